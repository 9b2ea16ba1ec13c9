"""The teacher: a SAC agent (Haarnoja et al. 2018; stable-baselines3) that drives by the robot's state, not by pictures.

It drives in the task's environments without pictures, with the training's rewards and randomized robots, so it learns
within two minutes. The policy then learns from pictures what the teacher would do (`distillation.py`).
"""

from collections.abc import Callable
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors.torch import load_file
from safetensors.torch import save as tensor_bytes
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from twin.env.options import STATE_SIZES
from twin.files import read_json, regular_file, wrap_read_errors, write_bytes, write_json
from twin.learn.sb3_env import DriveVecEnv
from twin.learn.train_config import TrainConfig
from twin.loading import Twin

STATE_SCALES = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.3, 3.0, 1.0, 1.0)
"""Typical magnitudes of the components of `RewardAndTermination.state`: speed [m/s], yaw rate [rad/s], cross-track
error [m], heading error [rad], turns up to 1, 2 and 4 m ahead [rad], and place and size of the nearest obstacle [m]."""

_MAX_STATE = 3.0  # states are clamped to ± this multiple of their scales
_HIDDEN = (128, 128)
_ALONG_TIME = 3.0  # [s] length of an episode
_RANDOM_STEPS = 1_000  # steps with random actions before learning begins
_UPDATES = 0.5  # per step
_BATCH = 256
_RATE, _FINAL_RATE = 1e-3, 1e-4  # learning rate in the first half of the training, and at its end
_STREAM = 8  # part of the seed; see `training._TRAINING_STREAM`
_TENSORS, _RESULT = "teacher.safetensors", "teacher.json"


class Teacher(nn.Module):
    """The mean action of the SAC agent's actor."""

    def __init__(self, actions: int) -> None:
        super().__init__()
        widths = (len(STATE_SCALES), *_HIDDEN)
        layers = [nn.Linear(before, after) for before, after in pairwise(widths)]
        self.hidden = nn.Sequential(*(part for layer in layers for part in (layer, nn.ReLU())))
        self.mean = nn.Linear(widths[-1], actions)
        self._scales: torch.Tensor
        self.register_buffer("_scales", torch.tensor(STATE_SCALES), persistent=False)
        self.requires_grad_(False)

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        """Actions in [-1, 1], shape (n, actions), in states (n, 10), see `RewardAndTermination.state`."""
        return self.scaled_actions(self.scaled(states))

    def scaled_actions(self, scaled: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.mean(self.hidden(scaled)))

    def scaled(self, states: torch.Tensor) -> torch.Tensor:
        """States divided by their typical magnitudes, and clamped; shape (n, 10)."""
        return (states / self._scales).clamp(-_MAX_STATE, _MAX_STATE)


def train_teacher(
    twin: Twin, config: TrainConfig, processes: int | None = None, watch: Callable[[int], object] = lambda _: None
) -> tuple[Teacher, int]:
    """Trains a teacher for `config.teacher_steps` steps; then tests it.

    Args:
        processes: See `make_vector_env`; the number does not change the result.
        watch: Receives the number of steps done.

    Returns:
        The teacher, and how often it reaches the goal in one episode per environment, from the segment's start.
    """
    options = {**config.teacher_options(), "along_time": _ALONG_TIME}
    seed, test_seed = map(int, np.random.SeedSequence([config.seed, _STREAM]).generate_state(2))
    with closing(_StateVecEnv(twin, config, seed, processes, options)) as envs:
        model = SAC(
            "MlpPolicy",
            envs,
            learning_rate=lambda left: _FINAL_RATE + (_RATE - _FINAL_RATE) * min(1.0, 2.0 * left),
            buffer_size=config.teacher_steps,
            learning_starts=min(_RANDOM_STEPS, config.teacher_steps // 2),
            batch_size=_BATCH,
            tau=config.tau,
            gamma=config.gamma,
            train_freq=1,
            gradient_steps=max(1, round(_UPDATES * config.worlds)),
            ent_coef="auto_0.1",
            target_entropy=config.entropy * config.control.actions,
            policy_kwargs={"net_arch": list(_HIDDEN)},
            seed=config.seed,
            device="cpu",
        )
        envs.seed(seed)  # stable-baselines3 has seeded them with the run's seed, which the policy's tests may share
        model.learn(config.teacher_steps, _Watch(watch))
    actor = model.policy.actor
    teacher = Teacher(config.control.actions)
    teacher.hidden.load_state_dict(actor.latent_pi.state_dict())
    teacher.mean.load_state_dict(actor.mu.state_dict())
    with closing(_StateVecEnv(twin, config, test_seed, processes, {**options, "start_along": 0.0})) as envs:
        return teacher, _test(teacher, envs)


def save_teacher(folder: Path, teacher: Teacher, successes: int, trials: int) -> None:
    """Writes a teacher and the result of its test to a folder."""
    write_bytes(folder / _TENSORS, tensor_bytes(teacher.state_dict()))
    write_json(folder / _RESULT, {"successes": successes, "trials": trials})


def load_teacher(folder: Path, actions: int) -> Teacher:
    """Raises InputError: files are missing or damaged."""
    teacher = Teacher(actions)
    with wrap_read_errors(folder / _TENSORS, "train again under another name"):
        teacher.load_state_dict(load_file(regular_file(folder / _TENSORS)))
    return teacher


def teacher_result(folder: Path) -> dict[str, int]:
    """The result of the teacher's test: `successes` in `trials`. Raises InputError: as `load_teacher`."""
    with wrap_read_errors(folder / _RESULT, "train again under another name"):
        return {name: int(read_json(folder / _RESULT)[name]) for name in ("successes", "trials")}


class _Watch(BaseCallback):
    def __init__(self, watch: Callable[[int], object]) -> None:
        super().__init__()
        self._watch = watch

    def _on_step(self) -> bool:
        self._watch(self.num_timesteps)
        return True


class _StateVecEnv(VecEnvWrapper):
    """Environments without pictures; observations are scaled states."""

    def __init__(
        self, twin: Twin, config: TrainConfig, seed: int, processes: int | None, options: dict[str, Any]
    ) -> None:
        size = (sum(STATE_SIZES.values()),)
        envs = DriveVecEnv(twin, config.task, config.worlds, seed, processes, **options)
        super().__init__(envs, spaces.Box(-_MAX_STATE, _MAX_STATE, size, np.float32))
        self._scaled = Teacher(config.control.actions).scaled

    def reset(self) -> Any:
        return self._observation(self.venv.reset())

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        states, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self._observation(infos[i]["terminal_observation"])
            # The goal is no terminal state: the middle of the corridor is worth as much there as before, as if the
            # road went on. With a reward for the goal instead, however large, an agent steers the less, the nearer the
            # goal is (docs/findings.md, "The end of a task").
            infos[i]["TimeLimit.truncated"] |= infos[i]["cause"] == "goal"
        return self._observation(states), rewards, dones, infos

    def _observation(self, states: Any) -> NDArray:
        return self._scaled(torch.as_tensor(np.asarray(states))).numpy()


def _test(teacher: Teacher, envs: _StateVecEnv) -> int:
    """Number of environments whose first episode ends at the goal."""
    causes: dict[int, str] = {}
    states = envs.reset()
    while len(causes) < envs.num_envs:
        states, _, dones, infos = envs.step(teacher.scaled_actions(torch.as_tensor(states)).numpy())
        for i in np.flatnonzero(dones).tolist():
            causes.setdefault(i, infos[i]["cause"])
    return sum(cause == "goal" for cause in causes.values())
