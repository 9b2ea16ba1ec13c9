"""Writes a ROS 2 bag of a drive, as a Husky would record it, for the tests of reading one."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from twin.robot import TRACK, WHEEL_RADIUS, WHEELS

_TOPICS = {
    "commands": ("/cmd_vel", "geometry_msgs/msg/TwistStamped"),
    "wheels": ("/platform/joint_states", "sensor_msgs/msg/JointState"),
    "wheel odometry": ("/platform/odom", "nav_msgs/msg/Odometry"),
    "poses": ("/icp_odom", "nav_msgs/msg/Odometry"),
    "imu": ("/imu/data", "sensor_msgs/msg/Imu"),
    "camera's imu": ("/camera/imu", "sensor_msgs/msg/Imu"),
    "arm": ("/arm/joint_states", "sensor_msgs/msg/JointState"),
}
_OFTEN = ("camera's imu", "arm")


def write_bag(
    path: Path, table: dict[str, NDArray], without: tuple[str, ...] = (), poses: str = _TOPICS["poses"][0]
) -> Path:
    """Writes a table of `twin.sysid.logs` as a bag, with the `poses` on this topic.

    The wheels' poses stand still, the camera's IMU has optical axes, and the arm has no wheels, so that a test notices
    if they are used. Camera and arm write each message twice. Rows whose `cmd_v` is NaN have no command.
    """
    store = get_typestore(Stores.LATEST)
    t = store.types
    zero = np.zeros(9)

    def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0):
        return t["geometry_msgs/msg/Vector3"](x, y, z)

    def turn(yaw: float):
        return t["geometry_msgs/msg/Quaternion"](0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))

    def odometry(header, x: float, y: float, yaw: float, v: float = 0.0, yaw_rate: float = 0.0):
        pose = t["geometry_msgs/msg/Pose"](t["geometry_msgs/msg/Point"](x, y, 0.0), turn(yaw))
        twist = t["geometry_msgs/msg/Twist"](vector(v), vector(z=yaw_rate))
        return t["nav_msgs/msg/Odometry"](
            header,
            "base_link",
            t["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            t["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        )

    def imu(header, x: float, y: float, z: float):
        return t["sensor_msgs/msg/Imu"](header, turn(0.0), zero, vector(), zero, vector(x, y, z), zero)

    def joints(header, names: list[str], speeds: list[float]):
        none = np.zeros(0)
        return t["sensor_msgs/msg/JointState"](header, names, np.zeros(len(names)), np.array(speeds), none)

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            kind: writer.add_connection(poses if kind == "poses" else topic, type_, typestore=store)
            for kind, (topic, type_) in _TOPICS.items()
            if kind not in without
        }
        for i in range(len(table["time"])):
            row = {name: float(column[i]) for name, column in table.items()}
            stamp = round(row["time"] * 1e9) + 1_700_000_000_000_000_000
            time = t["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
            header = t["std_msgs/msg/Header"](time, "odom")
            sides = [row["left_wheel_vel"], row["right_wheel_vel"]]
            messages = {
                "commands": t["geometry_msgs/msg/TwistStamped"](
                    header, t["geometry_msgs/msg/Twist"](vector(row["cmd_v"]), vector(z=row["cmd_yaw_rate"]))
                ),
                "poses": odometry(header, row["x"], row["y"], row["yaw"]),
                "wheel odometry": odometry(
                    *(header, 0.0, 0.0, 0.0, (sides[1] + sides[0]) * WHEEL_RADIUS / 2),
                    (sides[1] - sides[0]) * WHEEL_RADIUS / (TRACK * 1.875),
                ),
                "imu": imu(header, row["acceleration_x"], row["acceleration_y"], 9.81),
                "camera's imu": imu(header, -row["acceleration_y"], -9.81, row["acceleration_x"]),
                "wheels": joints(header, [f"{name}_wheel_joint" for name in WHEELS], [*sides, *sides]),
                "arm": joints(header, ["shoulder"], [0.0]),
            }
            for kind, message in messages.items():
                if kind in topics and not (kind == "commands" and np.isnan(row["cmd_v"])):
                    connection = topics[kind]
                    for _ in range(2 if kind in _OFTEN else 1):
                        writer.write(connection, stamp, store.serialize_cdr(message, connection.msgtype))
    return path
