"""Where along the route, and how far beside it, a policy's pictures can be trusted (see `env/trust.py`)."""

from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps

from twin.env.trust import Trust
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, heading_at, point_at
from twin.nerf.rendering import RenderableField
from twin.report.video_layout import GROUND, INK, MUTED, draw_text
from twin.robot import CAMERA_SIZE
from twin.types import Array, Image

_STEP = 1.5  # [m] along the route
_BESIDE = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # half widths of the corridor beside it, left positive
_SIZE = (80, 45)  # [px] of the pictures that are judged
_BATCH = 32
_LOW = 0.5  # below, a picture counts as not to be trusted
_CELL = (18, 16)  # [px] width at least, height
_EDGE, _LAST = 26, 40  # [px] above and below; right, for the last label


def trust_along(field: RenderableField, cameras: Cameras, world: World) -> tuple[Array, Array, Array]:
    """Trust of what the front camera would see, looking along the route.

    Returns:
        Arc lengths [m], shape (k,); offsets beside the route, left positive [m], shape (m,); trust, shape (m, k).
    """
    s = np.arange(0.0, arc_lengths(world.route)[-1], _STEP)
    beside = np.array(_BESIDE) * world.half_width
    heading = heading_at(world.route, s)
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
    down = np.tan(np.deg2rad(world.robot.camera_pitch))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.full_like(heading, -down)], -1)
    poses = []
    for offset in beside:
        eyes = point_at(world.route, s) + offset * left + [0.0, 0.0, world.robot.camera_height]
        poses += [look_at(eye, eye + way) for eye, way in zip(eyes, ahead, strict=True)]
    judge, out = Trust(cameras), []
    for start in range(0, len(poses), _BATCH):
        batch = np.array(poses[start : start + _BATCH])
        views = Viewpoints.of(batch, world.intrinsics, CAMERA_SIZE)
        out.append(judge.of(batch, field.render(views, field.lightings[0], _SIZE)))
    return s, beside, np.concatenate(out).reshape(len(beside), len(s))


def trust_metrics(s: Array, beside: Array, trust: Array) -> dict[str, Any]:
    """Numbers of `trust_along` within the corridor, for the report."""
    trust = trust[np.abs(beside) <= np.abs(beside[beside != 0.0]).min() + 1e-9]
    return {
        "mean": float(trust.mean()),
        "lowest": float(trust.min()),
        "lowest_at_m": float(s[int(trust.min(0).argmin())]),
        "low_share": float((trust < _LOW).mean()),
    }


def trust_picture(s: Array, beside: Array, trust: Array) -> Image:
    """A map: along the route to the right, left of the route above; bright is to be trusted."""
    wide, high = max(2, _CELL[0] * 40 // max(len(s), 1)), _CELL[1]
    cells = (colormaps["viridis"](trust[::-1])[..., :3] * 255 + 0.5).astype(np.uint8)
    body = cv2.resize(cells, (wide * len(s), high * len(beside)), interpolation=cv2.INTER_NEAREST)
    out = np.empty((body.shape[0] + 2 * _EDGE, body.shape[1] + 64 + _LAST, 3), np.uint8)
    out[:] = GROUND
    out[_EDGE : _EDGE + body.shape[0], 64:-_LAST] = body
    for k, offset in enumerate(beside[::-1]):
        draw_text(out, f"{offset:+.1f} m", 58, _EDGE + k * high + 1, 11, MUTED, align="right")
    for at in np.arange(0, s[-1] + 1, 10):
        draw_text(out, f"{at:.0f} m", 64 + round(at / _STEP * wide), out.shape[0] - _EDGE + 5, 12, MUTED)
    draw_text(out, "trust, dark 0 to bright 1; along the route, and beside it", 64, 5, 12, INK)
    return out
