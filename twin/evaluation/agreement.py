"""Agreement of success rates in the twin and on the road: correlations, bias and scores of predictions.

A *group* is the policies of one task, or of all tasks, that were driven on the road. A *cell* is the trials of one
policy on one task under one lighting. A *day* is a lighting of the real trials; a *training* is a run, with all its
checkpoints. A statistic is an `Estimate`: a value with its sample size, or the reason why there is no value. A value
has a 90 % interval only if `benchmarks/intervals.py` confirmed this coverage. Intervals hold for the population from
which the trainings and days are a sample, not for the measured cells (see `agreement_intervals` and `rate_model`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.errors import join_names
from twin.evaluation.agreement_intervals import (
    STATISTICS,
    PairedCells,
    Statistic,
    jackknife_interval,
    mean_bias,
    pair_cells,
    policy_rows,
)
from twin.evaluation.probability_scores import (
    SCORE_DIFFERENCE,
    CalibrationBin,
    DayErrors,
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
from twin.evaluation.statistics import (
    MIN_POLICIES,
    MIN_PREDICTORS,
    MIN_TRIALS,
    UndefinedStatistic,
    leave_one_group_out,
    mmrv,
    pearson,
    prediction_powered_mean,
    rate_difference,
    spearman,
    winner,
)
from twin.evaluation.trials import Cell
from twin.types import Array, Indices

DEPENDENT = "none: policies, and their predictions, depend on each other"
"""Reason why a mean over policies or cells, or a fraction of them, has no interval."""

_ROUNDING = 1e-9
_MAXIMUM = "none for a single place, since the value depends on the best policy alone"

Cells = Mapping[tuple[str, str, str], Cell]
"""The twin's cells by `Cell.key`."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; if either is missing, the reason."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    """For a rate, the number of trials; for a statistic, the number of policies or cells."""
    missing: str = ""
    """Reason why there is no value; empty if there is one."""
    no_interval: str = ""
    """Reason why the value has no interval; empty if it has one, and for `twin_error`, `brier` and `log`."""


@dataclass(frozen=True)
class CellPair:
    """A real cell and the twin's cell with which it is compared."""

    policy: str
    task: str
    lighting: str
    twin_lighting: str
    twin: Estimate
    real: Estimate
    bias: Estimate
    """Real minus twin rate."""
    within_chance: bool
    """True if Newcombe's interval of the difference, which treats trials as independent, contains 0."""


@dataclass(frozen=True)
class PredictorScore:
    """Scores of a predictor of the trials on the road; see `probability_scores`. Lower is better."""

    predictor: str
    brier: Estimate
    log: Estimate
    gain: Estimate
    """Log score of this predictor minus that of the twin; above 0, the twin is better. Missing for the twin itself."""


@dataclass(frozen=True)
class OrderedPairs:
    """Pairs of policies of one task whose real rates differ, and whose twin scores differ by `low` to `high`.

    Pairs that are tied in the twin are counted apart: there both limits are 0.
    """

    low: float
    high: float
    pairs: int
    right: float
    """Number of pairs in the same order in the twin and on the road; a pair tied in the twin counts one half."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of twin and road for a group."""

    task: str
    policies: int
    cells: int
    missing: tuple[str, ...]
    """Data that are needed but missing; if any are, the estimates below have no values."""
    pearson: Estimate
    spearman: Estimate
    mmrv: Estimate
    winner_agreement: Estimate
    winner_regret: Estimate
    bias: Estimate
    """Mean over policies of real minus twin rate."""
    coverage: Estimate
    """Fraction of cells for which `CellPair.within_chance` is true."""
    corrected_coverage: Estimate
    """Fraction of policies whose real rate lies in the interval predicted from policies of other trainings."""
    mean_real: Estimate
    """Prediction-powered estimate of the mean real rate of policies like these, including those not driven."""
    trainings: int = 0
    days: int = 0
    twin_error: Estimate = Estimate(missing="not measured")
    """Mean over policies of the absolute difference of real rate and twin score."""
    scores: tuple[PredictorScore, ...] = ()
    """First the twin, then its recalibration and the baselines."""
    calibration: tuple[CalibrationBin, ...] = ()
    errors: tuple[DayErrors, ...] = ()
    ordered: tuple[OrderedPairs, ...] = ()
    tied_pairs: int = 0
    """Number of pairs of policies of one task with the same rate on the road; they are not in `ordered`."""


# ---- parts that `forecasting` also uses


def missing_data(real: Sequence[Cell], twin: Cells) -> list[str]:
    """Messages that name the data that are still missing for statistics of these real cells."""
    policies = len({cell.policy for cell in real})
    out = []
    if policies < MIN_POLICIES:
        more = MIN_POLICIES - policies
        driven = "1 policy" if policies == 1 else f"{policies} policies"
        out.append(f"{driven} driven on the road, {MIN_POLICIES} are needed: drive {more} more")
    for cells, what, cure in (
        (real, "real trials", "or leave these cells out"),
        (dict.fromkeys(twin[cell.twin_key] for cell in real), "episodes in the twin", "validate more episodes"),
    ):
        short = [f"{c.policy} under {c.lighting} has {c.trials}" for c in cells if c.trials < MIN_TRIALS]
        if short:
            out.append(f"each cell needs {MIN_TRIALS} {what}, but {join_names(short)}; {cure}")
    return out


def unit_counts(rows: Sequence[Sequence[Cell]], by_day: bool) -> tuple[Indices, Indices]:
    """Successes and trials of each policy's independent units, shapes (n, k): cells if `by_day`, or else trials."""
    units = [[(c.successes, c.trials) for c in row] for row in rows]
    if not by_day:
        totals = [np.sum(row, 0) for row in units]
        units = [[(int(k < won), 1) for k in range(driven)] for won, driven in totals]
    counts = np.zeros((2, len(units), max(map(len, units))), np.int64)
    for i, row in enumerate(units):
        counts[:, i, : len(row)] = np.transpose(row)
    return counts[0], counts[1]


def compare_cells(cell: Cell, mate: Cell) -> CellPair:
    """Compares the rate of a real cell with that of the corresponding cell `mate` of the twin."""
    value, low, high = rate_difference(
        twin_successes=mate.successes, twin_trials=mate.trials, real_successes=cell.successes, real_trials=cell.trials
    )
    alone = "none for a single cell"
    in_twin, on_road = (Estimate(c.rate, n=c.trials, no_interval=alone) for c in (mate, cell))
    bias = Estimate(float(value), n=cell.trials, no_interval=alone)
    within = bool(low <= 0.0 <= high)
    return CellPair(cell.policy, cell.task, cell.lighting, mate.lighting, in_twin, on_road, bias, within)


# ---- agreement


def measure_agreement(task: str, real: Sequence[Cell], twin: Cells, further: Sequence[float]) -> Agreement:
    """Agreement of a group's real cells with the corresponding cells of the twin.

    `further` holds the twin scores of policies without real trials, for `Agreement.mean_real`.
    """
    missing = missing_data(real, twin)
    data = pair_cells(real, twin)
    if missing:
        none = Estimate(n=data.policies, missing="; ".join(missing))
        return Agreement(
            task, data.policies, data.cells, tuple(missing), *(none,) * 9, data.trainings, data.days, twin_error=none
        )
    rates, pairs = data.rates(), [compare_cells(cell, twin[cell.twin_key]) for cell in real]
    return Agreement(
        task=task,
        policies=data.policies,
        cells=data.cells,
        missing=(),
        pearson=_statistic("pearson", pearson, data),
        spearman=_statistic("spearman", spearman, data),
        mmrv=_statistic("mmrv", mmrv, data),
        **_winner(data),
        bias=_statistic("bias", lambda **rates: float(mean_bias(**rates)), data),
        coverage=Estimate(sum(pair.within_chance for pair in pairs) / len(pairs), n=len(pairs), no_interval=DEPENDENT),
        corrected_coverage=_corrected_coverage(data),
        mean_real=_mean_real(data, further),
        trainings=data.trainings,
        days=data.days,
        twin_error=Estimate(float(np.abs(rates["real"] - rates["twin"]).mean()), n=data.policies),
        **_probabilities(data, real, twin),
        **_ordered(data),
    )


def _statistic(name: str, of: Callable[..., float], data: PairedCells) -> Estimate:
    try:
        value = of(**data.rates())
    except UndefinedStatistic as refusal:
        return Estimate(n=data.policies, missing=str(refusal))
    return _with_interval(value, STATISTICS[name], data, data.policies)


def _with_interval(value: float, statistic: Statistic, data: PairedCells, n: int) -> Estimate:
    try:
        low, high = jackknife_interval(statistic, data)
    except UndefinedStatistic as refusal:
        return Estimate(value, n=n, no_interval=str(refusal))
    return Estimate(value, float(low), float(high), n)


def _winner(data: PairedCells) -> dict[str, Any]:
    """Agreement and regret of the twin's best policy, as means over tasks with two policies or more."""
    n, names = data.policies, ("winner_agreement", "winner_regret")
    rates = data.rates()
    each = [winner(twin=rates["twin"][of], real=rates["real"][of]) for of in data.strata if len(of) > 1]
    if not each:
        return dict.fromkeys(names, Estimate(n=n, missing="no task has two policies"))
    values = np.mean(each, 0)
    return {k: Estimate(float(v), n=n, no_interval=_MAXIMUM) for k, v in zip(names, values, strict=True)}


def _corrected_coverage(data: PairedCells) -> Estimate:
    """See `Agreement.corrected_coverage`; predictions are made task by task."""
    hits: list[bool] = []
    rates = data.rates()
    for members in data.strata:
        f, y = rates["twin"][members], rates["real"][members]
        groups = data.training[members]
        if len(np.unique(groups)) <= MIN_PREDICTORS:
            continue
        _, low, high = leave_one_group_out(twin=f, real=y, groups=groups.tolist())
        hits += list(within(low, y, high)[np.isfinite(low)])
    if not hits:
        few = f"each policy needs policies of {MIN_PREDICTORS} other trainings on its task, whose rates scatter"
        return Estimate(missing=few)
    return Estimate(float(np.mean(hits)), n=len(hits), no_interval=DEPENDENT)


def within(low: Array, value: Array, high: Array) -> NDArray[np.bool_]:
    """True where a value lies in an interval, with a tolerance for rounding."""
    return np.asarray((low - _ROUNDING <= value) & (value <= high + _ROUNDING))


def _mean_real(data: PairedCells, further: Sequence[float]) -> Estimate:
    rates = data.rates()
    try:
        mean = prediction_powered_mean(twin=rates["twin"], real=rates["real"], twin_only=further)
    except UndefinedStatistic as refusal:
        return Estimate(missing=str(refusal))
    alike = "none: the formula of the interval treats the trials of a day as independent"
    if not 0.0 <= mean.value <= 1.0:
        return Estimate(missing="in the twin, the policies without real trials are unlike those driven on the road")
    return Estimate(mean.value, n=data.policies + len(further), no_interval=alike)


TWIN, RECALIBRATED, OTHERS, SHUFFLED = (
    "the twin",
    "the twin, recalibrated on other trainings",
    "without the twin: mean of the other trainings",
    "the twin, its days shuffled",
)
"""Names of the predictors in `PredictorScore`."""


def _probabilities(data: PairedCells, real: Sequence[Cell], twin: Cells) -> dict[str, Any]:
    """Scores of the twin and of the baselines; the twin's calibration, and its errors by day."""
    probability, several = _twin_probabilities(data, real, twin)
    logs = {TWIN: log_score(probability, data.real)}
    briers = {TWIN: brier(probability, data.real)}
    task = np.empty(data.policies, int)
    for k, members in enumerate(data.strata):
        task[members] = k
    others = np.broadcast_to(other_trainings(data, task)[:, None], probability.shape)
    for name, p in ((RECALIBRATED, recalibrated(probability, data)), (OTHERS, others)):
        if data.trainings > 1:
            logs[name], briers[name] = log_score(p, data.real), brier(p, data.real)
    if several:
        logs[SHUFFLED] = shuffled_days(probability, data.weight, data.real, log_score)
        briers[SHUFFLED] = shuffled_days(probability, data.weight, data.real, brier)
    scores = []
    for name in logs:
        gain = Estimate(missing="compared with itself")
        if name != TWIN:
            pair = score_pair(data, logs[TWIN], logs[name])
            gain = _with_interval(float(mean_bias(**pair.rates())), SCORE_DIFFERENCE, pair, data.cells)
        mean_brier, mean_log = (Estimate(mean_score(data, each[name]), n=data.cells) for each in (briers, logs))
        scores.append(PredictorScore(name, mean_brier, mean_log, gain))
    used = data.weight > 0
    cells = [cell for row in policy_rows(real) for cell in row]  # in the order of the mask `used`
    trials = np.array([cell.trials for cell in cells])
    return {
        "scores": tuple(scores),
        "calibration": calibration(probability[used], data.real[used], trials),
        "errors": errors_by_day(probability[used], data.real[used], [cell.lighting for cell in cells]),
    }


def _twin_probabilities(data: PairedCells, real: Sequence[Cell], twin: Cells) -> tuple[Array, bool]:
    """The twin's probability of success in each real cell, and True if some policy has several twin cells."""
    rows = policy_rows(real)
    mine = [list(dict.fromkeys(cell.twin_key for cell in row)) for row in rows]
    several = max(map(len, mine)) > 1
    counts = unit_counts([[twin[key] for key in keys] for keys in mine], several)
    by_unit = twin_probabilities(*counts)
    out = np.full(data.weight.shape, 0.5)
    for i, (row, keys) in enumerate(zip(rows, mine, strict=True)):
        for j, cell in enumerate(row):
            driven = counts[1][i] > 0
            out[i, j] = by_unit[i, keys.index(cell.twin_key)] if several else by_unit[i, driven].mean()
    return out, several


_GAPS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # edges of the bins of `OrderedPairs`


def _ordered(data: PairedCells) -> dict[str, Any]:
    rates = data.rates()
    i, j = np.concatenate([members[np.array(np.triu_indices(len(members), 1))] for members in data.strata], 1)
    twin, real = (rates[name][i] - rates[name][j] for name in ("twin", "real"))
    pairs = len(real)
    twin, real = (difference[np.abs(real) > _ROUNDING] for difference in (twin, real))
    tied = np.abs(twin) < _ROUNDING
    right = np.where(tied, 0.5, (twin > 0) == (real > 0))
    index = np.clip(np.searchsorted(_GAPS, np.abs(twin) + _ROUNDING, "right") - 1, 0, len(_GAPS) - 2)
    index[tied] = -1
    ordered = tuple(
        OrderedPairs(_GAPS[max(b, 0)], _GAPS[b + 1], int(of.sum()), float(right[of].sum()))
        for b in range(-1, len(_GAPS) - 1)
        if (of := index == b).any()
    )
    return {"ordered": ordered, "tied_pairs": pairs - len(real)}
