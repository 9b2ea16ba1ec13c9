"""What `env_sections.py` runs in processes of its own: prints one line of JSON.

python benchmarks/env_workers.py WHAT SCENE [NUMBERS ...]
"""

import gc
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

_STEPS = 60  # per timed run


def standard_tasks(scene: Path) -> list[str]:
    """The standard tasks that a scene has, `right_turn` last; `route` where it has none."""
    from twin.env.route_segments import STANDARD_TASKS, scene_tasks
    from twin.loading import load_scene

    there = scene_tasks(load_scene(scene).world())
    return [name for name in STANDARD_TASKS if name in there] or ["route"]


def one_obstacle(scene: Path) -> dict[str, Any]:
    """Options with a cone that stays in view ahead for the first twenty metres."""
    from twin.config import ObstacleConfig

    return {"obstacles": (ObstacleConfig("it", "cone", 24.0, 0.9),), "start_offset": 0.0, "start_heading": 0.0}


def single(scene: Path, runs: int) -> dict[str, Any]:
    """One world on one core, alternately with MuJoCo's own renderer where software OpenGL is to be had."""
    import twin
    from twin.env.drivers import RouteDriver

    begin = time.perf_counter()
    environment, drive = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle(scene)), RouteDriver()
    environment.reset()
    out: dict[str, Any] = {"single.load_s": time.perf_counter() - begin}
    renderer, why = software_gl(scene)
    plain = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle(scene), pixels=False)
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
        out |= {"ratio_to_software_gl": None, "software_gl.why_not": why}
    return out


def _pace(environment: Any, drive: Any, also: Any) -> tuple[float, float]:
    """Steps per second from the start of an episode, and processor time per step [s]."""
    step = environment.reset()
    for _ in range(10):
        step = environment.step(drive(environment, step))
        also()
    begin, used = time.perf_counter(), time.process_time()
    for _ in range(_STEPS):
        step = environment.step(drive(environment, step))
        also()
    return _STEPS / (time.perf_counter() - begin), (time.process_time() - used) / _STEPS


def software_gl(scene: Path) -> tuple[Any, str]:
    """A function that draws a physics' front camera with the extracted mesh, and if there is none, why."""
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
    except Exception as error:  # whatever a missing library makes of itself
        return None, " ".join(str(error).split())[:200] or type(error).__name__
    shown = mujoco.MjvOption()
    shown.geomgroup[:] = [1, 1, 1, 0, 0, 1]

    def draw(physics: Any) -> Any:
        data.qpos[:] = physics.data.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, "front", shown)
        return renderer.render()

    return draw, ""


def batch(scene: Path, count: int, runs: int) -> dict[str, Any]:
    """Many worlds on two cores, in two processes, and alternately in one; steps of all worlds counted."""
    spread, alone = _worlds(scene, count), _worlds(scene, count, 1)
    both = [(_worlds_pace(spread), _worlds_pace(alone)) for _ in range(runs)]
    rates, costs = zip(*(pair[0] for pair in both), strict=True)
    return {
        f"batch{count}.steps_per_s": max(rates),
        f"batch{count}.steps_per_s_all": [round(v, 1) for v in rates],
        f"batch{count}.cpu_ms_per_step": 1e3 * min(costs),
        f"batch{count}.ratio_to_one_process": max(rates) / max(pair[1][0] for pair in both),
    }


def _worlds_pace(worlds: Any) -> tuple[float, float]:
    """Steps per second from the start of an episode, and processor time per step [s], children included."""
    count = len(worlds)
    worlds.begin(range(count))
    begin, used, steps = 0.0, 0.0, max(8, _STEPS * 4 // count)
    for k in range(steps + 3):
        if k == 3:
            begin, used = time.perf_counter(), _cpu_time()
        worlds.step(_onward(worlds))
        worlds.observation()
    return count * steps / (time.perf_counter() - begin), (_cpu_time() - used) / (count * steps)


def _cpu_time() -> float:
    """Of this process and its children [s]."""
    import psutil

    this = psutil.Process()
    times = [one.cpu_times() for one in (this, *this.children())]
    return sum(one.user + one.system for one in times)


def physics(scene: Path, runs: int) -> dict[str, Any]:
    """One world without pictures, one core."""
    import twin
    from twin.env.drivers import RouteDriver

    environment = twin.load(scene, standard_tasks(scene)[-1], 0, **one_obstacle(scene), pixels=False)
    return {"physics.steps_per_s": max(_pace(environment, RouteDriver(), lambda: None)[0] for _ in range(2 * runs))}


def memory(scene: Path, count: int) -> dict[str, Any]:
    worlds = _worlds(scene, count)
    worlds.begin(range(count))
    for _ in range(5):
        worlds.step(_onward(worlds))
        worlds.observation()
    worlds.begin([0])
    worlds.close()
    peaks = [resource.getrusage(who).ru_maxrss * 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    # Of the children the largest counts; they are alike.
    return {f"worlds{count}.bytes": peaks[0] + peaks[1] * getattr(worlds, "processes", 0)}


def soak(scene: Path, steps: int) -> dict[str, Any]:
    import psutil

    from twin.env.suite import EnvFactory
    from twin.env.vector_env_local import LocalVectorEnv

    count = 8
    stage = EnvFactory.open(scene, standard_tasks(scene)[-1], {"randomise": True, "obstacles": 3})
    worlds = LocalVectorEnv(stage, list(range(count)))  # here, where bodies can be looked at
    worlds.begin(range(count))
    rng, sizes, episodes, bad = np.random.default_rng(0), [], 0, 0
    rounds = steps // count
    for k in range(rounds):
        # Mostly forward, so that episodes get somewhere.
        actions = np.stack([rng.uniform(0, 1, count), rng.uniform(-0.3, 0.3, count)], 1)
        out = worlds.step(actions)
        bad += int(~np.isfinite(out.reward).all()) + sum(
            not np.isfinite(p.data.qpos).all() or not np.isfinite(p.data.qvel).all() for p in worlds.physics
        )
        over = np.flatnonzero(out.over).tolist()
        if over:
            episodes += len(over)
            worlds.begin(over)
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
    """The same as `batch` on a GPU, nothing but the field in view."""
    import warp

    worlds = _worlds(scene, count, device="cuda", obstacles=())
    worlds.begin(range(count))
    begin, steps = 0.0, 30
    for k in range(steps + 3):
        if k == 3:  # compiled, and captured
            warp.synchronize()
            begin = time.perf_counter()
        worlds.step(_onward(worlds))
        worlds.pixels.tensor()
    warp.synchronize()
    return {"gpu.worlds": count, "gpu.steps_per_s": count * steps / (time.perf_counter() - begin)}


def host(scene: Path, count: int) -> dict[str, Any]:
    """What the host does for worlds on a GPU in a step, whatever the GPU: small steps and pictures are left out.

    It holds Python's lock throughout, so `host.steps_per_s` is the most that `Worlds.step` comes to with any GPU;
    `host.info_us` is what asking a world for its `info` and `state` costs besides, as stable-baselines3 does.
    """
    import dataclasses

    import warp

    from twin.env.suite import EnvFactory
    from twin.env.vector_env_gpu import GpuSimulation, GpuVectorEnv
    from twin.nerf.baked import BakedField

    with warp.ScopedDevice("cpu"):
        blank = warp.zeros((count, 64), dtype=warp.vec3), warp.ones((count, 64), dtype=float)

    def show(field: BakedField, cameras: Any, lighting: Any, take: Any) -> None:
        field.head_biases(lighting, len(cameras.camera_to_world))  # as `render_on_device` does, on the host
        take(*blank)

    GpuSimulation._advance, BakedField.render_on_device = lambda self: None, show  # type: ignore[method-assign]
    stage = EnvFactory.open(scene, standard_tasks(scene)[-1], {"obstacles": (), "size": (8, 8)})
    options = dataclasses.replace(stage.options, device="cuda")  # pictures that stay; the field itself is on the CPU
    worlds = GpuVectorEnv(dataclasses.replace(stage, options=options), list(range(count)), "cpu")
    begin = time.perf_counter()
    worlds.begin(range(count))
    begun, times = time.perf_counter() - begin, []
    for _ in range(23):
        times.append(time.perf_counter())
        worlds.step(_onward(worlds))
        worlds.pixels.tensor()
    step = float(np.median(np.diff(times)[2:]))
    asked = time.perf_counter()
    for i in range(count):
        worlds.info(i), worlds.state(i)
    asked = time.perf_counter() - asked
    return {
        "host.worlds": count,
        "host.us_per_step": 1e6 * step / count,
        "host.steps_per_s": count / step,
        "host.info_us": 1e6 * asked / count,
        "host.begin_ms": 1e3 * begun / count,
    }


def trust(scene: Path) -> dict[str, Any]:
    """See `twin.env.trust`: depth error against the known truth at poses on and off the filmed path, by trust."""
    from env_trust import trust_against_truth

    return trust_against_truth(scene)


def _worlds(scene: Path, count: int, processes: int | None = None, **options: Any) -> Any:
    from twin.env.vector_env import make_vector_env

    options = one_obstacle(scene) | options
    return make_vector_env(scene, standard_tasks(scene)[-1], options, list(range(count)), processes)


def _onward(worlds: Any) -> np.ndarray:
    """Straight on at full speed."""
    return np.tile(np.array([1.0, 0.0]), (len(worlds), 1))


if __name__ == "__main__":
    what, folder, *numbers = sys.argv[1:]
    print(json.dumps(globals()[what](Path(folder), *map(int, numbers))))
