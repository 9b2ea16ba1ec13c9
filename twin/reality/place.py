"""The campus road, place 0: the designed place in which the demo was filmed.

The tables give the station and lateral [m] of each object, and the properties that differ between objects of a kind.
Before station 80 m, no solid object is within 1.6 m of the center line; barriers and trees close the road's end.
"""

import numpy as np

from twin.reality import SEED, primitives
from twin.reality import centerline as roads
from twin.reality.campus_textures import BUILDINGS, WET_TEXTURES, campus_textures
from twin.reality.centerline import END, PAVEMENT_WIDTH, ROAD_HALF_WIDTH, START, VERGE_WIDTH, RoadLine
from twin.reality.houses import add_block
from twin.reality.lighting import LIGHTINGS, sky_cube_map
from twin.reality.place_objects import DrivenLine, GroundLayout, KnownPlace, PlaceObject, Solid, up
from twin.reality.plants import add_hedge, add_tree, add_tufts
from twin.reality.primitives import MeshPart
from twin.reality.street_furniture import (
    add_bench,
    add_bin,
    add_car,
    add_cone,
    add_crate,
    add_lamp_post,
    add_sign,
)

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
_MIN_LATERAL = 2.15  # [m] least distance from the center line to which an object is displaced
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

    An object nearer to the center line than `_MIN_LATERAL` comes no nearer; others stay at least that far away.
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


_OUTER = ROAD_HALF_WIDTH + roads.KERB_WIDTH
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
        route: Center line; the default road where None.
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


def _road_strip(route: DrivenLine, laterals: list[float], heights: list[float] | None, step: float) -> MeshPart:
    """A mesh strip along the road, with vertices at the laterals [m], left first, and every `step` [m] along the road.

    `heights` [m] are above the undulation; None puts the strip on the ground.
    """
    stations = np.arange(roads.START, roads.END + step / 2, step)
    across = np.asarray(laterals, float)
    xy = route.at(stations[None], across[:, None])
    z = roads.undulation(xy) + (roads.cross_profile(across) if heights is None else np.asarray(heights))[:, None]
    span = np.cumsum(np.hypot(np.diff(across), np.diff((z - roads.undulation(xy))[:, 0])))
    v = np.concatenate([[0.0], span / span[-1]])
    u = (stations - roads.START) / (roads.END - roads.START)
    return primitives.grid(
        np.concatenate([xy, z[..., None]], -1), np.stack(np.broadcast_arrays(u[None], v[:, None]), -1)
    )


def _add_ground(place: KnownPlace) -> None:
    route, edge = place.route, ROAD_HALF_WIDTH
    crossing = np.linspace(edge, -edge, 13)
    place.objects.append(PlaceObject("road", "ground", _road_strip(route, list(crossing), None, 0.5), "road"))
    low = float(roads.cross_profile(edge))
    outer = edge + roads.KERB_WIDTH
    high = float(roads.cross_profile(outer))
    for side, name in ((1.0, "left"), (-1.0, "right")):
        profile = [(edge, low - 0.02), (edge + 0.015, high - 0.012), (edge + 0.03, high), (outer, high)]
        verge = np.linspace(outer, outer + roads.VERGE_WIDTH, 8)
        if side > 0:
            profile, verge = profile[::-1], verge[::-1]
        kerb = _road_strip(route, [side * p[0] for p in profile], [p[1] for p in profile], 0.5)
        place.objects.append(PlaceObject(f"kerb_{name}", "ground", kerb, "kerb"))
        strip = _road_strip(route, [side * v for v in verge], None, 0.5)
        place.objects.append(PlaceObject(f"verge_{name}", "ground", strip, f"verge_{name}"))
    x0, x1, y0, y1 = LAND_RANGE
    x, y = np.meshgrid(np.arange(x0, x1 + 0.1, LAND_STEP), np.arange(y1, y0 - 0.1, -LAND_STEP))
    xy = np.stack([x, y], -1)
    _, lateral = route.project(xy)
    sunk = np.where(
        np.abs(lateral) < edge + 1.5, 0.45, np.where(np.abs(lateral) < outer + roads.VERGE_WIDTH, 0.10, 0.03)
    )
    points = np.concatenate([xy, (route.ground_height(xy) - sunk)[..., None]], -1)
    uv = np.stack([(x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)], -1)
    place.objects.append(PlaceObject("land", "ground", primitives.grid(points, uv), "land"))
