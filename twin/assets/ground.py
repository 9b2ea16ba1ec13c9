"""Ground height field, fitted to rendered depth, sparse points and the camera path.

A height datum is a height z ± σ measured at (x, y). There are three kinds: `field` (from rendered pixels on near-level
surfaces), `points` (from structure from motion) and `path` (camera centers lowered by the camera height).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from twin.assets.views import Views
from twin.config import MeshConfig
from twin.files import check_shapes, load_arrays, wrap_read_errors
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.passes import path_inliers, source_frames
from twin.types import Array


@dataclass(frozen=True)
class Ground:
    """Heights z [m] on a regular grid; node (row, column) is at `origin + cell · (column, row)`."""

    height: NDArray[np.float64]  # shape (rows along y, columns along x) [m], without holes
    origin: NDArray[np.float64]  # x, y of node (0, 0) [m], shape (2,)
    cell: float  # grid spacing [m]
    measured: NDArray[np.bool_]  # false where the height is extrapolated, shape as `height`
    rgb: NDArray[np.uint8]  # mean color of the ground around each node, shape (rows, columns, 3)

    def at(self, xy: NDArray) -> NDArray[np.float64]:
        """Bilinear height [m] at points (..., 2), clamped to the edge."""
        return _interpolate(self.height, self.origin, self.cell, xy, order=1)

    def extremes(self, low: Array, high: Array) -> tuple[float, float]:
        """Lowest and highest height [m] between two corners (x, y), each of shape (2,) [m]."""
        size = self.height.shape[::-1]
        first = np.clip(np.floor((low - self.origin) / self.cell).astype(int), 0, np.array(size) - 1)
        last = np.clip(np.ceil((high - self.origin) / self.cell).astype(int), 0, np.array(size) - 1)
        part = self.height[first[1] : last[1] + 1, first[0] : last[0] + 1]
        return float(part.min()), float(part.max())

    def coarsened(self, cell: float) -> "Ground":
        """Ground with every n-th node, n = cell / self.cell, rounded. Nodes after the last n-th one are cut off."""
        n = max(1, round(cell / self.cell))
        rows, columns = ((size - 1) // n * n + 1 for size in self.height.shape)
        nodes = np.s_[:rows:n, :columns:n]
        return Ground(self.height[nodes], self.origin, self.cell * n, self.measured[nodes], self.rgb[nodes])

    def triangles(self, cell: float, max_faces: int) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (v, 3) [m] and upward faces (f, 3) about `cell` [m] wide, or wider where `max_faces` demands it."""
        rows, columns = self.height.shape
        step = max(1, round(cell / self.cell), int(np.ceil(np.sqrt(2 * rows * columns / max_faces))))
        row, column = (np.unique(np.append(np.arange(0, n, step), n - 1)) for n in (rows, columns))
        grid_c, grid_r = np.meshgrid(column, row)
        xy = self.origin + self.cell * np.stack([grid_c, grid_r], -1)
        vertices = np.concatenate([xy, self.height[grid_r, grid_c][..., None]], -1).reshape(-1, 3)
        return vertices, lattice_faces(*grid_r.shape)

    def save(self, folder: Path) -> None:
        """Writes `ground.npz`."""
        np.savez(folder / "ground.npz", **vars(self))

    @staticmethod
    def load(folder: Path) -> "Ground":
        """Reads `ground.npz`. Raises InputError if it is missing or damaged."""
        path = folder / "ground.npz"
        with wrap_read_errors(path, "build the scene again"):
            data = load_arrays(path)
            ground = Ground(data["height"], data["origin"], float(data["cell"]), data["measured"], data["rgb"])
            rows, columns = size = ground.height.shape
            shapes = {"height": (size, "f"), "origin": ((2,), "f"), "measured": (size, "b"), "rgb": ((*size, 3), "u")}
            check_shapes({name: (getattr(ground, name), *shape) for name, shape in shapes.items()})
            if not (0.0 < ground.cell < np.inf and np.isfinite(ground.height).all() and rows * columns):
                raise ValueError(f"cell = {ground.cell} m; expected > 0, and one or more heights, all finite")
        return ground


def lattice_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Triangles (f, 3) over a lattice of vertices numbered row by row; they face up if rows are along y, columns x."""
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _interpolate(height: Array, origin: Array, cell: float, xy: Array, order: int) -> Array:
    """Spline interpolation of a grid of heights at points (..., 2), clamped to the edge."""
    column_row = (np.asarray(xy) - origin) / cell
    at = np.moveaxis(column_row[..., ::-1], -1, 0).reshape(2, -1)
    return map_coordinates(height, at, order=order, mode="nearest").reshape(np.shape(xy)[:-1])


# ---- height data

DATA_KINDS = ("field", "points", "path")
_MIN_UPRIGHT = 0.94  # least z of a unit normal (20° from vertical); steeper surfaces are not ground
_GATE, _GATE_PER_METER = 0.25, 0.05  # [m, m/m] largest height difference from the path; its growth with distance
_SIGMA_FIELD = 0.03  # [m] σ of the median of a cell's rendered heights, near the lens
_SIGMA_POINTS = 0.04  # [m] σ of the median height of a cell's sparse points
_SIGMA_PATH = 0.012  # [m] σ of path data if the camera is rigidly mounted
_LATERAL_OFFSETS = (-0.6, -0.3, 0.0, 0.3, 0.6)  # [m] positions of data beside the path, where the wheels drove
_CROSS_SLOPE = 0.02  # [m/m] possible cross slope of a road, which the path does not measure
_DATA_CELL = 0.25  # [m] side of the squares with one datum each
_BIAS_REACH = 0.8  # [m] greatest distance of data from the path data with which their heights are compared
_MAX_DEPTH = 18.0  # [m] deeper pixels are not used: the ground there fills only a few pixel rows


@dataclass(frozen=True)
class HeightData:
    """k height data."""

    xyz: Array  # shape (k, 3) [m]
    sigma: Array  # shape (k,) [m]
    kind: NDArray[np.int8]  # index into `DATA_KINDS`, shape (k,)

    @staticmethod
    def join(parts: Sequence["HeightData"]) -> "HeightData":
        every = (HeightData(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int8)), *parts)
        return HeightData(*(np.concatenate([getattr(p, name) for p in every]) for name in ("xyz", "sigma", "kind")))


def cell_medians(xyz: Array, sigma: Array, cell: float, kind: int) -> HeightData:
    """One datum per occupied square of side `cell` [m]: mean x and y and median z of its n points.

    Its σ is (1 + 1/n) times the smallest σ of the points: it is never smaller, since errors of neighbors correlate.
    """
    if len(xyz) == 0:
        return HeightData.join([])
    key = np.floor(xyz[:, :2] / cell).astype(np.int64)
    key -= key.min(0)
    flat = key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]
    order = np.lexsort((xyz[:, 2], flat))
    flat, xyz, sigma = flat[order], xyz[order], sigma[order]
    first = np.flatnonzero(np.diff(flat, prepend=-1))
    count = np.diff(np.append(first, len(flat)))
    xy = np.add.reduceat(xyz[:, :2], first, axis=0) / count[:, None]
    smallest = np.minimum.reduceat(sigma, first) * (1.0 + 1.0 / count)
    median = xyz[first + count // 2, 2]
    return HeightData(np.column_stack([xy, median]), smallest, np.full(len(first), kind, np.int8))


def _field_data(views: Views) -> tuple[HeightData, Array, NDArray[np.uint8]]:
    """Returns one datum per cell, from near-level rendered pixels, and the points and colors (k, 3) of these pixels."""
    points, sigmas, colors = [], [], []
    for i in range(len(views)):
        depth = views.depth[i]
        keep = (depth > 0) & (depth < _MAX_DEPTH) & (views.upward[i] > _MIN_UPRIGHT)
        points.append(views.points(i)[keep])
        # A depth error of 2 % causes a height error of 2 % · depth · slant.
        sigmas.append(np.hypot(_SIGMA_FIELD, 0.02 * depth[keep] * views.slant[i][keep]))
        colors.append(views.rgb[i][keep])
    xyz = np.concatenate(points)
    return cell_medians(xyz, np.concatenate(sigmas), _DATA_CELL, 0), xyz, np.concatenate(colors)


def _path_data(
    cameras: Cameras, ground_height: Array | None, camera_height: float
) -> tuple[HeightData, dict[str, dict]]:
    """Data from the camera path, lowered by the camera height. Their σ includes the up-and-down motion of the camera.

    `ground_height` (n,) [m] is that below each camera, from the other kinds of data, None if unknown; `camera_height`
    [m] is the given one, 0 for each source's median height above `ground_height`.
    """
    parts, metrics = [], {}
    for index in source_frames(cameras):
        index = index[path_inliers(cameras.positions[index])]
        position = cameras.positions[index]
        above = position[:, 2] - (ground_height[index] if ground_height is not None else 0.0)
        height = camera_height if camera_height > 0 else float(np.median(above))
        z = position[:, 2] - height
        level = gaussian_filter1d(z, 2.0, mode="nearest") if len(z) > 4 else z
        rapid = 1.4826 * float(np.median(np.abs(z - level)))
        slow = 0.0
        if ground_height is not None and len(z) > 4:
            drift = gaussian_filter1d(above, 4.0, mode="nearest")
            slow = 1.4826 * float(np.median(np.abs(drift - np.median(drift))))
        # The other kinds of data vary by about 3 cm; any further slow variation is attributed to the camera.
        sigma = float(np.sqrt(_SIGMA_PATH**2 + rapid**2 + max(0.0, slow**2 - 0.03**2)))
        own = {"camera_height_m": height, "rapid_m": rapid, "slow_m": slow, "sigma_m": sigma}
        metrics[cameras.sources[index[0]]] = own
        if len(index) >= 2:
            parts.append(_path_strip(np.column_stack([position[:, :2], z]), sigma))
    return HeightData.join(parts), metrics


def _path_strip(xyz: Array, sigma: float) -> HeightData:
    """Data on the path and beside it, about every 0.25 m; none across gaps in the film."""
    step = np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1)
    typical = np.median(step[step > 0.02]) if (step > 0.02).any() else 0.0
    points, sigmas = [], []
    for a, b, length in zip(xyz[:-1], xyz[1:], step, strict=True):
        if not 0.02 < length <= 4.0 * typical:
            continue
        along = (b - a)[:2] / length
        left = np.array([-along[1], along[0]])
        count = max(1, round(length / _DATA_CELL))
        for fraction in (np.arange(count) + 0.5) / count:
            for offset in _LATERAL_OFFSETS:
                points.append(np.append((a + fraction * (b - a))[:2] + offset * left, a[2] + fraction * (b - a)[2]))
                sigmas.append(np.hypot(sigma, _CROSS_SLOPE * abs(offset)))
    return HeightData(np.array(points).reshape(-1, 3), np.array(sigmas), np.full(len(points), 2, np.int8))


def bias_to_path(data: HeightData, path: HeightData) -> float:
    """Median height [m] of data above their nearest path data, `_BIAS_REACH` away at most; 0 for under ten pairs."""
    if len(path.xyz) == 0 or len(data.xyz) == 0:
        return 0.0
    away, nearest = cKDTree(path.xyz[:, :2]).query(data.xyz[:, :2], distance_upper_bound=_BIAS_REACH)
    paired = np.isfinite(away)
    return float(np.median(data.xyz[paired, 2] - path.xyz[nearest[paired], 2])) if paired.sum() >= 10 else 0.0


# ---- fit

_COARSE_CELL = 0.5  # [m]
# Largest numbers of nodes of the two grids; for more, cells grow, or only nodes near a given line are fitted.
_COARSE_NODES, _FINE_NODES = 40_000, 200_000
_BESIDE_LINE = 2.0  # [m] width of the ground that is fitted beyond `MeshConfig.margin` beside a long line
_MAX_CELLS = 3_000_000
_SMOOTHING_LENGTH = 0.5  # [m] structures shorter than this are smoothed away as noise
_EXTRAPOLATION_LENGTH = 8.0  # [m] distance over which a slope continues without data
_REWEIGHTINGS = 6
_COLOR_WIDTHS = (0.1, 0.4, 1.6, 6.4)  # [m] σ of the Gaussian windows over which colors are averaged
_COLOR_WEIGHT = 0.1  # a mean counts in full if at least this share of its window has colors
_MIN_DATA = 50  # with fewer data the ground is flat


@dataclass(frozen=True)
class HeightGrid:
    """Grid of nodes at origin + cell · (column, row) [m]."""

    origin: Array
    cell: float
    rows: int
    columns: int
    fitted: NDArray[np.bool_] | None = None
    """Mask (rows, columns) of the nodes that `fit_height` fits; the others get the height of the nearest of these.
    None: all."""

    @staticmethod
    def covering(
        low: Array, high: Array, cell: float, max_nodes: int, line: Array | None = None, reach: float = 0.0
    ) -> "HeightGrid":
        """A grid over the box from `low` to `high` (x, y).

        If there would be more than `max_nodes`, only those within `reach` [m] of `line` (m, 2) are fitted, or the cell
        grows if there is no line.
        """
        if line is not None and np.prod((high - low) / cell) > max_nodes:
            full = HeightGrid.covering(low, high, cell, np.iinfo(np.int64).max)
            away = np.ones((full.rows, full.columns), bool)
            index, inside = full.index(line)
            away.ravel()[index[inside]] = False
            return replace(full, fitted=distance_transform_edt(away) * cell < reach)
        cell = max(cell, float(np.sqrt(np.prod(high - low) / max_nodes)))
        columns, rows = (int(n) for n in np.ceil((high - low) / cell).astype(int) + 1)
        return HeightGrid(np.asarray(low, float), cell, rows, columns)

    def index(self, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Flat index (k,) of the node nearest to each point (k, 2), and a mask (k,) of those inside the grid."""
        column, row = np.rint((xy - self.origin) / self.cell).astype(int).T
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return row * self.columns + column, inside

    def numbers(self) -> NDArray[np.int64]:
        """Consecutive numbers of the fitted nodes, −1 for the others, shape (rows, columns)."""
        fitted = np.ones((self.rows, self.columns), bool) if self.fitted is None else self.fitted
        return np.where(fitted, np.cumsum(fitted).reshape(fitted.shape) - 1, -1)

    def nodes(self) -> Array:
        """Positions x, y of the nodes [m], shape (rows, columns, 2)."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.origin + self.cell * np.stack([x, y], -1)

    def sample(self, height: Array, xy: Array, order: int = 1) -> Array:
        """Heights [m] at points (..., 2), by splines through the nodes' (rows, columns); clamped to the edge."""
        return _interpolate(height, self.origin, self.cell, xy, order)


def fit_height(
    data: HeightData, grid: HeightGrid, initial: Array | None = None, iterations: int = _REWEIGHTINGS
) -> tuple[Array, Array]:
    """Robust fit of a smooth height field h, which minimizes

        Σ ρ((h(xᵢ, yᵢ) − zᵢ) / σᵢ) + λ Σ |second differences of h|² + μ Σ |first differences of h|²

    where ρ is the Geman-McClure loss. The method is iteratively reweighted least squares with sparse factorization. The
    second term smooths bumps but not slopes; the last one limits how far a slope continues without data.

    At least one datum must be at a fitted node. If heights `initial` (rows, columns) [m] are given, the first robust
    weights are computed from them; otherwise the first robust weights are all 1. Returns heights (rows, columns) [m],
    and the final robust weight of each datum in [0, 1], shape (k,).
    """
    index, inside = grid.index(data.xyz[:, :2])
    number = grid.numbers()
    inside[inside] = number.ravel()[index[inside]] >= 0
    node, z, sigma = number.ravel()[index[inside]], data.xyz[inside, 2], data.sigma[inside]
    count = int(number.max()) + 1
    smooth = _smoothness_matrix(grid)
    height = None if initial is None else initial[number >= 0]
    robust = np.ones(len(z))
    for iteration in range(iterations):
        if height is not None:
            # The width of the loss shrinks from 2.5 σ to 2 σ, so that a poor first solution does not reject good data.
            width = (max(3.0 - iteration / 2, 2.0) if initial is None else 2.0) * sigma
            robust = (1.0 + ((height[node] - z) / width) ** 2) ** -2
        weight = robust / sigma**2
        system = (smooth + sparse.diags_array(np.bincount(node, weight, count))).tocsc()
        # As the matrix is symmetric positive definite, no pivoting and an ordering of Aᵀ + A make this 4 times as fast.
        factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        height = factors.solve(np.bincount(node, weight * z, count))
    assert height is not None
    weights = np.zeros(len(inside))
    weights[inside] = robust
    nearest = distance_transform_edt(number < 0, return_distances=False, return_indices=True)
    return height[number[tuple(nearest)]], weights


_STENCILS = {  # differences as (row, column, factor) of the nodes
    "xx": ((0, 0, 1.0), (0, 1, -2.0), (0, 2, 1.0)),
    "yy": ((0, 0, 1.0), (1, 0, -2.0), (2, 0, 1.0)),
    "xy": ((0, 0, 1.0), (0, 1, -1.0), (1, 0, -1.0), (1, 1, 1.0)),
    "x": ((0, 0, -1.0), (0, 1, 1.0)),
    "y": ((0, 0, -1.0), (1, 0, 1.0)),
}


def _smoothness_matrix(grid: HeightGrid) -> sparse.csr_array:
    """λ D₂ᵀD₂ + μ D₁ᵀD₁ on the fitted nodes. A bump of length `_SMOOTHING_LENGTH` weighs like a datum of σ = 3 cm."""
    number = np.pad(grid.numbers(), (0, 2), constant_values=-1)
    row, column = np.nonzero(number >= 0)
    squares = {}
    for name, stencil in _STENCILS.items():
        nodes = np.stack([number[row + down, column + right] for down, right, _ in stencil], 1)
        nodes = nodes[(nodes >= 0).all(1)]
        factors = np.tile([factor for _, _, factor in stencil], len(nodes))
        starts = np.arange(len(nodes) + 1) * len(stencil)
        difference = sparse.csr_array((factors, nodes.ravel(), starts), shape=(len(nodes), len(row)))
        squares[name] = difference.T @ difference
    bend = max(_SMOOTHING_LENGTH / grid.cell, 0.5) ** 4 / _SIGMA_FIELD**2
    flat = bend * (grid.cell / _EXTRAPOLATION_LENGTH) ** 2
    second = squares["xx"] + squares["yy"] + 2.0 * squares["xy"]
    return (bend * second + flat * (squares["x"] + squares["y"])).tocsr()


def fit_low_passed(
    data: HeightData, low: Array, high: Array, config: MeshConfig, line: Array | None = None
) -> tuple[Array, HeightGrid, Array]:
    """Fits heights over the box from `low` to `high` (x, y), coarse to fine; low-passes them by `ground_smoothing`.

    For `line` see `build_ground`.

    Returns heights [m] on a grid of `ground_cell`, the grid, and the weight of each datum.
    """
    grid = HeightGrid.covering(low, high, config.ground_cell, _MAX_CELLS)
    if len(data.xyz) < _MIN_DATA:
        surface, weights = np.zeros((grid.rows, grid.columns)), np.zeros(len(data.xyz))
    else:
        reach = config.margin + _BESIDE_LINE
        coarse = HeightGrid.covering(low, high, _COARSE_CELL, _COARSE_NODES, line, reach)
        height, _ = fit_height(data, coarse)
        fine = HeightGrid.covering(low, high, max(0.25, config.ground_cell), _FINE_NODES, line, reach)
        height, weights = fit_height(data, fine, coarse.sample(height, fine.nodes(), order=3), iterations=1)
        surface = fine.sample(height, grid.nodes(), order=3)
    return gaussian_filter(surface, config.ground_smoothing / grid.cell, mode="nearest"), grid, weights


def build_ground(
    views: Views,
    cameras: Cameras,
    points: SparsePoints,
    box: tuple[Array, Array],
    config: MeshConfig,
    height: float | None,
    line: Array | None = None,
) -> tuple[Ground, dict[str, Any]]:
    """Fits the ground over a box, given by its low and high corners (x, y) [m]. Also returns metrics for the report.

    `height` is the given height of the camera [m]; 0 = estimate it per source; None = do not use the path (because the
    film goes around an object). If the box is large, only the ground near `line`, the route (m, 2) [m], is fitted.
    """
    low, high = box
    coarse = HeightGrid.covering(low, high, _COARSE_CELL, _COARSE_NODES, line, config.margin + _BESIDE_LINE)
    path, path_metrics = _path_data(cameras, None, height) if height is not None else (HeightData.join([]), {})
    level = fit_height(path, coarse, iterations=1)[0] if len(path.xyz) else np.zeros((coarse.rows, coarse.columns))
    tree = cKDTree(path.xyz[:, :2]) if len(path.xyz) else None
    field, pixels, colors = _field_data(views)
    good = (points.track_length >= 3) & (points.error < 2.0)
    sparse_points = cell_medians(points.xyz[good], np.full(good.sum(), _SIGMA_POINTS), _DATA_CELL, 1)
    visible = []
    for data in (field, sparse_points):
        away = tree.query(data.xyz[:, :2])[0] if tree is not None else np.zeros(len(data.xyz))
        # Rejects the many points on obstacles, whose heights differ from the level of the path.
        gap = np.abs(data.xyz[:, 2] - coarse.sample(level, data.xyz[:, :2]))
        keep = gap < _GATE + _GATE_PER_METER * away
        visible.append(HeightData(data.xyz[keep], data.sigma[keep], data.kind[keep]))
    bias = [0.0, 0.0]
    if height is not None and sum(len(data.xyz) for data in visible) >= _MIN_DATA:
        below = coarse.sample(fit_height(HeightData.join(visible), coarse)[0], cameras.positions[:, :2])
        path, path_metrics = _path_data(cameras, below, height)
        # Blurred depth or a tilted reconstruction offsets all data of a kind, which would cause a step beside the path.
        bias = [bias_to_path(data, path) for data in visible]
        visible = [replace(d, xyz=d.xyz - [0.0, 0.0, b]) for d, b in zip(visible, bias, strict=True)]
    data = HeightData.join([*visible, path])
    surface, grid, weights = fit_low_passed(data, low, high, config, line)
    used = data.xyz[weights > 0.25, :2]
    measured = np.zeros((grid.rows, grid.columns), bool)
    node, inside = grid.index(used)
    measured.ravel()[node[inside]] = True
    # Data are 0.25 m apart; the cells between them count as measured.
    measured = binary_closing(np.pad(measured, 8), iterations=max(1, round(0.3 / grid.cell)))[8:-8, 8:-8]
    on_ground = np.abs(grid.sample(surface, pixels[:, :2]) - pixels[:, 2]) < 0.15
    ground = Ground(surface, grid.origin, grid.cell, measured, _mean_colors(grid, pixels[on_ground], colors[on_ground]))
    error = np.abs(ground.at(data.xyz[:, :2]) - data.xyz[:, 2])
    metrics: dict[str, Any] = {
        "fitted": len(data.xyz) >= _MIN_DATA,
        "cell_m": grid.cell,
        "coverage": float(measured.mean()),
        "path": path_metrics,
        "bias_m": dict(zip(DATA_KINDS, bias, strict=False)),
    }
    for i, kind in enumerate(DATA_KINDS):
        own = data.kind == i
        metrics[f"{kind}_data"] = int(own.sum())
        metrics[f"{kind}_residual_m"] = float(np.median(error[own])) if own.any() else None
    return ground, metrics


def _mean_colors(grid: HeightGrid, points: Array, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mean color per cell. A cell with few pixels around it gets a mean over a wider window."""
    node, inside = grid.index(points[:, :2])
    count = np.bincount(node[inside], minlength=grid.rows * grid.columns)
    if not count.any():
        return np.full((grid.rows, grid.columns, 3), 128, np.uint8)
    sums = np.stack([np.bincount(node[inside], rgb[inside, k], len(count)) for k in range(3)], -1)
    mean: Array = (sums / np.maximum(count, 1)[:, None]).reshape(grid.rows, grid.columns, 3)
    seen = (count > 0).reshape(grid.rows, grid.columns).astype(np.float64)
    colors: Array = np.empty_like(mean)
    colors[:] = mean[seen > 0].mean(0)
    for width in reversed(_COLOR_WIDTHS):
        sigma = width / grid.cell
        weight = gaussian_filter(seen, sigma, mode="constant")
        near = gaussian_filter(mean, (sigma, sigma, 0.0), mode="constant") / np.maximum(weight, 1e-12)[..., None]
        share = np.clip(weight / _COLOR_WEIGHT, 0.0, 1.0)[..., None]
        colors += share * (near - colors)
    return np.clip(colors + 0.5, 0, 255).astype(np.uint8)
