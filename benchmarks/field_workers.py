"""Measurements that `field.py` runs in separate processes; each prints one line of JSON.

    python field_workers.py frames PLACE VIEWS CORES FRAMES REPEATS
    python field_workers.py ratio  PLACE VIEWS WIDTH REPEATS
    python field_workers.py first  PLACE VIEWS
    python field_workers.py memory SCENE FRAMES STEPS

PLACE is a scene with a baked field, or a folder that contains one; VIEWS is a file of `field_common.route_views`.
Functions import late, because the core count must be set, or the clock started, before the imports.
"""

import itertools
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def use_cores(count: int) -> None:
    """Binds this process to this many cores. Call it before importing numpy and torch, which count cores at import.

    The package itself chooses the number of threads, as on a machine with this many cores.

    Raises:
        OSError: the system cannot bind processes to cores.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise OSError("this system cannot bind a process to a core; figures per core need Linux")
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def frames(place: str, views: str, cores: str, count: str, repeats: str) -> dict[str, Any]:
    """Times [ms] of single frames, and frames per second of single frames and of batches."""
    use_cores(int(cores))
    import numpy as np
    from field_common import SIZE, load_baked, render

    field = load_baked(Path(place))
    poses, k, lightings = _views(views, int(count), field.lightings)

    def one(i: int) -> None:
        render(field, poses[i : i + 1], k, SIZE, lightings[i])

    for i in range(min(5, len(poses))):
        one(i)
    latency, speed, batched, busy = [], [], [], []
    for _ in range(int(repeats)):
        began, began_cpu = time.perf_counter(), time.process_time()
        for i in range(len(poses)):
            before = time.perf_counter()
            one(i)
            latency.append(time.perf_counter() - before)
        speed.append(len(poses) / (time.perf_counter() - began))
        busy.append((time.process_time() - began_cpu) / len(poses))
        began = time.perf_counter()
        render(field, poses, k, SIZE, lightings[0])
        batched.append(len(poses) / (time.perf_counter() - began))
    return {
        "fps": float(np.median(speed)),
        "ms": float(np.median(latency)) * 1e3,
        "ms_95": float(np.quantile(latency, 0.95)) * 1e3,
        "cpu_ms": float(np.median(busy)) * 1e3,
        "batch_fps": float(np.median(batched)),
    }


def ratio(place: str, views: str, width: str, repeats: str) -> dict[str, Any]:
    """Frame times on one core, in turns: a frame of plain Nerfacto, one of tuned Nerfacto, eight of the baked field."""
    use_cores(1)
    import nerfacto_reference
    import nerfacto_tuned
    import numpy as np
    import torch
    from field_common import SIZE, load_baked, render
    from nerfacto_reference import Nerfacto

    torch.set_num_threads(1)
    field = load_baked(Path(place))
    size = (int(width), round(int(width) * SIZE[1] / SIZE[0]))
    poses, k, lightings = _views(views, 8 * int(repeats), field.lightings)
    k = k * size[0] / SIZE[0]
    low, high = field.bounds
    scaled = poses.copy()  # in Nerfacto's units
    scaled[:, :3, 3] = (poses[:, :3, 3] - (low + high) / 2) / (high - low).max() * 2
    scaled = torch.as_tensor(scaled, dtype=torch.float32)
    intrinsics, networks = torch.as_tensor(k), nerfacto_reference.networks()
    plain, tuned = Nerfacto(*networks), nerfacto_tuned.tuned(*networks)

    def seconds(reference: Nerfacto, i: int, chunk: int, shrink: int = 1) -> float:
        began = time.perf_counter()
        reference.frame(scaled[i], intrinsics / shrink, (size[0] // shrink, size[1] // shrink), chunk)
        return time.perf_counter() - began

    seconds(plain, 0, nerfacto_reference.CHUNK, 8)  # a small image, to load everything
    seconds(tuned, 0, nerfacto_tuned.CHUNK)
    render(field, poses[:1], k, size, lightings[0])
    turns = []
    for first_view in range(0, 8 * int(repeats), 8):
        plain_s = seconds(plain, first_view, nerfacto_reference.CHUNK)
        tuned_s = seconds(tuned, first_view, nerfacto_tuned.CHUNK)
        baked_s = []
        for i in range(first_view, first_view + 8):
            began = time.perf_counter()
            render(field, poses[i : i + 1], k, size, lightings[i])
            baked_s.append(time.perf_counter() - began)
        turns.append((plain_s, tuned_s, float(np.median(baked_s))))
    plain_times, tuned_times, baked_times = np.transpose(turns)
    return {
        "ratio_to_nerfacto": float(np.median(plain_times / baked_times)),
        "ratio_to_nerfacto_tuned": float(np.median(tuned_times / baked_times)),
        "nerfacto_s": float(np.median(plain_times)),
        "nerfacto_tuned_s": float(np.median(tuned_times)),
        "ms_beside_nerfacto": float(np.median(baked_times)) * 1e3,
    }


def first(place: str, views: str) -> dict[str, Any]:
    """Start-up time: `import_s`, then `first_frame_s` from loading the field to the first frame."""
    began = time.perf_counter()
    from field_common import SIZE, load_baked, render

    import twin.loading
    import twin.nerf.baked  # noqa: F401

    imported = time.perf_counter()
    poses, k, _ = _views(views, 1, ("",))
    loading = time.perf_counter()
    field = load_baked(Path(place))
    loaded = time.perf_counter()
    render(field, poses[:1], k, SIZE, field.lightings[0])
    done = time.perf_counter()
    return {"import_s": imported - began, "load_s": loaded - loading, "first_frame_s": done - loading}


def memory(scene: str, count: str, steps: str) -> dict[str, Any]:
    """Peak resident memory of training on `count` frames; the scene's frames repeat if there are fewer."""
    from dataclasses import replace

    import numpy as np
    from fuzzing.cases import peak_memory

    from twin.config_file import load_config
    from twin.files import read_json
    from twin.geometry.cameras import Cameras, SparsePoints
    from twin.nerf.dataset import constant_height
    from twin.nerf.trainer import train_field
    from twin.runtime import set_quiet
    from twin.scene import SceneDir

    set_quiet(True)
    paths = SceneDir(Path(scene))
    config = load_config(paths.config_file, ())
    cameras = Cameras.load(paths.stage("metric"))
    points = SparsePoints.load(paths.stage("metric"))
    cameras = replace(cameras, held_out=np.zeros(len(cameras), bool))
    chosen = np.resize(np.arange(len(cameras)), int(count))  # keeps the frames' indices, to which the points refer
    height = constant_height(read_json(paths.stage("metric") / "metric.json")) if config.mjcf.route else 0.0
    trained, *_ = train_field(
        cameras.select(chosen), points, replace(config.nerf, steps=int(steps)), config.seed, height, "cpu"
    )
    size = cameras.sizes[0] * min(1.0, config.nerf.max_width / cameras.sizes[0].max())
    return {"peak_bytes": peak_memory(), "frames": len(trained.appearance.frames), "size": np.rint(size).tolist()}


def _views(file: str, count: int, lightings: tuple[str, ...]) -> tuple[Any, Any, list[str]]:
    """Poses spread along the route, intrinsics, and a lighting per pose: the field's lightings and mixtures in turn."""
    import numpy as np

    with np.load(file) as data:
        poses, intrinsics = data["poses"], data["intrinsics"]
    chosen = np.linspace(0, len(poses) - 1, count).round().astype(int)
    mixtures = [f"{a}:{b}:0.3" for a, b in itertools.pairwise(lightings)]
    every = [*lightings, *mixtures]
    return poses[chosen], intrinsics, [every[i % len(every)] for i in range(count)]


if __name__ == "__main__":
    workers: dict[str, Callable[..., dict[str, Any]]] = {"frames": frames, "ratio": ratio, "first": first}
    workers["memory"] = memory
    work = workers[sys.argv[1]]
    print(json.dumps(work(*sys.argv[2:])))
