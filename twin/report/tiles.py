"""Tables as pictures: where rows and columns are many, a shade is read faster than a number.

A *tile* is a cell of such a table. Its *strength* from −1 to 1 is how deep its colour is, and its sign which of two
colours; without a strength (NaN) there is none.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.report.figures import INK, SERIES, new_figure, style

Array = NDArray[np.float64]

HALF, WHOLE = 4.8, 7.2
"""Widths of a figure [in]: beside another, and with the page's width to itself."""

_ROW = 0.28  # [in] per row
_LETTER, _LABEL = 0.075, 0.35  # [in] for a letter of a name, and for the axis' label
_LYING = 3  # letters of a column's name at most that does not stand upright
_FAINT, _DEEP = 0.08, 0.58  # alpha of strength 0 and 1; over the page, and ink is legible on it in light and in dark
_PART = np.array([0.48, 0.46])  # of a tile to either side of its middle, of the distance to the next
_SMALL, _LARGE = 4.5, 7.0  # [pt] of texts; where these would have to be smaller there are none
_DIGIT = 0.8  # width of a digit and its gap, of its size


def tiles(
    strength: Array,
    rows: Sequence[str],
    columns: Sequence[str],
    texts: NDArray[np.str_],
    label: str = "",
    width: float = HALF,
) -> Figure:
    """A figure of tiles, the first row on top.

    Args:
        strength: −1 to 1, or NaN, shape (n, m).
        rows: Their names, n.
        columns: Their names, m; long ones stand upright.
        texts: Written into the tiles as far as there is room, shape (n, m).
        label: What the columns are.
        width: `HALF` or `WHOLE`.
    """
    there = np.argwhere(np.isfinite(strength))
    value = strength[tuple(there.T)]
    corners = there[:, None, ::-1] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * _PART
    colours = np.array([to_rgb(SERIES[0]), to_rgb(SERIES[1])])[(value < 0.0).astype(int)]
    faces = np.column_stack([colours, _FAINT + (_DEEP - _FAINT) * np.abs(value)])
    longest = max(map(len, columns))
    upright = longest > _LYING
    figure, axes = new_figure(_ROW * len(rows) + _LABEL + (_LETTER * longest if upright else _LABEL), width)
    room = 72.0 * (width - _LETTER * max(map(len, rows))) / len(columns)  # [pt]
    size = min(_LARGE, room / (_DIGIT * max([1, *map(len, texts[tuple(there.T)].tolist())])))
    with style():
        axes.grid(False)
        axes.add_collection(PolyCollection(corners, facecolors=faces, linewidths=0.0))
        if size >= _SMALL:
            for row, column in there:
                text = str(texts[row, column])
                axes.annotate(text, (column, row), ha="center", va="center", fontsize=size, color=INK)
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set_xticks(range(len(columns)), list(columns), rotation=90 if upright else 0)
        axes.xaxis.tick_top()  # where a long figure begins to be read
        axes.xaxis.set_label_position("top")
        axes.spines["bottom"].set_visible(False)
        axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5), xlabel=label)
    return figure


def matrix(found: Mapping[tuple[str, str], float | None], rows: Sequence[str], columns: Sequence[str]) -> Array:
    """Values by row and column, shape (n, m); NaN where there is none."""
    return np.array([[found.get((row, column)) for column in columns] for row in rows], float)


def percents(rate: Array) -> NDArray[np.str_]:
    """Rates as texts of their tiles."""
    return np.array([[f"{100 * each:.0f}" for each in row] for row in rate])
