"""The lightings of the real test. None of them is ever filmed; a build of the twin gets a photo of them at most.

The five stated ones were driven while training was developed, and a constant of the twin was measured on pictures of
these and of days 1 to 5 (`twin.env.randomisation.UNTOLD`): only days 6 to 15 were no part of any choice.

The sun stands elsewhere than in any film, its light has other colours, the air is hazy or the ground wet. Five are
stated here, fifteen more are *days*, drawn once with a fixed seed as a calendar would: sun, clouds and air are whatever
they are. What a trial adds of its own is only the camera's drift of exposure.
"""

import numpy as np

from twin.reality.lighting import Colour, Lighting
from twin.reality.things import SEED

_DAYS = 15
_WHITE, _RED = np.array([1.0, 0.94, 0.83]), np.array([1.0, 0.60, 0.34])  # of a high sun, and of one at the horizon
_REDDENED = 14.0  # [°] over which a rising sun loses all but 1/e of its red
_GREY = 0.3  # of this the mean of pictures is to be, as automatic exposure would have it


def _day(number: int) -> Lighting:
    """A day: its sun, its clouds and its air are drawn from the ranges below, its colours follow from these."""
    rng = np.random.default_rng([SEED, 51, number])
    elevation, azimuth = rng.uniform(6.0, 60.0), rng.uniform(0.0, 2.0 * np.pi)
    clouds, veil = rng.uniform(0.1, 1.0), rng.uniform(0.0, 1.0)
    hazy, wet = rng.uniform() < 0.4, rng.uniform() < 0.4
    visibility, wetness = float(np.exp(rng.uniform(np.log(60.0), np.log(400.0)))), float(rng.uniform(0.15, 0.4))
    tint, brightness = rng.uniform(-0.03, 0.03), float(np.exp(rng.uniform(-0.15, 0.15)))

    up, low = np.sin(np.deg2rad(elevation)), float(np.exp(-elevation / _REDDENED))
    overcast = clouds > 0.8
    through = 0.0 if overcast else (1.0 - clouds) ** 0.3 * (1.0 - 0.4 * veil)  # of the sun's own light
    sun = through * (0.55 + 0.45 * up) * 1.2 * (low * _RED + (1.0 - low) * _WHITE)
    grey = 0.30 + 0.32 * np.sqrt(up) * (0.7 + 0.3 * clouds)  # what comes from everywhere
    ambient = grey * np.array([0.96 - 0.04 * through, 1.0, 1.08 + 0.04 * through])
    level = np.cos(np.deg2rad(elevation))
    ray = (float(-level * np.cos(azimuth)), float(-level * np.sin(azimuth)), float(-up))
    clear, dull = np.array([0.24, 0.45, 0.80]), np.array([0.62, 0.65, 0.70])
    bright = 0.55 + 0.45 * np.sqrt(up)
    zenith = bright * ((1.0 - clouds) * clear + clouds * dull)
    horizon = bright * (low * np.array([1.05, 0.80, 0.62]) + (1.0 - low) * np.array([0.80, 0.85, 0.90]))
    cloud = bright * (low * np.array([0.95, 0.72, 0.66]) + (1.0 - low) * np.array([0.93, 0.94, 0.95]))
    cloud *= 0.78 if overcast else 1.0
    return Lighting(
        f"day_{number}",
        ambient=_colour(ambient),
        suns=(
            ((0.1, 0.2, -1.0), _colour(np.full(3, 0.3 * grey)), False) if overcast else (ray, _colour(sun), True),
            ((-ray[0], -ray[1], -0.7), _colour(0.18 * ambient), False),
        ),
        zenith=_colour(zenith),
        horizon=_colour(horizon),
        clouds=float(clouds),
        cloud=_colour(cloud),
        skyline=_colour(horizon * np.array([0.42, 0.47, 0.44])),
        occlusion=float(0.4 + 0.6 * (1.0 - through)),
        exposure=float(brightness * _GREY / (0.36 * (ambient.mean() + 0.5 * up * sun.mean()))),
        noise=0.003 + 0.004 * low,
        gain=(1.0 + tint, 1.0, 1.0 - tint),
        glow_sun=_colour(0.45 * through * np.array([1.0, 0.8, 0.55])),
        wet=wetness if wet else 0.0,
        visibility=visibility if hazy else float("inf"),
    )


def _colour(rgb: np.ndarray) -> Colour:
    red, green, blue = np.clip(rgb, 0.0, 1.05).tolist()
    return red, green, blue


WEATHER: dict[str, Lighting] = {
    lighting.name: lighting
    for lighting in (
        Lighting(
            "dawn",
            ambient=(0.36, 0.37, 0.47),
            suns=(((-0.72, -0.52, -0.42), (0.86, 0.58, 0.36), True), ((0.5, 0.4, -0.8), (0.10, 0.11, 0.16), False)),
            zenith=(0.34, 0.46, 0.70),
            horizon=(0.95, 0.76, 0.60),
            clouds=0.35,
            cloud=(0.93, 0.76, 0.70),
            skyline=(0.26, 0.27, 0.30),
            occlusion=0.6,
            glow_sun=(0.5, 0.34, 0.18),
            exposure=1.6,
            noise=0.005,
            gain=(1.02, 1.0, 0.98),
        ),
        Lighting(
            "afternoon",
            ambient=(0.42, 0.45, 0.52),
            suns=(((0.66, 0.18, -0.62), (1.02, 0.90, 0.70), True), ((-0.5, 0.4, -0.5), (0.10, 0.11, 0.14), False)),
            zenith=(0.26, 0.45, 0.76),
            horizon=(0.78, 0.83, 0.88),
            clouds=0.55,
            cloud=(0.94, 0.93, 0.92),
            skyline=(0.32, 0.38, 0.34),
            occlusion=0.5,
            glow_sun=(0.4, 0.34, 0.24),
            exposure=1.15,
            noise=0.003,
        ),
        Lighting(
            "evening",
            ambient=(0.28, 0.27, 0.36),
            suns=(((0.50, -0.78, -0.30), (0.66, 0.38, 0.22), True), ((-0.3, 0.1, -1.0), (0.12, 0.12, 0.18), False)),
            zenith=(0.18, 0.22, 0.44),
            horizon=(0.90, 0.52, 0.36),
            clouds=0.6,
            cloud=(0.66, 0.44, 0.46),
            skyline=(0.15, 0.14, 0.19),
            occlusion=0.7,
            lamps=(0.34, 0.27, 0.16),
            glow=0.8,
            exposure=1.7,
            noise=0.007,
            gain=(1.03, 1.0, 0.97),
        ),
        Lighting(
            "haze",
            ambient=(0.56, 0.57, 0.59),
            suns=(((-0.55, 0.20, -0.60), (0.34, 0.32, 0.28), True), ((0.4, -0.3, -0.8), (0.10, 0.10, 0.11), False)),
            zenith=(0.72, 0.76, 0.80),
            horizon=(0.86, 0.86, 0.85),
            clouds=0.5,
            cloud=(0.86, 0.86, 0.86),
            skyline=(0.72, 0.74, 0.74),
            occlusion=0.8,
            visibility=60.0,
            exposure=1.1,
            noise=0.004,
        ),
        Lighting(
            "rain",
            ambient=(0.40, 0.43, 0.48),
            suns=(((0.1, 0.2, -1.0), (0.24, 0.25, 0.27), False), ((-0.6, 0.5, -0.4), (0.07, 0.07, 0.08), False)),
            zenith=(0.46, 0.49, 0.54),
            horizon=(0.62, 0.64, 0.67),
            clouds=1.0,
            cloud=(0.50, 0.52, 0.56),
            skyline=(0.36, 0.39, 0.41),
            occlusion=1.0,
            wet=0.35,
            visibility=130.0,
            lamps=(0.10, 0.08, 0.05),
            glow=0.5,
            exposure=1.45,
            noise=0.007,
            gain=(0.97, 1.0, 1.04),
        ),
        *(_day(number) for number in range(1, 1 + _DAYS)),
    )
}
"""By name."""
