"""How a frame of the review film is laid out: a header, two *panels* side by side, and a *strip* below them.

Pictures are RGB uint8, shape (height, width, 3). A *box* is x, y, width, height [px] within the canvas. A *plate* is
text on a half transparent ground, so that it can be read over any picture.
"""

import functools
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import ImageDraw, ImageFont
from scipy.spatial import ConvexHull, QhullError

from twin.assets.ground import Ground
from twin.geometry.images import resize
from twin.report.video_writer import even
from twin.types import Array, Image

Colour = tuple[int, int, int]
Box = tuple[int, int, int, int]

GROUND: Colour = (16, 20, 26)
SUNKEN: Colour = (28, 34, 43)
INK: Colour = (236, 239, 244)
MUTED: Colour = (150, 160, 174)
ACCENT: Colour = (94, 190, 255)
AMBER: Colour = (255, 190, 70)
RED: Colour = (255, 107, 96)
GREEN: Colour = (98, 214, 140)

_MARGIN = 12  # [px]
NEAREST_DEPTH, FARTHEST_DEPTH = 1.0, 60.0  # [m], ends of the depth colours


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib ships, so that the film looks the same on a machine without fonts."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def text_width(text: str, size: int, bold: bool = False) -> int:
    """Width [px] of one line of text."""
    return int(np.ceil(font(size, bold).getlength(text)))


def shorten(text: str, width: int, size: int, bold: bool = False) -> str:
    """The text, cut with an ellipsis where it is wider than `width` [px]."""
    if text_width(text, size, bold) <= width:
        return text
    while text and text_width(text + "…", size, bold) > width:
        text = text[:-1]
    return text.rstrip() + "…"


def wrap(text: str, width: int, size: int, bold: bool = False) -> list[str]:
    """Breaks text into lines no wider than `width` [px]; a single word that is wider is cut."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_width(f"{lines[-1]} {word}", size, bold) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(shorten(word, width, size, bold))
    return lines


def draw_text(
    canvas: Image, text: str, x: int, y: int, size: int, colour: Colour = INK, bold: bool = False, align: str = "left"
) -> None:
    """Writes one line in place, its top at y; `align` says whether x is its left end, middle or right end."""
    width, height = text_width(text, size, bold) + 2, round(size * 1.35)
    x -= {"left": 0, "middle": width // 2, "right": width}[align]
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + width, canvas.shape[1]), min(y + height, canvas.shape[0])
    if right <= left or bottom <= top:
        return
    # Only the patch under the text goes through PIL: the whole canvas would be copied for every label.
    patch = PILImage.fromarray(canvas[top:bottom, left:right])
    ImageDraw.Draw(patch).text((x - left, y - top), text, font=font(size, bold), fill=colour)
    canvas[top:bottom, left:right] = np.asarray(patch)


def plate(
    canvas: Image,
    text: str,
    box: Box,
    corner: str = "top left",
    size: int = 14,
    colour: Colour = INK,
    bold: bool = False,
) -> None:
    """Writes text in a corner of a box ("top left", "bottom right", ...), in place."""
    x, y, width, height = box
    text = shorten(text, width - 24, size, bold)
    w, h = text_width(text, size, bold) + 14, round(size * 1.35) + 6
    left = x + 6 if "left" in corner else x + width - w - 6
    top = y + 6 if "top" in corner else y + height - h - 6
    left, top = max(left, 0), max(top, 0)
    under = canvas[top : top + h, left : left + w]
    under[:] = (under * 0.3 + np.array(GROUND) * 0.7).astype(np.uint8)
    draw_text(canvas, text, left + 7, top + 3, size, colour, bold)


def fit(picture: NDArray, size: tuple[int, int]) -> Image:
    """Scales a picture to fit into `size` (width, height), centred, keeping its proportions."""
    if picture.dtype != np.uint8:
        picture = (np.clip(np.nan_to_num(picture), 0, 1) * 255 + 0.5).astype(np.uint8)
    width, height = size
    scale = min(width / picture.shape[1], height / picture.shape[0])
    w, h = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    out = np.empty((height, width, 3), np.uint8)
    out[:] = SUNKEN
    x, y = (width - w) // 2, (height - h) // 2
    scaled = cv2.resize(picture, (w, h), interpolation=cv2.INTER_CUBIC) if scale > 1 else resize(picture, w, h)
    out[y : y + h, x : x + w] = scaled
    return out


def depth_colours(depth: NDArray, opacity: NDArray | None = None) -> Image:
    """Depth [m], shape (h, w), as colours: bright is near, dark is far, on a logarithmic scale.

    Where `opacity` is below one half nothing solid was found, and the colour is that of an empty panel.
    """
    colours = (colormaps["inferno"](1.0 - 0.86 * depth_share(depth))[..., :3] * 255 + 0.5).astype(np.uint8)
    if opacity is not None:
        colours[np.asarray(opacity) < 0.5] = SUNKEN
    return colours


def depth_share(depth: NDArray | float) -> NDArray[np.float64]:
    """Where depths [m] lie on the scale of `depth_colours`: 0 at its near end, 1 at its far end."""
    known = np.clip(np.nan_to_num(depth, nan=1e9), NEAREST_DEPTH, FARTHEST_DEPTH)
    return np.log(known / NEAREST_DEPTH) / np.log(FARTHEST_DEPTH / NEAREST_DEPTH)


@dataclass(frozen=True)
class FrameLayout:
    """Where things are on the canvas, for panels of a given size."""

    panel: tuple[int, int]
    """Width, height [px] of each of the two panels."""

    @staticmethod
    def for_pictures(width: int, aspect: float) -> "FrameLayout":
        """Panels `width` wide for pictures of height / width = `aspect`; very tall or flat ones get bars."""
        return FrameLayout((even(max(width, 160)), even(round(max(width, 160) * float(np.clip(aspect, 0.4, 1.0))))))

    @property
    def strip_height(self) -> int:
        return even(round(max(0.34 * self.panel[0], 120)))

    @property
    def header(self) -> int:
        return even(round(max(0.1 * self.panel[0], 40)))

    @property
    def size(self) -> tuple[int, int]:
        """Width, height [px] of the canvas; even."""
        return (
            even(2 * self.panel[0] + 3 * _MARGIN),
            even(self.header + self.panel[1] + self.strip_height + 2 * _MARGIN),
        )

    @property
    def text(self) -> int:
        """Size [px] of ordinary text, legible when the film is seen at half its width."""
        return max(12, round(self.panel[0] / 30))

    @property
    def left(self) -> Box:
        return (_MARGIN, self.header, *self.panel)

    @property
    def right(self) -> Box:
        return (2 * _MARGIN + self.panel[0], self.header, *self.panel)

    def strip(self, *shares: float) -> tuple[Box, ...]:
        """The strip below the panels, divided by shares of its width."""
        free = self.size[0] - (len(shares) + 1) * _MARGIN
        ends = np.round(np.cumsum([0.0, *shares]) / sum(shares) * free).astype(int)
        y = self.header + self.panel[1] + _MARGIN
        return tuple(
            (int(_MARGIN * (i + 1) + ends[i]), y, int(ends[i + 1] - ends[i]), self.strip_height)
            for i in range(len(shares))
        )

    def canvas(self, title: str, note: str = "") -> Image:
        """An empty canvas with its header: the title on the left, a note on the right."""
        width, height = self.size
        out = np.empty((height, width, 3), np.uint8)
        out[:] = GROUND
        big = round(self.text * 1.25)
        y = (self.header - round(big * 1.3)) // 2
        note = shorten(note, width // 3, self.text)
        free = width - 4 * _MARGIN - text_width(note, self.text)
        draw_text(out, shorten(title, free, big, bold=True), _MARGIN, y, big, INK, bold=True)
        draw_text(out, note, width - _MARGIN, y + (big - self.text), self.text, MUTED, align="right")
        return out

    def card(self, title: str, lines: list[str], colour: Colour = ACCENT) -> Image:
        """A title card: what comes next, and what to look for."""
        width, height = self.size
        out = np.empty((height, width, 3), np.uint8)
        out[:] = GROUND
        big, small = round(self.text * 2), round(self.text * 1.2)
        inset = round(0.08 * width)
        wrapped = [part for line in lines for part in wrap(line, width - 2 * inset, small)]
        heads = wrap(title, width - 2 * inset, big, bold=True)
        block = len(heads) * round(big * 1.4) + 18 + len(wrapped) * round(small * 1.6)
        y = max(10, (height - block) // 2)
        out[y : y + block, inset - 14 : inset - 10] = colour
        for head in heads:
            draw_text(out, head, inset, y, big, INK, bold=True)
            y += round(big * 1.4)
        y += 18
        for line in wrapped:
            draw_text(out, line, inset, y, small, MUTED)
            y += round(small * 1.6)
        return out


def place(canvas: Image, picture: NDArray, box: Box) -> None:
    """Puts a picture into a box of the canvas, in place."""
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = fit(picture, (width, height))


def facts(canvas: Image, box: Box, rows: list[tuple[str, str, Colour]], size: int) -> None:
    """A small table in a box: name on the left, value on the right in its colour."""
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = SUNKEN
    step = min(round(size * 1.75), (height - 8) // max(1, len(rows)))
    size = min(size, round(step * 0.72))
    y += (height - step * len(rows)) // 2
    for name, value, colour in rows:
        draw_text(canvas, name, x + 10, y, size, MUTED)
        free = width - 30 - text_width(name, size)
        draw_text(canvas, shorten(value, free, size, bold=True), x + width - 10, y, size, colour, True, "right")
        y += step


def legend(canvas: Image, box: Box, size: int) -> None:
    """The colour scale of `depth_colours` along the lower edge of a box."""
    x, y, width, height = box
    bar_width, bar_height = max(40, width // 3), max(5, size // 2)
    ramp = np.exp(np.linspace(0, np.log(FARTHEST_DEPTH / NEAREST_DEPTH), bar_width)) * NEAREST_DEPTH
    left, top = x + width - bar_width - 8, y + height - bar_height - 8
    canvas[top : top + bar_height, left : left + bar_width] = depth_colours(ramp[None])
    draw_text(canvas, f"{NEAREST_DEPTH:g} m", left, top - round(size * 1.4), size)
    draw_text(canvas, f"{FARTHEST_DEPTH:g} m", x + width - 8, top - round(size * 1.4), size, align="right")


# ---- The place seen from above, for the strip of the film: ground colours, corridor, solid parts, and where we are.
#
# The plan is turned so that the path runs from left to right along its longest extent. *Plan pixels* are (column, row).


_SIDE = 5.0  # [m] shown beside the path
_SUPERSAMPLE = 4  # bits of sub-pixel precision for OpenCV's line drawing


def footprints(
    vertices: NDArray, vertex_start: NDArray, above: Ground | None = None, reach: float = 3.0
) -> list[Array]:
    """Outlines from above of convex parts, each shape (k, 2) [m], anticlockwise.

    Args:
        vertices: All parts' vertices [m], shape (v, 3).
        vertex_start: Where each part begins, shape (parts + 1,).
        above: If given, parts that begin more than `reach` above this ground are left out: nothing drives into them.
        reach: See `above` [m].
    """
    outlines = []
    for start, end in pairwise(vertex_start):
        part = np.asarray(vertices[start:end], np.float64)
        if above is not None and (part[:, 2] - above.at(part[:, :2])).min() > reach:
            continue
        try:
            outlines.append(part[ConvexHull(part[:, :2]).vertices, :2])
        except (QhullError, ValueError):  # seen edge on: a line, which covers no ground
            continue
    return outlines


def turn_of(path: Array) -> Array:
    """Rotation, shape (2, 2), that lays the longest extent of a path (n, 2) along +x, its start to the left."""
    centred = path - path.mean(0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0] if len(path) > 1 else np.array([1.0, 0.0])
    if (path[-1] - path[0]) @ axis < 0:
        axis = -axis
    return np.array([axis, [-axis[1], axis[0]]])


@dataclass(frozen=True)
class MapView:
    """A picture of the place from above and the way from metres into it."""

    picture: Image
    to_pixel: Array
    """Affine map of (x, y, 1) [m] to plan pixels, shape (2, 3)."""

    @staticmethod
    def draw(
        size: tuple[int, int],
        path: Array,
        ground: Ground | None = None,
        parts: list[Array] | None = None,
        half_width: float = 0.0,
    ) -> "MapView":
        """Draws what stays the same throughout the film.

        Args:
            size: Width, height [px].
            path: What the plan is centred on [m], shape (n, 2).
            ground: Colours the plan where it was measured.
            parts: Outlines from `footprints`.
            half_width: Of the drivable corridor around the path [m]; 0 = none is drawn.
        """
        to_pixel = _fit(path, size)
        scale = float(np.hypot(*to_pixel[:, 0]))
        picture: Image = np.empty((size[1], size[0], 3), np.uint8)
        picture[:] = SUNKEN
        if ground is not None:
            cell = np.array([[ground.cell, 0, ground.origin[0]], [0, ground.cell, ground.origin[1]], [0, 0, 1]])
            warp = to_pixel @ cell
            colours = cv2.warpAffine(ground.rgb, warp, size, flags=cv2.INTER_LINEAR).astype(np.float64)
            seen = cv2.warpAffine(ground.measured.astype(np.uint8) * 255, warp, size)[..., None] / 255.0
            picture = (picture * (1 - seen) + (0.25 * picture + 0.75 * colours) * seen).astype(np.uint8)
        if half_width > 0.0:
            over = picture.copy()
            _line(over, _pixels(to_pixel, path), GREEN, max(1, round(2 * half_width * scale)))
            picture = (picture * 0.7 + over * 0.3).astype(np.uint8)
        for outline in parts or []:
            corners = (_pixels(to_pixel, outline) * 2**_SUPERSAMPLE).round().astype(np.int32)
            cv2.fillPoly(picture, [corners], (120, 74, 70), cv2.LINE_AA, _SUPERSAMPLE)
            cv2.polylines(picture, [corners], True, RED, 1, cv2.LINE_AA, _SUPERSAMPLE)
        _line(picture, _pixels(to_pixel, path), INK, 1)
        return MapView(picture, to_pixel)

    def with_marker(
        self, position: Array, heading: Array, trail: Array | None = None, dots: Array | None = None
    ) -> Image:
        """A copy with an arrow at a position along a heading.

        Args:
            position: Shape (≥2,) [m].
            heading: Any length, shape (≥2,).
            trail: The way gone so far [m], shape (n, 2), drawn as a line.
            dots: Other places [m], shape (n, 2), drawn as dots.
        """
        out = self.picture.copy()
        if trail is not None and len(trail) > 1:
            _line(out, _pixels(self.to_pixel, trail), AMBER, 2)
        for centre in _pixels(self.to_pixel, dots).round().astype(int) if dots is not None else ():
            cv2.circle(out, (int(centre[0]), int(centre[1])), 1, ACCENT, -1, cv2.LINE_AA)
        at = _pixels(self.to_pixel, position[None, :2])[0]
        ahead = self.to_pixel[:, :2] @ heading[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        side = np.array([-ahead[1], ahead[0]])
        length = max(7.0, out.shape[0] / 14)
        arrow = np.array([at + ahead * length, at - ahead * length * 0.7 + side * length * 0.65,
                          at - ahead * length * 0.35, at - ahead * length * 0.7 - side * length * 0.65])  # fmt: skip
        corners = (arrow * 2**_SUPERSAMPLE).round().astype(np.int32)
        cv2.fillPoly(out, [corners], AMBER, cv2.LINE_AA, _SUPERSAMPLE)
        cv2.polylines(out, [corners], True, (0, 0, 0), 1, cv2.LINE_AA, _SUPERSAMPLE)
        return out


def _fit(path: Array, size: tuple[int, int]) -> Array:
    """The affine map that shows the turned path and `_SIDE` metres around it as large as possible."""
    turn = turn_of(path)
    turned = path @ turn.T
    low, high = turned.min(0) - _SIDE, turned.max(0) + _SIDE
    scale = min(size[0] / (high[0] - low[0]), size[1] / (high[1] - low[1]))
    flip = np.diag([1.0, -1.0])  # rows count downwards
    centre = (low + high) / 2
    linear = scale * flip @ turn
    return np.column_stack([linear, np.array(size) / 2 - scale * flip @ centre])


def _pixels(to_pixel: Array, xy: Array) -> Array:
    return xy @ to_pixel[:, :2].T + to_pixel[:, 2]


def _line(picture: Image, pixels: Array, colour: Colour, thickness: int) -> None:
    points = (pixels * 2**_SUPERSAMPLE).round().astype(np.int32)
    cv2.polylines(picture, [points], False, colour, thickness, cv2.LINE_AA, _SUPERSAMPLE)
