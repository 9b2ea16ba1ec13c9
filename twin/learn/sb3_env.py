"""Many worlds as stable-baselines3 takes them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from twin.env.gym_env import spaces_of
from twin.env.vector_env import make_vector_env
from twin.loading import Twin


class DriveVecEnv(VecEnv):
    """n worlds; one that ends begins anew in the same step, its last observation in `terminal_observation`.

    Every `info` holds `state`, see `Worlds.state`, and where an episode ended `first_state`, of the one that begins.
    """

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str = "right_turn",
        n_envs: int = 8,
        seed: int | None = None,
        processes: int | None = None,
        **options: Any,
    ) -> None:
        """
        Args:
            scene: See `twin.load`.
            task: See `twin.load`.
            n_envs: Number of worlds.
            seed: World i has the episodes of seed + i; None: unpredictable.
            processes: See `worlds_of`.
            options: See `twin.env.options.Options`.
        """
        self.worlds = make_vector_env(scene, task, options, [None] * n_envs, processes)
        super().__init__(n_envs, *spaces_of(self.worlds))
        self._returns, self._lengths = np.zeros(n_envs), np.zeros(n_envs, int)
        self.seed(seed)

    def reset(self) -> NDArray:
        for i, seed in enumerate(self._seeds):
            if seed is not None:
                self.worlds.seed(i, seed)
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.worlds.begin(range(self.num_envs))
        self.reset_infos = [self.worlds.info(i) for i in range(self.num_envs)]
        return self.worlds.observation()

    def step_async(self, actions: NDArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        out = self.worlds.step(self._actions)
        infos = [{**self.worlds.info(i), "state": self.worlds.state(i)} for i in range(self.num_envs)]
        self._returns += out.reward
        self._lengths += 1
        over = np.flatnonzero(out.over).tolist()
        if over:
            last = self.worlds.observation()
            for i in over:
                infos[i] |= {
                    "terminal_observation": last[i],
                    "TimeLimit.truncated": bool(out.truncated[i]),
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                }
            self._returns[over], self._lengths[over] = 0.0, 0
            self.worlds.begin(over)
            for i in over:
                infos[i]["first_state"] = self.worlds.state(i)
        return self.worlds.observation(), out.reward.astype(np.float32), out.over, infos

    def close(self) -> None:
        self.worlds.close()

    def get_images(self) -> Sequence[NDArray | None]:
        if not self.worlds.pixels:
            return [None] * self.num_envs
        return [stack[-1].transpose(1, 2, 0) for stack in self.worlds.pixels.stacks]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        if attr_name == "render_mode":
            return ["rgb_array"] * self.num_envs
        return [self.worlds.get(i, attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for i in self._get_indices(indices):
            self.worlds.set(i, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [self.worlds.call(i, method_name, *args, **kwargs) for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
