"""Where one more photo was taken from, by the frames and sparse points of a built scene.

A *landmark* is a feature of a frame that lies where a sparse point falls that the frame sees: so its place is known. A
*match* pairs a feature of the photo with a landmark; *inliers* are the matches that one pose explains. The work happens
in the worker process (`worker.py`), as all of COLMAP's does; `register` starts it and reads what it found.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.capture.exif import PhotoFacts
from twin.capture.lens import Lens, same_aspect
from twin.capture.photos import regular_choice
from twin.capture.pycolmap_import import pycolmap
from twin.capture.types import Capture
from twin.capture.video import fitted_size
from twin.capture.worker import run_worker, tell
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.cameras import Cameras, project
from twin.geometry.images import decoded, resize, write_image
from twin.geometry.points import SparsePoints
from twin.geometry.poses import Array, inverse_pose
from twin.scene import SceneDir

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

Image = NDArray[np.uint8]


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


def register(photo: Image, facts: PhotoFacts, scene: SceneDir, seed: int = 0) -> Registration:
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


class Place:
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


def solve(job: dict[str, Any]) -> None:
    """Runs a job of `register` and leaves `result.json` in its work folder.

    Raises:
        InputError: too few inliers.
    """
    place, work = Place(Path(job["metric"])), Path(job["work"])
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


def matched_frames(place: Place, descriptors: NDArray, bars: bool) -> list[NDArray[np.int64]]:
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
