"""Transients: things that move during a film, and objects that stand in some films only.

Training leaves out the pixels that show them, so that the field contains only what stays.

*Movers*, and shadows that move: each surface that a frame shows is looked up in other frames of the same lighting. If
these agree on a color from which the frame's own differs, something else was in front of the surface, or shaded it.
Frames are divided into *cells* of a few pixels; the depths of the surfaces in them come from a field in training.

*Objects that left*: stereo within each film shows which voxels are occupied, and which are empty since surfaces behind
them are seen. A group of voxels that is occupied in one lighting and empty in another is such an object.
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree

from twin.geometry.cameras import pixel_grid, project, unproject
from twin.geometry.images import resize
from twin.nerf.buffers import CameraArrays, parallel
from twin.nerf.dataset import TrainingPixels
from twin.nerf.field import RadianceField
from twin.types import Array, Array32

_GRID_CELLS = 80  # cells along a frame's longer side
_FAR = 300.0  # [m] greatest depth; the sky is taken to be there
_NEIGHBORS = 14  # frames in which a surface is looked up
_MIN_SEEN = 4  # least number of observations of a cell's surface in other frames
_DEPTH_TOLERANCE = 0.1  # a surface is visible in a frame if it is deeper than the frame's depth by less than this share
_MIN_DIFFERENCE = 0.015  # least difference of a mover's color from that of a black surface [full scale = 1]
_MIN_CONTRAST = 0.12  # increase of this least difference with brightness
_MIN_CELLS = 8  # least number of strongly marked cells of a mover
_WEAK = 0.75  # a mover's weakly marked cells have at least this share of the least difference
_FIXED = 0.25  # a cell that is marked in more than this share of a film's frames shows no mover
_SPREADS = 4.0  # least difference, as a multiple of the other frames' median deviation from their median


@dataclass(frozen=True)
class Cells:
    """A training frame's cells."""

    pixel: Array
    """Centers (u, v) [px], shape (rows, columns, 2)."""
    color: Array32
    """Mean colors in [0, 1], shape (rows, columns, 3)."""
    depth: Array32
    """z-depth [m], shape (rows, columns)."""
    side: int
    """Side of a cell [px]."""

    def points(self, pixels: TrainingPixels, i: int) -> Array:
        """Points of the surfaces that the cells of frame i show [m], shape (rows · columns, 3)."""
        rays = unproject(self.pixel.reshape(-1, 2), pixels.intrinsics[i])
        pose = pixels.cameras.camera_to_world[i]
        return (rays / rays[:, 2:] * self.depth.reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]


def cell_size(pixels: TrainingPixels, count: int = _GRID_CELLS) -> int:
    """Side of a cell [px], such that `count` cells are about as long as a frame's longer side."""
    return max(1, round(float(max(pixels.width.max(), pixels.height.max())) / count))


def cell_centers(width: int, height: int, side: int) -> Array:
    """Centers (u, v) of a frame's whole cells [px], shape (rows, columns, 2)."""
    return pixel_grid(width // side, height // side) * side


def frame_cells(pixels: TrainingPixels, i: int, side: int, depth: Array32) -> Cells:
    """Cells of training frame i, with the z-depths (rows, columns) [m] at their centers."""
    width, height = int(pixels.width[i]), int(pixels.height[i])
    image = pixels.colors[pixels.start[i] : pixels.start[i + 1]].reshape(height, width, 3)
    centers = cell_centers(width, height, side)
    rows, columns = centers.shape[:2]
    color = image[: rows * side, : columns * side].reshape(rows, side, columns, side, 3).mean((1, 3)) / 255.0
    return Cells(centers, color.astype(np.float32), np.minimum(depth, np.float32(_FAR)), side)


def neighbors(pixels: TrainingPixels, i: int) -> NDArray[np.int64]:
    """Up to 14 other frames of frame i's lighting, nearest first."""
    lightings = np.array(pixels.cameras.lightings)
    others = np.flatnonzero((lightings == lightings[i]) & (np.arange(len(lightings)) != i))
    distance = np.linalg.norm(pixels.cameras.positions[others] - pixels.cameras.positions[i], axis=1)
    return others[np.argsort(distance, kind="stable")[:_NEIGHBORS]]


def static_depths(pixels: TrainingPixels, cells: list[Cells]) -> list[Array32]:
    """z-depths [m] of the static surfaces in every frame's cells, shapes (rows, columns).

    A field in training may contain a mover as a surface close to the cameras that filmed it. So every cell gets the
    median depth of the surfaces that other frames show in it, if there are `_MIN_SEEN`.
    """

    def find(i: int) -> Array32:
        own = cells[i]
        rows, columns = own.depth.shape
        at, depths = [], []
        for j in neighbors(pixels, i):
            points = cells[j].points(pixels, j)
            pixel, z = project(points, pixels.cameras.camera_to_world[i], pixels.intrinsics[i])
            u, v = np.floor(pixel / own.side).T
            inside = (z > 0.1) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
            at.append((v[inside] * columns + u[inside]).astype(int))
            depths.append(z[inside].astype(np.float32))
        group, depth = np.concatenate([np.zeros(0, int), *at]), np.concatenate([np.zeros(0, np.float32), *depths])
        count = np.bincount(group, minlength=rows * columns)
        first = np.cumsum(count) - count
        ordered = np.append(depth[np.lexsort((depth, group))], np.float32(0.0))
        middle = ordered[np.minimum(first + (count - 1) // 2, len(depth))].reshape(rows, columns)
        return np.where(count.reshape(rows, columns) >= _MIN_SEEN, middle, own.depth)

    return parallel(find, range(len(cells)), "cpu")


def consensus(pixels: TrainingPixels, cells: list[Cells], i: int) -> tuple[Array32, Array32, NDArray]:
    """Colors of the surfaces in frame i's cells as other frames see them.

    Returns:
        Median color, shape (rows, columns, 3); median deviation from it, shape (rows, columns); number of frames that
        see the surface, shape (rows, columns).
    """
    own = cells[i]
    shape = own.depth.shape
    points = own.points(pixels, i)
    seen = [np.full((len(points), 3), np.nan, np.float32)]
    for j in neighbors(pixels, i):
        other = cells[j]
        rows, columns = other.depth.shape
        pixel, z = project(points, pixels.cameras.camera_to_world[j], pixels.intrinsics[j])
        at = (pixel / other.side - 0.5).astype(np.float32)
        inside = (z > 0.1) & (at > -0.5).all(1) & (at < np.array([columns, rows]) - 0.5).all(1)
        at = np.where(inside[:, None], at, np.float32(0.0))
        u, v = at.T.reshape(2, *shape)
        color = cv2.remap(other.color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)
        nearest = np.clip(np.rint(at).astype(int), 0, [columns - 1, rows - 1])
        visible = inside & (z < (1.0 + _DEPTH_TOLERANCE) * other.depth[nearest[:, 1], nearest[:, 0]])
        if visible.any():  # corrects the drift of exposure and white balance from frame to frame
            color += np.median((own.color.reshape(-1, 3) - color)[visible], 0)
        seen.append(np.where(visible[:, None], color, np.float32(np.nan)))
    stack = np.array(seen)
    count = np.isfinite(stack[..., 0]).sum(0)
    median = _median(stack, count)
    spread = _median(np.abs(stack - median).mean(-1, keepdims=True), count)[:, 0]
    return median.reshape(*shape, 3), spread.reshape(shape), count.reshape(shape)


def _median(stack: Array32, count: NDArray) -> Array32:
    """Median over the first axis of (k, n, c), of which `count` (n,) values are known and the others nan."""
    ordered = np.sort(stack, 0)  # nan comes last
    index = np.arange(len(count))
    return 0.5 * (ordered[np.maximum(count - 1, 0) // 2, index] + ordered[count // 2, index])


def cell_depths(pixels: TrainingPixels, field: RadianceField, arrays: CameraArrays) -> list[Array32]:
    """A field's z-depths [m] at the centers of every frame's cells, shapes (rows, columns); `arrays`: the cameras."""
    side = cell_size(pixels)
    centers = [cell_centers(int(w), int(h), side) for w, h in zip(pixels.width, pixels.height, strict=True)]
    counts = [grid.shape[0] * grid.shape[1] for grid in centers]
    frame = np.repeat(np.arange(len(centers)), counts)
    depth = field.trace(arrays, frame, np.concatenate([grid.reshape(-1, 2) for grid in centers]))[2]
    parts = np.split(depth.cpu().numpy(), np.cumsum(counts)[:-1])
    return [part.reshape(grid.shape[:2]) for part, grid in zip(parts, centers, strict=True)]


def mover_masks(pixels: TrainingPixels, depths: list[Array32]) -> list[NDArray[np.bool_]]:
    """One mask per training frame, true where it shows a mover or a shadow that moves.

    `depths` are the z-depths [m] of the surfaces in every frame's cells (`cell_centers`), shapes (rows, columns).
    """
    side = cell_size(pixels)
    cells = [frame_cells(pixels, i, side, depth) for i, depth in enumerate(depths)]
    static = [replace(one, depth=depth) for one, depth in zip(cells, static_depths(pixels, cells), strict=True)]

    # The field's depths are wrong where the field contains the mover; the median depths are wrong at thin objects. So
    # a mover must differ with either kind of depth.
    def find(i: int) -> NDArray[np.bool_]:
        excess = np.fmin(difference(pixels, cells, i), difference(pixels, static, i))
        return cleaned(excess > 1.0, excess > _WEAK)

    marked = _without_fixed(parallel(find, range(len(cells)), "cpu"), pixels.cameras.sources)
    sizes = zip(pixels.width, pixels.height, strict=True)
    return [_enlarged(mark, side, int(w), int(h)) for mark, (w, h) in zip(marked, sizes, strict=True)]


def _without_fixed(marked: list[NDArray[np.bool_]], sources: tuple[str, ...]) -> list[NDArray[np.bool_]]:
    """Unmarks cells that are marked in many frames of a film, as by vignetting or shadows that move with the camera."""
    out = list(marked)
    for source in dict.fromkeys(sources):
        own = [i for i, name in enumerate(sources) if name == source]
        if len({marked[i].shape for i in own}) == 1:
            fixed = np.mean([marked[i] for i in own], 0) > _FIXED
            for i in own:
                out[i] = marked[i] & ~fixed
    return out


def _enlarged(cells: NDArray[np.bool_], side: int, width: int, height: int) -> NDArray[np.bool_]:
    """A frame's marked cells as pixels, shape (height, width)."""
    mask = np.repeat(np.repeat(cells, side, 0), side, 1)
    return np.pad(mask, ((0, height - mask.shape[0]), (0, width - mask.shape[1])), mode="edge")


def difference(pixels: TrainingPixels, cells: list[Cells], i: int) -> Array32:
    """Color difference of frame i's cells from other frames, divided by the least one of a mover, (rows, columns).

    Errors of depths and poses are unlikely to give values above 1. It is 0 where too few frames see the surface.
    """
    median, spread, count = consensus(pixels, cells, i)
    color = cells[i].color
    coarse = np.abs(_mean_around(color) - _mean_around(median)).mean(-1)
    brightness = np.fmax(color.mean(-1), median.mean(-1))
    least = np.maximum(_MIN_DIFFERENCE + _MIN_CONTRAST * brightness, _SPREADS * spread)
    excess = np.fmin(_least_difference(color, median), coarse) / least
    return np.where(count >= _MIN_SEEN, excess, 0.0).astype(np.float32)


def _least_difference(color: Array32, median: Array32) -> Array32:
    """Difference of each cell's color from the most similar surface in its cell or the eight around it.

    Depths and poses are not exact, so a surface may be found one cell aside. Shapes (rows, columns, 3) →
    (rows, columns).
    """
    rows, columns = color.shape[:2]
    wide = np.pad(median, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    shifts = [np.abs(color - wide[a : a + rows, b : b + columns]).mean(-1) for a in range(3) for b in range(3)]
    return np.fmin.reduce(shifts)


def _mean_around(color: Array32) -> Array32:
    """Means over 3 × 3 cells, without those that are nan."""
    known = np.isfinite(color)
    total = cv2.blur(np.where(known, color, np.float32(0.0)), (3, 3))
    return (total / np.maximum(cv2.blur(known.astype(np.float32), (3, 3)), 1e-6)).astype(np.float32)


def cleaned(strong: NDArray[np.bool_], weak: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Weakly marked regions with `_MIN_CELLS` strongly marked cells, with small gaps closed and a margin of a cell."""
    closed = cv2.morphologyEx((strong | weak).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    count, labels = cv2.connectedComponents(opened, connectivity=4)
    kept = np.bincount(labels[strong], minlength=count) >= _MIN_CELLS
    kept[0] = False  # the background
    return cv2.dilate(kept[labels].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


# ---- objects that stand in some films only

_VOXEL = 0.25  # [m] side
_REACH = 18.0  # [m] from the camera, within which stereo is accurate enough
_BEHIND = (0.5, 0.08)  # least distance of a surface behind an empty voxel: greater of [m] and [share of the depth]
_AT = (0.3, 0.04)  # greatest distance of a surface from an occupied voxel: greater of [m] and [share of the depth]
_MIN_KNOWN = 3  # least number of known depths among a voxel's cell and its eight neighbors, to find the voxel empty
_MIN_FRAMES = 3  # least number of frames to find a voxel occupied, or empty
_MIN_VOXELS = 24  # smaller objects are left alone: noise of stereo looks like them
_HIDDEN = 0.7  # [m] an object is hidden by surfaces that are nearer than its nearest voxel by more than this
_NEAR_PLANE = 0.3  # [m] z-depth from which an object's outline is drawn
_SHADOW_REACH = 2.5  # [m] dark ground at most this far from an object is taken to be in its shadow
_SHADOW_DARKNESS = 0.8  # greatest brightness of ground in a shadow, as a share of the median brightness farther away
_MIN_AROUND = 20  # least number of cells with ground farther away, to find a shadow
_STEREO_CELLS = 160  # cells along a frame's longer side in which stereo depths are looked up
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_MIN_EXTENT = 0.6  # [m] least extent along the second longest axis


@dataclass(frozen=True)
class LeftObject:
    """Something that stands in the films of some lightings, and is missing in others."""

    voxels: Array
    """Centers of its voxels [m], shape (k, 3)."""
    present: tuple[str, ...]
    """Lightings that show it."""
    absent: tuple[str, ...]
    """Lightings that show its space empty."""

    @property
    def center(self) -> Array:
        """Center of its bounding box [m], shape (3,)."""
        return 0.5 * (self.voxels.min(0) + self.voxels.max(0))

    @property
    def size(self) -> Array:
        """Size of its bounding box [m], shape (3,)."""
        return np.ptp(self.voxels, axis=0) + _VOXEL

    def to_json(self) -> dict[str, Any]:
        """Center and size of its bounding box [m], and its lightings, for the report."""
        center, size = ([round(float(x), 2) for x in values] for values in (self.center, self.size))
        return {"center": center, "size": size, "present": list(self.present), "absent": list(self.absent)}


def left_objects(pixels: TrainingPixels) -> list[LeftObject]:
    """Finds objects that stand in the films of some lightings only, from the films' stereo depths."""
    lightings = tuple(dict.fromkeys(pixels.cameras.lightings))
    if len(lightings) < 2 or not len(pixels.stereo.frame):
        return []
    voxels = _voxels(pixels)
    side = cell_size(pixels, _STEREO_CELLS)
    index = np.array([lightings.index(name) for name in pixels.cameras.lightings])
    occupied, empty = (np.zeros((len(voxels), len(lightings)), np.int32) for _ in range(2))
    for i in range(len(pixels.cameras)):
        known = stereo_map(pixels, i, side)
        near = np.flatnonzero(((voxels - pixels.cameras.positions[i]) ** 2).sum(1) < _REACH**2)
        pixel, z = project(voxels[near], pixels.cameras.camera_to_world[i], pixels.intrinsics[i])
        column, row = np.floor(pixel / side).astype(int).T
        inside = (z > 0.5) & (row >= 1) & (column >= 1) & (row < known.shape[0] - 1) & (column < known.shape[1] - 1)
        near, z, row, column = near[inside], z[inside], row[inside], column[inside]
        window = np.stack([known[row + a, column + b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
        enough = np.isfinite(window).sum(0) >= _MIN_KNOWN
        window = np.where(np.isnan(window), np.inf, window)
        at = np.abs(window - z).min(0) < np.maximum(_AT[0], _AT[1] * z)
        behind = enough & (window.min(0) > z + np.maximum(_BEHIND[0], _BEHIND[1] * z))
        occupied[near, index[i]] += at
        empty[near, index[i]] += behind
    is_there = (occupied >= _MIN_FRAMES) & (occupied > 2 * empty)
    is_empty = (empty >= _MIN_FRAMES) & (empty > 6 * occupied)
    found = []
    chosen = np.flatnonzero(is_there.any(1) & is_empty.any(1))
    for part in _components(voxels[chosen]):
        own = chosen[part]
        extent = np.sort(np.ptp(voxels[own], axis=0) + _VOXEL)
        if not _stands(pixels, voxels[own]):
            continue
        if len(own) < _MIN_VOXELS or extent[1] < _MIN_EXTENT:
            continue
        there, gone = is_there[own].sum(0), is_empty[own].sum(0)
        present = tuple(name for k, name in enumerate(lightings) if there[k] > gone[k])
        absent = tuple(name for k, name in enumerate(lightings) if gone[k] > there[k])
        if present and absent:
            found.append(LeftObject(voxels[own], present, absent))
    return found


def object_masks(pixels: TrainingPixels, objects: list[LeftObject]) -> list[NDArray[np.bool_]]:
    """One mask per training frame, true where it shows one of the objects, or its shadow on the ground."""
    side = cell_size(pixels)

    def find(i: int) -> NDArray[np.bool_]:
        width, height = int(pixels.width[i]), int(pixels.height[i])
        mask = np.zeros((height, width), bool)
        present = [one for one in objects if pixels.cameras.lightings[i] in one.present]
        if present:
            known = stereo_map(pixels, i, side)
            cells = frame_cells(pixels, i, side, np.where(np.isnan(known), np.float32(_FAR), known))
            for one in present:
                mask |= _outline(pixels, cells, i, one)
                mask |= _enlarged(_shadow(pixels, cells, i, one), side, width, height)
        return mask

    return parallel(find, range(len(pixels.cameras)), "cpu")


def _outline(pixels: TrainingPixels, cells: Cells, i: int, one: LeftObject) -> NDArray[np.bool_]:
    """True where frame i shows an object, with a margin of half a voxel, shape (height, width)."""
    height, width = int(pixels.height[i]), int(pixels.width[i])
    mask = np.zeros((height, width), np.uint8)
    corners = (one.voxels[:, None] + _VOXEL * _CORNERS).reshape(-1, 3)
    corners = corners[ConvexHull(corners).vertices]
    local = (corners - pixels.cameras.positions[i]) @ pixels.cameras.camera_to_world[i, :3, :3]
    ahead, behind = local[local[:, 2] >= _NEAR_PLANE], local[local[:, 2] < _NEAR_PLANE]
    if not len(ahead):
        return mask > 0
    # Where edges of the hull cross the near plane.
    share = (_NEAR_PLANE - behind[:, None, 2]) / (ahead[:, 2] - behind[:, None, 2])
    crossing = behind[:, None] + share[..., None] * (ahead - behind[:, None])
    corner = np.concatenate([ahead, crossing.reshape(-1, 3)])
    fx, fy, cx, cy = pixels.intrinsics[i]
    u, v = fx * corner[:, 0] / corner[:, 2] + cx, fy * corner[:, 1] / corner[:, 2] + cy
    cv2.fillConvexPoly(mask, np.rint(cv2.convexHull(np.stack([u, v], 1).astype(np.float32))).astype(np.int32), 1)
    hidden = (cells.depth < corner[:, 2].min() - _HIDDEN).astype(np.uint8)
    hidden = cv2.resize(hidden, (width, height), interpolation=cv2.INTER_NEAREST)
    return (mask > 0) & (hidden == 0)


def _shadow(pixels: TrainingPixels, cells: Cells, i: int, one: LeftObject) -> NDArray[np.bool_]:
    """True in the cells of frame i with ground near an object that is darker than the ground around it."""
    base = one.voxels[:, 2].min() - 0.5 * _VOXEL
    rays = unproject(cells.pixel.reshape(-1, 2), pixels.intrinsics[i]) @ pixels.cameras.camera_to_world[i, :3, :3].T
    position = pixels.cameras.positions[i]
    down = rays[:, 2] < -1e-3
    reach = np.where(down, (base - position[2]) / np.where(down, rays[:, 2], -1.0), 0.0)
    ground = position[:2] + reach[:, None] * rays[:, :2]
    distance = np.where(down & (reach > 0.0), cKDTree(one.voxels[:, :2]).query(ground)[0], np.inf)
    brightness = cells.color.mean(-1).ravel()
    around = (distance > _SHADOW_REACH) & (distance < 2.0 * _SHADOW_REACH)
    if around.sum() < _MIN_AROUND:
        return np.zeros(cells.depth.shape, bool)
    dark = (distance < _SHADOW_REACH) & (brightness < _SHADOW_DARKNESS * np.median(brightness[around]))
    dark = cv2.morphologyEx(dark.reshape(cells.depth.shape).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return cv2.dilate(dark, np.ones((3, 3), np.uint8)) > 0


def stereo_map(pixels: TrainingPixels, i: int, side: int) -> Array32:
    """Stereo's z-depths [m] in the cells of `side` pixels of training frame i, nan where unknown, (rows, columns)."""
    known = np.full((int(pixels.height[i]) // side, int(pixels.width[i]) // side), np.nan, np.float32)
    own = pixels.stereo.of_frame(i)
    pixel = pixels.stereo.pixel[own]
    z = pixels.stereo.distance[own] / np.linalg.norm(unproject(pixel, pixels.intrinsics[i]), axis=1)
    column, row = np.minimum((pixel // side).astype(int), [known.shape[1] - 1, known.shape[0] - 1]).T
    known[row, column] = z
    return known


def _voxels(pixels: TrainingPixels) -> Array:
    """Centers [m] of the voxels that contain stereo points of enough frames near them, shape (n, 3)."""
    keys = []
    for i in range(len(pixels.cameras)):
        own = pixels.stereo.of_frame(i)
        distance = pixels.stereo.distance[own]
        near = distance < _REACH
        rays = unproject(pixels.stereo.pixel[own][near], pixels.intrinsics[i])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) * distance[near, None]
        pose = pixels.cameras.camera_to_world[i]
        keys.append(np.unique(np.floor((rays @ pose[:3, :3].T + pose[:3, 3]) / _VOXEL).astype(np.int64), axis=0))
    found, frames = np.unique(np.concatenate(keys), axis=0, return_counts=True)
    return (found[frames >= _MIN_FRAMES] + 0.5) * _VOXEL


def _stands(pixels: TrainingPixels, voxels: Array) -> bool:
    """True if an object's lowest voxel is below the nearest camera; others are treetops, or lights at night."""
    positions = pixels.cameras.positions
    nearest = np.argmin(np.linalg.norm(positions[:, :2] - voxels[:, :2].mean(0), axis=1))
    return bool(voxels[:, 2].min() < positions[nearest, 2])


def _components(points: Array) -> list[NDArray[np.int64]]:
    """Groups of voxels that touch each other or have one voxel between them, as indices."""
    if not len(points):
        return []
    tree = cKDTree(points)
    pairs = tree.query_pairs(2.1 * _VOXEL, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points), len(points)))
    labels = connected_components(graph, directed=False)[1]
    return [np.flatnonzero(labels == k) for k in range(labels.max() + 1)]


# ---- picture for the report

_SHOWN = 2  # frames per lighting, and columns of the picture
_TILE = (320, 180)  # size of a frame in the picture [px]
_RED = np.array([230, 20, 20], np.float32)


def picture(pixels: TrainingPixels, excluded: list[NDArray[np.bool_]]) -> NDArray[np.uint8]:
    """Up to two frames per lighting with many excluded pixels, which are red; RGB, shape (height, width, 3).

    At least one pixel must be excluded.
    """
    lightings = np.array(pixels.cameras.lightings)
    share = np.array([mask.mean() for mask in excluded])
    tiles = []
    for name in dict.fromkeys(pixels.cameras.lightings):
        own = np.flatnonzero((lightings == name) & (share > 0.0))
        for i in own[np.argsort(-share[own], kind="stable")][: 8 * _SHOWN : 8]:  # neighbors look alike
            mask = excluded[i]
            image = pixels.colors[pixels.start[i] : pixels.start[i + 1]].reshape(*mask.shape, 3).astype(np.float32)
            image[mask] = 0.5 * (image[mask] + _RED)
            scale = min(_TILE[0] / mask.shape[1], _TILE[1] / mask.shape[0])
            small = resize(image.astype(np.uint8), round(scale * mask.shape[1]), round(scale * mask.shape[0]))
            tile = np.zeros((_TILE[1], _TILE[0], 3), np.uint8)
            tile[: small.shape[0], : small.shape[1]] = small
            tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _SHOWN)
    return np.concatenate([np.concatenate(tiles[k : k + _SHOWN], 1) for k in range(0, len(tiles), _SHOWN)])
