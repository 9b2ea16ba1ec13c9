"""Tells matches of near points from those of far points, before any pose is known.

Between two frames, points on the skyline move as under a rotation of the camera alone. They constrain rotations, but
not positions or scale. On a road with little texture their tracks are the longest, and global mapping explains them
best by cameras that stand still.
"""

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from twin.types import Array

FAR_ANGLE = np.radians(0.8)
"""[rad] Matches with less parallax are those of far points."""
_MIN_MATCHES = 15  # least number of matches of a pair
_SAME_ROTATION = np.radians(0.2)  # [rad] largest deviation of a far point from the rotation that most points share
_TRIALS = 60  # random pairs of matches that propose a rotation
_REFINEMENTS = 3


def remove_far_points(path: Path, seed: int) -> None:
    """Removes the matches of far points from COLMAP's database, and pairs of frames with few others."""
    rng = np.random.default_rng(seed)
    with pycolmap.Database.open(path) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        rays = {
            image.image_id: _rays(cameras[image.camera_id], database.read_keypoints(image.image_id)[:, :2])
            for image in database.read_all_images()
        }
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            matches = geometry.inlier_matches
            if not len(matches):
                continue
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            first, second = (rays[image_id][matches[:, k]] for k, image_id in enumerate(pair))
            near = parallax(first, second, rng) > FAR_ANGLE
            database.delete_two_view_geometry(*pair)
            if near.sum() >= _MIN_MATCHES:
                geometry.inlier_matches = matches[near]
                database.write_two_view_geometry(*pair, geometry)


def _rays(camera: pycolmap.Camera, pixels: NDArray[np.floating]) -> Array:
    """Unit directions (n, 3) of pixels (n, 2) in the camera's frame."""
    directions = np.ones((len(pixels), 3))
    directions[:, :2] = camera.cam_from_img(pixels)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def parallax(first: Array, second: Array, rng: np.random.Generator) -> NDArray[np.float64]:
    """Angles (n,) [rad] between matched unit rays (n, 3) of two frames after the rotation on which most matches agree.

    The rotation is found by RANSAC (Fischler and Bolles 1981).
    """
    at = rng.integers(len(first), size=(_TRIALS, 2))
    rotations = np.swapaxes(_triads(second[at]), 1, 2) @ _triads(first[at])
    agree = np.linalg.norm(first @ np.swapaxes(rotations, 1, 2) - second, axis=2) < _SAME_ROTATION
    rotation = rotations[np.argmax(agree.sum(1))]
    for _ in range(_REFINEMENTS):
        chosen = np.linalg.norm(first @ rotation.T - second, axis=1) < _SAME_ROTATION
        u, _, v = np.linalg.svd(second[chosen].T @ first[chosen])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.linalg.norm(first @ rotation.T - second, axis=1)


def _triads(rays: Array) -> Array:
    """Orthonormal axes (n, 3, 3), one per row, spanned by pairs of rays (n, 2, 3); zero if the two are parallel."""
    normal = np.cross(rays[:, 0], rays[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([rays[:, 0], normal, np.cross(rays[:, 0], normal)], 1)
