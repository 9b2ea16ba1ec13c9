"""How well a prediction meets the windows it was not fitted to. Errors are of the pose at a window's end."""

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.alignment.kinematics import at, end_errors
from twin.alignment.logs import Windows

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Over windows."""

    windows: int
    position_m: float
    """Median."""
    yaw_deg: float
    """Median."""
    position_m_p90: float
    yaw_deg_p90: float
    wheels_rad_s: float
    """Median over windows, samples and sides."""

    def told(self) -> dict[str, float]:
        """For JSON, rounded."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


class Prediction:
    """What a model makes of every window of a log."""

    def __init__(self, name: str, windows: Windows, poses: Array, wheels: Array | None = None) -> None:
        """
        Args:
            name: For the legend.
            windows: The log.
            poses: `PERIOD` apart since each window's first was measured, shape (n, k + OLDEST + 1, 3).
            wheels: Shape (n, ≥ k, 2); the measured ones where the model is told them.
        """
        self.name = name
        self.windows = windows
        self.poses = poses
        self.wheels = windows.wheels if wheels is None else wheels[:, : windows.wheels.shape[1]]

    @cached_property
    def ends(self) -> Array:
        """Poses when the last one was measured, shape (n, 3)."""
        return at(self.poses, self.windows.elapsed[:, -1])

    @cached_property
    def _errors(self) -> tuple[Array, Array]:
        return end_errors(self.poses, self.windows)

    @property
    def distance(self) -> Array:
        """[m], shape (n,)."""
        return self._errors[0]

    @property
    def angle(self) -> Array:
        """[°], shape (n,)."""
        return self._errors[1]

    def score(self, which: NDArray[np.bool_]) -> Score:
        """Over some of the windows."""
        off = np.abs(self.wheels - self.windows.wheels)[which]
        return Score(
            int(which.sum()),
            float(np.median(self.distance[which])),
            float(np.median(self.angle[which])),
            float(np.quantile(self.distance[which], 0.9)),
            float(np.quantile(self.angle[which], 0.9)),
            float(np.median(off)),
        )
