"""Maps the frames of linked films with COLMAP, and keeps the part of the result that holds together.

A *model* is a COLMAP reconstruction, refined by bundle adjustment. Poses averaged from pairs of frames are tried first
(`pose_averaging.py`), then COLMAP's global mapping (Pan et al. 2024), then incremental mapping, which gets stuck on
forward motion. On a road with little texture, global mapping may tear a film apart: the long tracks of points on the
skyline, which constrain rotations alone, outnumber the short tracks of near points. The pieces of a torn model share no
points that fix their scale, so it is recognized. Frames off the path of their neighbors are removed and registered once
more against all others. They are left out if they are then still off the path.
"""

import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from twin.capture.camera_models import camera_to_world
from twin.capture.matching import SEQUENCE_STEPS, Matcher, near_pairs
from twin.capture.pair_geometry import Pair
from twin.capture.pose_averaging import averaged_poses
from twin.capture.worker import send_message
from twin.errors import InputError
from twin.geometry.passes import path_outliers
from twin.geometry.poses import inverse_pose, umeyama
from twin.types import Array

MIN_FRAMES = 3  # least number of frames of a reconstruction
_NEAR_STEPS = 3.0  # [median steps between frames] largest distance between the two cameras of a near pair
_NEAR_PAIRS = 4  # largest number of near pairs per frame
# The reconstruction is repeated if more near pairs are verified than this fraction of the pairs verified before.
_REMAPPING_FRACTION = 0.05
_SHARED_POINTS = 8  # points in common that connect two frames of a model
_MANY_MATCHES = 40  # successive frames with this many verified matches must share points
# The nearest points of a frame measure its scale: in sound models the distance between two frames with common points is
# up to 22 times the distance of the nearest points; between pieces of a torn model it is 10³ to 10⁷ times.
_NEAREST_FRACTION = 0.1  # the distance of a frame's nearest points is this quantile of the distances of its points
_MAX_DISTANCE = 60.0  # [distance of the nearest points] largest distance between two connected frames
_COHERENT_FRACTION = 0.95  # a model is torn if its largest connected part has a smaller fraction of its frames
_FAR_ANGLE = np.radians(0.8)  # points whose rays from two frames differ by less do not fix the relative scale
_AVERAGINGS = 2  # bundle adjustments of averaged poses, each after a triangulation
# Two models agree if at least this fraction of positions differ by less than this distance [median steps]. Torn models
# differ by many steps, sound ones with somewhat different focal lengths by up to one step.
_AGREEMENT, _AGREEING_FRACTION = 1.0, 0.8
_TRACKS_PER_VIEW = 300  # point tracks per view in the first solution; this limit saves 40 % of its time
_MAX_ERROR = 2.0  # [px] observations with larger errors are excluded from the last bundle adjustment
_MIN_ANGLE = 0.5  # [°] smallest angle between two rays to a point
_LOSS_SCALE = 0.5  # [px] scale of the Cauchy loss in the last bundle adjustment
_REFINEMENTS = 30  # largest number of iterations of the last bundle adjustment


def reconstruct(matcher: Matcher, job: dict[str, Any], work: Path, summary: dict[str, Any]) -> pycolmap.Reconstruction:
    """Reconstructs the frames of a matcher, of which at least two pairs are verified; matches near pairs, too.

    `job` holds the settings of the stage, see `sfm.solve_mapping`; COLMAP's files are written to `work`. `summary`
    receives the mapper's name, the number of near pairs, the frames left out, and the films whose scale may drift,
    because all models of global mapping were torn.

    Raises InputError: no frame could be registered.
    """
    mapper = Mapper(matcher, job, work)
    model = mapper.best(summary)
    before = len(matcher.verified())
    frames, poses = registered_poses(model, matcher)
    near = near_pairs(poses, frames, matcher.tried, _NEAR_STEPS * median_step(poses, frames, matcher), _NEAR_PAIRS)
    summary["near_pairs"] += len(near)
    if near:
        matcher.match(near, "near pairs")
        fresh = len(matcher.verified()) - before
        if fresh > _REMAPPING_FRACTION * before:
            send_message(say=f"  {fresh} new verified pairs: reconstructing again")
            about: dict[str, Any] = {}
            again = mapper.best(about)
            if again.num_reg_images() >= model.num_reg_images():
                model = again
                summary |= about
    model = mapper.without_outliers(model, job["max_outlier"], summary)
    send_message(bar="refinement", total=1)
    mapper.refine(model)
    send_message(step=1)
    return model


def coherent_frames(model: pycolmap.Reconstruction, matcher: Matcher) -> set[int]:
    """Registered frames of the largest connected part of a model, see `connections`."""
    frames, connected = connections(model, matcher)
    if not connected.nnz:
        return set()
    part = connected_components(connected, directed=False)[1]
    return set(frames[part == np.bincount(part).argmax()].tolist())


def connections(model: pycolmap.Reconstruction, matcher: Matcher) -> tuple[NDArray[np.int64], csr_matrix]:
    """Registered frames (n,), and a matrix (n, n) that is True for connected pairs.

    Two frames are connected if they share points that fix their relative scale: eight points that the two see from
    different directions, and that a third frame sees, too. In addition, the frames must be near each other and have
    about the same scale. This excludes misplaced frames far off the path, which may share points that are even farther
    away, and pieces of the model that collapsed to one spot. A film is cut where two successive frames have many
    matches, but share few points: the model contradicts these matches, so the part on one side is misplaced.
    """
    frames, poses = registered_poses(model, matcher)
    row = {int(matcher.image_ids[i]): k for k, i in enumerate(frames)}
    points = [point for point in model.points3D.values() if point.track.length() > 2]
    seen = [(row[element.image_id], k) for k, point in enumerate(points) for element in point.track.elements]
    if not seen:
        return frames, csr_matrix((len(frames), len(frames)), dtype=bool)
    frame, point = np.unique(np.array(seen), axis=0).T
    offset = np.array([point.xyz for point in points])[point] - poses[frame, :3, 3]
    distance = np.linalg.norm(offset, axis=1)
    begin = np.searchsorted(frame, np.arange(len(frames) + 1))
    mine = [slice(*ends) for ends in itertools.pairwise(begin)]
    nearest = [np.quantile(distance[one], _NEAREST_FRACTION) if one.stop > one.start else np.inf for one in mine]
    ray = offset / np.maximum(distance, 1e-12)[:, None]
    views = csr_matrix((np.ones(len(frame), np.int32), (frame, point)), shape=(len(frames), len(points)))
    shared, source = (views @ views.T).toarray(), matcher.capture.source_index[frames]

    def fixing(i: int, j: int) -> int:
        """Number of common points that two frames see from different directions."""
        _, first, second = np.intersect1d(point[mine[i]], point[mine[j]], assume_unique=True, return_indices=True)
        angle = np.linalg.norm(ray[mine[i]][first] - ray[mine[j]][second], axis=1)
        return int(np.count_nonzero(angle > _FAR_ANGLE))

    verified = matcher.verified()
    many = [verified.get(pair, 0) >= _MANY_MATCHES for pair in itertools.pairwise(frames.tolist())]
    piece = np.cumsum([False, *(np.array(many, bool) & (shared.diagonal(1) < _SHARED_POINTS))])
    connected = []
    for i, j in np.argwhere(np.triu(shared >= _SHARED_POINTS, 1)):
        if source[i] == source[j] and piece[i] != piece[j]:
            continue
        apart = np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3])
        if max(apart, nearest[i], nearest[j]) > _MAX_DISTANCE * min(nearest[i], nearest[j]):
            continue
        if fixing(i, j) >= _SHARED_POINTS:
            connected += [(i, j), (j, i)]
    pairs = np.array(connected, np.int64).reshape(-1, 2).T
    return frames, csr_matrix((np.ones(pairs.shape[1], bool), tuple(pairs)), shape=(len(frames), len(frames)))


class Mapper:
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
        """The largest coherent model of a few attempts; the other frames are deregistered.

        A larger model replaces the one from averaged poses only if the two agree. Raises InputError: no model.
        """
        matcher, needed = self._matcher, self._min_registered * len(self._matcher.frames)
        best: pycolmap.Reconstruction | None = None
        averaged: pycolmap.Reconstruction | None = None
        kept: set[int] = set()
        held: set[int] = set()  # frames of the averaged model
        for name, attempt in self._attempts():
            if best is not None and name == "incremental" and len(kept) >= needed:
                break  # slow, and rarely better than a torn model of global mapping
            model = attempt()
            if model is None:
                continue
            coherent = coherent_frames(model, matcher)
            better = best is None or len(coherent) > len(kept)
            if better and averaged is not None:
                better = _agree(averaged, model, sorted(held & coherent), matcher)
            if better:
                best, kept, summary["mapper"] = model, coherent, name
            if name == "averaging" and len(kept) >= needed:
                averaged, held = model, coherent
            if len(kept) >= max(needed, _COHERENT_FRACTION * len(matcher.frames)):
                break
        if best is None:
            raise InputError(
                f"registered 0 of {len(matcher.frames)} frames; film slower, sideways rather than only forward, with "
                "texture in view"
            )
        _deregister(best, matcher, _incoherent_frames(best, matcher))
        drifts = self._kind == "auto" and summary["mapper"] == "incremental"
        sources = set(matcher.capture.source_index[matcher.frames].tolist()) if drifts else set()
        summary["may_drift"] = [matcher.capture.sources[s].name for s in sorted(sources)]
        return best

    def _attempts(self) -> Iterator[tuple[str, Callable[[], pycolmap.Reconstruction | None]]]:
        matcher = self._matcher
        if self._kind in ("auto", "averaging"):
            yield "averaging", self._averaging
        if self._kind in ("auto", "global"):
            yield "global", lambda: self._global(matcher.database)
            if far := self._loops():
                yield (
                    "global, without loops",
                    lambda: self._global(matcher.copied_without(far, fresh_folder(self._work, "fewer_pairs"))),
                )
        if self._kind in ("auto", "incremental"):
            yield "incremental", self._incremental

    def _loops(self) -> list[Pair]:
        """Verified pairs of frames that are far from each other in the same film."""
        source = self._matcher.capture.source_index
        pairs = self._matcher.verified()
        return [(i, j) for i, j in pairs if source[i] == source[j] and abs(i - j) > SEQUENCE_STEPS[-1]]

    def _averaging(self) -> pycolmap.Reconstruction | None:
        matcher = self._matcher
        films = matcher.capture.source_index
        frames, poses = averaged_poses(matcher.geometries(), matcher.frame_of(), films, matcher.seed)
        if len(frames) < MIN_FRAMES:
            return None
        model = posed_model(matcher, frames, poses)
        send_message(bar="points", total=_AVERAGINGS)
        for _ in range(_AVERAGINGS):
            model = triangulated(matcher, model, self._work)
            self.refine(model)
            send_message(step=1)
        return model

    def _global(self, database: Path) -> pycolmap.Reconstruction | None:
        matcher = self._matcher
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = matcher.threads, matcher.seed
        bundle = options.mapper.bundle_adjustment
        bundle.ceres.use_gpu = False
        options.mapper.global_positioning.use_gpu = False
        options.mapper.track_required_tracks_per_view = _TRACKS_PER_VIEW
        if self._fixed == set(self._cameras):
            bundle.refine_focal_length = bundle.refine_extra_params = False
        send_message(say="  mapping, without a progress bar")
        folder = fresh_folder(self._work, "global")
        model = _largest(pycolmap.global_mapping(database, matcher.images, folder, options))
        if model is not None and self._fixed and self._fixed != set(self._cameras):
            self.refine(model)
        return model

    def _incremental(self) -> pycolmap.Reconstruction | None:
        matcher = self._matcher
        options = self._incremental_options()
        options.min_model_size = MIN_FRAMES
        send_message(bar="incremental mapping", total=len(matcher.frames))
        models = pycolmap.incremental_mapping(
            matcher.database,
            matcher.images,
            fresh_folder(self._work, "incremental"),
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
        fixed = [camera_id for camera_id in self._fixed if camera_id in model.cameras]
        for camera_id in fixed:
            model.cameras[camera_id].params = self._cameras[camera_id].params.tolist()
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.images.values():
            if image.has_pose:
                config.add_image(image.image_id)
        for camera_id in fixed:
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
        if not off and model.num_reg_images() == len(matcher.frames):
            return model
        _deregister(model, matcher, off)
        model = self._register_missing(model)
        _deregister(model, matcher, _incoherent_frames(model, matcher))
        off_again = _off_path_frames(model, matcher, limit)
        _deregister(model, matcher, off_again)
        dropped = set(off) - set(registered_poses(model, matcher)[0].tolist()) | set(off_again)
        summary["outliers"] += sorted(names[i] for i in dropped)
        summary["registered_anew"] += sorted(names[i] for i in set(off) - dropped)
        return model

    def _register_missing(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        source, target = fresh_folder(self._work, "kept"), fresh_folder(self._work, "anew")
        model.write(source)
        options = self._incremental_options()
        options.fix_existing_frames = True
        options.mapper.fix_existing_frames = True
        options.multiple_models = False
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        matcher = self._matcher
        again = _largest(pycolmap.incremental_mapping(matcher.database, matcher.images, target, options, source))
        return model if again is None else again


def posed_model(matcher: Matcher, frames: NDArray[np.int64], poses: Array) -> pycolmap.Reconstruction:
    """A model of frames (n,) with camera_to_world (n, 4, 4), without points."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matcher.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for i, pose in zip(frames, poses, strict=True):
            image = database.read_image(int(matcher.image_ids[i]))
            fresh = pycolmap.Image(image.name, pycolmap.Point2DList(), image.camera_id, image.image_id)
            model.add_image_with_trivial_frame(fresh, pycolmap.Rigid3d(inverse_pose(pose)[:3]))
    return model


def triangulated(matcher: Matcher, model: pycolmap.Reconstruction, work: Path) -> pycolmap.Reconstruction:
    """The model with points triangulated again from all verified matches, under its poses."""
    options, folder = pycolmap.IncrementalPipelineOptions(), fresh_folder(work, "triangulated")
    options.num_threads, options.random_seed = matcher.threads, matcher.seed
    return pycolmap.triangulate_points(model, matcher.database, matcher.images, folder, True, options, False)


def _agree(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, frames: list[int], matcher: Matcher
) -> bool:
    """True if a similarity maps the camera positions of two models in common frames to about the same points."""
    if len(frames) < MIN_FRAMES:
        return False
    known, poses = registered_poses(first, matcher)
    others, others_poses = registered_poses(second, matcher)
    mine, theirs = poses[np.isin(known, frames)], others_poses[np.isin(others, frames)]
    offset = umeyama(theirs[:, :3, 3], mine[:, :3, 3]).points(theirs[:, :3, 3]) - mine[:, :3, 3]
    step = median_step(mine, np.array(frames), matcher)
    return bool(np.quantile(np.linalg.norm(offset, axis=1), _AGREEING_FRACTION) < _AGREEMENT * step)


def _largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def fresh_folder(work: Path, name: str) -> Path:
    folder = work / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _off_path_frames(model: pycolmap.Reconstruction, matcher: Matcher, limit: float) -> list[int]:
    frames, poses = registered_poses(model, matcher)
    source = matcher.capture.source_index[frames]
    off: list[int] = []
    for s in np.unique(source):
        off += frames[source == s][path_outliers(poses[source == s], limit)].tolist()
    return off


def _incoherent_frames(model: pycolmap.Reconstruction, matcher: Matcher) -> list[int]:
    """Registered frames outside of the largest connected part; none if there are too few points to decide."""
    coherent = coherent_frames(model, matcher)
    registered = set(registered_poses(model, matcher)[0].tolist())
    return sorted(registered - coherent) if len(coherent) >= MIN_FRAMES else []


def _deregister(model: pycolmap.Reconstruction, matcher: Matcher, frames: list[int]) -> None:
    for i in frames:
        model.deregister_frame(model.images[int(matcher.image_ids[i])].frame_id)


def registered_poses(model: pycolmap.Reconstruction, matcher: Matcher) -> tuple[NDArray[np.int64], Array]:
    """Sorted indices of the registered frames (n,), and their camera_to_world (n, 4, 4)."""
    frame_of = matcher.frame_of()
    registered = [image for image in model.images.values() if image.has_pose]
    poses = {frame_of[image.image_id]: camera_to_world(image.cam_from_world()) for image in registered}
    frames = np.array(sorted(poses), np.int64)
    return frames, np.array([poses[i] for i in frames]).reshape(-1, 4, 4)


def median_step(poses: Array, frames: NDArray[np.int64], matcher: Matcher) -> float:
    """Median distance between successive frames (n,) of the same source, given their poses (n, 4, 4)."""
    source = matcher.capture.source_index[frames]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[np.diff(source) == 0]
    return float(np.median(steps)) if len(steps) else 0.0
