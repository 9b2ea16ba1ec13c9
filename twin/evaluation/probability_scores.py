"""Scores of predicted success probabilities: Brier and log scores, calibration, false alarms and misses.

A predictor gives a probability p of success for each cell (a policy's real trials on a day). An outcome is 1 or 0:

    Brier score: mean over a cell's trials of (p − outcome)²
    log score: mean over a cell's trials of −log of the outcome's predicted probability

The best value of both scores is 0. They are *proper*: the expected score is best if p is the true probability (Gneiting
and Raftery, J. Am. Stat. Assoc. 102, 2007). The twin's scores are compared with those of baselines: `other_trainings`
does not use the twin, and `shuffled_days` does not use its differences between days. `other_trainings` and the twin's
recalibration are fitted to real trials; they predict each training from trials of other trainings only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from twin.evaluation.agreement_intervals import STATISTICS, PairedCells
from twin.evaluation.rate_model import RateModel
from twin.types import Array, Indices

CALIBRATION_EDGES = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
"""Ends of the bins of predicted probability in a calibration curve."""

SCORE_DIFFERENCE = replace(STATISTICS["bias"], low=-np.inf, high=np.inf, trainings=12, days=10)
"""Mean over policies of the difference of two scores; `jackknife_interval` takes it with data from `score_pair`.

With fewer units it has no interval: its coverage would be as low as 0.54, since the baselines are fitted to the same
trials (`benchmarks/intervals.py --better-by`).
"""

_LEAST = 0.005  # log scores and recalibration clip probabilities to between this and 1 minus this
_RIDGE = 0.1  # weight of a recalibration's prior, which favors unchanged probabilities
_NEWTON_STEPS = 30


@dataclass(frozen=True)
class CalibrationBin:
    """Summary of the cells whose predicted probability lies in a bin from `low` to `high`."""

    low: float
    high: float
    predicted: float
    """Mean predicted probability."""
    observed: float
    """Success rate on the road."""
    cells: int
    trials: int


@dataclass(frozen=True)
class DayErrors:
    """Counts of one day's cells: all, and those whose more frequent outcome the twin predicts wrongly."""

    day: str
    cells: int
    misses: int
    """Missed failures: the twin predicts success (p ≥ ½), and fewer than half of the trials succeed."""
    false_alarms: int
    """The twin predicts failure (p < ½), and at least half of the trials succeed."""


def brier(probability: Array, rate: Array) -> Array:
    """Brier score of each cell with success rate `rate`, shapes (...)."""
    return np.asarray(rate * (1.0 - probability) ** 2 + (1.0 - rate) * probability**2)


def log_score(probability: Array, rate: Array) -> Array:
    """Log score of each cell [nats], shapes (...); probabilities are kept 0.005 away from 0 and 1."""
    p = np.clip(probability, _LEAST, 1.0 - _LEAST)
    return np.asarray(-rate * np.log(p) - (1.0 - rate) * np.log1p(-p))


def score_pair(data: PairedCells, score: Array, baseline: Array) -> PairedCells:
    """`data` with scores (n, k) instead of rates, so that its `mean_bias` is the mean of baseline minus score."""
    return PairedCells(score, baseline, data.weight, data.training, data.day, data.strata)


def mean_score(data: PairedCells, score: Array) -> float:
    """Mean over policies of the mean score of their cells."""
    return float(((data.weight * score).sum(-1) / data.weight.sum(-1)).mean())


def twin_probabilities(successes: Array | Indices, trials: Array | Indices) -> Array:
    """The twin's probability of success in each of its cells, shape (n, k), from its counts (n, k).

    A cell's probability is its rate, shrunk towards the policy's rate in the twin.
    """
    return RateModel.fit(successes, trials, shared_days=False, all_or_none=False).cell_means()


def shuffled_days(probability: Array, weight: Array, rate: Array, score: Callable[[Array, Array], Array]) -> Array:
    """Expected score of each cell, shape (n, k), if the days of each policy's probabilities were permuted at random.

    Args:
        probability: Predicted probability of success in each cell, shape (n, k).
        weight: 1 for a cell, 0 for padding.
        rate: Success rates on the road, shape (n, k).
        score: `brier` or `log_score`.
    """
    out = np.zeros_like(probability)
    for i, row in enumerate(weight > 0):
        out[i, row] = score(probability[i, row][:, None], rate[i, row][None]).mean(0)
    return out


def other_trainings(data: PairedCells, groups: Indices) -> Array:
    """Baseline: for each policy, the mean real rate of policies of the same group in other trainings, shape (n,).

    The mean rate of all policies of other trainings is included with the weight of one policy. `groups` contains the
    group of each policy, such as its training setup. If there is only one group, this is the mean over all policies of
    other trainings.
    """
    real = data.rates()["real"]
    out = np.full(data.policies, 0.5)
    for i in range(data.policies):
        others = data.training != data.training[i]
        mine = others & (groups == groups[i])
        everyone = (real[others].sum() + 0.5) / (others.sum() + 1.0)
        out[i] = (real[mine].sum() + everyone) / (mine.sum() + 1.0)
    return out


def recalibrated(probability: Array, data: PairedCells) -> Array:
    """Recalibrates probabilities (n, k) by a logistic regression on the real trials of other trainings (Platt 1999)."""
    x = np.log(np.clip(probability, _LEAST, 1 - _LEAST)) - np.log1p(-np.clip(probability, _LEAST, 1 - _LEAST))
    out = np.empty_like(probability)
    for training in np.unique(data.training):
        mine = data.training == training
        used = (data.weight > 0) & ~mine[:, None]
        if not used.any():
            out[mine] = probability[mine]
            continue
        intercept, slope = _logistic_line(x[used], data.real[used])
        out[mine] = 1.0 / (1.0 + np.exp(-(intercept + slope * x[mine])))
    return out


def _logistic_line(x: Array, rate: Array) -> tuple[float, float]:
    """Intercept and slope of a logistic regression by Newton's method, with a weak prior around (0, 1)."""
    design = np.stack([np.ones_like(x), x], -1)
    start = np.array([0.0, 1.0])
    line = start.copy()
    for _ in range(_NEWTON_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ line, -30, 30)))
        gradient = design.T @ (rate - p) - _RIDGE * (line - start)
        hessian = (design * (p * (1 - p))[:, None]).T @ design + _RIDGE * np.eye(2)
        line = line + np.clip(np.linalg.solve(hessian, gradient), -2.0, 2.0)
    return float(line[0]), float(line[1])


def calibration(probability: Array, rate: Array, trials: Indices) -> tuple[CalibrationBin, ...]:
    """Calibration curve of cells, shapes (c,); bins without trials are left out."""
    index = np.clip(np.searchsorted(CALIBRATION_EDGES, probability, "right") - 1, 0, len(CALIBRATION_EDGES) - 2)
    out = []
    for b, (low, high) in enumerate(pairwise(CALIBRATION_EDGES)):
        of = index == b
        if n := int(trials[of].sum()):
            predicted, observed = (float((trials[of] * value[of]).sum() / n) for value in (probability, rate))
            out.append(CalibrationBin(low, high, predicted, observed, int(of.sum()), n))
    return tuple(out)


def errors_by_day(probability: Array, rate: Array, days: Sequence[str]) -> tuple[DayErrors, ...]:
    """Counts misses and false alarms among cells, shapes (c,), for each day in order of first occurrence."""
    out = []
    for day in dict.fromkeys(days):
        of = np.array([other == day for other in days])
        predicted, happened = probability[of] >= 0.5, rate[of] >= 0.5
        misses, alarms = int((predicted & ~happened).sum()), int((~predicted & happened).sum())
        out.append(DayErrors(day, int(of.sum()), misses, alarms))
    return tuple(out)
