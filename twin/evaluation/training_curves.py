"""Success along a training, from its `episodes.csv`: the curve, and what a policy did that was saved on the way."""

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.evaluation.statistics import share, wilson
from twin.evaluation.trials import RECENT
from twin.files import damaged, digest_file, read_json, read_text, regular
from twin.scene import SceneDir

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

CHOICE = "choice.json"
"""Of a run: what its last policies did without exploring, and which is the run's; see `learn/policy_evaluation.py`."""
_BINS = 25  # points of a curve, at most
_LEAST = 5  # episodes behind each point


def trainings(root: Path, policies: Iterable[str]) -> dict[str, dict[str, Any]]:
    """What is known of the training of validated policies: those that lie in `runs/` as they were validated.

    Args:
        root: The scene folder.
        policies: Their names in the tables, `run` or `run/checkpoint`.

    Returns:
        JSON-able, by policy: run, step at which it was saved, task, observe and lighting of the training, and the rate
        (`share`) over the `RECENT` episodes before that step.
    """
    noted = SceneDir(root).validation / "validated.json"
    digests: dict[str, Any] = {}
    if noted.exists():
        with damaged(noted, f"move {noted.parent} away and validate anew"):
            digests = dict(read_json(noted)["policies"])
    out = {}
    for policy in policies:
        run, _, checkpoint = policy.partition("/")
        folder = root / "runs" / run
        head = (folder / "checkpoints" / checkpoint if checkpoint else folder) / "policy.json"
        if not (_is_there(head) and _is_there(folder / "episodes.csv")) or digest_file(head) != digests.get(policy):
            continue
        with damaged(head, "copy the whole run again"):
            trained = dict(read_json(head).get("trained", {}))
            if "step" not in trained:
                continue
            at = float(trained["step"])
        steps, success = read_episodes(folder)
        won = success[steps <= at][-RECENT:]
        told = {key: trained.get(key, "") for key in ("step", "task", "observe", "lighting")}
        out[policy] = {"run": run, **told, **share(int(won.sum()), len(won))}
    return out


def _is_there(path: Path) -> bool:
    """Whether there is such a file; False for a name that no file can have, as a table may have any."""
    try:
        return bool(regular(path))
    except InputError:
        return False


def read_episodes(folder: Path) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of a run: the steps at which episodes ended, ascending, and success, 0 or 1; both of shape (n,).

    Episodes that started on the way are left out, as they are easier.

    Raises:
        InputError: no such file, or not one that a training wrote.
    """
    path = folder / "episodes.csv"
    text = read_text(path)
    with damaged(path, "cut its last lines off, or train anew under another name"):
        # Runs of before have no such column: all their episodes were whole.
        whole = [row for row in csv.DictReader(io.StringIO(text)) if float(row.get("start_m") or 0.0) == 0.0]
        rows = [(int(row["step"]), int(row["success"])) for row in whole]
        steps, success = np.array(rows, np.int64).reshape(-1, 2).T
        if (np.diff(steps) < 0).any() or not np.isin(success, (0, 1)).all():
            raise ValueError("steps that go back, or success that is neither 0 nor 1")
    return steps, success


def binned(steps: np.ndarray, success: np.ndarray, bins: int = _BINS) -> list[tuple[float, int, int, float, float]]:
    """Episodes in as many bins of alike many: mean step, successes, episodes, and the rate's interval.

    Args:
        steps: At which episodes ended, ascending, shape (n,).
        success: 0 or 1, shape (n,).
        bins: At most; every one has 5 episodes at least, where there are so many.
    """
    out = []
    parts = max(1, min(bins, len(steps) // _LEAST))
    for at, won in zip(np.array_split(steps, parts), np.array_split(success, parts), strict=True):
        low, high = wilson(won.sum(), len(won))
        out.append((float(at.mean()), int(won.sum()), len(won), float(low), float(high)))
    return out


def draw_curve(axes: Axes, steps: NDArray[np.int64], success: NDArray[np.int64], colour: str) -> None:
    """The rate of success over steps with its interval; arguments as of `binned`, at least one episode."""
    step, won, count, low, high = (np.array(column, float) for column in zip(*binned(steps, success), strict=True))
    axes.fill_between(step, low, high, color=colour, alpha=0.2, linewidth=0, label="90 % interval")
    axes.plot(step, won / count, ".-", color=colour, label=f"{len(steps)} episodes, {int(count[0])} a point")


def _draw_choice(axes: Axes, choice: dict[str, Any]) -> None:
    tried, chosen = choice["candidates"], choice["chosen"]
    shares = [one["successes"] / one["trials"] for one in tried]
    label = f"without exploring, {tried[0]['trials']} episodes each"
    axes.plot([one["step"] for one in tried], shares, "o", color="#d95f02", fillstyle="none", label=label)
    rate = chosen["successes"] / chosen["trials"]
    low, high = wilson(chosen["successes"], chosen["trials"])
    label = f"the chosen one, {chosen['trials']} more"
    bars = [[max(0.0, rate - low)], [max(0.0, high - rate)]]  # rounding may put an end on the wrong side
    axes.errorbar(chosen["step"], rate, bars, fmt="o", color="#d95f02", capsize=3, label=label)


def success_curve(folder: Path) -> Path:
    """Draws `success.png` of a run: success over steps, with intervals of 90 %, and the choice at its end."""
    steps, success = read_episodes(folder)
    path = folder / "success.png"
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    if len(steps):
        draw_curve(axes, steps, success, "#1f77b4")
    if (folder / CHOICE).exists():
        with damaged(folder / CHOICE, "delete it, and the best policy is chosen again"):
            _draw_choice(axes, read_json(folder / CHOICE))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    axes.set(xlabel="steps of all worlds", ylabel="success in training", ylim=(-0.04, 1.04), xlim=(0, None))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
