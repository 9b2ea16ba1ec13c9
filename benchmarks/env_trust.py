"""Validity of the trust score: rendered depth and color against the known truth, on and off the filmed path."""

from pathlib import Path
from typing import Any

import numpy as np
from overlay import SIZE, TrueWorld
from scipy.stats import spearmanr

from twin.env.trust import Trust
from twin.geometry.cameras import Viewpoints
from twin.geometry.poses import look_at
from twin.loading import load_scene
from twin.mjcf.world import arc_lengths, heading_at, point_at
from twin.reality.comparison import align_rigid, matched_poses
from twin.reality.lighting import LIGHTINGS
from twin.reality.truth import Truth

LATERALS = (0.0, 0.8, -1.6, 2.5, -4.0)  # [m] from the route
TURNS = (0.0, 20.0, -45.0, 90.0, 180.0)  # [°] from the route's heading
_EYE = 0.6  # [m] camera height
_STEP = 6.0  # [m] along the route between positions
_FAR = 20.0  # [m] errors are evaluated up to this true depth
_BINS = ((0.9, 1.01), (0.5, 0.9), (0.0, 0.5))  # ranges of the trust score


def trust_against_truth(path: Path) -> dict[str, Any]:
    """Median depth error [m] and PSNR [dB] of images by their trust, and rank correlations of trust with both."""
    scene = load_scene(path)
    world, field, trust = scene.world(), scene.field(), Trust(scene.cameras())
    truth, cameras = Truth.load(scene.scene.truth), scene.cameras()
    to_truth = align_rigid(cameras.camera_to_world, matched_poses(truth, cameras))
    lighting = next(name for name in field.lightings if name in LIGHTINGS)
    true_world = TrueWorld(truth, lighting, world.intrinsics)
    rows = []
    for s in np.arange(3.0, arc_lengths(world.route)[-1] - 3.0, _STEP):
        for lateral in LATERALS:
            for turn in TURNS:
                pose = _pose(world.route, float(s), lateral, turn)
                out = field.render(Viewpoints.of(pose, world.intrinsics, SIZE), lighting, SIZE)
                number = float(trust.of(pose[None], out)[0])
                wanted, depth = true_world.render(to_truth.poses(pose), None, np.eye(4))
                near = depth < _FAR
                if near.sum() < 500:
                    continue
                error = float(np.median(np.abs(np.minimum(out.depth[0], 2 * _FAR) - depth)[near]))
                psnr = float(-10.0 * np.log10(((out.rgb[0] - wanted) ** 2).mean()))
                rows.append((number, error, psnr, float(trust.offset(pose[None])[0])))
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
    heading = float(heading_at(route, s))
    left = np.array([-np.sin(heading), np.cos(heading), 0.0])
    eye = point_at(route, s) + lateral * left + np.array([0.0, 0.0, _EYE])
    yaw = heading + np.deg2rad(turn)
    return look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), -np.tan(np.deg2rad(5.0))]))
