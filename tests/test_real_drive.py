"""The real test: road, light, numbers; nothing but pictures goes in, and nothing but rows come out."""

import ast
import csv
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import mujoco
import numpy as np
import pytest

from twin import commands
from twin.config import MjcfConfig
from twin.env.options import parse_options
from twin.env.route_segments import find_task
from twin.env.task import task_table
from twin.errors import InputError
from twin.evaluation.trials import SETUP_COLUMNS, Cell, read_results, read_trials, write_real_trials
from twin.geometry.images import read_image
from twin.geometry.polyline import arc_lengths, point_at
from twin.learn.policy import Control, Policy, load_policy, save_policy
from twin.learn.policy_network import Architecture
from twin.mjcf.world import World
from twin.reality import REALITY_VERSION, campus_road, real_test, recordings, true_world
from twin.reality.campus_road import RoadLine
from twin.reality.lighting import LIGHTINGS, WEATHER, weather, weather_index
from twin.reality.real_camera import native_size
from twin.reality.real_robot import RealRobot
from twin.reality.real_test import RealTest, Setup, task_for
from twin.reality.recordings import follow
from twin.reality.road_task import CAMPUS_TASKS, parse_task, place_on_test_day, task_of_place, true_route
from twin.runtime import exclusive_lock
from twin.sysid.log_files import read_log

ROOT = Path(__file__).parents[1]
NARROW = Architecture(convolutions=((2, 8, 8),), features=2, hidden=(2,))


def steering(yaw_rate: float, seen: list | None = None) -> Policy:
    """Always returns the same yaw rate [rad/s], and stores the pictures."""

    def act(stacks):
        if seen is not None:
            seen.append(stacks.copy())
        return np.full((len(stacks), 1), yaw_rate, np.float32)

    return Policy("constant", act, Control())


def straight(setup: Setup | None = None) -> RealTest:
    return RealTest(task_of_place(0, "straight"), setup)


def written(folder: Path, yaw_rate: float) -> Path:
    """The folder of a policy that always steers alike."""
    weights = {name: np.zeros(shape, np.float32) for name, shape in NARROW.shapes().items()}
    weights["mean.bias"][:] = np.arctanh(yaw_rate)
    save_policy(folder, NARROW, Control(), weights, {})
    return folder


class Grey:
    """Stands in for a rasterizer where pictures do not matter."""

    def __call__(self, pose):
        return np.full((90, 160, 3), 0.4, np.float32), np.full((90, 160), 5.0, np.float32)


@pytest.fixture
def gray(monkeypatch):
    monkeypatch.setattr(real_test, "rasterizer", lambda *_: Grey())


# ---- independence


def test_nothing_leaks():
    """No module outside `twin/reality` imports from it: only the test knows its robot, weather, road and trials."""
    for path in (ROOT / "twin").rglob("*.py"):
        if path.parent.name == "reality":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            module = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
            assert not [name for name in names if f"{module}.{name}".startswith("twin.reality")], path


FOUNDATIONS = {"errors", "types", "ranges", "files", "robot", "config", "runtime", "warp_runtime", "geometry"}
"""Rooms of `twin` below the pipeline: files, messages, settings, geometry of cameras."""
TABLES = {"evaluation", "evaluation.trials", "evaluation.statistics"}
"""The format of tables of trials."""
LOADER = {"learn", "learn.policy", "learn.policy_network"}
"""The loader of policy files."""


def test_the_real_test_runs_without_the_twin():
    """Trials, recordings and their evaluation import only basic modules, the policy loader and tables of trials."""
    code = (
        "import sys\n"
        "from twin.learn.policy import Control, Policy\n"
        "import numpy as np\n"
        "from twin.reality import real_test, recordings\n"
        "class Grey:\n"
        "    def __call__(self, pose):\n"
        "        return np.full((90, 160, 3), 0.4, np.float32), np.full((90, 160), 5.0, np.float32)\n"
        "real_test.rasterizer = lambda *_: Grey()\n"
        "policy = Policy('left', lambda stacks: np.full((len(stacks), 1), 0.9, np.float32), Control())\n"
        "test = real_test.RealTest(real_test.task_for(policy, 'straight', 0))\n"
        "assert test.run_trial(policy, 'rain', 1).cause == 'out_of_bounds'\n"
        "print(*sys.modules)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    loaded = {name.removeprefix("twin.") for name in done.stdout.split() if name.startswith("twin.")}
    own = {name for name in loaded if name.split(".")[0] == "reality"}
    others = {name for name in loaded - own if name.split(".")[0] not in FOUNDATIONS}
    assert len(own) > 15 and others == TABLES | LOADER
    assert "dm_control" not in done.stdout


# ---- road, light


def test_tasks_are_the_twins():
    """`straight` is 30 m and `right_turn` 58 m of the filmed path, which is always near the road's center."""
    line = true_route()
    world = World(line, MjcfConfig().half_width, (0.0, 0.0, 0.0, 0.0), Path(), start=2.0)
    options = parse_options({"pixels": False, "action": "steering"})
    for name in CAMPUS_TASKS:
        theirs = parse_task(task_table(world, find_task(name, world), options))
        mine = task_of_place(0, name)
        for field, value in vars(mine).items():
            same = value == theirs.name if field == "name" else np.allclose(getattr(theirs, field), value, atol=1e-3)
            assert same, (name, field)
        # A policy may ask for more than the robot's top speed, and needs time all the same.
        fast = parse_task(task_table(world, find_task(name, world), replace(options, speed=1.6)))
        assert task_of_place(0, name, speed=1.6).time_limit == pytest.approx(fast.time_limit, abs=1e-3)
    assert {"straight", "right_turn"} < set(CAMPUS_TASKS)
    assert arc_lengths(line)[-1] == pytest.approx(60.0, abs=1.0)
    assert np.abs(campus_road.build().route.project(line[:, :2])[1]).max() < 0.35


def test_the_corridor_is_free_and_a_drive_along_it_arrives():
    """No solid is within 0.35 m (half the robot's width) of the corridor; a driver that knows the route reaches the
    goal.
    """
    points = point_at(true_route()[:, :2], np.arange(0.0, 60.0, 0.1))
    for obj in place_on_test_day().objects:
        for solid in obj.solids:
            c, s = np.cos(solid.yaw), np.sin(solid.yaw)
            off = (points - solid.center[:2]) @ np.array([[c, -s], [s, c]])
            round_one = np.linalg.norm(off, axis=1) - solid.half[0]
            square = np.linalg.norm(np.maximum(np.abs(off) - solid.half[:2], 0.0), axis=1)
            distance = (round_one if solid.kind == "cylinder" else square).min()
            assert distance > MjcfConfig().half_width + 0.35, obj.name
    for name, number in (("straight", 0), ("right_turn", 2), ("right_turn", 11)):
        test = RealTest(task_of_place(0, name), Setup(robot=number))
        assert follow_the_line(test).cause == "goal"


def follow_the_line(test: RealTest, speed: float = 1.0):
    """Drives a test by pure pursuit, without pictures; returns the judge."""
    start = test.task.sample_start(np.random.default_rng(3))
    test.robot.set_pose(*start, np.random.default_rng(4))
    test.judge.begin(*start[:2])
    while not test.judge.cause:
        test.step(speed, follow(test.task.line, test.robot.pose, test.judge.station, speed, test.task.yaw_rate))
    return test.judge


def test_a_robot_that_drives_into_a_house_has_touched_it():
    test = straight()
    boxes = [one for obj in place_on_test_day().objects for one in obj.solids if one.kind == "box"]
    one = max(boxes, key=lambda box: box.half[0])
    test.robot.set_pose(*one.center[:2].tolist(), 0.0, np.random.default_rng(0))
    test.judge.begin(*one.center[:2].tolist())
    test.step(0.0, 0.0)
    assert test.judge.cause == "collision"


def test_small_things_have_moved_and_nothing_else():
    filmed, later = campus_road.build(), campus_road.build(displaced=True)
    assert [obj.name for obj in filmed.objects] == [obj.name for obj in later.objects]
    for before, after in zip(filmed.objects, later.objects, strict=True):
        moved = not np.array_equal(before.part.vertices, after.part.vertices)
        assert moved == before.name.startswith(("cone_", "bin_", "crate_", "car_")), before.name
        if moved:
            off = np.linalg.norm(before.part.vertices.mean(0) - after.part.vertices.mean(0))
            assert 0.0 < off < 2.0


def test_its_light_is_not_filmed():
    assert len(WEATHER) >= 4 and not set(WEATHER) & set(LIGHTINGS)
    for one in WEATHER.values():
        for other in LIGHTINGS.values():
            assert one.ambient != other.ambient and one.suns != other.suns and one.zenith != other.zenith


def test_some_days_are_hazy_and_some_are_clear():
    """Two in five of the fifteen days are expected to be hazy; their visibility is 60 to 400 m."""
    sight = np.array([one.visibility for name, one in WEATHER.items() if name.startswith("day_")])
    hazy = np.isfinite(sight)
    assert len(sight) == 15 and 2 <= hazy.sum() <= 11
    assert np.all((sight[hazy] >= 60.0) & (sight[hazy] <= 400.0))


def test_every_number_is_a_day_and_other_weathers_keep_their_seeds():
    assert weather("day_15") == WEATHER["day_15"] and weather("day_300") != weather("day_301")
    names = [*WEATHER, "day_16", "day_300"]
    assert [weather_index(name) for name in names] == [*range(len(WEATHER)), len(WEATHER), 304]
    for name in ("day_0", "day_01", "day_x", "day_1111111111", "snow"):
        with pytest.raises(InputError, match=f"no lighting '{name}' in the real test; expected one of dawn"):
            weather(name)


def test_drawn_days_change_a_picture_by_10_gray_levels_or_more():
    """All pictures are rendered from one pose of one camera."""
    test, seen = straight(), []
    for name in ("evening", "day_6", "day_9"):
        camera = test.reset(name, 1)
        seen.append(camera.capture(test.robot).astype(float))
    apart = [np.abs(one - other).mean() for k, one in enumerate(seen) for other in seen[:k]]
    assert min(apart) > 9.5 and np.mean(apart) > 20.0, apart


# ---- trials


def test_a_policy_sees_pictures_and_nothing_else(gray):
    seen: list = []
    trial = straight().run_trial(steering(0.9, seen), "rain", 1)
    assert trial.cause == "out_of_bounds" and len(seen) == trial.steps
    assert all(stacks.shape == (1, 12, 90, 160) and stacks.dtype == np.uint8 for stacks in seen)
    assert np.array_equal(seen[0][0, :3], seen[0][0, 9:])  # at first the first picture four times
    assert np.array_equal(seen[4][0, 3:6], seen[5][0, :3])  # the newest last


def test_trials_repeat_and_differ_by_seed():
    """Pictures and outcome of a trial repeat with a new road and robot, under the true lighting."""
    sums, ends = [], []
    for seed in (1, 1, 2):
        frames: list = []
        ends.append(straight().run_trial(steering(0.9), "evening", seed, frames.append))
        sums.append(hashlib.sha256(np.stack(frames).tobytes()).hexdigest())
    assert sums[0] == sums[1] != sums[2] and ends[0] == ends[1]
    assert ends[0].progress != ends[2].progress
    assert len(frames[0].shape) == 3 and 15 < np.stack(frames).mean() < 200


def test_the_seed_alone_decides_where_a_trial_starts(gray):
    """Neither earlier trials nor policy nor lighting matter, so that policies can be compared pair by pair."""
    one, starts = straight(), []
    for seed, lighting in ((5, "rain"), (6, "dawn"), (5, "haze")):
        one.run_trial(steering(0.5), lighting, seed)
        one.reset(lighting, seed)
        starts.append(one.robot.pose)
    assert np.array_equal(starts[0], starts[2]) and not np.array_equal(starts[0], starts[1])


def test_results_are_the_sums_of_trials(gray, tmp_path):
    """`twin forecast` reads them; a second call drives only missing trials; a row of another policy file is refused."""
    left, ahead = written(tmp_path / "left", 0.9), written(tmp_path / "ahead", 0.001)
    out = tmp_path / "real" / "results.csv"
    stack = np.zeros((12, 90, 160), np.uint8)
    assert load_policy(left)(stack) == pytest.approx(0.9) and load_policy(ahead)(stack) == pytest.approx(0.001)
    real_test.run([left, ahead, left], "straight", ["rain", "haze", "rain"], 2, out)
    twin = [Cell(policy, "straight", "held-out+randomised", 10, 5) for policy in ("left", "ahead")]
    cells = read_results([out], twin)
    trials = read_trials(out.with_name("results_trials.csv"))
    assert len(trials) == 8 and len(cells) == 4
    starts = {(t.lighting, t.seed) for t in trials}
    assert (
        len(starts) == len({seed for _, seed in starts}) == 4
    )  # the same for both policies, others in another weather
    for cell in cells:
        mine = [t for t in trials if (t.policy, t.lighting) == (cell.policy, cell.lighting)]
        assert (cell.trials, cell.successes) == (len(mine), sum(t.success for t in mine))
        assert cell.twin_key == (cell.policy, "straight", "held-out+randomised")
    before = out.with_name("results_trials.csv").read_text()
    with exclusive_lock(out.with_name(".results.lock"), "x"), pytest.raises(InputError, match="is being written"):
        real_test.run([left], "straight", ["rain"], 3, out)
    third = max(t.seed for t in trials if t.lighting == "rain") + 1
    with pytest.raises(
        InputError, match=r"are compared with 'held-out\+randomised', not with 'sun'; give --twin-light"
    ):
        real_test.run([left], "straight", ["rain"], 3, out, "sun")
    real_test.run([left], "straight", ["rain"], 3, out, films=tmp_path / "films")
    assert {cell.twin_lighting for cell in read_results([out], twin)} == {"held-out+randomised"}  # as it was before
    assert [film.name for film in (tmp_path / "films").iterdir()] == [f"left_straight_rain_{third}.mp4"]
    after = out.with_name("results_trials.csv").read_text()
    assert after.startswith(before) and after.count("\n") == before.count("\n") + 1
    with pytest.raises(
        InputError, match=r"has trials of \{'place': 0, 'robot': 0.*; this call has .*give another --out"
    ):
        real_test.run([left], "straight", ["rain"], 4, out, setup=Setup(robot=1))
    out.with_name("results_setup.json").unlink()
    with pytest.raises(InputError, match="has trials of version 1 of the real test; this is version 4; give another"):
        real_test.run([left], "straight", ["rain"], 4, out)


def test_results_are_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for out in (Path(), tmp_path):
        with pytest.raises(InputError, match=r"is a folder; give a file to write, such as .*results\.csv"):
            real_test.run([written(tmp_path / "left", 0.9)], "straight", ["rain"], 1, out)
    assert [one.name for one in tmp_path.iterdir()] == ["left"]


def test_results_from_elsewhere_are_not_overwritten(gray, tmp_path):
    """The user's own results, written by hand: `drive` would replace them by its own rows."""
    out = tmp_path / "real.csv"
    out.write_text(text := "policy,lighting,trials,successes,twin_lighting\nmine,monday,10,8,held-out\n")
    with pytest.raises(
        InputError, match=r"10 trials of mine under monday, but real_trials\.csv has 0 of them; give another"
    ):
        real_test.run([written(tmp_path / "left", 0.9)], "straight", ["rain"], 1, out)
    assert out.read_text() == text


def test_another_file_under_a_known_name_is_refused(gray, tmp_path):
    left = written(tmp_path / "left", 0.9)
    real_test.run([left], "straight", ["rain"], 1, tmp_path / "results.csv")
    written(left, 0.5)
    with pytest.raises(InputError, match="another file under the name 'left'"):
        real_test.run([left], "straight", ["rain"], 2, tmp_path / "results.csv")


def test_a_command_that_failed_before_its_first_trial_can_be_given_again_corrected(gray, tmp_path):
    left, out = written(tmp_path / "left", 0.9), tmp_path / "results.csv"
    with pytest.raises(InputError, match="place -3"):
        Setup(place=-3)
    with pytest.raises(InputError, match="task 'strait'"):
        real_test.run([left], "strait", ["rain"], 1, out, setup=Setup(robot=1))
    written(left, 0.5)
    real_test.run([left], "straight", ["rain"], 1, out)
    assert len(read_trials(out.with_name("results_trials.csv"))) == 1


def test_a_weather_gets_one_rasterizer_for_all_policies(tmp_path, monkeypatch):
    """To make one takes as long as a trial."""
    made: list = []
    real_test.rasterizer.cache_clear()
    monkeypatch.setattr(real_test, "rasterizer_of", lambda place, light, *_: made.append(light) or Grey())
    left, right = written(tmp_path / "left", 0.9), written(tmp_path / "right", -0.9)
    real_test.run([left, right], "straight", ["rain", "haze"], 1, tmp_path / "results.csv")
    real_test.rasterizer.cache_clear()
    assert made == [weather("rain"), weather("haze")]


def test_trials_of_another_task_of_the_same_name_are_refused(gray, tmp_path):
    """Else its trials would count as driven, or both tasks would be summed in one row."""
    left, out, task = written(tmp_path / "left", 0.9), tmp_path / "results.csv", task_of_place(0, "straight")
    real_test.run([left], task, ["rain"], 1, out)
    record = out.with_name("results_tasks.json")
    before = record.read_text()
    # A line computed with other threads may differ in its last digits.
    real_test.run([left], replace(task, line=task.line + 1e-9), ["rain"], 2, out)
    for other in ("straight", replace(task, half_width=0.4), replace(task, line=task.line[:-1], goal=20.0)):
        with pytest.raises(InputError, match=r"results_trials\.csv has trials of another task 'straight'; give"):
            real_test.run([left], other, ["rain"], 2, out)
    assert record.read_text() == before
    real_test.run([left], "right_turn", ["rain"], 1, out)
    assert [one.task for one in read_trials(tmp_path / "results_trials.csv")] == ["straight"] * 2 + ["right_turn"]
    record.unlink()  # a table of an earlier version
    real_test.run([left], "straight", ["rain"], 2, out)


def test_a_task_whose_run_was_stopped_before_its_first_trial_may_change(gray, tmp_path, monkeypatch):
    left, out, task = written(tmp_path / "left", 0.9), tmp_path / "results.csv", task_of_place(0, "straight")
    with monkeypatch.context() as patched:
        patched.setattr(RealTest, "run_trial", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            real_test.run([left], task, ["rain"], 1, out)
    assert len(real_test.run([left], replace(task, half_width=0.4), ["rain"], 1, out)) == 1


def test_the_table_has_the_numbers_of_its_setup(gray, tmp_path, capsys):
    """Place, day, robot and camera, and their values outside training's ranges, which are printed as well."""
    left, out = written(tmp_path / "left", 0.9), tmp_path / "results.csv"
    given = ["drive", "--policy", str(left), "--task", "whole", "--trials", "1", "--out", str(out)]
    numbers = ["--place", "3", "--robot", "2", "--camera", "5", "--day", "21", "--lightings", "rain"]
    assert commands.main("reality", [*given, *numbers]) == 0
    said = capsys.readouterr().out
    assert "place 3, robot 2, camera 5; outside training's ranges: payload 23.97 (0 to 20), wheel_radius 0.9741" in said
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["lighting"] for row in rows] == ["rain", "day_21"]
    outside = "payload wheel_radius wheel_difference shift_left turn_up"
    for row, day in zip(rows, ("", "21"), strict=True):
        assert [row[name] for name in SETUP_COLUMNS] == ["3", day, "2", "5", outside]
    # A trial recorded later, without numbers, leaves them as they are.
    write_real_trials(read_trials(tmp_path / "results_trials.csv"), tmp_path / "t.csv", out, "sun")
    with out.open(newline="") as file:
        assert list(csv.DictReader(file)) == rows
    record = json.loads((tmp_path / "results_setup.json").read_text())
    assert (record["place"], record["robot"], record["camera"]) == (3, 2, 5) and record[
        "version"
    ] == REALITY_VERSION == 4
    assert record["robot_values"]["payload"] == pytest.approx(23.97, abs=0.01)
    assert read_results([out], [Cell("left", "whole", "held-out+randomised", 10, 5)])
    assert commands.main("reality", [*given, "--place", "3", "--robot", "-1"]) == 2
    assert "robot -1: expected 0 or more" in capsys.readouterr().err


def test_a_length_below_that_of_the_road_is_refused():
    with pytest.raises(InputError, match=r"--length 20: the road of place 3 has 47\.15 m; give more, or leave"):
        Setup(place=3, length=20.0)
    assert "place 3 of 60 m" in str(Setup(place=3, length=60.0))


def test_a_task_of_another_control_step_is_refused():
    policy = Policy("slow", lambda stacks: np.zeros((len(stacks), 1), np.float32), Control(control_timestep=0.2))
    assert task_for(policy, "straight", 0).control_timestep == 0.2
    with pytest.raises(InputError, match=r"task 'straight' has a control step of 0\.1 s, policy slow one of 0\.2 s"):
        task_for(policy, task_of_place(0, "straight"), 0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["photo", "--day", "-1"], "--day -1: expected 1 or more"),
        (["bag", "--lighting", "dwan"], "no lighting 'dwan' in the real test; did you mean 'dawn'?"),
        (
            ["bag", "--lighting", "dawn", "--task", "strait"],
            "task 'strait': place 0 has none of that name; did you mean",
        ),
        (["drive", "--policy", "lfet", "--task", "straight"], "lfet: no such policy file; did you mean 'left'?"),
        (["drive", "--policy", "left", "--task", "straight", "--scene", "s"], "--scene s: only a task of a .json file"),
        (["film", "--lightings", "sunn"], "no lighting 'sunn' in this place; did you mean 'sun'?"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "left", 0.9)
    assert commands.main("reality", [*arguments, "--out", "out.png"]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["left"]


@pytest.mark.parametrize("what", ["math:sqrt", "missing", "policy.zip", "policy.txt", "folder"])
def test_only_a_policy_file_drives(what, tmp_path, capsys):
    given = what if ":" in what else str(tmp_path / what)
    if what.startswith("policy"):
        Path(given).write_bytes(b"PK")
    if what == "folder":
        Path(given).mkdir()
    arguments = ["drive", "--policy", given, "--task", "straight", "--trials", "1", "--out", str(tmp_path / "r.csv")]
    assert commands.main("reality", arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and what in said
    assert not (tmp_path / "r.csv").exists()


# ---- drive log


class Recorder:
    """Stands in for a full-size rasterizer; records the poses and lightings that it was asked for."""

    def __init__(self, model, intrinsics, size, shadow_range=None) -> None:
        self.poses, self.size = [], size
        Recorder.last = self

    def __call__(self, pose):
        self.poses.append(pose)
        width, height = self.size
        return np.full((height, width, 3), 0.4, np.float32), np.full((height, width), 5.0, np.float32)


def test_the_robots_film_goes_down_the_road(tmp_path, monkeypatch):
    """The robot weaves and stays on the road, the film has the camera's full size, and no other file is written."""
    monkeypatch.setattr(true_world, "Rasterizer", Recorder)
    monkeypatch.setattr(true_world, "world_spec", lambda light, place: mujoco.MjSpec())
    monkeypatch.setattr(recordings, "_FPS", 1)
    path = tmp_path / "robot.mp4"
    assert commands.main("reality", ["onboard", "--out", str(path)]) == 0
    positions = np.array(Recorder.last.poses)[:, :3, 3]
    station, lateral = RoadLine().project(positions[:, :2])
    assert station[0] < 5.0 and 26.0 < station[-1] < 32.0 and np.all(np.diff(station)[5:] > 0.05)
    assert lateral.min() < -0.3 and lateral.max() > 0.3 and np.abs(lateral).max() < 1.0
    with av.open(str(path)) as film:
        assert (film.streams.video[0].width, film.streams.video[0].height) == native_size()
    assert [one.name for one in tmp_path.iterdir()] == ["robot.mp4"]


def test_a_photo_is_of_the_weather_asked_for(tmp_path, monkeypatch, capsys):
    lights: list = []
    monkeypatch.setattr(true_world, "Rasterizer", Recorder)
    monkeypatch.setattr(true_world, "world_spec", lambda light, place: lights.append(light) or mujoco.MjSpec())
    path = tmp_path / "photos" / "haze.png"
    assert commands.main("reality", ["photo", "--lighting", "haze", "--out", str(path)]) == 0
    assert lights == [WEATHER["haze"]] and read_image(path).shape == (*native_size()[::-1], 3)
    capsys.readouterr()
    assert commands.main("reality", ["photo", "--lighting", "haze", "--out", str(tmp_path / "haze.txt")]) == 2
    assert "expected a file ending in .png or .jpg" in capsys.readouterr().err
    assert commands.main("reality", ["onboard", "--out", str(tmp_path)]) == 2
    assert "expected a file ending in .mp4" in capsys.readouterr().err


def test_the_log_is_what_alignment_reads(tmp_path, monkeypatch, capsys):
    table = recordings.record_log(40.0, Setup())
    recordings.write_log(tmp_path / "drive.csv", table)
    windows = read_log(tmp_path / "drive.csv")
    assert len(windows) == 19 and windows.twist and windows.acceleration is not None
    assert np.ptp(table["cmd_v"]) > 0.8 and np.ptp(table["cmd_yaw_rate"]) > 1.5
    assert np.abs(table["y"]).max() < 2.2
    assert np.abs(np.diff(table["yaw"])).max() < 0.3
    content = (tmp_path / "drive.csv").read_bytes()
    with pytest.raises(ValueError):
        recordings.write_log(tmp_path / "drive.csv", {**table, "yaw": table["yaw"][:3]})
    assert (tmp_path / "drive.csv").read_bytes() == content and len(list(tmp_path.iterdir())) == 1
    first, again, other = (recordings.record_log(12.0, Setup(robot=number))["x"] for number in (0, 0, 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    monkeypatch.setattr(RealRobot, "step", lambda *given: pytest.fail("the robot drives before --out is checked"))
    for name in ("", "drive.txt", "drive"):
        assert commands.main("reality", ["log", "--out", str(tmp_path / name)]) == 2
        assert "expected a file ending in .csv" in capsys.readouterr().err
    for duration in (3.0, np.inf):
        with pytest.raises(InputError, match=f"duration = {duration:g} s; expected 10 to 36000"):
            recordings.record_log(duration, Setup())
