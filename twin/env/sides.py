"""What another sun does to a place that was filmed under its own: what faces it is lighter than what turns away.

The ground is what all else is compared with, and keeps its light. A surface of normal n under a sun in direction s gets
a gain of exp(strength · (n · s − s_z)), more of it in red than in blue, as the light of a low sun is warm. Normals come
from the picture's own depth; beside an outline, within three pixels, they are the outline's. What is lower than 0.4 m
below the lens keeps its light, kerbs too, as a field's ground is rough; what is higher than the lens gets all of it.
What is far, and the sky itself, get one light of another brightness and colour, more of it towards the sun; between 25
and 40 m the one passes into the other.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

REACH = 40.0  # [m] of depth beyond which no normals are told
_NEAR = 25.0  # [m] of depth up to which nothing is far
_WARM = (0.0, 0.5)  # share of the gain by which red has more, and blue less, than green
_SKY, _TINT = 0.6, 0.15  # standard deviations of the sky's brightness and colour, as shares of the strength
_STANDS = (-0.4, 0.0)  # [m] above the lens: up to the first nothing is lit otherwise, from the second on all of it
_SMOOTH = 3  # [px] a side, over which points are averaged before normals are taken


class Sides:
    """The light on what stands, in one episode."""

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """
        Args:
            strength: Of 0.7 makes a front that faces a sun 15° high 1.6 times as light, one that turns away 0.4 times.
            sun: Direction towards it, a unit vector, shape (3,).
            rng: Of the episode.
        """
        red_to_blue = np.array([1.0, 0.0, -1.0])
        self._sun = sun.astype(np.float32)
        self._gain = (strength * (1.0 + rng.uniform(*_WARM) * red_to_blue)).astype(np.float32)
        sky = rng.normal(0.0, _SKY) + rng.normal(0.0, _TINT) * red_to_blue
        self._sky = (strength * sky).astype(np.float32)

    def over(self, rgb: Floats, depth: Floats, points: Floats) -> Floats:
        """A picture under this sun.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            points: What is seen, relative to the camera in world axes [m], no farther than REACH in depth; shape
                (height, width, 3).
        """
        low, high = _STANDS
        stands = np.clip((points[..., 2] - low) / (high - low), 0.0, 1.0)
        facing = stands * (_normals(points) @ self._sun - self._sun[2])
        light = facing[..., None] * self._gain
        far = depth > _NEAR
        share = np.minimum((depth[far] - _NEAR) / (REACH - _NEAR), 1.0)[:, None]
        ahead = points[far] @ self._sun / np.sqrt(np.einsum("...i,...i", points[far], points[far]))
        light[far] += share * (self._sky + ahead[:, None] * (0.5 * self._gain) - light[far])
        return rgb * np.exp(light)


def _normals(points: Floats) -> Floats:
    """Unit normals of the surface through points around the camera, towards it, shape (height, width, 3)."""
    smooth = cv2.blur(points, (_SMOOTH, _SMOOTH), borderType=cv2.BORDER_REPLICATE)
    down, across = np.gradient(smooth, axis=(0, 1))
    normal = np.cross(down, across)
    squares, towards = (np.einsum("...i,...i", normal, other) for other in (normal, smooth))
    return normal * (-np.sign(towards) / np.sqrt(np.maximum(squares, 1e-18)))[..., None]
