"""The choice of the route among the filmed passes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import drive, right_turn, street
from routes import KINDS, draw_filming

from twin.config import RouteConfig
from twin.errors import InputError
from twin.geometry.passes import SPACING, find_passes, path_length, smooth_path
from twin.geometry.route import distance_to_route, filmed_route, route_metrics


def test_route_is_evenly_spaced_and_on_the_path(tmp_path: Path):
    cameras = drive(street(), right_turn(step=0.75), tmp_path / "2_metric", points=100)
    route = filmed_route(cameras)
    steps = np.linalg.norm(np.diff(route.line, axis=0), axis=1)
    assert np.all(np.abs(steps - SPACING) < 0.01)
    assert path_length(route.line) == pytest.approx(60.0, abs=0.3)
    assert distance_to_route(right_turn(step=0.05), route.line).max() < 0.05
    # One pass: the line is the whole film's, so that builds of one pass stay as they are.
    assert np.array_equal(route.line, smooth_path(cameras.positions))


def test_distance_to_route_is_that_of_the_nearest_segment():
    route = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, -3.0]])
    points = np.array([[2.0, 1.0], [-3.0, 4.0], [5.0, -1.0], [4.0, -5.0], [3.0, -0.5]])
    assert np.allclose(distance_to_route(route, points), [1.0, 5.0, 1.0, 2.0, 0.5])


def test_longest_source_in_driving_order(tmp_path: Path):
    cameras = drive(street(), right_turn(), tmp_path / "2_metric", sources=("a", "b"), points=100)
    half = cameras.select(np.array([s == "b" or t < 15.0 for s, t in zip(cameras.sources, cameras.times, strict=True)]))
    # Frames stored out of order are still driven in order of time.
    shuffled = half.select(np.random.default_rng(0).permutation(len(half)))
    line = filmed_route(shuffled).line
    assert np.allclose(line[0], [0, 0], atol=0.05) and np.allclose(line[-1], right_turn()[-1], atol=0.05)


def test_a_camera_that_stands_still_is_refused(tmp_path: Path):
    cameras = drive(street(), right_turn(), tmp_path / "2_metric", points=100)
    still = replace(cameras, camera_to_world=np.repeat(cameras.camera_to_world[:1], len(cameras), 0))
    with pytest.raises(InputError, match=r"0\.00 m long.*mjcf\.route = false"):
        filmed_route(still)


def _cameras(kind: str, number: int = 0):
    return draw_filming(KINDS.index(kind) + len(KINDS) * number).cameras


def test_a_pass_may_be_chosen_and_driven_backwards():
    cameras = _cameras("there_and_back_on_the_spot")
    there, back = find_passes(cameras)
    assert filmed_route(cameras).chosen == ("a:1",)
    chosen = filmed_route(cameras, RouteConfig(passes=("a:2",)))
    assert chosen.chosen == ("a:2",) and np.array_equal(chosen.line, back.path)
    reverse = filmed_route(cameras, RouteConfig(passes=("a:1",), reverse=True))
    assert np.array_equal(reverse.line, there.path[::-1])


def test_passes_that_meet_may_be_joined_and_others_not():
    cameras = _cameras("jump_ahead", number=1)
    first, second = find_passes(cameras)
    with pytest.raises(InputError, match=r"a:2 is \d+\.\d m from the end.*expected at most 0\.5 m.*route\.max_gap"):
        filmed_route(cameras, RouteConfig(passes=("a:1", "a:2"), max_gap=0.5))
    joined = filmed_route(cameras, RouteConfig(passes=("a:1", "a:2"), max_gap=20.0))
    assert joined.chosen == ("a:1", "a:2")
    assert path_length(joined.line) > first.length + second.length
    # There and back is no line that a robot can drive in one go.
    with pytest.raises(InputError, match="turns back at"):
        filmed_route(_cameras("there_and_back_on_the_spot"), RouteConfig(passes=("a:1", "a:2")))


def test_films_of_one_lighting_continue_each_other_and_of_two_do_not():
    cameras = _cameras("cut_in_two")
    assert filmed_route(cameras).chosen == ("a:1", "b:1")
    two = replace(cameras, lightings=tuple("day" if name == "a" else "night" for name in cameras.sources))
    assert len(filmed_route(two).chosen) == 1


def test_a_second_lap_is_not_driven_by_default():
    cameras = _cameras("laps")
    assert len(find_passes(cameras)) >= 2
    assert len(filmed_route(cameras).chosen) == 1


def test_way_points_follow_what_was_filmed():
    cameras = _cameras("once")
    path = find_passes(cameras)[0].path
    points = tuple(tuple(float(v) for v in path[k]) for k in range(0, len(path), 8))
    route = filmed_route(cameras, RouteConfig(points=points))
    assert route.chosen == () and distance_to_route(path, route.line).max() < 0.3
    off = (points[0], (points[1][0] + 30.0, points[1][1] + 30.0))
    with pytest.raises(InputError, match=r"route\.points: at .* m from the nearest filmed path"):
        filmed_route(cameras, RouteConfig(points=off))


def test_an_unknown_pass_is_refused_with_the_list():
    cameras = _cameras("twice_with_cut")
    with pytest.raises(InputError, match=r"no pass 'a:7'; expected one of a:1 \(.* m\), a:2 \(.* m\)"):
        filmed_route(cameras, RouteConfig(passes=("a:7",)))
    assert filmed_route(cameras, RouteConfig(passes=("a",))).chosen[0] in ("a:1", "a:2")


def test_metrics_name_passes_and_choice():
    metrics = route_metrics(filmed_route(_cameras("twice_with_cut")))
    assert [one["name"] for one in metrics["passes"]] == ["a:1", "a:2"]
    assert metrics["chosen"] in (["a:1"], ["a:2"])
