"""Volume rendering of a field in training: samples, compositing of features with a backward pass, and regularizers.

A ray has K strata, bounded by K + 1 edges [m]; stratum i has length δᵢ [contracted m] and a sample at distance tᵢ [m].
The network output of a sample holds *raw density* in channel 0 and features in the others. The weight of sample i is
wᵢ = Tᵢ·(1 − exp(−σᵢδᵢ)), where σᵢ is its density and Tᵢ the transmittance up to its stratum (Max 1995). The composited
output holds the *opacity* Σwᵢ in channel 0 and Σwᵢ·featureᵢ in the others. `space.py` defines contracted meters.

Samples come from opacity grids, by inverse-CDF sampling. *Opacity grid*: stores for each cell the fraction of light
that the cell blocks, averaged over the samples in it. (With mean density instead, a cell that contains only a thin post
would be opaque.) A fine grid covers the near box, and a coarse one covers the contracted cube. *Bin*: one weighted step
of the march through the grids. *Stratum*: one of K intervals of a ray that contain equal weight; it is sampled once,
and the sample represents the whole stratum.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
# ruff: noqa: RUF046
from twin.nerf.kernels.space import Contraction, Rays, expansion, grid_position, max_norm, unit_position
from twin.warp_runtime import wp

CHANNELS = 16
"""Network outputs per sample: raw density and 15 features."""

Channels = wp.types.vector(length=CHANNELS, dtype=wp.float32)

RAW_LIMIT = 14.0
"""Upper limit of raw density, at which a stratum of any usual length is opaque."""


@wp.struct
class Strata:
    """Strata of n rays."""

    edges: wp.array2d(dtype=wp.float32)
    """[m], shape (n, K + 1)."""
    distances: wp.array2d(dtype=wp.float32)
    """Sampled distances [m], shape (n, K)."""
    lengths: wp.array2d(dtype=wp.float32)
    """[contracted m], shape (n, K)."""


@wp.func
def density_of(raw: wp.float32, unit: wp.float32) -> wp.float32:
    """Density [1/contracted m] of a raw output; `unit` is the density at raw output 0."""
    return unit * wp.exp(wp.min(raw, RAW_LIMIT))


@wp.kernel(enable_backward=False)
def sample_densities(
    outputs: wp.array(dtype=Channels), unit: wp.float32, start: wp.int32, densities: wp.array(dtype=wp.float32)
):
    """Densities of samples [1/contracted m]."""
    i = start + wp.tid()
    densities[i] = density_of(outputs[i][0], unit)


@wp.kernel(enable_backward=False)
def composite(
    outputs: wp.array2d(dtype=Channels),
    strata: Strata,
    unit: wp.float32,
    start: wp.int32,
    weights: wp.array2d(dtype=wp.float32),
    composited: wp.array(dtype=Channels),
    inverse_distance: wp.array(dtype=wp.float32),
    median_distance: wp.array(dtype=wp.float32),
):
    """Opacity and features per ray, Σwᵢ/tᵢ [1/m], and the distance [m] at which half the light is blocked.

    The distance is −1 if less than half is blocked.
    """
    i = start + wp.tid()
    transmittance = float(1.0)
    total = Channels()
    inverse = float(0.0)
    median = float(-1.0)
    for k in range(strata.distances.shape[1]):
        out = outputs[i, k]
        sigma = density_of(out[0], unit)
        optical = sigma * strata.lengths[i, k]
        through = wp.exp(-optical)
        w = transmittance * (1.0 - through)
        weights[i, k] = w
        total += out * w
        inverse += w / strata.distances[i, k]
        if median < 0.0 and transmittance * through < 0.5:
            share = wp.log(transmittance / 0.5) / optical
            median = strata.edges[i, k] + share * (strata.edges[i, k + 1] - strata.edges[i, k])
        transmittance *= through
    total[0] = 1.0 - transmittance
    composited[i] = total
    inverse_distance[i] = inverse
    median_distance[i] = median


@wp.kernel(enable_backward=False)
def composite_backward(
    outputs: wp.array2d(dtype=Channels),
    strata: Strata,
    weights: wp.array2d(dtype=wp.float32),
    targets: wp.array(dtype=wp.float32),
    composited_grad: wp.array(dtype=Channels),
    inverse_distance_grad: wp.array(dtype=wp.float32),
    unit: wp.float32,
    distortion: wp.float32,
    depth: wp.float32,
    depth_reach: wp.float32,
    log_offset: wp.float32,
    start: wp.int32,
    outputs_grad: wp.array2d(dtype=Channels),
):
    """Loss gradient of the network outputs, given those of the composited output and of Σwᵢ/tᵢ.

    Adds the gradient of two regularizers of the weights:
        distortion · (Σᵢⱼ wᵢwⱼ|sᵢ − sⱼ| + ⅓ Σ wᵢ²Δsᵢ), s = log(t + log_offset)      (Barron et al. 2022, eq. 15)
        depth · (Σᵢ wᵢ·min(|tᵢ/target − 1|, reach) + (1 − Σwᵢ)·reach), if a target distance is known: the cost of moving
        all weight to it, capped at reach = `depth_reach` to limit the effect of wrong targets.
    """
    i = start + wp.tid()
    count = strata.distances.shape[1]
    target = targets[i]
    gradient = composited_grad[i]
    opacity_gradient = gradient[0]
    inverse_gradient = inverse_distance_grad[i]

    # Σⱼ wⱼ|sᵢ − sⱼ| = sᵢ(2Wᵢ − W) − (2Sᵢ − S) with prefix sums Wᵢ of w and Sᵢ of w·s, as the samples are sorted.
    all_w = float(0.0)
    all_ws = float(0.0)
    for k in range(count):
        w = weights[i, k]
        all_w += w
        all_ws += w * wp.log(strata.distances[i, k] + log_offset)
    sum_w = all_w
    sum_ws = all_ws

    behind = float(0.0)  # Σ_{j>i} wⱼ·∂L/∂wⱼ
    left = 1.0 - all_w
    for reverse in range(count):
        k = count - 1 - reverse
        out = outputs[i, k]
        w = weights[i, k]
        t = strata.distances[i, k]
        s = wp.log(t + log_offset)
        sum_w -= w
        sum_ws -= w * s
        spread = s * (2.0 * sum_w + w - all_w) - (2.0 * sum_ws + w * s - all_ws)
        width = wp.log((strata.edges[i, k + 1] + log_offset) / (strata.edges[i, k] + log_offset))
        gw = opacity_gradient + inverse_gradient / t + distortion * (2.0 * spread + 0.6666667 * w * width)
        if target > 0.0:
            gw += depth * (wp.min(wp.abs(t / target - 1.0), depth_reach) - depth_reach)
        grad = gradient * w
        gw += wp.dot(gradient, out) - opacity_gradient * out[0]
        # ∂wᵢ/∂σᵢ = δᵢ·T_{i+1}, and ∂wⱼ/∂σᵢ = −δᵢ·wⱼ for the samples j behind sample i.
        sigma = density_of(out[0], unit)
        left += w  # Tᵢ
        slope = gw * (left - w) - behind
        behind += gw * w
        if out[0] < RAW_LIMIT:
            grad[0] = slope * sigma * strata.lengths[i, k]
        else:
            grad[0] = 0.0
        outputs_grad[i, k] = grad


# ---- samples

BINS = 256
_FAR = 100.0  # a ray ends at this unit position; what is farther is the horizon
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
