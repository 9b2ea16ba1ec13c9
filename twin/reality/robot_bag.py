"""A ROS 2 bag of one trial of the hidden robot, as a real Husky would record it, for `twin.trial`.

The robot runs `twin_policy`'s pilot on JPEG pictures of its native camera, or, without a policy, follows the route. The
bag has those pictures, camera_info, commands, and poses such as RTK gives them, in a frame of their own. Recording goes
on for a moment after the trial's end.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from twin.env.drivers import PurePursuit
from twin.env.options import STEERING, TWIST, parse_options
from twin.env.task import CAMERA, control
from twin.errors import InputError
from twin.evaluation.trials import Trial
from twin.files import remove
from twin.learn.policy import Control
from twin.reality import SEED, true_world
from twin.reality.lighting import WEATHER
from twin.reality.rasterizer import Rasterizer
from twin.reality.real_robot import RealCamera, TrueRoad, hidden_robot, shadow_range
from twin.runtime import bar
from twin.types import Array
from twin_policy import Camera, CompressedPicture, Limits, OnnxPolicy, Pilot

_START = 1_700_000_000  # [s] time of the first trial
_APART = 1000  # [s] between the starts of two trials
_WIDTH = 640  # [px] of the camera's stream
_QUALITY = 92  # of JPEG
_POSITION_NOISE, _YAW_NOISE = 0.01, 0.003  # [m], [rad]
_FRAME = (0.7, 251.0, -38.0)  # yaw [rad], x, y [m] of the scene in the poses' frame
_AFTER = 1.5  # [s] recorded after the end
_TOPICS = {
    "picture": ("/sensors/camera_0/color/compressed", "sensor_msgs/msg/CompressedImage"),
    "camera": ("/sensors/camera_0/color/camera_info", "sensor_msgs/msg/CameraInfo"),
    "pose": ("/sensors/gps_0/odom", "nav_msgs/msg/Odometry"),
    "command": ("/cmd_vel", "geometry_msgs/msg/TwistStamped"),
}


def write_robot_bag(path: Path, policy: Path | None, task: str, lighting: str, seed: int = 0, number: int = 0) -> Trial:
    """Drives one trial and records it; returns its true outcome.

    Args:
        path: Folder of the bag to write.
        policy: A policy folder with policy.onnx; None: the robot follows the route.
        task: See `TrueRoad`.
        lighting: One of `WEATHER`.
        seed: Of all randomness.
        number: Number of the place.

    Raises:
        InputError: rosbags is not installed, the path exists, or an unknown policy, task or lighting.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise InputError(f"{path}: writing a ROS 2 bag needs rosbags; pip install 'twin[ros]'") from None
    if path.exists():
        raise InputError(f"{path} exists; give another --out, or delete it")
    if lighting not in WEATHER:
        raise InputError(f"unknown lighting {lighting!r}; the real test offers {', '.join(WEATHER)}")
    robot = hidden_robot()
    onnx, driving = None, Control(TWIST)
    if policy:
        try:
            onnx = OnnxPolicy(policy)
        except ValueError as error:
            raise InputError(str(error)) from None
        driving = Control(onnx.action, onnx.speed, onnx.max_yaw_rate, onnx.timestep)
    road = TrueRoad(task, robot, parse_options({**asdict(driving), "pixels": False}), number)
    drive, physics = road.drive, road.physics
    environment = control.Environment(physics, drive, control_timestep=driving.control_timestep)
    drive.seed(seed)
    environment.reset()
    size = _WIDTH, round(_WIDTH * robot.params.camera_size[1] / robot.params.camera_size[0])
    fx, fy, cx, cy = road.intrinsics(size).tolist()
    model = true_world.world_spec(WEATHER[lighting], road.place).compile()
    raster = Rasterizer(model, np.array((fx, fy, cx, cy)), size, shadow_range(road.place))
    camera = RealCamera(raster, WEATHER[lighting], robot, np.array((fx, fy, cx, cy)), size, drive.rng(CAMERA))
    rng, messages = np.random.default_rng([SEED, 44, seed]), BagMessages()
    begin = now = (_START + _APART * (list(WEATHER).index(lighting) + len(WEATHER) * seed)) * 10**9

    def clock() -> int:
        return now

    pilot = Pilot(onnx, Limits(), None, clock, clock) if onnx else None
    if pilot:
        pilot.set_camera(Camera(size, (fx, fy, cx, cy)))
    pursuit = PurePursuit(road.world.route, driving.speed, driving.yaw_rate, road.segment.start)
    steps, left = 0, round(_AFTER / driving.control_timestep)
    path.parent.mkdir(parents=True, exist_ok=True)
    limit = round(drive.time_limit / driving.control_timestep) + left
    with contextlib.ExitStack() as stack:
        unfinished = stack.enter_context(contextlib.ExitStack())  # what Ctrl-C leaves behind is no bag
        unfinished.callback(remove, path)
        writer = stack.enter_context(Writer(path, version=9, storage_plugin=StoragePlugin.MCAP))
        progress = stack.enter_context(bar("trial", limit, "step"))
        topics = {kind: writer.add_connection(*topic, typestore=messages.store) for kind, topic in _TOPICS.items()}

        def write(kind: str, message: Any) -> None:
            writer.write(topics[kind], now, messages.store.serialize_cdr(message, _TOPICS[kind][1]))

        while left:
            now = begin + round(physics.time() * 1e9)
            shutter = now - round(robot.params.camera_latency * 1e9)
            image = camera.capture(physics.camera_to_world, physics.time())
            jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
            write("camera", messages.camera_info((fx, fy, cx, cy), size, shutter))
            write("pose", messages.odometry(_measured(physics.base_to_world, rng), now))
            write("picture", messages.jpeg(jpeg, shutter))
            if pilot:
                given = pilot.picture(CompressedPicture(jpeg), shutter)
                v, yaw_rate = given.v, given.yaw_rate
            else:
                pursuit.update(physics.planar_pose)
                v, yaw_rate = pursuit.command(physics.planar_pose)
            write("command", messages.command(v, yaw_rate, now))
            if drive.cause:
                physics.robot.command(v, yaw_rate)
                physics.robot.step(driving.control_timestep)
                left -= 1
            else:
                environment.step(np.array([yaw_rate] if driving.action == STEERING else [v, yaw_rate]))
                steps += 1
            progress.update()
        unfinished.pop_all()
    name = onnx.name if onnx else "route follower"
    return Trial(name, drive.segment.name, lighting, seed, drive.cause, drive.progress, steps)


def _measured(base_to_world: Array, rng: np.random.Generator) -> Array:
    """A pose of the base (4, 4) in the poses' frame, with noise."""
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
        """`intrinsics` fx, fy, cx, cy [px] from the corner of the first pixel; ROS counts from its center."""
        fx, fy, cx, cy = intrinsics
        k = np.array([fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1.0])
        p = np.array([fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1.0, 0])
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self.types["sensor_msgs/msg/CameraInfo"](
            *(self.header(stamp), size[1], size[0], model, np.array(distortion, float), k, np.eye(3).ravel(), p, 0, 0),
            roi,
        )

    def odometry(self, base_to_world: Array, stamp: int) -> Any:
        """A pose of the base (4, 4)."""
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
        """v [m/s], yaw rate [rad/s]."""
        return self.types["geometry_msgs/msg/TwistStamped"](self.header(stamp, "base_link"), self._twist(v, yaw_rate))

    def _twist(self, v: float, yaw_rate: float) -> Any:
        vector = self.types["geometry_msgs/msg/Vector3"]
        return self.types["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(0.0, 0.0, yaw_rate))
