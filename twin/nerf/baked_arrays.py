"""Arrays of a baked field: its bricks, networks and detail, in files with checks, and on a device with their kernels.

`kernels/bricks.py` defines bricks, blocks, slots and indices; the march in `kernels/march.py` reads the arrays. The
*detail* consists of features at surfaces: `kernels/surface_detail.py` defines texels, tiles and the hash grid, and adds
the features to rays; `detail.py` fits them.
"""

import itertools
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes, load_tensors, wrap_read_errors
from twin.nerf.kernels import march as kernels
from twin.nerf.kernels import surface_detail
from twin.nerf.kernels.bricks import BLOCKS, CELLS, CORNERS, HALF_CORNERS, Bricks, Bytes
from twin.nerf.kernels.color_head import HARMONICS, Vec8, color_head_kernel
from twin.nerf.kernels.color_head import LANES as HEAD_LANES
from twin.nerf.kernels.volume import CHANNELS, Channels
from twin.runtime import bar
from twin.types import Array32
from twin.warp_runtime import wp

# ---- bricks and networks

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

    `distance` has one value per block; each of its axes is 4 times as long as that of the brick `index`. In the
    returned index, bricks without a slot have the value −d, where d is the least distance in the brick. The returned
    distances are those in the stored bricks, shape (slots, 64).
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
    """Raises ValueError if the shapes of the networks do not match each other or embeddings of `dim` numbers."""
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


# ---- surface features

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
                "detail.texels": (named["texels"], (tiles * surface_detail.TEXELS, CHANNELS), "u"),
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
    """Height map, tile index and sizes on a device, see `surface_detail.DetailGrid`."""
    grid: Any = surface_detail.DetailGrid()
    grid.origin = wp.vec2f(*detail.origin.tolist())
    grid.texel, grid.cell, grid.per_height_cell = detail.texel, detail.cell, 1.0 / detail.height_cell
    grid.coarsest = max(detail.texel * 2 ** (surface_detail.LEVELS - 1), detail.cell)
    grid.mask = wp.uint32(max(1, len(detail.vertices)) - 1)
    index = detail.tile_index
    grid.heights_x, grid.heights_y = detail.heights.shape
    grid.tiles_x, grid.tiles_y = index.shape
    grid.heights = wp.array(detail.heights.ravel(), dtype=wp.float32, device=device)
    grid.tiles = wp.array(index.ravel(), dtype=wp.int32, device=device)
    return grid


# ---- a section in files

BAKED_HEAD = "baked.json"
BAKED_FORMATS = 2, 3  # format with one section, and with several


class BakedSection:
    """Bricks and detail of one section of the road, in memory or in a file that is read on demand."""

    def __init__(self, layout: BrickLayout, arrays: dict[str, NDArray] | None = None, file: Path | None = None):
        """
        Args:
            layout: Sizes and bounds.
            arrays: `near` and `far` (the stored bricks in their grids, (s, 3)), `features` (s, 729, CHANNELS) bytes,
                near bricks first, `low` and `step` (CHANNELS,) of the quantization, `near_leap` and `far_leap` (see
                `skip_distances`), and those of `Detail.arrays`.
            file: A file with these arrays, if they are not given.
        """
        self.layout, self._arrays, self._file = layout, arrays, file

    @property
    def arrays(self) -> dict[str, NDArray]:
        """The arrays. Raises InputError if the file is damaged."""
        if self._arrays is not None:
            return self._arrays
        assert self._file is not None
        arrays = load_tensors(self._file)
        with wrap_read_errors(self._file, "build the scene again"):
            check_arrays(self.layout, arrays)
        return arrays


def section_file(k: int) -> str:
    """Name of the file with the arrays of section k; that of section 0 also has those that all sections share."""
    return f"baked_{k}.safetensors" if k else "baked.safetensors"


# ---- on a device

BLOCK_DIM = 128
"""Threads of a block on a GPU; with 256, it renders 10 % fewer pictures a second."""


def on_device(array: NDArray, dtype: Any, device: str) -> Any:
    """A copy of an array on a device."""
    if device == "cpu":  # NumPy allocates large arrays on huge pages, where random reads cost less
        own = np.empty(array.shape, array.dtype)
        own[...] = array
        return wp.array(own, dtype=dtype, device=device, copy=False)
    return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)


class SectionOnDevice:
    """Bricks and detail of a section as the kernels read them."""

    def __init__(self, layout: BrickLayout, arrays: dict[str, NDArray], device: str):
        """For the arrays see `BakedSection`."""
        b: Any = Bricks()
        near_index, far_index = brick_indices(layout, arrays["near"], arrays["far"])
        near_index, near_skips = stored_skips(near_index, arrays["near_leap"])
        far_index, far_skips = stored_skips(far_index, arrays["far_leap"])
        b.near_index, b.far_index = (on_device(index.ravel(), wp.int32, device) for index in (near_index, far_index))
        b.skips = on_device(np.concatenate([near_skips, far_skips]).ravel(), wp.uint8, device)
        b.near_blocks = wp.vec3i(*(BLOCKS * n for n in layout.near_shape))
        b.far_blocks = wp.vec3i(*(BLOCKS * n for n in layout.far_shape))
        b.densities = on_device(density_codes(arrays["features"][..., 0]), wp.uint8, device)
        b.features = on_device(arrays["features"].reshape(-1, CHANNELS), Bytes, device)
        b.low, b.step = Channels(*arrays["low"].tolist()), Channels(*arrays["step"].tolist())
        b.center = wp.vec3f(*layout.centre)
        b.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        b.near_cell, b.far_cell = layout.near_cell, layout.far_cell
        b.unit, b.near_plane = layout.density_unit, layout.near_plane
        self.bricks = b
        detail = Detail.of_arrays(arrays)
        stored: Any = surface_detail.DetailBytes()
        stored.texels = wp.array(detail.texels, dtype=Bytes, device=device)
        stored.vertices = wp.array(detail.vertices, dtype=Bytes, device=device)
        stored.texel_step, stored.vertex_step = (
            Channels(*step.tolist()) for step in (detail.texel_step, detail.vertex_step)
        )
        self.detail = detail_grid(detail, device), stored
        self.has_detail = bool(len(detail.tiles) or len(detail.vertices))
        self.targets: WeakKeyDictionary[Any, OrderedDict[tuple, Any]] = WeakKeyDictionary()
        """`RenderTarget`s of every `BakedField` object that shares this section; they are dropped with it."""


class RenderKernels:
    """Kernels that render a field, and the weights of its networks, on a device."""

    def __init__(self, network: dict[str, NDArray], device: str):
        """`network` has the arrays of the color head and the background network, see `BakedField.network`."""
        self.device = device
        self.march = kernels.march_kernel(kernels.LANES[device])
        self.color_head, weights = color_head_kernel(
            HEAD_LANES[device], network["head.1"].shape[0], network["backdrop.0"].shape[1]
        )
        rows = CHANNELS - 1 + HARMONICS
        self.weights = w = weights()

        def as_vec8(matrix: NDArray) -> Any:
            """Packs a matrix (units, m) as vectors of eight units: array (units / 8, m), flat."""
            return on_device(matrix.reshape(len(matrix) // 8, 8, -1).transpose(0, 2, 1).reshape(-1, 8), Vec8, device)

        w.head_0, w.head_1, w.head_2 = (
            as_vec8(network["head.0"][:rows].T),
            as_vec8(network["head.1"].T),
            as_vec8(network["head.2"]),
        )
        w.head_1_bias, w.head_2_bias = as_vec8(network["head.1.bias"]), wp.vec3f(*network["head.2.bias"].tolist())
        for name in ("backdrop.0", "backdrop.0.bias", "backdrop.1"):
            setattr(w, name.replace(".", "_"), on_device(network[name].ravel(), wp.float32, device))
        self.first_bias = network["head.0.bias"], network["head.0"][rows:]
        needed = kernels.cone_march, self.march, surface_detail.add_detail, self.color_head
        # Loaded here, so that no two threads load them at once.
        with bar("compiling the renderer (first use only)", len(needed), "part", after=1.0) as progress:
            for kernel in needed:
                wp.force_load(device, [kernel.module], BLOCK_DIM)
                progress.update()
