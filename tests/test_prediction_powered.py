"""Prediction-powered estimates: closed forms, bias, coverage of intervals, refusals."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import expit

from twin.evaluation.statistics import (
    LinearCorrection,
    UndefinedStatistic,
    leave_one_group_out,
    prediction_powered_mean,
)

F = np.array([0.1, 0.3, 0.5, 0.6, 0.9, 0.95])
Y = np.array([0.0, 0.3, 0.2, 0.5, 0.6, 0.9])
FURTHER = np.array([0.2, 0.4, 0.8])


def test_power_zero_and_one_are_the_classical_and_the_plain_estimate() -> None:
    none = prediction_powered_mean(twin=F, real=Y, twin_only=FURTHER, power=0.0)
    assert none.value == pytest.approx(Y.mean())
    half = stats.t.ppf(0.95, 5) * Y.std(ddof=1) / np.sqrt(6)
    assert (none.low, none.high) == pytest.approx((Y.mean() - half, Y.mean() + half))
    full = prediction_powered_mean(twin=F, real=Y, twin_only=FURTHER, power=1.0)
    assert full.value == pytest.approx(FURTHER.mean() + (Y - F).mean())


def test_a_perfect_twin_is_relied_on_and_a_useless_one_is_not() -> None:
    many = np.random.default_rng(0).uniform(size=10_000)
    perfect = prediction_powered_mean(twin=Y, real=Y, twin_only=many)
    assert perfect.power == pytest.approx(1.0, abs=1e-2)
    flat = prediction_powered_mean(twin=np.full(6, 0.5), real=Y, twin_only=np.array([0.5, 0.5]))
    assert flat.power == 0.0 and flat.value == pytest.approx(Y.mean())


def test_the_powered_mean_has_no_bias() -> None:
    """Scores are skewed and errors grow with the score, so a λ tuned on the same six policies would be biased."""
    rng = np.random.default_rng(1)
    runs, n, more = 3000, 6, 10
    twin = rng.beta(0.6, 1.5, (runs, n + more))
    real = twin**2 * rng.uniform(0.5, 1.5, twin.shape)
    aim = stats.beta(0.6, 1.5).moment(2)
    pairs = list(zip(twin, real, strict=True))
    values = np.array([prediction_powered_mean(twin=f[:n], real=y[:n], twin_only=f[n:]).value for f, y in pairs])
    error = values.std() / np.sqrt(runs)
    assert values.mean() == pytest.approx(aim, abs=3 * error)

    def tuned_on_the_same(f: np.ndarray, y: np.ndarray) -> float:
        power = np.cov(y[:n], f[:n])[0, 1] / ((1 + n / more) * f[:n].var(ddof=1))
        return prediction_powered_mean(twin=f[:n], real=y[:n], twin_only=f[n:], power=power).value

    assert abs(np.mean([tuned_on_the_same(f, y) for f, y in pairs]) - aim) > 3 * error


def test_the_powered_interval_covers() -> None:
    """Rates of policies of varied quality, seven driven, ten not: 1500 experiments, Monte-Carlo error 0.008."""
    rng = np.random.default_rng(2)
    quality = rng.normal(0.0, 1.5, (1500, 17))
    twin = rng.binomial(100, expit(quality + 0.5 + rng.normal(0.0, 0.5, quality.shape))) / 100
    real = rng.binomial(20, expit(quality)) / 20
    aim = 0.5  # by symmetry
    means = [prediction_powered_mean(twin=f[:7], real=y[:7], twin_only=f[7:]) for f, y in zip(twin, real, strict=True)]
    held = np.mean([one.low <= aim <= one.high for one in means])
    assert 0.88 <= held <= 0.95, held


def test_power_reduces_the_variance() -> None:
    rng = np.random.default_rng(2)
    tuned, classical = [], []
    for _ in range(300):
        twin = rng.uniform(size=60)
        real = 0.8 * twin + rng.normal(0.0, 0.05, 60)
        tuned.append(prediction_powered_mean(twin=twin[:10], real=real[:10], twin_only=twin[10:]).value)
        classical.append(real[:10].mean())
    assert np.std(tuned) < 0.6 * np.std(classical)


def test_the_line_is_that_of_least_squares() -> None:
    line = LinearCorrection.fit(twin=F, real=Y)
    fit = stats.linregress(F, Y)
    assert line.slope == pytest.approx(fit.slope)
    value, low, high = line.predict(0.5)
    assert float(value) == pytest.approx(fit.intercept + 0.5 * fit.slope)
    spread = np.sqrt(np.sum((Y - fit.intercept - fit.slope * F) ** 2) / 4)
    half = stats.t.ppf(0.95, 4) * spread * np.sqrt(1 + 1 / 6 + (0.5 - F.mean()) ** 2 / np.sum((F - F.mean()) ** 2))
    assert (float(low), float(high)) == pytest.approx((max(value - half, 0.0), min(value + half, 1.0)))


def test_predictions_are_rates_and_keep_their_width() -> None:
    line = LinearCorrection.fit(twin=F, real=F - 0.2 + 0.05 * np.array([1, -1, 1, -1, 1, -1]))
    value, low, high = line.predict([0.0, 1.0])
    assert value[0] == low[0] == 0.0 < high[0]
    assert 0.0 <= value[1] <= high[1] <= 1.0
    flat = LinearCorrection.fit(twin=np.full(6, 0.5), real=Y)
    assert flat.slope == 0.0 and float(flat.predict(0.5)[0]) == pytest.approx(Y.mean())


def test_what_the_scores_do_not_determine_is_not_predicted() -> None:
    same = LinearCorrection.fit(twin=np.ones(8), real=np.ones(8))
    value, low, high = same.predict([0.0, 1.0])
    assert np.isnan(value[0]) and value[1] == 1.0 and np.isnan([low, high]).all()
    on_a_line = LinearCorrection.fit(twin=F, real=F).predict(F)
    assert np.allclose(on_a_line[0], F) and np.isnan(on_a_line[1:]).all()


def test_left_out_predictions_do_not_depend_on_their_target() -> None:
    value, _, _ = leave_one_group_out(twin=F, real=Y, groups=range(6))
    for i in range(6):
        fit = stats.linregress(np.delete(F, i), np.delete(Y, i))
        assert value[i] == pytest.approx(np.clip(fit.intercept + fit.slope * F[i], 0.0, 1.0))
    changed = Y.copy()
    changed[2] = 1.0
    assert leave_one_group_out(twin=F, real=changed, groups=range(6))[0][2] == value[2]


def test_left_out_intervals_are_those_of_the_line_through_the_others() -> None:
    real = 0.5 + 0.1 * (Y - Y.mean())  # far from 0 and 1, where intervals end
    value, low, high = leave_one_group_out(twin=F, real=real, groups=range(6))
    for i in range(6):
        line = LinearCorrection.fit(twin=np.delete(F, i), real=np.delete(real, i))
        assert (value[i], low[i], high[i]) == pytest.approx(line.predict(F[i]))


@pytest.mark.parametrize(("n", "real_trials", "noise"), [(12, 50, 0.5), (6, 20, 0.5), (12, 20, 3.0)])
def test_prediction_intervals_cover(n: int, real_trials: int, noise: float) -> None:
    """Rates of new policies in as many real trials: 600 experiments, Monte-Carlo error 0.012."""
    rng = np.random.default_rng(n)
    held, held_out = [], []
    for _ in range(600):
        quality = rng.normal(0.0, 1.5, n + 1)
        twin = rng.binomial(100, expit(quality + 0.5 + rng.normal(0.0, noise, n + 1))) / 100
        real = rng.binomial(real_trials, expit(quality)) / real_trials
        _, low, high = LinearCorrection.fit(twin=twin[:n], real=real[:n]).predict(twin[n])
        held.append(float(low) <= real[n] <= float(high))
        _, lows, highs = leave_one_group_out(twin=twin[:n], real=real[:n], groups=range(n))
        held_out.append(np.mean((lows <= real[:n]) & (real[:n] <= highs)))
    assert 0.86 <= np.mean(held) <= 0.96, np.mean(held)
    assert 0.87 <= np.mean(held_out) <= 0.95, np.mean(held_out)


def test_too_few_are_refused() -> None:
    with pytest.raises(UndefinedStatistic, match="4 policies driven both in the twin and on the road; 5 are needed"):
        LinearCorrection.fit(twin=F[:4], real=Y[:4])
    with pytest.raises(UndefinedStatistic, match="4 policies"):
        prediction_powered_mean(twin=F[:4], real=Y[:4], twin_only=FURTHER)
    with pytest.raises(UndefinedStatistic, match="1 policies driven in the twin only"):
        prediction_powered_mean(twin=F, real=Y, twin_only=[0.5])
    with pytest.raises(UndefinedStatistic):
        leave_one_group_out(twin=F[:5], real=Y[:5], groups=range(5))
