"""The filmed path as a line to drive.

The *path* is where the lens was, (x, y, z), in driving order. The *route* is the path seen from above, (x, y): without
outliers, standing parts and rocking to and fro, smoothed, with points every `SPACING` metres. *Station* [m] is the
length along it. The *corridor* is what lies within a half width of the route: the camera went through it, so it is
free.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d, median_filter

from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.types import Array

SPACING = 0.25  # [m]
_SMOOTHING = 0.5  # [m] standard deviation; moves a 5 m turn by 0.5²/(2·5) = 2.5 cm
_ROCKING = 0.4  # [m] returns within this are standing or rocking, not driving
_LEFT = 1.6  # [m] further away than this it has left for good: a round trip passes here again
_MIN_LENGTH = 2.0  # [m]
_JUMP = 8.0  # usual steps; frames of uneven slots and sudden starts stay below 4
_MIN_JUMP = 5.0  # [m]
_BESIDE = 4  # steps before and after that say what is usual
_MOST_LOST = 20.0  # frames in a row; a longer gap in time explains no longer step


def filmed_route(cameras: Cameras) -> Array:
    """The route of the longest source (the first of those within 2 % of it), shape (m, 2) [m].

    Raises:
        InputError: the cameras hardly moved, or the path jumps.
    """
    frames = source_frames(cameras)
    routes = [smooth_route(cameras.positions[index]) for index in frames]
    lengths = np.array([route_length(route) for route in routes])
    if not len(lengths) or lengths.max() < _MIN_LENGTH:
        longest = lengths.max() if len(lengths) else 0.0
        raise InputError(
            f"the filmed path is {longest:.2f} m long, expected at least {_MIN_LENGTH:g} m; "
            "film a drive, correct [metric], or set mjcf.route = false"
        )
    chosen = int(np.argmax(lengths >= 0.98 * lengths.max()))
    _refuse_jumps(cameras, frames[chosen])
    return routes[chosen]


def refuse_jumps(cameras: Cameras) -> None:
    """Refuses a film of several passes as early as its cameras are metric; a path too short for a route is let pass.

    Raises:
        InputError: the path that makes the route jumps, see `path_jumps`; names the frames.
    """
    frames = source_frames(cameras)
    lengths = np.array([route_length(smooth_route(cameras.positions[index])) for index in frames])
    if len(lengths) and lengths.max() >= _MIN_LENGTH:
        _refuse_jumps(cameras, frames[int(np.argmax(lengths >= 0.98 * lengths.max()))])


def path_jumps(positions: Array, times: Array) -> NDArray[np.int64]:
    """Where a path steps much further than it usually does: between two passes that were filmed one after the other.

    A step is usual where it is at most 8 of those before and after it, or less than 5 m. Frames that are missing in
    between lengthen it.

    Args:
        positions: Camera centres in order of time, shape (n, 3) [m].
        times: Of these [s], or the place of photos without a clock, shape (n,).

    Returns:
        Indices i such that the path jumps from i to i + 1, shape (k,).
    """
    if len(positions) < 3:
        return np.zeros(0, np.int64)
    step = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    wait = np.diff(times)
    lost = np.clip(wait / max(float(np.median(wait)), 1e-9), 1.0, _MOST_LOST)  # intervals that a step spans
    pace = step / lost
    usual = np.full(len(step), np.median(pace))
    for i in range(len(step)):
        beside = np.concatenate([pace[max(i - _BESIDE, 0) : i], pace[i + 1 : i + 1 + _BESIDE]])
        # An upper quartile, since a film may start, stop and speed up at any frame.
        usual[i] = max(usual[i], float(np.quantile(beside, 0.75)))
    return np.flatnonzero((step > _MIN_JUMP) & (step > usual * np.maximum(_JUMP, 2.0 * lost)))


def _refuse_jumps(cameras: Cameras, index: NDArray[np.int64]) -> None:
    """Refuses a source, given its frames in order of time, whose path jumps."""
    index = index[path_inliers(cameras.positions[index])]
    xy, times = cameras.positions[index, :2], cameras.times[index]
    jumps = path_jumps(cameras.positions[index], times)
    if not len(jumps):
        return
    first = int(jumps[0])
    metres = float(np.linalg.norm(xy[first + 1] - xy[first]))
    starts, ends = [0, *(int(k) + 1 for k in jumps)], [*(int(k) for k in jumps), len(index) - 1]
    passes = list(zip(starts, ends, strict=True))
    a, b = max(passes, key=lambda ends: route_length(xy[ends[0] : ends[1] + 1]))
    keep = f"[[{math.floor(100 * times[a]) / 100:g}, {math.ceil(100 * times[b]) / 100:g}]]"
    raise InputError(
        f"the filmed path jumps {metres:.1f} m from frame {cameras.names[index[first]]} to "
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
    """Camera centres in order of time (n, 3) → points of the route (m, 2), `SPACING` apart; (1, 2) if still."""
    xy = without_rocking(positions[path_inliers(positions)][:, :2])
    if len(xy) < 2:
        return xy[:1]
    dense = _resample(xy, SPACING, curved=len(xy) > 4)
    return _resample(_smooth(dense, _SMOOTHING / SPACING), SPACING, curved=False)


def path_inliers(positions: Array) -> NDArray[np.bool_]:
    """Which camera centres (n, 3) lie along the path: false where one jumps aside and its neighbours do not."""
    n = len(positions)
    if n < 5:
        return np.ones(n, bool)
    step = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    typical = np.stack([median_filter(positions[:, k], size=5, mode="nearest") for k in range(3)], -1)
    # A component-wise median lags by up to two steps along the path, also in a turn; aside of that it must agree.
    return np.linalg.norm(positions - typical, axis=1) <= 2.5 * step + 0.3


def without_rocking(xy: Array) -> Array:
    """Drops standing parts and short trips to and fro from a path in order of time, (n, 2) → (k, 2).

    From each kept point the walk goes on at the path's last exit from a disc of radius `_ROCKING` around it. Returns
    after it has been `_LEFT` away are another visit, as in a round trip, and stay.
    """
    kept, i = [0], 0
    while True:
        distance = np.linalg.norm(xy[i:] - xy[i], axis=1)
        gone = np.flatnonzero(distance > _LEFT)
        stay = distance[: gone[0] if len(gone) else len(distance)]
        i += int(np.flatnonzero(stay <= _ROCKING)[-1]) + 1
        if i >= len(xy):
            return xy[kept]
        kept.append(i)


def route_length(route: Array) -> float:
    """Length of a polyline (m, 2) [m]."""
    return float(np.linalg.norm(np.diff(route, axis=0), axis=1).sum())


def distance_to_route(route: Array, xy: Array) -> Array:
    """Distance [m] of points (..., 2) to a polyline (m, 2), shape (...); beyond its ends, to the ends."""
    if len(route) < 2:
        return np.linalg.norm(xy - route[0], axis=-1)
    best = np.full(np.shape(xy)[:-1], np.inf)
    for start, end in pairwise(route):
        along = end - start
        share = np.clip((xy - start) @ along / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(xy - start - share[..., None] * along, axis=-1))
    return best


def _resample(xy: Array, spacing: float, curved: bool) -> Array:
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    # Equal steps as near to the spacing as the length allows, so that the end of the path stays its end.
    count = max(round(float(station[-1]) / spacing), 1)
    at = np.linspace(0.0, station[-1], count + 1)
    if curved:
        return Akima1DInterpolator(station, xy, axis=0)(at)
    return np.stack([np.interp(at, station, xy[:, k]) for k in range(2)], -1)


def _smooth(xy: Array, sigma: float) -> Array:
    """Gaussian smoothing along the line; odd extension about the ends keeps straight ends straight and in place."""
    reach = min(int(4 * sigma) + 1, len(xy) - 1)
    before = 2 * xy[0] - xy[reach:0:-1]
    after = 2 * xy[-1] - xy[-2 : -reach - 2 : -1]
    return gaussian_filter1d(np.concatenate([before, xy, after]), sigma, axis=0)[reach : reach + len(xy)]
