"""Recordings of the hidden robot, without poses of its camera.

A film of a drive along the filmed road, in a filmed lighting, lets `twin.align` estimate the camera's extrinsics. A
photo in the weather of a trial lets `twin.relight` fit its lighting. A drive log lets `twin.align` identify the robot.
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
from twin.reality import SEED, true_world
from twin.reality.drawn_road import DrawnRoad
from twin.reality.filming import FilmingPlan, write_video
from twin.reality.lighting import WEATHER, Lighting
from twin.reality.place_objects import DrivenLine
from twin.reality.rasterizer import Rasterizer
from twin.reality.real_robot import RealCamera, TrueRoad, hidden_robot, place_on_test_day, shadow_range
from twin.runtime import track
from twin.types import Array

LIGHTING = "overcast"

_STATIONS = (4.0, 30.0)  # [m] along the road
_SPEED = 0.6  # [m/s]
_WEAVE_AMPLITUDE, _WEAVE_PERIOD = 0.5, 11.0  # [m] to either side, [m] along the road; the weaving makes it turn
_LATERAL_GAIN, _HEADING_GAIN = 0.8, 1.5  # [rad/m], [1/s]
_FPS = 4
_CONTROL_STEP = 0.05  # [s]


def write_film(path: Path, number: int = 0) -> None:
    """Drives the robot down the road and writes a film by its camera, 4 frames per second as the robot is slow.

    Raises:
        InputError: `path` does not end in .mp4, or is a folder.
    """
    if path.suffix != ".mp4" or path.is_dir():
        raise InputError(f"{path}: expected a .mp4 file to write, such as robot.mp4")
    husky = hidden_robot()
    width, height = husky.params.camera_size
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = round((_STATIONS[1] - _STATIONS[0]) / _SPEED * _FPS)
    plan = replace(FilmingPlan(), width=width, height=height, fps=_FPS, crf=16)
    write_video(track(_frames(frames, number), "film from the robot", unit="frame", total=frames), plan, path)


def write_photo(weather: str, path: Path, number: int = 0) -> None:
    """Writes a photo for `twin.relight` from the robot's start pose.

    Raises:
        InputError: unknown weather, or `path` is not a .png or .jpg file.
    """
    if weather not in WEATHER:
        raise InputError(f"lighting {weather!r}: reality's are {', '.join(WEATHER)}")
    if path.suffix not in (".png", ".jpg") or path.is_dir():
        raise InputError(f"{path}: expected a .png or .jpg file to write, such as dawn.png")
    road, camera = _road_and_camera(WEATHER[weather], number)
    _set_start_pose(road, road.place.route)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, camera.capture(road.physics.camera_to_world, 0.0))


def _road_and_camera(light: Lighting, number: int) -> tuple[TrueRoad, RealCamera]:
    """The road, and the robot's camera at its full image size."""
    husky = hidden_robot()
    road, size = _true_road(number), husky.params.camera_size
    intrinsics = road.intrinsics(size)
    model = true_world.world_spec(light, road.place).compile()
    raster = Rasterizer(model, intrinsics, size, shadow_range(road.place))
    return road, RealCamera(raster, light, husky, intrinsics, size, np.random.default_rng([SEED, 43]))


def _set_start_pose(road: TrueRoad, line: DrivenLine) -> None:
    """Puts the robot at the first station of `_STATIONS`."""
    start = line.at(_STATIONS[0])
    road.physics.robot.set_pose(float(start[0]), float(start[1]), float(line.heading(_STATIONS[0])))


def _true_road(number: int) -> TrueRoad:
    return TrueRoad("whole" if number else "straight", hidden_robot(), Options(pixels=False), number)


def _frames(count: int, number: int) -> Iterator[NDArray[np.uint8]]:
    filmed = place_on_test_day(number).lightings
    light = filmed.get(LIGHTING) or next(iter(filmed.values()))
    road, camera = _road_and_camera(light, number)
    line = road.place.route
    _set_start_pose(road, line)
    physics = road.physics.robot
    for i in range(count):
        yield camera.capture(road.physics.camera_to_world, i / _FPS)
        for _ in range(round(1.0 / _FPS / _CONTROL_STEP)):
            physics.command(_SPEED, _steering(line, physics.planar_pose))
            physics.step(_CONTROL_STEP)


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

_LOG_PERIOD = 0.05  # [s] between two rows
_COMMAND_ROWS = 2  # rows between two commands
_MAX_LATERAL, _LOG_STATIONS = 1.7, (4.0, 26.0)  # [m] bounds of the base's position
_HOLD = (1.0, 2.5)  # [s] duration of a command
_LOG_SPEED, _YAW_RATE = 0.9, 1.6  # [m/s], [rad/s] bounds of commands
_POSITION_NOISE, _YAW_NOISE = 0.004, 0.0015  # [m], [rad]
_WHEEL_NOISE, _ACCELERATION_NOISE = 0.03, 0.08  # [rad/s], [m/s²]
_MAX_TRIES = 40


def record_log(duration: float, number: int = 0) -> dict[str, Array]:
    """A drive log of `duration` [s] on the straight segment: columns by name, each of shape (rows,).

    Random joystick commands drive forwards, backwards and turning, never off the asphalt. The log has commands, wheel
    encoders, an IMU and surveyed poses in the frame of the first one, with the noise of such instruments.
    """
    if not duration >= 10.0:
        raise InputError(f"duration = {duration:g} s; expected at least 10")
    rng = np.random.default_rng([SEED, 42])
    road = _true_road(number)
    physics, line = road.physics.robot, road.place.route
    start = line.at(12.0)
    physics.set_pose(float(start[0]), float(start[1]), float(line.heading(12.0)))
    first = physics.planar_pose
    command, until, rows = np.zeros(2), 1.0, []
    for i in range(round(duration / _LOG_PERIOD)):
        now = i * _LOG_PERIOD
        if now >= until or not _stays_inside(line, physics.planar_pose, command, 0.6):
            hold = float(rng.uniform(*_HOLD))
            command, until = _sample_command(rng, line, physics.planar_pose, hold), now + hold
        if i % _COMMAND_ROWS == 0:
            physics.command(*command.tolist())
        wheels = physics.wheel_velocity
        rows.append((now, *command, wheels[[0, 2]].mean(), wheels[[1, 3]].mean(), *physics.planar_pose))
        rows[-1] += tuple(physics.accelerometer[:2])
        physics.step(_LOG_PERIOD)
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
    """A random command that keeps the robot on the asphalt, or a turn on the spot if none is found."""
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
