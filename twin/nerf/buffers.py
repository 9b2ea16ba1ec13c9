"""Devices, threads, layout and arrays of a radiance field.

The terms are defined in `kernels/space.py` and `kernels/volume.py`.

Warp runs a CPU launch on one thread. As Warp and torch release the interpreter lock while they compute, two Python
threads keep two cores busy. A batch is divided into a fixed number of *shards*, whose results are summed in order. So
results do not depend on the number of cores. On CUDA there is one shard: a launch uses the whole GPU.
"""

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from twin.config import NerfConfig
from twin.errors import InputError, short_repr
from twin.nerf.kernels import hashgrid, space, volume
from twin.runtime import available_cores
from twin.warp_runtime import wp

Item = TypeVar("Item")
T = TypeVar("T")

_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


def resolve_device(device: str | None) -> str:
    """The requested device, `cpu` or `cuda`; None means CUDA if both torch and Warp see it, else the CPU.

    Raises InputError for another name, and for `cuda` if there is no CUDA device.
    """
    has_cuda = torch.cuda.is_available() and wp.is_cuda_available()
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"device {short_repr(device)}; expected cpu or cuda")
    if device == "cuda" and not has_cuda:
        raise InputError("device cuda: no CUDA device is visible to torch and warp; use --device cpu")
    return device or ("cuda" if has_cuda else "cpu")


def shard_count(device: str) -> int:
    """Number of shards of a batch."""
    return 4 if device == "cpu" else 1


def part_count(device: str) -> int:
    """Number of parts of an update whose result does not depend on it; every part reads the whole batch."""
    return min(shard_count(device), available_cores())


def parallel(work: Callable[[Item], T], items: Iterable[Item], device: str) -> list[T]:
    """Maps `work` over items, in parallel on a CPU and serially on CUDA; results in order.

    Each worker uses one torch thread: parallel shards use the cores better than parallel operations within a shard.
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


def in_batches(work: Callable[[slice], None], n: int, size: int, device: str) -> None:
    """Calls `work` on slices of n rows, at most `size` rows each, in parallel and without gradients."""

    @torch.no_grad()
    def one(start: int) -> None:
        work(slice(start, min(start + size, n)))

    with single_threaded_torch():
        parallel(one, range(0, n, size), device)


def load_training_kernels(device: str) -> None:
    """Compiles or loads the training kernels once, before several threads would each compile their own copy."""
    for module in ("space", "hashgrid", "volume"):
        wp.load_module(f"twin.nerf.kernels.{module}", device=device)
    if device == "cuda":  # torch and Warp exchange arrays without synchronizing, so they must share a stream
        wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()), device)


def warp_view(tensor: torch.Tensor, dtype: Any) -> Any:
    """A Warp array that shares a tensor's memory."""
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


# ---- layout

_NEAR_CELLS = 3_000_000  # cells of the near opacity grid: 12 MB, which fit in a laptop's cache
_FAR_CELLS = 1_000_000  # cells of the far opacity grid
_INITIAL_OPTICAL_DEPTH = 1.5  # optical depth of the untrained field along the near box's longest half side
_COARSEST_CELLS = 16  # cells of the coarsest hash level along the longest axis
_CELL_PIXELS = 2.0  # projected side of the finest hash cell at the distance of near surfaces [px of a training frame]
_GROWTH_RANGE = (1.3, 2.2)  # limits of the factor between the cells per axis of consecutive hash levels
_HIDDEN = 64  # units per hidden layer
_MIN_NEAR_PLANE = 1e-3  # [m] losses divide by distances along rays, so no sample may be at a camera


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
    """Ratio of the cells per axis of consecutive hash levels."""
    log2_table: int
    hidden: int
    appearance_dim: int

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near box [m], shape (2, 3)."""
        center, half = np.array(self.centre), np.array(self.half)
        return np.stack([center - half, center + half])

    @property
    def scale(self) -> float:
        """The longest half side of the near box [m]."""
        return max(self.half)

    @property
    def density_unit(self) -> float:
        """Density at raw output 0 [1/contracted m]."""
        return _INITIAL_OPTICAL_DEPTH / self.scale

    def grid_positions(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Points (n, 3) [m] → grid positions in [0, 1), shape (n, 3); see `kernels/space.py`."""
        u = (points - np.array(self.centre)) / np.array(self.half)
        m = np.maximum(np.abs(u).max(1, keepdims=True), 1.0)
        u *= (2.0 - 1.0 / m) / m
        return (u * 0.25 + 0.5).clip(0.0, 1.0 - 1e-6).astype(np.float32)

    def opacity_grids(self) -> list[tuple[tuple[int, ...], float]]:
        """Cells per axis, and side of a cell [contracted m], of the near and the far opacity grid.

        The near grid covers the near box, the far grid the contracted cube, which is twice as wide.
        """
        out = []
        for sides, cells in ((2.0 * np.array(self.half), _NEAR_CELLS), (4.0 * np.array(self.half), _FAR_CELLS)):
            cell = float((sides.prod() / cells) ** (1 / 3))
            out.append((tuple(int(n) for n in np.maximum(np.ceil(sides / cell), 4)), cell))
        return out

    def level_cells(self) -> NDArray[np.float32]:
        """Cells per axis of every hash level, shape (levels, 3). Inside the near box, cells are cubes."""
        sides = 4.0 * np.array(self.half)
        per_meter = _COARSEST_CELLS * self.growth ** np.arange(self.levels) / sides.max()
        return np.maximum(per_meter[:, None] * sides, 1.0).astype(np.float32)

    def level_shapes(self) -> NDArray[np.int32]:
        """Vertices per axis, and 1 if the level is stored densely, shape (levels, 4)."""
        vertices = np.floor(self.level_cells()).astype(np.int64) + 2
        dense = vertices.prod(1) <= 2**self.log2_table
        return np.concatenate([vertices, dense[:, None]], 1).astype(np.int32)


def near_box(
    camera_to_world: NDArray[np.float64], near_half_extent: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Center and half sides [m] of the near box of cameras (n, 4, 4), z up.

    It contains the cameras and the points half the path's extent ahead of each, with a margin, which is smaller
    vertically, as most of what is filmed from a road lies beside the road. A nonzero `near_half_extent` [m] instead
    gives a cube with that half side around the cameras.
    """
    positions, ahead = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    low, high = positions.min(0), positions.max(0)
    if near_half_extent > 0.0:
        return (low + high) / 2, np.full(3, near_half_extent)
    longest = max(float((high - low).max()), 1e-3)
    seen = np.concatenate([positions, positions + 0.5 * longest * ahead])
    low, high = seen.min(0), seen.max(0)
    return (low + high) / 2, (high - low) / 2 + longest * np.array([0.15, 0.15, 0.1])


def near_distance(scale: float, known: NDArray) -> float:
    """Distance of near surfaces from the cameras [m]: a low quantile of the known distances (k,).

    Without a known one, it is a quarter of `scale`, the longest half side of the near box [m].
    """
    return float(np.quantile(known, 0.05)) if len(known) else 0.25 * scale


def section_layout(camera_to_world: NDArray[np.float64], config: NerfConfig, known: NDArray, focal: float) -> Layout:
    """The layout of a section that is filmed by cameras (n, 4, 4).

    The finest hash cell is `_CELL_PIXELS` wide at the distance of near surfaces, for a focal length [px of a training
    frame].
    """
    center, half = (tuple(values.tolist()) for values in near_box(camera_to_world, config.near_half_extent))
    cell = _CELL_PIXELS * near_distance(max(half), known) / focal
    ratio = 4.0 * max(half) / cell / _COARSEST_CELLS
    return Layout(
        center,
        half,
        near_plane=max(config.near_plane, _MIN_NEAR_PLANE),
        levels=config.levels,
        growth=float(np.clip(ratio ** (1.0 / max(1, config.levels - 1)), *_GROWTH_RANGE)),
        log2_table=config.log2_table,
        hidden=_HIDDEN,
        appearance_dim=config.appearance_dim,
    )


class Workspace:
    """Arrays for `rays` rays with `samples` samples each, followed by `extra` points; all batches reuse them.

    Attributes `w_*` are Warp views of the torch tensors; those named `w_ray_*` have a row per ray and no extra points.
    """

    def __init__(self, layout: Layout, rays: int, samples: int, device: str, extra: int = 0, training: bool = False):
        self.rays, self.samples, self.device = rays, samples, device
        rows, channels = rays * samples + extra, volume.CHANNELS
        levels, width = layout.levels, layout.levels * hashgrid.FEATURES

        def new(dtype: Any, *shape: int) -> tuple[torch.Tensor, Any]:
            tensor = torch.zeros(shape, device=device)
            return tensor, warp_view(tensor, dtype)

        def by_ray(tensor: torch.Tensor, dtype: Any) -> Any:
            return warp_view(tensor[: rays * samples].view(rays, samples, *tensor.shape[1:]), dtype)

        self.camera = torch.zeros(rays, dtype=torch.int32, device=device)
        self.w_camera = warp_view(self.camera, wp.int32)
        self.pixel, self.w_pixel = new(wp.vec2f, rays, 2)
        self.targets, self.w_targets = new(wp.float32, rays)
        self.w_rays: Any = space.Rays()
        self.origins, self.w_rays.origins = new(wp.vec3f, rays, 3)
        self.directions, self.w_rays.directions = new(wp.vec3f, rays, 3)
        self.cosines, self.w_rays.cosines = new(wp.float32, rays)
        self.w_strata: Any = volume.Strata()
        self.edges, self.w_strata.edges = new(wp.float32, rays, samples + 1)
        self.distances, self.w_strata.distances = new(wp.float32, rays, samples)
        self.lengths, self.w_strata.lengths = new(wp.float32, rays, samples)
        self.positions, self.w_positions = new(wp.vec3f, rows, 3)
        self.w_ray_positions = by_ray(self.positions, wp.vec3f)
        self.features = torch.zeros(rows, width, device=device)
        self.w_features = warp_view(self.features.view(rows, levels, -1), hashgrid.Feature)
        self.hidden = torch.zeros(rows, layout.hidden, device=device)
        self.outputs, self.w_outputs = new(volume.Channels, rows, channels)
        self.w_ray_outputs = by_ray(self.outputs, volume.Channels)
        self.weights, self.w_weights = new(wp.float32, rays, samples)
        self.composited, self.w_composited = new(volume.Channels, rays, channels)
        self.inverse_distance, self.w_inverse = new(wp.float32, rays)
        self.median_distance, self.w_median = new(wp.float32, rays)
        if training:
            self.densities, self.w_densities = new(wp.float32, rows)
            self.outputs_grad, self.w_outputs_grad = new(volume.Channels, rows, channels)
            self.w_ray_outputs_grad = by_ray(self.outputs_grad, volume.Channels)
            self.hidden_grad, self.features_grad = torch.zeros_like(self.hidden), torch.zeros_like(self.features)
            self.w_features_grad = warp_view(self.features_grad.view(rows, levels, -1), hashgrid.Feature)
            self.composited_grad, self.w_composited_grad = new(volume.Channels, rays, channels)
            self.inverse_grad, self.w_inverse_grad = new(wp.float32, rays)


class CameraArrays:
    """Poses and intrinsics of cameras on a device, in the layout of `space.pixel_rays`."""

    def __init__(self, camera_to_world: NDArray, intrinsics: NDArray, device: str):
        self._device = device
        self.set_poses(camera_to_world)
        self.intrinsics: Any = wp.array(np.asarray(intrinsics, np.float32), dtype=wp.vec4f, device=device)

    def set_poses(self, camera_to_world: NDArray) -> None:
        """Sets poses, shape (n, 4, 4)."""
        pose = np.asarray(camera_to_world, np.float64)
        self.rotation: Any = wp.array(pose[:, :3, :3].astype(np.float32), dtype=wp.mat33f, device=self._device)
        self.position: Any = wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3f, device=self._device)
