"""The sparse points of structure from motion, and which frames saw them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes, damaged, load_arrays
from twin.geometry.poses import Similarity


@dataclass(frozen=True)
class SparsePoints:
    """m points and their k observations (one row per point and frame that sees it)."""

    xyz: NDArray[np.float64]
    """Shape (m, 3), in the frame of the `Cameras` beside them."""
    rgb: NDArray[np.uint8]
    """Shape (m, 3)."""
    error: NDArray[np.float64]
    """Mean reprojection error [px], shape (m,)."""
    point: NDArray[np.int64]
    """Point index per observation, shape (k,)."""
    frame: NDArray[np.int64]
    """Frame index (into the `Cameras` beside them) per observation, shape (k,)."""

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def track_length(self) -> NDArray[np.int64]:
        """How many frames saw each point, shape (m,)."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def transformed(self, similarity: Similarity) -> "SparsePoints":
        return replace(self, xyz=similarity.points(self.xyz))

    @staticmethod
    def empty() -> "SparsePoints":
        none = np.zeros(0, np.int64)
        return SparsePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), none, none)

    def save(self, folder: Path) -> None:
        """Writes `points.npz`."""
        np.savez(folder / "points.npz", **vars(self))

    @staticmethod
    def load(folder: Path) -> "SparsePoints":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / "points.npz"
        with damaged(path, "build the scene again"):
            points = SparsePoints(**load_arrays(path))
            m, k = len(points.xyz), len(points.point)
            check_shapes(
                {
                    "xyz": (points.xyz, (m, 3), "f"),
                    "rgb": (points.rgb, (m, 3), "u"),
                    "error": (points.error, (m,), "f"),
                    "point": (points.point, (k,), "i"),
                    "frame": (points.frame, (k,), "i"),
                }
            )
            if k and not (points.point.min() >= 0 and points.point.max() < m and points.frame.min() >= 0):
                raise ValueError(f"observations of points that are not among the {m}")
        return points
