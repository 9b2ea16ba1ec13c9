"""A shadow map: how far the sun's light comes along its direction, over a plane across it, drawn once per lighting.

The map covers the road that is driven, `_RANGE`; what lies beyond it is in the light. A point is in shadow where
something lies between it and the sun; each look asks the four nearest texels and blends their answers.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, call-overload, arg-type, type-var, operator"
# (inside kernels, Warp's own types hold, which mypy does not know)

from typing import Any

import numpy as np
import warp as wp

from twin.reality.flatten import Flat

_RANGE = ((-14.0, -66.0, -1.0), (66.0, 24.0, 6.0))  # [m] what is shaded
_TEXEL = 0.03  # [m]
_FAR = 1.0e6  # [m]
_GRAZING = 12.0  # the most texels by which a surface is lifted from its own shadow


@wp.struct
class Map:
    """Axes of the plane and of the light, and the depths along it."""

    sun: int
    right: wp.vec3
    up: wp.vec3
    ray: wp.vec3
    left_bottom: wp.vec2
    depth: wp.array2d[float]


@wp.kernel
def _draw(corners: wp.array2d[wp.vec3], shadows: Map):
    i = wp.tid()
    o = shadows.left_bottom
    a = wp.vec3(wp.dot(corners[i, 0], shadows.right) - o[0], wp.dot(corners[i, 0], shadows.up) - o[1], 0.0) / _TEXEL
    b = wp.vec3(wp.dot(corners[i, 1], shadows.right) - o[0], wp.dot(corners[i, 1], shadows.up) - o[1], 0.0) / _TEXEL
    c = wp.vec3(wp.dot(corners[i, 2], shadows.right) - o[0], wp.dot(corners[i, 2], shadows.up) - o[1], 0.0) / _TEXEL
    da, db, dc = (
        wp.dot(corners[i, 0], shadows.ray),
        wp.dot(corners[i, 1], shadows.ray),
        wp.dot(corners[i, 2], shadows.ray),
    )
    area = wp.cross(b - a, c - a)[2]
    if area == 0.0:
        return
    rows, columns = shadows.depth.shape[0], shadows.depth.shape[1]
    x0 = wp.max(0, int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])))))
    x1 = wp.min(columns - 1, int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])))))
    y0 = wp.max(0, int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])))))
    y1 = wp.min(rows - 1, int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])))))
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            p = wp.vec3(float(x), float(y), 0.0)
            wa, wb = wp.cross(b - p, c - p)[2] / area, wp.cross(c - p, a - p)[2] / area
            wc = 1.0 - wa - wb
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                wp.atomic_min(shadows.depth, y, x, wa * da + wb * db + wc * dc)


@wp.func
def _free(shadows: Map, x: int, y: int, along: float):
    if x < 0 or y < 0 or x >= shadows.depth.shape[1] or y >= shadows.depth.shape[0]:
        return 1.0
    return wp.where(shadows.depth[y, x] < along, 0.0, 1.0)


@wp.func
def in_light(shadows: Map, point: wp.vec3, normal: wp.vec3):
    """Share of the sun that reaches a point [m] of a surface, 0 to 1."""
    facing = wp.max(-wp.dot(normal, shadows.ray), 1.0e-3)
    # Over half a texel's width a slanted surface rises this far towards the light; so much it must not shade itself.
    slack = _TEXEL * wp.min(wp.sqrt(1.0 - facing * facing) / facing, _GRAZING) + 0.5 * _TEXEL
    x = (wp.dot(point, shadows.right) - shadows.left_bottom[0]) / _TEXEL
    y = (wp.dot(point, shadows.up) - shadows.left_bottom[1]) / _TEXEL
    along = wp.dot(point, shadows.ray) - slack
    x0, y0 = int(wp.floor(x)), int(wp.floor(y))
    fx, fy = x - float(x0), y - float(y0)
    low = _free(shadows, x0, y0, along) * (1.0 - fx) + _free(shadows, x0 + 1, y0, along) * fx
    high = _free(shadows, x0, y0 + 1, along) * (1.0 - fx) + _free(shadows, x0 + 1, y0 + 1, along) * fx
    return low * (1.0 - fy) + high * fy


def draw(corners: wp.array, flat: Flat) -> Map:
    """The map of the first sun that casts shadows; without any, an empty one whose `sun` is −1."""
    out = Map()
    casting = np.flatnonzero(flat.sun_shadows)
    out.sun = int(casting[0]) if len(casting) else -1
    ray = flat.sun_rays[out.sun].astype(np.float64) if len(casting) else np.array([0.0, 0.0, -1.0])
    helper = np.eye(3)[np.argmin(np.abs(ray))]
    right = np.cross(ray, helper)
    right /= np.linalg.norm(right)
    up = np.cross(right, ray)
    box = np.array([[x, y, z] for x, y, z in np.array(np.meshgrid(*np.array(_RANGE).T)).reshape(3, -1).T])
    low, high = (box @ np.stack([right, up], 1)).min(0), (box @ np.stack([right, up], 1)).max(0)
    columns, rows = np.ceil((high - low) / _TEXEL).astype(int).tolist() if len(casting) else (1, 1)
    out.right, out.up, out.ray, out.left_bottom = wp.vec3(*right), wp.vec3(*up), wp.vec3(*ray), wp.vec2(*low)
    depth: Any = wp.full((rows, columns), _FAR, dtype=float, device="cpu")
    out.depth = depth
    if len(casting):
        wp.launch(_draw, len(corners), [corners, out], device="cpu")
    return out
