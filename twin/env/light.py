"""What light falls on things in a radiance field, estimated from the field itself.

A field knows colours, not light. *Irradiance* here is what a colour of 1 (perfect white, facing some way) would look
like in the film of a lighting: an obstacle's own colour times the irradiance is what it looks like there. It has two
factors: the *level*, of what faces up at a place, and the *shape*, how much of that reaches what faces elsewhere.

Level: the colour of the reconstructed ground around the place, over the albedo that is taken for it. Shape: probes with
other normals are compared with themselves under the mean of the filmed lightings, which cancels their albedo, and with
the ground near them, which cancels the level; that mean is taken for a uniform sky over a dim ground. Six coefficients
are fitted per colour (an *ambient cube*: Mitchell et al. 2006 without its lower face, plus a constant).

*Probes* are rays whose composited features are kept, so that any embedding gives them colours in a millisecond.
"""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.mjcf.world import arc_lengths, heading_at, point_at
from twin.nerf.baked import BakedField
from twin.nerf.plausible import Probes

Array = NDArray[np.float64]

GROUND_ALBEDO = 0.38
"""What the ground along the route is taken to reflect, in film colours: worn asphalt reflects about 12 %, which a film's
tone curve (exponent 1 / 2.2) shows as 0.38."""

DIRECTIONS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
"""From where the lights of the shape come, shape (5, 3); a constant comes on top."""

_EYE_HEIGHT, _PITCH = 1.0, 8.0  # [m], [°] of the views that probes are taken from
_EYE_STEP = 1.0  # [m] of the route
_VIEW, _FOCAL = (96, 54), 50.0  # [px]; nearly 90° wide
_GROUND_REACH, _WALL_REACH = 7.0, 12.0  # [m] depth up to which probes are taken
_GROUND_SKIN = 0.12  # [m] from the ground
_STANDING = 0.3  # [m] above the ground from where on a probe is none of it
_MOST_PROBES = 4000  # of each kind
_NEAR = 0.7  # [m] standard deviation of the ground's weights around a place
_BOUNCE = 0.25  # radiosity of the ground over that of the sky, in the mean of the filmed lightings
_DARK = 0.02  # a probe whose mean colour is below tells nothing
_KEPT = 64  # lightings


@dataclass(frozen=True)
class Light:
    """One lighting's light."""

    xy: Array
    """Places of the ground's probes [m], shape (k, 2)."""
    irradiance: Array
    """Of what faces up there, shape (k, 3)."""
    constant: Array
    """Share of the level that reaches everything, shape (3,)."""
    lights: Array
    """Share of the level that light from each of `DIRECTIONS` adds, times the cosine, shape (5, 3)."""

    def level(self, xy: Array) -> Array:
        """Irradiance of what faces up at places (n, 2) [m], shape (n, 3)."""
        distance2 = ((np.asarray(xy)[:, None] - self.xy) ** 2).sum(-1)
        # Where no probe is near, the nearest ones count.
        weight = np.exp(-0.5 * distance2 / _NEAR**2) + 1e-6 / (1.0 + distance2**2)
        return (weight / weight.sum(1, keepdims=True)) @ self.irradiance

    def shape(self, normals: Array) -> Array:
        """Irradiance of unit normals (n, 3) over the level, shape (n, 3)."""
        return self.constant + np.maximum(np.asarray(normals) @ DIRECTIONS.T, 0.0) @ self.lights


class FieldLight:
    """Estimates the light of any lighting of a field."""

    def __init__(self, field: BakedField, route: Array):
        """
        Args:
            field: Looked at from along the route, once.
            route: On the ground [m], shape (m, 3).
        """
        self._field = field
        self._kept: OrderedDict[bytes, Light] = OrderedDict()
        found = _look(field, route)
        height, lateral = _above(found.points, route)
        depth = found.depth
        flat = found.normals[:, 2] > 0.9
        ground = (np.abs(height) < _GROUND_SKIN + 0.05 * np.abs(lateral)) & (depth < _GROUND_REACH) & flat
        standing = (height > _STANDING) & (depth < _WALL_REACH) & (found.facing > 0.25)
        rng = np.random.default_rng(0)
        self._ground = found.pick(_some(rng, ground))
        self._standing = found.pick(_some(rng, standing))
        names = field.lightings
        self._mean_ground = _balanced([self._ground.probes.picture(field.embedding(n)) for n in names])
        self._mean_standing = _balanced(
            [self._standing.probes.picture(field.embedding(n)) for n in names],
            [self._ground.probes.picture(field.embedding(n)) for n in names],
        )

    def under(self, lighting: str | NDArray) -> Light:
        """The light of a lighting, by name or embedding (dim,)."""
        embedding = self._field.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        key = embedding.tobytes()
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        light = self._estimate(embedding)
        self._kept[key] = light
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return light

    def _estimate(self, embedding: NDArray) -> Light:
        xy = self._ground.points[:, :2]
        irradiance = self._ground.probes.picture(embedding).astype(np.float64) / GROUND_ALBEDO
        constant, lights = self._shape(embedding, irradiance)
        return Light(xy, irradiance, constant, lights)

    def _shape(self, embedding: NDArray, irradiance: Array) -> tuple[Array, Array]:
        from scipy.optimize import nnls

        normals, mean = self._standing.normals, self._mean_standing
        colours = self._standing.probes.picture(embedding).astype(np.float64)
        level = irradiance.mean(0) * GROUND_ALBEDO
        sky = _uniform_sky(normals)
        basis = np.column_stack([np.ones(len(normals)), np.maximum(normals @ DIRECTIONS.T, 0.0)])
        # What faces up is known: its level.
        anchor, weight = np.zeros((1, 6)), float(len(normals))
        anchor[0, :2] = 1.0
        out = np.empty((6, 3))
        for c in range(3):
            usable = mean[:, c] > _DARK
            seen = colours[usable, c] / mean[usable, c] / level[c] * sky[usable]
            rows = np.concatenate([basis[usable], weight * anchor])
            out[:, c], _ = nnls(rows, np.append(np.clip(seen, 0.0, 3.0), weight))
        return out[0], out[1:]


@dataclass(frozen=True)
class _Found:
    """Surface points of a field, with what gives them their colours."""

    probes: Probes
    points: Array
    normals: Array
    depth: Array
    facing: Array
    """Cosine between the normal and the way to the eye."""

    def pick(self, index: NDArray) -> "_Found":
        probes = Probes(self.probes.features[index], self.probes.harmonics[index], self.probes.network)
        return _Found(probes, self.points[index], self.normals[index], self.depth[index], self.facing[index])


def _look(field: BakedField, route: Array) -> _Found:
    width, height = _VIEW
    poses = []
    for s in np.arange(0.0, arc_lengths(route)[-1], _EYE_STEP):
        eye = point_at(route, s) + [0.0, 0.0, _EYE_HEIGHT]
        yaw, pitch = float(heading_at(route, s)), np.deg2rad(_PITCH)
        ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        poses.append(look_at(eye, eye + ahead))
    intrinsics = np.array([_FOCAL, _FOCAL, width / 2, height / 2])
    rays = unproject(pixel_grid(width, height), intrinsics)
    network = {k.removeprefix("network."): v for k, v in field._arrays.items() if k.startswith("network.")}
    parts: list[list[NDArray]] = [[] for _ in range(6)]
    for pose in poses:
        out = field.render(Viewpoints.of(pose, intrinsics, _VIEW), field.lightings[0])
        # What the render has just composited, before it became colour.
        features = field._picture(1, width, height, False).features.numpy()[0].reshape(-1, height, width)
        depth = out.depth[0].astype(np.float64)
        points = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        normals = np.cross(down, across)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        inner = points[1:-1, 1:-1]
        toward = pose[:3, 3] - inner
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
        facing = (normals * toward).sum(-1)
        around = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
        z = depth[1:-1, 1:-1]
        # At a rim the neighbours are of different things.
        whole = (np.abs(around - z) < 0.15 * z).all(0) & (out.opacity[0, 1:-1, 1:-1] > 0.97) & (facing > 0.05)
        whole &= z < _WALL_REACH
        directions = (inner - pose[:3, 3])[whole]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        for kept, value in zip(
            parts,
            (
                features[1:, 1:-1, 1:-1].transpose(1, 2, 0)[whole],
                harmonics(directions),
                inner[whole],
                normals[whole],
                z[whole],
                facing[whole],
            ),
            strict=True,
        ):
            kept.append(value)
    a, b, points, normals, depth, facing = (np.concatenate(part) for part in parts)
    return _Found(Probes(a.astype(np.float32), b.astype(np.float32), network), points, normals, depth, facing)


def harmonics(d: Array) -> Array:
    """`twin.nerf.network.spherical_harmonics` without torch: unit vectors (n, 3) → (n, 16)."""
    x, y, z = np.moveaxis(d, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    first = [np.ones_like(x), x, y, z, x * y, y * z, 3.0 * zz - 1.0, x * z, xx - yy]
    third = [y * (3.0 * xx - yy), x * y * z, y * (5.0 * zz - 1.0), z * (5.0 * zz - 3.0)]
    return np.stack([*first, *third, x * (5.0 * zz - 1.0), z * (xx - yy), x * (xx - 3.0 * yy)], -1)


def _above(points: Array, route: Array) -> tuple[Array, Array]:
    """Height over the nearest vertex of the route, and distance from it [m], both (n,)."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(route[:, :2]).query(points[:, :2])
    return points[:, 2] - route[index, 2], distance


def _some(rng: np.random.Generator, which: NDArray[np.bool_]) -> NDArray[np.int64]:
    index = np.flatnonzero(which)
    return np.sort(rng.choice(index, min(_MOST_PROBES, len(index)), replace=False))


def _balanced(pictures: list[NDArray], references: list[NDArray] | None = None) -> Array:
    """Mean over lightings of pictures (k, 3), each brought to the same mean colour (of its reference) first."""
    levels = [picture.mean(0) for picture in (references or pictures)]
    return np.mean([picture / level for picture, level in zip(pictures, levels, strict=True)], 0)


def _uniform_sky(normals: Array) -> Array:
    """Irradiance of unit normals (n, 3) under a uniform sky over ground of radiosity `_BOUNCE`, 1 facing up, (n,)."""
    up = normals[:, 2]
    return 0.5 * (1.0 + up) + 0.5 * (1.0 - up) * _BOUNCE
