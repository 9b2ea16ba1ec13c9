"""The frame of a recording's poses in the scene: rotation and shift, fitted to pictures that were localized there.

Poses of a trial are in the frame of their ROS topic (odometry, RTK). Pictures, evenly spaced along the drive, are
localized in the scene. The frame is fitted to the positions of the robot's base at these pictures.
"""

from dataclasses import dataclass

import numpy as np

from twin.assets.ground import Ground
from twin.capture.camera_models import Lens
from twin.capture.localize import register_film
from twin.errors import InputError
from twin.robot import HuskyParams
from twin.scene import SceneDir, require_stage
from twin.sysid.camera_extrinsics import base_below_camera
from twin.sysid.trial_recording import TrialRecording
from twin.types import Array
from twin_policy import Rectifier

SCENE_FRAME, FIT = "scene", "pictures"
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


def scene_frame(recording: TrialRecording, frame: str, start: int, scene: SceneDir, robot: HuskyParams) -> FrameFit:
    """The frame of a recording's poses in a built scene.

    Args:
        frame: `SCENE_FRAME` or `FIT`.
        start: Time [ns] from which pictures are used.

    Raises:
        InputError: an error of `fit_frame`, or the pictures are missing or cannot be read.
    """
    if frame == SCENE_FRAME:
        return FrameFit(0.0, np.zeros(2))
    ground = Ground.load(require_stage(scene, "mesh"))
    stamps = recording.shutter[recording.shutter >= start]
    xy = recording.poses_at(stamps)[:, :2]
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))) if len(xy) else np.zeros(0)
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
