"""How fast and how well a field trains: a table on standard output, numbers as JSON where asked.

    python benchmarks/field_train.py SCENE [--set nerf.steps=4000] [--profile 20] [--json FILE]

SCENE is a scene folder whose `metric` stage is built. The field is trained and scored on the held-out frames; nothing
is written into the scene. `--profile N` also says what N of the steps spend their time on, on one core.
"""

import argparse
import json
import resource
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from twin.config_file import load_config
from twin.geometry.cameras import Cameras
from twin.geometry.points import SparsePoints
from twin.nerf import compute, fit, network
from twin.nerf.evaluate import evaluate
from twin.nerf.stage import constant_height
from twin.scene import SceneDir, read_json


def profile(trainer: fit.Trainer, steps: int) -> dict[str, float]:
    """Processor time per step of each part [ms], on one core, over `steps` steps."""
    spent: dict[str, float] = defaultdict(float)
    originals = []

    def watch(owner: Any, name: str) -> None:
        original = getattr(owner, name)
        originals.append((owner, name, original))

        def timed(*args: Any, **kwargs: Any) -> Any:
            began = time.thread_time()
            result = original(*args, **kwargs)
            spent[args[0].key if name == "launch" else name] += time.thread_time() - began
            return result

        setattr(owner, name, timed)

    for owner, names in (
        (wp, ("launch",)),
        (network, ("trunk", "trunk_backward", "head", "ray_features", "spherical_harmonics")),
        (torch.autograd, ("grad",)),
        (trainer.pixels, ("batch",)),
        (trainer.optimiser, ("step",)),
    ):
        for name in names:
            watch(owner, name)
    all_cores, compute.cores = compute.cores, lambda: 1
    began = time.thread_time()
    with compute.single_threaded_torch():
        for _ in range(steps):
            trainer.step()
    spent["all"] = time.thread_time() - began
    compute.cores = all_cores
    for owner, name, original in originals:
        setattr(owner, name, original)
    return {name: round(seconds / steps * 1e3, 2) for name, seconds in sorted(spent.items(), key=lambda x: -x[1])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--profile", type=int, default=0, metavar="STEPS")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    scene = SceneDir(options.scene)
    config = load_config(scene.config_file, tuple(options.set))
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    height = constant_height(read_json(scene.stage("metric") / "metric.json")) if config.mjcf.route else 0.0
    result: dict[str, Any] = {"device": compute.device(), "cores": compute.cores()}
    if options.profile:
        trainer = fit.Trainer(cameras, points, config.nerf, config.seed, compute.device(), camera_height=height)
        with compute.single_threaded_torch():
            for _ in range(100):  # until sampling has settled
                trainer.step()
        result["ms_per_step"] = profile(trainer, options.profile)
    field, metrics = fit.fit(cameras, points, config.nerf, config.seed, height)
    began = time.perf_counter()
    result |= {k: v for k, v in metrics.items() if k != "curve"} | evaluate(field, cameras, config.nerf.max_width)
    result["seconds_evaluate"] = round(time.perf_counter() - began, 2)
    views = cameras.select(np.arange(4))
    began = time.perf_counter()
    field.render(views, field.lightings[0], (160, 90))
    result["render_160x90_seconds"] = round((time.perf_counter() - began) / 4, 3)
    result["peak_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

    for key, value in result.items():
        if isinstance(value, dict):
            print(key)
            for name, number in value.items():
                print(f"    {name:24} {number}")
        else:
            print(f"{key:28} {value}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
