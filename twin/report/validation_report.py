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
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.training_curves import plot_success_curve
from twin.evaluation.trials import RECENT_EPISODES, csv_text
from twin.files import write_text
from twin.report.figures import FULL_WIDTH, INK, SERIES, heatmap, matrix, new_figure, percent_texts, style, svg
from twin.report.forecast_report import RATE_LIMITS, RATE_TICKS, legend_below, lighting_labels, shorten_name
from twin.report.html import MAX_TABLE_ROWS, Chart, Picture, command, data_url, render
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
    cells, curves = results["cells"], [curve for curve in curves if len(curve.steps)]
    policies, lights = (dict.fromkeys(c[key] for c in cells) for key in ("policy", "lighting"))
    headings = {
        "arrive": "How often does each policy reach the goal?",
        "better": "Which policy is better?" if results["pairs"] else "",
        "worst": "The worst light" if results["worst"] else "",
        "trust": "Are the pictures reliable?",
        "where": "Where do they fail?",
        "films": "Videos",
        "training": "How they were trained" if curves else "",
        "unknown": "Limitations",
        "next": "What to do next",
    }
    return render(
        "validation.html",
        title=f"{scene}: validation",
        kicker=f"{_count(len(policies), 'policy', 'policies')}, {_count(len(lights), 'lighting')}: "
        f"{sum(c['trials'] for c in cells)} episodes in the twin.",
        verdicts=verdicts(results),
        headings={name: heading for name, heading in headings.items() if heading},
        files=["summary.json", "cells.csv", "episodes.csv"],
        results=results,
        tasks=[_task(results, task) for task in tasks(results)],
        definitions={name: lighting_text(name) for name in lights}
        | {FAILURES[cause][0]: FAILURES[cause][1] for c in cells for cause in c["causes"]},
        untrusted=[c for c in cells if c["low_trust"]["trials"]],
        maps=[Picture(folder / f"failures_{task}.png", f"{task}, all policies and lights") for task in tasks(results)],
        films=[_video(film, folder) for film in results["films"]],
        films_of=join_names(dict.fromkeys(str(film["of"]) for film in results["films"])),
        training=[_training_chart(results, curve) for curve in curves],
        limitations=limitations(results),
        next_steps=_next_steps(results, folder.parent),
        RECENT_EPISODES=RECENT_EPISODES,
        MAX_P_VALUE=MAX_P_VALUE,
        percent="{:.0%}".format,
        failure_text=failure_text,
        p_value_text=p_value_text,
        pair_text=pair_text,
        rate_text=rate_text,
        training_text=training_text,
    )


def _task(results: dict[str, Any], task: str) -> dict[str, Any]:
    """Cells, pairs and charts of a task."""
    mine, pairs = ([it for it in results[key] if it["task"] == task] for key in ("cells", "pairs"))
    if len({c["lighting"] for c in mine}) <= MAX_PLOTTED_LIGHTINGS:
        rates = Chart("Share of episodes that reached the goal", svg(rate_figure(mine)))
    else:
        least, most = min(c["trials"] for c in mine), max(c["trials"] for c in mine)
        each = f"{least}" if least == most else f"{least} to {most}"
        title = f"Episodes that reached the goal [%], of {each} in each light; the mean is over the common lights"
        trained = {policy: rate["rate"] for policy, rate in results["training"].items()}
        rates = Chart(title, svg(rate_heatmap(mine, trained)))
    title = (
        "Number of episodes in which only the row’s policy reached the goal, minus those of the column’s: blue is "
        "better, red is worse, pale is within chance"
    )
    return {
        "name": task,
        "cells": mine,
        "by_policy": {c["policy"]: [it for it in mine if it["policy"] == c["policy"]] for c in mine},
        "rates": rates,
        "pairs": pairs,
        "pair_charts": [Chart(title, svg(pair_heatmap(pairs)))] if len(pairs) > MAX_TABLE_ROWS else [],
    }


def _video(film: dict[str, Any], folder: Path) -> dict[str, Any]:
    ended = "reached the goal" if film["cause"] == "goal" else FAILURES[film["cause"]][0]
    return film | {"url": quote(film["file"]), "poster": data_url(folder / film["poster"]), "ended": ended}


def _training_chart(results: dict[str, Any], curve: TrainingCurve) -> Chart:
    saved = [t["step"] for t in results["training"].values() if t["run"] == curve.run]
    return Chart(curve.run, svg(training_figure(curve.steps, curve.success, sorted(saved))))


def _next_steps(results: dict[str, Any], root: Path) -> list[tuple[str, list[str]]]:
    """What to do after a validation: texts with their commands."""
    policies = list(dict.fromkeys((c["policy"], c["task"]) for c in results["cells"]))
    rows = [(policy, task, "LIGHT", "TRIALS", "SUCCESSES") for policy, task in policies[:2]]
    head = ("policy", "task", "lighting", "trials", "successes")
    return [
        (
            f"Drive some of these policies on the road, good and bad ones, on several days: at least {MIN_POLICIES} "
            f"policies, each at least {MIN_TRIALS} times in each light.",
            [],
        ),
        (
            "Write real.csv, with a line for each policy and light: the light’s name, how often you drove, and how "
            "often the goal was reached. If the twin has no light of that name, name the one to compare with in a "
            "further column twin_lighting, such as held-out.",
            [*csv_text(head, rows).splitlines(), *(["…"] if len(policies) > 2 else [])],
        ),
        ("Forecast how all of them do on the road:", [command("forecast", root, "--real", "real.csv")]),
    ]


def _count(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"
