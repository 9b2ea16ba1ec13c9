"""Imperfections of a real camera: vibration, drifting exposure and motion blur. All are off by default."""

from dataclasses import dataclass

import cv2
import numpy as np

from twin.geometry.poses import inverse_pose
from twin.types import Array, Array32

_VIBRATION_TIME = 0.05  # [s] correlation time of the vibration
_DRIFT_TIME = 5.0  # [s] correlation time of the exposure
_MAX_SHUTTER = 0.5  # the shutter is open for at most this fraction of the time between two pictures
_KNEE = 0.75  # colors above this value are compressed to at most 1


@dataclass(frozen=True)
class CameraOptions:
    """Strength of a camera's imperfections."""

    vibration: float = 0.0
    """Standard deviation of the camera's rotation about each of its axes [°]."""
    exposure: float = 0.0
    """Standard deviation of the logarithm of the exposure, which drifts over seconds."""
    shutter: float = 0.0
    """Time for which the shutter is open [s]."""
    blur_samples: int = 5
    """Number of shifted pictures that are averaged for motion blur."""


class CameraNoise:
    """Imperfections of one camera in one episode; same seed and times give the same result."""

    def __init__(self, options: CameraOptions, rng: np.random.Generator):
        self._options, self._rng = options, rng
        self._time: float | None = None
        self._tilt, self._drift = np.zeros(3), 0.0
        self._last: tuple[float, Array] | None = None

    def perturb_pose(self, camera_to_world: Array, time: float) -> Array:
        """Returns the camera's pose with vibration added, shape (4, 4), and updates the exposure for `apply`.

        `time` is the time of the episode [s]; it must not decrease between calls.
        """
        step = np.inf if self._time is None else max(time - self._time, 0.0)
        self._time = time
        # This update of an Ornstein-Uhlenbeck process is exact for any time step.
        keep = np.exp(-step / np.array([_VIBRATION_TIME, _DRIFT_TIME]))
        fresh = np.sqrt(1.0 - keep**2)
        self._tilt = keep[0] * self._tilt + fresh[0] * self._rng.normal(size=3)
        self._drift = float(keep[1] * self._drift + fresh[1] * self._rng.normal())
        if self._options.vibration == 0.0:
            return camera_to_world
        out = camera_to_world.copy()
        turn, _ = cv2.Rodrigues(np.deg2rad(self._options.vibration) * self._tilt)
        out[:3, :3] = out[:3, :3] @ turn
        return out

    def apply(self, rgb: Array32, depth: Array32, pose: Array, time: float, rays: Array, intrinsics: Array) -> Array32:
        """Returns the picture with motion blur and exposure drift.

        Args:
            rgb: Sharp picture, shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            pose: camera_to_world as `perturb_pose` returned it, shape (4, 4).
            time: Time of the episode [s].
            rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
            intrinsics: fx, fy, cx, cy [px], shape (4,).
        """
        last, self._last = self._last, (time, pose)
        if self._options.shutter > 0.0 and last is not None and time > last[0]:
            share = min(self._options.shutter / (time - last[0]), _MAX_SHUTTER)
            rgb = motion_blur(rgb, depth, pose, last[1], share, rays, intrinsics, self._options.blur_samples)
        if self._options.exposure > 0.0:
            rgb = soft_clip(rgb * np.float32(np.exp(self._options.exposure * self._drift)))
        return rgb


def motion_blur(
    rgb: Array32, depth: Array32, pose: Array, before: Array, share: float, rays: Array, intrinsics: Array, samples: int
) -> Array32:
    """Returns a picture with motion blur: the mean of copies shifted by the camera's motion while the shutter is open.

    The shutter is open during the last fraction `share` of the motion from `before` to `pose`. The world is assumed to
    be static. Shapes and units as in `CameraNoise.apply`.
    """
    to_before = inverse_pose(before) @ pose
    points = (rays * depth[..., None]) @ to_before[:3, :3].T + to_before[:3, 3]
    fx, fy, cx, cy = intrinsics
    z = np.maximum(points[..., 2], 1e-3)
    there = np.stack([fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy], -1)
    here = np.stack([fx * rays[..., 0] + cx, fy * rays[..., 1] + cy], -1)
    flow = np.where(points[..., 2:] > 0.0, there - here, 0.0)
    out = np.zeros_like(rgb)
    for back in np.linspace(0.0, share, samples):
        # In OpenCV, the center of the first pixel has the coordinate 0; here, 0.5.
        at = (here + back * flow - 0.5).astype(np.float32)
        out += cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out / np.float32(samples)


def soft_clip(rgb: Array32) -> Array32:
    """Returns colors of at most 1: values above `_KNEE` are compressed smoothly, not clipped."""
    over = np.maximum(rgb - _KNEE, 0.0)
    return np.minimum(rgb, _KNEE) + (1.0 - _KNEE) * (1.0 - np.exp(-over / (1.0 - _KNEE)))
