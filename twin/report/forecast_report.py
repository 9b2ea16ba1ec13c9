"""Writes `forecast.html`: how well the twin predicts the road, which policy is best, and how certain that is."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.config import RANDOMIZED
from twin.evaluation.forecasting import Agreement, Candidate, CellPair, Estimate, Forecast
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
    percentage_points,
    verdicts,
)
from twin.report.html import (
    MAX_TABLE_ROWS,
    Html,
    caution,
    chart,
    document,
    element,
    folded,
    headline,
    join,
    page_header,
    table,
)

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
    if all(name.endswith(RANDOMIZED) for name in lightings):
        return [shorten_name(name.removesuffix(RANDOMIZED)) for name in lightings], f"lights, all of them {RANDOMIZED}"
    return [shorten_name(name) for name in lightings], ""


def shorten_name(name: str) -> str:
    return (
        name
        if len(name) <= _MAX_NAME_LENGTH
        else f"{name[: _MAX_NAME_LENGTH // 2]}…{name[-(_MAX_NAME_LENGTH // 2 - 1) :]}"
    )


# ---- page

_STYLE = ".whole, td code { white-space:nowrap }\n"


def write_forecast_page(forecast: Forecast, folder: Path) -> None:
    """Writes `forecast.html`, atomically."""
    write_text(folder / "forecast.html", forecast_page(forecast))


def forecast_page(forecast: Forecast) -> str:
    sections = [
        ("road", "Does the twin predict the road?", _agreement_section(forecast)),
        ("stages", "From training to the road", _stages_section(forecast)),
        ("policies", "Which policy is best?", _policies_section(forecast)),
        ("predictions", "What to expect on the road", _predictions_section(forecast)),
        ("more", "How many more trials?", _trials_section(forecast)),
        ("cells", "Cell by cell", _cells_section(forecast)),
        ("unknown", "Limitations", join(*map(caution, limitations(forecast)))),
    ]
    links = (
        element("a", "forecast.json", href="forecast.json"),
        " and ",
        element("a", "forecast.csv", href="forecast.csv"),
    )
    return document(
        f"{forecast.scene}: forecast",
        _STYLE,
        _header(forecast),
        element("nav", *(element("a", title, href=f"#{name}") for name, title, _ in sections)),
        *(element("section", element("h2", title), content, id=name) for name, title, content in sections),
        element("footer", "Every number is in ", *links, " beside this page."),
    )


def _header(forecast: Forecast) -> Html:
    policies = len({c.policy for c in forecast.candidates})
    tasks = f"{len(forecast.tasks)} tasks" if len(forecast.tasks) > 1 else "one task"
    trials = f"{forecast.twin_trials} trials in the twin, {forecast.real_trials} on the road"
    kicker = f"{policies} policies on {tasks}: {trials}."
    return page_header(f"{forecast.scene}: forecast", kicker, *map(headline, verdicts(forecast)))


def _agreement_section(forecast: Forecast) -> Html:
    lead = element(
        "p",
        "Policies were driven in the twin and on the road. If the twin is a good predictor, policies that succeed more "
        "often in the twin also succeed more often on the road. Brackets are 90% intervals of the average over other "
        "policies of this kind with as many trials.",
        class_="done",
    )
    doubt = element(
        "div", element("b", "The intervals may be too narrow."), NOMINAL_INTERVALS, class_="caution", role="note"
    )
    if not forecast.groups:
        return element("p", "No real trials were given, so this was not measured.", class_="na")
    shown = [group for group in forecast.groups if not group.missing]
    refused = [_refusal(group) for group in forecast.groups if group.missing]
    rows: list[list[str]] = [
        [
            element("b", title, class_="whole"),
            *(_estimate(getattr(group, name), name in PERCENT_STATISTICS) for group in shown),
            element("span", meaning, class_="meaning"),
        ]
        for name, title, meaning in STATISTICS
    ]
    heads = ["", *(f"{g.task} (n = {g.policies}, {g.cells} cells)" for g in shown), "meaning"]
    drawn = chart(
        "Success on the road over success in the twin; on the dashed line they are equal",
        svg(twin_against_road(forecast)),
    )
    return join(lead, *refused, *((table(heads, rows), doubt) if shown else ()), element("div", drawn, class_="charts"))


def _estimate(estimate: Estimate, percent: bool = False) -> Html:
    """A number whose interval does not break across lines, or the reason why there is none."""
    if estimate.value is None:
        return element("span", estimate.missing, class_="meaning")
    value, _, ends = format_estimate(estimate, percent).partition(" ")
    return join(value, " ", element("span", ends, class_="whole"))


def _refusal(group: Agreement) -> Html:
    needed = f"At least {MIN_POLICIES} policies and {MIN_TRIALS} trials in every cell are needed."
    return element(
        "div",
        element("b", f"{group.task}: no correlation is given."),
        f"{needed} Missing: {'; '.join(group.missing)}.",
        class_="caution",
        role="note",
    )


def _stages_section(forecast: Forecast) -> Html:
    """The table common in papers: training, validation and real success rate per policy and task."""
    lead = element(
        "p",
        "Train: success in the last training episodes before the policy was saved, with exploration. Validate: "
        "success in the twin, in the lightings that are compared with those of the road. Real: success on the road. A "
        "drop from the first to the second rate is overfitting to the training; a drop from the second to the third "
        "is the twin’s error, or chance.",
        class_="done",
    )
    parts = [lead]
    for task in forecast.tasks:
        rows: list[list[str]] = [
            [element("code", c.policy), *map(_stage_rate, (c.trained, c.twin, c.real))]
            for c in forecast.candidates_of(task)
        ]
        parts += [element("h3", task), table(["policy", "train", "validate", "real"], rows)]
    return join(*parts)


def _stage_rate(estimate: Estimate) -> Html:
    return Html("–") if estimate.value is None else _estimate(estimate, True)


def _policies_section(forecast: Forecast) -> Html:
    parts: list[Html] = [
        element(
            "p",
            "A policy’s rate is the mean over its lightings. Its interval assumes independent trials; correlated "
            "trials of one day contain less information. Ranks have 90% intervals under the same assumption: the "
            "order of two policies with nearly the same rate is uncertain.",
            class_="done",
        )
    ]
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        rows = [
            [
                element("code", c.policy),
                _estimate(c.twin, True),
                str(c.twin.n),
                f"{c.twin_rank.low:.0f} to {c.twin_rank.high:.0f}",
                format_probability(c.twin_ranks[0]),
                _estimate(c.real, True),
                str(c.real.n) if c.driven else "",
                format_probability(c.real_ranks[0]) if c.real_ranks else "",
            ]
            for c in mine
        ]
        heads = ["policy", "twin", "trials", "rank in twin", "best in twin", "road", "trials", "best on road"]
        figures = [chart("Success rates with 90% intervals", svg(rate_figure(mine)))]
        if len(mine) > 1:
            figures.append(chart("Probability of each rank in the twin", svg(rank_heatmap(mine))))
        parts += [element("h3", task), element("div", *figures, class_="charts"), table(heads, rows, (2, 4, 6, 7))]
    return join(*parts)


def _predictions_section(forecast: Forecast) -> Html:
    lead = element(
        "p",
        "The driven policies measure the bias of the twin’s rates; the same correction predicts the rates of the "
        "others. Each prediction excludes the policy’s own real trials, so the driven policies test it. Intervals are "
        "for the rate observed in as many real trials.",
        class_="done",
    )
    known = [c for c in forecast.candidates if c.corrected.value is not None]
    if not known:
        reasons = dict.fromkeys(c.corrected.missing for c in forecast.candidates)
        why = (
            f"Not given: {'; '.join(reasons)}." if forecast.groups else "No real trials were given to estimate it from."
        )
        return join(lead, element("p", why, class_="na"))
    rows: list[list[str]] = [
        [
            element("code", c.policy),
            c.task,
            _estimate(c.twin, True),
            _estimate(c.corrected, True),
            _estimate(c.real, True),
        ]
        for c in known
    ]
    heads = ["policy", "task", "twin", "predicted for the road", "road"]
    further = [row for row, c in zip(rows, known, strict=True) if not c.driven]
    driven = [row for row, c in zip(rows, known, strict=True) if c.driven]
    parts = [lead]
    if any(c.driven for c in known):
        drawn = chart(
            "Observed rate over the rate predicted from the other policies", svg(predicted_against_road(forecast))
        )
        parts.append(element("div", drawn, class_="charts"))
    if further:
        parts += [element("h3", "Not yet driven"), table(heads, further)]
    if driven:
        parts.append(folded("Driven policies, each predicted from the others", table(heads, driven)))
    if forecast.left_out:
        out = [
            [
                x.task,
                x.lighting,
                str(x.cells),
                _estimate(x.twin_error, True),
                _estimate(x.corrected_error, True),
                _estimate(x.coverage, True),
            ]
            for x in forecast.left_out
        ]
        heads = ["task", "lighting", "cells", "twin is off by", "prediction is off by", "within its interval"]
        words = "Each lighting is predicted from the others only; this tests the prediction for a new light."
        parts += [
            element("h3", "Leaving one lighting out"),
            element("p", words, class_="done"),
            table(heads, out, (2,)),
        ]
    return join(*parts)


def _trials_section(forecast: Forecast) -> Html:
    rule = (
        f"The best policy is settled when the leading one is, with a probability of {forecast.sure:.0%}, the best or "
        f"within {percentage_points(forecast.margin)} of it; the order is settled when {forecast.sure:.0%} of the "
        "pairs that differ by more are in the right order. Trials are counted per policy, spread over its lightings, "
        "and averaged over the posterior of the rates, assuming independent trials."
    )
    words = [element("p", allocation_text(forecast, allocation)) for allocation in forecast.plans]
    return join(*words, element("p", rule, class_="done"))


def _cells_section(forecast: Forecast) -> Html:
    if not forecast.pairs:
        return element("p", "No real trials were given.", class_="na")
    rows, beyond_chance = [], 0
    for pair in forecast.pairs:
        light = (
            pair.lighting if pair.lighting == pair.twin_lighting else f"{pair.lighting} (twin: {pair.twin_lighting})"
        )
        beyond_chance += not pair.within_chance
        tag, words = ("span", "within chance") if pair.within_chance else ("b", "beyond chance")
        luck = element(tag, words, class_="whole")
        counts = _estimate(pair.twin, True), str(pair.twin.n), _estimate(pair.real, True), str(pair.real.n)
        rows.append([element("code", pair.policy), pair.task, light, *counts, _estimate(pair.bias, True), luck])
    heads = ["policy", "task", "lighting", "twin", "n", "road", "n", "road minus twin", ""]
    lead = (
        f"{beyond_chance} of {len(rows)} cells differ by more than chance; about one in ten at most would if the twin "
        "were perfect."
    )
    parts, cells = [element("p", lead, class_="done")], table(heads, rows, (4, 6))
    if len(rows) <= MAX_TABLE_ROWS:
        return join(*parts, cells)
    for task in forecast.tasks:
        mine = [pair for pair in forecast.pairs if pair.task == task]
        if mine:
            every = forecast.candidates_of(task)
            rates = element(
                "div",
                chart("In the twin [%]", svg(twin_heatmap(every, mine))),
                chart("On the road [%]", svg(road_heatmap(every, mine))),
                class_="charts",
            )
            title = (
                "Road minus twin [points]: red where the twin was too optimistic, blue the opposite, pale within chance"
            )
            difference = element("div", chart(title, svg(difference_heatmap(every, mine))), class_="charts")
            parts += [element("h3", task), rates, difference]
    return join(*parts, folded("Every policy in every lighting, with intervals", cells))
