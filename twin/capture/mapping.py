"""From matches to poses and points; the body of the worker process.

A *model* is a COLMAP reconstruction. Global mapping (Pan et al. 2024) comes first: the incremental mapper gets stuck on
forward motion. Frames off their neighbours' path are taken out and registered once more against all others; those that
end up beside the path again are dropped.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.capture import matching as pairing
from twin.capture.capture_data import Capture
from twin.capture.matching import Matcher, open_database
from twin.capture.pycolmap_import import pycolmap
from twin.capture.worker import tell
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.poses import inverse_pose, rotation_angle
from twin.types import Array

# ---- Frames that structure from motion placed beside the path.
#
# A film moves smoothly: a frame's place and direction follow from its neighbours in time. A *residual* is how far a frame
# is from what they say. Two predictions are made and the kinder one counts, since either alone errs on honest frames: the
# chord between neighbours (blind to how evenly the film moves, but cuts corners), and the cubic through them (follows a
# turn, but wants even steps).


_OUTLIERS_MIN_FRAMES = 6
_MAX_SHARE = 0.25
"""If more than this share of a source looks wrong, it is not a smooth path, and nothing can be said."""
_ROUGH = 0.3
"""A path whose median residual is more than this share of its median step is photos in no order, not a film."""
_SPREADS = 8.0
"""A residual counts only beyond this many robust standard deviations of all residuals."""
_MAX_TURN = np.radians(5.0)  # [rad] off the neighbours, at least, before a direction counts as wrong


def path_residuals(camera_to_world: Array) -> tuple[Array, Array]:
    """How far each frame is off its neighbours' path.

    Args:
        camera_to_world: Poses of one source in time order, shape (n, 4, 4), n ≥ 5.

    Returns:
        Off in position (unit of the poses) and in direction [rad], shapes (n,).
    """
    n = len(camera_to_world)
    centres = camera_to_world[:, :3, 3]
    rotations = Rotation.from_matrix(camera_to_world[:, :3, :3])
    position, turn = np.zeros(n), np.zeros(n)
    for i in range(n):
        left, right = [k for k in (i - 1, i - 2) if k >= 0], [k for k in (i + 1, i + 2) if k < n]
        if left and right:
            chords = [_segment_distance(centres[i], centres[a], centres[b]) for a in left for b in right]
            position[i] = float(np.median(chords))
            if len(left) == len(right) == 2:  # Lagrange's cubic at the middle of five even steps
                a2, a1, b1, b2 = centres[left[1]], centres[left[0]], centres[right[0]], centres[right[1]]
                cubic = (4.0 * (a1 + b1) - (a2 + b2)) / 6.0
                position[i] = min(position[i], float(np.linalg.norm(centres[i] - cubic)))
            middle = [Slerp([a, b], Rotation.concatenate([rotations[a], rotations[b]]))(i) for a in left for b in right]
            turn[i] = min(_angle(m, rotations[i]) for m in middle)
        else:  # an end: go on along the line of the next two
            near, far = (right or left)[0], (right or left)[1]
            step = centres[near] - centres[far]
            position[i] = _segment_distance(centres[i], centres[near], centres[near] + 2.5 * step)
            same_again = rotations[near] * rotations[far].inv() * rotations[near]
            turn[i] = min(_angle(same_again, rotations[i]), _angle(rotations[near], rotations[i]))
    return position, turn


def _angle(a: Rotation, b: Rotation) -> float:
    return float(rotation_angle((a.inv() * b).as_matrix()))


def _segment_distance(point: Array, start: Array, end: Array) -> float:
    along = end - start
    share = np.clip((point - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * along))


def path_outliers(camera_to_world: Array, limit: float) -> NDArray[np.bool_]:
    """Frames off their neighbours' path; found worst first, each judged without those found before.

    Args:
        camera_to_world: Poses of one source in time order, shape (n, 4, 4).
        limit: Allowed offset [median steps between frames]; more is allowed where the whole path is rough.

    Returns:
        True for outliers, shape (n,); all false for fewer than 6 frames, or where the path is not smooth at all.
    """
    n = len(camera_to_world)
    out = np.zeros(n, bool)
    if n < _OUTLIERS_MIN_FRAMES:
        return out
    step = float(np.median(np.linalg.norm(np.diff(camera_to_world[:, :3, 3], axis=0), axis=1)))
    position, turn = path_residuals(camera_to_world)
    if np.median(position) > _ROUGH * step:
        return out
    max_offset = max(limit * step, _SPREADS * _spread(position), 1e-12)
    max_turn = max(_MAX_TURN, _SPREADS * _spread(turn))
    while True:
        kept = np.flatnonzero(~out)
        if len(kept) < _OUTLIERS_MIN_FRAMES:
            return np.zeros(n, bool)
        position, turn = path_residuals(camera_to_world[kept])
        score = np.maximum(position / max_offset, turn / max_turn)
        worst = int(np.argmax(score))
        if score[worst] <= 1.0:
            return out
        # An outlier spoils its neighbours' predictions too: it goes only if the others then agree better.
        candidates = [k for k in range(max(worst - 2, 0), min(worst + 3, len(kept))) if score[k] > 0.5]
        out[kept[min(candidates, key=lambda k: _score_without(camera_to_world[kept], k, max_offset, max_turn))]] = True
        if out.sum() > _MAX_SHARE * n:
            return np.zeros(n, bool)


def _score_without(poses: Array, k: int, max_offset: float, max_turn: float) -> float:
    lo, hi = max(k - 5, 0), min(k + 6, len(poses))
    local = np.delete(poses[lo:hi], k - lo, axis=0)
    if len(local) < 3:
        return np.inf
    position, turn = path_residuals(local)
    return float(np.sum(np.maximum(position / max_offset, turn / max_turn)))


def _spread(values: Array) -> float:
    """Robust standard deviation about zero of non-negative residuals."""
    return 1.4826 * float(np.median(values))


_MIN_FRAMES = 3
_PROBE_INLIERS = 25
_NEAR_STEPS = 3.0
"""Cameras this near [median steps] that were never matched are matched in the second round."""
_NEAR_PAIRS = 4
_POSED_PAIRS = 10
_TRACKS_PER_VIEW = 300
"""Tracks each frame needs for the first solution; the rest join in the retriangulation. Saves 40 % of the time."""
_MAX_ERROR = 2.0  # [px] observations worse than this are left out of the last adjustment
_MIN_ANGLE = 0.5  # [°] between the rays to a point
_LOSS_SCALE = 0.5  # [px] residual from which the last adjustment trusts an observation less
_REFINEMENTS = 30
_WORTH_REMAPPING = 0.05
"""Newly verified pairs [share of all] from which the second round solves again."""


def solve_mapping(job: dict[str, Any]) -> None:
    """Runs a whole job (see `sfm.run` for its keys) and leaves `result.npz` and `result.json` in its work folder.

    Raises:
        InputError: too few frames, no texture, or no model found.
    """
    stage, work = Path(job["capture"]), Path(job["work"])
    capture = Capture.load(stage)
    pycolmap.set_random_seed(job["seed"])
    matcher = open_database(capture, stage, work, job["free_focal"], job["threads"], job["seed"])
    matcher.extract(job["features"], job["max_feature_size"])
    facts: dict[str, Any] = {}
    if capture.camera_to_world is not None:
        model = _triangulated(matcher, capture, work)
        facts["mapper"] = "given poses"
        facts["outliers"] = []
    else:
        model = _mapped(matcher, job, work, facts)
    facts["pairs"] = len(matcher.tried)
    facts["verified_pairs"] = len(matcher.verified())
    _save(model, matcher, facts, work)


def _mapped(matcher: Matcher, job: dict[str, Any], work: Path, facts: dict[str, Any]) -> pycolmap.Reconstruction:
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
    model = mapper.best(facts)
    before = matcher.verified()
    frames, poses = _poses(model, matcher)
    step = _median_step(poses, frames, capture)
    near = pairing.near_pairs(poses, frames, matcher.tried, _NEAR_STEPS * step, _NEAR_PAIRS)
    facts["near_pairs"] = len(near)
    if near:
        matcher.match(near, "near pairs")
        fresh = len(matcher.verified()) - len(before)
        if fresh > _WORTH_REMAPPING * len(before):
            tell(say=f"  {fresh} more pairs hold: mapping again")
            again = mapper.best(facts)
            model = again if again.num_reg_images() >= model.num_reg_images() else model
    model = mapper.without_outliers(model, job["max_outlier"], facts)
    tell(bar="refinement", total=1)
    mapper.refine(model)
    tell(step=1)
    return model


def _match(matcher: Matcher, rng: np.random.Generator) -> None:
    source_index = matcher.capture.source_index
    sequence = pairing.sequence_pairs(source_index)
    signatures = pairing.frame_signatures(matcher.descriptors(), source_index, rng)
    probes = pairing.probe_pairs(source_index, signatures) - sequence
    matcher.match(sequence | probes, "matches in sequence")
    more = pairing.expanded_pairs(source_index, probes, matcher.verified(), _PROBE_INLIERS) - matcher.tried
    if more:
        matcher.match(more, "matches across")


class _Mapper:
    """COLMAP's mappers on one database, with the known cameras held fixed."""

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

    def best(self, facts: dict[str, Any]) -> pycolmap.Reconstruction:
        """The largest model by the configured mapper. Raises InputError if there is none."""
        total = len(self._matcher.capture.names)
        model = None
        if self._kind in ("auto", "global"):
            model, facts["mapper"] = self._global(), "global"
        if self._kind == "incremental" or (
            self._kind == "auto" and (model is None or model.num_reg_images() < self._min_registered * total)
        ):
            other = self._incremental()
            if other is not None and (model is None or other.num_reg_images() > model.num_reg_images()):
                model, facts["mapper"] = other, "incremental"
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
        tell(bar="mapping", total=0)
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
        tell(bar="incremental mapping", total=total)
        models = pycolmap.incremental_mapping(
            self._matcher.database,
            self._matcher.images,
            self._fresh_folder("incremental"),
            options,
            next_image_callback=lambda: tell(step=1),
        )
        return max(models.values(), key=lambda m: m.num_reg_images(), default=None)

    def _incremental_options(self) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = self._threads, self._seed
        options.constant_cameras = self._fixed
        options.mapper.constant_cameras = self._fixed
        return options

    def refine(self, model: pycolmap.Reconstruction) -> None:
        """A last bundle adjustment that trusts bad observations less than COLMAP's, which dark frames have many of.

        The known cameras are put back to what was given and held there.
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
        self, model: pycolmap.Reconstruction, limit: float, facts: dict[str, Any]
    ) -> pycolmap.Reconstruction:
        """Frames off the path registered anew against the rest; those off it again are dropped. Missing ones, too."""
        matcher = self._matcher
        names = matcher.capture.names
        off = _off_path(model, matcher, limit)
        facts["outliers"] = []
        missing = len(names) - model.num_reg_images()
        if not off and not missing:
            return model
        _deregister(model, matcher, off)
        model = self._registered_anew(model)
        still = _off_path(model, matcher, limit)
        _deregister(model, matcher, still)
        gone = set(off) - set(_poses(model, matcher)[0].tolist()) | set(still)
        facts["outliers"] = sorted(names[i] for i in gone)
        facts["registered_anew"] = sorted(names[i] for i in set(off) - gone)
        return model

    def _registered_anew(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
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


def _off_path(model: pycolmap.Reconstruction, matcher: Matcher, limit: float) -> list[int]:
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
    """Frame indices of the registered frames in order, and their camera_to_world."""
    frame_of = matcher.frame_of()
    poses = {}
    for image in model.images.values():
        if image.has_pose:
            camera_from_world = np.eye(4)
            camera_from_world[:3] = image.cam_from_world().matrix()
            poses[frame_of[image.image_id]] = inverse_pose(camera_from_world)
    frames = np.array(sorted(poses), np.int64)
    return frames, np.array([poses[i] for i in frames]).reshape(-1, 4, 4)


def _median_step(poses: Array, frames: NDArray[np.int64], capture: Capture) -> float:
    source = capture.source_index[frames]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[np.diff(source) == 0]
    return float(np.median(steps)) if len(steps) else 0.0


def _triangulated(matcher: Matcher, capture: Capture, work: Path) -> pycolmap.Reconstruction:
    """Points under the given poses, which stay as they are."""
    assert capture.camera_to_world is not None
    every = np.arange(len(capture.names))
    matcher.match(
        pairing.sequence_pairs(capture.source_index)
        | pairing.near_pairs(capture.camera_to_world, every, set(), np.inf, _POSED_PAIRS),
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


def _save(model: pycolmap.Reconstruction, matcher: Matcher, facts: dict[str, Any], work: Path) -> None:
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
    facts["cameras"] = [
        {"model": c.model.name, "params": [float(p) for p in c.params], "width": c.width, "height": c.height}
        for c in cameras
    ]
    write_json(work / "result.json", facts)
