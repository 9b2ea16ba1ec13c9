"""Packs: one drives as the built scene, bit for bit; what is private stays behind; hostile ones get one line."""

import contextlib
import io
import json
import multiprocessing
import re
import resource
import signal
import stat
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save as to_safetensors
from tiny_runs import tiny_runs
from tiny_twin import tiny_twin

import twin
from twin import runtime, unpack
from twin.__main__ import main
from twin.capture.capture_data import NO_GPS, Capture, SourceInfo
from twin.drive import chosen_policy, chosen_task
from twin.errors import InputError
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.poses import look_at
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BakedSection
from twin.nerf.lightings import AddedLighting, Fog
from twin.nerf.road import RoadSections
from twin.pack import pack, rounded
from twin.runtime import exclusive_lock
from twin.scene import SceneDir, stage_result, write_stamp
from twin.unpack import decode_differences, encode_differences, open_scene

MORE = """
[[obstacle]]  # beside my neighbor's house
kind = "box"
station = 2.123456789012345
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root = tiny_twin(tmp_path_factory.mktemp("pack") / "place", more=MORE)
    tiny_runs(root, {"task": "ahead"})
    scene = SceneDir(root)
    AddedLighting(
        "dusk", [0.5, 0.5, 0.0, 0.0], Fog(0.01, (0.5, 0.5, 0.5)), stage_result(scene, "field"), "/home/me/dusk.jpg", {}
    ).save(scene)
    return root


@pytest.fixture(scope="module")
def packed(root, tmp_path_factory) -> Path:
    return pack(root, tmp_path_factory.mktemp("packed") / "place.twin", ["ahead"])[0]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "twin" / "packs"


def episode(scene: Path) -> list[np.ndarray]:
    """States and pixels of a drive with obstacles, under a mixture with a lighting of a photo."""
    env = twin.load(scene, "ahead", seed=3, lighting="day:dusk:0.5")
    step, out = env.reset(), []
    for action in ([1.0, 0.1], [0.8, -0.4], [0.8, 0.3], [1.0, 0.0]):
        out += [step.observation["pixels"], env.physics.data.qpos.copy(), env.physics.data.qvel.copy()]
        step = env.step(action)
    return out


def test_a_packed_scene_drives_as_the_built_one_bit_for_bit(root, packed, tmp_path):
    unpack.unpack(packed, tmp_path / "there")
    built = episode(root)
    for scene in (tmp_path / "there", packed):
        for a, b in zip(built, episode(scene), strict=True):
            np.testing.assert_array_equal(a, b)


def test_replaced_samples_are_read_by_no_ray(root, packed, tmp_path):
    unpack.unpack(packed, tmp_path / "there")
    fields = [twin.load_scene(scene).field() for scene in (root, tmp_path / "there")]
    assert (fields[0].sections[0].arrays["features"] != fields[1].sections[0].arrays["features"]).any()
    rng = np.random.default_rng(0)
    eyes = rng.uniform([-3, -8, 0.2], [12, 3, 2.5], (40, 3))
    poses = np.array([look_at(eye, eye + rng.normal(size=3)) for eye in eyes])
    views = Viewpoints.of(poses, [60.0, 60.0, 40.0, 22.5], (80, 45))
    a, b = (field.render(views, "night") for field in fields)
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_packed_long_road_has_all_its_sections(tmp_path):
    root = tiny_twin(tmp_path / "place")
    stage = SceneDir(root).stage("field")
    field = BakedField.load(stage)
    x = np.linspace(-3.0, 12.0, 40)
    road = RoadSections(np.stack([x, 0 * x, 0 * x + 1.0], 1), (x > 3.0).astype(np.int64))
    sections = [field.sections[0], other_features(field.sections[0])]
    BakedField(sections, field.lightings_by_name, field.networks, road=road).save(stage)
    write_stamp(stage, "field")
    out, _ = pack(root, tmp_path / "long.twin")
    unpack.unpack(out, tmp_path / "there")
    eyes = np.stack([[0.0, 3.0, 6.0], [0.0] * 3, [1.0] * 3], 1)
    views = Viewpoints.of(
        np.array([look_at(eye, eye + np.array([2.0, 0.3, -0.2])) for eye in eyes]), [60, 60, 40, 22], (80, 44)
    )
    a, b = (twin.load_scene(scene).field().render(views, "day").rgb for scene in (root, tmp_path / "there"))
    np.testing.assert_array_equal(a, b)
    changed = np.abs(a - field.render(views, "day").rgb).max((1, 2, 3))
    assert changed[0] == 0.0 and changed[1:].min() > 0.01


def other_features(section: BakedSection) -> BakedSection:
    """The section with other features."""
    features = section.arrays["features"].copy()
    features[..., 1:] = 255 - features[..., 1:]
    return BakedSection(section.layout, section.arrays | {"features": features})


def test_fewer_levels_make_a_smaller_pack_of_another_field(root, packed, tmp_path):
    small, manifest = pack(root, tmp_path / "small.twin", levels=8)
    assert manifest["levels"] == 8 and small.stat().st_size < 0.8 * packed.stat().st_size
    opened = twin.load_scene(small)
    assert stage_result(opened.scene, "field") != stage_result(SceneDir(root), "field")
    assert "dusk" in opened.field().lightings  # its embedding is as valid as before
    views = Viewpoints.of(
        np.array([look_at(np.array([0.0, 0, 1]), np.array([3.0, 0, 0.8]))]), [60, 60, 40, 22], (80, 44)
    )
    a, b = (scene.field().render(views, "day").rgb for scene in (opened, twin.load_scene(root)))
    assert 0 < np.abs(a - b).mean() < 0.05


def test_rounding_keeps_zero_and_stays_within_half_a_step():
    values = np.arange(256, dtype=np.uint8)
    for step in (1.0, 4.0, 32.0, 25.6):
        out = rounded(values, step).astype(int)
        assert out[128] == 128 and np.abs(out - values).max() <= step / 2 + 0.5
        assert len(np.unique(out)) <= 256 / step + 2


def decoded(content: bytes) -> bytes:
    out = np.frombuffer(content, np.uint8).copy()
    decode_differences(out)
    return out.tobytes()


def test_a_pack_that_could_not_be_unpacked_is_not_written(root, tmp_path, monkeypatch):
    monkeypatch.setattr("twin.unpack._MAX_FILES", 5)
    with pytest.raises(InputError, match="files; expected at most 5"):
        pack(root, tmp_path / "place.twin", ["ahead"])
    assert not list(tmp_path.glob("place*"))


def test_coding_is_undone_exactly():
    rng = np.random.default_rng(1)
    arrays = {
        "cube": rng.integers(0, 256, (3, 7, 5), np.uint8),
        "flat": rng.integers(0, 256, 9, np.uint8),
        "none": np.zeros((0, 4), np.uint8),
        "float": rng.normal(size=(4, 4)).astype(np.float32),
    }
    content = to_safetensors(arrays)
    coded = encode_differences(content)
    assert len(coded) == len(content) and coded != content
    assert decoded(coded) == content
    np.testing.assert_array_equal(load_safetensors(coded)["float"], arrays["float"])


def test_coded_arrays_may_not_overlap():
    content = to_safetensors({"a": np.zeros((4, 5), np.uint8)})
    (length,) = struct.unpack_from("<Q", content)
    one = json.loads(content[8 : 8 + length])["a"]
    text = json.dumps({"a": one, "b": one}).encode()
    with pytest.raises(ValueError, match="overlap"):
        decoded(struct.pack("<Q", len(text)) + text + content[8 + length :])


def test_the_same_scene_gives_the_same_pack(root, packed, tmp_path):
    stray = SceneDir(root).stage("mjcf") / "MUJOCO_LOG.TXT"  # not of the build, and refused by unpack
    stray.write_text("x")
    again, _ = pack(root, tmp_path / "place.twin", ["ahead"], trust=True)  # without effect, as there is no zip
    stray.unlink()
    assert again.read_bytes() == packed.read_bytes()


def test_progress_is_counted_in_bytes(root, tmp_path, monkeypatch):
    shown, totals = [], []

    def bar(what, total, unit, after):
        totals.append((total, unit))
        return contextlib.nullcontext(SimpleNamespace(update=shown.append))

    monkeypatch.setattr(runtime, "bar", bar)
    monkeypatch.setattr("twin.pack._CHUNK", 1000)
    _, manifest = pack(root, tmp_path / "place.twin")
    assert totals == [(sum(one["bytes"] for one in manifest["files"].values()), "B")]
    assert sum(shown) == totals[0][0] and max(shown) == 1000


def test_what_is_private_stays_behind(root, packed):
    with zipfile.ZipFile(packed) as archive:
        names = archive.namelist()
        text = b"".join(archive.read(name) for name in names if not name.endswith((".npz", ".safetensors", ".onnx")))
        note = archive.read("README.txt").decode()
    assert b"neighbor" not in text and b"/home/me" not in text and b"input/" not in text
    assert not any(name.startswith(("input", "build/1", "build/2_cameras", "build/6", "runs/left")) for name in names)
    assert "PRIVACY" in note and "not stated" in note and "It has no GPS positions" in note


def test_positions_are_taken_along_when_asked_for(root, tmp_path):
    with pytest.raises(InputError, match="no 1_capture yet"):
        pack(root, tmp_path / "a.twin", positions=True)
    scene = SceneDir(root)
    names, n = ("day/000000", "day/000001"), 2
    source = SourceInfo(**dict.fromkeys(SourceInfo.__annotations__, "") | {"name": "day", "camera_params": ()})
    gps = np.array([[48.5, 9.05, 340.0], NO_GPS])
    scene.stage("capture").mkdir()
    Capture((source,), names, np.zeros(n, int), np.arange(2.0), np.zeros(n, bool), gps).save(scene.stage("capture"))
    write_stamp(scene.stage("capture"), "capture")
    filmed = Cameras.load(scene.stage("metric"))
    assert set(names) & set(filmed.names)
    out, manifest = pack(root, tmp_path / "b.twin", positions=True, licence="CC BY 4.0")
    with zipfile.ZipFile(out) as archive:
        rows = archive.read("positions.csv").decode().splitlines()
        assert "CC BY 4.0" in archive.read("README.txt").decode() and manifest["licence"] == "CC BY 4.0"
    assert len(rows) == 2 and rows[1].startswith("day/000000,48.5,9.05,340.0,")


def test_what_came_with_the_pack_drives_it(packed, tmp_path):
    unpack.unpack(packed, tmp_path / "there")
    opened = twin.load_scene(tmp_path / "there")
    policy = chosen_policy(opened, None)
    assert policy == "ahead" and chosen_task(opened, None, policy, False) == "ahead"
    assert chosen_policy(opened, "other") == "other" and chosen_task(opened, "bend", policy, False) == "bend"


@pytest.mark.parametrize("name", ["os:getcwd", "../outside", "/etc/hosts", "runs/ahead/policy.json"])
def test_an_unpacked_scene_drives_by_no_other_policy_than_its_own(packed, tmp_path, name):
    unpack.unpack(packed, tmp_path / "there")
    assert chosen_policy(twin.load_scene(tmp_path / "there"), None) == "ahead"
    manifest = tmp_path / "there" / "pack.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"policies": [name]}))
    assert unpack.packed_policies(tmp_path / "there") == []
    assert chosen_policy(twin.load_scene(tmp_path / "there"), None) == "ahead"  # its only run
    for damaged in ("{}", "[]", '{"policies": 5}', '{"policies": [5]}'):
        manifest.write_text(damaged)
        with pytest.raises(InputError, match=r"pack\.json is damaged"):
            unpack.packed_policies(tmp_path / "there")


def test_drive_films_a_pack_by_its_name(packed, tmp_path, monkeypatch, capsys):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "tiny.twin").write_bytes(packed.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert main(["drive", "tiny", "--lighting", "night"]) == 0
    film = Path(capsys.readouterr().out.split(": ")[-1].strip())
    assert film.name.startswith("tiny_ahead_") and film.stat().st_size > 10_000
    assert main(["drive", "tiny", "--view", "--out", "a.mp4"]) == 2
    assert "leave out one of them" in capsys.readouterr().err
    for wrong in ("drive.avi", "."):
        assert main(["drive", "tiny", "--out", wrong]) == 2
        assert f"{wrong}: expected a file ending in .mp4" in capsys.readouterr().err
    assert main(["drive", "tiny", "--port", "9000"]) == 2
    assert "--port 9000: only the page has it" in capsys.readouterr().err
    assert main(["drive", "nowhere"]) == 2
    assert "no nowhere.twin here or in scenes/; give a path" in capsys.readouterr().err
    assert main(["drive", "tiy"]) == 2
    assert "no tiy.twin here or in scenes/; did you mean 'tiny'?" in capsys.readouterr().err


def test_drive_says_what_is_wrong_with_a_pack_that_is_there(packed, tmp_path, monkeypatch, capsys):
    (tmp_path / "cut.twin").write_bytes(packed.read_bytes()[:-4000])
    rewritten(packed, tmp_path / "sent.twin", add("policies/a.zip"))
    monkeypatch.chdir(tmp_path)
    for name, words in (
        ("cut", "expected a pack, as twin pack"),
        ("sent", "if you trust its sender, twin unpack --trust"),
    ):
        assert main(["drive", name]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{name}.twin" in line and words in line and "no folder" not in line


def test_verbs_that_add_results_ask_for_a_folder(packed, capsys):
    trial = ["a.mcap", "--policy", "ahead", "--lighting", "monday"]
    for verb, more in (("validate", ["--policy", "ahead"]), ("train", ["--run", "x"]), ("trial", trial)):
        assert main([verb, str(packed), *more]) == 2
        assert "unpack it to a folder, which can take results: twin unpack" in capsys.readouterr().err


def test_verbs_that_need_films_say_what_is_absent(packed, tmp_path, capsys):
    unpack.unpack(packed, tmp_path / "there")
    (tmp_path / "photo.png").write_bytes(b"")
    there = str(tmp_path / "there")
    assert main(["relight", there, str(tmp_path / "photo.png"), "--name", "noon"]) == 2
    assert "has neither 1_capture nor films" in capsys.readouterr().err
    assert main(["export", there, "--colmap", str(tmp_path / "colmap")]) == 2
    assert "has neither 1_capture nor films" in capsys.readouterr().err
    assert main(["build", there]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_an_unpacked_scene_is_validated(packed, tmp_path):
    there = str(tmp_path / "there")
    assert main(["unpack", str(packed), there, "--quiet"]) == 0
    run = [
        "validate",
        there,
        "--policy",
        "ahead",
        "--task",
        "ahead",
        "--episodes",
        "2",
        "--lightings",
        "day",
        "--quiet",
    ]
    assert main(run) == 0
    assert (tmp_path / "there" / "validation" / "episodes.csv").exists()


def _open(packed: str) -> str:
    return str(open_scene(Path(packed)))


def test_two_processes_open_a_pack_at_once(packed, cache):
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        a, b = pool.map(_open, [str(packed)] * 2, chunksize=1)
    assert a == b and [path.name for path in cache.iterdir()] == [Path(a).name]
    before = (Path(a) / "scene.toml").stat().st_mtime_ns
    assert _open(str(packed)) == a and (Path(a) / "scene.toml").stat().st_mtime_ns == before


def break_file(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("name", ["build/3_field/baked.safetensors", "scene.toml", unpack.PACK_JSON])
@pytest.mark.parametrize("harm", [break_file, Path.unlink])
def test_a_damaged_pack_in_the_cache_is_unpacked_again(packed, cache, name, harm, capsys):
    folder = open_scene(packed)
    before = {one: one.read_bytes() for one in folder.rglob("*") if one.is_file()}
    (folder / "build" / "more.txt").write_text("")  # not of the pack, so it does no harm
    assert open_scene(packed) == folder and (folder / "build" / "more.txt").exists()
    assert "is damaged" not in capsys.readouterr().err
    harm(folder / name)
    assert open_scene(packed) == folder
    assert {one: one.read_bytes() for one in folder.rglob("*") if one.is_file()} == before
    assert [one.name for one in cache.iterdir()] == [folder.name]
    assert f"{packed} is unpacked again" in capsys.readouterr().err


def test_the_cure_of_a_damaged_unpacked_scene_is_its_pack(packed, tmp_path):
    unpack.unpack(packed, tmp_path / "there")
    break_file(tmp_path / "there" / "build" / "5_mjcf" / "scene.xml")
    with pytest.raises(InputError, match=r"scene\.xml is damaged .*; unpack the pack of .*/there into another folder"):
        twin.load_scene(tmp_path / "there").world()


_KILLED = """
import os, signal, sys
from pathlib import Path
from twin import unpack
unpack._check_contents = lambda *given: os.kill(os.getpid(), signal.SIGKILL)
unpack.open_scene(Path(sys.argv[1]))
"""


def test_what_a_killed_process_left_in_the_cache_is_removed(packed, cache):
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(packed)])
    assert killed.returncode == -signal.SIGKILL
    assert any((one / "scene.toml").exists() for one in cache.iterdir())
    used = cache / ".other-0123.abcd0123.partial"  # of another process, which still runs
    used.mkdir()
    with exclusive_lock(used.with_suffix(".lock"), "a pack is being unpacked"):
        folder = open_scene(packed)
        assert {one.name for one in cache.iterdir()} == {folder.name, used.name, f"{used.stem}.lock"}


def test_what_a_killed_process_left_in_an_empty_folder_is_removed(packed, tmp_path):
    left = tmp_path / "mine" / ".mine.abcd0123.partial" / "build"
    left.mkdir(parents=True)
    unpack.unpack(packed, tmp_path / "mine")
    assert not left.parent.exists() and (tmp_path / "mine" / unpack.PACK_JSON).exists()


# ---- hostile packs


def rewritten(packed: Path, out: Path, change) -> Path:
    """A copy of a pack whose entries, a list of (ZipInfo, content), and manifest `change` has edited in place."""
    with zipfile.ZipFile(packed) as archive:
        entries = [(entry, archive.read(entry)) for entry in archive.infolist()]
    manifest = json.loads(entries[1][1])
    more = change(manifest, entries)
    entries[1] = entries[1][0], json.dumps(manifest).encode()
    with pytest.MonkeyPatch.context() as patch, zipfile.ZipFile(out, "w") as archive:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        for entry, content in entries:
            archive.writestr(entry, content)
    if more is not None:
        out.write_bytes(more(out.read_bytes()))
    return out


def add(name: str, content: bytes = b"x", mode: int = stat.S_IFREG | 0o644, **declared):
    def change(manifest, entries):
        entry = zipfile.ZipInfo(name)
        entry.external_attr = mode << 16
        entry.compress_type = zipfile.ZIP_DEFLATED
        entries.append((entry, content))
        manifest["files"][name] = {
            "bytes": len(content), "sha256": unpack.digest(content), "coding": "plain", **declared
        }  # fmt: skip

    return change


def declare(key: str, value):
    return lambda manifest, _: manifest.update({key: value})


def twice(manifest, entries):
    entries.append(next(one for one in entries if one[0].filename == "scene.toml"))


def edit(name: str, change):
    """Changes a file of a pack, and its digest and size in the manifest."""

    def edited(manifest, entries):
        k = next(i for i, one in enumerate(entries) if one[0].filename == name)
        content = change(entries[k][1])
        entries[k] = entries[k][0], content
        manifest["files"][name] |= {"bytes": len(content), "sha256": unpack.digest(content)}

    return edited


def huge_shape(content: bytes) -> bytes:
    (length,) = struct.unpack_from("<Q", content)
    head = json.loads(content[8 : 8 + length])
    head["features"]["shape"] = [10**12, 729, 16]
    text = json.dumps(head).encode()
    return struct.pack("<Q", len(text)) + text + content[8 + length :]


def masks_in(folder: str):
    return lambda content: json.dumps(json.loads(content) | {"masks": folder}).encode()


def source_at(path: bytes):
    return lambda content: re.sub(rb'"path" = "[^"]*"', b'"path" = "' + path + b'"', content, count=1)


def wrong_digest(manifest, _):
    manifest["files"]["scene.toml"]["sha256"] = "0" * 64


def code_as_differences(manifest, _):
    manifest["files"][XML]["coding"] = "differences"


FIELD, XML, CAMERAS = "build/3_field/baked.safetensors", "build/5_mjcf/scene.xml", "build/2_metric/cameras.json"
# To a parser without entities, the document is the entity's text; to one with them, it is what follows.
ENTITY = b"""<!DOCTYPE m [<!ENTITY a "><mujoco><include file='/a.xml'/></mujoco><!--"> ]><!-- x -->"""
HOSTILE = {
    "traversal": (add("../../evil.toml"), "is not a file of a scene"),
    "absolute": (add("/tmp/evil.toml"), "is not a file of a scene"),
    "inner traversal": (add("build/5_mjcf/assets/../../../x.obj"), "is not a file of a scene"),
    "backslash": (add("build\\evil.obj"), "is not a file of a scene"),
    "code": (add("build/5_mjcf/evil.py"), "is not a file of a scene"),
    "hidden": (add("lightings/.bashrc"), "is not a file of a scene"),
    "link": (add("build/5_mjcf/assets/a.obj", b"/etc/passwd", stat.S_IFLNK | 0o777), "is not a regular file"),
    "bomb": (add("build/5_mjcf/assets/a.obj", bytes(90 << 20)), "unpacks to"),
    "huge": (add("build/5_mjcf/assets/a.obj", bytes=10**13), "expected at most"),
    "negative": (add("build/5_mjcf/assets/a.obj", bytes=-1), "expected at most"),
    "other size": (add("build/5_mjcf/assets/a.obj", bytes=5), "manifest.json says otherwise"),
    "digest": (wrong_digest, "not as it was packed"),
    "huge shape": (edit(FIELD, huge_shape), "features"),
    "short header": (edit(FIELD, lambda b: struct.pack("<Q", 10**15) + b[8:]), "its header has"),
    "twice": (twice, "a name twice"),
    "version": (declare("version", 99), "version 99, expected 1"),
    "format": (declare("format", "tar"), "no twin pack"),
    "no files": (declare("files", 3), "is damaged"),
    "unlisted": (lambda manifest, _: manifest["files"].pop("scene.toml") and None, "in the pack but not listed"),
    "truncated": (lambda *_: lambda content: content[: len(content) // 2], "is damaged"),
    "no zip": (lambda *_: lambda content: b"twin" * 100, "is damaged"),
    "include": (edit(XML, lambda b: b.replace(b"<asset>", b'<include file="/a"/><asset>', 1)), "names a file"),
    "path": (edit(XML, lambda b: b.replace(b'meshdir="assets"', b'meshdir="/etc"', 1)), "names a file"),
    "sky": (edit(XML, lambda b: b.replace(b"<asset>", b'<asset><texture fileback="/a.png"/>', 1)), "names a file"),
    "namespace": (edit(XML, lambda b: b.replace(b"<asset>", b'<include xmlns="q" file="w"/><asset>', 1)), "has xmlns"),
    "encoding": (edit(XML, lambda b: b.decode().encode("utf-16")), "scene.xml: no UTF-8 text"),
    "coding": (code_as_differences, "build/5_mjcf/scene.xml has coding differences; expected plain"),
    "entity": (edit(XML, lambda b: ENTITY + b), "scene.xml has <!DOCTYPE; expected"),
    "masks": (edit(CAMERAS, masks_in("/etc")), "etc' names a file"),
    "masks above": (edit(CAMERAS, masks_in("1_capture/../../../x")), "x' names a file"),
    "config": (edit("scene.toml", lambda b: b + b"surprise = 1\n"), "surprise"),
    "source": (edit("scene.toml", source_at(b"/etc")), "'/etc' names a file"),
    "source above": (edit("scene.toml", source_at(b"../x")), "'../x' names a file"),
    "function": (declare("policies", ["pickle:loads"]), "policy 'pickle:loads' is not in the pack"),
    "policy above": (declare("policies", ["../ahead"]), "policy '../ahead' is not in the pack"),
    "untrusted": (add("policies/a.zip"), "if you trust its sender, twin unpack --trust"),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_pack_gets_one_line_and_leaves_nothing(packed, tmp_path, capsys, what):
    change, message = HOSTILE[what]
    bad = rewritten(packed, tmp_path / "bad.twin", change)
    place = tmp_path / "place"
    place.mkdir()
    assert main(["unpack", str(bad), str(place / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error, error
    assert not list(place.iterdir()) and not (tmp_path / "evil.toml").exists()
    assert main(["drive", str(bad)]) == 2  # nor does the cache keep anything
    assert not list((tmp_path / "cache" / "twin" / "packs").glob("*"))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED])
def test_a_manifest_that_inflates_beyond_its_declared_size_takes_no_memory(tmp_path, method):
    bad = tmp_path / "bomb.twin"
    with zipfile.ZipFile(bad, "w", method) as archive:
        archive.writestr("manifest.json", bytes(100 << 20))
    content = bytearray(bad.read_bytes())
    struct.pack_into("<I", content, content.rfind(b"PK\x01\x02") + 24, 1000)  # the declared size
    bad.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"bomb\.twin"):
            unpack.read_manifest(bad)
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()


def test_a_folder_with_something_in_it_is_kept(packed, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("x")
    with pytest.raises(InputError, match="exists"):
        unpack.unpack(packed, tmp_path / "mine")


def test_an_empty_folder_is_filled_also_through_a_link_or_as_the_working_folder(packed, tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    unpack.unpack(packed, tmp_path / "link")
    monkeypatch.chdir(tmp_path / "b")
    unpack.unpack(packed, Path())
    names = {one.name for one in (tmp_path / "a").iterdir()}
    assert unpack.PACK_JSON in names and names == {one.name for one in (tmp_path / "b").iterdir()}


@pytest.mark.parametrize("moves", [0, 1, 2, 3])
def test_an_interrupted_unpack_leaves_an_empty_folder_empty(packed, tmp_path, monkeypatch, moves):
    there, rename, seen = tmp_path / "there", Path.rename, []
    there.mkdir()

    def interrupted(self, target):
        if len(seen) == moves:
            raise KeyboardInterrupt
        seen.append(self.name)
        return rename(self, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "rename", interrupted)
        unpack.unpack(packed, there)
    assert seen[:1] == [unpack.PACK_JSON][:moves] and "scene.toml" not in seen
    assert not list(there.iterdir())
    unpack.unpack(packed, there)
    assert (there / "scene.toml").exists()


def test_a_file_that_cannot_be_written_is_no_damage_to_the_pack(packed, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            unpack.unpack(packed, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_an_sb3_zip_is_packed_and_unpacked_by_trust_alone(root, tmp_path, monkeypatch):
    zipped = tmp_path / "a.zip"
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(InputError, match="runs code"):
        pack(root, tmp_path / "x.twin", [str(zipped)])
    monkeypatch.setattr("twin.pack.load_policy", lambda *_: None)  # stable-baselines3 would refuse this one
    out, manifest = pack(root, tmp_path / "x.twin", [str(zipped)], trust=True)
    assert manifest["policies"] == ["policies/a.zip"]
    with pytest.raises(InputError, match="--trust"):
        open_scene(out)
    unpack.unpack(out, tmp_path / "y", trust=True)
    assert (tmp_path / "y" / "policies" / "a.zip").read_bytes() == zipped.read_bytes()


def test_a_policy_whose_name_unpack_would_refuse_is_refused(root, tmp_path):
    (tmp_path / "my policy.onnx").write_bytes((root / "runs" / "ahead" / "policy.onnx").read_bytes())
    with pytest.raises(InputError, match=r"'policies/my policy\.onnx' cannot be in a pack; rename it"):
        pack(root, tmp_path / "x.twin", [str(tmp_path / "my policy.onnx")])
    assert not (tmp_path / "x.twin").exists()


def test_a_scene_inside_the_folder_of_its_photos_is_packed(tmp_path):
    root = tiny_twin(tmp_path / "photos" / "place")
    toml = root / "scene.toml"
    toml.write_text(re.sub(r'path = "[^"]*"', 'path = ".."', toml.read_text(), count=1))
    file, _ = pack(root, tmp_path / "place.twin")
    assert twin.load_scene(file).world().route.shape[1] >= 2


def test_two_policies_of_one_name_are_refused(root, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "policy.onnx").write_bytes((root / "runs" / "ahead" / "policy.onnx").read_bytes())
    with pytest.raises(InputError, match=r"the pack has a policy policies/policy\.onnx already"):
        pack(root, tmp_path / "x.twin", [str(tmp_path / name / "policy.onnx") for name in ("a", "b")])


def test_a_function_has_no_place_in_a_pack(root, tmp_path):
    with pytest.raises(InputError, match="policy operator:neg"):
        pack(root, tmp_path / "x.twin", ["operator:neg"])


@pytest.mark.parametrize(
    "name, change",
    [
        ("features", lambda a: a[:-1]),
        ("near", lambda a: a + 1000),
        ("near", lambda a: np.concatenate([a[:1], a[:-1]])),
        ("near_leap", lambda a: a[:-4]),
        ("network.head.1", lambda a: a[:, :4]),
        ("network.head.0", lambda a: a[:4]),
        ("network.backdrop.1", lambda a: a[:, :2]),
        ("step", lambda a: a[:3]),
    ],
)
def test_a_field_that_a_kernel_would_read_beyond_is_refused(root, tmp_path, name, change):
    folder = SceneDir(root).stage("field")
    arrays = load_safetensors((folder / "baked.safetensors").read_bytes())
    arrays[name] = np.ascontiguousarray(change(arrays[name]))
    (tmp_path / "baked.json").write_bytes((folder / "baked.json").read_bytes())
    (tmp_path / "baked.safetensors").write_bytes(to_safetensors(arrays))
    with pytest.raises(InputError, match="damaged"):
        BakedField.load(tmp_path)


def test_the_page_of_a_manifest_is_readable(packed):
    manifest = unpack.read_manifest(packed)
    assert manifest["policies"] == ["ahead"] and manifest["levels"] == 256
    with zipfile.ZipFile(io.BytesIO(packed.read_bytes())) as archive:
        assert archive.testzip() is None
