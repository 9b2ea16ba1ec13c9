"""Textures of randomly sampled places: ground, walls, roofs (see `surfaces.py`), and the atlas with all the rest."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from twin.reality import surfaces
from twin.reality.atlas_painting import AtlasColors, paint_atlas, to_uint8
from twin.reality.drawn_road import MOUTH_REACH
from twin.reality.houses import House
from twin.reality.place_objects import CELLS, GroundLayout
from twin.reality.place_spec import BoundarySpec, PlaceSpec, Rgb
from twin.reality.place_streams import stream
from twin.reality.textures import slabs

DRAWN_CELLS = (
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
        red, green, blue = np.clip(np.array(color) * rng.uniform(1 - spread, 1 + spread, 3), 0.03, 0.9).tolist()
        return red, green, blue

    defaults = AtlasColors()
    metals = {name: near(color) for name, color in defaults.metals.items()}
    metals |= {f"paint{k}": c for k, c in enumerate((spec.furniture.car_colors * 6)[:6])}
    left, right = spec.boundaries
    metals |= {"cabinet": near((0.5, 0.53, 0.5), 0.3), "stone": near((0.45, 0.44, 0.42), 0.2)}
    woods = {"planks": near((0.50, 0.37, 0.24)), "crate": near((0.52, 0.40, 0.27)), "pole": near((0.33, 0.26, 0.2))}
    woods["shutter"] = near((0.3, 0.34, 0.3), 0.8)

    masonry = {"chimney": near((0.45, 0.3, 0.25), 0.3)}

    def surface(boundary: BoundarySpec, name: str) -> None:
        material = {"wall": masonry, "mesh": metals, "bollards": metals}.get(boundary.kind, woods)
        material[name] = boundary.color

    surface(left, "boundary_left")
    surface(right, "boundary_right")
    plates = [((0.93, 0.92, 0.88), f"{chr(65 + int(rng.integers(26)))}X {int(rng.integers(100, 999))}") for _ in "12"]
    signs = [
        (_SIGN_GROUNDS[int(rng.integers(len(_SIGN_GROUNDS)))], _WORDS[int(rng.integers(len(_WORDS)))]) for _ in range(6)
    ]
    color = spec.lamps.color
    trees = spec.trees
    dark = trees.greens[0]
    colors = AtlasColors(
        metals=metals,
        woods=woods,
        masonry=masonry,
        doors=(near((0.6, 0.42, 0.3), 0.5), near((0.4, 0.5, 0.5), 0.6)),
        greens=trees.greens,
        hedge=(0.45 * dark[0], 0.45 * dark[1], 0.45 * dark[2]),
        barks=(trees.bark, near(trees.bark), near(trees.bark)),
        lamp=(0.4 + 0.6 * color[0], 0.4 + 0.6 * color[1], 0.4 + 0.6 * color[2]),
        signs=(*signs, *plates),
        window=spec.houses.window,
        frames=np.array([spec.houses.trim]),
    )
    return to_uint8(paint_atlas(lambda k: stream(spec.number, "furniture", 4, k), DRAWN_CELLS, colors))


def drawn_textures(
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


def _paint(
    spec: PlaceSpec, layout: GroundLayout, houses: dict[str, tuple[House, str, Rgb, Rgb]]
) -> dict[str, NDArray[np.uint8]]:
    surface, section = spec.surface, spec.section

    def rng(*key: int) -> np.random.Generator:
        return stream(spec.number, "surface", *key)

    def style(key: int) -> np.random.Generator | None:
        """The generator of what the parts of a long road share; None for a road of one part."""
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
        painted = surfaces.road(rng(2, *more), surface, section, length, _ROAD_PIXEL, zebras, style(1))
        out[f"road{part}"] = to_uint8(painted)
        for k, (name, side) in enumerate(zip(("verge_left", "verge_right"), section.sides, strict=True)):
            shape = (max(8, round(side.width / _VERGE_PIXEL)), round(length / _VERGE_PIXEL))
            image = surfaces.turf(rng(3, k, *more), surface, shape, _VERGE_PIXEL, side.verge)
            if side.pavement > 0.0:
                paved = (min(shape[0], round(side.pavement / _VERGE_PIXEL)), shape[1])
                inner = slice(shape[0] - paved[0], None) if k == 0 else slice(0, paved[0])
                image[inner] = surfaces.paving(
                    rng(4, k, *more), surface, paved, _VERGE_PIXEL, side.paving, style(2 + k)
                )
            out[f"{name}{part}"] = to_uint8(image)
        if section.kerb_height > 0.0:
            tone = float(rng(5).uniform(0.7, 1.25))
            stones = (16, round(length / 0.02))
            kerb = slabs(rng(6, *more), stones, 0.02, (10.0, float(rng(5).uniform(0.5, 1.2)))) * tone
            out[f"kerb{part}"] = to_uint8(kerb)
    if spec.line.mouths:
        plain = replace(surface, markings=(), strip=0.0)
        half = 0.5 * max(mouth.width for mouth in spec.line.mouths)
        across = replace(section, left=half, right=half, kerb_height=0.0)
        out["side_road"] = to_uint8(surfaces.road(rng(7), plain, across, MOUTH_REACH / 0.25, 0.02))
    kind = {"town": "grass", "works": "gravel", "field": "meadow", "forest": "earth"}.get(spec.setting, "grass")
    for n, (name, (x0, x1, y0, y1)) in enumerate(layout.lands.items()):
        shape = (round((y1 - y0) / _LAND_PIXEL), round((x1 - x0) / _LAND_PIXEL))
        out[name] = to_uint8(surfaces.land(rng(8, *((n,) if n else ())), surface, shape, _LAND_PIXEL, kind))
    for k, (name, (house, wall, color, tiles)) in enumerate(houses.items()):
        size = (round((house.eaves + 0.5) / _WALL_PIXEL), round(2 * (house.width + house.depth) / _WALL_PIXEL))
        paint = stream(spec.number, "houses", 2, k)
        out[name] = to_uint8(surfaces.wall(paint, wall, color, size, _WALL_PIXEL))
        ridge, slope = house.roof_size
        tiled = (max(16, round(slope / 0.045)), round(ridge / 0.045))
        out[f"{name}_roof"] = to_uint8(surfaces.roof(paint, spec.houses, tiles, tiled, 0.045))
    out["atlas"] = _atlas_image(spec)
    return out
