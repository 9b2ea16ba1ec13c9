"""Reads films in one pass with little memory: decodes them, and selects the sharpest frames at regular spacing.

A *film* is a video file, or the pictures of a bag (`bag_film.py`). Damaged frames are skipped, interlaced ones are
deinterlaced, HDR is converted to SDR (`hdr.py`), and frames are turned upright. A *slot* is one of n equal time spans
of a film; the sharpest frame of each slot is its *candidate*. A candidate in which the image hardly moved since the
last kept frame is a *duplicate* and is dropped. A frame's *index* is its position in the film, counted from 0 in order
of presentation; its *time* [s] is measured from the first frame. If only *segments* of the film are kept, the slots
divide these segments as if the rest were cut out; indices and times remain those of the whole film.
"""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, partial
from pathlib import Path

import av
import av.error
import av.filter
import cv2
import numpy as np
from av.sidedata.sidedata import SideDataContainer
from av.sidedata.sidedata import Type as SideData
from av.video.frame import PictureType
from av.video.reformatter import Colorspace
from numpy.typing import NDArray

from twin import runtime
from twin.capture.hdr import HDR_NAMES, hdr_to_sdr
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.files import regular_file
from twin.geometry.images import resize
from twin.types import Array, Image

FLOW_WIDTH = 320  # [px] image width at which motion is measured
SHARPNESS_WIDTH = 640  # [px] image width at which sharpness is measured; at full size sensor noise counts as detail
_CORNERS = 200
_MIN_TRACKED = 12  # corners needed to judge the motion of the whole image
_MAX_RETURN_ERROR = 0.5  # [px] largest forward-backward tracking error
# [gray levels after contrast stretching] Two frames without texture count as equal if they differ by less.
_STILL_DIFFERENCE = 1.5
BLANK_STD = 2.0  # an image with a smaller standard deviation of its brightness [gray levels] counts as blank
_LUMA_FIRST = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray")
_MIN_DECODED_FRACTION = 0.98  # the user gets a note if a smaller fraction of the declared frames can be decoded


# ---- decoding

_MAX_REORDERED = 16  # frames by which H.264 and H.265 may reorder
_UNKNOWN = 2  # FFmpeg's AVCOL_SPC_UNSPECIFIED
_SD = 1280, 576  # [px] frames of unknown color matrix are BT.709 from this width on, or if they are higher than this
_DEINTERLACE = "mode=send_frame:parity=auto:deint=interlaced"


@dataclass
class FilmStatistics:
    """Counts of decoded and dropped frames, and properties of the film; filled while it is read."""

    decoded: int = 0
    damaged: int = 0
    duplicates: int = 0
    blank: int = 0
    interlaced: bool = False
    hdr: str = ""  # HLG or PQ; empty for SDR
    declared: int = 0
    duration: float = 0.0
    size: tuple[int, int] = (0, 0)  # upright width and height of the input [px]
    sharpness: list[float] = field(default_factory=list)


def decode(path: Path, count: FilmStatistics) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Yields a tuple per undamaged frame of a film, in order: its time stamp in the stream [s] or None, and the frame.

    Interlaced frames are deinterlaced, because their two fields show the scene at different instants.
    """
    graph: av.filter.Graph | None = None
    for stamp, frame in _intact_frames(path, count):
        if graph is None and not frame.interlaced_frame:
            yield stamp, frame
            continue
        try:
            if graph is None:
                count.interlaced = True
                graph = _deinterlacer(frame)
            graph.push(frame)
        except (av.error.FFmpegError, ValueError) as error:
            raise InputError(f"{path}: cannot be deinterlaced ({error}); convert it to progressive frames") from None
        yield from _pulled(graph)
    if graph is not None:
        graph.push(None)
        yield from _pulled(graph)


def _deinterlacer(frame: av.VideoFrame) -> av.filter.Graph:
    """A filter that makes a progressive frame of each interlaced frame, and passes progressive frames unchanged."""
    graph = av.filter.Graph()
    base = frame.time_base or Fraction(1, 1000)
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=base)
    graph.link_nodes(source, graph.add("bwdif", _DEINTERLACE), graph.add("buffersink")).configure()
    return graph


def _pulled(graph: av.filter.Graph) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Yields the frames that a filter has ready, each with its time [s] or None."""
    with contextlib.suppress(av.error.BlockingIOError, av.error.EOFError):
        while True:
            frame = graph.pull()
            assert isinstance(frame, av.VideoFrame)
            yield frame.time, frame


def _intact_frames(path: Path, count: FilmStatistics) -> Iterator[tuple[float | None, av.VideoFrame]]:
    """Frames that are not damaged, and do not depend on damaged ones.

    A decoder conceals a damaged frame by a guess and predicts later frames from it. Therefore all frames from a
    damaged one to the next key frame are skipped, and so are the B frames before it that depend on it.
    """
    with open_film(path) as (container, stream):
        stream.thread_type = "AUTO"
        # B frames that wait for the undamaged frame on which they depend. Some encoders use B frames alone.
        pending: deque[av.VideoFrame] = deque()
        broken = False
        for packet in _packets(container, stream):
            frames: list[av.VideoFrame | None] = []
            try:
                frames.extend(packet.decode())
            except av.error.FFmpegError:
                frames.append(None)
            for frame in frames:
                if frame is None or frame.is_corrupt or (broken and not frame.key_frame):
                    count.damaged += 1 + len(pending)
                    pending.clear()
                    broken = True
                    continue
                broken = False
                pending.append(frame)
                while pending and (frame.pict_type != PictureType.B or len(pending) > _MAX_REORDERED):
                    intact = pending.popleft()
                    yield intact.time, intact
        yield from ((intact.time, intact) for intact in pending)


def _packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet]:
    """A stream's packets and a final empty packet, which flushes the decoder; a truncated file just ends earlier."""
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


@contextlib.contextmanager
def open_film(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """Opens a film file and its first video stream. Raises InputError: no such stream, or none that can be decoded."""
    # Without the prefix, FFmpeg takes the beginning of a name such as `17:30.mp4` for a protocol.
    with av.open(f"file:{path}") as container:
        if not container.streams.video:
            raise InputError(f"{path}: no video stream in this file; give a film, an image folder or a posed image set")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{path}: FFmpeg does not know this film's codec; convert it to H.264 or H.265")
        yield container, stream


def first_size(path: Path) -> tuple[int, int] | None:
    """Width and height [px] of a film's first frame, upright; None if none can be decoded."""
    with contextlib.suppress(av.error.FFmpegError, ValueError), open_film(path) as (container, stream):
        for frame in container.decode(stream):
            height, width = upright(frame).shape[:2]
            return width, height
    return None


def fitted_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Width and height [px] scaled down to a longer side of at most `max_size`."""
    scale = min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def upright(frame: av.VideoFrame) -> Image:
    """A frame as SDR RGB, rotated and mirrored by its display matrix in multiples of 90°.

    If the color matrix is unknown it is that which players use: BT.709 if the frame is larger than `_SD`, else BT.601.
    """
    transfer = hdr_transfer(frame)
    if transfer:
        image = hdr_to_sdr(frame, transfer)
    else:
        large = frame.width >= _SD[0] or frame.height > _SD[1]
        matrix = Colorspace.ITU709 if frame.colorspace == _UNKNOWN and large else None
        image = np.asarray(frame.to_ndarray(format="rgb24", src_colorspace=matrix), np.uint8)
    # `frame.side_data` would make a reference cycle, so many large frames would stay until garbage is collected.
    side = SideDataContainer(frame).get(SideData.DISPLAYMATRIX)  # type: ignore[call-arg]
    if side is None:
        return image
    turn = np.frombuffer(bytes(side), np.int32, 9).reshape(3, 3)[:2, :2] / 65536.0
    return apply_display_matrix(image, turn) if np.abs(np.linalg.det(turn)) > 1e-3 else image


def apply_display_matrix(image: Image, matrix: Array) -> Image:
    """Applies a display matrix [[a, b], [c, d]] to an image: x' = a x + c y, y' = b x + d y."""
    (a, b), (c, d) = matrix
    if abs(a) < abs(c):  # x' depends on y: a quarter turn
        image, sign_x, sign_y = image.swapaxes(0, 1), c, b
    else:
        sign_x, sign_y = a, d
    image = image[:, ::-1] if sign_x < 0 else image
    image = image[::-1] if sign_y < 0 else image
    return np.ascontiguousarray(image)


def hdr_transfer(frame: av.VideoFrame) -> int | None:
    """`HLG` or `PQ` for an HDR frame, None for an SDR one."""
    transfer = int(frame.color_trc or 0)
    return transfer if transfer in HDR_NAMES else None


# ---- sharpness and motion, on small gray images (uint8, shape (h, w)) so that a frame takes about a millisecond


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of the image; comparable only between frames of one view.

    Pech-Pacheco et al. 2000 ("LAPV"). The division by the contrast keeps a brighter exposure from scoring as sharper.
    """
    laplacian = cv2.Laplacian(gray, cv2.CV_32F)
    return float(laplacian.var() / (gray.astype(np.float32).var() + 1.0))


def _sharpness_image(frame: av.VideoFrame) -> Image:
    width = min(SHARPNESS_WIDTH, frame.width)
    height = max(1, round(frame.height * width / frame.width))
    if frame.format.name in _LUMA_FIRST:  # the first plane is the brightness: no conversion needed
        plane = frame.planes[0]
        luma = np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
        return resize(luma, width, height)
    return np.asarray(frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray(), np.uint8)


def median_motion(
    before: NDArray[np.uint8], after: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
) -> float | None:
    """Median optical flow between two gray frames of equal size [px]; None if too few corners are tracked.

    Pyramidal Lucas-Kanade on Shi-Tomasi corners with a forward-backward check. The mask is 0 where pixels are ignored.
    """
    before, after = _contrast_stretched(before), _contrast_stretched(after)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 5, mask=mask)
    if corners is None or len(corners) < _MIN_TRACKED:
        return None
    there, found_there, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None)  # type: ignore[call-overload]
    consistent = np.linalg.norm(back - corners, axis=-1) < _MAX_RETURN_ERROR
    good = (consistent & (found_there == 1) & (found_back == 1))[:, 0]
    if good.sum() < _MIN_TRACKED:
        return None
    return float(np.median(np.linalg.norm(there - corners, axis=-1)[good]))


def is_static(
    before: NDArray[np.uint8], after: NDArray[np.uint8], min_motion: float, mask: NDArray[np.uint8] | None = None
) -> bool:
    """True if the image moved less than `min_motion` [px] or, without corners to track, did not change.

    Always false for a `min_motion` of 0.
    """
    if min_motion <= 0.0:
        return False
    moved = median_motion(before, after, mask)
    if moved is not None:
        return moved < min_motion
    difference = cv2.absdiff(_contrast_stretched(before), _contrast_stretched(after))
    seen = difference if mask is None else difference[mask > 0]
    return float(seen.mean()) < _STILL_DIFFERENCE if seen.size else True


def _contrast_stretched(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with its contrast stretched to the whole range, so that night frames have corners too."""
    low, high = np.percentile(gray[::2, ::2], (1.0, 99.0))
    gain = 255.0 / max(high - low, 16.0)  # bounded, so that the noise of a blank frame is hardly amplified
    return np.clip((gray.astype(np.float32) - low) * gain, 0, 255).astype(np.uint8)


# ---- timing of a film

# A longer time between two frames is a pause of the recording: [s], and median times between frames.
_PAUSE, _PAUSE_INTERVALS = 2.0, 5.0


@dataclass(frozen=True)
class FilmTiming:
    """Frame times of a film from its packets, read without decoding."""

    times: Array  # presentation times since the first frame [s], sorted, shape (n,)
    start: float  # time stamp of the first frame in its stream [s]
    declared: int  # number of frames that the container declares and shows; n if it declares none
    consecutive: bool = False  # true if decoded frames have no presentation times; they are numbered one by one

    @cached_property
    def interval(self) -> float:
        """Median time between frames [s]."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0

    @cached_property
    def duration(self) -> float:
        """Time from the first frame to the end of the last one [s]."""
        return float(self.times[-1] + self.interval)


def probe(path: Path) -> FilmTiming:
    """Reads the timing of a film from its packets.

    Raises InputError: not a video, or too damaged to have a readable packet.
    """
    times: list[float] = []
    unstamped = 0
    regular_file(path)
    try:
        with open_film(path) as (container, stream):
            with contextlib.suppress(av.error.FFmpegError):  # the packets before the end of a truncated file suffice
                for packet in container.demux(stream):
                    stamp = packet.pts if packet.pts is not None else packet.dts
                    if stamp is not None and not packet.is_discard:
                        times.append(float(stamp * packet.time_base))
                    unstamped += stamp is None and packet.size > 0
            # Without the frames outside the part that an edit list shows, as in a trimmed film.
            declared = sum(not entry.is_discard for entry in stream.index_entries) if stream.frames else 0
            rate = float(stream.average_rate or 25)
            # AVI stores no presentation times. With B frames, those that FFmpeg gives are in the order of the file.
            consecutive = container.format.name == "avi" and stream.codec_context.has_b_frames
    except InputError:
        raise
    except (av.error.FFmpegError, ValueError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{path}: not a readable film ({path.stat().st_size} bytes: {reason}); "
            "copy it again from the camera or re-encode it"
        ) from None
    if not times:
        times = [k / rate for k in range(unstamped)]  # a raw stream has no time stamps
    if not times:
        raise InputError(f"{path}: the film has no readable frame; copy it again from the camera or re-encode it")
    at = np.sort(np.array(times))
    if len(at) > 1 and at[-1] == at[0]:  # a raw stream without time stamps
        at = np.arange(len(at)) / rate
    return FilmTiming(at - at[0], float(at[0]), declared if declared > 0 else len(at), consecutive)


def frame_index(time: float | None, timing: FilmTiming, last: int) -> int:
    """Index of a decoded frame from its time [s], always above the index `last`.

    Damaged frames leave gaps, but not in films that are numbered one by one.
    """
    if time is None or timing.consecutive:
        return last + 1
    right = min(int(np.searchsorted(timing.times, time)), len(timing.times) - 1)
    left = max(right - 1, 0)
    nearest = left if time - timing.times[left] < timing.times[right] - time else right
    return max(nearest, last + 1)


def slot_of(index: int, time: float, timing: FilmTiming, slots: int) -> int:
    """The slot of a frame. Slots have equal durations; if there are as many slots as frames, each frame has its own."""
    if slots >= len(timing.times):
        return index
    # Half a frame interval is added so that rounding of time stamps never moves a frame across the border of a slot.
    return min(int((time + 0.5 * timing.interval) / timing.duration * slots), slots - 1)


def in_segments(times: Array, segments: tuple[tuple[float, ...], ...]) -> NDArray[np.bool_]:
    """Mask of the times (n,) [s] inside any of the segments [from, to]; all true without segments."""
    if not segments:
        return np.ones(len(times), bool)
    # Matroska rounds its time stamps to milliseconds, so they are wrong by at most 0.5 ms.
    return np.any([(times >= start - 5e-4) & (times <= end + 5e-4) for start, end in segments], axis=0)


def _joined_segments(
    timing: FilmTiming, segments: tuple[tuple[float, ...], ...], path: Path
) -> tuple[FilmTiming, NDArray[np.int64]]:
    """The timing of a film of the kept segments without pauses, and each frame's position in it (−1 if cut out).

    While nothing was recorded, as in a bag that was paused, there are no frames that could fill slots.
    """
    used = in_segments(timing.times, segments)
    if segments and used.sum() < 2:
        raise InputError(
            f"{path}: keep = {[list(part) for part in segments]} leaves {used.sum()} of {len(used)} frames (need 2); "
            f"the film runs from 0 to {timing.times[-1]:.2f} s"
        )
    position = np.where(used, np.cumsum(used) - 1, -1)
    step = np.diff(timing.times[used])
    pause = (np.diff(np.flatnonzero(used)) > 1) | (step > max(_PAUSE, _PAUSE_INTERVALS * timing.interval))
    if used.all() and not pause.any():
        return timing, position
    # The last frame before a cut or a pause lasts one frame interval.
    step = np.where(pause, timing.interval, step)
    return FilmTiming(np.concatenate([[0.0], np.cumsum(step)]), timing.start, int(used.sum())), position


# ---- reading a film


@dataclass(frozen=True)
class Film:
    """A film to be read."""

    path: Path
    timing: FilmTiming
    decode: Callable[[FilmStatistics], Iterator[tuple[float | None, av.VideoFrame]]]
    """Yields a tuple per undamaged frame in order: its time stamp [s] or None, and the frame. Counts damaged frames."""


def video_film(path: Path) -> Film:
    """The film in a video file. Raises InputError: see `probe`."""
    return Film(path, probe(path), partial(decode, path))


@dataclass(frozen=True)
class FilmFrame:
    """A kept frame, upright and scaled to the kept size."""

    index: int
    time: float
    image: Image  # RGB, shape (h, w, 3)
    mask: Image | None  # 0 = ignore, shape (h, w); None without a mask


@dataclass(frozen=True)
class _Candidate:
    slot: int
    index: int
    time: float
    sharpness: float
    frame: av.VideoFrame


def read_film(
    film: Film,
    config: CaptureConfig,
    count: FilmStatistics,
    mask_of: Callable[[int, int, int], Image | None],
    segments: tuple[tuple[float, ...], ...] = (),
) -> Iterator[FilmFrame]:
    """Yields a film's kept frames in order: the sharpest of each slot, without duplicates of a standing camera.

    `count` is filled while reading. `mask_of` maps a frame's index, kept width and kept height to its mask or None.
    `segments` holds pairs (from, to) of times [s]; empty for the whole film.

    Raises InputError: the film is unreadable, or has fewer than two frames or only blank ones.
    """
    last_small: Image | None = None
    for candidate in _sharpest_per_slot(film, config, count, segments):
        image = upright(candidate.frame)
        count.hdr = count.hdr or HDR_NAMES.get(hdr_transfer(candidate.frame) or 0, "")
        count.size = (image.shape[1], image.shape[0])
        size = fitted_size(*count.size, config.max_size)
        if size != count.size:
            image = resize(image, *size)
        height = max(1, round(size[1] * FLOW_WIDTH / size[0]))
        small = np.asarray(cv2.cvtColor(resize(image, FLOW_WIDTH, height), cv2.COLOR_RGB2GRAY), np.uint8)
        mask = mask_of(candidate.index, *size)
        small_mask = None
        if mask is not None:
            small_mask = np.asarray(cv2.resize(mask, small.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
        if last_small is not None and is_static(last_small, small, config.min_motion, small_mask):
            count.duplicates += 1
            continue
        last_small = small
        count.sharpness.append(candidate.sharpness)
        yield FilmFrame(candidate.index, candidate.time, image, mask)
    if count.decoded < 2:
        raise InputError(
            f"{film.path}: {count.decoded} of {count.declared} frames could be decoded (need 2); "
            "copy it again from the camera or re-encode it"
        )
    if last_small is None:
        raise InputError(
            f"{film.path}: all {count.blank} frames are blank (one color); film with enough light and without a lens "
            "cap"
        )


def _sharpest_per_slot(
    film: Film, config: CaptureConfig, count: FilmStatistics, segments: tuple[tuple[float, ...], ...]
) -> Iterator[_Candidate]:
    timing = film.timing
    kept_timing, position = _joined_segments(timing, segments, film.path)
    last = int(np.flatnonzero(position >= 0)[-1])
    slots = config.frames or max(2, round(kept_timing.duration * config.fps))
    slots = min(slots, len(kept_timing.times))
    if slots > config.max_frames:
        runtime.log_line(
            f"  {film.path.name}: {config.max_frames} of {slots} frames are kept, as capture.max_frames = "
            f"{config.max_frames}; raise it if they are more than 2 m apart, as on a long road"
        )
        slots = config.max_frames
    count.declared = max(timing.declared, len(timing.times)) if not segments else len(kept_timing.times)
    count.duration = kept_timing.duration
    best: _Candidate | None = None
    index = -1
    size: tuple[int, int] | None = None
    for stamp, frame in film.decode(count):
        index = frame_index(None if stamp is None else stamp - timing.start, timing, index)
        if segments and index > last:
            break
        if segments and position[index] < 0:
            continue
        count.decoded += 1
        if size is not None and size != (frame.width, frame.height):
            raise InputError(
                f"{film.path}: the picture changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} "
                f"at frame {index}; cut the film there into two sources"
            )
        size = (frame.width, frame.height)
        gray = _sharpness_image(frame)
        if float(gray[::2, ::2].std()) < BLANK_STD:
            count.blank += 1
            continue
        time = float(timing.times[index]) if index < len(timing.times) else index * timing.interval
        inside = index < len(position)
        order, at = (int(position[index]), float(kept_timing.times[position[index]])) if inside else (index, time)
        candidate = _Candidate(slot_of(order, at, kept_timing, slots), index, time, sharpness(gray), frame)
        if best is not None and candidate.slot != best.slot:
            yield best
            best = candidate
        elif best is None or candidate.sharpness > best.sharpness:
            best = candidate
    if best is not None:
        yield best


def format_note(path: Path, count: FilmStatistics) -> str | None:
    """A note for the user if a film was converted from HDR or deinterlaced, else None."""
    done = [f"HDR ({count.hdr}), converted to SDR"] if count.hdr else []
    done += ["interlaced, so it was deinterlaced, which costs detail"] if count.interlaced else []
    return f"{path.name}: {'; '.join(done)}; film without it if you can" if done else None


def damage_note(path: Path, count: FilmStatistics) -> str | None:
    """A note for the user if a film is truncated or partly damaged, else None."""
    if count.decoded >= _MIN_DECODED_FRACTION * count.declared and not count.damaged:
        return None
    return (
        f"{path.name}: damaged; {count.decoded} of {count.declared} frames could be decoded and only those are used. "
        "Copy it again from the camera if more was filmed"
    )
