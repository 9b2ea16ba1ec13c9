"""Ray marching through bricks of 8-bit samples, for one image or many, on CPU and CUDA.

*Packet*: neighboring rays, eight to a row, that march together, one per *lane*. Loops over lanes have no branches, so
the compiler vectorizes them; on CUDA, where the hardware runs threads in parallel, a packet has one lane. *Tile*: 8 × 8
pixels; space is empty along its rays up to the distance *start* [m]. *Skip distance* of a block: its distance [blocks]
in the maximum norm from the nearest occupied block, see `baked_arrays.skip_distances`. `bricks.py` defines bricks,
blocks and grids; `space.py` defines positions.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
# ruff: noqa: RUF046
from functools import cache
from typing import Any

from twin.nerf.kernels.bricks import BLOCKS, CORNERS, DENSITIES, HALF_CORNERS, SAMPLES, Bricks, Bytes
from twin.nerf.kernels.space import grid_position, max_norm
from twin.nerf.kernels.volume import CHANNELS, RAW_LIMIT, Channels
from twin.warp_runtime import wp

TILE = 8
"""Pixels along a tile's side."""
LANES = {"cpu": 16, "cuda": 1}
"""Rays of a packet."""

OPTIONS = {
    "enable_backward": False,
    # Loops over lanes must stay loops for the compiler to vectorize them.
    "max_unroll": 0,
    "optimization_level": 3,
    "fast_math": False,
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000",
}
"""Module options of kernels with loops over lanes."""

wp.set_module_options(OPTIONS)

_FAR = 100.0  # unit positions beyond this count as the horizon
_INFINITE = 1.0e30
_STEP_CELLS = 1.0  # step inside a brick [cells]
_MIN_STEP_PIXELS = 1.0  # least step [pixel widths]
_OPAQUE = 0.06  # transmittance that counts as zero; 0.03 takes 6 % longer and gains 0.01 dB of PSNR
_MIN_WEIGHT = 0.06  # features are looked up when more weight than this has accumulated
_WAIT_RATIO = 4  # sampling waits while fewer than 1/4 of the live lanes need it
_MAX_STEPS = 1000
_MAX_CONE_STEPS = 64
_MIN_CONE_STEP = 0.5  # least step of the cone march [cells]

_ACROSS = 2 * CORNERS * HALF_CORNERS  # density bytes from one sample to the next along x
_NEXT_Y = 8 * HALF_CORNERS  # density bits from one sample to the next along y
_X = CORNERS * CORNERS  # rows of features from one sample to the next along x
_Z = 1  # rows of features from one sample to the next along z


@wp.struct
class ImageBuffers:
    """Cameras of images of one size, and the depth at which their rays end."""

    rotation: wp.array(dtype=wp.mat33f)
    position: wp.array(dtype=wp.vec3f)
    intrinsics: wp.array(dtype=wp.vec4f)
    stop: wp.array2d(dtype=wp.float32)
    """z-depth [m] of other objects, where rays end, (cameras, pixels); shape (0, 0): no objects."""
    width: wp.int32
    height: wp.int32
    across: wp.int32
    """Number of tiles in a row."""


# ---- arithmetic without calls and branches, so that the compiler vectorizes loops over lanes


@wp.func
def fast_exp(x: wp.float32) -> wp.float32:
    """e^x with a relative error of 1e-4."""
    y = wp.max(x, -80.0) * 1.4426950408889634
    n = wp.floor(y)
    f = y - n
    p = 1.0 + f * (0.69550201 + f * (0.22626982 + f * 0.07822817))
    return p * wp.cast((int(n) + 127) << 23, wp.float32)


@wp.func
def fast_log(x: wp.float32) -> wp.float32:
    """Natural logarithm of x in [1, 2] with an error of 1e-5 (Abramowitz and Stegun 1964, 4.1.43)."""
    y = x - 1.0
    return y * (0.99949556 + y * (-0.49190896 + y * (0.28947478 + y * (-0.13606275 + y * 0.03215845))))


@wp.func
def lowest_bit(bits: wp.int32) -> wp.int32:
    """Index of the lowest set bit of a positive number, read from the exponent of that bit as a float."""
    return (wp.cast(float(bits & -bits), wp.int32) >> 23) - 127


@wp.func
def nonzero(x: wp.float32) -> wp.float32:
    return wp.where(wp.abs(x) < 1.0e-9, 1.0e-9, x)


# ---- lookups, compact because memory access limits the march


# Warp arrays may be strided. These are contiguous, and native access makes that known to the compiler, which then
# generates faster code.
@wp.func_native("return array.data[i];")
def byte_of(array: wp.array(dtype=wp.uint8), i: wp.int32) -> wp.uint8: ...


@wp.func_native("return array.data[i];")
def slot_of(array: wp.array(dtype=wp.int32), i: wp.int32) -> wp.int32: ...


@wp.func_native("return array.data[i];")
def sample_of(array: wp.array(dtype=Bytes), i: wp.int32) -> Bytes: ...


@wp.func_native("unsigned long long eight; memcpy(&eight, array.data + i, 8); return eight;")
def eight_of(array: wp.array(dtype=wp.uint8), i: wp.int32) -> wp.uint64: ...


@wp.func
def brick_at(index: wp.array(dtype=wp.int32), b1: wp.int32, b2: wp.int32, i0: wp.int32, i1: wp.int32, i2: wp.int32):
    """Index entry of the brick that contains block (i0, i1, i2), for a grid of (.., b1, b2) blocks."""
    return slot_of(index, ((i0 >> 2) * (b1 >> 2) + (i1 >> 2)) * (b2 >> 2) + (i2 >> 2))


@wp.func
def skip_at(bricks: Bricks, brick: wp.int32, i0: wp.int32, i1: wp.int32, i2: wp.int32):
    """Skip distance of a block, or of its whole brick if the brick is not stored."""
    at = wp.max(brick, 0) * 64 + ((i0 & 3) * 4 + (i1 & 3)) * 4 + (i2 & 3)
    stored = int(byte_of(bricks.skips, at))
    return wp.where(brick < 0, -brick, stored)


@wp.func
def density_at(bricks: Bricks, slot: wp.int32, p0: wp.float32, p1: wp.float32, p2: wp.float32):
    """Density [1/contracted m] at a position [blocks]."""
    i0 = int(2.0 * p0)
    i1 = int(2.0 * p1)
    i2 = int(2.0 * p2)
    x = 2.0 * p0 - float(i0)
    y = 2.0 * p1 - float(i1)
    z = 2.0 * p2 - float(i2)
    at = slot * DENSITIES + (((i0 & 7) * 2 + ((i2 & 4) >> 2)) * CORNERS + (i1 & 7)) * HALF_CORNERS + (i2 & 3)
    near = eight_of(bricks.densities, at)
    far = eight_of(bricks.densities, at + _ACROSS)
    byte = wp.uint32(255)
    az = 1.0 - z
    a = wp.uint32(near)
    b = wp.uint32(near >> wp.uint64(_NEXT_Y))
    c = wp.uint32(far)
    d = wp.uint32(far >> wp.uint64(_NEXT_Y))
    v0 = az * float(a & byte) + z * float((a >> wp.uint32(8)) & byte)
    v1 = az * float(b & byte) + z * float((b >> wp.uint32(8)) & byte)
    v2 = az * float(c & byte) + z * float((c >> wp.uint32(8)) & byte)
    v3 = az * float(d & byte) + z * float((d >> wp.uint32(8)) & byte)
    code = (1.0 - x) * ((1.0 - y) * v0 + y * v1) + x * ((1.0 - y) * v2 + y * v3)
    return bricks.unit * fast_exp(wp.min(bricks.low[0] + bricks.step[0] * code, RAW_LIMIT))


@wp.func
def as_floats(value: Bytes) -> Channels:
    out = Channels()
    for c in range(CHANNELS):
        out[c] = float(value[c])
    return out


@wp.func
def features_at(bricks: Bricks, slot: wp.int32, p0: wp.float32, p1: wp.float32, p2: wp.float32) -> Channels:
    """Interpolated feature bytes at a position [blocks]."""
    i0 = int(2.0 * p0)
    i1 = int(2.0 * p1)
    i2 = int(2.0 * p2)
    x = 2.0 * p0 - float(i0)
    y = 2.0 * p1 - float(i1)
    z = 2.0 * p2 - float(i2)
    at = slot * SAMPLES + ((i0 & 7) * CORNERS + (i1 & 7)) * CORNERS + (i2 & 7)
    ax = 1.0 - x
    ay = 1.0 - y
    az = 1.0 - z
    value = as_floats(sample_of(bricks.features, at)) * (ax * ay * az)
    value += as_floats(sample_of(bricks.features, at + _Z)) * (ax * ay * z)
    value += as_floats(sample_of(bricks.features, at + CORNERS)) * (ax * y * az)
    value += as_floats(sample_of(bricks.features, at + CORNERS + _Z)) * (ax * y * z)
    value += as_floats(sample_of(bricks.features, at + _X)) * (x * ay * az)
    value += as_floats(sample_of(bricks.features, at + _X + _Z)) * (x * ay * z)
    value += as_floats(sample_of(bricks.features, at + _X + CORNERS)) * (x * y * az)
    value += as_floats(sample_of(bricks.features, at + _X + CORNERS + _Z)) * (x * y * z)
    return value


# ---- march


@wp.func
def exit_distance(p: wp.float32, slowness: wp.float32, first: wp.int32, size: wp.int32, skip: wp.int32):
    """Distance [m] after which a ray leaves the blocks that it may skip, along one axis.

    The ray is at `p` [blocks]; `slowness` is its inverse velocity [m/block]. It may skip `size` blocks from `first` on,
    and skip − 1 more on both sides.
    """
    return (float(wp.where(slowness > 0.0, first + size + skip - 1, first + 1 - skip)) - p) * slowness


@wp.func
def contracted_velocity(u: wp.vec3f, v: wp.vec3f, m: wp.float32) -> wp.vec4f:
    """Rates of change of the contracted position [1/m] and of the maximum norm m [1/m] along a ray; see `space.py`.

    c = u·f(m) with f = (2 − 1/m)/m, so dc/dt = v·f + u·f′·dm/dt.
    """
    first = wp.sign(u[0]) * v[0]
    second = wp.sign(u[1]) * v[1]
    third = wp.sign(u[2]) * v[2]
    out = wp.where(wp.abs(u[0]) >= m, first, wp.where(wp.abs(u[1]) >= m, second, third))
    f = (2.0 - 1.0 / m) / m
    bend = (2.0 / m - 2.0) / (m * m) * out
    c = v * f + u * bend
    return wp.vec4f(c[0], c[1], c[2], out)


@wp.func
def unit_ray(k: wp.vec4f, u: wp.float32, v: wp.float32) -> wp.vec3f:
    """Unit direction of the ray through (u, v) [px], in the camera frame."""
    return wp.normalize(wp.vec3f((u - k[2]) / k[0], (v - k[3]) / k[1], 1.0))


@wp.kernel(enable_backward=False)
def cone_march(bricks: Bricks, image: ImageBuffers, first: wp.int32, start: wp.array2d(dtype=wp.float32)):
    """Cone march: finds the distance [m] up to which space is empty, per camera and tile, from tile `first` on.

    The unit directions of a tile's rays differ from that of its axis by at most a chord α. So at distance t, the rays
    lie in a ball of radius α·t around a point of the axis.
    """
    camera, i = wp.tid()
    tile = first + i
    k = image.intrinsics[camera]
    side = float(TILE)
    u = float(tile % image.across) * side
    v = float(tile // image.across) * side
    axis = unit_ray(k, u + 0.5 * side, v + 0.5 * side)
    chord = wp.max(
        wp.max(wp.length(axis - unit_ray(k, u, v)), wp.length(axis - unit_ray(k, u + side, v))),
        wp.max(wp.length(axis - unit_ray(k, u, v + side)), wp.length(axis - unit_ray(k, u + side, v + side))),
    )
    blocks = wp.vec3f(bricks.near_blocks)
    unit = wp.cw_mul(image.position[camera] - bricks.center, bricks.inverse_half)
    o = wp.cw_mul(unit * 0.5 + wp.vec3f(0.5, 0.5, 0.5), blocks)
    per_meter = wp.cw_mul(bricks.inverse_half, blocks) * 0.5
    rate = wp.cw_mul(image.rotation[camera] * axis, per_meter)
    t = float(bricks.near_plane)
    for _ in range(_MAX_CONE_STEPS):
        p = o + rate * t
        if wp.min(p) < 0.0 or p[0] >= blocks[0] or p[1] >= blocks[1] or p[2] >= blocks[2]:
            break
        i0 = int(p[0])
        i1 = int(p[1])
        i2 = int(p[2])
        brick = brick_at(bricks.near_index, bricks.near_blocks[1], bricks.near_blocks[2], i0, i1, i2)
        skip = skip_at(bricks, brick, i0, i1, i2)
        size = wp.where(brick < 0, BLOCKS, 1)
        margin_blocks = float(skip - 1)
        q = p - wp.vec3f(float(i0 & -size), float(i1 & -size), float(i2 & -size))
        whole = float(size)
        margin = wp.vec3f(margin_blocks, margin_blocks, margin_blocks) + wp.min(q, wp.vec3f(whole, whole, whole) - q)
        margin = wp.min(margin, wp.min(p, blocks - p))  # beyond the near box, far bricks may block rays
        ahead = (wp.min(wp.cw_div(margin, per_meter)) - t * chord) / (1.0 + chord)
        if skip == 0 or ahead < _MIN_CONE_STEP * bricks.near_cell:
            break
        t += ahead
    start[camera, tile] = t


@cache
def march_kernel(lanes: int) -> Any:
    """Builds the marching kernel for packets of `lanes` rays, 1, 8 or 16.

    It is launched over cameras and packets, `TILE`² / lanes of them per tile. It writes opacity and composited
    features (cameras, CHANNELS, pixels), and the z-depth [m] at which half the light is blocked (−1 if less
    than half is blocked).
    """
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Ints = wp.types.vector(length=lanes, dtype=wp.int32)
    Totals = wp.types.matrix(shape=(lanes, CHANNELS), dtype=wp.float32)
    QueueBits = wp.types.vector(length=32, dtype=wp.int32)
    QueueFloats = wp.types.matrix(shape=(32, lanes), dtype=wp.float32)
    QueueInts = wp.types.matrix(shape=(32, lanes), dtype=wp.int32)
    per_tile = TILE * TILE // lanes

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def march_packets(
        bricks: Bricks,
        image: ImageBuffers,
        first: wp.int32,
        start: wp.array2d(dtype=wp.float32),
        features: wp.array3d(dtype=wp.float32),
        depth: wp.array2d(dtype=wp.float32),
    ):
        camera, packet = wp.tid()
        tile = first + packet // per_tile
        corner = (packet % per_tile) * lanes  # index, in the tile, of the packet's first pixel
        column = (tile % image.across) * TILE + corner % TILE
        row = (tile // image.across) * TILE + corner // TILE
        if row >= image.height:
            return
        k = image.intrinsics[camera]
        rotation = image.rotation[camera]
        near_blocks = wp.vec3f(bricks.near_blocks)
        far_blocks = wp.vec3f(bricks.far_blocks)
        n0 = bricks.near_blocks[0]
        n1 = bricks.near_blocks[1]
        n2 = bricks.near_blocks[2]
        f1 = bricks.far_blocks[1]
        f2 = bricks.far_blocks[2]
        unit = wp.cw_mul(image.position[camera] - bricks.center, bricks.inverse_half)
        o = wp.cw_mul(unit * 0.5 + wp.vec3f(0.5, 0.5, 0.5), near_blocks)
        per_meter = wp.cw_mul(bricks.inverse_half, near_blocks) * 0.5
        begin = start[camera, tile]

        cosine = Floats()
        r0 = Floats()  # velocity along each axis of the near grid [blocks/m]
        r1 = Floats()
        r2 = Floats()
        s0 = Floats()  # inverse of the velocity [m/block]
        s1 = Floats()
        s2 = Floats()
        enter = Floats()  # distances at which rays enter and leave the near box [m]
        leave = Floats()
        limit = Floats()
        t = Floats()
        transmittance = Floats()
        median = Floats()
        for j in range(lanes):
            x = (float(column + (j & 7)) + 0.5 - k[2]) / k[0]
            y = (float(row + (j >> 3)) + 0.5 - k[3]) / k[1]
            c = 1.0 / wp.sqrt(x * x + y * y + 1.0)
            cosine[j] = c
            a0 = nonzero((rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) * c * per_meter[0])
            a1 = nonzero((rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) * c * per_meter[1])
            a2 = nonzero((rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) * c * per_meter[2])
            r0[j] = a0
            s0[j] = 1.0 / a0
            r1[j] = a1
            s1[j] = 1.0 / a1
            r2[j] = a2
            s2[j] = 1.0 / a2
            e0 = wp.where(a0 > 0.0, o[0], o[0] - near_blocks[0]) / -a0
            e1 = wp.where(a1 > 0.0, o[1], o[1] - near_blocks[1]) / -a1
            e2 = wp.where(a2 > 0.0, o[2], o[2] - near_blocks[2]) / -a2
            l0 = wp.where(a0 > 0.0, near_blocks[0] - o[0], -o[0]) / a0
            l1 = wp.where(a1 > 0.0, near_blocks[1] - o[1], -o[1]) / a1
            l2 = wp.where(a2 > 0.0, near_blocks[2] - o[2], -o[2]) / a2
            into = wp.max(wp.max(e0, e1), e2)
            out = wp.min(wp.min(l0, l1), l2)
            enter[j] = wp.where(into < out, into, _INFINITE)
            leave[j] = out
            t[j] = begin
            transmittance[j] = 1.0
            median[j] = -1.0
            limit[j] = wp.where(
                column + (j & 7) < image.width, wp.where(row + (j >> 3) < image.height, _INFINITE, 0.0), 0.0
            )
        if image.stop.shape[0] > 0:
            for j in range(lanes):
                pixel = wp.min(row + (j >> 3), image.height - 1) * image.width + wp.min(
                    column + (j & 7), image.width - 1
                )
                limit[j] = wp.min(limit[j], image.stop[camera, pixel] / cosine[j])

        footprint = _MIN_STEP_PIXELS / k[0]  # width of a pixel per meter
        total = Totals()
        dense = Ints()  # 1 if a lane takes a sample; the next variables then describe its step
        slot = Ints()
        p0 = Floats()  # position [blocks of its grid]
        p1 = Floats()
        p2 = Floats()
        length = Floats()  # length of the step [m]
        thick = Floats()  # length of the step [contracted m]
        ahead = Floats()
        pending = Floats()  # weight of steps too faint for a feature lookup, passed on to the next step
        counted = Floats()
        # Feature lookups are queued and done together, so that only memory access limits their speed.
        queue_length = int(0)
        queued = QueueBits()
        queued_weight = QueueFloats()
        queued_slot = QueueInts()
        queued_0 = QueueFloats()
        queued_1 = QueueFloats()
        queued_2 = QueueFloats()
        for _ in range(_MAX_STEPS):
            alive_count = int(0)
            outside_count = int(0)
            sampling_count = int(0)
            for j in range(lanes):
                tj = t[j]
                alive = wp.where(tj < limit[j], 1, 0) * wp.where(transmittance[j] > _OPAQUE, 1, 0)
                near = alive * wp.where(tj >= enter[j], 1, 0) * wp.where(tj < leave[j], 1, 0)
                alive_count = alive_count + alive
                outside_count = outside_count + alive - near
                x = o[0] + r0[j] * tj
                y = o[1] + r1[j] * tj
                z = o[2] + r2[j] * tj
                # Lanes outside the box read some block of it and do not use the value.
                i0 = wp.clamp(int(wp.clamp(x, -1.0, 1.0e6)), 0, n0 - 1)
                i1 = wp.clamp(int(wp.clamp(y, -1.0, 1.0e6)), 0, n1 - 1)
                i2 = wp.clamp(int(wp.clamp(z, -1.0, 1.0e6)), 0, n2 - 1)
                brick = brick_at(bricks.near_index, n1, n2, i0, i1, i2)
                skip = skip_at(bricks, brick, i0, i1, i2)
                size = wp.where(brick < 0, BLOCKS, 1)
                w0 = exit_distance(x, s0[j], i0 & -size, size, skip)
                w1 = exit_distance(y, s1[j], i1 & -size, size, skip)
                w2 = exit_distance(z, s2[j], i2 & -size, size, skip)
                occupied = near * wp.where(skip > 0, 0, 1)
                sampling_count = sampling_count + occupied
                dense[j] = occupied
                slot[j] = wp.where(occupied > 0, brick, -1)
                p0[j] = wp.clamp(x, 0.0, near_blocks[0] - 1.0e-3)
                p1[j] = wp.clamp(y, 0.0, near_blocks[1] - 1.0e-3)
                p2[j] = wp.clamp(z, 0.0, near_blocks[2] - 1.0e-3)
                stride = _STEP_CELLS * wp.max(bricks.near_cell, footprint * tj)
                length[j] = stride
                thick[j] = stride
                advance = wp.min(wp.min(wp.min(w0, w1), w2), leave[j] - tj) + 0.02 * bricks.near_cell
                ahead[j] = wp.where(near > 0, wp.where(skip > 0, advance, stride), 0.0)
            if alive_count == 0 or queue_length == 32:
                if wp.static(lanes > 1):
                    for n in range(queue_length):
                        bits = queued[n]
                        while bits != 0:
                            j = lowest_bit(bits)
                            bits = bits & (bits - 1)
                            value = features_at(
                                bricks, queued_slot[n, j], queued_0[n, j], queued_1[n, j], queued_2[n, j]
                            )
                            for ch in range(CHANNELS):
                                total[j, ch] = total[j, ch] + value[ch] * queued_weight[n, j]
                    queue_length = 0
                if alive_count == 0:
                    break
            if outside_count > 0:
                for j in range(lanes):
                    tj = t[j]
                    alive = wp.where(tj < limit[j], 1, 0) * wp.where(transmittance[j] > _OPAQUE, 1, 0)
                    far = alive * (1 - wp.where(tj >= enter[j], 1, 0) * wp.where(tj < leave[j], 1, 0))
                    v = wp.cw_div(wp.vec3f(r0[j], r1[j], r2[j]), near_blocks) * 2.0
                    u = unit + v * wp.min(tj, 1.0e6)
                    m = wp.max(max_norm(u), 1.0)
                    g = wp.cw_mul(grid_position(u), far_blocks)
                    i0 = int(g[0])
                    i1 = int(g[1])
                    i2 = int(g[2])
                    brick = brick_at(bricks.far_index, f1, f2, i0, i1, i2)
                    skip = skip_at(bricks, brick, i0, i1, i2)
                    size = wp.where(brick < 0, BLOCKS, 1)
                    occupied = far * wp.where(skip > 0, 0, 1)
                    c4 = contracted_velocity(u, v, m)
                    q0 = 1.0 / nonzero(c4[0] * 0.25 * far_blocks[0])
                    q1 = 1.0 / nonzero(c4[1] * 0.25 * far_blocks[1])
                    q2 = 1.0 / nonzero(c4[2] * 0.25 * far_blocks[2])
                    w0 = exit_distance(g[0], q0, i0 & -size, size, skip)
                    w1 = exit_distance(g[1], q1, i1 & -size, size, skip)
                    w2 = exit_distance(g[2], q2, i2 & -size, size, skip)
                    cell = 0.5 * wp.min(wp.min(wp.abs(q0), wp.abs(q1)), wp.abs(q2))  # length of a cell here [m]
                    # On an outward ray, the contracted position is about linear in 1/m. On an inward ray its rate
                    # grows, so the ray advances by half the distance that the current rate gives.
                    advance = wp.min(wp.min(w0, w1), w2)
                    slack = 1.0 - advance * c4[3] / m
                    advance = wp.where(
                        c4[3] < 0.0,
                        0.5 * advance,
                        wp.where(slack > 0.0, advance / wp.max(slack, 1.0e-6), _INFINITE),
                    )
                    advance = advance + 0.1 * bricks.far_cell * m
                    stride = _STEP_CELLS * wp.max(
                        wp.clamp(cell, bricks.far_cell * m, 3.0 * bricks.far_cell * m), footprint * tj
                    )
                    advance = wp.where(skip > 0, advance, stride)
                    # A step ends at the border of the near box.
                    advance = wp.where(tj < enter[j], wp.min(advance, enter[j] - tj + 0.02 * bricks.near_cell), advance)
                    advance = wp.where(m > _FAR, _INFINITE, advance)
                    ahead[j] = wp.where(far > 0, advance, ahead[j])
                    slot[j] = wp.where(occupied > 0, brick, slot[j])
                    p0[j] = wp.where(occupied > 0, g[0], p0[j])
                    p1[j] = wp.where(occupied > 0, g[1], p1[j])
                    p2[j] = wp.where(occupied > 0, g[2], p2[j])
                    length[j] = wp.where(occupied > 0, stride, length[j])
                    thick[j] = wp.where(occupied > 0, stride / (m * m), thick[j])
                    dense[j] = wp.where(occupied > 0, 1, dense[j])
                    sampling_count = sampling_count + occupied
            if _WAIT_RATIO * sampling_count < alive_count:  # few lanes need a sample, so they wait until more do
                for j in range(lanes):
                    ahead[j] = wp.where(dense[j] > 0, 0.0, ahead[j])
            else:
                bits = int(0)
                # Density and features of a step are those at its middle.
                for j in range(lanes):
                    filled = wp.where(slot[j] >= 0, 1.0, 0.0)
                    density = density_at(bricks, wp.max(slot[j], 0), p0[j], p1[j], p2[j])
                    # The part of the step beyond the limit blocks nothing.
                    before_limit = wp.clamp((limit[j] - t[j]) / length[j] + 0.5, 0.0, 1.0)
                    optical = density * thick[j] * before_limit * filled
                    before = transmittance[j]
                    after = before * fast_exp(-optical)
                    half = fast_log(wp.clamp(2.0 * before, 1.0, 2.0)) / wp.max(optical, 1.0e-6)
                    crossed = wp.where(before >= 0.5, 1, 0) * wp.where(after < 0.5, 1, 0)
                    median[j] = wp.where(crossed > 0, t[j] + (half - 0.5) * length[j], median[j])
                    transmittance[j] = after
                    due = pending[j] + before - after
                    due_now = wp.where(due > _MIN_WEIGHT, 1, 0)
                    pending[j] = wp.where(due_now > 0, 0.0, due)
                    counted[j] = counted[j] + wp.where(due_now > 0, due, 0.0)
                    if wp.static(lanes > 1):
                        bits = bits | (due_now << j)
                        queued_weight[queue_length, j] = due
                        queued_slot[queue_length, j] = wp.max(slot[j], 0)
                        queued_0[queue_length, j] = p0[j]
                        queued_1[queue_length, j] = p1[j]
                        queued_2[queue_length, j] = p2[j]
                    elif due_now > 0:
                        value = features_at(bricks, wp.max(slot[j], 0), p0[j], p1[j], p2[j])
                        for ch in range(CHANNELS):
                            total[j, ch] = total[j, ch] + value[ch] * due
                if wp.static(lanes > 1):
                    queued[queue_length] = bits
                    queue_length = queue_length + wp.where(bits != 0, 1, 0)
            for j in range(lanes):
                t[j] = t[j] + ahead[j]
        for j in range(lanes):
            if column + (j & 7) < image.width and row + (j >> 3) < image.height:
                pixel = (row + (j >> 3)) * image.width + column + (j & 7)
                opacity = wp.where(transmittance[j] > _OPAQUE, 1.0 - transmittance[j], 1.0)
                share = opacity / wp.max(counted[j], 1.0e-6)
                features[camera, 0, pixel] = opacity
                for ch in range(1, CHANNELS):
                    code = total[j, ch] * bricks.step[ch] + bricks.low[ch] * counted[j]
                    features[camera, ch, pixel] = code * share
                depth[camera, pixel] = wp.where(median[j] > 0.0, median[j] * cosine[j], -1.0)

    return march_packets
