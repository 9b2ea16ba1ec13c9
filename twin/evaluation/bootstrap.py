"""What the same experiment would show if it were done again: resampling of policies and of trials.

Policies are drawn with replacement, within each task, as policies of the same kind would be drawn; then every trial of
theirs, in both worlds, is driven again at its cell's rate (shrunk by half a trial towards one half, Jeffreys' posterior
mean, so that a rate of 0 or 1 is not taken for certain). A statistic's *interval* is the middle 90 % of its values,
widened to what was seen where that lies outside: a repetition of a repetition adds the noise of the trials once more.

It aims at what the statistic is on average over such experiments, with as many trials a cell. The noise of few trials
is part of it and takes from a correlation as it always does: nothing is claimed that was not seen. With few cells of
ten trials or more it errs to the wide side, except where the twin hardly tells a good policy from a bad one: 0.80 at
least. With twenty days of five trials, most of them all or none, it is too narrow: cells driven again at a shrunk rate
agree less than what was seen, and it contains Spearman's in 0.6, Pearson's in 0.75 to 0.8 and MMRV in 0.5 to 0.6 of the
experiments instead of in 0.9 (`benchmarks/intervals.py`, without and with `--record`).
Narrower ones were tried: resampling policies alone covers 0.6 to 0.9 with a dozen of them, moving the interval's middle
to what was seen 0.73 to 0.9 for Spearman's correlation, and freeing the rates of noise by a hierarchical model gives
what its prior says.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from twin.evaluation.statistics import CONFIDENCE, rate_difference
from twin.evaluation.trials import Cell
from twin.types import Array, Indices

DRAWS = 2000
"""Experiments resampled."""


@dataclass(frozen=True)
class Paired:
    """n policies driven in both worlds, on one task or several; each has up to k real cells and their twin's cells.

    A policy driven on two tasks is two of them. Rows shorter than k are filled with cells of weight 0.
    """

    twin_trials: Indices
    """Of each policy's cells in the twin, each cell once; shape (n, t)."""
    twin_successes: Indices
    """Shape (n, t)."""
    twin_of: Indices
    """Which twin cell each real cell is compared with; shape (n, k)."""
    real_trials: Indices
    """Shape (n, k)."""
    real_successes: Indices
    """Shape (n, k)."""
    weight: Array
    """1 where there is a cell, else 0; shape (n, k)."""
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
    """What one experiment, or each of many, has seen."""

    twin: Array
    """Score of each policy, the mean over its cells; shape (..., n)."""
    real: Array
    """Shape (..., n)."""
    inside: Array
    """Share of the cells whose difference is compatible with none (`rate_difference`), shape (...)."""
    difference: Array
    """Mean over cells of real minus twin, shape (...)."""
    strata: tuple[Indices, ...]


def paired(real: Sequence[Cell], twin: Sequence[Cell]) -> Paired:
    """Real cells with the twin's cells they are compared with, policies in order of first occurrence, task by task."""
    found = {cell.key: cell for cell in twin}
    tasks = dict.fromkeys(cell.task for cell in real)
    policies = [p for task in tasks for p in dict.fromkeys((c.policy, c.task) for c in real if c.task == task)]
    rows = [[cell for cell in real if (cell.policy, cell.task) == policy] for policy in policies]
    shape = len(rows), max(map(len, rows))
    twin_of, weight = np.zeros(shape, np.int64), np.zeros(shape)
    # Trials of 1 where there is no cell: it must divide, and counts for nothing.
    counts = {name: np.full(shape, int("trials" in name), np.int64) for name in ("rt_trials", "rs", "tt_trials", "ts")}
    for i, row in enumerate(rows):
        keys = list(dict.fromkeys(cell.twin_key for cell in row))
        for j, key in enumerate(keys):
            counts["tt_trials"][i, j], counts["ts"][i, j] = found[key].trials, found[key].successes
        for j, cell in enumerate(row):
            counts["rt_trials"][i, j], counts["rs"][i, j] = cell.trials, cell.successes
            twin_of[i, j], weight[i, j] = keys.index(cell.twin_key), 1.0
    strata = tuple(np.array([i for i, (_, t) in enumerate(policies) if t == task]) for task in tasks)
    return Paired(counts["tt_trials"], counts["ts"], twin_of, counts["rt_trials"], counts["rs"], weight, strata)


def seen(data: Paired, confidence: float = CONFIDENCE) -> Rates:
    """What the experiment itself has seen; shapes (n,) and ()."""
    return _rates(data, data.twin_successes, data.real_successes, np.arange(data.policies), confidence)


def resample(data: Paired, rng: np.random.Generator, draws: int = DRAWS, confidence: float = CONFIDENCE) -> Rates:
    """What `draws` repetitions see; shapes (draws, n) and (draws,). See the module."""
    which = np.empty((draws, data.policies), np.int64)
    for members in data.strata:
        which[:, members] = members[rng.integers(len(members), size=(draws, len(members)))]
    twin = rng.binomial(data.twin_trials[which], _shrunk(data.twin_successes, data.twin_trials)[which])
    real = rng.binomial(data.real_trials[which], _shrunk(data.real_successes, data.real_trials)[which])
    return _rates(data, twin, real, which, confidence)


def interval(value: float, again: Array, confidence: float = CONFIDENCE) -> tuple[float, float] | None:
    """Ends of the interval of a statistic that came out as `value`; see the module.

    Args:
        value: Of the experiment itself.
        again: Of its repetitions, shape (draws,); nan where it is not defined.
        confidence: Of the interval.

    Returns:
        None where less than half of the repetitions are defined.
    """
    if np.isfinite(again).mean() < 0.5:
        return None
    low, high = np.nanquantile(again, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return min(float(low), value), max(float(high), value)


def by_task(statistic: Callable[..., tuple[Array, Array]], rates: Rates) -> tuple[Array, Array]:
    """A pair of statistics that makes sense within a task only, averaged over tasks."""
    each = [statistic(twin=rates.twin[..., members], real=rates.real[..., members]) for members in rates.strata]
    return np.mean([one[0] for one in each], 0), np.mean([one[1] for one in each], 0)


def _shrunk(successes: Indices, trials: Indices) -> Array:
    return (successes + 0.5) / (trials + 1.0)


def _rates(data: Paired, twin: Indices, real: Indices, which: Indices, confidence: float) -> Rates:
    """`twin` (..., n, t) and `real` (..., n, k) are successes of the policies `which` (..., n)."""
    weight, of = data.weight[which], data.twin_of[which]
    twin_trials = np.take_along_axis(data.twin_trials[which], of, -1)
    twin_here = np.take_along_axis(twin, of, -1)
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
        inside=(weight * ((low <= 0.0) & (high >= 0.0))).sum((-1, -2)) / total,
        difference=(weight * difference).sum((-1, -2)) / total,
        strata=data.strata,
    )
