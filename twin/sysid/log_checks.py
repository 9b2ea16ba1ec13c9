"""Plausibility checks of a log: units, turns, length. Each error is one line with value, expectation and cure."""

import numpy as np

from twin.errors import InputError
from twin.robot import TRACK, WHEEL_RADIUS
from twin.sysid.drivetrain import commanded_speeds
from twin.sysid.logs import DURATION, Windows
from twin.types import Array

MIN_WINDOWS = 20  # to fit to; half as many to score on
MIN_TURNS = 10  # windows that turn by more than TURN, at least a quarter of them to either side
TURN = 0.25  # [rad]

_MOVING = 0.15  # [m/s] of wheels or robot: slower windows are not used to check units
_DEGREE = np.pi / 180


def check(windows: Windows, where: str) -> None:
    """Checks that a log is long enough, turns enough and has plausible units. Raises InputError: it is not."""
    driving = windows.fresh[windows.turning].sum(1)
    if len(driving) and np.median(driving) < 2:
        raise InputError(
            f"{where}: {np.median(driving):g} new poses in {DURATION:.0f} s of driving (median); expected at least 2; "
            "record them at 1 Hz or more, better at 10 Hz"
        )
    fitting, scoring = int(windows.fitting.sum()), int((~windows.fitting).sum())
    if fitting < MIN_WINDOWS or scoring < MIN_WINDOWS // 2:
        raise InputError(
            f"{where}: {fitting} windows of {DURATION:.0f} s to fit to and {scoring} to score on; expected at least "
            f"{MIN_WINDOWS} and {MIN_WINDOWS // 2}; drive for {1.5 * MIN_WINDOWS * DURATION / 60:.0f} min or more"
        )
    _check_units(windows, where)
    turned = windows.poses[windows.fitting, -1, 2]
    left, right = int((turned > TURN).sum()), int((turned < -TURN).sum())
    if left + right < MIN_TURNS or min(left, right) < MIN_TURNS / 4:
        raise InputError(
            f"{where}: {left} windows turn left and {right} right by more than {TURN} rad; expected {MIN_TURNS}, a "
            "quarter of them at least to either side; drive more turns"
        )


def _check_units(windows: Windows, where: str) -> None:
    mean, half = _speeds(windows.wheels)
    distance = np.hypot(windows.poses[:, -1, 0], windows.poses[:, -1, 1]) / DURATION
    straight = (np.maximum(np.abs(mean), distance) > _MOVING) & (np.abs(half) < 0.3 * np.abs(mean))
    _check_ratio(
        _median(distance[straight] / np.abs(mean[straight])),
        (0.3, 2.0),
        where,
        "the robot moves {:.3g} m for each metre its wheels roll",
        {
            _DEGREE: "wheel speeds look like °/s; multiply them by π/180",
            1 / WHEEL_RADIUS: "wheel speeds look like m/s; divide them by the wheel's radius",
            1000.0: "poses look like millimetres; divide them by 1000",
        },
    )
    rate = np.abs(windows.poses[:, -1, 2]) / DURATION
    turning = np.maximum(np.abs(half), rate * TRACK / 2) > _MOVING
    _check_ratio(
        _median(rate[turning] * TRACK / 2 / np.abs(half[turning])),
        (0.1, 1.3),
        where,
        "the robot turns {:.3g} times as fast as its wheels would have it without slip",
        {
            1 / _DEGREE: "yaw looks like degrees; multiply it by π/180",
            _DEGREE: "yaw looks π/180 times too small; divide it by π/180",
        },
    )
    commanded = commanded_speeds(windows)[:, -1] * WHEEL_RADIUS
    end = windows.wheels[:, -1] * WHEEL_RADIUS
    measured = np.stack([end.mean(1), (end[:, 1] - end[:, 0]) / 2], -1)
    names = ("cmd_v", "cmd_yaw_rate") if windows.twist else ("the mean of the wheel commands", "their difference")
    for i, name in enumerate(names):
        use = (np.abs(measured[:, i]) > 0.5 * _MOVING) & (np.abs(commanded[:, i]) > 0)
        _check_ratio(
            _median(np.abs(measured[use, i] / commanded[use, i])),
            (0.1, 6.0),
            where,
            f"wheels do {{:.3g}} times what {name} asks for",
            {_DEGREE: f"{name} looks like degrees; multiply by π/180", 1 / _DEGREE: f"{name} looks π/180 too small"},
        )


def _check_ratio(
    ratio: float | None, expected: tuple[float, float], where: str, message: str, cures: dict[float, str]
) -> None:
    """Raises InputError if a ratio is out of range, with the cure whose factor is nearest to it."""
    low, high = expected
    if ratio is None or low <= ratio <= high:
        return
    nearest = min(cures, key=lambda factor: abs(np.log(max(ratio, 1e-9) / factor)))
    close = abs(np.log(max(ratio, 1e-9) / nearest)) < np.log(6)
    cure = cures[nearest] if close else "check the units of the columns"
    raise InputError(f"{where}: {message.format(ratio)}; expected {low:g} to {high:g}; {cure}")


def _speeds(wheels: Array) -> tuple[Array, Array]:
    """Mean and half the difference of the sides' circumference speeds over each window [m/s], shapes (n,)."""
    sides = wheels.mean(1) * WHEEL_RADIUS
    return sides.mean(1), (sides[:, 1] - sides[:, 0]) / 2


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) >= 3 else None
