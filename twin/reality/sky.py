"""The sky of the simulated reality, with the far view in it, such as hills, and haze."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.reality import SEED
from twin.reality.lighting import Lighting
from twin.reality.place_spec import HorizonSpec, PlaceSpec, rgb, stream
from twin.reality.textures import fbm
from twin.types import Array

_COLUMNS = 4096  # columns of a skyline, over a full turn


def _tree_line(seed: int) -> tuple[NDArray, NDArray]:
    """The skyline of the campus road: a row of trees; see `skyline`."""
    still = np.random.default_rng([seed, 7])
    ring = fbm(still, (1, 4096), 300, 3.0, 0.75)[0]
    ring[-200:] += (ring[0] - ring[-1]) * np.linspace(0, 1, 200)  # makes both ends of the ring meet
    return 0.075 + 0.028 * ring, 1.0 + 0.22 * fbm(still, (512, 4096), 40, 2.0, 0.8)


def sky_cube_map(
    lighting: Lighting, seed: int, width: int = 512, skyline: tuple[NDArray, NDArray] | None = None
) -> NDArray[np.uint8]:
    """A cube map for MuJoCo's skybox: six stacked faces, shape (6 · width, width, 3) uint8.

    The clouds differ per lighting; the skyline, as the function `skyline` returns it, is the same under all lightings.
    """
    t, s = np.meshgrid(np.arange(width), np.arange(width), indexing="ij")
    a, b = (2 * (s + 0.5) / width - 1), (2 * (t + 0.5) / width - 1)
    one = np.ones_like(a)
    # OpenGL's order of cube faces: +X −X +Y −Y +Z −Z; MuJoCo takes the cube's y axis along the world's z.
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
    heights, shade = skyline or _tree_line(seed)
    column = ((azimuth / (2 * np.pi) + 0.5) * 4095).astype(int)
    edge = heights[column]
    row = np.clip((elevation / 0.2 * 511), 0, 511).astype(int)
    trees = np.asarray(lighting.skyline) * shade[row, column][..., None]
    out = np.where((elevation < edge)[..., None], trees, out)
    return (np.clip(out, 0.0, 1.0) * 255 + 0.5).astype(np.uint8).reshape(6 * width, width, 3)


def place_sky(spec: PlaceSpec, lighting: Lighting) -> NDArray[np.uint8]:
    """The cube map of the sky of a place under a lighting."""
    tinted = replace(lighting, skyline=rgb(np.multiply(lighting.skyline, spec.horizon.tint)))
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


# ---- haze

_HAZE_HEIGHT = 25.0  # [m] height over which the density of haze falls to 1/e
_FORWARD_SCATTER = 0.35  # relative excess of the haze's brightness in the direction of the sun
_SKY = 400.0  # [m] assumed length of the ray through haze for a pixel of the sky


def apply_haze(
    light: NDArray[np.float32],
    depth: NDArray[np.float32],
    rays: NDArray,
    camera_to_world: NDArray[np.float64],
    lighting: Lighting,
    ground: float,
) -> NDArray[np.float32]:
    """Adds haze to an image. The haze's extinction falls exponentially with height; its airlight grows towards the sun.

    Args:
        light: Linear RGB, shape (h, w, 3).
        depth: z-depth [m], 0 = sky, shape (h, w).
        rays: Rays of the pixels with z = 1 in the camera frame, shape (h, w, 3).
        camera_to_world: OpenCV axes, shape (4, 4).
        lighting: Its `visibility` applies at the ground; its `horizon` is the color of the haze.
        ground: Height of the ground [m].
    """
    if np.isinf(lighting.visibility):
        return light
    world = rays @ camera_to_world[:3, :3].T
    per_depth = np.linalg.norm(rays, axis=-1)
    length = np.where(depth > 0.0, depth * per_depth, _SKY)
    # The bound of −3 limits the extinction along rays that go below the ground.
    rise = np.clip(world[..., 2] / per_depth * length / _HAZE_HEIGHT, -3.0, 60.0)
    start = np.exp(-max(float(camera_to_world[2, 3]) - ground, 0.0) / _HAZE_HEIGHT)
    level = np.abs(rise) < 1e-4
    # Mean of exp(−h) over h from 0 to `rise`.
    mean = np.where(level, 1.0, -np.expm1(-rise) / np.where(level, 1.0, rise))
    through = np.exp(-length / lighting.visibility * start * mean)[..., None]
    toward = -np.asarray(lighting.suns[0][0]) / np.linalg.norm(lighting.suns[0][0])
    facing = np.clip((world * toward).sum(-1) / per_depth, 0.0, 1.0)
    airlight = np.asarray(lighting.horizon) * (1.0 + _FORWARD_SCATTER * facing[..., None] ** 4)
    return (through * light + (1.0 - through) * airlight).astype(np.float32)
