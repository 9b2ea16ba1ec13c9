"""Memory layout and lookups of a baked field for the march, compact because memory access limits the march.

Bricks and blocks: see `bricks.py`. *Skip distance*: 0 for a block with matter in it, else the Chebyshev distance d ≥ 1
in blocks to the nearest such block, for empty-space skipping.
"""

# Warp reads annotations as values.
# mypy: ignore-errors
from twin.nerf.kernels.bricks import CORNERS, SAMPLES, Bytes
from twin.nerf.kernels.composite import CHANNELS, RAW_LIMIT, Channels
from twin.nerf.kernels.vectorized import fast_exp
from twin.warp_runtime import wp

HALF_CORNERS = CORNERS // 2 + 1
"""Samples along z of half a brick."""
DENSITIES = CORNERS * 2 * CORNERS * HALF_CORNERS
"""Bytes of a brick's densities: along x, then by halves along z (the sample between them twice), then y, then z. So
the four corners of a cell's face across x lie within eight bytes, and a cache line holds many cells."""

_SAMPLES = wp.constant(SAMPLES)
_CORNERS = wp.constant(CORNERS)
_HALF = wp.constant(HALF_CORNERS)
_DENSITIES = wp.constant(DENSITIES)
_ACROSS = wp.constant(2 * CORNERS * HALF_CORNERS)  # from one face to the next
_NEXT_Y = wp.constant(8 * HALF_CORNERS)  # bits
_RAW_LIMIT = wp.constant(RAW_LIMIT)
_X = wp.constant(CORNERS * CORNERS)  # from one sample to the next along each axis
_Y = wp.constant(CORNERS)
_Z = wp.constant(1)


@wp.struct
class Bricks:
    """A baked field in the layout of the march. Grids are flat, the last axis fastest."""

    near_index: wp.array(dtype=wp.int32)
    """Slot of a brick, or −d where none is stored, d being the least skip distance of its blocks."""
    far_index: wp.array(dtype=wp.int32)
    skips: wp.array(dtype=wp.uint8)
    """Skip distances of the stored bricks' blocks, 64 per slot."""
    near_blocks: wp.vec3i
    far_blocks: wp.vec3i
    densities: wp.array(dtype=wp.uint8)
    """See `brick_layout.density_codes`."""
    features: wp.array(dtype=Bytes)
    low: Channels
    step: Channels
    center: wp.vec3f
    inverse_half: wp.vec3f
    near_cell: wp.float32
    far_cell: wp.float32
    unit: wp.float32
    near_plane: wp.float32


# Warp arrays may be strided; these are contiguous, and the compiler does better when it knows.
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
    """Skip distance of a block, or of its brick if that is not stored."""
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
    at = slot * _DENSITIES + (((i0 & 7) * 2 + ((i2 & 4) >> 2)) * _CORNERS + (i1 & 7)) * _HALF + (i2 & 3)
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
    return bricks.unit * fast_exp(wp.min(bricks.low[0] + bricks.step[0] * code, _RAW_LIMIT))


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
    at = slot * _SAMPLES + ((i0 & 7) * _CORNERS + (i1 & 7)) * _CORNERS + (i2 & 7)
    ax = 1.0 - x
    ay = 1.0 - y
    az = 1.0 - z
    value = as_floats(sample_of(bricks.features, at)) * (ax * ay * az)
    value += as_floats(sample_of(bricks.features, at + _Z)) * (ax * ay * z)
    value += as_floats(sample_of(bricks.features, at + _Y)) * (ax * y * az)
    value += as_floats(sample_of(bricks.features, at + _Y + _Z)) * (ax * y * z)
    value += as_floats(sample_of(bricks.features, at + _X)) * (x * ay * az)
    value += as_floats(sample_of(bricks.features, at + _X + _Z)) * (x * ay * z)
    value += as_floats(sample_of(bricks.features, at + _X + _Y)) * (x * y * az)
    value += as_floats(sample_of(bricks.features, at + _X + _Y + _Z)) * (x * y * z)
    return value
