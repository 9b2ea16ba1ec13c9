"""Bootstrap intervals of statistics over policies: policies and trials are resampled.

Policies are resampled with replacement within each task; then all their trials, in both worlds, are resampled at the
rates of their cells (shrunk by half a trial towards one half, Jeffreys' posterior mean, so that a rate of 0 or 1 still
varies). The interval of a statistic is the central 90 % of its replicates, extended to the observed value if that lies
outside, as a replicate contains the noise of the trials twice.

The interval is for the statistic's mean over such experiments with as many trials per cell; the noise of few trials is
part of the statistic and lowers a correlation. `benchmarks/intervals.py` measures its coverage (nominally 0.9). With
few cells of ten trials or more the interval is too wide, except if the twin hardly separates good policies from bad
ones: 0.80 at least. With twenty days of five trials, most of a single outcome, it is too narrow, since resampled cells
agree less than observed ones: 0.6 for Spearman's correlation, 0.75 to 0.8 for Pearson's, 0.5 to 0.6 for MMRV.
Alternatives were worse: resampling policies alone covers 0.6 to 0.9 with a dozen of them; intervals centered on the
observed value cover 0.73 to 0.9 for Spearman's correlation; a hierarchical model of the rates returns its prior.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from twin.evaluation.statistics import CONFIDENCE, rate_difference
from twin.evaluation.trials import Cell
from twin.types import Array, Indices

REPLICATES = 2000  # resampled experiments


@dataclass(frozen=True)
class PairedCells:
    """Up to k real cells of n policies, shape (n, k), and the t twin cells they are compared with, shape (n, t).

    A policy driven on two tasks counts as two. Shorter rows are padded with cells of weight 0.
    """

    twin_trials: Indices
    twin_successes: Indices
    twin_index: Indices
    """Column of the twin cell that each real cell is compared with, shape (n, k)."""
    real_trials: Indices
    real_successes: Indices
    weight: Array
    """1 for a real cell, 0 for padding, shape (n, k)."""
    strata: tuple[Indices, ...]
    """Indices of the policies of each task."""

    @property
    def policies(self) -> int:
        return len(self.weight)

    @property
    def cells(self) -> int:
        return int(self.weight.sum())


@dataclass(frozen=True)
class Rates:
    """Rates of one experiment, or of many along leading axes."""

    twin: Array
    """Mean rate of each policy's twin cells, shape (..., n)."""
    real: Array
    """Mean rate of each policy's real cells, shape (..., n)."""
    compatible: Array
    """Fraction of cells whose `rate_difference` has an interval that contains 0, shape (...)."""
    difference: Array
    """Mean over cells of real minus twin rate, shape (...)."""
    strata: tuple[Indices, ...]
    """As in `PairedCells`."""


def pair_cells(real: Sequence[Cell], twin: Mapping[tuple[str, str, str], Cell]) -> PairedCells:
    """Pairs real cells with the twin's cells (by key); policies are in order of first occurrence, task by task."""
    tasks = dict.fromkeys(cell.task for cell in real)
    policies = [p for task in tasks for p in dict.fromkeys((c.policy, c.task) for c in real if c.task == task)]
    rows = [[cell for cell in real if (cell.policy, cell.task) == policy] for policy in policies]
    shape = len(rows), max(map(len, rows))
    twin_index, weight = np.zeros(shape, np.int64), np.zeros(shape)
    twin_trials, real_trials = np.ones((2, *shape), np.int64)  # 1 in the padding, since rates are divided by them
    twin_successes, real_successes = np.zeros((2, *shape), np.int64)
    for i, row in enumerate(rows):
        keys = list(dict.fromkeys(cell.twin_key for cell in row))
        for j, key in enumerate(keys):
            twin_trials[i, j], twin_successes[i, j] = twin[key].trials, twin[key].successes
        for j, cell in enumerate(row):
            real_trials[i, j], real_successes[i, j] = cell.trials, cell.successes
            twin_index[i, j], weight[i, j] = keys.index(cell.twin_key), 1.0
    strata = tuple(np.array([i for i, (_, t) in enumerate(policies) if t == task]) for task in tasks)
    return PairedCells(twin_trials, twin_successes, twin_index, real_trials, real_successes, weight, strata)


def observed_rates(data: PairedCells, confidence: float = CONFIDENCE) -> Rates:
    """Rates of the experiment itself; shapes (n,) and ()."""
    return _rates(data, data.twin_successes, data.real_successes, np.arange(data.policies), confidence)


def resample(
    data: PairedCells, rng: np.random.Generator, replicates: int = REPLICATES, confidence: float = CONFIDENCE
) -> Rates:
    """Rates of bootstrap replicates; shapes (replicates, n) and (replicates,)."""
    which = np.empty((replicates, data.policies), np.int64)
    for members in data.strata:
        which[:, members] = members[rng.integers(len(members), size=(replicates, len(members)))]
    twin = rng.binomial(data.twin_trials[which], _shrunk(data.twin_successes, data.twin_trials)[which])
    real = rng.binomial(data.real_trials[which], _shrunk(data.real_successes, data.real_trials)[which])
    return _rates(data, twin, real, which, confidence)


def bootstrap_interval(value: float, replicates: Array, confidence: float = CONFIDENCE) -> tuple[float, float] | None:
    """Ends of the interval of a statistic with an observed value; None if more than half of the replicates are nan."""
    if np.isfinite(replicates).mean() < 0.5:
        return None
    low, high = np.nanquantile(replicates, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return min(float(low), value), max(float(high), value)


def mean_over_tasks(statistic: Callable[..., tuple[Array, Array]], rates: Rates) -> tuple[Array, Array]:
    """Mean over tasks of a pair of statistics that are defined only within a task."""
    each = [statistic(twin=rates.twin[..., members], real=rates.real[..., members]) for members in rates.strata]
    return np.mean([one[0] for one in each], 0), np.mean([one[1] for one in each], 0)


def _shrunk(successes: Indices, trials: Indices) -> Array:
    return (successes + 0.5) / (trials + 1.0)


def _rates(data: PairedCells, twin: Indices, real: Indices, which: Indices, confidence: float) -> Rates:
    """Rates of the policies `which` (..., n) with successes `twin` (..., n, t) and `real` (..., n, k)."""
    weight, index = data.weight[which], data.twin_index[which]
    twin_trials = np.take_along_axis(data.twin_trials[which], index, -1)
    twin_here = np.take_along_axis(twin, index, -1)
    difference, low, high = rate_difference(
        twin_successes=twin_here,
        twin_trials=twin_trials,
        real_successes=real,
        real_trials=data.real_trials[which],
        confidence=confidence,
    )
    total = weight.sum((-1, -2))
    return Rates(
        twin=(weight * twin_here / twin_trials).sum(-1) / weight.sum(-1),
        real=(weight * real / data.real_trials[which]).sum(-1) / weight.sum(-1),
        compatible=(weight * ((low <= 0.0) & (high >= 0.0))).sum((-1, -2)) / total,
        difference=(weight * difference).sum((-1, -2)) / total,
        strata=data.strata,
    )
