"""Writes `validation.html`: how often policies reach the goal in each lighting, and why they fail.

`results` is the content of `summary.json` (see `validation_summary.summarize` and `twin.validate`). Videos are stored
beside the page, their posters inside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.errors import join_names
from twin.evaluation.training_curves import plot_success_curve
from twin.evaluation.trials import RECENT_EPISODES
from twin.files import write_text
from twin.report.figures import FULL_WIDTH, INK, SERIES, heatmap, matrix, new_figure, percent_texts, style, svg
from twin.report.forecast_report import RATE_LIMITS, RATE_TICKS, legend_below, lighting_labels, shorten_name
from twin.report.html import (
    MAX_TABLE_ROWS,
    Html,
    caution,
    chart,
    data_url,
    document,
    element,
    folded,
    headline,
    join,
    page_header,
    picture,
    table,
)
from twin.report.validation_summary import (
    FAILURES,
    MAX_P_VALUE,
    failure_text,
    lighting_text,
    limitations,
    p_value_text,
    pair_text,
    rate_text,
    tasks,
    training_text,
    verdicts,
)
from twin.scene import SceneDir

# ---- figures

MAX_PLOTTED_LIGHTINGS = 4
"""Up to this many lightings rates are plotted with intervals, else as a heatmap."""

_ROW_HEIGHT = 0.17  # [in] per rate
_LEGEND_LETTERS = 55  # per row of the legend; a marker counts as four
_LIGHTING_SPACING = 0.18  # in units of the distance of two policies


def rate_figure(cells: Sequence[dict[str, Any]]) -> Figure:
    """Success in the cells of a task with intervals: one row per policy, one color per lighting."""
    policies, lightings = (list(dict.fromkeys(c[key] for c in cells)) for key in ("policy", "lighting"))
    height = 0.9 + max(0.34, _ROW_HEIGHT * len(lightings)) * len(policies)
    figure, axes = new_figure(height)
    with style():
        for k, lighting in enumerate(lightings):
            mine = [c for c in cells if c["lighting"] == lighting]
            y = (
                np.array([policies.index(c["policy"]) for c in mine])
                + (k - (len(lightings) - 1) / 2) * _LIGHTING_SPACING
            )
            x, low, high = (np.array([c[key] for c in mine], float) for key in ("rate", "low", "high"))
            ends = np.maximum([x - low, high - x], 0.0)
            axes.errorbar(x, y, xerr=ends, fmt="o", color=SERIES[k], ms=3.5, lw=1.1, label=lighting)
        axes.set_yticks(range(len(policies)), [shorten_name(name) for name in policies])
        axes.grid(False, axis="y")
        label = "success rate" if len(lightings) > 1 else f"success rate in the light {lightings[0]}"
        axes.set(xlim=RATE_LIMITS, ylim=(len(policies) - 0.5, -0.5), xlabel=label, xticks=RATE_TICKS)
    if len(lightings) > 1:
        fitting = max(
            1, _LEGEND_LETTERS // (max(map(len, lightings)) + 4)
        )  # a legend wider than the figure leaves no room for the axes
        legend_below(axes, min(fitting, len(lightings)), height)
    return figure


def rate_heatmap(cells: Sequence[dict[str, Any]], trained: Mapping[str, float | None]) -> Figure:
    """Success in the cells of a task in percent: one row per policy, one column per lighting.

    The first columns are the rate in training, and the mean over the lightings in which all policies drove.
    """
    policies, lightings = (list(dict.fromkeys(c[key] for c in cells)) for key in ("policy", "lighting"))
    rate = matrix({(c["policy"], c["lighting"]): c["rate"] for c in cells}, policies, lightings)
    common = rate[:, np.isfinite(rate).all(0)]
    means = common.mean(1) if common.size else np.full(len(policies), np.nan)
    training = np.array([trained.get(policy) for policy in policies], float)
    shown = np.column_stack([training, means, rate])
    names, label = lighting_labels(lightings)
    columns = ["in training", "mean", *names]
    return heatmap(
        shown, [shorten_name(policy) for policy in policies], columns, percent_texts(shown), label, FULL_WIDTH
    )


def pair_heatmap(pairs: Sequence[dict[str, Any]]) -> Figure:
    """Paired comparisons of a task's policies: the row's policy is better (blue), worse (red), or within chance (pale).

    A cell's number is how many more of the shared episodes the row's policy succeeded in. Rows are sorted by
    significant wins minus losses; columns have the same order.
    """
    policies = list(dict.fromkeys(p[key] for p in pairs for key in ("a", "b")))
    ahead, surely = (np.full((len(policies), len(policies)), np.nan) for _ in range(2))
    for pair in pairs:
        i, j, more = policies.index(pair["a"]), policies.index(pair["b"]), pair["only_a"] - pair["only_b"]
        ahead[i, j], ahead[j, i] = more, -more
        surely[i, j] = 0.0 if pair["p"] > MAX_P_VALUE else np.sign(more)
        surely[j, i] = -surely[i, j]
    order = np.lexsort([-np.nansum(ahead, 1), -np.nansum(surely, 1)])
    ahead, surely = ahead[order][:, order], surely[order][:, order]
    numbers = [str(k + 1) for k in range(len(policies))]
    rows = [f"{shorten_name(policies[i])}  {number}" for i, number in zip(order, numbers, strict=True)]
    texts = np.array([[f"{each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in ahead])
    return heatmap(surely, rows, numbers, texts, "compared with the policy of this number", FULL_WIDTH)


def training_figure(steps: NDArray[np.int64], success: NDArray[np.int64], saved: Sequence[int]) -> Figure:
    """Success (0 or 1, shape (n,)) over ascending training steps with its interval; `saved` steps are dashed lines."""
    figure, axes = new_figure(2.2)
    with style():
        plot_success_curve(axes, steps, success, SERIES[0])
        for one in saved:
            axes.axvline(one, color=INK, lw=0.9, ls="--")
        axes.set(xlabel="training step", ylabel="success in training", ylim=RATE_LIMITS, yticks=RATE_TICKS)
        axes.set_xlim(left=0)
    return figure


# ---- page

_STYLE = """.whole, td code { white-space:nowrap }
th, td { overflow-wrap:normal }
img { background:#fff }
"""

PageSection = tuple[str, str, Html]


@dataclass(frozen=True)
class TrainingCurve:
    """Success over the training of a run."""

    run: str
    steps: NDArray[np.int64]
    """Steps at which episodes ended, ascending, shape (n,)."""
    success: NDArray[np.int64]
    """0 or 1, shape (n,)."""


def write_validation_page(scene: SceneDir, results: dict[str, Any], curves: Sequence[TrainingCurve]) -> None:
    """Writes `validation/validation.html`, atomically."""
    path = scene.validation / "validation.html"
    write_text(path, validation_page(scene.root.resolve().name, path.parent, results, curves))


def validation_page(scene: str, folder: Path, results: dict[str, Any], curves: Sequence[TrainingCurve]) -> str:
    """The whole page of a scene; `folder` contains the maps and videos."""
    sections: list[PageSection] = [
        ("arrive", "How often does each policy reach the goal?", _rates_section(results)),
        *_pairs_section(results),
        *_worst_section(results),
        ("trust", "Are the pictures reliable?", _trust_section(results)),
        ("where", "Where do they fail?", _maps_section(folder, results)),
        ("films", "Videos", _videos_section(results, folder)),
        *_training_section(results, curves),
        ("unknown", "Limitations", join(*map(caution, limitations(results)))),
    ]
    files = [element("a", name, href=name) for name in ("summary.json", "cells.csv", "episodes.csv")]
    return document(
        f"{scene}: validation",
        _STYLE,
        _header(scene, results),
        element("nav", *(element("a", title, href=f"#{name}") for name, title, _ in sections)),
        *(element("section", element("h2", title), content, id=name) for name, title, content in sections),
        element("footer", "Every number is in ", files[0], ", ", files[1], " and ", files[2], " beside this page."),
    )


def _header(scene: str, results: dict[str, Any]) -> Html:
    policies = len({c["policy"] for c in results["cells"]})
    lights = len({c["lighting"] for c in results["cells"]})
    episodes = sum(c["trials"] for c in results["cells"])
    kicker = f"{_count(policies, 'policy', 'policies')}, {_count(lights, 'lighting')}: {episodes} episodes in the twin."
    return page_header(f"{scene}: validation", kicker, *map(headline, verdicts(results)))


def _rates_section(results: dict[str, Any]) -> Html:
    trained = results["training"]
    parts: list[Html] = [
        _intro(
            "An episode is one drive, from a random start to the goal or to a failure. All policies drive the same "
            f"episodes. Brackets are {results['confidence']:.0%} confidence intervals. “In training” is success in the "
            f"last {RECENT_EPISODES} complete episodes before the policy was saved, with exploration, so a policy may "
            "do better here; one that does much worse is overfitted to its training."
        )
    ]
    for task in tasks(results):
        mine = [c for c in results["cells"] if c["task"] == task]
        rows: list[list[str]] = []
        for policy in dict.fromkeys(c["policy"] for c in mine):
            name: list[str] = [element("code", policy), _training_rate(trained.get(policy))]
            for c in (c for c in mine if c["policy"] == policy):
                light = element("span", c["lighting"], class_="whole")
                rows.append([*name, light, _rate(c), str(c["trials"]), failure_text(c)])
                name = ["", ""]
        cells = table(["policy", "in training", "light", "goal reached", "episodes", "failures"], rows, (4,))
        if len({c["lighting"] for c in mine}) <= MAX_PLOTTED_LIGHTINGS:
            plot = chart("Share of episodes that reached the goal", svg(rate_figure(mine)))
        else:
            least, most = min(c["trials"] for c in mine), max(c["trials"] for c in mine)
            each = f"{least}" if least == most else f"{least} to {most}"
            title = f"Episodes that reached the goal [%], of {each} in each light; the mean is over the common lights"
            chart_figure = rate_heatmap(mine, {policy: rate["rate"] for policy, rate in trained.items()})
            plot = chart(title, svg(chart_figure))
        if len(rows) > MAX_TABLE_ROWS:
            cells = folded("Every policy in every light, with intervals and causes of failure", cells)
        parts += [element("h3", task), element("div", plot, class_="charts"), cells]
    causes = dict.fromkeys(cause for c in results["cells"] for cause in c["causes"])
    meanings = [(FAILURES[cause][0], FAILURES[cause][1]) for cause in causes]
    lights = [(name, lighting_text(name)) for name in dict.fromkeys(c["lighting"] for c in results["cells"])]
    words = [element("li", element("b", name), f": {meaning}") for name, meaning in (*lights, *meanings)]
    parts.append(folded("Definitions", element("ul", *words)))
    return join(*parts)


def _training_rate(trained: dict[str, Any] | None) -> Html:
    if trained is None or not trained["trials"]:
        return element("span", "not known", class_="meaning")
    words = f" {training_text(trained)}, after {trained['step']} steps"
    return join(_rate(trained), element("span", words, class_="meaning"))


def _pairs_section(results: dict[str, Any]) -> list[PageSection]:
    if not results["pairs"]:
        return []
    count = len(results["pairs"])
    lead = (
        "Two policies are compared on the episodes that both drove, with the same start, robot and light. Only "
        "episodes in which one of them reached the goal and the other did not count. The p-value is the probability "
        f"that two equally good policies differ as much; above {MAX_P_VALUE:.0%} the difference is reported as chance. "
    )
    if count > 1:
        lead += (
            f"Even if all were equally good, up to {MAX_P_VALUE * count:.1f} of these {count} comparisons would on "
            "average be reported as a difference."
        )
    parts = [_intro(lead)]
    for task in tasks(results):
        mine = [p for p in results["pairs"] if p["task"] == task]
        if not mine:
            continue
        parts += [element("h3", task)] if len(tasks(results)) > 1 else []
        if len(mine) > MAX_TABLE_ROWS:
            title = (
                "Number of episodes in which only the row’s policy reached the goal, minus those of the column’s: blue "
                "is better, red is worse, pale is within chance"
            )
            parts.append(element("div", chart(title, svg(pair_heatmap(mine))), class_="charts"))
        parts.append(
            folded("All pairs of policies", _pairs_table(mine)) if len(mine) > MAX_TABLE_ROWS else _pairs_table(mine)
        )
    return [("better", "Which policy is better?", join(*parts))]


def _pairs_table(pairs: Sequence[dict[str, Any]]) -> Html:
    heads = ["first", "second", "episodes", "only first arrived", "only second arrived", "p-value", "verdict"]
    rows: list[list[str]] = [
        [
            element("code", p["a"]),
            element("code", p["b"]),
            *(str(p[key]) for key in ("episodes", "only_a", "only_b")),
            p_value_text(p["p"]),
            pair_text(p),
        ]
        for p in pairs
    ]
    return table(heads, rows, (2, 3, 4, 5))


def _worst_section(results: dict[str, Any]) -> list[PageSection]:
    if not results["worst"]:
        return []
    rows = [
        [
            element("code", w["policy"]),
            w["task"],
            w["lighting"],
            str(w["of"]),
            _rate(w),
            str(w["trials"]),
            failure_text(w),
        ]
        for w in results["worst"]
    ]
    heads = ["policy", "task", "its worst light", "lights searched", "goal reached", "episodes", "failures"]
    lead = (
        "Lights that could have been filmed were sampled, and each policy drove in all of them, more often in those "
        "with low success. The worst one was then tested in new episodes; only these are counted here, so that the "
        "selection does not bias the rate. The same number is the same light for every policy."
    )
    return [("worst", "The worst light", join(_intro(lead), table(heads, rows, (3, 5))))]


def _trust_section(results: dict[str, Any]) -> Html:
    lead = _intro(
        "Trust estimates from 0 to 1 how reliable a picture is; 1 is close to what was filmed. Episodes with a mean "
        f"below {results['trusted_from']} are counted separately: a failure there may be the twin’s and not the "
        "policy’s."
    )
    split = [c for c in results["cells"] if c["low_trust"]["trials"]]
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
    heads = ["policy", "task", "light", "goal reached, trusted", "episodes", "goal reached, untrusted", "episodes"]
    cells = table(heads, rows, (4, 6))
    return join(
        lead,
        folded(f"{len(rows)} policies and lights with such episodes", cells) if len(rows) > MAX_TABLE_ROWS else cells,
    )


def _maps_section(folder: Path, results: dict[str, Any]) -> Html:
    lead = _intro(
        "End points of the failed episodes of all policies, on the map and along the route. Failures concentrated in "
        "one place indicate a cause there: a bend, a narrow gap, or an error of the twin; failures everywhere indicate "
        "the policy."
    )
    chart_figure = [
        picture(folder / f"failures_{task}.png", f"{task}, all policies and lights") for task in tasks(results)
    ]
    return join(lead, element("div", *chart_figure, class_="pictures"))


def _videos_section(results: dict[str, Any], folder: Path) -> Html:
    other = element(
        "p",
        "To record a video of any row of episodes.csv: ",
        element("code", "python -m twin.film SCENE --policy NAME --task TASK --lighting LIGHT --seed SEED"),
        class_="meaning",
    )
    if not results["films"]:
        none = "No videos: run the command that made this page with --films, which takes about a minute per video."
        return join(element("p", none, class_="na"), other)
    shown = []
    for film in results["films"]:
        ended = "reached the goal" if film["cause"] == "goal" else FAILURES[film["cause"]][0]
        kinds = " and ".join(film["which"])
        caption = join(
            element("b", f"{film['policy']}, {kinds}"),
            f": {film['task']}, light {film['lighting']}, seed {film['seed']}; {ended} after "
            f"{film['progress_m']:.1f} m. ",
            element("a", "file", href=quote(film["file"])),
        )
        video = element(
            "video",
            src=quote(film["file"]),
            poster=data_url(folder / film["poster"]),
            controls=True,
            preload="none",
            playsinline=True,
        )
        shown.append(element("figure", video, element("figcaption", caption)))
    of = join_names(dict.fromkeys(str(film["of"]) for film in results["films"]))
    lead = (
        "The typical episode of a policy has the median progress. The worst is the failed one with the least progress "
        f"or, if none failed, the one with the lowest trust. They were chosen from the {of} episodes of the command "
        "that recorded them, and repeat episodes of the table with the same seed. The videos are stored beside this "
        "page."
    )
    return join(_intro(lead), element("div", *shown, class_="pictures"), other)


def _training_section(results: dict[str, Any], curves: Sequence[TrainingCurve]) -> list[PageSection]:
    curves = [curve for curve in curves if len(curve.steps)]
    if not curves:
        return []
    charts = []
    for curve in curves:
        saved = [t["step"] for t in results["training"].values() if t["run"] == curve.run]
        charts.append(chart(curve.run, svg(training_figure(curve.steps, curve.success, sorted(saved)))))
    lead = (
        "Success over the steps of training, in the complete episodes that the policy was trained on, with 90% "
        "intervals. Dashed lines mark the steps at which the validated policies were saved."
    )
    return [("training", "How they were trained", join(_intro(lead), element("div", *charts, class_="charts")))]


def _intro(text: str) -> Html:
    return element("p", text, class_="done")


def _rate(rate: dict[str, Any]) -> Html:
    return element("span", rate_text(rate), class_="whole")


def _count(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"
