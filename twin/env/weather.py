"""What the weather of an episode lays over its pictures: another sun's light on what stands (`weather.py`), that sun's
shadows (`weather.py`), and then the air: that of the episode's own light, where a photo told it (`nerf/fog.py`), and what
was drawn besides (`weather.py`)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.env.domain_randomization import RandomizationSample
from twin.nerf.fog import REACH, Fog
from twin.types import Array, Array32

# ---- Air that is drawn for an episode, over what a photo told of it if one did: see `nerf/fog.py` for what it does.
#
# The airlight has the colour that the sky has near the horizon in the episode's own light, as its first picture shows it.


_FAR = 40.0  # [m] what is farther has nearly the horizon's colour
_FEW = 0.01  # share of a picture that must be so far for its colour to count


class FogSample:
    """The air of one episode."""

    def __init__(self, extinction: float, airlight: float = 1.0) -> None:
        """
        Args:
            extinction: [1/m].
            airlight: Its brightness as a share of the horizon's.
        """
        self._extinction, self._gain = extinction, np.float32(airlight)
        self._air: Fog | None = None

    def over(self, rgb: Array32, distance: Array32) -> Array32:
        """A picture as seen through the air; an episode's first one tells the airlight.

        Args:
            rgb: Shape (height, width, 3).
            distance: Along the pixels' rays [m], shape (height, width).
        """
        if self._air is None:
            horizon = _horizon(rgb, np.minimum(distance, np.float32(REACH)))
            red, green, blue = np.minimum(self._gain * horizon, np.float32(1.0)).tolist()
            self._air = Fog(self._extinction, (red, green, blue))
        return self._air.over(rgb, distance)


def _horizon(rgb: Array32, distance: Array32) -> Array32:
    """Colour of what is far, shape (3,); of the upper third, where too little is."""
    far = distance > _FAR
    if far.mean() < _FEW:
        far = np.zeros_like(far)
        far[: max(1, len(far) // 3)] = True
    return rgb[far].mean(0)


# ---- What another sun does to a place that was filmed under its own: what faces it is lighter than what turns away.
#
# The ground is what all else is compared with, and keeps its light. A surface of normal n under a sun in direction s gets
# a gain of exp(strength · (n · s − s_z)), more of it in red than in blue, as the light of a low sun is warm. Normals come
# from the picture's own depth; beside an outline, within three pixels, they are the outline's. What is lower than 0.4 m
# below the lens keeps its light, kerbs too, as a field's ground is rough; what is higher than the lens gets all of it.
# What is far, and the sky itself, get one light of another brightness and colour, more of it towards the sun; between 25
# and 40 m the one passes into the other.


RELIGHT_REACH = 40.0  # [m] of depth beyond which no normals are told
_NEAR = 25.0  # [m] of depth up to which nothing is far
_WARM = (0.0, 0.5)  # share of the gain by which red has more, and blue less, than green
_SKY, _TINT = 0.6, 0.15  # standard deviations of the sky's brightness and colour, as shares of the strength
_STANDS = (-0.4, 0.0)  # [m] above the lens: up to the first nothing is lit otherwise, from the second on all of it
_SMOOTH = 3  # [px] a side, over which points are averaged before normals are taken


class DirectionalRelighting:
    """The light on what stands, in one episode."""

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """
        Args:
            strength: Of 0.7 makes a front that faces a sun 15° high 1.6 times as light, one that turns away 0.4 times.
            sun: Direction towards it, a unit vector, shape (3,).
            rng: Of the episode.
        """
        red_to_blue = np.array([1.0, 0.0, -1.0])
        self._sun = sun.astype(np.float32)
        self._gain = (strength * (1.0 + rng.uniform(*_WARM) * red_to_blue)).astype(np.float32)
        sky = rng.normal(0.0, _SKY) + rng.normal(0.0, _TINT) * red_to_blue
        self._sky = (strength * sky).astype(np.float32)

    def over(self, rgb: Array32, depth: Array32, points: Array32) -> Array32:
        """A picture under this sun.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            points: What is seen, relative to the camera in world axes [m], no farther than REACH in depth; shape
                (height, width, 3).
        """
        low, high = _STANDS
        stands = np.clip((points[..., 2] - low) / (high - low), 0.0, 1.0)
        facing = stands * (_normals(points) @ self._sun - self._sun[2])
        light = facing[..., None] * self._gain
        far = depth > _NEAR
        share = np.minimum((depth[far] - _NEAR) / (RELIGHT_REACH - _NEAR), 1.0)[:, None]
        ahead = points[far] @ self._sun / np.sqrt(np.einsum("...i,...i", points[far], points[far]))
        light[far] += share * (self._sky + ahead[:, None] * (0.5 * self._gain) - light[far])
        return rgb * np.exp(light)


def _normals(points: Array32) -> Array32:
    """Unit normals of the surface through points around the camera, towards it, shape (height, width, 3)."""
    smooth = cv2.blur(points, (_SMOOTH, _SMOOTH), borderType=cv2.BORDER_REPLICATE)
    down, across = np.gradient(smooth, axis=(0, 1))
    normal = np.cross(down, across)
    squares, towards = (np.einsum("...i,...i", normal, other) for other in (normal, smooth))
    return normal * (-np.sign(towards) / np.sqrt(np.maximum(squares, 1e-18)))[..., None]


# ---- Shadows that the film did not have, such as another sun throws: dark patches that lie in the place and stay there.
#
# What throws them is not there. A *pattern* of light and dark, drawn for an episode, fills the plane z = 0 and is carried
# through space along the rays of the episode's sun, so that ground, kerbs and walls are crossed by it as by a shadow. It
# is made of *patches*, some of them broken up as those of leaves are, of *solids* with straight edges as houses and posts
# throw them, which look like kerbs and lines to who has never seen any, or of both. The lower the sun, the longer they
# are.


_SIDE = 256  # texels of a pattern, which repeats itself
_TEXEL = 0.1  # [m] across the sun's direction
_BLOBS = (0.4, 2.0)  # [m] smallest and largest radius of patches
_LEAVES = 0.15  # [m] of the holes in broken ones
_COVER = (0.2, 0.6)  # share of the plane in the dark of patches
_HOUSES, _HOUSE = (1, 4), (3.0, 12.0)  # how many, below the second; [m] their sides, before the sun stretches them
_POSTS, _POST, _POST_LENGTH = (0, 8), (0.1, 0.5), (2.0, 10.0)  # how many; [m] width and length
_FINER = 4  # times, what solids are drawn at so that their edges are smooth
_SHADE_SKY = np.array([1.0, 0.95, 0.85], np.float32)  # what is left in a shadow is the sky's light, which is bluer


class CastShadows:
    """The shadows of one episode."""

    def __init__(self, strength: float, sun: Array, rng: np.random.Generator) -> None:
        """
        Args:
            strength: Share of a colour that is lost in full shadow.
            sun: Direction towards it, a unit vector, shape (3,).
            rng: Of the episode.
        """
        flat = np.linalg.norm(sun[:2])
        along = sun[:2] / flat
        self._slant = sun[:2] / sun[2]
        long = max(1.0, flat / sun[2])
        self._to_texel = np.stack([along / long, [-along[1], along[0]]]) / _TEXEL
        self._loss: Array32 = np.float32(strength) * _SHADE_SKY
        kind = rng.integers(3)  # patches, solids, both
        self._pattern = np.zeros((_SIDE, _SIDE), np.float32)
        if kind != 1:
            radius = np.exp(rng.uniform(*np.log(_BLOBS)))
            self._pattern = _patches(rng, radius / _TEXEL, rng.uniform(*_COVER))
            if rng.random() < 0.5:
                self._pattern = self._pattern * _patches(rng, _LEAVES / _TEXEL, 0.6)
        if kind != 0:
            self._pattern = np.maximum(self._pattern, _solids(rng))

    def over(self, rgb: Array32, depth: Array32, points: Array) -> Array32:
        """A picture with the shadows in it.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            points: What is seen, in the world [m], no farther than REACH in depth; shape (height, width, 3).
        """
        flat = points[..., :2] - points[..., 2:] * self._slant
        across, down = np.moveaxis(flat @ self._to_texel.T % _SIDE, -1, 0).astype(np.float32)
        dark = cv2.remap(self._pattern, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
        dark[depth >= RELIGHT_REACH] = 0.0
        return rgb * (np.float32(1.0) - dark[..., None] * self._loss)


def _solids(rng: np.random.Generator) -> Array32:
    """A pattern, 1 in the dark, of houses turned anyhow and of posts along the sun's direction; shape (side, side)."""
    side = _SIDE * _FINER
    canvas = np.zeros((side, side), np.uint8)
    houses = [(rng.uniform(*_HOUSE, 2), rng.uniform(0.0, np.pi)) for _ in range(rng.integers(*_HOUSES))]
    posts = [((rng.uniform(*_POST_LENGTH), rng.uniform(*_POST)), 0.0) for _ in range(rng.integers(*_POSTS))]
    for size, turn in houses + posts:
        middle = rng.uniform(0.0, side, 2)
        for x in (-side, 0, side):  # it repeats itself without a seam
            for y in (-side, 0, side):
                wide, high = (extent / _TEXEL * _FINER for extent in size)
                box = ((middle[0] + x, middle[1] + y), (wide, high), np.rad2deg(turn))
                cv2.fillConvexPoly(canvas, cv2.boxPoints(box).round().astype(np.int32), 255)
    return cv2.resize(canvas, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)


def _patches(rng: np.random.Generator, radius: float, cover: float) -> Array32:
    """A pattern, 1 in the dark, of patches of about a radius [texels] that cover a share of it; shape (side, side)."""
    # Smoothed as on a torus, so that it repeats itself without a seam.
    frequency = np.fft.fftfreq(_SIDE)[:, None] ** 2 + np.fft.rfftfreq(_SIDE) ** 2
    smooth = np.exp(-2.0 * (np.pi * radius) ** 2 * frequency)
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE))) * smooth, (_SIDE, _SIDE))
    noise /= noise.std()
    # An edge as wide as a third of the patch's radius is as soft as a tree's at some metres.
    edge = 0.15
    return np.clip((noise - np.quantile(noise, 1.0 - cover)) / edge + 0.5, 0.0, 1.0).astype(np.float32)


_ELEVATION = (10.0, 55.0)  # [°] of the sun


class Weather:
    """The weather of one episode."""

    def __init__(self, draw: RandomizationSample, rng: np.random.Generator, air: Fog | None = None) -> None:
        """
        Args:
            draw: Of the episode.
            rng: Of its sun, light and shadows.
            air: See `air`.
        """
        self.air = air
        """Of the episode's light as it is now, where a photo told it; clear or None: nothing of its own."""
        elevation, azimuth = np.deg2rad(rng.uniform(*_ELEVATION)), rng.uniform(0.0, 2.0 * np.pi)
        level = np.cos(elevation)
        sun = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        # Each draws from a sequence of its own, so that neither changes with whether there is the other.
        sides, shade = rng.spawn(2)
        self._sides = DirectionalRelighting(draw.sunlight, sun, sides) if draw.sunlight else None
        self._shade = CastShadows(draw.shade, sun, shade) if draw.shade else None
        self._haze = FogSample(draw.extinction, draw.airlight) if draw.extinction else None

    def over(self, rgb: Array32, depth: Array32, rays: NDArray, pose: NDArray) -> Array32:
        """A picture in this weather.

        Args:
            rgb: Shape (height, width, 3).
            depth: z-depth [m], shape (height, width).
            rays: Of the pixels, in the camera, with z = 1, shape (height, width, 3).
            pose: camera_to_world, OpenCV axes, shape (4, 4).
        """
        if self._sides or self._shade:
            around = (rays * np.minimum(depth, RELIGHT_REACH)[..., None]) @ pose[:3, :3].T
            if self._sides:
                rgb = self._sides.over(rgb, depth, around.astype(np.float32))
            if self._shade:
                rgb = self._shade.over(rgb, depth, around + pose[:3, 3])
        if self.air or self._haze:
            distance = depth * np.linalg.norm(rays, axis=-1).astype(np.float32)
            airs: list[Fog | FogSample] = [one for one in (self.air, self._haze) if one]
            for one in airs:
                rgb = one.over(rgb, distance)
        return rgb
