"""The robots of the real test: Huskies by number, with equations of motion independent of MuJoCo and the twin.

The chassis is a rigid body with three degrees of freedom in the plane of the ground beneath it. Each of four tires has
its own load and slip; a geared motor drives the two tires of a side. Height, pitch and roll follow the ground under the
tires as lightly damped oscillators of 6.5 to 11 Hz, which bumps and the road's texture excite.

Tire: the averaged lumped LuGre model (Canudas de Wit, Tsiotras, Velenis, Basset, Gissinger 2003, Vehicle System
Dynamics 39(3)) in its anisotropic planar form (Velenis, Tsiotras, Canudas de Wit, Sorine 2005, same journal 43(1)). For
the deflection z of the bristles [m] along the tire's two axes i, slip velocity v, friction coefficients μ, rolling
speed u = |r ω| and the length L of the contact patch:

    dz_i/dt = v_i − (σ₀ |M v| / (μ_i² g) + κ₀ u / L) z_i,    |M v| = √((μ_x v_x)² + (μ_y v_y)²)
    F_i = −(σ₀ z_i + σ₁ dz_i/dt) N,    κ₀ = 7/6 (Deur 2001, IFAC Workshop Advances in Automotive Control)

with the load N and g = 1 + (s − 1) exp(−√(|v| / v_s)), where s is the ratio of static to sliding friction and v_s the
Stribeck speed. In steady sliding the force lies on Coulomb's friction ellipse; a rolling tire creeps in proportion to
its force; a tire at rest holds like a spring.

Loads: the tires are four equal springs. A tire's load is the sum of its shares of the weight, of the load transfer by
acceleration (h ΣF / wheelbase along, h ΣF / track across, with the center of mass at height h) and of the load that a
warp of the ground shifts between the diagonals. Motor: torque k i, current i = (U − k ω) / R within its limit. The
voltage U is at most the battery's, which sags by the battery's resistance times the current. A velocity loop (PI) per
side sets U; a controller turns commands into the target speeds of both loops. Controller and loops have their own
clocks, whose periods jitter.

`draw_robot` samples robots from `RANGES`; `TRAINED` is a copy of the ranges that the twin's training randomizes.
"""

from collections import deque
from dataclasses import dataclass
from math import atan2, copysign, cos, exp, hypot, pi, sin, sqrt
from typing import Annotated

import numpy as np

from twin.errors import InputError
from twin.geometry.poses import pose_of
from twin.ranges import Range, setting_ranges
from twin.reality import SEED
from twin.reality.place_objects import KnownPlace, Solids
from twin.types import Array

# ---- facts (Clearpath's description of the Husky A200)

_EMPTY_MASS = 56.582  # [kg]
_WHEELBASE, _TRACK, _RADIUS = 0.512, 0.5708, 0.1651  # [m]
_EMPTY_HEIGHT = 0.18  # [m] height of the empty robot's center of mass
_EMPTY_YAW_INERTIA = 4.0  # [kg m²]: chassis 2.03, four wheels of 2.64 kg at 0.38 m, and the wheels' own inertia
_WHEEL_INERTIA = 0.0441  # [kg m²]
_GEAR = 79.0
_MULTIPLIER = 1.875  # Clearpath's wheel_separation_multiplier
_MAX_SPEED, _MAX_YAW_RATE = 1.0, 2.0  # [m/s], [rad/s]
_MAX_ACCELERATION, _MAX_YAW_ACCELERATION = 3.0, 6.0  # [m/s²], [rad/s²]
FOOTPRINT = (0.9874, 0.6851)  # [m] length over the bumpers, width over the tires
_LOW, _HIGH = 0.03, 0.40  # [m] heights above the ground between which the robot can hit an object

_GRAVITY = 9.81
_STEP = 0.002  # [s]
_GROUND_STEPS = 10  # steps between two samples of the ground: 2 cm at 1 m/s
_KAPPA = 7.0 / 6.0
_STRIBECK_SPEED = 0.1  # [m/s]
_LOAD_LAG = 0.03  # [s] time constant with which loads follow the forces
_HISTORY = 2.0  # [s] for which poses are kept, since a picture shows a past pose
_TIRES = ((1, 1, 0), (1, -1, 1), (-1, 1, 0), (-1, -1, 1))  # front or rear, left or right, index of the side


@dataclass(frozen=True)
class HiddenRobot:
    """The parameters of one robot."""

    number: int = 0

    # Body.
    payload: Annotated[float, Range(0.0, 26.0)] = 10.0
    """Mass on the top plate [kg]."""
    payload_height: Annotated[float, Range(0.38, 0.55)] = 0.45
    """Height of the payload's center above the ground [m]."""
    center_forward: Annotated[float, Range(-0.05, 0.02)] = -0.02
    """Distance of the center of mass ahead of the middle of the four wheels [m]."""
    center_left: Annotated[float, Range(-0.012, 0.012)] = 0.0
    """Distance of the center of mass to the left of this point [m]."""

    # Tires.
    friction: Annotated[float, Range(0.42, 0.98)] = 0.7
    """Sliding friction coefficient along the tire."""
    lateral_grip: Annotated[float, Range(1.0, 1.35)] = 1.1
    """Friction coefficient across the tire, relative to the one along it."""
    static_excess: Annotated[float, Range(1.0, 1.12)] = 1.05
    """Static friction relative to sliding friction."""
    bristle_stiffness: Annotated[float, Range(140.0, 320.0)] = 200.0
    """σ₀ [1/m]."""
    bristle_damping: Annotated[float, Range(1.0, 2.0)] = 1.5
    """σ₁ [s/m]."""
    patch_length: Annotated[float, Range(0.07, 0.11)] = 0.09
    """L [m]."""
    rolling_resistance: Annotated[float, Range(0.012, 0.04)] = 0.02
    """Ratio of the resisting force to the load."""
    wheel_radius: Annotated[float, Range(0.97, 1.02)] = 1.0
    """Mean radius, relative to the nominal radius that the controller uses."""
    wheel_difference: Annotated[float, Range(-0.009, 0.009)] = 0.0
    """Relative excess of the right tires' radius over the left ones'."""
    tire_stiffness: Annotated[float, Range(35_000.0, 70_000.0)] = 50_000.0
    """Vertical stiffness of a tire [N/m]."""

    # Bounce on the tires.
    bounce_frequency: Annotated[float, Range(6.5, 11.0)] = 9.0
    """Natural frequency of height, pitch and roll [Hz]."""
    bounce_damping: Annotated[float, Range(0.08, 0.25)] = 0.15
    """Damping ratio."""
    shake: Annotated[float, Range(0.08, 0.35)] = 0.2
    """Standard deviation of the pitch and roll that the road's texture causes at 1 m/s [°]."""

    # Drivetrain.
    torque_constant: Annotated[float, Range(0.031, 0.038)] = 0.035
    """Torque constant of a motor, net of the gear's losses [N m/A]; also the back-EMF constant [V s/rad]."""
    resistance: Annotated[float, Range(0.28, 0.45)] = 0.35
    """Resistance of a motor with its leads [Ω]."""
    current_limit: Annotated[float, Range(18.0, 28.0)] = 24.0
    """Greatest current of a motor [A]."""
    gear_friction: Annotated[float, Range(0.8, 2.5)] = 1.5
    """Coulomb friction of motor and gear, at the wheels of a side [N m]."""
    rotor_inertia: Annotated[float, Range(0.2, 0.4)] = 0.3
    """Inertia of motor and gear, at the wheels of a side [kg m²]."""
    battery_voltage: Annotated[float, Range(23.5, 27.0)] = 25.0
    """Voltage without load [V]."""
    battery_resistance: Annotated[float, Range(0.04, 0.14)] = 0.08
    """[Ω]"""

    # Control.
    loop_gain: Annotated[float, Range(1.4, 2.8)] = 2.2
    """Proportional gain of the velocity loop [V s/rad]."""
    loop_integral: Annotated[float, Range(14.0, 35.0)] = 25.0
    """Integral gain of the velocity loop [V/rad]."""
    loop_period: Annotated[float, Range(0.008, 0.02)] = 0.01
    """[s]"""
    controller_period: float = 0.1
    """Period of the controller that takes commands [s]."""
    timeout: float = 0.25
    """Time without a command after which the controller stops [s]."""
    jitter: Annotated[float, Range(0.0, 0.25)] = 0.1
    """Largest relative deviation of a period of the controller or of a loop."""
    deadband: Annotated[float, Range(0.0, 0.03)] = 0.01
    """Speed of a side below which the controller commands standstill [m/s]."""
    command_latency: Annotated[float, Range(0.02, 0.15)] = 0.05
    """Time from sending a command to its arrival at the controller [s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value):
                raise InputError(f"robot: {name} = {value}; expected a finite number")


RANGES = {name: (one.low, one.high) for name, one in setting_ranges(HiddenRobot).items()}
"""Ranges from which `draw_robot` samples uniformly."""

TRAINED: dict[str, tuple[float, float]] = {
    "payload": (0.0, 20.0),
    "friction": (0.49, 0.91),
    "command_latency": (0.0, 0.1),
    "wheel_radius": (0.98, 1.02),
    "wheel_difference": (-0.006, 0.006),
}
"""Default ranges of training with Clearpath's robot, as published; a test compares them with the twin's values."""

_CONTROLLERS = ((0.1, 0.25), (0.05, 0.5), (0.02, 0.5))  # period, timeout [s] in configurations by Clearpath


def draw_robot(number: int) -> HiddenRobot:
    """The robot with a number, always the same. Robot 0 drives the demo's trials; it lies within `TRAINED`.

    Raises:
        InputError: a negative number.
    """
    if number < 0:
        raise InputError(f"robot {number}: expected 0 or more")
    rng = np.random.default_rng([SEED, 200, number])
    values = {}
    for name, (low, high) in RANGES.items():
        if number == 0 and name in TRAINED:
            low, high = max(low, TRAINED[name][0]), min(high, TRAINED[name][1])
        values[name] = float(rng.uniform(low, high))
    period, timeout = _CONTROLLERS[int(rng.integers(len(_CONTROLLERS))) if number else 0]
    return HiddenRobot(number, controller_period=period, timeout=timeout, **values)


# ---- dynamics


class RealRobot:
    """One Husky on the ground of a place. The *base* is the point on the ground in the middle of the wheels."""

    def __init__(self, robot: HiddenRobot, place: KnownPlace) -> None:
        self.robot = robot
        self._ground = place.route.ground_height
        self._solids = Solids(place, FOOTPRINT)
        self._mass = _EMPTY_MASS + robot.payload
        self._height = (_EMPTY_MASS * _EMPTY_HEIGHT + robot.payload * robot.payload_height) / self._mass
        self._yaw_inertia = _EMPTY_YAW_INERTIA + 0.03 * robot.payload
        self._side_inertia = 2.0 * _WHEEL_INERTIA + robot.rotor_inertia
        mean, half = _RADIUS * robot.wheel_radius, 0.5 * robot.wheel_difference
        self._radius = (mean * (1.0 - half), mean * (1.0 + half))
        self.set_pose(0.0, 0.0, 0.0, np.random.default_rng(0))

    def set_pose(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Puts the robot at rest at a base position [m] and yaw [rad], at time 0; jitter and shake use `rng`."""
        r = self.robot
        self._rng = rng
        self._x, self._y, self._yaw = x, y, yaw
        self._vx = self._vy = self._rate = 0.0  # velocity and yaw rate of the center of mass, in the robot's axes
        self._wheel = [0.0, 0.0]  # [rad/s] per side
        self._z = [[0.0, 0.0] for _ in _TIRES]
        self._force = [0.0, 0.0]  # lagged sum of the tires' forces
        self.acceleration = (0.0, 0.0)
        """The IMU's proper acceleration, forward and left [m/s²]."""
        self._voltage, self._integral, self._target = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self._current = [0.0, 0.0]
        self._limited = (0.0, 0.0)
        self._arrivals: deque[tuple[float, float, float]] = deque()
        self._newest = (-np.inf, 0.0, 0.0)
        self._steps = 0
        self._due = 0.0
        self.time = 0.0
        """Time since `set_pose` [s]."""
        self._next_control = float(rng.uniform(0.0, r.controller_period))
        self._next_loop = float(rng.uniform(0.0, r.loop_period))
        self._last_control, self._last_loop = 0.0, 0.0
        self.touched = False
        """True if the robot has touched an object since `set_pose`."""
        self._sample_ground()
        self._attitude = [*self._rest]  # height [m], pitch up, roll right [rad] of the chassis
        self._attitude_rate = [0.0, 0.0, 0.0]
        self._poses: deque[tuple[float, ...]] = deque([(0.0, x, y, yaw, *self._attitude)])
        self._touch()

    def command(self, v: float, yaw_rate: float) -> None:
        """Sends a command: speed [m/s] and yaw rate [rad/s]. It arrives after the command latency."""
        self._arrivals.append((self.time + self.robot.command_latency, v, yaw_rate))

    def step(self, period: float) -> None:
        """Advances by `period` [s]; a rest below half a step of 2 ms is made up for by the next call."""
        self._due += period
        steps = round(self._due / _STEP) - self._steps
        r = self.robot
        omega = 2.0 * pi * r.bounce_frequency
        spread = np.deg2rad(r.shake)
        # White acceleration of intensity q gives an oscillator the variance q / (4 ζ ω³).
        push = spread * sqrt(4.0 * r.bounce_damping * omega**3 / _STEP)
        noise = (self._rng.standard_normal((steps, 3)) * np.array([0.1 * push, push, push])).tolist()
        for k in range(steps):
            if self.time >= self._next_control - 1e-9:
                self._control()
            if self.time >= self._next_loop - 1e-9:
                self._velocity_loop()
            self._advance()
            if self._steps % _GROUND_STEPS == 0:
                self._sample_ground()
                self._touch()
            shaking, kick = sqrt(min(hypot(self._vx, self._vy), 2.0)), noise[k]
            pitch_lag = self._height * self._force[0] / (2.0 * r.tire_stiffness * _WHEELBASE**2)
            roll_lag = self._height * self._force[1] / (2.0 * r.tire_stiffness * _TRACK**2)
            targets = (self._rest[0], self._rest[1] + 2.0 * pitch_lag, self._rest[2] + 2.0 * roll_lag)
            for i in range(3):
                gap = targets[i] - self._attitude[i]
                rate = self._attitude_rate[i]
                rate += _STEP * (omega * omega * gap - 2.0 * r.bounce_damping * omega * rate + shaking * kick[i])
                self._attitude_rate[i] = rate
                self._attitude[i] += _STEP * rate
            self._steps += 1
            self.time = self._steps * _STEP
            self._poses.append((self.time, self._x, self._y, self._yaw, *self._attitude))
        while self._poses[0][0] < self.time - _HISTORY:
            self._poses.popleft()

    # ---- control

    def _control(self) -> None:
        """Runs the controller: timeout, limits of speed and acceleration, speeds of both sides, deadband."""
        r = self.robot
        elapsed = self.time - self._last_control
        self._last_control = self.time
        self._next_control = self.time + r.controller_period * (1.0 + r.jitter * float(self._rng.uniform(-1.0, 1.0)))
        while self._arrivals and self._arrivals[0][0] <= self.time + 1e-9:
            self._newest = self._arrivals.popleft()
        stale = self.time - self._newest[0] > r.timeout
        wanted = (0.0, 0.0) if stale else self._newest[1:]
        out = []
        for value, before, most, change in zip(
            wanted, self._limited, (_MAX_SPEED, _MAX_YAW_RATE), (_MAX_ACCELERATION, _MAX_YAW_ACCELERATION), strict=True
        ):
            value = min(max(value, -most), most)
            out.append(min(max(value, before - change * elapsed), before + change * elapsed))
        self._limited = (out[0], out[1])
        turn = 0.5 * _TRACK * _MULTIPLIER * out[1]
        sides = (out[0] - turn, out[0] + turn)
        scale = min(1.0, _MAX_SPEED / max(abs(sides[0]), abs(sides[1]), 1e-9))
        for i in (0, 1):
            speed = scale * sides[i]
            self._target[i] = 0.0 if abs(speed) < r.deadband else speed / _RADIUS

    def _velocity_loop(self) -> None:
        """Runs the PI loops of both sides; a loop's integral stays constant while the battery limits the voltage."""
        r = self.robot
        elapsed = self.time - self._last_loop
        self._last_loop = self.time
        self._next_loop = self.time + r.loop_period * (1.0 + r.jitter * float(self._rng.uniform(-1.0, 1.0)))
        drawn = sum(abs(self._current[i] * self._voltage[i]) for i in (0, 1)) / r.battery_voltage
        most = r.battery_voltage - r.battery_resistance * drawn
        for i in (0, 1):
            error = self._target[i] - self._wheel[i]
            feed = r.torque_constant * _GEAR * self._target[i]
            wanted = feed + r.loop_gain * error + self._integral[i]
            self._voltage[i] = min(max(wanted, -most), most)
            if wanted == self._voltage[i]:
                self._integral[i] += r.loop_integral * error * elapsed

    # ---- motion

    def _advance(self) -> None:
        """Advances tires, wheels and body by a semi-implicit step: first the bristles, then what their forces move."""
        r = self.robot
        mass, vx, vy, rate = self._mass, self._vx, self._vy, self._rate
        _, pitch, roll = self._rest
        weight = mass * _GRAVITY * cos(pitch) * cos(roll)
        front = 0.25 * weight * 2.0 * r.center_forward / _WHEELBASE - 0.5 * self._height * (self._force[0] / _WHEELBASE)
        left = 0.25 * weight * 2.0 * r.center_left / _TRACK - 0.5 * self._height * self._force[1] / _TRACK
        loads = [max(0.0, 0.25 * weight + f * front + s * left + f * s * self._warp_load) for f, s, _ in _TIRES]
        share = weight / max(sum(loads), 1e-9)
        mu_x, mu_y = r.friction, r.friction * r.lateral_grip
        along = across = moment = 0.0
        side_torque, resisting = [0.0, 0.0], [0.0, 0.0]
        for i, (f, s, side) in enumerate(_TIRES):
            load = share * loads[i]
            px = f * 0.5 * _WHEELBASE - r.center_forward
            py = s * 0.5 * _TRACK - r.center_left
            radius, spin = self._radius[side], self._wheel[side]
            slip_x, slip_y = vx - rate * py - radius * spin, vy + rate * px
            speed = hypot(slip_x, slip_y)
            weighted = hypot(mu_x * slip_x, mu_y * slip_y)
            excess = 1.0 + (r.static_excess - 1.0) * exp(-sqrt(speed / _STRIBECK_SPEED))
            rolled = _KAPPA * abs(radius * spin) / r.patch_length
            z = self._z[i]
            new_x = (z[0] + _STEP * slip_x) / (
                1.0 + _STEP * (r.bristle_stiffness * weighted / (mu_x * mu_x * excess) + rolled)
            )
            new_y = (z[1] + _STEP * slip_y) / (
                1.0 + _STEP * (r.bristle_stiffness * weighted / (mu_y * mu_y * excess) + rolled)
            )
            fx = -load * (r.bristle_stiffness * new_x + r.bristle_damping * (new_x - z[0]) / _STEP)
            fy = -load * (r.bristle_stiffness * new_y + r.bristle_damping * (new_y - z[1]) / _STEP)
            z[0], z[1] = new_x, new_y
            along, across, moment = along + fx, across + fy, moment + px * fy - py * fx
            side_torque[side] -= radius * fx
            resisting[side] += r.rolling_resistance * load * radius
        gain = _GEAR * r.torque_constant
        for side in (0, 1):
            spin = self._wheel[side]
            current = (self._voltage[side] - gain * spin) / r.resistance
            current = min(max(current, -r.current_limit), r.current_limit)
            self._current[side] = current
            # Friction of gear and tires may stop a wheel; it cannot reverse the wheel.
            free = spin + _STEP * (gain * current + side_torque[side]) / self._side_inertia
            held = _STEP * (r.gear_friction + resisting[side]) / self._side_inertia
            self._wheel[side] = copysign(max(abs(free) - held, 0.0), free)
        keep = _STEP / _LOAD_LAG
        self._force[0] += keep * (along - self._force[0])
        self._force[1] += keep * (across - self._force[1])
        self.acceleration = (along / mass, across / mass)
        ax = along / mass - _GRAVITY * sin(pitch)
        ay = across / mass - _GRAVITY * sin(roll) * cos(pitch)
        self._vx = vx + _STEP * (ax + rate * vy)
        self._vy = vy + _STEP * (ay - rate * vx)
        self._rate = rate + _STEP * moment / self._yaw_inertia
        base_x, base_y = self._vx + self._rate * r.center_left, self._vy - self._rate * r.center_forward
        ahead, aside, level = cos(self._yaw), sin(self._yaw), cos(pitch)
        self._x += _STEP * level * (ahead * base_x - aside * base_y)
        self._y += _STEP * level * (aside * base_x + ahead * base_y)
        self._yaw += _STEP * self._rate

    def _sample_ground(self) -> None:
        """Fits a plane to the ground under the four tires, and computes the load that the ground's warp shifts."""
        c, s = cos(self._yaw), sin(self._yaw)
        at = [
            (
                self._x + c * f * 0.5 * _WHEELBASE - s * b * 0.5 * _TRACK,
                self._y + s * f * 0.5 * _WHEELBASE + c * b * 0.5 * _TRACK,
            )
            for f, b, _ in _TIRES
        ]
        fl, fr, rl, rr = self._ground(np.array(at)).tolist()
        pitch = atan2(0.5 * (fl + fr - rl - rr), _WHEELBASE)  # nose up
        roll = atan2(0.5 * (fr + rr - fl - rl), _TRACK)  # right side up
        self._rest = (0.25 * (fl + fr + rl + rr), pitch, -roll)
        self._warp_load = 0.25 * self.robot.tire_stiffness * (fl - fr - rl + rr)

    def _touch(self) -> None:
        if not self.touched:
            low = self._rest[0]
            self.touched = self._solids.hit(self._x, self._y, self._yaw, low + _LOW, low + _HIGH)

    # ---- observations

    @property
    def pose(self) -> tuple[float, float, float]:
        """x, y [m] and yaw [rad] of the base."""
        return self._x, self._y, self._yaw

    @property
    def tilt(self) -> float:
        """Angle between the chassis's and the world's up axes, for small pitch and roll [rad]."""
        return hypot(self._attitude[1], self._attitude[2])

    @property
    def wheel_speeds(self) -> tuple[float, float]:
        """Wheel speeds that the encoders of the left and right side measure [rad/s]."""
        return self._wheel[0], self._wheel[1]

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Forward and leftward velocity of the base [m/s], yaw rate [rad/s]."""
        r = self.robot
        return self._vx + self._rate * r.center_left, self._vy - self._rate * r.center_forward, self._rate

    @property
    def currents(self) -> tuple[float, float]:
        """Currents of the two motors [A]."""
        return self._current[0], self._current[1]

    def base_to_world(self, at: float) -> Array:
        """Pose of the base (4, 4), axes forward, left, up, at a time [s] in the last 2 s."""
        first = self._poses[0][0]
        k = min(max((at - first) / _STEP, 0.0), len(self._poses) - 1.0)
        before = int(k)
        share = k - before
        a, b = self._poses[before], self._poses[min(before + 1, len(self._poses) - 1)]
        x, y, yaw, z, pitch, roll = (p + share * (q - p) for p, q in zip(a[1:], b[1:], strict=True))
        cy, sy, cp, sp, cr, sr = cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)
        turn = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        nose = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
        lean = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        return pose_of(turn @ nose @ lean, np.array([x, y, z]))
