"""Coverage of every 90 % interval of a forecast, in simulated worlds whose truth is known.

    python benchmarks/intervals.py [--worlds 1000] [--shapes user] [--json FILE]
    python benchmarks/intervals.py --better-by --worlds 200

A *world* is one whole experiment: places, trainings, checkpoints, days, and trials in the twin and on the road. Policy
p succeeds on day d at the rate

    road: logit = s (q_p + day_d + cell_pd)            twin: the same with a sharpness, bias and noise of its own

where q_p is a setup's mean plus the effects of place, training and checkpoint, and a *cell* is a policy on a day. Day
and cell effects are correlated between twin and road: a low sun, for example, makes both harder. With a large sharpness
s, a policy succeeds in all trials of a day or in none, as in 706 of the 720 cells of Table 1. The kind `recorded` is
fitted to Table 1.

An interval must contain its *estimand* in 90 % of the worlds. The estimands are:

- Pearson, Spearman, MMRV, bias, regret: the mean of the statistic over further worlds of the same shape, with
  other trainings, days and trials, at the same place or, if the shape has several places, at other places.
- policy: a policy's rate on the road over all days of this kind; coverage is averaged over the policies. *policy,
  middling*: the same, only for policies whose rate is between 0.1 and 0.9.
- setup over days: the rate over all days of the finished policies of a setup (`rate_over_days`), at one place.
- twin: a policy's rate in the twin over all days of this kind.
- predicted: the observed real rate of a policy, predicted from its rate in the twin and from the other trainings.
- with `--better-by`: how much better the twin's log score of single days is than a baseline's, on average over worlds.

Prints coverage; a dash means that a forecast of that shape has no such interval. A world without an interval does not
count: a forecast would print none, because its trainings and days do not determine one. *refused* is the largest
fraction of such worlds over the agreement statistics. In shapes of more than ten policies, rates are estimated in a
quarter of the worlds. The seed is fixed. A run takes fifteen minutes on one core.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from place_intervals import place_interval, rate_over_days
from record import record_parser, save
from scipy.special import expit
from scipy.stats import norm

from twin.evaluation.agreement import within
from twin.evaluation.agreement_intervals import STATISTICS, PairedCells, jackknife_interval, mean_bias
from twin.evaluation.probability_scores import (
    SCORE_DIFFERENCE,
    log_score,
    other_trainings,
    recalibrated,
    score_pair,
    shuffled_days,
    twin_probabilities,
)
from twin.evaluation.rate_model import MIN_RATE_DAYS, RateModel
from twin.evaluation.statistics import MIN_PREDICTORS, UndefinedStatistic, leave_one_group_out

WORLDS = 1000
_MEAN_OVER = 6000  # worlds from which the mean of a statistic is estimated
_BATCH = 250  # worlds simulated together
_RATE_WORLDS = 250  # of `WORLDS`, in which rates are estimated for more than `_USERS_POLICIES` policies
_USERS_POLICIES = 10
_LEAST_DAYS = 3  # days below which `better_by` is not measured
_QUANTILES = norm.ppf((np.arange(400) + 0.5) / 400)


@dataclass(frozen=True)
class Shape:
    """Size of an experiment."""

    places: int
    setups: int
    """Setups per place; 0: the setup of each training is random."""
    trainings: int
    """Trainings per place."""
    checkpoints: int
    """Policies per training."""
    days: int
    twin_trials: int
    """Trials in the twin per policy and day."""
    trials: int = 5


@dataclass(frozen=True)
class Kind:
    """Distribution of policies, days and the twin's errors; the unit of effects is a logit divided by the sharpness.

    `training`, `place`, `day` and `cell` are standard deviations.
    """

    setups: tuple[float, float, float]
    """Means of three setups."""
    training: float
    place: float
    checkpoint: float
    """Mean difference in quality between last and first checkpoint; the standard deviation is a third of the mean."""
    day: float
    cell: float
    shared: float
    """Correlation of day and cell effects between twin and road."""
    sharpness: float
    twin_sharpness: float
    bias: float
    noise: float
    """Standard deviation over policies of the twin's own error."""


SHAPES = {
    "Table 1: 12 trainings × 3, 20 days": Shape(1, 6, 12, 3, 20, 5),
    "Table 1 by days 6 to 15: 12 × 3, 10 days": Shape(1, 6, 12, 3, 10, 5),
    "6 places of 12 × 3, 20 days": Shape(6, 6, 12, 3, 20, 5),
    "6 places of 6 × 1, 10 days": Shape(6, 6, 6, 1, 10, 5),
    "user: 8 policies, 4 days": Shape(1, 0, 8, 1, 4, 20),
    "user: 6 policies, 3 days": Shape(1, 0, 6, 1, 3, 20),
    "user: 5 policies, 2 days": Shape(1, 0, 5, 1, 2, 20),
}
KINDS = {
    "recorded": Kind((-2.2, -1.5, 2.4), 0.5, 0.3, 1.8, 0.5, 0.9, 0.5, 20.0, 2.5, 0.0, 0.4),
    "graded": Kind((-1.5, 0.0, 1.5), 1.0, 0.5, 1.0, 0.5, 1.0, 0.5, 1.0, 1.0, 0.5, 0.5),
    "poor twin": Kind((-3.0, 0.0, 3.0), 2.0, 1.0, 2.0, 1.0, 2.0, 0.3, 1.0, 1.0, 0.5, 4.0),
    "good policies": Kind((3.0, 4.0, 5.0), 2.0, 1.0, 2.0, 2.0, 4.0, 0.8, 1.0, 1.0, 0.0, 0.5),
    "shared weather": Kind((3.0, 4.0, 5.0), 2.0, 1.0, 2.0, 4.5, 0.0, 0.8, 1.0, 1.0, 0.0, 0.5),
}


@dataclass(frozen=True)
class Worlds:
    """Simulated worlds; `twin` and `real` have the shape (worlds, places, policies, days)."""

    kind: Kind
    shape: Shape
    twin: np.ndarray
    """Successes in the twin."""
    real: np.ndarray
    quality: np.ndarray
    """q_p, shape (worlds, places, policies)."""
    twin_quality: np.ndarray
    """q_p plus the bias and the noise of the twin, shape (worlds, places, policies)."""
    setup: np.ndarray
    """Index of each policy's setup in `Kind.setups`, shape (worlds, places, policies)."""

    def place(self, i: int, world: int | slice = slice(None)) -> PairedCells:
        """One place of one or all worlds."""
        shape, n = self.shape, self.twin.shape[2]
        return PairedCells(
            twin=self.twin[world, i] / shape.twin_trials,
            real=self.real[world, i] / shape.trials,
            weight=np.ones((n, shape.days)),
            training=np.arange(n) // shape.checkpoints,
            day=np.broadcast_to(np.arange(shape.days), (n, shape.days)),
            strata=(np.arange(n),),
        )

    @property
    def places(self) -> list[PairedCells]:
        return [self.place(i) for i in range(self.shape.places)]

    @property
    def finished(self) -> np.ndarray:
        """True for the last policy of each training, shape (policies,)."""
        return np.arange(self.twin.shape[2]) % self.shape.checkpoints == self.shape.checkpoints - 1

    def policy_rates(self) -> np.ndarray:
        """True rates on the road over all days, shape (worlds, places, policies)."""
        return _rate(self.kind.sharpness, self.quality, np.hypot(self.kind.day, self.kind.cell))

    def twin_rates(self) -> np.ndarray:
        """True rates in the twin over all days, shape (worlds, places, policies)."""
        return _rate(self.kind.twin_sharpness, self.twin_quality, np.hypot(self.kind.day, self.kind.cell))


def simulate(rng: np.random.Generator, kind: Kind, shape: Shape, worlds: int) -> Worlds:
    """Simulates worlds. The effect of a single place is the same in all worlds and part of `Kind.setups`."""
    per_place = (worlds, shape.places, shape.trainings)
    if shape.setups:
        setup = np.broadcast_to(np.arange(shape.trainings) * shape.setups // shape.trainings % 3, per_place)
    else:
        setup = rng.integers(3, size=per_place)
    several = shape.places > 1
    place, place_bias = rng.normal(0.0, kind.place * several, (2, worlds, shape.places, 1, 1))
    training = np.array(kind.setups)[setup] + rng.normal(0.0, kind.training, per_place)
    early = np.linspace(-1.0, 0.0, shape.checkpoints) if shape.checkpoints > 1 else np.zeros(1)
    effect = kind.checkpoint * early * (1.0 + rng.normal(0.0, 1 / 3, (*per_place, shape.checkpoints)))
    quality = (training[..., None] + place + effect).reshape(worlds, shape.places, -1)
    n = quality.shape[-1]
    error = kind.bias + place_bias / 2 + rng.normal(0.0, kind.noise, (worlds, shape.places, n, 1))

    def effects(std: float, size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        road, own = rng.normal(0.0, std, (2, *size))
        return road, kind.shared * road + np.sqrt(1.0 - kind.shared**2) * own

    day, twin_day = effects(kind.day, (worlds, shape.places, 1, shape.days))
    cell, twin_cell = effects(kind.cell, (worlds, shape.places, n, shape.days))
    real = expit(kind.sharpness * (quality[..., None] + day + cell))
    twin = expit(kind.twin_sharpness * (quality[..., None] + error + twin_day + twin_cell))
    won = rng.binomial(shape.twin_trials, twin), rng.binomial(shape.trials, real)
    setups = np.repeat(setup, shape.checkpoints, -1)
    return Worlds(kind, shape, *won, quality, quality + error[..., 0], setups)


def _rate(sharpness: float, quality: np.ndarray, std: float) -> np.ndarray:
    """Mean rate over a normally distributed quality with mean `quality` and standard deviation `std`."""
    out = np.zeros_like(quality)
    for z in _QUANTILES:
        out += expit(sharpness * (quality + std * z))
    return out / len(_QUANTILES)


# ---- coverage

Hits = dict[str, np.ndarray]
"""Name of an interval → 1 in worlds where it contains its estimand, 0 where not, nan where there is no interval.

Where a world has several such intervals, the value is their mean.
"""


def coverage(kind: Kind, shape: Shape, worlds: int) -> dict[str, float]:
    """Coverage of each interval; nan if no world has it. *refused*: largest fraction of worlds without an interval."""
    rng = np.random.default_rng(0)
    truth = expected(kind, shape, rng)
    parts = [
        holds(simulate(rng, kind, shape, min(_BATCH, worlds - start)), truth) for start in range(0, worlds, _BATCH)
    ]
    hits = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    out = {name: float(np.nanmean(hit)) if np.isfinite(hit).any() else float("nan") for name, hit in hits.items()}
    agreement = [name for name in hits if name.partition(",")[0] in STATISTICS]
    refused = [float(np.isnan(hits[name]).mean()) for name in agreement if out[name] == out[name]]
    return out | {"refused": max(refused, default=float("nan"))}


def expected(kind: Kind, shape: Shape, rng: np.random.Generator) -> dict[str, float]:
    """Mean of each statistic over many worlds."""
    means: dict[str, list[np.ndarray]] = {}
    batch = max(_MEAN_OVER // (20 if shape.places > 1 else 6), 1)
    for _ in range(_MEAN_OVER // batch):
        places = simulate(rng, kind, shape, batch).places
        for name, statistic in STATISTICS.items():
            with np.errstate(invalid="ignore", divide="ignore"):
                for data in places:
                    means.setdefault(name, []).append(statistic.of(**data.rates()))
                if shape.places > 1:
                    each = [data.rates() for data in places]
                    both = {key: np.concatenate([one[key] for one in each], -1) for key in ("twin", "real")}
                    means.setdefault(f"{name}, pooled", []).append(statistic.of(**both))
    return {name: float(np.nanmean(np.concatenate(values))) for name, values in means.items()}


def holds(worlds: Worlds, truth: dict[str, float]) -> Hits:
    several = worlds.shape.places > 1
    agreement = _over_places(worlds, truth) if several else _at_one_place(worlds, truth)
    return agreement | _rates(worlds) | _over_days(worlds) | ({} if several else _predicted(worlds))


def _hit(ends: Callable[[], tuple[Any, ...]], aim: float | np.ndarray, count: int) -> np.ndarray:
    try:
        low, high = ends()[-2:]
    except UndefinedStatistic:
        return np.full(count, np.nan)
    hit = (low - 1e-9 <= aim) & (aim <= high + 1e-9)
    return np.where(np.isfinite(low), hit, np.nan)


def _at_one_place(worlds: Worlds, truth: dict[str, float]) -> Hits:
    data, count = worlds.places[0], len(worlds.twin)
    return {
        name: _hit(partial(jackknife_interval, statistic, data), truth[name], count)
        for name, statistic in STATISTICS.items()
    }


def _over_places(worlds: Worlds, truth: dict[str, float]) -> Hits:
    out: Hits = {}
    for name, statistic in STATISTICS.items():
        for pooled in (False, True):
            key = f"{name}, pooled" if pooled else name
            ends = partial(place_interval, statistic, worlds.places, pooled)
            out[key] = _hit(ends, truth[key], len(worlds.twin))
    return out


def _rates(worlds: Worlds) -> Hits:
    """Hits of the intervals for rates of single policies, at the first place."""
    shape, true = worlds.shape, worlds.policy_rates()[:, 0]
    policy, twin = np.full((2, *true.shape), np.nan)
    if shape.days >= MIN_RATE_DAYS:
        for hit, won, aim, trials in (
            (policy, worlds.real[:, 0], true, shape.trials),
            (twin, worlds.twin[:, 0], worlds.twin_rates()[:, 0], shape.twin_trials),
        ):
            for i, mine in enumerate(won[: _counted(worlds)]):
                low, high = RateModel.fit(mine, np.full(mine.shape, trials)).interval()
                hit[i] = (low <= aim[i]) & (aim[i] <= high)
    middling = np.where((true >= 0.1) & (true <= 0.9), policy, np.nan)
    return {"policy": policy.mean(1), "policy, middling": _mean_or_nan(middling), "twin": twin.mean(1)}


def _counted(worlds: Worlds) -> int:
    """Number of worlds in which rates are estimated; the others have nan."""
    return len(worlds.real) if worlds.twin.shape[2] <= _USERS_POLICIES else _RATE_WORLDS * len(worlds.real) // WORLDS


def _mean_or_nan(values: np.ndarray) -> np.ndarray:
    count = np.isfinite(values).sum(-1)
    return np.where(count > 0, np.nansum(values, -1) / np.maximum(count, 1), np.nan)


def _over_days(worlds: Worlds) -> Hits:
    """Hits of `rate_over_days` for the finished policies of each setup, at one place."""
    shape, done = worlds.shape, worlds.finished
    if not shape.setups or shape.places > 1:
        return {"setup over days": np.full(len(worlds.real), np.nan)}
    won, true, setups = worlds.real[:, 0, done], worlds.policy_rates()[:, 0, done], worlds.setup[0, 0, done]
    hit = np.full((_counted(worlds), 3), np.nan)
    for i in range(len(hit)):
        for setup in range(3):
            _, low, high = rate_over_days(won[i, setups == setup].mean(0) / shape.trials)
            hit[i, setup] = low <= true[i, setups == setup].mean() <= high
    return {"setup over days": hit.mean(1)}


def _predicted(worlds: Worlds) -> Hits:
    out = np.full(len(worlds.real), np.nan)
    for i in range(len(out)):
        data = worlds.place(0, i)
        f, y = data.rates()["twin"], data.rates()["real"]
        if len(np.unique(data.training)) <= MIN_PREDICTORS:
            break
        try:
            _, low, high = leave_one_group_out(twin=f, real=y, groups=data.training.tolist())
        except UndefinedStatistic:
            continue
        known = np.isfinite(low)
        if known.any():
            out[i] = within(low, y, high)[known].mean()
    return {"predicted": out}


def better_by(kind: Kind, shape: Shape, worlds: int) -> dict[str, float]:
    """Coverage of the interval of the twin's advantage over each baseline, for any number of trainings and days."""
    statistic = replace(SCORE_DIFFERENCE, trainings=1, days=1)
    made = simulate(np.random.default_rng(0), kind, shape, worlds)
    values: dict[str, list[tuple[float, float, float]]] = {}
    for i in range(worlds):
        data = made.place(0, i)
        probability = twin_probabilities(made.twin[i, 0], np.full(data.weight.shape, shape.twin_trials))
        own, alike = log_score(probability, data.real), np.zeros(data.policies, int)
        setup = made.setup[i, 0] * shape.checkpoints + np.arange(data.policies) % shape.checkpoints
        for name, other in {
            "mean of other trainings": log_score(other_trainings(data, alike)[:, None], data.real),
            "setup and step": log_score(other_trainings(data, setup)[:, None], data.real),
            "recalibrated": log_score(recalibrated(probability, data), data.real),
            "days shuffled": shuffled_days(probability, data.weight, data.real, log_score),
        }.items():
            pair = score_pair(data, own, other)
            try:
                ends = jackknife_interval(statistic, pair)
            except UndefinedStatistic:
                continue
            values.setdefault(name, []).append((float(mean_bias(**pair.rates())), float(ends[0]), float(ends[1])))
    out = {}
    for name, each in values.items():
        gain, low, high = np.array(each).T
        out[name] = float(within(low, gain.mean(), high).mean())
    return out


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--worlds", type=int, default=WORLDS)
    parser.add_argument("--shapes", nargs="+", default=[], help="beginnings of the names of shapes (default: all)")
    parser.add_argument("--better-by", action="store_true", help="only the advantage in the scores of single days")
    given = parser.parse_args()
    shapes = {k: v for k, v in SHAPES.items() if not given.shapes or k.startswith(tuple(given.shapes))}
    if not shapes:
        parser.error(f"no shape begins with {' or '.join(given.shapes)}; there are {', '.join(SHAPES)}")
    record: dict[str, Any] = {"worlds": given.worlds, "shapes": {}}
    heads: list[str] = []
    for name, shape in shapes.items():
        record["shapes"][name] = {}
        for kind in KINDS:
            if given.better_by and (shape.places > 1 or shape.days < _LEAST_DAYS):
                continue
            row = (better_by if given.better_by else coverage)(KINDS[kind], shape, given.worlds)
            record["shapes"][name][kind] = row
            if list(row) != heads:
                heads = list(row)
                print(f"\n| shape | kind | {' | '.join(heads)} |\n|---|---|{'---|' * len(heads)}")
            cells = " | ".join(f"{x:.2f}" if x == x else "–" for x in row.values())
            print(f"| {name} | {kind} | {cells} |", flush=True)
    return save(given.json, record, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
