"""What a real camera adds to a picture: it shakes, its exposure drifts, and what moves under an open shutter smears.

All are off by default; the robot's own rattling on the ground is in the physics and is no part of this. Delays of
pictures and commands are the environment's.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from twin.geometry.poses import inverse_pose
from twin.types import Array, Array32

_SHAKE_TIME = 0.05  # [s] over which vibration forgets where it was
_DRIFT_TIME = 5.0  # [s] over which exposure does
_MOST_SMEAR = 0.5  # of the time between two pictures that a shutter can be open
_KNEE = 0.75  # film colours above roll off towards 1


@dataclass(frozen=True)
class CameraOptions:
    """How imperfect a camera is."""

    vibration: float = 0.0
    """Standard deviation of the camera's direction about each of its axes [°]."""
    exposure: float = 0.0
    """Standard deviation of the logarithm of the exposure, drifting over seconds."""
    shutter: float = 0.0
    """Time the shutter is open [s]."""
    blur_samples: int = 5
    """Pictures that a smeared one is the mean of."""


class CameraNoise:
    """One camera in one episode; the same seed and the same times give the same effects."""

    def __init__(self, options: CameraOptions, rng: np.random.Generator):
        self._options, self._rng = options, rng
        self._time: float | None = None
        self._tilt, self._drift = np.zeros(3), 0.0
        self._last: tuple[float, Array] | None = None

    def shaken(self, camera_to_world: Array, time: float) -> Array:
        """The pose that the camera really has at a time [s] of the episode, shape (4, 4). Times must not go back."""
        step = np.inf if self._time is None else max(time - self._time, 0.0)
        self._time = time
        # Ornstein-Uhlenbeck, exact for any step.
        keep = np.exp(-step / np.array([_SHAKE_TIME, _DRIFT_TIME]))
        fresh = np.sqrt(1.0 - keep**2)
        self._tilt = keep[0] * self._tilt + fresh[0] * self._rng.normal(size=3)
        self._drift = float(keep[1] * self._drift + fresh[1] * self._rng.normal())
        if self._options.vibration == 0.0:
            return camera_to_world
        out = camera_to_world.copy()
        turn, _ = cv2.Rodrigues(np.deg2rad(self._options.vibration) * self._tilt)
        out[:3, :3] = out[:3, :3] @ turn
        return out

    def exposed(
        self, rgb: Array32, depth: Array32, pose: Array, time: float, rays: Array, intrinsics: Array
    ) -> Array32:
        """The picture as exposed and smeared.

        Args:
            rgb: Sharp, shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            pose: camera_to_world, as `shaken` gave it, shape (4, 4).
            time: [s].
            rays: Of the pixels, in the camera, with z = 1, shape (height, width, 3).
            intrinsics: fx, fy, cx, cy [px], shape (4,).
        """
        last, self._last = self._last, (time, pose)
        if self._options.shutter > 0.0 and last is not None and time > last[0]:
            share = min(self._options.shutter / (time - last[0]), _MOST_SMEAR)
            rgb = smeared(rgb, depth, pose, last[1], share, rays, intrinsics, self._options.blur_samples)
        if self._options.exposure > 0.0:
            rgb = rolled_off(rgb * np.float32(np.exp(self._options.exposure * self._drift)))
        return rgb


def smeared(
    rgb: Array32, depth: Array32, pose: Array, before: Array, share: float, rays: Array, intrinsics: Array, samples: int
) -> Array32:
    """Mean of a picture over the last `share` of the way from the pose `before` to its own; the world stands still.

    Shapes and units as in `CameraEffects.exposed`.
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
        # OpenCV counts pixels from the middle of the first one.
        at = (here + back * flow - 0.5).astype(np.float32)
        out += cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out / np.float32(samples)


def rolled_off(rgb: Array32) -> Array32:
    """Film colours in [0, 1] of what may be brighter: a shoulder instead of a cut."""
    over = np.maximum(rgb - _KNEE, 0.0)
    return np.minimum(rgb, _KNEE) + (1.0 - _KNEE) * (1.0 - np.exp(-over / (1.0 - _KNEE)))
