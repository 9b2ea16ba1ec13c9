"""Writes `forecast.html`, the forecast's page, with figures. The page's text comes from `twin.report.forecast_text`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.evaluation.agreement import Agreement, CellPair, Estimate
from twin.evaluation.forecasting import Candidate, Forecast
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.trials import REAL_CSV
from twin.files import write_text
from twin.report import forecast_text
from twin.report.figures import (
    CARD,
    FULL_WIDTH,
    MARKERS,
    MUTED,
    RATE_AXIS,
    SERIES,
    add_legend,
    difference_texts,
    heatmap,
    legend_name,
    lighting_labels,
    matrix,
    new_figure,
    percent_texts,
    rate_chart,
    shorten_name,
    styled,
    svg,
)
from twin.report.html import MAX_TABLE_ROWS, Chart, command, counted, render

# ---- figures

_MAX_LABELS = 3  # maximum number of points with a name in a figure
_LABEL_SIZE = (0.5, 0.06)  # assumed width and height of a name, in axis units
_SQUARE_SIZE = 4.6  # [in]


@styled
def rates_against_road(forecast: Forecast, field: str = "twin", label: str = "success in the twin") -> Figure:
    """Scatter plot of the candidates that have real trials (`twin.evaluation.forecasting`), colored by task.

    Vertical: success rate on the road. Horizontal: the candidate's attribute `field`, with the axis label `label`:
    "twin" for the rate in the twin, or "corrected" for the rate predicted from policies of other trainings.
    """
    figure, axes = _unit_square(label)
    driven = [c for c in forecast.candidates if c.driven and getattr(c, field).value is not None]
    for i, task in enumerate(forecast.tasks):
        mine = [c for c in driven if c.task == task]
        if mine:
            (x, x_ends), (y, y_ends) = (_error_bars([getattr(c, name) for c in mine]) for name in (field, "real"))
            color, marker = SERIES[i % len(SERIES)], MARKERS[i % len(MARKERS)]
            axes.errorbar(x, y, xerr=x_ends, yerr=y_ends, fmt="none", ecolor=color, elinewidth=0.8, alpha=0.5)
            axes.plot(x, y, marker, color=color, ms=4.5, label=legend_name(task), zorder=4)
    _label_outliers(axes, [(c.policy, getattr(c, field).value, c.real.value or 0.0) for c in driven])
    if driven:
        add_legend(figure)
    return figure


def _unit_square(label: str) -> tuple[Figure, Axes]:
    """A figure for success on the road against the rate named by `label`; its diagonal is dashed."""
    figure, axes = new_figure(_SQUARE_SIZE)
    axes.plot([0, 1], [0, 1], color=MUTED, lw=0.9, ls="--", zorder=1)
    limits, ticks = RATE_AXIS.values()
    axes.set(xlabel=label, ylabel="success on the road", ylim=limits, yticks=ticks, **RATE_AXIS)
    return figure, axes


def _error_bars(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the values (n,), and how far their intervals extend below and above them (2, n)."""
    value, low, high = np.array([_interval(e) for e in estimates]).T
    return value, np.maximum([value - low, high - value], 0.0)


def _interval(e: Estimate) -> tuple[float, float, float]:
    value = e.value or 0.0
    return value, value if e.low is None else e.low, value if e.high is None else e.high


def _label_outliers(axes: Axes, points: list[tuple[str, float, float]]) -> None:
    """Names the points (name, x, y) farthest from the diagonal: `_MAX_LABELS` at most, whose names do not overlap."""
    named: list[tuple[float, float]] = []
    width, height = _LABEL_SIZE
    for name, x, y in sorted(points, key=lambda p: -abs(p[2] - p[1])):
        if len(named) == _MAX_LABELS or any(abs(x - a) < width and abs(y - b) < height for a, b in named):
            continue
        named.append((x, y))
        offset, side = ((-7, -10), "right") if x > 0.5 else ((7, -10), "left")
        box = {"facecolor": CARD, "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
        look: dict[str, Any] = {"ha": side, "bbox": box, "zorder": 3, "fontsize": 7.5, "color": MUTED}
        axes.annotate(shorten_name(name), (x, y), offset, textcoords="offset points", **look)


@styled
def calibration_chart(group: Agreement) -> Figure:
    """Calibration chart: success rate on the road against the success probability that the twin predicts.

    There is one point per bin of this probability; its area and label show the number of trials in the bin.
    """
    figure, axes = _unit_square("success probability predicted by the twin")
    x, y, trials = (
        np.array([getattr(it, name) for it in group.calibration]) for name in ("predicted", "observed", "trials")
    )
    axes.plot(x, y, color=SERIES[0], lw=1.0, zorder=2)
    axes.scatter(x, y, s=20 + 180 * trials / trials.max(), color=SERIES[0], alpha=0.8, linewidths=0, zorder=3)
    for at, height, n in zip(x, y, trials, strict=True):
        side = -1 if at > 0.5 else 1
        axes.annotate(f"{n}", (at, height), (side * 10, -12), textcoords="offset points", fontsize=7.5, color=MUTED)
    return figure


def rank_heatmap(candidates: Sequence[Candidate]) -> Figure:
    """Probabilities of the ranks in the twin: one row per candidate, one column per rank."""
    n = len(candidates)
    chance = np.array([c.twin_ranks for c in candidates])
    ranks = [str(k + 1) if k % -(-n // 12) == 0 else "" for k in range(n)]
    shown = np.where(chance > 0.005, chance, np.nan)
    policies = [shorten_name(c.policy) for c in candidates]
    return heatmap(shown, policies, ranks, percent_texts(chance), "rank in the twin; probabilities in %")


def cell_heatmap(candidates: Sequence[Candidate], pairs: Sequence[CellPair], field: str) -> Figure:
    """Success rates in the twin (`field`: "twin") or on the road ("real"): a row per policy, a column per lighting."""
    light = "twin_lighting" if field == "twin" else "lighting"
    rates = {(pair.policy, getattr(pair, light)): getattr(pair, field).value for pair in pairs}
    policies, lightings = [c.policy for c in candidates if c.driven], list(dict.fromkeys(name for _, name in rates))
    rate = matrix(rates, policies, lightings)
    names, label = lighting_labels(lightings)
    return heatmap(rate, list(map(shorten_name, policies)), names, percent_texts(rate), label)


def difference_heatmap(candidates: Sequence[Candidate], pairs: Sequence[CellPair]) -> Figure:
    """Success rate on the road minus that in the twin [percentage points].

    Differences whose Newcombe interval contains 0 get the color of 0, and parentheses.
    """
    policies = [c.policy for c in candidates if c.driven]
    lightings = list(dict.fromkeys(pair.lighting for pair in pairs))
    bias = matrix({(pair.policy, pair.lighting): pair.bias.value for pair in pairs}, policies, lightings)
    beyond = {(pair.policy, pair.lighting): float(not pair.within_chance) for pair in pairs}
    certain = matrix(beyond, policies, lightings)
    texts = difference_texts(100 * bias, certain)
    names, label = lighting_labels(lightings)
    return heatmap(bias * certain, list(map(shorten_name, policies)), names, texts, label, FULL_WIDTH)


# ---- page


def write_forecast_page(forecast: Forecast, folder: Path) -> None:
    """Writes `forecast.html`, atomically; `folder` lies directly in the scene's folder."""
    write_text(folder / "forecast.html", forecast_page(forecast, folder.parent))


def forecast_page(forecast: Forecast, root: Path = Path("SCENE")) -> str:
    """The HTML of the page. `root` is the scene's folder, which the commands on the page contain."""
    policies = counted(len({c.policy for c in forecast.candidates}), "policy", "policies")
    tasks = f"{len(forecast.tasks)} tasks" if len(forecast.tasks) > 1 else "one task"
    measured = [group for group in forecast.groups if not group.missing]
    known = [c for c in forecast.candidates if c.corrected.value is not None]
    driven = sum(c.driven for c in forecast.candidates)
    agreement = []
    if forecast.groups:
        title = (
            "Success on the road against success in the twin, one point per policy and task "
            f"(n = {driven}); dashed: equal rates"
        )
        agreement = [Chart(title, svg(rates_against_road(forecast)))]
    calibration = []
    if measured and measured[-1].calibration:
        group = measured[-1]
        n = f"n = {group.cells} cells, {group.task}; labels: number of trials in each bin"
        title = f"Calibration: success on the road against the success probability predicted by the twin ({n})"
        calibration = [Chart(title, svg(calibration_chart(group)))]
    predictions = []
    if tested := [c for c in known if c.driven]:
        n = f"(n = {len(tested)}); dashed: equal rates"
        title = f"Success on the road against the rate predicted from other trainings {n}"
        drawn = rates_against_road(forecast, "corrected", "predicted from other trainings")
        predictions = [Chart(title, svg(drawn))]
    unpredicted = ""
    if not known:
        reasons = "; ".join(dict.fromkeys(c.corrected.missing for c in forecast.candidates))
        unpredicted = (
            f"No prediction: {reasons}."
            if forecast.groups
            else "No prediction: it needs real trials, and none were given."
        )
    return render(
        "forecast.html",
        title=f"{forecast.scene}: forecast",
        kicker=f"{policies} on {tasks}: {counted(forecast.twin_trials, 'trial')} in the twin, "
        f"{forecast.real_trials} on the road.",
        verdicts=forecast_text.verdicts(forecast),
        headings={
            "road": "Does the twin predict the road?",
            "stages": "From training to the road",
            "policies": "Which policy is best?",
            "predictions": "What to expect on the road",
            "cells": "Twin and road under each lighting",
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
        tested=tested,
        prediction_charts=predictions,
        unpredicted=unpredicted,
        beyond_chance=sum(not pair.within_chance for pair in forecast.pairs),
        limitations=forecast_text.limitations(forecast),
        next_steps=[
            *((text, []) for text in forecast_text.next_trials(forecast)),
            (
                "Add the results to real.csv, and forecast again:",
                [command("forecast", root, "--real", root / REAL_CSV)],
            ),
        ],
        MIN_POLICIES=MIN_POLICIES,
        MIN_TRIALS=MIN_TRIALS,
        text=forecast_text,
        calibration=calibration,
        last=measured[-1] if measured else None,
    )


def _task(forecast: Forecast, task: str) -> dict[str, Any]:
    """A task's candidates and charts, for the page's template."""
    mine, pairs = forecast.candidates_of(task), [pair for pair in forecast.pairs if pair.task == task]
    columns = {"in the twin": "twin", "on the road": "real", "road, predicted": "corrected"}
    rates = {
        title: [(c.policy, *_interval(e)) for c in mine if (e := getattr(c, field)).value is not None]
        for title, field in columns.items()
    }
    drawn = rate_chart([c.policy for c in mine], {title: rows for title, rows in rates.items() if rows}, "success rate")
    charts = [Chart("Success rates with 90% intervals; the number of trials is in the table", svg(drawn))]
    if len(mine) > 1:
        charts.append(Chart("Probability of each rank in the twin [%]", svg(rank_heatmap(mine))))
    cell_rates, differences = [], []
    if pairs and len(forecast.pairs) > MAX_TABLE_ROWS:
        for where, field in (("In the twin", "twin"), ("On the road", "real")):
            trials = sorted({getattr(pair, field).n for pair in pairs})
            n = " to ".join(str(end) for end in dict.fromkeys((trials[0], trials[-1])))
            cell_rates.append(Chart(f"{where} [%], n = {n} per cell", svg(cell_heatmap(mine, pairs, field))))
        title = (
            "Road minus twin [percentage points]: red and below 0 where the twin was too optimistic, blue the "
            "opposite, pale and in parentheses where the 90% interval of the difference contains 0"
        )
        differences = [Chart(title, svg(difference_heatmap(mine, pairs)))]
    return {"name": task, "candidates": mine, "charts": charts, "cell_rates": cell_rates, "differences": differences}
