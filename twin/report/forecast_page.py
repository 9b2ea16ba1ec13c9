"""`forecast.html`: one file that tells a newcomer which policy to take, how sure that is, and what is not known."""

from pathlib import Path

from twin.files import write_text
from twin.report import forecast_figures as draw
from twin.report.figures import svg
from twin.report.forecast import Estimate, Forecast, Group
from twin.report.forecast_words import (
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
from twin.report.markup import LONG, Html, caution, document, element, folded, headline, join, table
from twin.report.statistics import MIN_POLICIES, MIN_TRIALS

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
        svg(draw.twin_against_road(forecast)),
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
        figures = [_chart("Success rates with 90% intervals", svg(draw.rates(mine)))]
        if len(mine) > 1:
            figures.append(_chart("How likely each rank is, in the twin", svg(draw.rank_chances(mine))))
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
        drawn = _chart("What was seen over what was predicted without it", svg(draw.predicted_against_road(forecast)))
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
                _chart("In the twin [%]", svg(draw.twin_cells(every, mine))),
                _chart("On the road [%]", svg(draw.road_cells(every, mine))),
                class_="charts",
            )
            title = "Road minus twin [points]: red where the twin promised more, blue less, pale within chance"
            off = element("div", _chart(title, svg(draw.road_minus_twin(every, mine))), class_="charts")
            parts += [element("h3", task), beside, off]
    return join(*parts, folded("Every policy in every lighting, with intervals", told))


def _chart(title: str, drawing: str) -> Html:
    return element("div", element("h3", title), Html(drawing))
