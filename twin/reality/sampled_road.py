"""The road of a sampled place: sampling of the driven line, the ground's height on and around it, and their meshes.

In plan, the line consists of straights and bends. A *lengthened* line begins with the sampled one and goes on with
further elements of the same kinds. Along the line, the height follows the sampled grades and a slight unevenness;
across the line, it follows the sampled cross section. On the verge, the ground blends into open land, whose height is a
weighted mean of the heights of the whole line, plus swells.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject
from twin.reality.place_spec import (
    GRADE_STEP,
    LONGEST_DRAWN,
    MOUTH_REACH,
    RUN_IN,
    RUN_OUT,
    LineSpec,
    Mouth,
    Piece,
    PlaceSpec,
    SectionSpec,
    stream,
)
from twin.reality.side_roads import SideAxis, smooth
from twin.types import Array

_CROWN_ROUNDING = 0.3  # [m] half width of the rounding of a crown
_BUMP_LENGTHS = (5.0, 20.0)  # [m] range of wavelengths of the unevenness
_SWELL_LENGTHS = (25.0, 80.0)  # [m] range of wavelengths of the land's swells
_LAND_SAMPLE = 2.0  # [m] between points of the line whose heights determine the land
_LAND_SMOOTHING = 3.0  # [m] length over which these heights are smoothed
_DROP_LENGTH = 0.8  # [m] over which a curb drops beside a side road
_CHUNK = 40_000  # largest number of points whose land heights are computed at once
_CHUNK_DISTANCES = 4_000_000  # largest number of distances from points to the line computed at once


class SampledRoad:
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
        self.side_axes = [SideAxis(self, self.section, one) for one in spec.line.side_roads]

    # ---- plan

    def heading(self, station: ArrayLike) -> Array:
        s = np.asarray(station, float)
        k, curvature = self._piece(s)
        return self._headings[k] + curvature * (s - self._starts[k])

    def _piece(self, station: Array) -> tuple[NDArray[np.int64], Array]:
        """Index of the piece at a station [m], and the line's curvature there [1/m]."""
        k = np.clip(np.searchsorted(self._starts, station, side="right") - 1, 0, None)
        return k, np.where(station < 0.0, 0.0, self._curvatures[k])

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Points (x, y) [m], shape (..., 2). The line continues straight before station 0 and beyond its end."""
        s, lateral = np.broadcast_arrays(np.asarray(station, float), np.asarray(lateral, float))
        k, curvature = self._piece(s)
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
        for mouth in self.mouths(side):
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
        for sign in (1, -1):
            away, side = sign * lateral - section.edge(sign), section.beside(sign)
            curb = section.curb_height * (1.0 - self.mouth_weight(station, sign))
            out = out + np.where(away > 0.0, curb + side.slope * np.clip(away, 0.0, side.width), 0.0)
        return out

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
        xy = np.asarray(xy, float)
        station, lateral = self.project(xy)
        section = self.section
        z = self.profile(np.clip(station, self.start - 5.0, self.end + 5.0)) + self.cross_profile(station, lateral)
        width = np.where(lateral > 0.0, section.sides[0].width, section.sides[1].width)
        share = np.clip((self.edges(lateral) - section.curb_width - 0.25 * width) / (0.75 * width), 0.0, 1.0)
        # Distance past the road's ends [m], minus 5 m.
        beyond = np.maximum(self.start - 5.0 - station, station - self.end - 5.0)
        share = np.maximum(share, np.clip(beyond / 5.0, 0.0, 1.0))
        share = smooth(share)
        off = share > 0.0
        if off.any():
            z = np.array(z)
            z[off] = (1.0 - share[off]) * z[off] + share[off] * self._land(xy[off])
        for axis in self.side_axes:
            z = z + axis.verge_lift(xy)
        return z


def _advance(point: Array, heading: float, curvature: float, length: float) -> Array:
    """The end of a straight or an arc [m], shape (2,)."""
    half = 0.5 * curvature * length
    chord = length * float(np.sinc(half / np.pi))
    return point + chord * np.array([np.cos(heading + half), np.sin(heading + half)])


# ---- meshes

STEP = 0.5  # [m] between vertices along the road
_LAND_STEP = 1.5  # [m] between vertices of the land
_LAND_MARGIN = 48.0  # [m] width of the land around the road
_TILE = 72.0  # [m] side of the square tiles of a long road's land, a multiple of `_LAND_STEP`


def land_boxes(line: Array, tiled: bool) -> dict[str, tuple[float, float, float, float]]:
    """Textures of the land and their x and y ranges [m]: one for all, or one per square tile near the line (n, 2)."""
    (x0, y0), (x1, y1) = (line.min(0) - _LAND_MARGIN).tolist(), (line.max(0) + _LAND_MARGIN).tolist()
    if not tiled:
        return {"land": (x0, x1, y0, y1)}
    out: dict[str, tuple[float, float, float, float]] = {}
    for x in np.arange(x0, x1, _TILE).tolist():
        for y in np.arange(y0, y1, _TILE).tolist():
            away = np.abs(line - (x + 0.5 * _TILE, y + 0.5 * _TILE)) - 0.5 * _TILE
            if np.hypot(*np.maximum(away, 0.0).T).min() < _LAND_MARGIN:
                out[f"land_{len(out)}"] = (x, x + _TILE, y, y + _TILE)
    return out


def add_road(place: KnownPlace, road: SampledRoad, stations: Array, suffix: str) -> None:
    """Adds road, curbs and verges along consecutive stations; `suffix` ends the names of objects and textures."""
    section = road.section

    def strip(name: str, texture: str, laterals: Array, lifts: Array | None = None, gaps: int = 0) -> None:
        """Adds a mesh strip along the road with vertices at `laterals` [m], left first.

        It lies on the ground, or `lifts` [m] above the driven line. `gaps` (1 = left, −1 = right) leaves gaps for the
        side roads on that side.
        """
        xy = road.at(stations[None], laterals[:, None])
        z = road.ground_height(xy)
        if lifts is not None:
            z = road.profile(stations)[None] + lifts
        part = primitives.grid(xy, z, primitives.share(stations)[None], primitives.share(laterals)[:, None])
        if gaps:
            middle = stations[(part.faces % len(stations))].mean(1)
            keep = np.ones(len(part.faces), bool)
            for mouth in road.mouths(gaps):
                keep &= np.abs(middle - mouth.station) > 0.5 * mouth.width
            part = replace(part, faces=part.faces[keep])
        place.objects.append(PlaceObject(f"{name}{suffix}", "ground", part, f"{texture}{suffix}"))

    inner = 1e-6  # keeps the vertices at the road's edges on the road
    strip("road", "road", np.linspace(section.left - inner, -section.right + inner, 15))
    for sign, name in ((1, "left"), (-1, "right")):
        edge, outer = section.edge(sign), section.curb_edge(sign)
        if section.curb_height > 0.0:
            low = road.cross_profile(stations, sign * edge)
            high = road.cross_profile(stations, sign * (edge + 0.03))
            profile = np.array([edge, edge + 0.015, edge + 0.03, outer])
            back = road.cross_profile(stations, sign * (outer + inner))
            lifts = np.stack([low - 0.02, high - 0.15 * (high - low), high, back])
            strip(f"curb_{name}", "curb", sign * profile[::-sign], lifts[::-sign])
        across = sign * np.linspace(outer + inner, outer + section.beside(sign).width, 9)
        strip(f"verge_{name}", f"verge_{name}", np.sort(across)[::-1], gaps=sign)


def add_side_roads(place: KnownPlace, road: SampledRoad, stations: Array) -> None:
    """Adds the side roads that are not filmed; `stations` are those of the vertices along the road."""
    section = road.section
    filmed = [one.mouth for one in road.line.side_roads]
    for k, mouth in enumerate(road.line.mouths):
        if mouth in filmed:
            continue
        reach = section.curb_edge(mouth.side) + np.arange(0.0, MOUTH_REACH, 0.5)
        first = stations[np.argmax(stations + STEP / 2 > mouth.station - mouth.width / 2)]
        inside = stations[(stations >= first - STEP) & (stations <= mouth.station + mouth.width / 2 + STEP)]
        xy = road.at(inside[None], mouth.side * reach[:, None])
        z = road.ground_height(xy) + 0.01
        u = 0.03 + 0.3 * (k % 3) + 0.25 * primitives.share(reach)
        order = -mouth.side
        part = primitives.grid(xy[::order], z[::order], u[::order, None], primitives.share(inside)[None])
        place.objects.append(PlaceObject(f"side_road_{k}", "ground", part, "side_road"))


def add_land(place: KnownPlace, road: SampledRoad, name: str, box: tuple[float, float, float, float]) -> None:
    """Adds land in an x and y range [m], lowered under road, verges and side roads."""
    section = road.section
    x0, x1, y0, y1 = box
    x, y = np.meshgrid(np.arange(x0, x1 + 0.1, _LAND_STEP), np.arange(y1, y0 - 0.1, -_LAND_STEP))
    xy = np.stack([x, y], -1)
    station, lateral = road.project(xy)
    away = road.edges(lateral) - section.curb_width
    width = np.where(lateral > 0.0, section.sides[0].width, section.sides[1].width)
    along = (station > road.start - 2.0) & (station < road.end + 2.0)
    sunk = np.where(along & (away < width - 1.6), 0.5, np.where(along & (away < width + 1.6), 0.12, 0.0))
    for mouth in road.line.mouths:
        near = (np.abs(station - mouth.station) < mouth.width / 2 + 1.6) & (lateral * mouth.side > 0.0)
        sunk = np.where(near & (away < MOUTH_REACH), 0.3, sunk)
    for axis in road.side_axes:
        sunk = np.maximum(sunk, axis.depth_below(xy, _LAND_STEP + 0.1))
    u, v = np.clip((x - x0) / (x1 - x0), 0.0, 1.0), np.clip((y1 - y) / (y1 - y0), 0.0, 1.0)
    part = primitives.grid(xy, road.ground_height(xy) - sunk, u, v)
    place.objects.append(PlaceObject(name, "ground", part, name))


# ---- samples of the line

_SEPARATION = 28.0  # [m] points more than twice this far apart along the line are at least this far apart in plan
_LONG_SEPARATION = 30.0  # [m] the same between a point of the lengthening and any other
# If all headings are this close to one direction, points 60 m apart along the line are at least 60 · cos 58° = 32 m
# apart in plan, so `_LONG_SEPARATION` can be kept.
_HEADING_BOUND = float(np.deg2rad(58.0))  # [rad]
_BEND_ROOM = 2.0  # [m] least distance from a verge's outer edge to the center of a bend of the lengthening
_MOUTH_ROOM = 30.0  # [m] from the road's edge; a further side road must be far from the rest of the road there


def sample_line(rng: np.random.Generator, setting: str, section: SectionSpec) -> LineSpec:
    """Samples the driven line of a place with a setting and a cross section."""
    length = float(rng.uniform(42.0, LONGEST_DRAWN))
    while True:  # until no part of the line comes near another
        pieces = _pieces(rng, setting, section, length + RUN_OUT)
        if _keeps_clear(pieces):
            break
    hilly = rng.random() < 0.65
    count = int(np.ceil((length + RUN_OUT) / GRADE_STEP)) + 1
    steepest = float(rng.uniform(0.02, 0.08)) * hilly
    base = rng.normal(0.0, 1.0, count) + rng.normal(0.0, 1.2)
    grades = steepest * np.clip(base / 1.5, -1.0, 1.0)
    bumps = float(rng.uniform(0.003, 0.012))
    mouths: list[Mouth] = []
    stations = np.cumsum([0.0, *(piece.length for piece in pieces)])
    for piece, start in zip(pieces, stations, strict=False):
        mouth = _mouth(rng, setting, piece, float(start), length)
        if mouth and len(mouths) < 2:
            mouths.append(mouth)
    relief = float(rng.uniform(0.0, 0.35 if setting in ("town", "works") else 1.4))
    return LineSpec(pieces, round(length, 2), tuple(grades.tolist()), bumps, tuple(mouths), relief)


def _mouth(rng: np.random.Generator, setting: str, piece: Piece, start: float, length: float) -> Mouth | None:
    """Samples a side road on a piece of a line of `length` [m] that begins at station `start`, or none."""
    width, side = float(rng.uniform(2.8, 6.0)), int(rng.choice([-1, 1]))
    offset, wanted = float(rng.uniform(0.0, 1.0)), rng.random() < (0.25 if setting in ("forest", "field") else 0.5)
    room = min(piece.length, length - start) - width - 4.0
    if piece.curvature != 0.0 or not wanted or room <= 0.0:
        return None
    return Mouth(round(start + 2.0 + width / 2 + offset * room, 2), side, width)


def _pieces(rng: np.random.Generator, setting: str, section: SectionSpec, length: float) -> tuple[Piece, ...]:
    """Straights and bends of a total length of at least `length` [m]; bends in a row turn to alternate sides."""
    pieces: list[Piece] = []
    bendy = {"town": 0.6, "works": 0.6}.get(setting, 1.0)
    straight = rng.random() < 0.75
    left = bool(rng.random() < 0.5)
    total = 0.0
    while total < length:
        if straight:
            piece = Piece(float(rng.uniform(6.0, 34.0)), 0.0)
        else:
            least = max(6.0, section.curb_edge(1 if left else -1) + 2.2)
            radius = float(np.exp(rng.uniform(np.log(least), np.log(40.0))))
            angle = np.deg2rad(rng.uniform(20.0, 100.0)) * bendy
            piece = Piece(min(radius * float(angle), 45.0), (1.0 if left else -1.0) / radius)
        last = straight
        straight = rng.random() < 0.55 if not last else False  # no two straights in a row
        if not last:
            left = not left if not straight else bool(rng.random() < 0.5)
        pieces.append(piece)
        total += piece.length
    return tuple(pieces)


def lengthen(rng: np.random.Generator, line: LineSpec, setting: str, section: SectionSpec, length: float) -> LineSpec:
    """The line, lengthened to `length` [m].

    The verges of `section` already end before the centers of the line's bends. Further bends are wide enough for them.
    """
    while True:  # until no part of the line comes near another
        pieces = _further(rng, line.pieces, setting, section, length + RUN_OUT)
        if _keeps_clear((Piece(RUN_IN, 0.0), *pieces), _LONG_SEPARATION, len(line.pieces) + 1):
            break
    count = int(np.ceil((length + RUN_OUT) / GRADE_STEP)) + 1 - len(line.grades)
    steepest = max(map(abs, line.grades))
    grades = steepest * np.clip(rng.normal(0.0, 1.0, max(count, 0)) / 1.5, -1.0, 1.0)
    xy = _points(pieces)[0]
    mouths = list(line.mouths)
    starts = np.cumsum([0.0, *(piece.length for piece in pieces)]).tolist()
    begins = np.cumsum([0, *(_point_count(piece) for piece in pieces)]).tolist()
    for n in range(len(line.pieces), len(pieces)):
        start = starts[n]
        mouth = _mouth(rng, setting, pieces[n], start, length)
        if not mouth:
            continue
        side = mouth.side
        begin = xy[begins[n] - 1]
        ahead = (xy[begins[n]] - begin) / np.linalg.norm(xy[begins[n]] - begin)
        reach = section.edge(side) + _MOUTH_ROOM
        end = begin + (mouth.station - start) * ahead + side * reach * np.array([-ahead[1], ahead[0]])
        if np.linalg.norm(xy - end, axis=1).min() > 0.5 * reach:
            mouths.append(mouth)
    return replace(
        line, pieces=pieces, length=round(length, 2), grades=(*line.grades, *grades.tolist()), mouths=tuple(mouths)
    )


def _further(
    rng: np.random.Generator, pieces: tuple[Piece, ...], setting: str, section: SectionSpec, length: float
) -> tuple[Piece, ...]:
    """The pieces and further ones, up to a total length of at least `length` [m].

    The headings of the further pieces stay near the direction from the line's start to the end of `pieces`, so the line
    does not come back.
    """
    xy, heading = _points(pieces)
    away = xy[-1] - xy[0]
    off = float(np.angle(np.exp(1j * (heading - np.arctan2(away[1], away[0])))))  # heading from that direction [rad]
    bendy = {"town": 0.6, "works": 0.6}.get(setting, 1.0)
    out, total = list(pieces), sum(piece.length for piece in pieces)
    straight = pieces[-1].curvature != 0.0 and rng.random() < 0.55
    left = pieces[-1].curvature < 0.0 if pieces[-1].curvature else bool(rng.random() < 0.5)
    while total < length:
        if straight:
            out.append(Piece(float(rng.uniform(6.0, 34.0)), 0.0))
            straight, left = False, bool(rng.random() < 0.5)
        else:
            angle = float(np.deg2rad(rng.uniform(20.0, 100.0))) * bendy
            if abs(off + (angle if left else -angle)) > _HEADING_BOUND:
                left = off < 0.0
                angle = min(angle, _HEADING_BOUND + abs(off))
            side = 1 if left else -1
            least = max(6.0, section.curb_edge(side) + 2.2, section.verge_edge(side) + _BEND_ROOM)
            radius = float(np.exp(rng.uniform(np.log(least), np.log(40.0))))
            angle = min(angle, 45.0 / radius)
            out.append(Piece(radius * angle, (1.0 if left else -1.0) / radius))
            off += angle if left else -angle
            straight, left = bool(rng.random() < 0.55), not left
        total += out[-1].length
    return tuple(out)


def _keeps_clear(pieces: tuple[Piece, ...], separation: float = _SEPARATION, first: int = 0) -> bool:
    """True if points more than 2 `separation` [m] apart along the line are more than `separation` apart in plan.

    Pairs of points on the pieces before number `first` are not examined.
    """
    xy, _ = _points(pieces)
    old = sum(_point_count(piece) for piece in pieces[:first])
    for k in range(old, len(xy)):
        before = xy[: max(0, k - int(2.0 * separation))]
        if len(before) and np.linalg.norm(before - xy[k], axis=1).min() <= separation:
            return False
    return True


def _point_count(piece: Piece) -> int:
    return max(1, round(piece.length))


def _points(pieces: tuple[Piece, ...]) -> tuple[Array, float]:
    """Points about every 1 m along the pieces [m], the first one 1 m after the start, and the last heading [rad]."""
    heading, point, points = 0.0, np.zeros(2), []
    for piece in pieces:
        count = _point_count(piece)
        for _ in range(count):
            heading += 0.5 * piece.curvature * piece.length / count
            point = point + piece.length / count * np.array([np.cos(heading), np.sin(heading)])
            heading += 0.5 * piece.curvature * piece.length / count
            points.append(point)
    return np.array(points), heading
