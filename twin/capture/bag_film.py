"""The film in a robot's bag, with what the bag says of its camera: calibration, positions and seat on the robot.

A picture's *stamp* is its header's. Pictures whose stamp is not after that of an earlier one are left out. A *fix* is a
position by satellites. The *seat* is the camera's pose on the robot by `/tf_static`, from the frame in the pictures'
headers to `base_link`. Positions by odometry are those of the lens, in the frame of the odometry.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.capture.bag import (
    CAMERA_INFO,
    COMPRESSED,
    FIX,
    RAW,
    TRANSFORMS,
    TYPES,
    choose_camera_info,
    choose_pictures,
    choose_topics,
    fix_of,
    header_time,
    message_times,
    messages_by_topic,
    open_bag,
    picture_of,
    picture_topics,
)
from twin.capture.camera_models import Lens, checked_lens, same_aspect
from twin.capture.video import Film, FilmStatistics, FilmTiming
from twin.errors import InputError
from twin.robot import BASE_HEIGHT, CAMERA_AHEAD
from twin.types import Array, Image

_MAX_UNORDERED = 0.02  # fraction of pictures that may be left out for their stamps
_MAX_FIX_GAP, _MAX_POSE_GAP = 2.5, 0.5  # [s] between two fixes or poses; longer ones are not interpolated
_BASE, _GROUND = "base_link", "base_footprint"
_MAX_FRAMES = 10_000  # of /tf_static
_MAX_PIXELS = 1 << 28  # of a compressed picture


@dataclass(frozen=True)
class CameraSeat:
    """A camera's pose on the robot."""

    height: float
    """Of the lens above flat ground [m]."""
    ground_known: bool
    """False: the bag has no `base_footprint`, and `base_link` is taken to be as high as a Husky's."""
    offset: tuple[float, float]
    """Forward and left of `base_link` [m]."""
    yaw: float
    """To the left [°]."""
    pitch: float
    """Downward [°]."""
    roll: float
    """Leaning to the right [°]."""


@dataclass(frozen=True)
class BagContents:
    """What a bag has for a scene."""

    path: Path
    topics: dict[str, str]
    """Topics by what they hold: pictures, and, where there are any, camera, fixes, odometry, transforms."""
    other_pictures: tuple[str, ...]
    """Topics with pictures that were not chosen."""
    encoding: str
    size: tuple[int, int]
    """Width, height of the first picture [px]."""
    recorded: int
    """Number of pictures that the bag promises."""
    stamps: NDArray[np.int64]
    """Of the pictures that are used, increasing [ns], shape (n,)."""
    position: NDArray[np.int64]
    """Their positions among the topic's messages, shape (n,)."""
    lens: Lens | None
    """The calibration; None without a usable one."""
    lens_note: str
    """Where the calibration is from, or why there is none."""
    fix_times: NDArray[np.int64]
    """[ns], increasing, shape (f,)."""
    fixes: Array
    """Latitude [°], longitude [°], altitude [m], shape (f, 3); NaN without a fix."""
    odometry_times: NDArray[np.int64]
    """[ns], increasing, shape (p,)."""
    odometry: Array
    """Positions of the lens [m], shape (p, 3)."""
    seat: CameraSeat | None

    @property
    def duration(self) -> float:
        """Of the film [s]."""
        return float((self.stamps[-1] - self.stamps[0]) * 1e-9)

    def fixes_at(self, times: Array) -> Array:
        """Fixes at times [s] after the first picture, shape (k, 3); NaN where there is none near."""
        return _interpolated(times, self.stamps[0], self.fix_times, self.fixes, _MAX_FIX_GAP)

    def odometry_at(self, times: Array) -> Array:
        """Positions of the lens by odometry at times [s] after the first picture, shape (k, 3); NaN as above."""
        return _interpolated(times, self.stamps[0], self.odometry_times, self.odometry, _MAX_POSE_GAP)

    def film(self) -> Film:
        """The pictures as a film."""
        times = (self.stamps - self.stamps[0]) * 1e-9
        return Film(self.path, FilmTiming(times, 0.0, self.recorded), partial(_decode, self))


class _Rows:
    """Numbers of a topic's messages, as compact as they are many."""

    def __init__(self) -> None:
        self.times = array("q")  # of header and recording [ns], per message
        self.values = array("d")


def read_contents(path: Path, topic: str = "") -> BagContents:
    """Reads all of a bag that is no picture, and the pictures' stamps.

    Args:
        path: See `twin.capture.bag`.
        topic: Of the pictures; empty: the one with most of them.

    Raises:
        InputError: no bag or a damaged one, no pictures, an unknown encoding, a camera model that is not supported, or
            stamps out of order.
    """
    with open_bag(path) as bag:
        topics = _topics(bag.connections, path, topic)
        rows = {kind: _Rows() for kind in topics}
        first: dict[str, Any] = {}
        transforms: dict[str, tuple[str, Array]] = {}
        kinds = {name: kind for kind, name in topics.items()}
        for connection, recorded, message in bag.messages(bag.on(*kinds)):
            kind = kinds[connection.topic]
            first.setdefault(kind, message)
            if kind == "transforms":
                _add_transforms(transforms, message)
            elif kind != "camera":
                rows[kind].times.extend((header_time(message), recorded))
                rows[kind].values.extend(_values(kind, message))
        recorded = messages_by_topic(bag.connections, (RAW, COMPRESSED))[topics["pictures"]]
        others = tuple(name for name in picture_topics(bag.connections) if name != topics["pictures"])
    if not rows["pictures"].times:
        raise InputError(f"{path}: no message on {topics['pictures']}; record it")
    where = f"{path}: {topics['pictures']}"
    times = {
        kind: message_times(np.array(one.times, np.int64).reshape(-1, 2), topics[kind], path)
        for kind, one in rows.items()
        if one.times
    }
    position, stamps = _ordered(times["pictures"], where)
    picture = picture_of(first["pictures"])
    height, width = _decoded(picture, where).shape[:2]
    frame = str(first["pictures"].header.frame_id)
    lens, note = _lens(first.get("camera"), topics, frame, (width, height), path)
    camera_to_base = _pose_in_base(transforms, frame)
    fix_times, fixes = _table(rows.get("fixes"), times.get("fixes"), 3)
    pose_times, poses = _table(rows.get("odometry"), times.get("odometry"), 7)
    arm = np.zeros(3) if camera_to_base is None else camera_to_base[:3, 3]
    encoding = getattr(picture, "encoding", None) or str(getattr(first["pictures"], "format", "")) or "compressed"
    return BagContents(
        *(path, topics, others, encoding, (width, height), recorded, stamps, position, lens, note, fix_times, fixes),
        *(pose_times, _lens_positions(poses, arm), _seat(camera_to_base, transforms)),
    )


def _topics(connections: list[Any], path: Path, topic: str) -> dict[str, str]:
    topics = {"pictures": choose_pictures(connections, path, topic)}
    info = choose_camera_info(connections, topics["pictures"])
    if info is not None:
        topics["camera"] = info
    fixes = messages_by_topic(connections, (FIX,))
    if fixes:
        topics["fixes"] = max(fixes, key=lambda name: fixes[name])
    if messages_by_topic(connections, TYPES["poses"]):
        topics["odometry"] = choose_topics(connections, path, ("poses",))["poses"].topic
    static = [name for name in messages_by_topic(connections, (TRANSFORMS,)) if name.endswith("tf_static")]
    if static:
        topics["transforms"] = min(static, key=len)
    return topics


def _values(kind: str, message: Any) -> tuple[float, ...]:
    """Of a message: a fix; or position and quaternion of a pose."""
    if kind == "fixes":
        return fix_of(message)
    if kind == "odometry":
        pose = message.pose
        pose = getattr(pose, "pose", pose)
        p, q = pose.position, pose.orientation
        return p.x, p.y, p.z, q.x, q.y, q.z, q.w
    return ()


def _ordered(times: NDArray[np.int64], where: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions and stamps of the pictures whose stamp is after all earlier ones. Raises InputError: many are not."""
    latest = np.maximum.accumulate(times)
    late = np.append(False, times[1:] <= latest[:-1])
    if late.sum() > max(1.0, _MAX_UNORDERED * len(times)):
        back = float((latest[:-1] - times[1:]).max() * 1e-9)
        raise InputError(
            f"{where}: the stamps of {late.sum()} of {len(times)} pictures are not after the one before, by up to "
            f"{back:.3f} s; expected increasing stamps: give the topic of one camera, and record under one clock"
        )
    position = np.flatnonzero(~late)
    return position, times[position]


def _table(rows: _Rows | None, times: NDArray[np.int64] | None, width: int) -> tuple[NDArray[np.int64], Array]:
    """Times in order and the values of a topic's messages, shape (n, width)."""
    if rows is None or times is None:
        return np.zeros(0, np.int64), np.zeros((0, width))
    times, index = np.unique(times, return_index=True)
    return times, np.array(rows.values, np.float64).reshape(-1, width)[index]


def _interpolated(times: Array, first: int, knots: NDArray[np.int64], values: Array, max_gap: float) -> Array:
    """Values (k, c) at times [s] after `first` [ns] between the knots [ns]; NaN outside, and in gaps [s]."""
    out = np.full((len(times), values.shape[1]), np.nan)
    if len(knots) < 2:
        return out
    since = (knots - first) * 1e-9
    right = np.clip(np.searchsorted(since, times), 1, len(since) - 1)
    left, gap = right - 1, since[right] - since[right - 1]
    good = (times >= since[0]) & (times <= since[-1]) & (gap <= max_gap)
    share = ((times - since[left]) / gap)[:, None]
    out[good] = (values[left] * (1.0 - share) + values[right] * share)[good]
    return out


# ---- pictures


def _decoded(picture: Any, where: str) -> Image:
    """RGB (h, w, 3) of a picture. Raises InputError."""
    from twin_policy import PictureError

    try:
        return np.ascontiguousarray(_checked(picture).decode())
    except PictureError as error:
        raise InputError(f"{where}: {error}; record raw or compressed pictures of 8 bits") from None


def _checked(picture: Any) -> Any:
    """The picture. Raises PictureError for a compressed one that would fill the memory, before it is decoded."""
    from io import BytesIO

    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    from twin_policy import PictureError

    if not hasattr(picture, "encoding"):
        try:
            with Pillow.open(BytesIO(bytes(picture.data))) as head:
                width, height = head.size
        except (UnidentifiedImageError, Pillow.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
            raise PictureError(f"{len(picture.data)} bytes are neither a JPEG nor a PNG picture ({error})") from None
        if width * height > _MAX_PIXELS:
            raise PictureError(f"picture of {width} x {height} px; expected at most {_MAX_PIXELS:,} px")
    return picture


def _decode(contents: BagContents, count: FilmStatistics) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Yields time [s] and frame of the pictures; damaged ones are counted and left out."""
    topic, used, shown = contents.topics["pictures"], iter(contents.position.tolist()), 0
    where = f"{contents.path}: {topic}"
    wanted, problem = next(used, None), None
    with open_bag(contents.path) as bag:
        for number, (_, _, message) in enumerate(bag.messages(bag.on(topic))):
            if number != wanted:
                continue
            wanted = next(used, None)
            time = float((contents.stamps[shown] - contents.stamps[0]) * 1e-9)
            shown += 1
            try:
                image = _decoded(picture_of(message), where)
            except InputError as error:
                problem = error
                count.damaged += 1
                continue
            yield time, av.VideoFrame.from_ndarray(image, "rgb24")
    if problem is not None and count.damaged == shown:
        raise problem


# ---- calibration


def lens_of(info: Any, rectified: bool, where: str) -> Lens:
    """The lens of a CameraInfo. Raises InputError: an unknown model, or values that no camera has.

    Args:
        info: sensor_msgs/CameraInfo of ROS 1 or 2.
        rectified: The pictures are rectified, so that the camera is the matrix P.
        where: Begins the messages.
    """
    from twin_policy import Camera, PictureError

    try:
        camera = Camera.from_info(info, rectified)
    except PictureError as error:
        raise InputError(f"{where}: {error}; give camera = under this [[source]]") from None
    width, height = camera.size
    d = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
    if not any(d):
        return checked_lens("PINHOLE", camera.intrinsics, width, height, where)
    if camera.model == "equidistant":
        return checked_lens("OPENCV_FISHEYE", (*camera.intrinsics, *d[:4]), width, height, where)
    if any(d[4:]):  # k3, and k4 to k6 of rational_polynomial; COLMAP has the same order
        return checked_lens("FULL_OPENCV", (*camera.intrinsics, *d), width, height, where)
    return checked_lens("OPENCV", (*camera.intrinsics, *d[:4]), width, height, where)


def _lens(info: Any, topics: dict[str, str], frame: str, size: tuple[int, int], path: Path) -> tuple[Lens | None, str]:
    """The calibration and a note on it."""
    if info is None:
        return None, f"no {CAMERA_INFO}; the camera is calibrated from the film"
    topic = topics["camera"]
    if not getattr(info, "k", getattr(info, "K", (0.0,)))[0] > 0.0:
        return None, f"{topic} has no calibration; the camera is calibrated from the film"
    if frame and info.header.frame_id and info.header.frame_id != frame:
        return None, (
            f"{topic} is of another camera ({info.header.frame_id}, the pictures {frame}); the camera is calibrated "
            "from the film"
        )
    lens = lens_of(info, "rect" in topics["pictures"], f"{path}: {topic}")
    if not same_aspect((lens.width, lens.height), size):
        raise InputError(
            f"{path}: {topic} is for {lens.width}x{lens.height}, but the pictures are {size[0]}x{size[1]}; expected "
            "one aspect: give camera = under this [[source]]"
        )
    return lens, f"{topic}: {info.distortion_model or 'no distortion'}"


# ---- the camera on the robot


def _add_transforms(transforms: dict[str, tuple[str, Array]], message: Any) -> None:
    """Adds the transforms of a message: parent and child_to_parent (4, 4) by child."""
    for one in message.transforms:
        if len(transforms) >= _MAX_FRAMES:
            return
        p, q = one.transform.translation, one.transform.rotation
        values = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        if not np.isfinite(values).all() or np.linalg.norm(values[3:]) < 0.5:
            continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        transforms[one.child_frame_id.strip("/")] = (one.header.frame_id.strip("/"), pose)


def _pose_in_base(transforms: dict[str, tuple[str, Array]], frame: str) -> Array | None:
    """camera_to_base (4, 4) with OpenCV axes, or None if the camera's frame is not connected to `base_link`."""
    pose, name, seen = np.eye(4), frame.strip("/"), set()
    while not _is_named(name, _BASE):
        if name not in transforms or name in seen:
            return None
        seen.add(name)
        name, step = transforms[name][0], transforms[name][1]
        pose = step @ pose
    if abs(pose[2, 2]) > abs(pose[2, 1]):  # the frame's z is vertical: x forward, y left, not an optical frame
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AHEAD
    return pose


def _seat(camera_to_base: Array | None, transforms: dict[str, tuple[str, Array]]) -> CameraSeat | None:
    if camera_to_base is None:
        return None
    base_height = BASE_HEIGHT
    known = False
    for child, (parent, pose) in transforms.items():
        if _is_named(child, _GROUND) and _is_named(parent, _BASE):
            base_height, known = -float(pose[2, 3]), True
        elif _is_named(child, _BASE) and _is_named(parent, _GROUND):
            base_height, known = float(pose[2, 3]), True
    yaw, pitch, roll = Rotation.from_matrix(camera_to_base[:3, :3] @ CAMERA_AHEAD.T).as_euler("ZYX", degrees=True)
    x, y, z = camera_to_base[:3, 3].tolist()
    return CameraSeat(z + base_height, known, (x, y), float(yaw), float(pitch), float(roll))


def _is_named(frame: str, name: str) -> bool:
    """True for a frame of this name, with or without a prefix."""
    return frame.rpartition("/")[2] == name


def _lens_positions(poses: Array, arm: Array) -> Array:
    """Positions of the lens (p, 3) from positions and quaternions of the base (p, 7) and the lens in the base (3,)."""
    good = np.isfinite(poses).all(1) & (np.linalg.norm(poses[:, 3:], axis=1) > 0.5)
    out = np.full((len(poses), 3), np.nan)
    if good.any():
        out[good] = poses[good, :3] + Rotation.from_quat(poses[good, 3:]).apply(arm)
    return out
