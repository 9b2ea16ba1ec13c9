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
    """Adds a hedge of pieces 1 m long, which begin at the stations [m]."""
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


def add_tufts(place: KnownPlace, rng: np.random.Generator, station: Array, lateral: Array, name: str = "tufts") -> None:
    """Adds blades of grass and weeds at stations and laterals [m], shapes (n,), as one object."""
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
    place.objects.append(PlaceObject(name, "detail", place.cell("leaf2", blades)))


# ---- trees of sampled places


def add_crowned_tree(
    place: KnownPlace, k: int, spot: tuple[float, float], height: float, crown: float, slender: float, skin: str
) -> None:
    """Adds a broadleaf tree at a station and lateral [m]; a larger `slender` gives a higher crown of the same width."""
    rng = place.rng(2, k)
    foot = place.spot(*spot)
    lean = np.append(rng.normal(0, 0.03 * height, 2), 0.0)
    stem = float(rng.uniform(0.25, 0.42)) / slender**0.5
    fork, thick = foot + lean + up(stem * height), 0.025 * height
    wood = [primitives.tube(foot - up(0.2), fork, thick * 1.25, thick * 0.8, 10, False)]
    top = foot + lean + up(height)
    wood.append(primitives.tube(fork - up(0.1), top - up(0.1 * height), thick * 0.7, thick * 0.15, 6, False))
    branches = int(rng.integers(6, 11))
    clusters = [top - up(0.3 * crown)]
    for b in range(branches):
        angle, share = b * 2.4 + rng.uniform(0, 0.8), (b + rng.uniform(0, 1)) / branches
        reach = crown * rng.uniform(0.5, 0.8) * (1.0 - 0.6 * share**2)
        rise = (height - stem * height - 0.4 * crown) * share
        tip = fork + np.array([reach * np.cos(angle), reach * np.sin(angle), rise])
        wood.append(primitives.tube(fork + up(0.5 * rise), tip, thick * 0.35, thick * 0.1, 5, False))
        clusters.append(tip)
    per = int(1700 / len(clusters))
    centers = []
    for tip in clusters:
        ball = rng.normal(size=(per, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        radius = max(crown, 0.16 * height) * rng.uniform(0.45, 0.7) * rng.uniform(0.2, 1.0, (per, 1)) ** 0.5
        centers.append(tip + ball * radius * [1.0, 1.0, 0.8 * slender**0.5])
    _grow(place, rng, k, foot, stem * height, thick, wood, np.concatenate(centers), (0.12, 0.30), crown, skin)


def add_conifer(place: KnownPlace, k: int, spot: tuple[float, float], height: float, skin: str) -> None:
    """Adds a conifer: whorls of drooping boughs that shorten towards the tip."""
    rng = place.rng(2, k)
    foot = place.spot(*spot)
    thick, width = 0.02 * height, height * float(rng.uniform(0.16, 0.28))
    bare = float(rng.uniform(0.04, 0.25))
    wood = [primitives.tube(foot - up(0.2), foot + up(height), thick * 1.2, 0.01, 8, False)]
    n = 1900
    share = 1.0 - np.sqrt(rng.uniform(0.0, 1.0, n))  # 0 at the lowest boughs, 1 at the tip
    tier = (np.floor(share * 11) + rng.uniform(0.0, 0.55, n)) / 11
    angle, reach = rng.uniform(0, 2 * np.pi, n), width * (1.0 - share) * rng.uniform(0.15, 1.0, n) ** 0.6
    z = (bare + (1.0 - bare) * tier) * height - 0.35 * reach
    needles = foot + np.stack([reach * np.cos(angle), reach * np.sin(angle), z], 1)
    _grow(place, rng, k, foot, bare * height + 1.0, thick, wood, needles, (0.14, 0.38), width, skin)


def add_bare_tree(place: KnownPlace, k: int, spot: tuple[float, float], height: float) -> None:
    """Adds a tree without leaves, whose branches fork three times."""
    rng = place.rng(2, k)
    foot = place.spot(*spot)
    wood: list[MeshPart] = []

    def branch(start: Array, direction: Array, length: float, thick: float, depth: int) -> None:
        end = start + length * direction
        wood.append(primitives.tube(start, end, thick, 0.6 * thick, 9 - 2 * depth, False))
        if depth == 3:
            return
        for _ in range(int(rng.integers(2, 5))):
            way = direction + rng.normal(0.0, 0.5, 3) + up(0.15)
            begin = start + float(rng.uniform(0.6, 1.0)) * length * direction
            branch(begin, way / np.linalg.norm(way), length * float(rng.uniform(0.5, 0.8)), 0.55 * thick, depth + 1)

    lean = np.append(rng.normal(0.0, 0.06, 2), 1.0)
    thick = 0.024 * height
    branch(foot - up(0.2), lean / np.linalg.norm(lean), 0.4 * height, thick, 0)
    trunk = Solid("cylinder", foot + up(0.2 * height), (thick, 0.22 * height, 0.0))
    part = place.cell(f"bark{k % 3}", primitives.join(wood))
    place.objects.append(PlaceObject(f"tree_{k}", "obstacle", part, "atlas", (trunk,)))


def add_shrub(place: KnownPlace, k: int, spot: tuple[float, float], height: float, skin: str) -> None:
    """Adds a shrub, of which only the middle is solid."""
    rng = place.rng(2, k)
    foot = place.spot(*spot)
    ball = rng.normal(size=(650, 3))
    ball[:, 2] = np.abs(ball[:, 2])
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    twigs = foot + ball * rng.uniform(0.4, 1.0, (650, 1)) ** 0.5 * [0.55 * height, 0.55 * height, height]
    wood = [primitives.tube(foot - up(0.1), foot + up(0.6 * height), 0.05, 0.02, 5, False)]
    _grow(place, rng, k, foot, 0.4 * height, 0.25 * height, wood, twigs, (0.08, 0.2), height, skin)


def _grow(
    place: KnownPlace,
    rng: np.random.Generator,
    k: int,
    foot: Array,
    stem: float,
    radius: float,
    wood: list[MeshPart],
    centers: Array,
    leaf: tuple[float, float],
    crown: float,
    skin: str,
) -> None:
    """Adds a plant's wood, with the trunk's collision shape (height `stem`, `radius` [m]), and the plant's leaves."""
    centers = centers[centers[:, 2] > foot[2] + 0.1]
    trunk = Solid("cylinder", foot + up(0.5 * stem), (radius * 1.1, 0.5 * stem + 0.1, 0.0))
    bark = "birch" if skin == "leaf3" and "birch" in place.cells else f"bark{k % 3}"
    part = place.cell(bark, primitives.join(wood))
    place.objects.append(PlaceObject(f"tree_{k}", "obstacle", part, "atlas", (trunk,)))
    middle = centers.mean(0)
    outward = np.clip(np.linalg.norm((centers - middle) / crown, axis=1), 0, 1)
    light = 0.15 + 0.6 * outward**1.5 + 0.18 * np.clip((centers[:, 2] - middle[2]) / crown, -1, 1)
    leaves = place.cell(skin, primitives.leaves(rng, centers, leaf, light))
    place.objects.append(PlaceObject(f"tree_{k}_leaves", "foliage", leaves))
