"""Forecast of real success rates from rates in the twin: the numbers, of which `report/` makes pages and tables.

A *candidate* is a policy on a task. Its twin score is the mean of its rates under the *compared lightings*: the twin's
lightings that real cells of the task are compared with, or all of them without real trials. It is *driven* if it has
real trials. A *group* is the driven candidates of one task, or of all tasks. Every number is an `Estimate` with its
count and interval, or with the reason for its absence.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from twin.config_file import parse_table
from twin.errors import InputError, join_names
from twin.evaluation import ranking
from twin.evaluation.bootstrap import (
    REPLICATES,
    Rates,
    bootstrap_interval,
    mean_over_tasks,
    observed_rates,
    pair_cells,
    resample,
)
from twin.evaluation.ranking import TrialCounts
from twin.evaluation.statistics import (
    CONFIDENCE,
    MIN_POLICIES,
    MIN_TRIALS,
    LinearCorrection,
    UndefinedStatistic,
    leave_one_group_out,
    mean_rate,
    mmrv,
    mmrv_batched,
    pearson,
    pearson_batched,
    prediction_powered_mean,
    rate_difference,
    spearman,
    spearman_batched,
    wilson,
    winner_batched,
)
from twin.evaluation.trials import Cell
from twin.files import exists, read_json, wrap_read_errors, write_json
from twin.types import Array

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

    @property
    def within_chance(self) -> bool:
        """True if the interval of `bias` contains 0."""
        return (self.bias.low or 0.0) <= 0.0 <= (self.bias.high or 0.0)


@dataclass(frozen=True)
class Candidate:
    """A policy on a task."""

    policy: str
    task: str
    lightings: tuple[str, ...]
    """The twin's lightings of its score."""
    twin: Estimate
    """Twin score."""
    twin_rank: Estimate
    """Expected rank among the task's candidates (1 is best), and its interval."""
    twin_ranks: tuple[float, ...]
    """Probability of each rank in the twin."""
    real: Estimate
    """Mean over its real cells."""
    real_ranks: tuple[float, ...]
    """Probability of each rank on the road among the driven candidates; empty if it is not one of several."""
    corrected: Estimate
    """Real rate predicted from its twin score and the other driven candidates."""
    trained: Estimate = Estimate(missing="its training on this task is not known")
    """Success rate in training before it was saved."""

    @property
    def driven(self) -> bool:
        return self.real.value is not None


@dataclass(frozen=True)
class Agreement:
    """Agreement of twin and road for a group."""

    task: str
    policies: int
    cells: int
    missing: tuple[str, ...]
    """Missing data, because of which the estimates below have no values."""
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
    draws: int = REPLICATES
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
    """A JSON value without its nulls, whose fields have defaults."""
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
    # A policy without any compared lighting gets a score over its own lightings, which is not compared.
    cells = [mine or [c for c in twin if c.policy == p] for p, mine in zip(policies, cells, strict=True)]
    driven = [[c for c in real if c.policy == p] for p in policies]
    rng = np.random.default_rng([seed, 1])
    ranks = ranking.rank_probabilities(_trial_counts(cells), rng)
    with_real = [i for i, mine in enumerate(driven) if mine]
    real_ranks: dict[int, Array] = {}
    if len(with_real) > 1:
        each = ranking.rank_probabilities(_trial_counts([driven[i] for i in with_real]), rng)
        real_ranks = dict(zip(with_real, each, strict=True))
    corrected = _corrected(cells, driven, lightings, {cell.key: cell for cell in twin})
    out = []
    for i, policy in enumerate(policies):
        out.append(
            Candidate(
                policy=policy,
                task=task,
                lightings=tuple(c.lighting for c in cells[i]),
                twin=_mean_rate(cells[i]),
                twin_rank=Estimate(*ranking.rank_interval(ranks[i]), len(policies)),
                twin_ranks=tuple(float(p) for p in ranks[i]),
                real=_mean_rate(driven[i]) if driven[i] else Estimate(missing="not driven on the road"),
                real_ranks=tuple(float(p) for p in real_ranks.get(i, ())),
                corrected=corrected[i],
            )
        )
    return sorted(out, key=lambda c: (c.twin_rank.value or 0.0, c.policy)), lightings


def _corrected(
    cells: list[list[Cell]], driven: list[list[Cell]], lightings: tuple[str, ...], twin: Cells
) -> list[Estimate]:
    """Real rate of each candidate, predicted from the other driven ones."""
    scores = {i: _scores(mine, twin) for i, mine in enumerate(driven) if mine}
    missing = "; ".join(_missing_data([cell for mine in driven for cell in mine], twin))
    out = []
    for i, mine in enumerate(cells):
        others = [pair for j, pair in scores.items() if j != i]
        if missing or len(others) < MIN_POLICIES:
            too_few = f"{len(others)} other policies driven, {MIN_POLICIES} needed"
            out.append(Estimate(missing=missing or too_few))
        elif {c.lighting for c in mine} != set(lightings):
            out.append(Estimate(missing=f"not validated under {join_names(lightings)}, as the driven policies are"))
        else:
            line = LinearCorrection.fit(twin=[f for f, _ in others], real=[y for _, y in others])
            score = scores[i][0] if i in scores else _mean_rate(mine).value
            value, low, high = (float(x) for x in line.predict(np.array(score)))
            out.append(Estimate(value, low, high, line.n))
    return out


def _scores(real: Sequence[Cell], twin: Cells) -> tuple[float, float]:
    """Mean twin and mean real rate of one policy's real cells."""
    return float(np.mean([twin[c.twin_key].rate for c in real])), float(np.mean([c.rate for c in real]))


def _trial_counts(rows: Sequence[Sequence[Cell]]) -> TrialCounts:
    return TrialCounts.from_rows([[(c.successes, c.trials) for c in row] for row in rows])


def _mean_rate(cells: Sequence[Cell]) -> Estimate:
    return Estimate(*mean_rate([c.successes for c in cells], [c.trials for c in cells]), sum(c.trials for c in cells))


def _rate(successes: int, trials: int) -> Estimate:
    low, high = wilson(successes, trials)
    return Estimate(successes / trials, float(low), float(high), trials)


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


def _agreement(task: str, real: Sequence[Cell], twin: Cells, candidates: list[Candidate], seed: int) -> Agreement:
    missing = _missing_data(real, twin)
    data = pair_cells(real, twin)
    if missing:
        none = Estimate(n=data.policies, missing="; ".join(missing))
        return Agreement(task, data.policies, data.cells, tuple(missing), *(none,) * 9)
    observed, replicates = observed_rates(data), resample(data, np.random.default_rng([seed, 2]))
    return Agreement(
        task=task,
        policies=data.policies,
        cells=data.cells,
        missing=(),
        pearson=_statistic(pearson, pearson_batched, observed, replicates),
        spearman=_statistic(spearman, spearman_batched, observed, replicates),
        mmrv=_statistic(mmrv, mmrv_batched, observed, replicates),
        **_winner(observed, replicates),
        bias=_bootstrapped(float(observed.difference), replicates.difference, data.cells),
        coverage=_bootstrapped(float(observed.compatible), replicates.compatible, data.cells),
        corrected_coverage=_corrected_coverage(observed),
        mean_real=_mean_real(observed, candidates),
    )


def _statistic(of: Callable[..., float], batched: Callable[..., Array], observed: Rates, replicates: Rates) -> Estimate:
    n = len(observed.twin)
    try:
        value = of(twin=observed.twin, real=observed.real)
    except UndefinedStatistic as refusal:
        return Estimate(n=n, missing=str(refusal))
    return _bootstrapped(value, batched(twin=replicates.twin, real=replicates.real), n)


def _bootstrapped(value: float, replicates: Array, n: int) -> Estimate:
    ends = bootstrap_interval(value, replicates)
    if ends is None:
        return Estimate(n=n, missing="most resampled experiments have rates that are all the same")
    return Estimate(value, *ends, n)


def _winner(observed: Rates, replicates: Rates) -> dict[str, Estimate]:
    """Agreement and regret of the winner, as means over tasks."""
    n, names = len(observed.twin), ("winner_agreement", "winner_regret")
    if all(len(members) < 2 for members in observed.strata):
        return dict.fromkeys(names, Estimate(n=n, missing="no task has two policies"))
    values, resampled = (mean_over_tasks(winner_batched, rates) for rates in (observed, replicates))
    return {k: _bootstrapped(float(v), r, n) for k, v, r in zip(names, values, resampled, strict=True)}


def _corrected_coverage(observed: Rates) -> Estimate:
    """Coverage of leave-one-out predictions, task by task."""
    hits: list[bool] = []
    for members in observed.strata:
        twin, real = observed.twin[members], observed.real[members]
        try:
            _, low, high = leave_one_group_out(twin=twin, real=real, groups=range(len(members)))
        except UndefinedStatistic:
            continue
        hits += list((low <= real) & (real <= high))
    if not hits:
        return Estimate(missing=f"{MIN_POLICIES + 1} policies of a task driven on the road are needed")
    return _rate(int(sum(hits)), len(hits))


def _mean_real(observed: Rates, candidates: list[Candidate]) -> Estimate:
    further = [c.twin.value for c in candidates if not c.driven and c.twin.value is not None]
    try:
        mean = prediction_powered_mean(twin=observed.twin, real=observed.real, twin_only=further)
    except UndefinedStatistic as refusal:
        return Estimate(missing=str(refusal))
    return Estimate(mean.value, max(mean.low, 0.0), min(mean.high, 1.0), len(observed.twin) + len(further))


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
                estimates = _mean(twin_error), _mean(error), _rate(int(inside.sum()), n)
        out.append(LeftOutLighting(task, name, n, *estimates))
    return out


def _mean(values: Array) -> Estimate:
    """Mean of absolute differences, with Student's t interval, clipped at 0."""
    n, mean = len(values), float(values.mean())
    if n < 2:
        return Estimate(mean, n=n)
    half = float(student.ppf(0.5 + CONFIDENCE / 2, n - 1) * values.std(ddof=1) / np.sqrt(n))
    return Estimate(mean, max(mean - half, 0.0), mean + half, n)


def _pair(cell: Cell, mate: Cell) -> CellPair:
    value, low, high = rate_difference(
        twin_successes=mate.successes,
        twin_trials=mate.trials,
        real_successes=cell.successes,
        real_trials=cell.trials,
    )
    bias = Estimate(float(value), float(low), float(high), cell.trials)
    rates = _rate(mate.successes, mate.trials), _rate(cell.successes, cell.trials)
    return CellPair(cell.policy, cell.task, cell.lighting, mate.lighting, *rates, bias)


def _allocation(task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int) -> TrialAllocation:
    on_road = len({cell.policy for cell in real}) > 1
    basis, cells = ("road", real) if on_road else ("twin", twin)
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    if len(policies) < 2:
        return TrialAllocation(task, len(policies), basis, None, None, 0, 0)
    counts = _trial_counts([[c for c in cells if c.policy == policy] for policy in policies])
    now = ranking.expected_confidence(counts, 0, seed, on_road)
    more = [ranking.trials_needed(counts, what, seed, on_road) for what in ("winner", "order")]
    return TrialAllocation(task, len(policies), basis, now.winner, now.order, *more)
