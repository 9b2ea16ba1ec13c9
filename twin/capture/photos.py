"""Image sets, posed or not, as kept frames.

A *posed* set brings a camera and a pose per image. A *stored* picture is as the file has it; *upright* is as its EXIF
orientation wants it shown.
"""

import hashlib
import itertools
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags

from twin import runtime
from twin.capture.camera_models import Lens, flattened, same_aspect
from twin.capture.formats import ImageSet
from twin.capture.pycolmap_import import pycolmap
from twin.capture.sources import BLANK, KeptFrame, SourceTask, ahead, read_mask
from twin.capture.video import fitted_size, within
from twin.errors import InputError
from twin.geometry.images import BROKEN, decoded, opened, resize
from twin.types import Image

# ---- What a photo's EXIF header knows: focal length, position and clock.
#
# A *prior* is a focal length that comes from the header and not from a calibration: structure from motion starts at it
# and improves it.


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


_MAX_FOCAL_SPREAD = 0.05  # relative; photos of one source that differ more were zoomed


def read_photos(task: SourceTask, images: ImageSet) -> KeptFrame:
    """Reads, scales and writes the images of a set; exact duplicates and blank images are dropped.

    Raises:
        InputError: an unreadable image, images of different shapes, or none that shows anything.
    """
    if images.missing:
        runtime.say(f"  {task.path.name}: {images.missing} images are listed but do not exist; going on without them")
    lenses = images.lenses
    if lenses and (given := task.given_lens((lenses[0].width, lenses[0].height))):
        lenses = (given,) * len(lenses)
    flatten = lenses is not None and _differ(lenses)
    limit = min(task.config.frames or task.config.max_frames, task.config.max_frames)
    there = _in_parts(task, images)
    chosen = [int(there[i]) for i in regular_choice(len(there), limit)]

    def load(i: int) -> tuple[int, Image, PhotoFacts]:
        return i, *load_photo(images.paths[i], lenses[i] if lenses else None)

    kept = KeptFrame(task.info((0, 0), None, False))
    seen: set[bytes] = set()
    duplicates = blank = unmasked = 0
    clock: list[float | None] = []
    focal: list[float] = []
    kept_lenses: list[Lens] = []
    native = size = (0, 0)
    stream = ahead(task.writer.pool, load, chosen)
    for i, image, facts in runtime.track(stream, f"reading {task.name}", len(chosen), "image"):
        shape = (image.shape[1], image.shape[0])
        if size == (0, 0):
            native, size = shape, fitted_size(*shape, task.config.max_size)
        if not same_aspect(shape, native):
            raise InputError(
                f"{images.paths[i]}: {shape[0]}x{shape[1]}, but the images before it are {native[0]}x{native[1]}; "
                "put images of another shape into a source of their own"
            )
        if shape != size:
            image = np.asarray(resize(image, *size), np.uint8)
        digest = hashlib.sha256(image.tobytes()).digest()
        if digest in seen:
            duplicates += 1
            continue
        seen.add(digest)
        if float(image[::4, ::4].std()) < BLANK:
            blank += 1
            continue
        mask = _mask(task, images, i, size)
        unmasked += mask is None
        if lenses and images.camera_to_world is not None:
            lens = lenses[i].scaled(*size)
            if flatten:
                mask = None if mask is None else flattened(mask, lens, nearest=True)[0]
                image, lens = flattened(image, lens)
            kept_lenses.append(lens)
            kept.poses.append(images.camera_to_world[i])
            kept.intrinsics.append(lens.intrinsics)
        task.writer.put(i, image, mask)
        kept.index.append(i)
        kept.gps.append(facts.gps)
        clock.append(facts.time)
        focal += [facts.focal] if facts.focal else []
    if not kept.index:
        raise InputError(f"{task.path}: all {len(chosen)} images are blank (one colour); give photos of the place")
    task.check_masked(unmasked, len(kept.index))
    kept.times = photo_times(clock, kept.index)
    if kept_lenses:
        middle = np.median([lens.intrinsics for lens in kept_lenses], axis=0)
        kept.info = task.info(size, kept_lenses[0].with_intrinsics(middle), True)
    elif known := task.given_lens(native):
        kept.info = task.info(size, known.scaled(*size), True)
    else:
        kept.info = task.info(size, focal_prior(focal, size, task.name), False)
    kept.metrics = {
        "kind": task.kind,
        "lighting": task.lighting,
        "decoded": len(chosen),
        "kept": len(kept.index),
        "missing": images.missing,
        "duplicates": duplicates,
        "blank": blank,
        "with_gps": sum(math.isfinite(latitude) for latitude, _, _ in kept.gps),
        "focal_prior_px": None if kept.info.calibrated or not focal else round(kept.info.camera_params[0], 1),
        "width": size[0],
        "height": size[1],
    }
    return kept


def _in_parts(task: SourceTask, images: ImageSet) -> NDArray[np.int64]:
    """Indices of the photos that lie in the parts of the source that are used.

    Raises:
        InputError: parts are given and the photos have no clock that rises, or fewer than two photos are in the parts.
    """
    count = len(images.paths)
    if not task.parts:
        return np.arange(count)
    clock = [photo_facts(path).time for path in images.paths]
    if not rises(clock):
        raise InputError(
            f"{task.path}: keep is in seconds, but these photos have no clock (EXIF) that rises with their names; put "
            "the photos that are to be used into a folder of their own, and give keep to the films only"
        )
    times = np.array(photo_times(clock, list(range(count))))
    used = np.flatnonzero(within(times, task.parts))
    if len(used) < 2:
        raise InputError(
            f"{task.path}: keep = {[list(part) for part in task.parts]} leaves {len(used)} of {count} photos (need 2); "
            f"they were taken from 0 to {times[-1]:.2f} s"
        )
    return used


def load_photo(path: Path, lens: Lens | None) -> tuple[Image, PhotoFacts]:
    """An image file as RGB, shape (h, w, 3), and what its header says.

    A posed image's lens describes the picture as stored, so it is turned upright only where it then fits the lens.

    Raises:
        InputError: missing, empty, cut off or undecodable, or of another shape than its lens is for.
    """
    stored = _stored_size(path)
    facts = photo_facts(path)
    as_stored = lens is not None and (facts.orientation < 5 or stored is None or lens.fits(*stored))
    flags = cv2.IMREAD_COLOR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0)
    image = np.asarray(cv2.cvtColor(decoded(path, flags), cv2.COLOR_BGR2RGB), np.uint8)
    if lens is not None and not lens.fits(image.shape[1], image.shape[0]):
        raise InputError(
            f"{path}: {image.shape[1]}x{image.shape[0]}, but its camera is for {lens.width}x{lens.height}; "
            "give the images the poses were made with"
        )
    return image, facts


def photo_times(clock: list[float | None], index: list[int]) -> list[float]:
    """Times from the first photo on [s] where every photo has a clock and they rise strictly; else the index."""
    if rises(clock):
        known = [t for t in clock if t is not None]
        return [t - known[0] for t in known]
    return [float(i) for i in index]


def rises(clock: list[float | None]) -> bool:
    """Whether two photos or more have a clock each, [s] or None, and it rises strictly."""
    known = [t for t in clock if t is not None]
    return len(known) == len(clock) and len(known) > 1 and all(b > a for a, b in itertools.pairwise(known))


def regular_choice(count: int, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` of `count` things, evenly spaced, ends included."""
    return np.arange(count) if count <= limit else np.round(np.linspace(0, count - 1, limit)).astype(np.int64)


def focal_prior(focal: list[float], size: tuple[int, int], name: str) -> Lens | None:
    """A lens with the photos' own focal length [longer sides], or None where they do not say."""
    if not focal:
        return None
    middle = float(np.median(focal))
    if max(focal) - min(focal) > _MAX_FOCAL_SPREAD * middle:
        runtime.say(f"  {name}: the photos' focal lengths differ (zoomed); give each zoom a source of its own")
    return Lens("SIMPLE_RADIAL", (middle * max(size), 0.5 * size[0], 0.5 * size[1], 0.0), *size)


def _differ(lenses: tuple[Lens, ...]) -> bool:
    """True where one distortion cannot describe the source: then it is taken out here, image by image."""
    several = len({(lens.model, lens.distortion) for lens in lenses}) > 1
    return several and any(lens.is_distorted for lens in lenses)


def _stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height as stored [px]; None where Pillow does not know the format.

    OpenCV fills the rest of a JPEG that is cut off with grey and says nothing; Pillow reads to the end and objects.
    """
    photo = opened(path)
    if photo is None:
        return None
    with photo:
        stored = photo.size
        if photo.format not in ("JPEG", "MPO"):
            return stored
        try:
            photo.draft("L", (stored[0] // 8, stored[1] // 8))  # cheap, yet reads to the end
            photo.load()
        except BROKEN:
            count = path.stat().st_size
            raise InputError(f"{path}: the image is cut off ({count} bytes); copy it again or remove it") from None
    return stored


def _mask(task: SourceTask, images: ImageSet, i: int, size: tuple[int, int]) -> Image | None:
    path, own = images.paths[i], images.masks[i] if images.masks else None
    found = task.masks.find((path.stem, path.name)) if task.masks else own
    return read_mask(found, *size) if found else None
