"""A recorded episode: what was done, what became of it, and everything needed to see it again."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from twin.config import ObstacleConfig
from twin.config_file import parse
from twin.env.drivers import Driver
from twin.env.options import control
from twin.files import read_json, write_json
from twin.types import Array

_ARRAYS = ("times", "base_to_world", "qpos", "actions", "rewards", "speed", "cross_track", "progress", "trust")


@dataclass(frozen=True)
class Episode:
    """k instants, one per control step, the first at rest at the start."""

    times: Array
    """[s], shape (k,)."""
    base_to_world: Array
    """Shape (k, 4, 4)."""
    qpos: Array
    """MuJoCo's positions, shape (k, nq)."""
    actions: Array
    """Taken at each instant, in the units of the action spec; the last row is zero. Shape (k, actions)."""
    rewards: Array
    """For having come to each instant; the first is zero. Shape (k,)."""
    speed: Array
    """[m/s], shape (k,)."""
    cross_track: Array
    """Left positive [m], shape (k,)."""
    progress: Array
    """[m], shape (k,)."""
    trust: Array
    """Of the picture at each instant, in [0, 1]; nan without pictures. Shape (k,)."""
    cause: str
    """Why it ended; empty if it was cut off."""
    touched: tuple[str, ...]
    """What the robot touched at its end."""
    task: str
    lighting: str
    """Empty without pictures."""
    seed: int
    """Of the episode."""
    randomisation: dict[str, Any]
    obstacles: tuple[ObstacleConfig, ...]

    @property
    def success(self) -> bool:
        return self.cause == "goal"

    def save(self, folder: Path) -> None:
        """Writes `episode.npz` and `episode.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(folder / "episode.npz", **{name: getattr(self, name) for name in _ARRAYS})
        head = {k: v for k, v in asdict(self).items() if k not in _ARRAYS}
        write_json(folder / "episode.json", head)

    @staticmethod
    def load(folder: Path) -> "Episode":
        head = read_json(folder / "episode.json")
        head["touched"] = tuple(head["touched"])
        head["obstacles"] = tuple(parse(ObstacleConfig, one, str(folder / "episode.json")) for one in head["obstacles"])
        with np.load(folder / "episode.npz", allow_pickle=False) as data:
            return Episode(**{name: data[name] for name in _ARRAYS}, **head)


def record(
    environment: control.Environment,
    driver: Driver,
    watch: Callable[[dm_env.TimeStep], None] | None = None,
    most: int | None = None,
) -> Episode:
    """Drives one episode.

    Args:
        environment: See `twin.load`.
        driver: Who drives.
        watch: Is shown every time step.
        most: Control steps after which it is cut off.
    """
    task, physics, pixels = environment.task, environment.physics, getattr(environment, "pixels", None)
    rows: list[tuple] = []
    actions: list[Array] = []
    step, info = environment.reset(), {"trust": np.nan, "lighting": ""}
    while True:
        if watch:
            watch(step)
        if pixels:
            info = pixels.info(0)
        position = np.array(physics.data.qpos)
        rows.append(
            (
                *(physics.time(), physics.base_to_world, position, step.reward or 0.0, physics.speed),
                *(task.cross_track, task.progress, info["trust"]),
            )
        )
        if step.last() or len(actions) == most:
            break
        actions.append(np.asarray(driver(environment, step), float))
        step = environment.step(actions[-1])
    times, bases, qpos, rewards, speed, cross_track, progress, trust = (np.array(c) for c in zip(*rows, strict=True))
    return Episode(
        times=times,
        base_to_world=bases,
        qpos=qpos,
        actions=np.array([*actions, np.zeros(environment.action_spec().shape)]),
        rewards=rewards,
        speed=speed,
        cross_track=cross_track,
        progress=progress,
        trust=trust,
        cause=task.cause,
        touched=physics.touched,
        task=task.stretch.name,
        lighting=str(info["lighting"]),
        seed=task.episode_seed,
        randomisation=task.draw.record(),
        obstacles=task.obstacles,
    )
