"""Physics of the Husky, driven by commands: forward speed v [m/s] and yaw rate ω [rad/s].

A *control step* is the time between two commands, usually 0.1 s; it consists of many MuJoCo substeps. Contacts are
checked several times per control step, so that short contacts are not missed. *Touched* geoms are geoms in contact with
the robot, except for the ground. A command reaches the controller after `command_latency`. The newest image was taken
`camera_latency` ago, so it shows earlier poses of robot and obstacles.
"""

from bisect import bisect_right
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from twin.env.controller import CONTROL_PERIOD, Controller, wheel_speeds
from twin.errors import InputError
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.poses import pose_of
from twin.mjcf.scene_xml import rest_pose
from twin.robot import GEAR_RATIO, SIDES, WHEEL_RADIUS, WHEELS, HuskyParams
from twin.types import Array

TIME_TOLERANCE = 1e-6  # [s] simulation times that differ by less count as equal, because of rounding

_CHECK_PERIOD = 0.01  # [s] time between two contact checks; if images are delayed, each check also records all poses
_SETTLE_TIME = 0.3  # [s] time that `set_pose` simulates, so that the robot settles on the ground
_RAY_START = 50.0  # [m] least height, above the ground's origin, from which rays are cast down to find its height


class _Snapshot(NamedTuple):
    """Time and generalized positions, from which all poses follow."""

    time: float
    qpos: Array
    mocap_pos: Array
    mocap_quat: Array


EPISODE_STATE = ("controller", "steps_to_update", "touched_geoms", "snapshots")
"""Attributes of `HuskyPhysics` that are an episode's state besides MuJoCo's data."""


class HuskyPhysics:
    """Steps one Husky in one model."""

    move_obstacles: Callable[[float], None] | None = None
    """Sets the poses of moving obstacles at a time [s]. `step` calls it before each segment, for the segment's end."""

    def __init__(
        self, model: mujoco.MjModel, params: HuskyParams | None = None, data: mujoco.MjData | None = None
    ) -> None:
        """
        Args:
            model: Contains the Husky of `add_husky`; its keyframe `spawn`, if any, is the start.
            params: Parameters of the robot in the model; None: the published ones.
            data: State to step, from its present values on; None: a new state, at the start.
        """
        self.model = model
        self.params = params or HuskyParams()
        self.data = mujoco.MjData(model) if data is None else data
        self._body = model.body("base_link").id
        self._camera = model.camera("front").id
        self.actuators = np.array([model.actuator(side).id for side in SIDES])
        self.is_robot = model.body_rootid[model.geom_bodyid] == self._body
        """Mask of the robot's geoms, shape (ngeom,)."""
        self._ground = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ground")
        self.is_collidable = ~self.is_robot & (np.arange(model.ngeom) != self._ground)
        """Mask of all other geoms except for the ground, shape (ngeom,)."""
        self._spawn = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "spawn")
        self._steps_per_update = round(self.params.timing.period / model.opt.timestep)
        self.check_steps = max(1, round(_CHECK_PERIOD / model.opt.timestep))
        """Substeps between two contact checks."""
        self._delayed = mujoco.MjData(model) if self.params.camera_latency else self.data
        if data is None:
            self.reset()
        else:
            self.begin()

    def reset(self) -> None:
        """Resets to the start, at rest."""
        if self._spawn >= 0:
            mujoco.mj_resetDataKeyframe(self.model, self.data, self._spawn)
        else:
            mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.begin()

    def set_pose(self, x: float, y: float, yaw: float, speed: float = 0.0) -> None:
        """Sets the robot on the ground at x, y [m] and yaw [rad], lets it settle, and sets the time to 0.

        It is at rest, or drives straight on as if `speed` [m/s] had been commanded for a while: no faster than the
        controller lets it. Pictures begin at time 0; a camera's latency does not reach back before it.

        Raises InputError: there is no ground below a wheel.
        """
        position, quaternion = rest_pose(self._ground_height, np.array([x, y]), yaw)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:3], self.data.qpos[3:7] = position, quaternion
        if self.move_obstacles:
            self.move_obstacles(0.0)
        mujoco.mj_forward(self.model, self.data)
        overlapping = self._contacts()  # what the robot is put into pushes it away while it settles
        mujoco.mj_step(self.model, self.data, round(_SETTLE_TIME / self.model.opt.timestep))
        self.data.qvel[:], self.data.time = 0.0, 0.0
        if speed:
            self._roll(speed)
        mujoco.mj_forward(self.model, self.data)
        self.begin()
        self.touched_geoms |= overlapping

    def _roll(self, speed: float) -> None:
        """Sets wheels, motors and body in motion, straight on, as a command of `speed` [m/s] does in the end."""
        sides = wheel_speeds(np.array([min(speed, self.params.max_speed), 0.0]), self.params)
        self.data.ctrl[self.actuators] = sides
        if self.model.na:  # the motors' lag
            self.data.act[self.model.actuator_actadr[self.actuators]] = sides
        self.data.qvel[[self.model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS]] = np.tile(sides, 2)
        forward = np.zeros(3)
        mujoco.mju_rotVecQuat(forward, np.array([sides.mean() * WHEEL_RADIUS, 0.0, 0.0]), self.data.qpos[3:7])
        self.data.qvel[:3] = forward

    def begin(self) -> None:
        """Starts an episode in the present state; drops pending commands and earlier contacts.

        The controller begins at the mean speed that the wheels are commanded (`data.ctrl`): dm_control calls this again
        after `set_pose`, which may have set the robot in motion.
        """
        self.controller = Controller(self.params, float(self.data.ctrl[self.actuators].mean()) * WHEEL_RADIUS)
        phase_steps = int(np.ceil(self.controller.phase / self.model.opt.timestep - 1e-6))
        self.steps_to_update = phase_steps % self._steps_per_update
        """Substeps until the controller's next update."""
        self.touched_geoms = self._contacts()
        """Indices of the geoms touched during the last control step."""
        self.snapshots = [self._snapshot()]
        """State at the contact checks from which delayed pictures are taken."""

    def _ground_height(self, xy: Array) -> Array:
        relief = self.model.hfield_size[self.model.geom_dataid[self._ground], 2]
        top = self.model.geom_pos[self._ground, 2] + max(_RAY_START, relief + 1.0)
        down = np.array([0.0, 0.0, -1.0])
        depths = np.array(
            [mujoco.mj_rayHfield(self.model, self.data, self._ground, np.array([*p, top]), down, None) for p in xy]
        )
        if depths.min() < 0.0:  # rays that miss
            x, y = xy.mean(0)
            raise InputError(
                f"the robot would start at x = {x:.1f} m, y = {y:.1f} m, beyond the ground; expected a start on it: "
                "lower start_offset, or raise mesh.margin and build again"
            )
        return top - depths

    def command(self, v: float, yaw_rate: float) -> None:
        """Commands a speed [m/s] and a yaw rate [rad/s]; the command expires after the controller's time-out."""
        self.controller.command(self.time, v, yaw_rate)

    def step(self, period: float = CONTROL_PERIOD) -> None:
        """Steps for `period` [s], the time between two commands."""
        touched: set[int] = set()
        for steps, speeds in self.schedule(period):
            self.data.ctrl[self.actuators] = speeds
            if self.move_obstacles:
                self.move_obstacles(self.time + steps * self.model.opt.timestep)
            mujoco.mj_step(self.model, self.data, steps)
            touched |= self._contacts()
            if self.params.camera_latency:
                self.snapshots.append(self._snapshot())
        # After mj_step, poses and contacts are those at the start of the last substep; compute those at its end.
        mujoco.mj_forward(self.model, self.data)
        self._finish_step(touched | self._contacts())

    def schedule(self, period: float) -> list[tuple[int, Array]]:
        """Runs the controller for the next `period` [s].

        Returns the segments in order. Each is given by its number of substeps and by the speeds of the left and right
        wheels [rad/s], shape (2,). A segment ends at a contact check, at an update of the controller, or at the end of
        the period.
        """
        out, time = [], self.time
        left = round(period / self.model.opt.timestep)
        speeds = self.data.ctrl[self.actuators].copy()
        while left:
            if not self.steps_to_update:
                speeds = self.controller.update(time)
                self.steps_to_update = self._steps_per_update
            steps = min(left, self.check_steps, self.steps_to_update)
            out.append((steps, speeds))
            time += steps * self.model.opt.timestep
            left, self.steps_to_update = left - steps, self.steps_to_update - steps
        return out

    def load_state(self, touched: set[int], snapshots: list[tuple[float, Array, Array, Array]]) -> None:
        """Completes a state that another engine computed and wrote to `data`. The controller's state is not updated.

        Args:
            touched: Geoms touched during the last control step.
            snapshots: Time [s], `qpos`, `mocap_pos` and `mocap_quat` at each of the last contact checks; used only if
                the camera has a latency.
        """
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        if self.params.camera_latency:
            self.snapshots = [_Snapshot(*one) for one in snapshots]
        self._finish_step(touched)

    def _finish_step(self, touched: set[int]) -> None:
        self.touched_geoms = touched
        oldest = self.time - self.params.camera_latency - 2 * _CHECK_PERIOD
        self.snapshots = [one for one in self.snapshots if one.time > oldest]

    def _snapshot(self) -> _Snapshot:
        d = self.data
        return _Snapshot(self.time, d.qpos.copy(), d.mocap_pos.copy(), d.mocap_quat.copy())

    def _contacts(self) -> set[int]:
        """Geoms in contact with the robot at present, except for the ground."""
        pairs = self.data.contact.geom
        hit = self.is_robot[pairs[:, ::-1]] & self.is_collidable[pairs]
        return set(pairs[hit].tolist()) if hit.any() else set()

    @property
    def touched(self) -> tuple[str, ...]:
        """Names of the geoms touched during the last control step, sorted."""
        return tuple(sorted(self.model.geom(i).name for i in self.touched_geoms))

    @property
    def time(self) -> float:
        """Time since the reset [s]."""
        return float(self.data.time)

    @property
    def base_to_world(self) -> Array:
        """Pose of the base, shape (4, 4)."""
        return pose_of(self.data.xmat[self._body].reshape(3, 3), self.data.xpos[self._body])

    @property
    def planar_pose(self) -> Array:
        """x, y [m] and yaw [rad] of the base, shape (3,)."""
        x, y = self.data.xpos[self._body, :2]
        matrix = self.data.xmat[self._body]
        return np.array([x, y, np.arctan2(matrix[3], matrix[0])])

    @property
    def uprightness(self) -> float:
        """Cosine of the angle between the robot's and the world's up axes."""
        return float(self.data.xmat[self._body, 8])

    @property
    def speed(self) -> float:
        """Speed over ground along the robot's heading [m/s]."""
        return float(self.data.qvel[:3] @ self.data.xmat[self._body, [0, 3, 6]])

    @property
    def yaw_rate(self) -> float:
        """Angular velocity about the robot's up axis [rad/s]."""
        return float(self.data.qvel[5])

    @property
    def camera_to_world(self) -> Array:
        """Present pose of the front camera, OpenCV axes, shape (4, 4)."""
        return camera_pose(self.data, self._camera)

    @property
    def delayed_data(self) -> mujoco.MjData:
        """State at the time when the newest image was taken: `camera_latency` ago, but not before the episode's start.

        Without latency, it is the present data. With latency, it contains only the time, the positions, and the results
        of `mj_kinematics` and `mj_camlight`; positions are interpolated linearly between contact checks. The state is
        valid until the next access to this property.
        """
        if not self.params.camera_latency:
            return self.data
        data, time = self._delayed, self.time - self.params.camera_latency
        before = max(bisect_right(self.snapshots, time + TIME_TOLERANCE, key=lambda one: one.time) - 1, 0)
        first, last = self.snapshots[before], self.snapshots[min(before + 1, len(self.snapshots) - 1)]
        data.time, data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = first
        if first.time + TIME_TOLERANCE < time < last.time:
            share, rate = (time - first.time) / (last.time - first.time), np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, rate, 1.0, first.qpos, last.qpos)
            mujoco.mj_integratePos(self.model, data.qpos, rate, share)
            data.time, data.mocap_pos[:] = time, (1.0 - share) * first.mocap_pos + share * last.mocap_pos
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)
        return data

    @property
    def delayed_camera_to_world(self) -> Array:
        """Pose of the front camera when the newest image was taken, shape (4, 4)."""
        return camera_pose(self.delayed_data, self._camera)

    @property
    def motor_torque(self) -> Array:
        """Torques at the wheels of the left and right side [N m], shape (2,)."""
        return self.data.actuator_force[self.actuators].copy()

    @property
    def motor_current(self) -> Array:
        """Current estimated from the torque [A], shape (2,): torque / (gear ratio · `motor_constant`)."""
        return self.motor_torque / (GEAR_RATIO * self.params.motor_constant)


def camera_pose(data: mujoco.MjData, camera: int) -> Array:
    """camera_to_world of a camera, OpenCV axes, shape (4, 4)."""
    return opencv_to_mujoco(pose_of(data.cam_xmat[camera].reshape(3, 3), data.cam_xpos[camera]))
