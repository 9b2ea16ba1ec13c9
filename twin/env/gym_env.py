"""The environment for Gymnasium: `twin/Drive-v0`, alone or many at once.

    gymnasium.make("twin/Drive-v0", scene="scenes/demo", task="right_turn", lighting="night")
    gymnasium.make_vec("twin/Drive-v0", 8, vectorization_mode="vector_entry_point", scene="scenes/demo")

Actions are in [-1, 1], which spans what the dm_control environment allows in metres and radians. Observations are
pictures, uint8, (3 · stack, height, width), the newest three channels last; with `pixels=False` the driver's state.
`info` says `cause` (why the episode ended, or nothing), `is_success`, `progress` [m], `start` [m] (how far along
the stretch it began), `cross_track` [m], `lighting`, `trust`, `randomisation`, `episode_seed`, `speed` [m/s] and
`touched`.
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
from twin.errors import InputError, shown
from twin.loading import Twin


def spaces_of(worlds: LocalVectorEnv | ProcessVectorEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one world."""
    action = gymnasium.spaces.Box(-1.0, 1.0, (worlds.actions,), np.float32)
    if worlds.pixels:
        width, height = worlds.options.size
        return gymnasium.spaces.Box(0, 255, (3 * worlds.options.stack, height, width), np.uint8), action
    return gymnasium.spaces.Box(-np.inf, np.inf, (worlds.states,), np.float32), action


def _checked(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise InputError(f"render_mode = {shown(render_mode)}; expected None or 'rgb_array'")
    return render_mode


class DriveEnv(gymnasium.Env):
    """One world."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012, as Gymnasium has it

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str = "right_turn",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """See `twin.load`; `render_mode` is None or rgb_array."""
        self.render_mode = _checked(render_mode)
        self.worlds = make_vector_env(scene, task, options, [None])
        self._begun = False
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.worlds.options.control_timestep)}
        self.observation_space, self.action_space = spaces_of(self.worlds)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.worlds.seed(0, seed)
        self.worlds.begin([0])
        self._begun = True
        return self.worlds.observation()[0], self.worlds.info(0)

    def step(self, action: NDArray) -> tuple[NDArray, float, bool, bool, dict[str, Any]]:
        if not self._begun:
            raise ResetNeeded("step before reset; call reset() first")
        out = self.worlds.step(np.asarray(action)[None])
        end = bool(out.terminated[0]), bool(out.truncated[0])
        return self.worlds.observation()[0], float(out.reward[0]), *end, self.worlds.info(0)

    def render(self) -> NDArray | None:
        """The newest picture, uint8 (height, width, 3); None without pixels."""
        if self.render_mode is None or not self.worlds.pixels:
            return None
        return self.worlds.pixels.stacks[0, -1].transpose(1, 2, 0).copy()

    def close(self) -> None:
        self.worlds.close()


class DriveVectorEnv(VectorEnv):
    """n worlds; one that ends begins anew in the same step, its last observation and info in `final_obs`,
    `final_info`."""

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
        """See `twin.load`; for `processes` see `worlds_of`."""
        self.num_envs, self.render_mode = num_envs, _checked(render_mode)
        self._begun = False
        self.worlds = make_vector_env(scene, task, options, [None] * num_envs, processes)
        self.single_observation_space, self.single_action_space = spaces_of(self.worlds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        """All worlds anew; world i gets seed + i where one number is given."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        for i, one in enumerate(seeds or ()):
            if one is not None:
                self.worlds.seed(i, one)
        self.worlds.begin(range(self.num_envs))
        self._begun = True
        return self.worlds.observation(), self._infos(range(self.num_envs))

    def step(self, actions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, dict[str, Any]]:
        if not self._begun:
            raise ResetNeeded("step before reset; call reset() first")
        out = self.worlds.step(np.asarray(actions))
        over = np.flatnonzero(out.over).tolist()
        final: dict[str, Any] = {}
        if over:
            last = self.worlds.observation()
            final = {"final_obs": np.full(self.num_envs, None, object), "_final_obs": out.over.copy()}
            for i in over:
                final["final_obs"][i] = last[i]
            final |= {"final_info": self._infos(over), "_final_info": out.over.copy()}
            self.worlds.begin(over)
        infos = self._infos(range(self.num_envs)) | final
        return self.worlds.observation(), out.reward, out.terminated, out.truncated, infos

    def render(self) -> tuple[NDArray, ...] | None:
        """The newest picture of each world, uint8 (height, width, 3)."""
        if self.render_mode is None or not self.worlds.pixels:
            return None
        return tuple(stack[-1].transpose(1, 2, 0).copy() for stack in self.worlds.pixels.stacks)

    def close_extras(self, **kwargs: Any) -> None:
        self.worlds.close()

    def _infos(self, which: Sequence[int]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for i in which:
            infos = self._add_info(infos, self.worlds.info(i), i)
        return infos
