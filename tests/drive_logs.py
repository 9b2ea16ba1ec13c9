"""Logs of a simulated Husky whose parameters are known, for the tests of alignment."""

import csv
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.controller import CONTROL_PERIOD, Controller
from twin.robot import WHEELS, HuskyParams
from twin.sysid import logs
from twin.sysid.rollout import plane_model

RATE = 0.05  # [s]
SOFT = HuskyParams(
    friction=0.45,
    spin_friction=0.03,
    ground_viscosity=4.0,
    slip_stiffness=0.2,
    center_of_mass=(-0.06, 0.0, 0.062),
    command_latency=0.2,
    servo_lag=0.12,
    max_acceleration=2.0,
    max_yaw_acceleration=3.0,
    max_yaw_rate=1.4,
    separation_multiplier=1.6,
)
"""On soft ground."""


def columns(params: HuskyParams, duration: float, seed: int, strong: bool = True) -> dict[str, NDArray]:
    """A drive by random commands, each held for 1.5 to 3 s, through the robot's own controller and `mj_step`.

    Args:
        params: The truth.
        duration: [s]
        seed: Of the commands.
        strong: Up to the full yaw rate and speed, else gently straight ahead.
    """
    rng = np.random.default_rng(seed)
    model = plane_model(params)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    data.time = 0.0
    controller = Controller(params)
    joints = np.array([model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS])
    per_row = round(RATE / model.opt.timestep)
    rows, command, until = [], np.zeros(2), 1.0
    for i in range(round(duration / RATE)):
        now = i * RATE
        if now >= until:
            command = rng.uniform([-0.9, -1.8], [0.9, 1.8]) if strong else rng.uniform([0.3, -0.02], [0.8, 0.02])
            until = now + rng.uniform(1.5, 3.0)
        if i % round(CONTROL_PERIOD / RATE) == 0:
            controller.command(now, *command)
        if i % round(CONTROL_PERIOD / RATE) == 1:  # the controller's own clock is not the log's
            data.ctrl[:] = controller.update(now)
        w, x, y, z = data.qpos[3:7]
        wheels = data.qvel[joints]
        acceleration = data.sensor("imu_accelerometer").data
        rows.append(
            (
                *(now, *command, wheels[[0, 2]].mean(), wheels[[1, 3]].mean()),
                *(*data.qpos[:2], np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), *acceleration[:2]),
            )
        )
        mujoco.mj_step(model, data, per_row)
    names = ("time", "cmd_v", "cmd_yaw_rate", "left_wheel_vel", "right_wheel_vel", "x", "y", "yaw")
    names += ("acceleration_x", "acceleration_y")
    return dict(zip(names, np.array(rows).T, strict=True))


def write_csv(path: Path, table: dict[str, NDArray]) -> Path:
    """Writes the log as a .csv with one line of names."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(np.stack(list(table.values()), 1).tolist())
    return path


def windows_of(wheels: NDArray, poses: NDArray | None = None, **others) -> logs.Windows:
    """Windows with these wheel speeds, commanded and measured; none follows another."""
    n, k = wheels.shape[:2]
    return logs.Windows(
        **{
            "commands": wheels.copy(),
            "twist": False,
            "wheels": wheels,
            "poses": np.zeros((n, k + 1, 3)) if poses is None else poses,
            "groups": np.arange(n),
            "follows": np.zeros(n, bool),
        }
        | others
    )
