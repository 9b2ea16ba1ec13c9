"""Gymnasium environments: `twin/Drive-v0`, single or vectorized.

    gymnasium.make("twin:twin/Drive-v0", scene="scenes/demo", task="right_turn", lighting="night")
    gymnasium.make_vec("twin:twin/Drive-v0", 8, vectorization_mode="vector_entry_point", scene="scenes/demo")

The prefix `twin:` makes Gymnasium import `twin`, which registers the environment. Use the prefix in new processes, such
as those of stable-baselines3's SubprocVecEnv.

Actions in [-1, 1] span the action range of the dm_control environment. Observations are images: uint8, shape
(3 · stack, height, width), the newest three channels last. With `pixels=False`, an observation is the privileged state
of `RewardAndTermination.state`: float32, clipped to the bounds of the observation space. With the option `state`,
observations are a dict of images (`pixels`) and numbers (`state`).

`info` contains `cause` (why the episode ended; empty before its end), `is_success`, `progress` [m], `start` [m] (offset
of the start along the route segment), `cross_track` [m], `speed` [m/s], `touched`, `randomisation`, `episode_seed` and,
with images, `trust` and `lighting`. `lighting` is the name of the episode's lighting; for a sampled lighting, it is the
name of the set and the nearest mixture of filmed lightings: `training: sun 0.62, night 0.38`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from twin.env.mujoco_renderer import ChaseCamera, SceneCamera
from twin.env.observation import PixelObserver
from twin.env.options import IMAGE_SIZE, check_actions, check_option, parse_options, state_size
from twin.env.vector_env import ProcessVectorEnv, make_vector_env
from twin.env.vector_env_local import LocalVectorEnv
from twin.errors import InputError, short_repr
from twin.loading import Twin
from twin.warp_runtime import wp

ROBOT, CHASE = "robot", "chase"

_RENDER_SIZE = 640, 360  # [px] default width and height of a chase view


def make_spaces(envs: LocalVectorEnv | ProcessVectorEnv) -> tuple[gymnasium.Space, gymnasium.spaces.Box]:
    """Observation and action space of one environment."""
    action = gymnasium.spaces.Box(-1.0, 1.0, (envs.action_size,), np.float32)
    low, high = envs.get(0, "state_bounds")
    if not envs.pixels:
        return gymnasium.spaces.Box(low, high, dtype=np.float32), action
    width, height = envs.options.size
    images = gymnasium.spaces.Box(0, 255, (3 * envs.options.stack, height, width), np.uint8)
    size = state_size(envs.options)
    if not size:
        return images, action
    state = gymnasium.spaces.Box(low[:size], high[:size], dtype=np.float32)
    return gymnasium.spaces.Dict({"pixels": images, "state": state}), action


def observations(envs: LocalVectorEnv | ProcessVectorEnv) -> NDArray | dict[str, NDArray]:
    """Observations of all environments, with the environment as the first axis of each array."""
    size = state_size(envs.options)
    if not size:
        return envs.observation()
    return {"pixels": envs.observation(), "state": np.stack([envs.state(i)[:size] for i in range(len(envs))])}


def of_one(observations: NDArray | dict[str, NDArray], i: int) -> NDArray | dict[str, NDArray]:
    """The observation of environment i."""
    if isinstance(observations, dict):
        return {name: values[i] for name, values in observations.items()}
    return observations[i]


def _info(envs: LocalVectorEnv | ProcessVectorEnv, i: int) -> dict[str, Any]:
    """Info of environment i; its `lighting` is the `sampled_lighting` of `LocalVectorEnv.info`, if there are images."""
    info = envs.info(i)
    return info | {"lighting": info.pop("sampled_lighting")} if "sampled_lighting" in info else info


def _check_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise InputError(f"render_mode = {short_repr(render_mode)}; expected None or 'rgb_array'")
    return render_mode


def _check_view(size: Any, view: str | None, pixels: bool) -> tuple[str, tuple[int, int] | None]:
    """Returns view and size of rendered pictures; no size if `render` returns the observation's own images."""
    if view is None:
        view = ROBOT if pixels else CHASE
    if view not in (ROBOT, CHASE):
        raise InputError(f"render_view = {short_repr(view)}; expected {ROBOT!r} or {CHASE!r}")
    if view == ROBOT and not pixels:
        raise InputError(
            f"render_view = {view!r} with pixels=False: no field is loaded; expected pixels=True, or {CHASE!r}"
        )
    if size is None:
        return view, _RENDER_SIZE if view == CHASE else None
    check_option("render_size", size, IMAGE_SIZE)
    return view, (int(size[0]), int(size[1]))


def check_reset_options(options: dict[str, Any] | None) -> None:
    """Raises InputError: there are options of `reset`; an environment gets its options when it is made."""
    if options:
        raise InputError(
            f"options of reset = {short_repr(options)}; expected none: give them to gymnasium.make or the constructor"
        )


class DriveEnv(gymnasium.Env):
    """A single environment."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012, as in Gymnasium

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str = "right_turn",
        render_mode: str | None = None,
        render_size: tuple[int, int] | None = None,
        render_view: str | None = None,
        **options: Any,
    ) -> None:
        """
        Args:
            scene: See `twin.load`.
            task: See `twin.load`.
            render_mode: None or rgb_array.
            render_size: Width and height of the pictures of `render` [px]; None: the size of the observed images, or
                640 × 360 for the chase view.
            render_view: `robot` shows the view of the robot's camera; `chase` shows MuJoCo's picture of the scene from
                behind the robot, with collision parts, as in the videos of `twin film`. None: `robot` with pixels,
                `chase` without.
            options: See `twin.env.options.Options`.
        """
        self.render_mode = _check_render_mode(render_mode)
        self._render_view, self._render_size = _check_view(render_size, render_view, parse_options(options).pixels)
        self._large: PixelObserver | None = None
        self._scene: SceneCamera | None = None
        self._chase: ChaseCamera | None = None
        self.vector_env = make_vector_env(scene, task, options, [None])
        self._started, self._over = False, False
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.vector_env.options.control_timestep)}
        self.observation_space, self.action_space = make_spaces(self.vector_env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        check_reset_options(options)
        super().reset(seed=seed)
        if seed is not None:
            self.vector_env.seed(0, seed)
        self.vector_env.begin([0])
        self._started, self._over = True, False
        if self._render_view == CHASE and self.render_mode:
            base = self._local.physics[0].base_to_world
            self._chase = ChaseCamera(base)
            self._chase_pose = self._chase.follow(base)
        return of_one(observations(self.vector_env), 0), _info(self.vector_env, 0)

    def step(self, action: NDArray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._over or not self._started:
            raise ResetNeeded("step before reset, or after the end of an episode; call reset() first")
        out = self.vector_env.step(check_actions(action, (self.vector_env.action_size,))[None])
        if self._chase:
            self._chase_pose = self._chase.follow(self._local.physics[0].base_to_world)
        end = bool(out.terminated[0]), bool(out.truncated[0])
        self._over = any(end)
        return of_one(observations(self.vector_env), 0), float(out.reward[0]), *end, _info(self.vector_env, 0)

    def render(self) -> NDArray | None:
        """A picture, uint8 (height, width, 3).

        By default, it is the newest image of the observation. With `render_size`, the same view
        is rendered at that size, with the episode's lighting, obstacles and weather, but without camera noise. The
        chase view shows the robot's present pose, even if the camera has a latency. Rendering has no effect on
        observations or random numbers.
        """
        if self.render_mode is None:
            return None
        if not self._started:
            raise ResetNeeded("render before reset; call reset() first")
        if self._render_size is None:
            assert self.vector_env.pixels
            return self.vector_env.pixels.stacks[0, -1].transpose(1, 2, 0).copy()
        envs = self._local
        physics = envs.physics[0]  # with physics on a GPU, this downloads the state
        if self._chase:
            with wp.ScopedDevice("cpu"):
                if self._scene is None:
                    self._scene = SceneCamera(envs.factory.world, self._render_size, envs.factory.obstacles.pool)
                self._scene.obstacles = envs.tasks[0].obstacles
                return self._scene.render(physics.data.qpos, self._chase_pose, physics.time())
        self._large = self._large or envs.make_view(self._render_size)
        self._large.observe([0])
        return self._large.stacks[0, -1].transpose(1, 2, 0).copy()

    @property
    def _local(self) -> LocalVectorEnv:
        assert isinstance(self.vector_env, LocalVectorEnv)  # true for a single environment
        return self.vector_env

    def close(self) -> None:
        self.vector_env.close()


class DriveVectorEnv(VectorEnv):
    """n environments. The step that ends an episode also resets its environment; `final_obs` and `final_info` contain
    the last observation and info of the ended episode."""

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
        if render_mode and not parse_options(options).pixels:
            raise InputError("render_mode: vector environments show their images, which pixels=False leaves out")
        self._started = False
        self.vector_env = make_vector_env(scene, task, options, [None] * num_envs, processes)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.vector_env.options.control_timestep)}
        self.single_observation_space, self.single_action_space = make_spaces(self.vector_env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets all environments; if `seed` is one number, environment i gets `seed` + i."""
        self._check_open()
        check_reset_options(options)
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        elif len(seeds := list(seed)) != self.num_envs:
            raise InputError(f"{len(seeds)} seeds; expected {self.num_envs}, one per environment, or one number")
        for i, one in enumerate(seeds):
            if one is not None:
                self.vector_env.seed(i, one)
        self.vector_env.begin(range(self.num_envs))
        self._started = True
        return observations(self.vector_env), self._infos(range(self.num_envs))

    def step(self, actions: NDArray) -> tuple[Any, NDArray, NDArray, NDArray, dict[str, Any]]:
        self._check_open()
        if not self._started:
            raise ResetNeeded("step before reset; call reset() first")
        out = self.vector_env.step(np.asarray(actions))
        over = np.flatnonzero(out.over).tolist()
        final: dict[str, Any] = {}
        if over:
            last = observations(self.vector_env)
            final = {"final_obs": np.full(self.num_envs, None, object), "_final_obs": out.over.copy()}
            for i in over:
                final["final_obs"][i] = of_one(last, i)
            final |= {"final_info": self._infos(over), "_final_info": out.over.copy()}
            self.vector_env.begin(over)
        infos = self._infos(range(self.num_envs)) | final
        return observations(self.vector_env), out.reward, out.terminated, out.truncated, infos

    def render(self) -> tuple[NDArray, ...] | None:
        """The newest image of each environment, uint8 (height, width, 3)."""
        if self.render_mode is None:
            return None
        if not self._started:
            raise ResetNeeded("render before reset; call reset() first")
        assert self.vector_env.pixels
        return tuple(stack[-1].transpose(1, 2, 0).copy() for stack in self.vector_env.pixels.stacks)

    def close_extras(self, **kwargs: Any) -> None:
        self.vector_env.close()

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the vector environment is closed; make a new one")

    def _infos(self, which: Sequence[int]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for i in which:
            infos = self._add_info(infos, _info(self.vector_env, i), i)
        return infos
