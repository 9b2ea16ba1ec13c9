"""Simulates the windows of a log with the Husky's MJCF on a plane, in parallel threads of `mujoco.rollout`.

Each simulation starts with the robot settled on the plane. Before time zero, the window's start, its wheels turn as in
the log (`Windows.preceding_wheels`), which gives body and tires their momentum. From time zero on, the servos receive
the targets of the drivetrain model. The only other input from the log is the slope of the ground, as tilted gravity.
"""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy.optimize import minimize

from twin.mjcf.husky import add_husky, set_options
from twin.mjcf.husky_visuals import ROBOT_VISUAL_GROUP
from twin.robot import WHEELS, HuskyParams
from twin.runtime import available_cores
from twin.sysid.drivetrain import CONTROL_STEP, EXTRA_SAMPLES
from twin.sysid.kinematics import IcrModel, integrate
from twin.sysid.logs import MAX_POSE_AGE, PERIOD, SAMPLES, Windows, relative_poses
from twin.types import Array

# ---- slope of the ground

Complex = NDArray[np.complex128]
"""Gravity along x (real part) and along y (imaginary part) [m/s²]."""

GRAVITY = 9.81  # [m/s²]
MAX_SLOPE = 0.2  # fraction of gravity; readings are clipped to this (11°), since larger ones are bumps or glitches


@dataclass(frozen=True)
class SlopeModel:
    """Statistics of the slope along x and y: a first-order autoregression over windows, with noisy readings."""

    steepness: float
    """Standard deviation of the slope [m/s²]."""
    windows: float
    """Number of windows after which the autocorrelation is 1 / e."""
    noise: float
    """Standard deviation of a window's reading [m/s²]."""


# Log-normal prior of the three statistics: their medians (0.25 m/s² is a slope of 1.5°), and the standard deviation of
# their logarithms.
_PRIOR, _PRIOR_STD = SlopeModel(0.25, 5.0, 0.25), 1.0
_RANGE = 1e-3, 1e3  # bounds of each statistic; they keep the fit finite if the readings have no noise


def slope_gravity(windows: Windows, model: IcrModel) -> Array:
    """Gravity along x and y [m/s²] in the robot's frame at the start of each window's `preceding_wheels`, shape (n, 2).

    Tires that scrub sideways over soft ground slide downhill by more than a good model's error, so the fit to a log on
    real ground needs the slope. An accelerometer at rest reads minus gravity. On a rattling robot, the mean reading of
    a window is noisy, but consecutive windows have similar slopes. So the readings are smoothed (`smooth_slopes`) with
    their most probable statistics (`fit_slope_model`); the noisier the IMU, the closer the result is to level ground.
    Subtracting the log's median removes errors that are constant in the robot's frame (mounting of the IMU, a pitched
    chassis). Headings and accelerations of the motion come from wheel speeds; poses are not used, as the model is to
    predict them.

    Args:
        windows: All windows of a log; without accelerations the result is zero.
    """
    if windows.acceleration is None:
        return np.zeros((len(windows), 2))
    motion = model.motion(windows.wheels)
    turned = integrate(motion)[..., 2]
    yaw, turn = turned[:, :-1], turned[:, -1]
    motion_acceleration = np.stack([np.gradient(motion[..., 0], PERIOD, axis=1), motion[..., 0] * motion[..., 2]], -1)
    down = -(windows.acceleration - motion_acceleration)
    down = down - np.median(down.mean(1), axis=0)
    readings = ((down[..., 0] + 1j * down[..., 1]) * np.exp(1j * yaw)).mean(1)
    readings *= np.minimum(1.0, MAX_SLOPE * GRAVITY / np.maximum(np.abs(readings), 1e-9))
    slopes, _ = smooth_slopes(fit_slope_model(readings, turn, windows.follows), readings, turn, windows.follows)
    slopes *= np.exp(1j * model.motion(windows.preceding_wheels[:, :-1])[..., 2].sum(1) * PERIOD)
    return np.stack([slopes.real, slopes.imag], -1)


def fit_slope_model(readings: Complex, turn: Array, follows: NDArray[np.bool_]) -> SlopeModel:
    """The most probable slope statistics.

    Args:
        readings: Slope of every window in the frame of its first pose, shape (n,).
        turn: Yaw change of each window [rad], shape (n,).
        follows: `Windows.follows`.
    """
    prior = np.log([_PRIOR.steepness, _PRIOR.windows, _PRIOR.noise])

    def cost(logs: Array) -> float:
        _, negative = smooth_slopes(SlopeModel(*np.exp(logs).tolist()), readings, turn, follows)
        return negative + float((((logs - prior) / _PRIOR_STD) ** 2).sum()) / 2

    options = {"xatol": 0.01, "fatol": 0.01}
    found = minimize(cost, prior, method="Nelder-Mead", bounds=[tuple(np.log(_RANGE))] * 3, options=options)
    return SlopeModel(*np.exp(found.x).tolist())


def smooth_slopes(
    model: SlopeModel, readings: Complex, turn: Array, follows: NDArray[np.bool_]
) -> tuple[Complex, float]:
    """Kalman smoother (Rauch, Tung and Striebel 1965): every window's slope given all readings, shape (n,), and the
    negative log-likelihood of the readings. Arguments as `fit_slope_model`.
    """
    n, prior, noise = len(readings), model.steepness**2, model.noise**2
    keep = np.exp(-1 / model.windows)
    predicted, predicted_var = np.zeros(n, complex), np.full(n, prior)  # from the previous windows alone
    slope, var = np.zeros(n, complex), np.zeros(n)  # updated with the window's reading
    cost = 0.0
    for i in range(n):
        if i and follows[i]:
            predicted[i] = keep * slope[i - 1] * np.exp(-1j * turn[i - 1])
            predicted_var[i] = keep**2 * var[i - 1] + (1 - keep**2) * prior
        total, off = predicted_var[i] + noise, readings[i] - predicted[i]
        slope[i] = predicted[i] + predicted_var[i] / total * off
        var[i] = predicted_var[i] * noise / total
        cost += np.log(2 * np.pi * total) + abs(off) ** 2 / (2 * total)
    for i in range(n - 2, -1, -1):
        if follows[i + 1]:
            back = keep * var[i] / predicted_var[i + 1]
            slope[i] += back * np.exp(1j * turn[i]) * (slope[i + 1] - predicted[i + 1])
    return slope, float(cost)


# ---- simulation

MAX_POSE_LAG, MAX_POSE_LEAD = 4, 3  # [samples] largest delay and largest lead of poses relative to wheel speeds
LEAD_SAMPLES = MAX_POSE_LAG + MAX_POSE_AGE  # samples before time zero in the result
# [s] Time step for the start of a fit. After 2 s, poses differ by up to 1 cm and 0.8° from those with the scene's step.
COARSE_TIMESTEP = 0.005

_SETTLE = 1.0  # [s] at rest before a simulation
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class Rollouts:
    poses: Array
    """x, y [m], yaw [rad] of the base relative to the first, `PERIOD` [s] apart, with time zero at `LEAD_SAMPLES`;
    shape (n, LEAD_SAMPLES + k + EXTRA_SAMPLES, 3)."""
    wheels: Array
    """Wheel speeds, left and right [rad/s], shape (n, k + EXTRA_SAMPLES, 2)."""
    torques: Array
    """Motor torques at the wheels, left and right [N m], means over each `PERIOD`; (n, k + EXTRA_SAMPLES − 1, 2)."""


def plane_model(params: HuskyParams, timestep: float | None = None) -> mujoco.MjModel:
    """The Husky on a plane, without the visual geometry, which costs a third of the time and most of the memory."""
    spec = mujoco.MjSpec()
    set_options(spec, params)
    if timestep:
        spec.option.timestep = timestep
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1))
    add_husky(spec, params=params)
    for geom in [geom for geom in spec.geoms if geom.group == ROBOT_VISUAL_GROUP]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return spec.compile()


def simulate_windows(
    params: HuskyParams, targets: Array, before: Array, slope: Array, timestep: float | None = None
) -> Rollouts:
    """Simulates every window.

    Args:
        params: The robot and its ground; its `servo_lag` acts on `targets`, but not on `before`.
        targets: Servo targets, left and right [rad/s], `CONTROL_STEP` [s] apart, shape (n, steps, 2).
        before: Wheel speeds up to time zero, left and right [rad/s], `PERIOD` [s] apart, (n, ≥ LEAD_SAMPLES + 2, 2).
        slope: Gravity along x and y in the robot's frame at the start of `before` [m/s²], shape (n, 2).
        timestep: [s], a whole fraction of `PERIOD`; None: the time step of scenes.
    """
    model = plane_model(params, timestep)
    step = model.opt.timestep
    per_sample = round(PERIOD / step)
    lead = (before.shape[1] - 1) * per_sample
    count = targets.shape[1] * CONTROL_STEP
    index = np.minimum((np.arange(round(count / step)) * step / CONTROL_STEP + 1e-9).astype(int), targets.shape[1] - 1)
    control = np.concatenate([_lag_compensated(before, per_sample, params.servo_lag), targets[:, index]], 1)
    limit = model.actuator_ctrlrange[0, 1]
    states, joints = _initial_states(model, params, np.clip(before[:, 0], -limit, limit))
    models = _tilted_models(model, slope)
    threads = min(available_cores(), len(targets))
    states, sensors = rollout.rollout(models, [mujoco.MjData(model) for _ in range(threads)], states, control)
    torque = [model.sensor(f"{side}_torque").adr[0] for side in ("left", "right")]
    torques = sensors[:, lead:, torque]
    # The first state of a rollout is the one after its first step, so time zero is the last step of the lead.
    seen = states[:, lead - 1 - LEAD_SAMPLES * per_sample :: per_sample]
    position, velocity = seen[..., 1 : 1 + model.nq], seen[..., 1 + model.nq : 1 + model.nq + model.nv]
    n, k = targets.shape[0], SAMPLES + EXTRA_SAMPLES
    return Rollouts(
        _planar(position[:, : LEAD_SAMPLES + k, :7]),
        np.stack([velocity[:, LEAD_SAMPLES : LEAD_SAMPLES + k, joints[[i, i + 2]]].mean(-1) for i in (0, 1)], -1),
        torques[:, : (k - 1) * per_sample].reshape(n, k - 1, per_sample, 2).mean(2),
    )


def _lag_compensated(wheels: Array, count: int, lag: float) -> Array:
    """Targets with which servos follow wheel speeds (n, k, 2), `PERIOD` [s] apart, despite a first-order lag [s].

    Between samples the wheel speeds are interpolated linearly. Shape (n, (k − 1) · count, 2), `count` per sample.
    """
    share = (np.arange(count) + 0.5)[:, None] / count
    change = np.diff(wheels, axis=1)[:, :, None]
    targets = wheels[:, :-1, None] + (share + lag / PERIOD) * change
    return targets.reshape(len(wheels), -1, wheels.shape[2])


def _initial_states(model: mujoco.MjModel, params: HuskyParams, start: Array) -> tuple[Array, NDArray[np.int64]]:
    """Initial full-physics states, shape (n, ·), and the indices of the wheels' degrees of freedom, shape (4,)."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(_SETTLE / model.opt.timestep))
    data.qvel[:], data.time = 0.0, 0.0
    joints = np.array([model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS])
    states = np.empty((len(start), mujoco.mj_stateSize(model, _FULL)))
    for i, sides in enumerate(start):
        rolling = sides * params.wheel_radius
        data.qvel[0] = rolling.mean()
        # The initial yaw rate is not divided by a track, so it is about half of the rate to which the robot settles. It
        # is kept because published fits were made with it, and because it is set 0.8 s before the first pose: the
        # settled rate would change poses by at most 1.2 mm and 0.02° with a friction of 0.3 or more, and by up to 3 cm
        # and 1.1° with 0.05, a fit's lower bound.
        data.qvel[5] = (rolling[1] - rolling[0]) / 2
        data.qvel[joints] = np.tile(sides, 2)
        if model.na:
            data.act[:] = sides
        mujoco.mj_getState(model, data, states[i], _FULL)
    return states, joints


def _tilted_models(model: mujoco.MjModel, slope: Array) -> list[mujoco.MjModel]:
    """A model per window with tilted gravity; a single one if all slopes are zero."""
    if not np.any(slope):
        return [model]
    models = []
    for x, y in slope:
        tilted = copy.copy(model)
        tilted.opt.gravity[:] = x, y, -np.sqrt(GRAVITY**2 - x * x - y * y)
        models.append(tilted)
    return models


def _planar(pose: Array) -> Array:
    """Free-joint positions (n, k, 7) → x, y, yaw relative to the first, shape (n, k, 3)."""
    w, x, y, z = np.moveaxis(pose[..., 3:7], -1, 0)
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), axis=1)
    return relative_poses(np.stack([pose[..., 0], pose[..., 1], yaw], -1))
