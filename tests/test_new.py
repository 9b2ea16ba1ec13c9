"""The verb `new`: its scenes can be loaded and built."""

import json
import os
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from filmed_wall import HEIGHT, WIDTH, film, views

from twin import commands
from twin.build import build
from twin.config_file import load_config
from twin.errors import InputError
from twin.geometry.images import write_image
from twin.new import new_scene


def test_new_writes_a_scene_that_loads_and_never_overwrites(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    day = film(tmp_path / "day.mp4", views([5 * i for i in range(4)]))
    dusk = film(tmp_path / 'other/du"sk.mp4', views([5 * i for i in range(4)]))
    root = tmp_path / "scenes" / "road"
    assert commands.main("new", [str(root), str(day), str(dusk), "--camera-height", "1.2"]) == 0
    config = load_config(root / "scene.toml")
    assert config.name == "road" and config.metric.camera_height == 1.2
    assert [(s.path, s.lighting) for s in config.source] == [("input/day.mp4", "day"), ('input/du"sk.mp4', 'du"sk')]
    assert (root / "input/day.mp4").read_bytes() == day.read_bytes()
    before = (root / "scene.toml").read_text()
    for line in before.splitlines():  # every commented line is a setting that exists
        if line.startswith("# ") and " = " in line and "[fx" not in line:
            (tmp_path / "one.toml").write_text(_uncommented(before, line))
            load_config(tmp_path / "one.toml")
    capsys.readouterr()
    assert commands.main("new", [str(root), str(day)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "already" in error and (root / "scene.toml").read_text() == before


def test_two_at_once_do_not_mix_their_films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second would write to the unfinished copies of the first, and replace its `scene.toml`."""
    day = film(tmp_path / "day.mp4", views([5 * i for i in range(4)]))
    copy, refused = shutil.copyfile, []

    def copy_slowly(source: Path, target: Path) -> None:
        with pytest.raises(InputError, match="is being written by process"):
            new_scene(tmp_path / "road", [day])
        refused.append(copy(source, target))

    monkeypatch.setattr("twin.new.shutil.copyfile", copy_slowly)
    new_scene(tmp_path / "road", [day])
    assert len(refused) == 1 and sorted(p.name for p in (tmp_path / "road").iterdir()) == ["input", "scene.toml"]


def test_the_next_command_can_be_pasted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    day = film(tmp_path / "day.mp4", views([5 * i for i in range(4)]))
    assert commands.main("new", [str(tmp_path / "my road"), str(day)]) == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("next: "))
    assert words == ["twin", "build", str(tmp_path / "my road")]


def _uncommented(text: str, line: str) -> str:
    scales = ("# gps", "# poses", "# marker", "# distance")
    if line.startswith(scales):
        text = text.replace("camera_height = 1.2", "# camera_height = 1.2")
    return text.replace(line, line.removeprefix("# "), 1)


@pytest.mark.parametrize(
    "arguments", [["absent.mp4"], ["text.mp4"], ["day.mp4", "./day.mp4"], ["day.mp4", "--camera-height", "-1"]]
)
def test_new_refuses_unusable_films(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    film(tmp_path / "day.mp4", views([0, 5, 10]))
    (tmp_path / "text.mp4").write_text("no film")
    assert commands.main("new", ["scene", *arguments]) == 2
    assert capsys.readouterr().err.startswith("error: ") and not (tmp_path / "scene/scene.toml").exists()


def _transforms(folder: Path, name: str = "transforms.json", prefix: str = "images/") -> Path:
    """A posed image set of three views, its images at `prefix`."""
    frames = []
    for i, picture in enumerate(views([0, 9, 18])):
        write_image(folder / prefix / f"{i}.png", picture)
        frames.append({"file_path": f"{prefix}{i}.png", "transform_matrix": np.eye(4).tolist()})
    (folder / name).write_text(json.dumps({"frames": frames, "fl_x": 150.0}))
    return folder / name


def _colmap(root: Path) -> Path:
    """A COLMAP workspace of three views; its model, in text."""
    model = root / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 150 150 80 60\n")
    lines = []
    for i, picture in enumerate(views([0, 9, 18])):
        write_image(root / f"images/left/{i}.png", picture)
        lines += [f"{i + 1} 1 0 0 0 {0.1 * i} 0 0 1 left/{i}.png", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (root / "database.db").write_bytes(b"what no build needs")
    return model


@pytest.mark.parametrize("given", ["transforms.json", "its folder", "images elsewhere", "model", "workspace"])
def test_a_posed_image_set_is_copied_with_its_images_and_can_be_built(tmp_path: Path, given: str) -> None:
    data = tmp_path / "data/fox"
    if given in ("model", "workspace"):
        given_path = _colmap(data) if given == "model" else _colmap(data).parents[1]
        path = "input/fox/sparse/0" if given == "model" else "input/fox"
    elif given == "images elsewhere":
        given_path, path = _transforms(data / "nerf", "poses.json", "../photos/"), "input/fox/nerf/poses.json"
    else:
        table = _transforms(data)
        given_path, path = (table, "input/fox/transforms.json") if given == "transforms.json" else (data, "input/fox")
    root = tmp_path / "scene"
    assert commands.main("new", [str(root), str(given_path), "--camera-height", "1.2"]) == 0
    (source,) = load_config(root / "scene.toml").source
    assert (source.path, source.lighting) == (path, "fox")
    shutil.rmtree(tmp_path / "data")  # the scene stands alone
    report = build(root, until="capture")
    assert report["capture"]["frames"] == 3 and report["capture"]["posed"]
    assert not list((root / "input").rglob("*.db")) and not list((root / "input").glob("*.partial"))


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_the_inner_folder_of_a_posed_image_set_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture, kind: str
) -> None:
    data = tmp_path / "fox"
    _transforms(data) if kind == "transforms" else _colmap(data)
    photos = next(data.rglob("*.png")).parent
    assert commands.main("new", [str(tmp_path / "scene"), str(photos)]) == 0
    said = capsys.readouterr().err
    assert f"{data} has camera poses of these photos, which are not used; to use them, delete" in said
    alone = shutil.copytree(photos, tmp_path / "alone/images")
    assert commands.main("new", [str(tmp_path / "other"), str(alone)]) == 0
    assert "camera poses" not in capsys.readouterr().err


def test_a_camera_that_does_not_fit_its_images_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    table = _transforms(tmp_path / "fox")
    for name, size, words in (("far", (WIDTH, HEIGHT), "times the longer"), ("wide", (1920, 540), "its camera is for")):
        whole = json.loads(table.read_text()) | {"w": size[0], "h": size[1], "fl_x": 10.0 * size[0]}
        whole["fl_x"] = 10.0 * WIDTH if name == "far" else 1500.0
        table.write_text(json.dumps(whole))
        assert commands.main("new", [str(tmp_path / name), str(tmp_path / "fox")]) == 2
        assert words in capsys.readouterr().err


def test_a_posed_image_set_in_the_scene_stays_where_it_is(tmp_path: Path) -> None:
    table = _transforms(tmp_path / "scene/input/fox")
    assert commands.main("new", [str(tmp_path / "scene"), str(table), "--camera-height", "1.2"]) == 0
    (source,) = load_config(tmp_path / "scene/scene.toml").source
    assert (source.path, source.lighting) == ("input/fox/transforms.json", "fox")
    assert [path.name for path in (tmp_path / "scene/input").iterdir()] == ["fox"]


def test_a_posed_image_set_without_its_images_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    table, model = _transforms(tmp_path / "a"), _colmap(tmp_path / "b")
    shutil.rmtree(tmp_path / "a/images")
    shutil.rmtree(tmp_path / "b/images")
    absolute = _transforms(tmp_path / "c", prefix=f"{tmp_path / 'c'}/")
    for given, words in (
        (table, "none of its 3 images"),
        (model, "none of its 3 images"),
        (absolute, "absolute paths"),
    ):
        assert commands.main("new", [str(tmp_path / "scene"), str(given)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and words in error and error.count("\n") == 1
        assert not (tmp_path / "scene/scene.toml").exists() and not list((tmp_path / "scene").glob("input/*"))


@pytest.mark.parametrize("name", ["training", "any", "day+randomised"])
def test_a_reserved_name_is_changed(tmp_path: Path, name: str) -> None:
    day = film(tmp_path / f"{name}.mp4", views([5 * i for i in range(4)]))
    assert commands.main("new", [str(tmp_path / "scene"), str(day), "--camera-height", "1.2"]) == 0
    assert build(tmp_path / "scene", until="capture")["capture"]["frames"] >= 2


def test_special_files_of_a_folder_are_not_copied(tmp_path):
    photos = tmp_path / "photos"
    write_image(photos / "a.png", np.zeros((8, 8, 3), np.uint8))
    os.mkfifo(photos / "b.png")
    for name, target in (("c.png", "/dev/zero"), ("d.png", "nowhere"), ("e", ".")):
        (photos / name).symlink_to(target)
    new_scene(tmp_path / "scene", [photos], 1.2)
    assert [path.name for path in (tmp_path / "scene/input/photos").iterdir()] == ["a.png"]


@pytest.mark.parametrize("name", ["x" * 200, "\u6f22" * 60, ".hidden", "a\nb", "a\\b"])
def test_any_film_name_becomes_a_valid_lighting(tmp_path, name):
    write_image(tmp_path / name / "a.png", np.zeros((8, 8, 3), np.uint8))
    config = load_config(new_scene(tmp_path / "scene", [tmp_path / name], 1.2))
    assert 1 <= len(config.source[0].lighting) <= 80


@pytest.mark.parametrize(
    ("name", "words"),
    [("photo.png", "give the folder of all photos"), ("one.mp4", "give a longer film"), ("list.m3u8", "a playlist")],
)
def test_what_is_no_film_is_refused(tmp_path, capsys, name, words):
    write_image(tmp_path / "photo.png", views([0])[0])
    film(tmp_path / "one.mp4", views([0]))
    film(tmp_path / "part.ts", views([5 * i for i in range(20)]))
    (tmp_path / "list.m3u8").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\npart.ts\n#EXT-X-ENDLIST\n")
    assert commands.main("new", [str(tmp_path / "scene"), str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and not (tmp_path / "scene").exists()


def test_a_scene_inside_the_photo_folder_is_refused(tmp_path, capsys):
    write_image(tmp_path / "photos/a.png", np.zeros((8, 8, 3), np.uint8))
    for scene in ("photos", "photos/deep/scene"):
        assert commands.main("new", [str(tmp_path / scene), str(tmp_path / "photos")]) == 2
        error = capsys.readouterr().err
        assert "inside the folder" in error and "choose another folder" in error and error.count("\n") == 1
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["a.png"]


def test_a_folder_is_copied_once(tmp_path):
    """A second attempt uses the copy of the first; another folder of the same name is copied beside it."""
    for folder, shade in (("9.30", 0), ("other/9.30", 9)):
        write_image(tmp_path / folder / "deep/a.png", np.full((8, 8, 3), shade, np.uint8))
        write_image(tmp_path / folder / "b.png", np.zeros((8, 8, 3), np.uint8))
    _transforms(tmp_path / "fox")
    for _ in range(2):
        new_scene(tmp_path / "scene", [tmp_path / name for name in ("9.30", "other/9.30", "fox")], 1.2)
        copies = {path.name for path in (tmp_path / "scene/input").iterdir()}
        assert copies == {"9.30", "9.30_2", "fox"}
        (tmp_path / "scene/scene.toml").unlink()
    write_image(tmp_path / "9.30/c.png", np.zeros((8, 8, 3), np.uint8))
    new_scene(tmp_path / "scene", [tmp_path / "9.30"], 1.2)
    assert (tmp_path / "scene/input/9.30_3/c.png").exists()


@pytest.mark.parametrize("name", ["photos", "day.mp4"])
def test_a_copy_that_fails_leaves_nothing(tmp_path, monkeypatch, name):
    write_image(tmp_path / "photos/a.png", np.zeros((8, 8, 3), np.uint8))
    film(tmp_path / "day.mp4", views([5 * i for i in range(4)]))

    def full(source: Path, target: Path, **_: object) -> None:
        Path(target).write_bytes(b"begun")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        new_scene(tmp_path / "scene", [tmp_path / name], 1.2)
    assert not list((tmp_path / "scene/input").iterdir())


def test_films_of_one_name_become_two_lightings(tmp_path, capsys):
    folders = [tmp_path / name for name in ("9.30", "9.45", "x" * 81, "x" * 82)]
    for folder in folders:
        write_image(folder / "a.png", np.zeros((8, 8, 3), np.uint8))
    day = film(tmp_path / "9.30.mp4", views([5 * i for i in range(4)]))
    config = load_config(new_scene(tmp_path / "scene", [*folders, day], 1.2))
    assert [one.lighting for one in config.source] == ["9.30", "9.45", "x" * 80, "x" * 78 + "_2", "9.30_2"]
    assert f"{day}: another film is called 9.30, too, so its lighting is 9.30_2" in capsys.readouterr().err


def test_an_option_whose_value_is_two_dashes_is_refused(tmp_path, capsys):
    """argparse alone would return an empty list."""
    with pytest.raises(SystemExit) as end:
        commands.main("new", [str(tmp_path / "scene"), "film.mp4", "--camera-height=--"])
    assert end.value.code == 2 and "--camera-height: expected one argument" in capsys.readouterr().err
