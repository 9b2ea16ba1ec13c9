"""What a row of the acceptance table is, and what it is measured on.

A *row* is one number and the limits it must keep. A *subject* is a robot, right or deliberately wrong.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import mujoco

from twin.env.acceptance.drive import Edit, Recording, drive, on_plane
from twin.robot import CHASSIS_MASS, WHEEL_MASS, HuskyParams

GRAVITY = 9.81  # [m/s²]
MASS = CHASSIS_MASS + 4 * WHEEL_MASS  # [kg] without payload


@dataclass(frozen=True)
class Row:
    """One measured number."""

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
    """Makes the model a wrong one."""

    def plane(self, **changes: Any) -> mujoco.MjModel:
        """On a plane, some parameters changed."""
        return on_plane(replace(self.params, **changes), self.edit)

    def turn(
        self, yaw_rate: float = 1.0, v: float = 0.0, skip: float = 1.5, seconds: float = 1.0, **changes: Any
    ) -> Recording:
        """Turning on a plane: ω [rad/s], v [m/s], `seconds` recorded after `skip` [s], some parameters changed."""
        return drive(self.plane(**changes), v, yaw_rate, skip, seconds, replace(self.params, **changes))
