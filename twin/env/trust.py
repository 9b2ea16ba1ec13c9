"""Trust: the estimated reliability of a rendered picture.

Trust is high if the picture's camera is near the filmed frames and the reconstruction in view is complete. It is the
smallest of three numbers in [0, 1]:

*pose*: 1 if the offset to the most similar filmed frame is at most `_NEAR`, 0 if it is at least `_FAR`, linear in
between. The offset of two cameras is their distance [m] plus `_PER_TURN` · (1 − cos α), where α is the angle between
their optical axes;
*opacity*: the mean opacity of the lower half of the picture, where only ground and objects should be visible;
*sky in the road*: 1 minus `_SKY_WEIGHT` times the fraction of the lower half whose opacity is below `SKY_OPACITY`.

It is apart from the observation, because a build, which needs no dm_control, draws a map of it.
"""

import numpy as np
from scipy.spatial import cKDTree

from twin.geometry.cameras import PosedCameras, Rendering
from twin.types import Array

SKY_OPACITY = 0.5
"""Opacity below which a pixel shows the sky."""

_PER_TURN = 10.0  # [m]: a right angle counts as 10 m, as in `geometry.cameras.nearest_frame`
_NEAR, _FAR = 1.0, 5.0  # [m]
_SKY_WEIGHT = 5.0
_CANDIDATES = 32  # number of nearest filmed frames that are compared


class Trust:
    """Computes the trust of pictures."""

    def __init__(self, cameras: PosedCameras) -> None:
        """`cameras` are the filmed frames."""
        poses = np.asarray(cameras.camera_to_world, np.float64)
        self._axes = poses[:, :3, 2]
        self._tree = cKDTree(poses[:, :3, 3])
        self._candidates = min(_CANDIDATES, len(poses))

    def offset(self, camera_to_world: Array) -> Array:
        """Offsets [m] of OpenCV poses (n, 4, 4) to their most similar filmed frames, shape (n,)."""
        distance, frame = self._tree.query(camera_to_world[:, :3, 3], self._candidates)
        distance, frame = distance.reshape(len(camera_to_world), -1), frame.reshape(len(camera_to_world), -1)
        cosine = (self._axes[frame] * camera_to_world[:, None, :3, 2]).sum(-1)
        return (distance + _PER_TURN * (1.0 - cosine)).min(1)

    def of(self, camera_to_world: Array, rendering: Rendering) -> Array:
        """Trust of pictures from OpenCV poses (n, 4, 4), in [0, 1], shape (n,)."""
        lower = rendering.opacity[:, rendering.opacity.shape[1] // 2 :]
        return self.from_opacity(camera_to_world, lower.mean((1, 2)), (lower < SKY_OPACITY).mean((1, 2)))

    def from_opacity(self, camera_to_world: Array, mean_opacity: Array, sky_share: Array) -> Array:
        """Trust of pictures, from the mean opacity and the fraction of sky pixels of their lower halves; all (n,)."""
        near_film = np.clip((_FAR - self.offset(camera_to_world)) / (_FAR - _NEAR), 0.0, 1.0)
        return np.minimum(np.minimum(near_film, mean_opacity), np.clip(1.0 - _SKY_WEIGHT * sky_share, 0.0, 1.0))
