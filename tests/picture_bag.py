"""Writes ROS 2 bags of a robot's trial for tests: pictures, camera_info, odometry and commands."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

START = 1_700_000_000_000_000_000  # [ns]
STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
IMAGE, CAMERA_INFO, ODOMETRY, COMMANDS = "/camera/image", "/camera/camera_info", "/odom", "/cmd_vel"


@dataclass(frozen=True)
class Recorded:
    """A message to be written."""

    topic: str
    type: str
    message: Any
    stamp: int
    """Time of its recording [ns]."""


def header(stamp: int, frame: str = "camera") -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return TYPES["std_msgs/msg/Header"](time, frame)


def image(picture: np.ndarray, stamp: int, recorded: int | None = None, encoding: str = "rgb8") -> Recorded:
    """A picture, RGB (h, w, 3): raw as rgb8 or bgra8, or as png or jpeg."""
    height, width = picture.shape[:2]
    time = stamp if recorded is None else recorded
    if encoding in ("png", "jpeg"):
        data = cv2.imencode(f".{encoding}", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        message = TYPES["sensor_msgs/msg/CompressedImage"](header(stamp), f"rgb8; {encoding} compressed bgr8", data)
        return Recorded(f"{IMAGE}/compressed", "sensor_msgs/msg/CompressedImage", message, time)
    rows = picture if encoding == "rgb8" else cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA)
    rows = rows.reshape(height, -1)
    padded = np.zeros((height, rows.shape[1] + 8), np.uint8)  # rows may be longer than their pixels
    padded[:, : rows.shape[1]] = rows
    message = TYPES["sensor_msgs/msg/Image"](header(stamp), height, width, encoding, 0, padded.shape[1], padded.ravel())
    return Recorded(IMAGE, "sensor_msgs/msg/Image", message, time)


def camera_info(
    intrinsics: Sequence[float], size: tuple[int, int], stamp: int, model: str = "plumb_bob", distortion=(0.0,) * 5
) -> Recorded:
    """`intrinsics` as twin has them, from the corner of the first pixel."""
    fx, fy, cx, cy = intrinsics
    k = np.array([fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1.0])
    p = np.array([fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1.0, 0])
    roi = TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    message = TYPES["sensor_msgs/msg/CameraInfo"](
        header(stamp), size[1], size[0], model, np.array(distortion), k, np.eye(3).ravel(), p, 0, 0, roi
    )
    return Recorded(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", message, stamp)


def odometry(base_to_world: np.ndarray, stamp: int) -> Recorded:
    """A pose of the base (4, 4)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(base_to_world[:3, :3]).as_quat()
    point = TYPES["geometry_msgs/msg/Point"](*base_to_world[:3, 3].tolist())
    pose = TYPES["geometry_msgs/msg/Pose"](point, TYPES["geometry_msgs/msg/Quaternion"](x, y, z, w))
    message = TYPES["nav_msgs/msg/Odometry"](
        header(stamp, "odom"),
        "base_link",
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](_twist(0.0, 0.0), np.zeros(36)),
    )
    return Recorded(ODOMETRY, "nav_msgs/msg/Odometry", message, stamp)


def command(v: float, yaw_rate: float, stamp: int) -> Recorded:
    message = TYPES["geometry_msgs/msg/TwistStamped"](header(stamp, "base_link"), _twist(v, yaw_rate))
    return Recorded(COMMANDS, "geometry_msgs/msg/TwistStamped", message, stamp)


def _twist(v: float, yaw_rate: float) -> Any:
    vector = TYPES["geometry_msgs/msg/Vector3"]
    return TYPES["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(0.0, 0.0, yaw_rate))


def write(path: Path, messages: Sequence[Recorded], mcap: bool = True) -> Path:
    """Writes a bag's folder, in MCAP or sqlite3."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics: dict[str, Any] = {}
        for one in sorted(messages, key=lambda each: each.stamp):
            if one.topic not in topics:
                topics[one.topic] = writer.add_connection(one.topic, one.type, typestore=STORE)
            writer.write(topics[one.topic], one.stamp, STORE.serialize_cdr(one.message, one.type))
    return path
