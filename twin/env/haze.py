"""Air that the film did not have, laid into a picture by its depth.

*Extinction* is the share of light that a metre of air takes away [1/m]: what is seen over a distance d keeps
exp(−extinction · d) of its light and gains the rest from the *airlight*, which the air itself scatters towards the
camera (Koschmieder 1924). *Visibility*, as meteorologists say it, is the distance over which 5 % are kept: 3 over the
extinction.

The airlight has the colour that the sky has near the horizon in the episode's own light, as its first picture shows it.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_FAR = 40.0  # [m] what is farther has nearly the horizon's colour
_HIGH = 100.0  # [m] that haze reaches at most: it lies low, so the sky shines through
_FEW = 0.01  # share of a picture that must be so far for its colour to count


class Haze:
    """The air of one episode."""

    def __init__(self, extinction: float, airlight: float = 1.0) -> None:
        """
        Args:
            extinction: [1/m].
            airlight: Its brightness as a share of the horizon's.
        """
        self._extinction, self._gain = np.float32(extinction), np.float32(airlight)
        self._airlight: Floats | None = None

    def over(self, rgb: Floats, depth: Floats, lengths: Floats) -> Floats:
        """A picture as seen through the air; an episode's first one tells the airlight.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            lengths: Of the pixels' rays where z = 1, shape (height, width).
        """
        distance = np.minimum(depth * lengths, np.float32(_HIGH))
        if self._airlight is None:
            self._airlight = np.minimum(self._gain * _horizon(rgb, distance), np.float32(1.0))
        kept = np.exp(-self._extinction * distance)[..., None]
        return kept * rgb + (1.0 - kept) * self._airlight


def _horizon(rgb: Floats, distance: Floats) -> Floats:
    """Colour of what is far, shape (3,); of the upper third, where too little is."""
    far = distance > _FAR
    if far.mean() < _FEW:
        far = np.zeros_like(far)
        far[: max(1, len(far) // 3)] = True
    return rgb[far].mean(0)
