"""The sections of `env.py`: each takes the scene and whether to be quick, and returns figures by name."""

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from env_workers import standard_tasks

_HERE = Path(__file__).parent


def worker(*arguments: str | Path | int, cores: int = 1) -> dict[str, Any]:
    """What `env_workers.py` says, run in a process of its own that has so many cores.

    Raises:
        RuntimeError: it failed.
    """
    command = [sys.executable, str(_HERE / "env_workers.py"), *map(str, arguments)]
    path = os.pathsep.join(filter(None, [str(_HERE.parent), os.environ.get("PYTHONPATH", "")]))
    threads = {"OMP_NUM_THREADS": str(cores), "OPENBLAS_NUM_THREADS": str(cores)}
    # MuJoCo chooses its OpenGL when it is imported: Mesa's, which draws in software where there is no GPU.
    threads |= {"MUJOCO_GL": "egl", "LIBGL_ALWAYS_SOFTWARE": "1"}
    own = sorted(os.sched_getaffinity(0))[:cores]
    done = subprocess.run(
        ["taskset", "-c", ",".join(map(str, own)), *command],
        env=os.environ | threads | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, arguments))}:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def speed(scene: Path, quick: bool) -> dict[str, Any]:
    """Environment steps per second with pixels and one obstacle in view, of one world on one core and of eight on two.

    `ratio_to_software_gl` is one world's speed over that of the same environment whose picture is MuJoCo's own of the
    extracted mesh, drawn by `mujoco.Renderer` with OpenGL in software (Mesa through EGL), alternately in one process.
    `ratio_to_one_process` is that of many worlds in two processes over the same in one with two threads, alternately.
    `cpu_ms_per_step` is processor time, which other work on the machine disturbs less. `load_s` is `twin.load` and the
    first reset, kernels cached.
    """
    runs = 1 if quick else 4
    out = worker("single", scene, runs)
    out |= worker("batch", scene, 8, runs, cores=2)
    out |= worker("physics", scene, runs)
    if not quick:
        out |= worker("batch", scene, 64, 1, cores=2)
    return out


def memory(scene: Path, quick: bool) -> dict[str, Any]:
    """Peak memory of all processes of 64 worlds that have been stepped with pixels."""
    return worker("memory", scene, 4 if quick else 64, cores=2)


def driver(scene: Path, quick: bool) -> dict[str, Any]:
    """Share of episodes that the scripted driver brings to the goal, and the blind one, no obstacles, by task.

    `driver.n` episodes each, seeds 0, 1, ...; `driver.random_robot` the same with the robot drawn from the default
    ranges of domain randomisation.
    """
    import twin
    from twin.env.drivers import BlindDriver, RouteDriver

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
    """The exploit audit (`audit.py`): control steps with each event in an hour of simulated time."""
    from audit import audit as run

    from twin.env.suite import EnvFactory

    found = run(EnvFactory.open(scene, standard_tasks(scene)[-1], {"pixels": False}), 0.02 if quick else 1.0).summary()
    out = {f"audit.{key}": found[key] for key in ("simulated_s", "wall_s", "steps_touching", "false_successes")}
    out |= {f"audit.ended.{cause}": n for cause, n in found["episodes"].items()}
    return out | {f"audit.{name}": n for name, n in found["steps_with"].items()}


def soak(scene: Path, quick: bool) -> dict[str, Any]:
    """Random steps with pixels, robot, light, obstacles drawn for every episode: NaNs and growth of memory."""
    return worker("soak", scene, 400 if quick else 100_000, cores=2)


def trust(scene: Path, quick: bool) -> dict[str, Any]:
    """What the trust number is worth, where the truth is known: rendered depth error by trust, off the filmed path."""
    return worker("trust", scene, cores=2)


def overlay(scene: Path, quick: bool) -> dict[str, Any]:
    """Obstacles put into the twin against the same in the true world, see `overlay.py`; needs the known truth."""
    from overlay import KINDS, round_trip

    return round_trip(scene, None, KINDS[:1] if quick else KINDS)


def seen_touched(scene: Path, quick: bool) -> dict[str, Any]:
    """What the last build's report says of what is seen against what is solid (`twin.report.visual_vs_collision`)."""
    from twin.loading import load_scene

    found = load_scene(scene).report().get("seen_touched")
    if not found:
        return {"seen_touched.median_m": None}
    return {f"seen_touched.{name}": value for name, value in found.items() if isinstance(value, int | float)}


def gpu(scene: Path, quick: bool) -> dict[str, Any]:
    """1024 worlds on one GPU, physics and pictures, with the pictures left there for torch."""
    import warp

    if not warp.is_cuda_available():
        return {"gpu.none": "no CUDA device is visible to warp"}
    return worker("gpu", scene, 8 if quick else 1024, cores=len(os.sched_getaffinity(0)))


def host(scene: Path, quick: bool) -> dict[str, Any]:
    """What the host costs of 1024 worlds on a GPU, and what that leaves possible; needs no GPU."""
    return worker("host", scene, 8 if quick else 1024, cores=len(os.sched_getaffinity(0)))


SECTIONS: dict[str, Callable[[Path, bool], dict[str, Any]]] = {
    "speed": speed,
    "memory": memory,
    "driver": driver,
    "audit": audit,
    "soak": soak,
    "trust": trust,
    "overlay": overlay,
    "seen_touched": seen_touched,
    "host": host,
    "gpu": gpu,
}
