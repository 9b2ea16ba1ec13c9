"""Intervals with the day, the place, or the pair of trainings, as the unit.

For places, as in `twin.evaluation.agreement_intervals`, the estimand is the mean of a statistic over repeated
experiments; here each repetition also has new places. A place is left out with all its policies and days.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

from twin.evaluation.agreement_intervals import PairedCells, Statistic, interval_ends, jackknife_variance
from twin.evaluation.statistics import CONFIDENCE, UndefinedStatistic, wilson
from twin.types import Array

MIN_PLACES = 5
"""Number of places, or of pairs, below which there is no interval."""


def rate_over_days(rates: ArrayLike) -> tuple[float, float, float]:
    """Unweighted mean of the rates of k days, shape (k,), and the ends of its interval with the day as the unit.

    Trials of one day share its lighting and weather. The interval assumes that all trials of a day have the same
    outcome: with an intra-class correlation ρ of 1, the design effect 1 + (m − 1) ρ equals the number m of trials of a
    day (Kish, Survey Sampling, 1965, section 5.4), so k days count as k trials in Wilson's interval. If the trials of
    a day differ, the variance is smaller, so the interval is too wide rather than too narrow. It holds for further days
    of the same policies, not for further policies. Raises ValueError: no rate, or a rate outside [0, 1].
    """
    days = np.asarray(rates, float)
    if days.ndim != 1 or not len(days) or not ((days >= 0.0) & (days <= 1.0)).all():
        raise ValueError(f"rates of shape {days.shape}: expected one in [0, 1] per day, (k,), k ≥ 1")
    low, high = wilson(days.sum(), len(days))
    return float(days.mean()), float(low), float(high)


def place_interval(
    statistic: Statistic, places: Sequence[PairedCells], pooled: bool = False
) -> tuple[Array, Array, Array]:
    """A statistic over several places, and the ends of its interval with the place as the unit, shapes (...).

    The value is the mean of the statistics of the single places; if `pooled`, it is the statistic of the policies of
    all places together. Raises UndefinedStatistic as `jackknife_interval` does.
    """
    if len(places) < MIN_PLACES:
        raise UndefinedStatistic(f"too few for an interval: {len(places)} places, {MIN_PLACES} are needed")
    each = [place.rates() for place in places]

    def of(kept: Sequence[dict[str, Array]]) -> Array:
        if not pooled:
            return np.asarray(np.mean([statistic.of(**rates) for rates in kept], 0))
        return statistic.of(**{key: np.concatenate([rates[key] for rates in kept], -1) for key in ("twin", "real")})

    value = of(each)
    left_out = np.stack([statistic.scale(of([*each[:i], *each[i + 1 :]])) for i in range(len(each))])
    low, high = interval_ends(statistic, value, jackknife_variance(left_out), np.asarray(len(places) - 1.0))
    return value, low, high


def mean_difference_interval(
    differences: Array, limits: tuple[float, float] = (-1.0, 1.0)
) -> tuple[float, float, float]:
    """Mean difference of two training setups, and the ends of its interval by Student's t.

    Args:
        differences: One value per pair of trainings or per place, shape (n,).
        limits: The interval is clipped to these; by default, those of a difference of rates.

    Raises:
        UndefinedStatistic: there are fewer than `MIN_PLACES` differences, or all are equal.
    """
    n = len(differences)
    if n < MIN_PLACES:
        raise UndefinedStatistic(f"too few for an interval: {n} pairs, {MIN_PLACES} are needed")
    mean, error = float(np.mean(differences)), float(np.std(differences, ddof=1) / np.sqrt(n))
    if error < 1e-9:
        raise UndefinedStatistic("no interval: all pairs differ by the same amount")
    half = float(student.ppf(0.5 + CONFIDENCE / 2, n - 1)) * error
    return mean, max(mean - half, limits[0]), min(mean + half, limits[1])
