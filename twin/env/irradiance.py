"""Light on objects in a radiance field: irradiance, estimated from the field for any lighting, and contact shadows.

A field stores colors, not light. *Irradiance* is the color that a perfectly white surface with a given normal would
have in a film under a lighting. An object's color in the picture is its own color times the irradiance. The irradiance
of a horizontal surface is called *ground irradiance*. It is estimated as the color of the reconstructed ground nearby,
divided by an assumed albedo.

The irradiance for other normals is fitted to *upright probes*: points of the field on surfaces that rise above the
ground. A probe's color is divided by its mean color over the field's lightings, which cancels its albedo. The mean
lighting is assumed to be a uniform sky over dim ground. The light from each direction of `SIDE_DIRECTIONS` has two
parts: one is proportional to the local ground irradiance, like light from the sun or a lamp; the other is the same
everywhere, like light from the sky.

The estimator stores the probes' composited features. From these, the color network computes the probes' colors under
any embedding in a millisecond.
"""

import threading
from collections import OrderedDict
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.env.obstacles import PREFIX
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints, pixel_grid, unproject
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.geometry.poses import look_at
from twin.nerf.baked import BakedField
from twin.nerf.kernels.color_head import harmonics_of
from twin.nerf.lightings import Probes
from twin.nerf.sun import Sunlight, main_sun
from twin.types import Array

GROUND_ALBEDO = 0.37
"""Assumed color of the ground along the route under irradiance 1: worn asphalt reflects about 11 % of the light, which
the tone curve of a film (exponent 1 / 2.2) shows as 0.37. With 0.38 (12 %), obstacles at night failed the test of
`benchmarks/overlay.py` (PSNR 6 dB above unshaded obstacles). So this test chose the value and does not confirm it."""

SIDE_DIRECTIONS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
"""Horizontal directions for which the incoming light is estimated, shape (4, 3)."""

_CAMERA_HEIGHT, _CAMERA_PITCH = 1.0, 8.0  # [m], [°] height and downward pitch of the views from which probes are taken
_CAMERA_STEP = 2.0  # [m] distance along the route between two views, or more if there would be more than `_MAX_VIEWS`
_MAX_VIEWS = 100
_BEYOND = 10.0  # [m] on a long route, views are also taken up to this far before and after the driven segment
_VIEW_SIZE, _FOCAL = (96, 54), 50.0  # [px]; nearly 90° wide
_MAX_GROUND_DEPTH, _MAX_DEPTH = 7.0, 12.0  # [m] largest z-depth of ground probes and of all probes
_GROUND_TOLERANCE = 0.12  # [m] largest height difference of ground probes from the route, plus 5 % of their distance
_MIN_UPRIGHT_HEIGHT = 0.3  # [m] only probes more than this above the route's height count as upright
_MAX_GROUND_PROBES, _MAX_UPRIGHT_PROBES = 3000, 1500
_KERNEL_STD = 1.5  # [m] standard deviation of the Gaussian weights of ground probes around a position
_BOUNCE = 0.25  # assumed ratio of the ground's radiance to the sky's in the mean of the field's lightings
_UPRIGHT_SKY = 0.5 * (1.0 + _BOUNCE)  # irradiance of upright surfaces under the uniform sky that gives level ground 1
_MAX_SUN_SHARE, _MAX_SUN_COTANGENT = 0.8, 3.0  # upper limits of the sun's share of the light and of cot(elevation)
_MIN_COLOR = 0.02  # a probe whose mean color is darker is not used
_MAX_BRIGHTNESS = 1.5  # probes above this multiple of the highest ground irradiance count as lamps and are not used
_NEIGHBORS = 8  # number of ground probes that give the ground irradiance at an upright probe
_MIN_PROBES = 50  # fewer ground probes are an error; with fewer upright probes, a uniform sky is assumed
_LIGHTINGS_CACHED, _POSITIONS_CACHED = 64, 1000


@dataclass(frozen=True)
class Irradiance:
    """Irradiance under one lighting, as a function of position and normal."""

    xy: Array
    """Positions of the ground probes [m], shape (k, 2)."""
    up: Array
    """Ground irradiance at these positions, shape (k, 3)."""
    constant: Array
    """The light's part that is the same everywhere, shape (5, 3): undirected, then from each of `SIDE_DIRECTIONS`."""
    proportional: Array
    """The part that is proportional to the ground irradiance, divided by it, shape (5, 3); rows as in `constant`."""
    known_sun: Array | None = None
    """Direction to the sun, shape (3,), if the lighting has one; None: `sun` estimates it."""
    sun_share: Array | None = None
    """The known sun's share of the ground irradiance at `xy`, shape (k,)."""
    _cache: dict[tuple[float, float], Array] = field(default_factory=dict, repr=False, compare=False)
    """Ground irradiance by position. Most objects stand still, so positions recur."""

    def ground(self, xy: Array) -> Array:
        """Ground irradiance at positions (n, 2) [m], shape (n, 3)."""
        return np.stack([self._ground_at(x, y) for x, y in np.asarray(xy).tolist()])

    def _ground_at(self, x: float, y: float) -> Array:
        found = self._cache.get((x, y))
        if found is None:
            distance2 = (self.xy[:, 0] - x) ** 2 + (self.xy[:, 1] - y) ** 2
            # Far from all probes, the second term selects the nearest ones.
            weight = np.exp(-0.5 * distance2 / _KERNEL_STD**2) + 1e-6 / (1.0 + distance2**2)
            found = weight @ self.up / weight.sum()
            if len(self._cache) >= _POSITIONS_CACHED:
                self._cache.clear()
            self._cache[x, y] = found
        return found

    def irradiance(self, ground: Array, normals: Array) -> Array:
        """Irradiance, shape (n, 3), for unit normals (n, 3) at places with the ground irradiance `ground` (n, 3)."""
        basis = _basis(normals)
        up = np.maximum(normals[:, 2:], 0.0)
        return up * ground + basis @ self.constant + (basis @ self.proportional) * ground

    def sun(self, xy: Array) -> tuple[float, Array]:
        """The sun's share of the ground irradiance at a position (2,), and the direction to the sun, shape (3,).

        Sky and sun both contribute to the ground irradiance and to the irradiance of upright surfaces. Averaged over
        all azimuths, an upright surface gets `_UPRIGHT_SKY` times what the ground gets from the sky, and cot e / π
        times what the ground gets from a sun at elevation e. Only the sun lights one side more than the opposite side:
        by cot e times what the ground gets from it. So the light on upright surfaces gives both the sun's share and e.
        """
        if self.known_sun is not None and self.sun_share is not None:
            nearest = int(((self.xy - xy) ** 2).sum(1).argmin())
            return float(np.clip(self.sun_share[nearest], 0.0, _MAX_SUN_SHARE)), self.known_sun
        ground = self.ground(np.asarray(xy)[None])[0]
        parts = (self.constant + self.proportional * ground).mean(1) / max(float(ground.mean()), 1e-6)
        difference = np.array([parts[1] - parts[2], parts[3] - parts[4]])
        strength = float(np.linalg.norm(difference))
        around = float(parts[0] + parts[1:].sum() / np.pi)
        share = float(np.clip((_UPRIGHT_SKY + strength / np.pi - around) / _UPRIGHT_SKY, 0.0, _MAX_SUN_SHARE))
        cotangent = min(strength / max(share, 1e-3), _MAX_SUN_COTANGENT)
        toward = np.append(difference / max(strength, 1e-9) * cotangent, 1.0)
        return share, toward / np.linalg.norm(toward)


def _basis(normals: Array) -> Array:
    """Weights, shape (n, 5), of the rows of `Irradiance.constant` for normals (n, 3).

    For a normal n, the first weight is 1 − max(0, n_z); the others are max(0, n · d) for each d of `SIDE_DIRECTIONS`.
    """
    return np.column_stack([1.0 - np.maximum(normals[:, 2], 0.0), np.maximum(normals @ SIDE_DIRECTIONS.T, 0.0)])


class IrradianceEstimator:
    """Estimates the irradiance of any lighting of a field."""

    def __init__(self, baked: BakedField, route: Array, between: tuple[float, float] = (0.0, np.inf)):
        """Renders views of the field along a route on the ground, shape (m, 3) [m].

        A route of more than 200 m is too long for views of all of it. Then views are taken between two arc lengths [m],
        about where the robot drives.

        Raises InputError: no ground is seen.
        """
        from scipy.spatial import cKDTree  # slow to import, and a first picture needs no irradiance

        self._field = baked
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[bytes, Sunlight], Irradiance] = OrderedDict()
        points = _surface_points(baked, route, view_stations(float(arc_lengths(route)[-1]), *between))
        lateral, vertex = cKDTree(route[:, :2]).query(points.positions[:, :2])
        height = points.positions[:, 2] - route[vertex, 2]
        flat = points.normals[:, 2] > 0.9
        ground = (np.abs(height) < _GROUND_TOLERANCE + 0.05 * np.abs(lateral)) & (points.depth < _MAX_GROUND_DEPTH)
        upright = (height > _MIN_UPRIGHT_HEIGHT) & (points.facing > 0.25)
        rng = np.random.default_rng(0)
        self._ground = points.subset(_random_indices(rng, ground & flat, _MAX_GROUND_PROBES))
        self._upright = points.subset(_random_indices(rng, upright, _MAX_UPRIGHT_PROBES))
        if len(self._ground.positions) < _MIN_PROBES:
            raise InputError(
                "no ground is seen along the route, so the irradiance cannot be estimated; was the field built with "
                "this scene? Compositor(..., shaded=False) needs no irradiance"
            )
        self._xy = self._ground.positions[:, :2]
        count = min(_NEIGHBORS, len(self._xy))
        nearest = np.arange(1, count + 1)  # as an array, so that the result has two axes if there is one
        self._neighbors = cKDTree(self._xy).query(self._upright.positions[:, :2], nearest)[1]
        names = baked.lightings_by_name.filmed().names  # added lightings change no other one
        grounds = [self._ground.probes.picture(baked.embedding(name)).astype(np.float64) for name in names]
        uprights = [self._upright.probes.picture(baked.embedding(name)).astype(np.float64) for name in names]
        # Lightings are scaled to the same brightness of the ground before their mean is taken.
        mean_ground = np.mean([colors / colors.mean(0) for colors in grounds], 0)
        self._mean = np.mean([c / ground.mean(0) for c, ground in zip(uprights, grounds, strict=True)], 0)
        # Irradiance of the mean lighting, a uniform sky over dim ground, at the upright probes.
        tilt = self._upright.normals[:, 2:]
        sky = 0.5 * (1.0 + tilt) + 0.5 * (1.0 - tilt) * _BOUNCE
        self._reference = sky * mean_ground[self._neighbors].mean(1) / GROUND_ALBEDO
        self._rows = _basis(self._upright.normals)

    def estimate(self, lighting: str | NDArray, sunlight: Sunlight = ()) -> Irradiance:
        """The irradiance of a lighting, by name or embedding (dim,), and its suns. Recent estimates are cached."""
        embedding = self._field.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        key = embedding.tobytes(), sunlight
        with self._lock:
            if key not in self._cache:
                self._cache[key] = self._estimate(embedding, sunlight)
                if len(self._cache) > _LIGHTINGS_CACHED:
                    self._cache.popitem(last=False)
            return self._cache[key]

    def _estimate(self, embedding: NDArray, sunlight: Sunlight) -> Irradiance:
        from scipy.optimize import nnls

        up = self._ground.probes.picture(embedding).astype(np.float64) / GROUND_ALBEDO
        colors = self._upright.probes.picture(embedding).astype(np.float64)
        known: tuple[Array, Array] | tuple[()] = ()
        if sunlight:
            level = np.tile([0.0, 0.0, 1.0], (len(up), 1))
            up_gain, share = _gains(sunlight, self._ground.positions, level)
            up, sun = up * up_gain, main_sun(sunlight)
            colors = colors * _gains(sunlight, self._upright.positions, self._upright.normals)[0]
            known = (sun.toward, share) if sun else ()
        ground = up[self._neighbors].mean(1)
        seen = colors / np.maximum(self._mean, _MIN_COLOR) * self._reference
        sides = seen - np.maximum(self._upright.normals[:, 2:], 0.0) * ground
        if len(self._rows) < _MIN_PROBES:  # assume a uniform sky
            proportional = np.zeros((5, 3))
            proportional[0] = _UPRIGHT_SKY
            return Irradiance(self._xy, up, np.zeros((5, 3)), proportional, *known)
        found = np.empty((10, 3))
        for c in range(3):
            usable = (self._mean[:, c] > _MIN_COLOR) & (seen[:, c] < _MAX_BRIGHTNESS * up[:, c].max())
            rows = np.concatenate([self._rows, self._rows * ground[:, c : c + 1]], 1)[usable]
            # For speed, the Cholesky factor of the normal equations replaces the rows; the minimum stays the same.
            square = np.linalg.cholesky(rows.T @ rows + 1e-6 * len(rows) * np.eye(10))
            found[:, c], _ = nnls(square.T, np.linalg.solve(square, rows.T @ sides[usable, c]))
        return Irradiance(self._xy, up, found[:5], found[5:], *known)


def _gains(sunlight: Sunlight, points: Array, normals: Array) -> tuple[Array, Array]:
    """Gain of suns (n, 3) at points (n, 3) [m] with normals (n, 3), and the direct light's fraction of it (n,)."""
    gain = np.full((len(points), 3), 1.0 - sum(weight for _, weight in sunlight))
    direct = np.zeros(len(points))
    for sun, weight in sunlight:
        one, share = sun.gain(points, normals)
        gain += weight * one
        direct += weight * one.mean(1) * share
    return gain, direct / gain.mean(1)


@dataclass(frozen=True)
class _SurfacePoints:
    """n surface points of a field with their probes."""

    probes: Probes
    positions: Array
    """[m], shape (n, 3)."""
    normals: Array
    """Shape (n, 3)."""
    depth: Array
    """z-depth in the view that shows the point [m], shape (n,)."""
    facing: Array
    """Cosine between the normal and the direction to the camera, shape (n,)."""

    def subset(self, index: NDArray) -> "_SurfacePoints":
        probes = Probes(self.probes.features[index], self.probes.harmonics[index], self.probes.network)
        return _SurfacePoints(probes, self.positions[index], self.normals[index], self.depth[index], self.facing[index])


def view_stations(length: float, low: float, high: float) -> Array:
    """Arc lengths [m] of the views along a route of a length [m], at most `_MAX_VIEWS`.

    They are from `low` to `high` [m] and a little beyond, or all along the route if it is not too long.
    """
    stations = np.arange(0.0, length, _CAMERA_STEP)
    if len(stations) > _MAX_VIEWS:
        stations = stations[(stations >= low - _BEYOND) & (stations <= high + _BEYOND)]
    return stations[:: max(1, -(-len(stations) // _MAX_VIEWS))]


def _surface_points(field: BakedField, route: Array, stations: Array) -> _SurfacePoints:
    """Surface points that are visible in views from stations of the route; pixels at depth edges are left out."""
    width, height = _VIEW_SIZE
    intrinsics = np.array([_FOCAL, _FOCAL, width / 2, height / 2])
    rays = unproject(pixel_grid(width, height), intrinsics)
    found = []
    for s in stations:
        eye = point_at(route, s) + np.array([0.0, 0.0, _CAMERA_HEIGHT])
        yaw, pitch = float(heading_at(route, s)), np.deg2rad(_CAMERA_PITCH)
        ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        pose = look_at(eye, eye + ahead)
        out, channels = field.render_features(Viewpoints.of(pose, intrinsics, _VIEW_SIZE), field.lightings[0])
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
        # At a depth edge, neighboring pixels belong to another surface.
        valid = (np.abs(around - z) < 0.15 * z).all(0) & (out.opacity[0, 1:-1, 1:-1] > 0.97) & (facing > 0.05)
        valid &= z < _MAX_DEPTH
        directions = (inner - pose[:3, 3])[valid]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        features = channels[0, 1:, 1:-1, 1:-1].transpose(1, 2, 0)[valid]
        harmonics = spherical_harmonics_numpy(directions)
        found.append((features, harmonics, inner[valid], normals[valid], z[valid], facing[valid]))
    features, harmonics, points, normals, depth, facing = map(np.concatenate, zip(*found, strict=True))
    probes = Probes(features.astype(np.float32), harmonics.astype(np.float32), field.network)
    return _SurfacePoints(probes, points, normals, depth, facing)


def spherical_harmonics_numpy(d: Array) -> Array:
    """`twin.nerf.network.spherical_harmonics` without torch: unit vectors (n, 3) → (n, 16)."""
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([np.ones_like(x), *harmonics_of(x, y, z)], -1)


def _random_indices(rng: np.random.Generator, mask: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    index = np.flatnonzero(mask)
    return np.sort(rng.choice(index, min(most, len(index)), replace=False))


# ---- contact shadows

BOX_CORNERS = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T
"""Corners of a box around the origin, in half sides, shape (8, 3)."""

_PENUMBRA = 0.03, 0.10
"""Half width of the penumbra at an obstacle's foot (its origin on the ground) [m], and its growth per meter of distance
from the foot. They account for the size of the sun's disk and halo, and for the error of the estimated direction."""
_FILL = 0.85  # assumed fraction of its bounding boxes' length and width that an obstacle fills
_SKY_LOSS_BELOW = 0.75  # fraction of the sky's light lost below an obstacle; below 1, since it does not fill its box
_SKY_REACH = 1.2  # [m] ground within this distance of an obstacle loses part of the sky's light
_MAX_SHADOW = 4.0  # [m] largest distance of a shadow's end from the foot
_SHADOW_TOLERANCE = 0.15  # [m] surfaces at most this far above or below the foot count as ground
_MAX_DISTANCE = 25.0  # [m] shadows of obstacles farther from the camera than this are not drawn


class ContactShadows:
    """Soft shadows of a model's obstacles on the reconstructed ground.

    The light is assumed to come from a uniform sky and from one sun; `Irradiance.sun` estimates the sun's direction and
    share of the light. Ground beside an obstacle loses the light of the part of the sky that the obstacle hides. Ground
    in the obstacle's shadow also loses sunlight; the penumbra widens with the distance from the obstacle. Two upright
    boxes, one around the lower geoms and one around the upper geoms, approximate an obstacle.
    """

    def __init__(self, model: mujoco.MjModel, geoms: NDArray[np.int64]):
        """`geoms` are the drawn geoms; only those of obstacles cast shadows."""
        self._boxes: dict[int, Array] = {}
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        roots = model.body_rootid[model.geom_bodyid[geoms]]
        for body in np.unique(roots):
            if model.body(int(body)).name.startswith(PREFIX):
                self._boxes[int(body)] = _bounding_boxes(model, data, geoms[roots == body], int(body))

    @property
    def bodies(self) -> tuple[int, ...]:
        """Indices of the obstacles' bodies."""
        return tuple(self._boxes)

    def darken(
        self, rgb: NDArray, depth: NDArray, rays: Array, pose: Array, data: mujoco.MjData, irradiance: Irradiance
    ) -> None:
        """Darkens shadowed ground in a picture (height, width, 3) of the field, in place.

        Args:
            rgb: The picture.
            depth: Its z-depth [m], shape (height, width).
            rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
            data: Poses of the bodies.
            irradiance: Irradiance under the lighting.
        """
        for body, boxes in self._boxes.items():
            foot = data.xpos[body]
            away = float((foot - pose[:3, 3]) @ pose[:3, 2])
            # An obstacle beside or behind the camera may throw its shadow into the picture.
            if not abs(away) < _MAX_DISTANCE or abs(foot[2] - pose[2, 3]) > _MAX_DISTANCE:
                continue
            share, sun = irradiance.sun(foot[:2])
            size = float(np.abs(boxes[:, :, :2]).max() * np.sqrt(2.0))
            length = min(float(boxes[:, 1, 2].max() * np.linalg.norm(sun[:2]) / sun[2]), _MAX_SHADOW)
            reach = size + max(length, _SKY_REACH)
            if away < -reach:
                continue
            index = np.flatnonzero(np.abs(depth - away) < reach)
            points = (rays.reshape(-1, 3)[index] * depth.ravel()[index, None]) @ pose[:3, :3].T + (pose[:3, 3] - foot)
            on = (np.abs(points[:, 2]) < _SHADOW_TOLERANCE) & ((points[:, :2] ** 2).sum(1) < reach**2)
            if on.any():
                lost = _light_loss(boxes, points[on, :2], data.xmat[body].reshape(3, 3)[:2, :2], share, sun)
                rgb.reshape(-1, 3)[index[on]] *= (1.0 - lost)[:, None].astype(rgb.dtype)


def _light_loss(boxes: Array, points: Array, turn: Array, share: float, sun: Array) -> Array:
    """Fraction of the light that points of the ground lose, shape (n,).

    Args:
        boxes: Lowest and highest corners in the body frame, shape (2, 2, 3) [m].
        points: Points relative to the foot in world axes, shape (n, 2) [m].
        turn: Rotation of the body in the plane, shape (2, 2).
        share: The sun's share of the light.
        sun: Direction to the sun, shape (3,).
    """
    local = points @ turn
    azimuth = sun[:2] / max(float(np.linalg.norm(sun[:2])), 1e-9)
    across_sun = np.array([-azimuth[1], azimuth[0]])
    slope = float(np.linalg.norm(sun[:2])) / float(sun[2])
    behind, beside = -points @ azimuth, points @ across_sun
    spread = _PENUMBRA[0] + _PENUMBRA[1] * np.maximum(behind, 0.0)
    sunlit = np.ones(len(points))
    hidden = np.zeros(len(points))
    for low, high in boxes:
        center, half = 0.5 * (low + high)[:2], 0.5 * _FILL * (high - low)[:2]
        # Loss of the sky's light: an endless wall hides half of it (weighted by the cosine), a box hides less.
        gap = np.linalg.norm(np.maximum(np.abs(local - center) - half, 0.0), axis=1)
        wide = np.arctan2(float(half.mean()), gap) / np.pi
        gap2 = gap**2 + 1e-6
        rise = high[2] ** 2 / (high[2] ** 2 + gap2) - low[2] ** 2 / (low[2] ** 2 + gap2)
        hidden = np.maximum(hidden, np.where(gap > 0.0, wide, _SKY_LOSS_BELOW) * rise)
        # Loss of sunlight: within the box's shadow, its projection onto the ground along the sun's rays.
        middle = turn @ center
        axes = turn * half  # columns: half sides in the world
        across = float(np.abs(across_sun @ axes).sum())
        along = float(np.abs(azimuth @ axes).sum())
        start, end = low[2] * slope - along, min(high[2] * slope, _MAX_SHADOW) + along
        u, v = behind + middle @ azimuth, beside - middle @ across_sun
        shadow = _smooth_step((across - v) / spread) + _smooth_step((across + v) / spread) - 1.0
        shadow *= _smooth_step((u - start) / spread) + _smooth_step((end - u) / spread) - 1.0
        sunlit *= 1.0 - np.clip(shadow, 0.0, 1.0)
    return share * (1.0 - sunlit) + (1.0 - share) * hidden


def _smooth_step(x: Array) -> Array:
    """A smooth step from 0 to 1, nearly all of it between x = −2 and 2."""
    return 0.5 + 0.5 * np.tanh(x)


def _bounding_boxes(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.int64], body: int) -> Array:
    """Lowest and highest corners of boxes around an obstacle's lower and upper geoms, in its frame, shape (2, 2, 3)."""
    local = model.geom_aabb[geoms, None, :3] + BOX_CORNERS * model.geom_aabb[geoms, None, 3:]
    turns = data.geom_xmat[geoms].reshape(-1, 3, 3)
    world = local @ turns.transpose(0, 2, 1) + data.geom_xpos[geoms, None]
    corners = (world - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
    corners[..., 2] = np.maximum(corners[..., 2], 0.0)
    middle = corners[..., 2].mean(1)
    lower = middle <= 0.5 * corners[..., 2].max()
    boxes = [corners[part].reshape(-1, 3) for part in (lower, ~lower) if part.any()]
    return np.array([[box.min(0), box.max(0)] for box in (boxes[0], boxes[-1])])
