"""Benchmark of suns fitted to photos: one photo per day, compared with pictures of the day from there and elsewhere.

    python benchmarks/sun.py SCENE [--camera N] [--days N ...] [--json FILE] [--pictures FOLDER]

The scene was built from films of a generated place (`twin reality film`). For each day, by number, a lighting is
fitted to a photo from the start of the road as `twin relight` does, but at the true pose of the photo: without a sun
(`embedding`), with the sun searched in the photo, and with the true sun. Prints, in dB: the PSNR of the photo under the
nearest filmed lighting, the PSNR of each half of the photo under the fit to the other half, and the mean PSNR of
pictures of the day from other stations of the road. *Sunny* days are those on which the sun casts shadows.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import record_parser, save

from twin.geometry.cameras import Cameras, Viewpoints, pixel_grid, unproject
from twin.geometry.images import psnr, resize, write_image
from twin.geometry.shadow_map import ShadowCasters, angles
from twin.loading import load_scene
from twin.nerf.baked import BakedField
from twin.nerf.lightings import Fog
from twin.nerf.sun import Sunlight, relit
from twin.reality import recordings
from twin.reality.lighting import Lighting, weather
from twin.reality.real_camera import draw_camera, intrinsics_of
from twin.reality.real_test import Setup
from twin.reality.road_task import place_on_test_day
from twin.reality.truth import Truth, align_poses, matched_poses
from twin.relight import PhotoFit, SunSource, fit_photo, shadow_casters, with_sun

SIZE = (240, 135)  # [px]
STATIONS = 6  # the photo is taken at the first one
FIRST, MARGIN = 4.0, 6.0  # [m] the first station; distance of the last one from the end of the road
VARIANTS = ("embedding", "searched", "true")


def day_pictures(setup: Setup, light: Lighting) -> tuple[NDArray[np.float32], NDArray]:
    """Pictures at all stations (stations, h, w, 3), the first of which is the photo, and true camera_to_world poses."""
    line = place_on_test_day(setup.place, setup.length).route
    robot, camera = recordings.robot_and_camera(setup, light)
    rows, poses = [], []
    for station in np.linspace(FIRST, line.length - MARGIN, STATIONS):
        recordings.set_on_line(robot, line, float(station))
        poses.append(camera.pose(robot, robot.time))
        rows.append(np.asarray(resize(camera.capture(robot), *SIZE), np.float32) / 255.0)
    return np.array(rows), np.array(poses)


class Views:
    """Pictures of a field from the stations."""

    def __init__(self, field: BakedField, poses: NDArray, intrinsics: NDArray) -> None:
        self._field, self._poses = field, poses
        self._cameras = Viewpoints.of(poses, intrinsics, SIZE)
        self._rays = unproject(pixel_grid(*SIZE), intrinsics)

    def shown(self, lighting: str | NDArray, fog: Fog | None = None, suns: Sunlight = ()) -> NDArray[np.float32]:
        """Pictures in a lighting, shape (stations, h, w, 3)."""
        out = self._field.render(self._cameras, lighting)
        lengths = np.linalg.norm(self._rays, axis=-1).astype(np.float32)
        many = []
        for rgb, depth, pose in zip(out.rgb, out.depth, self._poses, strict=True):
            lit = relit(rgb, depth, self._rays, pose, suns)
            many.append(np.clip(fog.apply(lit, depth * lengths) if fog else lit, 0.0, 1.0))
        return np.array(many)


def fitted(relit_photo: PhotoFit, views: Views) -> NDArray[np.float32]:
    """Pictures in the light of a fit, shape (stations, h, w, 3)."""
    suns = ((relit_photo.sun, 1.0),) if relit_photo.sun else ()
    return views.shown(relit_photo.embedding, relit_photo.fog, suns)


def day_row(
    truth: NDArray[np.float32],
    toward: NDArray | None,
    field,
    views: Views,
    pose: NDArray,
    casters: ShadowCasters,
    k: NDArray,
) -> tuple[dict[str, object], list[NDArray[np.float32]]]:
    """The figures of one day, and its pictures: true, under the embedding, with the searched and with the true sun.

    `toward` is the direction to the day's sun in the scene, None if it casts no shadows.
    """
    plain = fit_photo(field, truth[0], pose, k)
    fits = {"embedding": plain, "searched": with_sun(field, plain, casters, SunSource(None, "searched"))}
    if toward is not None:
        fits["true"] = with_sun(field, plain, casters, SunSource(toward, "true"))
    pictures = {"filmed": views.shown(plain.nearest)} | {name: fitted(one, views) for name, one in fits.items()}
    row: dict[str, object] = {"half.filmed": plain.psnr_nearest}
    row |= {f"half.{name}": one.psnr_other_half for name, one in fits.items()}
    for name, many in pictures.items():
        row[f"elsewhere.{name}"] = float(np.mean([psnr(a, b) for a, b in zip(many[1:], truth[1:], strict=True)]))
    sun = fits["searched"].sun
    row |= {"found": sun is not None, "disagreement_deg": fits["searched"].sun_disagreement}
    if sun is not None and toward is not None:
        row["direction_error_deg"] = float(np.rad2deg(np.arccos(np.clip(sun.toward @ toward, -1.0, 1.0))))
    return row, [truth, *(pictures[name] for name in fits)]


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--camera", type=int, default=0, help="number of the robot's camera")
    parser.add_argument("--days", type=int, nargs="+", default=list(range(20, 30)), metavar="N")
    parser.add_argument("--pictures", type=Path, help="folder for images: the day, and the twin in each variant")
    given = parser.parse_args()
    twin = load_scene(given.scene)
    truth, cameras = Truth.load(twin.scene.truth), Cameras.load(twin.scene.stage("metric"))
    setup = Setup(truth.number, 0, given.camera, truth.road_length)
    from_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras)).inverse()
    field, baked, days = twin.radiance_field("cpu"), twin.field(), {}
    intrinsics, casters = intrinsics_of(draw_camera(setup.camera), SIZE), shadow_casters(twin.scene, baked)
    assert casters is not None
    for number in given.days:
        light = weather(f"day_{number}")
        real, poses = day_pictures(setup, light)
        poses = from_truth.poses(poses)
        ray, _, is_sunny = light.suns[0]
        toward = -from_truth.rotation @ np.array(ray) / np.linalg.norm(ray)
        views = Views(baked, poses, intrinsics)
        row, pictures = day_row(real, toward if is_sunny else None, field, views, poses[0], casters, intrinsics)
        azimuth, elevation = angles(toward)
        days[f"day_{number}"] = row | {"sunny": is_sunny, "azimuth_deg": azimuth, "elevation_deg": elevation}
        text = " ".join(
            f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in days[f"day_{number}"].items()
        )
        print(f"day_{number}: {text}", flush=True)
        if given.pictures:
            given.pictures.mkdir(parents=True, exist_ok=True)
            image = np.hstack([np.vstack(one) for one in pictures])
            write_image(given.pictures / f"day_{number}.png", (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
    figures: dict[str, object] = {"place": setup.place, "days": days}
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
