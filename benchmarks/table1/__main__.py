"""Replication of table 1 of DriveEnv-NeRF (arXiv 2403.15791) in the simulated reality (`twin reality`).

    python benchmarks/table1 SCENE [--seeds 0 1] [--jobs 2] [--steps train validate photos real]

Steps, each a command of `twin` that resumes where it was interrupted:

- build: films the simulated road and builds the twin in SCENE; aligns the robot to a drive log and an onboard film.
- train: trains the three setups on both tasks.
- validate: drives every policy in the twin under held-out lightings with everything else randomized, and finished
  policies also with nothing else randomized.
- photos: drives every policy in the twin under a lighting from one photo of each test day.
- real: drives every policy in the simulated reality under weather that was not filmed.

The defaults are the published plan; the same call with more seeds adds runs. `results.json` beside this file records
every run. If the new record has fewer runs, policies, days or trials, this file is kept, the new record is written to
`results.json.partial`, and the command ends with status 2. `--results` gives another file for the record. `plan.py`
defines setups, sizes and checkpoints. After all steps the command prints the tables of `scores.py` and the paper's
table. `scores.py` itself needs only `results.json`.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from plan import EPISODES, LIGHTINGS, PHOTO_EPISODES, PHOTOS, SETUPS, STEPS, TASKS, TRIALS, Run, runs
from results import collect, table
from scores import RESULTS, tables

import twin
from twin.reality.lighting import WEATHER

sys.path.append(str(Path(__file__).parents[1]))
from record import save

STAGES = ("train", "validate", "photos", "real")


def verb(*arguments: str | Path) -> None:
    """Runs `python -m twin.…` on one core."""
    command = [sys.executable, "-m", *map(str, arguments)]
    print("+", " ".join(command[2:]), flush=True)
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def build(scene: Path) -> None:
    if not (scene / "scene.toml").exists():
        verb("twin.reality", "film", "--out", scene)
    verb("twin.build", scene)  # skips stages that are up to date
    for kind, name, figures in (("log", "drive.csv", "align.json"), ("onboard", "robot.mp4", "camera.json")):
        if not (scene / "alignment" / figures).exists():
            verb("twin.reality", kind, "--out", scene / name)
            verb("twin.align", scene, scene / name)
    verb("twin.build", scene)  # with the aligned robot


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


def photos(scene: Path, task: str, every: Iterable[Run], jobs: int) -> None:
    """Validates under lightings from one photo of each test day."""
    for name in WEATHER:
        if name not in twin.load_scene(scene).field().lightings:
            photo = scene / "photos" / f"{name}.png"
            verb("twin.reality", "photo", "--lighting", name, "--out", photo)
            verb("twin.relight", scene, photo, "--name", name)
    policies = [path for run in every if run.task == task for path in _policies(scene, run)]
    if policies:
        options = ("--lightings", *PHOTOS, "--episodes", str(PHOTO_EPISODES), "--processes", str(jobs))
        verb("twin.validate", scene, "--task", TASKS[task], "--policy", *policies, *options)


def real(scene: Path, run: Run) -> None:
    out = ("--task", TASKS[run.task], "--out", scene / "real" / f"{run.name}.csv")
    verb("twin.reality", "drive", "--policy", *_policies(scene, run), "--trials", str(TRIALS), *out)


def _policies(scene: Path, run: Run) -> list[Path]:
    return [run.folder(scene), *run.checkpoints(scene)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--setups", nargs="+", choices=SETUPS, default=list(SETUPS))
    parser.add_argument(
        "--steps", nargs="*", choices=STAGES, default=list(STAGES), help="no names: only save and print results"
    )
    parser.add_argument("--jobs", type=int, default=2, help="number of runs in parallel, each on one core")
    parser.add_argument("--results", type=Path, default=RESULTS, help="the record (default: the one beside this file)")
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
        if "photos" in given.steps:
            for task in given.tasks:
                photos(given.scene, task, done, given.jobs)
        if "real" in given.steps:
            list(pool.map(lambda run: real(given.scene, run), done))
    folders = [path for path in (given.scene / "runs").glob("*_*_[0-9]*") if path.is_dir()]
    seeds = sorted({int(path.name.rsplit("_", 1)[1]) for path in folders})
    results = collect(given.scene, runs(seeds, list(TASKS), list(SETUPS)))
    status = save(given.results, results, replace=None)
    if status:
        return status
    print(tables(results))
    print(f"\nThe paper's table, over all {len(WEATHER)} weathers\n\n{table(results)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
