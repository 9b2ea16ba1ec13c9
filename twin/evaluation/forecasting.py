"""`Forecast`: what rates in the twin say about the real runs. Numbers only; pages and tables are drawn from it.

A *candidate* is a policy on a task. Its twin score is the mean of its rates under the *compared lightings*: those of
the twin that real cells of the task are compared with, or all of them where there are no real trials yet. It is
*driven* if it has real trials. A *group* is the driven candidates of one task, or of all of them. Every number stands
in an `Estimate` with its count and its interval, or with what is missing for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from twin.config_file import parse
from twin.errors import InputError, listing
from twin.evaluation import prediction_powered, ranking
from twin.evaluation.bootstrap import DRAWS, Paired, Rates, by_task, interval, paired, resample, seen
from twin.evaluation.ranking import Tallies
from twin.evaluation.statistics import (
    CONFIDENCE,
    MIN_POLICIES,
    MIN_TRIALS,
    Refused,
    mean_rate,
    mmrv,
    mmrv_rows,
    pearson,
    pearson_rows,
    rate_difference,
    spearman,
    spearman_rows,
    wilson,
    winner_rows,
)
from twin.evaluation.trials import Cell
from twin.files import damaged, exists, read_json, write_json

ALL_TASKS = "all tasks"
_FILE = "forecast.json"


@dataclass(frozen=True)
class Estimate:
    """A number with its interval, or why there is none."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    """Trials behind a rate, policies or cells behind a statistic."""
    missing: str = ""
    """What it would take; empty where there is a value."""


UNKNOWN_TRAINING = Estimate(missing="its training on this task is not known")


@dataclass(frozen=True)
class Pair:
    """A real cell beside the twin's."""

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
        """Whether its bias may be none."""
        return (self.bias.low or 0.0) <= 0.0 <= (self.bias.high or 0.0)


@dataclass(frozen=True)
class Candidate:
    policy: str
    task: str
    lightings: tuple[str, ...]
    """Of the twin, that its score is the mean over."""
    twin: Estimate
    twin_rank: Estimate
    """Among the task's candidates, 1 is best: expected, and interval."""
    twin_ranks: tuple[float, ...]
    """Probability of each rank in the twin."""
    real: Estimate
    """Mean over its real cells."""
    real_ranks: tuple[float, ...]
    """Probability of each rank on the road among the driven; empty where it was not driven or is the only one."""
    corrected: Estimate
    """Real rate expected, from its twin score and the other driven candidates; its own real trials are not used."""
    trained: Estimate = UNKNOWN_TRAINING
    """Rate in its training, on this task, before it was saved."""

    @property
    def driven(self) -> bool:
        return self.real.value is not None


@dataclass(frozen=True)
class Group:
    """How well the twin foretold the road for the driven candidates of a task, or of all tasks."""

    task: str
    policies: int
    cells: int
    missing: tuple[str, ...]
    """What it would take; nothing below is given before."""
    pearson: Estimate
    spearman: Estimate
    mmrv: Estimate
    winner_agreement: Estimate
    winner_regret: Estimate
    bias: Estimate
    """Mean over cells of real minus twin."""
    coverage: Estimate
    """Share of the cells whose difference between twin and road is no more than chance (interval of `Pair.bias`)."""
    corrected_coverage: Estimate
    """Share of the candidates whose real rate lies in the interval predicted without them."""
    mean_real: Estimate
    """Mean real rate of policies such as these, driven or not (prediction-powered)."""


@dataclass(frozen=True)
class LeftOut:
    """One real lighting, foretold from all others of the task."""

    task: str
    lighting: str
    cells: int
    twin_error: Estimate
    """Mean distance of the twin's rates from the real ones."""
    corrected_error: Estimate
    """The same after the correction learnt under the other lightings."""
    coverage: Estimate
    """Share of the cells within the interval predicted."""


@dataclass(frozen=True)
class TrialAllocation:
    """What more real trials would bring. `ranking` states the rule."""

    task: str
    policies: int
    basis: str
    """road: trials are added to those driven; twin: none so far, and the road is taken to be like the twin."""
    winner_now: float | None = None
    """Probability that the leading policy is the best, or within `ranking.MARGIN` of it."""
    order_now: float | None = None
    """Share of the pairs that matter expected in the right order."""
    more_for_winner: int | None = None
    """Real trials per policy until `winner_now` is expected to be `sure`; None: more than `ranking.MOST_TRIALS`."""
    more_for_order: int | None = None


@dataclass(frozen=True)
class Forecast:
    scene: str
    twin_trials: int
    real_trials: int
    tasks: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    """Task by task, best in the twin first."""
    pairs: tuple[Pair, ...]
    groups: tuple[Group, ...]
    left_out: tuple[LeftOut, ...]
    plans: tuple[TrialAllocation, ...]
    confidence: float = CONFIDENCE
    draws: int = DRAWS
    seed: int = 0
    sure: float = ranking.SURE
    margin: float = ranking.MARGIN

    def of(self, task: str) -> list[Candidate]:
        return [c for c in self.candidates if c.task == task]

    def save(self, folder: Path) -> None:
        """Writes `forecast.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / _FILE, asdict(self))

    @staticmethod
    def load(folder: Path) -> "Forecast":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / _FILE
        if not exists(path):
            raise InputError(f"{path} does not exist; run python -m twin.forecast SCENE")
        with damaged(path, "run python -m twin.forecast SCENE anew"):
            try:
                return parse(Forecast, _given(read_json(path)), str(path))
            except InputError as error:
                raise InputError(f"{error}; run python -m twin.forecast SCENE anew") from None


def _given(value: Any) -> Any:
    """A JSON value without its nulls, which a dataclass has as defaults."""
    if isinstance(value, dict):
        return {key: _given(item) for key, item in value.items() if item is not None}
    return [_given(item) for item in value] if isinstance(value, list) else value


# ---- How a `Forecast` is computed from the cells of the twin and of the road; see `forecasting.py` for the words.


def make_forecast(
    scene: str,
    twin: Sequence[Cell],
    real: Sequence[Cell],
    seed: int = 0,
    trained: Mapping[tuple[str, str], Estimate] | None = None,
) -> Forecast:
    """Computes everything.

    Args:
        scene: Its name.
        twin: Cells of the twin.
        real: Real cells, each with a cell of the twin to compare with; may be none.
        seed: Of the resampling.
        trained: Rates in training by policy and task, where they are known.
    """
    tasks = tuple(dict.fromkeys(cell.task for cell in twin))
    candidates: list[Candidate] = []
    comparable: list[Candidate] = []
    groups, left_out, plans = [], [], []
    for task in tasks:
        here = [cell for cell in real if cell.task == task]
        mine, lightings = _candidates(task, [c for c in twin if c.task == task], here, seed)
        if here:
            alike = [c for c in mine if set(c.lightings) == set(lightings)]
            groups.append(_group(task, here, twin, alike, seed))
            comparable += alike
            left_out += _left_out(task, here, twin)
        plans.append(_plan(task, [c for c in twin if c.task == task and c.lighting in lightings], here, seed))
        candidates += [replace(c, trained=(trained or {}).get((c.policy, task), c.trained)) for c in mine]
    if len(groups) > 1:
        groups.append(_group(ALL_TASKS, real, twin, comparable, seed))
    return Forecast(
        scene=scene,
        twin_trials=sum(cell.trials for cell in twin),
        real_trials=sum(cell.trials for cell in real),
        candidates=tuple(candidates),
        pairs=tuple(_pair(cell, twin) for cell in real),
        groups=tuple(groups),
        left_out=tuple(left_out),
        plans=tuple(plans),
        seed=seed,
        tasks=tasks,
    )


# ---- candidates


def _candidates(
    task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int
) -> tuple[list[Candidate], tuple[str, ...]]:
    """The task's candidates, best first, and the compared lightings; `twin` and `real` are the task's cells."""
    lightings = tuple(dict.fromkeys(cell.lighting for cell in twin))
    if real:
        compared = {cell.twin_key[2] for cell in real}
        lightings = tuple(name for name in lightings if name in compared)
    policies = list(dict.fromkeys(cell.policy for cell in twin))
    cells = [[c for c in twin if c.policy == p and c.lighting in lightings] for p in policies]
    # Not validated under any compared lighting: it has a score of its own, which is not compared with the others'.
    cells = [mine or [c for c in twin if c.policy == p] for p, mine in zip(policies, cells, strict=True)]
    rng = np.random.default_rng([seed, 1])
    ranks = ranking.rank_probabilities(_tallies(cells), rng)
    driven = [[c for c in real if c.policy == p] for p in policies]
    with_real = [i for i, mine in enumerate(driven) if mine]
    real_ranks: dict[int, NDArray[np.float64]] = {}
    if len(with_real) > 1:
        each = ranking.rank_probabilities(_tallies([driven[i] for i in with_real]), rng)
        real_ranks = dict(zip(with_real, each, strict=True))
    corrected = _corrected(cells, driven, lightings, twin)
    out = []
    for i, policy in enumerate(policies):
        expected, low, high = ranking.rank_interval(ranks[i])
        out.append(
            Candidate(
                policy=policy,
                task=task,
                lightings=tuple(c.lighting for c in cells[i]),
                twin=_mean_rate(cells[i]),
                twin_rank=Estimate(expected, low, high, len(policies)),
                twin_ranks=tuple(float(p) for p in ranks[i]),
                real=_mean_rate(driven[i]) if driven[i] else Estimate(missing="not driven on the road"),
                real_ranks=tuple(float(p) for p in real_ranks.get(i, ())),
                corrected=corrected[i],
            )
        )
    return sorted(out, key=lambda c: (c.twin_rank.value or 0.0, c.policy)), lightings


def _corrected(
    cells: list[list[Cell]], driven: list[list[Cell]], lightings: tuple[str, ...], twin: Sequence[Cell]
) -> list[Estimate]:
    """What each candidate is expected to do on the road, from the other driven ones."""
    pairs = [(i, *_scores(mine, twin)) for i, mine in enumerate(driven) if mine]
    few = _few([cell for mine in driven for cell in mine], twin)
    out = []
    for i, mine in enumerate(cells):
        others = [(f, y) for j, f, y in pairs if j != i]
        if few or len(others) < MIN_POLICIES:
            out.append(
                Estimate(missing="; ".join(few) or f"{len(others)} other policies driven, {MIN_POLICIES} needed")
            )
            continue
        score = _scores(driven[i], twin)[0] if driven[i] else _mean_rate(mine).value
        if {c.lighting for c in mine} != set(lightings):
            out.append(Estimate(missing=f"not validated under {listing(lightings)}, as the driven policies are"))
            continue
        line = prediction_powered.Correction.fit(twin=[f for f, _ in others], real=[y for _, y in others])
        value, low, high = (float(x) for x in line.predict(np.array(score)))
        out.append(Estimate(value, low, high, line.n))
    return out


def _scores(real: Sequence[Cell], twin: Sequence[Cell]) -> tuple[float, float]:
    """Mean twin and mean real rate of one policy's real cells."""
    found = {cell.key: cell for cell in twin}
    return float(np.mean([found[c.twin_key].rate for c in real])), float(np.mean([c.rate for c in real]))


def _mean_rate(cells: Sequence[Cell]) -> Estimate:
    mean, low, high = mean_rate([c.successes for c in cells], [c.trials for c in cells])
    return Estimate(mean, low, high, sum(c.trials for c in cells))


def _tallies(rows: Sequence[Sequence[Cell]]) -> Tallies:
    return Tallies.of([[(c.successes, c.trials) for c in row] for row in rows])


# ---- agreement of the worlds


def _few(real: Sequence[Cell], twin: Sequence[Cell]) -> list[str]:
    """What is missing for a statistic over these real cells."""
    found = {cell.key: cell for cell in twin}
    policies = len({cell.policy for cell in real})
    out = []
    if policies < MIN_POLICIES:
        more = MIN_POLICIES - policies
        out.append(f"{policies} policies driven on the road, {MIN_POLICIES} are needed: drive {more} more")
    short = [
        f"{c.policy} under {c.lighting} has {c.trials} real trials ({MIN_TRIALS - c.trials} more)"
        for c in real
        if c.trials < MIN_TRIALS
    ]
    twins = dict.fromkeys(found[cell.twin_key] for cell in real)
    short += [
        f"{c.policy} under {c.lighting} has {c.trials} trials in the twin ({MIN_TRIALS - c.trials} more)"
        for c in twins
        if c.trials < MIN_TRIALS
    ]
    if short:
        out.append(f"cells of fewer than {MIN_TRIALS} trials: {listing(short)}; or leave these cells out")
    return out


def _group(task: str, real: Sequence[Cell], twin: Sequence[Cell], candidates: list[Candidate], seed: int) -> Group:
    few = _few(real, twin)
    data = paired(real, twin)
    if few:
        none = Estimate(n=data.policies, missing="; ".join(few))
        return Group(task, data.policies, data.cells, tuple(few), *(none,) * 9)
    own, again, n = seen(data), resample(data, np.random.default_rng([seed, 2])), data.policies
    return Group(
        task=task,
        policies=data.policies,
        cells=data.cells,
        missing=(),
        pearson=_correlation(pearson, pearson_rows, own, again),
        spearman=_correlation(spearman, spearman_rows, own, again),
        mmrv=_bootstrapped(mmrv(twin=own.twin, real=own.real), mmrv_rows(twin=again.twin, real=again.real), n),
        **_winner(own, again, data),
        bias=_bootstrapped(float(own.difference), again.difference, data.cells),
        coverage=_bootstrapped(float(own.inside), again.inside, data.cells),
        corrected_coverage=_corrected_coverage(data, own),
        mean_real=_mean_real(own, candidates),
    )


def _correlation(
    of: Callable[..., float], rows: Callable[..., NDArray[np.float64]], own: Rates, again: Rates
) -> Estimate:
    n = len(own.twin)
    try:
        value = of(twin=own.twin, real=own.real)
    except Refused as refusal:
        return Estimate(n=n, missing=str(refusal))
    return _bootstrapped(value, rows(twin=again.twin, real=again.real), n)


def _bootstrapped(value: float, again: NDArray[np.float64], n: int) -> Estimate:
    ends = interval(value, again)
    if ends is None:
        return Estimate(n=n, missing="most resampled experiments have rates that are all the same")
    return Estimate(value, *ends, n)


def _winner(own: Rates, again: Rates, data: Paired) -> dict[str, Estimate]:
    """Compared within each task that has two candidates or more."""
    if all(len(members) < 2 for members in data.strata):
        none = Estimate(n=data.policies, missing="no task has two policies")
        return {"winner_agreement": none, "winner_regret": none}
    (agreement, regret), (agreements, regrets) = by_task(winner_rows, own), by_task(winner_rows, again)
    return {
        "winner_agreement": _bootstrapped(float(agreement), agreements, data.policies),
        "winner_regret": _bootstrapped(float(regret), regrets, data.policies),
    }


def _corrected_coverage(data: Paired, own: Rates) -> Estimate:
    """Task by task, each candidate predicted without itself."""
    hits: list[bool] = []
    for members in data.strata:
        twin, real = own.twin[members], own.real[members]
        try:
            _, low, high = prediction_powered.left_out_predictions(twin=twin, real=real, groups=range(len(members)))
        except Refused:
            continue
        hits += list((low <= real) & (real <= high))
    if not hits:
        return Estimate(missing=f"{MIN_POLICIES + 1} policies of a task driven on the road are needed")
    low_, high_ = wilson(sum(hits), len(hits))
    return Estimate(float(np.mean(hits)), float(low_), float(high_), len(hits))


def _mean_real(own: Rates, candidates: list[Candidate]) -> Estimate:
    further = [c.twin.value for c in candidates if not c.driven and c.twin.value is not None]
    try:
        mean = prediction_powered.powered_mean(twin=own.twin, real=own.real, twin_only=further)
    except Refused as refusal:
        return Estimate(missing=str(refusal))
    return Estimate(mean.value, max(mean.low, 0.0), min(mean.high, 1.0), mean.labelled + mean.unlabelled)


def _left_out(task: str, real: Sequence[Cell], twin: Sequence[Cell]) -> list[LeftOut]:
    lightings = [cell.lighting for cell in real]
    names = list(dict.fromkeys(lightings))
    twin_rate, real_rate = np.array([_scores([cell], twin) for cell in real]).T
    few = _few(real, twin) or (["a second real lighting is needed"] if len(names) < 2 else [])
    if few:
        none = Estimate(missing="; ".join(few))
        return [LeftOut(task, name, lightings.count(name), none, none, none) for name in names]
    out = []
    for name in names:
        mine = np.array([other == name for other in lightings])
        n = int(mine.sum())
        try:
            line = prediction_powered.Correction.fit(twin=twin_rate[~mine], real=real_rate[~mine])
        except Refused:
            none = Estimate(missing=f"the other lightings have fewer than {MIN_POLICIES} cells")
            out.append(LeftOut(task, name, n, none, none, none))
            continue
        value, low, high = line.predict(twin_rate[mine])
        inside = (low <= real_rate[mine]) & (real_rate[mine] <= high)
        ends = wilson(inside.sum(), n)
        twin_error, error = np.abs(twin_rate - real_rate)[mine], np.abs(value - real_rate[mine])
        covered = Estimate(float(inside.mean()), float(ends[0]), float(ends[1]), n)
        out.append(LeftOut(task, name, n, _mean(twin_error), _mean(error), covered))
    return out


def _mean(values: NDArray[np.float64]) -> Estimate:
    """Mean of distances, with the interval of Student's t, cut off at 0."""
    n = len(values)
    if n < 2:
        return Estimate(float(values.mean()), None, None, n)
    half = float(student.ppf(0.5 + CONFIDENCE / 2, n - 1) * values.std(ddof=1) / np.sqrt(n))
    mean = float(values.mean())
    return Estimate(mean, max(mean - half, 0.0), mean + half, n)


def _pair(cell: Cell, twin: Sequence[Cell]) -> Pair:
    mate = next(c for c in twin if c.key == cell.twin_key)
    difference = rate_difference(
        twin_successes=mate.successes,
        twin_trials=mate.trials,
        real_successes=cell.successes,
        real_trials=cell.trials,
    )
    value, low, high = (float(x) for x in difference)
    bias = Estimate(value, low, high, cell.trials)
    return Pair(cell.policy, cell.task, cell.lighting, mate.lighting, _rate(mate), _rate(cell), bias)


def _rate(cell: Cell) -> Estimate:
    low, high = wilson(cell.successes, cell.trials)
    return Estimate(cell.rate, float(low), float(high), cell.trials)


def _plan(task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int) -> TrialAllocation:
    basis = "road" if len({cell.policy for cell in real}) > 1 else "twin"
    cells = real if basis == "road" else twin
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    if len(policies) < 2:
        return TrialAllocation(task, len(policies), basis, None, None, 0, 0)
    tallies = _tallies([[c for c in cells if c.policy == policy] for policy in policies])
    so_far = basis == "road"
    now = ranking.expected_after(tallies, 0, seed, so_far)
    more = [ranking.trials_to_settle(tallies, what, seed, so_far) for what in ("winner", "order")]
    return TrialAllocation(task, len(policies), basis, now.winner, now.order, *more)
