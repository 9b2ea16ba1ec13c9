"""Drivetrain model: wheel speeds that result from commands, by the robot's controller and servos, fitted to a log.

The model follows the rules of `twin.env.controller`, for many windows at once and smooth in its parameters:
acceleration limits act as ramps instead of steps every 0.1 s (on average the controller's delay to its next period and
its step ahead cancel). *Mean* and *half* speed are the mean of the two sides and half their difference [rad/s at the
wheels]. Wheel commands may be in units of another robot (DRIVE's assume wheels of 0.3 m under a Husky), so they have a
gain for the mean and one for the half speed. With commands v and ω the first is 1 and the second is the controller's
separation multiplier.
"""

from dataclasses import dataclass

import numpy as np

from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.sysid.estimation import Fit, Kinds, Parameter, fit_parameters, negative_log_likelihood
from twin.sysid.logs import PERIOD, SAMPLES, Windows
from twin.types import Array

CONTROL_STEP = 0.01  # [s] of the simulation
HISTORY_SAMPLES = 20  # samples of the previous window from which delayed commands are taken
EXTRA_SAMPLES = 5  # samples beyond a window's end, for poses measured later than logged

_CHAIN = 3  # previous windows over which a ramp is simulated: six seconds
_PER_SAMPLE = round(PERIOD / CONTROL_STEP)
_CURES = {
    "mean_gain": "driving straight at several speeds",
    "half_gain": "turns of several strengths",
    "half_limit": "turns on the spot at full command",
    "wheel_limit": "full speed and a turn at once",
    "latency": "sudden changes of command",
    "mean_acceleration": "sudden starts and stops",
    "half_acceleration": "sudden turns at full command",
    "lag": "sudden changes of command",
}
_SIDES: Kinds = (0, 0)  # residuals of the left and the right wheels [rad/s]


@dataclass(frozen=True)
class Drivetrain:
    """Parameters of the controller and the servos, in the wheels' units."""

    mean_gain: float
    half_gain: float
    half_limit: float
    """[rad/s]"""
    wheel_limit: float
    """[rad/s]; above it both sides are scaled down alike."""
    latency: float
    """[s]"""
    mean_acceleration: float
    """[rad/s²]"""
    half_acceleration: float
    """[rad/s²]"""
    lag: float
    """[s]"""

    @staticmethod
    def from_robot(params: HuskyParams, twist: bool) -> "Drivetrain":
        """The drivetrain of a robot; `twist`: its commands are v and ω, else wheel speeds."""
        half = params.separation_multiplier * TRACK / 2 / WHEEL_RADIUS
        return Drivetrain(
            1.0,
            params.separation_multiplier if twist else 1.0,
            params.max_yaw_rate * half,
            params.max_wheel_speed / WHEEL_RADIUS,
            params.command_latency,
            params.max_acceleration / WHEEL_RADIUS,
            params.max_yaw_acceleration * half,
            params.servo_lag,
        )

    def robot_fields(self, params: HuskyParams, twist: bool) -> dict[str, float]:
        """The same as fields of `HuskyParams`; with wheel commands, `params` gives the separation multiplier."""
        multiplier = self.half_gain if twist else params.separation_multiplier
        half = multiplier * TRACK / 2 / WHEEL_RADIUS
        return {
            "separation_multiplier": multiplier,
            "max_yaw_rate": self.half_limit / half,
            "max_wheel_speed": self.wheel_limit * WHEEL_RADIUS,
            "command_latency": self.latency,
            "max_acceleration": self.mean_acceleration * WHEEL_RADIUS,
            "max_yaw_acceleration": self.half_acceleration / half,
            "servo_lag": self.lag,
        }


def commanded_speeds(windows: Windows) -> Array:
    """Commanded mean and half speed before gains [rad/s], shape (n, k, 2)."""
    a, b = windows.commands[..., 0], windows.commands[..., 1]
    if windows.twist:
        return np.stack([a, b * TRACK / 2], -1) / WHEEL_RADIUS
    return np.stack([a + b, b - a], -1) / 2


def simulate_drivetrain(drivetrain: Drivetrain, windows: Windows) -> tuple[Array, Array]:
    """Servo targets and the wheel speeds that result from them, starting from each window's first wheel speeds.

    A window that follows others starts with their delayed commands and with the state of their acceleration ramps,
    which lagging wheels do not show. In other windows the wheels keep their speed until the first command arrives.

    Returns:
        Targets and lagged wheel speeds, left and right [rad/s], each of shape (n, (k + EXTRA_SAMPLES) · 5, 2),
        `CONTROL_STEP` [s] apart.
    """
    gains = np.array([drivetrain.mean_gain, drivetrain.half_gain])
    commanded = commanded_speeds(windows) * gains
    commanded[..., 1] = np.clip(commanded[..., 1], -drivetrain.half_limit, drivetrain.half_limit)
    speed = windows.wheels[:, 0]
    start = np.stack([speed.mean(1), (speed[:, 1] - speed[:, 0]) / 2], -1)
    before = np.repeat(start[:, None], HISTORY_SAMPLES, 1)
    follows = np.flatnonzero(windows.follows)
    before[follows] = commanded[follows - 1, -HISTORY_SAMPLES:]
    commanded = np.concatenate([before, commanded, np.repeat(commanded[:, -1:], EXTRA_SAMPLES, 1)], 1).repeat(
        _PER_SAMPLE, 1
    )
    delay = min(drivetrain.latency / CONTROL_STEP, HISTORY_SAMPLES * _PER_SAMPLE - 1.0)
    whole = int(delay)
    share = delay - whole

    def delayed_by(steps: int) -> tuple[Array, Array]:
        arrived = commanded[:, HISTORY_SAMPLES * _PER_SAMPLE - steps :]
        begin = start
        for _ in range(_CHAIN):
            ended = _ramped(drivetrain, arrived, begin)[:, SAMPLES * _PER_SAMPLE - 1]
            begin = start.copy()
            begin[follows] = ended[follows - 1]
        return _wheel_speeds(drivetrain, _ramped(drivetrain, arrived, begin), speed)

    # Ramps are not linear in their input, so the result is interpolated between two whole delays, not the commands.
    one, other = delayed_by(whole), delayed_by(whole + 1)
    return (1 - share) * one[0] + share * other[0], (1 - share) * one[1] + share * other[1]


def _ramped(drivetrain: Drivetrain, commanded: Array, now: Array) -> Array:
    """Mean and half speeds after each step under the acceleration limits, starting from `now` (n, 2)."""
    limit = np.array([drivetrain.mean_acceleration, drivetrain.half_acceleration]) * CONTROL_STEP
    out = np.empty((len(commanded), (SAMPLES + EXTRA_SAMPLES) * _PER_SAMPLE, 2))
    for i in range(out.shape[1]):
        now = now + np.clip(commanded[:, i] - now, -limit, limit)
        out[:, i] = now
    return out


def _wheel_speeds(drivetrain: Drivetrain, ramped: Array, speed: Array) -> tuple[Array, Array]:
    """Servo targets for these mean and half speeds, and the wheel speeds that lag behind them, starting from `speed`.

    Shapes (n, steps, 2), left and right [rad/s].
    """
    targets = np.stack([ramped[..., 0] - ramped[..., 1], ramped[..., 0] + ramped[..., 1]], -1)
    targets /= np.maximum(1.0, np.abs(targets).max(-1, keepdims=True) / drivetrain.wheel_limit)
    decay = 1 - np.exp(-CONTROL_STEP / max(drivetrain.lag, 1e-6))
    lagged = np.empty_like(targets)
    for i in range(targets.shape[1]):
        lagged[:, i] = speed
        speed = speed + (targets[:, i] - speed) * decay
    return targets, lagged


def at_samples(fine: Array) -> Array:
    """Values `CONTROL_STEP` [s] apart, taken every `PERIOD` [s] of a window, shape (n, k, 2)."""
    return fine[:, : SAMPLES * _PER_SAMPLE : _PER_SAMPLE]


def fit_drivetrain(windows: Windows, params: HuskyParams) -> tuple[Drivetrain, Fit]:
    """Fits the drivetrain to a log's wheel speeds; parameters that are not identified keep the robot's values.

    Args:
        windows: All of a log; those for fitting are used.
        params: The robot that gives the defaults.
    """
    default = Drivetrain.from_robot(params, windows.twist)
    fitting = windows.fitting
    measured = windows.wheels[fitting]
    commanded = np.abs(commanded_speeds(windows)[fitting, -1])
    half = np.abs(measured[..., 1] - measured[..., 0]) / 2
    # Gains start from the wheels' final speeds, limits from their highest.
    start = {
        "mean_gain": 1.0 if windows.twist else _gain(commanded[:, 0], np.abs(measured[:, -1].mean(1))),
        "half_gain": _gain(commanded[:, 1], half[:, -1]),
        "half_limit": float(np.quantile(half, 0.95)),
        "wheel_limit": float(np.quantile(np.abs(measured), 0.98)),
        "latency": 0.1,
        "mean_acceleration": 15.0,
        "half_acceleration": 4.0,
        "lag": 0.1,
    }

    def residuals(values: dict[str, float]) -> Array:
        drivetrain = Drivetrain(**(vars(default) | values))
        return (at_samples(simulate_drivetrain(drivetrain, windows)[1]) - windows.wheels)[fitting]

    # Accelerations hardly matter at a wrong latency, so the search starts at the best of several pairs.
    tries = [start | {"latency": t, "half_acceleration": a} for t in (0.05, 0.15, 0.25, 0.4) for a in (3.0, 8.0, 30.0)]
    start = min(tries, key=lambda values: negative_log_likelihood(residuals(values), _SIDES))
    priors = {  # standard deviation, lowest, highest value, unit
        "mean_gain": (0.05 * start["mean_gain"], 0.05, 20.0, ""),
        "half_gain": (0.1 * start["half_gain"], 0.02, 20.0, ""),
        "half_limit": (0.3, 0.2, 40.0, "rad/s"),
        "wheel_limit": (0.3, 0.5, 30.0, "rad/s"),
        "latency": (0.05, 0.0, 0.9, "s"),
        "mean_acceleration": (5.0, 0.5, 200.0, "rad/s²"),
        "half_acceleration": (3.0, 0.5, 200.0, "rad/s²"),
        "lag": (0.05, 0.0, 1.0, "s"),
    }
    if windows.twist:
        del priors["mean_gain"]
    defaults = vars(default)
    table = [
        Parameter(name, None, std, low, high, defaults[name], unit, _CURES[name])
        for name, (std, low, high, unit) in priors.items()
    ]
    found = fit_parameters(table, residuals, _SIDES, windows.groups[fitting], start)
    return Drivetrain(**(defaults | found.values)), found


def _gain(x: Array, y: Array) -> float:
    """Gain y / x where no limit is active: a high quantile of the ratios at large x."""
    use = x > 0.2 * x.max(initial=0.0)
    return float(np.clip(np.quantile(y[use] / x[use], 0.8), 0.1, 5.0)) if use.any() else 1.0
