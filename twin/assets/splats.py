"""The field under one lighting as Gaussian splats, for viewers and renderers that know nothing of fields.

A *gaussian* is a soft disk on a surface that the field shows (Kerbl et al. 2023, "3D Gaussian Splatting"). They are not
fitted to photos: each is a pixel of a rendered view, as large as that pixel is on the surface, and where views overlap
the sharpest one stays. So they have the field's colours and its faults, and one colour from all sides.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.assets.views import Views
from twin.types import Array

_FINEST = 0.01  # [m] side of the smallest cell in which one gaussian stays
_DISK, _THICKNESS = 0.8, 0.2  # standard deviations along the surface and across it [pixel widths]
_STRETCH = 4.0  # a disk seen edge-on grows at most so much longer than wide
_OPACITY = 0.97
_HARMONIC = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)


@dataclass(frozen=True)
class Gaussians:
    """k soft disks."""

    positions: NDArray[np.float32]
    """[m], shape (k, 3)."""
    rotations: NDArray[np.float32]
    """w, x, y, z; the disk's normal is its z, shape (k, 4)."""
    scales: NDArray[np.float32]
    """Standard deviations along its axes [m], shape (k, 3)."""
    rgb: NDArray[np.float32]
    """In [0, 1], shape (k, 3)."""
    opacity: NDArray[np.float32]
    """In (0, 1), shape (k,)."""

    def to_ply(self) -> bytes:
        """A binary `.ply` as 3DGS viewers read it: colours as harmonics, opacities as logits, logarithms of scales."""
        columns = {
            **dict(zip("xyz", self.positions.T, strict=True)),
            **{f"n{axis}": np.zeros(len(self.rgb)) for axis in "xyz"},
            **{f"f_dc_{c}": (self.rgb[:, c] - 0.5) / _HARMONIC for c in range(3)},
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
    """One gaussian per pixel, thinned to one per cell of about its own size.

    Args:
        views: Rendered views; depth 0 is left out.
        background: Where what is further away goes [m].
    """
    points, normals, widths, lengths, colours = [], [], [], [], []
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
        normal = np.where(np.abs(facing) < 1e-3, -ray, normal)  # edge-on, or none at all
        slant = np.clip(-(normal * ray).sum(1), 1.0 / _STRETCH, 1.0)
        width = depth[use] / views.intrinsics[i, 0]
        points.append(position)
        normals.append(normal)
        widths.append(width)
        lengths.append(width / slant)
        colours.append(views.rgb[i][use])
    rays = np.concatenate([p - views.camera_to_world[i, :3, 3] for i, p in enumerate(points)])
    position, normal = np.concatenate(points), np.concatenate(normals)
    width, length, rgb = np.concatenate(widths), np.concatenate(lengths), np.concatenate(colours)
    keep = sharpest(position, width)
    position, normal, width, length, rgb, rays = (x[keep] for x in (position, normal, width, length, rgb, rays))
    along = rays - (rays * normal).sum(1, keepdims=True) * normal  # of the surface, away from the lens: the long axis
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
    """Unit normals of a grid of points (h, w, 3), by differences to the nearer of the neighbours on either side."""

    def difference(axis: int) -> Array:
        step = np.diff(points, axis=axis)
        ahead = np.concatenate([step, np.take(step, [-1], axis)], axis)
        behind = np.concatenate([np.take(step, [0], axis), step], axis)
        nearer = np.linalg.norm(ahead, axis=-1) < np.linalg.norm(behind, axis=-1)
        return np.where(nearer[..., None], ahead, behind)

    normal = np.cross(difference(1), difference(0))
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def sharpest(points: Array, width: Array) -> NDArray[np.int64]:
    """Indices of the points (k, 3) that stay: one per cell, and none where finer ones are.

    A point's cell has about its width [m]: `_FINEST` times a power of two.
    """
    level = np.maximum(np.ceil(np.log2(width / _FINEST)), 0).astype(int)
    kept: list[NDArray[np.int64]] = []
    low = points.min(0) if len(points) else 0.0
    for n in np.unique(level):
        mine = np.flatnonzero(level == n)
        mine = mine[np.argsort(width[mine], kind="stable")]
        side = _FINEST * 2.0**n
        finer = np.concatenate(kept) if kept else mine[:0]
        cells = np.floor((points[np.concatenate([finer, mine])] - low) / side).astype(np.int64)
        _, first = np.unique(cells @ [1 << 42, 1 << 21, 1], return_index=True)
        kept.append(mine[first[first >= len(finer)] - len(finer)])
    return np.sort(np.concatenate(kept))
