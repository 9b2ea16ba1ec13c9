"""Which stretches of a scene's route are tasks.

A *stretch* is a piece of the route between two arc lengths. The *standard tasks* are those of DriveEnv-NeRF:
`straight` (30 m) and `right_turn` (60 m); they are looked for on the route. `[[task]]` entries of `scene.toml` name
further ones, and `route` is the whole of it.
"""

from dataclasses import dataclass

import numpy as np

from twin.config import TaskConfig
from twin.errors import InputError
from twin.mjcf.world import World, arc_lengths, heading_at
from twin.types import Array


@dataclass(frozen=True)
class RouteSegment:
    """What is driven in an episode."""

    name: str
    start: float
    """Arc length at which it begins [m]."""
    length: float
    """[m]"""

    @property
    def end(self) -> float:
        """Arc length at which it ends [m]."""
        return self.start + self.length


@dataclass(frozen=True)
class _StandardTask:
    length: float  # [m]
    turn: tuple[float, float]  # total turn it may have [rad], left positive
    wander: float  # [rad] the heading may leave the range between its first and last value by


_STANDARD = {
    "straight": _StandardTask(30.0, (-np.deg2rad(15), np.deg2rad(15)), np.deg2rad(10)),
    "right_turn": _StandardTask(60.0, (-np.deg2rad(120), -np.deg2rad(60)), np.deg2rad(20)),
}
STANDARD = tuple(_STANDARD)
"""Names of the standard tasks."""

_SHORTER = 0.05  # share by which a stretch may fall short of its standard length: scale and smoothing take their part
_STEP = 0.25  # [m]


def find_task(name: str, world: World, configured: tuple[TaskConfig, ...] = ()) -> RouteSegment:
    """The stretch of a task by name.

    Raises:
        InputError: no such task, or the route has no such stretch; says which tasks there are.
    """
    found = tasks(world, configured)
    if name in found:
        return found[name]
    there = ", ".join(f"{s.name} ({s.length:.1f} m from {s.start:.1f} m)" for s in found.values())
    why = "unknown"
    if name in _STANDARD:
        longest = _longest(world.route, _STANDARD[name])
        why = f"the route ({arc_lengths(world.route)[-1]:.1f} m) has no such stretch of {_STANDARD[name].length:g} m"
        if longest:
            why += f"; the longest is {longest[1]:.1f} m from {longest[0]:.1f} m"
    raise InputError(
        f"task {name!r}: {why}; there are {there}; name another in scene.toml: "
        '[[task]] name = "mine", start = 0.0, length = 20.0'
    )


def tasks(world: World, configured: tuple[TaskConfig, ...] = ()) -> dict[str, RouteSegment]:
    """All tasks of a scene by name; those of `scene.toml` replace standard ones of the same name.

    Raises:
        InputError: a configured one leaves the route.
    """
    total = float(arc_lengths(world.route)[-1])
    found = {"route": RouteSegment("route", 0.0, total)}
    for name, standard in _STANDARD.items():
        length = min(standard.length, total)
        if length >= (1.0 - _SHORTER) * standard.length and (starts := _fitting(world.route, standard, length)).size:
            found[name] = RouteSegment(name, float(starts[0]), length)
    for task in configured:
        if task.start + task.length > total + 1e-6:
            raise InputError(
                f"task {task.name!r}: from {task.start:g} m to {task.start + task.length:g} m, but the route is "
                f"{total:.2f} m long; shorten it in scene.toml"
            )
        found[task.name] = RouteSegment(task.name, task.start, task.length)
    return found


def _fitting(route: Array, standard: _StandardTask, length: float) -> Array:
    """Arc lengths [m] at which stretches of a length that fit begin, best first: most of the turn in their middle."""
    total = float(arc_lengths(route)[-1])
    s = np.append(np.arange(0.0, total, _STEP), total)
    heading = np.unwrap(heading_at(route, s))
    starts, off = [], []
    for start in np.arange(0.0, total - length + 1e-9, _STEP):
        inside = heading[(s >= start - 1e-9) & (s <= start + length + 1e-9)]
        turn, low, high = inside[-1] - inside[0], min(inside[0], inside[-1]), max(inside[0], inside[-1])
        wander = max(low - inside.min(), inside.max() - high)
        if standard.turn[0] <= turn <= standard.turn[1] and wander <= standard.wander:
            starts.append(start)
            half = int(np.argmin(np.abs(inside - (inside[0] + inside[-1]) / 2)))
            # A straight stretch has no middle of its turn; the first one will do.
            off.append(abs(half / len(inside) - 0.5) if abs(turn) > np.deg2rad(30) else 0.0)
    return np.array(starts)[np.argsort(np.array(off), kind="stable")] if starts else np.zeros(0)


def _longest(route: Array, standard: _StandardTask) -> tuple[float, float] | None:
    """Start and length [m] of the longest fitting stretch; None where there is none of 2 m."""
    for length in np.arange(min(standard.length, float(arc_lengths(route)[-1])), 2.0, -1.0):
        if (starts := _fitting(route, standard, float(length))).size:
            return float(starts[0]), float(length)
    return None
