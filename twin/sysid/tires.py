"""Tyres and ground fitted to where a robot went.

Why Coulomb friction is not enough, and what is. Four point contacts under Coulomb friction turn with the same track
ratio chi at every speed and on every friction, and hold the body at the mean speed of the wheels. A Husky on grass
(DRIVE's log) turns with chi 2.0 in gentle bends and 2.3 in hard ones, and in hard turns moves at only 0.4 to 0.7 of the
wheels' mean speed, though it slips 2.5 % going straight. Tried in MuJoCo's own terms, each fitted to the even groups of
that log and scored on its odd ones (median error of the pose after 2 s):

    Coulomb, friction and centre of mass fitted        0.23 m, 13 to 26°
    + spin friction of the contact patch               0.21 m, 6°: right turns, but bodies still as fast as wheels
    + drag (`ground_viscosity`)                        0.15 m, 6.0°: what the wheels wade through takes thrust; tyres
                                                       that scrub sideways have little to give lengthwise, so they slip
    + creep (`slip_stiffness` < 1)                     0.15 m, 5.0°: gentle bends turn more easily than hard ones
    + slope, from the log's accelerometer              0.13 m, 5.2°: scrubbing tyres slide downhill
    + the lateness of poses against wheel speeds       0.13 m, 4.8°
    + wheels and slope as before each window           0.12 m, 4.7°: a body keeps its motion for half a second
    + poses as of when they were measured              0.12 m, 4.8°: and less of it is noise (`timing`)
    + rolling resistance                               0.12 m, 4.8°: tyres that roll grip by their slip; drag goes
    + a controller's ramp goes on between windows      0.12 m, 4.5°: wheels lag, so they do not show it (`commands`)
    + misses of the log's own scales                   0.11 m, 4.6°: set ones cared too much for yaw (`robust`)

The last row is what ships; `docs/benchmarks.md` records it. Before rolling resistance, drag on all bodies or on the
chassis alone was worse by 5 % of what was made least, and a part of the weight that slides, instead of drag, by 1 %:
better straight on, worse in turns.

Rolling resistance costs power, which servos give without slowing down, but it also softens turns. In MuJoCo's elliptic
cone (condim 6) sliding, spinning and rolling share one limit: a tyre that rolls at v and slides at u has the share
u / √(u² + (v Crr / μ)²) of its grip across. That is a tyre's law of slip: grip grows with the slip ratio u / v, in
proportion at first, as in a brush model of stiffness μ / Crr. On hard ground Crr is small, and the tyre Coulomb's; soft
ground, of a large Crr, lets a rolling tyre turn more easily than a standing one. What poses tell is this; a Crr
by motor currents (`currents`) is of power, and may differ.

Fluid of a given density drags with the square of speed and adds mass. All terms are the MJCF's: contact coefficients,
`impratio`, and the viscosity of a medium in which only the tyres stand. None acts on the body, and all are off by
default, but for the rolling resistance of hard ground. Where the ground is level, poses do not tell the mass's height.

Poses may be those of a sensor with a clock of its own: the offset of their origin from the base, and how late they are
against the wheel speeds, are fitted along, as the log's own.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.sysid.drivetrain import Drivetrain, targets
from twin.sysid.estimation import Fit, Parameter, fit, search
from twin.sysid.kinematics import POSE, residuals
from twin.sysid.logs import PERIOD, Windows, retimed
from twin.sysid.rollout import BEFORE, COARSE, EARLY, LATE, Rollouts, drive
from twin.types import Array

# Guess, span, lowest and highest value, unit, and what would show it; guesses are those of soft ground and of the
# published robot, whatever load it bears. Creep is the inverse of slip stiffness, which slip grows with in proportion.
# The mass may well be as far behind as some publish it.
_MANY = 100  # windows
_NEAR = 0.25  # `reach` of the search that begins near the end
_SPREAD = "hard turns at several speeds"
_TORQUE = "motor currents or torques"
_BRAKING = "hard braking, or slopes"
_TABLE: dict[str, tuple[float, float, float, float, str, str]] = {
    "friction": (0.3, 0.2, 0.05, 1.5, "", _SPREAD),
    "spin_friction": (0.03, 0.03, 0.0, 0.3, "m", _SPREAD),
    "rolling_resistance": (0.1, 0.1, 0.0, 0.5, "", "gentle bends as well as hard turns"),
    "creep": (15.0, 15.0, 0.01, 300.0, "", "gentle bends as well as hard turns"),
    "ground_viscosity": (1.0, 2.0, 0.0, 80.0, "Pa s", "turns while driving at several speeds"),
    "center_of_mass_x": (0.0, 0.08, -0.2, 0.2, "m", "turns forward and backward at speed"),
    "center_of_mass_y": (0.0, 0.04, -0.1, 0.1, "m", "turns to both sides"),
    "center_of_mass_z": (0.062, 0.1, -0.1, 0.45, "m", _BRAKING),
    "radius_left": (WHEEL_RADIUS, 0.012, 0.1, 0.25, "m", "long straight drives"),
    "radius_right": (WHEEL_RADIUS, 0.012, 0.1, 0.25, "m", "long straight drives"),
    "log10_servo_gain": (np.log10(HuskyParams().servo_gain), 0.3, 1.0, 4.0, "", _TORQUE),
    "pose_x": (0.0, 0.2, -1.0, 1.0, "m", "turns on the spot"),
    "pose_y": (0.0, 0.1, -1.0, 1.0, "m", "turns on the spot"),
    "pose_late": (0.0, 0.1, -EARLY * PERIOD, LATE * PERIOD, "s", "turns that begin and end"),
}


def robot(params: HuskyParams, values: dict[str, float]) -> HuskyParams:
    """The robot with fitted values in place."""
    x, y, z = params.center_of_mass
    left, right = params.wheel_radius
    return replace(
        params,
        friction=values["friction"],
        spin_friction=values["spin_friction"],
        rolling_resistance=values["rolling_resistance"],
        slip_stiffness=1 / values["creep"],
        ground_viscosity=values["ground_viscosity"],
        center_of_mass=(
            values.get("center_of_mass_x", x),
            values.get("center_of_mass_y", y),
            values.get("center_of_mass_z", z),
        ),
        wheel_radius=(values.get("radius_left", left), values.get("radius_right", right)),
        servo_gain=10 ** values["log10_servo_gain"],
    )


def usual(params: HuskyParams) -> dict[str, float]:
    """The values of `_TABLE` that a robot has."""
    x, y, z = params.center_of_mass
    left, right = params.wheel_radius
    return {
        "friction": params.friction,
        "spin_friction": params.spin_friction,
        "rolling_resistance": params.rolling_resistance,
        "creep": 1 / params.slip_stiffness,
        "ground_viscosity": params.ground_viscosity,
        "center_of_mass_x": x,
        "center_of_mass_y": y,
        "center_of_mass_z": z,
        "radius_left": left,
        "radius_right": right,
        "log10_servo_gain": float(np.log10(params.servo_gain)),
        "pose_x": 0.0,
        "pose_y": 0.0,
        "pose_late": 0.0,
    }


def simulated(
    params: HuskyParams,
    values: dict[str, float],
    drive_: Drivetrain,
    windows: Windows,
    slope: Array,
    timestep: float | None = None,
) -> Rollouts:
    """What the robot with these values does with a log's commands; its poses are `told_poses`."""
    told, _ = targets(drive_, windows)
    fitted = robot(replace(params, servo_lag=drive_.lag, max_wheel_speed=5.0), values)
    out = drive(fitted, told, windows.before, slope, timestep)
    return replace(out, poses=measured_poses(out, values, windows))


def measured_poses(drives: Rollouts, values: dict[str, float], windows: Windows) -> Array:
    """Poses of drives as these windows tell them: of the log's own origin, with its own clock, since each one's first
    pose was measured. Shape (n, k + OLDEST + 1, 3)."""
    seen = retimed(drives.poses, values["pose_late"] - windows.measured[:, 0], BEFORE)
    return moved_origin(seen, values["pose_x"], values["pose_y"])


def moved_origin(poses: Array, x: float, y: float) -> Array:
    """Poses of a point of the robot, x forward and y left of its origin [m], relative to where it was. Any shape."""
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    moved = np.stack([x * (cos - 1) - y * sin, x * sin + y * (cos - 1), np.zeros_like(cos)], -1)
    return poses + moved


def fit_ground(
    params: HuskyParams,
    drive_: Drivetrain,
    windows: Windows,
    slope: Array,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """What the log's poses say of tyres, ground and masses.

    Args:
        params: What is kept of what cannot be told.
        drive_: From `commands.fit_drive`.
        windows: All of a log; fitted are those for fitting.
        slope: From `slope.gravity`, shape (n, 2).
        progress: Told a line now and then.
    """
    kept = usual(params)
    hidden: dict[str, str] = {}
    if not slope.any():
        height = kept["center_of_mass_z"]
        hidden["center_of_mass_z"] = f"center_of_mass_z = {height:.4g} m: on level ground, needs {_BRAKING}"
    fitting = np.flatnonzero(windows.fitting)
    if len(fitting) < _MANY:  # where it is next to nothing, others would go astray for it
        hidden["pose_late"] = f"pose_late = 0 s: from {len(fitting)} windows, needs {_MANY}"
    table = [
        Parameter(name, guess, span, low, high, kept[name], unit, cure)
        for name, (guess, span, low, high, unit, cure) in _TABLE.items()
        if name not in hidden
    ]
    told, _ = targets(drive_, windows)
    before = windows.before
    base = replace(params, servo_lag=drive_.lag, max_wheel_speed=5.0)

    def misses_of(which: NDArray[np.int64], timestep: float | None) -> Callable[[dict[str, float]], Array]:
        some = windows.of(which)

        def missed(values: dict[str, float]) -> Array:
            out = drive(robot(base, kept | values), told[which], before[which], slope[which], timestep)
            return residuals(measured_poses(out, kept | values, some), some)

        return missed

    # At a coarse time step, with a third of many windows, the neighbourhood is found in a tenth of the time; nothing is
    # judged there. What is fitted at a coarse step makes up for it: the shipped one has the last word.
    some = fitting
    if len(fitting) >= _MANY:
        some = np.sort(np.random.default_rng(0).choice(fitting, len(fitting) // 3, replace=False))
    progress(f"looking around with {len(some)} windows")
    near = search(table, misses_of(some, COARSE), POSE, {p.name: _TABLE[p.name][0] for p in table}, progress=progress)
    found = fit(table, misses_of(fitting, None), POSE, windows.groups[fitting], near, _NEAR, progress)
    return replace(found, values=kept | found.values, refused=hidden | found.refused)
