"""Trees, hedges and tufts of grass: foliage of many single leaves, with gaps that light passes through."""

import numpy as np

from twin.reality import shapes
from twin.reality.route import PAVEMENT_WIDTH, ROAD_HALF_WIDTH, START, ground_height
from twin.reality.shapes import Part
from twin.reality.things import SEED, Place, Solid, Thing, cell, up

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


def add(place: Place) -> None:
    """Adds all that grows to a place."""
    for k, tree in enumerate(_TREES):
        _tree(place, k, *tree)
    for k, hedge in enumerate(_HEDGES):
        _hedge(place, k, *hedge)
    _tufts(place)


def _tree(place: Place, k: int, station: float, lateral: float, height: float, crown: float) -> None:
    rng = np.random.default_rng([SEED, 2, k])
    foot = place.spot(station, lateral)
    lean = np.append(rng.normal(0, 0.15, 2), 0.0)
    fork = foot + lean + up(0.42 * height)
    thick = 0.028 * height
    wood = [shapes.tube(foot - up(0.15), fork, thick * 1.25, thick * 0.75, 12, False)]
    clusters = []
    for b in range(7):
        angle, reach = b * 2.4 + rng.uniform(0, 0.6), crown * rng.uniform(0.45, 0.85)
        tip = fork + np.array([reach * np.cos(angle), reach * np.sin(angle), height * rng.uniform(0.10, 0.48)])
        wood.append(shapes.tube(fork - up(0.1), tip, thick * 0.4, thick * 0.12, 6, False))
        clusters.append(tip)
    clusters.append(fork + up(0.5 * height))
    centres = []
    for tip in clusters:
        ball = rng.normal(size=(330, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        radius = crown * 0.55 * rng.uniform(0.25, 1.0, (330, 1)) ** 0.5
        centres.append(tip + ball * radius * [1.0, 1.0, 0.75])
    crown_leaves = np.concatenate(centres)
    crown_leaves = crown_leaves[crown_leaves[:, 2] > foot[2] + 0.3 * height]
    trunk = Solid("cylinder", foot + up(0.2 * height), (thick * 1.1, 0.25 * height, 0.0))
    wood_part = cell(f"bark{k % 3}", shapes.join(wood))
    place.things.append(Thing(f"tree_{k}", "obstacle", wood_part, "atlas", (trunk,)))
    middle = crown_leaves.mean(0)
    outward = np.linalg.norm((crown_leaves - middle) / [crown, crown, 0.8 * crown], axis=1)
    light = 0.15 + 0.6 * np.clip(outward, 0, 1) ** 1.5 + 0.18 * (crown_leaves[:, 2] - middle[2]) / crown
    foliage = cell(f"leaf{k % 4}", shapes.leaves(rng, crown_leaves, (0.09, 0.21), light))
    place.things.append(Thing(f"tree_{k}_leaves", "foliage", foliage))


def _hedge(place: Place, k: int, start: float, end: float, lateral: float) -> None:
    rng = np.random.default_rng([SEED, 3, k])
    core, solids, centres = [], [], []
    for station in np.arange(start, end, 1.0):
        foot, yaw = place.spot(station + 0.5, lateral) - up(0.1), place.heading(station + 0.5)
        core.append(cell("hedge", shapes.box((1.15, 0.55, 0.95)).moved(foot, yaw)))
        solids.append(Solid("box", foot + up(0.5), (0.57, 0.35, 0.5), yaw))
        surface = rng.uniform(-1, 1, (260, 3)) * [0.55, 0.36, 0.5] + up(0.55)
        push = rng.integers(0, 3, 260)
        surface[push == 0, 2] = rng.normal(1.0, 0.06, (push == 0).sum())
        surface[push == 1, 1] = rng.normal(0.31, 0.04, (push == 1).sum())
        surface[push == 2, 1] = rng.normal(-0.31, 0.04, (push == 2).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        centres.append(surface @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + foot)
    tips = np.concatenate(centres)
    light = 0.25 + 0.5 * np.clip((tips[:, 2] - tips[:, 2].min()) / 1.1, 0.0, 1.0)
    twigs = cell("leaf1", shapes.leaves(rng, tips, (0.08, 0.17), light))
    place.things.append(Thing(f"hedge_{k}", "obstacle", shapes.join([*core, twigs]), "atlas", tuple(solids)))


def _tufts(place: Place) -> None:
    """Grass and weeds that stand up a little along the kerbs and on the verges."""
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
    blades = Part(points.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), window.reshape(-1, 2))
    place.things.append(Thing("tufts", "detail", cell("leaf2", blades)))
