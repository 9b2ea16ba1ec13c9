"""The ground as a height field: a regular grid of heights over the xy plane."""

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
from twin.files import check_shapes, damaged, load_arrays
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.route import path_inliers, source_frames
from twin.types import Array


@dataclass(frozen=True)
class Ground:
    """Height z [m] at `origin + cell · (column, row)`."""

    height: NDArray[np.float64]
    """Shape (rows along y, columns along x) [m]; no holes."""
    origin: NDArray[np.float64]
    """x, y of cell (0, 0) [m], shape (2,)."""
    cell: float
    """Grid spacing [m]."""
    measured: NDArray[np.bool_]
    """False where the height was filled in rather than seen, shape as `height`."""
    rgb: NDArray[np.uint8]
    """Mean colour, shape (rows, columns, 3)."""

    def at(self, xy: NDArray) -> NDArray[np.float64]:
        """Bilinear height [m] at points (..., 2); beyond the edge, that of the edge."""
        column_row = (np.asarray(xy) - self.origin) / self.cell
        return map_coordinates(
            self.height, np.moveaxis(column_row[..., ::-1], -1, 0).reshape(2, -1), order=1, mode="nearest"
        ).reshape(np.shape(xy)[:-1])

    def coarsened(self, cell: float) -> "Ground":
        """Every n-th node, n = cell / own cell rounded; what is left over at the far edges is cut off."""
        n = max(1, round(cell / self.cell))
        rows, columns = ((size - 1) // n * n + 1 for size in self.height.shape)
        nodes = np.s_[:rows:n, :columns:n]
        return Ground(self.height[nodes], self.origin, self.cell * n, self.measured[nodes], self.rgb[nodes])

    def save(self, folder: Path) -> None:
        """Writes `ground.npz`."""
        np.savez(folder / "ground.npz", **vars(self))

    @staticmethod
    def load(folder: Path) -> "Ground":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / "ground.npz"
        with damaged(path, "build the scene again"):
            data = load_arrays(path)
            ground = Ground(data["height"], data["origin"], float(data["cell"]), data["measured"], data["rgb"])
            rows, columns = ground.height.shape
            check_shapes(
                {
                    "height": (ground.height, (rows, columns), "f"),
                    "origin": (ground.origin, (2,), "f"),
                    "measured": (ground.measured, (rows, columns), "b"),
                    "rgb": (ground.rgb, (rows, columns, 3), "u"),
                }
            )
            if not (0.0 < ground.cell < np.inf and np.isfinite(ground.height).all() and rows * columns):
                raise ValueError(f"cell = {ground.cell}, or heights that are not finite")
        return ground


# ---- The ground from what there is: rendered depth, sparse points, and the path of a camera carried over it.
#
# A *datum* is a measured height z ± σ at (x, y). Three kinds: `field` (rendered pixels on near-level surface), `points`
# (structure from motion) and `path` (camera centre minus the camera's height). The fit is the surface h that minimises
#
#     Σ ρ((h(xᵢ, yᵢ) − zᵢ) / σᵢ) + λ Σ |second differences of h|² + μ Σ |first differences of h|²,
#
# ρ = Geman-McClure by iterated reweighting: the second differences keep slopes and remove bumps, the first ones only
# decide how far a slope goes on where nothing was seen. Solved by sparse factorisation, reweighted on coarse nodes, then
# once on fine ones.


KINDS = ("field", "points", "path")
_LEVEL = 0.94  # normals this upright (20°) can be ground
_GATE, _GATE_PER_METRE = 0.25, 0.05  # [m] a datum may be this far from the path's level, more so far from the path
_SIGMA_FIELD = 0.03  # [m] of a cell's median rendered depth near the lens
_SIGMA_POINTS = 0.04  # [m] of a cell's median sparse point
_SIGMA_PATH = 0.012  # [m] of a rigidly mounted camera's path
_BESIDE_PATH = (-0.6, -0.3, 0.0, 0.3, 0.6)  # [m] wheels beside the lens: the ground there was driven on as well
_ROLL = 0.02  # cross slope of a road that the path cannot show
_COARSE_NODES, _FINE_NODES = 40_000, 200_000
_BEND_LENGTH = 0.5  # [m] what is shorter is smoothed as noise
_FLAT_LENGTH = 8.0  # [m] how far a slope is continued into the unseen
_SWEEPS = 6
_MOST_CELLS = 1_500_000
_FAR = 18.0  # [m] ground further from the lens than this is a few pixel rows
_FEW = 50  # data below which there is no ground to speak of


@dataclass(frozen=True)
class HeightData:
    """k measured heights."""

    xyz: Array
    """Shape (k, 3) [m]."""
    sigma: Array
    """Shape (k,) [m]."""
    kind: NDArray[np.int8]
    """Index into `KINDS`, shape (k,)."""

    @staticmethod
    def join(parts: list["HeightData"]) -> "HeightData":
        return HeightData(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("xyz", "sigma", "kind")))


@dataclass(frozen=True)
class HeightGrid:
    """Nodes at origin + cell · (column, row)."""

    origin: Array
    cell: float
    rows: int
    columns: int

    @staticmethod
    def covering(low: Array, high: Array, cell: float, most: int) -> "HeightGrid":
        """Nodes over the box from `low` to `high` (x, y), `most` nodes at most: the cell grows if it must."""
        cell = max(cell, float(np.sqrt(np.prod(high - low) / most)))
        columns, rows = (int(n) for n in np.ceil((high - low) / cell).astype(int) + 1)
        return HeightGrid(np.asarray(low, float), cell, rows, columns)

    def index(self, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Flat index of the nearest node, and whether there is one, of points (k, 2)."""
        column, row = np.rint((xy - self.origin) / self.cell).astype(int).T
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return row * self.columns + column, inside

    def nodes(self) -> Array:
        """Shape (rows, columns, 2)."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.origin + self.cell * np.stack([x, y], -1)

    def sample(self, height: Array, xy: Array, order: int = 1) -> Array:
        """Heights at points (..., 2) of a field (rows, columns) by splines of `order`; beyond the edge, the edge's."""
        column_row = (np.asarray(xy) - self.origin) / self.cell
        at = np.moveaxis(column_row[..., ::-1], -1, 0).reshape(2, -1)
        return map_coordinates(height, at, order=order, mode="nearest").reshape(np.shape(xy)[:-1])


def fit_height(
    data: HeightData, grid: HeightGrid, start: Array | None = None, sweeps: int = _SWEEPS
) -> tuple[Array, Array]:
    """Robust height field through the data.

    Args:
        data: Measured heights, at least one inside the grid.
        grid: Where to solve.
        start: Heights to weigh the data by at first (rows, columns); None = believe all at first.
        sweeps: Reweightings.

    Returns:
        Heights (rows, columns) [m], and the final weight of each datum in [0, 1], shape (k,).
    """
    node, inside = grid.index(data.xyz[:, :2])
    node, z, sigma = node[inside], data.xyz[inside, 2], data.sigma[inside]
    count = grid.rows * grid.columns
    smooth = _smoothness(grid)
    height = None if start is None else start.ravel()
    robust = np.ones(len(z))
    for sweep in range(sweeps):
        if height is not None and (sweep or start is not None):
            # Geman-McClure, its width drawn in from 3 σ to 2 σ so that a far start is not lost.
            width = (max(3.0 - sweep / 2, 2.0) if start is None else 2.0) * sigma
            robust = (1.0 + ((height[node] - z) / width) ** 2) ** -2
        weight = robust / sigma**2
        system = (smooth + sparse.diags_array(np.bincount(node, weight, count))).tocsc()
        # Symmetric positive definite: no pivoting and an ordering of AᵀA's cheaper cousin make it four times as fast.
        factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        height = factors.solve(np.bincount(node, weight * z, count))
    assert height is not None
    weights = np.zeros(len(inside))
    weights[inside] = robust
    return height.reshape(grid.rows, grid.columns), weights


def _smoothness(grid: HeightGrid) -> sparse.csr_array:
    """λ D₂ᵀD₂ + μ D₁ᵀD₁ on the grid's nodes; λ makes structure of `_BEND_LENGTH` cost as much as σ = 3 cm."""
    rows, columns = grid.rows, grid.columns

    def difference(n: int, order: int) -> sparse.csr_array:
        stencil = [-1.0, 1.0] if order == 1 else [1.0, -2.0, 1.0]
        return sparse.diags_array(stencil, offsets=range(order + 1), shape=(n - order, n)).tocsr()

    eye_r, eye_c = sparse.eye_array(rows), sparse.eye_array(columns)
    xx = sparse.kron(eye_r, difference(columns, 2))
    yy = sparse.kron(difference(rows, 2), eye_c)
    xy = sparse.kron(difference(rows, 1), difference(columns, 1))
    x, y = sparse.kron(eye_r, difference(columns, 1)), sparse.kron(difference(rows, 1), eye_c)
    bend = max(_BEND_LENGTH / grid.cell, 0.5) ** 4 / _SIGMA_FIELD**2
    flat = bend * (grid.cell / _FLAT_LENGTH) ** 2
    return (bend * (xx.T @ xx + yy.T @ yy + 2.0 * xy.T @ xy) + flat * (x.T @ x + y.T @ y)).tocsr()


def cell_medians(xyz: Array, sigma: Array, cell: float, kind: int) -> HeightData:
    """One datum per occupied square of side `cell`: mean x and y, median z, and the σ of its best-seen member.

    No smaller σ for many members: neighbouring pixels and points err alike, so that many are no better than a few.
    """
    if len(xyz) == 0:
        return HeightData(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int8))
    key = np.floor(xyz[:, :2] / cell).astype(np.int64)
    key -= key.min(0)
    flat = key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]
    order = np.lexsort((xyz[:, 2], flat))
    flat, xyz, sigma = flat[order], xyz[order], sigma[order]
    first = np.flatnonzero(np.diff(flat, prepend=-1))
    count = np.diff(np.append(first, len(flat)))
    middle = first + count // 2
    xy = np.add.reduceat(xyz[:, :2], first, axis=0) / count[:, None]
    best = np.minimum.reduceat(sigma, first)
    # A lone pixel in a square is worth less than several that agree.
    alone = 1.0 + 1.0 / count
    return HeightData(np.column_stack([xy, xyz[middle, 2]]), best * alone, np.full(len(first), kind, np.int8))


def field_data(views: Views, cell: float, far: float) -> tuple[HeightData, Array, NDArray[np.uint8]]:
    """Near-level rendered pixels as data, one per cell, and all those pixels' points (k, 3) and colours (k, 3)."""
    points, sigmas, colours = [], [], []
    for i in range(len(views)):
        depth = views.depth[i]
        keep = (depth > 0) & (depth < far) & (views.upward[i] > _LEVEL)
        points.append(views.points(i)[keep])
        # A pixel's depth errs by a share of itself; on ground seen at a glance that is slant times less in height.
        sigmas.append(np.hypot(_SIGMA_FIELD, 0.02 * depth[keep] * views.slant[i][keep]))
        colours.append(views.rgb[i][keep])
    xyz = np.concatenate(points)
    return cell_medians(xyz, np.concatenate(sigmas), cell, 0), xyz, np.concatenate(colours)


def point_data(points: SparsePoints, cell: float) -> HeightData:
    """Sparse points seen by three frames or more, one per cell. Most stand on things; the fit's gate tells."""
    keep = (points.track_length >= 3) & (points.error < 2.0)
    return cell_medians(points.xyz[keep], np.full(keep.sum(), _SIGMA_POINTS), cell, 1)


def path_data(
    cameras: Cameras, ground_height: Array | None, camera_height: float
) -> tuple[HeightData, dict[str, dict]]:
    """The path minus the camera's height, per source, with how steadily each was carried.

    Args:
        cameras: Metric cameras.
        ground_height: Height of the ground below each camera as the other kinds see it, shape (n,) [m]; None = unknown.
        camera_height: The height that set the scale [m]; 0 = each source's own median over `ground_height`.

    Returns:
        Data, and per source: camera height used, its rapid and slow spread, and σ [m].
    """
    parts, facts = [], {}
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
        # The other kinds waver by some 3 cm themselves; only what is beyond that tells of a hand.
        sigma = float(np.sqrt(_SIGMA_PATH**2 + rapid**2 + max(0.0, slow**2 - 0.03**2)))
        facts[cameras.sources[index[0]]] = {
            "camera_height_m": height,
            "rapid_m": rapid,
            "slow_m": slow,
            "sigma_m": sigma,
        }
        if len(index) < 2:
            continue
        parts.append(_strip(np.column_stack([position[:, :2], z]), sigma))
    empty = HeightData(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int8))
    return (HeightData.join(parts) if parts else empty), facts


def _strip(xyz: Array, sigma: float) -> HeightData:
    """Points along the path and beside it, about every 0.25 m of a drive; none across gaps in the film."""
    step = np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1)
    typical = np.median(step[step > 0.02]) if (step > 0.02).any() else 0.0
    points, sigmas = [], []
    for a, b, length in zip(xyz[:-1], xyz[1:], step, strict=True):
        if not 0.02 < length <= 4.0 * typical:
            continue
        along = (b - a)[:2] / length
        left = np.array([-along[1], along[0]])
        for share in (np.arange(max(1, round(length / 0.25))) + 0.5) / max(1, round(length / 0.25)):
            for aside in _BESIDE_PATH:
                points.append(np.append((a + share * (b - a))[:2] + aside * left, a[2] + share * (b - a)[2]))
                sigmas.append(np.hypot(sigma, _ROLL * abs(aside)))
    return HeightData(np.array(points).reshape(-1, 3), np.array(sigmas), np.full(len(points), 2, np.int8))


def near_ground(data: HeightData, level: Array, distance: Array) -> HeightData:
    """The data within the gate of a first guess `level` (k,), wider with the distance (k,) from the path."""
    keep = np.abs(data.xyz[:, 2] - level) < _GATE + _GATE_PER_METRE * distance
    return HeightData(data.xyz[keep], data.sigma[keep], data.kind[keep])


def bias_to_path(data: HeightData, path: HeightData, reach: float = 0.8) -> float:
    """Median height of data above the path's data nearby [m]; 0 where fewer than ten meet."""
    if len(path.xyz) == 0 or len(data.xyz) == 0:
        return 0.0
    away, nearest = cKDTree(path.xyz[:, :2]).query(data.xyz[:, :2], distance_upper_bound=reach)
    met = np.isfinite(away)
    return float(np.median(data.xyz[met, 2] - path.xyz[nearest[met], 2])) if met.sum() >= 10 else 0.0


def solve(data: HeightData, low: Array, high: Array, cell: float) -> tuple[Array, HeightGrid, Array]:
    """Coarse-to-fine fit over the box `low` to `high`: heights, their grid, and the weight of each datum."""
    coarse = HeightGrid.covering(low, high, 0.5, _COARSE_NODES)
    height, _ = fit_height(data, coarse)
    fine = HeightGrid.covering(low, high, max(0.25, cell), _FINE_NODES)
    height, weights = fit_height(data, fine, coarse.sample(height, fine.nodes(), order=3), sweeps=1)
    return height, fine, weights


def low_passed(data: HeightData, low: Array, high: Array, config: MeshConfig) -> tuple[Array, HeightGrid, Array]:
    """The fit at `ground_cell`, low-passed by `ground_smoothing`: heights, their grid, and the weight of each datum."""
    grid = HeightGrid.covering(low, high, config.ground_cell, _MOST_CELLS)
    if len(data.xyz) < _FEW:
        surface, weights = np.zeros((grid.rows, grid.columns)), np.zeros(len(data.xyz))
    else:
        solved, fine, weights = solve(data, low, high, grid.cell)
        surface = fine.sample(solved, grid.nodes(), order=3)
    return gaussian_filter(surface, config.ground_smoothing / grid.cell, mode="nearest"), grid, weights


def build_ground(
    views: Views,
    cameras: Cameras,
    points: SparsePoints,
    box: tuple[Array, Array],
    config: MeshConfig,
    height: float | None,
) -> tuple[Ground, dict[str, Any]]:
    """The low-passed height field over a box, and how it was found.

    Args:
        views: Renderings of the field.
        cameras: Metric cameras.
        points: Sparse points in the same frame.
        box: Low and high corner (x, y) [m].
        config: Cell and low-pass length.
        height: The camera's height above ground that set the scale [m], 0 = estimate it per source; None = the path
            says nothing about the ground (an object filmed around).

    Returns:
        The ground, and JSON-able facts.
    """
    low, high = box
    coarse = HeightGrid.covering(low, high, 0.5, _COARSE_NODES)
    nothing = HeightData(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int8))
    path, carried = path_data(cameras, None, height) if height is not None else (nothing, {})
    level = fit_height(path, coarse, sweeps=1)[0] if len(path.xyz) else np.zeros((coarse.rows, coarse.columns))
    tree = cKDTree(path.xyz[:, :2]) if len(path.xyz) else None
    field, pixels, colours = field_data(views, 0.25, _FAR)
    seen = []
    for data in (field, point_data(points, 0.25)):
        away = tree.query(data.xyz[:, :2])[0] if tree is not None else np.zeros(len(data.xyz))
        seen.append(near_ground(data, coarse.sample(level, data.xyz[:, :2]), away))
    bias = [0.0, 0.0]
    if height is not None and sum(len(data.xyz) for data in seen) >= _FEW:
        below = coarse.sample(fit_height(HeightData.join(seen), coarse)[0], cameras.positions[:, :2])
        path, carried = path_data(cameras, below, height)
        # Each kind errs in height as a whole (blurred depth, a tilted scale); beside the path that must leave no step.
        bias = [bias_to_path(data, path) for data in seen]
        seen = [replace(d, xyz=d.xyz - [0.0, 0.0, b]) for d, b in zip(seen, bias, strict=True)]
    data = HeightData.join([*seen, path])
    surface, grid, weights = low_passed(data, low, high, config)
    used = data.xyz[weights > 0.25, :2]
    measured = np.zeros((grid.rows, grid.columns), bool)
    node, inside = grid.index(used)
    measured.ravel()[node[inside]] = True
    # Data sit 0.25 m apart; cells between them are measured, too.
    measured = binary_closing(np.pad(measured, 8), iterations=max(1, round(0.3 / grid.cell)))[8:-8, 8:-8]
    on_ground = np.abs(grid.sample(surface, pixels[:, :2]) - pixels[:, 2]) < 0.15
    ground = Ground(surface, grid.origin, grid.cell, measured, _colours(grid, pixels[on_ground], colours[on_ground]))
    error = np.abs(ground.at(data.xyz[:, :2]) - data.xyz[:, 2])
    facts: dict[str, Any] = {
        "fitted": len(data.xyz) >= _FEW,
        "cell_m": grid.cell,
        "coverage": float(measured.mean()),
        "path": carried,
        "bias_m": dict(zip(KINDS, bias, strict=False)),
    }
    for i, kind in enumerate(KINDS):
        of = data.kind == i
        facts[f"{kind}_data"] = int(of.sum())
        facts[f"{kind}_residual_m"] = float(np.median(error[of])) if of.any() else None
    return ground, facts


def _colours(grid: HeightGrid, points: Array, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mean colour per cell; cells without a pixel take that of the nearest one that has."""
    node, inside = grid.index(points[:, :2])
    count = np.bincount(node[inside], minlength=grid.rows * grid.columns)
    mean = np.stack(
        [np.bincount(node[inside], rgb[inside, k], len(count)) / np.maximum(count, 1) for k in range(3)], -1
    )
    if not count.any():
        return np.full((grid.rows, grid.columns, 3), 128, np.uint8)
    nearest = distance_transform_edt(
        (count == 0).reshape(grid.rows, grid.columns), return_distances=False, return_indices=True
    )
    filled = mean.reshape(grid.rows, grid.columns, 3)[tuple(nearest)]
    return (gaussian_filter(filled, (1.0, 1.0, 0.0)) + 0.5).astype(np.uint8)
