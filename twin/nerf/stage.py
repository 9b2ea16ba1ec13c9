"""Stage `field`: metric cameras → a trained radiance field, the same baked for rendering, and how good both are."""

from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from twin.config import SceneConfig
from twin.files import read_json
from twin.geometry.cameras import Cameras
from twin.geometry.points import SparsePoints
from twin.nerf.bake import bake
from twin.nerf.crosslight import cross_lighting
from twin.nerf.dataset import TrainingPixels
from twin.nerf.evaluate import evaluate
from twin.nerf.fit import fit
from twin.scene import SceneDir

_TIMES = ("seconds", "seconds_train", "rays_per_second")
_HEIGHT_SPREAD = 0.1  # a camera height that varies by more than this share is not constant


def constant_height(metric: dict[str, Any]) -> float:
    """The camera's height above the ground [m], if the metric stage found it to be known and constant; else 0."""
    height, spread = metric.get("camera_height_median_m"), metric.get("local_height_spread_m")
    if not height or not (metric.get("road_reliable") or metric.get("scale_source") == "camera_height"):
        return 0.0
    return 0.0 if spread is not None and spread > _HEIGHT_SPREAD * height else float(height)


def untimed(metrics: dict[str, Any]) -> dict[str, Any]:
    """Metrics without how long it took: the same field is the same file, and what was fitted to it stays valid."""
    return {
        name: untimed(value) if isinstance(value, dict) else value
        for name, value in metrics.items()
        if name not in _TIMES
    }


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Stage `field`: trains on the metric cameras, scores the held-out frames, saves the field.

    Raises:
        InputError: nothing to train on, an unreadable frame, or a device that is not there.
    """
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    height = constant_height(read_json(scene.stage("metric") / "metric.json")) if config.mjcf.route else 0.0
    field, metrics, cameras = fit(cameras, points, config.nerf, config.seed, height)
    pixels = TrainingPixels(cameras, points, config.nerf.max_width)
    baked, metrics["bake"] = bake(field, pixels, config.seed, config.nerf.bake_steps, config.nerf.max_bricks)
    metrics |= evaluate(field, cameras, config.nerf.max_width, baked=baked)
    metrics["cross_lighting"] = cross_lighting(baked, cameras)
    field.about = {
        "scene": config.name,
        "seed": config.seed,
        "nerf": asdict(config.nerf),
        "versions": {name: metadata.version(name) for name in ("twin", "torch", "warp-lang", "numpy")},
        "metrics": untimed(metrics),
    }
    field.save(out)
    baked.about = field.about
    baked.save(out)
    return metrics
