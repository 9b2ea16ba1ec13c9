"""Gymnasium environments: `twin/Drive-v0`, single or vectorized.

    gymnasium.make("twin/Drive-v0", scene="scenes/demo", task="right_turn", lighting="night")
    gymnasium.make_vec("twin/Drive-v0", 8, vectorization_mode="vector_entry_point", scene="scenes/demo")

Actions in [-1, 1] span the action range of the dm_control environment. Observations are images, uint8, shape
(3 · stack, height, width), the newest three channels last; with `pixels=False` the privileged state. `info` contains
`cause` (of the episode's end, or empty), `is_success`, `progress` [m], `start` [m] (offset of the start along the route
segment), `cross_track` [m], `lighting`, `trust`, `randomisation`, `episode_seed`, `speed` [m/s] and `touched`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from twin.env.vector_env import make_vector_env
from twin.env.vector_env_local import LocalVectorEnv
from twin.env.vector_env_processes import ProcessVectorEnv
from twin.errors import InputError, short_repr
from twin.loading import Twin


def make_spaces(envs: LocalVectorEnv | ProcessVectorEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one environment."""
    action = gymnasium.spaces.Box(-1.0, 1.0, (envs.action_size,), np.float32)
    if envs.pixels:
        width, height = envs.options.size
        return gymnasium.spaces.Box(0, 255, (3 * envs.options.stack, height, width), np.uint8), action
    return gymnasium.spaces.Box(-np.inf, np.inf, (envs.state_size,), np.float32), action


def _check_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise InputError(f"render_mode = {short_repr(render_mode)}; expected None or 'rgb_array'")
    return render_mode


class DriveEnv(gymnasium.Env):
    """A single environment."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012, as in Gymnasium

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str = "right_turn",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """See `twin.load`; `render_mode` is None or rgb_array."""
        self.render_mode = _check_render_mode(render_mode)
        self.vector_env = make_vector_env(scene, task, options, [None])
        self._started = False
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.vector_env.options.control_timestep)}
        self.observation_space, self.action_space = make_spaces(self.vector_env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.vector_env.seed(0, seed)
        self.vector_env.begin([0])
        self._started = True
        return self.vector_env.observation()[0], self.vector_env.info(0)

    def step(self, action: NDArray) -> tuple[NDArray, float, bool, bool, dict[str, Any]]:
        if not self._started:
            raise ResetNeeded("step before reset; call reset() first")
        out = self.vector_env.step(np.asarray(action)[None])
        end = bool(out.terminated[0]), bool(out.truncated[0])
        return self.vector_env.observation()[0], float(out.reward[0]), *end, self.vector_env.info(0)

    def render(self) -> NDArray | None:
        """The newest image, uint8 (height, width, 3); None without pixels."""
        if self.render_mode is None or not self.vector_env.pixels:
            return None
        return self.vector_env.pixels.stacks[0, -1].transpose(1, 2, 0).copy()

    def close(self) -> None:
        self.vector_env.close()


class DriveVectorEnv(VectorEnv):
    """n environments. One whose episode ends is reset in the same step; its last observation and info are in
    `final_obs` and `final_info`."""

    metadata = {**DriveEnv.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int,
        scene: str | Path | Twin,
        task: str = "right_turn",
        render_mode: str | None = None,
        processes: int | None = None,
        **options: Any,
    ) -> None:
        """See `twin.load` and, for `processes`, `make_vector_env`."""
        self.num_envs, self.render_mode = num_envs, _check_render_mode(render_mode)
        self._started = False
        self.vector_env = make_vector_env(scene, task, options, [None] * num_envs, processes)
        self.single_observation_space, self.single_action_space = make_spaces(self.vector_env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        """Resets all environments; a single seed gives environment i the seed + i."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        for i, one in enumerate(seeds or ()):
            if one is not None:
                self.vector_env.seed(i, one)
        self.vector_env.begin(range(self.num_envs))
        self._started = True
        return self.vector_env.observation(), self._infos(range(self.num_envs))

    def step(self, actions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, dict[str, Any]]:
        if not self._started:
            raise ResetNeeded("step before reset; call reset() first")
        out = self.vector_env.step(np.asarray(actions))
        over = np.flatnonzero(out.over).tolist()
        final: dict[str, Any] = {}
        if over:
            last = self.vector_env.observation()
            final = {"final_obs": np.full(self.num_envs, None, object), "_final_obs": out.over.copy()}
            for i in over:
                final["final_obs"][i] = last[i]
            final |= {"final_info": self._infos(over), "_final_info": out.over.copy()}
            self.vector_env.begin(over)
        infos = self._infos(range(self.num_envs)) | final
        return self.vector_env.observation(), out.reward, out.terminated, out.truncated, infos

    def render(self) -> tuple[NDArray, ...] | None:
        """The newest image of each environment, uint8 (height, width, 3)."""
        if self.render_mode is None or not self.vector_env.pixels:
            return None
        return tuple(stack[-1].transpose(1, 2, 0).copy() for stack in self.vector_env.pixels.stacks)

    def close_extras(self, **kwargs: Any) -> None:
        self.vector_env.close()

    def _infos(self, which: Sequence[int]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for i in which:
            infos = self._add_info(infos, self.vector_env.info(i), i)
        return infos
