"""Layout of a baked field's bricks: sizes and bounds, indices of the grids, empty-space skipping, checks of the arrays.

`kernels/bricks.py` defines bricks, blocks, slots and indices; the march in `kernels/march.py` reads the arrays.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes
from twin.nerf.kernels.bricks import BLOCKS, CELLS, CORNERS, HALF_CORNERS
from twin.nerf.kernels.color_head import HARMONICS
from twin.nerf.kernels.composite import CHANNELS
from twin.nerf.surface_features import Detail

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
    """Density at raw network output 0 [1/contracted m, see `kernels/space.py`]."""
    near_shape: tuple[int, int, int]
    """Number of near bricks per axis."""
    far_shape: tuple[int, int, int]
    """Number of far bricks per axis."""

    @property
    def near_side(self) -> NDArray[np.float64]:
        """Sides of a brick in the near box [m]."""
        return 2.0 * np.array(self.half) / np.array(self.near_shape)

    @property
    def near_cell(self) -> float:
        """Smallest side of a near cell [m]."""
        return float(self.near_side.min()) / CELLS

    @property
    def far_cell(self) -> float:
        """Smallest side of a far cell [contracted m]."""
        return float((4.0 * np.array(self.half) / np.array(self.far_shape)).min()) / CELLS


def brick_indices(layout: BrickLayout, near: NDArray, far: NDArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Near and far index (see `kernels/bricks.py`); near bricks have the lower slots.

    `near` and `far` are the stored bricks' positions in their grids [bricks], shape (s, 3).
    """
    out = []
    for shape, slots, first in ((layout.near_shape, near, 0), (layout.far_shape, far, len(near))):
        index = np.full(shape, -1, np.int32)
        index[tuple(slots.T)] = np.arange(first, first + len(slots))
        out.append(index)
    return out[0], out[1]


def density_codes(samples: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Density bytes of bricks (s, 729) in the order that is described at `bricks.DENSITIES`, shape (s · 810 + 8,)."""
    cube = samples.reshape(-1, *[CORNERS] * 3)
    halves = np.stack([cube[..., :HALF_CORNERS], cube[..., HALF_CORNERS - 1 :]], 2)
    return np.concatenate([halves.ravel(), np.zeros(8, np.uint8)])  # padding, as the march reads eight bytes at a time


def stored_skips(index: NDArray[np.int32], distance: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Compresses a grid's skip distances to the arrays that the march reads.

    `distance` has one value per block; each of its axes is 4 times as long as that of the brick `index`. Returns the
    index with −d for bricks without a slot (d: least distance in the brick), and the distances in the stored bricks,
    shape (slots, 64).
    """
    n0, n1, n2 = index.shape
    blocks = distance.reshape(n0, BLOCKS, n1, BLOCKS, n2, BLOCKS).transpose(0, 2, 4, 1, 3, 5).reshape(*index.shape, -1)
    stored = index >= 0
    by_slot = blocks[stored][np.argsort(index[stored])]
    return np.where(stored, index, -blocks.min(-1).astype(np.int32)), by_slot


def skip_distances(layout: BrickLayout, arrays: dict[str, NDArray]) -> dict[str, NDArray[np.uint8]]:
    """Skip distances (see `kernels/march.py`) of all blocks of both grids, as arrays `near_leap` and `far_leap`.

    A block is occupied if one of its samples is so dense that a cell of this density has an opacity above
    `_MAX_EMPTY_OPACITY`.
    """
    from scipy.ndimage import distance_transform_cdt

    split = len(arrays["near"])
    codes = arrays["features"][..., 0].reshape(-1, *[CORNERS] * 3)
    cell = np.where(np.arange(len(codes)) < split, layout.near_cell, layout.far_cell)
    threshold = (np.log(_MAX_EMPTY_OPACITY / (cell * layout.density_unit)) - arrays["low"][0]) / arrays["step"][0]
    occupied = codes > threshold[:, None, None, None]
    for axis in (1, 2, 3):
        first, second, third = (np.take(occupied, np.arange(k, k + CELLS - 1, 2), axis) for k in (0, 1, 2))
        occupied = first | second | third
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


def samples_read(layout: BrickLayout, arrays: dict[str, NDArray]) -> NDArray[np.bool_]:
    """Mask of the samples (s, 729) of occupied blocks (see `skip_distances`); the march reads no other samples."""
    near, far = brick_indices(layout, arrays["near"], arrays["far"])
    skips = [stored_skips(near, arrays["near_leap"])[1], stored_skips(far, arrays["far_leap"])[1]]
    occupied = np.concatenate(skips).reshape(-1, *[BLOCKS] * 3) == 0
    read = np.zeros((len(occupied), *[CORNERS] * 3), bool)
    for corner in itertools.product(range(CELLS // BLOCKS + 1), repeat=3):
        read[:, *(slice(c, c + CELLS - 1, CELLS // BLOCKS) for c in corner)] |= occupied
    return read.reshape(len(read), -1)


def check_arrays(layout: BrickLayout, arrays: dict[str, NDArray]) -> None:
    """Raises ValueError if the arrays of a section would make a kernel read outside of them."""
    near, far = arrays["near"], arrays["far"]
    slots = len(near) + len(far)
    shapes: dict[str, tuple[tuple[int, ...], str]] = {
        "near": ((len(near), 3), "i"),
        "far": ((len(far), 3), "i"),
        "features": ((slots, CORNERS**3, CHANNELS), "u"),
        "low": ((CHANNELS,), "f"),
        "step": ((CHANNELS,), "f"),
        "near_leap": (tuple(BLOCKS * n for n in layout.near_shape), "u"),
        "far_leap": (tuple(BLOCKS * n for n in layout.far_shape), "u"),
    }
    check_shapes({name: (arrays[name], *expected) for name, expected in shapes.items()})
    for name, index, shape in (("near", near, layout.near_shape), ("far", far, layout.far_shape)):
        inside = not len(index) or (index.min() >= 0 and (index < np.array(shape)).all())
        if not inside or len(np.unique(np.ravel_multi_index(tuple(index.T), shape))) < len(index):
            raise ValueError(f"{name}: a brick is outside the grid of {shape} bricks or occurs twice")
    Detail.of_arrays(arrays)


def check_networks(networks: dict[str, NDArray], dim: int) -> None:
    """Raises ValueError if the networks do not fit together, or to embeddings of `dim` numbers."""
    hidden, background = networks["network.head.1"].shape[0], networks["network.backdrop.0"].shape[1]
    shapes = {
        "network.head.0": (CHANNELS - 1 + HARMONICS + dim, hidden),
        "network.head.0.bias": (hidden,),
        "network.head.1": (hidden, hidden),
        "network.head.1.bias": (hidden,),
        "network.head.2": (hidden, 3),
        "network.head.2.bias": (3,),
        "network.backdrop.0": (HARMONICS, background),
        "network.backdrop.0.bias": (background,),
        "network.backdrop.1": (background, CHANNELS - 1),
    }
    if "probes.features" in networks:
        count = len(networks["probes.features"])
        shapes |= {"probes.features": (count, CHANNELS - 1), "probes.harmonics": (count, HARMONICS)}
    check_shapes({name: (networks[name], shape, "f") for name, shape in shapes.items()})
    if hidden % 8 or not hidden:
        raise ValueError(f"the head has {hidden} hidden units; expected a multiple of 8")
