"""Environments stepped by mujoco_warp agree with those stepped by MuJoCo, on the CPU and on a GPU if there is one.

Without a GPU, the option `device` is set to "cuda" where it selects the code, and the arrays stay on the CPU.
"""

from dataclasses import replace

import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from devices import DEVICES
from tiny_twin import tiny_twin

import twin
from twin import runtime
from twin.config import ObstacleConfig
from twin.env.domain_randomization import Ranges
from twin.env.env_factory import EnvFactory
from twin.env.observation import GpuPixelObserver, PixelObserver
from twin.env.picture_effects import CameraOptions
from twin.env.task import control
from twin.env.vector_env_gpu import GpuVectorEnv, _compile_kernels
from twin.env.vector_env_local import LocalVectorEnv
from twin.errors import InputError
from twin.nerf.baked import BakedField
from twin.nerf.buffers import load_training_kernels
from twin.robot import HuskyParams

WALKER = ObstacleConfig("walker", "pedestrian", station=6.0, lateral=-1.5, to=(6.0, 1.5), speed=1.0)
RANGES = Ranges(friction=(0.7, 1.3), payload=(0.0, 40.0), latency=(0.0, 0.1), bystanders=(0, 0))
SMALL = {"size": (32, 18)}
OPTIONS = {"pixels": False, "randomise": RANGES, "obstacles": (WALKER,)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    runtime.set_quiet(True)
    # Lagging servos: they have a state of their own.
    return twin.load_scene(tiny_twin(tmp_path_factory.mktemp("twin"), robot=HuskyParams(servo_lag=0.05)))


def load_field(scene, device_name: str) -> BakedField:
    return BakedField.load(scene.scene.stage("field"), device_name)


@pytest.mark.slow
@pytest.mark.parametrize("device_name", DEVICES)
def test_gpu_physics_agrees_with_mujoco(scene, device_name):
    """Different robots under different commands, step by step and all at once."""
    stage = EnvFactory.open(scene, "bend", OPTIONS)
    stage = replace(stage, world=replace(stage.world, robot=replace(stage.world.robot, camera_latency=0.07)))
    plain, device = LocalVectorEnv(stage, [1, 2, 3]), GpuVectorEnv(stage, [1, 2, 3], device_name)
    for envs in (plain, device):
        envs.begin(range(3))
    rng = np.random.default_rng(0)
    actions = np.array([[1.0, 0.0], [0.6, 0.5], [0.2, -0.4]])
    for k in range(8):
        which = [0, 1, 2] if k != 4 else [1]
        given = np.clip(actions + 0.2 * rng.normal(size=actions.shape), -1.0, 1.0)[which]
        a, b = plain.step(given, which), device.step(given, which)
        np.testing.assert_array_equal(a.over, b.over)
        np.testing.assert_allclose(a.reward, b.reward, atol=0.02)
        # Vectorized results equal those of each environment.
        poses, times = device._simulation.camera_poses(np.arange(3))
        motion = device._simulation.motion(np.arange(3))
        for i, (physics, task) in enumerate(zip(device.physics, device.tasks, strict=True)):
            np.testing.assert_allclose(poses[i], physics.camera_to_world, atol=1e-7)
            assert times[i] == pytest.approx(physics.delayed_data.time, abs=1e-9) and motion.time[i] == physics.time()
            np.testing.assert_allclose(motion.pose[i], physics.planar_pose, atol=1e-9)
            said = motion.speed[i], motion.yaw_rate[i], motion.uprightness[i]
            np.testing.assert_allclose(said, (physics.speed, physics.yaw_rate, physics.uprightness), atol=1e-9)
            np.testing.assert_allclose(device.state(i), np.concatenate(list(task.get_observation(physics).values())))
            # (the speed is the same but for its last bit)
            assert device.info(i) | {"speed": 0} == task.info(physics) | {"speed": 0}
    for one, other in zip(plain.physics, device.physics, strict=True):
        assert one.time() == pytest.approx(other.time())
        np.testing.assert_allclose(one.planar_pose, other.planar_pose, atol=6e-3)
        # Where a motor is at its limit, a wheel slips a little sooner or later.
        np.testing.assert_allclose(one.data.qvel[6:], other.data.qvel[6:], atol=0.3)
        np.testing.assert_allclose(one.data.act, other.data.act, atol=1e-4)
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=4e-3)
        assert one.delayed_data.time == pytest.approx(one.time() - 0.07) and other.delayed_data.time == pytest.approx(
            one.delayed_data.time
        )
        np.testing.assert_allclose(one.data.mocap_pos, other.data.mocap_pos, atol=1e-9)
        assert one.speed > 0.1
    assert all(task.progress > 0.1 for task in device.tasks)
    # One episode is reset while its robot moves; it then stands.
    for envs in (plain, device):
        envs.begin([0])
        envs.begin([])
        for _ in range(2):
            envs.step(np.array([[-1.0, 0.0], [1.0, 0.2]]), [0, 2])
    # The device has the robot that was sampled for the new episode.
    friction = np.stack([physics.robot.model.geom_friction for physics in device.physics])
    np.testing.assert_allclose(device._simulation._model.geom_friction.numpy(), friction, rtol=1e-6)
    for i in (0, 2):
        one, other = plain.physics[i], device.physics[i]
        np.testing.assert_allclose(one.planar_pose, other.planar_pose, atol=6e-3)
        np.testing.assert_allclose(one.data.act, other.data.act, atol=1e-4)
    assert abs(device.physics[0].speed) < 0.01 and plain.physics[0].data.act.shape == (2,)
    plain.close(), device.close()


@pytest.mark.slow
@pytest.mark.parametrize("device_name", DEVICES)
def test_gpu_robots_that_start_along_the_route_are_rolling(scene, device_name):
    stage = EnvFactory.open(scene, "bend", {**OPTIONS, "start_along": 0.5, "speed": 0.6})
    plain, device = LocalVectorEnv(stage, [1, 2]), GpuVectorEnv(stage, [1, 2], device_name)
    for envs in (plain, device):
        envs.begin(range(2))
        for _ in range(3):
            envs.step(np.array([[1.0, 0.0], [1.0, 0.0]]))
    for one, other in zip(plain.physics, device.physics, strict=True):
        assert other.speed == pytest.approx(0.6, abs=0.05) and one.speed == pytest.approx(other.speed, abs=0.02)
        np.testing.assert_allclose(one.planar_pose, other.planar_pose, atol=6e-3)
    plain.close(), device.close()


@pytest.mark.parametrize("device_name", DEVICES)
@pytest.mark.parametrize("obstacles", [pytest.param((), marks=pytest.mark.slow), (WALKER,)])
def test_gpu_observations_agree_with_the_cpu(scene, obstacles, device_name):
    """Images of the field alone, and images with obstacles, without access to the physics in between."""
    stage = EnvFactory.open(scene, "bend", {"obstacles": obstacles, "lighting": "day", **SMALL})
    stage = replace(stage, world=replace(stage.world, robot=replace(stage.world.robot, camera_latency=0.07)))
    plain = LocalVectorEnv(stage, [1, 2])
    stage = replace(stage, options=replace(stage.options, device="cuda"), field=load_field(scene, device_name))
    device = GpuVectorEnv(stage, [1, 2], device_name)
    assert type(device.pixels) is (PixelObserver if obstacles else GpuPixelObserver)
    before = None
    for envs in (plain, device):
        envs.begin([0, 1])
    for k in range(3):
        for envs in (plain, device):
            envs.step(np.array([[1.0, 0.4], [1.0, -0.4]])[: 2 - k % 2], [0, 1][: 2 - k % 2])
        off = np.abs(plain.observation().astype(int) - device.observation())
        assert off.mean() < 1.0 and np.quantile(off, 0.99) < 20
        assert before is None or np.abs(before.astype(int) - device.observation()).mean() > 2 * off.mean()
        before = device.observation()
    np.testing.assert_allclose(plain.pixels.trust, device.pixels.trust, atol=0.02)
    plain.close(), device.close()


@pytest.mark.parametrize("device_name", DEVICES)
def test_gpu_overflow_and_divergence_raise(scene, device_name):
    envs = GpuVectorEnv(EnvFactory.open(scene, "bend", {"pixels": False, "obstacles": ()}), [1, 2], device_name)
    envs.begin([0])  # the other environment keeps the model's initial state
    device = envs._simulation
    device._advance, device._graph = lambda: None, None
    device._data.overflow.assign([0, int(mjw.OverflowType.NEFC)])
    device._upload = lambda: None
    envs.step(np.zeros((1, 2)), [0])
    device._data.overflow.assign([int(mjw.OverflowType.NEFC), 0])
    with pytest.raises(RuntimeError, match=r"environments \[0\]: more than .* no room; use device='cpu'"):
        envs.step(np.zeros((1, 2)), [0])
    device._data.overflow.zero_()
    device._data.qvel.assign(np.full(device._data.qvel.shape, np.nan, np.float32))
    with pytest.raises(control.PhysicsError, match=r"environments \[0\]"):
        envs.step(np.zeros((1, 2)), [0])
    envs.close()


@pytest.mark.slow
@pytest.mark.parametrize("device_name", DEVICES)
def test_gpu_contact_ends_the_episode(scene, device_name):
    wall = ObstacleConfig("in_the_way", "box", station=0.95, lateral=0.0)
    stage = EnvFactory.open(scene, "bend", {"pixels": False, "obstacles": (wall,)})
    envs = GpuVectorEnv(stage, [4, 5], device_name)
    envs.begin(range(2))
    actions = np.array([[1.0, 0.0], [-1.0, 0.0]])
    assert not envs.step(actions).over.any()
    for _ in range(30):
        out = envs.step(actions)
        if out.over.any():
            break
    assert out.terminated.tolist() == [True, False]
    assert envs.tasks[0].cause == "collision" and any("in_the_way" in name for name in envs.physics[0].touched)
    assert envs.physics[1].touched == ()
    envs.begin([0])
    assert envs.physics[0].time() == 0.0 and not envs.step(np.zeros((1, 2)), [0]).over.any()
    envs.close()


@pytest.mark.parametrize("device_name", DEVICES)
@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_gpu_frame_stacks_equal_those_on_the_host(scene, latency, device_name, monkeypatch):
    """Also across episode ends, for subsets of environments, and as a tensor that shares memory."""
    stage = EnvFactory.open(
        scene, "bend", {"obstacles": (), "lighting": ("day", "night"), "lighting_drift": True, **SMALL}
    )
    robot = replace(stage.world.robot, camera_latency=latency)
    stage = replace(stage, world=replace(stage.world, robot=robot), field=load_field(scene, device_name))
    parts = [stage.make_env(seed) for seed in range(5)]
    monkeypatch.setattr(stage.trust, "offset", lambda poses: np.zeros(len(poses)))  # so that the picture decides
    host, device = stage.make_observer(parts), GpuPixelObserver(stage.field, stage.trust, stage.options, parts)
    for physics, task in parts:
        task.initialize_episode(physics)
    before = None
    for k in range(7):
        which = [0, 1, 2, 3, 4] if k % 3 == 0 else [0, 2, 4] if k % 3 == 1 else [1, 2]
        for i in which:
            parts[i][1].before_step([1.0, 0.3 * i], parts[i][0])
            parts[i][0].step(50)
        for pixels in (host, device):
            (pixels.begin if k in (0, 4) else pixels.observe)(which)
        np.testing.assert_array_equal(device.stacks, host.stacks)
        np.testing.assert_allclose(device.trust, host.trust, atol=1e-5)
        assert device.info(0)["lighting"] == host.info(0)["lighting"]
        np.testing.assert_array_equal(device.tensor().cpu().numpy(), host.stacks.reshape(5, -1, 18, 32))
        assert before is None or not np.array_equal(before, host.stacks)
        before = device.stacks


def test_kernels_are_compiled_before_the_first_step(scene, monkeypatch):
    """Those that the list of kernels lacks would be compiled one by one; on the CPU, one has another block size."""
    envs = GpuVectorEnv(EnvFactory.open(scene, "bend", {"pixels": False, "obstacles": ()}), [1, 2], "cpu")
    simulation, load = envs._simulation, wp.Module.load
    loaded: list[str] = []

    def note(module, device, block_dim=None, **rest):
        if (None, block_dim) not in module.execs:
            loaded.append(module.name)
        return load(module, device, block_dim, **rest)

    monkeypatch.setattr(wp.Module, "load", note)
    conditional = simulation._model.opt.graph_conditional
    _compile_kernels(simulation._model, lambda: simulation._substep(0), "cpu")
    assert simulation._model.opt.graph_conditional == conditional
    loaded.clear()
    envs.begin(range(2))
    envs.step(np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert set(loaded) <= {"mujoco_warp._src.collision_driver"}
    assert all(physics.speed > 0.01 for physics in envs.physics)
    envs.close()


def test_physics_starts_while_torch_shares_its_stream(scene):
    """A field that was trained in this process has made torch's stream Warp's, which a CUDA graph cannot record."""
    if "cuda" not in DEVICES:
        pytest.skip("no CUDA device")
    load_training_kernels("cuda")
    envs = GpuVectorEnv(EnvFactory.open(scene, "bend", {"pixels": False, "obstacles": ()}), [1, 2], "cuda")
    envs.begin(range(2))
    for _ in range(5):
        envs.step(np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert all(physics.speed > 0.1 for physics in envs.physics)
    envs.close()


def test_gpu_observer_is_used_only_without_objects(scene):
    def kind(**options) -> type:
        stage = EnvFactory.open(scene, "bend", {"obstacles": (), **SMALL, **options})
        stage = replace(stage, options=replace(stage.options, device="cuda"))  # the field stays on the CPU
        return type(stage.make_observer([stage.make_env(0)]))

    assert kind() is GpuPixelObserver
    assert kind(randomise=True) is kind(obstacles=1) is kind(camera=CameraOptions(vibration=0.1)) is PixelObserver


def test_missing_gpu_is_refused_in_one_line(scene):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError, match="device = 'cuda': no CUDA device"):
        patch.setattr(wp, "is_cuda_available", lambda: False)
        twin.load(scene, "bend", device="cuda")
    with pytest.raises(InputError, match=r"device = 'tpu'; expected"):
        twin.load(scene, "bend", device="tpu")
