"""Environments: interfaces of dm_env, Gymnasium and stable-baselines3, rewards, starts and rendering."""

import copy
import json
import pickle
import re
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from dm_env import StepType
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.config import CAUSES, ObstacleConfig
from twin.env.domain_randomization import Ranges
from twin.env.drivers import RouteDriver
from twin.env.env_factory import EnvFactory
from twin.env.episode_lighting import mixture_text
from twin.env.gym_env import DriveEnv, DriveVectorEnv
from twin.env.mujoco_renderer import chase_poses
from twin.env.obstacles import RADIUS
from twin.env.options import parse_options
from twin.env.picture_effects import CameraOptions
from twin.env.task import Motion
from twin.env.vector_env_local import LocalVectorEnv
from twin.errors import InputError
from twin.geometry.images import resize
from twin.nerf.lightings import Lightings
from twin.robot import HuskyParams

SMALL = {"size": (32, 18)}
OPTION_SETS = {
    "paper": SMALL,
    "steering": SMALL | {"action": "steering", "stack": 1, "lighting": "day"},
    "night": SMALL | {"lighting": "day:night:0.7", "lighting_drift": True, "randomise": True},
    "crowded": SMALL | {"obstacles": 2, "lighting": ("day", "night"), "control_timestep": 0.05},
    "state": {"pixels": False, "randomise": True, "rewards": {"progress": 1.0, "cross_track": -0.1}},
    "both": SMALL | {"state": "privileged"},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


def rollout(environment, seed: int, steps: int = 25) -> tuple[list, np.ndarray]:
    """Time steps under random actions, and the poses."""
    environment.task.seed(seed)
    rng = np.random.default_rng(seed)
    spec = environment.action_spec()
    out, poses = [environment.reset()], []
    for _ in range(steps):
        out.append(environment.step(rng.uniform(spec.minimum, spec.maximum)))
        poses.append(np.array(environment.physics.data.qpos))
    return out, np.array(poses)


def driven(environment, driver, seed: int | None = None):
    """The last time step of an episode."""
    if seed is not None:
        environment.task.seed(seed)
    step = environment.reset()
    while not step.last():
        step = environment.step(driver(environment, step))
    return step


@pytest.mark.parametrize(
    ("task", "name"), [*(("bend", name) for name in OPTION_SETS), ("ahead", "paper"), ("route", "crowded")]
)
def test_specs_hold_and_seeds_repeat(scene, task, name):
    environment = twin.load(scene, task, **OPTION_SETS[name])
    spec = environment.observation_spec()
    first, poses = rollout(environment, 3)
    assert first[0].step_type is StepType.FIRST and first[0].reward is None and first[0].discount is None
    for step in first:
        assert set(step.observation) == set(spec)
        for key, value in step.observation.items():
            spec[key].validate(value)
        if step.step_type is not StepType.FIRST:
            environment.discount_spec().validate(np.float64(step.discount))
            assert np.isfinite(step.reward)
    again, poses_again = rollout(environment, 3)
    np.testing.assert_array_equal(poses, poses_again)
    for a, b in zip(first, again, strict=True):
        assert a.step_type == b.step_type and a.reward == b.reward and a.discount == b.discount
        for key in spec:
            np.testing.assert_array_equal(a.observation[key], b.observation[key])
    _, poses_other = rollout(environment, 4)
    assert not np.array_equal(poses, poses_other)


@pytest.mark.parametrize("name", OPTION_SETS)
def test_gymnasium_and_sb3_accept_it(scene, name):
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    environment = gymnasium.make(
        "twin/Drive-v0", scene=scene, task="bend", render_mode="rgb_array", **OPTION_SETS[name]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "The environment .* is different from the unwrapped version")
        warnings.filterwarnings("ignore", "The minimal resolution for an image is 36x36.*")
        check_env(environment.unwrapped)
        sb3_check_env(environment.unwrapped, skip_render_check=True)
    _, info = environment.reset(seed=1)
    for _ in range(3):
        *_, info = environment.step(environment.action_space.sample())
    wanted = {"cause", "is_success", "progress", "cross_track", "randomisation"}
    assert wanted | (set() if name == "state" else {"lighting", "trust"}) <= set(info)
    json.dumps(info)
    assert environment.render().shape == ((360, 640, 3) if name == "state" else (18, 32, 3))


@pytest.mark.parametrize("name", OPTION_SETS)
def test_vector_environment_equals_single_environments(scene, name):
    """Every step is equal, pictures included, also across the ends of episodes."""
    options = OPTION_SETS[name] | {"time_limit": 0.8}
    envs = LocalVectorEnv(EnvFactory.open(scene, "bend", options), [5, 6, 7])
    single = twin.load(scene, "bend", seed=6, **options)
    rng = np.random.default_rng(0)
    spec = single.action_spec()
    envs.begin(range(3))
    step = single.reset()
    for _ in range(24):
        if envs.pixels:
            np.testing.assert_array_equal(envs.pixels.stacks[1].transpose(0, 2, 3, 1), step.observation["pixels"])
        else:
            np.testing.assert_array_equal(envs.observation()[1], np.concatenate(list(step.observation.values())))
        actions = rng.uniform(-1, 1, (3, envs.action_size))
        out = envs.step(actions)
        step = single.step(spec.minimum + (actions[1] + 1) / 2 * (spec.maximum - spec.minimum))
        assert out.reward[1] == step.reward and out.over[1] == step.last()
        assert out.truncated[1] == (step.last() and step.discount == 1.0)
        np.testing.assert_array_equal(envs.physics[1].data.qpos, single.physics.data.qpos)
        if out.over.any():
            envs.begin(np.flatnonzero(out.over).tolist())
        if step.last():
            step = single.reset()
    envs.close()


@pytest.mark.parametrize(("state", "size"), [("odometry", 2), ("privileged", 10)])
def test_images_and_state_come_as_a_dict(scene, state, size):
    from stable_baselines3 import PPO

    from twin.learn.sb3_env import DriveVecEnv

    options = SMALL | {"time_limit": 0.5, "lighting": "day"}
    single = gymnasium.make("twin/Drive-v0", scene=scene, task="bend", state=state, **options)
    plain = gymnasium.make("twin/Drive-v0", scene=scene, task="bend", **options)
    numbers = gymnasium.make("twin/Drive-v0", scene=scene, task="bend", pixels=False, time_limit=0.5)
    assert single.observation_space["state"].shape == (size,) and single.observation_space["state"].is_bounded()
    for environment in (single, plain, numbers):
        environment.reset(seed=3)
    for _ in range(4):
        action = single.action_space.sample()
        seen, images, whole = (environment.step(action)[0] for environment in (single, plain, numbers))
        np.testing.assert_array_equal(seen["pixels"], images)
        np.testing.assert_array_equal(seen["state"], whole[:size])
    vectors = DriveVecEnv(scene, "bend", 2, seed=1, state=state, **options)
    vectors.reset()
    for _ in range(5):
        out, _, done, infos = vectors.step(np.zeros((2, 2), np.float32))
    assert done.all() and out["state"].shape == (2, size)
    assert infos[1]["terminal_observation"]["state"].shape == (size,)
    large = DriveVecEnv(scene, "bend", 2, state=state, **(options | {"size": (40, 40)}))
    PPO("MultiInputPolicy", large, n_steps=4, batch_size=4, n_epochs=1).learn(8)
    with pytest.raises(InputError, match="with pixels=False"):
        gymnasium.make("twin/Drive-v0", scene=scene, task="bend", pixels=False, state=state)


def test_vector_environments_reset_in_the_same_step(scene):
    from stable_baselines3 import SAC

    from twin.learn.sb3_env import DriveVecEnv

    options = SMALL | {"time_limit": 0.5, "lighting": "day"}
    many = gymnasium.make_vec(
        "twin/Drive-v0", 2, vectorization_mode="vector_entry_point", scene=scene, task="bend", **options
    )
    first, _ = many.reset(seed=1)
    assert first.shape == (2, 12, 18, 32) and first.dtype == np.uint8
    for k in range(5):
        out, _, terminated, truncated, info = many.step(np.zeros((2, 2), np.float32))
        assert not terminated.any() and truncated.all() == (k == 4)
    assert info["final_info"]["cause"].tolist() == ["timeout", "timeout"] and info["final_obs"][0].shape == (12, 18, 32)
    assert (info["cause"] == "").all() and not np.array_equal(info["final_obs"][0], out[0])
    many.close()
    for call in (many.reset, lambda: many.step(np.zeros((2, 2)))):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="is closed; make a new one"):
            call()
    vectors = DriveVecEnv(scene, "bend", 2, seed=1, **options)
    vectors.set_options({"lighting": "night"})
    with pytest.raises(
        InputError, match=r"options of reset = .*; expected none: give them to gymnasium.make or the con"
    ):
        vectors.reset()
    vectors.set_options(None)
    np.testing.assert_array_equal(vectors.reset(), first)
    for _ in range(5):
        out, _, done, infos = vectors.step(np.zeros((2, 2), np.float32))
    assert done.all() and infos[0]["TimeLimit.truncated"] and infos[0]["terminal_observation"].shape == (12, 18, 32)
    assert infos[0]["episode"]["l"] == 5 and infos[0]["episode"]["r"] == pytest.approx(4 * 0.1 - 5.0)
    small = SAC("CnnPolicy", DriveVecEnv(scene, "bend", 2, **(options | {"size": (40, 40)})), buffer_size=200)
    small.learn(8)


def test_every_cause_ends_an_episode_with_its_reward_and_discount(scene, tmp_path):
    ends, times = {}, {}

    def ended(name: str, action, options, where=scene, before=None):
        environment = twin.load(where, "bend", seed=0, pixels=False, start_offset=0.0, start_heading=0.0, **options)
        step = environment.reset()
        while not step.last():
            if before:
                before(environment)
            last, step = step, environment.step(np.array(action))
        assert environment.task.cause == name, environment.task.info(environment.physics)
        assert last.reward is None or last.reward == pytest.approx(0.1)
        times[name] = environment.physics.time()
        ends[name] = step.reward, step.discount

    def tip(environment):
        environment.physics.data.qvel[3] = 8.0

    ended("collision", [1.0, 0.0], {"obstacles": (ObstacleConfig("it", "box", station=3.0),)})
    ended("out_of_bounds", [1.0, 0.5], {})
    ended("timeout", [0.5, 0.0], {"time_limit": 2.0})
    ended("stuck", [0.0, 0.0], {})
    ended("rollover", [0.0, 0.0], {}, before=tip)
    environment = twin.load(scene, "bend", seed=0, pixels=False)
    step = driven(environment, RouteDriver())
    ends["goal"] = step.reward, step.discount
    assert environment.task.cause == "goal" and environment.task.progress >= 9.5
    assert set(ends) == set(CAUSES)
    assert times["stuck"] == pytest.approx(5.0, abs=1e-6)  # though the clock's sum of steps is short of it
    assert ends == {
        "collision": (-4.0, 0.0),
        "out_of_bounds": (-5.0, 0.0),
        "timeout": (-5.0, 1.0),
        "stuck": (-5.0, 0.0),
        "rollover": (-5.0, 0.0),
        "goal": (pytest.approx(0.1), 0.0),
    }


@pytest.mark.parametrize("action, act", [("twist", [1.0, 0.25]), ("steering", [0.25])])
def test_rewards_of_steering_and_cross_track(scene, action, act):
    """Every action commands half of the largest yaw rate (0.5 rad/s) to one side."""
    terms = {"step": 1.0, "steering": -0.5, "cross_track": -0.2}
    options = {"pixels": False, "action": action, "yaw_rate": 0.5, "rewards": terms, "start_offset": 0.3}
    environment = twin.load(scene, "bend", seed=0, **options)
    environment.reset()
    for sign in (1.0, -1.0):
        asked = np.array(act) * ([1.0] * (len(act) - 1) + [sign])
        reward = environment.step(asked).reward
        off = abs(environment.task.cross_track) / environment.task.half_width
        assert off > 0.01
        assert reward == pytest.approx(1.0 - 0.5 * 0.5**2 - 0.2 * off)
    straight = environment.step(np.array([*act[:-1], 0.0])).reward
    off = abs(environment.task.cross_track) / environment.task.half_width
    assert straight == pytest.approx(1.0 - 0.2 * off)


def test_the_route_driver_arrives_and_driving_straight_on_does_not(scene):
    environment = twin.load(scene, "bend", pixels=False, randomise=True)
    causes = []
    for seed in range(10):
        driven(environment, RouteDriver(), seed)
        causes.append(environment.task.cause)
    assert causes == ["goal"] * 10
    for seed in range(3):
        driven(environment, lambda environment, step: environment.action_spec().maximum * (1, 0), seed)
        assert environment.task.cause == "out_of_bounds"


def test_starts_are_spread_as_stated(scene):
    environment = twin.load(scene, "ahead", pixels=False, start_offset=0.25, start_heading=8.0)
    route = environment.task.world.route
    offsets, turns, along = [], [], []
    for seed in range(200):
        environment.task.seed(seed)
        step = environment.reset()
        offsets.append(step.observation["cross_track"][0])
        turns.append(np.rad2deg(step.observation["heading_error"][0]))
        along.append(environment.physics.planar_pose[0] - route[0, 0])
    assert np.abs(offsets).max() < 0.27 and np.abs(turns).max() < 8.5
    assert np.std(offsets) == pytest.approx(0.25 / np.sqrt(3), rel=0.1)
    assert np.std(turns) == pytest.approx(8.0 / np.sqrt(3), rel=0.1)
    assert np.allclose(along, 0.5, atol=0.1)


def test_start_along_moves_starts_along_and_beside_the_route(scene):
    environment = twin.load(scene, "route", pixels=False, start_along=0.6)
    length, half_width = environment.task.segment.length, environment.task.half_width
    starts, offsets, turns = [], [], []
    for seed in range(120):
        environment.task.seed(seed)
        environment.reset()
        info = environment.task.info(environment.physics)
        starts.append(info["start"])
        offsets.append(info["cross_track"])
        turns.append(environment.task.state(environment.physics)[3])
        assert info["progress"] == pytest.approx(info["start"], abs=0.1) and environment.task.cause == ""
        assert environment.physics.speed == pytest.approx(1.0, abs=1e-3)
    share = np.array(starts) / length
    assert 0.5 < share.max() <= 0.6 and 0.0 < share.min() < 0.05 and np.std(share) > 0.1
    assert 0.7 < np.abs(offsets).max() / half_width < 0.82
    assert 17.0 < np.rad2deg(np.abs(turns).max()) < 21.0
    for wrong in ({"start_along": 1.0}, {"along_time": 0.0}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            twin.load(scene, "route", pixels=False, **wrong)


@pytest.mark.parametrize(("along", "speed"), [(0.6, 0.8), (0.6, 0.3), (0.0, 0.8)])
@pytest.mark.parametrize("randomise", [None, Ranges(latency=(0.38, 0.38))])  # longer than the time-out
def test_robots_that_start_along_the_route_are_rolling(scene, along, speed, randomise):
    """As if they had been driving for a while; others accelerate from rest."""
    options = {"start_along": along, "speed": speed, "along_time": 2.0, "randomise": randomise}
    environment = twin.load(scene, "route", pixels=False, start_heading=0.0, **options)
    for seed in range(4):
        environment.task.seed(seed)
        environment.reset()
        speeds = [environment.physics.speed]
        wheels = [environment.physics.data.ctrl.copy()]
        for _ in range(8):
            environment.step([speed, 0.0])
            speeds.append(environment.physics.speed)
            wheels.append(environment.physics.data.ctrl.copy())
        if along:
            assert speeds == pytest.approx([speed] * 9, rel=0.06)  # wheels and slopes differ
            assert np.ptp(wheels) < 1e-6
        else:
            assert abs(speeds[0]) < 1e-3 and speeds[-1] > 0.7 * speed


@pytest.mark.parametrize(("along", "time", "count"), [(0.6, 3.0, 30), (0.6, 0.8, 8), (0.0, 0.8, 40)])
def test_episodes_that_start_along_the_route_are_cut_off(scene, along, time, count):
    options = {"pixels": False, "start_along": along, "along_time": time, "start_offset": 0.0, "start_heading": 0.0}
    environment = twin.load(scene, "route", seed=1, **options)
    step, steps = environment.reset(), 0
    while not step.last() and steps < count:
        step, steps = environment.step([0.1, 0.0]), steps + 1
    assert steps == count and environment.task.cause == "" and step.last() == (along > 0.0)
    assert step.reward == 0.1 and step.discount == 1.0


def test_the_state_has_the_nearest_obstacle_in_reach(scene):
    """Until the robot has passed it; not beyond 6 m, nor where the robot cannot touch it."""
    still = {"start_offset": 0.0, "start_heading": 0.0, "pixels": False}
    cones = [
        ObstacleConfig("far", "cone", 9.0, 0.2),
        ObstacleConfig("near", "box", 3.0, -0.3, size=(0.6, 0.8, 0.5)),
        ObstacleConfig("aside", "cone", 2.0, 3.0),
        ObstacleConfig("walker", "pedestrian", 4.5, 3.0, to=(4.5, -3.0), speed=1.0),
    ]

    def told(obstacles: list[ObstacleConfig], steps: int = 0) -> list[float]:
        environment = twin.load(scene, "route", obstacles=obstacles, **still)
        out = environment.reset()
        for _ in range(steps):
            out = environment.step([1.0, 0.0])
        own = environment.task.state(environment.physics)
        np.testing.assert_array_equal(own[7:], out.observation["obstacle"])
        return (own[7:] + np.array([own_station(environment), own[2], 0.0])).tolist()

    def own_station(environment) -> float:
        return environment.task.progress + environment.task.segment.start

    start = twin.load(scene, "route", **still)
    start.reset()
    assert told([]) == pytest.approx([6.0 + own_station(start), start.task.cross_track, 0.0], abs=0.02)
    assert told(cones[:1]) == told([])  # too far away
    assert told(cones[:3]) == pytest.approx([3.0, -0.3, 0.5], abs=0.02)
    assert told(cones[2:3]) == told([])
    assert told(cones[2:]) == told([])  # the walker is still aside
    assert told([cones[0]], steps=45)[:2] == pytest.approx([9.0, 0.2], abs=0.05)
    behind, beside, ahead = (ObstacleConfig(f"c{k}", "cone", 2.0 + k, 0.8) for k in (-1.0, -0.5, 1.0))
    here = own_station(start)
    passed = [replace(one, station=one.station + here - 2.0) for one in (behind, beside, ahead)]
    assert told(passed)[:2] == pytest.approx([here - 0.5, 0.8], abs=0.03)
    assert told([passed[0], passed[2]])[:2] == pytest.approx([here + 1.0, 0.8], abs=0.03)
    assert told(passed[:1]) == told([])
    crossing = told([replace(cones[3], station=6.0, to=(6.0, -3.0))], steps=25)
    assert crossing == pytest.approx([6.0, 0.5, RADIUS["pedestrian"]], abs=0.05)


def test_lighting_and_robot_do_not_change_the_start(scene):
    """So two policies, or two lightings, can be compared in the same episodes."""
    poses = []
    for options in ({}, {"lighting": "night"}, {"randomise": Ranges(payload=(0.0, 0.0))}, {"obstacles": 1}):
        environment = twin.load(scene, "bend", seed=9, **SMALL, **options)
        environment.reset()
        poses.append(environment.physics.planar_pose)
    for pose in poses[1:]:
        np.testing.assert_allclose(pose, poses[0], atol=0.02)


def test_scene_obstacles_exist_and_move(tmp_path):
    more = '[[obstacle]]\nname = "walker"\nkind = "pedestrian"\nstation = 5.0\nlateral = -0.8\nto = [5.0, 0.8]\n'
    environment = twin.load(tiny_twin(tmp_path, more=more), "bend", seed=0, pixels=False)
    environment.reset()
    body = environment.physics.data.ptr.body("obstacle_walker")
    before = body.xpos.copy()
    for _ in range(5):
        environment.step([0.0, 0.0])
    assert np.linalg.norm(body.xpos - before) == pytest.approx(0.5 * 1.2, rel=0.1)
    assert environment.task.obstacles[0].name == "walker"
    none = twin.load(tmp_path, "bend", seed=0, pixels=False, obstacles=())
    none.reset()
    assert none.task.obstacles == ()


@pytest.mark.parametrize("make", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_like_its_original(tmp_path, make):
    """Commands under way, the controller, delayed pictures and moving obstacles are copied, too."""
    walker = ObstacleConfig("walker", "pedestrian", station=6.0, lateral=-2.5, to=(6.0, 2.5), speed=1.0)
    robot = HuskyParams(controller="ros2", command_latency=0.15, camera_latency=0.1)
    options = {"pixels": False, "obstacles": [walker], "randomise": True, "control_timestep": 0.05}
    env = DriveEnv(tiny_twin(tmp_path, robot=robot), "bend", **options)
    env.reset(seed=1)
    for _ in range(7):
        env.step(np.array([1.0, 0.5]))
    other = make(env)
    before, copies = env.vector_env.physics[0], [other.vector_env.physics[0], env.vector_env.physics[0].copy()]
    for _ in range(10):
        one, another = env.step(np.array([1.0, -0.5])), other.step(np.array([1.0, -0.5]))
        np.testing.assert_array_equal(one[0], another[0])
        assert one[1:] == another[1:]
        copies[1].robot.command(*env.vector_env.tasks[0].commands(np.array([[1.0, -0.5]]))[0])
        copies[1].step(25)
        for physics in copies:
            np.testing.assert_array_equal(physics.data.qpos, before.data.qpos)
            np.testing.assert_array_equal(physics.data.mocap_pos, before.data.mocap_pos)
            np.testing.assert_array_equal(physics.camera_to_world, before.camera_to_world)


def test_unknown_tasks_and_options_are_refused(scene):
    with pytest.raises(InputError, match=r"'straight': the route .* no such segment of 30 m; .* there are .*bend \(10"):
        twin.load(scene, "straight")
    with pytest.raises(InputError, match="seed = -1; expected None, or a whole number of 0 or more"):
        twin.load(scene, "bend", seed=-1, pixels=False)
    with pytest.raises(InputError, match="did you mean 'lighting'"):
        twin.load(scene, "bend", lightning="day")
    with pytest.raises(InputError, match="unknown; the field has day, night"):
        twin.load(scene, "bend", lighting="noon")
    for name in ("obstacles", "state"):
        with pytest.raises(InputError, match=rf"{name} = array\(\[1, 2\]\); expected"):
            twin.load(scene, "bend", **{name: np.array([1, 2])})
    with pytest.raises(InputError, match=r"9 obstacles on a route of 10\.0 m; expected at most [1-8]"):
        twin.load(scene, "bend", obstacles=9)
    assert parse_options({"obstacles": np.int64(3)}) == parse_options({"obstacles": 3})
    with pytest.raises(InputError, match=r"control_timestep = 0\.015; expected a multiple of 0\.002 \[s\]"):
        twin.load(scene, "bend", control_timestep=0.015)
    for camera in ({"shutter": -0.02}, {"vibration": -1.0}, {"blur_samples": 0}, {"blur_samples": 2.5}):
        with pytest.raises(InputError, match=r"camera = .*; expected None, or CameraOptions of numbers from 0"):
            twin.load(scene, "bend", camera=CameraOptions(**camera))
    for options in ({"action": "jump"}, {"stack": 0}, {"control_timestep": 0.5}, {"rewards": {"fame": 1.0}}):
        with pytest.raises(InputError):
            twin.load(scene, "bend", **options)


def test_a_slow_robot_has_time_to_arrive(scene, tmp_path):
    for speed in (1.5, 3.0):
        environment = twin.load(scene, "bend", seed=0, pixels=False, speed=speed)
        driven(environment, RouteDriver())
        assert environment.task.cause == "goal"
    for top in (0.4, 0.5):
        (tmp_path / f"{top}").mkdir()
        slow = twin.load_scene(tiny_twin(tmp_path / f"{top}", robot=HuskyParams(max_speed=top)))
        environment = twin.load(slow, "bend", seed=0, pixels=False)
        driven(environment, RouteDriver())
        assert environment.task.cause == "goal"
    assert twin.load(scene, "bend", pixels=False).task.time_limit == 20.0  # twice the time of 10 m at 1 m/s


def test_the_sampled_lighting_is_named(scene):
    """Gymnasium names the mixture of each episode; the name in tables stays that of the set."""
    options = SMALL | {"time_limit": 0.3}
    mixture = r"(day|night) \d\.\d\d(, (day|night) \d\.\d\d)?"
    for lighting, pattern in (
        ("training", f"training: {mixture}"),
        ("held-out", f"held-out: {mixture}"),
        ("any", f"any: {mixture}"),
        ("day", "day"),
        (("day", "night"), "day|night"),
        ("day:night:0.3", "day:night:0.3"),
    ):
        environment, names = DriveEnv(scene, "bend", lighting=lighting, **options), set()
        for seed in range(4):
            names.add(environment.reset(seed=seed)[1]["lighting"])
            info = environment.step(environment.action_space.sample())[-1]
            assert info["lighting"] in names and "sampled_lighting" not in info
            table = environment.vector_env.info(0)
            assert table["lighting"] == environment.vector_env.pixels.info(0)["lighting"]
            assert table["lighting"] in ("training", "held-out", "any", "day", "night", "day:night:0.3")
        assert all(re.fullmatch(pattern, name) for name in names), names
        assert len(names) > 2 or lighting not in ("training", "held-out", "any")
    drifting = DriveEnv(scene, "bend", lighting="training", lighting_drift=True, randomise=True, **options)
    name = drifting.reset(seed=0)[1]["lighting"]
    assert re.fullmatch(rf"training → training\+randomised: {mixture} → {mixture}", name)
    many = gymnasium.make_vec(
        "twin/Drive-v0", 2, vectorization_mode="vector_entry_point", scene=scene, task="bend", **options
    )
    names = many.reset(seed=0)[1]["lighting"].tolist()
    one = DriveEnv(scene, "bend", **options)
    assert names == [one.reset(seed=seed)[1]["lighting"] for seed in (0, 1)]


def test_a_mixture_is_the_nearest_sum_of_the_filmed_lightings():
    vectors = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    filmed = Lightings(("sun", "night", "rain"), vectors, (), vectors[:0])
    blend = 0.62 * vectors[0] + 0.38 * vectors[1]
    assert mixture_text(blend, filmed) == "sun 0.62, night 0.38"
    assert mixture_text(blend + np.float32([0.0, 0.0, -5.0]), filmed).startswith("sun")  # no negative part
    assert mixture_text(vectors[2], filmed) == "rain 1.00"


@pytest.mark.parametrize("name", ["paper", "night", "crowded"])
def test_a_large_view_changes_nothing(scene, name):
    """Observations, rewards and infos equal those without it, also across the ends of episodes."""
    camera = CameraOptions(vibration=0.5, exposure=0.2, shutter=0.02)
    options = OPTION_SETS[name] | {"time_limit": 0.4, "camera": camera}
    plain = DriveEnv(scene, "bend", "rgb_array", **options)
    views = [
        DriveEnv(scene, "bend", "rgb_array", render_size=(96, 54), **options),
        DriveEnv(scene, "bend", "rgb_array", render_size=(64, 48), render_view="chase", **options),
    ]
    rng = np.random.default_rng(0)
    for seed in (3, 4):
        first = plain.reset(seed=seed)
        for view in views:
            observation, info = view.reset(seed=seed)
            np.testing.assert_array_equal(observation, first[0])
            assert info == first[1]
        over = False
        while not over:
            action = rng.uniform(-1.0, 1.0, 2)
            assert plain.render().shape == (18, 32, 3)
            for view, shape in zip(views, ((54, 96, 3), (48, 64, 3)), strict=True):
                picture = view.render()
                assert picture.shape == shape and picture.dtype == np.uint8 and picture.std() > 1.0
                np.testing.assert_array_equal(view.render(), picture)
            wanted = plain.step(action)
            for view in views:
                np.testing.assert_array_equal((out := view.step(action))[0], wanted[0])
                assert out[1:] == wanted[1:]
            over = wanted[2] or wanted[3]


def test_a_large_view_shows_what_the_policy_sees(scene):
    """Scaled down, the view equals the observation, including lighting, obstacles and weather."""
    obstacles = (ObstacleConfig("it", "box", station=3.0, color=(0.9, 0.1, 0.1)),)
    pictures = {}
    for name, more in (("plain", {}), ("box", {"obstacles": obstacles}), ("weather", {"randomise": True})):
        options = {"size": (160, 90), "lighting": "day", **more}
        environment = DriveEnv(scene, "bend", "rgb_array", render_size=(640, 360), **options)
        observation, _ = environment.reset(seed=2)
        for _ in range(5):
            observation, *_ = environment.step(np.array([1.0, 0.0]))
        pictures[name] = environment.render()
        small = resize(pictures[name], 160, 90).astype(float)
        assert np.abs(small - observation[-3:].transpose(1, 2, 0)).mean() < 3.0
        assert np.abs(pictures[name].astype(float) - pictures["plain"]).mean() > 1.0 or name == "plain"


def test_motion_blur_leaves_the_sky_of_the_simulator_sharp(scene):
    """Driving straight ahead moves nothing in the sky."""
    pictures = []
    for camera in (None, CameraOptions(shutter=0.05)):
        environment = twin.load(
            scene, "ahead", 0, size=(64, 36), observe="simulator", camera=camera, start_heading=0.0, start_offset=0.0
        )
        environment.reset()
        for _ in range(12):
            step = environment.step([1.0, 0.0])
        pictures.append(step.observation["pixels"][-1].astype(float))
    blur = np.abs(pictures[1] - pictures[0]).mean((1, 2))
    assert blur[17:22].mean() > 0.2 and blur[:12].max() < 0.05  # horizon, sky


def test_a_vector_environment_shows_what_it_has(scene):
    with pytest.raises(InputError, match="vector environments show their images, which pixels=False leaves out"):
        DriveVectorEnv(2, scene, "bend", "rgb_array", pixels=False)
    environment = DriveVectorEnv(2, scene, "bend", "rgb_array", size=(32, 18))
    with pytest.raises(ResetNeeded):
        environment.render()
    environment.close()


def test_randomized_latencies_stay_within_the_robots(scene):
    with pytest.raises(InputError, match=r"randomise: latency: .* \+ 2.5 s; expected at most 2 s together"):
        twin.load(scene, "bend", pixels=False, randomise=Ranges(latency=(0.0, 2.5)))
    with pytest.raises(InputError, match="bystanders"):
        Ranges(bystanders=(0.0, 1e5))


def test_a_chase_view_follows_the_robot_and_shows_its_obstacles(scene):
    """It also works without pictures for the policy, and with other obstacles in every episode."""
    environment = DriveEnv(scene, "bend", "rgb_array", render_view="chase", pixels=False, obstacles=2)
    environment.reset(seed=1)
    scenes = []
    for seed in (1, 2):
        environment.reset(seed=seed)
        first = environment.render()
        assert first.shape == (360, 640, 3)
        bases = [environment.vector_env.physics[0].base_to_world]
        for _ in range(5):
            environment.step(np.array([1.0, 0.5]))
            bases.append(environment.vector_env.physics[0].base_to_world)
        assert np.abs(environment.render().astype(float) - first).mean() > 1.0
        scenes.append(environment._scene)
        np.testing.assert_array_equal(environment._chase_pose, chase_poses(np.array(bases))[-1])
        parked = scenes[0].data.mocap_pos[:, 2] < -50.0
        assert (~parked).sum() == 2
    assert scenes[0] is scenes[1]


def test_a_state_never_leaves_its_bounds(scene):
    environment = DriveEnv(scene, "bend", pixels=False, start_offset=2.0, start_heading=180.0)
    space = environment.observation_space
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all() and space.shape == (10,)
    np.testing.assert_allclose(space.high[3:7], np.pi, rtol=1e-6)
    rng = np.random.default_rng(0)
    for seed in range(20):
        observation, _ = environment.reset(seed=seed)
        assert space.contains(observation)
        over = False
        while not over:
            observation, _, terminated, truncated, _ = environment.step(rng.uniform(-1.0, 1.0, 2))
            over = terminated or truncated
            assert space.contains(observation)
            assert (np.abs(observation[:3]) < 0.9 * space.high[:3]).all()  # nothing is clipped in a drive
    thrown = Motion(np.zeros((1, 3)), *(np.array([value]) for value in (1e3, -1e3, 1.0, False, 0.0)))
    state = environment.vector_env.tasks[0]._evaluator.state([0], thrown)[0]
    assert space.contains(state) and (state[0], state[1]) == (space.high[0], space.low[1])


def test_a_fresh_process_makes_it_by_its_full_name_without_torch(scene):
    """Processes of stable-baselines3's SubprocVecEnv have not imported `twin` either."""
    code = (
        "import sys, gymnasium; assert 'twin' not in sys.modules; "
        f"env = gymnasium.make('twin:twin/Drive-v0', scene={str(scene.scene.root)!r}, task='bend', pixels=False); "
        "print(env.reset(seed=0)[0].shape, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "(10,) False", done.stderr


def test_wrong_gymnasium_arguments_are_refused(scene):
    with pytest.raises(InputError, match="render_mode = 'human'; expected None or 'rgb_array'"):
        DriveEnv(scene, "bend", render_mode="human", pixels=False)
    with pytest.raises(InputError, match="lighting 'noon'"):
        DriveEnv(scene, "bend", lighting="noon")
    for options, words in (
        ({"render_view": "above"}, "render_view = 'above'; expected 'robot' or 'chase'"),
        ({"render_size": (640,)}, r"render_size = \(640,\); expected \(width, height\), whole numbers from 8 to 4096"),
        ({"render_size": (640, 3.5)}, "render_size"),
        ({"render_view": "robot", "pixels": False}, "render_view = 'robot' with pixels=False: no field is loaded"),
    ):
        with pytest.raises(InputError, match=words):
            DriveEnv(scene, "bend", "rgb_array", **options)
    with pytest.raises(gymnasium.error.ResetNeeded, match="render before reset"):
        DriveEnv(scene, "bend", "rgb_array", render_size=(64, 36)).render()
    environment = DriveEnv(scene, "bend", pixels=False, time_limit=0.1)
    with pytest.raises(gymnasium.error.ResetNeeded, match="step before reset"):
        environment.step(environment.action_space.sample())
    with pytest.raises(InputError, match="expected none: give them"):
        environment.reset(options={"lighting": "night"})
    environment.reset()
    for action in (np.array([np.nan, 0.0]), np.zeros((1, 2)), None):
        with pytest.raises(ValueError, match=r"^action .*; expected finite numbers of shape \(2,\)$"):
            environment.step(action)
    assert environment.step(environment.action_space.sample())[3]
    with pytest.raises(gymnasium.error.ResetNeeded, match="after the end of an episode"):
        environment.step(environment.action_space.sample())
    environment.reset()
    environment.step(environment.action_space.sample())
    environment.close()
