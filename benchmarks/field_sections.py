"""Sections of `field.py`. Each returns figures by name.

*Unfitted* and *fitted* scores are defined in `twin/nerf/evaluate.py`. A *budget* is the wall time [s] from the start of
training to the finished field, including stereo and the reading of frames; kernels are compiled before it starts.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from field_common import SIZE, Bench, load_baked, load_field, render, route_views, worker

from twin.config import NerfConfig
from twin.config_file import load_config
from twin.geometry.cameras import Cameras, SparsePoints, Viewpoints
from twin.nerf import buffers
from twin.scene import SceneDir

_MARGIN = 0.05  # fraction of a budget kept for errors of the predicted pace
_PROBE_STEPS = {"cpu": 150, "cuda": 1500}  # training steps that measure the pace
_NEAR = 10.0  # [m] depth errors are evaluated up to this depth

Figures = dict[str, Any]


@dataclass(frozen=True)
class Pace:
    """Training time: seconds before the first step, and per step."""

    overhead: float
    step: float

    def steps(self, budget: float) -> int:
        """Steps that fit into a budget [s] less the margin."""
        return max(1, int(((1.0 - _MARGIN) * budget - self.overhead) / self.step))


def timed_fit(
    cameras: Cameras, points: SparsePoints, config: NerfConfig, steps: int, device: str = "cpu"
) -> tuple[Any, float, Pace]:
    """Trains a field for `steps` steps; returns the field, the wall time [s] and the pace."""
    from twin.nerf.trainer import train_field

    began = time.perf_counter()
    field, metrics, *_ = train_field(cameras, points, replace(config, steps=steps), device=device)
    wall = time.perf_counter() - began
    return field, wall, Pace(wall - metrics["seconds_train"], metrics["seconds_train"] / steps)


def fox(bench: Bench) -> Figures:
    """Training within budgets on the fox capture.

    Poses are those of the capture, every 8th image (270×480 px) is held out, and settings are the defaults.
    """
    cameras, points = _fox_scene(bench)
    config = replace(NerfConfig(), max_width=bench.pick(NerfConfig().max_width, 96))
    budgets = bench.pick(bench.budgets, (10,))
    return {f"fox.{key}": value for key, value in _within_budgets(bench, cameras, points, config, budgets).items()}


def _fox_scene(bench: Bench) -> tuple[Cameras, SparsePoints]:
    """Cameras and points of the fox from the build stages, which undistort the images and keep the poses."""
    from twin.build import build

    root = bench.work / "fox"
    if not (root / "build").exists():
        root.mkdir()
        (root / "scene.toml").write_text(
            f'[[source]]\npath = "{(bench.data / "fox/transforms_orig_1080x1920.json").resolve().as_posix()}"\n'
            'lighting = "indoor"\n[capture]\nheld_out_every = 8\n[metric]\nposes_are_metric = true\nup = "cameras"\n'
            "[mjcf]\nroute = false\n",
            encoding="utf-8",
        )
        build(root, until="metric", overrides=bench.pick((), ("capture.max_size=240", "cameras.features=500")))
    folder = SceneDir(root).stage("metric")
    return Cameras.load(folder), SparsePoints.load(folder)


def _within_budgets(
    bench: Bench,
    cameras: Cameras,
    points: SparsePoints,
    config: NerfConfig,
    budgets: tuple[int, ...],
    device: str = "cpu",
) -> Figures:
    from twin.nerf.dataset import load_frame
    from twin.nerf.evaluate import evaluate

    timed_fit(cameras, points, config, 2, device)  # compiles kernels and warms the file cache
    _, _, pace = timed_fit(cameras, points, config, bench.pick(_PROBE_STEPS[device], 20), device)
    found: Figures = {"overhead_s": pace.overhead, "step_s": pace.step}
    found["frame_size"] = "{1}x{0}".format(*load_frame(cameras, 0, config.max_width)[1].shape)
    for budget in budgets:
        steps = pace.steps(budget)
        field, wall, pace = timed_fit(cameras, points, config, steps, device)
        scores = evaluate(field, cameras, config.max_width, max_frames=len(cameras))
        (name,) = field.lightings
        found |= {
            f"psnr_{budget}s": scores["psnr"][name],
            f"psnr_{budget}s_unfitted": scores["psnr_unfitted"][name],
            f"ssim_{budget}s": scores["ssim"][name],
            f"seconds_{budget}s": wall,
            f"steps_{budget}s": steps,
            "n": scores["n"][name],
        }
    return found


def bake(bench: Bench) -> Figures:
    """Baking: PSNR loss over all held-out frames, size of the baked field, and time."""
    from twin.nerf.evaluate import evaluate

    scene = SceneDir(bench.scene)
    field = load_field(bench.scene)
    baked, report, seconds = _bake(bench, field)
    width = load_config(scene.config_file, ()).nerf.max_width
    cameras = Cameras.load(scene.stage("metric"))
    scores = evaluate(field, cameras, width, bench.pick(len(cameras), 1), baked=baked)
    drops = {name: -gain for name, gain in scores["baking_gain"].items()}
    file = bench.work / "baked/baked.safetensors"
    return {
        "bake.psnr_drop": float(np.mean(list(drops.values()))),
        **{f"bake.psnr_drop.{name}": drop for name, drop in drops.items()},
        **{f"bake.psnr_unfitted.{name}": value for name, value in scores["psnr_unfitted"].items()},
        "bake.n": sum(scores["n"].values()),
        "bake.bytes": baked.bytes,
        "bake.file_bytes": file.stat().st_size,
        "bake.seconds": seconds,
        "bake.bricks": report["bricks_near"] + report["bricks_far"],
        "bake.cell_m": report["cell_m"],
    }


def _bake(bench: Bench, field: Any) -> tuple[Any, Figures, float]:
    """Bakes the scene's field into the work folder; returns the baked field, the report of `bake`, wall time [s]."""
    import warp as wp

    from twin.nerf.bake import bake as run
    from twin.nerf.dataset import TrainingPixels

    scene = SceneDir(bench.scene)
    config = load_config(scene.config_file, ())
    cameras, points = Cameras.load(scene.stage("metric")), SparsePoints.load(scene.stage("metric"))
    pixels = TrainingPixels(cameras, points, config.nerf.max_width)
    wp.load_module("twin.nerf.kernels.bricks", device=field.device)
    began = time.perf_counter()
    size = {"steps": config.nerf.bake_steps, "max_bricks": config.nerf.max_bricks}  # as a build, but for its detail
    baked, report = run(field, pixels, config.seed, **bench.pick(size, {"steps": 5, "max_bricks": 1500}))
    seconds = time.perf_counter() - began
    folder = bench.work / "baked"
    folder.mkdir(exist_ok=True)
    baked.save(folder)
    return baked, report, seconds


def baked_path(bench: Bench) -> Path:
    """Path of a baked field: the scene's own, or one that is baked into the work folder."""
    if (SceneDir(bench.scene).stage("field") / "baked.json").exists():
        return bench.scene
    folder = bench.work / "baked"
    if not (folder / "baked.json").exists():
        _bake(bench, load_field(bench.scene))
    return folder


def speed(bench: Bench) -> Figures:
    """Rendering speed of 160×90 images with depth along the route, in separate processes."""
    place, views = baked_path(bench), route_views(bench)
    count, repeats = bench.pick((60, 5), (4, 1))
    found: Figures = {}
    for cores in (1, 2)[: buffers.available_cores()]:
        row = worker("frames", place, views, cores, count, repeats)
        found |= {f"render.{key}_{cores}core": value for key, value in row.items()}
    row = worker("ratio", place, views, bench.pick(SIZE[0], 16), bench.pick(3, 1))
    found |= {f"render.{key}": value for key, value in row.items()}
    return found | _first_frame(bench, place, views)


def _first_frame(bench: Bench, place: Path, views: Path) -> Figures:
    """Time to the first frame of a new process: median of three with cached kernels, and one with an empty cache."""
    runs = [worker("first", place, views) for _ in range(bench.pick(4, 1))]
    runs = runs[1:] or runs  # the first one fills the file cache
    warm = {key: float(np.median([run[key] for run in runs])) for key in runs[0]}
    cache = bench.work / "cold_cache"
    cold = worker("first", place, views, environment={"WARP_CACHE_PATH": str(cache)})
    return {
        "render.import_s": warm["import_s"],
        "render.load_s": warm["load_s"],
        "render.first_frame_s": warm["first_frame_s"],
        "render.first_frame_cold_s": cold["first_frame_s"],
        "render.cold_compile_s": cold["first_frame_s"] - warm["first_frame_s"],
    }


def depth(bench: Bench) -> Figures:
    """Error of rendered depth against the known truth up to 10 m, at the true camera poses."""
    from twin.reality.truth import Truth, align_poses, depth_errors, matched_poses

    scene = SceneDir(bench.scene)
    if not (scene.truth / "truth.npz").exists():
        return {"depth.none": "the scene has no known truth"}
    truth = Truth.load(scene.truth)
    cameras = Cameras.load(scene.stage("metric"))
    to_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras))
    found: Figures = {}
    for suffix, field in (("", load_baked(baked_path(bench))), ("_field", load_field(bench.scene))):
        errors = depth_errors(field, truth, to_truth, _NEAR)
        found[f"depth.median_error{suffix}_m"] = errors["depth_median_m"]
        found[f"depth.median_relative{suffix}"] = errors["depth_relative"]
    return found


def train(bench: Bench) -> Figures:
    """Peak memory of a separate process that trains on 200 frames of the scene, at the size used in training."""
    row = worker("memory", bench.scene, bench.pick(200, 12), bench.pick(60, 3))
    size = "{:.0f}x{:.0f}".format(*row["size"])
    return {"train.peak_bytes": row["peak_bytes"], "train.frames": row["frames"], "train.frame_size": size}


def gpu(bench: Bench) -> Figures:
    """Training and rendering on CUDA, if both torch and Warp support the device."""
    import torch
    import warp as wp

    if not (torch.cuda.is_available() and wp.is_cuda_available()):
        return {"gpu.none": "no CUDA device here; nothing of this section was measured"}
    found: Figures = {"gpu.device": torch.cuda.get_device_name()}
    cameras, points = _fox_scene(bench)
    config = replace(NerfConfig(), max_width=bench.pick(960, 96))
    row = _within_budgets(bench, cameras, points, config, (bench.pick(60, 10),), "cuda")
    found |= {f"gpu.fox.{key}": value for key, value in row.items()}
    if bench.scene is None:
        return found
    place = baked_path(bench)
    with np.load(route_views(bench)) as data:
        poses, k = data["poses"], data["intrinsics"]
    poses = poses[np.linspace(0, len(poses) - 1, bench.pick(256, 4)).round().astype(int)]
    on_gpu, on_cpu = load_baked(place, "cuda"), load_baked(place, "cpu")
    name = on_gpu.lightings[0]
    render(on_gpu, poses, k, SIZE, name)
    views = Viewpoints.of(poses, k, SIZE)
    times: dict[str, list[float]] = {"to_host": [], "on_device": []}
    for _ in range(bench.pick(10, 2)):
        began = time.perf_counter()
        render(on_gpu, poses, k, SIZE, name)  # returns numpy arrays, so it has finished
        times["to_host"].append(time.perf_counter() - began)
        began = time.perf_counter()
        on_gpu.render_on_device(views, name, lambda rgb, opacity: wp.synchronize())
        times["on_device"].append(time.perf_counter() - began)
    some = poses[:: max(1, len(poses) // 8)]
    difference = np.abs(render(on_gpu, some, k, SIZE, name).rgb - render(on_cpu, some, k, SIZE, name).rgb)
    return found | {
        "gpu.render_batch": len(poses),
        "gpu.render_fps": len(poses) / float(np.median(times["to_host"])),
        "gpu.render_on_device_fps": len(poses) / float(np.median(times["on_device"])),
        "gpu.cpu_difference_max": float(difference.max()),
        "gpu.cpu_difference_mean": float(difference.mean()),
    }


SECTIONS = {"fox": fox, "bake": bake, "render": speed, "depth": depth, "train": train, "gpu": gpu}
NEED_SCENE = ("bake", "render", "depth", "train")
