"""The robot as dm_control sees it: a `dm_control.mujoco.Physics` whose named quantities are those of `HuskyPhysics`."""

import warnings
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

with warnings.catch_warnings():
    # dm_control looks for a display when it is imported, and complains where there is none; nothing here needs one.
    warnings.simplefilter("ignore")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco import wrapper

from twin.env.physics import HuskyPhysics
from twin.robot import HuskyParams

Array = NDArray[np.float64]


class DrivePhysics(dm_mujoco.Physics):
    """One robot in one episode's model."""

    _params = HuskyParams()

    @staticmethod
    def of(model: mujoco.MjModel, params: HuskyParams) -> "DrivePhysics":
        """Physics of a model that `episode_spec` made for a robot; the model is kept, not copied."""
        physics = DrivePhysics(wrapper.MjData(wrapper.MjModel(model)))
        physics.set_robot(params)
        return physics

    def _reload_from_data(self, data: Any) -> None:
        mujoco.mj_forward(data.model.ptr, data.ptr)
        # First, as the parent's own ends with `after_reset`.
        self.robot = HuskyPhysics(data.model.ptr, self._params, data.ptr)
        super()._reload_from_data(data)

    def set_robot(self, params: HuskyParams) -> None:
        """Gives the robot another controller; what it has been commanded is forgotten."""
        surroundings = self.robot.surroundings
        self._params = params
        self.robot = HuskyPhysics(self.model.ptr, params, self.data.ptr)
        self.robot.surroundings = surroundings

    def copy(self, share_model: bool = False) -> "DrivePhysics":
        twin = super().copy(share_model)
        twin.set_robot(self._params)
        return twin

    def __getstate__(self) -> Any:
        return self.data, self._params

    def __setstate__(self, state: Any) -> None:
        data, self._params = state
        super().__setstate__(data)

    def after_reset(self) -> None:
        super().after_reset()
        self.robot.begin()

    def step(self, nstep: int = 1) -> None:
        """Lets `nstep` small steps pass, the time between two commands."""
        with self.check_invalid_state():
            self.robot.step(nstep * self.timestep())

    # ---- named quantities

    @property
    def planar_pose(self) -> Array:
        """x, y [m] and yaw [rad] of the base, shape (3,)."""
        return self.robot.planar_pose

    @property
    def base_to_world(self) -> Array:
        """Shape (4, 4)."""
        return self.robot.base_to_world

    @property
    def seen(self) -> mujoco.MjData:
        """Time and poses of everything when the newest picture was taken; see `HuskyPhysics.seen`."""
        return self.robot.seen

    @property
    def camera_to_world(self) -> Array:
        """Of the front camera when its newest picture was taken, OpenCV axes, shape (4, 4)."""
        return self.robot.delayed_camera_to_world

    @property
    def speed(self) -> float:
        """Over ground along the robot's heading [m/s]."""
        return self.robot.speed

    @property
    def yaw_rate(self) -> float:
        """About the robot's up [rad/s]."""
        return self.robot.yaw_rate

    @property
    def uprightness(self) -> float:
        """Cosine of the angle between the robot's up and the world's."""
        return self.robot.uprightness

    @property
    def touched(self) -> tuple[str, ...]:
        """Names of the geoms touched during the last control step besides the ground, sorted."""
        return self.robot.touched
