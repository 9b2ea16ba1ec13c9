"""What light falls on things in a radiance field, estimated from the field itself.

A field knows colours, not light. *Irradiance* here is what a colour of 1 (perfect white, facing some way) would look
like in the film of a lighting: an obstacle's own colour times the irradiance is what it looks like there. That of what
faces up at a place is its *level*: the colour of the reconstructed ground around it, over the albedo taken for it.

How much reaches what faces elsewhere is learnt from *probes*, points of the field that stand and face all ways. Each is
compared with itself under the mean of the filmed lightings, which cancels its albedo; that mean is taken for a uniform
sky over a dim ground. Per direction of `SIDES` one share of the light grows with the level of the place, as that of the
lamp or sun that lights the ground, too, and one does not, as that of the sky does.

Of the probes the composited features are kept, so that any embedding gives them colours in a millisecond.
"""

import threading
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.mjcf.world import arc_lengths, heading_at, point_at
from twin.nerf.appearance_prior import Probes
from twin.nerf.baked import BakedField
from twin.types import Array

GROUND_ALBEDO = 0.37
"""Reflectance assumed for the ground along the route, in film colours: worn asphalt reflects about 11 %, which the tone
curve of a film (exponent 1 / 2.2) shows as 0.37. The value was tuned on the known-truth world: it was 0.38 (12 %), and
became 0.37 when obstacles at night missed their bar of `benchmarks/overlay.py` (6 dB better than unshaded), which they
meet with it. So that benchmark's figures are not independent of it."""

SIDES = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
"""Directions that light comes from besides above and everywhere, shape (4, 3)."""

_EYE_HEIGHT, _PITCH = 1.0, 8.0  # [m], [°] of the views that probes are taken from
_EYE_STEP = 2.0  # [m] of the route
_VIEW, _FOCAL = (96, 54), 50.0  # [px]; nearly 90° wide
_GROUND_REACH, _REACH = 7.0, 12.0  # [m] depth up to which probes are taken
_GROUND_SKIN = 0.12  # [m] from the ground
_STANDING = 0.3  # [m] above the ground from where on a probe is none of it
_MOST_GROUND, _MOST_STANDING = 3000, 1500  # probes
_NEAR = 1.5  # [m] standard deviation of the ground's weights around a place
_BOUNCE = 0.25  # radiosity of the ground over that of the sky, in the mean of the filmed lightings
_POLE = 0.5 * (1.0 + _BOUNCE)
_MOST_SUN, _LOWEST_SUN = 0.8, 3.0  # share of one direction at most; cotangent of its elevation at most
_DARK = 0.02  # a probe whose mean colour is below tells nothing
_MOST = 1.5  # times the ground's brightest: what seems brighter shines by itself
_NEIGHBOURS = 8  # of the ground's probes, around one that stands
_FEW = 50  # probes of a kind are none
_KEPT, _PLACES_KEPT = 64, 1000  # lightings; places of one


@dataclass(frozen=True)
class Irradiance:
    """One lighting's light."""

    xy: Array
    """Places of the ground's probes [m], shape (k, 2)."""
    up: Array
    """Irradiance of what faces up there, shape (k, 3)."""
    steady: Array
    """What reaches all that does not face up, and what comes from each of `SIDES`, whatever the level, shape (5, 3)."""
    growing: Array
    """The same per unit of the level, shape (5, 3)."""
    _known: dict[tuple[float, float], Array] = field(default_factory=dict, repr=False, compare=False)
    """Levels of the last places asked for, as most things stand still."""

    def level(self, xy: Array) -> Array:
        """Irradiance of what faces up at places (n, 2) [m], shape (n, 3)."""
        return np.stack([self._level_at(x, y) for x, y in np.asarray(xy).tolist()])

    def _level_at(self, x: float, y: float) -> Array:
        found = self._known.get((x, y))
        if found is None:
            distance2 = (self.xy[:, 0] - x) ** 2 + (self.xy[:, 1] - y) ** 2
            # Where no probe is near, the nearest ones count.
            weight = np.exp(-0.5 * distance2 / _NEAR**2) + 1e-6 / (1.0 + distance2**2)
            found = weight @ self.up / weight.sum()
            if len(self._known) >= _PLACES_KEPT:
                self._known.clear()
            self._known[x, y] = found
        return found

    def irradiance(self, level: Array, normals: Array) -> Array:
        """Of unit normals (n, 3) where the level is (n, 3), shape (n, 3)."""
        basis = _basis(normals)
        up = np.maximum(normals[:, 2:], 0.0)
        return up * level + basis @ self.steady + (basis @ self.growing) * level

    def sun(self, xy: Array) -> tuple[float, Array]:
        """Share of the light at a place (2,) that comes from one direction, and that direction, shape (3,).

        Around a vertical pole a uniform sky gives `_POLE` of what faces up, and a sun at elevation e gives cot e / π;
        only the sun favours one side, by cot e. So both its share and e follow from the light on upright surfaces.
        """
        level = self.level(np.asarray(xy)[None])[0]
        parts = (self.steady + self.growing * level).mean(1) / max(float(level.mean()), 1e-6)
        favour = np.array([parts[1] - parts[2], parts[3] - parts[4]])
        strength = float(np.linalg.norm(favour))
        around = float(parts[0] + parts[1:].sum() / np.pi)
        share = float(np.clip((_POLE + strength / np.pi - around) / _POLE, 0.0, _MOST_SUN))
        cotangent = min(strength / max(share, 1e-3), _LOWEST_SUN)
        toward = np.append(favour / max(strength, 1e-9) * cotangent, 1.0)
        return share, toward / np.linalg.norm(toward)


def _basis(normals: Array) -> Array:
    """How much normals (n, 3) do not face up, and the cosines to `SIDES`, shape (n, 5)."""
    return np.column_stack([1.0 - np.maximum(normals[:, 2], 0.0), np.maximum(normals @ SIDES.T, 0.0)])


class IrradianceEstimator:
    """Estimates the light of any lighting of a field."""

    def __init__(self, baked: BakedField, route: Array):
        """
        Args:
            baked: The field; looked at from along the route, once.
            route: On the ground [m], shape (m, 3).

        Raises:
            InputError: no ground is seen there.
        """
        self._field = baked
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, Irradiance] = OrderedDict()
        found = _look(baked, route)
        height, lateral = _above(found.points, route)
        flat = found.normals[:, 2] > 0.9
        ground = (np.abs(height) < _GROUND_SKIN + 0.05 * np.abs(lateral)) & (found.depth < _GROUND_REACH) & flat
        standing = (height > _STANDING) & (found.facing > 0.25)
        rng = np.random.default_rng(0)
        self._ground = found.pick(_some(rng, ground, _MOST_GROUND))
        self._standing = found.pick(_some(rng, standing, _MOST_STANDING))
        if len(self._ground.points) < _FEW:
            raise InputError(
                "no ground is seen along the route, and so nothing to tell the light from; was the field built with "
                "this scene? Overlay(..., shaded=False) does without"
            )
        self._xy = self._ground.points[:, :2]
        self._beside = _nearest_of(self._xy, self._standing.points[:, :2])
        names = baked.lightings
        grounds = [self._ground.probes.picture(baked.embedding(name)).astype(np.float64) for name in names]
        standings = [self._standing.probes.picture(baked.embedding(name)).astype(np.float64) for name in names]
        # Lightings are brought to one brightness of the ground before their mean is taken.
        mean_ground = np.mean([picture / picture.mean(0) for picture in grounds], 0)
        self._mean = np.mean([p / ground.mean(0) for p, ground in zip(standings, grounds, strict=True)], 0)
        # What the mean lighting's irradiance is there, over albedo.
        sky = _uniform_sky(self._standing.normals)[:, None]
        self._reference = sky * mean_ground[self._beside].mean(1) / GROUND_ALBEDO
        self._rows = _basis(self._standing.normals)

    def under(self, lighting: str | NDArray) -> Irradiance:
        """The light of a lighting, by name or embedding (dim,)."""
        embedding = self._field.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        key = embedding.tobytes()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._estimate(embedding)
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            return self._kept[key]

    def _estimate(self, embedding: NDArray) -> Irradiance:
        from scipy.optimize import nnls

        up = self._ground.probes.picture(embedding).astype(np.float64) / GROUND_ALBEDO
        level = up[self._beside].mean(1)
        colours = self._standing.probes.picture(embedding).astype(np.float64)
        seen = colours / np.maximum(self._mean, _DARK) * self._reference
        over = seen - np.maximum(self._standing.normals[:, 2:], 0.0) * level
        if len(self._rows) < _FEW:  # nothing stands here to tell by: a uniform sky
            return Irradiance(
                self._xy, up, np.zeros((5, 3)), np.array([_POLE, 0.0, 0.0, 0.0, 0.0])[:, None] * np.ones(3)
            )
        found = np.empty((10, 3))
        for c in range(3):
            usable = (self._mean[:, c] > _DARK) & (seen[:, c] < _MOST * up[:, c].max())
            rows = np.concatenate([self._rows, self._rows * level[:, c : c + 1]], 1)[usable]
            # The same minimum as that of all rows, from their normal equations.
            square = np.linalg.cholesky(rows.T @ rows + 1e-6 * len(rows) * np.eye(10))
            found[:, c], _ = nnls(square.T, np.linalg.solve(square, rows.T @ over[usable, c]))
        return Irradiance(self._xy, up, found[:5], found[5:])


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
        eye = point_at(route, s) + np.array([0.0, 0.0, _EYE_HEIGHT])
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
        whole &= z < _REACH
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


def _some(rng: np.random.Generator, which: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    index = np.flatnonzero(which)
    return np.sort(rng.choice(index, min(most, len(index)), replace=False))


def _nearest_of(places: Array, xy: Array) -> NDArray[np.int64]:
    """Indices of the places (k, 2) nearest to points (n, 2), shape (n, `_NEIGHBOURS`)."""
    from scipy.spatial import cKDTree

    _, index = cKDTree(places).query(xy, min(_NEIGHBOURS, len(places)))
    return index.reshape(len(xy), -1)


def _uniform_sky(normals: Array) -> Array:
    """Irradiance of unit normals (n, 3) under a uniform sky over ground of radiosity `_BOUNCE`, 1 facing up, (n,)."""
    up = normals[:, 2]
    return 0.5 * (1.0 + up) + 0.5 * (1.0 - up) * _BOUNCE
