"""Stage 1, capture: films and image sets become kept frames of one size, with masks, clock and a train/held-out split.

A *source* is one input under one lighting. A *kept* frame is upright and scaled down to `capture.max_size`, with the
lens's distortion still in it. Its name is `<source>/<index>`, where the index is its place in the film, or in the image
set's natural order, so the same moment has the same name whatever else is kept. *Held-out* frames are never trained on.
"""

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from twin import progress
from twin.capture.exif import PhotoFacts, photo_facts
from twin.capture.formats import ImageSet, detect_kind, read_colmap, read_image_folder, read_transforms
from twin.capture.lens import Lens, checked_lens, same_aspect, undistort
from twin.capture.masks import Masks, read_mask
from twin.capture.types import Capture, SourceInfo
from twin.capture.video import FilmCount, damage_note, fitted_size, read_film
from twin.config import CaptureConfig, SceneConfig, SourceConfig
from twin.errors import InputError
from twin.geometry.images import resize, write_image
from twin.scene import SceneDir

_BLANK = 2.0  # [grey levels], a picture whose brightness varies less than this shows nothing
_MAX_FOCAL_SPREAD = 0.05  # relative; photos of one source that differ more were zoomed
_AHEAD = 4  # pictures decoded or encoded beside the one at hand; bounds the memory
_PLAIN_NAMES = ("images", "image", "sparse", "colmap", "transforms", "input", "0", "dense", "data")

Image = NDArray[np.uint8]
T = TypeVar("T")
R = TypeVar("R")


@dataclass
class Kept:
    """The kept frames of one source, in order, and what is known of each."""

    info: SourceInfo | None = None
    index: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    gps: list[tuple[float, float, float]] = field(default_factory=list)
    poses: list[NDArray[np.float64]] = field(default_factory=list)
    intrinsics: list[NDArray[np.float64]] = field(default_factory=list)
    metrics: dict[str, Any] = field(default_factory=dict)


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reads every source of a scene and writes the kept frames and `Capture` to `out`.

    Raises:
        InputError: an unreadable or impossible input, or fewer than two usable frames in all.
    """
    names = source_names([source.path for source in config.source])
    kept = []
    for name, source in zip(names, config.source, strict=True):
        with _Writer(out, name) as writer:
            kept.append(_read_source(scene.root, name, source, config.capture, writer))
    total = sum(len(one.index) for one in kept)
    if total < 2:
        raise InputError(
            f"{scene.root.name}: {total} usable frame in all sources (need 2, better 50); film longer or raise capture.fps"
        )
    capture = _joined(names, kept, config.capture)
    capture.save(out)
    held_out = int(capture.held_out.sum())
    return {
        "frames": total,
        "train": total - held_out,
        "held_out": held_out,
        "posed": capture.camera_to_world is not None,
        "gps": int(np.isfinite(capture.gps[:, :2]).all(1).sum()),
        "sources": {name: one.metrics for name, one in zip(names, kept, strict=True)},
    }


def source_names(paths: list[str]) -> list[str]:
    """A unique folder name for each source: what its path is called, in characters every tool takes."""
    names: list[str] = []
    for path in paths:
        base = _stem(path)
        name, number = base, 2
        while name.lower() in (taken.lower() for taken in names):
            name, number = f"{base}_{number}", number + 1
        names.append(name)
    return names


def held_out_frames(count: int, every: int, source: int) -> NDArray[np.bool_]:
    """Which of a source's frames are held out: every n-th, never the first or the last, one at least of three.

    The offset moves on from source to source, so that equal moments under several lightings are not all held out.
    """
    index = np.arange(count)
    held_out = index % every == (every // 2 + source) % every
    held_out[[0, -1]] = False
    if count >= 3 and not held_out.any():
        held_out[count // 2] = True
    return held_out


def regular_choice(count: int, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` of `count` things, evenly spaced, ends included."""
    return np.arange(count) if count <= limit else np.round(np.linspace(0, count - 1, limit)).astype(np.int64)


def _joined(names: list[str], kept: list[Kept], config: CaptureConfig) -> Capture:
    posed = [bool(one.poses) for one in kept]
    if any(posed) and not all(posed):
        without = ", ".join(name for name, has in zip(names, posed, strict=True) if not has)
        progress.say(f"  the poses given are not used: {without} brings none, so all cameras are reconstructed together")
    counts = [len(one.index) for one in kept]
    return Capture(
        sources=tuple(one.info for one in kept if one.info),
        names=tuple(f"{name}/{i:06d}" for name, one in zip(names, kept, strict=True) for i in one.index),
        source_index=np.repeat(np.arange(len(kept)), counts),
        times=np.array([t for one in kept for t in one.times], np.float64),
        held_out=np.concatenate([held_out_frames(n, config.held_out_every, i) for i, n in enumerate(counts)]),
        gps=np.array([g for one in kept for g in one.gps], np.float64).reshape(-1, 3),
        camera_to_world=np.stack([p for one in kept for p in one.poses]) if all(posed) else None,
        intrinsics=np.stack([k for one in kept for k in one.intrinsics]) if all(posed) else None,
    )


def _read_source(root: Path, name: str, source: SourceConfig, config: CaptureConfig, writer: "_Writer") -> Kept:
    path = root / source.path
    kind = detect_kind(path) if source.kind == "auto" or not path.exists() else source.kind
    lighting = source.lighting or _stem(source.path)
    if set(lighting) & set(":/"):
        raise InputError(f"lighting = {lighting!r}: ':' and '/' have a meaning of their own; choose a plain name")
    images = root / source.images if source.images else None
    masks = Masks(root / source.mask) if source.mask else None
    if kind == "video":
        return _read_video(path, name, lighting, source, config, masks, writer)
    readers: dict[str, Callable[[], ImageSet]] = {
        "images": lambda: read_image_folder(path),
        "colmap": lambda: read_colmap(path, images),
        "transforms": lambda: read_transforms(path, images),
    }
    return _read_images(path, readers[kind](), name, lighting, kind, source, config, masks, writer)


def _read_video(
    path: Path,
    name: str,
    lighting: str,
    source: SourceConfig,
    config: CaptureConfig,
    masks: Masks | None,
    writer: "_Writer",
) -> Kept:
    kept, count, unmasked = Kept(), FilmCount(), 0

    def mask_of(index: int, image: Image) -> Image | None:
        found = masks.find((f"{index:06d}",)) if masks else None
        return read_mask(found, image.shape[1], image.shape[0]) if found else None

    size = (0, 0)
    for frame in progress.track(read_film(path, config, count, mask_of), f"reading {name}", 0, "frame"):
        size = (frame.image.shape[1], frame.image.shape[0])
        mask = mask_of(frame.index, frame.image)
        unmasked += masks is not None and mask is None
        writer.put(frame.index, frame.image, mask)
        kept.index.append(frame.index)
        kept.times.append(frame.time)
        kept.gps.append((math.nan,) * 3)
    if note := damage_note(path, count):
        progress.say(f"  {note}")
    _check_masked(masks, unmasked, len(kept.index))
    lens = _given_lens(source, count.size, size, f"{path.name}: camera")
    kept.info = _info(name, lighting, "video", size, lens, lens is not None, source)
    kept.metrics = {
        "kind": "video",
        "lighting": lighting,
        "decoded": count.decoded,
        "kept": len(kept.index),
        "duplicates": count.duplicates,
        "damaged": count.damaged,
        "blank": count.blank,
        "duration_s": round(count.duration, 3),
        "width": size[0],
        "height": size[1],
        "median_sharpness": _median(count.sharpness),
    }
    return kept


def _read_images(
    path: Path,
    images: ImageSet,
    name: str,
    lighting: str,
    kind: str,
    source: SourceConfig,
    config: CaptureConfig,
    masks: Masks | None,
    writer: "_Writer",
) -> Kept:
    if images.missing:
        progress.say(f"  {path.name}: {images.missing} images are listed but do not exist; going on without them")
    posed = images.lenses is not None
    lenses = images.lenses
    if lenses and source.camera:
        given = _config_lens(source, (lenses[0].width, lenses[0].height), f"{path.name}: camera")
        lenses = tuple(given for _ in lenses)
    # One distortion describes the source; where lenses differ in it, it is taken out here, picture by picture.
    flatten = bool(lenses) and len({(lens.model, lens.distortion) for lens in lenses}) > 1
    flatten = flatten and any(lens.is_distorted for lens in lenses or ())

    chosen = regular_choice(len(images.paths), min(config.frames or config.max_frames, config.max_frames))
    load = lambda i: (int(i), _load_photo(images.paths[i], lenses[i] if lenses else None))  # noqa: E731
    kept, seen, counts = Kept(), set(), {"duplicates": 0, "blank": 0, "unmasked": 0}
    clock: list[float | None] = []
    focal: list[float] = []
    native = size = (0, 0)
    kept_lenses: list[Lens] = []
    for i, (image, facts) in progress.track(
        _ahead(writer.pool, load, chosen), f"reading {name}", len(chosen), "image"
    ):
        height, width = image.shape[:2]
        if size == (0, 0):
            native, size = (width, height), fitted_size(width, height, config.max_size)
        if not same_aspect((width, height), native):
            raise InputError(
                f"{images.paths[i]}: {width}x{height}, but the images before it are {native[0]}x{native[1]}; "
                "put images of another shape into a source of their own"
            )
        image = image if (width, height) == size else resize(image, *size).astype(np.uint8, copy=False)
        digest = hashlib.sha256(image.tobytes()).digest()
        if digest in seen:
            counts["duplicates"] += 1
            continue
        seen.add(digest)
        if float(image[::4, ::4].std()) < _BLANK:
            counts["blank"] += 1
            continue
        mask = _photo_mask(images, i, masks, size)
        counts["unmasked"] += masks is not None and mask is None
        if lenses:
            lens = lenses[i].scaled(*size)
            kept.poses.append(images.camera_to_world[i])  # type: ignore[index]
            kept.intrinsics.append(lens.intrinsics)
            if flatten:
                image, covered = undistort(image, lens)
                mask = covered if mask is None else np.minimum(undistort(mask, lens)[0], covered)
                lens = Lens("PINHOLE", tuple(lens.intrinsics), *size)
            kept_lenses.append(lens)
        writer.put(i, image, mask)
        kept.index.append(i)
        kept.gps.append(facts.gps)
        clock.append(facts.time)
        if facts.focal:
            focal.append(facts.focal)
    if not kept.index:
        raise InputError(f"{path}: all {len(chosen)} images are blank (one colour); give photos that show something")
    kept.times = photo_times(clock, kept.index)
    _check_masked(masks, counts["unmasked"], len(kept.index))
    if posed:
        lens = kept_lenses[0].with_intrinsics(np.median([k.intrinsics for k in kept_lenses], axis=0))
        kept.info = _info(name, lighting, kind, size, lens, True, source)
    else:
        given = _given_lens(source, native, size, f"{path.name}: camera")
        kept.info = _info(name, lighting, kind, size, given or _prior(focal, size, name), given is not None, source)
    kept.metrics = {
        "kind": kind,
        "lighting": lighting,
        "decoded": len(chosen),
        "kept": len(kept.index),
        "missing": images.missing,
        "duplicates": counts["duplicates"],
        "blank": counts["blank"],
        "with_gps": int(sum(math.isfinite(g[0]) for g in kept.gps)),
        "focal_prior_px": None if posed or not focal else round(float(np.median(focal)) * max(size), 1),
        "width": size[0],
        "height": size[1],
    }
    return kept


def photo_times(clock: list[float | None], index: list[int]) -> list[float]:
    """Times from the first photo on [s] where every photo has a clock and they rise strictly; else the index."""
    known = [t for t in clock if t is not None]
    if len(known) == len(clock) and len(known) > 1 and all(b > a for a, b in zip(known, known[1:], strict=False)):
        return [t - known[0] for t in known]
    return [float(i) for i in index]


def _load_photo(path: Path, lens: Lens | None) -> tuple[Image, PhotoFacts]:
    """An image file as RGB and what its header says.

    A posed image's lens describes the picture as stored, so it is turned upright only where it then fits the lens.
    """
    data = np.frombuffer(path.read_bytes(), np.uint8) if path.exists() else np.zeros(0, np.uint8)
    problem = InputError(f"{path}: not a readable image ({len(data)} bytes); replace or remove it")
    if not len(data):
        raise problem
    facts = photo_facts(path)
    try:
        with PillowImage.open(path) as photo:
            stored = photo.size
            if photo.format in ("JPEG", "MPO"):
                photo.draft("L", (stored[0] // 8, stored[1] // 8))  # cheap, yet reads to the end
                photo.load()
    except (OSError, SyntaxError, ValueError):
        raise InputError(f"{path}: the image is cut off ({len(data)} bytes); copy it again or remove it") from None
    turn = facts.orientation >= 5 and lens is not None and not lens.fits(*stored)
    as_stored = lens is not None and not turn
    raw = cv2.imdecode(data, cv2.IMREAD_COLOR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0))
    if raw is None:
        raise problem
    image = cv2.cvtColor(raw, cv2.COLOR_BGR2RGB)
    if lens is not None and not lens.fits(image.shape[1], image.shape[0]):
        raise InputError(
            f"{path}: {image.shape[1]}x{image.shape[0]}, but its camera is for {lens.width}x{lens.height}; "
            "give the images the poses were made with"
        )
    return image.astype(np.uint8, copy=False), facts


def _photo_mask(images: ImageSet, i: int, masks: Masks | None, size: tuple[int, int]) -> Image | None:
    path = images.paths[i]
    found = masks.find((path.stem, path.name)) if masks else (images.masks[i] if images.masks else None)
    return read_mask(found, *size) if found else None


def _check_masked(masks: Masks | None, unmasked: int, count: int) -> None:
    if masks and unmasked == count:
        raise InputError(
            f"{masks.path}: no mask here is named like a frame; name them 000012.png (frame of the film) or like the photo"
        )
    if unmasked:
        progress.say(f"  {masks.path.name if masks else ''}: {unmasked} of {count} frames have no mask and are used whole")


def _config_lens(source: SourceConfig, native: tuple[int, int], where: str) -> Lens:
    camera = source.camera
    assert camera is not None
    width, height = (camera.width, camera.height) if camera.width or camera.height else native
    return checked_lens(camera.model, camera.params, width, height, where)


def _given_lens(source: SourceConfig, native: tuple[int, int], size: tuple[int, int], where: str) -> Lens | None:
    """The calibration of `scene.toml` at the kept size, or None. `native` is the upright size of the input."""
    if source.camera is None:
        return None
    lens = _config_lens(source, native, where)
    if not lens.fits(*size):
        raise InputError(
            f"{where} is for {lens.width}x{lens.height}, but the upright picture is {native[0]}x{native[1]}; "
            "give the calibration of the upright picture"
        )
    return lens.scaled(*size)


def _prior(focal: list[float], size: tuple[int, int], name: str) -> Lens | None:
    """A lens with the photos' own focal length, or None where they do not say."""
    if not focal:
        return None
    middle = float(np.median(focal))
    if max(focal) - min(focal) > _MAX_FOCAL_SPREAD * middle:
        progress.say(f"  {name}: the photos' focal lengths differ (zoomed); give each zoom a source of its own")
    return Lens("SIMPLE_RADIAL", (middle * max(size), 0.5 * size[0], 0.5 * size[1], 0.0), *size)


def _info(
    name: str,
    lighting: str,
    kind: str,
    size: tuple[int, int],
    lens: Lens | None,
    calibrated: bool,
    source: SourceConfig,
) -> SourceInfo:
    model, params = (lens.model, lens.params) if lens else ("SIMPLE_RADIAL", ())
    return SourceInfo(name, lighting, kind, *size, model, params, calibrated, source.camera_height)


def _stem(path: str) -> str:
    parts = [part for part in Path(path).with_suffix("").parts if part not in (".", "..", "/")]
    telling = [part for part in parts if not part.lower().startswith("transforms") and part.lower() not in _PLAIN_NAMES]
    chosen = telling[-1] if telling else (parts[-1] if parts else "source")
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in chosen).strip(".") or "source"


def _median(values: list[float]) -> float | None:
    return round(float(np.median(values)), 4) if values else None


def _ahead(pool: ThreadPoolExecutor, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Maps in threads, in order, never more than a few results ahead of the consumer."""
    waiting: list[Future[R]] = []
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= _AHEAD:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()


class _Writer:
    """Encodes and writes a source's frames and masks in threads; a failure surfaces at the next frame or at the end."""

    def __init__(self, out: Path, name: str) -> None:
        self.images, self.masks = out / "images" / name, out / "masks" / name
        self.pool = ThreadPoolExecutor(2)
        self.waiting: list[Future[None]] = []

    def put(self, index: int, image: Image, mask: Image | None) -> None:
        while len(self.waiting) >= _AHEAD:
            self.waiting.pop(0).result()
        self.waiting.append(self.pool.submit(self._write, f"{index:06d}.png", image, mask))

    def _write(self, file: str, image: Image, mask: Image | None) -> None:
        grey = (image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all()
        write_image(self.images / file, image[..., 0] if grey else image)
        if mask is not None:
            write_image(self.masks / file, mask)

    def __enter__(self) -> "_Writer":
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.pool.shutdown(wait=True, cancel_futures=error is not None)
        if error is None:
            for future in self.waiting:
                future.result()

