"""Layout of video frames, and functions that draw on them.

A frame has a header, two *panels* side by side, and a *strip* below the panels. Pictures are RGB uint8,
shape (height, width, 3). A *box* is x, y, width, height [px] within the canvas. Functions that take a canvas draw in
place.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
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
from twin.geometry.images import resize, to_uint8
from twin.mjcf.scene_xml import Parts
from twin.report.video_writer import even
from twin.types import Array, Image

Color = tuple[int, int, int]
Box = tuple[int, int, int, int]

BACKGROUND: Color = (16, 20, 26)
PANEL_BACKGROUND: Color = (28, 34, 43)
INK: Color = (236, 239, 244)
MUTED: Color = (150, 160, 174)
ACCENT: Color = (94, 190, 255)
AMBER: Color = (255, 190, 70)
RED: Color = (255, 107, 96)
GREEN: Color = (98, 214, 140)

_MARGIN = 12  # [px]
NEAREST_DEPTH, FARTHEST_DEPTH = 1.0, 60.0  # [m], ends of the depth color scale


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans as contained in matplotlib, so that videos look the same on all machines."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def text_width(text: str, size: int, bold: bool = False) -> int:
    return int(np.ceil(font(size, bold).getlength(text)))


def shorten(text: str, width: int, size: int, bold: bool = False) -> str:
    """Shortens text that is wider than `width` [px], and ends it with an ellipsis."""
    if text_width(text, size, bold) <= width:
        return text
    while text and text_width(text + "…", size, bold) > width:
        text = text[:-1]
    return text.rstrip() + "…"


def wrap(text: str, width: int, size: int, bold: bool = False) -> list[str]:
    """Breaks text into lines of at most `width` [px]. A single word that is wider is shortened."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_width(f"{lines[-1]} {word}", size, bold) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(shorten(word, width, size, bold))
    return lines


def draw_text(
    canvas: Image, text: str, x: int, y: int, size: int, color: Color = INK, bold: bool = False, align: str = "left"
) -> None:
    """Draws one line of text with its top at y. Its left end, middle or right end is at x, as `align` says."""
    width, height = text_width(text, size, bold) + 2, round(size * 1.35)
    x -= {"left": 0, "middle": width // 2, "right": width}[align]
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + width, canvas.shape[1]), min(y + height, canvas.shape[0])
    if right <= left or bottom <= top:
        return
    # PIL copies the picture on which it draws, so it gets only the patch under the text.
    patch = PILImage.fromarray(canvas[top:bottom, left:right])
    ImageDraw.Draw(patch).text((x - left, y - top), text, font=font(size, bold), fill=color)
    canvas[top:bottom, left:right] = np.asarray(patch)


def draw_label(
    canvas: Image, text: str, box: Box, corner: str = "top left", size: int = 14, color: Color = INK, bold: bool = False
) -> None:
    """Draws text on a half transparent background in a corner of a box ("top left", "bottom right", ...)."""
    x, y, width, height = box
    text = shorten(text, width - 24, size, bold)
    w, h = text_width(text, size, bold) + 14, round(size * 1.35) + 6
    left = x + 6 if "left" in corner else x + width - w - 6
    top = y + 6 if "top" in corner else y + height - h - 6
    left, top = max(left, 0), max(top, 0)
    under = canvas[top : top + h, left : left + w]
    under[:] = (under * 0.3 + np.array(BACKGROUND) * 0.7).astype(np.uint8)
    draw_text(canvas, text, left + 7, top + 3, size, color, bold)


def colored(name: str, shares: NDArray) -> Image:
    """Colors of values (h, w) in [0, 1], from the matplotlib colormap `name`."""
    return to_uint8(colormaps[name](shares)[..., :3])


def fit(picture: NDArray, size: tuple[int, int]) -> Image:
    """Scales a picture to fit into `size` (width, height) with its aspect kept, and centers it."""
    if picture.dtype != np.uint8:
        picture = to_uint8(picture)
    width, height = size
    scale = min(width / picture.shape[1], height / picture.shape[0])
    w, h = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    out = np.full((height, width, 3), PANEL_BACKGROUND, np.uint8)
    x, y = (width - w) // 2, (height - h) // 2
    scaled = cv2.resize(picture, (w, h), interpolation=cv2.INTER_CUBIC) if scale > 1 else resize(picture, w, h)
    out[y : y + h, x : x + w] = scaled
    return out


def depth_colors(depth: NDArray, opacity: NDArray | None = None) -> Image:
    """Colors of depths [m], shape (h, w), on a logarithmic scale: near is bright, far is dark.

    Pixels with `opacity` below one half get the color of an empty panel.
    """
    colors = colored("inferno", 1.0 - 0.86 * depth_scale(depth))
    if opacity is not None:
        colors[np.asarray(opacity) < 0.5] = PANEL_BACKGROUND
    return colors


def depth_scale(depth: NDArray | float) -> NDArray[np.float64]:
    """Positions of depths [m] on the scale of `depth_colors`: 0 is its near end, 1 its far end."""
    clipped = np.clip(np.nan_to_num(depth, nan=1e9), NEAREST_DEPTH, FARTHEST_DEPTH)
    return np.log(clipped / NEAREST_DEPTH) / np.log(FARTHEST_DEPTH / NEAREST_DEPTH)


@dataclass(frozen=True)
class FrameLayout:
    """Boxes and text sizes of a frame with panels of a given size."""

    panel: tuple[int, int]
    """Width, height [px] of a panel."""

    @staticmethod
    def for_pictures(width: int, aspect: float) -> "FrameLayout":
        """Layout with panels `width` [px] wide. Their height / width is `aspect`, clipped to [0.4, 1]."""
        return FrameLayout((even(max(width, 160)), even(round(max(width, 160) * float(np.clip(aspect, 0.4, 1.0))))))

    @property
    def strip_height(self) -> int:
        return even(round(max(0.34 * self.panel[0], 120)))

    @property
    def header(self) -> int:
        return even(round(max(0.1 * self.panel[0], 40)))

    @property
    def size(self) -> tuple[int, int]:
        """Width, height [px] of the canvas, both even."""
        return (
            even(2 * self.panel[0] + 3 * _MARGIN),
            even(self.header + self.panel[1] + self.strip_height + 2 * _MARGIN),
        )

    @property
    def text(self) -> int:
        """Size [px] of normal text, legible when the video plays at half its width."""
        return max(12, round(self.panel[0] / 30))

    @property
    def left(self) -> Box:
        return (_MARGIN, self.header, *self.panel)

    @property
    def right(self) -> Box:
        return (2 * _MARGIN + self.panel[0], self.header, *self.panel)

    def strip(self, *shares: float) -> tuple[Box, ...]:
        """Divides the strip below the panels by shares of its width."""
        free = self.size[0] - (len(shares) + 1) * _MARGIN
        ends = np.round(np.cumsum([0.0, *shares]) / sum(shares) * free).astype(int)
        y = self.header + self.panel[1] + _MARGIN
        return tuple(
            (int(_MARGIN * (i + 1) + ends[i]), y, int(ends[i + 1] - ends[i]), self.strip_height)
            for i in range(len(shares))
        )

    def canvas(self, title: str, note: str = "") -> Image:
        """An empty canvas with its header: title at the left, note at the right."""
        width, height = self.size
        out = np.full((height, width, 3), BACKGROUND, np.uint8)
        big = round(self.text * 1.25)
        y = (self.header - round(big * 1.3)) // 2
        beside = width - 4 * _MARGIN - text_width(title, big, bold=True)
        note = shorten(note, max(width // 3, beside), self.text)
        free = width - 4 * _MARGIN - text_width(note, self.text)
        draw_text(out, shorten(title, free, big, bold=True), _MARGIN, y, big, INK, bold=True)
        draw_text(out, note, width - _MARGIN, y + (big - self.text), self.text, MUTED, align="right")
        return out

    def draw_panels(self, canvas: Image, left: tuple[NDArray, str], right: tuple[NDArray, str] | None) -> None:
        """Draws the panels, each given by a picture and its label; None leaves the right panel empty."""
        for box, panel in ((self.left, left), (self.right, right)):
            if panel:
                paste(canvas, panel[0], box)
                draw_label(canvas, panel[1], box, size=self.text, bold=True)

    def draw_outcome(self, canvas: Image, text: str, success: bool) -> None:
        """Draws the end of a drive in a corner of the right panel."""
        draw_label(canvas, text, self.right, "bottom right", round(self.text * 1.2), GREEN if success else RED, True)

    def card(self, title: str, lines: list[str], color: Color = ACCENT) -> Image:
        width, height = self.size
        out = np.full((height, width, 3), BACKGROUND, np.uint8)
        big, small = round(self.text * 2), round(self.text * 1.2)
        inset = round(0.08 * width)
        wrapped = [part for line in lines for part in wrap(line, width - 2 * inset, small)]
        heads = wrap(title, width - 2 * inset, big, bold=True)
        block = len(heads) * round(big * 1.4) + 18 + len(wrapped) * round(small * 1.6)
        y = max(10, (height - block) // 2)
        out[y : y + block, inset - 14 : inset - 10] = color
        for head in heads:
            draw_text(out, head, inset, y, big, INK, bold=True)
            y += round(big * 1.4)
        y += 18
        for line in wrapped:
            draw_text(out, line, inset, y, small, MUTED)
            y += round(small * 1.6)
        return out


def paste(canvas: Image, picture: NDArray, box: Box) -> None:
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = fit(picture, (width, height))


def draw_facts(canvas: Image, box: Box, rows: list[tuple[str, str, Color]], size: int) -> None:
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = PANEL_BACKGROUND
    step = min(round(size * 1.75), (height - 8) // max(1, len(rows)))
    size = min(size, round(step * 0.72))
    y += (height - step * len(rows)) // 2
    for name, value, color in rows:
        draw_text(canvas, name, x + 10, y, size, MUTED)
        free = width - 30 - text_width(name, size)
        draw_text(canvas, shorten(value, free, size, bold=True), x + width - 10, y, size, color, True, "right")
        y += step


def draw_depth_legend(canvas: Image, box: Box, size: int) -> None:
    """Draws the color scale of `depth_colors` along the lower edge of a box."""
    x, y, width, height = box
    bar_width, bar_height = max(40, width // 3), max(5, size // 2)
    ramp = np.exp(np.linspace(0, np.log(FARTHEST_DEPTH / NEAREST_DEPTH), bar_width)) * NEAREST_DEPTH
    left, top = x + width - bar_width - 8, y + height - bar_height - 8
    canvas[top : top + bar_height, left : left + bar_width] = depth_colors(ramp[None])
    draw_text(canvas, f"{NEAREST_DEPTH:g} m", left, top - round(size * 1.4), size)
    draw_text(canvas, f"{FARTHEST_DEPTH:g} m", x + width - 8, top - round(size * 1.4), size, align="right")


def draw_slider(canvas: Image, box: Box, lightings: tuple[str, ...], at: float, size: int) -> None:
    """Draws a slider with a stop per lighting. `at` is the knob's position: 0 is the first stop, 1 the second, ..."""
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = PANEL_BACKGROUND
    left, right, middle = x + round(0.08 * width), x + round(0.92 * width), y + height // 2
    stops = np.linspace(left, right, len(lightings)).round().astype(int)
    canvas[middle - 2 : middle + 2, left:right] = MUTED
    room = (right - left) // max(1, len(lightings) - 1)
    for k, (stop, name) in enumerate(zip(stops, lightings, strict=True)):
        canvas[middle - 7 : middle + 7, stop - 2 : stop + 2] = INK
        near = abs(at - k) < 0.5
        align = "left" if k == 0 else "right" if k == len(lightings) - 1 else "middle"
        edge = x + 12 if k == 0 else x + width - 12 if k == len(lightings) - 1 else int(stop)
        text = shorten(name, room - 8, size, near)
        draw_text(canvas, text, edge, middle + 16, size, GREEN if near else MUTED, near, align)
    knob = round(left + (right - left) * at / max(1, len(lightings) - 1))
    canvas[middle - 10 : middle + 10, knob - 5 : knob + 5] = AMBER
    draw_text(canvas, "appearance", x + 12, y + 8, size, MUTED)


# ---- rows of panels

_GAP = 6  # [px] between panels
_TEXT = 15  # [px] text size
_HEAD, _BELOW = 30, 50  # [px] heights of the title above a panel, and of the caption or scale below it


def scale_bar(width: int, ramp: Image, labels: list[tuple[float, str]]) -> Image:
    """Draws a color bar with labels at shares of its length. Labels that would overlap others are left out."""
    out = np.full((_BELOW, width, 3), BACKGROUND, np.uint8)
    bar = ramp.shape[1]
    left = (width - bar) // 2
    out[8:18, left : left + bar] = ramp[:1]
    free = left  # the next label must start to the right of this
    last = width - text_width(labels[-1][1], _TEXT) - 2 * _GAP  # left end of the last label
    for k, (share, text) in enumerate(labels):
        at, half = left + round(share * (bar - 1)), text_width(text, _TEXT) // 2
        align = "left" if k == 0 else "right" if k == len(labels) - 1 else "middle"
        if align == "middle" and (at - half < free or at + half > last):
            continue
        out[18:22, at : at + 1] = INK
        draw_text(out, text, at, 24, _TEXT, INK, align=align)
        free = at + (2 if k == 0 else 1) * half + _GAP
    return out


def caption_line(width: int, text: str, color: Color = MUTED) -> Image:
    out = np.full((_BELOW, width, 3), BACKGROUND, np.uint8)
    draw_text(out, shorten(text, width - 8, _TEXT), 4, 8, _TEXT, color)
    return out


def titled_panel(picture: Image, title: str, note: str, below: Image) -> Image:
    width = picture.shape[1]
    head = np.full((_HEAD, width, 3), BACKGROUND, np.uint8)
    draw_text(head, title, 4, 5, _TEXT, INK, True)
    free = width - text_width(title, _TEXT, True) - 20
    if note and free > 20:
        draw_text(head, shorten(note, free, _TEXT), width - 4, 5, _TEXT, MUTED, align="right")
    body = picture.copy()
    body[[0, -1]] = PANEL_BACKGROUND  # shows the edge of a picture that is as dark as the background
    return np.concatenate([head, body, below])


def panel_row(panels: Sequence[Image]) -> Image:
    """Panels of one height beside each other, with gaps between and around them."""
    gap = np.full((len(panels[0]), _GAP, 3), BACKGROUND, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)] + [gap], 1)


def side_by_side(pictures: Sequence[Image], height: int) -> Image:
    """Concatenates pictures in a row, scaled to one height, with thin gaps."""
    gap = np.full((height, 6, 3), 255, np.uint8)
    row: list[Image] = []
    for picture in pictures:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        interpolation = cv2.INTER_AREA if picture.shape[0] > height else cv2.INTER_CUBIC
        row += [gap, cv2.resize(picture, (width, height), interpolation=interpolation).astype(np.uint8)]
    return np.concatenate(row[1:], 1)


# ---- map

_MAP_MARGIN = 5.0  # [m] around the path
_MAX_HEIGHT = 3.0  # [m] above the ground; the robot does not reach parts that are entirely higher
_SUBPIXEL_BITS = 4  # fixed-point precision of OpenCV's drawing


def footprints(parts: Parts, ground: Ground) -> list[Array]:
    """Outlines of convex parts from above, each shape (k, 2) [m], counterclockwise.

    Parts that are entirely more than `_MAX_HEIGHT` above the ground are dropped.
    """
    outlines = []
    for vertices in parts.vertices:
        part = vertices.astype(np.float64)
        if (part[:, 2] - ground.at(part[:, :2])).min() > _MAX_HEIGHT:
            continue
        try:
            outlines.append(part[ConvexHull(part[:, :2]).vertices, :2])
        except (QhullError, ValueError):  # degenerate: a vertical sheet has no area from above
            continue
    return outlines


def map_rotation(path: Array) -> Array:
    """Rotation (2, 2) that turns the longest extent of a path (n, 2) to the x axis, with its start at the left."""
    centered = path - path.mean(0)
    axis = np.linalg.svd(centered, full_matrices=False)[2][0] if len(path) > 1 else np.array([1.0, 0.0])
    if (path[-1] - path[0]) @ axis < 0:
        axis = -axis
    return np.array([axis, [-axis[1], axis[0]]])


@dataclass(frozen=True)
class MapView:
    """The scene from above: ground colors, corridor, convex parts and path.

    The map is rotated so that the longest extent of the path runs from left to right. Pixels are (column, row).
    """

    picture: Image
    to_pixel: Array
    """Affine map of (x, y, 1) [m] to pixels, shape (2, 3)."""

    @staticmethod
    def draw(
        size: tuple[int, int],
        path: Array,
        ground: Ground | None = None,
        parts: list[Array] | None = None,
        half_width: float = 0.0,
    ) -> "MapView":
        """Draws the static map, centered on a path (n, 2) [m], for an image of `size` (width, height) [px].

        `parts` are outlines from `footprints`. A corridor of half width 0 [m] is not drawn.
        """
        to_pixel = _map_transform(path, size)
        scale = float(np.hypot(*to_pixel[:, 0]))
        picture: Image = np.full((size[1], size[0], 3), PANEL_BACKGROUND, np.uint8)
        if ground is not None:
            cell = np.array([[ground.cell, 0, ground.origin[0]], [0, ground.cell, ground.origin[1]], [0, 0, 1]])
            warp = to_pixel @ cell
            colors = cv2.warpAffine(ground.rgb, warp, size, flags=cv2.INTER_LINEAR).astype(np.float64)
            coverage = cv2.warpAffine(ground.measured.astype(np.uint8) * 255, warp, size)[..., None] / 255.0
            picture = (picture * (1 - coverage) + (0.25 * picture + 0.75 * colors) * coverage).astype(np.uint8)
        if half_width > 0.0:
            over = picture.copy()
            _draw_line(over, _to_pixels(to_pixel, path), GREEN, max(1, round(2 * half_width * scale)))
            picture = (picture * 0.7 + over * 0.3).astype(np.uint8)
        for outline in parts or []:
            corners = (_to_pixels(to_pixel, outline) * 2**_SUBPIXEL_BITS).round().astype(np.int32)
            cv2.fillPoly(picture, [corners], (120, 74, 70), cv2.LINE_AA, _SUBPIXEL_BITS)
            cv2.polylines(picture, [corners], True, RED, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        _draw_line(picture, _to_pixels(to_pixel, path), INK, 1)
        return MapView(picture, to_pixel)

    def with_marker(
        self, position: Array, heading: Array, trail: Array | None = None, dots: Array | None = None
    ) -> Image:
        """Returns a copy of the picture with an arrow at `position` [m], pointing along `heading`, both of shape (≥2,).

        `trail` [m], shape (n, 2), is drawn as a line, and `dots` [m], shape (n, 2), as dots.
        """
        out = self.picture.copy()
        if trail is not None and len(trail) > 1:
            _draw_line(out, _to_pixels(self.to_pixel, trail), AMBER, 2)
        for center in _to_pixels(self.to_pixel, dots).round().astype(int) if dots is not None else ():
            cv2.circle(out, (int(center[0]), int(center[1])), 1, ACCENT, -1, cv2.LINE_AA)
        at = _to_pixels(self.to_pixel, position[None, :2])[0]
        ahead = self.to_pixel[:, :2] @ heading[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        side = np.array([-ahead[1], ahead[0]])
        length = max(7.0, out.shape[0] / 14)
        arrow = np.array([at + ahead * length, at - ahead * length * 0.7 + side * length * 0.65,
                          at - ahead * length * 0.35, at - ahead * length * 0.7 - side * length * 0.65])  # fmt: skip
        corners = (arrow * 2**_SUBPIXEL_BITS).round().astype(np.int32)
        cv2.fillPoly(out, [corners], AMBER, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.polylines(out, [corners], True, (0, 0, 0), 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        return out


def _map_transform(path: Array, size: tuple[int, int]) -> Array:
    """Affine map (2, 3) from [m] to [px]. It rotates the path and fits it with a margin into `size`."""
    turn = map_rotation(path)
    turned = path @ turn.T
    low, high = turned.min(0) - _MAP_MARGIN, turned.max(0) + _MAP_MARGIN
    scale = min(size[0] / (high[0] - low[0]), size[1] / (high[1] - low[1]))
    flip = np.diag([1.0, -1.0])  # rows of a picture count downwards
    center = (low + high) / 2
    linear = scale * flip @ turn
    return np.column_stack([linear, np.array(size) / 2 - scale * flip @ center])


def _to_pixels(to_pixel: Array, xy: Array) -> Array:
    return xy @ to_pixel[:, :2].T + to_pixel[:, 2]


def _draw_line(picture: Image, pixels: Array, color: Color, thickness: int) -> None:
    points = (pixels * 2**_SUBPIXEL_BITS).round().astype(np.int32)
    cv2.polylines(picture, [points], False, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
