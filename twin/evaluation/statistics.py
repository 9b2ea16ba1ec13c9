"""Success rates with intervals; Spearman, Pearson, MMRV and regret of twin against real scores, in closed form.

A *rate* is successes over trials; its interval contains the true rate with probability `CONFIDENCE`. *Twin scores* and
*real scores* are rates of the same policies in the twin and on the road, in the same order, along the last axis;
leading axes are separate experiments. Twin and real are keyword-only, as they are not interchangeable (regret and rank
violations are differences of real rates).

Functions raise `UndefinedStatistic` where the data do not determine the statistic. Those ending in `_batched` compute
it over leading axes for resampling, and return nan there instead.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm, rankdata

from twin.types import Array

CONFIDENCE = 0.9
"""Confidence level of every interval."""
MIN_POLICIES = 5
"""Number of policies below which no correlation is given."""
MIN_TRIALS = 5
"""Number of trials per cell below which no correlation is given."""

_MIN_POINTS = 3  # below it a correlation says nothing
_DECIMALS = 12  # scores equal to so many decimals are tied, in whatever order they were summed


class UndefinedStatistic(ValueError):
    """The data do not determine a statistic; the message gives the reason and what is missing."""


# ---- rates


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Score interval of a rate: Wilson (1927); eq. 4 of Brown, Cai and DasGupta, Statistical Science 16 (2001).

    Successes (any shape) need not be integers, see `mean_rate`; trials are positive. Returns lower and upper end.
    """
    n = np.asarray(trials, float)
    p = np.asarray(successes, float) / n
    z2 = norm.ppf(0.5 + confidence / 2) ** 2
    center = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n**2))) / (1 + z2 / n)
    return np.maximum(center - half, 0.0), np.minimum(center + half, 1.0)


def mean_rate(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Unweighted mean of the rates of k cells (lightings), and its interval.

    The interval is Wilson's for the effective number of trials k² / Σ 1/nᵢ, at which a binomial rate has the mean's
    variance if all rates are equal; unequal rates have less variance, so the interval errs to the wide side.
    Successes and trials (positive) have shape (k,). Returns mean, lower and upper end.
    """
    n = np.asarray(trials, float)
    mean = float(np.mean(np.asarray(successes, float) / n))
    effective = len(n) ** 2 / np.sum(1.0 / n)
    low, high = wilson(mean * effective, effective, confidence)
    return mean, float(low), float(high)


def rate_summary(won: int, trials: int) -> dict[str, Any]:
    """Successes, trials, rate and its interval, JSON-able; the rate is None without trials."""
    if not trials:
        return {"successes": 0, "trials": 0, "rate": None, "low": 0.0, "high": 1.0}
    low, high = wilson(won, trials)
    return {"successes": won, "trials": trials, "rate": won / trials, "low": float(low), "high": float(high)}


def rate_over_days(rates: ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Unweighted mean of the rates of k days, and its interval with the day as the unit.

    Trials of one day share its lighting and weather and tend to have the same outcome. The interval assumes that they
    agree entirely: with an intra-class correlation of 1 the design effect 1 + (m − 1) ρ equals the m trials of a day
    (Kish, Survey Sampling, 1965, section 5.4), so k days count as k trials, and the interval is Wilson's for these.
    Rates between 0 and 1 have less variance than successes and failures of the same mean, so it errs to the wide side.
    It holds for further days of the same policies, not for further policies. `rates` (k,) has one rate per day in
    [0, 1], the mean over all its trials of all policies. Returns mean, lower and upper end.

    Raises:
        ValueError: `rates` is empty, or a rate is outside [0, 1].
    """
    days = np.asarray(rates, float)
    if days.ndim != 1 or not len(days) or not ((days >= 0.0) & (days <= 1.0)).all():
        raise ValueError(f"rates of shape {days.shape}: expected one in [0, 1] per day, (k,), k ≥ 1")
    low, high = wilson(days.sum(), len(days), confidence)
    return float(days.mean()), float(low), float(high)


def rate_difference(
    *,
    twin_successes: ArrayLike,
    twin_trials: ArrayLike,
    real_successes: ArrayLike,
    real_trials: ArrayLike,
    confidence: float = CONFIDENCE,
) -> tuple[Array, Array, Array]:
    """Real rate minus twin rate, and its interval: Newcombe's hybrid score (method 10).

    R. G. Newcombe, Interval estimation for the difference between independent proportions, Stat. in Medicine 17 (1998).
    All counts have the same shape, trials are positive. Returns difference, lower and upper end, in [−1, 1].
    """
    twin = np.asarray(twin_successes, float) / np.asarray(twin_trials, float)
    real = np.asarray(real_successes, float) / np.asarray(real_trials, float)
    twin_low, twin_high = wilson(twin_successes, twin_trials, confidence)
    real_low, real_high = wilson(real_successes, real_trials, confidence)
    low = np.sqrt((real - real_low) ** 2 + (twin_high - twin) ** 2)
    high = np.sqrt((real_high - real) ** 2 + (twin - twin_low) ** 2)
    return real - twin, real - twin - low, real - twin + high


# ---- agreement of scores


def pearson(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Pearson's correlation of scores, shapes (n,). Raises UndefinedStatistic: n < 3, or all scores are equal."""
    twin, real = _validated(twin, real)
    return float(pearson_batched(twin=twin, real=real))


def spearman(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Pearson's correlation of ranks; tied scores share their mean rank. Raises UndefinedStatistic as `pearson`."""
    twin, real = _validated(twin, real)
    return float(spearman_batched(twin=twin, real=real))


def mmrv(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Mean maximum rank violation in [0, 1], 0 is best: SIMPLER (Li et al., arXiv 2405.05941), section on metrics.

    The violation of a pair of policies that twin and road order differently is the difference of their real scores:
    |Rᵢ − Rⱼ| · 1[(Sᵢ < Sⱼ) ≠ (Rᵢ < Rⱼ)]; MMRV is the mean over i of the largest over j. It is not symmetric in its
    arguments, and published code names them in both orders. Policies tied in the twin, but not on the road, count as a
    violation of the worse of the two; code published with the paper compares by > and charges the better.

    Raises:
        UndefinedStatistic: fewer than two policies.
    """
    twin, real = _validated(twin, real, needed=2, varied=False)
    return float(mmrv_batched(twin=twin, real=real))


def winner_agreement(*, twin: ArrayLike, real: ArrayLike) -> float:
    """1 if the twin's best policy is the road's best, else 0; the mean over policies tied as best in the twin.
    Raises UndefinedStatistic: fewer than two policies.
    """
    twin, real = _validated(twin, real, needed=2, varied=False)
    return float(winner_batched(twin=twin, real=real)[0])


def winner_regret(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Regret in [0, 1]: real rate of the road's best policy minus that of the twin's best; the mean over twin's ties.
    Raises UndefinedStatistic: fewer than two policies.
    """
    twin, real = _validated(twin, real, needed=2, varied=False)
    return float(winner_batched(twin=twin, real=real)[1])


def pearson_batched(*, twin: Array, real: Array) -> Array:
    """`pearson` over leading axes, shape (..., n) → (...); nan where all scores are equal."""
    x = twin - twin.mean(-1, keepdims=True)
    y = real - real.mean(-1, keepdims=True)
    scale = np.sqrt((x * x).sum(-1) * (y * y).sum(-1))
    flat = (np.ptp(_rounded(twin), -1) == 0) | (np.ptp(_rounded(real), -1) == 0)
    return np.where(flat, np.nan, np.clip((x * y).sum(-1) / np.where(flat, 1.0, scale), -1.0, 1.0))


def spearman_batched(*, twin: Array, real: Array) -> Array:
    """`spearman` over leading axes, shape (..., n) → (...); nan where all scores are equal."""
    return pearson_batched(twin=rankdata(_rounded(twin), axis=-1), real=rankdata(_rounded(real), axis=-1))


def mmrv_batched(*, twin: Array, real: Array) -> Array:
    """`mmrv` over leading axes, shape (..., n) → (...)."""
    twin, real = _rounded(twin), _rounded(real)
    violated = (twin[..., :, None] < twin[..., None, :]) != (real[..., :, None] < real[..., None, :])
    size = np.abs(real[..., :, None] - real[..., None, :])
    return (size * violated).max(-1).mean(-1)


def winner_batched(*, twin: Array, real: Array) -> tuple[Array, Array]:
    """`winner_agreement` and `winner_regret` over leading axes, shape (..., n) → (...) each."""
    twin, real = _rounded(twin), _rounded(real)
    chosen = twin == twin.max(-1, keepdims=True)
    best = real.max(-1, keepdims=True)
    share = chosen / chosen.sum(-1, keepdims=True)
    return (share * (real == best)).sum(-1), (share * (best - real)).sum(-1)


def _rounded(scores: Array) -> Array:
    return np.round(scores, _DECIMALS)


def _validated(twin: ArrayLike, real: ArrayLike, needed: int = _MIN_POINTS, varied: bool = True) -> tuple[Array, Array]:
    twin, real = np.asarray(twin, float), np.asarray(real, float)
    if twin.ndim != 1 or twin.shape != real.shape:
        raise ValueError(f"scores of shapes {twin.shape} and {real.shape}: expected one per policy in each, (n,)")
    if not (np.isfinite(twin).all() and np.isfinite(real).all()):
        raise ValueError("a score is not a number")
    if len(twin) < needed:
        raise UndefinedStatistic(f"{len(twin)} policies; at least {needed} are needed for this to be defined")
    for name, scores in (("in the twin", twin), ("on the road", real)):
        if varied and np.ptp(_rounded(scores)) == 0:
            raise UndefinedStatistic(f"all rates {name} are {scores[0]:.3g}; a correlation needs rates that differ")
    return twin, real
