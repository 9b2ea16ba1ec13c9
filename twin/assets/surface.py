"""From rendered depth to surfaces: a block-sparse distance field around what the views hit, and its zero level.

The *volume* is a regular grid of voxels over a box; only voxels in *blocks* (4³) near a hit are computed, all others
are unseen (NaN). What stands less than a threshold above the ground is left to the height field. The *solid* is the
part behind the surface, as thick as the band, that convex parts are made of; the *surface* is the seen side.
"""

from dataclasses import dataclass

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from twin.assets.fusion import fuse
from twin.assets.ground import Ground
from twin.assets.views import Views

Array = NDArray[np.float64]

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
