"""Verb: exports the visual mesh as glTF and the radiance field as Gaussian splats, in the colors of one lighting.

    python -m twin.export scenes/demo --glb road.glb --ply road.ply --lighting night

The Gaussians (Kerbl et al. 2023, "3D Gaussian Splatting") are not fitted to photos. Each is a pixel of a view rendered
from a filmed pose: a disk as large as the pixel's footprint on the surface; where views overlap, the smallest is kept.
Their color does not depend on the viewing direction.
"""

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from twin import commands
from twin.assets.views import Views, render_views
from twin.errors import InputError
from twin.files import load_arrays, write_bytes
from twin.geometry.cameras import project
from twin.loading import load_scene
from twin.scene import require_stage
from twin.types import Array

_VIEWS, _WIDTH = 60, 320
_FAR = 100.0  # [m] beyond which geometry becomes background
_BACKGROUND = 150.0  # [m] distance of the background's splats
_DEPTH_TOLERANCE = 0.03  # relative depth difference up to which a vertex counts as visible
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def export(scene: Path, lighting: str | None, glb: Path | None, ply: Path | None) -> list[str]:
    """Writes the given files, in colors without fog; returns a summary line for each.

    Raises:
        InputError: the scene is not built, the lighting is unknown, or an output folder does not exist.
    """
    for path in (glb, ply):
        if path is not None and not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}; create it, or give another path")
    twin = load_scene(scene)
    field = twin.field()
    lighting = lighting or field.lightings[0]
    field.embedding(lighting)  # raises early for an unknown name
    views = render_views(field, twin.cameras(), _VIEWS, _WIDTH, _FAR, lighting)
    lines = []
    if glb is not None:
        mesh = load_arrays(require_stage(twin.scene, "mesh") / "visual.npz")
        vertices, faces = mesh["vertices"], mesh["faces"]
        colors = vertex_colors(views, vertices.astype(np.float64))
        surface = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
        surface.apply_transform(_Z_UP_TO_Y_UP)  # glTF's convention
        content = surface.export(file_type="glb")
        assert isinstance(content, bytes)
        write_bytes(glb, content)
        lines.append(f"{glb}: {len(faces)} faces under {lighting}, y up [m]")
    if ply is not None:
        splats = gaussians_of_views(views, _BACKGROUND)
        write_bytes(ply, splats.to_ply())
        lines.append(f"{ply}: {len(splats.rgb)} gaussians under {lighting}, z up [m]")
    return lines


def command(options: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    if options.glb is None and options.ply is None:
        raise InputError("nothing to write; give --glb FILE, --ply FILE or both")
    lines = export(options.scene, options.lighting, options.glb, options.ply)
    if not options.quiet:
        print("\n".join(lines))


# ---- mesh


def vertex_colors(views: Views, vertices: NDArray) -> NDArray[np.uint8]:
    """Colors of vertices (k, 3) [m]: means over views weighted by 1 / depth², shape (k, 3).

    A vertex that no view shows has the color of the nearest one that a view shows.
    """
    height, width = views.depth.shape[1:]
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for i in range(len(views)):
        pixel, depth = project(vertices, views.camera_to_world[i], views.intrinsics[i])
        u, v = np.floor(np.nan_to_num(pixel, nan=-1.0).clip(-1.0, 1e6)).astype(int).T
        inside = np.flatnonzero((depth > 0.0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))
        rendered = views.depth[i, v[inside], u[inside]]
        visible = inside[np.abs(rendered - depth[inside]) < _DEPTH_TOLERANCE * depth[inside]]
        share = 1.0 / depth[visible] ** 2
        total[visible] += share[:, None] * views.rgb[i, v[visible], u[visible]]
        weight[visible] += share
    known = weight > 0.0
    if not known.any():
        raise InputError("no view of the field shows the mesh; build the scene again")
    colors = total / np.maximum(weight, 1e-12)[:, None]
    colors[~known] = colors[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return (colors + 0.5).astype(np.uint8)


# ---- splats

_MIN_CELL = 0.01  # [m] side of the smallest thinning cell, which keeps one Gaussian
_DISK, _THICKNESS = 0.8, 0.2  # standard deviations along the surface and across it [pixel widths]
_MAX_ELONGATION = 4.0  # length / width of a disk seen at a grazing angle
_OPACITY = 0.97
_SH_CONSTANT = 0.28209479177387814  # spherical harmonic of degree 0, 1 / (2 √π)


@dataclass(frozen=True)
class Gaussians:
    """k disks, each with a normal along its z axis."""

    positions: NDArray[np.float32]
    """[m], shape (k, 3)."""
    rotations: NDArray[np.float32]
    """Quaternions w, x, y, z, shape (k, 4)."""
    scales: NDArray[np.float32]
    """Standard deviations along the axes [m], shape (k, 3)."""
    rgb: NDArray[np.float32]
    """In [0, 1], shape (k, 3)."""
    opacity: NDArray[np.float32]
    """In (0, 1), shape (k,)."""

    def to_ply(self) -> bytes:
        """Binary `.ply` for 3DGS viewers: colors as spherical harmonics, opacities as logits, scales as logarithms."""
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
    columns: list[list[NDArray]] = []
    for i in range(len(views)):
        depth = np.minimum(views.depth[i], background)
        use = depth > 0.0
        camera = views.camera_to_world[i, :3, 3]
        position = views.points(i, depth)[use]
        ray = position - camera
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        normal = _surface_normals(views.points(i, depth))[use]
        facing = (normal * ray).sum(1, keepdims=True)
        normal = np.where(facing > 0.0, -normal, normal)
        normal = np.where(np.abs(facing) < 1e-3, -ray, normal)  # edge-on, or undefined
        slant = np.clip(-(normal * ray).sum(1), 1.0 / _MAX_ELONGATION, 1.0)
        width = depth[use] / views.intrinsics[i, 0]
        columns.append([position, position - camera, normal, width, width / slant, views.rgb[i][use]])
    joined = [np.concatenate(column) for column in zip(*columns, strict=True)]
    keep = select_sharpest(joined[0], joined[3])
    position, rays, normal, width, length, rgb = (column[keep] for column in joined)
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


def _surface_normals(points: Array) -> Array:
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
    """Indices of the points (k, 3) to keep: in each cell without a finer point, that of the smallest width (k,) [m].

    A point's cell size is its width, rounded up to `_MIN_CELL` times a power of two.
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


main = partial(commands.main, "export")

if __name__ == "__main__":
    sys.exit(main())
