"""The vocabulary of the place: things, their collision shapes, the atlas of small textures, and the place itself.

A *thing* has a kind: `ground` is driven or walked on, `obstacle` is solid, `foliage` lets light and wind through, and
`detail` is too small to matter. Stations and laterals are those of `centerline.py`.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.reality.centerline import RoadLine, ground_height
from twin.reality.primitives import MeshPart
from twin.types import Array

SEED = 20  # of everything random in the place, its textures, its sky and its films
ATLAS_SIDE = 8  # cells per side of the atlas
ATLAS_CELL = 256  # [px] side of a cell
CELLS = (
    *("bark0", "bark1", "bark2", "leaf0", "leaf1", "leaf2", "leaf3", "hedge"),
    *("zinc", "dark", "green", "red", "blue", "white", "rubber", "glass"),
    *("planks", "crate", "cone", "barrier", "door0", "door1", "lamp", "tank"),
    *(f"sign{k}" for k in range(8)),
    *(f"window{k}" for k in range(16)),
    *(f"lit{k}" for k in range(8)),
)
"""Names of the atlas' cells, row by row."""


@dataclass(frozen=True)
class Solid:
    """A collision shape: an upright `box` or `cylinder`."""

    kind: str
    centre: Array
    """Of its volume [m], shape (3,)."""
    half: tuple[float, float, float]
    """Half sizes of a box; radius, half height, 0 of a cylinder [m]."""
    yaw: float = 0.0
    """Of a box, about z [rad]."""


@dataclass(frozen=True)
class Thing:
    """Something of the place."""

    name: str
    kind: str
    part: MeshPart
    texture: str = "atlas"
    solids: tuple[Solid, ...] = ()


@dataclass
class KnownPlace:
    """The whole place: its things, and the lamps' heads [m]."""

    route: RoadLine
    things: list[Thing] = field(default_factory=list)
    lamp_heads: list[Array] = field(default_factory=list)

    def spot(self, station: float, lateral: float) -> Array:
        """The point of the ground at a station and lateral, shape (3,)."""
        xy = self.route.at(station, lateral)
        return np.append(xy, ground_height(self.route, xy))

    def heading(self, station: float) -> float:
        """Direction of travel at a station [rad]."""
        return float(self.route.heading(station))


def up(height: float) -> Array:
    """A vector straight up [m], shape (3,)."""
    return np.array([0.0, 0.0, height])


def cell(name: str, part: MeshPart) -> MeshPart:
    """Maps a part's texture into its cell of the atlas."""
    row, column = divmod(CELLS.index(name), ATLAS_SIDE)
    low, inset = np.array([column, row]) / ATLAS_SIDE, 1.5 / (ATLAS_SIDE * ATLAS_CELL)
    return part.in_window(low + inset, low + 1.0 / ATLAS_SIDE - inset)
