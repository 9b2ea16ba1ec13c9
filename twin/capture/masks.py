"""Masks: which pixels of a frame are ignored by everything that follows. 0 = ignore, anything else = use."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.capture.lens import same_aspect
from twin.capture.paths import is_file, is_folder
from twin.errors import InputError
from twin.geometry.images import decoded

_LOSSY_THRESHOLD = 63  # a JPEG's zero is not quite zero

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Masks:
    """The masks of one source: one for all frames, or a folder with one for each."""

    path: Path

    def __post_init__(self) -> None:
        cure = "give as mask an image or a folder of images, 0 = ignore"
        if is_folder(self.path, cure) and not any(self.path.iterdir()):
            raise InputError(f"{self.path}: this mask folder is empty; put one image per frame in it, 0 = ignore")

    def find(self, keys: tuple[str, ...]) -> Path | None:
        """The file that masks a frame known under these names; None where the folder has none of them."""
        if not self.path.is_dir():
            return self.path
        candidates = (self.path / f"{key}{suffix}" for key in keys for suffix in (".png", ".jpg", ".PNG", ".JPG"))
        return next((path for path in candidates if is_file(path)), None)


def read_mask(path: Path, width: int, height: int) -> Image:
    """A mask at a frame's size, 0 or 255, shape (height, width).

    Raises:
        InputError: unreadable, of another aspect than the frame, or nothing left to use.
    """
    mask = decoded(path, cv2.IMREAD_GRAYSCALE, "write the mask again as an 8-bit PNG")
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
