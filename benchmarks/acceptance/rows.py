"""`Row`, a measured value with its limits, and `Subject`, the robot that is measured."""

from dataclasses import dataclass, field, replace
from typing import Any

import mujoco

from acceptance.drives import Edit, Recording, drive, on_plane
from twin.robot import CHASSIS_MASS, WHEEL_MASS, HuskyParams

GRAVITY = 9.81  # [m/s²]
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
