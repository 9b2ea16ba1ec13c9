"""Sections of `env.py`. Each takes a built scene and a flag `quick` for a shorter run, and returns figures by name."""

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from env_workers import standard_tasks
from numpy.typing import NDArray
from sections import run_worker


def worker(*arguments: str | Path | int, cores: int = 1) -> dict[str, Any]:
    """Figures of a function of `env_workers.py`, run in a process that is bound to `cores` cores; see `run_worker`."""
    threads = {"OMP_NUM_THREADS": str(cores), "OPENBLAS_NUM_THREADS": str(cores)}
    # MuJoCo selects its OpenGL at import; these select Mesa's software renderer.
    threads |= {"MUJOCO_GL": "egl", "LIBGL_ALWAYS_SOFTWARE": "1"}
    own = sorted(os.sched_getaffinity(0))[:cores]
    return run_worker("env_workers.py", arguments, threads, ("taskset", "-c", ",".join(map(str, own))))


def speed(scene: Path, quick: bool) -> dict[str, Any]:
    """Environment steps per second with pixels and one obstacle in view: one environment on one core, 8 or 64 on two.

    `ratio_to_software_gl`: speed of one environment divided by that of the same environment with `mujoco.Renderer`
    images of the extracted mesh in software OpenGL (Mesa through EGL); both alternate in one process.
    `ratio_to_one_process`: speed of a vector env in two processes divided by that of a vector env in one process with
    two threads; their runs alternate.
    `cpu_ms_per_step`: processor time, which depends less than wall time on other load of the machine.
    `load_s`: time of `twin.load` and the first reset with cached kernels.
    """
    runs = 1 if quick else 4
    out = worker("single", scene, runs)
    out |= worker("batch", scene, 8, runs, cores=2)
    out |= worker("physics", scene, runs)
    if not quick:
        out |= worker("batch", scene, 64, 1, cores=2)
    return out


def memory(scene: Path, quick: bool) -> dict[str, Any]:
    """Peak memory of all processes of a vector env of 64 environments, after steps with pixels."""
    return worker("memory", scene, 4 if quick else 64, cores=2)


class BlindDriver:
    """Drives straight at full speed, regardless of the images."""

    def __call__(self, environment: Any, step: Any) -> NDArray[np.float64]:
        spec = environment.action_spec()
        return np.array([0.0]) if spec.shape == (1,) else np.array([spec.maximum[0], 0.0])


def driver(scene: Path, quick: bool) -> dict[str, Any]:
    """Success rates of the scripted driver and of one that drives straight on (`blind`), without obstacles, by task.

    Each rate is over `driver.n` episodes with seeds 0, 1, ...; in `driver.random_robot` the robot is sampled from the
    default ranges of domain randomization.
    """
    import twin
    from twin.env.drivers import RouteDriver

    opened, count = twin.load_scene(scene), 3 if quick else 100
    tasks = standard_tasks(scene)
    out: dict[str, Any] = {"driver.n": count}
    for task in tasks:
        for name, kind, options in (
            ("success", RouteDriver, {}),
            ("random_robot", RouteDriver, {"randomise": True}),
            ("blind", BlindDriver, {}),
        ):
            environment = twin.load(opened, task, pixels=False, obstacles=(), **options)
            causes: Counter = Counter()
            for seed in range(count):
                environment.task.seed(seed)
                step, drive = environment.reset(), kind()
                while not step.last():
                    step = environment.step(drive(environment, step))
                causes[environment.task.cause] += 1
            out[f"driver.{name}.{task}"] = causes["goal"] / count
    out["driver.success"] = min(out[f"driver.success.{task}"] for task in tasks)
    return out


def audit(scene: Path, quick: bool) -> dict[str, Any]:
    """Exploit audit (`audit.py`): control steps with each event in one hour of simulated time."""
    from audit import audit as run

    from twin.env.env_factory import EnvFactory

    found = run(EnvFactory.open(scene, standard_tasks(scene)[-1], {"pixels": False}), 0.02 if quick else 1.0).summary()
    out = {f"audit.{key}": found[key] for key in ("simulated_s", "wall_s", "steps_touching", "false_successes")}
    out |= {f"audit.ended.{cause}": n for cause, n in found["episodes"].items()}
    return out | {f"audit.{name}": n for name, n in found["steps_with"].items()}


def soak(scene: Path, quick: bool) -> dict[str, Any]:
    """Endurance: non-finite values and memory growth over random steps, with everything randomized per episode."""
    return worker("soak", scene, 400 if quick else 100_000, cores=2)


def trust(scene: Path, quick: bool) -> dict[str, Any]:
    """Validity of the trust score (`env_workers.py`): rendered depth error by trust, on and off the filmed path."""
    return worker("trust", scene, cores=2)


def gpu(scene: Path, quick: bool) -> dict[str, Any]:
    """Steps per second of 1024 environments on one GPU, with images that stay on it for torch."""
    import warp

    if not warp.is_cuda_available():
        return {"gpu.none": "no CUDA device is visible to warp"}
    return worker("gpu", scene, 8 if quick else 1024, cores=len(os.sched_getaffinity(0)))


def host(scene: Path, quick: bool) -> dict[str, Any]:
    """Host time per step of 1024 environments on a GPU, and the speed limit that follows from it; needs no GPU."""
    return worker("host", scene, 8 if quick else 1024, cores=len(os.sched_getaffinity(0)))


SECTIONS: dict[str, Callable[[Path, bool], dict[str, Any]]] = {
    "speed": speed,
    "memory": memory,
    "driver": driver,
    "audit": audit,
    "soak": soak,
    "trust": trust,
    "host": host,
    "gpu": gpu,
}
