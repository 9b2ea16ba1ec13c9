"""Render target: the buffers of images, and the launches that render a section of a baked field into them.

`baked.py` chooses the sections that render a camera, and blends their images.
"""

import itertools
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import Rendering
from twin.nerf.baked_arrays import BrickLayout, Detail, brick_indices, density_codes, detail_grid, stored_skips
from twin.nerf.kernels import march as kernels
from twin.nerf.kernels import surface_detail as detail_kernels
from twin.nerf.kernels.bricks import BLOCKS, Bricks, Bytes
from twin.nerf.kernels.color_head import HARMONICS, Vec8, color_head_kernel
from twin.nerf.kernels.color_head import LANES as HEAD_LANES
from twin.nerf.kernels.volume import CHANNELS, Channels
from twin.runtime import bar
from twin.types import Array32
from twin.warp_runtime import wp

_BLOCK = 128  # threads of a block on a GPU; with 256, it renders 10 % fewer pictures a second
_COPIED = 8  # images that are copied together


@dataclass(frozen=True)
class CameraBatch:
    """n cameras to render."""

    pose: NDArray[np.float64]
    """Camera to world, shape (n, 4, 4)."""
    intrinsics: NDArray[np.float64]
    """Shape (n, 4)."""
    size: tuple[int, int]
    """Width, height [px]."""
    bias: Array32
    """See `BakedField.head_biases`."""
    stop: NDArray | None
    """See `BakedField.render`."""

    def subset(self, rows: NDArray[np.int64]) -> "CameraBatch":
        """Some of the cameras."""
        stop = None if self.stop is None else self.stop[rows]
        return CameraBatch(self.pose[rows], self.intrinsics[rows], self.size, self.bias[rows], stop)


@dataclass(frozen=True)
class RenderedImages:
    """Images of n cameras, with or without features."""

    rendering: Rendering
    features: Array32 | None
    """Opacity (channel 0) and composited features, shape (n, CHANNELS, height, width)."""


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
        """Copies the arrays of a `BakedSection` to a device."""
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
        stored: Any = detail_kernels.DetailBytes()
        stored.texels = wp.array(detail.texels, dtype=Bytes, device=device)
        stored.vertices = wp.array(detail.vertices, dtype=Bytes, device=device)
        stored.texel_step, stored.vertex_step = (
            Channels(*step.tolist()) for step in (detail.texel_step, detail.vertex_step)
        )
        self.detail = detail_grid(detail, device), stored
        self.has_detail = bool(len(detail.tiles) or len(detail.vertices))
        self.targets: WeakKeyDictionary[Any, OrderedDict[tuple, RenderTarget]] = WeakKeyDictionary()
        """Render targets of every `BakedField` object that shares this section; they are dropped with it."""


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
        needed = kernels.cone_march, self.march, detail_kernels.add_detail, self.color_head
        # Loaded here, so that no two threads load them at once.
        with bar("compiling the renderer (first use only)", len(needed), "part", after=1.0) as progress:
            for kernel in needed:
                wp.force_load(device, [kernel.module], _BLOCK)
                progress.update()


class RenderTarget:
    """Buffers for images of one size, and recorded launches that render them in horizontal bands, in parallel."""

    def __init__(
        self,
        compiled: RenderKernels,
        section: SectionOnDevice,
        bands: int,
        n: int,
        width: int,
        height: int,
        stopped: bool,
    ):
        """Allocates buffers for n cameras and at most `bands` bands; with `stopped`, rays end at given depths."""
        self.shape, device = (n, height, width), compiled.device
        # The arrays live as long as the launches that read them. A reference to the section itself would be circular,
        # and a dropped section would stay in memory until the next garbage collection.
        self.arrays = section.bricks, section.detail
        across, down, pixels = -(-width // kernels.TILE), -(-height // kernels.TILE), width * height

        def new(shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        image: Any = kernels.ImageBuffers()
        image.rotation, image.position = new((n,), wp.mat33f), new((n,), wp.vec3f)
        image.intrinsics = new((n,), wp.vec4f)
        image.stop = new((n, pixels) if stopped else (0, 0))
        image.width, image.height, image.across = width, height, across
        self.image, self.bias = image, new((n, len(compiled.first_bias[0]) // 8), Vec8)
        self.depth, self.opacity, self.rgb = new((n, pixels)), new((n, pixels)), new((n, pixels), wp.vec3f)
        self.features = new((n, CHANNELS, pixels))
        self.staging: list[Any] = []
        start = new((n, across * down))
        edges = np.unique(np.linspace(0, down, bands + 1).round().astype(int)).tolist()
        self.bands = range(len(edges) - 1)
        self.launches = []
        for first, last in itertools.pairwise(edges):
            recorded = partial(wp.launch, device=device, record_cmd=True, block_dim=_BLOCK)
            tiles = (last - first) * across
            top, bottom = first * kernels.TILE * width, min(last * kernels.TILE, height) * width
            packets = tiles * kernels.TILE**2 // kernels.LANES[device]
            runs = -(-(bottom - top) // HEAD_LANES[device])
            launches = [
                recorded(kernels.cone_march, (n, tiles), [section.bricks, image, first * across], [start]),
                recorded(
                    *(compiled.march, (n, packets), [section.bricks, image, first * across, start]),
                    [self.features, self.depth],
                ),
            ]
            if section.has_detail:
                run = detail_kernels.RUN[device]
                dim, inputs = (n, -(-(bottom - top) // run)), [image, top, bottom, run, self.depth]
                launches.append(recorded(detail_kernels.add_detail, dim, [*section.detail, *inputs], [self.features]))
            inputs = [compiled.weights, self.bias, image, top, bottom, self.features]
            outputs = [self.depth, self.rgb, self.opacity]
            launches.append(recorded(compiled.color_head, (n, runs), inputs, outputs))
            self.launches.append(launches)

    def set_cameras(self, views: CameraBatch) -> None:
        """Sets the cameras of the next images, as many as the target has."""
        image = self.image
        image.rotation.assign(views.pose[:, :3, :3].astype(np.float32))
        image.position.assign(views.pose[:, :3, 3].astype(np.float32))
        image.intrinsics.assign(views.intrinsics.astype(np.float32))
        self.bias.assign(np.ascontiguousarray(views.bias, np.float32).reshape(len(views.bias), -1, 8))
        if views.stop is not None:
            image.stop.assign(np.asarray(views.stop, np.float32).reshape(image.stop.shape))

    def render_band(self, band: int) -> None:
        """Renders a band of all images; bands may be rendered at the same time."""
        for launch in self.launches[band]:
            launch.launch()

    def images(self, features: bool, pool: ThreadPoolExecutor | None) -> RenderedImages:
        """Copies of the images, as the buffers are reused; with or without features. The threads of `pool` copy."""
        arrays = [self.rgb, self.depth, self.opacity, *([self.features] if features else [])]
        shapes = [(*self.shape, 3), self.shape, self.shape, (self.shape[0], CHANNELS, *self.shape[1:])]
        sources = [array.numpy() for array in (self._staged(arrays) if self.rgb.device.is_cuda else arrays)]
        out = [np.empty(shape, np.float32) for shape, _ in zip(shapes, sources, strict=False)]
        pairs = [(to, source.reshape(to.shape)) for to, source in zip(out, sources, strict=True)]
        # The first write to new memory takes longer than the transfer from a GPU, unless many threads write.
        slices = [slice(i, i + _COPIED) for i in range(0, len(out[0]), _COPIED)]
        parts = [(to[some], source[some]) for to, source in pairs for some in slices]
        copying = pool.map if pool and len(slices) > 1 else map
        list(copying(np.copyto, *zip(*parts, strict=True)))
        return RenderedImages(Rendering(*out[:3]), out[3] if features else None)

    def _staged(self, arrays: list[Any]) -> list[Any]:
        """Copies on the host of arrays on a GPU, in page-locked memory, where transfers are faster."""
        for array in arrays[len(self.staging) :]:
            self.staging.append(wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=True))
        for staged, array in zip(self.staging, arrays, strict=False):
            wp.copy(staged, array)
        wp.synchronize_device(arrays[0].device)
        return self.staging[: len(arrays)]
