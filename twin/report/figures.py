"""The report's figures: each a function of numbers that were computed before it, none of which it changes.

A *figure* is drawn by matplotlib without a display and becomes inline SVG whose colours are CSS variables, so that it
follows the page into the dark. What would make thousands of paths (points, height fields) is rasterised inside it.
"""

import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.types import Array

# Colours that nothing else uses stand for the page's CSS variables, and are replaced by them in the SVG.
INK, MUTED, LINE, CARD = "#0a0b01", "#0a0b02", "#0a0b03", "#0a0b04"
SERIES = ("#0a0b11", "#0a0b12", "#0a0b13", "#0a0b14", "#0a0b15", "#0a0b16")
_VARIABLES = {INK: "--ink", MUTED: "--muted", LINE: "--line", CARD: "--card"}
_VARIABLES |= {colour: f"--c{i + 1}" for i, colour in enumerate(SERIES)}

_WIDTH = 4.8  # [in]; with 8.5 pt text legible on a phone, where the figure is as wide as the screen
_RASTER_DPI = 200
_MOST_POINTS = 20_000  # drawn in a map
_STYLE: dict[str, Any] = {
    "font.size": 8.5,
    "font.family": "sans-serif",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "text.color": INK,
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",
    "svg.hashsalt": "twin",  # ids from the content alone, so that the same numbers give the same figure
    # Names come from the user's files: a dollar sign is a dollar sign.
    "text.parse_math": False,
}


def style() -> AbstractContextManager[None]:
    """How every figure looks; what draws text, lines or ticks stands within."""
    return matplotlib.rc_context(_STYLE)  # type: ignore[arg-type]


def svg(figure: Figure) -> str:
    """The figure as an SVG element for a page, themed and without ids that another figure could share."""
    buffer = io.BytesIO()
    with style():
        FigureCanvasSVG(figure)
        figure.savefig(
            buffer,
            format="svg",
            dpi=_RASTER_DPI,
            metadata={"Date": None, "Creator": None},
            bbox_inches="tight",
            pad_inches=0.04,
        )
    text = buffer.getvalue().decode()
    text = text[text.index("<svg") :]
    # Its style would hold for the whole page, which has the same rule for its figures.
    text = re.sub(r"<(metadata|style)\b.*?</\1>", "", text, flags=re.DOTALL)
    # Within HTML the parser knows the namespaces; left out, nothing in the page looks like an address.
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    # Only what is referred to needs an id; those get a prefix of their own.
    referred = set(re.findall(r"#([\w.-]+)[\")]", text))
    prefix = "f" + hashlib.sha256(text.encode()).hexdigest()[:8]
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in referred else "", text)
    text = re.sub(r"#([\w.-]+)([\")])", lambda m: f"#{prefix}{m[1]}{m[2]}" if m[1] in referred else m[0], text)
    # The picture fills its column: width and height are the page's business.
    return re.sub(
        r'<svg([^>]*?) width="[^"]*"', r"<svg\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    )


def new_figure(height: float, width: float = _WIDTH) -> tuple[Figure, Axes]:
    """An empty figure [in] and its axes."""
    with style():
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.add_subplot()


def _map_axes(low: Array, high: Array) -> tuple[Figure, Axes]:
    """Axes in metres, equal in both directions, for the rectangle from `low` to `high`."""
    extent = np.maximum(high - low, 1.0)
    figure, axes = new_figure(float(np.clip(_WIDTH * extent[1] / extent[0], 1.6, 5.6)) + 0.7)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    return figure, axes


def _legend(axes: Axes, columns: int) -> None:
    with style():
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.22 if axes.get_aspect() == "auto" else -0.12),
            ncols=columns,
            handlelength=1.4,
            columnspacing=1.2,
        )


def bounds_of(path: Array, margin: float = 8.0) -> tuple[Array, Array]:
    """The rectangle around a path (n, 2) that a map shows [m]."""
    return path.min(0) - margin, path.max(0) + margin


def corridor_outline(route: Array, half_width: float) -> Array:
    """The polygon of a route (m, 2) widened by `half_width` to both sides, shape (2 m, 2)."""
    along = np.gradient(route, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    side = np.stack([-along[:, 1], along[:, 0]], 1) * half_width
    return np.concatenate([route + side, (route - side)[::-1]])


def place_map(
    positions: Array,
    sources: Sequence[str],
    held_out: NDArray[np.bool_],
    points: Array,
    point_rgb: NDArray[np.uint8],
    route: Array | None = None,
    half_width: float = 0.0,
    parts: Sequence[Array] = (),
) -> Figure:
    """The place from above: reconstructed points, cameras by source, route with its corridor, and solid parts.

    Args:
        positions: Camera centres [m], shape (n, 3).
        sources: Source name per camera.
        held_out: Which cameras were never trained on, shape (n,).
        points: Sparse points [m], shape (m, 3).
        point_rgb: Their colours, shape (m, 3).
        route: Shape (k, 2) [m], or None.
        half_width: Of the corridor [m].
        parts: Outlines of convex parts [m], each (k, 2).
    """
    low, high = bounds_of(positions[:, :2] if route is None else np.concatenate([positions[:, :2], route]))
    figure, axes = _map_axes(low, high)
    with style():
        shown = np.flatnonzero(((points[:, :2] > low) & (points[:, :2] < high)).all(1))
        if len(shown) > _MOST_POINTS:
            shown = shown[np.linspace(0, len(shown) - 1, _MOST_POINTS).astype(int)]
        # Dark points would vanish on a dark page and bright ones on a bright page: keep to the middle tones.
        colours = 0.25 + 0.5 * point_rgb[shown] / 255.0
        axes.scatter(points[shown, 0], points[shown, 1], s=0.8, c=colours, linewidths=0, rasterized=True)
        _draw_route(axes, route, half_width)
        _draw_parts(axes, parts)
        for i, source in enumerate(dict.fromkeys(sources)):
            mine = np.array([name == source for name in sources])
            colour = SERIES[i % len(SERIES)]
            seen, unseen = positions[mine & ~held_out], positions[mine & held_out]
            # Several films of one path lie on top of each other: the later ones are smaller, so that all show.
            size = 16.0 / (1.0 + 0.8 * i)
            axes.scatter(seen[:, 0], seen[:, 1], s=size, c=colour, linewidths=0, label=source, zorder=4)
            axes.scatter(unseen[:, 0], unseen[:, 1], s=size, facecolors="none", edgecolors=colour, lw=0.8, zorder=4)
        axes.scatter([], [], s=12, facecolors="none", edgecolors=MUTED, lw=0.9, label="held out")
    _legend(axes, 3)
    return figure


def ground_map(ground: Ground, path: Array, route: Array | None, half_width: float, parts: Sequence[Array]) -> Figure:
    """Height of the ground [m] where it was measured, with the route, its corridor and the footprints of parts."""
    low, high = bounds_of(path if route is None else route)
    rows, columns = ground.height.shape
    x = ground.origin[0] + ground.cell * np.arange(columns)
    y = ground.origin[1] + ground.cell * np.arange(rows)
    seen = ground.measured & ((x > low[0]) & (x < high[0])) & ((y > low[1]) & (y < high[1]))[:, None]
    figure, axes = _map_axes(low, high)
    heights = ground.height[seen] if seen.any() else ground.height
    lowest, highest = np.percentile(heights, [1, 99])
    with style():
        picture = axes.imshow(
            np.ma.masked_array(ground.height, ~ground.measured),
            origin="lower",
            extent=(x[0], x[-1], y[0], y[-1]),
            vmin=lowest,
            vmax=max(highest, lowest + 1e-3),
            cmap="viridis",
            rasterized=True,
        )
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        _draw_route(axes, route, half_width)
        _draw_parts(axes, parts)
        beside = axes.inset_axes((1.03, 0.0, 0.035, 1.0))  # as tall as the map, whatever its proportions
        bar = figure.colorbar(picture, cax=beside, label="height of the ground [m]")
        bar.outline.set_visible(False)
        bar.solids.set_rasterized(True)  # type: ignore[union-attr]
    if route is not None or len(parts):
        _legend(axes, 3)
    return figure


def _draw_route(axes: Axes, route: Array | None, half_width: float) -> None:
    if route is None or len(route) < 2:
        return
    if half_width > 0.0:
        axes.add_collection(
            PolyCollection([corridor_outline(route, half_width)], facecolors=SERIES[2], alpha=0.25, label="corridor")
        )
    axes.plot(*route.T, color=INK, lw=1.0, label="route", zorder=3)
    axes.plot(*route[0], "o", color=INK, ms=4, zorder=3)
    for word, at in (("start", route[0]), ("goal", route[-1])):
        box = {"facecolor": CARD, "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
        axes.annotate(word, at, xytext=(5, 5), textcoords="offset points", fontsize=8, bbox=box, zorder=5)


def _draw_parts(axes: Axes, parts: Sequence[Array]) -> None:
    if len(parts):
        axes.add_collection(
            PolyCollection(
                list(parts), facecolors=SERIES[1], edgecolors=SERIES[1], alpha=0.55, lw=0.5, label="solid part"
            )
        )


def training_curve(steps: Sequence[float], values: Sequence[float], label: str) -> Figure:
    """How training went: a value per step."""
    figure, axes = new_figure(2.2)
    with style():
        axes.plot(steps, values, color=SERIES[0])
        axes.set(xlabel="training step", ylabel=label)
    return figure


def bars(values: dict[str, float], counts: dict[str, int], unit: str, label: str) -> Figure:
    """A horizontal bar per name with its value and the number of samples behind it."""
    figure, axes = new_figure(0.55 + 0.36 * max(1, len(values)))
    names = list(values)
    with style():
        axes.grid(False, axis="y")
        axes.barh(range(len(names)), [values[name] for name in names], color=SERIES[0], height=0.62)
        for i, name in enumerate(names):
            n = f" (n = {counts[name]})" if name in counts else ""
            text = f"{values[name]:.1f} {unit}{n}"
            axes.annotate(text, (values[name], i), (4, 0), textcoords="offset points", va="center", fontsize=8)
        axes.set_yticks(range(len(names)), [name if len(name) < 20 else name[:18] + "…" for name in names])
        axes.set(xlabel=label, xlim=(0, max([*values.values(), 1e-9]) * 1.35), ylim=(len(names) - 0.5, -0.5))
    return figure


def histogram(values: NDArray, label: str, highest: float | None = None, whole: bool = False) -> Figure:
    """How often each value occurs, with its median; what is above `highest` is counted in the last bin.

    Args:
        values: Not negative, shape (n,).
        label: What they are, with their unit.
        highest: Right end; by default where 99.5 % of the values are.
        whole: One bin per whole number.
    """
    figure, axes = new_figure(1.9)
    values = np.asarray(values, np.float64)
    top = float(highest if highest is not None else np.percentile(values, 99.5))
    with style():
        edges = np.arange(np.floor(top) + 2) - 0.5 if whole else np.linspace(0.0, max(top, 1e-9), 41)
        axes.hist(np.minimum(values, top), bins=edges, color=SERIES[0], rwidth=0.9)  # type: ignore[arg-type]
        median = float(np.median(values))
        axes.axvline(median, color=SERIES[1], lw=1.2)
        at = (median, axes.get_ylim()[1])
        text = f"median {median:.3g}"
        axes.annotate(text, at, (4, 0), textcoords="offset points", color=SERIES[1], va="top", fontsize=8)
        axes.grid(False, axis="x")
        axes.set(xlabel=label, ylabel="count")
    return figure


def along_the_path(
    distance: Sequence[float],
    curves: dict[str, Sequence[float]],
    label: str,
    limit: float | None = None,
    lowest: float | None = None,
) -> Figure:
    """Curves over the distance driven or filmed [m]; ± `limit` are dashed lines, the axis starts at `lowest`."""
    figure, axes = new_figure(2.2)
    with style():
        for i, (name, values) in enumerate(curves.items()):
            axes.plot(distance[: len(values)], values, color=SERIES[i % len(SERIES)], label=name, lw=1.3)
        if limit is not None:
            axes.axhline(limit, color=SERIES[1], ls="--", lw=1.0)
            axes.axhline(-limit, color=SERIES[1], ls="--", lw=1.0)
        axes.set(xlabel="distance along the path [m]", ylabel=label)
        if lowest is not None:
            axes.set_ylim(bottom=lowest)
    if len(curves) > 1:
        _legend(axes, 4)
    return figure


def errors_by_group(errors: dict[str, Sequence[float]], label: str, limit: float | None = None) -> Figure:
    """Per-frame errors, one curve per group (a source), over the frame's place in its group."""
    figure, axes = new_figure(2.2)
    with style():
        for i, (name, values) in enumerate(errors.items()):
            place = np.linspace(0.0, 100.0, len(values)) if len(values) > 1 else np.zeros(len(values))
            axes.plot(place, values, color=SERIES[i % len(SERIES)], label=name, lw=1.3)
        if limit is not None:
            axes.axhline(limit, color=SERIES[1], ls="--", lw=1.0)
        axes.set(xlabel="place along the film [%]", ylabel=label)
        axes.set_ylim(bottom=0.0)
    _legend(axes, 4)
    return figure


# ---- Tables as pictures: where rows and columns are many, a shade is read faster than a number.
#
# A *tile* is a cell of such a table. Its *strength* from −1 to 1 is how deep its colour is, and its sign which of two
# colours; without a strength (NaN) there is none.


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
