"""Skid steering without dynamics: what wheel speeds alone say of the motion, and how far off that is.

*Nominal*: a differential drive whose wheels roll freely. *ICR model*: each side's tread meets the ground where it does
not slip at a lateral offset of its own, the instantaneous centre of rotation of that side (Mandow et al. 2007); with a
factor of slip per side and a common forward offset it is the usual baseline, five numbers. Residuals are *bent*, so
that a window in which the robot was stuck counts little: a window's squared residuals s count as log(1 + s).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.alignment.logs import PERIOD, SAMPLES, Windows, retimed, wrapped
from twin.alignment.timing import OLDEST
from twin.robot import TRACK, WHEEL_RADIUS

Array = NDArray[np.float64]

POSITION_SCALE, YAW_SCALE = 0.08, 0.07  # [m], [rad] what a good model misses by in 2 s
LOOKS = (SAMPLES // 2, SAMPLES)
"""Samples of a window at which a model is held against the poses."""


@dataclass(frozen=True)
class Icr:
    """The ICR model."""

    slip_left: float = 1.0
    slip_right: float = 1.0
    """Speed of a side's tread over the ground / of its wheels' circumference."""
    y_left: float = TRACK / 2
    y_right: float = -TRACK / 2
    """[m]"""
    x: float = 0.0
    """[m]"""

    def motion(self, wheels: Array) -> Array:
        """vx, vy [m/s], yaw rate [rad/s], shape (..., 3), for wheel speeds [rad/s], shape (..., 2)."""
        left = self.slip_left * WHEEL_RADIUS * wheels[..., 0]
        right = self.slip_right * WHEEL_RADIUS * wheels[..., 1]
        rate = (right - left) / (self.y_left - self.y_right)
        forward = (right * self.y_left - left * self.y_right) / (self.y_left - self.y_right)
        return np.stack([forward, -self.x * rate, rate], -1)


NOMINAL = Icr()


def integrate(motion: Array) -> Array:
    """Poses x, y [m], yaw [rad] from zero, shape (n, k + 1, 3), for motions (n, k, 3) held `PERIOD` [s] each."""
    turned = motion[..., 2] * PERIOD
    yaw = np.concatenate([np.zeros((len(motion), 1)), np.cumsum(turned, 1)], 1)
    middle = yaw[:, :-1] + turned / 2
    cos, sin = np.cos(middle), np.sin(middle)
    x = np.cumsum((motion[..., 0] * cos - motion[..., 1] * sin) * PERIOD, 1)
    y = np.cumsum((motion[..., 0] * sin + motion[..., 1] * cos) * PERIOD, 1)
    start = np.zeros((len(motion), 1))
    return np.stack([np.concatenate([start, x], 1), np.concatenate([start, y], 1), yaw], -1)


def predict(model: Icr, windows: Windows) -> Array:
    """Poses by measured wheel speeds, which are held afterwards, since each window's first pose was measured.
    Shape (n, k + OLDEST + 1, 3)."""
    before, after = windows.before[:, -1 - OLDEST : -1], np.repeat(windows.wheels[:, -1:], OLDEST, 1)
    poses = integrate(model.motion(np.concatenate([before, windows.wheels, after], 1)))
    return retimed(poses, -windows.measured[:, 0], OLDEST)


def fit_icr(windows: Windows) -> Icr:
    """The ICR model that fits those of the windows best that are for fitting."""
    start = np.array([1.0, 1.0, 0.5, -0.5, 0.0])
    fitting = windows.fitting

    def error(x: Array) -> Array:
        return bend(residuals(predict(Icr(*x), windows), windows)[fitting]).ravel()

    found = least_squares(error, start, x_scale=(0.1, 0.1, 0.1, 0.1, 0.1))
    return Icr(*(float(value) for value in found.x))


def at(poses: Array, time: Array) -> Array:
    """Poses (n, m, 3), `PERIOD` [s] apart, at one time [s] per window, shape (n,), interpolated. Shape (n, 3)."""
    position = np.clip(time / PERIOD, 0, poses.shape[1] - 1 - 1e-9)
    before = position.astype(int)
    share = (position - before)[:, None]
    row = np.arange(len(poses))
    return poses[row, before] * (1 - share) + poses[row, before + 1] * share


def residuals(predicted: Array, windows: Windows) -> Array:
    """Predicted minus measured in units of what a good model misses by, at `LOOKS`. Shape (n, looks, 3)."""
    elapsed = windows.elapsed
    error = np.stack([at(predicted, elapsed[:, i]) - windows.poses[:, i] for i in LOOKS], 1)
    error[..., 2] = wrapped(error[..., 2])
    return error / (POSITION_SCALE, POSITION_SCALE, YAW_SCALE)


def bend(error: Array) -> Array:
    """Residuals (n, looks, ...) scaled per window so that their squares sum to log(1 + s), s their mean over looks."""
    return error * _per_window(_bent(_size(error)) / np.sqrt(error.shape[1]), error)


def bent_slopes(error: Array, slopes: Array) -> Array:
    """What a least-squares solver may take for the slopes of `bend(error)`: with them its gradient is exact.

    The true ones turn with the residuals, over which differences stumble; Gauss and Newton do not need that part.

    Args:
        error: Shape (n, looks, ...).
        slopes: Of `error`, one more axis.
    """
    size = _size(error)
    factor = 1 / (1 + size) / _bent(size) / np.sqrt(error.shape[1])
    return slopes * _per_window(factor, slopes)


def weighted(error: Array, values: Array) -> Array:
    """Values (n, ...) times the root of their window's weight 1 / (1 + s), as iterated least squares would have it."""
    return values * _per_window(1 / np.sqrt((1 + _size(error)) * error.shape[1]), values)


def _size(error: Array) -> Array:
    return (error**2).sum(tuple(range(1, error.ndim))) / error.shape[1]


def _bent(size: Array) -> Array:
    """√(log(1 + s) / s), which tends to 1 at 0."""
    return np.where(size < 1e-9, 1.0, np.sqrt(np.log1p(size) / np.maximum(size, 1e-12)))


def _per_window(factor: Array, like: Array) -> Array:
    return factor.reshape(-1, *[1] * (like.ndim - 1))


def end_errors(predicted: Array, windows: Windows) -> tuple[Array, Array]:
    """Distance [m] and angle [°] between predicted and measured pose at the end of each window, shapes (n,)."""
    error = at(predicted, windows.elapsed[:, -1]) - windows.poses[:, -1]
    return np.hypot(error[:, 0], error[:, 1]), np.abs(np.degrees(wrapped(error[:, 2])))
