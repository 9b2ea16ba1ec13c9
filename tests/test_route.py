"""The filmed path as a route."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import drive, right_turn, street

from twin.assets.route import (
    SPACING,
    distance_to_route,
    filmed_route,
    path_inliers,
    route_length,
    smooth_route,
    without_rocking,
)
from twin.errors import InputError


def _lifted(xy):
    return np.concatenate([xy, np.full((len(xy), 1), 1.8)], 1)


def test_route_is_evenly_spaced_and_on_the_path():
    path = right_turn(step=0.75)
    route = smooth_route(_lifted(path))
    steps = np.linalg.norm(np.diff(route, axis=0), axis=1)
    assert np.all(np.abs(steps - SPACING) < 0.01)
    assert route_length(route) == pytest.approx(60.0, abs=0.3)
    assert distance_to_route(right_turn(step=0.05), route).max() < 0.05
    assert np.allclose(route[[0, -1]], path[[0, -1]], atol=0.02)


def test_noise_and_an_outlier_are_smoothed_away():
    rng = np.random.default_rng(1)
    positions = _lifted(right_turn(step=0.75)) + 0.04 * rng.standard_normal((81, 3))
    positions[30] += [0.0, 4.0, 1.0]
    keep = path_inliers(positions)
    assert not keep[30] and keep.sum() == 80
    route = smooth_route(positions)
    assert distance_to_route(right_turn(step=0.05), route).max() < 0.12
    turning = np.diff(np.unwrap(np.arctan2(*np.diff(route, axis=0).T[::-1])))
    assert np.abs(turning).max() < np.deg2rad(6.0)


def test_standing_and_rocking_leave_no_trace():
    rng = np.random.default_rng(2)
    path = np.stack([np.arange(0.0, 20.0, 0.5), np.zeros(40)], -1)
    standing = path[20] + 0.03 * rng.standard_normal((15, 2))
    rocking = path[20] + np.stack([0.35 * np.sin(np.arange(12)), np.zeros(12)], -1)
    filmed = np.concatenate([path[:20], standing, rocking, path[20:]])
    route = smooth_route(_lifted(filmed))
    assert np.all(np.diff(route[:, 0]) > 0.1)
    assert route_length(route) == pytest.approx(19.5, abs=0.2)


def test_a_round_trip_keeps_its_return():
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = 5 * np.stack([np.cos(angle), np.sin(angle)], -1)
    assert len(without_rocking(circle)) > 50
    assert route_length(smooth_route(_lifted(circle))) == pytest.approx(10 * np.pi, rel=0.02)


def test_distance_to_route_is_that_of_the_nearest_segment():
    route = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, -3.0]])
    points = np.array([[2.0, 1.0], [-3.0, 4.0], [5.0, -1.0], [4.0, -5.0], [3.0, -0.5]])
    assert np.allclose(distance_to_route(route, points), [1.0, 5.0, 1.0, 2.0, 0.5])


def test_longest_source_in_driving_order(tmp_path: Path):
    cameras = drive(street(), right_turn(), tmp_path / "2_metric", sources=("a", "b"), points=100)
    half = cameras.select(np.array([s == "b" or t < 15.0 for s, t in zip(cameras.sources, cameras.times, strict=True)]))
    # Frames stored out of order are still driven in order of time.
    shuffled = half.select(np.random.default_rng(0).permutation(len(half)))
    route = filmed_route(shuffled)
    assert np.allclose(route[0], [0, 0], atol=0.05) and np.allclose(route[-1], right_turn()[-1], atol=0.05)


def test_a_camera_that_stands_still_is_refused(tmp_path: Path):
    cameras = drive(street(), right_turn(), tmp_path / "2_metric", points=100)
    still = replace(cameras, camera_to_world=np.repeat(cameras.camera_to_world[:1], len(cameras), 0))
    with pytest.raises(InputError, match=r"0\.00 m long.*mjcf\.route = false"):
        filmed_route(still)
