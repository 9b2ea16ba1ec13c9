"""Fits the detail of a baked field to the training frames; `kernels/surface_detail.py` defines the terms.

Bricks blur surfaces that are seen at grazing angles, above all the ground: a ray passes through many cells before it is
blocked. The point where it meets the surface is known more precisely: on the ground to about a centimeter, as stereo
shows its height. Detail adds features at that point, which correct those of the bricks.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, median_filter

from twin.geometry.cameras import pixel_grid, unproject
from twin.nerf import network
from twin.nerf.appearance import Appearance
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import Detail, detail_grid
from twin.nerf.buffers import parallel, part_count, shard_count, single_threaded_torch, warp_view
from twin.nerf.dataset import DepthSupervision, TrainingPixels
from twin.nerf.kernels import surface_detail as kernels
from twin.nerf.kernels import volume
from twin.runtime import bar
from twin.types import Array
from twin.warp_runtime import wp

_TEXEL = 0.025  # [m] least side of the finest texels
_MAX_TILES = 6000  # texels grow until there are at most this many tiles, 33 MB
_CELL = 0.06  # [m] side of the hash grid's cells
_LOG2_ROWS = 20  # binary logarithm of the number of rows of the hash grid's table, 16 MB
_HEIGHT_CELL = 0.1  # [m] spacing of the height map
_SMOOTH_CELL = 0.25  # [m] spacing of the heights from rendered depth
_STEREO_GATE = 0.2  # [m] stereo depths farther from these heights are not on the ground
_HEIGHT_VIEW = 160  # [px] width of the rendered views in which the ground is searched
_REACH = 12.0  # [m] greatest z-depth of rendered ground, and greatest distance of stereo depths
_MIN_UPRIGHT = 0.94  # least z of the ground's unit normal (20° from level)
_MIN_RENDERED, _MIN_STEREO = 8, 3  # least numbers of points that determine a height
_MAX_GAP = 0.3  # [m] stereo heights extend this far into gaps
_MIN_OPACITY = 0.98  # rays of greater opacity show a surface and nothing behind it
_MIN_HITS = 24  # least number of training pixels in a stored tile
_MAX_HITS = 8_000_000  # approximate upper limit of the training pixels used, which take 0.5 GB
_RAYS = 16384  # rays per step
_RATE, _FINAL_RATE = 0.04, 0.05  # initial learning rate, and the final one as a share of it
_ROWS_AT_ONCE = 2**16
_CLIPPED_SHARE = 2e-4  # share of values clipped by the range of a byte


@dataclass(frozen=True)
class SurfacePixels:
    """n training pixels on surfaces."""

    hits: NDArray[np.float32]
    """See `kernels.Hit`, shape (n, 4)."""
    features: NDArray[np.float16]
    """Features of the baked field, shape (n, CHANNELS − 1)."""
    directions: NDArray[np.float16]
    """Unit vectors of the rays, shape (n, 3)."""
    color: NDArray[np.uint8]
    """Shape (n, 3)."""
    frame: NDArray[np.int32]
    """Index into the training frames, shape (n,)."""


def fit_detail(
    baked: BakedField,
    appearance: Appearance,
    pixels: TrainingPixels,
    stereo: DepthSupervision,
    seed: int,
    passes: float,
) -> dict[str, Any]:
    """Fits detail to the training frames and adds it to a baked field; returns a summary.

    Args:
        baked: The field that the detail is added to.
        appearance: Embeddings of the training frames.
        pixels: Training frames of the field.
        stereo: Depths in these frames, from which the height of the ground is known; may be empty.
        seed: Seed of the order of pixels.
        passes: How often every usable training pixel is used.
    """
    facts = []
    for k, frames in enumerate(baked.road.frames(pixels.cameras.positions)):
        detail, about = _section_detail(baked.alone(k), appearance, pixels.of_frames(frames), stereo, seed + k, passes)
        if detail is not None:
            baked.set_detail(k, detail)
            facts.append(about)
    if not facts:
        return {"pixels": 0}
    totals = {name: sum(one[name] for one in facts) for name in ("pixels", "tiles", "bytes")}
    means = {name: round(float(np.mean([one[name] for one in facts])), 3) for name in ("psnr_before", "psnr_after")}
    return totals | {"texel_m": max(one["texel_m"] for one in facts)} | means


def _section_detail(
    baked: BakedField,
    appearance: Appearance,
    pixels: TrainingPixels,
    stereo: DepthSupervision,
    seed: int,
    passes: float,
) -> tuple[Detail | None, dict[str, Any]]:
    """Detail of a field of one section, or None if no pixel shows a near surface; and a summary."""
    ground = Detail.without_features(*_height_map(baked, pixels, stereo), _HEIGHT_CELL)
    seen = _surface_pixels(baked, pixels, ground, seed)
    if not len(seen.hits):
        return None, {}
    tiles, texel = _choose_tiles(seen.hits, ground.heights.shape)
    vertices = np.zeros((2**_LOG2_ROWS, 0), np.uint8)
    fitter = _DetailFitter(
        baked, appearance, replace(ground, tiles=tiles, texel=texel, cell=_CELL, vertices=vertices), seen
    )
    before, after = fitter.run(max(1, round(passes * len(seen.hits) / _RAYS)))
    detail = fitter.quantized()
    return detail, {
        "pixels": len(seen.hits),
        "tiles": len(tiles),
        "texel_m": texel,
        "psnr_before": before,
        "psnr_after": after,
        "bytes": sum(array.nbytes for array in detail.arrays().values()),
    }


def _height_map(
    baked: BakedField, pixels: TrainingPixels, stereo: DepthSupervision
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Heights of the ground (along x, along y) [m], and the lowest corner of their grid.

    Rendered depth shows where the ground is, but it smooths curbs. Stereo depths near the ground replace it where there
    are enough of them.
    """
    rendered = _level_points(baked, pixels)
    if not len(rendered):
        return np.full((2, 2), kernels.NO_GROUND, np.float32), pixels.cameras.positions[:, :2].min(0)
    origin = rendered[:, :2].min(0) - _SMOOTH_CELL
    smooth, seen = _medians(rendered, origin, _SMOOTH_CELL, _MIN_RENDERED)
    weight = gaussian_filter(seen.astype(float), 1.0)
    smooth = gaussian_filter(smooth, 1.0) / np.maximum(weight, 1e-9)
    fine = _SMOOTH_CELL / _HEIGHT_CELL
    shape = tuple(math.ceil((n - 1) * fine) + 1 for n in smooth.shape)
    nodes = np.indices(shape) / fine
    known = map_coordinates(weight, nodes, order=1, mode="nearest") > 0.3
    heights = map_coordinates(smooth, nodes, order=1, mode="nearest")

    points = _stereo_points(pixels, stereo)
    node = np.floor((points[:, :2] - origin) / _HEIGHT_CELL + 0.5).astype(np.int64)
    inside = ((node >= 0) & (node < shape)).all(1)
    node, points = node[inside], points[inside]
    near = known[tuple(node.T)] & (np.abs(points[:, 2] - heights[tuple(node.T)]) < _STEREO_GATE)
    sharp, seen = _medians(points[near], origin, _HEIGHT_CELL, _MIN_STEREO, shape)
    if seen.any():
        # The smooth heights in a small gap would be a dent in a curb.
        gap, nearest = distance_transform_edt(~seen, return_indices=True)
        heights = median_filter(np.where(gap * _HEIGHT_CELL < _MAX_GAP, sharp[tuple(nearest)], heights), 3)
    return np.where(known, heights, kernels.NO_GROUND).astype(np.float32), origin


def _medians(
    xyz: Array, origin: Array, cell: float, least: int, shape: tuple[int, ...] | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Median z of the points within half a cell of each node of a grid, and the mask of nodes with `least` points.

    Where there are fewer, the median is 0. The default `shape` covers all points.
    """
    node = np.floor((xyz[:, :2] - origin) / cell + 0.5).astype(np.int64)
    size = tuple(node.max(0) + 2) if shape is None else shape
    flat = node[:, 0] * size[1] + node[:, 1]
    order = np.lexsort((xyz[:, 2], flat))
    first = np.flatnonzero(np.diff(flat[order], prepend=-1))
    count = np.diff(first, append=len(order))
    enough = count >= least
    at = np.unravel_index(flat[order[first[enough]]], size)
    out, seen = np.zeros(size), np.zeros(size, bool)
    out[at], seen[at] = xyz[order[(first + count // 2)[enough]], 2], True
    return out, seen


def _level_points(baked: BakedField, pixels: TrainingPixels) -> Array:
    """Points (k, 3) [m] of rendered pixels on level surfaces."""
    found = [np.zeros((0, 3))]
    for i in pixels.frames.tolist():
        width = min(_HEIGHT_VIEW, int(pixels.width[i]))
        height = max(2, round(width * int(pixels.height[i]) / int(pixels.width[i])))
        pose, k = pixels.cameras.camera_to_world[i], pixels.intrinsics[i] * (width / pixels.width[i])
        depth = baked.render(pixels.cameras.select(np.array([i])), baked.lightings[0], (width, height)).depth[0]
        points = unproject(pixel_grid(width, height), k) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
        # Normals from neighboring pixels.
        across, down = np.diff(points[1:], axis=1), np.diff(points[:, 1:], axis=0)
        normal = np.cross(down, across)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        points = points[1:, 1:]
        level = (normal[..., 2] > _MIN_UPRIGHT) & (depth[1:, 1:] < _REACH) & (points[..., 2] < pose[2, 3])
        found.append(points[level])
    return np.concatenate(found)


def _stereo_points(pixels: TrainingPixels, stereo: DepthSupervision) -> Array:
    """Points (k, 3) [m] of the stereo depths in `pixels.frames`, up to `_REACH` away."""
    found = [np.zeros((0, 3))]
    for i in pixels.frames.tolist():
        rows = stereo.of_frame(i)
        rays, distance = unproject(stereo.pixel[rows], pixels.intrinsics[i]), stereo.distance[rows]
        near = distance < _REACH
        depth = distance[near] / np.linalg.norm(rays[near], axis=1)
        pose = pixels.cameras.camera_to_world[i]
        found.append(rays[near] * depth[:, None] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(found)


def _surface_pixels(baked: BakedField, pixels: TrainingPixels, ground: Detail, seed: int) -> SurfacePixels:
    """Unmasked training pixels that detail can change, in random order."""
    grid = detail_grid(ground, baked.device)
    rng = np.random.default_rng([seed, 7])
    total = int((pixels.width * pixels.height)[pixels.frames].sum())
    share = min(1.0, _MAX_HITS / max(1, int(0.7 * total)))
    # Untouched memory is free, and parts to be joined later would set the build's peak memory.
    room = min(total, int(1.05 * share * total) + 10_000)
    columns: list[NDArray[Any]] = [
        np.empty((room, 4), np.float32),
        np.empty((room, volume.CHANNELS - 1), np.float16),
        np.empty((room, 3), np.float16),
        np.empty((room, 3), np.uint8),
        np.empty(room, np.int32),
    ]
    count = 0
    with bar("surface points", len(pixels.frames), "frame") as progress:
        for i in pixels.frames.tolist():
            width, height = int(pixels.width[i]), int(pixels.height[i])
            pose, k = pixels.cameras.camera_to_world[i].astype(np.float32), pixels.intrinsics[i].astype(np.float32)
            shown, features = baked.render_features(
                pixels.cameras.select(np.array([i])), baked.lightings[0], (width, height)
            )
            depth: wp.array = wp.array(shown.depth.ravel(), dtype=wp.float32, device=baked.device)
            hits = wp.empty(len(depth), dtype=kernels.Hit, device=baked.device)
            camera = [wp.mat33f(*pose[:3, :3].ravel()), wp.vec3f(*pose[:3, 3]), wp.vec4f(*k)]
            wp.launch(kernels.find_surface, len(depth), [grid, *camera, width, depth], [hits], device=baked.device)
            hit = hits.numpy()
            rows = slice(pixels.start[i], pixels.start[i + 1])
            coarsest = np.where(hit[:, 3] > 0.0, _TEXEL * 2 ** (kernels.LEVELS - 1), _CELL)
            usable = np.abs(hit[:, 3]) < kernels.MAX_FOOTPRINT * coarsest
            usable &= (hit[:, 3] != 0.0) & pixels.unmasked[rows]
            usable &= shown.opacity.ravel() > _MIN_OPACITY
            if share < 1.0:
                usable &= rng.random(len(hit)) < share
            at = np.flatnonzero(usable)
            v, u = np.divmod(at, width)
            local = np.stack([(u + 0.5 - k[2]) / k[0], (v + 0.5 - k[3]) / k[1], np.ones(len(at), "f4")], 1)
            ray = local @ pose[:3, :3].T
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            base = features[0].reshape(volume.CHANNELS, -1)[1:, at].T
            more = slice(count, count + len(at))
            for column, values in zip(columns, (hit[at], base, ray, pixels.colors[rows][at], i), strict=True):
                column[more] = values
            count = more.stop
            progress.update()
    order = rng.permutation(count)
    return SurfacePixels(*(columns.pop(0)[:count][order] for _ in range(5)))  # one at a time is copied


def _choose_tiles(hits: NDArray[np.float32], map_shape: tuple[int, ...]) -> tuple[NDArray[np.int32], float]:
    """Tiles (t, 2) with enough hits, and the side of their finest texels [m]."""
    texel, on_ground = _TEXEL, hits[hits[:, 3] > 0.0]
    while True:
        side = texel * kernels.TILE
        shape = np.ceil(np.array(map_shape) * _HEIGHT_CELL / side).astype(int) + 1
        at = np.floor(on_ground[:, :2] / side).astype(np.int64)
        at = at[((at >= 0) & (at < shape)).all(1)]
        count = np.bincount(at[:, 0] * shape[1] + at[:, 1], minlength=int(shape.prod()))
        tiles = np.argwhere(count.reshape(shape) >= _MIN_HITS).astype(np.int32)
        if len(tiles) <= _MAX_TILES:
            return tiles, texel
        texel *= max(1.05, (len(tiles) / _MAX_TILES) ** 0.5)


class _DetailFitter:
    """Fits detail by gradient descent through the color head, which stays fixed."""

    def __init__(self, baked: BakedField, appearance: Appearance, detail: Detail, pixels: SurfacePixels):
        self.detail, self.pixels, self.device = detail, pixels, baked.device
        self.shards, self.parts = shard_count(self.device), part_count(self.device)
        self.parameters = {name: torch.from_numpy(value).to(self.device) for name, value in baked.network.items()}
        with torch.no_grad():
            self.embeddings = appearance.of_frames(torch.arange(len(appearance.frames), device=self.device))
        self.grid = detail_grid(detail, self.device)

        def new(*shape: int, dtype: Any = volume.Channels) -> tuple[torch.Tensor, Any]:
            tensor = torch.zeros(shape, device=self.device)
            return tensor, warp_view(tensor, dtype)

        self.hits, self.w_hits = new(_RAYS, 4, dtype=kernels.Hit)
        self.added, self.w_added = new(_RAYS, volume.CHANNELS)
        self.added_grad, self.w_added_grad = new(_RAYS, volume.CHANNELS)
        tables = []
        for rows in (len(detail.tiles) * kernels.TEXELS, len(detail.vertices)):
            values, gradient = new(rows, volume.CHANNELS), new(rows, volume.CHANNELS)
            tables.append((values[1], gradient[1], new(rows, dtype=wp.float32)[1]))
        self.texels, self.vertices = tables
        wp.load_module("twin.nerf.kernels.surface_detail", device=self.device)

    def run(self, steps: int) -> tuple[float, float]:
        """Fits the detail; returns the PSNR [dB] of the first and of the last tenth of the batches."""
        n = len(self.pixels.hits)
        count = min(_RAYS, n)
        errors: list[torch.Tensor] = []
        with bar("fitting detail", steps, "step") as progress, single_threaded_torch():
            for step in range(steps):
                start = step * count % (n - count + 1)
                rows = slice(start, start + count)
                self.hits[:count] = torch.from_numpy(self.pixels.hits[rows])
                rate = _RATE * _FINAL_RATE ** (step / steps)
                squared = parallel(partial(self._backward, rows=rows), range(self.shards), self.device)
                parallel(partial(self._update, count=count, rate=rate, step=step), range(self.parts), self.device)
                errors.append(torch.stack(squared))
                progress.update()
        some, means = max(1, steps // 10), [sum(shards) / count / 3 for shards in torch.stack(errors).tolist()]
        return float(-10 * np.log10(np.mean(means[:some]))), float(-10 * np.log10(np.mean(means[-some:])))

    def _backward(self, shard: int, rows: slice) -> torch.Tensor:
        """Writes the loss gradient of a shard's added features; returns the shard's sum of squared errors."""
        count = rows.stop - rows.start
        low, high = shard * count // self.shards, (shard + 1) * count // self.shards
        mine = slice(rows.start + low, rows.start + high)

        def batch(array: NDArray) -> torch.Tensor:
            return torch.from_numpy(array[mine]).to(self.device)

        inputs = [self.w_hits, self.grid, self.texels[0], self.vertices[0], low]
        wp.launch(kernels.interpolate_detail, high - low, inputs, [self.w_added], device=self.device)
        added = self.added[low:high, 1:].detach().requires_grad_(True)
        harmonics = network.spherical_harmonics(batch(self.pixels.directions).float())
        embedding = self.embeddings[batch(self.pixels.frame).long()]
        rgb = network.head(self.parameters, batch(self.pixels.features).float() + added, harmonics, embedding)
        error = rgb - batch(self.pixels.color).float() / 255.0
        loss = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1, reduction="sum") / count
        (self.added_grad[low:high, 1:],) = torch.autograd.grad(loss, [added])
        return (error.detach() ** 2).sum()

    def _update(self, part: int, count: int, rate: float, step: int) -> None:
        inputs = [self.w_hits, self.grid, self.w_added_grad, part, self.parts]
        outputs = [self.texels[1], self.vertices[1]]
        wp.launch(kernels.interpolate_detail_backward, count, inputs, outputs, device=self.device)
        rates = [rate, 1.0 / (1.0 - 0.99 ** (step + 1))]
        if self.device == "cpu":
            hits = [self.w_hits, self.grid, part, self.parts]
            wp.launch(kernels.adam_step_detail, count, [*hits, *rates, *self.texels, *self.vertices], device="cpu")
        else:
            for table in (self.texels, self.vertices):
                wp.launch(kernels.adam_step_everywhere, table[0].shape[0], [*rates, *table], device=self.device)

    def quantized(self) -> Detail:
        """The detail as the renderer reads it: bytes, with the coarser levels added to every texel."""
        total = wp.zeros(self.texels[0].shape, dtype=volume.Channels, device=self.device)
        tiles: wp.array = wp.array(self.detail.tiles, dtype=wp.vec2i, device=self.device)
        wp.launch(kernels.sum_levels, total.shape[0], [tiles, self.grid, self.texels[0]], [total], device=self.device)
        texels, texel_step = _as_bytes(total.numpy())
        vertices, vertex_step = _as_bytes(self.vertices[0].numpy())
        return replace(self.detail, texels=texels, texel_step=texel_step, vertices=vertices, vertex_step=vertex_step)


def _as_bytes(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Values (rows, CHANNELS) as bytes around 128, and the value of one byte step in each channel."""
    used = np.flatnonzero((values != 0.0).any(1))
    if not len(used):
        return np.full(values.shape, 128, np.uint8), np.zeros(values.shape[1], np.float32)
    sample = values[used[:: max(1, len(used) // 200_000)]]
    step = np.quantile(np.abs(sample), 1.0 - _CLIPPED_SHARE, axis=0) / 127.0
    codes = np.empty(values.shape, np.uint8)
    for start in range(0, len(values), _ROWS_AT_ONCE):  # copies of the whole table would set the build's peak memory
        rows = slice(start, start + _ROWS_AT_ONCE)
        codes[rows] = np.rint(values[rows] / np.maximum(step, 1e-9)).clip(-127, 127) + 128
    return codes, step.astype(np.float32)
