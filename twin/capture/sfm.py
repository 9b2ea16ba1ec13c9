"""Stage `cameras`: camera poses and sparse points by structure from motion, and images without lens distortion.

The output frame is that of the reconstruction, with arbitrary rotation, origin and scale, unless the input has poses.
This module starts the worker process (`worker.py`, `mapping.py`), checks its result and writes the stage's files.
"""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.capture.camera_models import fitted_pinhole, undistortion_map, write_pinhole_image
from twin.capture.capture_data import Capture
from twin.capture.pycolmap_import import pycolmap
from twin.capture.worker import run_worker
from twin.config import CamerasConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.scene import SceneDir

_MAX_THREADS = 16
_MAX_POINT_ERROR = 20.0  # [px] points that bundle adjustment moved behind a camera exceed it by far


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reconstructs the cameras of a capture; writes `Cameras`, `SparsePoints`, `images/` and `masks/` to `out`.

    Returns:
        registered, total, reprojection_error_px, mean_track_length, points, focal_px (per source), pairs,
        verified_pairs, outliers (names), mapper, registered_per_source.

    Raises:
        InputError: no texture, no overlap, or fewer frames registered than `cameras.min_registered`.
    """
    capture = Capture.load(scene.stage("capture"))
    work = out / "work"
    work.mkdir()
    settings = config.cameras
    if settings.mapper not in ("auto", "global", "incremental"):
        raise InputError(f"cameras.mapper = {settings.mapper!r}; expected auto, global or incremental")
    run_worker(
        {
            "task": "map",
            "capture": str(scene.stage("capture").resolve()),
            "work": str(work.resolve()),
            "features": settings.features,
            "max_feature_size": settings.max_feature_size,
            "mapper": settings.mapper,
            "min_registered": settings.min_registered,
            "max_outlier": settings.max_outlier,
            "free_focal": settings.free_focal,
            "seed": config.seed,
            "threads": min(os.cpu_count() or 1, _MAX_THREADS),
        },
        work,
    )
    summary = read_json(work / "result.json")
    with np.load(work / "result.npz", allow_pickle=False) as result:
        frames, poses = result["frames"], result["camera_to_world"]
        points = _sparse_points(result, frames, len(capture.names))
    _check_registered(capture, frames, settings)
    intrinsics, sizes = _write_images(capture, scene.stage("capture"), frames, summary["cameras"], out)
    source_of = [capture.sources[int(s)] for s in capture.source_index[frames]]
    cameras = Cameras(
        names=tuple(capture.names[i] for i in frames),
        camera_to_world=poses,
        intrinsics=intrinsics,
        sizes=sizes,
        lightings=tuple(source.lighting for source in source_of),
        sources=tuple(source.name for source in source_of),
        times=capture.times[frames],
        held_out=capture.held_out[frames],
        images=out / "images",
        masks=out / "masks" if (out / "masks").exists() else None,
    )
    cameras.save(out)
    points.save(out)
    shutil.rmtree(work)
    return _metrics(capture, cameras, points, summary)


def _sparse_points(result: Any, frames: NDArray[np.int64], total: int) -> SparsePoints:
    row = np.full(total, -1)
    row[frames] = np.arange(len(frames))
    frame = row[result["frame"]]
    valid = np.isfinite(result["xyz"]).all(1) & (result["error"] < _MAX_POINT_ERROR)
    observed = (frame >= 0) & valid[result["point"]]
    number = np.cumsum(valid) - 1
    return SparsePoints(
        result["xyz"][valid],
        result["rgb"][valid],
        result["error"][valid],
        number[result["point"][observed]],
        frame[observed],
    )


def _check_registered(capture: Capture, frames: NDArray[np.int64], settings: CamerasConfig) -> None:
    total = len(capture.names)
    if len(frames) < settings.min_registered * total or not len(frames):
        raise InputError(
            f"registered {len(frames)} of {total} frames (need {settings.min_registered:.0%}); film slower and with "
            "more overlap and texture, raise capture.fps, give the calibration, or lower cameras.min_registered"
        )
    for s, source in enumerate(capture.sources):
        if not np.any(capture.source_index[frames] == s):
            raise InputError(
                f"source {source.name!r}: none of its {np.sum(capture.source_index == s)} frames connects to the "
                "others; film the same road along the same path, in light that shows the same texture, or leave it out"
            )


def _write_images(
    capture: Capture, stage: Path, frames: NDArray[np.int64], lenses: list[dict[str, Any]], out: Path
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Writes the pinhole images and masks; returns intrinsics (n, 4) and sizes (n, 2) [px]."""
    intrinsics, sizes = np.zeros((len(frames), 4)), np.zeros((len(frames), 2), np.int64)
    cache: dict[str, tuple[tuple[float, float, float, float], NDArray[np.float32] | None]] = {}
    for k, i in enumerate(runtime.track(frames, "pinhole images", unit="frame")):
        lens = lenses[k]
        key = repr(lens)
        if key not in cache:
            cache.clear()  # pixel maps are large, and frames are ordered by source
            camera = pycolmap.Camera(
                model=lens["model"], params=lens["params"], width=lens["width"], height=lens["height"]
            )
            pinhole = fitted_pinhole(camera)
            cache[key] = pinhole, undistortion_map(camera, pinhole)
        pinhole, pixel_map = cache[key]
        intrinsics[k], sizes[k] = pinhole, (lens["width"], lens["height"])
        name = f"{capture.names[int(i)]}.png"
        write_pinhole_image(stage / "images" / name, out / "images" / name, pixel_map)
        if (stage / "masks" / name).exists():
            write_pinhole_image(stage / "masks" / name, out / "masks" / name, pixel_map, mask=True)
    return intrinsics, sizes


def _metrics(capture: Capture, cameras: Cameras, points: SparsePoints, summary: dict[str, Any]) -> dict[str, Any]:
    counts = points.track_length
    sources = [source.name for source in capture.sources]
    of_source = np.array(cameras.sources)
    return {
        "registered": len(cameras),
        "total": len(capture.names),
        "registered_per_source": {
            name: [int(np.sum(of_source == name)), int(np.sum(capture.source_index == s))]
            for s, name in enumerate(sources)
        },
        "points": len(points),
        # Weighted by the number of observations, as in COLMAP.
        "reprojection_error_px": float(np.average(points.error, weights=counts)) if len(points) else None,
        "mean_track_length": float(counts.mean()) if len(points) else None,
        "focal_px": {name: round(float(np.median(cameras.intrinsics[of_source == name, :2])), 3) for name in sources},
        "pairs": summary["pairs"],
        "verified_pairs": summary["verified_pairs"],
        "near_pairs": summary.get("near_pairs", 0),
        "outliers": summary["outliers"],
        "registered_anew": summary.get("registered_anew", []),
        "mapper": summary["mapper"],
        "note": None if len(points) else "no point was triangulated under the given poses",
    }
