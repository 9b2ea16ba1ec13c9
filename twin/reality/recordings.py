"""Recordings by a robot of the real test; they contain no poses of its camera.

A film of a drive along the filmed road, in a filmed lighting, lets `twin.align` estimate the camera's extrinsics. A
photo in the weather of a trial lets `twin.relight` fit its lighting. A drive log lets `twin.align` identify the robot.
"""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.images import write_image
from twin.reality import SEED
from twin.reality.drawn_road import DrawnRoad
from twin.reality.filming import FilmingPlan, write_video
from twin.reality.lighting import Lighting, weather
from twin.reality.place_objects import DrivenLine
from twin.reality.real_camera import RealCamera, draw_camera, intrinsics_of, native_size
from twin.reality.real_robot import RealRobot, draw_robot
from twin.reality.real_test import Setup
from twin.reality.trial_place import place_on_test_day, rasterizer_of
from twin.runtime import track
from twin.types import Array

LIGHTING = "overcast"  # lighting of the film, if the place has it

_STATIONS = (4.0, 30.0)  # [m] start and end of the film
_SPEED = 0.6  # [m/s]
_WEAVE_AMPLITUDE, _WEAVE_PERIOD = 0.5, 11.0  # [m] to either side, and along the road; fitting extrinsics needs turns
_LATERAL_GAIN, _HEADING_GAIN = 0.8, 1.5  # [rad/m], [1/s]
_FPS = 4
_CONTROL_STEP = 0.05  # [s]


def write_film(path: Path, setup: Setup) -> None:
    """Drives the robot down the road and writes a film by the robot's camera, at 4 frames per second.

    Raises:
        InputError: `path` does not end in .mp4, or is a folder.
    """
    if path.suffix != ".mp4" or path.is_dir():
        raise InputError(f"{path}: expected a .mp4 file to write, such as robot.mp4")
    filmed = place_on_test_day(setup.place, setup.length).lightings
    robot, camera = robot_and_camera(setup, filmed.get(LIGHTING) or next(iter(filmed.values())))
    path.parent.mkdir(parents=True, exist_ok=True)
    count = round((_STATIONS[1] - _STATIONS[0]) / _SPEED * _FPS)
    width, height = native_size()
    plan = replace(FilmingPlan(), width=width, height=height, fps=_FPS, crf=16)
    frames = _frames(robot, camera, place_on_test_day(setup.place, setup.length).route, count)
    write_video(track(frames, "film from the robot", unit="frame", total=count), plan, path)


def write_photo(lighting: str, path: Path, setup: Setup) -> None:
    """Writes a photo for `twin.relight` from the robot's start pose.

    Raises:
        InputError: unknown weather, or `path` is not a .png or .jpg file.
    """
    light = weather(lighting)
    if path.suffix not in (".png", ".jpg") or path.is_dir():
        raise InputError(f"{path}: expected a .png or .jpg file to write, such as dawn.png")
    robot, camera = robot_and_camera(setup, light)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, camera.capture(robot))


def robot_and_camera(setup: Setup, light: Lighting) -> tuple[RealRobot, RealCamera]:
    """The robot at rest at the start of `_STATIONS`, and its camera with the native image size."""
    place, numbers, size = place_on_test_day(setup.place, setup.length), draw_camera(setup.camera), native_size()
    robot = RealRobot(draw_robot(setup.robot), place)
    set_on_line(robot, place.route, _STATIONS[0])
    raster = rasterizer_of(place, light, intrinsics_of(numbers, size), size)
    return robot, RealCamera(raster, light, numbers, size, np.random.default_rng([SEED, 43]))


def set_on_line(robot: RealRobot, line: DrivenLine, station: float) -> None:
    """Puts the robot at rest on a line at a station [m]."""
    x, y = line.at(station).tolist()
    robot.set_pose(x, y, float(line.heading(station)), np.random.default_rng([SEED, 45]))


def _frames(robot: RealRobot, camera: RealCamera, line: DrivenLine, count: int) -> Iterator[NDArray[np.uint8]]:
    for _ in range(count):
        yield camera.capture(robot)
        for _ in range(round(1.0 / _FPS / _CONTROL_STEP)):
            robot.command(_SPEED, _steering(line, np.array(robot.pose)))
            robot.step(_CONTROL_STEP)


def _steering(line: DrivenLine, pose: NDArray[np.float64]) -> float:
    """Yaw rate [rad/s] that steers a base at pose x, y, yaw to the weaving line."""
    station, lateral = (float(value[0]) for value in line.project(pose[None, :2]))
    phase = 2.0 * np.pi * station / _WEAVE_PERIOD
    slope = _WEAVE_AMPLITUDE * 2.0 * np.pi / _WEAVE_PERIOD * np.cos(phase)
    wanted = (
        float(line.heading(station)) + np.arctan(slope) - _LATERAL_GAIN * (lateral - _WEAVE_AMPLITUDE * np.sin(phase))
    )
    return float(_HEADING_GAIN * np.angle(np.exp(1j * (wanted - pose[2]))))


# ---- drive log

LOG_COLUMNS = (
    *("time", "cmd_v", "cmd_yaw_rate", "left_wheel_vel", "right_wheel_vel", "x", "y", "yaw"),
    *("acceleration_x", "acceleration_y"),
)

_DURATIONS = (10.0, 36_000.0)  # [s] range of a log's duration
_LOG_PERIOD = 0.05  # [s] between two rows
_COMMAND_ROWS = 2  # rows between two commands
_MAX_LATERAL, _LOG_STATIONS = 1.7, (4.0, 26.0)  # [m] bounds of the base's position
_HOLD = (1.0, 2.5)  # [s] duration of a command
_LOG_SPEED, _YAW_RATE = 0.9, 1.6  # [m/s], [rad/s] bounds of commands
_POSITION_NOISE, _YAW_NOISE = 0.004, 0.0015  # [m], [rad]
_WHEEL_NOISE, _ACCELERATION_NOISE = 0.03, 0.08  # [rad/s], [m/s²]
_MAX_TRIES = 40


def record_log(duration: float, setup: Setup) -> dict[str, Array]:
    """A drive log of `duration` [s] near the road's start: columns by name, each of shape (rows,).

    Random commands, as from a joystick, drive the robot forwards, backwards and through turns, but keep it on the road.
    The log has the commands and, with measurement noise, wheel speeds, accelerations and poses, as surveyed, in the
    frame of the first pose.

    Raises:
        InputError: `duration` is not within `_DURATIONS`.
    """
    if not _DURATIONS[0] <= duration <= _DURATIONS[1]:
        raise InputError(f"duration = {duration:g} s; expected {_DURATIONS[0]:g} to {_DURATIONS[1]:g}")
    rng = np.random.default_rng([SEED, 42])
    place = place_on_test_day(setup.place, setup.length)
    line, robot = place.route, RealRobot(draw_robot(setup.robot), place)
    set_on_line(robot, line, 12.0)
    first = np.array(robot.pose)
    command, until, rows = np.zeros(2), 1.0, []
    for i in range(round(duration / _LOG_PERIOD)):
        now, pose = i * _LOG_PERIOD, np.array(robot.pose)
        if now >= until or not _stays_inside(line, pose, command, 0.6):
            hold = float(rng.uniform(*_HOLD))
            command, until = _sample_command(rng, line, pose, hold), now + hold
        if i % _COMMAND_ROWS == 0:
            robot.command(*command.tolist())
        rows.append((now, *command, *robot.wheel_speeds, *pose, *robot.acceleration))
        robot.step(_LOG_PERIOD)
    table = np.array(rows)
    table[:, 7] = np.unwrap(table[:, 7])
    noise = (_WHEEL_NOISE, _WHEEL_NOISE, _POSITION_NOISE, _POSITION_NOISE, _YAW_NOISE)
    sigma = np.array([0.0, 0.0, 0.0, *noise, _ACCELERATION_NOISE, _ACCELERATION_NOISE])
    table[:, 5:8] = _relative_poses(table[:, 5:8], first)
    table += rng.normal(size=table.shape) * sigma
    return dict(zip(LOG_COLUMNS, table.T, strict=True))


def write_log(path: Path, columns: dict[str, Array]) -> None:
    """Writes a log as CSV with six decimals."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([f"{value:.6f}" for value in row] for row in np.stack(list(columns.values()), 1))


def _sample_command(rng: np.random.Generator, line: DrivenLine, pose: Array, hold: float) -> Array:
    """A random command that keeps the robot on the road, or a turn on the spot if none is found."""
    for _ in range(_MAX_TRIES):
        command = rng.uniform([-_LOG_SPEED, -_YAW_RATE], [_LOG_SPEED, _YAW_RATE])
        if _stays_inside(line, pose, command, hold + 0.3):
            return command
    return np.array([0.0, rng.choice([-1.0, 1.0]) * _YAW_RATE])


def _stays_inside(line: DrivenLine, pose: Array, command: Array, ahead: float) -> bool:
    """True if a command held for `ahead` [s] keeps the robot inside the bounds."""
    times = np.linspace(0.0, ahead, 8)
    heading = pose[2] + command[1] * times
    step = np.diff(times) * command[0]
    xy = pose[:2] + np.cumsum(np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], 1) * step[:, None], 0)
    station, lateral = line.project(xy)
    bound = _MAX_LATERAL
    if isinstance(line, DrawnRoad):
        bound = min(bound, max(0.9, min(line.section.left, line.section.right) - 0.2))
    inside = (np.abs(lateral) <= bound) & (station >= _LOG_STATIONS[0]) & (station <= _LOG_STATIONS[1])
    return bool(inside.all())


def _relative_poses(poses: Array, first: Array) -> Array:
    """Poses x, y, yaw (n, 3) in the frame of the pose `first` (3,)."""
    cos, sin = np.cos(first[2]), np.sin(first[2])
    off = poses - first
    return np.stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]], 1)
