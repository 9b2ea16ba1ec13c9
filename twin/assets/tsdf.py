"""Fusion of depth maps into a truncated signed distance field (TSDF), and triangle meshes from it by marching cubes.

*Signed distance* [m]: positive in free space, negative behind a surface, valid within ± `band` of it. At each voxel a
view votes `near` if the surface that it sees is within ± `band`, and `free` if it sees farther. This is the method of
Curless & Levoy 1996, eqs. 3 and 4, with votes for free space added. So the many views through a *floater*, a false
surface in the air, outvote the few that show it. At a depth edge the radiance field has a false, slanted surface
between the near and the far surface. The view sees it edge-on, so the view's `near` votes have little weight, and views
from elsewhere outvote them.
"""

# mypy: disable-error-code="index, attr-defined"
# (mypy does not know Warp's types inside kernels)

from collections.abc import Callable
from dataclasses import dataclass

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from twin.assets.views import Views
from twin.geometry.poses import inverse_pose
from twin.types import Array
from twin.warp_runtime import wp

FREE_SPACE_REACH = 2.5  # free votes reach this many times as far as surface votes
_HALF_WEIGHT_DEPTH = 5.0  # [m] a vote at this depth has half weight, since pixels and errors grow with depth
_CLEARANCE = 0.1  # beyond `far`, a view votes `free` only if (surface depth / voxel depth − 1) exceeds this
_SAME_SURFACE_RATIO = 1.1  # largest depth ratio of neighboring pixels on one surface


@wp.func
def _project(point: wp.vec3, pose: wp.mat44, k: wp.vec4):
    """Vector of the pixel (u, v) and the z-depth of a world point."""
    local = wp.transform_point(pose, point)
    z = wp.max(local[2], 1.0e-6)
    return wp.vec3(k[0] * local[0] / z + k[2], k[1] * local[1] / z + k[3], local[2])


@wp.kernel
def _fuse_kernel(
    points: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
    chosen: wp.array[wp.int32],
    slant: wp.array3d[wp.float32],
    far: float,
    band: float,
    reach: float,
    fade: float,
    clearance: float,
    one_surface: float,
    distance: wp.array[wp.float32],
    near: wp.array[wp.float32],
    free: wp.array[wp.float32],
):
    i = wp.tid()
    point = points[i]
    height = depth.shape[1]
    width = depth.shape[2]
    total = float(0.0)
    near_votes = float(0.0)
    free_votes = float(0.0)
    for k in range(chosen.shape[0]):
        view = chosen[k]
        seen = _project(point, world_to_camera[view], intrinsics[view])
        z = seen[2]
        if z > 0.35 and z < reach:
            u = seen[0] - 0.5
            v = seen[1] - 0.5
            if u >= 0.0 and v >= 0.0 and u < float(width - 1) and v < float(height - 1):
                column = int(u)
                row = int(v)
                nearest_row = int(v + 0.5)
                nearest_column = int(u + 0.5)
                a = depth[view, row, column]
                b = depth[view, row, column + 1]
                c = depth[view, row + 1, column]
                d = depth[view, row + 1, column + 1]
                low = wp.min(wp.min(a, b), wp.min(c, d))
                high = wp.max(wp.max(a, b), wp.max(c, d))
                surface = depth[view, nearest_row, nearest_column]
                if low > 0.0 and high < one_surface * low:
                    # The four pixels show one surface, on which inverse depth is bilinear.
                    s = u - float(column)
                    t = v - float(row)
                    surface = 1.0 / ((1.0 - t) * ((1.0 - s) / a + s / b) + t * ((1.0 - s) / c + s / d))
                if surface > 0.0:
                    away = (surface - z) * slant[view, nearest_row, nearest_column]
                    weight = 1.0 / (1.0 + (z / fade) * (z / fade))
                    if away >= band and (z < far or surface - z > clearance * z):
                        free_votes += weight
                    elif away < band and away > -band and z < far:
                        lean = wp.min(slant[view, nearest_row, nearest_column], 1.0)
                        weight *= lean * lean
                        near_votes += weight
                        total += weight * away
    near[i] = near_votes
    free[i] = free_votes
    if near_votes > 0.0:
        distance[i] = (total + band * free_votes) / (near_votes + free_votes)


@wp.kernel
def _color_kernel(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    centers: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
    chosen: wp.array[wp.int32],
    rgb: wp.array4d[wp.uint8],
    tolerance: float,
    colors: wp.array[wp.vec3],
    found: wp.array[wp.float32],
):
    i = wp.tid()
    point = points[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    weights = float(0.0)
    for k in range(chosen.shape[0]):
        view = chosen[k]
        seen = _project(point, world_to_camera[view], intrinsics[view])
        z = seen[2]
        # Only surfaces that face the lens get a color. A limit of 0.1 (6°) keeps walls beside a forward-looking camera.
        if z > 0.35 and wp.dot(normals[i], wp.normalize(centers[view] - point)) > 0.1:
            column = int(wp.floor(seen[0]))
            row = int(wp.floor(seen[1]))
            if column >= 0 and row >= 0 and column < depth.shape[2] and row < depth.shape[1]:
                surface = depth[view, row, column]
                if surface > 0.0 and wp.abs(surface - z) < tolerance + 0.05 * z:
                    # The nearest views are the sharpest; the fourth power makes a few of them dominate.
                    weight = 1.0 / (z * z * z * z)
                    pixel = wp.vec3(
                        float(rgb[view, row, column, 0]),
                        float(rgb[view, row, column, 1]),
                        float(rgb[view, row, column, 2]),
                    )
                    total += weight * pixel
                    weights += weight
    if weights > 0.0:
        colors[i] = total / weights
        found[i] = 1.0


def fuse(points: Array, views: Views, band: float, far: float) -> tuple[NDArray, NDArray, NDArray]:
    """Fuses all views at points (k, 3). Returns signed distances [m], `near` votes and `free` votes, each (k,).

    A distance is NaN if there are no `near` votes. Views vote for surfaces up to the depth `far` [m], and for free
    space up to `FREE_SPACE_REACH` times as far.
    """
    distance = np.full(len(points), np.nan, np.float32)
    near, free = (np.zeros(len(points), np.float32) for _ in range(2))
    reach = FREE_SPACE_REACH * far
    constants = [far, band, reach, _HALF_WEIGHT_DEPTH, _CLEARANCE, _SAME_SURFACE_RATIO]
    with wp.ScopedDevice("cpu"):
        cameras = _camera_arrays(views)
        slant: wp.array = wp.array(views.slant, dtype=wp.float32)
        for index, chosen in _groups(points, views, reach):
            found = wp.full(len(index), float("nan"), dtype=wp.float32)
            votes = [wp.zeros(len(index), dtype=wp.float32) for _ in range(2)]
            inputs = [_vectors(points[index]), *cameras, wp.array(chosen, dtype=wp.int32), slant, *constants]
            wp.launch(_fuse_kernel, len(index), inputs, [found, *votes])
            distance[index], near[index], free[index] = (values.numpy() for values in (found, *votes))
    return distance, near, free


def color_points(
    points: Array, normals: Array, views: Views, tolerance: float, reach: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Returns colors (k, 3) of surface points (k, 3) with normals (k, 3), and a mask (k,) of the points that views see.

    The nearest views dominate a color. A view sees a point if the point faces it and the view's depth there differs by
    less than `tolerance` [m] plus 5 % from the point's depth, which is at most `reach` [m].
    """
    colors = np.zeros((len(points), 3), np.float32)
    seen = np.zeros(len(points), bool)
    with wp.ScopedDevice("cpu"):
        cameras = _camera_arrays(views)
        rgb: wp.array = wp.array(views.rgb, dtype=wp.uint8)
        centers = _vectors(views.camera_to_world[:, :3, 3])
        for index, chosen in _groups(points, views, reach):
            mean, found = wp.zeros(len(index), dtype=wp.vec3), wp.zeros(len(index), dtype=wp.float32)
            where = _vectors(points[index]), _vectors(normals[index])
            inputs = [*where, centers, *cameras, wp.array(chosen, dtype=wp.int32), rgb, tolerance]
            wp.launch(_color_kernel, len(index), inputs, [mean, found])
            colors[index], seen[index] = mean.numpy(), found.numpy() > 0
    return (colors + 0.5).astype(np.uint8), seen


def _camera_arrays(views: Views) -> list[wp.array]:
    return [
        wp.array(inverse_pose(views.camera_to_world).astype(np.float32), dtype=wp.mat44),
        wp.array(views.intrinsics.astype(np.float32), dtype=wp.vec4),
        wp.array(views.depth, dtype=wp.float32),
    ]


def _vectors(points: Array) -> wp.array:
    return wp.array(np.asarray(points, np.float32), dtype=wp.vec3)


# ---- views of a group of points

_GROUP_SIDE = 8.0  # [m] side of the square columns that divide points into groups
_PIXEL_SLACK = 2.0  # [px] width of a frame around the image in which points still count as seen


def _groups(points: Array, views: Views, reach: float) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Divides points (k, 3) into groups. Returns for each the indices of its points and of the views that may see any.

    Views far away would only cost time: on a long road, almost all views are far from any point.
    """
    if len(points) == 0:
        return []
    column = np.floor(points[:, :2] / _GROUP_SIDE).astype(np.int64)
    order = np.lexsort(column.T)
    starts = np.flatnonzero((np.diff(column[order], axis=0) != 0).any(1)) + 1
    groups = np.split(order, starts)
    return [(index, views_of_box(views, points[index].min(0), points[index].max(0), reach)) for index in groups]


def views_of_box(views: Views, low: Array, high: Array, reach: float) -> NDArray[np.int64]:
    """Indices in order of the views that may see a point of a box up to the depth `reach` [m]; `low`, `high` (3,)."""
    corners = np.stack(np.meshgrid(*np.stack([low, high], 1), indexing="ij"), -1).reshape(-1, 3)
    world_to_camera = inverse_pose(views.camera_to_world)
    x, y, z = np.moveaxis(
        corners @ np.swapaxes(world_to_camera[:, :3, :3], 1, 2) + world_to_camera[:, None, :3, 3], 2, 0
    )
    height, width = views.depth.shape[1:]
    fx, fy, cx, cy = views.intrinsics.T[..., None]
    # A box is outside the view's frustum if all its corners are outside one plane of it. For z < 0, u and v have the
    # opposite signs, but these points are behind the lens and outside anyway.
    left, right = fx * x + (cx + _PIXEL_SLACK) * z < 0, fx * x + (cx - width - _PIXEL_SLACK) * z > 0
    above, below = fy * y + (cy + _PIXEL_SLACK) * z < 0, fy * y + (cy - height - _PIXEL_SLACK) * z > 0
    outside = [one.all(1) for one in (z < 0, z > 1.001 * reach, left, right, above, below)]
    return np.flatnonzero(~np.any(outside, axis=0))


# ---- volumes

BLOCK = 4  # [voxels] side of the blocks that are fused or left out as a whole
BAND_VOXELS = 2.0  # [voxels] half width of the band around a surface
_MAX_VOXELS = 40_000_000  # a place with more voxels is divided into sections
_SECTION_SIDE = 256  # [voxels] side of a section, a multiple of `BLOCK`
_FREE_MAJORITY = 0.75  # a surface is removed if a larger fraction of votes is `free`


@dataclass(frozen=True)
class VolumeSection:
    """A box of voxels, part of the lattice of a place. Indices are those of lattice points along x, y, z.

    A section is processed with a frame of voxels around it, so that filters give the same values at its border as in
    the sections beside it.
    """

    start: NDArray[np.int64]  # first voxel with frame, shape (3,)
    shape: NDArray[np.int64]  # number of voxels with frame, shape (3,)
    low: NDArray[np.int64]  # first voxel without frame, shape (3,)
    high: NDArray[np.int64]  # first voxel after the section without frame, shape (3,)
    place: NDArray[np.int64]  # number of voxels of the lattice, shape (3,)

    @property
    def inner(self) -> tuple[slice, slice, slice]:
        """Slices of the section without frame in an array with frame."""
        x, y, z = (slice(int(a), int(b)) for a, b in zip(self.low - self.start, self.high - self.start, strict=True))
        return x, y, z


def divide(
    box: Array, voxel: float, frame: int, heights: Callable[[Array, Array], tuple[float, float]]
) -> list[VolumeSection]:
    """Sections of a place: one if it has at most 40 million voxels, otherwise square columns of 256 voxels' side.

    The lattice has its voxel (0, 0, 0) at the low corner of `box` (2, 3) [m] and the spacing `voxel` [m]; frames have
    at least `frame` voxels. `heights` returns the lowest and highest z [m] of interest between two corners (x, y) [m].
    """
    blocks = np.ceil((box[1] - box[0]) / (voxel * BLOCK)).astype(np.int64) + 1
    whole = blocks * BLOCK
    if np.prod(whole) <= _MAX_VOXELS:
        return [VolumeSection(np.zeros(3, np.int64), whole, np.zeros(3, np.int64), whole, whole)]
    frame = -(-frame // BLOCK) * BLOCK
    sections = []
    for x in range(0, int(whole[0]), _SECTION_SIDE):
        for y in range(0, int(whole[1]), _SECTION_SIDE):
            low = np.array([x, y])
            high = np.minimum(low + _SECTION_SIDE, whole[:2])
            start, end = np.maximum(low - frame, 0), np.minimum(high + frame, whole[:2])
            z = np.array(heights(box[0, :2] + voxel * start, box[0, :2] + voxel * end)) - box[0, 2]
            bottom, top = np.clip(np.floor(z / (voxel * BLOCK)) + np.array([0, 2]), 0, blocks[2]).astype(int) * BLOCK
            first, last = np.append(start, bottom), np.append(end, top)
            sections.append(VolumeSection(first, last - first, np.append(low, bottom), np.append(high, top), whole))
    return sections


@dataclass(frozen=True)
class Volume:
    """Grid of signed distances in a section; voxel (i, j, k) is at origin + voxel · (i, j, k) [m]."""

    distance: NDArray[np.float32]
    """Signed distances [m], shape (x, y, z); NaN where no surface is near or no view votes."""
    hidden: NDArray[np.bool_]  # mask of the voxels near a surface that got no votes; they may be solid
    origin: Array  # position of voxel (0, 0, 0) [m], shape (3,)
    voxel: float  # grid spacing [m]
    section: VolumeSection
    outvoted: int  # number of voxels of the section without frame at which free votes removed a surface


def fuse_volume(hits: Array, views: Views, corner: Array, voxel: float, section: VolumeSection, far: float) -> Volume:
    """Fuses views at the voxels of a section, only in blocks of 4³ voxels near the surface points `hits` (k, 3).

    `corner` is the position of the lattice's voxel (0, 0, 0), shape (3,) [m], and `voxel` its spacing [m]. For `far`
    see `fuse`.
    """
    active = np.zeros(section.shape // BLOCK, bool)
    index = np.floor((hits - corner) / (voxel * BLOCK)).astype(int) - section.start // BLOCK
    index = index[((index >= 0) & (index < active.shape)).all(1)]
    active[tuple(index.T)] = True
    active = binary_dilation(active, np.ones((3, 3, 3), bool))
    distance = np.full(section.shape, np.nan, np.float32)
    hidden = np.zeros(distance.shape, bool)
    inner = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    voxels = (np.argwhere(active)[:, None] * BLOCK + inner).reshape(-1, 3)
    band = BAND_VOXELS * voxel
    value, near, free = fuse(corner + voxel * (section.start + voxels), views, band, far)
    through = (near > 0) & (free > _FREE_MAJORITY * (near + free))
    counted = ((section.start + voxels >= section.low) & (section.start + voxels < section.high)).all(1)
    outvoted = int((counted & through & (value < band)).sum())
    value = np.where(through, np.fmax(value, 0.5 * voxel), value)
    # If all votes at a voxel are `free`, it is outside every surface.
    value = np.where((near == 0) & (free > 0), band, value)
    distance[tuple(voxels.T)] = value
    hidden[tuple(voxels.T)] = (near == 0) & (free == 0)
    return Volume(distance, hidden, corner + voxel * section.start, voxel, section, outvoted)


# ---- triangle meshes: vertices (v, 3) [m] and faces (f, 3)

_SAME_VERTEX = 1e-3  # [voxels] vertices of two sections that are nearer than this are the same vertex


def zero_level(distance: NDArray, origin: Array, voxel: float) -> tuple[Array, NDArray[np.int64]]:
    """Marching cubes of a distance field (NaN = unknown): vertices (v, 3) [m], and faces (f, 3) towards free space."""
    if not ((distance < 0).any() and (distance > 0).any()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent", allow_degenerate=False)
    # A vertex on an edge with an unseen end is NaN; its triangles are dropped.
    faces = faces[np.isfinite(vertices).all(1)[faces].all(1)]
    return compact(origin + voxel * vertices.astype(np.float64), faces.astype(np.int64))


def section_surface(volume: Volume) -> tuple[Array, NDArray[np.int64]]:
    """Zero level of a section without frame; at the border, its vertices are also those of the section beside it."""
    # The section includes the cells between its last voxels and the next section's first voxels.
    x, y, z = volume.section.inner
    inner = slice(x.start, x.stop + 1), slice(y.start, y.stop + 1), z
    origin = volume.origin + volume.voxel * (volume.section.low - volume.section.start)
    return zero_level(volume.distance[inner], origin, volume.voxel)


def join_surfaces(
    surfaces: list[tuple[Array, NDArray[np.int64]]], corner: Array, voxel: float
) -> tuple[Array, NDArray[np.int64]]:
    """Joins the surfaces of the sections of a place to one mesh, without duplicates of the vertices at borders."""
    if len(surfaces) <= 1:
        return surfaces[0] if surfaces else (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    vertices = np.concatenate([vertices for vertices, _ in surfaces])
    faces = np.concatenate([faces + start for (_, faces), start in zip(surfaces, starts, strict=False)])
    at = (vertices[:, :2] - corner[:2]) / (voxel * _SECTION_SIDE)
    border = np.flatnonzero((np.abs(at - np.rint(at)) * _SECTION_SIDE < _SAME_VERTEX).any(1))
    pairs = border[cKDTree(vertices[border]).query_pairs(_SAME_VERTEX * voxel, output_type="ndarray")]
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(vertices),) * 2)
    vertex = connected_components(graph, directed=False)[1]
    first = np.unique(vertex, return_index=True)[1]
    faces = vertex[faces].astype(np.int64)
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    return vertices[first], faces[whole]


def compact(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray[np.int64]]:
    """Removes the vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int64)


def remove_specks(vertices: Array, faces: NDArray, min_area: float) -> tuple[Array, NDArray[np.int64], int]:
    """Removes connected components smaller than `min_area` [m²]; also returns the number of removed components."""
    if len(faces) == 0:
        return vertices, faces, 0
    start, end = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    edges = coo_array((np.ones(len(start), bool), (start, end)), shape=(len(vertices),) * 2)
    component = connected_components(edges, directed=False)[1][faces[:, 0]]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.bincount(component, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    small = (np.bincount(component) > 0) & (area < min_area)
    return *compact(vertices, faces[~small[component]]), int(small.sum())


def decimate(vertices: Array, faces: NDArray, max_faces: int) -> tuple[Array, NDArray[np.int64]]:
    """Simplifies a mesh to about `max_faces` by quadric edge collapse (Garland & Heckbert 1997)."""
    if len(faces) <= max_faces:
        return vertices, faces
    reduced_vertices, reduced_faces = fast_simplification.simplify(
        vertices.astype(np.float32), faces.astype(np.int32), target_count=max_faces, agg=5.0
    )
    return compact(reduced_vertices.astype(np.float64), reduced_faces.astype(np.int64))


def vertex_normals(vertices: Array, faces: NDArray) -> Array:
    """Unit normals (v, 3) of the vertices: means of their faces' normals, weighted by face area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    out = np.stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 3), len(vertices)) for k in range(3)], -1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
