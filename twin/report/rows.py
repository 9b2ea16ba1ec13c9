"""Pictures for the page in which a person can judge the field: film, render, depth and error of one frame in a row.

The render has the lighting's own embedding, as it was learnt; nothing is fitted to the frame. *Error* is the mean over
red, green and blue of |render − film|, as a share of full brightness.
"""

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from twin.geometry.images import psnr, read_image, resize
from twin.report.panels import (
    AMBER,
    FARTHEST_DEPTH,
    GROUND,
    INK,
    MUTED,
    NEAREST_DEPTH,
    SUNKEN,
    Colour,
    Picture,
    depth_colours,
    depth_share,
    draw_text,
    fit,
    shorten,
    text_width,
)
from twin.report.studio import Studio, as_picture

PANEL = 320  # [px] longer side of each picture, and of what is rendered
MOST_ERROR = 0.3  # share of full brightness at the end of the error's colours
_DEPTH_TICKS = (2.0, 5.0, 10.0, 25.0)  # [m] between the ends
_GAP = 6  # [px]
_TEXT = 15  # [px]
_EDGE = 30  # [px] height of the lines above and below the pictures


def judged_row(studio: Studio, i: int) -> tuple[Picture, float]:
    """Frame i filmed, rendered, its depth and its error side by side with their scales; and its PSNR [dB]."""
    cameras = studio.cameras
    view = studio.frame_view(i, cameras.lightings[i], PANEL)
    rgb, depth = view.rgb[0], depth_colours(view.depth[0], view.opacity[0])
    height, width = depth.shape[:2]
    film = resize(read_image(cameras.image_path(i)), width, height) / 255.0
    path = cameras.mask_path(i)
    # Any ignored pixel spoils the mean it goes into.
    mask = None if path is None else resize((read_image(path)[..., 0] > 0).astype(np.float32), width, height) > 0.999
    score = psnr(rgb, film, mask)
    wrong = error_colours(np.abs(rgb - film).mean(-1), mask)
    bar = max(40, width - 16)
    far = [(float(depth_share(m)), f"{m:g}") for m in (NEAREST_DEPTH, *_DEPTH_TICKS)]
    far.append((1.0, f"{FARTHEST_DEPTH:g} m"))
    ramp = NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** np.linspace(0.0, 1.0, bar)
    errors = [(share, f"{100 * share * MOST_ERROR:.0f}") for share in (0.0, 1 / 3, 2 / 3)]
    errors.append((1.0, f"{100 * MOST_ERROR:.0f} %+"))
    unseen = ("never trained on", AMBER) if cameras.held_out[i] else ("trained on", MUTED)
    panels = [
        panel(fit(studio.real(i), (width, height)), "filmed", cameras.names[i], under(width, *unseen)),
        panel(as_picture(rgb), "rendered", f"{score:.1f} dB PSNR", under(width, "light as learnt, nothing fitted")),
        panel(depth, "depth", "grey: nothing solid", scale_bar(width, depth_colours(ramp[None]), far)),
        panel(
            wrong,
            "error",
            "of full brightness",
            scale_bar(width, error_colours(np.linspace(0, MOST_ERROR, bar)[None]), errors),
        ),
    ]
    gap = np.full((len(panels[0]), _GAP, 3), GROUND, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)] + [gap], 1), score


def error_colours(error: NDArray, mask: NDArray[np.bool_] | None = None) -> Picture:
    """Error as a share of full brightness, shape (h, w), as colours: dark is right, bright wrong; ignored is grey."""
    colours = (colormaps["viridis"](np.clip(error / MOST_ERROR, 0.0, 1.0))[..., :3] * 255 + 0.5).astype(np.uint8)
    if mask is not None:
        colours[~mask] = MUTED
    return colours


def scale_bar(width: int, ramp: Picture, labels: list[tuple[float, str]]) -> Picture:
    """A bar of colours over labels at shares of its length; those without room are left out."""
    out = np.full((2 * _EDGE - 10, width, 3), GROUND, np.uint8)
    bar = ramp.shape[1]
    left = (width - bar) // 2
    out[8:18, left : left + bar] = ramp[:1]
    free = left  # where the next label may begin
    last = width - text_width(labels[-1][1], _TEXT) - 2 * _GAP  # where the one at the end begins
    for k, (share, text) in enumerate(labels):
        at, half = left + round(share * (bar - 1)), text_width(text, _TEXT) // 2
        align = "left" if k == 0 else "right" if k == len(labels) - 1 else "middle"
        if align == "middle" and (at - half < free or at + half > last):
            continue
        out[18:22, at : at + 1] = INK
        draw_text(out, text, at, 24, _TEXT, INK, align=align)
        free = at + (2 if k == 0 else 1) * half + _GAP
    return out


def under(width: int, text: str, colour: Colour = MUTED) -> Picture:
    """A line of words as tall as a scale."""
    out = np.full((2 * _EDGE - 10, width, 3), GROUND, np.uint8)
    draw_text(out, shorten(text, width - 8, _TEXT), 4, 8, _TEXT, colour)
    return out


def panel(picture: Picture, title: str, note: str, below: Picture) -> Picture:
    """A picture between its title and what stands below."""
    width = picture.shape[1]
    head = np.full((_EDGE, width, 3), GROUND, np.uint8)
    draw_text(head, title, 4, 5, _TEXT, INK, True)
    free = width - text_width(title, _TEXT, True) - 20
    if note and free > 20:
        draw_text(head, shorten(note, free, _TEXT), width - 4, 5, _TEXT, MUTED, align="right")
    body = picture.copy()
    body[[0, -1]] = SUNKEN  # an edge where a picture is as dark as the ground
    return np.concatenate([head, body, below])
