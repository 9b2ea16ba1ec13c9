"""Depth maps into a truncated signed distance field, and colours on to points: the loops over voxels × views.

*Signed distance* [m] is positive in free space, negative behind a surface, and believed within ± `band` of it only.
Each view votes at each voxel: `near` where its surface passes within the band, `free` where it looks further. A surface
that few views make and many look through is a floater, and their votes outweigh it (Curless & Levoy 1996, eqs. 3 and 4,
with free space counted in). The ramp that a field leaves between the rim of a thing and what is behind it is seen
edge-on, where votes count next to nothing; so views that look past it from elsewhere, even from far away, clear it.
"""

# mypy: disable-error-code="index, attr-defined"
# (inside kernels, Warp's own types hold, which mypy does not know)

from dataclasses import dataclass

import fast_simplification
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from twin.assets.ground import Ground
from twin.assets.views import Views
from twin.geometry.poses import inverse_pose
from twin.types import Array

wp.config.log_level = wp.LOG_ERROR  # compiling is announced by our own bars


LOOK_THROUGH = 2.5  # a view says what is free this many times further than it says where a surface is
_FADE = 5.0  # [m] depth at which a view's vote counts half: its pixels and its errors have grown
_CLEARANCE = 0.1  # share of the depth a surface beyond that reach must lie behind what it is to leave free
_ONE_SURFACE = 1.1  # neighbouring pixels whose depths differ by more than this ratio belong to two


@wp.func
def _look(point: wp.vec3, pose: wp.mat44, k: wp.vec4):
    """Pixel (u, v) and depth of a world point."""
    local = wp.transform_point(pose, point)
    z = wp.max(local[2], 1.0e-6)
    return wp.vec3(k[0] * local[0] / z + k[2], k[1] * local[1] / z + k[3], local[2])


@wp.kernel
def _fuse(
    points: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
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
    for view in range(depth.shape[0]):
        seen = _look(point, world_to_camera[view], intrinsics[view])
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
                    # One surface: inverse depth is bilinear on it.
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
def _colour(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    eyes: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
    rgb: wp.array4d[wp.uint8],
    tolerance: float,
    colours: wp.array[wp.vec3],
    found: wp.array[wp.float32],
):
    i = wp.tid()
    point = points[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    weights = float(0.0)
    for view in range(depth.shape[0]):
        seen = _look(point, world_to_camera[view], intrinsics[view])
        z = seen[2]
        # Only what faces the lens is seen; 0.1 (6°) keeps the walls beside a forward-looking camera.
        if z > 0.35 and wp.dot(normals[i], wp.normalize(eyes[view] - point)) > 0.1:
            column = int(wp.floor(seen[0]))
            row = int(wp.floor(seen[1]))
            if column >= 0 and row >= 0 and column < depth.shape[2] and row < depth.shape[1]:
                surface = depth[view, row, column]
                if surface > 0.0 and wp.abs(surface - z) < tolerance + 0.05 * z:
                    # Sharpest where nearest: the fourth power lets the few nearest views decide.
                    weight = 1.0 / (z * z * z * z)
                    pixel = wp.vec3(
                        float(rgb[view, row, column, 0]),
                        float(rgb[view, row, column, 1]),
                        float(rgb[view, row, column, 2]),
                    )
                    total += weight * pixel
                    weights += weight
    if weights > 0.0:
        colours[i] = total / weights
        found[i] = 1.0


def fuse(points: Array, views: Views, band: float, far: float) -> tuple[NDArray, NDArray, NDArray]:
    """Votes of all views at points (k, 3), each (k,): signed distance [m] (NaN where no surface is), near and free.

    Surfaces are believed up to the depth `far` [m], free space up to `LOOK_THROUGH` times as far.
    """
    device = "cpu"
    distance = wp.full(len(points), float("nan"), dtype=wp.float32, device=device)
    near = wp.zeros(len(points), dtype=wp.float32, device=device)
    free = wp.zeros(len(points), dtype=wp.float32, device=device)
    slant: wp.array = wp.array(views.slant, dtype=wp.float32, device=device)
    inputs = [*_cameras(points, views, device), slant, far, band, LOOK_THROUGH * far, _FADE, _CLEARANCE, _ONE_SURFACE]
    wp.launch(_fuse, len(points), inputs, [distance, near, free], device=device)
    return distance.numpy(), near.numpy(), free.numpy()


def colour(
    points: Array, normals: Array, views: Views, tolerance: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (k, 3) of surface points (k, 3) with normals (k, 3) from the nearest views, and whether any sees it (k,).

    A view sees a point that faces it and lies within `tolerance` [m] and 5 % of its depth.
    """
    device = "cpu"
    colours = wp.zeros(len(points), dtype=wp.vec3, device=device)
    found = wp.zeros(len(points), dtype=wp.float32, device=device)
    rgb: wp.array = wp.array(views.rgb, dtype=wp.uint8, device=device)
    where, *cameras = _cameras(points, views, device)
    turned: wp.array = wp.array(np.asarray(normals, np.float32), dtype=wp.vec3, device=device)
    eyes: wp.array = wp.array(views.camera_to_world[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    inputs = [where, turned, eyes, *cameras, rgb, tolerance]
    wp.launch(_colour, len(points), inputs, [colours, found], device=device)
    return (colours.numpy() + 0.5).astype(np.uint8), found.numpy() > 0


def _cameras(points: Array, views: Views, device: str) -> list[wp.array]:
    return [
        wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device),
        wp.array(inverse_pose(views.camera_to_world).astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(views.intrinsics.astype(np.float32), dtype=wp.vec4, device=device),
        wp.array(views.depth, dtype=wp.float32, device=device),
    ]


# ---- From rendered depth to surfaces: a block-sparse distance field around what the views hit, and its zero level.
#
# The *volume* is a regular grid of voxels over a box; only voxels in *blocks* (4³) near a hit are computed, all others
# are unseen (NaN). What stands less than a threshold above the ground is left to the height field. The *solid* is the
# part behind the surface, as thick as the band, that convex parts are made of; the *surface* is the seen side.


_BLOCK = 4  # voxels
_MOST_VOXELS = 60_000_000
_BAND = 2.0  # voxels on either side of the surface
_CHUNK = 400_000  # voxels per launch
_FREE_SHARE = 0.75  # of the votes: what so many look through is not there


@dataclass(frozen=True)
class Volume:
    """Signed distance [m] at origin + voxel · (i, j, k); NaN = no surface near, or unseen."""

    distance: NDArray[np.float32]
    hidden: NDArray[np.bool_]
    """Near a surface, and neither seen as matter nor looked through by any view: may be solid."""
    origin: Array
    voxel: float
    seen_through: int
    """Voxels some view took for matter and the others outvoted."""

    @property
    def band(self) -> float:
        return _BAND * self.voxel

    def points(self, index: NDArray) -> Array:
        return self.origin + self.voxel * np.asarray(index)


def fuse_volume(hits: Array, views: Views, box: Array, voxel: float, far: float) -> Volume:
    """Distance field around hit points.

    Args:
        hits: World points on surfaces, shape (k, 3) [m].
        views: The views they come from.
        box: Low and high corner, shape (2, 3) [m].
        voxel: Grid spacing [m]; grows where the box would hold more than 60 million.
        far: Depth up to which a view votes for a surface [m].
    """
    voxel = max(voxel, float((np.prod(box[1] - box[0]) / _MOST_VOXELS) ** (1 / 3)))
    blocks = np.ceil((box[1] - box[0]) / (voxel * _BLOCK)).astype(int) + 1
    active = np.zeros(blocks, bool)
    index = np.floor((hits - box[0]) / (voxel * _BLOCK)).astype(int)
    index = index[((index >= 0) & (index < blocks)).all(1)]
    active[tuple(index.T)] = True
    active = binary_dilation(active, np.ones((3, 3, 3), bool))
    distance = np.full(blocks * _BLOCK, np.nan, np.float32)
    inner = np.stack(np.meshgrid(*[np.arange(_BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    voxels = (np.argwhere(active)[:, None] * _BLOCK + inner).reshape(-1, 3)
    hidden = np.zeros(distance.shape, bool)
    outvoted = 0
    for start in range(0, len(voxels), _CHUNK):
        part = voxels[start : start + _CHUNK]
        value, near, free = fuse(box[0] + voxel * part, views, _BAND * voxel, far)
        through = (near > 0) & (free > _FREE_SHARE * (near + free))
        outvoted += int((through & (value < _BAND * voxel)).sum())
        # Air that everyone looks through bounds a surface as well as a distance does.
        value = np.where(through | ((near == 0) & (free > 0)), np.fmax(value, 0.5 * voxel), value)
        value = np.where((near == 0) & (free > 0), _BAND * voxel, value)
        distance[tuple(part.T)] = value
        hidden[tuple(part.T)] = (near == 0) & (free == 0)
    return Volume(distance, hidden, np.asarray(box[0], float), voxel, outvoted)


def zero_level(distance: NDArray, origin: Array, voxel: float) -> tuple[Array, NDArray[np.int64]]:
    """Marching cubes of a distance field, NaN = unseen: vertices (v, 3) [m], faces (f, 3) facing free space."""
    if not ((distance < 0).any() and (distance > 0).any()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent", allow_degenerate=False)
    # An edge with an unseen end has no crossing (NaN); nor have the triangles on it.
    faces = faces[np.isfinite(vertices).all(1)[faces].all(1)]
    return compact(origin + voxel * vertices.astype(np.float64), faces.astype(np.int64))


def compact(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray[np.int64]]:
    """Drops vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int64)


def face_components(faces: NDArray, count: int) -> NDArray[np.int64]:
    """Number of the connected piece each face belongs to, shape (f,)."""
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(count, count))
    return connected_components(graph, directed=False)[1][faces[:, 0]]


def face_areas(vertices: Array, faces: NDArray) -> Array:
    """Shape (f,) [m²]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def without_specks(vertices: Array, faces: NDArray, min_area: float) -> tuple[Array, NDArray[np.int64], int]:
    """Removes pieces of less than `min_area` [m²]; returns how many there were, too."""
    if len(faces) == 0:
        return vertices, faces, 0
    piece = face_components(faces, len(vertices))
    area = np.bincount(piece, face_areas(vertices, faces))
    present = np.bincount(piece) > 0
    small = present & (area < min_area)
    return *compact(vertices, faces[~small[piece]]), int(small.sum())


def decimate(vertices: Array, faces: NDArray, most: int) -> tuple[Array, NDArray[np.int64]]:
    """At most about `most` faces, by quadric edge collapse (Garland & Heckbert 1997)."""
    if len(faces) <= most:
        return vertices, faces
    less, kept = fast_simplification.simplify(
        vertices.astype(np.float32), faces.astype(np.int32), target_count=most, agg=5.0
    )
    return compact(less.astype(np.float64), kept.astype(np.int64))


def vertex_normals(vertices: Array, faces: NDArray) -> Array:
    """Area-weighted unit normals (v, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    out = np.stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 3), len(vertices)) for k in range(3)], -1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def height_mesh(ground: Ground, cell: float, most: int) -> tuple[Array, NDArray[np.int64]]:
    """The ground as triangles facing up, on every n-th node: they are `cell` or more wide and `most` or fewer."""
    rows, columns = ground.height.shape
    step = max(1, round(cell / ground.cell), int(np.ceil(np.sqrt(2 * rows * columns / most))))
    row, column = (np.unique(np.append(np.arange(0, n, step), n - 1)) for n in (rows, columns))
    grid_c, grid_r = np.meshgrid(column, row)
    xy = ground.origin + ground.cell * np.stack([grid_c, grid_r], -1)
    vertices = np.concatenate([xy, ground.height[grid_r, grid_c][..., None]], -1).reshape(-1, 3)
    node = np.arange(len(vertices)).reshape(grid_r.shape)
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices, faces.astype(np.int64)
