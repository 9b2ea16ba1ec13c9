"""Benchmark of transients: effect of walkers, cars and objects that left on a twin, against films without them.

    twin reality film --place N --out CLEAN && twin build CLEAN
    twin reality film --place N --traffic --out TRAFFIC && twin build TRAFFIC
    python benchmarks/transients.py CLEAN TRAFFIC [WITHOUT] [--json FILE]

CLEAN and TRAFFIC are filmed with the same camera poses, exposure and noise. Every build is scored on its held-out
frames as the clean films show them: the static place alone. WITHOUT is an optional build of TRAFFIC's films with
`nerf.transients = false`. A *ghost* is visual geometry 0.1 to 2 m above the true ground of the corridor.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from record import record_parser, save

from twin.config_file import load_config
from twin.errors import InputError, print_error
from twin.files import read_json
from twin.geometry.cameras import Cameras
from twin.geometry.images import write_image
from twin.nerf.baked import BakedField
from twin.nerf.evaluate import evaluate
from twin.nerf.field import RadianceField
from twin.reality.truth import Truth, align_poses, intrudes, load_parts, matched_poses
from twin.scene import SceneDir

_GHOST_HEIGHT = 0.10  # [m] above the true ground
_CELL = 0.25  # [m] side of the corridor's grid
_HEAD_ROOM = 2.0  # [m] above the ground; higher geometry is a crown or a wire


def clean_frames(cameras: Cameras, films: Path, out: Path) -> Cameras:
    """The held-out cameras with images from the clean films at the same times, written to `out`."""
    held_out = cameras.select(cameras.held_out)
    for source in dict.fromkeys(held_out.sources):
        video = cv2.VideoCapture(str(films / f"{source}.mp4"))
        rate, wanted = video.get(cv2.CAP_PROP_FPS), {}
        for i in np.flatnonzero([name == source for name in held_out.sources]):
            wanted[round(float(held_out.times[i]) * rate)] = held_out.names[i]
        for k in range(max(wanted) + 1):
            found, image = video.read()
            if not found:
                raise InputError(f"{films / source}.mp4 ends before frame {k}; expected the clean film of this place")
            if k in wanted:
                (out / wanted[k]).parent.mkdir(parents=True, exist_ok=True)
                write_image(out / f"{wanted[k]}.png", image[..., ::-1])
    return replace(held_out, images=out)


def scores(scene: SceneDir, films: Path) -> dict[str, Any]:
    """Held-out scores of a build on the clean films, by lighting."""
    field, baked = RadianceField.load(scene.stage("field")), BakedField.load(scene.stage("field"))
    config = load_config(scene.config_file)
    with tempfile.TemporaryDirectory() as out:
        cameras = clean_frames(Cameras.load(scene.stage("metric")), films, Path(out))
        found = evaluate(field, cameras, config.nerf.max_width, baked=baked)
    return {name: found[name] for name in ("psnr", "ssim", "psnr_small", "psnr_small_lower", "n")}


def ghosts(scene: SceneDir) -> dict[str, float]:
    """Number of cells of the true corridor with ghosts, greatest height of these [m], number of convex parts in it."""
    truth = Truth.load(scene.truth)
    cameras = Cameras.load(scene.stage("metric"))
    to_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras))
    with np.load(scene.stage("mesh") / "visual.npz", allow_pickle=False) as data:
        vertices, faces = data["vertices"].astype(np.float64), data["faces"]
    points = to_truth.points(vertices[faces].mean(1))
    station, lateral = truth.route.project(points[:, :2])
    height = points[:, 2] - truth.ground_height(points[:, :2])
    inside = (station > truth.start) & (station < truth.start + truth.length) & (np.abs(lateral) < truth.half_width)
    ghost = inside & (height > _GHOST_HEIGHT) & (height < _HEAD_ROOM)
    cells = np.unique(np.floor(np.stack([station, lateral], 1)[ghost] / _CELL), axis=0)
    parts = sum(intrudes(to_truth.points(v), f, truth) for v, f in load_parts(scene.stage("mesh")))
    return {"cells": len(cells), "height": float(height[ghost].max(initial=0.0)), "parts": parts}


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("clean", type=Path, help="built scene of the films without traffic")
    parser.add_argument("traffic", type=Path, help="built scene of the films with traffic")
    parser.add_argument("without", type=Path, nargs="?", help="films with traffic, nerf.transients=false")
    given = parser.parse_args()
    found: dict[str, Any] = {}
    try:
        for name in ("clean", "traffic", "without"):
            if root := getattr(given, name):
                scene = SceneDir(root)
                found[name] = {**scores(scene, given.clean / "input"), "ghosts": ghosts(scene)}
                found[name]["transients"] = read_json(scene.root / "build" / "report.json")["field"].get("transients")
    except InputError as error:
        return print_error(error)
    for name, row in found.items():
        print(name, "ghosts:", row["ghosts"])
        for light, value in row["psnr"].items():
            change = value - found["clean"]["psnr"][light]
            small = f"{row['psnr_small'][light]:.2f}, lower half {row['psnr_small_lower'][light]:.2f} dB at 160×90"
            print(f"  {light:<12} {value:.2f} dB ({change:+.2f}), SSIM {row['ssim'][light]:.3f}; {small}")
    return save(given.json, found, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
