"""Windows of a log driven by the Husky's MJCF on a plane, many at once.

Each starts rolling: the robot stands settled on the plane, and before time starts its wheels do what the log's did
before the window (`Windows.before`), so that body and tyres are in the motion that goes with them. Then the servo is
told what the controller makes of the log's commands (`commands.targets`). Nothing else of the log enters but the slope.
`mujoco.rollout` steps windows in threads; gravity is tilted rather than the plane.
"""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy.optimize import minimize

from twin.mjcf.husky import add_husky, set_options
from twin.mjcf.husky_visuals import LOOK_GROUP
from twin.robot import WHEELS, HuskyParams
from twin.runtime import cores
from twin.sysid.drivetrain import AHEAD, STEP
from twin.sysid.kinematics import Icr, integrate
from twin.sysid.logs import OLDEST, PERIOD, SAMPLES, Windows
from twin.types import Array

# ---- How the ground slopes under a drive, from the log's own accelerometer.
#
# At rest an accelerometer reads gravity upside down; tyres that scrub sideways over soft ground slide downhill by more
# than a good model's error, so a log on real ground is fitted with the slope it was driven on. Two seconds of a rattling
# robot tell it badly, but the next two are on nearly the same ground: from window to window the slope forgets itself at a
# steady rate (a first-order autoregression), a window's reading adds noise, and a Kalman smoother (Rauch, Tung and
# Striebel 1965) weighs all that follow each other. How steep the ground is, for how long, and how noisy the readings are
# is what makes the log's own readings most likely, so that slopes of a rough IMU shrink towards level ground. What is
# constant in the robot's own frame (the IMU's mounting, a pitched chassis) is taken off by the median over the log.
#
# Only headings and speeds reckoned from wheels (`kinematics.Icr`) are used to turn accelerations into one frame and to
# take the motion's own off: never the poses that are to be predicted.


Complex = NDArray[np.complex128]
"""Gravity along x, and along y as the imaginary part [m/s²]."""

GRAVITY = 9.81  # [m/s²]
STEEPEST = 0.2  # of gravity; a reading of more than 11° is rather a bump or a glitch


@dataclass(frozen=True)
class Slopes:
    """What slopes are like, along x and along y alike."""

    steepness: float
    """[m/s²], standard deviation."""
    windows: float
    """After how many of them a slope has forgotten itself but for 1 / e."""
    noise: float
    """Of a window's reading [m/s²], standard deviation."""


_USUAL = Slopes(0.25, 5.0, 0.25)  # gentle: 1.5°
_DOUBT = 1.0  # standard deviation of the logarithms of those three, before any log
_RANGE = 1e-3, 1e3  # of each, so that readings without any noise do no harm


def gravity(windows: Windows, model: Icr) -> Array:
    """Gravity along x and y [m/s²] of the robot where each window's `Windows.before` begins, shape (n, 2).

    Zeros without accelerations.
    """
    if windows.acceleration is None:
        return np.zeros((len(windows), 2))
    motion = model.motion(windows.wheels)
    turned = integrate(motion)[..., 2]
    yaw, turn = turned[:, :-1], turned[:, -1]
    own = np.stack([np.gradient(motion[..., 0], PERIOD, axis=1), motion[..., 0] * motion[..., 2]], -1)
    down = -(windows.acceleration - own)
    down = down - np.median(down.mean(1), axis=0)
    readings = ((down[..., 0] + 1j * down[..., 1]) * np.exp(1j * yaw)).mean(1)
    readings *= np.minimum(1.0, STEEPEST * GRAVITY / np.maximum(np.abs(readings), 1e-9))
    slopes, _ = smoothed(terrain(readings, turn, windows.follows), readings, turn, windows.follows)
    slopes *= np.exp(1j * model.motion(windows.before[:, :-1])[..., 2].sum(1) * PERIOD)
    return np.stack([slopes.real, slopes.imag], -1)


def terrain(readings: Complex, turn: Array, follows: NDArray[np.bool_]) -> Slopes:
    """The terrain that makes a log's readings most likely, beside what is usual.

    Args:
        readings: Of every window's slope, in the frame of its first pose, shape (n,).
        turn: What each window turns by [rad], shape (n,).
        follows: Of `Windows`, shape (n,).
    """
    usual = np.log([_USUAL.steepness, _USUAL.windows, _USUAL.noise])

    def unlikely(logs: Array) -> float:
        _, cost = smoothed(Slopes(*np.exp(logs).tolist()), readings, turn, follows)
        return cost + float((((logs - usual) / _DOUBT) ** 2).sum()) / 2

    options = {"xatol": 0.01, "fatol": 0.01}
    found = minimize(unlikely, usual, method="Nelder-Mead", bounds=[tuple(np.log(_RANGE))] * 3, options=options)
    return Slopes(*np.exp(found.x).tolist())


def smoothed(terrain_: Slopes, readings: Complex, turn: Array, follows: NDArray[np.bool_]) -> tuple[Complex, float]:
    """Every window's slope given all readings, shape (n,), and minus the logarithm of the readings' likelihood.

    For the arguments see `terrain`.
    """
    n, prior, noise = len(readings), terrain_.steepness**2, terrain_.noise**2
    keep = np.exp(-1 / terrain_.windows)
    guess, unsure = np.zeros(n, complex), np.full(n, prior)  # by the windows before
    slope, left = np.zeros(n, complex), np.zeros(n)  # by these and its own reading
    cost = 0.0
    for i in range(n):
        if i and follows[i]:
            guess[i] = keep * slope[i - 1] * np.exp(-1j * turn[i - 1])
            unsure[i] = keep**2 * left[i - 1] + (1 - keep**2) * prior
        spread, off = unsure[i] + noise, readings[i] - guess[i]
        slope[i] = guess[i] + unsure[i] / spread * off
        left[i] = unsure[i] * noise / spread
        cost += np.log(2 * np.pi * spread) + abs(off) ** 2 / (2 * spread)
    for i in range(n - 2, -1, -1):
        if follows[i + 1]:
            back = keep * left[i] / unsure[i + 1]
            slope[i] += back * np.exp(1j * turn[i]) * (slope[i + 1] - guess[i + 1])
    return slope, float(cost)


LATE, EARLY = 4, 3  # samples by which poses may be late against the wheel speeds, and ahead of them
BEFORE = LATE + OLDEST  # samples before time starts that are kept
COARSE = 0.005  # [s] time step to begin a fit with; poses after 2 s are up to 1 cm and 0.8° off those of a fine one

_SETTLE = 1.0  # [s]
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class Rollouts:
    """What the robots did."""

    poses: Array
    """x, y [m], yaw [rad] of the base relative to the first, `PERIOD` [s] apart; time starts with number `BEFORE`.
    Shape (n, BEFORE + k + AHEAD, 3)."""
    wheels: Array
    """Of the left and of the right side [rad/s], shape (n, k + AHEAD, 2)."""
    torques: Array
    """Of the left and the right motor, at the wheels [N m], means over each `PERIOD`, shape (n, k + AHEAD − 1, 2)."""


def plane_model(params: HuskyParams, timestep: float | None = None) -> mujoco.MjModel:
    """The Husky on a plane, without its looks: they take a third of the time and nearly all of the memory."""
    spec = mujoco.MjSpec()
    set_options(spec, params)
    if timestep:
        spec.option.timestep = timestep
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1))
    add_husky(spec, params=params)
    for geom in [geom for geom in spec.geoms if geom.group == LOOK_GROUP]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return spec.compile()


def drive(params: HuskyParams, told: Array, before: Array, slope: Array, timestep: float | None = None) -> Rollouts:
    """Drives every window.

    Args:
        params: The robot and its ground; its `servo_lag` acts on `told`, but not on `before`.
        told: Wheel speeds the servos are told, left and right [rad/s], `commands.STEP` [s] apart, shape (n, steps, 2).
        before: Wheel speeds until time starts, left and right [rad/s], `PERIOD` [s] apart; the last are those at the
            start. Shape (n, ≥ BEFORE + 2, 2).
        slope: Gravity along x and y of the robot where `before` begins [m/s²], shape (n, 2).
        timestep: [s], a whole fraction of `PERIOD`; the shipped one by default.
    """
    model = plane_model(params, timestep)
    step = model.opt.timestep
    per_sample = round(PERIOD / step)
    lead = (before.shape[1] - 1) * per_sample
    count = told.shape[1] * STEP
    index = np.minimum((np.arange(round(count / step)) * step / STEP + 1e-9).astype(int), told.shape[1] - 1)
    control = np.concatenate([_led(before, per_sample, params.servo_lag), told[:, index]], 1)
    limit = model.actuator_ctrlrange[0, 1]
    states, joints = _starts(model, params, np.clip(before[:, 0], -limit, limit))
    models = _tilted(model, slope)
    threads = min(cores(), len(told))
    states, sensors = rollout.rollout(models, [mujoco.MjData(model) for _ in range(threads)], states, control)
    torque = [model.sensor(f"{side}_torque").adr[0] for side in ("left", "right")]
    torques = sensors[:, lead:, torque]
    # A rollout's first state is that after one step; the one before time starts is the last of the lead.
    seen = states[:, lead - 1 - BEFORE * per_sample :: per_sample]
    position, velocity = seen[..., 1 : 1 + model.nq], seen[..., 1 + model.nq : 1 + model.nq + model.nv]
    n, k = told.shape[0], SAMPLES + AHEAD
    return Rollouts(
        _planar(position[:, : BEFORE + k, :7]),
        np.stack([velocity[:, BEFORE : BEFORE + k, joints[[i, i + 2]]].mean(-1) for i in (0, 1)], -1),
        torques[:, : (k - 1) * per_sample].reshape(n, k - 1, per_sample, 2).mean(2),
    )


def _led(wheels: Array, count: int, lag: float) -> Array:
    """What servos that lag are told so that wheels go from sample to sample in straight lines.

    Args:
        wheels: Shape (n, k, 2), `PERIOD` [s] apart.
        count: Steps from one to the next.
        lag: [s], of first order: what comes out is as much behind as it changes in that time.

    Returns:
        Shape (n, (k − 1) · count, 2).
    """
    share = (np.arange(count) + 0.5)[:, None] / count
    change = np.diff(wheels, axis=1)[:, :, None]
    told = wheels[:, :-1, None] + (share + lag / PERIOD) * change
    return told.reshape(len(wheels), -1, wheels.shape[2])


def _starts(model: mujoco.MjModel, params: HuskyParams, start: Array) -> tuple[Array, NDArray[np.int64]]:
    """Full states to start from, shape (n, ·), and the degrees of freedom of the wheels, shape (4,)."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(_SETTLE / model.opt.timestep))
    data.qvel[:] = 0.0
    data.time = 0.0
    joints = np.array([model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS])
    states = np.empty((len(start), mujoco.mj_stateSize(model, _FULL)))
    for i, sides in enumerate(start):
        rolling = sides * params.wheel_radius
        data.qvel[0] = rolling.mean()
        data.qvel[5] = (rolling[1] - rolling[0]) / 2  # about half what a differential drive would turn
        data.qvel[joints] = np.tile(sides, 2)
        if model.na:
            data.act[:] = sides
        mujoco.mj_getState(model, data, states[i], _FULL)
    return states, joints


def _tilted(model: mujoco.MjModel, slope: Array) -> list[mujoco.MjModel]:
    """One model per window; the same one where the ground is level throughout."""
    if not np.any(slope):
        return [model]
    models = []
    for x, y in slope:
        tilted = copy.copy(model)
        tilted.opt.gravity[:] = x, y, -np.sqrt(GRAVITY**2 - x * x - y * y)
        models.append(tilted)
    return models


def _planar(pose: Array) -> Array:
    """x, y, yaw relative to the first, shape (n, k, 3), of free-joint positions (n, k, 7)."""
    w, x, y, z = np.moveaxis(pose[..., 3:7], -1, 0)
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), axis=1)
    moved = pose[..., :2] - pose[:, :1, :2]
    cos, sin = np.cos(yaw[:, :1]), np.sin(yaw[:, :1])
    return np.stack(
        [
            cos * moved[..., 0] + sin * moved[..., 1],
            cos * moved[..., 1] - sin * moved[..., 0],
            yaw - yaw[:, :1],
        ],
        -1,
    )
