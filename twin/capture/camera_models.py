"""COLMAP camera models: validation, scaling, intrinsics and undistortion.

A *lens* is a camera model with its parameters at one image size. Its *intrinsics* are fx, fy, cx, cy [px]; the other
parameters are its *distortion*. `twin.config.CAMERA_MODELS` lists the models; pycolmap computes the projections. A
*raw* image has the distortion; the *pinhole* image shows the same view without it. The pinhole's focal length is just
large enough that every pinhole pixel lies inside the raw image, so that no pixel is extrapolated.
"""

import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from twin.config import CAMERA_MODELS
from twin.errors import InputError, name_hint
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.images import decode_image, write_image
from twin.geometry.poses import inverse_pose
from twin.types import Array, Image

PixelMap = NDArray[np.float32]
"""For each pixel of the pinhole image, its position in the raw image, (height, width, 2) [px]; as in `cv2.remap`,
(0, 0) is the center of the first pixel."""

_NEGLIGIBLE_DISTORTION = 0.1  # [px] smaller displacements are ignored
_STEP = 0.01  # [m at a depth of 1 m] step outward by which the growth of a distortion is measured
_LEAST_GROWTH = 0.1  # of the distance of a raw pixel from the center; a fisheye lens has this 72° off its axis
_SAME_DIRECTION = 1e-3  # largest difference between a ray (x, y, 1) and the one that its raw pixel shows
_MAX_ZOOM = 4.0  # largest ratio of the pinhole's focal length to that of the lens
_MAX_ASPECT_ERROR = 0.01
_FOCAL_RANGE = (0.05, 8.0)  # plausible focal lengths / longer side; at 8, the angle of view is 7°
_MAX_SIDE = 1_000_000  # [px] largest side of an image


def camera_to_world(camera_from_world: pycolmap.Rigid3d) -> Array:
    """camera_to_world (4, 4) from a COLMAP pose, which maps from world to camera."""
    return inverse_pose(np.vstack([camera_from_world.matrix(), [0.0, 0.0, 0.0, 1.0]]))


# ---- lenses


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model with its parameters in COLMAP's order, and the image size [px] to which they apply."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @property
    def camera(self) -> pycolmap.Camera:
        return pycolmap.Camera(model=self.model, params=list(self.params), width=self.width, height=self.height)

    @property
    def intrinsics(self) -> Array:
        """fx, fy, cx, cy [px], shape (4,)."""
        matrix = self.camera.calibration_matrix()
        return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters other than focal length and principal point."""
        return tuple(self.params[i] for i in self.camera.extra_params_idxs())

    @property
    def is_distorted(self) -> bool:
        return "FISHEYE" in self.model or any(value != 0.0 for value in self.distortion)

    def with_intrinsics(self, intrinsics: Array) -> "Lens":
        """The lens with other fx, fy, cx, cy [px]; a model with one focal length gets the mean of fx and fy."""
        params = list(self.params)
        focal, center = self.camera.focal_length_idxs(), self.camera.principal_point_idxs()
        values = list(intrinsics[:2]) if len(focal) == 2 else [intrinsics[:2].mean()]
        for index, value in zip([*focal, *center], [*values, *intrinsics[2:]], strict=True):
            params[index] = float(value)
        return Lens(self.model, tuple(params), self.width, self.height)

    def scaled(self, width: int, height: int) -> "Lens":
        """The lens for the same image resized to another size [px]."""
        if (width, height) == (self.width, self.height):
            return self
        camera = self.camera
        camera.rescale(width, height)
        return Lens(self.model, tuple(float(p) for p in camera.params), width, height)

    def fits(self, width: int, height: int) -> bool:
        """True if an image of this size [px] has the aspect ratio of the lens, see `same_aspect`."""
        return same_aspect((width, height), (self.width, self.height))


def lens_from_json(entry: dict[str, Any]) -> Lens:
    """The lens from its attributes as JSON, as `vars(lens)` gives them."""
    return Lens(entry["model"], tuple(entry["params"]), entry["width"], entry["height"])


def checked_lens(model: str, params: tuple[float, ...], width: int, height: int, where: str) -> Lens:
    """A validated lens; `where` begins the error messages.

    Raises InputError: unknown model, wrong number of parameters, or implausible values.
    """
    if model not in CAMERA_MODELS:
        hint = name_hint(model, CAMERA_MODELS, f"valid: {', '.join(CAMERA_MODELS)}")
        raise InputError(f"{where}: unknown camera model {model!r}; {hint}")
    if not (0 < width < _MAX_SIDE and 0 < height < _MAX_SIDE):
        raise InputError(f"{where}: image size {width}x{height}; give the size [px] of the calibration images")
    camera = pycolmap.Camera.create_from_model_name(0, model, 1.0, width, height)
    if len(params) != len(camera.params):
        raise InputError(
            f"{where}: {len(params)} parameters for {model}; expected {len(camera.params)}: {camera.params_info}"
        )
    lens = Lens(model, tuple(float(p) for p in params), int(width), int(height))
    if not all(map(math.isfinite, lens.params)):
        raise InputError(f"{where}: a parameter of the {model} camera is not a finite number; calibrate again")
    fx, fy, cx, cy = lens.intrinsics
    longer = max(width, height)
    wrong = [f for f in (fx, fy) if not _FOCAL_RANGE[0] * longer < f < _FOCAL_RANGE[1] * longer]
    if wrong:
        raise InputError(
            f"{where}: focal length {fx:g}, {fy:g} px for {width}x{height}, {wrong[0] / longer:.3g} times the "
            "longer side (phones have 0.6 to 1); give it in px of that size"
        )
    if not (-0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
        raise InputError(
            f"{where}: principal point {cx:g}, {cy:g} px lies far outside {width}x{height}; check the parameters' order"
        )
    return lens


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """True if two sizes (width, height) [px] have the same aspect ratio, to 1 % or to one pixel of a side."""
    error = abs(a[0] * b[1] - a[1] * b[0])
    return error <= max(_MAX_ASPECT_ERROR * a[0] * b[1], a[0], a[1], b[0], b[1])


# ---- undistortion


def undistortion(lens: Lens) -> tuple[Lens, PixelMap | None]:
    """The pinhole lens that replaces a lens at the same size, and its pixel map.

    The map is None if the distortion is negligible. Raises InputError: the distortion is so strong that no pinhole view
    fits into the raw image.
    """
    pinhole = _fitted_pinhole(lens)
    if lens.camera.is_undistorted() or _max_displacement(lens, pinhole) < _NEGLIGIBLE_DISTORTION:
        return pinhole, None
    grid = pixel_grid(lens.width, lens.height)
    raw = raw_pixels(lens, unproject(grid.reshape(-1, 2), pinhole.intrinsics))
    return pinhole, (raw - 0.5).reshape(grid.shape).astype(np.float32)


def undistorted(image: Image, lens: Lens, nearest: bool = False) -> tuple[Image, Lens]:
    """Undistorts an image (h, w) or (h, w, 3) at the lens's size; returns it with its pinhole lens of the same size.

    `nearest` selects nearest-neighbor sampling, for masks.
    """
    pinhole, pixel_map = undistortion(lens)
    if pixel_map is not None:
        image = _remapped(image, pixel_map, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)
    return image, pinhole


def write_pinhole_image(raw: Path, target: Path, pixel_map: PixelMap | None, mask: bool = False) -> None:
    """Writes an image or mask without distortion; without a pixel map, hard-links or copies the file."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if pixel_map is None:
        try:
            os.link(raw, target)
        except OSError:
            shutil.copyfile(raw, target)
        return
    flags = cv2.IMREAD_GRAYSCALE if mask else cv2.IMREAD_ANYCOLOR
    image = decode_image(raw, flags, "delete the build folder and build again")
    image = _remapped(image, pixel_map, cv2.INTER_NEAREST if mask else cv2.INTER_CUBIC)
    write_image(target, image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _remapped(image: Image, pixel_map: PixelMap, method: int) -> Image:
    return np.asarray(cv2.remap(image, pixel_map, None, method, borderMode=cv2.BORDER_REPLICATE), np.uint8)  # type: ignore[call-overload]


def _fitted_pinhole(lens: Lens) -> Lens:
    fx, fy, cx, cy = lens.intrinsics

    def zoomed(factor: float) -> Lens:
        return Lens("PINHOLE", (float(fx * factor), float(fy * factor), float(cx), float(cy)), lens.width, lens.height)

    if lens.camera.is_undistorted() or _max_displacement(lens, zoomed(1.0)) < _NEGLIGIBLE_DISTORTION:
        return zoomed(1.0)
    border = border_pixels(lens)
    low, high = 0.5, _MAX_ZOOM
    if not _fits_inside(lens, border, zoomed(high)):
        raise InputError(
            f"camera {lens.model} {[round(p, 4) for p in lens.params]}: no pinhole view fits into it; "
            "check the calibration, or give a fisheye model for a fisheye lens"
        )
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _fits_inside(lens, border, zoomed(middle)) else (middle, high)
    return zoomed(high)


def raw_pixels(lens: Lens, rays: Array) -> Array:
    """Pixels (n, 2) of a raw image that show the directions (n, 3)."""
    return np.asarray(lens.camera.img_from_cam(rays))


def border_pixels(lens: Lens) -> Array:
    """Pixels along the border of a lens's images, shape (n, 2)."""
    u, v = np.linspace(0.5, lens.width - 0.5, 65), np.linspace(0.5, lens.height - 0.5, 65)
    rows = [np.stack([u, np.full_like(u, y)], 1) for y in (v[0], v[-1])]
    columns = [np.stack([np.full_like(v, x), v], 1) for x in (u[0], u[-1])]
    return np.concatenate(rows + columns)


def _fits_inside(lens: Lens, pixels: Array, pinhole: Lens) -> bool:
    """True if a pinhole camera's pixels show what is in the lens's image.

    Far from the center, a polynomial's distortion may run back into the image, where other directions are seen. So the
    raw pixels must show the directions that they were computed from, and larger angles must be farther out.
    """
    rays = unproject(pixels, pinhole.intrinsics)
    raw = raw_pixels(lens, rays)
    if not np.all((raw >= 0.0) & (raw <= [lens.width, lens.height])):
        return False
    if not np.all(np.abs(np.asarray(lens.camera.cam_from_img(raw)) - rays[:, :2]) < _SAME_DIRECTION):
        return False
    outward = rays[:, :2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1, keepdims=True), 1e-9)
    farther = raw_pixels(lens, rays + _STEP * np.pad(outward, ((0, 0), (0, 1))))
    growth = ((farther - raw) / lens.intrinsics[:2] * outward).sum(1) / _STEP  # 1 without distortion
    return bool(np.all(growth > _LEAST_GROWTH))


def _max_displacement(lens: Lens, pinhole: Lens) -> float:
    """Largest displacement of a pixel by the distortion [px]."""
    grid = pixel_grid(lens.width, lens.height)[:: max(lens.height // 20, 1), :: max(lens.width // 20, 1)]
    pixels = np.concatenate([grid.reshape(-1, 2), border_pixels(lens)])
    moved = raw_pixels(lens, unproject(pixels, pinhole.intrinsics)) - pixels
    return float(np.abs(moved).max()) if np.all(np.isfinite(moved)) else np.inf
