"""The Husky's wheel controller: turns commands into wheel speeds, for one robot or many.

A *command* is forward speed v [m/s] and yaw rate ω [rad/s]. It reaches the controller `command_latency` after it was
given. The controller runs periodically, by default at 10 Hz, and uses the newest command that has arrived. If this
command arrived longer ago than the time-out, by default 0.25 s, the controller stops the robot (see
`twin.robot.CONTROLLERS`). The controller limits v and ω, and then their changes per period. It converts v and ω to the
speeds of the left and right wheels, and scales both down if one exceeds `max_wheel_speed`. This reproduces Clearpath's
controller: ROS's diff_drive_controller with its speed limiter, followed by husky_hardware's limit of wheel speed.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.robot import CONTROLLERS, TRACK, WHEEL_RADIUS, HuskyParams
from twin.types import Array

Int32Array = NDArray[np.int32]

CONTROL_PERIOD = 0.1
"""Usual time between two commands [s]."""
COMMAND_TIMEOUT = min(timing.timeout for timing in CONTROLLERS.values())
"""Longest allowed time between two commands [s]: the shortest time-out of all controllers."""

_TIME_TOLERANCE = 1e-9  # [s] times that differ by less count as equal


def limit_command(command: Array, previous: Array, params: HuskyParams, period: float = CONTROL_PERIOD) -> Array:
    """Returns commands limited in speed and acceleration, shape (..., 2).

    `previous` are the limited commands one `period` [s] ago, shape (..., 2).
    """
    limit = np.array([params.max_speed, params.max_yaw_rate])
    step = np.array([params.max_acceleration, params.max_yaw_acceleration]) * period
    return limit_change(np.clip(command, -limit, limit), previous, step)


def limit_change(wanted: Array, previous: Array, step: Array) -> Array:
    """Returns the values nearest to `wanted` that differ from `previous` by at most `step`."""
    return np.clip(wanted, previous - step, previous + step)


def limit_sides(sides: Array, limit: float) -> Array:
    """Returns the speeds of both sides, shape (..., 2), scaled down by a common factor if one exceeds the limit."""
    return sides / np.maximum(1.0, np.abs(sides).max(-1, keepdims=True) / limit)


def wheel_speeds(command: Array, params: HuskyParams) -> Array:
    """Returns the speeds of the left and right wheels [rad/s] for v [m/s] and ω [rad/s], each shape (..., 2)."""
    half = command[..., 1:] * params.separation_multiplier * TRACK / 2
    sides = command[..., :1] + half * np.array([-1.0, 1.0])
    return limit_sides(sides, params.max_wheel_speed) / WHEEL_RADIUS


class Controller:
    """Controller of one robot. Times are in seconds on a clock that starts at 0."""

    def __init__(self, params: HuskyParams | None = None, speed: float = 0.0) -> None:
        """Begins at rest, or in the course of commands to drive straight on at `speed` [m/s]."""
        self.params = params or HuskyParams()
        self.speed = speed
        """Speed at the beginning [m/s]."""
        self._pending: deque[tuple[float, Array]] = deque()
        # The earlier commands hold until the first new one arrives.
        self._latest = (self.params.command_latency, np.array([speed, 0.0]))
        self._limited = np.array([speed, 0.0])

    @property
    def phase(self) -> float:
        """Time of the first update [s], chosen so that a command given at time 0 arrives at an update."""
        period = self.params.timing.period
        phase = self.params.command_latency % period
        return 0.0 if phase > period - _TIME_TOLERANCE else phase

    def command(self, time: float, v: float, yaw_rate: float) -> None:
        """Gives the controller a command at a time [s]; it arrives `command_latency` later."""
        self._pending.append((time + self.params.command_latency, np.array([v, yaw_rate], float)))

    def update(self, time: float) -> Array:
        """Runs one update and returns the speeds of the left and right wheels [rad/s], shape (2,)."""
        while self._pending and self._pending[0][0] <= time + _TIME_TOLERANCE:
            self._latest = self._pending.popleft()
        wanted = np.zeros(2)
        timing = self.params.timing
        if time - self._latest[0] <= timing.timeout - _TIME_TOLERANCE:
            wanted = self._latest[1]
        self._limited = limit_command(wanted, self._limited, self.params, timing.period)
        return wheel_speeds(self._limited, self.params)


# ---- controllers of many robots


@dataclass(frozen=True)
class SubstepSchedules:
    """Wheel speeds of n robots in one control step, which consists of `steps` physics substeps.

    A segment is a run of substeps with constant wheel speeds; contacts are checked at its end. Each robot has at most p
    segments; they differ between robots whose controllers have different phases.
    """

    speeds: Array
    """Speeds of the left and right wheels in each segment [rad/s], shape (p, n, 2)."""
    times: Array
    """Time at the end of each segment [s], infinite for unused segments, shape (p, n)."""
    segment: Int32Array
    """Index of the segment that contains each substep, shape (steps, n)."""
    checks: Int32Array
    """1 where a substep ends a segment, else 0, shape (steps, n)."""


class VectorController:
    """Controllers of n robots that differ only in `command_latency`; results equal those of `HuskyPhysics.schedule`."""

    def __init__(self, params: HuskyParams, count: int, period: float, timestep: float, check_steps: int) -> None:
        """`period` [s] is the time between two commands, `timestep` [s] that of a physics substep.

        `count` is the number of robots n, `check_steps` the number of substeps between two contact checks.
        """
        self._params, self.timestep, self._check_steps = params, timestep, check_steps
        self._steps, self._period = round(period / timestep), period
        self._steps_per_update = round(params.timing.period / timestep)
        # A segment ends at a contact check, at a controller update, or at the end of the control step.
        self.max_segments = self._steps // check_steps + round(period / params.timing.period) + 3
        self._latency, self._steps_to_update = np.zeros(count), np.zeros(count, int)
        self.time = np.zeros(count)
        """Time of each robot since its episode began [s], shape (n,)."""
        self._arrivals, self._commands = np.full((2, count), -np.inf), np.zeros((2, count, 2))  # the newest last
        self._limited, self._speeds = np.zeros((count, 2)), np.zeros((count, 2))

    def begin(
        self, which: NDArray[np.int64], latency: Array, steps_to_update: NDArray[np.int64], speed: Array | float = 0.0
    ) -> None:
        """Resets the k robots `which`, without pending commands, to rest or to driving straight on.

        `latency` (k,) is their `command_latency` [s], `steps_to_update` (k,) the substeps until their first update,
        `speed` (k,) that of `Controller` [m/s].
        """
        self._latency[which], self._steps_to_update[which], self.time[which] = latency, steps_to_update, 0.0
        missing = int(np.ceil(self._latency.max() / self._period)) + 2 - len(self._commands)
        if missing > 0:  # make room for all commands that may be pending
            n = len(self._latency)
            self._arrivals = np.concatenate([np.full((missing, n), -np.inf), self._arrivals])
            self._commands = np.concatenate([np.zeros((missing, n, 2)), self._commands])
        rolling = np.zeros((len(which), 2))
        rolling[:, 0] = speed
        self._arrivals[:, which], self._arrivals[-1, which] = -np.inf, 0.0
        self._commands[-1, which] = self._limited[which] = rolling
        self._speeds[which] = wheel_speeds(rolling, self._params)

    def schedules(self, which: NDArray[np.int64], commands: Array) -> SubstepSchedules:
        """Gives commands to the k robots `which` and runs their controllers for one control step.

        The commands are v [m/s] and ω [rad/s], shape (k, 2). The time of the other robots does not advance;
        their schedules are undefined.
        """
        for ring, new in ((self._arrivals, self.time[which] + self._latency[which]), (self._commands, commands)):
            ring[:-1, which] = ring[1:, which]
            ring[-1, which] = new
        n = len(self.time)
        speeds, times = np.zeros((self.max_segments, n, 2)), np.full((self.max_segments, n), np.inf)
        # Row i + 1 is 1 where substep i ends a segment. So rows 0 to i add up to the index of substep i's segment.
        checks = np.zeros((self._steps + 1, n), np.int32)
        left = np.zeros(n, int)
        left[which] = self._steps
        robots = np.arange(n)
        for p in range(self.max_segments):
            due = np.flatnonzero((self._steps_to_update == 0) & (left > 0))
            if len(due):
                self._speeds[due] = self._update(due)
                self._steps_to_update[due] = self._steps_per_update
            some = np.minimum(np.minimum(left, self._check_steps), self._steps_to_update)
            going = left > 0
            left, self.time = left - some, self.time + some * self.timestep
            self._steps_to_update = self._steps_to_update - some
            speeds[p] = self._speeds
            times[p, going] = self.time[going]
            checks[self._steps - left[going], robots[going]] = 1
        return SubstepSchedules(speeds, times, np.cumsum(checks[:-1], 0, dtype=np.int32), checks[1:])

    def _update(self, which: NDArray[np.int64]) -> Array:
        """See `Controller.update`; shape (k, 2)."""
        time, arrivals = self.time[which], self._arrivals[:, which]
        newest = len(arrivals) - 1 - np.argmax((arrivals <= time + _TIME_TOLERANCE)[::-1], axis=0)
        # No command expires: each control step brings one and is no longer than COMMAND_TIMEOUT.
        wanted = self._commands[newest, which]
        self._limited[which] = limit_command(wanted, self._limited[which], self._params, self._params.timing.period)
        return wheel_speeds(self._limited[which], self._params)
