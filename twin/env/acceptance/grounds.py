"""Ground to judge the Husky on: what the pipeline makes of a road whose true shape is known, and how rough it is.

*Relief*: true height [m] of points (k, 2). *Reconstructed*: noisy data of the relief, fitted and low-passed by
`twin.assets.ground_fit` as in a build. *Correlation length*: the distance over which the autocorrelation of the heights
along x falls to 1/e.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from twin.assets.ground import Ground
from twin.assets.ground_fit import KINDS, Data, low_passed
from twin.config import MeshConfig

Array = NDArray[np.float64]

_SPACING = 0.25  # [m] between data, as `ground_fit` thins them
_FIELD_NOISE, _PATH_NOISE = (
    0.03,
    0.012,
)  # [m] of a rendered height and of a steady camera's, as `ground_fit` weighs them
_BESIDE = np.array([-0.6, -0.3, 0.0, 0.3, 0.6])  # [m] of the path


def level(height: float = 0.0, half: float = 8.0, cell: float = 0.1) -> Ground:
    """Exactly level ground around the origin, `half` [m] to each side."""
    n = round(2 * half / cell) + 1
    return _grey(np.full((n, n), height), np.array([-half, -half]), cell)


def random_relief(rms: float, length: float, rng: np.random.Generator, half: float = 9.0) -> Callable[[Array], Array]:
    """Isotropic Gaussian bumps of an rms [m] and a length [m] (σ of the kernel), around the origin."""
    cell = length / 4
    n = round(2 * half / cell) + 1
    height = gaussian_filter(rng.normal(size=(n, n)), length / cell)
    bumps = _grey(height * rms / height.std(), np.array([-half, -half]), cell)
    return bumps.at


def reconstructed(
    rng: np.random.Generator, relief: Callable[[Array], Array] | None = None, size: tuple[float, float] = (8.0, 4.0)
) -> Ground:
    """A road along x, `size` [m] to each side of the origin, as the mesh stage would find it. Level by default."""
    relief = relief or (lambda xy: np.zeros(len(xy)))
    high = np.array(size)
    x, y = (np.arange(-h + _SPACING / 2, h, _SPACING) for h in size)
    field = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    # A hand's wavering moves what is beside the path along with it.
    waver = np.repeat(rng.normal(0.0, _PATH_NOISE, len(x)), len(_BESIDE))
    path = np.stack(np.meshgrid(x, _BESIDE, indexing="ij"), -1).reshape(-1, 2)
    data = Data.join(
        [
            _data(field, relief(field) + rng.normal(0.0, _FIELD_NOISE, len(field)), _FIELD_NOISE, "field"),
            _data(path, relief(path) + waver, _PATH_NOISE, "path"),
        ]
    )
    height, grid, _ = low_passed(data, -high, high, MeshConfig())
    return _grey(height, grid.origin, grid.cell)


def roughness(ground: Ground, line: Array) -> tuple[float, float]:
    """Rms [m] and correlation length [m] of the heights along a polyline (m, ≥2), its slow rise taken out.

    The rise is a straight line per 8 m, which is far longer than a robot.
    """
    step = ground.cell / 2
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    s = np.arange(0.0, length[-1], step)
    z = ground.at(np.stack([np.interp(s, length, line[:, k]) for k in (0, 1)], 1))
    window = min(len(z), round(8.0 / step))
    parts = []
    for start in range(0, len(z) - window + 1, window):
        at = s[start : start + window]
        parts.append(z[start : start + window] - np.polyval(np.polyfit(at, z[start : start + window], 1), at))
    rest = np.array(parts)
    variance = float((rest**2).mean())
    for lag in range(1, window // 2):
        if (rest[:, lag:] * rest[:, :-lag]).mean() < variance / np.e:
            return float(np.sqrt(variance)), lag * step
    return float(np.sqrt(variance)), window // 2 * step


def _data(xy: Array, z: Array, sigma: float, kind: str) -> Data:
    return Data(np.column_stack([xy, z]), np.full(len(xy), sigma), np.full(len(xy), KINDS.index(kind), np.int8))


def _grey(height: Array, origin: Array, cell: float) -> Ground:
    return Ground(height, origin, cell, np.ones(height.shape, bool), np.full((*height.shape, 3), 90, np.uint8))
