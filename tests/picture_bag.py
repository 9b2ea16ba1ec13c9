"""Writes ROS 2 bags of a robot's trial for tests: pictures, camera_info, odometry and commands."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from twin.reality.recordings import BagMessages

START = 1_700_000_000_000_000_000  # [ns]
MESSAGES = BagMessages()
TYPES = MESSAGES.types
IMAGE, CAMERA_INFO, ODOMETRY, COMMANDS = "/camera/image", "/camera/camera_info", "/odom", "/cmd_vel"


@dataclass(frozen=True)
class Recorded:
    """A message to be written."""

    topic: str
    type: str
    message: Any
    stamp: int
    """Time of its recording [ns]."""


def image(picture: np.ndarray, stamp: int, recorded: int | None = None, encoding: str = "rgb8") -> Recorded:
    """A picture, RGB (h, w, 3): raw as rgb8 or bgra8, or as png or jpeg."""
    height, width = picture.shape[:2]
    time = stamp if recorded is None else recorded
    if encoding in ("png", "jpeg"):
        data = cv2.imencode(f".{encoding}", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
        message = TYPES["sensor_msgs/msg/CompressedImage"](
            MESSAGES.header(stamp), f"rgb8; {encoding} compressed bgr8", data
        )
        return Recorded(f"{IMAGE}/compressed", "sensor_msgs/msg/CompressedImage", message, time)
    rows = picture if encoding == "rgb8" else cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA)
    rows = rows.reshape(height, -1)
    padded = np.zeros((height, rows.shape[1] + 8), np.uint8)  # rows may be longer than their pixels
    padded[:, : rows.shape[1]] = rows
    message = TYPES["sensor_msgs/msg/Image"](
        MESSAGES.header(stamp), height, width, encoding, 0, padded.shape[1], padded.ravel()
    )
    return Recorded(IMAGE, "sensor_msgs/msg/Image", message, time)


def camera_info(intrinsics: Sequence[float], size: tuple[int, int], stamp: int) -> Recorded:
    """`intrinsics` are in twin's convention, from the corner of the first pixel."""
    message = MESSAGES.camera_info(intrinsics, size, stamp)
    return Recorded(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", message, stamp)


def odometry(base_to_world: np.ndarray, stamp: int) -> Recorded:
    """A pose of the base (4, 4)."""
    return Recorded(ODOMETRY, "nav_msgs/msg/Odometry", MESSAGES.odometry(base_to_world, stamp), stamp)


def command(v: float, yaw_rate: float, stamp: int) -> Recorded:
    return Recorded(COMMANDS, "geometry_msgs/msg/TwistStamped", MESSAGES.command(v, yaw_rate, stamp), stamp)


def write(
    path: Path,
    messages: Sequence[Recorded],
    mcap: bool = True,
    compression: CompressionMode = CompressionMode.NONE,
    in_order: bool = True,
) -> Path:
    """Writes a bag's folder, in MCAP or sqlite3, with the messages sorted by time if `in_order`."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        topics: dict[tuple[str, str], Any] = {}
        for one in sorted(messages, key=lambda each: each.stamp) if in_order else messages:
            key = one.topic, one.type
            if key not in topics:
                topics[key] = writer.add_connection(*key, typestore=MESSAGES.store)
            writer.write(topics[key], one.stamp, MESSAGES.store.serialize_cdr(one.message, one.type))
    return path
