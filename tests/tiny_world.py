"""A small made-up scene as the mesh stage would leave it: rolling ground, a bent road, two boxes beside it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.config import MjcfConfig, SceneConfig
from twin.geometry.cameras import Cameras
from twin.mjcf.scene_xml import run
from twin.mjcf.world import World
from twin.scene import SceneDir

CELL = 0.1
_QUADS = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
BOX_FACES = _QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def box(center, size) -> np.ndarray:
    """The eight corners, ordered for BOX_FACES."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.concatenate([np.insert(square, 2, side, axis=1) for side in (-1, 1)])
    return np.asarray(center) + corners * np.asarray(size) / 2


def tiny_ground() -> Ground:
    x, y = np.arange(-3.0, 12.0, CELL), np.arange(-8.0, 3.0, CELL)
    grid_x, grid_y = np.meshgrid(x, y)
    height = 0.3 + 0.05 * np.sin(grid_x / 2) + 0.04 * np.cos(grid_y / 1.5) + 0.02 * grid_x
    rgb = np.full((*height.shape, 3), 90, np.uint8)
    return Ground(height, np.array([x[0], y[0]]), CELL, np.ones(height.shape, bool), rgb)


def tiny_route() -> np.ndarray:
    """5 m along x, a quarter turn to the right of radius 3 m, 1 m on: shape (m, 2)."""
    angle = np.arange(0.0, np.pi / 2, 0.25 / 3)
    straight = np.stack([np.arange(0.0, 5.0, 0.25), np.zeros(20)], 1)
    bend = np.stack([5 + 3 * np.sin(angle), -3 + 3 * np.cos(angle)], 1)
    end = np.stack([np.full(5, 8.0), -3 - np.arange(0.0, 1.25, 0.25)], 1)
    return np.concatenate([straight, bend, end])


def tiny_scene(root: Path, boxes=((3.0, 2.2, 0.8), (4.0, -3.0, 0.8)), route: bool = True) -> SceneDir:
    """Writes stages `metric` and `mesh`; boxes of 0.6 m stand at the given x, y, z."""
    scene = SceneDir(root)
    mesh, metric = scene.stage("mesh"), scene.stage("metric")
    mesh.mkdir(parents=True)
    metric.mkdir()
    ground = tiny_ground()
    ground.save(mesh)
    vertices = np.concatenate([box(center, (0.6, 0.6, 0.8)) for center in boxes] or [np.zeros((0, 3))]).astype(
        np.float32
    )
    faces = np.tile(BOX_FACES, (len(boxes), 1)).astype(np.int32)
    starts = np.arange(len(boxes) + 1)
    np.savez(mesh / "parts.npz", vertices=vertices, faces=faces, vertex_start=8 * starts, face_start=12 * starts)
    shifted = (faces + 8 * np.repeat(starts[:-1], 12)[:, None]).astype(np.int32)
    colors = np.random.default_rng(0).integers(0, 255, (len(vertices), 3)).astype(np.uint8)
    np.savez(mesh / "visual.npz", vertices=vertices, faces=shifted, colors=colors)
    if route:
        np.savez(mesh / "route.npz", xy=tiny_route(), z=ground.at(tiny_route()))
    pose = np.eye(4)[None].repeat(3, 0)
    Cameras(
        names=("day/000000", "day/000001", "day/000002"),
        camera_to_world=pose,
        intrinsics=np.array([[1.0, 1.0, 1.0, 1.0], [500.0, 510.0, 330.0, 170.0], [2.0, 2.0, 2.0, 2.0]]),
        sizes=np.tile([640, 360], (3, 1)),
        lightings=("day",) * 3,
        sources=("day",) * 3,
        times=np.arange(3.0),
        held_out=np.array([True, False, False]),
        images=scene.stage("cameras") / "images",
    ).save(metric)
    return scene


def tiny_config(**mjcf) -> SceneConfig:
    return replace(SceneConfig(name="tiny"), mjcf=MjcfConfig(**mjcf))


def export(scene: SceneDir, config: SceneConfig | None = None) -> tuple[Path, dict[str, Any]]:
    """Runs the stage `mjcf`; its folder and metrics."""
    out = scene.stage("mjcf")
    out.mkdir()
    return out, run(scene, config or tiny_config(), out)


def tiny_world(root: Path, **mjcf) -> World:
    return World.load(export(tiny_scene(root), tiny_config(**mjcf))[0])
