"""A second renderer for the reality: Blender's Cycles renders trials of the forecast experiment, or films of a place.

    python benchmarks/cycles trials WORK --places 100 [--share 0.1] [--minutes 60]   repeats recorded trials
    python benchmarks/cycles trials WORK --tables                                    only compares what is recorded
    python benchmarks/cycles film --place 7 --out DIR                                films a place, as twin.reality film

`trials` repeats trials of `benchmarks/forecast` at the places in WORK: policy, day, start, robot, camera effects and
judge are the same, but Cycles renders the pictures. The place's number draws a random tenth of its trials. The results
are in `trials_cycles.csv.gz` beside the place's `trials.csv.gz`. After an interruption, the same command continues.

`--python` names the interpreter of an environment with `bpy` (`pip install bpy==5.0.1`, Python 3.11), which needs
numpy 1 and therefore cannot be installed beside `twin`.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from cycles_renderer import SAMPLES, CyclesRenderer

from twin.errors import InputError, print_error
from twin.evaluation.statistics import UndefinedStatistic, spearman, wilson
from twin.evaluation.trials import Trial, read_trials
from twin.reality.__main__ import film, scene_task
from twin.reality.filming import FilmingPlan
from twin.reality.lighting import weather
from twin.reality.place_sampling import sample_place
from twin.reality.real_test import RealTest, Setup, load_policy_file, task_for
from twin.reality.road_task import place_on_test_day

sys.path.append(str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).parents[1] / "forecast"))
from place_record import TRIALS, freeze, keep, read_place
from protocol import PROTOCOL, Protocol, read_protocol
from record import add_record_options, save

RESULTS = Path(__file__).parents[1] / "forecast" / "results"
REPEATED = "trials_cycles.csv.gz"
_DRAW = 91  # random stream of the draw of trials


def drawn(trials: list[Trial], share: float, place: int) -> list[Trial]:
    """A random share of trials, in the order of policy, day and seed; the same for the same place and trials."""
    ordered = sorted(trials, key=_key)
    count = round(share * len(ordered))
    chosen = np.random.default_rng([_DRAW, place]).permutation(len(ordered))[:count]
    return [ordered[k] for k in sorted(chosen.tolist())]


def _key(trial: Trial) -> tuple[str, str, int]:
    return trial.policy, trial.lighting, trial.seed


@dataclass(frozen=True)
class Agreement:
    """Verdicts of both renderers on the same trials."""

    place: int
    trials: int
    agree: int
    """Trials with the same verdict: success or failure."""
    own: int
    """Successes with the pictures of the own renderer."""
    cycles: int
    """Successes with the pictures of Cycles."""
    spearman: float | None
    """Rank correlation of the policies' success rates over these trials; None if all rates of a renderer are equal."""


def compare(place: int, own: list[Trial], repeated: list[Trial]) -> Agreement:
    """Compares repeated trials with the recorded ones of the same policy, day and seed."""
    before = {_key(one): one.success for one in own}
    pairs = [(before[_key(one)], one.success) for one in repeated]
    rates = {
        policy: np.mean([(before[_key(one)], one.success) for one in repeated if one.policy == policy], axis=0)
        for policy in {one.policy for one in repeated}
    }
    try:
        table = np.array(list(rates.values())).reshape(-1, 2)
        rank = spearman(twin=table[:, 0], real=table[:, 1])
    except UndefinedStatistic:
        rank = None
    first, second = (sum(pair[k] for pair in pairs) for k in (0, 1))
    return Agreement(place, len(pairs), sum(a == b for a, b in pairs), first, second, rank)


class Repetition:
    """Repeats trials at one place with the pictures of Cycles."""

    def __init__(self, scene: Path, place: int, task: str, python: Path, samples: int) -> None:
        """
        Args:
            scene: The place's scene of the forecast experiment, with its policies and its task file.
            place: Number of place, robot and camera.
            python: Interpreter that can import `bpy`.
            samples: Paths per pixel.
        """
        self.scene, self.place, self.python, self.samples = scene, place, python, samples
        self.task = scene_task(str(scene / f"{task}.json"), scene, place)
        self.setup = Setup(place, place, place)

    def one_day(self, day: str, trials: list[Trial], end: float, keep_trial: Callable[[Trial], None]) -> None:
        """Repeats the trials of one day, until a time of `time.monotonic` [s]; each one is kept as it ends."""
        renderers: list[CyclesRenderer] = []

        def renderer_of(lighting: str, intrinsics: tuple[float, ...], size: tuple[int, int], number: int) -> Any:
            if not renderers:
                there = place_on_test_day(number)
                light = weather(lighting)
                renderers.append(CyclesRenderer(self.python, light, there, np.array(intrinsics), size, self.samples))
            return renderers[0]

        try:
            for one in trials:
                if time.monotonic() > end:
                    break
                policy = load_policy_file(self.scene / "runs" / one.policy)
                test = RealTest(task_for(policy, self.task, self.place), self.setup, policy.size, renderer_of)
                keep_trial(test.run_trial(policy, day, one.seed))
        finally:
            for renderer in renderers:
                renderer.close()


def _repeat(protocol: Protocol, given: argparse.Namespace) -> None:
    """Repeats the drawn trials that are not yet recorded, a day at a time, `--jobs` days at once."""
    end = time.monotonic() + 60.0 * min(given.minutes, 1e6)
    for place in given.places or protocol.places:
        protocol.check_has(place)
        record = given.results / protocol.name / f"place_{place}"
        if read_place(record, place, protocol) is None:  # a draw from a part of the trials would be another one
            raise InputError(f"{record} is not complete; first run benchmarks/forecast at place {place} to its end")
        scene = given.work / protocol.name / f"place_{place}"
        freeze(record, {setup: scene / "runs" / setup for setup in protocol.setups})  # the policies that were recorded
        chosen = drawn(read_trials(record / TRIALS), given.share, place)
        done = read_trials(record / REPEATED) if (record / REPEATED).exists() else []
        known = {_key(one) for one in done}
        place_on_test_day(place)  # fills its cache before threads ask for it
        run = Repetition(scene, place, protocol.task, given.python, given.samples)
        days: dict[str, list[Trial]] = {}
        for one in chosen:
            if _key(one) not in known:
                days.setdefault(one.lighting, []).append(one)
        lock = threading.Lock()

        def keep_trial(trial: Trial, record: Path = record, done: list[Trial] = done, lock: Any = lock) -> None:
            with lock:
                done.append(trial)
                keep(record / REPEATED, done)
                print(*trial.row(), flush=True)

        with ThreadPoolExecutor(given.jobs) as pool:
            list(pool.map(run.one_day, days, days.values(), repeat(end), repeat(keep_trial)))


def _film(given: argparse.Namespace) -> None:
    """Films a place under its lightings; each lighting has its own process of Cycles."""
    plan = FilmingPlan.of(sample_place(given.place)) if given.place else FilmingPlan()
    running: list[CyclesRenderer] = []

    def renderer_of(lighting: str, place: Any) -> CyclesRenderer:
        size = plan.width, plan.height
        light = place.lightings[lighting]
        if running:
            running[-1].close()  # the films of the lighting before are done
        running.append(CyclesRenderer(given.python, light, place, plan.intrinsics, size, given.samples, given.jobs))
        return running[-1]

    try:
        film(plan, given.out, given.place, renderer_of=renderer_of)
    finally:
        if running:
            running[-1].close()


def _tables(protocol: Protocol, results: Path) -> dict[str, Any]:
    """Compares all recorded places, and prints a table."""
    rows = []
    for place in protocol.places:
        record = results / protocol.name / f"place_{place}"
        if (record / REPEATED).exists():
            rows.append(compare(place, read_trials(record / TRIALS), read_trials(record / REPEATED)))
    print("| place | trials | same verdict | successes: own, Cycles | Spearman of policies |\n|---|---|---|---|---|")
    for one in rows:
        rank = "–" if one.spearman is None else f"{one.spearman:.2f}"
        print(f"| {one.place} | {one.trials} | {one.agree} | {one.own}, {one.cycles} | {rank} |")
    trials, agree = sum(one.trials for one in rows), sum(one.agree for one in rows)
    if trials:
        low, high = wilson(agree, trials)
        print(f"\nsame verdict in {agree} of {trials}: {agree / trials:.1%} ({low:.1%} to {high:.1%}); wanted ≥ 95 %")
    return {"places": [{"name": f"place_{one.place}", **vars(one)} for one in rows]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    trials = commands.add_parser("trials", help="repeat trials of the forecast experiment")
    trials.add_argument("work", type=Path, help="folder of the experiment's scenes")
    trials.add_argument("--places", type=int, nargs="+", metavar="NUMBER", help="default: all of the protocol")
    trials.add_argument("--share", type=float, default=0.1, help="share of a place's trials that is repeated")
    trials.add_argument("--minutes", type=float, default=float("inf"), help="begin no trial after this time")
    trials.add_argument("--protocol", type=Path, default=PROTOCOL, help="default: that of benchmarks/forecast")
    trials.add_argument("--results", type=Path, default=RESULTS, help="default: benchmarks/forecast/results")
    trials.add_argument("--tables", action="store_true", help="run nothing; compare what is recorded")
    add_record_options(trials)
    films = commands.add_parser("film", help="film a place")
    films.add_argument("--place", type=int, default=0, help="its number; default: 0, the demo's street")
    films.add_argument("--out", type=Path, required=True, help="folder of the new scene")
    for one in (trials, films):
        one.add_argument("--python", type=Path, default=Path(sys.executable), help="interpreter that can import bpy")
        one.add_argument("--samples", type=int, default=SAMPLES, help="paths per pixel (default: %(default)s)")
        one.add_argument("--jobs", type=int, default=2, help="cores to use (default: %(default)s)")
    given = parser.parse_args()
    try:
        if given.command == "film":
            _film(given)
            return 0
        protocol = read_protocol(given.protocol)
        if not given.tables:
            _repeat(protocol, given)
        return save(given.json, _tables(protocol, given.results), given.replace_record)
    except (InputError, OSError) as error:
        return print_error(error)


if __name__ == "__main__":
    sys.exit(main())
