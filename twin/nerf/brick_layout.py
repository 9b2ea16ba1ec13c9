"""Where the bricks of a baked field are, and what the march must know of them; vocabulary as in
`kernels/bricks.py` and `kernels/lookup.py`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.nerf.kernels.bricks import BLOCKS, CELLS, CORNERS
from twin.nerf.kernels.lookup import HALF

_TRACE = 0.03  # share of light that a cell may stop and count as empty


@dataclass(frozen=True)
class BrickLayout:
    """Everything about a baked field that is no array."""

    centre: tuple[float, float, float]
    """Of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Rays begin here [m]."""
    density_unit: float
    """Density at raw value 0, per contracted metre."""
    near_shape: tuple[int, int, int]
    """Bricks over the near box."""
    far_shape: tuple[int, int, int]
    """Bricks over the contracted cube."""

    @property
    def near_side(self) -> NDArray[np.float64]:
        """Sides of a brick in the near box [m]."""
        return 2.0 * np.array(self.half) / np.array(self.near_shape)

    @property
    def far_cell(self) -> float:
        """Smallest side of a far cell [contracted m]."""
        return float((4.0 * np.array(self.half) / np.array(self.far_shape)).min()) / CELLS


def brick_indices(layout: BrickLayout, near: NDArray, far: NDArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The near and the far index (see `kernels/bricks.py`) of slots at bricks (s, 3), near ones first."""
    out = []
    for shape, slots, first in ((layout.near_shape, near, 0), (layout.far_shape, far, len(near))):
        index = np.full(shape, -1, np.int32)
        index[tuple(slots.T)] = np.arange(first, first + len(slots))
        out.append(index)
    return out[0], out[1]


def density_codes(samples: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Densities of bricks (s, 729) as the march reads them, see `kernels/lookup.py`; shape (s · 810 + 8,)."""
    cube = samples.reshape(-1, *[CORNERS] * 3)
    halves = np.stack([cube[..., :HALF], cube[..., HALF - 1 :]], 2)
    return np.concatenate([halves.ravel(), np.zeros(8, np.uint8)])  # the last are read eight at a time, too


def brick_leaps(index: NDArray[np.int32], leap: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """The leaps of a grid's blocks, shape 4 · that of the index of its bricks, without those that say little.

    Returns:
        The index with −d where it has no slot, d the least leap in the brick; and the leaps of stored bricks, (k, 64),
        by slot.
    """
    n0, n1, n2 = index.shape
    blocks = leap.reshape(n0, BLOCKS, n1, BLOCKS, n2, BLOCKS).transpose(0, 2, 4, 1, 3, 5).reshape(*index.shape, -1)
    stored = index >= 0
    by_slot = blocks[stored][np.argsort(index[stored])]
    return np.where(stored, index, -blocks.min(-1).astype(np.int32)), by_slot


def leaps(layout: BrickLayout, arrays: dict[str, NDArray]) -> dict[str, NDArray[np.uint8]]:
    """How far rays may leap from every block of the `near_leap` and the `far_leap` grid, see `kernels/lookup.py`."""
    from scipy.ndimage import distance_transform_cdt

    filled = filled_blocks(layout, arrays)
    split = len(arrays["near"])
    out = {}
    for name, shape, slots, mine in (
        ("near_leap", layout.near_shape, arrays["near"], filled[:split]),
        ("far_leap", layout.far_shape, arrays["far"], filled[split:]),
    ):
        bricks = np.zeros((*shape, BLOCKS, BLOCKS, BLOCKS), bool)
        bricks[tuple(slots.T)] = mine
        blocks = bricks.transpose(0, 3, 1, 4, 2, 5).reshape(np.multiply(shape, BLOCKS))
        leap = distance_transform_cdt(~blocks, "chessboard") if blocks.any() else np.full(blocks.shape, 255)
        out[name] = np.minimum(leap, 255).astype(np.uint8)
    return out


def filled_blocks(layout: BrickLayout, arrays: dict[str, NDArray]) -> NDArray[np.bool_]:
    """Whether some corner of a block stops more than a trace of light per cell, shape (slots, 4, 4, 4)."""
    codes = arrays["features"][..., 0].reshape(-1, *[CORNERS] * 3)
    cell = np.where(np.arange(len(codes)) < len(arrays["near"]), float(layout.near_side.min()) / CELLS, layout.far_cell)
    least = (np.log(_TRACE / (cell * layout.density_unit)) - arrays["low"][0]) / arrays["step"][0]
    stops = codes > least[:, None, None, None]
    for axis in (1, 2, 3):
        first, second, third = (np.take(stops, np.arange(k, k + CELLS - 1, 2), axis) for k in (0, 1, 2))
        stops = first | second | third
    return stops
