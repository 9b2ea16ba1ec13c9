"""Gain of a sun in lightings of photos: one photo per day, compared with pictures of that day from there and elsewhere.

    python benchmarks/sun.py SCENE [--place N] [--camera N] [--days N ...] [--json FILE] [--pictures FOLDER]

The scene was built from the film of a generated place (`twin reality film`). For each day, by number, a photo from the
start of the road is relit as `twin relight` does, in three ways: without a sun, with the sun searched in the photo, and
with the day's true sun. Printed are the nearest filmed lighting's PSNR of the photo, the PSNR of each half of the photo
under the fit to the other half, and the mean PSNR of pictures of the day from other stations of the road [dB]. *Sunny*
days are those on which the sun casts shadows. The added lightings, `benchmark_...`, are removed afterwards.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import add_record_options, save

from twin.geometry.cameras import Cameras, Viewpoints, pixel_grid, unproject
from twin.geometry.images import psnr, resize, write_image
from twin.geometry.shadow_map import angles
from twin.loading import load_scene
from twin.nerf.baked import BakedField
from twin.nerf.sun import relit
from twin.reality import recordings
from twin.reality.comparison import align_rigid, matched_poses
from twin.reality.lighting import Lighting, weather
from twin.reality.real_camera import draw_camera, intrinsics_of
from twin.reality.real_test import Setup
from twin.reality.trial_place import place_on_test_day
from twin.reality.truth import Truth
from twin.relight import relight

SIZE = (240, 135)  # [px]
STATIONS = 7  # the photo is taken at the first one
FIRST, MARGIN = 4.0, 6.0  # [m] the first station; distance of the last one from the end of the road
VARIANTS = ("embedding", "searched", "true")


def day_pictures(setup: Setup, light: Lighting) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray]:
    """Photo at full size, pictures at all stations (stations, h, w, 3), and true camera_to_world poses."""
    line = place_on_test_day(setup.place).route
    robot, camera = recordings.robot_and_camera(setup, light)
    rows, poses, photo = [], [], None
    for station in np.linspace(FIRST, line.length - MARGIN, STATIONS):
        recordings.set_on_line(robot, line, float(station))
        poses.append(camera.pose(robot, robot.time))
        full = camera.capture(robot)
        photo = full if photo is None else photo
        rows.append(np.asarray(resize(full, *SIZE), np.float32) / 255.0)
    assert photo is not None
    return photo, np.array(rows), np.array(poses)


def shown(field: BakedField, views: Viewpoints, rays: NDArray, poses: NDArray, lighting: str) -> NDArray[np.float32]:
    """Pictures of the field in a lighting with its sun and fog, from poses, shape (n, h, w, 3)."""
    out = field.render(views, lighting)
    lengths = np.linalg.norm(rays, axis=-1).astype(np.float32)
    fog, suns = field.fog(lighting), field.sunlight(lighting)
    many = []
    for rgb, depth, pose in zip(out.rgb, out.depth, poses, strict=True):
        lit = relit(rgb, depth, rays, pose, suns)
        many.append(np.clip(fog.apply(lit, depth * lengths) if fog else lit, 0.0, 1.0))
    return np.array(many)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--place", type=int, default=0, help="number of the generated place")
    parser.add_argument("--camera", type=int, default=0, help="number of the robot's camera")
    parser.add_argument("--days", type=int, nargs="+", default=list(range(20, 30)), metavar="N")
    parser.add_argument("--pictures", type=Path, help="folder for images: the day, and the twin in each variant")
    add_record_options(parser)
    given = parser.parse_args()
    twin, setup = load_scene(given.scene), Setup(given.place, 0, given.camera)
    cameras = Cameras.load(twin.scene.stage("metric"))
    from_truth = align_rigid(cameras.camera_to_world, matched_poses(Truth.load(twin.scene.truth), cameras)).inverse()
    intrinsics = intrinsics_of(draw_camera(setup.camera), SIZE)
    rays = unproject(pixel_grid(*SIZE), intrinsics)
    days = {}
    for number in given.days:
        light = weather(f"day_{number}")
        photo, truth, poses = day_pictures(setup, light)
        poses = from_truth.poses(poses)
        ray, _, is_sunny = light.suns[0]
        toward = -from_truth.rotation @ np.array(ray) / np.linalg.norm(ray)
        azimuth, elevation = angles(toward)
        row: dict[str, object] = {"sunny": bool(is_sunny), "azimuth_deg": azimuth, "elevation_deg": elevation}
        views, pictures = Viewpoints.of(poses, intrinsics, SIZE), [truth]
        for variant in VARIANTS if is_sunny else VARIANTS[:2]:
            name = f"benchmark_{variant}_{number}"
            sun = {"embedding": "none", "searched": None, "true": f"{azimuth:.2f},{elevation:.2f}"}[variant]
            try:
                with tempfile.TemporaryDirectory() as folder:
                    write_image(Path(folder) / "photo.png", photo)
                    added = relight(given.scene, Path(folder) / "photo.png", name, sun)
                field = twin.field()
                mine = shown(field, views, rays, poses, name)
            finally:
                for suffix in ("json", "png"):
                    (twin.scene.lightings / f"{name}.{suffix}").unlink(missing_ok=True)
            pictures.append(mine)
            if variant == "embedding":
                nearest = str(added.figures["nearest"])
                filmed = shown(field, views, rays, poses, nearest)
                row["half.filmed"] = added.figures["psnr_nearest"]
                row["elsewhere.filmed"] = float(
                    np.mean([psnr(a, b) for a, b in zip(filmed[1:], truth[1:], strict=True)])
                )
            row[f"half.{variant}"] = added.figures["psnr_other_half"]
            elsewhere = [psnr(a, b) for a, b in zip(mine[1:], truth[1:], strict=True)]
            row[f"elsewhere.{variant}"] = float(np.mean(elsewhere))
            if variant == "searched":
                row["found"] = added.sun is not None
                if added.sun is not None and is_sunny:
                    cosine = float(np.clip(added.sun.toward @ toward, -1.0, 1.0))
                    row["direction_error_deg"] = float(np.rad2deg(np.arccos(cosine)))
        days[f"day_{number}"] = row
        text = " ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
        print(f"day_{number}: {text}", flush=True)
        if given.pictures:
            given.pictures.mkdir(parents=True, exist_ok=True)
            image = np.hstack([np.vstack(one) for one in pictures])
            write_image(given.pictures / f"day_{number}.png", (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
    figures: dict[str, object] = {"place": given.place, "days": days}
    for label, is_sunny in (("sunny", True), ("overcast", False)):
        rows = [row for row in days.values() if row["sunny"] == is_sunny]
        if rows:
            print(f"{label}: {len(rows)} days, {sum(bool(row['found']) for row in rows)} with a sun found in the photo")
        for where in ("half", "elsewhere"):
            for variant in (v for v in ("filmed", *VARIANTS) if rows and f"{where}.{v}" in rows[0]):
                values = np.array([row[f"{where}.{variant}"] for row in rows], float)
                above = values - np.array([row[f"{where}.filmed"] for row in rows], float)
                figures[f"{label}.{where}.{variant}"] = float(values.mean())
                print(f"{label:9} {where:10} {variant:10} {values.mean():6.2f} dB, {above.mean():+.2f} above filmed")
    return save(given.json, figures, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
