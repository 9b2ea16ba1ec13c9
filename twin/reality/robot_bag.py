"""A ROS 2 bag of one trial of the real test, as a real Husky would record it, for `twin.trial`.

The robot runs `twin_policy`'s pilot on its camera's JPEG pictures; without a policy, it follows the task's line. The
bag has these pictures, camera_info, commands, and poses with the accuracy of RTK, in a frame of their own. Recording
continues for 1.5 s after the trial's end.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from twin.errors import InputError
from twin.evaluation.trials import Trial
from twin.files import remove
from twin.reality import SEED
from twin.reality.lighting import weather_index
from twin.reality.real_camera import intrinsics_of, native_size
from twin.reality.real_robot import follow
from twin.reality.real_test import RealTest, Setup
from twin.reality.road_task import task_of_place
from twin.runtime import bar
from twin.types import Array
from twin_policy import Camera, CompressedPicture, Limits, OnnxPolicy, Pilot

_START = 1_700_000_000  # [s] Unix time of the first trial
_APART = 400  # [s] between the starts of two trials
_WEATHERS, MOST_SEED = 1000, 999  # upper bounds, so that times fit into ROS's 32-bit seconds
_WIDTH = 640  # [px] width of the camera's stream
_QUALITY = 92  # JPEG quality
_POSITION_NOISE, _YAW_NOISE = 0.01, 0.003  # [m], [rad]
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
    """Drives one trial and records it; returns its true outcome.

    Args:
        path: Folder of the bag to write.
        policy: A policy folder with policy.onnx; if None, the robot follows the line.
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
            raise InputError(str(error)) from None
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
    frame = np.eye(4)
    frame[:3, :3], frame[:2, 3] = Rotation.from_euler("z", yaw).as_matrix(), (x, y)
    noise = np.eye(4)
    noise[:3, :3] = Rotation.from_euler("z", rng.normal(0.0, _YAW_NOISE)).as_matrix()
    noise[:2, 3] = rng.normal(0.0, _POSITION_NOISE, 2)
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
