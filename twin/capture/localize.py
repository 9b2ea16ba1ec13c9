"""Where one more photo was taken from, by the frames and sparse points of a built scene.

A *landmark* is a feature of a frame that lies where a sparse point falls that the frame sees: so its place is known. A
*match* pairs a feature of the photo with a landmark; *inliers* are the matches that one pose explains. The work happens
in the worker process (`worker.py`), as all of COLMAP's does; `register` starts it and reads what it found.
"""

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.capture.camera_models import Lens, same_aspect
from twin.capture.capture_data import Capture
from twin.capture.photos import PhotoFacts, regular_choice
from twin.capture.pycolmap_import import pycolmap
from twin.capture.video import fitted_size
from twin.capture.worker import run_worker, tell
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, SparsePoints, project
from twin.geometry.images import decoded, resize, write_image
from twin.geometry.poses import inverse_pose
from twin.scene import SceneDir
from twin.types import Array, Image

MIN_INLIERS = 25
MAX_SIZE = 1280  # [px] longer side the photo's features are looked for at
_FEATURES = 4000
_FIRST_FRAMES = 48  # looked at first, spread evenly over every film
_BEST_FRAMES = 4  # whose neighbours are looked at next
_NEIGHBOURS = 8  # of each, whatever their lighting
_TRUSTED_FRAMES = 24  # with the most matches; the others' matches are chance
_RATIO = 0.8  # to the second best, Lowe 2004
_NEAR = 1.5  # [px] from a sparse point's place in the frame
_TOLERANCE = 0.006  # of an inlier [longer sides]
GUESSED_FOCAL = 1.2  # [longer sides]
_ESTIMATED = "estimated"
_DISTORTION_INLIERS = 100  # enough to tell distortion from noise
_CLEARLY_MORE = 1.25  # an earlier lens is kept unless a later one explains so many times more matches


@dataclass(frozen=True)
class Registration:
    """A photo's place."""

    camera_to_world: Array
    """OpenCV axes, metres, shape (4, 4)."""
    lens: Lens
    """At the photo's size."""
    lens_from: str
    """Where the focal length came from."""
    matches: int
    inliers: int
    error: float
    """Mean reprojection error of the inliers [px of the photo]."""


def register_photo(photo: Image, facts: PhotoFacts, scene: SceneDir, seed: int = 0) -> Registration:
    """The pose and lens of a photo (h, w, 3), upright.

    Raises:
        InputError: too few of its features fit the place.
    """
    full = photo.shape[1], photo.shape[0]
    size = fitted_size(*full, MAX_SIZE)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        write_image(work / "photo.png", cv2.cvtColor(np.asarray(resize(photo, *size), np.uint8), cv2.COLOR_RGB2GRAY))
        lenses = [
            vars(lens) | {"held": held, "said": said} for lens, held, said in candidate_lenses(size, facts, scene)
        ]
        metric = str(scene.stage("metric").resolve())
        run_worker({"task": "register", "metric": metric, "work": folder, "lenses": lenses, "seed": seed}, work)
        found = read_json(work / "result.json")
    lens = Lens(found["model"], tuple(found["params"]), *size).scaled(*full)
    pose = np.array(found["camera_to_world"])
    return Registration(
        *(pose, lens, found["lens_from"], found["matches"], found["inliers"], found["error"] * full[0] / size[0])
    )


def candidate_lenses(size: tuple[int, int], facts: PhotoFacts, scene: SceneDir) -> list[tuple[Lens, bool, str]]:
    """Lenses the photo may have been taken with, the likeliest first: lens at `size`, whether it is held, its origin.

    The photo's own header comes first; then the cameras of the scene whose picture has the same shape; then a guess.
    """

    def simple(focal: float) -> Lens:
        return Lens("SIMPLE_RADIAL", (focal, 0.5 * size[0], 0.5 * size[1], 0.0), *size)

    found = [(simple(facts.focal * max(size)), False, "EXIF")] if facts.focal else []
    for source in Capture.load(scene.stage("capture")).sources:
        if source.calibrated and same_aspect(size, (source.width, source.height)):
            lens = Lens(source.camera_model, source.camera_params, source.width, source.height)
            found.append((lens.scaled(*size), True, f"the calibration of {source.name!r}"))
    cameras = Cameras.load(scene.stage("metric"))
    for name in dict.fromkeys(cameras.sources):
        mine = np.flatnonzero(np.array(cameras.sources) == name)
        width, height = (int(v) for v in cameras.sizes[mine[0]])
        if same_aspect(size, (width, height)):
            focal = float(np.median(cameras.intrinsics[mine, 0])) * size[0] / width
            found.append((simple(focal), False, f"the camera of {name!r}"))
    found.append((simple(GUESSED_FOCAL * max(size)), False, _ESTIMATED))
    return list({repr(lens): (lens, held, said) for lens, held, said in reversed(found)}.values())[::-1]


# ---- in the worker


class LocalizationMap:
    """A built scene's frames and sparse points, and features of the frames that were looked at."""

    def __init__(self, metric: Path) -> None:
        self.cameras, self.points = Cameras.load(metric), SparsePoints.load(metric)
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads, options.sift.max_num_features = False, 1, _FEATURES
        self._extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        self._seen: dict[int, tuple[Array, NDArray[np.float32]]] = {}

    def features(self, path: Path) -> tuple[Array, NDArray[np.float32]]:
        """Places [px] (n, 2) and unit descriptors (n, 128) of an image file's SIFT features."""
        image = decoded(path, cv2.IMREAD_GRAYSCALE, "delete the build folder and build again")
        keypoints, descriptors = self._extractor.extract_from_uint8_array(np.ascontiguousarray(image))
        places = np.array([(k.x, k.y) for k in keypoints], np.float64).reshape(-1, 2)
        values = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
        return places, values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)

    def matches(self, descriptors: NDArray[np.float32], i: int) -> NDArray[np.int64]:
        """Matches of a photo in frame i, see `frame_matches`."""
        if i not in self._seen:
            self._seen[i] = self.features(self.cameras.image_path(i))
        return frame_matches(*self._seen[i], descriptors, self.cameras, self.points, i)

    def near(self, positions: Array, count: int) -> set[int]:
        """The frames nearest to each of some positions (n, 3)."""
        away = np.linalg.norm(self.cameras.positions[:, None] - positions, axis=-1)
        return {int(i) for column in away.T for i in np.argsort(column, kind="stable")[:count]}

    def pairs(self, found: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
        """Matches of the frames that have most, each once, shape (m, 2)."""
        most = sorted(found, key=len, reverse=True)[:_TRUSTED_FRAMES]
        return np.unique(np.concatenate([np.zeros((0, 2), int), *most]), axis=0)


def solve_photo(job: dict[str, Any]) -> None:
    """Runs a job of `register` and leaves `result.json` in its work folder.

    Raises:
        InputError: too few inliers.
    """
    place, work = LocalizationMap(Path(job["metric"])), Path(job["work"])
    pixels, descriptors = place.features(work / "photo.png")
    pairs = place.pairs(matched_frames(place, descriptors, bars=True))
    image, points = pixels[pairs[:, 0]], place.points.xyz[pairs[:, 1]]
    poses = [_posed(image, points, lens, job["seed"]) for lens in job["lenses"]]
    most = max((pose["inliers"] for pose in poses if pose), default=0)
    if most < MIN_INLIERS:
        raise InputError(
            f"{most} features of the photo fit the place (need {MIN_INLIERS}; it has {len(pixels)}, of which "
            f"{len(pairs)} resemble it); photograph it from near the filmed path, sharp, and in light that shows the "
            "texture some film shows: night and day share little"
        )
    best = next(pose for pose in poses if pose and pose["inliers"] * _CLEARLY_MORE >= most)
    write_json(work / "result.json", best | {"matches": len(pairs)})


def camera_of(lens: dict[str, Any]) -> pycolmap.Camera:
    """COLMAP's own object of a job's lens."""
    return Lens(lens["model"], tuple(lens["params"]), lens["width"], lens["height"]).camera


def estimation(lens: dict[str, Any], seed: int, focal: bool) -> pycolmap.AbsolutePoseEstimationOptions:
    """How a pose is estimated from matches, and with it the focal length if that is wanted."""
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = focal
    options.ransac.max_error = _TOLERANCE * max(lens["width"], lens["height"])
    options.ransac.min_inlier_ratio, options.ransac.random_seed = 0.02, seed
    return options


def matched_frames(place: LocalizationMap, descriptors: NDArray, bars: bool) -> list[NDArray[np.int64]]:
    """Matches of a photo in frames that resemble it: rows of photo feature and sparse point, shapes (m, 2)."""
    found: dict[int, NDArray[np.int64]] = {}

    def look(frames: list[int]) -> None:
        if bars:
            tell(bar="frames like the photo", total=len(frames))
        for i in frames:
            found[i] = place.matches(descriptors, i)
            if bars:
                tell(step=1)

    look([int(i) for i in regular_choice(len(place.cameras), _FIRST_FRAMES)])
    best = sorted(found, key=lambda i: -len(found[i]))[:_BEST_FRAMES]
    look(sorted(place.near(place.cameras.positions[best], _NEIGHBOURS + 1) - set(found)))
    return list(found.values())


def frame_matches(
    places: Array,
    descriptors: NDArray[np.float32],
    photo: NDArray[np.float32],
    cameras: Cameras,
    points: SparsePoints,
    i: int,
) -> NDArray[np.int64]:
    """Photo feature and sparse point of the matches with frame i, shape (m, 2).

    Args:
        places: Of the frame's features [px], shape (n, 2).
        descriptors: Of these, unit vectors, shape (n, 128).
        photo: Descriptors of the photo's features, shape (k, 128).
        cameras: The scene's.
        points: Beside these cameras.
        i: Index of the frame.
    """
    seen = points.point[points.frame == i]
    if not len(seen) or len(places) < 2 or not len(photo):
        return np.zeros((0, 2), np.int64)
    pixels, _ = project(points.xyz[seen], cameras.camera_to_world[i], cameras.intrinsics[i])
    distance, nearest = cKDTree(pixels).query(places)
    likeness, each = photo @ descriptors.T, np.arange(len(photo))
    best = likeness.argmax(1)
    mutual = likeness.argmax(0)[best] == each
    first = likeness[each, best]
    likeness[each, best] = -1.0  # and thus nobody's best
    rival = likeness.max(1)
    # Distances of unit vectors, squared: |a − b|² = 2 − 2 a·b.
    distinct = (1.0 - first) < _RATIO**2 * (1.0 - rival)
    good = mutual & distinct & (distance[best] < _NEAR)
    return np.stack([np.flatnonzero(good), seen[nearest[best[good]]]], 1)


def _posed(image: Array, place: Array, lens: dict[str, Any], seed: int) -> dict[str, Any] | None:
    """The pose that explains most matches under one lens; None where there is none."""
    if len(image) < MIN_INLIERS:
        return None
    camera, held = camera_of(lens), lens["held"]
    options = estimation(lens, seed, focal=lens["said"] == _ESTIMATED)
    found = pycolmap.estimate_absolute_pose(image, place, camera, options)
    if found is None:
        return None
    inlier = np.asarray(found["inlier_mask"], bool)
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = not held
    refinement.refine_extra_params = not held and inlier.sum() >= _DISTORTION_INLIERS
    better = pycolmap.refine_absolute_pose(found["cam_from_world"], image, place, inlier, camera, refinement)
    pose = (better or found)["cam_from_world"]
    shown = np.asarray(camera.img_from_cam(pose * place[inlier]))
    camera_from_world = np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])
    return {
        "camera_to_world": inverse_pose(camera_from_world).tolist(),
        "model": camera.model.name,
        "params": [float(p) for p in camera.params],
        "lens_from": lens["said"],
        "inliers": int(inlier.sum()),
        "error": float(np.linalg.norm(shown - image[inlier], axis=1).mean()),
    }


# ---- Where every frame of one more film was taken from, by one camera: `localize.py` for a film.
#
# A frame is looked for near where the one before it was, else everywhere. A *sight* is a frame that was found: its
# inliers and its pose. First each frame has a focal length of its own; then all are sighted again with the one in the
# middle, and last one is found that brings all their inliers nearest.


_REGISTER_FILM_NEIGHBOURS = 12  # frames that the next one is compared with
_USUAL = 0.0015  # an inlier's error, from which on it counts less [longer sides]
_VAGUE = 0.02  # share of a focal length that its error may be
_ROUNDS = 12  # of the parabola
_STEPS = np.array([0.98, 0.99, 1.0, 1.01, 1.02])  # of the focal length


@dataclass(frozen=True)
class FilmRegistration:
    """Places of a film's frames, all of one pinhole lens."""

    frames: NDArray[np.int64]
    """Indices of the frames that were found, shape (n,)."""
    camera_to_world: Array
    """OpenCV axes, metres, shape (n, 4, 4)."""
    lens: Lens
    """At the frames' size."""
    focal_error: float
    """Standard error of its focal length [px]; 0 where it was given."""
    error: float
    """Median over the frames of their inliers' mean reprojection error [px]."""


def register_film(frames: Sequence[Image], given: Lens | None, scene: SceneDir, seed: int = 0) -> FilmRegistration:
    """The poses and the focal length of a film's frames.

    Args:
        frames: RGB (h, w, 3), in order, of one camera without distortion.
        given: Its lens where that is known; else its focal length is found, and its principal point taken for the
            middle.
        scene: Built.
        seed: Of what is drawn at random.

    Raises:
        InputError: no frame fits the place.
    """
    full = frames[0].shape[1], frames[0].shape[0]
    size = fitted_size(*full, MAX_SIZE)
    guess = Lens("SIMPLE_PINHOLE", (GUESSED_FOCAL * max(size), 0.5 * size[0], 0.5 * size[1]), *size)
    lens = given.scaled(*size) if given else guess
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        names = [f"{i:06d}.png" for i in range(len(frames))]
        for name, frame in zip(names, frames, strict=True):
            write_image(work / name, cv2.cvtColor(np.asarray(resize(frame, *size), np.uint8), cv2.COLOR_RGB2GRAY))
        job = {"task": "register_film", "metric": str(scene.stage("metric").resolve()), "work": folder, "seed": seed}
        run_worker(job | {"photos": names, "lens": vars(lens), "held": given is not None}, work)
        found = read_json(work / "result.json")
    if given is None:
        lens = Lens(lens.model, (found["focal"], *lens.params[1:]), *size)
    scale = full[0] / size[0]
    return FilmRegistration(
        np.array(found["frames"]),
        np.array(found["camera_to_world"]),
        given or lens.scaled(*full),
        found["focal_error"] * scale,
        found["error"] * scale,
    )


# ---- in the worker


@dataclass(frozen=True)
class _Sight:
    """A frame that was found: inliers in it [px] (m, 2) and in the place [m] (m, 3)."""

    image: Array
    place: Array
    camera_from_world: Any
    focal: float
    """As this frame alone has it [px]."""

    @property
    def position(self) -> Array:
        """[m], shape (3,)."""
        return _to_world(self.camera_from_world)[:3, 3]

    def posed(self, lens: dict[str, Any]) -> tuple[Array, Array]:
        """camera_to_world (4, 4) under a lens, and the inliers' errors [px] (m, 2)."""
        camera, every = camera_of(lens), np.ones(len(self.image), bool)
        found = pycolmap.refine_absolute_pose(
            self.camera_from_world, self.image, self.place, every, camera, _refinement(focal=False)
        )
        pose = found["cam_from_world"] if found else self.camera_from_world
        return _to_world(pose), np.asarray(camera.img_from_cam(pose * self.place)) - self.image


def solve_film(job: dict[str, Any]) -> None:
    """Runs a job of `register_film` and leaves `result.json` in its work folder.

    Raises:
        InputError: no frame was found, or the focal length stays unknown.
    """
    place, work, lens, seed = LocalizationMap(Path(job["metric"])), Path(job["work"]), job["lens"], job["seed"]
    free = not job["held"]
    matches: list[tuple[Array, Array]] = []
    sights: dict[int, _Sight] = {}
    tell(bar="frames of the film", total=len(job["photos"]))
    for k, name in enumerate(job["photos"]):
        pixels, descriptors = place.features(work / name)
        best: tuple[Array, Array] = np.zeros((0, 2)), np.zeros((0, 3))
        before = next(reversed(sights.values())).position[None] if sights else np.zeros((0, 3))
        near = sorted(place.near(before, _REGISTER_FILM_NEIGHBOURS))
        for look in (
            lambda near=near, of=descriptors: [place.matches(of, i) for i in near],
            lambda of=descriptors: matched_frames(place, of, bars=False),
        ):
            pairs = place.pairs(look())
            best = pixels[pairs[:, 0]], place.points.xyz[pairs[:, 1]]
            sight = _sighted(*best, lens, seed, free)
            if sight:
                sights[k] = sight
                break
        matches.append(best)
        tell(step=1)
    if not sights:
        raise InputError(
            f"none of the {len(matches)} frames shows the place; film from the robot on the filmed path, and in light "
            "that shows the texture some film shows: night and day share little"
        )
    error = 0.0
    if free:
        lens = _with_focal(lens, float(np.median([sight.focal for sight in sights.values()])))
        again = {k: sight for k, pair in enumerate(matches) if (sight := _sighted(*pair, lens, seed, free=False))}
        sights = again or sights
        focal, error = _shared_focal(list(sights.values()), lens)
        lens = _with_focal(lens, focal)
    poses, errors = zip(*(sight.posed(lens) for sight in sights.values()), strict=True)
    write_json(
        work / "result.json",
        {
            "frames": list(sights),
            "camera_to_world": [pose.tolist() for pose in poses],
            "focal": lens["params"][0],
            "focal_error": error,
            "error": float(np.median([np.sqrt((e**2).sum(1)).mean() for e in errors])),
        },
    )


def _sighted(image: Array, place: Array, lens: dict[str, Any], seed: int, free: bool) -> _Sight | None:
    """A frame's place by its matches, and its focal length if that is free; None where too few fit."""
    if len(image) < MIN_INLIERS:
        return None
    camera = camera_of(lens)
    found = pycolmap.estimate_absolute_pose(image, place, camera, estimation(lens, seed, focal=free))
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    inlier = np.asarray(found["inlier_mask"], bool)
    better = pycolmap.refine_absolute_pose(
        found["cam_from_world"], image, place, inlier, camera, _refinement(focal=free)
    )
    return _Sight(image[inlier], place[inlier], (better or found)["cam_from_world"], float(camera.params[0]))


def _shared_focal(sights: Sequence[_Sight], lens: dict[str, Any]) -> tuple[float, float]:
    """The focal length with which all inliers come nearest, and its standard error [px].

    A parabola through the costs; a frame counts as one measurement of two numbers, as its inliers err together.
    """
    usual, middle = _USUAL * max(lens["width"], lens["height"]), float(lens["params"][0])
    for _ in range(_ROUNDS):
        focals, costs = middle * _STEPS, np.zeros(len(_STEPS))
        for i, focal in enumerate(focals):
            each = [sight.posed(_with_focal(lens, float(focal)))[1] for sight in sights]
            costs[i] = np.mean([usual**2 * np.log1p((e**2).sum(1) / usual**2).mean() for e in each])
        curve, lowest = np.polyfit(focals - middle, costs, 2), int(costs.argmin())
        if lowest != len(_STEPS) // 2:  # far off errors hardly grow, so that there is no parabola yet
            middle = float(focals[lowest])
            continue
        if curve[0] > 0.0:
            off = -curve[1] / (2.0 * curve[0])
            error = float(np.sqrt(max(np.polyval(curve, off), 0.0) / (2.0 * curve[0] * len(sights))))
            if error <= _VAGUE * middle:
                return float(middle + off), error
        break
    raise InputError("the film does not show the camera's focal length; give camera_intrinsics in [robot]")


def _with_focal(lens: dict[str, Any], focal: float) -> dict[str, Any]:
    """A SIMPLE_PINHOLE with another focal length."""
    return lens | {"params": [focal, *lens["params"][1:]]}


def _refinement(focal: bool) -> pycolmap.AbsolutePoseRefinementOptions:
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length, options.refine_extra_params = focal, False
    return options


def _to_world(camera_from_world: Any) -> Array:
    return inverse_pose(np.vstack([camera_from_world.matrix(), [0.0, 0.0, 0.0, 1.0]]))
