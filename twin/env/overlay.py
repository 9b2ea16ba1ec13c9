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

from twin.cores import cores
from twin.env.camera_effects import CameraEffects, rolled_off
from twin.env.light import FieldLight, Light
from twin.env.obstacle_view import Drawn, ObstacleView, camera_intrinsics, camera_pose
from twin.env.obstacles import route_of
from twin.env.shadow import Shadows
from twin.env.weather import Weather
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.nerf.baked import BakedField
from twin.nerf.rendering import Rendering

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Lighting = str | NDArray

_CAMERA = "front"
_WINDOW_STEP = 32  # [px] windows of the second march come in multiples of this, so that few sizes are needed


class Overlay:
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
        self._painters = [_Painter(model, field, self._camera, size) for _ in range(painters)]
        self._pool = ThreadPoolExecutor(len(self._painters)) if len(self._painters) > 1 else None
        self._shadows = Shadows(model, self._painters[0].view.geoms)
        self._route, self._shaded, self._lock = route_of(model), shaded, threading.Lock()
        self._lights = FieldLight(field, self._route) if shaded and self._shadows.bodies else None
        self._rays = unproject(pixel_grid(*size), self.intrinsics)

    def render(
        self,
        datas: Sequence[mujoco.MjData],
        lighting: Lighting | Sequence[Lighting],
        effects: Sequence[CameraEffects] | None = None,
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

        def paint(painter: _Painter) -> None:
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
        self, painter: "_Painter", data: mujoco.MjData, pose: Array, lighting: Lighting, out: Rendering, k: int
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

    def _light(self, lighting: Lighting) -> Light | None:
        if not self._shaded:
            return None
        with self._lock:
            if self._lights is None:  # no obstacles, but the robot sees itself
                self._lights = FieldLight(self._field, self._route)
        return self._lights.under(lighting)


class _Painter:
    """What one thread draws and marches with."""

    def __init__(self, model: mujoco.MjModel, field: BakedField, camera: int, size: tuple[int, int]):
        self.view = ObstacleView(model, camera, size)
        self._field, self._intrinsics = field, camera_intrinsics(model, camera, size)
        self._fronts: dict[tuple[int, int], BakedField] = {}

    def front(self, pose: Array, drawn: Drawn, lighting: Lighting) -> Rendering:
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


def composite(out: Rendering, inner: tuple, drawn: Drawn, front: Rendering) -> None:
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
