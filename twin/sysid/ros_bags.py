"""Converts bags to drive logs: tables with a row per joint state and the newest values of the other topics.

If a bag has no joint states, the wheel speeds are computed from the wheels' odometry by the inverse of Clearpath's
kinematics. Poses that come from the wheels are not used, since they hide the wheels' slip. If a bag has no other poses,
but a scene was built from its pictures, the poses are those of a robot at rest below the reconstructed cameras.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.assets.ground import Ground
from twin.capture.bag import (
    MIN_POSES,
    ODOMETRY,
    TYPES,
    VALUES,
    bag_files,
    choose_topics,
    is_bag,
    is_from_wheels,
    messages_by_topic,
    open_bag,
    topic_names,
)
from twin.capture.bag_film import read_contents
from twin.capture.frames import source_names
from twin.config import SceneConfig
from twin.errors import InputError
from twin.files import digest_file
from twin.geometry.cameras import Cameras
from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.scene import SceneDir, require_stage
from twin.sysid.camera_extrinsics import base_below_camera
from twin.sysid.logs import ACCELERATION, POSE, TWIST, WHEEL_SPEEDS
from twin.types import Array


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


def read_bag(path: Path, filmed: FilmedPoses | None = None) -> dict[str, Array]:
    """Reads a bag into the columns that `twin.sysid.logs` describes.

    Args:
        filmed: Poses to use if the bag has only poses that come from the wheels.

    Raises:
        InputError: rosbags is not installed, the bag is unreadable, a kind of message is missing, or the poses come
            from the wheels and `filmed` is None.
    """
    with open_bag(path, "record it anew or give a .csv") as bag:
        kinds, values = _kinds(bag.connections, path, filmed)
        chosen = choose_topics(bag.connections, path, [kind for kind in kinds if kind not in values])
        functions = {kind: VALUES[kind] for kind in chosen}
        if "wheels" in values:
            chosen["wheels"], functions["wheels"] = values["wheels"], _wheels_of_odometry
        rows: dict[str, list[tuple[float, ...]]] = {kind: [] for kind in chosen}
        by_id = {connection.id: kind for kind, connection in chosen.items()}
        # The beginning is subtracted as an integer: as a float it would be rounded to 0.2 µs.
        for connection, recorded, message in bag.messages(list(chosen.values())):
            kind = by_id[connection.id]
            numbers = functions[kind](message)
            if numbers is not None:
                rows[kind].append(((recorded - bag.begin) * 1e-9, *numbers))
        if "poses" not in kinds and filmed is not None:
            since = (filmed.times - bag.begin) * 1e-9
            rows["poses"] = [(float(t), *pose) for t, pose in zip(since, filmed.poses.tolist(), strict=True)]
    empty = [kind for kind, found in rows.items() if not found]
    if empty:
        raise InputError(f"{path}: no usable message of {', '.join(empty)}; expected at least one; record these topics")
    return _columns({kind: np.array(found) for kind, found in rows.items()})


def _kinds(connections: list[Any], path: Path, filmed: FilmedPoses | None) -> tuple[list[str], dict[str, Any]]:
    """The kinds of topics to read, and the connection of the wheels' odometry if it replaces missing joint states."""
    kinds, values = list(TYPES), {}
    counts = messages_by_topic(connections, TYPES["poses"])
    if not any(count >= MIN_POSES and not is_from_wheels(name) for name, count in counts.items()):
        if filmed is None:
            raise InputError(
                f"{path}: no topic with poses ({' or '.join(TYPES['poses'])}) other than wheel odometry "
                f"among {topic_names(connections)}; record LiDAR, RTK or a total station, or build the scene from this "
                "bag's pictures"
            )
        kinds.remove("poses")
        runtime.log_line(f"{path}: {len(filmed.times)} poses in the built scene are taken from its pictures")
    if not messages_by_topic(connections, TYPES["wheels"]):
        from_wheels = messages_by_topic(connections, (ODOMETRY,))
        names = [name for name in from_wheels if is_from_wheels(name)]
        if names:
            topic = max(names, key=lambda name: from_wheels[name])
            values["wheels"] = next(one for one in connections if one.topic == topic and one.msgcount)
            runtime.log_line(
                f"{path}: no joint states; wheel speeds are computed from {topic} with Clearpath's multiplier "
                f"{HuskyParams.separation_multiplier:g}"
            )
    return kinds, values


def _wheels_of_odometry(message: Any) -> tuple[float, float]:
    """Wheel speeds left and right [rad/s] from a message of the wheels' odometry."""
    v, yaw_rate = message.twist.twist.linear.x, message.twist.twist.angular.z
    half = yaw_rate * TRACK * HuskyParams.separation_multiplier / 2.0
    return (v - half) / WHEEL_RADIUS, (v + half) / WHEEL_RADIUS


_NAMES = {"commands": TWIST, "wheels": WHEEL_SPEEDS, "poses": POSE, "imu": ACCELERATION}


def _columns(tables: dict[str, Array]) -> dict[str, Array]:
    """Columns with a row per joint state, from the time at which every topic has had a message."""
    begin = max(table[0, 0] for table in tables.values())
    time = np.unique(tables["wheels"][:, 0])
    time = time[time >= begin]
    columns = {"time": time - (time[0] if len(time) else 0.0)}
    for kind, table in tables.items():
        newest = np.searchsorted(table[:, 0], time, side="right") - 1
        columns |= {name: table[newest, i + 1] for i, name in enumerate(_NAMES[kind])}
    return columns
