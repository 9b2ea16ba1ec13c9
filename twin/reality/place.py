"""The ground along the road, and the place put together: everything solid stays outside ±1.6 m of the centre line."""

import numpy as np
from numpy.typing import NDArray

from twin.reality import buildings, shapes, street, trees
from twin.reality import route as roads
from twin.reality.route import ROAD_HALF_WIDTH, Route
from twin.reality.shapes import Part
from twin.reality.things import SEED, Place, Thing

Array = NDArray[np.float64]

LAND = (-60.0, 120.0, -130.0, 60.0)  # [m] x and y range of the land beyond the verges
_LAND_STEP = 1.5


def build(route: Route | None = None, later: bool = False) -> Place:
    """The campus road; `later`: on another day than it was filmed, cones, bins, crates and cars having been moved.

    Deterministic: the same place each time.
    """
    place = Place(route or Route())
    _ground(place)
    buildings.add(place)
    trees.add(place)
    street.add(place, np.random.default_rng([SEED, 8]) if later else None)
    return place


def _ribbon(route: Route, laterals: list[float], heights: list[float] | None, step: float) -> Part:
    """A strip along the road through laterals (left first); heights [m] over the undulation, None = the ground's."""
    stations = np.arange(roads.START, roads.END + step / 2, step)
    across = np.asarray(laterals, float)
    xy = route.at(stations[None], across[:, None])
    z = roads.undulation(xy) + (roads.cross_profile(across) if heights is None else np.asarray(heights))[:, None]
    span = np.cumsum(np.hypot(np.diff(across), np.diff((z - roads.undulation(xy))[:, 0])))
    v = np.concatenate([[0.0], span / span[-1]])
    u = (stations - roads.START) / (roads.END - roads.START)
    return shapes.grid(np.concatenate([xy, z[..., None]], -1), np.stack(np.broadcast_arrays(u[None], v[:, None]), -1))


def _ground(place: Place) -> None:
    route, edge = place.route, ROAD_HALF_WIDTH
    crossing = np.linspace(edge, -edge, 13)
    place.things.append(Thing("road", "ground", _ribbon(route, list(crossing), None, 0.5), "road"))
    low = float(roads.cross_profile(edge))
    outer = edge + roads.KERB_WIDTH
    high = float(roads.cross_profile(outer))
    for side, name in ((1.0, "left"), (-1.0, "right")):
        profile = [(edge, low - 0.02), (edge + 0.015, high - 0.012), (edge + 0.03, high), (outer, high)]
        verge = np.linspace(outer, outer + roads.VERGE_WIDTH, 8)
        if side > 0:
            profile, verge = profile[::-1], verge[::-1]
        kerb = _ribbon(route, [side * p[0] for p in profile], [p[1] for p in profile], 0.5)
        place.things.append(Thing(f"kerb_{name}", "ground", kerb, "kerb"))
        strip = _ribbon(route, [side * v for v in verge], None, 0.5)
        place.things.append(Thing(f"verge_{name}", "ground", strip, f"verge_{name}"))
    x0, x1, y0, y1 = LAND
    x, y = np.meshgrid(np.arange(x0, x1 + 0.1, _LAND_STEP), np.arange(y1, y0 - 0.1, -_LAND_STEP))
    xy = np.stack([x, y], -1)
    _, lateral = route.project(xy)
    sunk = np.where(
        np.abs(lateral) < edge + 1.5, 0.45, np.where(np.abs(lateral) < outer + roads.VERGE_WIDTH, 0.10, 0.03)
    )
    points = np.concatenate([xy, (roads.ground_height(route, xy) - sunk)[..., None]], -1)
    uv = np.stack([(x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)], -1)
    place.things.append(Thing("land", "ground", shapes.grid(points, uv), "land"))
