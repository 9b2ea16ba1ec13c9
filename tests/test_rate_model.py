"""Hierarchical rates: exactness in tiny cases, limits, shrinkage, coverage."""

from collections import Counter

import numpy as np
import pytest
from intervals import KINDS, Shape, simulate
from scipy import integrate, stats

from twin.evaluation.agreement import unit_counts
from twin.evaluation.forecasting import _rates_over_days
from twin.evaluation.rate_model import RateModel
from twin.evaluation.statistics import wilson
from twin.evaluation.trials import Cell


def test_single_trials_equal_integration() -> None:
    """One policy of single trials: ρ plays no part, and the posterior of the rate can be integrated directly."""
    won, driven = 7, 10
    model = RateModel.fit([[1] * won + [0] * (driven - won)], [[1] * driven], shared_days=False)
    means = stats.beta.ppf((np.arange(15) + 0.5) / 15, 1.5, 1.5)
    correlations = stats.beta.ppf((np.arange(10) + 0.5) / 10, 1, 2)

    def prior(rate: float) -> float:
        sizes = 1 / correlations - 1
        return float(np.mean([stats.beta.pdf(rate, m * s, (1 - m) * s) for m in means for s in sizes]))

    def moment(power: int) -> float:
        return integrate.quad(lambda p: p ** (won + power) * (1 - p) ** (driven - won) * prior(p), 1e-6, 1 - 1e-6)[0]

    assert model.mean()[0] == pytest.approx(moment(1) / moment(0), abs=0.005)


def test_policies_and_days_in_any_order_give_the_same() -> None:
    rng = np.random.default_rng(0)
    won = rng.integers(0, 6, (5, 4))
    rows, days = rng.permutation(5), rng.permutation(4)
    one, other = (RateModel.fit(a, np.full((5, 4), 5)) for a in (won, won[rows][:, days]))
    assert np.allclose(np.array(one.interval())[:, rows], other.interval())


def test_successes_and_failures_are_symmetric() -> None:
    won = np.array([[5, 5, 0, 5], [0, 1, 0, 0], [5, 4, 5, 5]])
    one, other = RateModel.fit(won, np.full(won.shape, 5)), RateModel.fit(5 - won, np.full(won.shape, 5))
    assert np.allclose(one.mean(), 1.0 - other.mean())
    (low, high), (other_low, other_high) = one.interval(), other.interval()
    assert np.allclose(low, 1.0 - other_high, atol=1e-3) and np.allclose(high, 1.0 - other_low, atol=1e-3)


def test_identical_cells_leave_the_ends_in_the_interval_and_do_not_make_it_a_point() -> None:
    model = RateModel.fit(np.array([[5] * 10, [0] * 10, [5] * 10]), np.full((3, 10), 5))
    low, high = model.interval()
    assert high[0] == high[2] == 1.0 and low[1] == 0.0
    assert 0.02 < high[1] < 0.3 and low[0] == pytest.approx(low[2])
    assert model.mean()[1] < 0.04  # not the 8 % of half a trial added to every cell of five


def test_days_count_and_trials_of_one_day_hardly_do() -> None:
    """On half of the days all trials succeed, on the others none: more days narrow the interval, more trials a day do
    not.
    """

    def width(days: int, trials: int) -> float:
        won = np.tile([0, trials], (4, days // 2))
        low, high = RateModel.fit(won, np.full(won.shape, trials)).interval()
        return float((high - low)[0])

    assert width(4, 50) > 0.9 * width(4, 5)
    assert width(16, 5) < 0.7 * width(4, 5)
    low, high = wilson(10, 20)
    assert width(4, 5) > 1.2 * (high - low)  # as if the 20 trials were independent


def test_a_policy_is_shrunk_towards_the_others_and_not_towards_one_half() -> None:
    trials = np.full((6, 2), 5)
    good = RateModel.fit([[5, 5]] * 5 + [[5, 0]], trials).mean()
    bad = RateModel.fit([[0, 0]] * 5 + [[5, 0]], trials).mean()
    assert good[-1] > 0.5 > bad[-1]
    assert bad[0] < 0.2


def test_days_that_are_bad_for_all_policies_widen_the_intervals() -> None:
    """Six policies fail on one of four days, the same one or different ones."""
    same = np.full((6, 4), 5)
    other = same.copy()
    same[:, 0] = 0
    other[np.arange(6), np.arange(6) % 4] = 0
    (low, high), (other_low, other_high) = (RateModel.fit(won, np.full((6, 4), 5)).interval() for won in (same, other))
    assert ((high - low) > 1.03 * (other_high - other_low)).all()
    padded = [np.insert(a, [0, 2, 4], 0, axis=1) for a in (same, np.full((6, 4), 5))]  # days that nobody drove
    assert np.allclose(RateModel.fit(*padded).interval(), (low, high))


def test_days_are_matched_by_name() -> None:
    """The order of a policy's cells, and a day that it did not drive, change nothing about which days are the same."""
    rates = {"a": (0, 5, 5, 5), "b": (0, 5, 5, 4), "c": (0, 5, 5, None)}
    rows = [
        [Cell(name, "t", f"d{k}", 5, won) for k, won in enumerate(each) if won is not None]
        for name, each in rates.items()
    ]
    found = _rates_over_days(rows, Counter())
    mixed = _rates_over_days([row[::-1] for row in rows], Counter())
    shifted = _rates_over_days([rows[0], rows[1][::-1], rows[2]], Counter())
    for others in (mixed, shifted):
        ends, expected = ([(one.low, one.high) for one in each] for each in (others, found))
        assert np.allclose(ends, expected)


def test_a_covariate_pulls_a_rate_towards_itself() -> None:
    won, trials = np.array([[5, 5], [5, 5], [0, 0], [0, 0], [5, 0], [5, 0]]), np.full((6, 2), 5)
    x = np.array([3.0, 3.0, -3.0, -3.0, 3.0, -3.0])
    mean = RateModel.fit(won, trials, x).mean()
    assert mean[4] > mean[5] + 0.1
    assert np.allclose(*RateModel.fit(won, trials).mean()[4:])


def test_samples_follow_the_posterior() -> None:
    won = np.array([[5, 5, 0, 5], [0, 1, 0, 0], [5, 4, 5, 5]])
    model = RateModel.fit(won, np.full(won.shape, 5), shared_days=False)
    samples = model.sample(np.random.default_rng(0), 20_000)
    assert np.allclose(samples.mean(0), model.mean(), atol=0.01)
    low, high = model.interval()
    assert np.allclose(((low <= samples) & (samples <= high)).mean(0), 0.9, atol=0.02)


def test_hundreds_of_days_are_no_rate_of_zero() -> None:
    """Two policies of rate 1/2, one alike within each day and one not: no ρ fits both."""
    won = np.array([[0, 10] * 200, [5, 5] * 200])
    for shared in (False, True):
        model = RateModel.fit(won, np.full(won.shape, 10), shared_days=shared)
        assert model.mean() == pytest.approx([0.5, 0.5], abs=0.05)
        samples = model.sample(np.random.default_rng(0), 1000).mean(0)
        assert samples == pytest.approx([0.5, 0.5], abs=0.05)


def test_cells_are_shrunk_towards_their_policy() -> None:
    means = RateModel.fit([[5, 0, 5, 5], [0, 0, 0, 5]], np.full((2, 4), 5), shared_days=False).cell_means()
    assert means[0, 1] < 0.5 < means[0, 0] and means[0, 1] > means[1, 0]
    assert means[1, 3] < means[0, 0]


@pytest.mark.parametrize(
    ("won", "trials"), [([[50] * 4] * 8 + [[0] * 4], 50), ([[50] * 5] * 3 + [[49] * 5], 50), ([[5, 5], [0, 0]], 5)]
)
def test_a_rate_lies_in_its_interval(won: list[list[int]], trials: int) -> None:
    rows = [[Cell(f"p{i}", "t", f"d{k}", trials, n) for k, n in enumerate(row)] for i, row in enumerate(won)]
    model = zip(*RateModel.fit(won, np.full(np.shape(won), trials)).interval(), strict=True)
    for one, row, (low, high) in zip(_rates_over_days(rows, Counter()), won, model, strict=True):
        assert one.value == pytest.approx(np.mean(row) / trials) and one.low <= one.value <= one.high
        assert one.low <= low and one.high >= high  # the interval is only widened


def test_padding_changes_nothing_and_wrong_counts_are_refused() -> None:
    cells = [Cell("p", "t", "day", 5, 3), Cell("p", "t", "dusk", 5, 5)], [Cell("q", "t", "day", 4, 2)]
    won, trials = unit_counts(cells, by_day=True)
    assert won.tolist() == [[3, 5], [2, 0]] and trials.tolist() == [[5, 5], [4, 0]]
    padded = RateModel.fit(np.pad(won, ((0, 0), (0, 3))), np.pad(trials, ((0, 0), (0, 3))))
    assert np.allclose(padded.interval(), RateModel.fit(won, trials).interval())
    for successes, driven in (([[6]], [[5]]), ([[-1]], [[5]]), ([[1, 2]], [[5]])):
        with pytest.raises(ValueError, match="expected 0 ≤ successes ≤ trials"):
            RateModel.fit(successes, driven)


def test_more_policies_on_the_same_days_do_not_replace_days() -> None:
    def lowest(policies: int, days: int) -> float:
        won = np.full((policies, days), 5)
        return float(RateModel.fit(won, won).interval()[0][0])

    assert lowest(36, 4) < lowest(1, 20) and lowest(8, 4) < 0.97


@pytest.mark.parametrize("kind", ["recorded", "graded", "shared weather"])
def test_intervals_cover_the_rates_over_days(kind: str) -> None:
    """100 worlds of 8 policies only; `benchmarks/intervals.py` has the precise figures."""
    shape = Shape(places=1, setups=0, trainings=8, checkpoints=1, days=4, twin_trials=5)
    worlds = simulate(np.random.default_rng(0), KINDS[kind], shape, 100)
    held = []
    for won, true in zip(worlds.real[:, 0], worlds.policy_rates()[:, 0], strict=True):
        low, high = RateModel.fit(won, np.full(won.shape, 5)).interval()
        held.append((low <= true) & (true <= high))
    assert 0.84 <= np.mean(held) <= 0.98, np.mean(held)
