"""The road of a place sampled by `place_sampling.py`: the driven line in plan, and the height of the ground on and
around it.

Along the line, the height follows the sampled grades and a slight unevenness; across the line, it follows the sampled
cross section. On the verge, the ground blends into open land, whose height is a weighted mean of the heights of the
whole line, plus swells.
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from twin.reality.place_spec import GRADE_STEP, RUN_IN, RUN_OUT, Mouth, PlaceSpec
from twin.reality.place_streams import stream
from twin.types import Array

_CROWN_ROUNDING = 0.3  # [m] half width of the rounding of a crown
_BUMP_LENGTHS = (5.0, 20.0)  # [m] range of wavelengths of the unevenness
_SWELL_LENGTHS = (25.0, 80.0)  # [m] range of wavelengths of the land's swells
_LAND_SAMPLE = 2.0  # [m] between points of the line whose heights determine the land
_LAND_SMOOTHING = 3.0  # [m] length over which these heights are smoothed
_DROP_LENGTH = 0.8  # [m] over which a curb drops beside a side road
MOUTH_REACH = 26.0  # [m] from the road's edge to the end of a side road
_CHUNK = 40_000  # most points whose land height is computed together
_CHUNK_DISTANCES = 4_000_000  # most distances between points and line that are computed together


class DrawnRoad:
    """The driven line and the ground of a sampled place, as a `place_objects.DrivenLine`."""

    def __init__(self, spec: PlaceSpec) -> None:
        self.spec, self.section, self.line = spec, spec.section, spec.line
        self.length = spec.line.length
        self.start, self.end = -RUN_IN, spec.line.length + RUN_OUT - 2.0
        rng = stream(spec.number, "line", 1)
        lengths = rng.uniform(*_BUMP_LENGTHS, 4)
        self._bumps = np.stack([2 * np.pi / lengths, rng.uniform(0, 2 * np.pi, 4)], 1)
        directions, swells = rng.uniform(0, 2 * np.pi, 4), 2 * np.pi / rng.uniform(*_SWELL_LENGTHS, 4)
        self._swells = np.stack([swells * np.cos(directions), swells * np.sin(directions)], 1)
        self._swell_phases = rng.uniform(0, 2 * np.pi, 4)
        starts, headings, points = [0.0], [0.0], [np.zeros(2)]
        for piece in spec.line.pieces:
            points.append(_advance(points[-1], headings[-1], piece.curvature, piece.length))
            headings.append(headings[-1] + piece.curvature * piece.length)
            starts.append(starts[-1] + piece.length)
        self._starts = np.array(starts)
        self._headings = np.array(headings)
        self._points = np.array(points)
        self._curvatures = np.array([*(piece.curvature for piece in spec.line.pieces), 0.0])

    # ---- plan

    def heading(self, station: ArrayLike) -> Array:
        """Direction of travel, counterclockwise from +x [rad]; shape as `station`."""
        s = np.asarray(station, float)
        k = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, None)
        curvature = np.where(s < 0.0, 0.0, self._curvatures[k])
        return self._headings[k] + curvature * (s - self._starts[k])

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Points (x, y) [m], shape (..., 2). The line continues straight before station 0 and beyond its end."""
        s, lateral = np.broadcast_arrays(np.asarray(station, float), np.asarray(lateral, float))
        k = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, None)
        curvature = np.where(s < 0.0, 0.0, self._curvatures[k])
        along = s - self._starts[k]
        heading = self._headings[k] + curvature * along
        # The chord of an arc of angle a is the arc's length times sinc(a / 2), in the direction of the mean heading.
        half = 0.5 * curvature * along
        chord = along * np.sinc(half / np.pi)
        middle = self._headings[k] + half
        x = self._points[k, 0] + chord * np.cos(middle) - lateral * np.sin(heading)
        y = self._points[k, 1] + chord * np.sin(middle) + lateral * np.cos(heading)
        return np.stack([x, y], -1)

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Stations and laterals [m] of points relative to the nearest part of the line, (..., 2) → (...), (...)."""
        xy = np.asarray(xy, float)
        best_station, best_lateral = np.zeros(xy.shape[:-1]), np.full(xy.shape[:-1], np.inf)
        last = len(self._curvatures) - 1
        for k, curvature in enumerate(self._curvatures):
            ahead = np.array([np.cos(self._headings[k]), np.sin(self._headings[k])])
            left = np.array([-ahead[1], ahead[0]])
            off = xy - self._points[k]
            length = np.inf if k == last else self._starts[k + 1] - self._starts[k]
            if curvature == 0.0:
                along, lateral = off @ ahead, off @ left
            else:
                radius = 1.0 / curvature
                to_center = off - radius * left
                distance = np.hypot(to_center[..., 0], to_center[..., 1])
                angle = np.arctan2(to_center @ ahead, -np.sign(radius) * (to_center @ left))
                along, lateral = np.abs(radius) * angle, np.sign(radius) * (np.abs(radius) - distance)
                along = np.where(along < -1e-6, along + 2 * np.pi * np.abs(radius), along)
            nearer = (along >= -1e-6) & (along <= length + 1e-6) & (np.abs(lateral) < np.abs(best_lateral))
            best_station = np.where(nearer, self._starts[k] + along, best_station)
            best_lateral = np.where(nearer, lateral, best_lateral)
        # Before its start the line is straight, with heading 0.
        before = (xy[..., 0] <= 0.0) & (np.abs(xy[..., 1]) < np.abs(best_lateral))
        return np.where(before, xy[..., 0], best_station), np.where(before, xy[..., 1], best_lateral)

    # ---- section

    def edges(self, lateral: ArrayLike) -> Array:
        """Distance outwards from the nearer edge of the road [m], negative on the road; shape as `lateral`."""
        lateral = np.asarray(lateral, float)
        return np.maximum(lateral - self.section.left, -self.section.right - lateral)

    def mouth_weight(self, station: ArrayLike, side: int) -> Array:
        """1 at side roads on a side (1 = left, −1 = right), falling to 0 within `_DROP_LENGTH` beside them."""
        station = np.asarray(station, float)
        out = np.zeros(station.shape)
        for mouth in self.line.mouths:
            if mouth.side == side:
                beside = np.abs(station - mouth.station) - 0.5 * mouth.width
                out = np.maximum(out, 1.0 - np.clip(beside / _DROP_LENGTH, 0.0, 1.0))
        return out

    def mouths(self, side: int) -> list[Mouth]:
        """Side roads on a side."""
        return [mouth for mouth in self.line.mouths if mouth.side == side]

    def _surface(self, lateral: Array) -> Array:
        """Height of the road's surface above the driven line [m]."""
        middle, fall = 0.5 * (self.section.left - self.section.right), self.section.crossfall

        def height(across: Array | float) -> Array:
            if self.section.shape == "camber":
                return np.asarray(fall * (across - middle))
            return -fall * (np.hypot(across - middle, _CROWN_ROUNDING) - _CROWN_ROUNDING)

        return height(lateral) - height(0.0)

    def cross_profile(self, station: ArrayLike, lateral: ArrayLike) -> Array:
        """Height of road, curb and verge above the driven line [m], without the blend into the land."""
        station, lateral = np.broadcast_arrays(np.asarray(station, float), np.asarray(lateral, float))
        section = self.section
        out = self._surface(np.clip(lateral, -section.right, section.left))
        for sign, side, edge in ((1, section.sides[0], section.left), (-1, section.sides[1], section.right)):
            away = sign * lateral - edge
            kerb = section.kerb_height * (1.0 - self.mouth_weight(station, sign))
            out = out + np.where(away > 0.0, kerb + side.slope * np.clip(away, 0.0, side.width), 0.0)
        return out

    def grade(self, station: ArrayLike) -> Array:
        """Sampled slope along the line, without the unevenness."""
        knots = np.arange(len(self.line.grades)) * GRADE_STEP
        return np.interp(np.asarray(station, float), knots, self.line.grades)

    def profile(self, station: ArrayLike) -> Array:
        """Height of the driven line [m]: the integral of the grades plus the unevenness."""
        s = np.asarray(station, float)
        grades = np.array(self.line.grades)
        rises = np.concatenate([[0.0], np.cumsum(0.5 * (grades[:-1] + grades[1:]) * GRADE_STEP)])
        k = np.clip((s // GRADE_STEP).astype(int), 0, len(grades) - 1)
        along = s - k * GRADE_STEP
        following = np.append(grades[1:], grades[-1])
        change = np.where(along < 0.0, 0.0, 0.5 * (following[k] - grades[k]) / GRADE_STEP)
        smooth = rises[k] + grades[k] * along + change * along**2
        waves = np.sin(s[..., None] * self._bumps[:, 0] + self._bumps[:, 1]).sum(-1) / np.sqrt(2.0)
        return smooth + self.line.bumps * waves

    # ---- ground

    @cached_property
    def _land_samples(self) -> tuple[Array, Array]:
        stations = np.arange(self.start - 20.0, self.end + 20.0, _LAND_SAMPLE)
        return self.at(stations), self.profile(np.clip(stations, self.start, self.end))

    def _land(self, xy: Array) -> Array:
        """Height of the open land [m], shape (n, 2) → (n,): a weighted mean of the line's heights, plus swells."""
        points, heights = self._land_samples
        out = np.empty(len(xy))
        chunk = min(_CHUNK, _CHUNK_DISTANCES // len(points))
        for first in range(0, len(xy), chunk):
            part = xy[first : first + chunk]
            distance2 = ((part[:, None] - points[None]) ** 2).sum(-1)
            weight = 1.0 / (distance2 + _LAND_SMOOTHING**2) ** 2
            swell = np.sin(part @ self._swells.T + self._swell_phases).sum(-1) / np.sqrt(2.0)
            nearness = 1.0 - np.exp(-distance2.min(1) / 30.0**2)
            out[first : first + chunk] = (weight @ heights) / weight.sum(1) + self.line.relief * nearness * swell
        return out

    def ground_height(self, xy: ArrayLike) -> Array:
        """True height of the ground [m], shape (..., 2) → (...)."""
        xy = np.asarray(xy, float)
        station, lateral = self.project(xy)
        section = self.section
        z = self.profile(np.clip(station, self.start - 5.0, self.end + 5.0)) + self.cross_profile(station, lateral)
        width = np.where(lateral > 0.0, section.sides[0].width, section.sides[1].width)
        share = np.clip((self.edges(lateral) - section.kerb_width - 0.25 * width) / (0.75 * width), 0.0, 1.0)
        # Distance past the road's ends [m], minus 5 m.
        beyond = np.maximum(self.start - 5.0 - station, station - self.end - 5.0)
        share = np.maximum(share, np.clip(beyond / 5.0, 0.0, 1.0))
        share = share * share * (3.0 - 2.0 * share)
        off = share > 0.0
        if off.any():
            z = np.array(z)
            z[off] = (1.0 - share[off]) * z[off] + share[off] * self._land(xy[off])
        return z


def _advance(point: Array, heading: float, curvature: float, length: float) -> Array:
    """The end of a straight or an arc [m], shape (2,)."""
    half = 0.5 * curvature * length
    chord = length * float(np.sinc(half / np.pi))
    return point + chord * np.array([np.cos(heading + half), np.sin(heading + half)])
