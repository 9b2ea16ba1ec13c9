"""The ranking: probabilities against closed forms, coverage of intervals, numbers of further trials."""

import tracemalloc

import numpy as np
import pytest
from scipy import stats

from twin.evaluation import rate_model
from twin.evaluation.rate_model import (
    MARGIN,
    MAX_TRIALS,
    SETTLED_PROBABILITY,
    RankingConfidence,
    expected_confidence,
    rank_interval,
    rank_probabilities,
    trials_needed,
)


def of(*counts: tuple[int, int], samples: int = 4000, seed: int = 0) -> np.ndarray:
    """Samples of true rates from Jeffreys' posterior of independent trials: successes and trials per policy."""
    won, driven = np.array(counts).T
    return np.random.default_rng(seed).beta(won + 0.5, driven - won + 0.5, (samples, len(counts)))


def test_rank_probabilities_of_two_policies_equal_integration() -> None:
    chance = rank_probabilities(of((7, 10), (5, 10), samples=100_000))
    rate = (np.arange(200_000) + 0.5) / 200_000
    better = np.mean(stats.beta.pdf(rate, 7.5, 3.5) * stats.beta.cdf(rate, 5.5, 5.5))
    assert chance[0, 0] == pytest.approx(better, abs=0.005)
    assert np.allclose(chance, chance.T)


def test_rows_and_columns_sum_to_one() -> None:
    chance = rank_probabilities(of((1, 10), (9, 10), (5, 10), (5, 10)))
    assert np.allclose(chance.sum(0), 1.0) and np.allclose(chance.sum(1), 1.0)
    assert chance[1, 0] > 0.9 and chance[0, 3] > 0.9
    assert chance[2, 1] == pytest.approx(0.5, abs=0.05)


def test_rank_interval_excludes_unlikely_ranks() -> None:
    expected, low, high = rank_interval(np.array([0.04, 0.5, 0.42, 0.04]))
    assert (low, high) == (2, 3) and expected == pytest.approx(2.46)
    assert rank_interval(np.array([0.06, 0.88, 0.06]))[1:] == (1, 3)
    assert rank_interval(np.array([1.0, 0.0]))[1:] == (1, 1)
    assert rank_interval(np.array([0.05, 0.9, 0.05]))[1:] == (2, 2)


def test_rank_intervals_cover() -> None:
    """Uniform true rates; 300 experiments of six policies, Monte-Carlo error 0.008. Ranks are whole numbers, so the
    coverage is at least about the nominal one."""
    rng = np.random.default_rng(3)
    held = []
    for _ in range(300):
        true = rng.uniform(size=6)
        chance = rank_probabilities(
            of(*zip(rng.binomial(30, true), [30] * 6, strict=True), samples=500, seed=len(held))
        )
        rank = np.argsort(np.argsort(-true)) + 1
        for i in range(6):
            _, low, high = rank_interval(chance[i])
            held.append(low <= rank[i] <= high)
    assert 0.88 <= np.mean(held) <= 0.99, np.mean(held)


def test_confidence_grows_with_trials() -> None:
    rates = of((8, 10), (6, 10), (3, 10))
    sure = [expected_confidence(rates, more, 0) for more in (0, 20, 100, 500)]
    assert [s.winner for s in sure] == sorted(s.winner for s in sure)
    assert [s.order for s in sure] == sorted(s.order for s in sure)
    assert sure[-1].winner > 0.95 > sure[0].winner


def test_confidence_without_further_trials_is_the_posterior() -> None:
    """Without further trials the leader is fixed, so the confidence is the posterior probability that it is within the
    margin of the best.
    """
    rates = of((8, 10), (6, 10), (3, 10))
    assert expected_confidence(rates, 0, 0).winner == pytest.approx(np.mean(rates[:, 0] >= rates.max(1) - MARGIN))


def test_without_trials_so_far_nothing_is_known() -> None:
    rates = of((80, 100), (50, 100), (20, 100), (10, 100))
    nothing = expected_confidence(rates, 0, 0, so_far=False)
    assert nothing.winner == pytest.approx(0.25, abs=0.01) and nothing.order == 0.5
    assert expected_confidence(rates, 0, 0).winner > 0.99


def test_trials_needed_is_the_least_sufficient_number() -> None:
    rates = of((16, 20), (13, 20), (5, 20))
    more = trials_needed(rates, "winner", 0)
    assert more is not None and more % 5 == 0 and more > 0
    assert (
        expected_confidence(rates, more, 0).winner
        >= SETTLED_PROBABILITY
        > expected_confidence(rates, more - 5, 0).winner
    )
    assert trials_needed(of((100, 100), (1, 100)), "winner", 0) == 0
    assert trials_needed(of((100, 100), (1, 100)), "order", 0) == 0


@pytest.mark.parametrize("needed", [MAX_TRIALS - 5, MAX_TRIALS, MAX_TRIALS + 5, 1.5 * MAX_TRIALS, np.inf])
def test_no_more_trials_than_the_maximum_are_needed(needed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ranking that settles at a known number of trials: that number, or None above the maximum."""

    def confidence(rates: np.ndarray, more: int, seed: int, so_far: bool = True) -> RankingConfidence:
        assert more < 2 * MAX_TRIALS, "tried in vain"
        return RankingConfidence(float(more >= needed), 0.0)

    monkeypatch.setattr(rate_model, "expected_confidence", confidence)
    assert trials_needed(of((5, 10), (6, 10)), "winner", 0) == (needed if needed <= MAX_TRIALS else None)


def test_memory_grows_in_proportion_to_the_policies() -> None:
    rates = of(*((k % 11, 10) for k in range(80)), samples=1000)
    tracemalloc.start()
    expected_confidence(rates, 20, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * rates.nbytes


def test_equal_policies_need_no_order() -> None:
    """Rates that differ by less than the margin are equally good: any may win."""
    same = of((5000, 10_000), (5020, 10_000))
    assert trials_needed(same, "winner", 0) == 0
    assert expected_confidence(same, 0, 0).order == 1.0
