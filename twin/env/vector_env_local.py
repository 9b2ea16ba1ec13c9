"""Many worlds at once: physics on a thread pool, pictures of all of them in one call of the renderer.

A *world* is one robot in a model of its own, with its own sequence of episodes. Nothing here decides what happens in an
episode: every world is the dm_control environment that `twin.load` gives, stepped by the same code, so one of many goes
through exactly what it would alone, on a CPU.

`mujoco.batch.Batch` would step faster by what Python does between the looks at the contacts; it has no contacts to look
at and no controller between small steps, so the worlds are stepped from threads, outside the interpreter's lock, and
in several processes, see `vector_env_processes.py`. On a GPU `mujoco_warp` steps them all at once, and all are judged at
once, see `vector_env_gpu.py`.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import dm_env
import numpy as np
from numpy.typing import NDArray

from twin.env.options import control
from twin.env.physics import DrivePhysics
from twin.env.suite import EnvFactory
from twin.env.task import DriveTask, checked_actions
from twin.runtime import cores
from twin.types import Array

T = TypeVar("T")


@dataclass(frozen=True)
class StepResult:
    """What a step of n worlds led to; each shape (n,)."""

    reward: Array
    terminated: NDArray[np.bool_]
    """The episode is over, and failed or arrived."""
    truncated: NDArray[np.bool_]
    """The episode is over, and would have gone on but for the time limit."""

    @property
    def over(self) -> NDArray[np.bool_]:
        return self.terminated | self.truncated


class LocalVectorEnv:
    """n worlds of one scene and task."""

    def __init__(self, stage: EnvFactory, seeds: Sequence[int | None]) -> None:
        """
        Args:
            stage: Scene, task and options.
            seeds: One per world, of its sequence of episodes; None: unpredictable.
        """
        parts = self._parts(stage, seeds)
        self._physics, self.tasks = [p for p, _ in parts], [t for _, t in parts]
        self.pixels = stage.pixels(parts)
        self.options = stage.options
        step = stage.options.control_timestep
        self._environments = [control.Environment(p, t, control_timestep=step) for p, t in parts]
        threads = min(cores(), len(parts))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        spec = self._environments[0].action_spec()
        self._low, self._high = spec.minimum, spec.maximum
        self._states = np.zeros((len(parts), self.states), np.float32)

    def _parts(self, stage: EnvFactory, seeds: Sequence[int | None]) -> list[tuple[DrivePhysics, DriveTask]]:
        return [stage.drive(seed) for seed in seeds]

    @property
    def physics(self) -> list[DrivePhysics]:
        """Of every world, as it is now."""
        return self._physics

    def __len__(self) -> int:
        return len(self._environments)

    @property
    def actions(self) -> int:
        """Numbers in an action."""
        return len(self._low)

    @property
    def states(self) -> int:
        """Numbers in a driver's state."""
        return sum(int(np.prod(spec.shape)) for spec in self._environments[0].observation_spec().values())

    def seed(self, i: int, seed: int | None) -> None:
        """Starts another sequence of episodes in world i, from its next episode on."""
        self.tasks[i].seed(seed)

    def begin(self, which: Sequence[int]) -> None:
        """Starts new episodes in some worlds."""
        for i, step in zip(which, self._each(lambda i: self._environments[i].reset(), which), strict=True):
            self._states[i] = _state(step)
        if self.pixels:
            self.pixels.begin(which)

    def step(self, actions: NDArray, which: Sequence[int] | None = None) -> StepResult:
        """One control step of worlds, none of which may be at its episode's end.

        Args:
            actions: Of each, every number in [-1, 1], which spans what `action_spec` allows; shape (k, actions).
            which: Of which worlds; all unless given. The outcome has their order.

        Raises:
            ValueError: no such actions; the episodes are as they were.
        """
        which = range(len(self)) if which is None else which
        # In float64, as a driver of one environment does it.
        given = checked_actions(actions, (len(which), self.actions))
        wanted = self._low + (np.clip(given, -1.0, 1.0) + 1.0) / 2.0 * (self._high - self._low)
        out = self._advance(wanted, which)
        if self.pixels:
            self.pixels.look(which)
        return out

    def _advance(self, wanted: Array, which: Sequence[int]) -> StepResult:
        """The same with actions in metres and radians, and but for the pictures."""
        steps = self._each(lambda k: self._environments[which[k]].step(wanted[k]), range(len(which)))
        for i, step in zip(which, steps, strict=True):
            self._states[i] = _state(step)
        last = np.array([step.last() for step in steps])
        goes_on = np.array([step.discount for step in steps]) > 0.0
        return StepResult(np.array([step.reward for step in steps]), last & ~goes_on, last & goes_on)

    def observation(self) -> NDArray:
        """Pictures uint8 (n, 3 · stack, height, width), the newest last; or the states, float32 (n, k)."""
        return frame_stack(self.pixels.stacks) if self.pixels else self._states.copy()

    def state(self, i: int) -> NDArray[np.float32]:
        """What a driver of world i that knows the map would know, see `Drive.get_observation`; shape (k,).

        It is of now, which the newest picture is not where the camera has a latency.
        """
        return self._states[i].copy()

    def info(self, i: int) -> dict[str, Any]:
        """Of world i's episode so far, JSON-able."""
        return self.tasks[i].info(self._physics[i]) | (self.pixels.info(i) if self.pixels else {})

    def get(self, i: int, name: str) -> Any:
        """An attribute of world i's task."""
        return getattr(self.tasks[i], name)

    def set(self, i: int, name: str, value: Any) -> None:
        """Sets one."""
        setattr(self.tasks[i], name, value)

    def call(self, i: int, name: str, *args: Any, **kwargs: Any) -> Any:
        """Calls a method of world i's task."""
        return getattr(self.tasks[i], name)(*args, **kwargs)

    def close(self) -> None:
        if self._pool:
            self._pool.shutdown()

    def _each(self, function: Callable[[int], T], which: Iterable[int]) -> list[T]:
        return list(self._pool.map(function, which)) if self._pool else [function(i) for i in which]


def frame_stack(stacks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pictures of n worlds as networks take them, see `Worlds.observation`, of stacks (n, stack, 3, height, width)."""
    return stacks.reshape(len(stacks), -1, *stacks.shape[3:]).copy()


def _state(step: dm_env.TimeStep) -> NDArray[np.float32]:
    return np.concatenate(list(step.observation.values()))
