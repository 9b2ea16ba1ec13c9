"""The road as the robot drives it: the true ground and all that is solid, on a day after the film was made.

Tasks are the twin's own, by name, and mean the same places: the *route* is the path that the camera was filmed along,
which is what a twin of the film takes for its route, here as it truly was. So are the rules of a trial, which are those
of `twin.env.tasks`.
"""

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.assets.route import route_length, smooth_route
from twin.config import MjcfConfig
from twin.env.dm_physics import DrivePhysics
from twin.env.episode_obstacles import EpisodeObstacles
from twin.env.options import Options
from twin.env.stretches import Stretch, find_task
from twin.env.tasks import Drive
from twin.mjcf import husky
from twin.mjcf.export import rest_pose
from twin.mjcf.world import World, heading_at, point_at
from twin.reality import place as places
from twin.reality import world as worlds
from twin.reality.film import Plan, trajectory
from twin.reality.robot import Robot
from twin.reality.route import Route, ground_height
from twin.reality.things import Place, Thing

Array = NDArray[np.float64]

_REACH = 1.5  # [m] beyond the corridor's edge: as in the twin, what lies further is never touched
_SAME_LENGTH = 0.98  # share of the longest film's path from which on the first film counts


def route(plan: Plan | None = None, line: Route | None = None) -> Array:
    """The filmed path on the true ground [m], shape (m, 3).

    Of several films the first of those within 2 % of the longest, as a build chooses.
    """
    plan, line = plan or Plan(), line or Route()
    paths = [smooth_route(trajectory(plan, line, lighting)[1][:, :3, 3]) for lighting in plan.lightings]
    lengths = np.array([route_length(path) for path in paths])
    xy = paths[int(np.argmax(lengths >= _SAME_LENGTH * lengths.max()))]
    return np.column_stack([xy, ground_height(line, xy)])


@cache
def place() -> Place:
    """The place on the day of the trials."""
    return places.build(later=True)


class Road:
    """One task of the real test."""

    def __init__(self, task: str, robot: Robot, options: Options) -> None:
        """
        Args:
            task: As in the twin: straight, right_turn or route.
            robot: Drives.
            options: What a policy's numbers mean; its pictures are none of the road's business.

        Raises:
            InputError: no such task.
        """
        line = route()
        half_width = MjcfConfig().half_width
        yaw = float(heading_at(line, 0.0))
        start, quaternion = rest_pose(lambda xy: ground_height(place().route, xy), line[0, :2], yaw)
        self.world = World(line, half_width, (*start.tolist(), yaw), Path(), robot=robot.params)
        self.stretch: Stretch = find_task(task, self.world)
        spec = worlds.solids(self._near(half_width + _REACH))
        husky.set_options(spec, robot.params)
        husky.add_husky(spec, start, quaternion, robot.params)
        self.model = spec.compile()
        _mount(self.model, robot.camera_turn)
        self.physics = DrivePhysics.of(self.model, robot.params)
        none = EpisodeObstacles((), self.world, self.stretch)
        self.drive = Drive(self.world, self.stretch, options, none, self.model)

    def intrinsics(self, size: tuple[int, int]) -> Array:
        """fx, fy, cx, cy [px] of the robot's camera with pictures of a size (width, height), shape (4,)."""
        return np.array(self.world.robot.camera().resized(size).intrinsics)

    def _near(self, reach: float) -> Place:
        """The place with nothing solid further than `reach` [m] from the stretch."""
        s = self.stretch
        along = cKDTree(point_at(self.world.route[:, :2], np.arange(s.start, s.end + 0.1, 0.1)))

        def near(thing: Thing) -> bool:
            return any(
                along.query(one.centre[:2])[0] - np.hypot(one.half[0], one.half[1]) <= reach for one in thing.solids
            )

        return Place(place().route, [thing for thing in place().things if near(thing)], [])


def _mount(model: mujoco.MjModel, turn: tuple[float, float, float]) -> None:
    """Turns the front camera about its axes by angles [°]."""
    camera = model.camera("front").id
    rotation, quaternion = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.deg2rad(turn), "xyz")
    mujoco.mju_mulQuat(quaternion, model.cam_quat[camera], rotation)
    model.cam_quat[camera] = quaternion
