"""Contrast of upright bars in pictures: colors in a narrow box around a vertical line, and on its two sides.

A picture is given by its summed-area table: the sum of the colors above and left of each pixel corner. The camera is
level, so a vertical line in space is a column of its picture.
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
from twin.warp_runtime import wp

_CORE = 0.7  # half width of the box inside a bar, as a fraction of the bar's half width
_GAP = 0.4  # [px] between the bar's edge and the boxes beside it
_SIDE = 0.5  # width of the boxes beside the bar, as a fraction of its half width; at least 1 px
LEAST_HALF_WIDTH = 0.6  # [px] narrower bars are not judged
LEAST_ROWS = 3  # lower bands are not judged
MOST_HIDDEN = 0.05  # largest fraction of the three boxes' surroundings that may be masked


@wp.func
def column_sum(sums: wp.array3d(dtype=wp.int32), top: int, bottom: int, x: float) -> wp.vec3:
    """Sum of the colors left of x [px] in the rows top ≤ v < bottom."""
    column = int(x)
    part = x - float(column)
    out = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        low = float(sums[bottom, column, c] - sums[top, column, c])
        high = float(sums[bottom, column + 1, c] - sums[top, column + 1, c])
        out[c] = low + part * (high - low)
    return out


@wp.func
def box_mean(sums: wp.array3d(dtype=wp.int32), top: int, bottom: int, left: float, right: float) -> wp.vec3:
    """Mean color of a box."""
    total = column_sum(sums, top, bottom, right) - column_sum(sums, top, bottom, left)
    return total / ((right - left) * float(bottom - top))


@wp.func
def largest(color: wp.vec3) -> float:
    return wp.max(wp.max(wp.abs(color[0]), wp.abs(color[1])), wp.abs(color[2]))


@wp.kernel
def add_bars(
    sums: wp.array3d(dtype=wp.int32),
    hidden: wp.array2d(dtype=wp.int32),
    intrinsics: wp.vec4,
    spot: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    radii: wp.array(dtype=wp.float32),
    bands: wp.array(dtype=wp.vec2),
    count: wp.array3d(dtype=wp.float32),
    contrast: wp.array3d(dtype=wp.float32),
    color: wp.array3d(dtype=wp.vec3),
    square: wp.array3d(dtype=wp.vec3),
):
    """Adds one picture to the sums over pictures, for each spot, radius and band of heights.

    `hidden` is the summed-area table of the masked pixels, which are not judged. `spot` is a spot's foot in the axes of
    the level camera: x to the right, height above the lens, z ahead [m]; `index` is its row in the sums. `contrast` is
    the smaller of the color differences to the left and to the right, `color` and `square` are the color inside and its
    square.
    """
    t = wp.tid()
    i = index[t]
    rows = sums.shape[0] - 1
    columns = sums.shape[1] - 1
    z = spot[t][2]
    u = intrinsics[0] * spot[t][0] / z + intrinsics[2]
    for b in range(bands.shape[0]):
        top = int(intrinsics[3] - intrinsics[1] * (spot[t][1] + bands[b][1]) / z + 0.5)
        bottom = int(intrinsics[3] - intrinsics[1] * (spot[t][1] + bands[b][0]) / z + 0.5)
        if top >= 0 and bottom <= rows and bottom - top >= LEAST_ROWS:
            for r in range(radii.shape[0]):
                half = radii[r] * intrinsics[0] / z
                side = wp.max(1.0, _SIDE * half)
                reach = half + _GAP + side
                shown = half >= LEAST_HALF_WIDTH and u - reach >= 0.0 and u + reach < float(columns)
                if shown:
                    first = int(u - reach)
                    last = int(u + reach) + 1
                    masked = hidden[bottom, last] - hidden[top, last] - hidden[bottom, first] + hidden[top, first]
                    shown = float(masked) <= MOST_HIDDEN * float((bottom - top) * (last - first))
                if shown:
                    inside = box_mean(sums, top, bottom, u - _CORE * half, u + _CORE * half)
                    left = inside - box_mean(sums, top, bottom, u - reach, u - half - _GAP)
                    right = inside - box_mean(sums, top, bottom, u + half + _GAP, u + reach)
                    count[i, r, b] += 1.0
                    contrast[i, r, b] += wp.min(largest(left), largest(right))
                    color[i, r, b] += inside
                    square[i, r, b] += wp.cw_mul(inside, inside)
