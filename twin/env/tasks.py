"""A drive along a stretch of a route as a dm_control task. It knows poses and contacts, and nothing of pictures.

An *episode* starts at rest near the stretch's beginning and ends with a *cause*: `goal` (the robot's bumper crosses the
end of the stretch), `collision`, `out_of_bounds` (the base left the corridor), `timeout`, `rollover` or `stuck`. Its
*discount* at the end is 0, but 1 at a time limit, beyond which life would have gone on.

An episode's *seed* decides all its randomness. Start, robot and light are drawn from generators of their own, so that
changing one of them leaves the others as they were, and two policies can be compared on the same episodes.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from twin.config import ObstacleConfig
from twin.env.dm import control
from twin.env.dm_physics import DrivePhysics
from twin.env.episode_obstacles import EpisodeObstacles, Surroundings
from twin.env.judge import CAUSES, STATE, Judge, Motion
from twin.env.options import STEERING, Options
from twin.env.randomisation import Draw, Nominal
from twin.env.stretches import Stretch
from twin.errors import InputError, shown
from twin.mjcf.world import World, heading_at, point_at

Array = NDArray[np.float64]

START, ROBOT, LIGHT, OBSTACLES, CAMERA, WEATHER = range(6)
"""Streams of an episode's randomness: `numpy.random.default_rng([seed, stream])`."""

_START_TRIES = 50


def checked_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """Actions as float64.

    Raises:
        ValueError: of another shape, no real numbers (booleans are none), or not finite.
    """
    try:
        given = np.asarray(actions)
    except (TypeError, ValueError):  # ragged lists
        given = np.empty(0, object)
    if given.dtype.kind not in "iuf" or given.shape != shape or not np.isfinite(given).all():
        kind = f"{given.dtype} of shape {given.shape}"
        raise ValueError(f"action {shown(actions)} ({kind}); expected finite numbers of shape {shape}")
    return given.astype(np.float64, copy=False)


class Drive(control.Task):
    """Drives a stretch."""

    def __init__(
        self,
        world: World,
        stretch: Stretch,
        options: Options,
        obstacles: EpisodeObstacles,
        model: mujoco.MjModel,
        seed: int | None = None,
        judge: tuple[Judge, int] | None = None,
    ) -> None:
        """
        Args:
            world: Route and corridor.
            stretch: What is driven.
            options: How.
            obstacles: What stands or moves in the way; the model holds its pool.
            model: As compiled; the one that is driven in may be a copy.
            seed: Of the sequence of episodes; None: unpredictable.
            judge: Of many drives, and which of them this is; by default one of its own.
        """
        self.world, self.stretch, self.options = world, stretch, options
        self._judge, self._number = judge or (Judge(world, stretch, options), 0)
        self.half_width, self.time_limit = self._judge.half_width, self._judge.time_limit
        self._obstacles = obstacles
        self._nominal = Nominal(model) if options.randomise else None
        self.seed(seed)
        self.episode_seed = 0
        """Of the episode under way."""
        self.draw = Draw()
        """Of the episode under way: its robot and its weather."""
        self._record = self.draw.record()
        self.obstacles: tuple[ObstacleConfig, ...] = ()
        """Of the episode under way."""
        self._began = stretch.start

    def seed(self, seed: int | None) -> None:
        """Starts another sequence of episodes."""
        self._rng = np.random.default_rng(seed)

    def weathered(self, draw: Draw) -> None:
        """Takes another draw for that of the episode under way, which differs from it in the weather alone."""
        self.draw, self._record = draw, draw.record()

    def rng(self, stream: int) -> np.random.Generator:
        """A generator of the episode under way."""
        return np.random.default_rng([self.episode_seed, stream])

    # ---- what dm_control calls

    def initialize_episode(self, physics: DrivePhysics) -> None:
        self.episode_seed = int(self._rng.integers(2**63))
        self.draw = self.options.randomise.draw(self.rng(ROBOT)) if self.options.randomise else Draw()
        self._record = self.draw.record()
        if self._nominal:
            self._nominal.apply(self.draw, physics.model.ptr)
        params = self.world.robot
        physics.set_robot(replace(params, command_latency=params.command_latency + self.draw.latency))
        self.obstacles = self._obstacles.draw(self.rng(OBSTACLES), self.draw.bystanders)
        physics.robot.surroundings = Surroundings(self.obstacles, physics.data.ptr)
        rng = self.rng(START)
        for _ in range(_START_TRIES):
            physics.robot.place(*self._start(rng))
            if not physics.touched:
                break
        else:
            raise InputError(
                f"task {self.stretch.name!r}: the robot touches {', '.join(physics.touched)} wherever it starts; "
                "move the obstacle or the start"
            )
        self._judge.begin(self._me, np.array([self._began]), physics.planar_pose[None, :2])

    def before_step(self, action: Any, physics: DrivePhysics) -> None:
        """Raises ValueError: no action; the episode is as it was."""
        width = 1 if self.options.action == STEERING else 2
        commands = self.commands(checked_actions(action, (width,))[None])
        self._judge.act(self._me, commands[:, 1])
        physics.robot.command(*commands[0].tolist())

    def after_step(self, physics: DrivePhysics) -> None:
        self._judge.judge(self._me, _motion(physics))

    def get_reward(self, physics: DrivePhysics) -> float:
        return float(self._judge.reward(self._me)[0])

    def get_termination(self, physics: DrivePhysics) -> float | None:
        failed_or_arrived, timeout = self._judge.ended(self._me)
        return 0.0 if failed_or_arrived[0] else 1.0 if timeout[0] else None

    def get_observation(self, physics: DrivePhysics) -> "OrderedDict[str, Array]":
        """What a driver that knows the map would know, see `Judge.state`."""
        state = self._judge.state(self._me, _motion(physics))[0]
        ends = np.cumsum(list(STATE.values()))
        return OrderedDict(zip(STATE, np.split(state, ends[:-1]), strict=True))

    def observation_spec(self, physics: DrivePhysics) -> "OrderedDict[str, specs.Array]":
        return OrderedDict((name, specs.Array((n,), np.float32, name)) for name, n in STATE.items())

    def action_spec(self, physics: DrivePhysics) -> specs.BoundedArray:
        low, high = self._bounds()
        return specs.BoundedArray(low.shape, np.float64, low, high, name="\t".join(self.action_names))

    # ---- what else may be asked

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("yaw_rate",) if self.options.action == STEERING else ("speed", "yaw_rate")

    @property
    def cause(self) -> str:
        """Why the episode ended; empty while it goes on."""
        return CAUSES[self._judge.cause[self._number]]

    @property
    def cross_track(self) -> float:
        """Distance from the route [m], left positive."""
        return float(self._judge.cross_track[self._number])

    @property
    def progress(self) -> float:
        """Way along the stretch [m]; may be slightly negative."""
        return float(self._judge.foot[self._number]) - self.stretch.start

    def commands(self, actions: Array) -> Array:
        """What actions, shape (k, 1 or 2), ask of the robot: v [m/s] and ω [rad/s], shape (k, 2)."""
        actions = np.clip(actions, *self._bounds())
        if self.options.action == STEERING:
            return np.column_stack([np.full(len(actions), self.options.speed), actions])
        return actions

    def info(self, physics: DrivePhysics) -> dict[str, Any]:
        """The episode so far, JSON-able."""
        return self.told(physics.speed, physics.touched)

    def told(self, speed: float, touched: Sequence[str]) -> dict[str, Any]:
        """The same, where the robot's speed [m/s] and what it touched are known."""
        return {
            "cause": self.cause,
            "is_success": self.cause == "goal",
            "start": self._began - self.stretch.start,
            "progress": self.progress,
            "cross_track": self.cross_track,
            "speed": speed,
            "touched": list(touched),
            "episode_seed": self.episode_seed,
            "randomisation": self._record.copy(),
        }

    def _bounds(self) -> tuple[Array, Array]:
        o = self.options
        if o.action == STEERING:
            return np.array([-o.yaw_rate]), np.array([o.yaw_rate])
        return np.array([0.0, -o.yaw_rate]), np.array([o.speed, o.yaw_rate])

    def _start(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """x, y [m] and yaw [rad]."""
        o = self.options
        offset = rng.uniform(-o.start_offset, o.start_offset)
        turn = np.deg2rad(rng.uniform(-o.start_heading, o.start_heading))
        on_the_way = max(0.0, rng.uniform(-1.0, 1.0)) if o.start_along else 0.0
        s = self._began = self.stretch.start + on_the_way * o.start_along * self.stretch.length
        heading = float(heading_at(self.world.route[:, :2], s))
        x, y = point_at(self.world.route[:, :2], s) + offset * np.array([-np.sin(heading), np.cos(heading)])
        return float(x), float(y), heading + float(turn)

    @property
    def _me(self) -> list[int]:
        return [self._number]


def _motion(physics: DrivePhysics) -> Motion:
    """Of one robot."""
    values = physics.speed, physics.yaw_rate, physics.uprightness, bool(physics.touched), physics.time()
    return Motion(physics.planar_pose[None], *(np.array([value]) for value in values))
