"""Boundaries beside the road: fences, walls, hedges and rows of bollards, in short pieces that follow the ground."""

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, up
from twin.reality.place_spec import BoundarySpec
from twin.reality.plants import add_hedge
from twin.reality.primitives import MeshPart
from twin.reality.street_furniture import add_post
from twin.types import Array

BAY = 2.0  # [m] length of a piece
_THICK = {"wall": 0.26, "hedge": 0.7, "picket": 0.06, "boards": 0.06, "rails": 0.09, "mesh": 0.06, "bollards": 0.2}


def thickness(kind: str) -> float:
    """Thickness of a boundary [m]."""
    return _THICK[kind]


def add_boundary(place: KnownPlace, name: str, spec: BoundarySpec, skin: str, stations: Array, lateral: float) -> None:
    """Adds a boundary at a lateral [m]: pieces of length `BAY` that begin at the stations [m].

    `skin` is the boundary's atlas cell. One bollard stands at each station.
    """
    if not len(stations):
        return
    if spec.kind == "hedge":
        halves = np.sort(np.concatenate([stations, stations + 0.5 * BAY]))
        add_hedge(place, len(place.objects), halves, lateral)
        return
    if spec.kind == "bollards":
        for k, station in enumerate(stations):
            add_post(place, f"{name}_{k}", float(station), lateral, spec.height, 0.08, skin)
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
        half = (length / 2, thickness(spec.kind) / 2, spec.height / 2 + 0.1)
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
