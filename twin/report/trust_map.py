"""Map of the trust estimate (`twin.env.trust`) along the route and at offsets beside it."""

from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps

from twin.env.trust import Trust
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, heading_at, point_at
from twin.nerf.rendering import RenderableField
from twin.report.video_layout import BACKGROUND, INK, MUTED, draw_text
from twin.robot import CAMERA_SIZE
from twin.types import Array, Image

_STEP = 1.5  # [m] along the route
_OFFSETS = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # lateral, in half widths of the corridor, left positive
_SIZE = (80, 45)  # [px] of the rendered views
_BATCH = 32
_LOW_TRUST = 0.5  # views below this count as untrusted
_CELL = (18, 16)  # [px] minimum width, height
_MARGIN_ROWS, _MARGIN_RIGHT = 26, 40  # [px] above and below; at the right, for the last label


def trust_grid(field: RenderableField, cameras: Cameras, world: World) -> tuple[Array, Array, Array]:
    """Estimates the trust of front camera views that look along the route.

    Returns:
        Arc lengths [m], shape (k,); lateral offsets, left positive [m], shape (m,); trust in [0, 1], shape (m, k).
    """
    s = np.arange(0.0, arc_lengths(world.route)[-1], _STEP)
    offsets = np.array(_OFFSETS) * world.half_width
    heading = heading_at(world.route, s)
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
    down = np.tan(np.deg2rad(world.robot.camera_pitch))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.full_like(heading, -down)], -1)
    poses = []
    for offset in offsets:
        eyes = point_at(world.route, s) + offset * left + [0.0, 0.0, world.robot.camera_height]
        poses += [look_at(eye, eye + direction) for eye, direction in zip(eyes, ahead, strict=True)]
    estimator, out = Trust(cameras), []
    for start in range(0, len(poses), _BATCH):
        batch = np.array(poses[start : start + _BATCH])
        views = Viewpoints.of(batch, world.intrinsics, CAMERA_SIZE)
        out.append(estimator.of(batch, field.render(views, field.lightings[0], _SIZE)))
    return s, offsets, np.concatenate(out).reshape(len(offsets), len(s))


def trust_metrics(s: Array, offsets: Array, trust: Array) -> dict[str, Any]:
    trust = trust[np.abs(offsets) <= np.abs(offsets[offsets != 0.0]).min() + 1e-9]
    return {
        "mean": float(trust.mean()),
        "lowest": float(trust.min()),
        "lowest_at_m": float(s[int(trust.min(0).argmin())]),
        "low_share": float((trust < _LOW_TRUST).mean()),
    }


def trust_picture(s: Array, offsets: Array, trust: Array) -> Image:
    """Draws the trust grid: arc length to the right, left of the route at the top, bright is trusted."""
    wide, high = max(2, _CELL[0] * 40 // max(len(s), 1)), _CELL[1]
    cells = (colormaps["viridis"](trust[::-1])[..., :3] * 255 + 0.5).astype(np.uint8)
    body = cv2.resize(cells, (wide * len(s), high * len(offsets)), interpolation=cv2.INTER_NEAREST)
    out = np.empty((body.shape[0] + 2 * _MARGIN_ROWS, body.shape[1] + 64 + _MARGIN_RIGHT, 3), np.uint8)
    out[:] = BACKGROUND
    out[_MARGIN_ROWS : _MARGIN_ROWS + body.shape[0], 64:-_MARGIN_RIGHT] = body
    for k, offset in enumerate(offsets[::-1]):
        draw_text(out, f"{offset:+.1f} m", 58, _MARGIN_ROWS + k * high + 1, 11, MUTED, align="right")
    for at in np.arange(0, s[-1] + 1, 10):
        draw_text(out, f"{at:.0f} m", 64 + round(at / _STEP * wide), out.shape[0] - _MARGIN_ROWS + 5, 12, MUTED)
    draw_text(out, "trust from 0 (dark) to 1 (bright), along the route and beside it", 64, 5, 12, INK)
    return out
