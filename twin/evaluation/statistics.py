"""Statistics of success rates in closed form: intervals, agreement of twin and road, prediction of real rates.

A *rate* is successes divided by trials; its interval contains the true rate with probability `CONFIDENCE`. *Twin
scores* and *real scores* are rates of the same policies in the twin and on the road, in the same order, along the last
axis; leading axes are separate experiments. The arguments `twin` and `real` are keyword-only, since exchanging them
changes results: regret and rank violations are differences of real rates.

Functions raise `UndefinedStatistic` if the data do not determine a statistic. Functions whose names end in `_batched`
work over leading axes, for resampling, and raise nothing; a correlation that is not determined is nan.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm, rankdata
from scipy.stats import t as student

from twin.types import Array

CONFIDENCE = 0.9
"""Confidence level of every interval."""
MIN_POLICIES = 5
"""Number of policies below which neither agreement nor predictions are given."""
MIN_PREDICTORS = 7
"""Number of policies below which a prediction has no interval."""
MIN_TRIALS = 5
"""Number of trials per cell below which neither agreement nor predictions are given."""

_MIN_POINTS = 3  # smallest number of policies for a correlation
_DECIMALS = 12  # scores equal to this many decimals are tied; further decimals depend on the order of summation
_MIN_VARIANCE = 1e-12  # scores with a smaller variance count as equal
_LEAST_SPREAD = 0.01  # a smaller standard deviation about a line is chance: it vanishes if all policies succeed


class UndefinedStatistic(ValueError):
    """The data do not determine a statistic; the message gives the reason and what is missing."""


# ---- rates


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Lower and upper end of a rate's score interval (Wilson 1927).

    Eq. 4 of Brown, Cai and DasGupta, Statistical Science 16 (2001). Unlike SciPy's function, this one accepts arrays,
    and fractional numbers of successes (see `mean_rate`).
    """
    n = np.asarray(trials, float)
    p = np.asarray(successes, float) / n
    z2 = norm.ppf(0.5 + confidence / 2) ** 2
    center = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n**2))) / (1 + z2 / n)
    return np.maximum(center - half, 0.0), np.minimum(center + half, 1.0)


def mean_rate(successes: ArrayLike, trials: ArrayLike) -> tuple[float, float, float]:
    """Unweighted mean of the rates of k cells with nᵢ trials, shape (k,), and the ends of its interval.

    The interval is Wilson's for k² / Σ 1/nᵢ trials: if all cells have the same true rate, the rate in this many trials
    has the same variance as the mean. If the true rates differ, the mean's variance is smaller, so the interval is too
    wide rather than too narrow.
    """
    n = np.asarray(trials, float)
    mean = float(np.mean(np.asarray(successes, float) / n))
    effective = len(n) ** 2 / np.sum(1.0 / n)
    low, high = wilson(mean * effective, effective)
    return mean, float(low), float(high)


def rate_summary(won: int, trials: int) -> dict[str, Any]:
    """Successes, trials, rate and its interval, JSON-able; the rate is None without trials."""
    if not trials:
        return {"successes": 0, "trials": 0, "rate": None, "low": 0.0, "high": 1.0}
    low, high = wilson(won, trials)
    return {"successes": won, "trials": trials, "rate": won / trials, "low": float(low), "high": float(high)}


def rate_difference(
    *,
    twin_successes: ArrayLike,
    twin_trials: ArrayLike,
    real_successes: ArrayLike,
    real_trials: ArrayLike,
    confidence: float = CONFIDENCE,
) -> tuple[Array, Array, Array]:
    """Real minus twin rate in [−1, 1], and the ends of Newcombe's hybrid score interval, which SciPy lacks.

    Method 10 of R. G. Newcombe, Interval estimation for the difference between independent proportions, Statistics in
    Medicine 17 (1998). All counts have the same shape.
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
    """Pearson's correlation of scores (n,). Raises UndefinedStatistic: n < 3, or all scores on one side are equal."""
    twin, real = _validated(twin, real)
    return float(pearson_batched(twin=twin, real=real))


def spearman(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Pearson's correlation of ranks; tied scores share their mean rank. Raises UndefinedStatistic like `pearson`."""
    twin, real = _validated(twin, real)
    return float(spearman_batched(twin=twin, real=real))


def mmrv(*, twin: ArrayLike, real: ArrayLike) -> float:
    """Mean maximum rank violation in [0, 1], 0 is best: SIMPLER (Li et al., arXiv 2405.05941), section on metrics.

    If twin and road order a pair of policies differently, the violation is the difference of their real scores R:
    |Rᵢ − Rⱼ| · 1[(Sᵢ < Sⱼ) ≠ (Rᵢ < Rⱼ)], with twin scores S. MMRV is the mean over i of the largest violation over j.
    It is not symmetric in S and R, and published code has both orders of the arguments. For two policies tied in the
    twin but not on the road, the violation counts for the policy with the lower real score; in the paper's published
    code, which compares by >, for the one with the higher score. Raises UndefinedStatistic: fewer than two policies.
    """
    twin, real = _validated(twin, real, needed=2, varied=False)
    return float(mmrv_batched(twin=twin, real=real))


def winner(*, twin: ArrayLike, real: ArrayLike) -> tuple[float, float]:
    """Agreement and regret of the twin's best policy; if several are tied as best in the twin, the means over them.

    Agreement is 1 if the twin's best policy is also the best on the road, else 0. Regret is the real rate of the road's
    best policy minus that of the twin's best policy. Raises UndefinedStatistic: fewer than two policies.
    """
    twin, real = _validated(twin, real, needed=2, varied=False)
    twin, real = _rounded(twin), _rounded(real)
    chosen = twin == twin.max()
    share = chosen / chosen.sum()
    return float((share * (real == real.max())).sum()), float((share * (real.max() - real)).sum())


def pearson_batched(*, twin: Array, real: Array) -> Array:
    """`pearson` over leading axes, shape (..., n) → (...); nan where all twin or all real scores are equal."""
    x = twin - twin.mean(-1, keepdims=True)
    y = real - real.mean(-1, keepdims=True)
    scale = np.sqrt((x * x).sum(-1) * (y * y).sum(-1))
    flat = (np.ptp(_rounded(twin), -1) == 0) | (np.ptp(_rounded(real), -1) == 0)
    return np.where(flat, np.nan, np.clip((x * y).sum(-1) / np.where(flat, 1.0, scale), -1.0, 1.0))


def spearman_batched(*, twin: Array, real: Array) -> Array:
    """`spearman` over leading axes, shape (..., n) → (...); nan where all twin or all real scores are equal."""
    return pearson_batched(twin=rankdata(_rounded(twin), axis=-1), real=rankdata(_rounded(real), axis=-1))


def mmrv_batched(*, twin: Array, real: Array) -> Array:
    """`mmrv` over leading axes, shape (..., n) → (...)."""
    twin, real = _rounded(twin), _rounded(real)
    violated = (twin[..., :, None] < twin[..., None, :]) != (real[..., :, None] < real[..., None, :])
    size = np.abs(real[..., :, None] - real[..., None, :])
    return (size * violated).max(-1).mean(-1)


def _rounded(scores: Array) -> Array:
    return np.round(scores, _DECIMALS)


def _validated(twin: ArrayLike, real: ArrayLike, needed: int = _MIN_POINTS, varied: bool = True) -> tuple[Array, Array]:
    twin, real = np.asarray(twin, float), np.asarray(real, float)
    if twin.ndim != 1 or twin.shape != real.shape:
        raise ValueError(f"scores of shapes {twin.shape} and {real.shape}: expected one per policy in each, (n,)")
    if not (np.isfinite(twin).all() and np.isfinite(real).all()):
        raise ValueError("a score is nan or infinite; expected finite numbers")
    if len(twin) < needed:
        raise UndefinedStatistic(f"{len(twin)} policies; at least {needed} are needed for this statistic")
    for name, scores in (("in the twin", twin), ("on the road", real)):
        if varied and np.ptp(_rounded(scores)) == 0:
            raise UndefinedStatistic(f"all rates {name} are {scores[0]:.3g}; a correlation needs rates that differ")
    return twin, real


# ---- prediction of real scores
#
# Prediction-powered inference (PPI; Angelopoulos et al., arXiv 2301.09633) combines many twin scores with few pairs of
# twin and real scores. From n pairs of twin score fᵢ and real score Yᵢ, and from N further twin scores f̃ⱼ, it estimates
# the mean real score of such policies as
#
#     θ = λ · mean(f̃) + mean(Y − λ f)            eq. 4 of PPI++ (Angelopoulos, Duchi and Zrnic, arXiv 2311.01453)
#
# This estimate is unbiased however inaccurate the twin is. Its variance is least for the *power* λ = Cov(Y, f) /
# ((1 + n/N) Var f) (example 6.1 of PPI++). A single further policy with twin score f̃ is predicted with the λ for N → ∞:
#
#     Ŷ = λ f̃ + mean(Y − λ f),  λ = Cov(Y, f) / Var f
#
# This is the least-squares line through the pairs; their residuals give the prediction interval.


@dataclass(frozen=True)
class PredictionPoweredMean:
    """Estimate of the mean real score of policies like those driven, and the ends of its interval."""

    value: float
    low: float
    high: float
    power: float
    """λ, the weight of the twin scores: at 0 they are not used, at 1 they have full weight."""


def prediction_powered_mean(
    *, twin: ArrayLike, real: ArrayLike, twin_only: ArrayLike, power: float | None = None
) -> PredictionPoweredMean:
    """Estimates the mean real score by PPI++.

    For each policy, λ is tuned on the other policies (leave one out), so the estimate is exactly unbiased. With a λ
    tuned on all policies it would be biased (Mani et al., arXiv 2505.20178). The interval uses Student's t with n − 1
    degrees of freedom and is not clipped to [0, 1]. In simulation, the coverage of a 90 % interval is 0.91 to 0.93 for
    policies of varied quality, but only 0.8 for six policies if most of them fail.

    Args:
        twin: fᵢ, shape (n,).
        real: Yᵢ, shape (n,).
        twin_only: f̃ⱼ, shape (N,).
        power: λ; None: λ is tuned.

    Raises:
        UndefinedStatistic: n < 5, or N < 2.
    """
    f, y, further = (np.asarray(a, float) for a in (twin, real, twin_only))
    n, more = len(y), len(further)
    _check_count(n)
    if more < 2:
        raise UndefinedStatistic(f"{more} policies driven in the twin only; 2 are needed: validate further policies")
    powers = _left_out_powers(f, y, n / more) if power is None else np.full(n, power)
    mean_power = float(powers.mean())
    value = float(mean_power * further.mean() + (y - powers * f).mean())
    error = np.var(y - powers * f, ddof=1) / n + mean_power**2 * np.var(further, ddof=1) / more
    half = float(student.ppf(0.5 + CONFIDENCE / 2, n - 1) * np.sqrt(error))
    return PredictionPoweredMean(value, value - half, value + half, mean_power)


def _left_out_powers(f: Array, y: Array, ratio: float) -> Array:
    """λ tuned on all policies but the i-th, shape (n,); 0 where the others' twin scores are all equal."""
    powers = np.zeros(len(y))
    for i in range(len(y)):
        others, labels = np.delete(f, i), np.delete(y, i)
        if others.var() > _MIN_VARIANCE:
            powers[i] = np.cov(labels, others)[0, 1] / ((1 + ratio) * others.var(ddof=1))
    return powers


@dataclass(frozen=True)
class LinearCorrection:
    """Least-squares line from twin to real scores."""

    slope: float
    """λ."""
    twin_mean: float
    real_mean: float
    residual_std: float
    """Standard deviation of real scores about the line."""
    sum_of_squares: float
    """Σ (f − mean f)²."""
    n: int

    @staticmethod
    def fit(*, twin: ArrayLike, real: ArrayLike) -> "LinearCorrection":
        """Fits scores (n,); the slope is 0 if all twin scores are equal. Raises UndefinedStatistic: n < 5."""
        f, y = np.asarray(twin, float), np.asarray(real, float)
        _check_count(len(y))
        centered = f - f.mean()
        squares = float(centered @ centered)
        slope = float(centered @ (y - y.mean())) / squares if squares > _MIN_VARIANCE else 0.0
        residual = y - y.mean() - slope * centered
        residual_std = float(np.sqrt(residual @ residual / (len(y) - 2)))
        return LinearCorrection(slope, float(f.mean()), float(y.mean()), residual_std, squares, len(y))

    def predict(self, twin: ArrayLike) -> tuple[Array, Array, Array]:
        """Predicts the real scores of policies with these twin scores, in as many trials as the fitted policies had.

        Returns values and ends of their intervals, clipped to [0, 1], each of the shape of `twin`. The interval is the
        prediction interval of simple regression (Draper and Smith, Applied Regression Analysis, section 3.1). It is
        centered on the clipped value, so that it does not vanish where the line leaves [0, 1]. What the fitted scores
        do not determine is nan: the ends if all of them lie on the line, and the value for a twin score other than
        theirs if these are all equal.
        """
        f = np.asarray(twin, float)
        away, squares = f - self.twin_mean, self.sum_of_squares
        middle = np.clip(self.real_mean + self.slope * away, 0, 1)
        lever = away**2 / max(squares, _MIN_VARIANCE)
        if squares <= _MIN_VARIANCE:
            middle = np.where(np.abs(away) > math.sqrt(_MIN_VARIANCE), np.nan, middle)
        spread = self.residual_std if self.residual_std >= _LEAST_SPREAD else np.nan
        half = student.ppf(0.5 + CONFIDENCE / 2, self.n - 2) * spread * np.sqrt(1.0 + 1.0 / self.n + lever)
        return middle, np.clip(middle - half, 0, 1), np.clip(middle + half, 0, 1)


def leave_one_group_out(*, twin: ArrayLike, real: ArrayLike, groups: Sequence[object]) -> tuple[Array, Array, Array]:
    """Predicts each real score by the line fitted to all other groups: values and ends of intervals, shapes (n,).

    They are nan where `LinearCorrection.predict` says so. `groups` contains the group of each score, such as its policy
    or lighting. Raises UndefinedStatistic: fewer than 5 scores remain without one of the groups.
    """
    f, y = np.asarray(twin, float), np.asarray(real, float)
    out = np.empty((3, len(y)))
    for group in dict.fromkeys(groups):
        mine = np.array([other == group for other in groups])
        out[:, mine] = LinearCorrection.fit(twin=f[~mine], real=y[~mine]).predict(f[mine])
    return out[0], out[1], out[2]


def _check_count(n: int) -> None:
    if n < MIN_POLICIES:
        raise UndefinedStatistic(f"{n} policies driven both in the twin and on the road; {MIN_POLICIES} are needed")
