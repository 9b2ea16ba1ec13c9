"""Benchmark of the simulated real test: speed of its rasterizer, difference from the film's renderer, error of a route.

    python benchmarks/reality.py [--scene BUILT_SCENE_WITH_TRUTH] [--json FILE] [--pictures FOLDER]
    python benchmarks/reality.py --sheet docs/places.jpg

Rasterized pictures of 160×90, without the sensor model, are compared with frames that the film's renderer draws in the
film's size and that are then reduced to 160×90. The poses lie on the film's path, at the height of a robot's camera.
*small*: the same comparison, with the film's renderer at 160×90 in place of the rasterizer. With a scene, its route is
compared with the true one. `--sheet` instead writes one picture with a frame of each of the places 1 to 30.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from record import record_parser, save

from twin.geometry.cameras import Cameras, pixel_grid, unproject
from twin.geometry.images import psnr, write_image
from twin.geometry.polyline import nearest_on_route
from twin.loading import load_scene
from twin.reality import campus_road, filming, true_world
from twin.reality.place_sampling import sample_place
from twin.reality.rasterizer import Rasterizer
from twin.reality.road_task import true_route
from twin.reality.sampled_place import build
from twin.reality.sky import apply_haze
from twin.reality.truth import Truth, align_poses, matched_poses
from twin.runtime import track

_LIGHTINGS = ("sun", "overcast", "night")
_EVERY = 12  # one in this many frames of the film is compared
_LOWER = 0.6  # [m] by which the robot's camera is lower than the film's camera


def pictures(folder: Path | None) -> Iterator[tuple[str, float]]:
    """Names and values of the figures of each lighting."""
    place, large = campus_road.build(), filming.FilmingPlan()
    small = replace(large, width=160, height=90)
    for lighting in _LIGHTINGS:
        raster = Rasterizer(true_world.world_spec(lighting, place).compile(), small.intrinsics, (160, 90))
        renderer, renderer_small = filming.Renderer(lighting, place, large), filming.Renderer(lighting, place, small)
        poses = filming.trajectory(large, place.route, lighting)[1][::_EVERY]
        raster(poses[0])
        rows, seconds = [], []
        for pose in poses:
            pose = pose.copy()
            pose[2, 3] -= _LOWER
            begin = time.process_time()
            mine = raster(pose)[0]
            seconds.append(time.process_time() - begin)
            wanted = cv2.resize(renderer(pose)[0], (160, 90), interpolation=cv2.INTER_AREA)
            rows.append((psnr(mine, wanted), psnr(renderer_small(pose)[0], wanted)))
            if folder:
                both = np.hstack([mine, wanted, np.abs(mine - wanted)])
                write_image(folder / f"{lighting}_{len(rows):02d}.png", (np.clip(both, 0, 1) * 255).astype(np.uint8))
        yield f"reality.pictures_per_cpu_second.{lighting}", float(1.0 / np.median(seconds))
        yield f"reality.psnr.{lighting}", float(np.mean(rows, 0)[0])
        yield f"reality.psnr_lowest.{lighting}", float(np.min(rows, 0)[0])
        yield f"reality.psnr_small.{lighting}", float(np.mean(rows, 0)[1])


def places_of_tasks(scene: Path) -> Iterator[tuple[str, float]]:
    """Names and values: distances of a built route from the true route, and the true station where it begins [m]."""
    twin = load_scene(scene)
    truth = Truth.load(twin.scene.truth)
    cameras = Cameras.load(twin.scene.stage("metric"))
    to_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras))
    plan = filming.FilmingPlan.of(sample_place(truth.number, truth.road_length)) if truth.number else None
    station, lateral = nearest_on_route(true_route(plan, truth.route), to_truth.points(twin.world().route)[:, :2])
    yield "reality.route_off_max_m", float(np.abs(lateral).max())
    yield "reality.route_off_mean_m", float(np.abs(lateral).mean())
    yield "reality.route_begins_later_m", float(station[0])


def contact_sheet(path: Path) -> None:
    """Writes a frame of each of the places 1 to 30, 6 to a row; the lighting changes from place to place."""
    width, height = 240, 135
    frames = []
    for number in track(list(range(1, 31)), "contact sheet", unit="place"):
        spec = sample_place(number)
        place, plan = build(spec), replace(filming.FilmingPlan.of(spec), width=width, height=height)
        lighting = plan.lightings[number % len(plan.lightings)]
        poses = filming.trajectory(plan, place.route, lighting)[1]
        pose, look = poses[int(len(poses) * (0.15 + 0.12 * (number % 5)))], place.lightings[lighting]
        light, depth = filming.Renderer(lighting, place, plan)(pose)
        rays, ground = unproject(pixel_grid(width, height), plan.intrinsics), place.route.ground_height(pose[:2, 3])
        hazy = apply_haze(light, depth, rays, pose, look, float(ground))
        image = filming.sensor_image(np.random.default_rng(0), hazy, look, 1.0)
        label = (str(number), (5, 15), cv2.FONT_HERSHEY_DUPLEX, 0.45)
        frames.append(cv2.putText(np.ascontiguousarray(image), *label, (255, 255, 255), 1, cv2.LINE_AA))
    rows = [np.hstack(frames[k : k + 6]) for k in range(0, len(frames), 6)]
    cv2.imwrite(str(path), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 78])


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, help="a built scene with truth")
    parser.add_argument("--pictures", type=Path, help="folder for pictures: rasterized, film, difference")
    parser.add_argument("--sheet", type=Path, help="only write a picture of the places 1 to 30 to this file")
    options = parser.parse_args()
    if options.sheet:
        contact_sheet(options.sheet)
        return 0
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    for part in (places_of_tasks(options.scene) if options.scene else (), pictures(options.pictures)):
        for name, value in part:
            figures[name] = value
            print(f"{name:44} {value:8.3f}", flush=True)
    return save(options.json, figures, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
