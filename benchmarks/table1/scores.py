"""Scores of the table 1 experiment from `results.json`, first for the days that influenced no decision.

    python benchmarks/table1/scores.py [--results FILE]

Prints, by groups of days: success on the road; how well the twin's rates rank the policies; proper scores of the twin's
predictions of single days, beside those of baselines that do not use the twin; and the twin's false alarms and missed
failures. Rates on the road have intervals over days. Ranking and scores have jackknife intervals, as in
`twin forecast`, which hold for further trainings and days on this street (`twin/evaluation/agreement_intervals.py`).
`benchmarks/intervals.py` measures their coverage for these numbers of trainings and days. The *rule* is a baseline of
the ranking that does not use the twin; see `rule`.

Two decisions used trials or images of some days. The training methods were developed on the five designed weathers
(dawn, afternoon, evening, haze, rain). `KNOWN_WEATHER_FRACTION`, the fraction of the weather randomization that is kept
when a photo is available, was tuned on images of these weathers and of days 1 to 5. Days 6 to 15 were driven after
everything was fixed.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from plan import SETUPS, SHARES, STEPS, TASKS

from twin.config import Condition
from twin.evaluation.agreement import within
from twin.evaluation.agreement_intervals import (
    STATISTICS,
    PairedCells,
    Statistic,
    jackknife_interval,
    mean_bias,
    training_of,
)
from twin.evaluation.probability_scores import (
    SCORE_DIFFERENCE,
    brier,
    calibration,
    errors_by_day,
    log_score,
    mean_score,
    other_trainings,
    recalibrated,
    score_pair,
    shuffled_days,
    twin_probabilities,
)
from twin.evaluation.statistics import (
    MIN_POLICIES,
    UndefinedStatistic,
    leave_one_group_out,
    mmrv,
    pearson,
    rate_difference,
    spearman,
    winner,
)
from twin.files import read_json
from twin.reality.lighting import WEATHER

sys.path.append(str(Path(__file__).parents[1]))
from place_intervals import rate_over_days

RESULTS = Path(__file__).with_name("results.json")
_USED = 5  # number of sampled days that were examined before everything was fixed
_DAYS = [name for name in WEATHER if name.startswith("day_")]
_DESIGNED = len(WEATHER) - len(_DAYS)
GROUPS: dict[str, tuple[str, ...]] = {
    f"days {_USED + 1} to {len(_DAYS)}, not used during development": tuple(_DAYS[_USED:]),
    f"days 1 to {len(_DAYS)}, sampled at random": tuple(_DAYS),
    "the designed weathers and days 1 to 5, used during development": tuple(WEATHER)[: _DESIGNED + _USED],
    f"all {len(WEATHER)} weathers, half of them used during development": tuple(WEATHER),
}
"""Group of days → weathers."""

RULE_TRIALS = 5
"""Number of trials per day by which the rule's rate is turned into counts, for `_cells_held`; the twin has as many."""
# Fraction of its training from which a policy counts as half trained; less than 0.5, since the checkpoint may have been
# saved slightly earlier.
_HALF = max(SHARES) - 0.05

Counts = dict[str, tuple[int, int]]
"""Successes and trials by weather."""


@dataclass(frozen=True)
class PolicyRecord:
    """Record of one policy on its task."""

    name: str
    setup: str
    task: str
    trained: float
    """Fraction of its training that is done, 1 for a finished policy."""
    twin: Counts
    """Counts in the twin under a lighting from a photo of each day."""
    held_out: float
    """Success rate in the twin under held-out lightings with everything else randomized."""
    real: Counts


def policy_records(results: dict[str, Any]) -> list[PolicyRecord]:
    """The policies of a record."""
    names = {task: short for short, task in TASKS.items()}
    out = []
    for run in results["runs"]:
        for policy in run["policies"]:
            _, _, step = policy["policy"].partition("/")
            held_out = policy["validate_randomised"]
            out.append(
                PolicyRecord(
                    name=policy["policy"],
                    setup=run["setup"],
                    task=run["task"],
                    trained=int(step) / STEPS[names[run["task"]]] if step else 1.0,
                    twin={Condition.parse(k).lighting: v for k, v in counts(policy["validate_by_photo"]).items()},
                    held_out=held_out["successes"] / held_out["trials"] if held_out["trials"] else float("nan"),
                    real=counts(policy["real"]),
                )
            )
    return out


def counts(part: dict[str, Any]) -> Counts:
    return {name: (cell["successes"], cell["trials"]) for name, cell in part["by_lighting"].items()}


def rule(policy: PolicyRecord) -> float:
    """A baseline without the twin: 1 if lightings varied in training and at least half the training is done, else 0.

    This rule was formulated after the results of all trials were known.
    """
    return float(policy.setup == "varied" and policy.trained >= _HALF)


def by_photo(policy: PolicyRecord, days: Sequence[str]) -> float:
    """Mean over days of the twin's rates under lightings from photos."""
    return _mean(policy.twin, days)


def _mean(counts: Counts, days: Sequence[str]) -> float:
    return float(np.mean([counts[day][0] / counts[day][1] for day in days]))


PREDICTORS: dict[str, Callable[[PolicyRecord, Sequence[str]], float]] = {
    "twin, by a photo of each day": by_photo,
    "twin, held-out lightings": lambda policy, days: policy.held_out,
    "rule without the twin": lambda policy, days: rule(policy),
}


@dataclass(frozen=True)
class Scores:
    """Scores of a predictor on some policies and days; None where undefined."""

    policies: int
    spearman: float | None
    pearson: float | None
    mmrv: float | None
    intervals: dict[str, tuple[float, float] | None]
    """Statistic → its 90 % interval; None where there is none."""
    regret: float | None
    """Mean regret over tasks."""
    bias: float
    """Mean over policies of real minus predicted rate."""
    cells: float | None
    """Fraction of the cells (a policy on a day) in which predicted and real rate agree, see `_cells_held`; None if the
    predictor has no counts."""
    corrected: tuple[int, int]
    """A line fitted to the task's other trainings predicts an interval for each policy's real rate: number of intervals
    that contain the rate, and number of intervals."""


def scores(predictor: str, policies: Sequence[PolicyRecord], days: Sequence[str]) -> Scores | None:
    """Scores of one of `PREDICTORS`; None if fewer than `MIN_POLICIES` drove on all the days."""
    mine = [p for p in policies if set(days) <= p.real.keys() and (set(days) <= p.twin.keys())]
    if len(mine) < MIN_POLICIES:
        return None
    twin = np.array([PREDICTORS[predictor](policy, days) for policy in mine])
    if np.isnan(twin).any():
        return None
    real = np.array([_mean(policy.real, days) for policy in mine])
    tasks = [np.array([policy.task == task for policy in mine]) for task in dict.fromkeys(p.task for p in mine)]
    regrets = [winner(twin=twin[of], real=real[of])[1] for of in tasks if of.sum() > 1]
    by_day = [[PREDICTORS[predictor](policy, [day]) for day in days] for policy in mine]
    cells = paired_cells(mine, days, np.array(by_day))
    return Scores(
        policies=len(mine),
        spearman=_defined(spearman, twin, real),
        pearson=_defined(pearson, twin, real),
        mmrv=_defined(mmrv, twin, real),
        intervals={name: _interval(statistic, cells) for name, statistic in STATISTICS.items()},
        regret=float(np.mean(regrets)) if regrets else None,
        bias=float(np.mean(real - twin)),
        cells=_cells_held(predictor, mine, days),
        corrected=_corrected(twin, real, tasks, [training_of(policy.name) for policy in mine]),
    )


def paired_cells(policies: Sequence[PolicyRecord], days: Sequence[str], twin: np.ndarray) -> PairedCells:
    """Pairs the real rates of n policies on k days with their predictions `twin` (n, k), for the jackknife."""
    tasks, runs = [policy.task for policy in policies], [training_of(policy.name) for policy in policies]
    return PairedCells(
        twin=twin,
        real=np.array([[policy.real[day][0] / policy.real[day][1] for day in days] for policy in policies]),
        weight=np.ones((len(policies), len(days))),
        training=np.unique(runs, return_inverse=True)[1],
        day=np.broadcast_to(np.arange(len(days)), (len(policies), len(days))),
        strata=tuple(np.flatnonzero(np.array(tasks) == task) for task in dict.fromkeys(tasks)),
    )


def _interval(statistic: Statistic, data: PairedCells) -> tuple[float, float] | None:
    try:
        low, high = jackknife_interval(statistic, data)
    except UndefinedStatistic:
        return None
    return (float(low), float(high)) if np.isfinite(low) else None


# ---- predictions of single days

TWIN = "the twin, by a photo of each day"


@dataclass(frozen=True)
class DayScores:
    """Scores of a predictor of single days; see `twin.evaluation.probability_scores`."""

    brier: float
    log: float
    gain: float
    """Log score of the predictor minus the twin's: above 0 the twin is better."""
    interval: tuple[float, float] | None
    """Interval of the gain."""


def probabilities(policies: Sequence[PolicyRecord], days: Sequence[str]) -> tuple[PairedCells, dict[str, np.ndarray]]:
    """The cells, and each predictor's probability of success in them (n, k); baselines use only other trainings."""
    counts_ = np.array([[policy.twin[day] for day in days] for policy in policies])
    twin = twin_probabilities(counts_[..., 0], counts_[..., 1])
    data = paired_cells(policies, days, twin)
    steps = [min(SHARES, key=lambda share: abs(share - p.trained)) if p.trained < 0.9 else 1.0 for p in policies]
    groups = {
        "mean of other trainings": [0] * len(policies),
        "setup": [p.setup for p in policies],
        "training step": steps,
        "the rule": [rule(p) for p in policies],
        "setup and step": [(p.setup, step) for p, step in zip(policies, steps, strict=True)],
        "the other seed (same task, setup, step)": [
            (p.task, p.setup, step) for p, step in zip(policies, steps, strict=True)
        ],
    }
    out = {TWIN: twin, "the twin, recalibrated on other trainings": recalibrated(twin, data)}
    for name, keys in groups.items():
        ids = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        each = other_trainings(data, np.array([ids[key] for key in keys]))
        out[name] = np.broadcast_to(each[:, None], twin.shape)
    return data, out


def day_scores(policies: Sequence[PolicyRecord], days: Sequence[str]) -> dict[str, DayScores]:
    """Scores of every predictor of single days."""
    data, each = probabilities(policies, days)
    logs = {name: log_score(p, data.real) for name, p in each.items()}
    briers = {name: brier(p, data.real) for name, p in each.items()}
    shuffled = "the twin, its days shuffled"
    logs[shuffled] = shuffled_days(each[TWIN], data.weight, data.real, log_score)
    briers[shuffled] = shuffled_days(each[TWIN], data.weight, data.real, brier)
    out = {}
    for name in logs:
        pair = score_pair(data, logs[TWIN], logs[name])
        ends = _interval(SCORE_DIFFERENCE, pair) if name != TWIN else None
        gain = float(mean_bias(**pair.rates()))
        out[name] = DayScores(mean_score(data, briers[name]), mean_score(data, logs[name]), gain, ends)
    return out


def day_tables(policies: Sequence[PolicyRecord], days: Sequence[str]) -> str:
    """Scores of single days, calibration of the twin, and its errors by day, in Markdown."""
    lines = [
        "| predictor of single days | Brier | log score | the twin's log score is better by | ",
        "|---|---|---|---|",
    ]
    for name, one in day_scores(policies, days).items():
        gain = "–" if name == TWIN else _bracketed(one.gain, one.interval, "+.3f")
        lines.append(f"| {name} | {one.brier:.3f} | {one.log:.3f} | {gain} |")
    data, each = probabilities(policies, days)
    trials = np.array([[policy.real[day][1] for day in days] for policy in policies])
    lines += [
        "",
        "| probability predicted by the twin | mean | success on the road | cells | trials |",
        "|---|---|---|---|---|",
    ]
    for part in calibration(each[TWIN].ravel(), data.real.ravel(), trials.ravel()):
        ends = f"{part.low:g} to {part.high:g}"
        lines.append(f"| {ends} | {part.predicted:.2f} | {part.observed:.2f} | {part.cells} | {part.trials} |")
    lines += ["", "| day | cells | missed failures | false alarms |", "|---|---|---|---|"]
    for error in errors_by_day(each[TWIN].ravel(), data.real.ravel(), list(days) * len(policies)):
        lines.append(f"| {error.day} | {error.cells} | {error.misses} | {error.false_alarms} |")
    return "\n".join(lines)


def _bracketed(value: float | None, ends: tuple[float, float] | None, form: str) -> str:
    if value is None:
        return "–"
    text = format(value, form)
    if ends is not None:
        text += f" ({format(ends[0], form)} to {format(ends[1], form)})"
    return text.replace("-", "−")


def _corrected(
    twin: np.ndarray, real: np.ndarray, tasks: Sequence[np.ndarray], trainings: Sequence[str]
) -> tuple[int, int]:
    held: list[bool] = []
    for of in tasks:
        try:
            groups = [trainings[i] for i in np.flatnonzero(of)]
            _, low, high = leave_one_group_out(twin=twin[of], real=real[of], groups=groups)
        except UndefinedStatistic:
            continue
        known = np.isfinite(low)
        held += within(low, real[of], high)[known].tolist()
    return sum(held), len(held)


def _defined(statistic: Callable[..., float], twin: np.ndarray, real: np.ndarray) -> float | None:
    try:
        return statistic(twin=twin, real=real)
    except UndefinedStatistic:
        return None


def _cells_held(predictor: str, policies: Sequence[PolicyRecord], days: Sequence[str]) -> float | None:
    """Fraction of cells in which the interval of real minus predicted rate contains 0, as in a forecast."""
    if predictor not in ("twin, by a photo of each day", "rule without the twin"):
        return None
    predicted = [
        p.twin[day] if predictor.startswith("twin") else (round(RULE_TRIALS * rule(p)), RULE_TRIALS)
        for p in policies
        for day in days
    ]
    real = [policy.real[day] for policy in policies for day in days]
    (won, trials), (real_won, real_trials) = np.transpose(predicted), np.transpose(real)
    _, low, high = rate_difference(
        twin_successes=won, twin_trials=trials, real_successes=real_won, real_trials=real_trials
    )
    return float(((low <= 0.0) & (high >= 0.0)).mean())


def finals(policies: Sequence[PolicyRecord], setup: str, task: str, days: Sequence[str]) -> str:
    """Success on the road of a setup's finished policies, in the format of `over_days`."""
    mine = [p for p in policies if (p.setup, p.task, p.trained) == (setup, task, 1.0) and set(days) <= p.real.keys()]
    return over_days([{day: policy.real[day] for day in days} for policy in mine])


def over_days(parts: Sequence[Counts]) -> str:
    """Mean over days of the rates of several policies, its interval over days, and the counts.

    Args:
        parts: Counts of each policy, all on the same days.

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
    """Success of finished policies, and scores of every predictor, by group of days, in Markdown."""
    policies = policy_records(results)
    lines = ["Finished policies on the road: mean over days, its 90 % interval over days, successes/trials", ""]
    lines += ["| days | setup | straight | right turn |", "|---|---|---|---|"]
    for group, days in GROUPS.items():
        for setup in SETUPS:
            cells = [finals(policies, setup, task, days) for task in TASKS.values()]
            lines.append(f"| {group} | {setup} | {' | '.join(cells)} |")
    heads = "policies | Spearman | Pearson | MMRV | regret | road minus predicted | cells that agree"
    heads += " | real rate in predicted interval"
    lines += ["", "Ranking of all policies, finished and checkpoints, by predictor, with 90 % intervals", ""]
    lines += [f"| days | task | predictor | {heads} |", f"|---|---|---|{'---|' * (heads.count('|') + 1)}"]
    for group, days in GROUPS.items():
        for task in ("both tasks", *TASKS.values()):
            mine = [policy for policy in policies if task in ("both tasks", policy.task)]
            for name in PREDICTORS:
                found = scores(name, mine, days)
                if found:
                    lines.append(f"| {group} | {task} | {name} | {' | '.join(_row(found))} |")
    for group, days in list(GROUPS.items())[:2]:
        mine = [p for p in policies if set(days) <= p.real.keys() and set(days) <= p.twin.keys()]
        if len(mine) >= MIN_POLICIES:
            lines += ["", f"Single days, {group}", "", day_tables(mine, days)]
    return "\n".join(lines)


def _row(found: Scores) -> list[str]:
    held = found.intervals
    shown = [
        _bracketed(found.spearman, held["spearman"], ".2f"),
        _bracketed(found.pearson, held["pearson"], ".3f"),
        _bracketed(found.mmrv, held["mmrv"], ".3f"),
        _bracketed(found.regret, None, ".3f"),
        _bracketed(found.bias, held["bias"], "+.3f"),
        "–" if found.cells is None else f"{found.cells:.1%}",
        f"{found.corrected[0]} of {found.corrected[1]}" if found.corrected[1] else "–",
    ]
    return [str(found.policies), *shown]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS, help="the record (default: the one beside this file)")
    print(tables(read_json(parser.parse_args().results)))


if __name__ == "__main__":
    main()
