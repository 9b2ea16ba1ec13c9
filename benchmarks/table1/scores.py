"""What the experiment's record says, recounted without driving anything; what no choice had seen comes first.

    python benchmarks/table1/scores.py [--results FILE]

prints, from `results.json`, success on the road by groups of days and how well the twin's rates rank the policies
there. Rates on the road have intervals over days. Scores have none: the forecast's own are too narrow in worlds of this
shape (`benchmarks/intervals.py --record`). Beside the twin stands a *rule* that never looks at it; see `rule`.

A choice is anything that was decided while the trials of a day, or its pictures, were known: the methods of training,
developed in the five stated weathers; the share of weather that a photo leaves untold, measured on pictures of these
and of days 1 to 5. Days 6 to 15 were driven when all was fixed.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from plan import SETUPS, SHARES, STEPS, TASKS

from twin.config import RANDOMIZED
from twin.evaluation.statistics import (
    MIN_POLICIES,
    UndefinedStatistic,
    leave_one_group_out,
    mmrv,
    pearson,
    rate_difference,
    rate_over_days,
    spearman,
    winner,
)
from twin.files import read_json
from twin.reality.lighting import WEATHER

RESULTS = Path(__file__).with_name("results.json")
_USED = 5  # of the drawn days, the first, were looked at before everything was fixed
_DAYS = [name for name in WEATHER if name.startswith("day_")]
_STATED = len(WEATHER) - len(_DAYS)
GROUPS: dict[str, tuple[str, ...]] = {
    f"days {_USED + 1} to {len(_DAYS)}, which no choice had seen": tuple(_DAYS[_USED:]),
    f"days 1 to {len(_DAYS)}, drawn by chance": tuple(_DAYS),
    "the stated weathers and days 1 to 5, seen during development": tuple(WEATHER)[: _STATED + _USED],
    f"all {len(WEATHER)} weathers, half of them seen during development": tuple(WEATHER),
}
"""Weathers by what may be claimed of them."""

RULE_TRIALS = 5
"""Episodes per day that the rule is taken to have driven, as many as the twin."""
_HALF = max(SHARES) - 0.05  # of a training; checkpoints are saved within 100 steps of what is asked

Counts = dict[str, tuple[int, int]]
"""Successes and trials by weather."""


@dataclass(frozen=True)
class Judged:
    """One policy on its task."""

    name: str
    setup: str
    task: str
    trained: float
    """Share of its training that it has behind it, 1 for a finished policy."""
    twin: Counts
    """In the twin by a photo of each day."""
    held_out: float
    """Rate in the twin under held-out lights, everything else drawn anew."""
    real: Counts


def judged(results: dict[str, Any]) -> list[Judged]:
    """The policies of a record."""
    names = {task: short for short, task in TASKS.items()}
    out = []
    for run in results["runs"]:
        for policy in run["policies"]:
            _, _, step = policy["policy"].partition("/")
            held_out = policy["validate_randomised"]
            out.append(
                Judged(
                    name=policy["policy"],
                    setup=run["setup"],
                    task=run["task"],
                    trained=int(step) / STEPS[names[run["task"]]] if step else 1.0,
                    twin={k.removesuffix(RANDOMIZED): v for k, v in counts(policy["validate_by_photo"]).items()},
                    held_out=held_out["successes"] / held_out["trials"] if held_out["trials"] else float("nan"),
                    real=counts(policy["real"]),
                )
            )
    return out


def counts(part: dict[str, Any]) -> Counts:
    return {name: (told["successes"], told["trials"]) for name, told in part["by_lighting"].items()}


def rule(policy: Judged) -> float:
    """A predictor that does not look at the twin: every trial succeeds if the light varied in training and at least
    half of the training is done, else none. It was thought of when all trials were known."""
    return float(policy.setup == "varied" and policy.trained >= _HALF)


def by_photo(policy: Judged, days: Sequence[str]) -> float:
    """Mean over days of the twin's rates by a photo of each."""
    return _mean(policy.twin, days)


def _mean(counts: Counts, days: Sequence[str]) -> float:
    return float(np.mean([counts[day][0] / counts[day][1] for day in days]))


PREDICTORS: dict[str, Callable[[Judged, Sequence[str]], float]] = {
    "twin, by a photo of each day": by_photo,
    "twin, held-out lights": lambda policy, days: policy.held_out,
    "rule that never looks at the twin": lambda policy, days: rule(policy),
}


@dataclass(frozen=True)
class Scores:
    """How a predictor does on some policies and days; None where it is not defined."""

    policies: int
    spearman: float | None
    pearson: float | None
    mmrv: float | None
    regret: float | None
    """Mean over tasks."""
    bias: float
    """Mean over policies of real minus predicted rate."""
    cells: float | None
    """Share of the cells whose predicted and real counts differ by no more than chance; None: it counts none."""
    corrected: tuple[int, int]
    """Policies within the interval predicted from the task's other policies, as the forecast corrects; of how many."""


def scores(predictor: str, policies: Sequence[Judged], days: Sequence[str]) -> Scores | None:
    """Scores of one of `PREDICTORS`; None where fewer than five policies drove on all the days."""
    mine = [p for p in policies if set(days) <= p.real.keys() and (set(days) <= p.twin.keys())]
    if len(mine) < MIN_POLICIES:
        return None
    twin = np.array([PREDICTORS[predictor](policy, days) for policy in mine])
    if np.isnan(twin).any():
        return None
    real = np.array([_mean(policy.real, days) for policy in mine])
    tasks = [np.array([policy.task == task for policy in mine]) for task in dict.fromkeys(p.task for p in mine)]
    regrets = [winner(twin=twin[of], real=real[of])[1] for of in tasks if of.sum() > 1]
    return Scores(
        policies=len(mine),
        spearman=_defined(spearman, twin, real),
        pearson=_defined(pearson, twin, real),
        mmrv=_defined(mmrv, twin, real),
        regret=float(np.mean(regrets)) if regrets else None,
        bias=float(np.mean(real - twin)),
        cells=_cells_held(predictor, mine, days),
        corrected=_corrected(twin, real, tasks),
    )


def _corrected(twin: np.ndarray, real: np.ndarray, tasks: Sequence[np.ndarray]) -> tuple[int, int]:
    held: list[bool] = []
    for of in tasks:
        try:
            _, low, high = leave_one_group_out(twin=twin[of], real=real[of], groups=range(int(of.sum())))
        except UndefinedStatistic:
            continue
        held += ((low <= real[of]) & (real[of] <= high)).tolist()
    return sum(held), len(held)


def _defined(statistic: Callable[..., float], twin: np.ndarray, real: np.ndarray) -> float | None:
    try:
        return statistic(twin=twin, real=real)
    except UndefinedStatistic:
        return None


def _cells_held(predictor: str, policies: Sequence[Judged], days: Sequence[str]) -> float | None:
    """As the forecast counts it: the interval of the difference of rates contains none."""
    if predictor not in ("twin, by a photo of each day", "rule that never looks at the twin"):
        return None
    told = [
        p.twin[day] if predictor.startswith("twin") else (round(RULE_TRIALS * rule(p)), RULE_TRIALS)
        for p in policies
        for day in days
    ]
    seen = [policy.real[day] for policy in policies for day in days]
    (won, trials), (real_won, real_trials) = np.transpose(told), np.transpose(seen)
    _, low, high = rate_difference(
        twin_successes=won, twin_trials=trials, real_successes=real_won, real_trials=real_trials
    )
    return float(((low <= 0.0) & (high >= 0.0)).mean())


def finals(policies: Sequence[Judged], setup: str, task: str, days: Sequence[str]) -> str:
    """Success on the road of a setup's finished policies, as `over_days` tells it."""
    mine = [p for p in policies if (p.setup, p.task, p.trained) == (setup, task, 1.0) and set(days) <= p.real.keys()]
    return over_days([{day: policy.real[day] for day in days} for policy in mine])


def over_days(parts: Sequence[Counts]) -> str:
    """The mean over days of the rates of several policies on them, its interval over days, and the counts.

    Args:
        parts: By policy, all with the same days.

    Returns:
        "0.05 [0.01, 0.20], 15/250"; "–" without trials.
    """
    days = [[part[day] for part in parts if day in part] for day in dict.fromkeys(d for part in parts for d in part)]
    if not days:
        return "–"
    won, trials = (np.array([sum(counts[k] for counts in day) for day in days]) for k in (0, 1))
    mean, low, high = rate_over_days(won / trials)
    return f"{mean:.2f} [{low:.2f}, {high:.2f}], {won.sum()}/{trials.sum()}"


def tables(results: dict[str, Any]) -> str:
    """Success of finished policies and scores of every predictor, by groups of days, in Markdown."""
    policies = judged(results)
    lines = ["Finished policies on the road: mean over days, its 90 % interval over days, successes/trials", ""]
    lines += ["| days | setup | straight | right turn |", "|---|---|---|---|"]
    for group, days in GROUPS.items():
        for setup in SETUPS:
            cells = [finals(policies, setup, task, days) for task in TASKS.values()]
            lines.append(f"| {group} | {setup} | {' | '.join(cells)} |")
    heads = (
        "policies",
        "Spearman",
        "Pearson",
        "MMRV",
        "regret",
        "road minus predicted",
        "cells that agree",
        "corrected hold",
    )
    lines += ["", "How predictors rank the policies, finished ones and checkpoints; no interval is known to hold", ""]
    lines += [f"| days | task | predictor | {' | '.join(heads)} |", f"|---|---|---|{'---|' * len(heads)}"]
    for group, days in GROUPS.items():
        for task in ("both tasks", *TASKS.values()):
            mine = [policy for policy in policies if task in ("both tasks", policy.task)]
            for name in PREDICTORS:
                found = scores(name, mine, days)
                if found:
                    lines.append(f"| {group} | {task} | {name} | {' | '.join(_row(found))} |")
    return "\n".join(lines)


def _row(found: Scores) -> list[str]:
    def told(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form).replace("-", "−")

    values = (found.spearman, found.pearson, found.mmrv, found.regret, found.bias)
    forms = (".2f", ".3f", ".3f", ".3f", "+.3f")
    corrected = f"{found.corrected[0]} of {found.corrected[1]}" if found.corrected[1] else "–"
    return [str(found.policies), *map(told, values, forms), told(found.cells, ".1%"), corrected]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS, help="the record (default: results.json beside this)")
    print(tables(read_json(parser.parse_args().results)))


if __name__ == "__main__":
    main()
