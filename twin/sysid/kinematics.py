"""Skid steering without dynamics: what wheel speeds alone say of the motion, and how far off that is.

*Nominal*: a differential drive whose wheels roll freely. *ICR model*: each side's tread meets the ground where it does
not slip at a lateral offset of its own, the instantaneous centre of rotation of that side (Mandow et al. 2007); with a
factor of slip per side and a common forward offset it is the usual baseline, five numbers, fitted as the MJCF is
(`robust`).
"""

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.robot import TRACK, WHEEL_RADIUS
from twin.sysid.estimation import Kinds, in_turns, robust_loss
from twin.sysid.logs import OLDEST, PERIOD, SAMPLES, Windows, retimed, wrapped
from twin.types import Array

POSE: Kinds = (0, 0, 1)
"""Of the misses of x, y [m] and yaw [rad]."""
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

    def missed(x: Array) -> Array:
        return residuals(predict(Icr(*x), windows), windows)[fitting]

    def solve(x: Array, unit: Array) -> Array:
        return least_squares(lambda x: robust_loss(missed(x) / unit).ravel(), x, x_scale=0.1).x

    return Icr(*in_turns(start, missed, POSE, solve).tolist())


def at(poses: Array, time: Array) -> Array:
    """Poses (n, m, 3), `PERIOD` [s] apart, at one time [s] per window, shape (n,), interpolated. Shape (n, 3)."""
    position = np.clip(time / PERIOD, 0, poses.shape[1] - 1 - 1e-9)
    before = position.astype(int)
    share = (position - before)[:, None]
    row = np.arange(len(poses))
    return poses[row, before] * (1 - share) + poses[row, before + 1] * share


def residuals(predicted: Array, windows: Windows) -> Array:
    """Predicted minus measured x, y [m] and yaw [rad] at `LOOKS`. Shape (n, looks, 3)."""
    elapsed = windows.elapsed
    error = np.stack([at(predicted, elapsed[:, i]) - windows.poses[:, i] for i in LOOKS], 1)
    error[..., 2] = wrapped(error[..., 2])
    return error


def end_errors(predicted: Array, windows: Windows) -> tuple[Array, Array]:
    """Distance [m] and angle [°] between predicted and measured pose at the end of each window, shapes (n,)."""
    error = at(predicted, windows.elapsed[:, -1]) - windows.poses[:, -1]
    return np.hypot(error[:, 0], error[:, 1]), np.abs(np.degrees(wrapped(error[:, 2])))


# ---- How well a prediction meets the windows it was not fitted to. Errors are of the pose at a window's end.


@dataclass(frozen=True)
class Score:
    """Over windows."""

    windows: int
    position_m: float
    """Median."""
    yaw_deg: float
    """Median."""
    position_m_p90: float
    yaw_deg_p90: float
    wheels_rad_s: float
    """Median over windows, samples and sides."""

    def told(self) -> dict[str, float]:
        """For JSON, rounded."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


class Prediction:
    """What a model makes of every window of a log."""

    def __init__(self, name: str, windows: Windows, poses: Array, wheels: Array | None = None) -> None:
        """
        Args:
            name: For the legend.
            windows: The log.
            poses: `PERIOD` apart since each window's first was measured, shape (n, k + OLDEST + 1, 3).
            wheels: Shape (n, ≥ k, 2); the measured ones where the model is told them.
        """
        self.name = name
        self.windows = windows
        self.poses = poses
        self.wheels = windows.wheels if wheels is None else wheels[:, : windows.wheels.shape[1]]

    @cached_property
    def ends(self) -> Array:
        """Poses when the last one was measured, shape (n, 3)."""
        return at(self.poses, self.windows.elapsed[:, -1])

    @cached_property
    def _errors(self) -> tuple[Array, Array]:
        return end_errors(self.poses, self.windows)

    @property
    def distance(self) -> Array:
        """[m], shape (n,)."""
        return self._errors[0]

    @property
    def angle(self) -> Array:
        """[°], shape (n,)."""
        return self._errors[1]

    def score(self, which: NDArray[np.bool_]) -> Score:
        """Over some of the windows."""
        off = np.abs(self.wheels - self.windows.wheels)[which]
        return Score(
            int(which.sum()),
            float(np.median(self.distance[which])),
            float(np.median(self.angle[which])),
            float(np.quantile(self.distance[which], 0.9)),
            float(np.quantile(self.angle[which], 0.9)),
            float(np.median(off)),
        )
