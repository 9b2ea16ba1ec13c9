"""Baked field: density and features of a trained radiance field in sparse 8-bit bricks. Renders without torch.

`kernels/bricks.py` defines the bricks. The two per-ray networks, head and background (`network.py`), are stored beside
them. A lighting is one vector, so one baked field renders the place under every lighting.
"""

import copy
import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as to_bytes

from twin.errors import InputError, short_repr
from twin.files import check_shapes, load_tensors, read_json, require_text, wrap_read_errors, write_json
from twin.geometry.cameras import PosedCameras, intrinsics_for_size
from twin.nerf.appearance_prior import Probes
from twin.nerf.fog import Fog
from twin.nerf.kernels import march as kernels
from twin.nerf.kernels import surface_detail as detail_kernels
from twin.nerf.kernels.bricks import BLOCKS, CELLS, CORNERS, HALF_CORNERS, Bricks, Bytes
from twin.nerf.kernels.color_head import HARMONICS, Vec8, color_head_kernel
from twin.nerf.kernels.color_head import LANES as HEAD_LANES
from twin.nerf.kernels.composite import CHANNELS, Channels
from twin.nerf.lightings import Lightings
from twin.nerf.rendering import Rendering
from twin.runtime import available_cores, bar
from twin.types import Array32
from twin.warp_runtime import wp

# ---- layout of the bricks

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
    """Bricks over the near box."""
    far_shape: tuple[int, int, int]
    """Bricks over the contracted cube."""

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

    `near` and `far` are grid positions of the stored bricks, shape (s, 3).
    """
    out = []
    for shape, slots, first in ((layout.near_shape, near, 0), (layout.far_shape, far, len(near))):
        index = np.full(shape, -1, np.int32)
        index[tuple(slots.T)] = np.arange(first, first + len(slots))
        out.append(index)
    return out[0], out[1]


def _density_codes(samples: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Density bytes of bricks (s, 729) in the order that is described at `bricks.DENSITIES`, shape (s · 810 + 8,)."""
    cube = samples.reshape(-1, *[CORNERS] * 3)
    halves = np.stack([cube[..., :HALF_CORNERS], cube[..., HALF_CORNERS - 1 :]], 2)
    return np.concatenate([halves.ravel(), np.zeros(8, np.uint8)])  # padding, as the march reads eight bytes at a time


def _stored_skips(index: NDArray[np.int32], distance: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
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
    skips = [_stored_skips(near, arrays["near_leap"])[1], _stored_skips(far, arrays["far_leap"])[1]]
    occupied = np.concatenate(skips).reshape(-1, *[BLOCKS] * 3) == 0
    read = np.zeros((len(occupied), *[CORNERS] * 3), bool)
    for corner in itertools.product(range(CELLS // BLOCKS + 1), repeat=3):
        read[:, *(slice(c, c + CELLS - 1, CELLS // BLOCKS) for c in corner)] |= occupied
    return read.reshape(len(read), -1)


def _check_arrays(layout: BrickLayout, arrays: dict[str, NDArray], dim: int) -> None:
    """Raises ValueError if the arrays would make a kernel read outside of them."""
    near, far = arrays["near"], arrays["far"]
    slots, hidden = len(near) + len(far), arrays["network.head.1"].shape[0]
    background, inputs = arrays["network.backdrop.0"].shape[1], CHANNELS - 1 + HARMONICS + dim
    shapes: dict[str, tuple[tuple[int, ...], str]] = {
        "near": ((len(near), 3), "i"),
        "far": ((len(far), 3), "i"),
        "features": ((slots, CORNERS**3, CHANNELS), "u"),
        "low": ((CHANNELS,), "f"),
        "step": ((CHANNELS,), "f"),
        "near_leap": (tuple(BLOCKS * n for n in layout.near_shape), "u"),
        "far_leap": (tuple(BLOCKS * n for n in layout.far_shape), "u"),
        "network.head.0": ((inputs, hidden), "f"),
        "network.head.0.bias": ((hidden,), "f"),
        "network.head.1": ((hidden, hidden), "f"),
        "network.head.1.bias": ((hidden,), "f"),
        "network.head.2": ((hidden, 3), "f"),
        "network.head.2.bias": ((3,), "f"),
        "network.backdrop.0": ((HARMONICS, background), "f"),
        "network.backdrop.0.bias": ((background,), "f"),
        "network.backdrop.1": ((background, CHANNELS - 1), "f"),
    }
    check_shapes({name: (arrays[name], *expected) for name, expected in shapes.items()})
    if hidden % 8 or not hidden:
        raise ValueError(f"head of {hidden} units; expected a multiple of 8")
    for name, index, shape in (("near", near, layout.near_shape), ("far", far, layout.far_shape)):
        inside = not len(index) or (index.min() >= 0 and (index < np.array(shape)).all())
        if not inside or len(np.unique(np.ravel_multi_index(tuple(index.T), shape))) < len(index):
            raise ValueError(f"{name}: a brick is outside the grid of {shape} bricks or occurs twice")


# ---- detail


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
        return {f"detail.{name}": getattr(self, name) for name in _DETAIL_ARRAYS} | {"detail.sides": sides}

    @staticmethod
    def of_arrays(arrays: dict[str, NDArray]) -> "Detail":
        """The detail in the arrays of a `BakedField`; fields of earlier versions have none.

        Raises ValueError for arrays that a kernel could not read.
        """
        if "detail.sides" not in arrays:
            return Detail.without_features(np.zeros((0, 0), np.float32), np.zeros(2), 1.0)
        sides = arrays["detail.sides"]
        named = {name: arrays[f"detail.{name}"] for name in _DETAIL_ARRAYS}
        tiles, rows = len(named["tiles"]), len(named["vertices"])
        check_shapes(
            {
                "detail.sides": (sides, (3,), "f"),
                "detail.heights": (named["heights"], named["heights"].shape[:2], "f"),
                "detail.origin": (named["origin"], (2,), "f"),
                "detail.tiles": (named["tiles"], (tiles, 2), "i"),
                "detail.texels": (named["texels"], (tiles * detail_kernels.TEXELS, CHANNELS), "u"),
                "detail.texel_step": (named["texel_step"], (CHANNELS,), "f"),
                "detail.vertices": (named["vertices"], (rows, CHANNELS), "u"),
                "detail.vertex_step": (named["vertex_step"], (CHANNELS,), "f"),
            }
        )
        if rows < 8 or rows & (rows - 1):
            raise ValueError(f"detail.vertices has {rows} rows; expected a power of 2 from 8 on")
        if not (sides > 0.0).all() or named["tiles"].min(initial=0) < 0 or named["tiles"].max(initial=0) >= _MAX_INDEX:
            raise ValueError("detail.sides or detail.tiles out of range")
        height_cell, texel, cell = map(float, sides)
        return Detail(height_cell=height_cell, texel=texel, cell=cell, **named)


_MAX_INDEX = 10_000  # greatest number of tiles along an axis
_DETAIL_ARRAYS = ("heights", "origin", "tiles", "texels", "texel_step", "vertices", "vertex_step")


def detail_grid(detail: Detail, device: str) -> Any:
    """Height map, tile index and sizes on a device, see `detail_kernels.DetailGrid`."""
    grid: Any = detail_kernels.DetailGrid()
    grid.origin = wp.vec2f(*detail.origin.tolist())
    grid.texel, grid.cell, grid.per_height_cell = detail.texel, detail.cell, 1.0 / detail.height_cell
    grid.coarsest = max(detail.texel * 2 ** (detail_kernels.LEVELS - 1), detail.cell)
    grid.mask = wp.uint32(max(1, len(detail.vertices)) - 1)
    index = detail.tile_index
    grid.heights_x, grid.heights_y = detail.heights.shape
    grid.tiles_x, grid.tiles_y = index.shape
    grid.heights = wp.array(detail.heights.ravel(), dtype=wp.float32, device=device)
    grid.tiles = wp.array(index.ravel(), dtype=wp.int32, device=device)
    return grid


# ---- field

_FORMAT = 2
# Largest number of render targets that are kept, one per number of cameras and image size; the least recently used one
# is dropped. A vector env renders either all its envs or those that reset, whose number varies.
_MAX_TARGETS = 4


class BakedField:
    """Density and color of a place under every lighting it was filmed in, ready to render."""

    def __init__(
        self,
        layout: BrickLayout,
        lightings: Lightings,
        arrays: dict[str, NDArray],
        device: str = "cpu",
        about: dict[str, Any] | None = None,
    ):
        """
        Args:
            layout: Sizes and bounds.
            lightings: Appearance embeddings by name.
            arrays: `near` and `far` (grid positions of the stored bricks, (s, 3)), `features` (s, 729, CHANNELS) bytes,
                near bricks first, `low` and `step` (CHANNELS,) of the quantization, `near_leap` and `far_leap` (see
                `skip_distances`), `network.*`, and for random lightings `probes.*` (see `appearance_prior.Probes`).
            device: `cpu` or `cuda`.
            about: JSON-able metadata stored with the field.
        """
        self.layout, self.lightings_by_name, self.about, self.device = layout, lightings, about or {}, device
        self.arrays = arrays
        p = self.network
        if "probes.features" in arrays:
            probes = Probes(arrays["probes.features"], arrays["probes.harmonics"], p)
            self.lightings_by_name = replace(lightings, probes=probes)

        def on_device(array: NDArray, dtype: Any) -> Any:
            if device == "cpu":  # NumPy allocates large arrays on huge pages, where random reads cost less
                own = np.empty(array.shape, array.dtype)
                own[...] = array
                return wp.array(own, dtype=dtype, device=device, copy=False)
            return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)

        b: Any = Bricks()
        near_index, far_index = brick_indices(layout, arrays["near"], arrays["far"])
        near_index, near_skips = _stored_skips(near_index, arrays["near_leap"])
        far_index, far_skips = _stored_skips(far_index, arrays["far_leap"])
        b.near_index, b.far_index = on_device(near_index.ravel(), wp.int32), on_device(far_index.ravel(), wp.int32)
        b.skips = on_device(np.concatenate([near_skips, far_skips]).ravel(), wp.uint8)
        b.near_blocks = wp.vec3i(*(BLOCKS * n for n in layout.near_shape))
        b.far_blocks = wp.vec3i(*(BLOCKS * n for n in layout.far_shape))
        b.densities = on_device(_density_codes(arrays["features"][..., 0]), wp.uint8)
        b.features = on_device(arrays["features"].reshape(-1, CHANNELS), Bytes)
        b.low, b.step = Channels(*arrays["low"].tolist()), Channels(*arrays["step"].tolist())
        b.center = wp.vec3f(*layout.centre)
        b.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        b.near_cell, b.far_cell = layout.near_cell, layout.far_cell
        b.unit, b.near_plane = layout.density_unit, layout.near_plane
        self._bricks = b
        self._lock = threading.Lock()
        self._targets: dict[tuple[int, int, int, bool], _RenderTarget] = {}
        self._set_detail(Detail.of_arrays(arrays))

        self._march = kernels.march_kernel(kernels.LANES[device])
        self._color_head, weights = color_head_kernel(
            HEAD_LANES[device], p["head.1"].shape[0], p["backdrop.0"].shape[1]
        )
        rows = CHANNELS - 1 + HARMONICS
        w: Any = weights()

        def as_vec8(matrix: NDArray) -> Any:
            """Packs a matrix (units, m) as vectors of eight units: array (units / 8, m), flat."""
            return on_device(matrix.reshape(len(matrix) // 8, 8, -1).transpose(0, 2, 1).reshape(-1, 8), Vec8)

        w.head_0, w.head_1, w.head_2 = as_vec8(p["head.0"][:rows].T), as_vec8(p["head.1"].T), as_vec8(p["head.2"])
        w.head_1_bias, w.head_2_bias = as_vec8(p["head.1.bias"]), wp.vec3f(*p["head.2.bias"].tolist())
        for name in ("backdrop.0", "backdrop.0.bias", "backdrop.1"):
            setattr(w, name.replace(".", "_"), on_device(p[name].ravel(), wp.float32))
        self._weights = w
        self._first_bias = p["head.0.bias"], p["head.0"][rows:]
        needed = kernels.cone_march, self._march, detail_kernels.add_detail, self._color_head
        # Loaded here, so that no two threads load them at once.
        with bar("compiling the renderer, once", len(needed), "part", after=1.0) as progress:
            for kernel in needed:
                kernel.module.load(wp.get_device(device))
                progress.update()
        self._threads = available_cores()
        self._pool = ThreadPoolExecutor(self._threads) if device == "cpu" and self._threads > 1 else None

    @property
    def lightings(self) -> tuple[str, ...]:
        """Names of the filmed lightings, then of the added ones."""
        return self.lightings_by_name.names

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near box [m], shape (2, 3)."""
        center, half = np.array(self.layout.centre), np.array(self.layout.half)
        return np.stack([center - half, center + half])

    @property
    def network(self) -> dict[str, NDArray]:
        """Arrays of the color head and the background network, by name."""
        return {k.removeprefix("network."): v for k, v in self.arrays.items() if k.startswith("network.")}

    @property
    def bytes(self) -> int:
        """Size of the stored arrays [bytes]."""
        return sum(array.nbytes for array in self.arrays.values())

    def embedding(self, lighting: str) -> Array32:
        """See `Lightings.embedding`."""
        return self.lightings_by_name.embedding(lighting)

    def fog(self, lighting: str) -> Fog | None:
        """See `Lightings.fog`. `render` leaves the fog out; environments apply it to their images."""
        return self.lightings_by_name.fog(lighting)

    def sample_lighting(self, rng: np.random.Generator) -> Array32:
        """Embedding (dim,) of a random plausible lighting, see `Lightings.sample`."""
        return self.lightings_by_name.sample(rng)

    def add_lightings(
        self, more: Mapping[str, Array32], stale: tuple[str, ...] = (), fogs: Mapping[str, Fog] | None = None
    ) -> None:
        """See `Lightings.added`."""
        self.lightings_by_name = self.lightings_by_name.added(more, stale, fogs)

    def render(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None = None,
        stop: NDArray | None = None,
    ) -> Rendering:
        """Renders n cameras, without the fog of added lightings.

        Args:
            cameras: `Cameras` of a scene, or `Viewpoints`.
            lighting: A name (see `Lightings.embedding`) or an embedding (dim,); or a sequence of these, one per camera.
            size: Image width and height [px]; by default the size of the cameras.
            stop: z-depth of other objects [m], shape (n, height, width), at which the march ends. `opacity` is then the
                fraction of an object's light that the field in front of it blocks, and `rgb` the color of that part
                of the field alone (not premultiplied).

        Raises:
            InputError: unknown lighting, or cameras of several sizes and no size given.
        """
        with self._lock:  # all callers share the render targets
            return self._render(cameras, lighting, size, stop).result()

    def render_on_device(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        consume: Callable[[Any, Any], None],
    ) -> None:
        """Renders as `render` does and passes the result to `consume` without copying it to the host.

        `consume` receives two Warp arrays on the field's device: colors (n, height · width) of vec3, and opacities
        (n, height · width). Both are valid only until it returns.
        """
        with self._lock:
            target = self._render(cameras, lighting)
            consume(target.rgb, target.opacity)

    def render_features(
        self, cameras: PosedCameras, lighting: str | NDArray, size: tuple[int, int] | None = None
    ) -> tuple[Rendering, Array32]:
        """Renders as `render` does and also returns the composited features before the color head.

        Returns:
            The rendering, and a copy of opacity (channel 0) and features, shape (n, CHANNELS, height, width).
        """
        with self._lock:
            target = self._render(cameras, lighting, size)
            n, height, width = target.shape
            return target.result(), target.features.numpy().reshape(n, -1, height, width).copy()

    def set_detail(self, detail: Detail) -> None:
        """Replaces the detail."""
        with self._lock:
            self.arrays |= detail.arrays()
            self._set_detail(detail)

    def _set_detail(self, detail: Detail) -> None:
        stored: Any = detail_kernels.DetailBytes()
        stored.texels = wp.array(detail.texels, dtype=Bytes, device=self.device)
        stored.vertices = wp.array(detail.vertices, dtype=Bytes, device=self.device)
        stored.texel_step, stored.vertex_step = (
            Channels(*step.tolist()) for step in (detail.texel_step, detail.vertex_step)
        )
        self._detail = detail_grid(detail, self.device), stored
        self._has_detail = bool(len(detail.tiles) or len(detail.vertices))
        self._targets.clear()

    def single_threaded(self) -> "BakedField":
        """A field on the same arrays with its own render targets and lock. It renders on the calling thread.

        Several such fields render at the same time, each in a thread of the caller.
        """
        out = copy.copy(self)
        out._targets, out._lock, out._pool = {}, threading.Lock(), None
        return out

    def _render(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None = None,
        stop: NDArray | None = None,
    ) -> "_RenderTarget":
        intrinsics, (width, height) = intrinsics_for_size(cameras, size)
        pose = np.asarray(cameras.camera_to_world, np.float64)
        key = len(pose), width, height, stop is not None
        target = self._targets.pop(key, None) or _RenderTarget(self, *key)
        self._targets[key] = target
        while len(self._targets) > _MAX_TARGETS:
            del self._targets[next(iter(self._targets))]
        target.set_cameras(pose, intrinsics, self.head_biases(lighting, len(pose)), stop)
        if self._pool is None:
            for band in target.bands:
                target.render_band(band)
        else:
            list(self._pool.map(target.render_band, target.bands))
        return target

    def head_biases(self, lighting: str | NDArray | Sequence[str | NDArray], n: int) -> Array32:
        """Bias of the head's first layer including the appearance, for n cameras, shape (n, hidden)."""
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        vectors = np.stack(
            [self.embedding(v) if isinstance(v, str) else np.asarray(v) for v in ([lighting] if one else lighting)]
        ).astype(np.float32)
        if len(vectors) not in (1, n):
            raise InputError(f"{len(vectors)} lightings for {n} cameras; expected one, or one per camera")
        bias, matrix = self._first_bias
        # One product per vector: BLAS may sum a matrix product in another order for another number of vectors, and an
        # image must not depend on the other images.
        return np.broadcast_to(bias + np.stack([vector @ matrix for vector in vectors]), (n, len(bias)))

    # ---- files

    def save(self, folder: Path) -> None:
        """Writes `baked.safetensors` and `baked.json`."""
        names = self.lightings_by_name
        stored = {**self.arrays, "lightings.vectors": names.vectors, "lightings.frames": names.frame_vectors}
        (folder / "baked.safetensors").write_bytes(to_bytes({k: np.ascontiguousarray(v) for k, v in stored.items()}))
        write_json(
            folder / "baked.json",
            {
                "format": _FORMAT,
                "layout": asdict(self.layout),
                "lightings": names.names,
                "frames": names.frames,
                "about": self.about,
            },
        )

    @staticmethod
    def load(folder: Path, device: str = "cpu") -> "BakedField":
        """Loads a baked field; raises InputError if the folder has none, or one of another format."""
        path = folder / "baked.json"
        if not path.exists():
            raise InputError(f"{folder}: contains no baked.json; build the scene (again)")
        head = read_json(path)
        with wrap_read_errors(path, "build the scene again"):
            if head.get("format") != _FORMAT:
                raise InputError(
                    f"{path}: format {short_repr(head.get('format'))}, expected {_FORMAT}; build the scene again"
                )
            layout: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in head["layout"].items()}
            bricks = BrickLayout(**layout)
            names, frames = tuple(map(require_text, head["lightings"])), tuple(map(require_text, head["frames"]))
            about = dict(head["about"])
        arrays = load_tensors(folder / "baked.safetensors")
        with wrap_read_errors(folder / "baked.safetensors", "build the scene again"):
            vectors, frame_vectors = arrays.pop("lightings.vectors"), arrays.pop("lightings.frames")
            dim = vectors.shape[1]
            shapes = {"lightings.vectors": (vectors, (len(names), dim), "f")}
            check_shapes(shapes | {"lightings.frames": (frame_vectors, (len(frames), dim), "f")})
            _check_arrays(bricks, arrays, dim)
            return BakedField(bricks, Lightings(names, vectors, frames, frame_vectors), arrays, device, about)


class _RenderTarget:
    """Buffers for images of one size, and recorded launches that render them in horizontal bands, in parallel."""

    def __init__(self, field: BakedField, n: int, width: int, height: int, stopped: bool):
        self.shape, device = (n, height, width), field.device
        across, down, pixels = -(-width // kernels.TILE), -(-height // kernels.TILE), width * height

        def new(shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        image: Any = kernels.ImageBuffers()
        image.rotation, image.position = new((n,), wp.mat33f), new((n,), wp.vec3f)
        image.intrinsics = new((n,), wp.vec4f)
        image.stop = new((n, pixels) if stopped else (0, 0))
        image.width, image.height, image.across = width, height, across
        self.image, self.bias = image, new((n, len(field._first_bias[0]) // 8), Vec8)
        self.depth, self.opacity, self.rgb = new((n, pixels)), new((n, pixels)), new((n, pixels), wp.vec3f)
        self.features = new((n, CHANNELS, pixels))
        start = new((n, across * down))
        # More bands than cores keep all cores busy, as bands with sky finish sooner.
        bands = 3 * field._threads if field._pool else 1
        edges = np.unique(np.linspace(0, down, bands + 1).round().astype(int)).tolist()
        self.bands = range(len(edges) - 1)
        self.launches = []
        for first, last in itertools.pairwise(edges):
            recorded = partial(wp.launch, device=device, record_cmd=True)
            tiles = (last - first) * across
            top, bottom = first * kernels.TILE * width, min(last * kernels.TILE, height) * width
            packets = tiles * kernels.TILE**2 // kernels.LANES[device]
            runs = -(-(bottom - top) // HEAD_LANES[device])
            self.launches.append(
                [
                    recorded(kernels.cone_march, (n, tiles), [field._bricks, image, first * across], [start]),
                    recorded(
                        *(field._march, (n, packets), [field._bricks, image, first * across, start]),
                        [self.features, self.depth],
                    ),
                    *(
                        [
                            recorded(
                                *(detail_kernels.add_detail, (n, -(-(bottom - top) // detail_kernels.RUN))),
                                [*field._detail, image, top, bottom, self.depth],
                                [self.features],
                            )
                        ]
                        if field._has_detail
                        else []
                    ),
                    recorded(
                        *(field._color_head, (n, runs), [field._weights, self.bias, image, top, bottom, self.features]),
                        [self.depth, self.rgb, self.opacity],
                    ),
                ]
            )

    def set_cameras(self, pose: NDArray, intrinsics: NDArray, bias: NDArray, stop: NDArray | None) -> None:
        image = self.image
        image.rotation.assign(pose[:, :3, :3].astype(np.float32))
        image.position.assign(pose[:, :3, 3].astype(np.float32))
        image.intrinsics.assign(intrinsics.astype(np.float32))
        self.bias.assign(np.ascontiguousarray(bias, np.float32).reshape(len(bias), -1, 8))
        if stop is not None:
            image.stop.assign(np.asarray(stop, np.float32).reshape(image.stop.shape))

    def render_band(self, band: int) -> None:
        for launch in self.launches[band]:
            launch.launch()

    def result(self) -> Rendering:
        """A copy of the images, as the buffers are reused."""
        return Rendering(
            self.rgb.numpy().reshape(*self.shape, 3).copy(),
            self.depth.numpy().reshape(self.shape).copy(),
            self.opacity.numpy().reshape(self.shape).copy(),
        )
