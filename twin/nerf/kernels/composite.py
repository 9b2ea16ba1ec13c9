"""Volume rendering of features along rays, with a backward pass and regularizers.

A ray has K strata, bounded by K + 1 edges [m]; stratum i has length δᵢ [contracted m] and a sample at distance tᵢ [m].
The network output of a sample holds *raw density* in channel 0 and features in the others. The weight of sample i is
wᵢ = Tᵢ·(1 − exp(−σᵢδᵢ)), where σᵢ is its density and Tᵢ the transmittance up to its stratum (Max 1995). The composited
output holds the *opacity* Σwᵢ in channel 0 and Σwᵢ·featureᵢ in the others. `space.py` defines contracted meters.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
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
