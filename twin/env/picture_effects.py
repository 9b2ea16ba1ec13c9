"""Effects on rendered pictures: randomized weather, and the imperfections of a real camera.

The field itself does not change. *Weather*: directional relighting, cast shadows, and fog (sampled or fitted to a
photo); all three use the picture's depth. *Imperfections*: vibration, drifting exposure and motion blur; all are off by
default.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.env.domain_randomization import RandomizationSample
from twin.geometry.poses import inverse_pose
from twin.nerf.lightings import FOG_REACH, Fog
from twin.nerf.sun import surface_normals
from twin.types import Array, Array32

# ---- fog

_HORIZON_DISTANCE = 40.0  # [m] pixels beyond this depth have nearly the horizon's color
_MIN_HORIZON_SHARE = 0.01  # fraction of pixels that must be beyond `_HORIZON_DISTANCE` to give the horizon's color


class FogSample:
    """Fog sampled for one episode; see `nerf/lightings.py` for the model.

    The airlight has the color of the sky near the horizon in the episode's first picture.
    """

    def __init__(self, extinction: float, airlight: float = 1.0) -> None:
        """`extinction` [1/m]; `airlight` is the ratio of the fog's brightness to the horizon's."""
        self._extinction, self._gain = extinction, np.float32(airlight)
        self._fog: Fog | None = None

    def apply(self, rgb: Array32, distance: Array32) -> Array32:
        """Adds the fog to a picture (height, width, 3); `distance` is along the rays [m], shape (height, width)."""
        if self._fog is None:
            horizon = _horizon_color(rgb, np.minimum(distance, np.float32(FOG_REACH)))
            red, green, blue = np.minimum(self._gain * horizon, np.float32(1.0)).tolist()
            self._fog = Fog(self._extinction, (red, green, blue))
        return self._fog.apply(rgb, distance)


def _horizon_color(rgb: Array32, distance: Array32) -> Array32:
    """Mean color of far pixels or, if there are too few, of the upper third of the picture, shape (3,)."""
    far = distance > _HORIZON_DISTANCE
    if far.mean() < _MIN_HORIZON_SHARE:
        far = np.zeros_like(far)
        far[: max(1, len(far) // 3)] = True
    return rgb[far].mean(0)


# ---- directional relighting

RELIGHT_REACH = 40.0  # [m] depth beyond which normals are not used
_NEAR = 25.0  # [m] up to this depth, surfaces are relit by their normals alone
_WARMTH = (0.0, 0.5)  # range of the fraction by which the strength is higher in red, and lower in blue, than in green
_SKY, _TINT = 0.6, 0.15  # standard deviations of the sky's brightness and color, as fractions of the strength
_HEIGHT_RAMP = (-0.4, 0.0)  # [m] above the lens: no relighting below the first height, full relighting above the second
_SMOOTHING = 3  # [px] side of the window over which points are averaged before normals are computed


class DirectionalRelighting:
    """Brightens surfaces that face a hypothetical sun and darkens the others, for one episode.

    A surface with normal n under a sun in direction s gets the gain exp(strength · (n · s − s_z)). The strength is
    higher in red than in blue, since the light of a low sun is warm. Horizontal ground keeps its brightness. Normals
    come from the picture's depth, and are inaccurate within three pixels of an outline. Surfaces more than 0.4 m below
    the lens, including curbs, are not relit, since the ground that a radiance field renders is rough, with noisy
    normals. From there up to the height of the lens, the gain's exponent increases linearly to its full value. Far
    surfaces and the sky get another gain, which does not depend on normals: it has a random brightness and color, and
    is higher towards the sun. At depths from 25 to 40 m, the two gains are blended.
    """

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """
        Args:
            strength: For example, with 0.7 and a sun at 15° elevation, a wall that faces the sun becomes 1.6 times as
                bright, and a wall that faces away from it 0.4 times.
            sun: Unit vector towards the sun, shape (3,).
            rng: Random generator of the episode.
        """
        red_to_blue = np.array([1.0, 0.0, -1.0])
        self._sun = sun.astype(np.float32)
        self._gain = (strength * (1.0 + rng.uniform(*_WARMTH) * red_to_blue)).astype(np.float32)
        sky = rng.normal(0.0, _SKY) + rng.normal(0.0, _TINT) * red_to_blue
        self._sky_gain = (strength * sky).astype(np.float32)

    def apply(self, rgb: Array32, depth: Array32, points: Array32) -> Array32:
        """Returns the relit picture. `rgb` and `points` have shape (height, width, 3), `depth` is z-depth [m].

        `points` are surface points relative to the camera in world axes [m], no deeper than `RELIGHT_REACH`.
        """
        low, high = _HEIGHT_RAMP
        weight = np.clip((points[..., 2] - low) / (high - low), 0.0, 1.0)
        facing = weight * (surface_normals(points, _SMOOTHING) @ self._sun - self._sun[2])
        log_gain = facing[..., None] * self._gain
        far = depth > _NEAR
        share = np.minimum((depth[far] - _NEAR) / (RELIGHT_REACH - _NEAR), 1.0)[:, None]
        ahead = points[far] @ self._sun / np.sqrt(np.einsum("...i,...i", points[far], points[far]))
        log_gain[far] += share * (self._sky_gain + ahead[:, None] * (0.5 * self._gain) - log_gain[far])
        return rgb * np.exp(log_gain)


# ---- cast shadows

_SIDE = 256  # side of a pattern in texels; patterns are periodic
_TEXEL = 0.1  # [m] side of a texel, measured across the sun's direction
_PATCH_RADIUS = (0.4, 2.0)  # [m] smallest and largest radius of patches
_LEAF_RADIUS = 0.15  # [m] radius of the spots in dappled patches
_PATCH_COVER = (0.2, 0.6)  # smallest and largest fraction of the plane that patches darken
# Ranges of counts (without the upper end), and of sizes [m] before a low sun stretches the pattern.
_HOUSES, _HOUSE_SIDE = (1, 4), (3.0, 12.0)
_POSTS, _POST_WIDTH, _POST_LENGTH = (0, 8), (0.1, 0.5), (2.0, 10.0)
_OVERSAMPLING = 4  # resolution factor at which shadows of houses and posts are drawn, for smooth edges
_SHADOW_TINT = np.array([1.0, 0.95, 0.85], np.float32)  # RGB: blue loses less, since the sky's bluer light remains


class CastShadows:
    """Random cast shadows, fixed in the world, for one episode.

    A periodic pattern in the plane z = 0 is projected along the rays of the episode's sun onto ground, curbs and walls.
    It consists of patches, of shadows with straight edges, or of both. Patches may be dappled, like shadows of leaves.
    Shadows with straight edges are like those of houses and posts; a policy can mistake the edges for curbs and lines.
    A lower sun stretches the pattern more.
    """

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """`strength` is the fraction by which full shadow darkens a color, `sun` a unit vector towards the sun."""
        flat = np.linalg.norm(sun[:2])
        along = sun[:2] / flat
        self._slant = sun[:2] / sun[2]
        stretch = max(1.0, flat / sun[2])
        self._to_texel = np.stack([along / stretch, [-along[1], along[0]]]) / _TEXEL
        self._loss: Array32 = np.float32(strength) * _SHADOW_TINT
        kind = rng.integers(3)  # 0: patches, 1: straight edges, 2: both
        self._pattern = np.zeros((_SIDE, _SIDE), np.float32)
        if kind != 1:
            radius = np.exp(rng.uniform(*np.log(_PATCH_RADIUS)))
            self._pattern = _patches(rng, radius / _TEXEL, rng.uniform(*_PATCH_COVER))
            if rng.random() < 0.5:
                self._pattern = self._pattern * _patches(rng, _LEAF_RADIUS / _TEXEL, 0.6)
        if kind != 0:
            self._pattern = np.maximum(self._pattern, _solid_shadows(rng))

    def apply(self, rgb: Array32, depth: Array32, points: Array) -> Array32:
        """Returns the picture with shadows. Arguments as in `DirectionalRelighting.apply`, but world points."""
        flat = points[..., :2] - points[..., 2:] * self._slant
        across, down = np.moveaxis(flat @ self._to_texel.T % _SIDE, -1, 0).astype(np.float32)
        dark = cv2.remap(self._pattern, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
        dark[depth >= RELIGHT_REACH] = 0.0
        return rgb * (np.float32(1.0) - dark[..., None] * self._loss)


def _solid_shadows(rng: np.random.Generator) -> Array32:
    """Pattern (side, side) of the shadows of houses and posts, 1 where it is dark.

    Houses have random angles; the shadows of posts lie along the sun's direction.
    """
    side = _SIDE * _OVERSAMPLING
    canvas = np.zeros((side, side), np.uint8)
    houses = [(rng.uniform(*_HOUSE_SIDE, 2), rng.uniform(0.0, np.pi)) for _ in range(rng.integers(*_HOUSES))]
    posts = [((rng.uniform(*_POST_LENGTH), rng.uniform(*_POST_WIDTH)), 0.0) for _ in range(rng.integers(*_POSTS))]
    for size, turn in houses + posts:
        middle = rng.uniform(0.0, side, 2)
        for x in (-side, 0, side):  # drawn nine times, so that the pattern repeats without a seam
            for y in (-side, 0, side):
                wide, high = (extent / _TEXEL * _OVERSAMPLING for extent in size)
                box = ((middle[0] + x, middle[1] + y), (wide, high), np.rad2deg(turn))
                cv2.fillConvexPoly(canvas, cv2.boxPoints(box).round().astype(np.int32), 255)
    return cv2.resize(canvas, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)


def _patches(rng: np.random.Generator, radius: float, cover: float) -> Array32:
    """Pattern (side, side) of patches of about `radius` [texels], 1 where dark; a fraction `cover` is dark."""
    # The smoothing is periodic, so that the pattern repeats without a seam.
    frequency = np.fft.fftfreq(_SIDE)[:, None] ** 2 + np.fft.rfftfreq(_SIDE) ** 2
    smooth = np.exp(-2.0 * (np.pi * radius) ** 2 * frequency)
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE))) * smooth, (_SIDE, _SIDE))
    noise /= noise.std()
    edge = 0.15  # [standard deviations of the noise] makes edges about a sixth of `radius` wide, like a penumbra
    return np.clip((noise - np.quantile(noise, 1.0 - cover)) / edge + 0.5, 0.0, 1.0).astype(np.float32)


# ---- weather of an episode

_SUN_ELEVATION = (10.0, 55.0)  # [°]
_KNOWN_ELEVATION = (5.0, 85.0)  # [°] limits for a known sun, so that its shadows have a direction and a finite length


def _within_elevations(sun: Array) -> Array:
    """The direction (3,) with its elevation limited to `_KNOWN_ELEVATION`."""
    azimuth = np.arctan2(sun[1], sun[0])
    elevation = np.clip(np.arcsin(np.clip(sun[2], -1.0, 1.0)), *np.deg2rad(_KNOWN_ELEVATION))
    return np.array([*(np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])), np.sin(elevation)])


class Weather:
    """Weather of one episode: relighting, shadows and fog, applied in this order."""

    def __init__(
        self,
        sample: RandomizationSample,
        rng: np.random.Generator,
        fog: Fog | None = None,
        known_sun: Array | None = None,
    ) -> None:
        """`known_sun` is the direction (3,) to the sun of the episode's lighting; None: a random sun."""
        self.fog = fog
        """Fog of the episode's lighting, if fitted to a photo; updated while the lighting drifts. None: no fog beyond
        the haze that the film contains."""
        elevation, azimuth = np.deg2rad(rng.uniform(*_SUN_ELEVATION)), rng.uniform(0.0, 2.0 * np.pi)
        level = np.cos(elevation)
        sun = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        if known_sun is not None:
            sun = _within_elevations(known_sun)
        # Two random streams, so that relighting is the same with and without shadows, and vice versa.
        relighting_rng, shadow_rng = rng.spawn(2)
        self._relighting = DirectionalRelighting(sample.sunlight, sun, relighting_rng) if sample.sunlight else None
        self._shadows = CastShadows(sample.shade, sun, shadow_rng) if sample.shade else None
        self._sampled_fog = FogSample(sample.extinction, sample.airlight) if sample.extinction else None

    def apply(self, rgb: Array32, depth: Array32, rays: NDArray, pose: NDArray) -> Array32:
        """Returns a picture in this weather.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
        """
        if self._relighting or self._shadows:
            around = (rays * np.minimum(depth, RELIGHT_REACH)[..., None]) @ pose[:3, :3].T
            if self._relighting:
                rgb = self._relighting.apply(rgb, depth, around.astype(np.float32))
            if self._shadows:
                rgb = self._shadows.apply(rgb, depth, around + pose[:3, 3])
        if self.fog or self._sampled_fog:
            distance = depth * np.linalg.norm(rays, axis=-1).astype(np.float32)
            for fog in (self.fog, self._sampled_fog):
                if fog:
                    rgb = fog.apply(rgb, distance)
        return rgb


# ---- imperfections of a camera

_VIBRATION_TIME = 0.05  # [s] correlation time of the vibration
_DRIFT_TIME = 5.0  # [s] correlation time of the exposure
_MAX_SHUTTER = 0.5  # the shutter is open for at most this fraction of the time between two pictures
_KNEE = 0.75  # colors above this value are compressed to at most 1


@dataclass(frozen=True)
class CameraOptions:
    """Strength of a camera's imperfections."""

    vibration: float = 0.0
    """Standard deviation of the camera's rotation about each of its axes [°]."""
    exposure: float = 0.0
    """Standard deviation of the logarithm of the exposure, which drifts over seconds."""
    shutter: float = 0.0
    """Time for which the shutter is open [s]."""
    blur_samples: int = 5
    """Number of shifted pictures that are averaged for motion blur."""


class CameraNoise:
    """Imperfections of one camera in one episode; same seed and times give the same result."""

    def __init__(self, options: CameraOptions, rng: np.random.Generator):
        self._options, self._rng = options, rng
        self._time: float | None = None
        self._tilt, self._drift = np.zeros(3), 0.0
        self._last: tuple[float, Array] | None = None

    def perturb_pose(self, camera_to_world: Array, time: float) -> Array:
        """Returns the camera's pose with vibration added, shape (4, 4), and updates the exposure for `apply`.

        `time` is the time of the episode [s]; it must not decrease between calls.
        """
        step = np.inf if self._time is None else max(time - self._time, 0.0)
        self._time = time
        # This update of an Ornstein-Uhlenbeck process is exact for any time step.
        keep = np.exp(-step / np.array([_VIBRATION_TIME, _DRIFT_TIME]))
        fresh = np.sqrt(1.0 - keep**2)
        self._tilt = keep[0] * self._tilt + fresh[0] * self._rng.normal(size=3)
        self._drift = float(keep[1] * self._drift + fresh[1] * self._rng.normal())
        if self._options.vibration == 0.0:
            return camera_to_world
        out = camera_to_world.copy()
        turn, _ = cv2.Rodrigues(np.deg2rad(self._options.vibration) * self._tilt)
        out[:3, :3] = out[:3, :3] @ turn
        return out

    def apply(self, rgb: Array32, depth: Array32, pose: Array, time: float, rays: Array, intrinsics: Array) -> Array32:
        """Returns the picture with motion blur and exposure drift.

        Args:
            rgb: Sharp picture, shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            pose: camera_to_world as `perturb_pose` returned it, shape (4, 4).
            time: Time of the episode [s].
            rays: Rays of the pixels in the camera frame, with z = 1, shape (height, width, 3).
            intrinsics: fx, fy, cx, cy [px], shape (4,).
        """
        last, self._last = self._last, (time, pose)
        if self._options.shutter > 0.0 and last is not None and time > last[0]:
            share = min(self._options.shutter / (time - last[0]), _MAX_SHUTTER)
            rgb = motion_blur(rgb, depth, pose, last[1], share, rays, intrinsics, self._options.blur_samples)
        if self._options.exposure > 0.0:
            rgb = soft_clip(rgb * np.float32(np.exp(self._options.exposure * self._drift)))
        return rgb


def motion_blur(
    rgb: Array32, depth: Array32, pose: Array, before: Array, share: float, rays: Array, intrinsics: Array, samples: int
) -> Array32:
    """Returns a picture with motion blur: the mean of copies shifted by the camera's motion while the shutter is open.

    The shutter is open during the last fraction `share` of the motion from `before` to `pose`. The world is assumed to
    be static. Shapes and units as in `CameraNoise.apply`.
    """
    to_before = inverse_pose(before) @ pose
    points = (rays * depth[..., None]) @ to_before[:3, :3].T + to_before[:3, 3]
    fx, fy, cx, cy = intrinsics
    z = np.maximum(points[..., 2], 1e-3)
    there = np.stack([fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy], -1)
    here = np.stack([fx * rays[..., 0] + cx, fy * rays[..., 1] + cy], -1)
    flow = np.where(points[..., 2:] > 0.0, there - here, 0.0)
    out = np.zeros_like(rgb)
    for back in np.linspace(0.0, share, samples):
        # In OpenCV, the center of the first pixel has the coordinate 0; here, 0.5.
        at = (here + back * flow - 0.5).astype(np.float32)
        out += cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out / np.float32(samples)


def soft_clip(rgb: Array32) -> Array32:
    """Returns colors of at most 1: values above `_KNEE` are compressed smoothly, not clipped."""
    over = np.maximum(rgb - _KNEE, 0.0)
    return np.minimum(rgb, _KNEE) + (1.0 - _KNEE) * (1.0 - np.exp(-over / (1.0 - _KNEE)))
