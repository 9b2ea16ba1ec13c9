"""The Clearpath Husky A200 as a wheeled MuJoCo model.

*Base* is the body with the free joint (Clearpath's `base_link`; x forward, y left, z up; its origin lies between the
wheels, 0.132 m above flat ground). A *side* is the front and the rear wheel of the left or of the right, which one
motor drives through a belt. The *track ratio* chi = (v_right − v_left) / (yaw rate · track) is 1 for a differential
drive whose wheels roll freely and larger for a skid-steered robot, whose tyres must scrub sideways.

Figures: Clearpath's published description (husky.urdf.xacro, wheel.urdf.xacro, control.yaml). Contact settings:
measured, see `_WHEEL_SOLIMP`.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from twin.mjcf.husky_look import add_look

Array = NDArray[np.float64]

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of wheel arrays everywhere; the joint and the actuator of a wheel are `<name>_wheel`."""

CHASSIS_MASS = 46.034  # [kg]
WHEEL_MASS = 2.637  # [kg]
WHEEL_RADIUS = 0.1651  # [m]
WHEEL_WIDTH = 0.1143  # [m]
WHEELBASE = 0.512  # [m]
TRACK = 0.5708  # [m]
HUB_HEIGHT = 0.03282  # [m] above the base origin
BASE_HEIGHT = WHEEL_RADIUS - HUB_HEIGHT  # [m] of the base origin above flat ground

MAX_SPEED, MAX_ACCELERATION = 1.0, 3.0  # [m/s], [m/s²]
MAX_YAW_RATE, MAX_YAW_ACCELERATION = 2.0, 6.0  # [rad/s], [rad/s²]
CONTROL_PERIOD = 0.1  # [s], the wheel controller of the real robot runs at 10 Hz
COMMAND_TIMEOUT = 0.25  # [s] without a command, then the robot stops
TIMESTEP = 0.002  # [s]

_CHASSIS_INERTIA = (0.6022, 1.7386, 2.0296, -0.02364, -0.1197, -0.001544)  # ixx iyy izz ixy ixz iyz [kg m²]
_WHEEL_INERTIA = (0.02467, 0.04411, 0.02467)  # [kg m²], the axle is y
_COLLISION_BOXES = (  # full size, centre in the base [m]
    ((0.9874, 0.5709, 0.12375), (0.0, 0.0, 0.061875)),
    ((0.78992, 0.5709, 0.10375), (0.0, 0.0, 0.175625)),
)
# With MuJoCo's default solimp (d0 = 0.9) scrubbing wheels hop: 12 to 17 m/s² at the body in a point turn, and the
# effective track then depends on friction. An impedance that starts from zero over 3 mm has no jump at touchdown.
_WHEEL_SOLIMP = (0.0, 0.95, 0.003, 0.5, 2.0)
_TORSIONAL = 1e-4  # [m] spin friction of the contact patch; next to nothing, the scrubbing of four wheels dominates

ROBOT_GROUP = 4
"""Geom group of the robot's collision shapes; its looks are in group 1."""


@dataclass(frozen=True)
class HuskyParams:
    """What may differ from robot to robot, or be fitted to logs."""

    center_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.062)
    """Of the chassis, in the base [m]. The published (−.00065, −.085, .062) would lie 8.5 cm to the right of a
    symmetric robot; read as transposed it is rear-heavy (`REAR_HEAVY`) and turns with chi = 1.43. Centred it turns with
    1.805, which is nearer to what Clearpath's controller assumes (1.82 to 1.875) and to what logs of a real one show
    (2.15 and more); so centred is the default."""
    friction: float = 0.7
    """Sliding friction of a tyre, on whatever it touches."""
    rolling_resistance: float = 0.015
    """Rolling resistance coefficient Crr: force / load."""
    wheel_shape: str = "ellipsoid"
    """ellipsoid (one contact per wheel on a plane) or cylinder (two edges)."""
    servo_gain: float = 400.0
    """Torque per wheel speed error [N m s/rad]; stiff, as the motor controllers close the loop on encoder counts."""
    motor_inertia: float = 0.15
    """Inertia of rotors and gears as felt at one wheel [kg m²]: about 5e-5 kg m² per motor (estimated), times the gear
    ratio of 79 squared, shared by two wheels. It also keeps stiffly driven wheels from stick-slip flutter: without it a
    point turn at 1.8 rad/s on a friction of 1.0 hops (9 m/s² rms at the camera), from 0.1 up there is none at all."""
    wheel_torque: float = 35.0
    """Torque limit per wheel [N m]; half of what a side's motor gives at its peak."""
    separation_multiplier: float = 1.875
    """Clearpath's `wheel_separation_multiplier`: the controller's own guess of chi."""
    payload_mass: float = 0.0
    """[kg] on the top plate."""
    payload_position: tuple[float, float, float] = (0.0, 0.0, 0.35)
    """Centre of the payload in the base [m]."""
    camera_position: tuple[float, float, float] = (0.36, 0.0, 0.6 - BASE_HEIGHT)
    """Of the front camera in the base [m]; by default 0.6 m above the ground."""
    camera_pitch: float = 5.0
    """How far the front camera looks down [°]."""


@dataclass(frozen=True)
class PixelCamera:
    """A pinhole camera in pixels: OpenCV convention, (0, 0) is the corner of the top-left pixel."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]."""
    size: tuple[int, int] = (160, 90)
    """Width, height [px]."""


REAR_HEAVY = (-0.085, -0.00065, 0.062)
"""The published centre of mass of the chassis with x and y exchanged [m]."""

# A ZED 2 at 1280 × 720 has fx ≈ 530 px; at 160 × 90 that is an eighth.
ZED2 = PixelCamera((66.25, 66.25, 80.0, 45.0))


def set_options(spec: mujoco.MjSpec) -> None:
    """Solver settings under which skid steering behaves: see the figures in the module's tests."""
    spec.option.timestep = TIMESTEP
    # Euler and RK4 misbehave with a stiff speed servo; implicitfast takes its damping into the mass matrix.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The pyramidal cone reads the right chi with a torque 21 % too low.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0


def add_husky(
    spec: mujoco.MjSpec,
    position: Any = (0.0, 0.0, BASE_HEIGHT),
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
    params: HuskyParams | None = None,
    camera: PixelCamera = ZED2,
) -> None:
    """Adds the robot to a world.

    Names: body `husky`, free joint `husky`, bodies, joints, actuators `<front|rear>_<left|right>_wheel`, collision
    geoms `husky_chassis_0`, `husky_chassis_1`, `<wheel>_tyre`, camera `front`.

    Args:
        spec: The world; its options are not touched (see `set_options`).
        position: Of the base origin [m], shape (3,).
        quaternion: w, x, y, z, shape (4,).
        params: The robot; the published one by default.
        camera: Of the front camera.
    """
    params = params or HuskyParams()
    base = spec.worldbody.add_body(name="husky", pos=position, quat=quaternion)
    base.add_freejoint(name="husky")
    base.explicitinertial = True
    base.mass, base.ipos, base.fullinertia = _chassis_inertia(params)
    for i, (size, center) in enumerate(_COLLISION_BOXES):
        base.add_geom(
            name=f"husky_chassis_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=np.array(size) / 2,
            pos=center,
            group=ROBOT_GROUP,
            rgba=(0.2, 0.2, 0.8, 0.4),
        )
    wheels = {}
    for name, center in zip(WHEELS, wheel_centers(), strict=True):
        wheels[name] = _add_wheel(spec, base, f"{name}_wheel", center, params)
    for side in ("left", "right"):  # the belt: rear angle = front angle
        belt = spec.add_equality(
            name=f"{side}_belt",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=f"rear_{side}_wheel",
            name2=f"front_{side}_wheel",
        )
        belt.data[:2] = 0.0, 1.0
    _add_camera(base, params, camera)
    add_look(spec, base, wheels, params.camera_position, WHEEL_RADIUS, WHEEL_WIDTH)


def wheel_centers() -> Array:
    """Wheel hubs in the base [m], shape (4, 3), ordered as WHEELS."""
    x, y = WHEELBASE / 2, TRACK / 2
    return np.array([[x, y, HUB_HEIGHT], [x, -y, HUB_HEIGHT], [-x, y, HUB_HEIGHT], [-x, -y, HUB_HEIGHT]])


def _chassis_inertia(params: HuskyParams) -> tuple[float, Array, Array]:
    """Mass, centre and full inertia (ixx iyy izz ixy ixz iyz) of chassis and payload (a point mass) together."""
    masses = np.array([CHASSIS_MASS, params.payload_mass])
    centers = np.array([params.center_of_mass, params.payload_position])
    mass = masses.sum()
    center = masses @ centers / mass
    xx, yy, zz, xy, xz, yz = _CHASSIS_INERTIA
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    for m, d in zip(masses, centers - center, strict=True):
        tensor = tensor + m * (d @ d * np.eye(3) - np.outer(d, d))
    return float(mass), center, tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _add_wheel(
    spec: mujoco.MjSpec, base: mujoco.MjsBody, name: str, center: Array, params: HuskyParams
) -> mujoco.MjsBody:
    wheel = base.add_body(name=name, pos=center)
    wheel.explicitinertial = True
    # Left unsaid, MuJoCo takes the body's offset in its parent for the centre of mass.
    wheel.mass, wheel.ipos, wheel.inertia = WHEEL_MASS, (0.0, 0.0, 0.0), _WHEEL_INERTIA
    wheel.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 1, 0), armature=params.motor_inertia)
    shapes: dict[str, dict[str, Any]] = {
        "ellipsoid": {
            "type": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            "size": (WHEEL_RADIUS, WHEEL_WIDTH / 2, WHEEL_RADIUS),
        },
        "cylinder": {
            "type": mujoco.mjtGeom.mjGEOM_CYLINDER,
            "size": (WHEEL_RADIUS, WHEEL_WIDTH / 2, 0.0),
            "quat": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
        },
    }
    wheel.add_geom(
        name=name.replace("_wheel", "_tyre"),
        group=ROBOT_GROUP,
        rgba=(0.2, 0.2, 0.8, 0.4),
        condim=6,
        priority=1,
        # A rolling friction coefficient [m] over the radius is Crr.
        friction=(params.friction, _TORSIONAL, max(params.rolling_resistance * WHEEL_RADIUS, 1e-5)),
        solimp=_WHEEL_SOLIMP,
        **shapes[params.wheel_shape],
    )
    actuator = spec.add_actuator(
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=name,
        forcelimited=True,
        forcerange=(-params.wheel_torque, params.wheel_torque),
        ctrllimited=True,
        ctrlrange=(-MAX_SPEED / WHEEL_RADIUS, MAX_SPEED / WHEEL_RADIUS),
    )
    actuator.set_to_velocity(kv=params.servo_gain)
    return wheel


def _add_camera(base: mujoco.MjsBody, params: HuskyParams, camera: PixelCamera) -> None:
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.size
    pitch = np.deg2rad(params.camera_pitch)
    # Columns: right, up, backward of the camera in the base.
    axes = np.array([[0, np.sin(pitch), -np.cos(pitch)], [-1, 0, 0], [0, np.cos(pitch), np.sin(pitch)]])
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    base.add_camera(
        name="front",
        pos=params.camera_position,
        quat=quaternion,
        resolution=(width, height),
        focal_pixel=(fx, fy),
        # MuJoCo counts the principal point from the middle of the image, left and up being positive.
        principal_pixel=(width / 2 - cx, height / 2 - cy),
        # The metric size of the sensor is arbitrary: focal length and principal point scale with it.
        sensor_size=(width * 1e-5, height * 1e-5),
    )


def limited_command(command: Array, previous: Array, period: float = CONTROL_PERIOD) -> Array:
    """What the robot's controller makes of a command (v [m/s], ω [rad/s]) after its limits of speed and acceleration.

    Args:
        command: Wanted v, ω, shape (2,).
        previous: What it carried out one `period` [s] ago, shape (2,).
    """
    limit = np.array([MAX_SPEED, MAX_YAW_RATE])
    step = np.array([MAX_ACCELERATION, MAX_YAW_ACCELERATION]) * period
    return np.clip(np.clip(command, -limit, limit), previous - step, previous + step)


def wheel_speeds(command: Array, separation_multiplier: float = HuskyParams.separation_multiplier) -> Array:
    """Wheel speeds [rad/s], shape (4,) as WHEELS, for v [m/s] and ω [rad/s]; both sides shrink alike above 1 m/s."""
    v, yaw_rate = command
    half = yaw_rate * separation_multiplier * TRACK / 2
    sides = np.array([v - half, v + half])
    sides = sides / max(1.0, np.abs(sides).max() / MAX_SPEED)
    return np.tile(sides, 2) / WHEEL_RADIUS


def center_of_mass(params: HuskyParams) -> Array:
    """Centre of mass of the whole robot in the base [m], shape (3,)."""
    mass, center, _ = _chassis_inertia(params)
    return (mass * center + WHEEL_MASS * wheel_centers().sum(0)) / (mass + 4 * WHEEL_MASS)


def coulomb_track_ratio(center: Array, curvature_radius: float = 0.0) -> float:
    """Quasi-static chi of four point contacts under Coulomb friction, whatever the coefficient.

    With slip velocity s at each wheel the friction force is −μN s/|s|; forces and moment about the centre of mass must
    vanish. A centred mass in a point turn gives 1 + (wheelbase / track)² exactly.

    Args:
        center: Centre of mass in the base, x and y used [m], shape (≥2,).
        curvature_radius: v / yaw rate of the mean of both sides, in units where the yaw rate of the wheels counts [m].
    """
    arm = wheel_centers()[:, :2] - np.asarray(center)[:2]
    share_x = 0.5 + np.sign(arm[:, 0]) * center[0] / WHEELBASE
    share_y = 0.5 + np.sign(arm[:, 1]) * center[1] / TRACK
    load = share_x * share_y

    def residual(unknown: Array) -> Array:
        vx, vy, chi = unknown  # body velocity at the centre of mass for unit yaw rate
        rolling = curvature_radius + np.array([-1.0, 1.0, -1.0, 1.0]) * chi * TRACK / 2
        slip = np.stack([vx - arm[:, 1] - rolling, vy + arm[:, 0]], 1)
        force = -load[:, None] * slip / np.linalg.norm(slip, axis=1, keepdims=True)
        moment = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
        return np.array([force[:, 0].sum(), force[:, 1].sum(), moment.sum()])

    solution = root(residual, np.array([curvature_radius, -center[0] * 0.5, 1.0 + (WHEELBASE / TRACK) ** 2]))
    if not solution.success:
        raise ArithmeticError(f"no quasi-static balance for a centre of mass at {center}: {solution.message}")
    return float(solution.x[2])
