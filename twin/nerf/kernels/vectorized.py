"""Math without calls and branches, so that the compiler vectorizes loops over the lanes of a packet."""

# Warp reads annotations as values.
# mypy: ignore-errors
from twin.warp_runtime import wp

OPTIONS = {
    "enable_backward": False,
    # Loops over lanes must stay loops for the compiler to vectorize them.
    "max_unroll": 0,
    "optimization_level": 3,
    "fast_math": False,
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000",
}
"""Module options of kernels with such loops."""


@wp.func
def fast_exp(x: wp.float32) -> wp.float32:
    """e^x with a relative error of 1e-4."""
    y = wp.max(x, -80.0) * 1.4426950408889634
    n = wp.floor(y)
    f = y - n
    p = 1.0 + f * (0.69550201 + f * (0.22626982 + f * 0.07822817))
    return p * wp.cast((int(n) + 127) << 23, wp.float32)


@wp.func
def fast_log(x: wp.float32) -> wp.float32:
    """Natural logarithm of x in [1, 2] with an error of 1e-5 (Abramowitz and Stegun 1964, 4.1.43)."""
    y = x - 1.0
    return y * (0.99949556 + y * (-0.49190896 + y * (0.28947478 + y * (-0.13606275 + y * 0.03215845))))


@wp.func
def lowest_bit(bits: wp.int32) -> wp.int32:
    """Index of the lowest set bit below the sign, read from the exponent of that bit as a float."""
    return (wp.cast(float(bits & -bits), wp.int32) >> 23) - 127


@wp.func
def nonzero(x: wp.float32) -> wp.float32:
    return wp.where(wp.abs(x) < 1.0e-9, 1.0e-9, x)
