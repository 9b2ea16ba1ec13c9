"""Grounds for tests (level, random relief, or fitted by the pipeline to noisy data), and a measure of roughness."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

from twin.assets.ground import DATA_KINDS, Ground, HeightData, fit_low_passed
from twin.config import MeshConfig
from twin.types import Array

_SPACING = 0.25  # [m] between data points, as in `twin.assets.ground`
_FIELD_NOISE, _PATH_NOISE = 0.03, 0.012  # [m] σ of heights from the field and from the camera path, as there
_LATERAL_OFFSETS = np.array([-0.6, -0.3, 0.0, 0.3, 0.6])  # [m] from the path


def level(half: float = 8.0) -> Ground:
    """Level ground around the origin, `half` [m] to each side, in cells of 0.1 m."""
    n = round(2 * half / 0.1) + 1
    return _gray(np.zeros((n, n)), np.array([-half, -half]), 0.1)


def random_relief(rms: float, length: float, rng: np.random.Generator, half: float = 9.0) -> Callable[[Array], Array]:
    """Returns a random relief as a function from points (k, 2) to heights (k,) [m], up to `half` [m] from the origin.

    The relief is white noise, smoothed by a Gaussian kernel of standard deviation `length` [m] and scaled to the root
    mean square `rms` [m].
    """
    cell = length / 4
    n = round(2 * half / cell) + 1
    height = gaussian_filter(rng.normal(size=(n, n)), length / cell)
    bumps = _gray(height * rms / height.std(), np.array([-half, -half]), cell)
    return bumps.at


def reconstructed(rng: np.random.Generator, relief: Callable[[Array], Array] | None = None) -> Ground:
    """Ground that the pipeline fits to noisy data of a road along x, 16 m long and 8 m wide, around the origin.

    `relief` maps points (k, 2) to the true height [m]; level by default.
    """
    relief = relief or (lambda xy: np.zeros(len(xy)))
    high = np.array([8.0, 4.0])
    x, y = (np.arange(-h + _SPACING / 2, h, _SPACING) for h in (8.0, 4.0))
    field = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    # The sway of a hand-held camera shifts all data of a cross-section alike.
    sway = np.repeat(rng.normal(0.0, _PATH_NOISE, len(x)), len(_LATERAL_OFFSETS))
    path = np.stack(np.meshgrid(x, _LATERAL_OFFSETS, indexing="ij"), -1).reshape(-1, 2)
    data = HeightData.join(
        [
            _data(field, relief(field) + rng.normal(0.0, _FIELD_NOISE, len(field)), _FIELD_NOISE, "field"),
            _data(path, relief(path) + sway, _PATH_NOISE, "path"),
        ]
    )
    height, grid, _ = fit_low_passed(data, -high, high, MeshConfig())
    return _gray(height, grid.origin, grid.cell)


def roughness(ground: Ground, line: Array) -> tuple[float, float]:
    """Rms [m] and correlation length [m] of the heights along a polyline (m, ≥2).

    The heights are cut into windows of 8 m, and the straight line fitted to each window is subtracted. A window is much
    longer than the robot, so unevenness on the robot's scale remains.
    The correlation length is the lag at which the autocorrelation falls to 1/e.
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
    residuals = np.array(parts)
    variance = float((residuals**2).mean())
    for lag in range(1, window // 2):
        if (residuals[:, lag:] * residuals[:, :-lag]).mean() < variance / np.e:
            return float(np.sqrt(variance)), lag * step
    return float(np.sqrt(variance)), window // 2 * step


def _data(xy: Array, z: Array, sigma: float, kind: str) -> HeightData:
    kinds = np.full(len(xy), DATA_KINDS.index(kind), np.int8)
    return HeightData(np.column_stack([xy, z]), np.full(len(xy), sigma), kinds)


def _gray(height: Array, origin: Array, cell: float) -> Ground:
    return Ground(height, origin, cell, np.ones(height.shape, bool), np.full((*height.shape, 3), 90, np.uint8))
