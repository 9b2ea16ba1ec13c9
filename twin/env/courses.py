"""The wheel controllers of many robots at once: what each makes of a control step.

It is what `HuskyPhysics.course` says of one robot, with `Controller`'s arithmetic. A *piece* of a course is some small
steps under one command, at whose end contacts are looked at; robots whose controllers run at other times have other
pieces, and as many as they need.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.env.controller import CONTROL_PERIOD, TICK, limited_command, wheel_speeds
from twin.robot import HuskyParams

Array = NDArray[np.float64]
Numbers = NDArray[np.int32]


@dataclass(frozen=True)
class Courses:
    """Of n robots over one control step of `steps` small steps, in at most `p` pieces."""

    speeds: Array
    """Asked of the left and of the right wheels in each piece [rad/s], shape (p, n, 2)."""
    times: Array
    """At which each piece ends [s]; of those that a robot does not need infinite. Shape (p, n)."""
    piece: Numbers
    """Which each small step belongs to, shape (steps, n)."""
    looks: Numbers
    """1 where a small step ends a piece, else 0, shape (steps, n)."""


class Controllers:
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

    def courses(self, which: NDArray[np.int64], commands: Array) -> Courses:
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
        return Courses(speeds, times, np.cumsum(looks[:-1], 0, dtype=np.int32), looks[1:])

    def _run(self, which: NDArray[np.int64]) -> Array:
        """Runs controllers once: speeds of the left and of the right wheels [rad/s], shape (k, 2)."""
        time, arrivals = self.time[which], self._arrivals[:, which]
        newest = len(arrivals) - 1 - np.argmax((arrivals <= time + TICK)[::-1], axis=0)
        arrived = np.take_along_axis(arrivals, newest[None], 0)[0]
        # None lapses: a command comes with every control step, which is no longer than COMMAND_TIMEOUT.
        wanted = np.where(np.isfinite(arrived)[:, None], self._given[newest, which], 0.0)
        self._carried_out[which] = limited_command(wanted, self._carried_out[which], self._params)
        return wheel_speeds(self._carried_out[which], self._params)
