"""Kinematic models of skid steering, which are baselines for the fitted MuJoCo model, and the scores of predictions.

*Nominal*: a differential drive whose wheels roll without slip. *ICR model* (Mandow et al. 2007): each side's tread has
an instantaneous center of rotation at its own lateral offset. Its five parameters are these offsets, a slip factor per
side and a common forward offset; they are fitted with the same robust loss as the MuJoCo model.
"""

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.geometry.poses import wrap_angle
from twin.robot import TRACK, WHEEL_RADIUS
from twin.sysid.estimation import Kinds, fit_with_scales, robust_loss
from twin.sysid.logs import MAX_POSE_AGE, PERIOD, SAMPLES, Windows, resample_poses
from twin.types import Array

POSE_KINDS: Kinds = (0, 0, 1)
"""Kinds of the residuals of x, y [m] and yaw [rad]."""
EVALUATED_SAMPLES = (SAMPLES // 2, SAMPLES)
"""Samples of a window at which predicted and measured poses are compared."""

_MIN_DIFFERENCE = 0.25  # [m/s] between the sides; with a smaller difference the track ratio is noise


@dataclass(frozen=True)
class IcrModel:
    """The ICR model: slip factors (speed of a side's tread over the ground / circumferential speed of its wheels), and
    the centers' offsets [m]. The defaults are nominal kinematics.
    """

    slip_left: float = 1.0
    slip_right: float = 1.0
    y_left: float = TRACK / 2
    y_right: float = -TRACK / 2
    x: float = 0.0

    def motion(self, wheels: Array) -> Array:
        """vx, vy [m/s], yaw rate [rad/s], shape (..., 3), for wheel speeds [rad/s], shape (..., 2)."""
        left = self.slip_left * WHEEL_RADIUS * wheels[..., 0]
        right = self.slip_right * WHEEL_RADIUS * wheels[..., 1]
        rate = (right - left) / (self.y_left - self.y_right)
        forward = (right * self.y_left - left * self.y_right) / (self.y_left - self.y_right)
        return np.stack([forward, -self.x * rate, rate], -1)


NOMINAL = IcrModel()


def integrate(motion: Array) -> Array:
    """Poses x, y [m], yaw [rad] from zero, shape (n, k + 1, 3), for velocities (n, k, 3), each for `PERIOD` [s]."""
    turned = motion[..., 2] * PERIOD
    yaw = np.concatenate([np.zeros((len(motion), 1)), np.cumsum(turned, 1)], 1)
    middle = yaw[:, :-1] + turned / 2
    cos, sin = np.cos(middle), np.sin(middle)
    x = np.cumsum((motion[..., 0] * cos - motion[..., 1] * sin) * PERIOD, 1)
    y = np.cumsum((motion[..., 0] * sin + motion[..., 1] * cos) * PERIOD, 1)
    start = np.zeros((len(motion), 1))
    return np.stack([np.concatenate([start, x], 1), np.concatenate([start, y], 1), yaw], -1)


def predict(model: IcrModel, windows: Windows) -> Array:
    """Poses integrated from the measured wheel speeds, shape (n, k + MAX_POSE_AGE + 1, 3).

    They begin when the window's first pose was measured. After a window's end, its last wheel speeds continue.
    """
    before = windows.preceding_wheels[:, -1 - MAX_POSE_AGE : -1]
    after = np.repeat(windows.wheels[:, -1:], MAX_POSE_AGE, 1)
    poses = integrate(model.motion(np.concatenate([before, windows.wheels, after], 1)))
    return resample_poses(poses, -windows.measurement_times[:, 0], MAX_POSE_AGE)


def fit_icr(windows: Windows) -> IcrModel:
    """Fits the ICR model to the windows for fitting."""
    start = np.array([1.0, 1.0, 0.5, -0.5, 0.0])
    fitting = windows.fitting

    def pose_residuals(x: Array) -> Array:
        return residuals(predict(IcrModel(*x), windows), windows)[fitting]

    def solve(x: Array, scale: Array) -> Array:
        return least_squares(lambda x: robust_loss(pose_residuals(x) / scale).ravel(), x, x_scale=0.1).x

    return IcrModel(*fit_with_scales(start, pose_residuals, POSE_KINDS, solve).tolist())


def interpolate_poses(poses: Array, time: Array) -> Array:
    """Interpolates poses (n, m, 3), which are `PERIOD` [s] apart, at one time [s] per window (n,); returns (n, 3)."""
    position = np.clip(time / PERIOD, 0, poses.shape[1] - 1 - 1e-9)
    before = position.astype(int)
    share = (position - before)[:, None]
    row = np.arange(len(poses))
    return poses[row, before] * (1 - share) + poses[row, before + 1] * share


def residuals(predicted: Array, windows: Windows) -> Array:
    """Predicted minus measured x, y [m] and yaw [rad] at `EVALUATED_SAMPLES`, shape (n, instants, 3)."""
    elapsed = windows.elapsed
    error = np.stack([interpolate_poses(predicted, elapsed[:, i]) - windows.poses[:, i] for i in EVALUATED_SAMPLES], 1)
    error[..., 2] = wrap_angle(error[..., 2])
    return error


def track_ratios(windows: Windows, ends: Array) -> Array:
    """Track ratio chi (effective / geometric track) of each window, shape (n,), from the poses at its end (n, 3)."""
    difference = (windows.wheels[..., 1] - windows.wheels[..., 0]).mean(1) * WHEEL_RADIUS
    turned = np.where(np.abs(ends[:, 2]) < 1e-6, np.nan, ends[:, 2])
    return difference * windows.elapsed[:, -1] / (TRACK * turned)


def steady_windows(windows: Windows) -> NDArray[np.bool_]:
    """Mask (n,) of windows in which the sides' wheels turn at constant, different speeds; only these determine chi."""
    sides = windows.wheels * WHEEL_RADIUS
    thirds = np.stack([part.mean(1) for part in np.array_split(sides, 3, axis=1)])
    constant = np.ptp(thirds, axis=0).max(1) < 0.08
    return constant & (np.abs((sides[..., 1] - sides[..., 0]).mean(1)) > _MIN_DIFFERENCE)


# ---- scores of predictions


@dataclass(frozen=True)
class Score:
    """Median and 90th percentile of errors at the ends of several windows, and median error of wheel speeds."""

    windows: int
    position_m: float
    yaw_deg: float
    position_m_p90: float
    yaw_deg_p90: float
    wheels_rad_s: float

    def rounded(self) -> dict[str, float]:
        """All numbers, rounded for JSON."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


class Prediction:
    """A model's prediction of every window of a log."""

    def __init__(self, name: str, windows: Windows, poses: Array, wheels: Array | None = None) -> None:
        """
        Args:
            poses: `PERIOD` [s] apart, beginning when the window's first pose was measured,
                shape (n, k + MAX_POSE_AGE + 1, 3).
            wheels: Shape (n, ≥ k, 2) [rad/s]; None: the measured ones, which the model has as input.
        """
        self.name, self.windows, self.poses = name, windows, poses
        self.wheels = windows.wheels if wheels is None else wheels[:, : windows.wheels.shape[1]]

    @cached_property
    def ends(self) -> Array:
        """Poses at the times of the windows' last poses, shape (n, 3)."""
        return interpolate_poses(self.poses, self.windows.elapsed[:, -1])

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """Position errors [m] and yaw errors [°] at the end of each window, shapes (n,)."""
        error = self.ends - self.windows.poses[:, -1]
        return np.hypot(error[:, 0], error[:, 1]), np.abs(np.degrees(wrap_angle(error[:, 2])))

    def score(self, which: NDArray[np.bool_]) -> Score:
        """The score over some of the windows, a mask (n,)."""
        distance, angle = (error[which] for error in self.errors)
        off = np.abs(self.wheels - self.windows.wheels)[which]
        return Score(
            int(which.sum()),
            float(np.median(distance)),
            float(np.median(angle)),
            float(np.quantile(distance, 0.9)),
            float(np.quantile(angle, 0.9)),
            float(np.median(off)),
        )
