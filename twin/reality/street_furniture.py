"""Street furniture, vehicles and boundaries: each function adds an object with its collision shapes to a place.

Stations and laterals are those of the place's route; angles are relative to its direction at the station. *Boundaries*
beside the road are fences, walls, hedges and rows of bollards, in short pieces that follow the ground.
"""

from itertools import pairwise

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, up, vertical_quad
from twin.reality.place_spec import BoundarySpec
from twin.reality.plants import add_hedge
from twin.reality.primitives import MeshPart
from twin.types import Array


def add_cone(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    parts = [place.cell("cone", primitives.tube(foot + up(0.03), foot + up(0.62), 0.16, 0.03, 12))]
    parts.append(place.cell("rubber", primitives.box((0.42, 0.42, 0.04)).moved(foot, 0.3 * k)))
    solid = Solid("cylinder", foot + up(0.31), (0.16, 0.31, 0.0))
    place.objects.append(PlaceObject(f"cone_{k}", "obstacle", primitives.join(parts), "atlas", (solid,)))


def add_crate(place: KnownPlace, k: int, station: float, lateral: float, side: float) -> None:
    foot = place.spot(station, lateral) - up(0.05)
    yaw = place.heading(station) + 0.37 * k
    stack = [place.cell("crate", primitives.box((side, side, side)).moved(foot, yaw))]
    solids = [Solid("box", foot + up(side / 2), (side / 2, side / 2, side / 2), yaw)]
    if k % 2 == 0:  # a smaller crate on top
        top = foot + np.array([0.1, 0.05, side])
        stack.append(place.cell("planks", primitives.box((0.7, 0.7, 0.6)).moved(top, yaw + 0.4)))
        solids.append(Solid("box", top + up(0.3), (0.35, 0.35, 0.3), yaw + 0.4))
    place.objects.append(PlaceObject(f"crate_{k}", "obstacle", primitives.join(stack), "atlas", tuple(solids)))


def add_lamp_post(
    place: KnownPlace,
    k: int,
    station: float,
    lateral: float,
    height: float = 5.1,
    arms: tuple[float, ...] = (1.5,),
    shines: bool = True,
) -> None:
    """Adds a lamp post with a head on each arm; lengths of arms [m] are positive towards the road."""
    foot = place.spot(station, lateral)
    top = foot + up(height)
    parts = [
        place.cell("zinc", primitives.tube(foot - up(0.1), top, 0.075, 0.05, 10)),
        place.cell("dark", primitives.tube(foot - up(0.1), foot + up(0.9), 0.11, 0.10, 10)),
    ]
    glasses = []
    for arm in arms:
        inward = place.spot(station, lateral - np.sign(lateral) * arm)[:2] - foot[:2]
        head = np.array([*(foot[:2] + inward), top[2] + 0.25])
        yaw = float(np.arctan2(inward[1], inward[0]))
        parts.append(place.cell("zinc", primitives.tube(top, head, 0.04, 0.04, 8)))
        parts.append(place.cell("dark", primitives.box((0.62, 0.26, 0.10), 0.02).moved(head, yaw)))
        glasses.append(
            place.cell("lamp" if shines else "glass", primitives.box((0.5, 0.2, 0.06), -0.04).moved(head, yaw))
        )
        if shines:
            place.lamp_heads.append(head)
    _add_lamp(place, k, foot, height, parts, glasses, shines)


def add_lantern(
    place: KnownPlace, k: int, station: float, lateral: float, height: float, shape: str, shines: bool
) -> None:
    """Adds a lamp on top of a post: `post_top` is a disc under a hat, `lantern` a glass box that widens upwards."""
    foot = place.spot(station, lateral)
    top = foot + up(height)
    parts = [place.cell("dark", primitives.tube(foot - up(0.1), top, 0.07, 0.045, 10))]
    glass = "lamp" if shines else "glass"
    if shape == "lantern":
        parts.append(place.cell("dark", primitives.tube(foot - up(0.1), foot + up(0.7), 0.13, 0.09, 8)))
        glasses = [place.cell(glass, primitives.tube(top, top + up(0.42), 0.12, 0.22, 4))]
        parts.append(place.cell("dark", primitives.tube(top + up(0.42), top + up(0.62), 0.27, 0.03, 4)))
    else:
        glasses = [place.cell(glass, primitives.tube(top, top + up(0.16), 0.16, 0.22, 12))]
        parts.append(place.cell("zinc", primitives.tube(top + up(0.16), top + up(0.26), 0.36, 0.30, 12)))
    if shines:
        place.lamp_heads.append(top + up(0.1))
    _add_lamp(place, k, foot, height, parts, glasses, shines)


def _add_lamp(
    place: KnownPlace,
    k: int,
    foot: Array,
    height: float,
    parts: list[MeshPart],
    glasses: list[MeshPart],
    shines: bool,
) -> None:
    solid = Solid("cylinder", foot + up(0.5 * height - 0.05), (0.1, 0.5 * height + 0.05, 0.0))
    place.objects.append(PlaceObject(f"lamp_{k}", "obstacle", primitives.join(parts), "atlas", (solid,)))
    skin = "lamp_glass" if shines else "atlas"
    place.objects.append(PlaceObject(f"lamp_{k}_glass", "obstacle", primitives.join(glasses), skin))


def add_sign(
    place: KnownPlace, k: int, station: float, lateral: float, turn: float, size: tuple[float, float, float]
) -> None:
    """Adds a sign turned by `turn` [rad] from facing the traffic.

    `size` is its width and the heights of its lower and upper edge [m].
    """
    foot = place.spot(station, lateral)
    yaw = place.heading(station) + turn
    c, s = np.cos(yaw), np.sin(yaw)
    across = np.array([s, -c])  # from left to right as a reader of the sign sees it
    wide, low, high = size
    face = foot[:2] - 0.05 * np.array([c, s])
    left, right = face - across * wide / 2, face + across * wide / 2
    board = place.cell(f"sign{k % 8}", vertical_quad(left, right, foot[2] + low, foot[2] + high))
    back = primitives.box((0.03, wide, high - low), foot[2] + low).moved(
        np.append(foot[:2] - 0.03 * np.array([c, s]), 0), yaw
    )
    pole = place.cell("zinc", primitives.tube(foot - up(0.1), foot + up(high + 0.05), 0.035, 0.035, 8))
    solids = (
        Solid("cylinder", foot + up(high / 2), (0.04, high / 2, 0.0)),
        Solid("box", np.append(foot[:2], foot[2] + (low + high) / 2), (0.05, wide / 2, (high - low) / 2), yaw),
    )
    place.objects.append(
        PlaceObject(f"sign_{k}", "obstacle", primitives.join([board, place.cell("zinc", back), pole]), "atlas", solids)
    )


def add_bench(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    parts = [place.cell("planks", primitives.box((1.7, 0.45, 0.06), 0.42).moved(foot, yaw))]
    out = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * np.sign(lateral)
    parts.append(place.cell("planks", primitives.box((1.7, 0.06, 0.38), 0.52).moved(foot + 0.22 * out, yaw)))
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for end in (-0.7, 0.7):
        parts.append(place.cell("dark", primitives.box((0.07, 0.42, 0.50), -0.08).moved(foot + end * ahead, yaw)))
    solid = Solid("box", foot + up(0.22), (0.85, 0.24, 0.27), yaw)
    back = Solid("box", foot + 0.22 * out + up(0.7), (0.85, 0.04, 0.2), yaw)
    place.objects.append(PlaceObject(f"bench_{k}", "obstacle", primitives.join(parts), "atlas", (solid, back)))


def add_car(place: KnownPlace, k: int, station: float, lateral: float, skin: str) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    c, s = np.cos(yaw), np.sin(yaw)
    parts = [place.cell(skin, primitives.box((4.0, 1.7, 0.62), 0.28).moved(foot, yaw))]
    parts.append(
        place.cell("glass", primitives.box((2.1, 1.55, 0.50), 0.90).moved(foot - 0.2 * np.array([c, s, 0]), yaw))
    )
    parts.append(place.cell(skin, primitives.box((2.0, 1.5, 0.06), 1.40).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    for along in (-1.25, 1.25):
        for across in (-0.78, 0.78):
            hub = foot + np.array([along * c - across * s, along * s + across * c, 0.31])
            axle = 0.1 * np.array([-s, c, 0.0])
            parts.append(place.cell("rubber", primitives.tube(hub - axle, hub + axle, 0.31, 0.31, 14)))
    for along, name in ((-2.01, "sign7"), (2.01, "sign6")):
        plate = primitives.box((0.02, 0.5, 0.14), 0.5).moved(foot + np.array([along * c, along * s, 0.0]), yaw)
        parts.append(place.cell(name, plate))
    solids = (
        Solid("box", foot + up(0.45), (2.0, 0.87, 0.45), yaw),
        Solid("box", foot - 0.2 * np.array([c, s, 0]) + up(1.18), (1.05, 0.78, 0.28), yaw),
    )
    place.objects.append(PlaceObject(f"car_{k}", "obstacle", primitives.join(parts), "atlas", solids))


def add_bin(place: KnownPlace, k: int, station: float, lateral: float, skin: str) -> None:
    foot = place.spot(station, lateral)
    part = place.cell(skin, primitives.tube(foot - up(0.05), foot + up(0.95), 0.24, 0.28, 14))
    solid = Solid("cylinder", foot + up(0.45), (0.27, 0.5, 0.0))
    place.objects.append(PlaceObject(f"bin_{k}", "obstacle", part, "atlas", (solid,)))


# ---- furniture of sampled places

# Length, width, height [m]; side views of body and windows as corners (x, z) in units of length and height, x ahead.
_VEHICLES: dict[str, tuple[tuple[float, float, float], list[tuple[float, float]], list[tuple[float, float]]]] = {
    "hatchback": (
        (3.9, 1.72, 1.48),
        [(-0.5, 0.18), (0.48, 0.16), (0.5, 0.42), (0.44, 0.58), (0.2, 0.66), (-0.5, 0.68)],
        [(-0.47, 0.66), (0.22, 0.64), (0.04, 1.0), (-0.36, 1.0)],
    ),
    "saloon": (
        (4.5, 1.78, 1.44),
        [(-0.5, 0.2), (0.48, 0.16), (0.5, 0.44), (0.42, 0.6), (-0.48, 0.66), (-0.5, 0.5)],
        [(-0.36, 0.64), (0.22, 0.6), (0.06, 1.0), (-0.2, 1.0)],
    ),
    "estate": (
        (4.7, 1.8, 1.6),
        [(-0.5, 0.2), (0.48, 0.16), (0.5, 0.44), (0.42, 0.58), (-0.5, 0.64)],
        [(-0.49, 0.62), (0.24, 0.58), (0.1, 1.0), (-0.42, 1.0)],
    ),
    "van": (
        (4.9, 1.95, 2.1),
        [(-0.5, 0.14), (0.49, 0.12), (0.5, 0.36), (0.42, 0.5), (0.28, 0.97), (-0.5, 1.0)],
        [(0.2, 0.55), (0.41, 0.53), (0.31, 0.9), (0.2, 0.9)],
    ),
}
VEHICLES = tuple(_VEHICLES)
"""Kinds of vehicles."""


def vehicle_size(kind: str) -> tuple[float, float]:
    """Length and width of a vehicle [m]."""
    return _VEHICLES[kind][0][:2]


def add_vehicle(place: KnownPlace, k: int, station: float, lateral: float, turn: float, kind: str, skin: str) -> None:
    """Adds a vehicle."""
    (length, width, height), body, cabin = _VEHICLES[kind]
    foot, yaw = place.spot(station, lateral), place.heading(station) + turn
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    ends = [place.route.ground_height(foot[:2] + sign * 0.3 * length * ahead) for sign in (-1.0, 1.0)]
    foot[2] = float(np.mean(ends))
    scale = np.array([length, height])
    narrow = 1.01 if kind == "van" else 0.90
    parts = [
        place.cell(skin, primitives.prism(np.array(body) * scale, width)),
        place.cell("glass", primitives.prism(np.array(cabin) * scale, narrow * width)),
    ]
    if kind != "van":
        roof = 0.96 * (cabin[2][0] - cabin[3][0]) * length, 0.88 * width, 0.05
        at = np.array([0.5 * (cabin[2][0] + cabin[3][0]) * length, 0.0, 0.0])
        parts.append(place.cell(skin, primitives.box(roof, height - 0.02).moved(at)))
    for along in (-0.31, 0.33):
        for across in (-0.45, 0.45):
            hub = np.array([along * length, across * width, 0.32])
            axle = np.array([0.0, 0.11, 0.0])
            parts.append(place.cell("rubber", primitives.tube(hub - axle, hub + axle, 0.32, 0.32, 14)))
            cap = np.array([0.0, np.sign(across) * 0.12, 0.0])
            parts.append(place.cell("zinc", primitives.tube(hub, hub + cap, 0.19, 0.19, 10)))
    for along, name in ((-0.503, "sign7"), (0.503, "sign6")):
        plate = primitives.box((0.02, 0.5, 0.12), 0.34 * height if kind != "van" else 0.3 * height)
        parts.append(place.cell(name, plate.moved(np.array([along * length, 0.0, 0.0]))))
        for side in (-0.36, 0.36):
            lamp = primitives.box((0.03, 0.3, 0.13), 0.36 * min(height, 1.6))
            light = "red" if along < 0.0 else "white"
            parts.append(place.cell(light, lamp.moved(np.array([0.99 * along * length, side * width, 0.0]))))
    mesh = primitives.join(parts).moved(foot, yaw)
    low = 0.62 * height if kind != "van" else height
    solids = [Solid("box", foot + up(low / 2), (length / 2, width / 2, low / 2), yaw)]
    if kind != "van":
        middle = 0.25 * length * sum(x for x, _ in cabin)
        half = (0.22 * length, 0.45 * width, 0.19 * height)
        solids.append(Solid("box", foot + np.array([*(middle * ahead), 0.81 * height]), half, yaw))
    place.objects.append(PlaceObject(f"car_{k}", "obstacle", mesh, "atlas", tuple(solids)))


def add_post(
    place: KnownPlace, name: str, station: float, lateral: float, height: float, radius: float, skin: str
) -> None:
    """Adds an upright post: a bollard if it is lower than 2 m, else a pole for wires."""
    foot = place.spot(station, lateral)
    parts = [place.cell(skin, primitives.tube(foot - up(0.2), foot + up(height), radius, 0.8 * radius, 10))]
    if height < 2.0:
        ring = primitives.tube(foot + up(0.78 * height), foot + up(0.88 * height), 1.03 * radius, radius, 10)
        parts.append(place.cell("white", ring))
    else:
        yaw = place.heading(station)
        parts.append(place.cell(skin, primitives.box((0.12, 1.6, 0.12), height - 0.6).moved(foot, yaw)))
    solid = Solid("cylinder", foot + up(height / 2), (radius, height / 2, 0.0))
    place.objects.append(PlaceObject(name, "obstacle", primitives.join(parts), "atlas", (solid,)))


def add_wires(place: KnownPlace, name: str, feet: list[tuple[float, float]], height: float) -> None:
    """Adds three sagging wires along poles at stations and laterals [m]."""
    parts = []
    share = np.linspace(0.0, 1.0, 9)
    for (s0, l0), (s1, l1) in pairwise(feet):
        a, b = place.spot(s0, l0) + up(height - 0.48), place.spot(s1, l1) + up(height - 0.48)
        for offset in (-0.7, 0.0, 0.7):
            sides = [offset * np.array([-np.sin(place.heading(s)), np.cos(place.heading(s)), 0.0]) for s in (s0, s1)]
            line = (a + sides[0]) * (1 - share[:, None]) + (b + sides[1]) * share[:, None]
            line[:, 2] -= 0.5 * 4.0 * share * (1.0 - share)
            parts += [primitives.tube(p, q, 0.012, 0.012, 4, False) for p, q in pairwise(line)]
    place.objects.append(PlaceObject(name, "detail", place.cell("dark", primitives.join(parts))))


def add_cabinet(place: KnownPlace, k: int, station: float, lateral: float, size: tuple[float, float, float]) -> None:
    """Adds a utility cabinet."""
    foot, yaw = place.spot(station, lateral) - up(0.1), place.heading(station)
    base = place.cell("tank", primitives.box((size[0] + 0.06, size[1] + 0.06, 0.2)).moved(foot, yaw))
    box = place.cell("cabinet", primitives.box(size, 0.2).moved(foot, yaw))
    solid = Solid("box", foot + up(size[2] / 2 + 0.1), (size[0] / 2, size[1] / 2, size[2] / 2 + 0.1), yaw)
    place.objects.append(PlaceObject(f"cabinet_{k}", "obstacle", primitives.join([base, box]), "atlas", (solid,)))


def add_stone(place: KnownPlace, k: int, station: float, lateral: float, radius: float) -> None:
    """Adds a boulder."""
    rng = place.rng(9, k)
    foot = place.spot(station, lateral)
    angle, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 11), np.linspace(0.5 * np.pi, -0.3, 6))
    swell = rng.uniform(0.75, 1.1, angle.shape)
    swell[:, -1] = swell[:, 0]
    swell[0] = swell[0, 0]
    points = np.stack([np.cos(rise) * np.cos(angle), np.cos(rise) * np.sin(angle), 0.75 * np.sin(rise)], -1)
    points = foot + radius * swell[..., None] * points
    mesh = primitives.grid(points[..., :2], points[..., 2], angle / (2 * np.pi), 0.5 - rise / np.pi)
    part = place.cell("stone", mesh)
    solid = Solid("cylinder", foot + up(0.3 * radius), (0.85 * radius, 0.35 * radius, 0.0))
    place.objects.append(PlaceObject(f"stone_{k}", "obstacle", part, "atlas", (solid,)))


# ---- boundaries

BAY = 2.0  # [m] length of a piece
THICKNESS = {"wall": 0.26, "hedge": 0.7, "picket": 0.06, "boards": 0.06, "rails": 0.09, "mesh": 0.06, "bollards": 0.2}
"""Thickness of a boundary by its kind [m]."""


def add_boundary(place: KnownPlace, k: int, spec: BoundarySpec, stations: Array, lateral: float) -> None:
    """Adds part k of the boundary at a lateral [m]: pieces of length `BAY` that begin at the stations [m].

    One bollard stands at each station.
    """
    if not len(stations):
        return
    side = "left" if lateral > 0.0 else "right"
    name, skin = f"{side}_{spec.kind}_{k}", f"boundary_{side}"
    if spec.kind == "hedge":
        halves = np.sort(np.concatenate([stations, stations + 0.5 * BAY]))
        add_hedge(place, 2 * k + (side == "right"), halves, lateral)
        return
    if spec.kind == "bollards":
        for number, station in enumerate(stations):
            add_post(place, f"{name}_{number}", float(station), lateral, spec.height, 0.08, skin)
        return
    parts: list[MeshPart] = []
    solids: list[Solid] = []
    for station in stations:
        ends = [place.spot(float(s), lateral) for s in (station, station + BAY)]
        off = ends[1] - ends[0]
        length, yaw = float(np.hypot(*off[:2])), float(np.arctan2(off[1], off[0]))
        bay = _bay(place, spec, skin, length)
        # Pieces are sheared rather than tilted, so that their posts stay upright.
        bay.vertices[:, 2] += (bay.vertices[:, 0] / length + 0.5) * off[2]
        middle = 0.5 * (ends[0] + ends[1])
        parts.append(bay.moved(np.append(middle[:2], ends[0][2]), yaw))
        half = (length / 2, THICKNESS[spec.kind] / 2, spec.height / 2 + 0.1)
        solids.append(Solid("box", middle + up(spec.height / 2), half, yaw))
    place.objects.append(PlaceObject(name, "obstacle", primitives.join(parts), "atlas", tuple(solids)))


def _bay(place: KnownPlace, spec: BoundarySpec, skin: str, length: float) -> MeshPart:
    """One piece of a boundary, with x along the boundary and the origin on the ground in the middle of the piece."""
    h, parts = spec.height, []

    def bar(x: float, size: tuple[float, float, float], base: float, y: float = 0.0, cell: str = skin) -> None:
        parts.append(place.cell(cell, primitives.box(size, base).moved(np.array([x, y, 0.0]))))

    if spec.kind == "wall":
        bar(0.0, (length + 0.04, 0.24, h + 0.3), -0.3)
        bar(0.0, (length + 0.06, 0.32, 0.07), h, cell="tank")
    elif spec.kind == "mesh":
        bar(-length / 2, (0.06, 0.06, h + 0.3), -0.2)
        bar(0.0, (length, 0.035, 0.035), h - 0.05)
        bar(0.0, (length, 0.03, 0.03), 0.05)
        for x in np.arange(-length / 2 + 0.1, length / 2, 0.1):
            bar(float(x), (0.012, 0.012, h - 0.1), 0.05)
    else:
        bar(-length / 2, (0.1, 0.1, h + 0.3), -0.2)
        rails = np.linspace(0.25 * h, 0.8 * h, 3 if spec.kind == "rails" else 2)
        for z in rails:
            bar(0.0, (length, 0.05, 0.10), float(z), 0.04)
        step, wide = (0.15, 0.14) if spec.kind == "boards" else (0.17, 0.08)
        if spec.kind != "rails":
            for x in np.arange(-length / 2 + 0.12, length / 2 - 0.02, step):
                bar(float(x), (wide, 0.022, h), 0.04)
    return primitives.join(parts)
