"""Homogeneous fog, applied to an image by its depth (Koschmieder 1924).

Over a distance d, fog keeps a share exp(−extinction · d) of a surface's light; the rest of the color is the *airlight*,
which the air scatters towards the camera. The meteorological visibility, at which fog keeps 5 %, is 3 / extinction.
"""

from dataclasses import dataclass

import numpy as np

from twin.types import Array32

REACH = 100.0
"""Greatest distance [m] over which fog accumulates: fog lies low and does not hide the sky."""


@dataclass(frozen=True)
class Fog:
    """Fog in addition to any in the film; none by default."""

    extinction: float = 0.0
    """[1/m]"""
    airlight: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB in [0, 1]."""

    def apply(self, rgb: Array32, distance: Array32) -> Array32:
        """Applies the fog to an image (..., 3) with distances along the rays [m], shape (...)."""
        if not self.extinction:
            return rgb
        kept = np.exp(np.float32(-self.extinction) * np.minimum(distance, np.float32(REACH)))[..., None]
        return kept * rgb + (np.float32(1.0) - kept) * np.asarray(self.airlight, np.float32)


def mixed(one: Fog | None, other: Fog | None, share: float) -> Fog | None:
    """Interpolated fog, `share` of the way from `one` to `other`; None stands for no additional fog.

    The airlights are weighted by the extinctions.
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
