"""A recorded episode: actions, results, and the data for rendering it again."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import dm_env
import numpy as np

from twin.config import ObstacleConfig
from twin.env.drivers import Driver
from twin.env.task import control
from twin.types import Array


@dataclass(frozen=True)
class Episode:
    """A recorded episode of k instants, one per control step. At the first, the robot rests at its start."""

    times: Array
    """[s], shape (k,)."""
    base_to_world: Array
    """Shape (k, 4, 4)."""
    qpos: Array
    """MuJoCo's positions, shape (k, nq)."""
    actions: Array
    """Action at each instant, shape (k, actions), in the units of the action spec; the last row is zero."""
    rewards: Array
    """Reward of the step that ended at each instant, shape (k,); the first is zero."""
    speed: Array
    """[m/s], shape (k,)."""
    cross_track: Array
    """Signed distance from the route, positive to the left [m], shape (k,)."""
    progress: Array
    """Distance along the route segment [m], shape (k,)."""
    trust: Array
    """Trust of the image at each instant (see `twin.env.trust`), in [0, 1], shape (k,); nan without images."""
    cause: str
    """Cause of the end, one of `CAUSES`; empty if the episode was cut off."""
    touched: tuple[str, ...]
    """Names of the geoms touched in the last step."""
    task: str
    lighting: str
    """Name of the lighting; empty without images."""
    seed: int
    """Seed of this episode, as sampled by the task; of a drive recorded by `twin film`, the seed to repeat it with."""
    randomisation: dict[str, Any]
    obstacles: tuple[ObstacleConfig, ...]

    @property
    def success(self) -> bool:
        return self.cause == "goal"


def record_episode(
    environment: control.Environment,
    driver: Driver,
    on_step: Callable[[dm_env.TimeStep], None] | None = None,
    max_steps: int | None = None,
) -> Episode:
    """Drives and records one episode; it is cut off after `max_steps` control steps.

    `on_step` is called with every time step.
    """
    task, physics, pixels = environment.task, environment.physics, getattr(environment, "pixels", None)
    rows: list[dict[str, Any]] = []
    step, info, end = environment.reset(), {"trust": np.nan, "lighting": ""}, False
    while not end:
        if on_step:
            on_step(step)
        if pixels:
            info = pixels.info(0)
        end = step.last() or len(rows) == max_steps
        rows.append(
            {
                "times": physics.time(),
                "base_to_world": physics.base_to_world,
                "qpos": np.array(physics.data.qpos),
                "rewards": step.reward or 0.0,
                "speed": physics.speed,
                "cross_track": task.cross_track,
                "progress": task.progress,
                "trust": info["trust"],
            }
        )
        action = np.zeros(environment.action_spec().shape) if end else np.asarray(driver(environment, step), float)
        rows[-1]["actions"] = action
        if not end:
            step = environment.step(action)
    return Episode(
        **{name: np.array([row[name] for row in rows]) for name in rows[0]},
        cause=task.cause,
        touched=physics.touched,
        task=task.segment.name,
        lighting=str(info["lighting"]),
        seed=task.episode_seed,
        randomisation=task.sample.record(),
        obstacles=task.obstacles,
    )
