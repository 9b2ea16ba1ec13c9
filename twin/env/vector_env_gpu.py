"""Vector environment on a GPU: `mujoco_warp` steps all environments at once.

The host starts episodes one by one. After each step, reward and termination are computed for all environments together.
Images of the radiance field alone, without obstacles, weather or camera noise, stay on the device (`GpuPixelObserver`).
Tests run this code on the CPU, where it is slower than MuJoCo, and on a GPU if there is one.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (kernels use Warp's own types, which mypy does not know)

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest.mock import patch

import mujoco_warp as mjw
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin import runtime
from twin.env.controller import SubstepSchedules, VectorController
from twin.env.env_factory import EnvFactory
from twin.env.observation import GpuPixelObserver
from twin.env.obstacles import ObstacleMotion
from twin.env.physics import TIME_TOLERANCE
from twin.env.task import DrivePhysics, DriveTask, Motion, RewardAndTermination, control
from twin.env.vector_env_local import LocalVectorEnv, StepResult
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.poses import pose_of
from twin.runtime import available_cores
from twin.types import Array, Indices
from twin.warp_runtime import wp

_RANDOMIZED_FIELDS = (
    *("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "cam_pos", "cam_quat", "body_mass", "body_inertia"),
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"),
)
"""Model fields that `NominalModel.apply` changes per environment, and fields that MuJoCo derives from them."""

_UPLOADED_FIELDS = ("qpos", "qvel", "act", "qacc_warmstart")
_STATE_FIELDS = (*_UPLOADED_FIELDS, "ctrl", "sensordata", "actuator_force")

_MAX_CONTACTS, _MAX_ROWS = 96, 384  # capacity per environment; the demo scene needs a third of each
_OVERFLOWS = mjw.OverflowType.NEFC | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD


@wp.kernel
def _apply_commands(
    k: int,
    segment: wp.array2d(dtype=int),
    speeds: wp.array3d(dtype=float),
    positions: wp.array3d(dtype=wp.vec3),
    quaternions: wp.array3d(dtype=wp.quat),
    ctrl: wp.array2d(dtype=float),
    mocap_pos: wp.array2d(dtype=wp.vec3),
    mocap_quat: wp.array2d(dtype=wp.quat),
):
    """Sets wheel speeds and poses of moving obstacles for substep k."""
    env = wp.tid()
    s = segment[k, env]
    for i in range(ctrl.shape[1]):
        ctrl[env, i] = speeds[s, env, i]
    for i in range(mocap_pos.shape[1]):
        mocap_pos[env, i] = positions[s, env, i]
        mocap_quat[env, i] = quaternions[s, env, i]


@wp.kernel
def _record_positions(
    k: int,
    segment: wp.array2d(dtype=int),
    qpos: wp.array2d(dtype=float),
    history: wp.array3d(dtype=float),
):
    """Records positions at the end of each segment (see `SubstepSchedules`); its last substep overwrites the others."""
    env, i = wp.tid()
    history[segment[k, env], env, i] = qpos[env, i]


@wp.kernel
def _mark_contacts(
    k: int,
    checks: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
    geoms: wp.array(dtype=wp.vec2i),
    envs: wp.array(dtype=int),
    robot: wp.array(dtype=int),
    is_collidable: wp.array(dtype=int),
    touched: wp.array2d(dtype=int),
):
    """Marks both geoms of each contact between the robot and a collidable geom, if substep k ends a segment."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    env, pair = envs[contact], geoms[contact]
    if checks[k, env] == 0 or pair[0] < 0 or pair[1] < 0:
        return
    if (robot[pair[0]] == 1 and is_collidable[pair[1]] == 1) or (robot[pair[1]] == 1 and is_collidable[pair[0]] == 1):
        touched[env, pair[0]] = 1
        touched[env, pair[1]] = 1


class GpuSimulation:
    """Steps the physics of n environments of one compiled scene; their models may differ in randomized fields.

    The state (positions, velocities, the solver's last accelerations) is kept in arrays that contain all environments.
    A control step uploads it, runs the substeps with the controllers' schedules, and downloads the new state and the
    touched geoms. The environments' own `MjData` are updated by `sync` only, since this takes far longer than a
    download. The device computes in single precision with another solver: episodes are similar to those of MuJoCo, but
    not bit-identical. On a GPU, they are not repeatable either, since the order of contacts varies.
    """

    def __init__(self, envs: Sequence[DrivePhysics], period: float, device: str) -> None:
        """`period`: time between two commands [s]; `device`: Warp's name of the device."""
        self._envs, self._device = list(envs), device
        robot, n = envs[0].robot, len(envs)
        model, self._params = robot.model, robot.params
        self._steps = round(period / model.opt.timestep)
        self._controllers = VectorController(self._params, n, period, model.opt.timestep, robot.check_steps)
        max_segments = self._controllers.max_segments
        self._state = {name: np.stack([getattr(env.robot.data, name) for env in envs]) for name in _STATE_FIELDS}
        self._stale = np.zeros(n, bool)
        self._touched = np.zeros((n, model.ngeom), bool)
        self._moving = np.zeros(n, bool)  # True for environments in which an obstacle moves
        mocap = [np.stack([getattr(env.robot.data, name) for env in envs]) for name in ("mocap_pos", "mocap_quat")]
        self._mocap = [np.tile(values, (max_segments, 1, 1, 1)) for values in mocap]  # poses at the end of each segment
        # The state at the last contact checks, the newest last; delayed camera poses are interpolated from it.
        latency = self._params.camera_latency
        kept = max_segments * (int(np.ceil(latency / period)) + 2) if latency else 0
        self._snapshot_times = np.full((kept, n), np.inf)
        self._snapshots = [np.zeros((kept, *values.shape)) for values in (self._state["qpos"], *mocap)]
        self._randomized = {
            name: np.stack([getattr(env.robot.model, name) for env in envs]) for name in _RANDOMIZED_FIELDS
        }
        self._uploaded = False  # True once `begin` has uploaded the randomized fields
        self._camera, self._actuators = model.camera("front").id, robot.actuators
        with wp.ScopedDevice(device):
            self._model = mjw.put_model(model, batch_sizes=dict.fromkeys(_RANDOMIZED_FIELDS, n))
            self._model.opt.warn_overflow = 0  # no warnings by kernels: `_download` raises an error
            if device != "cpu":
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
            self._data = mjw.make_data(model, nworld=n, nconmax=_MAX_CONTACTS, njmax=_MAX_ROWS)
            self._segment, self._checks = (wp.zeros((self._steps, n), dtype=int) for _ in range(2))
            self._speeds = wp.zeros((max_segments, n, model.nu), dtype=float)
            kinds = zip(self._mocap, (wp.vec3, wp.quat), strict=True)
            self._mocap_on_device = [wp.array(values.astype(np.float32), dtype=kind) for values, kind in kinds]
            self._history = wp.zeros((max_segments, n, model.nq), dtype=float)
            self._touched_on_device = wp.zeros((n, model.ngeom), dtype=int)
            masks = (robot.is_robot, robot.is_collidable)
            self._is_robot, self._is_collidable = (wp.array(mask.astype(np.int32), dtype=int) for mask in masks)
            self._upload()
            self._graph: Any = None
            if device != "cpu":
                _compile_kernels(self._model, lambda: self._substep(0), device)
                # The CUDA graph is captured now, while nothing else uses the GPU.
                # torch's default stream, which training a field makes Warp's, cannot be captured.
                with wp.ScopedStream(wp.Stream(device), sync_enter=True, sync_exit=True):
                    self._advance()
                    with wp.ScopedCapture() as capture:
                        self._advance()
                self._graph = capture.graph

    def begin(self, which: Indices) -> None:
        """Copies the models and states of environments whose episodes have just begun."""
        if not len(which):
            return
        robots = [self._envs[i].robot for i in which]
        for name, values in self._randomized.items():
            new = np.stack([getattr(robot.model, name) for robot in robots])
            if self._uploaded and np.array_equal(values[which], new):
                continue  # the arrays of all environments are uploaded, which takes long
            values[which] = new
            array = getattr(self._model, name)
            # In Warp's arrays, a vector or quaternion is one element.
            array.assign(values.reshape(array.shape + getattr(array.dtype, "_shape_", ())))
        for name, values in self._state.items():
            values[which] = [getattr(robot.data, name) for robot in robots]
        mocap = [np.stack([getattr(robot.data, name) for robot in robots]) for name in ("mocap_pos", "mocap_quat")]
        for values, array, new in zip(self._mocap, self._mocap_on_device, mocap, strict=True):
            values[:, which] = new
            array.assign(values.astype(np.float32))
        self._uploaded = True
        self._snapshot_times[:, which] = np.inf
        if len(self._snapshot_times):
            self._snapshot_times[-1, which] = 0.0
            for values, new in zip(self._snapshots, (self._state["qpos"][which], *mocap), strict=True):
                values[-1, which] = new
        self._stale[which] = False
        self._touched[which] = [np.isin(np.arange(len(robot.is_robot)), list(robot.touched_geoms)) for robot in robots]
        self._moving[which] = [isinstance(r.move_obstacles, ObstacleMotion) and r.move_obstacles.moving for r in robots]
        latency = np.array([robot.params.command_latency for robot in robots])
        until, speeds = (
            np.array(v) for v in zip(*((r.steps_to_update, r.controller.speed) for r in robots), strict=True)
        )
        self._controllers.begin(which, latency, until, speeds)

    def step(self, which: Indices, commands: Array) -> None:
        """Runs a control step of k environments with commands v [m/s] and ω [rad/s], shape (k, 2).

        Raises:
            RuntimeError: there are more contacts or constraint rows than the capacity.
            PhysicsError (of dm_control): positions or velocities are not finite.
        """
        schedules = self._controllers.schedules(which, commands)
        self._move_obstacles(which, schedules)
        speeds = np.zeros(self._speeds.shape, np.float32)
        speeds[:, :, self._actuators] = schedules.speeds
        self._segment.assign(schedules.segment)
        self._checks.assign(schedules.checks)
        self._speeds.assign(speeds)
        self._upload()
        with wp.ScopedDevice(self._device):
            if self._graph is None:
                self._advance()
            else:
                wp.capture_launch(self._graph)
        self._download(which, schedules)

    def motion(self, which: Indices) -> Motion:
        """Present motion of the robots of some environments."""
        qpos, qvel = self._state["qpos"][which], self._state["qvel"][which]
        matrix = _rotation_matrices(qpos[:, 3:7])
        pose = np.column_stack([qpos[:, :2], np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])])
        speed = (qvel[:, :3] * matrix[:, :, 0]).sum(-1)
        touched = self._touched[which].any(1)
        return Motion(pose, speed, qvel[:, 5], matrix[:, 2, 2], touched, self._controllers.time[which].copy())

    def touched(self, i: int) -> tuple[str, ...]:
        """Names of the geoms touched in environment i during the last control step, sorted."""
        model = self._envs[i].robot.model
        return tuple(sorted(model.geom(k).name for k in np.flatnonzero(self._touched[i])))

    def camera_poses(self, which: Indices) -> tuple[Array, Array]:
        """Camera poses (OpenCV axes), shape (k, 4, 4), and times [s], shape (k,), of the newest images."""
        qpos, time = self._state["qpos"][which, :7], self._controllers.time[which]
        if len(self._snapshot_times):
            qpos, time = self._delayed_base_poses(which)
        base = _rotation_matrices(qpos[:, 3:])
        rotation = base @ _rotation_matrices(self._randomized["cam_quat"][which, self._camera])
        position = qpos[:, :3] + (base @ self._randomized["cam_pos"][which, self._camera, :, None])[..., 0]
        return opencv_to_mujoco(pose_of(rotation, position)), time

    def sync(self, which: Indices) -> None:
        """Updates the `MjData` of some environments to their present state."""
        for i in which[self._stale[which]].tolist():
            robot = self._envs[i].robot
            for name, values in self._state.items():
                getattr(robot.data, name)[:] = values[i]
            robot.data.mocap_pos[:], robot.data.mocap_quat[:] = (values[-1, i] for values in self._mocap)
            robot.data.time = self._controllers.time[i]
            snapshots = [
                (float(time), *(values[k, i].copy() for values in self._snapshots))
                for k, time in enumerate(self._snapshot_times[:, i])
                if np.isfinite(time)
            ]
            robot.load_state(set(np.flatnonzero(self._touched[i]).tolist()), snapshots)
        self._stale[which] = False

    def _delayed_base_poses(self, which: Indices) -> tuple[Array, Array]:
        """Base poses, shape (k, 7), and times [s] of the newest images; see `HuskyPhysics.delayed_data`."""
        times, qpos = self._snapshot_times[:, which], self._snapshots[0][:, which, :7]
        time = self._controllers.time[which] - self._params.camera_latency
        row = np.arange(len(which))
        past = times <= time + TIME_TOLERANCE
        past[np.argmin(times, 0), row] = True  # use the oldest snapshot if all are newer than the image
        first = np.argmax(np.where(past, times, -np.inf), 0)
        coming = np.where(past, np.inf, times)
        last = np.argmin(coming, 0)
        start, end = times[first, row], coming[last, row]
        a, b = qpos[first, row], qpos[last, row]
        between = (start + TIME_TOLERANCE < time) & np.isfinite(end)
        share = np.zeros(len(which))
        share[between] = ((time - start) / (end - start))[between]
        # Snapshots are 10 ms apart, so linear interpolation of quaternions is accurate enough.
        b[:, 3:] *= np.sign((a[:, 3:] * b[:, 3:]).sum(-1, keepdims=True))
        return a + share[:, None] * (b - a), np.where(between, time, start)

    def _move_obstacles(self, which: Indices, schedules: SubstepSchedules) -> None:
        """Sets the poses of moving obstacles at the end of each segment."""
        moving = which[self._moving[which]]
        for i in moving.tolist():
            robot = self._envs[i].robot
            times = schedules.times[:, i]
            for p, time in enumerate(times[np.isfinite(times)].tolist()):
                assert robot.move_obstacles
                robot.move_obstacles(time)
                self._mocap[0][p:, i], self._mocap[1][p:, i] = robot.data.mocap_pos, robot.data.mocap_quat
        if len(moving):
            for values, array in zip(self._mocap, self._mocap_on_device, strict=True):
                array.assign(values.astype(np.float32))

    def _upload(self) -> None:
        for name in _UPLOADED_FIELDS:
            getattr(self._data, name).assign(self._state[name].astype(np.float32))
        self._touched_on_device.zero_()
        self._data.overflow.zero_()

    def _advance(self) -> None:
        for k in range(self._steps):
            self._substep(k)

    def _substep(self, k: int) -> None:
        d, contact = self._data, self._data.contact
        commands = [self._segment, self._speeds, *self._mocap_on_device]
        wp.launch(_apply_commands, d.nworld, [k, *commands], [d.ctrl, d.mocap_pos, d.mocap_quat])
        mjw.step(self._model, d)
        wp.launch(_record_positions, d.qpos.shape, [k, self._segment, d.qpos], [self._history])
        pairs = [d.nacon, contact.geom, contact.worldid, self._is_robot, self._is_collidable]
        wp.launch(_mark_contacts, d.naconmax, [k, self._checks, *pairs], [self._touched_on_device])

    def _download(self, which: Indices, schedules: SubstepSchedules) -> None:
        over = self._data.overflow.numpy()[which] & int(_OVERFLOWS)
        if over.any():
            raise RuntimeError(
                f"environments {which[over != 0].tolist()}: more than {_MAX_CONTACTS} contacts or {_MAX_ROWS} "
                "constraint rows, for which mujoco_warp has no room; use device='cpu'"
            )
        new = {name: getattr(self._data, name).numpy()[which] for name in _STATE_FIELDS}
        finite = np.isfinite(new["qpos"]).all(1) & np.isfinite(new["qvel"]).all(1)
        if not finite.all():
            raise control.PhysicsError(
                f"environments {which[~finite].tolist()}: positions or velocities are not finite"
            )
        for name, values in self._state.items():
            values[which] = new[name]
        self._touched[which] = self._touched_on_device.numpy()[which] > 0
        self._stale[which] = True
        if len(self._snapshot_times):
            newest = (
                schedules.times[:, which],
                self._history.numpy()[:, which],
                *(values[:, which] for values in self._mocap),
            )
            for kept, some in zip((self._snapshot_times, *self._snapshots), newest, strict=True):
                kept[: -len(some), which] = kept[len(some) :, which]
                kept[-len(some) :, which] = some


def _rotation_matrices(quaternions: Array) -> Array:
    """Rotation matrices (k, 3, 3) of quaternions w, x, y, z, shape (k, 4), which need not be unit quaternions."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _compile_kernels(model: Any, launch: Callable[[], None], device: str) -> None:
    """Compiles and loads the kernels that `launch` needs, one per core at a time.

    Warp compiles a kernel when it is first launched. For the physics that would be some 60 kernels one after another,
    which takes minutes on a machine that has not compiled them yet. No other thread may launch kernels meanwhile. A few
    whose block size depends on the GPU are compiled later.
    """
    needed: dict[tuple[Any, int], None] = {}

    def note(module: Any, _: Any, block_dim: int | None = None) -> None:
        """Replaces `Module.load`. A launch whose module is not loaded does nothing."""
        needed[module, block_dim or module.options["block_dim"]] = None

    def suggest(kernel: Any, _: Any) -> tuple[int, int]:
        """Replaces `get_suggested_block_size`, which needs a loaded module."""
        note(kernel.module, None)
        return 256, 1

    with (
        patch.object(wp.Module, "load", note),
        patch.object(wp, "get_suggested_block_size", suggest),
        patch.object(model.opt, "graph_conditional", False),  # else loops would read what was not computed
    ):
        launch()
    with (
        runtime.bar("preparing physics on the GPU", len(needed), "kernel", after=1.0) as progress,
        ThreadPoolExecutor(available_cores()) as pool,
    ):
        for _ in pool.map(lambda one: one[0].load(wp.get_device(device), one[1]), needed):
            progress.update()


class GpuVectorEnv(LocalVectorEnv):
    """n environments of one scene and task, stepped by `mujoco_warp`."""

    def __init__(self, factory: EnvFactory, seeds: Sequence[int | None], device: str) -> None:
        """`seeds` as in `LocalVectorEnv`; `device`: Warp's name of the device."""
        self._evaluator = RewardAndTermination(factory.world, factory.segment, factory.options, len(seeds))
        self._speed = np.zeros(len(seeds))
        super().__init__(factory, seeds)
        self._simulation = GpuSimulation(self._physics, factory.options.control_timestep, device)
        if isinstance(self.pixels, GpuPixelObserver):
            self.pixels.camera_poses = self._simulation.camera_poses

    def _make_envs(self, factory: EnvFactory, seeds: Sequence[int | None]) -> list[tuple[DrivePhysics, DriveTask]]:
        return [factory.make_env(seed, (self._evaluator, i)) for i, seed in enumerate(seeds)]

    @property
    def physics(self) -> list[DrivePhysics]:
        """Present physics of every environment. This property calls `sync`, which takes long."""
        self._simulation.sync(np.arange(len(self)))
        return self._physics

    def begin(self, which: Sequence[int]) -> None:
        self._each(lambda i: self._environments[i].reset(), which)
        some = np.array(which, int)
        self._simulation.begin(some)
        self._store(some, self._simulation.motion(some))
        if self.pixels:
            self.pixels.begin(which)

    def info(self, i: int) -> dict[str, Any]:
        info = self.tasks[i].episode_info(float(self._speed[i]), self._simulation.touched(i))
        return info | self._pixel_info(i)

    def _advance(self, wanted: Array, which: Sequence[int]) -> StepResult:
        some = np.array(which, int)
        commands = self.tasks[0].commands(wanted)
        self._evaluator.set_steering(some, commands[:, 1])
        self._simulation.step(some, commands)
        motion = self._simulation.motion(some)
        self._evaluator.evaluate(some, motion)
        self._store(some, motion)
        if self.pixels and not isinstance(self.pixels, GpuPixelObserver):
            self._simulation.sync(some)  # `PixelObserver` reads the state on the host
        return StepResult(self._evaluator.reward(some), *self._evaluator.ended(some))

    def _store(self, which: NDArray[np.int64], motion: Motion) -> None:
        self._states[which], self._speed[which] = self._evaluator.state(which, motion), motion.speed
