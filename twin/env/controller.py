"""The Husky's own wheel controller: what becomes of a command before it is a wheel speed.

A *command* is forward speed v [m/s] and yaw rate ω [rad/s]. The controller runs at 10 Hz: it takes the newest command
that has reached it (none newer than `command_latency`, none older than 0.25 s: then it stops), limits v and ω, then
their change per period, turns them into the speeds of the two sides, and slows both alike where one is beyond
`max_wheel_speed`. As Clearpath's: ROS's diff_drive_controller with its speed limiter, then husky_hardware's limit.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.types import Array

CONTROL_PERIOD = 0.1  # [s]
COMMAND_TIMEOUT = 0.25  # [s] without a command, then the robot stops

TICK = 1e-9  # [s] instants nearer than this are the same


def limited_command(command: Array, previous: Array, params: HuskyParams, period: float = CONTROL_PERIOD) -> Array:
    """A command after the limits of speed and acceleration: v [m/s], ω [rad/s].

    Args:
        command: Wanted v, ω, shape (..., 2).
        previous: What was carried out one `period` [s] ago, shape (..., 2).
        params: `max_speed`, `max_yaw_rate` and their accelerations.
    """
    limit = np.array([params.max_speed, params.max_yaw_rate])
    step = np.array([params.max_acceleration, params.max_yaw_acceleration]) * period
    return np.clip(np.clip(command, -limit, limit), previous - step, previous + step)


def wheel_speeds(command: Array, params: HuskyParams) -> Array:
    """Speeds of the left and of the right wheels [rad/s] for v [m/s] and ω [rad/s], each shape (..., 2)."""
    half = command[..., 1:] * params.separation_multiplier * TRACK / 2
    sides = command[..., :1] + half * np.array([-1.0, 1.0])
    beyond = np.abs(sides).max(-1, keepdims=True) / params.max_wheel_speed
    return sides / np.maximum(1.0, beyond) / WHEEL_RADIUS


def commanded_motion(speeds: Array, params: HuskyParams) -> Array:
    """The inverse of `wheel_speeds` within its limits: v [m/s], ω [rad/s] that the controller believes in."""
    left, right = np.asarray(speeds) * WHEEL_RADIUS
    return np.array([(left + right) / 2, (right - left) / (params.separation_multiplier * TRACK)])


class Controller:
    """The controller through time. Times are seconds on any clock that starts with `reset`."""

    def __init__(self, params: HuskyParams | None = None) -> None:
        self.params = params or HuskyParams()
        self.reset()

    def reset(self) -> None:
        """At rest, with no command under way."""
        self._under_way: deque[tuple[float, Array]] = deque()
        self._latest: tuple[float, Array] | None = None
        self._carried_out = np.zeros(2)

    @property
    def phase(self) -> float:
        """When the controller first runs [s]; then every 0.1 s. A command given at 0 reaches it just then."""
        phase = self.params.command_latency % CONTROL_PERIOD
        return 0.0 if phase > CONTROL_PERIOD - TICK else phase

    @property
    def carried_out(self) -> Array:
        """v [m/s], ω [rad/s] after the limits, shape (2,)."""
        return self._carried_out.copy()

    def command(self, time: float, v: float, yaw_rate: float) -> None:
        """Gives a command at a time [s]."""
        self._under_way.append((time + self.params.command_latency, np.array([v, yaw_rate], float)))

    def update(self, time: float) -> Array:
        """Runs once: speeds of the left and of the right wheels [rad/s], shape (2,)."""
        while self._under_way and self._under_way[0][0] <= time + TICK:
            self._latest = self._under_way.popleft()
        wanted = np.zeros(2)
        if self._latest is not None and time - self._latest[0] <= COMMAND_TIMEOUT - TICK:
            wanted = self._latest[1]
        self._carried_out = limited_command(wanted, self._carried_out, self.params)
        return wheel_speeds(self._carried_out, self.params)


# ---- The wheel controllers of many robots at once: what each makes of a control step.
#
# It is what `HuskyPhysics.course` says of one robot, with `Controller`'s arithmetic. A *piece* of a course is some small
# steps under one command, at whose end contacts are looked at; robots whose controllers run at other times have other
# pieces, and as many as they need.

Numbers = NDArray[np.int32]


@dataclass(frozen=True)
class SubstepSchedules:
    """Of n robots over one control step of `steps` small steps, in at most `p` pieces."""

    speeds: Array
    """Asked of the left and of the right wheels in each piece [rad/s], shape (p, n, 2)."""
    times: Array
    """At which each piece ends [s]; of those that a robot does not need infinite. Shape (p, n)."""
    piece: Numbers
    """Which each small step belongs to, shape (steps, n)."""
    looks: Numbers
    """1 where a small step ends a piece, else 0, shape (steps, n)."""


class VectorController:
    """Of n robots that differ in nothing but their `command_latency`."""

    def __init__(self, params: HuskyParams, count: int, period: float, timestep: float, look_steps: int) -> None:
        """
        Args:
            params: What they have in common.
            count: How many robots.
            period: Between two commands, a control step [s].
            timestep: Of physics [s].
            look_steps: Small steps between two looks.
        """
        self._params, self.timestep, self._look_steps = params, timestep, look_steps
        self._steps, self._period = round(period / timestep), period
        self._between = round(CONTROL_PERIOD / timestep)  # small steps between two runs of the controller
        # A piece ends with a look; every run of the controller, and the control step's end, may cut one short.
        self.pieces = self._steps // look_steps + round(period / CONTROL_PERIOD) + 3
        self._latency, self._until = np.zeros(count), np.zeros(count, int)
        self.time = np.zeros(count)
        """Of each robot [s], since its episode began, shape (n,)."""
        self._arrivals, self._given = np.full((2, count), -np.inf), np.zeros((2, count, 2))  # the newest last
        self._carried_out, self._speeds = np.zeros((count, 2)), np.zeros((count, 2))

    def begin(self, which: NDArray[np.int64], latency: Array, until: NDArray[np.int64]) -> None:
        """Episodes begin: robots at rest, with no command under way.

        Args:
            which: Of which robots, shape (k,).
            latency: Their `command_latency` [s], shape (k,).
            until: Small steps until their controllers run first, shape (k,).
        """
        self._latency[which], self._until[which], self.time[which] = latency, until, 0.0
        missing = int(np.ceil(self._latency.max() / self._period)) + 2 - len(self._given)
        if missing > 0:  # so many commands may be under way
            n = len(self._latency)
            self._arrivals = np.concatenate([np.full((missing, n), -np.inf), self._arrivals])
            self._given = np.concatenate([np.zeros((missing, n, 2)), self._given])
        self._arrivals[:, which], self._carried_out[which], self._speeds[which] = -np.inf, 0.0, 0.0

    def courses(self, which: NDArray[np.int64], commands: Array) -> SubstepSchedules:
        """Gives some robots commands, v [m/s] and ω [rad/s], shape (k, 2), and runs their controllers for a control
        step. For the others no time passes, and what is said of them means nothing."""
        for ring, new in ((self._arrivals, self.time[which] + self._latency[which]), (self._given, commands)):
            ring[:-1, which] = ring[1:, which]
            ring[-1, which] = new
        n = len(self.time)
        speeds, times = np.zeros((self.pieces, n, 2)), np.full((self.pieces, n), np.inf)
        looks = np.zeros((self._steps + 1, n), np.int32)  # shifted by one, so that the pieces' numbers are its sums
        left = np.zeros(n, int)
        left[which] = self._steps
        everyone = np.arange(n)
        for p in range(self.pieces):
            due = np.flatnonzero((self._until == 0) & (left > 0))
            if len(due):
                self._speeds[due] = self._run(due)
                self._until[due] = self._between
            some = np.minimum(np.minimum(left, self._look_steps), self._until)
            going = left > 0
            left, self.time, self._until = left - some, self.time + some * self.timestep, self._until - some
            speeds[p] = self._speeds
            times[p, going] = self.time[going]
            looks[self._steps - left[going], everyone[going]] = 1
        return SubstepSchedules(speeds, times, np.cumsum(looks[:-1], 0, dtype=np.int32), looks[1:])

    def _run(self, which: NDArray[np.int64]) -> Array:
        """Runs controllers once: speeds of the left and of the right wheels [rad/s], shape (k, 2)."""
        time, arrivals = self.time[which], self._arrivals[:, which]
        newest = len(arrivals) - 1 - np.argmax((arrivals <= time + TICK)[::-1], axis=0)
        arrived = np.take_along_axis(arrivals, newest[None], 0)[0]
        # None lapses: a command comes with every control step, which is no longer than COMMAND_TIMEOUT.
        wanted = np.where(np.isfinite(arrived)[:, None], self._given[newest, which], 0.0)
        self._carried_out[which] = limited_command(wanted, self._carried_out[which], self._params)
        return wheel_speeds(self._carried_out[which], self._params)
