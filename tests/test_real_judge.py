"""The judge of the real test, against the twin's own verdicts through the task's file."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from twin.config import CAUSES
from twin.env.options import parse_options
from twin.env.route_segments import RouteSegment
from twin.env.task import Motion, RewardAndTermination, task_table
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.geometry.poses import Similarity
from twin.mjcf.world import World
from twin.reality.road_task import RealJudge, RoadTask, read_task

PATHS, STEP, SPEED = 1000, 0.2, 1.0
OPTIONS = parse_options({"pixels": False, "control_timestep": STEP})


def winding_world() -> tuple[World, RouteSegment]:
    """70 m that bend to both sides, on a slope; the task is a part of it."""
    s = np.arange(0.0, 70.0, 0.25)
    heading = 0.9 * np.sin(s / 7.0) + 0.4 * np.sin(s / 2.9)
    xy = np.cumsum(0.25 * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    route = np.column_stack([xy, 0.05 * s])
    return World(route, 1.0, (0.0, 0.0, 0.0, 0.0), Path()), RouteSegment("middle", 20.0, 16.0)


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> RoadTask:
    path = tmp_path_factory.mktemp("task") / "middle.json"
    write_json(path, task_table(*winding_world(), OPTIONS))
    return read_task(path)


def drawn_paths(rng: np.random.Generator) -> Motion:
    """Paths of wandering drives, shape (steps, paths): some halt, turn back, tip over or touch something."""
    world, segment = winding_world()
    steps = round(2.2 * segment.length / SPEED / STEP)
    speed = rng.uniform(0.3, 1.0, PATHS) * np.where(rng.random(PATHS) < 0.1, -1.0, 1.0)
    moving = np.where(
        rng.random(PATHS) < 0.3, np.arange(steps)[:, None] < rng.integers(0, steps, PATHS), np.ones((steps, 1), bool)
    )
    creep = np.where(moving, speed, rng.choice([0.0, 0.019, 0.021, 0.04], PATHS))
    station = segment.start + np.cumsum(creep * STEP, 0)
    wander = np.cumsum(rng.normal(0.0, 0.1, (steps, PATHS)), 0) * rng.uniform(0.0, 1.0, PATHS)
    lateral = rng.uniform(-0.3, 0.3, PATHS) + wander
    route = world.route[:, :2]
    heading = heading_at(route, station)
    xy = point_at(route, station) + lateral[..., None] * np.stack([-np.sin(heading), np.cos(heading)], -1)
    rare = rng.random((2, steps, PATHS)) < 0.1 / steps
    times = np.broadcast_to((np.arange(steps)[:, None] + 1) * STEP, (steps, PATHS))
    flat = np.zeros((steps, PATHS))
    return Motion(
        np.concatenate([xy, heading[..., None]], -1), flat, flat, np.where(rare[0], 0.3, 0.99), rare[1], times
    )


def test_both_judges_agree_on_a_thousand_paths(task):
    """They agree in cause, step and progress; the twin evaluates all paths at once, the reality one after the other."""
    world, segment = winding_world()
    paths = drawn_paths(np.random.default_rng(0))
    twin, all_of_them = RewardAndTermination(world, segment, OPTIONS, PATHS), np.arange(PATHS)
    start = paths.pose[0, :, :2]
    twin.begin(all_of_them, np.full(PATHS, segment.start), start)
    verdicts: list[tuple[str, int, float]] = [("", 0, 0.0)] * PATHS
    for k in range(len(paths.time)):
        going = np.array([i for i in range(PATHS) if not verdicts[i][0]], int)
        if not len(going):
            break
        twin.evaluate(going, Motion(*(getattr(paths, name)[k, going] for name in vars(paths))))
        for i in going.tolist():
            verdicts[i] = twin.cause(i), k, float(twin.foot[i] - segment.start)
    judge, mine = RealJudge(task), []
    for i in range(PATHS):
        judge.begin(*start[i].tolist())
        for k in range(len(paths.time)):
            tilt, touched = float(np.arccos(paths.uprightness[k, i])), bool(paths.touched[k, i])
            if judge.see(*paths.pose[k, i, :2].tolist(), tilt, touched, float(paths.time[k, i])):
                break
        mine.append((judge.cause, k, judge.progress))
    counts = Counter(cause for cause, _, _ in mine)
    assert all(counts[cause] >= 5 for cause in CAUSES), counts
    disagree = [i for i in range(PATHS) if mine[i][:2] != verdicts[i][:2]]
    assert not disagree, [(mine[i], verdicts[i]) for i in disagree[:5]]
    np.testing.assert_allclose([m[2] for m in mine], [v[2] for v in verdicts], atol=1e-6)


def test_a_task_says_what_the_twin_does(task):
    world, segment = winding_world()
    rules = RewardAndTermination(world, segment, OPTIONS)
    assert (task.name, task.half_width, task.time_limit) == ("middle", rules.half_width, rules.time_limit)
    assert task.goal == segment.end - 0.5 and task.knots[-1] == pytest.approx(arc_lengths(world.route)[-1])
    starts = np.array([task.sample_start(np.random.default_rng(k)) for k in range(300)])
    off = starts[:, :2] - point_at(world.route[:, :2], segment.start)
    heading = float(heading_at(world.route[:, :2], segment.start))
    lateral = off @ [-np.sin(heading), np.cos(heading)]
    assert np.abs(off @ [np.cos(heading), np.sin(heading)]).max() < 1e-9
    assert 0.28 < np.abs(lateral).max() <= 0.3
    turned = np.rad2deg(np.abs(starts[:, 2] - heading)).max()
    assert 9.5 < turned <= 10.0


def test_a_task_goes_from_the_scenes_frame_into_the_true_one(tmp_path, task):
    """The frames differ by a quarter turn and a shift; lengths do not change."""
    path = tmp_path / "task.json"
    write_json(path, task_table(*winding_world(), OPTIONS))
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = read_task(path, Similarity(1.0, quarter, np.array([5.0, 6.0, 7.0])))
    np.testing.assert_allclose(moved.line, task.line @ quarter[:2, :2].T + [5.0, 6.0], atol=1e-12)
    assert (moved.goal, moved.start) == (task.goal, task.start)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "is not a task; write one: twin export SCENE --task NAME --task-file FILE"),
        ({"line": [[0.0, 0.0, 0.0]]}, "line of shape"),
        ({"goal": 500.0}, "goal 500 m on a line of"),
        ({"half_width": None}, "is damaged"),
        ({"time_limit": 0.0}, "time limit"),
    ],
)
def test_impossible_tasks_are_refused_in_one_line(tmp_path, change, message):
    path = tmp_path / "task.json"
    write_json(path, task_table(*winding_world(), OPTIONS))
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=message) as raised:
        read_task(path)
    assert "\n" not in str(raised.value)
