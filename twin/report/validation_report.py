"""`validation.html`: one file that tells a newcomer how often policies arrive, in which light, and why not otherwise.

It is drawn from what `summary.json` holds (*said*, see `validation.summary` and `twin.validate`), from the maps beside
it, and from the curves of the trainings. Films lie beside the page; their pictures are in it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.errors import listing
from twin.evaluation.training_curves import draw_curve
from twin.evaluation.trials import RECENT
from twin.files import write_text
from twin.report.figures import INK, SERIES, WHOLE, matrix, new_figure, percents, style, svg, tiles
from twin.report.forecast_report import LIMITS, TICKS, columns_of, legend_below, short
from twin.report.html import LONG, Html, caution, data_url, document, element, folded, headline, join, picture, table
from twin.report.validation_summary import (
    FAILURES,
    LUCK,
    chance_words,
    light_words,
    pair_words,
    percent,
    tasks,
    trained_words,
    unknowns,
    verdicts,
    why,
)
from twin.scene import SceneDir

# ---- The validation's figures: success per policy and light, who beats whom, and success along the trainings.


FEW = 4
"""Lightings at most, of which every rate is drawn with its interval."""

_ROW = 0.17  # [in] per point
_LETTERS = 55  # in a row of the legend, with four for each marker
_APART = 0.18  # between two lightings of a policy, of the distance of two policies


def rates(cells: Sequence[dict[str, Any]]) -> Figure:
    """One row per policy, one colour per lighting, `FEW` at most: success in the cells of a task with its interval."""
    policies, lightings = (list(dict.fromkeys(c[key] for c in cells)) for key in ("policy", "lighting"))
    height = 0.9 + max(0.34, _ROW * len(lightings)) * len(policies)
    figure, axes = new_figure(height)
    with style():
        for k, lighting in enumerate(lightings):
            mine = [c for c in cells if c["lighting"] == lighting]
            y = np.array([policies.index(c["policy"]) for c in mine]) + (k - (len(lightings) - 1) / 2) * _APART
            x, low, high = (np.array([c[key] for c in mine], float) for key in ("rate", "low", "high"))
            ends = np.maximum([x - low, high - x], 0.0)
            axes.errorbar(x, y, xerr=ends, fmt="o", color=SERIES[k], ms=3.5, lw=1.1, label=lighting)
        axes.set_yticks(range(len(policies)), [short(name) for name in policies])
        axes.grid(False, axis="y")
        label = "success rate" if len(lightings) > 1 else f"success rate in the light {lightings[0]}"
        axes.set(xlim=LIMITS, ylim=(len(policies) - 0.5, -0.5), xlabel=label, xticks=TICKS)
    if len(lightings) > 1:
        fitting = max(1, _LETTERS // (max(map(len, lightings)) + 4))  # wider than the figure, it would leave no axes
        legend_below(axes, min(fitting, len(lightings)), height)
    return figure


def rate_tiles(cells: Sequence[dict[str, Any]], trained: Mapping[str, float | None]) -> Figure:
    """Per cent of episodes in the cells of a task: a row per policy, a column per lighting.

    Before them stand the policies' rates in training, and the mean over the lightings that all of them drove in.
    """
    policies, lightings = (list(dict.fromkeys(c[key] for c in cells)) for key in ("policy", "lighting"))
    rate = matrix({(c["policy"], c["lighting"]): c["rate"] for c in cells}, policies, lightings)
    common = rate[:, np.isfinite(rate).all(0)]
    means = common.mean(1) if common.size else np.full(len(policies), np.nan)
    training = np.array([trained.get(policy) for policy in policies], float)
    shown = np.column_stack([training, means, rate])
    names, label = columns_of(lightings)
    columns = ["in training", "mean", *names]
    return tiles(shown, [short(policy) for policy in policies], columns, percents(shown), label, WHOLE)


def better(pairs: Sequence[dict[str, Any]]) -> Figure:
    """Who beats whom on a task: a row's policy is better than a column's in blue, worse in red, or it may be chance.

    The numbers are how many more of the episodes that both drove the row's policy arrived in. Who beats more than beat
    it is above; columns have the rows' order.
    """
    policies = list(dict.fromkeys(p[key] for p in pairs for key in ("a", "b")))
    ahead, surely = (np.full((len(policies), len(policies)), np.nan) for _ in range(2))
    for pair in pairs:
        i, j, more = policies.index(pair["a"]), policies.index(pair["b"]), pair["only_a"] - pair["only_b"]
        ahead[i, j], ahead[j, i] = more, -more
        surely[i, j] = 0.0 if pair["p"] > LUCK else np.sign(more)
        surely[j, i] = -surely[i, j]
    order = np.lexsort([-np.nansum(ahead, 1), -np.nansum(surely, 1)])
    ahead, surely = ahead[order][:, order], surely[order][:, order]
    numbers = [str(k + 1) for k in range(len(policies))]
    rows = [f"{short(policies[i])}  {number}" for i, number in zip(order, numbers, strict=True)]
    texts = np.array([[f"{each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in ahead])
    return tiles(surely, rows, numbers, texts, "compared with the policy of this number", WHOLE)


def along_training(steps: NDArray[np.int64], success: NDArray[np.int64], saved: Sequence[int]) -> Figure:
    """Success over the steps of a training with its interval; where policies were saved that are validated.

    Args:
        steps: At which episodes ended, ascending, shape (n,), n > 0.
        success: 0 or 1, shape (n,).
        saved: Steps at which the validated policies were saved.
    """
    figure, axes = new_figure(2.2)
    with style():
        draw_curve(axes, steps, success, SERIES[0])
        for one in saved:
            axes.axvline(one, color=INK, lw=0.9, ls="--")
        axes.set(xlabel="training step", ylabel="success in training", ylim=LIMITS, yticks=TICKS)
        axes.set_xlim(left=0)
    return figure


_STYLE = """.whole, td code { white-space:nowrap }
th, td { overflow-wrap:normal }
img { background:#fff }
"""

Section = tuple[str, str, Html]


@dataclass(frozen=True)
class Curve:
    """The training of a run."""

    run: str
    steps: NDArray[np.int64]
    """At which episodes ended, ascending, shape (n,)."""
    success: NDArray[np.int64]
    """0 or 1, shape (n,)."""


def write_validation_page(scene: SceneDir, said: dict[str, Any], curves: Sequence[Curve]) -> None:
    """Writes `validation/validation.html`; half a page is never seen."""
    path = scene.validation / "validation.html"
    write_text(path, validation_page(scene.root.resolve().name, path.parent, said, curves))


def validation_page(scene: str, folder: Path, said: dict[str, Any], curves: Sequence[Curve]) -> str:
    """The whole page.

    Args:
        scene: Its name.
        folder: Where maps and films are.
        said: See the module.
        curves: Trainings that validated policies come from.
    """
    sections: list[Section] = [
        ("arrive", "How often does each policy arrive?", _cells(said)),
        *_better(said),
        *_worst(said),
        ("trust", "What if the pictures are wrong?", _trust(said)),
        ("where", "Where do they fail?", _maps(folder, said)),
        ("films", "Watch them", _films(said, folder)),
        *_curves(said, curves),
        ("unknown", "What this cannot know", join(*map(caution, unknowns(said)))),
    ]
    files = [element("a", name, href=name) for name in ("summary.json", "cells.csv", "episodes.csv")]
    return document(
        f"{scene}: validation",
        _STYLE,
        _header(scene, said),
        element("nav", *(element("a", title, href=f"#{name}") for name, title, _ in sections)),
        *(element("section", element("h2", title), content, id=name) for name, title, content in sections),
        element("footer", "Every number is in ", files[0], ", ", files[1], " and ", files[2], " beside this page."),
    )


def _header(scene: str, said: dict[str, Any]) -> Html:
    policies = len({c["policy"] for c in said["cells"]})
    lights = len({c["lighting"] for c in said["cells"]})
    episodes = sum(c["trials"] for c in said["cells"])
    told = f"{_count(policies, 'policy', 'policies')}, {_count(lights, 'lighting')}: {episodes} episodes in the twin."
    return element(
        "header",
        element("h1", f"{scene}: validation"),
        element("p", told, class_="kicker"),
        element("ul", *map(headline, verdicts(said)), class_="verdicts"),
        class_="top",
    )


def _cells(said: dict[str, Any]) -> Html:
    trained = said["training"]
    parts: list[Html] = [
        _lead(
            "An episode is one drive, from a start drawn at random to the goal or to a failure. All policies drive the "
            f"same episodes. Brackets are {said['confidence']:.0%} intervals: how far chance alone may have moved the "
            f"rate. “In training” is success over the last {RECENT} whole episodes before the policy was saved, in "
            "which it also tried things out, so that it may do better here; one that does much worse has learnt its "
            "training by heart."
        )
    ]
    for task in tasks(said):
        mine = [c for c in said["cells"] if c["task"] == task]
        rows: list[list[str]] = []
        for policy in dict.fromkeys(c["policy"] for c in mine):
            name: list[str] = [element("code", policy), _training(trained.get(policy))]
            for c in (c for c in mine if c["policy"] == policy):
                light = element("span", c["lighting"], class_="whole")
                rows.append([*name, light, _rate(c), str(c["trials"]), why(c)])
                name = ["", ""]
        told = table(["policy", "in training", "light", "arrived", "episodes", "the others"], rows, (4,))
        if len({c["lighting"] for c in mine}) <= FEW:
            chart = _chart("Share of episodes that reached the goal", svg(rates(mine)))
        else:
            least, most = min(c["trials"] for c in mine), max(c["trials"] for c in mine)
            each = f"{least}" if least == most else f"{least} to {most}"
            title = (
                f"Episodes that reached the goal [%], of {each} in each light; the mean is of the lights all drove in"
            )
            drawn = rate_tiles(mine, {policy: rate["rate"] for policy, rate in trained.items()})
            chart = _chart(title, svg(drawn))
        if len(rows) > LONG:
            told = folded("Every policy in every light, with intervals and what went wrong", told)
        parts += [element("h3", task), element("div", chart, class_="charts"), told]
    causes = dict.fromkeys(cause for c in said["cells"] for cause in c["causes"])
    meanings = [(FAILURES[cause][0], FAILURES[cause][1]) for cause in causes]
    lights = [(name, light_words(name)) for name in dict.fromkeys(c["lighting"] for c in said["cells"])]
    words = [element("li", element("b", name), f": {meaning}") for name, meaning in (*lights, *meanings)]
    parts.append(folded("What the words mean", element("ul", *words)))
    return join(*parts)


def _training(trained: dict[str, Any] | None) -> Html:
    if trained is None or not trained["trials"]:
        return element("span", "not known", class_="meaning")
    words = f" {trained_words(trained)}, after {trained['step']} steps"
    return join(_rate(trained), element("span", words, class_="meaning"))


def _better(said: dict[str, Any]) -> list[Section]:
    if not said["pairs"]:
        return []
    count = len(said["pairs"])
    lead = (
        "Two policies are compared on the episodes that both drove, where start, robot and light were the same. Only "
        "those tell them apart in which one arrived and the other did not. “By luck” is how often two equally good "
        f"policies would differ as much; above {LUCK:.0%} the difference is called chance. "
    )
    if count > 1:
        lead += (
            f"Were all of them equally good, luck would still call up to {LUCK * count:.1f} of these {count} "
            "comparisons a difference."
        )
    parts = [_lead(lead)]
    for task in tasks(said):
        mine = [p for p in said["pairs"] if p["task"] == task]
        if not mine:
            continue
        parts += [element("h3", task)] if len(tasks(said)) > 1 else []
        if len(mine) > LONG:
            title = (
                "How many more episodes a policy arrived in than another: in blue it is the better one, in red the "
                "worse; pale is within chance"
            )
            parts.append(element("div", _chart(title, svg(better(mine))), class_="charts"))
        parts.append(folded("Every two policies", _pairs(mine)) if len(mine) > LONG else _pairs(mine))
    return [("better", "Which policy is better?", join(*parts))]


def _pairs(pairs: Sequence[dict[str, Any]]) -> Html:
    heads = ["first", "second", "episodes", "only first arrived", "only second", "by luck", "verdict"]
    rows: list[list[str]] = [
        [
            element("code", p["a"]),
            element("code", p["b"]),
            *(str(p[key]) for key in ("episodes", "only_a", "only_b")),
            chance_words(p["p"]),
            pair_words(p),
        ]
        for p in pairs
    ]
    return table(heads, rows, (2, 3, 4, 5))


def _worst(said: dict[str, Any]) -> list[Section]:
    if not said["worst"]:
        return []
    rows = [
        [
            element("code", w["policy"]),
            w["task"],
            w["lighting"],
            str(w["of"]),
            _rate(w),
            str(w["trials"]),
            why(w),
        ]
        for w in said["worst"]
    ]
    heads = ["policy", "task", "its worst light", "lights searched", "arrived in it", "episodes", "the others"]
    lead = (
        "Lights that could have been filmed were drawn, and each policy was driven in all of them, longer in those it "
        "fared worst in. The worst one was then driven in anew, in other episodes: those are counted here, so that bad "
        "luck is not taken for a bad light. The same number is the same light for every policy."
    )
    return [("worst", "The worst light", join(_lead(lead), table(heads, rows, (3, 5))))]


def _trust(said: dict[str, Any]) -> Html:
    lead = _lead(
        "Trust says from 0 to 1 how far a picture can be believed: 1 is near to what was filmed. Episodes whose "
        f"pictures have less than {said['trusted_from']} on average are counted apart: a failure there may be the "
        "twin’s and not the policy’s."
    )
    split = [c for c in said["cells"] if c["low_trust"]["trials"]]
    if not split:
        return join(lead, element("p", "There is no such episode here.", class_="na"))
    rows: list[list[str]] = [
        [
            element("code", c["policy"]),
            c["task"],
            c["lighting"],
            *(text for rate in (c["trusted"], c["low_trust"]) for text in (_rate(rate), str(rate["trials"]))),
        ]
        for c in split
    ]
    heads = ["policy", "task", "light", "arrived where trusted", "episodes", "arrived elsewhere", "episodes"]
    told = table(heads, rows, (4, 6))
    return join(lead, folded(f"{len(rows)} policies and lights with such episodes", told) if len(rows) > LONG else told)


def _maps(folder: Path, said: dict[str, Any]) -> Html:
    lead = _lead(
        "Where the failed episodes of all policies ended, on the map and along the way. Failures in one place are the "
        "place’s doing: a bend, a narrow gap, or a fault of the twin; failures everywhere are the policy’s."
    )
    drawn = [picture(folder / f"failures_{task}.png", f"{task}, all policies and lights") for task in tasks(said)]
    return join(lead, element("div", *drawn, class_="pictures"))


def _films(said: dict[str, Any], folder: Path) -> Html:
    other = element(
        "p",
        "To film any row of episodes.csv: ",
        element("code", "python -m twin.film SCENE --policy NAME --task TASK --lighting LIGHT --seed SEED"),
        class_="meaning",
    )
    if not said["films"]:
        none = "Nothing was filmed: the command that made this page does so with --films, a minute for each film."
        return join(element("p", none, class_="na"), other)
    shown = []
    for film in said["films"]:
        ended = "reached the goal" if film["cause"] == "goal" else FAILURES[film["cause"]][0]
        kinds = " and ".join(film["which"])
        caption = join(
            element("b", f"{film['policy']}, {kinds}"),
            f": {film['task']}, light {film['lighting']}, seed {film['seed']}; {ended} after "
            f"{film['progress_m']:.1f} m. ",
            element("a", "file", href=_link(film["file"])),
        )
        video = element(
            "video",
            src=_link(film["file"]),
            poster=data_url(folder / film["poster"]),
            controls=True,
            preload="none",
            playsinline=True,
        )
        shown.append(element("figure", video, element("figcaption", caption)))
    of = listing(dict.fromkeys(str(film["of"]) for film in said["films"]))
    lead = (
        "The typical episode of a policy is the one whose way driven is the median. Its worst is the failed one that "
        "got least far; where none failed, the one whose pictures are trusted least. They were chosen from the "
        f"{of} episodes driven by the command that filmed them, and are those of the table, driven again with the "
        "same seed. The films lie beside this page."
    )
    return join(_lead(lead), element("div", *shown, class_="pictures"), other)


def _curves(said: dict[str, Any], curves: Sequence[Curve]) -> list[Section]:
    told = [curve for curve in curves if len(curve.steps)]
    if not told:
        return []
    charts = []
    for curve in told:
        saved = [t["step"] for t in said["training"].values() if t["run"] == curve.run]
        charts.append(_chart(curve.run, svg(along_training(curve.steps, curve.success, sorted(saved)))))
    lead = (
        "Success over the steps of training, in the episodes from start to goal that the policy learnt from, with 90% "
        "intervals. Dashed lines are where the policies were saved that are validated here."
    )
    return [("training", "How they were trained", join(_lead(lead), element("div", *charts, class_="charts")))]


def _lead(text: str) -> Html:
    return element("p", text, class_="done")


def _rate(rate: dict[str, Any]) -> Html:
    """A rate whose interval does not break across lines."""
    return element("span", percent(rate), class_="whole")


def _count(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"


def _link(path: str) -> str:
    return quote(path)


def _chart(title: str, drawing: str) -> Html:
    return element("div", element("h3", title), Html(drawing))
