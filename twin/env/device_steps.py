"""The physics of many worlds in one go on a GPU, by `mujoco_warp`.

Episodes begin, are judged and end on the host, in the same code as everywhere: its `MjData` says where a world is. A
control step takes the *state* of all worlds (positions, velocities, the solver's last accelerations) to the device,
lets the small steps pass there under the courses of their controllers, and brings the states back with the geoms that
were touched. A *slot* is a piece of a course: some small steps under one command, at whose end contacts are looked at;
worlds whose controllers run at other times have other slots. Numbers are of single precision there, and of another
solver: episodes are those of MuJoCo in kind, not bit for bit. On a GPU contacts are found in any order, so there they
are not the same twice, either.

The device is a GPU, or for tests the CPU, where this is slower than MuJoCo itself.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (inside kernels, Warp's own types hold, which mypy does not know)

from collections.abc import Sequence
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.env.controller import CONTROL_PERIOD
from twin.env.dm import control
from twin.env.dm_physics import DrivePhysics

_DRAWN = (
    *("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "cam_pos", "cam_quat", "body_mass", "body_inertia"),
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"),
)
"""What `Nominal.apply` makes different from world to world, with what MuJoCo derives from it."""

Array = NDArray[np.float64]
Looks = list[tuple[float, Array, Array]]
"""Of one world in one control step: time [s], `mocap_pos` and `mocap_quat` of each look."""

_SENT = ("qpos", "qvel", "qacc_warmstart")
_FETCHED = (*_SENT, "sensordata", "actuator_force")

_CONTACTS, _ROWS = 96, 384  # room per world for contacts and for the solver's rows; the demo needs a third
_OVERFLOWS = mjw.OverflowType.NEFC | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD


@wp.kernel
def _before(
    k: int,
    slot: wp.array2d(dtype=int),
    speeds: wp.array3d(dtype=float),
    positions: wp.array3d(dtype=wp.vec3),
    turns: wp.array3d(dtype=wp.quat),
    ctrl: wp.array2d(dtype=float),
    mocap_pos: wp.array2d(dtype=wp.vec3),
    mocap_quat: wp.array2d(dtype=wp.quat),
):
    """Commands of small step k, and where what moves by itself is in it."""
    world = wp.tid()
    mine = slot[k, world]
    for i in range(ctrl.shape[1]):
        ctrl[world, i] = speeds[mine, world, i]
    for i in range(mocap_pos.shape[1]):
        mocap_pos[world, i] = positions[mine, world, i]
        mocap_quat[world, i] = turns[mine, world, i]


@wp.kernel
def _keep(
    k: int,
    slot: wp.array2d(dtype=int),
    qpos: wp.array2d(dtype=float),
    history: wp.array3d(dtype=float),
):
    """Where worlds are at the ends of their slots: the last small step of a slot writes last."""
    world, i = wp.tid()
    history[slot[k, world], world, i] = qpos[world, i]


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


class DeviceSteps:
    """Steps n worlds of one compiled scene; the models may differ in what an episode draws."""

    def __init__(self, worlds: Sequence[DrivePhysics], period: float, where: str) -> None:
        """
        Args:
            worlds: Their physics.
            period: Between two commands [s].
            where: Warp's name of the device.
        """
        self._worlds, self._period, self._where = list(worlds), period, where
        robot, n = worlds[0].robot, len(worlds)
        model = robot.model
        self._steps = round(period / model.opt.timestep)
        # A piece ends with a look; every run of the controller, and the control step's end, may cut one short.
        slots = self._steps // robot.look_steps + round(period / CONTROL_PERIOD) + 3
        data = [world.robot.data for world in worlds]
        self._sent = {
            "slot": np.zeros((self._steps, n), np.int32),
            "looks": np.zeros((self._steps, n), np.int32),
            "speeds": np.zeros((slots, n, model.nu), np.float32),
            "positions": np.tile(np.float32([d.mocap_pos for d in data]), (slots, 1, 1, 1)),
            "turns": np.tile(np.float32([d.mocap_quat for d in data]), (slots, 1, 1, 1)),
        }
        self._drawn = {name: np.stack([getattr(world.robot.model, name) for world in worlds]) for name in _DRAWN}
        with wp.ScopedDevice(where):
            self._model = mjw.put_model(model, batch_sizes=dict.fromkeys(_DRAWN, n))
            self._model.opt.warn_overflow = 0  # what it prints from kernels; `_fetch` says it once
            if where != "cpu":
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
            self._data = mjw.make_data(model, nworld=n, nconmax=_CONTACTS, njmax=_ROWS)
            kinds = {"slot": int, "looks": int, "speeds": float, "positions": wp.vec3, "turns": wp.quat}
            self._there = {name: wp.array(self._sent[name], dtype=kind) for name, kind in kinds.items()}
            self._history = wp.zeros((slots, n, model.nq), dtype=float)
            self._touched = wp.zeros((n, model.ngeom), dtype=int)
            masks = (robot.is_robot, robot.counts)
            self._is_robot, self._counts = (wp.array(mask.astype(np.int32), dtype=int) for mask in masks)
            self._send_states()
            self._graph: Any = None
            if where != "cpu":
                # Now, as nothing else may use the GPU while a graph is captured; once before, as that compiles.
                self._advance()
                with wp.ScopedCapture() as capture:
                    self._advance()
                self._graph = capture.graph

    def begin(self, which: Sequence[int]) -> None:
        """Takes over the models of worlds whose episodes have just begun."""
        if not len(which):
            return
        for name, values in self._drawn.items():
            for i in which:
                values[i] = getattr(self._worlds[i].robot.model, name)
            array = getattr(self._model, name)
            # Vectors and quaternions are one element each there.
            array.assign(values.reshape(array.shape + getattr(array.dtype, "_shape_", ())))

    def step(self, which: Sequence[int]) -> None:
        """Lets a control step pass in some worlds, whose robots have been commanded.

        Raises:
            RuntimeError: more contacts than there is room for.
            PhysicsError: dm_control's; a world came apart.
        """
        looks = self._send(which)
        with wp.ScopedDevice(self._where):
            if self._graph is None:
                self._advance()
            else:
                wp.capture_launch(self._graph)
        self._fetch(which, looks)

    def _send(self, which: Sequence[int]) -> list[Looks]:
        """Sends courses and states."""
        sent, ends = self._sent, list[Looks]()
        sent["looks"][:] = 0
        for i in which:
            robot, k = self._worlds[i].robot, 0
            data, time = robot.data, robot.time
            ends.append([])
            for number, (some, command) in enumerate(robot.course(self._period)):
                time += some * robot.model.opt.timestep
                if robot.surroundings:
                    robot.surroundings(time)
                data.ctrl[robot.actuators] = command
                sent["speeds"][number, i] = data.ctrl
                sent["positions"][number, i], sent["turns"][number, i] = data.mocap_pos, data.mocap_quat
                sent["slot"][k : k + some, i], sent["looks"][k + some - 1, i] = number, 1
                ends[-1].append((time, data.mocap_pos.copy(), data.mocap_quat.copy()))
                k += some
        for name, values in sent.items():
            self._there[name].assign(values)
        self._send_states()
        return ends

    def _send_states(self) -> None:
        for name in _SENT:
            values = np.stack([getattr(world.robot.data, name) for world in self._worlds])
            getattr(self._data, name).assign(values.astype(np.float32))
        self._touched.zero_()
        self._data.overflow.zero_()

    def _advance(self) -> None:
        d, there = self._data, self._there
        contact, commands = d.contact, [there["slot"], there["speeds"], there["positions"], there["turns"]]
        for k in range(self._steps):
            wp.launch(_before, d.nworld, [k, *commands], [d.ctrl, d.mocap_pos, d.mocap_quat])
            mjw.step(self._model, d)
            wp.launch(_keep, d.qpos.shape, [k, there["slot"], d.qpos], [self._history])
            pairs = [d.nacon, contact.geom, contact.worldid, self._is_robot, self._counts]
            wp.launch(_touch, d.naconmax, [k, there["looks"], *pairs], [self._touched])

    def _fetch(self, which: Sequence[int], looks: list[Looks]) -> None:
        over = self._data.overflow.numpy()
        full = [i for i in which if over[i] & int(_OVERFLOWS)]
        if full:
            raise RuntimeError(
                f"worlds {full}: more than {_CONTACTS} contacts or {_ROWS} rows of constraints, for which mujoco_warp "
                "has no room; use device='cpu'"
            )
        states = {name: getattr(self._data, name).numpy() for name in _FETCHED}
        wrong = [i for i in which if not np.isfinite(np.append(states["qpos"][i], states["qvel"][i])).all()]
        if wrong:
            raise control.PhysicsError(f"worlds {wrong}: positions or velocities are no longer numbers")
        touched, history = self._touched.numpy(), self._history.numpy().astype(float)
        for i, ends in zip(which, looks, strict=True):
            robot = self._worlds[i].robot
            for name, values in states.items():
                getattr(robot.data, name)[:] = values[i]
            robot.data.time = ends[-1][0]
            seen = [(time, history[k, i], *mocap) for k, (time, *mocap) in enumerate(ends)]
            robot.take_over(set(np.flatnonzero(touched[i]).tolist()), seen)
