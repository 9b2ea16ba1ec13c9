"""What a Husky is and what may differ from one to the next: facts and parameters, no MuJoCo.

*Base* is Clearpath's `base_link`: x forward, y left, z up; its origin lies between the wheels, 0.132 m above flat
ground. A *side* is the front and the rear wheel of the left or of the right, which one motor drives through gear and
belt; arrays per side are ordered left, right. The *track ratio* chi = (v_right − v_left) / (yaw rate · track) is 1 for
a differential drive whose wheels roll freely and larger for a skid-steered robot, whose tyres must scrub sideways.

`HuskyParams` is what `[robot]` in `scene.toml` and the file `robot.toml` beside it may set.

Figures: Clearpath's published description (husky.urdf.xacro, wheel.urdf.xacro, control.yaml).
"""

from dataclasses import dataclass

import numpy as np

from twin.errors import InputError
from twin.types import Array

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of wheel arrays everywhere; body, joint and encoder of a wheel are `<name>_wheel`."""
SIDES = ("left", "right")
"""Order of arrays per side; also the names of the actuators."""

CHASSIS_MASS = 46.034  # [kg]
WHEEL_MASS = 2.637  # [kg]
WHEEL_RADIUS = 0.1651  # [m], nominal: what the robot's controller reckons with
WHEEL_WIDTH = 0.1143  # [m]
WHEELBASE = 0.512  # [m]
TRACK = 0.5708  # [m]
HUB_HEIGHT = 0.03282  # [m] above the base origin
BASE_HEIGHT = WHEEL_RADIUS - HUB_HEIGHT  # [m] of the base origin above flat ground
GEAR_RATIO = 79.0  # motor turns per wheel turn

CAMERA_SIZE = (160, 90)
"""Width, height of the pictures a policy gets of the front camera [px]."""
REAR_HEAVY = (-0.085, -0.00065, 0.062)
"""The published centre of mass of the chassis with x and y exchanged [m]."""


@dataclass(frozen=True)
class PixelCamera:
    """A pinhole camera in pixels: OpenCV convention, (0, 0) is the corner of the top-left pixel."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]."""
    size: tuple[int, int] = CAMERA_SIZE
    """Width, height [px]."""

    def resized(self, size: tuple[int, int]) -> "PixelCamera":
        """The same camera with pictures of another size (width, height) [px], scaled by the width.

        Pixels keep their shape, so fy scales like fx; where the aspect ratio differs, the middle of the picture's
        height is cut out (or, for a picture wider than the new one, extended).
        """
        scale = size[0] / self.size[0]
        fx, fy, cx, cy = (float(x) * scale for x in self.intrinsics)
        cut = (self.size[1] * scale - size[1]) / 2
        return PixelCamera((fx, fy, cx, cy - cut), size)


ZED2 = PixelCamera((530.0, 530.0, 640.0, 360.0), (1280, 720))
"""A ZED 2's left lens at 1280 × 720, typical; the calibration of the unit at hand governs."""


@dataclass(frozen=True)
class HuskyParams:
    """What may differ from robot to robot, or be fitted to logs.

    Raises:
        InputError: a value out of range.
    """

    # Body.
    center_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.062)
    """Of the chassis, in the base [m]. The published (−.00065, −.085, .062) would lie 8.5 cm to the right of a
    symmetric robot; read as transposed it is rear-heavy (`REAR_HEAVY`) and turns with chi = 1.43. Centred it turns with
    1.805, which is nearer to what Clearpath's controller assumes (1.82 to 1.875) and to what logs of a real one show
    (2.15 and more); so centred is the default."""
    payload_mass: float = 0.0
    """[kg] on the top plate."""
    payload_position: tuple[float, float, float] = (0.0, 0.0, 0.35)
    """Centre of the payload in the base [m]."""

    # Tyres.
    friction: float = 0.7
    """Sliding friction of a tyre, on whatever it touches."""
    rolling_resistance: float = 0.015
    """Rolling resistance coefficient Crr: force / load. Rolling and sliding share a tyre's grip: it slides at
    Crr / friction · s / √(1 − s²) of its rolling speed under a share s of its grip, next to nothing by default."""
    wheel_radius: tuple[float, float] = (WHEEL_RADIUS, WHEEL_RADIUS)
    """Effective radius of the left and of the right tyres [m]: pressure and wear. The robot's own controller goes on
    reckoning with the nominal one."""
    spin_friction: float = 1e-4
    """Of a tyre's contact patch turning on the spot: moment / load [m]. Next to nothing by default, for the scrubbing
    of four wheels dominates on hard ground; tyres that sink in have a long patch."""
    slip_stiffness: float = 10.0
    """How stiffly friction holds a tyre, against how stiffly the ground carries it (MuJoCo's `impratio`). Below 1 tyres
    creep as on soft ground: force grows with the speed of slip before they slide."""
    ground_viscosity: float = 0.0
    """Of what the wheels wade through, such as long grass, mud or snow [Pa s]; none by default. It drags the tyres back
    with about 2.4 N per Pa s and m/s each, so it grows with speed, and turns harder the faster."""
    wheel_shape: str = "ellipsoid"
    """ellipsoid (one contact per wheel on a plane) or cylinder (two edges)."""

    # Drivetrain.
    servo_gain: float = 1600.0
    """Torque of a side per wheel speed error [N m s/rad]; stiff, as the motor controllers close the loop on encoder
    counts."""
    servo_lag: float = 0.0
    """Time constant of the first-order lag with which a side's wheel speed command takes effect [s]."""
    motor_inertia: float = 0.15
    """Inertia of rotors and gears as felt at one wheel [kg m²]: about 5e-5 kg m² per motor (estimated), times the gear
    ratio of 79 squared, shared by two wheels. It also keeps stiffly driven wheels from stick-slip flutter: without it a
    point turn at 1.8 rad/s on a friction of 1.0 hops (9 m/s² rms at the camera), from 0.1 up there is none at all."""
    motor_torque: float = 70.0
    """Torque limit of a side, at its wheels [N m]. None is published."""
    motor_constant: float = 0.035
    """Torque per current at the motor's shaft, losses of gear and belt taken off [N m/A]. None is published: with this
    one the motors' continuous 8 A are 22 N m at the wheels of a side, and 70 N m are 25 A."""

    # Controller.
    max_speed: float = 1.0
    """[m/s]"""
    max_acceleration: float = 3.0
    """[m/s²]"""
    max_yaw_rate: float = 2.0
    """[rad/s]"""
    max_yaw_acceleration: float = 6.0
    """[rad/s²]"""
    max_wheel_speed: float = 1.0
    """Of a tyre's circumference [m/s]; beyond it both sides slow down alike."""
    separation_multiplier: float = 1.875
    """Clearpath's `wheel_separation_multiplier`: the controller's own guess of chi."""
    command_latency: float = 0.0
    """From a command being given to the controller acting on it [s]."""

    # Front camera.
    camera_height: float = 0.6
    """Of the lens above flat ground [m]."""
    camera_offset: tuple[float, float] = (0.36, 0.0)
    """Of the lens forward and left of the base origin [m]."""
    camera_pitch: float = 5.0
    """How far it looks down [°]."""
    camera_yaw: float = 0.0
    """How far it looks to the left [°]."""
    camera_roll: float = 0.0
    """How far it leans to the right [°]."""
    camera_intrinsics: tuple[float, ...] = ()
    """fx, fy, cx, cy at `camera_size` [px]; empty: in a scene those of the film, elsewhere a ZED 2's."""
    camera_size: tuple[int, int] = ZED2.size
    """Width, height of its native pictures [px], which `camera_intrinsics` belong to."""
    camera_latency: float = 0.0
    """From the light reaching the lens to the picture reaching the policy [s]."""

    def __post_init__(self) -> None:
        lengths = {"center_of_mass": 3, "payload_position": 3, "wheel_radius": 2, "camera_offset": 2, "camera_size": 2}
        for name, length in lengths.items():
            if len(getattr(self, name)) != length:
                raise InputError(f"{name} = {list(getattr(self, name))}; expected {length} numbers")
        if len(self.camera_intrinsics) not in (0, 4):
            raise InputError(f"camera_intrinsics = {list(self.camera_intrinsics)}; expected [fx, fy, cx, cy]")
        if self.camera_intrinsics and min(self.camera_intrinsics[:2]) <= 0:
            raise InputError(f"camera_intrinsics = {list(self.camera_intrinsics)}; expected fx, fy > 0 [px]")
        for name, (low, high) in _RANGES.items():
            for value in np.atleast_1d(getattr(self, name)).tolist():
                if not low <= value <= high:
                    raise InputError(f"{name} = {value:g}; expected {low:g} to {high:g}")
        if self.wheel_shape not in WHEEL_SHAPES:
            raise InputError(f"wheel_shape = {self.wheel_shape!r}; expected {' or '.join(WHEEL_SHAPES)}")

    @property
    def camera_position(self) -> tuple[float, float, float]:
        """Of the front camera in the base [m]."""
        return (*self.camera_offset, self.camera_height - BASE_HEIGHT)

    @property
    def camera_rotation(self) -> Array:
        """The front camera's axes right, up and back (columns) in the base, shape (3, 3)."""
        yaw, pitch, roll = np.deg2rad([self.camera_yaw, self.camera_pitch, self.camera_roll])
        turned = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        axes = np.array([[0, np.sin(pitch), -np.cos(pitch)], [-1, 0, 0], [0, np.cos(pitch), np.sin(pitch)]])
        leaning = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        return turned @ axes @ leaning

    def camera(self, fallback: PixelCamera = ZED2) -> PixelCamera:
        """The front camera at its native size; `fallback` where no intrinsics are given."""
        if not self.camera_intrinsics:
            return fallback
        fx, fy, cx, cy = self.camera_intrinsics
        return PixelCamera((fx, fy, cx, cy), self.camera_size)


WHEEL_SHAPES = ("ellipsoid", "cylinder")

# What a value may be; wide enough for any Husky, narrow enough to catch millimetres, degrees and percent.
_RANGES: dict[str, tuple[float, float]] = {
    "center_of_mass": (-0.5, 0.5),
    "payload_mass": (0.0, 100.0),
    "payload_position": (-2.0, 2.0),
    "friction": (0.01, 3.0),
    "rolling_resistance": (0.0, 0.5),
    "wheel_radius": (0.1, 0.25),
    "spin_friction": (0.0, 1.0),
    "slip_stiffness": (1e-3, 1e3),
    "ground_viscosity": (0.0, 1e3),
    "servo_gain": (1.0, 1e5),
    "servo_lag": (0.0, 2.0),
    "motor_inertia": (0.0, 5.0),
    "motor_torque": (1.0, 500.0),
    "motor_constant": (1e-4, 10.0),
    "max_speed": (0.01, 5.0),
    "max_acceleration": (0.01, 100.0),
    "max_yaw_rate": (0.01, 10.0),
    "max_yaw_acceleration": (0.01, 100.0),
    "max_wheel_speed": (0.01, 5.0),
    "separation_multiplier": (0.5, 5.0),
    "command_latency": (0.0, 2.0),
    "camera_height": (0.05, 3.0),
    "camera_offset": (-2.0, 2.0),
    "camera_pitch": (-90.0, 90.0),
    "camera_yaw": (-180.0, 180.0),
    "camera_roll": (-180.0, 180.0),
    "camera_intrinsics": (-1e5, 1e5),
    "camera_size": (1, 20_000),
    "camera_latency": (0.0, 2.0),
}
