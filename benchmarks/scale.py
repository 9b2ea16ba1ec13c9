"""Coverage of the stated uncertainty of the metric scale over simulated captures.

    python benchmarks/scale.py [--gps] [--first 1] [--count 200]

A capture is a simulated drive with known truth: the camera's height is measured with an error; the road has slope,
crossfall, a crown and a curb; structure from motion bends the path and scatters points. The number of a capture seeds
it: 1 to 999 are for development; those from 1,000 on are for reports, each used once. Prints how often the truth lies
within one and two standard deviations, and the median error. With --gps, the scale comes from GPS fixes in one to three
films, whose error drifts (an Ornstein-Uhlenbeck process; a fix every 0.4 to 1.5 s). The errors of structure from motion
are simulated, so this does not replace tests with reconstructed captures.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from twin.capture.gravity import up_from_ground
from twin.capture.scale import Scale, scale_from_gps, scale_from_height
from twin.config import MetricConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.poses import look_at
from twin.types import Array

_EARTH = 6_378_137.0  # [m] radius at the equator
_TOLERANCE = 0.01  # [m] standard deviation of the error of the measured height


def draw_capture(number: int) -> tuple[Cameras, Array, float]:
    """Cameras and sparse points (m, 3) whose true scale is 1, and the measured height of the camera [m]."""
    rng = np.random.default_rng([2027, number])
    length, spacing, height = rng.uniform(20.0, 80.0), rng.uniform(0.4, 1.5), rng.uniform(0.4, 1.7)
    s = np.arange(0.0, length, spacing)
    radius = float(np.exp(rng.uniform(np.log(8.0), np.log(200.0)))) * rng.choice([-1.0, 1.0])
    angle = np.clip(s - length / 3, 0.0, rng.uniform(0.1, 1.5) * abs(radius)) / radius
    xy = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], -1) * spacing, 0)
    slope, camber, crown = rng.uniform(-0.08, 0.08), rng.normal(0.0, 0.012), rng.uniform(0.0, 0.02)
    curb_at, curb = rng.uniform(1.2, 4.0), rng.choice([0.0, 0.06, 0.12])
    waves = rng.uniform(0.0, 0.012), rng.uniform(3.0, 12.0), rng.uniform(0.0, 6.3)

    def ground(along: Array, lateral: Array) -> Array:
        out = slope * along + camber * lateral - crown * np.abs(lateral) + curb * (lateral > curb_at)
        return out + waves[0] * np.sin(2 * np.pi * along / waves[1] + waves[2])

    lift = height + 0.008 * np.sin(2 * np.pi * s / rng.uniform(2.0, 9.0)) + 0.003 * rng.standard_normal(len(s))
    eyes = np.concatenate([xy, (ground(s, 0 * s) + lift)[:, None]], 1)
    pitch, roll = rng.uniform(0.0, 0.3), rng.normal(0.0, np.radians(0.6))
    ahead = np.stack([np.cos(angle), np.sin(angle), np.full(len(s), slope - np.tan(pitch))], 1)
    poses = np.array([look_at(eye, eye + one) for eye, one in zip(eyes, ahead, strict=True)])
    c, d = np.cos(roll), np.sin(roll)
    poses[:, :3, :3] = poses[:, :3, :3] @ np.array([[c, -d, 0.0], [d, c, 0.0], [0.0, 0.0, 1.0]])
    count = int(rng.integers(60, 1500))
    k = rng.integers(0, len(s), count)
    lateral = rng.normal(0.0, rng.uniform(0.6, 2.0), count)
    normal = np.stack([-np.sin(angle[k]), np.cos(angle[k])], -1)
    road = np.concatenate([xy[k] + lateral[:, None] * normal, ground(s[k], lateral)[:, None]], 1)
    road[:, 2] += rng.uniform(0.005, 0.03) * rng.standard_normal(count)
    other = eyes[rng.integers(0, len(s), 1200)] + rng.uniform(-15, 15, (1200, 3))
    other[:, 2] = np.maximum(other[:, 2], ground(0.0, 0.0) + slope * other[:, 0]) + 0.4
    points = np.concatenate([road, other])
    # Structure from motion bends a drive: errors of position grow with the squared distance from the start.
    bend = rng.normal(0.0, 0.1 / 40.0**2, 3) * [1.0, 1.0, 0.5]
    for one in (points, poses[:, :3, 3]):
        one += bend * ((one[:, :2] - xy[0]) ** 2).sum(1)[:, None]
    n = len(s)
    cameras = Cameras(
        tuple(f"film/{i:06d}" for i in range(n)),
        poses,
        np.tile([300.0, 300.0, 320.0, 180.0], (n, 1)),
        np.tile([640, 360], (n, 1)),
        ("day",) * n,
        ("film",) * n,
        np.arange(float(n)),
        np.zeros(n, bool),
        Path("images"),
    )
    return cameras, points, height + _TOLERANCE * float(rng.standard_normal())


def estimate_by_gps(number: int) -> Scale:
    """The scale of a simulated capture by GPS whose error drifts; the true scale is 1."""
    film, _, _ = draw_capture(number)
    rng = np.random.default_rng([2027, number, 1])
    films, n = int(rng.integers(1, 4)), len(film)
    size, jitter = rng.uniform(0.5, 3.0), rng.uniform(0.0, 0.3)
    # Time in which the error changes [s], at 1 m/s; at most one fix per frame.
    time = float(np.exp(rng.uniform(np.log(3.0), np.log(300.0))))
    kept = np.exp(-float(np.median(np.linalg.norm(np.diff(film.positions, axis=0), axis=1))) / time)
    fixes = []
    for _ in range(films):
        steps = rng.standard_normal((n, 2))
        error = steps[:1] * size
        for step in steps[1:]:
            error = np.concatenate([error, error[-1:] * kept + step * size * np.sqrt(1.0 - kept**2)])
        fixes.append(film.positions[:, :2] + error + jitter * rng.standard_normal((n, 2)))
    cameras = film.select(np.tile(np.arange(n), films))
    cameras = replace(cameras, sources=tuple(f"film_{k}" for k in range(films) for _ in range(n)))
    degrees = np.degrees(np.concatenate(fixes) / _EARTH)  # at the equator east and north are alike
    gps = np.column_stack([degrees[:, 1], degrees[:, 0], np.zeros(len(degrees))])
    return scale_from_gps(cameras, np.array([0.0, 0.0, 1.0]), gps, rng)[0]


def estimate(number: int) -> Scale:
    """The estimated scale of a simulated capture; the true scale is 1."""
    cameras, points, measured = draw_capture(number)
    up, road = up_from_ground(cameras.camera_to_world, points)
    return scale_from_height(cameras, up, points, road, MetricConfig(measured, _TOLERANCE), {})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gps", action="store_true", help="scale by GPS fixes instead of the camera's height")
    parser.add_argument("--first", type=int, default=1, help="number of the first capture (default %(default)s)")
    parser.add_argument("--count", type=int, default=200, help="number of captures (default %(default)s)")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.count)
    scales = []
    for number in numbers:
        try:
            scales.append((estimate_by_gps if options.gps else estimate)(number))
        except InputError:  # GPS does not spread beyond its error
            continue
    error = np.array([np.log(one.value) for one in scales])
    sigma = np.array([one.uncertainty for one in scales])
    keys = () if options.gps else ("height_as_measured", "repeatability", "tilt", "left_against_right")
    parts = {key: np.median([one.notes["scale_uncertainty_of"][key] for one in scales]) for key in keys}
    print(f"captures with a scale          {len(scales)} of {len(numbers)}")
    print(f"within one standard deviation  {np.mean(np.abs(error) < sigma):6.1%}")
    print(f"within two                     {np.mean(np.abs(error) < 2 * sigma):6.1%}")
    print(f"median error                   {np.median(np.abs(error)):7.2%}, mean {error.mean():+.2%}")
    print(f"median uncertainty             {np.median(sigma):7.2%}")
    if parts:
        print("  of which " + ", ".join(f"{key} {value:.2%}" for key, value in parts.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
