"""Pictures of what MuJoCo loads: a bird's eye view of the place, and the drive from behind.

A *shot* is the robot's configuration (MuJoCo's qpos) and the pose of the camera that sees it.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.chase import SceneCamera, chase_poses, frame_indices
from twin.env.follower import Drive
from twin.geometry.cameras import Cameras
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, point_at
from twin.report.panels import Picture

Array = NDArray[np.float64]
Shot = tuple[Array | None, Array]

_BACK, _UP, _AHEAD = 9.0, 7.0, 10.0  # [m] behind and above the place looked from, and ahead of it where we look
_STATIONS = (0.0, 0.45)  # shares of the route where the bird is


def bird_pose(route: Array, s: float) -> Array:
    """camera_to_world behind and above the point at arc length s [m] of a route (m, 3), looking along it."""
    ahead, here = point_at(route, s + _AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: look as the last piece goes
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _BACK * along + [0.0, 0.0, _UP], here + _AHEAD * along)


def route_shots(route: Array) -> list[Shot]:
    """The place from above its start and from further along, the robot where the scene puts it."""
    length = float(arc_lengths(route)[-1])
    return [(None, bird_pose(route, share * length)) for share in _STATIONS]


def camera_shots(cameras: Cameras) -> list[Shot]:
    """The place as two of the cameras saw it, for a scene without a route."""
    n = len(cameras)
    return [(None, cameras.camera_to_world[i]) for i in dict.fromkeys((n // 4, 3 * n // 4))]


def chase_shots(drive: Drive, every: int) -> list[Shot]:
    """The drive from behind, every few control steps and at its last instant."""
    poses = chase_poses(drive.base_to_world)
    return [(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), every)]


def pictures_of(world: World, shots: list[Shot], size: tuple[int, int]) -> Iterator[Picture]:
    """Draws shots in order, solid parts over what is seen. One camera serves all: building it takes seconds."""
    if not shots:
        return
    camera = SceneCamera(world, size)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for qpos, pose in shots:
        yield camera.render(data.qpos if qpos is None else qpos, pose)
