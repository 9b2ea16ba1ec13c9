"""Writes and reads H.264 mp4 videos with PyAV; needs no display and no system codec.

Frames are RGB uint8, shape (height, width, 3). Videos are yuv420p in BT.709, which every browser plays; their width
and height are even. A video's index is stored first, so that playback can start before the download ends.
"""

import io
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

_BT709 = 1  # number of BT.709 in ITU-T H.273, for matrix, primaries and transfer
_LIMITED_RANGE = 1  # AVCOL_RANGE_MPEG
# Threads of x264. With four threads on a busy machine, the bytes of 8 of 1,500 films differed between runs. With one
# thread this is rare, and the pictures are the same.
_THREADS = 1
_POSTER_WIDTH = 640  # [px]


def even(size: int) -> int:
    """Largest even number up to `size`, but at least 2. Chroma subsampling (4:2:0) needs even sides."""
    return max(2, size // 2 * 2)


class VideoWriter:
    """Context manager that writes an mp4 frame by frame.

    The video is written as `<name>.partial` and renamed on a clean exit, so that a reader never finds an incomplete
    file. An exception inside the block removes the partial file.

    Args:
        path: The finished mp4.
        size: Width, height [px] of every frame; both even.
        fps: Frames per second.
        crf: Constant rate factor of x264: 18 looks lossless, 23 is its default, 28 is small.

    Raises:
        ValueError: A side is odd or below 2.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int, crf: int = 23):
        if size[0] % 2 or size[1] % 2 or min(size) < 2:
            raise ValueError(f"video size {size[0]}×{size[1]}: expected even sides, see `even`")
        self.path = path
        self.size = size
        self.fps = fps
        self.frames = 0
        self._partial = path.with_name(path.name + ".partial")
        self._container = av.open(str(self._partial), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream = self._container.add_stream("libx264", rate=Fraction(fps))
        # One key frame per second allows seeking.
        self._stream.options = {"crf": str(crf), "preset": "veryfast", "g": str(fps)}
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        codec = self._stream.codec_context
        codec.colorspace = codec.color_primaries = codec.color_trc = _BT709
        codec.color_range = _LIMITED_RANGE
        codec.thread_count = _THREADS

    def write(self, frame: NDArray[np.uint8], count: int = 1) -> None:
        """Appends a frame, shown for `count` frame times.

        Raises:
            ValueError: The frame has another shape or dtype.
        """
        width, height = self.size
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise ValueError(f"frame {frame.shape} {frame.dtype}: expected uint8 {(height, width, 3)}")
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        picture = picture.reformat(
            format="yuv420p", src_color_range="JPEG", dst_color_range="MPEG", dst_colorspace="ITU709"
        )
        picture.colorspace, picture.color_range = _BT709, _LIMITED_RANGE
        for _ in range(count):
            picture.pts = self.frames
            picture.time_base = Fraction(1, self.fps)
            self._container.mux(self._stream.encode(picture))
            self.frames += 1

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            if kind is None:
                self._partial.replace(self.path)
        finally:
            self._partial.unlink(missing_ok=True)


def frame_indices(count: int, every: int) -> list[int]:
    """Every `every`-th index from 0 on, and the last index, `count` − 1. `count` must be at least 1."""
    indices = list(range(0, count, every))
    return indices if indices[-1] == count - 1 else [*indices, count - 1]


def read_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)


def last_frame_jpeg(path: Path) -> bytes:
    """Returns the last frame of a video as a JPEG, `_POSTER_WIDTH` wide."""
    frame = Image.fromarray(deque(read_frames(path), maxlen=1)[0])
    out = io.BytesIO()
    frame.resize((_POSTER_WIDTH, round(_POSTER_WIDTH * frame.height / frame.width))).save(out, "JPEG", quality=80)
    return out.getvalue()
