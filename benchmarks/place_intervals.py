"""Intervals with the place, or the pair of trainings, as the unit.

As in `twin.evaluation.statistic_intervals`, the estimand is the mean of a statistic over repeated experiments; here
each repetition also has new places. A place is left out with all its policies and days.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from twin.evaluation.statistic_intervals import PairedCells, Statistic, interval_ends, jackknife_variance
from twin.evaluation.statistics import CONFIDENCE, UndefinedStatistic
from twin.types import Array

MIN_PLACES = 5
"""Number of places, or of pairs, below which there is no interval."""


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
