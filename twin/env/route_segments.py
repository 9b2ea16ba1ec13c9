"""Tasks of a scene: segments of its route, each between two arc lengths.

The *standard tasks* of DriveEnv-NeRF are `straight` (30 m) and `right_turn` (60 m): segments of the route with a given
length and total turn. `[[task]]` entries of `scene.toml` define further tasks, and `route` is the whole route.
A [[branch]] of `scene.toml`, another route through the place, is a task of its own. No task begins before
`World.start`; one that begins earlier in `scene.toml` is cut.
"""

from dataclasses import dataclass

import numpy as np

from twin.config import TaskConfig
from twin.config_file import MIN_TASK_LENGTH
from twin.errors import InputError, name_hint
from twin.geometry.polyline import heading_at
from twin.mjcf.world import World
from twin.types import Array


@dataclass(frozen=True)
class RouteSegment:
    """A named part of the route, along which episodes drive."""

    name: str
    start: float
    """Arc length of the start [m]."""
    length: float
    """[m]"""
    route: str = ""
    """Name of the branch (`World.branches`) of which it is a part; "" is the route."""

    @property
    def end(self) -> float:
        """Arc length of the end [m]."""
        return self.start + self.length


@dataclass(frozen=True)
class _StandardTask:
    length: float  # [m]
    turn: tuple[float, float]  # lowest and highest total turn [rad], positive to the left
    max_excursion: float  # [rad] largest deviation of the heading from the range between its first and last value


_STANDARD_SPECS = {
    "straight": _StandardTask(30.0, (-np.deg2rad(15), np.deg2rad(15)), np.deg2rad(10)),
    "right_turn": _StandardTask(60.0, (-np.deg2rad(120), -np.deg2rad(60)), np.deg2rad(20)),
}

_LENGTH_TOLERANCE = 0.05  # relative shortfall allowed in standard tasks, as smoothing and scale errors shorten routes
_STEP = 0.25  # [m] between tested starts


def find_task(name: str, world: World, configured: tuple[TaskConfig, ...] = ()) -> RouteSegment:
    """Returns the route segment of a task.

    Raises:
        InputError: there is no such task, or no such segment on the route; the error lists the tasks that exist.
    """
    found = scene_tasks(world, configured)
    if name in found:
        return found[name]
    if hint := name_hint(name, found, ""):
        raise InputError(f"task {name!r}: unknown; {hint}")
    there = ", ".join(f"{s.name} ({s.length:.1f} m long, starts at {s.start:.1f} m)" for s in found.values())
    why = "unknown"
    if name in _STANDARD_SPECS:
        longest = _longest_fit(world, _STANDARD_SPECS[name])
        why = f"the route ({world.length:.1f} m) has no such segment of {_STANDARD_SPECS[name].length:g} m"
        if longest:
            why += f"; the longest is {longest[1]:.1f} m long and starts at {longest[0]:.1f} m"
    raise InputError(
        f"task {name!r}: {why}; there are {there}; define another in scene.toml: "
        '[[task]] name = "mine", start = 0.0, length = 20.0'
    )


def scene_tasks(world: World, configured: tuple[TaskConfig, ...] = ()) -> dict[str, RouteSegment]:
    """Returns all tasks of a scene by name; a task of `scene.toml` replaces a standard one of the same name.

    Raises:
        InputError: a configured task extends beyond the route.
    """
    found = {"route": RouteSegment("route", world.start, world.length)}
    for name, standard in _STANDARD_SPECS.items():
        length = min(standard.length, world.length)
        long_enough = length >= (1.0 - _LENGTH_TOLERANCE) * standard.length
        if long_enough and (starts := _fitting_starts(world, standard, length)).size:
            found[name] = RouteSegment(name, float(starts[0]), length)
    for name in world.branches:
        found[name] = RouteSegment(name, world.along(name).start, world.along(name).length, name)
    for task in configured:
        if task.route and task.route not in world.branches:
            raise InputError(f"task {task.name!r}: the build has no branch {task.route!r}; build the scene again")
        along, end = world.along(task.route), task.start + task.length
        total, cut = along.start + along.length, max(along.start - task.start, 0.0)
        if end > total + 1e-6 or task.length - cut < MIN_TASK_LENGTH:
            raise InputError(
                f"task {task.name!r}: from {task.start:g} m to {end:g} m, but its route is {total:.2f} m long, and "
                f"robots start at {along.start:.2f} m; change the task in scene.toml"
            )
        found[task.name] = RouteSegment(task.name, task.start + cut, task.length - cut, task.route)
    return found


def _fitting_starts(world: World, standard: _StandardTask, length: float) -> Array:
    """Start arc lengths [m] of segments of a given length that fit a standard task; the most central turn first."""
    route, total = world.route, world.start + world.length
    s = np.append(np.arange(0.0, total, _STEP), total)
    heading = np.unwrap(heading_at(route, s))
    starts, off_center = [], []
    for start in np.arange(world.start, total - length + 1e-9, _STEP):
        inside = heading[(s >= start - 1e-9) & (s <= start + length + 1e-9)]
        turn, low, high = inside[-1] - inside[0], min(inside[0], inside[-1]), max(inside[0], inside[-1])
        excursion = max(low - inside.min(), inside.max() - high)
        if standard.turn[0] <= turn <= standard.turn[1] and excursion <= standard.max_excursion:
            starts.append(start)
            half = int(np.argmin(np.abs(inside - (inside[0] + inside[-1]) / 2)))
            # A straight segment has no turn to center, so the first that fits comes first.
            off_center.append(abs(half / len(inside) - 0.5) if abs(turn) > np.deg2rad(30) else 0.0)
    return np.array(starts)[np.argsort(np.array(off_center), kind="stable")] if starts else np.zeros(0)


def _longest_fit(world: World, standard: _StandardTask) -> tuple[float, float] | None:
    """Start and length [m] of the longest fitting segment, to within 1 m; None if none exceeds 2 m."""
    for length in np.arange(min(standard.length, world.length), 2.0, -1.0):
        if (starts := _fitting_starts(world, standard, float(length))).size:
            return float(starts[0]), float(length)
    return None
