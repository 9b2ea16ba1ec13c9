"""Many worlds on a GPU: stepped, judged and, where the field alone is in view, seen all at once.

An episode begins on the host, world by world, as everywhere. After that nothing is done world by world but for those
who ask for one of them: `mujoco_warp` steps all (`vector_env_gpu.py`), one `Judge` judges all, and pictures stay on the
device (`observation.py`).
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (inside kernels, Warp's own types hold, which mypy does not know)

from collections.abc import Sequence
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.env.controller import SubstepSchedules, VectorController
from twin.env.observation import GpuPixelObserver
from twin.env.obstacles import Surroundings
from twin.env.options import control
from twin.env.physics import DrivePhysics
from twin.env.suite import EnvFactory
from twin.env.task import DriveTask, Motion, RewardAndTermination
from twin.env.vector_env_local import LocalVectorEnv, StepResult
from twin.geometry.cameras import opencv_to_mujoco
from twin.types import Array, Indices

# ---- The physics of many worlds in one go on a GPU, by `mujoco_warp`.
#
# Episodes begin on the host, in the same code as everywhere. From then on their *state* (positions, velocities, the
# solver's last accelerations) is kept here in arrays over all worlds: a control step takes it to the device, lets the
# small steps pass there under the courses of the robots' controllers (`controller.py`), and brings it back with the geoms
# that were touched. The worlds' own `MjData` are brought up to it when they are asked for (`sync`), as that takes far
# longer. Numbers are of single precision on the device, and of another solver: episodes are those of MuJoCo in kind, not
# bit for bit. On a GPU contacts are found in any order, so there they are not the same twice, either.
#
# The device is a GPU, or for tests the CPU, where this is slower than MuJoCo itself.


_DRAWN = (
    *("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "cam_pos", "cam_quat", "body_mass", "body_inertia"),
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"),
)
"""What `Nominal.apply` makes different from world to world, with what MuJoCo derives from it."""

_SENT = ("qpos", "qvel", "act", "qacc_warmstart")
_STATE = (*_SENT, "ctrl", "sensordata", "actuator_force")

_SAME_TIME = 1e-6  # [s] apart are rounding errors of the clock

_CONTACTS, _ROWS = 96, 384  # room per world for contacts and for the solver's rows; the demo needs a third
_OVERFLOWS = mjw.OverflowType.NEFC | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD


@wp.kernel
def _before(
    k: int,
    piece: wp.array2d(dtype=int),
    speeds: wp.array3d(dtype=float),
    positions: wp.array3d(dtype=wp.vec3),
    turns: wp.array3d(dtype=wp.quat),
    ctrl: wp.array2d(dtype=float),
    mocap_pos: wp.array2d(dtype=wp.vec3),
    mocap_quat: wp.array2d(dtype=wp.quat),
):
    """Commands of small step k, and where what moves by itself is in it."""
    world = wp.tid()
    mine = piece[k, world]
    for i in range(ctrl.shape[1]):
        ctrl[world, i] = speeds[mine, world, i]
    for i in range(mocap_pos.shape[1]):
        mocap_pos[world, i] = positions[mine, world, i]
        mocap_quat[world, i] = turns[mine, world, i]


@wp.kernel
def _keep(
    k: int,
    piece: wp.array2d(dtype=int),
    qpos: wp.array2d(dtype=float),
    history: wp.array3d(dtype=float),
):
    """Where worlds are at the ends of their pieces: the last small step of a piece writes last."""
    world, i = wp.tid()
    history[piece[k, world], world, i] = qpos[world, i]


@wp.kernel
def _touch(
    k: int,
    looks: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
    geoms: wp.array(dtype=wp.vec2i),
    worlds: wp.array(dtype=int),
    robot: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    touched: wp.array2d(dtype=int),
):
    """Marks both geoms of contacts between the robot and what counts, where small step k ends with a look."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    world, pair = worlds[contact], geoms[contact]
    if looks[k, world] == 0 or pair[0] < 0 or pair[1] < 0:
        return
    if (robot[pair[0]] == 1 and counts[pair[1]] == 1) or (robot[pair[1]] == 1 and counts[pair[0]] == 1):
        touched[world, pair[0]] = 1
        touched[world, pair[1]] = 1


class GpuSimulation:
    """Steps n worlds of one compiled scene; the models may differ in what an episode draws."""

    def __init__(self, worlds: Sequence[DrivePhysics], period: float, where: str) -> None:
        """
        Args:
            worlds: Their physics.
            period: Between two commands [s].
            where: Warp's name of the device.
        """
        self._worlds, self._where = list(worlds), where
        robot, n = worlds[0].robot, len(worlds)
        model, self._params = robot.model, robot.params
        self._steps = round(period / model.opt.timestep)
        self._controllers = VectorController(self._params, n, period, model.opt.timestep, robot.look_steps)
        pieces = self._controllers.pieces
        self._state = {name: np.stack([getattr(world.robot.data, name) for world in worlds]) for name in _STATE}
        self._stale = np.zeros(n, bool)
        self._touched = np.zeros((n, model.ngeom), bool)
        self._moving = np.zeros(n, bool)  # whether anything moves by itself
        mocap = [
            np.stack([getattr(world.robot.data, name) for world in worlds]) for name in ("mocap_pos", "mocap_quat")
        ]
        self._mocap = [np.tile(values, (pieces, 1, 1, 1)) for values in mocap]  # of each piece
        # Of the last looks, the newest last, and in the same order: what `HuskyPhysics.seen` goes by.
        kept = pieces * (int(np.ceil(self._params.camera_latency / period)) + 2) if self._params.camera_latency else 0
        self._look_times = np.full((kept, n), np.inf)
        self._looks = [np.zeros((kept, *values.shape)) for values in (self._state["qpos"], *mocap)]
        self._drawn = {name: np.stack([getattr(world.robot.model, name) for world in worlds]) for name in _DRAWN}
        self._camera, self._actuators = model.camera("front").id, robot.actuators
        with wp.ScopedDevice(where):
            self._model = mjw.put_model(model, batch_sizes=dict.fromkeys(_DRAWN, n))
            self._model.opt.warn_overflow = 0  # what it prints from kernels; `_fetch` says it once
            if where != "cpu":
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
            self._data = mjw.make_data(model, nworld=n, nconmax=_CONTACTS, njmax=_ROWS)
            self._piece, self._look = (wp.zeros((self._steps, n), dtype=int) for _ in range(2))
            self._speeds = wp.zeros((pieces, n, model.nu), dtype=float)
            kinds = zip(self._mocap, (wp.vec3, wp.quat), strict=True)
            self._mocap_there = [wp.array(values.astype(np.float32), dtype=kind) for values, kind in kinds]
            self._history = wp.zeros((pieces, n, model.nq), dtype=float)
            self._touched_there = wp.zeros((n, model.ngeom), dtype=int)
            masks = (robot.is_robot, robot.counts)
            self._is_robot, self._counts = (wp.array(mask.astype(np.int32), dtype=int) for mask in masks)
            self._send()
            self._graph: Any = None
            if where != "cpu":
                # Now, as nothing else may use the GPU while a graph is captured; once before, as that compiles.
                self._advance()
                with wp.ScopedCapture() as capture:
                    self._advance()
                self._graph = capture.graph

    def begin(self, which: Indices) -> None:
        """Takes over the models and states of worlds whose episodes have just begun."""
        if not len(which):
            return
        robots = [self._worlds[i].robot for i in which]
        for name, values in self._drawn.items():
            values[which] = [getattr(robot.model, name) for robot in robots]
            array = getattr(self._model, name)
            # Vectors and quaternions are one element each there.
            array.assign(values.reshape(array.shape + getattr(array.dtype, "_shape_", ())))
        for name, values in self._state.items():
            values[which] = [getattr(robot.data, name) for robot in robots]
        mocap = [np.stack([getattr(robot.data, name) for robot in robots]) for name in ("mocap_pos", "mocap_quat")]
        for values, there, new in zip(self._mocap, self._mocap_there, mocap, strict=True):
            values[:, which] = new
            there.assign(values.astype(np.float32))
        self._look_times[:, which] = np.inf
        if len(self._look_times):
            self._look_times[-1, which] = 0.0
            for values, new in zip(self._looks, (self._state["qpos"][which], *mocap), strict=True):
                values[-1, which] = new
        self._stale[which] = False
        self._touched[which] = [np.isin(np.arange(len(robot.is_robot)), list(robot.touching)) for robot in robots]
        self._moving[which] = [isinstance(r.surroundings, Surroundings) and r.surroundings.moving for r in robots]
        latency = np.array([robot.params.command_latency for robot in robots])
        self._controllers.begin(which, latency, np.array([robot.until_update for robot in robots]))

    def step(self, which: Indices, commands: Array) -> None:
        """Lets a control step pass in some worlds under commands, v [m/s] and ω [rad/s], shape (k, 2).

        Raises:
            RuntimeError: more contacts than there is room for.
            PhysicsError: dm_control's; a world came apart.
        """
        courses = self._controllers.courses(which, commands)
        self._surround(which, courses)
        speeds = np.zeros(self._speeds.shape, np.float32)
        speeds[:, :, self._actuators] = courses.speeds
        for there, values in ((self._piece, courses.piece), (self._look, courses.looks), (self._speeds, speeds)):
            there.assign(values)
        self._send()
        with wp.ScopedDevice(self._where):
            if self._graph is None:
                self._advance()
            else:
                wp.capture_launch(self._graph)
        self._fetch(which, courses)

    def motion(self, which: Indices) -> Motion:
        """Of the robots of some worlds."""
        qpos, qvel = self._state["qpos"][which], self._state["qvel"][which]
        matrix = _matrices(qpos[:, 3:7])
        pose = np.column_stack([qpos[:, :2], np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])])
        speed = (qvel[:, :3] * matrix[:, :, 0]).sum(-1)
        touched = self._touched[which].any(1)
        return Motion(pose, speed, qvel[:, 5], matrix[:, 2, 2], touched, self._controllers.time[which].copy())

    def touched(self, i: int) -> tuple[str, ...]:
        """Names of the geoms touched in world i during the last control step, sorted."""
        model = self._worlds[i].robot.model
        return tuple(sorted(model.geom(k).name for k in np.flatnonzero(self._touched[i])))

    def eyes(self, which: Indices) -> tuple[Array, Array]:
        """OpenCV poses of the front cameras when their newest pictures were taken, shape (k, 4, 4), and when that was
        [s], shape (k,)."""
        qpos, time = self._state["qpos"][which, :7], self._controllers.time[which]
        if len(self._look_times):
            qpos, time = self._before(which)
        matrix, pose = _matrices(qpos[:, 3:]), np.tile(np.eye(4), (len(which), 1, 1))
        pose[:, :3, :3] = matrix @ _matrices(self._drawn["cam_quat"][which, self._camera])
        pose[:, :3, 3] = qpos[:, :3] + (matrix @ self._drawn["cam_pos"][which, self._camera, :, None])[..., 0]
        return opencv_to_mujoco(pose), time

    def sync(self, which: Indices) -> None:
        """Brings the `MjData` of some worlds to where they are."""
        for i in which[self._stale[which]].tolist():
            robot = self._worlds[i].robot
            for name, values in self._state.items():
                getattr(robot.data, name)[:] = values[i]
            robot.data.mocap_pos[:], robot.data.mocap_quat[:] = (values[-1, i] for values in self._mocap)
            robot.data.time = self._controllers.time[i]
            looks = [
                (float(time), *(values[k, i].copy() for values in self._looks))
                for k, time in enumerate(self._look_times[:, i])
                if np.isfinite(time)
            ]
            robot.take_over(set(np.flatnonzero(self._touched[i]).tolist()), looks)
        self._stale[which] = False

    def _before(self, which: Indices) -> tuple[Array, Array]:
        """Positions, shape (k, 7), and times [s] of the bases when the newest pictures were taken, as `seen` says."""
        looks, qpos = self._look_times[:, which], self._looks[0][:, which, :7]
        time = self._controllers.time[which] - self._params.camera_latency
        row = np.arange(len(which))
        past = looks <= time + _SAME_TIME
        past[np.argmin(looks, 0), row] = True  # nothing is older than the beginning
        first = np.argmax(np.where(past, looks, -np.inf), 0)
        coming = np.where(past, np.inf, looks)
        last = np.argmin(coming, 0)
        start, end = looks[first, row], coming[last, row]
        a, b = qpos[first, row], qpos[last, row]
        between = (start + _SAME_TIME < time) & np.isfinite(end)
        share = np.zeros(len(which))
        share[between] = ((time - start) / (end - start))[between]
        # Between two looks, 10 ms apart, the straight line between two attitudes is as good as the arc.
        b[:, 3:] *= np.sign((a[:, 3:] * b[:, 3:]).sum(-1, keepdims=True))
        return a + share[:, None] * (b - a), np.where(between, time, start)

    def _surround(self, which: Indices, courses: SubstepSchedules) -> None:
        """Moves what moves by itself to where it is at the end of each piece."""
        moving = which[self._moving[which]]
        for i in moving.tolist():
            robot = self._worlds[i].robot
            times = courses.times[:, i]
            for p, time in enumerate(times[np.isfinite(times)].tolist()):
                assert robot.surroundings
                robot.surroundings(time)
                self._mocap[0][p:, i], self._mocap[1][p:, i] = robot.data.mocap_pos, robot.data.mocap_quat
        if len(moving):
            for values, there in zip(self._mocap, self._mocap_there, strict=True):
                there.assign(values.astype(np.float32))

    def _send(self) -> None:
        for name in _SENT:
            getattr(self._data, name).assign(self._state[name].astype(np.float32))
        self._touched_there.zero_()
        self._data.overflow.zero_()

    def _advance(self) -> None:
        d, contact = self._data, self._data.contact
        commands = [self._piece, self._speeds, *self._mocap_there]
        for k in range(self._steps):
            wp.launch(_before, d.nworld, [k, *commands], [d.ctrl, d.mocap_pos, d.mocap_quat])
            mjw.step(self._model, d)
            wp.launch(_keep, d.qpos.shape, [k, self._piece, d.qpos], [self._history])
            pairs = [d.nacon, contact.geom, contact.worldid, self._is_robot, self._counts]
            wp.launch(_touch, d.naconmax, [k, self._look, *pairs], [self._touched_there])

    def _fetch(self, which: Indices, courses: SubstepSchedules) -> None:
        over = self._data.overflow.numpy()[which] & int(_OVERFLOWS)
        if over.any():
            raise RuntimeError(
                f"worlds {which[over != 0].tolist()}: more than {_CONTACTS} contacts or {_ROWS} rows of constraints, "
                "for which mujoco_warp has no room; use device='cpu'"
            )
        new = {name: getattr(self._data, name).numpy()[which] for name in _STATE}
        finite = np.isfinite(new["qpos"]).all(1) & np.isfinite(new["qvel"]).all(1)
        if not finite.all():
            raise control.PhysicsError(
                f"worlds {which[~finite].tolist()}: positions or velocities are no longer numbers"
            )
        for name, values in self._state.items():
            values[which] = new[name]
        self._touched[which] = self._touched_there.numpy()[which] > 0
        self._stale[which] = True
        if len(self._look_times):
            newest = (
                courses.times[:, which],
                self._history.numpy()[:, which],
                *(values[:, which] for values in self._mocap),
            )
            for kept, some in zip((self._look_times, *self._looks), newest, strict=True):
                kept[: -len(some), which] = kept[len(some) :, which]
                kept[-len(some) :, which] = some


def _matrices(quaternions: Array) -> Array:
    """Rotation matrices (k, 3, 3) of quaternions w, x, y, z, shape (k, 4), of any length."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


class GpuVectorEnv(LocalVectorEnv):
    """n worlds of one scene and task that `mujoco_warp` steps."""

    def __init__(self, stage: EnvFactory, seeds: Sequence[int | None], device: str) -> None:
        """
        Args:
            stage: Scene, task and options.
            seeds: One per world, of its sequence of episodes; None: unpredictable.
            device: Warp's name of the device.
        """
        self._judge = RewardAndTermination(stage.world, stage.stretch, stage.options, len(seeds))
        self._speed = np.zeros(len(seeds))
        super().__init__(stage, seeds)
        self._device = GpuSimulation(self._physics, stage.options.control_timestep, device)
        if isinstance(self.pixels, GpuPixelObserver):
            self.pixels.eyes = self._device.eyes

    def _parts(self, stage: EnvFactory, seeds: Sequence[int | None]) -> list[tuple[DrivePhysics, DriveTask]]:
        return [stage.drive(seed, (self._judge, i)) for i, seed in enumerate(seeds)]

    @property
    def physics(self) -> list[DrivePhysics]:
        """Of every world, as it is now: they are brought up to it, which is no matter of course here."""
        self._device.sync(np.arange(len(self)))
        return self._physics

    def begin(self, which: Sequence[int]) -> None:
        self._each(lambda i: self._environments[i].reset(), which)
        some = np.array(which, int)
        self._device.begin(some)
        self._remember(some, self._device.motion(some))
        if self.pixels:
            self.pixels.begin(which)

    def info(self, i: int) -> dict[str, Any]:
        told = self.tasks[i].told(float(self._speed[i]), self._device.touched(i))
        return told | (self.pixels.info(i) if self.pixels else {})

    def _advance(self, wanted: Array, which: Sequence[int]) -> StepResult:
        some = np.array(which, int)
        commands = self.tasks[0].commands(wanted)
        self._judge.act(some, commands[:, 1])
        self._device.step(some, commands)
        motion = self._device.motion(some)
        self._judge.judge(some, motion)
        self._remember(some, motion)
        if self.pixels and not isinstance(self.pixels, GpuPixelObserver):
            self._device.sync(some)  # the host draws what is in view
        return StepResult(self._judge.reward(some), *self._judge.ended(some))

    def _remember(self, which: NDArray[np.int64], motion: Motion) -> None:
        self._states[which], self._speed[which] = self._judge.state(which, motion), motion.speed
