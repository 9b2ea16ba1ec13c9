"""Shots of a scene for the review video and its pictures.

A *shot* is a robot configuration (MuJoCo's qpos; None for the initial one) and a camera pose (OpenCV).
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from twin.env.drivers import RecordedDrive
from twin.env.mujoco_renderer import SceneCamera, chase_poses
from twin.geometry.cameras import Cameras
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, point_at
from twin.types import Array, Image

Shot = tuple[Array | None, Array]

_OVERVIEW_BEHIND, _OVERVIEW_ABOVE, _OVERVIEW_AHEAD = 9.0, 7.0, 10.0  # [m] camera position and look-at point
_OVERVIEW_POSITIONS = (0.0, 0.45)  # of the overview, as shares of the route length


def frame_indices(count: int, every: int) -> list[int]:
    indices = list(range(0, count, every))
    return indices if indices[-1] == count - 1 else [*indices, count - 1]


def overview_pose(route: Array, s: float) -> Array:
    """Camera pose behind and above the point at arc length s [m] of a route (m, 3), looking along it."""
    ahead, here = point_at(route, s + _OVERVIEW_AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: use its last heading
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _OVERVIEW_BEHIND * along + [0.0, 0.0, _OVERVIEW_ABOVE], here + _OVERVIEW_AHEAD * along)


def route_shots(route: Array) -> list[Shot]:
    """Shots of the scene from above the route's start and from further along; the robot is at its initial pose."""
    length = float(arc_lengths(route)[-1])
    return [(None, overview_pose(route, share * length)) for share in _OVERVIEW_POSITIONS]


def camera_shots(cameras: Cameras) -> list[Shot]:
    """Shots from two of the filmed cameras, for a scene without a route."""
    n = len(cameras)
    return [(None, cameras.camera_to_world[i]) for i in dict.fromkeys((n // 4, 3 * n // 4))]


def chase_shots(drive: RecordedDrive, every: int) -> list[Shot]:
    """Shots of a drive from behind, every `every` control steps and at the last one."""
    poses = chase_poses(drive.base_to_world)
    return [(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), every)]


def render_shots(world: World, shots: list[Shot], size: tuple[int, int]) -> Iterator[Image]:
    """Renders shots in order. All share one camera, because building it takes seconds."""
    if not shots:
        return
    camera = SceneCamera(world, size)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for qpos, pose in shots:
        yield camera.render(data.qpos if qpos is None else qpos, pose)
