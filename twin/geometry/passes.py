"""Passes: the smoothed segments of a filmed path that a robot can drive without interruption.

A filming camera may go down a road twice, come back in the other lane, stop or back up; a film may be cut. The path is
divided at *jumps* (a cut, or frames that lie far apart), at *turns* (the camera comes back the way it came) and at
*laps* (it goes the same way again). Each part between them is a *pass*, named `<source>:<number>`.
`twin/geometry/route.py` chooses the route from the passes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from twin.geometry.cameras import Cameras
from twin.geometry.poses import rotation_angle
from twin.types import Array

SPACING = 0.25  # [m] between the points of a path
_SMOOTHING = 0.5  # [m] standard deviation of the smoothing, which moves a turn of radius 5 m by 0.5²/(2·5) = 2.5 cm
_STATIONARY_RADIUS = 0.4  # [m] motion within this radius counts as standing still
_DEPARTURE_RADIUS = 1.6  # [m] beyond this radius the camera has left, and a later return is another pass
_JUMP_RATIO = 8.0  # [typical steps] least length of a jump; uneven timing and sudden starts cause at most 4
_MIN_JUMP = 5.0  # [m] least length of a jump
_LONG_JUMP, _LONG_RATIO = 12.0, 3.0  # [m], [typical steps]; a step longer than both is a jump in any case
_JUMP_WINDOW = 4  # number of steps before and after a step that determine its typical step
_MAX_MISSING = 20.0  # [frame intervals] longer gaps in time do not raise the allowed step further
_BESIDE = 5.0  # [m] a path this close to an earlier part of itself retraces it; a U-turn of 6 m radius is 12 m wide
_ALONGSIDE = 0.5  # [m] largest offset along the path between a point and the earlier one that it retraces
_PARALLEL = np.cos(np.deg2rad(40.0))  # cosine of the greatest angle between a path and the part that it retraces
_MIN_RETRACE = 1.5  # [m] shorter retraces are noise
_MIN_LAP = 12.0  # [m] least length of a lap
_MAX_U_TURN = 25.0  # [m] a longer turn is a loop at the end of the road and stays in the pass
_MIN_PASS = 1.0  # [m] shorter passes are dropped
_CHORD = 1.0  # [m] length over which headings are measured
_MIN_PATH_FRAMES = 6
_MAX_OUTLIER_FRACTION = 0.25  # if more frames of a path look wrong, the path is not smooth and no frame is removed
_MAX_ROUGHNESS = 0.3  # [median steps] a larger median residual means unordered photos rather than a film
_OUTLIER_SIGMAS = 8.0  # an outlier's residual exceeds this many robust standard deviations of all residuals
_MAX_TURN = np.radians(5.0)  # [rad] smaller deviations from the predicted direction are always allowed


@dataclass(frozen=True)
class FilmedPass:
    """One pass of one source."""

    name: str  # `<source>:<number>`, numbered from 1 in order of time
    source: str
    lighting: str
    frames: NDArray[np.int64]  # indices into the cameras, in order of time
    path: Array  # points `SPACING` apart, shape (m, 2) [m]; reversed in time if the camera looked backward
    ends_with: str  # reason why the pass ends: `end` (of the film), `jump`, `turn` or `lap`

    @property
    def length(self) -> float:
        return path_length(self.path)


def find_passes(cameras: Cameras) -> list[FilmedPass]:
    """All passes, sorted by source in order of appearance, then by time."""
    found = []
    for index in source_frames(cameras):
        number = 0
        for piece, ending in _between_jumps(cameras, index):
            for frames, path, ends_with in _between_retraces(cameras.positions, piece, ending):
                if path_length(path) < _MIN_PASS:
                    continue
                number += 1
                first = int(frames[0])
                if _looks_back(cameras.camera_to_world[frames], path):
                    path = path[::-1]
                source, lighting = cameras.sources[first], cameras.lightings[first]
                found.append(FilmedPass(f"{source}:{number}", source, lighting, frames, path, ends_with))
    return found


def source_frames(cameras: Cameras) -> list[NDArray[np.int64]]:
    """Frame indices of each source in order of time, sources in order of appearance."""
    sources = np.array(cameras.sources)
    frames = []
    for name in dict.fromkeys(cameras.sources):
        index = np.flatnonzero(sources == name)
        frames.append(index[np.argsort(cameras.times[index], kind="stable")])
    return frames


# ---- division


def path_jumps(positions: Array, times: Array, min_jump: float = _MIN_JUMP) -> NDArray[np.int64]:
    """Finds steps much longer than the typical step of a path, as between two passes filmed one after the other.

    A step is a jump if it is longer than both 5 m and 8 typical steps of its neighborhood (more where frames are
    missing), or longer than both 12 m and 3 typical steps. Takes camera centers (n, d) [m] in order of time, with times
    [s] or indices (n,); returns the indices i of jumps from i to i + 1. `min_jump` replaces the 5 m.
    """
    if len(positions) < 3:
        return np.zeros(0, np.int64)
    step = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    gap = np.diff(times)
    intervals = np.clip(gap / max(float(np.median(gap)), 1e-9), 1.0, _MAX_MISSING)  # frame intervals per step
    pace = step / intervals
    typical = np.full(len(step), np.median(pace))
    for i in range(len(step)):
        neighbors = np.concatenate([pace[max(i - _JUMP_WINDOW, 0) : i], pace[i + 1 : i + 1 + _JUMP_WINDOW]])
        # The upper quartile ignores neighbors at which the camera stands or is slow.
        typical[i] = max(typical[i], float(np.quantile(neighbors, 0.75)))
    relative = (step > min_jump) & (step > typical * np.maximum(_JUMP_RATIO, 2.0 * intervals))
    return np.flatnonzero(relative | ((step > _LONG_JUMP) & (step > _LONG_RATIO * typical)))


def _between_jumps(cameras: Cameras, index: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], str]]:
    """The parts of a source between its jumps: frames of each part, and the reason why the part ends."""
    inliers = index[path_inliers(cameras.positions[index])]
    jumps = path_jumps(cameras.positions[inliers, :2], cameras.times[inliers])
    # Outliers are removed before the division, since an outlier at the end of a part could not be recognized: it
    # has neighbors on one side only.
    pieces = np.split(inliers, jumps + 1) if len(jumps) else [index]
    return [(piece, "jump" if k < len(jumps) else "end") for k, piece in enumerate(pieces)]


def _between_retraces(
    positions: Array, frames: NDArray[np.int64], ending: str
) -> list[tuple[NDArray[np.int64], Array, str]]:
    """Divides a part without jumps at turns and laps; returns frames, path and reason for the end of each pass."""
    path = smooth_path(positions[frames])
    cuts = _retraces(path)
    if not cuts:
        return [(frames, path, ending)]
    # Frames are assigned to passes by their arc length along the path; frames of a turn belong to no pass.
    station = _frame_stations(positions[frames, :2], path)
    spacing = path_length(path) / (len(path) - 1)
    out, start = [], 0
    for end, following, kind in [*cuts, (len(path) - 1, 0, ending)]:
        mine = frames[(station >= (start - 0.5) * spacing) & (station <= (end + 0.5) * spacing)]
        if end > start and len(mine):
            out.append((mine, path[start : end + 1], kind))
        start = following
    return out


def _retraces(path: Array) -> list[tuple[int, int, str]]:
    """Cuts where a path begins to retrace itself.

    A cut has the index of the pass's last point, the index of the next pass's first point, and `turn` or `lap`.
    """
    if len(path) < 3:
        return []
    direction = path_directions(path)
    near = cKDTree(path).query_ball_point(path, _BESIDE)
    need = round(_MIN_RETRACE / SPACING)
    cuts: list[tuple[int, int, str]] = []
    begin, run = 0, list[tuple[int, int, str]]()
    for i in range(len(path)):
        earlier = np.array([j for j in near[i] if begin <= j < i], int)
        # Keep points of the path beside point i, neither ahead of it nor behind.
        earlier = earlier[np.abs((path[earlier] - path[i]) @ direction[i]) <= _ALONGSIDE]
        cosine = direction[earlier] @ direction[i]
        back = earlier[cosine < -_PARALLEL]
        again = earlier[(cosine > _PARALLEL) & ((i - earlier) * SPACING > _MIN_LAP)]
        if not len(back) and not len(again):
            run = []
            continue
        kind = "turn" if len(back) else "lap"
        partners = back if len(back) else again
        j = int(partners[np.argmin(np.linalg.norm(path[partners] - path[i], axis=1))])
        run = [*run, (j, i, kind)] if not run or run[-1][2] == kind else [(j, i, kind)]
        if len(run) < need:
            continue
        j, first, kind = run[0]
        short_turn = kind == "turn" and (first - j) * SPACING <= _MAX_U_TURN
        cuts.append((j if short_turn else first, first, kind))
        begin, run = first, []
    return cuts


def _frame_stations(xy: Array, path: Array) -> Array:
    """Arc length [m] of frames (n, 2) along their own path; it never decreases, even where the path crosses itself."""
    total = path_length(path)
    kept = moving(xy)
    raw = path_stations(xy[kept])
    return np.interp(np.arange(len(xy)), kept, raw * (total / max(float(raw[-1]), 1e-9)))


def _looks_back(camera_to_world: Array, path: Array) -> bool:
    """True if cameras (n, 4, 4) look against the direction in which they moved."""
    direction = path_directions(path)
    _, nearest = cKDTree(path).query(camera_to_world[:, :2, 3])
    return float(np.mean((camera_to_world[:, :2, 2] * direction[nearest]).sum(1))) < -0.5


# ---- paths


def smooth_path(positions: Array) -> Array:
    """Path (m, 2) along camera centers (n, 3) in order of time, with points `SPACING` apart.

    If the camera stands still, the path is one point, shape (1, 2).
    """
    xy = positions[path_inliers(positions)][:, :2]
    xy = xy[moving(xy)]
    if len(xy) < 2:
        return xy[:1]
    dense = resample(xy, curved=len(xy) > 4)
    return resample(_smooth(dense, _SMOOTHING / SPACING), curved=False)


def path_inliers(positions: Array) -> NDArray[np.bool_]:
    """Mask (n,) of the camera centers (n, 3) that agree with their neighbors in time; false for single outliers."""
    n = len(positions)
    if n < 5:
        return np.ones(n, bool)
    step = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    typical = np.stack([median_filter(positions[:, k], size=5, mode="nearest") for k in range(3)], -1)
    # A component-wise median lags by up to two steps along the path, also in a turn; 2.5 steps allow for that.
    return np.linalg.norm(positions - typical, axis=1) <= 2.5 * step + 0.3


def moving(xy: Array) -> list[int]:
    """Indices of the points of a path (n, 2), in order of time, that are kept when stops and jitter are removed.

    After each kept point, the points within `_STATIONARY_RADIUS` of it are skipped, up to the path's last exit from
    that disc. Points are kept if the path returns after it was more than `_DEPARTURE_RADIUS` away, as on another pass.
    """
    kept, i = [0], 0
    while True:
        distance = np.linalg.norm(xy[i:] - xy[i], axis=1)
        departed = np.flatnonzero(distance > _DEPARTURE_RADIUS)
        visit = distance[: departed[0] if len(departed) else len(distance)]
        i += int(np.flatnonzero(visit <= _STATIONARY_RADIUS)[-1]) + 1
        if i >= len(xy):
            return kept
        kept.append(i)


def path_stations(path: Array) -> Array:
    """Arc length [m] at each point of a polyline (m, d), shape (m,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def path_length(path: Array) -> float:
    """Length of a polyline (m, d) [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def path_directions(path: Array, chord: float = _CHORD) -> Array:
    """Unit direction of the chord around each point of a path, shape (m, 2)."""
    reach = max(round(chord / 2 / SPACING), 1)
    at = np.arange(len(path))
    along = path[np.minimum(at + reach, len(path) - 1)] - path[np.maximum(at - reach, 0)]
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def smooth_line(corners: Sequence[Array] | Array) -> Array:
    """A path (m, 2) along a polyline (n ≥ 2, 2), with corners rounded like those of a filmed path."""
    return resample(_smooth(resample(np.asarray(corners, float), curved=False), _SMOOTHING / SPACING), curved=False)


def resample(xy: Array, curved: bool) -> Array:
    """Points about `SPACING` apart along a polyline (n ≥ 2, 2) or, if `curved`, along a curve through its points."""
    station = path_stations(xy)
    # Equal steps close to the spacing, so that the last point is the end of the path.
    count = max(round(float(station[-1]) / SPACING), 1)
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
    """Mask (n,) of the frames that lie off the path of their neighbors, for poses (n, 4, 4) in any unit of length.

    `limit` is the allowed position residual [median distances between consecutive frames]; more is allowed if the whole
    path is rough. The path is divided where the film jumps, since frames before a cut do not predict those after it.
    """
    n = len(camera_to_world)
    if n < _MIN_PATH_FRAMES:
        return np.zeros(n, bool)
    step = float(np.median(np.linalg.norm(np.diff(camera_to_world[:, :3, 3], axis=0), axis=1)))
    centers = camera_to_world[:, :3, 3] / max(step, 1e-12)
    inliers = np.flatnonzero(path_inliers(centers))
    cuts = inliers[path_jumps(centers[inliers], inliers.astype(float), min_jump=0.0)] + 1
    return np.concatenate([_piece_outliers(piece, limit) for piece in np.split(camera_to_world, cuts)])


def _piece_outliers(camera_to_world: Array, limit: float) -> NDArray[np.bool_]:
    """Outliers of a path without jumps, found one by one, the worst first.

    Finds none in fewer than 6 frames or in a path that is not smooth.
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
        # An outlier also spoils its neighbors' predictions. So the worst frame and its neighbors are candidates. The
        # candidate is removed whose removal makes the other frames agree best.
        candidates = [k for k in range(max(worst - 2, 0), min(worst + 3, len(kept))) if score[k] > 0.5]
        out[kept[min(candidates, key=lambda k: _score_without(camera_to_world[kept], k, max_offset, max_turn))]] = True
        if out.sum() > _MAX_OUTLIER_FRACTION * n:
            return np.zeros(n, bool)


def _path_residuals(camera_to_world: Array) -> tuple[Array, Array]:
    """Deviation of each frame from the pose predicted from its neighbors, for poses in order of time (n, 4, 4), n ≥ 5.

    A position has two predictions, and the smaller residual counts: the chord between neighbors fails in turns; the
    cubic through neighbors follows turns, but fails where the speed changes.
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
