"""Division of filmed paths into passes."""

import numpy as np
import pytest
from routes import KINDS, draw_filming, measure

from twin.geometry.passes import (
    SPACING,
    find_passes,
    moving,
    path_directions,
    path_inliers,
    path_jumps,
    path_length,
    path_outliers,
    smooth_path,
)
from twin.geometry.route import distance_to_route, filmed_route


def _endings(kind: str, number: int = 0) -> list[str]:
    """Endings of the passes of the first drawn filming of a kind."""
    filming = draw_filming(KINDS.index(kind) + len(KINDS) * number)
    assert filming.kind == kind
    return [one.ends_with for one in find_passes(filming.cameras)]


@pytest.mark.parametrize("kind", KINDS)
def test_routes_of_random_films_follow_the_film_without_jumps_and_folds(kind):
    for number in range(3):
        row = measure(draw_filming(KINDS.index(kind) + len(KINDS) * number))
        assert row["off"] < 0.3 and row["step"] < 0.3 and row["turn"] < 120.0 and row["length"] > 0.9


def test_a_pass_ends_at_a_jump_turn_lap_or_the_film_s_end():
    assert _endings("once") == ["end"]
    assert _endings("stops") == ["end"]
    assert _endings("twice_with_cut") == ["jump", "end"]
    assert _endings("there_and_back_on_the_spot") == ["turn", "end"]
    assert _endings("there_and_back_other_lane") == ["turn", "end"]
    assert set(_endings("laps")[:-1]) == {"lap"}
    assert _endings("backs_up") == ["turn", "turn", "end"]


def test_passes_are_numbered_by_source_and_cover_their_frames():
    cameras = draw_filming(KINDS.index("twice_with_cut")).cameras
    first, second = find_passes(cameras)
    assert (first.name, second.name) == ("a:1", "a:2")
    assert set(first.frames).isdisjoint(second.frames)
    assert len(first.frames) + len(second.frames) == len(cameras)
    for one in (first, second):
        near = distance_to_route(one.path, cameras.positions[one.frames, :2])
        assert np.quantile(near, 0.95) < 0.2


def test_a_pass_points_where_its_camera_looks():
    cameras = draw_filming(KINDS.index("backs_up")).cameras
    for one in find_passes(cameras):
        looks = cameras.camera_to_world[one.frames, :2, 2].mean(0)
        assert path_directions(one.path)[len(one.path) // 2] @ looks > 0.5


def test_a_film_that_backs_up_is_one_route():
    filming = draw_filming(KINDS.index("backs_up"))
    assert filmed_route(filming.cameras).chosen == ("a:1", "a:3")
    assert measure(filming)["length"] == pytest.approx(1.0, abs=0.08)


def _lifted(xy):
    return np.concatenate([xy, np.full((len(xy), 1), 1.8)], 1)


def test_standing_and_rocking_are_removed_from_the_path():
    rng = np.random.default_rng(2)
    path = np.stack([np.arange(0.0, 20.0, 0.5), np.zeros(40)], -1)
    standing = path[20] + 0.03 * rng.standard_normal((15, 2))
    rocking = path[20] + np.stack([0.35 * np.sin(np.arange(12)), np.zeros(12)], -1)
    filmed = np.concatenate([path[:20], standing, rocking, path[20:]])
    route = smooth_path(_lifted(filmed))
    assert np.all(np.diff(route[:, 0]) > 0.1)
    assert path_length(route) == pytest.approx(19.5, abs=0.2)


def test_a_closed_loop_keeps_its_return():
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = 5 * np.stack([np.cos(angle), np.sin(angle)], -1)
    assert len(moving(circle)) > 50
    assert path_length(smooth_path(_lifted(circle))) == pytest.approx(10 * np.pi, rel=0.02)


def test_noise_and_an_outlier_are_smoothed_away():
    rng = np.random.default_rng(1)
    path = np.stack([0.75 * np.arange(81), 2.0 * np.sin(0.075 * np.arange(81))], -1)
    positions = _lifted(path) + 0.04 * rng.standard_normal((81, 3))
    positions[30] += [0.0, 4.0, 1.0]
    keep = path_inliers(positions)
    assert not keep[30] and keep.sum() == 80
    smooth = smooth_path(positions)
    assert np.all(np.abs(np.linalg.norm(np.diff(smooth, axis=0), axis=1) - SPACING) < 0.02)
    assert distance_to_route(path, smooth).max() < 0.12


def _driven(steps: list[float]) -> np.ndarray:
    """A slowly turning path with these step lengths [m]."""
    x = np.concatenate([[0.0], np.cumsum(steps)])
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
def test_turns_stops_and_changes_of_speed_are_no_jumps(xy):
    assert len(path_jumps(xy, 0.5 * np.arange(len(xy)))) == 0


def test_lost_frames_are_no_jump_unless_the_gap_in_time_is_too_short():
    xy, times = _driven([0.6] * 40 + [9.0] + [0.6] * 40), 0.5 * np.arange(82)
    assert list(path_jumps(xy, times)) == [40]
    times[41:] += 7.0  # 14 frames between them
    assert len(path_jumps(xy, times)) == 0


@pytest.mark.parametrize("unit", [1.0, 0.04])
def test_frames_beside_a_cut_are_no_outliers(unit):
    cameras = draw_filming(KINDS.index("twice_with_cut")).cameras
    pose = cameras.camera_to_world.copy()
    pose[:, :3, 3] *= unit  # a reconstruction has no meters
    true = np.zeros(len(cameras), bool)
    true[[6, len(cameras) - 9]] = True
    pose[true, 1, 3] += 4.0 * unit
    assert np.array_equal(path_outliers(pose, 0.3), true)
