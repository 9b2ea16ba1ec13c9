"""A trial on the road, read from the robot's bag: pictures, calibration, poses and commands.

Times are nanoseconds (`twin.capture.bag.message_times`). Poses are planar, in the frame of their topic (odometry, RTK);
`fit_frame` finds the pose of that frame in the scene, from pictures located there. Pictures are read from the bag only
when they are needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.capture.bag import (
    CAMERA_INFO,
    FIX,
    TYPES,
    VALUES,
    choose_camera_info,
    choose_pictures,
    choose_topics,
    fix_of,
    header_time,
    message_times,
    open_bag,
    picture_of,
    topic_names,
)
from twin.capture.scale import local_east_north_up
from twin.errors import InputError
from twin.types import Array
from twin_policy import Camera, PictureError

_STEP = 0.3  # [m] a fix's heading is the direction of motion from this far before it to this far after it


@dataclass(frozen=True)
class TrialRecording:
    """A robot's recording of a drive."""

    path: Path
    topics: dict[str, str]
    """Topics by kind: pictures, camera, poses, commands."""
    camera: Camera
    shutter: NDArray[np.int64]
    """Stamps of the pictures [ns], increasing, shape (n,)."""
    arrival: NDArray[np.int64]
    """Times at which the pictures were recorded [ns], shape (n,)."""
    pose_times: NDArray[np.int64]
    """Stamps of the poses [ns], increasing, shape (p,)."""
    poses: Array
    """x, y [m] and yaw [rad], continuous, shape (p, 3)."""
    uprightness: Array
    """Cosine of the robot's tilt, shape (p,); 1 if the poses come from fixes."""
    command_times: NDArray[np.int64]
    """Stamps of the commands [ns], in order, shape (c,)."""
    commands: Array
    """v [m/s], ω [rad/s], shape (c, 2)."""

    def poses_at(self, times: NDArray[np.int64]) -> Array:
        """Interpolated poses (k, 3) at times [ns], constant before the first and after the last recorded pose."""
        since = (times - self.pose_times[0]) * 1e-9
        knots = (self.pose_times - self.pose_times[0]) * 1e-9
        return np.stack([np.interp(since, knots, column) for column in self.poses.T], -1)

    def pictures(self, stamps: NDArray[np.int64]) -> Iterator[tuple[int, Any]]:
        """Yields stamp and picture (something with `decode()`) of the pictures with these stamps, in order."""
        wanted = set(stamps.tolist())
        shift = dict(zip(self.arrival.tolist(), self.shutter.tolist(), strict=True))
        with open_bag(self.path) as bag:
            for _, recorded, message in bag.messages(bag.on(self.topics["pictures"])):
                stamp = shift.get(recorded)
                if stamp is not None and stamp in wanted:
                    wanted.discard(stamp)
                    yield stamp, picture_of(message)


def read_trial(path: Path, given: dict[str, str] | None = None) -> TrialRecording:
    """Reads a bag.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        given: Topics that the user gives, by kind: `pictures`, `camera`, `poses`, `commands`.

    Raises:
        InputError: an unreadable bag, or topics that are missing, empty or contradictory.
    """
    if not path.exists():
        raise InputError(f"{path}: no such bag; expected the folder of a ROS 2 bag, or its .mcap or .db3 file")
    with open_bag(path) as bag:
        chosen = _choose(bag.connections, path, given or {})
        times: dict[str, list[tuple[int, int]]] = {kind: [] for kind in chosen}
        values: dict[str, list[Any]] = {kind: [] for kind in chosen}
        kinds = {connection.id: kind for kind, connection in chosen.items()}
        for connection, recorded, message in bag.messages(list(chosen.values())):
            kind = kinds[connection.id]
            if kind == "camera" and values[kind]:
                continue
            times[kind].append((header_time(message), recorded))
            values[kind].append(_value(kind, message))
    topics = {kind: connection.topic for kind, connection in chosen.items()}
    for kind, topic in topics.items():
        if not values[kind]:
            raise InputError(f"{path}: no message on {topic} ({kind}); record it")
    try:
        camera = Camera.from_info(values["camera"][0], "rect" in topics["pictures"])
    except PictureError as error:
        raise InputError(f"{path}: {topics['camera']}: {error}") from None
    stamps = {kind: message_times(np.array(times[kind], np.int64), topics[kind], path) for kind in times}
    arrival = np.array(times["pictures"], np.int64)[:, 1]
    if len(np.unique(arrival)) < len(arrival):
        raise InputError(f"{path}: pictures on {topics['pictures']} have equal recording times; record the topic once")
    shutter, first = np.unique(stamps["pictures"], return_index=True)
    pose_times, poses, uprightness = _poses(stamps["poses"], values["poses"], f"{path}: {topics['poses']}")
    commands = np.array(values["commands"], float)
    if not np.isfinite(commands).all():
        raise InputError(f"{path}: {topics['commands']} has commands that are not finite; expected numbers")
    order = np.argsort(stamps["commands"], kind="stable")
    return TrialRecording(
        *(path, topics, camera, shutter, arrival[first], pose_times, poses, uprightness),
        *(stamps["commands"][order], commands[order]),
    )


def _choose(connections: Any, path: Path, given: dict[str, str]) -> dict[str, Any]:
    """The connections of pictures, camera, poses and commands."""
    filled = [one for one in connections if one.msgcount]
    chosen: dict[str, Any] = {}
    for kind, topic in given.items():
        found = [one for one in filled if one.topic == topic]
        if not found:
            raise InputError(f"{path}: no topic {topic} ({kind}); there are {topic_names(connections)}")
        chosen[kind] = found[0]
    if "pictures" not in chosen:
        topic = choose_pictures(filled, path)
        chosen["pictures"] = next(one for one in filled if one.topic == topic)
    if "camera" not in chosen:
        info = choose_camera_info(filled, chosen["pictures"].topic)
        if info is None:
            raise InputError(
                f"{path}: no topic of {CAMERA_INFO} among {topic_names(connections)}; record the camera's camera_info"
            )
        chosen["camera"] = next(one for one in filled if one.topic == info)
    if "poses" not in chosen and not any(one.msgtype in TYPES["poses"] for one in filled):
        fixes = [one for one in filled if one.msgtype == FIX]
        if fixes:
            chosen["poses"] = max(fixes, key=lambda one: one.msgcount)
    missing = [kind for kind in ("poses", "commands") if kind not in chosen]
    return chosen | choose_topics(connections, path, missing)


def _value(kind: str, message: Any) -> Any:
    if kind == "pictures":
        return None
    if kind == "camera":
        return message
    if kind == "poses" and hasattr(message, "latitude"):
        return fix_of(message)
    if kind == "poses":
        pose = getattr(message.pose, "pose", message.pose)
        q = pose.orientation
        return (*(VALUES["poses"](message) or ()), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))
    return VALUES[kind](message)


def _poses(times: NDArray[np.int64], rows: list[Any], where: str) -> tuple[NDArray[np.int64], Array, Array]:
    """Times, poses and uprightness in order, from planar poses with uprightness, or from fixes."""
    times, index = np.unique(times, return_index=True)
    table = np.array(rows, float)[index]
    keep = np.isfinite(table).all(1)
    if keep.sum() < 2:
        raise InputError(f"{where}: {keep.sum()} usable poses; expected many: record odometry or RTK, 10 Hz or more")
    times, table = times[keep], table[keep]
    if table.shape[1] == 4:
        table[:, 2] = np.unwrap(table[:, 2])
        return times, table[:, :3], table[:, 3]
    xy = local_east_north_up(table)[:, :2]
    return times, np.column_stack([xy, _headings(xy)]), np.ones(len(times))


def _headings(xy: Array) -> Array:
    """Heading of motion [rad] at positions (n, 2), from `_STEP` before to `_STEP` after; constant while standing."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1)))
    ahead, behind = (np.stack([np.interp(way + d, way, c) for c in xy.T], -1) for d in (_STEP, -_STEP))
    return np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))


# ---- the frame of the poses

_MIN_LOCATED, _MIN_WAY = 5, 2.0  # least number of pictures; [m] least distance of the farthest pose from the first
_MAX_RESIDUAL = 0.25  # [m] rms
_OUTLIER = 3.0  # pictures whose residual is above this multiple of the median are left out
_ROUNDS = 5


@dataclass(frozen=True)
class FrameFit:
    """Rotation and shift from a recording's frame to the scene's, and how well they fit."""

    yaw: float
    """[rad]"""
    shift: Array
    """[m], shape (2,)."""
    residual: float = 0.0
    """Root mean square distance between the poses and the located pictures [m]."""
    scale: float = 1.0
    """Metres of the scene per metre of the poses, from the same pictures; reported only, not applied to poses."""
    located: int = 0
    """Pictures used."""

    def __call__(self, poses: Array) -> Array:
        """Poses (n, 3) in the scene."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        xy = poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + self.shift
        return np.column_stack([xy, poses[:, 2] + self.yaw])


def fit_frame(poses: Array, located: Array, where: str) -> FrameFit:
    """Fits the frame to positions, without a scale; wrongly located pictures are left out.

    Args:
        poses: Recorded poses at the pictures' stamps, shape (n, 3).
        located: Poses of the base in the scene, located from the same pictures, shape (n, 3).
        where: The recording's name in errors.

    Raises:
        InputError: too few pictures, too short a way, or poses that do not fit.
    """
    source, target = (one[:, 0] + 1j * one[:, 1] for one in (poses, located))
    way = float(np.abs(source - source[:1]).max(initial=0.0))
    if len(poses) < _MIN_LOCATED or way < _MIN_WAY:
        raise InputError(
            f"{where}: {len(poses)} pictures were located in the scene, over {way:.1f} m; expected {_MIN_LOCATED} over "
            f"{_MIN_WAY:g} m: is it the same place, in light like that of a film? If the poses are already in the "
            "scene's frame, --frame scene"
        )
    use = np.ones(len(poses), bool)
    for _ in range(_ROUNDS):
        a, b = source[use] - source[use].mean(), target[use] - target[use].mean()
        turn = (a.conj() * b).sum()
        yaw = float(np.angle(turn))
        shift = target[use].mean() - np.exp(1j * yaw) * source[use].mean()
        off = np.abs(np.exp(1j * yaw) * source + shift - target)
        use = off <= max(_OUTLIER * float(np.median(off)), 0.05)
    residual, scale = float(np.sqrt((off[use] ** 2).mean())), float(abs(turn) / (np.abs(a) ** 2).sum())
    if residual > _MAX_RESIDUAL:
        raise InputError(
            f"{where}: poses and located pictures differ by {residual:.2f} m (rms); expected at most "
            f"{_MAX_RESIDUAL:g}: wheel odometry drifts in turns; record RTK or LiDAR odometry, or name its topic with "
            "--poses"
        )
    return FrameFit(yaw, np.array([shift.real, shift.imag]), residual, scale, int(use.sum()))
