"""The ground as a height field: a regular grid of heights over the xy plane."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from twin.files import check_shapes, damaged, load_arrays


@dataclass(frozen=True)
class Ground:
    """Height z [m] at `origin + cell · (column, row)`."""

    height: NDArray[np.float64]
    """Shape (rows along y, columns along x) [m]; no holes."""
    origin: NDArray[np.float64]
    """x, y of cell (0, 0) [m], shape (2,)."""
    cell: float
    """Grid spacing [m]."""
    measured: NDArray[np.bool_]
    """False where the height was filled in rather than seen, shape as `height`."""
    rgb: NDArray[np.uint8]
    """Mean colour, shape (rows, columns, 3)."""

    def at(self, xy: NDArray) -> NDArray[np.float64]:
        """Bilinear height [m] at points (..., 2); beyond the edge, that of the edge."""
        column_row = (np.asarray(xy) - self.origin) / self.cell
        return map_coordinates(
            self.height, np.moveaxis(column_row[..., ::-1], -1, 0).reshape(2, -1), order=1, mode="nearest"
        ).reshape(np.shape(xy)[:-1])

    def coarsened(self, cell: float) -> "Ground":
        """Every n-th node, n = cell / own cell rounded; what is left over at the far edges is cut off."""
        n = max(1, round(cell / self.cell))
        rows, columns = ((size - 1) // n * n + 1 for size in self.height.shape)
        nodes = np.s_[:rows:n, :columns:n]
        return Ground(self.height[nodes], self.origin, self.cell * n, self.measured[nodes], self.rgb[nodes])

    def save(self, folder: Path) -> None:
        """Writes `ground.npz`."""
        np.savez(folder / "ground.npz", **vars(self))

    @staticmethod
    def load(folder: Path) -> "Ground":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / "ground.npz"
        with damaged(path, "build the scene again"):
            data = load_arrays(path)
            ground = Ground(data["height"], data["origin"], float(data["cell"]), data["measured"], data["rgb"])
            rows, columns = ground.height.shape
            check_shapes(
                {
                    "height": (ground.height, (rows, columns), "f"),
                    "origin": (ground.origin, (2,), "f"),
                    "measured": (ground.measured, (rows, columns), "b"),
                    "rgb": (ground.rgb, (rows, columns, 3), "u"),
                }
            )
            if not (0.0 < ground.cell < np.inf and np.isfinite(ground.height).all() and rows * columns):
                raise ValueError(f"cell = {ground.cell}, or heights that are not finite")
        return ground
