"""A film by the robot's own camera → how that camera sits, and its focal length.

The frames are found on the built place (`capture/localize.py`), and the seat by where they were (`camera_extrinsics.py`). The
pictures that are drawn show the film's frames beside what the twin's robot sees from the same spots.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from twin import runtime
from twin.assets.ground import Ground
from twin.capture.camera_models import Lens, same_aspect
from twin.capture.localize import FilmRegistration, register_film
from twin.capture.video import FilmCount, read_film
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, opencv_to_mujoco
from twin.geometry.images import psnr, write_image
from twin.loading import load_scene
from twin.mjcf.scene_xml import rest_pose
from twin.robot import BASE_HEIGHT, HuskyParams, PixelCamera
from twin.scene import SceneDir, finished
from twin.types import Array, Image

# ---- How the front camera sits on a robot, by where it was while the robot drove over known ground.
#
# The *seat* is the camera's height above flat ground and how it is turned from looking straight ahead: yaw to the left,
# pitch down, roll to the right. Height, pitch and roll are what a pose differs by from that of a base at rest on the
# ground below. Yaw shows in the direction of travel: a base that does not slide sideways goes where it heads, so what its
# steps, from frame to frame, go sideways must not add up along the way. A camera ahead of the point that the robot turns
# about swings outwards, so that the distance between the two is fitted along.


_MIN_FRAMES, _MIN_WAY = 16, 6.0  # frames, [m]
_PARTS = 8  # of the film, by whose disagreement errors are told
_NOISE, _OUTLYING = 0.01, 0.03  # [m] that a sum of sideways steps is off, and from which on it counts less
_PIVOT = 0.1  # [m] that the point the robot turns about may well be before or behind the base's origin
_ROUNDS = 3
_FAR_OFF, _JUMP = 8.0, 3.0  # medians: from the middle, and of steps
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes right, down and forward (columns) of a camera that looks straight ahead, in the base."""


@dataclass(frozen=True)
class CameraExtrinsics:
    """Values or standard errors of a camera's seat.

    By how far the principal point is not where it was taken to be, yaw and pitch are off, and so they should: seen in
    pictures they are the same.
    """

    height: float
    """[m]"""
    yaw: float
    """[°]"""
    pitch: float
    """[°]"""
    roll: float
    """[°]"""


def estimate_extrinsics(
    camera_to_world: Array, ground_at: Callable[[Array], Array], offset: tuple[float, float]
) -> tuple[CameraExtrinsics, CameraExtrinsics]:
    """The seat, and its standard errors: a jackknife over consecutive parts of the film.

    Args:
        camera_to_world: OpenCV axes, in the order they were filmed [m], shape (n, 4, 4).
        ground_at: Height of the ground [m] at points (n, 2), shape (n,).
        offset: Of the lens forward and left of the base's origin [m].

    Raises:
        InputError: too few frames, or too short a way.
    """
    poses = np.asarray(camera_to_world, float)
    way = float(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum())
    if len(poses) < _MIN_FRAMES or way < _MIN_WAY:
        raise InputError(
            f"{len(poses)} frames of the film were found on the place, over {way:.1f} m; expected at least "
            f"{_MIN_FRAMES} over {_MIN_WAY:g} m; drive further, slowly, on the filmed path and in light such as some "
            "film's"
        )
    yaw, lens = 0.0, np.array([*offset, 0.0])
    headings = heading_of(poses, 0.0)
    for _ in range(_ROUNDS):  # where a base is and heads shows once it is known how the camera sits on it
        angles, heights, bases = _stances(poses, headings - yaw, ground_at, lens)
        sound = _sound(np.column_stack([angles[:, 1:], heights]))
        lens[2], headings = heights[sound].mean(), _headings(poses, angles[sound, 1:].mean(0))
        yaw = _yaw(bases, headings, sound)
    part = np.arange(len(poses)) * _PARTS // len(poses)
    without = []
    for k in range(_PARTS):
        rest = sound & (part != k)
        without.append((heights[rest].mean(), _yaw(bases, headings, rest), *angles[rest, 1:].mean(0)))
    spread = np.sqrt((_PARTS - 1) * np.var(without, axis=0))
    value = CameraExtrinsics(
        float(lens[2]) + BASE_HEIGHT, float(np.degrees(yaw)), *np.degrees(angles[sound, 1:].mean(0)).tolist()
    )
    return value, CameraExtrinsics(float(spread[0]), *np.degrees(spread[1:]).tolist())


def with_extrinsics(params: HuskyParams, position: Array, heading: float, ground_at: Callable[[Array], Array]) -> Array:
    """camera_to_world (4, 4), OpenCV axes, of a robot's camera at x, y (2,) [m] whose base heads some way [rad]."""
    base, rotation = _base(position, heading, ground_at, np.array(params.camera_position))
    pose = np.eye(4)
    pose[:3, :3] = rotation @ params.camera_rotation
    pose[:3, 3] = base + rotation @ params.camera_position
    return opencv_to_mujoco(pose)  # which turns either into the other


def heading_of(camera_to_world: Array, yaw: float) -> Array:
    """Headings [rad] of bases whose cameras have these poses (..., 4, 4) and look left by a yaw [rad], shape (...)."""
    return np.arctan2(camera_to_world[..., 1, 2], camera_to_world[..., 0, 2]) - yaw


def _headings(poses: Array, lean: Array) -> Array:
    """Headings [rad] (n,) of bases whose cameras look straight ahead but for a pitch and a roll [rad] (2,)."""
    base = poses[:, :3, :3] @ _AHEAD.T @ Rotation.from_euler("YX", lean).as_matrix().T
    return np.arctan2(base[:, 1, 0], base[:, 0, 0])


def _sound(values: Array) -> NDArray[np.bool_]:
    """Which frames (n, k) lie where most do, in every column."""
    off = np.abs(values - np.median(values, axis=0))
    return (off <= _FAR_OFF * np.maximum(np.median(off, axis=0), 1e-6)).all(1)


def _yaw(bases: Array, headings: Array, use: NDArray[np.bool_]) -> float:
    """How far the camera looks left of where the base goes [rad].

    Args:
        bases: Where the base is, x, y [m], shape (n, 2).
        headings: Of the base if that were nothing [rad], shape (n,).
        use: Frames, shape (n,). Steps are added up between those that follow each other; where some are left out, or
            the robot seems to have jumped, a new sum begins.
    """
    way = np.diff(bases, axis=0)
    length = np.linalg.norm(way, axis=1)
    goes_on = use[1:] & use[:-1] & (length <= _JUMP * np.median(length))
    pieces = [piece for piece in np.split(np.arange(len(bases)), np.flatnonzero(~goes_on) + 1) if len(piece) > 2]

    def sideways(unknown: Array) -> Array:
        """What the point that the robot turns about, `pivot` before the base's origin [m], went sideways [m] up to each
        frame of a piece, less the piece's mean."""
        yaw, pivot = unknown
        heads = headings - yaw
        off = way + np.diff(pivot * np.stack([np.cos(heads), np.sin(heads)], 1), axis=0)
        middle = heads[:-1] + np.angle(np.exp(1j * np.diff(heads))) / 2.0
        step = off[:, 1] * np.cos(middle) - off[:, 0] * np.sin(middle)
        sums = [np.append(0.0, np.cumsum(step[piece[:-1]])) for piece in pieces]
        return np.concatenate([*(one - one.mean() for one in sums), [_NOISE * pivot / _PIVOT]])

    return float(least_squares(sideways, np.zeros(2), loss="soft_l1", f_scale=_OUTLYING).x[0])


def _stances(
    poses: Array, headings: Array, ground_at: Callable[[Array], Array], lens: Array
) -> tuple[Array, Array, Array]:
    """Of cameras over bases at rest below: yaw, pitch, roll [rad] (n, 3), heights above the bases' origins [m] (n,),
    and x, y of these [m] (n, 2)."""
    angles, heights, bases = np.zeros((len(poses), 3)), np.zeros(len(poses)), np.zeros((len(poses), 2))
    for i, (pose, heading) in enumerate(zip(poses, headings, strict=True)):
        base, rotation = _base(pose[:2, 3], heading, ground_at, lens)
        angles[i] = Rotation.from_matrix(rotation.T @ pose[:3, :3] @ _AHEAD.T).as_euler("ZYX")
        heights[i], bases[i] = (rotation.T @ (pose[:3, 3] - base))[2], base[:2]
    return angles, heights, bases


def _base(position: Array, heading: float, ground_at: Callable[[Array], Array], lens: Array) -> tuple[Array, Array]:
    """Origin [m] and axes (3, 3) of a base at rest whose lens, at a place in the base (3,), is at x, y (2,)."""
    rotation = Rotation.from_euler("Z", heading).as_matrix()
    arm = lens + np.array([0.0, 0.0, BASE_HEIGHT])  # from the ground
    for _ in range(2):  # a base that leans carries its lens to the side
        origin, (w, x, y, z) = rest_pose(ground_at, position - (rotation @ arm)[:2], heading)
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return origin, rotation


_CHOICE = CaptureConfig(fps=2.0, max_frames=90)
_WORST_TURN, _WORST_HEIGHT = 0.3, 0.03  # [°], [m] standard errors beyond which a seat is not believed
_WORST_ERROR = 3.0  # [px at 1280] of a pinhole's inliers
_PICTURES, _WIDTH = 3, 640  # of the film, and their width [px]


@dataclass(frozen=True)
class CameraAlignment:
    """What a film told of the robot's camera."""

    film: FilmRegistration
    frames: int
    """Of the film that were looked for."""
    seat: CameraExtrinsics
    error: CameraExtrinsics
    """Standard errors."""
    focal_given: bool
    """Whether the focal length was given."""

    @property
    def in_words(self) -> str:
        """The film's fit in a line."""
        found = f"{len(self.film.frames)} of {self.frames} frames found on the place"
        return f"{found}, features {self.film.error:.2f} px off (median)"

    @property
    def identified(self) -> dict[str, tuple[Any, Any]]:
        """Fields of HuskyParams: value and standard error."""
        out: dict[str, tuple[Any, Any]] = {
            f"camera_{name}": (value, getattr(self.error, name)) for name, value in vars(self.seat).items()
        }
        if not self.focal_given:
            fx, fy, cx, cy = (float(value) for value in self.film.lens.intrinsics)
            out["camera_intrinsics"] = (fx, fy, cx, cy), (self.film.focal_error, self.film.focal_error, None, None)
            out["camera_size"] = (self.film.lens.width, self.film.lens.height), None
        return out

    def figures(self) -> dict[str, Any]:
        """Every figure, for JSON."""
        return {
            "frames": self.frames,
            "frames_found": len(self.film.frames),
            "reprojection_error_px": round(self.film.error, 3),
            "robot": {
                name: {"value": value, "standard_error": error} for name, (value, error) in self.identified.items()
            },
        }


def align_camera(film: Path, scene: SceneDir, params: HuskyParams) -> tuple[CameraAlignment, list[Image]]:
    """The seat by a film, and the film's frames that were looked for.

    Args:
        film: Of the robot driving on the place, mostly ahead, by its front camera, rectified.
        scene: Built.
        params: What is known of the robot; intrinsics among it are kept.

    Raises:
        InputError: a scene that is not built, or a film that does not show how the camera sits.
    """
    ground = _ground(scene)
    with runtime.bar("reading the film", 0, "frame") as bar:
        frames = []
        for frame in read_film(film, _CHOICE, FilmCount(), lambda *_: None):
            frames.append(frame.image)
            bar.update()
    size = frames[0].shape[1], frames[0].shape[0]
    found = register_film(frames, _given(params, size), scene)
    worst = _WORST_ERROR * max(size) / 1280
    if found.error > worst:
        raise InputError(
            f"{film}: features lie {found.error:.1f} px off where a pinhole camera would show them, expected at most "
            f"{worst:.1f}; rectify the film (take the distortion out of it)"
        )
    seat, error = estimate_extrinsics(found.camera_to_world, ground.at, params.camera_offset)
    if max(error.yaw, error.pitch, error.roll) > _WORST_TURN or error.height > _WORST_HEIGHT:
        raise InputError(
            f"{film}: leaves the camera's yaw, pitch, roll uncertain by {error.yaw:.2f}, {error.pitch:.2f}, "
            f"{error.roll:.2f}° and its height by {error.height:.3f} m, expected at most {_WORST_TURN:g}° and "
            f"{_WORST_HEIGHT:g} m; film a longer drive on the filmed path"
        )
    return CameraAlignment(found, len(frames), seat, error, bool(params.camera_intrinsics)), frames


def pictures(
    folder: Path, alignment: CameraAlignment, frames: list[Image], scene: SceneDir, robot: HuskyParams
) -> None:
    """Writes `camera.png`: frames of the film, left, and what the twin's robot sees from there."""
    field, ground = load_scene(scene.root).field(), _ground(scene)
    some = np.linspace(0, len(alignment.film.frames) - 1, _PICTURES + 2).round().astype(int)[1:-1]
    width, height = alignment.film.lens.width, alignment.film.lens.height
    size = min(_WIDTH, width), round(height * min(1.0, _WIDTH / width))
    lens = PixelCamera(tuple(alignment.film.lens.intrinsics.tolist()), (width, height)).resized(size)
    rows = []
    for k in some:
        pose = alignment.film.camera_to_world[k]
        heading = float(heading_of(pose, np.deg2rad(alignment.seat.yaw)))
        here = Viewpoints.of(with_extrinsics(robot, pose[:2, 3], heading, ground.at), np.array(lens.intrinsics), size)
        filmed = cv2.resize(frames[alignment.film.frames[k]], size, interpolation=cv2.INTER_AREA)
        seen = [field.render(here, lighting).rgb[0] for lighting in field.lightings]
        best = max(seen, key=lambda rgb: psnr(rgb, filmed / np.float32(255.0)))
        rows.append(np.hstack([filmed, (np.clip(best, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)]))
    write_image(folder / "camera.png", np.vstack(rows))


def _ground(scene: SceneDir) -> Ground:
    """Of a scene that is built as far as is needed here. Raises InputError."""
    for stage in ("metric", "field", "mesh"):
        finished(scene, stage)
    return Ground.load(scene.stage("mesh"))


def _given(params: HuskyParams, size: tuple[int, int]) -> Lens | None:
    """The lens that is known of the robot, at the film's size."""
    if not params.camera_intrinsics:
        return None
    if not same_aspect(size, params.camera().size):
        width, height = params.camera().size
        raise InputError(
            f"the film is {size[0]}x{size[1]}, but camera_intrinsics in [robot] are for {width}x{height}; "
            "film with the whole picture, or give the intrinsics of the film"
        )
    return Lens("PINHOLE", tuple(params.camera().resized(size).intrinsics), *size)
