"""The Husky driven by commands: forward speed v [m/s] and yaw rate ω [rad/s], as its own controller takes them.

One *control step* is 0.1 s, the period of the robot's wheel controller. Within it MuJoCo takes many small steps;
contacts are looked at several times in between, so that a short graze is not missed. *Touched* means in contact with
any part of the robot, the ground excepted.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import opencv_to_mujoco
from twin.mjcf.husky import COMMAND_TIMEOUT, CONTROL_PERIOD, WHEELS, limited_command, wheel_speeds

Array = NDArray[np.float64]

_LOOK_PERIOD = 0.01  # [s] between two looks at the contacts


class HuskyPhysics:
    """Steps one Husky in one world."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """
        Args:
            model: A world made by `twin.mjcf.export`, or any with `add_husky`; a keyframe `spawn` is where it starts.
        """
        self.model = model
        self.data = mujoco.MjData(model)
        self._body = model.body("husky").id
        self._camera = model.camera("front").id
        self._actuators = np.array([model.actuator(f"{name}_wheel").id for name in WHEELS])
        self._wheel_dofs = np.array([model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS])
        self._robot = model.body_rootid[model.geom_bodyid] == self._body
        ground = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ground")
        self._counts = ~self._robot & (np.arange(model.ngeom) != ground)
        self._spawn = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "spawn")
        self._look_steps = max(1, round(_LOOK_PERIOD / model.opt.timestep))
        self._looks = max(1, round(CONTROL_PERIOD / (self._look_steps * model.opt.timestep)))
        self.reset()

    def reset(self) -> None:
        """Back to the start, at rest."""
        if self._spawn >= 0:
            mujoco.mj_resetDataKeyframe(self.model, self.data, self._spawn)
        else:
            mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self._wanted = np.zeros(2)
        self._carried_out = np.zeros(2)
        self._command_time = 0.0
        self._touched: set[int] = set()

    def command(self, v: float, yaw_rate: float) -> None:
        """Sets the wanted speed [m/s] and yaw rate [rad/s]; it lapses after 0.25 s without a new one."""
        self._wanted = np.array([v, yaw_rate])
        self._command_time = self.data.time

    def step(self) -> None:
        """One control step of 0.1 s."""
        lapsed = self.data.time - self._command_time > COMMAND_TIMEOUT - 1e-9
        self._carried_out = limited_command(np.zeros(2) if lapsed else self._wanted, self._carried_out)
        self.data.ctrl[self._actuators] = wheel_speeds(self._carried_out)
        touched: set[int] = set()
        for _ in range(self._looks):
            mujoco.mj_step(self.model, self.data, self._look_steps)
            touched |= self._touching()
        # Poses and contacts of the instant that is now read, rather than of the last small step's start.
        mujoco.mj_forward(self.model, self.data)
        self._touched = touched | self._touching()

    def _touching(self) -> set[int]:
        pairs = self.data.contact.geom
        # Of a pair that counts one geom is the robot's and the other neither robot nor ground.
        hit = self._robot[pairs[:, ::-1]] & self._counts[pairs]
        return set(pairs[hit].tolist()) if hit.any() else set()

    @property
    def touched(self) -> tuple[str, ...]:
        """Names of the geoms touched during the last control step, sorted."""
        return tuple(sorted(self.model.geom(i).name for i in self._touched))

    @property
    def time(self) -> float:
        """[s] since the reset."""
        return float(self.data.time)

    @property
    def base_to_world(self) -> Array:
        """Shape (4, 4)."""
        return _pose(self.data.xpos[self._body], self.data.xmat[self._body])

    @property
    def planar_pose(self) -> Array:
        """x, y [m] and yaw [rad] of the base, shape (3,)."""
        x, y = self.data.xpos[self._body, :2]
        matrix = self.data.xmat[self._body]
        return np.array([x, y, np.arctan2(matrix[3], matrix[0])])

    @property
    def camera_to_world(self) -> Array:
        """Of the front camera, OpenCV axes, shape (4, 4)."""
        return opencv_to_mujoco(_pose(self.data.cam_xpos[self._camera], self.data.cam_xmat[self._camera]))

    @property
    def wheel_velocity(self) -> Array:
        """[rad/s], shape (4,) as `twin.mjcf.husky.WHEELS`."""
        return self.data.qvel[self._wheel_dofs].copy()

    @property
    def wheel_torque(self) -> Array:
        """[N m], shape (4,)."""
        return self.data.actuator_force[self._actuators].copy()


def _pose(position: Array, matrix: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = matrix.reshape(3, 3)
    pose[:3, 3] = position
    return pose
