"""Drivetrain model, fitted to a log: how the robot's controller and servos turn commands into wheel speeds.

The model applies the limits of `twin.env.controller` to many windows of a log at once. Its step is 0.01 s instead of
0.1 s, so that wheel speeds are smooth functions of its parameters. (A real controller reacts up to one period late, but
then makes the whole change of a period in one step. On average, the two effects cancel.) *Mean speed* is the mean of
the two sides' wheel speeds [rad/s], *half speed* is half of right minus left. Each of the two has a gain, since wheel
commands may be in units of another robot (the public DRIVE log assumes a Husky with wheels of 0.3 m). For commands v
and ω, the gain of the mean speed is 1, and that of the half speed is the controller's separation multiplier.
"""

from dataclasses import dataclass, replace

import numpy as np

from twin.env.controller import limit_change, limit_sides
from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.sysid.estimation import Fit, Kinds, Parameter, fit_parameters, negative_log_likelihood
from twin.sysid.logs import PERIOD, SAMPLES, Windows
from twin.types import Array

CONTROL_STEP = 0.01  # [s] between two servo targets
EXTRA_SAMPLES = 5  # samples after a window's end, for poses measured after it

_HISTORY = 20  # samples of the previous window from which delayed commands are taken
_CHAIN = 3  # number of previous windows over which a ramp is simulated: six seconds
_PER_SAMPLE = round(PERIOD / CONTROL_STEP)
_LIMITS = {"mean_limit": "max_speed", "half_limit": "max_yaw_rate", "wheel_limit": "max_wheel_speed"}  # → `HuskyParams`
_LIMIT_NATS = 3.0  # [nat] least loss of a log's likelihood without a limit from which the limit counts as reached
_HELD = 0.9  # quantile of a window's speeds: the highest speed that the robot held for 0.2 s
_EXCEEDED = 1.05  # a speed / the robot's limit above which the log contradicts the limit
_SIDES: Kinds = (0, 0)  # residuals of the left and the right wheels [rad/s]


@dataclass(frozen=True)
class Drivetrain:
    """Parameters of the controller and the servos: limits [rad/s], accelerations [rad/s²], latency and lag [s]."""

    mean_gain: float
    half_gain: float
    mean_limit: float
    """Infinite if commands are wheel speeds, which bypass this limit."""
    half_limit: float
    wheel_limit: float
    latency: float
    mean_acceleration: float
    half_acceleration: float
    lag: float

    @staticmethod
    def from_robot(params: HuskyParams, twist: bool) -> "Drivetrain":
        """The drivetrain of a robot; commands are v and ω if `twist`, else wheel speeds."""
        half = params.separation_multiplier * TRACK / 2 / WHEEL_RADIUS
        return Drivetrain(
            1.0,
            params.separation_multiplier if twist else 1.0,
            params.max_speed / WHEEL_RADIUS if twist else np.inf,
            params.max_yaw_rate * half,
            params.max_wheel_speed / WHEEL_RADIUS,
            params.command_latency,
            params.max_acceleration / WHEEL_RADIUS,
            params.max_yaw_acceleration * half,
            params.servo_lag,
        )

    def robot_fields(self, params: HuskyParams, twist: bool) -> dict[str, float]:
        """Converts the drivetrain to fields of `HuskyParams`.

        If commands are wheel speeds (not `twist`), separation multiplier and top speed are copied from `params`.
        """
        multiplier = self.half_gain if twist else params.separation_multiplier
        half = multiplier * TRACK / 2 / WHEEL_RADIUS
        return {
            "separation_multiplier": multiplier,
            "max_speed": self.mean_limit * WHEEL_RADIUS if twist else params.max_speed,
            "max_yaw_rate": self.half_limit / half,
            "max_wheel_speed": self.wheel_limit * WHEEL_RADIUS,
            "command_latency": self.latency,
            "max_acceleration": self.mean_acceleration * WHEEL_RADIUS,
            "max_yaw_acceleration": self.half_acceleration / half,
            "servo_lag": self.lag,
        }


def simulate_drivetrain(drivetrain: Drivetrain, windows: Windows) -> tuple[Array, Array]:
    """Servo targets and the resulting wheel speeds, starting from each window's first wheel speeds.

    A window that follows the previous one begins with the previous window's delayed commands and continues its
    acceleration ramp. The measured wheel speeds do not show how far the ramp has come, since they lag behind it. In all
    other windows, the wheels keep their speed until the first command arrives.

    Returns:
        Targets and lagged wheel speeds, left and right [rad/s], each of shape (n, (k + EXTRA_SAMPLES) · 5, 2),
        `CONTROL_STEP` [s] apart.
    """
    gains = np.array([drivetrain.mean_gain, drivetrain.half_gain])
    limits = np.array([drivetrain.mean_limit, drivetrain.half_limit])
    commanded = np.clip(windows.commanded_speeds * gains, -limits, limits)
    speed = windows.wheels[:, 0]
    start = np.stack([speed.mean(1), (speed[:, 1] - speed[:, 0]) / 2], -1)
    before = np.repeat(start[:, None], _HISTORY, 1)
    follows = np.flatnonzero(windows.follows)
    before[follows] = commanded[follows - 1, -_HISTORY:]
    after = np.repeat(commanded[:, -1:], EXTRA_SAMPLES, 1)
    commanded = np.concatenate([before, commanded, after], 1).repeat(_PER_SAMPLE, 1)
    delay = min(drivetrain.latency / CONTROL_STEP, _HISTORY * _PER_SAMPLE - 1.0)
    whole = int(delay)
    share = delay - whole

    def delayed_by(steps: int) -> tuple[Array, Array]:
        arrived = commanded[:, _HISTORY * _PER_SAMPLE - steps :]
        begin = start
        for _ in range(_CHAIN):
            ended = _ramped(drivetrain, arrived, begin)[:, SAMPLES * _PER_SAMPLE - 1]
            begin = start.copy()
            begin[follows] = ended[follows - 1]
        return _wheel_speeds(drivetrain, _ramped(drivetrain, arrived, begin), speed)

    # If the delay is not a whole number of steps, the results for the two nearest whole numbers are interpolated.
    # Delayed commands are not interpolated, because ramps are not linear in their input.
    one, other = delayed_by(whole), delayed_by(whole + 1)
    return (1 - share) * one[0] + share * other[0], (1 - share) * one[1] + share * other[1]


def _ramped(drivetrain: Drivetrain, commanded: Array, now: Array) -> Array:
    """Mean and half speeds after each step under the acceleration limits, starting from `now` (n, 2)."""
    limit = np.array([drivetrain.mean_acceleration, drivetrain.half_acceleration]) * CONTROL_STEP
    out = np.empty((len(commanded), (SAMPLES + EXTRA_SAMPLES) * _PER_SAMPLE, 2))
    for i in range(out.shape[1]):
        out[:, i] = now = limit_change(commanded[:, i], now, limit)
    return out


def _wheel_speeds(drivetrain: Drivetrain, ramped: Array, speed: Array) -> tuple[Array, Array]:
    """Converts mean and half speeds (n, steps, 2) to servo targets and to wheel speeds that lag behind the targets.

    The wheel speeds start at `speed` (n, 2). Both results are left and right [rad/s], shape (n, steps, 2).
    """
    sides = np.stack([ramped[..., 0] - ramped[..., 1], ramped[..., 0] + ramped[..., 1]], -1)
    targets = limit_sides(sides, drivetrain.wheel_limit)
    decay = 1 - np.exp(-CONTROL_STEP / max(drivetrain.lag, 1e-6))
    lagged = np.empty_like(targets)
    for i in range(targets.shape[1]):
        lagged[:, i] = speed
        speed = speed + (targets[:, i] - speed) * decay
    return targets, lagged


def at_samples(fine: Array) -> Array:
    """Picks a value every `PERIOD` [s] from values `CONTROL_STEP` [s] apart; the result has shape (n, k, 2)."""
    return fine[:, : SAMPLES * _PER_SAMPLE : _PER_SAMPLE]


def fit_drivetrain(windows: Windows, params: HuskyParams) -> tuple[Drivetrain, Fit]:
    """Fits the drivetrain to a log's wheel speeds; parameters that are not identified keep the values of `params`.

    A limit is identified only if the log contradicts a drivetrain without it (`_LIMIT_NATS`). Otherwise the fit would
    take the largest command for a limit. A limit that the log exceeds is raised for the fit of the others.
    """
    default = Drivetrain.from_robot(params, windows.twist)
    fitting = windows.fitting
    measured = windows.wheels[fitting]
    commanded = np.abs(windows.commanded_speeds[fitting, -1])
    mean, half = np.abs(measured.mean(2)), np.abs(measured[..., 1] - measured[..., 0]) / 2
    # Initial gains come from the windows' final wheel speeds, initial limits from the highest speeds.
    start = {
        "mean_gain": 1.0 if windows.twist else _gain(commanded[:, 0], np.abs(measured[:, -1].mean(1))),
        "half_gain": _gain(commanded[:, 1], half[:, -1]),
        "mean_limit": float(np.quantile(mean, 0.98)),
        "half_limit": float(np.quantile(half, 0.95)),
        "wheel_limit": float(np.quantile(np.abs(measured), 0.98)),
        "latency": 0.1,
        "mean_acceleration": 15.0,
        "half_acceleration": 4.0,
        "lag": 0.1,
    }
    # Speeds held for a while: a wrong sample of an encoder exceeds no limit.
    held = (np.quantile(x, _HELD, 1).max() for x in (mean, half, np.abs(measured).max(2)))
    highest = dict(zip(_LIMITS, map(float, held), strict=True))
    exceeded = {
        name: f"; {field} = {getattr(params, field):g} is kept, which the log exceeds, so raise it in [robot]"
        for name, field in _LIMITS.items()
        if highest[name] > _EXCEEDED * getattr(default, name)
    }
    default = replace(default, **{name: highest[name] for name in exceeded})

    def residuals(values: dict[str, float]) -> Array:
        lagged = simulate_drivetrain(replace(default, **values), windows)[1]
        return (at_samples(lagged) - windows.wheels)[fitting]

    def cost(values: dict[str, float]) -> float:
        return negative_log_likelihood(residuals(values), _SIDES)

    # At a wrong latency, accelerations hardly change the residuals. So the search starts at the best of several pairs
    # of latency and acceleration.
    tries = [start | {"latency": t, "half_acceleration": a} for t in (0.05, 0.15, 0.25, 0.4) for a in (3.0, 8.0, 30.0)]
    start = min(tries, key=cost)
    table = [
        Parameter(name, None, std, low, high, getattr(default, name), unit, cure + exceeded.get(name, ""))
        for name, std, low, high, unit, cure in (
            ("mean_gain", 0.05 * start["mean_gain"], 0.05, 20.0, "", "driving straight at several speeds"),
            ("half_gain", 0.1 * start["half_gain"], 0.02, 20.0, "", "turns of several strengths"),
            ("mean_limit", 0.3, 0.2, 30.0, "rad/s", "commands beyond the top speed"),
            ("half_limit", 0.3, 0.2, 40.0, "rad/s", "turns on the spot at full command"),
            ("wheel_limit", 0.3, 0.5, 30.0, "rad/s", "full speed and a turn at once"),
            ("latency", 0.05, 0.0, 0.9, "s", "sudden changes of command"),
            ("mean_acceleration", 5.0, 0.5, 200.0, "rad/s²", "sudden starts and stops"),
            ("half_acceleration", 3.0, 0.5, 200.0, "rad/s²", "sudden turns at full command"),
            ("lag", 0.05, 0.0, 1.0, "s", "sudden changes of command"),
        )
        if name != ("mean_gain" if windows.twist else "mean_limit")
    ]
    refused: dict[str, str] = {}
    while True:  # each round has fewer parameters
        found = fit_parameters(table, residuals, _SIDES, windows.groups[fitting], start)
        least = cost(found.values) + _LIMIT_NATS / len(measured)
        idle = [
            p for p in table if p.name in {*_LIMITS} & {*found.errors} and cost(found.values | {p.name: np.inf}) < least
        ]
        if not idle:
            return replace(default, **found.values), replace(found, refused=refused | found.refused)
        for p in idle:
            table.remove(p)
            refused[p.name] = f"{p.name} = {p.default:.4g} {p.unit}: the log does not reach this limit; needs {p.cure}"
        start = found.values


def _gain(x: Array, y: Array) -> float:
    """Gain y / x where no limit is active: a high quantile of the ratios at large x."""
    use = x > 0.2 * x.max(initial=0.0)
    return float(np.clip(np.quantile(y[use] / x[use], 0.8), 0.1, 5.0)) if use.any() else 1.0
