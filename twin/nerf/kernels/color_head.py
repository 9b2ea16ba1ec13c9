"""Color head on baked fields: composited features → colors, by the head and background networks of `network.py`.

The *bias* of the first layer includes the appearance embedding. Every camera of a launch has its own bias, and so its
own lighting.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept.
# mypy: ignore-errors
from functools import cache
from typing import Any

from twin.geometry.cameras import FAR
from twin.nerf.kernels.march import OPTIONS, ImageBuffers, fast_exp
from twin.nerf.kernels.volume import CHANNELS
from twin.warp_runtime import wp

HARMONICS = 16
"""Spherical harmonics of degree 0 to 3."""
FEATURES = CHANNELS - 1
LANES = {"cpu": 16, "cuda": 2}
"""Pixels per thread; see `march.py`. On an H200, two take 14 % less time than one, as they share the weights' loads."""

_UNROLLING = OPTIONS | {"max_unroll": 8}  # unrolls loops over eight units, not loops over lanes

wp.set_module_options(OPTIONS)

Vec8 = wp.types.vector(length=8, dtype=wp.float32)
"""Weights of eight hidden units."""

_INPUTS = FEATURES + HARMONICS


def harmonics_of(x: Any, y: Any, z: Any):
    """The 15 real spherical harmonics of degree 1 to 3 of unit vectors (x, y, z), up to constant factors.

    The function accepts NumPy and torch arrays, and Warp compiles it. The harmonic of degree 0 is the constant 1.
    """
    xx = x * x
    yy = y * y
    zz = z * z
    return (
        x,
        y,
        z,
        x * y,
        y * z,
        3.0 * zz - 1.0,
        x * z,
        xx - yy,
        y * (3.0 * xx - yy),
        x * y * z,
        y * (5.0 * zz - 1.0),
        z * (5.0 * zz - 3.0),
        x * (5.0 * zz - 1.0),
        z * (xx - yy),
        x * (xx - 3.0 * yy),
    )


_compiled_harmonics = wp.func(harmonics_of)
_Harmonics = wp.types.vector(length=HARMONICS - 1, dtype=wp.float32)


@wp.func
def _harmonics(d: wp.vec3f) -> _Harmonics:
    x, y, z, xy, yz, zz, xz, xx, yyy, xyz, yzz, zzz, xzz, zxx, xxx = _compiled_harmonics(d[0], d[1], d[2])
    return _Harmonics(x, y, z, xy, yz, zz, xz, xx, yyy, xyz, yzz, zzz, xzz, zxx, xxx)


@wp.func
def sigmoid(x: wp.float32) -> wp.float32:
    return 1.0 / (1.0 + fast_exp(wp.min(-x, 80.0)))  # from −x = 88 on, the exponent of `fast_exp` overflows


@cache
def color_head_kernel(lanes: int, hidden: int, background_hidden: int) -> tuple[Any, Any]:
    """Builds the kernel for `lanes` neighboring pixels per thread and given layer widths, and its struct of weights.

    The kernel is launched over cameras and runs of pixels, from `first` up to `last`. If rays stop at given depths (the
    images have `stop`), no background is added and features are divided by opacity, so that the color is that of the
    field alone (not premultiplied).
    """
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Inputs = wp.types.matrix(shape=(FEATURES + HARMONICS, lanes), dtype=wp.float32)
    Eight = wp.types.matrix(shape=(8, lanes), dtype=wp.float32)
    Color = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)
    Hidden = wp.types.matrix(shape=(hidden, lanes), dtype=wp.float32)
    Background = wp.types.matrix(shape=(background_hidden, lanes), dtype=wp.float32)

    @wp.func
    def add_harmonics(image: ImageBuffers, camera: wp.int32, first: wp.int32, x: Inputs) -> Inputs:
        """Appends the harmonics of the ray directions to the features."""
        k = image.intrinsics[camera]
        rotation = image.rotation[camera]
        for j in range(lanes):
            pixel = first + j
            u = (float(pixel % image.width) + 0.5 - k[2]) / k[0]
            v = (float(pixel // image.width) + 0.5 - k[3]) / k[1]
            d = rotation * wp.normalize(wp.vec3f(u, v, 1.0))
            x[FEATURES, j] = 1.0
            h = _harmonics(d)
            for n in range(15):
                x[FEATURES + 1 + n, j] = h[n]
        return x

    @wp.struct
    class Weights:
        """Head weights have shape (hidden / 8, inputs or outputs), each entry a vector of eight hidden units.

        Background weights are flat, index = input · n_out + output.
        """

        head_0: wp.array(dtype=Vec8)
        head_1: wp.array(dtype=Vec8)
        head_1_bias: wp.array(dtype=Vec8)
        head_2: wp.array(dtype=Vec8)
        head_2_bias: wp.vec3f
        backdrop_0: wp.array(dtype=wp.float32)
        backdrop_0_bias: wp.array(dtype=wp.float32)
        backdrop_1: wp.array(dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=_UNROLLING)
    def color_rays(
        weights: Weights,
        bias: wp.array2d(dtype=Vec8),
        image: ImageBuffers,
        first: wp.int32,
        last: wp.int32,
        features: wp.array3d(dtype=wp.float32),
        depth: wp.array2d(dtype=wp.float32),
        rgb: wp.array2d(dtype=wp.vec3f),
        opacity: wp.array2d(dtype=wp.float32),
    ):
        camera, run = wp.tid()
        start = first + run * lanes
        share = Floats()
        least = float(1.0)
        for j in range(lanes):
            share[j] = features[camera, 0, wp.min(start + j, last - 1)]
            least = wp.min(least, share[j])
        x = Inputs()
        for n in range(FEATURES):
            for j in range(lanes):
                x[n, j] = features[camera, n + 1, wp.min(start + j, last - 1)]
        x = add_harmonics(image, camera, start, x)
        if image.stop.shape[0] > 0:
            for n in range(FEATURES):
                for j in range(lanes):
                    x[n, j] = x[n, j] / wp.max(share[j], 1.0e-3)
        elif least < 0.999:
            g = Background()
            for n in range(background_hidden):
                a = Floats(weights.backdrop_0_bias[n])
                for i in range(HARMONICS):
                    a += x[FEATURES + i] * weights.backdrop_0[i * background_hidden + n]
                for j in range(lanes):
                    a[j] = wp.max(a[j], 0.0) * (1.0 - share[j])
                g[n] = a
            for i in range(FEATURES):
                a = x[i]
                for n in range(background_hidden):
                    a += g[n] * weights.backdrop_1[n * FEATURES + i]
                x[i] = a
        # Eight hidden units at a time: each input is read once for all eight, and eight independent sums keep the
        # processor busy. Both layers are written out: one function for both would be 30 % slower, as it copies inputs.
        h = Hidden()
        for q in range(weights.head_1_bias.shape[0]):
            s = Eight()
            w = bias[camera, q]
            for k in range(8):
                s[k] = Floats(w[k])
            for i in range(_INPUTS):
                row = x[i]
                w = weights.head_0[q * _INPUTS + i]
                for k in range(8):
                    s[k] += row * w[k]
            for k in range(8):
                h[8 * q + k] = wp.max(s[k], Floats())
        color = Color()
        for c in range(3):
            color[c] = Floats(weights.head_2_bias[c])
        for q in range(weights.head_1_bias.shape[0]):
            s = Eight()
            w = weights.head_1_bias[q]
            for k in range(8):
                s[k] = Floats(w[k])
            for i in range(hidden):
                row = h[i]
                w = weights.head_1[q * hidden + i]
                for k in range(8):
                    s[k] += row * w[k]
            for k in range(8):
                s[k] = wp.max(s[k], Floats())
            for c in range(3):
                w = weights.head_2[3 * q + c]
                color[c] += s[0] * w[0] + s[1] * w[1] + s[2] * w[2] + s[3] * w[3]
                color[c] += s[4] * w[4] + s[5] * w[5] + s[6] * w[6] + s[7] * w[7]
        for j in range(lanes):
            if start + j < last:
                pixel = start + j
                rgb[camera, pixel] = wp.vec3f(sigmoid(color[0, j]), sigmoid(color[1, j]), sigmoid(color[2, j]))
                opacity[camera, pixel] = share[j]
                z = depth[camera, pixel]
                depth[camera, pixel] = wp.where(z > 0.0, wp.min(z, FAR), FAR)

    return color_rays, Weights
