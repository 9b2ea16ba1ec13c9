"""Soft shadows of obstacles on the reconstructed ground.

The sky is taken for uniform but for one *sun*, whose direction and share of the light `Light.sun` tells. Of the sky,
the ground beside an obstacle loses what its side hides; of the sun, the ground behind it loses what its outline hides,
with a penumbra that widens with the distance. So under clouds the ground darkens around the foot alone, and in sunshine
on the far side. An obstacle is two upright boxes, around its lower and its upper geoms.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.light import Light
from twin.env.obstacles import PREFIX

Array = NDArray[np.float64]

_PENUMBRA = 0.03, 0.10  # [m] half width at the foot, and per metre behind it: the sun's halo and what is unsure of it
_FILLED = 0.85  # of a box's sides that an obstacle really fills
_UNDER = 0.75  # of the sky that the ground straight below loses, as no obstacle fills its box
_SKY_REACH = 1.2  # [m] from an obstacle's side, of what is hidden of the sky
_MOST_REACH = 4.0  # [m] of a shadow behind the foot
_SKIN = 0.15  # [m] above or below the foot where a surface counts as the ground
_FAR = 25.0  # [m] of the camera, beyond which shadows are not drawn


class Shadows:
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

    def darken(self, rgb: NDArray, depth: NDArray, rays: Array, pose: Array, data: mujoco.MjData, light: Light) -> None:
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
