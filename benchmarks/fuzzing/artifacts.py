"""Fuzz targets of files that twin writes: lightings, build stages, forecasts, metadata of runs and validations."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing.cases import Case
from fuzzing.values import corrupted, json_text, mutated, mutated_json, mutated_text

STAGES = {"2_metric": "metric", "3_field": "field", "4_mesh": "mesh", "5_mjcf": "mjcf"}
"""Folder of each stage → its name."""


def lighting(case: Case) -> None:
    """A mutated file of a lighting that was added from a photo."""
    import twin
    from twin.scene import stage_result

    root = case.folder / "scene"
    (root / "lightings").mkdir(parents=True)
    shutil.copyfile(case.samples.twin / "scene.toml", root / "scene.toml")
    (root / "build").symlink_to(case.samples.twin / "build")
    scene = twin.load_scene(root).scene
    table = {"format": 2, "name": "dusk", "embedding": [0.1, 0.2, 0.3, 0.4], "field": stage_result(scene, "field")}
    table |= {"air": {"extinction": 0.01, "airlight": [0.5, 0.5, 0.5]}, "photo": "a.jpg", "figures": {"psnr": 20.0}}
    data = mutated_json(case.rng, table)
    name = case.rng.choice(("dusk", "dusk", "day", "training", "a b", "a:b", "+randomised"))
    (root / "lightings" / f"{name}.json").write_bytes(data)
    twin.load_scene(root).field()


def stage_files(case: Case) -> None:
    """A built scene with one corrupted file, in most cases with a stamp that matches the corrupted file."""
    import twin
    from twin.assets.ground import Ground
    from twin.scene import require_stage

    root = case.folder / "scene"
    stage = _copy_with_corrupted_stage(case.rng, root, case.samples.twin, sealed=case.rng.random() < 0.6)
    scene = twin.load_scene(root)
    if stage == "metric":
        scene.cameras()
    elif stage == "field":
        scene.field()
    elif stage == "mjcf":
        scene.world()
    else:
        Ground.load(require_stage(scene.scene, "mesh"))


def _copy_with_corrupted_stage(rng: Random, root: Path, good: Path, sealed: bool) -> str:
    """Copies a built scene to `root` and corrupts one file of one stage; the other stages are links.

    Args:
        sealed: True writes a stamp that matches the corrupted file.

    Returns:
        Name of the corrupted stage.
    """
    from twin.scene import write_stamp

    (root / "build").mkdir(parents=True)
    shutil.copyfile(good / "scene.toml", root / "scene.toml")
    chosen = rng.choice(tuple(STAGES))
    for name in STAGES:
        if name == chosen:
            shutil.copytree(good / "build" / name, root / "build" / name)
        else:
            (root / "build" / name).symlink_to(good / "build" / name)
    folder = root / "build" / chosen
    path = rng.choice(sorted(p for p in folder.rglob("*") if p.is_file() and (p.name != "stamp.json" or not sealed)))
    if path.suffix == ".json" and rng.random() < 0.7:
        path.write_bytes(mutated_json(rng, json.loads(path.read_text())))
    elif path.suffix == ".npz" and rng.random() < 0.5:
        _mutate_npz(rng, path)
    else:
        path.write_bytes(corrupted(rng, path.read_bytes()))
    if rng.random() < 0.05:
        path.unlink()
    if sealed:
        write_stamp(folder, STAGES[chosen])
    return STAGES[chosen]


def _mutate_npz(rng: Random, path: Path) -> None:
    """Removes, renames or empties one array, or changes its shape, dtype or values."""
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    what = rng.randrange(6)
    if what == 0:
        del arrays[name]
    elif what == 1:
        arrays[name] = array[:1] if array.ndim else np.zeros((2, 2))
    elif what == 2:
        arrays[name] = array.astype(rng.choice(("U8", "f4", "i8", "c16", "?", "O")))  # type: ignore[arg-type]
    elif what == 3:
        arrays[name] = np.full(array.shape, rng.choice((np.nan, np.inf, -1.0, 1e308)))
    elif what == 4:
        arrays[name + "_more"] = arrays.pop(name)
    else:
        arrays[name] = np.zeros((0, *array.shape[1:]))
    np.savez(path, **arrays)  # type: ignore[arg-type]


def stage_parts(case: Case) -> None:
    """A corrupted file of sparse points, of a capture or of cameras, without a stamp."""
    from twin.capture.capture_data import Capture, SourceInfo
    from twin.geometry.cameras import Cameras, SparsePoints

    rng, folder = case.rng, case.folder / "stage"
    folder.mkdir()
    which = rng.randrange(3)
    if which == 0:
        n = np.zeros(4, np.int64)
        SparsePoints(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.zeros(2), n, n).save(folder)
        load: Callable[[Path], Any] = SparsePoints.load
    elif which == 1:
        info = SourceInfo("day", "day", "video", 32, 24, "PINHOLE", (30.0, 30.0, 16.0, 12.0), True, 1.2)
        n = np.zeros(2, np.int64)
        Capture((info,), ("day/000000", "day/000001"), n, np.arange(2.0), n > 0, np.full((2, 3), np.nan)).save(folder)
        load = Capture.load
    else:
        for name in ("cameras.json", "cameras.npz"):
            shutil.copyfile(case.samples.twin / "build" / "2_metric" / name, folder / name)
        load = Cameras.load
    path = rng.choice(sorted(folder.iterdir()))
    if path.suffix == ".json":
        path.write_bytes(mutated_json(rng, json.loads(path.read_text())))
    elif rng.random() < 0.5:
        _mutate_npz(rng, path)
    else:
        path.write_bytes(corrupted(rng, path.read_bytes()))
    load(folder)


def forecast(case: Case) -> None:
    from twin.evaluation.forecasting import Forecast

    (case.folder / "forecast.json").write_bytes(mutated_json(case.rng, case.samples.forecast))
    Forecast.load(case.folder)


def run_metadata(case: Case) -> None:
    """JSON files of runs and validations: summaries of trainings, configs, checkpoints, choices."""
    from twin.evaluation.training_curves import CHOICE_FILE, write_success_curve
    from twin.learn import distillation, selection, training

    rng, root = case.rng, case.folder / "scene"
    which = rng.random()
    if which < 0.4:
        _training_summary(case, root)
    elif which < 0.6:
        root.mkdir()
        config = {"road": "x", "steps": 100, "seed": 0, "task": "ahead"}
        (root / "config.json").write_bytes(mutated_json(rng, config))
        training.check_same(root, config)
    elif which < 0.9:
        (root / "state").mkdir(parents=True)
        names = [name for name in vars(distillation).values() if isinstance(name, str) and name.endswith(".json")]
        for name in names:
            state = {"steps": 100, "updates": 50, "resumed": 0}
            (root / "state" / name).write_bytes(mutated_json(rng, state))
        distillation.saved_steps(root / "state")
    else:
        (root / "state").mkdir(parents=True)
        (root / "state" / "state.json").write_text('{"steps": 200}')
        failure = {"cause": "stuck", "progress": 3.0, "lighting": "training: sun 1.00"}
        one = {"step": 100, "trials": 8, "successes": 4, "progress": 9.0, "reward": 1.0, "failures": [failure]}
        ends = {"most": 300, "success": 0.95, "reached": False, "why": "steps", "failures": ""}
        choice = {"steps": 200, "candidates": [one, one | {"step": 150}], "chosen": one | {"trials": 20}, **ends}
        (root / CHOICE_FILE).write_bytes(mutated_json(rng, choice))
        (root / selection.TESTS_FILE).write_bytes(mutated_json(rng, [one]))
        selection.read_choice(root)
        selection.read_tests(root)
        write_success_curve(root)


def _training_summary(case: Case, root: Path) -> None:
    from twin.evaluation.training_curves import training_summaries
    from twin.scene import digest_file

    rng = case.rng
    shutil.copytree(case.samples.twin / "runs" / "ahead", root / "runs" / "ahead")
    head = root / "runs" / "ahead" / "policy.json"
    table = json.loads(head.read_text())
    if rng.random() < 0.5:
        table["trained"] = mutated(rng, table["trained"])
    head.write_bytes(json_text(table).encode("utf-8", "surrogatepass"))
    validated: dict[str, Any] = {"roads": {"ahead, day": "x"}, "policies": {"ahead": digest_file(head)}}
    tests = [{"step": step, "trials": 20, "successes": 9} for step in (100, 200)]
    (root / "runs" / "ahead" / "tests.json").write_bytes(mutated_json(rng, tests))
    (root / "validation").mkdir()
    text = json_text(mutated(rng, validated) if rng.random() < 0.5 else validated)
    (root / "validation" / "validated.json").write_bytes(mutated_text(rng, text))
    training_summaries(root, ["ahead", "left", "ahead/100", rng.choice(("", "..", "/", "a" * 300, "../ahead"))])
