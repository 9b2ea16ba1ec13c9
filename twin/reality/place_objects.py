"""Data of the place: its objects with their collision shapes, and the texture atlas.

The kind of an object is `ground` (driven or walked on), `obstacle` (solid), `foliage` (not solid) or `detail` (too
small to matter). Stations and laterals are those of `centerline.py`.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.reality.centerline import RoadLine, ground_height
from twin.reality.primitives import MeshPart
from twin.types import Array

SEED = 20  # of the place, its textures, sky and films
ATLAS_SIDE = 8  # cells per side of the atlas
ATLAS_CELL = 256  # [px] per side of a cell
CELLS = (
    *("bark0", "bark1", "bark2", "leaf0", "leaf1", "leaf2", "leaf3", "hedge"),
    *("zinc", "dark", "green", "red", "blue", "white", "rubber", "glass"),
    *("planks", "crate", "cone", "barrier", "door0", "door1", "lamp", "tank"),
    *(f"sign{k}" for k in range(8)),
    *(f"window{k}" for k in range(16)),
    *(f"lit{k}" for k in range(8)),
)
"""Names of the atlas cells, row by row."""


@dataclass(frozen=True)
class Solid:
    """An upright collision shape: `box` or `cylinder`."""

    kind: str
    center: Array
    """Center of its volume [m], shape (3,)."""
    half: tuple[float, float, float]
    """Half sizes of a box, or radius, half height and 0 for a cylinder [m]."""
    yaw: float = 0.0
    """Rotation of a box about z [rad]."""


@dataclass(frozen=True)
class PlaceObject:
    """A textured mesh of the place with its collision shapes."""

    name: str
    kind: str
    part: MeshPart
    texture: str = "atlas"
    solids: tuple[Solid, ...] = ()


@dataclass
class KnownPlace:
    """The whole place: its road, its objects and the positions of its lamp heads [m]."""

    route: RoadLine
    objects: list[PlaceObject] = field(default_factory=list)
    lamp_heads: list[Array] = field(default_factory=list)

    def spot(self, station: float, lateral: float) -> Array:
        """The ground point at a station and lateral [m], shape (3,)."""
        xy = self.route.at(station, lateral)
        return np.append(xy, ground_height(self.route, xy))

    def heading(self, station: float) -> float:
        """Direction of travel at a station [rad]."""
        return float(self.route.heading(station))


def up(height: float) -> Array:
    """A vertical vector [m], shape (3,)."""
    return np.array([0.0, 0.0, height])


def cell(name: str, part: MeshPart) -> MeshPart:
    """Maps the texture coordinates of a part into a cell of the atlas."""
    row, column = divmod(CELLS.index(name), ATLAS_SIDE)
    low, inset = np.array([column, row]) / ATLAS_SIDE, 1.5 / (ATLAS_SIDE * ATLAS_CELL)
    return part.in_window(low + inset, low + 1.0 / ATLAS_SIDE - inset)
