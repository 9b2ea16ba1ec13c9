"""Proper scores, baselines that use other trainings alone, calibration, errors by day."""

import numpy as np
import pytest
from test_agreement_intervals import cells_of

from twin.evaluation.agreement_intervals import jackknife_interval, mean_bias
from twin.evaluation.probability_scores import (
    SCORE_DIFFERENCE,
    brier,
    calibration,
    errors_by_day,
    log_score,
    mean_score,
    other_trainings,
    recalibrated,
    score_pair,
    shuffled_days,
    twin_probabilities,
)


@pytest.mark.parametrize("score", [brier, log_score])
@pytest.mark.parametrize("rate", [0.2, 0.5, 0.9])
def test_scores_are_proper(score, rate: float) -> None:
    """The expected score is best for the true probability; it is 0 only for certain and correct predictions."""
    p = np.linspace(0.01, 0.99, 99)
    assert p[np.argmin(score(p, np.full(99, rate)))] == pytest.approx(rate)
    assert score(np.array(1.0), np.array(1.0)) == pytest.approx(0.0, abs=0.006)


def test_scores_of_trials_are_means_over_them() -> None:
    outcomes = np.array([1.0, 1.0, 0.0, 1.0, 0.0])
    for score in (brier, log_score):
        assert score(np.array(0.7), outcomes.mean()) == pytest.approx(np.mean(score(np.full(5, 0.7), outcomes)))


def test_shuffled_days_are_the_mean_over_permutations() -> None:
    from itertools import permutations

    p, y = np.array([[0.1, 0.6, 0.9]]), np.array([[0.0, 1.0, 0.8]])
    every = [log_score(p[:, list(order)], y) for order in permutations(range(3))]
    assert np.allclose(shuffled_days(p, np.ones((1, 3)), y, log_score), np.mean(every, 0))


def test_baselines_use_other_trainings_alone() -> None:
    real = np.array([[1.0, 1.0], [0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    data = cells_of(real, real, per_training=2)  # two trainings of two checkpoints
    groups = np.array([0, 1, 0, 1])
    everyone = (0.5 + 0.5) / 3  # of the other training: 0.5 and 0, and half a trial of one half
    assert other_trainings(data, groups)[0] == pytest.approx((0.5 + everyone) / 2)
    changed = cells_of(real, np.concatenate([1.0 - real[:2], real[2:]]), per_training=2)
    assert np.allclose(other_trainings(changed, groups)[:2], other_trainings(data, groups)[:2])
    p = np.clip(real, 0.1, 0.9)
    assert np.allclose(recalibrated(p, changed)[:2], recalibrated(p, data)[:2])


def test_recalibration_removes_a_bias() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.05, 0.95, (12, 40))
    real = (rng.random(true.shape) < true).astype(float)
    logit = np.log(true / (1 - true))
    over = 1 / (1 + np.exp(-(2.0 * logit + 1.0)))
    data = cells_of(over, real)
    mended = recalibrated(over, data)
    assert np.abs(mended - true).mean() < 0.05 < np.abs(over - true).mean()
    assert mean_score(data, log_score(mended, real)) < mean_score(data, log_score(over, real))


def test_the_gain_is_the_difference_of_mean_scores() -> None:
    rng = np.random.default_rng(1)
    real = rng.random((12, 10))
    data = cells_of(real, real)
    one, other = rng.random((2, 12, 10))
    pair = score_pair(data, one, other)
    assert mean_bias(**pair.rates()) == pytest.approx(mean_score(data, other) - mean_score(data, one))
    low, high = jackknife_interval(SCORE_DIFFERENCE, pair)
    assert low < mean_bias(**pair.rates()) < high


def test_twin_probabilities_are_never_0_or_1() -> None:
    p = twin_probabilities(np.array([[5, 5, 5], [0, 0, 5]]), np.full((2, 3), 5))
    assert (p > 0).all() and (p < 1).all() and p[0].min() > 0.9 and p[1, 2] > 0.5 > p[1, 0]


def test_calibration_counts_every_cell_once() -> None:
    p, y, trials = np.array([0.0, 0.02, 0.5, 1.0]), np.array([0.0, 0.2, 1.0, 1.0]), np.array([5, 5, 10, 5])
    bins = calibration(p, y, trials)
    assert [(it.cells, it.trials) for it in bins] == [(2, 10), (1, 10), (1, 5)]
    assert bins[0].observed == pytest.approx(0.1) and bins[0].predicted == pytest.approx(0.01)


def test_errors_by_day() -> None:
    days = ["a", "b", "a", "b"]
    first, second = errors_by_day(np.array([0.9, 0.9, 0.1, 0.1]), np.array([0.0, 1.0, 0.6, 0.0]), days)
    assert (first.day, first.cells, first.misses, first.false_alarms) == ("a", 2, 1, 1)
    assert (second.misses, second.false_alarms) == (0, 0)
