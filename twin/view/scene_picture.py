"""Pictures of a scene from a free camera: the radiance field under a lighting, with the robot and obstacles in it.

Without `add_objects`, only the field is rendered. After it, `twin.env.compositor` also draws robot and obstacles in
each picture for which an `ObjectState` with their positions is given.
"""

import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from twin.config import ObstacleConfig
from twin.env.episode_lighting import EpisodeLighting
from twin.geometry.cameras import Rendering, Viewpoints, opencv_to_mujoco, pixel_grid, unproject
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.nerf.sun import relit
from twin.types import Array, Array32

if TYPE_CHECKING:
    from twin.env.compositor import Compositor

_CAMERA = "view"  # name of the free camera in the model
# Number of cached compositors: for coarse and fine pictures of four pages. Creating one takes seconds.
_MAX_COMPOSITORS = 8


@dataclass(frozen=True)
class FreeCamera:
    """A pinhole camera."""

    camera_to_world: Array
    """OpenCV axes, shape (4, 4)."""
    intrinsics: Array
    """fx, fy, cx, cy [px], shape (4,)."""
    size: tuple[int, int]
    """Width, height [px]."""

    @staticmethod
    def of_fov(camera_to_world: Array, fov: float, size: tuple[int, int]) -> "FreeCamera":
        """A camera with a vertical angle of view [rad] and its principal point in the center."""
        focal = size[1] / 2.0 / np.tan(fov / 2.0)
        return FreeCamera(camera_to_world, np.array([focal, focal, size[0] / 2.0, size[1] / 2.0]), size)


@dataclass(frozen=True)
class ObjectState:
    """Positions of robot and obstacles."""

    qpos: Array
    mocap_pos: Array
    mocap_quat: Array

    @staticmethod
    def of(data: mujoco.MjData) -> "ObjectState":
        """A copy of the positions in `data`."""
        return ObjectState(data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy())


class ScenePicture:
    """Renders a scene from free cameras; several threads may call it."""

    def __init__(self, field: BakedField) -> None:
        self.field = field
        self._model: mujoco.MjModel | None = None
        self._compositors: OrderedDict[tuple[int, int], Compositor] = OrderedDict()
        self._lock = threading.Lock()

    def add_objects(self, world: World, obstacles: tuple[ObstacleConfig, ...]) -> None:
        """Adds the robot of a world, and obstacles, to the pictures; an `ObjectState` lists obstacles in this order."""
        from twin.env.obstacles import add_obstacles  # slow to import

        spec = world.spec(keeps_part=lambda name: False, visuals=False)  # convex parts are not drawn
        add_obstacles(spec, obstacles, world)
        spec.worldbody.add_camera(name=_CAMERA)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        with self._lock:
            self._model, self._data = model, data
            self._compositors.clear()

    def render(self, camera: FreeCamera, lighting: EpisodeLighting, objects: ObjectState | None = None) -> Rendering:
        """Renders one picture, with the lighting's fog."""
        with self._lock:
            if objects is None or self._model is None:
                view = Viewpoints.of(camera.camera_to_world, camera.intrinsics, camera.size)
                out = self.field.render(view, lighting.start)
                if lighting.sunlight:
                    rays = unproject(pixel_grid(*camera.size), camera.intrinsics)
                    pose = camera.camera_to_world
                    out.rgb[0] = relit(out.rgb[0], out.depth[0], rays, pose, lighting.sunlight)
            else:
                out = self._render_objects(camera, lighting, objects)
            if lighting.fog is not None and lighting.fog.extinction:
                out.rgb[0] = lighting.fog.apply(
                    out.rgb[0], out.depth[0] * _ray_lengths(camera.size, tuple(camera.intrinsics))
                )
        return out

    def _render_objects(self, camera: FreeCamera, lighting: EpisodeLighting, objects: ObjectState) -> Rendering:
        compositor = self._compositor(camera)
        data = self._data
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = objects.qpos, objects.mocap_pos, objects.mocap_quat
        mujoco.mj_kinematics(data.model, data)
        pose, number = opencv_to_mujoco(camera.camera_to_world), data.model.camera(_CAMERA).id
        data.cam_xpos[number], data.cam_xmat[number] = pose[:3, 3], pose[:3, :3].ravel()
        return compositor.render([data], lighting.start, sunlight=[lighting.sunlight])

    def _compositor(self, camera: FreeCamera) -> "Compositor":
        from twin.env.compositor import Compositor

        if camera.size not in self._compositors:
            assert self._model is not None
            self._compositors[camera.size] = Compositor(self._model, self.field, camera.size, camera=_CAMERA)
            if len(self._compositors) > _MAX_COMPOSITORS:
                self._compositors.popitem(last=False)
        self._compositors.move_to_end(camera.size)
        self._compositors[camera.size].set_intrinsics(camera.intrinsics)
        return self._compositors[camera.size]


@lru_cache(4)
def _ray_lengths(size: tuple[int, int], intrinsics: tuple[float, ...]) -> Array32:
    """Length of each pixel's ray up to z-depth 1, shape (height, width)."""
    rays = unproject(pixel_grid(*size), np.array(intrinsics))
    return np.linalg.norm(rays, axis=-1).astype(np.float32)
