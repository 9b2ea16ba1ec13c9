"""Jackknife intervals: pairing of cells, exactness against enumeration, coverage, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from intervals import KINDS, Shape, expected, simulate
from place_intervals import MIN_PLACES, mean_difference_interval, place_interval
from scipy import stats

from twin.evaluation.agreement_intervals import (
    MIN_DAYS,
    MIN_TRAININGS,
    STATISTICS,
    PairedCells,
    jackknife_interval,
    pair_cells,
)
from twin.evaluation.statistics import UndefinedStatistic, spearman_batched
from twin.evaluation.trials import Cell

TWIN = [
    Cell("a", "straight", "sun", 10, 9),
    Cell("a", "straight", "held-out", 20, 10),
    Cell("b/000", "straight", "sun", 10, 1),
    Cell("a", "turn", "sun", 10, 4),
]
REAL = [
    Cell("b/000", "straight", "sun", 4, 1, "sun"),
    Cell("a", "turn", "sun", 8, 2, "sun"),
    Cell("a", "straight", "dusk", 5, 1, "held-out"),
    Cell("a", "straight", "dawn", 5, 2, "held-out"),
    Cell("a", "straight", "sun", 10, 10, "sun"),
]


def by_key(cells: list[Cell]) -> dict[tuple[str, str, str], Cell]:
    return {cell.key: cell for cell in cells}


def cells_of(twin: np.ndarray, real: np.ndarray, per_training: int = 1) -> PairedCells:
    """Rates (n, k) of policies on days, one task."""
    n, k = real.shape[-2:]
    training, day = np.arange(n) // per_training, np.broadcast_to(np.arange(k), (n, k))
    return PairedCells(twin, real, np.ones((n, k)), training, day, (np.arange(n),))


def random_cells(seed: int = 0, n: int = 9, k: int = 5) -> PairedCells:
    rng = np.random.default_rng(seed)
    quality = np.linspace(0.05, 0.95, n)[:, None]
    noise = rng.normal(0.0, 0.2, (2, n, k))
    return cells_of(*(np.clip(quality + one, 0.0, 1.0) for one in noise))


def test_scores_are_means_over_real_cells_and_their_twin_cells() -> None:
    data = pair_cells(REAL, by_key(TWIN))
    assert (data.policies, data.cells, data.trainings, data.days) == (3, 5, 2, 3)
    assert [list(members) for members in data.strata] == [[0, 1], [2]]  # b and a on straight, a on the turn
    assert data.training.tolist() == [0, 1, 1]  # a on two tasks is one training
    rates = data.rates()
    assert np.allclose(rates["twin"], [0.1, (0.5 + 0.5 + 0.9) / 3, 0.4])
    assert np.allclose(rates["real"], [0.25, (0.2 + 0.4 + 1.0) / 3, 0.25])


def test_leaving_out_a_day_drops_it_from_twin_and_road() -> None:
    data = pair_cells(REAL, by_key(TWIN))
    rates = data.rates(data.day != 0)  # without "sun": b, and a on the turn, drove on no other day
    assert np.allclose(rates["twin"], [0.5]) and np.allclose(rates["real"], [0.3])


def test_the_interval_of_a_mean_is_the_textbook_s_where_only_trainings_vary() -> None:
    """All days are alike, so leaving one out changes nothing; the jackknife variance of a mean over n is s²/n, with
    Student's t.
    """
    differences = np.array([0.1, -0.2, 0.3, 0.05, 0.15, -0.1])
    data = cells_of(np.full((6, 4), 0.5), 0.5 + differences[:, None] * np.ones((6, 4)))
    low, high = jackknife_interval(STATISTICS["bias"], data)
    half = stats.t.ppf(0.95, 5) * differences.std(ddof=1) / np.sqrt(6)
    assert (float(low), float(high)) == pytest.approx((differences.mean() - half, differences.mean() + half))


def test_variance_equals_enumeration() -> None:
    """A loop over policies and days leaves every unit out."""
    data = random_cells()

    def value(rows: list[int], days: list[int], hole: tuple[int, int] | None = None) -> float:
        def rate(matrix: np.ndarray, i: int) -> float:
            return float(np.mean([matrix[i, d] for d in days if hole != (i, d)]))

        pair = [[rate(matrix, i) for i in rows] for matrix in (data.twin, data.real)]
        return float(np.arcsin(stats.spearmanr(*pair).statistic))

    rows, days = list(range(9)), list(range(5))
    parts = [
        [value([r for r in rows if r != i], days) for i in rows],
        [value(rows, [d for d in days if d != j]) for j in days],
        [value(rows, days, (i, j)) for i in rows for j in days],
    ]
    training, day, both = ((len(p) - 1) * np.var(p) for p in parts)
    variance = training + day - both / 2
    variance = max(variance, 0.7 * max(training, day))
    freedom = np.clip(variance**2 / (training**2 / 8 + day**2 / 4), 4.0, 12.0)
    half = stats.t.ppf(0.95, freedom) * np.sqrt(variance)
    center = value(rows, days)
    low, high = jackknife_interval(STATISTICS["spearman"], data)
    assert float(low) == pytest.approx(np.sin(max(center - half, -np.pi / 2)))
    assert float(high) == pytest.approx(np.sin(min(center + half, np.pi / 2)))


@pytest.mark.parametrize("name", list(STATISTICS))
def test_order_of_policies_and_days_does_not_matter(name: str) -> None:
    data = random_cells(n=13)
    rng = np.random.default_rng(1)
    rows, days = rng.permutation(13), rng.permutation(5)
    shuffled = replace(
        data, twin=data.twin[rows][:, days], real=data.real[rows][:, days], training=rng.permutation(13), day=data.day
    )
    assert np.allclose(jackknife_interval(STATISTICS[name], data), jackknife_interval(STATISTICS[name], shuffled))


def test_experiments_along_an_axis_are_separate() -> None:
    one, two = random_cells(0), random_cells(1)
    both = replace(one, twin=np.stack([one.twin, two.twin]), real=np.stack([one.real, two.real]))
    ends = np.array(jackknife_interval(STATISTICS["mmrv"], both))
    for i, data in enumerate((one, two)):
        assert np.allclose(ends[:, i], jackknife_interval(STATISTICS["mmrv"], data))


def test_checkpoints_of_one_training_are_one_unit() -> None:
    """Copies of each policy as its checkpoints do not make the interval narrower."""
    data = random_cells()
    copies = cells_of(np.repeat(data.twin, 3, 0), np.repeat(data.real, 3, 0), per_training=3)
    ends = [np.array(jackknife_interval(STATISTICS["spearman"], one)) for one in (data, copies)]
    assert copies.trainings == 9 and np.ptp(ends[1]) >= 0.8 * np.ptp(ends[0])
    bias = STATISTICS["bias"]
    alone = cells_of(copies.twin, copies.real)
    assert np.ptp(jackknife_interval(bias, alone)) < 0.9 * np.ptp(jackknife_interval(bias, copies))


# ---- refusals


@pytest.mark.parametrize(("n", "k", "told"), [(MIN_TRAININGS - 1, 9, "7 trainings, 8"), (9, MIN_DAYS - 1, "3 days, 4")])
def test_too_few_units_are_refused_with_the_number_that_is_needed(n: int, k: int, told: str) -> None:
    with pytest.raises(UndefinedStatistic, match=f"too few for an interval: {told} are needed"):
        jackknife_interval(STATISTICS["spearman"], random_cells(n=n, k=k))


def test_identical_cells_have_no_interval() -> None:
    """If nothing varies, the variance cannot be estimated, and there is no interval of width zero."""
    same = cells_of(np.full((9, 5), 0.5), np.full((9, 5), 0.7))
    with pytest.raises(UndefinedStatistic, match="no interval"):
        jackknife_interval(STATISTICS["bias"], same)
    perfect = np.linspace(0.0, 1.0, 9)[:, None] * np.ones((9, 5))
    for name in ("spearman", "mmrv"):
        with pytest.raises(UndefinedStatistic, match="no interval"):
            jackknife_interval(STATISTICS[name], cells_of(perfect, perfect))


# ---- places


def test_over_places_the_place_is_the_unit() -> None:
    places = [random_cells(seed) for seed in range(MIN_PLACES + 1)]
    each = np.array([float(STATISTICS["mmrv"].of(**place.rates())) for place in places])
    value, low, high = place_interval(STATISTICS["mmrv"], places)
    half = stats.t.ppf(0.95, len(each) - 1) * each.std(ddof=1) / np.sqrt(len(each))
    assert float(value) == pytest.approx(each.mean())
    assert (float(low), float(high)) == pytest.approx((max(each.mean() - half, 0.0), each.mean() + half))
    pooled, low, high = place_interval(STATISTICS["spearman"], places, pooled=True)
    rates = [place.rates() for place in places]
    own = spearman_batched(**{key: np.concatenate([one[key] for one in rates]) for key in ("twin", "real")})
    assert float(pooled) == pytest.approx(float(own)) and low < pooled < high
    with pytest.raises(UndefinedStatistic, match="4 places, 5 are needed"):
        place_interval(STATISTICS["mmrv"], places[:4])


def test_differences_of_setups_are_paired() -> None:
    differences = np.array([0.2, 0.4, 0.3, 0.35, 0.25])
    mean, low, high = mean_difference_interval(differences)
    interval = stats.ttest_1samp(differences, 0.0).confidence_interval(0.9)
    assert (mean, low, high) == pytest.approx((0.3, interval.low, interval.high))
    with pytest.raises(UndefinedStatistic, match="4 pairs"):
        mean_difference_interval(differences[:4])
    with pytest.raises(UndefinedStatistic, match="all pairs differ by the same"):
        mean_difference_interval(np.full(6, 0.5))


# ---- coverage


@pytest.mark.parametrize("kind", ["graded", "poor twin"])
def test_intervals_cover_the_mean_over_repetitions(kind: str) -> None:
    """250 worlds only (Monte-Carlo error 0.02); `benchmarks/intervals.py` has the precise figures."""
    rng = np.random.default_rng(0)
    shape = Shape(places=1, setups=0, trainings=12, checkpoints=1, days=6, twin_trials=5)
    truth = expected(KINDS[kind], shape, rng)
    data = simulate(rng, KINDS[kind], shape, 250).places[0]
    for name, statistic in STATISTICS.items():
        low, high = jackknife_interval(statistic, data)
        held = np.mean((low <= truth[name]) & (truth[name] <= high))
        assert 0.82 <= held <= 0.98, (name, held)
