"""Forecast of real success rates from rates in the twin: the numbers, of which `report/` makes pages and tables.

A *candidate* is a policy on a task. Its twin score is the mean of its rates under the *compared lightings*: the twin's
lightings that real cells of the task are compared with, or all of them without real trials. It is *driven* if it has
real trials. A *group* is the driven candidates of one task, or of all tasks. A *day* is a lighting of the real trials;
a *training* is a run, with all its checkpoints.

Every number is an `Estimate`: a value with its count, or the reason why there is no value; and a 90 % interval where
one is known to have that coverage, or the reason why there is none. Intervals are about the population of trainings and
days of which these are a sample (modules `jackknife` and `rate_model`, with their coverage in
`benchmarks/intervals.py`), not about these cells.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.config_file import parse_table
from twin.errors import InputError, join_names
from twin.evaluation import ranking
from twin.evaluation.jackknife import (
    STATISTICS,
    PairedCells,
    jackknife_interval,
    mean_bias,
    mean_over_tasks,
    pair_cells,
    training_of,
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
from twin.evaluation.rate_model import MIN_RATE_DAYS, RateModel, padded_counts
from twin.evaluation.statistics import (
    CONFIDENCE,
    MIN_POLICIES,
    MIN_PREDICTORS,
    MIN_TRIALS,
    LinearCorrection,
    UndefinedStatistic,
    leave_one_group_out,
    mean_rate,
    mmrv,
    pearson,
    prediction_powered_mean,
    rate_difference,
    spearman,
    winner_batched,
)
from twin.evaluation.trials import Cell
from twin.files import exists, read_json, wrap_read_errors, write_json
from twin.types import Array, Indices

ALL_TASKS = "all tasks"
_FILE = "forecast.json"

Cells = Mapping[tuple[str, str, str], Cell]
"""The twin's cells by `Cell.key`."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval, or the reason for its absence."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    """Number of trials for a rate, of policies or cells for a statistic."""
    missing: str = ""
    """The reason; empty if there is a value."""
    no_interval: str = ""
    """The reason why the value has no interval, and what is missing for one; else empty."""


@dataclass(frozen=True)
class CellPair:
    """A real cell and the twin cell it is compared with."""

    policy: str
    task: str
    lighting: str
    twin_lighting: str
    twin: Estimate
    real: Estimate
    bias: Estimate
    """Real minus twin rate."""
    within_chance: bool
    """True if Newcombe's interval of the difference, with independent trials, contains 0."""


@dataclass(frozen=True)
class Candidate:
    """A policy on a task."""

    policy: str
    task: str
    lightings: tuple[str, ...]
    """The twin's lightings of its score."""
    twin: Estimate
    """Twin score. Its interval is over days if days are compared with several of its lightings; otherwise over the
    episodes under its lightings."""
    twin_rank: Estimate
    """Expected rank among the task's candidates (1 is best), and its interval."""
    twin_ranks: tuple[float, ...]
    """Probability of each rank in the twin."""
    real: Estimate
    """Mean over its real cells; its interval is over days."""
    real_ranks: tuple[float, ...]
    """Probability of each rank on the road among the driven candidates; empty unless it and another one are driven."""
    corrected: Estimate
    """Real rate predicted from its twin score and the driven candidates of other trainings."""
    trained: Estimate = Estimate(missing="its training on this task is not known")
    """Success rate in training before it was saved."""

    @property
    def driven(self) -> bool:
        return self.real.value is not None


@dataclass(frozen=True)
class PredictorScore:
    """Scores of a predictor of the trials on the road; see `probability_scores`. Lower is better."""

    predictor: str
    brier: Estimate
    log: Estimate
    gain: Estimate
    """Log score of this predictor minus that of the twin: above 0 the twin is better. Missing for the twin itself."""


@dataclass(frozen=True)
class OrderedPairs:
    """Pairs of policies of one task with different real rates, by the difference of their twin scores."""

    low: float
    high: float
    pairs: int
    right: float
    """Number of pairs in the road's order; a pair tied in the twin counts one half."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of twin and road for a group."""

    task: str
    policies: int
    cells: int
    missing: tuple[str, ...]
    """Data that are missing; if any are, the estimates below have no values."""
    pearson: Estimate
    spearman: Estimate
    mmrv: Estimate
    winner_agreement: Estimate
    winner_regret: Estimate
    bias: Estimate
    """Mean over cells of real minus twin rate."""
    coverage: Estimate
    """Fraction of cells for which the interval of `CellPair.bias` contains 0."""
    corrected_coverage: Estimate
    """Fraction of candidates whose real rate lies in the interval predicted without them."""
    mean_real: Estimate
    """Prediction-powered mean real rate of policies such as these, driven or not."""
    trainings: int = 0
    days: int = 0
    twin_error: Estimate = Estimate(missing="not measured")
    """Mean over policies of the absolute difference of real rate and twin score."""
    scores: tuple[PredictorScore, ...] = ()
    """The twin first, then its recalibration and the baselines."""
    calibration: tuple[CalibrationBin, ...] = ()
    errors: tuple[DayErrors, ...] = ()
    ordered: tuple[OrderedPairs, ...] = ()


@dataclass(frozen=True)
class LeftOutLighting:
    """Prediction of one real lighting from the task's others."""

    task: str
    lighting: str
    cells: int
    twin_error: Estimate
    """Mean absolute difference of twin and real rates."""
    corrected_error: Estimate
    """The same after a correction fitted under the other lightings."""
    coverage: Estimate
    """Fraction of cells within the predicted interval."""


@dataclass(frozen=True)
class TrialAllocation:
    """Further real trials that would settle the ranking of a task's policies; see `ranking.py`."""

    task: str
    policies: int
    basis: str
    """`road`: trials are added to the real ones; `twin`: there are none, and the twin's rates are assumed."""
    winner_now: float | None = None
    """See `RankingConfidence.winner`."""
    order_now: float | None = None
    """See `RankingConfidence.order`."""
    more_for_winner: int | None = None
    """Real trials per policy until `winner_now` is expected to reach `sure`; None: more than `ranking.MAX_TRIALS`."""
    more_for_order: int | None = None


@dataclass(frozen=True)
class Forecast:
    """The forecast of a scene; field names are the keys of `forecast.json`."""

    scene: str
    twin_trials: int
    real_trials: int
    tasks: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    """Task by task, best in the twin first."""
    pairs: tuple[CellPair, ...]
    groups: tuple[Agreement, ...]
    left_out: tuple[LeftOutLighting, ...]
    plans: tuple[TrialAllocation, ...]
    confidence: float = CONFIDENCE
    draws: int = ranking.SAMPLES
    seed: int = 0
    sure: float = ranking.SETTLED_PROBABILITY
    margin: float = ranking.MARGIN

    def candidates_of(self, task: str) -> list[Candidate]:
        return [c for c in self.candidates if c.task == task]

    def save(self, folder: Path) -> None:
        """Writes `forecast.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / _FILE, asdict(self))

    @staticmethod
    def load(folder: Path) -> "Forecast":
        """Reads `forecast.json`. Raises InputError: no such file, or an invalid one."""
        path = folder / _FILE
        if not exists(path):
            raise InputError(f"{path} does not exist; run python -m twin.forecast SCENE")
        with wrap_read_errors(path, "run python -m twin.forecast SCENE anew"):
            try:
                return parse_table(Forecast, _without_nulls(read_json(path)), str(path))
            except InputError as error:
                raise InputError(f"{error}; run python -m twin.forecast SCENE anew") from None


def _without_nulls(value: Any) -> Any:
    """A JSON value without entries that are null, so that the records' fields take their defaults."""
    if isinstance(value, dict):
        return {key: _without_nulls(item) for key, item in value.items() if item is not None}
    return [_without_nulls(item) for item in value] if isinstance(value, list) else value


# ---- computation


def make_forecast(
    scene: str,
    twin: Sequence[Cell],
    real: Sequence[Cell],
    seed: int = 0,
    trained: Mapping[tuple[str, str], Estimate] | None = None,
) -> Forecast:
    """Computes a forecast.

    Args:
        scene: Name of the scene.
        twin: Cells of the twin.
        real: Real cells, each with a twin cell to compare with; may be empty.
        seed: Of the resampling.
        trained: Success rates in training by (policy, task), where known.
    """
    tasks = tuple(dict.fromkeys(cell.task for cell in twin))
    found = {cell.key: cell for cell in twin}
    candidates: list[Candidate] = []
    comparable: list[Candidate] = []
    groups, left_out, allocations = [], [], []
    for task in tasks:
        task_twin, task_real = ([cell for cell in cells if cell.task == task] for cells in (twin, real))
        task_candidates, lightings = _candidates(task, task_twin, task_real, seed)
        if task_real:
            task_comparable = [c for c in task_candidates if set(c.lightings) == set(lightings)]
            groups.append(_agreement(task, task_real, found, task_comparable, seed))
            comparable += task_comparable
            left_out += _left_out(task, task_real, found)
        allocations.append(_allocation(task, [c for c in task_twin if c.lighting in lightings], task_real, seed))
        candidates += [replace(c, trained=(trained or {}).get((c.policy, task), c.trained)) for c in task_candidates]
    if len(groups) > 1:
        groups.append(_agreement(ALL_TASKS, real, found, comparable, seed))
    return Forecast(
        scene=scene,
        twin_trials=sum(cell.trials for cell in twin),
        real_trials=sum(cell.trials for cell in real),
        candidates=tuple(candidates),
        pairs=tuple(_pair(cell, found[cell.twin_key]) for cell in real),
        groups=tuple(groups),
        left_out=tuple(left_out),
        plans=tuple(allocations),
        seed=seed,
        tasks=tasks,
    )


def _candidates(
    task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int
) -> tuple[list[Candidate], tuple[str, ...]]:
    """The candidates of a task, best in the twin first, and the compared lightings."""
    lightings = tuple(dict.fromkeys(cell.lighting for cell in twin))
    if real:
        compared = {cell.twin_key[2] for cell in real}
        lightings = tuple(name for name in lightings if name in compared)
    policies = list(dict.fromkeys(cell.policy for cell in twin))
    cells = [[c for c in twin if c.policy == p and c.lighting in lightings] for p in policies]
    # A policy that was not validated under any compared lighting is scored over all of its own lightings instead.
    cells = [mine or [c for c in twin if c.policy == p] for p, mine in zip(policies, cells, strict=True)]
    driven = [[c for c in real if c.policy == p] for p in policies]
    rng = np.random.default_rng([seed, 1])
    by_day = bool(real) and len(lightings) > 1
    ranks = ranking.rank_probabilities(_sampled_rates(cells, by_day, rng))
    with_real = [i for i, mine in enumerate(driven) if mine]
    real_ranks: dict[int, Array] = {}
    if len(with_real) > 1:
        each = ranking.rank_probabilities(_sampled_rates([driven[i] for i in with_real], True, rng))
        real_ranks = dict(zip(with_real, each, strict=True))
    twin_rates = _rates_over_days(cells, road=False) if by_day else [_mean_rate(mine) for mine in cells]
    real_rates = dict(zip(with_real, _rates_over_days([driven[i] for i in with_real]), strict=True))
    corrected = _corrected(cells, driven, lightings, {cell.key: cell for cell in twin})
    out = []
    for i, policy in enumerate(policies):
        out.append(
            Candidate(
                policy=policy,
                task=task,
                lightings=tuple(c.lighting for c in cells[i]),
                twin=twin_rates[i],
                twin_rank=Estimate(*ranking.rank_interval(ranks[i]), len(policies)),
                twin_ranks=tuple(float(p) for p in ranks[i]),
                real=real_rates.get(i, Estimate(missing="not driven on the road")),
                real_ranks=tuple(float(p) for p in real_ranks.get(i, ())),
                corrected=corrected[i],
            )
        )
    return sorted(out, key=lambda c: (c.twin_rank.value or 0.0, c.policy)), lightings


def _corrected(
    cells: list[list[Cell]], driven: list[list[Cell]], lightings: tuple[str, ...], twin: Cells
) -> list[Estimate]:
    """Real rate of each candidate, predicted from the driven candidates of other trainings."""
    scores = {i: _scores(mine, twin) for i, mine in enumerate(driven) if mine}
    missing = "; ".join(_missing_data([cell for mine in driven for cell in mine], twin))
    out = []
    for i, mine in enumerate(cells):
        training = training_of(mine[0].policy)
        others = [pair for j, pair in scores.items() if training_of(cells[j][0].policy) != training]
        if missing or len(others) < MIN_POLICIES:
            too_few = f"{len(others)} policies of other trainings driven, {MIN_POLICIES} needed"
            out.append(Estimate(missing=missing or too_few))
        elif {c.lighting for c in mine} != set(lightings):
            out.append(Estimate(missing=f"not validated under {join_names(lightings)}, as the driven policies are"))
        else:
            line = LinearCorrection.fit(twin=[f for f, _ in others], real=[y for _, y in others])
            score = scores[i][0] if i in scores else _mean_rate(mine).value
            value, low, high = map(float, line.predict(np.array(score)))
            if line.n < MIN_PREDICTORS:
                few = f"too few for an interval: {line.n} policies of other trainings, {MIN_PREDICTORS} are needed"
                out.append(Estimate(value, n=line.n, no_interval=few))
            else:
                out.append(Estimate(value, low, high, line.n))
    return out


def _scores(real: Sequence[Cell], twin: Cells) -> tuple[float, float]:
    """Mean twin and mean real rate of one policy's real cells."""
    return float(np.mean([twin[c.twin_key].rate for c in real])), float(np.mean([c.rate for c in real]))


def _counts(rows: Sequence[Sequence[Cell]], by_day: bool) -> tuple[Indices, Indices]:
    """Successes and trials of each policy's units: a unit is a cell if `by_day`, else a single episode."""
    if by_day:
        return padded_counts([[(c.successes, c.trials) for c in row] for row in rows])
    won = [sum(c.successes for c in row) for row in rows]
    driven = [sum(c.trials for c in row) for row in rows]
    return padded_counts([[(int(k < w), 1) for k in range(n)] for w, n in zip(won, driven, strict=True)])


def _sampled_rates(rows: Sequence[Sequence[Cell]], by_day: bool, rng: np.random.Generator) -> Array:
    """Samples of the policies' true rates, shape (samples, n). Effects of a day that all policies share are not
    modeled, since they hardly change ranks."""
    return RateModel.fit(*_counts(rows, by_day), shared_days=False).sample(rng, ranking.SAMPLES)


def _rates_over_days(rows: Sequence[Sequence[Cell]], road: bool = True) -> list[Estimate]:
    """Mean rate of each policy's cells, with an interval over days, on the road or in the twin."""
    if not rows:
        return []
    low, high = RateModel.fit(*_counts(rows, True), road=road).interval()
    out = []
    for i, row in enumerate(rows):
        value, trials = float(np.mean([c.rate for c in row])), sum(c.trials for c in row)
        if len(row) < MIN_RATE_DAYS:
            few = f"too few for an interval: {len(row)} day, {MIN_RATE_DAYS} are needed"
            out.append(Estimate(value, n=trials, no_interval=few))
        else:
            out.append(Estimate(value, float(low[i]), float(high[i]), trials))
    return out


def _mean_rate(cells: Sequence[Cell]) -> Estimate:
    """Mean rate, with an interval over episodes under these lightings."""
    return Estimate(*mean_rate([c.successes for c in cells], [c.trials for c in cells]), sum(c.trials for c in cells))


def _share(count: int, total: int, no_interval: str) -> Estimate:
    return Estimate(count / total, n=total, no_interval=no_interval)


def _missing_data(real: Sequence[Cell], twin: Cells) -> list[str]:
    """Data that are missing for a statistic over these real cells."""
    policies = len({cell.policy for cell in real})
    out = []
    if policies < MIN_POLICIES:
        more = MIN_POLICIES - policies
        out.append(f"{policies} policies driven on the road, {MIN_POLICIES} are needed: drive {more} more")
    short = [
        f"{c.policy} under {c.lighting} has {c.trials} {kind} ({MIN_TRIALS - c.trials} more)"
        for kind, cells in (
            ("real trials", real),
            ("trials in the twin", dict.fromkeys(twin[cell.twin_key] for cell in real)),
        )
        for c in cells
        if c.trials < MIN_TRIALS
    ]
    if short:
        out.append(f"cells of fewer than {MIN_TRIALS} trials: {join_names(short)}; or leave these cells out")
    return out


# ---- agreement

_DEPENDENT = "none: policies, and their predictions, depend on each other"
_MAXIMUM = "none at one place: it hangs on the best policy alone"


def _agreement(task: str, real: Sequence[Cell], twin: Cells, candidates: list[Candidate], seed: int) -> Agreement:
    missing = _missing_data(real, twin)
    data = pair_cells(real, twin)
    if missing:
        none = Estimate(n=data.policies, missing="; ".join(missing))
        return Agreement(
            task, data.policies, data.cells, tuple(missing), *(none,) * 9, data.trainings, data.days, twin_error=none
        )
    rates, pairs = data.rates(), [_pair(cell, twin[cell.twin_key]) for cell in real]
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
        coverage=_share(sum(pair.within_chance for pair in pairs), len(pairs), _DEPENDENT),
        corrected_coverage=_corrected_coverage(data),
        mean_real=_mean_real(data, candidates),
        trainings=data.trainings,
        days=data.days,
        twin_error=Estimate(float(np.abs(rates["real"] - rates["twin"]).mean()), n=data.policies),
        **_probabilities(data, real, twin),
        ordered=_ordered(data),
    )


def _statistic(name: str, of: Callable[..., float], data: PairedCells) -> Estimate:
    try:
        value = of(**data.rates())
    except UndefinedStatistic as refusal:
        return Estimate(n=data.policies, missing=str(refusal))
    try:
        low, high = jackknife_interval(STATISTICS[name], data)
    except UndefinedStatistic as refusal:
        return Estimate(value, n=data.policies, no_interval=str(refusal))
    return Estimate(value, float(low), float(high), data.policies)


def _winner(data: PairedCells) -> dict[str, Any]:
    """Agreement and regret of the winner, as means over tasks with two policies or more."""
    n, names = data.policies, ("winner_agreement", "winner_regret")
    if all(len(members) < 2 for members in data.strata):
        return dict.fromkeys(names, Estimate(n=n, missing="no task has two policies"))
    values = mean_over_tasks(winner_batched, data)
    return {k: Estimate(float(v), n=n, no_interval=_MAXIMUM) for k, v in zip(names, values, strict=True)}


def _corrected_coverage(data: PairedCells) -> Estimate:
    """Coverage of predictions from other trainings, task by task."""
    hits: list[bool] = []
    rates = data.rates()
    for members in data.strata:
        f, y = rates["twin"][members], rates["real"][members]
        groups = data.training[members]
        if len(members) - np.bincount(groups).max() < MIN_PREDICTORS:
            continue
        try:
            _, low, high = leave_one_group_out(twin=f, real=y, groups=groups.tolist())
        except UndefinedStatistic:
            continue
        hits += list((low <= y) & (y <= high))
    if not hits:
        return Estimate(missing=f"{MIN_PREDICTORS} policies of a task, of other trainings, are needed for each")
    return _share(int(sum(hits)), len(hits), _DEPENDENT)


def _mean_real(data: PairedCells, candidates: list[Candidate]) -> Estimate:
    further = [c.twin.value for c in candidates if not c.driven and c.twin.value is not None]
    rates = data.rates()
    try:
        mean = prediction_powered_mean(twin=rates["twin"], real=rates["real"], twin_only=further)
    except UndefinedStatistic as refusal:
        return Estimate(missing=str(refusal))
    alike = "none: it would take a day's trials as independent"
    return Estimate(mean.value, n=data.policies + len(further), no_interval=alike)


TWIN, RECALIBRATED, OTHERS, SHUFFLED = (
    "the twin",
    "the twin, recalibrated on other trainings",
    "without the twin: mean of the other trainings",
    "the twin, its days shuffled",
)
"""Names of predictors."""


def _probabilities(data: PairedCells, real: Sequence[Cell], twin: Cells) -> dict[str, Any]:
    """Scores of the twin and of baselines, its calibration, and its errors by day."""
    probability, several = _twin_probabilities(data, real, twin)
    logs = {TWIN: log_score(probability, data.real)}
    briers = {TWIN: brier(probability, data.real)}
    others = np.broadcast_to(other_trainings(data, np.zeros(data.policies, int))[:, None], probability.shape)
    for name, p in ((RECALIBRATED, recalibrated(probability, data)), (OTHERS, others)):
        if data.trainings > 1:
            logs[name], briers[name] = log_score(p, data.real), brier(p, data.real)
    if several:
        logs[SHUFFLED] = shuffled_days(probability, data.weight, data.real, log_score)
        briers[SHUFFLED] = shuffled_days(probability, data.weight, data.real, brier)
    scores = tuple(
        PredictorScore(
            name,
            Estimate(mean_score(data, briers[name]), n=data.cells),
            Estimate(mean_score(data, logs[name]), n=data.cells),
            _gain(data, logs[TWIN], logs[name]) if name != TWIN else Estimate(missing="compared with itself"),
        )
        for name in logs
    )
    used = data.weight > 0
    trials, days = _trials_and_days(real)
    return {
        "scores": scores,
        "calibration": calibration(probability[used], data.real[used], trials[used]),
        "errors": errors_by_day(probability[used], data.real[used], days[used].tolist()),
    }


def _gain(data: PairedCells, score: Array, baseline: Array) -> Estimate:
    pair = score_pair(data, score, baseline)
    value = float(mean_bias(**pair.rates()))
    try:
        low, high = jackknife_interval(SCORE_DIFFERENCE, pair)
    except UndefinedStatistic as refusal:
        return Estimate(value, n=data.cells, no_interval=str(refusal))
    return Estimate(value, float(low), float(high), data.cells)


def _real_rows(real: Sequence[Cell]) -> list[list[Cell]]:
    """Real cells by policy, in the order of `pair_cells`."""
    tasks = dict.fromkeys(cell.task for cell in real)
    keys = [p for task in tasks for p in dict.fromkeys((c.policy, c.task) for c in real if c.task == task)]
    return [[cell for cell in real if (cell.policy, cell.task) == key] for key in keys]


def _trials_and_days(real: Sequence[Cell]) -> tuple[Indices, NDArray[np.object_]]:
    """Trials and day of each cell, in the layout of `pair_cells`."""
    rows = _real_rows(real)
    shape = len(rows), max(map(len, rows))
    trials, days = np.zeros(shape, np.int64), np.full(shape, "", dtype=object)
    for i, row in enumerate(rows):
        for j, cell in enumerate(row):
            trials[i, j], days[i, j] = cell.trials, cell.lighting
    return trials, days


def _twin_probabilities(data: PairedCells, real: Sequence[Cell], twin: Cells) -> tuple[Array, bool]:
    """The twin's probability of success in each cell, and whether any policy has several."""
    rows = _real_rows(real)
    mine = [list(dict.fromkeys(cell.twin_key for cell in row)) for row in rows]
    several = max(map(len, mine)) > 1
    counts = _counts([[twin[key] for key in keys] for keys in mine], several)
    by_unit = twin_probabilities(*counts)
    out = np.full(data.weight.shape, 0.5)
    for i, (row, keys) in enumerate(zip(rows, mine, strict=True)):
        for j, cell in enumerate(row):
            driven = counts[1][i] > 0
            out[i, j] = by_unit[i, keys.index(cell.twin_key)] if several else by_unit[i, driven].mean()
    return out, several


_GAPS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # ends of the bins of differences of twin scores
_ROUNDING = 1e-9


def _ordered(data: PairedCells) -> tuple[OrderedPairs, ...]:
    rates = data.rates()
    gaps: list[float] = []
    right: list[float] = []
    for members in data.strata:
        f, y = rates["twin"][members], rates["real"][members]
        for i, j in zip(*np.triu_indices(len(members), 1), strict=True):
            if abs(y[i] - y[j]) > _ROUNDING:
                gap = f[i] - f[j]
                gaps.append(abs(float(gap)))
                right.append(0.5 if abs(gap) < _ROUNDING else float((gap > 0) == (y[i] > y[j])))
    index = np.clip(np.searchsorted(_GAPS, np.array(gaps) + _ROUNDING, "right") - 1, 0, len(_GAPS) - 2)
    return tuple(
        OrderedPairs(_GAPS[b], _GAPS[b + 1], int(of.sum()), float(np.array(right)[of].sum()))
        for b in range(len(_GAPS) - 1)
        if (of := index == b).any()
    )


def _left_out(task: str, real: Sequence[Cell], twin: Cells) -> list[LeftOutLighting]:
    """Each real lighting of a task predicted from the others."""
    lightings = [cell.lighting for cell in real]
    names = list(dict.fromkeys(lightings))
    twin_rate, real_rate = np.array([_scores([cell], twin) for cell in real]).T
    missing = "; ".join(_missing_data(real, twin)) or ("a second real lighting is needed" if len(names) < 2 else "")
    out = []
    for name in names:
        mine = np.array([other == name for other in lightings])
        n = int(mine.sum())
        estimates = (Estimate(missing=missing),) * 3
        if not missing:
            try:
                line = LinearCorrection.fit(twin=twin_rate[~mine], real=real_rate[~mine])
            except UndefinedStatistic:
                none = Estimate(missing=f"the other lightings have fewer than {MIN_POLICIES} cells")
                estimates = (none, none, none)
            else:
                value, low, high = line.predict(twin_rate[mine])
                inside = (low <= real_rate[mine]) & (real_rate[mine] <= high)
                twin_error, error = np.abs(twin_rate - real_rate)[mine], np.abs(value - real_rate[mine])
                estimates = (
                    Estimate(float(twin_error.mean()), n=n, no_interval=_DEPENDENT),
                    Estimate(float(error.mean()), n=n, no_interval=_DEPENDENT),
                    _share(int(inside.sum()), n, _DEPENDENT),
                )
        out.append(LeftOutLighting(task, name, n, *estimates))
    return out


def _pair(cell: Cell, mate: Cell) -> CellPair:
    value, low, high = rate_difference(
        twin_successes=mate.successes,
        twin_trials=mate.trials,
        real_successes=cell.successes,
        real_trials=cell.trials,
    )
    alone = "none for a single cell"
    in_twin, on_road = (Estimate(c.rate, n=c.trials, no_interval=alone) for c in (mate, cell))
    bias = Estimate(float(value), n=cell.trials, no_interval=alone)
    within = bool(low <= 0.0 <= high)
    return CellPair(cell.policy, cell.task, cell.lighting, mate.lighting, in_twin, on_road, bias, within)


def _allocation(task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int) -> TrialAllocation:
    on_road = len({cell.policy for cell in real}) > 1
    basis, cells = ("road", real) if on_road else ("twin", twin)
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    if len(policies) < 2:
        return TrialAllocation(task, len(policies), basis, None, None, 0, 0)
    rows = [[c for c in cells if c.policy == policy] for policy in policies]
    by_day = on_road or len({c.lighting for c in real}) > 1
    rates = _sampled_rates(rows, by_day, np.random.default_rng([seed, 3]))
    now = ranking.expected_confidence(rates, 0, seed, on_road)
    more = [ranking.trials_needed(rates, what, seed, on_road) for what in ("winner", "order")]
    return TrialAllocation(task, len(policies), basis, now.winner, now.order, *more)
