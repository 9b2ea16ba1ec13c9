"""Motor effort of turning relative to driving straight: measured currents against simulated torques.

*Steady*: both sides drive forward at constant speed for 1 s. *Straight* and *turning* samples have a small and a
large speed difference of the sides. In a turn the *outer* side drives and the *inner* side is dragged. Currents in the
logs are unsigned and zero while a motor brakes, so negative simulated torques count as zero. Torque per ampere is not
published but cancels in the ratios. The logs have no poses, so nothing else can be compared.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from twin.errors import InputError
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.sysid.drivetrain import CONTROL_STEP, EXTRA_SAMPLES
from twin.sysid.log_files import read_npz
from twin.sysid.logs import PERIOD, SAMPLES
from twin.sysid.rollout import COARSE_TIMESTEP, LEAD_SAMPLES, simulate_windows
from twin.types import Array

COLUMNS = ("time", "curL", "curR", "velL", "velR")
"""Units [s], [A], [A], [m/s], [m/s]; speeds are those of the wheel circumference."""

_HALF_WINDOW = 0.5  # [s]
_MAX_VARIATION = 0.06  # [m/s] speed range of a steady side; the encoders resolve 0.016
_MIN_SPEED = 0.1  # [m/s]
_MAX_STRAIGHT, _MIN_TURNING = 0.04, 0.08  # [m/s] largest and smallest speed difference of the sides
_MIN_SAMPLES = 30  # steady samples of each kind
_MAX_SIMULATED = 150  # turning samples simulated; at most twice this number


@dataclass(frozen=True)
class Effort:
    """Mean current or torque of a side in turns, relative to the mean when driving straight."""

    outer: float
    inner: float

    @property
    def total(self) -> float:
        """Mean of both sides."""
        return (self.outer + self.inner) / 2


@dataclass(frozen=True)
class SteadySamples:
    """Samples of steady driving."""

    speeds: Array
    """Left and right [m/s], shape (n, 2)."""
    currents: Array
    """Left and right [A], shape (n, 2)."""

    @property
    def straight(self) -> NDArray[np.bool_]:
        return np.abs(self.speeds[:, 1] - self.speeds[:, 0]) < _MAX_STRAIGHT

    @property
    def turning(self) -> NDArray[np.bool_]:
        return np.abs(self.speeds[:, 1] - self.speeds[:, 0]) > _MIN_TURNING


def read_currents(paths: list[Path]) -> SteadySamples:
    """Steady samples of .npz logs with `COLUMNS`. Raises InputError: columns are missing, or samples are too few."""
    speeds, currents = [], []
    for path in paths:
        columns = read_npz(path)
        missing = [name for name in COLUMNS if name not in columns]
        if missing:
            raise InputError(f"{path}: no column {', '.join(missing)}; expected {', '.join(COLUMNS)}")
        time = columns["time"]
        speed = np.stack([columns["velL"], columns["velR"]], -1)
        current = np.stack([columns["curL"], columns["curR"]], -1)
        first = np.searchsorted(time, time - _HALF_WINDOW)
        last = np.searchsorted(time, time + _HALF_WINDOW, side="right")
        for i, (a, b) in enumerate(zip(first, last, strict=True)):
            near = speed[a:b]
            complete = time[i] - time[0] >= _HALF_WINDOW and time[-1] - time[i] >= _HALF_WINDOW
            if complete and np.ptp(near, axis=0).max() <= _MAX_VARIATION and near.min() > _MIN_SPEED:
                speeds.append(near.mean(0))
                currents.append(current[i])
    steady = SteadySamples(np.array(speeds).reshape(-1, 2), np.array(currents).reshape(-1, 2))
    for kind, count in (("straight", steady.straight.sum()), ("turning", steady.turning.sum())):
        if count < _MIN_SAMPLES:
            raise InputError(
                f"{int(count)} samples of steady {kind} driving; expected {_MIN_SAMPLES}; give longer logs"
            )
    return steady


def measured_effort(steady: SteadySamples) -> Effort:
    """Effort from measured currents."""
    return _effort(steady.speeds[steady.turning], steady.currents[steady.turning], steady.currents[steady.straight])


def simulated_effort(steady: SteadySamples, params: HuskyParams) -> Effort:
    """Effort from simulated torques at the same wheel speeds on a plane."""
    turning = steady.speeds[steady.turning]
    turning = turning[:: max(1, len(turning) // _MAX_SIMULATED)]
    straight = steady.speeds[steady.straight]
    straight = straight[:: max(1, len(straight) // 20)]
    both = np.concatenate([turning, straight]) / WHEEL_RADIUS
    steps = round((SAMPLES + EXTRA_SAMPLES) * PERIOD / CONTROL_STEP)
    commands, preceding = (np.repeat(both[:, None], count, 1) for count in (steps, LEAD_SAMPLES + 2))
    out = simulate_windows(
        replace(params, servo_lag=0.0), commands, preceding, np.zeros((len(both), 2)), COARSE_TIMESTEP
    )
    torque = np.maximum(out.torques[:, SAMPLES // 2 :].mean(1), 0.0)
    return _effort(turning, torque[: len(turning)], torque[len(turning) :])


def rolling_resistance_of(steady: SteadySamples, params: HuskyParams) -> float:
    """Rolling resistance, including gear and belt losses, at which the simulated effort equals the measured one.

    Raises:
        InputError: there is no such value between 0.002 and 0.4.
    """
    target = measured_effort(steady).total

    def residual(log: float) -> float:
        return simulated_effort(steady, replace(params, rolling_resistance=float(np.exp(log)))).total - target

    low, high = np.log(0.002), np.log(0.4)
    at_low, at_high = residual(low), residual(high)
    if at_low * at_high > 0:
        raise InputError(
            f"turning takes {target:.2f} times the current of driving straight; expected {at_high:.2f} to {at_low:.2f} "
            f"with friction {params.friction:g}; give the friction of that ground"
        )
    return float(np.exp(brentq(residual, low, high, xtol=0.02)))


def _effort(speeds: Array, turning: Array, straight: Array) -> Effort:
    right_is_outer = speeds[:, 1] > speeds[:, 0]
    outer = np.where(right_is_outer, turning[:, 1], turning[:, 0]).mean()
    inner = np.where(right_is_outer, turning[:, 0], turning[:, 1]).mean()
    return Effort(float(outer / straight.mean()), float(inner / straight.mean()))
