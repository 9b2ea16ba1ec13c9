"""From commands to wheel speeds: the robot's controller and servo as twelve lines of arithmetic, fitted to a log.

The same rules as `twin.env.controller`, but for many windows at once and smooth in its parameters: the limits of
acceleration are ramps rather than steps every 0.1 s (the controller's waiting for its next period and its stepping
ahead cancel on average). *Mean* and *half* speed: of the two sides, and half their difference [rad/s at the wheels].
A log's commands may be another robot's wheel speeds: DRIVE's count on wheels of 0.3 m under a Husky. So wheel commands
have a gain for the mean and one for the half speed; with commands v and ω the first is known and the second is the
controller's separation multiplier.
"""

from dataclasses import astuple, dataclass

import numpy as np

from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.sysid.estimation import Fit, Kinds, Parameter, fit, negative_log_likelihood
from twin.sysid.logs import PERIOD, SAMPLES, Windows
from twin.types import Array

STEP = 0.01  # [s] of the arithmetic
HISTORY = 20  # samples of the window before that late commands are taken from
AHEAD = 5  # samples beyond a window's end, for poses that were measured later than the log says

_CHAIN = 3  # windows before one whose commands a ramp is followed through: six seconds
_PER_SAMPLE = round(PERIOD / STEP)
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
_SIDES: Kinds = (0, 0)  # of the misses of the left and of the right wheels [rad/s]


@dataclass(frozen=True)
class Drivetrain:
    """What lies between commands and wheel speeds, in the wheels' units."""

    mean_gain: float
    half_gain: float
    half_limit: float
    """[rad/s]"""
    wheel_limit: float
    """[rad/s] beyond it both sides slow down alike."""
    latency: float
    """[s]"""
    mean_acceleration: float
    """[rad/s²]"""
    half_acceleration: float
    """[rad/s²]"""
    lag: float
    """[s]"""

    @staticmethod
    def of(params: HuskyParams, twist: bool) -> "Drivetrain":
        """The drive of a robot whose commands are v and ω (`twist`) or its own wheel speeds."""
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

    def robot(self, params: HuskyParams, twist: bool) -> dict[str, float]:
        """The values of `HuskyParams` these are; a robot commanded in wheel speeds keeps its separation multiplier."""
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


def requested(windows: Windows) -> Array:
    """Mean and half speed that the commands ask for, before gains [rad/s], shape (n, k, 2)."""
    a, b = windows.commands[..., 0], windows.commands[..., 1]
    if windows.twist:
        return np.stack([a, b * TRACK / 2], -1) / WHEEL_RADIUS
    return np.stack([a + b, b - a], -1) / 2


def targets(drive: Drivetrain, windows: Windows) -> tuple[Array, Array]:
    """What the servo is told, and the wheel speeds that come of it, from the wheel speeds each window starts with.

    Where a window follows others, commands still under way at its start are theirs, and so is how far the acceleration
    limits have let the controller come by then, which lagging wheels do not show. Else the wheels go on as
    they are until the first command has arrived.

    Returns:
        Speeds left and right [rad/s], shape (n, (k + AHEAD) · 5, 2), `STEP` [s] apart; and as long the lagged ones.
    """
    gains = np.array([drive.mean_gain, drive.half_gain])
    wanted = requested(windows) * gains
    wanted[..., 1] = np.clip(wanted[..., 1], -drive.half_limit, drive.half_limit)
    speed = windows.wheels[:, 0]
    start = np.stack([speed.mean(1), (speed[:, 1] - speed[:, 0]) / 2], -1)
    before = np.repeat(start[:, None], HISTORY, 1)
    follows = np.flatnonzero(windows.follows)
    before[follows] = wanted[follows - 1, -HISTORY:]
    wanted = np.concatenate([before, wanted, np.repeat(wanted[:, -1:], AHEAD, 1)], 1).repeat(_PER_SAMPLE, 1)
    delay = min(drive.latency / STEP, HISTORY * _PER_SAMPLE - 1.0)
    whole = int(delay)
    share = delay - whole

    def carried_out(late: int) -> tuple[Array, Array]:
        arrived = wanted[:, HISTORY * _PER_SAMPLE - late :]
        begin = start
        for _ in range(_CHAIN):
            ended = _ramped(drive, arrived, begin)[:, SAMPLES * _PER_SAMPLE - 1]
            begin = start.copy()
            begin[follows] = ended[follows - 1]
        return _turned(drive, _ramped(drive, arrived, begin), speed)

    # A ramp does not care for the size of what it is told, so the outcome must be blended between two delays instead.
    one, other = carried_out(whole), carried_out(whole + 1)
    return (1 - share) * one[0] + share * other[0], (1 - share) * one[1] + share * other[1]


def _ramped(drive: Drivetrain, wanted: Array, now: Array) -> Array:
    """Mean and half speeds that the acceleration limits make of those wanted, after each step, from those now (n, 2).

    Shape (n, (k + AHEAD) · 5, 2).
    """
    most = np.array([drive.mean_acceleration, drive.half_acceleration]) * STEP
    out = np.empty((len(wanted), (SAMPLES + AHEAD) * _PER_SAMPLE, 2))
    for i in range(out.shape[1]):
        now = now + np.clip(wanted[:, i] - now, -most, most)
        out[:, i] = now
    return out


def _turned(drive: Drivetrain, ramped: Array, speed: Array) -> tuple[Array, Array]:
    """What servos are told for these mean and half speeds, and what wheels make of it that lag and begin at `speed`.

    Shapes (n, steps, 2), left and right.
    """
    told = np.stack([ramped[..., 0] - ramped[..., 1], ramped[..., 0] + ramped[..., 1]], -1)
    told /= np.maximum(1.0, np.abs(told).max(-1, keepdims=True) / drive.wheel_limit)
    decay = 1 - np.exp(-STEP / max(drive.lag, 1e-6))
    lagged = np.empty_like(told)
    for i in range(told.shape[1]):
        lagged[:, i] = speed
        speed = speed + (told[:, i] - speed) * decay
    return told, lagged


def sampled(fine: Array) -> Array:
    """Every `PERIOD` [s] of a window from what is `STEP` [s] apart: shape (n, k, 2)."""
    return fine[:, : SAMPLES * _PER_SAMPLE : _PER_SAMPLE]


def fit_drive(windows: Windows, params: HuskyParams) -> tuple[Drivetrain, Fit]:
    """The drive that explains a log's wheel speeds; parameters it does not show stay as they are.

    Args:
        windows: All of a log; fitted are those for fitting.
        params: Where to start, and what is kept of what cannot be told.
    """
    given = Drivetrain.of(params, windows.twist)
    fitting = windows.fitting
    measured = windows.wheels[fitting]
    asked = np.abs(requested(windows)[fitting, -1])
    half = np.abs(measured[..., 1] - measured[..., 0]) / 2
    # Gains start from how fast the wheels end up, limits from the fastest there was.
    start = {
        "mean_gain": 1.0 if windows.twist else _slope(asked[:, 0], np.abs(measured[:, -1].mean(1))),
        "half_gain": _slope(asked[:, 1], half[:, -1]),
        "half_limit": float(np.quantile(half, 0.95)),
        "wheel_limit": float(np.quantile(np.abs(measured), 0.98)),
        "latency": 0.1,
        "mean_acceleration": 15.0,
        "half_acceleration": 4.0,
        "lag": 0.1,
    }

    def missed(values: dict[str, float]) -> Array:
        drive = Drivetrain(**(_asdict(given) | values))
        return (sampled(targets(drive, windows)[1]) - windows.wheels)[fitting]

    # Far from its latency a log hardly shows its accelerations, so the search begins at the best of a few.
    tries = [start | {"latency": t, "half_acceleration": a} for t in (0.05, 0.15, 0.25, 0.4) for a in (3.0, 8.0, 30.0)]
    start = min(tries, key=lambda values: negative_log_likelihood(missed(values), _SIDES))
    spans = {  # span, lowest, highest value, unit
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
        del spans["mean_gain"]
    usual = _asdict(given)
    table = [
        Parameter(name, None, span, low, high, usual[name], unit, _CURES[name])
        for name, (span, low, high, unit) in spans.items()
    ]
    found = fit(table, missed, _SIDES, windows.groups[fitting], start)
    return Drivetrain(**(usual | found.values)), found


def _slope(x: Array, y: Array) -> float:
    """The largest common ratio y / x: the median of those that no limit holds down."""
    use = x > 0.2 * x.max(initial=0.0)
    return float(np.clip(np.quantile(y[use] / x[use], 0.8), 0.1, 5.0)) if use.any() else 1.0


def _asdict(drive: Drivetrain) -> dict[str, float]:
    return dict(zip(Drivetrain.__dataclass_fields__, astuple(drive), strict=True))
