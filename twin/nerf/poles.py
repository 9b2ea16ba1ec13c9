"""Poles: thin upright bars, such as lamp posts, signs and bollards, found in the films.

Stereo and the density grid are too coarse for a pole of 6 cm, so a field loses it, or shows it at the depth of what is
behind it. But its shape is known: a *spot* on the ground, a radius and a height. A spot, a radius and a *band* of
heights project to an upright bar in every picture of a level camera. The films show a pole there if the bar differs
from the pixels left and right of it in each picture, and has the same color in all pictures of one film. Without a
pole, the bar shows the changing background. Colors of different films are not compared: seen from the other side, as in
a film that comes back, a pole may be darker.

The *quality* of a bar is contrast / (contrast + deviation + noise), with means over pictures. The *evidence* for a pole
is the sum over its bands, from the ground up, of quality − `_CHANCE`; the pole ends where the sum is largest. The spots
with the most evidence come first. The evidence for a spot excludes the pictures in which a pole that was already found
covers it, since beside a pole, some cameras see this pole in the spot's bars. Lastly, all pictures must agree on the
pole's place: in each picture, its bar is moved by a few pixels to where its contrast is greatest, and these bars must
stand on one spot.

Poles are found by the lowest `_JUDGED` bands. Those that reach the highest of these are followed upward in pictures
that are further away.
"""

import math
import warnings
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from twin.files import load_arrays, save_arrays
from twin.geometry.cameras import Cameras
from twin.geometry.poses import wrap_angle
from twin.nerf.buffers import parallel
from twin.nerf.dataset import DepthSupervision, TrainingPixels, join_depths, load_picture
from twin.nerf.kernels import upright as kernels
from twin.runtime import track
from twin.types import Array
from twin.warp_runtime import wp

POLES_FILE = "poles.npz"

_BESIDE = 1.2, 10.0  # [m] least and greatest distance of a spot from the path of the cameras
_DEPTHS = 1.2, 13.0  # [m] depths at which pictures are used
_FRAME_SPACING = 0.4  # [m] pictures of a film that are closer to each other add nothing
_TILE = 20.0  # [m] side of the squares that are searched one after the other
_MAX_PIXELS = 300 * 640 * 360  # largest number of pixels of the pictures around a square, to bound memory
_LEAST_WIDTH = 640  # [px] pictures are read up to this width even if those of training are smaller

_RADII = (0.02, 0.028, 0.037, 0.048, 0.062, 0.08, 0.1, 0.125, 0.16, 0.2, 0.25)  # [m]
_THIN = 8  # a pole has one of the first radii, this many; the others are for comparison
_TWICE = 3  # number of steps in the list of radii that double the radius
_BAND = 0.2  # [m] height of a band
_BANDS = tuple((0.1 + _BAND * k, 0.1 + _BAND * (k + 1)) for k in range(35))  # [m] above the ground
_JUDGED = 15  # number of the lowest bands, by which poles are found
_HIGH_DEPTHS = 6.0, 18.0  # [m] depths of the pictures used for the higher bands, which nearer pictures do not show

_COARSE_CELL = 0.05  # [m] spacing of the first search
_COARSE_RADII, _COARSE_BANDS = (0.03, 0.055, 0.1), ((0.1, 0.4), (0.4, 0.7))
_COARSE_QUALITY = 0.4
_FINE_SPANS = (0.04, 0.02)  # [m] half widths of the grids of 5 × 5 spots around a spot that refine it
_FINE_BANDS = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.7))
_FINE_QUALITY = 0.42
_LAST_STEPS = tuple(0.015 * k for k in range(-4, 5))  # [m] steps in x and y to the most evident spot
_LAST_ROUNDS = 4  # largest number of such steps; they end when the spot does not change

_NOISE = 3.0  # [gray levels]
_SPREAD = 1.5  # weight of the color's standard deviation over pictures
_MIN_PICTURES = 4  # least number of pictures of a film; those of shorter films of a lighting are combined
_MIN_ALL = 5  # least number of pictures in all
_CHANCE = 0.42  # quality of bars where there is no pole
_MIN_EVIDENCE = 0.6
_MIN_QUALITY = 0.57  # mean over a pole's bands
_MIN_SPREAD = 8.0  # [°] between the bearings from which pictures show a pole
_MAX_RATIO = 0.9  # evidence for twice the radius / evidence for the radius: a thicker thing has a larger one
_APART = 0.5  # [m] least distance between two poles

_OFFSET_WINDOW, _OFFSET_STEP = (1.0, 2.5), 0.25  # [px] search for a bar's place in a picture
_OFFSET_SCALE = 0.01  # [m] scale of the Cauchy loss of offsets
_OFFSET_CONTRAST = 40.0  # [gray levels] pictures with at least this contrast have the same weight
_MAX_OFFSET = 0.009  # [m] largest median offset of a pole
_AGREES, _MIN_AGREEING = 0.02, 0.83  # [m] offsets below the first in at least this fraction of the pictures

_POINT_SPACING = 0.04  # [m] spacing of the points of a pole that get depth supervision
_MIN_CONTRAST = 6.0  # [gray levels] least contrast of a bar in a picture that supervises depth
_LEAST_ALIKE = 3  # least number of pictures of a film that determine the bar's median color
_MAX_CHANGE = 0.7  # largest difference from the bar's median color, as a multiple of its median contrast


@dataclass(frozen=True)
class Poles:
    """n upright cylinders."""

    foot: Array
    """Point of the axis on the ground, as high as the ground under the camera's path beside it [m], shape (n, 3)."""
    radius: Array
    """Shape (n,) [m]."""
    height: Array
    """Height above the foot, at most 7.1 m; a taller pole ends there. Shape (n,) [m]."""

    def __len__(self) -> int:
        return len(self.radius)

    def save(self, folder: Path) -> None:
        save_arrays(folder / POLES_FILE, dict(vars(self)))

    @staticmethod
    def load(folder: Path) -> "Poles":
        """The saved poles of a field's folder; none if it has no such file."""
        if not (folder / POLES_FILE).exists():
            return Poles.none()
        return Poles(**load_arrays(folder / POLES_FILE))

    @staticmethod
    def none() -> "Poles":
        return Poles(np.zeros((0, 3)), np.zeros(0), np.zeros(0))

    @staticmethod
    def join(parts: "list[Poles]") -> "Poles":
        return Poles(*(np.concatenate([getattr(one, name) for one in parts]) for name in vars(parts[0])))

    def select(self, index: NDArray[np.int64]) -> "Poles":
        return Poles(*(values[index] for values in vars(self).values()))


@dataclass(frozen=True)
class _Bars:
    """Sums over the pictures of one film, see `kernels.add_bars`, each of shape (spots, radii, bands)."""

    lighting: str
    count: Array
    contrast: Array
    color: Array
    square: Array


@dataclass(frozen=True)
class _LevelPicture:
    """A picture as a level camera would have taken it."""

    turn: Array
    """Axes of the camera, see `_level`."""
    intrinsics: Array
    """fx, fy, cx, cy [px]"""
    tables: list[wp.array]
    """Summed-area tables of the colors, and of the pixels that are masked or outside."""


class _LevelPictures:
    """Level pictures of some frames, used up to a depth."""

    def __init__(self, pixels: TrainingPixels, far: float = _DEPTHS[1]) -> None:
        """Begins without pictures, see `read`; `far` is the greatest depth at which they are used [m]."""
        self._pixels, self._far = pixels, far
        self.frames: list[int] = []
        self.pictures: list[_LevelPicture] = []

    def read(self, frames: NDArray[np.int64]) -> None:
        """Changes the frames; those that are kept are not read again, and the others leave memory first."""
        known = {i: one for i, one in zip(self.frames, self.pictures, strict=True) if i in frames}
        self.frames, self.pictures = frames.tolist(), []
        new = [i for i in self.frames if i not in known]
        known |= zip(new, parallel(self._read_frame, new, "cpu"), strict=True)
        self.pictures = [known[i] for i in self.frames]
        cameras = self._pixels.cameras
        self.films, self.lightings = np.array(cameras.sources)[frames], np.array(cameras.lightings)[frames]
        self.positions = cameras.positions[frames]

    def _read_frame(self, i: int) -> _LevelPicture:
        pixels = self._pixels
        shape, pose = (int(pixels.height[i]), int(pixels.width[i])), pixels.cameras.camera_to_world[i]
        picture, intrinsics = load_picture(pixels.cameras, i, _width(pixels, i))
        height, width = picture.shape[:2]
        masked = ~pixels.unmasked[pixels.start[i] : pixels.start[i + 1]].reshape(shape)
        mask = cv2.resize(masked.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        fx, fy, cx, cy = intrinsics
        matrix, turn = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]]), _level(pose)
        homography = matrix @ (turn.T @ pose[:3, :3]) @ np.linalg.inv(matrix)
        level = cv2.warpPerspective(picture, homography, (width, height))
        hidden = cv2.warpPerspective(mask, homography, (width, height), flags=cv2.INTER_NEAREST, borderValue=1)
        tables: list[wp.array] = [wp.array(cv2.integral(one), dtype=wp.int32, device="cpu") for one in (level, hidden)]
        return _LevelPicture(turn, intrinsics, tables)

    def seen(self, k: int, feet: Array) -> tuple[NDArray[np.int64], Array]:
        """Indices of the spots (n, 3) before picture k, and their positions in its camera: right, up and ahead [m]."""
        local = (feet - self.positions[k]) @ self.pictures[k].turn * (1.0, -1.0, 1.0)
        fx, _, cx, _ = self.pictures[k].intrinsics
        ahead = (local[:, 2] > _DEPTHS[0]) & (local[:, 2] < self._far) & (np.abs(local[:, 0]) * fx < local[:, 2] * cx)
        index = np.flatnonzero(ahead)
        return index, local[index]

    def spread(self, feet: Array) -> Array:
        """Largest difference between the bearings from which pictures show spots (n, 3) [rad]; shape (n,)."""
        low, high, first = np.zeros(len(feet)), np.zeros(len(feet)), np.full(len(feet), np.nan)
        for k in range(len(self.frames)):
            index, _ = self.seen(k, feet)
            way = feet[index, :2] - self.positions[k, :2]
            bearing = np.arctan2(way[:, 1], way[:, 0])
            first[index] = np.where(np.isnan(first[index]), bearing, first[index])
            turned = wrap_angle(bearing - first[index])
            low[index], high[index] = np.minimum(low[index], turned), np.maximum(high[index], turned)
        return high - low

    def bars(
        self,
        feet: Array,
        radii: tuple[float, ...],
        bands: tuple[tuple[float, float], ...],
        found: "Poles | None" = None,
    ) -> list[_Bars]:
        """Sums per film over the pictures in which no pole `found` covers the spot."""
        shape = len(feet), len(radii), len(bands)
        halves = np.array_split(np.arange(len(feet)), 2)
        out = []
        for film in dict.fromkeys(self.films):
            chosen = np.flatnonzero(self.films == film)
            sums = [wp.zeros(shape, dtype=kind, device="cpu") for kind in (wp.float32, wp.float32, wp.vec3, wp.vec3)]
            given: list[wp.array] = [
                wp.array(np.array(radii, np.float32), dtype=wp.float32, device="cpu"),
                wp.array(np.array(bands, np.float32), dtype=wp.vec2, device="cpu"),
            ]

            def add(half: int, chosen: NDArray = chosen, sums: list = sums, given: list = given) -> None:
                for k in chosen:
                    index, local = self.seen(k, feet[halves[half]])
                    if found is not None and len(found) and len(index):
                        free = ~self._covered(k, local, max(radii[:_THIN]), found)
                        index, local = index[free], local[free]
                    if not len(index):
                        continue
                    spots: wp.array = wp.array(local.astype(np.float32), dtype=wp.vec3, device="cpu")
                    rows: wp.array = wp.array(halves[half][index].astype(np.int32), dtype=wp.int32, device="cpu")
                    lens = wp.vec4(*map(float, self.pictures[k].intrinsics))
                    inputs = [*self.pictures[k].tables, lens, spots, rows, *given]
                    wp.launch(kernels.add_bars, len(index), inputs, sums, device="cpu")

            parallel(add, range(2), "cpu")
            out.append(_Bars(str(self.lightings[chosen[0]]), *(values.numpy() for values in sums)))
        return out

    def offsets(self, foot: Array, radius: float, bands: tuple[tuple[float, float], ...], found: Poles) -> Array:
        """Measures how far to the right of a spot (3,) the pictures show the bar's greatest contrast.

        Returns a row for each picture in which no pole `found` covers the spot: its axis to the right (x, y), the
        offset [m], and the contrast [gray levels]; shape (n, 4).
        """
        out = []
        for k, picture in enumerate(self.pictures):
            sums, hidden = picture.tables
            index, local = self.seen(k, foot[None])
            if not len(index) or (len(found) and self._covered(k, local, radius, found)[0]):
                continue
            (x, y, z), table, (fx, fy, cx, cy) = local[0], sums.numpy(), picture.intrinsics
            half = radius * fx / z
            middle, side = fx * x / z + cx, max(1.0, 0.5 * half)
            most = int(np.clip(0.6 * half, *_OFFSET_WINDOW) / _OFFSET_STEP)
            steps = _OFFSET_STEP * np.arange(-most, most + 1)
            bottom, top = np.rint(cy - fy * (y + np.array(bands).T) / z).astype(int)
            corners = middle + np.array([-half - side, -half, half, half + side])[:, None] + steps
            first, last = math.floor(corners.min()), math.floor(corners.max()) + 1
            shown = (top >= 0) & (bottom < len(table)) & (bottom - top >= kernels.LEAST_ROWS)
            if half < kernels.LEAST_HALF_WIDTH or first < 0 or last >= table.shape[1] or not shown.any():
                continue
            masked = np.diff(hidden.numpy()[np.stack([top, bottom])[:, shown]][..., [first, last]], axis=2)[..., 0]
            size = (last - first) * (bottom - top)[shown]
            shown[shown] = masked[1] - masked[0] <= kernels.MOST_HIDDEN * size
            if not shown.any():
                continue
            columns = np.subtract(*table[np.stack([bottom, top])[:, shown], first : last + 1].astype(float))
            means = columns / (bottom - top)[shown, None, None]  # sums over the columns left of a corner
            at = interp1d(np.arange(first, last + 1), means, axis=1)(corners)
            left, inside, right = (
                (at[:, i + 1] - at[:, i]) / width for i, width in enumerate((side, 2.0 * half, side))
            )
            contrast = np.minimum(*(np.abs(inside - beside).max(-1) for beside in (left, right))).mean(0)
            best = int(contrast.argmax())
            out.append((*picture.turn[:2, 0], steps[best] * z / fx, contrast[best]))
        return np.array(out).reshape(-1, 4)

    def _covered(self, k: int, local: Array, radius: float, found: "Poles") -> NDArray[np.bool_]:
        """True for the spots whose bars touch a found pole in picture k."""
        index, pole = self.seen(k, found.foot)
        if not len(index):
            return np.zeros(len(local), bool)
        apart = np.abs(local[:, :1] / local[:, 2:] - pole[:, 0] / pole[:, 2])
        touching = apart < (radius + found.radius[index]) / np.minimum(local[:, 2:], pole[:, 2])
        return np.asarray(touching.any(1))


def find_poles(pixels: TrainingPixels, camera_height: float) -> Poles:
    """Finds the poles up to 10 m beside the path of the cameras; `camera_height` [m] is that of the lens.

    Masked pixels are not used.
    """
    positions, kept = pixels.cameras.positions, _spaced_frames(pixels)
    path = cKDTree(positions[:, :2])
    steps = np.array(list(product((-1.0, 0.0, 1.0), repeat=2))) * _BESIDE[1]
    tiles = np.unique(np.floor((positions[:, None, :2] + steps).reshape(-1, 2) / _TILE).astype(int), axis=0)
    poles, evidence, pictures = Poles.none(), np.zeros(0), _LevelPictures(pixels)
    for corner in track(tiles * _TILE, "poles", unit="square"):
        spots = _spots(corner, path, positions[:, 2] - camera_height)
        beyond = np.maximum(np.abs(positions[kept, :2] - corner - 0.5 * _TILE) - 0.5 * _TILE, 0.0)
        frames = _at_most(kept, np.linalg.norm(beyond, axis=1) < _DEPTHS[1], pixels)
        if len(spots) and len(frames) >= _MIN_ALL:
            pictures.read(frames)
            more, sums = _search(pictures, spots, poles)
            poles, evidence = Poles.join([poles, more]), np.append(evidence, sums)
    del pictures  # those of `_extended` take their memory
    return _extended(pixels, kept, poles.select(_peaks(poles.foot[:, :2], evidence, 0.0, _APART)))


def _extended(pixels: TrainingPixels, kept: NDArray[np.int64], poles: Poles) -> Poles:
    """Poles that reach the highest band by which they were found, continued upward as far as pictures show them."""
    tall, height = poles.height > _BANDS[_JUDGED - 1][0], poles.height.copy()
    pictures = _LevelPictures(pixels, _HIGH_DEPTHS[1])
    for i in np.flatnonzero(tall):
        away = np.linalg.norm(pixels.cameras.positions[kept, :2] - poles.foot[i, :2], axis=1)
        frames = _at_most(kept, (away > _HIGH_DEPTHS[0]) & (away < _HIGH_DEPTHS[1]), pixels)
        if len(frames) < _MIN_ALL:
            continue
        pictures.read(frames)
        others = poles.select(np.flatnonzero(tall & (np.arange(len(poles)) != i)))  # lower ones hide nothing there
        thin = int(np.abs(np.array(_RADII) - poles.radius[i]).argmin())
        bars = pictures.bars(poles.foot[i : i + 1], (_RADII[thin], _RADII[thin + _TWICE]), _BANDS[_JUDGED:], others)
        quality, count = (one[0] for one in _quality(bars))
        sums, thicker = np.cumsum(np.where(count >= _MIN_ALL, quality - _CHANCE, 0.0), 1)
        top = int(sums.argmax())
        good = sums[top] / (top + 1) + _CHANCE >= _MIN_QUALITY and thicker[top] <= _MAX_RATIO * sums[top]
        if good and sums[top] > 0.0:
            height[i] = _BANDS[_JUDGED + top][1]
    return Poles(poles.foot, poles.radius, height)


def pole_depths(pixels: TrainingPixels, poles: Poles) -> DepthSupervision:
    """Depth supervision on the fronts of poles in the pictures that show their bars in the usual color."""
    tops = [round((height - _BANDS[0][0]) / _BAND) for height in poles.height]
    views: list[list[_View]] = [[] for _ in tops]
    pictures = _LevelPictures(pixels, _HIGH_DEPTHS[1])
    for i, position in enumerate(pixels.cameras.positions):
        away = np.linalg.norm(poles.foot[:, :2] - position[:2], axis=1)
        near = np.flatnonzero(away < np.where(np.array(tops) > _JUDGED, _HIGH_DEPTHS[1], _DEPTHS[1]))
        if len(near):
            pictures.read(np.array([i]))
            (bars,) = pictures.bars(poles.foot[near], tuple(map(float, poles.radius[near])), _BANDS)
            rows = np.arange(len(near))
            count, contrast, color = (one[rows, rows] for one in (bars.count, bars.contrast, bars.color))
            for row, pole in enumerate(near):
                top = tops[pole]
                shown = (count[row, :top] > 0) & ((away[pole] < _DEPTHS[1]) | (np.arange(top) >= _JUDGED))
                view = _View(i, shown, contrast[row, :top], color[row, :top])
                if view.shown.any():
                    views[pole].append(view)
    parts = []
    for foot, radius, seen in zip(poles.foot, poles.radius, views, strict=True):
        for one, usual in zip(seen, _usual(seen, pixels.cameras), strict=True):
            toward = pixels.cameras.positions[one.frame, :2] - foot[:2]
            front = foot[:2] + toward / np.linalg.norm(toward) * radius
            bands = np.array(_BANDS[: len(usual)])[usual]
            if len(bands):
                z = np.concatenate([foot[2] + np.arange(low, high, _POINT_SPACING) for low, high in bands])
                parts.append(pixels.depths_in_frame(one.frame, np.column_stack([np.tile(front, (len(z), 1)), z])))
    return join_depths(parts)


@dataclass(frozen=True)
class _View:
    """The bars of a pole in one picture."""

    frame: int
    shown: NDArray[np.bool_]
    """False for bands that are not judged in this picture, shape (bands,)."""
    contrast: Array
    """Shape (bands,)."""
    color: Array
    """Shape (bands, 3)."""


def _usual(views: list[_View], cameras: Cameras) -> list[NDArray[np.bool_]]:
    """Masks (bands,): the bands that show a pole in its usual color.

    This is the median of the picture's film or, in bands that the film shows too seldom, of its lighting.
    """
    films, lightings = (
        {name: _medians([one for one in views if names[one.frame] == name]) for name in dict.fromkeys(names)}
        for names in (cameras.sources, cameras.lightings)
    )
    out = []
    for one in views:
        count, color, contrast = films[cameras.sources[one.frame]]
        _, all_color, all_contrast = lightings[cameras.lightings[one.frame]]
        enough = count >= _LEAST_ALIKE
        color, contrast = np.where(enough[:, None], color, all_color), np.where(enough, contrast, all_contrast)
        same = np.abs(one.color - color).max(-1) <= _MAX_CHANGE * contrast
        out.append(one.shown & (one.contrast > _MIN_CONTRAST) & same)
    return out


def _medians(views: list[_View]) -> tuple[Array, Array, Array]:
    """Number of views of each band, and medians of their colors and contrasts; empty without views."""
    if not views:
        return np.zeros(0), np.zeros((0, 3)), np.zeros(0)
    judged = np.stack([np.where(one.shown, 1.0, np.nan) for one in views])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a band that no picture shows has no median
        color = np.nanmedian(np.stack([one.color for one in views]) * judged[..., None], 0)
        contrast = np.nanmedian(np.stack([one.contrast for one in views]) * judged, 0)
    return (~np.isnan(judged)).sum(0), color, contrast


def _level(pose: Array) -> Array:
    """Axes (right, down, ahead) of the level camera that looks where a camera looks, as columns, shape (3, 3)."""
    ahead = np.array([pose[0, 2], pose[1, 2], 0.0])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    down = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(down, ahead), down, ahead], 1)


def _spaced_frames(pixels: TrainingPixels) -> NDArray[np.int64]:
    """Frames that are at least `_FRAME_SPACING` from the previous one of their film."""
    last: dict[str, Array] = {}
    kept = []
    for i, source in enumerate(pixels.cameras.sources):
        position = pixels.cameras.positions[i]
        if source not in last or np.linalg.norm(position - last[source]) >= _FRAME_SPACING:
            last[source] = position
            kept.append(i)
    return np.array(kept, np.int64)


def _at_most(kept: NDArray[np.int64], near: NDArray[np.bool_], pixels: TrainingPixels) -> NDArray[np.int64]:
    """The near ones of the kept frames; every second, third … of them if they had more than `_MAX_PIXELS`."""
    frames = kept[near]
    size = sum(_width(pixels, i) ** 2 * pixels.height[i] / pixels.width[i] for i in frames)
    stride = max(1, math.ceil(size / _MAX_PIXELS))
    return kept[near & (np.arange(len(kept)) % stride == 0)]


def _width(pixels: TrainingPixels, i: int) -> int:
    """Largest side [px] of frame i's picture in the search."""
    return max(_LEAST_WIDTH, int(pixels.width[i]), int(pixels.height[i]))


def _spots(corner: Array, path: cKDTree, floor: Array) -> Array:
    """Spots (n, 3) [m] of the first search in the square at a corner (2,), as high as `floor` at the nearest camera."""
    steps = np.arange(0.5 * _COARSE_CELL, _TILE, _COARSE_CELL)
    xy = corner + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    distance, nearest = path.query(xy, distance_upper_bound=_BESIDE[1])
    near = np.isfinite(distance) & (distance > _BESIDE[0])
    return np.column_stack([xy[near], floor[nearest[near]]])


def _search(pictures: _LevelPictures, spots: Array, known: Poles) -> tuple[Poles, Array]:
    """The poles among spots (n, 3), most evident first, and their evidence; without those that are known already."""
    quality = _quality(pictures.bars(spots, _COARSE_RADII, _COARSE_BANDS))[0].min(2).max(1)
    feet = spots[_peaks(spots[:, :2], quality, _COARSE_QUALITY, 2.0 * _COARSE_CELL)]
    score = np.zeros(len(feet))
    for span in _FINE_SPANS:
        steps = np.linspace(-span, span, 5)
        offsets = np.array([(x, y, 0.0) for x, y in product(steps, steps)])
        around = (feet[:, None] + offsets).reshape(-1, 3)
        quality = _quality(pictures.bars(around, _RADII, _FINE_BANDS))[0].min(2).max(1).reshape(-1, len(offsets))
        feet, score = feet + offsets[quality.argmax(1)], quality.max(1)
    feet = feet[_peaks(feet[:, :2], score, _FINE_QUALITY, 2.0 * _COARSE_CELL)]
    feet = feet[pictures.spread(feet) > np.deg2rad(_MIN_SPREAD)]
    found, evidence = known, np.zeros(0)
    offsets = np.array([(x, y, 0.0) for x, y in product(_LAST_STEPS, _LAST_STEPS)])
    rejected = np.zeros((0, 3))
    sums = _judge(pictures, feet, found)[1]
    while len(feet):
        best = int(sums.argmax())
        if sums[best] < _MIN_EVIDENCE:
            break
        spot = feet[best]
        for _ in range(_LAST_ROUNDS):
            around, scores = _judge(pictures, spot + offsets, found)
            most = int(scores.argmax())
            spot, moved = around.foot[most], bool(np.abs(offsets[most]).max() >= max(_LAST_STEPS))
            if not moved:
                break
        near, again = _within(spot, found.foot, _APART), _within(spot, rejected, 2.0 * _COARSE_CELL)
        accepted = not near and not again and _agree(pictures, around.select(np.array([most])), found)
        # A rejected spot may be the edge of something beside a pole.
        cleared = _APART if accepted or near else 2.0 * _COARSE_CELL
        keep = np.linalg.norm(feet[:, :2] - spot[:2], axis=1) > cleared
        keep[best] = False
        feet, sums = feet[keep & (sums > 0.0)], sums[keep & (sums > 0.0)]
        if accepted:
            found, evidence = Poles.join([found, around.select(np.array([most]))]), np.append(evidence, scores[most])
            sums = _judge(pictures, feet, found)[1]
        else:
            rejected = np.vstack([rejected, spot])
    return found.select(np.arange(len(known), len(found))), evidence


def _within(spot: Array, others: Array, distance: float) -> bool:
    """True if one of the other spots (n, 3) is nearer than a distance [m]."""
    return bool((np.linalg.norm(others[:, :2] - spot[:2], axis=1) < distance).any())


def _judge(pictures: _LevelPictures, feet: Array, found: Poles) -> tuple[Poles, Array]:
    """The best pole at each spot, and the evidence for it; 0 if its bars are poor or a thicker thing stands there."""
    quality, count = _quality(pictures.bars(feet, _RADII, _BANDS[:_JUDGED], found))
    sums = np.cumsum(np.where(count >= _MIN_ALL, quality - _CHANCE, 0.0), 2)
    rows = np.arange(len(feet))
    radius = sums[:, :_THIN].max(2).argmax(1)
    top = sums[rows, radius].argmax(1)
    evidence, thicker = sums[rows, radius, top], sums[rows, radius + _TWICE, top]
    poles = Poles(feet, np.array(_RADII)[radius], np.array(_BANDS)[top, 1])
    poor = evidence / (top + 1) + _CHANCE < _MIN_QUALITY
    return poles, np.where(poor | (thicker > _MAX_RATIO * evidence), 0.0, evidence)


def _agree(pictures: _LevelPictures, pole: Poles, found: Poles) -> bool:
    """True if the pictures show the bar at one place, which may be beside the given one.

    A bar that consists of different things in different pictures has good contrast at different places.
    """
    bands = tuple(band for band in _BANDS if band[1] <= pole.height[0] + 0.5 * _BAND)
    rows = pictures.offsets(pole.foot[0], float(pole.radius[0]), bands, found)
    if len(rows) < _MIN_ALL:
        return False
    right, offset, weight = rows[:, :2], rows[:, 2], np.minimum(rows[:, 3] / _OFFSET_CONTRAST, 1.0)
    place = least_squares(
        lambda shift: weight * (offset - right @ shift), np.zeros(2), loss="cauchy", f_scale=_OFFSET_SCALE
    ).x
    left = np.abs(offset - right @ place)
    return bool(np.median(left) <= _MAX_OFFSET and (left < _AGREES).mean() >= _MIN_AGREEING)


def _quality(bars: list[_Bars]) -> tuple[Array, Array]:
    """Quality of bars and number of pictures, shape (spots, radii, bands): means over films by their pictures.

    Films with too few pictures count as one film per lighting. In this, colors deviate from the mean of their own film,
    which its first picture determines; so of all these films but one, one picture does not count.
    """
    total, weights = np.zeros(bars[0].count.shape), np.zeros(bars[0].count.shape)

    def add(count: Array, contrast: Array, squares: Array) -> None:
        nonlocal total, weights
        deviation = np.sqrt(np.maximum(squares, 0.0).max(-1) / np.maximum(count, 1.0))
        weight = np.where(count >= _MIN_PICTURES, count, 0.0)
        total = total + weight * contrast / (contrast + _SPREAD * deviation + _NOISE)
        weights = weights + weight

    for lighting in dict.fromkeys(one.lighting for one in bars):
        short: list[Array] = [np.zeros(1)] * 4
        for one in (one for one in bars if one.lighting == lighting):
            squares = one.square - one.color**2 / np.maximum(one.count, 1.0)[..., None]
            add(one.count, one.contrast / np.maximum(one.count, 1.0), squares)
            few = (one.count > 0) & (one.count < _MIN_PICTURES)
            parts = (1.0 * few, few * one.count, few * one.contrast, few[..., None] * squares)
            short = [a + b for a, b in zip(short, parts, strict=True)]
        films, count, contrast, squares = short
        add(count - np.maximum(films - 1, 0), contrast / np.maximum(count, 1.0), squares)
    return total / np.maximum(weights, 1.0), weights


def _peaks(points: Array, score: Array, least: float, radius: float) -> NDArray[np.int64]:
    """Indices of points (n, 2) that score at least `least`, best first; none within `radius` [m] of a better one."""
    index = np.flatnonzero(score >= least)
    index = index[np.argsort(-score[index], kind="stable")]
    if not len(index):
        return index
    tree, taken, out = cKDTree(points[index]), np.zeros(len(index), bool), []
    for k in range(len(index)):
        if not taken[k]:
            out.append(index[k])
            taken[tree.query_ball_point(points[index[k]], radius)] = True
    return np.array(out, np.int64)
