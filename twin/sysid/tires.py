"""Tires and ground, fitted to the poses of a log.

All terms are parameters of the MJCF: contact coefficients, `impratio`, and the viscosity of a medium around the tires
alone. By default, the ground is hard: only sliding friction and a small rolling resistance matter. Two properties of
the log are also fitted: the offset of the pose sensor from the base's origin, and the delay of poses against wheel
speeds. The height of the center of mass is fitted only on slopes, as poses on level ground do not depend on it.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from twin import runtime
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.sysid.drivetrain import Drivetrain, simulate_drivetrain
from twin.sysid.estimation import Fit, Parameter, fit_parameters, maximize_posterior
from twin.sysid.kinematics import POSE_KINDS, residuals
from twin.sysid.logs import PERIOD, Windows, resample_poses
from twin.sysid.rollout import COARSE_TIMESTEP, LEAD_SAMPLES, MAX_POSE_LAG, MAX_POSE_LEAD, Rollouts, simulate_windows
from twin.types import Array

# ---- choice of terms
#
# Four point contacts under Coulomb friction turn with the same track ratio chi at every speed and friction, and move
# the body at the mean speed of the wheels. A Husky on grass (public DRIVE log) turns with chi 2.0 in gentle bends and
# 2.3 in hard ones; in hard turns it moves at 0.4 to 0.7 of the wheels' mean speed, though it slips only 2.5 % when it
# goes straight. Each model below was fitted to the even groups of that log and scored on its odd ones (median pose
# error after 2 s):
#
#     Coulomb, friction and center of mass fitted       0.23 m, 13 to 26°
#     + spin friction of the contact patch              0.21 m, 6°: turns correctly, but moves as fast as its wheels
#     + drag (`ground_viscosity`)                       0.15 m, 6.0°: scrubbing tires have little grip left for thrust
#     + creep (`slip_stiffness` < 1)                    0.15 m, 5.0°: gentle bends turn more easily than hard ones
#     + slope, from the log's accelerometer             0.13 m, 5.2°: scrubbing tires slide downhill
#     + delay of poses against wheel speeds             0.13 m, 4.8°
#     + wheels and slope before each window             0.12 m, 4.7°: a body keeps its motion for half a second
#     + measurement times of poses (`logs`)             0.12 m, 4.8°
#     + rolling resistance                              0.12 m, 4.8°: grip grows with slip; drag is not needed
#     + ramps continued between windows (`drivetrain`)  0.12 m, 4.5°: wheel speeds lag and do not show them
#     + residual scales from the log (`estimation`)     0.11 m, 4.6°: fixed scales weighted yaw too much
#
# The last row is the shipped model (`docs/benchmarks.md`).
#
# In MuJoCo's elliptic cone (condim 6) sliding, spinning and rolling friction share one limit: a tire (friction μ,
# rolling resistance Crr) that rolls at v and slides at u has the fraction u / √(u² + (v Crr / μ)²) of its grip
# sideways. So grip grows with u / v, the slip ratio, at first in proportion, as in a brush model of stiffness μ / Crr.
# On hard ground Crr is small and the tire obeys Coulomb's law; on soft ground a rolling tire turns more easily than a
# standing one. The fitted Crr describes this effect; the Crr that motor currents show (`benchmarks/motor_currents.py`)
# describes power, and may differ.

_MANY = 100  # with fewer windows the delay of poses is not fitted, and the coarse search uses all windows
_USUAL = 120, 90  # usual numbers of simulations in the coarse search and in the final fit, for the time left
_NEAR = 0.25  # `reach` of the search that starts near the solution
_TURNS, _BENDS = "hard turns at several speeds", "gentle bends as well as hard turns"
_BRAKING = "hard braking, or slopes"
# Prior mean and standard deviation, lowest and highest value, unit, cure. Prior means are those of soft ground and of
# the published robot without load; the prior std of `center_of_mass_x` is the difference between publications. Creep,
# the inverse of slip stiffness, is fitted because slip is proportional to it.
_TABLE: dict[str, tuple[float, float, float, float, str, str]] = {
    "friction": (0.3, 0.2, 0.05, 1.5, "", _TURNS),
    "spin_friction": (0.03, 0.03, 0.0, 0.3, "m", _TURNS),
    "rolling_resistance": (0.1, 0.1, 0.0, 0.5, "", _BENDS),
    "creep": (15.0, 15.0, 0.01, 300.0, "", _BENDS),
    "ground_viscosity": (1.0, 2.0, 0.0, 80.0, "Pa s", "turns while driving at several speeds"),
    "center_of_mass_x": (0.0, 0.08, -0.2, 0.2, "m", "turns forward and backward at speed"),
    "center_of_mass_y": (0.0, 0.04, -0.1, 0.1, "m", "turns to both sides"),
    "center_of_mass_z": (0.062, 0.1, -0.1, 0.45, "m", _BRAKING),
    "radius_left": (WHEEL_RADIUS, 0.012, 0.1, 0.25, "m", "long straight drives"),
    "radius_right": (WHEEL_RADIUS, 0.012, 0.1, 0.25, "m", "long straight drives"),
    "log10_servo_gain": (np.log10(HuskyParams().servo_gain), 0.3, 1.0, 4.0, "", "motor currents or torques"),
    "pose_x": (0.0, 0.2, -1.0, 1.0, "m", "turns on the spot"),
    "pose_y": (0.0, 0.1, -1.0, 1.0, "m", "turns on the spot"),
    "pose_late": (0.0, 0.1, -MAX_POSE_LEAD * PERIOD, MAX_POSE_LAG * PERIOD, "s", "turns that begin and end"),
}
_COPIED = ("friction", "spin_friction", "rolling_resistance", "ground_viscosity")  # equal in `HuskyParams`


def robot_with_values(params: HuskyParams, values: dict[str, float]) -> HuskyParams:
    """A robot with fitted values in its fields, and those of `params` in the others."""
    copied: dict[str, Any] = {name: values[name] for name in _COPIED}
    x, y, z = (values[f"center_of_mass_{axis}"] for axis in "xyz")
    return replace(
        params,
        **copied,
        slip_stiffness=1 / values["creep"],
        center_of_mass=(x, y, z),
        wheel_radius=(values["radius_left"], values["radius_right"]),
        servo_gain=10 ** values["log10_servo_gain"],
    )


def values_of_robot(params: HuskyParams) -> dict[str, float]:
    """The parameters of a robot, with a pose sensor at its origin and without delay."""
    values = {name: getattr(params, name) for name in _COPIED} | {"creep": 1 / params.slip_stiffness}
    values |= {f"center_of_mass_{axis}": at for axis, at in zip("xyz", params.center_of_mass, strict=True)}
    values |= dict(zip(("radius_left", "radius_right"), params.wheel_radius, strict=True))
    return values | {
        "log10_servo_gain": float(np.log10(params.servo_gain)),
        "pose_x": 0.0,
        "pose_y": 0.0,
        "pose_late": 0.0,
    }


def simulate_log(
    params: HuskyParams, values: dict[str, float], drivetrain: Drivetrain, windows: Windows, slope: Array
) -> Rollouts:
    """Simulates the log's commands with these values; poses are those of the log's sensor (`_measured_poses`)."""
    targets, _ = simulate_drivetrain(drivetrain, windows)
    fitted = robot_with_values(_with_drivetrain(params, drivetrain), values)
    out = simulate_windows(fitted, targets, windows.preceding_wheels, slope)
    return replace(out, poses=_measured_poses(out, values, windows))


def _with_drivetrain(params: HuskyParams, drivetrain: Drivetrain) -> HuskyParams:
    """A robot with the drivetrain's lag and unlimited wheel speeds: the servo targets are limited already."""
    return replace(params, servo_lag=drivetrain.lag, max_wheel_speed=5.0)


def _measured_poses(rollouts: Rollouts, values: dict[str, float], windows: Windows) -> Array:
    """Poses as the log's sensor measures them, at the sensor's position and time, shape (n, k + MAX_POSE_AGE + 1, 3).

    At the first measurement the sensor's position and the robot's yaw are zero.
    """
    poses = resample_poses(rollouts.poses, values["pose_late"] - windows.measurement_times[:, 0], LEAD_SAMPLES)
    x, y = values["pose_x"], values["pose_y"]
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return poses + np.stack([x * (cos - 1) - y * sin, x * sin + y * (cos - 1), np.zeros_like(cos)], -1)


def fit_ground(
    params: HuskyParams,
    drivetrain: Drivetrain,
    windows: Windows,
    slope: Array,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Fits the parameters of `_TABLE` to the poses of a log's windows for fitting.

    Args:
        params: The robot that gives the defaults.
        slope: See `rollout.slope_gravity`, shape (n, 2).
    """
    defaults = values_of_robot(params)
    refused: dict[str, str] = {}
    if not slope.any():
        height = defaults["center_of_mass_z"]
        refused["center_of_mass_z"] = (
            f"center_of_mass_z = {height:.4g} m: not fitted on level ground; needs slopes, and an IMU"
        )
    fitting = np.flatnonzero(windows.fitting)
    if len(fitting) < _MANY:  # fitting a delay that is near zero would bias the other parameters
        refused["pose_late"] = f"pose_late = 0 s: not fitted to {len(fitting)} windows; needs {_MANY} or more"
    table = [
        Parameter(name, mean, std, low, high, defaults[name], unit, cure)
        for name, (mean, std, low, high, unit, cure) in _TABLE.items()
        if name not in refused
    ]
    targets, _ = simulate_drivetrain(drivetrain, windows)
    before = windows.preceding_wheels
    base = _with_drivetrain(params, drivetrain)

    def residuals_of(
        which: NDArray[np.int64], timestep: float | None, bar: tqdm
    ) -> Callable[[dict[str, float]], Array]:
        some = windows.select(which)

        def pose_residuals(values: dict[str, float]) -> Array:
            values = defaults | values
            robot = robot_with_values(base, values)
            out = simulate_windows(robot, targets[which], before[which], slope[which], timestep)
            bar.update()
            return residuals(_measured_poses(out, values, some), some)

        return pose_residuals

    # The coarse search uses a long time step and, if there are many windows, a third of them; it gets near the solution
    # in a tenth of the time. The final fit uses the scene's time step, since values fitted at a longer step compensate
    # for that step's errors.
    some = fitting
    if len(fitting) >= _MANY:
        some = np.sort(np.random.default_rng(0).choice(fitting, len(fitting) // 3, replace=False))
    progress(f"coarse search with {len(some)} windows")
    start = {p.name: _TABLE[p.name][0] for p in table}
    with runtime.bar("coarse search", _USUAL[0], "simulation") as bar:
        coarse = residuals_of(some, COARSE_TIMESTEP, bar)
        near = maximize_posterior(table, coarse, POSE_KINDS, start, progress=progress)
    with runtime.bar("final fit", _USUAL[1], "simulation") as bar:
        fine = residuals_of(fitting, None, bar)
        found = fit_parameters(table, fine, POSE_KINDS, windows.groups[fitting], near, _NEAR, progress)
    return replace(found, values=defaults | found.values, refused=refused | found.refused)
