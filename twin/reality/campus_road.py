"""The campus road, place 0: the designed place in which the demo was filmed.

*Station* s [m] is the arc length along the center line, *lateral* [m] the signed offset from it, positive to the left
of the driving direction. The road runs straight along +x, turns right on a circular arc, and runs straight on. Heights
[m] are above z = 0. Tables give the station and lateral [m] of each object, and the properties that differ between
objects of a kind. Before station 80 m, no solid object is within 1.6 m of the center line; barriers and trees close the
road's end.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.geometry.images import to_uint8
from twin.reality import SEED, primitives, textures
from twin.reality.houses import add_block
from twin.reality.lighting import LIGHTINGS
from twin.reality.place_objects import CELLS, DrivenLine, GroundLayout, KnownPlace, PlaceObject, Solid, up
from twin.reality.plants import add_hedge, add_tree, add_tufts
from twin.reality.primitives import MeshPart
from twin.reality.sky import sky_cube_map
from twin.reality.street_furniture import (
    add_bench,
    add_bin,
    add_car,
    add_cone,
    add_crate,
    add_lamp_post,
    add_sign,
)
from twin.reality.textures import AtlasColors, paint_atlas
from twin.types import Array

# ---- line

ROAD_HALF_WIDTH = 3.0  # [m] from the center line to the face of the curb
CURB_HEIGHT = 0.11  # [m] above the adjacent asphalt
CURB_WIDTH = 0.16  # [m]
VERGE_WIDTH = 5.6  # [m] from the curb to the open land; on the left this includes the sidewalk
PAVEMENT_WIDTH = 1.7  # [m] of the sidewalk along the left curb
START, END = -6.0, 88.0  # [m] stations of the ends of the road
VERGE_SLOPE = 0.025  # slope of the verges, which rise away from the road
_CROWN = 0.018  # slope of the road from its crown to either side
_CROWN_ROUNDING = 0.35  # [m] half width of the rounding of the crown
# Undulation: amplitude [m], wave vector (x, y) [rad/m], phase [rad]. The steepest slope is about 3 %.
_WAVES = (
    (0.055, (0.170, 0.030), 0.4),
    (0.035, (-0.060, 0.210), 1.9),
    (0.020, (0.310, 0.240), 3.3),
    (0.010, (0.520, -0.450), 5.1),
)


@dataclass(frozen=True)
class RoadLine:
    """The center line of the road, as a `DrivenLine`: a straight, a right-hand arc and a straight."""

    straight: float = 30.0
    """Length before the turn [m]."""
    radius: float = 9.0
    """Radius of the turn [m]."""
    turn: float = np.pi / 2.0
    """Angle of the turn, to the right [rad]."""
    length: float = 60.0
    """Driven length [m]."""

    @property
    def arc(self) -> float:
        """Length of the turn [m]."""
        return self.radius * self.turn

    def heading(self, station: ArrayLike) -> Array:
        return -np.clip((np.asarray(station) - self.straight) / self.radius, 0.0, self.turn)

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Points (x, y) [m], shape (..., 2). The line continues straight before station 0 and beyond its end."""
        s, lateral = np.broadcast_arrays(np.asarray(station, float), np.asarray(lateral, float))
        heading = self.heading(s)
        before, after = np.minimum(s, self.straight), np.maximum(s - self.straight - self.arc, 0.0)
        x = before - self.radius * np.sin(heading) + after * np.cos(self.turn)
        y = self.radius * (np.cos(heading) - 1.0) - after * np.sin(self.turn)
        return np.stack([x - lateral * np.sin(heading), y + lateral * np.cos(heading)], -1)

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Station and lateral [m] of points relative to the center line, shapes (..., 2) → (...), (...)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        out = np.array([np.cos(self.turn), -np.sin(self.turn)])  # direction after the turn
        end = self.at(self.straight + self.arc)
        along = (xy - end) @ out
        across = (xy - end) @ np.array([-out[1], out[0]])
        angle = np.arctan2(x - self.straight, y + self.radius)  # clockwise, from the start of the arc
        radial = np.hypot(x - self.straight, y + self.radius) - self.radius
        stations = np.stack([x, self.straight + self.radius * angle, self.straight + self.arc + along])
        laterals = np.stack([y, radial, across])
        valid = np.stack([x <= self.straight, (angle >= 0.0) & (angle <= self.turn), along >= 0.0])
        best = np.argmin(np.where(valid, np.abs(laterals), np.inf), 0)[None]
        return np.take_along_axis(stations, best, 0)[0], np.take_along_axis(laterals, best, 0)[0]

    def ground_height(self, xy: ArrayLike) -> Array:
        return undulation(xy) + cross_profile(self.project(xy)[1])


def undulation(xy: ArrayLike) -> Array:
    """Height of the undulating land without the road [m], shape (..., 2) → (...)."""
    xy = np.asarray(xy, float)
    return sum((a * np.sin(xy @ np.array(k) + phase) for a, k, phase in _WAVES), np.zeros(xy.shape[:-1]))


def cross_profile(lateral: ArrayLike) -> Array:
    """Height above the undulation [m]: crowned asphalt, a curb, and a verge that rises outwards."""
    away = np.abs(np.asarray(lateral, float))
    crown = -_CROWN * (np.sqrt(away**2 + _CROWN_ROUNDING**2) - _CROWN_ROUNDING)
    edge = -_CROWN * (np.hypot(ROAD_HALF_WIDTH, _CROWN_ROUNDING) - _CROWN_ROUNDING)
    verge = edge + CURB_HEIGHT + VERGE_SLOPE * np.clip(away - ROAD_HALF_WIDTH, 0.0, 8.0)
    return np.where(away <= ROAD_HALF_WIDTH, crown, verge)


# ---- textures

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

WET_TEXTURES = ("road", "curb", "verge_left", "verge_right", "land")
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
    out["curb"] = to_uint8(textures.slabs(rng(4), (16, round(length / 0.02)), 0.02, (10.0, 0.9)) * np.float32(0.95))
    out["land"] = to_uint8(textures.grass(rng(5), (2292, 2172), 1 / 12))
    for k, (name, (kind, color)) in enumerate(WALLS.items()):
        (_, size, _) = BUILDINGS[name]
        wall = (round(size[2] / _WALL_PIXEL), round(2 * (size[0] + size[1]) / _WALL_PIXEL))
        paint = textures.bricks if kind == "bricks" else textures.plaster
        out[name] = to_uint8(textures.weathered(paint(rng(6, k), wall, _WALL_PIXEL, color), _WALL_PIXEL))
    out["atlas"] = to_uint8(paint_atlas(lambda k: rng(7, k), CELLS, AtlasColors()))
    return out


# ---- street furniture

_LAMPS = ((2.0, 3.75), (15.0, -3.75), (28.0, 3.75), (40.0, 3.9), (51.0, -3.75), (63.0, 3.75), (76.0, -3.75))
_SIGNS = (  # station, lateral [m], rotation from facing the traffic [rad]
    *((6.0, -3.7, 0.1), (11.0, 3.6, -0.2), (20.0, -3.8, 0.0), (27.5, -4.0, 0.5), (33.0, 4.6, -0.4)),
    *((37.5, 4.4, -0.9), (46.0, 3.7, 0.0), (55.0, -3.7, 0.2), (67.0, -3.7, 0.0), (72.0, 3.8, 0.1)),
)
_CONES = (
    *((19.0, 2.35), (20.6, 2.2), (22.4, 2.25), (24.1, 2.4), (35.5, 2.5)),
    *((47.5, -2.4), (49.2, -2.3), (58.0, 2.4), (68.0, -2.3)),
)
_BENCHES = ((9.5, 4.6), (26.0, 4.7), (43.5, 4.7), (57.0, 4.6), (69.0, 4.6))
_BINS = (
    *((10.9, 4.6, "green"), (17.5, -3.9, "dark"), (38.7, 5.2, "blue")),
    *((58.6, 4.6, "green"), (48.5, 4.4, "red")),
)
_CRATES = (  # station, lateral, side [m]
    *((18.5, -5.0, 1.1), (18.6, -6.3, 0.9), (29.5, -5.6, 1.2)),
    *((45.5, 6.5, 1.0), (54.0, -5.3, 1.15), (65.0, -4.9, 1.0)),
)
_MIN_LATERAL = 2.15  # [m] least distance of a displaced object from the center line
_CARS = ((31.2, -5.2, "white"), (12.6, -4.9, "blue"), (66.0, 5.4, "red"))


def _add_street_furniture(place: KnownPlace, rng: np.random.Generator | None = None) -> None:
    """Adds street furniture, cars and barriers; displaces cones, bins, crates and cars if `rng` is given."""
    for k, lamp in enumerate(_LAMPS):
        add_lamp_post(place, k, *lamp)
    for k, (station, lateral, turn) in enumerate(_SIGNS):
        high, low, wide = (2.4, 1.5, 0.9) if k % 3 else (1.9, 0.7, 1.3)
        add_sign(place, k, station, lateral, turn, (wide, low, high))
    for k, (station, lateral) in enumerate(_CONES):
        add_cone(place, k, *_displaced(rng, station, lateral, 1.5, 0.2))
    for k, bench in enumerate(_BENCHES):
        add_bench(place, k, *bench)
    for k, (station, lateral, skin) in enumerate(_BINS):
        add_bin(place, k, *_displaced(rng, station, lateral, 1.0, 0.2), skin)
    for k, (station, lateral, side) in enumerate(_CRATES):
        add_crate(place, k, *_displaced(rng, station, lateral, 0.5, 0.2), side)
    for k, (station, lateral, skin) in enumerate(_CARS):
        add_car(place, k, *_displaced(rng, station, lateral, 1.5, 0.1), skin)
    for k, lateral in enumerate((-2.0, 0.0, 2.0)):  # barriers across the end of the road
        foot, yaw = place.spot(END - 3.0, lateral), place.heading(END) + np.pi / 2
        part = place.cell("barrier", primitives.box((1.8, 0.12, 1.0)).moved(foot, yaw))
        solid = Solid("box", foot + up(0.5), (0.9, 0.06, 0.5), yaw)
        place.objects.append(PlaceObject(f"barrier_{k}", "obstacle", part, "atlas", (solid,)))


def _displaced(
    rng: np.random.Generator | None, station: float, lateral: float, along: float, across: float
) -> tuple[float, float]:
    """Station and lateral, displaced at random by at most `along` and `across` [m]; unchanged without a generator.

    The result is at least `_MIN_LATERAL` from the center line, or as far as before if that is nearer.
    """
    if rng is None:
        return station, lateral
    station += rng.uniform(-along, along)
    away = max(abs(lateral) + rng.uniform(-across, across), min(abs(lateral), _MIN_LATERAL))
    return float(station), float(np.copysign(away, lateral))


# ---- vegetation

_TREES = (  # station, lateral, height, crown radius [m]
    (4.5, -5.6, 6.2, 1.9),
    (8.0, 6.4, 7.0, 2.3),
    (13.5, -6.3, 5.4, 1.7),
    (15.5, 6.0, 6.4, 2.0),
    (23.5, -5.4, 6.8, 2.1),
    (25.0, 7.0, 6.0, 2.0),
    (34.0, 7.2, 7.4, 2.4),
    (41.0, 6.6, 6.3, 2.0),
    (50.5, 6.2, 7.2, 2.3),
    (52.0, -6.0, 6.0, 1.9),
    (60.0, -5.5, 6.9, 2.2),
    (62.5, 6.8, 6.2, 2.1),
    (71.0, -6.2, 7.4, 2.4),
    (74.5, 6.1, 6.6, 2.1),
    (83.0, -6.5, 6.5, 2.2),
    (86.0, 7.0, 7.2, 2.3),
    (93.0, -1.5, 6.8, 2.3),
    (95.0, 3.5, 7.5, 2.6),
)


# First station, last station, lateral [m].
_HEDGES = ((0.0, 11.0, -7.6), (18.0, 30.0, 7.9), (46.0, 60.0, 7.6), (46.5, 58.0, -7.4))
_TUFTS = 5200
_TUFT_STATIONS = (START, 75.0)  # [m]


def _add_vegetation(place: KnownPlace) -> None:
    """Adds trees, hedges and tufts of grass."""
    for k, tree in enumerate(_TREES):
        add_tree(place, k, *tree)
    for k, (start, end, lateral) in enumerate(_HEDGES):
        add_hedge(place, k, np.arange(start, end, 1.0), lateral)
    rng = place.rng(4)
    station = rng.uniform(*_TUFT_STATIONS, _TUFTS)
    side = rng.choice([-1.0, 1.0], _TUFTS)
    inner = np.where(side > 0, ROAD_HALF_WIDTH + PAVEMENT_WIDTH + 0.25, ROAD_HALF_WIDTH + 0.25)
    lateral = side * (inner + rng.exponential(0.9, _TUFTS).clip(0, 4.5))
    add_tufts(place, rng, station, lateral)


# ---- ground

LAND_RANGE = (-60.0, 120.0, -130.0, 60.0)  # [m] x and y range of the land beyond the verges
LAND_STEP = 1.5  # [m] between vertices of the land


_OUTER = ROAD_HALF_WIDTH + CURB_WIDTH
_LAYOUT = GroundLayout(
    bands={
        "road": (START, END, ROAD_HALF_WIDTH, -ROAD_HALF_WIDTH),
        "verge_left": (START, END, _OUTER + VERGE_WIDTH, _OUTER),
        "verge_right": (START, END, -_OUTER, -_OUTER - VERGE_WIDTH),
    },
    lands={"land": LAND_RANGE},
    field=((-8.0, -58.0), (60.0, 22.0)),
    wet=WET_TEXTURES,
)


def build(route: RoadLine | None = None, displaced: bool = False) -> KnownPlace:
    """Builds the campus road; equal arguments give equal places.

    Args:
        route: Center line; None: the default road.
        displaced: True for the day of the trials: cones, bins, crates and cars have moved since the film.
    """
    place = KnownPlace(
        route or RoadLine(), _LAYOUT, campus_textures, LIGHTINGS, lambda lighting: sky_cube_map(lighting, SEED)
    )
    _add_ground(place)
    for name, building in BUILDINGS.items():
        add_block(place, name, *building)
    _add_vegetation(place)
    _add_street_furniture(place, np.random.default_rng([SEED, 8]) if displaced else None)
    return place


def _road_strip(route: DrivenLine, laterals: list[float], heights: list[float] | None) -> MeshPart:
    """A mesh strip along the road, with vertices at the laterals [m], left first, and every 0.5 m along the road.

    `heights` [m] are above the undulation; None puts the strip on the ground.
    """
    stations = np.arange(START, END + 0.25, 0.5)
    across = np.asarray(laterals, float)
    xy = route.at(stations[None], across[:, None])
    z = undulation(xy) + (cross_profile(across) if heights is None else np.asarray(heights))[:, None]
    span = np.cumsum(np.hypot(np.diff(across), np.diff((z - undulation(xy))[:, 0])))
    v = np.concatenate([[0.0], span / span[-1]])
    u = (stations - START) / (END - START)
    return primitives.grid(xy, z, u[None], v[:, None])


def _add_ground(place: KnownPlace) -> None:
    route, edge = place.route, ROAD_HALF_WIDTH
    crossing = np.linspace(edge, -edge, 13)
    place.objects.append(PlaceObject("road", "ground", _road_strip(route, list(crossing), None), "road"))
    low = float(cross_profile(edge))
    outer = edge + CURB_WIDTH
    high = float(cross_profile(outer))
    for side, name in ((1.0, "left"), (-1.0, "right")):
        profile = [(edge, low - 0.02), (edge + 0.015, high - 0.012), (edge + 0.03, high), (outer, high)]
        verge = np.linspace(outer, outer + VERGE_WIDTH, 8)
        if side > 0:
            profile, verge = profile[::-1], verge[::-1]
        curb = _road_strip(route, [side * p[0] for p in profile], [p[1] for p in profile])
        place.objects.append(PlaceObject(f"curb_{name}", "ground", curb, "curb"))
        strip = _road_strip(route, [side * v for v in verge], None)
        place.objects.append(PlaceObject(f"verge_{name}", "ground", strip, f"verge_{name}"))
    x0, x1, y0, y1 = LAND_RANGE
    x, y = np.meshgrid(np.arange(x0, x1 + 0.1, LAND_STEP), np.arange(y1, y0 - 0.1, -LAND_STEP))
    xy = np.stack([x, y], -1)
    _, lateral = route.project(xy)
    sunk = np.where(np.abs(lateral) < edge + 1.5, 0.45, np.where(np.abs(lateral) < outer + VERGE_WIDTH, 0.10, 0.03))
    part = primitives.grid(xy, route.ground_height(xy) - sunk, (x - x0) / (x1 - x0), (y1 - y) / (y1 - y0))
    place.objects.append(PlaceObject("land", "ground", part, "land"))
