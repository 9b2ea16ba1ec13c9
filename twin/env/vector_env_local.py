"""Vector environment in one process: a thread pool runs the physics, and one call renders all images.

Each environment has its own model and sequence of episodes. It is stepped by the same code as an environment of
`twin.load`; on a CPU, the results of both are bit-identical. `mujoco.batch.Batch` is not used, since it cannot check
contacts or run a controller between substeps. `vector_env.py` is for several processes, `vector_env_gpu.py` for a GPU.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import dm_env
import numpy as np
from numpy.typing import NDArray

from twin.env.env_factory import EnvFactory
from twin.env.observation import PixelObserver
from twin.env.options import check_actions
from twin.env.task import DrivePhysics, DriveTask, control
from twin.runtime import available_cores
from twin.types import Array

T = TypeVar("T")


@dataclass(frozen=True)
class StepResult:
    """Result of a step of n environments, each array of shape (n,)."""

    reward: Array
    terminated: NDArray[np.bool_]
    """True where the episode ended by success or failure."""
    truncated: NDArray[np.bool_]
    """True where the episode ended at the time limit."""

    @property
    def over(self) -> NDArray[np.bool_]:
        return self.terminated | self.truncated


class LocalVectorEnv:
    """n environments of one scene and task."""

    def __init__(self, factory: EnvFactory, seeds: Sequence[int | None]) -> None:
        """`seeds`: seed of each environment's sequence of episodes; None: unpredictable."""
        envs = self._make_envs(factory, seeds)
        self.factory = factory
        self._physics, self.tasks = [p for p, _ in envs], [t for _, t in envs]
        self.pixels = factory.make_observer(envs)
        self.options = factory.options
        step = factory.options.control_timestep
        self._environments = [control.Environment(p, t, control_timestep=step) for p, t in envs]
        threads = min(available_cores(), len(envs))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        spec = self._environments[0].action_spec()
        self._low, self._high = spec.minimum, spec.maximum
        self._states = np.zeros((len(envs), self.state_size), np.float32)

    def _make_envs(self, factory: EnvFactory, seeds: Sequence[int | None]) -> list[tuple[DrivePhysics, DriveTask]]:
        return [factory.make_env(seed) for seed in seeds]

    @property
    def physics(self) -> list[DrivePhysics]:
        """Present physics of every environment."""
        return self._physics

    def __len__(self) -> int:
        return len(self._environments)

    @property
    def action_size(self) -> int:
        """Number of components of an action."""
        return len(self._low)

    @property
    def state_size(self) -> int:
        """Number of components of the privileged state."""
        return sum(int(np.prod(spec.shape)) for spec in self._environments[0].observation_spec().values())

    def seed(self, i: int, seed: int | None) -> None:
        """Starts a new sequence of episodes in environment i, from its next episode on."""
        self.tasks[i].seed(seed)

    def begin(self, which: Sequence[int]) -> None:
        """Starts new episodes in some environments."""
        for i, step in zip(which, self._each(lambda i: self._environments[i].reset(), which), strict=True):
            self._states[i] = _flat_observation(step)
        if self.pixels:
            self.pixels.begin(which)

    def step(self, actions: NDArray, which: Sequence[int] | None = None) -> StepResult:
        """Runs one control step of environments whose episodes are not over.

        Args:
            actions: Actions in [-1, 1], scaled to the range of `action_spec`; shape (k, action_size).
            which: Indices of k environments; None: all. The result is in this order.

        Raises:
            ValueError: invalid actions; the episodes are unchanged.
        """
        which = range(len(self)) if which is None else which
        # Scaled in float64, as in `PolicyDriver`, so that both give the robot the same actions.
        given = check_actions(actions, (len(which), self.action_size))
        wanted = self._low + (np.clip(given, -1.0, 1.0) + 1.0) / 2.0 * (self._high - self._low)
        out = self._advance(wanted, which)
        if self.pixels:
            self.pixels.observe(which)
        return out

    def _advance(self, wanted: Array, which: Sequence[int]) -> StepResult:
        """Steps environments without rendering; actions are in the units of `action_spec`."""
        steps = self._each(lambda k: self._environments[which[k]].step(wanted[k]), range(len(which)))
        for i, step in zip(which, steps, strict=True):
            self._states[i] = _flat_observation(step)
        last = np.array([step.last() for step in steps])
        goes_on = np.array([step.discount for step in steps]) > 0.0
        return StepResult(np.array([step.reward for step in steps]), last & ~goes_on, last & goes_on)

    def observation(self) -> NDArray:
        """Images, uint8 (n, 3 · stack, height, width), the newest last; without images the states, float32 (n, k)."""
        return frame_stack(self.pixels.stacks) if self.pixels else self._states.copy()

    def state(self, i: int) -> NDArray[np.float32]:
        """Present privileged state of environment i, see `DriveTask.get_observation`; shape (k,).

        If the camera has a latency, this state is newer than the newest image.
        """
        return self._states[i].copy()

    def info(self, i: int) -> dict[str, Any]:
        """Info of environment i's episode so far, JSON-able.

        With images, `lighting` is the name that tables use, such as `training`. `sampled_lighting` also contains the
        sampled mixture: `training: sun 0.62, night 0.38`, see `EpisodeLighting.mixture`.
        """
        return self.tasks[i].info(self._physics[i]) | self._pixel_info(i)

    def _pixel_info(self, i: int) -> dict[str, Any]:
        if not self.pixels:
            return {}
        info = self.pixels.info(i)
        return info | {"sampled_lighting": info["lighting"] + self.pixels.lightings[i].mixture}

    def make_view(self, size: tuple[int, int]) -> PixelObserver:
        """Returns an observer that renders current episodes at another size (width, height), without camera noise.

        Its stacks have one image. It needs `pixels`, and changes neither observations nor random numbers.
        """
        options = dataclasses.replace(self.options, size=size, stack=1, camera=None)
        factory = dataclasses.replace(self.factory, options=options)
        view = factory.make_observer(list(zip(self._physics, self.tasks, strict=True)))
        assert view and self.pixels
        view.lightings, view._weather = self.pixels.lightings, self.pixels._weather
        return view

    def get(self, i: int, name: str) -> Any:
        """Returns an attribute of environment i's task."""
        return getattr(self.tasks[i], name)

    def set(self, i: int, name: str, value: Any) -> None:
        """Sets an attribute of environment i's task."""
        setattr(self.tasks[i], name, value)

    def call(self, i: int, name: str, *args: Any, **kwargs: Any) -> Any:
        """Calls a method of environment i's task."""
        return getattr(self.tasks[i], name)(*args, **kwargs)

    def close(self) -> None:
        if self._pool:
            self._pool.shutdown()

    def _each(self, function: Callable[[int], T], which: Iterable[int]) -> list[T]:
        return list(self._pool.map(function, which)) if self._pool else [function(i) for i in which]


def frame_stack(stacks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reshapes stacks (n, stack, 3, height, width) to a copy of shape (n, 3 · stack, height, width)."""
    return stacks.reshape(len(stacks), -1, *stacks.shape[3:]).copy()


def _flat_observation(step: dm_env.TimeStep) -> NDArray[np.float32]:
    return np.concatenate(list(step.observation.values()))
