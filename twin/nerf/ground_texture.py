"""Ground texture of a baked field: fits it to the training frames; terms as in `kernels/ground_texture.py`.

Bricks blur the ground, which a driving camera sees at grazing angles: a ray runs through many of their cells before it
is blocked. But the ground's height is known much better than a brick's cell, so where a ray meets the ground is known
to a few centimeters, and features can be looked up there. The texture holds what the bricks' features lack.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from twin.geometry.cameras import pixel_grid, unproject
from twin.nerf import network
from twin.nerf.appearance import Appearance
from twin.nerf.baked import BakedField, GroundTexture, ground_grid
from twin.nerf.buffers import parallel, single_threaded_torch, warp_view
from twin.nerf.dataset import TrainingPixels
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import ground_texture as kernels
from twin.runtime import bar
from twin.warp_runtime import wp

_TEXEL = 0.025  # [m] least side of the finest texels
_MAX_TILES = 6000  # texels grow until there are at most this many tiles, 33 MB
_HEIGHT_CELL = 0.25  # [m]
_HEIGHT_VIEW = 160  # [px] width of the views that find the ground
_REACH = 12.0  # [m] greatest distance of a view from the ground it finds
_MIN_UPRIGHT = 0.94  # z of the normal of ground (20° from level)
_MIN_SEEN = 8  # pixels in a cell whose height is known
_MIN_OPACITY = 0.98  # of a ray that shows the ground and nothing behind it
_MIN_HITS = 24  # training pixels in a stored tile
_MAX_HITS = 6_000_000  # training pixels that are kept, at most: 0.3 GB
_SHARDS = 4
_RAYS = 16384  # per step
_RATE, _FINAL_RATE = 0.04, 0.05  # learning rate, and its final share
_CLIPPED_SHARE = 2e-4  # share of values clipped by the range of a byte


@dataclass(frozen=True)
class GroundPixels:
    """n training pixels on the ground."""

    hits: NDArray[np.float32]
    """x, y [m] from the corner of the height map, and footprint [m], shape (n, 3)."""
    features: NDArray[np.float16]
    """Features of the baked field, shape (n, CHANNELS − 1)."""
    directions: NDArray[np.float16]
    """Unit vectors of the rays, shape (n, 3)."""
    color: NDArray[np.uint8]
    """Shape (n, 3)."""
    frame: NDArray[np.int32]
    """Training frames, shape (n,)."""


def fit_ground_texture(
    baked: BakedField, appearance: Appearance, pixels: TrainingPixels, seed: int, passes: int
) -> dict[str, Any]:
    """Gives a baked field a ground texture, fitted to the training frames; returns a summary.

    Args:
        baked: Gets the texture, unless no level surface is seen.
        appearance: Embeddings of the training frames.
        pixels: Training frames of the field.
        seed: Seed of the order of pixels.
        passes: How often every training pixel on the ground is used.
    """
    ground = _height_map(baked, pixels)
    if ground is None:
        return {"tiles": 0}
    heights, origin = ground
    seen = _ground_pixels(baked, pixels, heights, origin, seed)
    tiles, texel = _choose_tiles(seen.hits, heights.shape)
    if not len(tiles):
        return {"tiles": 0}
    texture = replace(GroundTexture.untextured(heights, origin, _HEIGHT_CELL), tiles=tiles, texel=texel)
    fitter = _TextureFitter(baked, appearance, texture, seen)
    before, after = fitter.run(max(1, round(passes * len(seen.hits) / _RAYS)))
    baked.set_ground_texture(fitter.quantized())
    return {
        "tiles": len(tiles),
        "texel_m": texel,
        "pixels": len(seen.hits),
        "psnr_before": round(before, 3),
        "psnr_after": round(after, 3),
        "bytes": len(tiles) * kernels.TEXELS * volume.CHANNELS,
    }


def _height_map(baked: BakedField, pixels: TrainingPixels) -> tuple[NDArray[np.float32], NDArray[np.float64]] | None:
    """Heights of level surfaces (along x, along y) [m], and the lowest corner of their grid; None if none is seen."""
    found = [np.zeros((0, 3))]
    for i in range(len(pixels.cameras)):
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
    xyz = np.concatenate(found)
    if len(xyz) < _MIN_SEEN:
        return None
    origin = xyz[:, :2].min(0) - _HEIGHT_CELL
    # Node i of the map is the median of the points within half a cell.
    node = np.floor((xyz[:, :2] - origin) / _HEIGHT_CELL + 0.5).astype(np.int64)
    shape = node.max(0) + 2
    flat = node[:, 0] * shape[1] + node[:, 1]
    order = np.lexsort((xyz[:, 2], flat))
    first = np.flatnonzero(np.diff(flat[order], prepend=-1))
    count = np.diff(first, append=len(order))
    median = xyz[order[first + count // 2], 2]
    known = np.zeros(shape)
    heights = np.zeros(shape)
    seen = count >= _MIN_SEEN
    at = np.unravel_index(flat[order[first[seen]]], tuple(shape))
    known[at], heights[at] = 1.0, median[seen]
    weight = gaussian_filter(known, 1.0)
    smooth = gaussian_filter(heights, 1.0) / np.maximum(weight, 1e-9)
    return np.where(weight > 0.3, smooth, kernels.NO_GROUND).astype(np.float32), origin


def _ground_pixels(
    baked: BakedField, pixels: TrainingPixels, heights: NDArray[np.float32], origin: NDArray, seed: int
) -> GroundPixels:
    """Unmasked training pixels on the ground, in random order."""
    grid = ground_grid(GroundTexture.untextured(heights, origin, _HEIGHT_CELL), baked.device)
    rng = np.random.default_rng([seed, 7])
    share = min(1.0, _MAX_HITS / max(1, int(0.5 * pixels.start[-1])))
    parts = []
    with bar("ground pixels", len(pixels.cameras), "frame") as progress:
        for i in range(len(pixels.cameras)):
            width, height = int(pixels.width[i]), int(pixels.height[i])
            pose, k = pixels.cameras.camera_to_world[i].astype(np.float32), pixels.intrinsics[i].astype(np.float32)
            shown, features = baked.render_features(
                pixels.cameras.select(np.array([i])), baked.lightings[0], (width, height)
            )
            depth = wp.array(shown.depth.ravel(), dtype=wp.float32, device=baked.device)
            hits = wp.empty(len(depth), dtype=wp.vec3f, device=baked.device)
            wp.launch(
                kernels.find_ground,
                len(depth),
                [grid, wp.mat33f(*pose[:3, :3].ravel()), wp.vec3f(*pose[:3, 3]), wp.vec4f(*k), width, depth],
                [hits],
                device=baked.device,
            )
            hit = hits.numpy()
            rows = slice(pixels.start[i], pixels.start[i + 1])
            usable = (hit[:, 2] > 0.0) & (hit[:, 2] < _TEXEL * 2**kernels.LEVELS) & pixels.unmasked[rows]
            usable &= shown.opacity.ravel() > _MIN_OPACITY
            if share < 1.0:
                usable &= rng.random(len(hit)) < share
            at = np.flatnonzero(usable)
            v, u = np.divmod(at, width)
            local = np.stack([(u + 0.5 - k[2]) / k[0], (v + 0.5 - k[3]) / k[1], np.ones(len(at), "f4")], 1)
            ray = local @ pose[:3, :3].T
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            base = features[0].reshape(volume.CHANNELS, -1)[1:, at].T.astype(np.float16)
            parts.append((hit[at], base, ray.astype(np.float16), pixels.colors[rows][at], np.full(len(at), i, np.int32)))
            progress.update()
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = rng.permutation(len(columns[0]))
    return GroundPixels(*(column[order] for column in columns))


def _parameters(baked: BakedField) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(value) for name, value in baked.network.items()}


def _choose_tiles(hits: NDArray[np.float32], map_shape: tuple[int, ...]) -> tuple[NDArray[np.int32], float]:
    """Tiles (t, 2) with enough hits, and the side of their finest texels [m]."""
    texel = _TEXEL
    while True:
        side = texel * kernels.TILE
        shape = np.ceil(np.array(map_shape) * _HEIGHT_CELL / side).astype(int) + 1
        at = (hits[:, :2] / side).astype(np.int64)
        count = np.bincount(at[:, 0] * shape[1] + at[:, 1], minlength=int(shape.prod()))
        tiles = np.argwhere(count.reshape(shape) >= _MIN_HITS).astype(np.int32)
        if len(tiles) <= _MAX_TILES:
            return tiles, texel
        texel *= max(1.05, (len(tiles) / _MAX_TILES) ** 0.5)


class _TextureFitter:
    """Fits texels by gradient descent through the color head, which stays as it is."""

    def __init__(
        self,
        baked: BakedField,
        appearance: Appearance,
        texture: GroundTexture,
        pixels: GroundPixels,
    ):
        self.texture, self.pixels = texture, pixels
        self.device, self.parameters = baked.device, _parameters(baked)
        self.embeddings = appearance.of_frames(torch.arange(len(appearance.frames))).detach().cpu()
        self.grid = ground_grid(texture, self.device)
        rows = len(texture.tiles) * kernels.TEXELS
        self.values, self.gradient = torch.zeros(rows, volume.CHANNELS), torch.zeros(rows, volume.CHANNELS)
        self.second = torch.zeros(rows)
        self.out, self.out_grad = torch.zeros(_RAYS, volume.CHANNELS), torch.zeros(_RAYS, volume.CHANNELS)
        self.batch_hits = torch.zeros(_RAYS, 3)
        self.w_values, self.w_gradient, self.w_out, self.w_out_grad = (
            warp_view(t, volume.Channels) for t in (self.values, self.gradient, self.out, self.out_grad)
        )
        self.w_second, self.w_hits = warp_view(self.second, wp.float32), warp_view(self.batch_hits, wp.vec3f)

    def run(self, steps: int) -> tuple[float, float]:
        """Fits the texels; returns the PSNR [dB] of the first and of the last tenth of the batches."""
        wp.load_module("twin.nerf.kernels.ground_texture", device=self.device)
        errors = []
        with bar("ground texture", steps, "step") as progress, single_threaded_torch():
            for step in range(steps):
                start = (step * _RAYS) % max(1, len(self.pixels.hits) - _RAYS + 1)
                count = min(_RAYS, len(self.pixels.hits))
                rows = slice(start, start + count)
                self.batch_hits[:count] = torch.from_numpy(self.pixels.hits[rows])
                rate = _RATE * _FINAL_RATE ** (step / steps)
                squared = parallel(partial(self._backward, rows=rows), range(_SHARDS), self.device)
                parallel(partial(self._update, count=count, rate=rate, step=step), range(_SHARDS), self.device)
                errors.append(sum(squared) / count / 3)
                progress.update()
        some = max(1, steps // 10)
        return float(-10 * np.log10(np.mean(errors[:some]))), float(-10 * np.log10(np.mean(errors[-some:])))

    def _backward(self, shard: int, rows: slice) -> float:
        """Gradient of the loss with respect to the texture's features of a shard, and the sum of squared errors."""
        count = rows.stop - rows.start
        low, high = shard * count // _SHARDS, (shard + 1) * count // _SHARDS
        mine = slice(rows.start + low, rows.start + high)
        wp.launch(
            kernels.interpolate_texture,
            high - low,
            [self.w_hits, self.grid, self.w_values, low],
            [self.w_out],
            device=self.device,
        )
        base = torch.from_numpy(self.pixels.features[mine]).float()
        harmonics = network.spherical_harmonics(torch.from_numpy(self.pixels.directions[mine]).float())
        added = self.out[low:high, 1:].detach().requires_grad_(True)
        embedding = self.embeddings[torch.from_numpy(self.pixels.frame[mine]).long()]
        rgb = network.head(self.parameters, base + added, harmonics, embedding)
        error = rgb - torch.from_numpy(self.pixels.color[mine]).float() / 255.0
        loss = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1, reduction="sum") / count
        (self.out_grad[low:high, 1:],) = torch.autograd.grad(loss, [added])
        return float((error.detach() ** 2).sum())

    def _update(self, part: int, count: int, rate: float, step: int) -> None:
        wp.launch(
            kernels.interpolate_texture_backward,
            count,
            [self.w_hits, self.grid, self.w_out_grad, part, _SHARDS],
            [self.w_gradient],
            device=self.device,
        )
        wp.launch(
            kernels.adam_step_texture,
            count,
            [self.w_hits, self.grid, part, _SHARDS, rate, 1.0 / (1.0 - 0.99 ** (step + 1))],
            [self.w_values, self.w_gradient, self.w_second],
            device=self.device,
        )

    def quantized(self) -> GroundTexture:
        """The texture with its texels as the renderer reads them: sums over the coarser levels, as bytes."""
        total = wp.zeros(len(self.values), dtype=volume.Channels, device=self.device)
        wp.launch(
            kernels.sum_levels,
            len(self.values),
            [wp.array(self.texture.tiles, dtype=wp.vec2i, device=self.device), self.grid, self.w_values],
            [total],
            device=self.device,
        )
        values = total.numpy()
        some = np.abs(values[:: max(1, len(values) // 200_000)])
        step = (np.quantile(some, 1.0 - _CLIPPED_SHARE, axis=0) / 127.0).astype(np.float32)
        codes = np.rint(values / np.maximum(step, 1e-9)).clip(-127, 127) + 128
        return replace(self.texture, texels=codes.astype(np.uint8), step=step)
