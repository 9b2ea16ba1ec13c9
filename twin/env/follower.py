"""A scripted driver that follows a route from poses alone: the first proof that a scene can be driven.

Pure pursuit (Coulter 1992): steer on the circle through a point of the route some way ahead. A skid-steered robot
turns faster or slower than commanded, by a factor that depends on ground and load, so the driver also compares the yaw
rate it asked for with what the poses show, and corrects its commands by the ratio.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.env.controller import CONTROL_PERIOD
from twin.env.physics import HuskyPhysics
from twin.mjcf.world import World, arc_lengths, heading_error, nearest, point_at

Array = NDArray[np.float64]

GOAL_RADIUS = 1.0  # [m]

_LOOK_AHEAD = 1.0  # [m] on the route
_GAIN_RATE = 0.15  # share of the observed ratio taken over per control step
_GAIN_RANGE = (0.5, 2.5)
_GAIN_MIN_YAW_RATE = 0.15  # [rad/s]; below this the ratio is noise
_SEARCH = (1.0, 3.0)  # [m] behind and ahead of the last foot point


@dataclass(frozen=True)
class Drive:
    """A recorded drive of k instants, one per control step of 0.1 s, the first at rest at the start."""

    times: Array
    """[s], shape (k,)."""
    base_to_world: Array
    """Shape (k, 4, 4)."""
    camera_to_world: Array
    """Of the front camera, OpenCV axes, shape (k, 4, 4)."""
    qpos: Array
    """MuJoCo's positions, shape (k, nq), so that the drive can be drawn again."""
    commands: Array
    """v [m/s], ω [rad/s] given at each instant (the last row is zero), shape (k, 2)."""
    cross_track: Array
    """Distance from the route, left positive [m], shape (k,)."""
    progress: Array
    """Arc length of the nearest point of the route [m], shape (k,)."""
    touched: tuple[str, ...]
    """Names of what was touched besides the ground, sorted."""
    outcome: str
    """goal, touched, off_corridor or timeout."""

    @property
    def reached_goal(self) -> bool:
        return self.outcome == "goal"

    @property
    def max_cross_track(self) -> float:
        """[m]"""
        return float(np.abs(self.cross_track).max())

    @property
    def mean_cross_track(self) -> float:
        """[m]"""
        return float(np.abs(self.cross_track).mean())


def pursuit_curvature(pose: Array, target: Array) -> float:
    """Curvature [1/m] of the circle that leaves `pose` (x, y, yaw) along its heading and passes `target` (x, y)."""
    ahead = target - pose[:2]
    lateral = np.cos(pose[2]) * ahead[1] - np.sin(pose[2]) * ahead[0]
    return float(2.0 * lateral / max(ahead @ ahead, 1e-9))


def follow(world: World, physics: HuskyPhysics, speed: float = 1.0, timeout: float | None = None) -> Drive:
    """Drives from the start along the route until the goal, a touch, the corridor's edge or the time limit.

    Args:
        world: Route, goal and corridor.
        physics: Of the world's model; it is reset.
        speed: [m/s]; the robot itself does at most 1 m/s at a wheel, so less in a turn.
        timeout: [s]; by default what three times the route takes, and 10 s.
    """
    speed = min(speed, physics.params.max_speed)
    fastest_turn = physics.params.max_yaw_rate
    route = world.route[:, :2]
    length = float(arc_lengths(route)[-1])
    timeout = 3.0 * length / speed + 10.0 if timeout is None else timeout
    physics.reset()

    times, bases, cameras, positions, commands, errors, feet = [], [], [], [], [], [], []
    touched: set[str] = set()
    gain, s = 1.0, 0.0
    pose = physics.planar_pose
    while True:
        foot, error = nearest(route, pose[:2], (s - _SEARCH[0], s + _SEARCH[1]))
        s = max(s, float(foot))
        times.append(physics.time)
        bases.append(physics.base_to_world)
        cameras.append(physics.camera_to_world)
        positions.append(physics.data.qpos.copy())
        errors.append(float(error))
        feet.append(float(foot))
        outcome = _outcome(world, pose, s, length, abs(float(error)), touched, physics.time > timeout)
        if outcome:
            commands.append((0.0, 0.0))
            break
        wanted = np.clip(
            speed * pursuit_curvature(pose, _target(route, s + _LOOK_AHEAD, length)), -fastest_turn, fastest_turn
        )
        command = (speed, float(np.clip(gain * wanted, -fastest_turn, fastest_turn)))
        commands.append(command)
        physics.command(*command)
        physics.step()
        touched |= set(physics.touched)
        previous, pose = pose, physics.planar_pose
        gain = _updated_gain(gain, previous, pose, command)
    return Drive(
        times=np.array(times),
        base_to_world=np.array(bases),
        camera_to_world=np.array(cameras),
        qpos=np.array(positions),
        commands=np.array(commands),
        cross_track=np.array(errors),
        progress=np.array(feet),
        touched=tuple(sorted(touched)),
        outcome=outcome,
    )


def _outcome(world: World, pose: Array, s: float, length: float, error: float, touched: set[str], late: bool) -> str:
    """Why the drive ends here; empty while it goes on."""
    if touched:
        return "touched"
    # A route that passes its own goal early is not done there.
    if np.linalg.norm(pose[:2] - world.goal[:2]) < GOAL_RADIUS and s > length - 2 * GOAL_RADIUS:
        return "goal"
    if error > world.half_width:
        return "off_corridor"
    return "timeout" if late else ""


def _target(route: Array, s: float, length: float) -> Array:
    """The point of the route at s [m]; past its end the route goes on straight."""
    if s <= length:
        return point_at(route, s)
    direction = route[-1] - point_at(route, length - 1.0)
    return route[-1] + direction / max(float(np.linalg.norm(direction)), 1e-9) * (s - length)


def _updated_gain(gain: float, previous: Array, pose: Array, command: tuple[float, float]) -> float:
    """Follows the ratio of path curvature commanded to achieved, which for skid steering is not 1."""
    turned = float(heading_error(pose[2], previous[2])) / CONTROL_PERIOD
    moved = float(np.linalg.norm(pose[:2] - previous[:2])) / CONTROL_PERIOD
    v, yaw_rate = command
    if abs(yaw_rate) < _GAIN_MIN_YAW_RATE or abs(turned) < _GAIN_MIN_YAW_RATE or yaw_rate * turned < 0 or moved < 0.2:
        return gain
    ratio = (yaw_rate / v) / (turned / moved)
    return float(np.clip(gain + _GAIN_RATE * (ratio - gain), *_GAIN_RANGE))
