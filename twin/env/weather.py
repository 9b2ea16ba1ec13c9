"""What the weather of an episode lays over its pictures: another sun's light on what stands (`sides.py`), that sun's
shadows (`shade.py`), and then the air: that of the episode's own light, where a photo told it (`nerf/air.py`), and what
was drawn besides (`haze.py`)."""

import numpy as np
from numpy.typing import NDArray

from twin.env.haze import Haze
from twin.env.randomisation import Draw
from twin.env.shade import Shade
from twin.env.sides import REACH, Sides
from twin.nerf.air import Air

Floats = NDArray[np.float32]

_ELEVATION = (10.0, 55.0)  # [°] of the sun


class Weather:
    """The weather of one episode."""

    def __init__(self, draw: Draw, rng: np.random.Generator, air: Air | None = None) -> None:
        """
        Args:
            draw: Of the episode.
            rng: Of its sun, light and shadows.
            air: See `air`.
        """
        self.air = air
        """Of the episode's light as it is now, where a photo told it; clear or None: nothing of its own."""
        elevation, azimuth = np.deg2rad(rng.uniform(*_ELEVATION)), rng.uniform(0.0, 2.0 * np.pi)
        level = np.cos(elevation)
        sun = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        # Each draws from a sequence of its own, so that neither changes with whether there is the other.
        sides, shade = rng.spawn(2)
        self._sides = Sides(draw.sunlight, sun, sides) if draw.sunlight else None
        self._shade = Shade(draw.shade, sun, shade) if draw.shade else None
        self._haze = Haze(draw.extinction, draw.airlight) if draw.extinction else None

    def over(self, rgb: Floats, depth: Floats, rays: NDArray, pose: NDArray) -> Floats:
        """A picture in this weather.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            rays: Of the pixels, in the camera, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
        """
        if self._sides or self._shade:
            around = (rays * np.minimum(depth, REACH)[..., None]) @ pose[:3, :3].T
            if self._sides:
                rgb = self._sides.over(rgb, depth, around.astype(np.float32))
            if self._shade:
                rgb = self._shade.over(rgb, depth, around + pose[:3, 3])
        if self.air or self._haze:
            distance = depth * np.linalg.norm(rays, axis=-1).astype(np.float32)
            airs: list[Air | Haze] = [one for one in (self.air, self._haze) if one]
            for one in airs:
                rgb = one.over(rgb, distance)
        return rgb
