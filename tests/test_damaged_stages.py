"""Damaged results of stages, with a valid stamp or without: every reader raises an error of one line."""

import json

import numpy as np
import pytest
from tiny_twin import tiny_twin

from twin.assets.ground import Ground
from twin.capture.capture_data import Capture, SourceInfo
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE_FILE, TESTS_FILE, read_test_counts, training_summaries
from twin.geometry.cameras import Cameras, SparsePoints
from twin.mjcf.world import World
from twin.nerf.baked import BakedField


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """`build/` of a small scene, with points and a capture in a folder `more`."""
    folder = tiny_twin(tmp_path_factory.mktemp("scene")) / "build"
    more = folder / "more"
    more.mkdir()
    n = np.zeros(2, np.int64)
    SparsePoints(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.zeros(2), n, n).save(more)
    info = SourceInfo("day", "day", "video", 32, 24, "PINHOLE", (30.0, 30.0, 16.0, 12.0), True, 1.2)
    Capture((info,), ("day/000000", "day/000001"), n, np.arange(2.0), n > 0, np.zeros((2, 3))).save(more)
    return folder


READERS = [
    (Ground, "4_mesh", "ground.npz"),
    (SparsePoints, "more", "points.npz"),
    (Capture, "more", "capture.npz"),
    (Capture, "more", "capture.json"),
    (Cameras, "2_metric", "cameras.npz"),
    (Cameras, "2_metric", "cameras.json"),
    (World, "5_mjcf", "world.json"),
    (BakedField, "3_field", "baked.json"),
    (BakedField, "3_field", "baked.safetensors"),
]


def _refused(reader, folder, name):
    with pytest.raises(InputError, match=name) as caught:
        reader.load(folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1700


def _copied(build, stage, tmp_path):
    for path in (build / stage).iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


@pytest.mark.parametrize(("reader", "stage", "name"), READERS)
def test_truncated_empty_or_missing_files(build, tmp_path, reader, stage, name):
    folder = _copied(build, stage, tmp_path)
    reader.load(folder)  # whole it is read
    data = (folder / name).read_bytes()
    for damaged in (data[: len(data) // 2], b"", b"{}", b"[1, 2]", b"\x00" * 100):
        (folder / name).write_bytes(damaged)
        _refused(reader, folder, name)
    (folder / name).unlink()
    with pytest.raises(InputError):
        reader.load(folder)


@pytest.mark.parametrize(("reader", "stage", "name"), [one for one in READERS if one[2].endswith(".npz")])
def test_arrays_that_are_missing_pickled_or_of_another_shape(build, tmp_path, reader, stage, name):
    folder = _copied(build, stage, tmp_path)
    with np.load(folder / name) as data:
        whole = {key: data[key] for key in data.files}
    for key in whole:
        for other in (whole[key].astype(object), np.zeros((7, 2)), np.array("text"), None):
            arrays = {**whole, key: other}
            np.savez(folder / name, **{k: v for k, v in arrays.items() if v is not None})
            _refused(reader, folder, name)


@pytest.mark.parametrize(
    ("reader", "stage", "name", "key", "value"),
    [
        (World, "5_mjcf", "world.json", "spawn", [1, 2]),
        (World, "5_mjcf", "world.json", "route", [[0, 0, 0]]),
        (World, "5_mjcf", "world.json", "half_width", "wide"),
        (Cameras, "2_metric", "cameras.json", "names", None),
        (Cameras, "2_metric", "cameras.json", "lightings", ["day"]),
        (Capture, "more", "capture.json", "sources", [{}]),
        (BakedField, "3_field", "baked.json", "layout", {}),
        (BakedField, "3_field", "baked.json", "lightings", [1, 2]),
    ],
)
def test_json_values_of_wrong_type(build, tmp_path, reader, stage, name, key, value):
    folder = _copied(build, stage, tmp_path)
    (folder / name).write_text(json.dumps(json.loads((folder / name).read_text()) | {key: value}))
    with pytest.raises(InputError):
        reader.load(folder)


@pytest.mark.parametrize(
    "tests",
    ["{", "{}", "[3]", '[{"step": 1, "successes": 2}]', '[{"step": 1, "successes": 2, "trials": 1}]']
    + [json.dumps([{"step": 1, "successes": 0, "trials": n}]) for n in (0, "many", None, "9" * 400, 1e300, 10**30)],
)
def test_damaged_tests_of_a_training(tmp_path, tests):
    (tmp_path / TESTS_FILE).write_text(tests)
    with pytest.raises(
        InputError, match=r"tests\.json(: no valid JSON| .*; delete it, and the policies are tested again)"
    ):
        read_test_counts(tmp_path)
    (tmp_path / CHOICE_FILE).write_text(f'{{"candidates": {tests}}}')
    with pytest.raises(
        InputError, match=r"choice\.json(: no valid JSON| .*; delete it, and the best policy is selected again)"
    ):
        read_test_counts(tmp_path)


def test_damaged_records_of_a_validation(tmp_path):
    (tmp_path / "validation").mkdir()
    assert training_summaries(tmp_path, ["x" * 300, "a\x00b"]) == {}  # a table may have any name
    for text in ("[]", "{}", '{"policies": 3}', "{"):
        (tmp_path / "validation" / "validated.json").write_text(text)
        with pytest.raises(InputError, match=r"validated\.json"):
            training_summaries(tmp_path, ["a"])
