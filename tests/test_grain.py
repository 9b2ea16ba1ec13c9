"""The detail that randomised episodes have more of than the field."""

import numpy as np
import pytest

from twin.env.grain import Grain, _marks, _roughness
from twin.env.randomisation import Draw
from twin.env.weather import Weather
from twin.geometry.cameras import pixel_grid, unproject

TEXEL = 0.025


def plane(side: int, pixel: float, origin: tuple[float, float, float], u: tuple, v: tuple) -> np.ndarray:
    """Points on a plane through the origin, seen squarely by pixels of some size [m], shape (side, side, 3)."""
    across, down = np.meshgrid(np.arange(side) * pixel, np.arange(side) * pixel)
    return np.float32(np.array(origin) + across[..., None] * np.array(u) + down[..., None] * np.array(v))


def seen(grain: Grain, points: np.ndarray, depth: float = 5.0) -> np.ndarray:
    """Logarithm of the gain that points get, shape (side, side)."""
    rgb = np.ones_like(points)
    out = grain.over(rgb, np.full(points.shape[:2], depth, np.float32), points)
    np.testing.assert_array_equal(out, np.repeat(out[..., :1], 3, -1))
    return np.log(out[..., 0])


GROUND = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def test_a_pixel_shows_the_mean_of_what_it_covers():
    grain = Grain(0.5, np.random.default_rng(1))
    fine = seen(grain, plane(256, TEXEL, (0.0, 0.0, 0.0), *GROUND))
    for factor in (2, 4, 8, 16):
        middle = (factor - 1) / 2 * TEXEL
        coarse = seen(grain, plane(256 // factor, factor * TEXEL, (middle, middle, 0.0), *GROUND))
        means = fine.reshape(256 // factor, factor, 256 // factor, factor).mean((1, 3))
        np.testing.assert_allclose(coarse, means, atol=2e-3)
    far = seen(grain, plane(20, 64 * TEXEL, (0.0, 0.0, 0.0), *GROUND))
    assert far.std() < 0.4 * fine.std()


def test_it_lies_still_scales_with_its_strength_and_is_not_in_the_sky():
    one, half = (Grain(strength, np.random.default_rng(2)) for strength in (1.0, 0.5))
    here = seen(one, plane(64, TEXEL, (3.0, -2.0, 0.1), *GROUND))
    there = seen(one, plane(64, TEXEL, (3.0 + 10 * TEXEL, -2.0, 0.1), *GROUND))
    np.testing.assert_allclose(there[:, :-10], here[:, 10:], atol=0.04)  # OpenCV reads at 1/32 of a texel
    assert np.abs(there - here).mean() > 0.02
    np.testing.assert_allclose(seen(half, plane(64, TEXEL, (3.0, -2.0, 0.1), *GROUND)), 0.5 * here, atol=1e-5)
    assert not seen(one, plane(64, TEXEL, (3.0, -2.0, 0.1), *GROUND), depth=50.0).any()
    other = seen(Grain(1.0, np.random.default_rng(3)), plane(64, TEXEL, (3.0, -2.0, 0.1), *GROUND))
    assert np.abs(other - here).mean() > 0.05


@pytest.mark.parametrize("u", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.8, 0.6, 0.0)])
def test_walls_have_it_too(u):
    """In both directions, wherever they face."""
    rough = []
    for seed in range(6):
        light = seen(Grain(1.0, np.random.default_rng(seed)), plane(200, TEXEL, (1.0, 2.0, 0.0), u, (0.0, 0.0, 1.0)))
        rough.append([np.abs(np.diff(light, axis=axis)).mean() for axis in (0, 1)])
    assert np.all(np.mean(rough, 0) > 0.03)


def test_patterns_have_no_seam_and_cracks_are_dark_and_few():
    marks = np.stack([_marks(np.random.default_rng(seed)) for seed in range(12)])
    rough = _roughness(np.random.default_rng(0))
    assert rough.std() == pytest.approx(0.1) and abs(rough.mean()) < 1e-3
    for pattern, axis in ((rough, 0), (rough, 1), (marks, 1), (marks, 2)):
        steps = np.abs(np.diff(pattern, axis=axis)).mean()
        seam = np.abs(np.take(pattern, 0, axis) - np.take(pattern, -1, axis)).mean()
        assert 0.3 * steps < seam < 3.0 * steps
    dark, bright = (marks < -0.25).mean((1, 2)), (marks > 0.25).mean((1, 2))
    assert 0.005 < dark.mean() < 0.1 and dark.std() > 0.003 and bright.mean() < 0.5 * dark.mean()


def test_weather_lays_it_on_the_place_and_nothing_else_changes_with_it():
    rays = unproject(pixel_grid(48, 32), np.array([40.0, 40.0, 24.0, 16.0]))
    rgb, depth = np.full((32, 48, 3), 0.5, np.float32), np.full((32, 48), 2.0, np.float32)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    pose[:3, 3] = 5.0, 3.0, 2.0
    moved = pose.copy()
    moved[0, 3] += 0.5  # ten pixels
    weather = Weather(Draw(grain=1.0), np.random.default_rng(0))
    first = weather.over(rgb, depth, rays, pose)
    np.testing.assert_allclose(weather.over(rgb, depth, rays, moved)[:, :-10], first[:, 10:], rtol=0.03)
    assert first.std() > 0.01
    shaded = Weather(Draw(shade=0.5), np.random.default_rng(0)).over(rgb, depth, rays, pose)
    both = Weather(Draw(shade=0.5, grain=1.0), np.random.default_rng(0)).over(rgb, depth, rays, pose)
    np.testing.assert_allclose(both, shaded * first / 0.5, rtol=1e-5)
