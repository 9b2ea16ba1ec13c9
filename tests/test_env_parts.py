"""Parts of the environment: stretches of a route, lightings and their sets, randomization, trust, the scene's model,
recorded episodes, the audit and the film."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from audit import EVENTS, Findings, VisualMesh, audit
from films import video_info
from tiny_twin import tiny_field, tiny_twin
from tiny_world import tiny_world

import twin
from twin import commands, runtime
from twin.config import HELD_OUT, TRAINING, TaskConfig
from twin.env.domain_randomization import EVALUATION_RANGES, NominalModel, RandomizationSample, Ranges
from twin.env.drivers import PolicyDriver, PurePursuit, RouteDriver, find_callable
from twin.env.env_factory import EnvFactory, episode_spec
from twin.env.episode import record_episode
from twin.env.episode_lighting import EpisodeLighting, LightingSets, sample_lighting
from twin.env.options import parse_options
from twin.env.physics import HuskyPhysics
from twin.env.route_segments import find_task, scene_tasks
from twin.env.trust import Trust
from twin.env.vector_env import make_vector_env
from twin.errors import InputError
from twin.geometry.cameras import Rendering, Viewpoints
from twin.geometry.poses import look_at
from twin.mjcf.world import World
from twin.report.video_writer import read_frames
from twin.robot import TRACK, WHEEL_RADIUS, WHEELS, HuskyParams

SMALL = {"size": (32, 18)}


@pytest.mark.parametrize("period", [0.1, 0.02])
def test_the_scripted_driver_learns_the_track_ratio_at_any_control_period(period):
    """A robot turns half as fast as commanded: soon the driver commands twice the yaw rate."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    driver = PurePursuit(2.5 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]), 1.0, 3.0, period=period)
    pose = np.zeros(3)
    for _ in range(round(5.0 / period)):
        driver.update(pose)
        v, yaw_rate = driver.command(pose)
        pose = pose + period * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), 0.5 * yaw_rate])
    assert driver._gain == pytest.approx(2.0, abs=0.15)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


@pytest.fixture(scope="module")
def field():
    return tiny_field(())


# ---- stretches


def route_world(*pieces: tuple[float, float]) -> World:
    """A route of pieces (length [m], turn [rad], left positive)."""
    points, heading = [np.zeros(2)], 0.0
    for length, turn in pieces:
        count = max(1, round(length / 0.25))
        for _ in range(count):
            heading += turn / count
            points.append(points[-1] + length / count * np.array([np.cos(heading), np.sin(heading)]))
    return World(np.column_stack([points, np.zeros(len(points))]), 1.0, (0, 0, 0, 0), Path())


def test_standard_tasks_are_located_on_the_route():
    world = route_world((20.0, 1.2), (40.0, 0.0), (12.0, -np.pi / 2), (40.0, 0.0))
    found = scene_tasks(world)
    assert set(found) == {"route", "straight", "right_turn"}
    assert 14.0 < found["straight"].start < 30.0 and found["straight"].length == 30.0
    turn = found["right_turn"]
    assert turn.length == 60.0 and turn.start + 30.0 == pytest.approx(66.0, abs=1.0)  # the turn is in its middle
    assert found["route"].length == pytest.approx(112.0, abs=0.1)


def test_missing_task_lists_those_that_exist():
    world = route_world((20.0, 0.0), (12.0, np.pi / 2), (40.0, 0.0))
    with pytest.raises(InputError, match=r"'right_turn': .*no such segment of 60 m; there are .*straight \(30.0 m"):
        find_task("right_turn", world)
    short = route_world((17.0, 0.0))
    with pytest.raises(InputError, match=r"the longest is 17.0 m long and starts at 0.0 m; there are route"):
        find_task("straight", short)
    assert find_task("straight", route_world((29.0, 0.0))).length == pytest.approx(29.0, abs=0.01)


def test_configured_tasks_must_fit_the_route():
    world = route_world((17.0, 0.0))
    assert find_task("mine", world, (TaskConfig("mine", 3.0, 5.0),)).end == 8.0
    assert find_task("straight", world, (TaskConfig("straight", 1.0, 9.0),)).start == 1.0
    with pytest.raises(InputError, match=r"from 10 m to 20 m, but its route is 17\.00 m long"):
        find_task("mine", world, (TaskConfig("mine", 10.0, 10.0),))


# ---- lightings


def test_training_and_held_out_lights_never_mix(field):
    sets, rng = LightingSets(field), np.random.default_rng(5)
    for which in (TRAINING, HELD_OUT):
        for _ in range(20):
            assert sets.set_and_anchor(sets.sample(which, rng))[0] == which
    assert all(sets.set_and_anchor(field.embedding(name))[0] == TRAINING for name in field.lightings)
    # No two lightings of different sets are equal.
    train, held = ([sets._probe_colors(sets.sample(w, rng)) for _ in range(15)] for w in (TRAINING, HELD_OUT))
    gap = min(float(np.sqrt(((a - b) ** 2).mean())) for a in train for b in held)
    assert gap > 0.0


def test_between_training_and_held_out_lights_is_a_gap(field):
    """A lighting of a set is a fifth nearer to its own set than to the other one, and lightings between the sets belong
    to neither. Otherwise training would use lightings that are next to held-out ones.
    """
    sets, rng = LightingSets(field), np.random.default_rng(2)
    anchors = sets.anchors

    def distances(embedding: np.ndarray) -> dict[str, float]:
        colors = sets._probe_colors(embedding)
        far = np.sqrt(((anchors.probe_colors - colors) ** 2).mean(1))
        return {TRAINING: far[~anchors.held_out].min(), HELD_OUT: far[anchors.held_out].min()}

    for which, other in ((TRAINING, HELD_OUT), (HELD_OUT, TRAINING)):
        for _ in range(20):
            far = distances(sets.sample(which, rng))
            assert far[other] > 1.2 * far[which]
    (start, *_), (end, *_) = anchors.embeddings[~anchors.held_out], anchors.embeddings[anchors.held_out]
    way = [start + share * (end - start) for share in np.linspace(0.0, 1.0, 200).astype(np.float32)]
    between = [light for light in way if sets.set_and_anchor(light)[0] is None]
    ends = sets.set_and_anchor(way[0])[0], sets.set_and_anchor(way[-1])[0]
    assert len(between) > 5 and ends == (TRAINING, HELD_OUT)
    assert all(max(far.values()) < 1.3 * min(far.values()) for far in map(distances, between))


def test_anchors_are_sampled_equally_often(field):
    sets, rng = LightingSets(field), np.random.default_rng(3)
    for which, held_out in ((TRAINING, False), (HELD_OUT, True)):
        own = set(np.flatnonzero(sets.anchors.held_out == held_out))
        near = [sets.set_and_anchor(sets.sample(which, rng))[1] for _ in range(40 * len(own))]
        assert set(near) == own
        assert min(near.count(anchor) for anchor in own) > 20


def test_a_photo_added_later_moves_no_set():
    plain, added = tiny_field(()), tiny_field(())
    rng = np.random.default_rng(0)
    lights = [plain.sample_lighting(rng) for _ in range(30)]
    added.add_lightings({"photo": np.array([0.4, 0.5, 0.3, 0.0], np.float32)})
    before, after = LightingSets(plain), LightingSets(added)
    assert [before.set_and_anchor(light)[0] for light in lights] == [after.set_and_anchor(light)[0] for light in lights]


def test_sampled_lightings_follow_the_option(field):
    sets, rng = LightingSets(field), np.random.default_rng(1)
    assert np.array_equal(sample_lighting("day", False, 1.0, sets, rng).at(9.0), field.embedding("day"))
    mixed = sample_lighting("day:night:0.25", False, 1.0, sets, rng).at(0.0)
    np.testing.assert_allclose(mixed, 0.75 * field.embedding("day") + 0.25 * field.embedding("night"), atol=1e-6)
    names = {sample_lighting(("day", "night"), False, 1.0, sets, rng).name for _ in range(30)}
    assert names == {"day", "night"}
    assert sample_lighting(("day",), True, 10.0, sets, rng).name == "day → night"
    drifting = sample_lighting("day", True, 10.0, sets, rng)
    assert drifting.name == "day → night"
    np.testing.assert_allclose(drifting.at(5.0), 0.5 * (field.embedding("day") + field.embedding("night")), atol=1e-6)
    assert np.array_equal(drifting.at(99.0), field.embedding("night"))
    assert isinstance(sample_lighting("any", False, 1.0, sets, rng), EpisodeLighting)


# ---- randomization


def test_randomization_sample_changes_the_model_as_stated(scene):
    stage = EnvFactory.open(scene, "bend", {"pixels": False})
    physics, _ = stage.make_env(0)
    model, nominal = physics.model.ptr, NominalModel(stage.model)
    plain = model.geom_size[model.geom("front_left_tyre").id].copy()
    draw = RandomizationSample(1.2, 12.0, 0.05, (0.01, 0.0, -0.01), (0.0, 2.0, 0.0), 0.97)
    nominal.apply(draw, model)
    tyre = model.geom("front_left_tyre")
    assert tyre.friction[0] == pytest.approx(1.2 * world_friction(stage))
    np.testing.assert_allclose(tyre.size, plain * [0.97, 1.0, 0.97])
    assert model.body_subtreemass[model.body("base_link").id] == pytest.approx(
        stage.model.body_subtreemass[stage.model.body("base_link").id] + 12.0
    )
    camera, before = model.camera("front"), stage.model.camera("front")
    assert np.linalg.norm(camera.pos - before.pos) == pytest.approx(np.hypot(0.01, 0.01))
    turn = 2 * np.arccos(abs(camera.quat @ before.quat))
    assert np.rad2deg(turn) == pytest.approx(2.0, abs=1e-6)
    nominal.apply(RandomizationSample(), model)
    for name in ("geom_friction", "geom_size", "body_mass", "cam_pos", "cam_quat", "body_invweight0"):
        np.testing.assert_allclose(getattr(model, name), getattr(stage.model, name), atol=1e-12, err_msg=name)


def world_friction(stage: EnvFactory) -> float:
    return float(stage.world.robot.friction)


def test_smaller_wheels_drive_slower_and_latency_later(scene):
    def after_two_seconds(**ranges) -> float:
        fixed = {name: (value, value) for name, value in ranges.items()}
        still = {"friction": (1.0, 1.0), "payload": (0.0, 0.0), "latency": (0.0, 0.0), "wheel_radius": (1.0, 1.0)}
        still["wheel_difference"] = (0.0, 0.0)
        environment = twin.load(
            scene, "bend", 0, pixels=False, start_heading=0.0, randomise=Ranges(**(still | fixed)), time_limit=9.0
        )
        environment.reset()
        start = environment.physics.planar_pose[:2]
        for _ in range(20):
            environment.step([1.0, 0.0])
        return float(np.linalg.norm(environment.physics.planar_pose[:2] - start))

    plain = after_two_seconds()
    assert after_two_seconds(wheel_radius=0.9) == pytest.approx(0.9 * plain, rel=0.01)
    assert plain - after_two_seconds(latency=0.1) == pytest.approx(0.1, rel=0.15)
    assert after_two_seconds(payload=40.0) == pytest.approx(plain, rel=0.02)


def test_larger_wheels_on_the_right_turn_it_to_the_left(scene):
    """The yaw rate is that of a larger speed of the right wheels: the difference of the speeds over the effective
    track.
    """
    still = {"friction": (1.0, 1.0), "payload": (0.0, 0.0), "latency": (0.0, 0.0), "wheel_radius": (1.0, 1.0)}

    def turned(difference: float) -> float:
        ranges = Ranges(**still, wheel_difference=(difference, difference))
        environment = twin.load(
            scene, "bend", 0, pixels=False, start_heading=0.0, half_width=9.0, randomise=ranges, time_limit=9.0
        )
        environment.reset()
        before = environment.physics.planar_pose[2]
        for _ in range(30):
            environment.step([1.0, 0.0])
        return float(environment.physics.planar_pose[2] - before)

    straight, left, right = turned(0.0), turned(0.02), turned(-0.02)
    assert left - straight == pytest.approx(straight - right, rel=0.2)
    way = 2.5  # [m], from rest
    assert 0.02 * way / (2.5 * TRACK) < left - straight < 0.02 * way / TRACK


def test_invalid_ranges_are_refused():
    wrong = [
        {"wheel_difference": (-0.1, 3.0)},
        {"friction": (0.0, 1.0)},
        {"payload": (-1.0, 0.0)},
        {"latency": (0.2, 0.1)},
        {"extinction": (-0.1, 0.0)},
        {"camera_shift": ((0.0, 0.0), (0.1, 0.1))},
    ]
    for ranges in (*wrong, {"bystanders": (-1, 2)}):
        with pytest.raises(InputError):
            Ranges(**ranges)


def test_clear_air_is_more_common_than_fog():
    samples = [Ranges().sample(np.random.default_rng(k)) for k in range(2000)]
    extinction = np.array([one.extinction for one in samples])
    assert extinction.min() >= 0.0 and 0.045 < extinction.max() <= 0.05
    assert (extinction < 3.0 / 480.0).mean() == pytest.approx(0.5, abs=0.03)  # visibility above 480 m
    assert (extinction > 3.0 / 120.0).mean() == pytest.approx(0.2, abs=0.03)
    assert np.mean([one.shade for one in samples]) == pytest.approx(0.375, abs=0.02)  # the others stay uniform


def test_measured_parameters_are_held_in_evaluation():
    robot = HuskyParams(friction=0.6, wheel_radius=(0.162, 0.163), center_of_mass=(-0.05, 0.0, 0.06))
    draws = [EVALUATION_RANGES.for_robot(robot).sample(np.random.default_rng(k)) for k in range(9)]
    assert {(d.friction, d.wheel_radius, d.wheel_difference, d.payload) for d in draws} == {(1.0, 1.0, 0.0, 0.0)}
    others = [EVALUATION_RANGES.sample(np.random.default_rng(k)) for k in range(9)]
    for name in ("latency", "camera_shift", "camera_turn", "sunlight", "shade", "extinction", "bystanders"):
        assert [getattr(d, name) for d in draws] == [getattr(d, name) for d in others]
    assert len({d.latency for d in draws}) == 9
    seen = [
        EVALUATION_RANGES.for_robot(HuskyParams(camera_height=0.59, camera_yaw=0.4)).sample(np.random.default_rng(1))
    ]
    seen.append(EVALUATION_RANGES.for_robot(HuskyParams(camera_height=0.59)).sample(np.random.default_rng(1)))
    assert [any(d.camera_shift) for d in seen] == [False, False] and [any(d.camera_turn) for d in seen] == [False, True]
    assert EVALUATION_RANGES.for_robot(HuskyParams()) == EVALUATION_RANGES  # no parameter is known
    assert Ranges().for_robot(robot) == Ranges()  # training still samples it


# ---- the model of an episode


def test_parts_out_of_reach_change_no_result(tmp_path):
    world = tiny_world(tmp_path)
    whole = HuskyPhysics(world.model())
    spec = episode_spec(world, 0.0, 3.0, 0.5)
    small = HuskyPhysics(spec.compile())
    assert small.model.ngeom < whole.model.ngeom and small.model.ntex == 0
    for physics in (whole, small):
        physics.set_pose(0.0, 0.1, 0.05)
        for _ in range(20):
            physics.command(0.8, 0.1)
            physics.step()
    np.testing.assert_array_equal(whole.data.qpos, small.data.qpos)


def test_a_rolling_robot_goes_on_as_one_that_has_accelerated(tmp_path):
    """Body, wheels and lagging motors."""
    robot = HuskyParams(servo_lag=0.2, wheel_radius=(0.168, 0.164))
    model = twin.load_scene(tiny_twin(tmp_path, robot=robot)).world().model()
    assert model.na == 2
    accelerated, rolling = (HuskyPhysics(model, robot) for _ in range(2))
    accelerated.set_pose(0.0, 0.0, 0.1)
    rolling.set_pose(1.0, 0.1, 0.1, speed=0.7)
    wheels = [model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS]
    np.testing.assert_allclose(rolling.data.qvel[wheels], 0.7 / WHEEL_RADIUS)
    np.testing.assert_allclose(rolling.data.act, 0.7 / WHEEL_RADIUS)
    assert rolling.speed == pytest.approx(0.7) and rolling.yaw_rate == pytest.approx(0.0)
    for limit in ("max_speed", "max_wheel_speed"):
        limited = HuskyPhysics(model, replace(robot, **{limit: 0.4}))
        limited.set_pose(1.0, 0.1, 0.1, speed=0.7)
        assert limited.speed == pytest.approx(0.4) == limited.controller.speed
    for k in range(30):
        accelerated.command(0.7, 0.0)
        accelerated.step()
        if k >= 20:
            rolling.command(0.7, 0.0)
            rolling.step()
            assert rolling.speed == pytest.approx(accelerated.speed, abs=0.01)
            np.testing.assert_allclose(rolling.data.act, accelerated.data.act, atol=1e-3)
            np.testing.assert_allclose(rolling.data.qvel[wheels], accelerated.data.qvel[wheels], atol=0.1)


def test_the_robot_stands_on_a_hundred_meters_of_relief(tmp_path):
    physics = HuskyPhysics(tiny_world(tmp_path).model())
    with pytest.raises(InputError, match=r"start at x = 300\.0 m, y = 0\.0 m, beyond the ground"):
        physics.set_pose(300.0, 0.0, 0.0)
    model, points = physics.model, np.array([[0.0, 0.1], [2.0, -0.2]])
    model.hfield_data[:] = np.linspace(0.4, 0.8, len(model.hfield_data))
    low = physics._ground_height(points)
    model.hfield_size[0, 2] = 150.0
    high = physics._ground_height(points)
    base = float(model.geom("ground").pos[2])
    assert (high > base + 50.0).all()
    model.hfield_size[0, 2] = 1.0
    np.testing.assert_allclose(high - base, 150.0 * (physics._ground_height(points) - base), rtol=1e-3)
    assert (low < high).all()


def test_parts_within_reach_stay(tmp_path):
    """All parts whose distance from the corridor is less than the robot's length are kept."""
    world = tiny_world(tmp_path)
    kept = {geom.name for geom in episode_spec(world, 0.0, 10.0, 1.0).geoms}
    assert {"part_0000", "part_0001"} <= kept
    assert "part_0001" not in {geom.name for geom in episode_spec(world, 0.0, 1.0, 0.2).geoms}


def test_parts_behind_the_start_stay_as_far_as_a_robot_may_get_back(tmp_path):
    more = '[[task]]\nname = "end"\nstart = 8.5\nlength = 1.0\n'
    root, kept = tiny_twin(tmp_path, more=more), []
    for limit in (None, 30.0):
        model = EnvFactory.open(root, "end", {"pixels": False, "half_width": 0.2, "time_limit": limit}).model
        kept.append({model.geom(k).name for k in range(model.ngeom) if model.geom(k).name.startswith("part_")})
    assert kept[0] < kept[1]


# ---- trust


def test_trust_falls_with_distance_turn_and_missing_road():
    filmed = np.stack([look_at(np.array([x, 0.0, 1.0]), np.array([x + 1, 0.0, 1.0])) for x in np.arange(0, 10, 1.0)])
    trust = Trust(Viewpoints.of(filmed, np.ones(4), (16, 9)))

    def of(pose, opacity=1.0, lower=None):
        o = np.full((1, 18, 32), opacity, np.float32)
        if lower is not None:
            o[0, 9:, :lower] = 0.0
        return float(trust.of(pose[None], Rendering(np.zeros((1, 18, 32, 3), np.float32), o, o))[0])

    def at(y, yaw=0.0):
        eye = np.array([5.0, y, 1.0])
        return look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), 0.0]))

    assert of(at(0.0)) == of(at(0.9)) == 1.0
    falling = [of(at(y)) for y in (1.5, 2.5, 4.0, 6.0)]
    assert falling == sorted(falling, reverse=True) and falling[0] < 1.0 and falling[-1] == 0.0
    assert of(at(0.0, np.pi)) == 0.0 and 0.0 < of(at(0.0, 0.6)) < 1.0
    assert of(at(0.0), opacity=0.7) == pytest.approx(0.7)
    assert of(at(0.0), lower=2) < 0.95 and of(at(0.0), lower=8) == 0.0
    assert trust.offset(at(2.0)[None])[0] == pytest.approx(2.0)


# ---- episodes, drivers, films


def test_an_episode_is_recorded_to_its_end(scene):
    environment = twin.load(scene, "ahead", 0, obstacles=0, lighting="night", **SMALL)
    episode = record_episode(environment, RouteDriver())
    assert episode.success and episode.lighting == "night" and episode.progress[-1] == pytest.approx(3.5, abs=0.15)
    assert len(episode.times) == len(episode.actions) == len(episode.trust)
    assert episode.rewards.sum() == pytest.approx(0.1 * (len(episode.times) - 1))
    assert episode.obstacles == () and episode.randomisation["payload"] == 0.0


def test_a_policy_is_a_function_by_name(scene, tmp_path, monkeypatch):
    (tmp_path / "my_policy.py").write_text(
        "def act(pixels):\n    assert pixels.shape == (12, 18, 32)\n    return [1.0, 0.0]\n"
        "def bad(pixels):\n    return [1]\n"
    )
    monkeypatch.chdir(tmp_path)
    environment = twin.load(scene, "bend", 0, **SMALL)
    episode = record_episode(environment, PolicyDriver(find_callable("my_policy:act")), max_steps=5)
    np.testing.assert_array_equal(episode.actions[:5], np.tile([1.0, 0.0], (5, 1)))
    assert episode.cause == ""
    with pytest.raises(InputError, match="expected 2 numbers"):
        record_episode(environment, PolicyDriver(find_callable("my_policy:bad")), max_steps=1)
    for name in ("my_policy", "my_policy:nothing", "no_such_module:act"):
        with pytest.raises(InputError):
            find_callable(name)


@pytest.mark.slow
def test_the_film_shows_the_drive_to_its_end(scene, tmp_path, capsys):
    """This test is slow, because the chase camera's kernels compile on first use."""
    out = tmp_path / "drive.mp4"
    arguments = [str(scene.scene.root), "--task", "ahead", "--lighting", "night", "--out", str(out)]
    assert commands.main("film", arguments) == 0
    assert "goal after 3." in capsys.readouterr().out
    told = video_info(out)
    assert told["codec"] == "h264" and 20 < told["frames"] < 60
    assert commands.main("film", [str(scene.scene.root), "--task", "moon", "--quiet"]) == 2
    assert "task 'moon': unknown; there are route" in capsys.readouterr().err


def test_a_dataset_has_the_drives_that_are_filmed(scene, tmp_path, capsys):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    out = tmp_path / "drives"
    arguments = [str(scene.scene.root), "--task", "ahead"]
    assert commands.main("film", [*arguments, "--lerobot", str(out), "--episodes", "2", "--seed", "4"]) == 0
    assert capsys.readouterr().out.startswith("2 drives, ")
    rows = parquet.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    numbers, actions = np.array(rows["episode_index"]), np.float32(rows["action"])
    kept = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert kept["twin.seed"] == [4, 5]  # those that repeat the drives below
    for k in range(2):
        environment, seen = twin.load(scene, "ahead", 4 + k), []
        episode = record_episode(environment, RouteDriver(), lambda step, seen=seen: seen.append(step.observation))
        np.testing.assert_array_equal(actions[numbers == k], np.float32(episode.actions[:-1]))
        film = np.array(list(read_frames(out / f"videos/observation.images.front/chunk-000/file-{k:03d}.mp4")))
        pixels = np.array([one["pixels"][-1] for one in seen[:-1]])
        luma = [0.299, 0.587, 0.114]  # the codec halves the size of the colors' differences, not of this
        assert np.abs(film @ luma - pixels @ luma).mean() < 3.5  # 5 to 7 where it is a picture late
    assert commands.main("film", [*arguments, "--lerobot", str(out), "--quiet"]) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--seed", "-1"], "seed = -1: expected 0 or more"),
        (["--episodes", "2"], "--episodes 2: a film shows one drive"),
        (["--lerobot", "drives", "--episodes", "0"], "--episodes 0: expected 1 or more"),
        (["--lerobot", "drives", "--out", "a.mp4"], "--out names a film"),
        (["--lerobot", "no/drives"], "there is no folder no"),
        (["--obstacles", "²"], "--obstacles '²': expected 0 to 999999"),
        (["--obstacles", "-1"], "--obstacles '-1': expected 0 to 999999"),
        (["--task", "ahed"], "task 'ahed': unknown; did you mean 'ahead'?"),
        (["--out", "a.mp4/b.mp4"], "a.mp4: cannot be written to"),
        (["--lighting", "day:night:30"], "share 30 is not from 0 to 1"),
    ],
)
def test_impossible_films_are_refused_in_one_line(scene, tmp_path, monkeypatch, capsys, option, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.mp4").write_bytes(b"")
    assert commands.main("film", [str(scene.scene.root), "--task", "ahead", "--quiet", *option]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and words in error and error.count("\n") == 1


# ---- audit


def test_audit_finds_holes_only_where_they_are(scene, tmp_path):
    stage = EnvFactory.open(scene, "bend", {"pixels": False})
    found = audit(stage, hours=0.02)
    assert found.seconds >= 72.0 and found.touching > 0
    assert found.false_successes == 0 and found.events["episode_tunnelling"] == found.events["tunnelling"] == 0
    assert found.events["episode_wall_sliding"] == found.events["gap"] == found.events["climbing"] == 0
    assert set(found.summary()["steps_with"]) == {*EVENTS, *(f"episode_{name}" for name in EVENTS)}
    # A visual mesh across the road without convex parts is a gap.
    import audit as module

    seen = VisualMesh(stage.world)
    seen._points = np.array([[3.0, y, z] for y in np.arange(-2, 2, 0.1) for z in np.arange(0.3, 1.0, 0.05)])
    seen._tree = module.cKDTree(seen._points[:, :2])
    holes = Findings()
    module._episodes(stage, holes, seen, True, 20.0, np.random.default_rng(0), runtime.bar("", 1))
    assert holes.events["episode_gap"] > 0 and holes.false_successes == holes.episodes["goal"] > 0


def test_audit_detects_tunnelling_climbing_and_sliding(scene):
    from audit import EventDetector

    stage = EnvFactory.open(scene, "bend", {"pixels": False})
    robot = HuskyPhysics(episode_spec(stage.world, 0.0, 10.0, 5.0).compile(), stage.world.robot)
    detector = EventDetector(robot, VisualMesh(stage.world))
    robot.set_pose(1.0, 0.0, 0.0)
    assert detector.events() == []
    robot.data.qpos[2] += 0.15
    mujoco.mj_forward(robot.model, robot.data)
    assert detector.events() == ["climbing"]
    robot.set_pose(3.0, 1.5, 0.0)
    robot.data.qpos[1] += 0.3  # into the box beside the road
    robot.data.qvel[0] = 0.5
    mujoco.mj_forward(robot.model, robot.data)
    assert {"tunnelling", "wall_sliding"} <= set(detector.events())


_NO_ACTIONS = [
    *(np.ones(1), np.ones(3), np.ones((1, 2)), np.ones((0,)), 1.0, None, "ab", [[1.0], [1.0, 2.0]]),
    *(np.ones(2, complex), np.ones(2, bool), np.array([np.nan, 0.0]), np.array([0.0, np.inf]), [10**400, 0]),
]


@pytest.mark.parametrize("action", _NO_ACTIONS, ids=str)
def test_invalid_action_raises_and_the_episode_continues(scene, action):
    environments = []
    for _ in range(2):
        environments.append(twin.load(scene, "ahead", seed=3, pixels=False))
        environments[-1].reset()
    tried, other = environments
    with pytest.raises(ValueError, match=r"^action .*; expected finite numbers of shape \(2,\)$"):
        tried.step(action)
    good = [tried.step(np.array([0.5, 0.1])), other.step([0.5, 0.1])]
    assert good[0].reward == good[1].reward and not good[0].last()
    for name, value in good[0].observation.items():
        np.testing.assert_array_equal(value, good[1].observation[name])


def test_invalid_actions_of_a_vector_environment(scene):
    envs = make_vector_env(scene, "ahead", {"pixels": False, "action": "steering"}, [1, 2], 1)
    envs.begin([0, 1])
    for actions in (np.zeros((2, 2)), np.zeros(2), np.zeros((1, 1)), np.full((2, 1), np.nan), np.zeros((2, 1), bool)):
        with pytest.raises(ValueError, match=r"expected finite numbers of shape \(2, 1\)"):
            envs.step(actions)
    assert np.isfinite(envs.step(np.zeros((2, 1), int)).reward).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[
            ("size", (10**9, 10**9)),
            ("size", 5),
            ("size", "ab"),
            ("size", (90.5, 90)),
            ("stack", 10**9),
            ("stack", 2.5),
        ],
        *[("speed", "fast"), ("speed", float("nan")), ("speed", 10**400), ("time_limit", [1]), ("start_along", "x")],
        *[("half_width", float("inf")), ("start_offset", True), ("rewards", {"step": "much"}), ("rewards", None)],
        *[
            ("obstacles", -1),
            ("obstacles", 10**9),
            ("obstacles", [5]),
            ("lighting", 5),
            ("lighting", ()),
            ("device", 7),
        ],
        *[
            ("camera", "shaky"),
            ("randomise", "much"),
            ("pixels", "yes"),
            ("action", 3),
            ("observe", None),
            ("device", 7),
        ],
    ],
)
def test_invalid_options_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        parse_options({name: value})


def test_a_range_nested_very_deep_is_refused():
    deep = [0.5]
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(InputError, match="friction"):
        Ranges(friction=deep)


@pytest.mark.parametrize("pair", [5, "ab", (1,), (1, 2, 3), (0.0, float("inf")), (0, 10**400), None])
def test_a_range_is_two_numbers(pair):
    with pytest.raises(InputError, match="friction"):
        Ranges(friction=pair)
