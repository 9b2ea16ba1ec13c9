"""Reads drive logs from files: tables, windows in the format of the DRIVE dataset, and bags.

A bag becomes a table with a row per joint state and the newest values of the other topics; a command older than the
controllers' longest time-out counts as 0. If a bag has no joint states, the wheel speeds are computed from the wheels'
odometry by the inverse of Clearpath's kinematics. Poses that come from the wheels are not used, since they hide the
wheels' slip. If a bag has no other poses, but a scene was built from its pictures, the poses are those of a robot at
rest below the reconstructed cameras.
"""

import csv
import io
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.assets.ground import Ground
from twin.capture.bag import (
    TYPES,
    VALUES,
    bag_files,
    choose_topics,
    independent_poses,
    is_bag,
    log_topics,
    messages_by_topic,
    open_bag,
    topic_names,
    wheel_odometry,
)
from twin.capture.bag_film import read_contents
from twin.capture.frames import source_names
from twin.config import SceneConfig
from twin.errors import InputError, join_names
from twin.files import digest_file, exists, load_arrays, read_text, wrap_read_errors
from twin.geometry.cameras import Cameras
from twin.robot import CONTROLLERS, TRACK, WHEEL_RADIUS, HuskyParams
from twin.scene import SceneDir, require_stage
from twin.sysid.camera_extrinsics import base_below_camera
from twin.sysid.logs import ACCELERATION, POSE, TWIST, WHEEL_SPEEDS, Windows, cut_windows, published_windows
from twin.types import Array

# ---- tables

_MAX_BYTES = 512 << 20  # largest log, unpacked


def read_log(path: Path) -> Windows:
    """Reads a table or windows. Raises InputError: an unreadable file, missing columns, impossible times or values."""
    if not exists(path):
        raise InputError(f"{path}: no such log; expected a .csv, an .npz or a bag")
    if path.suffix.lower() == ".csv":
        return cut_windows(_read_csv(path), str(path))
    if path.suffix.lower() == ".npz":
        columns = read_npz(path)
        if columns.get("icp_x", np.zeros(0)).ndim == 2:
            return published_windows(columns, str(path))
        return cut_windows(columns, str(path))
    raise InputError(f"{path}: expected a log in .csv, .npz or a bag; convert it to one of these")


def _read_csv(path: Path) -> dict[str, Array]:
    text = read_text(path, _MAX_BYTES)
    try:
        head, *rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row] or [[]]
        if len(head) == 1 and (other := next((one for one in ";\t" if one in head[0]), "")):
            raise InputError(f"{path}: its columns are separated by {other!r}, not by commas; export it again")
        values = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in rows])
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: not a table of numbers under one line of names: {error}; export it again") from None
    if not rows:
        raise InputError(f"{path}: no row of numbers; expected one per instant, under a line of names; export it again")
    if values.ndim != 2 or values.shape[1] != len(head):
        raise InputError(f"{path}: {len(head)} names in the first line, but rows of another length; export it again")
    names = [name.strip() for name in head]
    twice = [name for name, count in Counter(names).items() if name and count > 1]
    if twice:
        raise InputError(
            f"{path}: column {twice[0]} appears {names.count(twice[0])} times; expected once; rename the others"
        )
    return {name: values[:, i] for i, name in enumerate(names)}


def read_npz(path: Path) -> dict[str, Array]:
    """Numeric arrays of an .npz file by name."""
    arrays = load_arrays(path, _MAX_BYTES)
    with wrap_read_errors(path, "expected plain arrays of numbers; save it again with numpy.savez"):
        return {name: np.asarray(values, np.float64) for name, values in arrays.items()}


# ---- bags


@dataclass(frozen=True)
class FilmedPoses:
    """Poses of a robot, reconstructed from the pictures that it took."""

    times: NDArray[np.int64]
    """Stamps of the pictures [ns], increasing, shape (n,)."""
    poses: Array
    """x, y [m], yaw [rad] of the base in the scene, shape (n, 3)."""


def filmed_poses(scene: SceneDir, config: SceneConfig, bag: Path) -> FilmedPoses | None:
    """The robot's poses, reconstructed from a bag's pictures; None unless the scene was built from that bag.

    Raises InputError: the bag is unreadable.
    """
    names = source_names([source.path for source in config.source])
    built = all(scene.stage(stage).is_dir() for stage in ("metric", "mesh"))
    for name, source in zip(names, config.source, strict=True):
        path = scene.root / source.path
        if not (built and is_bag(path) and path.exists() and _are_same(path, bag)):
            continue
        cameras = Cameras.load(require_stage(scene, "metric"))
        ground = Ground.load(require_stage(scene, "mesh"))
        rows = [i for i, one in enumerate(cameras.sources) if one == name]
        first = int(read_contents(bag, source.topic).stamps[0])
        times = first + np.round(cameras.times[rows] * 1e9).astype(np.int64)
        poses = [base_below_camera(config.robot, cameras.camera_to_world[i], ground.at) for i in rows]
        order = np.argsort(times)
        return FilmedPoses(times[order], np.array(poses).reshape(-1, 3)[order])
    return None


def _are_same(one: Path, other: Path) -> bool:
    """True if two bags have the same files."""
    first, second = bag_files(one), bag_files(other)
    sizes = [[file.stat().st_size for file in files] for files in (first, second)]
    return sizes[0] == sizes[1] and list(map(digest_file, first)) == list(map(digest_file, second))


def read_bag(path: Path, filmed: FilmedPoses | None = None, poses: str = "") -> dict[str, Array]:
    """Reads a bag into the columns that `twin.sysid.logs` describes. Messages that are not finite, and poses
    without orientation, are left out.

    Args:
        filmed: Poses to use if the bag has only poses that come from the wheels.
        poses: Topic of the poses; empty: the best one that does not come from the wheels.

    Raises:
        InputError: rosbags is not installed, the bag is unreadable, a kind of message is missing, or the poses come
            from the wheels and `filmed` is None.
    """
    with open_bag(path, "record it again or give a .csv") as bag:
        uses = _uses(bag.connections, path, filmed, poses)
        rows: dict[tuple[str, str], list[tuple[float, ...]]] = {use: [] for use in uses}
        lost: Counter[str] = Counter()
        # The beginning is subtracted as an integer: as a float it would be rounded to 0.2 µs.
        for connection, recorded, message in bag.messages(bag.on(*(topic for _, topic in uses))):
            for (kind, topic), function in uses.items():
                if topic == connection.topic and (numbers := function(message)) is not None:
                    if np.isfinite(numbers).all():
                        rows[kind, topic].append(((recorded - bag.begin) * 1e-9, *numbers))
                    else:
                        lost[topic] += 1
        begin = bag.begin
    for topic, count in lost.items():
        runtime.log_line(f"{path}: {count} messages on {topic} left out: not finite, or poses without orientation")
    # Some topics with joint states have no wheels, such as those of an arm.
    computed = next((use for use in uses if uses[use] is _wheels_of_odometry), None)
    if computed and any(rows[use] for use in uses if uses[use] is VALUES["wheels"]):
        del rows[computed]
    elif computed:
        runtime.log_line(
            f"{path}: no joint states of wheels; wheel speeds are computed from {computed[1]} with Clearpath's "
            f"multiplier {HuskyParams.separation_multiplier:g}"
        )
    rows = {use: found for use, found in rows.items() if found or use[0] != "imu"}  # the IMU is optional
    best = dict(sorted(rows, key=lambda use: len(rows[use])))
    topics = {kind: best[kind] for kind in TYPES if kind in best}
    log_topics(path, topics)
    tables = {kind: rows[kind, topic] for kind, topic in topics.items()}
    if "poses" not in topics and filmed is not None:
        since = (filmed.times - begin) * 1e-9
        tables["poses"] = [(float(t), *pose) for t, pose in zip(since, filmed.poses.tolist(), strict=True)]
    empty = [kind for kind, found in tables.items() if not found]
    if empty:
        cure = "record these topics"
        if "poses" in empty and lost[topics.get("poses", "")]:
            cure = "its poses have no orientation (zeros): record poses with yaw, and name their topic by --topic"
        raise InputError(f"{path}: no usable message of {', '.join(empty)}; expected at least one; {cure}")
    columns, old = _columns({kind: np.array(found) for kind, found in tables.items()})
    if old:
        runtime.log_line(
            f"{path}: {old:.0%} of the log has no command of the last {_MAX_COMMAND_AGE:g} s, counted as 0"
        )
    return columns


def _uses(
    connections: list[Any], path: Path, filmed: FilmedPoses | None, poses: str
) -> dict[tuple[str, str], Callable[[Any], Any]]:
    """The topics to read: (kind, topic) → function that extracts a message's numbers.

    They include all topics with joint states, and the topic with odometry from the wheels.
    """
    counts = messages_by_topic(connections, TYPES["poses"])
    if poses and poses not in counts:
        raise InputError(f"{path}: no poses on topic {poses}; expected one of {join_names(counts, most=12)}")
    topics = choose_topics(connections, path, [kind for kind in TYPES if kind not in ("wheels", "poses")])
    if poses or independent_poses(connections):
        topics["poses"] = poses or choose_topics(connections, path, ("poses",))["poses"]
    elif filmed is None:
        raise InputError(
            f"{path}: no topic with poses ({' or '.join(TYPES['poses'])}) other than wheel odometry "
            f"among {topic_names(connections)}; record LiDAR, RTK or a total station (--topic names their topic), or "
            "build the scene from this bag's pictures"
        )
    else:
        runtime.log_line(f"{path}: {len(filmed.times)} poses in the built scene are taken from its pictures")
    uses = {(kind, topic): VALUES[kind] for kind, topic in topics.items()}
    joints = messages_by_topic(connections, TYPES["wheels"])
    from_wheels = wheel_odometry(connections)
    if from_wheels:
        uses["wheels", max(from_wheels, key=lambda name: from_wheels[name])] = _wheels_of_odometry
    elif not joints:
        choose_topics(connections, path, ["wheels"])  # raises InputError: no such topic
    return uses | {("wheels", topic): VALUES["wheels"] for topic in joints}


def _wheels_of_odometry(message: Any) -> tuple[float, float]:
    """Wheel speeds left and right [rad/s] from a message of the wheels' odometry."""
    v, yaw_rate = message.twist.twist.linear.x, message.twist.twist.angular.z
    half = yaw_rate * TRACK * HuskyParams.separation_multiplier / 2.0
    return (v - half) / WHEEL_RADIUS, (v + half) / WHEEL_RADIUS


_MAX_COMMAND_AGE = max(timing.timeout for timing in CONTROLLERS.values())  # [s]
_NAMES = {"commands": TWIST, "wheels": WHEEL_SPEEDS, "poses": POSE, "imu": ACCELERATION}


def _columns(tables: dict[str, Array]) -> tuple[dict[str, Array], float]:
    """Columns with a row per joint state, from the time at which every topic has had a message; share of old commands.

    A command counts until the next one, but not longer than `_MAX_COMMAND_AGE`: then the robot stops by itself. Robots
    on ROS 1 stop earlier, after 0.25 s; for them, the last command counts a quarter of a second too long.
    """
    begin = max(table[0, 0] for table in tables.values())
    time = np.unique(tables["wheels"][:, 0])
    time = time[time >= begin]
    columns, share = {"time": time - (time[0] if len(time) else 0.0)}, 0.0
    for kind, table in tables.items():
        newest = np.searchsorted(table[:, 0], time, side="right") - 1
        values = table[newest, 1:]
        if kind == "commands":
            old = time - table[newest, 0] > _MAX_COMMAND_AGE
            values[old], share = 0.0, float(old.mean()) if len(old) else 0.0
        columns |= {name: values[:, i] for i, name in enumerate(_NAMES[kind])}
    return columns, share
