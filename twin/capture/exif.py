"""What a photo's EXIF header knows: focal length, position and clock.

A *prior* is a focal length that comes from the header and not from a calibration: structure from motion starts at it
and improves it.
"""

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import ExifTags

from twin.capture.pycolmap_import import pycolmap
from twin.geometry.images import BROKEN, opened

_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)  # [mm]
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit


@dataclass(frozen=True)
class PhotoFacts:
    """One photo's header."""

    focal: float | None
    """Focal length in units of the longer side of the picture; None where the header does not say."""
    gps: tuple[float, float, float]
    """Latitude [°], longitude [°], altitude [m]; NaN where unknown."""
    time: float | None
    """Clock time [s since the epoch, the camera's own zone]; None where unknown."""
    orientation: int
    """1 is upright; 2 to 8 as EXIF has them."""


def photo_facts(path: Path) -> PhotoFacts:
    """Reads a photo's header; whatever is absent or malformed is unknown, never an error."""
    nothing = PhotoFacts(None, (math.nan, math.nan, math.nan), None, 1)
    try:
        found = opened(path)
        if found is None:
            return nothing
        with found as image:
            width, height = image.size
            exif = image.getexif()
            if not exif:
                return nothing
            photo, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    except BROKEN:
        return nothing
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return PhotoFacts(
        focal=focal_from_exif(photo, width, height) or _focal_from_model(path, width, height),
        gps=gps_from_exif(gps),
        time=time_from_exif(photo),
        orientation=orientation if orientation in range(1, 9) else 1,
    )


def focal_from_exif(photo: Any, width: int, height: int) -> float | None:
    """Focal length over the longer side of the picture, from the Exif block of a header, or None.

    The 35 mm equivalent compares diagonals (CIPA DCG-001). Without it, the focal length and the pitch of the sensor
    do, if the header gives both.
    """
    longer, diagonal = max(width, height), math.hypot(width, height)
    equivalent = _number(photo.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent > 0.0:
        return equivalent / _FULL_FRAME_DIAGONAL * diagonal / longer
    millimetres = _number(photo.get(ExifTags.Base.FocalLength))
    pitch = _number(photo.get(ExifTags.Base.FocalPlaneXResolution))  # [px per unit]
    unit = _UNIT_MM.get(photo.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    full_width = _number(photo.get(ExifTags.Base.ExifImageWidth)) or width
    full_height = _number(photo.get(ExifTags.Base.ExifImageHeight)) or height
    if millimetres > 0.0 and pitch > 0.0 and unit:
        return millimetres * pitch / unit / max(full_width, full_height)
    return None


def _focal_from_model(path: Path, width: int, height: int) -> float | None:
    """COLMAP's own table of sensor sizes, by camera model."""
    try:
        camera = pycolmap.infer_camera_from_image(str(path))
    except (RuntimeError, ValueError):
        return None
    return camera.mean_focal_length() / max(width, height) if camera.has_prior_focal_length else None


def gps_from_exif(gps: Any) -> tuple[float, float, float]:
    """Latitude [°], longitude [°], altitude [m] from the GPS block; NaN where unknown."""
    tag = ExifTags.GPS
    latitude = _degrees(gps.get(tag.GPSLatitude), gps.get(tag.GPSLatitudeRef), "S")
    longitude = _degrees(gps.get(tag.GPSLongitude), gps.get(tag.GPSLongitudeRef), "W")
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return math.nan, math.nan, math.nan
    altitude = _number(gps.get(tag.GPSAltitude), math.nan)
    below = gps.get(tag.GPSAltitudeRef) in (1, b"\x01")
    return latitude, longitude, -altitude if below else altitude


def time_from_exif(photo: Any) -> float | None:
    """When the photo was taken [s], with its fraction of a second, or None."""
    text = photo.get(ExifTags.Base.DateTimeOriginal)
    try:
        taken = datetime.strptime(str(text).strip("\x00 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    fraction = str(photo.get(ExifTags.Base.SubsecTimeOriginal) or "").strip("\x00 ")
    seconds = (taken - datetime(1970, 1, 1)).total_seconds()
    return seconds + (float(f"0.{fraction}") if fraction.isdigit() else 0.0)


def _degrees(parts: Any, reference: Any, negative: str) -> float:
    try:
        values = [float(part) for part in parts]
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    total = sum(value / 60.0**i for i, value in enumerate(values))
    return -total if str(reference).strip("\x00 ").upper() == negative else total


def _number(value: Any, missing: float = 0.0) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return missing
    return number if math.isfinite(number) else missing
