"""Reality's own Husky: what the training side is not told, drawn once.

Every value is uniform in the range stated here, from a fixed seed, and stays the same through all trials and the drive
log, as one robot's would. What is printed on the robot (its controller's limits, its track) is as published.
"""

from dataclasses import dataclass

import numpy as np

from twin.env.camera_effects import CameraOptions
from twin.reality.film import Plan
from twin.reality.things import SEED
from twin.robot import WHEEL_RADIUS, HuskyParams


@dataclass(frozen=True)
class Robot:
    """One Husky with its front camera."""

    params: HuskyParams
    camera_turn: tuple[float, float, float]
    """By which the camera is mounted askew, about its axes right, up, back [°]."""
    camera: CameraOptions
    """Vibration and shutter; exposure is `exposure_drift`, for it acts on light and not on a finished picture."""
    exposure_drift: float
    """Standard deviation of the logarithm of the exposure."""


def robot() -> Robot:
    """The one there is."""
    rng = np.random.default_rng([SEED, 41])

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    radius = WHEEL_RADIUS * between(0.975, 1.0)
    film = Plan()
    zoom = between(0.985, 1.015)
    fx, fy, cx, cy = film.intrinsics.tolist()
    params = HuskyParams(
        center_of_mass=(between(-0.05, 0.0), between(-0.01, 0.01), 0.062),
        payload_mass=between(6.0, 14.0),
        payload_position=(between(-0.10, 0.10), between(-0.04, 0.04), 0.33),
        friction=between(0.55, 0.9),
        rolling_resistance=between(0.015, 0.03),
        wheel_radius=(radius * between(0.996, 1.004), radius * between(0.996, 1.004)),
        servo_lag=between(0.05, 0.12),
        motor_torque=between(50.0, 65.0),
        command_latency=between(0.03, 0.08),
        camera_height=0.6 + between(-0.015, 0.015),
        camera_offset=(0.36 + between(-0.02, 0.02), between(-0.015, 0.015)),
        camera_pitch=5.0 + between(-0.8, 0.8),
        camera_latency=between(0.04, 0.09),
        camera_intrinsics=(fx * zoom, fy * zoom, cx + between(-4.0, 4.0), cy + between(-4.0, 4.0)),
        camera_size=(film.width, film.height),
    )
    turn = (between(-0.4, 0.4), between(-0.6, 0.6), between(-0.6, 0.6))
    camera = CameraOptions(vibration=between(0.15, 0.35), shutter=between(0.008, 0.02))
    return Robot(params, turn, camera, between(0.06, 0.12))
