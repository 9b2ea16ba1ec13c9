"""Procedural textures: RGB in [0, 1], shape (rows, columns, 3), with detail at every scale; and the atlas.

Nothing repeats along the road, since a repeating texture causes false matches in structure from motion. Each texture
has its own random generator, so a change of one does not change the others. An *atlas* is one image with a square cell
for each small surface, from bark to windows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.reality.place_objects import ATLAS_CELL, atlas_shape
from twin.reality.place_spec import Rgb
from twin.types import Array32

ARROW = ((-1.6, -0.08), (0.4, -0.08), (0.4, -0.3), (1.3, 0.0), (0.4, 0.3), (0.4, 0.08), (-1.6, 0.08))
"""Outline of an arrow on the road: along and across it [m]."""
CHIPS = np.array([[0.55, 0.54, 0.52], [0.22, 0.22, 0.22], [0.47, 0.43, 0.39], [0.17, 0.17, 0.18]], np.float32)
"""Colors of the stones in asphalt and concrete."""


def fbm(rng: np.random.Generator, shape: tuple[int, int], coarsest: float, finest: float = 1.0, gain: float = 0.7):
    """Fractal noise with zero mean and unit standard deviation: octaves from `coarsest` to `finest` pixels."""
    out = np.zeros(shape, np.float32)
    size, weight = coarsest, 1.0
    while size >= finest:
        rows, columns = int(shape[0] / size) + 3, int(shape[1] / size) + 3
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        zoom = cv2.resize(grid, (int(columns * size), int(rows * size)), interpolation=cv2.INTER_CUBIC)
        off_r, off_c = (int(rng.integers(0, max(1, z - n))) for z, n in zip(zoom.shape, shape, strict=True))
        out += weight * zoom[off_r : off_r + shape[0], off_c : off_c + shape[1]]
        size, weight = size / 2.0, weight * gain
    return (out - out.mean()) / out.std()


def blend(image: NDArray, color: ArrayLike, weight: NDArray) -> None:
    """Blends a color into an image, in place; `weight` in [0, 1], shape (rows, columns)."""
    w = weight[..., None].astype(np.float32)
    image += w * (np.asarray(color, np.float32) - image)


def tinted(base: ArrayLike, noise: NDArray, contrast: float, tint: NDArray | None = None) -> Array32:
    """A color modulated by noise with zero mean; positive values of `tint` shift it to warm, negative ones to cold."""
    image = np.asarray(base, np.float32) * (1.0 + contrast * noise[..., None].astype(np.float32))
    if tint is not None:
        image = image * (1.0 + tint[..., None] * np.array([0.10, 0.02, -0.10], np.float32))
    return image.astype(np.float32)


def speckle(rng: np.random.Generator, image: NDArray, count: int, sizes: tuple[float, float], colors: NDArray) -> None:
    """Draws small random ellipses (chips, fallen leaves, stones) into an image, in place."""
    rows, columns = image.shape[:2]
    centers = np.stack([rng.uniform(0, columns, count), rng.uniform(0, rows, count)], -1)
    axes = rng.uniform(*sizes, (count, 2))
    angles = rng.uniform(0, 180, count)
    picks = rng.integers(0, len(colors), count)
    shade = rng.uniform(0.7, 1.3, count)
    for center, axis, angle, pick, light in zip(centers, axes, angles, picks, shade, strict=True):
        color = tuple(float(c * light) for c in colors[pick])
        shift = 4  # fractional bits of the coordinates
        cv2.ellipse(
            image,
            [int(c * 2**shift) for c in center],
            [max(1, int(a * 2**shift)) for a in axis],
            float(angle),
            0.0,
            360.0,
            color,
            -1,
            cv2.LINE_AA if image.dtype == np.uint8 else cv2.LINE_8,
            shift,
        )


def grains(rng: np.random.Generator, image: Array32, share: float, colors: NDArray) -> None:
    """Recolors a fraction `share` of the texels, in place, like the stones in asphalt."""
    hit = rng.random(image.shape[:2]) < share
    shade = rng.uniform(0.75, 1.15, (int(hit.sum()), 1))
    image[hit] = 0.35 * image[hit] + 0.65 * colors[rng.integers(0, len(colors), int(hit.sum()))] * shade


def crack(rng: np.random.Generator, mask: NDArray, start: NDArray, heading: float, length: float, width: float) -> None:
    """Draws a wandering, branching crack into `mask`."""
    point = start.astype(float)
    step = 6.0
    for _ in range(int(length / step)):
        heading += rng.normal(0.0, 0.28)
        ahead = point + step * np.array([np.cos(heading), np.sin(heading)])
        cv2.line(mask, point.astype(int).tolist(), ahead.astype(int).tolist(), 1.0, max(1, round(width)))
        point = ahead
        if length > 60 and rng.random() < 0.05:
            crack(rng, mask, point, heading + rng.choice([-1, 1]) * rng.uniform(0.5, 1.2), length * 0.35, width * 0.7)


def add_cracks(
    rng: np.random.Generator,
    image: NDArray,
    count: int,
    widths: tuple[float, float],
    color: Rgb,
    weight: float,
) -> None:
    """Draws cracks along and across a road into its image, in place; `widths` is their range [px]."""
    rows, columns = image.shape[:2]
    mask = np.zeros((rows, columns), np.float32)
    for _ in range(count):
        start = np.array([rng.uniform(0, columns), rng.uniform(0, rows)])
        heading = (np.pi / 2 if rng.random() < 0.45 else 0.0) + rng.normal(0, 0.25) + rng.integers(0, 2) * np.pi
        crack(rng, mask, start, heading, rng.uniform(40, 330), rng.uniform(*widths))
    blend(image, color, weight * cv2.GaussianBlur(mask, (3, 3), 0.6))


def add_patch(rng: np.random.Generator, part: NDArray, tone: ArrayLike) -> None:
    """Turns a part of a road's image into a repaired patch of another tone with a tarred seam, in place."""
    rows, columns = part.shape[:2]
    fresh = tinted(tone, fbm(rng, (rows, columns), 30, 2.0), 0.14)
    grains(rng, fresh, rng.uniform(0.05, 0.2), CHIPS)
    part[:] = 0.25 * part + 0.75 * fresh
    seam = np.zeros((rows, columns), np.float32)
    cv2.rectangle(seam, (1, 1), (columns - 2, rows - 2), 1.0, int(rng.integers(2, 4)))
    worn = np.clip(0.6 + 0.4 * fbm(rng, seam.shape, 40, 3.0), 0.0, 0.9)
    blend(part, (0.12, 0.12, 0.125), seam * worn)


def add_stain(image: Array32, center: tuple[float, float], radius: float) -> None:
    """Darkens a round spot, in place; center (column, row) and radius [px]."""
    rows, columns = image.shape[:2]
    r0, r1 = max(0, int(center[1] - radius)), min(rows, int(center[1] + radius) + 1)
    c0, c1 = max(0, int(center[0] - radius)), min(columns, int(center[0] + radius) + 1)
    rr, cc = np.mgrid[r0:r1, c0:c1]
    blob = np.clip(1.6 - np.hypot(rr - center[1], cc - center[0]) / (0.6 * radius), 0, 1)
    blend(image[r0:r1, c0:c1], (0.12, 0.12, 0.13), 0.6 * blob)


def road(rng: np.random.Generator, length: float, half_width: float, pixel: float) -> Array32:
    """Asphalt with rows across the road (row 0 at the left edge) and columns along it. Lengths and `pixel` [m].

    It has chips, stains, wheel tracks, patches with tarred seams, cracks, manholes and worn markings.
    """
    rows, columns = round(2 * half_width / pixel), round(length / pixel)
    shape = (rows, columns)
    lateral = (half_width - (np.arange(rows) + 0.5) * pixel)[:, None]
    image = tinted(
        (0.37, 0.37, 0.375), fbm(rng, shape, 3.0 / pixel, 2.0), 0.13, 0.5 * fbm(rng, shape, 6.0 / pixel, 40.0)
    )
    grains(rng, image, 0.16, CHIPS)
    speckle(rng, image, int(length * 45), (0.5, 1.6), CHIPS)
    for track in (-1.95, -0.75, 0.75, 1.95):  # polished by wheels
        wander = track + 0.08 * fbm(rng, (1, columns), 8.0 / pixel, 200.0)
        blend(image, (0.27, 0.27, 0.275), 0.33 * np.exp(-0.5 * ((lateral - wander) / 0.22) ** 2))
    blend(
        image, (0.45, 0.41, 0.34), 0.5 * np.clip((np.abs(lateral) - 2.3) / 0.7, 0, 1) * (fbm(rng, shape, 80, 4) > 0.2)
    )
    for _ in range(int(length / 2.6)):  # repairs
        along, across = rng.uniform(0.5, 3.4), rng.uniform(0.4, 1.9)
        c0, r0 = int(rng.uniform(0, columns)), int(rng.uniform(0, rows))
        c1, r1 = min(columns, c0 + int(along / pixel)), min(rows, r0 + int(across / pixel))
        if c1 - c0 < 8 or r1 - r0 < 8:
            continue
        level = rng.uniform(0.19, 0.48)
        add_patch(rng, image[r0:r1, c0:c1], (level, level, level * 1.02))
    add_cracks(rng, image, int(length * 1.1), (1.0, 3.0), (0.08, 0.08, 0.085), 0.85)
    for _ in range(int(length / 1.8)):  # drips of oil, spilt water, chewing gum
        add_stain(image, (int(rng.uniform(0, columns)), int(rng.uniform(0, rows))), int(rng.uniform(3, 26)))
    _markings(rng, image, lateral, pixel)
    for station in np.arange(4.0, length, 11.0):  # manholes and storm drains
        station += rng.uniform(-3, 3)
        manhole(image, (int(station / pixel), int(rng.uniform(0.3, 0.7) * rows)), int(0.32 / pixel))
        gully(image, int((station + 4.0) / pixel), rng.random() < 0.5, pixel)
    leaves = np.array([[0.55, 0.42, 0.16], [0.42, 0.28, 0.12], [0.38, 0.42, 0.18], [0.6, 0.5, 0.25]], np.float32)
    speckle(rng, image, int(length * 5), (1.5, 4.5), leaves)
    return np.clip(image, 0.02, 1.0)


def _markings(rng: np.random.Generator, image: Array32, lateral: NDArray, pixel: float) -> None:
    rows, columns = image.shape[:2]
    along = (np.arange(columns) + 0.5)[None] * pixel
    worn = np.clip(0.75 + 0.35 * fbm(rng, (rows, columns), 40, 1.5), 0.0, 1.0)
    dashes = (np.abs(lateral) < 0.065) & ((along % 4.5) < 2.7)
    edges = np.abs(np.abs(lateral) - 2.62) < 0.055
    blend(image, (0.82, 0.81, 0.76), worn * (0.95 * dashes + 0.75 * edges))
    for station, left in ((17.0, False), (39.0, True), (64.0, False)):  # arrows of the lanes
        c = station / pixel
        middle = (3.0 - (1.4 if left else -1.4)) / pixel
        sign = -1.0 if left else 1.0
        outline = np.array([[c + sign * a / pixel, middle + b / pixel] for a, b in ARROW], np.int32)
        mask = np.zeros((rows, columns), np.float32)
        cv2.fillPoly(mask, [outline], 1.0)
        blend(image, (0.80, 0.80, 0.76), worn * mask)


def manhole(image: Array32, center: tuple[int, int], radius: int) -> None:
    """Draws a manhole cover; center (column, row) and radius [px]."""
    cv2.circle(image, center, radius + 3, (0.14, 0.14, 0.14), -1)
    cv2.circle(image, center, radius, (0.36, 0.33, 0.30), -1)
    for k in range(-radius + 4, radius - 2, 6):
        half = int(np.sqrt(max(0, (radius - 3) ** 2 - k * k)))
        cv2.line(image, (center[0] - half, center[1] + k), (center[0] + half, center[1] + k), (0.17, 0.16, 0.15), 2)
    cv2.circle(image, center, radius - 2, (0.22, 0.2, 0.19), 2)


def gully(image: Array32, column: int, left: bool, pixel: float) -> None:
    """Draws the grate of a storm drain at the left or right edge of the road."""
    rows = image.shape[0]
    across, along = int(0.34 / pixel), int(0.55 / pixel)
    r0 = 2 if left else rows - 2 - across
    image[r0 : r0 + across, column : column + along] = (0.25, 0.24, 0.23)
    for k in range(3, along - 3, 7):
        image[r0 + 3 : r0 + across - 3, column + k : column + k + 4] = (0.05, 0.05, 0.05)


def add_blades(rng: np.random.Generator, image: Array32, green: Rgb, dry: float = 0.0) -> None:
    """Draws blades of grass into an image, in place; a fraction `dry` of them is straw."""
    rows, columns = image.shape[:2]
    count = int(rows * columns * 0.02)
    starts = np.stack([rng.uniform(0, columns, count), rng.uniform(0, rows, count)], -1)
    ends = starts + rng.normal(0, 4.0, (count, 2))
    brightness = rng.uniform(0.55, 1.65, (count, 1))
    colors = np.tile(green, (count, 1))
    if dry:
        colors[rng.random(count) < dry] = (0.62, 0.55, 0.30)
    for a, b, color in zip(
        starts.astype(int).tolist(), ends.astype(int).tolist(), (colors * brightness).tolist(), strict=True
    ):
        cv2.line(image, a, b, color, 1)


def grass(rng: np.random.Generator, shape: tuple[int, int], pixel: float) -> Array32:
    """Turf from above: patches, bare earth, blades, stones, fallen leaves; `pixel` [m]."""
    image = tinted((0.29, 0.38, 0.15), fbm(rng, shape, 2.5 / pixel, 1.5, 0.8), 0.17, fbm(rng, shape, 4.0 / pixel, 10))
    blend(image, (0.44, 0.36, 0.22), np.clip(fbm(rng, shape, 1.8 / pixel, 3.0) - 1.1, 0, 0.8))
    add_blades(rng, image, (0.29, 0.37, 0.14))
    colors = np.array([[0.6, 0.45, 0.18], [0.45, 0.27, 0.1], [0.8, 0.8, 0.7], [0.5, 0.5, 0.47], [0.72, 0.66, 0.2]])
    speckle(rng, image, int(shape[0] * shape[1] * 0.0015), (1.0, 3.2), colors.astype(np.float32))
    return np.clip(image, 0.02, 1.0)


def slabs(rng: np.random.Generator, shape: tuple[int, int], pixel: float, slab: tuple[float, float]) -> Array32:
    """Concrete slabs of random tones, joints with moss, gum and stains; `slab` is (across, along) [m]."""
    rows, columns = shape
    r, c = np.arange(rows) * pixel / slab[0], np.arange(columns) * pixel / slab[1]
    tone = rng.uniform(0.8, 1.15, (int(r[-1]) + 1, int(c[-1]) + 2))
    offset = 0.5 * (r.astype(int) % 2)[:, None]
    cells = (c[None] + offset).astype(int)
    image = tinted((0.53, 0.51, 0.47), fbm(rng, shape, 60, 1.5), 0.10) * tone[r.astype(int)[:, None], cells, None]
    joint = ((r % 1.0) < 1.5 * pixel / slab[0])[:, None] | (((c[None] + offset) % 1.0) < 1.5 * pixel / slab[1])
    blend(image, (0.19, 0.2, 0.14), 0.85 * joint)
    spots = np.array([[0.2, 0.2, 0.2], [0.7, 0.68, 0.64], [0.4, 0.33, 0.22]], np.float32)
    speckle(rng, image, int(rows * columns * 0.004), (0.7, 2.6), spots)
    return np.clip(image, 0.02, 1.0).astype(np.float32)


def bricks(rng: np.random.Generator, shape: tuple[int, int], pixel: float, base: Rgb) -> Array32:
    """Brickwork with bricks of random tones and stains from top to bottom."""
    image = slabs(rng, shape, pixel, (0.12, 0.36))
    gray = image.mean(-1, keepdims=True) / 0.5
    tint = np.asarray(base, np.float32) * gray
    stains = fbm(rng, shape, 2.0 / pixel, 4.0)
    streaks = fbm(rng, (1, shape[1]), 30, 2.0) * np.linspace(1.0, 0.2, shape[0])[:, None]
    return np.clip(tint * (1.0 + 0.10 * stains[..., None] - 0.06 * streaks[..., None]), 0.02, 1.0).astype(np.float32)


def plaster(rng: np.random.Generator, shape: tuple[int, int], pixel: float, base: Rgb) -> Array32:
    """Plastered wall: blotches, drip streaks, cracks, a darker plinth."""
    image = tinted(base, fbm(rng, shape, 3.0 / pixel, 1.5), 0.06, 0.5 * fbm(rng, shape, 2.0 / pixel, 8))
    streaks = np.clip(fbm(rng, (1, shape[1]), 24, 2.0), 0, 3) * np.linspace(1.0, 0.1, shape[0])[:, None]
    image *= 1.0 - 0.07 * streaks[..., None]
    cracks = np.zeros(shape, np.float32)
    for _ in range(shape[1] // 60):
        start = np.array([rng.uniform(0, shape[1]), rng.uniform(0, shape[0])])
        crack(rng, cracks, start, rng.uniform(0, 2 * np.pi), rng.uniform(30, 120), 1.0)
    blend(image, (0.25, 0.23, 0.2), 0.55 * cracks)
    plinth = round(0.7 / pixel)
    image[-plinth:] *= 0.62
    return np.clip(image, 0.02, 1.0)


def weathered(image: Array32, pixel: float) -> Array32:
    """A wall's texture, darkened towards its foot and its eaves, where less sky is visible."""
    up = (image.shape[0] - np.arange(image.shape[0]))[:, None, None] * pixel
    down = image.shape[0] * pixel - up
    return (image * (1.0 - 0.35 * np.exp(-up / 0.6) - 0.30 * np.exp(-down / 0.5))).astype(np.float32)


WINDOW_BARS: dict[str, tuple[tuple[slice, ...], ...]] = {
    "cross": (np.s_[:, 34:38], np.s_[30:33, :]),
    "casement": (np.s_[:, 34:38],),
    "sash": (np.s_[46:51, :], np.s_[:, 35:37]),
    "ribbon": (),
    "shutters": (np.s_[:, 34:38], np.s_[30:33, :], np.s_[62:65, :]),
}
"""Glazing bars by style of window, within 96 rows and 72 columns."""


def window(rng: np.random.Generator, lit: bool, style: str, frames: NDArray[np.float64]) -> Array32:
    """A window of 96 × 72 px: frame, glazing bars, and sky, curtains or a lit room behind the glass.

    `frames` are the colors of frames to choose from, shape (n, 3).
    """
    image = np.zeros((96, 72, 3), np.float32)
    down = np.linspace(0, 1, 96)[:, None]
    if lit:
        image[:] = np.array([0.95, 0.78, 0.48]) * (0.95 - 0.3 * down[..., None]) * rng.uniform(0.8, 1.05)
    else:
        image[:] = np.array([0.20, 0.24, 0.30]) + (0.38 * (1 - down) ** 1.5)[..., None] * np.array([0.8, 0.95, 1.1])
        image *= rng.uniform(0.65, 1.15)
    image *= 1.0 + 0.10 * fbm(rng, (96, 72), 30, 3.0)[..., None]
    for side in (0, 1):  # curtains of unequal width
        width = int(rng.uniform(2, 26))
        folds = 0.75 + 0.25 * np.sin(np.arange(width) * rng.uniform(0.7, 1.6))
        tone = rng.uniform(0.45, 0.9) * np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.0)])
        part = slice(4, 4 + width) if side == 0 else slice(68 - width, 68)
        image[4:92, part] = 0.25 * image[4:92, part] + 0.75 * folds[None, :, None] * tone
    if rng.random() < 0.6:  # something on the sill
        x, w, h = int(rng.uniform(10, 50)), int(rng.uniform(5, 14)), int(rng.uniform(8, 24))
        image[90 - h : 90, x : x + w] = rng.uniform(0.1, 0.6, 3)
    if rng.random() < 0.35:  # a blind half down
        drop = int(rng.uniform(12, 60))
        image[4:drop] = (0.62 + 0.13 * (np.arange(4, drop) % 5 < 2))[:, None, None] * np.array([1.0, 0.97, 0.9])
    frame = rng.choice(frames)
    edges = (np.s_[:5, :], np.s_[-5:, :], np.s_[:, :5], np.s_[:, -5:])
    for bar in (*edges, *WINDOW_BARS[style]):
        image[bar] = frame
    return np.clip(image, 0.02, 1.0)


def bark(rng: np.random.Generator, shape: tuple[int, int], base: Rgb) -> Array32:
    """Bark: long vertical furrows, lichen."""
    grain = fbm(rng, (shape[0] // 4, shape[1]), 24, 1.0, 0.85)
    grain = cv2.resize(grain, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    image = tinted(base, grain, 0.30)
    blend(image, (0.52, 0.54, 0.42), np.clip(fbm(rng, shape, 40, 2.0) - 1.0, 0, 0.7))
    return np.clip(image, 0.03, 1.0)


def leaf(rng: np.random.Generator, shape: tuple[int, int], base: Rgb) -> Array32:
    """Leaf tones from dark (left) to light (right); `primitives.leaves` assigns each leaf a window of this texture."""
    image = tinted(base, fbm(rng, shape, 60, 1.0, 0.85), 0.20, 0.8 * fbm(rng, shape, 30, 6))
    image *= np.linspace(0.35, 1.35, shape[1], dtype=np.float32)[None, :, None]
    return np.clip(image, 0.03, 1.0)


def wood(rng: np.random.Generator, shape: tuple[int, int], base: Rgb) -> Array32:
    """Weathered planks with the grain along the columns."""
    grain = cv2.resize(fbm(rng, (shape[0], shape[1] // 8), 12, 1.0), shape[::-1], interpolation=cv2.INTER_LINEAR)
    image = tinted(base, grain, 0.17)
    image[:: max(2, shape[0] // 5)] *= 0.4
    speckle(rng, image, 30, (1.0, 3.0), np.array([[0.2, 0.13, 0.08]], np.float32))
    return np.clip(image, 0.03, 1.0)


def metal(rng: np.random.Generator, shape: tuple[int, int], base: Rgb) -> Array32:
    """Painted or galvanized metal: scratches, rust, stickers."""
    image = tinted(base, fbm(rng, shape, 40, 1.5), 0.11)
    blend(image, (0.36, 0.2, 0.1), np.clip(fbm(rng, shape, 30, 1.5) - 1.5, 0, 0.8))
    for _ in range(9):
        a, b = rng.uniform(0, shape[1], 2).astype(int), rng.uniform(0, shape[0], 2).astype(int)
        cv2.line(image, (int(a[0]), int(b[0])), (int(a[1]), int(b[1])), tuple(float(c) * 1.3 for c in base), 1)
    for _ in range(3):
        x, y = int(rng.uniform(0, shape[1] - 24)), int(rng.uniform(0, shape[0] - 16))
        corner = (x + int(rng.integers(8, 22)), y + int(rng.integers(6, 14)))
        cv2.rectangle(image, (x, y), corner, rng.uniform(0.2, 0.9, 3).tolist(), -1)
    return np.clip(image, 0.03, 1.0)


def notice(rng: np.random.Generator, shape: tuple[int, int], ground: Rgb, word: str) -> Array32:
    """A sign or poster: border, a word, lines of small print, dots."""
    rows, columns = shape
    image = np.empty((rows, columns, 3), np.uint8)
    image[:] = [round(255 * c) for c in ground]
    ink = (242, 242, 242) if sum(ground) < 1.6 else (20, 20, 26)
    cv2.rectangle(image, (5, 5), (columns - 6, rows - 6), ink, 4)
    scale = 0.9 * columns / max(60, 21 * len(word))
    cv2.putText(image, word, (14, int(rows * 0.38)), cv2.FONT_HERSHEY_DUPLEX, scale, ink, 3)
    for k in range(4):
        y = int(rows * (0.55 + 0.1 * k))
        for x in range(16, columns - 60, 14):
            if rng.random() < 0.75:
                cv2.line(image, (x, y), (x + int(rng.integers(4, 12)), y), ink, 3)
    for _ in range(4):
        center = (int(rng.uniform(columns * 0.72, columns - 20)), int(rng.uniform(rows * 0.5, rows - 24)))
        cv2.circle(image, center, int(rng.integers(5, 18)), rng.uniform(12, 242, 3).tolist(), -1)
    return np.clip(image / np.float32(255.0) * (1.0 + 0.05 * fbm(rng, shape, 50, 2.0)[..., None]), 0.03, 1.0)


def stripes(
    rng: np.random.Generator, shape: tuple[int, int], a: tuple[float, ...], b: tuple[float, ...], n: int
) -> Array32:
    """Dirty horizontal bands, for cones and barriers."""
    band = (np.arange(shape[0]) * n // shape[0]) % 2
    image = np.where(band[:, None, None] == 0, np.asarray(a, np.float32), np.asarray(b, np.float32))
    image = np.broadcast_to(image, (*shape, 3)).astype(np.float32)
    return np.clip(image * (1.0 + 0.12 * fbm(rng, shape, 40, 1.5)[..., None]), 0.03, 1.0)


# ---- atlas


@dataclass(frozen=True)
class AtlasColors:
    """Colors and styles that differ between the atlases of places; the defaults are those of the campus road."""

    metals: Mapping[str, Rgb] = field(
        default_factory=lambda: {
            "zinc": (0.55, 0.57, 0.58),
            "dark": (0.16, 0.17, 0.18),
            "green": (0.12, 0.30, 0.18),
            "red": (0.58, 0.12, 0.10),
            "blue": (0.13, 0.24, 0.46),
            "white": (0.78, 0.78, 0.76),
            "rubber": (0.09, 0.09, 0.09),
            "tank": (0.34, 0.33, 0.33),
            "glass": (0.16, 0.2, 0.24),
        }
    )
    woods: Mapping[str, Rgb] = field(
        default_factory=lambda: {"planks": (0.50, 0.37, 0.24), "crate": (0.50, 0.37, 0.24)}
    )
    masonry: Mapping[str, Rgb] = field(default_factory=dict)
    doors: tuple[Rgb, Rgb] = ((0.50, 0.37, 0.24), (0.50, 0.37, 0.24))
    greens: tuple[Rgb, ...] = ((0.26, 0.37, 0.12), (0.33, 0.42, 0.13), (0.40, 0.40, 0.14), (0.22, 0.33, 0.14))
    hedge: Rgb = (0.10, 0.16, 0.06)
    barks: tuple[Rgb, ...] = ((0.34, 0.27, 0.20),) * 3
    lamp: Rgb = (1.0, 0.93, 0.76)
    signs: tuple[tuple[Rgb, str], ...] = (
        *(((0.10, 0.22, 0.55), "LIBRARY"), ((0.85, 0.85, 0.82), "SLOW"), ((0.9, 0.75, 0.1), "WORKS")),
        *(((0.12, 0.4, 0.2), "HALL B"), ((0.75, 0.1, 0.1), "STOP"), ((0.92, 0.9, 0.85), "MAP")),
        *(((0.95, 0.95, 0.9), "KA 214"), ((0.93, 0.8, 0.2), "RX 730")),
    )
    window: str = "cross"
    frames: NDArray[np.float64] = field(
        default_factory=lambda: np.array([[0.86, 0.86, 0.84], [0.32, 0.22, 0.15], [0.25, 0.3, 0.27]])
    )


def paint_atlas(
    rng: Callable[[int], np.random.Generator], names: tuple[str, ...], colors: AtlasColors
) -> NDArray[np.float32]:
    """The image of an atlas in [0, 1]; `rng(k)` is the random generator of cell k."""
    rows, columns = atlas_shape(names)
    image = np.zeros((rows, ATLAS_CELL, columns, ATLAS_CELL, 3), np.float32)
    for k, name in enumerate(names):
        row, column = divmod(k, columns)
        image[row, :, column] = _cell(rng(k), name, colors)
    return image.reshape(rows * ATLAS_CELL, columns * ATLAS_CELL, 3)


def _cell(rng: np.random.Generator, name: str, colors: AtlasColors) -> Array32 | NDArray[np.float32]:
    square = (ATLAS_CELL, ATLAS_CELL)
    if name.startswith("bark"):
        return bark(rng, square, colors.barks[int(name[-1])])
    if name.startswith("leaf"):
        return leaf(rng, square, colors.greens[int(name[-1])])
    if name == "hedge":
        return leaf(rng, square, colors.hedge)
    if name in colors.metals:
        return metal(rng, square, colors.metals[name])
    if name in colors.masonry:
        return bricks(rng, square, 0.02, colors.masonry[name])
    if name == "birch":
        return bark(rng, square, (0.72, 0.71, 0.67))
    if name in colors.woods:
        return wood(rng, square, colors.woods[name])
    if name == "cone":
        return stripes(rng, square, (0.85, 0.30, 0.08), (0.88, 0.88, 0.85), 5)
    if name == "barrier":
        return np.rot90(stripes(rng, square, (0.75, 0.1, 0.08), (0.9, 0.9, 0.88), 7)).copy()
    if name.startswith("door"):
        return wood(rng, square, colors.doors[int(name[-1])]) * np.float32(0.55)
    if name == "lamp":
        return np.full((*square, 3), colors.lamp, np.float32)
    if name.startswith("sign"):
        return notice(rng, square, *colors.signs[int(name[-1])])
    pane = window(rng, name.startswith("lit"), colors.window, colors.frames)
    return cv2.resize(pane, square, interpolation=cv2.INTER_CUBIC).astype(np.float32)
