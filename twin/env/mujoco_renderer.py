"""What of a MuJoCo model a camera sees besides the field: obstacles, other robots, the robot's own body without what
the camera is built into.

`mujoco_warp`'s ray caster draws them, without OpenGL, from a small model of their geoms alone. It is given only the
rays it needs: of the pixels that some geom's box may cover, one each, and at edges four each, so that outlines come
out smooth. Its lights are set so that the colour it draws is the surface's normal; what a surface looks like is
then its own colour times the irradiance of that normal there. *Coverage* is the share of a pixel that is covered.
"""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.env.camera_noise import CameraNoise
from twin.env.irradiance import Irradiance
from twin.env.obstacle_models import OBSTACLE_GROUP
from twin.env.weather import Weather
from twin.geometry.cameras import opencv_to_mujoco, pixel_grid, unproject
from twin.mjcf.husky import ROBOT_GROUP
from twin.mjcf.husky_visuals import LOOK_GROUP, camera_parts
from twin.nerf.rendering import FAR, Rendering
from twin.runtime import cores
from twin.types import Array, Array32

_NEAR = 0.02  # [m] z-depth before which nothing is drawn
_SMALL = 800  # [px] of which all are sampled as those at edges are: a second cast would cost more than it saves
_QUARTERS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # [px] of the samples at edges
_CORNERS = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T


@dataclass(frozen=True)
class RenderedObjects:
    """A window of the picture with what covers it. Arrays of shape (height, width), colour (height, width, 3)."""

    window: tuple[int, int, int, int]
    """Left, top, width, height [px]."""
    coverage: Array32
    rgb: Array32
    """As lit, in film colours; 0 where nothing covers the pixel."""
    depth: Array32
    """z-depth of the covered share [m]; 0 where nothing covers the pixel."""


def camera_intrinsics(model: mujoco.MjModel, camera: int, size: tuple[int, int]) -> Array:
    """fx, fy, cx, cy [px] of a camera of the model for pictures of a size (width, height), shape (4,)."""
    width, height = size
    if model.cam_sensorsize[camera, 1] > 0.0:
        fx, fy, right, up = model.cam_intrinsic[camera] / np.tile(model.cam_sensorsize[camera], 2)
        # MuJoCo counts the principal point from the middle of the image, left and up being positive.
        return np.array([fx * width, fy * height, width / 2 - right * width, height / 2 - up * height])
    focal = height / 2 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    return np.array([focal, focal, width / 2, height / 2])


def camera_pose(data: mujoco.MjData, camera: int) -> Array:
    """camera_to_world of a camera, OpenCV axes, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = data.cam_xmat[camera].reshape(3, 3)
    pose[:3, 3] = data.cam_xpos[camera]
    return opencv_to_mujoco(pose)


class ObjectRenderer:
    """Draws the obstacles and robots of one model, one world at a time. Not for two threads at once."""

    def __init__(self, model: mujoco.MjModel, camera: int, size: tuple[int, int]):
        """
        Args:
            model: Its geoms of the obstacles' group and of the robot's looks are drawn.
            camera: Of the model; where it is, is told when something is drawn.
            size: Width, height of the picture [px].
        """
        import mujoco_warp as mjw  # slow to import

        self._mjw, self.size = mjw, size
        self._intrinsics = intrinsics = camera_intrinsics(model, camera, size)
        shown = np.isin(model.geom_group, (OBSTACLE_GROUP, LOOK_GROUP)) & (_rgba(model)[:, 3] > 0.0)
        shown[camera_parts(model, camera)] = False
        self.geoms = np.flatnonzero(shown)
        owners = model.body_rootid[model.geom_bodyid[self.geoms]]
        self._bodies, self._owner = np.unique(owners, return_inverse=True)
        self._colors = _rgba(model)[self.geoms, :3]
        self._centers, self._halves = model.geom_aabb[self.geoms, :3], model.geom_aabb[self.geoms, 3:]
        fx, fy, cx, cy = intrinsics
        # Inward normals of the planes that bound the view, in the camera; the last one lies `_NEAR` ahead.
        self._planes = np.array([[fx, 0, cx], [-fx, 0, size[0] - cx], [0, fy, cy], [0, -fy, size[1] - cy], [0, 0, 1.0]])
        if len(self.geoms) == 0:
            return
        small = _only(model, self.geoms)
        self._offset, self._turn = _own_frames(small)
        # Distances are cut off at a multiple of the model's extent.
        small.stat.extent, small.vis.map.zfar = 1.0, 1.0e4
        width, height = size
        with wp.ScopedDevice("cpu"):
            data = mujoco.MjData(small)
            mujoco.mj_forward(small, data)
            self._model, self._data = mjw.put_model(small), mjw.put_data(small, data)
            self._context = mjw.create_render_context(
                small,
                cam_res=(2 * width, 2 * height),
                render_rgb=True,
                render_depth=True,
                render_seg=True,
                enabled_geom_groups=[0],
                use_textures=False,
                enable_specular=False,
                enable_emission=False,
            )
            self._cast(self._rays(pixel_grid(2, 2).reshape(-1, 2)))  # compiles
        self._middles = self._rays(pixel_grid(*size).reshape(-1, 2))
        self._quarters = np.stack([self._rays(pixel_grid(*size).reshape(-1, 2) + quarter) for quarter in _QUARTERS], 1)

    def in_view(self, data: mujoco.MjData, pose: Array) -> NDArray[np.bool_] | None:
        """Pixels that some geom may cover, shape (height, width); None where nothing is in view.

        Args:
            data: With poses of geoms as of now.
            pose: camera_to_world, OpenCV axes, shape (4, 4).
        """
        if len(self.geoms) == 0:
            return None
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        middles = data.geom_xpos[self.geoms] - pose[:3, 3] + np.einsum("nij,nj->ni", turns, self._centers)
        planes = self._planes @ pose[:3, :3].T
        # How far a box reaches into a half space: its middle, and its half sides' shares along the normal.
        reach = middles @ planes.T + np.einsum("npj,nj->np", np.abs(planes @ turns), self._halves)
        reach[:, -1] -= _NEAR
        seen = np.flatnonzero((reach > 0.0).all(1))
        if len(seen) == 0:
            return None
        corners = np.matmul(self._halves[seen, None] * _CORNERS, turns[seen].transpose(0, 2, 1)) + middles[seen, None]
        x, y, z = np.moveaxis(corners @ pose[:3, :3], -1, 0)
        width, height = self.size
        mask = np.zeros((height, width), bool)
        if (z < _NEAR).any():
            mask[:] = True
            return mask
        fx, fy, cx, cy = self._intrinsics
        u, v = fx * x / z + cx, fy * y / z + cy
        sides = np.stack([u.min(1) - 1, u.max(1) + 2, v.min(1) - 1, v.max(1) + 2], 1)
        sides = np.clip(sides, 0, [width, width, height, height]).astype(int)
        for left, right, top, bottom in sides.tolist():
            mask[top:bottom, left:right] = True
        return mask if mask.any() else None

    def draw(
        self, data: mujoco.MjData, pose: Array, mask: NDArray[np.bool_], light: Irradiance | None
    ) -> RenderedObjects | None:
        """What covers the pixels of a mask, see `in_view`; None where nothing does.

        Args:
            data: With poses of geoms as of now.
            pose: camera_to_world, OpenCV axes, shape (4, 4).
            mask: Shape (height, width).
            light: What falls on it; None = everything has its own plain colour, unshaded.
        """
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        self._data.geom_xpos.numpy()[0] = data.geom_xpos[self.geoms] + np.einsum("nij,nj->ni", turns, self._offset)
        self._data.geom_xmat.numpy()[0] = turns @ self._turn
        camera = opencv_to_mujoco(pose)
        self._data.cam_xpos.numpy()[0, 0], self._data.cam_xmat.numpy()[0, 0] = camera[:3, 3], camera[:3, :3]
        lit = self._lit(data, light)
        with wp.ScopedDevice("cpu"):
            self._mjw.refit_bvh(self._model, self._data, self._context)
            pixels = np.flatnonzero(mask)
            width, height = self.size
            coverage, color, z = (np.zeros((height, width, *rest), np.float32) for rest in ((), (3,), ()))
            edges = pixels
            if len(pixels) > _SMALL:
                geom, normals, depth = self._cast(self._middles[pixels])
                coverage.ravel()[pixels] = geom >= 0
                color.reshape(-1, 3)[pixels], z.ravel()[pixels] = lit(geom, normals), depth
                ids = np.full((height, width), -1, np.int32)
                ids.ravel()[pixels] = geom
                edges = np.flatnonzero(_edges(ids) & mask)
            if len(edges):
                geom, normals, depth = self._cast(self._quarters[edges].reshape(-1, 3))
                hits = (geom >= 0).reshape(-1, 4)
                share = hits.sum(1) / 4.0
                over = 1.0 / np.maximum(4.0 * share, 1.0)
                coverage.ravel()[edges] = share
                color.reshape(-1, 3)[edges] = lit(geom, normals).reshape(-1, 4, 3).sum(1) * over[:, None]
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
        rays = unproject(pixels, self._intrinsics) * [1.0, -1.0, -1.0]
        return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)

    def _cast(self, rays: Array32) -> tuple[NDArray[np.int32], Array32, Array32]:
        """Drawn geom (−1: none), unit normal and z-depth [m] (0: none) that rays (n, 3) meet."""
        context, count = self._context, len(rays)
        most = context.ray.shape[0]
        if count > most:  # more edges than fit: in turns
            parts = [self._cast(rays[k : k + most]) for k in range(0, count, most)]
            geom, normals, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
            return geom, normals, depth
        # The context's own rays are those of a whole picture; it casts as many of them as it is told to.
        context.ray.numpy()[:count] = rays
        context.total_rays = count
        self._mjw.render(self._model, self._data, context)
        packed = context.rgb_data.numpy()[0, :count]
        geom = context.seg_data.numpy()[0, :count, 0].copy()
        normals = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.float32) / 127.5 - 1.0
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        return geom, normals, context.depth_data.numpy()[0, :count].copy()

    def _lit(self, data: mujoco.MjData, light: Irradiance | None) -> Callable[[NDArray[np.int32], Array32], Array32]:
        """What drawn geoms (n,) with normals (n, 3) look like, (n, 3); 0 where there is none."""
        levels = light.level(data.xpos[self._bodies, :2]) if light else None

        def lit(geom: NDArray[np.int32], normals: Array32) -> Array32:
            out = np.zeros((len(geom), 3), np.float32)
            hit = np.flatnonzero(geom >= 0)
            mine = geom[hit]
            color = self._colors[mine]
            if light is not None and levels is not None:
                color = color * light.irradiance(levels[self._owner[mine]], normals[hit].astype(np.float64))
            out[hit] = color
            return out

        return lit


def _rgba(model: mujoco.MjModel) -> Array:
    """Colour of every geom, shape (ngeom, 4)."""
    out = model.geom_rgba.copy()
    has = model.geom_matid >= 0
    out[has] = model.mat_rgba[model.geom_matid[has]]
    return out


def _only(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> mujoco.MjModel:
    """A model of these geoms alone, in its world body, with a camera; lit so that colours are (1 + normal) / 2."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    meshes: set[int] = set()
    for i in geoms:
        settings = {}
        mesh = int(model.geom_dataid[i]) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH else -1
        if mesh >= 0:
            settings["meshname"] = f"mesh_{mesh}"
            if mesh not in meshes:
                _add_mesh(spec, model, mesh)
            meshes.add(mesh)
        spec.worldbody.add_geom(type=int(model.geom_type[i]), size=model.geom_size[i], rgba=(1, 1, 1, 1), **settings)
    spec.worldbody.add_camera(name="view")
    for axis in range(3):
        for sign in (1.0, -1.0):
            shine = np.eye(3)[axis]
            spec.worldbody.add_light(
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                dir=-sign * shine,
                diffuse=0.5 * sign * shine,  # from the far side it takes light away
                ambient=(0.5, 0.5, 0.5) if axis == 0 and sign > 0 else (0, 0, 0),
                specular=(0, 0, 0),
                castshadow=False,
            )
    return spec.compile()


def _add_mesh(spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: int) -> None:
    added = spec.add_mesh(name=f"mesh_{mesh}")
    start, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    added.uservert = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].ravel()
    added.userface = model.mesh_face[faces : faces + model.mesh_facenum[mesh]].ravel()
    added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _own_frames(small: mujoco.MjModel) -> tuple[Array, Array]:
    """Where each geom is in the frame its mesh was given in, as MuJoCo moves meshes to a frame of their own."""
    turns = np.empty((small.ngeom, 9))
    for i in range(small.ngeom):
        mujoco.mju_quat2Mat(turns[i], small.geom_quat[i])
    return small.geom_pos.copy(), turns.reshape(-1, 3, 3)


def _edges(ids: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels with another thing beside them."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


# ---- What MuJoCo itself would show a policy: the extracted mesh in its filmed colours, the ground, obstacles, the robot.
#
# This is the standard pipeline that a radiance field is compared with. `mujoco_warp`'s ray caster draws it, through the
# same camera as the field's pictures; its light is the model's own, whatever lighting is asked for. What the camera is
# built into is left out, as it is there.


_CAMERA = "front"
_GROUPS = [0, 1, 2, OBSTACLE_GROUP]  # what is looked at; collision parts are not
_LOADED = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")


class SceneRenderer:
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
        self._painters = [_SceneRendererThread(model, size, self._rays) for _ in range(min(worlds, cores()))]
        self._pool = ThreadPoolExecutor(len(self._painters))

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Any = None,
        effects: Sequence[CameraNoise] | None = None,
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


class _SceneRendererThread:
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
