"""Recordings by a robot of the real test; they contain no poses of its camera.

A film of a drive along the filmed road, in a filmed lighting, lets `twin.align` estimate the camera's extrinsics. A
photo in the weather of a trial lets `twin.relight` fit its lighting. A drive log lets `twin.align` identify the robot.
A ROS 2 bag of a trial, as a real Husky would record it, is input for `twin.trial`.
"""

import contextlib
import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import atan2, copysign, hypot, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.errors import InputError
from twin.evaluation.trials import Trial
from twin.files import atomic_path, remove, require_output
from twin.geometry.images import write_image
from twin.geometry.poses import pose_of
from twin.reality import SEED
from twin.reality.filming import FilmingPlan, write_video
from twin.reality.lighting import Lighting, weather, weather_index
from twin.reality.place_objects import DrivenLine
from twin.reality.real_camera import RealCamera, draw_camera, intrinsics_of, native_size
from twin.reality.real_robot import RealRobot, draw_robot
from twin.reality.real_test import RealTest, Setup
from twin.reality.road_task import place_on_test_day, stations_of, task_of_place
from twin.reality.sampled_road import SampledRoad
from twin.reality.true_world import rasterizer_of
from twin.runtime import bar, track
from twin.types import Array
from twin_policy import Camera, CompressedPicture, Limits, OnnxPolicy, Pilot

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
    require_output(path, (".mp4",), make=True)
    filmed = place_on_test_day(setup.place, setup.length).lightings
    robot, camera = robot_and_camera(setup, filmed.get(LIGHTING) or next(iter(filmed.values())))
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
    require_output(path, (".png", ".jpg"), make=True)
    robot, camera = robot_and_camera(setup, light)
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
    """Writes a log as CSV with six decimals, atomically."""
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
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
    if isinstance(line, SampledRoad):
        bound = min(bound, max(0.9, min(line.section.left, line.section.right) - 0.2))
    inside = (np.abs(lateral) <= bound) & (station >= _LOG_STATIONS[0]) & (station <= _LOG_STATIONS[1])
    return bool(inside.all())


def _relative_poses(poses: Array, first: Array) -> Array:
    """Poses x, y, yaw (n, 3) in the frame of the pose `first` (3,)."""
    cos, sin = np.cos(first[2]), np.sin(first[2])
    off = poses - first
    return np.stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]], 1)


# ---- bag of a trial

_START = 1_700_000_000  # [s] Unix time of the first trial
_APART = 400  # [s] between the starts of two trials
_WEATHERS, MOST_SEED = 1000, 999  # upper bounds, so that times fit into ROS's 32-bit seconds
_WIDTH = 640  # [px] width of the camera's stream
_QUALITY = 92  # JPEG quality
_FIX_POSITION_NOISE, _FIX_YAW_NOISE = 0.01, 0.003  # [m], [rad]
_FRAME = (0.7, 251.0, -38.0)  # yaw [rad], x, y [m] of the true frame in the bag's frame of poses
_AFTER = 1.5  # [s] recorded after the end of the trial
_TOPICS = {
    "picture": ("/sensors/camera_0/color/compressed", "sensor_msgs/msg/CompressedImage"),
    "camera": ("/sensors/camera_0/color/camera_info", "sensor_msgs/msg/CameraInfo"),
    "pose": ("/sensors/gps_0/odom", "nav_msgs/msg/Odometry"),
    "command": ("/cmd_vel", "geometry_msgs/msg/TwistStamped"),
}


def write_robot_bag(
    path: Path, policy: Path | None, task: str, lighting: str, seed: int = 0, setup: Setup | None = None
) -> Trial:
    """Drives one trial and records it as a ROS 2 bag; returns its true outcome.

    The robot runs `twin_policy`'s pilot on its camera's JPEG pictures. The bag has these pictures, camera_info,
    commands, and poses with the accuracy of RTK, in a frame of their own. Recording continues for 1.5 s after the
    trial's end.

    Args:
        path: Folder of the bag to write.
        policy: A policy folder with policy.onnx; if None, the robot follows the task's line.
        task: Name of one of the place's tasks.
        lighting: See `twin.reality.lighting.weather`.
        seed: Seed of all randomness.
        setup: Place, robot and camera.

    Raises:
        InputError: rosbags is not installed, the path exists, or an unknown policy, task or lighting.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise InputError(f"{path}: writing a ROS 2 bag needs rosbags; pip install 'twin[ros]'") from None
    if path.exists():
        raise InputError(f"{path} exists; give another --out, or delete it")
    weather_number, setup = weather_index(lighting), setup or Setup()
    if not 0 <= seed <= MOST_SEED or weather_number >= _WEATHERS:
        raise InputError(f"seed {seed} under {lighting}; expected a seed from 0 to {MOST_SEED}, and a day up to 995")
    onnx, limits = None, (1.0, 1.0, 0.1)
    if policy:
        try:
            onnx = OnnxPolicy(policy)
        except ValueError as error:
            more = "" if Path(policy).exists() else "; twin unpack demo FOLDER gives a policy, FOLDER/runs/first"
            raise InputError(f"{error}{more}") from None
        limits = onnx.speed, onnx.max_yaw_rate, onnx.timestep
    size = _WIDTH, round(_WIDTH * native_size()[1] / native_size()[0])
    test = RealTest(task_of_place(setup.place, task, *limits, road_length=setup.length), setup, size)
    robot, judge, timestep = test.robot, test.judge, test.task.control_timestep
    camera = test.reset(lighting, seed)
    fx, fy, cx, cy = intrinsics_of(test.camera, size).tolist()
    rng, messages = np.random.default_rng([SEED, 44, seed]), BagMessages()
    begin = now = (_START + _APART * (weather_number + _WEATHERS * seed)) * 10**9

    def clock() -> int:
        return now

    pilot = Pilot(onnx, Limits(), None, clock, clock) if onnx else None
    if pilot:
        pilot.set_camera(Camera(size, (fx, fy, cx, cy)))
    steps, left = 0, round(_AFTER / timestep)
    path.parent.mkdir(parents=True, exist_ok=True)
    limit = round(test.task.time_limit / timestep) + left
    with contextlib.ExitStack() as stack:
        unfinished = stack.enter_context(contextlib.ExitStack())  # removes an interrupted bag
        unfinished.callback(remove, path)
        writer = stack.enter_context(Writer(path, version=9, storage_plugin=StoragePlugin.MCAP))
        progress = stack.enter_context(bar("trial", limit, "step"))
        topics = {kind: writer.add_connection(*topic, typestore=messages.store) for kind, topic in _TOPICS.items()}

        def write(kind: str, message: Any) -> None:
            writer.write(topics[kind], now, messages.store.serialize_cdr(message, _TOPICS[kind][1]))

        while left:
            now = begin + round(robot.time * 1e9)
            shutter = now - round(test.camera.latency * 1e9)
            image = camera.capture(robot)
            jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            write("camera", messages.camera_info((fx, fy, cx, cy), size, shutter))
            write("pose", messages.odometry(_measured(robot.base_to_world(robot.time), rng), now))
            write("picture", messages.jpeg(jpeg, shutter))
            if pilot:
                given = pilot.picture(CompressedPicture(jpeg), shutter)
                v, yaw_rate = given.v, given.yaw_rate
            else:
                v = test.task.speed
                yaw_rate = follow(test.task.line, robot.pose, judge.station, v, test.task.yaw_rate)
            write("command", messages.command(v, yaw_rate, now))
            if judge.cause:
                robot.command(v, yaw_rate)
                robot.step(timestep)
                left -= 1
            else:
                test.step(v, yaw_rate)
                steps += 1
            progress.update()
        unfinished.pop_all()
    name = onnx.name if onnx else "route follower"
    return Trial(name, task, lighting, seed, judge.cause, judge.progress, steps)


def _measured(base_to_world: Array, rng: np.random.Generator) -> Array:
    """A pose of the base (4, 4), in the bag's frame of poses and with noise."""
    yaw, x, y = _FRAME
    frame = pose_of(Rotation.from_euler("z", yaw).as_matrix(), np.array([x, y, 0.0]))
    turn = Rotation.from_euler("z", rng.normal(0.0, _FIX_YAW_NOISE)).as_matrix()
    noise = pose_of(turn, np.append(rng.normal(0.0, _FIX_POSITION_NOISE, 2), 0.0))
    return frame @ base_to_world @ noise


class BagMessages:
    """Makes messages of ROS 2 for rosbags."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.types = self.store.types

    def header(self, stamp: int, frame: str = "camera") -> Any:
        """A header with a stamp [ns]."""
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return self.types["std_msgs/msg/Header"](time, frame)

    def jpeg(self, data: Any, stamp: int) -> Any:
        return self.types["sensor_msgs/msg/CompressedImage"](self.header(stamp), "rgb8; jpeg compressed bgr8", data)

    def camera_info(
        self,
        intrinsics: Sequence[float],
        size: tuple[int, int],
        stamp: int,
        model: str = "plumb_bob",
        distortion: Sequence[float] = (0.0,) * 5,
    ) -> Any:
        """A message with fx, fy, cx, cy [px]; these cx, cy are from the first pixel's corner, ROS's from its center."""
        fx, fy, cx, cy = intrinsics
        k = np.array([fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1.0])
        p = np.array([fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1.0, 0])
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self.types["sensor_msgs/msg/CameraInfo"](
            *(self.header(stamp), size[1], size[0], model, np.array(distortion, float), k, np.eye(3).ravel(), p, 0, 0),
            roi,
        )

    def odometry(self, base_to_world: Array, stamp: int) -> Any:
        """A message with a pose of the base (4, 4)."""
        quaternion = Rotation.from_matrix(base_to_world[:3, :3]).as_quat().tolist()
        point = self.types["geometry_msgs/msg/Point"](*base_to_world[:3, 3].tolist())
        pose = self.types["geometry_msgs/msg/Pose"](point, self.types["geometry_msgs/msg/Quaternion"](*quaternion))
        return self.types["nav_msgs/msg/Odometry"](
            self.header(stamp, "odom"),
            "base_link",
            self.types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            self.types["geometry_msgs/msg/TwistWithCovariance"](self._twist(0.0, 0.0), np.zeros(36)),
        )

    def command(self, v: float, yaw_rate: float, stamp: int) -> Any:
        """A message with the command v [m/s], yaw rate [rad/s]."""
        return self.types["geometry_msgs/msg/TwistStamped"](self.header(stamp, "base_link"), self._twist(v, yaw_rate))

    def _twist(self, v: float, yaw_rate: float) -> Any:
        vector = self.types["geometry_msgs/msg/Vector3"]
        return self.types["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(0.0, 0.0, yaw_rate))


def follow(line: Array, pose: tuple[float, float, float], station: float, speed: float, most: float) -> float:
    """Yaw rate [rad/s] that steers the base towards a line, by pure pursuit.

    Args:
        line: Points (x, y) of the line [m], shape (m, 2).
        pose: x, y [m], yaw [rad] of the base.
        station: Station of the nearest point of the line [m].
        speed: Speed of the robot [m/s].
        most: Bound of the yaw rate [rad/s].
    """
    ahead = 0.6 + 0.6 * speed
    x, y = (float(np.interp(station + ahead, stations_of(line), line[:, k])) for k in (0, 1))
    bearing = atan2(y - pose[1], x - pose[0]) - pose[2]
    rate = 2.0 * speed * sin(bearing) / max(hypot(x - pose[0], y - pose[1]), 0.2)
    return copysign(min(abs(rate), most), rate)
