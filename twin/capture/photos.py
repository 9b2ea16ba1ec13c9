"""Reads image sets as `KeptFrames`, with focal length, GPS and time from the EXIF headers.

A *posed* set has a camera and a pose per image. A *stored* image is unrotated, as in the file; an *upright* image is
rotated by its EXIF orientation. A focal length *prior* comes from the header; structure from motion refines it.
"""

import hashlib
import itertools
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import ExifTags

from twin import runtime
from twin.capture.camera_models import Lens, same_aspect, undistorted
from twin.capture.capture_data import NO_GPS, QUEUE_SIZE, KeptFrames, SourceTask, given_lens, read_mask
from twin.capture.formats import ImageSet
from twin.capture.video import BLANK_STD, fitted_size, in_segments
from twin.errors import InputError
from twin.geometry.cameras import evenly_spaced
from twin.geometry.images import DECODE_ERRORS, decode_image, open_header, resize
from twin.types import Array, Image

_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)  # [mm]
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit
# Photos of a source count as zoomed if their focal lengths differ by more than this fraction.
_MAX_FOCAL_SPREAD = 0.05


# ---- EXIF


@dataclass(frozen=True)
class PhotoExif:
    """A photo's EXIF header."""

    focal: float | None  # focal length in units of the image's longer side; None if unknown
    gps: tuple[float, float, float]  # latitude [°], longitude [°], altitude [m]; NaN where unknown
    time: float | None  # time of exposure [s since the epoch, in the camera's time zone]; None if unknown
    orientation: int  # EXIF orientation, 1 to 8; 1 is upright


def read_exif(path: Path) -> PhotoExif:
    """Reads a photo's header; absent or malformed values count as unknown and raise no error."""
    nothing = PhotoExif(None, NO_GPS, None, 1)
    try:
        found = open_header(path)
        if found is None:
            return nothing
        with found as image:
            width, height = image.size
            exif = image.getexif()
            if not exif:
                return nothing
            photo, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    except DECODE_ERRORS:
        return nothing
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return PhotoExif(
        focal=focal_from_exif(photo, width, height) or _focal_from_model(path, width, height),
        gps=_gps(gps),
        time=_time(photo),
        orientation=orientation if orientation in range(1, 9) else 1,
    )


def focal_from_exif(photo: Any, width: int, height: int) -> float | None:
    """Focal length as a multiple of the image's longer side, from the Exif block of a header; None if unknown.

    It is computed from the 35 mm equivalent, which is defined by the image diagonal (CIPA DCG-001), or else from focal
    length and sensor resolution.
    """
    longer, diagonal = max(width, height), math.hypot(width, height)
    equivalent = _finite(photo.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent > 0.0:
        return equivalent / _FULL_FRAME_DIAGONAL * diagonal / longer
    millimeters = _finite(photo.get(ExifTags.Base.FocalLength))
    pitch = _finite(photo.get(ExifTags.Base.FocalPlaneXResolution))  # [px per unit]
    unit = _UNIT_MM.get(photo.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    full_width = _finite(photo.get(ExifTags.Base.ExifImageWidth)) or width
    full_height = _finite(photo.get(ExifTags.Base.ExifImageHeight)) or height
    if millimeters > 0.0 and pitch > 0.0 and unit:
        return millimeters * pitch / unit / max(full_width, full_height)
    return None


def _focal_from_model(path: Path, width: int, height: int) -> float | None:
    """Focal length as a multiple of the longer side, from COLMAP's table of cameras' sensor sizes; None if unknown."""
    try:
        camera = pycolmap.infer_camera_from_image(str(path))
    except (RuntimeError, ValueError):
        return None
    return camera.mean_focal_length() / max(width, height) if camera.has_prior_focal_length else None


def _gps(gps: Any) -> tuple[float, float, float]:
    tag = ExifTags.GPS
    latitude = _degrees(gps.get(tag.GPSLatitude), gps.get(tag.GPSLatitudeRef), "S")
    longitude = _degrees(gps.get(tag.GPSLongitude), gps.get(tag.GPSLongitudeRef), "W")
    # Cameras without a fix write zeros.
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return NO_GPS
    altitude = _finite(gps.get(tag.GPSAltitude), math.nan)
    below = gps.get(tag.GPSAltitudeRef) in (1, b"\x01")
    return latitude, longitude, -altitude if below else altitude


def _degrees(angle: Any, reference: Any, negative: str) -> float:
    """Degrees from (degrees, minutes, seconds); below 0 if `reference` is the letter `negative`, NaN if malformed."""
    try:
        total = sum(float(part) / 60.0**i for i, part in enumerate(angle))
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    return -total if str(reference).strip("\x00 ").upper() == negative else total


def _time(photo: Any) -> float | None:
    try:
        text = str(photo.get(ExifTags.Base.DateTimeOriginal)).strip("\x00 ")
        taken = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    fraction = str(photo.get(ExifTags.Base.SubsecTimeOriginal) or "").strip("\x00 ")
    seconds = (taken - datetime(1970, 1, 1)).total_seconds()
    return seconds + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


def _finite(value: Any, missing: float = 0.0) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return missing
    return number if math.isfinite(number) else missing


# ---- reading an image set


def read_photos(task: SourceTask, images: ImageSet) -> KeptFrames:
    """Reads, scales and writes the images of a set; drops exact duplicates and blank images.

    Raises InputError: an unreadable image, images of different aspect ratios, or only blank images.
    """
    if images.missing:
        runtime.log_line(
            f"  {task.path.name}: {images.missing} images are listed but do not exist; the build goes on without them"
        )
    if images.missing_masks:
        runtime.log_line(
            f"  {task.path.name}: {images.missing_masks} masks are listed but do not exist; these images are used whole"
        )
    lenses = images.lenses
    if lenses and (given := given_lens(task.path, task.source, (lenses[0].width, lenses[0].height))):
        lenses = (given,) * len(lenses)
    # A source has one camera model, so images with different distortions are undistorted here.
    several = lenses is not None and len({(lens.model, lens.distortion) for lens in lenses}) > 1
    flatten = several and any(lens.is_distorted for lens in lenses or ())
    available = _in_kept_segments(task, images)
    limit = min(task.config.frames or task.config.max_frames, task.config.max_frames)
    chosen = [int(available[i]) for i in evenly_spaced(len(available), limit)]
    if len(available) > limit and not task.config.frames:
        runtime.log_line(
            f"  {task.name}: {limit} of {len(available)} images are kept, as capture.max_frames = {limit}; raise it if "
            "they are more than 2 m apart, as on a long road"
        )
    mask_names = _mask_names(images.paths)
    index: list[int] = []
    gps: list[tuple[float, float, float]] = []
    clock: list[float | None] = []
    focals: list[float] = []
    poses: list[Array] = []
    posed_lenses: list[Lens] = []
    seen: set[bytes] = set()
    duplicates = blank = unmasked = 0
    native = size = largest = (0, 0)
    stream = _load_ahead(task.writer.pool, images.paths, lenses, chosen)
    for i, (image, exif) in runtime.track(stream, f"reading {task.name}", len(chosen), "image"):
        path, shape = images.paths[i], (image.shape[1], image.shape[0])
        if size == (0, 0):
            native, size = shape, fitted_size(*shape, task.config.max_size)
        if not same_aspect(shape, native):
            raise InputError(
                f"{path}: {shape[0]}x{shape[1]}, but the images before it are {native[0]}x{native[1]}; "
                "put images of another aspect ratio into a source of their own"
            )
        largest = max(largest, shape)
        if shape != size:
            image = resize(image, *size)
        digest = hashlib.sha256(image.tobytes()).digest()
        if digest in seen:
            duplicates += 1
            continue
        seen.add(digest)
        if float(image[::4, ::4].std()) < BLANK_STD:
            blank += 1
            continue
        own = images.masks[i] if images.masks and not task.masks else None
        mask = read_mask(own, *size) if own else task.mask(mask_names[i], *size)
        unmasked += mask is None
        if lenses and images.camera_to_world is not None:
            lens = lenses[i].scaled(*size)
            if flatten:
                mask = None if mask is None else undistorted(mask, lens, nearest=True)[0]
                image, lens = undistorted(image, lens)
            posed_lenses.append(lens)
            poses.append(images.camera_to_world[i])
        task.writer.put(i, image, mask)
        index.append(i)
        gps.append(exif.gps)
        clock.append(exif.time)
        focals += [exif.focal] if exif.focal else []
    if not index:
        raise InputError(f"{task.path}: all {len(chosen)} images are blank (one color); give photos of the place")
    if max(fitted_size(*largest, task.config.max_size)) > max(size):
        runtime.log_line(
            f"  {task.name}: photos of up to {largest[0]}x{largest[1]} are scaled to {size[0]}x{size[1]}, the size of "
            "the first one; give photos of another size a source of their own"
        )
    task.check_masked(unmasked, len(index))
    intrinsics = [lens.intrinsics for lens in posed_lenses]
    if posed_lenses:
        info = task.info(size, posed_lenses[0].with_intrinsics(np.median(intrinsics, axis=0)), True)
    elif known := given_lens(task.path, task.source, native):
        info = task.info(size, known.scaled(*size), True)
    else:
        info = task.info(size, _focal_prior(focals, size, task.name), False)
    metrics = {
        "kind": task.kind,
        "lighting": task.lighting,
        "decoded": len(chosen),
        "kept": len(index),
        "missing": images.missing,
        "duplicates": duplicates,
        "blank": blank,
        "with_gps": sum(math.isfinite(latitude) for latitude, _, _ in gps),
        "focal_prior_px": None if info.calibrated or not focals else round(info.camera_params[0], 1),
        "width": size[0],
        "height": size[1],
    }
    return KeptFrames(info, index, photo_times(clock, index), gps, metrics, poses, intrinsics)


def _mask_names(paths: Sequence[Path]) -> list[tuple[str, ...]]:
    """Names that each image's mask may have in a folder of masks, the best first.

    They are relative to the images' common folder; without subfolders only if no other subfolder has such an image.
    """
    top = Path(os.path.commonpath([path.parent for path in paths]))
    folders = Counter(stem for _, stem in {(path.parent, path.stem) for path in paths})
    below = [path.relative_to(top) for path in paths]
    return [
        (one.with_suffix("").as_posix(), one.as_posix(), *((one.stem, one.name) if folders[one.stem] == 1 else ()))
        for one in below
    ]


def _load_ahead(
    pool: ThreadPoolExecutor, paths: tuple[Path, ...], lenses: tuple[Lens, ...] | None, chosen: list[int]
) -> Iterator[tuple[int, tuple[Image, PhotoExif]]]:
    """Yields index and photo of the chosen photos in order. Threads load at most `QUEUE_SIZE` photos in advance."""
    waiting: list[tuple[int, Future[tuple[Image, PhotoExif]]]] = []
    for i in chosen:
        waiting.append((i, pool.submit(load_photo, paths[i], lenses[i] if lenses else None)))
        if len(waiting) >= QUEUE_SIZE:
            first, photo = waiting.pop(0)
            yield first, photo.result()
    for i, photo in waiting:
        yield i, photo.result()


def _in_kept_segments(task: SourceTask, images: ImageSet) -> NDArray[np.int64]:
    """Indices of the photos to use: those inside the source's segments, or all if the source has no segments."""
    count = len(images.paths)
    if not task.segments:
        return np.arange(count)
    clock = [read_exif(path).time for path in images.paths]
    if not _strictly_rising(clock):
        raise InputError(
            f"{task.path}: keep is given in seconds, but these photos' EXIF times are missing or do not increase in "
            "file-name order; put the photos to use into a folder of their own, and set keep only for films"
        )
    times = np.array(photo_times(clock, list(range(count))))
    used = np.flatnonzero(in_segments(times, task.segments))
    if len(used) < 2:
        raise InputError(
            f"{task.path}: keep = {[list(part) for part in task.segments]} leaves {len(used)} of {count} photos "
            f"(need 2); they were taken from 0 to {times[-1]:.2f} s"
        )
    return used


def load_photo(path: Path, lens: Lens | None) -> tuple[Image, PhotoExif]:
    """An image file as RGB, shape (h, w, 3), and its EXIF header.

    The lens of a posed image usually describes the stored image, so a posed image is rotated upright only if the stored
    image does not fit its lens.

    Raises InputError: the file is missing, empty, truncated or undecodable, or has another aspect ratio than its lens.
    """
    stored = _stored_size(path)
    exif = read_exif(path)
    as_stored = lens is not None and (exif.orientation < 5 or stored is None or lens.fits(*stored))
    flags = cv2.IMREAD_COLOR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0)
    image = np.asarray(cv2.cvtColor(decode_image(path, flags), cv2.COLOR_BGR2RGB), np.uint8)
    if lens is not None and not lens.fits(image.shape[1], image.shape[0]):
        raise InputError(
            f"{path}: {image.shape[1]}x{image.shape[0]}, but its camera is for {lens.width}x{lens.height}; "
            "use the images from which the poses were computed"
        )
    return image, exif


def _stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height as stored [px]; None for a format unknown to Pillow.

    Raises InputError for a truncated JPEG: OpenCV would silently fill the missing rest with gray.
    """
    photo = open_header(path)
    if photo is None:
        return None
    with photo:
        stored = photo.size
        if photo.format in ("JPEG", "MPO"):
            try:
                photo.draft("L", (stored[0] // 8, stored[1] // 8))  # cheap at this size, but reads the whole file
                photo.load()
            except DECODE_ERRORS:
                count = path.stat().st_size
                raise InputError(f"{path}: the image is cut off ({count} bytes); copy it again or remove it") from None
    return stored


def photo_times(clock: list[float | None], index: list[int]) -> list[float]:
    """Times since the first photo [s] if all are known and rise strictly; otherwise the photos' indices."""
    if _strictly_rising(clock):
        known = [t for t in clock if t is not None]
        return [t - known[0] for t in known]
    return [float(i) for i in index]


def _strictly_rising(clock: list[float | None]) -> bool:
    known = [t for t in clock if t is not None]
    return len(known) == len(clock) and len(known) > 1 and all(b > a for a, b in itertools.pairwise(known))


def _focal_prior(focals: list[float], size: tuple[int, int], name: str) -> Lens | None:
    """A lens with the median of the photos' focal lengths [longer sides]; None if none is known."""
    if not focals:
        return None
    median = float(np.median(focals))
    if max(focals) - min(focals) > _MAX_FOCAL_SPREAD * median:
        runtime.log_line(f"  {name}: the photos' focal lengths differ (zoomed); give each zoom a source of its own")
    return Lens("SIMPLE_RADIAL", (median * max(size), 0.5 * size[0], 0.5 * size[1], 0.0), *size)
