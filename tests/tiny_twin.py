"""A small built scene that every stage of an environment can be loaded from: `tiny_world`'s, with a field made up by
formula and two lightings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from test_baked import LOW, STEP, baked_of_arrays, networks, places
from tiny_world import tiny_config, tiny_ground, tiny_scene

from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.images import write_image
from twin.geometry.poses import look_at
from twin.mjcf.scene_xml import run
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BrickLayout, skip_distances
from twin.nerf.lightings import Lightings
from twin.robot import HuskyParams
from twin.scene import write_stamp

LAYOUT = BrickLayout((4.5, -2.5, 1.0), (8.0, 6.0, 2.0), 0.1, 0.5, (12, 9, 5), (8, 8, 4))

SCENE_TOML = """
name = "tiny"
[[source]]
path = "input/day.mp4"
[metric]
camera_height = 1.2
[[task]]
name = "ahead"
start = 0.5
length = 4.0
[[task]]
name = "bend"
start = 0.0
length = 10.0
"""


def tiny_twin(
    root: Path, boxes=((3.0, 2.2, 0.8), (4.0, -3.0, 0.8)), more: str = "", robot: HuskyParams | None = None
) -> Path:
    """Writes the scene folder; `more` goes to the end of its scene.toml."""
    scene = tiny_scene(root, boxes)
    (root / "scene.toml").write_text(SCENE_TOML + more)
    scene.stage("mjcf").mkdir()
    run(scene, replace(tiny_config(), robot=robot or HuskyParams()), scene.stage("mjcf"))
    scene.stage("field").mkdir()
    tiny_field(boxes).save(scene.stage("field"))
    for stage in ("metric", "mesh", "mjcf", "field"):
        write_stamp(scene.stage(stage), stage)
    return root


def tiny_field(boxes) -> BakedField:
    """Solid below the ground and in boxes of 0.6 × 0.6 × 0.8 m; brighter by day than by night."""
    ground, layout = tiny_ground(), LAYOUT
    near = np.argwhere(np.ones(layout.near_shape, bool)).astype(np.int32)
    far = np.argwhere(np.ones(layout.far_shape, bool)).astype(np.int32)
    inside = ((far / layout.far_shape >= 0.25) & ((far + 1) / layout.far_shape <= 0.75)).all(1)
    far = far[~inside]
    at = places(layout, near, far)
    solid = at[..., 2] < ground.at(at[..., :2])
    for center in boxes:
        solid |= (np.abs(at - np.array(center)) < [0.3, 0.3, 0.4]).all(-1)
    values = np.empty((*at.shape[:2], 16))
    values[..., 0] = np.where(solid, LOW + 255 * STEP, LOW)
    for c in range(15):
        values[..., c + 1] = np.sin(at @ np.array([1.0 + 0.2 * c, 0.7 - 0.1 * c, 0.5]))
    low, step = np.r_[LOW, np.full(15, -1.0)], np.r_[STEP, np.full(15, 2.0 / 255)]
    rng = np.random.default_rng(0)
    weights = networks()
    weights["network.head.0"][31, :3], weights["network.head.0"][32, :3] = 0.6, 0.1  # day and night
    weights["network.head.0"][33, 0], weights["network.head.0"][34, 2] = 0.1, 0.1
    probes = rng.uniform(-1, 1, (300, 15)), rng.uniform(-1, 1, (300, 16))
    arrays = {
        "near": near,
        "far": far,
        "features": np.rint((values - low) / step).astype(np.uint8),
        "low": low.astype(np.float32),
        "step": step.astype(np.float32),
        "probes.features": probes[0].astype(np.float32),
        "probes.harmonics": probes[1].astype(np.float32),
        **weights,
    }
    vectors = np.eye(2, 4, dtype=np.float32)
    frames = np.repeat(vectors, 4, 0) + rng.normal(0, 0.1, (8, 4)).astype(np.float32)
    names = Lightings(("day", "night"), vectors, tuple(f"{n}/{k}" for n in ("day", "night") for k in range(4)), frames)
    return baked_of_arrays(layout, names, arrays | skip_distances(layout, arrays))


FILM_SIZE = (96, 64)
"""Width and height of the frames of `filmed_tiny_twin` [px]."""


def filmed_tiny_twin(root: Path) -> Path:
    """A tiny twin filmed by six cameras under two lightings; the first frame is held out, two have masks."""
    tiny_twin(root)
    build = root / "build"
    names = [f"{lighting}/{k:06d}" for lighting in ("day", "night") for k in range(3)]
    eyes = np.array([[k * 1.5, 0.1 * k, 1.5] for k in range(3)] * 2)
    rng, (width, height) = np.random.default_rng(0), FILM_SIZE
    for i, name in enumerate(names):
        image = build / "2_cameras" / "images" / f"{name}.png"
        image.parent.mkdir(parents=True, exist_ok=True)
        write_image(image, rng.integers(0, 255, (height, width, 3)).astype(np.uint8))
        if i in (1, 4):
            mask = build / "1_capture" / "masks" / f"{name}.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            write_image(mask, np.full((height, width), 255 * (i == 1), np.uint8))
    cameras = Cameras(
        names=tuple(names),
        camera_to_world=np.array([look_at(eye, eye + np.array([3.0, 0.4, -0.8])) for eye in eyes]),
        intrinsics=np.array([[60.0, 61.0, 47.0, 33.0]] * 3 + [[70.0, 70.5, 48.5, 31.0]] * 3),
        sizes=np.tile(FILM_SIZE, (6, 1)),
        lightings=("day",) * 3 + ("night",) * 3,
        sources=("day",) * 3 + ("night",) * 3,
        times=np.arange(6.0),
        held_out=np.arange(6) == 0,
        images=build / "2_cameras" / "images",
        masks=build / "1_capture" / "masks",
    )
    xyz = rng.uniform([3, -1, 0], [6, 1, 1], (40, 3))
    point, frame = np.divmod(np.arange(240), 6)
    rgb = rng.integers(0, 255, (40, 3)).astype(np.uint8)
    cameras.save(build / "2_metric")
    SparsePoints(xyz, rgb, rng.uniform(0, 1, 40), point, frame).save(build / "2_metric")
    write_stamp(build / "2_metric", "metric")
    return root
