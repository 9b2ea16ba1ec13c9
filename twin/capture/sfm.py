"""Stage `cameras`: camera poses and sparse points by structure from motion, and images without lens distortion.

The output has the coordinate system of the reconstruction. Its rotation, origin and scale are arbitrary, unless the
input has poses. The stage runs `solve_mapping` in a worker process. A *model* is a COLMAP reconstruction. Global
mapping (Pan et al. 2024) is tried first, since the incremental mapper gets stuck on forward motion. Frames off the path
of their neighbors are removed and registered once more against all others, and left out if they are again off the path.
"""

import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from twin import runtime
from twin.capture.camera_models import Lens, camera_to_world, lens_from_json, undistortion, write_pinhole_image
from twin.capture.capture_data import Capture
from twin.capture.matching import (
    Matcher,
    expanded_pairs,
    frame_signatures,
    near_pairs,
    open_database,
    probe_pairs,
    sequence_pairs,
)
from twin.capture.worker import run_worker, send_message
from twin.config import CamerasConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.passes import path_outliers
from twin.geometry.poses import inverse_pose
from twin.scene import SceneDir
from twin.types import Array

_MAX_THREADS = 16
# [px] Points with a larger reprojection error are left out, such as those that bundle adjustment moved behind a camera.
_MAX_POINT_ERROR = 20.0
_MIN_FRAMES = 3
_PROBE_INLIERS = 25
_NEAR_STEPS = 3.0  # [median steps between frames] largest distance between the two cameras of a near pair
_NEAR_PAIRS = 4  # largest number of near pairs per frame
_POSED_PAIRS = 10  # the same, if poses are given
# The reconstruction is repeated if more near pairs are verified than this fraction of the pairs verified before.
_REMAPPING_FRACTION = 0.05
_TRACKS_PER_VIEW = 300  # point tracks per view in the first solution; saves 40 % of its time, others are added later
_MAX_ERROR = 2.0  # [px] observations with larger errors are excluded from the last bundle adjustment
_MIN_ANGLE = 0.5  # [°] smallest angle between two rays to a point
_LOSS_SCALE = 0.5  # [px] scale of the Cauchy loss in the last bundle adjustment
_REFINEMENTS = 30  # largest number of iterations of the last bundle adjustment


# ---- the stage


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Reconstructs the cameras of a capture; writes `Cameras`, `SparsePoints`, `images/` and `masks/` to `out`.

    Returns metrics, see `_metrics`.

    Raises InputError: too little texture or overlap, or a fraction of registered frames below `cameras.min_registered`.
    """
    stage, settings = scene.stage("capture"), config.cameras
    capture = Capture.load(stage)
    work = out / "work"
    work.mkdir()
    if settings.mapper not in ("auto", "global", "incremental"):
        raise InputError(f"cameras.mapper = {settings.mapper!r}; expected auto, global or incremental")
    threads = min(os.cpu_count() or 1, _MAX_THREADS)
    job = asdict(settings) | {"capture": str(stage), "seed": config.seed, "threads": threads}
    run_worker(solve_mapping, job, work)
    summary = read_json(work / "result.json")
    with np.load(work / "result.npz", allow_pickle=False) as result:
        frames, poses = result["frames"], result["camera_to_world"]
        points = _sparse_points(result, frames, len(capture.names))
    _check_registered(capture, frames, settings)
    intrinsics, sizes = _write_images(capture, stage, frames, list(map(lens_from_json, summary["cameras"])), out)
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
    capture: Capture, stage: Path, frames: NDArray[np.int64], lenses: list[Lens], out: Path
) -> tuple[Array, NDArray[np.int64]]:
    """Writes the pinhole images and masks; returns intrinsics (n, 4) and sizes (n, 2) [px]."""
    intrinsics, sizes = np.zeros((len(frames), 4)), np.zeros((len(frames), 2), np.int64)
    lens: Lens | None = None
    for k, i in enumerate(runtime.track(frames, "pinhole images", unit="frame")):
        if lens != lenses[k]:  # frames are sorted by source, and most sources have one lens
            lens = lenses[k]
            pinhole, pixel_map = undistortion(lens)
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
    copied = ("pairs", "verified_pairs", "near_pairs", "outliers", "registered_anew", "mapper")
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
        "focal_px": {name: round(float(np.median(cameras.intrinsics[of_source == name, :2])), 3) for name in names},
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
    summary: dict[str, Any] = {"near_pairs": 0, "outliers": [], "registered_anew": []}
    if capture.camera_to_world is not None:
        summary["mapper"] = "given poses"
        model = _triangulate(matcher, capture.camera_to_world, work)
    else:
        model = _reconstruct(matcher, job, work, summary)
    frames, poses = _poses(model, matcher)
    cameras = [model.cameras[model.images[int(matcher.image_ids[i])].camera_id] for i in frames]
    lenses = [Lens(c.model.name, tuple(float(p) for p in c.params), c.width, c.height) for c in cameras]
    frame_of = matcher.frame_of()
    points = list(model.points3D.values())
    seen = [(k, frame_of[element.image_id]) for k, point in enumerate(points) for element in point.track.elements]
    observations = np.array(seen, np.int64).reshape(-1, 2)
    np.savez(
        work / "result.npz",
        frames=frames,
        camera_to_world=poses,
        xyz=np.array([point.xyz for point in points]).reshape(-1, 3),
        rgb=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        error=np.array([point.error for point in points], np.float64),
        point=observations[:, 0],
        frame=observations[:, 1],
    )
    summary |= {"pairs": len(matcher.tried), "verified_pairs": len(matcher.verified())}
    write_json(work / "result.json", summary | {"cameras": list(map(vars, lenses))})


def _triangulate(matcher: Matcher, given: Array, work: Path) -> pycolmap.Reconstruction:
    """Triangulates points under the given, constant poses (n, 4, 4)."""
    near = near_pairs(given, np.arange(len(given)), set(), np.inf, _POSED_PAIRS)
    matcher.match(sequence_pairs(matcher.capture.source_index) | near, "matches")
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matcher.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for i, image_id in enumerate(matcher.image_ids):
            image = database.read_image(int(image_id))
            fresh = pycolmap.Image(image.name, pycolmap.Point2DList(), image.camera_id, image.image_id)
            model.add_image_with_trivial_frame(fresh, pycolmap.Rigid3d(inverse_pose(given[i])[:3]))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = matcher.threads, matcher.seed
    folder = _fresh_folder(work, "posed")
    return pycolmap.triangulate_points(model, matcher.database, matcher.images, folder, True, options, False)


def _reconstruct(matcher: Matcher, job: dict[str, Any], work: Path, summary: dict[str, Any]) -> pycolmap.Reconstruction:
    capture = matcher.capture
    if len(capture.names) < _MIN_FRAMES:
        raise InputError(
            f"{len(capture.names)} frames (need {_MIN_FRAMES} that share a view); raise capture.fps or film longer"
        )
    _match(matcher, np.random.default_rng(job["seed"]))
    if len(matcher.verified()) < 2:
        raise InputError(
            "no two frames show the same place; film slower with texture in view, or raise capture.fps for more overlap"
        )
    if not all(source.camera_params for source in capture.sources) or job["free_focal"]:
        pycolmap.calibrate_view_graph(matcher.database)
    mapper = _Mapper(matcher, job, work)
    model = mapper.best(summary)
    before = len(matcher.verified())
    frames, poses = _poses(model, matcher)
    reach = _NEAR_STEPS * _median_step(poses, frames, capture)
    near = near_pairs(poses, frames, matcher.tried, reach, _NEAR_PAIRS)
    summary["near_pairs"] = len(near)
    if near:
        matcher.match(near, "near pairs")
        fresh = len(matcher.verified()) - before
        if fresh > _REMAPPING_FRACTION * before:
            send_message(say=f"  {fresh} new verified pairs: reconstructing again")
            again = mapper.best(summary)
            model = again if again.num_reg_images() >= model.num_reg_images() else model
    model = mapper.without_outliers(model, job["max_outlier"], summary)
    send_message(bar="refinement", total=1)
    mapper.refine(model)
    send_message(step=1)
    return model


def _match(matcher: Matcher, rng: np.random.Generator) -> None:
    source_index = matcher.capture.source_index
    sequence = sequence_pairs(source_index)
    signatures = frame_signatures(matcher.descriptors(), source_index, rng)
    probes = probe_pairs(source_index, signatures) - sequence
    matcher.match(sequence | probes, "matches")
    more = expanded_pairs(source_index, probes, matcher.verified(), _PROBE_INLIERS) - matcher.tried
    if more:
        matcher.match(more, "more matches")


class _Mapper:
    """COLMAP's mappers on one database. The cameras of calibrated sources stay constant."""

    def __init__(self, matcher: Matcher, job: dict[str, Any], work: Path) -> None:
        self._matcher, self._work = matcher, work
        self._kind, self._min_registered = job["mapper"], job["min_registered"]
        capture = matcher.capture
        with pycolmap.Database.open(matcher.database) as database:
            self._cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
            camera_of = {image.image_id: image.camera_id for image in database.read_all_images()}
        fixed = [source.calibrated and not job["free_focal"] for source in capture.sources]
        images = zip(matcher.image_ids, capture.source_index, strict=True)
        self._fixed = {camera_of[int(image)] for image, s in images if fixed[int(s)]}

    def best(self, summary: dict[str, Any]) -> pycolmap.Reconstruction:
        """The largest model of the configured mapper. Raises InputError if there is none."""
        total = len(self._matcher.capture.names)
        model = None
        if self._kind in ("auto", "global"):
            model, summary["mapper"] = self._global(), "global"
        if self._kind == "incremental" or (
            self._kind == "auto" and (model is None or model.num_reg_images() < self._min_registered * total)
        ):
            other = self._incremental()
            if other is not None and (model is None or other.num_reg_images() > model.num_reg_images()):
                model, summary["mapper"] = other, "incremental"
        if model is None:
            raise InputError(
                f"registered 0 of {total} frames; film slower, sideways rather than only forward, with texture in view"
            )
        return model

    def _global(self) -> pycolmap.Reconstruction | None:
        matcher = self._matcher
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = matcher.threads, matcher.seed
        bundle = options.mapper.bundle_adjustment
        bundle.ceres.use_gpu = False
        options.mapper.global_positioning.use_gpu = False
        options.mapper.track_required_tracks_per_view = _TRACKS_PER_VIEW
        if self._fixed == set(self._cameras):
            bundle.refine_focal_length = bundle.refine_extra_params = False
        send_message(bar="mapping", total=0)
        folder = _fresh_folder(self._work, "global")
        model = _largest(pycolmap.global_mapping(matcher.database, matcher.images, folder, options))
        if model is not None and self._fixed and self._fixed != set(self._cameras):
            self.refine(model)
        return model

    def _incremental(self) -> pycolmap.Reconstruction | None:
        matcher = self._matcher
        options = self._incremental_options()
        options.min_model_size = _MIN_FRAMES
        send_message(bar="incremental mapping", total=len(matcher.capture.names))
        models = pycolmap.incremental_mapping(
            matcher.database,
            matcher.images,
            _fresh_folder(self._work, "incremental"),
            options,
            next_image_callback=lambda: send_message(step=1),
        )
        return _largest(models)

    def _incremental_options(self) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = self._matcher.threads, self._matcher.seed
        options.constant_cameras = self._fixed
        options.mapper.constant_cameras = self._fixed
        return options

    def refine(self, model: pycolmap.Reconstruction) -> None:
        """Runs a last bundle adjustment, with a more robust loss than COLMAP's: dark frames have many bad observations.

        The known cameras are reset to their given calibration and kept constant.
        """
        pycolmap.ObservationManager(model).filter_all_points3D(_MAX_ERROR, _MIN_ANGLE)
        for camera_id in self._fixed:
            model.cameras[camera_id].params = self._cameras[camera_id].params.tolist()
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.images.values():
            if image.has_pose:
                config.add_image(image.image_id)
        for camera_id in self._fixed:
            config.set_constant_cam_intrinsics(camera_id)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        options = pycolmap.BundleAdjustmentOptions()
        options.ceres.solver_options.max_num_iterations = _REFINEMENTS
        options.ceres.solver_options.num_threads = self._matcher.threads
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = _LOSS_SCALE
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        model.update_point_3d_errors()

    def without_outliers(
        self, model: pycolmap.Reconstruction, limit: float, summary: dict[str, Any]
    ) -> pycolmap.Reconstruction:
        """Registers the missing frames and those off the path again; removes the frames that are then off the path."""
        matcher = self._matcher
        names = matcher.capture.names
        off = _off_path_frames(model, matcher, limit)
        if not off and model.num_reg_images() == len(names):
            return model
        _deregister(model, matcher, off)
        model = self._register_missing(model)
        off_again = _off_path_frames(model, matcher, limit)
        _deregister(model, matcher, off_again)
        dropped = set(off) - set(_poses(model, matcher)[0].tolist()) | set(off_again)
        summary["outliers"] = sorted(names[i] for i in dropped)
        summary["registered_anew"] = sorted(names[i] for i in set(off) - dropped)
        return model

    def _register_missing(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        source, target = _fresh_folder(self._work, "kept"), _fresh_folder(self._work, "anew")
        model.write(source)
        options = self._incremental_options()
        options.fix_existing_frames = True
        options.mapper.fix_existing_frames = True
        options.multiple_models = False
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        matcher = self._matcher
        again = _largest(pycolmap.incremental_mapping(matcher.database, matcher.images, target, options, source))
        return model if again is None else again


def _largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _fresh_folder(work: Path, name: str) -> Path:
    folder = work / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _off_path_frames(model: pycolmap.Reconstruction, matcher: Matcher, limit: float) -> list[int]:
    frames, poses = _poses(model, matcher)
    source = matcher.capture.source_index[frames]
    off: list[int] = []
    for s in np.unique(source):
        off += frames[source == s][path_outliers(poses[source == s], limit)].tolist()
    return off


def _deregister(model: pycolmap.Reconstruction, matcher: Matcher, frames: list[int]) -> None:
    for i in frames:
        model.deregister_frame(model.images[int(matcher.image_ids[i])].frame_id)


def _poses(model: pycolmap.Reconstruction, matcher: Matcher) -> tuple[NDArray[np.int64], Array]:
    """Sorted indices of the registered frames (n,), and their camera_to_world (n, 4, 4)."""
    frame_of = matcher.frame_of()
    registered = [image for image in model.images.values() if image.has_pose]
    poses = {frame_of[image.image_id]: camera_to_world(image.cam_from_world()) for image in registered}
    frames = np.array(sorted(poses), np.int64)
    return frames, np.array([poses[i] for i in frames]).reshape(-1, 4, 4)


def _median_step(poses: Array, frames: NDArray[np.int64], capture: Capture) -> float:
    source = capture.source_index[frames]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[np.diff(source) == 0]
    return float(np.median(steps)) if len(steps) else 0.0
