"""A drive along a stretch of a route as a dm_control task. It knows poses and contacts, and nothing of pictures.

An *episode* starts at rest near the stretch's beginning and ends with a *cause*: `goal` (the robot's bumper crosses the
end of the stretch), `collision`, `out_of_bounds` (the base left the corridor), `timeout`, `rollover` or `stuck`. Its
*discount* at the end is 0, but 1 at a time limit, beyond which life would have gone on.

An episode's *seed* decides all its randomness. Start, robot and light are drawn from generators of their own, so that
changing one of them leaves the others as they were, and two policies can be compared on the same episodes.
"""

from collections import OrderedDict
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
from twin.env.options import STEERING, Options
from twin.env.randomisation import Draw, Nominal
from twin.env.stretches import Stretch
from twin.errors import InputError
from twin.mjcf.world import World, heading_at, heading_error, nearest, point_at

Array = NDArray[np.float64]

START, ROBOT, LIGHT, OBSTACLES, CAMERA, WEATHER = range(6)
"""Streams of an episode's randomness: `numpy.random.default_rng([seed, stream])`."""

_BUMPER = 0.5  # [m] ahead of the base
_SEARCH = (1.0, 3.0)  # [m] behind and ahead of the last foot point
_ROLLED = 0.5  # cosine of the tilt beyond which the robot has rolled over
_STUCK_TIME, _STUCK_DISTANCE = 5.0, 0.1  # [s], [m]: less way than this in that time
_START_TRIES = 50
_AHEAD = (1.0, 2.0, 4.0)  # [m] along the route, of which the state tells the curvature


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
    ) -> None:
        """
        Args:
            world: Route and corridor.
            stretch: What is driven.
            options: How.
            obstacles: What stands or moves in the way; the model holds its pool.
            model: As compiled; the one that is driven in may be a copy.
            seed: Of the sequence of episodes; None: unpredictable.
        """
        self.world, self.stretch, self.options = world, stretch, options
        self.half_width = options.half_width or world.half_width
        self.time_limit = options.time_limit or 2.0 * stretch.length / options.speed
        self._route, self._obstacles = world.route[:, :2], obstacles
        self._nominal = Nominal(model) if options.randomise else None
        self.seed(seed)
        self.episode_seed = 0
        """Of the episode under way."""
        self.draw = Draw()
        """The robot of the episode under way."""
        self.obstacles: tuple[ObstacleConfig, ...] = ()
        """Of the episode under way."""
        self.cause = ""
        """Why the episode ended; empty while it goes on."""
        self._began = stretch.start

    def seed(self, seed: int | None) -> None:
        """Starts another sequence of episodes."""
        self._rng = np.random.default_rng(seed)

    def rng(self, stream: int) -> np.random.Generator:
        """A generator of the episode under way."""
        return np.random.default_rng([self.episode_seed, stream])

    # ---- what dm_control calls

    def initialize_episode(self, physics: DrivePhysics) -> None:
        self.episode_seed = int(self._rng.integers(2**63))
        self.draw = self.options.randomise.draw(self.rng(ROBOT)) if self.options.randomise else Draw()
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
        self.cause, self._stood, self._steering = "", 0.0, 0.0
        foot, self.cross_track = nearest(self._route, physics.planar_pose[:2], self._around(self._began))
        self._foot = self._before = float(foot)
        self._last_moved = physics.planar_pose[:2]

    def before_step(self, action: Any, physics: DrivePhysics) -> None:
        action = np.clip(np.asarray(action, float), *self._bounds())
        self._steering = float(action[-1]) / self.options.yaw_rate
        if self.options.action == STEERING:
            physics.robot.command(self.options.speed, float(action[0]))
        else:
            physics.robot.command(float(action[0]), float(action[1]))

    def after_step(self, physics: DrivePhysics) -> None:
        position = physics.planar_pose[:2]
        foot, self.cross_track = nearest(self._route, position, self._around(self._foot))
        self._before, self._foot = self._foot, float(foot)
        if np.linalg.norm(position - self._last_moved) > _STUCK_DISTANCE:
            self._last_moved, self._stood = position, physics.time()
        self.cause = self._cause(physics)

    def get_reward(self, physics: DrivePhysics) -> float:
        terms = self.options.rewards
        reward = getattr(terms, self.cause) if self.cause else 0.0
        if self.cause in ("", "goal"):
            reward += terms.step
        off = min(1.0, abs(float(self.cross_track)) / self.half_width)
        reward += terms.progress * (self._foot - self._before) + terms.cross_track * off
        return float(reward + terms.steering * self._steering**2)

    def get_termination(self, physics: DrivePhysics) -> float | None:
        if not self.cause:
            return None
        return 1.0 if self.cause == "timeout" else 0.0

    def get_observation(self, physics: DrivePhysics) -> "OrderedDict[str, Array]":
        """What a driver that knows the map would know.

        `speed` [m/s], `yaw_rate` [rad/s], `cross_track` [m] left positive, `heading_error` [rad] of the robot against
        the route, `turns` [rad]: how far the route's heading has turned 1, 2 and 4 m ahead, shape (3,).
        """
        pose = physics.planar_pose
        heading = heading_at(self._route, self._foot)
        ahead = heading_at(self._route, self._foot + np.array(_AHEAD))
        return OrderedDict(
            speed=np.array([physics.speed], np.float32),
            yaw_rate=np.array([physics.yaw_rate], np.float32),
            cross_track=np.array([self.cross_track], np.float32),
            heading_error=np.array([heading_error(pose[2], heading)], np.float32),
            turns=heading_error(ahead, heading).astype(np.float32),
        )

    def observation_spec(self, physics: DrivePhysics) -> "OrderedDict[str, specs.Array]":
        shapes = {"speed": 1, "yaw_rate": 1, "cross_track": 1, "heading_error": 1, "turns": len(_AHEAD)}
        return OrderedDict((name, specs.Array((n,), np.float32, name)) for name, n in shapes.items())

    def action_spec(self, physics: DrivePhysics) -> specs.BoundedArray:
        low, high = self._bounds()
        return specs.BoundedArray(low.shape, np.float64, low, high, name="\t".join(self.action_names))

    # ---- what else may be asked

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("yaw_rate",) if self.options.action == STEERING else ("speed", "yaw_rate")

    @property
    def progress(self) -> float:
        """Way along the stretch [m]; may be slightly negative."""
        return self._foot - self.stretch.start

    def info(self, physics: DrivePhysics) -> dict[str, Any]:
        """The episode so far, JSON-able."""
        return {
            "cause": self.cause,
            "is_success": self.cause == "goal",
            "start": self._began - self.stretch.start,
            "progress": self.progress,
            "cross_track": float(self.cross_track),
            "speed": physics.speed,
            "touched": list(physics.touched),
            "episode_seed": self.episode_seed,
            "randomisation": self.draw.record(),
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
        heading = float(heading_at(self._route, s))
        x, y = point_at(self._route, s) + offset * np.array([-np.sin(heading), np.cos(heading)])
        return float(x), float(y), heading + float(turn)

    def _around(self, s: float) -> tuple[float, float]:
        return s - _SEARCH[0], s + _SEARCH[1]

    def _cause(self, physics: DrivePhysics) -> str:
        if physics.uprightness < _ROLLED:
            return "rollover"
        if physics.touched:
            return "collision"
        if abs(float(self.cross_track)) > self.half_width:
            return "out_of_bounds"
        if self._foot >= self.stretch.end - _BUMPER:
            return "goal"
        if physics.time() > self.time_limit - 1e-6:
            return "timeout"
        return "stuck" if physics.time() - self._stood >= _STUCK_TIME else ""
