"""Localizes photos and film frames in a built scene from its frames and sparse points.

A *landmark* is a feature of a scene frame close to the projection of a sparse point, so its position is known. A
*match* pairs a feature of the photo with a landmark; *inliers* are the matches that agree with one pose.
`register_photo` and `register_film` run `solve_photo` and `solve_film` in a worker process.
"""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.capture.camera_models import Lens, camera_to_world, lens_from_json, same_aspect
from twin.capture.capture_data import Capture
from twin.capture.photos import PhotoExif
from twin.capture.video import fitted_size
from twin.capture.worker import run_worker, send_message
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, SparsePoints, evenly_spaced, project
from twin.geometry.images import decode_image, resize, write_image
from twin.scene import SceneDir
from twin.types import Array, Image

MIN_INLIERS = 25
_MAX_SIZE = 1280  # [px] longer side of the image from which features are extracted
_GUESSED_FOCAL = 1.2  # [longer sides]
_FEATURES = 4000
_MAX_FRAMES = 100  # frames whose features are kept; those of one take up to 2 MB
_FIRST_FRAMES = 48  # scene frames matched first, evenly spaced over all films
_BEST_FRAMES = 4  # number of first frames, those with the most matches, whose neighbors are matched next
_NEIGHBOR_FRAMES = 8  # number of frames, of any lighting, that are matched near each best frame
_TRACKING_FRAMES = 12  # number of scene frames, near the last localized film frame, that are matched first
_TRUSTED_FRAMES = 24  # only the matches of this many frames, those with the most, are used; others are mostly wrong
_RATIO = 0.8  # largest ratio of the best to the second best distance, Lowe 2004
_LANDMARK_RADIUS = 1.5  # [px] largest distance from the projection of a sparse point
_INLIER_TOLERANCE = 0.006  # [longer sides] largest residual of an inlier
_ESTIMATED = "estimated"
_DISTORTION_INLIERS = 100  # inliers needed to separate distortion from noise
_LENS_SWITCH_RATIO = 1.25  # a later candidate lens must give this many times the inliers of an earlier one
_ROBUST_SCALE = 0.0015  # [longer sides] residual from which the robust loss reduces the weight of an inlier
_MAX_FOCAL_ERROR = 0.02  # largest accepted relative standard error of the focal length
_MAX_ITERATIONS = 12  # largest number of parabola fits
_FOCAL_STEPS = np.array([0.98, 0.99, 1.0, 1.01, 1.02])  # relative focal lengths of the parabola fit


# ---- photos


@dataclass(frozen=True)
class Registration:
    """Pose and lens of a photo."""

    camera_to_world: Array  # OpenCV axes [m], shape (4, 4)
    lens: Lens  # at the photo's size
    lens_from: str  # source of the focal length
    matches: int
    inliers: int
    error: float  # mean reprojection error of the inliers [px of the photo]


def register_photo(photo: Image, exif: PhotoExif, scene: SceneDir) -> Registration:
    """Localizes an upright photo (h, w, 3) in a scene and estimates its lens.

    Raises InputError: fewer than `MIN_INLIERS` inliers.
    """
    full = photo.shape[1], photo.shape[0]
    size = fitted_size(*full, _MAX_SIZE)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        _write_gray(work / "photo.png", photo, size)
        lenses = [(vars(lens), held, origin) for lens, held, origin in candidate_lenses(size, exif, scene)]
        run_worker(solve_photo, {"metric": str(scene.stage("metric")), "lenses": lenses}, work)
        result = read_json(work / "result.json")
    result["camera_to_world"] = np.array(result["camera_to_world"])
    result["lens"] = lens_from_json(result["lens"]).scaled(*full)
    result["error"] = result["error"] * full[0] / size[0]
    return Registration(**result)


def candidate_lenses(size: tuple[int, int], exif: PhotoExif, scene: SceneDir) -> list[tuple[Lens, bool, str]]:
    """Candidate lenses of a photo, most likely first.

    Each entry consists of the lens at `size`, whether it stays fixed, and its origin. The origin is the photo's EXIF
    header, the calibration or the estimated camera of a source with the same aspect ratio, or a guess. Only calibrated
    lenses stay fixed.
    """

    def simple(focal: float) -> Lens:
        return Lens("SIMPLE_RADIAL", (focal, 0.5 * size[0], 0.5 * size[1], 0.0), *size)

    candidates = [(simple(exif.focal * max(size)), False, "EXIF")] if exif.focal else []
    for source in Capture.load(scene.stage("capture")).sources:
        if source.calibrated and same_aspect(size, (source.width, source.height)):
            lens = Lens(source.camera_model, source.camera_params, source.width, source.height)
            candidates.append((lens.scaled(*size), True, f"the calibration of {source.name!r}"))
    cameras = Cameras.load(scene.stage("metric"))
    for name in dict.fromkeys(cameras.sources):
        frames = np.flatnonzero(np.array(cameras.sources) == name)
        width, height = (int(v) for v in cameras.sizes[frames[0]])
        if same_aspect(size, (width, height)):
            focal = float(np.median(cameras.intrinsics[frames, 0])) * size[0] / width
            candidates.append((simple(focal), False, f"the camera of {name!r}"))
    candidates.append((simple(_GUESSED_FOCAL * max(size)), False, _ESTIMATED))
    return list(dict.fromkeys(candidates))


def _write_gray(path: Path, image: Image, size: tuple[int, int]) -> None:
    write_image(path, cv2.cvtColor(resize(image, *size), cv2.COLOR_RGB2GRAY))


# ---- photos, in the worker


class LocalizationMap:
    """A built scene's frames and sparse points, with the features of the frames that were used last."""

    def __init__(self, metric: Path) -> None:
        self.cameras, self.points = Cameras.load(metric), SparsePoints.load(metric)
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads, options.sift.max_num_features = False, 1, _FEATURES
        self._extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        self._features: dict[int, tuple[Array, NDArray[np.float32]]] = {}

    def features(self, path: Path) -> tuple[Array, NDArray[np.float32]]:
        """SIFT features of an image file: positions [px] (n, 2) and unit descriptors (n, 128)."""
        image = decode_image(path, cv2.IMREAD_GRAYSCALE, "delete the build folder and build again")
        keypoints, descriptors = self._extractor.extract_from_uint8_array(np.ascontiguousarray(image))
        positions = np.array([(k.x, k.y) for k in keypoints], np.float64).reshape(-1, 2)
        values = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
        return positions, values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)

    def matches(self, descriptors: NDArray[np.float32], i: int) -> NDArray[np.int64]:
        """Matches frame i with the photo that has these descriptors (k, 128), see `match_frame`."""
        found = self._features.pop(i, None) or self.features(self.cameras.image_path(i))
        self._features[i] = found  # the last used ones are at the end
        if len(self._features) > _MAX_FRAMES:
            del self._features[next(iter(self._features))]
        return match_frame(*found, descriptors, self.cameras, self.points, i)

    def nearest_frames(self, positions: Array, count: int) -> set[int]:
        """The `count` frames nearest to each of the positions (n, 3)."""
        distance = np.linalg.norm(self.cameras.positions[:, None] - positions, axis=-1)
        return {int(i) for column in distance.T for i in np.argsort(column, kind="stable")[:count]}


def solve_photo(job: dict[str, Any], work: Path) -> None:
    """Runs a job of `register_photo`; writes `result.json` to `work`."""
    scene_map = LocalizationMap(Path(job["metric"]))
    pixels, descriptors = scene_map.features(work / "photo.png")
    pairs = _trusted_pairs(_match_similar_frames(scene_map, descriptors, show_bars=True))
    image, points = pixels[pairs[:, 0]], scene_map.points.xyz[pairs[:, 1]]
    found: list[tuple[_LocalizedFrame, str]] = []
    for entry, held, origin in job["lenses"]:
        frame = _localize(image, points, lens_from_json(entry), origin == _ESTIMATED, not held, distortion=not held)
        if frame:
            found.append((frame, origin))
    most = max((len(frame.image) for frame, _ in found), default=0)
    if most < MIN_INLIERS:
        raise InputError(
            f"only {most} of the photo's {len(pixels)} features agree with one camera pose (need {MIN_INLIERS}); "
            f"{len(pairs)} looked similar to features of the scene; take a sharp photo from near the filmed path, in "
            "lighting similar to one of the films: night and day have little texture in common"
        )
    frame, origin = next(pair for pair in found if len(pair[0].image) * _LENS_SWITCH_RATIO >= most)
    write_json(
        work / "result.json",
        {
            "camera_to_world": camera_to_world(frame.camera_from_world).tolist(),
            "lens": vars(frame.lens),
            "lens_from": origin,
            "matches": len(pairs),
            "inliers": len(frame.image),
            "error": float(np.linalg.norm(frame.residuals(frame.lens), axis=1).mean()),
        },
    )


@dataclass(frozen=True)
class _LocalizedFrame:
    """Inliers, pose and lens of a localized photo or film frame."""

    image: Array  # inliers in the image [px], shape (m, 2)
    points: Array  # inliers in the scene [m], shape (m, 3)
    camera_from_world: pycolmap.Rigid3d
    lens: Lens  # given, or estimated from this image alone

    def residuals(self, lens: Lens) -> Array:
        """Reprojection errors of the inliers under a lens [px], shape (m, 2)."""
        return np.asarray(lens.camera.img_from_cam(self.camera_from_world * self.points)) - self.image

    def refined(self, lens: Lens) -> "_LocalizedFrame":
        """The frame with its pose refined under a lens."""
        every = np.ones(len(self.image), bool)
        options = pycolmap.AbsolutePoseRefinementOptions()
        options.refine_focal_length = options.refine_extra_params = False
        found = pycolmap.refine_absolute_pose(
            self.camera_from_world, self.image, self.points, every, lens.camera, options
        )
        return replace(self, camera_from_world=found["cam_from_world"], lens=lens) if found else self


def _localize(
    image: Array,
    points: Array,
    lens: Lens,
    estimate_focal: bool,
    refine_focal: bool,
    distortion: bool = False,
) -> _LocalizedFrame | None:
    """The refined pose with the most inliers among matched pixels (k, 2) and scene points (k, 3), or None.

    `estimate_focal` lets RANSAC vary the focal length; `distortion` refines the distortion if the inliers suffice.
    """
    if len(image) < MIN_INLIERS:
        return None
    camera = lens.camera
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = estimate_focal
    options.ransac.max_error = _INLIER_TOLERANCE * max(lens.width, lens.height)
    options.ransac.min_inlier_ratio, options.ransac.random_seed = 0.02, 0
    found = pycolmap.estimate_absolute_pose(image, points, camera, options)
    if found is None:
        return None
    inlier = np.asarray(found["inlier_mask"], bool)
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = refine_focal
    refinement.refine_extra_params = distortion and bool(inlier.sum() >= _DISTORTION_INLIERS)
    refined = pycolmap.refine_absolute_pose(found["cam_from_world"], image, points, inlier, camera, refinement)
    pose = (refined or found)["cam_from_world"]
    return _LocalizedFrame(image[inlier], points[inlier], pose, replace(lens, params=tuple(map(float, camera.params))))


def _match_similar_frames(scene_map: LocalizationMap, descriptors: NDArray, show_bars: bool) -> list[NDArray[np.int64]]:
    """A photo's matches with each frame of a coarse-to-fine search, shapes (m, 2), as in `match_frame`."""
    found: dict[int, NDArray[np.int64]] = {}

    def match(frames: list[int]) -> None:
        if show_bars:
            send_message(bar="frames like the photo", total=len(frames))
        for i in frames:
            found[i] = scene_map.matches(descriptors, i)
            if show_bars:
                send_message(step=1)

    match([int(i) for i in evenly_spaced(len(scene_map.cameras), _FIRST_FRAMES)])
    best = sorted(found, key=lambda i: -len(found[i]))[:_BEST_FRAMES]
    match(sorted(scene_map.nearest_frames(scene_map.cameras.positions[best], _NEIGHBOR_FRAMES + 1) - set(found)))
    return list(found.values())


def match_frame(
    positions: Array,
    descriptors: NDArray[np.float32],
    photo: NDArray[np.float32],
    cameras: Cameras,
    points: SparsePoints,
    i: int,
) -> NDArray[np.int64]:
    """Mutual, distinctive matches of a photo with the landmarks of frame i, shape (m, 2).

    A match holds the indices of the photo's feature and of the sparse point. `positions` [px] (n, 2) and unit
    `descriptors` (n, 128) are the frame's features; `photo` (k, 128) holds the unit descriptors of the photo.
    """
    observed = points.point[points.frame == i]
    if not len(observed) or len(positions) < 2 or not len(photo):
        return np.zeros((0, 2), np.int64)
    pixels, _ = project(points.xyz[observed], cameras.camera_to_world[i], cameras.intrinsics[i])
    distance, nearest = cKDTree(pixels).query(positions)
    similarity, rows = photo @ descriptors.T, np.arange(len(photo))
    best = similarity.argmax(1)
    first = similarity[rows, best]
    mutual = similarity.max(0)[best] == first  # argmax(0) takes twenty times as long
    similarity[rows, best] = -1.0  # excludes the best from the search for the second best
    second = similarity.max(1)
    # Squared distances of unit vectors: |a − b|² = 2 − 2 a·b.
    distinct = (1.0 - first) < _RATIO**2 * (1.0 - second)
    good = mutual & distinct & (distance[best] < _LANDMARK_RADIUS)
    return np.stack([np.flatnonzero(good), observed[nearest[best[good]]]], 1)


def _trusted_pairs(matches: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """The distinct matches of the frames with the most matches, shape (m, 2)."""
    most = sorted(matches, key=len, reverse=True)[:_TRUSTED_FRAMES]
    return np.unique(np.concatenate([np.zeros((0, 2), int), *most]), axis=0)


# ---- films


@dataclass(frozen=True)
class FilmRegistration:
    """Poses of a film's frames, all with one pinhole lens."""

    frames: NDArray[np.int64]  # indices of the localized frames, shape (n,)
    camera_to_world: Array  # OpenCV axes [m], shape (n, 4, 4)
    lens: Lens  # at the frames' size
    focal_error: float  # standard error of the focal length [px]; 0 for a given lens
    error: float  # median over the frames of the mean reprojection error of their inliers [px]


def register_film(frames: Sequence[Image], given: Lens | None, scene: SceneDir) -> FilmRegistration:
    """Localizes the frames of a film in a scene and, without a given lens, estimates their focal length.

    Each frame is first matched with scene frames near the previous localized frame; if that fails, the whole scene is
    searched. The focal length is estimated per frame. All frames are localized again with the median of these
    estimates, and a joint fit to all inliers gives the final value. The principal point is assumed at the center.
    Frames are RGB (h, w, 3), in order, of one camera without distortion.

    Raises InputError: no frame could be localized, or the focal length is not determined.
    """
    full = frames[0].shape[1], frames[0].shape[0]
    size = fitted_size(*full, _MAX_SIZE)
    guess = Lens("SIMPLE_PINHOLE", (_GUESSED_FOCAL * max(size), 0.5 * size[0], 0.5 * size[1]), *size)
    lens = given.scaled(*size) if given else guess
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        names = [f"{i:06d}.png" for i in range(len(frames))]
        for name, frame in zip(names, frames, strict=True):
            _write_gray(work / name, frame, size)
        job = {"metric": str(scene.stage("metric")), "photos": names}
        run_worker(solve_film, job | {"lens": vars(lens), "held": given is not None}, work)
        result = read_json(work / "result.json")
    scale = full[0] / size[0]
    return FilmRegistration(
        np.array(result["frames"]),
        np.array(result["camera_to_world"]),
        given or lens_from_json(result["lens"]).scaled(*full),
        result["focal_error"] * scale,
        result["error"] * scale,
    )


# ---- films, in the worker


def solve_film(job: dict[str, Any], work: Path) -> None:
    """Runs a job of `register_film`; writes `result.json` to `work`."""
    scene_map, lens = LocalizationMap(Path(job["metric"])), lens_from_json(job["lens"])
    free_focal = not job["held"]
    matches: list[tuple[Array, Array]] = []
    localized: dict[int, _LocalizedFrame] = {}
    last: _LocalizedFrame | None = None
    send_message(bar="frames of the film", total=len(job["photos"]))
    for k, name in enumerate(job["photos"]):
        pixels, descriptors = scene_map.features(work / name)
        for found in _film_matches(scene_map, descriptors, last):
            pairs = _trusted_pairs(found)
            inputs = pixels[pairs[:, 0]], scene_map.points.xyz[pairs[:, 1]]
            if frame := _localize_frame(*inputs, lens, free_focal):
                localized[k] = last = frame
                break
        matches.append(inputs)
        send_message(step=1)
    if not localized:
        raise InputError(
            f"none of the {len(matches)} frames shows the place; film from the robot on the filmed path, in lighting "
            "similar to one of the scene's films: night and day have little texture in common"
        )
    focal_error = 0.0
    if free_focal:
        lens = _with_focal(lens, float(np.median([frame.lens.params[0] for frame in localized.values()])))
        again = {k: frame for k, pair in enumerate(matches) if (frame := _localize_frame(*pair, lens, False))}
        localized = again or localized
        focal, focal_error = _shared_focal(list(localized.values()), lens)
        lens = _with_focal(lens, focal)
    final = [frame.refined(lens) for frame in localized.values()]
    write_json(
        work / "result.json",
        {
            "frames": list(localized),
            "camera_to_world": [camera_to_world(frame.camera_from_world).tolist() for frame in final],
            "lens": vars(lens),
            "focal_error": focal_error,
            "error": float(np.median([np.sqrt((frame.residuals(lens) ** 2).sum(1)).mean() for frame in final])),
        },
    )


def _film_matches(
    scene_map: LocalizationMap, descriptors: NDArray[np.float32], last: _LocalizedFrame | None
) -> Iterator[list[NDArray[np.int64]]]:
    """Yields a film frame's matches near the last localized frame, if any, then those found in the whole scene."""
    if last:
        position = camera_to_world(last.camera_from_world)[None, :3, 3]
        near = sorted(scene_map.nearest_frames(position, _TRACKING_FRAMES))
        yield [scene_map.matches(descriptors, i) for i in near]
    yield _match_similar_frames(scene_map, descriptors, show_bars=False)


def _localize_frame(image: Array, points: Array, lens: Lens, free_focal: bool) -> _LocalizedFrame | None:
    frame = _localize(image, points, lens, free_focal, free_focal)
    return frame if frame and len(frame.image) >= MIN_INLIERS else None


def _shared_focal(frames: Sequence[_LocalizedFrame], lens: Lens) -> tuple[float, float]:
    """The focal length that minimizes the robust cost over all frames, and its standard error [px], from a parabola.

    Each frame counts as a single (x, y) measurement, because its inliers' errors are correlated.
    """
    robust_scale, center = _ROBUST_SCALE * max(lens.width, lens.height), lens.params[0]
    for _ in range(_MAX_ITERATIONS):
        focals, costs = center * _FOCAL_STEPS, np.zeros(len(_FOCAL_STEPS))
        for i, focal in enumerate(focals):
            trial = _with_focal(lens, float(focal))
            residuals = [frame.refined(trial).residuals(trial) for frame in frames]
            costs[i] = np.mean([robust_scale**2 * np.log1p((e**2).sum(1) / robust_scale**2).mean() for e in residuals])
        curve, lowest = np.polyfit(focals - center, costs, 2), int(costs.argmin())
        if lowest != len(_FOCAL_STEPS) // 2:  # away from the minimum, the robust cost is nearly flat, not a parabola
            center = float(focals[lowest])
            continue
        if curve[0] > 0.0:
            offset = -curve[1] / (2.0 * curve[0])
            error = float(np.sqrt(max(np.polyval(curve, offset), 0.0) / (2.0 * curve[0] * len(frames))))
            if error <= _MAX_FOCAL_ERROR * center:
                return float(center + offset), error
        break
    raise InputError("the film does not determine the camera's focal length; give camera_intrinsics in [robot]")


def _with_focal(lens: Lens, focal: float) -> Lens:
    return replace(lens, params=(focal, *lens.params[1:]))
