"""The physics of many worlds in one go on a GPU, by `mujoco_warp`.

Episodes begin, are judged and end on the host, in the same code as everywhere: its `MjData` says where a world is. A
control step takes the *state* of all worlds (positions, velocities, the solver's last accelerations) to the device,
lets the small steps pass there under the courses of their controllers, and brings the states back with the geoms that
were touched. A *slot* is a piece of a course: some small steps under one command, at whose end contacts are looked at;
worlds whose controllers run at other times have other slots. Numbers are of single precision there, and of another
solver: episodes are those of MuJoCo in kind, not bit for bit.

The device is a GPU, or for tests the CPU, where this is slower than MuJoCo itself.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (inside kernels, Warp's own types hold, which mypy does not know)

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp

from twin.env.dm_physics import DrivePhysics

_DRAWN = (
    *("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "cam_pos", "cam_quat", "body_mass", "body_inertia"),
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"),
)
"""What `Nominal.apply` makes different from world to world, with what MuJoCo derives from it."""

_SENT = ("qpos", "qvel", "qacc_warmstart")
_FETCHED = (*_SENT, "sensordata", "actuator_force")

_CONTACTS, _ROWS = 96, 384  # room per world for contacts and for the solver's rows; the demo needs a third
_OVERFLOWS = mjw.OverflowType.NEFC | mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE


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
        # Every look, and one more for every run of the controller.
        slots = 2 * (self._steps // robot.look_steps + 2)
        with wp.ScopedDevice(where):
            self._model = mjw.put_model(model, batch_sizes=dict.fromkeys(_DRAWN, n))
            self._data = mjw.make_data(model, nworld=n, nconmax=_CONTACTS, njmax=_ROWS)
            self._slot, self._looks = (wp.zeros((self._steps, n), dtype=int) for _ in range(2))
            self._speeds = wp.zeros((slots, n, model.nu), dtype=float)
            self._positions = wp.zeros((slots, n, model.nmocap), dtype=wp.vec3)
            self._turns = wp.zeros((slots, n, model.nmocap), dtype=wp.quat)
            self._history = wp.zeros((slots, n, model.nq), dtype=float)
            self._touched = wp.zeros((n, model.ngeom), dtype=int)
            self._is_robot, self._counts = (
                wp.array(mask.astype(np.int32), dtype=int) for mask in (robot.is_robot, robot.counts)
            )
        self._graph: Any = None

    def begin(self, which: Iterable[int]) -> None:
        """Takes over the models of worlds whose episodes have just begun."""
        which = list(which)
        for name in _DRAWN:
            array = getattr(self._model, name)
            values = array.numpy()
            for i in which:
                values[i] = getattr(self._worlds[i].robot.model, name).reshape(values[i].shape)
            array.assign(values)

    def step(self, which: Sequence[int]) -> None:
        """Lets a control step pass in some worlds, whose robots have been commanded.

        Raises:
            RuntimeError: more contacts than there is room for.
        """
        self._send(which)
        with wp.ScopedDevice(self._where):
            if self._where == "cpu":
                self._advance()
            else:
                if self._graph is None:
                    self._advance()  # compiles, which a capture must not
                    with wp.ScopedCapture() as capture:
                        self._advance()
                    self._graph = capture.graph
                    self._send_states()
                wp.capture_launch(self._graph)
        self._fetch(which)

    def _send(self, which: Sequence[int]) -> None:
        slot, looks = np.zeros((self._steps, len(self._worlds)), np.int32), np.zeros_like(self._looks.numpy())
        speeds, positions, turns = (a.numpy() for a in (self._speeds, self._positions, self._turns))
        self._ends: dict[int, list[tuple[float, Any, Any]]] = {}
        for i in which:
            robot, k = self._worlds[i].robot, 0
            data, time = robot.data, robot.time
            ends = self._ends[i] = []
            for number, (some, command) in enumerate(robot.course(self._period)):
                time += some * robot.model.opt.timestep
                if robot.surroundings:
                    robot.surroundings(time)
                data.ctrl[robot.actuators] = command
                speeds[number, i] = data.ctrl
                positions[number, i], turns[number, i] = data.mocap_pos, data.mocap_quat
                slot[k : k + some, i], looks[k + some - 1, i] = number, 1
                ends.append((time, data.mocap_pos.copy(), data.mocap_quat.copy()))
                k += some
        for array, values in (
            *((self._slot, slot), (self._looks, looks)),
            *((self._speeds, speeds), (self._positions, positions), (self._turns, turns)),
        ):
            array.assign(values)
        self._send_states()

    def _send_states(self) -> None:
        for name in _SENT:
            values = np.stack([getattr(world.robot.data, name) for world in self._worlds])
            getattr(self._data, name).assign(values.astype(np.float32))
        self._touched.zero_()
        self._data.overflow.zero_()

    def _advance(self) -> None:
        d = self._data
        contact, commands = d.contact, [self._slot, self._speeds, self._positions, self._turns]
        for k in range(self._steps):
            wp.launch(_before, d.nworld, [k, *commands], [d.ctrl, d.mocap_pos, d.mocap_quat])
            mjw.step(self._model, d)
            wp.launch(_keep, d.qpos.shape, [k, self._slot, d.qpos], [self._history])
            pairs = [d.nacon, contact.geom, contact.worldid, self._is_robot, self._counts]
            wp.launch(_touch, d.naconmax, [k, self._looks, *pairs], [self._touched])

    def _fetch(self, which: Sequence[int]) -> None:
        d = self._data
        over = int(np.bitwise_or.reduce(d.overflow.numpy().ravel()))
        if over & int(_OVERFLOWS):
            raise RuntimeError(f"mujoco_warp ran out of room: {mjw.OverflowType(over & int(_OVERFLOWS))!r}")
        states = {name: getattr(d, name).numpy() for name in _FETCHED}
        touched, history = self._touched.numpy(), self._history.numpy().astype(float)
        for i in which:
            robot = self._worlds[i].robot
            for name, values in states.items():
                getattr(robot.data, name)[:] = values[i]
            robot.data.time = self._ends[i][-1][0]
            looks = [(time, history[k, i], *mocap) for k, (time, *mocap) in enumerate(self._ends[i])]
            robot.take_over(set(np.flatnonzero(touched[i]).tolist()), looks)
