"""Export of the field under one lighting as Gaussian splats (Kerbl et al. 2023, "3D Gaussian Splatting").

The Gaussians are not fitted to photos. Each is a pixel of a rendered view, a disk as large as the pixel's footprint on
the surface; where views overlap, the smallest is kept. Their color does not depend on the direction of view.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.assets.views import Views
from twin.types import Array

_MIN_CELL = 0.01  # [m] side of the smallest thinning cell, which keeps one Gaussian
_DISK, _THICKNESS = 0.8, 0.2  # standard deviations along the surface and across it [pixel widths]
_MAX_ELONGATION = 4.0  # length / width of a disk seen at a grazing angle
_OPACITY = 0.97
_SH_CONSTANT = 0.28209479177387814  # spherical harmonic of degree 0, 1 / (2 √π)


@dataclass(frozen=True)
class Gaussians:
    """k disks."""

    positions: NDArray[np.float32]
    """[m], shape (k, 3)."""
    rotations: NDArray[np.float32]
    """Quaternions w, x, y, z, shape (k, 4); the normal of a disk is its z axis."""
    scales: NDArray[np.float32]
    """Standard deviations along the axes [m], shape (k, 3)."""
    rgb: NDArray[np.float32]
    """In [0, 1], shape (k, 3)."""
    opacity: NDArray[np.float32]
    """In (0, 1), shape (k,)."""

    def to_ply(self) -> bytes:
        """Binary `.ply` for 3DGS viewers: colors as harmonics, opacities as logits, scales as logarithms."""
        columns = {
            **dict(zip("xyz", self.positions.T, strict=True)),
            **{f"n{axis}": np.zeros(len(self.rgb)) for axis in "xyz"},
            **{f"f_dc_{c}": (self.rgb[:, c] - 0.5) / _SH_CONSTANT for c in range(3)},
            "opacity": np.log(self.opacity / (1.0 - self.opacity)),
            **{f"scale_{c}": np.log(self.scales[:, c]) for c in range(3)},
            **{f"rot_{c}": self.rotations[:, c] for c in range(4)},
        }
        rows = np.empty(len(self.rgb), [(name, "<f4") for name in columns])
        for name, values in columns.items():
            rows[name] = values
        properties = "".join(f"property float {name}\n" for name in columns)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
        return head.encode() + rows.tobytes()


def gaussians_of_views(views: Views, background: float) -> Gaussians:
    """One Gaussian per pixel, thinned to one per cell of about its own size.

    Pixels of depth 0 are skipped; depths are limited to `background` [m].
    """
    points, normals, widths, lengths, colors = [], [], [], [], []
    for i in range(len(views)):
        depth = np.minimum(views.depth[i], background)
        use = depth > 0.0
        camera = views.camera_to_world[i, :3, 3]
        position = views.points(i, depth)[use]
        ray = position - camera
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        normal = surface_normals(views.points(i, depth))[use]
        facing = (normal * ray).sum(1, keepdims=True)
        normal = np.where(facing > 0.0, -normal, normal)
        normal = np.where(np.abs(facing) < 1e-3, -ray, normal)  # edge-on, or undefined
        slant = np.clip(-(normal * ray).sum(1), 1.0 / _MAX_ELONGATION, 1.0)
        width = depth[use] / views.intrinsics[i, 0]
        points.append(position)
        normals.append(normal)
        widths.append(width)
        lengths.append(width / slant)
        colors.append(views.rgb[i][use])
    rays = np.concatenate([p - views.camera_to_world[i, :3, 3] for i, p in enumerate(points)])
    position, normal = np.concatenate(points), np.concatenate(normals)
    width, length, rgb = np.concatenate(widths), np.concatenate(lengths), np.concatenate(colors)
    keep = select_sharpest(position, width)
    position, normal, width, length, rgb, rays = (x[keep] for x in (position, normal, width, length, rgb, rays))
    along = rays - (rays * normal).sum(1, keepdims=True) * normal  # the ray projected onto the surface: the long axis
    along += 1e-6 * np.cross(normal, [0.3, 0.5, 0.8])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    frame = np.stack([along, np.cross(normal, along), normal], -1)
    quaternion = Rotation.from_matrix(frame).as_quat()[:, [3, 0, 1, 2]]
    scales = np.stack([_DISK * length, _DISK * width, _THICKNESS * width], -1)
    return Gaussians(
        position.astype(np.float32),
        quaternion.astype(np.float32),
        scales.astype(np.float32),
        (rgb / 255.0).astype(np.float32),
        np.full(len(rgb), _OPACITY, np.float32),
    )


def surface_normals(points: Array) -> Array:
    """Unit normals (h, w, 3) of a grid of points, from differences to the nearer neighbor along each axis."""

    def difference(axis: int) -> Array:
        step = np.diff(points, axis=axis)
        ahead = np.concatenate([step, np.take(step, [-1], axis)], axis)
        behind = np.concatenate([np.take(step, [0], axis), step], axis)
        nearer = np.linalg.norm(ahead, axis=-1) < np.linalg.norm(behind, axis=-1)
        return np.where(nearer[..., None], ahead, behind)

    normal = np.cross(difference(1), difference(0))
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def select_sharpest(points: Array, width: Array) -> NDArray[np.int64]:
    """Indices of the points (k, 3) to keep.

    In every cell that holds no point of a finer level, the point with the smallest pixel width is kept. The cell size
    is the point's pixel width [m], rounded up to `_MIN_CELL` times a power of two.
    """
    level = np.maximum(np.ceil(np.log2(width / _MIN_CELL)), 0).astype(int)
    kept: list[NDArray[np.int64]] = []
    low = points.min(0) if len(points) else 0.0
    for n in np.unique(level):
        own = np.flatnonzero(level == n)
        own = own[np.argsort(width[own], kind="stable")]
        side = _MIN_CELL * 2.0**n
        finer = np.concatenate(kept) if kept else own[:0]
        cells = np.floor((points[np.concatenate([finer, own])] - low) / side).astype(np.int64)
        _, first = np.unique(cells @ [1 << 42, 1 << 21, 1], return_index=True)
        kept.append(own[first[first >= len(finer)] - len(finer)])
    return np.sort(np.concatenate(kept))
