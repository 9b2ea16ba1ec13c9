"""ROS 2 bags read as tables, with `rosbags` (the extra `ros`; no ROS installation is needed).

Topics are selected by message type: geometry_msgs/Twist or TwistStamped for commands; sensor_msgs/JointState, with
joints named like a Husky's wheels, for wheel speeds; nav_msgs/Odometry, geometry_msgs/PoseStamped or
PoseWithCovarianceStamped for poses, preferably without a word of `_FROM_WHEELS` in the topic's name; sensor_msgs/Imu
for accelerations. The table has a row per joint state, with the newest values of the other topics.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import InputError
from twin.robot import WHEELS
from twin.types import Array

TYPES = {
    "commands": ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"),
    "wheels": ("sensor_msgs/msg/JointState",),
    "poses": (
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
    ),
    "imu": ("sensor_msgs/msg/Imu",),
}
"""Message types of each kind of topic."""
_FROM_WHEELS = ("platform", "wheel", "velocity_controller")


@contextmanager
def open_bag(path: Path, cure: str = "record it anew") -> Iterator[Any]:
    """A reader of rosbags.

    Raises InputError: rosbags is not installed, or the bag is unreadable. Errors of rosbags inside the `with` block
    become an InputError, too.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"{path}: reading a ROS 2 bag needs rosbags; pip install 'twin[ros]'") from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # of the reader: not a bag, a damaged one, unknown messages
        raise InputError(f"{path}: not a readable ROS 2 bag: {error}; {cure}") from None


def read_bag(path: Path) -> dict[str, Array]:
    """The columns that `twin.sysid.logs` describes.

    Raises InputError: rosbags is not installed, the bag is unreadable, or a kind of message is missing.
    """
    with open_bag(path, "record it anew or give a .csv") as reader:
        chosen = choose_topics(reader.connections, path)
        rows: dict[str, list[tuple[float, ...]]] = {kind: [] for kind in chosen}
        kinds = {connection.id: kind for kind, connection in chosen.items()}
        begin = reader.start_time  # [ns], subtracted as an integer: as a float it would be rounded to 0.2 µs
        for connection, stamp, raw in reader.messages(connections=list(chosen.values())):
            kind = kinds[connection.id]
            values = VALUES[kind](reader.deserialize(raw, connection.msgtype))
            if values is not None:
                rows[kind].append(((stamp - begin) * 1e-9, *values))
    empty = [kind for kind, values in rows.items() if not values]
    if empty:
        raise InputError(f"{path}: no usable message of {', '.join(empty)}; expected some; record those topics")
    return _columns({kind: np.array(values) for kind, values in rows.items()})


def choose_topics(connections: Any, path: Path, kinds: Sequence[str] = tuple(TYPES)) -> dict[str, Any]:
    """The connection of each kind, a key of `TYPES`. Raises InputError: a kind other than imu has none."""
    chosen = {}
    for kind in kinds:
        types = TYPES[kind]
        found = [c for c in connections if c.msgtype in types and c.msgcount]
        if kind == "commands":  # prefer the controller's input to the multiplexer's
            found.sort(key=lambda c: (not c.topic.endswith("cmd_vel"), -c.msgcount))
        elif kind == "poses":
            found.sort(key=lambda c: (any(word in c.topic for word in _FROM_WHEELS), -c.msgcount))
        else:
            found.sort(key=lambda c: -c.msgcount)
        if found:
            chosen[kind] = found[0]
        elif kind != "imu":
            topics = ", ".join(sorted({c.topic for c in connections})) or "none"
            raise InputError(f"{path}: no topic with {kind} ({' or '.join(types)}) among {topics}; record it")
    return chosen


def _twist(message: Any) -> tuple[float, ...]:
    twist = getattr(message, "twist", message)
    return twist.linear.x, twist.angular.z


def _wheels(message: Any) -> tuple[float, ...] | None:
    speeds = dict(zip(message.name, message.velocity, strict=False))
    sides = [[v for name, v in speeds.items() for w in WHEELS[i::2] if name.startswith(w)] for i in (0, 1)]
    return tuple(float(np.mean(side)) for side in sides) if all(sides) else None


def _pose(message: Any) -> tuple[float, ...]:
    pose = message.pose
    pose = getattr(pose, "pose", pose)
    p, q = pose.position, pose.orientation
    return p.x, p.y, float(np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)))


def _imu(message: Any) -> tuple[float, ...]:
    return message.linear_acceleration.x, message.linear_acceleration.y


VALUES: dict[str, Callable[[Any], Any]] = {"commands": _twist, "wheels": _wheels, "poses": _pose, "imu": _imu}
"""Functions from a message of each kind to its numbers: v, ω; wheel speeds; x, y, yaw; accelerations."""
_NAMES = {
    "commands": ("cmd_v", "cmd_yaw_rate"),
    "wheels": ("left_wheel_vel", "right_wheel_vel"),
    "poses": ("x", "y", "yaw"),
    "imu": ("acceleration_x", "acceleration_y"),
}


def _columns(tables: dict[str, Array]) -> dict[str, Array]:
    """A row per joint state, once every topic has had a message."""
    begin = max(table[0, 0] for table in tables.values())
    time = np.unique(tables["wheels"][:, 0])
    time = time[time >= begin]
    columns = {"time": time - (time[0] if len(time) else 0.0)}
    for kind, table in tables.items():
        newest = np.searchsorted(table[:, 0], time, side="right") - 1
        columns |= {name: table[newest, i + 1] for i, name in enumerate(_NAMES[kind])}
    return columns
