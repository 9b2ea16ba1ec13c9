"""Observations: images of the right instant, without the camera's own housing."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.config import ObstacleConfig
from twin.env.compositor import Compositor
from twin.env.domain_randomization import NominalModel, RandomizationSample, Ranges
from twin.env.env_factory import DriveEnvironment, EnvFactory
from twin.env.mujoco_renderer import RayCaster, SceneRenderer
from twin.env.options import NERF, SIMULATOR
from twin.env.physics import camera_pose
from twin.geometry.cameras import Viewpoints
from twin.warp_runtime import wp

SIZE = (64, 36)
WALKER = ObstacleConfig("walker", "pedestrian", station=2.5, lateral=-0.6, to=(2.5, 0.6), speed=1.5)
OTHER = ObstacleConfig("other", "husky", station=2.5)
LIGHT = "day"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin")))


def film(scene, latency: float, steps: int, **options) -> np.ndarray:
    """Newest pictures (steps + 1, height, width, 3) of one drive."""
    stage = EnvFactory.open(scene, "bend", {"size": SIZE, "stack": 1, "time_limit": 60.0, **options})
    stage = replace(stage, world=replace(stage.world, robot=replace(stage.world.robot, camera_latency=latency)))
    physics, task = stage.make_env(3)
    environment = DriveEnvironment(physics, task, stage.make_observer([(physics, task)]))
    rng = np.random.default_rng(0)
    pictures = [environment.reset().observation["pixels"][0]]
    for _ in range(steps):
        step = environment.step([rng.uniform(0.6, 1.0), rng.uniform(-0.3, 0.3)])
        assert not step.last()
        pictures.append(step.observation["pixels"][0])
    return np.stack(pictures)


@pytest.mark.parametrize("observe", [NERF, SIMULATOR])
@pytest.mark.parametrize(("period", "late"), [(0.1, 1), (0.1, 3), (0.05, 3), (0.014, 5)])
def test_camera_latency_shows_the_past_state(scene, observe, period, late):
    """Camera pose, robot, moving obstacles and lighting are equal bit for bit."""
    options = {"observe": observe, "control_timestep": period, "obstacles": (WALKER,)}
    options |= {"lighting": LIGHT, "lighting_drift": True}
    steps = late + round(0.8 / period)
    prompt, tardy = film(scene, 0.0, steps, **options), film(scene, late * period, steps, **options)
    np.testing.assert_array_equal(tardy[late:], prompt[: steps + 1 - late])
    np.testing.assert_array_equal(tardy[:late], np.repeat(prompt[:1], late, 0))  # nothing is older than the episode
    # Somebody walks through that picture, from right to left: above the horizon nothing else differs.
    empty = film(scene, 0.0, steps, **(options | {"obstacles": ()}))
    there = [np.flatnonzero((a != b)[: SIZE[1] // 4].any((0, 2))) for a, b in zip(prompt, empty, strict=True)]
    assert len(there[0]) and len(there[-1]) and there[0].mean() > there[steps // 2].mean() + 5


def test_ray_casters_in_parallel_stay_on_the_cpu(scene, monkeypatch):
    """On a machine with a GPU, too, which is Warp's default device there."""
    runtime, model = wp.get_device("cpu").runtime, scene.world().model()
    monkeypatch.setattr(runtime, "default_device", "the GPU")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    casters = [RayCaster(model, data, cam_res=(8, 8), cam_active=["front"]) for _ in range(2)]
    first_ended, second_began, seen = threading.Event(), threading.Event(), []

    def first(*_) -> None:
        assert second_began.wait(60)

    def second(*_) -> None:
        second_began.set()
        assert first_ended.wait(60)
        seen.append(runtime.default_device)

    for caster, render in zip(casters, (first, second), strict=True):
        caster._mjw = SimpleNamespace(render=render)
    with ThreadPoolExecutor(2) as pool:
        futures = [pool.submit(caster.cast) for caster in casters]
        futures[0].result(60)
        first_ended.set()
        futures[1].result(60)
    assert seen == [wp.get_device("cpu")]


def views(stage: EnvFactory, shaded: bool = False) -> tuple[Compositor, SceneRenderer]:
    simulated = replace(stage, field=None, options=replace(stage.options, observe=SIMULATOR))
    return Compositor(stage.model, stage.field, SIZE, shaded=shaded), simulated.make_observer(
        [stage.make_env(0)]
    )._renderer  # type: ignore


def standing(stage: EnvFactory, draw: RandomizationSample) -> mujoco.MjData:
    """The robot at its start, as rendered."""
    physics, task = stage.make_env(0)
    task.initialize_episode(physics)
    NominalModel(stage.model).apply(draw, physics.model.ptr)
    mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
    return physics.data.ptr


@pytest.mark.parametrize("ranges", [Ranges(), Ranges(camera_shift=(-0.05, 0.05))])
def test_no_camera_sees_its_own_housing(scene, ranges):
    stage = EnvFactory.open(scene, "bend", {"size": SIZE, "start_offset": 0.0, "start_heading": 0.0})
    overlay, simulator = views(stage)
    rng = np.random.default_rng(1)
    data = standing(stage, RandomizationSample())
    model, nominal = data.model, NominalModel(stage.model)
    for _ in range(100):
        nominal.apply(ranges.sample(rng), model)
        mujoco.mj_forward(model, data)
        depth = simulator.render([data]).depth
        assert depth[depth > 0.0].min() > 0.3  # the road
        pose = camera_pose(data, model.camera("front").id)
        alone = stage.field.render(Viewpoints.of(pose, overlay.intrinsics, SIZE), LIGHT)
        assert np.array_equal(overlay.render([data], LIGHT).rgb, alone.rgb)


def test_the_rest_of_the_robot_is_seen_where_in_view(scene):
    """The camera looks down at its own bumper."""
    stage = EnvFactory.open(scene, "bend", {"size": SIZE, "start_offset": 0.0, "start_heading": 0.0})
    data = standing(stage, RandomizationSample(camera_turn=(-65.0, 0.0, 0.0)))
    bumper = data.body("base_link").xpos + data.body("base_link").xmat.reshape(3, 3) @ [0.479, 0.0, 0.165]
    pose = camera_pose(data, data.model.camera("front").id)
    away = float((bumper - pose[:3, 3]) @ pose[:3, 2])
    for view in views(stage):
        depth = view.render([data], LIGHT).depth[0]
        assert depth[depth > 0.0].min() > 0.1
        assert (np.abs(depth - away) < 0.03).sum() > 20


def test_another_robot_keeps_its_camera(scene):
    stage = EnvFactory.open(scene, "bend", {"size": SIZE, "obstacles": (OTHER,)})
    names = {
        stage.model.geom(int(i)).name for i in Compositor(stage.model, stage.field, SIZE)._workers[0].renderer.geoms
    }
    assert {name for name in names if "camera" in name} == {
        f"obstacle_other_camera_{part}" for part in ("bracket", "housing", "lens_left", "lens_right")
    }
