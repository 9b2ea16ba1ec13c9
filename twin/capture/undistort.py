"""From a lens with distortion to a pinhole of the same size.

The *raw* image has the lens's distortion; the *pinhole* image is what a perfect pinhole at the same place would see.
Its focal length is raised just enough that no pixel of it lies outside the raw image, so nothing has to be filled in.
"""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.capture.pycolmap_import import pycolmap
from twin.errors import InputError
from twin.geometry.cameras import pixel_grid
from twin.geometry.images import decoded, write_image
from twin.geometry.poses import Array

_NEGLIGIBLE = 0.1  # [px] distortion below this is left alone
_MAX_ZOOM = 4.0


def pinhole_of(camera: pycolmap.Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy [px] of the pinhole camera that replaces a distorted one of the same size.

    Raises:
        InputError: the distortion bends the picture so far that no pinhole fits into it.
    """
    fx, fy = camera.focal_length_x, camera.focal_length_y
    cx, cy = camera.principal_point_x, camera.principal_point_y
    if camera.is_undistorted():
        return fx, fy, cx, cy
    if _displacement(camera, (fx, fy, cx, cy)) < _NEGLIGIBLE:
        return fx, fy, cx, cy
    border = _border(camera.width, camera.height)
    low, high = 0.5, _MAX_ZOOM
    if not _inside(camera, border, (fx * high, fy * high, cx, cy)):
        raise InputError(
            f"camera {camera.model.name} {[round(float(p), 4) for p in camera.params]}: no pinhole view fits into it; "
            "check the calibration, or give a fisheye model for a fisheye lens"
        )
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _inside(camera, border, (fx * middle, fy * middle, cx, cy)) else (middle, high)
    return fx * high, fy * high, cx, cy


def undistortion_map(camera: pycolmap.Camera, pinhole: tuple[float, float, float, float]) -> NDArray[np.float32] | None:
    """Where each pinhole pixel lies in the raw image, in OpenCV's pixel convention (centre of the first pixel is 0, 0).

    Returns:
        Shape (height, width, 2); None where the raw image may be taken as it is.
    """
    if camera.is_undistorted() or _displacement(camera, pinhole) < _NEGLIGIBLE:
        return None
    grid = pixel_grid(camera.width, camera.height)
    return (_raw(camera, grid.reshape(-1, 2), pinhole) - 0.5).reshape(grid.shape).astype(np.float32)


def write_pinhole_image(raw: Path, target: Path, mapping: NDArray[np.float32] | None, mask: bool = False) -> None:
    """Writes one image or mask without distortion; without a mapping it is linked (or copied across disks).

    Raises:
        InputError: the raw image cannot be read.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if mapping is None:
        try:
            os.link(raw, target)
        except OSError:
            shutil.copyfile(raw, target)
        return
    flags = cv2.IMREAD_GRAYSCALE if mask else cv2.IMREAD_ANYCOLOR
    image = decoded(raw, flags, "delete the build folder and build again")
    method = cv2.INTER_NEAREST if mask else cv2.INTER_CUBIC
    flat = cv2.remap(image, mapping[..., 0], mapping[..., 1], method, borderMode=cv2.BORDER_REPLICATE)
    write_image(target, flat if flat.ndim == 2 else cv2.cvtColor(flat, cv2.COLOR_BGR2RGB))


def _raw(camera: pycolmap.Camera, pixels: Array, pinhole: tuple[float, float, float, float]) -> Array:
    fx, fy, cx, cy = pinhole
    rays = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], 1)
    return np.asarray(camera.img_from_cam(rays))


def _border(width: int, height: int) -> Array:
    u, v = np.linspace(0.5, width - 0.5, 65), np.linspace(0.5, height - 0.5, 65)
    top, left = np.stack([u, 0 * u + 0.5], 1), np.stack([0 * v + 0.5, v], 1)
    down, right = np.array([0.0, height - 1.0]), np.array([width - 1.0, 0.0])
    return np.concatenate([top, top + down, left, left + right])


def _inside(camera: pycolmap.Camera, border: Array, pinhole: tuple[float, float, float, float]) -> bool:
    raw = _raw(camera, border, pinhole)
    within = (raw >= 0.0) & (raw <= [camera.width, camera.height])
    return bool(np.all(np.isfinite(raw)) and np.all(within))


def _displacement(camera: pycolmap.Camera, pinhole: tuple[float, float, float, float]) -> float:
    """How far the distortion moves a pixel at most [px]."""
    grid = pixel_grid(camera.width, camera.height)[:: max(camera.height // 20, 1), :: max(camera.width // 20, 1)]
    pixels = np.concatenate([grid.reshape(-1, 2), _border(camera.width, camera.height)])
    moved = _raw(camera, pixels, pinhole) - pixels
    return float(np.abs(moved).max()) if np.all(np.isfinite(moved)) else np.inf
