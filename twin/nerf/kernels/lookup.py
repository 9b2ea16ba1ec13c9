"""What the march reads of a baked field: densities by the cell, features by the sample; see `bricks.py`."""

# Warp reads annotations as values.
# mypy: ignore-errors
import warp as wp

from twin.nerf.kernels.bricks import CORNERS, SAMPLES, Bytes
from twin.nerf.kernels.composite import CHANNELS, Channels

_SAMPLES = wp.constant(SAMPLES)
_CORNERS = wp.constant(CORNERS)
_X = wp.constant(CORNERS * CORNERS)  # from one sample to the next along each axis
_Y = wp.constant(CORNERS)
_Z = wp.constant(1)


@wp.struct
class Bricks:
    """A baked field as the march reads it. Grids are flat, the last axis fastest."""

    near_leap: wp.array(dtype=wp.uint8)
    far_leap: wp.array(dtype=wp.uint8)
    near_index: wp.array(dtype=wp.int32)
    far_index: wp.array(dtype=wp.int32)
    near_blocks: wp.vec3i
    far_blocks: wp.vec3i
    corners: wp.array(dtype=wp.uint64)
    """Densities on a cell's eight corners, corner 4·x + 2·y + z in the byte of that number, one cell after another."""
    features: wp.array(dtype=Bytes)
    low: Channels
    step: Channels
    centre: wp.vec3f
    inverse_half: wp.vec3f
    near_cell: wp.float32
    far_cell: wp.float32
    unit: wp.float32
    near_plane: wp.float32


@wp.func
def interpolated(cell: wp.uint64, x: wp.float32, y: wp.float32, z: wp.float32) -> wp.float32:
    """Density code at (x, y, z) in [0, 1]³ of a cell."""
    low = wp.uint32(cell)
    high = wp.uint32(cell >> wp.uint64(32))
    byte = wp.uint32(255)
    az = 1.0 - z
    v0 = az * float(low & byte) + z * float((low >> wp.uint32(8)) & byte)
    v1 = az * float((low >> wp.uint32(16)) & byte) + z * float(low >> wp.uint32(24))
    v2 = az * float(high & byte) + z * float((high >> wp.uint32(8)) & byte)
    v3 = az * float((high >> wp.uint32(16)) & byte) + z * float(high >> wp.uint32(24))
    return (1.0 - x) * ((1.0 - y) * v0 + y * v1) + x * ((1.0 - y) * v2 + y * v3)


@wp.func
def codes(value: Bytes) -> Channels:
    out = Channels()
    for c in range(CHANNELS):
        out[c] = float(value[c])
    return out


@wp.func
def features_at(bricks: Bricks, slot: wp.int32, p0: wp.float32, p1: wp.float32, p2: wp.float32) -> Channels:
    """Feature codes at a place in blocks."""
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
    value = codes(bricks.features[at]) * (ax * ay * az)
    value += codes(bricks.features[at + _Z]) * (ax * ay * z)
    value += codes(bricks.features[at + _Y]) * (ax * y * az)
    value += codes(bricks.features[at + _Y + _Z]) * (ax * y * z)
    value += codes(bricks.features[at + _X]) * (x * ay * az)
    value += codes(bricks.features[at + _X + _Z]) * (x * ay * z)
    value += codes(bricks.features[at + _X + _Y]) * (x * y * az)
    value += codes(bricks.features[at + _X + _Y + _Z]) * (x * y * z)
    return value
