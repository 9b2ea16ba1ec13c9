"""A place made of formulas, seen through the interface of a radiance field: for tests of what follows the field.

Ground z = h(x, y) with a gentle undulation; on it boxes (upright, any heading) and posts (upright cylinders). Rays are
intersected exactly, so every surface, depth and density is known. Optional faults: depth noise, and floaters that only
some views see.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.files import write_json
from twin.geometry.cameras import Cameras, PosedCameras, SparsePoints, intrinsics_for_size, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.types import Array

FAR = 200.0  # [m] depth of the sky


class Box(NamedTuple):
    """Center (x, y), size along its own x and y, top above z = 0 [m], heading [rad]."""

    x: float
    y: float
    length: float
    width: float
    top: float
    heading: float = 0.0
    bottom: float = -1.0


class Post(NamedTuple):
    """An upright cylinder [m]."""

    x: float
    y: float
    radius: float
    top: float


class Rendering(NamedTuple):
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]


def waves(points: Array, count: int, amplitude: float) -> Array:
    """Sum of waves of 0.3 to 3 m in random directions at points (..., 3); shape (...)."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction *= (2 * np.pi / np.geomspace(0.3, 3.0, count))[:, None]
    return amplitude * np.sin(points @ direction.T + rng.uniform(0, 2 * np.pi, count)).sum(-1)


@dataclass(frozen=True)
class AnalyticField:
    """Has the interface of a RadianceField."""

    boxes: tuple[Box, ...] = ()
    posts: tuple[Post, ...] = ()
    amplitude: float = 0.05
    """Amplitude of the ground's undulation [m]."""
    slope: float = 0.0
    """Rise of the ground along x."""
    depth_noise: float = 0.0
    """Standard deviation, as a share of the depth."""
    floaters: float = 0.0
    """Share of views with a blob hanging 1.5 to 3 m before the camera."""
    bounds: Array = field(default_factory=lambda: np.array([[-20.0, -60.0, -2.0], [80.0, 20.0, 8.0]]))
    lightings: tuple[str, ...] = ("day", "night")

    def ground(self, xy: Array) -> Array:
        """True ground height [m], shape (..., 2) → (...)."""
        x, y = xy[..., 0], xy[..., 1]
        return self.slope * x + self.amplitude * (np.sin(0.35 * x + 0.2 * y) + 0.5 * np.sin(0.5 * y - 0.1 * x))

    def distance_to_obstacles(self, points: Array) -> Array:
        """Signed distance [m] to the boxes and posts, negative inside; shape (..., 3) → (...)."""
        best = np.full(points.shape[:-1], np.inf)
        for box in self.boxes:
            local = _into(points[..., :2] - [box.x, box.y], box.heading)
            middle, half = (box.top + box.bottom) / 2, (box.top - box.bottom) / 2
            q = np.stack(
                [
                    np.abs(local[..., 0]) - box.length / 2,
                    np.abs(local[..., 1]) - box.width / 2,
                    np.abs(points[..., 2] - middle) - half,
                ],
                -1,
            )
            outside = np.linalg.norm(np.maximum(q, 0.0), axis=-1)
            best = np.minimum(best, outside + np.minimum(q.max(-1), 0.0))
        for post in self.posts:
            radial = np.hypot(points[..., 0] - post.x, points[..., 1] - post.y) - post.radius
            above = points[..., 2] - post.top
            outside = np.hypot(np.maximum(radial, 0.0), np.maximum(above, 0.0))
            best = np.minimum(best, outside + np.minimum(np.maximum(radial, above), 0.0))
        return best

    def density(self, points: Array) -> NDArray[np.float32]:
        """Density: 30 per meter inside matter, otherwise 0."""
        solid = (points[:, 2] < self.ground(points[:, :2])) | (self.distance_to_obstacles(points) < 0)
        return np.where(solid, 30.0, 0.0).astype(np.float32)

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        return np.full(32, float(self.lightings.index(lighting)), np.float32)

    def render(self, cameras: PosedCameras, lighting: object, size: tuple[int, int] | None = None) -> Rendering:
        """Exact depth; the color depends on the surface that a ray hits."""
        camera_to_world = cameras.camera_to_world
        intrinsics, (width, height) = intrinsics_for_size(cameras, size)
        n = len(camera_to_world)
        rgb = np.zeros((n, height, width, 3), np.float32)
        depth = np.full((n, height, width), FAR, np.float32)
        rng = np.random.default_rng(5)
        for i in range(n):
            rays = unproject(pixel_grid(width, height), intrinsics[i]) @ camera_to_world[i, :3, :3].T
            depth[i], kind = self._cast(camera_to_world[i, :3, 3], rays)
            palette = np.array([[0.6, 0.7, 0.9], [0.35, 0.35, 0.37], [0.7, 0.4, 0.3], [0.3, 0.5, 0.3]], np.float32)
            rgb[i] = palette[kind]
            if self.depth_noise:
                depth[i] *= 1 + self.depth_noise * rng.standard_normal(depth[i].shape)
            if rng.random() < self.floaters:
                u, v = rng.integers(width // 2), rng.integers(height // 4, height // 2)
                depth[i, v : v + height // 6, u : u + width // 6] = rng.uniform(1.5, 3.0)
        return Rendering(rgb, depth, (depth < FAR * 0.9).astype(np.float32))

    def _cast(self, origin: Array, rays: Array) -> tuple[Array, NDArray[np.int64]]:
        """Depth of the first hit of rays with unit z-depth, shape (..., 3) → (...), and the kind of surface hit."""
        t = np.full(rays.shape[:-1], FAR)
        kind = np.zeros(rays.shape[:-1], np.int64)

        def hit(distance: Array, what: int) -> None:
            nearer = (distance > 1e-3) & (distance < t)
            t[nearer], kind[nearer] = distance[nearer], what

        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.full(t.shape, np.inf)
            falling = rays[..., 2] < -1e-3
            guess = np.where(falling, (self.slope * origin[0] - origin[2]) / rays[..., 2], FAR)
            for _ in range(12):
                guess = np.clip(guess, 0.0, FAR)
                point = origin + guess[..., None] * rays
                guess = guess + (self.ground(point[..., :2]) - point[..., 2]) / np.minimum(rays[..., 2], -1e-3)
            ground[falling] = guess[falling]
            hit(ground, 1)
            for box in self.boxes:
                start = np.append(_into(origin[:2] - [box.x, box.y], box.heading), origin[2])
                direction = np.concatenate([_into(rays[..., :2], box.heading), rays[..., 2:]], -1)
                low = np.array([-box.length / 2, -box.width / 2, box.bottom])
                high = np.array([box.length / 2, box.width / 2, box.top])
                a, b = (low - start) / direction, (high - start) / direction
                near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
                hit(np.where(near <= far, near, np.inf), 2)
            for post in self.posts:
                offset = origin[:2] - [post.x, post.y]
                d = rays[..., :2]
                a, b, c = (d**2).sum(-1), d @ offset, offset @ offset - post.radius**2
                t_side = (-b - np.sqrt(b**2 - a * c)) / a
                below = origin[2] + t_side * rays[..., 2] < post.top
                hit(np.where(below, np.nan_to_num(t_side, nan=np.inf), np.inf), 3)
        return t, kind


def _into(xy: Array, heading: float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return xy @ np.array([[c, -s], [s, c]])


def right_turn(length: float = 60.0, straight: float = 30.0, radius: float = 6.0, step: float = 0.75) -> Array:
    """Points (x, y) every `step` meters of a straight along +x, a right quarter turn and a straight on."""
    s = np.arange(0.0, length + 1e-9, step)
    arc = radius * np.pi / 2
    angle = np.clip((s - straight) / radius, 0.0, np.pi / 2)
    x = np.minimum(s, straight) + radius * np.sin(angle)
    y = -radius * (1 - np.cos(angle)) - np.maximum(s - straight - arc, 0.0)
    return np.stack([x, y], -1)


def street(**changes: object) -> AnalyticField:
    """Walls, crates and lamp posts along `right_turn()`; nothing nearer than 1.8 m to the path."""
    boxes = (
        Box(12.0, 6.0, 20.0, 3.0, 5.0),
        Box(20.0, -8.0, 14.0, 5.0, 4.5),
        Box(43.0, 3.0, 5.0, 14.0, 5.0, 0.3),
        Box(30.0, -28.0, 4.0, 12.0, 5.0),
        Box(8.0, -2.4, 0.8, 0.6, 0.9, 0.4),
        Box(39.0, -12.0, 0.6, 0.6, 0.7),
        Box(39.5, -20.0, 2.0, 0.5, 1.1, 0.2),
    )
    posts = (
        Post(15.0, 2.5, 0.12, 4.8),
        Post(26.0, -2.6, 0.15, 4.8),
        Post(33.5, -16.0, 0.12, 4.8),
        Post(22, 2.4, 0.2, 0.7),
    )
    return AnalyticField(**{"boxes": boxes, "posts": posts, **changes})  # type: ignore[arg-type]


def drive(
    place: AnalyticField,
    path: Array,
    folder: Path,
    height: float = 1.8,
    sources: tuple[str, ...] = ("day",),
    points: int = 3000,
    seed: int = 0,
) -> Cameras:
    """Writes a `2_metric` folder of a drive along `path` (x, y): cameras, sparse points and metric.json."""
    rng = np.random.default_rng(seed)
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    poses, names, of = [], [], []
    for source in sources:
        for i, (xy, forward) in enumerate(zip(path, ahead, strict=True)):
            eye = np.append(xy, place.ground(xy) + height)
            poses.append(look_at(eye, eye + np.append(forward, -0.12)))
            names.append(f"{source}/{i:06d}")
            of.append(source)
    n = len(poses)
    folder.mkdir(parents=True, exist_ok=True)
    cameras = Cameras(
        names=tuple(names),
        camera_to_world=np.array(poses),
        intrinsics=np.tile([240.0, 240.0, 240.0, 135.0], (n, 1)),
        sizes=np.tile(np.array([480, 270]), (n, 1)),
        lightings=tuple(of),
        sources=tuple(of),
        times=np.tile(np.arange(len(path)) * 0.5, len(sources)),
        held_out=np.arange(n) % 8 == 4,
        images=folder.parent / "2_cameras" / "images",
    )
    cameras.save(folder)
    chosen = rng.integers(n, size=points)
    pixels = rng.uniform([0, 0], [480, 270], (points, 2))
    xyz, frame = [], []
    for k in np.unique(chosen):
        origin = cameras.positions[k]
        rays = unproject(pixels[chosen == k], cameras.intrinsics[k]) @ cameras.camera_to_world[k, :3, :3].T
        depth, _ = place._cast(origin, rays)
        good = depth < 30.0
        xyz.append((origin + depth[:, None] * rays)[good])
        frame.append(np.full(good.sum(), k))
    found = np.concatenate(xyz)
    found += 0.02 * rng.standard_normal(found.shape)
    seen = np.concatenate(frame)
    # Every point is seen by three consecutive frames, as a track of structure from motion is.
    SparsePoints(
        xyz=found,
        rgb=np.full((len(found), 3), 128, np.uint8),
        error=np.full(len(found), 0.5),
        point=np.repeat(np.arange(len(found)), 3),
        frame=np.clip(np.repeat(seen, 3) + np.tile([-1, 0, 1], len(found)), 0, n - 1),
    ).save(folder)
    write_json(folder / "metric.json", {"camera_height_median_m": height, "scale_source": "camera_height"})
    return cameras
