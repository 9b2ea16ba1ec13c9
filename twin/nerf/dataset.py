"""Training data of a field: pixels of the training frames, and depth supervision.

Depth supervision consists of image points (not rounded to pixels) with a known distance along their rays. It has three
kinds: sparse points in the frames in which they were matched, the ground under the path ahead of the camera (if the
camera height is constant), and stereo.
"""

import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.cameras import Cameras, SparsePoints, project, scaled_intrinsics
from twin.geometry.images import read_image, resize
from twin.geometry.passes import path_stations
from twin.runtime import track

_MAX_POINT_ERROR = 2.0  # [px] greatest reprojection error of a used point
_MIN_TRACK_LENGTH = 3  # least number of frames in which a used point was matched
_PATH_REACH = 12.0  # [camera heights] the path is used up to this distance ahead
_PATH_OFFSETS = (-0.5, 0.0, 0.5)  # [camera heights] lateral offsets at which the ground is assumed level with the path
_SUPERVISION = ("points", "path", "stereo")  # attributes of `TrainingPixels` with the kinds of depth supervision
_TRIPLE_SPACING = 0.02  # greatest spacing of a triple's pixels (see `batch`) [share of the image width]


@dataclass(frozen=True)
class RayBatch:
    """n rays with their colors and known distances."""

    frame: NDArray[np.int32]
    """Index into the training frames, shape (n,)."""
    pixel: NDArray[np.float32]
    """(u, v) [px], shape (n, 2)."""
    color: NDArray[np.float32]
    """In [0, 1], shape (n, 3)."""
    distance: NDArray[np.float32]
    """Distance of the surface [m], 0 = unknown, shape (n,)."""


@dataclass(frozen=True)
class DepthSupervision:
    """k known distances along rays."""

    frame: NDArray[np.int32]
    """Index into the training frames, ascending, shape (k,)."""
    pixel: NDArray[np.float64]
    """(u, v) [px], shape (k, 2)."""
    distance: NDArray[np.float32]
    """[m], shape (k,)."""

    def of_frame(self, i: int) -> slice:
        """The rows of frame i."""
        return slice(*np.searchsorted(self.frame, np.array([i, i + 1], self.frame.dtype)))

    def select(self, rows: NDArray) -> "DepthSupervision":
        """The rows with these indices or where this mask is true."""
        return DepthSupervision(self.frame[rows], self.pixel[rows], self.distance[rows])


def join_depths(parts: list[DepthSupervision]) -> DepthSupervision:
    """Joins depth supervision, in the order of the frames."""
    parts = [DepthSupervision(np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.float32)), *parts]
    joined = DepthSupervision(
        *(np.concatenate(columns) for columns in zip(*(vars(p).values() for p in parts), strict=True))
    )
    return joined.select(np.argsort(joined.frame, kind="stable"))


class TrainingPixels:
    """All training pixels in one array, and all depth supervision."""

    def __init__(self, cameras: Cameras, points: SparsePoints, max_width: int, camera_height: float = 0.0):
        """Reads the frames that are not held out, scaled so that the longer side is at most `max_width` [px].

        `camera_height` [m] is the constant height of the camera above the ground; 0 = not constant.

        Raises InputError without a training frame, or if all pixels are masked.
        """
        chosen = np.flatnonzero(~cameras.held_out)
        if not len(chosen):
            raise InputError("no frame to train on: all are held out; raise capture.held_out_every or film longer")
        self.cameras = cameras.select(chosen)
        images, masks, intrinsics = [], [], []
        for i in track(range(len(chosen)), "reading frames", unit="frame"):
            image, mask, k = load_frame(self.cameras, i, max_width)
            images.append(image)
            masks.append(mask)
            intrinsics.append(k)
        self.intrinsics = np.array(intrinsics)
        self.width = np.array([image.shape[1] for image in images])
        self.height = np.array([image.shape[0] for image in images])
        self.start = np.concatenate([[0], np.cumsum(self.width * self.height)])
        self.colors = np.concatenate([image.reshape(-1, 3) for image in images])
        unmasked = np.concatenate([mask.ravel() for mask in masks])
        if not unmasked.any():
            raise InputError("every training pixel is masked; in a mask 0 = ignore, so are the masks inverted?")
        self.unmasked = unmasked
        """True for the pixels to train on, in the order of `colors`."""
        self.frames = np.arange(len(chosen))
        """Indices of the frames from which `batch` samples, ascending; all frames unless made by `of_frames`."""
        self.points = self._depths_of_points(points, chosen)
        self.path = self._depths_of_path(camera_height) if camera_height > 0.0 else join_depths([])
        self.stereo = join_depths([])  # set from `stereo.stereo_depths`

    def exclude(self, marked: list[NDArray[np.bool_]]) -> None:
        """Excludes the pixels in `marked` (one mask per frame) and the depth supervision on them from training.

        A frame that would lose all its pixels keeps them.
        """
        parts = np.split(self.unmasked, self.start[1:-1])
        kept = [part & ~mark.ravel() for part, mark in zip(parts, marked, strict=True)]
        self.unmasked = np.concatenate([new if new.any() else old for old, new in zip(parts, kept, strict=True)])
        vars(self).pop("_index", None)
        for name in _SUPERVISION:
            pool = getattr(self, name)
            setattr(self, name, pool.select(self.is_unmasked(pool.frame, pool.pixel)))

    def of_frames(self, frames: NDArray[np.int64]) -> "TrainingPixels":
        """The same pixels and frame indices, but `batch` samples from the given frames only.

        Raises InputError if these have no pixel to train on.
        """
        if np.array_equal(frames, self.frames):
            return self
        out = copy.copy(self)
        out.frames = frames
        vars(out).pop("_index", None)
        for name in _SUPERVISION:
            pool = getattr(self, name)
            setattr(out, name, pool.select(np.isin(pool.frame, frames)))
        if not any(self.unmasked[self.start[i] : self.start[i + 1]].any() for i in frames):
            raise InputError(
                f"a section of the road has no pixel to train on: its {len(frames)} frames are held out or masked; "
                "unmask some, or set nerf.section_length = 0"
            )
        return out

    def is_unmasked(self, frame: int | NDArray, pixel: NDArray) -> NDArray:
        """Mask (k,) of the pixels (k, 2) that are used, in one frame or in frames (k,)."""
        u, v = pixel.astype(int).T
        return self.unmasked[self.start[frame] + v * self.width[frame] + u]

    def depths_in_frame(self, i: int, xyz: NDArray) -> DepthSupervision:
        """Depth supervision of frame i from points (k, 3) [m]; drops points outside the frame or on masked pixels."""
        pixel, depth = project(xyz, self.cameras.camera_to_world[i], self.intrinsics[i])
        inside = (depth > 0) & (pixel > 0.5).all(1) & (pixel < [self.width[i] - 0.5, self.height[i] - 0.5]).all(1)
        xyz, pixel = xyz[inside], pixel[inside]
        seen = self.is_unmasked(i, pixel)
        distance = np.linalg.norm(xyz[seen] - self.cameras.positions[i], axis=1)
        return DepthSupervision(np.full(seen.sum(), i, np.int32), pixel[seen], distance.astype(np.float32))

    def _depths_of_points(self, points: SparsePoints, chosen: NDArray) -> DepthSupervision:
        good = (points.error < _MAX_POINT_ERROR) & (points.track_length >= _MIN_TRACK_LENGTH)
        found = []
        for i, original in enumerate(chosen):
            seen = points.point[(points.frame == original) & good[points.point]]
            found.append(self.depths_in_frame(i, points.xyz[seen]))
        return join_depths(found)

    def _depths_of_path(self, camera_height: float) -> DepthSupervision:
        """Depth supervision from the ground under the path ahead of each frame, where the path is nearly straight."""
        found = []
        for source in dict.fromkeys(self.cameras.sources):
            frames = np.flatnonzero([s == source for s in self.cameras.sources])
            path = self.cameras.positions[frames]
            arc = path_stations(path)
            for k, i in enumerate(frames):
                s = arc[k] + np.linspace(0.5, _PATH_REACH, 40) * camera_height
                s = s[s <= arc[-1]]
                if not len(s):
                    continue
                ahead = np.stack([np.interp(s, arc, path[:, axis]) for axis in range(3)], 1)
                straight = np.linalg.norm(ahead - path[k], axis=1) > 0.97 * (s - arc[k])
                ahead = ahead[straight]
                heading = ahead - path[k]
                side = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(ahead))], 1)
                side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
                ground = ahead - [0.0, 0.0, camera_height]
                shifts = np.array(_PATH_OFFSETS) * camera_height
                found.append(self.depths_in_frame(int(i), (ground + shifts[:, None, None] * side).reshape(-1, 3)))
        return join_depths(found)

    def batch(self, rng: np.random.Generator, shards: int, triples: int, singles: int, supervised: int) -> RayBatch:
        """Samples random rays, shard after shard (a shard is a part of a batch, see `buffers.py`).

        Each shard holds, in this order: `triples` × 3 rays (a triple goes through three equally spaced pixels in a
        line), `singles` rays through random pixels, and `supervised` rays with depth, equally many of each kind.
        """
        kinds = [pool for name in _SUPERVISION if len((pool := getattr(self, name)).frame)]
        if not kinds:
            singles, supervised = singles + supervised, 0
        parts = [self._triples(rng, shards * triples), self._pixels(self._random(rng, shards * singles))]
        each = [len(part) for part in np.array_split(np.arange(supervised), max(1, len(kinds)))]
        parts += [self._supervised_rays(rng, pool, shards * n) for pool, n in zip(kinds, each, strict=False)]
        columns = [
            np.concatenate([c.reshape(shards, -1, *c.shape[1:]) for c in cs], 1) for cs in zip(*parts, strict=True)
        ]
        frame, pixel, color, distance = (c.reshape(-1, *c.shape[2:]) for c in columns)
        return RayBatch(frame.astype(np.int32), pixel.astype(np.float32), color, distance)

    def _random(self, rng: np.random.Generator, n: int) -> NDArray[np.int64]:
        """Random indices into `colors` of unmasked pixels."""
        if self._index is None:
            ends = np.cumsum(self.start[self.frames + 1] - self.start[self.frames])
            pick = rng.integers(ends[-1], size=n)
            run = np.searchsorted(ends, pick, side="right")
            return self.start[self.frames + 1][run] - ends[run] + pick
        return self._index[rng.integers(len(self._index), size=n)].astype(np.int64)

    @cached_property
    def _index(self) -> NDArray[np.integer] | None:
        """Indices of the unmasked pixels of `frames`; None if no pixel is masked."""
        if self.unmasked.all():
            return None
        kind = np.int32 if len(self.unmasked) < 2**31 else np.int64  # on a long road this is the largest array
        runs = [slice(self.start[i], self.start[i + 1]) for i in self.frames]
        return np.concatenate([(np.flatnonzero(self.unmasked[run]) + run.start).astype(kind) for run in runs])

    def _place(self, flat: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
        """Frame, row and column of indices into `colors`."""
        frame = np.searchsorted(self.start, flat, side="right") - 1
        return frame, *np.divmod(flat - self.start[frame], self.width[frame])

    def _pixels(self, flat: NDArray[np.int64]) -> tuple[NDArray, ...]:
        frame, row, column = self._place(flat)
        pixel = np.stack([column + 0.5, row + 0.5], -1)
        return frame, pixel, self.colors[flat].astype(np.float32) / 255.0, np.zeros(len(flat), np.float32)

    def _triples(self, rng: np.random.Generator, n: int) -> tuple[NDArray, ...]:
        """Triples of pixels in a line, the middle one second.

        If one of the three is masked or outside the frame, the middle one replaces both others.
        """
        middle = self._random(rng, n)
        frame, row, column = self._place(middle)
        reach = rng.uniform(1.0, np.maximum(2.0, _TRIPLE_SPACING * self.width[frame]))
        angle = rng.uniform(0.0, np.pi, n)
        dx, dy = np.rint(reach * np.cos(angle)).astype(int), np.rint(reach * np.sin(angle)).astype(int)
        w, h = self.width[frame], self.height[frame]
        inside = (column - abs(dx) >= 0) & (column + abs(dx) < w) & (row - dy >= 0) & (row + dy < h)
        shift = np.where(inside, dy * w + dx, 0)
        triple = np.stack([middle - shift, middle, middle + shift], 1)
        if self._index is not None:
            triple = np.where(self.unmasked[triple].all(1, keepdims=True), triple, middle[:, None])
        return self._pixels(triple.ravel())

    def _supervised_rays(self, rng: np.random.Generator, pool: DepthSupervision, n: int) -> tuple[NDArray, ...]:
        pick = rng.integers(len(pool.frame), size=n)
        frame, pixel = pool.frame[pick], pool.pixel[pick]
        return frame, pixel, self._interpolated(frame, pixel), pool.distance[pick]

    def _interpolated(self, frame: NDArray, pixel: NDArray) -> NDArray[np.float32]:
        """Bilinear color at pixels at least half a pixel from the border."""
        x, y = (pixel - 0.5).T
        column, row = x.astype(int), y.astype(int)
        bx, by = (x - column)[:, None], (y - row)[:, None]
        at = self.start[frame] + row * self.width[frame] + column
        right = (column + 1 < self.width[frame]).astype(int)
        below = np.where(row + 1 < self.height[frame], self.width[frame], 0)
        c = self.colors
        top = c[at] * (1 - bx) + c[at + right] * bx
        bottom = c[at + below] * (1 - bx) + c[at + below + right] * bx
        return ((top * (1 - by) + bottom * by) / 255.0).astype(np.float32)


def load_picture(cameras: Cameras, i: int, max_width: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Reads a frame's picture, scaled to at most `max_width` on its longer side, and its intrinsics [px]."""
    image = read_image(cameras.image_path(i))
    height, width = image.shape[:2]
    shrink = min(1.0, max_width / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    if (w, h) != (width, height):
        image = resize(image, w, h)
    size = (int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1]))
    return image, scaled_intrinsics(cameras.intrinsics[i], size, (w, h))


def load_frame(
    cameras: Cameras, i: int, max_width: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]]:
    """Reads a frame, scaled to at most `max_width` on its longer side: image, mask (true = use), intrinsics [px]."""
    image, intrinsics = load_picture(cameras, i, max_width)
    h, w = image.shape[:2]
    path = cameras.mask_path(i)
    mask = np.ones((h, w), bool)
    if path is not None:
        # A resized pixel is usable only if all pixels that it averages are usable.
        whole = read_image(path)[..., 0] > 0
        mask = resize(whole.astype(np.float32), w, h) > 0.999 if whole.shape != (h, w) else whole
    return image, mask, intrinsics


# ---- free space and camera height

_HEIGHT_SPREAD = 0.1  # a camera height that varies by more than this share is not constant


def free_segments(cameras: Cameras, near_plane: float) -> NDArray[np.float64]:
    """Straight segments of the camera path, shape (k, 2, 3) [m]; space closer to them than `near_plane` is empty.

    A segment of at least 3 times its film's median length is a jump between photos. It is left out, but the camera
    positions at its ends are included as segments of length 0.
    """
    pieces = [np.repeat(cameras.positions[:, None], 2, 1)] if near_plane > 0 else []
    for source in dict.fromkeys(cameras.sources):
        p = cameras.positions[np.array([s == source for s in cameras.sources])]
        if len(p) > 2 and near_plane > 0:
            length = np.linalg.norm(np.diff(p, axis=0), axis=1)
            keep = length < 3.0 * np.median(length)
            pieces.append(np.stack([p[:-1], p[1:]], 1)[keep])
    return np.concatenate(pieces) if pieces else np.zeros((0, 2, 3))


def random_free_points(
    rng: np.random.Generator, segments: NDArray[np.float64], n: int, near_plane: float
) -> NDArray[np.float64]:
    """Random points (n, 3) [m], less than `near_plane` [m] from one of the segments (k, 2, 3) [m]."""
    pick = segments[rng.integers(len(segments), size=n)]
    offset = rng.normal(size=(n, 3))
    offset *= near_plane * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(offset, axis=1)[:, None]
    return pick[:, 0] + (pick[:, 1] - pick[:, 0]) * rng.random((n, 1)) + offset


def constant_height(metric: dict[str, Any]) -> float:
    """Camera height above the ground [m] if stage `metric` found one that is reliable and constant, else 0."""
    height = metric.get("camera_height_median_m")
    spread = metric.get("local_height_spread_m", metric.get("camera_height_spread_m"))
    if (
        not height
        or metric.get("camera_height_m_of")
        or not (metric.get("road_reliable") or metric.get("scale_source") == "camera_height")
    ):
        return 0.0
    return 0.0 if spread is not None and spread > _HEIGHT_SPREAD * height else float(height)
