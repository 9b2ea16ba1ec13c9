"""Differences between the twin under the photo of a day and pictures of that day, compared with randomized weather.

    python benchmarks/day.py SCENE [--days NAME ...] [--policies RUN ...] [--json FILE] [--pictures FOLDER]

The scene was built from films of place 0 (`twin reality`) and has a lighting fitted to one photo of each
day (`benchmarks/table1`, step `photos`). From eight other stations of the road, images of every day are compared with
renderings from the same poses under the photo's appearance and fog. The figures are PSNR, and for steering a ratio: the
policies' change of steering from rendering to image, divided by the change that randomized sun and shadows cause.
*Lasting* change: rms over days of the mean over stations. *Local* change: rms of the deviations from this mean.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import record_parser, save

from twin.env.domain_randomization import EVALUATION_RANGES, KNOWN_WEATHER_FRACTION, RandomizationSample
from twin.env.mujoco_renderer import camera_intrinsics
from twin.env.picture_effects import Weather
from twin.geometry.cameras import Cameras, Viewpoints, pixel_grid, unproject
from twin.geometry.images import psnr, resize, write_image
from twin.learn.policy import find_policy, load_policy
from twin.loading import load_scene
from twin.reality import recordings
from twin.reality.campus_road import RoadLine
from twin.reality.lighting import WEATHER
from twin.reality.real_test import Setup
from twin.reality.truth import Truth, align_poses, matched_poses
from twin.runtime import track

STATIONS = (4.0, 10.0, 17.0, 24.0, 31.0, 37.0, 42.0, 48.0, 54.0)  # [m]; the lightings come from photos at the first one
STRAIGHT = 4  # number of stations on the straight segment, the photo's included
SIZE = (160, 90)
DRAWS = 8  # weather samples per day
RESAMPLED = 500  # bootstrap samples for 90 % intervals
SCALES = (1.0, 0.8, 0.7, KNOWN_WEATHER_FRACTION, 0.5)  # fractions of the sun and shadow randomization

Pictures = NDArray[np.float32]  # (days, stations, height, width, 3)


def true_images(days: list[str]) -> tuple[Pictures, NDArray[np.float64]]:
    """Images of every day at every station, and the camera_to_world poses (stations, 4, 4) in the true world."""
    line, rows, poses = RoadLine(), [], np.zeros((len(STATIONS), 4, 4))
    for light in track([WEATHER[name] for name in days], "images of days", unit="day"):
        robot, camera = recordings.robot_and_camera(Setup(), light)
        row = []
        for k, station in enumerate(STATIONS):
            recordings.set_on_line(robot, line, station)
            poses[k] = camera.pose(robot, robot.time)
            row.append(np.asarray(resize(camera.capture(robot), *SIZE), np.float32) / 255.0)
        rows.append(row)
    return np.array(rows), poses


def lasting_and_local(change: NDArray) -> NDArray:
    """Lasting and local change: rms of the days' means of changes (days, stations), and of the deviations from them."""
    mean = change.mean(1, keepdims=True)
    return np.sqrt([(mean**2).mean(), ((change - mean) ** 2).mean()])


def steering(policy: Callable, pictures: Pictures) -> NDArray:
    """Steering (days, stations), the last component of a policy's action, for stacks of four equal images."""
    stacks = (np.clip(np.moveaxis(pictures, -1, 2), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return np.array([[policy(np.tile(one, (4, 1, 1)))[-1] for one in row] for row in stacks])


def ratios(gaps: list[NDArray], randomised: list[NDArray], rng: np.random.Generator | None = None) -> NDArray:
    """Ratios of lasting and local changes to those under randomized weather, geometric means over policies.

    Args:
        gaps: Steering changes between twin and truth, (days, stations) per policy.
        randomised: Steering changes under randomized weather, (samples, stations) per policy.
            Sample k belongs to day k modulo the number of days.
        rng: Resamples policies and days for a bootstrap, if given.
    """
    policies = np.arange(len(gaps))
    days, draws = np.arange(len(gaps[0])), np.arange(0, len(randomised[0]), len(gaps[0]))
    if rng:
        policies, days = (rng.choice(one, len(one)) for one in (policies, days))
    others = (draws[:, None] + days).ravel()  # samples of one day share its rendering
    log_ratios = [np.log(lasting_and_local(gaps[k][days]) / lasting_and_local(randomised[k][others])) for k in policies]
    return np.exp(np.mean(log_ratios, 0))


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument(
        "--days", nargs="+", choices=WEATHER, default=list(WEATHER), metavar="NAME", help="default: all"
    )
    parser.add_argument("--policies", nargs="*", default=[], help="runs of the scene; names begin with the task")
    parser.add_argument(
        "--pictures", type=Path, help="folder for images: the day, the twin, the twin with randomized weather"
    )
    given = parser.parse_args()
    twin = load_scene(given.scene)
    filmed_place = Truth.load(twin.scene.truth)
    if filmed_place.number:
        parser.error(f"{given.scene} is a film of place {filmed_place.number}; expected one of place 0, as scenes/demo")
    field, cameras = twin.field(), Cameras.load(twin.scene.stage("metric"))
    model = twin.world().model()
    intrinsics = camera_intrinsics(model, model.camera("front").id, SIZE)
    rays = unproject(pixel_grid(*SIZE), intrinsics)
    lengths = np.linalg.norm(rays, axis=-1).astype(np.float32)
    truth, true_poses = true_images(given.days)
    to_truth = align_poses(cameras.camera_to_world, matched_poses(filmed_place, cameras))
    poses = to_truth.inverse().poses(true_poses)
    views = Viewpoints.of(poses, intrinsics, SIZE)
    clear = [field.render(views, name) for name in given.days]
    depth = clear[0].depth
    fogged = np.array(
        [field.fog(name).apply(one.rgb, depth * lengths) for name, one in zip(given.days, clear, strict=True)]
    )
    filmed = [field.render(views, name).rgb for name in field.lightings_by_name.filmed().names]
    figures: dict[str, float] = {}

    def report(name: str, value: float) -> None:
        figures[name] = float(value)
        print(f"{name:44} {value:8.3f}", flush=True)

    for i, name in enumerate(given.days):
        report(f"day.extinction.{name}", field.fog(name).extinction)
        for what, many in (("filmed", filmed), ("photo", [fogged[i]])):
            means = [np.mean([psnr(a, b) for a, b in zip(p[1:], truth[i, 1:], strict=True)]) for p in many]
            report(f"day.psnr.{what}.{name}", max(means))

    rng = np.random.default_rng(0)
    samples = [[EVALUATION_RANGES.sample(rng) for _ in given.days] for _ in range(DRAWS)]
    seeds = rng.integers(2**31, size=(DRAWS, len(given.days)))

    def weathered(scale: float, days: list[RandomizationSample], numbers: NDArray) -> Pictures:
        rows = []
        for i, (name, draw, number) in enumerate(zip(given.days, days, numbers, strict=True)):
            weaker = RandomizationSample(sunlight=scale * draw.sunlight, shade=scale * draw.shade)
            weather = Weather(weaker, np.random.default_rng(number), field.fog(name))
            seen = zip(clear[i].rgb, depth, poses, strict=True)
            rows.append([weather.apply(rgb, far, rays, pose) for rgb, far, pose in seen])
        return np.array(rows)

    pictures = {scale: [weathered(scale, *one) for one in zip(samples, seeds, strict=True)] for scale in SCALES}
    if given.pictures:
        for i, name in enumerate(given.days):
            both = np.hstack([np.vstack(p[i]) for p in (truth, fogged, pictures[KNOWN_WEATHER_FRACTION][0])])
            write_image(given.pictures / f"{name}.png", (np.clip(both, 0.0, 1.0) * 255.0).astype(np.uint8))
    gaps: list[NDArray] = []
    responses: dict[float, list[NDArray]] = {scale: [] for scale in SCALES}
    for source in track(given.policies, "policies", unit="policy"):
        policy = load_policy(str(find_policy(given.scene, source)), False)
        places = slice(1, STRAIGHT if Path(source).name.startswith("straight") else None)  # 0 is the photo's station
        before = steering(policy, fogged[:, places])
        gaps.append(steering(policy, truth[:, places]) - before)
        for scale, many in pictures.items():
            responses[scale].append(np.concatenate([steering(policy, one[:, places]) - before for one in many]))
    for scale, randomised in responses.items() if gaps else ():
        low, high = np.quantile([ratios(gaps, randomised, rng) for _ in range(RESAMPLED)], (0.05, 0.95), axis=0)
        for k, kind in enumerate(("lasting", "local")):
            name = f"day.change_over_drawn.{kind}.{scale:g}"
            report(name, ratios(gaps, randomised)[k])
            report(f"{name}.low", low[k])
            report(f"{name}.high", high[k])
    return save(given.json, figures, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
