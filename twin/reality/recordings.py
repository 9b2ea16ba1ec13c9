"""What the camera of reality's Husky takes besides trials: no poses come with it.

A film while someone drives it down the filmed road, in light that was filmed, too, tells `twin.align` how the camera
sits. A photo in the weather of a trial, from where the robot then stands, tells `twin.relight` what day it is.
"""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.env.options import Options
from twin.errors import InputError
from twin.geometry.images import write_image
from twin.reality import true_world as worlds
from twin.reality.centerline import RoadLine
from twin.reality.filming import FilmingPlan, encode
from twin.reality.lighting import LIGHTINGS, WEATHER, Lighting
from twin.reality.rasterizer import Raster
from twin.reality.real_robot import RealCamera, TrueRoad, place_robot, robot
from twin.reality.things import SEED
from twin.runtime import track
from twin.types import Array

LIGHTING = "overcast"

_STATIONS = (4.0, 30.0)  # [m] along the road
_SPEED = 0.6  # [m/s]
_WEAVE, _PERIOD = 0.5, 11.0  # [m] to either side, [m] along the road: so that it turns a little
_TO_LINE, _TO_HEADING = 0.8, 1.5  # [rad/m], [1/s]
_FPS = 4
_CONTROL = 0.05  # [s]


def write(path: Path) -> None:
    """Drives and films; a few frames a second will do, as the robot is slow.

    Raises:
        InputError: no name of a film.
    """
    if path.suffix != ".mp4" or path.is_dir():
        raise InputError(f"{path}: expected the name of a film, such as robot.mp4")
    husky = robot()
    width, height = husky.params.camera_size
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = round((_STATIONS[1] - _STATIONS[0]) / _SPEED * _FPS)
    plan = replace(FilmingPlan(), width=width, height=height, fps=_FPS, crf=16)
    encode(track(_pictures(frames), "film from the robot", unit="frame", total=frames), plan, path)


def photograph(weather: str, path: Path) -> None:
    """Writes a photo, as `twin.relight` reads it.

    Raises:
        InputError: no such weather, or no name of a picture.
    """
    if weather not in WEATHER:
        raise InputError(f"lighting {weather!r}: reality's are {', '.join(WEATHER)}")
    if path.suffix not in (".png", ".jpg") or path.is_dir():
        raise InputError(f"{path}: expected the name of a picture, such as dawn.png")
    road, eye = _camera(WEATHER[weather])
    _stand(road, RoadLine())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, eye.look(road.physics.camera_to_world, 0.0))


def _camera(light: Lighting) -> tuple[TrueRoad, RealCamera]:
    """The road, and the robot's camera on it with pictures of its full size."""
    husky = robot()
    road, size = TrueRoad("straight", husky, Options(pixels=False)), husky.params.camera_size
    intrinsics = road.intrinsics(size)
    raster = Raster(worlds.spec(light, place_robot()).compile(), intrinsics, size)
    return road, RealCamera(raster, light, husky, intrinsics, size, np.random.default_rng([SEED, 43]))


def _stand(road: TrueRoad, line: RoadLine) -> None:
    """Puts the robot on the road."""
    start = line.at(_STATIONS[0])
    road.physics.robot.place(float(start[0]), float(start[1]), float(line.heading(_STATIONS[0])))


def _pictures(count: int) -> Iterator[NDArray[np.uint8]]:
    line, (road, eye) = RoadLine(), _camera(LIGHTINGS[LIGHTING])
    _stand(road, line)
    physics = road.physics.robot
    for i in range(count):
        yield eye.look(road.physics.camera_to_world, i / _FPS)
        for _ in range(round(1.0 / _FPS / _CONTROL)):
            physics.command(_SPEED, _towards(line, physics.planar_pose))
            physics.step(_CONTROL)


def _towards(line: RoadLine, pose: NDArray[np.float64]) -> float:
    """Yaw rate [rad/s] that leads a base at x, y, yaw back to the weaving line."""
    station, lateral = (float(value[0]) for value in line.project(pose[None, :2]))
    phase = 2.0 * np.pi * station / _PERIOD
    slope = _WEAVE * 2.0 * np.pi / _PERIOD * np.cos(phase)
    wanted = float(line.heading(station)) + np.arctan(slope) - _TO_LINE * (lateral - _WEAVE * np.sin(phase))
    return float(_TO_HEADING * np.angle(np.exp(1j * (wanted - pose[2]))))


# ---- A drive log of reality's Husky, as `twin.align` reads it.
#
# Someone drives it by joystick on the straight part of the road: commands that change every second or two, forwards,
# backwards and turning, never off the asphalt. Logged are commands, wheel encoders, an IMU and a surveyor's pose, with
# the errors that such instruments have.


COLUMNS = (
    *("time", "cmd_v", "cmd_yaw_rate", "left_wheel_vel", "right_wheel_vel", "x", "y", "yaw"),
    *("acceleration_x", "acceleration_y"),
)

_LOG_PERIOD = 0.05  # [s] between two rows
_COMMAND_ROWS = 2  # rows between two commands
_LATERAL, _LOG_STATIONS = 1.7, (4.0, 26.0)  # [m] where the base may be
_HOLD = (1.0, 2.5)  # [s] a command is held for
_LOG_SPEED, _YAW_RATE = 0.9, 1.6  # [m/s], [rad/s] the most that is asked for
_POSITION_NOISE, _YAW_NOISE = 0.004, 0.0015  # [m], [rad]
_WHEEL_NOISE, _ACCELERATION_NOISE = 0.03, 0.08  # [rad/s], [m/s²]
_TRIES = 40


def record(duration: float) -> dict[str, Array]:
    """A log of `duration` [s]: columns by name, shape (rows,) each; poses are in the frame of the first one."""
    if not duration >= 10.0:
        raise InputError(f"duration = {duration:g} s; expected at least 10")
    rng = np.random.default_rng([SEED, 42])
    road = TrueRoad("straight", robot(), Options(pixels=False))
    physics, line = road.physics.robot, RoadLine()
    start = line.at(12.0)
    physics.place(float(start[0]), float(start[1]), float(line.heading(12.0)))
    first = physics.planar_pose
    command, until, rows = np.zeros(2), 1.0, []
    for i in range(round(duration / _LOG_PERIOD)):
        now = i * _LOG_PERIOD
        if now >= until or not _stays(line, physics.planar_pose, command, 0.6):
            hold = float(rng.uniform(*_HOLD))
            command, until = _chosen(rng, line, physics.planar_pose, hold), now + hold
        if i % _COMMAND_ROWS == 0:
            physics.command(*command.tolist())
        wheels = physics.wheel_velocity
        rows.append((now, *command, wheels[[0, 2]].mean(), wheels[[1, 3]].mean(), *physics.planar_pose))
        rows[-1] += tuple(physics.accelerometer[:2])
        physics.step(_LOG_PERIOD)
    table = np.array(rows)
    table[:, 7] = np.unwrap(table[:, 7])
    told = (_WHEEL_NOISE, _WHEEL_NOISE, _POSITION_NOISE, _POSITION_NOISE, _YAW_NOISE)
    sigma = np.array([0.0, 0.0, 0.0, *told, _ACCELERATION_NOISE, _ACCELERATION_NOISE])
    table[:, 5:8] = _relative(table[:, 5:8], first)
    table += rng.normal(size=table.shape) * sigma
    return dict(zip(COLUMNS, table.T, strict=True))


def log_write(path: Path, columns: dict[str, Array]) -> None:
    """As CSV, micrometres and microradians at most."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([f"{value:.6f}" for value in row] for row in np.stack(list(columns.values()), 1))


def _chosen(rng: np.random.Generator, line: RoadLine, pose: Array, hold: float) -> Array:
    """A random command that keeps the robot on the asphalt; where none is found, a turn on the spot."""
    for _ in range(_TRIES):
        command = rng.uniform([-_LOG_SPEED, -_YAW_RATE], [_LOG_SPEED, _YAW_RATE])
        if _stays(line, pose, command, hold + 0.3):
            return command
    return np.array([0.0, rng.choice([-1.0, 1.0]) * _YAW_RATE])


def _stays(line: RoadLine, pose: Array, command: Array, ahead: float) -> bool:
    """Whether a command, held for `ahead` [s], leaves the robot where it may be."""
    times = np.linspace(0.0, ahead, 8)
    heading = pose[2] + command[1] * times
    step = np.diff(times) * command[0]
    xy = pose[:2] + np.cumsum(np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], 1) * step[:, None], 0)
    station, lateral = line.project(xy)
    inside = (np.abs(lateral) <= _LATERAL) & (station >= _LOG_STATIONS[0]) & (station <= _LOG_STATIONS[1])
    return bool(inside.all())


def _relative(poses: Array, first: Array) -> Array:
    """Poses x, y, yaw (n, 3) in the frame of one (3,)."""
    cos, sin = np.cos(first[2]), np.sin(first[2])
    off = poses - first
    return np.stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]], 1)
