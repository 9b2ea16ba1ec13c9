"""The Husky driven by commands: forward speed v [m/s] and yaw rate ω [rad/s], as its own controller takes them.

One *control step* is 0.1 s, the period of the robot's wheel controller. Within it MuJoCo takes many small steps;
contacts are looked at several times in between, so that a short graze is not missed. *Touched* means in contact with
any part of the robot, the ground excepted. *Latency*: a command reaches the controller `command_latency` after it was
given, and the newest picture there is was taken `camera_latency` ago: it shows everything, robot and obstacles, as it
was at that *instant*.
"""

import warnings
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from twin.env.controller import CONTROL_PERIOD, Controller
from twin.geometry.cameras import opencv_to_mujoco
from twin.mjcf.scene_xml import rest_pose
from twin.robot import GEAR_RATIO, SIDES, WHEELS, HuskyParams
from twin.types import Array

_LOOK_PERIOD = 0.01  # [s] between two looks at the contacts and at where everything is
_SAME_TIME = 1e-6  # [s] apart are rounding errors of the clock
_SETTLE_TIME = 0.3  # [s] on the ground after being put there
_RAY_START = 50.0  # [m] above the ground's highest point


class _Instant(NamedTuple):
    """What the poses of everything follow from."""

    time: float
    qpos: Array
    mocap_pos: Array
    mocap_quat: Array


class HuskyPhysics:
    """Steps one Husky in one world."""

    surroundings: Callable[[float], None] | None = None
    """Called with the time [s] that the next small steps lead to, before them: moves what moves by itself."""

    def __init__(
        self, model: mujoco.MjModel, params: HuskyParams | None = None, data: mujoco.MjData | None = None
    ) -> None:
        """
        Args:
            model: A world made by `twin.mjcf.scene_xml`, or any with `add_husky`; a keyframe `spawn` is where it starts.
            params: The robot it was made with (`World.robot`): its controller and its latencies; by default the
                published one.
            data: Of the model, stepped from where it is; by default new, at the start.
        """
        self.model = model
        self.params = params or HuskyParams()
        self.data = mujoco.MjData(model) if data is None else data
        self._body = model.body("base_link").id
        self._camera = model.camera("front").id
        self.actuators = np.array([model.actuator(side).id for side in SIDES])
        wheels = [model.joint(f"{name}_wheel") for name in WHEELS]
        self._wheel_angles = np.array([wheel.qposadr[0] for wheel in wheels])
        self._wheel_dofs = np.array([wheel.dofadr[0] for wheel in wheels])
        self.is_robot = model.body_rootid[model.geom_bodyid] == self._body
        self._ground = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ground")
        self.counts = ~self.is_robot & (np.arange(model.ngeom) != self._ground)
        self._spawn = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "spawn")
        self._period_steps = round(CONTROL_PERIOD / model.opt.timestep)
        self.look_steps = max(1, round(_LOOK_PERIOD / model.opt.timestep))
        self._seen = mujoco.MjData(model) if self.params.camera_latency else self.data
        if data is None:
            self.reset()
        else:
            self.begin()

    def reset(self) -> None:
        """Back to the start, at rest."""
        if self._spawn >= 0:
            mujoco.mj_resetDataKeyframe(self.model, self.data, self._spawn)
        else:
            mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.begin()

    def place(self, x: float, y: float, yaw: float) -> None:
        """Puts it at rest on the ground, wheels down and settled, at x, y [m] and yaw [rad]; the clock starts at 0."""
        position, quaternion = rest_pose(self._ground_height, np.array([x, y]), yaw)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:3], self.data.qpos[3:7] = position, quaternion
        if self.surroundings:
            self.surroundings(0.0)
        mujoco.mj_step(self.model, self.data, round(_SETTLE_TIME / self.model.opt.timestep))
        self.data.qvel[:], self.data.time = 0.0, 0.0
        mujoco.mj_forward(self.model, self.data)
        self.begin()

    def begin(self) -> None:
        """Takes the state as it is for the beginning: nothing commanded yet, and touched only what it touches now."""
        self.controller = Controller(self.params)
        # Small steps until the controller runs next.
        self.until_update = int(np.ceil(self.controller.phase / self.model.opt.timestep - 1e-6)) % self._period_steps
        self._touched = self._touching()
        self._instants = [self._instant()]

    def _ground_height(self, xy: Array) -> Array:
        top = self.model.geom_pos[self._ground, 2] + _RAY_START
        down = np.array([0.0, 0.0, -1.0])
        return np.array(
            [
                top - mujoco.mj_rayHfield(self.model, self.data, self._ground, np.array([*p, top]), down, None)
                for p in xy
            ]
        )

    def command(self, v: float, yaw_rate: float) -> None:
        """Sets the wanted speed [m/s] and yaw rate [rad/s]; it lapses after 0.25 s without a new one."""
        self.controller.command(self.time, v, yaw_rate)

    def step(self, period: float = CONTROL_PERIOD) -> None:
        """Lets `period` [s] pass, the time between two commands."""
        touched: set[int] = set()
        for some, speeds in self.course(period):
            self.data.ctrl[self.actuators] = speeds
            if self.surroundings:
                self.surroundings(self.time + some * self.model.opt.timestep)
            mujoco.mj_step(self.model, self.data, some)
            touched |= self._touching()
            if self.params.camera_latency:
                self._instants.append(self._instant())
        # Poses and contacts of the instant that is now read, rather than of the last small step's start.
        mujoco.mj_forward(self.model, self.data)
        self._arrive(touched | self._touching())

    def course(self, period: float) -> list[tuple[int, Array]]:
        """What the controller makes of `period` [s] from now: small steps until the next look, and for how long the
        left and the right wheels are asked for which speed [rad/s], shape (2,). It has run when this returns."""
        out, time = [], self.time
        left = round(period / self.model.opt.timestep)
        speeds = self.data.ctrl[self.actuators].copy()
        while left:
            if not self.until_update:
                speeds = self.controller.update(time)
                self.until_update = self._period_steps
            some = min(left, self.look_steps, self.until_update)
            out.append((some, speeds))
            time += some * self.model.opt.timestep
            left, self.until_update = left - some, self.until_update - some
        return out

    def take_over(self, touched: set[int], looks: list[tuple[float, Array, Array, Array]]) -> None:
        """Takes over where another engine's small steps have led: `data` holds positions, velocities and time. What the
        controller has been commanded it is not told.

        Args:
            touched: Geoms that were in contact at a look of the last control step.
            looks: Time [s], `qpos`, `mocap_pos` and `mocap_quat` of the last ones, if the camera has a latency.
        """
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        if self.params.camera_latency:
            self._instants = [_Instant(*look) for look in looks]
        self._arrive(touched)

    def _arrive(self, touched: set[int]) -> None:
        self._touched = touched
        oldest = self.time - self.params.camera_latency - 2 * _LOOK_PERIOD
        self._instants = [one for one in self._instants if one.time > oldest]

    def _instant(self) -> _Instant:
        d = self.data
        return _Instant(self.time, d.qpos.copy(), d.mocap_pos.copy(), d.mocap_quat.copy())

    def _touching(self) -> set[int]:
        pairs = self.data.contact.geom
        # Of a pair that counts one geom is the robot's and the other neither robot nor ground.
        hit = self.is_robot[pairs[:, ::-1]] & self.counts[pairs]
        return set(pairs[hit].tolist()) if hit.any() else set()

    @property
    def touched(self) -> tuple[str, ...]:
        """Names of the geoms touched during the last control step, sorted."""
        return tuple(sorted(self.model.geom(i).name for i in self._touched))

    @property
    def touching(self) -> frozenset[int]:
        """The same, as numbers of geoms."""
        return frozenset(self._touched)

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
    def camera_to_world(self) -> Array:
        """Of the front camera, OpenCV axes, shape (4, 4)."""
        return opencv_to_mujoco(_pose(self.data.cam_xpos[self._camera], self.data.cam_xmat[self._camera]))

    @property
    def seen(self) -> mujoco.MjData:
        """Time and poses of everything when the newest picture there is was taken, `camera_latency` ago.

        Without latency the present; with it `qpos`, the mocap bodies and what `mj_kinematics` and `mj_camlight` make of
        them, until this is asked for again. Nothing is older than the beginning. Between two looks, 10 ms apart, what
        the robot does is taken for steady.
        """
        if not self.params.camera_latency:
            return self.data
        data, time = self._seen, self.time - self.params.camera_latency
        before = max(bisect_right(self._instants, time + _SAME_TIME, key=lambda one: one.time) - 1, 0)
        first, last = self._instants[before], self._instants[min(before + 1, len(self._instants) - 1)]
        data.time, data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = first
        if first.time + _SAME_TIME < time < last.time:
            share, rate = (time - first.time) / (last.time - first.time), np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, rate, 1.0, first.qpos, last.qpos)
            mujoco.mj_integratePos(self.model, data.qpos, rate, share)
            data.time, data.mocap_pos[:] = time, (1.0 - share) * first.mocap_pos + share * last.mocap_pos
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)
        return data

    @property
    def delayed_camera_to_world(self) -> Array:
        """Of the front camera when the newest picture there is was taken, `camera_latency` ago. Shape (4, 4)."""
        data = self.seen
        return opencv_to_mujoco(_pose(data.cam_xpos[self._camera], data.cam_xmat[self._camera]))

    @property
    def wheel_position(self) -> Array:
        """What the encoders count [rad], shape (4,) as `twin.robot.WHEELS`."""
        return self.data.qpos[self._wheel_angles].copy()

    @property
    def wheel_velocity(self) -> Array:
        """[rad/s], shape (4,) as `twin.robot.WHEELS`."""
        return self.data.qvel[self._wheel_dofs].copy()

    @property
    def motor_torque(self) -> Array:
        """Of the left and of the right side, at the wheels [N m], shape (2,)."""
        return self.data.actuator_force[self.actuators].copy()

    @property
    def motor_current(self) -> Array:
        """Estimated from the torque [A], shape (2,): torque / (gear ratio · `motor_constant`)."""
        return self.motor_torque / (GEAR_RATIO * self.params.motor_constant)

    @property
    def gyro(self) -> Array:
        """The IMU's angular velocity in the base [rad/s], shape (3,)."""
        return self.data.sensor("imu_gyro").data.copy()

    @property
    def accelerometer(self) -> Array:
        """The IMU's proper acceleration in the base [m/s²], shape (3,); at rest 9.81 upwards."""
        return self.data.sensor("imu_accelerometer").data.copy()

    @property
    def orientation(self) -> Array:
        """The IMU's attitude: quaternion w, x, y, z of base to world, shape (4,)."""
        return self.data.sensor("imu_orientation").data.copy()


def _pose(position: Array, matrix: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = matrix.reshape(3, 3)
    pose[:3, 3] = position
    return pose


# ---- The robot as dm_control sees it: a `dm_control.mujoco.Physics` whose named quantities are those of `HuskyPhysics`.


with warnings.catch_warnings():
    # dm_control looks for a display when it is imported, and complains where there is none; nothing here needs one.
    warnings.simplefilter("ignore")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco import wrapper


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
