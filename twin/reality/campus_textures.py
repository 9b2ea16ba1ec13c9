"""Textures of the campus road (place 0): ground, walls and the atlas with all other surfaces."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from twin.reality import SEED, textures
from twin.reality.atlas_painting import AtlasColors, paint_atlas, to_uint8
from twin.reality.centerline import END, PAVEMENT_WIDTH, ROAD_HALF_WIDTH, START, VERGE_WIDTH
from twin.reality.place_objects import CELLS

_ROAD_PIXEL = 0.0125  # [m] size of a texel
_VERGE_PIXEL = 0.022
_WALL_PIXEL = 0.03

# Name: center (x, y) [m]; width, depth, height [m]; windows per 10 m of wall, floors.
BUILDINGS: dict[str, tuple[tuple[float, float], tuple[float, float, float], tuple[int, int]]] = {
    "hall": ((10.0, -14.0), (17.0, 9.0, 8.0), (4, 2)),
    "library": ((19.5, 13.8), (18.0, 8.0, 10.5), (4, 3)),
    "lodge": ((-3.0, 13.5), (12.0, 7.0, 5.0), (3, 1)),
    "school": ((54.0, -16.0), (10.0, 30.0, 9.5), (3, 3)),
    "workshop": ((43.0, 15.0), (18.0, 9.0, 6.5), (3, 2)),
    "annex": ((25.5, -25.0), (10.0, 15.0, 7.0), (4, 2)),
    "dormitory": ((39.0, -66.0), (34.0, 9.0, 12.0), (4, 4)),
    "tower": ((-22.0, -40.0), (12.0, 12.0, 18.0), (3, 5)),
    "block": ((82.0, 6.0), (14.0, 24.0, 14.0), (3, 4)),
    "sheds": ((20.0, -52.0), (14.0, 9.0, 4.5), (2, 1)),
}

WALLS = {  # building → brick or plaster, color
    "hall": ("bricks", (0.50, 0.26, 0.19)),
    "library": ("plaster", (0.72, 0.66, 0.53)),
    "lodge": ("bricks", (0.56, 0.40, 0.28)),
    "school": ("bricks", (0.45, 0.22, 0.18)),
    "workshop": ("plaster", (0.55, 0.60, 0.58)),
    "annex": ("plaster", (0.70, 0.70, 0.68)),
    "dormitory": ("bricks", (0.60, 0.47, 0.36)),
    "tower": ("plaster", (0.6, 0.58, 0.55)),
    "block": ("plaster", (0.66, 0.60, 0.56)),
    "sheds": ("bricks", (0.42, 0.38, 0.34)),
}

WET_TEXTURES = ("road", "kerb", "verge_left", "verge_right", "land")
"""Ground textures that rain darkens."""


@cache
def campus_textures() -> dict[str, NDArray[np.uint8]]:
    """All textures of the campus road by name, uint8 RGB."""

    def rng(*key: int) -> np.random.Generator:
        return np.random.default_rng([SEED, 5, *key])

    length = END - START
    out = {"road": to_uint8(textures.road(rng(0), length, ROAD_HALF_WIDTH, _ROAD_PIXEL))}
    shape = (round(VERGE_WIDTH / _VERGE_PIXEL), round(length / _VERGE_PIXEL))
    out["verge_right"] = to_uint8(textures.grass(rng(1), shape, _VERGE_PIXEL))
    left = textures.grass(rng(2), shape, _VERGE_PIXEL)
    paved = round(PAVEMENT_WIDTH / _VERGE_PIXEL)
    left[-paved:] = textures.slabs(rng(3), (paved, shape[1]), _VERGE_PIXEL, (0.57, 0.75))
    out["verge_left"] = to_uint8(left)
    out["kerb"] = to_uint8(textures.kerb(rng(4), (16, round(length / 0.02)), 0.02))
    out["land"] = to_uint8(textures.grass(rng(5), (2292, 2172), 1 / 12))
    for k, (name, (kind, color)) in enumerate(WALLS.items()):
        (_, size, _) = BUILDINGS[name]
        wall = (round(size[2] / _WALL_PIXEL), round(2 * (size[0] + size[1]) / _WALL_PIXEL))
        paint = textures.bricks if kind == "bricks" else textures.plaster
        out[name] = to_uint8(textures.weathered(paint(rng(6, k), wall, _WALL_PIXEL, color), _WALL_PIXEL))
    out["atlas"] = to_uint8(paint_atlas(lambda k: rng(7, k), CELLS, AtlasColors()))
    return out
