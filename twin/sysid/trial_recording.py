"""A trial on the road, read from the robot's bag: pictures, calibration, poses and commands.

Times are nanoseconds (`twin.capture.bag.message_times`). Poses are planar, in the frame of their ROS topic (odometry,
RTK). `scene_frame` finds that frame's pose in the scene: pictures, evenly spaced along the drive, are localized in the
scene, and rotation and shift are fitted to the positions of the robot's base at these pictures. Pictures are read from
the bag only when they are needed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.capture.bag import (
    CAMERA_INFO,
    COMPRESSED,
    FIX,
    RAW,
    TYPES,
    VALUES,
    choose_camera_info,
    choose_pictures,
    choose_topics,
    fix_of,
    header_time,
    is_rectified,
    log_topics,
    message_times,
    messages_by_topic,
    open_bag,
    picture_of,
    topic_names,
    unit_quaternion,
)
from twin.capture.camera_models import Lens
from twin.capture.localize import register_film
from twin.capture.scale import local_east_north_up
from twin.errors import InputError
from twin.geometry.passes import path_stations
from twin.robot import HuskyParams
from twin.scene import SceneDir, require_stage
from twin.sysid.camera_extrinsics import base_below_camera
from twin.types import Array, Image
from twin_policy import Camera, PictureError, Rectifier

_STEP = 0.3  # [m] the heading at a satellite fix is the direction from a point this far before it to one as far after
_TYPES = {
    "pictures": (RAW, COMPRESSED),
    "camera": (CAMERA_INFO,),
    "poses": (*TYPES["poses"], FIX),
    "commands": TYPES["commands"],
}
"""Message types that a topic of each kind may have."""
_MOVING = 0.02  # [m/s], [rad/s]; a drive starts with the first command that exceeds this


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
    """x, y [m] and yaw [rad] without jumps of 2π, shape (p, 3)."""
    uprightness: Array
    """Cosine of the robot's tilt, shape (p,); 1 if the poses come from satellite fixes."""
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
        """Yields stamp and picture (an object with `decode()`) of the pictures with these stamps, in order."""
        wanted = set(stamps.tolist())
        shift = dict(zip(self.arrival.tolist(), self.shutter.tolist(), strict=True))
        with open_bag(self.path) as bag:
            for _, recorded, message in bag.messages(bag.on(self.topics["pictures"])):
                stamp = shift.get(recorded)
                if stamp is not None and stamp in wanted:
                    wanted.discard(stamp)
                    yield stamp, picture_of(message)

    def rectified(self, stamps: NDArray[np.int64], rectify: Rectifier) -> Iterator[tuple[int, Image]]:
        """Yields stamp and rectified picture (h, w, 3) of the pictures with these stamps, in order.

        Raises InputError: a picture cannot be decoded or rectified.
        """
        for stamp, picture in self.pictures(stamps):
            try:
                yield stamp, rectify(picture.decode())
            except PictureError as error:
                raise InputError(f"{self.path}: {self.topics['pictures']}: {error}") from None

    def rectifier(self, size: tuple[int, int], intrinsics: Any) -> Rectifier:
        """Rectifier to a pinhole camera of width, height [px] and fx, fy, cx, cy [px].

        Raises InputError: the intrinsics are not four numbers, or the camera sees too little of the pinhole camera.
        """
        try:
            fx, fy, cx, cy = map(float, intrinsics)
            return Rectifier(self.camera, Camera(size, (fx, fy, cx, cy)))
        except (PictureError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: {error}") from None

    def start(self) -> int:
        """Time of the first command that moves the robot [ns]. Raises InputError: there is none."""
        moving = np.flatnonzero(np.abs(self.commands).max(1, initial=0.0) > _MOVING)
        if not len(moving):
            topic = self.topics["commands"]
            raise InputError(f"{self.path}: no command on {topic} moves the robot; record the whole trial")
        return int(self.command_times[moving[0]])

    def motion_at_steps(self, start: int, period: float) -> tuple[Array, Array, Array]:
        """Samples the poses once per control step of `period` [s], from `start` [ns] to the last recorded pose.

        Returns:
            Times since the start [s] (n,), poses (n, 3) in the frame of their topic, and uprightness (n,).

        Raises:
            InputError: the poses begin after the start, or end within the first step.
        """
        left = (int(self.pose_times[-1]) - start) * 1e-9
        steps = int(left / period + 1e-6)
        if start < self.pose_times[0] or steps < 1:
            raise InputError(
                f"{self.path}: {self.topics['poses']} has poses from {(int(self.pose_times[0]) - start) * 1e-9:.1f} to "
                f"{left:.1f} s after the first command; expected the whole trial"
            )
        times = np.arange(steps + 1) * np.float64(period)
        stamps = start + np.round(times * 1e9).astype(np.int64)
        upright = np.interp(stamps - start, self.pose_times - start, self.uprightness)
        return times, self.poses_at(stamps), upright


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
        topics = _choose(bag.connections, path, given or {})
        log_topics(path, topics)
        times: dict[str, list[tuple[int, int]]] = {kind: [] for kind in topics}
        values: dict[str, list[Any]] = {kind: [] for kind in topics}
        kinds = {topic: kind for kind, topic in topics.items()}
        for connection, recorded, message in bag.messages(bag.on(*kinds)):
            kind = kinds[connection.topic]
            if kind == "camera" and values[kind]:
                continue
            times[kind].append((header_time(message), recorded))
            values[kind].append(_value(kind, message))
    for kind, topic in topics.items():
        if not values[kind]:
            raise InputError(f"{path}: no message on {topic} ({kind}); record it")
    try:
        camera = Camera.from_info(values["camera"][0], is_rectified(topics["pictures"]))
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


def _choose(connections: Any, path: Path, given: dict[str, str]) -> dict[str, str]:
    """The topics of pictures, camera, poses and commands."""
    types = {one.topic: one.msgtype for one in connections if one.msgcount}
    for kind, topic in given.items():
        if topic not in types:
            raise InputError(f"{path}: no topic {topic} ({kind}); there are {topic_names(connections)}")
        if types[topic] not in _TYPES[kind]:
            expected = " or ".join(_TYPES[kind])
            raise InputError(f"{path}: {topic} ({kind}) has {types[topic]}; expected {expected}; give another topic")
    chosen = dict(given)
    if "pictures" not in chosen:
        chosen["pictures"] = choose_pictures(connections, path)
    if "camera" not in chosen:
        info = choose_camera_info(connections, chosen["pictures"])
        if info is None:
            raise InputError(
                f"{path}: no topic of {CAMERA_INFO} among {topic_names(connections)}; record the camera's camera_info"
            )
        chosen["camera"] = info
    if "poses" not in chosen and not messages_by_topic(connections, TYPES["poses"]):
        fixes = messages_by_topic(connections, (FIX,))
        if fixes:
            chosen["poses"] = max(fixes, key=lambda topic: fixes[topic])
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
        x, y, _, _ = unit_quaternion(pose.orientation)
        return (*(VALUES["poses"](message) or ()), 1.0 - 2.0 * (x * x + y * y))
    return VALUES[kind](message)


def _poses(times: NDArray[np.int64], rows: list[Any], where: str) -> tuple[NDArray[np.int64], Array, Array]:
    """Times, poses and uprightness, sorted by time; `rows` are planar poses with uprightness, or satellite fixes.

    Rows that are not finite are left out. Raises InputError if fewer than two are left, or if most have no orientation.
    """
    times, index = np.unique(times, return_index=True)
    table = np.array(rows, float)[index]
    keep = np.isfinite(table).all(1)
    turned = np.isfinite(table[:, 2])
    if table.shape[1] == 4 and turned.mean() < 0.5:
        raise InputError(
            f"{where}: {len(turned) - turned.sum()} of {len(turned)} poses have no orientation; expected a quaternion "
            "of norm 1 in each: give the topic of other poses or of satellite fixes by --poses"
        )
    if keep.sum() < 2:
        raise InputError(f"{where}: {keep.sum()} usable poses; expected many: record odometry or RTK, 10 Hz or more")
    times, table = times[keep], table[keep]
    if table.shape[1] == 4:
        table[:, 2] = np.unwrap(table[:, 2])
        return times, table[:, :3], table[:, 3]
    xy = local_east_north_up(table)[:, :2]
    xy -= xy[0]
    return times, np.column_stack([xy, _headings(xy)]), np.ones(len(times))


def _headings(xy: Array) -> Array:
    """Heading of motion [rad] at positions (n, 2), from `_STEP` before to `_STEP` after; constant while standing."""
    way = path_stations(xy)
    ahead, behind = (np.stack([np.interp(way + d, way, c) for c in xy.T], -1) for d in (_STEP, -_STEP))
    return np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))


# ---- frame of the poses

PosesFrame = Literal["scene", "pictures"]
"""The poses are in the scene's frame, or their frame is fitted to localized pictures."""
_LOCATED = 24  # largest number of pictures that are localized in the scene
_MIN_LOCATED, _MIN_WAY = 5, 2.0  # least number of pictures; [m] least distance of the farthest pose from the first
_MAX_RESIDUAL = 0.25  # [m] largest `FrameFit.residual`
_OUTLIER = 3.0  # pictures with residuals above this multiple of the median, and above 0.05 m, are left out
_ROUNDS = 5  # number of fits


@dataclass(frozen=True)
class FrameFit:
    """Rotation and shift from a recording's frame to that of the scene, and how well they fit."""

    yaw: float
    """[rad]"""
    shift: Array
    """[m], shape (2,)."""
    residual: float = 0.0
    """Root mean square distance between the poses and the located pictures [m]."""
    scale: float = 1.0
    """Meters of the scene per meter of the poses, from the same pictures; reported only, not applied to poses."""
    located: int = 0
    """Number of pictures used."""

    def __call__(self, poses: Array) -> Array:
        """Poses (n, 3) in the scene."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        xy = poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + self.shift
        return np.column_stack([xy, poses[:, 2] + self.yaw])


def scene_frame(
    recording: TrialRecording, frame: PosesFrame, start: int, scene: SceneDir, robot: HuskyParams
) -> FrameFit:
    """The frame of a recording's poses in a built scene.

    Args:
        start: Pictures from this time [ns] on are used.

    Raises:
        InputError: an error of `fit_frame`, or the pictures are missing or cannot be read.
    """
    if frame == "scene":
        return FrameFit(0.0, np.zeros(2))
    ground = Ground.load(require_stage(scene, "mesh"))
    stamps = recording.shutter[recording.shutter >= start]
    xy = recording.poses_at(stamps)[:, :2]
    way = path_stations(xy) if len(xy) else np.zeros(0)
    some = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], _LOCATED))) if len(way) else np.zeros(0, int)
    native = recording.camera.without_distortion()
    pictures = dict(recording.rectified(stamps[some], Rectifier(recording.camera, native, max_outside=1.0)))
    if not pictures:
        raise InputError(f"{recording.path}: no picture after the first command; record pictures throughout")
    found = register_film(list(pictures.values()), Lens("PINHOLE", native.intrinsics, *native.size), scene)
    located = [base_below_camera(robot, pose, ground.at) for pose in found.camera_to_world]
    times = np.array(list(pictures), np.int64)[found.frames]
    return fit_frame(recording.poses_at(times), np.array(located).reshape(-1, 3), str(recording.path))


def fit_frame(poses: Array, located: Array, where: str) -> FrameFit:
    """Fits the frame to positions, without a scale; wrongly located pictures are left out.

    Args:
        poses: Recorded poses at the pictures' stamps, shape (n, 3).
        located: Poses of the base in the scene, located from the same pictures, shape (n, 3).
        where: The recording's name in errors.

    Raises:
        InputError: too few pictures, too short a path, or poses that do not fit.
    """
    source, target = (one[:, 0] + 1j * one[:, 1] for one in (poses, located))
    way = float(np.abs(source - source[:1]).max(initial=0.0))
    if len(poses) < _MIN_LOCATED or way < _MIN_WAY:
        raise InputError(
            f"{where}: {len(poses)} pictures were located in the scene, over {way:.1f} m; expected {_MIN_LOCATED} over "
            f"{_MIN_WAY:g} m: is it the same place, in light like that of a film? If the poses are already in the "
            "scene's frame, give --frame scene"
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
