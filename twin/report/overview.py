"""Pictures of the built scene for the page: what MuJoCo loads, from a bird's eye, with the solid parts drawn over."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.chase import SceneCamera
from twin.geometry.poses import look_at
from twin.mjcf.world import SCENE_XML, World, arc_lengths, point_at
from twin.report.studio import Studio
from twin.scene import SceneDir

Array = NDArray[np.float64]

_SIZE = (800, 450)  # [px]
_BACK, _UP, _AHEAD = 9.0, 7.0, 10.0  # [m] behind and above the place looked from, and ahead of it where we look


def bird_pose(route: Array, s: float) -> Array:
    """camera_to_world behind and above the point at arc length s [m] of a route (m, 3), looking along it."""
    ahead, here = point_at(route, s + _AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: look as the last piece goes
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _BACK * along + [0.0, 0.0, _UP], here + _AHEAD * along)


def keep_overviews(studio: Studio, scene: SceneDir, world: World | None) -> None:
    """Keeps one picture of the scene from its start and one from halfway; without a route one of the whole."""
    folder = scene.stage("mjcf")
    if not (folder / SCENE_XML).exists():
        return
    if world is None:
        # Only its model is drawn; there is no route to know.
        world = World(np.zeros((2, 3)), 0.0, (0.0, 0.0, 0.0, 0.0), np.ones(4), folder)
        middle = studio.cameras.positions.mean(0)
        poses = {
            "the scene that MuJoCo loads": look_at(studio.cameras.positions[0] + [0.0, 0.0, 1.0], middle * [1, 1, 0])
        }
    else:
        length = float(arc_lengths(world.route)[-1])
        poses = {
            "the scene that MuJoCo loads, from above its start; solid parts drawn over": bird_pose(world.route, 0.0),
            "further along the route": bird_pose(world.route, 0.45 * length),
        }
    camera = SceneCamera(world, _SIZE)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for number, (caption, pose) in enumerate(poses.items()):
        studio.keep(f"scene_{number}", "mjcf", caption, camera.render(data.qpos, pose))
