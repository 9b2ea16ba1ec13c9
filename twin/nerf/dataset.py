"""What a field is trained on: pixels of the training frames, and rays on which structure from motion knows the distance.

A *sighting* is a sparse point seen in a training frame: a pixel (not rounded) and the distance along its ray.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.geometry.cameras import Cameras, project, scaled_intrinsics
from twin.geometry.images import read_image, resize
from twin.geometry.points import SparsePoints
from twin.progress import track

_MAX_POINT_ERROR = 2.0  # reprojection error of a point that is believed [px]
_MIN_TRACK = 3  # frames that must have seen it


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


class TrainingPixels:
    """All training pixels in one array, and all sightings."""

    def __init__(self, cameras: Cameras, points: SparsePoints, max_width: int):
        """Reads the frames that are not held out, scaled so that the longer side is at most `max_width` [px].

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
        self._find_sightings(points, chosen, valid)

    def _find_sightings(self, points: SparsePoints, chosen: NDArray, valid: NDArray[np.bool_]) -> None:
        good = (points.error < _MAX_POINT_ERROR) & (points.track_length >= _MIN_TRACK)
        frames, pixels, distances = [], [], []
        for i, original in enumerate(chosen):
            seen = points.point[(points.frame == original) & good[points.point]]
            xyz = points.xyz[seen]
            pixel, depth = project(xyz, self.cameras.camera_to_world[i], self.intrinsics[i])
            low = np.array([0.5, 0.5])
            inside = (depth > 0) & (pixel > low).all(1) & (pixel < [self.width[i] - 0.5, self.height[i] - 0.5]).all(1)
            u, v = pixel[inside].astype(int).T
            open_ = valid[self.start[i] + v * self.width[i] + u]
            frames.append(np.full(open_.sum(), i, np.int32))
            pixels.append(pixel[inside][open_])
            distances.append(np.linalg.norm(xyz[inside][open_] - self.cameras.positions[i], axis=1))
        self.sighting_frame = np.concatenate(frames)
        self.sighting_pixel = np.concatenate(pixels).reshape(-1, 2)
        self.sighting_distance = np.concatenate(distances).astype(np.float32)

    def batch(self, rng: np.random.Generator, rays: int, sightings: int) -> RayBatch:
        """`rays` random rays, of which the last `sightings` are sightings (none where there are none)."""
        sightings = min(sightings, rays) if len(self.sighting_frame) else 0
        n = rays - sightings
        if self.valid is None:
            flat = rng.integers(len(self.colours), size=n)
        else:
            flat = self.valid[rng.integers(len(self.valid), size=n)]
        frame = np.searchsorted(self.start, flat, side="right") - 1
        row, column = np.divmod(flat - self.start[frame], self.width[frame])
        pixel = np.stack([column + 0.5, row + 0.5], -1)
        colour = self.colours[flat].astype(np.float32) / 255.0
        distance = np.zeros(n, np.float32)
        if sightings:
            pick = rng.integers(len(self.sighting_frame), size=sightings)
            f, p = self.sighting_frame[pick], self.sighting_pixel[pick]
            frame, pixel = np.concatenate([frame, f]), np.concatenate([pixel, p])
            colour = np.concatenate([colour, self._interpolated(f, p)])
            distance = np.concatenate([distance, self.sighting_distance[pick]])
        return RayBatch(frame.astype(np.int32), pixel.astype(np.float32), colour, distance)

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
