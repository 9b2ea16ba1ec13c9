"""Images as arrays, and how alike two are. RGB order, shape (height, width, 3), float in [0, 1] unless uint8."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from twin.errors import InputError


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB uint8; grey becomes RGB, alpha is dropped, EXIF rotation is applied.

    Raises:
        InputError: missing, empty or undecodable file.
    """
    data = np.frombuffer(path.read_bytes(), np.uint8) if path.exists() else np.zeros(0, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise InputError(f"{path}: not a readable image ({len(data)} bytes); replace or remove it")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def write_image(path: Path, image: NDArray) -> None:
    """Writes RGB or grey (uint8, or float in [0, 1]) as PNG or JPEG, by suffix."""
    if image.dtype != np.uint8:
        image = (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    path.parent.mkdir(parents=True, exist_ok=True)
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 95]
    ok, data = cv2.imencode(path.suffix, image, fast)
    if not ok:
        raise OSError(f"could not encode {path}")
    path.write_bytes(data.tobytes())


def resize(image: NDArray, width: int, height: int) -> NDArray:
    """Resizes by area averaging when shrinking, linear when growing."""
    shrinking = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


def psnr(image: NDArray, reference: NDArray, mask: NDArray | None = None) -> float:
    """Peak signal-to-noise ratio [dB] of float images in [0, 1], over the pixels where the mask is true."""
    error = (image.astype(np.float64) - reference) ** 2
    mse = float(error[mask].mean() if mask is not None else error.mean())
    return float("inf") if mse == 0.0 else -10.0 * np.log10(mse)


def ssim(image: NDArray, reference: NDArray) -> float:
    """Structural similarity (Wang et al. 2004, Gaussian window σ = 1.5) of float RGB images in [0, 1]."""
    return float(
        structural_similarity(
            image,
            reference,
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )
