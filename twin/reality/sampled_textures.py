"""Textures of randomly sampled places: ground, walls, roofs, and the atlas. Conventions as in `textures.py`."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.geometry.images import to_uint8
from twin.reality import textures
from twin.reality.houses import House
from twin.reality.place_objects import CELLS, GroundLayout
from twin.reality.place_spec import (
    MOUTH_REACH,
    HousesSpec,
    PlaceSpec,
    Rgb,
    SectionSpec,
    SideRoad,
    SurfaceSpec,
    rgb,
    stream,
)
from twin.reality.side_roads import SIDE_VERGE
from twin.reality.textures import (
    ARROW,
    CHIPS,
    AtlasColors,
    add_blades,
    add_cracks,
    add_patch,
    add_stain,
    blend,
    fbm,
    grains,
    gully,
    manhole,
    paint_atlas,
    slabs,
    speckle,
    tinted,
)
from twin.types import Array32


def road(
    rng: np.random.Generator,
    surface: SurfaceSpec,
    section: SectionSpec,
    length: float,
    pixel: float,
    zebras: tuple[float, ...] = (),
    style: np.random.Generator | None = None,
) -> Array32:
    """The road's surface: rows from the left edge to the right, columns along the road; lengths and `pixel` [m].

    `zebras` are the distances of zebra crossings from the first column [m]. Parts of one road share a `style`, a
    random generator that determines the bond of pavers, the lines and the colors of leaves.
    """
    style = style or rng
    shape = (round(section.width / pixel), round(length / pixel))
    rows = shape[0]
    lateral = (section.left - (np.arange(rows) + 0.5) * pixel)[:, None]
    from_edge = np.minimum(section.left - lateral, section.right + lateral)
    contrast = 0.13 * surface.coarseness
    image = tinted(surface.tone, fbm(rng, shape, 3.0 / pixel, 2.0), contrast, 0.5 * fbm(rng, shape, 6.0 / pixel, 40.0))
    match surface.kind:
        case "asphalt":
            _asphalt(rng, image, surface, length, lateral, pixel)
        case "concrete":
            _slab_field(rng, image, surface.unit, pixel, 0.06, (0.16, 0.15, 0.13), 0.016)
            grains(rng, image, 0.05, CHIPS)
        case "pavers":
            bond, spread = int(style.integers(0, 3)), float(style.uniform(0.06, 0.22))
            _slab_field(rng, image, surface.unit, pixel, spread, (0.2, 0.19, 0.15), 0.012, bond)
        case _:
            _gravel(rng, image, surface, section, lateral, pixel)
    if surface.kind != "gravel":
        dirt = np.clip(1.0 - from_edge / 0.7, 0.0, 1.0) * (fbm(rng, shape, 80, 4) > 0.3)
        blend(image, surface.earth, 0.45 * dirt)
    _repair(rng, image, surface, length, pixel)
    _mark(rng, style, image, surface, section, lateral, pixel, zebras)
    if surface.covers > 0.0:
        for station in np.arange(rng.uniform(1.0, surface.covers), length - 3.0, surface.covers):
            station += rng.uniform(-0.3, 0.3) * surface.covers
            center = (int(np.clip(station, 1.0, length - 1.0) / pixel), int(rng.uniform(0.25, 0.75) * rows))
            manhole(image, center, int(rng.uniform(0.22, 0.36) / pixel))
            if section.curb_height > 0.0:
                gully(image, int(np.clip(station + 4.0, 1.0, length - 1.0) / pixel), rng.random() < 0.5, pixel)
    fallen = np.array([[0.55, 0.42, 0.16], [0.42, 0.28, 0.12], [0.38, 0.42, 0.18], [0.45, 0.44, 0.42]], np.float32)
    fallen = fallen[style.permutation(4)[: int(style.integers(1, 4))]] * style.uniform(0.5, 1.1, 3).astype(np.float32)
    speckle(rng, image, int(length * surface.litter), (0.8, float(rng.uniform(1.4, 3.2))), fallen)
    return np.clip(image, 0.02, 1.0)


def _asphalt(
    rng: np.random.Generator, image: Array32, surface: SurfaceSpec, length: float, lateral: NDArray, pixel: float
) -> None:
    columns = image.shape[1]
    grains(rng, image, 0.16 * surface.coarseness, CHIPS)
    speckle(rng, image, int(length * 40 * surface.coarseness), (0.5, 1.6), CHIPS)
    dark = 0.75 * np.array(surface.tone)
    for track in (-0.75, 0.75):  # polished by wheels
        wander = track + 0.10 * fbm(rng, (1, columns), 8.0 / pixel, 200.0)
        blend(image, dark, 0.3 * np.exp(-0.5 * ((lateral - wander) / 0.22) ** 2))
    for _ in range(int(length * rng.uniform(0.05, 0.6))):
        add_stain(image, (rng.uniform(0, columns), rng.uniform(0, image.shape[0])), rng.uniform(3, 26))


def _slab_field(
    rng: np.random.Generator,
    image: Array32,
    unit: tuple[float, float],
    pixel: float,
    spread: float,
    joint: ArrayLike,
    gap: float,
    bond: int = 0,
) -> None:
    """Divides a surface into slabs of (across, along) [m] with random tones and joints `gap` [m] wide.

    `bond` 0: joints in line; 1: rows across the road shifted by half a slab; 2: rows along the road shifted.
    """
    rows, columns = image.shape[:2]
    r, c = np.arange(rows)[:, None] * pixel / unit[0], np.arange(columns)[None] * pixel / unit[1]
    r, c = np.broadcast_arrays(r, c)
    if bond == 1:
        r = r + 0.5 * (c.astype(int) % 2)
    elif bond == 2:
        c = c + 0.5 * (r.astype(int) % 2)
    i, j = r.astype(int), c.astype(int)
    tones = rng.normal(1.0, spread, (int(i.max()) + 1, int(j.max()) + 1)).astype(np.float32)
    warm = rng.normal(0.0, 0.15 * spread, tones.shape).astype(np.float32)
    image *= tones[i, j][..., None] * (1.0 + warm[i, j][..., None] * np.array([1.0, 0.0, -1.0], np.float32))
    seams = ((r % 1.0) * unit[0] < gap) | ((c % 1.0) * unit[1] < gap)
    moss = np.clip(0.7 + 0.3 * fbm(rng, image.shape[:2], 60, 4.0), 0.2, 1.0)
    blend(image, joint, moss * seams)


def _gravel(
    rng: np.random.Generator,
    image: Array32,
    surface: SurfaceSpec,
    section: SectionSpec,
    lateral: NDArray,
    pixel: float,
) -> None:
    shape = image.shape[:2]
    base = np.array(surface.tone)
    stones = np.stack([np.clip(base * k, 0.05, 0.95) for k in (0.55, 0.75, 1.15, 1.4, 1.6)]).astype(np.float32)
    grains(rng, image, 0.3 * surface.coarseness, stones)
    speckle(rng, image, int(shape[0] * shape[1] * 0.006 * surface.coarseness), (0.6, 2.4), stones)
    blend(image, surface.earth, np.clip(0.35 * fbm(rng, shape, 2.0 / pixel, 8.0), 0.0, 0.7))
    lighter = np.clip(base * 1.18, 0.0, 0.9)
    wander = 0.12 * fbm(rng, (1, shape[1]), 9.0 / pixel, 200.0)
    for track in (-0.72, 0.72):
        weight = np.exp(-0.5 * ((lateral - track - wander) / 0.26) ** 2)
        blend(image, lighter, 0.45 * weight)
    ragged = 0.16 * fbm(rng, shape, 0.8 / pixel, 3.0)
    edge = np.minimum(section.left - lateral, section.right + lateral)
    green = edge + ragged < 0.22
    if surface.strip > 0.0:
        green |= np.abs(lateral - wander) + ragged < 0.5 * surface.strip
    grass = turf(rng, surface, shape, pixel, "grass")
    image[green] = grass[green]


def _repair(rng: np.random.Generator, image: Array32, surface: SurfaceSpec, length: float, pixel: float) -> None:
    """Adds repairs with tarred seams, trenches and cracks."""
    rows, columns = image.shape[:2]
    for _ in range(int(length * surface.patches)):
        along, across = rng.uniform(0.5, 4.0), rng.uniform(0.4, 2.2)
        if rng.random() < 0.2:  # a trench
            along, across = (rng.uniform(6.0, 20.0), 0.5) if rng.random() < 0.5 else (0.5, 20.0)
        c0, r0 = int(rng.uniform(0, columns)), int(rng.uniform(-0.2, 1) * rows)
        c1, r1 = min(columns, c0 + int(along / pixel)), min(rows, r0 + int(across / pixel))
        r0 = max(0, r0)
        if c1 - c0 < 8 or r1 - r0 < 8:
            continue
        add_patch(rng, image[r0:r1, c0:c1], np.array(surface.tone) * rng.uniform(0.6, 1.25))
    add_cracks(rng, image, int(length * surface.cracks), (0.8, 2.2), (0.10, 0.10, 0.10), 0.7)


def _mark(
    rng: np.random.Generator,
    style: np.random.Generator,
    image: Array32,
    surface: SurfaceSpec,
    section: SectionSpec,
    lateral: NDArray,
    pixel: float,
    zebras: tuple[float, ...],
) -> None:
    """Paints the markings, worn by traffic."""
    rows, columns = image.shape[:2]
    along = (np.arange(columns) + 0.5)[None] * pixel
    worn = np.clip(1.05 - surface.wear + 0.45 * fbm(rng, (rows, columns), 40, 1.5), 0.0, 1.0)
    middle = lateral - 0.5 * (section.left - section.right)
    period, share, wide = style.uniform(3.0, 9.0), style.uniform(0.35, 0.65), style.uniform(0.05, 0.08)
    lines = np.zeros((rows, columns), bool)
    if "dashes" in surface.markings:
        lines |= (np.abs(middle) < wide) & ((along % period) < share * period)
    if "centre" in surface.markings:
        lines |= np.broadcast_to(np.abs(middle) < wide, lines.shape)
    if "edges" in surface.markings:
        inset = style.uniform(0.12, 0.35)
        lines |= np.broadcast_to(np.abs(np.abs(middle) - 0.5 * section.width + inset) < wide, lines.shape)
    blend(image, surface.paint, worn * lines)
    for station in zebras:
        stripes = (np.abs(along - station) < 1.6) & (((middle + 0.25) % 1.0) < 0.5)
        blend(image, (0.82, 0.81, 0.78), worn * stripes)
    if "arrows" in surface.markings:
        for station in np.arange(rng.uniform(6.0, 20.0), columns * pixel - 4.0, rng.uniform(16.0, 30.0)):
            mask = np.zeros((rows, columns), np.float32)
            at = (section.left + 0.25 * section.width * (section.left == section.right)) / pixel
            cv2.fillPoly(mask, [np.array([[(station + a) / pixel, at + b / pixel] for a, b in ARROW], np.int32)], 1.0)
            blend(image, surface.paint, worn * mask)


# ---- ground


def turf(rng: np.random.Generator, surface: SurfaceSpec, shape: tuple[int, int], pixel: float, kind: str) -> Array32:
    """Ground beside the road from above: `grass`, `meadow` (tall, with straw and flowers), `earth`, `gravel`."""
    earth = np.array(surface.earth)
    base = {"earth": earth, "gravel": 0.5 * earth + 0.25}.get(kind, np.array(surface.grass))
    patches, fine = fbm(rng, shape, 4.0 / pixel, 10), fbm(rng, shape, 2.5 / pixel, 1.5, 0.8)
    image = tinted(base, fine, 0.17, patches)
    if kind in ("earth", "gravel"):
        blend(image, surface.grass, np.clip(fbm(rng, shape, 1.6 / pixel, 3.0) - 0.9, 0, 0.8))
        tones = np.stack([base * k for k in (0.6, 0.8, 1.2, 1.4)]).clip(0.04, 0.9).astype(np.float32)
        grains(rng, image, 0.25 if kind == "gravel" else 0.06, tones)
        speckle(rng, image, int(shape[0] * shape[1] * (0.004 if kind == "gravel" else 0.0012)), (0.8, 3.0), tones)
        return np.clip(image, 0.02, 1.0)
    blend(image, surface.earth, np.clip(fbm(rng, shape, 1.8 / pixel, 3.0) - 1.4 + 3.0 * surface.bare, 0, 0.8))
    add_blades(rng, image, surface.grass, dry=0.3 if kind == "meadow" else 0.04)
    spots = np.array([[0.6, 0.45, 0.18], [0.45, 0.27, 0.1], [0.5, 0.5, 0.47], [0.72, 0.66, 0.2]], np.float32)
    if kind == "meadow":
        flower = rng.choice(np.array([[0.85, 0.8, 0.2], [0.9, 0.9, 0.88], [0.7, 0.2, 0.3], [0.5, 0.4, 0.75]]), 2)
        spots = np.concatenate([spots, flower.astype(np.float32)])
    speckle(rng, image, int(shape[0] * shape[1] * 0.0015), (1.0, 3.0), spots)
    return np.clip(image, 0.02, 1.0)


def land(rng: np.random.Generator, surface: SurfaceSpec, shape: tuple[int, int], pixel: float, kind: str) -> Array32:
    """The land around the road: turf, and for `meadow` also fields of different tints, some with furrows."""
    image = turf(rng, surface, shape, pixel, kind)
    if kind == "meadow":
        sites = np.stack([rng.uniform(0, shape[0], 14), rng.uniform(0, shape[1], 14)], -1)
        rows, columns = np.mgrid[0 : shape[0] : 4, 0 : shape[1] : 4]
        nearest = np.argmin([np.hypot(rows - r, columns - c) for r, c in sites], 0).astype(np.float32)
        field = cv2.resize(nearest, shape[::-1], interpolation=cv2.INTER_NEAREST).astype(int)
        tints = np.clip(rng.normal(1.0, 0.16, (14, 3)), 0.6, 1.5).astype(np.float32)
        image *= tints[field]
        furrow = rng.uniform(0, np.pi, 14)
        r, c = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
        direction = furrow[field]
        phase = (r * np.sin(direction) + c * np.cos(direction)) * pixel * 2 * np.pi / 1.1
        image *= 1.0 + 0.10 * (np.sin(phase) * (field % 2 == 0))[..., None].astype(np.float32)
    return np.clip(image, 0.02, 1.0)


def paving(
    rng: np.random.Generator,
    surface: SurfaceSpec,
    shape: tuple[int, int],
    pixel: float,
    kind: str,
    style: np.random.Generator | None = None,
) -> Array32:
    """A sidewalk: rows across it, columns along it. Parts of one sidewalk share a `style`, see `road`."""
    style = style or rng
    if kind == "gravel":
        return turf(rng, surface, shape, pixel, "gravel")
    level = float(style.uniform(0.26, 0.42) if kind == "asphalt" else style.uniform(0.42, 0.62))
    warm = float(style.uniform(-0.04, 0.10))
    image = tinted((level * (1 + warm), level, level * (1 - warm)), fbm(rng, shape, 60, 1.5), 0.10)
    if kind == "asphalt":
        grains(rng, image, 0.14, CHIPS)
    elif kind == "slabs":
        unit = (float(style.uniform(0.3, 0.8)), float(style.uniform(0.3, 0.9)))
        _slab_field(rng, image, unit, pixel, 0.09, (0.19, 0.2, 0.14), 0.022, int(style.integers(0, 3)))
    else:
        unit = (float(style.uniform(0.11, 0.2)), float(style.uniform(0.11, 0.24)))
        _slab_field(rng, image, unit, pixel, 0.12, (0.24, 0.22, 0.17), 0.022, int(style.integers(0, 3)))
    spots = np.array([[0.2, 0.2, 0.2], [0.7, 0.68, 0.64], [0.4, 0.33, 0.22]], np.float32)
    speckle(rng, image, int(shape[0] * shape[1] * 0.003), (0.7, 2.4), spots)
    return np.clip(image, 0.02, 1.0)


# ---- buildings


def wall(rng: np.random.Generator, kind: str, color: Rgb, shape: tuple[int, int], pixel: float) -> Array32:
    """A wall of a material (see `HousesSpec.walls`), weathered at foot and eaves."""
    if kind == "bricks":
        image = textures.bricks(rng, shape, pixel, color)
    elif kind == "plaster":
        image = textures.plaster(rng, shape, pixel, color)
    else:
        image = tinted(color, fbm(rng, shape, 2.0 / pixel, 2.0), 0.07, 0.4 * fbm(rng, shape, 2.0 / pixel, 8))
        dark = 0.4 * np.array(color)
        if kind == "boards":
            unit = (0.18, 40.0) if rng.random() < 0.6 else (40.0, 0.16)  # horizontal or vertical boards
            _slab_field(rng, image, unit, pixel, 0.09, dark, 0.03)
        elif kind == "stone":
            _slab_field(rng, image, (0.32, 0.5), pixel, 0.2, (0.30, 0.28, 0.24), 0.035, 2)
            blend(image, dark, 0.3 * np.clip(fbm(rng, shape, 20, 2.0), 0.0, 1.0))
        elif kind == "sheet":
            ribs = np.sin(np.arange(shape[1]) * pixel * 2 * np.pi / 0.24)
            image *= (1.0 + 0.13 * ribs)[None, :, None].astype(np.float32)
            rust = np.clip(fbm(rng, (1, shape[1]), 40, 2.0) - 1.0, 0, 1) * np.linspace(1.0, 0.0, shape[0])[:, None]
            blend(image, (0.34, 0.19, 0.10), 0.6 * rust)
        else:
            _slab_field(rng, image, (2.8, 2.4), pixel, 0.05, dark, 0.05)
        stains = np.clip(fbm(rng, (1, shape[1]), 24, 2.0), 0, 3) * np.linspace(1.0, 0.1, shape[0])[:, None]
        image *= 1.0 - 0.06 * stains[..., None].astype(np.float32)
    return np.clip(textures.weathered(np.clip(image, 0.02, 1.0), pixel), 0.02, 1.0)


def roof(rng: np.random.Generator, houses: HousesSpec, color: Rgb, shape: tuple[int, int], pixel: float) -> Array32:
    """A roof: rows from ridge to eaves."""
    image = tinted(color, fbm(rng, shape, 3.0 / pixel, 2.0), 0.10, 0.6 * fbm(rng, shape, 2.0 / pixel, 8))
    if "sheet" in houses.walls:
        ribs = np.arange(shape[1]) * pixel % 0.5 < 0.06
        image *= np.where(ribs, 0.7, 1.0)[None, :, None].astype(np.float32)
    else:
        _slab_field(rng, image, (0.33, 0.24), pixel, 0.10, 0.45 * np.array(color), 0.05, 2)
    blend(image, (0.28, 0.30, 0.18), np.clip(fbm(rng, shape, 40, 3.0) - 1.2, 0, 0.7))
    return np.clip(image, 0.02, 1.0)


SAMPLED_CELLS = (
    *CELLS,
    *(f"paint{k}" for k in range(6)),
    *("boundary_left", "boundary_right", "chimney", "shutter", "cabinet", "stone", "pole", "birch"),
)
"""Names of the cells of a sampled place's atlas, row by row."""

_ROAD_PIXEL, _VERGE_PIXEL, _LAND_PIXEL, _WALL_PIXEL = 0.0135, 0.022, 0.09, 0.035  # [m]

_WORDS = ("STOP", "SLOW", "BAKERY", "PARK", "30", "NO ENTRY", "BUS", "SCHOOL", "FARM", "HOTEL", "CAFE", "DEPOT", "EXIT")
_SIGN_GROUNDS: tuple[Rgb, ...] = (
    *((0.10, 0.22, 0.55), (0.85, 0.85, 0.82), (0.9, 0.75, 0.1), (0.12, 0.4, 0.2), (0.75, 0.1, 0.1)),
    *((0.92, 0.9, 0.85), (0.35, 0.2, 0.12), (0.2, 0.2, 0.22)),
)


@cache
def _atlas_image(spec: PlaceSpec) -> NDArray[np.uint8]:
    rng = stream(spec.number, "furniture", 3)

    def near(color: Rgb, spread: float = 0.25) -> Rgb:
        return rgb(np.clip(np.array(color) * rng.uniform(1 - spread, 1 + spread, 3), 0.03, 0.9))

    metals = {name: near(color) for name, color in AtlasColors().metals.items()}
    metals |= {f"paint{k}": c for k, c in enumerate((spec.furniture.car_colors * 6)[:6])}
    metals |= {"cabinet": near((0.5, 0.53, 0.5), 0.3), "stone": near((0.45, 0.44, 0.42), 0.2)}
    woods = {"planks": near((0.50, 0.37, 0.24)), "crate": near((0.52, 0.40, 0.27)), "pole": near((0.33, 0.26, 0.2))}
    woods["shutter"] = near((0.3, 0.34, 0.3), 0.8)
    masonry = {"chimney": near((0.45, 0.3, 0.25), 0.3)}
    for side, boundary in zip(("left", "right"), spec.boundaries, strict=True):
        material = {"wall": masonry, "mesh": metals, "bollards": metals}.get(boundary.kind, woods)
        material[f"boundary_{side}"] = boundary.color
    plates = [((0.93, 0.92, 0.88), f"{chr(65 + int(rng.integers(26)))}X {int(rng.integers(100, 999))}") for _ in "12"]
    signs = [
        (_SIGN_GROUNDS[int(rng.integers(len(_SIGN_GROUNDS)))], _WORDS[int(rng.integers(len(_WORDS)))]) for _ in range(6)
    ]
    trees = spec.trees
    colors = AtlasColors(
        metals=metals,
        woods=woods,
        masonry=masonry,
        doors=(near((0.6, 0.42, 0.3), 0.5), near((0.4, 0.5, 0.5), 0.6)),
        greens=trees.greens,
        hedge=rgb(0.45 * np.array(trees.greens[0])),
        barks=(trees.bark, near(trees.bark), near(trees.bark)),
        lamp=rgb(0.4 + 0.6 * np.array(spec.lamps.color)),
        signs=(*signs, *plates),
        window=spec.houses.window,
        frames=np.array([spec.houses.trim]),
    )
    return to_uint8(paint_atlas(lambda k: stream(spec.number, "furniture", 4, k), SAMPLED_CELLS, colors))


def sampled_textures(
    spec: PlaceSpec, layout: GroundLayout, houses: dict[str, tuple[House, str, Rgb, Rgb]]
) -> dict[str, NDArray[np.uint8]]:
    """All textures of a place by name, uint8 RGB."""
    if spec not in _painted:
        if len(_painted) > 1:
            _painted.pop(next(iter(_painted)))
        _painted[spec] = _paint(spec, layout, houses)
    return _painted[spec]


# Textures of the last two places; films under several lightings reuse them.
_painted: dict[PlaceSpec, dict[str, NDArray[np.uint8]]] = {}


def _paint_side_road(spec: PlaceSpec, k: int, one: SideRoad) -> dict[str, NDArray[np.uint8]]:
    """The textures of the ground of side road number `k`."""
    surface, section = replace(spec.surface, markings=(), strip=0.0), spec.section

    def rng(key: int) -> np.random.Generator:
        return stream(spec.number, "side_roads", k, 10, key)

    begin = section.verge_edge(one.mouth.side)
    half, before, length = 0.5 * one.mouth.width, begin - section.curb_edge(one.mouth.side), one.length - begin
    across = replace(section, left=half, right=half)
    out = {
        one.name: road(rng(0), surface, across, length, _ROAD_PIXEL),
        f"{one.name}_mouth": road(rng(1), surface, replace(across, curb_height=0.0), before, _ROAD_PIXEL),
    }
    shape = round(SIDE_VERGE / _VERGE_PIXEL), round(length / _VERGE_PIXEL)
    out[f"{one.name}_verge"] = turf(rng(2), surface, shape, _VERGE_PIXEL, section.sides[0].verge)
    if section.curb_height > 0.0:
        tone, unit = rng(3).uniform(0.7, 1.25), float(rng(4).uniform(0.5, 1.2))
        out[f"{one.name}_curb"] = slabs(rng(5), (16, round(length / 0.02)), 0.02, (10.0, unit)) * tone
    return {name: to_uint8(image) for name, image in out.items()}


def _paint(
    spec: PlaceSpec, layout: GroundLayout, houses: dict[str, tuple[House, str, Rgb, Rgb]]
) -> dict[str, NDArray[np.uint8]]:
    surface, section = spec.surface, spec.section

    def rng(*key: int) -> np.random.Generator:
        return stream(spec.number, "surface", *key)

    def style(key: int) -> np.random.Generator | None:
        """The generator of the features that all parts of a long road share; None for a road of one part."""
        return stream(spec.number, "longer", key) if parts > 1 else None

    out: dict[str, NDArray[np.uint8]] = {}
    parts = sum(name.startswith("road") for name in layout.bands)
    for n in range(parts):
        part, more = (f"_{n}", (n,)) if n else ("", ())
        first, last, *_ = layout.bands[f"road{part}"]
        length = last - first
        zebras: tuple[float, ...] = ()
        if "zebra" in surface.markings:
            share = float(rng(1, *more).uniform(0.2, 0.8))
            zebras = (share * spec.line.length - first if parts == 1 else share * length,)
        painted = road(rng(2, *more), surface, section, length, _ROAD_PIXEL, zebras, style(1))
        out[f"road{part}"] = to_uint8(painted)
        for k, (name, side) in enumerate(zip(("verge_left", "verge_right"), section.sides, strict=True)):
            shape = (max(8, round(side.width / _VERGE_PIXEL)), round(length / _VERGE_PIXEL))
            image = turf(rng(3, k, *more), surface, shape, _VERGE_PIXEL, side.verge)
            if side.pavement > 0.0:
                paved = (min(shape[0], round(side.pavement / _VERGE_PIXEL)), shape[1])
                inner = slice(shape[0] - paved[0], None) if k == 0 else slice(0, paved[0])
                image[inner] = paving(rng(4, k, *more), surface, paved, _VERGE_PIXEL, side.paving, style(2 + k))
            out[f"{name}{part}"] = to_uint8(image)
        if section.curb_height > 0.0:
            tone = float(rng(5).uniform(0.7, 1.25))
            stones = (16, round(length / 0.02))
            curb = slabs(rng(6, *more), stones, 0.02, (10.0, float(rng(5).uniform(0.5, 1.2)))) * tone
            out[f"curb{part}"] = to_uint8(curb)
    if spec.line.mouths:
        plain = replace(surface, markings=(), strip=0.0)
        half = 0.5 * max(mouth.width for mouth in spec.line.mouths)
        across = replace(section, left=half, right=half, curb_height=0.0)
        out["side_road"] = to_uint8(road(rng(7), plain, across, MOUTH_REACH / 0.25, 0.02))
    for k, one in enumerate(spec.line.side_roads):
        out |= _paint_side_road(spec, k, one)
    kind = {"town": "grass", "works": "gravel", "field": "meadow", "forest": "earth"}.get(spec.setting, "grass")
    for n, (name, (x0, x1, y0, y1)) in enumerate(layout.lands.items()):
        shape = (round((y1 - y0) / _LAND_PIXEL), round((x1 - x0) / _LAND_PIXEL))
        out[name] = to_uint8(land(rng(8, *((n,) if n else ())), surface, shape, _LAND_PIXEL, kind))
    for name, (house, cladding, color, tiles) in houses.items():
        size = (round((house.eaves + 0.5) / _WALL_PIXEL), round(2 * (house.width + house.depth) / _WALL_PIXEL))
        paint = stream(spec.number, "houses", 2, int(name.removeprefix("house_")))
        out[name] = to_uint8(wall(paint, cladding, color, size, _WALL_PIXEL))
        ridge, slope = house.roof_size
        tiled = (max(16, round(slope / 0.045)), round(ridge / 0.045))
        out[f"{name}_roof"] = to_uint8(roof(paint, spec.houses, tiles, tiled, 0.045))
    out["atlas"] = _atlas_image(spec)
    return out
