"""Which figures a finished build can have: reads the artifacts that exist and the report, and draws each section's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.geometry.cameras import Cameras
from twin.geometry.points import SparsePoints
from twin.geometry.poses import umeyama
from twin.report import figures
from twin.report.plan import footprints
from twin.report.words import numbers, pick
from twin.scene import SceneDir

Array = NDArray[np.float64]

_WORST_REPROJECTION = 4.0  # [px], right end of the histogram
_LONGEST_TRACK = 30.0  # frames, right end of the histogram


@dataclass(frozen=True)
class Chart:
    """A figure under its title."""

    section: str
    title: str
    svg: str


def charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """Every figure that the build's artifacts and numbers allow."""
    return [*_place(scene, report), *_points(scene), *_field(report), *_drive(report), *_seen(report), *_truth(scene)]


def _place(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """The maps: what was seen, and what can be driven on."""
    folder = scene.stage("metric")
    if not (folder / "cameras.npz").exists():
        return []
    cameras = Cameras.load(folder)
    points = SparsePoints.load(folder) if (folder / "points.npz").exists() else SparsePoints.empty()
    mesh = scene.stage("mesh")
    ground = Ground.load(mesh) if (mesh / "ground.npz").exists() else None
    parts = _footprints(mesh / "parts.npz", ground)
    route = _route(mesh / "route.npz")
    half_width = pick(report, "mjcf.half_width_m")
    wide = float(half_width) if isinstance(half_width, int | float) else 0.0
    seen = figures.place_map(cameras.positions, cameras.sources, cameras.held_out, points.xyz, points.rgb, route, wide)
    out = [Chart("metric", "The place from above: points, cameras and route", figures.svg(seen))]
    if ground is not None:
        path = cameras.positions[:, :2] if route is None else route
        drawn = figures.ground_map(ground, path, route, wide, parts)
        out.append(Chart("mesh", "Ground and solid parts", figures.svg(drawn)))
    return out


def _footprints(path: Path, ground: Ground | None) -> list[Array]:
    if not path.exists():
        return []
    with np.load(path, allow_pickle=False) as data:
        return footprints(data["vertices"], data["vertex_start"], ground)


def _route(path: Path) -> Array | None:
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as data:
        return data["xy"].astype(np.float64)


def _points(scene: SceneDir) -> list[Chart]:
    """How well the reconstruction fits, in its own pixels."""
    folder = scene.stage("cameras")
    if not (folder / "points.npz").exists():
        return []
    points = SparsePoints.load(folder)
    if not len(points):
        return []
    error = figures.histogram(points.error, "reprojection error of a point [px]", _WORST_REPROJECTION)
    tracks = figures.histogram(points.track_length, "frames that saw a point", _LONGEST_TRACK, whole=True)
    return [
        Chart("cameras", "How far points are from where they were seen", figures.svg(error)),
        Chart("cameras", "How often points were seen again", figures.svg(tracks)),
    ]


def _field(report: dict[str, Any]) -> list[Chart]:
    out = []
    psnr = numbers(pick(report, "field.psnr"))
    if psnr:
        counts = {name: int(n) for name, n in numbers(pick(report, "field.n")).items()}
        drawn = figures.bars(psnr, counts, "dB", "PSNR on frames it never saw [dB]")
        out.append(Chart("field", "How alike a view is to the real frame", figures.svg(drawn)))
    curve = pick(report, "field.curve")
    if isinstance(curve, list) and len(curve) > 1 and all(isinstance(row, list) and len(row) == 2 for row in curve):
        steps, values = zip(*curve, strict=True)
        drawn = figures.training_curve(steps, values, "PSNR on training pixels [dB]")
        out.append(Chart("field", "How training went", figures.svg(drawn)))
    return out


def _drive(report: dict[str, Any]) -> list[Chart]:
    trace = pick(report, "review.trace")
    if not isinstance(trace, dict) or len(trace.get("progress_m") or []) < 2:
        return []
    half_width = pick(report, "mjcf.half_width_m")
    limit = float(half_width) if isinstance(half_width, int | float) else None
    off = figures.along_the_path(
        trace["progress_m"], {"cross-track": trace["cross_track_m"]}, "off the route [m], left is positive", limit
    )
    speed = figures.along_the_path(trace["progress_m"], {"speed": trace["speed_m_s"]}, "speed [m/s]", lowest=0.0)
    title = "How far off the route it drove" + ("" if limit is None else "; dashed: the corridor")
    return [Chart("review", title, figures.svg(off)), Chart("review", "How fast it drove", figures.svg(speed))]


def _seen(report: dict[str, Any]) -> list[Chart]:
    """Leaks, ghosts and the ground's error along the route."""
    along = pick(report, "seen_touched.along")
    if not isinstance(along, dict) or len(along.get("station_m") or []) < 2:
        return []
    known: dict[str, Sequence[float]] = {
        name: [float("nan") if value is None else float(value) for value in along[key]]
        for name, key in (("largest leak", "leak_m"), ("largest ghost", "ghost_m"), ("ground, median", "ground_m"))
    }
    drawn = figures.along_the_path(along["station_m"], known, "in the corridor [m]", lowest=0.0)
    return [Chart("seen_touched", "Seen but not solid, solid but not seen, along the route", figures.svg(drawn))]


def _truth(scene: SceneDir) -> list[Chart]:
    """Errors of the cameras along their path, where the truth is known."""
    if not (scene.truth / "truth.npz").exists() or not (scene.stage("metric") / "cameras.npz").exists():
        return []
    from twin.reality.truth import Truth
    from twin.report.truth import matched_poses  # only where there is a truth to compare with

    cameras = Cameras.load(scene.stage("metric"))
    true = matched_poses(Truth.load(scene.truth), cameras)[:, :3, 3]
    off = np.linalg.norm(umeyama(cameras.positions, true).points(cameras.positions) - true, axis=1)
    by_source = {name: off[[s == name for s in cameras.sources]] for name in dict.fromkeys(cameras.sources)}
    drawn = figures.errors_by_group(by_source, "camera off by [m]")
    return [Chart("truth", "Camera error along the films", figures.svg(drawn))]
