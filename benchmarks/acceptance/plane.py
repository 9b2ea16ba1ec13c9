"""Rows A to D: composition of the model, scrubbing and friction on a plane, driving straight."""

import math
from dataclasses import replace

import mujoco
import numpy as np

from acceptance import GRAVITY, MASS, REAR_HEAVY, Row, Subject
from acceptance.drives import drive, record, state_at_rest
from twin.env.controller import Controller
from twin.mjcf.husky import center_of_mass, coulomb_track_ratio
from twin.robot import SIDES, TRACK, WHEEL_RADIUS, WHEEL_WIDTH, WHEELBASE, WHEELS, HuskyParams

_TURNS = (0.3, 1.0, 1.8)  # [rad/s] commanded


def composition(subject: Subject) -> list[Row]:
    """A1: a free joint, four hinges, motors on the wheels only, and no artificial aids; counts the violations."""
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
    return [Row("A1", f"foreign elements: {', '.join(violated) or 'none'}", float(len(violated)), 0.0, 0.0)]


def measures(subject: Subject) -> list[Row]:
    """A2: largest relative error of mass, wheelbase, track, wheel radius and width."""
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
    return [Row("A2", "error of mass with 10 kg payload, wheelbase, track, wheel size", 100 * worst, 0.0, 1.0, "%")]


def track_ratios(subject: Subject) -> list[Row]:
    """B1: chi of a centered and of a rear-heavy robot."""
    rows = []
    for label, center, bound in (("centered", HuskyParams.center_of_mass, 0.03), ("rear-heavy", REAR_HEAVY, 0.10)):
        changed = replace(subject.params, center_of_mass=center)
        expected = coulomb_track_ratio(center_of_mass(changed))
        for rate in _TURNS:
            skip = 1.5 if label == "centered" else 3.0
            turn = subject.turn(rate, skip=skip, center_of_mass=center)
            low, high = expected * (1 - bound), expected * (1 + bound)
            rows.append(Row("B1", f"chi at {rate:g} rad/s, {label} (Coulomb {expected:.3f})", turn.chi, low, high))
    return rows


def friction_spread(subject: Subject) -> list[Row]:
    """B2: relative range of chi over friction."""
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
        Row("B5", "smallest motor power", float(turn.power.min()), 0.0, math.inf, "W"),
    ]


def quiet(subject: Subject) -> list[Row]:
    """B6 and B7: jolt of the camera, and fraction of steps with four wheels loaded, in point turns."""
    rows, loaded = [], []
    for rate, friction in (*((rate, subject.params.friction) for rate in _TURNS), (1.8, 1.0)):
        # Flutter takes seconds to build up and first occurs in the fastest turn at the highest friction.
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
    """C1: response of the parked robot to a sideways force at its center of mass for 1 s."""
    values = []
    for ratio in (0.7, 1.3):
        model = subject.plane()
        data = state_at_rest(model)
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
    """C2: creep and sliding on slopes. Gravity is tilted instead of the plane, which is equivalent."""
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
    """C3: yaw rate of a point turn with limited motor torque."""
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
        data = state_at_rest(model)
        record(model, lambda _: (1.0, 0.0), 1.5, 1.4, subject.params, data)
        controller = Controller(subject.params)
        controller.command(0.0, 1.0, 0.0)
        for _ in range(4):
            controller.update(0.0)  # ramps its internal command up to 1 m/s
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
