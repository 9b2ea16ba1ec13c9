"""One source while it is read: its inputs, its masks, its kept frames, and the writer of its image files.

A mask marks the pixels of a frame that all later stages ignore: 0 = ignore, any other value = use.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.capture.camera_models import Lens, checked_lens, same_aspect
from twin.capture.capture_data import SourceInfo
from twin.config import CaptureConfig, SourceConfig
from twin.errors import InputError
from twin.files import is_file, is_folder
from twin.geometry.images import decode_image, write_image
from twin.types import Image

_LOSSY_THRESHOLD = 63  # compression changes the zeros of a JPEG mask
_QUEUE_SIZE = 4  # images decoded or encoded in the background; bounds the memory
NO_GPS = (math.nan, math.nan, math.nan)
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Masks:
    """The masks of one source: one image for all frames, or a folder with an image per frame."""

    path: Path

    def __post_init__(self) -> None:
        cure = "give as mask an image or a folder of images, 0 = ignore"
        if is_folder(self.path, cure) and not any(self.path.iterdir()):
            raise InputError(f"{self.path}: this mask folder is empty; put one image per frame in it, 0 = ignore")

    def find(self, keys: tuple[str, ...]) -> Path | None:
        """The mask of a frame that may be named by any of the keys; None if the folder has none of them."""
        if not self.path.is_dir():
            return self.path
        candidates = (self.path / f"{key}{suffix}" for key in keys for suffix in (".png", ".jpg", ".PNG", ".JPG"))
        return next((path for path in candidates if is_file(path)), None)


def read_mask(path: Path, width: int, height: int) -> Image:
    """Reads a mask at a frame's size: 0 or 255, shape (height, width).

    Raises InputError: unreadable, of another aspect than the frame, or all pixels ignored.
    """
    mask = decode_image(path, cv2.IMREAD_GRAYSCALE, "write the mask again as an 8-bit PNG")
    if not same_aspect((mask.shape[1], mask.shape[0]), (width, height)):
        raise InputError(
            f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]} but its frame has the aspect of {width}x{height}; "
            "draw it on an upright frame of this source"
        )
    use = mask > (_LOSSY_THRESHOLD if path.suffix.lower() in (".jpg", ".jpeg") else 0)
    if not use.any():
        raise InputError(f"{path}: this mask ignores the whole picture; 0 = ignore, 255 = use")
    binary = np.where(use, 255, 0).astype(np.uint8)
    return cv2.resize(binary, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.uint8, copy=False)


@dataclass(frozen=True)
class SourceTask:
    """The inputs for reading one source."""

    path: Path
    name: str
    lighting: str
    kind: str
    source: SourceConfig
    config: CaptureConfig
    masks: Masks | None
    writer: "FrameWriter"

    @property
    def segments(self) -> tuple[tuple[float, ...], ...]:
        """Segments of the source to use, [from, to] each [s]; empty for all of it."""
        return self.source.keep or self.config.keep

    def given_lens(self, native: tuple[int, int]) -> Lens | None:
        """The calibration in `scene.toml`, or None; `native` is the upright size of the input [px].

        Raises InputError: an impossible calibration, or one for another aspect.
        """
        camera = self.source.camera
        if camera is None:
            return None
        where = f"{self.path.name}: camera"
        width, height = (camera.width, camera.height) if camera.width or camera.height else native
        lens = checked_lens(camera.model, camera.params, width, height, where)
        if not lens.fits(*native):
            raise InputError(
                f"{where} is for {width}x{height}, but the upright picture is {native[0]}x{native[1]}; "
                "give the calibration of the upright picture"
            )
        return lens

    def info(self, size: tuple[int, int], lens: Lens | None, calibrated: bool) -> SourceInfo:
        """The `SourceInfo` for a frame size [px]; without a lens, with SIMPLE_RADIAL, which fits most cameras."""
        model, params = (lens.model, lens.params) if lens else ("SIMPLE_RADIAL", ())
        height = self.source.camera_height
        return SourceInfo(self.name, self.lighting, self.kind, *size, model, params, calibrated, height)

    def check_masked(self, unmasked: int, count: int) -> None:
        """Reports frames without a mask. Raises InputError if the mask folder fits none of the `count` frames."""
        if self.masks and unmasked == count:
            raise InputError(
                f"{self.masks.path}: no mask here is named like a frame; "
                "call them 000012.png (frame of the film, from 0) or like the photo"
            )
        if self.masks and unmasked:
            runtime.log_line(f"  {self.masks.path.name}: {unmasked} of {count} frames have no mask and are used whole")


@dataclass
class KeptFrames:
    """The kept frames of one source in order, with their metadata."""

    info: SourceInfo
    index: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    gps: list[tuple[float, float, float]] = field(default_factory=list)
    poses: list[NDArray[np.float64]] = field(default_factory=list)
    """camera_to_world (4, 4) per frame; empty for a source without poses."""
    intrinsics: list[NDArray[np.float64]] = field(default_factory=list)
    """fx, fy, cx, cy [px] at the kept size per pose."""
    metrics: dict[str, Any] = field(default_factory=dict)


class FrameWriter:
    """Encodes and writes a source's frames and masks in threads; errors are raised at the next frame or at the end."""

    def __init__(self, out: Path, name: str) -> None:
        self._images, self._masks = out / "images" / name, out / "masks" / name
        self._waiting: list[Future[None]] = []
        self.pool = ThreadPoolExecutor(2)

    def put(self, index: int, image: Image, mask: Image | None) -> None:
        """Queues one frame and its mask; blocks while the queue is full."""
        while len(self._waiting) >= _QUEUE_SIZE:
            self._waiting.pop(0).result()
        self._waiting.append(self.pool.submit(self._write, f"{index:06d}.png", image, mask))

    def _write(self, file: str, image: Image, mask: Image | None) -> None:
        gray = (image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all()
        write_image(self._images / file, image[..., 0] if gray else image)
        if mask is not None:
            write_image(self._masks / file, mask)

    def __enter__(self) -> "FrameWriter":
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.pool.shutdown(wait=True, cancel_futures=error is not None)
        if error is None:
            for future in self._waiting:
                future.result()


def prefetch(pool: ThreadPoolExecutor, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Maps items in threads and yields the results in order, at most `_QUEUE_SIZE` ahead of the consumer."""
    waiting: list[Future[R]] = []
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= _QUEUE_SIZE:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()
