"""PatchMatch stereo: fits planes that map windows of a reference frame to similar ones in its source frames.

A *plane* at a pixel is (q, ∂q/∂u, ∂q/∂v): inverse z-depth q [1/m] and its slopes [1/(m px)]. This is exact for a plane
in space, whose inverse depth is affine in the pixel. A *window* is 5 × 5 pixels `spacing` apart around the pixel; the
plane maps it to a source frame. The cost is 1 − NCC (normalized cross-correlation), in which window pixels weigh more
if they resemble the middle one.
Only the two sources of lowest cost are used, since a point may be hidden in the others (Gipuma, Galliani et al. 2015).
"""

# Warp evaluates annotations, so they contain calls, which mypy does not accept. In a kernel, float() and int() declare
# a variable that a loop changes.
# mypy: ignore-errors
from twin.warp_runtime import wp

_SIDE = 5
_PIXELS = 25

Window = wp.types.vector(length=_PIXELS, dtype=wp.float32)

_WORST_COST = 2.0  # cost in a source that does not contain the window or has no texture in it
_GRAY_SIGMA = 0.08  # gray difference at which a window pixel has weight 1/e
_MAX_RETURN_ERROR = 2.0  # [px] greatest error of a point mapped to a source and back
_MIN_VARIANCE = 1e-5  # a window with a smaller variance of gray has no texture to match


@wp.struct
class GrayImages:
    """Gray images in one array."""

    gray: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int64)
    width: wp.array(dtype=wp.int32)
    height: wp.array(dtype=wp.int32)


@wp.struct
class SourceViews:
    """Mapping of a frame's pixel p = (u, v, 1) with inverse depth q to its sources: homography · p + epipole · q."""

    source: wp.array(dtype=wp.int32)
    homography: wp.array(dtype=wp.mat33)
    epipole: wp.array(dtype=wp.vec3)


@wp.func
def cell_center(row: int, column: int, step: int) -> wp.vec2:
    """Center [px] of the middle pixel of a cell, a square of `step`² pixels."""
    return wp.vec2(float(column * step + step // 2) + 0.5, float(row * step + step // 2) + 0.5)


@wp.func
def gray_at(frames: GrayImages, frame: int, x: float, y: float) -> float:
    """Bilinear gray at (x, y), with pixel centers at whole numbers; −1 outside."""
    width = frames.width[frame]
    height = frames.height[frame]
    if not (x >= 0.0 and y >= 0.0 and x < float(width - 1) and y < float(height - 1)):
        return -1.0
    column = int(x)
    row = int(y)
    s = x - float(column)
    t = y - float(row)
    at = int(frames.start[frame]) + row * width + column
    top = frames.gray[at] * (1.0 - s) + frames.gray[at + 1] * s
    bottom = frames.gray[at + width] * (1.0 - s) + frames.gray[at + width + 1] * s
    return top * (1.0 - t) + bottom * t


@wp.struct
class ReferenceWindow:
    """Window of a reference frame with weights that sum to 1."""

    center: wp.vec2
    spacing: float
    values: Window
    weights: Window
    mean: float
    variance: float


@wp.func
def reference_window(frames: GrayImages, frame: int, center: wp.vec2, spacing: float) -> ReferenceWindow:
    """The window around a pixel; beyond the border of the frame, the border pixels are repeated."""
    window = ReferenceWindow()
    window.center = center
    window.spacing = spacing
    width = frames.width[frame]
    height = frames.height[frame]
    at = int(frames.start[frame])
    values = Window()
    for i in range(_SIDE):
        for j in range(_SIDE):
            x = wp.clamp(int(center[0] + float(j - 2) * spacing), 0, width - 1)
            y = wp.clamp(int(center[1] + float(i - 2) * spacing), 0, height - 1)
            values[i * _SIDE + j] = frames.gray[at + y * width + x]
    weights = Window()
    gray = values[_PIXELS // 2]
    total = float(0.0)
    for i in range(_PIXELS):
        w = wp.exp(-wp.abs(values[i] - gray) / _GRAY_SIGMA)
        weights[i] = w
        total += w
    mean = float(0.0)
    squares = float(0.0)
    for i in range(_PIXELS):
        w = weights[i] / total
        weights[i] = w
        mean += w * values[i]
        squares += w * values[i] * values[i]
    window.values = values
    window.weights = weights
    window.mean = mean
    window.variance = squares - mean * mean
    return window


@wp.func
def ncc_cost(frames: GrayImages, views: SourceViews, k: int, window: ReferenceWindow, plane: wp.vec3) -> float:
    """1 − NCC of a reference window and its image in source k under the plane."""
    source = views.source[k]
    homography = views.homography[k]
    epipole = views.epipole[k]
    # The plane's homography; its homogeneous coordinates, before the division, are affine in the window's offsets.
    middle = homography * wp.vec3(window.center[0], window.center[1], 1.0) + epipole * plane[0]
    along_u = (wp.vec3(homography[0, 0], homography[1, 0], homography[2, 0]) + epipole * plane[1]) * window.spacing
    along_v = (wp.vec3(homography[0, 1], homography[1, 1], homography[2, 1]) + epipole * plane[2]) * window.spacing
    total = float(0.0)
    squares = float(0.0)
    products = float(0.0)
    for i in range(_SIDE):
        for j in range(_SIDE):
            h = middle + along_v * float(i - 2) + along_u * float(j - 2)
            if h[2] <= 1.0e-6:
                return _WORST_COST
            value = gray_at(frames, source, h[0] / h[2] - 0.5, h[1] / h[2] - 0.5)
            if value < 0.0:
                return _WORST_COST
            w = window.weights[i * _SIDE + j]
            total += w * value
            squares += w * value * value
            products += w * value * window.values[i * _SIDE + j]
    spread = squares - total * total
    if spread < _MIN_VARIANCE:
        return _WORST_COST
    return 1.0 - (products - total * window.mean) / wp.sqrt(spread * window.variance)


@wp.func
def matching_cost(frames: GrayImages, views: SourceViews, window: ReferenceWindow, plane: wp.vec3) -> float:
    """Mean of the two lowest `ncc_cost` over all sources."""
    best = float(_WORST_COST)
    second = float(_WORST_COST)
    count = views.source.shape[0]
    for k in range(count):
        d = ncc_cost(frames, views, k, window, plane)
        if d < best:
            second = best
            best = d
        elif d < second:
            second = d
    if count == 1:
        return best
    return 0.5 * (best + second)


@wp.kernel(enable_backward=False)
def sweep(
    frames: GrayImages,
    views: SourceViews,
    frame: int,
    step: int,
    spacing: float,
    low: float,
    high: float,
    round_number: int,
    parity: int,
    seed: int,
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    planes: wp.array2d(dtype=wp.vec3),
    costs: wp.array2d(dtype=wp.float32),
):
    """Sets the cells of one `parity` (checkerboard) to the best of their own plane and those that the round tries.

    Round 0 tries `first`, `second` (q = 0: none) and a random depth; later rounds try the planes of the four neighbors
    (which are of the other parity) and two perturbations that shrink from round to round.
    """
    row, half = wp.tid()
    rows = planes.shape[0]
    columns = planes.shape[1]
    column = 2 * half + (row + parity) % 2
    if column >= columns:
        return
    window = reference_window(frames, frame, cell_center(row, column, step), spacing)
    if window.variance < _MIN_VARIANCE:
        costs[row, column] = _WORST_COST
        if round_number == 0:
            planes[row, column] = first[row, column]
        return
    state = wp.rand_init(seed + 7919 * round_number, row * columns + column)
    best = planes[row, column]
    lowest = costs[row, column]
    trials = 6
    if round_number == 0:
        best = wp.vec3(low * wp.pow(high / low, wp.randf(state)), 0.0, 0.0)
        lowest = matching_cost(frames, views, window, best)
        trials = 2
    scale = wp.pow(0.4, float(round_number))
    for n in range(trials):
        trial = wp.vec3()
        if round_number == 0:
            trial = first[row, column]
            if n == 1:
                trial = second[row, column]
        elif n < 4:
            c = column + wp.where(n < 2, 2 * n - 1, 0)
            r = row + wp.where(n < 2, 0, 2 * n - 5)
            if r < 0 or r >= rows or c < 0 or c >= columns:
                continue
            there = planes[r, c]
            trial = wp.vec3(
                there[0] + float(step) * (there[1] * float(column - c) + there[2] * float(row - r)),
                there[1],
                there[2],
            )
            if trial[0] == best[0]:
                continue
        else:
            slope = scale * best[0] * 0.02
            trial = wp.vec3(
                best[0],
                best[1] + slope * (2.0 * wp.randf(state) - 1.0),
                best[2] + slope * (2.0 * wp.randf(state) - 1.0),
            )
            if n == 4:
                trial[0] = best[0] * (1.0 + 0.5 * scale * (2.0 * wp.randf(state) - 1.0))
        if trial[0] >= low and trial[0] <= high:
            cost = matching_cost(frames, views, window, trial)
            if cost < lowest:
                lowest = cost
                best = trial
    planes[row, column] = best
    costs[row, column] = lowest


@wp.kernel(enable_backward=False)
def count_votes(
    views: SourceViews,
    back: wp.array(dtype=wp.mat33),
    back_epipole: wp.array(dtype=wp.vec3),
    planes: wp.array3d(dtype=wp.vec3),
    shapes: wp.array(dtype=wp.vec2i),
    costs: wp.array2d(dtype=wp.float32),
    frame: int,
    step: int,
    max_cost: float,
    tolerance: float,
    parallax: float,
    votes: wp.array2d(dtype=wp.int32),
):
    """Counts the sources that found the same point: their planes have its inverse depth and map it back to its pixel.

    A source does not vote if a relative change of inverse depth by `tolerance` moves the pixel less than `parallax`
    [px] in it: such a source does not measure the depth.
    """
    row, column = wp.tid()
    votes[row, column] = 0
    if row >= shapes[frame][0] or column >= shapes[frame][1] or costs[row, column] > max_cost:
        return
    q = planes[frame, row, column][0]
    center = cell_center(row, column, step)
    for k in range(views.source.shape[0]):
        source = views.source[k]
        h = views.homography[k] * wp.vec3(center[0], center[1], 1.0) + views.epipole[k] * q
        if h[2] <= 1.0e-6:
            continue
        u = h[0] / h[2]
        v = h[1] / h[2]
        epipole = views.epipole[k]
        du = (epipole[0] - u * epipole[2]) / h[2] * q * tolerance
        dv = (epipole[1] - v * epipole[2]) / h[2] * q * tolerance
        if u < 0.0 or v < 0.0 or du * du + dv * dv < parallax * parallax:
            continue
        r = int(v) // step
        c = int(u) // step
        if r >= shapes[source][0] or c >= shapes[source][1]:
            continue
        there = planes[source, r, c]
        middle = cell_center(r, c, step)
        found = there[0] + there[1] * (u - middle[0]) + there[2] * (v - middle[1])
        # h is in units of this frame's depth: the source's inverse depth of the point is q / h₂.
        if found > 0.0 and wp.abs(found * h[2] / q - 1.0) < tolerance:
            b = back[k] * wp.vec3(u, v, 1.0) + back_epipole[k] * found
            if wp.abs(b[0] / b[2] - center[0]) + wp.abs(b[1] / b[2] - center[1]) < _MAX_RETURN_ERROR:
                votes[row, column] += 1
