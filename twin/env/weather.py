"""What the weather of an episode lays over its pictures: shadows (`shade.py`), and then the air (`haze.py`)."""

import numpy as np
from numpy.typing import NDArray

from twin.env.haze import Haze
from twin.env.randomisation import Draw
from twin.env.shade import Shade

Floats = NDArray[np.float32]


class Weather:
    """The weather of one episode."""

    def __init__(self, draw: Draw, rng: np.random.Generator) -> None:
        """
        Args:
            draw: Of the episode.
            rng: Of its shadows.
        """
        self._shade = Shade(draw.shade, rng) if draw.shade else None
        self._haze = Haze(draw.extinction, draw.airlight) if draw.extinction else None

    def over(self, rgb: Floats, depth: Floats, rays: NDArray, pose: NDArray) -> Floats:
        """A picture in this weather; shapes and units as in `Shade.over`."""
        if self._shade:
            rgb = self._shade.over(rgb, depth, rays, pose)
        return self._haze.over(rgb, depth, np.linalg.norm(rays, axis=-1).astype(np.float32)) if self._haze else rgb
