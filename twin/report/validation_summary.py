"""Summary of a validation: success per policy and lighting, causes of failure, and paired comparisons of policies.

`results` is the content of `summary.json` (see `summarize` and `twin.validate`). Paired episodes share lighting and
seed; the exact McNemar test compares the numbers of episodes in which only one of two policies succeeded.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from twin.config import ANY, HELD_OUT, TRAINING, Condition
from twin.errors import join_names
from twin.evaluation.forecasting import Estimate
from twin.evaluation.statistics import rate_summary
from twin.evaluation.trials import CAUSES, Trial, tally
from twin.mjcf.world import World, point_at
from twin.report.figures import corridor_outline
from twin.report.forecast_summary import format_estimate
from twin.report.html import Caution, Verdict

MAX_P_VALUE = 0.1
"""Paired differences with a larger p-value are reported as within chance."""
FEW_EPISODES = 30
"""Number of episodes in a cell below which a caution about wide intervals is given."""
FAILURES = {
    "collision": ("hit something", "touched anything solid except the ground"),
    "out_of_bounds": ("left the corridor", "its center was more than half the corridor’s width off the route"),
    "timeout": ("ran out of time", "did not reach the goal within the time limit"),
    "rollover": ("rolled over", "tipped onto its side"),
    "stuck": ("got stuck", "stood still too long"),
}
"""Cause of failure → its name and meaning."""
LIGHTING_SETS = {
    HELD_OUT: "another light for every episode, sampled from those reserved for evaluation",
    TRAINING: "another light for every episode, sampled from those used in training",
    ANY: "another light for every episode, sampled from all that could have been filmed",
}
"""Lightings that are sets → their meaning."""

_GOOD_RATE, _MIXED_RATE = 0.9, 0.5


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
        plain = lighting_text(condition.lighting)
        return (
            f"{plain}; and for every episode another sun, other shadows, haze unless a photo determines it, objects "
            "beside the corridor, and other robot parameters except for the identified ones"
        )
    if lighting.startswith("drawn_"):
        return f"light number {lighting[6:]} of those sampled in the search"
    if lighting.count(":") == 2:
        a, b, part = lighting.split(":")
        return f"{float(part):.0%} of the way from {a} to {b}"
    return LIGHTING_SETS.get(lighting, "the same light in every episode")


def training_text(trained: dict[str, Any]) -> str:
    """Describes a training, for instance "on straight, in varying light"."""
    if trained["observe"] == "simulator":
        return f"on {trained['task']}, from MuJoCo’s picture of the mesh"
    light = "in varying light" if trained["lighting"] in (TRAINING, ANY) else f"in the light {trained['lighting']}"
    return f"on {trained['task']}, {light}"


def verdicts(results: dict[str, Any]) -> list[Verdict]:
    """The headlines: the best policy of every task and its worst lighting."""
    out = []
    for task in tasks(results):
        by_policy: dict[str, list[dict[str, Any]]] = {}
        for cell in results["cells"]:
            if cell["task"] == task:
                by_policy.setdefault(cell["policy"], []).append(cell)
        # Only lightings in which all policies drove compare them fairly.
        common = set.intersection(*({c["lighting"] for c in cells} for cells in by_policy.values()))
        if not common:
            out.append(Verdict(f"On {task} no lighting was used for all policies: there is no best one.", "mixed"))
            continue
        means = {
            policy: sum(c["rate"] for c in cells if c["lighting"] in common) / len(common)
            for policy, cells in by_policy.items()
        }
        best = max(means, key=lambda policy: means[policy])
        cells = [c for c in by_policy[best] if c["lighting"] in common]
        won, of = sum(c["successes"] for c in cells), sum(c["trials"] for c in cells)
        tied = [policy for policy in means if means[policy] == means[best] and policy != best]
        lead = " most often" if len(by_policy) > 1 and not tied else ""
        text = f"On {task}, {best} reaches the goal{lead}: in {won} of {of} episodes"
        every = dict.fromkeys(c["lighting"] for c in results["cells"] if c["task"] == task)
        if len(common) < len(every):
            text += (
                f" in the light that was used for all policies ({join_names(name for name in every if name in common)})"
            )
        text += f", and so does {join_names(tied)} as often" if tied else ""
        weakest = min(cells, key=lambda c: c["rate"])
        if weakest["rate"] < max(c["rate"] for c in cells):
            text += f"; least often in the light {weakest['lighting']}, {weakest['successes']} of {weakest['trials']}"
        mood = "good" if means[best] >= _GOOD_RATE else "mixed" if means[best] >= _MIXED_RATE else "bad"
        out.append(Verdict(f"{text}.", mood))
    low, of = (sum(c[k]["trials"] for c in results["cells"]) for k in ("low_trust", "trusted"))
    if low:
        text = f"In {low} of {low + of} episodes the pictures are not trusted; these are counted separately below."
        out.append(Verdict(text, "mixed"))
    return out


def pair_text(pair: dict[str, Any]) -> str:
    if pair["only_a"] == pair["only_b"]:
        return "no difference"
    return (
        "within chance"
        if pair["p"] > MAX_P_VALUE
        else f"{'first' if pair['only_a'] > pair['only_b'] else 'second'} is better"
    )


def p_value_text(p: float) -> str:
    return "<0.1%" if p < 0.001 else f"{100 * p:.1f}%" if p < MAX_P_VALUE else f"{p:.0%}"


def limitations(results: dict[str, Any]) -> list[Caution]:
    """Limits of the validation, with cures."""
    out = [
        Caution(
            "These rates are success in the twin. Success on the road was not measured here.",
            "drive some of the policies on the road and run python -m twin.forecast.",
        )
    ]
    few = [c for c in results["cells"] if c["trials"] < FEW_EPISODES]
    if few:
        smallest = min(c["trials"] for c in few)
        out.append(
            Caution(
                f"{len(few)} of {len(results['cells'])} rates come from fewer than {FEW_EPISODES} episodes (minimum: "
                f"{smallest}), so their intervals are wide.",
                "run the same command with more --episodes; earlier episodes are kept.",
            )
        )
    drawn = dict.fromkeys(c["lighting"] for c in results["cells"] if Condition.parse(c["lighting"]).randomised)
    if drawn and not results.get("robot_known"):
        out.append(
            Caution(
                f"The result may differ for your robot: under {join_names(drawn)} another one drives every episode, "
                "because none of its parameters are identified.",
                "log five minutes of driving, run python -m twin.align, build again and validate again.",
            )
        )
    searched = {(w["policy"], w["task"]) for w in results.get("worst", [])}
    left = dict.fromkeys(c["policy"] for c in results["cells"] if (c["policy"], c["task"]) not in searched)
    if left:
        out.append(
            Caution(
                f"The worst light that {join_names(left)} might meet was not searched for.",
                "run the same command with --worst.",
            )
        )
    return out


def tasks(results: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(c["task"] for c in results["cells"]))


matplotlib.use("Agg")

TRUSTED = 0.8
"""Episodes with a lower mean trust of their pictures are counted separately."""

_BIN = 2.0  # [m] bin of the route in the failure histogram
_COLORS = dict(zip(CAUSES[1:], ("#d62728", "#ff7f0e", "#7f7f7f", "#9467bd", "#8c564b"), strict=True))


def success_rate(trials: Sequence[Trial]) -> dict[str, Any]:
    return rate_summary(sum(t.success for t in trials), len(trials))


def summarize(trials: Sequence[Trial]) -> dict[str, Any]:
    cells = []
    for cell in tally(trials):
        own = [t for t in trials if (t.policy, t.task, t.lighting) == cell.key]
        trusted = [t for t in own if t.trust is not None and t.trust >= TRUSTED]
        cells.append(
            {"policy": cell.policy, "task": cell.task, "lighting": cell.lighting}
            | success_rate(own)
            | {"causes": {c: n for c, n in Counter(t.cause for t in own).items() if c != "goal"}}
            | {"trusted": success_rate(trusted), "low_trust": success_rate([t for t in own if t not in trusted])}
        )
    return {"confidence": 0.9, "trusted_from": TRUSTED, "cells": cells, "pairs": compare_pairs(trials)}


def compare_pairs(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Compares every two policies on the episodes that both drove, if there are any."""
    by_policy: dict[tuple[str, str], dict[tuple[str, int], bool]] = {}
    for t in trials:
        by_policy.setdefault((t.task, t.policy), {})[t.lighting, t.seed] = t.success
    out = []
    for (task, a), (other, b) in combinations(by_policy, 2):
        if task != other:
            continue
        first, second = by_policy[task, a], by_policy[task, b]
        both = [(first[key], second[key]) for key in first if key in second]
        if not both:
            continue
        only_a, only_b = sum(x and not y for x, y in both), sum(y and not x for x, y in both)
        chance = float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
        out.append(
            {"task": task, "a": a, "b": b, "episodes": len(both), "only_a": only_a, "only_b": only_b, "p": chance}
        )
    return out


def typical_episode(trials: Sequence[Trial]) -> Trial:
    """The episode with the median progress; the upper one of an even number."""
    return sorted(trials, key=lambda t: t.progress)[len(trials) // 2]


def worst_episode(trials: Sequence[Trial]) -> Trial:
    """The failed episode with the least progress; if none failed, the one with the lowest trust."""
    failed = [t for t in trials if not t.success]
    if failed:
        return min(failed, key=lambda t: t.progress)
    return min(trials, key=lambda t: 1.0 if t.trust is None else t.trust)


def summary_lines(results: dict[str, Any]) -> list[str]:
    out = []
    wide = max((len(c["policy"]) for c in results["cells"]), default=0)
    light = max((len(c["lighting"]) for c in results["cells"]), default=0)
    for c in results["cells"]:
        causes = failure_text(c)
        out.append(
            f"{c['policy']:{wide}}  {c['task']}  {c['lighting']:{light}}  {c['successes']:3d}/{c['trials']:<3d} = "
            f"{c['rate']:.2f} ({c['low']:.2f} to {c['high']:.2f})" + (f"  {causes}" if causes else "")
        )
        low = c["low_trust"]
        if low["trials"]:
            t = c["trusted"]
            out.append(
                f"{'':{wide}}  trusted pictures {t['successes']}/{t['trials']}, "
                f"others {low['successes']}/{low['trials']}"
            )
    for p in results["pairs"]:
        out.append(
            f"{p['a']} against {p['b']}, {p['task']}, the same {p['episodes']} episodes: only the first succeeded in "
            f"{p['only_a']}, only the second in {p['only_b']} (p = {p['p']:.2g})"
        )
    for w in results.get("worst", []):
        out.append(
            f"{w['policy']}, {w['task']}: of {w['of']} sampled lights the worst is {w['lighting']}, in new "
            f"episodes {w['successes']}/{w['trials']} ({w['low']:.2f} to {w['high']:.2f})"
        )
    return out


def failure_map(path: Path, trials: Sequence[Trial], world: World, segment: tuple[float, float]) -> None:
    """Plots where on the route the failed episodes of a task ended; `segment` is the task on the route [m]."""
    start, end = segment
    line = point_at(world.route[:, :2], np.append(np.arange(start, end, 0.5), end))
    edges = np.arange(0.0, end - start + _BIN, _BIN)
    failed = {cause: [t.progress for t in trials if t.cause == cause] for cause in CAUSES[1:]}
    across, up = np.ptp(line, axis=0) + 2.0 * world.half_width
    tall = float(np.clip(6.4 * up / across, 0.5, 6.0))
    figure, (above, along) = plt.subplots(
        2, 1, figsize=(7.2, tall + 3.6), layout="constrained", height_ratios=[tall + 0.6, 2.6]
    )
    above.fill(*corridor_outline(line, world.half_width).T, color="#dfe6ee", label="corridor")
    above.plot(*line.T, color="#7a8794", linewidth=1)
    for name, at in (("start", line[0]), ("goal", line[-1])):
        above.annotate(
            name, at, xytext=(0, 10), textcoords="offset points", ha="center", fontsize=9, annotation_clip=False
        )
    before: NDArray = np.zeros(len(edges) - 1)
    for cause, distances in failed.items():
        if not distances:
            continue
        count = np.histogram(np.clip(distances, 0.0, edges[-1]), edges)[0]
        at = point_at(line, edges[:-1] + _BIN / 2)
        above.scatter(*at[count > 0].T, s=30.0 * count[count > 0], color=_COLORS[cause], alpha=0.6, linewidths=0)
        along.bar(
            edges[:-1],
            count,
            _BIN,
            before,
            align="edge",
            edgecolor="white",
            color=_COLORS[cause],
            label=f"{FAILURES[cause][0]} ({len(distances)})",
        )
        before = before + count
    failures = sum(len(distances) for distances in failed.values())
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{failures} of {len(trials)} episodes failed")
    along.set(xlabel="distance along the task [m]", ylabel="failed episodes", xlim=(0.0, edges[-1]))
    along.yaxis.get_major_locator().set_params(integer=True)
    if failures:
        along.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
