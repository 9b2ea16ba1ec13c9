"""Data of a place: its objects with their collision shapes, its textures and its lightings.

The kind of an object is `ground` (driven or walked on), `obstacle` (solid), `foliage` (not solid) or `detail` (grass
and wires, which comparisons with the truth ignore). Stations and laterals are defined in `campus_road.py`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import cos, hypot, sin
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.reality import SEED, primitives
from twin.reality.primitives import MeshPart
from twin.types import Array

ATLAS_CELL = 256  # [px] per side of a cell
CELLS = (
    *("bark0", "bark1", "bark2", "leaf0", "leaf1", "leaf2", "leaf3", "hedge"),
    *("zinc", "dark", "green", "red", "blue", "white", "rubber", "glass"),
    *("planks", "crate", "cone", "barrier", "door0", "door1", "lamp", "tank"),
    *(f"sign{k}" for k in range(8)),
    *(f"window{k}" for k in range(16)),
    *(f"lit{k}" for k in range(8)),
)
"""Names of the cells that every atlas begins with, row by row."""


class DrivenLine(Protocol):
    """A driven line and the ground around it."""

    @property
    def length(self) -> float:
        """Driven length [m]."""

    def heading(self, station: ArrayLike) -> Array:
        """Direction of travel, counterclockwise from +x [rad]; shape as `station`."""

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Points (x, y) [m], shape (..., 2)."""

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Station and lateral [m] of points, shapes (..., 2) → (...), (...)."""

    def ground_height(self, xy: ArrayLike) -> Array:
        """True height of the ground [m], shape (..., 2) → (...)."""


def atlas_shape(cells: tuple[str, ...]) -> tuple[int, int]:
    """Rows and columns of cells in an atlas with these cells."""
    return max(8, -(-len(cells) // 8)), 8


@dataclass(frozen=True)
class GroundLayout:
    """Extents of the ground textures of a place, and of the area around its driven line."""

    bands: Mapping[str, tuple[float, float, float, float]]
    """Texture → stations of its first and last column, laterals of its first and last row [m]."""
    lands: Mapping[str, tuple[float, float, float, float]]
    """Texture of the land → its x and y range [m]."""
    field: tuple[tuple[float, float], tuple[float, float]]
    """Lowest and highest (x, y) [m] of the area around the driven line. In randomly sampled places (number ≥ 1), the
    rasterizer casts shadows only in this area (`true_world.shadow_range`)."""
    wet: tuple[str, ...]
    """Textures that rain darkens."""


@dataclass(frozen=True)
class Solid:
    """An upright collision shape: `box` or `cylinder`."""

    kind: str
    center: Array
    """Center of the shape [m], shape (3,)."""
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
    """A whole place: its road, its objects, and the textures, lightings and sky that render it."""

    route: DrivenLine
    layout: GroundLayout
    textures: Callable[[], dict[str, NDArray[np.uint8]]]
    """Returns all textures by name, uint8 RGB."""
    lightings: Mapping[str, Any]
    """`Lighting`s of the films by name."""
    sky: Callable[[Any], NDArray[np.uint8]]
    """Returns the cube map of the sky under a lighting; see `sky.sky_cube_map`."""
    number: int = 0
    seed: tuple[int, ...] = (SEED,)
    """Seed of the objects' details."""
    cells: tuple[str, ...] = CELLS
    """Names of the atlas's cells, row by row."""
    objects: list[PlaceObject] = field(default_factory=list)
    lamp_heads: list[Array] = field(default_factory=list)
    """Positions of the shining lamps [m], each of shape (3,)."""

    def spot(self, station: float, lateral: float) -> Array:
        """The ground point at a station and lateral [m], shape (3,)."""
        xy = self.route.at(station, lateral)
        return np.append(xy, self.route.ground_height(xy))

    def heading(self, station: float) -> float:
        """Direction of travel at a station [rad]."""
        return float(self.route.heading(station))

    def cell(self, name: str, part: MeshPart) -> MeshPart:
        """Maps the texture coordinates of a part from [0, 1]² into a cell of the atlas."""
        rows, columns = atlas_shape(self.cells)
        row, column = divmod(self.cells.index(name), columns)
        count = np.array([columns, rows])
        low, inset = np.array([column, row]) / count, 1.5 / (count * ATLAS_CELL)
        low, high = low + inset, low + 1.0 / count - inset
        return replace(part, uv=low + np.clip(part.uv, 0.0, 1.0) * (high - low))

    def rng(self, *key: int) -> np.random.Generator:
        """The random generator for a key, such as the kind and number of an object."""
        return np.random.default_rng([*self.seed, *key])


def up(height: float) -> Array:
    """A vertical vector [m], shape (3,)."""
    return np.array([0.0, 0.0, height])


def vertical_quad(left: Array, right: Array, low: float, high: float) -> MeshPart:
    """A vertical rectangle between two points (x, y) [m] and two heights [m]."""
    return primitives.quad([[*left, high], [*left, low], [*right, low], [*right, high]])


class Solids:
    """The solid objects of a place, tested against a robot's footprint by separating axes."""

    def __init__(self, place: KnownPlace, footprint: tuple[float, float]) -> None:
        """`footprint` is length and width [m]."""
        self._footprint = footprint
        solids = [one for obj in place.objects for one in obj.solids]
        self._center = np.array([one.center for one in solids]).reshape(-1, 3)
        self._half = np.array([one.half for one in solids]).reshape(-1, 3)
        self._round = np.array([one.kind == "cylinder" for one in solids], bool)
        # A cylinder's half sizes are its radius, half its height and 0.
        self._up = np.where(self._round, self._half[:, 1], self._half[:, 2])
        self._reach = np.where(self._round, self._half[:, 0], np.hypot(self._half[:, 0], self._half[:, 1]))
        self._reach += 0.5 * hypot(*footprint)
        self._yaw = np.array([one.yaw for one in solids])

    def hit(self, x: float, y: float, yaw: float, low: float, high: float) -> bool:
        """True if the footprint at a pose [m], [rad] overlaps an object between two heights [m]."""
        off = self._center[:, :2] - (x, y)
        near = np.flatnonzero(
            (np.hypot(off[:, 0], off[:, 1]) < self._reach)
            & (self._center[:, 2] - self._up < high)
            & (self._center[:, 2] + self._up > low)
        )
        return any(self._overlaps(int(i), off[i], yaw) for i in near)

    def _overlaps(self, i: int, off: Array, yaw: float) -> bool:
        long, wide = 0.5 * self._footprint[0], 0.5 * self._footprint[1]
        c, s = cos(yaw), sin(yaw)
        ahead, aside = float(c * off[0] + s * off[1]), float(c * off[1] - s * off[0])
        if self._round[i]:
            return hypot(max(abs(ahead) - long, 0.0), max(abs(aside) - wide, 0.0)) < self._half[i, 0]
        # The separating axes of two rectangles are the axes of both.
        turn = float(self._yaw[i]) - yaw
        ct, st = cos(turn), sin(turn)
        a, b = float(self._half[i, 0]), float(self._half[i, 1])
        if abs(ahead) > long + a * abs(ct) + b * abs(st) or abs(aside) > wide + a * abs(st) + b * abs(ct):
            return False
        u, v = ct * ahead + st * aside, ct * aside - st * ahead
        return abs(u) <= a + long * abs(ct) + wide * abs(st) and abs(v) <= b + long * abs(st) + wide * abs(ct)
