"""Driving along a route segment in dm_control, without images: physics, start, state, reward and termination.

`options.Rewards` has the weights of the reward. In an *episode*, the robot starts at rest near the segment's start, or
with `Options.start_along` anywhere on the segment and rolling. The episode ends with one of `CAUSES`. The discount at
the end is 0, or 1 after a timeout, which truncates the episode. An episode's seed determines all its randomness, so
that policies can be compared on the same episodes. Start, robot, lighting, obstacles, camera and weather have separate
random generators: a change in the sampling of one leaves the others unchanged.
"""

import copy
import math
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from twin.config import CAUSES, STEERING, ObstacleConfig
from twin.env.domain_randomization import NominalModel, RandomizationSample
from twin.env.obstacles import EpisodeObstacles, ObstacleMotion, obstacles_in_reach
from twin.env.options import STATE_SIZES, Options, check_actions
from twin.env.physics import EPISODE_STATE, HuskyPhysics
from twin.env.route_segments import RouteSegment
from twin.errors import InputError, short_repr
from twin.geometry.polyline import heading_at, nearest_on_route, point_at
from twin.geometry.poses import wrap_angle
from twin.mjcf.world import World
from twin.robot import HuskyParams
from twin.types import Array

try:
    with warnings.catch_warnings():
        # On import, dm_control looks for a display and warns if there is none; this package needs none.
        warnings.simplefilter("ignore")
        from dm_control import mujoco as dm_mujoco
        from dm_control.mujoco import wrapper
        from dm_control.rl import control
except ModuleNotFoundError as error:
    needed = f"{error}: driving in a scene needs"
    if sys.version_info >= (3, 13):
        python = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise InputError(
            f"{needed} dm_control, which installs on Python 3.11 and 3.12; this is Python {python}"
        ) from None
    raise InputError(f"{needed} {(error.name or 'dm_control').split('.')[0]}; install twin again") from None

EnvIndices = Sequence[int] | NDArray[np.int64]

_CODES = {cause: code for code, cause in enumerate(CAUSES, 1)}  # 0: the episode goes on
BUMPER_OFFSET = 0.5  # [m] from the base to the bumper; the goal is reached when the bumper is at the segment's end
ROLLOVER_COSINE = 0.5  # cosine of the tilt beyond which the robot has rolled over
STUCK_TIME, STUCK_DISTANCE = 5.0, 0.1  # [s], [m]: a robot that moves less than this distance in this time is stuck
_STATE_MARGIN = 10.0  # bounds of speed and yaw rate in the state, as multiples of the controller's limits
EPISODE_VERSION = 8
"""Version of the episodes of a training. Increase it whenever a change of the code changes the starts of a seed with
`Options.start_along`, when these episodes are cut off, or which ends of episodes are terminal."""
# With `Options.start_along`: at the start, largest distance from the route / corridor half width, largest heading /
# `start_heading`. A policy has to know what to do there, since it gets there sometimes.
_ALONG_OFFSET, _ALONG_HEADING = 0.8, 2.0
_LOOKAHEADS = (1.0, 2.0, 4.0)  # [m] along the route; the state contains the change of heading up to these points
_OBSTACLE_RANGE = (-0.5, 6.0)  # [m] the state contains the nearest obstacle between here and there along the route


# ---- reward and termination of n drives at once


@dataclass(frozen=True)
class Motion:
    """Motion of k robots at the end of a control step."""

    pose: Array
    """x, y [m] and yaw [rad] of the bases, shape (k, 3)."""
    speed: Array
    """Speed along the heading [m/s], shape (k,)."""
    yaw_rate: Array
    """[rad/s], shape (k,)."""
    uprightness: Array
    """Cosine of the tilt, shape (k,)."""
    touched: NDArray[np.bool_]
    """True where the robot touched anything but the ground during the step, shape (k,)."""
    time: Array
    """Time since the start of the episodes [s], shape (k,)."""


class RewardAndTermination:
    """Reward, termination and state of n drives along one route segment.

    A task uses it for one drive, a GPU vector environment for all of its drives. `which` selects k of the n drives. The
    *foot* is the point of the route that is nearest to the robot's base, given by its arc length. Progress is the arc
    length from the segment's start to the foot.
    """

    def __init__(self, world: World, segment: RouteSegment, options: Options, count: int = 1) -> None:
        """`count`: number of drives n."""
        self.segment, self.options = segment, options
        self.half_width = options.half_width or world.half_width
        """Half width of the corridor [m]."""
        top_speed = min(world.robot.max_speed, world.robot.max_wheel_speed)
        self.time_limit = options.time_limit or segment.length * max(2.0 / options.speed, 1.5 / top_speed)
        """[s]; by default twice the time that the segment takes at `speed`, or 1.5 times that at the top speed."""
        self.foot, self.cross_track = np.zeros(count), np.zeros(count)
        """Arc length of the foot, and signed distance from the route, positive to the left [m], shape (n,)."""
        self._cause = np.zeros(count, int)
        self._route = world.route[:, :2]
        self._previous_foot, self._steering = np.zeros(count), np.zeros(count)
        # Position and time at which each robot last completed a motion of STUCK_DISTANCE.
        self._anchor, self._anchor_time = np.zeros((count, 2)), np.zeros(count)
        self._cut_time, self._cut = np.full(count, np.inf), np.zeros(count, bool)
        terms = options.rewards
        speed, yaw_rate = (_STATE_MARGIN * x for x in (world.robot.max_wheel_speed, world.robot.max_yaw_rate))
        # `cross_track` is bounded, since an episode ends at most one control step after the robot leaves the corridor.
        cross_track = max(self.half_width, options.start_offset) + speed * options.control_timestep
        beside = 2.0 * cross_track + _OBSTACLE_RANGE[1]
        high = np.array([speed, yaw_rate, cross_track, *[np.pi] * 4, _OBSTACLE_RANGE[1], beside, beside], np.float32)
        self.state_bounds = np.stack([-high, high])
        """Lowest and highest values of the components of `state`, float32, shape (2, 10)."""
        self.obstacles: list[tuple[ObstacleConfig, ...]] = [()] * count
        """Obstacles of each drive's present episode."""
        self._cause_rewards = np.array([0.0, *(getattr(terms, cause) for cause in CAUSES)])
        self._cause_rewards[[0, _CODES["goal"]]] += terms.step

    def begin(self, which: EnvIndices, foot: Array, position: Array, cut_time: float = np.inf) -> None:
        """Starts k episodes at positions, shape (k, 2) [m], near the arc lengths `foot`, shape (k,) [m].

        An episode that has not ended after `cut_time` [s] is cut off: truncated without a cause.
        """
        self._cut_time[which] = cut_time
        self._cause[which], self._anchor_time[which], self._steering[which] = 0, 0.0, 0.0
        self.foot[which], self.cross_track[which] = self._nearest(position, foot)
        self._previous_foot[which], self._anchor[which] = self.foot[which], position

    def set_steering(self, which: EnvIndices, yaw_rate: Array) -> None:
        """Stores the yaw rates commanded for the coming step [rad/s], shape (k,); the steering reward uses them."""
        self._steering[which] = yaw_rate / self.options.yaw_rate

    def evaluate(self, which: EnvIndices, motion: Motion) -> None:
        """Updates progress and termination after a control step."""
        position = motion.pose[:, :2]
        self._previous_foot[which] = self.foot[which]
        foot, cross = self.foot[which], self.cross_track[which] = self._nearest(position, self.foot[which])
        moved = np.linalg.norm(position - self._anchor[which], axis=-1) > STUCK_DISTANCE
        self._anchor[which] = np.where(moved[:, None], position, self._anchor[which])
        self._anchor_time[which] = np.where(moved, motion.time, self._anchor_time[which])
        conditions = {  # if several hold, the first is the cause
            "rollover": motion.uprightness < ROLLOVER_COSINE,
            "collision": motion.touched,
            "out_of_bounds": np.abs(cross) > self.half_width,
            "goal": foot >= self.segment.end - BUMPER_OFFSET,
            "timeout": motion.time > self.time_limit - 1e-6,
            "stuck": motion.time - self._anchor_time[which] > STUCK_TIME - 1e-6,
        }
        self._cause[which] = np.select(list(conditions.values()), [_CODES[cause] for cause in conditions], 0)
        self._cut[which] = motion.time > self._cut_time[which] - 1e-6

    def cause(self, i: int) -> str:
        """The cause of drive i's end, one of `CAUSES`; empty while the episode goes on, and if it was cut off."""
        code = self._cause[i]
        return CAUSES[code - 1] if code else ""

    def reward(self, which: EnvIndices) -> Array:
        """Returns the reward of the last evaluated step, shape (k,)."""
        terms = self.options.rewards
        off = np.minimum(1.0, np.abs(self.cross_track[which]) / self.half_width)
        motion = terms.progress * (self.foot[which] - self._previous_foot[which]) + terms.cross_track * off
        return self._cause_rewards[self._cause[which]] + motion + terms.steering * self._steering[which] ** 2

    def ended(self, which: EnvIndices) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns which drives are terminated, and which are truncated (time limit, cut off), each of shape (k,)."""
        timeout = self._cause[which] == _CODES["timeout"]
        ended = (self._cause[which] > 0) & ~timeout
        return ended, timeout | (self._cut[which] & ~ended)

    def state(self, which: EnvIndices, motion: Motion) -> NDArray[np.float32]:
        """Returns the privileged state of a driver that knows the map, shape (k, 10).

        Its components are `speed` [m/s], `yaw_rate` [rad/s], `cross_track` [m] (positive to the left), `heading_error`
        [rad] (the robot's heading minus the route's), `turns` [rad] (changes of the route's heading until 1, 2 and 4 m
        ahead) and `obstacle`: of the nearest obstacle in reach of the corridor, until 6 m ahead, its distance from the
        robot along and across the route (positive ahead and to the left) and its radius [m]; without one 6, 0 and 0.

        The state is clipped to `state_bounds`. This changes it only if the robot moves more than ten times as fast as
        its controller allows, for example when it falls.
        """
        foot = self.foot[which]
        heading = heading_at(self._route, foot)
        turns = wrap_angle(heading_at(self._route, foot[:, None] + np.array(_LOOKAHEADS)) - heading[:, None])
        error = wrap_angle(motion.pose[:, 2] - heading)
        columns = (motion.speed, motion.yaw_rate, self.cross_track[which], error)
        nearest = [self._nearest_obstacle(i, time) for i, time in zip(which, motion.time, strict=True)]
        obstacle = np.array(nearest).reshape(-1, STATE_SIZES["obstacle"])
        return np.clip(np.column_stack([*columns, turns, obstacle]).astype(np.float32), *self.state_bounds)

    def _nearest_obstacle(self, i: int, time: float) -> tuple[float, float, float]:
        """The part `obstacle` of the state of drive i at a time [s]."""
        behind, far = _OBSTACLE_RANGE
        if self.obstacles[i]:
            station, lateral, radius = obstacles_in_reach(self.obstacles[i], self.half_width, time).T
            ahead = station - self.foot[i]
            seen = np.flatnonzero((ahead + radius > behind) & (ahead < far))
            if len(seen):
                k = seen[(np.abs(ahead[seen]) - radius[seen]).argmin()]
                return float(ahead[k]), float(lateral[k] - self.cross_track[i]), float(radius[k])
        return far, 0.0, 0.0

    def _nearest(self, position: Array, foot: Array) -> tuple[Array, Array]:
        return nearest_on_route(self._route, position, foot)


# ---- physics and task of one drive


class DrivePhysics(dm_mujoco.Physics):
    """A dm_control Physics of one robot, with properties of `HuskyPhysics`."""

    _params = HuskyParams()

    @staticmethod
    def of(model: mujoco.MjModel, params: HuskyParams) -> "DrivePhysics":
        """Returns physics that steps `model` itself, not a copy; `episode_spec` must have made it for this robot."""
        data = wrapper.MjData(wrapper.MjModel(model))
        mujoco.mj_forward(model, data.ptr)
        physics = DrivePhysics(data)
        physics.set_robot(params)
        return physics

    def _reload_from_data(self, data: Any) -> None:
        # Set before the call of super(), which calls `after_reset`.
        self.robot = HuskyPhysics(data.model.ptr, self._params, data.ptr)
        super()._reload_from_data(data)

    def set_robot(self, params: HuskyParams) -> None:
        """Replaces the robot's controller and latencies; drops pending commands."""
        move_obstacles = self.robot.move_obstacles
        self._params = params
        self.robot = HuskyPhysics(self.model.ptr, params, self.data.ptr)
        self.robot.move_obstacles = move_obstacles

    def copy(self, share_model: bool = False) -> "DrivePhysics":
        physics = super().copy(share_model)
        physics._continue(*copy.deepcopy(self._episode()))
        return physics

    def __getstate__(self) -> Any:
        return self.data, *self._episode()

    def __setstate__(self, state: Any) -> None:
        data, *episode = state
        super().__setstate__(data)
        self._continue(*episode)

    def _episode(self) -> tuple[HuskyParams, tuple[ObstacleConfig, ...] | None, dict[str, Any]]:
        """Robot, obstacles and state, which a copy needs besides `data` to go on with the episode."""
        moved = self.robot.move_obstacles
        obstacles = moved.obstacles if isinstance(moved, ObstacleMotion) else None
        return self._params, obstacles, {name: getattr(self.robot, name) for name in EPISODE_STATE}

    def _continue(
        self, params: HuskyParams, obstacles: tuple[ObstacleConfig, ...] | None, state: dict[str, Any]
    ) -> None:
        self.set_robot(params)
        vars(self.robot).update(state)
        if obstacles is not None:
            self.robot.move_obstacles = ObstacleMotion(obstacles, self.data.ptr)

    def after_reset(self) -> None:
        super().after_reset()
        self.robot.begin()

    def step(self, nstep: int = 1) -> None:
        """Runs one control step of `nstep` substeps."""
        with self.check_invalid_state():
            self.robot.step(nstep * self.timestep())

    # Properties of `HuskyPhysics`; `camera_to_world` is the pose from which the newest image was taken.
    planar_pose = property(attrgetter("robot.planar_pose"))
    base_to_world = property(attrgetter("robot.base_to_world"))
    delayed_data = property(attrgetter("robot.delayed_data"))
    camera_to_world = property(attrgetter("robot.delayed_camera_to_world"))
    speed = property(attrgetter("robot.speed"))
    yaw_rate = property(attrgetter("robot.yaw_rate"))
    uprightness = property(attrgetter("robot.uprightness"))
    touched = property(attrgetter("robot.touched"))


START, ROBOT, LIGHTING, OBSTACLES, CAMERA, WEATHER = range(6)
"""Random streams of an episode: `numpy.random.default_rng([seed, stream])`."""

_START_TRIES = 50


class DriveTask(control.Task):
    """A dm_control task: driving along a route segment."""

    def __init__(
        self,
        world: World,
        segment: RouteSegment,
        options: Options,
        obstacles: EpisodeObstacles,
        model: mujoco.MjModel,
        seed: int | None = None,
        evaluator: tuple[RewardAndTermination, int] | None = None,
    ) -> None:
        """
        Args:
            world, segment, options: As in `RewardAndTermination`.
            obstacles: Samples an episode's obstacles; its pool is in the model.
            model: The compiled model before randomization; it is not stepped.
            seed: Seed of the sequence of episodes; None: unpredictable.
            evaluator: Shared reward and termination of many drives, and this drive's index; None: a new one.
        """
        self.world, self.segment, self.options = world, segment, options
        self._evaluator, self._index = evaluator or (RewardAndTermination(world, segment, options), 0)
        self.half_width, self.time_limit = self._evaluator.half_width, self._evaluator.time_limit
        self._obstacles = obstacles
        self._nominal = NominalModel(model) if options.randomise else None
        self.seed(seed)
        self.episode_seed = 0
        """Seed of the current episode."""
        self.sample = RandomizationSample()
        """Randomized robot and weather of the current episode; the weather is reduced where a photo shows it."""
        self.drawn = self.sample
        """The same before any reduction."""
        self._start_station = segment.start

    def seed(self, seed: int | None) -> None:
        """Starts a new sequence of episodes. Raises InputError: the seed is negative, or not a whole number."""
        try:
            self._rng = np.random.default_rng(seed)
        except (TypeError, ValueError):
            raise InputError(f"seed = {short_repr(seed)}; expected None, or a whole number of 0 or more") from None

    def rng(self, stream: int) -> np.random.Generator:
        """Returns a new generator of one stream of the current episode."""
        return np.random.default_rng([self.episode_seed, stream])

    # ---- interface of dm_control

    def initialize_episode(self, physics: DrivePhysics) -> None:
        self.episode_seed = int(self._rng.integers(2**63))
        ranges = self.options.randomise
        self.sample = self.drawn = ranges.sample(self.rng(ROBOT)) if ranges else RandomizationSample()
        if self._nominal:
            self._nominal.apply(self.sample, physics.model.ptr)
        params = self.world.robot
        physics.set_robot(replace(params, command_latency=params.command_latency + self.sample.latency))
        self.obstacles = self._obstacles.sample(self.rng(OBSTACLES), self.sample.bystanders)
        physics.robot.move_obstacles = ObstacleMotion(self.obstacles, physics.data.ptr)
        rng, speed = self.rng(START), self.options.speed if self.options.start_along else 0.0
        for _ in range(_START_TRIES):
            physics.robot.set_pose(*self._sample_start(rng), speed)
            if not physics.touched:
                break
        else:
            raise InputError(
                f"task {self.segment.name!r}: the robot touches {', '.join(physics.touched)} at each of {_START_TRIES} "
                "sampled starts; move the obstacle or the start"
            )
        cut_time = self.options.along_time if self.options.start_along else np.inf
        position = physics.planar_pose[None, :2]
        self._evaluator.begin([self._index], np.array([self._start_station]), position, cut_time)

    def before_step(self, action: Any, physics: DrivePhysics) -> None:
        """Raises ValueError: the action is invalid; the episode is unchanged."""
        width = 1 if self.options.action == STEERING else 2
        commands = self.commands(check_actions(action, (width,))[None])
        self._evaluator.set_steering([self._index], commands[:, 1])
        physics.robot.command(*commands[0].tolist())

    def after_step(self, physics: DrivePhysics) -> None:
        self._evaluator.evaluate([self._index], _robot_motion(physics))

    def get_reward(self, physics: DrivePhysics) -> float:
        return float(self._evaluator.reward([self._index])[0])

    def get_termination(self, physics: DrivePhysics) -> float | None:
        terminated, truncated = self._evaluator.ended([self._index])
        return 0.0 if terminated[0] else 1.0 if truncated[0] else None

    def get_observation(self, physics: DrivePhysics) -> dict[str, NDArray[np.float32]]:
        """Returns the components of the privileged state."""
        return _by_component(self.state(physics))

    def state(self, physics: DrivePhysics) -> NDArray[np.float32]:
        """Returns the privileged state, shape (10,), see `RewardAndTermination.state`."""
        return self._evaluator.state([self._index], _robot_motion(physics))[0]

    def observation_spec(self, physics: DrivePhysics) -> dict[str, specs.BoundedArray]:
        lows, highs = map(_by_component, self.state_bounds)
        return {name: specs.BoundedArray(low.shape, np.float32, low, highs[name], name) for name, low in lows.items()}

    def action_spec(self, physics: DrivePhysics) -> specs.BoundedArray:
        low, high = self._bounds()
        name = "yaw_rate" if self.options.action == STEERING else "speed\tyaw_rate"
        return specs.BoundedArray(low.shape, np.float64, low, high, name=name)

    # ---- state of the episode

    @property
    def obstacles(self) -> tuple[ObstacleConfig, ...]:
        """Obstacles of the current episode."""
        return self._evaluator.obstacles[self._index]

    @obstacles.setter
    def obstacles(self, obstacles: tuple[ObstacleConfig, ...]) -> None:
        self._evaluator.obstacles[self._index] = obstacles

    @property
    def state_bounds(self) -> NDArray[np.float32]:
        """See `RewardAndTermination.state_bounds`."""
        return self._evaluator.state_bounds

    @property
    def cause(self) -> str:
        """The cause of the episode's end; empty while it goes on, and if it was cut off."""
        return self._evaluator.cause(self._index)

    @property
    def cross_track(self) -> float:
        """Signed distance from the route, positive to the left [m]."""
        return float(self._evaluator.cross_track[self._index])

    @property
    def progress(self) -> float:
        """Distance along the segment [m]; may be slightly negative."""
        return float(self._evaluator.foot[self._index]) - self.segment.start

    def commands(self, actions: Array) -> Array:
        """Converts actions, shape (k, 1 or 2), to commands v [m/s] and ω [rad/s], shape (k, 2)."""
        actions = np.clip(actions, *self._bounds())
        if self.options.action == STEERING:
            return np.column_stack([np.full(len(actions), self.options.speed), actions])
        return actions

    def info(self, physics: DrivePhysics) -> dict[str, Any]:
        """Returns the episode's info so far, see `twin.env.gym_env`; JSON-able."""
        return self.episode_info(physics.speed, physics.touched)

    def episode_info(self, speed: float, touched: Sequence[str]) -> dict[str, Any]:
        """Returns the episode's info so far, for a speed [m/s] and touched geoms computed elsewhere."""
        return {
            "cause": self.cause,
            "is_success": self.cause == "goal",
            "start": self._start_station - self.segment.start,
            "progress": self.progress,
            "cross_track": self.cross_track,
            "speed": speed,
            "touched": list(touched),
            "episode_seed": self.episode_seed,
            "randomisation": self.sample.record(),
        }

    def _bounds(self) -> tuple[Array, Array]:
        o = self.options
        if o.action == STEERING:
            return np.array([-o.yaw_rate]), np.array([o.yaw_rate])
        return np.array([0.0, -o.yaw_rate]), np.array([o.speed, o.yaw_rate])

    def _sample_start(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Samples a start pose: x, y [m] and yaw [rad]."""
        o = self.options
        offset = rng.uniform(-o.start_offset, o.start_offset)
        turn = np.deg2rad(rng.uniform(-o.start_heading, o.start_heading))
        share = 0.0
        if o.start_along:
            offset *= max(1.0, _ALONG_OFFSET * self.half_width / o.start_offset) if o.start_offset else 1.0
            turn *= _ALONG_HEADING
            share = o.start_along * rng.random()
        s = self._start_station = self.segment.start + share * (self.segment.length - BUMPER_OFFSET)
        heading = float(heading_at(self.world.route[:, :2], s))
        x, y = point_at(self.world.route[:, :2], s) + offset * np.array([-np.sin(heading), np.cos(heading)])
        return float(x), float(y), heading + float(turn)


def _by_component(state: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    ends = np.cumsum(list(STATE_SIZES.values()))
    return dict(zip(STATE_SIZES, np.split(state, ends[:-1]), strict=True))


def _robot_motion(physics: DrivePhysics) -> Motion:
    values = physics.speed, physics.yaw_rate, physics.uprightness, bool(physics.touched), physics.time()
    return Motion(physics.planar_pose[None], *(np.array([value]) for value in values))


# ---- task file

_TASK_FILE_VERSION = 1


def task_table(world: World, segment: RouteSegment, options: Options) -> dict[str, Any]:
    """A task for a JSON file, by which programs without this package evaluate drives by the same rules.

    Its numbers are those of `RewardAndTermination`, in the scene's frame (z up), meters, seconds, radians.
    `line` (m, 3) is on the ground, in driving order; a *station* is a horizontal arc length along it. Trials start at
    `start.station`, up to `start.offset` beside the line and turned by up to `start.heading` from its direction. They
    succeed when the base reaches the station `goal`. They fail

    - when the base is further than `half_width` from the line;
    - when the robot touches an object;
    - when the robot tilts by more than `max_tilt`;
    - when the robot moves by less than `stuck.distance` in `stuck.time`;
    - after `time_limit`.

    Commands come every `control_timestep` and are bounded by `limits`.
    """
    rules = RewardAndTermination(world, segment, options)
    return {
        "format": "twin task",
        "version": _TASK_FILE_VERSION,
        "name": segment.name,
        "line": world.route.tolist(),
        "half_width": rules.half_width,
        "start": {
            "station": segment.start,
            "offset": options.start_offset,
            "heading": math.radians(options.start_heading),
        },
        "goal": segment.end - BUMPER_OFFSET,
        "time_limit": rules.time_limit,
        "stuck": {"distance": STUCK_DISTANCE, "time": STUCK_TIME},
        "max_tilt": math.acos(ROLLOVER_COSINE),
        "limits": {"speed": options.speed, "yaw_rate": options.yaw_rate},
        "control_timestep": options.control_timestep,
    }
