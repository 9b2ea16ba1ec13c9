"""Lightings of the simulated reality: lights, colors of the sky, and the camera's exposure under them.

`LIGHTINGS` are those of films of the campus road; `WEATHER` are those of the real test, which are not filmed. Randomly
sampled places have lightings of their own. Colors are display values, not radiometric ones: the renderer adds lights
linearly and clips at 1, and `filming.py` applies exposure and a tone curve.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError, name_hint, short_repr
from twin.reality import SEED
from twin.reality.place_spec import LightSpec, PlaceSpec, Rgb, rgb


@dataclass(frozen=True)
class Lighting:
    """One lighting, and the camera settings of films under it. Colors are RGB."""

    name: str
    ambient: Rgb
    """Ambient light."""
    suns: tuple[tuple[Rgb, Rgb, bool], ...]
    """Directional lights: direction of the rays, color, and a flag for cast shadows."""
    zenith: Rgb
    horizon: Rgb
    clouds: float
    """Cloud cover, 0 to 1."""
    cloud: Rgb
    skyline: Rgb
    """Color of the distant trees and roofs along the horizon."""
    occlusion: float
    """Strength of the baked ambient occlusion, 0 to 1."""
    lamps: Rgb = (0.0, 0.0, 0.0)
    """Light of the street lamps."""
    glow: float = 0.0
    """Emission of lamp heads and lit windows."""
    exposure: float = 1.0
    drift: float = 0.10
    """Standard deviation of the log exposure within a film."""
    noise: float = 0.004
    """Sensor noise at mid gray [fraction of full scale]."""
    gain: Rgb = (1.0, 1.0, 1.0)
    """White balance: factors on RGB."""
    glow_sun: Rgb = (0.0, 0.0, 0.0)
    """Brightening of the sky around the first sun."""
    wet: float = 0.0
    """Fraction by which wet ground is darker, 0 to 1."""
    visibility: float = float("inf")
    """Distance on the ground over which haze transmits 1/e of the light [m]; haze has the color of the horizon."""


LIGHTINGS: dict[str, Lighting] = {
    lighting.name: lighting
    for lighting in (
        Lighting(
            "sun",
            ambient=(0.46, 0.50, 0.58),
            suns=(((-0.40, 0.45, -0.85), (0.98, 0.91, 0.78), True), ((0.5, -0.3, -0.4), (0.10, 0.12, 0.16), False)),
            zenith=(0.22, 0.42, 0.78),
            horizon=(0.70, 0.82, 0.94),
            clouds=0.30,
            cloud=(0.97, 0.97, 0.98),
            skyline=(0.33, 0.42, 0.38),
            occlusion=0.45,
            glow_sun=(0.5, 0.42, 0.3),
            exposure=1.2,
            drift=0.08,
            noise=0.003,
        ),
        Lighting(
            "overcast",
            ambient=(0.60, 0.63, 0.67),
            suns=(((0.2, 0.3, -1.0), (0.42, 0.42, 0.42), False), ((-0.8, -0.5, -0.3), (0.10, 0.10, 0.10), False)),
            zenith=(0.66, 0.69, 0.74),
            horizon=(0.84, 0.86, 0.88),
            clouds=0.95,
            cloud=(0.75, 0.77, 0.80),
            skyline=(0.42, 0.46, 0.46),
            occlusion=1.0,
            exposure=1.2,
            noise=0.004,
            gain=(0.98, 1.0, 1.03),
        ),
        Lighting(
            "dusk",
            ambient=(0.30, 0.27, 0.36),
            suns=(((0.78, 0.55, -0.26), (0.75, 0.42, 0.20), True), ((-0.3, 0.1, -1.0), (0.12, 0.12, 0.18), False)),
            zenith=(0.20, 0.22, 0.42),
            horizon=(0.92, 0.56, 0.34),
            clouds=0.5,
            cloud=(0.72, 0.45, 0.42),
            skyline=(0.16, 0.14, 0.19),
            occlusion=0.7,
            lamps=(0.30, 0.22, 0.12),
            glow=0.75,
            exposure=1.2,
            noise=0.006,
            gain=(1.03, 1.0, 0.97),
        ),
        Lighting(
            "night",
            ambient=(0.135, 0.15, 0.215),
            suns=(((0.4, 0.3, -1.0), (0.07, 0.08, 0.12), False),),
            zenith=(0.015, 0.02, 0.05),
            horizon=(0.10, 0.09, 0.11),
            clouds=0.35,
            cloud=(0.09, 0.08, 0.09),
            skyline=(0.02, 0.02, 0.03),
            occlusion=0.7,
            lamps=(1.0, 0.80, 0.50),
            glow=1.0,
            exposure=1.7,
            drift=0.07,
            noise=0.007,
        ),
    )
}


def add_lights(spec: mujoco.MjSpec, lighting: Lighting, lamp_heads: NDArray[np.float64]) -> None:
    """Adds the lights of a lighting to a model; `lamp_heads` are lamp positions [m], shape (k, 3)."""
    spec.visual.headlight.active = 0
    world = spec.worldbody
    for k, (direction, color, shadow) in enumerate(lighting.suns):
        world.add_light(
            name=f"sun_{k}",
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0, 0, 60],
            dir=np.asarray(direction) / np.linalg.norm(direction),
            ambient=list(lighting.ambient) if k == 0 else [0, 0, 0],
            diffuse=list(color),
            specular=[0, 0, 0],
            castshadow=shadow,
        )
    if sum(lighting.lamps) == 0.0:
        return
    for k, head in enumerate(lamp_heads):
        world.add_light(
            name=f"lamp_{k}",
            type=mujoco.mjtLightType.mjLIGHT_SPOT,
            pos=head - np.array([0.0, 0.0, 0.12]),
            dir=[0, 0, -1],
            cutoff=82.0,
            exponent=1.0,
            attenuation=[0.35, 0.0, 0.028],
            ambient=[0, 0, 0],
            diffuse=list(lighting.lamps),
            specular=[0, 0, 0],
            castshadow=False,
        )


# ---- lightings of the real test


_DAYS = 15
_HIGH_SUN = np.array([1.0, 0.94, 0.83])
_LOW_SUN = np.array([1.0, 0.60, 0.34])  # color of a sun at the horizon
_REDDENING_ANGLE = 14.0  # [°] difference of elevation over which the redness of a low sun falls to 1/e
_MEAN_BRIGHTNESS = 0.3  # mean image value for which a day's exposure is chosen


def _day(number: int) -> Lighting:
    """A random day, the same for the same number: sun, clouds and haze are sampled; the colors follow from these."""
    rng = np.random.default_rng([SEED, 51, number])
    elevation, azimuth = rng.uniform(6.0, 60.0), rng.uniform(0.0, 2.0 * np.pi)
    clouds, veil = rng.uniform(0.1, 1.0), rng.uniform(0.0, 1.0)
    hazy, wet = rng.uniform() < 0.4, rng.uniform() < 0.4
    visibility, wetness = float(np.exp(rng.uniform(np.log(60.0), np.log(400.0)))), float(rng.uniform(0.15, 0.4))
    tint, brightness = rng.uniform(-0.03, 0.03), float(np.exp(rng.uniform(-0.15, 0.15)))

    haze, water = visibility if hazy else float("inf"), wetness if wet else 0.0
    return daylight(f"day_{number}", elevation, azimuth, clouds, veil, haze, water, tint, brightness)


def daylight(
    name: str,
    elevation: float,
    azimuth: float,
    clouds: float,
    veil: float,
    visibility: float,
    wet: float,
    tint: float,
    brightness: float,
) -> Lighting:
    """The lighting of a day; the colors follow from sun, clouds and haze.

    Args:
        name: Name of the lighting.
        elevation: Elevation of the sun [°].
        azimuth: Azimuth of the sun, counterclockwise from +x [rad].
        clouds: Cloud cover, 0 to 1; above 0.8 no direct sunlight.
        veil: Thickness of high cloud in front of the sun, 0 to 1.
        visibility: Distance at which haze transmits 1/e of the light [m].
        wet: Fraction by which wet ground is darker, 0 to 1.
        tint: White balance, positive is warmer.
        brightness: Relative exposure.
    """
    up, low = np.sin(np.deg2rad(elevation)), float(np.exp(-elevation / _REDDENING_ANGLE))
    overcast = clouds > 0.8
    through = 0.0 if overcast else (1.0 - clouds) ** 0.3 * (1.0 - 0.4 * veil)  # fraction of direct sunlight
    sun = through * (0.55 + 0.45 * up) * 1.2 * (low * _LOW_SUN + (1.0 - low) * _HIGH_SUN)
    gray = 0.30 + 0.32 * np.sqrt(up) * (0.7 + 0.3 * clouds)  # ambient
    ambient = gray * np.array([0.96 - 0.04 * through, 1.0, 1.08 + 0.04 * through])
    level = np.cos(np.deg2rad(elevation))
    ray = (float(-level * np.cos(azimuth)), float(-level * np.sin(azimuth)), float(-up))
    clear, dull = np.array([0.24, 0.45, 0.80]), np.array([0.62, 0.65, 0.70])
    bright = 0.55 + 0.45 * np.sqrt(up)
    zenith = bright * ((1.0 - clouds) * clear + clouds * dull)
    horizon = bright * (low * np.array([1.05, 0.80, 0.62]) + (1.0 - low) * np.array([0.80, 0.85, 0.90]))
    cloud = bright * (low * np.array([0.95, 0.72, 0.66]) + (1.0 - low) * np.array([0.93, 0.94, 0.95]))
    cloud *= 0.78 if overcast else 1.0
    return Lighting(
        name,
        ambient=_color(ambient),
        suns=(
            ((0.1, 0.2, -1.0), _color(np.full(3, 0.3 * gray)), False) if overcast else (ray, _color(sun), True),
            ((-ray[0], -ray[1], -0.7), _color(0.18 * ambient), False),
        ),
        zenith=_color(zenith),
        horizon=_color(horizon),
        clouds=float(clouds),
        cloud=_color(cloud),
        skyline=_color(horizon * np.array([0.42, 0.47, 0.44])),
        occlusion=float(0.4 + 0.6 * (1.0 - through)),
        exposure=float(brightness * _MEAN_BRIGHTNESS / (0.36 * (ambient.mean() + 0.5 * up * sun.mean()))),
        noise=0.003 + 0.004 * low,
        gain=(1.0 + tint, 1.0, 1.0 - tint),
        glow_sun=_color(0.45 * through * np.array([1.0, 0.8, 0.55])),
        wet=wet,
        visibility=visibility,
    )


def _color(values: np.ndarray) -> Rgb:
    return rgb(np.clip(values, 0.0, 1.05))


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
"""Lightings of the real test by name: five designed weathers and 15 random days.

None is filmed; a build gets at most one photo of each. The sun's position and color differ from those in every film,
and the air may be hazy or the ground wet.

The designed weathers were used during development. `twin.env.domain_randomization.KNOWN_WEATHER_FRACTION` was tuned on
images of these and of days 1 to 5. Days 6 to 15 were not used during development.
"""


def weather(name: str) -> Lighting:
    """The weather with a name: one of `WEATHER`, or `day_N` for any whole number N ≥ 1.

    Raises:
        InputError: no such weather.
    """
    if name in WEATHER:
        return WEATHER[name]
    _, _, number = name.partition("day_")
    if name.startswith("day_") and number.isascii() and number.isdecimal() and number[0] != "0" and len(number) < 10:
        return _day(int(number))
    named = list(WEATHER)[: len(WEATHER) - _DAYS]
    every = f"expected one of {', '.join(named)}, day_1, day_2, ..."
    raise InputError(f"no lighting {short_repr(name)} in the real test; {name_hint(name, named, every)}")


def weather_index(name: str) -> int:
    """Unique number of a weather: its index in `WEATHER`; days after the last of `WEATHER` continue the count."""
    weather(name)
    if name in WEATHER:
        return list(WEATHER).index(name)
    return len(WEATHER) - _DAYS - 1 + int(name.removeprefix("day_"))


def day_number(name: str) -> str:
    """The number N of `day_N`, as text; empty for the designed weathers."""
    return name.removeprefix("day_") if name.startswith("day_") else ""


# ---- lightings of randomly sampled places


def place_lightings(spec: PlaceSpec) -> dict[str, Lighting]:
    """The lightings of a place's films by name."""
    return {light.name: _lighting(light, spec) for light in spec.lights}


def _lighting(light: LightSpec, spec: PlaceSpec) -> Lighting:
    gain = (1.0 + light.warmth, 1.0, 1.0 - light.warmth)
    lamps, lit = spec.lamps.color, spec.lamps.kind != "none"
    if light.name == "night":
        # Without lamps the moon is brighter and the camera's exposure is longer.
        base, moon = LIGHTINGS["night"], 1.0 if lit else 1.9
        return replace(
            base,
            ambient=_scaled(base.ambient, moon),
            suns=((_ray(light), (0.10 * moon, 0.11 * moon, 0.15 * moon), False),),
            zenith=_scaled(base.zenith, moon),
            horizon=_scaled(base.horizon, moon),
            clouds=light.clouds,
            skyline=(0.02 * moon, 0.02 * moon, 0.03 * moon),
            lamps=lamps if lit else (0.0, 0.0, 0.0),
            exposure=1.8 if lit else 2.1,
            gain=gain,
            visibility=light.haze,
        )
    azimuth = np.deg2rad(light.azimuth)
    day = daylight(light.name, light.elevation, azimuth, light.clouds, 0.2, light.haze, 0.0, light.warmth, 1.0)
    if light.name == "dusk":
        day = replace(
            day,
            ambient=_scaled(day.ambient, 0.75),
            zenith=_scaled(day.zenith, 0.55),
            horizon=_scaled(day.horizon, 0.85),
            cloud=_scaled(day.cloud, 0.65),
            skyline=_scaled(day.skyline, 0.5),
            lamps=_scaled(lamps, 0.3) if lit else (0.0, 0.0, 0.0),
            glow=0.75,
            noise=0.006,
        )
    return day


def _ray(light: LightSpec) -> Rgb:
    """Unit vector along the rays of sun or moon."""
    up, azimuth = np.deg2rad(light.elevation), np.deg2rad(light.azimuth)
    return float(-np.cos(up) * np.cos(azimuth)), float(-np.cos(up) * np.sin(azimuth)), float(-np.sin(up))


def _scaled(color: Rgb, factor: float) -> Rgb:
    return rgb(factor * np.array(color))
