"""Estimates the up direction and the road below the cameras, in the unit of the poses (no metric scale is needed).

*Up* is the unit normal of the ground. Three kinds of evidence are combined, weighted by their uncertainties:

- *right* axes of the cameras: horizontal if the cameras are upright, whatever their pitch
- *path*: parallel to the ground if the camera has a constant height. A straight path does not constrain the rotation of
  up about the path; a path with turns constrains both angles
- *road*: the layer of points below the path. Because of camber it determines up only to about 1°

The *drop* of a point is its depth below the horizontally nearest camera; its *offset* is the horizontal distance from
that camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.types import Array

_SIGMA_RIGHT = np.radians(1.0)
"""Mounting error of a camera's right axis [rad]; common to all frames, so averaging does not reduce it."""
_SIGMA_ROAD = np.radians(1.0)  # [rad] standard deviation of the tilt of roads by camber
_SIGMA_PATH = np.radians(0.3)  # [rad] standard deviation of a path's slope relative to the ground
_PATH_SAMPLES = 3.0  # independent heights along a path; far fewer than frames, since a path undulates smoothly
_MIN_VARIANCE_RATIO = 10.0
"""A principal axis of points constrains up only if the variance along it is more than this multiple of the smallest."""
_MIN_WIDTH = 0.05
"""An axis of the path constrains up only if the path's standard deviation along it is more than this fraction of the
largest one. A narrower path is straight: it deviates as much vertically as sideways."""
_UNDULATION = 0.003  # lower bound of the path's vertical standard deviation [fraction of the largest one]
_LAYER = 0.06  # half thickness of the road layer, for undulation, camber and noise [fraction of the drop]
_MAX_TILT = np.radians(25.0)  # largest angle between the road's normal and the cameras' mean up axis [rad]
MIN_ROAD_POINTS = 20  # road points needed for a reliable road
_REACHES = (1.0, 2.0, 4.0, 8.0)  # largest offsets [drops] of the points of the road layer, tried in this order
_MIN_AROUND = 6  # road points around a place needed for the height of the ground there
_MIN_CAMERA_FRACTION = 0.2  # smallest fraction of the cameras that need a height in `heights_above_road`
_DEEPER_THAN = 1.25  # points are far below a layer if their drop exceeds this multiple of the layer's drop
_MAX_DEEPER_FRACTION = 0.1
"""A layer is not the ground if the number of points far below it exceeds this fraction of its own points: ground
hides what lies below it."""


@dataclass(frozen=True)
class Road:
    """The layer of points below a path."""

    points: NDArray[np.int64]  # indices of its points, shape (k,)
    drop: float  # median height of the cameras above it
    spread: float  # robust standard deviation of the drops of its points
    reach: float  # largest offset of its points [drops]; 1: below the path, more: on the verges, too

    @property
    def reliable(self) -> bool:
        return len(self.points) >= MIN_ROAD_POINTS and self.reach <= _REACHES[0]


@dataclass(frozen=True)
class Gravity:
    """The up direction with its uncertainty."""

    direction: Array  # unit vector, shape (3,)
    uncertainty: float  # standard deviation of the angle [rad]
    source: str  # the evidence used


def camera_up(camera_to_world: Array) -> Array:
    """Mean up axis of the cameras, a unit vector, shape (3,)."""
    mean = -camera_to_world[:, :3, 1].mean(0)
    return mean / max(float(np.linalg.norm(mean)), 1e-12)


def up_from_path(camera_to_world: Array, sources: Sequence[str] = ()) -> tuple[Array, Array]:
    """Returns up (3,), estimated from the cameras' right axes and path, and the matrix E (3, 3) of this evidence.

    `sources` names the source of each frame, empty: all are of one. Sources may have different camera heights, so only
    slopes within a source count. n·E·n is the squared error [standard deviations] if a unit vector n is taken as up.
    """
    right = camera_to_world[:, :3, 0]
    evidence = right.T @ right / len(right) / _SIGMA_RIGHT**2
    centers = camera_to_world[:, :3, 3].copy()
    for mine in _each(sources, len(centers)):
        centers[mine] -= centers[mine].mean(0)
    variances, axes = np.linalg.eigh(centers.T @ centers / len(centers))
    undulation = max(variances[0], _UNDULATION**2 * variances[2])
    for variance, axis in zip(variances[1:], axes.T[1:], strict=True):
        if variance > max(_MIN_VARIANCE_RATIO * variances[0], _MIN_WIDTH**2 * variances[2]):
            sigma2 = undulation / (_PATH_SAMPLES * variance) + _SIGMA_PATH**2
            evidence += np.outer(axis, axis) / sigma2
    return _solve_up(evidence, camera_up(camera_to_world))[0], evidence


def _each(sources: Sequence[str], count: int) -> list[NDArray[np.bool_]]:
    """The mask (count,) of each source's frames."""
    names = np.array(sources or [""] * count)
    return [names == source for source in dict.fromkeys(names.tolist())]


def _solve_up(evidence: Array, prior_up: Array) -> tuple[Array, float]:
    """The unit vector that minimizes the error under evidence and a weak prior, and its standard deviation [rad]."""
    # The prior is weak, since cameras may be pitched by 10° and more: it decides only where there is no evidence.
    prior = (np.eye(3) - np.outer(prior_up, prior_up)) / np.radians(15.0) ** 2
    values, vectors = np.linalg.eigh(evidence + prior)
    up = vectors[:, 0] * (1.0 if vectors[:, 0] @ prior_up >= 0 else -1.0)
    return up, float(np.sqrt(np.sum(1.0 / np.maximum(values[1:] - values[0], 1e-12))))


def below_path(points: Array, centers: Array, up: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Horizontally nearest camera of each point, and the point's drop and offset from that camera, shapes (m,)."""
    flat = np.eye(3) - np.outer(up, up)
    offset, nearest = cKDTree(centers @ flat).query(points @ flat)
    return nearest, (centers[nearest] - points) @ up, offset


def find_road(points: Array, centers: Array, up: Array) -> Road | None:
    """The lowest well-supported layer of points below a path, or None.

    The support of a layer at drop h is the number of points within ±6 % of h whose offset is below h. Such points are
    seen more than 45° below the horizon. The road is the lowest layer with at least half of the best support, since
    nothing solid lies below a road. A layer with many points far below it is no road; such a layer occurs when the
    camera circles an object. If the road has fewer than `MIN_ROAD_POINTS`, because it is without texture, larger
    offsets are allowed step by step, so that the verges count, too. If no step gives enough points, the layer of
    the first step is returned, unless a later one has more than twice as many points.
    """
    if not len(points):
        return None
    _, drop, offset = below_path(points, centers, up)
    best: Road | None = None
    for reach in _REACHES:
        road = _layer(drop, offset, reach)
        if road is not None and len(road.points) >= MIN_ROAD_POINTS:
            return road
        if road is not None and (best is None or len(road.points) > 2 * len(best.points)):
            best = road
    return best


def _layer(drop: Array, offset: Array, reach: float) -> Road | None:
    below = np.flatnonzero((drop > 0) & (offset < 2.0 * reach * drop))
    if not len(below):
        return None
    drops, offsets = drop[below], offset[below]
    layers = np.geomspace(np.quantile(drops, 0.01), drops.max(), 400)
    # One layer at a time: all at once would take gigabytes for the points of a long road.
    support = np.array([np.sum((np.abs(drops - h) < _LAYER * h) & (offsets < reach * h)) for h in layers])
    height = float(layers[np.flatnonzero(support >= 0.5 * support.max())[-1]])
    for _ in range(5):  # centers the layer on its median
        chosen = (np.abs(drops - height) < _LAYER * height) & (offsets < reach * height)
        if not chosen.any():
            return None
        height = float(np.median(drops[chosen]))
    chosen = (np.abs(drops - height) < _LAYER * height) & (offsets < reach * height)
    deeper = np.count_nonzero((drops > _DEEPER_THAN * height) & (offsets < reach * height))
    if deeper > _MAX_DEEPER_FRACTION * chosen.sum():
        return None
    spread = 1.4826 * float(np.median(np.abs(drops[chosen] - height)))
    return Road(below[chosen], height, spread, reach)


def up_from_ground(camera_to_world: Array, points: Array, sources: Sequence[str] = ()) -> tuple[Gravity, Road | None]:
    """Returns the up direction and the road below the path, computed from poses (n, 4, 4) and sparse points (m, 3).

    `sources` names the source of each frame, see `up_from_path`.
    """
    prior_up = camera_up(camera_to_world)
    centers = camera_to_world[:, :3, 3]
    up, evidence = up_from_path(camera_to_world, sources)
    road = find_road(points, centers, up)
    basis = ["path and cameras"]
    if road is not None and road.reliable:
        normal = _road_normal(points[road.points], centers, up, sources)
        if normal is not None and np.arccos(np.clip(normal @ prior_up, -1, 1)) < _MAX_TILT:
            evidence = evidence + (np.eye(3) - np.outer(normal, normal)) / _SIGMA_ROAD**2
            basis.append("road")
    up, sigma = _solve_up(evidence, prior_up)
    return Gravity(up, sigma, " + ".join(basis)), find_road(points, centers, up)


def _road_normal(road: Array, centers: Array, up: Array, sources: Sequence[str]) -> Array | None:
    """Mean normal of the road; None if its points lie on a line.

    Each point is taken relative to the camera above it, so that a climbing road counts as level.
    """
    nearest, _, _ = below_path(road, centers, up)
    local = road - centers[nearest]
    for mine in _each(sources, len(centers)):
        if (of := mine[nearest]).any():
            local[of] -= np.median(local[of], axis=0)
    weight = np.ones(len(local))
    for _ in range(10):  # iteratively reweighted total least squares, Huber-like
        variances, axes = np.linalg.eigh((local * weight[:, None]).T @ local / weight.sum())
        residual = np.abs(local @ axes[:, 0])
        weight = 1.0 / np.maximum(residual, 1.4826 * np.median(residual) + 1e-12)
    if variances[1] < _MIN_VARIANCE_RATIO * variances[0]:
        return None
    return axes[:, 0] if axes[:, 0] @ up > 0 else -axes[:, 0]


def heights_above_road(points: Array, centers: Array, up: Array, drop: float) -> Array | None:
    """Heights (n,) of the camera centers (n, 3) above the road.

    Each is the median height above the road points (k, 3) whose horizontal distance from the camera is at most `drop`,
    NaN if there are fewer than `_MIN_AROUND`. None if fewer than three cameras, or fewer than a fifth, have a height.
    """
    flat = np.eye(3) - np.outer(up, up)
    tree = cKDTree(points @ flat)
    heights = np.full(len(centers), np.nan)
    for i, near in enumerate(tree.query_ball_point(centers @ flat, drop)):
        if len(near) >= _MIN_AROUND:
            heights[i] = float(np.median((centers[i] - points[near]) @ up))
    return heights if np.isfinite(heights).sum() >= max(3, _MIN_CAMERA_FRACTION * len(centers)) else None


def local_ground(points: Array, position: Array, up: Array, radius: float) -> tuple[float, float] | None:
    """Median height along `up` of the road points (k, 3) around a position (3,), and its robust standard deviation.

    Points count up to a horizontal distance of `radius`. Returns None if they are fewer than `_MIN_AROUND`.
    """
    away = points - position
    heights = away @ up
    heights = heights[np.linalg.norm(away - np.outer(heights, up), axis=1) <= radius]
    if len(heights) < _MIN_AROUND:
        return None
    middle = float(np.median(heights))
    return middle + float(position @ up), 1.4826 * float(np.median(np.abs(heights - middle)))
