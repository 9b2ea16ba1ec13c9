"""Constants and parameters of the Clearpath Husky: wheels, mass, friction, limits; `mjcf/husky.py` builds its model.

*Base* is Clearpath's `base_link`: x forward, y left, z up; its origin lies between the wheels, 0.132 m above flat
ground. A *side* is the front and rear wheel on the left or right, driven by one motor through gear and belt. The *track
ratio* chi = (v_right − v_left) / (yaw rate · track) is 1 for a differential drive with freely rolling wheels, and
larger for a skid-steered robot, whose tires scrub sideways.

The constants are from Clearpath's published description (husky.urdf.xacro, wheel.urdf.xacro, control.yaml).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from twin.errors import InputError
from twin.ranges import Range, check_ranges
from twin.types import Array

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of all arrays per wheel; body, joint and encoder of a wheel are named `<name>_wheel`."""
SIDES = ("left", "right")
"""Order of all arrays per side, and names of the actuators."""

CHASSIS_MASS = 46.034  # [kg]
WHEEL_MASS = 2.637  # [kg]
MAX_LATENCY = 2.0  # [s]
WHEEL_RADIUS = 0.1651  # [m] nominal, used by the robot's controller
WHEEL_WIDTH = 0.1143  # [m]
WHEELBASE = 0.512  # [m]
TRACK = 0.5708  # [m]
HUB_HEIGHT = 0.03282  # [m] height of the wheel hubs above the base origin
BASE_HEIGHT = WHEEL_RADIUS - HUB_HEIGHT  # [m] height of the base origin above flat ground
GEAR_RATIO = 79.0  # motor turns per wheel turn

CAMERA_SIZE = (160, 90)
"""Width, height of a policy's images from the front camera [px]."""
CAMERA_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes right, down and forward (columns) of a camera that looks straight ahead, in the base."""


@dataclass(frozen=True)
class PixelCamera:
    """A pinhole camera: OpenCV convention, (0, 0) is the outer corner of the top-left pixel."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]."""
    size: tuple[int, int] = CAMERA_SIZE
    """Width, height [px]."""

    def resized(self, size: tuple[int, int]) -> "PixelCamera":
        """The same camera at another image size (width, height) [px].

        fx and fy scale with the width. If the aspect ratio changes, the picture is cropped or extended equally at the
        top and bottom.
        """
        scale = size[0] / self.size[0]
        fx, fy, cx, cy = (float(x) * scale for x in self.intrinsics)
        cut = (self.size[1] * scale - size[1]) / 2
        return PixelCamera((fx, fy, cx, cy - cut), size)


ZED2 = PixelCamera((530.0, 530.0, 640.0, 360.0), (1280, 720))
"""Typical left lens of a ZED 2; prefer the calibration of the actual unit."""


@dataclass(frozen=True)
class ControllerTiming:
    """Timing of a wheel controller."""

    period: float
    """Time between two updates [s]."""
    timeout: float
    """Time without a command after which the robot stops [s]."""


CONTROLLERS = {
    "ros1": ControllerTiming(0.1, 0.25),
    "ros2": ControllerTiming(0.05, 0.5),
    "ros2_50hz": ControllerTiming(0.02, 0.5),
}
"""Clearpath's configurations by name: `ros1` for the Husky on ROS 1, `ros2` for the A200 on ROS 2 (20 Hz), `ros2_50hz`
for robots on ROS 2 with 50 Hz."""


@dataclass(frozen=True)
class HuskyParams:
    """Parameters that differ between robots or are fitted to logs: `[robot]` in `scene.toml`, and `robot.toml`.

    Ranges are wide enough for any Husky, and narrow enough to reveal values in wrong units such as millimeters.

    Raises:
        InputError: a value is out of range.
    """

    # Body.
    center_of_mass: Annotated[tuple[float, float, float], Range(-0.5, 0.5)] = (0.0, 0.0, 0.062)
    """Center of mass of the chassis in the base [m]. The published one, (−.00065, −.085, .062), lies 8.5 cm to the
    right, although the robot is symmetric. With x and y exchanged, the robot turns with chi = 1.43. With the default,
    which is centered, chi is 1.805, nearer to Clearpath's controller (1.82 to 1.875) and to logs of a real robot (2.15
    and more)."""
    payload_mass: Annotated[float, Range(0, 100)] = 0.0
    """Mass on the top plate [kg]."""
    payload_position: Annotated[tuple[float, float, float], Range(-2, 2)] = (0.0, 0.0, 0.35)
    """Center of the payload in the base [m]."""

    # Tires.
    friction: Annotated[float, Range(0.01, 3)] = 0.7
    """Sliding friction coefficient of the tires on any surface."""
    rolling_resistance: Annotated[float, Range(0, 0.5)] = 0.015
    """Rolling resistance coefficient Crr: force / load. A tire that uses a fraction s of its grip slides at
    Crr / friction · s / √(1 − s²) of its rolling speed, which is negligible by default."""
    wheel_radius: Annotated[tuple[float, float], Range(0.1, 0.25)] = (WHEEL_RADIUS, WHEEL_RADIUS)
    """Effective radius of the left and right tires [m]. The robot's controller uses the nominal radius."""
    spin_friction: Annotated[float, Range(0, 1)] = 1e-4
    """Torsional friction of a tire's contact patch: moment / load [m]. On hard ground it is negligible against the
    scrubbing of four wheels; tires that sink in have a long contact patch."""
    slip_stiffness: Annotated[float, Range(0.001, 1_000)] = 10.0
    """Stiffness of tire friction relative to normal contact (MuJoCo's `impratio`). Below 1, tires creep as on soft
    ground: before they slide, the friction force grows with the slip speed."""
    ground_viscosity: Annotated[float, Range(0, 1_000)] = 0.0
    """Viscosity of the medium around the wheels, such as long grass, mud or snow [Pa s]. The drag of a tire is about
    2.4 m × viscosity × speed."""
    wheel_shape: str = "ellipsoid"
    """`ellipsoid` (one contact per wheel on a plane) or `cylinder` (contacts at two edges)."""

    # Drivetrain.
    servo_gain: Annotated[float, Range(1, 100_000)] = 1600.0
    """Torque of a side per wheel speed error [N m s/rad]; high, since the motor controllers' encoder loop is stiff."""
    servo_lag: Annotated[float, Range(0, 2)] = 0.0
    """Time constant of the first-order lag of a side's wheel speed command [s]."""
    motor_inertia: Annotated[float, Range(0, 5)] = 0.15
    """Inertia of rotor and gears at one wheel [kg m²]: about 5e-5 kg m² per motor (estimated), times the square of the
    gear ratio 79, shared by two wheels. It also prevents stick-slip flutter of stiffly driven wheels: without it, the
    robot hops in a point turn at 1.8 rad/s with a friction of 1.0 (9 m/s² rms at the camera). 0.1 kg m² would suffice
    against that."""
    motor_torque: Annotated[float, Range(1, 500)] = 70.0
    """Torque limit of a side at its wheels [N m]; not published."""
    motor_constant: Annotated[float, Range(0.0001, 10)] = 0.035
    """Torque per current at the motor's shaft, after subtracting losses of gear and belt [N m/A]; not published. With
    the default, the motor's continuous current of 8 A gives 22 N m at the wheels of a side."""

    # Controller.
    controller: str = "ros1"
    """Timing of the wheel controller, a key of `CONTROLLERS`: ros1, ros2 or ros2_50hz. The limits below are independent
    of it; for Clearpath's A200 on ROS 2, set accelerations of 1 m/s² and 1 rad/s², and a yaw rate of 1 rad/s."""
    max_speed: Annotated[float, Range(0.01, 5)] = 1.0
    """Limit of the speed [m/s]."""
    max_acceleration: Annotated[float, Range(0.01, 100)] = 3.0
    """Limit of the acceleration [m/s²]."""
    max_yaw_rate: Annotated[float, Range(0.01, 10)] = 2.0
    """Limit of the yaw rate [rad/s]."""
    max_yaw_acceleration: Annotated[float, Range(0.01, 100)] = 6.0
    """Limit of the yaw acceleration [rad/s²]."""
    max_wheel_speed: Annotated[float, Range(0.01, 5)] = 1.0
    """Limit of a tire's circumferential speed [m/s]. If one side would exceed it, both are scaled down by the same
    factor."""
    separation_multiplier: Annotated[float, Range(0.5, 5)] = 1.875
    """Clearpath's `wheel_separation_multiplier`: the controller's estimate of chi."""
    command_latency: Annotated[float, Range(0, MAX_LATENCY)] = 0.0
    """Delay from a command to the controller's action [s]."""

    # Front camera.
    camera_height: Annotated[float, Range(0.05, 3)] = 0.6
    """Height of the lens above flat ground [m]."""
    camera_offset: Annotated[tuple[float, float], Range(-2, 2)] = (0.36, 0.0)
    """Position of the lens forward and left of the base origin [m]."""
    camera_pitch: Annotated[float, Range(-90, 90)] = 5.0
    """Angle by which the camera looks down [°]."""
    camera_yaw: Annotated[float, Range(-180, 180)] = 0.0
    """Angle by which the camera looks to the left [°]."""
    camera_roll: Annotated[float, Range(-180, 180)] = 0.0
    """Angle by which the camera leans to the right [°]."""
    camera_intrinsics: Annotated[tuple[float, ...], Range(-100_000, 100_000)] = ()
    """fx, fy, cx, cy at `camera_size` [px]. If empty, they are those of the scene's film or, without a scene, those of
    a ZED 2."""
    camera_size: Annotated[tuple[int, int], Range(1, 20_000)] = ZED2.size
    """Width, height of the camera's native images [px]."""
    camera_latency: Annotated[float, Range(0, 2)] = 0.0
    """Delay from exposure to the policy's receipt of the image [s]."""

    def __post_init__(self) -> None:
        lengths = {"center_of_mass": 3, "payload_position": 3, "wheel_radius": 2, "camera_offset": 2, "camera_size": 2}
        for name, length in lengths.items():
            if len(getattr(self, name)) != length:
                raise InputError(f"{name} = {list(getattr(self, name))}; expected {length} numbers")
        if len(self.camera_intrinsics) not in (0, 4):
            raise InputError(f"camera_intrinsics = {list(self.camera_intrinsics)}; expected [fx, fy, cx, cy]")
        if self.camera_intrinsics and min(self.camera_intrinsics[:2]) <= 0:
            raise InputError(f"camera_intrinsics = {list(self.camera_intrinsics)}; expected fx, fy > 0 [px]")
        check_ranges(self)
        if self.wheel_shape not in ("ellipsoid", "cylinder"):
            raise InputError(f"wheel_shape = {self.wheel_shape!r}; expected ellipsoid or cylinder")
        if self.controller not in CONTROLLERS:
            raise InputError(f"controller = {self.controller!r}; expected {' or '.join(CONTROLLERS)}")

    @property
    def timing(self) -> ControllerTiming:
        return CONTROLLERS[self.controller]

    @property
    def camera_position(self) -> tuple[float, float, float]:
        """Position of the front camera in the base [m]."""
        return (*self.camera_offset, self.camera_height - BASE_HEIGHT)

    @property
    def camera_rotation(self) -> Array:
        """The front camera's axes right, up and back (columns) in the base, shape (3, 3)."""
        yaw, pitch, roll = np.deg2rad([self.camera_yaw, self.camera_pitch, self.camera_roll])
        about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        axes = np.array([[0, np.sin(pitch), -np.cos(pitch)], [-1, 0, 0], [0, np.cos(pitch), np.sin(pitch)]])
        about_axis = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        return about_z @ axes @ about_axis

    def camera(self, fallback: PixelCamera = ZED2) -> PixelCamera:
        """The front camera at its native size; `fallback` if no intrinsics are given."""
        if not self.camera_intrinsics:
            return fallback
        fx, fy, cx, cy = self.camera_intrinsics
        return PixelCamera((fx, fy, cx, cy), self.camera_size)
