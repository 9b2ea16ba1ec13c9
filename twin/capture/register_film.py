"""Where every frame of one more film was taken from, by one camera: `register.py` for a film.

A frame is looked for near where the one before it was, else everywhere. A *sight* is a frame that was found: its
inliers and its pose. First each frame has a focal length of its own; then all are sighted again with the one in the
middle, and last one is found that brings all their inliers nearest.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.capture.lens import Lens
from twin.capture.pycolmap_import import pycolmap
from twin.capture.register import GUESSED_FOCAL, MAX_SIZE, MIN_INLIERS, Place, camera_of, estimation, matched_frames
from twin.capture.video import fitted_size
from twin.capture.worker import run_worker, tell
from twin.errors import InputError
from twin.files import read_json, write_json
from twin.geometry.images import resize, write_image
from twin.geometry.poses import Array, inverse_pose
from twin.scene import SceneDir

_NEIGHBOURS = 12  # frames that the next one is compared with
_USUAL = 0.0015  # an inlier's error, from which on it counts less [longer sides]
_VAGUE = 0.02  # share of a focal length that its error may be
_ROUNDS = 12  # of the parabola
_STEPS = np.array([0.98, 0.99, 1.0, 1.01, 1.02])  # of the focal length

Image = NDArray[np.uint8]


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


def solve(job: dict[str, Any]) -> None:
    """Runs a job of `register_film` and leaves `result.json` in its work folder.

    Raises:
        InputError: no frame was found, or the focal length stays unknown.
    """
    place, work, lens, seed = Place(Path(job["metric"])), Path(job["work"]), job["lens"], job["seed"]
    free = not job["held"]
    matches: list[tuple[Array, Array]] = []
    sights: dict[int, _Sight] = {}
    tell(bar="frames of the film", total=len(job["photos"]))
    for k, name in enumerate(job["photos"]):
        pixels, descriptors = place.features(work / name)
        best: tuple[Array, Array] = np.zeros((0, 2)), np.zeros((0, 3))
        before = next(reversed(sights.values())).position[None] if sights else np.zeros((0, 3))
        near = sorted(place.near(before, _NEIGHBOURS))
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
