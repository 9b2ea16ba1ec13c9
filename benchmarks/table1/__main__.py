"""The paper's table 1, on a road whose reality is known.

    python benchmarks/table1 SCENE [--seeds 0] [--jobs 2] [--steps train validate real forecast]

films reality and builds the twin in SCENE (unless that is done), aligns its robot to a drive log of reality's Husky and
to a film by that one's camera, trains the three setups on both tasks, validates every policy in the twin under held-out
lightings, as filmed and with all else drawn anew, drives them in reality under weather that neither has seen, and
forecasts. Every step is a command of `twin`, goes on where it was cut off, and adds to what is there: the same call
with more seeds keeps all runs. `results.json` beside this file holds every run. Setups, sizes, checkpoints: `plan.py`.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from plan import EPISODES, LIGHTINGS, SETUPS, STEPS, TASKS, TRIALS, Run, runs
from results import collect, table

STAGES = ("train", "validate", "real", "forecast")


def verb(*arguments: str | Path) -> None:
    """Runs `python -m twin.…` on one core."""
    command = [sys.executable, "-m", *map(str, arguments)]
    print("+", " ".join(command[2:]), flush=True)
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def build(scene: Path) -> None:
    if not (scene / "scene.toml").exists():
        verb("twin.reality", "film", "--out", scene)
    verb("twin.build", scene)  # what is up to date it leaves alone
    for kind, name, figures in (("log", "drive.csv", "align.json"), ("onboard", "robot.mp4", "camera.json")):
        if not (scene / "alignment" / figures).exists():
            verb("twin.reality", kind, "--out", scene / name)
            verb("twin.align", scene, scene / name)
    verb("twin.build", scene)  # with the robot at hand


def train(scene: Path, run: Run) -> None:
    if not run.finished(scene):
        options = ("--seed", str(run.seed), "--steps", str(STEPS[run.task]), *SETUPS[run.setup], "--quiet")
        verb("twin.train", scene, "--task", TASKS[run.task], "--run", run.name, *options)


def validate(scene: Path, task: str, every: Iterable[Run], jobs: int) -> None:
    mine = [_policies(scene, run) for run in every if run.task == task]
    finals, checkpoints = [final for final, *_ in mine], [path for _, *rest in mine for path in rest]
    for which, policies in (("final", finals), ("checkpoint", checkpoints)):
        if policies:
            options = ("--lightings", *LIGHTINGS[which], "--episodes", str(EPISODES), "--processes", str(jobs))
            verb("twin.validate", scene, "--task", TASKS[task], "--policy", *policies, *options)


def real(scene: Path, run: Run) -> None:
    out = ("--task", TASKS[run.task], "--out", scene / "real" / f"{run.name}.csv")
    verb("twin.reality", "drive", "--policy", *_policies(scene, run), "--trials", str(TRIALS), *out)


def forecast(scene: Path) -> None:
    tables = sorted(path for path in (scene / "real").glob("*_*.csv") if not path.stem.endswith("_trials"))
    lines = [path.read_text(encoding="utf-8").splitlines() for path in tables]
    text = "\n".join([lines[0][0], *(row for table in lines for row in table[1:])]) + "\n"
    (scene / "real" / "results.csv").write_text(text, encoding="utf-8")
    verb("twin.forecast", scene, "--real", scene / "real" / "results.csv")


def _policies(scene: Path, run: Run) -> list[Path]:
    return [run.folder(scene), *run.checkpoints(scene)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--setups", nargs="+", choices=SETUPS, default=list(SETUPS))
    parser.add_argument("--steps", nargs="*", choices=STAGES, default=list(STAGES), help="none: the table alone")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once, one core each")
    given = parser.parse_args()
    asked = runs(given.seeds, given.tasks, given.setups)
    if given.steps:
        build(given.scene)
    with ThreadPoolExecutor(given.jobs) as pool:
        if "train" in given.steps:
            list(pool.map(lambda run: train(given.scene, run), asked))
        done = [run for run in asked if run.finished(given.scene)]
        if "validate" in given.steps:
            for task in given.tasks:
                validate(given.scene, task, done, given.jobs)
        if "real" in given.steps:
            list(pool.map(lambda run: real(given.scene, run), done))
    if "forecast" in given.steps:
        forecast(given.scene)
    folders = [path for path in (given.scene / "runs").glob("*_*_[0-9]*") if path.is_dir()]
    seeds = sorted({int(path.name.rsplit("_", 1)[1]) for path in folders})
    results = collect(given.scene, runs(seeds, list(TASKS), list(SETUPS)))
    out = Path(__file__).with_name("results.json")
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(table(results))
    for task, group in results["forecast"].items():
        print(task, json.dumps(group))


if __name__ == "__main__":
    main()
