"""Skid steering in the plane, at constant speed and without MuJoCo: what the model is held against.

Words: `twin.robot`. *Quasi-static*: nothing accelerates, so friction forces and their moment balance.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from twin.mjcf.husky import wheel_centers
from twin.robot import TRACK, WHEELBASE

Array = NDArray[np.float64]


def coulomb_track_ratio(center: Array, curvature_radius: float = 0.0) -> float:
    """Quasi-static chi of four point contacts under Coulomb friction, whatever the coefficient.

    With slip velocity s at each wheel the friction force is −μN s/|s|; forces and moment about the centre of mass must
    vanish. A centred mass in a point turn gives 1 + (wheelbase / track)² exactly.

    Args:
        center: Centre of mass in the base, x and y used [m], shape (≥2,).
        curvature_radius: v / yaw rate of the mean of both sides, in units where the yaw rate of the wheels counts [m].
    """
    arm = wheel_centers()[:, :2] - np.asarray(center)[:2]
    share_x = 0.5 + np.sign(arm[:, 0]) * center[0] / WHEELBASE
    share_y = 0.5 + np.sign(arm[:, 1]) * center[1] / TRACK
    load = share_x * share_y

    def residual(unknown: Array) -> Array:
        vx, vy, chi = unknown  # body velocity at the centre of mass for unit yaw rate
        rolling = curvature_radius + np.array([-1.0, 1.0, -1.0, 1.0]) * chi * TRACK / 2
        slip = np.stack([vx - arm[:, 1] - rolling, vy + arm[:, 0]], 1)
        force = -load[:, None] * slip / np.linalg.norm(slip, axis=1, keepdims=True)
        moment = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
        return np.array([force[:, 0].sum(), force[:, 1].sum(), moment.sum()])

    solution = root(residual, np.array([curvature_radius, -center[0] * 0.5, 1.0 + (WHEELBASE / TRACK) ** 2]))
    if not solution.success:
        raise ArithmeticError(f"no quasi-static balance for a centre of mass at {center}: {solution.message}")
    return float(solution.x[2])
