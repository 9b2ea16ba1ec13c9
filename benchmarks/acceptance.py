"""Acceptance table of the Husky model: rows of measured numbers with limits, and wrong models that must fail them.

*Subject*: a robot to measure, correct or deliberately wrong. *Edit*: a change to the `MjSpec` before it is compiled,
which makes a wrong model. Letters of the ids: A composition, B scrubbing on a plane, C friction at rest, D driving,
E ground from the pipeline, P convex parts. Read chi together with B4 to B6: a hopping model can have a plausible chi,
and a pyramidal cone has the right chi with a torque 21 % too low.
"""

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from twin.assets.ground import DATA_KINDS, Ground, HeightData, fit_low_passed
from twin.config import MeshConfig, MjcfConfig
from twin.env.controller import CONTROL_PERIOD, Controller
from twin.mjcf.husky import add_husky, center_of_mass, coulomb_track_ratio, set_options
from twin.mjcf.scene_xml import add_ground, rest_pose
from twin.robot import (
    CHASSIS_MASS,
    REAR_HEAVY,
    SIDES,
    TRACK,
    WHEEL_MASS,
    WHEEL_RADIUS,
    WHEEL_WIDTH,
    WHEELBASE,
    WHEELS,
    HuskyParams,
)
from twin.types import Array

# ---- drives and recordings


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
    cell: float = MjcfConfig.hfield_cell,
) -> mujoco.MjModel:
    """Model of the Husky on a height field as the mjcf stage writes it, starting at x, y [m] and yaw [rad]."""
    spec = mujoco.MjSpec()
    set_options(spec, params)
    with tempfile.TemporaryDirectory(prefix="twin-ground-") as folder:
        spec.modelfiledir = spec.meshdir = spec.texturedir = folder
        add_ground(spec, ground, Path(folder), cell)
        position, quaternion = rest_pose(ground.at, np.array(start[:2]), start[2])
        add_husky(spec, position, quaternion, params)
        if edit is not None:
            edit(spec)
        return spec.compile()


@dataclass(frozen=True)
class Recording:
    """n physics steps. Arrays per wheel are ordered as `twin.robot.WHEELS`, per side as `SIDES`."""

    timestep: float
    """[s]"""
    wheel: Array
    """Wheel speeds [rad/s], shape (n, 4)."""
    torque: Array
    """Motor torques at the wheels of a side [N m], shape (n, 2)."""
    pose: Array
    """x, y, z [m], yaw and pitch [rad] of the base, yaw without jumps, shape (n, 5)."""
    velocity: Array
    """x, y in the world [m/s] and yaw rate [rad/s], shape (n, 3)."""
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
        """Track ratio."""
        return self.wheel_difference / (self.yaw_rate * TRACK)

    @property
    def power(self) -> Array:
        """Mechanical power of the motors [W], shape (n,)."""
        return (self.torque * (self.wheel[:, :2] + self.wheel[:, 2:]) / 2).sum(1)

    @property
    def jolt(self) -> float:
        """Vertical acceleration of the camera [m/s² rms]."""
        return float(np.diff(self.camera_z, 2).std() / self.timestep**2)

    def per_frame(self, values: Array, rate: float = 30.0) -> Array:
        """Changes of a series (n,) between frames at `rate` [1/s]."""
        every = 1.0 / (rate * self.timestep)
        steps = np.arange(0.0, len(values) - 1, every)
        return np.diff(np.interp(steps, np.arange(len(values)), values))


def start_of(model: mujoco.MjModel) -> mujoco.MjData:
    """State of the robot at rest."""
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

    `commands` maps the time [s] to v [m/s] and ω [rad/s], every 0.1 s; None = no command. `params` are those of the
    controller. `data` is the initial state (by default the robot at rest) and is changed in place.
    """
    data = start_of(model) if data is None else data
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
    """Power dissipated by all contacts: Σ −(friction · slip velocity + rolling and spinning moments · spin) [W]."""
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


# ---- rows and subjects


GRAVITY = 9.81  # [m/s²]
MASS = CHASSIS_MASS + 4 * WHEEL_MASS  # [kg] without payload


@dataclass(frozen=True)
class Row:
    """A measured number and its limits."""

    id: str
    quantity: str
    value: float
    low: float
    high: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        return bool(self.low <= self.value <= self.high)  # NaN fails


@dataclass(frozen=True)
class Subject:
    """A robot to measure."""

    params: HuskyParams = field(default_factory=HuskyParams)
    edit: Edit | None = None
    """Makes the model wrong."""

    def plane(self, **changes: Any) -> mujoco.MjModel:
        """Model on a plane, with changed parameters."""
        return on_plane(replace(self.params, **changes), self.edit)

    def turn(
        self, yaw_rate: float = 1.0, v: float = 0.0, skip: float = 1.5, seconds: float = 1.0, **changes: Any
    ) -> Recording:
        """Turns on a plane at ω [rad/s] and v [m/s] with changed parameters; records `seconds` after `skip` [s]."""
        return drive(self.plane(**changes), v, yaw_rate, skip, seconds, replace(self.params, **changes))


# ---- test grounds


_SPACING = 0.25  # [m] between data, as in `twin.assets.ground`
_FIELD_NOISE, _PATH_NOISE = 0.03, 0.012  # [m] σ of rendered heights and of a steady camera, as in `twin.assets.ground`
_LATERAL_OFFSETS = np.array([-0.6, -0.3, 0.0, 0.3, 0.6])  # [m] from the path


def level(height: float = 0.0, half: float = 8.0, cell: float = 0.1) -> Ground:
    """Level ground around the origin, `half` [m] to each side."""
    n = round(2 * half / cell) + 1
    return _gray(np.full((n, n), height), np.array([-half, -half]), cell)


def random_relief(rms: float, length: float, rng: np.random.Generator, half: float = 9.0) -> Callable[[Array], Array]:
    """Isotropic Gaussian bumps around the origin: maps points (k, 2) to height; `length` [m] is the σ of the kernel."""
    cell = length / 4
    n = round(2 * half / cell) + 1
    height = gaussian_filter(rng.normal(size=(n, n)), length / cell)
    bumps = _gray(height * rms / height.std(), np.array([-half, -half]), cell)
    return bumps.at


def reconstructed(
    rng: np.random.Generator, relief: Callable[[Array], Array] | None = None, size: tuple[float, float] = (8.0, 4.0)
) -> Ground:
    """Ground fitted as in a build to noisy data of a road along x, `size` [m] to each side of the origin.

    `relief` maps points (k, 2) to the true height [m]; level by default.
    """
    relief = relief or (lambda xy: np.zeros(len(xy)))
    high = np.array(size)
    x, y = (np.arange(-h + _SPACING / 2, h, _SPACING) for h in size)
    field = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    # The sway of a hand-held camera shifts the data beside the path, too.
    sway = np.repeat(rng.normal(0.0, _PATH_NOISE, len(x)), len(_LATERAL_OFFSETS))
    path = np.stack(np.meshgrid(x, _LATERAL_OFFSETS, indexing="ij"), -1).reshape(-1, 2)
    data = HeightData.join(
        [
            _data(field, relief(field) + rng.normal(0.0, _FIELD_NOISE, len(field)), _FIELD_NOISE, "field"),
            _data(path, relief(path) + sway, _PATH_NOISE, "path"),
        ]
    )
    height, grid, _ = fit_low_passed(data, -high, high, MeshConfig())
    return _gray(height, grid.origin, grid.cell)


def roughness(ground: Ground, line: Array) -> tuple[float, float]:
    """Rms [m] and correlation length [m] of the heights along a polyline (m, ≥2).

    A straight line is subtracted per 8 m, which is much longer than the robot. The autocorrelation falls to 1/e at the
    correlation length.
    """
    step = ground.cell / 2
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    s = np.arange(0.0, length[-1], step)
    z = ground.at(np.stack([np.interp(s, length, line[:, k]) for k in (0, 1)], 1))
    window = min(len(z), round(8.0 / step))
    parts = []
    for start in range(0, len(z) - window + 1, window):
        at = s[start : start + window]
        parts.append(z[start : start + window] - np.polyval(np.polyfit(at, z[start : start + window], 1), at))
    residuals = np.array(parts)
    variance = float((residuals**2).mean())
    for lag in range(1, window // 2):
        if (residuals[:, lag:] * residuals[:, :-lag]).mean() < variance / np.e:
            return float(np.sqrt(variance)), lag * step
    return float(np.sqrt(variance)), window // 2 * step


def _data(xy: Array, z: Array, sigma: float, kind: str) -> HeightData:
    kinds = np.full(len(xy), DATA_KINDS.index(kind), np.int8)
    return HeightData(np.column_stack([xy, z]), np.full(len(xy), sigma), kinds)


def _gray(height: Array, origin: Array, cell: float) -> Ground:
    return Ground(height, origin, cell, np.ones(height.shape, bool), np.full((*height.shape, 3), 90, np.uint8))


# ---- rows E and P: ground from the pipeline, and convex parts


def flat_ground(subject: Subject) -> list[Row]:
    """E1 and E2 on a level height field, and on a flat road reconstructed from noisy data."""
    rows = []
    turn, straight = subject.turn(), drive(subject.plane(), 1.0, 0.0, 1.0, 1.0, subject.params)
    for label, ground in (
        ("level field", level()),
        ("flat road reconstructed", reconstructed(np.random.default_rng(0))),
    ):
        model = on_ground(ground, subject.params, subject.edit, start=(-5.0, 0.37, 0.1))
        run = drive(model, 1.0, 0.0, 1.0, 5.0, subject.params)
        arc = drive(model, 0.5, 0.5, 1.5, 2.0, subject.params)
        spot = drive(model, 0.0, 1.0, 1.5, 1.5, subject.params)
        pitching = math.degrees(_rms(run.per_frame(run.pose[:, 4])))
        extra, extra_straight = spot.power.mean() - turn.power.mean(), run.power.mean() - straight.power.mean()
        ratio = float(spot.power.mean() / turn.power.mean())
        rows += [
            Row("E1", f"{label}: jolt straight, 1 m/s", run.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: jolt on R = 1 m", arc.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: jolt turning at 1 rad/s", spot.jolt, 0.0, 1.0, "m/s²"),
            Row("E1", f"{label}: dz per frame", 1000 * _rms(run.per_frame(run.camera_z)), 0.0, 0.3, "mm rms"),
            Row("E1", f"{label}: dpitch per frame", pitching, 0.0, 0.05, "° rms"),
            Row("E2", f"{label}: chi / plane's", spot.chi / turn.chi, 0.95, 1.05),
            Row("E2", f"{label}: turning power / plane's", ratio, 0.95, 1.05),
            Row("E2", f"{label}: turning, more than on the plane", float(extra), -math.inf, 10.0, "W"),
            Row("E2", f"{label}: straight, more than on the plane", float(extra_straight), -math.inf, 10.0, "W"),
        ]
    return rows


def reconstructed_ground(subject: Subject) -> list[Row]:
    """E3 on the roughest road that the pipeline produces: bumps of 3 cm rms and 0.5 m, low-passed."""
    rng = np.random.default_rng(1)
    ground = reconstructed(rng, random_relief(0.03, 0.5, rng))
    return chi_on(subject, ground, (-4.0, 0.0, 0.1), np.array([[-7.0, 0.0], [7.0, 0.0]]), "reconstructed bumps")


def chi_on(subject: Subject, ground: Ground, start: tuple[float, float, float], line: Array, label: str) -> list[Row]:
    """E3 on any ground from x, y [m] and yaw [rad]; the roughness is measured along `line` (m, ≥2)."""
    rms, length = roughness(ground, line)
    model = on_ground(ground, subject.params, subject.edit, start)
    turn = drive(model, 0.0, 1.0, 1.5, 2.0 * math.pi, subject.params)
    quantity = f"chi on {label} (rms {1000 * rms:.1f} mm, correlation length {length:.2f} m)"
    return [Row("E3", quantity, turn.chi, 1.6, 2.3)]


def halved_step(subject: Subject) -> list[Row]:
    """E4 on a plane and, over a whole turn, on a height field."""

    def halve(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        spec.option.timestep /= 2

    def turns(of: Subject) -> dict[str, Recording]:
        field = on_ground(level(), of.params, of.edit)
        return {"plane": of.turn(), "height field": drive(field, 0.0, 1.0, 1.5, 2.0 * math.pi, of.params)}

    rows = []
    fine = turns(replace(subject, edit=halve))
    for label, coarse in turns(subject).items():
        chi, power = fine[label].chi / coarse.chi, float(fine[label].power.mean() / coarse.power.mean())
        rows += [
            Row("E4", f"{label}: change of chi with half the step", 100 * abs(chi - 1), 0.0, 1.0, "%"),
            Row("E4", f"{label}: change of power", 100 * abs(power - 1), 0.0, 1.0, "%"),
        ]
    return rows


def plates(subject: Subject) -> list[Row]:
    """P1: flush convex parts, 0.3 m long, with seams across and along the way, as where a mesh was cut in two."""

    def lay(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        for i in range(30):
            for j, y in enumerate((-1.0, 0.2)):
                _convex(spec, f"part_{i:02d}_{j}", _box((-1.0 + 0.3 * i, y, -0.2), (0.3, 1.2, 0.2)))
        spec.geom("ground").pos = (0.0, 0.0, -0.2)

    model = on_plane(subject.params, lay)
    run = drive(model, 1.0, 0.0, 1.0, 5.0, subject.params)
    arc = drive(model, 0.5, 0.5, 1.0, 2.0, subject.params)
    return [
        Row("P1", "jolt over flush plates, 1 m/s", run.jolt, 0.0, 1.0, "m/s²"),
        Row("P1", "jolt over flush plates on R = 1 m", arc.jolt, 0.0, 1.0, "m/s²"),
        Row("P1", "sideways after 5 m", 100 * abs(float(np.ptp(run.pose[:, 1]))), 0.0, 5.0, "cm"),
    ]


def ramp(subject: Subject) -> list[Row]:
    """P2: a wedge that rises by 10° to a platform of 0.35 m, both convex meshes, as curbs and ramps of a build."""
    height, run_up = 0.35, 0.35 / math.tan(math.radians(10.0))

    def put(spec: mujoco.MjSpec) -> None:
        if subject.edit is not None:
            subject.edit(spec)
        side = ((1.0, 0.0), (1.0 + run_up, 0.0), (1.0 + run_up, height))
        _convex(spec, "part_wedge", np.array([[x, y, z] for y in (-1.0, 1.0) for x, z in side]))
        _convex(spec, "part_platform", _box((1.0 + run_up, -1.0, 0.0), (3.0, 2.0, height)))

    up = drive(on_plane(subject.params, put), 0.5, 0.0, 0.1, 8.0, subject.params)
    climbing = np.degrees(up.pose[:, 4])
    at_top = up.pose[-1, 2] - up.pose[0, 2]
    speed = np.linalg.norm(np.gradient(up.pose[:, :3], up.timestep, axis=0), axis=1)
    on_ramp = (climbing < -9.5) & (climbing > -10.5)
    return [
        Row("P2", "rise on a ramp of 10° and a platform of 0.35 m", float(at_top), 0.34, 0.36, "m"),
        Row("P2", "speed on the ramp / wheel speed", float(speed[on_ramp].mean() / _rolled(up, on_ramp)), 0.95, 1.0),
        Row("P2", "sideways", 100 * abs(float(np.ptp(up.pose[:, 1]))), 0.0, 5.0, "cm"),
    ]


def _rolled(run: Recording, chosen: NDArray[np.bool_]) -> float:
    return float(run.wheel[chosen].mean()) * WHEEL_RADIUS


def _box(corner: tuple[float, float, float], size: tuple[float, float, float]) -> Array:
    """Eight corners of an upright box from its low corner [m]."""
    return np.array(corner) + np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3) * np.array(size)


def _convex(spec: mujoco.MjSpec, name: str, vertices: Array) -> None:
    mesh = spec.add_mesh(name=name)
    mesh.uservert = vertices.ravel()
    spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


# ---- rows A to D: composition, scrubbing and friction on a plane, driving straight


_TURNS = (0.3, 1.0, 1.8)  # [rad/s] commanded


def composition(subject: Subject) -> list[Row]:
    """A1: violations of free joint, four hinges, motors on the wheels only, no artificial aids."""
    model = subject.plane()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    tires = [model.geom(f"{name}_tyre").id for name in WHEELS]
    hinges = [model.joint(f"{name}_wheel") for name in WHEELS]
    solid = np.flatnonzero((model.geom_contype | model.geom_conaffinity) & (model.geom_bodyid > 0))
    chassis = [model.geom("chassis_0").id, model.geom("chassis_1").id]
    violations = {
        "joints": model.jnt_type.tolist() != [mujoco.mjtJoint.mjJNT_FREE] + [mujoco.mjtJoint.mjJNT_HINGE] * 4,
        "actuators": model.nu != 2 or moment[:, :6].any() or (np.abs(moment[:, 6:]).sum(1) != 1.0).any(),
        "mocap": model.nmocap > 0,
        "equalities": (model.eq_type != mujoco.mjtEq.mjEQ_JOINT).any(),
        "wheels": any(joint.bodyid[0] != model.body(joint.name).id for joint in hinges),
        "casters": set(solid) != {*tires, *chassis} or (model.geom_friction[tires, 0] < 0.1).any(),
        "gravity": bool(model.body_gravcomp.any()),
        "tyres": (model.geom_type[tires] == mujoco.mjtGeom.mjGEOM_MESH).any(),
        "flags": model.opt.disableflags != 0 or model.opt.enableflags != 0,
    }
    violated = [name for name, wrong in violations.items() if wrong]
    return [Row("A1", f"what does not belong: {', '.join(violated) or 'nothing'}", float(len(violated)), 0.0, 0.0)]


def measures(subject: Subject) -> list[Row]:
    """A2: largest relative error of five measures."""
    model = subject.plane(payload_mass=10.0)
    hubs = np.array([model.body(f"{name}_wheel").pos for name in WHEELS])
    size = model.geom("front_left_tyre").size
    pairs = (
        (model.body_mass.sum(), MASS + 10.0),
        (np.ptp(hubs[:, 0]), WHEELBASE),
        (np.ptp(hubs[:, 1]), TRACK),
        (size[0], WHEEL_RADIUS),
        (2 * size[1], WHEEL_WIDTH),
    )
    worst = max(abs(float(a) / b - 1.0) for a, b in pairs)
    return [Row("A2", "mass with 10 kg payload, L, B, r, width off the table", 100 * worst, 0.0, 1.0, "%")]


def track_ratios(subject: Subject) -> list[Row]:
    """B1: chi of a centered and of a rear-heavy robot."""
    rows = []
    for label, center, bound in (("centred", HuskyParams.center_of_mass, 0.03), ("rear-heavy", REAR_HEAVY, 0.10)):
        changed = replace(subject.params, center_of_mass=center)
        expected = coulomb_track_ratio(center_of_mass(changed))
        for rate in _TURNS:
            skip = 1.5 if label == "centred" else 3.0
            turn = subject.turn(rate, skip=skip, center_of_mass=center)
            low, high = expected * (1 - bound), expected * (1 + bound)
            rows.append(Row("B1", f"chi at {rate:g} rad/s, {label} (Coulomb {expected:.3f})", turn.chi, low, high))
    return rows


def friction_spread(subject: Subject) -> list[Row]:
    """B2: spread of chi over friction."""
    ratios = [subject.turn(friction=mu).chi for mu in (0.35, 0.7, 1.0)]
    return [Row("B2", "spread of chi over friction .35, .7, 1", 100 * np.ptp(ratios) / np.mean(ratios), 0.0, 2.0, "%")]


def arcs(subject: Subject) -> list[Row]:
    """B3: chi on arcs at 0.4 m/s."""
    on_the_spot = subject.turn().chi
    rows = []
    for radius in (0.5, 1.0, 2.0):
        arc = subject.turn(0.4 / radius, 0.4)
        rows.append(Row("B3", f"chi on R = {radius:g} m", arc.chi, 0.97 * on_the_spot, 1.03 * on_the_spot))
    return rows


def scrubbing(subject: Subject) -> list[Row]:
    """B4 and B5: torque and power of a point turn at 1 rad/s."""
    turn = subject.turn()
    load = MASS * GRAVITY / 4
    arm = WHEEL_RADIUS * math.sin(math.atan(WHEELBASE / TRACK))
    expected = subject.params.friction * load * arm
    return [
        Row("B4", "wheel torque / Coulomb torque", float(np.abs(turn.torque).mean() / 2 / expected), 0.95, 1.05),
        Row("B5", "motor power / dissipated power", float(turn.power.mean() / turn.dissipated.mean()), 0.97, 1.05),
        Row("B5", "least motor power", float(turn.power.min()), 0.0, math.inf, "W"),
    ]


def quiet(subject: Subject) -> list[Row]:
    """B6 and B7: jolt and loaded wheels in point turns."""
    rows, loaded = [], []
    for rate, friction in (*((rate, subject.params.friction) for rate in _TURNS), (1.8, 1.0)):
        # Flutter takes seconds to build up, and shows first in the fastest turn at the highest friction.
        turn = subject.turn(rate, skip=5.0 if friction == 1.0 else 1.5, friction=friction)
        loaded.append(float((turn.loaded == 4).mean()))
        rows.append(Row("B6", f"jolt at {rate:g} rad/s, friction {friction:g}", turn.jolt, 0.0, 0.2, "m/s²"))
    return [*rows, Row("B7", "steps with four wheels loaded", 100 * min(loaded), 99.9, 100.0, "%")]


def drift(subject: Subject) -> list[Row]:
    """B8: drift in a point turn."""
    turn = subject.turn(skip=0.1, seconds=3.0)
    away = 1000 * float(np.linalg.norm(turn.pose[-1, :2] - turn.pose[0, :2]))
    return [Row("B8", "drift in a 3 s point turn", away, 0.0, 5.0, "mm")]


def push(subject: Subject) -> list[Row]:
    """C1: a sideways force at the center of mass of the parked robot for 1 s."""
    values = []
    for ratio in (0.7, 1.3):
        model = subject.plane()
        data = start_of(model)
        base, mass = model.body("base_link").id, float(model.body_mass.sum())
        force = np.array([0.0, ratio * subject.params.friction * mass * GRAVITY, 0.0])
        data.xfrc_applied[base] = [*force, *np.cross(data.subtree_com[base] - data.xipos[base], force)]
        steps = round(0.5 / model.opt.timestep)
        mujoco.mj_step(model, data, steps)
        before = data.qvel[1]
        mujoco.mj_step(model, data, steps)
        excess = (ratio - 1.0) * subject.params.friction * GRAVITY
        values.append((1000 * abs(float(data.qvel[1])), float(data.qvel[1] - before) / 0.5 / excess))
    return [
        Row("C1", "speed under a push of 0.7 μmg", values[0][0], 0.0, 3.0, "mm/s"),
        Row("C1", "acceleration under 1.3 μmg / (F − μmg)/m", values[1][1], 0.95, 1.05),
    ]


def slopes(subject: Subject) -> list[Row]:
    """C2: creep and sliding on slopes; gravity is tilted instead of the plane, which is equivalent."""
    rows = []
    limit = math.degrees(math.atan(subject.params.friction))
    for steeper, low, high in ((-2.0, 0.0, 10.0), (2.0, 500.0, math.inf)):
        for facing, yaw in (("up", math.pi), ("down", 0.0), ("across", math.pi / 2)):
            model = subject.plane()
            angle = math.radians(limit + steeper)
            down = np.array([math.cos(yaw), math.sin(yaw), 0.0])
            model.opt.gravity[:] = GRAVITY * (math.sin(angle) * down - [0.0, 0.0, math.cos(angle)])
            data = mujoco.MjData(model)
            mujoco.mj_step(model, data, round(2.0 / model.opt.timestep))
            speed = 1000 * float(np.linalg.norm(data.qvel[:2]))
            rows.append(
                Row("C2", f"speed facing {facing}, atan μ {steeper:+.0f}°, after 2 s", speed, low, high, "mm/s")
            )
    return rows


def stall(subject: Subject) -> list[Row]:
    """C3: yaw rate with limited motor torque."""
    free = subject.turn().yaw_rate
    weak, strong = (subject.turn(skip=2.0, motor_torque=2 * cap).yaw_rate for cap in (10.0, 12.0))
    return [
        Row("C3", "yaw rate with 10 N m per wheel / uncapped", weak / free, -0.02, 0.02),
        Row("C3", "yaw rate with 12 N m per wheel / uncapped", strong / free, 0.9, 1.1),
    ]


def straight(subject: Subject) -> list[Row]:
    """D1, D2, D3 and D5: 10 m straight at 1 m/s."""
    run = drive(subject.plane(), 1.0, 0.0, skip=1.0, seconds=10.0, params=subject.params)
    speed = float((run.pose[-1, 0] - run.pose[0, 0]) / (run.timestep * (len(run.pose) - 1)))
    rolled = float(run.wheel.mean() * WHEEL_RADIUS)
    expected = subject.params.rolling_resistance * MASS * GRAVITY * speed
    return [
        Row("D1", "sideways after 10 m", 100 * abs(float(run.pose[-1, 1] - run.pose[0, 1])), 0.0, 2.0, "cm"),
        Row("D1", "turned after 10 m", abs(math.degrees(run.pose[-1, 3] - run.pose[0, 3])), 0.0, 0.3, "°"),
        Row("D2", "slip at 1 m/s", 100 * (1.0 - speed / rolled), 0.0, 2.0, "%"),
        Row("D3", "power / (Crr m g v)", float(run.power.mean()) / expected, 0.9, 1.1),
        Row("D5", "fastest", float(np.linalg.norm(run.velocity[:, :2], axis=1).max()), 0.9, 1.0, "m/s"),
        Row("D5", "fastest wheel", float(np.abs(run.wheel).max()) * WHEEL_RADIUS, 0.9, 1.0 + 1e-6, "m/s"),
    ]


def stops(subject: Subject) -> list[Row]:
    """D4: stopping distances."""
    model = subject.plane()
    rows = []
    for label, ramp, low, high in (("3 m/s² ramp", True, 0.12, 0.20), ("instant zero", False, 0.065, 0.13)):
        data = start_of(model)
        record(model, lambda _: (1.0, 0.0), 1.5, 1.4, subject.params, data)
        controller = Controller(subject.params)
        controller.command(0.0, 1.0, 0.0)
        for _ in range(4):
            controller.update(0.0)  # ramps its own command up to 1 m/s
        x = float(data.qpos[0])
        for k in range(10):
            controller.command(k * 0.1, 0.0, 0.0)
            speeds = controller.update(k * 0.1)
            data.ctrl[[model.actuator(side).id for side in SIDES]] = speeds if ramp else 0.0
            mujoco.mj_step(model, data, round(0.1 / model.opt.timestep))
        stopped = abs(float(data.qvel[0])) < 0.01
        rows.append(
            Row("D4", f"stop from 1 m/s: {label}", float(data.qpos[0]) - x if stopped else math.inf, low, high, "m")
        )
    return rows


def overshoot(subject: Subject) -> list[Row]:
    """D6: overshoot after a step command of 1 rad/s."""
    turn = subject.turn(skip=0.0, seconds=2.0)
    rate = turn.velocity[:, 2]
    return [Row("D6", "yaw rate overshoot", 100 * float(rate.max() / rate[-250:].mean() - 1.0), 0.0, 10.0, "%")]


# ---- table and negative controls


MEASURES: dict[str, Callable[[Subject], list[Row]]] = {
    "A1": composition,
    "A2": measures,
    "B1": track_ratios,
    "B2": friction_spread,
    "B3": arcs,
    "B4 B5": scrubbing,
    "B6 B7": quiet,
    "B8": drift,
    "C1": push,
    "C2": slopes,
    "C3": stall,
    "D1 D2 D3 D5": straight,
    "D4": stops,
    "D6": overshoot,
    "E1 E2": flat_ground,
    "E3": reconstructed_ground,
    "E4": halved_step,
    "P1": plates,
    "P2": ramp,
}
"""Measuring function of each group of rows."""


@dataclass(frozen=True)
class Control:
    """A negative control: a model that is wrong in a known way."""

    name: str
    subject: Subject
    fails: tuple[str, ...]
    """Keys of MEASURES; the model must fail at least one row of each."""


def _default_contacts(spec: mujoco.MjSpec) -> None:
    for name in WHEELS:
        tire = spec.geom(f"{name}_tyre")
        tire.solref, tire.solimp = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)


def _pyramidal_cone(spec: mujoco.MjSpec) -> None:
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def _mesh_tyres(spec: mujoco.MjSpec) -> None:
    angle = np.arange(32) * 2 * np.pi / 32
    rings = [(WHEEL_RADIUS * np.cos(angle), np.full(32, y), WHEEL_RADIUS * np.sin(angle)) for y in (-0.5, 0.5)]
    mesh = spec.add_mesh(name="polygon")
    mesh.uservert = (np.concatenate([np.stack(ring, 1) for ring in rings]) * [1.0, WHEEL_WIDTH, 1.0]).ravel()
    for name in WHEELS:
        tire = spec.geom(f"{name}_tyre")
        tire.type, tire.meshname = mujoco.mjtGeom.mjGEOM_MESH, "polygon"


def _casters(spec: mujoco.MjSpec) -> None:
    for name in WHEELS[2:]:
        tire = spec.geom(f"{name}_tyre")
        tire.condim, tire.friction = 1, (0.0, 0.0, 0.0)


CONTROLS = (
    Control("default contacts", Subject(edit=_default_contacts), ("B6 B7",)),
    Control("pyramidal cone", Subject(edit=_pyramidal_cone), ("B4 B5",)),
    Control("mesh tyres", Subject(edit=_mesh_tyres), ("A1", "B6 B7")),
    Control("frictionless casters", Subject(edit=_casters), ("A1", "B1", "B4 B5")),
)
