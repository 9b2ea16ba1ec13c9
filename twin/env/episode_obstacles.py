"""Which obstacles an episode has: those of `scene.toml`, given ones, or some drawn at random for it.

A compiled model cannot gain bodies, so for random obstacles it holds a *pool*: as many of every kind as there may be.
"""

from collections.abc import Callable, Sequence
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
        self._colors = np.random.default_rng(_COLORS).uniform(0.05, 0.9, (len(STANDING), beside, 3))
        s = np.append(np.arange(stretch.start, stretch.end, _STEP), stretch.end)
        self._along, self._start = replace(world, route=point_at(world.route, s)), stretch.start

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        """What the model must hold."""
        standing = [_standing(kind, k) for kind in STANDING for k in range(self._count)]
        return (*self._given, *standing, *(self._bystander(kind, k) for kind in STANDING for k in range(self._beside)))

    def draw(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        """Those of one episode, with so many beside the corridor."""
        standing = random_obstacles(self._along, rng, self._count) if self._count else ()
        return (
            *self._given,
            *self._placed(standing, _standing),
            *self._placed(bystanders(self._along, rng, beside), self._bystander),
        )

    def _placed(
        self, drawn: Sequence[ObstacleConfig], of_pool: Callable[[str, int], ObstacleConfig]
    ) -> list[ObstacleConfig]:
        """Those of the pool where others were drawn."""
        out: list[ObstacleConfig] = []
        for one in drawn:
            mine = of_pool(one.kind, sum(other.kind == one.kind for other in out))
            out.append(replace(mine, station=one.station + self._start, lateral=one.lateral, yaw=one.yaw))
        return out

    def _bystander(self, kind: str, number: int) -> ObstacleConfig:
        color = self._colors[STANDING.index(kind), number]
        return ObstacleConfig(f"beside_{kind}_{number}", kind, color=tuple(color.tolist()))


def _standing(kind: str, number: int) -> ObstacleConfig:
    return ObstacleConfig(f"{kind}_{number}", kind)


class Surroundings:
    """Keeps an episode's obstacles in their places."""

    def __init__(self, obstacles: Sequence[ObstacleConfig], data: mujoco.MjData) -> None:
        self.obstacles, self._data = tuple(obstacles), data
        self.moving = moves(self.obstacles)
        """Whether any of them does."""

    def __call__(self, time: float) -> None:
        """Moves what moves to where it is at a time [s]; at 0 everything."""
        if self.moving or time == 0.0:
            place(self.obstacles, self._data, time)
