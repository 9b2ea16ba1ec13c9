"""Intervals of statistics that compare rates in the twin and on the road, by a jackknife over trainings and days.

The *estimand* of an interval is the mean of the statistic over repeated experiments at the same place, each with the
same numbers of new trainings, days and trials. For a mean rate or a bias, this is the value in the population. For a
correlation, MMRV (`statistics.mmrv`) or regret, it is the average result of such an experiment, including the noise of
its few days and trials. An interval says nothing about the measured policies on the measured days.

Units vary independently of each other: a *training* (checkpoints of a run are one unit), and a *day* (a lighting of the
real trials, left out of the twin and the road together). They are crossed, so the variance is that of two-way
clustering (Cameron, Gelbach and Miller, J. Bus. Econ. Stat. 29, 2011); each part is computed by leaving one unit out
(Efron and Stein 1981):

    V = V_training + V_day − V_both / 2        for the bias, − V_both

V_both is the variance from leaving out one training on one day; V_training and V_day each contain it. For a linear
statistic of many units, such as the bias, all of V_both is subtracted. For the other statistics, subtracting all made
intervals too narrow where leaving out a unit changes ranks, and subtracting nothing made them too wide
(`benchmarks/intervals.py`). V cannot be smaller than V_training or V_day, but its estimate may be, or even be negative,
which would make intervals much too narrow. So V is at least 0.7 times the larger of V_training and V_day; with the
factor 1, intervals were too wide.

The interval is the estimate ± Student's t times √V, on a scale on which the statistic is less skewed. The degrees of
freedom are Satterthwaite's, but at least (trainings − 1) / 2, since few days made intervals too wide, and at most
trainings + days − 2. There is no interval for fewer units than its coverage was tested for, nor if leaving units
out changes nothing, since the variance cannot be estimated then.

90 % intervals by a bootstrap had a coverage of only 0.5 to 0.8: policies that it samples twice raise correlations, and
trials that it resamples lower the agreement of twin and real rates.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from twin.evaluation.statistics import CONFIDENCE, UndefinedStatistic, mmrv_batched, pearson_batched, spearman_batched
from twin.evaluation.trials import Cell
from twin.types import Array, Indices

MIN_TRAININGS, MIN_DAYS = 8, 4
"""Least numbers of trainings and days for an interval. Pearson's correlation and the bias have their own, see below."""
MIN_PEARSON_TRAININGS = 12
"""Number of trainings below which Pearson's correlation has no interval, since a single policy may determine it."""
MIN_BIAS_TRAININGS, MIN_BIAS_DAYS = 5, 3
"""Numbers of trainings and days below which a mean difference at one place has no interval."""

_SHARE_OF_BOTH = 0.5  # fraction of V_both that is subtracted; see the module's docstring
_LEAST_SHARE = 0.7  # smallest variance, as a fraction of the larger of V_training and V_day
_LARGEST = 0.999  # correlations are clipped to ± this before Fisher's transform


@dataclass(frozen=True)
class PairedCells:
    """Up to k real cells of each of n policies, and the twin's cells with which they are compared.

    A policy driven on two tasks counts as two policies. Policies with fewer cells are padded with cells of weight 0.
    Rates may have leading axes, for separate experiments of the same design.
    """

    twin: Array
    """Rate of the twin's cell with which each real cell is compared, shape (..., n, k)."""
    real: Array
    """Rate of each real cell, shape (..., n, k)."""
    weight: Array
    """1 for a real cell, 0 for padding, shape (n, k)."""
    training: Indices
    """Index of each policy's training, shape (n,)."""
    day: Indices
    """Index of each cell's day, shape (n, k)."""
    strata: tuple[Indices, ...]
    """Indices of the policies of each task."""

    @property
    def policies(self) -> int:
        return len(self.weight)

    @property
    def cells(self) -> int:
        return int(self.weight.sum())

    @property
    def trainings(self) -> int:
        return len(np.unique(self.training))

    @property
    def days(self) -> int:
        return len(np.unique(self.day[self.weight > 0]))

    def rates(self, kept: Array | None = None) -> dict[str, Array]:
        """Mean twin and real rates of the policies, shapes (..., n), over the cells in the mask `kept` (n, k).

        Policies without a kept cell are left out.
        """
        weight = self.weight if kept is None else self.weight * kept
        total = weight.sum(-1)
        rows = total > 0
        means = ((weight * rate)[..., rows, :].sum(-1) / total[rows] for rate in (self.twin, self.real))
        return dict(zip(("twin", "real"), means, strict=True))


def training_of(policy: str) -> str:
    """Name of the training of a policy: checkpoints are named `<run>/<step>`."""
    return policy.partition("/")[0]


def policy_rows(real: Sequence[Cell]) -> list[list[Cell]]:
    """Real cells of each policy; policies are ordered by task, then by first occurrence."""
    tasks = dict.fromkeys(cell.task for cell in real)
    policies = [p for task in tasks for p in dict.fromkeys((c.policy, c.task) for c in real if c.task == task)]
    return [[cell for cell in real if (cell.policy, cell.task) == policy] for policy in policies]


def pair_cells(real: Sequence[Cell], twin: Mapping[tuple[str, str, str], Cell]) -> PairedCells:
    """Pairs real cells with the twin's cells, given by key; rows are those of `policy_rows`."""
    rows = policy_rows(real)
    shape = len(rows), max(map(len, rows))
    twin_rate, real_rate, weight = np.zeros((3, *shape))
    day = np.zeros(shape, np.int64)
    days = list(dict.fromkeys(cell.lighting for cell in real))
    for i, row in enumerate(rows):
        for j, cell in enumerate(row):
            twin_rate[i, j], real_rate[i, j], weight[i, j] = twin[cell.twin_key].rate, cell.rate, 1.0
            day[i, j] = days.index(cell.lighting)
    runs, tasks = [training_of(row[0].policy) for row in rows], [row[0].task for row in rows]
    trainings = list(dict.fromkeys(runs))
    training = np.array([trainings.index(run) for run in runs])
    strata = tuple(np.array([i for i, t in enumerate(tasks) if t == task]) for task in dict.fromkeys(tasks))
    return PairedCells(twin_rate, real_rate, weight, training, day, strata)


# ---- statistics and their scales


@dataclass(frozen=True)
class Statistic:
    """A statistic of policies' rates, and the scale on which its interval is symmetric."""

    of: Callable[..., Array]
    """Function of `twin` and `real`, shapes (..., n) → (...)."""
    scale: Callable[[Array], Array]
    inverse: Callable[[Array], Array]
    low: float
    high: float
    """Limits of the interval."""
    linear: bool = False
    """True for a mean of differences, for which V_both is subtracted entirely."""
    trainings: int = MIN_TRAININGS
    days: int = MIN_DAYS
    """Numbers of units below which there is no interval."""


def _identity(value: Array) -> Array:
    return value


def _arcsine(value: Array) -> Array:
    return np.asarray(np.arcsin(np.clip(value, -1.0, 1.0)))


def _sine(value: Array) -> Array:
    return np.asarray(np.sin(np.clip(value, -np.pi / 2, np.pi / 2)))


def _fisher(value: Array) -> Array:
    return np.asarray(np.arctanh(np.clip(value, -_LARGEST, _LARGEST)))


def mean_bias(*, twin: Array, real: Array) -> Array:
    """Mean over policies of real minus twin rate, shapes (..., n) → (...)."""
    return np.asarray((real - twin).mean(-1))


STATISTICS = {
    "pearson": Statistic(pearson_batched, _fisher, np.tanh, -1.0, 1.0, trainings=MIN_PEARSON_TRAININGS),
    "spearman": Statistic(spearman_batched, _arcsine, _sine, -1.0, 1.0),
    "mmrv": Statistic(mmrv_batched, _identity, _identity, 0.0, 1.0),
    "bias": Statistic(mean_bias, _identity, _identity, -1.0, 1.0, True, MIN_BIAS_TRAININGS, MIN_BIAS_DAYS),
}
"""Statistics that have intervals. Regret and agreement of the winner have none for a single place, since they depend on
the best policy alone."""


# ---- intervals


def jackknife_interval(statistic: Statistic, data: PairedCells) -> tuple[Array, Array]:
    """Ends of the interval of a statistic at one place, shapes (...).

    If the variance cannot be estimated, the ends are nan for one of several experiments (leading axes).

    Raises UndefinedStatistic: there are too few units; or, for a single experiment, the variance cannot be estimated.
    """
    trainings, days = data.trainings, data.days
    lacking = [
        f"{count} {what if count != 1 else what[:-1]}, {needed} are needed"
        for what, count, needed in (("trainings", trainings, statistic.trainings), ("days", days, statistic.days))
        if count < needed
    ]
    if lacking:
        raise UndefinedStatistic(f"too few for an interval: {'; '.join(lacking)}")
    of_training = [(data.training != t)[:, None] & np.ones_like(data.day, bool) for t in np.unique(data.training)]
    of_day = [data.day != d for d in np.unique(data.day[data.weight > 0])]
    both = [t | d for t in of_training for d in of_day]
    with np.errstate(invalid="ignore", divide="ignore"):
        each = [[statistic.of(**data.rates(kept)) for kept in units] for units in (of_training, of_day, both)]
        parts = [jackknife_variance(np.stack([statistic.scale(value) for value in values])) for values in each]
        variance = parts[0] + parts[1] - (1.0 if statistic.linear else _SHARE_OF_BOTH) * parts[2]
        variance = np.maximum(variance, _LEAST_SHARE * np.maximum(parts[0], parts[1]))
        freedom = variance**2 / (parts[0] ** 2 / (trainings - 1) + parts[1] ** 2 / (days - 1))
    freedom = np.clip(freedom, (trainings - 1) / 2, trainings + days - 2)
    return interval_ends(statistic, statistic.of(**data.rates()), variance, freedom)


def jackknife_variance(left_out: Array) -> Array:
    """Variance of a statistic, shape (...), from the m values that leave out one unit each, shape (m, ...)."""
    m = len(left_out)
    return np.asarray((m - 1) / m * ((left_out - left_out.mean(0)) ** 2).sum(0))


def interval_ends(statistic: Statistic, value: Array, variance: Array, freedom: Array) -> tuple[Array, Array]:
    """Ends of a statistic's interval by Student's t, from variance and degrees of freedom on its scale, shapes (...).

    Where the variance is zero or nan, the ends are nan. Raises UndefinedStatistic in that case if `variance` is a
    scalar.
    """
    variance = np.where(variance > 1e-18, variance, np.nan)
    if np.ndim(variance) == 0 and np.isnan(variance):
        raise UndefinedStatistic(
            "no interval: the variance cannot be estimated, since leaving out units does not change the value, or "
            "leaves rates that are all equal"
        )
    half = student.ppf(0.5 + CONFIDENCE / 2, freedom) * np.sqrt(variance)
    center = statistic.scale(value)
    low, high = statistic.inverse(center - half), statistic.inverse(center + half)
    return np.maximum(low, statistic.low), np.minimum(high, statistic.high)
