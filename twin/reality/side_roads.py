"""Side roads that are filmed: which mouths have one, the line into it, its ground and meshes.

A side road is straight and leaves the driven line at right angles. Its *axis* begins on the driven line, at the middle
of the mouth. The *side line* is what a film of the side road follows: some meters of the driven line, a turn, and the
axis. Both are `place_objects.DrivenLine`s: their stations begin at 0, and laterals are positive to the left.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.reality import primitives
from twin.reality.place_objects import DrivenLine, KnownPlace, PlaceObject
from twin.reality.place_spec import MOUTH_REACH, LineSpec, Mouth, SectionSpec, SideRoad
from twin.types import Array

LEAD = 8.0  # [m] length of the driven line before the turn that both films show
SIDE_VERGE = 2.2  # [m] width of a side road's verges
_MIN_WIDTH = 4.0  # [m] least width of a side road, so that the corridor stays off the corner of the mouth
_SWING = 1.6  # [m] radius of the turn minus the half width of the narrower road
_DRIVEN = 25.0  # [m] filmed length of a side road from the curb of the driven road on
_MIN_DRIVEN = 15.0  # [m] the same, at least
_BEYOND = 20.0  # [m] length of the side road beyond the film's end, if there is room
_SPARED = 4.0  # [m] least length of the side road beyond the film's end
_ROOM = 17.0  # [m] least distance of a side road from other parts of the driven line
_NEAR_MOUTH = 0.75  # least distance from the driven line as a fraction of that along the axis, where this is less
_APART = 14.0  # [m] least distance between two side roads
_RISE = 1.5  # [m] over which curbs rise where side roads leave the verge, and verges blend into the land
_STEP = 0.5  # [m] spacing of the vertices along a side road
_LIFT = 0.01  # [m] height of the surface above the ground


def smooth(share: Array) -> Array:
    """A smooth step: 0 up to a share of 0, 1 from a share of 1 on."""
    share = np.clip(share, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


class SideAxis:
    """The axis of a side road, and the ground that the side road takes up."""

    def __init__(self, road: DrivenLine, section: SectionSpec, one: SideRoad) -> None:
        """`section` is that of the driven road."""
        self._road, self.section, self.one = road, section, one
        self.length = one.length
        self.edge = 0.5 * one.mouth.width + section.curb_width
        """Distance of the curbs' outer edges from the axis [m]."""
        self.surface_start = section.curb_edge(one.mouth.side)
        """Station where the surface begins [m]: at the curb of the driven road."""
        self.verge_start = section.verge_edge(one.mouth.side)
        """Station where the verge of the driven road ends [m]; there, the side road's verges begin."""
        self._origin = road.at(one.mouth.station)
        self._yaw = float(road.heading(one.mouth.station)) + one.mouth.side * 0.5 * np.pi
        ahead = np.array([np.cos(self._yaw), np.sin(self._yaw)])
        self._axes = np.stack([ahead, [-ahead[1], ahead[0]]])

    def heading(self, station: ArrayLike) -> Array:
        return np.full(np.shape(station), self._yaw)

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        return self._origin + np.stack(np.broadcast_arrays(station, lateral), -1) @ self._axes

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        off = (np.asarray(xy, float) - self._origin) @ self._axes.T
        return off[..., 0], off[..., 1]

    def ground_height(self, xy: ArrayLike) -> Array:
        return self._road.ground_height(xy)

    def verge_lift(self, xy: Array) -> Array:
        """Height of the verges above the land [m] at points (..., 2), shape (...); 0 on the side road's surface."""
        station, lateral = self.project(xy)
        away = np.abs(lateral)
        along = smooth((station - self.verge_start) / _RISE) * (1.0 - smooth((station - self.length) / _RISE))
        across = (away > 0.5 * self.one.mouth.width) * (1.0 - smooth((away - (self.edge + SIDE_VERGE)) / _RISE))
        return self.section.curb_height * along * across

    def occupied(self, xy: Array, margin: float) -> NDArray[np.bool_]:
        """True at points (..., 2) on the side road, its curbs, or up to a margin [m] beside them."""
        station, lateral = self.project(xy)
        return np.asarray((np.abs(lateral) < self.edge + margin) & (station > 0.0) & (station < self.length))

    def depth_below(self, xy: Array, margin: float) -> Array:
        """Depth of the land's mesh below the side road and its verges [m] at points (..., 2), shape (...).

        `margin` [m] is about the distance between the land's vertices.
        """
        station, lateral = self.project(xy)
        away = np.abs(lateral) - (self.edge + SIDE_VERGE)
        along = (station > self.verge_start - margin) & (station < self.length)
        return np.where(along & (away < -margin), 0.5, np.where(along & (away < margin), 0.12, 0.0))


class SideLine:
    """The line that the film of a side road follows."""

    def __init__(self, road: DrivenLine, axis: SideAxis) -> None:
        self.one = one = axis.one
        self._road, self._axis = road, axis
        self._side, self._radius = float(one.mouth.side), one.radius
        self._turn = one.mouth.station - one.radius  # station of the driven line where the turn begins
        self._bend = 0.5 * np.pi * one.radius
        self.turn_end = LEAD + self._bend
        """Station where the turn ends [m]."""
        self.length = LEAD + self._bend + one.driven - one.radius
        self._yaw = float(road.heading(one.mouth.station))
        self._ahead = np.array([np.cos(self._yaw), np.sin(self._yaw)])
        self._left = np.array([-self._ahead[1], self._ahead[0]])
        self._center = road.at(one.mouth.station) + one.radius * (self._side * self._left - self._ahead)

    def heading(self, station: ArrayLike) -> Array:
        s = np.asarray(station, float) - LEAD
        turned = self._yaw + self._side * np.clip(s, 0.0, self._bend) / self._radius
        return np.where(s < 0.0, self._road.heading(self._turn + np.minimum(s, 0.0)), turned)

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        s, lateral = np.broadcast_arrays(np.asarray(station, float) - LEAD, np.asarray(lateral, float))
        angle = np.clip(s, 0.0, self._bend) / self._radius
        radius = (self._radius - self._side * lateral)[..., None]
        turn = self._center + radius * (
            np.sin(angle)[..., None] * self._ahead - self._side * np.cos(angle)[..., None] * self._left
        )
        out = np.where((s < 0.0)[..., None], self._road.at(self._turn + np.minimum(s, 0.0), lateral), turn)
        return np.where((s > self._bend)[..., None], self._axis.at(s - self._bend + self._radius, lateral), out)

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        xy = np.asarray(xy, float)
        along, off = self._road.project(xy)
        from_turn = np.minimum(along - self._turn, 0.0)
        # Beyond the start of the turn, the nearest point of the driven part is its end.
        passed = along > self._turn
        off = np.where(passed, np.linalg.norm(xy - self._road.at(self._turn), axis=-1), off)
        out, across = self._axis.project(xy)
        straight = (out >= self._radius) & (np.abs(across) < np.abs(off))
        station = np.where(straight, self._bend + out - self._radius, from_turn)
        lateral = np.where(straight, across, off)
        x, y = (xy - self._center) @ self._ahead, self._side * ((self._center - xy) @ self._left)
        aside = self._side * (self._radius - np.hypot(x, y))
        bent = (x >= 0.0) & (y >= 0.0) & (np.abs(aside) <= np.abs(lateral))
        station = np.where(bent, self._radius * np.arctan2(x, y), station)
        return station + LEAD, np.where(bent, aside, lateral)

    def ground_height(self, xy: ArrayLike) -> Array:
        return self._road.ground_height(xy)


# ---- which mouths have one


def with_side_roads(line: LineSpec, section: SectionSpec, road: DrivenLine, start: float, end: float) -> LineSpec:
    """The line with side roads at all mouths that have room for one; `road` is that line as a `DrivenLine`.

    A mouth has room if its film can begin on the driven line, and if the side road stays away from the rest of the
    road, which extends from station `start` to `end` [m], and from other side roads, filmed or not.
    """
    others = road.at(np.arange(start, end, 1.0))
    short = {}  # points (n, 2) [m] on the side roads that are not filmed
    for mouth in line.mouths:
        reach = section.curb_edge(mouth.side) + np.arange(0.0, MOUTH_REACH, 0.5)
        short[mouth] = road.at(np.full_like(reach, mouth.station), mouth.side * reach)
    found: list[tuple[Mouth, SideRoad]] = []
    taken: list[Array] = []
    for mouth in sorted(line.mouths, key=lambda one: one.station):
        wide = replace(mouth, width=max(mouth.width, _MIN_WIDTH))
        radius = min(0.5 * wide.width, section.edge(mouth.side)) + _SWING
        if mouth.station - radius - LEAD < 0.0:
            continue
        curb = section.curb_edge(mouth.side)
        whole = SideRoad(f"side_{len(found) + 1}", wide, radius, 0.0, curb + _DRIVEN + _BEYOND)
        out = np.arange(curb, whole.length + 0.1, 0.5)
        axis = SideAxis(road, section, whole).at(out)
        free = np.linalg.norm(axis[:, None] - others, axis=-1).min(1) > np.minimum(_NEAR_MOUTH * out, _ROOM)
        half = 0.5 * wide.width + section.curb_width + SIDE_VERGE
        for other, points in short.items():
            if other != mouth:
                free &= np.linalg.norm(axis[:, None] - points, axis=-1).min(1) > half + 0.5 * other.width
        for one in taken:
            free &= np.linalg.norm(axis[:, None] - one, axis=-1).min(1) > _APART
        length = float(out[-1] if free.all() else out[max(int(np.argmin(free)) - 1, 0)])
        driven = min(curb + _DRIVEN, length - _SPARED)
        if driven >= curb + _MIN_DRIVEN:
            found.append((mouth, replace(whole, driven=round(driven, 2), length=round(length, 2))))
            taken.append(axis[out <= length])
    wider = {mouth: one.mouth for mouth, one in found}
    return replace(
        line,
        mouths=tuple(wider.get(mouth, mouth) for mouth in line.mouths),
        side_roads=tuple(one for _, one in found),
    )


# ---- meshes


def add_side_road(place: KnownPlace, axis: SideAxis) -> None:
    """Adds surface, curbs and verges of a side road; their textures are `<name>`, `<name>_curb`, `<name>_verge`."""
    one, section = axis.one, axis.section
    half, curb = 0.5 * one.mouth.width, section.curb_width

    def strip(name: str, texture: str, first: float, laterals: Array, last: float, lift: float = 0.0) -> None:
        """Adds a strip of the ground between two stations, with vertices at `laterals` [m], left first."""
        stations = np.linspace(first, last, max(2, round((last - first) / _STEP) + 1))
        xy = axis.at(stations[None], laterals[:, None])
        part = primitives.grid(
            xy, axis.ground_height(xy) + lift, primitives.share(stations)[None], primitives.share(laterals)[:, None]
        )
        place.objects.append(PlaceObject(name, "ground", part, texture))

    begin, inner = axis.verge_start, 1e-6
    # Between the verges of the driven road, the surface is wider, as the verges' gap ends at a vertex.
    strip(f"{one.name}_mouth", f"{one.name}_mouth", axis.surface_start, _across(half + _STEP), begin, _LIFT)
    strip(one.name, one.name, begin, _across(half - inner), one.length, _LIFT)
    for sign, side in ((1, "left"), (-1, "right")):
        outer = sign * np.linspace(half + curb + inner, half + curb + SIDE_VERGE, 5)
        strip(f"{one.name}_verge_{side}", f"{one.name}_verge", begin, np.sort(outer)[::-1], one.length)
        if section.curb_height <= 0.0:
            continue
        stations = np.linspace(begin, one.length, round((one.length - begin) / _STEP) + 1)
        profile = np.array([half - inner, half + 0.015, half + 0.03, half + curb])
        xy = axis.at(stations[None], sign * profile[:, None])
        z = axis.ground_height(xy)
        z[1] = z[2] - 0.15 * (z[2] - z[0])
        z[0] -= 0.02
        part = primitives.grid(
            xy[::-sign], z[::-sign], primitives.share(stations)[None], primitives.share(profile)[::-sign, None]
        )
        place.objects.append(PlaceObject(f"{one.name}_curb_{side}", "ground", part, f"{one.name}_curb"))


def _across(half: float) -> Array:
    return np.linspace(half, -half, 9)
