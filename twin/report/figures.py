"""Figures of the reports, drawn by matplotlib without a display.

`svg` turns a figure into inline SVG whose colors are CSS variables of the page (light and dark mode). Points and height
fields are rasterized inside the SVG, because browsers draw thousands of SVG paths slowly. Heatmaps show tables with
many rows and columns.
"""

import hashlib
import io
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from twin.assets.ground import Ground
from twin.config import RANDOMIZED, Condition
from twin.geometry.passes import FilmedPass
from twin.types import Array

# Placeholder colors that occur nowhere else in a figure; `svg` replaces them with the page's CSS variables.
INK, MUTED, LINE, CARD = "#0a0b01", "#0a0b02", "#0a0b03", "#0a0b04"
SERIES = ("#0a0b11", "#0a0b12", "#0a0b13", "#0a0b14", "#0a0b15", "#0a0b16")
# The numbers of markers and of dashes have no common divisor with that of the colors, so that pairs of them recur late.
MARKERS = ("o", "s", "D", "^", "v", "P", "X")
"""Marker of each series, for readers who cannot distinguish the colors."""
_DASHES = ("-", "-.", ":", "--", (0, (6, 1, 1, 1, 1, 1)))
_VARIABLES = {INK: "--ink", MUTED: "--muted", LINE: "--line", CARD: "--card"}
_VARIABLES |= {color: f"--c{i + 1}" for i, color in enumerate(SERIES)}

_WIDTH = 4.8  # [in] if a figure of this width is scaled to a phone's screen, 8.5 pt text is still legible
_RASTER_DPI = 200
_MAP_MARGIN = 8.0  # [m] around the path
_MAX_POINTS = 20_000  # largest number of points drawn in a map
_LEGEND_LETTERS = 55  # letters per row of a legend; a marker counts as four letters
_LEGEND_ROW = 0.175  # [in] height of a row of a legend
_BOX = {"facecolor": CARD, "alpha": 0.75, "edgecolor": "none", "pad": 1.0}  # behind a text
_STYLE: dict[str, Any] = {
    "font.size": 8.5,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
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
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",
    "svg.hashsalt": "twin",  # deterministic ids: the same numbers give the same SVG
    # Names come from the user's files, so a dollar sign must not start a formula.
    "text.parse_math": False,
}
styled = matplotlib.rc_context(_STYLE)  # type: ignore[arg-type]
"""Decorator for functions that draw. It sets the common style, which matplotlib reads when it creates an element."""


@styled
def svg(figure: Figure) -> str:
    """Returns a figure as an inline SVG element. Its colors are CSS variables; its ids are unique to the figure."""
    buffer = io.BytesIO()
    FigureCanvasSVG(figure)
    no_metadata = {"Date": None, "Creator": None}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the page has the browser's fonts, matplotlib's lacks some letters
        figure.savefig(
            buffer, format="svg", dpi=_RASTER_DPI, metadata=no_metadata, bbox_inches="tight", pad_inches=0.04
        )  # fmt: skip
    text = buffer.getvalue().decode()
    text = text[text.index("<svg") :]
    # The style element would apply to the whole page, which has the same rule already.
    text = re.sub(r"<(metadata|style)\b.*?</\1>", "", text, flags=re.DOTALL)
    # HTML parsers do not need the namespaces, and without them the page contains no URL.
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    for color, variable in _VARIABLES.items():
        text = text.replace(color, f"var({variable})")
    # Keep only ids that are referred to, and give them a prefix that is unique to the figure.
    referred = set(re.findall(r"#([\w.-]+)[\")]", text))
    prefix = "f" + hashlib.sha256(text.encode()).hexdigest()[:8]
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in referred else "", text)
    text = re.sub(r"#([\w.-]+)([\")])", lambda m: f"#{prefix}{m[1]}{m[2]}" if m[1] in referred else m[0], text)
    # The page sets width and height.
    opening, end, rest = text.partition(">")
    return re.sub(r' (width|height)="[^"]*"', "", opening) + end + rest


@styled
def new_figure(height: float, width: float = _WIDTH) -> tuple[Figure, Axes]:
    """Returns a figure of the given size [in], and its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


@styled
def add_legend(figure: Figure) -> None:
    """Adds a legend of the first axes below the figure, which grows by its rows. It has as many columns as fit."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    fitting = min(len(labels), max(1, _LEGEND_LETTERS // (max(map(len, labels)) + 4)))
    figure.set_figheight(figure.get_figheight() + _LEGEND_ROW * (-(-len(labels) // fitting) - 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=fitting)


def legend_name(name: str) -> str:
    """A series' label: its name, short enough for a legend, which would omit a label with an underscore first."""
    name = shorten_name(name, _LEGEND_LETTERS - 4)
    return f" {name}" if name.startswith("_") else name


# ---- maps


def _map_axes(path: Array) -> tuple[Figure, Axes, Array, Array]:
    """Returns a figure, its axes in meters with equal aspect, and their lower and upper corner around a path (n, 2)."""
    low, high = path.min(0) - _MAP_MARGIN, path.max(0) + _MAP_MARGIN
    extent = np.maximum(high - low, 1.0)
    figure, axes = new_figure(float(np.clip(_WIDTH * extent[1] / extent[0], 1.6, 5.6)) + 0.7)
    axes.set_aspect("equal")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    return figure, axes, low, high


def corridor_outline(route: Array, half_width: float) -> Array:
    """Polygon (2 m, 2) of a route (m, 2) that is widened by `half_width` to both sides."""
    along = np.gradient(route, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    side = np.stack([-along[:, 1], along[:, 0]], 1) * half_width
    return np.concatenate([route + side, (route - side)[::-1]])


@styled
def place_map(
    positions: Array,
    sources: Sequence[str],
    held_out: NDArray[np.bool_],
    points: Array,
    point_rgb: NDArray[np.uint8],
    route: Array | None = None,
    half_width: float = 0.0,
    passes: Sequence[FilmedPass] = (),
    branches: Mapping[str, Array] | None = None,
    contradicted: Sequence[tuple[int, int]] = (),
) -> Figure:
    """Map [m] of the sparse points, the cameras by source (held-out ones hollow), and the route with its corridor.

    Shapes: `positions` (n, 3), `held_out` (n,), `points` and `point_rgb` (m, 3), `route` and `branches` (k, 2).
    If a source has several passes (`twin.geometry.passes`), all passes are drawn as lines with their names.
    `contradicted` has index pairs of cameras whose relative pose contradicts the pictures; thick lines join them.
    """
    others = (branches or {}).values()
    figure, axes, low, high = _map_axes(
        np.concatenate([positions[:, :2], *([] if route is None else [route]), *others])
    )
    shown = np.flatnonzero(((points[:, :2] > low) & (points[:, :2] < high)).all(1))
    if len(shown) > _MAX_POINTS:
        shown = shown[np.linspace(0, len(shown) - 1, _MAX_POINTS).astype(int)]
    # Middle tones are visible on dark and on bright pages.
    colors = 0.25 + 0.5 * point_rgb[shown] / 255.0
    axes.scatter(points[shown, 0], points[shown, 1], s=0.8, c=colors, linewidths=0, rasterized=True)
    if route is not None:
        _draw_route(axes, route, half_width)
    _draw_passes(axes, passes)
    for name, line in (branches or {}).items():
        _draw_route(axes, line, half_width, name)
    for i, source in enumerate(dict.fromkeys(sources)):
        mine = np.array([name == source for name in sources])
        color, marker = SERIES[i % len(SERIES)], MARKERS[i % len(MARKERS)]
        trained, unseen = positions[mine & ~held_out], positions[mine & held_out]
        # Films of one path overlap; later sources get smaller markers so that all remain visible.
        size = 16.0 / (1.0 + 0.8 * min(i, 5))
        look: dict[str, Any] = {"s": size, "marker": marker, "zorder": 4}
        axes.scatter(trained[:, 0], trained[:, 1], c=color, linewidths=0, label=legend_name(source), **look)
        axes.scatter(unseen[:, 0], unseen[:, 1], facecolors="none", edgecolors=color, lw=0.8, **look)
    axes.scatter([], [], s=12, facecolors="none", edgecolors=MUTED, lw=0.9, label="held out")
    steps = positions[np.array(contradicted, np.int64).reshape(-1, 2), :2]
    for k, step in enumerate(steps):
        label = f"contradicted (n = {len(steps)})" if k == 0 else None
        axes.plot(*step.T, color=INK, lw=4.0, solid_capstyle="round", label=label, zorder=5)
    add_legend(figure)
    return figure


@styled
def ground_map(
    ground: Ground,
    path: Array,
    route: Array | None,
    half_width: float,
    parts: Sequence[Array],
    branches: Mapping[str, Array] | None = None,
) -> Figure:
    """Map of the measured ground height [m], the route and its branches with their corridors, and footprints of parts.

    Shapes: `path`, `route` and `branches` (k, 2).
    """
    branches = branches or {}
    figure, axes, low, high = _map_axes(path if route is None else np.concatenate([route, *branches.values()]))
    rows, columns = ground.height.shape
    x = ground.origin[0] + ground.cell * np.arange(columns)
    y = ground.origin[1] + ground.cell * np.arange(rows)
    shown = ground.measured & ((x > low[0]) & (x < high[0])) & ((y > low[1]) & (y < high[1]))[:, None]
    lowest, highest = np.percentile(ground.height[shown] if shown.any() else ground.height, [1, 99])
    image = axes.imshow(
        np.ma.masked_array(ground.height, ~ground.measured),
        origin="lower",
        extent=(x[0], x[-1], y[0], y[-1]),
        vmin=lowest,
        vmax=max(highest, lowest + 1e-3),
        cmap="viridis",
        rasterized=True,
    )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if route is not None:
        _draw_route(axes, route, half_width)
    for name, line in branches.items():
        _draw_route(axes, line, half_width, name)
    if len(parts):
        look: dict[str, Any] = {"facecolors": SERIES[1], "edgecolors": SERIES[1], "alpha": 0.55, "lw": 0.5}
        axes.add_collection(PolyCollection(list(parts), label="convex part", **look))
    color_axes = axes.inset_axes((1.03, 0.0, 0.035, 1.0))  # as tall as the map
    bar = figure.colorbar(image, cax=color_axes, label="height of the ground [m]")
    bar.outline.set_visible(False)
    bar.solids.set_rasterized(True)  # type: ignore[union-attr]
    if route is not None or len(parts):
        add_legend(figure)
    return figure


def _draw_passes(axes: Axes, passes: Sequence[FilmedPass]) -> None:
    """Draws the passes with their names if a source has several. A cross marks an end that is not the film's end."""
    if len(passes) == len({one.source for one in passes}):
        return
    for k, one in enumerate(passes):
        color = SERIES[k % len(SERIES)]
        axes.plot(*one.path.T, color=color, lw=0.9, ls=(0, (4, 2)), zorder=3)
        # Passes may coincide, so each name is at another fraction of its pass.
        at = one.path[len(one.path) * (k + 1) // (len(passes) + 1)]
        axes.annotate(one.name, at, (4, -9), textcoords="offset points", fontsize=7, color=color, bbox=_BOX, zorder=6)
        if one.ends_with != "end":
            axes.plot(*one.path[-1], "x", color=color, ms=6, zorder=5)


def _draw_route(axes: Axes, line: Array, half_width: float, branch: str = "") -> None:
    """Draws a line (k, 2) with its corridor: the route, or a branch, which is dashed and has its name at its end."""
    label, words = ("route", {"start": 0, "goal": -1}) if not branch else (f"branch {branch}", {branch: -1})
    if half_width > 0.0:
        outline = corridor_outline(line, half_width)
        look: dict[str, Any] = {} if branch else {"label": "corridor"}
        axes.add_collection(PolyCollection([outline], facecolors=SERIES[2], alpha=0.25, **look))
    axes.plot(*line.T, color=INK, lw=1.0, ls="--" if branch else "-", label=legend_name(label), zorder=3)
    axes.plot(*line[0], "o", color=INK, ms=4, zorder=3)
    for word, end in words.items():
        axes.annotate(word, line[end], (5, 5), textcoords="offset points", fontsize=8, bbox=_BOX, zorder=5)


# ---- curves and bars


@styled
def curve_chart(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    x_label: str,
    y_label: str,
    limit: float | None = None,
    lowest: float | None = None,
) -> Figure:
    """Chart of named curves, each given by x (n,) and y (n,).

    Dashed lines mark ± `limit`; the y axis starts at `lowest`.
    """
    figure, axes = new_figure(2.2)
    for i, (name, (x, y)) in enumerate(curves.items()):
        axes.plot(x, y, ls=_DASHES[i % len(_DASHES)], color=SERIES[i % len(SERIES)], label=legend_name(name), lw=1.3)
    for at in () if limit is None else (limit, -limit):
        axes.axhline(at, color=SERIES[1], ls="--", lw=1.0)
    axes.set(xlabel=x_label, ylabel=y_label)
    if lowest is not None:
        axes.set_ylim(bottom=lowest)
    if len(curves) > 1:
        add_legend(figure)
    return figure


@styled
def bar_chart(values: dict[str, float], counts: dict[str, int], unit: str, label: str) -> Figure:
    """Horizontal bars, each with its value and (where known) its number of samples."""
    figure, axes = new_figure(0.55 + 0.36 * max(1, len(values)))
    axes.grid(False, axis="y")
    axes.barh(range(len(values)), list(values.values()), color=SERIES[0], height=0.62)
    for i, (name, value) in enumerate(values.items()):
        text = f"{value:.1f} {unit}" + (f" (n = {counts[name]})" if name in counts else "")
        axes.annotate(text, (value, i), (4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(range(len(values)), [shorten_name(name) for name in values])
    axes.set(xlabel=label, xlim=(0, max([*values.values(), 1e-9]) * 1.35), ylim=(len(values) - 0.5, -0.5))
    return figure


@styled
def histogram(values: NDArray, label: str, counted: str, highest: float, integer: bool = False) -> Figure:
    """Histogram of nonnegative values (n,) with their median. The last bin also counts the values above `highest`.

    `counted` is the label of the vertical axis. If `integer` is True, each integer has its own bin.
    """
    figure, axes = new_figure(1.9)
    edges = np.arange(np.floor(highest) + 2) - 0.5 if integer else np.linspace(0.0, highest, 41)
    axes.hist(np.minimum(values, highest), bins=edges, color=SERIES[0], rwidth=0.9)  # type: ignore[arg-type]
    median = float(np.median(values))
    axes.axvline(median, color=SERIES[1], lw=1.2)
    at = (median, axes.get_ylim()[1])
    text = f"median {median:.3g} (n = {len(values):,})"
    look: dict[str, Any] = {"color": SERIES[1], "va": "top", "fontsize": 8, "bbox": {**_BOX, "pad": 0.5}}
    axes.annotate(text, at, (4, 0), textcoords="offset points", **look)
    axes.grid(False, axis="x")
    axes.set(xlabel=label, ylabel=counted)
    return figure


# ---- heatmaps

HALF_WIDTH, FULL_WIDTH = 4.8, 7.2
"""Figure widths [in] for half and for the full width of the page."""

_ROW_HEIGHT = 0.28  # [in] per row
_LETTER_WIDTH, _LABEL_HEIGHT = 0.075, 0.35  # [in] width of a letter, height of the axis label
_MAX_HORIZONTAL_LETTERS = 3  # longer column names are set vertically
_MIN_ALPHA, _MAX_ALPHA = 0.08, 0.58  # opacity of a cell at strength 0 and 1; its text is legible in both modes
_CELL_HALF_SIZE = np.array([0.48, 0.46])  # in units of the cell spacing
_MIN_FONT, _MAX_FONT = 4.5, 7.0  # [pt]; texts smaller than `_MIN_FONT` are left out
_DIGIT_WIDTH = 0.8  # width of a digit with its gap, in units of the font size


@styled
def heatmap(
    strength: Array,
    rows: Sequence[str],
    columns: Sequence[str],
    texts: NDArray[np.str_],
    label: str = "",
    width: float = HALF_WIDTH,
) -> Figure:
    """A table of colored cells, the first row at the top.

    Args:
        strength: Color strength in [−1, 1], shape (n, m). The sign selects one of two colors; NaN leaves a cell empty.
        rows: n row names.
        columns: m column names. If one of them is long, all are set vertically.
        texts: Cell texts, shape (n, m). If they would be too small, all are left out.
        label: Label of the column axis.
        width: `HALF_WIDTH` or `FULL_WIDTH`.
    """
    finite = np.argwhere(np.isfinite(strength))
    value = strength[tuple(finite.T)]
    corners = finite[:, None, ::-1] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * _CELL_HALF_SIZE
    colors = np.array([to_rgb(SERIES[0]), to_rgb(SERIES[1])])[(value < 0.0).astype(int)]
    faces = np.column_stack([colors, _MIN_ALPHA + (_MAX_ALPHA - _MIN_ALPHA) * np.abs(value)])
    longest = max(map(len, columns))
    upright = longest > _MAX_HORIZONTAL_LETTERS
    heading = _LETTER_WIDTH * longest if upright else _LABEL_HEIGHT
    figure, axes = new_figure(_ROW_HEIGHT * len(rows) + _LABEL_HEIGHT + heading, width)
    room = 72.0 * (width - _LETTER_WIDTH * max(map(len, rows))) / len(columns)  # [pt]
    size = min(_MAX_FONT, room / (_DIGIT_WIDTH * max([1, *map(len, texts[tuple(finite.T)].tolist())])))
    axes.grid(False)
    axes.add_collection(PolyCollection(corners, facecolors=faces, linewidths=0.0))
    for row, column in finite if size >= _MIN_FONT else ():
        text = str(texts[row, column])
        axes.annotate(text, (column, row), ha="center", va="center", fontsize=size, color=INK)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_xticks(range(len(columns)), list(columns), rotation=90 if upright else 0)
    axes.xaxis.tick_top()  # readers of a long figure start at the top
    axes.xaxis.set_label_position("top")
    axes.spines["bottom"].set_visible(False)
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5), xlabel=label)
    return figure


def matrix(values: Mapping[tuple[str, str], float | None], rows: Sequence[str], columns: Sequence[str]) -> Array:
    """Values by row and column, shape (n, m); NaN where there is no value."""
    return np.array([[values.get((row, column)) for column in columns] for row in rows], float)


def percent_texts(rate: Array) -> NDArray[np.str_]:
    return np.array([[f"{100 * each:.0f}" for each in row] for row in rate])


def difference_texts(difference: Array, certain: Array) -> NDArray[np.str_]:
    """Formats differences as signed whole numbers. Where `certain` (same shape) is 0, they are in parentheses."""
    texts = np.array([[f"{each:+.0f}".replace("-", "−") if each else "0" for each in row] for row in difference])
    return np.where(certain == 0.0, np.char.add(np.char.add("(", texts), ")"), texts)


# ---- rates

RATE_AXIS: dict[str, Any] = {"xlim": (-0.04, 1.04), "xticks": (0.0, 0.25, 0.5, 0.75, 1.0)}
"""Limits and ticks of a horizontal axis of rates."""

_RATE_SPACING = 0.18  # distance between two rates of one policy; the distance between policies is 1
_RATE_HEIGHT = 0.17  # [in] per rate of a policy
_MAX_NAME_LENGTH = 26  # characters of a name

Rate = tuple[str, float, float, float]
"""Policy, its rate, and the low and high end of the rate's interval."""


@styled
def rate_chart(policies: Sequence[str], rates: Mapping[str, Sequence[Rate]], label: str) -> Figure:
    """Rates with intervals: one row per policy, one color and marker per series of `rates`."""
    figure, axes = new_figure(0.9 + max(0.34, _RATE_HEIGHT * len(rates)) * len(policies))
    for k, (name, mine) in enumerate(rates.items()):
        y = [policies.index(policy) + (k - (len(rates) - 1) / 2) * _RATE_SPACING for policy, *_ in mine]
        x, low, high = (np.array(column, float) for column in list(zip(*mine, strict=True))[1:])
        ends = np.maximum([x - low, high - x], 0.0)
        axes.errorbar(x, y, xerr=ends, fmt=MARKERS[k], color=SERIES[k], ms=3.5, lw=1.1, label=legend_name(name))
    axes.set_yticks(range(len(policies)), [shorten_name(policy) for policy in policies])
    axes.grid(False, axis="y")
    axes.set(ylim=(len(policies) - 0.5, -0.5), xlabel=label, **RATE_AXIS)
    if len(rates) > 1:
        add_legend(figure)
    return figure


def shorten_name(name: str, most: int = _MAX_NAME_LENGTH) -> str:
    """Cuts a name of more than `most` characters in its middle."""
    half = most // 2
    return name if len(name) <= most else f"{name[:half]}…{name[1 - half :]}"


def lighting_labels(lightings: Sequence[str]) -> tuple[list[str], str]:
    """Returns the column names for lightings, and an axis label.

    If all lightings are randomized, the label says so, and the names omit it; otherwise the label is empty.
    """
    conditions = [Condition.parse(name) for name in lightings]
    common = all(one.randomised for one in conditions)
    names = [shorten_name(one.lighting if common else str(one)) for one in conditions]
    return names, f"lights, all of them {RANDOMIZED}" if common else ""
