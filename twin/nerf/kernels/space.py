"""Contraction of unbounded space to a cube, and rays of pinhole cameras.

*Near box*: axis-aligned box [m], not contracted. *Unit position* u: per axis, the offset from the
center of the near box divided by its half side; the near box is [−1, 1]³. *Contracted position*: u inside the near box,
(2 − 1/|u|)·u/|u| outside (Barron et al. 2022, eq. 10, but with the maximum norm), so all of space is in (−2, 2)³.
*Grid position*: contracted position scaled to [0, 1]³. *Contracted meter*: inside the near box, a meter; outside
it, the length that contracts to a meter, see `expansion`. Density is per contracted meter, so at a uniform density, as
before training, the space outside the near box is no more opaque than the box.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept.
# mypy: ignore-errors
from twin.warp_runtime import wp

_TOP = 1.0 - 1.0e-6  # greatest coordinate: below 1, so that a grid position lies in a cell


@wp.struct
class Contraction:
    """Near box of the contraction."""

    center: wp.vec3f
    """[m]"""
    inverse_half: wp.vec3f
    """Inverse of the half sides [1/m]."""


@wp.struct
class Rays:
    """Rays of a batch."""

    origins: wp.array(dtype=wp.vec3f)
    """[m]"""
    directions: wp.array(dtype=wp.vec3f)
    """Unit vectors."""
    cosines: wp.array(dtype=wp.float32)
    """Cosines of the angle to the optical axis: z-depth = distance × cosine."""


@wp.func
def unit_position(box: Contraction, x: wp.vec3f) -> wp.vec3f:
    return wp.cw_mul(x - box.center, box.inverse_half)


@wp.func
def max_norm(u: wp.vec3f) -> wp.float32:
    return wp.max(wp.max(wp.abs(u[0]), wp.abs(u[1])), wp.abs(u[2]))


@wp.func
def expansion(u: wp.vec3f) -> wp.float32:
    """Meters per contracted meter in radial direction: 1 in the near box, |u|² outside."""
    m = max_norm(u)
    return wp.max(1.0, m * m)


@wp.func
def grid_position(u: wp.vec3f) -> wp.vec3f:
    """Unit position → grid position in [0, 1)."""
    m = max_norm(u)
    c = u
    if m > 1.0:
        c = u * ((2.0 - 1.0 / m) / m)
    g = c * 0.25 + wp.vec3f(0.5, 0.5, 0.5)
    return wp.vec3f(wp.clamp(g[0], 0.0, _TOP), wp.clamp(g[1], 0.0, _TOP), wp.clamp(g[2], 0.0, _TOP))


@wp.func
def grid_position_backward(u: wp.vec3f, g: wp.vec3f) -> wp.vec3f:
    """Gradient with respect to the unit position u, given the gradient g with respect to `grid_position(u)`."""
    ax = wp.abs(u[0])
    ay = wp.abs(u[1])
    az = wp.abs(u[2])
    m = wp.max(wp.max(ax, ay), az)
    if m <= 1.0:
        return g * 0.25
    along = (2.0 - 1.0 / m) / m
    slope = wp.dot(u, g) * (2.0 / (m * m * m) - 2.0 / (m * m))
    out = g * along
    if ax == m:
        out[0] += wp.sign(u[0]) * slope
    elif ay == m:
        out[1] += wp.sign(u[1]) * slope
    else:
        out[2] += wp.sign(u[2]) * slope
    return out * 0.25


@wp.kernel(enable_backward=False)
def pixel_rays(
    camera: wp.array(dtype=wp.int32),
    pixel: wp.array(dtype=wp.vec2f),
    rotation: wp.array(dtype=wp.mat33f),
    position: wp.array(dtype=wp.vec3f),
    intrinsics: wp.array(dtype=wp.vec4f),
    start: wp.int32,
    rays: Rays,
):
    """Rays through pixels (u, v) [px]; `rotation`, `position` and `intrinsics` (fx, fy, cx, cy) are per camera."""
    i = start + wp.tid()
    c = camera[i]
    k = intrinsics[c]
    p = pixel[i]
    local = wp.vec3f((p[0] - k[2]) / k[0], (p[1] - k[3]) / k[1], 1.0)
    length = wp.length(local)
    rays.origins[i] = position[c]
    rays.directions[i] = rotation[c] * (local / length)
    rays.cosines[i] = 1.0 / length


@wp.kernel(enable_backward=False)
def rays_backward(
    rays: Rays,
    distances: wp.array2d(dtype=wp.float32),
    box: Contraction,
    start: wp.int32,
    positions_grad: wp.array2d(dtype=wp.vec3f),
    origins_grad: wp.array(dtype=wp.vec3f),
    directions_grad: wp.array(dtype=wp.vec3f),
):
    """Gradients with respect to origins and directions of rays from `start` on, at fixed sample distances [m]."""
    i = start + wp.tid()
    o = rays.origins[i]
    d = rays.directions[i]
    by_origin = wp.vec3f()
    by_direction = wp.vec3f()
    for k in range(distances.shape[1]):
        t = distances[i, k]
        u = unit_position(box, o + d * t)
        g = wp.cw_mul(grid_position_backward(u, positions_grad[i, k]), box.inverse_half)
        by_origin += g
        by_direction += g * t
    origins_grad[i] = by_origin
    directions_grad[i] = by_direction
