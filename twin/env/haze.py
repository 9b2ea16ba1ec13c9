"""Air that is drawn for an episode, over what a photo told of it if one did: see `nerf/air.py` for what it does.

The airlight has the colour that the sky has near the horizon in the episode's own light, as its first picture shows it.
"""

import numpy as np
from numpy.typing import NDArray

from twin.nerf.air import REACH, Air

Floats = NDArray[np.float32]

_FAR = 40.0  # [m] what is farther has nearly the horizon's colour
_FEW = 0.01  # share of a picture that must be so far for its colour to count


class Haze:
    """The air of one episode."""

    def __init__(self, extinction: float, airlight: float = 1.0) -> None:
        """
        Args:
            extinction: [1/m].
            airlight: Its brightness as a share of the horizon's.
        """
        self._extinction, self._gain = extinction, np.float32(airlight)
        self._air: Air | None = None

    def over(self, rgb: Floats, distance: Floats) -> Floats:
        """A picture as seen through the air; an episode's first one tells the airlight.

        Args:
            rgb: Shape (height, width, 3).
            distance: Along the pixels' rays [m], shape (height, width).
        """
        if self._air is None:
            horizon = _horizon(rgb, np.minimum(distance, np.float32(REACH)))
            red, green, blue = np.minimum(self._gain * horizon, np.float32(1.0)).tolist()
            self._air = Air(self._extinction, (red, green, blue))
        return self._air.over(rgb, distance)


def _horizon(rgb: Floats, distance: Floats) -> Floats:
    """Colour of what is far, shape (3,); of the upper third, where too little is."""
    far = distance > _FAR
    if far.mean() < _FEW:
        far = np.zeros_like(far)
        far[: max(1, len(far) // 3)] = True
    return rgb[far].mean(0)
