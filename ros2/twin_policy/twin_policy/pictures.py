"""Pictures of a robot's camera: decoded, rectified and scaled to the camera that a policy was trained with.

Decoded pictures are RGB, uint8, shape (height, width, 3). In a `Camera`, pixel (0, 0) is the outer corner of the
top-left pixel, as in `twin` and COLMAP; in ROS's CameraInfo it is that pixel's center, and cx and cy are 0.5 smaller.
Distortion models are those of CameraInfo.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

# Number of channels, and OpenCV's conversion to RGB.
_PACKED = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
}
# OpenCV names a Bayer pattern by its second row and column, ROS by its first.
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}
# The colors follow the brightness, in half as many rows.
_PLANAR = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
ENCODINGS = (*_PACKED, *_BAYER, *_YUV, *_PLANAR)
"""Supported encodings of raw pictures."""

_COEFFICIENTS = {"": (0,), "none": (0,), "plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_MAX_SIDE = 16_384  # [px] largest side of a picture
_MAX_OVERSAMPLING = 16  # largest number of samples per pixel and axis
_EXACT = 1e-6  # [px] intrinsics that differ by less count as equal


class PictureError(ValueError):
    """A picture or a camera that cannot be used. The message is one line."""


@dataclass(frozen=True)
class RawPicture:
    """An uncompressed picture, as in sensor_msgs/Image."""

    encoding: str
    width: int
    height: int
    step: int
    """Bytes per row, padding included."""
    data: Any
    """Bytes, or an array of them."""

    def decode(self) -> np.ndarray:
        """Returns RGB, uint8, shape (height, width, 3). Raises PictureError."""
        name, width, height = self.encoding, self.width, self.height
        if name not in ENCODINGS:
            raise PictureError(f"encoding {name!r}; expected one of {', '.join(ENCODINGS)}")
        channels, code = _PACKED.get(name, (2 if name in _YUV else 1, (_BAYER | _YUV | _PLANAR).get(name)))
        lines = height + height // 2 if name in _PLANAR else height
        flat = np.frombuffer(self.data, np.uint8)
        sides = 1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE
        if not sides or self.step < width * channels or len(flat) < self.step * lines:
            raise PictureError(
                f"{name} picture of {width} x {height} px with {self.step} bytes a row has {len(flat)} bytes; expected "
                f"{width * channels} a row or more, and {max(self.step, width * channels) * lines} in all"
            )
        rows = flat[: self.step * lines].reshape(lines, self.step)[:, : width * channels]
        picture = np.ascontiguousarray(rows).reshape(lines, width, channels)
        odd = width % 2 or (height % 2 and name not in _YUV)
        if name not in _PACKED and (odd or min(width, height) < 4):
            raise PictureError(f"{name} picture of {width} x {height} px; expected even sides of 4 px or more")
        return picture if code is None else cv2.cvtColor(picture, code)


@dataclass(frozen=True)
class CompressedPicture:
    """A JPEG or PNG file, as in sensor_msgs/CompressedImage."""

    data: Any
    """Bytes, or an array of them."""

    def decode(self) -> np.ndarray:
        """Returns RGB, uint8, shape (height, width, 3). Raises PictureError."""
        flat = np.frombuffer(self.data, np.uint8)
        try:
            picture = cv2.imdecode(flat, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if len(flat) else None
        except cv2.error as error:
            raise PictureError(f"picture of {len(flat)} bytes: {str(error).splitlines()[0]}") from None
        if picture is None:
            raise PictureError(f"{len(flat)} bytes are neither a JPEG nor a PNG picture")
        return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


@dataclass(frozen=True)
class Camera:
    """A camera with its distortion. Raises PictureError: invalid values."""

    size: tuple[int, int]
    """Width, height [px]."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]; (0, 0) is the outer corner of the top-left pixel."""
    model: str = ""
    """plumb_bob, rational_polynomial, equidistant (fisheye), or empty for no distortion."""
    distortion: tuple[float, ...] = ()
    """Coefficients in the order of CameraInfo: k1, k2, p1, p2, k3, ..., or k1 to k4 of equidistant; empty: zeros."""

    def __post_init__(self) -> None:
        numbers = np.array([*self.size, *self.intrinsics, *self.distortion], float)
        if not np.isfinite(numbers).all() or min(*self.size, *self.intrinsics[:2]) <= 0 or max(self.size) > _MAX_SIDE:
            raise PictureError(
                f"camera of {self.size} px with intrinsics {self.intrinsics} and distortion {self.distortion}; "
                "expected finite numbers, and fx, fy > 0: is the camera calibrated?"
            )
        if self.model not in _COEFFICIENTS:
            raise PictureError(f"distortion model {self.model!r}; expected {', '.join(filter(None, _COEFFICIENTS))}")
        if len(self.distortion) not in _COEFFICIENTS[self.model] and any(self.distortion):
            counts = " or ".join(map(str, _COEFFICIENTS[self.model]))
            raise PictureError(f"{len(self.distortion)} coefficients of {self.model!r}; expected {counts}")

    @staticmethod
    def from_info(info: Any, rectified: bool = False) -> "Camera":
        """The camera of a sensor_msgs/CameraInfo (ROS 2's fields, or ROS 1's).

        `rectified`: the pictures were rectified by image_proc, so their camera is the matrix P.
        """
        k, p, d = (getattr(info, name, getattr(info, name.upper(), ())) for name in "kpd")
        k, p = list(map(float, k)), list(map(float, p))
        if len(k) != 9 or (rectified and len(p) != 12):
            raise PictureError(f"CameraInfo with {len(k)} numbers in K and {len(p)} in P; expected 9 and 12")
        fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if rectified else (k[0], k[4], k[2], k[5])
        roi = info.roi
        across, down = max(1, int(info.binning_x)), max(1, int(info.binning_y))
        x, y = int(roi.x_offset), int(roi.y_offset)
        width, height = int(roi.width) or int(info.width), int(roi.height) or int(info.height)
        intrinsics = (fx / across, fy / down, (cx + 0.5 - x) / across, (cy + 0.5 - y) / down)
        model, distortion = ("", ()) if rectified else (str(info.distortion_model), tuple(map(float, d)))
        return Camera((width // across, height // down), intrinsics, model, distortion)

    def resized(self, size: tuple[int, int]) -> "Camera":
        """The same camera at another size: scaled to its width, cropped or extended to its height about the middle."""
        scale = size[0] / self.size[0]
        fx, fy, cx, cy = (float(x) * scale for x in self.intrinsics)
        cut = (self.size[1] * scale - size[1]) / 2
        return Camera(size, (fx, fy, cx, cy - cut), self.model, self.distortion)

    @property
    def is_distorted(self) -> bool:
        """False for a pinhole camera; a fisheye is distorted also if its coefficients are zero."""
        return self.model == "equidistant" or any(self.distortion)

    def without_distortion(self) -> "Camera":
        return Camera(self.size, self.intrinsics)

    def reach(self) -> float:
        """Largest √(x² + y²) of a ray (x, y, 1) up to which the distortion is one to one."""
        r = np.linspace(0.0, 10.0, 2001)
        turns = np.flatnonzero(np.diff(self.project(r, np.zeros_like(r))[0]) <= 0.0)
        return float(r[turns[0]]) if len(turns) else np.inf

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of rays (x, y, 1), OpenCV axes; arrays of one shape."""
        fx, fy, cx, cy = self.intrinsics
        if self.is_distorted:
            x, y = (_fisheye if self.model == "equidistant" else _radial_tangential)(x, y, self.distortion)
        return fx * x + cx, fy * y + cy


def _radial_tangential(x: np.ndarray, y: np.ndarray, d: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *[0.0] * (8 - len(d)))
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _fisheye(x: np.ndarray, y: np.ndarray, d: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    r = np.hypot(x, y)
    t = np.arctan(r)
    t2 = t * t
    k1, k2, k3, k4 = (*d, *[0.0] * 4)[:4]
    bent = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
    return x * scale, y * scale


class Rectifier:
    """Maps pictures of one camera to a pinhole camera at a policy's size.

    The picture is sampled bilinearly on a grid as fine as the camera's pixels, and blocks of the grid are averaged,
    which avoids aliasing. If both cameras are equal, pictures pass unchanged, bit for bit.
    """

    def __init__(self, camera: Camera, pinhole: Camera, max_outside: float = 0.05) -> None:
        """
        Args:
            camera: Takes the pictures.
            pinhole: The policy's camera and size; its distortion is ignored.
            max_outside: Fraction of the pinhole camera's picture that the camera may not see.

        Raises:
            PictureError: more than `max_outside` of the pinhole camera's picture is outside the camera's.
        """
        self.camera, self.pinhole = camera, pinhole
        (fx, fy, cx, cy), (width, height) = pinhole.intrinsics, pinhole.size
        same = np.abs(np.subtract(camera.intrinsics, pinhole.intrinsics)).max() < _EXACT
        self.is_identity = bool(camera.size == pinhole.size and same and not camera.is_distorted)
        if self.is_identity:
            return
        fine = int(np.clip(round(camera.intrinsics[0] / fx), 1, _MAX_OVERSAMPLING))
        u, v = (np.arange(fine * n) / fine + 0.5 / fine for n in (width, height))
        x, y = np.meshgrid((u - cx) / fx, (v - cy) / fy)
        column, row = camera.project(x, y)
        outside = (column < 0) | (column > camera.size[0]) | (row < 0) | (row > camera.size[1])
        outside |= np.hypot(x, y) > camera.reach()
        if outside.mean() > max_outside:
            raise PictureError(
                f"the camera does not see {outside.mean():.0%} of the policy's picture; expected at most "
                f"{max_outside:.0%}: enter its intrinsics in [robot], build, train and validate with them"
            )
        # OpenCV counts pixels from the center of the first one.
        column, row = ((one - 0.5).astype(np.float32) for one in (column, row))
        self._columns_rows, self._fractions = cv2.convertMaps(column, row, cv2.CV_16SC2)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """RGB (h, w, 3) of the camera → RGB of the pinhole camera. Raises PictureError: another size."""
        if picture.shape != (*self.camera.size[::-1], 3) or picture.dtype != np.uint8:
            raise PictureError(
                f"picture {picture.shape} {picture.dtype}; expected {self.camera.size[1]} x {self.camera.size[0]} px "
                "RGB uint8, as its camera_info says"
            )
        if self.is_identity:
            return picture
        near = cv2.BORDER_REPLICATE
        fine = cv2.remap(picture, self._columns_rows, self._fractions, cv2.INTER_LINEAR, borderMode=near)
        return cv2.resize(fine, self.pinhole.size, interpolation=cv2.INTER_AREA)
