"""Lightings and skies of randomly sampled places; a sky contains the far view, such as hills."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.reality import SEED
from twin.reality.lighting import LIGHTINGS, Lighting, daylight, sky_cube_map
from twin.reality.place_spec import HorizonSpec, LightSpec, PlaceSpec, Rgb, stream
from twin.reality.textures import fbm
from twin.types import Array

_COLUMNS = 4096  # columns of a skyline, over a full turn


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
        )
    day = daylight(
        light.name,
        light.elevation,
        np.deg2rad(light.azimuth),
        light.clouds,
        0.2,
        light.haze,
        0.0,
        light.warmth,
        1.0,
    )
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
    return factor * color[0], factor * color[1], factor * color[2]


def place_sky(spec: PlaceSpec, lighting: Lighting) -> NDArray[np.uint8]:
    """The cube map of the sky of a place under a lighting."""
    red, green, blue = (a * b for a, b in zip(lighting.skyline, spec.horizon.tint, strict=True))
    tinted = replace(lighting, skyline=(red, green, blue))
    seed = SEED + 1000 * spec.number
    return sky_cube_map(tinted, seed, skyline=skyline(spec.horizon, stream(spec.number, "horizon", 1)))


def skyline(horizon: HorizonSpec, rng: np.random.Generator) -> tuple[Array, Array]:
    """Elevation angle [rad] of the far view's upper edge, and its shade: shapes (columns,) and (512, columns).

    Row r of the shade lies at an elevation of 0.2 r / 511 rad. The shade is a factor on the lighting's skyline color.
    """
    period = horizon.period / (2 * np.pi) * _COLUMNS
    if horizon.kind == "towers":
        ring = np.zeros(_COLUMNS)
        start = 0
        while start < _COLUMNS:
            wide = int(rng.uniform(0.4, 1.6) * period) + 4
            tall = float(rng.exponential(1.0)) if rng.random() < 0.6 else -0.5
            ring[start : start + wide] = tall - 0.6
            start += wide
    else:
        finest = {"hills": 60.0, "mountains": 6.0}.get(horizon.kind, 2.0)
        ring = fbm(rng, (1, _COLUMNS), max(period, finest), finest, 0.55)[0].astype(float)
        ring[-200:] += (ring[0] - ring[-1]) * np.linspace(0, 1, 200)  # makes both ends of the ring meet
    edge = np.maximum(horizon.height + horizon.roughness * ring, 0.004)
    texture = fbm(rng, (512, _COLUMNS), 40, 2.0, 0.8)
    shade = 1.0 + {"hills": 0.10, "flat": 0.1, "mountains": 0.16}.get(horizon.kind, 0.22) * texture
    rows = np.linspace(0.0, 0.2, 512)[:, None]
    if horizon.kind == "towers":
        columns = np.arange(_COLUMNS)[None]
        windows = (np.sin(rows * 900.0) > 0.2) & (columns % 9 < 4) & (rng.random((1, _COLUMNS)) < 0.8)
        shade = 1.0 + 0.06 * texture + 0.25 * windows
    elif horizon.kind in ("hills", "mountains"):  # nearer ridges are darker
        for k in range(2):
            nearer = fbm(rng, (1, _COLUMNS), 0.5 * period, 12.0, 0.6)[0]
            ridge = (0.62 - 0.27 * k) * horizon.height * (1.0 + 0.35 * nearer)
            shade = np.where(rows < ridge[None], (0.82 - 0.2 * k) + 0.12 * texture, shade)
    return edge, shade
