"""Trees, hedges and grass: each function adds one plant, or many of a kind, to a place."""

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, up
from twin.reality.primitives import MeshPart
from twin.types import Array


def add_tree(place: KnownPlace, k: int, station: float, lateral: float, height: float, crown: float) -> None:
    rng = place.rng(2, k)
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
    wood_part = place.cell(f"bark{k % 3}", primitives.join(wood))
    place.objects.append(PlaceObject(f"tree_{k}", "obstacle", wood_part, "atlas", (trunk,)))
    middle = crown_leaves.mean(0)
    outward = np.linalg.norm((crown_leaves - middle) / [crown, crown, 0.8 * crown], axis=1)
    light = 0.15 + 0.6 * np.clip(outward, 0, 1) ** 1.5 + 0.18 * (crown_leaves[:, 2] - middle[2]) / crown
    foliage = place.cell(f"leaf{k % 4}", primitives.leaves(rng, crown_leaves, (0.09, 0.21), light))
    place.objects.append(PlaceObject(f"tree_{k}_leaves", "foliage", foliage))


def add_hedge(place: KnownPlace, k: int, stations: Array, lateral: float) -> None:
    """A hedge of pieces 1 m long that begin at stations [m]."""
    rng = place.rng(3, k)
    core, solids, centers = [], [], []
    for station in stations:
        foot, yaw = place.spot(station + 0.5, lateral) - up(0.1), place.heading(station + 0.5)
        core.append(place.cell("hedge", primitives.box((1.15, 0.55, 0.95)).moved(foot, yaw)))
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
    twigs = place.cell("leaf1", primitives.leaves(rng, tips, (0.08, 0.17), light))
    place.objects.append(PlaceObject(f"hedge_{k}", "obstacle", primitives.join([*core, twigs]), "atlas", tuple(solids)))


def add_tufts(place: KnownPlace, rng: np.random.Generator, station: Array, lateral: Array) -> None:
    """Adds blades of grass and weeds at stations and laterals [m], shapes (n,)."""
    n = len(station)
    xy = place.route.at(station, lateral)
    foot = np.concatenate([xy, place.route.ground_height(xy)[:, None]], 1)
    height, width = rng.uniform(0.05, 0.16, n), rng.uniform(0.03, 0.09, n)
    angle = rng.uniform(0, np.pi, n)
    across = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1) * width[:, None]
    tip = foot + np.stack([rng.normal(0, 0.04, n), rng.normal(0, 0.04, n), height], 1)
    window = rng.uniform(0.5, 0.9, (n, 1, 2)) + 0.08 * np.array([[0, 1], [1, 1], [0.5, 0]])
    points = np.stack([foot - across - up(0.02), foot + across - up(0.02), tip], 1)
    blades = MeshPart(points.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), window.reshape(-1, 2))
    place.objects.append(PlaceObject("tufts", "detail", place.cell("leaf2", blades)))
