"""Measurements that `env_sections.py` runs in separate processes; each prints one line of JSON.

python benchmarks/env_workers.py FUNCTION SCENE [NUMBERS ...]
"""

import gc
import itertools
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

_STANDARD_TASKS = "straight", "right_turn"
_STEPS = 60  # environment steps per timed run


def standard_tasks(scene: Path) -> list[str]:
    """Standard tasks of a scene, `right_turn` last; `route` if it has none."""
    from twin.env.route_segments import scene_tasks
    from twin.loading import load_scene

    there = scene_tasks(load_scene(scene).world())
    return [name for name in _STANDARD_TASKS if name in there] or ["route"]


def one_obstacle() -> dict[str, Any]:
    """Options of an environment with a cone that stays in view for the first 20 m."""
    from twin.config import ObstacleConfig

    return {"obstacles": (ObstacleConfig("it", "cone", 24.0, 0.9),), "start_offset": 0.0, "start_heading": 0.0}


def single(scene: Path, runs: int) -> dict[str, Any]:
    """Speed of one environment on one core.

    If software OpenGL is available, its runs alternate with runs of the same environment whose images come from
    MuJoCo's renderer.
    """
    import twin
    from twin.env.drivers import RouteDriver

    begin = time.perf_counter()
    environment, drive = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle()), RouteDriver()
    environment.reset()
    out: dict[str, Any] = {"single.load_s": time.perf_counter() - begin}
    renderer, reason = software_gl(scene)
    plain = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle(), pixels=False)
    own, theirs = [], []
    for _ in range(runs):
        own.append(_pace(environment, drive, lambda: None))
        if renderer:
            theirs.append(_pace(plain, RouteDriver(), lambda: renderer(plain.physics))[0])
    paces = [pace for pace, _ in own]
    out["single.steps_per_s"] = max(paces)
    out["single.steps_per_s_all"] = [round(v, 1) for v in paces]
    out["single.cpu_ms_per_step"] = 1e3 * min(used for _, used in own)
    if theirs:
        out |= {"software_gl.steps_per_s": max(theirs), "ratio_to_software_gl": max(paces) / max(theirs)}
    else:
        out |= {"ratio_to_software_gl": None, "software_gl.why_not": reason}
    return out


def _pace(environment: Any, drive: Any, after_step: Any) -> tuple[float, float]:
    """Steps per second from the start of an episode, and processor time per step [s]."""
    step = environment.reset()
    for _ in range(10):
        step = environment.step(drive(environment, step))
        after_step()
    begin, used = time.perf_counter(), time.process_time()
    for _ in range(_STEPS):
        step = environment.step(drive(environment, step))
        after_step()
    return _STEPS / (time.perf_counter() - begin), (time.process_time() - used) / _STEPS


def software_gl(scene: Path) -> tuple[Any, str]:
    """A function that renders the front camera with the extracted mesh; None and the reason if OpenGL is missing."""
    try:
        import mujoco

        from twin.config import ObstacleConfig
        from twin.env.obstacles import add_obstacles, place
        from twin.loading import load_scene

        world = load_scene(scene).world()
        spec = mujoco.MjSpec.from_file(str(world.model_path))
        obstacles = (ObstacleConfig("it", "cone", 24.0, 0.9),)
        add_obstacles(spec, obstacles, world)
        model = spec.compile()
        data = mujoco.MjData(model)
        place(obstacles, data, 0.0)
        renderer = mujoco.Renderer(model, 90, 160)
    except Exception as error:  # each missing library raises its own type
        return None, " ".join(str(error).split())[:200] or type(error).__name__
    visible = mujoco.MjvOption()
    visible.geomgroup[:] = [1, 1, 1, 0, 0, 1]

    def draw(physics: Any) -> Any:
        data.qpos[:] = physics.data.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, "front", visible)
        return renderer.render()

    return draw, ""


def batch(scene: Path, count: int, runs: int) -> dict[str, Any]:
    """Speed of a vector env on two cores, alternately in two processes and in one: steps of all environments per s."""
    spread, alone = _vector_env(scene, count), _vector_env(scene, count, 1)
    both = [(_vector_env_pace(spread), _vector_env_pace(alone)) for _ in range(runs)]
    rates, costs = zip(*(pair[0] for pair in both), strict=True)
    return {
        f"batch{count}.steps_per_s": max(rates),
        f"batch{count}.steps_per_s_all": [round(v, 1) for v in rates],
        f"batch{count}.cpu_ms_per_step": 1e3 * min(costs),
        f"batch{count}.ratio_to_one_process": max(rates) / max(pair[1][0] for pair in both),
    }


def _vector_env_pace(envs: Any) -> tuple[float, float]:
    """Steps per second from the start of an episode, and processor time per step [s], children included."""
    count = len(envs)
    envs.begin(range(count))
    begin, used, steps = 0.0, 0.0, max(8, _STEPS * 4 // count)
    for k in range(steps + 3):
        if k == 3:
            begin, used = time.perf_counter(), _cpu_time()
        envs.step(_ahead(envs))
        envs.observation()
    return count * steps / (time.perf_counter() - begin), (_cpu_time() - used) / (count * steps)


def _cpu_time() -> float:
    """Processor time [s] of this process and its children."""
    import psutil

    this = psutil.Process()
    times = [one.cpu_times() for one in (this, *this.children())]
    return sum(one.user + one.system for one in times)


def physics(scene: Path, runs: int) -> dict[str, Any]:
    """Speed of one environment without images on one core."""
    import twin
    from twin.env.drivers import RouteDriver

    environment = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle(), pixels=False)
    return {"physics.steps_per_s": max(_pace(environment, RouteDriver(), lambda: None)[0] for _ in range(2 * runs))}


def memory(scene: Path, count: int) -> dict[str, Any]:
    """Peak memory of a vector env and its processes."""
    envs = _vector_env(scene, count)
    envs.begin(range(count))
    for _ in range(5):
        envs.step(_ahead(envs))
        envs.observation()
    envs.begin([0])
    envs.close()
    peaks = [resource.getrusage(who).ru_maxrss * 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    # ru_maxrss of the children is that of the largest child; the other children use about as much memory.
    return {f"worlds{count}.bytes": peaks[0] + peaks[1] * getattr(envs, "processes", 0)}


def soak(scene: Path, steps: int) -> dict[str, Any]:
    """Non-finite values and memory growth over random steps of eight environments."""
    import psutil

    from twin.env.env_factory import EnvFactory
    from twin.env.vector_env_local import LocalVectorEnv

    count = 8
    factory = EnvFactory.open(scene, standard_tasks(scene)[-1], {"randomise": True, "obstacles": 3})
    envs = LocalVectorEnv(factory, list(range(count)))  # in this process, which gives access to the states
    envs.begin(range(count))
    rng, sizes, episodes, bad = np.random.default_rng(0), [], 0, 0
    rounds = steps // count
    for k in range(rounds):
        # Mostly forward, so that episodes progress.
        actions = np.stack([rng.uniform(0, 1, count), rng.uniform(-0.3, 0.3, count)], 1)
        out = envs.step(actions)
        bad += int(~np.isfinite(out.reward).all()) + sum(
            not np.isfinite(p.data.qpos).all() or not np.isfinite(p.data.qvel).all() for p in envs.physics
        )
        over = np.flatnonzero(out.over).tolist()
        if over:
            episodes += len(over)
            envs.begin(over)
        if (k + 1) % max(1, rounds // 10) == 0:
            gc.collect()
            sizes.append(psutil.Process().memory_info().rss)
    return {
        "soak.steps": rounds * count,
        "soak.episodes": episodes,
        "soak.not_finite": bad,
        "soak.growth_bytes": sizes[-1] - sizes[len(sizes) // 5],
    }


def gpu(scene: Path, count: int) -> dict[str, Any]:
    """Speed of a vector env on a GPU, without obstacles."""
    import warp

    envs = _vector_env(scene, count, device="cuda", obstacles=())
    envs.begin(range(count))
    begin, steps = 0.0, 30
    for k in range(steps + 3):
        if k == 3:  # by now, kernels are compiled and the CUDA graph is captured
            warp.synchronize()
            begin = time.perf_counter()
        envs.step(_ahead(envs))
        envs.pixels.tensor()
    warp.synchronize()
    return {"gpu.worlds": count, "gpu.steps_per_s": count * steps / (time.perf_counter() - begin)}


def host(scene: Path, count: int) -> dict[str, Any]:
    """Host time of a GPU vector env per step; physics and rendering are replaced by stubs.

    The host holds the GIL throughout, so `host.steps_per_s` is an upper limit on the speed of `GpuVectorEnv` with any
    GPU. `host.info_us` is the time for `info` and `state` of an environment, which stable-baselines3 requests.
    """
    import dataclasses

    import warp

    from twin.env.env_factory import EnvFactory
    from twin.env.vector_env_gpu import GpuSimulation, GpuVectorEnv
    from twin.nerf.baked import BakedField

    with warp.ScopedDevice("cpu"):
        blank = warp.zeros((count, 64), dtype=warp.vec3), warp.ones((count, 64), dtype=float)

    def show(field: BakedField, cameras: Any, lighting: Any, take: Any) -> None:
        field.head_biases(lighting, len(cameras.camera_to_world))  # the host's part of `render_on_device`
        take(*blank)

    GpuSimulation._advance, BakedField.render_on_device = lambda self: None, show  # type: ignore[method-assign]
    factory = EnvFactory.open(scene, standard_tasks(scene)[-1], {"obstacles": (), "size": (8, 8)})
    # This option selects the observer that keeps images on the device. Here the device is the CPU, as for the field.
    options = dataclasses.replace(factory.options, device="cuda")
    envs = GpuVectorEnv(dataclasses.replace(factory, options=options), list(range(count)), "cpu")
    begin = time.perf_counter()
    envs.begin(range(count))
    reset_time, times = time.perf_counter() - begin, []
    for _ in range(23):
        times.append(time.perf_counter())
        envs.step(_ahead(envs))
        envs.pixels.tensor()
    step = float(np.median(np.diff(times)[2:]))
    begin = time.perf_counter()
    for i in range(count):
        envs.info(i), envs.state(i)
    info_time = time.perf_counter() - begin
    return {
        "host.worlds": count,
        "host.us_per_step": 1e6 * step / count,
        "host.steps_per_s": count / step,
        "host.info_us": 1e6 * info_time / count,
        "host.begin_ms": 1e3 * reset_time / count,
    }


_LATERALS = (0.0, 0.8, -1.6, 2.5, -4.0)  # [m] from the route
_TURNS = (0.0, 20.0, -45.0, 90.0, 180.0)  # [°] from the route's heading
_EYE = 0.6  # [m] camera height
_STEP = 6.0  # [m] along the route between positions
_FAR = 20.0  # [m] errors are evaluated up to this true depth
_BINS = ((0.9, 1.01), (0.5, 0.9), (0.0, 0.5))  # ranges of the trust score


def trust(scene: Path) -> dict[str, Any]:
    """Median depth error [m] and PSNR [dB] of images by their trust, and rank correlations of trust with both."""
    from overlay import SIZE, TrueWorld
    from scipy.stats import spearmanr

    from twin.env.trust import Trust
    from twin.geometry.cameras import Viewpoints
    from twin.geometry.polyline import arc_lengths
    from twin.loading import load_scene
    from twin.reality.lighting import LIGHTINGS
    from twin.reality.truth import Truth, align_poses, matched_poses

    opened = load_scene(scene)
    world, field, score = opened.world(), opened.field(), Trust(opened.cameras())
    truth, cameras = Truth.load(opened.scene.truth), opened.cameras()
    to_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras))
    lighting = next(name for name in field.lightings if name in LIGHTINGS)
    true_world = TrueWorld(truth, lighting, world.intrinsics)
    rows = []
    stations = np.arange(3.0, arc_lengths(world.route)[-1] - 3.0, _STEP)
    for s, lateral, turn in itertools.product(stations, _LATERALS, _TURNS):
        pose = _pose(world.route, float(s), lateral, turn)
        out = field.render(Viewpoints.of(pose, world.intrinsics, SIZE), lighting, SIZE)
        number = float(score.of(pose[None], out)[0])
        wanted, depth = true_world.render(to_truth.poses(pose), None, np.eye(4))
        near = depth < _FAR
        if near.sum() < 500:
            continue
        error = float(np.median(np.abs(np.minimum(out.depth[0], 2 * _FAR) - depth)[near]))
        psnr = float(-10.0 * np.log10(((out.rgb[0] - wanted) ** 2).mean()))
        rows.append((number, error, psnr, float(score.offset(pose[None])[0])))
    number, error, psnr, offset = np.array(rows).T
    figures: dict[str, Any] = {
        "trust.pictures": len(rows),
        "trust.rank_correlation_depth_error": float(spearmanr(number, error).statistic),
        "trust.rank_correlation_psnr": float(spearmanr(number, psnr).statistic),
        "trust.offset_rank_correlation_psnr": float(spearmanr(offset, psnr).statistic),
    }
    for low, high in _BINS:
        mine = (number >= low) & (number < high)
        name = f"{low:g}_to_{min(high, 1.0):g}"
        figures[f"trust.n.{name}"] = int(mine.sum())
        if mine.any():
            figures[f"trust.depth_error_m.{name}"] = float(np.median(error[mine]))
            figures[f"trust.psnr.{name}"] = float(np.median(psnr[mine]))
    return figures


def _pose(route: np.ndarray, s: float, lateral: float, turn: float) -> np.ndarray:
    from twin.geometry.polyline import heading_at, point_at
    from twin.geometry.poses import look_at

    heading = float(heading_at(route, s))
    left = np.array([-np.sin(heading), np.cos(heading), 0.0])
    eye = point_at(route, s) + lateral * left + np.array([0.0, 0.0, _EYE])
    yaw = heading + np.deg2rad(turn)
    return look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), -np.tan(np.deg2rad(5.0))]))


def _vector_env(scene: Path, count: int, processes: int | None = None, **options: Any) -> Any:
    from twin.env.vector_env import make_vector_env

    options = one_obstacle() | options
    return make_vector_env(scene, standard_tasks(scene)[-1], options, list(range(count)), processes)


def _ahead(envs: Any) -> np.ndarray:
    """Actions: straight ahead at full speed."""
    return np.tile(np.array([1.0, 0.0]), (len(envs), 1))


if __name__ == "__main__":
    function, folder, *numbers = sys.argv[1:]
    print(json.dumps(globals()[function](Path(folder), *map(int, numbers))))
