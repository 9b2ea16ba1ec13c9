"""Compositor: a radiance field rendered with obstacles, other robots and the robot's own body in it.

Objects are shaded with the field's irradiance and throw contact shadows. For every pixel that an object covers, the
field is marched a second time up to the object's depth, so that leaves and the like stay in front, and the object is
blended in with the remaining transmittance. Uncovered pixels, and uncovered parts of pixels at edges, show the field.
"""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.camera_noise import CameraNoise, soft_clip
from twin.env.irradiance import Irradiance, IrradianceEstimator
from twin.env.mujoco_renderer import (
    FRONT_CAMERA,
    ObjectRenderer,
    RenderedObjects,
    camera_intrinsics,
    camera_poses,
)
from twin.env.obstacles import PREFIX, stored_route
from twin.env.weather import Weather
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.nerf.baked import BakedField
from twin.nerf.rendering import Rendering
from twin.runtime import available_cores
from twin.types import Array
from twin.warp_runtime import wp

# ---- contact shadows

_PENUMBRA = 0.03, 0.10
"""Half width of the penumbra at the foot [m], and its growth per metre behind the foot; includes the sun's disk, its
halo and the error of the estimated direction."""
_FILL = 0.85  # fraction of a box's sides that an obstacle really fills
_SKY_LOSS_BELOW = 0.75  # fraction of the sky's light lost straight below an obstacle, which does not fill its box
_SKY_REACH = 1.2  # [m] from an obstacle's side up to which it hides the sky
_MAX_SHADOW = 4.0  # [m] length of a shadow behind the foot
_GROUND_TOLERANCE = 0.15  # [m] above or below the foot within which a surface counts as ground
_MAX_DISTANCE = 25.0  # [m] from the camera, beyond which shadows are not drawn


class ContactShadows:
    """Soft shadows of a model's obstacles on the reconstructed ground.

    The sky is taken as uniform except for one sun, whose direction and share of the light `Irradiance.sun` estimates.
    The ground beside an obstacle loses the part of the sky that the obstacle hides; the ground behind it loses the sun
    within the obstacle's outline, with a penumbra that widens with the distance. So under clouds the ground darkens
    around the foot alone, and in sunshine on the far side. An obstacle is approximated by two upright boxes, around its
    lower and its upper geoms.
    """

    def __init__(self, model: mujoco.MjModel, geoms: NDArray[np.int64]):
        """`geoms` are those that are drawn; only obstacles among them throw shadows."""
        self._boxes: dict[int, Array] = {}
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        roots = model.body_rootid[model.geom_bodyid[geoms]]
        for body in np.unique(roots):
            if model.body(int(body)).name.startswith(PREFIX):
                self._boxes[int(body)] = _bounding_boxes(model, data, geoms[roots == body], int(body))

    @property
    def bodies(self) -> tuple[int, ...]:
        """The obstacles' bodies."""
        return tuple(self._boxes)

    def darken(
        self, rgb: NDArray, depth: NDArray, rays: Array, pose: Array, data: mujoco.MjData, irradiance: Irradiance
    ) -> None:
        """Multiplies the colors of shadowed ground, in place.

        Args:
            rgb: Colors of the field, shape (height, width, 3).
            depth: z-depth of the field [m], shape (height, width).
            rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
            data: Current poses of the bodies.
            irradiance: Irradiance of the lighting.
        """
        for body, boxes in self._boxes.items():
            foot = data.xpos[body]
            away = float((foot - pose[:3, 3]) @ pose[:3, 2])
            if not (0.0 < away < _MAX_DISTANCE) or abs(foot[2] - pose[2, 3]) > _MAX_DISTANCE:
                continue
            share, sun = irradiance.sun(foot[:2])
            size = float(np.abs(boxes[:, :, :2]).max() * np.sqrt(2.0))
            length = min(float(boxes[:, 1, 2].max() * np.linalg.norm(sun[:2]) / sun[2]), _MAX_SHADOW)
            reach = size + max(length, _SKY_REACH)
            index = np.flatnonzero(np.abs(depth - away) < reach)
            points = (rays.reshape(-1, 3)[index] * depth.ravel()[index, None]) @ pose[:3, :3].T + (pose[:3, 3] - foot)
            on = (np.abs(points[:, 2]) < _GROUND_TOLERANCE) & ((points[:, :2] ** 2).sum(1) < reach**2)
            if on.any():
                lost = _light_loss(boxes, points[on, :2], data.xmat[body].reshape(3, 3)[:2, :2], share, sun)
                rgb.reshape(-1, 3)[index[on]] *= (1.0 - lost)[:, None].astype(rgb.dtype)


def _light_loss(boxes: Array, points: Array, turn: Array, share: float, sun: Array) -> Array:
    """Fraction of the light that points of the ground lose, shape (n,).

    Args:
        boxes: Lowest and highest corners in the body frame, shape (2, 2, 3) [m].
        points: Points relative to the foot in world axes, shape (n, 2) [m].
        turn: Rotation of the body in the plane, shape (2, 2).
        share: The sun's share of the light.
        sun: Direction to the sun, shape (3,).
    """
    local = points @ turn
    azimuth = sun[:2] / max(float(np.linalg.norm(sun[:2])), 1e-9)
    slope = float(np.linalg.norm(sun[:2])) / float(sun[2])
    behind, beside = -points @ azimuth, points @ np.array([-azimuth[1], azimuth[0]])
    spread = _PENUMBRA[0] + _PENUMBRA[1] * np.maximum(behind, 0.0)
    sunlit = np.ones(len(points))
    hidden = np.zeros(len(points))
    for low, high in boxes:
        center, half = 0.5 * (low + high)[:2], 0.5 * _FILL * (high - low)[:2]
        # Sky, weighted with the cosine: an endless wall hides half of it, a box a part by its width and height.
        gap = np.linalg.norm(np.maximum(np.abs(local - center) - half, 0.0), axis=1)
        wide = np.arctan2(float(half.mean()), gap) / np.pi
        gap2 = gap**2 + 1e-6
        rise = high[2] ** 2 / (high[2] ** 2 + gap2) - low[2] ** 2 / (low[2] ** 2 + gap2)
        hidden = np.maximum(hidden, np.where(gap > 0.0, wide, _SKY_LOSS_BELOW) * rise)
        # Sun: the box projected onto the ground.
        middle = turn @ center
        axes = turn * half  # columns: half sides in the world
        across = float(np.abs(np.array([-azimuth[1], azimuth[0]]) @ axes).sum())
        along = float(np.abs(azimuth @ axes).sum())
        start, end = low[2] * slope - along, min(high[2] * slope, _MAX_SHADOW) + along
        u, v = behind + middle @ azimuth, beside - middle @ np.array([-azimuth[1], azimuth[0]])
        shadow = _smooth_step((across - v) / spread) + _smooth_step((across + v) / spread) - 1.0
        shadow *= _smooth_step((u - start) / spread) + _smooth_step((end - u) / spread) - 1.0
        sunlit *= 1.0 - np.clip(shadow, 0.0, 1.0)
    return share * (1.0 - sunlit) + (1.0 - share) * hidden


def _smooth_step(x: Array) -> Array:
    """A smooth step from 0 to 1 around x = 0, over about ±2."""
    return 0.5 + 0.5 * np.tanh(x)


def _bounding_boxes(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.int64], body: int) -> Array:
    """Boxes around an obstacle's lower and upper geoms, in its frame: lowest and highest corners, shape (2, 2, 3)."""
    signs = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T
    local = model.geom_aabb[geoms, None, :3] + signs * model.geom_aabb[geoms, None, 3:]
    turns = data.geom_xmat[geoms].reshape(-1, 3, 3)
    world = local @ turns.transpose(0, 2, 1) + data.geom_xpos[geoms, None]
    corners = (world - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
    corners[..., 2] = np.maximum(corners[..., 2], 0.0)
    middle = corners[..., 2].mean(1)
    lower = middle <= 0.5 * corners[..., 2].max()
    boxes = [corners[part].reshape(-1, 3) for part in (lower, ~lower) if part.any()]
    return np.array([[box.min(0), box.max(0)] for box in (boxes[0], boxes[-1])])


# ---- compositing

Lighting = str | NDArray

_WINDOW_STEP = 32  # [px] windows of the second march come in multiples of this, so that few sizes occur


class Compositor:
    """Renders the front cameras of envs of one model."""

    def __init__(
        self,
        model: mujoco.MjModel,
        field: BakedField,
        size: tuple[int, int] = (160, 90),
        max_envs: int = 1,
        shaded: bool = True,
    ):
        """
        Args:
            model: A model with a camera `front`, compiled after `add_obstacles` (which may add none).
            field: The place.
            size: Width, height of the pictures [px].
            max_envs: Largest number of envs per call.
            shaded: False draws obstacles in their own plain colors, for comparison.
        """
        self.size, self.max_envs, self._field = size, max_envs, field
        self._camera = model.camera(FRONT_CAMERA).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        # Warp's default device is global to the process and worker threads change it, so it is set to the CPU here.
        # On a GPU all threads share one CUDA stream, so one worker is enough.
        wp.set_device("cpu")
        count = min(max_envs, available_cores()) if field.device == "cpu" else 1
        # One after the other, as Warp compiles kernels at their first use.
        self._workers = [_CompositorWorker(model, field, self._camera, size) for _ in range(count)]
        self._pool = ThreadPoolExecutor(count) if count > 1 else None
        self._shadows = ContactShadows(model, self._workers[0].renderer.geoms)
        self._route, self._shaded, self._lock = stored_route(model), shaded, threading.Lock()
        self._estimator = IrradianceEstimator(field, self._route) if shaded and self._shadows.bodies else None
        self._rays = unproject(pixel_grid(*size), self.intrinsics)

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Lighting | Sequence[Lighting],
        noise: Sequence[CameraNoise] | None = None,
        weather: Sequence[Weather | None] = (),
    ) -> Rendering:
        """Renders the front camera of every env.

        Args:
            datas: State of every env when the picture is taken, with its time and the poses of geoms and cameras
                (`mj_forward` or `mj_kinematics` and `mj_camlight` after the last step; `HuskyPhysics.delayed_data`).
            lighting: As for `BakedField.render`: one, or one per env.
            noise: Camera imperfections of each env; None: perfect cameras.
            weather: Weather of each env; None: that of the film.

        Raises:
            InputError: an unknown lighting, or more envs than `max_envs`.
        """
        if len(datas) > self.max_envs:
            raise InputError(f"{len(datas)} envs to render; expected at most {self.max_envs}, see max_envs")
        poses = camera_poses(datas, self._camera, noise)
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        out = self._field.render(Viewpoints.of(poses, self.intrinsics, self.size), lighting)
        lightings: list[Lighting] = [lighting] * len(datas) if one else list(lighting)  # type: ignore[list-item]

        todo = iter(range(len(datas)))  # shared: each idle worker takes the next env, because cores differ in speed

        def composite_all(worker: _CompositorWorker) -> None:
            for k in todo:
                self._add_objects(worker, datas[k], poses[k], lightings[k], out, k)
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
        self, worker: "_CompositorWorker", data: mujoco.MjData, pose: Array, lighting: Lighting, out: Rendering, k: int
    ) -> None:
        """Draws the objects in view of a camera, and their shadows, into picture k of a rendering."""
        mask = worker.renderer.visible_mask(data, pose)
        if mask is None:
            return
        irradiance = self._irradiance(lighting)
        if irradiance is not None:
            self._shadows.darken(out.rgb[k], out.depth[k], self._rays, pose, data, irradiance)
        drawn = worker.renderer.render(data, pose, mask, irradiance)
        if drawn is not None:
            left, top, width, height = drawn.window
            inner = np.s_[k, top : top + height, left : left + width]
            composite(out, inner, drawn, worker.foreground(pose, drawn, lighting))

    def _irradiance(self, lighting: Lighting) -> Irradiance | None:
        if not self._shaded:
            return None
        with self._lock:
            if self._estimator is None:  # no obstacles, but the robot sees itself
                self._estimator = IrradianceEstimator(self._field, self._route)
        return self._estimator.estimate(lighting)


class _CompositorWorker:
    """Renderers of one thread."""

    def __init__(self, model: mujoco.MjModel, field: BakedField, camera: int, size: tuple[int, int]):
        self.renderer = ObjectRenderer(model, camera, size)
        self._field, self._intrinsics = field, camera_intrinsics(model, camera, size)
        self._fields: dict[tuple[int, int], BakedField] = {}

    def foreground(self, pose: Array, drawn: RenderedObjects, lighting: Lighting) -> Rendering:
        """The part of the field in front of drawn objects, in their window, arrays (height, width)."""
        left, top, width, height = drawn.window
        across, down = (-(-n // _WINDOW_STEP) * _WINDOW_STEP for n in (width, height))
        stop = np.zeros((1, down, across), np.float32)
        stop[0, :height, :width] = drawn.depth
        # One field per window size, since a field keeps render targets of few sizes.
        if (across, down) not in self._fields:
            self._fields[across, down] = self._field.single_threaded()
        view = Viewpoints.of(pose, self._intrinsics - np.array([0.0, 0.0, left, top]), (across, down))
        out = self._fields[across, down].render(view, lighting, stop=stop)
        inner = np.s_[0, :height, :width]
        return Rendering(out.rgb[inner], out.depth[inner], out.opacity[inner])


def composite(out: Rendering, inner: tuple, drawn: RenderedObjects, front: Rendering) -> None:
    """Blends drawn objects into a window of a rendering, in place.

    Args:
        out: Rendering of the field alone.
        inner: Index of the window in its arrays.
        drawn: Objects in the window.
        front: The field up to `drawn.depth`, arrays (height, width): color (not premultiplied), depth and opacity of
            the field alone.
    """
    cover = drawn.coverage[..., None]
    held = front.opacity[..., None]
    covered = held * front.rgb + (1.0 - held) * soft_clip(drawn.rgb)
    out.rgb[inner] += cover * (covered - out.rgb[inner])
    mostly = drawn.coverage >= 0.5
    depth = np.where(front.opacity >= 0.5, np.minimum(front.depth, drawn.depth), drawn.depth)
    out.depth[inner] = np.where(mostly, depth, out.depth[inner])
    out.opacity[inner] += drawn.coverage * (1.0 - out.opacity[inner])
