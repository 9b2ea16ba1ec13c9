"""The near box, the stop grids and the levels: how a field of given bounds is laid out.

Vocabulary as in `kernels/space.py` and `kernels/sampler.py`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NEAR_CELLS = 3_000_000  # cells of the fine stop grid: 12 MB, as a laptop's cache holds
_FAR_CELLS = 1_000_000  # cells of the coarse one
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


@dataclass(frozen=True)
class StopGrids:
    """Sizes of the two stop grids."""

    near_shape: tuple[int, int, int]
    far_shape: tuple[int, int, int]
    near_cell: float
    """Side of a cell [m]."""
    far_cell: float
    """Side of a cell, measured inside the near box [m]."""


def stop_grids(space: Space) -> StopGrids:
    """The fine grid covers the near box, the coarse one the contracted cube, twice as wide; cells are cubes there."""
    box = 2.0 * np.array(space.half)

    def divide(sides: NDArray[np.float64], cells: int) -> tuple[tuple[int, int, int], float]:
        cell = float((sides.prod() / cells) ** (1 / 3))
        x, y, z = (int(n) for n in np.maximum(np.ceil(sides / cell), 4))
        return (x, y, z), cell

    near_shape, near_cell = divide(box, _NEAR_CELLS)
    far_shape, far_cell = divide(2.0 * box, _FAR_CELLS)
    return StopGrids(near_shape, far_shape, near_cell, far_cell)


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
