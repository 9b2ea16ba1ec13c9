"""The forecast's figures: twin against road, the ranking with its uncertainty, predictions against what was seen."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.config import RANDOMISED
from twin.report.figures import CARD, MUTED, SERIES, new_figure, style
from twin.report.forecast import Candidate, Estimate, Forecast, Pair
from twin.report.tiles import WHOLE, matrix, percents, tiles

LIMITS = (-0.04, 1.04)
"""Of an axis of rates."""
TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)

_NAMED = 3  # points furthest off, which are named
_NAME = (0.5, 0.06)  # width and height of a name, in units of the axes
_LONGEST = 26  # characters of a name
_ROW = 0.34  # [in] of three points with their intervals
_SQUARE = 4.6  # [in]


def twin_against_road(forecast: Forecast) -> Figure:
    """Real over twin rate of every driven candidate, coloured by task; on the diagonal the twin is right."""
    driven = [c for c in forecast.candidates if c.driven]
    figure, axes = _square("success in the twin", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in driven if c.task == task]
            if mine:
                _crosses(axes, [c.twin for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _name_furthest(axes, [(c.policy, c.twin.value or 0.0, c.real.value or 0.0) for c in driven])
    legend_below(axes, 3, _SQUARE)
    return figure


def predicted_against_road(forecast: Forecast) -> Figure:
    """Real rate of every driven candidate over what was predicted for it from the others."""
    known = [c for c in forecast.candidates if c.driven and c.corrected.value is not None]
    figure, axes = _square("predicted from the other policies", "success on the road")
    with style():
        for i, task in enumerate(forecast.tasks):
            mine = [c for c in known if c.task == task]
            if mine:
                _crosses(axes, [c.corrected for c in mine], [c.real for c in mine], SERIES[i % len(SERIES)], task)
        _name_furthest(axes, [(c.policy, c.corrected.value or 0.0, c.real.value or 0.0) for c in known])
    legend_below(axes, 3, _SQUARE)
    return figure


def rates(candidates: Sequence[Candidate]) -> Figure:
    """One row per candidate of a task, best in the twin first: its rate in the twin, on the road, and as predicted."""
    n = len(candidates)
    figure, axes = new_figure(0.8 + _ROW * n)
    columns = (
        ("in the twin", SERIES[0], "o", [c.twin for c in candidates]),
        ("on the road", SERIES[1], "s", [c.real for c in candidates]),
        ("road, predicted", SERIES[2], "D", [c.corrected for c in candidates]),
    )
    shown = [column for column in columns if any(e.value is not None for e in column[3])]
    with style():
        for k, (name, colour, marker, estimates) in enumerate(shown):
            rows = [i for i, e in enumerate(estimates) if e.value is not None]
            y = np.array(rows) + (k - (len(shown) - 1) / 2) * 0.24
            x, ends = _ends([estimates[i] for i in rows])
            axes.errorbar(x, y, xerr=ends, fmt=marker, color=colour, ms=3.5, lw=1.1, label=name)
        _names(axes, candidates)
        axes.grid(False, axis="y")
        axes.set(xlim=LIMITS, ylim=(n - 0.5, -0.5), xlabel="success rate", xticks=TICKS)
    legend_below(axes, len(shown), 0.8 + _ROW * n)
    return figure


def rank_chances(candidates: Sequence[Candidate]) -> Figure:
    """Probability of every rank in the twin, one row per candidate."""
    n = len(candidates)
    chance = np.array([c.twin_ranks for c in candidates])
    ranks = [str(k + 1) if k % -(-n // 12) == 0 else "" for k in range(n)]
    shown = np.where(chance > 0.005, chance, np.nan)
    return tiles(shown, [short(c.policy) for c in candidates], ranks, percents(chance), "rank in the twin [%]")


def twin_cells(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """Success of every driven candidate in every lighting of the twin that the road is compared with, in per cent."""
    return _cells(candidates, {(pair.policy, pair.twin_lighting): pair.twin.value for pair in pairs})


def road_cells(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """Success of every driven candidate in every lighting of the road, in per cent."""
    return _cells(candidates, {(pair.policy, pair.lighting): pair.real.value for pair in pairs})


def _cells(candidates: Sequence[Candidate], rates: dict[tuple[str, str], float | None]) -> Figure:
    policies, lightings = [c.policy for c in candidates if c.driven], list(dict.fromkeys(light for _, light in rates))
    rate = matrix(rates, policies, lightings)
    names, label = columns_of(lightings)
    return tiles(rate, [short(name) for name in policies], names, percents(rate), label)


def road_minus_twin(candidates: Sequence[Candidate], pairs: Sequence[Pair]) -> Figure:
    """In points, in every lighting of the road; coloured where it is more than chance."""
    policies = [c.policy for c in candidates if c.driven]
    lightings = list(dict.fromkeys(pair.lighting for pair in pairs))
    bias = matrix({(pair.policy, pair.lighting): pair.bias.value for pair in pairs}, policies, lightings)
    beyond = {(pair.policy, pair.lighting): float(not pair.within_chance) for pair in pairs}
    texts = np.array([[f"{100 * each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in bias])
    shown = bias * matrix(beyond, policies, lightings)
    names, label = columns_of(lightings)
    return tiles(shown, [short(name) for name in policies], names, texts, label, WHOLE)


def _square(x: str, y: str) -> tuple[Figure, Axes]:
    figure, axes = new_figure(_SQUARE)
    with style():
        axes.plot([0, 1], [0, 1], color=MUTED, lw=0.9, ls="--", zorder=1)
        axes.set(xlim=LIMITS, ylim=LIMITS, xlabel=x, ylabel=y, xticks=TICKS, yticks=TICKS)
    return figure, axes


def _crosses(axes: Axes, x: list[Estimate], y: list[Estimate], colour: str, name: str) -> None:
    """Points with their intervals in both directions."""
    (at_x, ends_x), (at_y, ends_y) = _ends(x), _ends(y)
    axes.errorbar(at_x, at_y, xerr=ends_x, yerr=ends_y, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.5)
    axes.plot(at_x, at_y, "o", color=colour, ms=4.5, label=name, zorder=4)


def _ends(estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,), and how far the interval reaches below and above, shape (2, n)."""
    rows = [(e.value or 0.0, e.low if e.low is not None else e.value, e.high if e.high is not None else e.value)
            for e in estimates]  # fmt: skip
    value, low, high = np.array(rows, float).reshape(-1, 3).T
    return value, np.stack([np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)])


def _name_furthest(axes: Axes, points: list[tuple[str, float, float]]) -> None:
    """Names the points that are furthest off, but none over the name of another."""
    named: list[tuple[float, float]] = []
    for name, x, y in sorted(points, key=lambda p: -abs(p[2] - p[1])):
        if len(named) == _NAMED or any(abs(x - a) < _NAME[0] and abs(y - b) < _NAME[1] for a, b in named):
            continue
        named.append((x, y))
        offset, side = ((-7, -10), "right") if x > 0.5 else ((7, -10), "left")
        box = {"facecolor": CARD, "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
        text = axes.annotate(short(name), (x, y), offset, textcoords="offset points", ha=side, bbox=box, zorder=3)
        text.set(fontsize=7.5, color=MUTED)


def _names(axes: Axes, candidates: Sequence[Candidate]) -> None:
    axes.set_yticks(range(len(candidates)), [short(c.policy) for c in candidates])


def legend_below(axes: Axes, columns: int, height: float) -> None:
    """A legend below the axes of a figure of this height [in]."""
    with style():
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.45 / height), ncols=columns, handlelength=1.4)


def columns_of(lightings: Sequence[str]) -> tuple[list[str], str]:
    """Names of lightings above tiles, without what is the same in all of them, and a label that tells that."""
    if all(name.endswith(RANDOMISED) for name in lightings):
        return [short(name.removesuffix(RANDOMISED)) for name in lightings], f"lights, all of them {RANDOMISED}"
    return [short(name) for name in lightings], ""


def short(name: str) -> str:
    """A name as long as a figure has room for; checkpoints differ at their end, so the middle goes."""
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST // 2]}…{name[-(_LONGEST // 2 - 1) :]}"
