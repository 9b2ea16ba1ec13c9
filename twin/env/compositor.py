"""Compositor: draws obstacles, other robots and the robot's own body into renderings of a radiance field.

Objects are shaded with the irradiance estimated from the field, and obstacles cast contact shadows. In pixels that an
object covers, the field is rendered a second time, only up to the object's depth. The object is blended with this
foreground by the foreground's opacity, so that leaves in front of an object hide it.
"""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.irradiance import BOX_CORNERS, ContactShadows, Irradiance, IrradianceEstimator
from twin.env.mujoco_renderer import FRONT_CAMERA, RayCaster, camera_intrinsics, camera_poses, mujoco_rays
from twin.env.obstacles import OBSTACLE_GROUP, stored_route
from twin.env.picture_effects import CameraNoise, Weather, soft_clip
from twin.geometry.cameras import Rendering, Viewpoints, opencv_to_mujoco, pixel_grid, unproject
from twin.mjcf.husky_visuals import ROBOT_VISUAL_GROUP, camera_mount_geoms
from twin.nerf.baked import BakedField
from twin.nerf.sun import Sunlight, relit
from twin.runtime import available_cores
from twin.types import Array, Array32
from twin.warp_runtime import wp

# ---- objects

_NEAR_PLANE = 0.02  # [m] geoms whose z-depth is smaller than this everywhere are not drawn
_SMALL_MASK = 800  # [px] if objects may cover at most this area, all its pixels get four rays, which is then faster
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # [px] offsets of a pixel's four rays


@dataclass(frozen=True)
class RenderedObjects:
    """Objects in a rectangular window of the picture; arrays have the window's height and width."""

    window: tuple[int, int, int, int]
    """Left, top, width, height [px]."""
    coverage: Array32
    """Fraction of each pixel that objects cover."""
    rgb: Array32
    """Shaded color; 0 where no object covers the pixel."""
    depth: Array32
    """Mean z-depth of the objects in the pixel [m]; 0 where no object covers the pixel."""


class ObjectRenderer:
    """Draws obstacles and robots of one model, one env at a time. Not thread-safe.

    It casts rays into a second model, which has only the geoms of obstacles and robots. There is one ray in each pixel
    that a geom's bounding box may cover; pixels at outlines of geoms have four, so that outlines are smooth. The second
    model's lights give surfaces a color that encodes their normal. An object's shaded color is its own color times the
    irradiance for its normal.
    """

    def __init__(self, model: mujoco.MjModel, camera: int, size: tuple[int, int]):
        """
        Args:
            model: Its geoms in the obstacles' and the robot's visual group are drawn, except for the camera's housing.
            camera: Index of the camera in the model.
            size: Width, height of the picture [px].
        """
        self.size = size
        colors = _geom_rgba(model)
        drawn = np.isin(model.geom_group, (OBSTACLE_GROUP, ROBOT_VISUAL_GROUP)) & (colors[:, 3] > 0.0)
        drawn[camera_mount_geoms(model, camera)] = False
        self.geoms = np.flatnonzero(drawn)
        owners = model.body_rootid[model.geom_bodyid[self.geoms]]
        self._bodies, self._owner = np.unique(owners, return_inverse=True)
        self._colors = colors[self.geoms, :3]
        self._centers, self._halves = model.geom_aabb[self.geoms, :3], model.geom_aabb[self.geoms, 3:]
        self.set_intrinsics(camera_intrinsics(model, camera, size))
        if len(self.geoms) == 0:
            return
        small = _geoms_only_model(model, self.geoms)
        self._offset, self._turn = _mesh_frames(small)
        # Distances are cut off at `zfar` times the model's extent, here 10 km.
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
        self._cast(self._rays(pixel_grid(2, 2).reshape(-1, 2)))  # compiles the kernels

    def set_intrinsics(self, intrinsics: Array) -> None:
        """Changes the camera's fx, fy, cx, cy [px], shape (4,)."""
        self.intrinsics = intrinsics
        (fx, fy, cx, cy), (width, height) = intrinsics, self.size
        # Inward normals of the view frustum's planes in the camera frame; the last plane lies `_NEAR_PLANE` ahead.
        self._planes = np.array([[fx, 0, cx], [-fx, 0, width - cx], [0, fy, cy], [0, -fy, height - cy], [0, 0, 1.0]])
        if len(self.geoms):
            pixels = pixel_grid(width, height).reshape(-1, 2)
            self._center_rays = self._rays(pixels)
            self._subpixel_rays = np.stack([self._rays(pixels + offset) for offset in _SUBPIXELS], 1)

    def visible_mask(self, data: mujoco.MjData, pose: Array) -> NDArray[np.bool_] | None:
        """Mask (height, width) of pixels that geoms may cover, seen from an OpenCV pose; None if no geom is in view."""
        if len(self.geoms) == 0:
            return None
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        middles = data.geom_xpos[self.geoms] - pose[:3, 3] + np.einsum("nij,nj->ni", turns, self._centers)
        planes = self._planes @ pose[:3, :3].T
        # Largest signed distance of a box's points from a plane: that of its center, plus its half sides projected onto
        # the plane's normal.
        reach = middles @ planes.T + np.einsum("npj,nj->np", np.abs(planes @ turns), self._halves)
        reach[:, -1] -= _NEAR_PLANE
        seen = np.flatnonzero((reach > 0.0).all(1))
        if len(seen) == 0:
            return None
        local = self._halves[seen, None] * BOX_CORNERS
        corners = np.matmul(local, turns[seen].transpose(0, 2, 1)) + middles[seen, None]
        x, y, z = np.moveaxis(corners @ pose[:3, :3], -1, 0)
        width, height = self.size
        mask = np.zeros((height, width), bool)
        if (z < _NEAR_PLANE).any():
            mask[:] = True
            return mask
        fx, fy, cx, cy = self.intrinsics
        u, v = fx * x / z + cx, fy * y / z + cy
        sides = np.stack([u.min(1) - 1, u.max(1) + 2, v.min(1) - 1, v.max(1) + 2], 1)
        sides = np.clip(sides, 0, [width, width, height, height]).astype(int)
        for left, right, top, bottom in sides.tolist():
            mask[top:bottom, left:right] = True
        return mask if mask.any() else None

    def render(
        self, data: mujoco.MjData, pose: Array, mask: NDArray[np.bool_], irradiance: Irradiance | None
    ) -> RenderedObjects | None:
        """Draws the geoms in the pixels of a mask from `visible_mask`; returns None if no geom covers any of them.

        Objects are shaded with `irradiance`; if it is None, they have their own, unshaded colors.
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
        return mujoco_rays(unproject(pixels, self.intrinsics))

    def _cast(self, rays: Array32) -> tuple[NDArray[np.int32], Array32, Array32]:
        """Casts rays (n, 3); returns the indices in `geoms` of the geoms hit (−1: none), normals and z-depths [m]."""
        count, most = len(rays), self._caster.max_rays
        if count > most:  # too many rays for one call
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
        """Returns a function that converts indices in `geoms` (n,) and normals (n, 3) to colors (n, 3), 0 for −1."""
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
    """Returns a model with only these geoms and a camera; its lights give a surface the color (1 + normal) / 2."""
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
                diffuse=0.5 * sign * direction,  # the light from the opposite side is negative
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
    """Positions (n, 3) and rotations (n, 3, 3) of geoms in the frames of their meshes before compilation.

    These offsets are not zero, since the compiler moves a mesh to its inertial frame.
    """
    turns = np.empty((small.ngeom, 9))
    for i in range(small.ngeom):
        mujoco.mju_quat2Mat(turns[i], small.geom_quat[i])
    return small.geom_pos.copy(), turns.reshape(-1, 3, 3)


def _edge_mask(ids: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels that have a neighbor with another id."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


# ---- compositing

Lighting = str | NDArray

_WINDOW_STEP = 32  # [px] sides of windows with a foreground are multiples of this, so that few sizes occur
_MAX_WINDOWS = 16  # number of window sizes whose render targets are kept; pictures of 160×90 px need at most 15


class Compositor:
    """Renders the pictures of one camera in envs that share a model."""

    def __init__(
        self,
        model: mujoco.MjModel,
        field: BakedField,
        size: tuple[int, int] = (160, 90),
        max_envs: int = 1,
        shaded: bool = True,
        camera: str = FRONT_CAMERA,
        lit: tuple[float, float] = (0.0, np.inf),
    ):
        """
        Args:
            model: Contains the camera and the route. `add_obstacles` stores the route, also without obstacles.
            field: Radiance field of the place.
            size: Width, height of the pictures [px].
            max_envs: Number of envs that are usually rendered together; it limits the number of threads.
            shaded: False draws obstacles in their own, unshaded colors, for comparison.
            camera: Name of the camera.
            lit: Lowest and highest arc length of the route [m] where objects are shaded, see `IrradianceEstimator`.
        """
        self.size, self._field = size, field
        self._camera = model.camera(camera).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        wp.set_device("cpu")  # see `RayCaster`
        count = min(max_envs, available_cores()) if field.device == "cpu" else 1
        # On a GPU there is one worker, since all threads would share one CUDA stream. Workers are created one after the
        # other: each may compile Warp kernels, and compiling in two threads at once corrupts them.
        self._workers = [_CompositorWorker(model, field, self._camera, size) for _ in range(count)]
        self._pool = ThreadPoolExecutor(count) if count > 1 else None
        self._shadows = ContactShadows(model, self._workers[0].renderer.geoms)
        self._shaded, self._lock = shaded, threading.Lock()
        self._lit = stored_route(model), lit
        self._estimator = IrradianceEstimator(field, *self._lit) if shaded and self._shadows.bodies else None
        self._rays = unproject(pixel_grid(*size), self.intrinsics)

    def set_intrinsics(self, intrinsics: Array) -> None:
        """Changes the camera's fx, fy, cx, cy [px], shape (4,); not while another thread renders."""
        if not np.array_equal(intrinsics, self.intrinsics):
            self.intrinsics, self._rays = intrinsics, unproject(pixel_grid(*self.size), intrinsics)
            for worker in self._workers:
                worker.renderer.set_intrinsics(intrinsics)

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Lighting | Sequence[Lighting],
        noise: Sequence[CameraNoise] | None = None,
        weather: Sequence[Weather | None] = (),
        sunlight: Sequence[Sunlight] = (),
    ) -> Rendering:
        """Renders the camera of every env.

        Args:
            datas: State of every env, with poses of geoms and cameras (after `mj_kinematics` and `mj_camlight`).
            lighting: One lighting, or one per env, as in `BakedField.render`.
            noise: Camera imperfections of each env; None: perfect cameras.
            weather: Weather of each env; None: that of the film.
            sunlight: Suns of each env's lighting; empty: the light of the film.

        Raises:
            InputError: an unknown lighting.
        """
        poses = camera_poses(datas, self._camera, noise)
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        out = self._field.render(Viewpoints.of(poses, self.intrinsics, self.size), lighting)
        lightings: list[Lighting] = [lighting] * len(datas) if one else list(lighting)  # type: ignore[list-item]

        todo = iter(range(len(datas)))  # shared by the workers: an idle one takes the next env

        def composite_all(worker: _CompositorWorker) -> None:
            for k in todo:
                suns = sunlight[k] if sunlight else ()
                out.rgb[k] = relit(out.rgb[k], out.depth[k], self._rays, poses[k], suns)
                self._add_objects(worker, datas[k], poses[k], lightings[k], out, k, suns)
                if weather and (sky := weather[k]):
                    out.rgb[k] = sky.apply(out.rgb[k], out.depth[k], self._rays, poses[k])
                if noise:
                    now = poses[k], datas[k].time, self._rays, self.intrinsics
                    out.rgb[k] = noise[k].apply(out.rgb[k], out.depth[k], *now)

        if self._pool is None:
            composite_all(self._workers[0])
        else:
            list(self._pool.map(composite_all, self._workers))
        return out

    def _add_objects(
        self,
        worker: "_CompositorWorker",
        data: mujoco.MjData,
        pose: Array,
        lighting: Lighting,
        out: Rendering,
        k: int,
        sunlight: Sunlight,
    ) -> None:
        """Draws the objects in view of a camera, and their shadows, into picture k of a rendering."""
        mask = worker.renderer.visible_mask(data, pose)
        if mask is None and not self._shadows.bodies:
            return
        irradiance = self._irradiance(lighting, sunlight)
        if irradiance is not None:
            self._shadows.darken(out.rgb[k], out.depth[k], self._rays, pose, data, irradiance)
        if mask is None:
            return
        drawn = worker.renderer.render(data, pose, mask, irradiance)
        if drawn is not None:
            left, top, width, height = drawn.window
            inner = np.s_[k, top : top + height, left : left + width]
            front = worker.foreground(pose, drawn, lighting)
            if sunlight:
                depth = np.minimum(front.depth, drawn.depth)
                rays = self._rays[top : top + height, left : left + width]
                front = replace(front, rgb=relit(front.rgb, depth, rays, pose, sunlight))
            composite(out, inner, drawn, front)

    def _irradiance(self, lighting: Lighting, sunlight: Sunlight) -> Irradiance | None:
        if not self._shaded:
            return None
        with self._lock:
            if self._estimator is None:  # there are no obstacles, but the robot's own body is in view
                self._estimator = IrradianceEstimator(self._field, *self._lit)
        return self._estimator.estimate(lighting, sunlight)


class _CompositorWorker:
    """Renderers of one thread."""

    def __init__(self, model: mujoco.MjModel, field: BakedField, camera: int, size: tuple[int, int]):
        self.renderer = ObjectRenderer(model, camera, size)
        # A field keeps render targets for few sizes, so each window size has its own copy of the field.
        self._field_of_size = lru_cache(_MAX_WINDOWS)(lambda size: field.single_threaded())

    def foreground(self, pose: Array, drawn: RenderedObjects, lighting: Lighting) -> Rendering:
        """Renders the part of the field in front of the drawn objects, in the objects' window."""
        left, top, width, height = drawn.window
        across, down = (-(-n // _WINDOW_STEP) * _WINDOW_STEP for n in (width, height))
        stop = np.zeros((1, down, across), np.float32)
        stop[0, :height, :width] = drawn.depth
        view = Viewpoints.of(pose, self.renderer.intrinsics - np.array([0.0, 0.0, left, top]), (across, down))
        out = self._field_of_size((across, down)).render(view, lighting, stop=stop)
        inner = np.s_[0, :height, :width]
        return Rendering(out.rgb[inner], out.depth[inner], out.opacity[inner])


def composite(out: Rendering, inner: tuple, drawn: RenderedObjects, front: Rendering) -> None:
    """Blends drawn objects into a window of a rendering, in place.

    Args:
        out: Rendering of the field alone.
        inner: Index that selects the window in the arrays of `out`.
        drawn: Objects in the window.
        front: The field up to `drawn.depth` in the window; its colors are not premultiplied by its opacity.
    """
    cover = drawn.coverage[..., None]
    held = front.opacity[..., None]
    covered = held * front.rgb + (1.0 - held) * soft_clip(drawn.rgb)
    out.rgb[inner] += cover * (covered - out.rgb[inner])
    mostly = drawn.coverage >= 0.5
    depth = np.where(front.opacity >= 0.5, np.minimum(front.depth, drawn.depth), drawn.depth)
    out.depth[inner] = np.where(mostly, depth, out.depth[inner])
    out.opacity[inner] += drawn.coverage * (1.0 - out.opacity[inner])
