"""Pictures of a scene from free camera poses with `mujoco_warp`'s ray caster; needs no OpenGL and no display.

The scene is rendered twice: visual geometry (ground, visual mesh, robot), and the convex collision parts with their
ids. Visible parts are blended over the first picture, half transparent and with outlines. The *chase camera* follows
the robot from behind and above.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.config import ObstacleConfig
from twin.env.obstacle_models import OBSTACLE_GROUP
from twin.env.obstacles import add_obstacles, place
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.poses import look_at
from twin.mjcf.world import World
from twin.types import Array, Image

_FOVY = 50.0  # [°]
_BEHIND, _ABOVE, _AHEAD = 3.0, 1.6, 2.0  # [m] camera position and look-at point relative to the robot
_SMOOTHING = 0.15  # low-pass gain of the camera heading per control step (0.1 s)
_VISUAL_GROUPS = [0, 1, 2, OBSTACLE_GROUP]
_PART_GROUPS = [3]
_PART_ALPHA = 0.45
_EDGE_RGB = (20, 20, 30)
# Parts lie close to the visual mesh; a part up to this far behind the visible surface counts as visible.
_OCCLUSION_TOLERANCE = 0.6  # [m]


class SceneCamera:
    """Renders a world from free camera poses."""

    def __init__(
        self,
        world: World,
        size: tuple[int, int],
        obstacles: Sequence[ObstacleConfig] = (),
    ) -> None:
        """Compiles the scene with obstacles and a free camera for pictures of `size` (width, height) [px].

        `obstacles` may then be set to some of them; the others are not shown.
        """
        import mujoco_warp as mjw  # slow to import

        self._mjw = mjw
        spec = mujoco.MjSpec.from_file(str(world.model_path))
        self.obstacles = tuple(obstacles)
        add_obstacles(spec, self.obstacles, world)
        spec.worldbody.add_camera(name="free", fovy=_FOVY)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.size = size
        self._camera = self.model.camera("free").id
        mujoco.mj_forward(self.model, self.data)
        self._device_model = mjw.put_model(self.model)
        self._device_data = mjw.put_data(self.model, self.data)
        common = {"cam_res": size, "cam_active": ["free"], "render_rgb": True, "render_depth": True}
        self._visual = mjw.create_render_context(
            self.model,
            enabled_geom_groups=_VISUAL_GROUPS,
            render_skybox=True,
            use_shadows=True,
            enable_backface_culling=False,
            **common,
        )
        self._parts = None
        if np.isin(self.model.geom_group, _PART_GROUPS).any():
            self._parts = mjw.create_render_context(
                self.model, enabled_geom_groups=_PART_GROUPS, render_seg=True, **common
            )
        # Warp compiles kernels at first launch. Compiling two at once in two threads of a process corrupts them
        # (observed: pictures without ground), so each pass runs once here, in sequence.
        for context in (self._visual, self._parts):
            if context is not None:
                self._render_pass(context)

    def render(self, qpos: Array, camera_to_world: Array, time: float = 0.0) -> Image:
        """Renders the scene with the robot at `qpos` at a time [s] from an OpenCV camera pose, shape (h, w, 3)."""
        self.data.qpos[:] = qpos
        place(self.obstacles, self.data, time)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        pose = opencv_to_mujoco(camera_to_world)
        self.data.cam_xpos[self._camera] = pose[:3, 3]
        self.data.cam_xmat[self._camera] = pose[:3, :3].ravel()
        device = self._device_data
        for name in ("geom_xpos", "cam_xpos", "light_xpos", "light_xdir"):
            getattr(device, name).assign(getattr(self.data, name)[None].astype(np.float32))
        for name in ("geom_xmat", "cam_xmat"):
            getattr(device, name).assign(getattr(self.data, name).reshape(1, -1, 3, 3).astype(np.float32))
        if self._parts is None:
            return self._render_pass(self._visual)[0]
        # Warp's CPU kernels run on one thread each and release the GIL.
        with ThreadPoolExecutor(2) as pool:
            (rgb, depth, _), (part_rgb, part_depth, identity) = pool.map(self._render_pass, (self._visual, self._parts))
        return blend_parts(rgb, depth, part_rgb, part_depth, identity)

    def _render_pass(self, context) -> tuple[Image, Array, NDArray[np.int32]]:
        self._mjw.refit_bvh(self._device_model, self._device_data, context)
        self._mjw.render(self._device_model, self._device_data, context)
        width, height = self.size
        packed = context.rgb_data.numpy()[0].reshape(height, width)
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.uint8)
        depth = context.depth_data.numpy()[0].reshape(height, width)
        identity = context.seg_data.numpy()[0, : 1 if context.seg_data.shape[1] == 1 else None, 0]
        return rgb, depth, identity.reshape(height, width) if identity.size > 1 else np.full((height, width), -1)


def blend_parts(rgb: Image, depth: Array, part_rgb: Image, part_depth: Array, identity: NDArray) -> Image:
    """Blends visible collision parts, with outlines, over a picture (h, w, 3); z-depths [m] have shape (h, w).

    `depth` is 0 where nothing is hit; `identity` is the id of the visible part, −1 for none.
    """
    visible = (identity >= 0) & ((depth <= 0) | (part_depth <= depth + _OCCLUSION_TOLERANCE))
    edge = np.zeros_like(visible)
    edge[:, 1:] |= identity[:, 1:] != identity[:, :-1]
    edge[1:] |= identity[1:] != identity[:-1]
    out = rgb.astype(np.float32)
    out[visible] = (1 - _PART_ALPHA) * out[visible] + _PART_ALPHA * part_rgb[visible]
    line = edge & visible
    out[line] = 0.4 * out[line] + 0.6 * np.array(_EDGE_RGB)
    return out.astype(np.uint8)


class ChaseCamera:
    """Poses of a camera behind and above a robot; it looks along the robot's low-passed heading."""

    def __init__(self, base_to_world: Array) -> None:
        """Starts an episode at the robot's pose, shape (4, 4)."""
        forward = base_to_world[:2, 0]
        self._direction = forward / np.linalg.norm(forward)

    def follow(self, base_to_world: Array) -> Array:
        """Returns the camera's pose (OpenCV) at the next control step, shape (4, 4)."""
        direction = self._direction + _SMOOTHING * (base_to_world[:2, 0] - self._direction)
        self._direction = direction / np.linalg.norm(direction)
        along = np.array([*self._direction, 0.0])
        eye = base_to_world[:3, 3] - _BEHIND * along + [0.0, 0.0, _ABOVE]
        return look_at(eye, base_to_world[:3, 3] + _AHEAD * along + [0.0, 0.0, 0.2])


def chase_poses(base_to_world: Array) -> Array:
    """Camera poses (OpenCV) behind and above a robot at k successive control steps, shape (k, 4, 4)."""
    camera = ChaseCamera(base_to_world[0])
    return np.array([camera.follow(base) for base in base_to_world])
