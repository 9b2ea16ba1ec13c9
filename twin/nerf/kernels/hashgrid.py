"""Multi-resolution hash encoding (Müller et al. 2022, section 3): forward, hand-written backward, and optimizer.

*Grid position*: see `kernels/space.py`. *Level*: one grid of vertices, from coarse to fine; levels that fit are stored
densely, the others are hashed. *Table*: features of all levels, `FEATURES` floats per vertex. The backward pass is
launched level by level, so that on a CPU one thread sums each level in a fixed order, whatever the number of threads.
"""

# Warp reads annotations as values.
# mypy: ignore-errors
from twin.warp_runtime import wp

FEATURES = 4
"""Features per level; four floats are one aligned 16-byte load."""

Feature = wp.vec4f

_PRIME_Y = wp.constant(wp.uint32(2654435761))
_PRIME_Z = wp.constant(wp.uint32(805459861))


@wp.func
def vertex_index(x: wp.int32, y: wp.int32, z: wp.int32, shape: wp.vec4i, mask: wp.uint32) -> wp.int32:
    """Row of a vertex in its level's table. `shape` is (nx, ny, nz, dense?). Müller et al. 2022, eq. 4."""
    if shape[3] == 1:
        return x + shape[0] * (y + shape[1] * z)
    return wp.int32((wp.uint32(x) ^ (wp.uint32(y) * _PRIME_Y) ^ (wp.uint32(z) * _PRIME_Z)) & mask)


@wp.kernel(enable_backward=False)
def encode(
    positions: wp.array(dtype=wp.vec3f),
    table: wp.array2d(dtype=Feature),
    cells: wp.array(dtype=wp.vec3f),
    shapes: wp.array(dtype=wp.vec4i),
    mask: wp.uint32,
    start: wp.int32,
    features: wp.array2d(dtype=Feature),
):
    """Trilinear features of grid positions [start, start + dim), shape (n, levels).

    Positions are vec3 in [0, 1]; `cells` the number of cells per axis and level; `shapes` as in `vertex_index`.
    """
    i = start + wp.tid()
    p = positions[i]
    for level in range(cells.shape[0]):
        s = wp.cw_mul(p, cells[level])
        fx = wp.floor(s[0])
        fy = wp.floor(s[1])
        fz = wp.floor(s[2])
        x = wp.int32(fx)
        y = wp.int32(fy)
        z = wp.int32(fz)
        bx = s[0] - fx
        by = s[1] - fy
        bz = s[2] - fz
        ax = 1.0 - bx
        ay = 1.0 - by
        az = 1.0 - bz
        n = shapes[level]
        value = table[level, vertex_index(x, y, z, n, mask)] * (ax * ay * az)
        value += table[level, vertex_index(x + 1, y, z, n, mask)] * (bx * ay * az)
        value += table[level, vertex_index(x, y + 1, z, n, mask)] * (ax * by * az)
        value += table[level, vertex_index(x + 1, y + 1, z, n, mask)] * (bx * by * az)
        value += table[level, vertex_index(x, y, z + 1, n, mask)] * (ax * ay * bz)
        value += table[level, vertex_index(x + 1, y, z + 1, n, mask)] * (bx * ay * bz)
        value += table[level, vertex_index(x, y + 1, z + 1, n, mask)] * (ax * by * bz)
        value += table[level, vertex_index(x + 1, y + 1, z + 1, n, mask)] * (bx * by * bz)
        features[i, level] = value


@wp.kernel(enable_backward=False)
def encode_backward(
    positions: wp.array(dtype=wp.vec3f),
    cells: wp.array(dtype=wp.vec3f),
    shapes: wp.array(dtype=wp.vec4i),
    mask: wp.uint32,
    first_level: wp.int32,
    features_grad: wp.array2d(dtype=Feature),
    table_grad: wp.array2d(dtype=Feature),
):
    """Adds the gradient of `encode` to `table_grad`; launched over (levels, n) from `first_level` on."""
    k, i = wp.tid()
    level = first_level + k
    s = wp.cw_mul(positions[i], cells[level])
    fx = wp.floor(s[0])
    fy = wp.floor(s[1])
    fz = wp.floor(s[2])
    x = wp.int32(fx)
    y = wp.int32(fy)
    z = wp.int32(fz)
    bx = s[0] - fx
    by = s[1] - fy
    bz = s[2] - fz
    ax = 1.0 - bx
    ay = 1.0 - by
    az = 1.0 - bz
    n = shapes[level]
    g = features_grad[i, level]
    wp.atomic_add(table_grad, level, vertex_index(x, y, z, n, mask), g * (ax * ay * az))
    wp.atomic_add(table_grad, level, vertex_index(x + 1, y, z, n, mask), g * (bx * ay * az))
    wp.atomic_add(table_grad, level, vertex_index(x, y + 1, z, n, mask), g * (ax * by * az))
    wp.atomic_add(table_grad, level, vertex_index(x + 1, y + 1, z, n, mask), g * (bx * by * az))
    wp.atomic_add(table_grad, level, vertex_index(x, y, z + 1, n, mask), g * (ax * ay * bz))
    wp.atomic_add(table_grad, level, vertex_index(x + 1, y, z + 1, n, mask), g * (bx * ay * bz))
    wp.atomic_add(table_grad, level, vertex_index(x, y + 1, z + 1, n, mask), g * (ax * by * bz))
    wp.atomic_add(table_grad, level, vertex_index(x + 1, y + 1, z + 1, n, mask), g * (bx * by * bz))


@wp.kernel(enable_backward=False)
def adam_step(
    first_level: wp.int32,
    rate: wp.float32,
    second_correction: wp.float32,
    table: wp.array2d(dtype=Feature),
    table_grad: wp.array2d(dtype=Feature),
    first: wp.array2d(dtype=Feature),
    second: wp.array2d(dtype=Feature),
):
    """Adam step (Kingma and Ba 2015) on the rows with a gradient, which it clears; launched over (levels, rows).

    Rows without a gradient keep their values and moments, as a batch touches little of a table. `rate` is the learning
    rate over 1 − β₁ᵗ and `second_correction` is 1 / (1 − β₂ᵗ); β = (0.9, 0.99).
    """
    k, i = wp.tid()
    level = first_level + k
    g = table_grad[level, i]
    if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
        m = first[level, i] * 0.9 + g * 0.1
        v = second[level, i] * 0.99 + wp.cw_mul(g, g) * 0.01
        first[level, i] = m
        second[level, i] = v
        table[level, i] = table[level, i] - rate * Feature(
            m[0] / (wp.sqrt(v[0] * second_correction) + 1.0e-15),
            m[1] / (wp.sqrt(v[1] * second_correction) + 1.0e-15),
            m[2] / (wp.sqrt(v[2] * second_correction) + 1.0e-15),
            m[3] / (wp.sqrt(v[3] * second_correction) + 1.0e-15),
        )
        table_grad[level, i] = Feature(0.0, 0.0, 0.0, 0.0)
