"""Decodes films: skips damaged frames, deinterlaces, converts HDR to SDR, and turns frames upright.

HDR films of phones and cameras (HLG and PQ of ITU-R BT.2100) become SDR pictures with the colors of BT.709. A frame's
signal is converted to display light L [cd/m²] by the formulas of BT.2100:

    HLG: E = inverse OETF of the signal;   L = 1000 Yˢ^0.2 E (OOTF)
    PQ:  L = EOTF of the signal

Yˢ is the luminance of E. For HLG a screen with a peak of 1,000 cd/m² is assumed; its system gamma is 1.2. Diffuse white
is 203 cd/m² in both (BT.2408). x = L / 203 is converted from the primaries of BT.2020 to those of BT.709 (BT.2087).
Then highlights are compressed, and the SDR signal is x^(1/2.4), the inverse of BT.1886:

    x → x up to 0.8;   x → 0.8 + 0.2 tanh((x − 0.8) / 0.2) above

The conversion is the same for every frame, so the exposure does not depend on a frame's content.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import av
import av.error
import av.filter
import cv2
import numpy as np
from av.sidedata.sidedata import SideDataContainer
from av.sidedata.sidedata import Type as SideData
from av.video.frame import PictureType

from twin.errors import InputError
from twin.types import Array, Array32, Image

# ---- films

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
        pending: list[av.VideoFrame] = []  # B frames that wait for the undamaged frame on which they depend
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
                if frame.pict_type != PictureType.B:
                    yield from ((intact.time, intact) for intact in pending)
                    pending.clear()
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
    """A frame as SDR RGB, rotated and mirrored by its display matrix in multiples of 90°."""
    transfer = hdr_transfer(frame)
    image = hdr_to_sdr(frame, transfer) if transfer else np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    # `frame.side_data` would make a reference cycle, so many large frames would stay until garbage is collected.
    side = SideDataContainer(frame).get(SideData.DISPLAYMATRIX)  # type: ignore[call-arg]
    if side is None:
        return image
    matrix = np.frombuffer(bytes(side), np.int32, 9).reshape(3, 3)[:2, :2] / 65536.0
    return apply_display_matrix(image, matrix) if np.abs(np.linalg.det(matrix)) > 1e-3 else image


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


# ---- HDR

HLG, PQ = 18, 16
"""Transfer characteristics of HDR films (ITU-T H.273)."""
HDR_NAMES = {HLG: "HLG", PQ: "PQ"}

_WHITE = 203.0  # [cd/m²] diffuse white
_PEAK, _SYSTEM_GAMMA = 1000.0, 1.2  # peak [cd/m²] and gamma of the display assumed for HLG
_HLG = (0.17883277, 0.28466892, 0.55991073)  # a, b, c of BT.2100
_PQ = (2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32)  # m1, m2, c1, c2, c3
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # weights of BT.2020's red, green and blue
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # BT.2087
_KNEE = 0.8
_DISPLAY_GAMMA = 2.4
_MATRICES = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593), 10: (0.2627, 0.0593)}
"""Matrix coefficients (H.273) → weights of red and blue in the luma; BT.2020's weights are used for all others."""
_LEVELS = 4096  # number of entries of a table over [0, 1]


def hdr_transfer(frame: av.VideoFrame) -> int | None:
    """`HLG` or `PQ` for an HDR frame, None for an SDR one."""
    transfer = int(frame.color_trc or 0)
    return transfer if transfer in HDR_NAMES else None


def hdr_to_sdr(frame: av.VideoFrame, transfer: int) -> Image:
    """An HDR frame as an SDR picture, RGB uint8 (h, w, 3), unrotated."""
    red, blue = _MATRICES.get(int(frame.colorspace or 0), _MATRICES[9])
    coded = frame.to_ndarray(format="yuv444p16le").astype(np.float32) / 65536.0  # y, u, v
    full_range = int(frame.color_range or 0) == 2
    offset, luma_range, chroma_range = (0.0, 1.0, 1.0) if full_range else (16 / 256, 219 / 256, 224 / 256)
    y = (coded[..., 0] - offset) / luma_range
    u, v = ((coded[..., k] - 0.5) / chroma_range for k in (1, 2))
    signal = np.empty_like(coded)
    signal[..., 0] = y + 2.0 * (1.0 - red) * v
    signal[..., 2] = y + 2.0 * (1.0 - blue) * u
    signal[..., 1] = (y - red * signal[..., 0] - blue * signal[..., 2]) / (1.0 - red - blue)
    x = _look_up(_light_table(transfer), signal)
    if transfer == HLG:
        x *= np.maximum(x @ _LUMINANCE, 1e-6)[..., None] ** (_SYSTEM_GAMMA - 1.0)
    x *= (_PEAK if transfer == HLG else 1.0) / _WHITE
    x = np.asarray(cv2.transform(x, _TO_BT709), np.float32)
    high = x > _KNEE
    x[high] = _KNEE + (1.0 - _KNEE) * np.tanh((x[high] - _KNEE) / (1.0 - _KNEE))
    return np.asarray(_look_up(_display_table(), np.sqrt(np.maximum(x, 0.0))) + 0.5, np.uint8)


@lru_cache
def _light_table(transfer: int) -> Array32:
    """HLG: scene light E of a signal from 0 to 1; PQ: display light [cd/m²]."""
    signal = np.linspace(0.0, 1.0, _LEVELS)
    if transfer == HLG:
        a, b, c = _HLG
        light = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
    else:
        m1, m2, c1, c2, c3 = _PQ
        root = signal ** (1.0 / m2)
        light = 10_000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
    return light.astype(np.float32)


@lru_cache
def _display_table() -> Array32:
    """SDR signal from 0 to 255 for light from 0 to 1."""
    # The table is indexed by the square root of light, which gives finer steps to dark colors.
    root = np.linspace(0.0, 1.0, _LEVELS)
    return (255.0 * root ** (2.0 / _DISPLAY_GAMMA)).astype(np.float32)


def _look_up(table: Array32, values: Array32) -> Array32:
    return np.asarray(table[(np.clip(values, 0.0, 1.0) * (_LEVELS - 1) + 0.5).astype(np.int32)])
