"""Video files: decoded once, front to back, never held in memory as a whole.

A *slot* is one of n equal spans of a film's duration; of each slot the sharpest frame is a *candidate*. A candidate
that hardly moved from the last kept frame is a *duplicate* of a standing camera and is dropped. A frame's *index* is
its place in the film, counted from 0 in order of presentation; its *time* runs from the first frame [s]. Where only
*parts* of a film are used, slots divide these, as if the rest were cut out; indices and times stay those of the film.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import av
import av.error
import cv2
import numpy as np
from av.sidedata.sidedata import Type as SideData
from av.video.frame import PictureType
from numpy.typing import NDArray

from twin.config import CaptureConfig
from twin.errors import InputError
from twin.files import regular
from twin.geometry.images import resize
from twin.types import Image

# ---- How sharp a frame is, and how far the picture moved between two frames.
#
# Everything here works on small grey pictures (uint8, shape (h, w)), so that judging a frame costs about a millisecond.
# A *flow* is the displacement of a picture's corners from one frame to the next [px]. A *mask* has 0 where the picture
# is to be ignored.


FLOW_WIDTH = 320
"""Width at which motion is measured [px]."""

SHARPNESS_WIDTH = 640
"""Width at which sharpness is measured [px]; at full size the noise of the sensor would count as detail."""

_CORNERS = 200
_MIN_TRACKED = 12  # fewer corners than this say nothing about the whole picture
_MAX_RETURN_ERROR = 0.5  # [px], a corner tracked there and back must come home
_STILL_DIFFERENCE = 1.5  # [grey levels of a picture stretched to 255], below it two texture-free frames are the same


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of the picture; comparable only between frames of one view.

    Pech-Pacheco et al. 2000 ("LAPV"). Dividing by the contrast keeps a brightening exposure from passing for focus.
    """
    laplacian = cv2.Laplacian(grey, cv2.CV_32F)
    return float(laplacian.var() / (grey.astype(np.float32).var() + 1.0))


def median_motion(
    before: NDArray[np.uint8], after: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
) -> float | None:
    """Median length of the flow between two grey frames of equal size [px]; None where too few corners are found.

    Pyramidal Lucas-Kanade on Shi-Tomasi corners; only corners that come home when tracked back are counted.
    """
    before, after = _stretched(before), _stretched(after)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 5, mask=mask)
    if corners is None or len(corners) < _MIN_TRACKED:
        return None
    there, found_there, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None)  # type: ignore[call-overload]
    home = np.linalg.norm(back - corners, axis=-1) < _MAX_RETURN_ERROR
    good = (home & (found_there == 1) & (found_back == 1))[:, 0]
    if good.sum() < _MIN_TRACKED:
        return None
    return float(np.median(np.linalg.norm(there - corners, axis=-1)[good]))


def stands_still(
    before: NDArray[np.uint8], after: NDArray[np.uint8], min_motion: float, mask: NDArray[np.uint8] | None = None
) -> bool:
    """True where the picture moved less than `min_motion` [px]; without corners, where it did not change at all.

    A `min_motion` of 0 keeps every frame.
    """
    if min_motion <= 0.0:
        return False
    moved = median_motion(before, after, mask)
    if moved is not None:
        return moved < min_motion
    difference = cv2.absdiff(_stretched(before), _stretched(after))
    seen = difference if mask is None else difference[mask > 0]
    return float(seen.mean()) < _STILL_DIFFERENCE if seen.size else True


def _stretched(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Contrast stretched to the whole range, so that a night frame has corners too."""
    low, high = np.percentile(grey[::2, ::2], (1.0, 99.0))
    gain = 255.0 / max(high - low, 16.0)  # a blank frame's noise is not blown up without bound
    return np.clip((grey.astype(np.float32) - low) * gain, 0, 255).astype(np.uint8)


_BLANK = 2.0  # [grey levels], a frame whose brightness varies less than this shows nothing
_LUMA_FIRST = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray")
_DAMAGED = 0.98  # share of the frames a container promises, below which the user is told


@dataclass(frozen=True)
class FilmFacts:
    """What a file's packets say before anything is decoded."""

    times: NDArray[np.float64]
    """Presentation times from the first frame on [s], sorted, shape (n,)."""
    start: float
    """Time stamp of the first frame in its stream [s]."""
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
    mask: Image | None
    """0 = ignore, shape (h, w); None where nothing is masked."""


def probe(path: Path) -> FilmFacts:
    """Reads a film's packets without decoding them.

    Raises:
        InputError: not a video, or so damaged that it has no readable packet.
    """
    times: list[float] = []
    regular(path)
    try:
        with av.open(str(path)) as container:
            stream = _video_stream(container, path)
            with contextlib.suppress(av.error.FFmpegError):  # cut off in the middle: what was read so far is used
                for packet in container.demux(stream):
                    stamp = packet.pts if packet.pts is not None else packet.dts
                    if stamp is not None and not packet.is_discard:
                        times.append(float(stamp * packet.time_base))
            promised = stream.frames
            rate = float(stream.average_rate or 25)
    except (av.error.FFmpegError, ValueError, OSError) as error:
        raise _unreadable(path, error) from None
    if not times:
        raise InputError(f"{path}: the film has no readable frame; copy it again from the camera or re-encode it")
    at = np.sort(np.array(times))
    if len(at) > 1 and at[-1] == at[0]:  # a raw stream without a clock
        at = np.arange(len(at)) / rate
    return FilmFacts(at - at[0], float(at[0]), promised or len(at))


def decode(path: Path, count: FilmCount) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Decodes a film front to back, skipping what is damaged.

    A decoder repairs a damaged frame by guessing and predicts the next frames from the guess, so nothing is taken from
    the damage on to the next key frame, nor the B frames shown before it that lean on it.

    Yields:
        Each frame's time stamp in its stream [s] (None where it has none), and the frame.
    """
    with av.open(str(path)) as container:
        stream = _video_stream(container, path)
        stream.thread_type = "AUTO"
        leaning: list[av.VideoFrame] = []  # B frames that wait for the frame after them to turn out sound
        broken = False
        for packet in _packets(container, stream):
            frames: list[av.VideoFrame | None] = []
            try:
                frames.extend(packet.decode())
            except av.error.FFmpegError:
                frames.append(None)
            for frame in frames:
                if frame is None or frame.is_corrupt or (broken and not frame.key_frame):
                    count.damaged += 1 + len(leaning)
                    leaning.clear()
                    broken = True
                    continue
                broken = False
                leaning.append(frame)
                if frame.pict_type != PictureType.B:
                    yield from ((sound.time, sound) for sound in leaning)
                    leaning.clear()
        yield from ((sound.time, sound) for sound in leaning)


def _packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet]:
    """A stream's packets, and an empty one at the end, upon which a decoder hands out what it held back.

    A file that ends in the middle of a packet ends the stream like any other.
    """
    last: av.Packet | None = None
    with contextlib.suppress(av.error.FFmpegError):
        for last in container.demux(stream):
            yield last
    if last is None or last.size:
        end = av.Packet()
        end.stream = stream
        if stream.time_base is not None:
            end.time_base = stream.time_base
        yield end


def index_of(time: float | None, facts: FilmFacts, last: int) -> int:
    """A decoded frame's index, by its time [s] among the film's, above `last` always; damaged frames leave gaps."""
    if time is None:
        return last + 1
    right = min(int(np.searchsorted(facts.times, time)), len(facts.times) - 1)
    left = max(right - 1, 0)
    nearest = left if time - facts.times[left] < facts.times[right] - time else right
    return max(nearest, last + 1)


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


def within(times: NDArray[np.float64], parts: tuple[tuple[float, ...], ...]) -> NDArray[np.bool_]:
    """Which times (n,) [s] lie in one of some parts, [from, to] each; all of them where there are no parts."""
    if not parts:
        return np.ones(len(times), bool)
    # Half a millisecond, to which Matroska rounds its clock.
    return np.any([(times >= start - 5e-4) & (times <= end + 5e-4) for start, end in parts], axis=0)


def _cut(facts: FilmFacts, parts: tuple[tuple[float, ...], ...], path: Path) -> tuple[FilmFacts, NDArray[np.int64]]:
    """A film's facts as if only some parts were there, and by frame of the film its place among those, −1 if cut out.

    Raises:
        InputError: fewer than two frames are in these parts.
    """
    used = within(facts.times, parts)
    if parts and used.sum() < 2:
        raise InputError(
            f"{path}: keep = {[list(part) for part in parts]} leaves {used.sum()} of {len(used)} frames (need 2); the "
            f"film runs from 0 to {facts.times[-1]:.2f} s"
        )
    place = np.where(used, np.cumsum(used) - 1, -1)
    if used.all():
        return facts, place
    # The clock stops where a part ends: its last frame lasts one interval more.
    step = np.where(np.diff(np.flatnonzero(used)) > 1, facts.interval, np.diff(facts.times[used]))
    return FilmFacts(np.concatenate([[0.0], np.cumsum(step)]), facts.start, int(used.sum())), place


def read_film(
    path: Path,
    config: CaptureConfig,
    count: FilmCount,
    mask_of: Callable[[int, int, int], Image | None],
    parts: tuple[tuple[float, ...], ...] = (),
) -> Iterator[FilmFrame]:
    """Yields a film's chosen frames in order: the sharpest of each slot, less the duplicates of a standing camera.

    Args:
        path: The film.
        config: Slots, size and smallest motion.
        count: Filled with what became of the frames.
        mask_of: From a frame's index, kept width and kept height to its mask (0 = ignore), or None.
        parts: Of the film that are used, [from, to] each [s]; empty = all of it.

    Raises:
        InputError: nothing readable, fewer than two frames, or nothing but blank frames.
    """
    facts = probe(path)
    shown, place = _cut(facts, parts, path)
    last = int(np.flatnonzero(place >= 0)[-1])
    slots = slot_count(shown, config)
    count.promised = max(facts.promised, len(facts.times)) if not parts else len(shown.times)
    count.duration = shown.duration
    kept_small: Image | None = None
    kept_any = False

    def keep(candidate: "_Candidate") -> FilmFrame | None:
        nonlocal kept_small, kept_any
        whole = upright(candidate.frame)
        count.size = (whole.shape[1], whole.shape[0])
        image = fit(whole, config.max_size)
        small = _flow_picture(image)
        mask = mask_of(candidate.index, image.shape[1], image.shape[0])
        small_mask = None
        if mask is not None:
            small_mask = np.asarray(cv2.resize(mask, small.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
        if kept_small is not None and stands_still(kept_small, small, config.min_motion, small_mask):
            count.duplicates += 1
            return None
        kept_small, kept_any = small, True
        count.sharpness.append(candidate.sharpness)
        return FilmFrame(candidate.index, candidate.time, image, mask)

    best: _Candidate | None = None
    index = -1
    size: tuple[int, int] | None = None
    for stamp, frame in decode(path, count):
        index = index_of(None if stamp is None else stamp - facts.start, facts, index)
        if parts and index > last:
            break
        if parts and place[index] < 0:
            continue
        count.decoded += 1
        time = float(facts.times[index]) if index < len(facts.times) else index * facts.interval
        if size is not None and size != (frame.width, frame.height):
            raise InputError(
                f"{path}: the picture changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} "
                f"at frame {index}; cut the film there into two sources"
            )
        size = (frame.width, frame.height)
        grey = _sharpness_picture(frame)
        if float(grey[::2, ::2].std()) < _BLANK:
            count.blank += 1
            continue
        order, at = (int(place[index]), float(shown.times[place[index]])) if parts else (index, time)
        candidate = _Candidate(slot_of(order, at, shown, slots), index, time, sharpness(grey), frame)
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
    return image if new == (width, height) else np.asarray(resize(image, *new), np.uint8)


def fitted_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Width and height [px] scaled down to a longer side of at most `max_size`."""
    scale = min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def upright(frame: av.VideoFrame) -> Image:
    """A frame as RGB, turned and mirrored as its display matrix says, to a multiple of 90°."""
    image = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    matrix = display_matrix(frame)
    return image if matrix is None else oriented(image, matrix)


def display_matrix(frame: av.VideoFrame) -> NDArray[np.float64] | None:
    """The 2×2 part of a frame's display matrix (pixel row vector × matrix = shown position), or None."""
    side = frame.side_data.get(SideData.DISPLAYMATRIX)  # type: ignore[call-overload]
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


def _sharpness_picture(frame: av.VideoFrame) -> Image:
    width = min(SHARPNESS_WIDTH, frame.width)
    height = max(1, round(frame.height * width / frame.width))
    if frame.format.name in _LUMA_FIRST:  # the brightness is there already: no conversion
        plane = frame.planes[0]
        luma = np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
        return np.asarray(resize(luma, width, height), np.uint8)
    return np.asarray(frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray(), np.uint8)


def _flow_picture(image: Image) -> Image:
    height, width = image.shape[:2]
    small = np.asarray(resize(image, FLOW_WIDTH, max(1, round(height * FLOW_WIDTH / width))), np.uint8)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)


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
