"""What a renderer returns, whichever renderer it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Rendering:
    """n rendered views of one size."""

    rgb: NDArray[np.float32]
    """Colour in [0, 1], shape (n, height, width, 3)."""
    depth: NDArray[np.float32]
    """z-depth at which half the light is stopped [m]; `FAR` where nothing stops it. Shape (n, height, width)."""
    opacity: NDArray[np.float32]
    """Share of the light that is stopped, in [0, 1], shape (n, height, width)."""


FAR = 1.0e4
"""z-depth of the background [m]."""
