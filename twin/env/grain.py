"""The detail that a field leaves out, or washes out: roughness, cracks, patches, spots.

A field's picture of a road is smoother than the film that it was learnt from. A *pattern* of light and dark, drawn for
an episode, lies on whatever is seen and stays there. It is seen through pixels: what is finer than a pixel averages
out, so that it fades with distance and is gone in the far, which fields show as sharp as films do. It is laid on along
one slanted direction, in which hardly any surface lies.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.env.sides import REACH

Floats = NDArray[np.float32]

_SIDE = 512  # texels of the pattern, which repeats itself; a power of two
_TEXEL = 0.025  # [m]
_COARSEST = 0.4  # [m] of the roughness' wavelengths; all down to two texels are alike
_ROUGH = 0.1  # standard deviation of the roughness, of the logarithm of brightness; the same unit below
_CRACKS, _CRACK_LENGTH, _CRACK = (3, 25), (1.0, 6.0), (-0.8, -0.2)  # how many, below the second; [m]
_PATCHES, _PATCH_SIDE, _PATCH = (0, 5), (0.5, 3.0), (-0.25, 0.25)
_SPOTS, _SPOT_RADIUS, _SPOT = (10, 150), (0.02, 0.1), (-0.6, 0.6)
_BEND = 0.4  # [rad] per knot of a crack
_KNOT = 0.3  # [m] between knots
_SLANT = np.array([[1.0, 0.0], [0.0, 1.0], [0.7, 0.6]], np.float32) / np.float32(_TEXEL)  # from the world to texels
_LEVELS = 7  # of the pattern, each half as fine as the one before
_SHIFT = 4  # bits of fraction that OpenCV draws with


class Grain:
    """The detail of one episode."""

    def __init__(self, strength: float, rng: np.random.Generator) -> None:
        """
        Args:
            strength: What the pattern is multiplied by; 0 changes nothing.
            rng: Of the episode.
        """
        self._levels: list[Floats] = [np.float32(strength) * (_roughness(rng) + _marks(rng))]
        for _ in range(_LEVELS - 1):
            half = len(self._levels[-1]) // 2
            self._levels.append(self._levels[-1].reshape(half, 2, half, 2).mean((1, 3)))

    def over(self, rgb: Floats, depth: Floats, points: Floats) -> Floats:
        """A picture with the detail in it.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            points: What is seen, in the world [m], no farther than REACH in depth; shape (height, width, 3).
        """
        at = points @ _SLANT
        down, across = np.gradient(at, axis=(0, 1))
        area = np.abs(down[..., 0] * across[..., 1] - down[..., 1] * across[..., 0])
        level = np.clip(0.5 * np.log2(np.maximum(area, 1.0)), 0.0, _LEVELS - 1.0)
        at = at % np.float32(_SIDE)
        light = np.zeros_like(depth)
        for k, pattern in enumerate(self._levels):
            # The middle of a coarser texel is the corner of four finer ones.
            texel = at * np.float32(0.5**k) + np.float32(0.5 ** (k + 1) - 0.5)
            seen = cv2.remap(pattern, texel, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            light += np.maximum(np.float32(1.0) - np.abs(level - np.float32(k)), np.float32(0.0)) * seen
        light[depth >= REACH] = 0.0
        return rgb * np.exp(light)[..., None]


def _roughness(rng: np.random.Generator) -> Floats:
    """Noise with as much in every octave of its wavelengths, shape (side, side)."""
    frequency = np.sqrt(np.fft.fftfreq(_SIDE)[:, None] ** 2 + np.fft.rfftfreq(_SIDE) ** 2)
    amplitude = (frequency >= _TEXEL / _COARSEST) / np.maximum(frequency, 1.0 / _SIDE)
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE))) * amplitude, (_SIDE, _SIDE))
    return (_ROUGH / noise.std() * noise).astype(np.float32)


def _marks(rng: np.random.Generator) -> Floats:
    """Patches with seams around them, cracks and spots, shape (side, side)."""
    # Twice as large and folded onto itself, it repeats without a seam.
    canvas = np.zeros((2 * _SIDE, 2 * _SIDE), np.float32)

    def line(points: NDArray, value: float, closed: bool) -> None:
        at = np.round(points * 2**_SHIFT).astype(np.int32)
        cv2.polylines(canvas, [at], closed, value, int(rng.integers(1, 4)), cv2.LINE_8, _SHIFT)

    for _ in range(rng.integers(*_PATCHES)):
        sides = rng.uniform(*_PATCH_SIDE, 2) / _TEXEL
        corners = cv2.boxPoints((_anywhere(rng), sides, rng.uniform(0.0, 180.0)))
        cv2.fillConvexPoly(canvas, np.round(corners * 2**_SHIFT).astype(np.int32), rng.uniform(*_PATCH), shift=_SHIFT)
        line(corners, rng.uniform(*_CRACK), True)
    for _ in range(rng.integers(*_CRACKS)):
        knots = round(rng.uniform(*_CRACK_LENGTH) / _KNOT) + 1
        heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, _BEND, knots))
        steps = np.stack([np.cos(heading), np.sin(heading)], -1) * (_KNOT / _TEXEL)
        line(_anywhere(rng) + np.cumsum(steps, 0), rng.uniform(*_CRACK), False)
    for _ in range(rng.integers(*_SPOTS)):
        u, v = np.round(_anywhere(rng) * 2**_SHIFT).astype(int).tolist()
        radius = round(rng.uniform(*_SPOT_RADIUS) / _TEXEL * 2**_SHIFT)
        cv2.circle(canvas, (u, v), radius, rng.uniform(*_SPOT), -1, shift=_SHIFT)
    return canvas.reshape(2, _SIDE, 2, _SIDE).sum((0, 2))


def _anywhere(rng: np.random.Generator) -> NDArray:
    """A place on the middle of the canvas [texels], shape (2,)."""
    return rng.uniform(0.5 * _SIDE, 1.5 * _SIDE, 2)
