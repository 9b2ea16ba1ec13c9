"""Success along a training, drawn from its `episodes.csv`."""

import csv
from pathlib import Path

import matplotlib
import numpy as np

from twin.report.statistics import wilson

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_BINS = 25


def binned(steps: np.ndarray, success: np.ndarray, bins: int = _BINS) -> list[tuple[float, int, int, float, float]]:
    """Episodes in as many bins of alike many: mean step, successes, episodes, and the rate's interval.

    Args:
        steps: At which episodes ended, ascending, shape (n,).
        success: 0 or 1, shape (n,).
        bins: Most; every bin has 10 episodes at least, where there are so many.
    """
    out = []
    parts = max(1, min(bins, len(steps) // 10))
    for at, won in zip(np.array_split(steps, parts), np.array_split(success, parts), strict=True):
        low, high = wilson(won.sum(), len(won))
        out.append((float(at.mean()), int(won.sum()), len(won), float(low), float(high)))
    return out


def success_curve(folder: Path) -> Path:
    """Draws `success.png` of a run: the rate of success over steps, with intervals of 90 %."""
    with (folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    path = folder / "success.png"
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    if rows:
        curve = binned(np.array([int(r["step"]) for r in rows]), np.array([int(r["success"]) for r in rows]))
        step, won, count, low, high = (np.array(column, float) for column in zip(*curve, strict=True))
        axes.fill_between(step, low, high, color="#1f77b4", alpha=0.2, linewidth=0, label="90 % interval")
        axes.plot(step, won / count, ".-", color="#1f77b4", label=f"{len(rows)} episodes, {int(count[0])} a point")
        axes.legend(loc="lower right", frameon=False)
    axes.set(xlabel="steps of all worlds", ylabel="success in training", ylim=(-0.02, 1.02), xlim=(0, None))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
