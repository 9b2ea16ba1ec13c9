"""Trains the default policy on ten sampled stretches of road, and drives each policy in 100 fresh episodes.

    python benchmarks/stretches.py WORK [--stretches 1 2] [--json FILE]

Stretch k is part of the route of sampled place 70 + k, which is filmed under its own lightings and built with the
default settings. Its length is uniform between 30 and 60 m (or that of the route, if this is shorter), and its start
uniform along the rest of the route; both are determined by k. The training is `twin train` without options but the
seed, 70 + k. The fresh episodes are those of `twin validate` under held-out lightings, all randomized; no decision uses
them. A stretch that cannot be filmed, built or trained counts as 0 of 100.

These constants were committed before the first result; a later version of the training gets other places. WORK needs
3 GB a place. An interrupted stretch continues, and recorded ones are not run again. A stretch takes 25 to 45 minutes.
"""

import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from record import record_parser, save

from twin.config import HELD_OUT, Condition
from twin.evaluation.statistics import wilson
from twin.evaluation.training_curves import CHOICE_FILE
from twin.evaluation.trials import read_trials
from twin.files import read_json
from twin.loading import load_scene

FIRST = 70  # stretch k is at place 70 + k
STRETCHES = tuple(range(1, 11))
LENGTHS = (30.0, 60.0)  # [m]
EPISODES = 100
RUN = TASK = "stretch"


class Failed(Exception):
    """A command of twin ended with exit status 2."""


def twin(*command: object) -> None:
    """Runs a command of twin, which shows its progress. Raises Failed: bad input; SystemExit: a signal or a bug."""
    print("+ twin", *command, flush=True)
    status = subprocess.run([sys.executable, "-m", "twin", *map(str, command)], check=False).returncode
    if status == 2:
        raise Failed(f"twin {command[0]} ended with exit status 2")
    if status:
        raise SystemExit(abs(status))


def segment(stretch: int, route: float) -> tuple[float, float]:
    """Start and length [m] of a stretch on a route of this length [m]."""
    part, where = np.random.default_rng([FIRST, stretch]).random(2)
    length = min(LENGTHS[0] + part * (LENGTHS[1] - LENGTHS[0]), route)
    return round(float(where * (route - length)), 1), float(np.floor(length * 10) / 10)


def measure(stretch: int, work: Path) -> dict[str, Any]:
    """The row of a stretch. Raises Failed: a command failed."""
    place = FIRST + stretch
    scene = work / f"place_{place}"
    if not (scene / "scene.toml").exists():
        twin("reality", "film", "--place", place, "--out", scene)
    twin("build", scene)
    start, length = segment(stretch, load_scene(scene).world().length)
    config = scene / "scene.toml"
    if f'name = "{TASK}"' not in config.read_text():
        with config.open("a") as file:
            file.write(f'\n[[task]]\nname = "{TASK}"\nstart = {start}\nlength = {length}\n')
        twin("build", scene)
    # A training that was interrupted has no duration.
    fresh = not (scene / "runs" / RUN).exists()
    began, cpu = time.monotonic(), _children()
    twin("train", scene, "--task", TASK, "--run", RUN, "--seed", place)
    minutes, cpu_minutes = (time.monotonic() - began) / 60, (_children() - cpu) / 60
    light = str(Condition(HELD_OUT, True))
    twin("validate", scene, *("--task", TASK, "--policy", RUN, "--lightings", light, "--episodes", EPISODES))
    choice = read_json(scene / "runs" / RUN / CHOICE_FILE)
    driven = [one for one in read_trials(scene / "validation" / "episodes.csv") if one.lighting == light]
    lost = [one for one in driven if not one.success]
    return {
        "start_m": start,
        "length_m": length,
        "minutes": round(minutes, 1) if fresh else None,
        "cpu_minutes": round(cpu_minutes, 1) if fresh else None,
        "steps": choice["steps"],
        "ended": choice["why"],
        "final_test": {name: choice["chosen"][name] for name in ("step", "successes", "trials")},
        "successes": len(driven) - len(lost),
        "trials": len(driven),
        "failures": [{"cause": one.cause, "progress_m": round(one.progress, 1)} for one in lost],
    }


def _children() -> float:
    """CPU time [s] of all ended child processes and their descendants."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def summary(rows: list[dict[str, Any]]) -> str:
    """A table of the recorded stretches, and their success together."""
    lines = ["| place | length | duration; CPU | steps | final test | fresh episodes |", "|---|---|---|---|---|---|"]
    for row in rows:
        if "error" in row:
            lines.append(f"| {row['name']} | | | | | 0 of {EPISODES}: {row['error']} |")
            continue
        final = row["final_test"]
        times = f"{row['minutes']}; {row['cpu_minutes']} min" if row["minutes"] else "interrupted"
        steps = f"{row['steps']:,}, kept {final['step']:,} ({row['ended']})"
        tests = f"{final['successes']} of {final['trials']} | {row['successes']} of {row['trials']}"
        lines.append(f"| {row['name']} | {row['length_m']} m | {times} | {steps} | {tests} |")
    won, driven = sum(row["successes"] for row in rows), sum(row["trials"] for row in rows)
    low, high = (float(x) for x in wilson(won, driven))
    durations = [row["minutes"] for row in rows if row.get("minutes")]
    median = f"; median {np.median(durations):.1f} min" if durations else ""
    lines.append(f"\n{won} of {driven} ({low:.2f} to {high:.2f}, episodes as the unit){median}")
    return "\n".join(lines)


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("work", type=Path, help="folder for the scenes")
    parser.add_argument(
        "--stretches", type=int, nargs="+", choices=STRETCHES, default=STRETCHES, metavar="K", help="1 to 10"
    )
    given = parser.parse_args()
    rows = read_json(given.json)["stretches"] if given.json and given.json.exists() else []
    for stretch in given.stretches:
        name = f"place_{FIRST + stretch}"
        if name in {row["name"] for row in rows}:
            continue
        try:
            row = measure(stretch, given.work)
        except Failed as error:
            row = {"error": str(error), "successes": 0, "trials": EPISODES}
        rows.append({"name": name, **row})
        rows.sort(key=lambda row: row["name"])
        if status := save(given.json, {"stretches": rows}, given.replace_record):
            return status
    if rows:
        print(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
