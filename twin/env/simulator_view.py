"""What MuJoCo itself would show a policy: the extracted mesh in its filmed colours, the ground, obstacles, the robot.

This is the standard pipeline that a radiance field is compared with. `mujoco_warp`'s ray caster draws it, through the
same camera as the field's pictures; its light is the model's own, whatever lighting is asked for. What the camera is
built into is left out, as it is there.
"""

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.cores import cores
from twin.env.camera_effects import CameraEffects
from twin.env.obstacle_shapes import OBSTACLE_GROUP
from twin.env.obstacle_view import camera_intrinsics, camera_pose
from twin.env.weather import Weather
from twin.geometry.cameras import opencv_to_mujoco, pixel_grid, unproject
from twin.mjcf.husky import ROBOT_GROUP
from twin.mjcf.husky_look import camera_parts
from twin.nerf.rendering import FAR, Rendering

Array = NDArray[np.float64]

_CAMERA = "front"
_GROUPS = [0, 1, 2, OBSTACLE_GROUP]  # what is looked at; collision parts are not
_LOADED = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")


class SimulatorView:
    """Renders worlds as their front cameras would see them in MuJoCo; takes what `Overlay` takes."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], worlds: int) -> None:
        """
        Args:
            model: As the worlds', with what `episode_spec` keeps of looks.
            size: Width, height of the pictures [px].
            worlds: How many worlds a call renders at most.
        """
        self.size = size
        self._camera = model.camera(_CAMERA).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        self._rays = unproject(pixel_grid(*size), self.intrinsics)
        model = copy.copy(model)
        model.geom_group[camera_parts(model, self._camera)] = ROBOT_GROUP  # which is not looked at
        # One after the other, as Warp compiles kernels when they are first used.
        self._painters = [_Painter(model, size, self._rays) for _ in range(min(worlds, cores()))]
        self._pool = ThreadPoolExecutor(len(self._painters))

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Any = None,
        effects: Sequence[CameraEffects] | None = None,
        weather: Sequence[Weather | None] = (),
    ) -> Rendering:
        """What the front camera of every world sees; arguments as in `Overlay.render`, the lighting has no effect."""
        poses = np.stack([camera_pose(data, self._camera) for data in datas])
        if effects is not None:
            poses = np.stack([e.shaken(p, d.time) for e, p, d in zip(effects, poses, datas, strict=True)])
        width, height = self.size
        rgb = np.empty((len(datas), height, width, 3), np.float32)
        depth = np.empty((len(datas), height, width), np.float32)

        def paint(number: int) -> None:
            for k in range(number, len(datas), len(self._painters)):
                rgb[k], depth[k] = self._painters[number].draw(datas[k], poses[k])

        list(self._pool.map(paint, range(len(self._painters))))
        for k, sky in enumerate(weather):
            if sky:
                far = np.where(depth[k] > 0.0, depth[k], np.float32(FAR))
                rgb[k] = sky.over(rgb[k], far, self._rays, poses[k])
        for k, effect in enumerate(effects or ()):
            rgb[k] = effect.exposed(rgb[k], depth[k], poses[k], datas[k].time, self._rays, self.intrinsics)
        return Rendering(rgb, depth, (depth > 0.0).astype(np.float32))


class _Painter:
    """What one thread draws with."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], rays: Array) -> None:
        import mujoco_warp as mjw  # slow to import
        import warp as wp

        self._mjw, self._wp, self._model, self._data = mjw, wp, model, mujoco.MjData(model)
        self._size, self._camera = size, model.camera(_CAMERA).id
        mujoco.mj_forward(model, self._data)
        with wp.ScopedDevice("cpu"):
            self._device_model, self._device_data = mjw.put_model(model), mjw.put_data(model, self._data)
            self._context = mjw.create_render_context(
                model,
                cam_res=size,
                cam_active=[_CAMERA],
                render_rgb=True,
                render_depth=True,
                enabled_geom_groups=_GROUPS,
                render_skybox=True,
                use_shadows=True,
                enable_backface_culling=False,
            )
        # The camera's own rays are those of its nominal lens; these are the field's.
        own = (rays * [1.0, -1.0, -1.0]).reshape(-1, 3)
        self._context.ray.assign((own / np.linalg.norm(own, axis=1, keepdims=True)).astype(np.float32))
        self.draw(self._data, camera_pose(self._data, self._camera))  # compiles

    def draw(self, data: mujoco.MjData, pose: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours (h, w, 3) in [0, 1] and z-depth (h, w) [m], 0 where nothing is, from an OpenCV pose."""
        mine = self._data
        mine.qpos[:], mine.mocap_pos[:], mine.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self._model, mine)
        mujoco.mj_camlight(self._model, mine)
        camera = opencv_to_mujoco(pose)
        mine.cam_xpos[self._camera], mine.cam_xmat[self._camera] = camera[:3, 3], camera[:3, :3].ravel()
        with self._wp.ScopedDevice("cpu"):
            for name in _LOADED:
                array = getattr(mine, name)
                rows = array.reshape(1, -1, 3, 3) if name.endswith("xmat") else array[None]
                getattr(self._device_data, name).assign(rows.astype(np.float32))
            self._mjw.refit_bvh(self._device_model, self._device_data, self._context)
            self._mjw.render(self._device_model, self._device_data, self._context)
        width, height = self._size
        packed = self._context.rgb_data.numpy()[0].reshape(height, width)
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.float32) / 255.0
        return rgb, self._context.depth_data.numpy()[0].reshape(height, width)
