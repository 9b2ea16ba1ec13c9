"""Planes that make one frame look like its neighbours: the loops over pixels × hypotheses × windows.

A *plane* at a pixel is (q, ∂q/∂u, ∂q/∂v): the inverse z-depth q [1/m] there and its slopes [1/(m px)], exact since the
inverse depth of a plane is affine in the pixel. A *window* is 5 × 5 pixels `spacing` apart around the pixel; the plane
says where each is in another frame. Cost is 1 − NCC, weighted towards window pixels that are like the middle one, and
of several frames the two best count, since what one frame sees another may not (Gipuma, Galliani et al. 2015).
"""

# Warp reads annotations as values, and float() makes a variable of a kernel that changes within a loop.
# mypy: ignore-errors
import warp as wp

_SIDE = wp.constant(5)
_PIXELS = 25

Window = wp.types.vector(length=_PIXELS, dtype=wp.float32)

_WORST = wp.constant(2.0)  # cost of a frame that does not see the window
_TONE = wp.constant(0.08)  # difference of grey at which a window pixel counts 1/e
_RETURN = wp.constant(2.0)  # [px] how near a place must come back to where it started
_FLAT = wp.constant(1e-5)  # variance of grey below which there is nothing to match


@wp.struct
class Frames:
    """Grey pictures in one array."""

    grey: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int64)
    width: wp.array(dtype=wp.int32)
    height: wp.array(dtype=wp.int32)


@wp.struct
class Pairs:
    """How a frame's pixel p = (u, v, 1) with inverse depth q appears in each of its sources: turn · p + shift · q."""

    source: wp.array(dtype=wp.int32)
    turn: wp.array(dtype=wp.mat33)
    shift: wp.array(dtype=wp.vec3)


@wp.func
def pixel_of(row: int, column: int, step: int) -> wp.vec2:
    """Centre of the pixel a cell of the grid stands for."""
    return wp.vec2(float(column * step + step // 2) + 0.5, float(row * step + step // 2) + 0.5)


@wp.func
def grey_at(frames: Frames, frame: int, x: float, y: float) -> float:
    """Bilinear grey at (x, y), pixel centres at whole numbers; −1 outside."""
    width = frames.width[frame]
    height = frames.height[frame]
    if not (x >= 0.0 and y >= 0.0 and x < float(width - 1) and y < float(height - 1)):
        return -1.0
    column = int(x)
    row = int(y)
    s = x - float(column)
    t = y - float(row)
    at = int(frames.start[frame]) + row * width + column
    top = frames.grey[at] * (1.0 - s) + frames.grey[at + 1] * s
    bottom = frames.grey[at + width] * (1.0 - s) + frames.grey[at + width + 1] * s
    return top * (1.0 - t) + bottom * t


@wp.func
def difference(
    frames: Frames,
    pairs: Pairs,
    k: int,
    centre: wp.vec2,
    plane: wp.vec3,
    spacing: float,
    values: Window,
    weights: Window,
    mean: float,
    variance: float,
) -> float:
    """1 − NCC of a reference window (its weights add up to 1) and what source k shows where the plane puts it."""
    source = pairs.source[k]
    turn = pairs.turn[k]
    shift = pairs.shift[k]
    # The homography of the plane: affine in the window's offsets before the division.
    middle = turn * wp.vec3(centre[0], centre[1], 1.0) + shift * plane[0]
    along_u = (wp.vec3(turn[0, 0], turn[1, 0], turn[2, 0]) + shift * plane[1]) * spacing
    along_v = (wp.vec3(turn[0, 1], turn[1, 1], turn[2, 1]) + shift * plane[2]) * spacing
    total = float(0.0)
    squares = float(0.0)
    products = float(0.0)
    for i in range(_SIDE):
        for j in range(_SIDE):
            h = middle + along_v * float(i - 2) + along_u * float(j - 2)
            if h[2] <= 1.0e-6:
                return _WORST
            value = grey_at(frames, source, h[0] / h[2] - 0.5, h[1] / h[2] - 0.5)
            if value < 0.0:
                return _WORST
            w = weights[i * _SIDE + j]
            total += w * value
            squares += w * value * value
            products += w * value * values[i * _SIDE + j]
    spread = squares - total * total
    if spread < _FLAT:
        return _WORST
    return 1.0 - (products - total * mean) / wp.sqrt(spread * variance)


@wp.func
def cost_of(
    frames: Frames,
    pairs: Pairs,
    centre: wp.vec2,
    plane: wp.vec3,
    spacing: float,
    values: Window,
    weights: Window,
    mean: float,
    variance: float,
) -> float:
    """Mean of the two best differences."""
    best = float(_WORST)
    second = float(_WORST)
    count = pairs.source.shape[0]
    for k in range(count):
        d = difference(frames, pairs, k, centre, plane, spacing, values, weights, mean, variance)
        if d < best:
            second = best
            best = d
        elif d < second:
            second = d
    if count == 1:
        return best
    return 0.5 * (best + second)


@wp.func
def look(frames: Frames, frame: int, centre: wp.vec2, spacing: float, values: Window) -> Window:
    """Grey of the reference window around a pixel, the border repeated."""
    width = frames.width[frame]
    height = frames.height[frame]
    at = int(frames.start[frame])
    for i in range(_SIDE):
        for j in range(_SIDE):
            x = wp.clamp(int(centre[0] + float(j - 2) * spacing), 0, width - 1)
            y = wp.clamp(int(centre[1] + float(i - 2) * spacing), 0, height - 1)
            values[i * _SIDE + j] = frames.grey[at + y * width + x]
    return values


@wp.kernel(enable_backward=False)
def sweep(
    frames: Frames,
    pairs: Pairs,
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
    """Gives every other cell the best of its own plane, its neighbours' and some guesses.

    Round 0 starts from `first` and `second` (q = 0: none) and a random depth; later rounds try the four neighbours'
    planes (which this parity's cells do not change) and two disturbances that shrink from round to round.
    """
    row, half = wp.tid()
    rows = planes.shape[0]
    columns = planes.shape[1]
    column = 2 * half + (row + parity) % 2
    if column >= columns:
        return
    centre = pixel_of(row, column, step)
    values = look(frames, frame, centre, spacing, Window())
    weights = Window()
    grey = values[12]
    sum_w = float(0.0)
    for i in range(25):
        w = wp.exp(-wp.abs(values[i] - grey) / _TONE)
        weights[i] = w
        sum_w += w
    mean = float(0.0)
    squares = float(0.0)
    for i in range(25):
        w = weights[i] / sum_w
        weights[i] = w
        mean += w * values[i]
        squares += w * values[i] * values[i]
    variance = squares - mean * mean
    if variance < _FLAT:
        costs[row, column] = _WORST
        if round_number == 0:
            planes[row, column] = first[row, column]
        return
    state = wp.rand_init(seed + 7919 * round_number, row * columns + column)
    best = planes[row, column]
    lowest = costs[row, column]
    if round_number == 0:
        guess = low * wp.pow(high / low, wp.randf(state))
        best = wp.vec3(guess, 0.0, 0.0)
        lowest = cost_of(frames, pairs, centre, best, spacing, values, weights, mean, variance)
        for n in range(2):
            trial = first[row, column]
            if n == 1:
                trial = second[row, column]
            if trial[0] >= low and trial[0] <= high:
                cost = cost_of(frames, pairs, centre, trial, spacing, values, weights, mean, variance)
                if cost < lowest:
                    lowest = cost
                    best = trial
    else:
        for n in range(4):
            r = row
            c = column
            if n == 0:
                c = column - 1
            elif n == 1:
                c = column + 1
            elif n == 2:
                r = row - 1
            else:
                r = row + 1
            if r >= 0 and r < rows and c >= 0 and c < columns:
                there = planes[r, c]
                trial = wp.vec3(
                    there[0] + float(step) * (there[1] * float(column - c) + there[2] * float(row - r)),
                    there[1],
                    there[2],
                )
                if trial[0] >= low and trial[0] <= high and trial[0] != best[0]:
                    cost = cost_of(frames, pairs, centre, trial, spacing, values, weights, mean, variance)
                    if cost < lowest:
                        lowest = cost
                        best = trial
        scale = wp.pow(0.4, float(round_number))
        for n in range(2):
            slope = scale * best[0] * 0.02
            trial = wp.vec3(
                best[0],
                best[1] + slope * (2.0 * wp.randf(state) - 1.0),
                best[2] + slope * (2.0 * wp.randf(state) - 1.0),
            )
            if n == 0:
                trial[0] = best[0] * (1.0 + 0.5 * scale * (2.0 * wp.randf(state) - 1.0))
            if trial[0] >= low and trial[0] <= high:
                cost = cost_of(frames, pairs, centre, trial, spacing, values, weights, mean, variance)
                if cost < lowest:
                    lowest = cost
                    best = trial
    planes[row, column] = best
    costs[row, column] = lowest


@wp.kernel(enable_backward=False)
def agree(
    pairs: Pairs,
    back: wp.array(dtype=wp.mat33),
    back_shift: wp.array(dtype=wp.vec3),
    planes: wp.array3d(dtype=wp.vec3),
    shapes: wp.array(dtype=wp.vec2i),
    costs: wp.array2d(dtype=wp.float32),
    frame: int,
    step: int,
    most_cost: float,
    tolerance: float,
    parallax: float,
    votes: wp.array2d(dtype=wp.int32),
):
    """How many sources found the same place: their plane puts it where it came from, at the same inverse depth.

    A place whose pixel hardly moves with its depth (less than `parallax` [px] for a change by `tolerance`) in a source
    gets no vote there: nothing was measured.
    """
    row, column = wp.tid()
    votes[row, column] = 0
    if row >= shapes[frame][0] or column >= shapes[frame][1] or costs[row, column] > most_cost:
        return
    q = planes[frame, row, column][0]
    centre = pixel_of(row, column, step)
    for k in range(pairs.source.shape[0]):
        source = pairs.source[k]
        h = pairs.turn[k] * wp.vec3(centre[0], centre[1], 1.0) + pairs.shift[k] * q
        if h[2] <= 1.0e-6:
            continue
        u = h[0] / h[2]
        v = h[1] / h[2]
        shift = pairs.shift[k]
        du = (shift[0] - u * shift[2]) / h[2] * q * tolerance
        dv = (shift[1] - v * shift[2]) / h[2] * q * tolerance
        if u < 0.0 or v < 0.0 or du * du + dv * dv < parallax * parallax:
            continue
        r = int(v) // step
        c = int(u) // step
        if r >= shapes[source][0] or c >= shapes[source][1]:
            continue
        there = planes[source, r, c]
        middle = pixel_of(r, c, step)
        found = there[0] + there[1] * (u - middle[0]) + there[2] * (v - middle[1])
        # h is in units of this frame's depth: the source's inverse depth of the place is q / h₂.
        if found > 0.0 and wp.abs(found * h[2] / q - 1.0) < tolerance:
            b = back[k] * wp.vec3(u, v, 1.0) + back_shift[k] * found
            if wp.abs(b[0] / b[2] - centre[0]) + wp.abs(b[1] / b[2] - centre[1]) < _RETURN:
                votes[row, column] += 1
