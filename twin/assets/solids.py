"""Closed meshes of the obstacles for the convex decomposition, and the corridor that is kept free of them.

The solid consists of the negative part of the distance field (`tsdf.py`) and of the hidden space up to `_HIDDEN_DEPTH`
behind it. (A film from a road shows only the fronts of obstacles, but collision needs walls with thickness.) The
corridor is the space up to `Corridor.reach` beside the route and up to `HEADROOM` above the ground. The camera passed
through it, so it is free.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from twin.assets.convex import ConvexPart, SolidPiece
from twin.assets.ground import Ground
from twin.assets.tsdf import BLOCK, Volume, zero_level
from twin.config import MeshConfig
from twin.geometry.passes import SPACING
from twin.geometry.route import distance_to_route, every_second
from twin.nerf.poles import Poles
from twin.types import Array

HEADROOM = 1.5  # [m] height of the corridor above the ground
_GROUND_CLEARANCE = 0.1  # [m] points less than this above the height field belong to the ground
_MAX_GROUND_GAP = 0.6  # [m] smaller gaps to the ground are closed, so that nothing hovers
_EMBEDDING = 0.15  # [m] depth to which parts extend below the ground
_TILE_SIZE = 3.0  # [m] large obstacles are divided into square columns with this side
_MIN_VOXELS = 8  # smaller connected components of the solid are noise
_MIN_HOVERING_VOXELS = 64  # smaller components are noise if they hover
_HIDDEN_DEPTH = 0.3  # [m] hidden space is solid up to this distance behind a surface
_MAX_GAP = 0.45  # [m] narrower gaps in the solid are closed
_SMOOTHING = 0.7  # [voxels] σ of the low-pass of the distance field
_EROSION = 0.06  # [m] inward offset of surfaces: blur moves edges outwards, and convex hulls add volume
_CERTAIN_DEPTH = 0.02  # [m] voxels deeper than this behind a seen surface are never eroded
_PRISM_SIDES = 8  # number of sides of a pole's collision shape
_CORRIDOR_SLACK = 0.02  # [m] added to the corridor's half width, against rounding in later stages


@dataclass(frozen=True)
class Corridor:
    """Free space along the route and its branches."""

    lines: tuple[Array, ...]  # polylines [m], each of shape (m, 2)
    reach: float  # half width of the corridor plus its margin [m]

    @property
    def points(self) -> Array:
        """Points of all lines [m], shape (n, 2)."""
        return np.concatenate(self.lines)

    def distance(self, xy: Array, limit: float) -> Array:
        """Distance [m] of points (..., 2) from the nearest line, see `distance_to_route`; shape (...)."""
        return np.min([distance_to_route(every_second(line), xy, limit) for line in self.lines], 0)


@dataclass(frozen=True)
class SolidVoxels:
    """Voxels of the solid and their neighbors. Voxel (i, j, k) is at corner + voxel · (i, j, k)."""

    index: NDArray[np.int64]  # i, j, k in the lattice of the place, shape (n, 3)
    field: NDArray[np.float32]  # distance from the solid's surface [m], negative in it, shape (n,)
    above: NDArray[np.float32]  # height above the ground [m], shape (n,)

    @cached_property
    def key(self) -> NDArray[np.int64]:
        """Numbers of the voxels, see `_keys`; ascending after `join`."""
        return _keys(self.index)

    @staticmethod
    def join(parts: list["SolidVoxels"]) -> "SolidVoxels":
        """The voxels of all parts, in the order of their indices."""
        empty = SolidVoxels(np.zeros((0, 3), np.int64), np.zeros(0, np.float32), np.zeros(0, np.float32))
        names = "index", "field", "above"
        index, field, above = (np.concatenate([getattr(part, name) for part in (empty, *parts)]) for name in names)
        order = np.argsort(_keys(index))
        return SolidVoxels(index[order], field[order], above[order])


def frame_width(voxel: float) -> int:
    """Distance [voxels] over which `solid_voxels` depends on the volume around a voxel."""
    filters = 4.0 * (1.0 + _SMOOTHING) + 2.0  # SciPy truncates Gaussian filters at 4 σ; 2 voxels allow for rounding
    return int(np.ceil((_HIDDEN_DEPTH + _MAX_GAP) / voxel + filters)) + 2 * BLOCK


def solid_voxels(
    volume: Volume, ground: Ground, corridor: Corridor | None, path: Array, config: MeshConfig
) -> SolidVoxels:
    """The solid within `config.margin` of a path (m, 2) [m], cleared of the corridor, in one section of the place."""
    voxel, section = volume.voxel, volume.section
    distance = _distance_to_path(volume, path, config.margin)
    if distance is None or not (volume.distance < 0).any():
        return SolidVoxels.join([])
    columns = volume.distance.shape[:2]
    xy = volume.origin[:2] + voxel * np.stack(np.meshgrid(*map(np.arange, columns), indexing="ij"), -1)
    z = volume.origin[2] + voxel * np.arange(volume.distance.shape[2])
    above = (z - ground.at(xy)[..., None]).astype(np.float32)
    field = _solid_distance(volume)
    field[above < _GROUND_CLEARANCE] = 0.5 * voxel
    _close_downwards(field, above, voxel)
    field = np.maximum(field, above - config.max_height)
    field = np.maximum(field, -_EMBEDDING - above)
    field = np.maximum(field, (distance - config.margin)[..., None].astype(np.float32))
    if corridor is not None:
        near = distance < corridor.reach + 2.0
        exact = np.full(distance.shape, np.inf)
        exact[near] = corridor.distance(xy[near], corridor.reach + 2.0 + 2.0 * voxel)
        inside = (corridor.reach + _CORRIDOR_SLACK - exact)[..., None].astype(np.float32)
        field = np.where(above < HEADROOM + voxel, np.maximum(field, inside), field)
    kept = np.zeros(field.shape, bool)
    kept[section.inner] = binary_dilation(field < 0, np.ones((3, 3, 3), bool))[section.inner]
    return SolidVoxels(np.argwhere(kept) + section.start, field[kept], above[kept])


def _distance_to_path(volume: Volume, path: Array, reach: float) -> Array | None:
    """Distance [m] of the section's columns to the path, shape (x, y), exact up to `reach`; None if all are farther."""
    voxel, section = volume.voxel, volume.section
    beyond = int(np.ceil(reach / voxel)) + 1
    corner = volume.origin[:2] - voxel * section.start[:2]
    low = np.maximum(section.start[:2] - beyond, 0)
    high = np.minimum(section.start[:2] + section.shape[:2] + beyond, section.place[:2])
    on_path = np.clip(np.rint((path - corner) / voxel).astype(int), 0, section.place[:2] - 1)
    on_path = on_path[((on_path >= low) & (on_path < high)).all(1)] - low
    if len(on_path) == 0:
        return None
    off_path = np.ones(high - low, bool)
    off_path[tuple(on_path.T)] = False
    x, y = section.start[:2] - low
    distance: Array = distance_transform_edt(off_path) * voxel
    return distance[x : x + section.shape[0], y : y + section.shape[1]]


def solid_pieces(
    voxels: SolidVoxels, corner: Array, voxel: float, path: Array, config: MeshConfig
) -> tuple[list[SolidPiece], dict[str, int]]:
    """Closed meshes of the solid's components that reach `obstacle_height` above the ground, cut into tiles.

    The lattice has its voxel (0, 0, 0) at `corner` (3,) [m] and the spacing `voxel` [m]. `path` (m, 2) [m] is the route
    or the positions of the cameras.

    Returns the pieces, nearest to the path first; and the numbers of components by kind: `standing` ones, of which the
    pieces are made, and `specks` and `low` ones, which are left out.
    """
    solid = np.flatnonzero(voxels.field < 0)
    component = _components(voxels.key[solid])
    count = int(component.max(initial=-1)) + 1
    pieces: list[tuple[float, SolidPiece]] = []
    specks = low = 0
    side = max(4, round(_TILE_SIZE / voxel))
    ends = np.cumsum(np.bincount(component, minlength=1))[:-1]
    for mine in np.split(solid[np.argsort(component, kind="stable")], ends) if count else ():
        index, heights = voxels.index[mine], voxels.above[mine]
        if heights.max() < config.obstacle_height:
            low += 1
            continue
        if len(mine) < (_MIN_VOXELS if heights.min() < _MAX_GROUND_GAP else _MIN_HOVERING_VOXELS):
            specks += 1
            continue
        start, end = index.min(0), index.max(0) + 1
        tile = (index[:, :2] - start[:2]) // side
        order = np.lexsort((tile[:, 1], tile[:, 0]))
        borders = np.flatnonzero((np.diff(tile[order], axis=0) != 0).any(1)) + 1
        for part in np.split(order, borders):
            if len(part) < _MIN_VOXELS // 2:
                continue
            first = start + np.append(tile[part[0]] * side, 0)
            last = np.minimum(first + np.array([side, side, end[2] - start[2]]), end)
            values = _values_around(voxels, index[part], first, last, voxel)
            piece = _block_piece(values, corner, voxel, first)
            if piece is not None:
                middle = ((piece.vertices.min(0) + piece.vertices.max(0)) / 2)[:2]
                pieces.append((float(np.linalg.norm(path - middle, axis=1).min()), piece))
    pieces.sort(key=lambda item: item[0])
    return [piece for _, piece in pieces], {"specks": specks, "low": low, "standing": count - specks - low}


def _components(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """Component of each voxel, given by ascending numbers (n,), see `_keys`. Voxels also touch at edges and corners.

    Components are numbered in the order of their first voxels.
    """
    if len(key) == 0:
        return np.zeros(0, np.int64)
    start, end = [], []
    offsets = np.argwhere(np.ones((3, 3, 3), bool)) - 1
    for step in _keys(offsets[14:]) - _keys(offsets[13:14]):  # 13 of the 26 neighbors, since links are symmetric
        at = np.minimum(np.searchsorted(key, key + step), len(key) - 1)
        found = np.flatnonzero(key[at] == key + step)
        start.append(found)
        end.append(at[found])
    ends = np.concatenate(start), np.concatenate(end)
    graph = coo_array((np.ones(len(ends[0]), bool), ends), shape=(len(key),) * 2)
    labels = connected_components(graph, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    return np.argsort(np.argsort(first))[labels]


def _keys(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number for each voxel (n, 3), in lexical order, shape (n,)."""
    x, y, z = (index + 1).T
    return (x << 42) + (y << 21) + z


def _values_around(
    voxels: SolidVoxels, mine: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64], voxel: float
) -> NDArray[np.float32]:
    """Distance field in the box from `first` to `last` of the lattice; only the voxels `mine` (k, 3) are solid."""
    values = np.full(last - first, 0.5 * voxel, np.float32)
    # The voxels are sorted by x, then y, so those of a row of columns are adjacent.
    key = voxels.key
    for x in range(int(first[0]), int(last[0])):
        ends = _keys(np.array([[x, first[1], first[2]], [x, last[1] - 1, last[2] - 1]]))
        a, b = np.searchsorted(key, ends[0]), np.searchsorted(key, ends[1], "right")
        row = voxels.index[a:b]
        inside = (row[:, 2] >= first[2]) & (row[:, 2] < last[2])
        values[tuple((row[inside] - first).T)] = voxels.field[a:b][inside]
    block = np.zeros(values.shape, bool)
    block[tuple((mine - first).T)] = True
    return np.where(block, values, np.maximum(values, np.float32(0.3 * voxel)))


def _solid_distance(volume: Volume) -> NDArray[np.float32]:
    """Distance field [m] of the solid, eroded: near seen surfaces the fused field, elsewhere the solid's blurred mask.

    Gaps narrower than `_MAX_GAP`, as in foliage and noise, are closed: the robot cannot pass through them, and each
    lengthens the decomposition.
    """
    voxel = volume.voxel
    seen = np.nan_to_num(volume.distance, nan=np.inf) < 0
    depth = distance_transform_edt(~seen) * voxel
    matter = seen | (volume.hidden & (depth < _HIDDEN_DEPTH))
    reach = _MAX_GAP / 2
    outside = distance_transform_edt(~matter) * voxel
    closed = matter | (distance_transform_edt(outside < reach) * voxel > reach)
    smooth = voxel * (0.5 - gaussian_filter(closed.astype(np.float32), 1.0))
    field = np.where(np.isfinite(volume.distance), np.clip(volume.distance, -voxel, voxel), smooth)
    field = np.where(closed & ~seen, np.minimum(field, smooth), field)
    field = gaussian_filter(field, _SMOOTHING) + _EROSION
    # Erosion must not remove obstacles that are as thin as a lamp post.
    return np.where(volume.distance < -_CERTAIN_DEPTH, np.minimum(field, -0.1 * voxel), field).astype(np.float32)


def _close_downwards(field: NDArray, above: NDArray, voxel: float) -> None:
    """Fills the gap between each column's lowest solid voxel and the ground, if it is small. Works in place."""
    matter = field < 0
    lowest = np.where(matter, above, np.inf).min(-1)
    fill = (lowest < _MAX_GROUND_GAP)[..., None] & (above < lowest[..., None]) & (above > -_EMBEDDING - voxel)
    field[fill] = -0.5 * voxel


def _block_piece(values: NDArray, corner: Array, voxel: float, start: NDArray) -> SolidPiece | None:
    """Closed surface of a block of the distance field whose first voxel is `start`; None if the block is empty."""
    padded = np.pad(values, 1, constant_values=0.5 * voxel)
    origin = corner + voxel * (start - 1)
    vertices, faces = zero_level(padded, origin, voxel)
    if len(faces) < 4:
        return None

    def inside(points: Array) -> NDArray[np.bool_]:
        return map_coordinates(padded, ((points - origin) / voxel).T, order=1, mode="nearest") < 0

    return SolidPiece.from_mesh(vertices, faces, inside)


def pole_parts(poles: Poles, corridor: Corridor | None, ground: Ground) -> list[ConvexPart]:
    """A prism around each pole, from below the ground to the pole's top; poles in the corridor are left out."""
    if corridor is not None:
        distance = corridor.distance(poles.foot[:, :2], corridor.reach + 1.0)
        poles = poles.select(np.flatnonzero(distance > corridor.reach + _CORRIDOR_SLACK + poles.radius))
    out = []
    angles = 2.0 * np.pi * np.arange(_PRISM_SIDES) / _PRISM_SIDES
    for foot, radius, height in zip(poles.foot, poles.radius, poles.height, strict=True):
        ring = foot[:2] + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        low = float(ground.at(foot[None, :2])[0]) - _EMBEDDING
        z = np.repeat([low, max(foot[2] + height, low + 2.0 * _EMBEDDING)], _PRISM_SIDES)
        part = ConvexPart.hull(np.column_stack([np.tile(ring, (2, 1)), z]))
        assert part is not None
        out.append(part)
    return out


def clear_corridor(
    parts: list[ConvexPart], corridor: Corridor, ground: Ground
) -> tuple[list[tuple[int, ConvexPart]], int]:
    """Clears the corridor: cuts convex parts at the headroom, and below it along tangents of the corridor.

    Returns the remaining parts, each with the index of its original, and the number of parts that were cut or dropped.
    """
    out: list[tuple[int, ConvexPart]] = []
    clipped = 0
    reach, points = corridor.reach + 0.5 * _CORRIDOR_SLACK, corridor.points
    for i, part in enumerate(parts):
        if _intrusion(part, points, reach, ground)[0] <= 0.0:
            out.append((i, part))
            continue
        clipped += 1
        ceiling = float(ground.at(part.vertices[:, :2]).max()) + HEADROOM + _CORRIDOR_SLACK
        upper = clip_part(part, np.array([0.0, 0.0, -1.0]), -ceiling)
        if upper is not None:
            out.append((i, upper))
        lower: ConvexPart | None = clip_part(part, np.array([0.0, 0.0, 1.0]), ceiling)
        for _ in range(len(points) + 1):  # each cut clears the part of one more point
            if lower is None:
                break
            depth, point, side = _intrusion(lower, points, reach, ground)
            if depth <= 0.0:
                out.append((i, lower))
                break
            # Keep the portion beyond the tangent line, on the side where most of the part is.
            offset = float(-side @ point - reach - _sagitta(reach) - 0.25 * _CORRIDOR_SLACK)
            lower = clip_part(lower, np.append(-side, 0.0), offset)
    return out, clipped


def clip_part(part: ConvexPart, normal: Array, offset: float) -> ConvexPart | None:
    """The portion of the part in the half space normal · x ≤ offset; None if it has no volume."""
    height = part.vertices @ normal - offset
    if (height <= 0).all():
        return part
    edges = np.unique(np.sort(part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    a, b = height[edges].T
    crosses = a * b < 0
    fraction = (a / np.where(crosses, a - b, 1.0))[crosses, None]
    start, end = part.vertices[edges[crosses, 0]], part.vertices[edges[crosses, 1]]
    return ConvexPart.hull(np.concatenate([part.vertices[height <= 0], start + fraction * (end - start)]))


def _sagitta(reach: float) -> float:
    """Largest error [m] if distances are measured from the route's points (`SPACING` apart), not from its line."""
    return SPACING**2 / (8 * reach)


def _intrusion(part: ConvexPart, route: Array, reach: float, ground: Ground) -> tuple[float, Array, Array]:
    """Depth [m] of a part inside the corridor (≤ 0: clear), the nearest route point, and a unit vector to the part."""
    clear = (-1.0, np.zeros(2), np.zeros(2))
    low, high = part.vertices[:, :2].min(0) - reach, part.vertices[:, :2].max(0) + reach
    near = route[((route >= low) & (route <= high)).all(1)]
    if len(near) == 0:
        return clear
    floor = ground.at(near)
    if part.vertices[:, 2].min() > floor.max() + HEADROOM:
        return clear
    below = clip_part(part, np.array([0.0, 0.0, 1.0]), float(floor.max()) + HEADROOM)
    if below is None:
        return clear
    xy = below.vertices[:, :2]
    try:
        outline = xy[ConvexHull(xy).vertices]  # counterclockwise
    except QhullError:  # all on a line
        outline = xy[[np.argmin(xy @ [1.0, 0.3]), np.argmax(xy @ [1.0, 0.3])]]
    distance, closest = _distance_to_outline(near, outline)
    worst = int(np.argmin(distance))
    depth = reach + _sagitta(reach) - float(distance[worst])
    point = near[worst]
    side = closest[worst] - point if distance[worst] > 1e-6 else outline.mean(0) - point
    length = float(np.linalg.norm(side))
    return depth, point, side / length if length > 1e-9 else np.array([1.0, 0.0])


def _distance_to_outline(points: Array, outline: Array) -> tuple[Array, Array]:
    """For points (k, 2): distances (k,) to a convex polygon, 0 inside; and the nearest points (k, 2) on its edges."""
    along = np.roll(outline, -1, axis=0) - outline
    toward = points[:, None] - outline
    fraction = np.einsum("kij,ij->ki", toward, along) / np.maximum((along**2).sum(1), 1e-18)
    foot = outline + np.clip(fraction, 0.0, 1.0)[..., None] * along
    distance = np.linalg.norm(points[:, None] - foot, axis=-1)
    best = np.argmin(distance, 1)
    rows = np.arange(len(points))
    turn = along[:, 0] * toward[..., 1] - along[:, 1] * toward[..., 0]
    left = turn >= 0 if len(outline) > 2 else np.zeros((len(points), 1), bool)
    return np.where(left.all(1), 0.0, distance[rows, best]), foot[rows, best]
