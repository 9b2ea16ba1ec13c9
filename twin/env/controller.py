"""The Husky's own wheel controller: what becomes of a command before it is a wheel speed.

A *command* is forward speed v [m/s] and yaw rate ω [rad/s]. The controller runs at 10 Hz: it takes the newest command
that has reached it (none newer than `command_latency`, none older than 0.25 s: then it stops), limits v and ω, then
their change per period, turns them into the speeds of the two sides, and slows both alike where one is beyond
`max_wheel_speed`. As Clearpath's: ROS's diff_drive_controller with its speed limiter, then husky_hardware's limit.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams

Array = NDArray[np.float64]

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
