"""The march: rays through bricks of 8-bit samples, for one picture or many, on a CPU or on CUDA.

*Brick*: 8³ cells of a grid, stored as the 9³ samples on their corners, so that interpolation never leaves it. A sample
is `CHANNELS` bytes: the raw density and the features of a radiance field (see `composite.py`), each in its channel's
range. *Slot*: row of a stored brick; the *index* gives it per brick of a grid, −1 where nothing is stored. *Block*: 2³
cells. *Leap*: per block of a grid 0 where there is something in it, else d ≥ 1, the distance to the nearest such block,
in blocks along the axis where it is furthest: so far a ray may go without looking. There are two grids: the *near* one
over the near box, the *far* one, of larger cells, over all of the contracted cube.
"""

# Warp reads annotations as values, and float() makes a variable of a kernel that changes within a loop.
# mypy: ignore-errors
# ruff: noqa: RUF046
import warp as wp

from twin.nerf.kernels.composite import CHANNELS, Channels, density_of
from twin.nerf.kernels.sampler import in_near_box, is_near
from twin.nerf.kernels.space import grid_position, max_norm

CELLS = 8
"""Cells along a brick's side."""
BLOCKS = CELLS // 2
"""Blocks along a brick's side."""
CORNERS = CELLS + 1
SAMPLES = CORNERS**3

Bytes = wp.types.vector(length=CHANNELS, dtype=wp.uint8)

_CELLS = wp.constant(CELLS)
_CORNERS = wp.constant(CORNERS)
_SIDE = wp.constant(float(CELLS))
_PER_BLOCK = wp.constant(2.0)  # cells
_SAMPLES = wp.constant(SAMPLES)
_X = wp.constant(CORNERS * CORNERS)  # from one sample to the next along each axis
_Y = wp.constant(CORNERS)
_Z = wp.constant(1)
_FAR = wp.constant(100.0)  # unit positions beyond this are one with the horizon
_STEP = wp.constant(0.9)  # step inside a brick [cells]
_OPAQUE = wp.constant(0.01)  # transmittance below which nothing behind is seen
_FAINT = wp.constant(0.005)  # weight below which a step's features are not looked up
_CLEAR = wp.constant(0.001)  # share of light below which a step stops nothing
_MOST_STEPS = wp.constant(2000)


@wp.struct
class Bricks:
    """A baked field; densities apart from the features, since most steps need nothing else."""

    near_index: wp.array3d(dtype=wp.int32)
    far_index: wp.array3d(dtype=wp.int32)
    near_leap: wp.array3d(dtype=wp.uint8)
    far_leap: wp.array3d(dtype=wp.uint8)
    density: wp.array(dtype=wp.uint8)
    features: wp.array(dtype=Bytes)
    low: Channels
    step: Channels
    centre: wp.vec3f
    inverse_half: wp.vec3f
    near_cell: wp.float32
    far_cell: wp.float32
    unit: wp.float32
    near_plane: wp.float32


@wp.struct
class Place:
    """Where a grid position falls: a slot (< 0: none), the cell's lowest corner, and how far into the cell."""

    slot: wp.int32
    corner: wp.int32
    x: wp.float32
    y: wp.float32
    z: wp.float32


@wp.func
def corner(x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int32:
    return (x * _CORNERS + y) * _CORNERS + z


@wp.func
def codes(value: Bytes) -> Channels:
    out = Channels()
    for c in range(CHANNELS):
        out[c] = float(value[c])
    return out


@wp.func
def wall(q: wp.vec3f, rate: wp.vec3f, slowness: wp.vec3f, reach: wp.float32) -> wp.float32:
    """When something at q in [0, 1)³ of a block has passed `reach` − 1 blocks around it, at `rate` blocks a metre.

    `slowness` is 1 / |rate|. In metres.
    """
    x = wp.where(rate[0] > 0.0, reach - q[0], q[0] + reach - 1.0) * slowness[0]
    y = wp.where(rate[1] > 0.0, reach - q[1], q[1] + reach - 1.0) * slowness[1]
    z = wp.where(rate[2] > 0.0, reach - q[2], q[2] + reach - 1.0) * slowness[2]
    return wp.min(wp.min(x, y), z)


@wp.func
def slowness_of(rate: wp.vec3f) -> wp.vec3f:
    return wp.vec3f(
        1.0 / wp.max(wp.abs(rate[0]), 1.0e-9),
        1.0 / wp.max(wp.abs(rate[1]), 1.0e-9),
        1.0 / wp.max(wp.abs(rate[2]), 1.0e-9),
    )


@wp.func
def far_rate(u: wp.vec3f, v: wp.vec3f, m: wp.float32) -> wp.vec4f:
    """Velocity of the contracted position [unit positions per metre], and of m; see `space.py`.

    c = u·f(m) with f = (2 − 1/m)/m, so dc/dt = v·f + u·f′·dm/dt.
    """
    out = float(0.0)
    if wp.abs(u[0]) >= m:
        out = wp.sign(u[0]) * v[0]
    elif wp.abs(u[1]) >= m:
        out = wp.sign(u[1]) * v[1]
    else:
        out = wp.sign(u[2]) * v[2]
    f = (2.0 - 1.0 / m) / m
    bend = (2.0 / m - 2.0) / (m * m) * out
    c = v * f + u * bend
    return wp.vec4f(c[0], c[1], c[2], out)


@wp.kernel(enable_backward=False)
def march(
    bricks: Bricks,
    rotation: wp.array(dtype=wp.mat33f),
    position: wp.array(dtype=wp.vec3f),
    intrinsics: wp.array(dtype=wp.vec4f),
    stop: wp.array2d(dtype=wp.float32),
    width: wp.int32,
    first: wp.int32,
    features: wp.array2d(dtype=Channels),
    depth: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.vec3f),
):
    """Pixels [first, first + dim) of every camera: opacity and features, z-depth of half the light [m] (−1: nowhere).

    `stop` (cameras, pixels) is the z-depth [m] at which something else is in the way, or of shape (0, 0).
    """
    camera, i = wp.tid()
    pixel = first + i
    k = intrinsics[camera]
    local = wp.vec3f((float(pixel % width) + 0.5 - k[2]) / k[0], (float(pixel // width) + 0.5 - k[3]) / k[1], 1.0)
    cosine = 1.0 / wp.length(local)
    d = rotation[camera] * (local * cosine)
    directions[camera, pixel] = d
    o = wp.cw_mul(position[camera] - bricks.centre, bricks.inverse_half)
    v = wp.cw_mul(d, bricks.inverse_half)
    end = float(1.0e30)
    if stop.shape[0] > 0:
        end = stop[camera, pixel] / cosine
    # In the near box a ray is straight: its place in blocks is first + rate · t.
    near_blocks = wp.vec3f(
        float(bricks.near_leap.shape[0]), float(bricks.near_leap.shape[1]), float(bricks.near_leap.shape[2])
    )
    far_blocks = wp.vec3f(
        float(bricks.far_leap.shape[0]), float(bricks.far_leap.shape[1]), float(bricks.far_leap.shape[2])
    )
    start = wp.cw_mul(o * 0.5 + wp.vec3f(0.5, 0.5, 0.5), near_blocks)
    rate = wp.cw_mul(v * 0.5, near_blocks)
    slowness = slowness_of(rate)
    total = Channels()
    transmittance = float(1.0)
    median = float(-1.0)
    t = float(bricks.near_plane)
    for _ in range(_MOST_STEPS):
        if t >= end or transmittance < _OPAQUE:
            break
        p = start + rate * t
        slot = int(0)
        length = _STEP * bricks.near_cell
        shrink = float(1.0)  # contracted metres per metre
        if (
            p[0] >= 0.0
            and p[1] >= 0.0
            and p[2] >= 0.0
            and p[0] < near_blocks[0]
            and p[1] < near_blocks[1]
            and p[2] < near_blocks[2]
        ):
            i0 = int(p[0])
            i1 = int(p[1])
            i2 = int(p[2])
            leap = int(bricks.near_leap[i0, i1, i2])
            if leap > 0:
                q = wp.vec3f(p[0] - float(i0), p[1] - float(i1), p[2] - float(i2))
                t += wall(q, rate, slowness, float(leap)) + 0.02 * bricks.near_cell
                continue
            slot = bricks.near_index[i0 >> 2, i1 >> 2, i2 >> 2]
        else:
            u = o + v * t
            m = wp.max(max_norm(u), 1.0)
            if m > _FAR:
                break
            p = wp.cw_mul(grid_position(u), far_blocks)
            i0 = int(p[0])
            i1 = int(p[1])
            i2 = int(p[2])
            leap = int(bricks.far_leap[i0, i1, i2])
            if leap > 0:
                c4 = far_rate(u, v, m)
                far = wp.cw_mul(wp.vec3f(c4[0], c4[1], c4[2]) * 0.25, far_blocks)
                q = wp.vec3f(p[0] - float(i0), p[1] - float(i1), p[2] - float(i2))
                # Outwards a ray slows down, so the wall is not passed; inwards half the way is taken at most.
                t += wall(q, far, slowness_of(far), float(leap)) * wp.where(c4[3] < 0.0, 0.5, 1.0)
                t += 0.1 * bricks.far_cell * m
                continue
            slot = bricks.far_index[i0 >> 2, i1 >> 2, i2 >> 2]
            length = _STEP * bricks.far_cell * wp.max(m * 0.5, 1.0)
            shrink = 1.0 / (m * m)
            if slot < 0:  # what of the far grid the near box covers
                t += length
                continue
        # A step's density and features are those of its middle.
        c = p * _PER_BLOCK
        x = int(c[0])
        y = int(c[1])
        z = int(c[2])
        fx = c[0] - float(x)
        fy = c[1] - float(y)
        fz = c[2] - float(z)
        ax = 1.0 - fx
        ay = 1.0 - fy
        az = 1.0 - fz
        at = slot * _SAMPLES + corner(x & 7, y & 7, z & 7)
        raw = ax * (
            ay * (az * float(bricks.density[at]) + fz * float(bricks.density[at + _Z]))
            + fy * (az * float(bricks.density[at + _Y]) + fz * float(bricks.density[at + _Y + _Z]))
        ) + fx * (
            ay * (az * float(bricks.density[at + _X]) + fz * float(bricks.density[at + _X + _Z]))
            + fy * (az * float(bricks.density[at + _X + _Y]) + fz * float(bricks.density[at + _X + _Y + _Z]))
        )
        optical = density_of(bricks.low[0] + bricks.step[0] * raw, bricks.unit) * length * shrink
        if optical < _CLEAR:
            t += length
            continue
        through = wp.exp(-optical)
        w = transmittance * (1.0 - through)
        if w > _FAINT:
            value = codes(bricks.features[at]) * (ax * ay * az)
            value += codes(bricks.features[at + _Z]) * (ax * ay * fz)
            value += codes(bricks.features[at + _Y]) * (ax * fy * az)
            value += codes(bricks.features[at + _Y + _Z]) * (ax * fy * fz)
            value += codes(bricks.features[at + _X]) * (fx * ay * az)
            value += codes(bricks.features[at + _X + _Z]) * (fx * ay * fz)
            value += codes(bricks.features[at + _X + _Y]) * (fx * fy * az)
            value += codes(bricks.features[at + _X + _Y + _Z]) * (fx * fy * fz)
            total += value * w
        if median < 0.0 and transmittance * through < 0.5:
            median = t + (wp.log(transmittance / 0.5) / optical - 0.5) * length
        transmittance *= through
        t += length
    total = wp.cw_mul(total, bricks.step) + bricks.low * (1.0 - transmittance)
    total[0] = 1.0 - transmittance
    features[camera, pixel] = total
    depth[camera, pixel] = median
    if median > 0.0:
        depth[camera, pixel] = median * cosine


@wp.func
def place_of(g: wp.vec3f, near_index: wp.array3d(dtype=wp.int32), far_index: wp.array3d(dtype=wp.int32)) -> Place:
    out = Place()
    b = in_near_box(g)
    p = wp.vec3f(0.0, 0.0, 0.0)
    if is_near(b):
        p = wp.vec3f(
            b[0] * float(near_index.shape[0]), b[1] * float(near_index.shape[1]), b[2] * float(near_index.shape[2])
        )
        out.slot = near_index[int(p[0]), int(p[1]), int(p[2])]
    else:
        p = wp.vec3f(
            g[0] * float(far_index.shape[0]), g[1] * float(far_index.shape[1]), g[2] * float(far_index.shape[2])
        )
        out.slot = far_index[int(p[0]), int(p[1]), int(p[2])]
    c = (p - wp.vec3f(wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2]))) * _SIDE
    x = wp.min(int(c[0]), _CELLS - 1)
    y = wp.min(int(c[1]), _CELLS - 1)
    z = wp.min(int(c[2]), _CELLS - 1)
    out.corner = corner(x, y, z)
    out.x = c[0] - float(x)
    out.y = c[1] - float(y)
    out.z = c[2] - float(z)
    return out


@wp.func
def corner_weight(place: Place, n: wp.int32) -> wp.float32:
    """Weight of the n-th corner of a cell, n = 4·x + 2·y + z."""
    w = float(1.0)
    w *= wp.where((n & 4) > 0, place.x, 1.0 - place.x)
    w *= wp.where((n & 2) > 0, place.y, 1.0 - place.y)
    w *= wp.where((n & 1) > 0, place.z, 1.0 - place.z)
    return w


@wp.func
def corner_offset(n: wp.int32) -> wp.int32:
    return corner((n >> 2) & 1, (n >> 1) & 1, n & 1)


@wp.kernel(enable_backward=False)
def interpolate(
    positions: wp.array(dtype=wp.vec3f),
    near_index: wp.array3d(dtype=wp.int32),
    far_index: wp.array3d(dtype=wp.int32),
    values: wp.array2d(dtype=Channels),
    nothing: wp.float32,
    start: wp.int32,
    outputs: wp.array(dtype=Channels),
):
    """Raw density and features at grid positions, from samples not in bytes; no brick means raw density `nothing`."""
    i = start + wp.tid()
    place = place_of(positions[i], near_index, far_index)
    out = Channels()
    if place.slot < 0:
        out[0] = nothing
    else:
        for n in range(8):
            out += values[place.slot, place.corner + corner_offset(n)] * corner_weight(place, n)
    outputs[i] = out


@wp.kernel(enable_backward=False)
def interpolate_backward(
    positions: wp.array(dtype=wp.vec3f),
    near_index: wp.array3d(dtype=wp.int32),
    far_index: wp.array3d(dtype=wp.int32),
    outputs_grad: wp.array(dtype=Channels),
    part: wp.int32,
    parts: wp.int32,
    gradient: wp.array2d(dtype=Channels),
):
    """Adds the gradient of `interpolate`; launched once per `part` of the slots, so that the order of sums is fixed."""
    i = wp.tid()
    place = place_of(positions[i], near_index, far_index)
    if place.slot >= 0 and place.slot % parts == part:
        for n in range(8):
            wp.atomic_add(
                gradient, place.slot, place.corner + corner_offset(n), outputs_grad[i] * corner_weight(place, n)
            )


@wp.kernel(enable_backward=False)
def adam_step(
    part: wp.int32,
    parts: wp.int32,
    rates: Channels,
    second_correction: wp.float32,
    values: wp.array2d(dtype=Channels),
    gradient: wp.array2d(dtype=Channels),
    first: wp.array2d(dtype=Channels),
    second: wp.array2d(dtype=Channels),
):
    """Adam (Kingma and Ba 2015) on samples that got a gradient, which is then cleared; β = (0.9, 0.99)."""
    row, i = wp.tid()
    slot = row * parts + part
    if slot >= values.shape[0]:
        return
    g = gradient[slot, i]
    if wp.dot(g, g) > 0.0:
        m = first[slot, i] * 0.9 + g * 0.1
        v = second[slot, i] * 0.99 + wp.cw_mul(g, g) * 0.01
        first[slot, i] = m
        second[slot, i] = v
        value = values[slot, i]
        for c in range(CHANNELS):
            value[c] = value[c] - rates[c] * m[c] / (wp.sqrt(v[c] * second_correction) + 1.0e-15)
        values[slot, i] = value
        gradient[slot, i] = Channels()
