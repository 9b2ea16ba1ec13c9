"""Street furniture and vehicles: each function adds one object with its collision shapes to a place.

Stations and laterals are those of the place's route; angles are relative to the direction of travel there.
"""

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, up, vertical_quad


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
    if k % 2 == 0:  # a smaller one on top
        top = foot + np.array([0.1, 0.05, side])
        stack.append(place.cell("planks", primitives.box((0.7, 0.7, 0.6)).moved(top, yaw + 0.4)))
        solids.append(Solid("box", top + up(0.3), (0.35, 0.35, 0.3), yaw + 0.4))
    place.objects.append(PlaceObject(f"crate_{k}", "obstacle", primitives.join(stack), "atlas", tuple(solids)))


def add_lamp_post(place: KnownPlace, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    inward = place.spot(station, lateral - np.sign(lateral) * 1.5)[:2] - foot[:2]
    top = foot + up(5.1)
    head = np.array([*(foot[:2] + inward), top[2] + 0.25])
    parts = [
        place.cell("zinc", primitives.tube(foot - up(0.1), top, 0.075, 0.05, 10)),
        place.cell("dark", primitives.tube(foot - up(0.1), foot + up(0.9), 0.11, 0.10, 10)),
        place.cell("zinc", primitives.tube(top, head, 0.04, 0.04, 8)),
    ]
    yaw = float(np.arctan2(inward[1], inward[0]))
    parts.append(place.cell("dark", primitives.box((0.62, 0.26, 0.10), 0.02).moved(head, yaw)))
    solid = Solid("cylinder", foot + up(2.5), (0.1, 2.6, 0.0))
    place.objects.append(PlaceObject(f"lamp_{k}", "obstacle", primitives.join(parts), "atlas", (solid,)))
    glass = place.cell("lamp", primitives.box((0.5, 0.2, 0.06), -0.04).moved(head, yaw))
    place.objects.append(PlaceObject(f"lamp_{k}_glass", "obstacle", glass, "lamp_glass"))
    place.lamp_heads.append(head)


def add_sign(
    place: KnownPlace, k: int, station: float, lateral: float, turn: float, size: tuple[float, float, float]
) -> None:
    """A sign turned by `turn` [rad] from facing the traffic; `size` is its width and the heights of its edges [m]."""
    foot = place.spot(station, lateral)
    yaw = place.heading(station) + turn
    c, s = np.cos(yaw), np.sin(yaw)
    across = np.array([s, -c])  # left to right as the reader sees it
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
