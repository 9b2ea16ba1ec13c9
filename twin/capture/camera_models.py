"""Camera models by COLMAP's names: checked, scaled, read as a matrix, and taken out of a picture.

A *lens* is a camera model with its parameters at one image size. Its *intrinsics* are fx, fy, cx, cy [px]; what is left
of the parameters is its *distortion*.
"""

import difflib
import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.capture.pycolmap_import import pycolmap
from twin.config import CAMERA_MODELS
from twin.errors import InputError
from twin.geometry.cameras import pixel_grid
from twin.geometry.images import decoded, write_image
from twin.types import Array, Image

# ---- From a lens with distortion to a pinhole of the same size.
#
# The *raw* image has the lens's distortion; the *pinhole* image is what a perfect pinhole at the same place would see.
# Its focal length is raised just enough that no pixel of it lies outside the raw image, so nothing has to be filled in.


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


_MODELS = tuple(CAMERA_MODELS)
_MAX_ASPECT_ERROR = 0.01
_MOST_SIDE = 1_000_000  # [px]


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model, its parameters in COLMAP's order, and the image size they are for [px]."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @property
    def camera(self) -> pycolmap.Camera:
        """The same as COLMAP's own object."""
        camera = pycolmap.Camera.create_from_model_name(0, self.model, 1.0, self.width, self.height)
        camera.params = np.array(self.params)  # type: ignore[assignment]
        return camera

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy [px], shape (4,)."""
        matrix = self.camera.calibration_matrix()
        return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters beyond focal length and principal point."""
        return tuple(self.params[i] for i in self.camera.extra_params_idxs())

    @property
    def is_distorted(self) -> bool:
        return self.model not in ("SIMPLE_PINHOLE", "PINHOLE") and (
            "FISHEYE" in self.model or any(value != 0.0 for value in self.distortion)
        )

    def with_intrinsics(self, intrinsics: NDArray[np.float64]) -> "Lens":
        """The same model and distortion with other fx, fy, cx, cy [px]; where there is one focal length, the mean."""
        params = list(self.params)
        focal, center = self.camera.focal_length_idxs(), self.camera.principal_point_idxs()
        values = list(intrinsics[:2]) if len(focal) == 2 else [intrinsics[:2].mean()]
        for index, value in zip([*focal, *center], [*values, *intrinsics[2:]], strict=True):
            params[index] = float(value)
        return Lens(self.model, tuple(params), self.width, self.height)

    def scaled(self, width: int, height: int) -> "Lens":
        """The lens of the same picture resized to another size [px]."""
        if (width, height) == (self.width, self.height):
            return self
        camera = self.camera
        camera.rescale(width, height)
        return Lens(self.model, tuple(float(p) for p in camera.params), width, height)

    def fits(self, width: int, height: int) -> bool:
        """True where an image of this size is the lens's picture, scaled: the aspect agrees within 1 %."""
        return same_aspect((width, height), (self.width, self.height))


def checked_lens(model: str, params: tuple[float, ...], width: int, height: int, where: str) -> Lens:
    """A lens whose model is known and whose numbers make sense.

    Raises:
        InputError: unknown model, wrong number of parameters, or values no camera has; `where` opens the message.
    """
    if model not in _MODELS:
        near = difflib.get_close_matches(model.upper(), _MODELS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(_MODELS)}"
        raise InputError(f"{where}: unknown camera model {model!r}; {hint}")
    if not (0 < width < _MOST_SIDE and 0 < height < _MOST_SIDE):
        raise InputError(f"{where}: image size {width}x{height}; give the width and height the calibration is for [px]")
    camera = pycolmap.Camera.create_from_model_name(0, model, 1.0, width, height)
    if len(params) != len(camera.params):
        raise InputError(
            f"{where}: {len(params)} parameters for {model}; expected {len(camera.params)}: {camera.params_info}"
        )
    lens = Lens(model, tuple(float(p) for p in params), int(width), int(height))
    if not all(math.isfinite(p) for p in lens.params):
        raise InputError(f"{where}: a parameter of the {model} camera is not a finite number; calibrate again")
    fx, fy, cx, cy = lens.intrinsics
    longer = max(width, height)
    if not (0.05 * longer < fx < 100 * longer and 0.05 * longer < fy < 100 * longer):
        raise InputError(f"{where}: focal length {fx:g}, {fy:g} px for {width}x{height}; expected pixels of that size")
    if not (-0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
        raise InputError(
            f"{where}: principal point {cx:g}, {cy:g} px lies far outside {width}x{height}; check the order"
        )
    return lens


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """True where two sizes (width, height) [px] are one picture at two scales, to 1 % or a rounded pixel."""
    error = abs(a[0] * b[1] - a[1] * b[0])
    return error <= max(_MAX_ASPECT_ERROR * a[0] * b[1], a[0], a[1], b[0], b[1])


def flattened(image: Image, lens: Lens, nearest: bool = False) -> tuple[Image, Lens]:
    """An image of a distorted lens, and the pinhole lens of the same size it is resampled to.

    Args:
        image: Shape (h, w) or (h, w, 3), at the lens's size.
        lens: The lens that took it.
        nearest: True for masks, whose values must not be mixed.
    """
    pinhole = pinhole_of(lens.camera)
    maps = undistortion_map(lens.camera, pinhole)
    if maps is not None:
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        image = np.asarray(cv2.remap(image, maps, None, how, borderMode=cv2.BORDER_REPLICATE), np.uint8)  # type: ignore[call-overload]
    return image, Lens("PINHOLE", pinhole, lens.width, lens.height)
