"""Sun of an added lighting: a gain that turns pictures of the field into pictures under another sun.

A field stores the colors of its films, with their light and shadows in them. The picture under another sun is the
picture under the lighting's embedding times a gain. The gain of each color channel is a sum of terms:

    level surfaces:  ambient + level · visibility · max(0, n · s)
    other surfaces:  ambient + direct · visibility · max(0, n · s)
    far view, sky:   base + toward · ((1 + d · s) / 2)⁴ + up · max(0, d_z)

The coefficients `level` and `direct` differ if the ground lies in shadows of unfilmed objects, or if its color
saturates. Here n is the normal of the surface, s the direction towards the sun, d the direction of view. The visibility
comes from a shadow map (`geometry/shadow_map.py`). Between the z-depths `_NEAR` and `_FAR`, the gain is interpolated
between the sums for the surface and for the far view. The coefficients are fitted to a photo (`sun_fit.py`). They are
ratios to the light of the film, in the film's tone curve.

The direction of the sun may be computed from time and place. Compass angles are clockwise from north. The *heading* of
a scene is the compass angle of its x axis. Azimuths in the scene are counterclockwise from its x axis.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.shadow_map import OrthographicShadowMap, direction
from twin.types import Array, Array32

TERMS = ("ambient", "direct", "base", "toward", "up", "level")
"""Names of the terms of the gain."""
MIN_GAIN, MAX_GAIN = 0.1, 4.0
"""Limits of the gain."""
_NEAR, _FAR = 30.0, 60.0  # [m] z-depths: only the sum for surfaces counts below the first, only the far view's above
_GLOW = 4  # exponent of the brightening towards the sun
_SMOOTHING = 9 / 160  # [widths of the picture] window over which points are averaged before normals are computed
_LEVEL = (0.75, 0.92)  # upward component of unit normals: below the first, surfaces are steep; above the second, level
_MAX_ENTRY = 100.0  # largest absolute coefficient in a file


@dataclass(frozen=True, eq=False)
class Sun:
    """A sun with the gain by which it changes pictures of a field under one embedding."""

    shadows: OrthographicShadowMap
    """The parts of the place that the sun reaches, and its direction."""
    coefficients: Array32
    """Coefficients of `TERMS` for red, green and blue, shape (6, 3)."""

    @property
    def toward(self) -> Array:
        """Unit vector towards the sun, shape (3,)."""
        return self.shadows.toward

    def gain(self, points: Array, normals: Array) -> tuple[Array32, Array32]:
        """Gain of near surfaces at points (n, 3) [m] with unit normals (n, 3), shape (n, 3).

        Also returns the fraction of the gain due to direct light, averaged over the channels, shape (n,).
        """
        level = _levelness(normals)[:, None]
        color = level * self.coefficients[5] + (1.0 - level) * self.coefficients[1]
        direct = lit_cosine(self.shadows, points, normals)[:, None] * color
        gain = np.clip(self.coefficients[0] + direct, MIN_GAIN, MAX_GAIN)
        return gain, (direct / gain).mean(1)

    def to_json(self) -> dict[str, Any]:
        """The sun for a JSON file."""
        values = self.coefficients.astype(np.float64).round(6)
        return {
            "coefficients": dict(zip(TERMS, values.tolist(), strict=True)),
            "shadow_map": self.shadows.to_json(),
        }

    @staticmethod
    def from_json(table: dict[str, Any]) -> "Sun":
        """Reads the result of `to_json`. Raises ValueError, KeyError or TypeError if it is damaged."""
        rows = np.array([table["coefficients"][name] for name in TERMS], np.float32)
        if rows.shape != (len(TERMS), 3) or not (np.abs(rows) <= _MAX_ENTRY).all():
            raise ValueError(f"the sun's coefficients have shape {rows.shape}, not (6, 3), or exceed ±{_MAX_ENTRY:g}")
        return Sun(OrthographicShadowMap.from_json(table["shadow_map"]), rows)


Sunlight = tuple[tuple[Sun, float], ...]
"""Suns with their weights, which sum to at most 1; the rest is the light of the film. Empty: the film's light alone."""


def mixed_sunlight(one: Sunlight, other: Sunlight, share: float) -> Sunlight:
    """Interpolated sunlight, `share` of the way from `one` to `other`."""
    weights: dict[Sun, float] = {}
    for part, factor in ((one, 1.0 - share), (other, share)):
        for sun, weight in part:
            weights[sun] = weights.get(sun, 0.0) + factor * weight
    return tuple((sun, weight) for sun, weight in weights.items() if weight > 0.0)


def main_sun(sunlight: Sunlight) -> Sun | None:
    """The sun with a weight of at least one half; None if there is none."""
    return next((sun for sun, weight in sunlight if weight >= 0.5), None)


def relit(rgb: Array32, depth: Array32, rays: Array, pose: Array, sunlight: Sunlight) -> Array32:
    """Relights a picture of the field.

    Args:
        rgb: Shape (height, width, 3).
        depth: z-depth [m], shape (height, width).
        rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
        pose: camera_to_world, OpenCV axes, shape (4, 4).
        sunlight: The suns; without one, the picture is returned as it is.
    """
    if not sunlight:
        return rgb
    seen = SeenSurfaces.of(depth, rays, pose)
    gain = np.float32(1.0 - sum(weight for _, weight in sunlight))
    for sun, weight in sunlight:
        terms = seen.terms(sun.shadows)
        gain = gain + np.float32(weight) * np.clip(terms @ sun.coefficients, MIN_GAIN, MAX_GAIN)
    return rgb * gain.reshape(rgb.shape)


@dataclass(frozen=True)
class SeenSurfaces:
    """Surfaces that the n pixels of a picture show."""

    points: Array32
    """[m], shape (n, 3); no deeper than `_FAR`."""
    normals: Array32
    """Unit normals towards the camera, shape (n, 3)."""
    directions: Array32
    """Unit vectors along the rays, shape (n, 3)."""
    far: Array32
    """Weight of the far view, shape (n,)."""

    @staticmethod
    def of(depth: Array32, rays: Array, pose: Array) -> "SeenSurfaces":
        """The surfaces in a picture; arguments as for `relit`."""
        turned = (rays @ pose[:3, :3].T).astype(np.float32)
        around = turned * np.minimum(depth, np.float32(_FAR))[..., None]
        directions = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        far = np.clip((depth - _NEAR) / (_FAR - _NEAR), 0.0, 1.0).astype(np.float32)
        points = around + pose[:3, 3].astype(np.float32)
        return SeenSurfaces(
            *(points.reshape(-1, 3), _normals(around).reshape(-1, 3), directions.reshape(-1, 3), far.ravel())
        )

    def subset(self, rows: NDArray) -> "SeenSurfaces":
        """Surfaces in some of the pixels."""
        return SeenSurfaces(self.points[rows], self.normals[rows], self.directions[rows], self.far[rows])

    def terms(self, shadows: OrthographicShadowMap) -> Array32:
        """The terms of the gain at each pixel under a sun, shape (n, 6)."""
        near, toward = np.float32(1.0) - self.far, shadows.toward.astype(np.float32)
        out = np.zeros((len(near), len(TERMS)), np.float32)
        out[:, 0] = near
        close = np.flatnonzero(near)
        lit = near[close] * lit_cosine(shadows, self.points[close], self.normals[close])
        level = _levelness(self.normals[close])
        out[close, 1], out[close, 5] = (1.0 - level) * lit, level * lit
        away = np.flatnonzero(self.far)
        far, directions = self.far[away], self.directions[away]
        out[away, 2] = far
        out[away, 3] = far * (0.5 + 0.5 * (directions @ toward)) ** _GLOW
        out[away, 4] = far * np.maximum(directions[:, 2], 0.0)
        return out


def lit_cosine(shadows: OrthographicShadowMap, points: NDArray, normals: NDArray) -> Array32:
    """Visibility of the sun times the cosine of its incidence, at points (n, 3) [m] with unit normals (n, 3); (n,)."""
    cosine = np.maximum(normals.astype(np.float32) @ shadows.toward.astype(np.float32), 0.0)
    facing = np.flatnonzero(cosine > 0.0)
    cosine[facing] *= shadows.visibility(points[facing], normals[facing])
    return cosine


def _levelness(normals: NDArray) -> NDArray:
    """1 for level surfaces, 0 for steep ones; normals (..., 3) → (...)."""
    low, high = _LEVEL
    return np.clip((normals[..., 2] - low) / (high - low), 0.0, 1.0)


def surface_normals(points: Array32, window: int) -> Array32:
    """Unit normals, towards the camera, of the surface through points relative to it, shape (height, width, 3).

    The points are averaged over `window`² pixels.
    """
    smooth = cv2.blur(points, (window, window), borderType=cv2.BORDER_REPLICATE)
    down, across = np.gradient(smooth, axis=(0, 1))
    normal = np.cross(down, across)
    squares, towards = (np.einsum("...i,...i", normal, other) for other in (normal, smooth))
    return normal * (-np.sign(towards) / np.sqrt(np.maximum(squares, 1e-18)))[..., None]


def _normals(points: Array32) -> Array32:
    """The `surface_normals` for relighting, shape (height, width, 3).

    Level surfaces get a vertical normal, since the ground in a radiance field is rough.
    """
    normal = surface_normals(points, max(3, 2 * round(_SMOOTHING * points.shape[1] / 2) + 1))
    normal += _levelness(normal)[..., None] * (np.array([0.0, 0.0, 1.0], np.float32) - normal)
    return (normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)).astype(np.float32)


# ---- direction from time and place

_YEARS = (1901, 2099)  # years for which the equations of `astral` hold
_MAX_LATITUDE, _MAX_LONGITUDE = 89.9, 180.0  # [°]
_GPS_SPREAD = 5.0  # least ratio of the GPS positions' spread to their error, for a heading
_GPS_SCALE = (0.7, 1.4)  # accepted ratio of distances by GPS to distances in the scene


def parse_time(text: str) -> datetime:
    """A moment from text such as 2026-06-01T17:30+02:00. Raises InputError: another form, or a year out of range."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise InputError(
            f"--time {text!r}: expected date, time and offset from UTC, such as 2026-06-01T17:30+02:00 (Z for UTC)"
        )
    if not _YEARS[0] <= moment.year <= _YEARS[1]:
        raise InputError(f"--time {text!r}: expected a year from {_YEARS[0]} to {_YEARS[1]}")
    return moment


def sun_angles(moment: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """Compass angle [°] and elevation [°] of the sun, with refraction, at a latitude and a longitude [°].

    Raises InputError: latitude or longitude out of range.
    """
    from astral import Observer
    from astral.sun import azimuth, elevation

    if not (abs(latitude) <= _MAX_LATITUDE and abs(longitude) <= _MAX_LONGITUDE):
        raise InputError(
            f"--location {latitude:g},{longitude:g}: expected latitude and longitude in degrees, such as 48.14,11.58"
        )
    observer = Observer(latitude, longitude)
    return float(azimuth(observer, moment)), float(elevation(observer, moment))


def sun_direction(moment: datetime, latitude: float, longitude: float, heading: float) -> Array:
    """Unit vector (3,) towards the sun in a scene with a heading [°].

    Raises InputError: the sun is not above the horizon, or latitude or longitude is out of range.
    """
    compass, elevation = sun_angles(moment, latitude, longitude)
    if not elevation > 0.0:
        raise InputError(
            f"--time {moment.isoformat()}: the sun is {-elevation:.0f}° below the horizon at {latitude:g},{longitude:g}"
            "; correct --time or --location, or leave --time out"
        )
    return direction(heading - compass, elevation)


def heading_from_gps(positions: Array, east_north: Array) -> float | None:
    """Heading [°] of a scene from positions of its cameras, in the scene and by GPS, each (n, 2) [m].

    `east_north` is NaN where unknown. None if fewer than three are known or they do not fit.
    """
    known = np.isfinite(east_north).all(1)
    if known.sum() < 3:
        return None
    source, target = ((xy[known] - xy[known].mean(0)) @ np.array([1.0, 1.0j]) for xy in (positions, east_north))
    size = float(np.vdot(source, source).real)
    if size < 1e-9:
        return None
    factor = np.vdot(source, target) / size
    error, spread = np.abs(target - factor * source).std(), np.abs(target).std()
    if not (_GPS_SCALE[0] <= abs(factor) <= _GPS_SCALE[1] and spread >= _GPS_SPREAD * error):
        return None
    # `factor` turns the x axis to the direction with this angle, counterclockwise from east.
    return float(90.0 - np.rad2deg(np.angle(factor))) % 360.0
