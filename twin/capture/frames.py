"""Stage `capture`: converts films and image sets to kept frames of one size with masks, times and a held-out split.

`video.py` decodes films and selects their frames. A *source* is one input under one lighting; its *kind* is video, bag,
images, colmap or transforms. A *kept* frame is upright and scaled to `capture.max_size`, and still has the lens's
distortion; a posed image may remain as stored, and is undistorted if distortions differ within its source. A frame's
name is `<source>/<index>`, where the index is its position in the whole film, or among all images of the set in natural
order. *Held-out* frames are never trained on.
"""

import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.capture.bag import BAG_SUFFIXES, bag_files, is_bag
from twin.capture.bag_film import BagContents, read_contents
from twin.capture.capture_data import NO_GPS, Capture, FrameWriter, KeptFrames, SourceTask, given_lens
from twin.capture.formats import find_model, image_files, listed_files, read_colmap, read_image_folder, read_transforms
from twin.capture.photos import load_photo, read_photos
from twin.capture.video import FilmStatistics, damage_note, first_size, format_note, read_film, video_film
from twin.config import CaptureConfig, SceneConfig, SourceConfig
from twin.config_file import MAX_NAME, check_lighting
from twin.errors import InputError
from twin.files import is_file, is_folder, require_folder
from twin.scene import SceneDir
from twin.types import Image

_SAME_FOCAL = 0.01  # focal lengths that differ by more than this share are not of one camera
# Path components that do not identify a source.
_GENERIC_NAMES = ("images", "image", "sparse", "colmap", "input", "0", "dense", "data")


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reads all sources of a scene and writes the kept frames and `Capture` to `out`; returns metrics.

    Raises InputError: an unreadable or impossible input, or fewer than two usable frames in all.
    """
    names = source_names([source.path for source in config.source])
    lightings = [source.lighting or _default_lighting(scene.root, source.path) for source in config.source]
    _tell_of_shared_lightings(config.source, lightings)
    for source, lighting in zip(config.source, lightings, strict=True):
        check_lighting(lighting, f"{source.path}: lighting")
        _check_calibration(scene.root / source.path, source)
    kept = []
    for name, lighting, source in zip(names, lightings, config.source, strict=True):
        with FrameWriter(out, name) as writer:
            kept.append(_read_source(scene.root, name, lighting, source, config.capture, writer))
    total = sum(len(one.index) for one in kept)
    if total < 2:
        noun = "frame" if total == 1 else "frames"
        raise InputError(
            f"{', '.join(names)}: {total} usable {noun} in all (need 2, better 50); "
            "move the camera, film longer, or raise capture.fps"
        )
    capture = _merged(kept, config.capture)
    capture.save(out)
    held_out = int(capture.held_out.sum())
    return {
        "frames": total,
        "train": total - held_out,
        "held_out": held_out,
        "posed": capture.camera_to_world is not None,
        "with_gps": int(np.isfinite(capture.gps[:, :2]).all(1).sum()),
        "sources": {one.info.name: one.metrics for one in kept},
    }


# ---- kinds and files of sources


def detect_kind(path: Path) -> str:
    """Detects a source's kind, one of `twin.config.KINDS`, from its files. Raises InputError if it has none."""
    folder = is_folder(path, "check `path` in scene.toml (it is relative to the scene folder)")
    if is_bag(path):
        return "bag"
    if path.suffix == ".zstd" and is_file(path):
        raise InputError(f"{path}: a compressed file of a bag; give the bag's folder")
    if not folder:
        return "transforms" if path.suffix.lower() == ".json" else "video"
    if find_model(path):
        return "colmap"
    if is_file(path / "transforms.json"):
        return "transforms"
    if image_files(path):
        return "images"
    if bags := sorted(file.name for suffix in BAG_SUFFIXES for file in path.glob(f"*{suffix}")):
        raise InputError(f"{path}: a bag without metadata.yaml; give its file, such as {bags[0]}")
    raise InputError(
        f"{path}: has no images, no COLMAP model and no transforms.json; give a film, a bag or an image folder"
    )


def source_files(path: Path, kind: str, images: Path | None = None) -> list[Path]:
    """All files that are read for a source, except the masks given in `scene.toml`.

    If an image set is damaged, only the files that can be determined are returned. `kind` may be auto; `images` is the
    separate image folder of a posed set. Raises InputError if `path` is not a source.
    """
    kind = detect_kind(path) if kind == "auto" else kind
    if kind == "transforms":
        table = path / "transforms.json" if path.is_dir() else path
        return [table, *listed_files(table, images)]
    if kind == "bag":
        return bag_files(path)
    if kind == "colmap" and path.is_dir() and (model := find_model(path)) is not None:
        files = [file for file in model.iterdir() if is_file(file)]
        try:
            return [*files, *read_colmap(path, images).paths]
        except InputError:
            return files  # reading the images will report the error
    return image_files(path) if kind == "images" and path.is_dir() else [path]


def source_names(paths: list[str]) -> list[str]:
    """Unique folder names for the sources, derived from their paths; only ASCII letters, digits and `-_.` occur."""
    names: list[str] = []
    for path in paths:
        base = _source_name(path)
        name, number = base, 2
        while name.lower() in (taken.lower() for taken in names):
            name, number = f"{base}_{number}", number + 1
        names.append(name)
    return names


def held_out_frames(count: int, every: int, source: int) -> NDArray[np.bool_]:
    """Mask (count,) of a source's held-out frames: one in `every`, not the first or last, at least one if `count` ≥ 3.

    The offset depends on the source's number, so that the same place is not held out under all lightings.
    """
    index = np.arange(count)
    held_out = index % every == (every // 2 + source) % every
    held_out[[0, -1]] = False
    if count >= 3 and not held_out.any():
        held_out[count // 2] = True
    return held_out


def _check_calibration(path: Path, source: SourceConfig) -> None:
    """Raises InputError if a calibration in `scene.toml` does not fit its film or folder of photos.

    This is called before any source is read. Posed sets and bags are checked only when they are read.
    """
    kind = detect_kind(path) if source.kind == "auto" else source.kind
    if source.camera is None or kind not in ("video", "images"):
        return
    size = first_size(path) if kind == "video" else load_photo(read_image_folder(path).paths[0], None)[0].shape[1::-1]
    if size is not None:
        given_lens(path, source, size)


def _read_source(
    root: Path, name: str, lighting: str, source: SourceConfig, config: CaptureConfig, writer: FrameWriter
) -> KeptFrames:
    path = root / source.path
    kind = detect_kind(path) if source.kind == "auto" else source.kind
    if source.topic and kind != "bag":
        raise InputError(f"{path}: topic = {source.topic!r}, but this is not a bag ({kind}); remove the topic")
    masks = root / source.mask if source.mask else None
    cure = "give as mask an image or a folder of images, 0 = ignore"
    if masks and is_folder(masks, cure) and not any(masks.iterdir()):
        raise InputError(f"{masks}: this mask folder is empty; put one image per frame in it, 0 = ignore")
    task = SourceTask(path, name, lighting, kind, source, config, masks, writer)
    images = root / source.images if source.images else None
    if images:
        require_folder(images, "check `images` in scene.toml; expected a folder")
    if kind == "video":
        return _read_video(task, None)
    if kind == "bag":
        return _read_video(task, read_contents(path, source.topic))
    if kind == "images":
        return read_photos(task, read_image_folder(path))
    return read_photos(task, read_colmap(path, images) if kind == "colmap" else read_transforms(path, images))


def _read_video(task: SourceTask, bag: BagContents | None) -> KeptFrames:
    """Reads a video file, or the film in a bag with its calibration and positions."""
    film = video_film(task.path) if bag is None else bag.film()
    if bag is not None:
        given_lens(task.path, task.source, bag.size)
    index: list[int] = []
    times: list[float] = []
    count, unmasked, size = FilmStatistics(), 0, (0, 0)

    def mask_of(frame: int, width: int, height: int) -> Image | None:
        return task.mask((f"{frame:06d}",), width, height)

    with runtime.bar(f"reading {task.name}", 0, "frame") as bar:
        for frame in read_film(film, task.config, count, mask_of, task.segments):
            size = (frame.image.shape[1], frame.image.shape[0])
            task.writer.put(frame.index, frame.image, frame.mask)
            unmasked += frame.mask is None
            index.append(frame.index)
            times.append(frame.time)
            bar.total = count.declared
            bar.update(count.decoded - bar.n)
    for note in filter(None, (damage_note(task.path, count), format_note(task.path, count))):
        runtime.log_line(f"  {note}")
    task.check_masked(unmasked, len(index))
    lens = given_lens(task.path, task.source, count.size)
    if lens is None and bag is not None and bag.lens is not None:
        lens = bag.lens.scaled(*count.size)
    info = task.info(size, lens.scaled(*size) if lens else None, lens is not None)
    metrics = {
        "kind": task.kind,
        "lighting": task.lighting,
        "decoded": count.decoded,
        "promised": count.declared,
        "kept": len(index),
        "duplicates": count.duplicates,
        "damaged": count.damaged,
        "blank": count.blank,
        "hdr": count.hdr,
        "interlaced": count.interlaced,
        "duration_s": round(count.duration, 3),
        "width": size[0],
        "height": size[1],
        "median_sharpness": round(float(np.median(count.sharpness)), 4),
    }
    if bag is None:
        return KeptFrames(info, index, times, [NO_GPS] * len(index), metrics, [], [])
    fixes, odometry = bag.fixes_at(np.array(times)), bag.odometry_at(np.array(times))
    metrics |= {
        "topics": bag.topics,
        "calibration": "scene.toml" if task.source.camera else bag.lens_note,
        "with_odometry": int(np.isfinite(odometry).all(1).sum()),
    }
    runtime.log_line(f"  {task.name}: {bag.topics['pictures']}; {metrics['calibration']}")
    return KeptFrames(info, index, times, list(map(tuple, fixes)), metrics, [], [], list(map(tuple, odometry)))


def _merged(kept: list[KeptFrames], config: CaptureConfig) -> Capture:
    without = [one.info.name for one in kept if not one.poses]
    if 0 < len(without) < len(kept):
        bare = ", ".join(without)
        runtime.log_line(f"  the given poses are not used: {bare} has none, so all cameras are reconstructed together")
        kept = [_with_one_camera(one) for one in kept]
    counts = [len(one.index) for one in kept]
    odometry = [row for one in kept for row in one.odometry or [NO_GPS] * len(one.index)]
    return Capture(
        sources=tuple(one.info for one in kept),
        names=tuple(f"{one.info.name}/{i:06d}" for one in kept for i in one.index),
        source_index=np.repeat(np.arange(len(kept)), counts),
        times=np.array([t for one in kept for t in one.times], np.float64),
        held_out=np.concatenate([held_out_frames(n, config.held_out_every, i) for i, n in enumerate(counts)]),
        gps=np.array([g for one in kept for g in one.gps], np.float64).reshape(-1, 3),
        camera_to_world=None if without else np.stack([pose for one in kept for pose in one.poses]),
        intrinsics=None if without else np.stack([k for one in kept for k in one.intrinsics]),
        odometry=np.array(odometry, np.float64).reshape(-1, 3) if np.isfinite(odometry).any() else None,
    )


def _with_one_camera(kept: KeptFrames) -> KeptFrames:
    """Frames whose poses are not used: their camera is calibrated only if all of them have the same focal length."""
    if not kept.poses:
        return kept
    focal = np.array(kept.intrinsics)[:, 0]
    if np.ptp(focal) <= _SAME_FOCAL * np.median(focal):
        return kept
    runtime.log_line(f"  {kept.info.name}: its focal lengths differ, so one is estimated for all of its images")
    return replace(kept, info=replace(kept.info, calibrated=False))


def _default_lighting(root: Path, path: str) -> str:
    """The lighting of a source without a given one: the specific part of its path, with letters of any script."""
    chosen = _specific_part(path, Path(path).name if (root / path).is_dir() else Path(path).stem)
    composed = unicodedata.normalize("NFC", chosen)  # macOS stores accents apart from their letters
    kept = "".join(c if c.isalnum() or c in "-_." else "_" for c in composed).strip(".")
    return (kept or "source")[:MAX_NAME].encode()[: 2 * MAX_NAME].decode(errors="ignore")


def _tell_of_shared_lightings(sources: Sequence[SourceConfig], lightings: Sequence[str]) -> None:
    """Logs which sources share a lighting only because their names are alike."""
    by_name: dict[str, list[str]] = {}
    for source, lighting in zip(sources, lightings, strict=True):
        if not source.lighting:
            by_name.setdefault(lighting, []).append(source.path)
    for lighting, paths in by_name.items():
        if len(paths) > 1:
            runtime.log_line(
                f"  {' and '.join(paths)} count as filmed under one lighting, {lighting!r}, by their names; if they "
                "were not, give each [[source]] a lighting"
            )


def _specific_part(path: str, last: str) -> str:
    """The last part of a path that is not generic; `last` replaces its last part."""
    parts = [part for part in (*Path(path).parent.parts, last) if part not in ("", ".", "..", "/")]
    specific = [part for part in parts if not part.startswith("transforms") and part.lower() not in _GENERIC_NAMES]
    return specific[-1] if specific else (parts[-1] if parts else "source")


def _source_name(path: str) -> str:
    """A source's name: the last part of its path that is not generic, without suffix."""
    chosen = _specific_part(path, Path(path).stem)
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in chosen).strip(".") or "source"
