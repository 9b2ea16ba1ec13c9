"""Stage `capture`: converts films and image sets to kept frames of one size with masks, times and a held-out split.

A *source* is one input under one lighting. A *kept* frame is upright and scaled to `capture.max_size`; it still has the
lens's distortion. Its name is `<source>/<index>`, where the index is its position in the film or in the natural order
of the image set: it does not depend on which other frames are kept. *Held-out* frames are never trained on.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.capture.capture_data import Capture
from twin.capture.formats import detect_kind, read_colmap, read_image_folder, read_transforms
from twin.capture.photos import read_photos
from twin.capture.sources import NO_GPS, FrameWriter, KeptFrames, Masks, SourceTask, read_mask
from twin.capture.video import FilmStatistics, damage_note, read_film
from twin.config import CaptureConfig, SceneConfig, SourceConfig
from twin.config_file import MAX_NAME, check_lighting
from twin.errors import InputError
from twin.files import require_folder
from twin.scene import SceneDir
from twin.types import Image

# Generic path components, which do not identify a source.
_GENERIC_NAMES = ("images", "image", "sparse", "colmap", "input", "0", "dense", "data")


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reads all sources of a scene and writes the kept frames and `Capture` to `out`; returns metrics.

    Raises InputError: an unreadable or impossible input, or fewer than two usable frames in all.
    """
    names = source_names([source.path for source in config.source])
    lightings = [_lighting_name(source) for source in config.source]
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


def source_names(paths: list[str]) -> list[str]:
    """A unique folder name for each source, derived from its path, of ASCII letters, digits and `-_.`."""
    names: list[str] = []
    for path in paths:
        base = _source_name(path)
        name, number = base, 2
        while name.lower() in (taken.lower() for taken in names):
            name, number = f"{base}_{number}", number + 1
        names.append(name)
    return names


def held_out_frames(count: int, every: int, source: int) -> NDArray[np.bool_]:
    """Mask (count,) of a source's held-out frames: every n-th, never the first or last, at least one of three or more.

    The offset depends on the source's number, so that the same place is not held out under all lightings.
    """
    index = np.arange(count)
    held_out = index % every == (every // 2 + source) % every
    held_out[[0, -1]] = False
    if count >= 3 and not held_out.any():
        held_out[count // 2] = True
    return held_out


def _lighting_name(source: SourceConfig) -> str:
    lighting = source.lighting or _source_name(source.path)[:MAX_NAME]
    check_lighting(lighting, f"{source.path}: lighting")
    return lighting


def _read_source(
    root: Path, name: str, lighting: str, source: SourceConfig, config: CaptureConfig, writer: FrameWriter
) -> KeptFrames:
    path = root / source.path
    kind = detect_kind(path) if source.kind == "auto" else source.kind
    masks = Masks(root / source.mask) if source.mask else None
    task = SourceTask(path, name, lighting, kind, source, config, masks, writer)
    images = root / source.images if source.images else None
    if images:
        require_folder(images, "check images = in scene.toml, a folder")
    if kind == "video":
        return _read_video(task)
    if kind == "images":
        return read_photos(task, read_image_folder(path))
    return read_photos(task, read_colmap(path, images) if kind == "colmap" else read_transforms(path, images))


def _read_video(task: SourceTask) -> KeptFrames:
    def mask_of(index: int, width: int, height: int) -> Image | None:
        found = task.masks.find((f"{index:06d}",)) if task.masks else None
        return read_mask(found, width, height) if found else None

    kept, count, unmasked = KeptFrames(task.info((0, 0), None, False)), FilmStatistics(), 0
    size = (0, 0)
    with runtime.bar(f"reading {task.name}", 0, "frame") as bar:
        for frame in read_film(task.path, task.config, count, mask_of, task.segments):
            size = (frame.image.shape[1], frame.image.shape[0])
            task.writer.put(frame.index, frame.image, frame.mask)
            unmasked += frame.mask is None
            kept.index.append(frame.index)
            kept.times.append(frame.time)
            kept.gps.append(NO_GPS)
            bar.total = count.declared
            bar.update(count.decoded - bar.n)
    if note := damage_note(task.path, count):
        runtime.log_line(f"  {note}")
    task.check_masked(unmasked, len(kept.index))
    lens = task.given_lens(count.size)
    kept.info = task.info(size, lens.scaled(*size) if lens else None, lens is not None)
    kept.metrics = {
        "kind": "video",
        "lighting": task.lighting,
        "decoded": count.decoded,
        "promised": count.declared,
        "kept": len(kept.index),
        "duplicates": count.duplicates,
        "damaged": count.damaged,
        "blank": count.blank,
        "duration_s": round(count.duration, 3),
        "width": size[0],
        "height": size[1],
        "median_sharpness": round(float(np.median(count.sharpness)), 4),
    }
    return kept


def _merged(kept: list[KeptFrames], config: CaptureConfig) -> Capture:
    without = [one.info.name for one in kept if not one.poses]
    if 0 < len(without) < len(kept):
        bare = ", ".join(without)
        runtime.log_line(
            f"  the poses given are not used: {bare} brings none, so all cameras are reconstructed together"
        )
    counts = [len(one.index) for one in kept]
    return Capture(
        sources=tuple(one.info for one in kept),
        names=tuple(f"{one.info.name}/{i:06d}" for one in kept for i in one.index),
        source_index=np.repeat(np.arange(len(kept)), counts),
        times=np.array([t for one in kept for t in one.times], np.float64),
        held_out=np.concatenate([held_out_frames(n, config.held_out_every, i) for i, n in enumerate(counts)]),
        gps=np.array([g for one in kept for g in one.gps], np.float64).reshape(-1, 3),
        camera_to_world=None if without else np.stack([pose for one in kept for pose in one.poses]),
        intrinsics=None if without else np.stack([k for one in kept for k in one.intrinsics]),
    )


def _source_name(path: str) -> str:
    """A source's name: the last part of its path that is not generic, without suffix."""
    parts = [part for part in (*Path(path).parent.parts, Path(path).stem) if part not in ("", ".", "..", "/")]
    specific = [part for part in parts if not part.startswith("transforms") and part.lower() not in _GENERIC_NAMES]
    chosen = specific[-1] if specific else (parts[-1] if parts else "source")
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in chosen).strip(".") or "source"
