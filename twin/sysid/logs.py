"""Drive logs: commands, wheel speeds and poses of a robot, cut into windows of two seconds, and plausibility checks.

A *window* contains evenly spaced samples of commands, wheel speeds, poses relative to the first one and, with an IMU,
accelerations. Windows of one *group* belong to one experiment; even groups are for fitting, odd ones for scoring. A
window *follows* the previous one if it begins when that one ends. A pose is *fresh* if it differs from the one before.

`twin.sysid.log_files` reads

- bags, which it converts to the columns of a table;
- a table (.csv, or .npz of equally long columns) with one row per instant: `time` [s]; commands, either `cmd_v` [m/s]
  and `cmd_yaw_rate` [rad/s], or `cmd_left` and `cmd_right` [rad/s at the wheels]; `left_wheel_vel`, `right_wheel_vel`
  [rad/s]; `x`, `y` [m], `yaw` [rad, counterclockwise from x] of the base in any fixed frame with z up; optionally
  `acceleration_x`, `acceleration_y` [m/s²], proper acceleration in the base (x forward, y left; an IMU's raw reading),
  and `group`;
- windows as published with DRIVE (Samson et al., BSD-3): an .npz of arrays (n, 40) at 20 Hz.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from twin import runtime
from twin.errors import InputError
from twin.robot import TRACK, WHEEL_RADIUS
from twin.types import Array

PERIOD = 0.05  # [s] between two samples of a window
DURATION = 2.0  # [s]
SAMPLES = round(DURATION / PERIOD)
MAX_POSE_AGE = 20  # [samples] largest age of a window's first pose at the window's start

TWIST = ("cmd_v", "cmd_yaw_rate")
WHEEL_COMMANDS = ("cmd_left", "cmd_right")
WHEEL_SPEEDS = ("left_wheel_vel", "right_wheel_vel")
POSE = ("x", "y", "yaw")
ACCELERATION = ("acceleration_x", "acceleration_y")

_MAX_GAP = 0.5  # [s] largest gap between two rows of a table; windows with a longer gap are left out
_MIN_INTERVAL = 5e-4  # [s] least median interval between rows; a shorter one means that time is not in seconds
_FAST = 1.75  # [samples] if the pose sensor's period is shorter, poses count as measured when they appear
# [samples] A window contradicts the period if a pose appears further than this from its estimated measurement time; the
# delay that all poses share is not counted.
_JITTER = 4
_UNSTEADY = 0.1  # if a larger fraction of windows contradicts the period, the sensor counts as aperiodic
_DROPOUT = 30  # [samples] a window is left out if the wheels turn and no pose is fresh for longer than this
_TURNING = 0.5  # [rad/s] mean of both sides' wheel speeds above which the wheels count as turning
_STANDING = 0.05  # [rad/s], [m/s] a window is left out if all its wheel speeds and commands are below this
_TICK = 1e-6  # [s] instants closer than this are the same
_GROUP_WINDOWS = 3  # windows per group in a table without groups: six seconds
_CONTINUES = 1.0  # [rad/s] largest change of wheel speeds between consecutive windows, summed over both sides

# ---- measurement times of poses


def measurement_times(fresh: NDArray[np.bool_]) -> Array:
    """Estimates when each pose of a log's windows was measured, from the samples at which poses changed.

    A pose sensor measures at a steady rate, but its poses reach the log with varying delay: between fresh poses that
    appear 0.05 s apart, a robot moves as far as between those that appear 0.15 s apart. (In turning windows of DRIVE's
    log, yaw is smooth to 0.3° as a function of the number of the fresh pose, but only to 0.7° as a function of the
    time at which the pose appears.) So the n-th fresh pose counts as measured n periods after the first. Lost poses are
    counted, too: if a pose and all later ones are late by more than half a period, poses before it were lost.

    Times of appearance are used instead for windows that contradict the period by more than `_JITTER`, and for the
    whole log if many windows do so or if the sensor is fast.

    Args:
        fresh: Mask of the poses, without the first, that differ from the one before, shape (n, k).

    Returns:
        Times [samples], shape (n, k + 1); a window starts at 0.
    """
    appeared = [np.flatnonzero(row).astype(np.float64) + 1 for row in fresh]
    slopes = [theilslopes(each).slope for each in appeared if len(each) > 1]
    period = float(np.median(slopes)) if slopes else 1.0
    times = [_steady(each, period) for each in appeared]
    both = zip(times, appeared, strict=True)
    stray = np.array([np.abs(time[1:] - each).max(initial=0.0) > _JITTER for time, each in both], bool)
    if period < _FAST or stray.sum() > _UNSTEADY * len(stray):
        stray[:] = True
    out = np.zeros((len(fresh), fresh.shape[1] + 1))
    for i, each in enumerate(appeared):
        if len(each):
            time = _as_appeared(each, period) if stray[i] else times[i]
            out[i] = time[np.append(0, np.cumsum(fresh[i]))]
    return out


def _steady(appeared: Array, period: float) -> Array:
    """Measurement times of a window's first and fresh poses, for a sensor of this period [samples].

    `appeared` are the samples at which fresh poses appeared.
    """
    if not len(appeared):
        return np.zeros(1)
    number = np.arange(1.0, len(appeared) + 1)
    lost = np.maximum(0.0, np.ceil((appeared - appeared[0]) / period - number + 0.5))
    number += np.minimum.accumulate(lost[::-1])[::-1]  # if a later pose is on time again, none was lost
    start = float(np.median(appeared - period * number))
    if start > period / 2:  # the robot rested, or the first poses were lost
        first = start - period * np.ceil(start / period)
    else:  # the window begins with a fresh pose
        first = start = min(start, 0.0)
    first = max(first, -MAX_POSE_AGE)
    return np.append(first, np.maximum(first, start + period * number))


def _as_appeared(appeared: Array, period: float) -> Array:
    """Measurement times as in `_steady`, taken from the times of appearance; `period` is used if only one pose is
    fresh.
    """
    apart = float(np.median(np.diff(appeared))) if len(appeared) > 1 else period
    return np.append(max(min(float(appeared[0]) - apart, 0.0), -MAX_POSE_AGE), appeared)


# ---- windows


@dataclass(frozen=True)
class Windows:
    """n windows of k samples, `PERIOD` [s] apart."""

    commands: Array
    """v [m/s] and ω [rad/s] if `twist`, else wheel speeds left and right [rad/s]; shape (n, k, 2)."""
    twist: bool
    wheels: Array
    """Measured wheel speeds, left and right [rad/s], shape (n, k, 2)."""
    poses: Array
    """x, y [m], yaw [rad] relative to the first, shape (n, k + 1, 3)."""
    groups: NDArray[np.int64]
    """Group of each window, shape (n,)."""
    follows: NDArray[np.bool_]
    """True for windows that follow the previous one, shape (n,)."""
    acceleration: Array | None = None
    """Proper acceleration forward and to the left [m/s²], shape (n, k, 2)."""

    def __len__(self) -> int:
        return len(self.wheels)

    @property
    def fitting(self) -> NDArray[np.bool_]:
        """Windows to fit to, shape (n,); the others are for scoring."""
        return self.groups % 2 == 0

    @property
    def preceding_wheels(self) -> Array:
        """Wheel speeds in the `DURATION` before each window and at its start [rad/s], shape (n, k + 1, 2).

        If the window follows the previous one, they are the previous window's; otherwise the speed at the start is
        repeated.
        """
        out = np.repeat(self.wheels[:, :1], self.wheels.shape[1] + 1, 1)
        follows = np.flatnonzero(self.follows)
        out[follows, :-1] = self.wheels[follows - 1]
        return out

    @property
    def commanded_speeds(self) -> Array:
        """Commanded mean of the sides' wheel speeds and half their difference [rad/s], shape (n, k, 2)."""
        a, b = self.commands[..., 0], self.commands[..., 1]
        if self.twist:
            return np.stack([a, b * TRACK / 2], -1) / WHEEL_RADIUS
        return np.stack([a + b, b - a], -1) / 2

    def select(self, which: NDArray) -> "Windows":
        """Some of the windows, by mask or index; none of them counts as following another."""
        some: dict[str, Any] = {name: getattr(self, name)[which] for name in ("commands", "wheels", "poses", "groups")}
        acceleration = None if self.acceleration is None else self.acceleration[which]
        return replace(self, **some, follows=np.zeros(len(some["wheels"]), bool), acceleration=acceleration)

    @property
    def fresh(self) -> NDArray[np.bool_]:
        """Mask of the fresh poses, without the first pose, shape (n, k)."""
        return np.abs(np.diff(self.poses, axis=1)).max(2) > 1e-6

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Windows in which the wheels turn, shape (n,)."""
        return np.abs(self.wheels).mean((1, 2)) > _TURNING

    @cached_property
    def measurement_times(self) -> Array:
        """Measurement time of each pose [s since the first sample], except for a common delay, shape (n, k + 1)."""
        return measurement_times(self.fresh) * PERIOD

    @property
    def elapsed(self) -> Array:
        """Time since the measurement of the first pose [s], shape (n, k + 1)."""
        return self.measurement_times - self.measurement_times[:, :1]


def cut_windows(columns: dict[str, Array], where: str) -> Windows:
    """Cuts a table into windows; a sample has the values of the last row that is not later than the sample.

    Args:
        columns: Columns by name, shape (rows,) each; see the module's head.
        where: The log's name in errors.

    Raises:
        InputError: a column is missing or not finite, or time does not increase or is not in seconds.
    """
    twist = all(name in columns for name in TWIST)
    commands = TWIST if twist else WHEEL_COMMANDS
    needed = ("time", *commands, *WHEEL_SPEEDS, *POSE)
    _need(columns, needed, where)
    accelerations = ACCELERATION if all(name in columns for name in ACCELERATION) else ()
    groups = ("group",) if "group" in columns else ()
    data = {name: columns[name] for name in (*needed, *accelerations, *groups)}
    if any(column.shape != data["time"].shape or column.ndim != 1 for column in data.values()):
        shapes = ", ".join(f"{name} {column.shape}" for name, column in data.items())
        raise InputError(f"{where}: columns of different lengths ({shapes}); expected one value per row in each")
    _finite(data, where)
    time = data["time"]
    backward = np.flatnonzero(np.diff(time) <= 0)
    if len(backward):
        i = int(backward[0])
        raise InputError(
            f"{where}: time goes from {time[i]:.3f} to {time[i + 1]:.3f} s at row {i + 2}; expected it to increase; "
            "sort the rows and drop those that repeat a time"
        )
    order = _gapless(time, where)
    begin = time[0] if len(time) else 0.0
    instants = begin + DURATION * order[:, None] + PERIOD * np.arange(SAMPLES + 1)
    rows = np.maximum(np.searchsorted(time, instants.ravel() + _TICK, side="right") - 1, 0).reshape(instants.shape)
    pose = np.stack([data[name] for name in POSE], -1)
    pose[:, 2] = np.unwrap(pose[:, 2])
    group = data["group"][rows[:, 0]].astype(int) if groups else order // _GROUP_WINDOWS

    def sampled(names: tuple[str, ...]) -> Array:
        return np.stack([data[name][rows[:, :-1]] for name in names], -1)

    windows = Windows(
        sampled(commands),
        twist,
        sampled(WHEEL_SPEEDS),
        relative_poses(pose[rows]),
        np.asarray(group, np.int64),
        np.diff(order, prepend=-2) == 1,
        sampled(accelerations) if accelerations else None,
    )
    return _informative(windows, where)


def _informative(windows: Windows, where: str) -> Windows:
    """Leaves out windows that lose poses while the wheels turn, and windows in which wheels and commands are at rest.

    Raises InputError: poses are lost in more than half of the windows in which the wheels turn.
    """
    edge = np.ones((len(windows), 1), bool)
    appeared = np.concatenate([edge, windows.fresh, edge], 1)
    lost_poses = np.array([np.diff(np.flatnonzero(row)).max() > _DROPOUT for row in appeared], bool)
    turning = windows.turning
    lost = int((lost_poses & turning).sum())
    if lost > turning.sum() / 2:
        raise InputError(
            f"{where}: no new pose for {_DROPOUT * PERIOD:g} s in {lost} of {turning.sum()} windows in which the "
            "wheels turn; expected at least one a second; record poses at 1 Hz or more, better at 10 Hz"
        )
    if lost:
        runtime.log_line(f"{lost} windows left out: no new poses while the wheels turn")
    standing = np.maximum(np.abs(windows.wheels), np.abs(windows.commands)).max((1, 2), initial=0.0) < _STANDING
    if standing.any():
        runtime.log_line(f"{standing.sum()} windows left out: the robot stands still")
    keep = ~(lost_poses & turning) & ~standing
    before = np.concatenate([[False], keep[:-1]])
    return replace(windows.select(keep), follows=(windows.follows & before)[keep])


def _gapless(time: Array, where: str) -> NDArray[np.int64]:
    """Indices of the windows without a gap, shape (n,); window i begins i · `DURATION` [s] after the first row.

    Raises InputError: the median interval between rows is too long, or too short for times in seconds.
    """
    if len(time) < 2:
        return np.zeros(0, np.int64)
    steps = np.diff(time)
    interval = float(np.median(steps))
    if not _MIN_INTERVAL <= interval <= _MAX_GAP:
        units = {"ms": 3, "µs": 6, "ns": 9}
        fits = [(u, n) for u, n in units.items() if 4 * _MIN_INTERVAL <= interval / 10**n <= _MAX_GAP]
        cure = f"record at least {1 / _MAX_GAP:g} rows a second" if interval > _MAX_GAP else "give time in s"
        if fits:
            cure = f"time looks like {fits[0][0]}; divide it by 1e{fits[0][1]}"
        raise InputError(
            f"{where}: rows are {interval:.3g} s apart (median), expected {_MIN_INTERVAL:g} to {_MAX_GAP:g} s; {cure}"
        )
    after = np.flatnonzero(steps > _MAX_GAP) + 1  # rows at which a segment without gaps begins
    first, last = time[np.append(0, after)], time[np.append(after - 1, len(time) - 1)]
    low = np.ceil((first - time[0]) / DURATION - _TICK).astype(np.int64)
    high = np.floor((last - time[0]) / DURATION + _TICK).astype(np.int64)
    return np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)])


def published_windows(columns: dict[str, Array], where: str) -> Windows:
    """Windows of DRIVE: the pose at 2 s, `gt_icp_*`, is the 41st sample; x and y of the robot's IMU are negated.

    The data show that their sign is wrong: `imu_acceleration_x` falls when the wheels speed up, and
    `imu_acceleration_y` points out of the turn (correlations −0.16 and −0.11 over 16,000 samples). The yaw rate has the
    right sign.
    """
    poses, ends = ([f"{prefix}icp_{name}" for name in POSE] for prefix in ("", "gt_"))
    imu = ("imu_acceleration_x", "imu_acceleration_y")
    names = [*WHEEL_COMMANDS, *WHEEL_SPEEDS, *poses, *imu]
    _need(columns, ("calib_step", *names, *ends), where)
    shape = columns["icp_x"].shape
    for name in names:
        if columns[name].shape != shape or shape[1] != SAMPLES:
            raise InputError(f"{where}: {name} has shape {columns[name].shape}; expected (n, {SAMPLES}), 2 s at 20 Hz")
    for name in ("calib_step", *ends):
        if columns[name].shape != shape[:1]:
            raise InputError(f"{where}: {name} has shape {columns[name].shape}; expected {shape[:1]}, one per window")
    _finite({name: columns[name] for name in ("calib_step", *names, *ends)}, where)

    def stacked(names: Iterable[str]) -> Array:
        return np.stack([columns[name] for name in names], -1)

    pose = np.concatenate([stacked(poses), stacked(ends)[:, None]], 1)
    pose[..., 2] = np.unwrap(pose[..., 2], axis=1)
    wheels, step = stacked(WHEEL_SPEEDS), columns["calib_step"].astype(np.int64)
    jump, advance = np.abs(wheels[1:, 0] - wheels[:-1, -1]).sum(1), np.diff(step)
    follows = np.concatenate([[False], (jump < _CONTINUES) & (advance <= 1) & (advance >= 0)])
    commands, acceleration = stacked(WHEEL_COMMANDS), -stacked(imu)
    return _informative(Windows(commands, False, wheels, relative_poses(pose), step, follows, acceleration), where)


def resample_poses(poses: Array, late: Array, before: int) -> Array:
    """Interpolates predicted poses at times `PERIOD` [s] apart, starting when a window's first pose was measured.

    The result is relative to its first pose, shape (n, SAMPLES + MAX_POSE_AGE + 1, 3).

    Args:
        poses: `PERIOD` [s] apart, shape (n, m, 3); extrapolated linearly beyond the last one.
        late: Age of the first measured pose at time zero [s], shape (n,), at most `before` samples; negative if it is
            measured later.
        before: Index of the pose at time zero.
    """
    position = before - late[:, None] / PERIOD + np.arange(SAMPLES + MAX_POSE_AGE + 1)
    whole = np.clip(position.astype(int), 0, poses.shape[1] - 2)
    share = (position - whole)[..., None]
    row = np.arange(len(poses))[:, None]
    return relative_poses(poses[row, whole] * (1 - share) + poses[row, whole + 1] * share)


def relative_poses(poses: Array) -> Array:
    """Poses in the frame of the first: x, y [m], yaw [rad], shape (n, k, 3)."""
    turned = poses - poses[:, :1]
    cos, sin = np.cos(poses[:, :1, 2]), np.sin(poses[:, :1, 2])
    x, y = turned[..., 0], turned[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, turned[..., 2]], -1)


def _need(columns: dict[str, Array], names: tuple[str, ...], where: str) -> None:
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(
            f"{where}: no column {', '.join(missing)} among {', '.join(sorted(columns)) or 'none'}; "
            "name the columns as `twin align --help` says"
        )


def _finite(columns: dict[str, Array], where: str) -> None:
    for name, column in columns.items():
        bad = np.argwhere(~np.isfinite(column))
        if len(bad):
            row = ", ".join(str(int(i) + 1) for i in bad[0])
            found = f"{name} is {column[tuple(bad[0])]} at row {row} and in {len(bad)} places"
            raise InputError(f"{where}: {found}; expected numbers; cut those rows out")


# ---- plausibility

_MIN_WINDOWS = 20  # least number of windows to fit to; half as many to score on
_MIN_TURNS = 10  # least number of windows that turn by more than `_TURN`; a quarter as many to each side
_TURN = 0.25  # [rad]

_MOVING = 0.15  # [m/s] of wheels or robot: slower windows are not used to check units
_MAX_ACCELERATION = 3.0  # [m/s²] a larger median is due to gravity: an axis that should be level is not
_DEGREE = np.pi / 180
_MIN_SIGNED = 5  # least number of windows from which a sign is taken
_ALONG = 0.5  # least component along yaw of the motion in straight windows, as a fraction


def check_log(windows: Windows, where: str) -> None:
    """Raises InputError if a log is too short, turns too little, or has implausible units, signs or axes."""
    driving = windows.fresh[windows.turning].sum(1)
    if len(driving) and np.median(driving) < 2:
        raise InputError(
            f"{where}: {np.median(driving):g} new poses in {DURATION:.0f} s of driving (median); expected at least 2; "
            "record them at 1 Hz or more, better at 10 Hz"
        )
    fitting, scoring = int(windows.fitting.sum()), int((~windows.fitting).sum())
    if fitting < _MIN_WINDOWS or scoring < _MIN_WINDOWS // 2:
        raise InputError(
            f"{where}: {fitting} windows of {DURATION:.0f} s to fit to and {scoring} to score on; expected at least "
            f"{_MIN_WINDOWS} and {_MIN_WINDOWS // 2}; drive for {1.5 * _MIN_WINDOWS * DURATION / 60:.0f} min or more"
        )
    if windows.acceleration is not None:
        mean = np.abs(np.median(windows.acceleration, axis=(0, 1)))
        if mean.max() > _MAX_ACCELERATION:
            raise InputError(
                f"{where}: {ACCELERATION[int(mean.argmax())]} is {mean.max():.1f} m/s² (median); expected at most "
                f"{_MAX_ACCELERATION:g}: the IMU's x must point forward and y to the left; leave it out with --level"
            )
    for ratio, (low, high), message, cures in _unit_ratios(windows):
        if ratio < low or ratio > high:
            nearest = min(cures, key=lambda factor: abs(np.log(max(ratio, 1e-9) / factor)))
            close = abs(np.log(max(ratio, 1e-9) / nearest)) < np.log(6)
            cure = cures[nearest] if close else "check the units of the columns"
            raise InputError(f"{where}: {message.format(ratio)}; expected {low:g} to {high:g}; {cure}")
    _check_directions(windows, where)
    turned = windows.poses[windows.fitting, -1, 2]
    left, right = int((turned > _TURN).sum()), int((turned < -_TURN).sum())
    if left + right < _MIN_TURNS or min(left, right) < _MIN_TURNS / 4:
        raise InputError(
            f"{where}: {left} windows turn left and {right} right by more than {_TURN} rad; expected {_MIN_TURNS} or "
            "more, and at least a quarter of that to each side; drive more turns"
        )


def _unit_ratios(windows: Windows) -> Iterator[tuple[float, tuple[float, float], str, dict[float, str]]]:
    """Ratios that reveal wrong units: value, expected range, message, and a cure per factor that wrong units cause.

    A ratio is NaN if fewer than three windows are suitable.
    """
    sides = windows.wheels.mean(1) * WHEEL_RADIUS
    mean, half = sides.mean(1), (sides[:, 1] - sides[:, 0]) / 2  # [m/s]
    distance = np.hypot(windows.poses[:, -1, 0], windows.poses[:, -1, 1]) / DURATION
    straight = (np.maximum(np.abs(mean), distance) > _MOVING) & (np.abs(half) < 0.3 * np.abs(mean))
    cures = {
        _DEGREE: "wheel speeds look like °/s; multiply them by π/180",
        1 / WHEEL_RADIUS: "wheel speeds look like m/s; divide them by the wheel's radius",
        1000.0: "poses look like millimeters; divide them by 1000",
    }
    ratio = _median(distance[straight] / np.abs(mean[straight]))
    yield ratio, (0.3, 2.0), "the robot moves {:.3g} m for each meter its wheels roll", cures
    rate = np.abs(windows.poses[:, -1, 2]) / DURATION
    turning = np.maximum(np.abs(half), rate * TRACK / 2) > _MOVING
    cures = {
        1 / _DEGREE: "yaw looks like degrees; multiply it by π/180",
        _DEGREE: "yaw looks 180/π times too small; divide it by π/180",
    }
    ratio = _median(rate[turning] * TRACK / 2 / np.abs(half[turning]))
    yield ratio, (0.1, 1.3), "the robot turns {:.3g} times as fast as its wheels would have it without slip", cures
    commanded = windows.commanded_speeds[:, -1] * WHEEL_RADIUS
    end = windows.wheels[:, -1] * WHEEL_RADIUS
    measured = np.stack([end.mean(1), (end[:, 1] - end[:, 0]) / 2], -1)
    wheels = ("the mean of cmd_left and cmd_right", "the difference of cmd_left and cmd_right")
    for i, name in enumerate(TWIST if windows.twist else wheels):
        use = (np.abs(measured[:, i]) > 0.5 * _MOVING) & (np.abs(commanded[:, i]) > 0)
        cures = {
            _DEGREE: f"{name} looks like degrees; multiply by π/180",
            1 / _DEGREE: f"{name} looks 180/π times too small; divide by π/180",
        }
        ratio = _median(np.abs(measured[use, i] / commanded[use, i]))
        yield ratio, (0.1, 6.0), f"the wheels turn {{:.3g}} times as fast as {name} requires", cures


def _check_directions(windows: Windows, where: str) -> None:
    """Raises InputError if poses, wheel speeds and commands contradict each other in direction.

    The combination of negative ratios shows which columns are wrong.
    """
    path, ahead, turn, speed, difference = _signed_ratios(windows)
    bends = f"the path turns {path:.2g} times as far as yaw; expected more than 0"
    moves = f"the robot moves {ahead:.2g} m along yaw per meter in its wheels' direction; expected at least {_ALONG}"
    turns = f"the robot turns {turn:.2g} times as fast as its wheels would have it without slip; expected more than 0"
    rolls = f"the wheels roll {speed:.2g} times as fast as commanded; expected more than 0"
    differ = f"the wheels' difference is {difference:.2g} times the commanded one; expected more than 0"
    forward, sideways = "cmd_v has", "cmd_yaw_rate is clockwise: negate it"
    if not windows.twist:
        forward, sideways = "cmd_left and cmd_right have", "cmd_left and cmd_right are swapped"
    cases = (
        (path < 0 and turn < 0, bends, "yaw is clockwise: negate it"),
        (path < 0, bends, "x and y are swapped, or one of them has the wrong sign"),
        (ahead < -_ALONG and not turn > 0, moves, "wheel speeds have the wrong sign"),
        (ahead < _ALONG, moves, "x and y are swapped, or yaw is not the angle from x to the robot's front"),
        (turn < 0 and difference < 0, turns, "left and right wheels are swapped"),
        (turn < 0, turns, "yaw is clockwise (NED): negate y and yaw; or left and right are swapped in all columns"),
        (speed < 0, rolls, f"{forward} the wrong sign"),
        (difference < 0, differ, sideways),
    )
    for wrong, found, cure in cases:
        if wrong:
            raise InputError(f"{where}: {found}; {cure}")


def _signed_ratios(windows: Windows) -> tuple[float, ...]:
    """Medians over suitable windows, positive in a consistent log; NaN with fewer than `_MIN_SIGNED` windows.

    They are: turn of the path / turn of yaw; motion along yaw / motion in the wheels' direction; turn of yaw / turn of
    the wheels without slip; measured / commanded mean of the sides' speeds; the same of their difference.
    """
    half = windows.wheels.shape[1] // 2
    halves = np.stack([one.mean((1, 2)) for one in (windows.wheels[:, :half], windows.wheels[:, half:])]) * WHEEL_RADIUS
    sides = windows.wheels.mean(1) * WHEEL_RADIUS
    measured = np.stack([sides.mean(1), (sides[:, 1] - sides[:, 0]) / 2], -1)  # [m/s]
    commanded = windows.commanded_speeds.mean(1) * WHEEL_RADIUS
    mean, difference = measured.T
    before, end, yaw = windows.poses[:, half, :2], windows.poses[:, -1, :2], windows.poses[:, -1, 2]
    after = end - before
    bend = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(1))
    slowest = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) / (DURATION / 2)
    steady = (halves.prod(0) > 0) & (np.minimum(slowest, np.abs(halves).min(0)) > _MOVING)  # without reversing
    distance = np.linalg.norm(end, axis=1)
    straight = (np.minimum(np.abs(mean), distance / DURATION) > _MOVING) & (np.abs(difference) < 0.3 * np.abs(mean))
    obeyed = np.minimum(np.abs(measured), np.abs(commanded)) > 0.5 * _MOVING
    ratios = (
        (2 * bend, yaw, steady & (np.abs(yaw) > 2 * _TURN)),
        (end[:, 0], distance * np.sign(mean), straight),
        (yaw * TRACK / 2, difference * DURATION, np.abs(difference) > _MOVING),
        *((measured[:, i], commanded[:, i], obeyed[:, i]) for i in (0, 1)),
    )
    return tuple(float(np.median(a[u] / b[u])) if u.sum() >= _MIN_SIGNED else np.nan for a, b, u in ratios)


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) >= 3 else np.nan
