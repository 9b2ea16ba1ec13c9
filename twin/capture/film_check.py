"""Checks a film before the build: finds defects that reduce the twin's quality and parts that are fixed to the camera.

Key frames spread over the film are decoded; if these are too few, other frames are decoded, too. The timing comes from
all packets. Stabilization and rolling shutter leave no trace in the file; the build finds them.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import av
import av.error
import cv2
import numpy as np

from twin.capture.hdr import NAMES, hdr_transfer
from twin.capture.static_mask import MIN_FRAMES, static_parts
from twin.capture.video import FilmTiming, fitted_size, open_film, probe, sharpness, upright
from twin.geometry.images import resize
from twin.types import Array, Image

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
        notes.append(f"HDR ({NAMES[transfer]}): converted to SDR by a fixed curve; turn HDR off for the next film")
    if first.interlaced_frame:
        notes.append(
            "interlaced: the build deinterlaces the film, at a loss of detail; film in a progressive mode (p, not i)"
        )
    if max(first.width, first.height) < _MIN_SIDE:
        notes.append(f"{first.width}x{first.height}: small pictures make a soft twin; film in 1920x1080")
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
    """The first frame, and upright pictures of frames spread over the film, fewer than twice `_SAMPLES`.

    With `skip` = NONKEY only key frames are decoded. The pictures are `_WIDTH` wide: 120 frames of 4K take 2 GB.
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
