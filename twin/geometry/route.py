"""The route: the line that the robot drives, chosen from the filmed passes.

By default, passes of the same lighting that continue each other are joined, and the longest line so formed is the
route; `[route]` in scene.toml chooses passes, their direction, or way points. *Station* [m] is the arc length along the
route. `passes.py` smooths the filmed paths. The *corridor* is the area within a half width of the route; it is free,
since the camera passed through it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from twin.config import BranchConfig, RouteConfig
from twin.errors import InputError, short_repr
from twin.geometry.cameras import Cameras
from twin.geometry.passes import SPACING, FilmedPass, find_passes, path_directions, path_length, resample, smooth_line
from twin.types import Array

BRANCH = "branch."  # prefix of the branches' names in `route.npz`, the file of the route
_MIN_LENGTH = 2.0  # [m] least length of a route
_AS_LONG = 0.98  # lines longer than this fraction of the longest count as equally long, so that noise does not decide
_ASIDE = 0.6  # [m] largest lateral offset between a pass and its continuation; the joined line runs midway
_BEYOND = 3.0  # [m] least length that a continuation adds
_AGREE = np.cos(np.deg2rad(40.0))  # least cosine between the headings of joined passes
_BLEND = 3.0  # [m] length before and after a join over which the joined line changes from one pass to the other
_MAX_FOLD = np.cos(np.deg2rad(120.0))  # cosine of the greatest change of heading over `_FOLD_CHORD`
_FOLD_CHORD = 2.0  # [m] length along the line between the headings that are compared
_STRETCH = 40  # number of segments of a long route whose distances are computed together
_OFF_FILM = 1.0  # [m] largest distance of a line through way points from the filmed paths


@dataclass(frozen=True)
class Route:
    """A drivable line and the passes that it was chosen from."""

    line: Array  # points about 0.25 m apart in driving order, shape (m, 2) [m]
    chosen: tuple[str, ...]  # names of these passes in driving order; empty if way points were given
    passes: tuple[FilmedPass, ...]  # all filmed passes, chosen or not


def filmed_branches(cameras: Cameras, branches: tuple[BranchConfig, ...]) -> dict[str, Array]:
    """Lines of other routes through the place by name, as `Route.line`. Raises InputError as `filmed_route` does."""
    return {one.name: filmed_route(cameras, one, f"[[branch]] {one.name!r}").line for one in branches}


def filmed_route(cameras: Cameras, config: RouteConfig | None = None, table: str = "route") -> Route:
    """Chooses the route among the filmed passes; error messages name `table` of scene.toml.

    Raises InputError: the route is shorter than 2 m or folds back on itself, passes that are to be joined lie apart, a
    pass has an unknown name, or way points leave what was filmed.
    """
    config = config or RouteConfig()
    passes = find_passes(cameras)
    if config.points:
        line, chosen = _through_points(config.points, passes, table), tuple[str, ...]()
    elif config.passes:
        picked = [_named(name, passes, table) for name in config.passes]
        line = picked[0].path
        for one in picked[1:]:
            line = _joined(line, one, config.max_gap, table)
        chosen = tuple(one.name for one in picked)
    else:
        line, chosen = _longest_line(passes, config.max_gap)
    length = path_length(line)
    if length < _MIN_LENGTH:
        raise InputError(
            f"the filmed path is {length:.2f} m long, expected at least {_MIN_LENGTH:g} m; "
            "film a drive, correct [metric], or set mjcf.route = false"
        )
    _check_no_fold(line, table)
    return Route(line[::-1] if config.reverse else line, chosen[::-1] if config.reverse else chosen, tuple(passes))


def route_metrics(route: Route) -> dict[str, object]:
    """All passes and the names of the chosen ones, as JSON."""
    passes = [
        {"name": one.name, "length_m": one.length, "frames": len(one.frames), "ends_with": one.ends_with}
        for one in route.passes
    ]
    return {"chosen": list(route.chosen), "passes": passes}


def _named(name: str, passes: list[FilmedPass], table: str) -> FilmedPass:
    """The pass with this name, or the longest pass of the source with this name."""
    fitting = [one for one in passes if name in (one.name, one.source)]
    if not fitting:
        known = ", ".join(f"{one.name} ({one.length:.1f} m)" for one in passes) or "none"
        raise InputError(f"{table}.passes: no pass {short_repr(name)}; expected one of {known}")
    return max(fitting, key=lambda one: one.length)


def _longest_line(passes: list[FilmedPass], max_gap: float) -> tuple[Array, tuple[str, ...]]:
    """The longest line of joined passes of one lighting that continue each other, and the names of these passes."""
    lines = []
    for start in passes:
        line, names = start.path, [start.name]
        while True:
            further = []
            for other in passes:
                if other.lighting == start.lighting and other.name not in names:
                    joined = _continued(line, other.path, max_gap)
                    if joined is not None and _new_length(line, joined) >= _BEYOND:
                        further.append((joined, other.name))
            if not further:
                break
            line, name = max(further, key=lambda one: path_length(one[0]))
            names.append(name)
        lines.append((line, tuple(names)))
    if not lines:
        return np.zeros((0, 2)), ()
    longest = max(path_length(line) for line, _ in lines)
    # Among lines about as long as the longest, the first with the fewest passes is chosen.
    fitting = [one for one in lines if path_length(one[0]) >= _AS_LONG * longest]
    return min(fitting, key=lambda one: len(one[1]))


def _continued(line: Array, path: Array, max_gap: float) -> Array | None:
    """A line extended by a path; None unless the path passes close to the line's end or starts ahead of it."""
    if len(line) < 3 or len(path) < 3:
        return None
    end, ahead = line[-1], path_directions(line)[-1]
    directions = path_directions(path)
    distance = np.linalg.norm(path - end, axis=1)
    distance[directions @ ahead < _AGREE] = np.inf
    k = int(np.argmin(distance))
    offset = path[k] - end
    along, aside = float(offset @ ahead), abs(float(ahead[0] * offset[1] - ahead[1] * offset[0]))
    starts_ahead = k == 0 and 0.0 < along <= max_gap and aside <= max(_ASIDE, 0.25 * along)
    if not (np.isfinite(distance[k]) and (distance[k] <= _ASIDE or starts_ahead)):
        return None
    return _blended(line, path[k:])


def _new_length(line: Array, joined: Array) -> float:
    """Length [m] that `joined` adds to a line; parts beside the line, such as a second lap, do not count."""
    distance, _ = cKDTree(line).query(joined)
    return float((distance > _ASIDE).sum()) * SPACING


def _joined(line: Array, one: FilmedPass, max_gap: float, table: str) -> Array:
    """A line extended by a pass that the user chose."""
    distance = np.linalg.norm(one.path - line[-1], axis=1)
    k = int(np.argmin(distance))
    if distance[k] > max_gap:
        raise InputError(
            f"{table}.passes: {one.name} is {distance[k]:.1f} m from the end of the pass before it, expected at most "
            f"{max_gap:g} m; choose passes that meet, or raise {table}.max_gap where the way between them is free"
        )
    return _blended(line, one.path[k:])


def _blended(line: Array, rest: Array) -> Array:
    """A line joined to its continuation: gradually if they run side by side, by a straight line across a gap."""
    offset = rest[0] - line[-1]
    if np.linalg.norm(offset) > _ASIDE:
        return resample(np.concatenate([line, rest]), curved=False)
    before, after = (min(round(_BLEND / SPACING), len(one)) for one in (line, rest))
    first = line[-before:] + np.linspace(0.0, 0.5, before)[:, None] * offset
    second = rest[:after] - np.linspace(0.5, 0.0, after)[:, None] * offset
    return resample(np.concatenate([line[:-before], first, second[1:], rest[after:]]), curved=False)


def _through_points(points: tuple[tuple[float, ...], ...], passes: list[FilmedPass], table: str) -> Array:
    line = smooth_line(np.array(points, float))
    off = np.min([np.full(len(line), np.inf), *(distance_to_route(one.path, line) for one in passes)], axis=0)
    worst = int(np.argmax(off))
    if off[worst] > _OFF_FILM:
        x, y = line[worst]
        raise InputError(
            f"{table}.points: at ({x:.1f}, {y:.1f}) the route is {off[worst]:.1f} m from the nearest filmed path, "
            f"expected at most {_OFF_FILM:g} m; set the points along what was filmed (the report has a map)"
        )
    return line


def _check_no_fold(line: Array, table: str) -> None:
    """Raises InputError: the line turns back on the spot, which the robot cannot drive."""
    directions, reach = path_directions(line), round(_FOLD_CHORD / SPACING)
    cosine = (directions[reach:] * directions[:-reach]).sum(1)
    if len(cosine) and cosine.min() < _MAX_FOLD:
        x, y = line[int(np.argmin(cosine)) + reach // 2]
        raise InputError(
            f"the route turns back at ({x:.1f}, {y:.1f}) within {_FOLD_CHORD:g} m; choose one pass, such as "
            f"{table}.passes = ['film:1']"
        )


def every_second(line: Array) -> Array:
    """Every second point of a polyline (m, 2), and its last one."""
    return line[::2] if len(line) % 2 else np.concatenate([line[::2], line[-1:]])


def distance_to_route(route: Array, xy: Array, up_to: float = np.inf) -> Array:
    """Distance [m] of points (..., 2) to a polyline (m, 2) including its end points, shape (...).

    Distances above `up_to` [m] may be overestimated, up to infinity; a low value saves time on long routes.
    """
    if len(route) < 2:
        return np.linalg.norm(xy - route[0], axis=-1)
    if up_to < np.inf:
        return _distance_up_to(route, xy, up_to)
    best = np.full(np.shape(xy)[:-1], np.inf)
    for start, end in pairwise(route):
        along = end - start
        fraction = np.clip((xy - start) @ along / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(xy - start - fraction[..., None] * along, axis=-1))
    return best


def _distance_up_to(route: Array, xy: Array, up_to: float) -> Array:
    """`distance_to_route` of the points that are near the route, and infinity for the others."""
    points = xy.reshape(-1, 2)
    best = np.full(len(points), np.inf)
    tree = cKDTree(points)
    for start in range(0, len(route) - 1, _STRETCH):
        part = route[start : start + _STRETCH + 1]
        middle = (part.min(0) + part.max(0)) / 2
        near = np.array(tree.query_ball_point(middle, np.linalg.norm(part - middle, axis=1).max() + up_to), int)
        best[near] = np.minimum(best[near], distance_to_route(part, points[near]))
    return best.reshape(np.shape(xy)[:-1])
