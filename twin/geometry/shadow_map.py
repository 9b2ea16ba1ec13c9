"""Shadows of a place that the sun throws, from a map of what the sun reaches.

A *shadow map* stores the parts of a place that the sun reaches, as an orthographic height map seen from the sun. The
sun's plane is perpendicular to the direction towards the sun. Its axes are `right`, which is horizontal, and `upward`.
A texel stores the largest *height*, the coordinate along the direction towards the sun, of all surfaces in it. A point
is in shadow if the map is higher than the point by more than a bias, which absorbs the errors of surfaces. A point is
compared with several texels, and the results are averaged (percentage-closer filtering, Reeves et al. 1987), so that
the edges of shadows are soft.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, arg-type, call-overload, operator"
# (mypy does not know the types that Warp uses inside kernels)

import base64
import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry.mesh_rays import Surface, vectors
from twin.types import Array, Array32
from twin.warp_runtime import wp

TEXEL = 0.15  # [m] side of a texel
BIAS = 0.3  # [m] height by which the map must exceed a point for a shadow: the error of a radiance field's surfaces
ROUGH_BIAS = 0.5  # [m] additional bias of rough surfaces, see `ShadowCasters`
_RAMP = 0.2  # [m] height above the bias over which the shadow becomes full
_LEAST_COSINE = wp.constant(0.1)  # lower bound of the cosine of incidence when a slope is computed
_MAX_SIDE = 4096  # [texels] longest side of a map; larger places get larger texels
_FULL = 65535  # largest value of a stored texel; 0: no surface
_BATCH = 1 << 16  # number of rays that are cast at once; bounds the memory
_START = 1.0  # [m] distance from the highest vertex to the plane from which rays are cast


@wp.kernel
def _look_up(
    height: wp.array2d(dtype=float),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    right: wp.vec3,
    upward: wp.vec3,
    toward: wp.vec3,
    origin: wp.vec2,
    texel: float,
    bias: float,
    ramp: float,
    out: wp.array(dtype=float),
):
    """Fraction of the sunlight at a point: the mean over a square of three texels' side around it.

    A texel's height is compared with that of the surface's plane at the texel's center, so that slopes do not shadow
    themselves. If the normal is (0, 0, 0), the plane is perpendicular to the light.
    """
    i = wp.tid()
    p, n = points[i], normals[i]
    facing = wp.dot(n, toward)
    slope_right, slope_upward = float(0.0), float(0.0)
    if facing > 0.0:
        facing = wp.max(facing, _LEAST_COSINE)
        slope_right = -wp.dot(n, right) / facing * texel
        slope_upward = -wp.dot(n, upward) / facing * texel
    column, row = (wp.dot(p, right) - origin[0]) / texel, (wp.dot(p, upward) - origin[1]) / texel
    level = wp.dot(p, toward) + bias
    first_column, first_row = int(wp.floor(column)) - 1, int(wp.floor(row)) - 1
    across, along = column - wp.floor(column), row - wp.floor(row)
    dark = float(0.0)
    for a in range(4):
        y = first_row + a
        wide = float(1.0)
        if a == 0:
            wide = 1.0 - along
        if a == 3:
            wide = along
        for b in range(4):
            x = first_column + b
            weight = wide
            if b == 0:
                weight = wide * (1.0 - across)
            if b == 3:
                weight = wide * across
            if x >= 0 and y >= 0 and x < height.shape[1] and y < height.shape[0]:
                plane = level + slope_right * (float(x) - column) + slope_upward * (float(y) - row)
                dark += weight * wp.clamp((height[y, x] - plane) / ramp, 0.0, 1.0)
    out[i] = 1.0 - dark / 9.0


@dataclass(frozen=True)
class OrthographicShadowMap:
    """Height map of a place seen from the sun."""

    toward: Array  # unit vector towards the sun, shape (3,)
    origin: Array  # coordinates of the center of the first texel along `right` and `upward` [m], shape (2,)
    texel: float  # side of a texel [m]
    height: Array32  # largest coordinate along `toward` in each texel [m], −inf where nothing is; shape (rows, columns)

    @cached_property
    def _height(self) -> Any:
        """`height` for the kernel, without infinities."""
        return wp.array(np.maximum(self.height, np.float32(-1e9)), dtype=float, device="cpu")

    def visibility(self, points: NDArray, normals: NDArray | None = None) -> Array32:
        """Fraction of the sunlight that reaches points (n, 3) [m], shape (n,); 1 outside the map.

        If the unit normals (n, 3) of the surfaces at the points are given, slopes do not shadow themselves.
        """
        facing = np.zeros(points.shape) if normals is None else normals
        axes = (wp.vec3(*axis.tolist()) for axis in (*plane_axes(self.toward), self.toward))
        where = [vectors(points), vectors(facing), *axes, wp.vec2(*self.origin.tolist())]
        inputs = [self._height, *where, self.texel, BIAS, _RAMP]
        out = wp.empty(len(points), dtype=float, device="cpu")
        wp.launch(_look_up, len(points), inputs=inputs, outputs=[out], device="cpu")
        return out.numpy()

    def to_json(self) -> dict[str, Any]:
        """The map for a JSON file; heights are rounded to 1/65534 of their range and stored as a PNG."""
        seen = np.isfinite(self.height)
        low, high = (float(f(self.height[seen], initial=0.0)) for f in (np.min, np.max))
        step = max(high - low, 1e-6) / (_FULL - 1)
        image = np.where(seen, np.rint((np.where(seen, self.height, low) - low) / step) + 1, 0).astype(np.uint16)
        content = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode("ascii")
        place = {"toward": self.toward.tolist(), "origin_m": self.origin.tolist(), "texel_m": self.texel}
        return {**place, "low_m": low, "step_m": step, "png": content}

    @staticmethod
    def from_json(table: dict[str, Any]) -> "OrthographicShadowMap":
        """Reads the result of `to_json`. Raises ValueError, KeyError or TypeError if it is damaged."""
        toward, origin = (np.array(table[name], np.float64) for name in ("toward", "origin_m"))
        texel, low, step = (float(table[name]) for name in ("texel_m", "low_m", "step_m"))
        if toward.shape != (3,) or abs(np.linalg.norm(toward) - 1.0) > 1e-6 or not toward[2] > 0.0:
            raise ValueError(f"sun {toward.tolist()}; expected a unit vector above the horizon")
        if origin.shape != (2,) or not np.isfinite([*origin, texel, low, step]).all() or min(texel, step) <= 0.0:
            raise ValueError(f"shadow map: origin {origin.tolist()}, texel {texel} m, step {step} m; expected > 0")
        data = np.frombuffer(base64.b64decode(table["png"], validate=True), np.uint8)
        image = None
        with contextlib.suppress(cv2.error):  # no data, or a size that OpenCV refuses
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16 or image.ndim != 2 or max(image.shape) > _MAX_SIDE + 1:
            raise ValueError(f"shadow map: expected a 16-bit gray picture, at most {_MAX_SIDE + 1} px a side")
        height = np.where(image > 0, low + step * (image.astype(np.float64) - 1.0), -np.inf).astype(np.float32)
        return OrthographicShadowMap(toward, origin, texel, height)


class ShadowCasters:
    """Surfaces of a place that throw shadows; `seen_from` makes the map for any sun.

    *Rough* surfaces have larger errors. Their bias is larger by `ROUGH_BIAS`, so that they do not shadow the accurate
    surfaces beside them.
    """

    def __init__(
        self, vertices: Array, faces: NDArray, rough_vertices: Array | None = None, rough_faces: NDArray | None = None
    ) -> None:
        """Vertices have shape (n, 3) [m], faces (m, 3)."""
        parts = [(vertices, faces, 0.0)]
        if rough_vertices is not None and rough_faces is not None:
            parts.append((rough_vertices, rough_faces, ROUGH_BIAS))
        self._parts = [
            (np.asarray(points, np.float64)[np.unique(index)], Surface(np.asarray(points), index), bias)
            for points, index, bias in parts
            if len(index)
        ]

    def seen_from(self, toward: Array, texel: float = TEXEL) -> OrthographicShadowMap:
        """The map for a sun in the direction of a unit vector (3,), from a ray of the sun through each texel.

        `texel` [m] grows for a wide place.
        """
        toward = np.asarray(toward, np.float64) / np.linalg.norm(toward)
        if not self._parts:
            return OrthographicShadowMap(toward, np.zeros(2), texel, np.full((1, 1), -np.inf, np.float32))
        right, upward = plane_axes(toward)
        axes = np.stack([right, upward, toward], 1)
        corners = np.array([[f(points @ axes, axis=0) for f in (np.min, np.max)] for points, _, _ in self._parts])
        low, high = corners[:, 0, :2].min(0), corners[:, 1, :2].max(0)
        texel = max(texel, float((high - low).max()) / (_MAX_SIDE - 1))
        columns, rows = np.ceil((high - low) / texel).astype(int) + 1
        start = float(corners[:, 1, 2].max()) + _START
        u, v = low[0] + texel * np.arange(columns), low[1] + texel * np.arange(rows)
        height = np.full((rows, columns), -np.inf, np.float32)
        step = max(1, _BATCH // int(columns))
        for first in range(0, int(rows), step):
            band = slice(first, first + step)
            origins = (u[None, :, None] * right + v[band, None, None] * upward + start * toward).reshape(-1, 3)
            rays = np.broadcast_to(-toward, origins.shape)
            for _, surface, bias in self._parts:
                hit = surface.cast(origins, rays).reshape(-1, columns)
                seen = np.where(hit < 0.0, -np.inf, start - hit - bias).astype(np.float32)
                height[band] = np.maximum(height[band], seen)
        return OrthographicShadowMap(toward, low, texel, height)


def plane_axes(toward: Array) -> tuple[Array, Array]:
    """Unit axes `right` (horizontal) and `upward` of the plane perpendicular to a unit vector (3,)."""
    right = np.cross([0.0, 0.0, 1.0], toward)
    size = float(np.linalg.norm(right))
    right = right / size if size > 1e-6 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(toward, right)


def direction(azimuth: float, elevation: float) -> Array:
    """Unit vector (3,) at an azimuth, counterclockwise from the x axis, and an elevation [°]."""
    a, e = np.deg2rad([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def angles(toward: Array) -> tuple[float, float]:
    """Azimuth in [0, 360) and elevation [°] of a unit vector (3,)."""
    azimuth = float(np.rad2deg(np.arctan2(toward[1], toward[0]))) % 360.0
    return azimuth, float(np.rad2deg(np.arcsin(np.clip(toward[2], -1.0, 1.0))))
