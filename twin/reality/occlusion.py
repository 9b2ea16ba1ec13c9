"""How much of the sky a point of the ground sees, baked into the ground's textures: soft shadows where things stand."""

import numpy as np
from numpy.typing import NDArray

from twin.reality import place as places
from twin.reality import route as roads
from twin.reality import shapes
from twin.reality.surface import Surface
from twin.reality.things import Place, up

Array = NDArray[np.float64]

_RAYS = 48
_REACH = 7.0  # [m] what is further does not darken
_STEP = 0.3  # [m] between points looked from


def sky_visibility(place: Place, points: Array) -> Array:
    """Share of the cosine-weighted sky seen from points (..., 3) that nothing standing nearby hides, shape (...)."""
    part = shapes.join([t.part for t in place.things if t.kind in ("obstacle", "foliage")])
    k = np.arange(_RAYS) + 0.5
    angle, sine = k * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(k / _RAYS)  # Malley: a uniform disc lifted to the dome
    rays = np.stack([sine * np.cos(angle), sine * np.sin(angle), np.sqrt(1.0 - sine**2)], 1)
    flat = points.reshape(-1, 3) + up(0.02)
    return Surface(part.vertices, part.faces).openness(flat, rays, _REACH).reshape(points.shape[:-1])


def ground_visibility(place: Place) -> dict[str, Array]:
    """Sky visibility over each texture of the ground, coarse, rows and columns as in the texture."""
    edge, outer = roads.ROAD_HALF_WIDTH, roads.ROAD_HALF_WIDTH + roads.KERB_WIDTH
    bands = {
        "road": (edge, -edge),
        "verge_left": (outer + roads.VERGE_WIDTH, outer),
        "verge_right": (-outer, -outer - roads.VERGE_WIDTH),
    }
    along = np.linspace(roads.START, roads.END, round((roads.END - roads.START) / _STEP))
    grids = {}
    for name, (first, last) in bands.items():
        across = np.linspace(first, last, round(abs(first - last) / _STEP))
        grids[name] = place.route.at(along[None], across[:, None])
    x0, x1, y0, y1 = places.LAND
    x, y = np.meshgrid(np.linspace(x0, x1, round(x1 - x0)), np.linspace(y1, y0, round(y1 - y0)))
    grids["land"] = np.stack([x, y], -1)
    return {
        name: sky_visibility(place, np.concatenate([xy, roads.ground_height(place.route, xy)[..., None]], -1))
        for name, xy in grids.items()
    }
