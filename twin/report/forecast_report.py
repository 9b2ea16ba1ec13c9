"""Writes `forecast.html`: how well the twin predicts the road, which policy is best, and how certain that is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.config import RANDOMIZED, Condition
from twin.evaluation.forecasting import Candidate, CellPair, Estimate, Forecast
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.files import write_text
from twin.report.figures import CARD, FULL_WIDTH, MUTED, SERIES, heatmap, matrix, new_figure, percent_texts, style, svg
from twin.report.forecast_summary import (
    NOMINAL_INTERVALS,
    PERCENT_STATISTICS,
    STATISTICS,
    allocation_text,
    format_estimate,
    format_probability,
    limitations,
    next_trials,
    percentage_points,
    verdicts,
)
from twin.report.html import MAX_TABLE_ROWS, Chart, command, render

# ---- figures

RATE_LIMITS = (-0.04, 1.04)
RATE_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)

_MAX_LABELS = 3  # named points per figure
_LABEL_SIZE = (0.5, 0.06)  # width and height of a name, in axis units
_MAX_NAME_LENGTH = 26  # characters of a name
_ROW_HEIGHT = 0.34  # [in] for three points with their intervals
_SQUARE_SIZE = 4.6  # [in]


def twin_against_road(forecast: Forecast) -> Figure:
    """Real over twin rate of every driven candidate, colored by task; on the diagonal they are equal."""
    driven = [c for c in forecast.candidates if c.driven]
    figure, axes = _square("success in the twin", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in driven if c.task == task]
            if mine:
                _plot_crosses(axes, [c.twin for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _label_outliers(axes, [(c.policy, c.twin.value or 0.0, c.real.value or 0.0) for c in driven])
    legend_below(axes, 3, _SQUARE_SIZE)
    return figure


def predicted_against_road(forecast: Forecast) -> Figure:
    """Real rate of every driven candidate over the rate predicted from the others."""
    known = [c for c in forecast.candidates if c.driven and c.corrected.value is not None]
    figure, axes = _square("predicted from the other policies", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in known if c.task == task]
            if mine:
                _plot_crosses(axes, [c.corrected for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _label_outliers(axes, [(c.policy, c.corrected.value or 0.0, c.real.value or 0.0) for c in known])
    legend_below(axes, 3, _SQUARE_SIZE)
    return figure


def rate_figure(candidates: Sequence[Candidate]) -> Figure:
    """Rates of the candidates of a task in the twin, on the road, and as predicted; best in the twin first."""
    n = len(candidates)
    figure, axes = new_figure(0.8 + _ROW_HEIGHT * n)
    columns = (
        ("in the twin", SERIES[0], "o", [c.twin for c in candidates]),
        ("on the road", SERIES[1], "s", [c.real for c in candidates]),
        ("road, predicted", SERIES[2], "D", [c.corrected for c in candidates]),
    )
    shown = [column for column in columns if any(e.value is not None for e in column[3])]
    with style():
        for k, (name, color, marker, estimates) in enumerate(shown):
            rows = [i for i, e in enumerate(estimates) if e.value is not None]
            y = np.array(rows) + (k - (len(shown) - 1) / 2) * 0.24
            x, ends = _error_bars([estimates[i] for i in rows])
            axes.errorbar(x, y, xerr=ends, fmt=marker, color=color, ms=3.5, lw=1.1, label=name)
        _set_policy_ticks(axes, candidates)
        axes.grid(False, axis="y")
        axes.set(xlim=RATE_LIMITS, ylim=(n - 0.5, -0.5), xlabel="success rate", xticks=RATE_TICKS)
    legend_below(axes, len(shown), 0.8 + _ROW_HEIGHT * n)
    return figure


def rank_heatmap(candidates: Sequence[Candidate]) -> Figure:
    """Probability of every rank in the twin, one row per candidate."""
    n = len(candidates)
    chance = np.array([c.twin_ranks for c in candidates])
    ranks = [str(k + 1) if k % -(-n // 12) == 0 else "" for k in range(n)]
    shown = np.where(chance > 0.005, chance, np.nan)
    return heatmap(
        shown, [shorten_name(c.policy) for c in candidates], ranks, percent_texts(chance), "rank in the twin [%]"
    )


def twin_heatmap(candidates: Sequence[Candidate], pairs: Sequence[CellPair]) -> Figure:
    return _rate_heatmap(candidates, {(pair.policy, pair.twin_lighting): pair.twin.value for pair in pairs})


def road_heatmap(candidates: Sequence[Candidate], pairs: Sequence[CellPair]) -> Figure:
    return _rate_heatmap(candidates, {(pair.policy, pair.lighting): pair.real.value for pair in pairs})


def _rate_heatmap(candidates: Sequence[Candidate], rates: dict[tuple[str, str], float | None]) -> Figure:
    policies, lightings = [c.policy for c in candidates if c.driven], list(dict.fromkeys(light for _, light in rates))
    rate = matrix(rates, policies, lightings)
    names, label = lighting_labels(lightings)
    return heatmap(rate, [shorten_name(name) for name in policies], names, percent_texts(rate), label)


def difference_heatmap(candidates: Sequence[Candidate], pairs: Sequence[CellPair]) -> Figure:
    """Road minus twin in percentage points; colored where it exceeds chance."""
    policies = [c.policy for c in candidates if c.driven]
    lightings = list(dict.fromkeys(pair.lighting for pair in pairs))
    bias = matrix({(pair.policy, pair.lighting): pair.bias.value for pair in pairs}, policies, lightings)
    beyond = {(pair.policy, pair.lighting): float(not pair.within_chance) for pair in pairs}
    texts = np.array([[f"{100 * each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in bias])
    shown = bias * matrix(beyond, policies, lightings)
    names, label = lighting_labels(lightings)
    return heatmap(shown, [shorten_name(name) for name in policies], names, texts, label, FULL_WIDTH)


def _square(x: str, y: str) -> tuple[Figure, Axes]:
    figure, axes = new_figure(_SQUARE_SIZE)
    with style():
        axes.plot([0, 1], [0, 1], color=MUTED, lw=0.9, ls="--", zorder=1)
        axes.set(xlim=RATE_LIMITS, ylim=RATE_LIMITS, xlabel=x, ylabel=y, xticks=RATE_TICKS, yticks=RATE_TICKS)
    return figure, axes


def _plot_crosses(axes: Axes, x: list[Estimate], y: list[Estimate], color: str, name: str) -> None:
    (at_x, ends_x), (at_y, ends_y) = _error_bars(x), _error_bars(y)
    axes.errorbar(at_x, at_y, xerr=ends_x, yerr=ends_y, fmt="none", ecolor=color, elinewidth=0.8, alpha=0.5)
    axes.plot(at_x, at_y, "o", color=color, ms=4.5, label=name, zorder=4)


def _error_bars(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,), and lengths of the intervals below and above, shape (2, n)."""
    rows = [(e.value or 0.0, e.low if e.low is not None else e.value, e.high if e.high is not None else e.value)
            for e in estimates]  # fmt: skip
    value, low, high = np.array(rows, float).reshape(-1, 3).T
    return value, np.stack([np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)])


def _label_outliers(axes: Axes, points: list[tuple[str, float, float]]) -> None:
    named: list[tuple[float, float]] = []
    for name, x, y in sorted(points, key=lambda p: -abs(p[2] - p[1])):
        if len(named) == _MAX_LABELS or any(
            abs(x - a) < _LABEL_SIZE[0] and abs(y - b) < _LABEL_SIZE[1] for a, b in named
        ):
            continue
        named.append((x, y))
        offset, side = ((-7, -10), "right") if x > 0.5 else ((7, -10), "left")
        box = {"facecolor": CARD, "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
        text = axes.annotate(
            shorten_name(name), (x, y), offset, textcoords="offset points", ha=side, bbox=box, zorder=3
        )
        text.set(fontsize=7.5, color=MUTED)


def _set_policy_ticks(axes: Axes, candidates: Sequence[Candidate]) -> None:
    axes.set_yticks(range(len(candidates)), [shorten_name(c.policy) for c in candidates])


def legend_below(axes: Axes, columns: int, height: float) -> None:
    """Adds a legend below the axes of a figure of the given height [in]."""
    with style():
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.45 / height), ncols=columns, handlelength=1.4)


def lighting_labels(lightings: Sequence[str]) -> tuple[list[str], str]:
    """Column names of lightings without a suffix common to all, and an axis label that names that suffix."""
    conditions = [Condition.parse(name) for name in lightings]
    if all(one.randomised for one in conditions):
        return [shorten_name(one.lighting) for one in conditions], f"lights, all of them {RANDOMIZED}"
    return [shorten_name(name) for name in lightings], ""


def shorten_name(name: str) -> str:
    return (
        name
        if len(name) <= _MAX_NAME_LENGTH
        else f"{name[: _MAX_NAME_LENGTH // 2]}…{name[-(_MAX_NAME_LENGTH // 2 - 1) :]}"
    )


# ---- page


def write_forecast_page(forecast: Forecast, folder: Path) -> None:
    """Writes `forecast.html`, atomically; `folder` is in the scene's folder."""
    write_text(folder / "forecast.html", forecast_page(forecast, folder.parent))


def forecast_page(forecast: Forecast, root: Path = Path("SCENE")) -> str:
    """The whole page; `root` is the scene's folder in the commands to type."""
    policies = len({c.policy for c in forecast.candidates})
    tasks = f"{len(forecast.tasks)} tasks" if len(forecast.tasks) > 1 else "one task"
    measured = [group for group in forecast.groups if not group.missing]
    known = [c for c in forecast.candidates if c.corrected.value is not None]
    agreement, predictions, unpredicted = None, [], ""
    if forecast.groups:
        title = "Success on the road over success in the twin; on the dashed line they are equal"
        agreement = Chart(title, svg(twin_against_road(forecast)))
    if any(c.driven for c in known):
        title = "Observed rate over the rate predicted from the other policies"
        predictions = [Chart(title, svg(predicted_against_road(forecast)))]
    if not known:
        reasons = dict.fromkeys(c.corrected.missing for c in forecast.candidates)
        unpredicted = "No real trials were given to estimate it from."
        unpredicted = f"Not given: {'; '.join(reasons)}." if forecast.groups else unpredicted
    again = "Add the results to real.csv, and forecast again:"
    return render(
        "forecast.html",
        title=f"{forecast.scene}: forecast",
        kicker=f"{policies} policies on {tasks}: {forecast.twin_trials} trials in the twin, "
        f"{forecast.real_trials} on the road.",
        verdicts=verdicts(forecast),
        headings={
            "road": "Does the twin predict the road?",
            "stages": "From training to the road",
            "policies": "Which policy is best?",
            "predictions": "What to expect on the road",
            "cells": "Cell by cell",
            "unknown": "Limitations",
            "next": "What to do next",
        },
        files=["forecast.json", "forecast.csv"],
        forecast=forecast,
        tasks=[_task(forecast, task) for task in forecast.tasks],
        measured=measured,
        statistic_heads=["", *(f"{g.task} (n = {g.policies}, {g.cells} cells)" for g in measured), "meaning"],
        agreement=agreement,
        predicted=[c for c in known if not c.driven],
        tested=[c for c in known if c.driven],
        prediction_charts=predictions,
        unpredicted=unpredicted,
        beyond_chance=sum(not pair.within_chance for pair in forecast.pairs),
        limitations=limitations(forecast),
        next_steps=[
            *((text, []) for text in next_trials(forecast)),
            (again, [command("forecast", root, "--real", "real.csv")]),
        ],
        MIN_POLICIES=MIN_POLICIES,
        MIN_TRIALS=MIN_TRIALS,
        STATISTICS=STATISTICS,
        PERCENT_STATISTICS=PERCENT_STATISTICS,
        NOMINAL_INTERVALS=NOMINAL_INTERVALS,
        allocation_text=allocation_text,
        format_estimate=format_estimate,
        format_probability=format_probability,
        percentage_points=percentage_points,
    )


def _task(forecast: Forecast, task: str) -> dict[str, Any]:
    """Candidates and charts of a task."""
    mine, pairs = forecast.candidates_of(task), [pair for pair in forecast.pairs if pair.task == task]
    charts = [Chart("Success rates with 90% intervals", svg(rate_figure(mine)))]
    if len(mine) > 1:
        charts.append(Chart("Probability of each rank in the twin", svg(rank_heatmap(mine))))
    rates, differences = [], []
    if pairs and len(forecast.pairs) > MAX_TABLE_ROWS:
        rates = [
            Chart("In the twin [%]", svg(twin_heatmap(mine, pairs))),
            Chart("On the road [%]", svg(road_heatmap(mine, pairs))),
        ]
        title = "Road minus twin [points]: red where the twin was too optimistic, blue the opposite, pale within chance"
        differences = [Chart(title, svg(difference_heatmap(mine, pairs)))]
    return {"name": task, "candidates": mine, "charts": charts, "cell_rates": rates, "differences": differences}
