"""Image files as arrays, resizing and similarity metrics.

Images are RGB, shape (height, width, 3), float in [0, 1] unless uint8.
"""

import re
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from twin.errors import InputError
from twin.files import read_bytes, regular_file, write_bytes

MAX_PIXELS = 2 * 89_478_485  # largest number of pixels accepted; Pillow rejects larger images as decompression bombs
DECODE_ERRORS = (
    *(ArithmeticError, AttributeError, EOFError, LookupError, OSError, SyntaxError, TypeError, ValueError),
    *(AssertionError, MemoryError, NotImplementedError, RuntimeError, struct.error, zlib.error, cv2.error),
)  # exceptions that Pillow and OpenCV raise for damaged files
_MAX_BYTES = 2 << 30  # largest image file [bytes]
HEIF_SUFFIXES = (".heic", ".heif")  # suffixes of photos from phones; reading them needs the extra `heif`
_HEIF = "HEIF"  # Pillow's name of HEIF and HEIC
_CURE = "replace or remove it"
warnings.filterwarnings("ignore", category=PillowImage.DecompressionBombWarning)  # Pillow warns from MAX_PIXELS / 2 on
warnings.filterwarnings("ignore", module="PIL")  # warnings about flawed headers; these values count as unknown


def to_uint8(rgb: NDArray) -> NDArray[np.uint8]:
    """Colors in [0, 1] as bytes; NaN is 0."""
    return (np.clip(np.nan_to_num(rgb), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def read_image(path: Path) -> NDArray[np.uint8]:
    """Reads an image file as RGB uint8; gray becomes RGB, alpha is dropped, EXIF rotation is applied.

    Raises InputError: missing, empty, too large or undecodable file.
    """
    return cv2.cvtColor(decode_image(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def decode_image(path: Path, flags: int, cure: str = _CURE) -> NDArray[np.uint8]:
    """Decodes an image file with OpenCV's `IMREAD_...` flags: uint8, shape (h, w), or (h, w, 3) in BGR order.

    Raises InputError: missing, empty, too large or undecodable file; `cure` ends the message.
    """
    if (header := open_header(path, cure)) is not None:
        with header:
            if header.format == _HEIF:
                return _decode_heif(path, header, flags, cure)
    data = read_bytes(path, _MAX_BYTES)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except DECODE_ERRORS:
        image = None
    if image is None:
        raise unreadable_error(path, cure)
    return np.asarray(image, np.uint8)


def _decode_heif(path: Path, image: PillowImage.Image, flags: int, cure: str) -> NDArray[np.uint8]:
    try:
        if flags & cv2.IMREAD_COLOR:
            return cv2.cvtColor(np.asarray(image.convert("RGB"), np.uint8), cv2.COLOR_RGB2BGR).astype(np.uint8)
        return np.asarray(image.convert("L"), np.uint8)
    except DECODE_ERRORS:
        raise unreadable_error(path, cure) from None


def open_header(path: Path, cure: str = _CURE) -> PillowImage.Image | None:
    """Opens an image file with Pillow, reading only the header; None for a format unknown to Pillow.

    A HEIF image is already upright when it is opened, whatever EXIF orientation its header gives.

    Raises InputError: no file, an empty one, more than `MAX_PIXELS`, or HEIF without pillow-heif.
    """
    if path.suffix.lower() in HEIF_SUFFIXES:
        try:
            import pillow_heif
        except ImportError:
            raise InputError(f"{path}: HEIC needs pillow-heif: pip install 'twin[heif]', or convert it") from None
        pillow_heif.register_heif_opener()
    try:
        if not regular_file(path).stat().st_size:
            raise unreadable_error(path, cure)
        image = PillowImage.open(path)
    except PillowImage.DecompressionBombError as error:
        count = re.search(r"\d+", str(error))
        raise _too_large(path, f"{int(count[0]) / 1e6:,.0f} megapixels" if count else "too many pixels") from None
    except InputError:
        raise
    except DECODE_ERRORS:
        return None
    width, height = image.size
    if width * height > MAX_PIXELS:
        image.close()
        raise _too_large(path, f"{width}x{height}, {width * height / 1e6:,.0f} megapixels")
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored [px], from its header. Raises InputError as `decode_image` does."""
    image = open_header(path)
    if image is None:
        raise unreadable_error(path)
    with image:
        return image.size


def unreadable_error(path: Path, cure: str = _CURE) -> InputError:
    """The error for an image file that cannot be decoded."""
    return InputError(f"{path}: not a readable image ({path.stat().st_size} bytes); {cure}")


def _too_large(path: Path, size: str) -> InputError:
    most = MAX_PIXELS / 1e6
    return InputError(f"{path}: the image has {size}; expected at most {most:.0f} megapixels: scale it down")


def write_image(path: Path, image: NDArray) -> None:
    """Writes RGB or gray (uint8, or float in [0, 1]) as PNG or JPEG, chosen by the suffix."""
    if image.dtype != np.uint8:
        image = to_uint8(image)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    path.parent.mkdir(parents=True, exist_ok=True)
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 95]
    ok, data = cv2.imencode(path.suffix, image, fast)
    if not ok:
        raise OSError(f"could not encode {path}")
    write_bytes(path, data.tobytes())


def resize(image: NDArray, width: int, height: int) -> NDArray:
    """Resizes by area averaging when shrinking and by linear interpolation when growing."""
    shrinking = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


SSIM_WINDOW = 11  # side of the windows of `ssim` [px], and least side of its images


def psnr(image: NDArray, reference: NDArray, mask: NDArray | None = None) -> float:
    """Peak signal-to-noise ratio [dB] of float images in [0, 1] over the pixels where `mask` is true."""
    error = (image.astype(np.float64) - reference) ** 2
    mse = float(error[mask].mean() if mask is not None else error.mean())
    return float("inf") if mse == 0.0 else -10.0 * np.log10(mse)


def ssim(image: NDArray, reference: NDArray, mask: NDArray | None = None) -> float:
    """Structural similarity (Wang et al. 2004, Gaussian window σ = 1.5) of float RGB images in [0, 1].

    With a mask, it is the mean over the windows whose middle is in it, NaN if there is none.
    """
    from skimage.metrics import structural_similarity  # slow to import

    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    mean, values = structural_similarity(image, reference, channel_axis=-1, data_range=1.0, full=True, **window)
    if mask is None or mask.all():
        return float(mean)
    inside = slice(SSIM_WINDOW // 2, -(SSIM_WINDOW // 2))
    kept = values[inside, inside][mask[inside, inside]]
    return float(kept.mean()) if len(kept) else float("nan")
