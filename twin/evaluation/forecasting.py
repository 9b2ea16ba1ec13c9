"""Forecast of real success rates from rates in the twin. `report/` makes pages and tables from these numbers.

A *candidate* is a policy on a task. Its twin score is the mean of its success rates in the twin under the *compared
lightings*: those with which the task's real trials are compared, each as often as days are compared with it, or all
lightings if there are no real trials. A candidate is *driven* if it has real trials. A *day* is a lighting of the real
trials; a *training* is a run, with all its checkpoints. `rate_model.py` gives the intervals of driven candidates,
`statistics.LinearCorrection` predicts the rates of the others. `agreement` compares the driven candidates of one task,
or of all tasks, with the twin.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from twin.config_file import parse_table
from twin.errors import InputError, join_names
from twin.evaluation.agreement import (
    DEPENDENT,
    Agreement,
    CellPair,
    Cells,
    Estimate,
    compare_cells,
    measure_agreement,
    missing_data,
    unit_counts,
    within,
)
from twin.evaluation.agreement_intervals import training_of
from twin.evaluation.rate_model import (
    MARGIN,
    MIN_RATE_DAYS,
    SAMPLES,
    SETTLED_PROBABILITY,
    RateModel,
    expected_confidence,
    rank_interval,
    rank_probabilities,
    trials_needed,
)
from twin.evaluation.statistics import (
    CONFIDENCE,
    MIN_POLICIES,
    MIN_PREDICTORS,
    LinearCorrection,
    mean_rate,
)
from twin.evaluation.trials import Cell
from twin.files import exists, read_json, wrap_read_errors, write_json
from twin.types import Array

ALL_TASKS = "all tasks"
_FILE = "forecast.json"
_NOT_KNOWN = Estimate(missing="its training on this task is not known")


@dataclass(frozen=True)
class Candidate:
    """A policy on a task."""

    policy: str
    task: str
    lightings: tuple[str, ...]
    """The twin's lightings over which its score is averaged."""
    twin: Estimate
    """Twin score. Its interval holds for further days if real days are compared with several of the twin's lightings,
    otherwise for further episodes under these lightings."""
    twin_rank: Estimate
    """Expected rank among the task's candidates (1 is best), and its interval."""
    twin_ranks: tuple[float, ...]
    """Probability of each rank in the twin."""
    real: Estimate
    """Mean rate of its real cells; the interval holds for further days."""
    real_ranks: tuple[float, ...]
    """Probability of each rank on the road among driven candidates; empty unless this and another one are driven."""
    corrected: Estimate
    """Real rate, predicted from its twin rates, in which each lighting counts as often as real days are compared with
    it, and from the rates of the driven candidates of other trainings."""
    trained: Estimate = _NOT_KNOWN
    """Success rate in the test of the policy by its training."""

    @property
    def driven(self) -> bool:
        return self.real.value is not None


@dataclass(frozen=True)
class LeftOutLighting:
    """Prediction of real rates under one lighting from the twin's, by a line fitted under the other lightings."""

    task: str
    lighting: str
    cells: int
    twin_error: Estimate
    """Mean absolute difference of twin and real rates."""
    corrected_error: Estimate
    """Mean absolute difference of predicted and real rates."""
    coverage: Estimate
    """Fraction of cells whose real rate lies in the predicted interval."""


@dataclass(frozen=True)
class TrialAllocation:
    """Further real trials that would settle the ranking of a task's policies; see `rate_model.py`."""

    task: str
    policies: int
    basis: str
    """`road`: the trials are added to those already driven. `twin`: fewer than two policies have real trials, so the
    road is assumed to have the twin's rates."""
    winner_now: float | None = None
    """See `RankingConfidence.winner`."""
    order_now: float | None = None
    """See `RankingConfidence.order`."""
    more_for_winner: int | None = None
    """Further trials per policy until `RankingConfidence.winner` reaches `Forecast.sure`; None: more than
    `rate_model.MAX_TRIALS`."""
    more_for_order: int | None = None
    """The same for `RankingConfidence.order`."""


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
    draws: int = SAMPLES
    seed: int = 0
    sure: float = SETTLED_PROBABILITY
    margin: float = MARGIN

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
            raise InputError(f"{path} does not exist; run twin forecast SCENE")
        with wrap_read_errors(path, "run twin forecast SCENE again"):
            try:
                return parse_table(Forecast, _without_nulls(read_json(path)), str(path))
            except InputError as error:
                raise InputError(f"{error}; run twin forecast SCENE again") from None


def _without_nulls(value: Any) -> Any:
    """Removes null entries from a JSON value, so that the dataclasses' fields get their defaults."""
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
        real: Real cells, each with a twin cell to compare with; may be empty.
        seed: Seed of the sampling from posteriors.
        trained: Success rates in training by (policy, task), where known.
    """
    tasks = tuple(dict.fromkeys(cell.task for cell in twin))
    found = {cell.key: cell for cell in twin}
    candidates: list[Candidate] = []
    further: list[float] = []
    groups, left_out, allocations = [], [], []
    for task in tasks:
        task_twin, task_real = ([cell for cell in cells if cell.task == task] for cells in (twin, real))
        task_candidates, lightings = _candidates(task, task_twin, task_real, seed)
        if task_real:
            rows = [
                [found[c.policy, task, name] for name in lightings]
                for c in task_candidates
                if not c.driven and set(c.lightings) == set(lightings)
            ]
            days = _days_by_lighting(task_real)
            task_further = [_score_over_days(row, days) for row in rows]
            groups.append(measure_agreement(task, task_real, found, task_further))
            further += [] if groups[-1].missing else task_further
            left_out += _left_out(task, task_real, found)
        allocations.append(_allocation(task, [c for c in task_twin if c.lighting in lightings], task_real, seed))
        candidates += [replace(c, trained=(trained or {}).get((c.policy, task), c.trained)) for c in task_candidates]
    measured = [group.task for group in groups if not group.missing]
    if len(measured) > 1:
        groups.append(measure_agreement(ALL_TASKS, [cell for cell in real if cell.task in measured], found, further))
    return Forecast(
        scene=scene,
        twin_trials=sum(cell.trials for cell in twin),
        real_trials=sum(cell.trials for cell in real),
        candidates=tuple(candidates),
        pairs=tuple(compare_cells(cell, found[cell.twin_key]) for cell in real),
        groups=tuple(groups),
        left_out=tuple(left_out),
        plans=tuple(allocations),
        seed=seed,
        tasks=tasks,
    )


def _days_by_lighting(real: Sequence[Cell]) -> Counter[str]:
    """Number of days that are compared with each of the twin's lightings."""
    return Counter(compared for _, compared in dict.fromkeys((c.lighting, c.twin_key[2]) for c in real))


def _score_over_days(cells: Sequence[Cell], days: Counter[str]) -> float:
    """Mean twin rate over real days of a policy with one cell per lighting.

    A lighting with which three days are compared counts three times; one with which no day is compared counts once.
    """
    return float(np.average([c.rate for c in cells], weights=[max(1, days[c.lighting]) for c in cells]))


def _one_per_day(cells: Sequence[Cell], days: Counter[str]) -> list[Cell]:
    """Splits the trials of a lighting into as many cells as days are compared with it, see `_score_over_days`."""
    out = []
    for cell in cells:
        n = min(max(1, days[cell.lighting]), cell.trials)
        parts = np.arange(n + 1)
        won = np.diff(cell.successes * parts // n)
        lost = np.diff((cell.trials - cell.successes) * parts // n)[::-1]
        out += [replace(cell, trials=int(w + f), successes=int(w)) for w, f in zip(won, lost, strict=True)]
    return out


def _candidates(
    task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int
) -> tuple[list[Candidate], tuple[str, ...]]:
    """The candidates of a task, best in the twin first, and the compared lightings."""
    lightings = tuple(dict.fromkeys(cell.lighting for cell in twin))
    if real:
        compared = {cell.twin_key[2] for cell in real}
        lightings = tuple(name for name in lightings if name in compared)
    policies = list(dict.fromkeys(cell.policy for cell in twin))
    each = [[c for c in twin if c.policy == p] for p in policies]
    # A policy that was not validated under any compared lighting is scored over all its lightings instead.
    cells = [[c for c in mine if c.lighting in lightings] or mine for mine in each]
    driven = [[c for c in real if c.policy == p] for p in policies]
    rng = np.random.default_rng([seed, 1])
    by_day, days = bool(real) and len(lightings) > 1, _days_by_lighting(real)
    units = [_one_per_day(mine, days) for mine in cells] if by_day else cells
    ranks = rank_probabilities(_sampled_rates(units, by_day, rng))
    with_real = [i for i, mine in enumerate(driven) if mine]
    real_ranks: dict[int, Array] = {}
    if len(with_real) > 1:
        sampled = _sampled_rates([driven[i] for i in with_real], True, rng)
        real_ranks = dict(zip(with_real, rank_probabilities(sampled), strict=True))
    twin_rates = _rates_over_days(cells, days) if by_day else [_mean_rate(mine) for mine in cells]
    real_rates = dict(zip(with_real, _rates_over_days([driven[i] for i in with_real], Counter()), strict=True))
    corrected = _corrected(cells, driven, lightings, {cell.key: cell for cell in twin})
    out = [
        Candidate(
            policy=policy,
            task=task,
            lightings=tuple(c.lighting for c in cells[i]),
            twin=twin_rates[i],
            twin_rank=Estimate(*rank_interval(ranks[i]), len(policies)),
            twin_ranks=tuple(float(p) for p in ranks[i]),
            real=real_rates.get(i, Estimate(missing="not driven on the road")),
            real_ranks=tuple(float(p) for p in real_ranks.get(i, ())),
            corrected=corrected[i],
        )
        for i, policy in enumerate(policies)
    ]
    return sorted(out, key=lambda c: (c.twin_rank.value or 0.0, c.policy)), lightings


def _corrected(
    cells: list[list[Cell]], driven: list[list[Cell]], lightings: tuple[str, ...], twin: Cells
) -> list[Estimate]:
    """Real rate of each candidate, predicted from the driven candidates of other trainings."""
    scores = {i: _scores(mine, twin) for i, mine in enumerate(driven) if mine}
    days = _days_by_lighting([cell for mine in driven for cell in mine])
    missing = "; ".join(missing_data([cell for mine in driven for cell in mine], twin))
    out = []
    for i, mine in enumerate(cells):
        training = training_of(mine[0].policy)
        trainings = {j: training_of(cells[j][0].policy) for j in scores}
        others = [pair for j, pair in scores.items() if trainings[j] != training]
        further = len({*trainings.values()} - {training})
        if missing or len(others) < MIN_POLICIES:
            too_few = f"{len(others)} policies of other trainings driven, {MIN_POLICIES} needed"
            out.append(Estimate(missing=missing or too_few))
        elif {c.lighting for c in mine} != set(lightings):
            out.append(Estimate(missing=f"not validated under all compared lightings ({join_names(lightings)})"))
        else:
            line = LinearCorrection.fit(twin=[f for f, _ in others], real=[y for _, y in others])
            score = scores[i][0] if i in scores else _score_over_days(mine, days)
            value, low, high = map(float, line.predict(np.array(score)))
            if np.isnan(value):
                same = f"all driven policies of other trainings have the rate {line.twin_mean:.2g} in the twin"
                out.append(Estimate(missing=f"{same}, which says nothing about other rates"))
            elif np.isnan(low):
                on_line = (
                    "no interval: the driven policies' rates lie within 1% of one line; their scatter is not known"
                )
                out.append(Estimate(value, n=line.n, no_interval=on_line))
            elif further < MIN_PREDICTORS:  # policies of one training err alike
                few = f"too few other trainings for an interval: {further}, {MIN_PREDICTORS} are needed"
                out.append(Estimate(value, n=line.n, no_interval=few))
            else:
                out.append(Estimate(value, low, high, line.n))
    return out


def _scores(real: Sequence[Cell], twin: Cells) -> tuple[float, float]:
    """Mean twin and mean real rate of one policy's real cells."""
    return float(np.mean([twin[c.twin_key].rate for c in real])), float(np.mean([c.rate for c in real]))


def _sampled_rates(rows: Sequence[Sequence[Cell]], by_day: bool, rng: np.random.Generator) -> Array:
    """Samples of the policies' true rates, shape (samples, n).

    Effects of a day on all policies are not modeled, since they hardly change ranks.
    """
    return RateModel.fit(*unit_counts(rows, by_day), shared_days=False).sample(rng, SAMPLES)


def _rates_over_days(rows: Sequence[Sequence[Cell]], days: Counter[str]) -> list[Estimate]:
    """Mean rate of each policy's cells over the days, see `_score_over_days`, with an interval over days.

    The model counts each cell once, shrinks a policy's rate towards those of the others, and its rates end short of 0
    and 1. So the mean may lie outside the model's interval, which then is widened up to the mean.
    """
    if not rows:
        return []
    column = {day: k for k, day in enumerate(dict.fromkeys((c.task, c.lighting) for row in rows for c in row))}
    counts = np.zeros((2, len(rows), len(column)), np.int64)
    for i, row in enumerate(rows):
        for cell in row:
            counts[:, i, column[cell.task, cell.lighting]] = cell.successes, cell.trials
    low, high = RateModel.fit(*counts).interval()
    out = []
    for i, row in enumerate(rows):
        value, trials = _score_over_days(row, days), sum(c.trials for c in row)
        if len(row) < MIN_RATE_DAYS:
            few = f"too few for an interval: {len(row)} day, {MIN_RATE_DAYS} are needed"
            out.append(Estimate(value, n=trials, no_interval=few))
        elif np.isnan(low[i]):
            out.append(Estimate(value, n=trials, no_interval="none: there are more trials than the model can hold"))
        else:
            out.append(Estimate(value, min(value, float(low[i])), max(value, float(high[i])), trials))
    return out


def _mean_rate(cells: Sequence[Cell]) -> Estimate:
    """Mean of the cells' rates, with an interval over episodes under the cells' lightings."""
    return Estimate(*mean_rate([c.successes for c in cells], [c.trials for c in cells]), sum(c.trials for c in cells))


def _left_out(task: str, real: Sequence[Cell], twin: Cells) -> list[LeftOutLighting]:
    """Predicts the real rates under each lighting of a task by a line fitted under its other lightings."""
    lightings = [cell.lighting for cell in real]
    names = list(dict.fromkeys(lightings))
    twin_rate, real_rate = np.array([_scores([cell], twin) for cell in real]).T
    missing = "; ".join(missing_data(real, twin)) or ("a second real lighting is needed" if len(names) < 2 else "")
    out = []
    for name in names:
        mine = np.array([other == name for other in lightings])
        n = int(mine.sum())
        too_few = f"the other lightings have fewer than {MIN_POLICIES} cells" if len(real) - n < MIN_POLICIES else ""
        if missing or too_few:
            out.append(LeftOutLighting(task, name, n, *(Estimate(missing=missing or too_few),) * 3))
            continue
        line = LinearCorrection.fit(twin=twin_rate[~mine], real=real_rate[~mine])
        value, low, high = line.predict(twin_rate[mine])
        inside = within(low, real_rate[mine], high)
        parts = (
            np.where(np.isfinite(value), np.abs(twin_rate - real_rate)[mine], np.nan),
            np.abs(value - real_rate[mine]),
            np.where(np.isfinite(low), inside, np.nan),
        )
        out.append(LeftOutLighting(task, name, n, *map(_mean_of_known, parts)))
    return out


def _mean_of_known(values: Array) -> Estimate:
    """Mean over the cells whose value is not nan."""
    known = values[~np.isnan(values)]
    if not len(known):
        return Estimate(missing="the rates under the other lightings do not determine a prediction")
    return Estimate(float(known.mean()), n=len(known), no_interval=DEPENDENT)


def _allocation(task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int) -> TrialAllocation:
    on_road = len({cell.policy for cell in real}) > 1
    basis, cells = ("road", real) if on_road else ("twin", twin)
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    if len(policies) < 2:
        return TrialAllocation(task, len(policies), basis, None, None, 0, 0)
    rows = [[c for c in cells if c.policy == policy] for policy in policies]
    by_day = on_road or (bool(real) and len({c.lighting for c in twin}) > 1)  # as in `_candidates`
    if by_day and not on_road:
        rows = [_one_per_day(row, _days_by_lighting(real)) for row in rows]
    rates = _sampled_rates(rows, by_day, np.random.default_rng([seed, 3]))
    now = expected_confidence(rates, 0, seed, on_road)
    more = [trials_needed(rates, what, seed, on_road) for what in ("winner", "order")]
    return TrialAllocation(task, len(policies), basis, now.winner, now.order, *more)
