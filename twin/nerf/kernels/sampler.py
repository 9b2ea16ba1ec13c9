"""Where along a ray the field is asked: inverse-CDF sampling from grids of what stops light.

*Stop grid*: per cell the share of light that would not leave it, averaged over the samples that fell into it. (The mean
of density itself would call a cell opaque that a thin post merely passes through.) A fine one covers the near box, a
coarse one all of the contracted cube. *Bin*: one step of the march through them. *Stratum*: the stretch between two of
K + 1 equal quantiles of the bins' weights; each is sampled once and stands for its whole length.
"""

# Warp reads annotations as values, and float() makes a variable of a kernel that changes within a loop.
# mypy: ignore-errors
# ruff: noqa: RUF046
import warp as wp

from twin.nerf.kernels.space import grid_position, max_norm, widening

BINS = wp.constant(256)
_FAR = wp.constant(100.0)  # unit positions beyond this are one with the horizon
_MOST = wp.constant(0.99)  # no cell is believed to stop more
_STEP = wp.constant(0.75)  # bin length [cells]
_BEYOND = wp.constant(2)  # bins behind an opaque one
_OPAQUE = wp.constant(0.02)
# A ray that grazes the ground runs for metres through cells that the ground passes through, before it meets the ground.
# So a share of the weight is laid out as if cells stopped only a part of what they are said to stop.
_SHARE = wp.constant(0.35)
_DOUBT = wp.constant(0.25)
_WIDENING = wp.constant(0.02)  # least bin length as a share of the distance


@wp.func
def grid_cell(g: wp.vec3f, nx: wp.int32, ny: wp.int32, nz: wp.int32) -> wp.vec3i:
    # Rounding may carry a position just below 1 to the end of the grid.
    return wp.vec3i(
        wp.min(wp.int32(g[0] * wp.float32(nx)), nx - 1),
        wp.min(wp.int32(g[1] * wp.float32(ny)), ny - 1),
        wp.min(wp.int32(g[2] * wp.float32(nz)), nz - 1),
    )


@wp.func
def in_near_box(g: wp.vec3f) -> wp.vec3f:
    """Grid position → position in the near box scaled to [0, 1), which it leaves outside the box."""
    return 2.0 * g - wp.vec3f(0.5, 0.5, 0.5)


@wp.func
def is_near(n: wp.vec3f) -> wp.bool:
    low = wp.min(wp.min(n[0], n[1]), n[2])
    high = wp.max(wp.max(n[0], n[1]), n[2])
    return low >= 0.0 and high < 1.0


@wp.kernel(enable_backward=False)
def sample_rays(
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    targets: wp.array(dtype=wp.float32),
    centre: wp.vec3f,
    inverse_half: wp.vec3f,
    near_grid: wp.array3d(dtype=wp.float32),
    far_grid: wp.array3d(dtype=wp.float32),
    near_cell: wp.float32,
    far_cell: wp.float32,
    near: wp.float32,
    floor: wp.float32,
    target_mass: wp.float32,
    seed: wp.int32,
    start: wp.int32,
    edges: wp.array2d(dtype=wp.float32),
    distances: wp.array2d(dtype=wp.float32),
    lengths: wp.array2d(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.vec3f),
):
    """K samples per ray: stratum edges (n, K + 1) [m], sampled distances (n, K) [m], contracted lengths of the strata
    (n, K) [m], see `kernels/space.py`, and grid positions (n, K).

    Args:
        targets: Distance at which something is known to be [m], 0 = unknown; gets `target_mass` of extra weight.
        near_grid, far_grid: Stop grids over the near box and the contracted cube.
        near_cell, far_cell: Side of their cells inside the near box [m].
        near: Where rays begin [m].
        floor: Weight spread evenly over all bins, beside at most 1 of the surfaces.
        seed: Of the jitter within strata; negative takes their middles.
    """
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    target = targets[i]
    weights = wp.zeros(shape=256, dtype=wp.float32)
    bounds = wp.zeros(shape=257, dtype=wp.float32)

    t = near
    transmittance = float(1.0)
    reluctant = float(1.0)
    n = int(0)
    beyond = int(0)
    bounds[0] = t
    while n < BINS:
        u = wp.cw_mul(o + d * t - centre, inverse_half)
        m = max_norm(u)
        if m > _FAR:
            break
        length = near_cell
        if m > 1.0:
            length = far_cell * widening(u)
        step = wp.max(_STEP * length, _WIDENING * t)
        g = grid_position(wp.cw_mul(o + d * (t + 0.5 * step) - centre, inverse_half))
        stop = float(0.0)
        b = in_near_box(g)
        if is_near(b):
            c = grid_cell(b, near_grid.shape[0], near_grid.shape[1], near_grid.shape[2])
            stop = near_grid[c[0], c[1], c[2]]
        else:
            c = grid_cell(g, far_grid.shape[0], far_grid.shape[1], far_grid.shape[2])
            stop = far_grid[c[0], c[1], c[2]]
        stop *= wp.min(1.0, step / length)
        doubt = _DOUBT * stop
        weights[n] = (1.0 - _SHARE) * transmittance * stop + _SHARE * reluctant * doubt
        transmittance *= 1.0 - stop
        reluctant *= 1.0 - doubt
        t += step
        n += 1
        bounds[n] = t
        # The surface may lie a cell behind where the grid believes it; a target further back must be reached, too.
        if reluctant < _OPAQUE and t > target:
            beyond += 1
            if beyond > _BEYOND:
                break

    # Neighbours share weight: a surface need not lie in the bin whose cell first saw it.
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

    count = distances.shape[1]
    share = total / wp.float32(count)
    rng = wp.rand_init(seed, i)
    b = int(0)
    passed = float(0.0)  # weight of the bins before b
    edges[i, 0] = near
    for k in range(count):
        jitter = float(0.5)
        if seed >= 0:
            jitter = wp.randf(rng)
        want = (wp.float32(k) + jitter) * share
        while b + 1 < n and passed + weights[b] < want:
            passed += weights[b]
            b += 1
        s = bounds[b] + (bounds[b + 1] - bounds[b]) * wp.clamp((want - passed) / weights[b], 0.0, 1.0)
        u = wp.cw_mul(o + d * s - centre, inverse_half)
        distances[i, k] = s
        positions[i, k] = grid_position(u)
        want = wp.float32(k + 1) * share
        while b + 1 < n and passed + weights[b] < want:
            passed += weights[b]
            b += 1
        edge = bounds[b] + (bounds[b + 1] - bounds[b]) * wp.clamp((want - passed) / weights[b], 0.0, 1.0)
        edges[i, k + 1] = edge
        lengths[i, k] = (edge - edges[i, k]) / widening(u)


@wp.kernel(enable_backward=False)
def update_grids(
    positions: wp.array(dtype=wp.vec3f),
    densities: wp.array(dtype=wp.float32),
    near_cell: wp.float32,
    far_cell: wp.float32,
    rise: wp.float32,
    fall: wp.float32,
    part: wp.int32,
    parts: wp.int32,
    near_grid: wp.array3d(dtype=wp.float32),
    far_grid: wp.array3d(dtype=wp.float32),
):
    """Moves the cells that were sampled towards what was found there, faster up (`rise`) than down (`fall`).

    Launched once per `part` of the cells, so that parts may run side by side and each cell sees its samples in order.
    """
    i = wp.tid()
    g = positions[i]
    b = in_near_box(g)
    if is_near(b):
        c = grid_cell(b, near_grid.shape[0], near_grid.shape[1], near_grid.shape[2])
        if (c[0] + c[1]) % parts == part:
            stop = wp.min(1.0 - wp.exp(-densities[i] * near_cell), _MOST)
            old = near_grid[c[0], c[1], c[2]]
            near_grid[c[0], c[1], c[2]] = old + wp.where(stop > old, rise, fall) * (stop - old)
    else:
        c = grid_cell(g, far_grid.shape[0], far_grid.shape[1], far_grid.shape[2])
        if (c[0] + c[1]) % parts == part:
            stop = wp.min(1.0 - wp.exp(-densities[i] * far_cell), _MOST)
            old = far_grid[c[0], c[1], c[2]]
            far_grid[c[0], c[1], c[2]] = old + wp.where(stop > old, rise, fall) * (stop - old)
