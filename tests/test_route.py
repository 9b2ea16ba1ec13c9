"""The filmed path as a route."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import drive, right_turn, street

from twin.errors import InputError
from twin.geometry.route import (
    SPACING,
    check_no_jumps,
    distance_to_route,
    filmed_route,
    path_inliers,
    path_jumps,
    remove_stationary,
    route_length,
    smooth_route,
)


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


def test_stops_and_rocking_are_removed():
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
    assert len(remove_stationary(circle)) > 50
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


def _filmed(tmp_path: Path, xy: np.ndarray, times: np.ndarray | None = None):
    """Cameras of one film along a path (n, 2)."""
    cameras = drive(street(), right_turn(), tmp_path / "2_metric", points=100)
    pose = np.repeat(cameras.camera_to_world[:1], len(xy), 0)
    pose[:, :2, 3] = xy
    cameras = cameras.select(np.zeros(len(xy), int))
    names = tuple(f"film/{i:06d}" for i in range(len(xy)))
    return replace(
        cameras, names=names, camera_to_world=pose, times=0.5 * np.arange(len(xy)) if times is None else times
    )


def _bend(length: float = 45.0, count: int = 70) -> np.ndarray:
    s = np.linspace(0.0, length, count)
    return np.stack([s, 3.0 * np.sin(s / 10.0)], -1)


@pytest.mark.parametrize("shift", [(0.0, 0.2), (12.0, 30.0)])
def test_two_passes_in_one_film_are_refused_by_the_names_of_their_frames(tmp_path: Path, shift):
    rng = np.random.default_rng(0)
    twice = np.concatenate([_bend(), _bend(count=60) + shift]) + 0.03 * rng.standard_normal((130, 2))
    cameras = _filmed(tmp_path, twice)
    for check in (check_no_jumps, filmed_route):
        with pytest.raises(InputError, match=r"film/000069 to film/000070.*keep = \[\[") as error:
            check(cameras)
    assert "keep = [[0, 34.5]]" in str(error.value) or "keep = [[35, 64.5]]" in str(error.value)
    assert list(path_jumps(cameras.positions, cameras.times)) == [69]
    for one_pass in (cameras.select(cameras.times <= 34.5), cameras.select(cameras.times >= 35.0)):
        check_no_jumps(one_pass)
        assert 40.0 < route_length(filmed_route(one_pass)) < 55.0


def _driven(speeds: list[float]) -> np.ndarray:
    """A path whose steps are these [m], turning slowly."""
    x = np.concatenate([[0.0], np.cumsum(speeds)])
    return np.stack([60.0 * np.sin(x / 60.0), 60.0 - 60.0 * np.cos(x / 60.0)], -1)


@pytest.mark.parametrize(
    "xy",
    [
        _driven([0.5] * 80),
        _driven([0.02] * 60 + [7.0] * 12),  # stands long, then goes fast at once
        _driven([7.0] * 8 + [0.3] * 60),  # and the reverse
        _driven([0.1 * 1.15**i for i in range(32)]),
        _driven([0.2, 1.8] * 40),  # the sharpest frame of each slot, at the slots' ends
        _driven([0.6] * 30 + [4.5] + [0.6] * 30),  # some frames did not register
        np.concatenate([_driven([0.6] * 40), _driven([0.6] * 40)[::-1]]),  # there and back
        np.concatenate([[[0.6 * i, 0.0] for i in range(40)], [[23.4, -0.6 * i] for i in range(1, 40)]]),  # a corner
    ],
)
def test_turns_stops_and_changes_of_speed_are_no_jumps(tmp_path: Path, xy):
    check_no_jumps(_filmed(tmp_path, xy))


def test_lost_frames_are_no_jump_unless_the_gap_in_time_is_too_short(tmp_path: Path):
    steps = [0.6] * 40 + [9.0] + [0.6] * 40
    times = 0.5 * np.arange(82)
    with pytest.raises(InputError, match=r"jumps 9\.0 m"):
        check_no_jumps(_filmed(tmp_path, _driven(steps), times))
    times[41:] += 7.0  # 14 frames between them
    check_no_jumps(_filmed(tmp_path, _driven(steps), times))
