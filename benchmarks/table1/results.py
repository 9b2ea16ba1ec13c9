"""Collects `results.json`, the record of every run, and formats it like table 1 of the paper (see `plan.py`)."""

import csv
from pathlib import Path
from typing import Any

from plan import PAPER, PHOTOS, SETUPS, TASKS, Run
from scores import counts, over_days

from twin.config import HELD_OUT, Condition
from twin.evaluation.statistics import wilson
from twin.evaluation.training_curves import CHOICE_FILE
from twin.evaluation.trials import Trial, read_trials
from twin.files import read_json

_EVALUATIONS = ("validate", "validate_randomised", "validate_by_photo", "real")
_BY_DAY = ("validate_by_photo", "real")


def collect(scene: Path, every: list[Run]) -> dict[str, Any]:
    """The content of `results.json`."""
    twin = _trials([scene / "validation" / "episodes.csv"])
    real = _trials(sorted((scene / "real").glob("*_trials.csv")))
    rows = []
    for run in (run for run in every if (run.folder(scene) / "policy.json").exists()):
        policies = [run.name, *(f"{run.name}/{path.name}" for path in run.checkpoints(scene))]
        rows.append(
            {"setup": run.setup, "task": TASKS[run.task], "seed": run.seed, "finished": run.finished(scene)}
            | _training(run.folder(scene))
            | {"policies": [_evaluations(name, twin, real) for name in policies]}
        )
    return {"runs": rows}


def table(results: dict[str, Any]) -> str:
    """Table 1 of the paper beside its replication, in Markdown, from the finished policies of all seeds.

    Rates by photo and on the road are means over days, with intervals over days.
    """
    columns = "train / validate / (ours: all randomized / by a photo of each day) / real"
    lines = [f"| | | straight: {columns} | right turn: {columns} |", "|---|---|---|---|"]
    for setup in SETUPS:
        lines.append(f"| paper | {setup} | " + " | ".join(_numbers(PAPER[setup, task]) for task in TASKS) + " |")
        ours = []
        for task in TASKS:
            some = [r for r in results["runs"] if r["finished"] and (r["setup"], r["task"]) == (setup, TASKS[task])]
            parts = {"train": [r["train"] for r in some]}
            parts |= {k: [r["policies"][0][k] for r in some] for k in _EVALUATIONS}
            cells = [
                over_days([counts(one) for one in part]) if name in _BY_DAY else _pooled(part)
                for name, part in parts.items()
            ]
            ours.append(" / ".join(cells) + f" ({len(some)} runs)")
        lines.append(f"| ours | {setup} | " + " | ".join(ours) + " |")
    return "\n".join(lines)


def _numbers(rates: tuple[float, ...]) -> str:
    return " / ".join(f"{rate:.2f}" for rate in rates)


def _pooled(parts: list[dict[str, Any]]) -> str:
    trials, won = sum(p["trials"] for p in parts), sum(p["successes"] for p in parts)
    if not trials:
        return "–"
    low, high = wilson(won, trials)
    return f"{won / trials:.2f} [{low:.2f}, {high:.2f}], {won}/{trials}"


def _training(folder: Path) -> dict[str, Any]:
    with (folder / "log.csv").open(newline="", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    choice = read_json(folder / CHOICE_FILE) if (folder / CHOICE_FILE).exists() else None
    # The test that chose the policy, in the training's lighting, so it is biased upwards; `choice["chosen"]` is the
    # final test, under held-out lightings.
    tests = {one["step"]: one for one in choice["candidates"]} if choice else {}
    return {
        "steps": int(last["step"]),
        "updates": int(last["updates"]),
        "wall_s": float(last["wall_s"]),
        "memory_mb": float(last["memory_mb"]),
        "train": tests[choice["chosen"]["step"]] if choice else _rate([]),
    }


def _evaluations(name: str, twin: list[Trial], real: list[Trial]) -> dict[str, Any]:
    out: dict[str, Any] = {"policy": name}
    parts = [
        [t for t in twin if t.lighting == HELD_OUT],
        [t for t in twin if t.lighting == str(Condition(HELD_OUT, True))],
    ]
    photos = [trial for trial in twin if trial.lighting in PHOTOS]
    for where, trials in zip(_EVALUATIONS, (*parts, photos, real), strict=True):
        mine = [trial for trial in trials if trial.policy == name]
        out[where] = _rate([trial.success for trial in mine]) | {
            "by_lighting": {
                light: _rate([t.success for t in mine if t.lighting == light])
                for light in dict.fromkeys(t.lighting for t in mine)
            },
            "causes": {
                cause: sum(t.cause == cause for t in mine) for cause in dict.fromkeys(sorted(t.cause for t in mine))
            },
        }
    return out


def _rate(successes: list[bool]) -> dict[str, Any]:
    return {"successes": sum(successes), "trials": len(successes)}


def _trials(paths: list[Path]) -> list[Trial]:
    return [trial for path in paths if path.exists() for trial in read_trials(path)]
