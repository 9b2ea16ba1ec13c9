"""Relative poses of pairs of frames, and focal lengths, from verified matches.

COLMAP's relative pose of a pair is often wrong by degrees on a road: the ground is one plane, which two poses explain
equally well, and repeated patterns are matched one period off. Here, a pair's pose minimizes the epipolar errors of all
its matches under a Cauchy loss. There are many local minima, so the search has several starts. One is the rotation on
which most matches agree: that of far points, such as those on the skyline.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import minimize

from twin.capture.worker import send_message
from twin.errors import InputError
from twin.runtime import die_with_parent
from twin.types import Array

Pair = tuple[int, int]
_MIN_MATCHES = 15  # least number of matches of a pair
_PIXEL_ERROR = 0.5  # [px] standard deviation of the epipolar error of a correct match
_OUTLIER = 4.0  # [standard deviations] matches with a larger epipolar error are wrong
_MUCH_WORSE = 1.1  # a pose is refused if its cost exceeds that of the best pose of the pair by this factor
_NEAR_ANGLE = 4.0  # [standard deviations of the epipolar error] smallest angle between the rays to a near point
_EPIPOLE = 20.0  # [standard deviations] angles to the epipole below this count as this, which bounds the error's scale
_WIDE = 4.0  # the first steps use a loss that is wider by this factor
_WIDE_STEPS, _STEPS = 5, 12  # largest number of Gauss–Newton steps
_SAME_START = np.radians(0.3)  # poses that differ less lead to the same minimum
_ROTATION_TRIALS, _TRANSLATION_TRIALS = 60, 120  # random pairs of matches that propose a rotation and a translation
_SAME_CAMERA = 1e-3  # [rad] cameras count as the same if the directions of their pixels differ by at most this
_SAME_ROTATION = np.radians(0.2)  # largest deviation of a far point from the rotation that most points share
_MIN_PARALLEL = 400  # with fewer pairs, starting processes takes longer than they save
_BLOCK, _CHUNK = 256, 16  # pairs per process that are prepared at once, and that are sent at once
_FOCAL_PAIRS, _FOCAL_MATCHES = 24, 300  # largest numbers of pairs and of their matches that a focal length is fitted to
_FOCAL_STEPS = 3  # [frames] largest distance of these pairs
_FOCAL_GRID = np.geomspace(0.3, 3.0, 16)  # [longer side] first guesses; the first and last limit the result
_MAX_DISTORTION = 0.3  # largest absolute value of the first distortion parameter
_DISTORTION_PRIOR = 0.1  # standard deviation of the first distortion parameter
_FOCAL_PRIOR = 0.5  # standard deviation of the logarithm of the focal length about COLMAP's guess


def ordered_pair(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)


@dataclass(frozen=True)
class PairMatches:
    """Verified matches of two images."""

    first: int  # COLMAP's ids of the images
    second: int
    features: NDArray[np.int64]  # (n, 2) numbers of the matched features
    first_rays: Array  # (n, 3) unit directions in the coordinates of each camera
    second_rays: Array
    error: Array  # (n,) [rad] standard deviation of the epipolar error of a correct match


@dataclass(frozen=True)
class PairGeometry:
    """Pose of the second camera of a pair relative to the first, and its near points.

    A point x in the coordinates of the first camera is at rotation @ x + translation in those of the second. The unit
    of length is the distance of the two cameras.
    """

    matches: PairMatches
    rotation: Array  # (3, 3)
    translation: Array  # (3,), of length 1
    cost: float  # Cauchy loss of all matches
    features: NDArray[np.int64]  # (k, 2) features of the points that are near and in front of both cameras
    depths: Array  # (k, 2) their distances from both cameras
    depth_error: Array  # (k,) relative standard deviation of the depths
    rotation_error: float  # [rad] standard deviation
    direction_error: float  # [rad] standard deviation of the translation's direction
    agreeing: float  # fraction of all matches that agree with the pose


_Job = tuple[PairMatches, Array | None, int]  # matches of a pair, COLMAP's rotation if it found one, and a seed


def pair_geometries(
    database: Path,
    seed: int,
    known: dict[tuple[int, int], PairGeometry] | None = None,
    among: set[tuple[int, int]] | None = None,
    refined: Mapping[int, pycolmap.Camera] | None = None,
    processes: int = 1,
) -> list[PairGeometry]:
    """Geometry of the verified pairs of a database.

    Args:
        known: Geometry of some pairs of images, which is not computed again; that of the others is added.
        among: Pairs of images, smaller id first, to which the result is restricted; by default all.
        refined: Cameras by COLMAP's ids that replace those of the database. Where they differ, `known` is not used.
        processes: Number of worker processes for many pairs; their number does not change the result.
    """
    known = {} if known is None else known
    with pycolmap.Database.open(database) as opened:
        cameras, camera_of = _cameras(opened)
        changed = {k for k, one in (refined or {}).items() if not _is_same(one, cameras[k])}
        cameras |= {k: one for k, one in (refined or {}).items() if k in changed}
        if changed:
            known = {pair: one for pair, one in known.items() if changed.isdisjoint(camera_of[image] for image in pair)}
        points = {image_id: opened.read_keypoints(image_id)[:, :2].astype(np.float64) for image_id in camera_of}
        found = zip(*opened.read_two_view_geometries(), strict=True)
        verified = [
            (pair, geometry)
            for pair, geometry in ((pycolmap.pair_id_to_image_pair(pair_id), geometry) for pair_id, geometry in found)
            if len(geometry.inlier_matches) >= _MIN_MATCHES and (among is None or pair in among)
        ]
    fresh = [(pair, geometry) for pair, geometry in verified if pair not in known]
    if fresh:
        send_message(bar="relative poses", total=len(fresh))
    rays = {image_id: camera_rays(cameras[camera_of[image_id]], xy) for image_id, xy in points.items()}
    errors = {i: _keypoint_errors(cameras[camera_of[i]], xy, rays[i]) for i, xy in points.items()}

    def jobs() -> Iterator[_Job]:
        for (first, second), geometry in fresh:
            matches = geometry.inlier_matches.astype(np.int64)
            error = (errors[first][matches[:, 0]] + errors[second][matches[:, 1]]) / 2
            matches, error = matches[np.isfinite(error)], error[np.isfinite(error)]  # some lenses cannot be inverted
            if len(matches) < _MIN_MATCHES:
                send_message(step=1)
                continue
            two = cameras[camera_of[first]], cameras[camera_of[second]]
            a, b = rays[first][matches[:, 0]], rays[second][matches[:, 1]]
            start = None
            if pycolmap.estimate_two_view_geometry_pose(two[0], points[first], two[1], points[second], geometry):
                assert geometry.cam2_from_cam1 is not None
                start = geometry.cam2_from_cam1.rotation.matrix()
            yield PairMatches(first, second, matches, a, b, error), start, seed

    for one in _solved(jobs(), processes if len(fresh) >= _MIN_PARALLEL else 1):
        known[one.matches.first, one.matches.second] = one
        send_message(step=1)
    return [known[pair] for pair, _ in verified if pair in known]


def _solved(jobs: Iterator[_Job], processes: int) -> Iterator[PairGeometry]:
    """The geometry of each job's pair, in order."""
    if processes == 1:
        yield from map(_geometry, jobs)
        return
    # Spawned, since COLMAP's threads do not survive a fork.
    try:
        with ProcessPoolExecutor(processes, get_context("spawn"), die_with_parent, (os.getpid(),)) as pool:
            while block := list(islice(jobs, _BLOCK * processes)):  # all jobs at once could take gigabytes
                yield from pool.map(_geometry, block, chunksize=_CHUNK)
    except BrokenProcessPool:
        cure = "if memory ran out, lower cameras.features or capture.max_frames"
        raise InputError(f"one of {processes} processes that compute relative poses was killed; {cure}") from None


def _geometry(job: _Job) -> PairGeometry:
    pair, start, seed = job
    rng = np.random.default_rng([seed, pair.first, pair.second])
    a, b = pair.first_rays, pair.second_rays
    starts = [np.eye(3), common_rotation(a, b, rng)] + ([] if start is None else [start])
    return _described(pair, *relative_pose(a, b, starts, pair.error, rng))


def with_rotation(pair: PairGeometry, rotation: Array, seed: int) -> PairGeometry | None:
    """The geometry of a pair that has about the given rotation (3, 3); None if it explains the matches much worse."""
    one = pair.matches
    rng = np.random.default_rng([seed, one.first, one.second])
    pose = relative_pose(one.first_rays, one.second_rays, [rotation], one.error, rng)
    return _described(one, *pose) if pose[2] < _MUCH_WORSE * pair.cost else None


def _cameras(database: pycolmap.Database) -> tuple[dict[int, pycolmap.Camera], dict[int, int]]:
    """The cameras, and the camera of each image, by COLMAP's ids."""
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    return cameras, {image.image_id: image.camera_id for image in database.read_all_images()}


def camera_rays(camera: pycolmap.Camera, pixels: NDArray[np.floating]) -> Array:
    """Unit directions (n, 3) of pixels (n, 2) in the camera's coordinates."""
    directions = np.ones((len(pixels), 3))
    directions[:, :2] = camera.cam_from_img(pixels)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _is_same(one: pycolmap.Camera, other: pycolmap.Camera) -> bool:
    grid = np.stack(np.meshgrid(np.linspace(0, one.width, 5), np.linspace(0, one.height, 5)), -1).reshape(-1, 2)
    return bool(np.linalg.norm(camera_rays(one, grid) - camera_rays(other, grid), axis=1).max() < _SAME_CAMERA)


def _keypoint_errors(camera: pycolmap.Camera, pixels: NDArray[np.floating], rays: Array) -> Array:
    """[rad] Standard deviations (n,) of the directions of keypoints, by the angular size of their pixels.

    Off the center, the pixels of a lens without distortion are smaller. With one size for all, short focal lengths
    would seem to fit better. The size is that across the radius, which is the larger one: when a camera goes forward,
    epipolar lines are radial, so their errors are measured across the radius.
    """
    x, y = (camera_rays(camera, pixels + shift) - rays for shift in np.eye(2))
    xx, yy, xy = (x * x).sum(1), (y * y).sum(1), (x * y).sum(1)
    return _PIXEL_ERROR * np.sqrt((xx + yy + np.sqrt((xx - yy) ** 2 + 4 * xy**2)) / 2)


def _described(pair: PairMatches, rotation: Array, translation: Array, cost: float) -> PairGeometry:
    a, b, error = pair.first_rays, pair.second_rays, pair.error
    residual, hessian = _epipolar(a, b, rotation, translation, error)[:2]
    agrees = np.abs(residual) < _OUTLIER
    turned = a @ rotation.T
    cosine = (turned * b).sum(1)
    angle = np.arctan2(np.linalg.norm(_cross(turned, b), axis=1), cosine)
    along_a, along_b = turned @ translation, b @ translation
    depths = np.stack([cosine * along_b - along_a, along_b - cosine * along_a], 1)
    depths /= np.maximum(np.sin(angle)[:, None] ** 2, 1e-12)
    usable = agrees & (angle > _NEAR_ANGLE * error)
    if (usable & (depths < 0).all(1)).sum() > (usable & (depths > 0).all(1)).sum():
        depths, translation = -depths, -translation
    near = usable & (depths > 0).all(1)
    covariance = np.linalg.pinv(hessian)
    rotation_error, direction_error = (
        float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:])
    )
    depth_error = error[near] / angle[near]
    kept = pair.features[near], depths[near], depth_error, rotation_error, direction_error, float(agrees.mean())
    return PairGeometry(pair, rotation, translation, cost, *kept)


# ---- relative pose


def relative_pose(
    a: Array, b: Array, rotations: Sequence[Array], error: Array, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Pose of the second camera relative to the first: rotation (3, 3) and direction of the translation (3,), up to its
    sign; and its cost.

    `a` and `b` (n, 3) are the unit rays of the matches in the two cameras, `rotations` (3, 3) the starts, `error` (n,)
    [rad] the standard deviations of the epipolar errors of correct matches.
    """
    wide: list[tuple[Array, Array, float]] = []
    for start in rotations:
        one = _minimized(a, b, start, _first_translation(a, b, start, error, rng), _WIDE * error, _WIDE_STEPS)
        if not any(_is_near(one, other) for other in wide):
            wide.append(one)
    return min((_minimized(a, b, *one[:2], error, _STEPS) for one in wide), key=lambda one: one[2])


def _is_near(one: tuple[Array, Array, float], other: tuple[Array, Array, float]) -> bool:
    """True for two poses in the same local minimum."""
    turn = one[0].ravel() @ other[0].ravel()  # 1 + 2 cos(angle)
    return turn > 1 + 2 * np.cos(_SAME_START) and abs(one[1] @ other[1]) > np.cos(_SAME_START)


def common_rotation(a: Array, b: Array, rng: np.random.Generator) -> Array:
    """The rotation (3, 3) on which most matched unit rays (n, 3) agree, by RANSAC (Fischler and Bolles 1981)."""
    at = rng.integers(len(a), size=(_ROTATION_TRIALS, 2))
    rotations = np.swapaxes(_triads(b[at]), 1, 2) @ _triads(a[at])
    agree = np.linalg.norm(a @ np.swapaxes(rotations, 1, 2) - b, axis=2) < _SAME_ROTATION
    chosen = agree[np.argmax(agree.sum(1))]
    u, _, v = np.linalg.svd(b[chosen].T @ a[chosen])
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def _triads(rays: Array) -> Array:
    """Orthonormal axes (n, 3, 3), one per row, spanned by pairs of rays (n, 2, 3); zero if the two are parallel."""
    normal = _cross(rays[:, 0], rays[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([rays[:, 0], normal, _cross(rays[:, 0], normal)], 1)


def _first_translation(a: Array, b: Array, rotation: Array, error: Array, rng: np.random.Generator) -> Array:
    """The translation with the smallest epipolar errors: forward, or one that a random pair of matches determines.

    The translation lies in the plane of the two rays of each match, so two matches determine it.
    """
    turned = a @ rotation.T
    normals = _cross(turned, b)
    at = rng.integers(len(a), size=(_TRANSLATION_TRIALS, 2))
    proposed = np.concatenate([_cross(normals[at[:, 0]], normals[at[:, 1]]), [[0.0, 0.0, 1.0]]])
    length = np.linalg.norm(proposed, axis=1)
    proposed = proposed[length > 1e-12] / length[length > 1e-12, None]
    sine = np.sqrt(np.maximum(1 - (proposed @ turned.T) ** 2, (_EPIPOLE * error) ** 2))
    costs = np.log1p((proposed @ normals.T / (_WIDE * error * sine)) ** 2).sum(1)
    return proposed[np.argmin(costs)]


def _epipolar(
    a: Array, b: Array, rotation: Array, translation: Array, error: Array
) -> tuple[Array, Array, Array, Array]:
    """Angles between the second rays and their epipolar planes, and the normal equations of a Gauss–Newton step.

    The unknowns are a small rotation (3,), applied after the rotation, and shifts along two directions perpendicular to
    the translation: returns the residuals (n,) in standard deviations, the Hessian (5, 5), the gradient (5,)
    and the directions (2, 3).
    """
    turned = a @ rotation.T
    sine = (error * np.sqrt(np.maximum(1 - (turned @ translation) ** 2, (_EPIPOLE * error) ** 2)))[:, None]
    # Rows of the Householder reflection that maps the translation to an axis; a decomposition takes six times as long.
    normal = translation + np.array([np.copysign(1.0, translation[0]), 0.0, 0.0])
    across = (np.eye(3) - 2 / (normal @ normal) * np.outer(normal, normal))[1:]
    normals = _cross(turned, b) / sine
    residual = normals @ translation
    # turned × (b × translation)
    turns = b * (turned @ translation)[:, None] - (turned * b).sum(1)[:, None] * translation
    jacobian = np.concatenate([turns / sine, normals @ across.T], 1)
    weighted = jacobian / (1 + residual**2)[:, None]
    return residual, weighted.T @ jacobian, weighted.T @ residual, across


def _cross(a: Array, b: Array) -> Array:
    """Cross products (n, 3); np.cross takes several times as long for a few hundred rows."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], 1)


def _minimized(
    a: Array, b: Array, rotation: Array, translation: Array, error: Array, steps: int
) -> tuple[Array, Array, float]:
    """Rotation, translation and cost after a few steps of Levenberg and Marquardt's method under a Cauchy loss."""
    damping = 1e-4
    residual, hessian, gradient, across = _epipolar(a, b, rotation, translation, error)
    cost = float(np.log1p(residual**2).sum())
    for _ in range(steps):
        step = -np.linalg.solve(hessian * (1 + damping * np.eye(5)) + 1e-12 * np.eye(5), gradient)
        turned = _turn(step[:3]) @ rotation
        moved = translation + step[3:] @ across
        moved /= np.linalg.norm(moved)
        terms = _epipolar(a, b, turned, moved, error)
        fresh = float(np.log1p(terms[0] ** 2).sum())
        if fresh >= cost:
            damping *= 10
            continue
        converged = cost - fresh < 1e-6 * cost
        rotation, translation, cost, damping = turned, moved, fresh, max(damping / 5, 1e-7)
        _, hessian, gradient, across = terms
        if converged:
            break
    return rotation, translation, cost


def _turn(vector: NDArray[np.floating]) -> Array:
    """Rotation (3, 3) about a vector (3,) by its length [rad], by Rodrigues; scipy's takes three times as long."""
    x, y, z = vector
    angle = np.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross


# ---- focal lengths


def estimate_focal_lengths(database: Path, seed: int) -> None:
    """Fits the focal length and the first distortion parameter of each camera without a prior to pairs of near frames.

    A film's images must have ids in the order of time. A camera keeps its parameters if its matches do not
    determine them.
    """
    with pycolmap.Database.open(database) as opened:
        cameras, camera_of = _cameras(opened)
        found = zip(*opened.read_two_view_geometries(), strict=True)
        verified = [(pycolmap.pair_id_to_image_pair(pair_id), geometry.inlier_matches) for pair_id, geometry in found]
        for camera in cameras.values():
            if camera.has_prior_focal_length:
                continue
            send_message(say=f"  focal length of camera {camera.camera_id}")
            own = [
                (first, second, matches[:: 1 + len(matches) // _FOCAL_MATCHES])
                for (first, second), matches in verified
                if camera_of[first] == camera_of[second] == camera.camera_id and len(matches) >= 2 * _MIN_MATCHES
            ]
            near = [one for one in own if abs(one[0] - one[1]) <= _FOCAL_STEPS]
            if len(near) < min(_FOCAL_PAIRS, len(own)):  # photos in no order
                near = sorted(own, key=lambda one: -len(one[2]))[:_FOCAL_PAIRS]
            chosen = near[:: 1 + len(near) // _FOCAL_PAIRS]
            ids = sorted({image_id for first, second, _ in chosen for image_id in (first, second)})
            points = {image_id: opened.read_keypoints(image_id)[:, :2].astype(np.float64) for image_id in ids}
            pixels = [(points[first][m[:, 0]], points[second][m[:, 1]]) for first, second, m in chosen]
            if pixels:
                camera.params = _fitted_camera(camera, pixels, np.random.default_rng(seed))
                opened.update_camera(camera)


def _fitted_camera(camera: pycolmap.Camera, pixels: list[tuple[Array, Array]], rng: np.random.Generator) -> list[float]:
    """Parameters of a camera that explain the matched pixels (n, 2) of pairs of its frames with the least cost."""
    focals, distortion = list(camera.focal_length_idxs()), list(camera.extra_params_idxs())[:1]
    first, guess = list(camera.params), camera.mean_focal_length()
    grid = max(camera.width, camera.height) * _FOCAL_GRID
    most = np.log1p(_OUTLIER**2)  # caps the cost of wrong matches, whose errors shrink with the focal length
    poses: list[tuple[Array, Array, float]] = []

    def observed(values: Array) -> list[tuple[Array, Array, Array]]:
        """Rays of all matches, and their errors, for the logarithm of a focal length and a distortion parameter."""
        params = np.array(first, np.float64)
        params[focals] = np.exp(values[0])
        params[distortion] = values[1:]
        camera.params = params.tolist()
        rays = [(camera_rays(camera, p), camera_rays(camera, q)) for p, q in pixels]
        errors = [
            (_keypoint_errors(camera, p, a) + _keypoint_errors(camera, q, b)) / 2
            for (p, q), (a, b) in zip(pixels, rays, strict=True)
        ]
        return [(a, b, error) for (a, b), error in zip(rays, errors, strict=True)]

    def cost(values: Array) -> float:
        """Cost of these values, after a refinement of the poses in `poses`."""
        if not grid[0] <= np.exp(values[0]) * 1.001 <= 1.002 * grid[-1] or (np.abs(values[1:]) > _MAX_DISTORTION).any():
            return np.inf
        total = 0.5 * ((values[0] - np.log(guess)) / _FOCAL_PRIOR) ** 2
        total += 0.5 * float((values[1:] ** 2).sum()) / _DISTORTION_PRIOR**2
        for (a, b, error), pose in zip(observed(values), poses, strict=True):
            if not np.isfinite(error).all():
                return np.inf
            wide = _minimized(a, b, *pose[:2], _WIDE * error, _WIDE_STEPS)
            rotation, translation, _ = _minimized(a, b, *wide[:2], error, _STEPS)
            residual = _epipolar(a, b, rotation, translation, error)[0]
            total += np.minimum(np.log1p(residual**2), most).sum()
        return float(total)

    found = []
    for focal in grid:
        values = np.array([np.log(focal), *np.zeros(len(distortion))])
        poses = [
            relative_pose(a, b, [common_rotation(a, b, rng), np.eye(3)], error, rng) for a, b, error in observed(values)
        ]
        found.append((cost(values), values, poses))
    _, start, poses = min(found, key=lambda one: one[0])
    simplex = start + np.concatenate([np.zeros((1, len(start))), np.diag([0.1, 0.05][: len(start)])])
    options = {"initial_simplex": simplex, "xatol": 2e-3, "fatol": 0.1, "maxfev": 60}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x
    if not grid[0] * 1.05 < np.exp(best[0]) < grid[-1] / 1.05:
        send_message(say=f"  the matches do not determine the focal length of a film; {guess:.0f} px are assumed")
        return first
    observed(best)
    return list(camera.params)
