"""The near box, the density grid and the levels: how a field of given bounds is laid out.

Vocabulary as in `kernels/space.py` and `kernels/sampler.py`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_GRID_CELLS = 4_000_000  # cells of the density grid: 16 MB, about what a laptop's cache holds
COARSEST = 16
"""Cells of the coarsest level along the longest axis."""


@dataclass(frozen=True)
class Space:
    """The near box [m]."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape (2, 3)."""
        centre, half = np.array(self.centre), np.array(self.half)
        return np.stack([centre - half, centre + half])

    @property
    def scale(self) -> float:
        """The longest half side [m]."""
        return max(self.half)


def space_of_cameras(camera_to_world: NDArray[np.float64], near_half_extent: float = 0.0) -> Space:
    """A near box around cameras, shape (n, 4, 4), z up: their path, and half the path's length ahead of each of them.

    Upright it is given less: what is filmed from a road lies beside it rather than above.
    `near_half_extent` [m], where not 0, is the half side of a cube around the cameras to use instead.
    """
    positions, ahead = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    low, high = positions.min(0), positions.max(0)
    if near_half_extent > 0.0:
        centre, half = (low + high) / 2, np.full(3, near_half_extent)
    else:
        longest = max(float((high - low).max()), 1e-3)
        seen = np.concatenate([positions, positions + 0.5 * longest * ahead])
        low, high = seen.min(0), seen.max(0)
        centre = (low + high) / 2
        half = (high - low) / 2 + longest * np.array([0.15, 0.15, 0.1])
    return Space(tuple(map(float, centre)), tuple(map(float, half)))  # type: ignore[arg-type]


def grid_shape(space: Space) -> tuple[tuple[int, int, int], float]:
    """Cells of the density grid per axis over the contracted cube, and the cell's side [m]: cubes in the near box."""
    sides = 4.0 * np.array(space.half)
    cell = float((sides.prod() / _GRID_CELLS) ** (1 / 3))
    shape = np.maximum(np.ceil(sides / cell), 4).astype(int)
    return (int(shape[0]), int(shape[1]), int(shape[2])), cell


def level_cells(space: Space, levels: int, growth: float) -> NDArray[np.float32]:
    """Cells per axis of every level, shape (levels, 3); cubes in the near box, growing by `growth` per level."""
    sides = 4.0 * np.array(space.half)
    per_metre = COARSEST * growth ** np.arange(levels) / sides.max()
    return np.maximum(per_metre[:, None] * sides, 1.0).astype(np.float32)


def level_shapes(cells: NDArray[np.float32], log2_table: int) -> NDArray[np.int32]:
    """Vertices per axis and whether the level is dense, shape (levels, 4)."""
    vertices = np.floor(cells).astype(np.int64) + 2
    dense = vertices.prod(1) <= 2**log2_table
    return np.concatenate([vertices, dense[:, None]], 1).astype(np.int32)
