"""Writes `validation.html`: how often policies reach the goal, and why they fail.

`results` is the content of `summary.json`: the result of `twin.evaluation.trials.summarize`, and entries that
`twin.validate` adds. Videos are files beside the page; their posters are embedded in the page.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure

from twin.config import ANY, HELD_OUT, SAMPLED_LIGHTING, TRAINING, Condition
from twin.errors import join_names
from twin.evaluation.agreement import Estimate
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.training_curves import TestCount, plot_tests, range_text
from twin.evaluation.trials import REAL_CSV, Trial, csv_text
from twin.files import write_text
from twin.geometry.polyline import point_at
from twin.mjcf.world import World
from twin.report.figures import (
    FULL_WIDTH,
    INK,
    RATE_AXIS,
    SERIES,
    corridor_outline,
    difference_texts,
    heatmap,
    lighting_labels,
    matrix,
    new_figure,
    percent_texts,
    rate_chart,
    shorten_name,
    styled,
    svg,
)
from twin.report.forecast_text import format_estimate
from twin.report.html import MAX_TABLE_ROWS, Caution, Chart, Picture, Verdict, command, counted, data_url, render
from twin.scene import SceneDir

MAX_P_VALUE = 0.1
"""A paired difference with a larger p-value is reported as not significant."""
FEW_EPISODES = 30
"""A cell (one policy on one task in one lighting) with fewer episodes gets a caution that its interval is wide."""
FAILURES = {
    "collision": ("hit something", "touched anything solid except the ground"),
    "out_of_bounds": ("left the corridor", "the robot’s center was farther from the route than the corridor’s edge"),
    "timeout": ("ran out of time", "did not reach the goal within the time limit"),
    "rollover": ("rolled over", "tipped onto its side"),
    "stuck": ("got stuck", "stood still too long"),
}
"""Cause of failure → its name and meaning."""
LIGHTING_SETS = {
    HELD_OUT: "another lighting for every episode, sampled from those reserved for evaluation",
    TRAINING: "another lighting for every episode, sampled from those used in training",
    ANY: "another lighting for every episode, sampled from all plausible lightings",
}
"""Name of a set of lightings → its meaning."""

_GOOD_RATE, _MIXED_RATE = 0.9, 0.5

# ---- words


def rate_text(rate: dict[str, Any]) -> str:
    """Formats a rate as "93% (87% to 96%)", or as a dash if there are no trials."""
    return format_estimate(Estimate(rate["rate"], rate["low"], rate["high"], rate["trials"]), percent=True)


def failure_text(cell: dict[str, Any]) -> str:
    """Formats the causes of failure, most frequent first, for instance "9 left the corridor, 2 hit something"."""
    causes = sorted(cell["causes"].items(), key=lambda item: -item[1])
    return ", ".join(f"{n} {FAILURES[cause][0]}" for cause, n in causes)


def lighting_text(lighting: str) -> str:
    condition = Condition.parse(lighting)
    if condition.randomised:
        return (
            f"{lighting_text(condition.lighting)}. Each episode also has its own sun, shadows, "
            "distractor objects, and values of the robot parameters that were not identified; the fog varies too, "
            "unless the lighting was fitted to a photo, which then determines the fog"
        )
    if lighting.startswith(SAMPLED_LIGHTING):
        return f"lighting number {lighting.removeprefix(SAMPLED_LIGHTING)} of those sampled in the search"
    if lighting.count(":") == 2:
        a, b, part = lighting.split(":")
        return f"{float(part):.0%} of the way from {a} to {b}"
    return LIGHTING_SETS.get(lighting, "the same lighting in every episode")


def training_text(trained: dict[str, Any]) -> str:
    """Describes a training and the test that measured its result; see `training_summaries`."""
    test = trained["test"]
    episodes = f"{'final test' if test['final'] else 'test during the training'}, n = {test['trials']}" + (
        f", lighting {test['condition']}" if test["condition"] else ""
    )
    light = "in varying lighting" if trained["lighting"] in (TRAINING, ANY) else f"in lighting {trained['lighting']}"
    light = "from MuJoCo’s pictures of the mesh" if trained["observe"] == "simulator" else light
    return f"{episodes}; trained on {trained['task']}, {light}, for {trained['step']:,} steps"


def pair_text(pair: dict[str, Any]) -> str:
    if pair["only_a"] == pair["only_b"]:
        return "no difference"
    if pair["p"] > MAX_P_VALUE:
        return "not significant"
    return f"“{pair['a'] if pair['only_a'] > pair['only_b'] else pair['b']}” is better"


def p_value_text(p: float) -> str:
    return "<0.1%" if p < 0.001 else f"{100 * p:.1f}%" if p < MAX_P_VALUE else f"{p:.0%}"


def verdicts(results: dict[str, Any]) -> list[Verdict]:
    """The headlines: each task's best policy and its worst lighting, and the number of episodes with low trust."""
    out = []
    for task in tasks(results):
        cells, pairs = ([one for one in results[key] if one["task"] == task] for key in ("cells", "pairs"))
        out.append(_task_verdict(task, cells, pairs))
    low, of = (sum(c[k]["trials"] for c in results["cells"]) for k in ("low_trust", "trusted"))
    if low:
        text = f"In {low} of {low + of} episodes the pictures have low trust; these are counted separately below."
        out.append(Verdict(text, "mixed"))
    return out


def _task_verdict(task: str, cells: list[dict[str, Any]], pairs: list[dict[str, Any]]) -> Verdict:
    lightings: dict[str, set[str]] = {}
    for c in cells:
        lightings.setdefault(c["policy"], set()).add(c["lighting"])
    # Policies are compared only in the lightings that all of them drove in.
    common = set.intersection(*lightings.values())
    if not common:
        return Verdict(f"On {task} no lighting was used for all policies, so the best policy is not known.", "mixed")
    shared = {policy: [c for c in cells if c["policy"] == policy and c["lighting"] in common] for policy in lightings}
    means = {
        policy: sum(Fraction(c["successes"], c["trials"]) for c in mine) / len(common)
        for policy, mine in shared.items()
    }
    best = max(means, key=lambda policy: means[policy])
    won, of = (sum(c[key] for c in shared[best]) for key in ("successes", "trials"))
    tied = [policy for policy in means if means[policy] == means[best] and policy != best]
    lead = " most often" if len(means) > 1 and not tied else ""
    pooled = Fraction(won, of) == means[best]
    alike = f"in {float(means[best]):.0%} of episodes, if every lighting has the same weight"
    count = f"in {won} of {of} episodes" if pooled else alike
    text = f"On {task}, “{best}” reaches the goal{lead}: {count}"
    every = dict.fromkeys(c["lighting"] for c in cells)
    if len(common) < len(every):
        names = join_names(name for name in every if name in common)
        text += f" in the lightings that were used for all policies ({names})"
    text += f", and {join_names(f'“{name}”' for name in tied)} as often" if tied else ""
    of_best = [p for p in pairs if best in (p["a"], p["b"]) and pair_text(p) != f"“{best}” is better"]
    unclear = [p["b"] if p["a"] == best else p["a"] for p in of_best]
    if lead and unclear:
        text += f", which is not significantly more often than {join_names(f'“{name}”' for name in unclear)}"
    weakest = min(shared[best], key=lambda c: c["rate"])
    if weakest["rate"] < max(c["rate"] for c in shared[best]):
        text += f"; least often in lighting {weakest['lighting']}, {weakest['successes']} of {weakest['trials']}"
    mood = "good" if means[best] >= _GOOD_RATE else "mixed" if means[best] >= _MIXED_RATE else "bad"
    return Verdict(f"{text}.", mood)


def limitations(results: dict[str, Any]) -> list[Caution]:
    """Limits of the validation, with cures."""
    cells = results["cells"]
    what = "These are success rates in the twin. Success on the road was not measured here."
    out = [Caution(what, "drive some of the policies on the road and run twin forecast.")]
    if few := [c["trials"] for c in cells if c["trials"] < FEW_EPISODES]:
        what = (
            f"{len(few)} of {len(cells)} rates come from fewer than {FEW_EPISODES} episodes (minimum: {min(few)}), so "
            "their intervals are wide."
        )
        out.append(Caution(what, "run the same command with more --episodes; earlier episodes are kept."))
    drawn = dict.fromkeys(c["lighting"] for c in cells if Condition.parse(c["lighting"]).randomised)
    if drawn and not results.get("robot_known"):
        what = (
            f"The result may differ for your robot: under {join_names(drawn)} the robot's parameters are random in "
            "each episode, because those of your robot have not been identified."
        )
        cure = "log ten minutes of driving, run twin align, build again and validate again."
        out.append(Caution(what, cure))
    searched = {(w["policy"], w["task"]) for w in results.get("worst", [])}
    if left := dict.fromkeys(c["policy"] for c in cells if (c["policy"], c["task"]) not in searched):
        what = f"The worst lighting for {join_names(left)} is not known: no search was made."
        out.append(Caution(what, "run the same command with --worst."))
    return out


def tasks(results: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(c["task"] for c in results["cells"]))


def summary_lines(results: dict[str, Any]) -> list[str]:
    """Lines of the printed summary."""
    out = []
    wide, light = (max((len(c[key]) for c in results["cells"]), default=0) for key in ("policy", "lighting"))
    for c in results["cells"]:
        row = (
            f"{c['policy']:{wide}}  {c['task']}  {c['lighting']:{light}}  {c['successes']:3d}/{c['trials']:<3d} = "
            f"{c['rate']:.2f} ({c['low']:.2f} to {c['high']:.2f})  {failure_text(c)}"
        )
        out.append(row.rstrip())
        if c["low_trust"]["trials"]:
            counts = [f"{rate['successes']}/{rate['trials']}" for rate in (c["trusted"], c["low_trust"])]
            out.append(f"{'':{wide}}  with trusted pictures {counts[0]}, with others {counts[1]}")
    for p in results["pairs"]:
        out.append(
            f"{p['a']} against {p['b']}, {p['task']}, the same {p['episodes']} episodes: only the first succeeded in "
            f"{p['only_a']}, only the second in {p['only_b']} (p = {p['p']:.2g})"
        )
    for w in results.get("worst", []):
        out.append(
            f"{w['policy']}, {w['task']}: the worst of {w['of']} sampled lightings is {w['lighting']}; success in new "
            f"episodes there: {w['successes']}/{w['trials']} ({w['low']:.2f} to {w['high']:.2f})"
        )
    return out


# ---- figures

MAX_PLOTTED_LIGHTINGS = 4
"""Up to this number of lightings, rates are plotted with intervals; with more, they are shown as a heatmap."""

_BIN = 2.0  # [m] width of the failure histogram's bins along the route
_FAILURE_LOOKS = {  # cause → color and hatching
    "collision": ("#d62728", ""),
    "out_of_bounds": ("#ff7f0e", "//"),
    "timeout": ("#7f7f7f", ".."),
    "rollover": ("#9467bd", "xx"),
    "stuck": ("#8c564b", "--"),
}


def rate_figure(cells: Sequence[dict[str, Any]]) -> Figure:
    """Success rates on a task, with intervals: one row per policy, one color per lighting."""
    rates: dict[str, list[tuple[str, float, float, float]]] = {}
    for c in cells:
        rates.setdefault(c["lighting"], []).append((c["policy"], c["rate"], c["low"], c["high"]))
    label = "success rate" if len(rates) > 1 else f"success rate in lighting {next(iter(rates))}"
    return rate_chart(list(dict.fromkeys(c["policy"] for c in cells)), rates, label)


def rate_heatmap(cells: Sequence[dict[str, Any]], trained: Mapping[str, float | None]) -> Figure:
    """Success rates on a task [%]: one row per policy, one column per lighting.

    The first column is the training's result (`trained`), unless none is known. The next is the mean over the lightings
    in which all policies drove.
    """
    policies, lightings = (list(dict.fromkeys(c[key] for c in cells)) for key in ("policy", "lighting"))
    rate = matrix({(c["policy"], c["lighting"]): c["rate"] for c in cells}, policies, lightings)
    common = rate[:, np.isfinite(rate).all(0)]
    means = common.mean(1) if common.size else np.full(len(policies), np.nan)
    training = np.array([trained.get(policy) for policy in policies], float)
    names, label = lighting_labels(lightings)
    shown, columns = np.column_stack([means, rate]), ["mean", *names]
    if np.isfinite(training).any():
        shown, columns = np.column_stack([training, shown]), ["training’s result", *columns]
    return heatmap(shown, list(map(shorten_name, policies)), columns, percent_texts(shown), label, FULL_WIDTH)


def pair_heatmap(pairs: Sequence[dict[str, Any]]) -> Figure:
    """Paired comparisons of a task's policies: the row's policy is better (blue), worse (red), or neither (pale).

    A cell's number is the number of shared episodes in which only the row's policy succeeded, minus the number in which
    only the column's policy did. It is in parentheses if the difference is not significant. Rows and columns are
    sorted by the number of significant wins minus that of significant losses.
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
    texts = difference_texts(ahead, surely)
    return heatmap(surely, rows, numbers, texts, "compared with the policy of this number", FULL_WIDTH)


@styled
def training_figure(tests: Sequence[TestCount], saved: Sequence[int]) -> Figure:
    """Success in a training's tests over its steps, with intervals; dashed lines mark the `saved` steps."""
    figure, axes = new_figure(2.2)
    plot_tests(axes, tests, SERIES[0])
    for one in saved:
        axes.axvline(one, color=INK, lw=0.9, ls="--")
    limits, ticks = RATE_AXIS.values()
    axes.set(xlabel="training step", ylabel="success rate in tests", ylim=limits, yticks=ticks)
    axes.set_xlim(left=0)
    return figure


def failure_map(path: Path, trials: Sequence[Trial], world: World, segment: tuple[float, float]) -> None:
    """Draws the places on the route at which failed episodes of a task ended, and writes the picture to `path`.

    `segment` contains the arc lengths of the task's start and end on the route [m].
    """
    start, end = segment
    line = point_at(world.route[:, :2], np.append(np.arange(start, end, 0.5), end))
    edges = np.arange(0.0, end - start + _BIN, _BIN)
    across, up = np.ptp(line, axis=0) + 2.0 * world.half_width
    tall = float(np.clip(6.4 * up / across, 0.5, 6.0))
    figure = Figure(figsize=(7.2, tall + 4.0), layout="constrained")
    above, along = figure.subplots(2, 1, height_ratios=[tall + 0.6, 2.6])
    above.fill(*corridor_outline(line, world.half_width).T, color="#dfe6ee")
    above.plot(*line.T, color="#7a8794", linewidth=1)
    look: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontsize": 9, "annotation_clip": False}
    for name, at in (("start", line[0]), ("goal", line[-1])):
        above.annotate(name, at, xytext=(0, 10), **look)
    total = np.zeros(len(edges) - 1)
    for cause, (color, hatch) in _FAILURE_LOOKS.items():
        distances = [t.progress for t in trials if t.cause == cause]
        if distances:
            count = np.histogram(np.clip(distances, 0.0, edges[-1]), edges)[0]
            name = f"{FAILURES[cause][0]} ({len(distances)})"
            along.bar(
                edges[:-1], count, _BIN, total, align="edge", edgecolor="white", color=color, hatch=hatch, label=name
            )
            total += count
    at = point_at(line, edges[:-1] + _BIN / 2)[total > 0]
    above.scatter(*at.T, s=30.0 * total[total > 0], color="#c0392b", alpha=0.6, linewidths=0)
    title = f"{total.sum():.0f} of {len(trials)} episodes failed; area of a dot: number of failures there"
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    along.set(xlabel="distance along the task [m]", ylabel="failed episodes", xlim=(0.0, edges[-1]))
    along.yaxis.get_major_locator().set_params(integer=True)
    if total.any():
        figure.legend(frameon=False, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=110)


# ---- page


TrainingCurve = tuple[str, Sequence[TestCount]]
"""A training run, and its tests."""


def write_validation_page(scene: SceneDir, results: dict[str, Any], curves: Sequence[TrainingCurve]) -> None:
    """Writes `validation/validation.html`, atomically."""
    path = scene.validation / "validation.html"
    write_text(path, validation_page(scene.root.resolve().name, path.parent, results, curves))


def validation_page(scene: str, folder: Path, results: dict[str, Any], curves: Sequence[TrainingCurve]) -> str:
    """The HTML of the page of a scene; `folder` contains the maps and videos."""
    cells, curves = results["cells"], [curve for curve in curves if curve[1]]
    policies, lights = (dict.fromkeys(c[key] for c in cells) for key in ("policy", "lighting"))
    headings = {
        "arrive": "How often does each policy reach the goal?",
        "better": "Which policy is better?" if results["pairs"] else "",
        "worst": "The worst lighting" if results["worst"] else "",
        "trust": "Are the pictures reliable?",
        "where": "Where do the policies fail?",
        "films": "Videos",
        "training": "How the policies were trained" if curves else "",
        "unknown": "Limitations",
        "next": "What to do next",
    }
    driven = f"{counted(len(policies), 'policy', 'policies')}, {counted(len(lights), 'lighting')}"
    return render(
        "validation.html",
        title=f"{scene}: validation",
        kicker=f"{driven}: {counted(sum(c['trials'] for c in cells), 'episode')} in the twin.",
        verdicts=verdicts(results),
        headings={name: heading for name, heading in headings.items() if heading},
        files=["summary.json", "cells.csv", "episodes.csv"],
        results=results,
        tasks=[_task(results, task) for task in tasks(results)],
        definitions={name: lighting_text(name) for name in lights}
        | {FAILURES[cause][0]: FAILURES[cause][1] for c in cells for cause in c["causes"]},
        untrusted=[c for c in cells if c["low_trust"]["trials"]],
        maps=[
            Picture(folder / f"failures_{task}.png", f"{task}, all policies and lightings") for task in tasks(results)
        ],
        films=[
            film
            | {"url": quote(film["file"]), "poster": data_url(folder / film["poster"])}
            | {"ended": FAILURES.get(film["cause"], ("reached the goal",))[0]}
            for film in results["films"]
        ],
        films_of=join_names(dict.fromkeys(str(film["of"]) for film in results["films"])),
        training=[_training_chart(results, curve) for curve in curves],
        limitations=limitations(results),
        next_steps=_next_steps(results, folder.parent),
        MAX_P_VALUE=MAX_P_VALUE,
        percent="{:.0%}".format,
        failure_text=failure_text,
        p_value_text=p_value_text,
        pair_text=pair_text,
        rate_text=rate_text,
        training_text=training_text,
    )


def _task(results: dict[str, Any], task: str) -> dict[str, Any]:
    """A task's cells, pairs and charts, for the page's template."""
    mine, pairs = ([it for it in results[key] if it["task"] == task] for key in ("cells", "pairs"))
    least, most = min(c["trials"] for c in mine), max(c["trials"] for c in mine)
    each = f"n = {least} per lighting" if least == most else f"n = {least} to {most} per lighting"
    if len({c["lighting"] for c in mine}) <= MAX_PLOTTED_LIGHTINGS:
        title, figure = f"Share of episodes that reached the goal, with 90% intervals ({each})", rate_figure(mine)
    else:
        # A rate on another task says nothing about overfitting.
        known = {policy: row for policy, row in results["training"].items() if row["task"] == task and row["test"]}
        trained = {policy: row["test"]["rate"] for policy, row in known.items()}
        title = f"Episodes that reached the goal [%] ({each}); means: lightings that all policies drove in"
        figure = rate_heatmap(mine, trained)
    pair_title = (
        "Number of episodes in which only the row’s policy reached the goal, minus the number in which only the "
        "column’s did. Blue, +: the row’s policy is better; red, −: worse; pale, in parentheses: not significant"
    )
    return {
        "name": task,
        "cells": mine,
        "by_policy": {c["policy"]: [it for it in mine if it["policy"] == c["policy"]] for c in mine},
        "rates": Chart(title, svg(figure)),
        "pairs": pairs,
        "pair_charts": [Chart(pair_title, svg(pair_heatmap(pairs)))] if len(pairs) > MAX_TABLE_ROWS else [],
    }


def _training_chart(results: dict[str, Any], curve: TrainingCurve) -> Chart:
    run, tests = curve
    saved = sorted(t["step"] for t in results["training"].values() if t["run"] == run)
    return Chart(
        f"{run} ({range_text(trials for *_, trials in tests)} episodes per test)", svg(training_figure(tests, saved))
    )


def _next_steps(results: dict[str, Any], root: Path) -> list[tuple[str, list[str]]]:
    """Next steps after a validation: texts with their commands."""
    policies = list(dict.fromkeys((c["policy"], c["task"]) for c in results["cells"]))
    rows = [(policy, task, "LIGHTING", "TRIALS", "SUCCESSES") for policy, task in policies[:2]]
    table = csv_text(("policy", "task", "lighting", "trials", "successes"), rows).splitlines()
    return [
        (
            f"Drive some of these policies on the road, good and bad ones, on several days: at least {MIN_POLICIES} "
            f"policies, each at least {MIN_TRIALS} times in each lighting.",
            [],
        ),
        (
            "Write real.csv, with a line for each policy and lighting: its name, how often you drove, and how often "
            "the goal was reached. If the twin has no lighting of that name, add a column twin_lighting with the "
            "twin’s lighting to compare with, for instance held-out.",
            [*table, *(["…"] if len(policies) > 2 else [])],
        ),
        (
            "Forecast how often each policy reaches the goal on the road:",
            [command("forecast", root, "--real", root / REAL_CSV)],
        ),
    ]
