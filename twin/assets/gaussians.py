"""Gaussian splats (Kerbl et al. 2023, "3D Gaussian Splatting") of a radiance field, and their files.

These Gaussians are not fitted to photos. Each is made from one pixel of a view rendered from a filmed pose: it is a
disk as large as the pixel's footprint on the surface. Where views overlap, the smallest disk is kept. The colors do not
depend on the viewing direction. Gaussians of one set of views have the same geometry under every lighting; only their
colors differ.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import logit

from twin.assets.views import ColorField, Views, render_views
from twin.errors import InputError
from twin.files import atomic_path, read_bytes
from twin.geometry.cameras import Cameras
from twin.types import Array

VIEWS, WIDTH = 60, 320  # number of rendered views, and their width [px]
FAR = 100.0  # [m] geometry at a larger depth becomes background
_BACKGROUND = 150.0  # [m] distance of the background's splats
_MIN_SKY, _MAX_SKY = 500, 50_000  # least and about the largest number of pixels in the fit of the sky's color
# A pixel shows the sky if it differs from the sky's color by less than this (rms over lightings and channels).
_SKY_TOLERANCE = 30.0  # [1/255]
# Within this reach [px] of such a pixel, the larger blend tolerance [of 255] holds.
_BLEND_TOLERANCE, _BLEND_REACH = 60.0, 3
_MIN_CELL = 0.01  # [m] side of the smallest thinning cell; each cell keeps one Gaussian
_DISK, _THICKNESS = 0.8, 0.2  # standard deviations along the surface and across it [pixel widths]
_MAX_ELONGATION = 4.0  # length / width of a disk seen at a grazing angle
_OPACITY = 0.97
SH_CONSTANT = 0.28209479177387814  # spherical harmonic of degree 0, 1 / (2 √π)


@dataclass(frozen=True)
class Gaussians:
    """k disks, each with a normal along its z axis."""

    positions: NDArray[np.float32]  # centers [m], shape (k, 3)
    rotations: NDArray[np.float32]  # quaternions w, x, y, z, shape (k, 4)
    scales: NDArray[np.float32]  # standard deviations along the axes [m], shape (k, 3)
    rgb: NDArray[np.float32]  # in [0, 1], shape (k, 3)
    opacity: NDArray[np.float32]  # in (0, 1), shape (k,)

    def render_settings(self) -> dict[str, NDArray[np.float32]]:
        """Arguments for `mujoco_warp.create_render_context`, which then draws these splats."""
        return {
            "splat_position": np.ascontiguousarray(self.positions),
            "splat_rotation": np.ascontiguousarray(self.rotations),
            "splat_scale": np.ascontiguousarray(self.scales),
            "splat_rgba": np.concatenate([self.rgb, self.opacity[:, None]], 1).astype(np.float32),
        }

    def stored(self) -> dict[str, NDArray[np.float32]]:
        """Columns of 3DGS files: `means`, `quats`, `sh0` (harmonics), `opacities` (logits), `scales` (logarithms)."""
        return {
            "means": self.positions,
            "quats": self.rotations,
            "sh0": (self.rgb - np.float32(0.5)) / np.float32(SH_CONSTANT),
            "opacities": logit(np.clip(self.opacity, 1e-6, 1.0 - 1e-6)),
            "scales": np.log(self.scales),
        }

    def to_ply(self) -> bytes:
        """Binary `.ply` for 3DGS viewers."""
        stored = self.stored()
        columns = {
            **dict(zip("xyz", stored["means"].T, strict=True)),
            **{f"n{axis}": np.zeros(len(self.rgb)) for axis in "xyz"},
            **{f"f_dc_{c}": stored["sh0"][:, c] for c in range(3)},
            "opacity": stored["opacities"],
            **{f"scale_{c}": stored["scales"][:, c] for c in range(3)},
            **{f"rot_{c}": stored["quats"][:, c] for c in range(4)},
        }
        return ply_bytes(columns)

    def write_spz(self, path: Path) -> None:
        """Writes the compressed `.spz` (version 3), a fifth of the `.ply`; positions are rounded to 0.24 mm up to 2 km.

        Raises InputError: the package gsply is missing.
        """
        spz = require_spz()
        stored = {name: np.ascontiguousarray(values, np.float32) for name, values in self.stored().items()}
        higher = np.zeros((len(self.rgb), 0, 3), np.float32)  # the color does not depend on the direction
        with atomic_path(path) as partial:
            # 24 bits for a coordinate and its sign: beyond 2 km, fewer of them are left for its fraction.
            reach = float(np.abs(self.positions).max(initial=1.0)) + 1.0
            bits = min(12, 23 - int(np.ceil(np.log2(reach))))
            spz.write_spz(partial, spz.GSData(**stored, shN=higher), fractional_bits=bits)


def ply_bytes(columns: dict[str, NDArray]) -> bytes:
    """A binary `.ply` with a vertex per row of the columns (n,); bytes are stored as `uchar`, others as `float`."""
    kinds = {
        name: ("uchar", "u1") if values.dtype == np.uint8 else ("float", "<f4") for name, values in columns.items()
    }
    rows = np.empty(len(next(iter(columns.values()))), [(name, kind) for name, (_, kind) in kinds.items()])
    for name, values in columns.items():
        rows[name] = values
    properties = "".join(f"property {kind} {name}\n" for name, (kind, _) in kinds.items())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return head.encode() + rows.tobytes()


def require_spz() -> Any:
    """Returns the module `gsply.spz`. Raises InputError: it is missing."""
    try:
        from gsply import spz
    except ImportError as error:
        raise InputError(f"{error}: .spz files need gsply; pip install 'twin[spz]'") from None
    return spz


_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_TYPES |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "short": "<i2", "ushort": "<u2", "char": "i1"}
_COLUMNS = ("x y z", "opacity", "f_dc_0 f_dc_1 f_dc_2", "scale_0 scale_1 scale_2", "rot_0 rot_1 rot_2 rot_3")
_MAX_HEAD = 1 << 16  # [bytes]
_MAX_PLY = 4 << 30  # [bytes]
_MAX_COORDINATE = 1e6  # [m]


def read_ply(path: Path) -> Gaussians:
    """Reads a binary `.ply` as 3DGS trainers and viewers write it; the coordinate frame is that of the file.

    Only the constant color is kept; higher spherical harmonics are ignored. Gaussians that are not finite are left out.

    Raises InputError: the file does not exist, has another format, or is cut off.
    """
    content = read_bytes(path, _MAX_PLY)
    cure = "expected a 3D Gaussian splat .ply (binary, little endian), as 3DGS trainers write"
    head, found, _ = content[:_MAX_HEAD].partition(b"end_header\n")
    if not found or not head.startswith(b"ply"):
        raise InputError(f"{path} is not a ply file; {cure}")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise InputError(f"{path} has another format; {cure}")
    elements = [line for line in lines if line[:1] == ["element"]]
    if not elements or elements[0][1:2] != ["vertex"] or len(elements[0]) != 3 or not elements[0][2].isdigit():
        raise InputError(f"{path} does not begin with its vertices; {cure}")
    count, names = int(elements[0][2]), []
    for line in lines[lines.index(elements[0]) + 1 :]:
        if line[:1] == ["element"]:
            break
        if line[:1] == ["property"]:
            if len(line) != 3 or line[1] not in _TYPES:
                raise InputError(f"{path}: property {' '.join(line[1:])!r} is unknown; {cure}")
            names.append((line[2], _TYPES[line[1]]))
    missing = [name for name in " ".join(_COLUMNS).split() if name not in dict(names)]
    if missing or len(dict(names)) < len(names):
        what = f"lacks {missing}" if missing else "has two properties of the same name"
        raise InputError(f"{path} {what}; {cure}")
    row = np.dtype(names)
    start = len(head) + len(found)
    if len(content) - start < count * row.itemsize:
        raise InputError(f"{path} is cut off: its head announces {count} splats of {row.itemsize} bytes; copy it again")
    rows = np.frombuffer(content, row, count, start)
    with np.errstate(over="ignore", invalid="ignore"):
        position, logit_opacity, harmonic, log_scale, rotation = (
            np.stack([rows[name] for name in column.split()], -1).astype(np.float32) for column in _COLUMNS
        )
        length = np.linalg.norm(rotation, axis=1, keepdims=True)
        scale = np.exp(log_scale)
        rgb = np.clip(harmonic * np.float32(SH_CONSTANT) + np.float32(0.5), 0.0, 1.0)
        opacity = 1.0 / (1.0 + np.exp(-logit_opacity[:, 0]))
    sound = (np.abs(position) < _MAX_COORDINATE).all(1) & (scale < _MAX_COORDINATE).all(1) & (length[:, 0] > 1e-6)
    sound &= np.isfinite(rgb).all(1) & np.isfinite(opacity) & np.isfinite(rotation).all(1)
    if not sound.any():
        raise InputError(f"{path} has no splat whose numbers are finite; {cure}")
    return Gaussians(*(a[sound] for a in (position, rotation / np.maximum(length, 1e-6), scale, rgb, opacity)))


def views_by_lighting(field: ColorField, cameras: Cameras, lightings: Sequence[str]) -> dict[str, Views]:
    """Renders the views for Gaussians under each lighting, without fog; all have the same depth images.

    Raises InputError: unknown lighting.
    """
    filmed = [name for name in field.lightings if name in cameras.lightings]
    names = dict.fromkeys([*lightings, *filmed])
    views = {name: render_views(field, cameras, VIEWS, WIDTH, FAR, name, f"splats, {name}") for name in names}
    depth = views[lightings[0]].depth.copy()
    depth[sky_on_surfaces([views[name] for name in filmed])] = 10.0 * FAR
    return {name: replace(views[name], depth=depth) for name in lightings}


def gaussians_by_lighting(views: Mapping[str, Views]) -> dict[str, Gaussians]:
    """Gaussians under each lighting of `views_by_lighting`; they differ in color only."""
    splats, pixel = gaussians_of_views(next(iter(views.values())), _BACKGROUND)
    return {name: replace(splats, rgb=_colors(one, pixel)) for name, one in views.items()}


def sky_on_surfaces(views: Sequence[Views]) -> NDArray[np.bool_]:
    """Mask (n, h, w) of pixels with the color of the sky but the depth of a surface, such as gaps in a tree's crown.

    `views` are the same views under each filmed lighting. From other viewpoints, Gaussians of such pixels would look
    like blue clumps, so `views_by_lighting` moves these pixels to the background. The sky's color under each lighting
    is a quadratic function of the direction, fitted to the pixels of the background. A pixel above the horizon is in
    the mask if it differs little from that color (mean square over lightings and channels). Up to `_BLEND_REACH` pixels
    from such a pixel the limit is larger, since pixels there blend the sky's color with that of leaves.
    """
    sky = views[0].depth > FAR
    if np.count_nonzero(sky) < _MIN_SKY:
        return np.zeros(sky.shape, bool)
    rays = np.stack([views[0].points(i, np.ones(sky.shape[1:])) for i in range(len(sky))])
    rays -= views[0].camera_to_world[:, None, None, :3, 3]
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    basis = np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, z * z], -1)
    some = np.flatnonzero(sky)
    some = some[:: max(1, len(some) // _MAX_SKY)]
    error = np.zeros(sky.shape)
    for one in views:
        colors = one.rgb.reshape(-1, 3)[some].astype(np.float64)
        fitted, *_ = np.linalg.lstsq(basis.reshape(-1, 9)[some], colors, rcond=None)
        error += ((one.rgb - basis @ fitted) ** 2).mean(-1)
    error[(z <= 0.0) | sky] = np.inf
    found, blended = (error / len(views) < limit**2 for limit in (_SKY_TOLERANCE, _BLEND_TOLERANCE))
    reach = np.zeros((3, 3, 3), bool)
    reach[1] = True  # within a view
    return ndimage.binary_dilation(found, reach, _BLEND_REACH, mask=blended)


def gaussians_of_views(views: Views, background: float) -> tuple[Gaussians, NDArray[np.int64]]:
    """One Gaussian per pixel, thinned to one per cell; the cells are about as large as the Gaussians.

    Pixels of depth 0 are skipped; depths are limited to `background` [m]. Also returns for each Gaussian the index (k,)
    of its pixel among the n · h · w pixels of the views.

    Raises InputError: no pixel has a depth.
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
        pixel = np.flatnonzero(use) + i * use.size
        columns.append([position, position - camera, normal, width, width / slant, pixel])
    joined = [np.concatenate(column) for column in zip(*columns, strict=True)]
    if not len(joined[0]):
        raise InputError("the field shows no surface in any of the views; build the scene with more nerf.steps")
    keep = select_sharpest(joined[0], joined[3])
    position, rays, normal, width, length, pixel = (column[keep] for column in joined)
    along = rays - (rays * normal).sum(1, keepdims=True) * normal  # long axis: the ray projected onto the surface
    along += 1e-6 * np.cross(normal, [0.3, 0.5, 0.8])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    frame = np.stack([along, np.cross(normal, along), normal], -1)
    quaternion = Rotation.from_matrix(frame).as_quat()[:, [3, 0, 1, 2]]
    scales = np.stack([_DISK * length, _DISK * width, _THICKNESS * width], -1)
    splats = Gaussians(
        position.astype(np.float32),
        quaternion.astype(np.float32),
        scales.astype(np.float32),
        _colors(views, pixel),
        np.full(len(pixel), _OPACITY, np.float32),
    )
    return splats, pixel


def _colors(views: Views, pixel: NDArray[np.int64]) -> NDArray[np.float32]:
    return views.rgb.reshape(-1, 3)[pixel].astype(np.float32) / np.float32(255.0)


def _surface_normals(points: Array) -> Array:
    """Unit normals (h, w, 3) of a grid of points, from the differences to the nearer neighbor along each grid axis."""

    def difference(axis: int) -> Array:
        step = np.diff(points, axis=axis)
        ahead = np.concatenate([step, np.take(step, [-1], axis)], axis)
        behind = np.concatenate([np.take(step, [0], axis), step], axis)
        nearer = np.linalg.norm(ahead, axis=-1) < np.linalg.norm(behind, axis=-1)
        return np.where(nearer[..., None], ahead, behind)

    normal = np.cross(difference(1), difference(0))
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def select_sharpest(points: Array, width: Array) -> NDArray[np.int64]:
    """Indices of the points to keep, given their positions (k, 3) [m] and widths (k,) [m].

    The side of a point's cell is its width, rounded up to `_MIN_CELL` times a power of two. Cells are filled from the
    smallest size up. Each keeps its point of smallest width, unless it contains a point kept at a smaller cell size.
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
