"""Reads robots' recordings (bags) with `rosbags` (the extra `ros`; no ROS installation is needed).

A bag is the folder of a ROS 2 recording (MCAP or SQLite), one of its .mcap or .db3 files, or a .bag file of ROS 1.
Messages are deserialized with the standard definitions of their types. The definitions inside the bag are not used,
because `rosbags` would generate code from them. Messages are streamed; memory holds one chunk of the file.
Pictures are decoded by `ros2/twin_policy/twin_policy/pictures.py`, as on the robot.

Topics are found by message type:

- commands: geometry_msgs/Twist or TwistStamped
- wheel speeds: sensor_msgs/JointState, with joints named like a Husky's wheels
- poses: nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped; odometry from the wheels (see
  `is_from_wheels`) is used only if no other topic has `MIN_POSES` messages
- accelerations: sensor_msgs/Imu
- pictures: sensor_msgs/Image or CompressedImage
- calibration: the sensor_msgs/CameraInfo topic whose name shares the most leading parts (between slashes) with the name
  of the pictures' topic

Times are nanoseconds.
"""

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.errors import InputError, join_names
from twin.files import is_file, read_text
from twin.robot import WHEELS

if TYPE_CHECKING:
    from twin_policy import CompressedPicture, RawPicture

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
METADATA = "metadata.yaml"  # the file by which a folder is recognized as a ROS 2 bag
RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, FIX = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/NavSatFix"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
TYPES = {
    "commands": ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"),
    "wheels": ("sensor_msgs/msg/JointState",),
    "poses": (ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    "imu": ("sensor_msgs/msg/Imu",),
}  # message types of each kind of topic
FROM_WHEELS = ("platform", "wheel", "velocity_controller")
"""A topic with one of these words in its name is taken for odometry computed from the wheels."""
MIN_POSES = 10
"""A topic with fewer poses, such as the goals that an operator clicks on a map, is used only if no topic has this
many."""
# A topic with one of these words in its name is used for pictures only if it is given explicitly.
_OTHER_IMAGES = re.compile(r"(?<![^/_])(depth|confidence|disparity|mask|infra\d*)(?![^/_])")
_RECTIFIED = re.compile(r"(?<![^/_])rect(ified)?(?![^/_])")  # words end at slashes and underscores
# [ns] If the median difference between header and recording times exceeds this, the headers use another clock.
_CLOCK = 1_000_000_000
_SET_BACK = 10 * _CLOCK  # [ns] if a time is earlier than one before it in the file by more, the clock was set back
_MAX_METADATA = 16 << 20  # [bytes] largest accepted metadata.yaml
_MIN_NORM = 0.5  # a quaternion with a smaller norm is no orientation
_MAX_CHUNK = 1 << 30  # [bytes] largest accepted MCAP chunk, uncompressed


def is_bag(path: Path) -> bool:
    """True for the folder of a ROS 2 bag, and for an existing file with a suffix of `BAG_SUFFIXES`."""
    return (path.suffix.lower() in BAG_SUFFIXES and is_file(path)) or is_file(path / METADATA)


def bag_files(path: Path) -> list[Path]:
    return sorted(filter(is_file, path.iterdir())) if path.is_dir() else [path]


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any, deserialize: Callable[[bytes, str], Any], cure: str) -> None:
        self._path, self._reader, self._deserialize, self._cure = path, reader, deserialize, cure
        self.connections: list[Any] = list(reader.connections)
        """Connections of `rosbags`, with `topic`, `msgtype` and `msgcount`; a topic may have several connections."""
        self.begin = int(reader.start_time)
        """Time of the first message [ns]."""

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, Any]]:
        """Yields connection, recording time [ns] and message. Raises InputError if the bag is damaged."""
        if not connections:
            return
        with _wrap_errors(self._path, self._cure):
            self._check_clock({one.topic for one in connections})
            for connection, recorded, raw in self._reader.messages(connections=connections):
                yield connection, recorded, self._deserialize(raw, connection.msgtype)

    def _check_clock(self, topics: set[str]) -> None:
        """Raises InputError if the recorder's clock was set back: readers sort messages by it, which would mix them.

        MCAP and ROS 1 bags store times by chunk, so a clock set back within the first or last chunk is not seen.
        """
        for topic in sorted(topics):
            times = np.array([*_times_in_file(self._reader, topic)], np.int64).reshape(-1, 2)
            # If the clock jumps within a chunk, that chunk spans both times. So a chunk is also compared with the one
            # two before it.
            for lag in (1, 2):
                back = int((times[:-lag] - times[lag:]).min(1, initial=2**62).max(initial=0))
                if back > _SET_BACK:
                    raise InputError(
                        f"{self._path}: {topic}: the recorder's clock was set back by about {back * 1e-9:.0f} s, so "
                        "parts of the recording have the same times; record it again after the clock has been set"
                    )

    def on(self, *topics: str) -> list[Any]:
        return [one for one in self.connections if one.topic in topics]


@contextmanager
def open_bag(path: Path, cure: str = "record it again") -> Iterator[Bag]:
    """Opens a bag.

    Raises InputError if rosbags is not installed, if the path is not a bag, or if the bag is damaged. The message on a
    damaged bag ends with `cure`, the advice to the user.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(f"{path}: reading a bag needs rosbags; pip install 'twin[ros]'") from None
    if not is_bag(path):
        raise InputError(f"{path}: not a bag; expected a ROS 2 bag's folder, or a .mcap, .db3 or .bag file")
    metadata = path / METADATA
    if path.is_dir() and metadata.stat().st_size > _MAX_METADATA:
        raise InputError(f"{metadata} has {metadata.stat().st_size:,} bytes; expected at most {_MAX_METADATA:,}")
    with contextlib.ExitStack() as stack:
        with _wrap_errors(path, cure):
            if path.suffix.lower() == ".bag" and not path.is_dir():
                store = get_typestore(Stores.ROS1_NOETIC)
                store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
                reader: Any = stack.enter_context(rosbag1.Reader(path))
                deserialize = store.deserialize_ros1
            else:
                deserialize = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
                reader = stack.enter_context(rosbag2.Reader(path))
                _check_chunks(reader)
            bag = Bag(path, reader, deserialize, cure)
        yield bag


def _check_chunks(reader: Any) -> None:
    """Raises ValueError for MCAP chunks that would take too much memory."""
    storages = getattr(reader.storage, "storages", [reader.storage])
    chunks = [chunk for storage in storages for chunk in getattr(storage, "chunks", ())]
    largest = max((chunk.uncompressed_size for chunk in chunks), default=0)
    if largest > _MAX_CHUNK:
        raise ValueError(f"a chunk of {largest:,} bytes; expected at most {_MAX_CHUNK:,}")


def _times_in_file(reader: Any, topic: str) -> Iterator[tuple[int, int]]:
    """Yields first and last time [ns] of a topic's messages or chunks in the order in which they were written."""
    if hasattr(reader, "chunk_infos"):  # ROS 1
        ids = {one.id for one in reader.connections if one.topic == topic}
        yield from ((c.start_time, c.end_time) for c in reader.chunk_infos if not ids.isdisjoint(c.connection_counts))
        return
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        ids = {one.id for one in storage.connections if one.topic == topic}
        if hasattr(storage, "dbconn"):
            known = ",".join(map(str, ids)) or "NULL"
            query = f"SELECT timestamp, timestamp FROM messages WHERE topic_id IN ({known}) ORDER BY id"
            yield from storage.dbconn.cursor().execute(query)
        for chunk in getattr(storage, "chunks", ()):
            if any(chunk.channel_count.get(one) for one in ids):
                yield chunk.message_start_time, chunk.message_end_time


_COMPRESSED = re.compile(r"compression_mode: *['\"]?[A-Za-z]")
"""Matches the text of a bag's `METADATA` if messages or files are compressed; only this text has that information."""


@contextmanager
def _wrap_errors(path: Path, cure: str) -> Iterator[None]:
    try:
        yield
    except (InputError, GeneratorExit):
        raise
    except Exception as error:  # from rosbags: not a bag, a damaged bag, or unknown messages
        if "end magic" in str(error) or "seems to be empty" in str(error):
            cure = "the recording was cut off: repair it by `mcap recover`, or " + cure
        elif "not indexed" in str(error):
            cure = "the recording was cut off: repair it by `rosbag reindex`, or " + cure
        elif is_file(path.parent / METADATA) and _COMPRESSED.search(read_text(path.parent / METADATA)):
            cure = f"give the bag's folder, {path.parent}, or " + cure
        said = str(error).rstrip(".") or type(error).__name__
        raise InputError(f"{path}: not a readable bag: {said}; {cure}") from None


# ---- topics


def topic_names(connections: Iterable[Any]) -> str:
    """The topics' names for an error message."""
    return ", ".join(sorted({one.topic for one in connections})) or "none"


def messages_by_topic(connections: Iterable[Any], types: Sequence[str]) -> dict[str, int]:
    """Topic → number of messages, for the topics with a message type in `types` and at least one message."""
    counts: dict[str, int] = {}
    for one in connections:
        if one.msgtype in types and one.msgcount:
            counts[one.topic] = counts.get(one.topic, 0) + one.msgcount
    return counts


def picture_topics(connections: Iterable[Any]) -> list[str]:
    """The topics with pictures, except those of `_OTHER_IMAGES`, sorted by decreasing number of messages."""
    counts = messages_by_topic(connections, (RAW, COMPRESSED))
    good = [topic for topic in counts if not _OTHER_IMAGES.search(topic)]
    return sorted(good, key=lambda topic: (counts[topic], topic), reverse=True)


def choose_pictures(connections: Sequence[Any], path: Path, topic: str = "") -> str:
    """The topic of the pictures: the given one, or the one with most messages. Raises InputError if there is none."""
    every = messages_by_topic(connections, (RAW, COMPRESSED))
    if topic in every:
        return topic
    found = picture_topics(connections)
    if not found and every:
        raise InputError(
            f"{path}: only pictures of depth, infrared or masks: {join_names(list(every), most=12)}; give one of them "
            "as the topic, or record the front camera"
        )
    if not found:
        raise InputError(f"{path}: no topic with pictures among {topic_names(connections)}; record the front camera")
    if topic:
        raise InputError(f"{path}: no pictures on topic {topic}; expected one of {join_names(found, most=12)}")
    return found[0]


def choose_camera_info(connections: Iterable[Any], pictures: str) -> str | None:
    """The CameraInfo topic whose name is most like that of the pictures, see `_common`; None without a CameraInfo."""
    found = messages_by_topic(connections, (CAMERA_INFO,))
    return max(found, key=lambda topic: _common(topic, pictures), default=None)


def is_rectified(topic: str) -> bool:
    """True if `rect` or `rectified` is a word of the topic's name, as in `image_rect`, `image_rect_color`."""
    return bool(_RECTIFIED.search(topic))


def _common(one: str, other: str) -> int:
    """Number of leading parts, separated by slashes, that the names of two topics share."""
    pairs = list(zip(one.split("/"), other.split("/"), strict=False))
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))


def choose_topics(connections: Iterable[Any], path: Path, kinds: Sequence[str] = tuple(TYPES)) -> dict[str, str]:
    """Maps each of `kinds`, keys of `TYPES`, to its best topic. Raises InputError if one has no topic, except imu."""
    chosen = {}
    for kind in kinds:
        counts = messages_by_topic(connections, TYPES[kind])
        if counts:
            chosen[kind] = min(counts.items(), key=partial(_order, kind))[0]
        elif kind != "imu":
            raise InputError(
                f"{path}: no topic with {kind} ({' or '.join(TYPES[kind])}) among {topic_names(connections)}; record it"
            )
    return chosen


def _order(kind: str, counted: tuple[str, int]) -> tuple[int, ...]:
    """Sort key of a topic for a kind; `counted` is (topic, number of messages). The best topic has the least key."""
    topic, count = counted
    if kind == "commands":  # prefer the velocity controller's input to the multiplexer's inputs
        return (not topic.endswith("cmd_vel"), -count)
    if kind == "poses":  # the heading of filtered odometry is better than that of the wheels alone
        return (count < MIN_POSES, is_from_wheels(topic) * (1 if "filtered" in topic else 2), -count)
    if kind == "imu":  # a camera's IMU often has the camera's axes
        return ("camera" in topic, -count)
    return (-count,)


def is_from_wheels(topic: str) -> bool:
    """True if the name contains a word of `FROM_WHEELS`, or is that of a Husky's fused wheel and IMU odometry."""
    return any(word in topic for word in FROM_WHEELS) or topic.endswith("odometry/filtered")


def wheel_odometry(connections: Iterable[Any]) -> dict[str, int]:
    """Topics with odometry of the wheels alone (filters also use the IMU), and their numbers of messages."""
    odometry = messages_by_topic(connections, (ODOMETRY,))
    return {name: count for name, count in odometry.items() if is_from_wheels(name) and "filtered" not in name}


def independent_poses(connections: Iterable[Any]) -> dict[str, int]:
    """Topics with at least `MIN_POSES` poses that do not come from the wheels, and their numbers of messages."""
    counts = messages_by_topic(connections, TYPES["poses"])
    return {name: count for name, count in counts.items() if count >= MIN_POSES and not is_from_wheels(name)}


def log_topics(path: Path, topics: dict[str, str]) -> None:
    """Logs which topic of a bag is used for what."""
    runtime.log_line(f"{path}: " + ", ".join(f"{kind} {topic}" for kind, topic in topics.items()))


# ---- messages


def picture_of(message: Any) -> "RawPicture | CompressedPicture":
    """The picture in an Image or CompressedImage."""
    from twin_policy import CompressedPicture, RawPicture

    if hasattr(message, "format"):
        return CompressedPicture(message.data)
    return RawPicture(message.encoding, message.width, message.height, message.step, message.data)


def header_time(message: Any) -> int:
    """The stamp of a message's header [ns]; 0 for a message without a stamp."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return stamp.sec * 10**9 + stamp.nanosec if stamp is not None else 0


def message_times(times: NDArray[np.int64], topic: str, path: Path) -> NDArray[np.int64]:
    """Times of a topic's messages [ns], shape (n,), from their header and recording times, shape (n, 2).

    The header times are used. The recording times replace them if the headers have no times, or if their clock is
    another one or was set back.
    """
    header, recorded = times.reshape(-1, 2).T
    if not header.any():
        return recorded.copy()
    if abs(int(np.median(recorded - header))) > _CLOCK:
        runtime.log_line(f"{path}: headers on {topic} have another clock; the times of recording are used")
        return recorded.copy()
    if not header.all():  # as by drivers whose first message has an empty stamp
        header = np.where(header, header, recorded - np.int64(np.median((recorded - header)[header > 0])))
    back = (header[:-1] - header[1:]).max(initial=0)
    if back > _SET_BACK:
        runtime.log_line(
            f"{path}: the clock of {topic} was set back by {back * 1e-9:.0f} s; the times of recording are used"
        )
        return recorded.copy()
    return header.copy()


def fix_of(message: Any) -> tuple[float, float, float]:
    """Latitude [°], longitude [°], altitude [m] of a NavSatFix; NaN if the receiver had no fix.

    Exactly (0°, 0°) counts as no fix: some receivers report it before their first one.
    """
    good = message.status.status >= 0 and (message.latitude, message.longitude) != (0.0, 0.0)
    return (message.latitude, message.longitude, message.altitude) if good else (np.nan,) * 3


def unit_quaternion(message: Any) -> tuple[float, float, float, float]:
    """x, y, z, w of a Quaternion, normalized; NaN if its norm is below 0.5, as that of a pose without orientation."""
    q = np.array([message.x, message.y, message.z, message.w], np.float64)
    norm = float(np.linalg.norm(q))
    x, y, z, w = (q / norm if norm >= _MIN_NORM else np.full(4, np.nan)).tolist()
    return x, y, z, w


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
    x, y, z, w = unit_quaternion(pose.orientation)
    return pose.position.x, pose.position.y, float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _imu(message: Any) -> tuple[float, ...]:
    return message.linear_acceleration.x, message.linear_acceleration.y


VALUES: dict[str, Callable[[Any], Any]] = {"commands": _twist, "wheels": _wheels, "poses": _pose, "imu": _imu}
"""Kind → function that extracts a message's numbers.

- commands: linear [m/s] and angular speed [rad/s]
- wheels: mean speed of the left and of the right wheels [rad/s], or None if a side is missing
- poses: x, y [m] and yaw [rad], NaN without orientation
- imu: accelerations along x and y [m/s²]
"""
