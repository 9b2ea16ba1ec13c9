"""Checks a film before the build: finds defects that reduce the twin's quality and parts that are fixed to the camera.

Key frames spread over the film are decoded; if these are too few, other frames are decoded, too. The timing comes from
all packets. Stabilization and rolling shutter leave no trace in the file; the build finds them.

Parts that are fixed to the camera are dirt and drops on the lens, logos, time stamps, and parts of the robot. There are
two kinds of evidence. At a *persistent edge*, the gradient of the brightness has one direction in nearly all frames.
Camera motion averages a scene's gradients out; those of a fixed pattern remain (Weiss, "Deriving intrinsic images from
image sequences", ICCV 2001). Under forward motion, edges that point to the vanishing point persist, too, such as lanes
and curbs; they are rejected by their directions. An *island* is a region that hardly varies while its surroundings vary
much. Smooth regions such as the sky have no edges and are no islands. A missed spot adds an artifact to the radiance
field; a wrong mask removes a part of the place. In case of doubt, nothing is masked.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import av
import av.error
import cv2
import numpy as np
from numpy.typing import NDArray

from twin.capture.hdr import HDR_NAMES
from twin.capture.video import FilmTiming, fitted_size, hdr_transfer, open_film, probe, sharpness, upright
from twin.geometry.images import resize
from twin.types import Array, Image

# ---- parts that are fixed to the camera

Mask = NDArray[np.bool_]

MIN_FRAMES = 12
_MAX_FRAMES = 40  # if there are more frames, only every second, third, ... is used, which saves time
_MAX_SHARE = 0.4  # largest fraction of the picture that is masked
_MIN_GRADIENT = 2.0  # [gray levels per px] smallest gradient of an edge
# A persistent edge exceeds the smallest gradient in 90 % of the frames, a likely one in 70 %. Edges of the scene that
# persist by chance are surrounded by likely edges. Of a fixed object's edges, at least half are persistent.
_PERSISTENT, _LIKELY, _SOLID = 0.1, 0.3, 0.5
_MIN_EDGE = 16  # [px] fewest persistent pixels of an object
_MIN_ACROSS = 0.1  # smallest mean cos² between an object's gradients and the rays from any possible vanishing point
_MIN_DISTANCE = 0.06  # smallest rms distance of such a point from the edges' tangents, as a fraction of the width
_MAX_COHERENCE = 0.5  # with a larger |median gradient| / mean |gradient| of the scene, the camera hardly moves
_CALMER = 0.6  # a region between persistent edges is fixed if it varies less than this fraction of its surroundings
_JOIN, _MARGIN = 4, 2  # [px] gaps between edges up to twice the first are closed; masks are widened by the second
_ISLAND_AREA, _ISLAND_VARIATION = 40, 15.0  # [px], [gray levels] least area of an island, largest variation inside
_AROUND_MEDIAN, _AROUND_MOST = 3.0, 2.5  # least variation around an island / median and 80 % quantile of that inside
_NIGHT = 15.0  # [gray levels] least brightness of an island, since black night hardly varies
_NOISE = 2.0  # [gray levels] added to the variation inside before the ratio is formed


@dataclass(frozen=True)
class StaticParts:
    """The parts of a film's picture that are fixed to the camera."""

    mask: Mask | None = None  # true = fixed to the camera, shape (h, w); None if there is nothing to mask
    note: str = ""  # a sentence for the user; empty if nothing was found


def static_parts(frames: list[Image]) -> StaticParts:
    """Finds the parts that are fixed to the camera in frames that spread over a film, RGB (h, w, 3), about 320 px wide.

    Nothing is found in fewer than 12 frames, in frames of several sizes, or if the camera hardly moves.
    """
    if len(frames) < MIN_FRAMES or len({frame.shape for frame in frames}) > 1:
        return StaticParts()
    frames = frames[:: -(-len(frames) // _MAX_FRAMES)]
    stack = np.asarray([cv2.GaussianBlur(frame, (0, 0), 1.0) for frame in frames], np.uint8)
    surely, likely = np.zeros((2, *stack.shape[1:3]), bool)
    direction = np.zeros((2, *surely.shape), np.float32)
    coherent, size = np.zeros((2, *surely.shape), np.float32)
    for channel in range(3):
        median, mean, levels = _gradients(stack[..., channel])
        length = np.hypot(*median)
        coherent, size = coherent + length, size + mean
        direction = np.where(levels[1] >= _MIN_GRADIENT, median / np.maximum(length, 1e-6), direction)
        surely |= levels[0] >= _MIN_GRADIENT
        likely |= levels[1] >= _MIN_GRADIENT
    low, high = np.quantile(stack, [0.1, 0.9], axis=0)
    variation = np.asarray((high - low).max(-1), np.float32)
    mask = _islands(variation, np.median(stack, axis=0).max(-1))
    mask |= _with_regions(_solid_edges(surely, likely, direction), variation)
    scene = ~_grown(mask, _JOIN)
    if not mask.any() or not scene.any() or coherent[scene].sum() > _MAX_COHERENCE * size[scene].sum():
        return StaticParts()  # nothing is fixed, or the camera hardly moves
    mask = _grown(mask, _MARGIN)
    share = float(mask.mean())
    if share > _MAX_SHARE:
        return StaticParts(
            note=f"{share:.0%} of the picture stays the same in all frames, too much for an automatic mask; "
            "if the robot fills so much of the picture, give a mask in scene.toml"
        )
    percent = f"{share:.0%}" if share >= 0.01 else "less than 1%"
    return StaticParts(mask, f"{percent} of the picture stays the same in all frames (dirt, or part of the robot)")


def _gradients(gray: Image) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Median gradient (2, h, w) of frames (n, h, w), mean length of gradients (h, w), and quantiles (2, h, w) of the
    component along the median gradient [gray levels per px]."""
    gx, gy = (np.stack([cv2.Sobel(one, cv2.CV_32F, *axis, scale=0.125) for one in gray]) for axis in ((1, 0), (0, 1)))
    median = np.stack([np.median(gx, 0), np.median(gy, 0)])
    unit = median / np.maximum(np.hypot(*median), 1e-6)
    levels = np.quantile(gx * unit[0] + gy * unit[1], [_PERSISTENT, _LIKELY], axis=0)
    return median, np.hypot(gx, gy).mean(0), np.asarray(levels, np.float32)


def _disk(radius: int) -> Any:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _grown(mask: Mask, radius: int) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _disk(radius)), bool)


def _closed(mask: Mask, radius: int) -> Mask:
    """The mask with gaps of up to twice the radius [px] closed, also to the picture's border."""
    padded = np.pad(mask, radius + 1, "edge").astype(np.uint8)
    inner = slice(radius + 1, -radius - 1)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disk(radius)), bool)[inner, inner]


def _components(mask: Mask) -> list[Mask]:
    """The connected components (4-neighbors) of at least `_MIN_EDGE` pixels, the largest first."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return [labels == 1 + label for label in np.argsort(-areas, kind="stable") if areas[label] >= _MIN_EDGE]


def _solid_edges(surely: Mask, likely: Mask, direction: NDArray[np.float32]) -> Mask:
    """The likely edges (h, w) of fixed objects; `direction` (2, h, w) has the unit vectors of the gradients."""
    kept = np.zeros(surely.shape, bool)
    for component in _components(_closed(likely, _JOIN)):
        edges = component & likely
        y, x = np.nonzero(edges & surely)
        solid = len(x) >= max(_MIN_EDGE, _SOLID * edges.sum())
        if solid and _crosses_motion(x, y, direction[:, y, x], kept.shape):
            kept |= edges & _grown(surely & component, 2)
    return kept


def _crosses_motion(x: NDArray[Any], y: NDArray[Any], direction: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """True if forward motion would move these edges, for every vanishing point in the middle of the picture.

    A lane's edges lie along the motion: their gradients are perpendicular to the rays from the vanishing point. Edges
    around this point hardly move; their tangents pass close to it.
    """
    px, py = np.meshgrid(np.linspace(0.25, 0.75, 17) * shape[1], np.linspace(0.25, 0.7, 15) * shape[0])
    dx, dy = x - px.reshape(-1, 1), y - py.reshape(-1, 1)
    distance2 = (dx * direction[0] + dy * direction[1]) ** 2
    across = (distance2 / np.maximum(dx**2 + dy**2, 1.0)).mean(1).min()
    return bool(across > _MIN_ACROSS and distance2.mean(1).min() > (_MIN_DISTANCE * shape[1]) ** 2)


def _with_regions(edges: Mask, variation: NDArray[np.float32]) -> Mask:
    """Edges (h, w) and the calm regions that they enclose, alone or with the left, right and lower border.

    `variation` (h, w) is the range of brightness over the frames [gray levels].
    """
    mask = _closed(edges, _JOIN)
    for radius in (_JOIN, 2 * _JOIN) if edges.any() else ():
        fence = _closed(edges, radius)
        scene, *regions = _components(~fence) or [fence]
        for region in regions:
            around = _grown(region | fence, 3 * _JOIN) & scene
            calm = around.any() and np.median(variation[region]) < _CALMER * np.median(variation[around])
            if calm and not region[0].any():
                mask |= _grown(region, 2 * _JOIN) & (region | fence)
    return mask


def _islands(variation: NDArray[np.float32], brightness: NDArray[Any]) -> Mask:
    """Mask (h, w) of the islands that do not touch a border; bright ones are left out: they are gaps with sky."""
    found = np.zeros(variation.shape, bool)
    calm = (variation < 0.5 * cv2.blur(variation, (61, 61))).astype(np.uint8)
    for island in _components(np.asarray(cv2.morphologyEx(calm, cv2.MORPH_OPEN, _disk(1)), bool)):
        border = island[[0, -1]].any() or island[:, [0, -1]].any()
        if border or island.sum() < _ISLAND_AREA:
            continue
        ring = _grown(island, 6) & ~_grown(island, 3)
        around = float(np.quantile(variation[ring], 0.1))
        inside, most = np.quantile(variation[island], [0.5, 0.8])
        level = float(np.median(brightness[island]))
        fixed = inside <= _ISLAND_VARIATION and around >= _AROUND_MEDIAN * (inside + _NOISE)
        if fixed and around >= _AROUND_MOST * (most + _NOISE) and _NIGHT < level < np.median(brightness[ring]):
            found |= _grown(island, _MARGIN)
    return found


# ---- the check

_SAMPLES = 60
_WIDTH = 320  # [px] width of the scaled-down frames that are checked
_MIN_SIDE = 640  # [px] smallest good length of the longer side
_DARK = 35.0  # [gray levels] smallest good median brightness
# A pixel is clipped from this gray level on. The second number is the largest good share of clipped pixels.
_CLIPPED, _CLIPPED_SHARE = 250, 0.15
# A frame is blurred if its sharpness is below this fraction of the 90 % quantile of all samples. The second number is
# the largest good share of blurred frames.
_BLURRED, _BLURRED_SHARE = 0.35, 0.3
_EXPOSURE_RANGE = 2.0  # largest good ratio of the 95 % to the 5 % quantile of brightness
_TINT_RANGE = 1.3  # largest good ratio of the 95 % to the 5 % quantile of the color ratio red / blue
_GAP = 0.5  # [s] shorter times without a picture are not reported
_UNEVEN = 1.5  # largest good ratio of the 95 % quantile to the median of the time between frames
_MIN_TRUSTED = 8  # fewest samples from which shares and quantiles are computed


@dataclass(frozen=True)
class FilmCheck:
    """The result of a check."""

    notes: list[str]  # one sentence per defect of the film, each with its cure; empty without defects
    static_note: str = ""  # a sentence about parts of the picture that are fixed to the camera; empty if none are found
    mask: Image | None = None  # 0 = fixed to the camera, 255 elsewhere, shape (h, w), at the film's upright size


def check_film(path: Path) -> FilmCheck:
    """Checks a film. Raises InputError: see `probe`."""
    timing = probe(path)
    notes = timing_notes(timing)
    first, small = _samples(path, "NONKEY")
    if len(small) < MIN_FRAMES:
        first, small = _samples(path, "DEFAULT")
    if first is None:
        return FilmCheck([*notes, "no frame can be decoded; copy the film again from the camera"])
    with open_film(path) as (_, stream):
        side = stream.sample_aspect_ratio or 1
    if side != 1:
        notes.append(
            f"pixels are {float(side):.3g} times as wide as high, but the build takes them for square; convert the "
            "film (ffmpeg -vf scale=iw*sar:ih,setsar=1), or give a calibration with fx and fy"
        )
    if transfer := hdr_transfer(first):
        notes.append(f"HDR ({HDR_NAMES[transfer]}): converted to SDR by a fixed curve; turn HDR off for the next film")
    if first.interlaced_frame:
        notes.append(
            "interlaced: the build deinterlaces the film, at a loss of detail; film in a progressive mode (p, not i)"
        )
    if max(first.width, first.height) < _MIN_SIDE:
        notes.append(f"{first.width}x{first.height}: small pictures give a blurred twin; film in 1920x1080")
    static = static_parts(small)
    mask = None
    if static.mask is not None:
        used = np.where(static.mask, 0, 255).astype(np.uint8)
        size = upright(first).shape[1::-1]
        mask = np.asarray(cv2.resize(used, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return FilmCheck(notes + _picture_notes(small), static.note, mask)


def timing_notes(timing: FilmTiming) -> list[str]:
    """Sentences on gaps and on a varying frame rate."""
    steps = np.diff(timing.times)
    if len(steps) < _MIN_TRUSTED:
        return []
    notes = []
    longest = int(steps.argmax())
    if steps[longest] > max(_GAP, 3.0 * timing.interval):
        at = f"{timing.times[longest]:.1f} s"
        notes.append(
            f"no picture for {steps[longest]:.1f} s from {at} on; film in one go, or cut the film at the gap into two"
        )
    if float(np.quantile(steps, 0.95)) > _UNEVEN * timing.interval:
        notes.append("varying frame rate: frames are taken by their time stamps; better set a fixed rate in the camera")
    return notes


def _samples(path: Path, skip: Literal["NONKEY", "DEFAULT"]) -> tuple[av.VideoFrame | None, list[Image]]:
    """The first frame, and fewer than 2 · `_SAMPLES` upright pictures of frames spread over the film.

    With `skip` = NONKEY only key frames are decoded. The pictures are scaled to `_WIDTH`, since 120 frames of 4K take
    3 GB.
    """
    first: av.VideoFrame | None = None
    small: list[Image] = []
    every = 1
    with open_film(path) as (container, stream):
        stream.codec_context.skip_frame = skip
        stream.thread_type = "AUTO"
        with contextlib.suppress(av.error.FFmpegError):  # the frames before the damage suffice for the check
            for number, frame in enumerate(container.decode(stream)):
                first = first or frame
                if number % every == 0:
                    image = upright(frame)
                    small.append(resize(image, *fitted_size(image.shape[1], image.shape[0], _WIDTH)))
                if len(small) == 2 * _SAMPLES:
                    small, every = small[::2], 2 * every
    return first, small


def _picture_notes(small: list[Image]) -> list[str]:
    gray = [np.asarray(cv2.cvtColor(one, cv2.COLOR_RGB2GRAY), np.uint8) for one in small]
    brightness = np.array([float(one.mean()) for one in gray])
    notes = []
    if float(np.median([np.median(one) for one in gray])) < _DARK:
        notes.append("dark: half of the picture is nearly black; lock a longer exposure, and walk slower against blur")
    if float(np.median([(one >= _CLIPPED).mean() for one in gray])) > _CLIPPED_SHARE:
        notes.append(
            "overexposed: much of the picture is white; lock a shorter exposure, measured on the road, not the sky"
        )
    if len(small) < _MIN_TRUSTED:
        return notes
    detail = np.array([sharpness(one) for one in gray])
    soft = float((detail < _BLURRED * np.quantile(detail, 0.9)).mean())
    if soft > _BLURRED_SHARE:
        notes.append(
            f"{soft:.0%} of the frames are far softer than the sharpest; walk slower, wipe the lens, lock the focus, "
            "or film in more light"
        )
    if (ratio := _range(brightness)) > _EXPOSURE_RANGE:
        notes.append(
            f"brightness varies {ratio:.1f}-fold along the film; unless lamps or shade cause it, lock the exposure"
        )
    tint = np.array([float(one[..., 0].mean() + 1.0) / float(one[..., 2].mean() + 1.0) for one in small])
    if (ratio := _range(tint)) > _TINT_RANGE:
        notes.append(
            f"the ratio red / blue varies {ratio:.1f}-fold along the film; unless due to lamps, lock the white balance"
        )
    return notes


def _range(values: Array) -> float:
    low, high = np.quantile(values, [0.05, 0.95])
    return float((high + 1e-6) / (low + 1e-6))
