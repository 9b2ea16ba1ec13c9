"""The robot in an episode's model as dm_control sees it: MuJoCo stepped by commands, and named quantities read off.

A *command* is a forward speed v [m/s] and a yaw rate ω [rad/s], as the robot's own controller takes them. Contacts are
looked at several times within a control step, so that a short graze is not missed. *Touched* means in contact with any
part of the robot, the ground excepted.
"""

import warnings
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

with warnings.catch_warnings():
    # dm_control looks for a display when it is imported, and complains where there is none; nothing here needs one.
    warnings.simplefilter("ignore")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco import wrapper

from twin.geometry.cameras import opencv_to_mujoco
from twin.mjcf.export import rest_pose
from twin.mjcf.husky import WHEELS, limited_command, wheel_speeds

Array = NDArray[np.float64]

_LOOK_PERIOD = 0.01  # [s] between two looks at the contacts
_SETTLE_TIME = 0.3  # [s] on the ground after being put there
_RAY_START = 50.0  # [m] above the ground's highest point


class DrivePhysics(dm_mujoco.Physics):
    """One robot in one episode's model."""

    moving: Callable[[mujoco.MjData, float], None] | None = None
    """Puts what moves by itself in its place at a time [s]; called before every look."""

    @staticmethod
    def of(model: mujoco.MjModel) -> "DrivePhysics":
        """Physics of a model that `episode_spec` made; the model is kept, not copied."""
        return DrivePhysics(wrapper.MjData(wrapper.MjModel(model)))

    def _reload_from_data(self, data) -> None:
        super()._reload_from_data(data)
        model = self.model.ptr
        self._body = model.body("husky").id
        self._camera = model.camera("front").id
        self._actuators = np.array([model.actuator(f"{name}_wheel").id for name in WHEELS])
        self._wheel_dofs = np.array([model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS])
        self._robot = model.body_rootid[model.geom_bodyid] == self._body
        self._ground = model.geom("ground").id
        self._counts = ~self._robot & (np.arange(model.ngeom) != self._ground)
        self._look_steps = max(1, round(_LOOK_PERIOD / model.opt.timestep))
        self.latency = 0.0
        """[s] from a command being given to its taking effect."""
        self.after_reset()

    # ---- stepping

    def after_reset(self) -> None:
        super().after_reset()
        self._sent: deque[tuple[float, Array]] = deque()
        self._wanted, self._carried_out = np.zeros(2), np.zeros(2)
        self._touched: set[int] = set()
        self._last_touched: set[int] = set()

    def place(self, x: float, y: float, yaw: float) -> None:
        """Puts the robot at rest on the ground, wheels down and settled; the clock is set to zero."""
        position, quaternion = rest_pose(self, np.array([x, y]), yaw)
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = 0.0, 0.0, 0.0
        self.data.qpos[:3], self.data.qpos[3:7] = position, quaternion
        if self.moving:
            self.moving(self.data.ptr, 0.0)
        self.after_reset()
        super().step(round(_SETTLE_TIME / self.timestep()))
        self.data.qvel[:], self.data.time = 0.0, 0.0
        self.after_reset()
        self._touched = self._last_touched = self._touching()

    def at(self, xy: Array) -> Array:
        """Height of the ground [m] at points (..., 2), shape (...)."""
        model, data = self.model.ptr, self.data.ptr
        top = model.geom_pos[self._ground, 2] + _RAY_START
        heights = [
            top - mujoco.mj_rayHfield(model, data, self._ground, np.array([*p, top]), np.array([0.0, 0.0, -1.0]), None)
            for p in np.reshape(xy, (-1, 2))
        ]
        return np.reshape(heights, np.shape(xy)[:-1])

    def command(self, v: float, yaw_rate: float) -> None:
        """Sets the wanted speed [m/s] and yaw rate [rad/s]; it takes effect after the latency."""
        self._sent.append((self.data.time + self.latency, np.array([v, yaw_rate])))

    def step(self, nstep: int = 1) -> None:
        """One control step of `nstep` small ones."""
        self._touched = set()
        done, period = 0, nstep * self.timestep()
        before = self._carried_out
        while done < nstep:
            some = min(self._look_steps, nstep - done)
            while self._sent and self._sent[0][0] < self.data.time + 1e-9:
                self._wanted = self._sent.popleft()[1]
            self._carried_out = limited_command(self._wanted, before, period)
            self.data.ctrl[self._actuators] = wheel_speeds(self._carried_out)
            if self.moving:
                self.moving(self.data.ptr, self.data.time + some * self.timestep())
            super().step(some)
            self._last_touched = self._touching()
            self._touched |= self._last_touched
            done += some

    def _touching(self) -> set[int]:
        pairs = self.data.contact.geom
        # Of a pair that counts one geom is the robot's and the other neither robot nor ground.
        hit = self._robot[pairs[:, ::-1]] & self._counts[pairs]
        return set(pairs[hit].tolist()) if hit.any() else set()

    # ---- named quantities

    @property
    def touched(self) -> tuple[str, ...]:
        """Names of the geoms touched during the last control step, sorted."""
        return tuple(sorted(self.model.ptr.geom(i).name for i in self._touched))

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
    def uprightness(self) -> float:
        """Cosine of the angle between the robot's up and the world's."""
        return float(self.data.xmat[self._body, 8])

    @property
    def speed(self) -> float:
        """Over ground along the robot's heading [m/s]."""
        return float(self.data.qvel[:3] @ self.data.xmat[self._body, [0, 3, 6]])

    @property
    def yaw_rate(self) -> float:
        """About the robot's up [rad/s]."""
        return float(self.data.qvel[5])

    @property
    def carried_out(self) -> Array:
        """v [m/s] and ω [rad/s] that the robot's controller makes of the commands just now, shape (2,)."""
        return self._carried_out.copy()

    @property
    def camera_to_world(self) -> Array:
        """Of the front camera, OpenCV axes, shape (4, 4)."""
        return opencv_to_mujoco(_pose(self.data.cam_xpos[self._camera], self.data.cam_xmat[self._camera]))

    @property
    def wheel_velocity(self) -> Array:
        """[rad/s], shape (4,) as `twin.mjcf.husky.WHEELS`."""
        return np.array(self.data.qvel[self._wheel_dofs])


def _pose(position: Array, matrix: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(matrix, (3, 3))
    pose[:3, 3] = position
    return pose
