"""Models of the Husky on a plane or a height field, drives through its controller, and recordings of them."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.config import MjcfConfig
from twin.env.controller import CONTROL_PERIOD, Controller
from twin.mjcf.husky import add_husky, set_options
from twin.mjcf.scene_xml import add_ground, rest_pose
from twin.robot import SIDES, TRACK, WHEEL_RADIUS, WHEELS, HuskyParams
from twin.types import Array

Edit = Callable[[mujoco.MjSpec], None]
SETTLE_TIME = 0.5  # [s] at rest before a drive


def on_plane(params: HuskyParams | None = None, edit: Edit | None = None) -> mujoco.MjModel:
    """Model of the Husky on a plane."""
    spec = mujoco.MjSpec()
    set_options(spec, params)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1))
    add_husky(spec, params=params)
    if edit is not None:
        edit(spec)
    return spec.compile()


def on_ground(
    ground: Ground,
    params: HuskyParams | None = None,
    edit: Edit | None = None,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> mujoco.MjModel:
    """Model of the Husky on a height field as the mjcf stage writes it, starting at x, y [m] and yaw [rad]."""
    spec = mujoco.MjSpec()
    set_options(spec, params)
    with tempfile.TemporaryDirectory(prefix="twin-ground-") as folder:
        spec.modelfiledir = spec.meshdir = spec.texturedir = folder
        add_ground(spec, ground, Path(folder), MjcfConfig.hfield_cell)
        position, quaternion = rest_pose(ground.at, np.array(start[:2]), start[2])
        add_husky(spec, position, quaternion, params)
        if edit is not None:
            edit(spec)
        return spec.compile()


@dataclass(frozen=True)
class Recording:
    """Series over n physics steps. Wheels are ordered as `twin.robot.WHEELS`, sides as `SIDES`."""

    timestep: float
    """Physics time step [s]."""
    wheel: Array
    """Wheel speeds [rad/s], shape (n, 4)."""
    torque: Array
    """Motor torques at the wheels of a side [N m], shape (n, 2)."""
    pose: Array
    """x, y, z [m], yaw and pitch [rad] of the base, yaw without jumps, shape (n, 5)."""
    velocity: Array
    """Velocity along x and y of the world [m/s], and yaw rate [rad/s], shape (n, 3)."""
    camera_z: Array
    """Height of the front camera [m], shape (n,)."""
    loaded: NDArray[np.int64]
    """Number of tires in contact, shape (n,)."""
    dissipated: Array
    """Power dissipated by the contacts [W], shape (n,)."""

    @property
    def wheel_difference(self) -> float:
        """Mean speed of the right wheels minus that of the left wheels [m/s]."""
        return float((self.wheel @ [-0.5, 0.5, -0.5, 0.5]).mean() * WHEEL_RADIUS)

    @property
    def yaw_rate(self) -> float:
        """Mean yaw rate [rad/s]."""
        return float((self.pose[-1, 3] - self.pose[0, 3]) / (self.timestep * (len(self.pose) - 1)))

    @property
    def chi(self) -> float:
        """Track ratio: wheel speed difference divided by the product of yaw rate and track."""
        return self.wheel_difference / (self.yaw_rate * TRACK)

    @property
    def power(self) -> Array:
        """Mechanical power of the motors [W], shape (n,)."""
        return (self.torque * (self.wheel[:, :2] + self.wheel[:, 2:]) / 2).sum(1)

    @property
    def jolt(self) -> float:
        """Vertical acceleration of the camera [m/s² rms]."""
        return float(np.diff(self.camera_z, 2).std() / self.timestep**2)

    def per_frame(self, values: Array) -> Array:
        """Differences of a series (n,) between video frames at 30 Hz."""
        every = 1.0 / (30.0 * self.timestep)
        steps = np.arange(0.0, len(values) - 1, every)
        return np.diff(np.interp(steps, np.arange(len(values)), values))


def state_at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    """State of the robot after `SETTLE_TIME` without a command."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(SETTLE_TIME / model.opt.timestep))
    return data


def record(
    model: mujoco.MjModel,
    commands: Callable[[float], tuple[float, float] | None],
    seconds: float,
    skip: float = 0.0,
    params: HuskyParams | None = None,
    data: mujoco.MjData | None = None,
) -> Recording:
    """Drives the robot through its controller for `seconds`, and records each physics step after the first `skip` [s].

    Args:
        commands: Maps the time [s], every 0.1 s, to v [m/s] and ω [rad/s]; None means no command.
        params: Parameters of the controller.
        data: Initial state, changed in place; the robot at rest by default.
    """
    data = state_at_rest(model) if data is None else data
    controller = Controller(params)
    actuators = [model.actuator(side).id for side in SIDES]
    dofs = [model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS]
    tires = np.array([model.geom(f"{name}_tyre").id for name in WHEELS])
    base, camera = model.body("base_link").id, model.camera("front").id
    rows: list[tuple] = []
    per_control = round(CONTROL_PERIOD / model.opt.timestep)
    for k in range(round(seconds / CONTROL_PERIOD)):
        time = k * CONTROL_PERIOD
        command = commands(time)
        if command is not None:
            controller.command(time, *command)
        data.ctrl[actuators] = controller.update(time)
        if time < skip - 1e-9:
            mujoco.mj_step(model, data, per_control)
            continue
        for _ in range(per_control):
            mujoco.mj_step(model, data)
            axes = data.xmat[base]
            rows.append(
                (
                    data.qvel[dofs],
                    data.actuator_force[actuators].copy(),
                    [*data.xpos[base], np.arctan2(axes[3], axes[0]), -np.arcsin(axes[6])],
                    data.qvel[[0, 1, 5]],
                    data.cam_xpos[camera, 2],
                    np.isin(tires, data.contact.geom).sum(),
                    dissipation(model, data),
                )
            )
    wheel, torque, pose, velocity, camera_z, loaded, dissipated = (np.array(c) for c in zip(*rows, strict=True))
    pose[:, 3] = np.unwrap(pose[:, 3])
    return Recording(model.opt.timestep, wheel, torque, pose, velocity, camera_z, loaded, dissipated)


def drive(
    model: mujoco.MjModel,
    v: float,
    yaw_rate: float,
    skip: float = 1.5,
    seconds: float = 1.5,
    params: HuskyParams | None = None,
) -> Recording:
    """Drives with a constant command from rest; records `seconds` after `skip` [s]."""
    return record(model, lambda _: (v, yaw_rate), skip + seconds, skip, params)


def dissipation(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Power dissipated by all contacts [W]: Σ −(friction · slip velocity + rolling and spinning moments · spin)."""
    total, wrench, velocity = 0.0, np.zeros(6), np.zeros((2, 6))
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(model, data, i, wrench)
        bodies = model.geom_bodyid[contact.geom]
        for side in (0, 1):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, bodies[side], velocity[side], 0)
            velocity[side, 3:] += np.cross(velocity[side, :3], contact.pos - data.xpos[bodies[side]])
        frame, relative = contact.frame.reshape(3, 3), velocity[1] - velocity[0]
        slip, spin = frame @ relative[3:], frame @ relative[:3]
        total -= wrench[1:3] @ slip[1:] + wrench[3:] @ spin
    return total
