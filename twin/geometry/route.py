"""The filmed path and the route derived from it.

The *path* is the sequence of camera centers (x, y, z) in driving order. The *route* is the path seen from above (x, y),
without outliers, stops and rocking, smoothed, with points every `SPACING` meters. *Station* [m] is the arc length along
it. The *corridor* is the area within a half width of the route; it is free, since the camera passed through it.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.spatial.transform import Rotation, Slerp

from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.poses import rotation_angle
from twin.types import Array

SPACING = 0.25  # [m]
_SMOOTHING = 0.5  # [m] standard deviation; moves a 5 m turn by 0.5²/(2·5) = 2.5 cm
_STATIONARY_RADIUS = 0.4  # [m] motion within this is standing or rocking
_DEPARTURE_RADIUS = 1.6  # [m] beyond this the camera has left: a later return is a second pass, as in a round trip
_MIN_LENGTH = 2.0  # [m]
_JUMP_RATIO = 8.0  # times the typical step; uneven frame intervals and sudden starts stay below 4
_MIN_JUMP = 5.0  # [m]
_JUMP_WINDOW = 4  # steps before and after from which the typical step is computed
_MAX_MISSING = 20.0  # frames in a row; longer gaps in time do not raise the allowed step further
_MIN_PATH_FRAMES = 6
_MAX_OUTLIER_FRACTION = 0.25  # if more frames of a source look wrong, its path is not smooth and no frame is removed
_MAX_ROUGHNESS = 0.3  # a path with a larger median residual [median steps] is a set of unordered photos, not a film
_OUTLIER_SIGMAS = 8.0  # an outlier's residual exceeds this many robust standard deviations of all residuals
_MAX_TURN = np.radians(5.0)  # [rad] smallest allowed deviation from the predicted direction


def filmed_route(cameras: Cameras) -> Array:
    """The route of the longest source (the first of those within 2 % of it), shape (m, 2) [m].

    Raises InputError: the route is shorter than 2 m, or its path jumps.
    """
    route, length, index = _longest_route(cameras)
    if length < _MIN_LENGTH:
        raise InputError(
            f"the filmed path is {length:.2f} m long, expected at least {_MIN_LENGTH:g} m; "
            "film a drive, correct [metric], or set mjcf.route = false"
        )
    _check_source_jumps(cameras, index)
    return route


def check_no_jumps(cameras: Cameras) -> None:
    """Raises InputError if the path of the route jumps, see `path_jumps`; a path too short for a route passes."""
    _, length, index = _longest_route(cameras)
    if length >= _MIN_LENGTH:
        _check_source_jumps(cameras, index)


def _longest_route(cameras: Cameras) -> tuple[Array, float, NDArray[np.int64]]:
    """The first route within 2 % of the longest, the longest length [m], and the route's frames in order of time."""
    frames = source_frames(cameras)
    routes = [smooth_route(cameras.positions[index]) for index in frames]
    if not routes:
        return np.zeros((0, 2)), 0.0, np.zeros(0, np.int64)
    lengths = np.array([route_length(route) for route in routes])
    chosen = int(np.argmax(lengths >= 0.98 * lengths.max()))
    return routes[chosen], float(lengths.max()), frames[chosen]


def path_jumps(positions: Array, times: Array) -> NDArray[np.int64]:
    """Finds steps much longer than the typical step of a path, as between two passes filmed one after the other.

    A jump is longer than 5 m and than 8 typical steps of its neighborhood, allowing for missing frames. Takes camera
    centers (n, 3) [m] in order of time, with times [s] or indices (n,); returns the indices i of jumps from i to i + 1.
    """
    if len(positions) < 3:
        return np.zeros(0, np.int64)
    step = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    gap = np.diff(times)
    intervals = np.clip(gap / max(float(np.median(gap)), 1e-9), 1.0, _MAX_MISSING)  # frame intervals per step
    pace = step / intervals
    typical = np.full(len(step), np.median(pace))
    for i in range(len(step)):
        neighbors = np.concatenate([pace[max(i - _JUMP_WINDOW, 0) : i], pace[i + 1 : i + 1 + _JUMP_WINDOW]])
        # The upper quartile, since a film may start, stop and speed up at any frame.
        typical[i] = max(typical[i], float(np.quantile(neighbors, 0.75)))
    return np.flatnonzero((step > _MIN_JUMP) & (step > typical * np.maximum(_JUMP_RATIO, 2.0 * intervals)))


def _check_source_jumps(cameras: Cameras, index: NDArray[np.int64]) -> None:
    """Raises InputError if the path of a source jumps; `index` has its frames in order of time."""
    index = index[path_inliers(cameras.positions[index])]
    xy, times = cameras.positions[index, :2], cameras.times[index]
    jumps = path_jumps(cameras.positions[index], times)
    if not len(jumps):
        return
    first = int(jumps[0])
    length = float(np.linalg.norm(xy[first + 1] - xy[first]))
    starts, ends = [0, *(int(k) + 1 for k in jumps)], [*(int(k) for k in jumps), len(index) - 1]
    passes = list(zip(starts, ends, strict=True))
    a, b = max(passes, key=lambda ends: route_length(xy[ends[0] : ends[1] + 1]))
    keep = f"[[{math.floor(100 * times[a]) / 100:g}, {math.ceil(100 * times[b]) / 100:g}]]"
    raise InputError(
        f"the filmed path jumps {length:.1f} m from frame {cameras.names[index[first]]} to "
        f"{cameras.names[index[first + 1]]}: a route is one pass without cuts; choose a pass, for the longest write "
        f"keep = {keep} [s] under [capture], or under its [[source]] where there are several; put photos of one pass "
        "into a folder of their own; or set mjcf.route = false"
    )


def source_frames(cameras: Cameras) -> list[NDArray[np.int64]]:
    """Frame indices of each source in order of time, sources in order of appearance."""
    sources = np.array(cameras.sources)
    frames = []
    for name in dict.fromkeys(cameras.sources):
        index = np.flatnonzero(sources == name)
        frames.append(index[np.argsort(cameras.times[index], kind="stable")])
    return frames


def smooth_route(positions: Array) -> Array:
    """Route (m, 2) with points `SPACING` apart from camera centers in order of time (n, 3); (1, 2) if standing."""
    xy = remove_stationary(positions[path_inliers(positions)][:, :2])
    if len(xy) < 2:
        return xy[:1]
    dense = _resample(xy, SPACING, curved=len(xy) > 4)
    return _resample(_smooth(dense, _SMOOTHING / SPACING), SPACING, curved=False)


def path_inliers(positions: Array) -> NDArray[np.bool_]:
    """Mask (n,) of the camera centers (n, 3) that agree with their neighbors in time; false for single outliers."""
    n = len(positions)
    if n < 5:
        return np.ones(n, bool)
    step = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    typical = np.stack([median_filter(positions[:, k], size=5, mode="nearest") for k in range(3)], -1)
    # A component-wise median lags by up to two steps along the path, also in a turn; 2.5 steps allow for that.
    return np.linalg.norm(positions - typical, axis=1) <= 2.5 * step + 0.3


def remove_stationary(xy: Array) -> Array:
    """Removes stops and rocking from a path in order of time, (n, 2) → (k, 2).

    The point kept after each kept point is the first one past the path's last exit from a disc of radius
    `_STATIONARY_RADIUS` around it. Returns after the path was `_DEPARTURE_RADIUS` away are another pass and are kept.
    """
    kept, i = [0], 0
    while True:
        distance = np.linalg.norm(xy[i:] - xy[i], axis=1)
        departed = np.flatnonzero(distance > _DEPARTURE_RADIUS)
        visit = distance[: departed[0] if len(departed) else len(distance)]
        i += int(np.flatnonzero(visit <= _STATIONARY_RADIUS)[-1]) + 1
        if i >= len(xy):
            return xy[kept]
        kept.append(i)


def route_length(route: Array) -> float:
    """Length of a polyline (m, 2) [m]."""
    return float(np.linalg.norm(np.diff(route, axis=0), axis=1).sum())


def distance_to_route(route: Array, xy: Array) -> Array:
    """Distance [m] of points (..., 2) to a polyline (m, 2) including its end points, shape (...)."""
    if len(route) < 2:
        return np.linalg.norm(xy - route[0], axis=-1)
    best = np.full(np.shape(xy)[:-1], np.inf)
    for start, end in pairwise(route):
        along = end - start
        fraction = np.clip((xy - start) @ along / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(xy - start - fraction[..., None] * along, axis=-1))
    return best


def _resample(xy: Array, spacing: float, curved: bool) -> Array:
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    # Equal steps close to the spacing, so that the last point is the end of the path.
    count = max(round(float(station[-1]) / spacing), 1)
    at = np.linspace(0.0, station[-1], count + 1)
    if curved:
        return Akima1DInterpolator(station, xy, axis=0)(at)
    return np.stack([np.interp(at, station, xy[:, k]) for k in range(2)], -1)


def _smooth(xy: Array, sigma: float) -> Array:
    """Gaussian smoothing along a polyline; odd extension keeps straight ends straight and end points in place."""
    reach = min(int(4 * sigma) + 1, len(xy) - 1)
    before = 2 * xy[0] - xy[reach:0:-1]
    after = 2 * xy[-1] - xy[-2 : -reach - 2 : -1]
    return gaussian_filter1d(np.concatenate([before, xy, after]), sigma, axis=0)[reach : reach + len(xy)]


# ---- poses off the path


def path_outliers(camera_to_world: Array, limit: float) -> NDArray[np.bool_]:
    """Mask (n,) of the frames off the path of their neighbors, found one by one, the worst first.

    All false for fewer than 6 frames or a path that is not smooth. `limit` is the allowed position residual [median
    steps between frames]; more is allowed if the whole path is rough.
    """
    n = len(camera_to_world)
    out = np.zeros(n, bool)
    if n < _MIN_PATH_FRAMES:
        return out
    step = float(np.median(np.linalg.norm(np.diff(camera_to_world[:, :3, 3], axis=0), axis=1)))
    position, turn = _path_residuals(camera_to_world)
    if np.median(position) > _MAX_ROUGHNESS * step:
        return out
    max_offset = max(limit * step, _OUTLIER_SIGMAS * (1.4826 * float(np.median(position))), 1e-12)
    max_turn = max(_MAX_TURN, _OUTLIER_SIGMAS * (1.4826 * float(np.median(turn))))
    while True:
        kept = np.flatnonzero(~out)
        if len(kept) < _MIN_PATH_FRAMES:
            return np.zeros(n, bool)
        position, turn = _path_residuals(camera_to_world[kept])
        score = np.maximum(position / max_offset, turn / max_turn)
        worst = int(np.argmax(score))
        if score[worst] <= 1.0:
            return out
        # An outlier also spoils its neighbors' predictions: the frame is removed without which the others agree best.
        candidates = [k for k in range(max(worst - 2, 0), min(worst + 3, len(kept))) if score[k] > 0.5]
        out[kept[min(candidates, key=lambda k: _score_without(camera_to_world[kept], k, max_offset, max_turn))]] = True
        if out.sum() > _MAX_OUTLIER_FRACTION * n:
            return np.zeros(n, bool)


def _path_residuals(camera_to_world: Array) -> tuple[Array, Array]:
    """Deviation of each frame from the pose predicted from its neighbors, for poses in order of time (n, 4, 4), n ≥ 5.

    The smaller of two predictions' residuals counts, since either alone fails on correct frames: the chord between
    neighbors is independent of the speed but cuts corners; the cubic through them follows turns but needs even steps.
    Returns residuals of position (unit of the poses) and direction [rad], shapes (n,).
    """
    n = len(camera_to_world)
    centers = camera_to_world[:, :3, 3]
    rotations = Rotation.from_matrix(camera_to_world[:, :3, :3])
    position, turn = np.zeros(n), np.zeros(n)
    for i in range(n):
        left, right = [k for k in (i - 1, i - 2) if k >= 0], [k for k in (i + 1, i + 2) if k < n]
        if left and right:
            chords = [_segment_distance(centers[i], centers[a], centers[b]) for a in left for b in right]
            position[i] = float(np.median(chords))
            if len(left) == len(right) == 2:  # Lagrange's cubic at the middle of five equidistant frames
                a2, a1, b1, b2 = centers[left[1]], centers[left[0]], centers[right[0]], centers[right[1]]
                cubic = (4.0 * (a1 + b1) - (a2 + b2)) / 6.0
                position[i] = min(position[i], float(np.linalg.norm(centers[i] - cubic)))
            middle = [Slerp([a, b], Rotation.concatenate([rotations[a], rotations[b]]))(i) for a in left for b in right]
            turn[i] = min(_angle(m, rotations[i]) for m in middle)
        else:  # an end of the path: extrapolate the next two frames
            near, far = (right or left)[0], (right or left)[1]
            step = centers[near] - centers[far]
            position[i] = _segment_distance(centers[i], centers[near], centers[near] + 2.5 * step)
            extrapolated = rotations[near] * rotations[far].inv() * rotations[near]
            turn[i] = min(_angle(extrapolated, rotations[i]), _angle(rotations[near], rotations[i]))
    return position, turn


def _angle(a: Rotation, b: Rotation) -> float:
    return float(rotation_angle((a.inv() * b).as_matrix()))


def _segment_distance(point: Array, start: Array, end: Array) -> float:
    along = end - start
    fraction = np.clip((point - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(point - start - fraction * along))


def _score_without(poses: Array, k: int, max_offset: float, max_turn: float) -> float:
    lo, hi = max(k - 5, 0), min(k + 6, len(poses))
    local = np.delete(poses[lo:hi], k - lo, axis=0)
    if len(local) < 3:
        return np.inf
    position, turn = _path_residuals(local)
    return float(np.sum(np.maximum(position / max_offset, turn / max_turn)))
