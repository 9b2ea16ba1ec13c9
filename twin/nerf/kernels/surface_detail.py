"""Detail: features finer than those of bricks, added to a ray's features at the point where it meets a surface.

On the ground, detail is stored as a texture, elsewhere as a hash grid. A height map locates the ground. A *texel* holds
features at a node of a grid in (x, y); there are `LEVELS` such grids, each with texels twice as wide as the one before
(a mipmap, Williams 1983). *Tile*: a square of `TILE`² texels of the finest level, and the coarser texels in the square;
the texels of all levels of a tile are stored together, the finest first. *Slot*: row of a stored tile; the *index* maps
each tile to its slot, or to −1 if it is not stored. The hash grid (Müller et al. 2022) has one level; its *vertices*
share the rows of a table. *Footprint*: width of a pixel on the surface [m]; it determines the levels that a ray uses.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
# ruff: noqa: RUF046
from twin.nerf.kernels.bricks import Bytes
from twin.nerf.kernels.march import OPTIONS, ImageBuffers, as_floats, sample_of, slot_of
from twin.nerf.kernels.volume import CHANNELS, Channels
from twin.warp_runtime import wp

wp.set_module_options(OPTIONS)

LEVELS = 4
_LOG2_TILE = 4
TILE = 1 << _LOG2_TILE
"""Texels of the finest level along a tile's side."""
TEXELS = sum((TILE >> level) ** 2 for level in range(LEVELS))
"""Texels of a tile, of all levels."""
NO_GROUND = 1.0e6
"""Height of nodes where the ground is unknown [m]."""

MAX_FOOTPRINT = 1.5
"""Greatest footprint at which a level is used [texels]."""
_UNKNOWN = 1.0e3  # [m] a greater interpolated height comes from a node without ground
_MIN_DESCENT = 0.01  # least descent per meter along a ray that can meet the ground
_TOLERANCE, _TOLERANCE_PER_METER = 0.08, 0.01  # [m], [m/m] a surface this close to the height map is ground
_CONVERGED, _BISECTIONS = 0.01, 5  # share of the depth by which the last step of a converged iteration moves a hit
_MAX_STRETCH = 4.0  # if a pixel's projection to the ground is longer than this times its width, the footprint grows
_PRIME_Y = wp.uint32(2654435761)
_PRIME_Z = wp.uint32(805459861)
RUN = {"cpu": 16, "cuda": 1}
"""Neighboring pixels per thread when rendering, by device."""
_ZERO = 128.0  # byte of the value 0
_MIN_GRADIENT = 1.0e-22  # rays with a smaller squared norm of the gradient are skipped


@wp.struct
class DetailGrid:
    """Height map and tile index, which have the same lowest corner, and the hash grid."""

    origin: wp.vec2f
    """Lowest corner [m]."""
    heights: wp.array(dtype=wp.float32)
    """[m], flattened from (along x, along y); `NO_GROUND` where it is unknown."""
    heights_x: wp.int32
    """Nodes along x."""
    heights_y: wp.int32
    per_height_cell: wp.float32
    """Nodes per meter."""
    tiles: wp.array(dtype=wp.int32)
    """Slots, flattened from (along x, along y)."""
    tiles_x: wp.int32
    tiles_y: wp.int32
    texel: wp.float32
    """Side of the finest texels [m]."""
    cell: wp.float32
    """Side of the hash grid's cells [m]."""
    mask: wp.uint32
    """Number of rows of the hash grid's table (a power of 2) minus 1."""
    coarsest: wp.float32
    """Side of the coarsest texels or cells [m]."""


# A hit is a point where a ray meets a surface: x, y [m] from the corner of the height map, z [m], and the footprint
# [m], which is negative if the surface is not the ground, and 0 if there is no surface.
Hit = wp.vec4f


# Native access shows the compiler that the array is contiguous, see `march.py`.
@wp.func_native("return array.data[i];")
def height_of(array: wp.array(dtype=wp.float32), i: wp.int32) -> wp.float32: ...


@wp.func
def height_at(grid: DetailGrid, x: wp.float32, y: wp.float32) -> wp.float32:
    """Height of the ground [m] at (x, y) [m], relative to the grid's corner; `NO_GROUND` where it is unknown."""
    px = x * grid.per_height_cell
    py = y * grid.per_height_cell
    ix = int(px)
    iy = int(py)
    if wp.min(px, py) < 0.0 or ix > grid.heights_x - 2 or iy > grid.heights_y - 2:
        return NO_GROUND
    ax = px - float(ix)
    ay = py - float(iy)
    at = ix * grid.heights_y + iy
    low = height_of(grid.heights, at) * (1.0 - ay) + height_of(grid.heights, at + 1) * ay
    at += grid.heights_y
    high = height_of(grid.heights, at) * (1.0 - ay) + height_of(grid.heights, at + 1) * ay
    height = low * (1.0 - ax) + high * ax
    return wp.where(height > _UNKNOWN, NO_GROUND, height)


@wp.func
def surface_hit(grid: DetailGrid, o: wp.vec3f, ray: wp.vec3f, depth: wp.float32, per_pixel: wp.float32) -> Hit:
    """The hit of a ray from `o` that meets a surface at the z-depth `depth` [m].

    `ray` is the ray's direction with unit z-depth, and `per_pixel` the width of a pixel per meter of depth. Two steps
    of a fixed-point iteration find level ground. At a curb, they end on its two sides, and bisection finds it between.
    """
    x0 = o[0] - grid.origin[0]
    y0 = o[1] - grid.origin[1]
    x = x0 + ray[0] * depth
    y = y0 + ray[1] * depth
    z = o[2] + ray[2] * depth
    length = wp.length(ray)
    per_descent = 1.0 / wp.max(-ray[2], _MIN_DESCENT * length)
    height = height_at(grid, x, y)
    if wp.abs(z - height) < _TOLERANCE + _TOLERANCE_PER_METER * depth and ray[2] < -_MIN_DESCENT * length:
        first = wp.clamp((o[2] - height) * per_descent, 0.5 * depth, 1.5 * depth)
        height = height_at(grid, x0 + ray[0] * first, y0 + ray[1] * first)
        t = wp.clamp((o[2] - height) * per_descent, 0.5 * depth, 1.5 * depth)
        if wp.abs(t - first) > _CONVERGED * depth:
            near = wp.min(t, first)
            far = wp.max(t, first)
            for _ in range(_BISECTIONS):
                t = 0.5 * (near + far)
                height = height_at(grid, x0 + ray[0] * t, y0 + ray[1] * t)
                if o[2] + ray[2] * t > height:
                    near = t
                else:
                    far = t
        stretch = wp.max(1.0, length * per_descent * (1.0 / _MAX_STRETCH))
        if height < NO_GROUND:
            return Hit(x0 + ray[0] * t, y0 + ray[1] * t, height, t * per_pixel * stretch)
    return Hit(x, y, z, -depth * per_pixel)


@wp.func
def is_shown(footprint: wp.float32, texel: wp.float32) -> wp.bool:
    """True if texels of side `texel` [m] are coarse enough not to alias at a footprint [m]."""
    return footprint < MAX_FOOTPRINT * texel


@wp.func
def texel_row(grid: DetailGrid, level: wp.int32, ix: wp.int32, iy: wp.int32) -> wp.int32:
    """Row of a texel in the stored tiles, −1 where its tile is not stored."""
    shift = _LOG2_TILE - level
    side = 1 << shift
    tx = ix >> shift
    ty = iy >> shift
    if wp.min(tx, ty) < 0 or tx >= grid.tiles_x or ty >= grid.tiles_y:
        return -1
    slot = slot_of(grid.tiles, tx * grid.tiles_y + ty)
    first = (4 * (TILE * TILE - side * side)) // 3  # texels of the finer levels
    return wp.where(slot < 0, -1, slot * TEXELS + first + ((ix & (side - 1)) << shift) + (iy & (side - 1)))


@wp.func
def vertex_row(grid: DetailGrid, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int32:
    """Row of a vertex of the hash grid; the vertices of a block of 2³ have consecutive rows."""
    block = wp.uint32(x >> 1) ^ (wp.uint32(y >> 1) * _PRIME_Y) ^ (wp.uint32(z >> 1) * _PRIME_Z)
    return wp.int32(((block << wp.uint32(3)) | wp.uint32((x & 1) * 4 + (y & 1) * 2 + (z & 1))) & grid.mask)


@wp.func
def texel_corner(grid: DetailGrid, level: wp.int32, x: wp.float32, y: wp.float32, n: wp.int32):
    """Row (see `texel_row`) and weight of corner n = x + 2·y of a level's cell at (x, y) [m] from the grid's corner."""
    side = grid.texel * float(1 << level)
    px = x / side
    py = y / side
    ix = int(px)
    iy = int(py)
    ax = px - float(ix)
    ay = py - float(iy)
    share = wp.where((n & 1) > 0, ax, 1.0 - ax) * wp.where((n >> 1) > 0, ay, 1.0 - ay)
    return texel_row(grid, level, ix + (n & 1), iy + (n >> 1)), share


@wp.func
def vertex_corner(grid: DetailGrid, hit: Hit, n: wp.int32):
    """Row and weight of corner n = x + 2·y + 4·z of the hash grid's cell at a hit."""
    p = wp.vec3f(hit[0], hit[1], hit[2]) / grid.cell
    low = wp.vec3f(wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2]))
    b = p - low
    x = wp.where((n & 1) > 0, b[0], 1.0 - b[0])
    y = wp.where((n & 2) > 0, b[1], 1.0 - b[1])
    share = x * y * wp.where((n & 4) > 0, b[2], 1.0 - b[2])
    return vertex_row(grid, int(low[0]) + (n & 1), int(low[1]) + ((n >> 1) & 1), int(low[2]) + (n >> 2)), share


# ---- training


@wp.kernel(enable_backward=False)
def find_surface(
    grid: DetailGrid,
    rotation: wp.mat33f,
    position: wp.vec3f,
    intrinsics: wp.vec4f,
    width: wp.int32,
    depth: wp.array(dtype=wp.float32),
    hits: wp.array(dtype=Hit),
):
    """Hits of the pixels of an image."""
    i = wp.tid()
    u = (float(i % width) + 0.5 - intrinsics[2]) / intrinsics[0]
    v = (float(i // width) + 0.5 - intrinsics[3]) / intrinsics[1]
    if depth[i] > 0.0:
        hits[i] = surface_hit(grid, position, rotation * wp.vec3f(u, v, 1.0), depth[i], 1.0 / intrinsics[0])
    else:
        hits[i] = Hit()


@wp.func
def interpolated(
    grid: DetailGrid, values: wp.array(dtype=Channels), level: wp.int32, x: wp.float32, y: wp.float32
) -> Channels:
    """Interpolated texels of a level at (x, y) [m] from the grid's corner."""
    total = Channels()
    for n in range(4):
        row, share = texel_corner(grid, level, x, y, n)
        if row >= 0:
            total += values[row] * share
    return total


@wp.kernel(enable_backward=False)
def interpolate_detail(
    hits: wp.array(dtype=Hit),
    grid: DetailGrid,
    texels: wp.array(dtype=Channels),
    vertices: wp.array(dtype=Channels),
    start: wp.int32,
    outputs: wp.array(dtype=Channels),
):
    """Features at hits from `start` on: on the ground texels summed over levels, elsewhere hash grid vertices."""
    i = start + wp.tid()
    hit = hits[i]
    total = Channels()
    if hit[3] > 0.0:
        for level in range(LEVELS):
            if is_shown(hit[3], grid.texel * float(1 << level)):
                total += interpolated(grid, texels, level, hit[0], hit[1])
    elif is_shown(-hit[3], grid.cell):
        for n in range(8):
            row, share = vertex_corner(grid, hit, n)
            total += vertices[row] * share
    outputs[i] = total


@wp.kernel(enable_backward=False)
def interpolate_detail_backward(
    hits: wp.array(dtype=Hit),
    grid: DetailGrid,
    outputs_grad: wp.array(dtype=Channels),
    part: wp.int32,
    parts: wp.int32,
    texels_grad: wp.array(dtype=Channels),
    vertices_grad: wp.array(dtype=Channels),
):
    """Adds the gradient of `interpolate_detail`; one launch per `part` of tiles and rows fixes the order of sums."""
    i = wp.tid()
    g = outputs_grad[i]
    if wp.dot(g, g) < _MIN_GRADIENT:
        return
    hit = hits[i]
    if hit[3] > 0.0:
        for level in range(LEVELS):
            if is_shown(hit[3], grid.texel * float(1 << level)):
                for n in range(4):
                    row, share = texel_corner(grid, level, hit[0], hit[1], n)
                    if row >= 0 and (row // TEXELS) % parts == part:
                        wp.atomic_add(texels_grad, row, g * share)
    elif is_shown(-hit[3], grid.cell):
        for n in range(8):
            row, share = vertex_corner(grid, hit, n)
            if (row // 8) % parts == part:
                wp.atomic_add(vertices_grad, row, g * share)


@wp.func
def adam_row(
    row: wp.int32,
    rate: wp.float32,
    second_correction: wp.float32,
    values: wp.array(dtype=Channels),
    gradient: wp.array(dtype=Channels),
    second: wp.array(dtype=wp.float32),
):
    """Adam step of one row, if it has a gradient."""
    g = gradient[row]
    squared = wp.dot(g, g)
    if squared > 0.0:
        v = second[row] * 0.99 + squared / float(CHANNELS - 1) * 0.01
        second[row] = v
        values[row] = values[row] - g * (rate / (wp.sqrt(v * second_correction) + 1.0e-15))
        gradient[row] = Channels()


@wp.kernel(enable_backward=False)
def adam_step_detail(
    hits: wp.array(dtype=Hit),
    grid: DetailGrid,
    part: wp.int32,
    parts: wp.int32,
    rate: wp.float32,
    second_correction: wp.float32,
    texels: wp.array(dtype=Channels),
    texels_grad: wp.array(dtype=Channels),
    texels_second: wp.array(dtype=wp.float32),
    vertices: wp.array(dtype=Channels),
    vertices_grad: wp.array(dtype=Channels),
    vertices_second: wp.array(dtype=wp.float32),
):
    """Takes an Adam step (Kingma and Ba 2015) on the rows with a gradient and clears the gradient; β = (0, 0.99).

    To save memory there is no momentum, and the features of a row share one second moment. Many hits share a row, so
    this kernel is for one thread; `adam_step_everywhere` is for a GPU.
    """
    i = wp.tid()
    hit = hits[i]
    if hit[3] > 0.0:
        for level in range(LEVELS):
            if is_shown(hit[3], grid.texel * float(1 << level)):
                for n in range(4):
                    row, _ = texel_corner(grid, level, hit[0], hit[1], n)
                    if row >= 0 and (row // TEXELS) % parts == part:
                        adam_row(row, rate, second_correction, texels, texels_grad, texels_second)
    else:
        for n in range(8):
            row, _ = vertex_corner(grid, hit, n)
            if (row // 8) % parts == part:
                adam_row(row, rate, second_correction, vertices, vertices_grad, vertices_second)


@wp.kernel(enable_backward=False)
def adam_step_everywhere(
    rate: wp.float32,
    second_correction: wp.float32,
    values: wp.array(dtype=Channels),
    gradient: wp.array(dtype=Channels),
    second: wp.array(dtype=wp.float32),
):
    """`adam_step_detail` for a GPU: one thread per row."""
    adam_row(wp.tid(), rate, second_correction, values, gradient, second)


@wp.kernel(enable_backward=False)
def sum_levels(
    tiles: wp.array(dtype=wp.vec2i), grid: DetailGrid, values: wp.array(dtype=Channels), total: wp.array(dtype=Channels)
):
    """Adds to every texel the coarser levels at its node, so that rendering interpolates one level instead of all.

    Both give the same sum, since a level's nodes are nodes of all finer levels.
    """
    row = wp.tid()
    tile = tiles[row // TEXELS]
    rest = row % TEXELS
    level = int(0)
    while rest >= (TILE >> level) * (TILE >> level):
        rest -= (TILE >> level) * (TILE >> level)
        level += 1
    side = TILE >> level
    texel = grid.texel * float(1 << level)
    x = float(tile[0] * side + rest // side) * texel
    y = float(tile[1] * side + rest % side) * texel
    out = values[row]
    for coarser in range(level + 1, LEVELS):
        # The small offset keeps rounding from moving a node into the neighboring cell of the coarser level.
        out += interpolated(grid, values, coarser, x + 1.0e-5 * texel, y + 1.0e-5 * texel)
    total[row] = out


# ---- rendering


@wp.struct
class DetailBytes:
    """Features as bytes around 128, and the value of one byte step in each channel."""

    texels: wp.array(dtype=Bytes)
    """Sums of the levels, see `sum_levels`."""
    texel_step: Channels
    vertices: wp.array(dtype=Bytes)
    vertex_step: Channels


@wp.func
def texture_bytes(grid: DetailGrid, texels: wp.array(dtype=Bytes), level: wp.int32, x: wp.float32, y: wp.float32):
    """Interpolated texels of a level at (x, y) [m] from the grid's corner, as bytes around 0."""
    total = Channels()
    for n in range(4):
        row, share = texel_corner(grid, level, x, y, n)
        if row >= 0:
            total += (as_floats(sample_of(texels, row)) - Channels(_ZERO)) * share
    return total


@wp.func
def vertex_bytes(grid: DetailGrid, vertices: wp.array(dtype=Bytes), hit: Hit) -> Channels:
    """Interpolated vertices of the hash grid at a hit, as bytes around 0."""
    total = Channels()
    for n in range(8):
        row, share = vertex_corner(grid, hit, n)
        total += as_floats(sample_of(vertices, row)) * share
    return total - Channels(_ZERO)


@wp.func_native("for (int c = 1; c < 16; ++c) array.data[at + c * stride] += value[c];")
def add_channels(array: wp.array3d(dtype=wp.float32), at: wp.int32, stride: wp.int32, value: Channels): ...


@wp.kernel(enable_backward=False)
def add_detail(
    grid: DetailGrid,
    detail: DetailBytes,
    image: ImageBuffers,
    first: wp.int32,
    last: wp.int32,
    pixels_per_thread: wp.int32,
    depth: wp.array2d(dtype=wp.float32),
    features: wp.array3d(dtype=wp.float32),
):
    """Adds detail times opacity to the features of runs of pixels, from `first` up to `last`, of every camera."""
    camera, run = wp.tid()
    k = image.intrinsics[camera]
    rotation = image.rotation[camera]
    position = image.position[camera]
    per_pixel = 1.0 / k[0]
    pixels = image.width * image.height
    for j in range(pixels_per_thread):
        pixel = first + run * pixels_per_thread + j
        if pixel < last:
            z = depth[camera, pixel]
            if z > 0.0 and z * per_pixel < MAX_FOOTPRINT * grid.coarsest:
                u = (float(pixel % image.width) + 0.5 - k[2]) * per_pixel
                v = (float(pixel // image.width) + 0.5 - k[3]) / k[1]
                hit = surface_hit(grid, position, rotation * wp.vec3f(u, v, 1.0), z, per_pixel)
                value = Channels()
                found = int(0)
                if hit[3] > 0.0:
                    level = int(0)
                    while level < LEVELS and not is_shown(hit[3], grid.texel * float(1 << level)):
                        level += 1
                    if level < LEVELS:
                        found = 1
                        value = wp.cw_mul(texture_bytes(grid, detail.texels, level, hit[0], hit[1]), detail.texel_step)
                elif is_shown(-hit[3], grid.cell):
                    found = 1
                    value = wp.cw_mul(vertex_bytes(grid, detail.vertices, hit), detail.vertex_step)
                if found == 1:
                    add_channels(
                        features, camera * CHANNELS * pixels + pixel, pixels, value * features[camera, 0, pixel]
                    )
