"""Stage `cameras`: camera poses and sparse points by structure from motion, and images without lens distortion.

The output has the coordinate system of the reconstruction. Its rotation, origin and scale are arbitrary, unless the
input has poses. The stage runs `solve_mapping` in a worker process: `matching.py` matches features, `mapping.py`
reconstructs. Films without a common view, such as those that go down the road in opposite directions, are reconstructed
separately, and joined by the ground if that is possible.
"""

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from twin import runtime
from twin.capture.camera_models import Lens, lens_from_json, undistortion, write_pinhole_image
from twin.capture.capture_data import Capture
from twin.capture.ground_matching import Part, join
from twin.capture.mapping import (
    MIN_FRAMES,
    Mapper,
    coherent_frames,
    connections,
    fresh_folder,
    posed_model,
    reconstruct,
    registered_poses,
    triangulated,
)
from twin.capture.matching import (
    PROBE_INLIERS,
    Matcher,
    expanded_pairs,
    frame_signatures,
    near_pairs,
    open_database,
    probe_pairs,
    sequence_pairs,
)
from twin.capture.metric import check_measured
from twin.capture.pair_geometry import estimate_focal_lengths
from twin.capture.pose_averaging import check_poses, near_in_film
from twin.capture.rolling_shutter import RollingShutter, correct_model, corrected_map, corrected_pinhole
from twin.capture.worker import run_worker, send_message
from twin.config import CamerasConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.images import decode_image
from twin.scene import SceneDir
from twin.types import Array

_MAX_THREADS = 16
# [px] Points with a larger reprojection error are left out, such as those that bundle adjustment moved behind a camera.
_MAX_POINT_ERROR = 20.0
# A model of two weakly linked groups is accepted if it has at least this fraction of the frames of each group, and this
# number of connections between the groups.
_TOGETHER_FRACTION, _TOGETHER_PAIRS = 0.8, 20
_POSED_PAIRS = 10  # largest number of pairs per frame if poses are given
_Solved = tuple[Matcher, pycolmap.Reconstruction]  # a model with the matcher of its frames


# ---- the stage


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reconstructs the cameras of a capture; writes `Cameras`, `SparsePoints`, `images/` and `masks/` to `out`.

    Returns metrics, see `_metrics`.

    Raises InputError: too little texture or overlap, a fraction of registered frames below `cameras.min_registered`, or
    nothing that could tell the wanted scale (`metric.check_measured`).
    """
    stage, settings = scene.stage("capture"), config.cameras
    capture = Capture.load(stage)
    check_measured(capture, config)
    work = out / "work"
    work.mkdir()
    threads = min(runtime.available_cores(), _MAX_THREADS)
    job = asdict(settings) | {"capture": str(stage), "seed": config.seed, "threads": threads}
    run_worker(solve_mapping, job, work)
    summary = read_json(work / "result.json")
    with np.load(work / "result.npz", allow_pickle=False) as result:
        frames, poses = result["frames"], result["camera_to_world"]
        points = _sparse_points(result, frames, len(capture.names))
    _check_registered(capture, frames, settings)
    lenses = list(map(lens_from_json, summary["cameras"]))
    shutters = {name: RollingShutter.from_json(entry) for name, entry in summary["rolling_shutters"].items()}
    intrinsics, sizes = _write_images(capture, stage, frames, lenses, shutters, out)
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
    xyz, rgb, error = (result[name][valid] for name in ("xyz", "rgb", "error"))
    return SparsePoints(xyz, rgb, error, number[result["point"][observed]], frame[observed])


def _check_registered(capture: Capture, frames: NDArray[np.int64], settings: CamerasConfig) -> None:
    """Raises InputError: too few registered frames, or a lighting without any.

    A film that could not be placed is left out if another film shows its lighting.
    """
    placed = np.isin(capture.source_index, capture.source_index[frames])
    total = int(placed.sum())
    if len(frames) < settings.min_registered * total or not len(frames):
        raise InputError(
            f"registered {len(frames)} of {total or len(capture.names)} frames (need {settings.min_registered:.0%}); "
            "film slower and with more overlap and texture, raise capture.fps, give the calibration, or lower "
            "cameras.min_registered"
        )
    lightings = {capture.sources[s].lighting for s in capture.source_index[frames].tolist()}
    for s, source in enumerate(capture.sources):
        if source.lighting not in lightings:
            raise InputError(
                f"source {source.name!r}: none of its {np.sum(capture.source_index == s)} frames connects to the "
                "others; film the same road along the same path, in light that shows the same texture, or leave it out"
            )


def _write_images(
    capture: Capture,
    stage: Path,
    frames: NDArray[np.int64],
    lenses: list[Lens],
    shutters: dict[str, RollingShutter],
    out: Path,
) -> tuple[Array, NDArray[np.int64]]:
    """Writes the pinhole images and masks; returns intrinsics (n, 4) and sizes (n, 2) [px]."""
    intrinsics, sizes = np.zeros((len(frames), 4)), np.zeros((len(frames), 2), np.int64)
    before: tuple[Lens, str] | None = None
    for k, i in enumerate(runtime.track(frames, "pinhole images", unit="frame")):
        lens, source = lenses[k], capture.sources[int(capture.source_index[i])].name
        shutter = shutters.get(source)
        if before != (lens, source):  # frames are sorted by source, and most sources have one lens
            before = lens, source
            pinhole, pixel_map = undistortion(lens)
            if shutter:
                pinhole = corrected_pinhole(lens, pinhole, shutter)
        if shutter:
            pixel_map = corrected_map(lens, pinhole, shutter.skews.get(int(i), np.zeros(3)), shutter.axis)
        intrinsics[k], sizes[k] = pinhole.intrinsics, (lens.width, lens.height)
        name = f"{capture.names[int(i)]}.png"
        write_pinhole_image(stage / "images" / name, out / "images" / name, pixel_map)
        if (stage / "masks" / name).exists():
            write_pinhole_image(stage / "masks" / name, out / "masks" / name, pixel_map, mask=True)
    return intrinsics, sizes


def _metrics(capture: Capture, cameras: Cameras, points: SparsePoints, summary: dict[str, Any]) -> dict[str, Any]:
    counts = points.track_length
    names = [source.name for source in capture.sources]
    of_source = np.array(cameras.sources)
    copied = ["pairs", "verified_pairs", "near_pairs", "outliers", "registered_anew", "mapper", "joined", "apart"]
    copied += ["may_drift", "checked_steps", "contradicted_steps", "rolling_shutter_deg", "stabilized"]
    return {
        "registered": len(cameras),
        "total": len(capture.names),
        "registered_per_source": {
            name: [int(np.sum(of_source == name)), int(np.sum(capture.source_index == s))]
            for s, name in enumerate(names)
        },
        "points": len(points),
        # Weighted by the number of observations, as in COLMAP.
        "reprojection_error_px": float(np.average(points.error, weights=counts)) if len(points) else None,
        "mean_track_length": float(counts.mean()) if len(points) else None,
        "focal_px": {
            name: round(float(np.median(cameras.intrinsics[of_source == name, :2])), 3)
            for name in names
            if name in cameras.sources
        },
        **{name: summary[name] for name in copied},
        "note": None if len(points) else "no point was triangulated under the given poses",
    }


# ---- in the worker


def solve_mapping(job: dict[str, Any], work: Path) -> None:
    """Runs the job of `run`; writes `result.npz` and `result.json` to `work`."""
    stage = Path(job["capture"])
    capture = Capture.load(stage)
    pycolmap.set_random_seed(job["seed"])
    matcher = open_database(capture, stage, work, job["free_focal"], job["threads"], job["seed"])
    matcher.extract(job["features"], job["max_feature_size"])
    summary = _new_summary() | {"stabilized": [], "checked_steps": 0, "contradicted_steps": []}
    shutters: dict[str, RollingShutter] = {}
    if capture.camera_to_world is not None:
        summary["mapper"] = "given poses"
        solved = [(matcher, _triangulate(matcher, capture.camera_to_world, work))]
    else:
        solved = _reconstruct(matcher, job, work, summary)
    for its_matcher, model in solved:
        frames, poses = registered_poses(model, its_matcher)
        pairs = its_matcher.geometries_among(near_in_film(capture.source_index, frames), dict(model.cameras))
        found = check_poses(pairs, its_matcher.frame_of(), capture.source_index, frames, poses)
        summary["checked_steps"] += found.steps
        summary["contradicted_steps"] += [[capture.names[i], capture.names[j]] for i, j in found.contradicted]
        if capture.camera_to_world is None:
            corrected, stabilized = correct_model(model, its_matcher, Mapper(its_matcher, job, work).refine)
            shutters |= corrected
            summary["stabilized"] += stabilized
    results = [_arrays(model, its_matcher) for its_matcher, model in solved]
    order = np.argsort(np.concatenate([one["frames"] for one in results]))
    cameras = [camera for its_matcher, model in solved for camera in _cameras(model, its_matcher)]
    lenses = [Lens(one.model.name, tuple(map(float, one.params)), one.width, one.height) for one in cameras]
    # The points of each model follow those of the models before it.
    first = np.cumsum([0, *(len(one["xyz"]) for one in results)])
    for one, offset in zip(results, first[:-1], strict=True):
        one["point"] = one["point"] + offset
    arrays: dict[str, Any] = {name: np.concatenate([one[name] for one in results]) for name in results[0]}
    for name in ("frames", "camera_to_world"):
        arrays[name] = arrays[name][order]
    np.savez(work / "result.npz", **arrays)
    summary["pairs"] = len(set().union(matcher.tried, *(one.tried for one, _ in solved)))
    summary["verified_pairs"] = sum(len(one.verified()) for one, _ in solved)
    missing = set(range(len(capture.sources))) - set(capture.source_index[arrays["frames"]].tolist())
    summary["apart"] = [capture.sources[s].name for s in sorted(missing)]
    summary["rolling_shutters"] = {name: one.to_json() for name, one in shutters.items()}
    summary["rolling_shutter_deg"] = {name: round(one.median_deg, 3) for name, one in shutters.items()}
    write_json(work / "result.json", summary | {"cameras": [vars(lenses[k]) for k in order]})


def _arrays(model: pycolmap.Reconstruction, matcher: Matcher) -> dict[str, NDArray]:
    """Frames, poses, points and observations of a model; `point` and `frame` are indices."""
    frames, poses = registered_poses(model, matcher)
    frame_of = matcher.frame_of()
    points = list(model.points3D.values())
    seen = [(k, frame_of[element.image_id]) for k, point in enumerate(points) for element in point.track.elements]
    observations = np.array(seen, np.int64).reshape(-1, 2)
    return {
        "frames": frames,
        "camera_to_world": poses,
        "xyz": np.array([point.xyz for point in points]).reshape(-1, 3),
        "rgb": np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        "error": np.array([point.error for point in points], np.float64),
        "point": observations[:, 0],
        "frame": observations[:, 1],
    }


def _cameras(model: pycolmap.Reconstruction, matcher: Matcher) -> list[pycolmap.Camera]:
    """The camera of each registered frame."""
    ids = [model.images[int(matcher.image_ids[i])].camera_id for i in registered_poses(model, matcher)[0]]
    return [model.cameras[one] for one in ids]


def _triangulate(matcher: Matcher, given: Array, work: Path) -> pycolmap.Reconstruction:
    """Triangulates points under the given, constant poses (n, 4, 4)."""
    near = near_pairs(given, np.arange(len(given)), set(), np.inf, _POSED_PAIRS)
    matcher.match(sequence_pairs(matcher.capture.source_index) | near, "matches")
    return triangulated(matcher, posed_model(matcher, np.arange(len(given)), given), work)


def _reconstruct(matcher: Matcher, job: dict[str, Any], work: Path, summary: dict[str, Any]) -> list[_Solved]:
    """Models of all groups of linked films, in the frame of the first one; `matcher` has only features."""
    capture = matcher.capture
    if len(capture.names) < MIN_FRAMES:
        raise InputError(
            f"{len(capture.names)} frames (need {MIN_FRAMES} that share a view); raise capture.fps or film longer"
        )
    _match(matcher, np.random.default_rng(job["seed"]))
    if len(matcher.verified()) < 2:
        raise InputError(
            "no two frames show the same place; film slower with texture in view, or raise capture.fps for more overlap"
        )
    if not all(source.camera_params for source in capture.sources) or job["free_focal"]:
        estimate_focal_lengths(matcher.database, job["seed"])
    groups = matcher.linked_groups()
    if len(groups) == 1:
        return [(matcher, reconstruct(matcher, job, work, summary))]
    solved: list[_Solved] = []
    found: list[dict[str, Any]] = []  # summaries of the models in `solved`
    first: InputError | None = None
    for k, frames in enumerate(groups):
        send_message(say=f"  films that share views: {', '.join(_source_names(capture, frames))}")
        try:
            own, about = _reconstructed(matcher, frames, job, fresh_folder(work, f"group_{k}"))
            if not solved or any(_join(one, own) for one in solved):
                solved.append(own)
                found.append(about)
                continue
            both = np.sort(np.concatenate([solved[0][0].frames, frames]))
            together, about = _reconstructed(matcher, both, job, fresh_folder(work, f"with_{k}"))
            if len(solved) == 1 and _is_one(together, solved[0][0].frames, frames):
                solved, found = [together], [about]
        except InputError as error:
            first = first or error
    if not solved:
        assert first is not None
        raise first
    for name in ("near_pairs", "outliers", "registered_anew", "may_drift"):
        summary[name] = sum((one[name] for one in found), summary[name])
    summary["mapper"] = found[0]["mapper"]
    summary["joined"] = [name for one, _ in solved[1:] for name in _source_names(capture, one.frames)]
    return solved


def _reconstructed(
    matcher: Matcher, frames: NDArray[np.int64], job: dict[str, Any], work: Path
) -> tuple[_Solved, dict[str, Any]]:
    """The model of some frames with its own matcher, and its summary. Raises InputError: too few frames or pairs."""
    own = matcher.restricted(frames, work)
    if len(frames) < MIN_FRAMES or len(own.verified()) < 2:
        raise InputError(f"{len(frames)} frames share no view with others; film slower, or with more overlap")
    summary = _new_summary()
    return (own, reconstruct(own, job, work, summary)), summary


def _new_summary() -> dict[str, Any]:
    return {"near_pairs": 0, "outliers": [], "registered_anew": [], "joined": [], "may_drift": []}


def _is_one(solved: _Solved, a: NDArray[np.int64], b: NDArray[np.int64]) -> bool:
    """True if a model has most frames of two groups in its coherent part, and enough connections between the groups."""
    matcher, model = solved
    coherent = np.array(sorted(coherent_frames(model, matcher)))
    if min(np.isin(one, coherent).mean() for one in (a, b)) < _TOGETHER_FRACTION:
        return False
    frames, connected = connections(model, matcher)
    between = connected[np.isin(frames, a)][:, np.isin(frames, b)]
    return bool(between.nnz >= min(_TOGETHER_PAIRS, len(a), len(b)))


def _source_names(capture: Capture, frames: NDArray[np.int64]) -> list[str]:
    return [capture.sources[s].name for s in np.unique(capture.source_index[frames]).tolist()]


def _join(first: _Solved, other: _Solved) -> bool:
    """Transforms the other model to the frame of the first; returns False if their grounds do not match."""
    matcher = first[0]

    def read_frame(frame: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        name = f"{matcher.capture.names[frame]}.png"
        mask = decode_image(matcher.masks / f"{name}.png", cv2.IMREAD_GRAYSCALE) if matcher.masks else None
        return decode_image(matcher.images / name, cv2.IMREAD_GRAYSCALE), mask

    similarity = join(_part(*first), _part(*other), read_frame)
    if similarity is None:
        return False
    rotation = pycolmap.Rotation3d(similarity.rotation)
    other[1].transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return True


def _part(matcher: Matcher, model: pycolmap.Reconstruction) -> Part:
    frames, poses = registered_poses(model, matcher)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    capture = matcher.capture
    lightings = [capture.sources[s].lighting for s in capture.source_index[frames].tolist()]
    return Part(frames, poses, points, _cameras(model, matcher), lightings)


def _match(matcher: Matcher, rng: np.random.Generator) -> None:
    source_index = matcher.capture.source_index
    sequence = sequence_pairs(source_index)
    signatures = frame_signatures(matcher.descriptors(), source_index, rng)
    probes = probe_pairs(source_index, signatures) - sequence
    matcher.match(sequence | probes, "matches")
    more = expanded_pairs(source_index, probes, matcher.verified(), PROBE_INLIERS) - matcher.tried
    if more:
        matcher.match(more, "more matches")
