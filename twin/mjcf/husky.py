"""MuJoCo model of the Clearpath Husky A200, and its quasi-static skid steering; `husky_visuals.py` adds visual geoms.

`twin.robot` defines constants and frames; `add_husky` lists the names in the model. `python -m twin.mjcf.husky` writes
the robot alone to `twin/assets/husky/husky.xml`. To attach the robot to another scene, and to list the options of that
scene that are wrong for the robot:

    husky.set_options(spec)     # MuJoCo keeps the parent's options, and the tires need these
    robot = mujoco.MjSpec.from_file(str(husky.HUSKY_XML))
    spec.attach(robot, prefix="husky/", frame=spec.worldbody.add_frame(pos=on_the_ground))
    print(*husky.check(spec.compile()), sep="\\n")
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from twin.mjcf.husky_visuals import add_visuals
from twin.robot import (
    BASE_HEIGHT,
    CAMERA_SIZE,
    CHASSIS_MASS,
    HUB_HEIGHT,
    SIDES,
    TRACK,
    WHEEL_MASS,
    WHEEL_RADIUS,
    WHEEL_WIDTH,
    WHEELBASE,
    WHEELS,
    ZED2,
    HuskyParams,
    PixelCamera,
)
from twin.types import Array

TIMESTEP = 0.002  # [s]
HUSKY_XML = Path(__file__).parents[1] / "assets" / "husky" / "husky.xml"
"""The published robot alone, without a floor."""
HUSKY_SCENE_XML = HUSKY_XML.with_name("scene.xml")
"""The published robot on a plane, to be opened in a viewer."""

_CHASSIS_INERTIA = (0.6022, 1.7386, 2.0296, -0.02364, -0.1197, -0.001544)  # ixx iyy izz ixy ixz iyz [kg m²]
_WHEEL_INERTIA = (0.02467, 0.04411, 0.02467)  # [kg m²], the axle is y
_COLLISION_BOXES = (  # full size, center in the base [m]
    ((0.9874, 0.5709, 0.12375), (0.0, 0.0, 0.061875)),
    ((0.78992, 0.5709, 0.10375), (0.0, 0.0, 0.175625)),
)
# With MuJoCo's default solimp (d0 = 0.9), scrubbing wheels hop (12 to 17 m/s² at the body in a point turn), and the
# effective track depends on friction. An impedance that starts from zero does not jump at touchdown. The width of
# 2.5 mm is a compromise: with 3 mm, a wheel sinks in by 1.6 mm and touches the facets of a height field ahead of it,
# which shakes the camera by 0.9 m/s² instead of 0.5 m/s²; with 1 mm, a scrubbing wheel flutters at a friction of 1.0.
_WHEEL_SOLIMP = (0.0, 0.95, 0.0025, 0.5, 2.5)
_WHEEL_SOLREF = (0.02, 2.0)  # twice the critical damping, which reduces shaking on a height field by 1/6
_IMU_POSITION = (0.19, 0.0, 0.149)  # [m] position in the base

ROBOT_COLLISION_GROUP = 4
"""Group of the geoms that collide; that of visual geoms is `husky_visuals.ROBOT_VISUAL_GROUP`."""


def set_options(spec: mujoco.MjSpec, params: HuskyParams | None = None) -> None:
    """Sets the time step, the solver options that skid steering needs, and the softness of the ground."""
    params = params or HuskyParams()
    spec.option.timestep = TIMESTEP
    # Euler and RK4 are unstable with a stiff speed servo; implicitfast adds the servo's damping to the mass matrix.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The pyramidal friction cone gives the right track ratio, but a torque that is 23 % too low.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = params.slip_stiffness
    spec.option.viscosity = params.ground_viscosity
    # The default of 1e-8 takes twice the Newton iterations for the same motion.
    spec.option.tolerance = 1e-5


@dataclass(frozen=True)
class WrongOption:
    """A wrong option of a model: with its value, the robot's tires skid unrealistically."""

    option: str
    found: str
    expected: str
    cost: str
    """Effect of the wrong option on the robot; the figures come from `benchmarks/husky_options.py`."""

    def __str__(self) -> str:
        return f"{self.option} is {self.found}; expected {self.expected}: {self.cost}"


def check(model: mujoco.MjModel) -> list[WrongOption]:
    """Lists the options of a model that are wrong for the skid steering of the Husky in it.

    When a robot is attached to a scene, MuJoCo keeps the options of the scene, and the scene's ground can override the
    contact parameters of the tires.

    Raises ValueError if the model has no Husky.
    """
    names = [model.geom(i).name for i in range(model.ngeom)]
    tires = [i for i, name in enumerate(names) if name.endswith(tuple(f"{wheel}_tyre" for wheel in WHEELS))]
    if len(tires) < len(WHEELS):
        raise ValueError("no Husky in the model: expected geoms named front_left_tyre and so on, after any prefix")
    opt, out = model.opt, []

    def expect(right: bool, option: str, found: Any, expected: str, cost: str) -> None:
        if not right:
            out.append(WrongOption(option, str(found), expected, cost))

    def name_of(value: Any) -> str:
        return value.name.split("_", 1)[-1].lower()

    cone, integrator = mujoco.mjtCone(opt.cone), mujoco.mjtIntegrator(opt.integrator)
    implicit = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_IMPLICIT
    expect(cone == mujoco.mjtCone.mjCONE_ELLIPTIC, "cone", name_of(cone), "elliptic", COSTS["cone"])
    expect(opt.impratio >= 5.0, "impratio", f"{opt.impratio:g}", "10", COSTS["impratio"])
    expect(integrator in implicit, "integrator", name_of(integrator), "implicitfast", COSTS["integrator"])
    expect(opt.timestep <= 0.005, "timestep", f"{1e3 * opt.timestep:g} ms", "2 ms, at most 5", COSTS["timestep"])
    expect(opt.iterations >= 3, "iterations", opt.iterations, "3 or more", COSTS["iterations"])
    expect(opt.tolerance <= 1e-3, "tolerance", f"{opt.tolerance:g}", "1e-5", COSTS["tolerance"])
    override = bool(opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    expect(not override, "flag override", "enabled", "disabled", COSTS["contact"])
    for bit, flag in (
        (mujoco.mjtDisableBit.mjDSBL_CONSTRAINT, "constraint"),
        (mujoco.mjtDisableBit.mjDSBL_EQUALITY, "equality"),
        (mujoco.mjtDisableBit.mjDSBL_CONTACT, "contact"),
        (mujoco.mjtDisableBit.mjDSBL_ACTUATION, "actuation"),
        (mujoco.mjtDisableBit.mjDSBL_GRAVITY, "gravity"),
    ):
        expect(not opt.disableflags & bit, f"flag {flag}", "disabled", "enabled", "the robot cannot drive without it")
    tire_priority = int(model.geom_priority[tires].min())
    bodies = set(model.body_rootid[model.geom_bodyid[tires]])
    for i in range(model.ngeom):
        solid = model.geom_contype[i] or model.geom_conaffinity[i]
        if solid and model.body_rootid[model.geom_bodyid[i]] not in bodies and model.geom_priority[i] >= tire_priority:
            what, most = f"priority of geom {names[i] or i}", f"below the tires' {tire_priority}"
            expect(False, what, int(model.geom_priority[i]), most, COSTS["contact"])
    if set(tires) & {*model.pair_geom1, *model.pair_geom2}:
        expect(False, "contact pair", "given for a tire", "none", COSTS["contact"])
    return out


COSTS = {
    "cone": "a pyramidal cone turns with 23 % too little torque, and creeps down a slope at 9 cm/s",
    "impratio": "at 1, a parked robot creeps down a slope ten times faster, at 7 mm/s",
    "integrator": "with Euler or RK4 the wheels hop (3 m/s² at the camera), and turning takes three times the torque",
    "timestep": "at 10 ms the wheels hop (10 m/s²), and the robot turns 26 % slower, with three times the torque",
    "iterations": "with 1, a parked robot creeps down a slope at 15 cm/s",
    "tolerance": "at 1e-2, a parked robot creeps down a slope at 9 mm/s",
    "contact": "with MuJoCo's default contacts the wheels hop (14 m/s²), and the robot turns 28 % slower",
}
"""Option, or `contact` → effect of a wrong value, from `benchmarks/husky_options.py`."""


def add_husky(
    spec: mujoco.MjSpec,
    position: Any = (0.0, 0.0, BASE_HEIGHT),
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
    params: HuskyParams | None = None,
    camera: PixelCamera = ZED2,
) -> None:
    """Adds the robot to a model.

    The options of the model stay as they are, see `set_options`.

    Names: body and free joint `base_link`; bodies and joints `<front|rear>_<left|right>_wheel`; actuators `left` and
    `right`, commanded in wheel speed [rad/s]; cameras `front` (160 × 90) and `front_native` (native size); site `imu`;
    sensors `imu_gyro`, `imu_accelerometer`, `imu_orientation`, `<wheel>_wheel_position`, `<wheel>_wheel_velocity`,
    `left_torque`, `right_torque`; collision geoms `chassis_0`, `chassis_1`, `<wheel>_tyre`; `chassis_dry`, a geom
    without contacts (see `disable_fluid_drag`); `camera_*`, the geoms of the camera's housing, which are left out of
    the camera's own pictures.

    Args:
        spec: The model.
        position: Base origin [m], shape (3,).
        quaternion: w, x, y, z, shape (4,).
        params: The published robot by default.
        camera: Front camera at its native size, if `params` has no intrinsics.
    """
    params = params or HuskyParams()
    base = spec.worldbody.add_body(name="base_link", pos=position, quat=quaternion)
    base.add_freejoint(name="base_link")
    base.explicitinertial = True
    base.mass, base.ipos, base.fullinertia = _chassis_inertia(params)
    for i, (size, center) in enumerate(_COLLISION_BOXES):
        base.add_geom(
            name=f"chassis_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=np.array(size) / 2,
            pos=center,
            group=ROBOT_COLLISION_GROUP,
            rgba=(0.2, 0.2, 0.8, 0.4),
        )
    disable_fluid_drag(base, "chassis")
    wheels = {name: _add_wheel(base, name, i, params) for i, name in enumerate(WHEELS)}
    for side in SIDES:
        _add_side_motor(spec, side, params)
    base.add_site(name="imu", pos=_IMU_POSITION, size=(0.01, 0.01, 0.01), group=ROBOT_COLLISION_GROUP)
    native = params.camera(camera)
    _add_camera(base, "front", params, native.resized(CAMERA_SIZE))
    _add_camera(base, "front_native", params, native)
    _add_sensors(spec)
    add_visuals(spec, base, wheels, params)


def stiffen_for_rest(model: mujoco.MjModel) -> mujoco.MjModel:
    """Increases tire and servo stiffness in place to at least the published values; returns the model.

    With softer tires or servos a robot creeps down any slope and never comes to rest.
    """
    model.opt.impratio = max(model.opt.impratio, HuskyParams.slip_stiffness)
    for side in SIDES:
        motor = model.actuator(side)
        motor.gainprm[0] = max(motor.gainprm[0], HuskyParams.servo_gain)
        motor.biasprm[2] = -motor.gainprm[0]
    return model


def wheel_centers() -> Array:
    """Positions of the wheel hubs in the base [m], shape (4, 3), ordered as WHEELS."""
    x, y = WHEELBASE / 2, TRACK / 2
    return np.array([[x, y, HUB_HEIGHT], [x, -y, HUB_HEIGHT], [-x, y, HUB_HEIGHT], [-x, -y, HUB_HEIGHT]])


def _chassis_inertia(params: HuskyParams) -> tuple[float, Array, Array]:
    """Mass, center and inertia (ixx iyy izz ixy ixz iyz) of the chassis with its payload (a point mass)."""
    masses = np.array([CHASSIS_MASS, params.payload_mass])
    centers = np.array([params.center_of_mass, params.payload_position])
    mass = masses.sum()
    center = masses @ centers / mass
    xx, yy, zz, xy, xz, yz = _CHASSIS_INERTIA
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    for m, d in zip(masses, centers - center, strict=True):
        tensor = tensor + m * (d @ d * np.eye(3) - np.outer(d, d))
    return float(mass), center, tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def disable_fluid_drag(body: mujoco.MjsBody, name: str) -> None:
    """Exempts a body from the drag of `ground_viscosity`.

    MuJoCo's fluid acts on a whole body, unless some of its geoms have `fluid_ellipsoid`; then it acts on these alone.
    So a tiny geom with `fluid_ellipsoid` is added.
    """
    body.add_geom(
        name=f"{name}_dry",
        size=(1e-3, 1e-3, 1e-3),
        mass=0,
        contype=0,
        conaffinity=0,
        fluid_ellipsoid=True,
        group=ROBOT_COLLISION_GROUP,
    )


def _add_wheel(base: mujoco.MjsBody, name: str, index: int, params: HuskyParams) -> mujoco.MjsBody:
    wheel = base.add_body(name=f"{name}_wheel", pos=wheel_centers()[index])
    wheel.explicitinertial = True
    # Without ipos, MuJoCo takes the body's offset in its parent as the center of mass.
    wheel.mass, wheel.ipos, wheel.inertia = WHEEL_MASS, (0.0, 0.0, 0.0), _WHEEL_INERTIA
    wheel.add_joint(
        name=f"{name}_wheel", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 1, 0), armature=params.motor_inertia
    )
    radius = params.wheel_radius[index % 2]
    shapes: dict[str, dict[str, Any]] = {
        "ellipsoid": {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": (radius, WHEEL_WIDTH / 2, radius)},
        "cylinder": {
            "type": mujoco.mjtGeom.mjGEOM_CYLINDER,
            "size": (radius, WHEEL_WIDTH / 2, 0.0),
            "quat": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
        },
    }
    wheel.add_geom(
        name=f"{name}_tyre",
        group=ROBOT_COLLISION_GROUP,
        rgba=(0.2, 0.2, 0.8, 0.4),
        condim=6,
        priority=1,
        # MuJoCo's rolling friction [m] is the rolling resistance coefficient times the radius.
        friction=(params.friction, params.spin_friction, max(params.rolling_resistance * radius, 1e-5)),
        solimp=_WHEEL_SOLIMP,
        solref=_WHEEL_SOLREF,
        fluid_ellipsoid=True,
        **shapes[params.wheel_shape],
    )
    return wheel


def _add_side_motor(spec: mujoco.MjSpec, side: str, params: HuskyParams) -> None:
    """Adds the motor of a side: a servo on the mean speed of its two wheels, and the belt that couples the wheels."""
    belt = spec.add_equality(
        name=f"{side}_belt",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=f"rear_{side}_wheel",
        name2=f"front_{side}_wheel",
    )
    belt.data[:2] = 0.0, 1.0
    shaft = spec.add_tendon(name=f"{side}_shaft")
    for end in ("front", "rear"):
        shaft.wrap_joint(f"{end}_{side}_wheel", 0.5)
    limit = params.max_wheel_speed / WHEEL_RADIUS
    actuator = spec.add_actuator(
        name=side,
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target=f"{side}_shaft",
        forcelimited=True,
        forcerange=(-params.motor_torque, params.motor_torque),
        ctrllimited=True,
        ctrlrange=(-limit, limit),
    )
    actuator.set_to_velocity(kv=params.servo_gain)
    if params.servo_lag > 0:
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = params.servo_lag


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kind, of = mujoco.mjtSensor, mujoco.mjtObj
    for name, sensor, objtype, target in (
        ("imu_gyro", kind.mjSENS_GYRO, of.mjOBJ_SITE, "imu"),
        ("imu_accelerometer", kind.mjSENS_ACCELEROMETER, of.mjOBJ_SITE, "imu"),
        ("imu_orientation", kind.mjSENS_FRAMEQUAT, of.mjOBJ_SITE, "imu"),
        *((f"{w}_wheel_position", kind.mjSENS_JOINTPOS, of.mjOBJ_JOINT, f"{w}_wheel") for w in WHEELS),
        *((f"{w}_wheel_velocity", kind.mjSENS_JOINTVEL, of.mjOBJ_JOINT, f"{w}_wheel") for w in WHEELS),
        *((f"{side}_torque", kind.mjSENS_ACTUATORFRC, of.mjOBJ_ACTUATOR, side) for side in SIDES),
    ):
        spec.add_sensor(name=name, type=sensor, objtype=objtype, objname=target)


def _add_camera(base: mujoco.MjsBody, name: str, params: HuskyParams, camera: PixelCamera) -> None:
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.size
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, params.camera_rotation.ravel())
    base.add_camera(
        name=name,
        pos=params.camera_position,
        quat=quaternion,
        resolution=(width, height),
        focal_pixel=(fx, fy),
        # MuJoCo measures the principal point from the image center, positive to the left and upwards.
        principal_pixel=(width / 2 - cx, height / 2 - cy),
        # The metric sensor size is arbitrary: focal length and principal point scale with it.
        sensor_size=(width * 1e-5, height * 1e-5),
    )


def center_of_mass(params: HuskyParams) -> Array:
    """Center of mass of the whole robot in the base [m], shape (3,)."""
    mass, center, _ = _chassis_inertia(params)
    return (mass * center + WHEEL_MASS * wheel_centers().sum(0)) / (mass + 4 * WHEEL_MASS)


# ---- quasi-static skid steering, a reference for the model


def coulomb_track_ratio(center: Array) -> float:
    """Track ratio chi (effective track / `TRACK`) of four point contacts under Coulomb friction in a steady point turn.

    It does not depend on the friction coefficient μ.

    The friction force at a wheel with slip velocity s is −μN s/|s|; the forces and their moments about the center of
    mass sum to zero. A centered mass in a point turn gives exactly 1 + (wheelbase / track)².

    Args:
        center: Center of mass in the base [m], shape (≥2,); x and y are used.

    Raises:
        ArithmeticError: no balance was found.
    """
    arm = wheel_centers()[:, :2] - np.asarray(center)[:2]
    share_x = 0.5 + np.sign(arm[:, 0]) * center[0] / WHEELBASE
    share_y = 0.5 + np.sign(arm[:, 1]) * center[1] / TRACK
    load = share_x * share_y

    def residual(unknown: Array) -> Array:
        vx, vy, chi = unknown  # body velocity at the center of mass for unit yaw rate
        rolling = np.array([-1.0, 1.0, -1.0, 1.0]) * chi * TRACK / 2
        slip = np.stack([vx - arm[:, 1] - rolling, vy + arm[:, 0]], 1)
        force = -load[:, None] * slip / np.linalg.norm(slip, axis=1, keepdims=True)
        moment = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
        return np.array([force[:, 0].sum(), force[:, 1].sum(), moment.sum()])

    from scipy.optimize import root  # slow to import

    solution = root(residual, np.array([0.0, -center[0] * 0.5, 1.0 + (WHEELBASE / TRACK) ** 2]))
    if not solution.success:
        raise ArithmeticError(f"no quasi-static balance for a center of mass at {center}: {solution.message}")
    return float(solution.x[2])


# ---- standalone robot


def standalone_xml() -> str:
    """MJCF of the published robot alone, without a floor."""
    spec = mujoco.MjSpec()
    spec.modelname = "husky"
    set_options(spec)
    add_husky(spec)
    spec.compile()
    return _XML_HEADER + spec.to_xml()


_XML_HEADER = """<!--
  Clearpath Husky A200, made by python -m twin.mjcf.husky; do not edit. Figures: README.md; license: LICENSE.

  body, free joint  base_link
  joints            front_left_wheel, front_right_wheel, rear_left_wheel, rear_right_wheel
  actuators         left, right: wheel speed [rad/s], up to 6.06; front and rear wheel of a side are belted
  cameras           front (160 x 90), front_native (1280 x 720)
  sensors           imu_gyro, imu_accelerometer, imu_orientation (site imu), <wheel>_wheel_position and _velocity,
                    left_torque, right_torque [N m] at the wheels of a side

  When the robot is attached to another model, MuJoCo ignores the options below. Set them in that model:
    <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10" tolerance="1e-5"/>
  With another cone the scrubbing torque is wrong; with Euler the speed servos are unstable.
-->
"""


if __name__ == "__main__":
    HUSKY_XML.write_text(standalone_xml(), encoding="utf-8")
    print(f"wrote {HUSKY_XML}")
