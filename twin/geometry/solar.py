"""Direction of the sun in a scene from time and place.

Compass angles are clockwise from north. The *heading* of a scene is the compass angle of its x axis. Azimuths in the
scene are counterclockwise from its x axis.
"""

from datetime import datetime

import numpy as np

from twin.errors import InputError
from twin.geometry.shadow_map import direction
from twin.types import Array

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
