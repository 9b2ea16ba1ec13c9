"""Invalid input of every kind: one clear line, exit status 2, earlier results intact."""

import json
import os
import socket
import struct
import zlib
from pathlib import Path

import av
import numpy as np
import pytest

from twin import build as verb
from twin import commands
from twin.capture.capture_data import read_mask
from twin.capture.formats import read_colmap, read_transforms
from twin.capture.photos import load_photo
from twin.config import SceneConfig, SourceConfig
from twin.errors import InputError
from twin.geometry.images import image_size, read_image, write_image
from twin.scene import SceneDir

_METRIC = "[metric]\ncamera_height = 1.2\n"


def _scene(tmp_path, text):
    root = tmp_path / "scene"
    (root / "input").mkdir(parents=True, exist_ok=True)
    (root / "scene.toml").write_text(text)
    return root


def _source(path):
    return f'[[source]]\npath = "input/{path}"\n'


def _noise(i, size=(180, 320)):
    """A textured wall that moves sideways by 4 px a frame."""
    wall = np.random.default_rng(0).integers(0, 256, (size[0] // 4, 300, 3), dtype=np.uint8)
    return np.repeat(np.repeat(wall[:, i : i + size[1] // 4], 4, 0), 4, 1)


def _film(path, frames):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))


def _fails(capsys, root, *words, until="metric"):
    capsys.readouterr()
    assert commands.main("build", [str(root), "--until", until, "--quiet"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ") and all(word in lines[-1] for word in words), lines
    assert "Traceback" not in "".join(lines)
    assert not list((root / "build").glob("*.old"))


def test_one_photo_and_an_empty_one(tmp_path, capsys):
    root = _scene(tmp_path, _source("photos") + _METRIC)
    write_image(root / "input/photos/a.png", _noise(0))
    _fails(capsys, root, "photos")
    (root / "input/photos/b.png").touch()
    _fails(capsys, root, "b.png")


def test_unknown_key_and_no_scale(tmp_path, capsys):
    root = _scene(tmp_path, _source("a.mp4") + "[metric]\ncamera_hight = 1.2\n")
    assert commands.main("build", [str(root)]) == 2
    assert "did you mean 'camera_height'" in capsys.readouterr().err
    _film(root / "input/a.mp4", [_noise(i) for i in range(4)])
    _scene(tmp_path, _source("a.mp4"))
    _fails(capsys, root, "camera_height", "distance", "gps", "marker", "poses_are_metric")


@pytest.mark.parametrize("keep", ["capture"])
def test_a_failure_keeps_what_was_built(tmp_path, capsys, keep):
    root = _scene(tmp_path, _source("a.mp4") + _METRIC)
    _film(root / "input/a.mp4", [_noise(i) for i in range(20)])
    assert commands.main("build", [str(root), "--until", keep, "--quiet"]) == 0
    before = (root / "build/1_capture/stamp.json").read_text()
    (root / "input/a.mp4").write_bytes(b"gone")
    _fails(capsys, root, "a.mp4", until=keep)
    assert (root / "build/1_capture/stamp.json").read_text() == before


# ---- paths that are not files


def _special(folder, what):
    """A path below a folder that is not a regular file."""
    path = folder / "odd"
    if what == "pipe":
        os.mkfifo(path)
    elif what == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    elif what == "dangling":
        path.symlink_to("nowhere")
    elif what == "loop":
        path.symlink_to("odd")
    elif what == "null":
        path.symlink_to("/dev/null")
    elif what == "zero":
        path.symlink_to("/dev/zero")
    elif what == "folder":
        path.mkdir()
    elif what == "long":
        path = folder / ("x" * 300)
    return path


_SPECIAL = ("pipe", "socket", "dangling", "loop", "null", "zero", "folder", "long", "absent")


@pytest.mark.parametrize("what", _SPECIAL)
@pytest.mark.parametrize("key", ["path", "mask", "images"])
def test_a_path_of_the_scene_that_is_no_file(tmp_path, monkeypatch, capsys, what, key):
    monkeypatch.chdir(tmp_path)  # the name of a socket is short
    root = _scene(tmp_path, "")
    (root / "input/photos").mkdir()
    for i in range(3):
        write_image(root / f"input/photos/{i}.png", _noise(i))
    odd = _special((root / "input").relative_to(tmp_path), what)
    paths = {"path": "input/photos"} | {key: f"input/{odd.name}"}
    lines = "".join(f'{name} = "{path}"\n' for name, path in paths.items())
    (root / "scene.toml").write_text(f"[[source]]\n{lines}{_METRIC}")
    if (key, what) == ("images", "folder"):
        return  # the images of a plain folder may lie anywhere
    _fails(capsys, root, "odd" if what != "long" else "xxx", until="capture")


@pytest.mark.parametrize("kind", ["auto", "video", "images", "colmap", "transforms"])
def test_a_device_or_a_pipe_as_a_source_of_any_kind(tmp_path, capsys, kind):
    root = _scene(tmp_path, f'[[source]]\npath = "input/odd"\nkind = "{kind}"\n{_METRIC}')
    _special(root / "input", "pipe")
    _fails(capsys, root, "is a pipe", until="capture")


def test_pipes_and_link_loops_in_a_folder_are_skipped(tmp_path):
    root = _scene(tmp_path, "")
    (root / "input/photos").mkdir()
    write_image(root / "input/photos/a.png", _noise(0))
    os.mkfifo(root / "input/photos/b.png")
    (root / "input/photos/c.png").symlink_to("c.png")
    (root / "input/photos/d").symlink_to("..")
    config = SceneConfig(source=(SourceConfig(path="input/photos"),))
    assert set(verb.input_digests(SceneDir(root), config)) == {"input/photos/a.png"}


# ---- posed sets


def _transforms(folder, **changes):
    folder.mkdir(exist_ok=True)
    write_image(folder / "a.png", _noise(0))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    frame |= {key.removeprefix("frame_"): value for key, value in changes.items() if key.startswith("frame_")}
    table = {"fl_x": 300.0, "w": 320, "h": 180, "frames": [frame]}
    table |= {key: value for key, value in changes.items() if not key.startswith("frame_")}
    (folder / "transforms.json").write_text(json.dumps(table))
    return folder / "transforms.json"


_DEEP = json.loads("[" * 900 + "]" * 900)
_ODD = ([], {}, {"a": 1}, [1], "text", True, _DEEP, -1, 10**39, 1e308, 5e-324)


@pytest.mark.parametrize(
    "key",
    [
        *("frames", "fl_x", "w", "h", "cx", "k1", "camera_angle_x", "camera_model", "applied_transform"),
        *("applied_scale", "frame_file_path", "frame_transform_matrix", "frame_mask_path", "frame_fl_y"),
    ],
)
def test_values_of_the_wrong_type_in_a_transforms_json(tmp_path, key):
    for i, value in enumerate(_ODD):
        path = _transforms(tmp_path / str(i), **{key: value})
        try:
            found = read_transforms(path)
        except InputError as error:
            assert "\n" not in str(error) and len(str(error)) < 2000
        else:  # a value that makes sense, or one that nothing needs
            assert np.isfinite(found.camera_to_world).all() and found.lenses[0].width > 0


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"frames": ' * 5000,
        '{"w": ' + "9" * 5000 + "}",
        '{"w": 1' + "0" * 400 + "}",
        "NaN",
        "[]",
        '{"frames": [',
        "\xff",
    ],
)
def test_a_transforms_json_of_another_structure(tmp_path, text):
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_transforms(tmp_path / "transforms.json")


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "", ".", "..", "/", "sub", "pipe", "/dev/zero", "\ud800"])
def test_a_transforms_json_that_names_no_image(tmp_path, name):
    (tmp_path / "sub").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="none of its 1 images"):
        read_transforms(_transforms(tmp_path, frame_file_path=name))


def _colmap(folder, camera="1 PINHOLE 320 180 300 300 160 90", image="1 1 0 0 0 0 0 0 1 a.png"):
    folder.mkdir(exist_ok=True)
    write_image(folder / "a.png", _noise(0))
    (folder / "cameras.txt").write_text(camera + "\n")
    (folder / "images.txt").write_text(image + "\n\n")
    return folder


_BIG = "1" + "0" * 400


def test_a_colmap_model_of_text(tmp_path):
    assert read_colmap(_colmap(tmp_path)).paths == (tmp_path / "a.png",)
    (tmp_path / "sub").mkdir()
    for camera in (f"1 PINHOLE {_BIG} 180 300 300 160 90", f"1 PINHOLE 320 180 {_BIG} 300 160 90", "9" * 5000, "1 X"):
        with pytest.raises(InputError, match=r"cameras\.txt"):
            read_colmap(_colmap(tmp_path, camera=camera))
    for values in (
        f"{_BIG} 0 0 0 0 0 0",
        "1 0 0 0 nan 0 0",
        "1e300 1e300 0 0 0 0 0",
        "1 0 0 0 1e300 0 0",
        "0 0 0 0 0 0 0",
    ):
        with pytest.raises(InputError, match=r"images\.txt"):
            read_colmap(_colmap(tmp_path, image=f"1 {values} 1 a.png"))
    for name in ("../a.png", "/etc/passwd", "a\0b", "sub", "x" * 300, ".", "..\\a.png"):
        with pytest.raises(InputError, match=r"images\.txt|none of its 1 images"):
            read_colmap(_colmap(tmp_path, image=f"1 1 0 0 0 0 0 0 1 {name}"))


@pytest.mark.parametrize("count", [2**63, 2**64 - 1, 3])
def test_a_binary_colmap_model_with_too_large_counts(tmp_path, count):
    write_image(tmp_path / "a.png", _noise(0))
    camera = struct.pack("<iiQQ4d", 1, 1, 320, 180, 300, 300, 160, 90)
    image = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"
    cameras, images = tmp_path / "cameras.bin", tmp_path / "images.bin"
    none = struct.pack("<Q", 0)
    images.write_bytes(struct.pack("<Q", 1) + image + none)
    for data in (struct.pack("<Q", count) + camera, struct.pack("<QiiQQ", 1, 1, 1, count, count), b"", b"\xff" * 99):
        cameras.write_bytes(data)
        with pytest.raises(InputError, match=r"cameras\.bin"):
            read_colmap(tmp_path)
    cameras.write_bytes(struct.pack("<Q", 1) + camera)
    assert len(read_colmap(tmp_path).paths) == 1
    for data in (
        struct.pack("<Q", count) + image + none,
        struct.pack("<Q", 1) + image + struct.pack("<Q", count),
        b"\1",
    ):
        images.write_bytes(data)
        with pytest.raises(InputError, match=r"images\.bin"):
            read_colmap(tmp_path)


@pytest.mark.parametrize("path", [".", "../model", "./model/../model"])
def test_the_digests_of_a_posed_set_outside_the_scene_cover_the_files_read(tmp_path, path):
    root = tmp_path / "scene"
    root.mkdir()
    model = _colmap((root / path).resolve())
    (model / "notes.md").write_text("not read") if path == "../model" else None
    config = SceneConfig(source=(SourceConfig(path=path),))
    before = verb.input_digests(SceneDir(root), config)
    assert {Path(name).name for name in before} >= {"cameras.txt", "images.txt", "a.png"}
    for name in ("build/1_capture/x.png", "runs/a", "validation/b.png", "forecast/c"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("written by twin")
    (tmp_path / "elsewhere.mp4").write_text("another film")
    assert verb.input_digests(SceneDir(root), config) == before
    (model / "a.png").write_bytes(b"another")
    assert verb.input_digests(SceneDir(root), config) != before


# ---- images


def _forged(path, width, height):
    """A PNG of a few bytes whose header declares a huge picture."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("size", [(20_000, 10_000), (60_000, 60_000), (2**31 - 1, 2**31 - 1)])
def test_an_image_of_too_many_pixels_is_refused_by_its_header(tmp_path, size):
    path = _forged(tmp_path / "a.png", *size)
    for read in (read_image, image_size, lambda p: load_photo(p, None), lambda p: read_mask(p, 320, 180)):
        with pytest.raises(InputError, match=r"a\.png: the image has .*megapixels; expected at most 179 megapixels"):
            read(path)


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n\x1a\n", b"II*\0" + b"\xff" * 60, b"\xff\xd8\xff\xe1" + b"\0" * 90]
)
def test_an_image_that_is_damaged(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    for read in (read_image, lambda p: load_photo(p, None), lambda p: read_mask(p, 320, 180)):
        with pytest.raises(InputError, match=rf"a\.png: .*{len(content)} bytes"):
            read(path)


def test_an_image_that_is_cut_in_the_middle_of_its_data(tmp_path):
    write_image(tmp_path / "a.png", _noise(0))
    whole = (tmp_path / "a.png").read_bytes()
    for cut in range(8, len(whole), len(whole) // 12):
        (tmp_path / "b.png").write_bytes(whole[:cut] + b"\xff" * 40)
        try:
            assert load_photo(tmp_path / "b.png", None)[0].shape == (180, 320, 3)
        except InputError as error:
            assert "b.png" in str(error)
