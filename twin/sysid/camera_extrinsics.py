"""Extrinsics and focal length of the robot's front camera, estimated from its film of the built scene.

`capture/localize.py` localizes the film's frames. The extrinsics are the camera's height above flat ground and its
rotation from straight ahead: yaw to the left, pitch down, roll to the right. Height, pitch and roll follow from the
frames' poses relative to a robot base at rest on the ground below. Yaw follows from the direction of travel: a base
that does not slide sideways moves along its heading, so its sideways steps must not add up. The robot turns about a
point that need not be the base's origin, and a camera ahead of that point swings outwards. So the point's forward
offset from the origin is estimated together with yaw.
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
from twin.capture.bag import is_bag
from twin.capture.bag_film import read_contents
from twin.capture.camera_models import Lens, same_aspect, undistorted
from twin.capture.localize import FilmRegistration, register_film
from twin.capture.video import FilmStatistics, read_film, video_film
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints
from twin.geometry.images import psnr, to_uint8, write_image
from twin.geometry.passes import path_length
from twin.loading import load_scene
from twin.mjcf.scene_xml import camera_pose, rest_pose
from twin.robot import BASE_HEIGHT, CAMERA_AHEAD, HuskyParams, PixelCamera
from twin.scene import SceneDir, require_stage
from twin.types import Array, Image

# ---- estimation from poses

_MIN_FRAMES, _MIN_WAY = 16, 6.0  # least number of frames; shortest path [m]
_PARTS = 8  # number of consecutive parts of the film for the jackknife
_NOISE, _OUTLYING = 0.01, 0.03  # [m] standard deviation of a sum of sideways steps; threshold of the robust loss
_PIVOT = 0.1  # [m] prior standard deviation of the turning point's forward offset from the base's origin
_ROUNDS = 3  # number of alternations between estimating base poses and extrinsics
_FAR_OFF, _JUMP = 8.0, 3.0  # multiples of the median deviation (outliers) and of the median step (jumps)


@dataclass(frozen=True)
class CameraExtrinsics:
    """Values or standard errors of a camera's height [m] and angles [°].

    An error of the principal point shifts the image as yaw and pitch do; the estimated yaw and pitch correct it, too.
    """

    height: float
    yaw: float
    pitch: float
    roll: float


def estimate_extrinsics(
    camera_to_world: Array, ground_at: Callable[[Array], Array], offset: tuple[float, float]
) -> tuple[CameraExtrinsics, CameraExtrinsics]:
    """The extrinsics, and their standard errors from a jackknife over consecutive parts of the film.

    Args:
        camera_to_world: OpenCV axes, in the order of the film [m], shape (n, 4, 4).
        ground_at: Returns the ground's height [m], shape (n,), at points (n, 2).
        offset: Forward and left position of the lens relative to the base's origin [m].

    Raises:
        InputError: too few frames, or too short a path.
    """
    poses = np.asarray(camera_to_world, float)
    way = path_length(poses[:, :2, 3])
    if len(poses) < _MIN_FRAMES or way < _MIN_WAY:
        raise InputError(
            f"{len(poses)} frames of the film were localized in the place, over {way:.1f} m; expected at least "
            f"{_MIN_FRAMES} over {_MIN_WAY:g} m; drive further, slowly, on the filmed path and in light "
            "like that of one of the films"
        )
    yaw, lens = 0.0, np.array([*offset, 0.0])
    headings = base_heading(poses, 0.0)
    for _ in range(_ROUNDS):  # base poses depend on the extrinsics
        angles, heights, bases = _relative_to_base(poses, headings - yaw, ground_at, lens)
        inlier = _inliers(np.column_stack([angles[:, 1:], heights]))
        lens[2], headings = heights[inlier].mean(), _headings(poses, angles[inlier, 1:].mean(0))
        yaw = _yaw(bases, headings, inlier)
    part = np.arange(len(poses)) * _PARTS // len(poses)
    estimates = []
    for k in range(_PARTS):
        rest = inlier & (part != k)
        estimates.append((heights[rest].mean(), _yaw(bases, headings, rest), *angles[rest, 1:].mean(0)))
    spread = np.sqrt((_PARTS - 1) * np.var(estimates, axis=0))
    pitch, roll = np.degrees(angles[inlier, 1:].mean(0)).tolist()
    value = CameraExtrinsics(float(lens[2]) + BASE_HEIGHT, float(np.degrees(yaw)), pitch, roll)
    return value, CameraExtrinsics(float(spread[0]), *np.degrees(spread[1:]).tolist())


def camera_pose_on_ground(
    params: HuskyParams, position: Array, heading: float, ground_at: Callable[[Array], Array]
) -> Array:
    """camera_to_world (4, 4), OpenCV axes, of the camera of a robot that is at rest on the ground.

    Args:
        position: x, y of the camera (2,) [m].
        heading: Heading of the base [rad].
        ground_at: Returns the ground's height [m], shape (n,), at points (n, 2).
    """
    base, rotation = _base_pose(position, heading, ground_at, np.array(params.camera_position))
    return camera_pose(params, base, rotation)


def base_below_camera(params: HuskyParams, camera_to_world: Array, ground_at: Callable[[Array], Array]) -> Array:
    """x, y [m], yaw [rad] (3,) of the base of a robot at rest, from its camera's pose (4, 4), OpenCV axes."""
    heading = float(base_heading(camera_to_world, np.deg2rad(params.camera_yaw)))
    base, _ = _base_pose(camera_to_world[:2, 3], heading, ground_at, np.array(params.camera_position))
    return np.array([*base[:2], heading])


def base_heading(camera_to_world: Array, yaw: float) -> Array:
    """Headings [rad] (...) of bases from poses (..., 4, 4) of cameras that are turned left by `yaw` [rad]."""
    return np.arctan2(camera_to_world[..., 1, 2], camera_to_world[..., 0, 2]) - yaw


def _headings(poses: Array, pitch_roll: Array) -> Array:
    """Headings [rad] (n,) of bases from camera poses (n, 4, 4) with zero yaw and given pitch and roll [rad] (2,)."""
    base = poses[:, :3, :3] @ CAMERA_AHEAD.T @ Rotation.from_euler("YX", pitch_roll).as_matrix().T
    return np.arctan2(base[:, 1, 0], base[:, 0, 0])


def _inliers(values: Array) -> NDArray[np.bool_]:
    """Mask (n,) of frames whose values (n, k) are within `_FAR_OFF` median deviations of the median in every column."""
    off = np.abs(values - np.median(values, axis=0))
    return (off <= _FAR_OFF * np.maximum(np.median(off, axis=0), 1e-6)).all(1)


def _yaw(bases: Array, headings: Array, use: NDArray[np.bool_]) -> float:
    """The camera's yaw to the left of the base's direction of travel [rad].

    Args:
        bases: x, y of the base [m], shape (n, 2).
        headings: Headings of the base if the camera's yaw is zero [rad], shape (n,).
        use: Frames to use, shape (n,). Gaps and jumps split the path into segments with separate sums of steps.
    """
    way = np.diff(bases, axis=0)
    length = np.linalg.norm(way, axis=1)
    connected = use[1:] & use[:-1] & (length <= _JUMP * np.median(length))
    segments = [part for part in np.split(np.arange(len(bases)), np.flatnonzero(~connected) + 1) if len(part) > 2]

    def sideways(unknown: Array) -> Array:
        """Sideways drift [m] of the point about which the robot turns, `pivot` [m] ahead of the base's origin.

        In each segment: the sum of sideways steps up to each frame, minus the mean of these sums. The last value is the
        residual of the prior of `pivot`.
        """
        yaw, pivot = unknown
        heads = headings - yaw
        off = way + np.diff(pivot * np.stack([np.cos(heads), np.sin(heads)], 1), axis=0)
        middle = heads[:-1] + np.angle(np.exp(1j * np.diff(heads))) / 2.0
        step = off[:, 1] * np.cos(middle) - off[:, 0] * np.sin(middle)
        sums = [np.append(0.0, np.cumsum(step[segment[:-1]])) for segment in segments]
        return np.concatenate([*(one - one.mean() for one in sums), [_NOISE * pivot / _PIVOT]])

    return float(least_squares(sideways, np.zeros(2), loss="soft_l1", f_scale=_OUTLYING).x[0])


def _relative_to_base(
    poses: Array, headings: Array, ground_at: Callable[[Array], Array], lens: Array
) -> tuple[Array, Array, Array]:
    """Camera poses (n, 4, 4) relative to bases at rest on the ground below.

    Returns:
        Yaw, pitch, roll [rad] (n, 3), heights above the bases' origins [m] (n,), and x, y of the origins [m] (n, 2).
    """
    angles, heights, bases = np.zeros((len(poses), 3)), np.zeros(len(poses)), np.zeros((len(poses), 2))
    for i, (pose, heading) in enumerate(zip(poses, headings, strict=True)):
        base, rotation = _base_pose(pose[:2, 3], heading, ground_at, lens)
        angles[i] = Rotation.from_matrix(rotation.T @ pose[:3, :3] @ CAMERA_AHEAD.T).as_euler("ZYX")
        heights[i], bases[i] = (rotation.T @ (pose[:3, 3] - base))[2], base[:2]
    return angles, heights, bases


def _base_pose(
    position: Array, heading: float, ground_at: Callable[[Array], Array], lens: Array
) -> tuple[Array, Array]:
    """Origin [m] and axes (3, 3) of a base at rest whose lens, at `lens` [m] in its frame, is at x, y = `position`."""
    rotation = Rotation.from_euler("Z", heading).as_matrix()
    arm = lens + np.array([0.0, 0.0, BASE_HEIGHT])  # lens, from the ground below the base's origin
    for _ in range(2):  # a tilted base moves its lens sideways
        origin, (w, x, y, z) = rest_pose(ground_at, position - (rotation @ arm)[:2], heading)
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return origin, rotation


# ---- calibration from a film

_CHOICE = CaptureConfig(fps=2.0, max_frames=90)
# Largest accepted standard errors [°], [m]. Each turn moves the edge of the policy's 160×90 pictures by about 0.7 px.
_WORST_TURN, _WORST_ROLL, _WORST_HEIGHT = 0.3, 0.5, 0.03
_WORST_ERROR = 3.0  # [px] largest accepted median reprojection error if the longer side is 1280 px
_PICTURES, _WIDTH = 3, 640  # number of frames in the comparison, and their largest width [px]


@dataclass(frozen=True)
class CameraCalibration:
    """A robot's camera calibrated by a film."""

    registration: FilmRegistration
    frames: int
    """Number of frames taken from the film."""
    extrinsics: CameraExtrinsics
    standard_errors: CameraExtrinsics
    focal_given: bool
    """True: `[robot]` gives the intrinsics. False: the focal length is estimated, or comes from a bag's calibration."""

    @property
    def summary(self) -> str:
        """One line: the number of localized frames, and their reprojection error."""
        found = f"{len(self.registration.frames)} of {self.frames} frames localized in the place"
        return f"{found}, median reprojection error {self.registration.error:.2f} px"

    @property
    def identified(self) -> dict[str, tuple[Any, Any]]:
        """Fields of HuskyParams with value and standard error."""
        out: dict[str, tuple[Any, Any]] = {
            f"camera_{name}": (value, getattr(self.standard_errors, name))
            for name, value in vars(self.extrinsics).items()
        }
        if not self.focal_given:
            lens, error = self.registration.lens, self.registration.focal_error
            errors = (error, error, None, None) if error else None  # a bag's calibration has no standard errors
            out["camera_intrinsics"] = tuple(map(float, lens.intrinsics)), errors
            out["camera_size"] = (lens.width, lens.height), None
        return out

    def figures(self) -> dict[str, Any]:
        """All numbers, for JSON."""
        return {
            "frames": self.frames,
            "frames_found": len(self.registration.frames),
            "reprojection_error_px": round(self.registration.error, 3),
            "robot": {
                name: {"value": value, "standard_error": error} for name, (value, error) in self.identified.items()
            },
        }


def calibrate_camera(
    film: Path, scene: SceneDir, params: HuskyParams, topic: str = ""
) -> tuple[CameraCalibration, list[Image]]:
    """Estimates the camera's extrinsics and, unless given, its focal length; also returns the film's frames.

    Args:
        film: Undistorted film of the front camera, while the robot drives through the scene, mostly straight ahead; or
            a bag with the camera's pictures, which are undistorted by the bag's calibration.
        params: The robot, with given intrinsics or none.
        topic: Topic of the bag's pictures; if empty, the topic with the most pictures.

    Raises:
        InputError: the scene is not built, or the film does not determine the extrinsics.
    """
    ground = _ground(scene)
    bag = read_contents(film, topic) if is_bag(film) else None
    source = video_film(film) if bag is None else bag.film()
    calibrated = bag.lens if bag else None
    with runtime.bar("reading the film", 0, "frame") as bar:
        frames = []
        for frame in read_film(source, _CHOICE, FilmStatistics(), lambda *_: None):
            image, pinhole = frame.image, None
            if calibrated is not None:
                image, pinhole = undistorted(image, calibrated.scaled(image.shape[1], image.shape[0]))
            frames.append(image)
            bar.update()
    size = frames[0].shape[1], frames[0].shape[0]
    registration = register_film(frames, pinhole or _given_lens(params, size), scene)
    worst = _WORST_ERROR * max(size) / 1280
    if registration.error > worst:
        raise InputError(
            f"{film}: features lie {registration.error:.1f} px (median) from where a pinhole camera would show them, "
            f"expected at most {worst:.1f}; rectify the film (remove its lens distortion)"
        )
    extrinsics, errors = estimate_extrinsics(registration.camera_to_world, ground.at, params.camera_offset)
    turned = max(errors.yaw, errors.pitch) > _WORST_TURN or errors.roll > _WORST_ROLL
    if turned or errors.height > _WORST_HEIGHT:
        raise InputError(
            f"{film}: leaves the camera's yaw, pitch, roll uncertain by {errors.yaw:.2f}, {errors.pitch:.2f}, "
            f"{errors.roll:.2f}° and its height by {errors.height:.3f} m, expected at most {_WORST_TURN:g}° (roll "
            f"{_WORST_ROLL:g}°) and {_WORST_HEIGHT:g} m; film a longer drive on the filmed path"
        )
    given = bool(params.camera_intrinsics) and pinhole is None
    return CameraCalibration(registration, len(frames), extrinsics, errors, given), frames


def write_camera_comparison(
    folder: Path, calibration: CameraCalibration, frames: list[Image], scene: SceneDir, robot: HuskyParams
) -> None:
    """Writes `camera.png`: frames of the film on the left, renderings of the calibrated camera on the right."""
    field, ground = load_scene(scene.root).field(), _ground(scene)
    some = np.linspace(0, len(calibration.registration.frames) - 1, _PICTURES + 2).round().astype(int)[1:-1]
    found = calibration.registration
    width, height = found.lens.width, found.lens.height
    size = min(_WIDTH, width), round(height * min(1.0, _WIDTH / width))
    lens = PixelCamera(tuple(found.lens.intrinsics.tolist()), (width, height)).resized(size)
    rows = []
    for k in some:
        pose = found.camera_to_world[k]
        heading = float(base_heading(pose, np.deg2rad(calibration.extrinsics.yaw)))
        on_ground = camera_pose_on_ground(robot, pose[:2, 3], heading, ground.at)
        here = Viewpoints.of(on_ground, np.array(lens.intrinsics), size)
        filmed = cv2.resize(frames[found.frames[k]], size, interpolation=cv2.INTER_AREA)
        rendered = [field.render(here, lighting).rgb[0] for lighting in field.lightings]
        best = max(rendered, key=lambda rgb: psnr(rgb, filmed / np.float32(255.0)))
        rows.append(np.hstack([filmed, to_uint8(best)]))
    write_image(folder / "camera.png", np.vstack(rows))


def _ground(scene: SceneDir) -> Ground:
    """The ground of a scene. Raises InputError: the scene is not built up to the mesh."""
    for stage in ("metric", "field", "mesh"):
        require_stage(scene, stage)
    return Ground.load(scene.stage("mesh"))


def _given_lens(params: HuskyParams, size: tuple[int, int]) -> Lens | None:
    """The robot's lens at the film's size; None without given intrinsics."""
    if not params.camera_intrinsics:
        return None
    if not same_aspect(size, params.camera().size):
        width, height = params.camera().size
        raise InputError(
            f"the film is {size[0]}x{size[1]}, but camera_intrinsics in [robot] are for {width}x{height}; "
            "film at the full field of view, or give the intrinsics of the film"
        )
    return Lens("PINHOLE", tuple(params.camera().resized(size).intrinsics), *size)
