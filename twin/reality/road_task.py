"""The task of a trial on the road (a line, the corridor's width, start, goal and limits), and the trial's judge.

The twin writes a task as JSON (`twin export SCENE --task NAME --task-file FILE`); `read_task` reads it and transforms
it from the scene's frame into that of the generated world (the *true frame*). Without a twin, `task_of_place` gives a
place's tasks on its filmed path, with the default rules. *Station*: arc length along the line [m].

The judge decides when a trial ends, and why: goal, collision, timeout, ... It uses the task's numbers and the robot's
position, tilt and contact, and shares no code with the twin's `RewardAndTermination`. A test compares the two on a
thousand paths.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from functools import cache
from math import cos, hypot, radians, sin
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import InputError, name_hint, short_repr
from twin.files import read_json, wrap_read_errors
from twin.geometry.passes import path_length, smooth_path
from twin.geometry.poses import Similarity
from twin.reality import campus_road
from twin.reality.campus_road import RoadLine
from twin.reality.filming import FilmingPlan, trajectory
from twin.reality.place_objects import DrivenLine, KnownPlace
from twin.reality.place_sampling import sample_place
from twin.reality.place_spec import tasks
from twin.reality.sampled_place import build_number
from twin.types import Array

CAMPUS_TASKS = {"straight": (2.0, 30.0), "right_turn": (2.0, 58.349), "route": (2.0, 58.349)}
"""Start and length [m] of the tasks of place 0, by name; a test compares them with those that the twin finds."""

_WRITE = "write one: twin export SCENE --task NAME --task-file FILE"
_HALF_WIDTH = 1.0  # [m]
_BUMPER = 0.5  # [m] from the base to the front bumper
_STUCK = (0.1, 5.0)  # [m], [s]
_MAX_TILT = radians(60.0)
_TOP_SPEED = 1.0  # [m/s] of the Husky
_START_OFFSET, _START_HEADING = 0.3, radians(10.0)  # [m], [rad]
_HEADING_WINDOW = 1.0  # [m]
_LENGTH_TOLERANCE = 0.98  # least length of the route, as a fraction of the longest path


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
        wrong = (
            f"line of shape {line.shape}; expected (m, 2), m ≥ 2"
            if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2
            else f"start {self.start:g} m and goal {self.goal:g} m on a line of {self.knots[-1]:.2f} m"
            if not -1e-6 <= self.start < self.goal <= self.knots[-1] + 1e-6
            else "half width, time limit, speed, yaw rate and control step; expected all above 0"
            if not min(self.half_width, self.time_limit, self.speed, self.yaw_rate, self.control_timestep) > 0.0
            else ""
        )
        if wrong:
            raise InputError(f"task {self.name!r}: {wrong}")

    @property
    def numbers(self) -> list[float]:
        """All values but the name."""
        return np.concatenate([np.ravel(value) for name, value in vars(self).items() if name != "name"]).tolist()

    @property
    def knots(self) -> Array:
        """Station of each point of the line [m], shape (m,)."""
        return stations_of(self.line)

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


def stations_of(line: Array) -> Array:
    """Station of each point (m, 2) of a line [m], shape (m,)."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))


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


# ---- tasks of a place


def true_route(plan: FilmingPlan | None = None, line: DrivenLine | None = None) -> Array:
    """The route on the true ground [m], shape (m, 3).

    As in a build, it is the path of the first film whose path has at least 98 % of the longest path's length.
    """
    plan, line = plan or FilmingPlan(), line or RoadLine()
    paths = [smooth_path(trajectory(plan, line, lighting)[1][:, :3, 3]) for lighting in plan.lightings]
    lengths = np.array([path_length(path) for path in paths])
    xy = paths[int(np.argmax(lengths >= _LENGTH_TOLERANCE * lengths.max()))]
    return np.column_stack([xy, line.ground_height(xy)])


@cache
def place_on_test_day(number: int = 0, length: float = 0.0) -> KnownPlace:
    """The place with a number on the day of the trials; `length` [m] as for `place_sampling.sample_place`."""
    return build_number(number, displaced=True, length=length) if number else campus_road.build(displaced=True)


@cache
def _filmed_line(number: int, length: float) -> Array:
    place = place_on_test_day(number, length)
    return true_route(FilmingPlan.of(sample_place(number, length)) if number else None, place.route)[:, :2]


def task_of_place(
    number: int,
    name: str,
    speed: float = 1.0,
    yaw_rate: float = 1.0,
    control_timestep: float = 0.1,
    road_length: float = 0.0,
) -> RoadTask:
    """A task of a place on its filmed path, for a policy's speed [m/s], yaw rate [rad/s] and control step [s].

    `road_length` [m] as the length for `place_sampling.sample_place`.

    Raises:
        InputError: no such task in this place.
    """
    offered = tasks(sample_place(number, road_length).line) if number else CAMPUS_TASKS
    if name not in offered:
        raise InputError(f"task {name!r}: place {number} has none of that name; {name_hint(name, offered)}")
    start, length = offered[name]
    line = _filmed_line(number, road_length)
    end = min(start + length, float(np.hypot(*np.diff(line, axis=0).T).sum()))
    return RoadTask(
        *(name, line, _HALF_WIDTH, start, _START_OFFSET, _START_HEADING, end - _BUMPER),
        time_limit=(end - start) * max(2.0 / speed, 1.5 / _TOP_SPEED),
        stuck=_STUCK,
        max_tilt=_MAX_TILT,
        speed=speed,
        yaw_rate=yaw_rate,
        control_timestep=control_timestep,
    )


# ---- judge

_BEHIND, _AHEAD = 1.5, 4.0  # [m] range of the search for the nearest point: behind and ahead of the previous one


class RealJudge:
    """Judges one trial at a time."""

    def __init__(self, task: RoadTask) -> None:
        self._task = task
        self._points = task.line.tolist()
        self._knots = task.knots.tolist()

    def begin(self, x: float, y: float) -> None:
        """Starts a trial at a position [m]."""
        self.cause = ""
        """Cause of the trial's end, one of `twin.config.CAUSES`; empty while it goes on."""
        self.station, self.offset = self._task.start, 0.0
        """Station of the nearest point of the line, and the distance from that point, positive to its left [m]."""
        self._locate(x, y)
        self._rested, self._since = (x, y), 0.0

    def see(self, x: float, y: float, tilt: float, touched: bool, time: float) -> str:
        """Takes the robot's state once per control step; returns the cause of the trial's end, empty while it goes on.

        Args:
            x: Position of the base [m].
            y: Position of the base [m].
            tilt: Angle between the robot's and the world's up axes [rad].
            touched: True if the robot has touched an object.
            time: Time since the start [s].
        """
        task = self._task
        self._locate(x, y)
        distance, patience = task.stuck
        if hypot(x - self._rested[0], y - self._rested[1]) > distance:
            self._rested, self._since = (x, y), time
        if tilt > task.max_tilt:
            self.cause = "rollover"
        elif touched:
            self.cause = "collision"
        elif abs(self.offset) > task.half_width:
            self.cause = "out_of_bounds"
        elif self.station >= task.goal:
            self.cause = "goal"
        elif time > task.time_limit - 1e-6:
            self.cause = "timeout"
        elif time - self._since > patience - 1e-6:
            self.cause = "stuck"
        return self.cause

    @property
    def progress(self) -> float:
        """Distance along the line from the task's start [m]."""
        return self.station - self._task.start

    def _locate(self, x: float, y: float) -> None:
        """Finds the nearest point of the line within the search range around the previous one."""
        low, high = self.station - _BEHIND, self.station + _AHEAD
        best = (float("inf"), self.station, 0.0)
        first = max(bisect_left(self._knots, low) - 1, 0)
        for k in range(first, min(bisect_right(self._knots, high), len(self._points) - 1)):
            (ax, ay), (bx, by) = self._points[k], self._points[k + 1]
            dx, dy = bx - ax, by - ay
            squared = dx * dx + dy * dy
            share = min(max(((x - ax) * dx + (y - ay) * dy) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
            away = hypot(x - ax - share * dx, y - ay - share * dy)
            if away < best[0]:
                left = dx * (y - ay) - dy * (x - ax)
                best = (away, self._knots[k] + share * (self._knots[k + 1] - self._knots[k]), left)
        self.station, self.offset = best[1], best[0] if best[2] >= 0.0 else -best[0]
