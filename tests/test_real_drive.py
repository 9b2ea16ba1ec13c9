"""The real test: whose robot, which road, which light, and that nothing but pictures goes in or rows come out."""

import ast
import hashlib
from dataclasses import asdict, replace
from pathlib import Path

import av
import mujoco
import numpy as np
import pytest
from dm_control.rl import control
from scipy.spatial.transform import Rotation

from twin.config import MjcfConfig
from twin.env.drivers import RouteDriver
from twin.env.options import parse_options
from twin.env.route_segments import STANDARD_TASKS
from twin.errors import InputError
from twin.evaluation.trials import Cell, read_results, read_trials
from twin.geometry.images import read_image
from twin.learn.policy import Control, Policy, load_policy, save_policy
from twin.learn.policy_network import Architecture
from twin.mjcf.world import arc_lengths, point_at
from twin.reality import place as places
from twin.reality import real_robot, real_test, recordings
from twin.reality.__main__ import main
from twin.reality.centerline import RoadLine
from twin.reality.lighting import LIGHTINGS, WEATHER
from twin.reality.real_robot import HiddenRobot, hidden_robot
from twin.reality.real_test import RealTest
from twin.robot import HuskyParams
from twin.runtime import exclusive_lock
from twin.sysid.logs import read_log

ROOT = Path(__file__).parents[1]
STEERING = parse_options({"action": "steering", "pixels": False})
NARROW = Architecture(convolutions=((2, 8, 8),), features=2, hidden=(2,))


def steering(yaw_rate: float, seen: list | None = None) -> Policy:
    """Always the same yaw rate [rad/s]; keeps what it is shown."""

    def act(stacks):
        if seen is not None:
            seen.append(stacks.copy())
        return np.full((len(stacks), 1), yaw_rate, np.float32)

    return Policy("constant", act, Control())


def written(folder: Path, yaw_rate: float) -> Path:
    """A policy folder that always steers alike."""
    weights = {name: np.zeros(shape, np.float32) for name, shape in NARROW.shapes().items()}
    weights["mean.bias"][:] = np.arctanh(yaw_rate)
    save_policy(folder, NARROW, Control(), weights, {})
    return folder


class Grey:
    """Stands for a raster where pictures do not matter."""

    def __call__(self, pose):
        return np.full((90, 160, 3), 0.4, np.float32), np.full((90, 160), 5.0, np.float32)


@pytest.fixture
def gray(monkeypatch):
    monkeypatch.setattr(real_test, "_rasterizer", lambda *_: Grey())


# ---- robot, road, light


def test_the_robot_is_one_and_another_than_the_published():
    mine, published = asdict(hidden_robot().params), asdict(HuskyParams())
    assert hidden_robot() == hidden_robot()
    for name in ("payload_mass", "friction", "wheel_radius", "servo_lag", "command_latency", "camera_latency"):
        assert mine[name] != published[name]
    assert (
        hidden_robot().camera.vibration > 0.0
        and hidden_robot().exposure_drift > 0.0
        and hidden_robot().camera.shutter > 0.0
    )


def test_the_same_commands_lead_elsewhere():
    """With the published robot on the same road: the training side cannot know where reality's goes."""
    ends = []
    for one in (hidden_robot(), HiddenRobot(HuskyParams(), (0.0, 0.0, 0.0), hidden_robot().camera, 0.0)):
        physics = real_robot.TrueRoad("straight", one, STEERING).physics.robot
        physics.set_pose(10.0, 0.0, 0.0)
        for k in range(40):
            physics.command(0.8, 0.6 if k < 20 else -0.6)
            physics.step()
        ends.append(physics.planar_pose)
    assert np.linalg.norm(ends[0][:2] - ends[1][:2]) > 0.05


def test_tasks_are_the_twins():
    """Straight 30 m and right turn 60 m of the filmed path, which is nowhere far from the road's centre."""
    for task in STANDARD_TASKS:
        one = real_robot.TrueRoad(task, hidden_robot(), STEERING)
        assert one.segment.length == pytest.approx({"straight": 30.0, "right_turn": 60.0}[task], abs=1.0)
        assert one.drive.half_width == MjcfConfig().half_width
    line = real_robot.true_route()
    assert arc_lengths(line)[-1] == pytest.approx(60.0, abs=1.0)
    assert np.abs(places.build().route.project(line[:, :2])[1]).max() < 0.35


def test_the_corridor_is_free_and_a_drive_along_it_arrives():
    """The robot's width beyond the corridor, nothing solid stands; who knows the way reaches the goal."""
    points = point_at(real_robot.true_route()[:, :2], np.arange(0.0, 60.0, 0.1))
    for obj in real_robot.place_on_test_day().objects:
        for solid in obj.solids:
            c, s = np.cos(solid.yaw), np.sin(solid.yaw)
            off = (points - solid.center[:2]) @ np.array([[c, -s], [s, c]])
            round_one = np.linalg.norm(off, axis=1) - solid.half[0]
            square = np.linalg.norm(np.maximum(np.abs(off) - solid.half[:2], 0.0), axis=1)
            distance = (round_one if solid.kind == "cylinder" else square).min()
            assert distance > MjcfConfig().half_width + 0.35, obj.name
    for task in STANDARD_TASKS:
        one = real_robot.TrueRoad(task, hidden_robot(), STEERING)
        environment = control.Environment(one.physics, one.drive, control_timestep=0.1)
        one.drive.seed(3)
        step, driver = environment.reset(), RouteDriver()
        while not step.last():
            step = environment.step(driver(environment, step))
        assert one.drive.cause == "goal"


def test_small_things_have_moved_and_nothing_else():
    filmed, later = places.build(), places.build(displaced=True)
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
    """Of fifteen days of which two in five are expected to be hazy; the air of those is as thick as stated."""
    sight = np.array([one.visibility for name, one in WEATHER.items() if name.startswith("day_")])
    hazy = np.isfinite(sight)
    assert len(sight) == 15 and 2 <= hazy.sum() <= 11
    assert np.all((sight[hazy] >= 60.0) & (sight[hazy] <= 400.0))


def test_the_camera_is_mounted_askew():
    """By the hidden angles about its axes right, up and back, beside one that is mounted as its parameters say."""
    mine = hidden_robot()
    assert np.abs(mine.camera_misalignment).max() > 0.1
    seen = []
    for one in (mine, replace(mine, camera_misalignment=(0.0, 0.0, 0.0))):
        physics = real_robot.TrueRoad("straight", one, STEERING).physics
        physics.robot.set_pose(10.0, 0.0, 0.3)
        seen.append(physics.camera_to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0]))  # axes right, up, back
    turned = Rotation.from_matrix(seen[1].T @ seen[0]).as_euler("XYZ", degrees=True)
    assert turned == pytest.approx(np.array(mine.camera_misalignment), abs=1e-4)


class Plain:
    """Stands for a raster before which everything is of one color and equally far [m]; notes from where it is asked."""

    def __init__(self, color: np.ndarray, distance: float) -> None:
        self._color, self._distance, self.poses = color, distance, []

    def __call__(self, pose):
        self.poses.append(pose)
        return np.full((90, 160, 3), self._color, np.float32), np.full((90, 160), self._distance, np.float32)


@pytest.fixture
def images(monkeypatch):
    """What the robot's camera sees of a raster in a weather at some times, standing still at the start of a trial."""
    policy = RealTest(steering(0.0), "straight")

    def see(raster: Plain, lighting: str, times: np.ndarray) -> np.ndarray:
        monkeypatch.setattr(real_test, "_rasterizer", lambda *_: raster)
        camera = policy.reset(lighting, 1)
        still = policy.road.physics.camera_to_world
        return np.stack([camera.capture(still, time) for time in times.tolist()])

    return see


@pytest.mark.parametrize("distance", [5.0, 60.0])
def test_haze_veils_what_the_robot_sees(images, monkeypatch, distance):
    """A dark wall in the haze looks like a wall in clear air that is as bright as wall and haze together."""
    light, dark, now = WEATHER["haze"], np.full(3, 0.1), np.zeros(1)
    seen = images(Plain(dark, distance), "haze", now).astype(float)
    left = np.exp(-distance / light.visibility)
    monkeypatch.setitem(WEATHER, "haze", replace(light, visibility=np.inf))
    veiled = images(Plain(left * dark + (1.0 - left) * np.array(light.horizon), distance), "haze", now).astype(float)
    assert np.abs(seen - veiled).max() <= 1.0
    assert seen.mean() > images(Plain(dark, distance), "haze", now).mean() + 10.0


def test_the_camera_shakes_on_the_road(images):
    """A robot that stands still looks in another direction in every picture, from the same place."""
    wall = Plain(np.full(3, 0.4), 5.0)
    images(wall, "rain", np.arange(0.0, 20.0, 0.1))
    poses = np.array(wall.poses)
    assert np.ptp(poses[:, :3, 3], axis=0).max() < 1e-9
    turns = Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).as_rotvec(degrees=True)
    assert turns.std(0).min() > 0.1
    assert turns.std(0) == pytest.approx(np.full(3, hidden_robot().camera.vibration), rel=0.3)


def test_the_cameras_exposure_drifts(images):
    """Of a wall as gray as ever, pictures get brighter and darker over seconds, not from one to the next."""
    times = np.arange(0.0, 590.0, 3.0)
    seen = images(Plain(np.full(3, 0.2), 5.0), "afternoon", times).mean((1, 2, 3))
    assert np.log(seen).std() > 0.04
    assert np.log(seen).std() == pytest.approx(hidden_robot().exposure_drift, rel=0.2)
    soon = images(Plain(np.full(3, 0.2), 5.0), "afternoon", times[:20] + 0.1).mean((1, 2, 3))
    assert np.abs(np.log(soon / seen[:20])).max() < 0.3 * np.ptp(np.log(seen))


def test_nothing_leaks():
    """No module outside `twin/reality` imports from it: robot, weather, road and trials belong to the test alone."""
    for path in (ROOT / "twin").rglob("*.py"):
        if path.parent.name == "reality":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            module = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
            assert not [name for name in names if f"{module}.{name}".startswith("twin.reality")], path


# ---- trials


def test_a_policy_sees_pictures_and_nothing_else(gray):
    seen: list = []
    trial = RealTest(steering(0.9, seen), "straight").run_trial("rain", 1)
    assert trial.cause == "out_of_bounds" and len(seen) == trial.steps
    assert all(stacks.shape == (1, 12, 90, 160) and stacks.dtype == np.uint8 for stacks in seen)
    assert np.array_equal(seen[0][0, :3], seen[0][0, 9:])  # at first the first picture four times
    assert np.array_equal(seen[4][0, 3:6], seen[5][0, :3])  # the newest last


def test_trials_repeat_and_differ_by_seed():
    """Pictures and outcome, through a fresh road and robot; in the true light."""
    sums, ends = [], []
    for seed in (1, 1, 2):
        frames: list = []
        ends.append(RealTest(steering(0.9), "straight").run_trial("evening", seed, frames.append))
        sums.append(hashlib.sha256(np.stack(frames).tobytes()).hexdigest())
    assert sums[0] == sums[1] != sums[2] and ends[0] == ends[1]
    assert ends[0].progress != ends[2].progress
    assert len(frames[0].shape) == 3 and 15 < np.stack(frames).mean() < 200


def test_the_seed_alone_decides_where_a_trial_starts(gray):
    """Not the trials before it, nor the policy, nor the light: policies are compared pair by pair."""
    one, starts = RealTest(steering(0.0), "straight"), []
    environment = one._environment
    for seed, lighting in ((5, "rain"), (6, "dawn"), (5, "haze")):
        one.run_trial(lighting, seed)
        one.road.drive.seed(seed)
        environment.reset()
        starts.append(one.road.physics.planar_pose)
    assert np.array_equal(starts[0], starts[2]) and not np.array_equal(starts[0], starts[1])


def test_results_are_the_sums_of_trials(gray, tmp_path):
    """As `twin.forecast` reads them; a second call drives only what is missing; a row of another file is refused."""
    left, ahead = written(tmp_path / "left", 0.9), written(tmp_path / "ahead", 0.001)
    out = tmp_path / "real" / "results.csv"
    stack = np.zeros((12, 90, 160), np.uint8)
    assert load_policy(left)(stack) == pytest.approx(0.9) and load_policy(ahead)(stack) == pytest.approx(0.001)
    real_test.run([left, ahead, left], "straight", ["rain", "haze", "rain"], 2, out)
    twin = [Cell(policy, "straight", "held-out+randomised", 10, 5) for policy in ("left", "ahead")]
    cells = read_results(out, twin)
    trials = read_trials(out.with_name("results_trials.csv"))
    assert len(trials) == 8 and len(cells) == 4
    starts = {(t.lighting, t.seed) for t in trials}
    assert len(starts) == len({seed for _, seed in starts}) == 4  # alike for both policies, others in other weather
    for cell in cells:
        mine = [t for t in trials if (t.policy, t.lighting) == (cell.policy, cell.lighting)]
        assert (cell.trials, cell.successes) == (len(mine), sum(t.success for t in mine))
        assert cell.twin_key == (cell.policy, "straight", "held-out+randomised")
    before = out.with_name("results_trials.csv").read_text()
    with exclusive_lock(out.with_name(".results.lock"), "x"), pytest.raises(InputError, match="is being written"):
        real_test.run([left], "straight", ["rain"], 3, out)
    third = max(t.seed for t in trials if t.lighting == "rain") + 1
    real_test.run([left], "straight", ["rain"], 3, out, "sun", films=tmp_path / "films")
    assert {cell.twin_lighting for cell in read_results(out, twin)} == {"held-out+randomised"}  # as it was before
    assert [film.name for film in (tmp_path / "films").iterdir()] == [f"left_straight_rain_{third}.mp4"]
    after = out.with_name("results_trials.csv").read_text()
    assert after.startswith(before) and after.count("\n") == before.count("\n") + 1
    written(left, 0.5)
    with pytest.raises(InputError, match="another file under the name 'left'"):
        real_test.run([left], "straight", ["rain"], 4, out)


@pytest.mark.parametrize("what", ["math:sqrt", "missing", "policy.zip", "policy.txt", "folder"])
def test_only_a_policy_file_drives(what, tmp_path, capsys):
    given = what if ":" in what else str(tmp_path / what)
    if what.startswith("policy"):
        Path(given).write_bytes(b"PK")
    if what == "folder":
        Path(given).mkdir()
    arguments = ["drive", "--policy", given, "--task", "straight", "--trials", "1", "--out", str(tmp_path / "r.csv")]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and what in said
    assert not (tmp_path / "r.csv").exists()


# ---- drive log


class Recorder:
    """Stands for a raster of full size; notes where it was asked to look from, and at what light."""

    def __init__(self, model, intrinsics, size, shadow_range=None) -> None:
        self.poses, self.size = [], size
        Recorder.last = self

    def __call__(self, pose):
        self.poses.append(pose)
        width, height = self.size
        return np.full((height, width, 3), 0.4, np.float32), np.full((height, width), 5.0, np.float32)


def test_the_robots_film_goes_down_the_road(tmp_path, monkeypatch):
    """It weaves, stays on the road, and is of the camera's full size; nothing but a film comes out."""
    monkeypatch.setattr(recordings, "Rasterizer", Recorder)
    monkeypatch.setattr(recordings.true_world, "world_spec", lambda light, place: mujoco.MjSpec())
    monkeypatch.setattr(recordings, "_FPS", 1)
    path = tmp_path / "robot.mp4"
    assert main(["onboard", "--out", str(path)]) == 0
    positions = np.array(Recorder.last.poses)[:, :3, 3]
    station, lateral = RoadLine().project(positions[:, :2])
    assert station[0] < 5.0 and 26.0 < station[-1] < 32.0 and np.all(np.diff(station)[5:] > 0.05)
    assert lateral.min() < -0.3 and lateral.max() > 0.3 and np.abs(lateral).max() < 1.0
    with av.open(str(path)) as film:
        assert (film.streams.video[0].width, film.streams.video[0].height) == hidden_robot().params.camera_size
    assert [one.name for one in tmp_path.iterdir()] == ["robot.mp4"]


def test_a_photo_is_of_the_weather_asked_for(tmp_path, monkeypatch, capsys):
    lights: list = []
    monkeypatch.setattr(recordings, "Rasterizer", Recorder)
    monkeypatch.setattr(
        recordings.true_world, "world_spec", lambda light, place: lights.append(light) or mujoco.MjSpec()
    )
    path = tmp_path / "photos" / "haze.png"
    assert main(["photo", "--lighting", "haze", "--out", str(path)]) == 0
    assert lights == [WEATHER["haze"]] and read_image(path).shape == (*hidden_robot().params.camera_size[::-1], 3)
    capsys.readouterr()
    assert main(["photo", "--lighting", "haze", "--out", str(tmp_path / "haze.txt")]) == 2
    assert "expected a .png or .jpg file" in capsys.readouterr().err
    assert main(["onboard", "--out", str(tmp_path)]) == 2
    assert "expected a .mp4 file" in capsys.readouterr().err


def test_the_log_is_what_alignment_reads(tmp_path):
    table = recordings.record_log(40.0)
    recordings.write_log(tmp_path / "drive.csv", table)
    windows = read_log(tmp_path / "drive.csv")
    assert len(windows) == 19 and windows.twist and windows.acceleration is not None
    assert np.ptp(table["cmd_v"]) > 0.8 and np.ptp(table["cmd_yaw_rate"]) > 1.5
    assert np.abs(table["y"]).max() < 2.2
    assert np.abs(np.diff(table["yaw"])).max() < 0.3
    assert np.array_equal(recordings.record_log(12.0)["x"], recordings.record_log(12.0)["x"])
    with pytest.raises(InputError, match="duration = 3 s"):
        recordings.record_log(3.0)
