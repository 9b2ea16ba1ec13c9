"""The task of a trial, as numbers: a line on the road, the corridor's width, start, goal and limits.

The twin writes a task as JSON (`twin export SCENE --task NAME --task-file FILE`); `read_task` reads it and transforms
it from the scene's frame into that of the generated world (the *true frame*). Without a twin, `task_of_place` gives a
place's tasks on its filmed path, with the default rules. *Station*: arc length along the line [m].
"""

from dataclasses import dataclass
from functools import cache
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import InputError, short_repr
from twin.files import read_json, wrap_read_errors
from twin.geometry.poses import Similarity
from twin.reality.filming import FilmingPlan
from twin.reality.place_sampling import draw
from twin.reality.place_spec import tasks
from twin.reality.trial_place import place_on_test_day, true_route
from twin.types import Array

CAMPUS_TASKS = {"straight": (0.0, 30.0), "right_turn": (0.25, 60.0), "route": (0.0, 60.349)}
"""Start and length [m] of the tasks of place 0, by name; a test compares them with those that the twin finds."""

_WRITE = "write one: twin export SCENE --task NAME --task-file FILE"
_HALF_WIDTH = 1.0  # [m]
_BUMPER = 0.5  # [m] from the base to the front bumper
_STUCK = (0.1, 5.0)  # [m], [s]
_MAX_TILT = radians(60.0)
_START_OFFSET, _START_HEADING = 0.3, radians(10.0)  # [m], [rad]
_HEADING_WINDOW = 1.0  # [m]


@dataclass(frozen=True)
class RoadTask:
    """A task on a road."""

    name: str
    line: Array
    """Points (x, y) in driving order [m], shape (m, 2)."""
    half_width: float
    """Largest distance of the base from the line [m]."""
    start: float
    """Station near which trials start [m]."""
    start_offset: float
    """Largest distance of a start from the line [m]."""
    start_heading: float
    """Largest angle between robot and line at a start [rad]."""
    goal: float
    """Station that the base must reach [m]."""
    time_limit: float
    """[s]"""
    stuck: tuple[float, float]
    """A robot that moves by less than this distance [m] in this time [s] is stuck."""
    max_tilt: float
    """Tilt beyond which the robot has rolled over [rad]."""
    speed: float
    """Largest speed of a command [m/s]."""
    yaw_rate: float
    """Largest yaw rate of a command [rad/s]."""
    control_timestep: float
    """[s]"""

    def __post_init__(self) -> None:
        line = self.line
        knots = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))) if line.ndim == 2 else np.zeros(1)
        wrong = (
            f"line of shape {line.shape}; expected (m, 2), m ≥ 2"
            if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2
            else f"start {self.start:g} m and goal {self.goal:g} m on a line of {knots[-1]:.2f} m"
            if not -1e-6 <= self.start < self.goal <= knots[-1] + 1e-6
            else "half width, time limit, speed, yaw rate and control step; expected all above 0"
            if not min(self.half_width, self.time_limit, self.speed, self.yaw_rate, self.control_timestep) > 0.0
            else ""
        )
        if wrong:
            raise InputError(f"task {self.name!r}: {wrong}")

    @property
    def knots(self) -> Array:
        """Station of each point of the line [m], shape (m,)."""
        return np.append(0.0, np.cumsum(np.hypot(*np.diff(self.line, axis=0).T)))

    def at(self, station: float) -> tuple[float, float, float]:
        """x, y [m] of the line at a station, and the line's heading [rad] over 1 m around the station."""
        knots, total = self.knots, float(self.knots[-1])

        def point(s: float) -> Array:
            return np.array([np.interp(s, knots, self.line[:, k]) for k in (0, 1)])

        window = min(_HEADING_WINDOW, total)
        middle = min(max(station, window / 2), total - window / 2)
        chord = point(middle + window / 2) - point(middle - window / 2)
        x, y = point(station).tolist()
        return x, y, float(np.arctan2(chord[1], chord[0]))

    def sample_start(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """A start pose: x, y [m], yaw [rad]."""
        x, y, heading = self.at(self.start)
        off = float(rng.uniform(-self.start_offset, self.start_offset))
        turn = float(rng.uniform(-self.start_heading, self.start_heading))
        return x - off * sin(heading), y + off * cos(heading), heading + turn


def read_task(path: Path, to_truth: Similarity | None = None) -> RoadTask:
    """Reads a task that the twin wrote; `to_truth` maps the scene's frame to the true one.

    Raises:
        InputError: no such file, a file of another format, or impossible numbers.
    """
    table = read_json(path)
    if not isinstance(table, dict) or (table.get("format"), table.get("version")) != ("twin task", 1):
        raise InputError(f"{path}: {short_repr(table)} is not a task; {_WRITE}")
    with wrap_read_errors(path, _WRITE):
        return parse_task(table, to_truth)


def parse_task(table: dict[str, Any], to_truth: Similarity | None = None) -> RoadTask:
    """A task from its file's contents. Raises KeyError, TypeError or ValueError for missing or wrong entries."""
    line = np.array(table["line"], float)
    line = to_truth.points(line) if to_truth else line
    start, limits = table["start"], table["limits"]
    return RoadTask(
        name=str(table["name"]),
        line=line[:, :2],
        half_width=float(table["half_width"]),
        start=float(start["station"]),
        start_offset=float(start["offset"]),
        start_heading=float(start["heading"]),
        goal=float(table["goal"]),
        time_limit=float(table["time_limit"]),
        stuck=(float(table["stuck"]["distance"]), float(table["stuck"]["time"])),
        max_tilt=float(table["max_tilt"]),
        speed=float(limits["speed"]),
        yaw_rate=float(limits["yaw_rate"]),
        control_timestep=float(table["control_timestep"]),
    )


@cache
def _filmed_line(number: int, length: float) -> Array:
    place = place_on_test_day(number, length)
    return true_route(FilmingPlan.of(draw(number, length)) if number else None, place.route)[:, :2]


def task_of_place(
    number: int,
    name: str,
    speed: float = 1.0,
    yaw_rate: float = 1.0,
    control_timestep: float = 0.1,
    road_length: float = 0.0,
) -> RoadTask:
    """A task of a place on its filmed path, for a policy's speed [m/s], yaw rate [rad/s] and control step [s].

    `road_length` [m] as the length for `place_sampling.draw`.

    Raises:
        InputError: no such task in this place.
    """
    offered = tasks(draw(number, road_length).line) if number else CAMPUS_TASKS
    if name not in offered:
        raise InputError(f"task {name!r}: place {number} has {', '.join(offered)}")
    start, length = offered[name]
    line = _filmed_line(number, road_length)
    end = min(start + length, float(np.hypot(*np.diff(line, axis=0).T).sum()))
    return RoadTask(
        *(name, line, _HALF_WIDTH, start, _START_OFFSET, _START_HEADING, end - _BUMPER),
        time_limit=2.0 * (end - start) / speed,
        stuck=_STUCK,
        max_tilt=_MAX_TILT,
        speed=speed,
        yaw_rate=yaw_rate,
        control_timestep=control_timestep,
    )
