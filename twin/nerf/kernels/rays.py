"""Gradients from samples' features back to the rays; terms as in `hashgrid.py` and `space.py`."""

# Warp reads annotations as values.
# mypy: ignore-errors
from twin.nerf.kernels.hashgrid import Feature, vertex_index
from twin.warp_runtime import wp


@wp.kernel(enable_backward=False)
def encode_positions_backward(
    positions: wp.array(dtype=wp.vec3f),
    table: wp.array2d(dtype=Feature),
    cells: wp.array(dtype=wp.vec3f),
    shapes: wp.array(dtype=wp.vec4i),
    mask: wp.uint32,
    start: wp.int32,
    features_grad: wp.array2d(dtype=Feature),
    positions_grad: wp.array(dtype=wp.vec3f),
):
    """Gradient of `hashgrid.encode` with respect to grid positions [start, start + dim)."""
    i = start + wp.tid()
    p = positions[i]
    total = wp.vec3f()
    for level in range(cells.shape[0]):
        s = wp.cw_mul(p, cells[level])
        x = wp.int32(wp.floor(s[0]))
        y = wp.int32(wp.floor(s[1]))
        z = wp.int32(wp.floor(s[2]))
        b = s - wp.vec3f(wp.float32(x), wp.float32(y), wp.float32(z))
        a = wp.vec3f(1.0, 1.0, 1.0) - b
        n = shapes[level]
        g = features_grad[i, level]
        v000 = wp.dot(g, table[level, vertex_index(x, y, z, n, mask)])
        v100 = wp.dot(g, table[level, vertex_index(x + 1, y, z, n, mask)])
        v010 = wp.dot(g, table[level, vertex_index(x, y + 1, z, n, mask)])
        v110 = wp.dot(g, table[level, vertex_index(x + 1, y + 1, z, n, mask)])
        v001 = wp.dot(g, table[level, vertex_index(x, y, z + 1, n, mask)])
        v101 = wp.dot(g, table[level, vertex_index(x + 1, y, z + 1, n, mask)])
        v011 = wp.dot(g, table[level, vertex_index(x, y + 1, z + 1, n, mask)])
        v111 = wp.dot(g, table[level, vertex_index(x + 1, y + 1, z + 1, n, mask)])
        dx = ((v100 - v000) * a[1] + (v110 - v010) * b[1]) * a[2] + ((v101 - v001) * a[1] + (v111 - v011) * b[1]) * b[2]
        dy = ((v010 - v000) * a[0] + (v110 - v100) * b[0]) * a[2] + ((v011 - v001) * a[0] + (v111 - v101) * b[0]) * b[2]
        dz = ((v001 - v000) * a[0] + (v101 - v100) * b[0]) * a[1] + ((v011 - v010) * a[0] + (v111 - v110) * b[0]) * b[1]
        total += wp.cw_mul(wp.vec3f(dx, dy, dz), cells[level])
    positions_grad[i] = total


@wp.func
def grid_position_backward(u: wp.vec3f, g: wp.vec3f) -> wp.vec3f:
    """Gradient with respect to the unit position u, given the gradient g of `space.grid_position(u)`."""
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
def rays_backward(
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    distances: wp.array2d(dtype=wp.float32),
    center: wp.vec3f,
    inverse_half: wp.vec3f,
    start: wp.int32,
    positions_grad: wp.array2d(dtype=wp.vec3f),
    origins_grad: wp.array(dtype=wp.vec3f),
    directions_grad: wp.array(dtype=wp.vec3f),
):
    """Gradients with respect to origins and directions of rays [start, start + dim), at fixed sample distances [m]."""
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    by_origin = wp.vec3f()
    by_direction = wp.vec3f()
    for k in range(distances.shape[1]):
        t = distances[i, k]
        u = wp.cw_mul(o + d * t - center, inverse_half)
        g = wp.cw_mul(grid_position_backward(u, positions_grad[i, k]), inverse_half)
        by_origin += g
        by_direction += g * t
    origins_grad[i] = by_origin
    directions_grad[i] = by_direction
