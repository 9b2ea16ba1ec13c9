"""Ray sampling: inverse-CDF sampling from opacity grids.

*Opacity grid*: stores for each cell the fraction of light that the cell blocks, averaged over the samples in it. (With
mean density instead, a cell that contains only a thin post would be opaque.) A fine grid covers the near box, and a
coarse one covers the contracted cube. *Bin*: one weighted step of the march through the grids. *Stratum*: one of
K intervals of a ray that contain equal weight; it is sampled once, and the sample represents the whole stratum.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
# ruff: noqa: RUF046
from twin.nerf.kernels.composite import Strata
from twin.nerf.kernels.space import Contraction, Rays, expansion, grid_position, max_norm, unit_position
from twin.warp_runtime import wp

BINS = 256
_FAR = 100.0  # unit positions beyond this count as the horizon
_MAX_OPACITY = 0.99  # greatest opacity of a cell
_STEP = 0.75  # bin length [cells]
_BINS_BEHIND = 2  # bins that the march takes after the ray is blocked
_OPAQUE = 0.02  # a ray with less transmittance counts as blocked
# A grazing ray passes for meters through cells that contain ground before it reaches the ground. So _DOUBT_SHARE of the
# weight is distributed as if the opacities of cells were multiplied by _DOUBT.
_DOUBT_SHARE = 0.35
_DOUBT = 0.25
_WIDENING = 0.02  # least bin length as a share of the distance


@wp.struct
class OpacityGrids:
    """Opacity grids over the near box and the contracted cube, and the side of a cell in each [contracted m]."""

    near: wp.array3d(dtype=wp.float32)
    far: wp.array3d(dtype=wp.float32)
    near_cell: wp.float32
    far_cell: wp.float32


@wp.func
def grid_cell(g: wp.vec3f, grid: wp.array3d(dtype=wp.float32)) -> wp.vec3i:
    n = wp.vec3i(grid.shape[0], grid.shape[1], grid.shape[2])
    # Rounding may carry a position just below 1 to the end of the grid.
    return wp.min(wp.vec3i(wp.cw_mul(g, wp.vec3f(n))), n - wp.vec3i(1, 1, 1))


@wp.func
def near_box_position(g: wp.vec3f) -> wp.vec3f:
    """Grid position → position relative to the near box, which spans [0, 1)³."""
    return 2.0 * g - wp.vec3f(0.5, 0.5, 0.5)


@wp.func
def inside_near_box(n: wp.vec3f) -> wp.bool:
    low = wp.min(wp.min(n[0], n[1]), n[2])
    high = wp.max(wp.max(n[0], n[1]), n[2])
    return low >= 0.0 and high < 1.0


@wp.kernel(enable_backward=False)
def sample_rays(
    rays: Rays,
    targets: wp.array(dtype=wp.float32),
    box: Contraction,
    grids: OpacityGrids,
    near: wp.float32,
    floor: wp.float32,
    target_mass: wp.float32,
    seed: wp.int32,
    start: wp.int32,
    strata: Strata,
    positions: wp.array2d(dtype=wp.vec3f),
):
    """Divides each ray into K strata and takes one sample in each. Writes `strata` and the samples' `positions` (n, K).

    Args:
        targets: Known distance of a surface [m], 0 = unknown; its bin gets `target_mass` of extra weight.
        near: Distance at which rays start [m].
        floor: Total weight spread evenly over all bins; the weights due to surfaces sum to at most 1.
        seed: Seed of the jitter within strata; if it is negative, the middles of the strata are sampled.
    """
    i = start + wp.tid()
    o = rays.origins[i]
    d = rays.directions[i]
    target = targets[i]
    weights = wp.zeros(shape=256, dtype=wp.float32)
    bounds = wp.zeros(shape=257, dtype=wp.float32)

    t = near
    transmittance = float(1.0)
    doubting = float(1.0)
    n = int(0)
    beyond = int(0)
    bounds[0] = t
    while n < BINS:
        u = unit_position(box, o + d * t)
        m = max_norm(u)
        if m > _FAR:
            break
        length = grids.near_cell
        if m > 1.0:
            length = grids.far_cell * expansion(u)
        step = wp.max(_STEP * length, _WIDENING * t)
        g = grid_position(unit_position(box, o + d * (t + 0.5 * step)))
        opacity = float(0.0)
        b = near_box_position(g)
        if inside_near_box(b):
            c = grid_cell(b, grids.near)
            opacity = grids.near[c[0], c[1], c[2]]
        else:
            c = grid_cell(g, grids.far)
            opacity = grids.far[c[0], c[1], c[2]]
        opacity *= wp.min(1.0, step / length)
        doubt = _DOUBT * opacity
        weights[n] = (1.0 - _DOUBT_SHARE) * transmittance * opacity + _DOUBT_SHARE * doubting * doubt
        transmittance *= 1.0 - opacity
        doubting *= 1.0 - doubt
        t += step
        n += 1
        bounds[n] = t
        # The surface may lie a cell farther than the grid shows, and the march must also reach a more distant target.
        if doubting < _OPAQUE and t > target:
            beyond += 1
            if beyond > _BINS_BEHIND:
                break

    # Each bin shares its weight with its neighbors, as the surface may lie in one of them.
    total = float(0.0)
    before = float(0.0)
    uniform = floor / wp.float32(n)
    for b in range(n):
        here = weights[b]
        after = float(0.0)
        if b + 1 < n:
            after = weights[b + 1]
        p = 0.5 * here + 0.25 * (before + after) + uniform
        if target > bounds[b] and target <= bounds[b + 1]:
            p += target_mass
        before = here
        weights[b] = p
        total += p

    count = strata.distances.shape[1]
    share = total / wp.float32(count)
    rng = wp.rand_init(seed, i)
    b = int(0)
    passed = float(0.0)  # weight of the bins before b
    strata.edges[i, 0] = near
    for k in range(count):
        jitter = float(0.5)
        if seed >= 0:
            jitter = wp.randf(rng)
        target_weight = (wp.float32(k) + jitter) * share
        while b + 1 < n and passed + weights[b] < target_weight:
            passed += weights[b]
            b += 1
        s = bounds[b] + (bounds[b + 1] - bounds[b]) * wp.clamp((target_weight - passed) / weights[b], 0.0, 1.0)
        u = unit_position(box, o + d * s)
        strata.distances[i, k] = s
        positions[i, k] = grid_position(u)
        target_weight = wp.float32(k + 1) * share
        while b + 1 < n and passed + weights[b] < target_weight:
            passed += weights[b]
            b += 1
        edge = bounds[b] + (bounds[b + 1] - bounds[b]) * wp.clamp((target_weight - passed) / weights[b], 0.0, 1.0)
        strata.edges[i, k + 1] = edge
        strata.lengths[i, k] = (edge - strata.edges[i, k]) / expansion(u)


@wp.func
def update_cell(
    grid: wp.array3d(dtype=wp.float32),
    g: wp.vec3f,
    optical_depth: wp.float32,
    rise: wp.float32,
    fall: wp.float32,
    part: wp.int32,
    parts: wp.int32,
):
    c = grid_cell(g, grid)
    if (c[0] + c[1]) % parts == part:
        opacity = wp.min(1.0 - wp.exp(-optical_depth), _MAX_OPACITY)
        old = grid[c[0], c[1], c[2]]
        grid[c[0], c[1], c[2]] = old + wp.where(opacity > old, rise, fall) * (opacity - old)


@wp.kernel(enable_backward=False)
def update_grids(
    positions: wp.array(dtype=wp.vec3f),
    densities: wp.array(dtype=wp.float32),
    rise: wp.float32,
    fall: wp.float32,
    part: wp.int32,
    parts: wp.int32,
    grids: OpacityGrids,
):
    """Moves sampled cells towards the opacity of their samples, at the rate `rise` upwards and `fall` downwards.

    Launched once per `part` of the cells, so that parts can run in parallel and each cell gets its samples in order. If
    several threads of a GPU update a cell at the same time, one of them wins.
    """
    i = wp.tid()
    g = positions[i]
    b = near_box_position(g)
    if inside_near_box(b):
        update_cell(grids.near, b, densities[i] * grids.near_cell, rise, fall, part, parts)
    else:
        update_cell(grids.far, g, densities[i] * grids.far_cell, rise, fall, part, parts)
