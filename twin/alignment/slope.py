"""How the ground slopes under a drive, from the log's own accelerometer.

At rest an accelerometer reads gravity upside down; tyres that scrub sideways over soft ground slide downhill by more
than a good model's error, so a log on real ground is fitted with the slope it was driven on. Two seconds of a rattling
robot tell it badly, but the next two are on nearly the same ground: from window to window the slope forgets itself at a
steady rate (a first-order autoregression), a window's reading adds noise, and a Kalman smoother (Rauch, Tung and
Striebel 1965) weighs all that follow each other. How steep the ground is, for how long, and how noisy the readings are
is what makes the log's own readings most likely, so that slopes of a rough IMU shrink towards level ground. What is
constant in the robot's own frame (the IMU's mounting, a pitched chassis) is taken off by the median over the log.

Only headings and speeds reckoned from wheels (`kinematics.Icr`) are used to turn accelerations into one frame and to
take the motion's own off: never the poses that are to be predicted.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from twin.alignment.kinematics import Icr, integrate
from twin.alignment.logs import PERIOD, Windows

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
"""Gravity along x, and along y as the imaginary part [m/s²]."""

GRAVITY = 9.81  # [m/s²]
STEEPEST = 0.2  # of gravity; a reading of more than 11° is rather a bump or a glitch


@dataclass(frozen=True)
class Terrain:
    """What slopes are like, along x and along y alike."""

    steepness: float
    """[m/s²], standard deviation."""
    windows: float
    """After how many of them a slope has forgotten itself but for 1 / e."""
    noise: float
    """Of a window's reading [m/s²], standard deviation."""


_USUAL = Terrain(0.25, 5.0, 0.25)  # gentle: 1.5°
_DOUBT = 1.0  # standard deviation of the logarithms of those three, before any log
_RANGE = 1e-3, 1e3  # of each, so that readings without any noise do no harm


def gravity(windows: Windows, model: Icr) -> Array:
    """Gravity along x and y [m/s²] of the robot where each window's `Windows.before` begins, shape (n, 2).

    Zeros without accelerations.
    """
    if windows.acceleration is None:
        return np.zeros((len(windows), 2))
    motion = model.motion(windows.wheels)
    turned = integrate(motion)[..., 2]
    yaw, turn = turned[:, :-1], turned[:, -1]
    own = np.stack([np.gradient(motion[..., 0], PERIOD, axis=1), motion[..., 0] * motion[..., 2]], -1)
    down = -(windows.acceleration - own)
    down = down - np.median(down.mean(1), axis=0)
    readings = ((down[..., 0] + 1j * down[..., 1]) * np.exp(1j * yaw)).mean(1)
    readings *= np.minimum(1.0, STEEPEST * GRAVITY / np.maximum(np.abs(readings), 1e-9))
    slopes, _ = smoothed(terrain(readings, turn, windows.follows), readings, turn, windows.follows)
    slopes *= np.exp(1j * model.motion(windows.before[:, :-1])[..., 2].sum(1) * PERIOD)
    return np.stack([slopes.real, slopes.imag], -1)


def terrain(readings: Complex, turn: Array, follows: NDArray[np.bool_]) -> Terrain:
    """The terrain that makes a log's readings most likely, beside what is usual.

    Args:
        readings: Of every window's slope, in the frame of its first pose, shape (n,).
        turn: What each window turns by [rad], shape (n,).
        follows: Of `Windows`, shape (n,).
    """
    usual = np.log([_USUAL.steepness, _USUAL.windows, _USUAL.noise])

    def unlikely(logs: Array) -> float:
        _, cost = smoothed(Terrain(*np.exp(logs).tolist()), readings, turn, follows)
        return cost + float((((logs - usual) / _DOUBT) ** 2).sum()) / 2

    options = {"xatol": 0.01, "fatol": 0.01}
    found = minimize(unlikely, usual, method="Nelder-Mead", bounds=[tuple(np.log(_RANGE))] * 3, options=options)
    return Terrain(*np.exp(found.x).tolist())


def smoothed(terrain_: Terrain, readings: Complex, turn: Array, follows: NDArray[np.bool_]) -> tuple[Complex, float]:
    """Every window's slope given all readings, shape (n,), and minus the logarithm of the readings' likelihood.

    For the arguments see `terrain`.
    """
    n, prior, noise = len(readings), terrain_.steepness**2, terrain_.noise**2
    keep = np.exp(-1 / terrain_.windows)
    guess, unsure = np.zeros(n, complex), np.full(n, prior)  # by the windows before
    slope, left = np.zeros(n, complex), np.zeros(n)  # by these and its own reading
    cost = 0.0
    for i in range(n):
        if i and follows[i]:
            guess[i] = keep * slope[i - 1] * np.exp(-1j * turn[i - 1])
            unsure[i] = keep**2 * left[i - 1] + (1 - keep**2) * prior
        spread, off = unsure[i] + noise, readings[i] - guess[i]
        slope[i] = guess[i] + unsure[i] / spread * off
        left[i] = unsure[i] * noise / spread
        cost += np.log(2 * np.pi * spread) + abs(off) ** 2 / (2 * spread)
    for i in range(n - 2, -1, -1):
        if follows[i + 1]:
            back = keep * left[i] / unsure[i + 1]
            slope[i] += back * np.exp(1j * turn[i]) * (slope[i + 1] - guess[i + 1])
    return slope, float(cost)
