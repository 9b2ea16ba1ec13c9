"""Scores of a forecast experiment over places, from the recorded tables alone.

The forecast of a policy on a day is its success rate in the twin under the lighting of that day's photo, or under
held-out lightings if the photo's pose was not found. Baselines are the success on the road at *other places*, which
does not use the twin, and the twin's rates with the days shuffled.

- *within places*: mean over places of Spearman, MMRV (`twin.evaluation.statistics.mmrv`) and regret among the place's
  policies. *over all*: the statistic of the policies of all places together.
- single days: mean over places of the log and Brier scores of all cells (a policy on a day). *gain* is a predictor's
  log score minus that of the twin by photos; it is above 0 if the twin is better.

Intervals (90 %) have the place as their unit (`benchmarks/place_intervals.py`), so they hold for experiments at other
places. Fewer than five places give no intervals.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from place_record import FAILURE, POLICIES, PlaceRecord, read_place
from protocol import Protocol

from twin.evaluation.agreement_intervals import STATISTICS, PairedCells, Statistic
from twin.evaluation.probability_scores import (
    brier,
    calibration,
    errors_by_day,
    log_score,
    shuffled_days,
    twin_probabilities,
)
from twin.evaluation.statistics import UndefinedStatistic, winner
from twin.files import read_json
from twin.types import Array

sys.path.append(str(Path(__file__).parents[1]))
from place_intervals import mean_difference_interval, place_interval, rate_over_days

TWIN, HELD_OUT, SETUP = "twin, by a photo of each day", "twin, held-out lightings", "same setup at other places"
MEAN, SHUFFLED = "mean of other places", "twin, its days shuffled"


def score(protocol: Protocol, results: Path) -> dict[str, Any]:
    """Scores of the places that are complete, as a JSON object."""
    folder = results / protocol.name
    places = {place: read_place(folder / f"place_{place}", place, protocol) for place in protocol.places}
    done = [one for one in places.values() if one]
    states = {str(place): _state(folder / f"place_{place}", one) for place, one in places.items()}
    out: dict[str, Any] = {"version": protocol.version, "places": states, "wanted": protocol.wanted}
    if not done:
        return out
    out["road"] = [
        {"place": one.place, "setup": policy, "trials": int(real[:, 1].sum()), **_rates(one, i)}
        for one in done
        for i, (policy, real) in enumerate(zip(one.policies, one.real, strict=True))
    ]
    out["ranking"] = {name: _ranking(done, name) for name in (TWIN, HELD_OUT, SETUP)}
    out["days"] = _day_scores(done)
    out["calibration"] = [vars(one) for one in calibration(*_flat(done))]
    out["errors"] = [
        vars(one)
        for place in done
        for one in errors_by_day(_twin(place).ravel(), _real(place).ravel(), list(place.days) * len(place.policies))
    ]
    out["met"] = _met(protocol, out)
    return out


def _state(folder: Path, record: PlaceRecord | None) -> str:
    if record:
        return "complete"
    if (folder / FAILURE).exists():
        failure = read_json(folder / FAILURE)
        return f"failed: {failure['step']}: {failure['message']}"
    return "trained" if (folder / POLICIES).exists() else "not begun" if not folder.exists() else "begun"


def _rates(one: PlaceRecord, i: int) -> dict[str, Any]:
    mean, low, high = rate_over_days(_real(one)[i])
    twin = (one.twin[i, :, 0] / one.twin[i, :, 1]).mean()  # days have equal weight, as on the road
    return {"real": mean, "low": low, "high": high, "twin": float(twin), "held_out": float(_held_out(one)[i])}


# ---- predictions, shapes (n policies, k days)


def _real(one: PlaceRecord) -> Array:
    return np.asarray(one.real[..., 0] / one.real[..., 1])


def _twin(one: PlaceRecord) -> Array:
    return twin_probabilities(one.twin[..., 0], one.twin[..., 1])


def _held_out(one: PlaceRecord) -> Array:
    return np.asarray(one.held_out[:, 0] / one.held_out[:, 1])


def _elsewhere(places: list[PlaceRecord], one: PlaceRecord, by_setup: bool) -> Array:
    """Success on the road at other places, shape (n,).

    This is the mean of all setups. If `by_setup`, it is each setup's mean, including one added place at which the
    setup has the mean of all setups.
    """
    others = [_real(other).mean(1) for other in places if other is not one]
    if not others:
        return np.full(len(one.policies), np.nan)
    rates = np.stack(others)
    if not by_setup:
        return np.full(len(one.policies), rates.mean())
    return np.asarray((rates.sum(0) + rates.mean()) / (len(rates) + 1))


def _predicted(places: list[PlaceRecord], one: PlaceRecord, name: str) -> Array:
    """A predictor's probability of success in every cell, shape (n, k)."""
    flat = {
        HELD_OUT: lambda: twin_probabilities(one.held_out[:, None, 0], one.held_out[:, None, 1])[:, 0],
        SETUP: lambda: _elsewhere(places, one, True),
        MEAN: lambda: _elsewhere(places, one, False),
    }
    if name == TWIN:
        return _twin(one)
    return np.broadcast_to(flat[name]()[:, None], _real(one).shape)


def _cells(places: list[PlaceRecord], one: PlaceRecord, name: str) -> PairedCells:
    """Predicted and real rates for the rankings. The twin's are ratios of counts, not shrunk as in `_predicted`."""
    counted = {TWIN: one.twin[..., 0] / one.twin[..., 1], HELD_OUT: _held_out(one)[:, None]}
    predicted = np.broadcast_to(counted[name] if name in counted else _predicted(places, one, name), _real(one).shape)
    n, k = predicted.shape
    day = np.broadcast_to(np.arange(k), (n, k))
    return PairedCells(predicted, _real(one), np.ones((n, k)), np.arange(n), day, (np.arange(n),))


def _flat(places: list[PlaceRecord]) -> tuple[Array, Array, Array]:
    parts = [(_twin(one).ravel(), _real(one).ravel(), one.real[..., 1].ravel()) for one in places]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))  # type: ignore[return-value]


# ---- scores


def _ranking(places: list[PlaceRecord], name: str) -> dict[str, Any]:
    cells = [_cells(places, one, name) for one in places]
    if any(np.isnan(one.twin).any() for one in cells):
        return {}
    by_place = {str(one.place): _alone(data) for one, data in zip(places, cells, strict=True)}
    ranked = [data for data in cells if np.ptp(data.rates()["real"]) > 0]
    out: dict[str, Any] = {"by_place": by_place, "places": len(cells), "ranked": len(ranked)}
    for key, statistic, mine, pooled in (
        ("spearman_within", replace(STATISTICS["spearman"], of=_spearman_within), ranked, False),
        ("mmrv", STATISTICS["mmrv"], cells, False),
        ("spearman_over_all", STATISTICS["spearman"], cells, True),
        ("bias", STATISTICS["bias"], cells, True),
    ):
        out[key] = _over_places(statistic, mine, pooled)
    out["regret"] = {"value": float(np.mean([one["regret"] for one in by_place.values()])), "low": None, "high": None}
    return out


def _spearman_within(twin: Array, real: Array) -> Array:
    """Spearman's correlation; 0 where the predictions do not differ but the rates on the road do."""
    with np.errstate(invalid="ignore", divide="ignore"):
        value = STATISTICS["spearman"].of(twin=twin, real=real)
    return np.where(np.isnan(value) & (np.ptp(real, -1) > 0), 0.0, value)


def _alone(data: PairedCells) -> dict[str, float | None]:
    rates = data.rates()
    out = {name: _defined(STATISTICS[name].of, rates) for name in ("spearman", "mmrv")}
    return {**out, "regret": winner(**rates)[1]}


def _over_places(statistic: Statistic, places: list[PairedCells], pooled: bool) -> dict[str, float | None]:
    """A statistic over places with its interval; None for undefined values."""
    if not places:
        return {"value": None, "low": None, "high": None}
    try:
        value, low, high = (float(x) for x in place_interval(statistic, places, pooled))
    except UndefinedStatistic:
        rates = [one.rates() for one in places]
        joined = {key: np.concatenate([one[key] for one in rates]) for key in ("twin", "real")}
        values = [_defined(statistic.of, one) for one in ([joined] if pooled else rates)]
        known = [one for one in values if one is not None]
        return {"value": float(np.mean(known)) if known else None, "low": None, "high": None}
    return {"value": value, "low": low, "high": high}


def _defined(of: Callable[..., Array], rates: dict[str, Array]) -> float | None:
    with np.errstate(invalid="ignore", divide="ignore"):
        value = float(of(**rates))
    return value if np.isfinite(value) else None


def _day_scores(places: list[PlaceRecord]) -> dict[str, Any]:
    """Scores of single days by predictor."""
    logs: dict[str, list[float]] = {}
    briers: dict[str, list[float]] = {}
    for one in places:
        real, twin = _real(one), _twin(one)
        weight = np.ones_like(real)
        each = {name: _predicted(places, one, name) for name in (TWIN, HELD_OUT, SETUP, MEAN)}
        for name, p in each.items():
            logs.setdefault(name, []).append(float(log_score(p, real).mean()))
            briers.setdefault(name, []).append(float(brier(p, real).mean()))
        logs.setdefault(SHUFFLED, []).append(float(shuffled_days(twin, weight, real, log_score).mean()))
        briers.setdefault(SHUFFLED, []).append(float(shuffled_days(twin, weight, real, brier).mean()))
    return {
        name: {
            "log": _mean(log),
            "brier": _mean(briers[name]),
            "gain": _gain(log, logs[TWIN]) if name != TWIN else None,
        }
        for name, log in logs.items()
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if np.isfinite(values).all() else None


def _gain(log: list[float], twin: list[float]) -> dict[str, float | None]:
    differences = np.array(log) - np.array(twin)
    try:
        mean, low, high = mean_difference_interval(differences, limits=(-np.inf, np.inf))
    except UndefinedStatistic:
        return {"value": _mean(differences.tolist()), "low": None, "high": None}
    return {"value": mean, "low": low, "high": high}


def _met(protocol: Protocol, out: dict[str, Any]) -> dict[str, bool | None]:
    """Acceptance criterion → whether it is met; None if its figure is undefined."""
    ranking = out["ranking"][TWIN]
    varied = [row["real"] for row in out["road"] if row["setup"] == next(iter(protocol.setups))]
    figures = {
        **{key: ranking[key]["value"] for key in ("spearman_within", "spearman_over_all")},
        **{key: ranking[key]["value"] for key in ("mmrv", "regret")},
        "varied_each_place": min(varied),
        "varied_mean": float(np.mean(varied)),
    }
    smaller = ("mmrv", "regret")
    met: dict[str, bool | None] = {}
    for name, bound in protocol.wanted.items():
        value = figures[name]
        met[name] = None if value is None else bool(value <= bound if name in smaller else value >= bound)
    gains = [row["gain"] for row in out["days"].values() if row["gain"]]
    met["log_score_better"] = None if any(one["low"] is None for one in gains) else all(one["low"] > 0 for one in gains)
    return met


# ---- tables


def tables(protocol: Protocol, found: dict[str, Any]) -> str:
    """The scores in Markdown."""
    states = list(found["places"].values())
    lines = [f"Protocol {protocol.version}: {states.count('complete')} of {len(states)} places are complete"]
    lines += [f"- place {place}: {state}" for place, state in found["places"].items()]
    if "road" not in found:
        return "\n".join(lines)
    lines += [
        "",
        "| ranking by | within places: Spearman | MMRV | regret | over all: Spearman | road minus predicted |",
    ]
    lines += ["|---|---|---|---|---|---|"]
    for name, row in found["ranking"].items():
        keys = ("spearman_within", "mmrv", "regret", "spearman_over_all", "bias")
        lines.append(f"| {name} | {' | '.join(_text(row.get(key)) for key in keys)} |")
    lines += [
        "",
        "| predictor of single days | Brier | log score | the twin's log score is better by |",
        "|---|---|---|---|",
    ]
    for name, row in found["days"].items():
        lines.append(f"| {name} | {_number(row['brier'])} | {_number(row['log'])} | {_text(row['gain'], '+.3f')} |")
    lines += [
        "",
        "| place | policy | road | 90 % interval over days | twin, by photos | twin, held-out lightings |",
        "|---|---|---|---|---|---|",
    ]
    for row in found["road"]:
        ends = f"{row['low']:.2f} to {row['high']:.2f}"
        rates = f"{row['twin']:.2f} | {row['held_out']:.2f}"
        lines.append(
            f"| {row['place']} | {row['setup']} | {row['real']:.2f} ({row['trials']} trials) | {ends} | {rates} |"
        )
    lines += [
        "",
        "| probability predicted by the twin | mean | success on the road | cells | trials |",
        "|---|---|---|---|---|",
    ]
    for row in found["calibration"]:
        ends = f"{row['low']:g} to {row['high']:g}"
        lines.append(f"| {ends} | {row['predicted']:.2f} | {row['observed']:.2f} | {row['cells']} | {row['trials']} |")
    lines += ["", "| day | cells | missed failures | false alarms |", "|---|---|---|---|"]
    lines += [f"| {row['day']} | {row['cells']} | {row['misses']} | {row['false_alarms']} |" for row in found["errors"]]
    lines += ["", "Acceptance criteria:", ""]
    words = {True: "reached", False: "missed", None: "undefined"}
    lines += [f"- {name} ({protocol.wanted.get(name, 0.0):g}): {words[met]}" for name, met in found["met"].items()]
    return "\n".join(lines)


def _number(value: float | None, form: str = ".3f") -> str:
    return "–" if value is None else format(value, form).replace("-", "−")


def _text(part: dict[str, float | None] | None, form: str = ".3f") -> str:
    if not part or part["value"] is None:
        return "–"
    ends = "" if part["low"] is None else f" ({_number(part['low'], form)} to {_number(part['high'], form)})"
    return _number(part["value"], form) + ends
