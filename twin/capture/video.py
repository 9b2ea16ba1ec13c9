"""Video files: decoded once, front to back, never held in memory as a whole.

A *slot* is one of n equal spans of a film's duration; of each slot the sharpest frame is a *candidate*. A candidate
that hardly moved from the last kept frame is a *duplicate* of a standing camera and is dropped. A frame's *index* is
its place in the film, counted from 0 in order of presentation; its *time* runs from the first frame [s].
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import av
import av.error
import cv2
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from twin.capture.motion import FLOW_WIDTH, SHARPNESS_WIDTH, sharpness, stands_still
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.geometry.images import resize

_BLANK = 2.0  # [grey levels], a frame whose brightness varies less than this shows nothing
_DAMAGED = 0.98  # share of the frames a container promises, below which the user is told

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class FilmFacts:
    """What a file's packets say before anything is decoded."""

    times: NDArray[np.float64]
    """Presentation times from the first frame on [s], sorted, shape (n,)."""
    promised: int
    """Frames the container says it has; n where it does not say."""

    @property
    def interval(self) -> float:
        """Median time between frames [s]."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0

    @property
    def duration(self) -> float:
        """From the first frame to the end of the last [s]."""
        return float(self.times[-1] + self.interval)


@dataclass
class FilmCount:
    """What became of a film's frames; filled while it is read."""

    decoded: int = 0
    damaged: int = 0
    duplicates: int = 0
    blank: int = 0
    promised: int = 0
    duration: float = 0.0
    size: tuple[int, int] = (0, 0)
    """Upright width and height as filmed [px]."""
    sharpness: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class FilmFrame:
    """A chosen frame, upright, at the kept size."""

    index: int
    time: float
    image: Image
    """RGB, shape (h, w, 3)."""


def probe(path: Path) -> FilmFacts:
    """Reads a film's packets without decoding them.

    Raises:
        InputError: not a video, or so damaged that it has no readable packet.
    """
    try:
        with av.open(str(path)) as container:
            stream = _video_stream(container, path)
            times: list[float] = []
            try:
                times.extend(
                    float((p.pts if p.pts is not None else p.dts) * p.time_base)
                    for p in container.demux(stream)
                    if (p.pts if p.pts is not None else p.dts) is not None and not p.is_discard
                )
            except av.error.FFmpegError:
                pass  # cut off in the middle: what was read so far is used
            promised = stream.frames
            rate = float(stream.average_rate or 25)
    except (av.error.FFmpegError, ValueError, OSError) as error:
        raise _unreadable(path, error) from None
    if not times:
        raise InputError(f"{path}: the film has no readable frame; copy it again from the camera or re-encode it")
    at = np.sort(np.array(times))
    if len(at) > 1 and at[-1] == at[0]:  # a raw stream without a clock
        at = np.arange(len(at)) / rate
    return FilmFacts(at - at[0], promised or len(at))


def decode(path: Path, count: FilmCount) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Decodes a film: each frame's time in the stream [s] (None where it has none) and the frame. Skips damaged ones."""
    with av.open(str(path)) as container:
        stream = _video_stream(container, path)
        stream.thread_type = "AUTO"
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                packet = None  # the file ends in the middle of a packet
            if packet is None:
                return
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                count.damaged += 1
                continue
            for frame in frames:
                if frame.is_corrupt:
                    count.damaged += 1
                else:
                    yield frame.time, frame  # type: ignore[misc]


def slot_of(index: int, time: float, facts: FilmFacts, slots: int) -> int:
    """The slot a frame falls in.

    With as many slots as frames, each frame has its own. Otherwise slots are equal in time, and half a frame interval
    is added so that rounded time stamps never push a frame over a slot's edge.
    """
    if slots >= len(facts.times):
        return index
    return min(int((time + 0.5 * facts.interval) / facts.duration * slots), slots - 1)


def slot_count(facts: FilmFacts, config: CaptureConfig) -> int:
    """How many slots a film is cut into."""
    wanted = config.frames or max(2, round(facts.duration * config.fps))
    return min(wanted, config.max_frames, len(facts.times))


def read_film(
    path: Path, config: CaptureConfig, count: FilmCount, mask_of: Callable[[int, Image], Image | None]
) -> Iterator[FilmFrame]:
    """Yields a film's chosen frames in order: the sharpest of each slot, less the duplicates of a standing camera.

    Args:
        path: The film.
        config: Slots, size and smallest motion.
        count: Filled with what became of the frames.
        mask_of: From a frame's index and kept image to its mask (0 = ignore), or None.

    Raises:
        InputError: nothing readable, fewer than two frames, or nothing but blank frames.
    """
    facts = probe(path)
    slots = slot_count(facts, config)
    count.promised, count.duration = max(facts.promised, len(facts.times)), facts.duration
    kept_small: Image | None = None
    kept_any = False

    def keep(candidate: "_Candidate") -> FilmFrame | None:
        nonlocal kept_small, kept_any
        whole = upright(candidate.frame)
        count.size = (whole.shape[1], whole.shape[0])
        image = fit(whole, config.max_size)
        small = _grey_at(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), FLOW_WIDTH)  # type: ignore[arg-type]
        mask = mask_of(candidate.index, image)
        small_mask = None if mask is None else cv2.resize(mask, small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        if kept_small is not None and stands_still(kept_small, small, config.min_motion, small_mask):  # type: ignore[arg-type]
            count.duplicates += 1
            return None
        kept_small, kept_any = small, True
        count.sharpness.append(candidate.sharpness)
        return FilmFrame(candidate.index, candidate.time, image)

    best: _Candidate | None = None
    start: float | None = None
    size: tuple[int, int] | None = None
    for stamp, frame in decode(path, count):
        index = count.decoded
        count.decoded += 1
        if stamp is not None and start is None:
            start = stamp
        time = stamp - start if stamp is not None and start is not None else index * facts.interval
        if size is not None and size != (frame.width, frame.height):
            raise InputError(
                f"{path}: the picture changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} at frame {index}; "
                "cut the film there into two sources"
            )
        size = (frame.width, frame.height)
        grey = _small_grey(frame)
        if float(grey[::2, ::2].std()) < _BLANK:
            count.blank += 1
            continue
        candidate = _Candidate(slot_of(index, time, facts, slots), index, time, sharpness(grey), frame)
        if best is not None and candidate.slot != best.slot:
            if (kept := keep(best)) is not None:
                yield kept
            best = candidate
        elif best is None or candidate.sharpness > best.sharpness:
            best = candidate
    if best is not None and (kept := keep(best)) is not None:
        yield kept
    _refuse_poor(path, count, kept_any)


def damage_note(path: Path, count: FilmCount) -> str | None:
    """A line for the user where a film is cut off or damaged in part, else None."""
    if count.decoded >= _DAMAGED * count.promised and not count.damaged:
        return None
    return (
        f"{path.name}: damaged; {count.decoded} of {count.promised} frames could be decoded and only those are used. "
        "Copy it again from the camera if more was filmed"
    )


def fit(image: Image, max_size: int) -> Image:
    """Scales an image down so that its longer side is at most `max_size` [px]."""
    height, width = image.shape[:2]
    new = fitted_size(width, height, max_size)
    return image if new == (width, height) else resize(image, *new)


def fitted_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Width and height [px] scaled down to a longer side of at most `max_size`."""
    scale = min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def upright(frame: av.VideoFrame) -> Image:
    """A frame as RGB, turned and mirrored as its display matrix says, to a multiple of 90°."""
    image = frame.to_ndarray(format="rgb24")
    matrix = display_matrix(frame)
    return image if matrix is None else oriented(image, matrix)


def display_matrix(frame: av.VideoFrame) -> NDArray[np.float64] | None:
    """The 2×2 part of a frame's display matrix (pixel row vector × matrix = shown position), or None."""
    side = frame.side_data.get(SideData.DISPLAYMATRIX)
    if side is None:
        return None
    matrix = np.frombuffer(bytes(side), np.int32, 9).reshape(3, 3)[:2, :2] / 65536.0
    return matrix if np.abs(np.linalg.det(matrix)) > 1e-3 else None


def oriented(image: Image, matrix: NDArray[np.float64]) -> Image:
    """An image moved by a display matrix: x' = a x + c y, y' = b x + d y with matrix [[a, b], [c, d]]."""
    (a, b), (c, d) = matrix
    if abs(a) < abs(c):  # x' comes from y: a quarter turn
        image, sign_x, sign_y = image.swapaxes(0, 1), c, b
    else:
        sign_x, sign_y = a, d
    image = image[:, ::-1] if sign_x < 0 else image
    image = image[::-1] if sign_y < 0 else image
    return np.ascontiguousarray(image)


@dataclass(frozen=True)
class _Candidate:
    slot: int
    index: int
    time: float
    sharpness: float
    frame: av.VideoFrame


def _small_grey(frame: av.VideoFrame) -> Image:
    width = min(SHARPNESS_WIDTH, frame.width)
    height = max(1, round(frame.height * width / frame.width))
    return frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray()


def _grey_at(grey: Image, width: int) -> Image:
    return resize(grey, width, max(1, round(grey.shape[0] * width / grey.shape[1])))  # type: ignore[return-value]


def _video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    if not container.streams.video:
        raise InputError(f"{path}: no picture in this file; give a film, an image folder or a posed image set")
    return container.streams.video[0]


def _unreadable(path: Path, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    size = path.stat().st_size if path.exists() else 0
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(
        f"{path}: not a readable film ({size} bytes: {reason}); copy it again from the camera or re-encode it"
    )


def _refuse_poor(path: Path, count: FilmCount, kept_any: bool) -> None:
    if count.decoded < 2:
        raise InputError(
            f"{path}: {count.decoded} of {count.promised} frames could be decoded (need 2); "
            "copy it again from the camera or re-encode it"
        )
    if not kept_any:
        raise InputError(f"{path}: all {count.blank} frames are blank (one colour); film with light and without a cap")

