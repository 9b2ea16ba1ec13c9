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
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from twin.mjcf.world import World, point_at
from twin.report.figures import corridor_outline
from twin.report.statistics import wilson
from twin.report.trials import CAUSES, Trial, tally
from twin.report.validation_words import FAILURES, why

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TRUSTED = 0.8
"""Episodes whose pictures have less trust than this on average are counted apart."""

_BIN = 2.0  # [m] of the route, within which failures are counted together
_COLORS = dict(zip(CAUSES[1:], ("#d62728", "#ff7f0e", "#7f7f7f", "#9467bd", "#8c564b"), strict=True))


def share(won: int, trials: int) -> dict[str, Any]:
    """Successes, trials, rate and its interval, JSON-able; the rate is None without trials."""
    if not trials:
        return {"successes": 0, "trials": 0, "rate": None, "low": 0.0, "high": 1.0}
    low, high = wilson(won, trials)
    return {"successes": won, "trials": trials, "rate": won / trials, "low": float(low), "high": float(high)}


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
