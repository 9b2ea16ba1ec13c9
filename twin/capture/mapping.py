"""Structure from motion with COLMAP: from matches to poses and points. Runs in the worker process.

A *model* is a COLMAP reconstruction. Global mapping (Pan et al. 2024) is tried first, since the incremental mapper gets
stuck on forward motion. A film moves smoothly, so a frame's pose can be predicted from its neighbors in time; frames
far from the prediction are removed and registered once more against all others, and dropped if they are off again.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.capture.camera_models import camera_to_world
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
from twin.capture.pycolmap_import import pycolmap
from twin.capture.worker import send_message
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.poses import inverse_pose, rotation_angle
from twin.types import Array

_MIN_PATH_FRAMES = 6
_MAX_OUTLIER_FRACTION = 0.25  # if more frames of a source look wrong, its path is not smooth and no frame is removed
_MAX_ROUGHNESS = 0.3  # A path with a larger median residual [median steps] is a set of unordered photos, not a film
_OUTLIER_SIGMAS = 8.0  # an outlier's residual exceeds this many robust standard deviations of all residuals
_MAX_TURN = np.radians(5.0)  # [rad] smallest allowed deviation from the predicted direction

_MIN_FRAMES = 3
_PROBE_INLIERS = 25
_NEAR_STEPS = 3.0  # distance [median steps] up to which cameras that were never matched are matched in the second round
_NEAR_PAIRS = 4
_POSED_PAIRS = 10
_TRACKS_PER_VIEW = 300
"""Tracks per frame for the first solution; retriangulation adds the others. Saves 40 % of the time."""
_MAX_ERROR = 2.0  # [px] observations with larger errors are excluded from the last bundle adjustment
_MIN_ANGLE = 0.5  # [°] between the rays to a point
_LOSS_SCALE = 0.5  # [px] scale of the Cauchy loss in the last bundle adjustment
_REFINEMENTS = 30
_REMAPPING_FRACTION = 0.05  # newly verified pairs [fraction of all] from which the second round maps again


# ---- outliers of the path


def path_residuals(camera_to_world: Array) -> tuple[Array, Array]:
    """Deviation of each frame from the pose predicted from its neighbors.

    The smaller of two predictions' residuals counts, since either alone fails on correct frames: the chord between
    neighbors is independent of the speed but cuts corners; the cubic through them follows turns but needs even steps.
    Takes the poses of one source in order of time (n, 4, 4), n ≥ 5; returns residuals of position (unit of the poses)
    and direction [rad], shapes (n,).
    """
    n = len(camera_to_world)
    centers = camera_to_world[:, :3, 3]
    rotations = Rotation.from_matrix(camera_to_world[:, :3, :3])
    position, turn = np.zeros(n), np.zeros(n)
    for i in range(n):
        left, right = [k for k in (i - 1, i - 2) if k >= 0], [k for k in (i + 1, i + 2) if k < n]
        if left and right:
            chords = [_segment_distance(centers[i], centers[a], centers[b]) for a in left for b in right]
            position[i] = float(np.median(chords))
            if len(left) == len(right) == 2:  # Lagrange's cubic at the middle of five equidistant frames
                a2, a1, b1, b2 = centers[left[1]], centers[left[0]], centers[right[0]], centers[right[1]]
                cubic = (4.0 * (a1 + b1) - (a2 + b2)) / 6.0
                position[i] = min(position[i], float(np.linalg.norm(centers[i] - cubic)))
            middle = [Slerp([a, b], Rotation.concatenate([rotations[a], rotations[b]]))(i) for a in left for b in right]
            turn[i] = min(_angle(m, rotations[i]) for m in middle)
        else:  # an end of the path: extrapolate the next two frames
            near, far = (right or left)[0], (right or left)[1]
            step = centers[near] - centers[far]
            position[i] = _segment_distance(centers[i], centers[near], centers[near] + 2.5 * step)
            extrapolated = rotations[near] * rotations[far].inv() * rotations[near]
            turn[i] = min(_angle(extrapolated, rotations[i]), _angle(rotations[near], rotations[i]))
    return position, turn


def _angle(a: Rotation, b: Rotation) -> float:
    return float(rotation_angle((a.inv() * b).as_matrix()))


def _segment_distance(point: Array, start: Array, end: Array) -> float:
    along = end - start
    fraction = np.clip((point - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(point - start - fraction * along))


def path_outliers(camera_to_world: Array, limit: float) -> NDArray[np.bool_]:
    """Mask (n,) of the frames off the path of their neighbors, found one by one, the worst first.

    All false for fewer than 6 frames or a path that is not smooth. `limit` is the allowed position residual [median
    steps between frames]; more is allowed if the whole path is rough.
    """
    n = len(camera_to_world)
    out = np.zeros(n, bool)
    if n < _MIN_PATH_FRAMES:
        return out
    step = float(np.median(np.linalg.norm(np.diff(camera_to_world[:, :3, 3], axis=0), axis=1)))
    position, turn = path_residuals(camera_to_world)
    if np.median(position) > _MAX_ROUGHNESS * step:
        return out
    max_offset = max(limit * step, _OUTLIER_SIGMAS * _robust_std(position), 1e-12)
    max_turn = max(_MAX_TURN, _OUTLIER_SIGMAS * _robust_std(turn))
    while True:
        kept = np.flatnonzero(~out)
        if len(kept) < _MIN_PATH_FRAMES:
            return np.zeros(n, bool)
        position, turn = path_residuals(camera_to_world[kept])
        score = np.maximum(position / max_offset, turn / max_turn)
        worst = int(np.argmax(score))
        if score[worst] <= 1.0:
            return out
        # An outlier also spoils its neighbors' predictions: the frame is removed without which the others agree best.
        candidates = [k for k in range(max(worst - 2, 0), min(worst + 3, len(kept))) if score[k] > 0.5]
        out[kept[min(candidates, key=lambda k: _score_without(camera_to_world[kept], k, max_offset, max_turn))]] = True
        if out.sum() > _MAX_OUTLIER_FRACTION * n:
            return np.zeros(n, bool)


def _score_without(poses: Array, k: int, max_offset: float, max_turn: float) -> float:
    lo, hi = max(k - 5, 0), min(k + 6, len(poses))
    local = np.delete(poses[lo:hi], k - lo, axis=0)
    if len(local) < 3:
        return np.inf
    position, turn = path_residuals(local)
    return float(np.sum(np.maximum(position / max_offset, turn / max_turn)))


def _robust_std(values: Array) -> float:
    """Robust standard deviation about zero of non-negative residuals."""
    return 1.4826 * float(np.median(values))


# ---- mapping


def solve_mapping(job: dict[str, Any]) -> None:
    """Runs a mapping job (see `sfm.run` for its keys); writes `result.npz` and `result.json` to its work folder.

    Raises InputError: too few frames, no texture, or no model found.
    """
    stage, work = Path(job["capture"]), Path(job["work"])
    capture = Capture.load(stage)
    pycolmap.set_random_seed(job["seed"])
    matcher = open_database(capture, stage, work, job["free_focal"], job["threads"], job["seed"])
    matcher.extract(job["features"], job["max_feature_size"])
    summary: dict[str, Any] = {}
    if capture.camera_to_world is not None:
        model = _triangulate(matcher, capture, work)
        summary["mapper"] = "given poses"
        summary["outliers"] = []
    else:
        model = _reconstruct(matcher, job, work, summary)
    summary["pairs"] = len(matcher.tried)
    summary["verified_pairs"] = len(matcher.verified())
    _save(model, matcher, summary, work)


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
    fixed = [s for s, source in enumerate(capture.sources) if source.calibrated and not job["free_focal"]]
    if not all(source.camera_params for source in capture.sources) or job["free_focal"]:
        pycolmap.calibrate_view_graph(matcher.database)
    mapper = _Mapper(matcher, job, work, fixed)
    model = mapper.best(summary)
    before = matcher.verified()
    frames, poses = _poses(model, matcher)
    step = _median_step(poses, frames, capture)
    near = near_pairs(poses, frames, matcher.tried, _NEAR_STEPS * step, _NEAR_PAIRS)
    summary["near_pairs"] = len(near)
    if near:
        matcher.match(near, "near pairs")
        fresh = len(matcher.verified()) - len(before)
        if fresh > _REMAPPING_FRACTION * len(before):
            send_message(say=f"  {fresh} more pairs hold: mapping again")
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
    matcher.match(sequence | probes, "matches in sequence")
    more = expanded_pairs(source_index, probes, matcher.verified(), _PROBE_INLIERS) - matcher.tried
    if more:
        matcher.match(more, "matches across")


class _Mapper:
    """COLMAP's mappers on one database; `fixed` lists the sources whose cameras are known and stay constant."""

    def __init__(self, matcher: Matcher, job: dict[str, Any], work: Path, fixed: list[int]) -> None:
        self._matcher, self._work, self._seed, self._threads = matcher, work, job["seed"], job["threads"]
        self._kind, self._min_registered = job["mapper"], job["min_registered"]
        with pycolmap.Database.open(matcher.database) as database:
            self._cameras = {c.camera_id: c for c in database.read_all_cameras()}
            image_camera = {i.image_id: i.camera_id for i in database.read_all_images()}
        of_source = {
            int(s): image_camera[int(matcher.image_ids[i])] for i, s in enumerate(matcher.capture.source_index)
        }
        self._fixed = {of_source[s] for s in fixed}

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
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = self._threads, self._seed
        bundle = options.mapper.bundle_adjustment
        bundle.ceres.use_gpu = False
        options.mapper.global_positioning.use_gpu = False
        options.mapper.track_required_tracks_per_view = _TRACKS_PER_VIEW
        if self._fixed == set(self._cameras):
            bundle.refine_focal_length = bundle.refine_extra_params = False
        send_message(bar="mapping", total=0)
        models = pycolmap.global_mapping(
            self._matcher.database, self._matcher.images, self._fresh_folder("global"), options
        )
        model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
        if model is not None and self._fixed and self._fixed != set(self._cameras):
            self.refine(model)
        return model

    def _incremental(self) -> pycolmap.Reconstruction | None:
        options = self._incremental_options()
        options.min_model_size = _MIN_FRAMES
        total = len(self._matcher.capture.names)
        send_message(bar="incremental mapping", total=total)
        models = pycolmap.incremental_mapping(
            self._matcher.database,
            self._matcher.images,
            self._fresh_folder("incremental"),
            options,
            next_image_callback=lambda: send_message(step=1),
        )
        return max(models.values(), key=lambda m: m.num_reg_images(), default=None)

    def _incremental_options(self) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = self._threads, self._seed
        options.constant_cameras = self._fixed
        options.mapper.constant_cameras = self._fixed
        return options

    def refine(self, model: pycolmap.Reconstruction) -> None:
        """A last bundle adjustment with a more robust loss than COLMAP's, since dark frames have many bad observations.

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
        options.ceres.solver_options.num_threads = self._threads
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = _LOSS_SCALE
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        model.update_point_3d_errors()

    def without_outliers(
        self, model: pycolmap.Reconstruction, limit: float, summary: dict[str, Any]
    ) -> pycolmap.Reconstruction:
        """Registers the missing frames and those off the path once more; drops the frames that are off again."""
        matcher = self._matcher
        names = matcher.capture.names
        off = _off_path_frames(model, matcher, limit)
        summary["outliers"] = []
        missing = len(names) - model.num_reg_images()
        if not off and not missing:
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
        source, target = self._fresh_folder("kept"), self._fresh_folder("anew")
        model.write(source)
        options = self._incremental_options()
        options.fix_existing_frames = True
        options.mapper.fix_existing_frames = True
        options.multiple_models = False
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        models = pycolmap.incremental_mapping(self._matcher.database, self._matcher.images, target, options, source)
        return max(models.values(), key=lambda m: m.num_reg_images(), default=model)

    def _fresh_folder(self, name: str) -> Path:
        folder = self._work / name
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
    poses = {
        frame_of[image.image_id]: camera_to_world(image.cam_from_world())
        for image in model.images.values()
        if image.has_pose
    }
    frames = np.array(sorted(poses), np.int64)
    return frames, np.array([poses[i] for i in frames]).reshape(-1, 4, 4)


def _median_step(poses: Array, frames: NDArray[np.int64], capture: Capture) -> float:
    source = capture.source_index[frames]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[np.diff(source) == 0]
    return float(np.median(steps)) if len(steps) else 0.0


def _triangulate(matcher: Matcher, capture: Capture, work: Path) -> pycolmap.Reconstruction:
    """Triangulates points under the given, constant poses."""
    assert capture.camera_to_world is not None
    frames = np.arange(len(capture.names))
    matcher.match(
        sequence_pairs(capture.source_index) | near_pairs(capture.camera_to_world, frames, set(), np.inf, _POSED_PAIRS),
        "matches",
    )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matcher.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for i, image_id in enumerate(matcher.image_ids):
            image = database.read_image(int(image_id))
            fresh = pycolmap.Image(image.name, pycolmap.Point2DList(), image.camera_id, image.image_id)
            pose = pycolmap.Rigid3d(inverse_pose(capture.camera_to_world[i])[:3])
            model.add_image_with_trivial_frame(fresh, pose)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = matcher.threads, matcher.seed
    folder = work / "posed"
    folder.mkdir(exist_ok=True)
    return pycolmap.triangulate_points(model, matcher.database, matcher.images, folder, True, options, False)


def _save(model: pycolmap.Reconstruction, matcher: Matcher, summary: dict[str, Any], work: Path) -> None:
    frames, poses = _poses(model, matcher)
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
    cameras = [model.cameras[model.images[int(matcher.image_ids[i])].camera_id] for i in frames]
    summary["cameras"] = [
        {"model": c.model.name, "params": [float(p) for p in c.params], "width": c.width, "height": c.height}
        for c in cameras
    ]
    write_json(work / "result.json", summary)
