"""The validation's figures: success per policy and light, who beats whom, and success along the trainings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.report.figures import INK, SERIES, new_figure, style
from twin.report.forecast_figures import LIMITS, TICKS, columns_of, legend_below, short
from twin.report.tiles import WHOLE, matrix, percents, tiles
from twin.report.training import draw_curve
from twin.report.validation_words import LUCK

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
