"""Devices, threads, layout and arrays of a radiance field; terms as in `kernels/space.py` and `kernels/sampler.py`.

Warp runs a CPU launch on one thread but releases the interpreter lock meanwhile, and so does torch in a matrix product:
two Python threads keep two cores busy. A *shard* is a fixed part of a batch. The shards of a batch do not depend on the
number of cores and are summed in order, so results do not depend on it either.
"""

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from twin.errors import InputError, short_repr
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import hashgrid
from twin.runtime import available_cores
from twin.warp_runtime import wp

T = TypeVar("T")


_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


def resolve_device(device: str | None) -> str:
    """`cpu` or `cuda`: the device asked for; None: CUDA if both torch and Warp see it, else the CPU.

    Raises InputError for another name, and for CUDA where there is none.
    """
    has_cuda = torch.cuda.is_available() and wp.is_cuda_available()
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"device {short_repr(device)}; expected cpu or cuda")
    if device == "cuda" and not has_cuda:
        raise InputError("device cuda: no CUDA device is visible to torch and warp; use --device cpu")
    return device or ("cuda" if has_cuda else "cpu")


def parallel(work: Callable[[int], T], items: Iterable[int], device: str) -> list[T]:
    """Maps `work` over items, in parallel on a CPU and serially on CUDA; results in order.

    Each worker uses one torch thread: shards in parallel use the cores better than parallel operations.
    """
    global _pool
    items = list(items)
    if device != "cpu" or len(items) < 2 or available_cores() < 2:
        return [work(item) for item in items]
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(available_cores(), initializer=torch.set_num_threads, initargs=(1,))
    return list(_pool.map(work, items))


class single_threaded_torch:
    """Context in which torch uses one thread per operation."""

    def __enter__(self) -> None:
        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: Any) -> None:
        torch.set_num_threads(self._threads)


def load_training_kernels(device: str) -> None:
    """Compiles or loads all training kernels, as two threads that first need one would each compile it."""
    for module in ("space", "sampler", "hashgrid", "composite"):
        wp.load_module(f"twin.nerf.kernels.{module}", device=device)
    if device == "cuda":  # torch and Warp exchange arrays without synchronizing, so they must share a stream
        wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()), device)


def warp_view(tensor: torch.Tensor, dtype: Any) -> Any:
    """A Warp array over a tensor's memory."""
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


# ---- layout

_NEAR_CELLS = 3_000_000  # cells of the near opacity grid: 12 MB, as a laptop's cache holds
_FAR_CELLS = 1_000_000  # cells of the far opacity grid
_INITIAL_OPTICAL_DEPTH = 1.5  # of the untrained field across the near box's longest half side
COARSEST_CELLS = 16
"""Cells of the coarsest hash level along the longest axis."""


@dataclass(frozen=True)
class NearBox:
    """The near box [m], by its center and half sides."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape (2, 3)."""
        center, half = np.array(self.center), np.array(self.half)
        return np.stack([center - half, center + half])

    @property
    def scale(self) -> float:
        """The longest half side [m]."""
        return max(self.half)


def near_box_of_cameras(camera_to_world: NDArray[np.float64], near_half_extent: float = 0.0) -> NearBox:
    """The near box of cameras (n, 4, 4), z up: their path and half the path's length ahead of each camera.

    The vertical margin is smaller, as most of what is filmed from a road lies beside it. A nonzero `near_half_extent`
    [m] instead gives a cube with that half side around the cameras.
    """
    positions, ahead = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    low, high = positions.min(0), positions.max(0)
    if near_half_extent > 0.0:
        center, half = (low + high) / 2, np.full(3, near_half_extent)
    else:
        longest = max(float((high - low).max()), 1e-3)
        seen = np.concatenate([positions, positions + 0.5 * longest * ahead])
        low, high = seen.min(0), seen.max(0)
        center = (low + high) / 2
        half = (high - low) / 2 + longest * np.array([0.15, 0.15, 0.1])
    return NearBox(tuple(map(float, center)), tuple(map(float, half)))  # type: ignore[arg-type]


@dataclass(frozen=True)
class OpacityGrids:
    """Sizes of the two opacity grids, in cells per axis."""

    near_shape: tuple[int, int, int]
    far_shape: tuple[int, int, int]
    near_cell: float
    """Side of a cell [m]."""
    far_cell: float
    """Side of a cell, measured inside the near box [m]."""


def opacity_grids(near_box: NearBox) -> OpacityGrids:
    """Sizes of cubic grids over the near box (near) and the contracted cube, twice as wide (far)."""
    box = 2.0 * np.array(near_box.half)

    def divide(sides: NDArray[np.float64], cells: int) -> tuple[tuple[int, int, int], float]:
        cell = float((sides.prod() / cells) ** (1 / 3))
        x, y, z = (int(n) for n in np.maximum(np.ceil(sides / cell), 4))
        return (x, y, z), cell

    near_shape, near_cell = divide(box, _NEAR_CELLS)
    far_shape, far_cell = divide(2.0 * box, _FAR_CELLS)
    return OpacityGrids(near_shape, far_shape, near_cell, far_cell)


def level_cells(near_box: NearBox, levels: int, growth: float) -> NDArray[np.float32]:
    """Cells per axis of every hash level, shape (levels, 3); cubic in the near box, `growth` times more per level."""
    sides = 4.0 * np.array(near_box.half)
    per_meter = COARSEST_CELLS * growth ** np.arange(levels) / sides.max()
    return np.maximum(per_meter[:, None] * sides, 1.0).astype(np.float32)


def level_shapes(cells: NDArray[np.float32], log2_table: int) -> NDArray[np.int32]:
    """Vertices per axis, and 1 if the level is stored densely, shape (levels, 4)."""
    vertices = np.floor(cells).astype(np.int64) + 2
    dense = vertices.prod(1) <= 2**log2_table
    return np.concatenate([vertices, dense[:, None]], 1).astype(np.int32)


@dataclass(frozen=True)
class Layout:
    """Sizes and bounds of a field. `field.json` stores these names as keys."""

    centre: tuple[float, float, float]
    """Center of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Distance at which rays start [m]."""
    levels: int
    growth: float
    log2_table: int
    hidden: int
    appearance_dim: int

    @property
    def near_box(self) -> NearBox:
        return NearBox(self.centre, self.half)

    @property
    def density_unit(self) -> float:
        """Density at raw output 0 [1/contracted m]."""
        return _INITIAL_OPTICAL_DEPTH / self.near_box.scale


class Workspace:
    """Arrays of `rays` rays with `samples` samples each and of `extra` points after them, reused by all batches.

    Names with `w_` are Warp views of the torch tensors.
    """

    def __init__(self, layout: Layout, rays: int, samples: int, device: str, extra: int = 0, training: bool = False):
        self.rays, self.samples, self.extra, self.device = rays, samples, extra, device
        rows, channels = rays * samples + extra, volume.CHANNELS
        width = layout.levels * hashgrid.FEATURES

        def new(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, device=device)

        self.camera = torch.zeros(rays, dtype=torch.int32, device=device)
        self.pixel, self.targets, self.cosines = new(rays, 2), new(rays), new(rays)
        self.origins, self.directions = new(rays, 3), new(rays, 3)
        self.edges, self.distances = new(rays, samples + 1), new(rays, samples)
        self.positions, self.features = new(rows, 3), new(rows, width)
        self.hidden, self.outputs = new(rows, layout.hidden), new(rows, channels)
        self.lengths = new(rays, samples)
        self.weights, self.composited = new(rays, samples), new(rays, channels)
        self.inverse_distance, self.median_distance = new(rays), new(rays)

        on_rays = rays * samples
        self.w_camera = warp_view(self.camera, wp.int32)
        self.w_pixel = warp_view(self.pixel, wp.vec2f)
        self.w_targets, self.w_cosines = warp_view(self.targets, wp.float32), warp_view(self.cosines, wp.float32)
        self.w_origins, self.w_directions = warp_view(self.origins, wp.vec3f), warp_view(self.directions, wp.vec3f)
        self.w_edges, self.w_distances = warp_view(self.edges, wp.float32), warp_view(self.distances, wp.float32)
        self.w_lengths = warp_view(self.lengths, wp.float32)
        self.w_positions = warp_view(self.positions, wp.vec3f)
        self.w_ray_positions = warp_view(self.positions[:on_rays].view(rays, samples, 3), wp.vec3f)
        self.w_features = warp_view(self.features.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature)
        self.w_outputs = warp_view(self.outputs, volume.Channels)
        self.w_ray_outputs = warp_view(self.outputs[:on_rays].view(rays, samples, channels), volume.Channels)
        self.w_weights = warp_view(self.weights, wp.float32)
        self.w_composited = warp_view(self.composited, volume.Channels)
        self.w_inverse = warp_view(self.inverse_distance, wp.float32)
        self.w_median = warp_view(self.median_distance, wp.float32)
        if training:
            self.densities = new(rows)
            self.outputs_grad, self.hidden_grad = new(rows, channels), new(rows, layout.hidden)
            self.features_grad = new(rows, width)
            self.composited_grad, self.inverse_grad = new(rays, channels), new(rays)
            self.w_densities = warp_view(self.densities, wp.float32)
            self.w_ray_outputs_grad = warp_view(
                self.outputs_grad[:on_rays].view(rays, samples, channels), volume.Channels
            )
            self.w_features_grad = warp_view(
                self.features_grad.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature
            )
            self.w_composited_grad = warp_view(self.composited_grad, volume.Channels)
            self.w_inverse_grad = warp_view(self.inverse_grad, wp.float32)


class CameraArrays:
    """Poses and intrinsics of cameras on a device, in the layout of `space.pixel_rays`."""

    def __init__(self, camera_to_world: NDArray, intrinsics: NDArray, device: str):
        self._device = device
        self.set_poses(camera_to_world)
        self.intrinsics: Any = wp.array(np.asarray(intrinsics, np.float32), dtype=wp.vec4f, device=device)

    def set_poses(self, camera_to_world: NDArray) -> None:
        """Sets camera-to-world poses, shape (n, 4, 4)."""
        pose = np.asarray(camera_to_world, np.float64)
        self.rotation: Any = wp.array(pose[:, :3, :3].astype(np.float32), dtype=wp.mat33f, device=self._device)
        self.position: Any = wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3f, device=self._device)
