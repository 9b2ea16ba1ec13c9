"""A drive along a stretch of a route as a dm_control task. It knows poses and contacts, and nothing of pictures.

An *episode* starts at rest near the stretch's beginning and ends with a *cause*: `goal` (the robot's bumper crosses the
end of the stretch), `collision`, `out_of_bounds` (the base left the corridor), `timeout`, `rollover` or `stuck`. Its
*discount* at the end is 0, but 1 at a time limit, beyond which life would have gone on.

An episode's *seed* decides all its randomness. Start, robot and light are drawn from generators of their own, so that
changing one of them leaves the others as they were, and two policies can be compared on the same episodes.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from twin.config import ObstacleConfig
from twin.env.domain_randomization import Nominal, RandomizationSample
from twin.env.obstacles import EpisodeObstacles, Surroundings
from twin.env.options import STEERING, Options, control
from twin.env.physics import DrivePhysics
from twin.env.route_segments import RouteSegment
from twin.errors import InputError, shown
from twin.mjcf.world import World, heading_at, heading_error, nearest, point_at
from twin.types import Array

# ---- What becomes of drives along a stretch of a route: where each is, why it ends, what a step of it is worth.
#
# Written for n drives at once: the task of one world is a judge of one drive, and the many worlds of a GPU share one
# judge, so all are judged by the same arithmetic. The *foot* is the arc length of the route's point next to the robot's
# base; *progress* is the foot's way from the beginning of the stretch.


Which = Sequence[int] | NDArray[np.int64]

CAUSES = ("", "rollover", "collision", "out_of_bounds", "goal", "timeout", "stuck")
"""Why an episode ends; the first: it goes on. Where several hold, the earlier one is told."""
STATE = {"speed": 1, "yaw_rate": 1, "cross_track": 1, "heading_error": 1, "turns": 3}
"""What a driver's state is made of, and how many numbers of each; see `Judge.state`."""

_GOAL, _TIMEOUT = CAUSES.index("goal"), CAUSES.index("timeout")
_BUMPER = 0.5  # [m] ahead of the base
_SEARCH = (1.0, 3.0)  # [m] behind and ahead of the last foot
_ROLLED = 0.5  # cosine of the tilt beyond which the robot has rolled over
_STUCK_TIME, _STUCK_DISTANCE = 5.0, 0.1  # [s], [m]: less way than this in that time
_AHEAD = (1.0, 2.0, 4.0)  # [m] along the route, of which the state tells the curvature


@dataclass(frozen=True)
class Motion:
    """Of k robots, at the end of a control step."""

    pose: Array
    """x, y [m] and yaw [rad] of the bases, shape (k, 3)."""
    speed: Array
    """Along the heading [m/s], shape (k,)."""
    yaw_rate: Array
    """[rad/s], shape (k,)."""
    uprightness: Array
    """Cosine of the tilt, shape (k,)."""
    touched: NDArray[np.bool_]
    """Whether anything but the ground was touched during the step, shape (k,)."""
    time: Array
    """Of the episodes [s], shape (k,)."""


class RewardAndTermination:
    """Of n drives along one stretch. Drives are told by their numbers, `which`, shape (k,)."""

    def __init__(self, world: World, stretch: RouteSegment, options: Options, count: int = 1) -> None:
        """
        Args:
            world: Has the route.
            stretch: What is driven.
            options: Corridor, limits and rewards.
            count: How many drives there are.
        """
        self.stretch, self.options = stretch, options
        self.half_width = options.half_width or world.half_width
        """Of the corridor [m]."""
        self.time_limit = options.time_limit or 2.0 * stretch.length / options.speed
        """[s]"""
        self.foot, self.cross_track = np.zeros(count), np.zeros(count)
        """Arc length and distance from the route, left positive [m], shape (n,)."""
        self.cause = np.zeros(count, int)
        """Why each ended, or that it goes on: index into `CAUSES`, shape (n,)."""
        self._route = world.route[:, :2]
        self._before, self._steering = np.zeros(count), np.zeros(count)
        self._last_moved, self._stood = np.zeros((count, 2)), np.zeros(count)
        terms = options.rewards
        self._worth = np.array([getattr(terms, cause) if cause else 0.0 for cause in CAUSES])
        self._worth[[0, _GOAL]] += terms.step

    def begin(self, which: Which, foot: Array, position: Array) -> None:
        """Drives begin: near which arc lengths, shape (k,), and where, shape (k, 2) [m]."""
        self.cause[which], self._stood[which], self._steering[which] = 0, 0.0, 0.0
        self.foot[which], self.cross_track[which] = self._nearest(position, foot)
        self._before[which], self._last_moved[which] = self.foot[which], position

    def act(self, which: Which, yaw_rate: Array) -> None:
        """What is steered in the coming step [rad/s], shape (k,)."""
        self._steering[which] = yaw_rate / self.options.yaw_rate

    def judge(self, which: Which, motion: Motion) -> None:
        """Takes in where a control step has led."""
        position = motion.pose[:, :2]
        self._before[which] = self.foot[which]
        foot, cross = self.foot[which], self.cross_track[which] = self._nearest(position, self.foot[which])
        moved = np.linalg.norm(position - self._last_moved[which], axis=-1) > _STUCK_DISTANCE
        self._last_moved[which] = np.where(moved[:, None], position, self._last_moved[which])
        self._stood[which] = np.where(moved, motion.time, self._stood[which])
        holds = [  # in the order of CAUSES
            motion.uprightness < _ROLLED,
            motion.touched,
            np.abs(cross) > self.half_width,
            foot >= self.stretch.end - _BUMPER,
            motion.time > self.time_limit - 1e-6,
            motion.time - self._stood[which] >= _STUCK_TIME,
        ]
        self.cause[which] = np.select(holds, list(range(1, len(CAUSES))), 0)

    def reward(self, which: Which) -> Array:
        """Of the step that was judged last, shape (k,)."""
        terms = self.options.rewards
        off = np.minimum(1.0, np.abs(self.cross_track[which]) / self.half_width)
        way = terms.progress * (self.foot[which] - self._before[which]) + terms.cross_track * off
        return self._worth[self.cause[which]] + way + terms.steering * self._steering[which] ** 2

    def ended(self, which: Which) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether drives are over for good, and whether only their time is up, each shape (k,)."""
        timeout = self.cause[which] == _TIMEOUT
        return (self.cause[which] > 0) & ~timeout, timeout

    def state(self, which: Which, motion: Motion) -> NDArray[np.float32]:
        """What a driver that knows the map would know, shape (k, 7).

        `speed` [m/s], `yaw_rate` [rad/s], `cross_track` [m] left positive, `heading_error` [rad] of the robot against
        the route, `turns` [rad]: how far the route's heading has turned 1, 2 and 4 m ahead.
        """
        foot = self.foot[which]
        heading = heading_at(self._route, foot)
        turns = heading_error(heading_at(self._route, foot[:, None] + np.array(_AHEAD)), heading[:, None])
        error = heading_error(motion.pose[:, 2], heading)
        columns = (motion.speed, motion.yaw_rate, self.cross_track[which], error)
        return np.column_stack([*columns, turns]).astype(np.float32)

    def _nearest(self, position: Array, foot: Array) -> tuple[Array, Array]:
        return nearest(self._route, position, (foot - _SEARCH[0], foot + _SEARCH[1]))


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


class DriveTask(control.Task):
    """Drives a stretch."""

    def __init__(
        self,
        world: World,
        stretch: RouteSegment,
        options: Options,
        obstacles: EpisodeObstacles,
        model: mujoco.MjModel,
        seed: int | None = None,
        judge: tuple[RewardAndTermination, int] | None = None,
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
        self._judge, self._number = judge or (RewardAndTermination(world, stretch, options), 0)
        self.half_width, self.time_limit = self._judge.half_width, self._judge.time_limit
        self._obstacles = obstacles
        self._nominal = Nominal(model) if options.randomise else None
        self.seed(seed)
        self.episode_seed = 0
        """Of the episode under way."""
        self.draw = RandomizationSample()
        """Of the episode under way: its robot and its weather."""
        self._record = self.draw.record()
        self.obstacles: tuple[ObstacleConfig, ...] = ()
        """Of the episode under way."""
        self._began = stretch.start

    def seed(self, seed: int | None) -> None:
        """Starts another sequence of episodes."""
        self._rng = np.random.default_rng(seed)

    def weathered(self, draw: RandomizationSample) -> None:
        """Takes another draw for that of the episode under way, which differs from it in the weather alone."""
        self.draw, self._record = draw, draw.record()

    def rng(self, stream: int) -> np.random.Generator:
        """A generator of the episode under way."""
        return np.random.default_rng([self.episode_seed, stream])

    # ---- what dm_control calls

    def initialize_episode(self, physics: DrivePhysics) -> None:
        self.episode_seed = int(self._rng.integers(2**63))
        self.draw = self.options.randomise.draw(self.rng(ROBOT)) if self.options.randomise else RandomizationSample()
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
