"""Light as no field knows it: random tones, tints and shades laid over pictures in updates.

A field's lightings are those that the place was filmed in and what lies between them. Other weather has another sky and
other shadows, and things take another colour in it. Brightness, contrast and tint of the ground as a whole are levelled
before a policy sees them (`architecture.levelled`); what is left is varied at random here, for every sample anew and
alike for all pictures of a stack, so that motion stays what it is:

    tone     v → v^gamma, and its contrast about the middle
    tint     a gain for each colour
    shade    a smooth pattern of light and dark over the picture
    covers   rectangles of one colour, so that no one thing in the background is what is steered by

All is drawn around no change at all, and scaled by one *strength*; 1 is what the constants below say.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

_GAMMA, _CONTRAST, _TINT = 0.25, 0.25, 0.08  # standard deviations, of logarithms
_SHADE = 0.4  # the same, at the knots
_COVERS, _COVER = 4, (0.1, 0.5)  # fewer than so many; their sides as shares of the picture's
_KNOTS = (3, 5)  # of the pattern, down and across
_LEVELS = np.arange(256) / 255.0


def recoloured(stacks: NDArray[np.uint8], strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Stacks as they might look in other weather.

    Args:
        stacks: Shape (k, 3 · stack, height, width), colours of one picture next to each other.
        strength: 0 changes nothing.
        rng: What is drawn from.
    """
    count, channels, height, width = stacks.shape
    curves = _curves(count, strength, rng)
    knots = np.exp(strength * _SHADE * rng.normal(size=(count, *_KNOTS))).astype(np.float32)
    out = np.empty_like(stacks)
    for i in range(count):
        shade = cv2.resize(knots[i], (width, height), interpolation=cv2.INTER_CUBIC)
        for channel in range(channels):
            toned = cv2.LUT(stacks[i, channel], curves[i, channel % 3])
            cv2.multiply(toned, shade, out[i, channel], dtype=cv2.CV_8U)
        for _ in range(rng.integers(_COVERS) if strength else 0):
            sides = (rng.uniform(*_COVER, 2) * (height, width)).astype(int) + 1
            top, left = (rng.uniform(size=2) * ((height, width) - sides)).astype(int)
            colour = np.tile(rng.integers(0, 256, 3, np.uint8), channels // 3)
            out[i, :, top : top + sides[0], left : left + sides[1]] = colour[:, None, None]
    return out


def _curves(count: int, strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A tone curve per sample and colour, shape (count, 3, 256)."""

    def spread(deviation: float, colours: int) -> NDArray[np.float64]:
        return np.exp(strength * deviation * rng.normal(size=(count, colours, 1)))

    toned = 0.5 + (_LEVELS ** spread(_GAMMA, 1) - 0.5) * spread(_CONTRAST, 1)
    return (255.0 * toned * spread(_TINT, 3)).clip(0.0, 255.0).round().astype(np.uint8)
