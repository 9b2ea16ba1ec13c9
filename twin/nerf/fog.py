"""The air between a camera and a place, laid into a picture by its depth.

*Extinction* is the share of light that a metre of air takes away [1/m]: what is seen over a distance d keeps
exp(−extinction · d) of its light and gains the rest from the *airlight*, which the air itself scatters towards the
camera (Koschmieder 1924). *Visibility*, as meteorologists say it, is the distance over which 5 % are kept: 3 over the
extinction.
"""

from dataclasses import dataclass

import numpy as np

from twin.types import Array32

REACH = 100.0
"""[m] that air reaches at most: haze lies low, so the sky shines through."""


@dataclass(frozen=True)
class Fog:
    """Over that of the film; clear by default."""

    extinction: float = 0.0
    """[1/m]"""
    airlight: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB in [0, 1]."""

    def over(self, rgb: Array32, distance: Array32) -> Array32:
        """A picture (..., 3) as seen through this air; distance along the rays [m], shape (...)."""
        if not self.extinction:
            return rgb
        kept = np.exp(np.float32(-self.extinction) * np.minimum(distance, np.float32(REACH)))[..., None]
        return kept * rgb + (np.float32(1.0) - kept) * np.asarray(self.airlight, np.float32)


def mixed(one: Fog | None, other: Fog | None, share: float) -> Fog | None:
    """The air `share` of the way from one to another; None is the film's, and both of them None give None.

    Each airlight counts by how much there is of its air.
    """
    if one is None and other is None:
        return None
    a, b = one or Fog(), other or Fog()
    mine, its = (1.0 - share) * a.extinction, share * b.extinction
    total = mine + its
    if not total:
        return Fog()
    red, green, blue = (mine * np.array(a.airlight) + its * np.array(b.airlight)) / total
    return Fog(total, (float(red), float(green), float(blue)))
