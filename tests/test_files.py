"""Arbitrary files: errors are one line, nothing hangs, no code runs, and former contents stay."""

import json
import os
import re
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin import files
from twin.errors import InputError
from twin.evaluation.trials import Cell, read_results, read_trials
from twin.scene import SceneDir, check_name, require_stage, run_folder, write_stamp
from twin.sysid.log_files import read_log

_DEEP = 100_000


@pytest.mark.parametrize("kind", ["pipe", "folder", "null", "zero", "dangling", "loop", "nothing", "long", "nul"])
@pytest.mark.parametrize("reader", [files.read_json, files.read_toml, files.load_arrays, files.load_tensors, read_log])
def test_errors_for_missing_or_special_files_are_one_line(tmp_path, kind, reader):
    path = tmp_path / "some.csv"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path = tmp_path
    elif kind in ("null", "zero"):
        path.symlink_to(f"/dev/{kind}")
    elif kind == "dangling":
        path.symlink_to(tmp_path / "gone")
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "long":
        path = tmp_path / ("x" * 300)
    elif kind == "nul":
        path = tmp_path / "a\0b.csv"
    with pytest.raises(InputError) as refused:
        reader(path)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 1600


@pytest.mark.parametrize(
    "text",
    [
        "[" * _DEEP,
        '{"a":' * _DEEP,
        "1" * 5000,
        '{"a": -1' + "0" * 400 + "}",
        "1e999",
        "NaN",
        "[-Infinity]",
        "",
        "{",
        "\ufeff\ufeff1",
        '"\x00"',
    ],
)
def test_errors_for_bad_json_are_one_line(tmp_path, text):
    path = tmp_path / "some.json"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(str(path))) as refused:
        files.read_json(path)
    assert len(str(refused.value)) < len(str(path)) + 200


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * _DEEP,
        "a = " + "1" * 5000,
        "a = 1" + "0" * 400,
        "a = {b" * 9000,
        "\x00",
        "a" + ".a" * _DEEP + " = 1",
        "a = {b" + ".b" * _DEEP + " = 1}",
    ],
)
def test_errors_for_bad_toml_are_one_line(tmp_path, text):
    path = tmp_path / "some.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(str(path))):
        files.read_toml(path)


def test_write_and_read_round_trip(tmp_path):
    value = {"state": 2**127, "low": -1.5e-300, "text": "é", "deep": [[[1]]]}
    files.write_json(tmp_path / "a.json", value)
    assert files.read_json(tmp_path / "a.json") == value
    files.save_arrays(tmp_path / "a.npz", {"x": np.arange(5), "y": np.zeros((0, 3), np.float32)})
    read = files.load_arrays(tmp_path / "a.npz")
    assert list(read) == ["x", "y"] and (read["x"] == np.arange(5)).all() and read["y"].shape == (0, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.npz"]


def test_pickled_and_oversized_arrays_are_refused(tmp_path):
    class Planted:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    np.savez(tmp_path / "pickle.npz", x=np.array([Planted()], object))
    np.savez_compressed(tmp_path / "bomb.npz", x=np.zeros(1 << 27, np.uint8))
    np.save(tmp_path / "small.npy", np.zeros(3))
    forged = (tmp_path / "small.npy").read_bytes().replace(b"(3,)", b"(9999999999,)", 1)
    with zipfile.ZipFile(tmp_path / "forged.npz", "w") as archive:
        archive.writestr("x.npy", forged.replace(b" " * 10 + b"\n", b"\n", 1))
    for name in ("pickle.npz", "bomb.npz", "forged.npz"):
        with pytest.raises(InputError, match=name):
            files.load_arrays(tmp_path / name, 1 << 26)
    assert not (tmp_path / "ran").exists()


def test_a_failed_write_leaves_the_former_file(tmp_path):
    path = tmp_path / "a.json"
    files.write_json(path, 1)
    with pytest.raises(ValueError):
        files.write_json(path, float("nan"))
    with pytest.raises(KeyError), files.atomic_path(path) as partial:
        partial.write_text("half")
        raise KeyError
    assert files.read_json(path) == 1 and [one.name for one in tmp_path.iterdir()] == ["a.json"]


def test_allocation_keeps_contents(tmp_path):
    path = tmp_path / "tape"
    path.write_bytes(b"kept")
    files.allocate(path, 1 << 20)
    assert path.stat().st_blocks * 512 >= 1 << 20 and path.read_bytes()[:4] == b"kept"


@given(st.text())
def test_toml_string_round_trip(text):
    whole = text.encode("utf-8", "replace").decode()
    assert tomllib.loads(f"a = {files.toml_string(text)}")["a"] == whole


@pytest.mark.parametrize(
    "name", ["", "../validation", "/tmp/x", "a/b", ".", "..", ".hidden", "a\0", "a b", "x" * 81, "é" * 90, "a\n"]
)
def test_a_path_is_refused_as_a_name(tmp_path, name):
    with pytest.raises(InputError, match="--run"):
        run_folder(SceneDir(tmp_path), name)
    assert check_name("first-2.b_é", "--run") == "first-2.b_é"


def test_a_damaged_stage_names_its_file(tmp_path):
    scene = SceneDir(tmp_path)
    folder = scene.stage("mjcf")
    (folder / "assets").mkdir(parents=True)
    (folder / "world.json").write_text("{}")
    (folder / "assets" / "ground.bin").write_bytes(bytes(100))
    with pytest.raises(InputError, match="twin build"):
        require_stage(scene, "mjcf")
    write_stamp(folder, "mjcf")
    assert require_stage(scene, "mjcf") == folder
    for damaged, content in (
        ("assets/ground.bin", bytes(99) + b"\1"),
        ("assets/ground.bin", b""),
        ("world.json", b"[]"),
    ):
        before = (folder / damaged).read_bytes()
        (folder / damaged).write_bytes(content)
        seal_again = (folder / "stamp.json").read_bytes()
        (folder / "stamp.json").write_bytes(seal_again)  # another time: a process looks once at what does not change
        with pytest.raises(InputError, match=f"{damaged} is damaged.*build the scene again"):
            require_stage(scene, "mjcf")
        (folder / damaged).write_bytes(before)
    stamp = (folder / "stamp.json").read_text()
    for changed in (stamp.replace('"mjcf"', '"mjcg"'), stamp[:-30], "[]", "1" * 6000, json.dumps({"stage": 1})):
        (folder / "stamp.json").write_text(changed)
        with pytest.raises(InputError, match=r"stamp\.json"):
            require_stage(scene, "mjcf")
    old = {name: value for name, value in json.loads(stamp).items() if name not in ("sha256", "itself")}
    (folder / "stamp.json").write_text(json.dumps(old))  # as it was written before digests of files
    assert require_stage(scene, "mjcf") == folder
    (folder / "world.json").write_text("[]")
    (folder / "stamp.json").write_text(json.dumps(old, indent=1))
    with pytest.raises(InputError, match="damaged"):
        require_stage(scene, "mjcf")


def test_stages_of_different_builds_are_not_used_together(tmp_path):
    scene = SceneDir(tmp_path)
    results = {}
    for stage, upstream in (("metric", ()), ("field", ("metric",)), ("mesh", ("field",)), ("mjcf", ("mesh",))):
        scene.stage(stage).mkdir(parents=True)
        (scene.stage(stage) / "result.txt").write_text(stage)
        depends = {"upstream": {name: results[name] for name in upstream}}
        results[stage] = write_stamp(scene.stage(stage), stage, depends).result
    require_stage(scene, "mjcf")
    (scene.stage("metric") / "result.txt").write_text("another scale")
    write_stamp(scene.stage("metric"), "metric", {"upstream": {}})  # then the build was interrupted
    assert require_stage(scene, "metric") == scene.stage("metric")
    for stage in ("field", "mesh", "mjcf"):
        with pytest.raises(InputError, match=r"3_field was built from an earlier 2_metric, .*; run twin build"):
            require_stage(scene, stage)


@pytest.mark.parametrize(
    "depends", [[], None, {"upstream": []}, {"upstream": 3}, {"upstream": {"nope": "x"}}, {"upstream": {"mjcf": "x"}}]
)
def test_what_a_foreign_stamp_depends_on_is_no_traceback(tmp_path, depends):
    folder = SceneDir(tmp_path).stage("mjcf")
    folder.mkdir(parents=True)
    stamp = write_stamp(folder, "mjcf")
    replace(stamp, depends=depends).save(folder)
    try:
        require_stage(SceneDir(tmp_path), "mjcf")  # what is unknown, or the stage itself, is passed over
    except InputError as error:
        assert "stamp.json" in str(error) and "build the scene again" in str(error)


@pytest.mark.parametrize("count", ["9223372036854775808", "9" * 5000, "1000001", "-1", "1.5", "٣"])
def test_implausible_counts_of_trials_are_refused(tmp_path, count):
    path = tmp_path / "real.csv"
    path.write_text(f"policy,lighting,trials,successes\nfirst,day,{count},0\n")
    with pytest.raises(InputError, match="line 2: trials") as refused:
        read_results([path], [Cell("first", "straight", "day", 5, 5)])
    assert len(str(refused.value)) < len(str(path)) + 200


def test_bad_tables_are_refused(tmp_path):
    path = tmp_path / "episodes.csv"
    for content in (b"\xff\xfe", b"\0" * 100, b'"' + b"x" * 10**6, b"policy," * 10**5):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"episodes\.csv"):
            read_trials(path)


def test_long_words_and_many_numbers_are_read(tmp_path):
    path = tmp_path / "some.toml"
    path.write_text(f'long = "{"x" * 10**6}"\nparams = [{", ".join(["1.5"] * 500)}]\n')
    assert len(files.read_toml(path)["params"]) == 500
