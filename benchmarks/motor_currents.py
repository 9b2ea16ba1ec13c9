"""What turning costs a motor against driving straight: measured currents and simulated torques side by side.

*Steady*: both sides hold their speeds for a second, forward. *Straight* and *turning*: by the difference of the sides.
In a turn the *outer* side pushes and the *inner* one is dragged along. Currents in the logs have no sign and read zero
where a motor brakes, so simulated torques below zero count as zero, too. Torque per ampere is not published and cancels
in ratios; without poses nothing else can be compared.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from twin.errors import InputError
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.sysid.drivetrain import AHEAD, STEP
from twin.sysid.logs import PERIOD, SAMPLES, _read_npz
from twin.sysid.rollout import BEFORE, COARSE, drive
from twin.types import Array

COLUMNS = ("time", "curL", "curR", "velL", "velR")
"""[s], [A], [A], [m/s], [m/s] of the wheels' circumference."""

_HALF_WINDOW = 0.5  # [s]
_SAME = 0.06  # [m/s] over which a steady side may vary; the encoders resolve 0.016
_SLOWEST = 0.1  # [m/s]
_STRAIGHT, _TURNING = 0.04, 0.08  # [m/s] difference of the sides below, above which
_FEWEST = 30  # samples of either kind
_MOST = 150  # turning samples simulated


@dataclass(frozen=True)
class Effort:
    """Mean current or torque of a side against that of one driving straight."""

    outer: float
    inner: float

    @property
    def total(self) -> float:
        """Of both sides together."""
        return (self.outer + self.inner) / 2


@dataclass(frozen=True)
class Steady:
    """Steady samples of logs."""

    speeds: Array
    """Left and right [m/s], shape (n, 2)."""
    currents: Array
    """Left and right [A], shape (n, 2)."""

    @property
    def straight(self) -> NDArray[np.bool_]:
        return np.abs(self.speeds[:, 1] - self.speeds[:, 0]) < _STRAIGHT

    @property
    def turning(self) -> NDArray[np.bool_]:
        return np.abs(self.speeds[:, 1] - self.speeds[:, 0]) > _TURNING


def read_currents(paths: list[Path]) -> Steady:
    """Steady samples of .npz logs with `COLUMNS`. Raises InputError: columns missing, too little of either kind."""
    speeds, currents = [], []
    for path in paths:
        columns = _read_npz(path)
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
            whole = time[i] - time[0] >= _HALF_WINDOW and time[-1] - time[i] >= _HALF_WINDOW
            if whole and np.ptp(near, axis=0).max() <= _SAME and near.min() > _SLOWEST:
                speeds.append(near.mean(0))
                currents.append(current[i])
    steady = Steady(np.array(speeds).reshape(-1, 2), np.array(currents).reshape(-1, 2))
    for kind, count in (("straight", steady.straight.sum()), ("turning", steady.turning.sum())):
        if count < _FEWEST:
            raise InputError(f"{int(count)} samples of steady {kind} driving; expected {_FEWEST}; give longer logs")
    return steady


def measured_effort(steady: Steady) -> Effort:
    """Of currents."""
    return _effort(steady.speeds[steady.turning], steady.currents[steady.turning], steady.currents[steady.straight])


def simulated_effort(steady: Steady, params: HuskyParams) -> Effort:
    """Of torques at the same wheel speeds on a plane."""
    turning = steady.speeds[steady.turning]
    turning = turning[:: max(1, len(turning) // _MOST)]
    straight = steady.speeds[steady.straight]
    straight = straight[:: max(1, len(straight) // 20)]
    both = np.concatenate([turning, straight]) / WHEEL_RADIUS
    steps = round((SAMPLES + AHEAD) * PERIOD / STEP)
    told, before = (np.repeat(both[:, None], count, 1) for count in (steps, BEFORE + 2))
    out = drive(replace(params, servo_lag=0.0), told, before, np.zeros((len(both), 2)), COARSE)
    torque = np.maximum(out.torques[:, SAMPLES // 2 :].mean(1), 0.0)
    return _effort(turning, torque[: len(turning)], torque[len(turning) :])


def rolling_resistance_of(steady: Steady, params: HuskyParams) -> float:
    """The rolling resistance, losses of gear and belt included, with which turning costs what it does in the logs.

    Raises:
        InputError: none between 0.002 and 0.4 does.
    """
    wanted = measured_effort(steady).total

    def miss(log: float) -> float:
        return simulated_effort(steady, replace(params, rolling_resistance=float(np.exp(log)))).total - wanted

    low, high = np.log(0.002), np.log(0.4)
    at_low, at_high = miss(low), miss(high)
    if at_low * at_high > 0:
        raise InputError(
            f"turning takes {wanted:.2f} times the current of driving straight; expected {at_high:.2f} to {at_low:.2f} "
            f"with friction {params.friction:g}; give the friction of that ground"
        )
    return float(np.exp(brentq(miss, low, high, xtol=0.02)))


def _effort(speeds: Array, turning: Array, straight: Array) -> Effort:
    right_is_outer = speeds[:, 1] > speeds[:, 0]
    outer = np.where(right_is_outer, turning[:, 1], turning[:, 0]).mean()
    inner = np.where(right_is_outer, turning[:, 0], turning[:, 1]).mean()
    return Effort(float(outer / straight.mean()), float(inner / straight.mean()))
