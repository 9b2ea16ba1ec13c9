"""Builds a place from its description (`PlaceSpec`): ground, objects, textures, lightings.

Objects stand along the driven line first, then along the side roads that are filmed. They are placed one after the
other: houses, lamps and boundaries first, then poles, cars, furniture and trees. An object is left out if its footprint
touches the road, a side road, the corridor along a filmed line or an earlier footprint.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count
from math import hypot

import numpy as np

from twin.reality import SEED
from twin.reality import street_furniture as furniture
from twin.reality.houses import House, add_house
from twin.reality.lighting import place_lightings
from twin.reality.place_objects import GroundLayout, KnownPlace
from twin.reality.place_sampling import sample_place
from twin.reality.place_spec import CLEARANCE, FREE_HALF_WIDTH, PlaceSpec, Rgb, stream
from twin.reality.plants import add_bare_tree, add_conifer, add_crowned_tree, add_shrub, add_tufts
from twin.reality.sampled_road import STEP, SampledRoad, add_land, add_road, add_side_roads, land_boxes
from twin.reality.sampled_textures import SAMPLED_CELLS, sampled_textures
from twin.reality.side_roads import SIDE_VERGE, SideAxis, SideLine, add_side_road
from twin.reality.sky import place_sky
from twin.reality.street_furniture import BAY, THICKNESS, add_boundary
from twin.types import Array

_FIELD_MARGIN = 14.0  # [m] from the driven line to the edges of `GroundLayout.field`
_MIN_GAP = 0.35  # [m] between footprints
_PART_LENGTH = 90.0  # [m] mean length of the parts of a long road; each part has textures of its own
_LONGEST_REACH = 113.0  # [m] longest reach, see `_reach`, of a road that was not lengthened


def build(spec: PlaceSpec, displaced: bool = False) -> KnownPlace:
    """Builds the place of a description; equal arguments give equal places.

    Args:
        spec: The description.
        displaced: True for the day of the trials: cones, bins, crates and cars have moved since the film.
    """
    road = SampledRoad(spec)
    stations = np.arange(road.start, road.end + STEP / 2, STEP)
    parts = max(1, round((stations[-1] - stations[0]) / _PART_LENGTH))
    ends = np.linspace(0, len(stations) - 1, parts + 1).round().astype(int).tolist()
    beside = [axis.at(np.linspace(0.0, axis.length, 50)) for axis in road.side_axes]
    driven = np.concatenate([road.at(np.linspace(0.0, spec.line.length, 200)), *beside])
    corners = ((driven.min(0) - _FIELD_MARGIN).tolist(), (driven.max(0) + _FIELD_MARGIN).tolist())
    section = spec.section
    across = {
        "road": (section.left, -section.right),
        "verge_left": (section.verge_edge(1), section.curb_edge(1)),
        "verge_right": (-section.curb_edge(-1), -section.verge_edge(-1)),
    }
    names_of_parts = [f"_{k}" if k else "" for k in range(parts)]
    lands = land_boxes(np.concatenate([road.at(stations), *beside]), tiled=parts > 1)
    layout = GroundLayout(
        bands={
            f"{name}{part}": (float(stations[first]), float(stations[last]), *laterals)
            for part, first, last in zip(names_of_parts, ends, ends[1:], strict=False)
            for name, laterals in across.items()
        },
        lands=lands,
        field=((corners[0][0], corners[0][1]), (corners[1][0], corners[1][1])),
        wet=(
            *(f"{name}{part}" for part in names_of_parts for name in ("road", "curb", "verge_left", "verge_right")),
            *lands,
            "side_road",
            *(f"{one.name}{end}" for one in spec.line.side_roads for end in ("", "_mouth", "_curb", "_verge")),
        ),
    )
    names: dict[str, tuple[House, str, Rgb, Rgb]] = {}
    place = KnownPlace(
        road,
        layout,
        partial(sampled_textures, spec, layout, names),
        place_lightings(spec),
        partial(place_sky, spec),
        number=spec.number,
        seed=(SEED, 100, spec.number, 1000),
        cells=SAMPLED_CELLS,
    )
    for part, first, last in zip(names_of_parts, ends, ends[1:], strict=False):
        add_road(place, road, stations[first : last + 1], part)
    add_side_roads(place, road, stations)
    for axis in road.side_axes:
        add_side_road(place, axis)
    for name, box in lands.items():
        add_land(place, road, name, box)
    site, movables = Site(road), list[_Movable]()
    names.update(_furnish(place, _of_driven_line(spec), site, movables))
    for k, axis in enumerate(road.side_axes):
        there = replace(place, route=axis, seed=(*place.seed, 30 + k))  # shares the lists of objects and lamps
        names.update(_furnish(there, _of_side_road(spec, axis, k), site, movables))
    rng = place.rng(20)
    for one in movables:  # after all else, so that the rest of the place is the same on all days
        one.add(*(_moved(rng, one, site) if displaced else one.at))
    return place


@cache
def build_number(number: int, displaced: bool = False, length: float = 0.0, side_roads: bool = False) -> KnownPlace:
    """Builds the place with a number, 1 or more; `length` [m] and `side_roads` as for `sample_place`."""
    return build(sample_place(number, length, side_roads), displaced)


# ---- placement


class Site:
    """Occupied ground: road, side roads, the corridors along filmed lines, and the footprints of placed objects.

    A footprint is a rectangle: its center [m], half sizes [m] and the direction of its first axis [rad].
    """

    def __init__(self, road: SampledRoad) -> None:
        self._road = road
        self._side_lines = [SideLine(road, axis) for axis in road.side_axes]
        self._taken: list[tuple[float, float, float, Array]] = []  # x, y, radius, corners

    def take(
        self, center: Array, half: tuple[float, float], yaw: float, clear: float = CLEARANCE, gap: float = _MIN_GAP
    ) -> bool:
        """Occupies a footprint if it is free; returns True if it was.

        Args:
            center: x, y [m].
            half: Half sizes along and across `yaw` [m].
            yaw: Direction of the first axis [rad].
            clear: Least distance from the road's edge or curb [m].
            gap: Least distance from other footprints [m].
        """
        corners = _corners(center, half, yaw)
        if not self._off_road(center, half, yaw, clear):
            return False
        grown, radius = _corners(center, (half[0] + gap, half[1] + gap), yaw), float(np.hypot(*half)) + gap
        x, y = center.tolist()
        for other_x, other_y, reach, outline in self._taken:
            if hypot(x - other_x, y - other_y) < radius + reach and _overlap(grown, outline):
                return False
        self._taken.append((x, y, float(np.hypot(*half)), corners))
        return True

    def move(self, start: Array, goal: Array, half: tuple[float, float], yaw: float) -> bool:
        """Moves the footprint with its center at `start` to `goal`, if that is free; returns True if it was.

        `half` and `yaw` are the footprint's at `goal`, as for `take`.
        """
        index = next(k for k, (x, y, *_) in enumerate(self._taken) if [x, y] == start.tolist())
        own = self._taken.pop(index)
        if self.take(goal, half, yaw):
            return True
        self._taken.insert(index, own)
        return False

    def _off_road(self, center: Array, half: tuple[float, float], yaw: float, clear: float) -> bool:
        road, section = self._road, self._road.section
        counts = [max(2, round(2 * h / 0.4) + 1) for h in half]
        a, b = np.meshgrid(*(np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)))
        axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        xy = center + np.stack([a.ravel(), b.ravel()], -1) @ axes
        station, lateral = road.project(xy)
        free = (road.edges(lateral) > section.curb_width + clear) & (np.abs(lateral) > FREE_HALF_WIDTH + CLEARANCE)
        for mouth in road.line.mouths:
            free &= (np.abs(station - mouth.station) > mouth.width / 2 + 0.4) | (lateral * mouth.side < 0.0)
        for line, axis in zip(self._side_lines, road.side_axes, strict=True):
            free &= ~axis.occupied(xy, clear)
            along, off = line.project(xy)
            free &= (np.abs(off) > FREE_HALF_WIDTH + CLEARANCE) | (along < 0.0) | (along > line.length)
        return bool(free.all())


def _corners(center: Array, half: tuple[float, float], yaw: float) -> Array:
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return center + np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half @ axes


def _overlap(a: Array, b: Array) -> bool:
    """True if two rectangles (4, 2) overlap, by the separating axis theorem."""
    for corners in (a, b):
        for side in (corners[1] - corners[0], corners[2] - corners[1]):
            normal = np.array([-side[1], side[0]])
            p, q = a @ normal, b @ normal
            if p.max() < q.min() or q.max() < p.min():
                return False
    return True


@dataclass(frozen=True)
class _Roadside:
    """The two sides of a road, along which objects stand. Pairs are left, right."""

    spec: PlaceSpec
    first: float
    """Station from which on objects stand [m]."""
    last: float
    """Station up to which objects stand [m]."""
    tufts: tuple[float, float]
    """Range of the stations of grass [m]."""
    edges: tuple[float, float]
    """Distances of the curbs' outer edges from the line [m]."""
    verges: tuple[float, float]
    """Widths of sidewalk and verge together [m]."""
    paved: tuple[float, float]
    """Widths of the sidewalks [m]."""
    key: tuple[int, ...] = ()
    """Key of its random streams: none for the driven line, the number of a side road."""

    def stream(self, aspect: str, *more: int) -> np.random.Generator:
        """A random generator, see `place_spec.stream`."""
        if not self.key:
            return stream(self.spec.number, aspect, *more)
        kinds = ("houses", "lamps", "boundaries", "furniture", "cars", "trees")
        return stream(self.spec.number, "side_roads", *self.key, kinds.index(aspect), *more)

    def numbered(self, k: int) -> int:
        """The number, unique in the place, of the k-th object of a kind."""
        return k + 1000 * (1 + self.key[0]) if self.key else k

    def suffix(self) -> str:
        """End of the names of objects that occur once per road."""
        return f"_{self.spec.line.side_roads[self.key[0]].name}" if self.key else ""

    def edge(self, side: int) -> float:
        """Distance of the curb's outer edge from the line on a side (1 = left) [m]."""
        return self.edges[0 if side > 0 else 1]

    def verge(self, side: int) -> float:
        """Width of sidewalk and verge on a side [m]."""
        return self.verges[0 if side > 0 else 1]


def _of_driven_line(spec: PlaceSpec) -> _Roadside:
    section, length = spec.section, spec.line.length
    return _Roadside(
        spec,
        *(-6.0, length + 22.0, (-7.0, length + 20.0)),
        (section.curb_edge(1), section.curb_edge(-1)),
        (section.sides[0].width, section.sides[1].width),
        (section.sides[0].pavement, section.sides[1].pavement),
    )


def _of_side_road(spec: PlaceSpec, axis: SideAxis, k: int) -> _Roadside:
    begin, last = axis.verge_start, axis.length - 1.0
    edges, verges = (axis.edge, axis.edge), (SIDE_VERGE, SIDE_VERGE)
    return _Roadside(spec, begin, last, (begin, last), edges, verges, (0.0, 0.0), (k,))


# ---- objects


@dataclass(frozen=True)
class _Movable:
    """An object that may stand elsewhere on another day; its footprint is occupied, but it is not added yet."""

    place: KnownPlace
    at: tuple[float, float]
    """Station and lateral in the films [m]."""
    half: tuple[float, float]
    """Half sizes of the footprint [m]."""
    turn: float
    """Direction of the footprint's first axis relative to the road [rad]."""
    add: Callable[[float, float], None]
    """Adds the object at a station and lateral [m]."""


def _furnish(
    place: KnownPlace, along: _Roadside, site: Site, movables: list[_Movable]
) -> dict[str, tuple[House, str, Rgb, Rgb]]:
    """Adds all objects along a road, the movable ones to `movables`; returns its houses as `_add_houses` does."""
    houses = _add_houses(place, along, site)
    _add_lamps(place, along, site)
    _add_boundaries(place, along, site)
    _add_poles(place, along, site)
    _add_cars(place, along, site, movables)
    _add_furniture(place, along, site, movables)
    _add_trees(place, along, site)
    _add_tufts(place, along)
    return houses


def _add_houses(place: KnownPlace, along: _Roadside, site: Site) -> dict[str, tuple[House, str, Rgb, Rgb]]:
    """Adds rows of houses; returns, by name, house, wall material, wall color and roof color."""
    rng, spec = along.stream("houses", 1), along.spec
    houses = spec.houses
    out: dict[str, tuple[House, str, Rgb, Rgb]] = {}
    if houses.density <= 0.05:
        return out
    most = max(16, int(0.14 * (along.last - along.first)))
    plots = count()  # a house has the number of its plot, so that it is the same whether other plots are free or not
    for side in (1, -1):
        station = along.first + float(rng.uniform(0.0, 12.0))
        while station < along.last + 10.0:
            width, depth = float(rng.uniform(*houses.front)), float(rng.uniform(6.0, 11.0))
            storeys = int(rng.integers(houses.storeys[0], houses.storeys[1] + 1))
            setback = float(rng.uniform(*houses.setback))
            away = along.edge(side) + max(0.6, along.verge(side) - 1.0) + setback + depth / 2
            yaw = place.heading(station) + (0.0 if side > 0 else np.pi) + float(rng.normal(0.0, 0.03))
            wall, roof = str(rng.choice(houses.walls)), str(rng.choice(houses.roofs))
            color = houses.colors[int(rng.integers(len(houses.colors)))]
            tiles = houses.roof_colors[int(rng.integers(len(houses.roof_colors)))]
            house = House(
                place.route.at(station, side * away), yaw, width, depth, storeys, roof, houses.pitch, houses.window
            )
            plot = along.numbered(next(plots))
            if len(out) < most and site.take(house.center, (width / 2 + 0.3, depth / 2 + 0.3), yaw, 0.6, 0.6):
                name = add_house(place, plot, house, spec.lamps.lit_windows)
                out[name] = (house, wall, color, tiles)
            mean = 100.0 / houses.density
            station += max(width + 0.8, float(rng.uniform(0.7, 1.3)) * mean)
    return out


def _add_lamps(place: KnownPlace, along: _Roadside, site: Site) -> None:
    rng, lamps = along.stream("lamps", 1), along.spec.lamps
    if lamps.kind == "none":
        return
    for k, station in enumerate(np.arange(along.first + rng.uniform(0.0, lamps.spacing), along.last, lamps.spacing)):
        side = lamps.side or (1 if k % 2 else -1)
        shines = bool(rng.random() >= lamps.broken)
        away = max(along.edge(side) + 0.45, FREE_HALF_WIDTH + 0.35)
        for shift in (0.0, 3.0, -3.0):
            at = float(station + shift), side * away
            if site.take(place.route.at(*at), (0.12, 0.12), 0.0):
                break
        else:
            continue
        if lamps.kind in ("post_top", "lantern"):
            furniture.add_lantern(place, along.numbered(k), *at, lamps.height, lamps.kind, shines)
        else:
            arm = 0.25 * lamps.height
            arms = (arm, -arm) if lamps.kind == "double" else (arm,)
            furniture.add_lamp_post(place, along.numbered(k), *at, lamps.height, arms, shines)


def _add_boundaries(place: KnownPlace, along: _Roadside, site: Site) -> None:
    rng, spec = along.stream("boundaries", 1), along.spec
    for side, boundary in zip((1, -1), spec.boundaries, strict=True):
        if boundary.kind == "none":
            continue
        away = max(along.edge(side) + max(boundary.distance, 0.3), FREE_HALF_WIDTH + 0.6)
        lateral, thick = side * away, THICKNESS[boundary.kind]
        pieces = spec.line.pieces if not along.key else ()  # side roads are straight
        tight = min((1 / abs(p.curvature) for p in pieces if side * p.curvature > 0.0), default=np.inf)
        if away > tight - 0.8:
            continue
        runs: list[list[float]] = [[]]
        wanted = rng.random(1000) < boundary.covered
        for k, station in enumerate(np.arange(along.first, along.last, BAY).tolist()):
            at, half = station + BAY / 2, (BAY / 2, thick / 2)
            if boundary.kind == "bollards":
                at, half = station, (0.12, 0.12)
            # Neighboring pieces touch, hence the negative gap.
            if wanted[k // 4] and site.take(place.route.at(at, lateral), half, place.heading(at), 0.1, -0.05):
                runs[-1].append(station)
            elif runs[-1]:
                runs.append([])
        for k, run in enumerate(runs):
            add_boundary(place, along.numbered(k), boundary, np.array(run), lateral)


def _add_poles(place: KnownPlace, along: _Roadside, site: Site) -> None:
    if not along.spec.furniture.poles:
        return
    rng = along.stream("furniture", 1)
    side, height = int(rng.choice([-1, 1])), float(rng.uniform(6.5, 8.5))
    away = along.edge(side) + min(1.2, 0.5 * along.verge(side)) + float(rng.uniform(0.4, 1.6))
    feet = []
    for k, station in enumerate(np.arange(along.first + rng.uniform(0, 10), along.last, rng.uniform(20.0, 30.0))):
        at = float(station), side * away
        if site.take(place.route.at(*at), (0.16, 0.16), 0.0):
            furniture.add_post(place, f"pole_{along.numbered(k)}", *at, height, 0.13, "pole")
            feet.append(at)
    if len(feet) > 1:
        furniture.add_wires(place, f"wires{along.suffix()}", feet, height)


def _scatter(
    rng: np.random.Generator, along: _Roadside, amount: float, near: float, far: float
) -> list[tuple[float, float]]:
    """Random stations and laterals [m]: `amount` per 100 m of road, at `near` to `far` from the curb."""
    out = []
    for _ in range(int(rng.poisson(amount * (along.last - along.first) / 100.0))):
        side, station = int(rng.choice([-1, 1])), float(rng.uniform(along.first, along.last))
        out.append((station, side * (along.edge(side) + float(rng.uniform(near, far)))))
    return out


def _moved(rng: np.random.Generator, one: _Movable, site: Site) -> tuple[float, float]:
    """Station and lateral [m] of an object on another day: up to 1.5 m along the road from where it was filmed.

    If none of ten spots is free, it has not moved.
    """
    route, (station, lateral) = one.place.route, one.at
    for moved in (station + rng.uniform(-1.5, 1.5, 10)).tolist():
        yaw = one.place.heading(moved) + one.turn
        if site.move(route.at(station, lateral), route.at(moved, lateral), one.half, yaw):
            return moved, lateral
    return one.at


def _add_cars(place: KnownPlace, along: _Roadside, site: Site, movables: list[_Movable]) -> None:
    rng, spec = along.stream("cars", 1), along.spec
    for k, (station, lateral) in enumerate(_scatter(rng, along, spec.furniture.cars, 1.25, 3.2)):
        kinds = furniture.VEHICLES
        kind = "van" if rng.random() < spec.furniture.vans else str(rng.choice(kinds[:-1]))
        turn = np.pi * int(rng.integers(0, 2)) + float(rng.normal(0.0, 0.03))
        skin = f"paint{int(rng.integers(len(spec.furniture.car_colors)))}"
        if rng.random() < 0.25:  # parked at right angles to the road
            turn, lateral = turn + np.pi / 2, float(lateral + np.sign(lateral) * 1.6)
        length, width = furniture.vehicle_size(kind)
        at, half = (station, lateral), (length / 2, width / 2)
        if site.take(place.route.at(*at), half, place.heading(station) + turn):
            add = partial(furniture.add_vehicle, place, along.numbered(k), turn=turn, kind=kind, skin=skin)
            movables.append(_Movable(place, at, half, turn, add))


_Adder = Callable[[int, tuple[float, float], np.random.Generator], None]
"""Adds object k at a station and lateral [m]; the generator samples its other properties."""


def _add_furniture(place: KnownPlace, along: _Roadside, site: Site, movables: list[_Movable]) -> None:
    f = along.spec.furniture

    def each(index: int, amount: float, near: float, far: float, radius: float, add: _Adder) -> None:
        rng = along.stream("furniture", 2, index)
        for k, at in enumerate(_scatter(rng, along, amount, near, far)):
            if site.take(place.route.at(*at), (radius, radius), place.heading(at[0])):
                add(along.numbered(k), at, rng)

    def sign(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        wide, high = float(rng.uniform(0.5, 1.3)), float(rng.uniform(1.7, 2.7))
        low = high - float(rng.uniform(0.45, 1.1))
        turn = float(rng.normal(0.0, 0.25)) + np.pi * (rng.random() < 0.25)
        furniture.add_sign(place, int(rng.integers(0, 6)) + 8 * k, *at, turn, (wide, low, high))

    def movable(at: tuple[float, float], radius: float, add: Callable[[float, float], None]) -> None:
        movables.append(_Movable(place, at, (radius, radius), 0.0, add))

    def waste_bin(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        skin = str(rng.choice(["green", "dark", "blue", "red", "zinc"]))
        movable(at, 0.35, partial(furniture.add_bin, place, k, skin=skin))

    def cone(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        movable(at, 0.3, partial(furniture.add_cone, place, k))

    def crate(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        movable(at, 0.75, partial(furniture.add_crate, place, k, side=float(rng.uniform(0.7, 1.2))))

    def cabinet(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        size = float(rng.uniform(0.5, 1.1)), float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.8, 1.4))
        furniture.add_cabinet(place, k, *at, size)

    def stone(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        furniture.add_stone(place, k, *at, float(rng.uniform(0.25, 0.65)))

    def bollard(k: int, at: tuple[float, float], rng: np.random.Generator) -> None:
        furniture.add_post(place, f"bollard_{k}", *at, float(rng.uniform(0.7, 1.1)), 0.07, "dark")

    each(0, f.signs, 0.25, 1.2, 0.35, sign)
    each(1, f.bins, 0.5, 2.5, 0.35, waste_bin)
    each(2, f.benches, 0.7, 2.8, 0.9, lambda k, at, rng: furniture.add_bench(place, k, *at))
    each(3, f.bollards, 0.2, 0.6, 0.12, bollard)
    each(4, f.cones, 0.3, 1.2, 0.3, cone)
    each(5, f.crates, 1.0, 4.0, 0.75, crate)
    each(6, f.cabinets, 0.6, 3.0, 0.6, cabinet)
    each(7, f.stones, 0.5, 6.0, 0.6, stone)


def _add_trees(place: KnownPlace, along: _Roadside, site: Site) -> None:
    rng, spec = along.stream("trees", 1), along.spec
    trees = spec.trees
    first, last = along.first, along.last
    spots: list[tuple[float, float]] = []
    for side in (1, -1):
        count = int(trees.density * (last - first + 8.0) / 100.0)
        row = max(1.0, 0.6 * along.verge(side))
        for k in range(count):
            station = first + (k + float(rng.uniform(0.2, 0.8))) / max(1, count) * (last - first + 8.0)
            beyond = row + float(rng.normal(0.0, 0.15)) if trees.row else float(rng.gamma(2.0, 3.5)) + 0.8
            spots.append((station, side * (along.edge(side) + beyond)))
    distant = 14 if spec.setting not in ("town", "works") else 5  # farther away from the road
    for _ in range(round(distant * max(1.0, (last - first) / _LONGEST_REACH))):
        side = int(rng.choice([-1, 1]))
        spots.append((float(rng.uniform(first, last + 25.0)), side * float(rng.uniform(14.0, 38.0))))
    for k, at in enumerate(spots, along.numbered(0)):
        kind, height = str(rng.choice(trees.kinds)), float(rng.uniform(*trees.height))
        skin = f"leaf{int(rng.integers(0, 3))}"
        crown, low = height * float(rng.uniform(0.22, 0.36)), float(rng.uniform(0.7, 1.8))
        radius = {"shrub": 0.5 * low}.get(kind, 0.35)
        clear = {"conifer": 0.9, "shrub": 0.5 * low}.get(kind, 0.4)
        if not site.take(place.route.at(*at), (radius, radius), 0.0, clear, 0.3):
            continue
        if kind == "conifer":
            add_conifer(place, k, at, 1.25 * height, skin)
        elif kind == "bare":
            add_bare_tree(place, k, at, height)
        elif kind == "shrub":
            add_shrub(place, k, at, low, skin)
        elif kind == "birch":
            add_crowned_tree(place, k, at, 1.1 * height, 0.6 * crown, 1.8, "leaf3")
        elif kind == "slender":
            add_crowned_tree(place, k, at, 1.3 * height, 0.55 * crown, 2.2, skin)
        else:
            add_crowned_tree(place, k, at, height, crown, 1.0, skin)


def _add_tufts(place: KnownPlace, along: _Roadside) -> None:
    rng, spec = along.stream("trees", 2), along.spec
    road, (first, last) = place.route, along.tufts
    count = int(spec.trees.tufts * (last - max(first, 0.0)))
    station = rng.uniform(first, last, count)
    side = rng.choice([-1, 1], count)
    edges = np.where(side > 0, along.edge(1), along.edge(-1))
    paved = np.where(side > 0, *along.paved)
    lateral = side * (edges + paved + 0.06 + rng.exponential(0.9, count).clip(0, 5.0))
    keep = np.ones(count, bool)
    for mouth in spec.line.mouths if not along.key else ():
        keep &= (np.abs(station - mouth.station) > mouth.width / 2 + 0.2) | (side != mouth.side)
    xy = road.at(station, lateral)
    keep &= np.abs(road.project(xy)[1]) > 0.5 * edges  # within a bend, a tuft may lie on another part of the road
    if keep.any():
        add_tufts(place, rng, station[keep], lateral[keep], f"tufts{along.suffix()}")
