"""Trainings as runs of Weights & Biases: by a stand-in for its package, and by the package itself, offline."""

import csv
import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from films import video_info
from stable_baselines3.common.logger import Logger
from test_training import SHORT
from tiny_twin import tiny_twin

import twin
from twin import commands, runtime
from twin.files import read_json
from twin.learn import selection
from twin.learn.training import prepare_folder
from twin.learn.training import train as train_run
from twin.learn.wandb_run import wandb_run

STAND_IN = """
import json
from pathlib import Path

class Error(Exception):
    pass

class Media:
    def __init__(self, path, caption=None, format=None):
        self.path, self.caption, self.size = path, caption, Path(path).stat().st_size

Image = Video = Media
runs = []

def Settings(**settings):
    return settings

class Run:
    def __init__(self, given):
        self.given, self.id, self.rows, self.metrics, self.code = given, given["id"] or f"id{len(runs)}", [], {}, None

    def define_metric(self, name, step_metric=None):
        self.metrics[name] = step_metric

    def log(self, values):
        json.dumps({k: v for k, v in values.items() if not isinstance(v, Media)})
        self.rows.append(values)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.code = 0 if kind is None else 1

def init(**given):
    if given["project"] == "nobody":
        raise Error("No API key configured.\\nUse `wandb login`")
    runs.append(Run(given))
    return runs[-1]
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return tiny_twin(tmp_path_factory.mktemp("twin"))


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    (tmp_path / "wandb.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    import wandb

    # Two episodes in each test, as nothing here depends on their number.
    for name, value in (("_BATCHES", (2,)), ("_TEST_EPISODES", 2), ("_ROUNDS", ((1, 2),)), ("FRESH_EPISODES", 2)):
        monkeypatch.setattr(selection, name, value)
    yield wandb
    sys.modules.pop("wandb")


def trained(scene: Path, name: str, steps: int, *options: str) -> int:
    common = ["--task", "ahead", "--lighting", "day", "--worlds", "2", "--processes", "1", "--quiet"]
    common += ["--teacher-steps", "8"]
    return commands.main("train", [str(scene), *common, "--run", name, "--steps", str(steps), *options])


def test_a_run_gets_the_tests_and_a_film_and_continues(scene, stand_in):
    assert trained(scene, "logged", 8, "--wandb", "team/roads") == 0
    folder, (run,) = scene / "runs" / "logged", stand_in.runs
    assert (run.given["entity"], run.given["project"], run.given["name"]) == ("team", "roads", "logged")
    assert run.given["config"]["task"] == "ahead" and run.metrics == {"step": None, "*": "step"} and run.code == 0
    (last,) = read_json(folder / "choice.json")["candidates"]
    (test,) = [row for row in run.rows if "tests/success" in row]
    assert test == {
        "tests/success": last["successes"] / last["trials"],
        "tests/progress": last["progress"],
        "tests/reward": last["reward"],
        "step": 8,
    }
    shown = run.rows[-1]
    assert shown["step"] == 8 and shown["success"].size > 1000
    assert shown["film"].path == str(folder / "drive.mp4") and shown["film"].caption.startswith("step 8, day: ")
    assert video_info(folder / "drive.mp4")["frames"] > 1

    assert trained(scene, "logged", 8, "--wandb", "team/roads") == 0
    assert len(stand_in.runs) == 1, "a training that has ended logs nothing"
    for project, known in (("team/roads", run.id), ("other", None)):
        with wandb_run(project, folder, {}):
            assert (stand_in.runs[-1].given["id"], stand_in.runs[-1].given["resume"]) == (known, "allow")
    assert stand_in.runs[-1].given["entity"] is None


def test_a_run_gets_the_numbers_of_the_tables(scene, tmp_path, stand_in):
    prepare_folder(tmp_path / "run")
    with wandb_run("roads", tmp_path / "run", {}) as writer:
        train_run(twin.load_scene(scene), tmp_path / "run", replace(SHORT, steps=160), processes=1, writers=[writer])
    assert stand_in.runs[0].given["name"] == "run"
    logged = stand_in.runs[0].rows
    for table, columns in (("episodes", ("success", "progress_m", "reward")), ("log", ("steps_per_s", "updates"))):
        rows = list(csv.DictReader((tmp_path / "run" / f"{table}.csv").open(newline="")))
        whole = [row for row in rows if float(row.get("start_m", 0.0)) == 0.0]  # the others are cut off
        assert whole and (len(whole) < len(rows)) == (table == "episodes")
        for column in columns:
            found = [(row["step"], row[f"{table}/{column}"]) for row in logged if f"{table}/{column}" in row]
            np.testing.assert_array_equal(found, [(int(row["step"]), float(row[column])) for row in whole])
    assert not [name for row in logged for name in row if name.endswith(("cause", "lighting", "seed"))]


def test_curves_of_the_learner_are_logged_and_a_failure_marks_the_run(tmp_path, stand_in):
    with pytest.raises(KeyError), wandb_run("roads", tmp_path, {}) as run:
        logger = Logger(None, [run])
        logger.record("train/critic_loss", np.float32(0.5))
        logger.record("train/note", "text")
        logger.record("time/secret", 1, exclude="wandb")
        logger.dump(40)
        raise KeyError
    assert stand_in.runs[0].rows == [{"train/critic_loss": 0.5, "step": 40}] and stand_in.runs[0].code == 1


def test_without_package_or_login_one_line_says_what_to_do(scene, stand_in, monkeypatch, capsys):
    assert trained(scene, "refused", 8, "--wandb", "nobody") == 2
    said = capsys.readouterr().err
    assert (
        said.startswith("error: --wandb nobody: No API key configured. Use `wandb login`; ") and said.count("\n") == 1
    )
    assert "WANDB_MODE=offline" in said
    with monkeypatch.context() as patch:  # undone before `stand_in` ends, which removes its module
        patch.setitem(sys.modules, "wandb", None)
        assert trained(scene, "refused", 8, "--wandb", "roads") == 2
    assert capsys.readouterr().err == "error: --wandb needs the package wandb: pip install 'twin[wandb]'\n"


@pytest.mark.slow
def test_the_package_writes_the_run_offline(scene):
    if importlib.util.find_spec("wandb") is None:
        pytest.skip("wandb is not installed")
    options = ["--task", "ahead", "--lighting", "day", "--worlds", "2", "--steps", "80", "--run", "offline", "--quiet"]
    options += ["--teacher-steps", "8"]
    command = [sys.executable, "-m", "twin.train", str(scene), *options, "--wandb", "roads"]
    done = subprocess.run(command, env={**os.environ, "WANDB_MODE": "offline"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    folder = scene / "runs" / "offline"
    (run,) = (folder / "wandb").glob("offline-run-*")
    assert run.name.endswith(read_json(folder / "wandb.json")["id"])
    assert list(run.glob("*.wandb")) and len(list(run.glob("files/media/videos/film_*.mp4"))) == 1
    assert len(list(run.glob("files/media/images/success_*.png"))) == 1
