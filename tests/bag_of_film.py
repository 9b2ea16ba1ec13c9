"""Writes a robot's bag of given pictures along given poses: calibration, odometry, fixes and the camera's seat."""

from pathlib import Path

import numpy as np
from picture_bag import CAMERA_INFO, IMAGE, MESSAGES, START, TYPES, Recorded, image, odometry, write
from scipy.spatial.transform import Rotation

from twin.capture.camera_models import Lens
from twin.robot import CAMERA_AHEAD

FRAME = "camera_optical"
EARTH = 6_378_137.0  # [m]


def camera_info(lens: Lens, stamp: int = START, frame: str = FRAME) -> Recorded:
    """A CameraInfo of a lens that ROS knows."""
    model, d = "plumb_bob", lens.distortion
    if lens.model == "OPENCV_FISHEYE":
        model = "equidistant"
    elif lens.model == "FULL_OPENCV":
        model = "rational_polynomial"
    message = MESSAGES.camera_info(lens.intrinsics.tolist(), (lens.width, lens.height), stamp, model, d)
    message.header.frame_id = frame
    return Recorded(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", message, stamp)


def transform(parent: str, child: str, rotation: Rotation, position, topic: str = "/tf_static") -> Recorded:
    x, y, z, w = rotation.as_quat().tolist()
    message = TYPES["tf2_msgs/msg/TFMessage"](
        [
            TYPES["geometry_msgs/msg/TransformStamped"](
                MESSAGES.header(START, parent),
                child,
                TYPES["geometry_msgs/msg/Transform"](
                    TYPES["geometry_msgs/msg/Vector3"](*map(float, position)),
                    TYPES["geometry_msgs/msg/Quaternion"](x, y, z, w),
                ),
            )
        ]
    )
    return Recorded(topic, "tf2_msgs/msg/TFMessage", message, START)


def seat(height: float, ahead: float, pitch: float, base_height: float = 0.1) -> list[Recorded]:
    """Frames of a camera `height` [m] above the ground, which looks down by `pitch` [rad]."""
    mount = Rotation.from_euler("ZYX", (0.0, pitch, 0.0))
    return [
        transform("base_link", "base_footprint", Rotation.identity(), (0, 0, -base_height)),
        transform("base_link", "camera", mount, (ahead, 0, height - base_height)),
        transform("camera", FRAME, Rotation.from_matrix(CAMERA_AHEAD), (0, 0, 0)),
    ]


def fix(position, stamp: int, status: int = 0) -> Recorded:
    """East, north [m] near 49° N, 8° E."""
    north = np.degrees(position[1] / EARTH)
    east = np.degrees(position[0] / EARTH / np.cos(np.radians(49.0)))
    message = TYPES["sensor_msgs/msg/NavSatFix"](
        *(MESSAGES.header(stamp), TYPES["sensor_msgs/msg/NavSatStatus"](status, 1)),
        *(49.0 + float(north), 8.0 + float(east), 100.0, np.zeros(9), 2),
    )
    return Recorded("/gps/fix", "sensor_msgs/msg/NavSatFix", message, stamp)


def pictures(frames: list[np.ndarray], times: np.ndarray, encoding: str = "rgb8") -> list[Recorded]:
    """Frames (h, w, 3) at times [s]."""
    out = []
    for frame, time in zip(frames, times, strict=True):
        one = image(frame, START + round(float(time) * 1e9), encoding=encoding)
        one.message.header.frame_id = FRAME
        out.append(one)
    return out


def drive(base_to_world: np.ndarray, times: np.ndarray, stretch: float = 1.0) -> list[Recorded]:
    """Odometry and fixes of a base's poses (n, 4, 4) at times [s]; odometry lengths are `stretch` times too long."""
    out = []
    for pose, time in zip(base_to_world, times, strict=True):
        stamp = START + round(float(time) * 1e9)
        scaled = pose.copy()
        scaled[:3, 3] *= stretch
        out += [odometry(scaled, stamp), fix(pose[:2, 3], stamp)]
    return out


def write_ros1(path: Path, frames: list[np.ndarray], times: np.ndarray) -> Path:
    """A .bag file of ROS 1 with frames (h, w, 3) at times [s], their camera_info and the camera on the robot."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    types = store.types
    height, width = frames[0].shape[:2]

    def header(stamp: int, frame: str = FRAME):
        return types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), frame)

    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    k, p = np.zeros(9), np.zeros(12)
    k[[0, 4, 2, 5, 8]] = 0.9 * width, 0.9 * width, width / 2 - 0.5, height / 2 - 0.5, 1.0
    point, turn = types["geometry_msgs/msg/Vector3"](0.3, 0.0, 0.5), Rotation.from_matrix(CAMERA_AHEAD).as_quat()
    mount = types["geometry_msgs/msg/TransformStamped"](
        header(START, "base_link"),
        FRAME,
        types["geometry_msgs/msg/Transform"](point, types["geometry_msgs/msg/Quaternion"](*turn.tolist())),
    )
    info = types["sensor_msgs/msg/CameraInfo"](
        *(header(START), height, width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, roi)
    )
    with Writer(path) as writer:

        def connection(topic: str, kind: str):
            return writer.add_connection(topic, kind, typestore=store)

        def put(to, stamp: int, message) -> None:
            writer.write(to, stamp, store.serialize_ros1(message, to.msgtype))

        put(connection("/tf_static", "tf2_msgs/msg/TFMessage"), START, types["tf2_msgs/msg/TFMessage"]([mount]))
        put(connection("/camera/camera_info", "sensor_msgs/msg/CameraInfo"), START, info)
        images = connection("/camera/image_raw", "sensor_msgs/msg/Image")
        for frame, time in zip(frames, times, strict=True):
            stamp = START + round(float(time) * 1e9)
            rows = np.ascontiguousarray(frame[..., ::-1])
            put(
                images,
                stamp,
                types["sensor_msgs/msg/Image"](header(stamp), height, width, "bgr8", 0, 3 * width, rows.ravel()),
            )
    return path


__all__ = [
    "CAMERA_INFO",
    "IMAGE",
    "START",
    "camera_info",
    "drive",
    "fix",
    "pictures",
    "seat",
    "transform",
    "write",
    "write_ros1",
]
