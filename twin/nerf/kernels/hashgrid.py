"""Multi-resolution hash encoding (Müller et al. 2022, section 3): forward and backward pass, and optimizer.

*Grid position*: see `kernels/space.py`. *Level*: one of several grids of vertices, from coarse to fine. *Table*:
features of all levels, with the same number of rows for each, `FEATURES` floats per row. A level with no more vertices
than rows is stored densely, others are hashed. On a CPU, the trainer launches the backward pass once per level, so that
the sums of each level are added in a fixed order.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept.
# mypy: ignore-errors
from twin.warp_runtime import wp

FEATURES = 4
"""Features per level; four floats are one aligned 16-byte load."""

Feature = wp.vec4f

Eight = wp.types.vector(length=8, dtype=wp.float32)

_PRIME_Y = wp.uint32(2654435761)
_PRIME_Z = wp.uint32(805459861)


@wp.struct
class Levels:
    """The levels of a grid."""

    cells: wp.array(dtype=wp.vec3f)
    """Cells per axis."""
    shapes: wp.array(dtype=wp.vec4i)
    """Vertices per axis, and 1 if the level is stored densely."""
    mask: wp.uint32
    """Number of rows of a hashed level's table (a power of 2) minus 1."""


@wp.struct
class HashCell:
    """A cell of a level: its lowest vertex, and weights of the upper (b) and lower (a = 1 − b) vertices per axis."""

    x: wp.int32
    y: wp.int32
    z: wp.int32
    a: wp.vec3f
    b: wp.vec3f


@wp.func
def cell_at(position: wp.vec3f, cells: wp.vec3f) -> HashCell:
    s = wp.cw_mul(position, cells)
    floor = wp.vec3f(wp.floor(s[0]), wp.floor(s[1]), wp.floor(s[2]))
    cell = HashCell()
    cell.x = wp.int32(floor[0])
    cell.y = wp.int32(floor[1])
    cell.z = wp.int32(floor[2])
    cell.b = s - floor
    cell.a = wp.vec3f(1.0, 1.0, 1.0) - cell.b
    return cell


@wp.func
def vertex_index(cell: HashCell, n: wp.int32, levels: Levels, level: wp.int32) -> wp.int32:
    """Row of a cell's vertex n = x + 2·y + 4·z in the level's table (Müller et al. 2022, eq. 4)."""
    shape = levels.shapes[level]
    x = cell.x + (n & 1)
    y = cell.y + ((n >> 1) & 1)
    z = cell.z + (n >> 2)
    if shape[3] == 1:
        return x + shape[0] * (y + shape[1] * z)
    return wp.int32((wp.uint32(x) ^ (wp.uint32(y) * _PRIME_Y) ^ (wp.uint32(z) * _PRIME_Z)) & levels.mask)


@wp.func
def vertex_weight(cell: HashCell, n: wp.int32) -> wp.float32:
    """Trilinear weight of a cell's vertex n."""
    x = wp.where((n & 1) > 0, cell.b[0], cell.a[0])
    y = wp.where((n & 2) > 0, cell.b[1], cell.a[1])
    return x * y * wp.where((n & 4) > 0, cell.b[2], cell.a[2])


@wp.kernel(enable_backward=False)
def encode(
    positions: wp.array(dtype=wp.vec3f),
    table: wp.array2d(dtype=Feature),
    levels: Levels,
    start: wp.int32,
    features: wp.array2d(dtype=Feature),
):
    """Trilinearly interpolated features at grid positions from `start` on, shape (n, levels)."""
    i = start + wp.tid()
    p = positions[i]
    for level in range(levels.cells.shape[0]):
        cell = cell_at(p, levels.cells[level])
        value = Feature()
        for n in range(8):
            value += table[level, vertex_index(cell, n, levels, level)] * vertex_weight(cell, n)
        features[i, level] = value


@wp.kernel(enable_backward=False)
def encode_backward(
    positions: wp.array(dtype=wp.vec3f),
    levels: Levels,
    first_level: wp.int32,
    features_grad: wp.array2d(dtype=Feature),
    table_grad: wp.array2d(dtype=Feature),
):
    """Adds the gradient of `encode` to `table_grad`; launched over (levels, n) from `first_level` on."""
    k, i = wp.tid()
    level = first_level + k
    g = features_grad[i, level]
    # Zero gradients occur, for example, behind an opaque sample. Small ones count, because Adam normalizes them.
    if wp.dot(g, g) == 0.0:
        return
    cell = cell_at(positions[i], levels.cells[level])
    for n in range(8):
        wp.atomic_add(table_grad, level, vertex_index(cell, n, levels, level), g * vertex_weight(cell, n))


@wp.kernel(enable_backward=False)
def encode_positions_backward(
    positions: wp.array(dtype=wp.vec3f),
    table: wp.array2d(dtype=Feature),
    levels: Levels,
    start: wp.int32,
    features_grad: wp.array2d(dtype=Feature),
    positions_grad: wp.array(dtype=wp.vec3f),
):
    """Gradient of `encode` with respect to grid positions from `start` on."""
    i = start + wp.tid()
    p = positions[i]
    total = wp.vec3f()
    for level in range(levels.cells.shape[0]):
        cell = cell_at(p, levels.cells[level])
        a = cell.a
        b = cell.b
        v = Eight()
        for n in range(8):
            v[n] = wp.dot(features_grad[i, level], table[level, vertex_index(cell, n, levels, level)])
        dx = ((v[1] - v[0]) * a[1] + (v[3] - v[2]) * b[1]) * a[2] + ((v[5] - v[4]) * a[1] + (v[7] - v[6]) * b[1]) * b[2]
        dy = ((v[2] - v[0]) * a[0] + (v[3] - v[1]) * b[0]) * a[2] + ((v[6] - v[4]) * a[0] + (v[7] - v[5]) * b[0]) * b[2]
        dz = ((v[4] - v[0]) * a[0] + (v[5] - v[1]) * b[0]) * a[1] + ((v[6] - v[2]) * a[0] + (v[7] - v[3]) * b[0]) * b[1]
        total += wp.cw_mul(wp.vec3f(dx, dy, dz), levels.cells[level])
    positions_grad[i] = total


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
    """Takes an Adam step (Kingma and Ba 2015) on the rows with a gradient and clears the gradient.

    Launched over (levels, rows). Rows without a gradient keep their values and moments, as a batch touches only a small
    part of a table. `rate` is the learning rate divided by 1 − β₁ᵗ, and `second_correction` is 1 / (1 − β₂ᵗ);
    β = (0.9, 0.99).
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
        table_grad[level, i] = Feature()
