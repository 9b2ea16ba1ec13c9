"""How often the forecast's 90 % intervals hold what they aim at, in simulated worlds where that is known.

    python benchmarks/intervals.py [--experiments 300]

Policies of varied quality drive under two lightings, in a twin that promises too much and misjudges each by some noise.
Prints a table: a world per row, a statistic per column.
"""

import argparse

import numpy as np
from scipy.special import expit

from twin.report.bootstrap import Paired, Rates, interval, resample, seen
from twin.report.correction import Correction, left_out_predictions, powered_mean
from twin.report.statistics import mmrv_rows, pearson_rows, spearman_rows, winner_rows

_MEAN_OVER = 3000  # experiments, for what an interval aims at
_DRAWS = 400

# policies, trials a cell in the twin and on the road, spread of quality [logit], noise of the twin [logit]
WORLDS = {
    "12 policies, 50 real trials": (12, 100, 50, 1.5, 0.5),
    "12, 50, a very good twin": (12, 200, 50, 2.0, 0.2),
    "24, 20": (24, 100, 20, 1.5, 0.5),
    "12, 20, a poor twin": (12, 100, 20, 1.5, 3.0),
    "6, 10": (6, 100, 10, 1.5, 0.7),
    "5, 5": (5, 50, 5, 1.5, 0.5),
}


def world(rng: np.random.Generator, n: int, twin_trials: int, real_trials: int, spread: float, noise: float) -> Paired:
    """One experiment."""
    quality = rng.normal(0.0, spread, (n, 1)) + rng.normal(0.0, 0.3, (n, 2))
    twin = expit(quality + 0.5 + rng.normal(0.0, noise, (n, 1)))
    trials = np.full((n, 2), twin_trials), np.full((n, 2), real_trials)
    won = rng.binomial(trials[0], twin), rng.binomial(trials[1], expit(quality))
    of = np.broadcast_to(np.arange(2), (n, 2))
    return Paired(trials[0], won[0], of, trials[1], won[1], np.ones((n, 2)), (np.arange(n),))


def statistics(rates: Rates) -> dict[str, np.ndarray]:
    """Those with a bootstrap interval."""
    agreement, regret = winner_rows(twin=rates.twin, real=rates.real)
    return {
        "Pearson": pearson_rows(twin=rates.twin, real=rates.real),
        "Spearman": spearman_rows(twin=rates.twin, real=rates.real),
        "MMRV": mmrv_rows(twin=rates.twin, real=rates.real),
        "winner": agreement,
        "regret": regret,
        "cells agree": rates.inside,
        "bias": rates.difference,
    }


def coverage(settings: tuple[int, int, int, float, float], experiments: int, seed: int = 0) -> dict[str, float]:
    """Share of the experiments in which each interval held what it aims at."""
    rng = np.random.default_rng(seed)
    many = [statistics(seen(world(rng, *settings))) for _ in range(_MEAN_OVER)]
    aims = {name: float(np.nanmean([one[name] for one in many])) for name in many[0]}
    held: dict[str, list[float]] = {name: [] for name in (*aims, "predicted", "left out", "mean on the road")}
    n = settings[0]
    for _ in range(experiments):
        data = world(rng, *settings)
        own, again = statistics(seen(data)), statistics(resample(data, rng, _DRAWS))
        for name, aim in aims.items():
            ends = interval(float(own[name]), again[name])
            if ends:
                held[name].append(ends[0] - 1e-9 <= aim <= ends[1] + 1e-9)
        further = seen(world(rng, 2 * n, *settings[1:]))
        driven, others = slice(0, n), slice(n, 2 * n)
        f, y = further.twin, further.real
        _, low, high = Correction.fit(twin=f[driven], real=y[driven]).predict(f[others])
        held["predicted"].append(float(np.mean((low <= y[others]) & (y[others] <= high))))
        if n > 5:
            _, low, high = left_out_predictions(twin=f[driven], real=y[driven], groups=range(n))
            held["left out"].append(float(np.mean((low <= y[driven]) & (y[driven] <= high))))
        mean = powered_mean(twin=f[driven], real=y[driven], twin_only=f[others])
        held["mean on the road"].append(mean.low <= 0.5 <= mean.high)  # one half, by symmetry
    return {name: float(np.mean(hits)) if hits else float("nan") for name, hits in held.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=300)
    experiments = parser.parse_args().experiments
    for i, (name, settings) in enumerate(WORLDS.items()):
        row = coverage(settings, experiments)
        if i == 0:
            print(f"| world | {' | '.join(row)} |\n|---|{'---|' * len(row)}")
        print(f"| {name} | {' | '.join(f'{x:.2f}' if x == x else '–' for x in row.values())} |", flush=True)


if __name__ == "__main__":
    main()
