"""How a `Forecast` is computed from the cells of the twin and of the road; see `forecast.py` for the words."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from twin.report import correction, ranking
from twin.report.bootstrap import Paired, Rates, by_task, interval, paired, resample, seen
from twin.report.forecast import ALL_TASKS, Candidate, Estimate, Forecast, Group, LeftOut, Pair, Plan
from twin.report.ranking import Tallies
from twin.report.statistics import (
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
from twin.report.trials import Cell
from twin.report.words import listing


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
        line = correction.Correction.fit(twin=[f for f, _ in others], real=[y for _, y in others])
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
            _, low, high = correction.left_out_predictions(twin=twin, real=real, groups=range(len(members)))
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
        mean = correction.powered_mean(twin=own.twin, real=own.real, twin_only=further)
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
            line = correction.Correction.fit(twin=twin_rate[~mine], real=real_rate[~mine])
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


def _plan(task: str, twin: Sequence[Cell], real: Sequence[Cell], seed: int) -> Plan:
    basis = "road" if len({cell.policy for cell in real}) > 1 else "twin"
    cells = real if basis == "road" else twin
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    if len(policies) < 2:
        return Plan(task, len(policies), basis, None, None, 0, 0)
    tallies = _tallies([[c for c in cells if c.policy == policy] for policy in policies])
    so_far = basis == "road"
    now = ranking.expected_after(tallies, 0, seed, so_far)
    more = [ranking.trials_to_settle(tallies, what, seed, so_far) for what in ("winner", "order")]
    return Plan(task, len(policies), basis, now.winner, now.order, *more)
