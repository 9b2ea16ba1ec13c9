"""Sources and kept (selected) frames of a capture, while they are read and as build stage `capture` stores them.

A *mask* marks the pixels of a frame that all later stages ignore: 0 = ignore, any other value = use.
"""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.capture.camera_models import Lens, checked_lens, same_aspect
from twin.config import CaptureConfig, SourceConfig
from twin.errors import InputError
from twin.files import check_shapes, is_file, load_arrays, read_json, require_text, wrap_read_errors, write_json
from twin.geometry.images import decode_image, write_image
from twin.types import Array, Image

QUEUE_SIZE = 4  # images that may be decoded or encoded in the background at once; bounds the memory
NO_GPS = (math.nan, math.nan, math.nan)
_TURN = 360.0  # [°]
_LOSSY_THRESHOLD = 63  # JPEG mask values up to this one count as 0, since compression changes zeros
_ARRAYS: dict[str, tuple[tuple[int, ...], str]] = {
    "source_index": ((), "i"),
    "times": ((), "f"),
    "held_out": ((), "b"),
    "gps": ((3,), "f"),
    "camera_to_world": ((4, 4), "f"),
    "intrinsics": ((4,), "f"),
    "odometry": ((3,), "f"),
}  # arrays of `Capture` that are stored: name → (shape per frame, `dtype.kind`)


def nearest_longitudes(longitude: Array, to: float = 0.0) -> Array:
    """Longitudes [°] shifted by whole turns to within 180° of the longitude `to`, so that they do not jump near it."""
    return np.asarray(longitude - _TURN * np.round((longitude - to) / _TURN))


# ---- the stored capture


@dataclass(frozen=True)
class SourceInfo:
    """One source after capture. Its frames share one camera, unless posed input has one camera per image."""

    name: str  # unique folder name of the source
    lighting: str
    kind: str  # video, bag, images, colmap or transforms
    width: int  # size of the kept frames [px]
    height: int
    camera_model: str  # COLMAP model name of the known or assumed camera
    camera_params: tuple[float, ...]
    """Calibration or focal length prior [px], at the size of the kept frames; empty if unknown."""
    calibrated: bool  # true if `camera_params` are a given calibration, which stays fixed
    camera_height: float  # height of the lens above the ground [m]; 0 = not given


@dataclass(frozen=True)
class Capture:
    """n kept frames, ordered by source and then by time."""

    sources: tuple[SourceInfo, ...]
    names: tuple[str, ...]
    """`<source>/<six digits>`; the image is `images/<name>.png` in the stage folder, its mask `masks/<name>.png`."""
    source_index: NDArray[np.int64]  # shape (n,)
    times: Array  # time within the source [s]; for photos without known times, their index. Shape (n,)
    held_out: NDArray[np.bool_]  # true for test frames, which are never trained on. Shape (n,)
    gps: Array  # latitude [°], longitude [°], altitude [m]; NaN where unknown. Shape (n, 3)
    camera_to_world: Array | None = None
    """Poses given with the input (OpenCV axes), shape (n, 4, 4); None unless all sources have them."""
    intrinsics: Array | None = None
    """fx, fy, cx, cy [px] per frame of posed input, at the kept size, shape (n, 4); distortion is in `SourceInfo`."""
    odometry: Array | None = None
    """Positions of the lens by a bag's odometry [m], shape (n, 3), NaN where unknown. Each source has its own
    coordinate frame. None if no bag has odometry."""

    def save(self, folder: Path) -> None:
        """Writes `capture.json` and `capture.npz`."""
        arrays = {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
        np.savez(folder / "capture.npz", **arrays)
        write_json(folder / "capture.json", {"sources": [vars(s) for s in self.sources], "names": self.names})

    @staticmethod
    def load(folder: Path) -> "Capture":
        """Reads the files that `save` wrote. Raises InputError if they are missing or damaged."""
        head, data = read_json(folder / "capture.json"), load_arrays(folder / "capture.npz")
        with wrap_read_errors(folder / "capture.json", "build the scene again"):
            sources = tuple(SourceInfo(**{**s, "camera_params": tuple(s["camera_params"])}) for s in head["sources"])
            names = tuple(map(require_text, head["names"]))
        with wrap_read_errors(folder / "capture.npz", "build the scene again"):
            capture, n = Capture(sources, names, **data), len(names)
            check_shapes({name: (array, (n, *_ARRAYS[name][0]), _ARRAYS[name][1]) for name, array in data.items()})
            if n and not (capture.source_index.min() >= 0 and capture.source_index.max() < len(sources)):
                raise ValueError(f"frames refer to a source index outside 0 to {len(sources) - 1}")
        return capture


# ---- a source while it is read


def read_mask(path: Path, width: int, height: int) -> Image:
    """Reads a mask at a frame's size: 0 or 255, shape (height, width).

    Raises InputError: the mask is unreadable, has another aspect ratio than the frame, or ignores all pixels.
    """
    mask = decode_image(path, cv2.IMREAD_GRAYSCALE, "write the mask again as an 8-bit PNG")
    if not same_aspect((mask.shape[1], mask.shape[0]), (width, height)):
        raise InputError(
            f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]} but its frame has the aspect ratio of "
            f"{width}x{height}; draw it on an upright frame of this source"
        )
    use = mask > (_LOSSY_THRESHOLD if path.suffix.lower() in (".jpg", ".jpeg") else 0)
    if not use.any():
        raise InputError(f"{path}: this mask ignores the whole picture; 0 = ignore, 255 = use")
    binary = np.where(use, 255, 0).astype(np.uint8)
    return cv2.resize(binary, (width, height), interpolation=cv2.INTER_NEAREST).astype(np.uint8, copy=False)


def given_lens(path: Path, source: SourceConfig, native: tuple[int, int]) -> Lens | None:
    """The calibration of a source in `scene.toml`, or None; `native` is the upright size of the input at `path` [px].

    Raises InputError: an impossible calibration, or a calibration for another aspect ratio.
    """
    camera = source.camera
    if camera is None:
        return None
    where = f"{path.name}: camera"
    width, height = (camera.width, camera.height) if camera.width or camera.height else native
    lens = checked_lens(camera.model, camera.params, width, height, where)
    if not lens.fits(*native):
        raise InputError(
            f"{where} is for {width}x{height}, but the upright picture is {native[0]}x{native[1]}; "
            "give the calibration of the upright picture"
        )
    return lens


@dataclass(frozen=True)
class SourceTask:
    """The inputs for reading one source."""

    path: Path
    name: str
    lighting: str
    kind: str
    source: SourceConfig
    config: CaptureConfig
    masks: Path | None  # one mask for all frames, or a folder with a mask per frame
    writer: "FrameWriter"

    @property
    def segments(self) -> tuple[tuple[float, ...], ...]:
        """The segments of the source that are used, each [from, to] [s]; empty for the whole source."""
        return self.source.keep or self.config.keep

    def info(self, size: tuple[int, int], lens: Lens | None, calibrated: bool) -> SourceInfo:
        """The `SourceInfo` for a frame size [px]; an unknown lens gets SIMPLE_RADIAL, which fits most cameras."""
        model, params = (lens.model, lens.params) if lens else ("SIMPLE_RADIAL", ())
        height = self.source.camera_height
        return SourceInfo(self.name, self.lighting, self.kind, *size, model, params, calibrated, height)

    def mask(self, keys: tuple[str, ...], width: int, height: int) -> Image | None:
        """The mask (height, width) of a frame, or None. In a mask folder, it is a file named like one of `keys`."""
        path = self.masks
        if path and path.is_dir():
            files = (path / f"{key}{suffix}" for key in keys for suffix in (".png", ".jpg", ".PNG", ".JPG"))
            path = next(filter(is_file, files), None)
        return read_mask(path, width, height) if path else None

    def check_masked(self, unmasked: int, count: int) -> None:
        """Reports that `unmasked` of `count` frames have no mask. Raises InputError if no frame has one."""
        if self.masks and unmasked == count:
            raise InputError(
                f"{self.masks}: no mask here is named like a frame; "
                "call them 000012.png (frame of the film, from 0) or like the photo, in a subfolder like its own"
            )
        if self.masks and unmasked:
            runtime.log_line(f"  {self.masks.name}: {unmasked} of {count} frames have no mask and are used whole")


@dataclass(frozen=True)
class KeptFrames:
    """The kept frames of one source in order."""

    info: SourceInfo
    index: list[int]
    times: list[float]
    gps: list[tuple[float, float, float]]
    metrics: dict[str, Any]
    poses: list[Array]  # camera_to_world (4, 4) per frame; empty for a source without poses
    intrinsics: list[Array]  # fx, fy, cx, cy [px] at the kept size, one per pose
    odometry: list[tuple[float, float, float]] | None = None  # positions of the lens [m]; None without a bag


class FrameWriter:
    """Encodes and writes a source's frames and masks in threads; errors are raised by a later `put` or at the end."""

    def __init__(self, out: Path, name: str) -> None:
        self._images, self._masks = out / "images" / name, out / "masks" / name
        self._waiting: list[Future[None]] = []
        self.pool = ThreadPoolExecutor(2)

    def put(self, index: int, image: Image, mask: Image | None) -> None:
        """Queues one frame and its mask; blocks while the queue is full."""
        while len(self._waiting) >= QUEUE_SIZE:
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
