"""What stands on the ground, as closed pieces for the convex decomposition, and the corridor kept clear.

The *solid* is where the distance field is negative, and what lies hidden behind that, up to `_DEPTH`: a film from a
road shows fronts only, and a wall needs a thickness to be touched. What is near the ground is closed downwards to it,
so that nothing hovers on the gap between. The *corridor* is the filmed route ± half width, up to `HEADROOM` above the
ground: the camera passed there, so it holds nothing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects, gaussian_filter, label, map_coordinates
from scipy.spatial import ConvexHull, QhullError

from twin.assets.convex import ConvexPart, SolidPiece
from twin.assets.ground import Ground
from twin.assets.tsdf import Volume, zero_level
from twin.config import MeshConfig
from twin.geometry.cameras import Cameras
from twin.geometry.route import SPACING, distance_to_route
from twin.types import Array

HEADROOM = 1.5  # [m] above the ground, that the corridor is clear to
_FOOT = 0.1  # [m] nearer to the ground than this is ground
_CLOSED_BELOW = 0.6  # [m] a gap to the ground up to this is closed
_ROOT = 0.15  # [m] parts reach this far into the ground
_TILE = 3.0  # [m] side of the columns big things are cut into
_SPECK = 8  # voxels; smaller things are noise
_HOVERING_SPECK = 64  # voxels; so are these where they touch nothing below
_DEPTH = 0.3  # [m] of hidden space behind a surface that counts as solid
_GAP = 0.45  # [m] narrower gaps are closed
_SMOOTHING = 0.7  # voxels
_SHRINK = 0.06  # [m] rims blur outwards and hulls only grow: surfaces start so much further in
_SURE = 0.02  # [m] what was seen so deep inside a surface stays solid all the same
_CLEAR = 0.02  # [m] parts stay this much further off than asked, for the rounding of later stages


@dataclass(frozen=True)
class Corridor:
    """Free space around the route."""

    route: Array
    """Shape (m, 2) [m]."""
    reach: float
    """Half width and margin [m]."""


def solid_pieces(
    volume: Volume, ground: Ground, corridor: Corridor | None, cameras: Cameras, config: MeshConfig
) -> tuple[list[SolidPiece], dict[str, int]]:
    """Closed meshes of everything that stands more than `obstacle_height` above the ground, at most a tile wide.

    Returns:
        Pieces, nearest to the path first, and counts of what was left out.
    """
    voxel = volume.voxel
    shape = volume.distance.shape
    columns = volume.points(np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij", sparse=False), -1)[:, :, 0])
    xy = columns[..., :2]
    floor = ground.at(xy)
    z = volume.origin[2] + voxel * np.arange(shape[2])
    above = (z[None, None] - floor[..., None]).astype(np.float32)
    field = _solid(volume)
    field[above < _FOOT] = 0.5 * voxel
    _close_downwards(field, above, voxel)
    field = np.maximum(field, above - config.max_height)
    field = np.maximum(field, -_ROOT - above)
    path = corridor.route[::2] if corridor else cameras.positions[:, :2]
    away = distance_transform_edt(~_marked(path, volume, shape[:2])) * voxel
    field = np.maximum(field, (away - config.margin)[..., None].astype(np.float32))
    if corridor is not None:
        near = away < corridor.reach + 2.0
        exact = np.full(away.shape, 10.0)
        exact[near] = distance_to_route(corridor.route[::2], xy[near])
        inside = (corridor.reach + _CLEAR - exact)[..., None].astype(np.float32)
        field = np.where(above < HEADROOM + voxel, np.maximum(field, inside), field)
    solid = field < 0
    names, count = label(solid, np.ones((3, 3, 3), bool))
    pieces: list[tuple[float, SolidPiece]] = []
    specks = low = 0
    tile = max(4, round(_TILE / voxel))
    for number, part in enumerate(find_objects(names), start=1):
        mine = names[part] == number
        size, heights = int(mine.sum()), above[part][mine]
        if heights.max() < config.obstacle_height:
            low += 1
            continue
        if size < (_SPECK if heights.min() < _CLOSED_BELOW else _HOVERING_SPECK):
            specks += 1
            continue
        start = np.array([s.start for s in part])
        for i in range(0, mine.shape[0], tile):
            for j in range(0, mine.shape[1], tile):
                block = mine[i : i + tile, j : j + tile]
                if block.sum() < _SPECK // 2:
                    continue
                values = field[part][i : i + tile, j : j + tile]
                piece = _closed(
                    np.where(block, values, np.maximum(values, 0.3 * voxel)), voxel, volume, start + np.array([i, j, 0])
                )
                if piece is not None:
                    middle = ((piece.vertices.min(0) + piece.vertices.max(0)) / 2)[:2]
                    pieces.append((float(np.linalg.norm(path - middle, axis=1).min()), piece))
    pieces.sort(key=lambda item: item[0])
    return [piece for _, piece in pieces], {"specks": specks, "low": low, "standing": count - specks - low}


def _solid(volume: Volume) -> NDArray[np.float32]:
    """Distance field [m] of the solid, clipped to a voxel; what is unknown beyond its depth counts as free.

    Where a surface was seen it is the surface's own. Gaps narrower than `_GAP` are closed: a fused surface is porous
    where foliage or noise is, and every pore costs the decomposition more than it is worth to a robot that could not
    pass it. All of it is drawn in by `_SHRINK`.
    """
    voxel = volume.voxel
    seen = np.nan_to_num(volume.distance, nan=np.inf) < 0
    depth = distance_transform_edt(~seen) * voxel
    matter = seen | (volume.hidden & (depth < _DEPTH))
    reach = _GAP / 2
    outside = distance_transform_edt(~matter) * voxel
    closed = matter | (distance_transform_edt(outside < reach) * voxel > reach)
    smooth = voxel * (0.5 - gaussian_filter(closed.astype(np.float32), 1.0))
    field = np.where(np.isfinite(volume.distance), np.clip(volume.distance, -voxel, voxel), smooth)
    field = np.where(closed & ~seen, np.minimum(field, smooth), field)
    field = gaussian_filter(field, _SMOOTHING) + _SHRINK
    # What is as thin as a lamp post must not vanish.
    return np.where(volume.distance < -_SURE, np.minimum(field, -0.1 * voxel), field).astype(np.float32)


def _close_downwards(field: NDArray, above: NDArray, voxel: float) -> None:
    """Fills columns from their lowest matter to the ground where the gap is small, in place."""
    matter = field < 0
    lowest = np.where(matter, above, np.inf).min(-1)
    fill = (lowest < _CLOSED_BELOW)[..., None] & (above < lowest[..., None]) & (above > -_ROOT - voxel)
    field[fill] = -0.5 * voxel


def _marked(path: Array, volume: Volume, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    marked = np.zeros(shape, bool)
    index = np.rint((path - volume.origin[:2]) / volume.voxel).astype(int)
    index = np.clip(index, 0, np.array(shape) - 1)
    marked[tuple(index.T)] = True
    return marked


def _closed(values: NDArray, voxel: float, volume: Volume, start: NDArray) -> SolidPiece | None:
    """The closed surface of one block of the field, outside all around."""
    padded = np.pad(values, 1, constant_values=0.5 * voxel)
    origin = volume.points(start - 1)
    vertices, faces = zero_level(padded, origin, voxel)
    if len(faces) < 4:
        return None

    def inside(points: Array) -> NDArray[np.bool_]:
        return map_coordinates(padded, ((points - origin) / voxel).T, order=1, mode="nearest") < 0

    return SolidPiece.of(vertices, faces, inside)


def clear_corridor(
    parts: list[ConvexPart], corridor: Corridor, ground: Ground
) -> tuple[list[tuple[int, ConvexPart]], int]:
    """Cuts away what convex parts still reach into the corridor.

    Above the headroom a part stays as it is; below, it is cut along the tangents of the corridor until it is clear.

    Returns:
        (Index of the original, part) of what is left, and how many parts were cut or dropped.
    """
    out: list[tuple[int, ConvexPart]] = []
    clipped = 0
    reach = corridor.reach + 0.5 * _CLEAR
    chord = _chord(reach)
    for i, part in enumerate(parts):
        if _intrusion(part, corridor.route, reach, ground)[0] <= 0.0:
            out.append((i, part))
            continue
        clipped += 1
        ceiling = float(ground.at(part.vertices[:, :2]).max()) + HEADROOM + _CLEAR
        upper = cut(part, np.array([0.0, 0.0, -1.0]), -ceiling)
        if upper is not None:
            out.append((i, upper))
        lower: ConvexPart | None = cut(part, np.array([0.0, 0.0, 1.0]), ceiling)
        for _ in range(12):
            if lower is None:
                break
            depth, point, side = _intrusion(lower, corridor.route, reach, ground)
            if depth <= 0.0:
                out.append((i, lower))
                break
            # Keep what lies beyond the tangent line on the side where most of the part is.
            lower = cut(lower, np.append(-side, 0.0), float(-side @ point - reach - chord - 0.25 * _CLEAR))
    return out, clipped


def cut(part: ConvexPart, normal: Array, offset: float) -> ConvexPart | None:
    """The part's share of the half space normal · x ≤ offset, or None where no volume is left."""
    height = part.vertices @ normal - offset
    if (height <= 0).all():
        return part
    edges = np.unique(np.sort(part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    a, b = height[edges].T
    crosses = a * b < 0
    share = (a / np.where(crosses, a - b, 1.0))[crosses, None]
    start, end = part.vertices[edges[crosses, 0]], part.vertices[edges[crosses, 1]]
    return ConvexPart.hull(np.concatenate([part.vertices[height <= 0], start + share * (end - start)]))


def _chord(reach: float) -> float:
    """How much nearer [m] the route comes between two of its points, at most; they are `SPACING` apart."""
    return SPACING**2 / (8 * reach)


def _intrusion(part: ConvexPart, route: Array, reach: float, ground: Ground) -> tuple[float, Array, Array]:
    """How deep [m] a part reaches into the corridor, at which route point, and which way it should yield."""
    none = (-1.0, np.zeros(2), np.zeros(2))
    low, high = part.vertices[:, :2].min(0) - reach, part.vertices[:, :2].max(0) + reach
    near = route[((route >= low) & (route <= high)).all(1)]
    if len(near) == 0:
        return none
    floor = ground.at(near)
    if part.vertices[:, 2].min() > floor.max() + HEADROOM:
        return none
    below = cut(part, np.array([0.0, 0.0, 1.0]), float(floor.max()) + HEADROOM)
    if below is None:
        return none
    flat = _outline(below.vertices[:, :2])
    distance, closest = _distance_to_outline(near, flat)
    worst = int(np.argmin(distance))
    depth = reach + _chord(reach) - float(distance[worst])
    point = near[worst]
    side = closest[worst] - point if distance[worst] > 1e-6 else flat.mean(0) - point
    length = float(np.linalg.norm(side))
    return depth, point, side / length if length > 1e-9 else np.array([1.0, 0.0])


def _outline(xy: Array) -> Array:
    """Corners of the convex outline of points (k, 2), counterclockwise; the two ends where they are on a line."""
    try:
        return xy[ConvexHull(xy).vertices]
    except QhullError:
        return xy[[np.argmin(xy @ [1.0, 0.3]), np.argmax(xy @ [1.0, 0.3])]]


def _distance_to_outline(points: Array, outline: Array) -> tuple[Array, Array]:
    """Distance (k,) of points (k, 2) to a convex polygon, 0 inside, and its nearest point (k, 2)."""
    start, along = outline, np.roll(outline, -1, axis=0) - outline
    share = np.einsum("kij,ij->ki", points[:, None] - start, along) / np.maximum((along**2).sum(1), 1e-18)
    foot = start + np.clip(share, 0.0, 1.0)[..., None] * along
    distance = np.linalg.norm(points[:, None] - foot, axis=-1)
    best = np.argmin(distance, 1)
    rows = np.arange(len(points))
    toward = points[:, None] - start
    turn = along[:, 0] * toward[..., 1] - along[:, 1] * toward[..., 0]
    left = turn >= 0 if len(outline) > 2 else np.zeros((len(points), 1), bool)
    return np.where(left.all(1), 0.0, distance[rows, best]), foot[rows, best]
