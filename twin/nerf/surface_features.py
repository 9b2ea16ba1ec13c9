"""Surface features: the detail of a baked field as arrays, on the host and on a device.

`kernels/surface_detail.py` defines texels, tiles and the hash grid, and adds the features to rays; `detail.py` fits the
features.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes
from twin.nerf.kernels import surface_detail as kernels
from twin.nerf.kernels.composite import CHANNELS
from twin.types import Array32
from twin.warp_runtime import wp

_MAX_INDEX = 10_000  # greatest number of tiles along an axis
_ARRAYS = ("heights", "origin", "tiles", "texels", "texel_step", "vertices", "vertex_step")


@dataclass(frozen=True)
class Detail:
    """Features at surfaces, finer than those of bricks; `kernels/surface_detail.py` defines the terms."""

    heights: Array32
    """Height map [m], shape (along x, along y)."""
    origin: NDArray[np.float64]
    """Lowest corner of the height map and of the tiles [m], shape (2,)."""
    height_cell: float
    """Spacing of the height map [m]."""
    tiles: NDArray[np.int32]
    """Positions of the stored tiles in their grid, shape (t, 2)."""
    texel: float
    """Side of the finest texels [m]."""
    texels: NDArray[np.uint8]
    """Bytes of the texels, shape (t · TEXELS, CHANNELS), see `DetailBytes`."""
    texel_step: Array32
    cell: float
    """Side of the hash grid's cells [m]."""
    vertices: NDArray[np.uint8]
    """Bytes of the hash grid's table, shape (rows, CHANNELS)."""
    vertex_step: Array32

    @staticmethod
    def without_features(heights: Array32, origin: NDArray[np.float64], height_cell: float) -> "Detail":
        """Detail with a height map only."""
        none, step = np.zeros((0, CHANNELS), np.uint8), np.zeros(CHANNELS, np.float32)
        return Detail(heights, origin, height_cell, np.zeros((0, 2), np.int32), 1.0, none, step, 1.0, none, step)

    @property
    def tile_index(self) -> NDArray[np.int32]:
        """Slots of the tiles in the grid that covers them, −1 where no tile is stored."""
        index = np.full(self.tiles.max(0, initial=0) + 1, -1, np.int32)
        index[tuple(self.tiles.T)] = np.arange(len(self.tiles))
        return index

    def arrays(self) -> dict[str, NDArray]:
        """The arrays of a `BakedField` that hold the detail."""
        sides = np.array([self.height_cell, self.texel, self.cell])
        return {f"detail.{name}": getattr(self, name) for name in _ARRAYS} | {"detail.sides": sides}

    @staticmethod
    def of_arrays(arrays: dict[str, NDArray]) -> "Detail":
        """The detail in the arrays of a `BakedField`; fields of earlier versions have none.

        Raises ValueError for arrays that a kernel could not read.
        """
        if "detail.sides" not in arrays:
            return Detail.without_features(np.zeros((0, 0), np.float32), np.zeros(2), 1.0)
        sides = arrays["detail.sides"]
        named = {name: arrays[f"detail.{name}"] for name in _ARRAYS}
        tiles, rows = len(named["tiles"]), len(named["vertices"])
        check_shapes(
            {
                "detail.sides": (sides, (3,), "f"),
                "detail.heights": (named["heights"], named["heights"].shape[:2], "f"),
                "detail.origin": (named["origin"], (2,), "f"),
                "detail.tiles": (named["tiles"], (tiles, 2), "i"),
                "detail.texels": (named["texels"], (tiles * kernels.TEXELS, CHANNELS), "u"),
                "detail.texel_step": (named["texel_step"], (CHANNELS,), "f"),
                "detail.vertices": (named["vertices"], (rows, CHANNELS), "u"),
                "detail.vertex_step": (named["vertex_step"], (CHANNELS,), "f"),
            }
        )
        if rows < 8 or rows & (rows - 1):
            raise ValueError(f"detail.vertices has {rows} rows; expected a power of 2 from 8 on")
        if not (sides > 0.0).all() or named["tiles"].min(initial=0) < 0 or named["tiles"].max(initial=0) >= _MAX_INDEX:
            raise ValueError(f"detail.sides not above 0, or detail.tiles not from 0 to {_MAX_INDEX - 1}")
        if not np.isfinite(named["origin"]).all():
            raise ValueError(f"detail.origin = {named['origin'].tolist()}; expected finite numbers")
        height_cell, texel, cell = map(float, sides)
        return Detail(height_cell=height_cell, texel=texel, cell=cell, **named)


def detail_grid(detail: Detail, device: str) -> Any:
    """Height map, tile index and sizes on a device, see `kernels.DetailGrid`."""
    grid: Any = kernels.DetailGrid()
    grid.origin = wp.vec2f(*detail.origin.tolist())
    grid.texel, grid.cell, grid.per_height_cell = detail.texel, detail.cell, 1.0 / detail.height_cell
    grid.coarsest = max(detail.texel * 2 ** (kernels.LEVELS - 1), detail.cell)
    grid.mask = wp.uint32(max(1, len(detail.vertices)) - 1)
    index = detail.tile_index
    grid.heights_x, grid.heights_y = detail.heights.shape
    grid.tiles_x, grid.tiles_y = index.shape
    grid.heights = wp.array(detail.heights.ravel(), dtype=wp.float32, device=device)
    grid.tiles = wp.array(index.ravel(), dtype=wp.int32, device=device)
    return grid
