"""Common interface of the renderers of a place."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import PosedCameras


@dataclass(frozen=True)
class Rendering:
    """n rendered views of one size."""

    rgb: NDArray[np.float32]
    """Color in [0, 1], shape (n, height, width, 3)."""
    depth: NDArray[np.float32]
    """z-depth [m] at which half the light is blocked, `FAR` where less is blocked; shape (n, height, width)."""
    opacity: NDArray[np.float32]
    """Share of the light that is blocked, in [0, 1], shape (n, height, width)."""


class RenderableField(Protocol):
    """Interface shared by `RadianceField` and `BakedField`."""

    @property
    def lightings(self) -> tuple[str, ...]: ...

    def render(self, cameras: PosedCameras, lighting: str, size: tuple[int, int]) -> Rendering: ...


FAR = 1.0e4
"""z-depth of the background [m]."""
