"""What stands where along the road: every thing of the known-truth world as textured surface and as collision shape.

A *thing* has a kind: `ground` is driven or walked on, `obstacle` is solid, `foliage` lets light and wind through, and
`detail` is too small to matter. Stations and laterals are those of `route.py`; everything solid stays outside ±1.6 m.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.reality import route as roads
from twin.reality import shapes
from twin.reality.route import ROAD_HALF_WIDTH, Route
from twin.reality.shapes import Part

Array = NDArray[np.float64]

SEED = 20  # of everything random in the place, its textures and its sky
ROAD_START, ROAD_END = -6.0, 88.0  # [m] stations between which the road is paved
VERGE_WIDTH = 5.6  # [m] beyond the kerb
PAVEMENT_WIDTH = 1.7  # [m] slabs along the left kerb
_ATLAS = 8  # cells per side of the atlas
CELLS = (
    ["bark0", "bark1", "bark2", "leaf0", "leaf1", "leaf2", "leaf3", "hedge"]
    + ["zinc", "dark", "green", "red", "blue", "white", "rubber", "glass"]
    + ["planks", "crate", "cone", "barrier", "door0", "door1", "lamp", "tank"]
    + [f"sign{k}" for k in range(8)]
    + [f"window{k}" for k in range(16)]
    + [f"lit{k}" for k in range(8)]
)


@dataclass(frozen=True)
class Solid:
    """A collision shape: an upright box or cylinder."""

    kind: str
    centre: Array
    """Of its volume [m], shape (3,)."""
    half: tuple[float, float, float]
    """Half sizes of a box; radius, half height, 0 of a cylinder [m]."""
    yaw: float = 0.0


@dataclass(frozen=True)
class Thing:
    """Something of the place."""

    name: str
    kind: str
    part: Part
    texture: str = "atlas"
    solids: tuple[Solid, ...] = ()


def cell(name: str, part: Part) -> Part:
    """Maps a part's texture into its cell of the atlas."""
    row, column = divmod(CELLS.index(name), _ATLAS)
    low, inset = np.array([column, row]) / _ATLAS, 1.5 / 2048
    return part.in_window(low + inset, low + 1.0 / _ATLAS - inset)


@dataclass
class Place:
    """The whole place: its things, and the lamps' heads [m]."""

    route: Route
    things: list[Thing] = field(default_factory=list)
    lamp_heads: list[Array] = field(default_factory=list)

    def spot(self, station: float, lateral: float) -> Array:
        """The point of the ground at a station and lateral, shape (3,)."""
        xy = self.route.at(np.float64(station), lateral)
        return np.append(xy, roads.ground_height(self.route, xy))

    def heading(self, station: float) -> float:
        return float(self.route.heading(np.float64(station)))


def build(route: Route | None = None) -> Place:
    """The campus road. Deterministic: the same place each time."""
    place = Place(route or Route())
    _ground(place)
    _buildings(place)
    _trees(place)
    _street(place)
    return place


def _ribbon(route: Route, laterals: list[float], heights: list[float] | None, step: float) -> Part:
    """A strip along the road through given laterals (left first); heights [m] over the undulation, None = the ground's."""
    stations = np.arange(ROAD_START, ROAD_END + step / 2, step)
    across = np.asarray(laterals, float)
    xy = route.at(stations[None], across[:, None])
    z = roads.undulation(xy) + (roads.cross_profile(across) if heights is None else np.asarray(heights))[:, None]
    if len(laterals) > 1:
        span = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(across), np.diff((z - roads.undulation(xy))[:, 0])))])
        v = span / span[-1]
    u = (stations - ROAD_START) / (ROAD_END - ROAD_START)
    return shapes.grid(np.concatenate([xy, z[..., None]], -1), np.stack(np.broadcast_arrays(u[None], v[:, None]), -1))


def _ground(place: Place) -> None:
    route, edge = place.route, ROAD_HALF_WIDTH
    crossing = np.linspace(edge, -edge, 13)
    place.things.append(Thing("road", "ground", _ribbon(route, list(crossing), None, 0.5), "road"))
    low = float(roads.cross_profile(np.float64(edge)))
    outer = edge + roads.KERB_WIDTH
    high = float(roads.cross_profile(np.float64(outer)))
    for side, name in ((1.0, "left"), (-1.0, "right")):
        profile = [(edge, low - 0.02), (edge + 0.015, high - 0.012), (edge + 0.03, high), (outer, high)]
        verge = np.linspace(outer, outer + VERGE_WIDTH, 8)
        if side > 0:
            profile, verge = profile[::-1], verge[::-1]
        kerb = _ribbon(route, [side * p[0] for p in profile], [p[1] for p in profile], 0.5)
        place.things.append(Thing(f"kerb_{name}", "ground", kerb, "kerb"))
        strip = _ribbon(route, [side * v for v in verge], None, 0.5)
        place.things.append(Thing(f"verge_{name}", "ground", strip, f"verge_{name}"))
    x, y = np.meshgrid(np.arange(-60.0, 121.0, 1.5), np.arange(60.0, -131.0, -1.5))
    xy = np.stack([x, y], -1)
    _, lateral = route.project(xy)
    sunk = np.where(np.abs(lateral) < edge + 1.5, 0.45, np.where(np.abs(lateral) < outer + VERGE_WIDTH, 0.10, 0.03))
    points = np.concatenate([xy, (roads.ground_height(route, xy) - sunk)[..., None]], -1)
    uv = np.stack([(x + 60.0) / 181.0, (60.0 - y) / 191.0], -1)
    place.things.append(Thing("land", "ground", shapes.grid(points, uv), "land"))


def _building(
    place: Place, name: str, centre: tuple[float, float], size: tuple[float, float, float], windows: tuple[int, int]
) -> None:
    """A block with a roof slab, windows in `windows` = (per 10 m of wall, floors), sills and doors."""
    rng = np.random.default_rng([SEED, 1, len(place.things)])
    width, depth, height = size
    corners = np.array(centre) + 0.5 * np.array([[a * width, b * depth] for a in (-1, 1) for b in (-1, 1)])
    base = float(roads.ground_height(place.route, corners).min()) - 0.2
    origin = np.array([*centre, 0.0])
    shell = shapes.walls(width, depth, base, base + height).moved(origin)
    solid = Solid("box", np.array([*centre, base + height / 2]), (width / 2, depth / 2, height / 2))
    place.things.append(Thing(name, "obstacle", shell, name, (solid,)))
    roof = cell("tank", shapes.box((width + 0.7, depth + 0.7, 0.35), base + height).moved(origin))
    trim, panes, lit = [roof], [], []
    floor = (height - 0.6) / windows[1]
    for wall in range(4):
        length = (width, depth)[wall % 2]
        across = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][wall], float)
        out = np.array([across[1], -across[0]])
        face = np.array(centre) + out * (depth, width)[wall % 2] / 2
        count = max(2, round(length / 10.0 * windows[0]))
        door = int(rng.integers(0, count))
        for level in range(windows[1]):
            for k in range(count):
                along = length * ((k + 0.5) / count - 0.5)
                middle = face + across * along
                is_door = level == 0 and k == door
                tall, wide = (2.25, 1.25) if is_door else (min(1.75, floor * 0.58), 1.2)
                z0 = base + 0.2 if is_door else base + 0.6 + level * floor + 0.35 * (floor - tall)
                left, right = middle - across * wide / 2, middle + across * wide / 2
                pane = _upright(left + 0.02 * out, right + 0.02 * out, z0, z0 + tall)
                if is_door:
                    trim.append(cell(f"door{int(rng.integers(0, 2))}", pane))
                    canopy = shapes.box((wide + 0.8, 0.9, 0.12), z0 + tall + 0.15)
                    at = np.append(middle + 0.45 * out, 0.0)
                    trim.append(cell("dark", canopy.moved(at, float(np.arctan2(across[1], across[0])))))
                    continue
                shining = rng.random() < 0.42
                kind = int(rng.integers(0, 16))
                (lit if shining else panes).append((kind, pane))
                sill = shapes.box((wide + 0.2, 0.14, 0.07), z0 - 0.09)
                at = np.append(middle + 0.07 * out, 0.0)
                trim.append(cell("white", sill.moved(at, float(np.arctan2(across[1], across[0])))))
    place.things.append(Thing(f"{name}_trim", "obstacle", shapes.join(trim)))
    place.things.append(Thing(f"{name}_glass", "obstacle", shapes.join([cell(f"window{k}", p) for k, p in panes])))
    # Windows that are lit after dark: which texture they show depends on the lighting.
    day = shapes.join([cell(f"window{k}", p) for k, p in lit])
    dark = shapes.join([cell(f"lit{k % 8}", p) for k, p in lit])
    place.things.append(Thing(f"{name}_day", "obstacle", day, "windows_by_day"))
    place.things.append(Thing(f"{name}_lit", "obstacle", dark, "windows_by_night"))


def _upright(left: Array, right: Array, low: float, high: float) -> Part:
    """A vertical rectangle between two points of the plan."""
    return shapes.quad(np.array([[*left, high], [*left, low], [*right, low], [*right, high]]))


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


def _buildings(place: Place) -> None:
    for name, (centre, size, windows) in BUILDINGS.items():
        _building(place, name, centre, size, windows)


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


def _trees(place: Place) -> None:
    for k, (station, lateral, height, crown) in enumerate(_TREES):
        rng = np.random.default_rng([SEED, 2, k])
        foot = place.spot(station, lateral)
        lean = np.append(rng.normal(0, 0.15, 2), 0.0)
        fork = foot + lean + np.array([0, 0, 0.42 * height])
        thick = 0.028 * height
        wood = [shapes.tube(foot - [0, 0, 0.15], fork, thick * 1.25, thick * 0.75, 12, False)]
        clusters = []
        for b in range(7):
            angle, reach = b * 2.4 + rng.uniform(0, 0.6), crown * rng.uniform(0.45, 0.85)
            tip = fork + np.array([reach * np.cos(angle), reach * np.sin(angle), height * rng.uniform(0.10, 0.48)])
            wood.append(shapes.tube(fork - [0, 0, 0.1], tip, thick * 0.4, thick * 0.12, 6, False))
            clusters.append(tip)
        clusters.append(fork + [0, 0, 0.5 * height])
        centres = []
        for tip in clusters:
            ball = rng.normal(size=(230, 3))
            ball /= np.linalg.norm(ball, axis=1, keepdims=True)
            radius = crown * 0.55 * rng.uniform(0.25, 1.0, (230, 1)) ** 0.5
            centres.append(tip + ball * radius * [1.0, 1.0, 0.75])
        crown_leaves = np.concatenate(centres)
        crown_leaves = crown_leaves[crown_leaves[:, 2] > foot[2] + 0.3 * height]
        trunk = Solid("cylinder", foot + [0, 0, 0.2 * height], (thick * 1.1, 0.25 * height, 0.0))
        wood_part = cell(f"bark{k % 3}", shapes.join(wood))
        place.things.append(Thing(f"tree_{k}", "obstacle", wood_part, "atlas", (trunk,)))
        foliage = cell(f"leaf{k % 4}", shapes.leaves(rng, crown_leaves, (0.14, 0.30)))
        place.things.append(Thing(f"tree_{k}_leaves", "foliage", foliage))


def _street(place: Place) -> None:
    for k, (station, lateral) in enumerate([(2, 3.75), (15, -3.75), (28, 3.75), (40, 3.9), (51, -3.75), (63, 3.75), (76, -3.75)]):
        _lamp_post(place, k, station, lateral)
    for k, (station, lateral, turn) in enumerate(
        [(6, -3.7, 0.1), (11, 3.6, -0.2), (20, -3.8, 0.0), (27.5, -4.0, 0.5), (33, 4.6, -0.4), (37.5, 4.4, -0.9)]
        + [(46, 3.7, 0.0), (55, -3.7, 0.2), (67, -3.7, 0.0), (72, 3.8, 0.1)]
    ):
        _sign(place, k, station, lateral, turn)
    for k, (station, lateral) in enumerate(
        [(19, 2.35), (20.6, 2.2), (22.4, 2.25), (24.1, 2.4), (35.5, 2.5), (47.5, -2.4), (49.2, -2.3), (58, 2.4), (68, -2.3)]
    ):
        foot = place.spot(station, lateral)
        cone = [cell("cone", shapes.tube(foot + [0, 0, 0.03], foot + [0, 0, 0.62], 0.16, 0.03, 12))]
        cone.append(cell("rubber", shapes.box((0.42, 0.42, 0.04)).moved(foot, 0.3 * k)))
        solid = Solid("cylinder", foot + [0, 0, 0.31], (0.16, 0.31, 0.0))
        place.things.append(Thing(f"cone_{k}", "obstacle", shapes.join(cone), "atlas", (solid,)))
    for k, (station, lateral) in enumerate([(9.5, 4.6), (26, 4.7), (43.5, 4.7), (57, 4.6), (69, 4.6)]):
        _bench(place, k, station, lateral)
    for k, (station, lateral, skin) in enumerate(
        [(10.9, 4.6, "green"), (17.5, -3.9, "dark"), (38.7, 5.2, "blue"), (58.6, 4.6, "green"), (48.5, 4.4, "red")]
    ):
        foot = place.spot(station, lateral)
        bin_part = cell(skin, shapes.tube(foot - [0, 0, 0.05], foot + [0, 0, 0.95], 0.24, 0.28, 14))
        solid = Solid("cylinder", foot + [0, 0, 0.45], (0.27, 0.5, 0.0))
        place.things.append(Thing(f"bin_{k}", "obstacle", bin_part, "atlas", (solid,)))
    crates = [(18.5, -5.0, 1.1), (18.6, -6.3, 0.9), (29.5, -5.6, 1.2), (45.5, 6.5, 1.0), (54.0, -5.3, 1.15), (65.0, -4.9, 1.0)]
    for k, (station, lateral, side) in enumerate(crates):
        foot = place.spot(station, lateral) - [0, 0, 0.05]
        yaw = place.heading(station) + 0.37 * k
        stack = [cell("crate", shapes.box((side, side, side)).moved(foot, yaw))]
        solids = [Solid("box", foot + [0, 0, side / 2], (side / 2, side / 2, side / 2), yaw)]
        if k % 2 == 0:
            top = foot + [0.1, 0.05, side]
            stack.append(cell("planks", shapes.box((0.7, 0.7, 0.6)).moved(top, yaw + 0.4)))
            solids.append(Solid("box", top + [0, 0, 0.3], (0.35, 0.35, 0.3), yaw + 0.4))
        place.things.append(Thing(f"crate_{k}", "obstacle", shapes.join(stack), "atlas", tuple(solids)))
    for k, (station, lateral, skin) in enumerate([(30.8, -5.0, "white"), (12.6, -4.9, "blue"), (66.0, 5.4, "red")]):
        _car(place, k, station, lateral, skin)
    for k, (start, end, lateral) in enumerate([(0.0, 11.0, -7.6), (18.0, 30.0, 7.9), (46.0, 60.0, 7.6), (46.5, 58.0, -7.4)]):
        _hedge(place, k, start, end, lateral)
    for k, lateral in enumerate((-2.0, 0.0, 2.0)):  # the road ends here
        foot = place.spot(ROAD_END - 3.0, lateral)
        yaw = place.heading(ROAD_END) + np.pi / 2
        part = cell("barrier", shapes.box((1.8, 0.12, 1.0)).moved(foot, yaw))
        solid = Solid("box", foot + [0, 0, 0.5], (0.9, 0.06, 0.5), yaw)
        place.things.append(Thing(f"barrier_{k}", "obstacle", part, "atlas", (solid,)))
    _tufts(place)


def _lamp_post(place: Place, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    inward = place.spot(station, lateral - np.sign(lateral) * 1.5)[:2] - foot[:2]
    top = foot + [0, 0, 5.1]
    head = np.array([*(foot[:2] + inward), top[2] + 0.25])
    parts = [
        cell("zinc", shapes.tube(foot - [0, 0, 0.1], top, 0.075, 0.05, 10)),
        cell("dark", shapes.tube(foot - [0, 0, 0.1], foot + [0, 0, 0.9], 0.11, 0.10, 10)),
        cell("zinc", shapes.tube(top, head, 0.04, 0.04, 8)),
    ]
    yaw = float(np.arctan2(inward[1], inward[0]))
    parts.append(cell("dark", shapes.box((0.62, 0.26, 0.10), 0.02).moved(head, yaw)))
    solid = Solid("cylinder", foot + [0, 0, 2.5], (0.1, 2.6, 0.0))
    place.things.append(Thing(f"lamp_{k}", "obstacle", shapes.join(parts), "atlas", (solid,)))
    glass = cell("lamp", shapes.box((0.5, 0.2, 0.06), -0.04).moved(head, yaw))
    place.things.append(Thing(f"lamp_{k}_glass", "obstacle", glass, "lamp_glass"))
    place.lamp_heads.append(head)


def _sign(place: Place, k: int, station: float, lateral: float, turn: float) -> None:
    foot = place.spot(station, lateral)
    yaw = place.heading(station) + turn
    c, s = np.cos(yaw), np.sin(yaw)
    across = np.array([s, -c])  # the reader's left to right, seen while driving
    high, low, wide = (2.4, 1.5, 0.9) if k % 3 else (1.9, 0.7, 1.3)
    face = foot[:2] - 0.05 * np.array([c, s])
    left, right = face - across * wide / 2, face + across * wide / 2
    board = cell(f"sign{k % 8}", _upright(left, right, foot[2] + low, foot[2] + high))
    back = shapes.box((0.03, wide, high - low), foot[2] + low).moved(np.append(foot[:2] - 0.03 * np.array([c, s]), 0), yaw)
    pole = cell("zinc", shapes.tube(foot - [0, 0, 0.1], foot + [0, 0, high + 0.05], 0.035, 0.035, 8))
    solids = (
        Solid("cylinder", foot + [0, 0, high / 2], (0.04, high / 2, 0.0)),
        Solid("box", np.append(foot[:2], foot[2] + (low + high) / 2), (0.05, wide / 2, (high - low) / 2), yaw),
    )
    place.things.append(Thing(f"sign_{k}", "obstacle", shapes.join([board, cell("zinc", back), pole]), "atlas", solids))


def _bench(place: Place, k: int, station: float, lateral: float) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    parts = [cell("planks", shapes.box((1.7, 0.45, 0.06), 0.42).moved(foot, yaw))]
    out = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * np.sign(lateral)
    parts.append(cell("planks", shapes.box((1.7, 0.06, 0.38), 0.52).moved(foot + 0.22 * out, yaw)))
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for end in (-0.7, 0.7):
        parts.append(cell("dark", shapes.box((0.07, 0.42, 0.50), -0.08).moved(foot + end * ahead, yaw)))
    solid = Solid("box", foot + [0, 0, 0.22], (0.85, 0.24, 0.27), yaw)
    back = Solid("box", foot + 0.22 * out + [0, 0, 0.7], (0.85, 0.04, 0.2), yaw)
    place.things.append(Thing(f"bench_{k}", "obstacle", shapes.join(parts), "atlas", (solid, back)))


def _car(place: Place, k: int, station: float, lateral: float, skin: str) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    c, s = np.cos(yaw), np.sin(yaw)
    parts = [cell(skin, shapes.box((4.0, 1.7, 0.62), 0.28).moved(foot, yaw))]
    parts.append(cell("glass", shapes.box((2.1, 1.55, 0.50), 0.90).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    parts.append(cell(skin, shapes.box((2.0, 1.5, 0.06), 1.40).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    for along in (-1.25, 1.25):
        for across in (-0.78, 0.78):
            hub = foot + [along * c - across * s, along * s + across * c, 0.31]
            axle = 0.1 * np.array([-s, c, 0.0])
            parts.append(cell("rubber", shapes.tube(hub - axle, hub + axle, 0.31, 0.31, 14)))
    for along, name in ((-2.01, "sign7"), (2.01, "sign6")):
        plate = shapes.box((0.02, 0.5, 0.14), 0.5).moved(foot + [along * c, along * s, 0.0], yaw)
        parts.append(cell(name, plate))
    solids = (
        Solid("box", foot + [0, 0, 0.45], (2.0, 0.87, 0.45), yaw),
        Solid("box", foot - 0.2 * np.array([c, s, 0]) + [0, 0, 1.18], (1.05, 0.78, 0.28), yaw),
    )
    place.things.append(Thing(f"car_{k}", "obstacle", shapes.join(parts), "atlas", solids))


def _hedge(place: Place, k: int, start: float, end: float, lateral: float) -> None:
    rng = np.random.default_rng([SEED, 3, k])
    core, solids, centres = [], [], []
    for station in np.arange(start, end, 1.0):
        foot, yaw = place.spot(station + 0.5, lateral) - [0, 0, 0.1], place.heading(station + 0.5)
        core.append(cell("hedge", shapes.box((1.15, 0.55, 0.95)).moved(foot, yaw)))
        solids.append(Solid("box", foot + [0, 0, 0.5], (0.57, 0.35, 0.5), yaw))
        surface = rng.uniform(-1, 1, (150, 3)) * [0.55, 0.36, 0.5] + [0, 0, 0.55]
        push = rng.integers(0, 3, 150)
        surface[push == 0, 2] = rng.normal(1.0, 0.06, (push == 0).sum())
        surface[push == 1, 1] = rng.normal(0.31, 0.04, (push == 1).sum())
        surface[push == 2, 1] = rng.normal(-0.31, 0.04, (push == 2).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        centres.append(surface @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + foot)
    twigs = cell("leaf1", shapes.leaves(rng, np.concatenate(centres), (0.10, 0.2)))
    place.things.append(Thing(f"hedge_{k}", "obstacle", shapes.join([*core, twigs]), "atlas", tuple(solids)))


def _tufts(place: Place) -> None:
    """Grass and weeds that stand up a little along the kerbs and on the verges."""
    rng = np.random.default_rng([SEED, 4])
    n = 5200
    station = rng.uniform(ROAD_START, 75.0, n)
    side = rng.choice([-1.0, 1.0], n)
    inner = np.where(side > 0, ROAD_HALF_WIDTH + PAVEMENT_WIDTH + 0.25, ROAD_HALF_WIDTH + 0.25)
    lateral = side * (inner + rng.exponential(0.9, n).clip(0, 4.5))
    xy = place.route.at(station, lateral)
    foot = np.concatenate([xy, roads.ground_height(place.route, xy)[:, None]], 1)
    height, width = rng.uniform(0.05, 0.16, n), rng.uniform(0.03, 0.09, n)
    angle = rng.uniform(0, np.pi, n)
    across = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1) * width[:, None]
    tip = foot + np.stack([rng.normal(0, 0.04, n), rng.normal(0, 0.04, n), height], 1)
    window = rng.uniform(0, 0.9, (n, 1, 2)) + 0.08 * np.array([[0, 1], [1, 1], [0.5, 0]])
    points = np.stack([foot - across - [0, 0, 0.02], foot + across - [0, 0, 0.02], tip], 1)
    blades = Part(points.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), window.reshape(-1, 2))
    place.things.append(Thing("tufts", "detail", cell("leaf2", blades)))
