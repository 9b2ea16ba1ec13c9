"""The center line of the campus road (place 0) and the height of the ground.

*Station* s [m] is the arc length along the center line, *lateral* [m] the signed offset from it, positive to the left
of the driving direction. The road runs straight along +x, turns right on a circular arc, and runs straight on. Heights
[m] are above z = 0.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from twin.types import Array

ROAD_HALF_WIDTH = 3.0  # [m] from the center line to the face of the curb
KERB_HEIGHT = 0.11  # [m] above the adjacent asphalt
KERB_WIDTH = 0.16  # [m]
VERGE_WIDTH = 5.6  # [m] from the curb to the open land; on the left this includes the sidewalk
PAVEMENT_WIDTH = 1.7  # [m] of the sidewalk along the left curb
START, END = -6.0, 88.0  # [m] stations of the ends of the road
VERGE_SLOPE = 0.025  # slope of the verges, which rise away from the road
_CROWN = 0.018  # slope of the road from its crown to either side
_CROWN_ROUNDING = 0.35  # [m] half width of the rounding of the crown
# Undulation: amplitude [m], wave vector (x, y) [rad/m], phase [rad]. The steepest slope is about 3 %.
_WAVES = (
    (0.055, (0.170, 0.030), 0.4),
    (0.035, (-0.060, 0.210), 1.9),
    (0.020, (0.310, 0.240), 3.3),
    (0.010, (0.520, -0.450), 5.1),
)


@dataclass(frozen=True)
class RoadLine:
    """The center line of the road: a straight, a right-hand arc and a straight."""

    straight: float = 30.0
    """Length before the turn [m]."""
    radius: float = 9.0
    """Radius of the turn [m]."""
    turn: float = np.pi / 2.0
    """Angle of the turn, to the right [rad]."""
    length: float = 60.0
    """Driven length [m]."""

    @property
    def arc(self) -> float:
        """Length of the turn [m]."""
        return self.radius * self.turn

    def heading(self, station: ArrayLike) -> Array:
        """Direction of travel, counterclockwise from +x [rad]; shape as `station`."""
        return -np.clip((np.asarray(station) - self.straight) / self.radius, 0.0, self.turn)

    def at(self, station: ArrayLike, lateral: ArrayLike = 0.0) -> Array:
        """Points (x, y) [m], shape (..., 2). The line continues straight before station 0 and beyond its end."""
        s, lateral = np.broadcast_arrays(np.asarray(station, float), np.asarray(lateral, float))
        heading = self.heading(s)
        before, after = np.minimum(s, self.straight), np.maximum(s - self.straight - self.arc, 0.0)
        x = before - self.radius * np.sin(heading) + after * np.cos(self.turn)
        y = self.radius * (np.cos(heading) - 1.0) - after * np.sin(self.turn)
        return np.stack([x - lateral * np.sin(heading), y + lateral * np.cos(heading)], -1)

    def project(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Station and lateral [m] of points relative to the center line, shapes (..., 2) → (...), (...)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        out = np.array([np.cos(self.turn), -np.sin(self.turn)])  # direction after the turn
        end = self.at(self.straight + self.arc)
        along = (xy - end) @ out
        across = (xy - end) @ np.array([-out[1], out[0]])
        angle = np.arctan2(x - self.straight, y + self.radius)  # clockwise, from the start of the arc
        radial = np.hypot(x - self.straight, y + self.radius) - self.radius
        stations = np.stack([x, self.straight + self.radius * angle, self.straight + self.arc + along])
        laterals = np.stack([y, radial, across])
        valid = np.stack([x <= self.straight, (angle >= 0.0) & (angle <= self.turn), along >= 0.0])
        best = np.argmin(np.where(valid, np.abs(laterals), np.inf), 0)[None]
        return np.take_along_axis(stations, best, 0)[0], np.take_along_axis(laterals, best, 0)[0]

    def ground_height(self, xy: ArrayLike) -> Array:
        """True height of the ground [m], shape (..., 2) → (...)."""
        return undulation(xy) + cross_profile(self.project(xy)[1])


def undulation(xy: ArrayLike) -> Array:
    """Height of the undulating land without the road [m], shape (..., 2) → (...)."""
    xy = np.asarray(xy, float)
    return sum((a * np.sin(xy @ np.array(k) + phase) for a, k, phase in _WAVES), np.zeros(xy.shape[:-1]))


def cross_profile(lateral: ArrayLike) -> Array:
    """Height above the undulation [m]: crowned asphalt, a curb, and a verge that rises outwards."""
    away = np.abs(np.asarray(lateral, float))
    crown = -_CROWN * (np.sqrt(away**2 + _CROWN_ROUNDING**2) - _CROWN_ROUNDING)
    edge = -_CROWN * (np.hypot(ROAD_HALF_WIDTH, _CROWN_ROUNDING) - _CROWN_ROUNDING)
    verge = edge + KERB_HEIGHT + VERGE_SLOPE * np.clip(away - ROAD_HALF_WIDTH, 0.0, 8.0)
    return np.where(away <= ROAD_HALF_WIDTH, crown, verge)
