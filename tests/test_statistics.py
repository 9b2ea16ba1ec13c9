"""Rates and agreement: closed forms, ties, refusals, the order of arguments, and the coverage of intervals."""

import itertools

import numpy as np
import pytest
from scipy import stats

from twin.evaluation.statistics import (
    CONFIDENCE,
    UndefinedStatistic,
    mean_rate,
    mmrv,
    mmrv_batched,
    pearson,
    pearson_batched,
    rate_difference,
    spearman,
    spearman_batched,
    wilson,
    winner,
)


def tied(rng: np.random.Generator, n: int) -> np.ndarray:
    """Rates of few trials, many of them the same."""
    return rng.integers(0, 5, n) / 4


def slow_mmrv(twin: np.ndarray, real: np.ndarray) -> float:
    worst = []
    for i in range(len(twin)):
        by = [abs(real[i] - real[j]) for j in range(len(twin)) if (twin[i] < twin[j]) != (real[i] < real[j])]
        worst.append(max(by, default=0.0))
    return sum(worst) / len(worst)


# ---- rates


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662)],
)
def test_wilson_equals_published_values(successes: int, trials: int, low: float, high: float) -> None:
    # The last line is of Newcombe's paper on single proportions, Stat. in Medicine 17 (1998), table I.
    assert np.allclose(wilson(successes, trials, 0.95), (low, high), atol=6e-5)


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.999])
def test_wilson_equals_scipy(confidence: float) -> None:
    for trials in (1, 7, 200, 10_000):
        for successes in {0, 1, trials // 3, trials}:
            expected = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
            np.testing.assert_allclose(wilson(successes, trials, confidence), expected, rtol=0, atol=1e-12)


def test_wilson_solves_the_score_equation() -> None:
    for successes, trials in itertools.product((1, 3, 7), (8, 20, 200)):
        for end in wilson(successes, trials):
            score = abs(successes / trials - end) / np.sqrt(end * (1 - end) / trials)
            assert score == pytest.approx(stats.norm.ppf(0.5 + CONFIDENCE / 2))


def test_newcombe_equals_published_values() -> None:
    # Newcombe, Stat. in Medicine 17 (1998) 873, table II, method 10: 56/70 − 48/80 and 9/10 − 3/10.
    for (a, n, b, m), ends in (((56, 70, 48, 80), (0.0524, 0.3339)), ((9, 10, 3, 10), (0.1705, 0.8090))):
        got = rate_difference(twin_successes=b, twin_trials=m, real_successes=a, real_trials=n, confidence=0.95)
        assert np.allclose(got, (a / n - b / m, *ends), atol=6e-5)


def test_the_difference_of_swapped_worlds_is_reversed() -> None:
    value, low, high = rate_difference(twin_successes=3, twin_trials=20, real_successes=9, real_trials=10)
    back = rate_difference(twin_successes=9, twin_trials=10, real_successes=3, real_trials=20)
    assert np.allclose(back, (-value, -high, -low))


def test_mean_rate_of_one_cell_or_equal_cells_is_wilson() -> None:
    assert np.allclose(mean_rate([7], [20])[1:], wilson(7, 20))
    assert np.allclose(mean_rate([3, 4], [10, 10])[1:], wilson(7, 20))
    assert mean_rate([10, 0], [10, 1000])[0] == 0.5


# ---- agreement


def test_correlations_equal_scipy_with_ties() -> None:
    rng = np.random.default_rng(0)
    for n in (3, 5, 12):
        for _ in range(20):
            twin, real = tied(rng, n), tied(rng, n)
            if np.ptp(twin) == 0 or np.ptp(real) == 0:
                continue
            assert pearson(twin=twin, real=real) == pytest.approx(stats.pearsonr(twin, real).statistic)
            assert spearman(twin=twin, real=real) == pytest.approx(stats.spearmanr(twin, real).statistic)


def test_correlations_and_mmrv_equal_closed_forms() -> None:
    real = np.array([0.1, 0.4, 0.5, 0.9])
    assert pearson(twin=0.2 + 0.5 * real, real=real) == pytest.approx(1.0)
    assert spearman(twin=real**3, real=real) == pytest.approx(1.0)
    assert spearman(twin=-real, real=real) == pytest.approx(-1.0)
    assert mmrv(twin=real**3, real=real) == 0.0
    assert mmrv(twin=-real, real=real) == pytest.approx(np.mean([0.8, 0.5, 0.4, 0.8]))
    assert winner(twin=-real, real=real)[1] == pytest.approx(0.8)
    assert winner(twin=real**3, real=real)[0] == 1.0


def test_mmrv_equals_a_slow_implementation() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        twin, real = tied(rng, 7), tied(rng, 7)
        assert mmrv(twin=twin, real=real) == pytest.approx(slow_mmrv(twin, real))


def test_the_order_of_arguments_matters_and_is_by_keyword() -> None:
    twin, real = np.array([0.9, 0.5, 0.1]), np.array([0.2, 0.6, 0.4])
    assert mmrv(twin=twin, real=real) == pytest.approx((0.4 + 0.4 + 0.2) / 3)
    assert mmrv(twin=real, real=twin) == pytest.approx((0.8 + 0.4 + 0.8) / 3)
    assert winner(twin=twin, real=real)[1] == pytest.approx(0.4)
    assert winner(twin=real, real=twin)[1] == pytest.approx(0.4)
    for statistic in (pearson, spearman, mmrv, winner):
        with pytest.raises(TypeError):
            statistic(twin, real)  # type: ignore[misc]


def test_ties_count_for_the_worse_policy_and_share_the_winner() -> None:
    twin, real = np.array([1.0, 1.0, 0.0]), np.array([0.2, 0.8, 0.0])
    # The worse of the tied pair is charged, the better is not.
    assert mmrv(twin=twin, real=real) == pytest.approx(0.6 / 3)
    assert winner(twin=twin, real=real)[0] == 0.5
    assert winner(twin=twin, real=real)[1] == pytest.approx(0.3)
    # Tied on the road: either is the winner.
    assert winner(twin=np.array([1.0, 0.9, 0.0]), real=np.array([0.8, 0.8, 0.0]))[0] == 1.0
    assert mmrv(twin=np.array([1.0, 0.9]), real=np.array([0.8, 0.8])) == 0.0


def test_rates_equal_up_to_rounding_are_tied() -> None:
    twin = np.array([0.1 + 0.2, 0.3, 0.5])
    assert twin[0] != twin[1]
    assert mmrv(twin=twin, real=np.array([0.5, 0.5, 0.9])) == 0.0
    assert spearman(twin=twin, real=np.array([0.5, 0.5, 0.9])) == pytest.approx(1.0)
    with pytest.raises(UndefinedStatistic):
        pearson(twin=np.array([0.3, 0.3, 0.1 + 0.2]), real=twin)


@pytest.mark.parametrize("statistic", [pearson, spearman])
def test_undefined_correlations_are_refused(statistic) -> None:
    for n in range(3):
        with pytest.raises(UndefinedStatistic, match=f"{n} policies; at least 3"):
            statistic(twin=np.arange(n), real=np.arange(n))
    with pytest.raises(UndefinedStatistic, match=r"all rates in the twin are 0\.5"):
        statistic(twin=[0.5] * 4, real=[0.1, 0.2, 0.3, 0.4])
    with pytest.raises(UndefinedStatistic, match="all rates on the road are 0"):
        statistic(twin=[0.1, 0.2, 0.3, 0.4], real=[0.0] * 4)


def test_constant_scores_have_a_winner_and_violations() -> None:
    flat, real = [0.5] * 3, [0.0, 0.3, 0.9]
    assert winner(twin=flat, real=real)[0] == pytest.approx(1 / 3)
    assert winner(twin=flat, real=real)[1] == pytest.approx(0.5)
    assert mmrv(twin=flat, real=real) == pytest.approx((0.9 + 0.6 + 0.0) / 3)
    for statistic in (mmrv, winner):
        with pytest.raises(UndefinedStatistic, match="1 policies; at least 2"):
            statistic(twin=[0.5], real=[0.5])


def test_shapes_and_numbers_are_checked() -> None:
    with pytest.raises(ValueError, match="shapes"):
        pearson(twin=[0.1, 0.2, 0.3], real=[0.1, 0.2])
    with pytest.raises(ValueError, match="nan or infinite"):
        mmrv(twin=[0.1, float("nan")], real=[0.1, 0.2])


def test_rows_are_the_same_statistics() -> None:
    rng = np.random.default_rng(2)
    twin, real = np.stack([tied(rng, 6) for _ in range(30)]), np.stack([tied(rng, 6) for _ in range(30)])
    twin[3] = 0.25
    for rows, one in ((pearson_batched, pearson), (spearman_batched, spearman), (mmrv_batched, mmrv)):
        got = rows(twin=twin, real=real)
        for i in range(30):
            if np.isnan(got[i]):
                with pytest.raises(UndefinedStatistic):
                    one(twin=twin[i], real=real[i])
            else:
                assert got[i] == pytest.approx(one(twin=twin[i], real=real[i]))
    assert np.isnan(pearson_batched(twin=twin, real=real)[3])


# ---- simulated coverage; 20,000 experiments: Monte-Carlo error 0.002, three times that is allowed beyond the rule

_RUNS = 20_000
_NOISE = 3 * np.sqrt(0.09 / _RUNS)


@pytest.mark.parametrize("trials", [10, 50, 100])
def test_wilson_covers(trials: int) -> None:
    """The mean coverage over uniformly distributed rates is the nominal one (Brown, Cai and DasGupta, section 4.1)."""
    rng = np.random.default_rng(trials)
    rate = rng.uniform(size=_RUNS)
    low, high = wilson(rng.binomial(trials, rate), trials)
    assert np.mean((low <= rate) & (rate <= high)) == pytest.approx(CONFIDENCE, abs=0.01 + _NOISE)


def test_mean_rate_covers() -> None:
    """The coverage is at least the nominal one, as a mean of unequal rates has less variance."""
    rng = np.random.default_rng(3)
    trials = np.array([10, 25, 50])
    rate = rng.uniform(size=(2000, 3))
    won = rng.binomial(trials, rate)
    ends = np.array([mean_rate(one, trials)[1:] for one in won])
    covered = np.mean((ends[:, 0] <= rate.mean(1)) & (rate.mean(1) <= ends[:, 1]))
    assert CONFIDENCE - 3 * np.sqrt(0.09 / 2000) <= covered <= 0.97


@pytest.mark.parametrize(("twin_trials", "real_trials"), [(100, 10), (100, 50), (20, 5)])
def test_the_difference_covers(twin_trials: int, real_trials: int) -> None:
    rng = np.random.default_rng(real_trials)
    twin, real = rng.uniform(size=(2, _RUNS))
    _, low, high = rate_difference(
        twin_successes=rng.binomial(twin_trials, twin),
        twin_trials=twin_trials,
        real_successes=rng.binomial(real_trials, real),
        real_trials=real_trials,
    )
    assert np.mean((low <= real - twin) & (real - twin <= high)) == pytest.approx(CONFIDENCE, abs=0.02 + _NOISE)
