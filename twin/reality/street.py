"""What stands beside the road: lamp posts, signs, cones, benches, bins, crates, cars, and the barrier at its end.

Where each thing stands is in the tables at the top: station and lateral [m], then what differs from one to the next.
"""

import numpy as np

from twin.reality import shapes
from twin.reality.buildings import upright
from twin.reality.route import END
from twin.reality.things import Place, Solid, Thing, cell, up

_LAMPS = ((2.0, 3.75), (15.0, -3.75), (28.0, 3.75), (40.0, 3.9), (51.0, -3.75), (63.0, 3.75), (76.0, -3.75))
_SIGNS = (  # turned from facing the traffic [rad]
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
_CRATES = (  # side [m]
    *((18.5, -5.0, 1.1), (18.6, -6.3, 0.9), (29.5, -5.6, 1.2)),
    *((45.5, 6.5, 1.0), (54.0, -5.3, 1.15), (65.0, -4.9, 1.0)),
)
_KEPT_FREE = 2.15  # [m] from the centre line that nothing's middle is moved into
_CARS = ((31.2, -5.2, "white"), (12.6, -4.9, "blue"), (66.0, 5.4, "red"))


def add(place: Place, later: np.random.Generator | None = None) -> None:
    """Adds everything beside the road to a place; with a generator as on another day, when small things have moved."""
    for k, lamp in enumerate(_LAMPS):
        _lamp_post(place, k, *lamp)
    for k, sign in enumerate(_SIGNS):
        _sign(place, k, *sign)
    for k, (station, lateral) in enumerate(_CONES):
        _cone(place, k, *_moved(later, station, lateral, 1.5, 0.2))
    for k, bench in enumerate(_BENCHES):
        _bench(place, k, *bench)
    for k, (station, lateral, skin) in enumerate(_BINS):
        station, lateral = _moved(later, station, lateral, 1.0, 0.2)
        foot = place.spot(station, lateral)
        part = cell(skin, shapes.tube(foot - up(0.05), foot + up(0.95), 0.24, 0.28, 14))
        solid = Solid("cylinder", foot + up(0.45), (0.27, 0.5, 0.0))
        place.things.append(Thing(f"bin_{k}", "obstacle", part, "atlas", (solid,)))
    for k, (station, lateral, side) in enumerate(_CRATES):
        _crate(place, k, *_moved(later, station, lateral, 0.5, 0.2), side)
    for k, (station, lateral, skin) in enumerate(_CARS):
        _car(place, k, *_moved(later, station, lateral, 1.5, 0.1), skin)
    for k, lateral in enumerate((-2.0, 0.0, 2.0)):  # the road ends here
        foot, yaw = place.spot(END - 3.0, lateral), place.heading(END) + np.pi / 2
        part = cell("barrier", shapes.box((1.8, 0.12, 1.0)).moved(foot, yaw))
        solid = Solid("box", foot + up(0.5), (0.9, 0.06, 0.5), yaw)
        place.things.append(Thing(f"barrier_{k}", "obstacle", part, "atlas", (solid,)))


def _moved(
    later: np.random.Generator | None, station: float, lateral: float, along: float, across: float
) -> tuple[float, float]:
    """Station and lateral of a thing that has been moved by up to so much [m], never nearer than `_KEPT_FREE`."""
    if later is None:
        return station, lateral
    station += later.uniform(-along, along)
    away = max(abs(lateral) + later.uniform(-across, across), min(abs(lateral), _KEPT_FREE))
    return float(station), float(np.copysign(away, lateral))


def _cone(place: Place, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    parts = [cell("cone", shapes.tube(foot + up(0.03), foot + up(0.62), 0.16, 0.03, 12))]
    parts.append(cell("rubber", shapes.box((0.42, 0.42, 0.04)).moved(foot, 0.3 * k)))
    solid = Solid("cylinder", foot + up(0.31), (0.16, 0.31, 0.0))
    place.things.append(Thing(f"cone_{k}", "obstacle", shapes.join(parts), "atlas", (solid,)))


def _crate(place: Place, k: int, station: float, lateral: float, side: float) -> None:
    foot = place.spot(station, lateral) - up(0.05)
    yaw = place.heading(station) + 0.37 * k
    stack = [cell("crate", shapes.box((side, side, side)).moved(foot, yaw))]
    solids = [Solid("box", foot + up(side / 2), (side / 2, side / 2, side / 2), yaw)]
    if k % 2 == 0:  # a smaller one on top
        top = foot + np.array([0.1, 0.05, side])
        stack.append(cell("planks", shapes.box((0.7, 0.7, 0.6)).moved(top, yaw + 0.4)))
        solids.append(Solid("box", top + up(0.3), (0.35, 0.35, 0.3), yaw + 0.4))
    place.things.append(Thing(f"crate_{k}", "obstacle", shapes.join(stack), "atlas", tuple(solids)))


def _lamp_post(place: Place, k: int, station: float, lateral: float) -> None:
    foot = place.spot(station, lateral)
    inward = place.spot(station, lateral - np.sign(lateral) * 1.5)[:2] - foot[:2]
    top = foot + up(5.1)
    head = np.array([*(foot[:2] + inward), top[2] + 0.25])
    parts = [
        cell("zinc", shapes.tube(foot - up(0.1), top, 0.075, 0.05, 10)),
        cell("dark", shapes.tube(foot - up(0.1), foot + up(0.9), 0.11, 0.10, 10)),
        cell("zinc", shapes.tube(top, head, 0.04, 0.04, 8)),
    ]
    yaw = float(np.arctan2(inward[1], inward[0]))
    parts.append(cell("dark", shapes.box((0.62, 0.26, 0.10), 0.02).moved(head, yaw)))
    solid = Solid("cylinder", foot + up(2.5), (0.1, 2.6, 0.0))
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
    board = cell(f"sign{k % 8}", upright(left, right, foot[2] + low, foot[2] + high))
    back = shapes.box((0.03, wide, high - low), foot[2] + low).moved(
        np.append(foot[:2] - 0.03 * np.array([c, s]), 0), yaw
    )
    pole = cell("zinc", shapes.tube(foot - up(0.1), foot + up(high + 0.05), 0.035, 0.035, 8))
    solids = (
        Solid("cylinder", foot + up(high / 2), (0.04, high / 2, 0.0)),
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
    solid = Solid("box", foot + up(0.22), (0.85, 0.24, 0.27), yaw)
    back = Solid("box", foot + 0.22 * out + up(0.7), (0.85, 0.04, 0.2), yaw)
    place.things.append(Thing(f"bench_{k}", "obstacle", shapes.join(parts), "atlas", (solid, back)))


def _car(place: Place, k: int, station: float, lateral: float, skin: str) -> None:
    foot, yaw = place.spot(station, lateral), place.heading(station)
    c, s = np.cos(yaw), np.sin(yaw)
    parts = [cell(skin, shapes.box((4.0, 1.7, 0.62), 0.28).moved(foot, yaw))]
    parts.append(cell("glass", shapes.box((2.1, 1.55, 0.50), 0.90).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    parts.append(cell(skin, shapes.box((2.0, 1.5, 0.06), 1.40).moved(foot - 0.2 * np.array([c, s, 0]), yaw)))
    for along in (-1.25, 1.25):
        for across in (-0.78, 0.78):
            hub = foot + np.array([along * c - across * s, along * s + across * c, 0.31])
            axle = 0.1 * np.array([-s, c, 0.0])
            parts.append(cell("rubber", shapes.tube(hub - axle, hub + axle, 0.31, 0.31, 14)))
    for along, name in ((-2.01, "sign7"), (2.01, "sign6")):
        plate = shapes.box((0.02, 0.5, 0.14), 0.5).moved(foot + np.array([along * c, along * s, 0.0]), yaw)
        parts.append(cell(name, plate))
    solids = (
        Solid("box", foot + up(0.45), (2.0, 0.87, 0.45), yaw),
        Solid("box", foot - 0.2 * np.array([c, s, 0]) + up(1.18), (1.05, 0.78, 0.28), yaw),
    )
    place.things.append(Thing(f"car_{k}", "obstacle", shapes.join(parts), "atlas", solids))
