"""Coverage of the forecast's 90 % intervals in simulated experiments with a known truth.

    python benchmarks/intervals.py [--experiments 300]
    python benchmarks/intervals.py --record benchmarks/table1/results.json

In an experiment, policies of varied quality drive under two lightings; the twin's rates are biased upwards and noisy.
Prints a table: one setting per row, one statistic per column. With `--record`, experiments are resampled from a
recorded one instead, which has many days of few trials with mostly equal outcomes. See `RESAMPLING`.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import expit

from twin.config import Condition
from twin.evaluation.bootstrap import PairedCells, Rates, bootstrap_interval, observed_rates, resample
from twin.evaluation.statistics import (
    LinearCorrection,
    leave_one_group_out,
    mmrv_batched,
    pearson_batched,
    prediction_powered_mean,
    spearman_batched,
    winner_batched,
)
from twin.files import read_json

_MEAN_OVER = 3000  # experiments that estimate the true value of a statistic
_DRAWS = 400

# policies, trials per cell in the twin and on the road, std of quality [logit], std of the twin's noise [logit]
SETTINGS = {
    "12 policies, 50 real trials": (12, 100, 50, 1.5, 0.5),
    "12, 50, a very good twin": (12, 200, 50, 2.0, 0.2),
    "24, 20": (24, 100, 20, 1.5, 0.5),
    "12, 20, a poor twin": (12, 100, 20, 1.5, 3.0),
    "6, 10": (6, 100, 10, 1.5, 0.7),
    "5, 5": (5, 50, 5, 1.5, 0.5),
}


def simulated_experiment(
    rng: np.random.Generator, n: int, twin_trials: int, real_trials: int, spread: float, noise: float
) -> PairedCells:
    """One simulated experiment."""
    quality = rng.normal(0.0, spread, (n, 1)) + rng.normal(0.0, 0.3, (n, 2))
    twin = expit(quality + 0.5 + rng.normal(0.0, noise, (n, 1)))
    trials = np.full((n, 2), twin_trials), np.full((n, 2), real_trials)
    won = rng.binomial(trials[0], twin), rng.binomial(trials[1], expit(quality))
    of = np.broadcast_to(np.arange(2), (n, 2))
    return PairedCells(trials[0], won[0], of, trials[1], won[1], np.ones((n, 2)), (np.arange(n),))


RESAMPLING = {
    "policies resampled, the same days": False,
    "policies and days resampled": True,
}
"""Row → True if days are resampled, too. Trials are resampled at each policy's recorded rates."""


def read_experiment(path: Path) -> PairedCells:
    """The experiment that `benchmarks/table1` recorded, with the twin's lightings from photos; policies by task."""
    read: list[tuple[str, list[list[int]]]] = []
    for run in read_json(path)["runs"]:
        for policy in run["policies"]:
            twin, real = policy["validate_by_photo"]["by_lighting"], policy["real"]["by_lighting"]
            sides = [[twin[str(Condition(day, True))], real[day]] for day in real]
            read.append((run["task"], [[c["trials"] for c in s] + [c["successes"] for c in s] for s in sides]))
    counts = np.array([cells for _, cells in read])
    task = np.array([name for name, _ in read])
    of = np.broadcast_to(np.arange(counts.shape[1]), counts.shape[:2])
    strata = tuple(np.flatnonzero(task == name) for name in dict.fromkeys(task))
    weight = np.ones(counts.shape[:2])
    return PairedCells(counts[..., 0], counts[..., 2], of, counts[..., 1], counts[..., 3], weight, strata)


def resampled_experiment(rng: np.random.Generator, record: PairedCells, resample_days: bool) -> PairedCells:
    """One experiment with policies resampled within each task, and days if `resample_days`, both with replacement."""
    policies = np.concatenate([rng.choice(members, len(members)) for members in record.strata])
    strata = tuple(np.split(np.arange(len(policies)), np.cumsum([len(m) for m in record.strata])[:-1]))
    days = np.arange(record.weight.shape[1])
    chosen = np.ix_(policies, rng.choice(days, len(days)) if resample_days else days)
    twin_trials, real_trials = record.twin_trials[chosen], record.real_trials[chosen]
    twin = rng.binomial(twin_trials, record.twin_successes[chosen] / twin_trials)
    real = rng.binomial(real_trials, record.real_successes[chosen] / real_trials)
    return PairedCells(twin_trials, twin, record.twin_index, real_trials, real, record.weight, strata)


def statistics(rates: Rates) -> dict[str, np.ndarray]:
    """The statistics that have a bootstrap interval."""
    agreement, regret = winner_batched(twin=rates.twin, real=rates.real)
    return {
        "Pearson": pearson_batched(twin=rates.twin, real=rates.real),
        "Spearman": spearman_batched(twin=rates.twin, real=rates.real),
        "MMRV": mmrv_batched(twin=rates.twin, real=rates.real),
        "winner": agreement,
        "regret": regret,
        "cells agree": rates.compatible,
        "bias": rates.difference,
    }


def coverage(settings: tuple[int, int, int, float, float], experiments: int, seed: int = 0) -> dict[str, float]:
    """Fraction of the experiments in which each interval contains the true value."""
    rng = np.random.default_rng(seed)
    truth = true_values(lambda: simulated_experiment(rng, *settings))
    hits: dict[str, list[float]] = {name: [] for name in (*truth, "predicted", "left out", "mean on the road")}
    n = settings[0]
    for _ in range(experiments):
        data = simulated_experiment(rng, *settings)
        for name, hit in intervals_hold(data, rng, truth).items():
            hits[name].append(hit)
        further = observed_rates(simulated_experiment(rng, 2 * n, *settings[1:]))
        driven, others = slice(0, n), slice(n, 2 * n)
        f, y = further.twin, further.real
        _, low, high = LinearCorrection.fit(twin=f[driven], real=y[driven]).predict(f[others])
        hits["predicted"].append(float(np.mean((low <= y[others]) & (y[others] <= high))))
        if n > 5:
            _, low, high = leave_one_group_out(twin=f[driven], real=y[driven], groups=range(n))
            hits["left out"].append(float(np.mean((low <= y[driven]) & (y[driven] <= high))))
        mean = prediction_powered_mean(twin=f[driven], real=y[driven], twin_only=f[others])
        hits["mean on the road"].append(mean.low <= 0.5 <= mean.high)  # one half, by symmetry
    return {name: float(np.mean(each)) if each else float("nan") for name, each in hits.items()}


def true_values(experiment: Callable[[], PairedCells]) -> dict[str, float]:
    """True value of each statistic: its mean over many experiments."""
    many = [statistics(observed_rates(experiment())) for _ in range(_MEAN_OVER)]
    return {name: float(np.nanmean([one[name] for one in many])) for name in many[0]}


def intervals_hold(data: PairedCells, rng: np.random.Generator, truth: dict[str, float]) -> dict[str, bool]:
    """Statistic → True if its bootstrap interval contains the true value; without undefined intervals."""
    own, repeated = statistics(observed_rates(data)), statistics(resample(data, rng, _DRAWS))
    ends = {name: bootstrap_interval(float(own[name]), repeated[name]) for name in truth}
    return {name: end[0] - 1e-9 <= truth[name] <= end[1] + 1e-9 for name, end in ends.items() if end}


def recorded_coverage(record: PairedCells, resample_days: bool, experiments: int, seed: int = 0) -> dict[str, float]:
    """`coverage` in experiments resampled from a record."""
    rng = np.random.default_rng(seed)
    truth = true_values(lambda: resampled_experiment(rng, record, resample_days))
    hits = [intervals_hold(resampled_experiment(rng, record, resample_days), rng, truth) for _ in range(experiments)]
    return {name: float(np.mean([one[name] for one in hits if name in one])) for name in truth}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=300)
    parser.add_argument("--record", type=Path, metavar="FILE", help="results.json of benchmarks/table1")
    given = parser.parse_args()
    rows: dict[str, Callable[[], dict[str, float]]] = {
        name: partial(coverage, settings, given.experiments) for name, settings in SETTINGS.items()
    }
    if given.record:
        record = read_experiment(given.record)
        rows = {name: partial(recorded_coverage, record, days, given.experiments) for name, days in RESAMPLING.items()}
    for i, (name, measure) in enumerate(rows.items()):
        row = measure()
        if i == 0:
            print(f"| setting | {' | '.join(row)} |\n|---|{'---|' * len(row)}")
        print(f"| {name} | {' | '.join(f'{x:.2f}' if x == x else '–' for x in row.values())} |", flush=True)


if __name__ == "__main__":
    main()
