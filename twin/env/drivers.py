"""Drivers: they convert poses or images to commands or actions.

`PurePursuit` (Coulter 1992) needs only poses: it steers along a circle through a point of the route ahead.
`follow_route` records a drive by `PurePursuit`, without images and without dm_control. A skid-steered robot turns
faster or slower than commanded, by a factor that depends on ground and load. So `PurePursuit` multiplies the yaw rate
by a gain, which it updates from the measured ratio of commanded to achieved curvature.

The *drivers of an environment* receive the environment and its newest `dm_env.TimeStep`, and return an action within
`action_spec`. Drivers that use poses serve as references; a policy uses images only.
"""

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from twin.config import STEERING
from twin.env.controller import CONTROL_PERIOD
from twin.env.options import check_actions
from twin.env.physics import HuskyPhysics
from twin.errors import InputError, short_repr
from twin.geometry.polyline import arc_lengths, heading_at, nearest_on_route, point_at
from twin.geometry.poses import wrap_angle
from twin.mjcf.world import World
from twin.types import Array

if TYPE_CHECKING:  # not imported at run time: `follow_route` works without dm_control
    import dm_env
    from dm_control.rl import control

# ---- pure pursuit

GOAL_RADIUS = 1.0  # [m] distance from the goal at which it is reached

_LOOKAHEAD = 1.0  # [m] distance along the route to the point that the robot steers to
_GAIN_RATE = 0.15  # fraction of the gain's error that is corrected per `CONTROL_PERIOD`
_GAIN_RANGE = (0.5, 2.5)
_GAIN_MIN_YAW_RATE = 0.15  # [rad/s]; at smaller yaw rates, the measured ratio is mostly noise


@dataclass(frozen=True)
class RecordedDrive:
    """A recorded drive of k instants, one per control step of 0.1 s. At the first, the robot rests at the start."""

    times: Array
    """[s], shape (k,)."""
    base_to_world: Array
    """Shape (k, 4, 4)."""
    camera_to_world: Array
    """Poses of the front camera, OpenCV axes, shape (k, 4, 4)."""
    qpos: Array
    """MuJoCo's positions, shape (k, nq), for rendering the drive again."""
    commands: Array
    """Commands v [m/s], ω [rad/s] at each instant, shape (k, 2); the last row is zero."""
    cross_track: Array
    """Signed distance from the route, positive to the left [m], shape (k,)."""
    progress: Array
    """Arc length of the route's point nearest to the robot [m], shape (k,)."""
    touched: tuple[str, ...]
    """Sorted names of the touched geoms except the ground."""
    outcome: str
    """goal, touched, off_corridor or timeout."""

    @property
    def reached_goal(self) -> bool:
        return self.outcome == "goal"

    @property
    def max_cross_track(self) -> float:
        """Largest distance from the route [m]."""
        return float(np.abs(self.cross_track).max())

    @property
    def mean_cross_track(self) -> float:
        """Mean distance from the route [m]."""
        return float(np.abs(self.cross_track).mean())


def pursuit_curvature(pose: Array, target: Array) -> float:
    """Curvature [1/m] of the circle that leaves `pose` (x, y, yaw) along its heading and passes `target` (x, y)."""
    ahead = target - pose[:2]
    lateral = np.cos(pose[2]) * ahead[1] - np.sin(pose[2]) * ahead[0]
    return float(2.0 * lateral / max(ahead @ ahead, 1e-9))


class PurePursuit:
    """Converts a sequence of poses to commands that follow the route.

    The *foot* is the point of the route nearest to the robot.
    """

    def __init__(
        self,
        route: Array,
        speed: float,
        max_yaw_rate: float,
        start: float = 0.0,
        period: float = CONTROL_PERIOD,
    ) -> None:
        """`route` [m] has shape (m, ≥2), `speed` is in m/s, `max_yaw_rate` in rad/s; `start` is an arc length [m].

        `period` is the time between two commands [s].
        """
        self._period = period
        self._route, self._speed, self._max_yaw_rate = route[:, :2], speed, max_yaw_rate
        self._length = float(arc_lengths(route)[-1])
        self.s = start
        """Largest arc length reached so far [m]."""
        self._gain = 1.0
        self._last: tuple[Array, tuple[float, float]] | None = None

    def update(self, pose: Array) -> tuple[float, float]:
        """Updates `s` from a pose (x, y, yaw); returns the foot's arc length and the cross-track error [m]."""
        foot, error = nearest_on_route(self._route, pose[:2], self.s)
        self.s = max(self.s, float(foot))
        return float(foot), float(error)

    def command(self, pose: Array) -> tuple[float, float]:
        """Returns v [m/s] and ω [rad/s] for the control step that begins at a pose (x, y, yaw)."""
        if self._last is not None:
            self._gain = _updated_gain(self._gain, self._last[0], pose, self._last[1], self._period)
        target = _pursuit_target(self._route, self.s + _LOOKAHEAD, self._length)
        limit = self._max_yaw_rate
        wanted = np.clip(self._speed * pursuit_curvature(pose, target), -limit, limit)
        command = (self._speed, float(np.clip(self._gain * wanted, -limit, limit)))
        self._last = (pose, command)
        return command


def follow_route(
    world: World, physics: HuskyPhysics, speed: float = 1.0, timeout: float | None = None, branch: str = ""
) -> RecordedDrive:
    """Drives along the route until the goal, a contact, the corridor's edge or the time limit.

    Args:
        world: Route, goal and corridor.
        physics: Physics of the world's model; it is reset.
        speed: [m/s]; wheels reach at most 1 m/s, so turns are slower.
        timeout: [s]; None: 3 · route length / speed + 10 s.
        branch: Name of the branch to drive along instead of the route, from its start.

    Raises:
        InputError: there is no ground below a wheel at the start of the branch.
    """
    world = world.along(branch)
    speed = min(speed, physics.params.max_speed)
    length = float(arc_lengths(world.route)[-1])
    timeout = 3.0 * length / speed + 10.0 if timeout is None else timeout
    if branch:
        x, y, _ = point_at(world.route, world.start).tolist()
        physics.set_pose(x, y, float(heading_at(world.route, world.start)))
    else:
        physics.reset()

    rows: list[dict[str, Any]] = []
    touched: set[str] = set()
    driver = PurePursuit(world.route, speed, physics.params.max_yaw_rate, world.start)
    outcome = ""
    while not outcome:
        pose = physics.planar_pose
        foot, error = driver.update(pose)
        outcome = _outcome(world, pose, driver.s, length, abs(error), touched, physics.time > timeout)
        rows.append(
            {
                "times": physics.time,
                "base_to_world": physics.base_to_world,
                "camera_to_world": physics.camera_to_world,
                "qpos": physics.data.qpos.copy(),
                "commands": (0.0, 0.0) if outcome else driver.command(pose),
                "cross_track": error,
                "progress": foot,
            }
        )
        if not outcome:
            physics.command(*rows[-1]["commands"])
            physics.step()
            touched |= set(physics.touched)
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return RecordedDrive(**arrays, touched=tuple(sorted(touched)), outcome=outcome)


def _outcome(world: World, pose: Array, s: float, length: float, error: float, touched: set[str], late: bool) -> str:
    """The drive's outcome; empty while the drive goes on."""
    if touched:
        return "touched"
    # A route may pass near its goal long before its end; a robot there has not succeeded.
    if np.linalg.norm(pose[:2] - world.goal[:2]) < GOAL_RADIUS and s > length - 2 * GOAL_RADIUS:
        return "goal"
    if error > world.half_width:
        return "off_corridor"
    return "timeout" if late else ""


def _pursuit_target(route: Array, s: float, length: float) -> Array:
    """The point of the route at arc length s [m]; past its end the route continues straight."""
    if s <= length:
        return point_at(route, s)
    direction = route[-1] - point_at(route, length - 1.0)
    return route[-1] + direction / max(float(np.linalg.norm(direction)), 1e-9) * (s - length)


def _updated_gain(gain: float, previous: Array, pose: Array, command: tuple[float, float], period: float) -> float:
    """Moves the gain towards the ratio of commanded to achieved curvature in the last control step."""
    turned = float(wrap_angle(pose[2] - previous[2])) / period
    moved = float(np.linalg.norm(pose[:2] - previous[:2])) / period
    v, yaw_rate = command
    if abs(yaw_rate) < _GAIN_MIN_YAW_RATE or abs(turned) < _GAIN_MIN_YAW_RATE or yaw_rate * turned < 0 or moved < 0.2:
        return gain
    ratio = (yaw_rate / v) / (turned / moved)
    return float(np.clip(gain + _GAIN_RATE * (period / CONTROL_PERIOD) * (ratio - gain), *_GAIN_RANGE))


# ---- drivers of an environment

Policy = Callable[[NDArray[np.uint8]], NDArray]
"""Converts images (3 · stack, height, width), the newest last, to one number in [-1, 1] per component of an action."""


class Driver(Protocol):
    """Chooses the action of each control step; `step.first()` is true at the start of an episode."""

    def __call__(self, environment: "control.Environment", step: "dm_env.TimeStep") -> Array: ...


class RouteDriver:
    """Follows the route by `PurePursuit` from poses, at the environment's speed."""

    def __call__(self, environment: "control.Environment", step: "dm_env.TimeStep") -> Array:
        task, pose = environment.task, environment.physics.planar_pose
        if step.first():
            speed = min(task.options.speed, task.world.robot.max_speed)
            limit, period = task.options.yaw_rate, task.options.control_timestep
            self._pursuit = PurePursuit(task.world.route, speed, limit, task.segment.start, period)
        self._pursuit.update(pose)
        v, yaw_rate = self._pursuit.command(pose)
        return np.array([yaw_rate]) if task.options.action == STEERING else np.array([v, yaw_rate])


class PolicyDriver:
    """Takes its actions from a policy that receives the images."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def __call__(self, environment: "control.Environment", step: "dm_env.TimeStep") -> Array:
        pixels = step.observation["pixels"]
        stack, height, width, channels = pixels.shape
        answer = self._policy(pixels.transpose(0, 3, 1, 2).reshape(stack * channels, height, width))
        spec = environment.action_spec()
        try:
            action = check_actions(answer, spec.shape)
        except ValueError:
            raise InputError(
                f"the policy returned {short_repr(answer)}; expected {spec.shape[0]} numbers in [-1, 1]"
            ) from None
        return spec.minimum + (np.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (spec.maximum - spec.minimum)


def find_callable(name: str) -> Policy:
    """Imports the callable `module:function`; the search path includes the working folder.

    Raises:
        InputError: the import fails, or the imported object is not callable.
    """
    module, _, function = name.partition(":")
    if not (module and function):
        raise InputError(f"policy {name!r}: expected module:function, a callable of pixels (3 · stack, h, w)")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), function)
    except (Exception, SystemExit) as error:  # importing user code may raise anything
        raise InputError(f"policy {name!r}: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise InputError(f"policy {name!r}: {found!r} cannot be called; expected a function of pixels")
    return found
