"""Which obstacles an episode has: those of `scene.toml`, given ones, or some drawn at random for it.

A compiled model cannot gain bodies, so for random obstacles it holds a *pool*: as many of every kind as there may be.
"""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from twin.config import ObstacleConfig
from twin.env.obstacles import STANDING, bystanders, moves, place, random_obstacles
from twin.env.stretches import Stretch
from twin.mjcf.world import World, point_at

_COLORS = 7  # seed of what bystanders are painted with
_STEP = 0.25  # [m] between points of a stretch's own route


class EpisodeObstacles:
    """The obstacles of a task's episodes."""

    def __init__(self, wanted: int | Sequence[ObstacleConfig], world: World, stretch: Stretch, beside: int = 0) -> None:
        """
        Args:
            wanted: How many to draw for every episode, or which there are in all of them.
            world: Has the route.
            stretch: Along which random ones stand.
            beside: How many stand beside the corridor, at most.
        """
        self._count = wanted if isinstance(wanted, int) else 0
        self._given = () if isinstance(wanted, int) else tuple(wanted)
        self._beside = beside
        s = np.append(np.arange(stretch.start, stretch.end, _STEP), stretch.end)
        self._along, self._start = replace(world, route=point_at(world.route, s)), stretch.start

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        """What the model must hold."""
        colors = np.random.default_rng(_COLORS).uniform(0.05, 0.9, (len(STANDING), self._beside, 3))
        drawn = [ObstacleConfig(f"{kind}_{k}", kind) for kind in STANDING for k in range(self._count)]
        drawn += [
            ObstacleConfig(f"beside_{kind}_{k}", kind, color=tuple(colors[j, k].tolist()))
            for j, kind in enumerate(STANDING)
            for k in range(self._beside)
        ]
        return (*self._given, *drawn)

    def draw(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        """Those of one episode, with so many beside the corridor."""
        out = self._named(random_obstacles(self._along, rng, self._count), "") if self._count else []
        out += self._named(bystanders(self._along, rng, beside), "beside_") if beside else []
        return (*self._given, *out)

    def _named(self, drawn: Sequence[ObstacleConfig], prefix: str) -> list[ObstacleConfig]:
        """By the names they have in the pool."""
        out: list[ObstacleConfig] = []
        for one in drawn:
            number = sum(other.kind == one.kind for other in out)
            out.append(replace(one, name=f"{prefix}{one.kind}_{number}", station=one.station + self._start))
        return out


class Surroundings:
    """Keeps an episode's obstacles in their places."""

    def __init__(self, obstacles: Sequence[ObstacleConfig], data: mujoco.MjData) -> None:
        self.obstacles, self._data = tuple(obstacles), data
        self._moving = moves(self.obstacles)

    def __call__(self, time: float) -> None:
        """Moves what moves to where it is at a time [s]; at 0 everything."""
        if self._moving or time == 0.0:
            place(self.obstacles, self._data, time)
