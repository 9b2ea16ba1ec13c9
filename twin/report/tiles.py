"""Tables as pictures: where rows and columns are many, a shade is read faster than a number.

A *tile* is a cell of such a table. Its *strength* from −1 to 1 is how deep its colour is, and its sign which of two
colours; without a strength (NaN) there is none.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.report.figures import INK, SERIES, new_figure, style

_ROW = 0.28  # [in] per row
_LETTER, _LABEL = 0.075, 0.35  # [in] for a letter of a name, and for the axis' label
_UPRIGHT = 3  # letters from which on they do
_FAINT, _DEEP = 0.10, 0.90  # alpha of strength 0 and 1; over the page, so that it reads in light and dark
_HALF = np.array([0.48, 0.46])  # of a tile, of the distance to the next
_SMALL, _LARGE = 4.0, 7.0  # [pt] of texts; where these would have to be smaller there are none
_SLIM = 0.65  # width of a digit, of its size


def tiles(
    strength: NDArray[np.float64],
    rows: Sequence[str],
    columns: Sequence[str],
    texts: NDArray[np.str_],
    label: str = "",
) -> Figure:
    """A figure of tiles, the first row on top.

    Args:
        strength: −1 to 1, or NaN, shape (n, m).
        rows: Their names, n.
        columns: Their names, m; long ones stand upright.
        texts: Written into the tiles as far as there is room, shape (n, m).
        label: What the columns are.
    """
    there = np.argwhere(np.isfinite(strength))
    value = strength[tuple(there.T)]
    corners = there[:, None, ::-1] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * _HALF
    colours = np.array([to_rgb(SERIES[0]), to_rgb(SERIES[1])])[(value < 0.0).astype(int)]
    faces = np.column_stack([colours, _FAINT + (_DEEP - _FAINT) * np.abs(value)])
    longest = max(map(len, columns))
    upright = longest > _UPRIGHT
    figure, axes = new_figure(_ROW * len(rows) + _LABEL + (_LETTER * longest if upright else _LABEL))
    room = 72.0 * (figure.get_figwidth() - _LETTER * max(map(len, rows))) / len(columns)  # [pt]
    size = min(_LARGE, room / (_SLIM * max(1, *map(len, texts[tuple(there.T)].tolist()))))
    with style():
        axes.grid(False)
        axes.add_collection(PolyCollection(corners, facecolors=faces, linewidths=0.0))
        if size >= _SMALL:
            for row, column in there:
                text = str(texts[row, column])
                axes.annotate(text, (column, row), ha="center", va="center", fontsize=size, color=INK)
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set_xticks(range(len(columns)), list(columns), rotation=90 if upright else 0)
        axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5), xlabel=label)
    return figure
