"""Success rates and how well one set of them predicts another: closed forms, no randomness, no files.

A *rate* is successes over trials; its *interval* is meant to hold the true rate with probability `CONFIDENCE`. *Twin
scores* and *real scores* are the rates of the same policies in the twin and on the road, in the same order, along the
last axis; any leading axes are separate experiments. The two worlds are not interchangeable (regret and rank violations
are counted in real points), so every function takes them by keyword only.

A statistic that the numbers do not allow is *refused*: `Refused` says why. The functions ending in `_rows` are the same
statistics over leading axes and give nan there instead; they are for resampling.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm, rankdata

from twin.types import Array

CONFIDENCE = 0.9
"""Of every interval."""
MIN_POLICIES = 5
"""Fewer are refused a correlation."""
MIN_TRIALS = 5
"""Cells of fewer trials are refused a correlation."""

_DEFINED = 3  # points below which a correlation is no statement at all
_DIGITS = 12  # scores that agree to so many decimals are tied, however they were summed


class Refused(ValueError):
    """A statistic that these numbers do not allow; the message says why and what is missing."""


# ---- rates


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Score interval of a rate: Wilson (1927); eq. 4 of Brown, Cai and DasGupta, Statistical Science 16 (2001).

    Args:
        successes: Need not be whole (see `mean_rate`), any shape.
        trials: Positive, same shape.
        confidence: Of the interval.

    Returns:
        Lower and upper end, in [0, 1].
    """
    n = np.asarray(trials, float)
    p = np.asarray(successes, float) / n
    z2 = norm.ppf(0.5 + confidence / 2) ** 2
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n**2))) / (1 + z2 / n)
    return np.maximum(centre - half, 0.0), np.minimum(centre + half, 1.0)


def mean_rate(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Mean of the rates of k cells (lightings), each counting alike whatever its trials, and its interval.

    The interval is Wilson's for the number of trials whose binomial variance the mean would have if all rates were
    equal, k² / Σ 1/nᵢ; unequal rates have less variance, so it errs to the wide side.

    Args:
        successes: Shape (k,).
        trials: Positive, shape (k,).
        confidence: Of the interval.

    Returns:
        Mean, lower and upper end.
    """
    n = np.asarray(trials, float)
    mean = float(np.mean(np.asarray(successes, float) / n))
    effective = len(n) ** 2 / np.sum(1.0 / n)
    low, high = wilson(mean * effective, effective, confidence)
    return mean, float(low), float(high)


def share(won: int, trials: int) -> dict[str, Any]:
    """Successes, trials, rate and its interval, JSON-able; the rate is None without trials."""
    if not trials:
        return {"successes": 0, "trials": 0, "rate": None, "low": 0.0, "high": 1.0}
    low, high = wilson(won, trials)
    return {"successes": won, "trials": trials, "rate": won / trials, "low": float(low), "high": float(high)}


def rate_over_days(rates: ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Mean of the rates of k days, each counting alike, and its interval with the day as the unit.

    Trials of one day share its light and weather and tend to end alike. The interval allows them to agree entirely:
    with an intra-class correlation of 1 the design effect 1 + (m − 1) ρ equals the m trials of a day (Kish, Survey
    Sampling, 1965, section 5.4), so k days count as k trials, and the interval is Wilson's for these. Rates between
    0 and 1 have less variance than successes and failures of the same mean, so it errs to the wide side. It is about
    further days for the same policies, not about further policies.

    Args:
        rates: In [0, 1], one per day, shape (k,). A day's rate is the mean over all its trials, of all policies.
        confidence: Of the interval.

    Returns:
        Mean, lower and upper end.

    Raises:
        ValueError: no day, or a rate outside [0, 1].
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

    Args:
        twin_successes: Any shape; the others have the same.
        twin_trials: Positive.
        real_successes: Likewise.
        real_trials: Positive.
        confidence: Of the interval.

    Returns:
        Difference, lower and upper end, in [−1, 1].
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
    """Pearson's correlation of scores, shapes (n,). Raises Refused: n < 3, or scores that are all the same."""
    twin, real = _checked(twin, real)
    return float(pearson_rows(twin=twin, real=real))


def spearman(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Pearson's correlation of ranks, tied scores sharing their mean rank. Raises Refused as `pearson` does."""
    twin, real = _checked(twin, real)
    return float(spearman_rows(twin=twin, real=real))


def mmrv(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Mean maximum rank violation, 0 at best and 1 at worst: SIMPLER (Li et al., arXiv 2405.05941), section on metrics.

    A pair of policies is violated where the twin orders it otherwise than the road, by as much as their real scores
    differ: |Rᵢ − Rⱼ| · 1[(Sᵢ < Sⱼ) ≠ (Rᵢ < Rⱼ)]; MMRV is the mean over i of the largest over j. It is not symmetric in
    its arguments, and code in circulation names them in both orders. Policies tied in the twin, but not on the road,
    count as a violation of the worse of the two; code published with the paper compares by > and charges the better.

    Raises:
        Refused: fewer than two policies.
    """
    twin, real = _checked(twin, real, needed=2, varied=False)
    return float(mmrv_rows(twin=twin, real=real))


def winner_agreement(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Whether the twin's best policy is the road's best: 1 or 0; of policies tied in the twin, the share that is.

    Raises:
        Refused: fewer than two policies.
    """
    twin, real = _checked(twin, real, needed=2, varied=False)
    return float(winner_rows(twin=twin, real=real)[0])


def winner_regret(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Real success lost by taking the twin's best policy instead of the road's, in [0, 1]; the mean over twin's ties.

    Raises:
        Refused: fewer than two policies.
    """
    twin, real = _checked(twin, real, needed=2, varied=False)
    return float(winner_rows(twin=twin, real=real)[1])


def pearson_rows(*, twin: Array, real: Array) -> Array:
    """`pearson` over leading axes, shape (..., n) → (...); nan where scores are all the same."""
    x = twin - twin.mean(-1, keepdims=True)
    y = real - real.mean(-1, keepdims=True)
    scale = np.sqrt((x * x).sum(-1) * (y * y).sum(-1))
    flat = (np.ptp(_rounded(twin), -1) == 0) | (np.ptp(_rounded(real), -1) == 0)
    return np.where(flat, np.nan, np.clip((x * y).sum(-1) / np.where(flat, 1.0, scale), -1.0, 1.0))


def spearman_rows(*, twin: Array, real: Array) -> Array:
    """`spearman` over leading axes, shape (..., n) → (...); nan where scores are all the same."""
    return pearson_rows(twin=rankdata(_rounded(twin), axis=-1), real=rankdata(_rounded(real), axis=-1))


def mmrv_rows(*, twin: Array, real: Array) -> Array:
    """`mmrv` over leading axes, shape (..., n) → (...)."""
    twin, real = _rounded(twin), _rounded(real)
    violated = (twin[..., :, None] < twin[..., None, :]) != (real[..., :, None] < real[..., None, :])
    by = np.abs(real[..., :, None] - real[..., None, :])
    return (by * violated).max(-1).mean(-1)


def winner_rows(*, twin: Array, real: Array) -> tuple[Array, Array]:
    """`winner_agreement` and `winner_regret` over leading axes, shape (..., n) → (...) each."""
    twin, real = _rounded(twin), _rounded(real)
    chosen = twin == twin.max(-1, keepdims=True)
    best = real.max(-1, keepdims=True)
    share = chosen / chosen.sum(-1, keepdims=True)
    return (share * (real == best)).sum(-1), (share * (best - real)).sum(-1)


def _rounded(scores: Array) -> Array:
    return np.round(scores, _DIGITS)


def _checked(twin: ArrayLike, real: ArrayLike, needed: int = _DEFINED, varied: bool = True) -> tuple[Array, Array]:
    twin, real = np.asarray(twin, float), np.asarray(real, float)
    if twin.ndim != 1 or twin.shape != real.shape:
        raise ValueError(f"scores of shapes {twin.shape} and {real.shape}: expected one per policy in each, (n,)")
    if not (np.isfinite(twin).all() and np.isfinite(real).all()):
        raise ValueError("a score is not a number")
    if len(twin) < needed:
        raise Refused(f"{len(twin)} policies; at least {needed} are needed for this to be defined")
    for name, scores in (("in the twin", twin), ("on the road", real)):
        if varied and np.ptp(_rounded(scores)) == 0:
            raise Refused(f"all rates {name} are {scores[0]:.3g}; a correlation needs rates that differ")
    return twin, real
