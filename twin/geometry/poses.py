"""Rigid and similarity transforms.

A *pose* is a 4×4 matrix that maps homogeneous points from one frame to another; its name gives both frames, as in
`camera_to_world`. A *similarity* also scales: x ↦ s·R·x + t.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.types import Array


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation · x + translation, from a source frame to a target frame."""

    scale: float
    rotation: Array
    translation: Array

    def points(self, x: Array) -> Array:
        """Maps points, shape (..., 3)."""
        return self.scale * x @ self.rotation.T + self.translation

    def poses(self, pose: Array) -> Array:
        """Maps camera-to-source to camera-to-target poses; rotations stay orthonormal. Shape (..., 4, 4)."""
        out = np.array(pose, dtype=np.float64)
        out[..., :3, :3] = self.rotation @ out[..., :3, :3]
        out[..., :3, 3] = self.points(out[..., :3, 3])
        return out

    def __matmul__(self, first: "Similarity") -> "Similarity":
        """Applies `first`, then this similarity."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation))

    def inverse(self) -> "Similarity":
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def umeyama(source: Array, target: Array, with_scale: bool = True) -> Similarity:
    """Least-squares similarity (rigid if `with_scale` is false) from source to target; Umeyama 1991, eqs. 34 to 42.

    Source and target are corresponding points, shape (n, 3), n ≥ 3 and not collinear.
    """
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((singular * signs).sum() / (a**2).sum() * len(a)) if with_scale else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def pose_of(rotation: NDArray, position: NDArray) -> Array:
    """The pose (..., 4, 4) with a rotation (..., 3, 3) and a position (..., 3)."""
    pose = np.zeros((*np.shape(position)[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, position, 1.0
    return pose


def inverse_pose(pose: Array) -> Array:
    """Inverse of rigid transforms, shape (..., 4, 4)."""
    out = np.zeros_like(pose)
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -(rotation_t @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def rotation_angle(rotation: Array) -> Array:
    """Angle of rotation matrices [rad], shape (..., 3, 3) → (...)."""
    # The skew part is used with the trace, as the arccos of the trace alone loses half the digits near zero.
    skew = np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    return np.arctan2(np.linalg.norm(skew, axis=-1), np.trace(rotation, axis1=-2, axis2=-1) - 1.0)


def wrap_angle(angle: Array | float) -> Array:
    """The same angle in [−π, π) [rad]."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def look_at(eye: Array, target: Array) -> Array:
    """camera_to_world of an upright OpenCV camera at `eye` that looks at `target`, shape (4, 4)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return pose_of(np.stack([right, np.cross(forward, right), forward], 1), eye)
