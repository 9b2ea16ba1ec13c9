"""Where along a ray the field is asked: inverse-CDF sampling from a grid of densities.

*Density grid*: what is known of the density [1/m], one value per cell of the contracted cube, coarse and always a
little late. *Bin*: one step of the march through it. *Stratum*: the stretch between two of K + 1 equal quantiles of
the bins' weights; each is sampled once and stands for its whole length.
"""

import warp as wp

from twin.nerf.kernels.space import grid_position, max_norm

BINS = wp.constant(256)
_FAR = wp.constant(100.0)  # unit positions beyond this are one with the horizon
_BEYOND = wp.constant(3)  # bins behind an opaque one
_WIDENING = wp.constant(0.02)  # least bin length as a share of the distance


@wp.func
def grid_cell(g: wp.vec3f, nx: wp.int32, ny: wp.int32, nz: wp.int32) -> wp.vec3i:
    return wp.vec3i(
        wp.int32(g[0] * wp.float32(nx)), wp.int32(g[1] * wp.float32(ny)), wp.int32(g[2] * wp.float32(nz))
    )


@wp.kernel(enable_backward=False)
def sample_rays(
    origins: wp.array(dtype=wp.vec3f),  # type: ignore[valid-type]
    directions: wp.array(dtype=wp.vec3f),  # type: ignore[valid-type]
    targets: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    centre: wp.vec3f,
    inverse_half: wp.vec3f,
    grid: wp.array3d(dtype=wp.float32),  # type: ignore[valid-type]
    cell: wp.float32,
    near: wp.float32,
    floor: wp.float32,
    target_mass: wp.float32,
    seed: wp.int32,
    start: wp.int32,
    edges: wp.array2d(dtype=wp.float32),  # type: ignore[valid-type]
    distances: wp.array2d(dtype=wp.float32),  # type: ignore[valid-type]
    positions: wp.array2d(dtype=wp.vec3f),  # type: ignore[valid-type]
):
    """K samples per ray: stratum edges (n, K + 1) [m], sampled distances (n, K) [m] and grid positions (n, K).

    Args:
        targets: Distance at which something is known to be [m], 0 = unknown; gets `target_mass` of extra weight.
        grid: Densities [1/m] over the contracted cube.
        cell: Side of a grid cell inside the near box [m].
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
    n = int(0)
    beyond = int(0)
    bounds[0] = t
    while n < BINS:
        m = max_norm(wp.cw_mul(o + d * t - centre, inverse_half))
        if m > _FAR:
            break
        step = wp.max(cell * wp.max(0.75, m * m), _WIDENING * t)
        u = wp.cw_mul(o + d * (t + 0.5 * step) - centre, inverse_half)
        c = grid_cell(grid_position(u), grid.shape[0], grid.shape[1], grid.shape[2])
        through = wp.exp(-grid[c[0], c[1], c[2]] * step)
        weights[n] = transmittance * (1.0 - through)
        transmittance *= through
        t += step
        n += 1
        bounds[n] = t
        # The surface may lie a cell behind where the grid believes it; a target further back must be reached, too.
        if transmittance < 1.0e-3 and t > target:
            beyond += 1
            if beyond > _BEYOND:
                break

    # Neighbours share weight: a surface need not lie in the bin whose cell first saw it.
    total = float(0.0)
    before = float(0.0)
    before2 = float(0.0)
    uniform = floor / wp.float32(n)
    for b in range(n):
        here = weights[b]
        after = float(0.0)
        after2 = float(0.0)
        if b + 1 < n:
            after = weights[b + 1]
        if b + 2 < n:
            after2 = weights[b + 2]
        p = 0.4 * here + 0.2 * (before + after) + 0.1 * (before2 + after2) + uniform
        if target > bounds[b] and target <= bounds[b + 1]:
            p += target_mass
        before2 = before
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
        distances[i, k] = s
        positions[i, k] = grid_position(wp.cw_mul(o + d * s - centre, inverse_half))
        want = wp.float32(k + 1) * share
        while b + 1 < n and passed + weights[b] < want:
            passed += weights[b]
            b += 1
        edges[i, k + 1] = bounds[b] + (bounds[b + 1] - bounds[b]) * wp.clamp((want - passed) / weights[b], 0.0, 1.0)


@wp.kernel(enable_backward=False)
def update_grid(
    positions: wp.array(dtype=wp.vec3f),  # type: ignore[valid-type]
    densities: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    rise: wp.float32,
    fall: wp.float32,
    part: wp.int32,
    parts: wp.int32,
    grid: wp.array3d(dtype=wp.float32),  # type: ignore[valid-type]
):
    """Moves the cells that were sampled towards the density found there, faster up (`rise`) than down (`fall`).

    Launched once per `part` of the cells, so that parts may run side by side and each cell sees its samples in order.
    """
    i = wp.tid()
    c = grid_cell(positions[i], grid.shape[0], grid.shape[1], grid.shape[2])
    if (c[0] + c[1]) % parts == part:
        old = grid[c[0], c[1], c[2]]
        change = densities[i] - old
        if change > 0.0:
            grid[c[0], c[1], c[2]] = old + rise * change
        else:
            grid[c[0], c[1], c[2]] = old + fall * change
