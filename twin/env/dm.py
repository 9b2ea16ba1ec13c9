"""dm_control: its control loop, and its `Physics` of one Husky. Builds import neither."""

import sys
import warnings
from operator import attrgetter
from typing import Any

import mujoco

from twin.env.physics import HuskyPhysics
from twin.errors import InputError
from twin.robot import HuskyParams

try:
    with warnings.catch_warnings():
        # On import, dm_control looks for a display and warns if there is none; nothing here needs one.
        warnings.simplefilter("ignore")
        from dm_control import mujoco as dm_mujoco
        from dm_control.mujoco import wrapper
        from dm_control.rl import control
except ModuleNotFoundError as error:
    raise InputError(
        f"{error}: driving in a scene needs dm_control, which installs on Python 3.11 and 3.12; this is "
        f"{sys.version_info.major}.{sys.version_info.minor}"
    ) from None

__all__ = ["DrivePhysics", "control"]


class DrivePhysics(dm_mujoco.Physics):
    """A dm_control Physics of one robot in one episode's model, with the quantities of `HuskyPhysics`."""

    _params = HuskyParams()

    @staticmethod
    def of(model: mujoco.MjModel, params: HuskyParams) -> "DrivePhysics":
        """Returns physics of a model that `episode_spec` made for a robot; keeps the model, without a copy."""
        physics = DrivePhysics(wrapper.MjData(wrapper.MjModel(model)))
        physics.set_robot(params)
        return physics

    def _reload_from_data(self, data: Any) -> None:
        mujoco.mj_forward(data.model.ptr, data.ptr)
        # Before super(), which ends with `after_reset`.
        self.robot = HuskyPhysics(data.model.ptr, self._params, data.ptr)
        super()._reload_from_data(data)

    def set_robot(self, params: HuskyParams) -> None:
        """Replaces the robot's controller and latencies; drops pending commands."""
        move_obstacles = self.robot.move_obstacles
        self._params = params
        self.robot = HuskyPhysics(self.model.ptr, params, self.data.ptr)
        self.robot.move_obstacles = move_obstacles

    def copy(self, share_model: bool = False) -> "DrivePhysics":
        physics = super().copy(share_model)
        physics.set_robot(self._params)
        return physics

    def __getstate__(self) -> Any:
        return self.data, self._params

    def __setstate__(self, state: Any) -> None:
        data, self._params = state
        super().__setstate__(data)

    def after_reset(self) -> None:
        super().after_reset()
        self.robot.begin()

    def step(self, nstep: int = 1) -> None:
        """Runs `nstep` substeps, the time between two commands."""
        with self.check_invalid_state():
            self.robot.step(nstep * self.timestep())

    # Quantities of `HuskyPhysics`; the camera's pose is that of the newest image.
    planar_pose = property(attrgetter("robot.planar_pose"))
    base_to_world = property(attrgetter("robot.base_to_world"))
    delayed_data = property(attrgetter("robot.delayed_data"))
    camera_to_world = property(attrgetter("robot.delayed_camera_to_world"))
    speed = property(attrgetter("robot.speed"))
    yaw_rate = property(attrgetter("robot.yaw_rate"))
    uprightness = property(attrgetter("robot.uprightness"))
    touched = property(attrgetter("robot.touched"))
