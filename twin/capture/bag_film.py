"""Reads the film in a robot's bag, with the camera's calibration, positions and extrinsics.

A picture's *stamp* is its time as selected by `message_times`. Only pictures with a later stamp than all pictures
before them are used. A *fix* is a satellite position. The *extrinsics* are the camera's pose on the robot: the
transform in `/tf_static` from the frame named in the pictures' headers to `base_link`. Odometry gives the positions of
the lens in the odometry's own coordinate frame.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import UnidentifiedImageError
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
    independent_poses,
    is_rectified,
    message_times,
    messages_by_topic,
    open_bag,
    picture_of,
    picture_topics,
    unit_quaternion,
    wheel_odometry,
)
from twin.capture.camera_models import Lens, checked_lens, same_aspect
from twin.capture.capture_data import nearest_longitudes
from twin.capture.video import Film, FilmStatistics, FilmTiming
from twin.errors import InputError, join_names
from twin.geometry.poses import pose_of
from twin.robot import BASE_HEIGHT, CAMERA_AHEAD
from twin.types import Array, Image

_MAX_UNORDERED = 0.02  # largest fraction of pictures that are left out because of their stamps
_MAX_FIX_GAP, _MAX_POSE_GAP = 2.5, 0.5  # [s] longest gaps across which fixes and poses are interpolated
_BASE, _GROUND = "base_link", "base_footprint"
_MAX_FRAMES = 10_000  # largest number of coordinate frames read from /tf_static
_MAX_PIXELS = 1 << 28  # [px] largest accepted size of a compressed picture


@dataclass(frozen=True)
class CameraSeat:
    """A camera's extrinsics: its pose on the robot."""

    height: float  # height of the lens above flat ground [m]
    ground_known: bool
    """False if the bag has no `base_footprint`; `base_link` is then assumed to be as high as on a Husky."""
    offset: tuple[float, float]  # distance of the lens forward and to the left of `base_link` [m]
    yaw: float  # angle of the viewing direction to the left of straight ahead [°]
    pitch: float  # angle of the viewing direction below the horizontal [°]
    roll: float  # angle by which the camera leans to its right [°]


@dataclass(frozen=True)
class BagContents:
    """The contents of a bag that a scene uses."""

    path: Path
    topics: dict[str, str]
    """Content → topic. The contents are pictures and, if the bag has them, camera, fixes, odometry and transforms."""
    other_pictures: tuple[str, ...]  # other topics with pictures, which are not used
    encoding: str
    size: tuple[int, int]  # width, height of the first undamaged picture [px]
    recorded: int  # number of pictures according to the bag's index
    stamps: NDArray[np.int64]  # stamps of the pictures that are used, increasing [ns], shape (n,)
    position: NDArray[np.int64]  # positions of these pictures among the topic's messages, shape (n,)
    lens: Lens | None  # the calibrated lens; None without a usable calibration
    lens_note: str  # source of the calibration, or the reason why it is missing
    fix_times: NDArray[np.int64]  # times of the fixes [ns], increasing, shape (f,)
    fixes: Array  # latitude [°], longitude [°], altitude [m], shape (f, 3); NaN without a fix
    odometry_times: NDArray[np.int64]  # times of the odometry [ns], increasing, shape (p,)
    odometry: Array  # positions of the lens [m], shape (p, 3)
    seat: CameraSeat | None
    log_note: str  # topics by which the bag is a log for `twin align`, or those that it lacks

    @property
    def duration(self) -> float:
        """Time from the first to the last picture [s]."""
        return float((self.stamps[-1] - self.stamps[0]) * 1e-9)

    def fixes_at(self, times: Array) -> Array:
        """Interpolated fixes at times [s] after the first picture, shape (k, 3); NaN in gaps and outside the fixes."""
        fixes = self.fixes.copy()
        known = np.isfinite(fixes[:, 1])
        if known.any():
            fixes[:, 1] = nearest_longitudes(fixes[:, 1], float(fixes[known, 1][0]))
        out = _interpolated(times, self.stamps[0], self.fix_times, fixes, _MAX_FIX_GAP)
        out[:, 1] = nearest_longitudes(out[:, 1])
        return out

    def odometry_at(self, times: Array) -> Array:
        """Lens positions by odometry at times [s] after the first picture, shape (k, 3); NaN as in `fixes_at`."""
        return _interpolated(times, self.stamps[0], self.odometry_times, self.odometry, _MAX_POSE_GAP)

    def film(self) -> Film:
        times = (self.stamps - self.stamps[0]) * 1e-9
        return Film(self.path, FilmTiming(times, 0.0, self.recorded), partial(_decode, self))


def read_contents(path: Path, topic: str = "") -> BagContents:
    """Reads calibration, positions, extrinsics and stamps of the pictures in a bag; decodes only one picture.

    `topic` is that of the pictures; empty for the topic with the most pictures.

    Raises InputError: the path is not a bag; or the bag is damaged, or has no pictures, an unknown encoding, an
    unsupported camera model, or stamps out of order.
    """
    with open_bag(path) as bag:
        topics = _topics(bag.connections, path, topic)
        where = f"{path}: {topics['pictures']}"
        picture: Any = None  # the first one that is not damaged
        problem: InputError | None = None
        # Header and recording times [ns], and numbers; in compact arrays because there may be many messages.
        rows = {kind: (array("q"), array("d")) for kind in ("pictures", "fixes", "odometry")}
        first: dict[str, Any] = {}
        transforms: dict[str, tuple[str, Array]] = {}
        kinds = {name: kind for kind, name in topics.items()}
        for connection, recorded, message in bag.messages(bag.on(*kinds)):
            kind = kinds[connection.topic]
            first.setdefault(kind, message)
            if kind == "transforms":
                _add_transforms(transforms, message)
            elif kind == "pictures" and picture is None:
                try:
                    height, width = _decoded(candidate := picture_of(message), where).shape[:2]
                    picture = candidate
                except InputError as error:
                    problem = problem or error
            if kind in rows:
                rows[kind][0].extend((header_time(message), recorded))
                rows[kind][1].extend(_values(kind, message))
        recorded = messages_by_topic(bag.connections, (RAW, COMPRESSED))[topics["pictures"]]
        log_note = _log_note(bag.connections)
        others = tuple(name for name in picture_topics(bag.connections) if name != topics["pictures"])
    if not rows["pictures"][0]:
        raise InputError(f"{path}: no message on {topics['pictures']}; record it")
    if problem is not None and picture is None:
        raise problem
    times = {kind: message_times(np.array(at, np.int64), topics.get(kind, ""), path) for kind, (at, _) in rows.items()}
    position, stamps = _ordered(times["pictures"], where)
    frame = str(first["pictures"].header.frame_id)
    lens, note = _lens(first.get("camera"), topics, frame, (width, height), path)
    camera_to_base = _pose_in_base(transforms, frame)
    fix_times, fixes = _table(times["fixes"], rows["fixes"][1], 3)
    pose_times, poses = _table(times["odometry"], rows["odometry"][1], 7)
    arm = np.zeros(3) if camera_to_base is None else camera_to_base[:3, 3]
    encoding = getattr(picture, "encoding", None) or str(getattr(first["pictures"], "format", "")) or "compressed"
    return BagContents(
        *(path, topics, others, encoding, (width, height), recorded, stamps, position, lens, note, fix_times, fixes),
        *(pose_times, _lens_positions(poses, arm), _seat(camera_to_base, transforms), log_note),
    )


def _log_note(connections: list[Any]) -> str:
    """Says by which topics a bag is a log for `twin align` (`twin.sysid.log_files`), or which kind it lacks."""
    commands, joints = (messages_by_topic(connections, TYPES[kind]) for kind in ("commands", "wheels"))
    wheels = wheel_odometry(connections) or joints
    if not commands:
        return f"as a log for twin align it lacks commands ({' or '.join(TYPES['commands'])})"
    if not wheels:
        return f"as a log for twin align it lacks joint states ({TYPES['wheels'][0]}) or odometry of the wheels"
    poses = join_names(independent_poses(connections), most=3) or "from its film, once the scene is built"
    topics = f"commands {join_names(commands, most=3)}, wheels {join_names(wheels, most=3)}, poses {poses}"
    return f"also a log for twin align: {topics}"


def _topics(connections: list[Any], path: Path, topic: str) -> dict[str, str]:
    topics = {"pictures": choose_pictures(connections, path, topic)}
    info = choose_camera_info(connections, topics["pictures"])
    if info is not None:
        topics["camera"] = info
    fixes = messages_by_topic(connections, (FIX,))
    if fixes:
        topics["fixes"] = max(fixes, key=lambda name: fixes[name])
    if messages_by_topic(connections, TYPES["poses"]):
        topics["odometry"] = choose_topics(connections, path, ("poses",))["poses"]
    static = [name for name in messages_by_topic(connections, (TRANSFORMS,)) if name.endswith("tf_static")]
    if static:
        topics["transforms"] = min(static, key=len)
    return topics


def _values(kind: str, message: Any) -> tuple[float, ...]:
    """The numbers kept from a message: the fix, or position and quaternion of the pose; none from a picture."""
    if kind == "fixes":
        return fix_of(message)
    if kind == "odometry":
        pose = message.pose
        pose = getattr(pose, "pose", pose)
        p = pose.position
        return p.x, p.y, p.z, *unit_quaternion(pose.orientation)
    return ()


def _ordered(times: NDArray[np.int64], where: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions and stamps of the pictures whose stamp is later than all stamps before it.

    The others are left out. Raises InputError if two or more are left out, and more than the fraction `_MAX_UNORDERED`.
    """
    latest = np.maximum.accumulate(times)
    late = np.append(False, times[1:] <= latest[:-1])
    if late.sum() > max(1.0, _MAX_UNORDERED * len(times)):
        back = float((latest[:-1] - times[1:]).max() * 1e-9)
        raise InputError(
            f"{where}: the stamps of {late.sum()} of {len(times)} pictures equal that of a picture before them in the "
            f"bag, or are earlier by up to {back:.3f} s; expected increasing stamps: give the topic of one camera, and "
            "record with one clock"
        )
    position = np.flatnonzero(~late)
    return position, times[position]


def _table(times: NDArray[np.int64], values: array, width: int) -> tuple[NDArray[np.int64], Array]:
    """Increasing times (n,) and values (n, width) of a topic's messages."""
    times, index = np.unique(times, return_index=True)
    return times, np.array(values, np.float64).reshape(-1, width)[index]


def _interpolated(times: Array, first: int, knots: NDArray[np.int64], values: Array, max_gap: float) -> Array:
    """Values (k, c) at times [s] after `first` [ns], interpolated linearly between the knots [ns].

    NaN outside the knots and in gaps longer than `max_gap` [s].
    """
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
    """RGB (h, w, 3) of a picture. Raises InputError if it cannot be decoded."""
    from twin_policy import PictureError

    try:
        if not hasattr(picture, "encoding"):
            _check_compressed(picture.data)
        return np.ascontiguousarray(picture.decode())
    except PictureError as error:
        raise InputError(f"{where}: {error}; record raw pictures of 8 bits, JPEG or PNG") from None


def _check_compressed(data: Any) -> None:
    """Raises PictureError, without decoding, for an unknown format or more than `_MAX_PIXELS`."""
    from twin_policy import PictureError

    try:
        with Pillow.open(BytesIO(bytes(data))) as head:
            width, height = head.size
    except UnidentifiedImageError:
        raise PictureError(f"{len(data)} bytes are neither a JPEG nor a PNG picture") from None
    except (Pillow.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise PictureError(f"damaged picture of {len(data)} bytes ({error})") from None
    if width * height > _MAX_PIXELS:
        raise PictureError(f"picture of {width} x {height} px; expected at most {_MAX_PIXELS:,} px")


def _decode(contents: BagContents, count: FilmStatistics) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Yields time [s] and frame of each picture; counts damaged ones instead. Raises InputError if all are damaged."""
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
    """The lens of a sensor_msgs/CameraInfo of ROS 1 or 2; for rectified pictures, the matrix P gives the intrinsics.

    Raises InputError: an unknown camera model or implausible values; `where` begins the message.
    """
    from twin_policy import Camera, PictureError

    try:
        camera = Camera.from_info(info, rectified)
    except PictureError as error:
        raise InputError(f"{where}: {error}; add `camera = ...` under this [[source]] of scene.toml") from None
    width, height = camera.size
    d = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
    if not camera.is_distorted:
        return checked_lens("PINHOLE", camera.intrinsics, width, height, where)
    if camera.model == "equidistant":
        return checked_lens("OPENCV_FISHEYE", (*camera.intrinsics, *d[:4]), width, height, where)
    if any(d[4:]):  # k3, and k4 to k6 of rational_polynomial, in COLMAP's order
        return checked_lens("FULL_OPENCV", (*camera.intrinsics, *d), width, height, where)
    return checked_lens("OPENCV", (*camera.intrinsics, *d[:4]), width, height, where)


def _lens(info: Any, topics: dict[str, str], frame: str, size: tuple[int, int], path: Path) -> tuple[Lens | None, str]:
    """The calibrated lens, or None, and a note on its source or on why it is missing."""
    if info is None:
        return None, f"no {CAMERA_INFO}; the camera is calibrated from the film"
    topic = topics["camera"]
    if not getattr(info, "k", getattr(info, "K", (0.0,)))[0] > 0.0:
        return None, f"{topic} has no calibration; the camera is calibrated from the film"
    if frame and info.header.frame_id and info.header.frame_id != frame:
        return None, (
            f"{topic} is of another camera (frame {info.header.frame_id}, pictures have {frame}); the camera is "
            "calibrated from the film"
        )
    lens = lens_of(info, is_rectified(topics["pictures"]), f"{path}: {topic}")
    if not same_aspect((lens.width, lens.height), size):
        raise InputError(
            f"{path}: {topic} is for {lens.width}x{lens.height}, but the pictures are {size[0]}x{size[1]}; expected "
            "the same aspect ratio: add `camera = ...` under this [[source]] of scene.toml"
        )
    return lens, f"{topic}: {info.distortion_model or 'no distortion'}"


# ---- the camera on the robot


def _add_transforms(transforms: dict[str, tuple[str, Array]], message: Any) -> None:
    """Adds a message's transforms to the dictionary child frame → (parent frame, child_to_parent (4, 4))."""
    for one in message.transforms:
        if len(transforms) >= _MAX_FRAMES:
            return
        p = one.transform.translation
        values = np.array([p.x, p.y, p.z, *unit_quaternion(one.transform.rotation)])
        if not np.isfinite(values).all():
            continue
        pose = pose_of(Rotation.from_quat(values[3:]).as_matrix(), values[:3])
        transforms[one.child_frame_id.strip("/")] = (one.header.frame_id.strip("/"), pose)


def _pose_in_base(transforms: dict[str, tuple[str, Array]], frame: str) -> Array | None:
    """camera_to_base (4, 4) with OpenCV axes, or None if the camera's frame is not connected to `base_link`."""
    pose, name, seen = np.eye(4), frame.strip("/"), set()
    while not _is_named(name, _BASE):
        if name not in transforms or name in seen:
            return None
        seen.add(name)
        name, step = transforms[name]
        pose = step @ pose
    if abs(pose[2, 2]) > abs(pose[2, 1]):  # z is vertical: x is forward and y left, unlike in optical frames
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AHEAD
    return pose


def _seat(camera_to_base: Array | None, transforms: dict[str, tuple[str, Array]]) -> CameraSeat | None:
    if camera_to_base is None:
        return None
    base_height, known = BASE_HEIGHT, False
    for child, (parent, pose) in transforms.items():
        if _is_named(child, _GROUND) and _is_named(parent, _BASE):
            base_height, known = -float(pose[2, 3]), True
        elif _is_named(child, _BASE) and _is_named(parent, _GROUND):
            base_height, known = float(pose[2, 3]), True
    yaw, pitch, roll = Rotation.from_matrix(camera_to_base[:3, :3] @ CAMERA_AHEAD.T).as_euler("ZYX", degrees=True)
    x, y, z = camera_to_base[:3, 3].tolist()
    return CameraSeat(z + base_height, known, (x, y), float(yaw), float(pitch), float(roll))


def _is_named(frame: str, name: str) -> bool:
    """True if the frame has this name, with or without a prefix that ends with a slash."""
    return frame.rpartition("/")[2] == name


def _lens_positions(poses: Array, arm: Array) -> Array:
    """Positions of the lens, shape (p, 3); NaN for poses that are not finite.

    `poses` (p, 7) holds position and quaternion of the base; `arm` (3,) is the position of the lens in the base frame.
    """
    good = np.isfinite(poses).all(1)
    out = np.full((len(poses), 3), np.nan)
    if good.any():
        out[good] = poses[good, :3] + Rotation.from_quat(poses[good, 3:]).apply(arm)
    return out
