"""The march: rays through bricks of 8-bit samples, for one picture or many, on a CPU or on CUDA.

*Packet*: neighbouring rays, eight to a row, that march together, one per *lane*. Every loop over lanes is free of
branches, so that the compiler turns it into vector instructions; on CUDA, where the hardware does that, a packet has
one lane.
*Tile*: 8 × 8 pixels; no ray of it meets anything before the tile's *start*. For bricks, blocks and the two grids see
`bricks.py`, for leaps `lookup.py`, for positions `space.py`.
"""

# Warp reads annotations as values, and float() makes a variable of a kernel that changes within a loop.
# mypy: ignore-errors
# ruff: noqa: RUF046
from functools import cache
from typing import Any

import warp as wp

from twin.nerf.kernels.bricks import BLOCKS
from twin.nerf.kernels.composite import CHANNELS
from twin.nerf.kernels.lookup import Bricks, brick_at, density_at, features_at, leap_at
from twin.nerf.kernels.space import grid_position, max_norm
from twin.nerf.kernels.vectorised import OPTIONS, exponential, logarithm, lowest_bit, nonzero

TILE = 8
"""Pixels along a tile's side."""
LANES = {"cpu": 16, "cuda": 1}
"""Rays of a packet."""

wp.set_module_options(OPTIONS)

_TILE = wp.constant(TILE)
_BLOCKS = wp.constant(BLOCKS)
_FAR = wp.constant(100.0)  # unit positions beyond this are one with the horizon
_NEVER = wp.constant(1.0e30)
_STEP = wp.constant(1.0)  # step inside a brick [cells]
_STRIDE = wp.constant(1.0)  # nor is one shorter than this [pixel widths]
_OPAQUE = wp.constant(0.03)  # transmittance that counts as none
_FAINT = wp.constant(0.06)  # weight from which features are looked up
_PATIENCE = wp.constant(4)  # lanes alive per sampling one above which sampling waits
_MOST_STEPS = wp.constant(1000)
_MOST_APPROACHES = wp.constant(64)
_LEAST_APPROACH = wp.constant(0.5)  # of the tiles' starts [cells]


@wp.struct
class ImageBuffers:
    """Where the rays of a picture begin and end."""

    rotation: wp.array(dtype=wp.mat33f)
    position: wp.array(dtype=wp.vec3f)
    intrinsics: wp.array(dtype=wp.vec4f)
    stop: wp.array2d(dtype=wp.float32)
    """z-depth [m] at which something else is in the way, (cameras, pixels), or of shape (0, 0)."""
    width: wp.int32
    height: wp.int32
    across: wp.int32
    """Tiles in a row of tiles."""


@wp.func
def wall(p: wp.float32, slowness: wp.float32, first: wp.int32, size: wp.int32, leap: wp.int32):
    """When something at p [blocks] leaves what it may leap over [m], at `slowness` metres a block.

    That is `size` blocks from `first` on and leap − 1 more to both sides.
    """
    return (float(wp.where(slowness > 0.0, first + size + leap - 1, first + 1 - leap)) - p) * slowness


@wp.func
def far_rate(u: wp.vec3f, v: wp.vec3f, m: wp.float32) -> wp.vec4f:
    """Velocity of the contracted position [unit positions per metre], and of m; see `space.py`.

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
    """Direction of the ray through (u, v) [px], in the camera."""
    return wp.normalize(wp.vec3f((u - k[2]) / k[0], (v - k[3]) / k[1], 1.0))


@wp.kernel(enable_backward=False)
def approach(bricks: Bricks, film: ImageBuffers, first: wp.int32, start: wp.array2d(dtype=wp.float32)):
    """Starts of the tiles [first, first + dim) of every camera: distances from it [m] before which there is nothing.

    Rays of a tile lie within a chord α of its axis, so at distance t in a ball of radius α·t around the axis.
    """
    camera, i = wp.tid()
    tile = first + i
    k = film.intrinsics[camera]
    side = float(_TILE)
    u = float(tile % film.across) * side
    v = float(tile // film.across) * side
    axis = unit_ray(k, u + 0.5 * side, v + 0.5 * side)
    chord = wp.max(
        wp.max(wp.length(axis - unit_ray(k, u, v)), wp.length(axis - unit_ray(k, u + side, v))),
        wp.max(wp.length(axis - unit_ray(k, u, v + side)), wp.length(axis - unit_ray(k, u + side, v + side))),
    )
    blocks = wp.vec3f(float(bricks.near_blocks[0]), float(bricks.near_blocks[1]), float(bricks.near_blocks[2]))
    unit = wp.cw_mul(film.position[camera] - bricks.centre, bricks.inverse_half)
    o = wp.cw_mul(unit * 0.5 + wp.vec3f(0.5, 0.5, 0.5), blocks)
    per_metre = wp.cw_mul(bricks.inverse_half, blocks) * 0.5
    rate = wp.cw_mul(film.rotation[camera] * axis, per_metre)
    t = float(bricks.near_plane)
    for _ in range(_MOST_APPROACHES):
        p = o + rate * t
        if wp.min(p) < 0.0 or p[0] >= blocks[0] or p[1] >= blocks[1] or p[2] >= blocks[2]:
            break
        i0 = int(p[0])
        i1 = int(p[1])
        i2 = int(p[2])
        brick = brick_at(bricks.near_index, bricks.near_blocks[1], bricks.near_blocks[2], i0, i1, i2)
        leap = leap_at(bricks, brick, i0, i1, i2)
        size = wp.where(brick < 0, _BLOCKS, 1)
        free = float(leap - 1)
        q = p - wp.vec3f(float(i0 & -size), float(i1 & -size), float(i2 & -size))
        whole = float(size)
        margin = wp.vec3f(free, free, free) + wp.min(q, wp.vec3f(whole, whole, whole) - q)
        ahead = (wp.min(wp.cw_div(margin, per_metre)) - t * chord) / (1.0 + chord)
        if leap == 0 or ahead < _LEAST_APPROACH * bricks.near_cell:
            break
        t += ahead
    start[camera, tile] = t


@cache
def march(lanes: int) -> Any:
    """The march's kernel for packets of `lanes` rays, 1, 8 or 16.

    Launched over cameras and `TILE`² / lanes packets for each of some tiles. It takes the bricks, the film, the first
    of the tiles and the tiles' starts; it writes opacity and composited features (cameras, CHANNELS, pixels), and the
    z-depth of half the light [m] (−1: nowhere).
    """
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Ints = wp.types.vector(length=lanes, dtype=wp.int32)
    Totals = wp.types.matrix(shape=(lanes, CHANNELS), dtype=wp.float32)
    Noted = wp.types.vector(length=32, dtype=wp.int32)
    NotedFloats = wp.types.matrix(shape=(32, lanes), dtype=wp.float32)
    NotedInts = wp.types.matrix(shape=(32, lanes), dtype=wp.int32)
    notes = wp.constant(32)
    count = wp.constant(lanes)
    per_tile = wp.constant(TILE * TILE // lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def march_packets(
        bricks: Bricks,
        film: ImageBuffers,
        first: wp.int32,
        start: wp.array2d(dtype=wp.float32),
        features: wp.array3d(dtype=wp.float32),
        depth: wp.array2d(dtype=wp.float32),
    ):
        camera, packet = wp.tid()
        tile = first + packet // per_tile
        corner = (packet % per_tile) * count  # of the packet, in its tile
        column = (tile % film.across) * _TILE + corner % _TILE
        row = (tile // film.across) * _TILE + corner // _TILE
        if row >= film.height:
            return
        k = film.intrinsics[camera]
        rotation = film.rotation[camera]
        near_blocks = wp.vec3f(float(bricks.near_blocks[0]), float(bricks.near_blocks[1]), float(bricks.near_blocks[2]))
        far_blocks = wp.vec3f(float(bricks.far_blocks[0]), float(bricks.far_blocks[1]), float(bricks.far_blocks[2]))
        n0 = bricks.near_blocks[0]
        n1 = bricks.near_blocks[1]
        n2 = bricks.near_blocks[2]
        f1 = bricks.far_blocks[1]
        f2 = bricks.far_blocks[2]
        unit = wp.cw_mul(film.position[camera] - bricks.centre, bricks.inverse_half)
        o = wp.cw_mul(unit * 0.5 + wp.vec3f(0.5, 0.5, 0.5), near_blocks)
        per_metre = wp.cw_mul(bricks.inverse_half, near_blocks) * 0.5
        begin = start[camera, tile]

        cosine = Floats()
        r0 = Floats()  # along each axis of the near grid [blocks/m]
        r1 = Floats()
        r2 = Floats()
        s0 = Floats()  # [m/block]
        s1 = Floats()
        s2 = Floats()
        enter = Floats()  # of the near box [m]
        leave = Floats()
        limit = Floats()
        t = Floats()
        transmittance = Floats()
        median = Floats()
        for j in range(count):
            x = (float(column + (j & 7)) + 0.5 - k[2]) / k[0]
            y = (float(row + (j >> 3)) + 0.5 - k[3]) / k[1]
            c = 1.0 / wp.sqrt(x * x + y * y + 1.0)
            cosine[j] = c
            a0 = nonzero((rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) * c * per_metre[0])
            a1 = nonzero((rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) * c * per_metre[1])
            a2 = nonzero((rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) * c * per_metre[2])
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
            enter[j] = wp.where(into < out, into, _NEVER)
            leave[j] = out
            t[j] = begin
            transmittance[j] = 1.0
            median[j] = -1.0
            limit[j] = wp.where(column + (j & 7) < film.width, wp.where(row + (j >> 3) < film.height, _NEVER, 0.0), 0.0)
        if film.stop.shape[0] > 0:
            for j in range(count):
                pixel = wp.min(row + (j >> 3), film.height - 1) * film.width + wp.min(column + (j & 7), film.width - 1)
                limit[j] = wp.min(limit[j], film.stop[camera, pixel] / cosine[j])

        footprint = _STRIDE / k[0]  # of a pixel, per metre
        total = Totals()
        dense = Ints()  # whether a lane samples, and if so what:
        slot = Ints()
        p0 = Floats()  # where, in blocks of its grid
        p1 = Floats()
        p2 = Floats()
        length = Floats()  # of the step [m]
        thick = Floats()  # ... in contracted metres
        ahead = Floats()
        pending = Floats()  # weight of steps too faint to look up features for, passed on to the next step
        counted = Floats()
        # Steps whose features are wanted are noted and looked up together: a look-up then waits for none but memory.
        note = int(0)
        noted = Noted()
        noted_weight = NotedFloats()
        noted_slot = NotedInts()
        noted_0 = NotedFloats()
        noted_1 = NotedFloats()
        noted_2 = NotedFloats()
        for _ in range(_MOST_STEPS):
            alive = int(0)
            outside = int(0)
            sampling = int(0)
            for j in range(count):
                tj = t[j]
                living = wp.where(tj < limit[j], 1, 0) * wp.where(transmittance[j] > _OPAQUE, 1, 0)
                near = living * wp.where(tj >= enter[j], 1, 0) * wp.where(tj < leave[j], 1, 0)
                alive = alive + living
                outside = outside + living - near
                x = o[0] + r0[j] * tj
                y = o[1] + r1[j] * tj
                z = o[2] + r2[j] * tj
                # Lanes outside the box look up some block of it, in vain.
                i0 = wp.clamp(int(wp.clamp(x, -1.0, 1.0e6)), 0, n0 - 1)
                i1 = wp.clamp(int(wp.clamp(y, -1.0, 1.0e6)), 0, n1 - 1)
                i2 = wp.clamp(int(wp.clamp(z, -1.0, 1.0e6)), 0, n2 - 1)
                brick = brick_at(bricks.near_index, n1, n2, i0, i1, i2)
                leap = leap_at(bricks, brick, i0, i1, i2)
                size = wp.where(brick < 0, _BLOCKS, 1)
                w0 = wall(x, s0[j], i0 & -size, size, leap)
                w1 = wall(y, s1[j], i1 & -size, size, leap)
                w2 = wall(z, s2[j], i2 & -size, size, leap)
                there = near * wp.where(leap > 0, 0, 1)
                sampling = sampling + there
                dense[j] = there
                slot[j] = wp.where(there > 0, brick, -1)
                p0[j] = wp.clamp(x, 0.0, near_blocks[0] - 1.0e-3)
                p1[j] = wp.clamp(y, 0.0, near_blocks[1] - 1.0e-3)
                p2[j] = wp.clamp(z, 0.0, near_blocks[2] - 1.0e-3)
                stride = _STEP * wp.max(bricks.near_cell, footprint * tj)
                length[j] = stride
                thick[j] = stride
                go = wp.min(wp.min(wp.min(w0, w1), w2), leave[j] - tj) + 0.02 * bricks.near_cell
                ahead[j] = wp.where(near > 0, wp.where(leap > 0, go, stride), 0.0)
            if alive == 0 or note == notes:
                for n in range(note):
                    bits = noted[n]
                    while bits != 0:
                        j = lowest_bit(bits)
                        bits = bits & (bits - 1)
                        value = features_at(bricks, noted_slot[n, j], noted_0[n, j], noted_1[n, j], noted_2[n, j])
                        for ch in range(CHANNELS):
                            total[j, ch] = total[j, ch] + value[ch] * noted_weight[n, j]
                note = 0
                if alive == 0:
                    break
            if outside > 0:
                for j in range(count):
                    tj = t[j]
                    living = wp.where(tj < limit[j], 1, 0) * wp.where(transmittance[j] > _OPAQUE, 1, 0)
                    far = living * (1 - wp.where(tj >= enter[j], 1, 0) * wp.where(tj < leave[j], 1, 0))
                    v = wp.cw_div(wp.vec3f(r0[j], r1[j], r2[j]), near_blocks) * 2.0
                    u = unit + v * wp.min(tj, 1.0e6)
                    m = wp.max(max_norm(u), 1.0)
                    g = wp.cw_mul(grid_position(u), far_blocks)
                    i0 = int(g[0])
                    i1 = int(g[1])
                    i2 = int(g[2])
                    brick = brick_at(bricks.far_index, f1, f2, i0, i1, i2)
                    leap = leap_at(bricks, brick, i0, i1, i2)
                    size = wp.where(brick < 0, _BLOCKS, 1)
                    there = far * wp.where(leap > 0, 0, 1)
                    c4 = far_rate(u, v, m)
                    q0 = 1.0 / nonzero(c4[0] * 0.25 * far_blocks[0])
                    q1 = 1.0 / nonzero(c4[1] * 0.25 * far_blocks[1])
                    q2 = 1.0 / nonzero(c4[2] * 0.25 * far_blocks[2])
                    w0 = wall(g[0], q0, i0 & -size, size, leap)
                    w1 = wall(g[1], q1, i1 & -size, size, leap)
                    w2 = wall(g[2], q2, i2 & -size, size, leap)
                    cell = 0.5 * wp.min(wp.min(wp.abs(q0), wp.abs(q1)), wp.abs(q2))  # what a cell is long here [m]
                    # Outwards a ray slows down: its position is about linear in 1/m. Inwards half the way is taken.
                    go = wp.min(wp.min(w0, w1), w2)
                    slack = 1.0 - go * c4[3] / m
                    go = wp.where(c4[3] < 0.0, 0.5 * go, wp.where(slack > 0.0, go / wp.max(slack, 1.0e-6), _NEVER))
                    go = go + 0.1 * bricks.far_cell * m
                    stride = _STEP * wp.max(
                        wp.clamp(cell, bricks.far_cell * m, 3.0 * bricks.far_cell * m), footprint * tj
                    )
                    go = wp.where(leap > 0, go, stride)
                    # No step jumps into the near box.
                    go = wp.where(tj < enter[j], wp.min(go, enter[j] - tj + 0.02 * bricks.near_cell), go)
                    go = wp.where(m > _FAR, _NEVER, go)
                    ahead[j] = wp.where(far > 0, go, ahead[j])
                    slot[j] = wp.where(there > 0, brick, slot[j])
                    p0[j] = wp.where(there > 0, g[0], p0[j])
                    p1[j] = wp.where(there > 0, g[1], p1[j])
                    p2[j] = wp.where(there > 0, g[2], p2[j])
                    length[j] = wp.where(there > 0, stride, length[j])
                    thick[j] = wp.where(there > 0, stride / (m * m), thick[j])
                    dense[j] = wp.where(there > 0, 1, dense[j])
                    sampling = sampling + there
            if _PATIENCE * sampling < alive:  # those few wait for others
                for j in range(count):
                    ahead[j] = wp.where(dense[j] > 0, 0.0, ahead[j])
            else:
                bits = int(0)
                # A step's density and features are those of its middle.
                for j in range(count):
                    filled = wp.where(slot[j] >= 0, 1.0, 0.0)
                    density = density_at(bricks, wp.max(slot[j], 0), p0[j], p1[j], p2[j])
                    # What of the step lies beyond the limit stops nothing.
                    before_limit = wp.clamp((limit[j] - t[j]) / length[j] + 0.5, 0.0, 1.0)
                    optical = density * thick[j] * before_limit * filled
                    before = transmittance[j]
                    after = before * exponential(-optical)
                    half = logarithm(wp.clamp(2.0 * before, 1.0, 2.0)) / wp.max(optical, 1.0e-6)
                    crossed = wp.where(before >= 0.5, 1, 0) * wp.where(after < 0.5, 1, 0)
                    median[j] = wp.where(crossed > 0, t[j] + (half - 0.5) * length[j], median[j])
                    transmittance[j] = after
                    due = pending[j] + before - after
                    wanted = wp.where(due > _FAINT, 1, 0)
                    pending[j] = wp.where(wanted > 0, 0.0, due)
                    counted[j] = counted[j] + wp.where(wanted > 0, due, 0.0)
                    bits = bits | (wanted << j)
                    noted_weight[note, j] = due
                    noted_slot[note, j] = wp.max(slot[j], 0)
                    noted_0[note, j] = p0[j]
                    noted_1[note, j] = p1[j]
                    noted_2[note, j] = p2[j]
                noted[note] = bits
                note = note + wp.where(bits != 0, 1, 0)
            for j in range(count):
                t[j] = t[j] + ahead[j]
        for j in range(count):
            if column + (j & 7) < film.width and row + (j >> 3) < film.height:
                pixel = (row + (j >> 3)) * film.width + column + (j & 7)
                opacity = wp.where(transmittance[j] > _OPAQUE, 1.0 - transmittance[j], 1.0)
                share = opacity / wp.max(counted[j], 1.0e-6)
                features[camera, 0, pixel] = opacity
                for ch in range(1, CHANNELS):
                    code = total[j, ch] * bricks.step[ch] + bricks.low[ch] * counted[j]
                    features[camera, ch, pixel] = code * share
                depth[camera, pixel] = wp.where(median[j] > 0.0, median[j] * cosine[j], -1.0)

    return march_packets
