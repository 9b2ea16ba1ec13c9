"""What renders a place, and what it returns, whichever renderer it is."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import Posed


@dataclass(frozen=True)
class Rendering:
    """n rendered views of one size."""

    rgb: NDArray[np.float32]
    """Colour in [0, 1], shape (n, height, width, 3)."""
    depth: NDArray[np.float32]
    """z-depth at which half the light is stopped [m]; `FAR` where nothing stops it. Shape (n, height, width)."""
    opacity: NDArray[np.float32]
    """Share of the light that is stopped, in [0, 1], shape (n, height, width)."""


class RenderableField(Protocol):
    """The part of a radiance field that needs no knowledge of its kind."""

    @property
    def lightings(self) -> tuple[str, ...]: ...

    def render(self, cameras: Posed, lighting: str, size: tuple[int, int]) -> Rendering: ...


FAR = 1.0e4
"""z-depth of the background [m]."""
