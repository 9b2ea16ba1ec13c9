"""How far an observation can be trusted: how far the camera is from what was filmed, and whether the road is there.

The trust of a picture is a number in [0, 1], the smallest of three:

*position and direction*: the offset to the most similar filmed frame, which is its distance [m] plus what a turned
view counts for (`_PER_TURN` metres per unit of 1 − cos of the angle between the optical axes); 1 up to `_NEAR`, 0 from
`_FAR` on, linear in between;
*opacity*: the mean opacity of the lower half of the picture, where nothing but ground and things should be;
*sky in the road*: 1 minus `_SKY_WEIGHT` times the share of that half where hardly anything stops the light.
"""

import numpy as np
from scipy.spatial import cKDTree

from twin.geometry.cameras import Posed
from twin.nerf.rendering import Rendering
from twin.types import Array

SKY = 0.5
"""Opacity below which a pixel shows the sky."""

_PER_TURN = 10.0  # [m]: a right angle counts as 10 m, as in `geometry.cameras.nearest_frame`
_NEAR, _FAR = 1.0, 5.0  # [m]
_SKY_WEIGHT = 5.0
_CANDIDATES = 32  # filmed frames looked at, nearest first


class Trust:
    """What was filmed of a place."""

    def __init__(self, cameras: Posed) -> None:
        """
        Args:
            cameras: The filmed frames.
        """
        poses = np.asarray(cameras.camera_to_world, np.float64)
        self._axes = poses[:, :3, 2]
        self._tree = cKDTree(poses[:, :3, 3])
        self._candidates = min(_CANDIDATES, len(poses))

    def offset(self, camera_to_world: Array) -> Array:
        """Offset to the most similar filmed frame [m] of OpenCV poses (n, 4, 4), shape (n,)."""
        distance, frame = self._tree.query(camera_to_world[:, :3, 3], self._candidates)
        distance, frame = distance.reshape(len(camera_to_world), -1), frame.reshape(len(camera_to_world), -1)
        cosine = (self._axes[frame] * camera_to_world[:, None, :3, 2]).sum(-1)
        return (distance + _PER_TURN * (1.0 - cosine)).min(1)

    def of(self, camera_to_world: Array, rendering: Rendering) -> Array:
        """Trust of pictures from OpenCV poses (n, 4, 4), in [0, 1], shape (n,)."""
        lower = rendering.opacity[:, rendering.opacity.shape[1] // 2 :]
        return self.judged(camera_to_world, lower.mean((1, 2)), (lower < SKY).mean((1, 2)))

    def judged(self, camera_to_world: Array, opaque: Array, sky: Array) -> Array:
        """The same from the lower half's mean opacity, and the share of it that shows the sky, each shape (n,)."""
        filmed = np.clip((_FAR - self.offset(camera_to_world)) / (_FAR - _NEAR), 0.0, 1.0)
        return np.minimum(np.minimum(filmed, opaque), np.clip(1.0 - _SKY_WEIGHT * sky, 0.0, 1.0))
