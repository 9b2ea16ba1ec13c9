"""Which way is up, and where the road lies below the cameras.

*Up* is the unit normal of the ground. Three witnesses testify, each with its own uncertainty: the *right* axes of the
cameras (level in an upright camera, however it is pitched), the *path* (parallel to the ground for a camera carried at
constant height) and the *road* (points of the layer the path runs above). A straight path says nothing about the roll
around itself, a turning one settles both angles; the road's own camber makes its testimony no better than a degree.

The *drop* of a point is how far it lies below the nearest camera of the path, its *offset* how far beside it. All
lengths are in the unit of the poses; nothing here needs the metric scale.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.types import Array

_SIGMA_RIGHT = np.radians(1.0)
"""A camera is mounted level to about this [rad]; the error is common to all frames, so averaging does not reduce it."""
_SIGMA_ROAD = np.radians(1.0)  # [rad] camber of roads
_SIGMA_PATH = np.radians(0.3)  # [rad] slope a path shares with nothing
_PATH_SAMPLES = 3.0
"""Independent heights along a path: its undulation is smooth, so frames count far less than their number."""
_CONDITION = 10.0
"""The path must extend this many times (in variance) further than it undulates before it says anything."""
_WIDTH = 0.05
"""... and at least this share of its length: a straight path undulates as much up and down as to the sides."""
_UNDULATION = 0.003
"""A path undulates by no less than this share of its length, however flat it looks."""
_LAYER = 0.06
"""Half thickness of the road layer [share of the drop]: undulation, camber and noise."""
_MAX_TILT = np.radians(25.0)
"""The road's normal lies within this of the camera-based one [rad]."""
MIN_ROAD_POINTS = 20
"""From this many points on the road counts as measured."""
_REACHES = (1.0, 2.0, 4.0, 8.0)
"""Offsets [drops] within which the road's layer is looked for, one after the other."""


_MIN_SHARE = 0.2
"""Share of the cameras that must have road points below them before their own heights are used."""
_DEEPER = 1.25
_MAX_DEEPER = 0.1
"""Solid ground hides what is below it: more than this share of points deeper than 1.25 drops, and it is no ground."""


@dataclass(frozen=True)
class Road:
    """The layer of points that a path runs above."""

    points: NDArray[np.int64]
    """Indices of the points that lie on it, shape (k,)."""
    drop: float
    """Height of the cameras above it, median."""
    spread: float
    """Robust standard deviation of the drops of its points."""
    reach: float
    """Largest offset of its points [drops]. At 1 they lie under the path, far beyond on verges."""

    @property
    def reliable(self) -> bool:
        return len(self.points) >= MIN_ROAD_POINTS and self.reach <= _REACHES[0]


@dataclass(frozen=True)
class Gravity:
    """Direction away from the ground."""

    direction: Array
    """Unit vector, shape (3,)."""
    uncertainty: float
    """One standard deviation of the angle [rad]."""
    source: str


def camera_up(camera_to_world: Array) -> Array:
    """Mean up axis of the cameras, unit vector, shape (3,)."""
    mean = -camera_to_world[:, :3, 1].mean(0)
    return mean / max(float(np.linalg.norm(mean)), 1e-12)


def up_from_path(camera_to_world: Array) -> tuple[Array, Array]:
    """What the cameras alone say of up: `evidence` of their right axes and of their path.

    Returns:
        Up, unit vector, shape (3,), and the evidence: a 3×3 matrix E such that n·E·n is the squared error of an up
        vector n in standard deviations.
    """
    right = camera_to_world[:, :3, 0]
    evidence = right.T @ right / len(right) / _SIGMA_RIGHT**2
    centres = camera_to_world[:, :3, 3] - camera_to_world[:, :3, 3].mean(0)
    variances, axes = np.linalg.eigh(centres.T @ centres / len(centres))
    undulation = max(variances[0], _UNDULATION**2 * variances[2])
    for variance, axis in zip(variances[1:], axes.T[1:], strict=True):
        if variance > max(_CONDITION * variances[0], _WIDTH**2 * variances[2]):
            sigma2 = undulation / (_PATH_SAMPLES * variance) + _SIGMA_PATH**2
            evidence += np.outer(axis, axis) / sigma2
    return _solve(evidence, camera_up(camera_to_world))[0], evidence


def _solve(evidence: Array, roughly: Array) -> tuple[Array, float]:
    """The unit vector of least error and the standard deviation of its angle [rad]."""
    # Weak prior: cameras are pitched by 10° and more, so their mean up counts only where nothing else does.
    prior = (np.eye(3) - np.outer(roughly, roughly)) / np.radians(15.0) ** 2
    values, vectors = np.linalg.eigh(evidence + prior)
    up = vectors[:, 0] * (1.0 if vectors[:, 0] @ roughly >= 0 else -1.0)
    return up, float(np.sqrt(np.sum(1.0 / np.maximum(values[1:] - values[0], 1e-12))))


def below_path(points: Array, centres: Array, up: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Nearest camera of each point (seen from above), and its drop below and offset from that camera, shapes (m,)."""
    flat = np.eye(3) - np.outer(up, up)
    offset, nearest = cKDTree(centres @ flat).query(points @ flat)
    return nearest, (centres[nearest] - points) @ up, offset


def find_road(points: Array, centres: Array, up: Array) -> Road | None:
    """The lowest well-supported layer of points under a path; None where nothing lies below it.

    A layer at drop h counts the points within ±6 % of h whose offset is below h: near the path the road is below 45°,
    whatever the scale. Among layers with at least half of the best support the lowest is the road, since nothing
    solid lies below a road; with many points below it there is none (a camera led around an object). A road without
    texture has no points; then the layer is looked for ever further beside the path, where its verges are, and the
    best supported of these is taken if none has enough points.
    """
    if not len(points):
        return None
    _, drop, offset = below_path(points, centres, up)
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
    inside = (np.abs(drops - layers[:, None]) < _LAYER * layers[:, None]) & (offsets < reach * layers[:, None])
    support = inside.sum(1)
    height = float(layers[np.flatnonzero(support >= 0.5 * support.max())[-1]])
    for _ in range(5):  # centre the layer on its median
        chosen = (np.abs(drops - height) < _LAYER * height) & (offsets < reach * height)
        if not chosen.any():
            return None
        height = float(np.median(drops[chosen]))
    chosen = (np.abs(drops - height) < _LAYER * height) & (offsets < reach * height)
    deeper = np.count_nonzero((drops > _DEEPER * height) & (offsets < reach * height))
    if deeper > _MAX_DEEPER * chosen.sum():
        return None
    spread = 1.4826 * float(np.median(np.abs(drops[chosen] - height)))
    return Road(below[chosen], height, spread, reach)


def up_from_ground(camera_to_world: Array, points: Array) -> tuple[Gravity, Road | None]:
    """Up by all three witnesses, and the road under the path.

    Args:
        camera_to_world: Poses of all frames, shape (n, 4, 4).
        points: Sparse points, shape (m, 3).
    """
    roughly = camera_up(camera_to_world)
    centres = camera_to_world[:, :3, 3]
    up, evidence = up_from_path(camera_to_world)
    road = find_road(points, centres, up)
    witnesses = ["path and cameras"]
    if road is not None and road.reliable:
        normal = _road_normal(points[road.points], centres, up)
        if normal is not None and np.arccos(np.clip(normal @ roughly, -1, 1)) < _MAX_TILT:
            evidence = evidence + (np.eye(3) - np.outer(normal, normal)) / _SIGMA_ROAD**2
            witnesses.append("road")
    up, sigma = _solve(evidence, roughly)
    return Gravity(up, sigma, " + ".join(witnesses)), find_road(points, centres, up)


def _road_normal(road: Array, centres: Array, up: Array) -> Array | None:
    """Mean normal of the road beneath the path: each point relative to the camera above it, so that a road that climbs
    as its cameras do counts as level. None where the points lie on a line."""
    nearest, _, _ = below_path(road, centres, up)
    local = road - centres[nearest]
    local = local - np.median(local, axis=0)
    weight = np.ones(len(local))
    for _ in range(10):  # iteratively reweighted total least squares, Huber-like
        variances, axes = np.linalg.eigh((local * weight[:, None]).T @ local / weight.sum())
        residual = np.abs(local @ axes[:, 0])
        weight = 1.0 / np.maximum(residual, 1.4826 * np.median(residual) + 1e-12)
    if variances[1] < _CONDITION * variances[0]:
        return None
    normal = axes[:, 0]
    return normal if normal @ up > 0 else -normal


def heights_above_road(points: Array, centres: Array, up: Array, drop: float, least: int = 6) -> Array | None:
    """Height of each camera over the road points around its own foot; NaN where fewer than `least` lie there, None
    where that leaves fewer than a fifth of the cameras.

    Args:
        points: Road points, shape (k, 3).
        centres: Camera centres, shape (n, 3).
        up: Unit vector.
        drop: Typical height; points within this horizontal distance count.
        least: Points needed per camera.
    """
    flat = np.eye(3) - np.outer(up, up)
    tree = cKDTree(points @ flat)
    heights = np.full(len(centres), np.nan)
    for i, near in enumerate(tree.query_ball_point(centres @ flat, drop)):
        if len(near) >= least:
            heights[i] = float(np.median((centres[i] - points[near]) @ up))
    return heights if np.isfinite(heights).sum() >= max(3, _MIN_SHARE * len(centres)) else None
