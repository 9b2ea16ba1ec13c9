"""Color and depth rendered from the radiance field at training poses: the input of ground, mesh and splats.

A view is one rendered pose. The slant of a pixel is |n · r|, where n is the surface normal and r the ray, scaled to
unit z-depth. A point whose z-depth is 1 m larger than that of the surface is `slant` meters away from it.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.geometry.cameras import Cameras, RenderableField, pixel_grid, scaled_intrinsics, unproject
from twin.geometry.images import to_uint8
from twin.types import Array

_BATCH = 8
_METERS_PER_RADIAN = 3.0  # [m per rad] weight of direction in the distance between views
_FLYING_PIXEL_STEP = 0.06  # a pixel is between surfaces if inverse depth differs relatively by more to both neighbors
_MIN_OPACITY = 0.5
_MIN_SLANT = 0.12  # smaller slants are set to this, since normals from depth are unreliable there
_MIN_DEPTH = 0.3  # [m] from the lens; nearer depth is discarded


class ColorField(RenderableField, Protocol):
    """A renderable field with a near box, such as `RadianceField`."""

    @property
    def bounds(self) -> Array: ...  # low and high corner of the near box [m], shape (2, 3)


@dataclass(frozen=True)
class Views:
    """n rendered views of one size."""

    camera_to_world: Array  # shape (n, 4, 4)
    intrinsics: Array  # fx, fy, cx, cy [px] at the rendered size, shape (n, 4)
    rgb: NDArray[np.uint8]  # shape (n, h, w, 3)
    depth: NDArray[np.float32]
    """z-depth [m], shape (n, h, w); 0 where unreliable. The background has a larger depth than any surface."""
    slant: NDArray[np.float32]  # slant of each pixel, shape (n, h, w), at least `_MIN_SLANT`
    upward: NDArray[np.float32]  # z components (n, h, w) of the unit surface normals that point toward the lens

    def __len__(self) -> int:
        return len(self.depth)

    def select(self, index: NDArray[np.int64]) -> "Views":
        """The views with these indices."""
        return Views(*(values[index] for values in vars(self).values()))

    def points(self, i: int, depth: NDArray | None = None) -> Array:
        """World points (h, w, 3) [m] of the pixels of view i, at its own z-depth or at a given one (h, w)."""
        height, width = self.depth.shape[1:]
        rays = unproject(pixel_grid(width, height), self.intrinsics[i])
        local = rays * (self.depth[i] if depth is None else depth)[..., None]
        return local @ self.camera_to_world[i, :3, :3].T + self.camera_to_world[i, :3, 3]


def render_views(
    field: RenderableField,
    cameras: Cameras,
    count: int,
    width: int,
    far: float,
    lighting: str | None = None,
    what: str = "rendering depth",
) -> Views:
    """Renders the field at up to `count` well-distributed training poses, by default under its first lighting.

    Views are `width` [px] wide and have the aspect ratio of the first camera. Pixels with depth beyond `far` [m] are
    background. `what` is the name of the progress bar.
    """
    chosen = cameras.select(select_spread_frames(cameras, count))
    size = (width, max(2, round(width * float(cameras.sizes[0, 1] / cameras.sizes[0, 0]))))
    intrinsics = scaled_intrinsics(chosen.intrinsics, chosen.sizes, size)
    rgb, depth = [], []
    with runtime.bar(what, len(chosen), "view") as bar:
        for start in range(0, len(chosen), _BATCH):
            part = slice(start, start + _BATCH)
            image = field.render(chosen.select(np.arange(len(chosen))[part]), lighting or field.lightings[0], size)
            rgb.append(to_uint8(image.rgb))
            depth.append(reliable_depth(np.asarray(image.depth), np.asarray(image.opacity), far))
            bar.update(len(image.depth))
    all_depth = np.concatenate(depth)
    slant, upward = surface_slant(all_depth, intrinsics, chosen.camera_to_world)
    return Views(chosen.camera_to_world, intrinsics, np.concatenate(rgb), all_depth, slant, upward)


def select_spread_frames(cameras: Cameras, count: int) -> NDArray[np.int64]:
    """Sorted indices of up to `count` training frames, chosen by farthest-point sampling in position and direction."""
    candidates = np.arange(len(cameras)) if cameras.held_out.all() else np.flatnonzero(~cameras.held_out)
    poses = np.concatenate([cameras.positions, _METERS_PER_RADIAN * cameras.camera_to_world[:, :3, 2]], 1)[candidates]
    chosen, gap = [0], np.linalg.norm(poses - poses[0], axis=1)
    while len(chosen) < min(count, len(candidates)):
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(poses - poses[chosen[-1]], axis=1))
    return np.sort(candidates[np.unique(chosen)])


def reliable_depth(depth: NDArray, opacity: NDArray, far: float) -> NDArray[np.float32]:
    """Sets depth (n, h, w) to 0 where a pixel is too near, half transparent or between two surfaces.

    Pixels with depth beyond `far` [m] and nearly transparent pixels become background, with depth 10 · far. The inverse
    depth of a plane is linear in the image, so second differences distinguish pixels between surfaces from slopes.
    """
    out = np.where((depth > far) | (opacity < 0.1) | ~np.isfinite(depth), 10.0 * far, depth).astype(np.float32)
    bad = (out < _MIN_DEPTH) | ((opacity < _MIN_OPACITY) & (out < far))
    inverse = 1.0 / np.maximum(out, 1e-3)
    for axis in (1, 2):
        across = np.moveaxis(inverse, axis, -1)
        step = np.diff(across)
        first, second = step[..., :-1], step[..., 1:]
        # Bad pixels: their inverse depth is between those of their neighbors, far from both, and far from the mean.
        steep = np.minimum(np.abs(first), np.abs(second)) > _FLYING_PIXEL_STEP * across[..., 1:-1]
        bent = np.abs(first - second) > 0.3 * np.abs(first + second)
        np.moveaxis(bad, axis, -1)[..., 1:-1] |= steep & bent & (first * second > 0)
    out[bad] = 0.0
    return out


def surface_slant(depth: NDArray, intrinsics: Array, camera_to_world: Array) -> tuple[NDArray, NDArray]:
    """Slants and upward components of the normals, each (n, h, w), from central differences of inverse depth.

    A plane n · x = c seen along r = (x, y, 1) has inverse depth q = (n · r) / c, hence n ∝ (∂ₓ, ∂ᵧ, q − x ∂ₓ − y ∂ᵧ).
    """
    height, width = depth.shape[1:]
    slant, upward = np.empty((2, *depth.shape), np.float32)
    for i in range(len(depth)):
        inverse = 1.0 / np.where(depth[i] > 0, depth[i], np.nan)
        rays = unproject(pixel_grid(width, height), intrinsics[i])
        dv, du = np.gradient(inverse)
        gx, gy = du * intrinsics[i, 0], dv * intrinsics[i, 1]
        normal = np.stack([gx, gy, inverse - rays[..., 0] * gx - rays[..., 1] * gy], -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
        # n · r has the sign of the inverse depth, so n points away from the lens, and −n toward it.
        slant[i] = np.nan_to_num(np.maximum((normal * rays).sum(-1), _MIN_SLANT), nan=_MIN_SLANT)
        upward[i] = np.nan_to_num(-(normal @ camera_to_world[i, :3, :3].T)[..., 2], nan=0.0)
    return slant, upward
