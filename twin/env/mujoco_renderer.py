"""MuJoCo renderers of a front camera: objects to be composited into a field, and the whole MuJoCo scene.

Both use `mujoco_warp`'s ray caster on the CPU, without OpenGL, and omit the parts that the camera is built into.
`ObjectRenderer` draws obstacles, other robots and the robot's own body; `SceneRenderer` draws the scene as MuJoCo
itself shows it, the standard pipeline that a radiance field is compared with.
"""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.camera_noise import CameraNoise
from twin.env.irradiance import Irradiance
from twin.env.obstacle_models import OBSTACLE_GROUP
from twin.env.weather import Weather
from twin.geometry.cameras import opencv_to_mujoco, pixel_grid, unproject
from twin.mjcf.husky import ROBOT_COLLISION_GROUP, ROBOT_VISUAL_GROUP, camera_mount_geoms
from twin.nerf.rendering import FAR, Rendering
from twin.runtime import available_cores
from twin.types import Array, Array32
from twin.warp_runtime import wp

FRONT_CAMERA = "front"
"""Name of the policy's camera in a model."""

_NEAR_PLANE = 0.02  # [m] z-depth before which nothing is drawn
_SMALL_MASK = 800  # [px] masks up to here are supersampled throughout: a first cast would cost more than it saves
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # [px] offsets of the samples at edges
_BOX_CORNERS = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T
_SCENE_GROUPS = [0, 1, 2, OBSTACLE_GROUP]  # drawn by `SceneRenderer`; collision parts are not


def camera_intrinsics(model: mujoco.MjModel, camera: int, size: tuple[int, int]) -> Array:
    """fx, fy, cx, cy [px] of a camera of the model for pictures of a size (width, height), shape (4,)."""
    width, height = size
    if model.cam_sensorsize[camera, 1] > 0.0:
        fx, fy, right, up = model.cam_intrinsic[camera] / np.tile(model.cam_sensorsize[camera], 2)
        # MuJoCo measures the principal point from the center of the image, positive to the left and up.
        return np.array([fx * width, fy * height, width / 2 - right * width, height / 2 - up * height])
    focal = height / 2 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    return np.array([focal, focal, width / 2, height / 2])


def camera_pose(data: mujoco.MjData, camera: int) -> Array:
    """camera_to_world of a camera, OpenCV axes, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = data.cam_xmat[camera].reshape(3, 3)
    pose[:3, 3] = data.cam_xpos[camera]
    return opencv_to_mujoco(pose)


def camera_poses(datas: Sequence[mujoco.MjData], camera: int, noise: Sequence[CameraNoise] | None) -> Array:
    """camera_to_world of a camera in n envs, with the vibration of `noise` if given, shape (n, 4, 4)."""
    poses = np.stack([camera_pose(data, camera) for data in datas])
    if noise is None:
        return poses
    return np.stack([n.perturb_pose(pose, data.time) for n, pose, data in zip(noise, poses, datas, strict=True)])


class RayCaster:
    """`mujoco_warp`'s ray caster for one model on the CPU, with free rays. Not for two threads at once."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, **context: Any) -> None:
        """`data` is a state after `mj_forward`; `context` has arguments of `mujoco_warp.create_render_context`."""
        import mujoco_warp as mjw  # slow to import

        self._mjw = mjw
        with wp.ScopedDevice("cpu"):
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
        # The context's own rays are those of a whole picture; it casts only the first `total_rays`.
        self._context.total_rays = len(rays)

    def cast(self) -> tuple[Array32, Array32]:
        """Casts the rays. Colors (k, 3) in [0, 255] and z-depth (k,) [m], 0 where nothing is hit."""
        with wp.ScopedDevice("cpu"):
            self._mjw.render(self._model, self._data, self._context)
        count = self._context.total_rays
        packed = self._context.rgb_data.numpy()[0, :count]
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.float32)
        return rgb, self._context.depth_data.numpy()[0, :count].copy()

    def hit_geoms(self) -> NDArray[np.int32]:
        """Geom that each ray of the last cast hit, −1 for none, shape (k,); needs `render_seg=True`."""
        return self._context.seg_data.numpy()[0, : self._context.total_rays, 0].copy()


def _mujoco_rays(rays: Array) -> Array32:
    """Unit rays in MuJoCo's camera axes from OpenCV rays (..., 3), shape (n, 3)."""
    flipped = (rays * [1.0, -1.0, -1.0]).reshape(-1, 3)
    return (flipped / np.linalg.norm(flipped, axis=1, keepdims=True)).astype(np.float32)


# ---- objects for compositing


@dataclass(frozen=True)
class RenderedObjects:
    """A window of the picture with the objects in it. Arrays of shape (height, width), color (height, width, 3)."""

    window: tuple[int, int, int, int]
    """Left, top, width, height [px]."""
    coverage: Array32
    """Fraction of a pixel that objects cover."""
    rgb: Array32
    """Shaded color in film colors; 0 where nothing covers the pixel."""
    depth: Array32
    """z-depth of the covered part [m]; 0 where nothing covers the pixel."""


class ObjectRenderer:
    """Draws obstacles and robots of one model, one env at a time. Not for two threads at once.

    A small model of their geoms alone is cast, only with rays of pixels that some geom's box may cover: one each, and
    four each at edges, for smooth outlines. Its lights make the drawn color the surface's normal; the object's color is
    then its own times the irradiance of that normal.
    """

    def __init__(self, model: mujoco.MjModel, camera: int, size: tuple[int, int]):
        """
        Args:
            model: Its geoms of the obstacles' group and of the robot's visual group are drawn.
            camera: Index of the camera in the model.
            size: Width, height of the picture [px].
        """
        self.size = size
        self._intrinsics = camera_intrinsics(model, camera, size)
        colors = _geom_rgba(model)
        drawn = np.isin(model.geom_group, (OBSTACLE_GROUP, ROBOT_VISUAL_GROUP)) & (colors[:, 3] > 0.0)
        drawn[camera_mount_geoms(model, camera)] = False
        self.geoms = np.flatnonzero(drawn)
        owners = model.body_rootid[model.geom_bodyid[self.geoms]]
        self._bodies, self._owner = np.unique(owners, return_inverse=True)
        self._colors = colors[self.geoms, :3]
        self._centers, self._halves = model.geom_aabb[self.geoms, :3], model.geom_aabb[self.geoms, 3:]
        fx, fy, cx, cy = self._intrinsics
        # Inward normals of the view frustum's planes in the camera frame; the last plane lies `_NEAR_PLANE` ahead.
        self._planes = np.array([[fx, 0, cx], [-fx, 0, size[0] - cx], [0, fy, cy], [0, -fy, size[1] - cy], [0, 0, 1.0]])
        if len(self.geoms) == 0:
            return
        small = _geoms_only_model(model, self.geoms)
        self._offset, self._turn = _mesh_frames(small)
        # Distances are cut off at a multiple of the model's extent.
        small.stat.extent, small.vis.map.zfar = 1.0, 1.0e4
        width, height = size
        data = mujoco.MjData(small)
        mujoco.mj_forward(small, data)
        self._caster = RayCaster(
            small,
            data,
            cam_res=(2 * width, 2 * height),
            render_seg=True,
            enabled_geom_groups=[0],
            use_textures=False,
            enable_specular=False,
            enable_emission=False,
        )
        self._cast(self._rays(pixel_grid(2, 2).reshape(-1, 2)))  # compiles
        pixels = pixel_grid(*size).reshape(-1, 2)
        self._center_rays = self._rays(pixels)
        self._subpixel_rays = np.stack([self._rays(pixels + offset) for offset in _SUBPIXELS], 1)

    def visible_mask(self, data: mujoco.MjData, pose: Array) -> NDArray[np.bool_] | None:
        """Pixels that some geom may cover, shape (height, width); None where nothing is in view.

        Args:
            data: Current poses of the geoms.
            pose: camera_to_world, OpenCV axes, shape (4, 4).
        """
        if len(self.geoms) == 0:
            return None
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        middles = data.geom_xpos[self.geoms] - pose[:3, 3] + np.einsum("nij,nj->ni", turns, self._centers)
        planes = self._planes @ pose[:3, :3].T
        # How far a box reaches into a half space: its center, plus its half sides projected onto the normal.
        reach = middles @ planes.T + np.einsum("npj,nj->np", np.abs(planes @ turns), self._halves)
        reach[:, -1] -= _NEAR_PLANE
        seen = np.flatnonzero((reach > 0.0).all(1))
        if len(seen) == 0:
            return None
        local = self._halves[seen, None] * _BOX_CORNERS
        corners = np.matmul(local, turns[seen].transpose(0, 2, 1)) + middles[seen, None]
        x, y, z = np.moveaxis(corners @ pose[:3, :3], -1, 0)
        width, height = self.size
        mask = np.zeros((height, width), bool)
        if (z < _NEAR_PLANE).any():
            mask[:] = True
            return mask
        fx, fy, cx, cy = self._intrinsics
        u, v = fx * x / z + cx, fy * y / z + cy
        sides = np.stack([u.min(1) - 1, u.max(1) + 2, v.min(1) - 1, v.max(1) + 2], 1)
        sides = np.clip(sides, 0, [width, width, height, height]).astype(int)
        for left, right, top, bottom in sides.tolist():
            mask[top:bottom, left:right] = True
        return mask if mask.any() else None

    def render(
        self, data: mujoco.MjData, pose: Array, mask: NDArray[np.bool_], irradiance: Irradiance | None
    ) -> RenderedObjects | None:
        """Draws the pixels of a mask from `visible_mask`; None where nothing covers them.

        Args:
            data: Current poses of the geoms.
            pose: camera_to_world, OpenCV axes, shape (4, 4).
            mask: Shape (height, width).
            irradiance: Irradiance that shades the objects; None: their own plain colors.
        """
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        camera = opencv_to_mujoco(pose)
        self._caster.set_poses(
            geom_xpos=data.geom_xpos[self.geoms] + np.einsum("nij,nj->ni", turns, self._offset),
            geom_xmat=turns @ self._turn,
            cam_xpos=camera[:3, 3],
            cam_xmat=camera[:3, :3],
        )
        shade = self._shader(data, irradiance)
        pixels = np.flatnonzero(mask)
        width, height = self.size
        coverage, color, z = (np.zeros((height, width, *rest), np.float32) for rest in ((), (3,), ()))
        edges = pixels
        if len(pixels) > _SMALL_MASK:
            geom, normals, depth = self._cast(self._center_rays[pixels])
            coverage.ravel()[pixels] = geom >= 0
            color.reshape(-1, 3)[pixels], z.ravel()[pixels] = shade(geom, normals), depth
            ids = np.full((height, width), -1, np.int32)
            ids.ravel()[pixels] = geom
            edges = np.flatnonzero(_edge_mask(ids) & mask)
        if len(edges):
            geom, normals, depth = self._cast(self._subpixel_rays[edges].reshape(-1, 3))
            hits = (geom >= 0).reshape(-1, 4)
            share = hits.sum(1) / 4.0
            over = 1.0 / np.maximum(4.0 * share, 1.0)
            coverage.ravel()[edges] = share
            color.reshape(-1, 3)[edges] = shade(geom, normals).reshape(-1, 4, 3).sum(1) * over[:, None]
            z.ravel()[edges] = depth.reshape(-1, 4).sum(1) * over
        rows, columns = np.flatnonzero(coverage.any(1)), np.flatnonzero(coverage.any(0))
        if len(rows) == 0:
            return None
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        inner = np.s_[top:bottom, left:right]
        window = int(left), int(top), int(right - left), int(bottom - top)
        return RenderedObjects(window, coverage[inner], color[inner], z[inner])

    def _rays(self, pixels: Array) -> Array32:
        """Unit rays through (u, v) [px] in MuJoCo's camera axes, shapes (n, 2) → (n, 3)."""
        return _mujoco_rays(unproject(pixels, self._intrinsics))

    def _cast(self, rays: Array32) -> tuple[NDArray[np.int32], Array32, Array32]:
        """Drawn geom (−1: none), unit normal and z-depth [m] (0: none) that rays (n, 3) hit."""
        count, most = len(rays), self._caster.max_rays
        if count > most:  # more edges than fit: in batches
            parts = [self._cast(rays[k : k + most]) for k in range(0, count, most)]
            geom, normals, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
            return geom, normals, depth
        self._caster.set_rays(rays)
        rgb, depth = self._caster.cast()
        normals = rgb / 127.5 - 1.0
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        return self._caster.hit_geoms(), normals, depth

    def _shader(
        self, data: mujoco.MjData, irradiance: Irradiance | None
    ) -> Callable[[NDArray[np.int32], Array32], Array32]:
        """A function that colors drawn geoms (n,) with normals (n, 3), shape (n, 3); 0 where there is none."""
        ground = irradiance.ground(data.xpos[self._bodies, :2]) if irradiance else None

        def shade(geom: NDArray[np.int32], normals: Array32) -> Array32:
            out = np.zeros((len(geom), 3), np.float32)
            hit = np.flatnonzero(geom >= 0)
            mine = geom[hit]
            color = self._colors[mine]
            if irradiance is not None and ground is not None:
                color = color * irradiance.irradiance(ground[self._owner[mine]], normals[hit].astype(np.float64))
            out[hit] = color
            return out

        return shade


def _geom_rgba(model: mujoco.MjModel) -> Array:
    """Color of every geom, shape (ngeom, 4)."""
    out = model.geom_rgba.copy()
    has = model.geom_matid >= 0
    out[has] = model.mat_rgba[model.geom_matid[has]]
    return out


def _geoms_only_model(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> mujoco.MjModel:
    """A model of these geoms alone, in its world body, with a camera; lit so that colors are (1 + normal) / 2."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    meshes: set[int] = set()
    for i in geoms:
        settings = {}
        mesh = int(model.geom_dataid[i]) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH else -1
        if mesh >= 0:
            settings["meshname"] = f"mesh_{mesh}"
            if mesh not in meshes:
                _copy_mesh(spec, model, mesh)
            meshes.add(mesh)
        spec.worldbody.add_geom(type=int(model.geom_type[i]), size=model.geom_size[i], rgba=(1, 1, 1, 1), **settings)
    spec.worldbody.add_camera(name="view")
    for axis in range(3):
        for sign in (1.0, -1.0):
            direction = np.eye(3)[axis]
            spec.worldbody.add_light(
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                dir=-sign * direction,
                diffuse=0.5 * sign * direction,  # negative from the opposite side
                ambient=(0.5, 0.5, 0.5) if axis == 0 and sign > 0 else (0, 0, 0),
                specular=(0, 0, 0),
                castshadow=False,
            )
    return spec.compile()


def _copy_mesh(spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: int) -> None:
    added = spec.add_mesh(name=f"mesh_{mesh}")
    start, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    added.uservert = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].ravel()
    added.userface = model.mesh_face[faces : faces + model.mesh_facenum[mesh]].ravel()
    added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _mesh_frames(small: mujoco.MjModel) -> tuple[Array, Array]:
    """Position and rotation of each geom in its mesh's original frame, as MuJoCo moves meshes to their inertial one."""
    turns = np.empty((small.ngeom, 9))
    for i in range(small.ngeom):
        mujoco.mju_quat2Mat(turns[i], small.geom_quat[i])
    return small.geom_pos.copy(), turns.reshape(-1, 3, 3)


def _edge_mask(ids: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels with a neighbor of another id."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


# ---- the whole scene


class SceneRenderer:
    """Renders envs as MuJoCo itself shows them to their front cameras; takes the arguments of `Compositor`.

    The extracted mesh in its filmed colors, the ground, obstacles and the robot are drawn through the same camera as
    the field's pictures, under the model's own lights, whatever lighting is requested.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], max_envs: int) -> None:
        """`model` has the visuals that `episode_spec` keeps; other arguments as of `Compositor`."""
        self.size = size
        self._camera = model.camera(FRONT_CAMERA).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        self._rays = unproject(pixel_grid(*size), self.intrinsics)
        model = copy.copy(model)
        model.geom_group[camera_mount_geoms(model, self._camera)] = ROBOT_COLLISION_GROUP  # not drawn
        # One after the other, as Warp compiles kernels at their first use.
        threads = min(max_envs, available_cores())
        self._workers = [_SceneWorker(model, size, self._rays) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads)

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Any = None,
        noise: Sequence[CameraNoise] | None = None,
        weather: Sequence[Weather | None] = (),
    ) -> Rendering:
        """Renders the front camera of every env; arguments as of `Compositor.render`, `lighting` has no effect."""
        poses = camera_poses(datas, self._camera, noise)
        width, height = self.size
        rgb = np.empty((len(datas), height, width, 3), np.float32)
        depth = np.empty((len(datas), height, width), np.float32)

        def render_share(number: int) -> None:
            for k in range(number, len(datas), len(self._workers)):
                rgb[k], depth[k] = self._workers[number].render(datas[k], poses[k])

        list(self._pool.map(render_share, range(len(self._workers))))
        for k, one in enumerate(weather):
            if one:
                far = np.where(depth[k] > 0.0, depth[k], np.float32(FAR))
                rgb[k] = one.apply(rgb[k], far, self._rays, poses[k])
        for k, camera_noise in enumerate(noise or ()):
            rgb[k] = camera_noise.apply(rgb[k], depth[k], poses[k], datas[k].time, self._rays, self.intrinsics)
        return Rendering(rgb, depth, (depth > 0.0).astype(np.float32))


class _SceneWorker:
    """Renders the scene for one thread."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], rays: Array) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._size, self._camera = size, model.camera(FRONT_CAMERA).id
        mujoco.mj_forward(model, self._data)
        self._caster = RayCaster(
            model,
            self._data,
            cam_res=size,
            cam_active=[FRONT_CAMERA],
            enabled_geom_groups=_SCENE_GROUPS,
            render_skybox=True,
            use_shadows=True,
            enable_backface_culling=False,
        )
        self._caster.set_rays(_mujoco_rays(rays))
        self.render(self._data, camera_pose(self._data, self._camera))  # compiles

    def render(self, data: mujoco.MjData, pose: Array) -> tuple[Array32, Array32]:
        """Colors (height, width, 3) in [0, 1] and z-depth (height, width) [m], 0 for sky, from an OpenCV pose."""
        mine = self._data
        mine.qpos[:], mine.mocap_pos[:], mine.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self._model, mine)
        mujoco.mj_camlight(self._model, mine)
        camera = opencv_to_mujoco(pose)
        mine.cam_xpos[self._camera], mine.cam_xmat[self._camera] = camera[:3, 3], camera[:3, :3].ravel()
        names = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
        self._caster.set_poses(**{name: getattr(mine, name) for name in names})
        rgb, depth = self._caster.cast()
        width, height = self._size
        return rgb.reshape(height, width, 3) / 255.0, depth.reshape(height, width)
