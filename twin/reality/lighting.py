"""The lightings of the known-truth world: lights, sky, and how the camera takes them.

Colours are those of the film, not of physics: the renderer adds lights linearly and clips at 1, and the film module
applies exposure and a tone curve to what it gets.
"""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.reality.textures import fbm

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Lighting:
    """One lighting and its film's traits."""

    name: str
    ambient: Colour
    """Light from everywhere."""
    suns: tuple[tuple[Colour, Colour, bool], ...]
    """Directional lights: direction they shine in, colour, whether they cast shadows."""
    zenith: Colour
    horizon: Colour
    clouds: float
    """Cover, 0 to 1."""
    cloud: Colour
    skyline: Colour
    """Of the far trees and roofs along the horizon."""
    occlusion: float
    """How much of the baked ambient occlusion is applied, 0 to 1."""
    lamps: Colour = (0.0, 0.0, 0.0)
    """Light of the street lamps."""
    glow: float = 0.0
    """Emission of lamp heads and lit windows."""
    exposure: float = 1.0
    drift: float = 0.10
    """Standard deviation of the exposure's logarithm within the film."""
    noise: float = 0.004
    """Sensor noise at mid grey [share of full scale]."""
    gain: Colour = (1.0, 1.0, 1.0)
    """White balance."""
    glow_sun: Colour = (0.0, 0.0, 0.0)
    """Brightening of the sky around the first sun."""
    wet: float = 0.0
    """How much darker the ground is for being wet, 0 to 1."""
    visibility: float = float("inf")
    """Distance over which haze takes all but 1/e of the light [m]; haze has the colour of the horizon."""


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


def sky(lighting: Lighting, seed: int, width: int = 512) -> NDArray[np.uint8]:
    """A cube map for MuJoCo's skybox: six faces stacked, shape (6 · width, width, 3) uint8.

    The geometry of sky and clouds differs per lighting; the skyline is the same in all.
    """
    t, s = np.meshgrid(np.arange(width), np.arange(width), indexing="ij")
    a, b = (2 * (s + 0.5) / width - 1), (2 * (t + 0.5) / width - 1)
    one = np.ones_like(a)
    # OpenGL cube-face order +X −X +Y −Y +Z −Z; MuJoCo reads it with its y axis up the world's z.
    cube = [(one, -b, -a), (-one, -b, a), (a, one, b), (a, -one, -b), (a, -b, one), (-a, -b, -one)]
    rays = np.stack([np.stack(face, -1) for face in cube])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    world = np.stack([rays[..., 0], -rays[..., 2], rays[..., 1]], -1)
    azimuth, elevation = np.arctan2(world[..., 1], world[..., 0]), np.arcsin(np.clip(world[..., 2], -1, 1))
    height = np.clip(np.sin(elevation), 0.0, 1.0)[..., None]
    out = np.asarray(lighting.horizon) + (np.asarray(lighting.zenith) - lighting.horizon) * height**0.55
    rng = np.random.default_rng([seed, sum(map(ord, lighting.name))])
    plane = world[..., :2] / np.maximum(world[..., 2:], 0.06)
    field = fbm(rng, (1024, 1024), 220, 2.0, 0.62)
    grid = (plane * 55.0 + 512.0).astype(np.float32) % 1024
    noise = np.stack(
        [cv2.remap(field, g[..., 0], g[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for g in grid]
    )
    threshold = np.quantile(field, 1.0 - lighting.clouds)
    cover = np.clip((noise - threshold) / 0.9, 0.0, 1.0) * np.clip((elevation - 0.02) / 0.25, 0.0, 1.0)
    shade = 1.0 - 0.13 * np.clip(noise, -1.0, 2.0)
    out += (cover * 0.9)[..., None] * (np.asarray(lighting.cloud) * shade[..., None] - out)
    if lighting.suns and sum(lighting.glow_sun):
        toward = -np.asarray(lighting.suns[0][0]) / np.linalg.norm(lighting.suns[0][0])
        close = np.clip((world * toward).sum(-1), 0.0, 1.0)[..., None]
        out += np.asarray(lighting.glow_sun) * (close**24 + 2.0 * close**600)
    still = np.random.default_rng([seed, 7])
    ring = fbm(still, (1, 4096), 300, 3.0, 0.75)[0]
    ring[-200:] += (ring[0] - ring[-1]) * np.linspace(0, 1, 200)  # closes the circle
    column = ((azimuth / (2 * np.pi) + 0.5) * 4095).astype(int)
    edge = 0.075 + 0.028 * ring[column]
    texture = fbm(still, (512, 4096), 40, 2.0, 0.8)
    row = np.clip((elevation / 0.2 * 511), 0, 511).astype(int)
    trees = np.asarray(lighting.skyline) * (1.0 + 0.22 * texture[row, column])[..., None]
    out = np.where((elevation < edge)[..., None], trees, out)
    return (np.clip(out, 0.0, 1.0) * 255 + 0.5).astype(np.uint8).reshape(6 * width, width, 3)


def hazed(light: NDArray[np.float32], depth: NDArray[np.float32], lighting: Lighting) -> NDArray[np.float32]:
    """A picture (h, w, 3) seen through the lighting's haze, by its z-depth (h, w) [m]; the sky, 0, has its own."""
    if np.isinf(lighting.visibility):
        return light
    share = np.where(depth > 0.0, np.exp(-depth / lighting.visibility), 1.0).astype(np.float32)[..., None]
    return share * light + (1.0 - share) * np.asarray(lighting.horizon, np.float32)


def add_lights(spec: mujoco.MjSpec, lighting: Lighting, lamp_heads: NDArray[np.float64]) -> None:
    """Adds a lighting's lights to a model; `lamp_heads` are the lamps' positions [m], shape (k, 3)."""
    spec.visual.headlight.active = 0
    world = spec.worldbody
    for k, (direction, colour, shadow) in enumerate(lighting.suns):
        world.add_light(
            name=f"sun_{k}",
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0, 0, 60],
            dir=np.asarray(direction) / np.linalg.norm(direction),
            ambient=list(lighting.ambient) if k == 0 else [0, 0, 0],
            diffuse=list(colour),
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
