"""The place: ground, buildings, street furniture and vegetation. Solid objects stay outside ±1.6 m of the center line.

Tables state where objects stand, by station and lateral [m], and what differs between objects of a kind.
"""

import numpy as np

from twin.reality import centerline as roads
from twin.reality import primitives
from twin.reality.centerline import END, PAVEMENT_WIDTH, ROAD_HALF_WIDTH, START, RoadLine, ground_height
from twin.reality.place_objects import SEED, KnownPlace, PlaceObject, Solid, cell, up
from twin.reality.primitives import MeshPart
from twin.types import Array

# ---- buildings

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


def _add_building(
    place: KnownPlace,
    name: str,
    center: tuple[float, float],
    size: tuple[float, float, float],
    windows: tuple[int, int],
) -> None:
    """A block with a roof slab, windows in `windows` = (per 10 m of wall, floors), sills and doors."""
    rng = np.random.default_rng([SEED, 1, len(place.objects)])
    width, depth, height = size
    corners = np.array(center) + 0.5 * np.array([[a * width, b * depth] for a in (-1, 1) for b in (-1, 1)])
    base = float(ground_height(place.route, corners).min()) - 0.2
    origin = np.array([*center, 0.0])
    shell = primitives.walls(width, depth, base, base + height).moved(origin)
    solid = Solid("box", np.array([*center, base + height / 2]), (width / 2, depth / 2, height / 2))
    place.objects.append(PlaceObject(name, "obstacle", shell, name, (solid,)))
    roof = cell("tank", primitives.box((width + 0.7, depth + 0.7, 0.35), base + height).moved(origin))
    trim: list[MeshPart] = [roof]
    panes: list[tuple[int, MeshPart]] = []
    lit: list[tuple[int, MeshPart]] = []
    floor = (height - 0.6) / windows[1]
    for wall in range(4):
        length = (width, depth)[wall % 2]
        across = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][wall], float)
        out = np.array([across[1], -across[0]])
        face = np.array(center) + out * (depth, width)[wall % 2] / 2
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
                pane = vertical_quad(left + 0.02 * out, right + 0.02 * out, z0, z0 + tall)
                if is_door:
                    trim.append(cell(f"door{int(rng.integers(0, 2))}", pane))
                    canopy = primitives.box((wide + 0.8, 0.9, 0.12), z0 + tall + 0.15)
                    at = np.append(middle + 0.45 * out, 0.0)
                    trim.append(cell("dark", canopy.moved(at, float(np.arctan2(across[1], across[0])))))
                    continue
                shining = rng.random() < 0.42
                kind = int(rng.integers(0, 16))
                (lit if shining else panes).append((kind, pane))
                sill = primitives.box((wide + 0.2, 0.14, 0.07), z0 - 0.09)
                at = np.append(middle + 0.07 * out, 0.0)
                trim.append(cell("white", sill.moved(at, float(np.arctan2(across[1], across[0])))))
    place.objects.append(PlaceObject(f"{name}_trim", "obstacle", primitives.join(trim)))
    place.objects.append(
        PlaceObject(f"{name}_glass", "obstacle", primitives.join([cell(f"window{k}", p) for k, p in panes]))
    )
    # Windows lit after dark exist twice; the lighting decides which of the two is in the model.
    day = primitives.join([cell(f"window{k}", p) for k, p in lit])
    dark = primitives.join([cell(f"lit{k % 8}", p) for k, p in lit])
    place.objects.append(PlaceObject(f"{name}_day", "obstacle", day, "windows_by_day"))
    place.objects.append(PlaceObject(f"{name}_lit", "obstacle", dark, "windows_by_night"))


def vertical_quad(left: Array, right: Array, low: float, high: float) -> MeshPart:
    """A vertical rectangle between two points (x, y) [m] and two heights [m]."""
    return primitives.quad(np.array([[*left, high], [*left, low], [*right, low], [*right, high]]))


def add_buildings(place: KnownPlace) -> None:
    """Adds all buildings to a place."""
    for name, (center, size, windows) in BUILDINGS.items():
        _add_building(place, name, center, size, windows)


# ---- street furniture

_LAMPS = ((2.0, 3.75), (15.0, -3.75), (28.0, 3.75), (40.0, 3.9), (51.0, -3.75), (63.0, 3.75), (76.0, -3.75))
_SIGNS = (  # last: rotation from facing the traffic [rad]
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
_CRATES = (  # last: side [m]
    *((18.5, -5.0, 1.1), (18.6, -6.3, 0.9), (29.5, -5.6, 1.2)),
    *((45.5, 6.5, 1.0), (54.0, -5.3, 1.15), (65.0, -4.9, 1.0)),
)
_MIN_LATERAL = 2.15  # [m] closest that a displaced object comes to the center line
_CARS = ((31.2, -5.2, "white"), (12.6, -4.9, "blue"), (66.0, 5.4, "red"))


def add_street_furniture(place: KnownPlace, rng: np.random.Generator | None = None) -> None:
    """Adds all objects beside the road; with a generator, small ones are displaced, as on another day."""
    for k, lamp in enumerate(_LAMPS):
        _add_lamp_post(place, k, *lamp)
    for k, sign in enumerate(_SIGNS):
        _add_sign(place, k, *sign)
    for k, (station, lateral) in enumerate(_CONES):
        _add_cone(place, k, *_displaced(rng, station, lateral, 1.5, 0.2))
    for k, bench in enumerate(_BENCHES):
        _add_bench(place, k, *bench)
    for k, (station, lateral, skin) in enumerate(_BINS):
        station, lateral = _displaced(rng, station, lateral, 1.0, 0.2)
        foot = place.spot(station, lateral)
        part = cell(skin, primitives.tube(foot - up(0.05), foot + up(0.95), 0.24, 0.28, 14))
        solid = Solid("cylinder", foot + up(0.45), (0.27, 0.5, 0.0))
        place.objects.append(PlaceObject(f"bin_{k}", "obstacle", part, "atlas", (solid,)))
    for k, (station, lateral, side) in enumerate(_CRATES):
        _add_crate(place, k, *_displaced(rng, station, lateral, 0.5, 0.2), side)
    for k, (station, lateral, skin) in enumerate(_CARS):
        _add_car(place, k, *_displaced(rng, station, lateral, 1.5, 0.1), skin)
    for k, lateral in enumerate((-2.0, 0.0, 2.0)):  # the road ends here
        foot, yaw = place.spot(END - 3.0, lateral), place.heading(END) + np.pi / 2
        part = cell("barrier", primitives.box((1.8, 0.12, 1.0)).moved(foot, yaw))
        solid = Solid("box", foot + up(0.5), (0.9, 0.06, 0.5), yaw)
        place.objects.append(PlaceObject(f"barrier_{k}", "obstacle", part, "atlas", (solid,)))


def _displaced(
    rng: np.random.Generator | None, station: float, lateral: float, along: float, across: float
) -> tuple[float, float]:
    """Station and lateral displaced by at most `along` and `across` [m]; the lateral stays beyond `_MIN_LATERAL`."""
    if rng is None:
        return station, lateral
    station += rng.uniform(-along, along)
    away = max(abs(lateral) + rng.uniform(-across, across), min(abs(lateral), _MIN_LATERAL))
    return float(station), float(np.copysign(away, lateral))


def _add_cone(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    parts = [cell("cone", primitives.tube(foot + up(0.03), foot + up(0.62), 0.16, 0.03, 12))]
    parts.append(cell("rubber", primitives.box((0.42, 0.42, 0.04)).moved(foot, 0.3 * k)))
    solid = Solid("cylinder", foot + up(0.31), (0.16, 0.31, 0.0))
    place.objects.append(PlaceObject(f"cone_{k}", "obstacle", primitives.join(parts), "atlas", (solid,)))


def _add_crate(place: KnownPlace, k: int, station: float, lateral: float, side: float) -> None:
    foot = place.spot(station, lateral) - up(0.05)
    yaw = place.heading(station) + 0.37 * k
    stack = [cell("crate", primitives.box((side, side, side)).moved(foot, yaw))]
    solids = [Solid("box", foot + up(side / 2), (side / 2, side / 2, side / 2), yaw)]
    if k % 2 == 0:  # a smaller one on top
        top = foot + np.array([0.1, 0.05, side])
        stack.append(cell("planks", primitives.box((0.7, 0.7, 0.6)).moved(top, yaw + 0.4)))
        solids.append(Solid("box", top + up(0.3), (0.35, 0.35, 0.3), yaw + 0.4))
    place.objects.append(PlaceObject(f"crate_{k}", "obstacle", primitives.join(stack), "atlas", tuple(solids)))


def _add_lamp_post(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    inward = place.spot(station, lateral - np.sign(lateral) * 1.5)[:2] - foot[:2]
    top = foot + up(5.1)
    head = np.array([*(foot[:2] + inward), top[2] + 0.25])
    parts = [
        cell("zinc", primitives.tube(foot - up(0.1), top, 0.075, 0.05, 10)),
        cell("dark", primitives.tube(foot - up(0.1), foot + up(0.9), 0.11, 0.10, 10)),
        cell("zinc", primitives.tube(top, head, 0.04, 0.04, 8)),
    ]
    yaw = float(np.arctan2(inward[1], inward[0]))
    parts.append(cell("dark", primitives.box((0.62, 0.26, 0.10), 0.02).moved(head, yaw)))
    solid = Solid("cylinder", foot + up(2.5), (0.1, 2.6, 0.0))
    place.objects.append(PlaceObject(f"lamp_{k}", "obstacle", primitives.join(parts), "atlas", (solid,)))
    glass = cell("lamp", primitives.box((0.5, 0.2, 0.06), -0.04).moved(head, yaw))
    place.objects.append(PlaceObject(f"lamp_{k}_glass", "obstacle", glass, "lamp_glass"))
    place.lamp_heads.append(head)


def _add_sign(place: KnownPlace, k: int, station: float, lateral: float, turn: float) -> None:
    foot = place.spot(station, lateral)
    yaw = place.heading(station) + turn
    c, s = np.cos(yaw), np.sin(yaw)
    across = np.array([s, -c])  # left to right as the reader sees it
    high, low, wide = (2.4, 1.5, 0.9) if k % 3 else (1.9, 0.7, 1.3)
    face = foot[:2] - 0.05 * np.array([c, s])
    left, right = face - across * wide / 2, face + across * wide / 2
    board = cell(f"sign{k % 8}", vertical_quad(left, right, foot[2] + low, foot[2] + high))
    back = primitives.box((0.03, wide, high - low), foot[2] + low).moved(
        np.append(foot[:2] - 0.03 * np.array([c, s]), 0), yaw
    )
    pole = cell("zinc", primitives.tube(foot - up(0.1), foot + up(high + 0.05), 0.035, 0.035, 8))
    solids = (
        Solid("cylinder", foot + up(high / 2), (0.04, high / 2, 0.0)),
        Solid("box", np.append(foot[:2], foot[2] + (low + high) / 2), (0.05, wide / 2, (high - low) / 2), yaw),
    )
    place.objects.append(
        PlaceObject(f"sign_{k}", "obstacle", primitives.join([board, cell("zinc", back), pole]), "atlas", solids)
    )


def _add_bench(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    parts = [cell("planks", primitives.box((1.7, 0.45, 0.06), 0.42).moved(foot, yaw))]
    out = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * np.sign(lateral)
    parts.append(cell("planks", primitives.box((1.7, 0.06, 0.38), 0.52).moved(foot + 0.22 * out, yaw)))
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for end in (-0.7, 0.7):
        parts.append(cell("dark", primitives.box((0.07, 0.42, 0.50), -0.08).moved(foot + end * ahead, yaw)))
    solid = Solid("box", foot + up(0.22), (0.85, 0.24, 0.27), yaw)
    back = Solid("box", foot + 0.22 * out + up(0.7), (0.85, 0.04, 0.2), yaw)
    place.objects.append(PlaceObject(f"bench_{k}", "obstacle", primitives.join(parts), "atlas", (solid, back)))


def _add_car(place: KnownPlace, k: int, station: float, lateral: float, skin: str) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    c, s = np.cos(yaw), np.sin(yaw)
    parts = [cell(skin, primitives.box((4.0, 1.7, 0.62), 0.28).moved(foot, yaw))]
    parts.append(cell("glass", primitives.box((2.1, 1.55, 0.50), 0.90).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    parts.append(cell(skin, primitives.box((2.0, 1.5, 0.06), 1.40).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    for along in (-1.25, 1.25):
        for across in (-0.78, 0.78):
            hub = foot + np.array([along * c - across * s, along * s + across * c, 0.31])
            axle = 0.1 * np.array([-s, c, 0.0])
            parts.append(cell("rubber", primitives.tube(hub - axle, hub + axle, 0.31, 0.31, 14)))
    for along, name in ((-2.01, "sign7"), (2.01, "sign6")):
        plate = primitives.box((0.02, 0.5, 0.14), 0.5).moved(foot + np.array([along * c, along * s, 0.0]), yaw)
        parts.append(cell(name, plate))
    solids = (
        Solid("box", foot + up(0.45), (2.0, 0.87, 0.45), yaw),
        Solid("box", foot - 0.2 * np.array([c, s, 0]) + up(1.18), (1.05, 0.78, 0.28), yaw),
    )
    place.objects.append(PlaceObject(f"car_{k}", "obstacle", primitives.join(parts), "atlas", solids))


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


_HEDGES = ((0.0, 11.0, -7.6), (18.0, 30.0, 7.9), (46.0, 60.0, 7.6), (46.5, 58.0, -7.4))  # from, to, lateral [m]
_TUFTS = 5200


def add_vegetation(place: KnownPlace) -> None:
    """Adds trees, hedges and tufts of grass to a place."""
    for k, tree in enumerate(_TREES):
        _add_tree(place, k, *tree)
    for k, hedge in enumerate(_HEDGES):
        _add_hedge(place, k, *hedge)
    _add_tufts(place)


def _add_tree(place: KnownPlace, k: int, station: float, lateral: float, height: float, crown: float) -> None:
    rng = np.random.default_rng([SEED, 2, k])
    foot = place.spot(station, lateral)
    lean = np.append(rng.normal(0, 0.15, 2), 0.0)
    fork = foot + lean + up(0.42 * height)
    thick = 0.028 * height
    wood = [primitives.tube(foot - up(0.15), fork, thick * 1.25, thick * 0.75, 12, False)]
    clusters = []
    for b in range(7):
        angle, reach = b * 2.4 + rng.uniform(0, 0.6), crown * rng.uniform(0.45, 0.85)
        tip = fork + np.array([reach * np.cos(angle), reach * np.sin(angle), height * rng.uniform(0.10, 0.48)])
        wood.append(primitives.tube(fork - up(0.1), tip, thick * 0.4, thick * 0.12, 6, False))
        clusters.append(tip)
    clusters.append(fork + up(0.5 * height))
    centers = []
    for tip in clusters:
        ball = rng.normal(size=(330, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        radius = crown * 0.55 * rng.uniform(0.25, 1.0, (330, 1)) ** 0.5
        centers.append(tip + ball * radius * [1.0, 1.0, 0.75])
    crown_leaves = np.concatenate(centers)
    crown_leaves = crown_leaves[crown_leaves[:, 2] > foot[2] + 0.3 * height]
    trunk = Solid("cylinder", foot + up(0.2 * height), (thick * 1.1, 0.25 * height, 0.0))
    wood_part = cell(f"bark{k % 3}", primitives.join(wood))
    place.objects.append(PlaceObject(f"tree_{k}", "obstacle", wood_part, "atlas", (trunk,)))
    middle = crown_leaves.mean(0)
    outward = np.linalg.norm((crown_leaves - middle) / [crown, crown, 0.8 * crown], axis=1)
    light = 0.15 + 0.6 * np.clip(outward, 0, 1) ** 1.5 + 0.18 * (crown_leaves[:, 2] - middle[2]) / crown
    foliage = cell(f"leaf{k % 4}", primitives.leaves(rng, crown_leaves, (0.09, 0.21), light))
    place.objects.append(PlaceObject(f"tree_{k}_leaves", "foliage", foliage))


def _add_hedge(place: KnownPlace, k: int, start: float, end: float, lateral: float) -> None:
    rng = np.random.default_rng([SEED, 3, k])
    core, solids, centers = [], [], []
    for station in np.arange(start, end, 1.0):
        foot, yaw = place.spot(station + 0.5, lateral) - up(0.1), place.heading(station + 0.5)
        core.append(cell("hedge", primitives.box((1.15, 0.55, 0.95)).moved(foot, yaw)))
        solids.append(Solid("box", foot + up(0.5), (0.57, 0.35, 0.5), yaw))
        surface = rng.uniform(-1, 1, (260, 3)) * [0.55, 0.36, 0.5] + up(0.55)
        push = rng.integers(0, 3, 260)
        surface[push == 0, 2] = rng.normal(1.0, 0.06, (push == 0).sum())
        surface[push == 1, 1] = rng.normal(0.31, 0.04, (push == 1).sum())
        surface[push == 2, 1] = rng.normal(-0.31, 0.04, (push == 2).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        centers.append(surface @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + foot)
    tips = np.concatenate(centers)
    light = 0.25 + 0.5 * np.clip((tips[:, 2] - tips[:, 2].min()) / 1.1, 0.0, 1.0)
    twigs = cell("leaf1", primitives.leaves(rng, tips, (0.08, 0.17), light))
    place.objects.append(PlaceObject(f"hedge_{k}", "obstacle", primitives.join([*core, twigs]), "atlas", tuple(solids)))


def _add_tufts(place: KnownPlace) -> None:
    """Adds grass and weeds along the kerbs and on the verges."""
    rng = np.random.default_rng([SEED, 4])
    n = _TUFTS
    station = rng.uniform(START, 75.0, n)
    side = rng.choice([-1.0, 1.0], n)
    inner = np.where(side > 0, ROAD_HALF_WIDTH + PAVEMENT_WIDTH + 0.25, ROAD_HALF_WIDTH + 0.25)
    lateral = side * (inner + rng.exponential(0.9, n).clip(0, 4.5))
    xy = place.route.at(station, lateral)
    foot = np.concatenate([xy, ground_height(place.route, xy)[:, None]], 1)
    height, width = rng.uniform(0.05, 0.16, n), rng.uniform(0.03, 0.09, n)
    angle = rng.uniform(0, np.pi, n)
    across = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1) * width[:, None]
    tip = foot + np.stack([rng.normal(0, 0.04, n), rng.normal(0, 0.04, n), height], 1)
    window = rng.uniform(0.5, 0.9, (n, 1, 2)) + 0.08 * np.array([[0, 1], [1, 1], [0.5, 0]])
    points = np.stack([foot - across - up(0.02), foot + across - up(0.02), tip], 1)
    blades = MeshPart(points.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), window.reshape(-1, 2))
    place.objects.append(PlaceObject("tufts", "detail", cell("leaf2", blades)))


# ---- ground

LAND_RANGE = (-60.0, 120.0, -130.0, 60.0)  # [m] x and y range of the land beyond the verges
_LAND_STEP = 1.5


def build(route: RoadLine | None = None, displaced: bool = False) -> KnownPlace:
    """The campus road; the result is always the same.

    Args:
        route: Center line; the default road where None.
        displaced: The place on another day than the film's: cones, bins, crates and cars stand elsewhere.
    """
    place = KnownPlace(route or RoadLine())
    _add_ground(place)
    add_buildings(place)
    add_vegetation(place)
    add_street_furniture(place, np.random.default_rng([SEED, 8]) if displaced else None)
    return place


def _road_strip(route: RoadLine, laterals: list[float], heights: list[float] | None, step: float) -> MeshPart:
    """A strip along the road through laterals [m], left first, at heights above the undulation [m] or on the ground."""
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
    x, y = np.meshgrid(np.arange(x0, x1 + 0.1, _LAND_STEP), np.arange(y1, y0 - 0.1, -_LAND_STEP))
    xy = np.stack([x, y], -1)
    _, lateral = route.project(xy)
    sunk = np.where(
        np.abs(lateral) < edge + 1.5, 0.45, np.where(np.abs(lateral) < outer + roads.VERGE_WIDTH, 0.10, 0.03)
    )
    points = np.concatenate([xy, (roads.ground_height(route, xy) - sunk)[..., None]], -1)
    uv = np.stack([(x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)], -1)
    place.objects.append(PlaceObject("land", "ground", primitives.grid(points, uv), "land"))
