"""What becomes of drives along a stretch of a route: where each is, why it ends, what a step of it is worth.

Written for n drives at once: the task of one world is a judge of one drive, and the many worlds of a GPU share one
judge, so all are judged by the same arithmetic. The *foot* is the arc length of the route's point next to the robot's
base; *progress* is the foot's way from the beginning of the stretch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.env.options import Options
from twin.env.stretches import Stretch
from twin.mjcf.world import World, heading_at, heading_error, nearest

Array = NDArray[np.float64]
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


class Judge:
    """Of n drives along one stretch. Drives are told by their numbers, `which`, shape (k,)."""

    def __init__(self, world: World, stretch: Stretch, options: Options, count: int = 1) -> None:
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
