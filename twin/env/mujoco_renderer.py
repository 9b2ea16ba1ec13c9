"""Pictures of a MuJoCo scene by `mujoco_warp`'s ray caster on the CPU, without OpenGL.

`SceneRenderer` renders the front camera's view with MuJoCo's own shading, as a baseline for radiance fields.
`CollisionCaster` casts rays at the convex collision parts. `SceneCamera` renders from free poses, and draws the parts
half transparent over the visual geometry.
The *chase camera* follows the robot from behind and above.
"""

import copy
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.assets.gaussians import Gaussians
from twin.config import ObstacleConfig
from twin.env.obstacles import OBSTACLE_GROUP, add_obstacles, place
from twin.env.physics import camera_pose
from twin.env.picture_effects import CameraNoise, Weather
from twin.geometry.cameras import FAR, Rendering, opencv_to_mujoco, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.mjcf.husky import ROBOT_COLLISION_GROUP
from twin.mjcf.husky_visuals import camera_mount_geoms
from twin.mjcf.world import GROUND_GROUP, PART_GROUP, World
from twin.runtime import available_cores, log_line
from twin.types import Array, Array32, Image
from twin.warp_runtime import wp

FRONT_CAMERA = "front"
"""Name of the policy's camera in a model."""

# Arrays of `MjData` on which a picture depends.
_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
_SCENE_SETTINGS: dict[str, Any] = {  # collision parts are not drawn
    "enabled_geom_groups": [0, 1, 2, OBSTACLE_GROUP],
    "render_skybox": True,
    "use_shadows": True,
    "enable_backface_culling": False,
}
_SPLAT_SETTINGS = _SCENE_SETTINGS | {"enabled_geom_groups": [GROUND_GROUP, 1, OBSTACLE_GROUP]}  # no visual mesh
_GROUND_BELOW_SPLATS = 0.15  # [m] the ground is lowered by this, so that it shows only through gaps between splats


def camera_intrinsics(model: mujoco.MjModel, camera: int, size: tuple[int, int]) -> Array:
    """fx, fy, cx, cy [px] of a camera of the model for pictures of a size (width, height), shape (4,)."""
    width, height = size
    if model.cam_sensorsize[camera, 1] > 0.0:
        fx, fy, right, up = model.cam_intrinsic[camera] / np.tile(model.cam_sensorsize[camera], 2)
        # MuJoCo measures the principal point from the center of the image, positive to the left and up.
        return np.array([fx * width, fy * height, width / 2 - right * width, height / 2 - up * height])
    focal = height / 2 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    return np.array([focal, focal, width / 2, height / 2])


def camera_poses(datas: Sequence[mujoco.MjData], camera: int, noise: Sequence[CameraNoise] | None) -> Array:
    """Poses camera_to_world of a camera in n envs, shape (n, 4, 4); `noise`, if given, adds its vibration."""
    poses = np.stack([camera_pose(data, camera) for data in datas])
    if noise is None:
        return poses
    return np.stack([n.perturb_pose(pose, data.time) for n, pose, data in zip(noise, poses, datas, strict=True)])


class RayCaster:
    """`mujoco_warp`'s ray caster for one model on the CPU, for rays that the caller chooses. Not thread-safe."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, **context: Any) -> None:
        """`data` is a state after `mj_forward`; `context` is passed to `mujoco_warp.create_render_context`."""
        import mujoco_warp as mjw  # slow to import

        self._mjw = mjw
        # Warp's default device is global to the process. Threads set it to the CPU and restore it, which is safe in
        # parallel only if it is the CPU before, too; on a machine with a GPU, it is the GPU until this line.
        wp.set_device("cpu")
        self._model, self._data = mjw.put_model(model), mjw.put_data(model, data)
        self._context = mjw.create_render_context(model, render_rgb=True, render_depth=True, **context)
        self.max_rays: int = self._context.ray.shape[0]

    def set_poses(self, **poses: Array) -> None:
        """Sets arrays of the state, such as `geom_xpos` (n, 3) or `geom_xmat` (n, 3, 3), and updates the BVH."""
        for name, values in poses.items():
            array = getattr(self._data, name).numpy()
            array[0] = values.reshape(array.shape[1:])
        with wp.ScopedDevice("cpu"):
            self._mjw.refit_bvh(self._model, self._data, self._context)

    def set_rays(self, rays: Array32) -> None:
        """Sets the unit rays (k, 3) in MuJoCo's camera axes; k is at most `max_rays`."""
        self._context.ray.numpy()[: len(rays)] = rays
        # The context has room for the rays of a whole picture; only the first `total_rays` are cast.
        self._context.total_rays = len(rays)

    def cast(self) -> tuple[Array32, Array32]:
        """Casts the rays; returns colors (k, 3) in [0, 255] and z-depth (k,) [m], 0 where nothing is hit."""
        with wp.ScopedDevice("cpu"):
            self._mjw.render(self._model, self._data, self._context)
        count = self._context.total_rays
        packed = self._context.rgb_data.numpy()[0, :count]
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.float32)
        return rgb, self._context.depth_data.numpy()[0, :count].copy()

    def hit_geoms(self) -> NDArray[np.int32]:
        """Indices of the geoms that the last cast's rays hit, shape (k,), −1 for none; needs `render_seg=True`."""
        return self._context.seg_data.numpy()[0, : self._context.total_rays, 0].copy()


def mujoco_rays(rays: Array) -> Array32:
    """Unit rays in MuJoCo's camera axes from OpenCV rays (..., 3), shape (n, 3)."""
    flipped = (rays * [1.0, -1.0, -1.0]).reshape(-1, 3)
    return (flipped / np.linalg.norm(flipped, axis=1, keepdims=True)).astype(np.float32)


# ---- convex parts

NOTHING, ON_GROUND = -1, -2
"""Numbers that `CollisionCaster` returns for rays that hit no part."""
_PARTS_PER_MODEL = 2000


class CollisionCaster:
    """Casts rays at the convex parts of a scene and, if wanted, at its ground.

    `mujoco_warp` lists all pairs of a model's geoms, which takes 9 GB for the 12,500 parts of a kilometer. So the parts
    are spread over several models.
    """

    def __init__(self, world: World, size: tuple[int, int], intrinsics: Array, ground: bool = False) -> None:
        """`size`: width, height [px] of a picture with the intrinsics fx, fy, cx, cy [px]."""
        self.size = size
        names = [geom.name for geom in world.spec(visuals=False).geoms if geom.group == PART_GROUP]
        self.count = len(names)
        numbers = {name: number for number, name in enumerate(names)}
        rays = mujoco_rays(unproject(pixel_grid(*size), intrinsics))
        self._casters = []
        for start in range(0, max(len(names), int(ground)), _PARTS_PER_MODEL):
            spec = world.spec(frozenset(names[start : start + _PARTS_PER_MODEL]).__contains__, visuals=False)
            spec.worldbody.add_camera(name="free")
            model = spec.compile()
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            caster = RayCaster(
                model,
                data,
                cam_res=size,
                cam_active=["free"],
                render_seg=True,
                use_textures=False,
                enabled_geom_groups=[PART_GROUP, GROUND_GROUP] if ground else [PART_GROUP],
            )
            caster.set_rays(rays)
            hit = [numbers.get(model.geom(geom).name, ON_GROUND) for geom in range(model.ngeom)]
            identities = np.array([*hit, NOTHING])  # the index of no geom is −1
            self._casters.append((caster, data, model.camera("free").id, identities))
        if self._casters:
            self.cast(np.eye(4))  # compiles the kernels, see `_SceneWorker`

    def cast(self, camera_to_world: Array) -> tuple[Array32, Array32, NDArray[np.int64]]:
        """Casts the rays of a picture from an OpenCV camera pose.

        Returns colors (height, width, 3) in [0, 255], z-depth (height, width) [m], 0 where nothing is hit, and the
        number of the part that is hit (height, width), ON_GROUND or NOTHING.
        """
        width, height = self.size
        if not self._casters:
            empty = np.zeros((height, width), np.float32)
            return np.zeros((height, width, 3), np.float32), empty, np.full(empty.shape, NOTHING)
        pose = opencv_to_mujoco(camera_to_world)
        found = []
        for caster, data, camera, identities in self._casters:
            data.cam_xpos[camera], data.cam_xmat[camera] = pose[:3, 3], pose[:3, :3].ravel()
            caster.set_poses(cam_xpos=data.cam_xpos, cam_xmat=data.cam_xmat)
            found.append((*caster.cast(), identities[caster.hit_geoms()]))
        depths = np.stack([depth for _, depth, _ in found])
        nearest = np.where(depths > 0.0, depths, np.inf).argmin(0)
        rgb, depth, identity = (
            np.take_along_axis(np.stack(one), nearest.reshape(1, -1, *[1] * (one[0].ndim - 1)), 0)[0]
            for one in zip(*found, strict=True)
        )
        return rgb.reshape(height, width, 3), depth.reshape(height, width), identity.reshape(height, width)


# ---- the whole scene


class SceneRenderer:
    """Renders the front cameras' views with MuJoCo's own shading; interface of `Compositor`.

    Obstacles and the robot are lit by the model's own lights. The place is drawn either as ground and visual mesh, in
    the filmed colors, or as Gaussian splats. Splats and geoms occlude each other, and the ground shows through the gaps
    between splats.
    """

    def __init__(
        self, model: mujoco.MjModel, size: tuple[int, int], max_envs: int, splats: Gaussians | None = None
    ) -> None:
        """`model` must come from `World.spec` with visual geometry; `splats`, if given, replace its visual mesh.

        The other arguments are those of `Compositor`.
        """
        self.size = size
        self._camera = model.camera(FRONT_CAMERA).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        self._rays = unproject(pixel_grid(*size), self.intrinsics)
        model = copy.copy(model)
        model.geom_group[camera_mount_geoms(model, self._camera)] = ROBOT_COLLISION_GROUP  # not drawn
        if splats is not None:
            model.geom_pos[model.geom("ground").id, 2] -= _GROUND_BELOW_SPLATS
        threads = min(max_envs, available_cores())
        settings = _SCENE_SETTINGS if splats is None else _SPLAT_SETTINGS | splats.render_settings()
        self._workers = [_SceneWorker(model, FRONT_CAMERA, size, settings) for _ in range(threads)]
        for worker in self._workers:
            worker.caster.set_rays(mujoco_rays(self._rays))
        self._pool = ThreadPoolExecutor(threads)
        if splats is not None:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            start = time.perf_counter()
            self._workers[0].render(data, camera_pose(data, self._camera))
            seconds = time.perf_counter() - start
            log_line(f"{len(splats.rgb)} splats on the CPU: {seconds:.2f} s for a picture of {size[0]}×{size[1]}")

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Any = None,
        noise: Sequence[CameraNoise] | None = None,
        weather: Sequence[Weather | None] = (),
        sunlight: Any = (),
    ) -> Rendering:
        """See `Compositor.render`; `lighting` and `sunlight` have no effect."""
        poses = camera_poses(datas, self._camera, noise)
        width, height = self.size
        rgb = np.empty((len(datas), height, width, 3), np.float32)
        depth = np.empty((len(datas), height, width), np.float32)

        def render_share(number: int) -> None:
            for k in range(number, len(datas), len(self._workers)):
                colors, depth[k] = self._workers[number].render(datas[k], poses[k])
                rgb[k] = colors / 255.0

        list(self._pool.map(render_share, range(len(self._workers))))
        far = np.where(depth > 0.0, depth, np.float32(FAR))
        for k, one in enumerate(weather):
            if one:
                rgb[k] = one.apply(rgb[k], far[k], self._rays, poses[k])
        for k, camera_noise in enumerate(noise or ()):
            rgb[k] = camera_noise.apply(rgb[k], far[k], poses[k], datas[k].time, self._rays, self.intrinsics)
        return Rendering(rgb, depth, (depth > 0.0).astype(np.float32))


class _SceneWorker:
    """Renders a scene by one of its cameras, for one thread.

    Warp compiles kernels at their first launch; compiling in two threads at once corrupts them (observed: pictures
    without ground). So each worker renders once when it is made.
    """

    def __init__(self, model: mujoco.MjModel, camera: str, size: tuple[int, int], settings: dict[str, Any]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._size, self._camera = size, model.camera(camera).id
        mujoco.mj_forward(model, self._data)
        self.caster = RayCaster(model, self._data, cam_res=size, cam_active=[camera], **settings)
        self.render(self._data, camera_pose(self._data, self._camera))

    def render(self, data: mujoco.MjData, pose: Array) -> tuple[Array32, Array32]:
        """Renders from an OpenCV pose; returns colors (h, w, 3) in [0, 255] and z-depth (h, w) [m], 0 for the sky."""
        mine = self._data
        mine.qpos[:], mine.mocap_pos[:], mine.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self._model, mine)
        mujoco.mj_camlight(self._model, mine)
        camera = opencv_to_mujoco(pose)
        mine.cam_xpos[self._camera], mine.cam_xmat[self._camera] = camera[:3, 3], camera[:3, :3].ravel()
        self.caster.set_poses(**{name: getattr(mine, name) for name in _POSES})
        rgb, depth = self.caster.cast()
        width, height = self._size
        return rgb.reshape(height, width, 3), depth.reshape(height, width)


# ---- free camera poses

_FOVY = 50.0  # [°]
_BEHIND, _ABOVE, _AHEAD = 3.0, 1.6, 2.0  # [m] camera position and look-at point relative to the robot
_SMOOTHING = 0.15  # low-pass gain of the camera heading per control step (0.1 s)
_PART_ALPHA = 0.45
_EDGE_RGB = (20, 20, 30)
_OCCLUSION_TOLERANCE = 0.6  # [m] parts at most this far behind the visible surface are drawn, too


class SceneCamera:
    """Renders a world from free camera poses."""

    def __init__(self, world: World, size: tuple[int, int], obstacles: Sequence[ObstacleConfig] = ()) -> None:
        """`size`: width, height [px]. To show only some of `obstacles`, set the attribute `obstacles` to these."""
        spec = world.spec(keeps_part=lambda name: False)
        self.obstacles = tuple(obstacles)
        add_obstacles(spec, self.obstacles, world)
        spec.worldbody.add_camera(name="free", fovy=_FOVY)
        self.model = spec.compile()
        """The scene without convex parts."""
        self.data = mujoco.MjData(self.model)
        self._worker = _SceneWorker(self.model, "free", size, _SCENE_SETTINGS)
        parts = CollisionCaster(world, size, camera_intrinsics(self.model, self.model.camera("free").id, size))
        self._parts = parts if parts.count else None

    def render(self, qpos: Array, camera_to_world: Array, time: float = 0.0) -> Image:
        """Picture of the scene at a time [s], with the robot at `qpos`, from an OpenCV camera pose; shape (h, w, 3)."""
        self.data.qpos[:] = qpos
        place(self.obstacles, self.data, time)
        if self._parts is None:
            return self._worker.render(self.data, camera_to_world)[0].astype(np.uint8)
        # Warp's CPU kernels run on one thread each and release the GIL, so the two casts run in parallel.
        with ThreadPoolExecutor(1) as pool:
            parts = pool.submit(self._parts.cast, camera_to_world)
            rgb, depth = self._worker.render(self.data, camera_to_world)
            return blend_parts(rgb, depth, *parts.result())


def blend_parts(rgb: NDArray, depth: NDArray, part_rgb: NDArray, part_depth: NDArray, identity: NDArray) -> Image:
    """Draws the visible collision parts half transparent, with outlines, over a picture (h, w, 3).

    The z-depths `depth` and `part_depth` [m] have shape (h, w); `depth` is 0 where rays hit nothing. `identity` (h, w)
    is the number of the nearest part, negative where there is none.
    """
    visible = (identity >= 0) & ((depth <= 0) | (part_depth <= depth + _OCCLUSION_TOLERANCE))
    edge = np.zeros_like(visible)
    edge[:, 1:] |= identity[:, 1:] != identity[:, :-1]
    edge[1:] |= identity[1:] != identity[:-1]
    out = rgb.astype(np.float32)  # a copy
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
