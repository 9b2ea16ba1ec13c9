"""Layout of a baked field's bricks, and the lookup tables of the march; terms as in `kernels/bricks.py` and
`kernels/lookup.py`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.nerf.kernels.bricks import BLOCKS, CELLS, CORNERS, HALF_CORNERS

_MAX_EMPTY_OPACITY = 0.03  # a cell that blocks at most this share of light counts as empty


@dataclass(frozen=True)
class BrickLayout:
    """Sizes and bounds of a baked field. `baked.json` stores these names as keys."""

    centre: tuple[float, float, float]
    """Center of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Distance at which rays start [m]."""
    density_unit: float
    """Density at raw value 0 [1/contracted m]."""
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
    """Near and far index (see `kernels/bricks.py`) of bricks (s, 3), whose slots count the near ones first."""
    out = []
    for shape, slots, first in ((layout.near_shape, near, 0), (layout.far_shape, far, len(near))):
        index = np.full(shape, -1, np.int32)
        index[tuple(slots.T)] = np.arange(first, first + len(slots))
        out.append(index)
    return out[0], out[1]


def density_codes(samples: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reorders density bytes of bricks (s, 729) for the march, shape (s · 810 + 8,); see `kernels/lookup.py`."""
    cube = samples.reshape(-1, *[CORNERS] * 3)
    halves = np.stack([cube[..., :HALF_CORNERS], cube[..., HALF_CORNERS - 1 :]], 2)
    return np.concatenate([halves.ravel(), np.zeros(8, np.uint8)])  # padding, as eight bytes are read at a time


def stored_skips(index: NDArray[np.int32], distance: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Compresses a grid's skip distances per block, shape 4 · that of the brick index, to what the march reads: the
    index with −d for bricks without a slot (d: least distance in it), and the stored bricks' distances (slots, 64)."""
    n0, n1, n2 = index.shape
    blocks = distance.reshape(n0, BLOCKS, n1, BLOCKS, n2, BLOCKS).transpose(0, 2, 4, 1, 3, 5).reshape(*index.shape, -1)
    stored = index >= 0
    by_slot = blocks[stored][np.argsort(index[stored])]
    return np.where(stored, index, -blocks.min(-1).astype(np.int32)), by_slot


def skip_distances(layout: BrickLayout, arrays: dict[str, NDArray]) -> dict[str, NDArray[np.uint8]]:
    """Skip distances of all blocks of the near and the far grid, as arrays `near_leap` and `far_leap`."""
    from scipy.ndimage import distance_transform_cdt

    occupied = occupied_blocks(layout, arrays)
    split = len(arrays["near"])
    out = {}
    for name, shape, slots, mine in (
        ("near_leap", layout.near_shape, arrays["near"], occupied[:split]),
        ("far_leap", layout.far_shape, arrays["far"], occupied[split:]),
    ):
        bricks = np.zeros((*shape, BLOCKS, BLOCKS, BLOCKS), bool)
        bricks[tuple(slots.T)] = mine
        blocks = bricks.transpose(0, 3, 1, 4, 2, 5).reshape(np.multiply(shape, BLOCKS))
        distance = distance_transform_cdt(~blocks, "chessboard") if blocks.any() else np.full(blocks.shape, 255)
        out[name] = np.minimum(distance, 255).astype(np.uint8)
    return out


def occupied_blocks(layout: BrickLayout, arrays: dict[str, NDArray]) -> NDArray[np.bool_]:
    """True for blocks with a corner that blocks more than `_MAX_EMPTY_OPACITY` per cell, shape (slots, 4, 4, 4)."""
    codes = arrays["features"][..., 0].reshape(-1, *[CORNERS] * 3)
    cell = np.where(np.arange(len(codes)) < len(arrays["near"]), float(layout.near_side.min()) / CELLS, layout.far_cell)
    threshold = (np.log(_MAX_EMPTY_OPACITY / (cell * layout.density_unit)) - arrays["low"][0]) / arrays["step"][0]
    dense = codes > threshold[:, None, None, None]
    for axis in (1, 2, 3):
        first, second, third = (np.take(dense, np.arange(k, k + CELLS - 1, 2), axis) for k in (0, 1, 2))
        dense = first | second | third
    return dense
