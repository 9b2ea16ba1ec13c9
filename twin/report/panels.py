"""How a frame of the review film is laid out: a header, two *panels* side by side, and a *strip* below them.

Pictures are RGB uint8, shape (height, width, 3). A *box* is x, y, width, height [px] within the canvas. A *plate* is
text on a half transparent ground, so that it can be read over any picture.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from twin.geometry.images import resize
from twin.report.video import even

Picture = NDArray[np.uint8]
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
    canvas: Picture, text: str, x: int, y: int, size: int, colour: Colour = INK, bold: bool = False, align: str = "left"
) -> None:
    """Writes one line in place, its top at y; `align` says whether x is its left end, middle or right end."""
    width, height = text_width(text, size, bold) + 2, round(size * 1.35)
    x -= {"left": 0, "middle": width // 2, "right": width}[align]
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + width, canvas.shape[1]), min(y + height, canvas.shape[0])
    if right <= left or bottom <= top:
        return
    # Only the patch under the text goes through PIL: the whole canvas would be copied for every label.
    patch = Image.fromarray(canvas[top:bottom, left:right])
    ImageDraw.Draw(patch).text((x - left, y - top), text, font=font(size, bold), fill=colour)
    canvas[top:bottom, left:right] = np.asarray(patch)


def plate(
    canvas: Picture,
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


def fit(picture: NDArray, size: tuple[int, int]) -> Picture:
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


def depth_colours(depth: NDArray, opacity: NDArray | None = None) -> Picture:
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
class Layout:
    """Where things are on the canvas, for panels of a given size."""

    panel: tuple[int, int]
    """Width, height [px] of each of the two panels."""

    @staticmethod
    def for_pictures(width: int, aspect: float) -> "Layout":
        """Panels `width` wide for pictures of height / width = `aspect`; very tall or flat ones get bars."""
        return Layout((even(max(width, 160)), even(round(max(width, 160) * float(np.clip(aspect, 0.4, 1.0))))))

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

    def canvas(self, title: str, note: str = "") -> Picture:
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

    def card(self, title: str, lines: list[str], colour: Colour = ACCENT) -> Picture:
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


def place(canvas: Picture, picture: NDArray, box: Box) -> None:
    """Puts a picture into a box of the canvas, in place."""
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = fit(picture, (width, height))


def facts(canvas: Picture, box: Box, rows: list[tuple[str, str, Colour]], size: int) -> None:
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


def legend(canvas: Picture, box: Box, size: int) -> None:
    """The colour scale of `depth_colours` along the lower edge of a box."""
    x, y, width, height = box
    bar_width, bar_height = max(40, width // 3), max(5, size // 2)
    ramp = np.exp(np.linspace(0, np.log(FARTHEST_DEPTH / NEAREST_DEPTH), bar_width)) * NEAREST_DEPTH
    left, top = x + width - bar_width - 8, y + height - bar_height - 8
    canvas[top : top + bar_height, left : left + bar_width] = depth_colours(ramp[None])
    draw_text(canvas, f"{NEAREST_DEPTH:g} m", left, top - round(size * 1.4), size)
    draw_text(canvas, f"{FARTHEST_DEPTH:g} m", x + width - 8, top - round(size * 1.4), size, align="right")
