"""A drive log of reality's Husky, as `twin.align` reads it.

Someone drives it by joystick on the straight part of the road: commands that change every second or two, forwards,
backwards and turning, never off the asphalt. Logged are commands, wheel encoders, an IMU and a surveyor's pose, with
the errors that such instruments have.
"""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.env.options import Options
from twin.errors import InputError
from twin.reality.road import Road
from twin.reality.robot import robot
from twin.reality.route import Route
from twin.reality.things import SEED

Array = NDArray[np.float64]

COLUMNS = (
    *("time", "cmd_v", "cmd_yaw_rate", "left_wheel_vel", "right_wheel_vel", "x", "y", "yaw"),
    *("acceleration_x", "acceleration_y"),
)

_PERIOD = 0.05  # [s] between two rows
_COMMAND_ROWS = 2  # rows between two commands
_LATERAL, _STATIONS = 1.7, (4.0, 26.0)  # [m] where the base may be
_HOLD = (1.0, 2.5)  # [s] a command is held for
_SPEED, _YAW_RATE = 0.9, 1.6  # [m/s], [rad/s] the most that is asked for
_POSITION_NOISE, _YAW_NOISE = 0.004, 0.0015  # [m], [rad]
_WHEEL_NOISE, _ACCELERATION_NOISE = 0.03, 0.08  # [rad/s], [m/s²]
_TRIES = 40


def record(duration: float) -> dict[str, Array]:
    """A log of `duration` [s]: columns by name, shape (rows,) each; poses are in the frame of the first one."""
    if not duration >= 10.0:
        raise InputError(f"duration = {duration:g} s; expected at least 10")
    rng = np.random.default_rng([SEED, 42])
    road = Road("straight", robot(), Options(pixels=False))
    physics, line = road.physics.robot, Route()
    start = line.at(12.0)
    physics.place(float(start[0]), float(start[1]), float(line.heading(12.0)))
    first = physics.planar_pose
    command, until, rows = np.zeros(2), 1.0, []
    for i in range(round(duration / _PERIOD)):
        now = i * _PERIOD
        if now >= until or not _stays(line, physics.planar_pose, command, 0.6):
            hold = float(rng.uniform(*_HOLD))
            command, until = _chosen(rng, line, physics.planar_pose, hold), now + hold
        if i % _COMMAND_ROWS == 0:
            physics.command(*command.tolist())
        wheels = physics.wheel_velocity
        rows.append((now, *command, wheels[[0, 2]].mean(), wheels[[1, 3]].mean(), *physics.planar_pose))
        rows[-1] += tuple(physics.accelerometer[:2])
        physics.step(_PERIOD)
    table = np.array(rows)
    table[:, 7] = np.unwrap(table[:, 7])
    told = (_WHEEL_NOISE, _WHEEL_NOISE, _POSITION_NOISE, _POSITION_NOISE, _YAW_NOISE)
    sigma = np.array([0.0, 0.0, 0.0, *told, _ACCELERATION_NOISE, _ACCELERATION_NOISE])
    table[:, 5:8] = _relative(table[:, 5:8], first)
    table += rng.normal(size=table.shape) * sigma
    return dict(zip(COLUMNS, table.T, strict=True))


def write(path: Path, columns: dict[str, Array]) -> None:
    """As CSV, micrometres and microradians at most."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([f"{value:.6f}" for value in row] for row in np.stack(list(columns.values()), 1))


def _chosen(rng: np.random.Generator, line: Route, pose: Array, hold: float) -> Array:
    """A random command that keeps the robot on the asphalt; where none is found, a turn on the spot."""
    for _ in range(_TRIES):
        command = rng.uniform([-_SPEED, -_YAW_RATE], [_SPEED, _YAW_RATE])
        if _stays(line, pose, command, hold + 0.3):
            return command
    return np.array([0.0, rng.choice([-1.0, 1.0]) * _YAW_RATE])


def _stays(line: Route, pose: Array, command: Array, ahead: float) -> bool:
    """Whether a command, held for `ahead` [s], leaves the robot where it may be."""
    times = np.linspace(0.0, ahead, 8)
    heading = pose[2] + command[1] * times
    step = np.diff(times) * command[0]
    xy = pose[:2] + np.cumsum(np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], 1) * step[:, None], 0)
    station, lateral = line.project(xy)
    inside = (np.abs(lateral) <= _LATERAL) & (station >= _STATIONS[0]) & (station <= _STATIONS[1])
    return bool(inside.all())


def _relative(poses: Array, first: Array) -> Array:
    """Poses x, y, yaw (n, 3) in the frame of one (3,)."""
    cos, sin = np.cos(first[2]), np.sin(first[2])
    off = poses - first
    return np.stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]], 1)
