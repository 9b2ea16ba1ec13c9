"""Ground texture: features on the ground, finer than bricks, that are added to those of rays which meet the ground.

A height map on a regular grid says where the ground is. A *texel* holds features at a node of a grid in (x, y); there
are `LEVELS` such grids, each with texels twice as wide as the one before (a mipmap, Williams 1983). *Tile*: a square of
`TILE`² texels of the finest level with the coarser texels on it; texels of all levels of a tile lie together, the
finest first. *Slot*: row of a stored tile; the *index* gives it per tile, −1 where none is stored. *Footprint*: width of
a pixel on the ground [m], by which a ray chooses its levels.
"""

# Warp reads annotations as values, and float() makes a variable of a kernel that changes within a loop.
# mypy: ignore-errors
# ruff: noqa: RUF046
from twin.nerf.kernels.bricks import Bytes
from twin.nerf.kernels.composite import CHANNELS, Channels
from twin.nerf.kernels.march import ImageBuffers, as_floats
from twin.warp_runtime import wp

LEVELS = 4
TILE = 16
"""Texels of the finest level along a tile's side."""
TEXELS = sum((TILE >> level) ** 2 for level in range(LEVELS))
"""Texels of a tile, of all levels."""
NO_GROUND = 1.0e6
"""Height of nodes where the ground is unknown [m]."""

_MIN_DESCENT = 0.01  # descent per meter along the ray of rays that can meet the ground
_TOLERANCE, _TOLERANCE_PER_METER = 0.08, 0.01  # [m] between the ground and a surface that counts as ground
_MAX_STRETCH = 4.0  # of a pixel on the ground, beyond which its length does not count
_ZERO = 128.0  # byte of the value 0
_MIN_GRADIENT = 1.0e-22  # squared norm from which a ray takes part in a step


@wp.struct
class GroundGrid:
    """Height map and tile index, which start at the same corner."""

    origin: wp.vec2f
    """Lowest corner [m]."""
    heights: wp.array2d(dtype=wp.float32)
    """[m], shape (along x, along y); `NO_GROUND` where it is unknown. Shape (0, 0): no ground texture."""
    height_cell: wp.float32
    """[m]"""
    tiles: wp.array2d(dtype=wp.int32)
    """Slots, shape (along x, along y)."""
    texel: wp.float32
    """Side of the finest texels [m]."""


@wp.struct
class GroundHit:
    """Where a ray meets the ground."""

    x: wp.float32
    """[m] from the grid's corner."""
    y: wp.float32
    footprint: wp.float32
    """[m], 0 where the ray does not meet the ground."""


@wp.func
def height_at(grid: GroundGrid, x: wp.float32, y: wp.float32) -> wp.float32:
    """Height of the ground [m] at a distance (x, y) [m] from the grid's corner."""
    px = x / grid.height_cell
    py = y / grid.height_cell
    if px < 0.0 or py < 0.0 or px >= float(grid.heights.shape[0] - 1) or py >= float(grid.heights.shape[1] - 1):
        return NO_GROUND
    ix = int(px)
    iy = int(py)
    ax = px - float(ix)
    ay = py - float(iy)
    low = grid.heights[ix, iy] * (1.0 - ay) + grid.heights[ix, iy + 1] * ay
    high = grid.heights[ix + 1, iy] * (1.0 - ay) + grid.heights[ix + 1, iy + 1] * ay
    return low * (1.0 - ax) + high * ax


@wp.func
def ground_hit(grid: GroundGrid, o: wp.vec3f, ray: wp.vec3f, depth: wp.float32, focal: wp.float32) -> GroundHit:
    """Meets the ground with a ray whose surface is at a z-depth [m]; `ray` is its direction with unit z-depth."""
    out = GroundHit()
    length = wp.length(ray)
    descent = -ray[2]
    if depth <= 0.0 or descent < _MIN_DESCENT * length:
        return out
    p = o + ray * depth
    x0 = o[0] - grid.origin[0]
    y0 = o[1] - grid.origin[1]
    height = height_at(grid, x0 + ray[0] * depth, y0 + ray[1] * depth)
    if wp.abs(p[2] - height) > _TOLERANCE + _TOLERANCE_PER_METER * depth:
        return out
    t = depth
    for _ in range(2):  # the ground is much flatter than the ray, so this converges
        t = wp.clamp((o[2] - height) / descent, 0.5 * depth, 1.5 * depth)
        height = height_at(grid, x0 + ray[0] * t, y0 + ray[1] * t)
        if height > 0.5 * NO_GROUND:
            return out
    t = wp.clamp((o[2] - height) / descent, 0.5 * depth, 1.5 * depth)
    out.x = x0 + ray[0] * t
    out.y = y0 + ray[1] * t
    if height_at(grid, out.x, out.y) > 0.5 * NO_GROUND:
        return GroundHit()
    out.footprint = t / focal * wp.max(1.0, length / (descent * _MAX_STRETCH))
    return out


@wp.func
def level_weight(footprint: wp.float32, texel: wp.float32) -> wp.float32:
    """Weight of a level: 1 if its texels are as wide as the footprint or wider, 0 if they are half as wide."""
    return wp.clamp(2.0 - footprint / texel, 0.0, 1.0)


@wp.func
def texel_row(grid: GroundGrid, level: wp.int32, ix: wp.int32, iy: wp.int32) -> wp.int32:
    """Row of a texel in the stored tiles, −1 where its tile is not stored."""
    side = TILE >> level
    first = (4 * (TILE * TILE - side * side)) / 3  # texels of the finer levels
    tx = ix / side
    ty = iy / side
    if ix < 0 or iy < 0 or tx >= grid.tiles.shape[0] or ty >= grid.tiles.shape[1]:
        return -1
    slot = grid.tiles[tx, ty]
    if slot < 0:
        return -1
    return slot * TEXELS + first + (ix - tx * side) * side + iy - ty * side


# ---- training


@wp.func
def interpolated(
    grid: GroundGrid, values: wp.array(dtype=Channels), level: wp.int32, x: wp.float32, y: wp.float32
) -> Channels:
    """Interpolated texels of a level at (x, y) [m] from the grid's corner."""
    side = grid.texel * float(1 << level)
    px = x / side
    py = y / side
    ix = int(px)
    iy = int(py)
    ax = px - float(ix)
    ay = py - float(iy)
    total = Channels()
    for n in range(4):
        row = texel_row(grid, level, ix + (n & 1), iy + (n >> 1))
        if row >= 0:
            share = wp.where((n & 1) > 0, ax, 1.0 - ax) * wp.where((n >> 1) > 0, ay, 1.0 - ay)
            total += values[row] * share
    return total


@wp.kernel(enable_backward=False)
def find_ground(
    grid: GroundGrid,
    rotation: wp.mat33f,
    position: wp.vec3f,
    intrinsics: wp.vec4f,
    width: wp.int32,
    depth: wp.array(dtype=wp.float32),
    hits: wp.array(dtype=wp.vec3f),
):
    """Where the pixels of an image meet the ground: x, y [m] from the grid's corner, and the footprint [m]."""
    i = wp.tid()
    u = (float(i % width) + 0.5 - intrinsics[2]) / intrinsics[0]
    v = (float(i / width) + 0.5 - intrinsics[3]) / intrinsics[1]
    hit = ground_hit(grid, position, rotation * wp.vec3f(u, v, 1.0), depth[i], intrinsics[0])
    hits[i] = wp.vec3f(hit.x, hit.y, hit.footprint)


@wp.kernel(enable_backward=False)
def interpolate_texture(
    hits: wp.array(dtype=wp.vec3f),
    grid: GroundGrid,
    values: wp.array(dtype=Channels),
    start: wp.int32,
    outputs: wp.array(dtype=Channels),
):
    """Features at hits [start, start + dim), as the sum over levels of interpolated texels."""
    i = start + wp.tid()
    hit = hits[i]
    total = Channels()
    for level in range(LEVELS):
        side = grid.texel * float(1 << level)
        weight = level_weight(hit[2], side)
        if weight > 0.0:
            total += interpolated(grid, values, level, hit[0], hit[1]) * weight
    outputs[i] = total


@wp.kernel(enable_backward=False)
def interpolate_texture_backward(
    hits: wp.array(dtype=wp.vec3f),
    grid: GroundGrid,
    outputs_grad: wp.array(dtype=Channels),
    part: wp.int32,
    parts: wp.int32,
    gradient: wp.array(dtype=Channels),
):
    """Adds the gradient of `interpolate_texture`; launched once per `part` of the tiles, which fixes the order of sums."""
    i = wp.tid()
    g = outputs_grad[i]
    if wp.dot(g, g) < _MIN_GRADIENT:
        return
    hit = hits[i]
    for level in range(LEVELS):
        side = grid.texel * float(1 << level)
        weight = level_weight(hit[2], side)
        if weight > 0.0:
            px = hit[0] / side
            py = hit[1] / side
            ix = int(px)
            iy = int(py)
            ax = px - float(ix)
            ay = py - float(iy)
            for n in range(4):
                row = texel_row(grid, level, ix + (n & 1), iy + (n >> 1))
                if row >= 0 and (row / TEXELS) % parts == part:
                    share = weight * wp.where((n & 1) > 0, ax, 1.0 - ax) * wp.where((n >> 1) > 0, ay, 1.0 - ay)
                    wp.atomic_add(gradient, row, g * share)


@wp.kernel(enable_backward=False)
def adam_step_texture(
    hits: wp.array(dtype=wp.vec3f),
    grid: GroundGrid,
    part: wp.int32,
    parts: wp.int32,
    rate: wp.float32,
    second_correction: wp.float32,
    values: wp.array(dtype=Channels),
    gradient: wp.array(dtype=Channels),
    second: wp.array(dtype=wp.float32),
):
    """Adam step (Kingma and Ba 2015) on the texels with a gradient, which it clears; β = (0, 0.99).

    To save memory there is no momentum, and the features of a texel share one second moment.
    """
    i = wp.tid()
    hit = hits[i]
    for level in range(LEVELS):
        side = grid.texel * float(1 << level)
        if level_weight(hit[2], side) > 0.0:
            ix = int(hit[0] / side)
            iy = int(hit[1] / side)
            for n in range(4):
                row = texel_row(grid, level, ix + (n & 1), iy + (n >> 1))
                if row >= 0 and (row / TEXELS) % parts == part:
                    g = gradient[row]
                    squared = wp.dot(g, g)
                    if squared > 0.0:
                        v = second[row] * 0.99 + squared / float(CHANNELS - 1) * 0.01
                        second[row] = v
                        values[row] = values[row] - g * (rate / (wp.sqrt(v * second_correction) + 1.0e-15))
                        gradient[row] = Channels()


@wp.kernel(enable_backward=False)
def sum_levels(
    tiles: wp.array(dtype=wp.vec2i), grid: GroundGrid, values: wp.array(dtype=Channels), total: wp.array(dtype=Channels)
):
    """Every texel plus the coarser levels at its node; exact, as the nodes of a level are nodes of the finer ones."""
    row = wp.tid()
    tile = tiles[row / TEXELS]
    rest = row % TEXELS
    level = int(0)
    while rest >= (TILE >> level) * (TILE >> level):
        rest -= (TILE >> level) * (TILE >> level)
        level += 1
    side = TILE >> level
    texel = grid.texel * float(1 << level)
    x = float(tile[0] * side + rest / side) * texel
    y = float(tile[1] * side + rest % side) * texel
    out = values[row]
    for coarser in range(level + 1, LEVELS):
        # A node of this level is a node of the coarser one or halfway between two, whatever the rounding.
        out += interpolated(grid, values, coarser, x + 1.0e-5 * texel, y + 1.0e-5 * texel)
    total[row] = out


# ---- rendering


@wp.func
def bytes_at(grid: GroundGrid, texels: wp.array(dtype=Bytes), level: wp.int32, x: wp.float32, y: wp.float32) -> Channels:
    """Interpolated texels of a level at (x, y) [m] from the grid's corner, as bytes around 0."""
    side = grid.texel * float(1 << level)
    px = x / side
    py = y / side
    ix = int(px)
    iy = int(py)
    ax = px - float(ix)
    ay = py - float(iy)
    total = Channels()
    for n in range(4):
        row = texel_row(grid, level, ix + (n & 1), iy + (n >> 1))
        if row >= 0:
            share = wp.where((n & 1) > 0, ax, 1.0 - ax) * wp.where((n >> 1) > 0, ay, 1.0 - ay)
            total += (as_floats(texels[row]) - Channels(_ZERO)) * share
    return total


@wp.kernel(enable_backward=False)
def add_ground(
    grid: GroundGrid,
    texels: wp.array(dtype=Bytes),
    step: Channels,
    image: ImageBuffers,
    first: wp.int32,
    depth: wp.array2d(dtype=wp.float32),
    features: wp.array3d(dtype=wp.float32),
):
    """Adds the texture to the features of pixels [first, first + dim) of every camera that show the ground.

    A stored texel is the sum of its level and the coarser ones at this point, so a ray reads at most two levels.
    """
    camera, i = wp.tid()
    pixel = first + i
    k = image.intrinsics[camera]
    u = (float(pixel % image.width) + 0.5 - k[2]) / k[0]
    v = (float(pixel / image.width) + 0.5 - k[3]) / k[1]
    ray = image.rotation[camera] * wp.vec3f(u, v, 1.0)
    hit = ground_hit(grid, image.position[camera], ray, depth[camera, pixel], k[0])
    if hit.footprint <= 0.0:
        return
    level = int(0)
    while level < LEVELS and level_weight(hit.footprint, grid.texel * float(1 << level)) <= 0.0:
        level += 1
    if level == LEVELS:
        return
    weight = level_weight(hit.footprint, grid.texel * float(1 << level))
    value = bytes_at(grid, texels, level, hit.x, hit.y) * weight
    if weight < 1.0 and level + 1 < LEVELS:
        value += bytes_at(grid, texels, level + 1, hit.x, hit.y) * (1.0 - weight)
    for c in range(1, CHANNELS):
        features[camera, c, pixel] += value[c] * step[c]
