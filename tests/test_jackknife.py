"""The bootstrap over policies and trials: pairing of cells, resampling, coverage of intervals."""

import numpy as np
import pytest
from scipy.special import expit

from twin.evaluation.bootstrap import (
    PairedCells,
    Rates,
    bootstrap_interval,
    mean_over_tasks,
    observed_rates,
    pair_cells,
    resample,
)
from twin.evaluation.statistics import (
    CONFIDENCE,
    mmrv_batched,
    pearson_batched,
    rate_difference,
    spearman_batched,
    winner_batched,
)
from twin.evaluation.trials import Cell

TWIN = [
    Cell("a", "straight", "sun", 10, 9),
    Cell("a", "straight", "held-out", 20, 10),
    Cell("b", "straight", "sun", 10, 1),
    Cell("a", "turn", "sun", 10, 4),
]
REAL = [
    Cell("b", "straight", "sun", 4, 1, "sun"),
    Cell("a", "turn", "sun", 8, 2, "sun"),
    Cell("a", "straight", "dusk", 5, 1, "held-out"),
    Cell("a", "straight", "dawn", 5, 2, "held-out"),
    Cell("a", "straight", "sun", 10, 10, "sun"),
]


def by_key(cells: list[Cell]) -> dict[tuple[str, str, str], Cell]:
    return {cell.key: cell for cell in cells}


def test_scores_are_means_over_real_cells_and_their_twin_cells() -> None:
    data = pair_cells(REAL, by_key(TWIN))
    assert (data.policies, data.cells) == (3, 5)
    assert [list(members) for members in data.strata] == [[0, 1], [2]]  # b and a on straight, a on the turn
    own = observed_rates(data)
    assert np.allclose(own.twin, [0.1, (0.5 + 0.5 + 0.9) / 3, 0.4])
    assert np.allclose(own.real, [0.25, (0.2 + 0.4 + 1.0) / 3, 0.25])
    differences = [0.15, -0.3, -0.1, 0.1, -0.15]
    assert float(own.difference) == pytest.approx(np.mean(differences))
    assert float(own.compatible) == 1.0


def test_policies_are_resampled_within_their_task() -> None:
    rates = resample(pair_cells(REAL, by_key(TWIN)), np.random.default_rng(0), 500)
    assert rates.twin.shape == rates.real.shape == (500, 3)
    # The turn has one policy, of 10 trials at about 0.4: no value of the others' 20 or 3-cell means need appear.
    assert np.allclose(rates.twin[:, 2] * 10, np.round(rates.twin[:, 2] * 10))
    assert rates.twin[:, 2].mean() == pytest.approx(4.5 / 11, abs=0.03)


def test_trials_are_resampled() -> None:
    """One policy with one cell: what varies is binomial, at the rate shrunk by half a trial."""
    cells = [Cell("a", "t", "sun", 30, 6)]
    rates = resample(pair_cells(cells, by_key(cells)), np.random.default_rng(0), 20_000)
    rate = 6.5 / 31
    for resampled in (rates.twin, rates.real):
        assert resampled.mean() == pytest.approx(rate, abs=0.003)
        assert resampled.std() == pytest.approx(np.sqrt(rate * (1 - rate) / 30), rel=0.03)
    assert abs(np.corrcoef(rates.twin[:, 0], rates.real[:, 0])[0, 1]) < 0.03


@pytest.mark.parametrize("confidence", [0.5, 0.9])
def test_resampled_cells_agree_at_the_confidence_asked_for(confidence: float) -> None:
    """One policy with one cell: its successes are known from its rates, and so is the interval of their difference."""
    cells = [Cell("a", "t", "sun", 30, 12)]
    data = pair_cells(cells, by_key(cells))
    rates = resample(data, np.random.default_rng(0), 500, confidence)
    won = {"twin_successes": np.rint(30 * rates.twin[:, 0]), "real_successes": np.rint(30 * rates.real[:, 0])}
    _, low, high = rate_difference(**won, twin_trials=30, real_trials=30, confidence=confidence)
    agree = (low <= 0.0) & (high >= 0.0)
    assert 0.3 < agree.mean() < 0.95 and np.array_equal(rates.compatible == 1.0, agree)
    if confidence == CONFIDENCE:  # which is the usual one
        assert np.array_equal(resample(data, np.random.default_rng(0), 500).compatible, rates.compatible)


def test_the_same_seed_gives_the_same_and_certain_rates_are_not_certain() -> None:
    cells = [Cell(name, "t", "sun", 10, 10) for name in "abcde"]
    one, two = (resample(pair_cells(cells, by_key(cells)), np.random.default_rng(3), 50) for _ in range(2))
    assert np.array_equal(one.twin, two.twin) and np.array_equal(one.compatible, two.compatible)
    assert 0.9 < one.real.mean() < 1.0


def test_the_interval_contains_the_observed_value() -> None:
    again = np.linspace(0.0, 1.0, 101)
    assert bootstrap_interval(0.5, again) == pytest.approx((0.05, 0.95))
    assert bootstrap_interval(0.99, again) == pytest.approx((0.05, 0.99))
    assert bootstrap_interval(0.5, np.where(again < 0.4, np.nan, again)) == pytest.approx((0.43, 0.97))
    assert bootstrap_interval(0.5, np.where(again < 0.6, np.nan, again)) is None


def test_statistics_within_tasks_are_averaged() -> None:
    rates = Rates(
        twin=np.array([0.9, 0.1, 0.2, 0.3]),
        real=np.array([0.5, 0.8, 0.1, 0.4]),
        compatible=np.array(0.0),
        difference=np.array(0.0),
        strata=(np.array([0, 1]), np.array([2, 3])),
    )
    agreement, regret = mean_over_tasks(winner_batched, rates)
    assert float(agreement) == 0.5 and float(regret) == pytest.approx(0.15)


# ---- simulated coverage

_EXPERIMENTS, _DRAWS = 150, 200
_LEAST = 0.80 - 3 * np.sqrt(0.9 * 0.1 / _EXPERIMENTS)
"""The least that was found in worlds of all kinds is 0.80; below that, three times the Monte-Carlo error."""


def world(
    rng: np.random.Generator, n: int, twin_trials: int, real_trials: int, noise: float, spread: float
) -> PairedCells:
    """Policies of varied quality under two lightings, in a twin that promises too much and judges with some noise."""
    quality = rng.normal(0.0, spread, (n, 1)) + rng.normal(0.0, 0.3, (n, 2))
    real = expit(quality)
    twin = expit(quality + 0.5 + rng.normal(0.0, noise, (n, 1)))
    trials = np.full((n, 2), twin_trials), np.full((n, 2), real_trials)
    of = np.broadcast_to(np.arange(2), (n, 2))
    won = rng.binomial(trials[0], twin), rng.binomial(trials[1], real)
    return PairedCells(trials[0], won[0], of, trials[1], won[1], np.ones((n, 2)), (np.arange(n),))


def statistics(rates: Rates) -> dict[str, np.ndarray]:
    agreement, regret = winner_batched(twin=rates.twin, real=rates.real)
    return {
        "pearson": pearson_batched(twin=rates.twin, real=rates.real),
        "spearman": spearman_batched(twin=rates.twin, real=rates.real),
        "mmrv": mmrv_batched(twin=rates.twin, real=rates.real),
        "agreement": agreement,
        "regret": regret,
        "coverage": rates.compatible,
        "bias": rates.difference,
    }


@pytest.mark.parametrize(
    ("n", "twin_trials", "real_trials", "noise", "spread"),
    [(12, 100, 50, 0.5, 1.5), (6, 100, 10, 0.7, 1.5), (12, 100, 20, 3.0, 1.5)],
    ids=["usual", "few", "a poor twin"],
)
def test_intervals_cover_the_mean_over_experiments(
    n: int, twin_trials: int, real_trials: int, noise: float, spread: float
) -> None:
    rng = np.random.default_rng(n + real_trials)
    settings = (n, twin_trials, real_trials, noise, spread)
    many = [statistics(observed_rates(world(rng, *settings))) for _ in range(700)]
    mean = {name: float(np.nanmean([one[name] for one in many])) for name in many[0]}
    held: dict[str, list[bool]] = {name: [] for name in mean}
    for _ in range(_EXPERIMENTS):
        data = world(rng, *settings)
        own, again = statistics(observed_rates(data)), statistics(resample(data, rng, _DRAWS))
        for name, aim in mean.items():
            ends = bootstrap_interval(float(own[name]), again[name])
            assert ends is not None
            held[name].append(ends[0] - 1e-9 <= aim <= ends[1] + 1e-9)
    coverage = {name: float(np.mean(hits)) for name, hits in held.items()}
    assert min(coverage.values()) >= _LEAST, coverage
    assert np.mean(list(coverage.values())) >= 0.85, coverage
