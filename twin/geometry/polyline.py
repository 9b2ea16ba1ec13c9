"""Points, headings and nearest points of a polyline on the ground, such as a route.

*Arc length* s: distance along the line in the plane, 0 at its first point. *Cross-track error*: distance from the line
in the plane, positive to its left. *Heading*: angle from the x axis, positive towards y.
"""

import numpy as np

from twin.types import Array

_SEARCH_WINDOW = (1.0, 3.0)  # [m] the nearest point is searched this far behind and ahead of the previous one
_CHORD = 1.0  # [m] length of the chord whose direction is the heading of a route


def arc_lengths(route: Array) -> Array:
    """Arc length at each vertex of a route (m, ≥2), shape (m,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1))])


def point_at(route: Array, s: Array | float) -> Array:
    """Points (..., d) of a route (m, d) at arc lengths s (...) [m]; s is clamped to the route's ends."""
    knots = arc_lengths(route)
    return np.stack([np.interp(s, knots, route[:, k]) for k in range(route.shape[1])], -1)


def heading_at(route: Array, s: Array | float) -> Array:
    """Heading [rad] at arc lengths s [m], in the shape of s.

    It is the direction of a chord of length `_CHORD` around s; near an end of the route, it is that of the route's
    first or last chord of this length.
    """
    length = arc_lengths(route)[-1]
    window = min(_CHORD, length)
    middle = np.clip(s, window / 2, length - window / 2)
    chord = point_at(route[:, :2], middle + window / 2) - point_at(route[:, :2], middle - window / 2)
    return np.arctan2(chord[..., 1], chord[..., 0])


def nearest_on_route(route: Array, xy: Array, last: Array | float | None = None) -> tuple[Array, Array]:
    """Arc lengths of the points of the route nearest to `xy`, and cross-track errors [m], both of shape (...).

    Args:
        route: Shape (m, ≥2).
        xy: Shape (..., 2) [m].
        last: Arc lengths of the previous nearest points [m], a number or of shape (...). Only the route around them is
            searched (`_SEARCH_WINDOW`), since it may cross itself; the whole route by default.
    """
    knots, xy = arc_lengths(route), np.asarray(xy)
    low, high = (knots[0], knots[-1]) if last is None else (last - _SEARCH_WINDOW[0], last + _SEARCH_WINDOW[1])
    # Indices of the segments that overlap each range, padded to the largest number of segments in a range.
    first = np.broadcast_to(np.searchsorted(knots[1:], low), xy.shape[:-1])
    last = np.broadcast_to(np.searchsorted(knots[:-1], high, "right"), xy.shape[:-1])
    run = first[..., None] + np.arange(np.max(last - first, initial=1))
    inside, run = run < last[..., None], np.minimum(run, len(route) - 2)
    start, step = route[run, :2], np.diff(route[:, :2], axis=0)[run]
    offset = xy[..., None, :] - start
    length_2 = np.maximum((step**2).sum(-1), 1e-18)
    fraction = np.clip((offset * step).sum(-1) / length_2, 0.0, 1.0)
    residual = offset - fraction[..., None] * step
    best = np.argmin(np.where(inside, (residual**2).sum(-1), np.inf), -1)[..., None]
    cross = step[..., 0] * offset[..., 1] - step[..., 1] * offset[..., 0]
    distance = np.take_along_axis(np.linalg.norm(residual, axis=-1), best, -1)[..., 0]
    side = np.sign(np.take_along_axis(cross, best, -1)[..., 0])
    s = np.take_along_axis(knots[run] + fraction * np.sqrt(length_2), best, -1)[..., 0]
    return s, np.where(side < 0, -distance, distance)


def total_turn(route: Array) -> float:
    """Total change of heading along the route [rad], positive to the left; a full turn adds 2π."""
    s = np.append(np.arange(0.0, arc_lengths(route)[-1], 0.25), np.inf)
    heading = np.unwrap(heading_at(route, s))
    return float(heading[-1] - heading[0])


def corridor_edges(route: Array, half_width: float) -> tuple[Array, Array]:
    """Left and right edges of the corridor beside the vertices of the route, at their heights, shapes (m, 3)."""
    heading = heading_at(route, arc_lengths(route))
    normal = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1) * half_width
    return route + normal, route - normal
