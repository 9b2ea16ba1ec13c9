"""The picture a policy gets: a radiance field with obstacles, other robots and the robot's own body put into it.

For every pixel that an obstacle covers, the field is marched a second time up to the obstacle's depth: what it holds
back in front, such as leaves, stays in front, and the obstacle is blended in by the remaining transmittance. Beside the
obstacle, and behind the uncovered share of a pixel at its edge, the field is as it is anyway.
"""

import copy
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.env.camera_noise import CameraNoise, rolled_off
from twin.env.irradiance import Irradiance, IrradianceEstimator
from twin.env.mujoco_renderer import ObjectRenderer, RenderedObjects, camera_intrinsics, camera_pose
from twin.env.obstacles import PREFIX, route_of
from twin.env.weather import Weather
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.nerf.baked import BakedField
from twin.nerf.rendering import Rendering
from twin.runtime import cores
from twin.types import Array

# ---- Soft shadows of obstacles on the reconstructed ground.
#
# The sky is taken for uniform but for one *sun*, whose direction and share of the light `Light.sun` tells. Of the sky,
# the ground beside an obstacle loses what its side hides; of the sun, the ground behind it loses what its outline hides,
# with a penumbra that widens with the distance. So under clouds the ground darkens around the foot alone, and in sunshine
# on the far side. An obstacle is two upright boxes, around its lower and its upper geoms.


_PENUMBRA = 0.03, 0.10  # [m] half width at the foot, and per metre behind it: the sun's halo and what is unsure of it
_FILLED = 0.85  # of a box's sides that an obstacle really fills
_UNDER = 0.75  # of the sky that the ground straight below loses, as no obstacle fills its box
_SKY_REACH = 1.2  # [m] from an obstacle's side, of what is hidden of the sky
_MOST_REACH = 4.0  # [m] of a shadow behind the foot
_SKIN = 0.15  # [m] above or below the foot where a surface counts as the ground
_FAR = 25.0  # [m] of the camera, beyond which shadows are not drawn


class ContactShadows:
    """Darkens pictures of a field where the obstacles of one model stand in the light."""

    def __init__(self, model: mujoco.MjModel, geoms: NDArray[np.int64]):
        """
        Args:
            model: With obstacles.
            geoms: Those that are drawn; of them only the obstacles' throw shadows.
        """
        self._boxes: dict[int, Array] = {}
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        roots = model.body_rootid[model.geom_bodyid[geoms]]
        for body in np.unique(roots):
            if model.body(int(body)).name.startswith(PREFIX):
                self._boxes[int(body)] = _two_boxes(model, data, geoms[roots == body], int(body))

    @property
    def bodies(self) -> tuple[int, ...]:
        """The obstacles' bodies."""
        return tuple(self._boxes)

    def darken(
        self, rgb: NDArray, depth: NDArray, rays: Array, pose: Array, data: mujoco.MjData, light: Irradiance
    ) -> None:
        """Multiplies the colours of shaded ground, in place.

        Args:
            rgb: Of the field, shape (height, width, 3).
            depth: z-depth of the field [m], shape (height, width).
            rays: Of the pixels, in the camera, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
            data: With poses of bodies as of now.
            light: What there is to lose.
        """
        for body, boxes in self._boxes.items():
            foot = data.xpos[body]
            away = float((foot - pose[:3, 3]) @ pose[:3, 2])
            if not (0.0 < away < _FAR) or abs(foot[2] - pose[2, 3]) > _FAR:
                continue
            share, sun = light.sun(foot[:2])
            size = float(np.abs(boxes[:, :, :2]).max() * np.sqrt(2.0))
            length = min(float(boxes[:, 1, 2].max() * np.linalg.norm(sun[:2]) / sun[2]), _MOST_REACH)
            reach = size + max(length, _SKY_REACH)
            index = np.flatnonzero(np.abs(depth - away) < reach)
            points = (rays.reshape(-1, 3)[index] * depth.ravel()[index, None]) @ pose[:3, :3].T + (pose[:3, 3] - foot)
            on = (np.abs(points[:, 2]) < _SKIN) & ((points[:, :2] ** 2).sum(1) < reach**2)
            if on.any():
                lost = _lost(boxes, points[on, :2], data.xmat[body].reshape(3, 3)[:2, :2], share, sun)
                rgb.reshape(-1, 3)[index[on]] *= (1.0 - lost)[:, None].astype(rgb.dtype)


def _lost(boxes: Array, points: Array, turn: Array, share: float, sun: Array) -> Array:
    """Share of the light that points (n, 2) of the ground, seen from the foot, lose; shape (n,).

    Args:
        boxes: Lowest and highest corner in the body, shape (2, 2, 3) [m].
        points: In world axes [m].
        turn: Of the body in the plane, shape (2, 2).
        share: Of the light that comes from the sun.
        sun: Direction to it, shape (3,).
    """
    local = points @ turn
    azimuth = sun[:2] / max(float(np.linalg.norm(sun[:2])), 1e-9)
    slope = float(np.linalg.norm(sun[:2])) / float(sun[2])
    behind, beside = -points @ azimuth, points @ np.array([-azimuth[1], azimuth[0]])
    spread = _PENUMBRA[0] + _PENUMBRA[1] * np.maximum(behind, 0.0)
    light = np.ones(len(points))
    hidden = np.zeros(len(points))
    for low, high in boxes:
        center, half = 0.5 * (low + high)[:2], 0.5 * _FILLED * (high - low)[:2]
        # The sky, weighted with the cosine: an endless wall hides half of it, a box its share by width and height.
        gap = np.linalg.norm(np.maximum(np.abs(local - center) - half, 0.0), axis=1)
        wide = np.arctan2(float(half.mean()), gap) / np.pi
        gap2 = gap**2 + 1e-6
        rise = high[2] ** 2 / (high[2] ** 2 + gap2) - low[2] ** 2 / (low[2] ** 2 + gap2)
        hidden = np.maximum(hidden, np.where(gap > 0.0, wide, _UNDER) * rise)
        # The sun: the box drawn out on the ground, away from it.
        middle = turn @ center
        axes = turn * half  # columns: half sides in the world
        across = float(np.abs(np.array([-azimuth[1], azimuth[0]]) @ axes).sum())
        along = float(np.abs(azimuth @ axes).sum())
        start, end = low[2] * slope - along, min(high[2] * slope, _MOST_REACH) + along
        u, v = behind + middle @ azimuth, beside - middle @ np.array([-azimuth[1], azimuth[0]])
        shade = _step((across - v) / spread) + _step((across + v) / spread) - 1.0
        shade *= _step((u - start) / spread) + _step((end - u) / spread) - 1.0
        light *= 1.0 - np.clip(shade, 0.0, 1.0)
    return share * (1.0 - light) + (1.0 - share) * hidden


def _step(x: Array) -> Array:
    """A smooth step from 0 to 1 around x = 0, over some ±2."""
    return 0.5 + 0.5 * np.tanh(x)


def _two_boxes(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.int64], body: int) -> Array:
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


Lighting = str | NDArray

_CAMERA = "front"
_WINDOW_STEP = 32  # [px] windows of the second march come in multiples of this, so that few sizes are needed


class Compositor:
    """Renders worlds of one model as their front cameras see them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        field: BakedField,
        size: tuple[int, int] = (160, 90),
        worlds: int = 1,
        shaded: bool = True,
    ):
        """
        Args:
            model: With a camera `front`, compiled after `add_obstacles` (be it of none).
            field: The place.
            size: Width, height of the pictures [px].
            worlds: How many worlds a call renders at most.
            shaded: False leaves obstacles in their own plain colours; to compare.
        """
        self.size, self.worlds, self._field = size, worlds, field
        self._camera = model.camera(_CAMERA).id
        self.intrinsics = camera_intrinsics(model, self._camera, size)
        # Painters draw on the CPU in threads of their own, and Warp's default device, which they set meanwhile, is the
        # process's. With a field on a GPU its stream is, too, so that one paints alone.
        wp.set_device("cpu")
        painters = min(worlds, cores()) if field.where == "cpu" else 1
        # One after the other, as Warp compiles kernels when they are first used.
        self._painters = [_CompositorThread(model, field, self._camera, size) for _ in range(painters)]
        self._pool = ThreadPoolExecutor(len(self._painters)) if len(self._painters) > 1 else None
        self._shadows = ContactShadows(model, self._painters[0].view.geoms)
        self._route, self._shaded, self._lock = route_of(model), shaded, threading.Lock()
        self._lights = IrradianceEstimator(field, self._route) if shaded and self._shadows.bodies else None
        self._rays = unproject(pixel_grid(*size), self.intrinsics)

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Lighting | Sequence[Lighting],
        effects: Sequence[CameraNoise] | None = None,
        weather: Sequence[Weather | None] = (),
    ) -> Rendering:
        """What the front camera of every world sees.

        Args:
            datas: Of every world, with its time and the poses of geoms and cameras when the picture is taken
                (`mj_forward` or `mj_kinematics` and `mj_camlight` after the last step; `HuskyPhysics.seen`).
            lighting: As `BakedField.render` takes it: one, or one per world.
            effects: What the camera of each world adds, where it is not perfect.
            weather: Of each world, where it is another than the film's.

        Raises:
            InputError: an unknown lighting, or more worlds than stated.
        """
        if len(datas) > self.worlds:
            raise InputError(f"{len(datas)} worlds to render; expected at most {self.worlds}, as it was made for")
        poses = np.stack([camera_pose(data, self._camera) for data in datas])
        if effects is not None:
            poses = np.stack([e.shaken(p, d.time) for e, p, d in zip(effects, poses, datas, strict=True)])
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        out = self._field.render(Viewpoints.of(poses, self.intrinsics, self.size), lighting)
        lightings: list[Lighting] = [lighting] * len(datas) if one else list(lighting)  # type: ignore[list-item]

        todo = iter(range(len(datas)))  # shared: whoever is done takes the next, as cores are not equally fast

        def paint(painter: _CompositorThread) -> None:
            for k in todo:
                self._paint(painter, datas[k], poses[k], lightings[k], out, k)
                if weather and (sky := weather[k]):
                    out.rgb[k] = sky.over(out.rgb[k], out.depth[k], self._rays, poses[k])
                if effects:
                    now = poses[k], datas[k].time, self._rays, self.intrinsics
                    out.rgb[k] = effects[k].exposed(out.rgb[k], out.depth[k], *now)

        if self._pool is None:
            paint(self._painters[0])
        else:
            list(self._pool.map(paint, self._painters))
        return out

    def _paint(
        self, painter: "_CompositorThread", data: mujoco.MjData, pose: Array, lighting: Lighting, out: Rendering, k: int
    ) -> None:
        """Puts into picture k of a rendering what is in view of its camera."""
        mask = painter.view.in_view(data, pose)
        if mask is None:
            return
        light = self._light(lighting)
        if light is not None:
            self._shadows.darken(out.rgb[k], out.depth[k], self._rays, pose, data, light)
        drawn = painter.view.draw(data, pose, mask, light)
        if drawn is not None:
            left, top, width, height = drawn.window
            inner = np.s_[k, top : top + height, left : left + width]
            composite(out, inner, drawn, painter.front(pose, drawn, lighting))

    def _light(self, lighting: Lighting) -> Irradiance | None:
        if not self._shaded:
            return None
        with self._lock:
            if self._lights is None:  # no obstacles, but the robot sees itself
                self._lights = IrradianceEstimator(self._field, self._route)
        return self._lights.under(lighting)


class _CompositorThread:
    """What one thread draws and marches with."""

    def __init__(self, model: mujoco.MjModel, field: BakedField, camera: int, size: tuple[int, int]):
        self.view = ObjectRenderer(model, camera, size)
        self._field, self._intrinsics = field, camera_intrinsics(model, camera, size)
        self._fronts: dict[tuple[int, int], BakedField] = {}

    def front(self, pose: Array, drawn: RenderedObjects, lighting: Lighting) -> Rendering:
        """What the field holds back in front of what is drawn, in its window, arrays (height, width)."""
        left, top, width, height = drawn.window
        across, down = (-(-n // _WINDOW_STEP) * _WINDOW_STEP for n in (width, height))
        stop = np.zeros((1, down, across), np.float32)
        stop[0, :height, :width] = drawn.depth
        if (across, down) not in self._fronts:
            # A field keeps arrays of few sizes, behind a lock, and has threads of its own: so it is copied, shallowly.
            front = copy.copy(self._field)
            front._pictures, front._lock, front._pool = {}, threading.Lock(), None
            self._fronts[across, down] = front
        view = Viewpoints.of(pose, self._intrinsics - np.array([0.0, 0.0, left, top]), (across, down))
        out = self._fronts[across, down].render(view, lighting, stop=stop)
        inner = np.s_[0, :height, :width]
        return Rendering(out.rgb[inner], out.depth[inner], out.opacity[inner])


def composite(out: Rendering, inner: tuple, drawn: RenderedObjects, front: Rendering) -> None:
    """Blends what is drawn into a window of a rendering, in place.

    Args:
        out: Of the field alone.
        inner: Index of the window in its arrays.
        drawn: What covers the window.
        front: Of the field up to `drawn.depth`: its own share's colour, depth and opacity, arrays (height, width).
    """
    cover = drawn.coverage[..., None]
    held = front.opacity[..., None]
    covered = held * front.rgb + (1.0 - held) * rolled_off(drawn.rgb)
    out.rgb[inner] += cover * (covered - out.rgb[inner])
    mostly = drawn.coverage >= 0.5
    depth = np.where(front.opacity >= 0.5, np.minimum(front.depth, drawn.depth), drawn.depth)
    out.depth[inner] = np.where(mostly, depth, out.depth[inner])
    out.opacity[inner] += drawn.coverage * (1.0 - out.opacity[inner])
