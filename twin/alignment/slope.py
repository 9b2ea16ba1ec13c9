"""How the ground slopes under a drive, from the log's own accelerometer.

At rest an accelerometer reads gravity upside down; tyres that scrub sideways over soft ground slide downhill by more
than a good model's error, so a log on real ground is fitted with the slope it was driven on. Two seconds of a rattling
robot tell it badly, so windows that follow each other are averaged, weights falling by `FADE` per window. What is
constant in the robot's own frame (the IMU's mounting, a pitched chassis) is taken off by the median over the log.

Only headings and speeds reckoned from wheels (`kinematics.Icr`) are used to turn accelerations into one frame and to
take the motion's own off: never the poses that are to be predicted.
"""

import numpy as np
from numpy.typing import NDArray

from twin.alignment.kinematics import Icr, predict
from twin.alignment.logs import PERIOD, Windows

Array = NDArray[np.float64]

GRAVITY = 9.81  # [m/s²]
FADE = 0.8  # weight of a window against that of one nearer by one
REACH = 4  # windows to either side
STEEPEST = 0.2  # of gravity; more than 11° is rather a bump that lasted


def gravity(windows: Windows, model: Icr) -> Array:
    """Gravity along x and y of each window's first pose [m/s²], shape (n, 2); zeros without accelerations."""
    if windows.acceleration is None:
        return np.zeros((len(windows), 2))
    poses = predict(model, windows)
    yaw = poses[:, : windows.wheels.shape[1], 2]
    motion = model.motion(windows.wheels)
    own = np.stack([np.gradient(motion[..., 0], PERIOD, axis=1), motion[..., 0] * motion[..., 2]], -1)
    down = -(windows.acceleration - own)
    down = down - np.median(down.mean(1), axis=0)
    turned = ((down[..., 0] + 1j * down[..., 1]) * np.exp(1j * yaw)).mean(1)
    averaged = _averaged(turned, poses[:, windows.wheels.shape[1], 2], windows.follows)
    steep = np.minimum(1.0, STEEPEST * GRAVITY / np.maximum(np.abs(averaged), 1e-9))
    return np.stack([averaged.real, averaged.imag], -1) * steep[:, None]


def _averaged(vector: NDArray, turn: Array, follows: NDArray[np.bool_]) -> NDArray:
    """Each window's vector (x + iy) with its neighbours', in its own frame; `turn` [rad] is made within a window."""
    out = np.empty_like(vector)
    for i in range(len(vector)):
        total, weight = vector[i], 1.0
        angle = 0.0
        for j in range(1, REACH + 1):
            if i + j >= len(vector) or not follows[i + j]:
                break
            angle += turn[i + j - 1]
            total, weight = total + FADE**j * vector[i + j] * np.exp(1j * angle), weight + FADE**j
        angle = 0.0
        for j in range(1, REACH + 1):
            if i - j < 0 or not follows[i - j + 1]:
                break
            angle -= turn[i - j]
            total, weight = total + FADE**j * vector[i - j] * np.exp(1j * angle), weight + FADE**j
        out[i] = total / weight
    return out
