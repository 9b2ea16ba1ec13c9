"""What a validation says: success per policy and lighting, why and where episodes failed, and who beats whom.

*Paired* episodes are those of one lighting and seed that two policies both drove; only where one succeeded and the
other failed do they differ, and whether the one does so more often than the other is a fair coin's question: the exact
McNemar test.
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

from twin.config import ANY, HELD_OUT, RANDOMISED, TRAINING
from twin.errors import listing
from twin.evaluation.forecasting import Estimate
from twin.evaluation.statistics import share
from twin.evaluation.trials import CAUSES, Trial, tally
from twin.mjcf.world import World, point_at
from twin.report.figures import corridor_outline
from twin.report.forecast_summary import show
from twin.report.html import Caution, Verdict

# ---- What a validation says in words: why episodes failed, who is better, what the numbers cannot tell. No HTML here.
#
# `said` is what `summary.json` holds, see `validation.summary` and `twin.validate`.


LUCK = 0.1
"""A paired difference that luck alone would bring more often than this is called within chance."""
FEW = 30
"""Episodes in a cell below which the intervals are called wide."""
FAILURES = {
    "collision": ("hit something", "touched anything solid but the ground"),
    "out_of_bounds": ("left the corridor", "its middle was more than half the corridor’s width off the route"),
    "timeout": ("ran out of time", "drove on without arriving within the time limit"),
    "rollover": ("rolled over", "tipped onto its side"),
    "stuck": ("got stuck", "stood still too long"),
}
"""Cause of failure → what it is called, and what it means."""
LIGHTS = {
    HELD_OUT: "another light for every episode, drawn from those that no training may show",
    TRAINING: "another light for every episode, drawn from those that trainings show",
    ANY: "another light for every episode, any that could have been filmed",
}
"""Lightings that are sets, explained."""

_GOOD, _MIXED = 0.9, 0.5


def percent(rate: dict[str, Any]) -> str:
    """ "93% (87% to 96%)", or a dash where there was nothing to count."""
    return show(Estimate(rate["rate"], rate["low"], rate["high"], rate["trials"]), percent=True)


def why(cell: dict[str, Any]) -> str:
    """ "9 left the corridor, 2 hit something", most first; empty where none failed."""
    causes = sorted(cell["causes"].items(), key=lambda item: -item[1])
    return ", ".join(f"{n} {FAILURES[cause][0]}" for cause, n in causes)


def light_words(lighting: str) -> str:
    """What a lighting of the tables is."""
    if lighting.endswith(RANDOMISED):
        plain = light_words(lighting.removesuffix(RANDOMISED))
        return (
            f"{plain}; and for every episode another sun, other shadows, haze unless a photo told the air, things "
            "beside the corridor, and another robot but for what is known of yours"
        )
    if lighting.startswith("drawn_"):
        return f"light number {lighting[6:]} of those drawn in the search"
    if lighting.count(":") == 2:
        a, b, part = lighting.split(":")
        return f"{float(part):.0%} of the way from {a} to {b}"
    return LIGHTS.get(lighting, "this one light in every episode")


def trained_words(trained: dict[str, Any]) -> str:
    """What a training was: "on straight, in varying light"."""
    if trained["observe"] == "simulator":
        return f"on {trained['task']}, from MuJoCo’s picture of the mesh"
    light = "in varying light" if trained["lighting"] in (TRAINING, ANY) else f"in the light {trained['lighting']}"
    return f"on {trained['task']}, {light}"


def verdicts(said: dict[str, Any]) -> list[Verdict]:
    """The headlines: for every task who arrives most often and where it fares worst."""
    out = []
    for task in tasks(said):
        by_policy: dict[str, list[dict[str, Any]]] = {}
        for cell in said["cells"]:
            if cell["task"] == task:
                by_policy.setdefault(cell["policy"], []).append(cell)
        # Only lightings that all have driven in compare them fairly.
        common = set.intersection(*({c["lighting"] for c in cells} for cells in by_policy.values()))
        if not common:
            out.append(Verdict(f"On {task} no lighting was driven in by all policies: there is no best one.", "mixed"))
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
        every = dict.fromkeys(c["lighting"] for c in said["cells"] if c["task"] == task)
        if len(common) < len(every):
            text += f" in the light that all have driven in ({listing(name for name in every if name in common)})"
        text += f", and so does {listing(tied)} as often" if tied else ""
        weakest = min(cells, key=lambda c: c["rate"])
        if weakest["rate"] < max(c["rate"] for c in cells):
            text += f"; least often in the light {weakest['lighting']}, {weakest['successes']} of {weakest['trials']}"
        mood = "good" if means[best] >= _GOOD else "mixed" if means[best] >= _MIXED else "bad"
        out.append(Verdict(f"{text}.", mood))
    low, of = (sum(c[k]["trials"] for c in said["cells"]) for k in ("low_trust", "trusted"))
    if low:
        text = f"In {low} of {low + of} episodes the pictures are not to be trusted; they are counted apart below."
        out.append(Verdict(text, "mixed"))
    return out


def pair_words(pair: dict[str, Any]) -> str:
    """Whether a paired difference is more than luck."""
    if pair["only_a"] == pair["only_b"]:
        return "no difference"
    return (
        "within chance" if pair["p"] > LUCK else f"{'first' if pair['only_a'] > pair['only_b'] else 'second'} is better"
    )


def chance_words(p: float) -> str:
    """How often luck alone would do it."""
    return "<0.1%" if p < 0.001 else f"{100 * p:.1f}%" if p < LUCK else f"{p:.0%}"


def unknowns(said: dict[str, Any]) -> list[Caution]:
    """What the numbers cannot tell, and what would."""
    out = [
        Caution(
            "Success here is success in the twin. How often it means success on the road is another question.",
            "drive some of the policies on the road and run python -m twin.forecast.",
        )
    ]
    few = [c for c in said["cells"] if c["trials"] < FEW]
    if few:
        smallest = min(c["trials"] for c in few)
        out.append(
            Caution(
                f"{len(few)} of {len(said['cells'])} rates come from fewer than {FEW} episodes (the least: "
                f"{smallest}), so their intervals are wide.",
                "run the same command with more --episodes; what was driven is kept.",
            )
        )
    drawn = dict.fromkeys(c["lighting"] for c in said["cells"] if c["lighting"].endswith(RANDOMISED))
    if drawn and not said.get("robot_known"):
        out.append(
            Caution(
                f"What your robot does: under {listing(drawn)} another one drives every episode, for nothing is known "
                "of yours.",
                "log five minutes of driving, run python -m twin.align, build again and validate anew.",
            )
        )
    searched = {(w["policy"], w["task"]) for w in said.get("worst", [])}
    left = dict.fromkeys(c["policy"] for c in said["cells"] if (c["policy"], c["task"]) not in searched)
    if left:
        out.append(
            Caution(
                f"The worst light that {listing(left)} might meet was not searched for.",
                "run the same command with --worst.",
            )
        )
    return out


def tasks(said: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(c["task"] for c in said["cells"]))


matplotlib.use("Agg")

TRUSTED = 0.8
"""Episodes whose pictures have less trust than this on average are counted apart."""

_BIN = 2.0  # [m] of the route, within which failures are counted together
_COLORS = dict(zip(CAUSES[1:], ("#d62728", "#ff7f0e", "#7f7f7f", "#9467bd", "#8c564b"), strict=True))


def rate(trials: Sequence[Trial]) -> dict[str, Any]:
    """`share` of trials."""
    return share(sum(t.success for t in trials), len(trials))


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """All that is said of trials, JSON-able."""
    cells = []
    for cell in tally(trials):
        mine = [t for t in trials if (t.policy, t.task, t.lighting) == cell.key]
        trusted = [t for t in mine if t.trust is not None and t.trust >= TRUSTED]
        cells.append(
            {"policy": cell.policy, "task": cell.task, "lighting": cell.lighting}
            | rate(mine)
            | {"causes": {c: n for c, n in Counter(t.cause for t in mine).items() if c != "goal"}}
            | {"trusted": rate(trusted), "low_trust": rate([t for t in mine if t not in trusted])}
        )
    return {"confidence": 0.9, "trusted_from": TRUSTED, "cells": cells, "pairs": pairs(trials)}


def pairs(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Every two policies on the episodes that both drove, if there are any."""
    by_policy: dict[tuple[str, str], dict[tuple[str, int], bool]] = {}
    for t in trials:
        by_policy.setdefault((t.task, t.policy), {})[t.lighting, t.seed] = t.success
    out = []
    for (task, a), (other, b) in combinations(by_policy, 2):
        if task != other:
            continue
        mine, theirs = by_policy[task, a], by_policy[task, b]
        both = [(mine[key], theirs[key]) for key in mine if key in theirs]
        if not both:
            continue
        only_a, only_b = sum(x and not y for x, y in both), sum(y and not x for x, y in both)
        chance = float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
        out.append(
            {"task": task, "a": a, "b": b, "episodes": len(both), "only_a": only_a, "only_b": only_b, "p": chance}
        )
    return out


def typical_episode(trials: Sequence[Trial]) -> Trial:
    """The episode whose way driven is the median; of an even number, the further one of the two in the middle."""
    return sorted(trials, key=lambda t: t.progress)[len(trials) // 2]


def worst_episode(trials: Sequence[Trial]) -> Trial:
    """The failed episode that got least far; where none failed, the one whose pictures are trusted least."""
    failed = [t for t in trials if not t.success]
    if failed:
        return min(failed, key=lambda t: t.progress)
    return min(trials, key=lambda t: 1.0 if t.trust is None else t.trust)


def lines(said: dict[str, Any]) -> list[str]:
    """The summary as a table for a terminal."""
    out = []
    wide = max((len(c["policy"]) for c in said["cells"]), default=0)
    light = max((len(c["lighting"]) for c in said["cells"]), default=0)
    for c in said["cells"]:
        causes = why(c)
        out.append(
            f"{c['policy']:{wide}}  {c['task']}  {c['lighting']:{light}}  {c['successes']:3d}/{c['trials']:<3d} = "
            f"{c['rate']:.2f} ({c['low']:.2f} to {c['high']:.2f})" + (f"  {causes}" if causes else "")
        )
        low = c["low_trust"]
        if low["trials"]:
            t = c["trusted"]
            out.append(
                f"{'':{wide}}  where the pictures are trusted {t['successes']}/{t['trials']}, "
                f"elsewhere {low['successes']}/{low['trials']}"
            )
    for p in said["pairs"]:
        out.append(
            f"{p['a']} against {p['b']}, {p['task']}, the same {p['episodes']} episodes: only the first succeeded in "
            f"{p['only_a']}, only the second in {p['only_b']} (p = {p['p']:.2g})"
        )
    for w in said.get("worst", []):
        out.append(
            f"{w['policy']}, {w['task']}: of {w['of']} lights drawn it fares worst in {w['lighting']}, in fresh "
            f"episodes {w['successes']}/{w['trials']} ({w['low']:.2f} to {w['high']:.2f})"
        )
    return out


def failure_map(path: Path, trials: Sequence[Trial], world: World, stretch: tuple[float, float]) -> None:
    """Draws where on the route episodes ended that failed.

    Args:
        path: The PNG.
        trials: Of one task.
        world: Route and corridor.
        stretch: Start and end of the task on the route [m].
    """
    start, end = stretch
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
    for cause, ways in failed.items():
        if not ways:
            continue
        count = np.histogram(np.clip(ways, 0.0, edges[-1]), edges)[0]
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
            label=f"{FAILURES[cause][0]} ({len(ways)})",
        )
        before = before + count
    lost = sum(len(ways) for ways in failed.values())
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{lost} of {len(trials)} episodes failed")
    along.set(xlabel="way along the task [m]", ylabel="failed episodes", xlim=(0.0, edges[-1]))
    along.yaxis.get_major_locator().set_params(integer=True)
    if lost:
        along.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
