"""Acceptance table of the Husky model: measured values with limits, and wrong models that must exceed these limits.

*Subject*: the robot that is measured, correct or deliberately wrong. *Edit*: a change to the `MjSpec` before it is
compiled, which makes a wrong model. *Chi*: track ratio, the effective track divided by the geometric one. Letters of
the row ids: A composition, B scrubbing on a plane, C static friction and stalling, D driving, E ground from the
pipeline, P convex parts. Read chi together with B4 to B6: a hopping model can have a plausible chi, and a model with a
pyramidal friction cone has the right chi with a torque 23 % too low.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import mujoco

from acceptance.drives import Edit, Recording, drive, on_plane
from twin.robot import CHASSIS_MASS, WHEEL_MASS, HuskyParams

GRAVITY = 9.81  # [m/s²]
REAR_HEAVY = (-0.085, -0.00065, 0.062)
"""The published center of mass of the chassis, with x and y exchanged [m]."""
MASS = CHASSIS_MASS + 4 * WHEEL_MASS  # [kg] without payload


@dataclass(frozen=True)
class Row:
    """A measured value and its limits."""

    id: str
    quantity: str
    value: float
    low: float
    high: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        return bool(self.low <= self.value <= self.high)  # NaN fails


@dataclass(frozen=True)
class Subject:
    """A robot to measure."""

    params: HuskyParams = field(default_factory=HuskyParams)
    edit: Edit | None = None
    """Change that makes the model wrong; None for a correct one."""

    def plane(self, **changes: Any) -> mujoco.MjModel:
        """Model on a plane with changed parameters."""
        return on_plane(replace(self.params, **changes), self.edit)

    def turn(
        self, yaw_rate: float = 1.0, v: float = 0.0, skip: float = 1.5, seconds: float = 1.0, **changes: Any
    ) -> Recording:
        """Turns on a plane at ω [rad/s] and v [m/s] with changed parameters; records `seconds` after `skip` [s]."""
        return drive(self.plane(**changes), v, yaw_rate, skip, seconds, replace(self.params, **changes))
