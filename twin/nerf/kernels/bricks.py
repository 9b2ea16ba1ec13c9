"""Bricks: sparse storage of a baked field's samples, and the kernels that fine-tune them; `march.py` renders them.

*Brick*: 8³ cells of a grid, stored as the 9³ samples on their corners, so that interpolation never leaves the brick. A
sample is `CHANNELS` bytes: raw density and features (see `volume.py`), each scaled to the range of its channel.
*Slot*: row of a stored brick; the *index* maps each brick of a grid to its slot, or to −1 if it is not stored. *Block*:
2³ cells. The *near* grid covers the near box; the *far* grid, with larger cells, covers the contracted cube.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
from twin.nerf.kernels.volume import CHANNELS, Channels, inside_near_box, near_box_position
from twin.warp_runtime import wp

CELLS = 8
"""Cells along a brick's side."""
BLOCKS = CELLS // 2
"""Blocks along a brick's side."""
CORNERS = CELLS + 1
SAMPLES = CORNERS**3

HALF_CORNERS = CORNERS // 2 + 1
"""Samples along z of half a brick."""
DENSITIES = CORNERS * 2 * CORNERS * HALF_CORNERS
"""Number of a brick's density bytes. Their axes, slowest first, are x, half of the brick along z, y, and z in the half;
samples on the border of the halves are stored twice. In this order, the four corners of a cell's face normal to x lie
within eight bytes, and a cache line holds many cells."""

Bytes = wp.types.vector(length=CHANNELS, dtype=wp.uint8)

_MIN_GRADIENT = 1.0e-22  # positions with a smaller squared norm of the gradient are skipped
_SIDE = float(CELLS)


@wp.struct
class Bricks:
    """A baked field as `march.py` reads it. Grids are flat, the last axis fastest."""

    near_index: wp.array(dtype=wp.int32)
    """Slot of each brick, or −d if it is not stored, where d is the least skip distance (`march.py`) of its blocks."""
    far_index: wp.array(dtype=wp.int32)
    skips: wp.array(dtype=wp.uint8)
    """Skip distances of the stored bricks' blocks, 64 per slot."""
    near_blocks: wp.vec3i
    far_blocks: wp.vec3i
    densities: wp.array(dtype=wp.uint8)
    """Densities of the stored bricks, in the order described at `DENSITIES`."""
    features: wp.array(dtype=Bytes)
    low: Channels
    step: Channels
    center: wp.vec3f
    inverse_half: wp.vec3f
    near_cell: wp.float32
    far_cell: wp.float32
    unit: wp.float32
    near_plane: wp.float32


@wp.struct
class BrickIndex:
    """Slots of the near and the far grid's bricks."""

    near: wp.array3d(dtype=wp.int32)
    far: wp.array3d(dtype=wp.int32)


@wp.struct
class BrickPosition:
    """Slot of a grid position (< 0: none), index of its cell's lowest sample, and position in the cell."""

    slot: wp.int32
    corner: wp.int32
    x: wp.float32
    y: wp.float32
    z: wp.float32


@wp.func
def corner_index(x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int32:
    return (x * CORNERS + y) * CORNERS + z


@wp.func
def locate(g: wp.vec3f, index: BrickIndex) -> BrickPosition:
    out = BrickPosition()
    b = near_box_position(g)
    p = wp.vec3f(0.0, 0.0, 0.0)
    if inside_near_box(b):
        p = wp.cw_mul(b, wp.vec3f(wp.vec3i(index.near.shape[0], index.near.shape[1], index.near.shape[2])))
        out.slot = index.near[int(p[0]), int(p[1]), int(p[2])]
    else:
        p = wp.cw_mul(g, wp.vec3f(wp.vec3i(index.far.shape[0], index.far.shape[1], index.far.shape[2])))
        out.slot = index.far[int(p[0]), int(p[1]), int(p[2])]
    c = (p - wp.vec3f(wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2]))) * _SIDE
    x = wp.min(int(c[0]), CELLS - 1)
    y = wp.min(int(c[1]), CELLS - 1)
    z = wp.min(int(c[2]), CELLS - 1)
    out.corner = corner_index(x, y, z)
    out.x = c[0] - float(x)
    out.y = c[1] - float(y)
    out.z = c[2] - float(z)
    return out


@wp.func
def corner_weight(position: BrickPosition, n: wp.int32) -> wp.float32:
    """Weight of the n-th corner of a cell, n = 4·x + 2·y + z."""
    w = float(1.0)
    w *= wp.where((n & 4) > 0, position.x, 1.0 - position.x)
    w *= wp.where((n & 2) > 0, position.y, 1.0 - position.y)
    w *= wp.where((n & 1) > 0, position.z, 1.0 - position.z)
    return w


@wp.func
def corner_offset(n: wp.int32) -> wp.int32:
    return corner_index((n >> 2) & 1, (n >> 1) & 1, n & 1)


@wp.kernel(enable_backward=False)
def interpolate(
    positions: wp.array(dtype=wp.vec3f),
    index: BrickIndex,
    values: wp.array2d(dtype=Channels),
    empty_raw: wp.float32,
    start: wp.int32,
    outputs: wp.array(dtype=Channels),
):
    """Raw density and features at grid positions, from float samples; raw density `empty_raw` outside bricks."""
    i = start + wp.tid()
    position = locate(positions[i], index)
    out = Channels()
    if position.slot < 0:
        out[0] = empty_raw
    else:
        for n in range(8):
            out += values[position.slot, position.corner + corner_offset(n)] * corner_weight(position, n)
    outputs[i] = out


@wp.kernel(enable_backward=False)
def interpolate_backward(
    positions: wp.array(dtype=wp.vec3f),
    index: BrickIndex,
    outputs_grad: wp.array(dtype=Channels),
    part: wp.int32,
    parts: wp.int32,
    gradient: wp.array2d(dtype=Channels),
):
    """Adds the gradient of `interpolate`; launched once per `part` of the slots, so a CPU sums in fixed order."""
    i = wp.tid()
    g = outputs_grad[i]
    if wp.dot(g, g) < _MIN_GRADIENT:
        return
    position = locate(positions[i], index)
    if position.slot >= 0 and position.slot % parts == part:
        for n in range(8):
            wp.atomic_add(gradient, position.slot, position.corner + corner_offset(n), g * corner_weight(position, n))


@wp.func
def adam_sample(
    slot: wp.int32,
    at: wp.int32,
    rates: Channels,
    second_correction: wp.float32,
    values: wp.array2d(dtype=Channels),
    gradient: wp.array2d(dtype=Channels),
    second: wp.array2d(dtype=wp.vec2f),
):
    """Adam step of one sample, if it has a gradient."""
    g = gradient[slot, at]
    if wp.dot(g, g) > 0.0:
        own = g[0] * g[0]
        v = second[slot, at] * 0.99 + wp.vec2f(own, (wp.dot(g, g) - own) / float(CHANNELS - 1)) * 0.01
        second[slot, at] = v
        value = values[slot, at]
        value[0] = value[0] - rates[0] * g[0] / (wp.sqrt(v[0] * second_correction) + 1.0e-15)
        scale = 1.0 / (wp.sqrt(v[1] * second_correction) + 1.0e-15)
        for c in range(1, CHANNELS):
            value[c] = value[c] - rates[c] * g[c] * scale
        values[slot, at] = value
        gradient[slot, at] = Channels()


@wp.kernel(enable_backward=False)
def adam_step_everywhere(
    rates: Channels,
    second_correction: wp.float32,
    values: wp.array2d(dtype=Channels),
    gradient: wp.array2d(dtype=Channels),
    second: wp.array2d(dtype=wp.vec2f),
):
    """`adam_step` for a GPU: one thread per stored sample."""
    slot, at = wp.tid()
    adam_sample(slot, at, rates, second_correction, values, gradient, second)


@wp.kernel(enable_backward=False)
def adam_step(
    positions: wp.array(dtype=wp.vec3f),
    index: BrickIndex,
    outputs_grad: wp.array(dtype=Channels),
    part: wp.int32,
    parts: wp.int32,
    rates: Channels,
    second_correction: wp.float32,
    values: wp.array2d(dtype=Channels),
    gradient: wp.array2d(dtype=Channels),
    second: wp.array2d(dtype=wp.vec2f),
):
    """Takes an Adam step (Kingma and Ba 2015) on samples with a gradient and clears the gradient; β = (0, 0.99).

    To save memory there is no momentum, and a sample's features share one second moment. Visits the positions of
    `interpolate_backward`, as most samples get no gradient. Many positions share a sample, so this kernel is for one
    thread; `adam_step_everywhere` is for a GPU.
    """
    i = wp.tid()
    g = outputs_grad[i]
    if wp.dot(g, g) < _MIN_GRADIENT:
        return
    position = locate(positions[i], index)
    if position.slot < 0 or position.slot % parts != part:
        return
    for n in range(8):
        corner = position.corner + corner_offset(n)
        adam_sample(position.slot, corner, rates, second_correction, values, gradient, second)
