"""The vector environment for stable-baselines3."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from twin.env.gym_env import check_reset_options, make_spaces, observations, of_one
from twin.env.vector_env import make_vector_env
from twin.loading import Twin


class DriveVecEnv(VecEnv):
    """n environments. The last step of an episode also resets its environment; `info` then has the episode's last
    observation.

    Every `info` has the privileged `state`; at the end of an episode, it also has `first_state`, the state at the start
    of the next episode. `lighting` is the name in tables, such as `training`; `sampled_lighting` adds the sampled
    mixture. (The `info` of the Gymnasium environments has this longer text as `lighting`.)

    `vector_env` has `spare` further environments after these; a step does not advance them.
    """

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str = "right_turn",
        n_envs: int = 8,
        seed: int | None = None,
        processes: int | None = None,
        spare: int = 0,
        **options: Any,
    ) -> None:
        """
        Args:
            seed: Environment i has the seed `seed` + i; None: unpredictable seeds.
            spare: Number of additional environments in `vector_env`.
            scene, task, processes, options: See `make_vector_env`.
        """
        self.vector_env = make_vector_env(scene, task, options, [None] * (n_envs + spare), processes)
        super().__init__(n_envs, *make_spaces(self.vector_env))
        self._returns, self._lengths = np.zeros(n_envs), np.zeros(n_envs, int)
        self.seed(seed)

    def reset(self) -> Any:
        """Resets all environments. Raises InputError: `set_options` gave options."""
        for options in self._options:
            check_reset_options(options)
        for i, seed in enumerate(self._seeds):
            if seed is not None:
                self.vector_env.seed(i, seed)
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.vector_env.begin(range(self.num_envs))
        return self._observations()

    def _observations(self) -> Any:
        found, n = observations(self.vector_env), self.num_envs
        return {name: values[:n] for name, values in found.items()} if isinstance(found, dict) else found[:n]

    def step_async(self, actions: NDArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray, NDArray, list[dict[str, Any]]]:
        out = self.vector_env.step(self._actions, range(self.num_envs))
        infos = [{**self.vector_env.info(i), "state": self.vector_env.state(i)} for i in range(self.num_envs)]
        self._returns += out.reward
        self._lengths += 1
        over = np.flatnonzero(out.over).tolist()
        if over:
            last = self._observations()
            for i in over:
                infos[i] |= {
                    "terminal_observation": of_one(last, i),
                    "TimeLimit.truncated": bool(out.truncated[i]),
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                }
            self._returns[over], self._lengths[over] = 0.0, 0
            self.vector_env.begin(over)
            for i in over:
                infos[i]["first_state"] = self.vector_env.state(i)
        return self._observations(), out.reward.astype(np.float32), out.over, infos

    def close(self) -> None:
        self.vector_env.close()

    def get_images(self) -> Sequence[NDArray | None]:
        if not self.vector_env.pixels:
            return [None] * self.num_envs
        return [stack[-1].transpose(1, 2, 0) for stack in self.vector_env.pixels.stacks[: self.num_envs]]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        if attr_name == "render_mode":
            return ["rgb_array"] * self.num_envs
        return [self.vector_env.get(i, attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for i in self._get_indices(indices):
            self.vector_env.set(i, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [self.vector_env.call(i, method_name, *args, **kwargs) for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
