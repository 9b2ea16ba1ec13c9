"""Drive logs: what a robot was told, what its wheels did, and where it went, cut into windows.

A *window* is two seconds of a log, sampled evenly: commands, wheel speeds, poses relative to the first one, and, where
there was an IMU, accelerations. Windows of one *group* share an experiment; groups of even number are for fitting, odd
ones for scoring. A window *follows* the one before it where it begins when that one ends. A pose is *fresh* when it
differs from the one before, *stale* when it repeats it. Windows in which the robot stands, as it was told to, or in
which poses cease while the wheels turn, are left out.

`read_log` takes

- a table (.csv, or .npz of equally long columns) with one row per instant: `time` [s]; commands, either `cmd_v` [m/s]
  and `cmd_yaw_rate` [rad/s], or `cmd_left` and `cmd_right` [rad/s at the wheels]; `left_wheel_vel`, `right_wheel_vel`
  [rad/s]; `x`, `y` [m], `yaw` [rad] of the base in any fixed frame; optionally `acceleration_x`, `acceleration_y`
  [m/s²], proper acceleration in the base (x forward, y left; an IMU's raw reading), and `group`;
- a ROS 2 bag (`twin.sysid.ros_bags`), which becomes such a table;
- windows as published with DRIVE (Samson et al., BSD-3): an .npz of arrays (n, 40) at 20 Hz.
"""

import csv
import io
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from twin import runtime
from twin.errors import InputError
from twin.files import damaged, exists, load_arrays, read_text
from twin.types import Array

# ---- When the poses of a log were measured, told from when they got into it.
#
# A sensor of poses measures at a steady rate, but what it measures gets into the log sooner or later: from a fresh pose
# to the next a robot moves as far after 0.05 s as after 0.15 s (DRIVE's log: within windows that turn, yaw is smooth to
# 0.3° over the number of fresh poses, to 0.7° over when they appeared). So the n-th measurement counts as of n periods
# after the first one. Where fresh poses are later for good by more than half a period, some were lost. The first one
# may be older than the window, by at most `OLDEST`.
#
# Windows that disagree with their log's period by more than a late delivery explains count as they appeared, and their
# first pose as older than the next by as much as those are apart; so do all of a log in which many do, or of a fast
# sensor. All times are in samples; a window starts at 0.


OLDEST = 20  # samples that the first pose of a window may have been measured before its start, at most

_FAST = 1.75  # samples; sensors of a shorter period tell more by when their poses appear than by how many did
_JITTER = 4  # samples, at most, between when a pose was measured and when it appeared, but for what is common to all
_UNSTEADY = 0.1  # share of windows that disagree with their log's period by more, from which on there is none


def measured(fresh: NDArray[np.bool_]) -> Array:
    """When every pose of a log's windows was measured [samples], shape (n, k + 1).

    Args:
        fresh: Which poses but the first differ from the one before, shape (n, k).
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
    """When a window's first pose and its fresh ones were measured by a steady sensor.

    Args:
        appeared: When fresh poses did.
        period: Of the sensor.
    """
    if not len(appeared):
        return np.zeros(1)
    number = np.arange(1.0, len(appeared) + 1)
    lost = np.maximum(0.0, np.ceil((appeared - appeared[0]) / period - number + 0.5))
    number += np.minimum.accumulate(lost[::-1])[::-1]  # what comes late, but comes, was not lost
    start = float(np.median(appeared - period * number))
    if start > period / 2:  # the robot rested, or as many were lost at first
        first = start - period * np.ceil(start / period)
    else:  # there was a pose when the window began
        first = start = min(start, 0.0)
    first = max(first, -OLDEST)
    return np.append(first, np.maximum(first, start + period * number))


def _as_appeared(appeared: Array, period: float) -> Array:
    """The same, by any other sensor; the period stands in where one fresh pose does not tell how far they are apart."""
    apart = float(np.median(np.diff(appeared))) if len(appeared) > 1 else period
    return np.append(max(min(float(appeared[0]) - apart, 0.0), -OLDEST), appeared)


PERIOD = 0.05  # [s] between two samples of a window
DURATION = 2.0  # [s]
SAMPLES = round(DURATION / PERIOD)
MAX_GAP = 0.5  # [s] between two rows of a table; a window that reaches into a longer one is left out
MIN_INTERVAL = 5e-4  # [s] between rows, median; the least a clock in seconds would show

_DROPOUT = 30  # samples without a fresh pose; a window with more of them in which the wheels turn is left out
_TURNING = 0.5  # [rad/s] mean of both sides' wheels
_STANDS = 0.05  # [rad/s], [m/s]; a window in which neither wheels nor commands ever are faster is left out
_MOST_LOG = 512 << 20  # [bytes], unpacked
_TICK = 1e-6  # [s] instants nearer than this are the same
_GROUP_WINDOWS = 3  # of a table without groups: six seconds
_CONTINUES = 1.0  # [rad/s] sum over both sides by which wheel speeds may change from one window to the next

TWIST = ("cmd_v", "cmd_yaw_rate")
WHEEL_COMMANDS = ("cmd_left", "cmd_right")
WHEEL_SPEEDS = ("left_wheel_vel", "right_wheel_vel")
POSE = ("x", "y", "yaw")
ACCELERATION = ("acceleration_x", "acceleration_y")


@dataclass(frozen=True)
class Windows:
    """n windows of k samples, `PERIOD` [s] apart."""

    commands: Array
    """v [m/s] and ω [rad/s], or left and right [rad/s], see `twist`; shape (n, k, 2)."""
    twist: bool
    """Whether commands are v and ω."""
    wheels: Array
    """Measured speed of the left and of the right wheels [rad/s], shape (n, k, 2)."""
    poses: Array
    """x, y [m], yaw [rad] relative to the first, which is zero; one more than samples, shape (n, k + 1, 3)."""
    groups: NDArray[np.int64]
    """Shape (n,)."""
    follows: NDArray[np.bool_]
    """Shape (n,)."""
    acceleration: Array | None = None
    """Proper acceleration forward and to the left [m/s²], shape (n, k, 2)."""

    def __len__(self) -> int:
        return len(self.wheels)

    @property
    def fitting(self) -> NDArray[np.bool_]:
        """Which windows may be fitted to; the others are for scoring. Shape (n,)."""
        return self.groups % 2 == 0

    @property
    def before(self) -> Array:
        """Wheel speeds of the `DURATION` before each window and at its start [rad/s], shape (n, k + 1, 2).

        Those of the window before, where this one follows it, else as they are at the start.
        """
        out = np.repeat(self.wheels[:, :1], self.wheels.shape[1] + 1, 1)
        follows = np.flatnonzero(self.follows)
        out[follows, :-1] = self.wheels[follows - 1]
        return out

    def of(self, which: NDArray) -> "Windows":
        """Some of the windows; none of them follows another."""
        return Windows(
            self.commands[which],
            self.twist,
            self.wheels[which],
            self.poses[which],
            self.groups[which],
            np.zeros(len(self.wheels[which]), bool),
            None if self.acceleration is None else self.acceleration[which],
        )

    @property
    def fresh(self) -> NDArray[np.bool_]:
        """Which poses but the first are fresh, shape (n, k)."""
        return np.abs(np.diff(self.poses, axis=1)).max(2) > 1e-6

    @property
    def turning(self) -> NDArray[np.bool_]:
        """In which windows the wheels turn, shape (n,)."""
        return np.abs(self.wheels).mean((1, 2)) > _TURNING

    @cached_property
    def measured(self) -> Array:
        """When each pose was measured [s], but for a lateness common to all; time starts with the first sample.

        See `timing`. Shape (n, k + 1).
        """
        return measured(self.fresh) * PERIOD

    @property
    def elapsed(self) -> Array:
        """Time from the measurement of the first pose to that of each [s], shape (n, k + 1)."""
        return self.measured - self.measured[:, :1]


def read_log(path: Path) -> Windows:
    """Reads any kind of log. Raises InputError: unreadable, columns missing, times or values impossible, too short."""
    if not exists(path):
        raise InputError(f"{path}: no such log; expected a .csv, an .npz or the folder of a ROS 2 bag")
    if path.is_dir() or path.suffix in (".db3", ".mcap", ".bag"):
        from twin.sysid.ros_bags import read_bag

        return cut(read_bag(path), str(path))
    if path.suffix == ".csv":
        return cut(_read_csv(path), str(path))
    if path.suffix == ".npz":
        columns = _read_npz(path)
        if columns.get("icp_x", np.zeros(0)).ndim == 2:
            return _published_windows(columns, str(path))
        return cut(columns, str(path))
    raise InputError(f"{path}: expected a log in .csv, .npz or a ROS 2 bag; convert it to one of those")


def _read_csv(path: Path) -> dict[str, Array]:
    text = read_text(path, _MOST_LOG)
    try:
        head, *rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
        values = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in rows])
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: not a table of numbers under one line of names: {error}; export it anew") from None
    if values.ndim != 2 or values.shape[1] != len(head):
        raise InputError(f"{path}: {len(head)} names over rows of another length; export it anew")
    return {name.strip(): values[:, i] for i, name in enumerate(head)}


def _read_npz(path: Path) -> dict[str, Array]:
    arrays = load_arrays(path, _MOST_LOG)
    with damaged(path, "expected plain arrays of numbers; save it anew with numpy.savez"):
        return {name: np.asarray(values, np.float64) for name, values in arrays.items()}


def cut(columns: dict[str, Array], where: str) -> Windows:
    """Windows of a table; rows may come at any rate, the newest one counts.

    Args:
        columns: By name, shape (rows,) each; see the module's head.
        where: What to call the log in an error.

    Raises:
        InputError: a column is missing or not a number throughout, or time does not increase or cannot be in seconds.
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
        relative(pose[rows]),
        np.asarray(group, np.int64),
        np.diff(order, prepend=-2) == 1,
        sampled(accelerations) if accelerations else None,
    )
    return _telling(windows, where)


def _telling(windows: Windows, where: str) -> Windows:
    """Leaves out windows that tell nothing of a model.

    Where the wheels turn and poses cease, nobody knows where the robot went; to stand where told to, any model can.

    Raises:
        InputError: those are more than half of the ones in which the wheels turn.
    """
    edge = np.ones((len(windows), 1), bool)
    appeared = np.concatenate([edge, windows.fresh, edge], 1)
    ceased = np.array([np.diff(np.flatnonzero(row)).max() > _DROPOUT for row in appeared], bool)
    turning = windows.turning
    lost = int((ceased & turning).sum())
    if lost > turning.sum() / 2:
        raise InputError(
            f"{where}: no new pose for {_DROPOUT * PERIOD:g} s in {lost} of {turning.sum()} windows in which the "
            "wheels turn; expected at least one a second; record poses at 1 Hz or more, better at 10 Hz"
        )
    if lost:
        runtime.say(f"{lost} windows left out: the wheels turn and poses cease")
    stands = np.maximum(np.abs(windows.wheels), np.abs(windows.commands)).max((1, 2), initial=0.0) < _STANDS
    if stands.any():
        runtime.say(f"{stands.sum()} windows left out: the robot stands")
    keep = ~(ceased & turning) & ~stands
    before = np.concatenate([[False], keep[:-1]])
    return replace(windows.of(keep), follows=(windows.follows & before)[keep])


def _gapless(time: Array, where: str) -> NDArray[np.int64]:
    """Which of the windows that begin every `DURATION` [s] from the first row on have no gap in them, shape (n,).

    Raises:
        InputError: by its rows' median interval time is not in seconds, or there are too few rows a second.
    """
    if len(time) < 2:
        return np.zeros(0, np.int64)
    steps = np.diff(time)
    interval = float(np.median(steps))
    if not MIN_INTERVAL <= interval <= MAX_GAP:
        units = {"ms": 3, "µs": 6, "ns": 9}
        fits = [(u, n) for u, n in units.items() if 4 * MIN_INTERVAL <= interval / 10**n <= MAX_GAP]
        cure = f"record at least {1 / MAX_GAP:g} rows a second" if interval > MAX_GAP else "give time in s"
        if fits:
            cure = f"time looks like {fits[0][0]}; divide it by 1e{fits[0][1]}"
        raise InputError(
            f"{where}: rows are {interval:.3g} s apart (median), expected {MIN_INTERVAL:g} to {MAX_GAP:g} s; {cure}"
        )
    after = np.flatnonzero(steps > MAX_GAP) + 1  # a stretch without gaps begins
    first, last = time[np.append(0, after)], time[np.append(after - 1, len(time) - 1)]
    low = np.ceil((first - time[0]) / DURATION - _TICK).astype(np.int64)
    high = np.floor((last - time[0]) / DURATION + _TICK).astype(np.int64)
    return np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)])


def _published_windows(columns: dict[str, Array], where: str) -> Windows:
    """DRIVE's: the pose at 2 s, `gt_icp_*`, is the 41st sample; the robot's IMU looks backwards.

    That it does is seen in the data: `imu_acceleration_x` falls when the wheels speed up, and `imu_acceleration_y`
    points out of the turn (correlations −0.16 and −0.11 over 16,000 samples), whereas the yaw rate has the right sign.
    """
    poses = [f"{{}}icp_{name}" for name in POSE]
    imu = ("imu_acceleration_x", "imu_acceleration_y")
    names = [*WHEEL_COMMANDS, *WHEEL_SPEEDS, *(p.format("") for p in poses), *imu]
    ends = [p.format("gt_") for p in poses]
    _need(columns, ("calib_step", *names, *ends), where)
    shape = columns["icp_x"].shape
    for name in names:
        if columns[name].shape != shape or shape[1] != SAMPLES:
            raise InputError(f"{where}: {name} has shape {columns[name].shape}; expected (n, {SAMPLES}), 2 s at 20 Hz")
    for name in ("calib_step", *ends):
        if columns[name].shape != shape[:1]:
            raise InputError(f"{where}: {name} has shape {columns[name].shape}; expected {shape[:1]}, one per window")
    _finite({name: columns[name] for name in ("calib_step", *names, *ends)}, where)
    pose = np.stack([np.concatenate([columns[p.format("")], columns[p.format("gt_")][:, None]], 1) for p in poses], -1)
    pose[..., 2] = np.unwrap(pose[..., 2], axis=1)
    wheels = np.stack([columns[name] for name in WHEEL_SPEEDS], -1)
    step = columns["calib_step"].astype(np.int64)
    jump = np.abs(wheels[1:, 0] - wheels[:-1, -1]).sum(1)
    windows = Windows(
        np.stack([columns[name] for name in WHEEL_COMMANDS], -1),
        False,
        wheels,
        relative(pose),
        step,
        np.concatenate([[False], (jump < _CONTINUES) & (np.diff(step) <= 1) & (np.diff(step) >= 0)]),
        -np.stack([columns[name] for name in imu], -1),
    )
    return _telling(windows, where)


def retimed(poses: Array, late: Array, before: int) -> Array:
    """Poses from when each robot's first one was measured.

    Args:
        poses: `PERIOD` [s] apart, shape (n, m, 3).
        late: How old the first one is when time starts [s], at most `before` samples; negative where it is yet to come.
            Shape (n,).
        before: Which of the poses is that at which time starts.

    Returns:
        Relative to the first, shape (n, k + OLDEST + 1, 3); straight on beyond the last one there is.
    """
    position = before - late[:, None] / PERIOD + np.arange(SAMPLES + OLDEST + 1)
    whole = np.clip(position.astype(int), 0, poses.shape[1] - 2)
    share = (position - whole)[..., None]
    row = np.arange(len(poses))[:, None]
    return relative(poses[row, whole] * (1 - share) + poses[row, whole + 1] * share)


def relative(poses: Array) -> Array:
    """Poses in the frame of the first: x, y [m], yaw [rad], shape (n, k, 3)."""
    turned = poses - poses[:, :1]
    cos, sin = np.cos(poses[:, :1, 2]), np.sin(poses[:, :1, 2])
    x, y = turned[..., 0], turned[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, turned[..., 2]], -1)


def wrapped(angle: Array) -> Array:
    """The same angle from −π to π [rad]."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def without_acceleration(windows: Windows) -> Windows:
    """The same, as if there had been no IMU."""
    return replace(windows, acceleration=None)


def _need(columns: dict[str, Array], names: tuple[str, ...], where: str) -> None:
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(
            f"{where}: no column {', '.join(missing)} among {', '.join(sorted(columns)) or 'none'}; "
            "name the columns as `python -m twin.align --help` says"
        )


def _finite(columns: dict[str, Array], where: str) -> None:
    for name, column in columns.items():
        bad = np.argwhere(~np.isfinite(column))
        if len(bad):
            place = ", ".join(str(int(i) + 1) for i in bad[0])
            raise InputError(
                f"{where}: {name} is {column[tuple(bad[0])]} at row {place} and in {len(bad)} places; "
                "expected numbers; cut those rows out"
            )
