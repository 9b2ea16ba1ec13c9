"""Shadows that the film did not have, such as another sun throws: dark patches that lie in the place and stay there.

What throws them is not there. A *pattern* of light and dark, drawn for an episode, fills the plane z = 0 and is carried
through space along the rays of the episode's sun, so that ground, kerbs and walls are crossed by it as by a shadow. It
is made of *patches*, some of them broken up as those of leaves are, of *solids* with straight edges as houses and posts
throw them, which look like kerbs and lines to who has never seen any, or of both. The lower the sun, the longer they
are.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.env.sides import REACH

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_SIDE = 256  # texels of a pattern, which repeats itself
_TEXEL = 0.1  # [m] across the sun's direction
_BLOBS = (0.4, 2.0)  # [m] smallest and largest radius of patches
_LEAVES = 0.15  # [m] of the holes in broken ones
_COVER = (0.2, 0.6)  # share of the plane in the dark of patches
_HOUSES, _HOUSE = (1, 4), (3.0, 12.0)  # how many, below the second; [m] their sides, before the sun stretches them
_POSTS, _POST, _POST_LENGTH = (0, 8), (0.1, 0.5), (2.0, 10.0)  # how many; [m] width and length
_FINER = 4  # times, what solids are drawn at so that their edges are smooth
_SKY = np.array([1.0, 0.95, 0.85], np.float32)  # what is left in a shadow is the sky's light, which is bluer


class Shade:
    """The shadows of one episode."""

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """
        Args:
            strength: Share of a colour that is lost in full shadow.
            sun: Direction towards it, a unit vector, shape (3,).
            rng: Of the episode.
        """
        flat = np.linalg.norm(sun[:2])
        along = sun[:2] / flat
        self._slant = sun[:2] / sun[2]
        long = max(1.0, flat / sun[2])
        self._to_texel = np.stack([along / long, [-along[1], along[0]]]) / _TEXEL
        self._loss: Floats = np.float32(strength) * _SKY
        kind = rng.integers(3)  # patches, solids, both
        self._pattern = np.zeros((_SIDE, _SIDE), np.float32)
        if kind != 1:
            radius = np.exp(rng.uniform(*np.log(_BLOBS)))
            self._pattern = _patches(rng, radius / _TEXEL, rng.uniform(*_COVER))
            if rng.random() < 0.5:
                self._pattern = self._pattern * _patches(rng, _LEAVES / _TEXEL, 0.6)
        if kind != 0:
            self._pattern = np.maximum(self._pattern, _solids(rng))

    def over(self, rgb: Floats, depth: Floats, points: Array) -> Floats:
        """A picture with the shadows in it.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            points: What is seen, in the world [m], no farther than REACH in depth; shape (height, width, 3).
        """
        flat = points[..., :2] - points[..., 2:] * self._slant
        across, down = np.moveaxis(flat @ self._to_texel.T % _SIDE, -1, 0).astype(np.float32)
        dark = cv2.remap(self._pattern, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
        dark[depth >= REACH] = 0.0
        return rgb * (np.float32(1.0) - dark[..., None] * self._loss)


def _solids(rng: np.random.Generator) -> Floats:
    """A pattern, 1 in the dark, of houses turned anyhow and of posts along the sun's direction; shape (side, side)."""
    side = _SIDE * _FINER
    canvas = np.zeros((side, side), np.uint8)
    houses = [(rng.uniform(*_HOUSE, 2), rng.uniform(0.0, np.pi)) for _ in range(rng.integers(*_HOUSES))]
    posts = [((rng.uniform(*_POST_LENGTH), rng.uniform(*_POST)), 0.0) for _ in range(rng.integers(*_POSTS))]
    for size, turn in houses + posts:
        middle = rng.uniform(0.0, side, 2)
        for x in (-side, 0, side):  # it repeats itself without a seam
            for y in (-side, 0, side):
                wide, high = (extent / _TEXEL * _FINER for extent in size)
                box = ((middle[0] + x, middle[1] + y), (wide, high), np.rad2deg(turn))
                cv2.fillConvexPoly(canvas, cv2.boxPoints(box).round().astype(np.int32), 255)
    return cv2.resize(canvas, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)


def _patches(rng: np.random.Generator, radius: float, cover: float) -> Floats:
    """A pattern, 1 in the dark, of patches of about a radius [texels] that cover a share of it; shape (side, side)."""
    # Smoothed as on a torus, so that it repeats itself without a seam.
    frequency = np.fft.fftfreq(_SIDE)[:, None] ** 2 + np.fft.rfftfreq(_SIDE) ** 2
    smooth = np.exp(-2.0 * (np.pi * radius) ** 2 * frequency)
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE))) * smooth, (_SIDE, _SIDE))
    noise /= noise.std()
    # An edge as wide as a third of the patch's radius is as soft as a tree's at some metres.
    edge = 0.15
    return np.clip((noise - np.quantile(noise, 1.0 - cover)) / edge + 0.5, 0.0, 1.0).astype(np.float32)
