"""`forecast.html`: one file that tells a newcomer which policy to take, how sure that is, and what is not known."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.config import RANDOMISED
from twin.evaluation.forecasting import Candidate, Estimate, Forecast, Group, Pair
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.files import write_text
from twin.report.figures import CARD, MUTED, SERIES, WHOLE, matrix, new_figure, percents, style, svg, tiles
from twin.report.forecast_summary import (
    NOMINAL,
    SHARES,
    STATISTICS,
    chance,
    plan_words,
    points,
    show,
    unknowns,
    verdicts,
)
from twin.report.html import LONG, Html, caution, document, element, folded, headline, join, table

# ---- The forecast's figures: twin against road, the ranking with its uncertainty, predictions against what was seen.


LIMITS = (-0.04, 1.04)
"""Of an axis of rates."""
TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)

_NAMED = 3  # points furthest off, which are named
_NAME = (0.5, 0.06)  # width and height of a name, in units of the axes
_LONGEST = 26  # characters of a name
_ROW = 0.34  # [in] of three points with their intervals
_SQUARE = 4.6  # [in]


def twin_against_road(forecast: Forecast) -> Figure:
    """Real over twin rate of every driven candidate, coloured by task; on the diagonal the twin is right."""
    driven = [c for c in forecast.candidates if c.driven]
    figure, axes = _square("success in the twin", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in driven if c.task == task]
            if mine:
                _crosses(axes, [c.twin for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _name_furthest(axes, [(c.policy, c.twin.value or 0.0, c.real.value or 0.0) for c in driven])
    legend_below(axes, 3, _SQUARE)
    return figure


def predicted_against_road(forecast: Forecast) -> Figure:
    """Real rate of every driven candidate over what was predicted for it from the others."""
    known = [c for c in forecast.candidates if c.driven and c.corrected.value is not None]
    figure, axes = _square("predicted from the other policies", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in known if c.task == task]
            if mine:
                _crosses(axes, [c.corrected for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _name_furthest(axes, [(c.policy, c.corrected.value or 0.0, c.real.value or 0.0) for c in known])
    legend_below(axes, 3, _SQUARE)
    return figure


def rates(candidates: Sequence[Candidate]) -> Figure:
    """One row per candidate of a task, best in the twin first: its rate in the twin, on the road, and as predicted."""
    n = len(candidates)
    figure, axes = new_figure(0.8 + _ROW * n)
    columns = (
        ("in the twin", SERIES[0], "o", [c.twin for c in candidates]),
        ("on the road", SERIES[1], "s", [c.real for c in candidates]),
        ("road, predicted", SERIES[2], "D", [c.corrected for c in candidates]),
    )
    shown = [column for column in columns if any(e.value is not None for e in column[3])]
    with style():
        for k, (name, colour, marker, estimates) in enumerate(shown):
            rows = [i for i, e in enumerate(estimates) if e.value is not None]
            y = np.array(rows) + (k - (len(shown) - 1) / 2) * 0.24
            x, ends = _ends([estimates[i] for i in rows])
            axes.errorbar(x, y, xerr=ends, fmt=marker, color=colour, ms=3.5, lw=1.1, label=name)
        _names(axes, candidates)
        axes.grid(False, axis="y")
        axes.set(xlim=LIMITS, ylim=(n - 0.5, -0.5), xlabel="success rate", xticks=TICKS)
    legend_below(axes, len(shown), 0.8 + _ROW * n)
    return figure


def rank_chances(candidates: Sequence[Candidate]) -> Figure:
    """Probability of every rank in the twin, one row per candidate."""
    n = len(candidates)
    chance = np.array([c.twin_ranks for c in candidates])
    ranks = [str(k + 1) if k % -(-n // 12) == 0 else "" for k in range(n)]
    shown = np.where(chance > 0.005, chance, np.nan)
    return tiles(shown, [short(c.policy) for c in candidates], ranks, percents(chance), "rank in the twin [%]")


def twin_cells(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """Success of every driven candidate in every lighting of the twin that the road is compared with, in per cent."""
    return _forecast_figures_cells(candidates, {(pair.policy, pair.twin_lighting): pair.twin.value for pair in pairs})


def road_cells(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """Success of every driven candidate in every lighting of the road, in per cent."""
    return _forecast_figures_cells(candidates, {(pair.policy, pair.lighting): pair.real.value for pair in pairs})


def _forecast_figures_cells(candidates: Sequence[Candidate], rates: dict[tuple[str, str], float | None]) -> Figure:
    policies, lightings = [c.policy for c in candidates if c.driven], list(dict.fromkeys(light for _, light in rates))
    rate = matrix(rates, policies, lightings)
    names, label = columns_of(lightings)
    return tiles(rate, [short(name) for name in policies], names, percents(rate), label)


def road_minus_twin(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """In points, in every lighting of the road; coloured where it is more than chance."""
    policies = [c.policy for c in candidates if c.driven]
    lightings = list(dict.fromkeys(pair.lighting for pair in pairs))
    bias = matrix({(pair.policy, pair.lighting): pair.bias.value for pair in pairs}, policies, lightings)
    beyond = {(pair.policy, pair.lighting): float(not pair.within_chance) for pair in pairs}
    texts = np.array([[f"{100 * each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in bias])
    shown = bias * matrix(beyond, policies, lightings)
    names, label = columns_of(lightings)
    return tiles(shown, [short(name) for name in policies], names, texts, label, WHOLE)


def _square(x: str, y: str) -> tuple[Figure, Axes]:
    figure, axes = new_figure(_SQUARE)
    with style():
        axes.plot([0, 1], [0, 1], color=MUTED, lw=0.9, ls="--", zorder=1)
        axes.set(xlim=LIMITS, ylim=LIMITS, xlabel=x, ylabel=y, xticks=TICKS, yticks=TICKS)
    return figure, axes


def _crosses(axes: Axes, x: list[Estimate], y: list[Estimate], colour: str, name: str) -> None:
    """Points with their intervals in both directions."""
    (at_x, ends_x), (at_y, ends_y) = _ends(x), _ends(y)
    axes.errorbar(at_x, at_y, xerr=ends_x, yerr=ends_y, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.5)
    axes.plot(at_x, at_y, "o", color=colour, ms=4.5, label=name, zorder=4)


def _ends(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,), and how far the interval reaches below and above, shape (2, n)."""
    rows = [(e.value or 0.0, e.low if e.low is not None else e.value, e.high if e.high is not None else e.value)
            for e in estimates]  # fmt: skip
    value, low, high = np.array(rows, float).reshape(-1, 3).T
    return value, np.stack([np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)])


def _name_furthest(axes: Axes, points: list[tuple[str, float, float]]) -> None:
    """Names the points that are furthest off, but none over the name of another."""
    named: list[tuple[float, float]] = []
    for name, x, y in sorted(points, key=lambda p: -abs(p[2] - p[1])):
        if len(named) == _NAMED or any(abs(x - a) < _NAME[0] and abs(y - b) < _NAME[1] for a, b in named):
            continue
        named.append((x, y))
        offset, side = ((-7, -10), "right") if x > 0.5 else ((7, -10), "left")
        box = {"facecolor": CARD, "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
        text = axes.annotate(short(name), (x, y), offset, textcoords="offset points", ha=side, bbox=box, zorder=3)
        text.set(fontsize=7.5, color=MUTED)


def _names(axes: Axes, candidates: Sequence[Candidate]) -> None:
    axes.set_yticks(range(len(candidates)), [short(c.policy) for c in candidates])


def legend_below(axes: Axes, columns: int, height: float) -> None:
    """A legend below the axes of a figure of this height [in]."""
    with style():
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.45 / height), ncols=columns, handlelength=1.4)


def columns_of(lightings: Sequence[str]) -> tuple[list[str], str]:
    """Names of lightings above tiles, without what is the same in all of them, and a label that tells that."""
    if all(name.endswith(RANDOMISED) for name in lightings):
        return [short(name.removesuffix(RANDOMISED)) for name in lightings], f"lights, all of them {RANDOMISED}"
    return [short(name) for name in lightings], ""


def short(name: str) -> str:
    """A name as long as a figure has room for; checkpoints differ at their end, so the middle goes."""
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST // 2]}…{name[-(_LONGEST // 2 - 1) :]}"


_STYLE = ".whole, td code { white-space:nowrap }\n"


def write_forecast_page(forecast: Forecast, folder: Path) -> None:
    """Writes `forecast.html`; half a page is never seen."""
    write_text(folder / "forecast.html", forecast_page(forecast))


def forecast_page(forecast: Forecast) -> str:
    """The whole page."""
    sections = [
        ("road", "Does the twin foretell the road?", _road(forecast)),
        ("stages", "From training to the road", _stages(forecast)),
        ("policies", "Which policy is best?", _policies(forecast)),
        ("predictions", "What to expect on the road", _predictions(forecast)),
        ("more", "How many more trials?", _more(forecast)),
        ("cells", "Cell by cell", _cells(forecast)),
        ("unknown", "What this cannot know", join(*map(caution, unknowns(forecast)))),
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
    told = f"{policies} policies on {tasks}: {trials}."
    return element(
        "header",
        element("h1", f"{forecast.scene}: forecast"),
        element("p", told, class_="kicker"),
        element("ul", *map(headline, verdicts(forecast)), class_="verdicts"),
        class_="top",
    )


def _road(forecast: Forecast) -> Html:
    lead = element(
        "p",
        "Policies were driven in the twin and on the road. If the twin is a good judge, those that do better there do "
        "better here. Numbers in brackets are 90% intervals for what other policies of this kind, driven as often, "
        "would show on average.",
        class_="done",
    )
    doubt = element("div", element("b", "The intervals may be too narrow."), NOMINAL, class_="caution", role="note")
    if not forecast.groups:
        return element("p", "No real trials were given, so this cannot be said.", class_="na")
    told = [group for group in forecast.groups if not group.missing]
    refused = [_refusal(group) for group in forecast.groups if group.missing]
    rows: list[list[str]] = [
        [
            element("b", title, class_="whole"),
            *(_show(getattr(group, name), name in SHARES) for group in told),
            element("span", meaning, class_="meaning"),
        ]
        for name, title, meaning in STATISTICS
    ]
    heads = ["", *(f"{g.task} (n = {g.policies}, {g.cells} cells)" for g in told), "what it means"]
    drawn = _chart(
        "Success on the road over success in the twin; on the dashed line the twin is right",
        svg(twin_against_road(forecast)),
    )
    return join(lead, *refused, *((table(heads, rows), doubt) if told else ()), element("div", drawn, class_="charts"))


def _show(estimate: Estimate, percent: bool = False) -> Html:
    """A number whose interval does not break across lines, or why there is none."""
    if estimate.value is None:
        return element("span", estimate.missing, class_="meaning")
    value, _, ends = show(estimate, percent).partition(" ")
    return join(value, " ", element("span", ends, class_="whole"))


def _refusal(group: Group) -> Html:
    needed = f"{MIN_POLICIES} policies and {MIN_TRIALS} trials in every cell are the least."
    return element(
        "div",
        element("b", f"{group.task}: no correlation is given."),
        f"{needed} Missing: {'; '.join(group.missing)}.",
        class_="caution",
        role="note",
    )


def _stages(forecast: Forecast) -> Html:
    """The table that papers print: for every task a row per policy, its rates where it learnt and was judged."""
    lead = element(
        "p",
        "Train: success over the last episodes before it was saved, exploring. Validate: success in the twin, in the "
        "lightings that are compared with the road’s. Real: success on the road. A policy that falls from the first "
        "to the second has learnt its training by heart; what falls from the second to the third is the twin’s error, "
        "or chance.",
        class_="done",
    )
    parts = [lead]
    for task in forecast.tasks:
        rows: list[list[str]] = [
            [element("code", c.policy), *map(_stage, (c.trained, c.twin, c.real))] for c in forecast.of(task)
        ]
        parts += [element("h3", task), table(["policy", "train", "validate", "real"], rows)]
    return join(*parts)


def _stage(estimate: Estimate) -> Html:
    return Html("–") if estimate.value is None else _show(estimate, True)


def _policies(forecast: Forecast) -> Html:
    parts: list[Html] = [
        element(
            "p",
            "A policy’s rate is the mean over its lightings. Its interval takes trials for independent: those of one "
            "day that end alike tell less. Ranks are given with how sure they are, with trials taken likewise: two "
            "policies of nearly the same rate may as well be the other way round.",
            class_="done",
        )
    ]
    for task in forecast.tasks:
        mine = forecast.of(task)
        rows = [
            [
                element("code", c.policy),
                _show(c.twin, True),
                str(c.twin.n),
                f"{c.twin_rank.low:.0f} to {c.twin_rank.high:.0f}",
                chance(c.twin_ranks[0]),
                _show(c.real, True),
                str(c.real.n) if c.driven else "",
                chance(c.real_ranks[0]) if c.real_ranks else "",
            ]
            for c in mine
        ]
        heads = ["policy", "twin", "trials", "rank in twin", "best in twin", "road", "trials", "best on road"]
        figures = [_chart("Success rates with 90% intervals", svg(rates(mine)))]
        if len(mine) > 1:
            figures.append(_chart("How likely each rank is, in the twin", svg(rank_chances(mine))))
        parts += [element("h3", task), element("div", *figures, class_="charts"), table(heads, rows, (2, 4, 6, 7))]
    return join(*parts)


def _predictions(forecast: Forecast) -> Html:
    lead = element(
        "p",
        "The driven policies show by how much the twin’s rates are off; the same correction predicts the others. Each "
        "prediction leaves the policy’s own real trials out, so that the driven ones test it. Intervals are for "
        "the rate seen in as many real trials.",
        class_="done",
    )
    known = [c for c in forecast.candidates if c.corrected.value is not None]
    if not known:
        reasons = dict.fromkeys(c.corrected.missing for c in forecast.candidates)
        why = f"Not given: {'; '.join(reasons)}." if forecast.groups else "No real trials were given to learn it from."
        return join(lead, element("p", why, class_="na"))
    rows: list[list[str]] = [
        [
            element("code", c.policy),
            c.task,
            _show(c.twin, True),
            _show(c.corrected, True),
            _show(c.real, True),
        ]
        for c in known
    ]
    heads = ["policy", "task", "twin", "predicted for the road", "road"]
    further = [row for row, c in zip(rows, known, strict=True) if not c.driven]
    driven = [row for row, c in zip(rows, known, strict=True) if c.driven]
    parts = [lead]
    if any(c.driven for c in known):
        drawn = _chart("What was seen over what was predicted without it", svg(predicted_against_road(forecast)))
        parts.append(element("div", drawn, class_="charts"))
    if further:
        parts += [element("h3", "Not yet driven"), table(heads, further)]
    if driven:
        parts.append(folded("The driven ones, each predicted without itself", table(heads, driven)))
    if forecast.left_out:
        out = [
            [
                x.task,
                x.lighting,
                str(x.cells),
                _show(x.twin_error, True),
                _show(x.corrected_error, True),
                _show(x.coverage, True),
            ]
            for x in forecast.left_out
        ]
        heads = ["task", "lighting", "cells", "twin is off by", "prediction is off by", "within its interval"]
        words = "Each lighting foretold from the others only: would a light never driven in have been foretold?"
        parts += [
            element("h3", "Leaving one lighting out"),
            element("p", words, class_="done"),
            table(heads, out, (2,)),
        ]
    return join(*parts)


def _more(forecast: Forecast) -> Html:
    rule = (
        f"The best policy is settled when the one that leads is the truly best, or within {points(forecast.margin)} of "
        f"it, with {forecast.sure:.0%} probability; the order, when {forecast.sure:.0%} of the pairs that differ by "
        "more are in the right order. Trials are counted per policy, spread over its lightings, and are what is needed "
        "on average over the rates that are still possible, were each trial independent of the others."
    )
    words = [element("p", plan_words(forecast, plan)) for plan in forecast.plans]
    return join(*words, element("p", rule, class_="done"))


def _cells(forecast: Forecast) -> Html:
    if not forecast.pairs:
        return element("p", "No real trials were given.", class_="na")
    rows, beyond = [], 0
    for pair in forecast.pairs:
        light = (
            pair.lighting if pair.lighting == pair.twin_lighting else f"{pair.lighting} (twin: {pair.twin_lighting})"
        )
        beyond += not pair.within_chance
        tag, words = ("span", "within chance") if pair.within_chance else ("b", "beyond chance")
        luck = element(tag, words, class_="whole")
        counts = _show(pair.twin, True), str(pair.twin.n), _show(pair.real, True), str(pair.real.n)
        rows.append([element("code", pair.policy), pair.task, light, *counts, _show(pair.bias, True), luck])
    heads = ["policy", "task", "lighting", "twin", "n", "road", "n", "road minus twin", ""]
    lead = (
        f"{beyond} of {len(rows)} cells differ by more than chance; at most about one in ten would if the twin were "
        "perfect."
    )
    parts, told = [element("p", lead, class_="done")], table(heads, rows, (4, 6))
    if len(rows) <= LONG:
        return join(*parts, told)
    for task in forecast.tasks:
        mine = [pair for pair in forecast.pairs if pair.task == task]
        if mine:
            every = forecast.of(task)
            beside = element(
                "div",
                _chart("In the twin [%]", svg(twin_cells(every, mine))),
                _chart("On the road [%]", svg(road_cells(every, mine))),
                class_="charts",
            )
            title = "Road minus twin [points]: red where the twin promised more, blue less, pale within chance"
            off = element("div", _chart(title, svg(road_minus_twin(every, mine))), class_="charts")
            parts += [element("h3", task), beside, off]
    return join(*parts, folded("Every policy in every lighting, with intervals", told))


def _chart(title: str, drawing: str) -> Html:
    return element("div", element("h3", title), Html(drawing))
