"""The ground: interpolation between its nodes, and the fit to noisy heights."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from twin.assets.ground import Ground, HeightData, HeightGrid, bias_to_path, cell_medians, fit_height


def _ground(height):
    measured = np.random.default_rng(0).random(height.shape) < 0.5
    return Ground(height, np.array([-3.0, 2.0]), 0.25, measured, np.full((*height.shape, 3), 7, np.uint8))


def _bent(xy):
    """A bilinear function of x and y, which bilinear interpolation of a grid reproduces exactly."""
    x, y = xy[..., 0], xy[..., 1]
    return 0.3 + 0.1 * x - 0.04 * y + 0.02 * x * y


def _hills(xy):
    x, y = xy[..., 0], xy[..., 1]
    return 0.5 + 0.06 * x - 0.03 * y + 0.08 * np.sin(0.5 * x) * np.cos(0.4 * y)


def _noisy(rng, count, low, high, sigma):
    xy = rng.uniform(low, high, (count, 2))
    z = _hills(xy) + sigma * rng.standard_normal(count)
    return np.column_stack([xy, z])


def test_interpolation_is_bilinear_and_clamped_to_the_edge():
    rows, columns = 9, 14
    x, y = np.meshgrid(-3.0 + 0.25 * np.arange(columns), 2.0 + 0.25 * np.arange(rows))
    ground = _ground(_bent(np.stack([x, y], -1)))
    xy = np.random.default_rng(1).uniform([-3.0, 2.0], [0.25, 4.0], (5, 40, 2))
    np.testing.assert_allclose(ground.at(xy), _bent(xy), atol=1e-12)
    np.testing.assert_allclose(ground.at(np.array([-9.0, 3.0])), _bent(np.array([-3.0, 3.0])), atol=1e-12)
    np.testing.assert_allclose(ground.at(np.array([9.0, 9.0])), ground.height[-1, -1], atol=1e-12)


def test_save_and_load_round_trip(tmp_path: Path):
    ground = _ground(np.random.default_rng(2).standard_normal((4, 6)))
    ground.save(tmp_path)
    back = Ground.load(tmp_path)
    for name, value in vars(ground).items():
        np.testing.assert_array_equal(getattr(back, name), value)
        assert np.asarray(getattr(back, name)).dtype == np.asarray(value).dtype


def test_fit_recovers_hills_despite_noise_and_obstacles():
    rng = np.random.default_rng(3)
    low, high = np.array([-8.0, -5.0]), np.array([8.0, 5.0])
    xyz = _noisy(rng, 3000, low, high, 0.03)
    standing = rng.random(len(xyz)) < 0.15
    xyz[standing, 2] += rng.uniform(0.3, 1.5, standing.sum())
    data = HeightData(xyz, np.full(len(xyz), 0.03), np.zeros(len(xyz), np.int8))
    grid = HeightGrid.covering(low, high, 0.4, 10_000)
    height, weights = fit_height(data, grid)
    error = np.abs(height - _hills(grid.nodes()))
    assert np.median(error) < 0.01 and np.quantile(error, 0.95) < 0.03
    assert np.median(weights[~standing]) > 0.6 and weights[standing].max() < 0.1


def test_a_slope_continues_through_a_gap():
    rng = np.random.default_rng(4)
    xy = rng.uniform([-8.0, -4.0], [8.0, 4.0], (1500, 2))
    xy = xy[np.abs(xy[:, 0]) > 1.5]
    data = HeightData(np.column_stack([xy, 0.1 * xy[:, 0] + 0.2]), np.full(len(xy), 0.03), np.zeros(len(xy), np.int8))
    grid = HeightGrid.covering(np.array([-8.0, -4.0]), np.array([8.0, 4.0]), 0.4, 10_000)
    height, _ = fit_height(data, grid)
    assert np.abs(height - 0.1 * grid.nodes()[..., 0] - 0.2).max() < 0.02


def test_cell_data_are_medians():
    z = np.array([0.1, 0.12, 5.0, 0.4])
    xy = np.array([[0.1, 0.1], [0.2, 0.1], [0.1, 0.2], [1.1, 0.1]])
    data = cell_medians(np.column_stack([xy, z]), np.array([0.03, 0.05, 0.04, 0.03]), 0.25, 1)
    np.testing.assert_allclose(data.xyz[:, 2], [0.12, 0.4])
    np.testing.assert_allclose(data.xyz[0, :2], xy[:3].mean(0))
    assert data.sigma[0] < data.sigma[1], "a lone point must count less than three that share a cell"
    assert (data.kind == 1).all()


def test_bias_uses_only_data_beside_the_path():
    rng = np.random.default_rng(5)
    path = HeightData(
        np.column_stack([np.arange(0.0, 10.0, 0.25), np.zeros((40, 2))]), np.ones(40), np.full(40, 2, np.int8)
    )
    xyz = rng.uniform([0.0, -6.0, 0.0], [10.0, 6.0, 0.0], (800, 3))
    near = np.abs(xyz[:, 1]) < 0.85
    xyz[:, 2] = np.where(near, 0.07, 1.0)
    assert bias_to_path(HeightData(xyz, np.ones(800), np.zeros(800, np.int8)), path) == 0.07
    assert bias_to_path(HeightData(xyz[:5], np.ones(5), np.zeros(5, np.int8)), path) == 0.0


def test_only_the_ground_near_a_long_line_is_fitted():
    rng = np.random.default_rng(5)
    low, high = np.array([-2.0, -2.0]), np.array([14.0, 14.0])
    corner = np.concatenate([np.linspace([0, 0], [12, 0], 40), np.linspace([12, 0], [12, 12], 40)])
    xyz = _noisy(rng, 4000, low, high, 0.02)
    xyz = xyz[cKDTree(corner).query(xyz[:, :2])[0] < 1.5]
    data = HeightData(xyz, np.full(len(xyz), 0.03), np.zeros(len(xyz), np.int8))
    whole = HeightGrid.covering(low, high, 0.4, 10_000, corner, 2.5)
    near = HeightGrid.covering(low, high, 0.4, 1000, corner, 2.5)
    assert whole.fitted is None and near.fitted is not None and 0.2 < near.fitted.mean() < 0.6
    assert (near.rows, near.columns, near.cell) == (whole.rows, whole.columns, 0.4)
    heights = [fit_height(data, grid)[0] for grid in (whole, near)]
    beside = cKDTree(corner).query(near.nodes().reshape(-1, 2))[0].reshape(near.rows, near.columns)
    assert np.abs(heights[1] - heights[0])[beside < 1.0].max() < 0.01
    assert np.abs(heights[1] - _hills(near.nodes()))[beside < 1.0].max() < 0.05
    assert np.isfinite(heights[1]).all()
    assert len(np.unique(heights[1])) == near.fitted.sum(), "the other nodes have heights of fitted ones"
