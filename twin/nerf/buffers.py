"""What a radiance field is computed with: its layout, and the arrays of a batch of rays.

A `Workspace` holds everything between the pixels of a batch and their colours, so that nothing is allocated per batch.
"""

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from twin.errors import InputError
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import hashgrid
from twin.runtime import cores

# ---- Where the field is computed, and how its work is split over cores.
#
# Warp runs a CPU launch on one thread but releases the interpreter while it does, and so does torch in a matrix product:
# two Python threads keep two cores busy. A *shard* is a fixed part of a batch. How a batch is cut into shards never
# depends on the number of cores and shards are summed in order, so that a result does not depend on the machine's cores.


T = TypeVar("T")

wp.config.log_level = wp.LOG_ERROR
wp.init()

_pool: ThreadPoolExecutor | None = None
_lock = threading.Lock()


def device() -> str:
    """`cpu` or `cuda`: what TWIN_DEVICE asks for, else CUDA where both torch and Warp see it.

    Raises:
        InputError: TWIN_DEVICE is neither, or asks for CUDA where there is none.
    """
    wanted = os.environ.get("TWIN_DEVICE", "")
    has_cuda = torch.cuda.is_available() and wp.is_cuda_available()
    if wanted not in ("", "cpu", "cuda"):
        raise InputError(f"device {wanted!r}: expected cpu or cuda")
    if wanted == "cuda" and not has_cuda:
        raise InputError("device cuda: no CUDA device is visible to torch and warp; use --device cpu")
    return wanted or ("cuda" if has_cuda else "cpu")


def parallel(work: Callable[[int], T], items: Iterable[int], where: str) -> list[T]:
    """`work` on every item, side by side on the cores of a CPU, one after the other on CUDA; results in order.

    Torch's own threads are held at one meanwhile: several shards at a time use the cores better than each op in turn.
    """
    global _pool
    items = list(items)
    if where != "cpu" or len(items) < 2 or cores() < 2:
        return [work(item) for item in items]
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(cores(), initializer=torch.set_num_threads, initargs=(1,))
    return list(_pool.map(work, items))


class single_threaded_torch:
    """Within it, torch uses one thread per op; the setting is restored after."""

    def __enter__(self) -> None:
        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: Any) -> None:
        torch.set_num_threads(self._threads)


def load_training_kernels(where: str) -> None:
    """Compiles or loads all kernels now: two threads that first need one would each compile it."""
    for module in ("space", "sampler", "hashgrid", "composite"):
        wp.load_module(f"twin.nerf.kernels.{module}", device=where)
    if where == "cuda":  # torch and Warp hand arrays to each other without waiting, so they must share a stream
        wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()), where)


def view(tensor: torch.Tensor, dtype: Any) -> Any:
    """A Warp array over a tensor's memory."""
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


# ---- The near box, the stop grids and the levels: how a field of given bounds is laid out.
#
# Vocabulary as in `kernels/space.py` and `kernels/sampler.py`.


_NEAR_CELLS = 3_000_000  # cells of the fine stop grid: 12 MB, as a laptop's cache holds
_FAR_CELLS = 1_000_000  # cells of the coarse one
COARSEST = 16
"""Cells of the coarsest level along the longest axis."""


@dataclass(frozen=True)
class Space:
    """The near box [m]."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape (2, 3)."""
        centre, half = np.array(self.centre), np.array(self.half)
        return np.stack([centre - half, centre + half])

    @property
    def scale(self) -> float:
        """The longest half side [m]."""
        return max(self.half)


def space_of_cameras(camera_to_world: NDArray[np.float64], near_half_extent: float = 0.0) -> Space:
    """A near box around cameras, shape (n, 4, 4), z up: their path, and half the path's length ahead of each of them.

    Upright it is given less: what is filmed from a road lies beside it rather than above.
    `near_half_extent` [m], where not 0, is the half side of a cube around the cameras to use instead.
    """
    positions, ahead = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    low, high = positions.min(0), positions.max(0)
    if near_half_extent > 0.0:
        centre, half = (low + high) / 2, np.full(3, near_half_extent)
    else:
        longest = max(float((high - low).max()), 1e-3)
        seen = np.concatenate([positions, positions + 0.5 * longest * ahead])
        low, high = seen.min(0), seen.max(0)
        centre = (low + high) / 2
        half = (high - low) / 2 + longest * np.array([0.15, 0.15, 0.1])
    return Space(tuple(map(float, centre)), tuple(map(float, half)))  # type: ignore[arg-type]


@dataclass(frozen=True)
class OpacityGrids:
    """Sizes of the two stop grids."""

    near_shape: tuple[int, int, int]
    far_shape: tuple[int, int, int]
    near_cell: float
    """Side of a cell [m]."""
    far_cell: float
    """Side of a cell, measured inside the near box [m]."""


def opacity_grids(space: Space) -> OpacityGrids:
    """The fine grid covers the near box, the coarse one the contracted cube, twice as wide; cells are cubes there."""
    box = 2.0 * np.array(space.half)

    def divide(sides: NDArray[np.float64], cells: int) -> tuple[tuple[int, int, int], float]:
        cell = float((sides.prod() / cells) ** (1 / 3))
        x, y, z = (int(n) for n in np.maximum(np.ceil(sides / cell), 4))
        return (x, y, z), cell

    near_shape, near_cell = divide(box, _NEAR_CELLS)
    far_shape, far_cell = divide(2.0 * box, _FAR_CELLS)
    return OpacityGrids(near_shape, far_shape, near_cell, far_cell)


def level_cells(space: Space, levels: int, growth: float) -> NDArray[np.float32]:
    """Cells per axis of every level, shape (levels, 3); cubes in the near box, growing by `growth` per level."""
    sides = 4.0 * np.array(space.half)
    per_metre = COARSEST * growth ** np.arange(levels) / sides.max()
    return np.maximum(per_metre[:, None] * sides, 1.0).astype(np.float32)


def level_shapes(cells: NDArray[np.float32], log2_table: int) -> NDArray[np.int32]:
    """Vertices per axis and whether the level is dense, shape (levels, 4)."""
    vertices = np.floor(cells).astype(np.int64) + 2
    dense = vertices.prod(1) <= 2**log2_table
    return np.concatenate([vertices, dense[:, None]], 1).astype(np.int32)


_START_DENSITY = 1.5  # optical depth of the untrained field across the near box's longest half side


@dataclass(frozen=True)
class Layout:
    """Everything about a field that is no learned number."""

    centre: tuple[float, float, float]
    """Of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Rays begin here [m]."""
    levels: int
    growth: float
    log2_table: int
    hidden: int
    appearance_dim: int

    @property
    def space(self) -> Space:
        return Space(self.centre, self.half)

    @property
    def density_unit(self) -> float:
        """Density at raw output 0, per contracted metre."""
        return _START_DENSITY / self.space.scale


class Workspace:
    """Arrays of a batch of `rays` rays with `samples` samples each, and `extra` single points after them."""

    def __init__(self, layout: Layout, rays: int, samples: int, where: str, extra: int = 0, training: bool = False):
        self.rays, self.samples, self.where = rays, samples, where
        rows, channels = rays * samples + extra, volume.CHANNELS
        width = layout.levels * hashgrid.FEATURES

        def new(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, device=where)

        self.camera = torch.zeros(rays, dtype=torch.int32, device=where)
        self.pixel, self.targets, self.cosines = new(rays, 2), new(rays), new(rays)
        self.origins, self.directions = new(rays, 3), new(rays, 3)
        self.edges, self.distances = new(rays, samples + 1), new(rays, samples)
        self.positions, self.features = new(rows, 3), new(rows, width)
        self.hidden, self.outputs = new(rows, layout.hidden), new(rows, channels)
        self.lengths = new(rays, samples)
        self.weights, self.composited = new(rays, samples), new(rays, channels)
        self.inverse_distance, self.median_distance = new(rays), new(rays)

        on_rays = rays * samples
        self.w_camera = view(self.camera, wp.int32)
        self.w_pixel = view(self.pixel, wp.vec2f)
        self.w_targets, self.w_cosines = view(self.targets, wp.float32), view(self.cosines, wp.float32)
        self.w_origins, self.w_directions = view(self.origins, wp.vec3f), view(self.directions, wp.vec3f)
        self.w_edges, self.w_distances = view(self.edges, wp.float32), view(self.distances, wp.float32)
        self.w_lengths = view(self.lengths, wp.float32)
        self.w_positions = view(self.positions, wp.vec3f)
        self.w_ray_positions = view(self.positions[:on_rays].view(rays, samples, 3), wp.vec3f)
        self.w_features = view(self.features.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature)
        self.w_outputs = view(self.outputs, volume.Channels)
        self.w_ray_outputs = view(self.outputs[:on_rays].view(rays, samples, channels), volume.Channels)
        self.w_weights = view(self.weights, wp.float32)
        self.w_composited = view(self.composited, volume.Channels)
        self.w_inverse = view(self.inverse_distance, wp.float32)
        self.w_median = view(self.median_distance, wp.float32)
        if training:
            self.densities = new(rows)
            self.outputs_grad, self.hidden_grad = new(rows, channels), new(rows, layout.hidden)
            self.features_grad = new(rows, width)
            self.composited_grad, self.inverse_grad = new(rays, channels), new(rays)
            self.w_densities = view(self.densities, wp.float32)
            self.w_ray_outputs_grad = view(self.outputs_grad[:on_rays].view(rays, samples, channels), volume.Channels)
            self.w_features_grad = view(
                self.features_grad.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature
            )
            self.w_composited_grad = view(self.composited_grad, volume.Channels)
            self.w_inverse_grad = view(self.inverse_grad, wp.float32)


class CameraArrays:
    """Cameras as the ray kernel wants them."""

    def __init__(self, camera_to_world: NDArray, intrinsics: NDArray, where: str):
        self._where = where
        self.set_poses(camera_to_world)
        self.intrinsics: Any = wp.array(np.asarray(intrinsics, np.float32), dtype=wp.vec4f, device=where)

    def set_poses(self, camera_to_world: NDArray) -> None:
        """Moves the cameras; shape (n, 4, 4)."""
        pose = np.asarray(camera_to_world, np.float64)
        self.rotation: Any = wp.array(pose[:, :3, :3].astype(np.float32), dtype=wp.mat33f, device=self._where)
        self.position: Any = wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3f, device=self._where)
