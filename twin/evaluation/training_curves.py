"""Success rate in training, from a run's `episodes.csv`: a curve, and the value just before a policy was saved."""

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.evaluation.statistics import rate_summary, wilson
from twin.evaluation.trials import RECENT_EPISODES
from twin.files import digest_file, is_file, read_json, read_text, wrap_read_errors
from twin.scene import SceneDir
from twin.types import Indices

CHOICE_FILE = "choice.json"
"""File of a run that records the selection of its policy; see `learn/selection.py`."""
_MAX_BINS = 25  # largest number of points in a curve
_MIN_EPISODES = 5  # smallest number of episodes per point


def training_summaries(root: Path, policies: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Summarizes the trainings of those policies in `runs/` that are unchanged since their validation.

    Args:
        root: The scene folder.
        policies: Names, `run` or `run/checkpoint`.

    Returns:
        A JSON-able dict for each policy: its run; the step at which it was saved; the training's task, observe and
        lighting; the `rate_summary` of the last `RECENT_EPISODES` episodes of `read_episodes` up to that step;
        `first_step`, the step at which the first of these episodes ended; and `test`, the run's final test if it tested
        this policy, else None.
    """
    digests = validated_digests(root)
    out = {}
    for policy in policies:
        run, _, checkpoint = policy.partition("/")
        folder = root / "runs" / run
        head = (folder / "checkpoints" / checkpoint if checkpoint else folder) / "policy.json"
        if not (is_file(head) and is_file(folder / "episodes.csv")) or digest_file(head) != digests.get(policy):
            continue
        with wrap_read_errors(head, "copy the whole run again"):
            trained = dict(read_json(head).get("trained", {}))
            if "step" not in trained:
                continue
            at = int(trained["step"])
        steps, success = read_episodes(folder)
        recent = np.flatnonzero(steps <= at)[-RECENT_EPISODES:]
        test = _final_test(folder)
        out[policy] = {
            "run": run,
            "step": at,
            **{key: trained.get(key, "") for key in ("task", "observe", "lighting")},
            **rate_summary(int(success[recent].sum()), len(recent)),
            "first_step": int(steps[recent[0]]) if len(recent) else None,
            "test": test if test and test["step"] == at else None,
        }
    return out


def _final_test(folder: Path) -> dict[str, Any] | None:
    """A run's final test: step of the policy, condition of the episodes, and `rate_summary`; None if there was none."""
    path = folder / CHOICE_FILE
    if not is_file(path):
        return None
    with wrap_read_errors(path, "delete it, and the best policy is selected again"):
        chosen = dict(read_json(path)["chosen"])
        step, won, trials = (int(chosen[name]) for name in ("step", "successes", "trials"))
        if not 0 <= won <= trials or not trials:
            raise ValueError(f"{won} successes in {trials} trials")
        condition = str(chosen.get("condition", ""))  # older runs do not store it
        return {"step": step, "condition": condition, **rate_summary(won, trials)}


def validated_digests(root: Path) -> dict[str, Any]:
    """Digests of a scene's validated policies by name; empty if nothing was validated yet."""
    record = SceneDir(root).validation / "validated.json"
    if not record.exists():
        return {}
    with wrap_read_errors(record, f"move {record.parent} away and validate again"):
        return dict(read_json(record)["policies"])


def read_episodes(folder: Path) -> tuple[Indices, Indices]:
    """Reads a run's episodes: steps at which they ended, ascending, and success, 0 or 1; shapes (n,).

    Episodes that started further along the route are left out, since they are easier. Raises InputError: there is no
    such file, or its contents are not those that a training writes.
    """
    path = folder / "episodes.csv"
    text = read_text(path)
    with wrap_read_errors(path, "delete its last lines, or train again under another name"):
        # Tables of older runs have no column start_m; all their episodes started at the beginning.
        whole = [row for row in csv.DictReader(io.StringIO(text)) if float(row.get("start_m") or 0.0) == 0.0]
        rows = [(int(row["step"]), int(row["success"])) for row in whole]
        steps, success = np.array(rows, np.int64).reshape(-1, 2).T
        if (np.diff(steps) < 0).any() or not np.isin(success, (0, 1)).all():
            raise ValueError("steps decrease, or success is neither 0 nor 1")
    return steps, success


def binned_rates(steps: Indices, success: Indices) -> list[tuple[float, int, int, float, float]]:
    """Divides the episodes of `read_episodes` into up to `_MAX_BINS` bins with about equal numbers of episodes.

    Returns for each bin: mean step, successes, episodes, and the ends of the rate's interval. A bin has at least
    `_MIN_EPISODES` episodes; if there are fewer in all, there is one bin.
    """
    out = []
    parts = max(1, min(_MAX_BINS, len(steps) // _MIN_EPISODES))
    for at, won in zip(np.array_split(steps, parts), np.array_split(success, parts), strict=True):
        low, high = wilson(won.sum(), len(won))
        out.append((float(at.mean()), int(won.sum()), len(won), float(low), float(high)))
    return out


def plot_success_curve(axes: Axes, steps: Indices, success: Indices, color: str) -> None:
    """Plots the success rate over steps, with its interval; see `binned_rates`. Needs at least one episode."""
    step, won, count, low, high = np.array(binned_rates(steps, success), float).T
    axes.fill_between(step, low, high, color=color, alpha=0.2, linewidth=0, label="90 % interval")
    label = f"{len(steps)} episodes from the start, {_range_text(count.astype(int).tolist())} per point"
    axes.plot(step, won / count, ".-", color=color, label=label)


def _range_text(counts: Iterable[int]) -> str:
    """Smallest and largest of some numbers, as "5 to 6" or "5"."""
    ends = sorted(counts)
    return " to ".join(map(str, dict.fromkeys((ends[0], ends[-1]))))


def _plot_choice(axes: Axes, choice: dict[str, Any]) -> None:
    tried, chosen = choice["candidates"], choice["chosen"]
    shares = [one["successes"] / one["trials"] for one in tried]
    label = f"tests without exploration, {_range_text(one['trials'] for one in tried)} episodes each"
    axes.plot([one["step"] for one in tried], shares, "o-", color="#d95f02", fillstyle="none", label=label)
    rate = chosen["successes"] / chosen["trials"]
    low, high = wilson(chosen["successes"], chosen["trials"])
    label = f"the chosen policy in {chosen['trials']} new episodes"
    bars = [[max(0.0, rate - low)], [max(0.0, high - rate)]]  # rounding could make a length negative
    axes.errorbar(chosen["step"], rate, bars, fmt="o", color="#d95f02", capsize=3, label=label)


def write_success_curve(folder: Path) -> Path:
    """Writes `success.png` to a run's folder: success over steps with 90 % intervals, and the selected policy."""
    steps, success = read_episodes(folder)
    path = folder / "success.png"
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    if len(steps) >= _MIN_EPISODES:
        plot_success_curve(axes, steps, success, "#1f77b4")
    if (folder / CHOICE_FILE).exists():
        with wrap_read_errors(folder / CHOICE_FILE, "delete it, and the best policy is selected again"):
            _plot_choice(axes, read_json(folder / CHOICE_FILE))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    axes.set(xlabel="steps of all environments", ylabel="success rate", ylim=(-0.04, 1.04), xlim=(0, None))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
