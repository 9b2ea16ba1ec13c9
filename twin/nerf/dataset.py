"""What a field is trained on: pixels of the training frames, and rays whose length is known.

A *sighting* is something at a known place that a training frame must see: a pixel (not rounded) and the distance along
its ray. Sparse points are sighted where they were matched; the ground under the filmed path is sighted ahead of every
camera that was carried along it at a constant height.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.cameras import Cameras, SparsePoints, project, scaled_intrinsics
from twin.geometry.images import read_image, resize
from twin.runtime import track

_MAX_POINT_ERROR = 2.0  # reprojection error of a point that is believed [px]
_MIN_TRACK = 3  # frames that must have seen it
_PATH_REACH = 12.0  # how far ahead the path is believed to be seen [camera heights]
_PATH_SIDES = (-0.5, 0.0, 0.5)  # ground taken to be level across the path, so far to its sides [camera heights]
_TRIPLE_REACH = 0.02  # greatest spacing of a triple's pixels [share of the width]


@dataclass(frozen=True)
class RayBatch:
    """n rays and what is known of them."""

    frame: NDArray[np.int32]
    """Index into the training frames, shape (n,)."""
    pixel: NDArray[np.float32]
    """(u, v) [px], shape (n, 2)."""
    colour: NDArray[np.float32]
    """In [0, 1], shape (n, 3)."""
    distance: NDArray[np.float32]
    """To what is seen there [m], 0 = unknown, shape (n,)."""


@dataclass(frozen=True)
class DepthSupervision:
    """k known distances along rays."""

    frame: NDArray[np.int32]
    """Training frame, shape (k,)."""
    pixel: NDArray[np.float64]
    """(u, v) [px], shape (k, 2)."""
    distance: NDArray[np.float32]
    """[m], shape (k,)."""


def joined(parts: list[DepthSupervision]) -> DepthSupervision:
    """All sightings in one."""
    return DepthSupervision(
        np.concatenate([np.zeros(0, np.int32), *(p.frame for p in parts)]),
        np.concatenate([np.zeros((0, 2)), *(p.pixel for p in parts)]),
        np.concatenate([np.zeros(0, np.float32), *(p.distance for p in parts)]),
    )


class TrainingPixels:
    """All training pixels in one array, and all sightings."""

    def __init__(self, cameras: Cameras, points: SparsePoints, max_width: int, camera_height: float = 0.0):
        """Reads the frames that are not held out, scaled so that the longer side is at most `max_width` [px].

        `camera_height` is that of a camera carried at constant height above the ground [m]; 0 = it was not.

        Raises:
            InputError: no frame to train on, or everything masked.
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
        self.colours = np.concatenate([image.reshape(-1, 3) for image in images])
        valid = np.concatenate([mask.ravel() for mask in masks])
        self.valid = None if valid.all() else np.flatnonzero(valid)
        if self.valid is not None and not len(self.valid):
            raise InputError("every training pixel is masked; masks are 0 = ignore, so are they inverted?")
        self.open = valid
        self.points = self._sight_points(points, chosen)
        self.path = self._sight_path(camera_height) if camera_height > 0.0 else joined([])
        self.stereo = joined([])  # see `stereo.stereo_sightings`

    def _sight(self, i: int, xyz: NDArray) -> "DepthSupervision":
        """Those of the points (k, 3) [m] that fall on open pixels of training frame i."""
        pixel, depth = project(xyz, self.cameras.camera_to_world[i], self.intrinsics[i])
        inside = (depth > 0) & (pixel > 0.5).all(1) & (pixel < [self.width[i] - 0.5, self.height[i] - 0.5]).all(1)
        xyz, pixel = xyz[inside], pixel[inside]
        u, v = pixel.astype(int).T
        seen = self.open[self.start[i] + v * self.width[i] + u]
        distance = np.linalg.norm(xyz[seen] - self.cameras.positions[i], axis=1)
        return DepthSupervision(np.full(seen.sum(), i, np.int32), pixel[seen], distance.astype(np.float32))

    def _sight_points(self, points: SparsePoints, chosen: NDArray) -> "DepthSupervision":
        good = (points.error < _MAX_POINT_ERROR) & (points.track_length >= _MIN_TRACK)
        found = []
        for i, original in enumerate(chosen):
            seen = points.point[(points.frame == original) & good[points.point]]
            found.append(self._sight(i, points.xyz[seen]))
        return joined(found)

    def _sight_path(self, camera_height: float) -> "DepthSupervision":
        """The ground under the path ahead, as far as the path runs nearly straight from each frame on.

        What the vehicle drove over afterwards is ground, at the camera's height below the path, and nothing hid it.
        """
        found = []
        for source in dict.fromkeys(self.cameras.sources):
            frames = np.flatnonzero([s == source for s in self.cameras.sources])
            path = self.cameras.positions[frames]
            arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
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
                shifts = np.array(_PATH_SIDES) * camera_height
                found.append(self._sight(int(i), (ground + shifts[:, None, None] * side).reshape(-1, 3)))
        return joined(found)

    def batch(self, rng: np.random.Generator, shards: int, triples: int, singles: int, sightings: int) -> RayBatch:
        """Random rays for so many shards, shard after shard.

        Each shard begins with `triples` × 3 rays through pixels in a line at equal spacing, then `singles` pixels,
        then `sightings`, in equal shares of sparse points, of the path and of stereo, or of those kinds there are.
        """
        kinds = [pool for pool in (self.points, self.path, self.stereo) if len(pool.frame)]
        if not kinds:
            singles, sightings = singles + sightings, 0
        parts = [self._triples(rng, shards * triples), self._pixels(self._random(rng, shards * singles))]
        each = [len(part) for part in np.array_split(np.arange(sightings), max(1, len(kinds)))]
        parts += [self._sightings(rng, pool, shards * n) for pool, n in zip(kinds, each, strict=False)]
        columns = [
            np.concatenate([c.reshape(shards, -1, *c.shape[1:]) for c in cs], 1) for cs in zip(*parts, strict=True)
        ]
        frame, pixel, colour, distance = (c.reshape(-1, *c.shape[2:]) for c in columns)
        return RayBatch(frame.astype(np.int32), pixel.astype(np.float32), colour, distance)

    def _random(self, rng: np.random.Generator, n: int) -> NDArray[np.int64]:
        """Indices of open pixels into `colours`."""
        if self.valid is None:
            return rng.integers(len(self.colours), size=n)
        return self.valid[rng.integers(len(self.valid), size=n)]

    def _pixels(self, flat: NDArray[np.int64]) -> tuple[NDArray, ...]:
        frame = np.searchsorted(self.start, flat, side="right") - 1
        row, column = np.divmod(flat - self.start[frame], self.width[frame])
        pixel = np.stack([column + 0.5, row + 0.5], -1)
        return frame, pixel, self.colours[flat].astype(np.float32) / 255.0, np.zeros(len(flat), np.float32)

    def _triples(self, rng: np.random.Generator, n: int) -> tuple[NDArray, ...]:
        """Three pixels in a line, the middle one second; where one would fall off the picture all are the middle."""
        middle = self._random(rng, n)
        frame = np.searchsorted(self.start, middle, side="right") - 1
        row, column = np.divmod(middle - self.start[frame], self.width[frame])
        reach = rng.uniform(1.0, np.maximum(2.0, _TRIPLE_REACH * self.width[frame]))
        angle = rng.uniform(0.0, np.pi, n)
        dx, dy = np.rint(reach * np.cos(angle)).astype(int), np.rint(reach * np.sin(angle)).astype(int)
        w, h = self.width[frame], self.height[frame]
        inside = (column - abs(dx) >= 0) & (column + abs(dx) < w) & (row - dy >= 0) & (row + dy < h)
        shift = np.where(inside, dy * w + dx, 0)
        triple = np.stack([middle - shift, middle, middle + shift], 1)
        if self.valid is not None:
            triple = np.where(self.open[triple].all(1, keepdims=True), triple, middle[:, None])
        return self._pixels(triple.ravel())

    def _sightings(self, rng: np.random.Generator, pool: "DepthSupervision", n: int) -> tuple[NDArray, ...]:
        pick = rng.integers(len(pool.frame), size=n)
        frame, pixel = pool.frame[pick], pool.pixel[pick]
        return frame, pixel, self._interpolated(frame, pixel), pool.distance[pick]

    def _interpolated(self, frame: NDArray, pixel: NDArray) -> NDArray[np.float32]:
        """Bilinear colour at pixels at least half a pixel from the border."""
        x, y = (pixel - 0.5).T
        column, row = x.astype(int), y.astype(int)
        bx, by = (x - column)[:, None], (y - row)[:, None]
        at = self.start[frame] + row * self.width[frame] + column
        right = (column + 1 < self.width[frame]).astype(int)
        below = np.where(row + 1 < self.height[frame], self.width[frame], 0)
        c = self.colours
        top = c[at] * (1 - bx) + c[at + right] * bx
        bottom = c[at + below] * (1 - bx) + c[at + below + right] * bx
        return ((top * (1 - by) + bottom * by) / 255.0).astype(np.float32)


def load_frame(
    cameras: Cameras, i: int, max_width: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]]:
    """A frame scaled to at most `max_width` on its longer side: image, mask (true = use), and its intrinsics [px]."""
    image = read_image(cameras.image_path(i))
    height, width = image.shape[:2]
    shrink = min(1.0, max_width / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    path = cameras.mask_path(i)
    mask = np.ones((h, w), bool)
    if path is not None:
        # Any ignored pixel spoils the mean it goes into.
        whole = read_image(path)[..., 0] > 0
        mask = resize(whole.astype(np.float32), w, h) > 0.999 if whole.shape != (h, w) else whole
    if (w, h) != (width, height):
        image = resize(image, w, h)
    size = (int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1]))
    return image, mask, scaled_intrinsics(cameras.intrinsics[i], size, (w, h))
