"""Posed pinhole cameras.

OpenCV axes: x right, y down, z forward. Pixel (0, 0) is the *corner* of the top-left pixel, whose centre is (0.5, 0.5)
as in COLMAP. *depth* is the z coordinate in the camera, *distance* runs along the ray. The world is metric with z up
once the metric stage has run; in `2_cameras` it is still the reconstruction's own frame.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.files import check_shapes, checked_text, damaged, load_arrays, read_json, write_json
from twin.geometry.poses import Similarity, inverse_pose
from twin.types import Array

_CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def opencv_to_mujoco(camera_to_world: Array) -> Array:
    """Turns OpenCV camera axes into MuJoCo's (x right, y up, looking along −z); its own inverse. Shape (..., 4, 4)."""
    return camera_to_world @ _CV_TO_GL


@dataclass(frozen=True)
class Cameras:
    """n undistorted pinhole views, with what is known of each frame. Order: by source, then by time."""

    names: tuple[str, ...]
    """Frame names, `<source>/<six digits>`; unique."""
    camera_to_world: Array
    """Shape (n, 4, 4)."""
    intrinsics: Array
    """fx, fy, cx, cy [px], shape (n, 4)."""
    sizes: NDArray[np.int64]
    """Width, height [px], shape (n, 2)."""
    lightings: tuple[str, ...]
    """Lighting name per frame."""
    sources: tuple[str, ...]
    """Source name per frame."""
    times: Array
    """Time within its source [s], shape (n,)."""
    held_out: NDArray[np.bool_]
    """True: never trained on, shape (n,)."""
    images: Path
    """Folder with `<name>.png`, undistorted, 8-bit RGB (or grey, read as RGB)."""
    masks: Path | None = None
    """Folder with `<name>.png`, 0 = ignore; None where nothing is masked."""

    def __len__(self) -> int:
        return len(self.names)

    def image_path(self, i: int) -> Path:
        return self.images / f"{self.names[i]}.png"

    def mask_path(self, i: int) -> Path | None:
        """The mask of frame i, or None where it has none."""
        path = self.masks / f"{self.names[i]}.png" if self.masks else None
        return path if path and path.exists() else None

    @property
    def positions(self) -> Array:
        """Camera centres, shape (n, 3)."""
        return self.camera_to_world[:, :3, 3]

    def select(self, index: NDArray) -> "Cameras":
        """The frames of an index array or boolean mask."""
        i = np.arange(len(self))[index]
        return replace(
            self,
            names=tuple(self.names[k] for k in i),
            camera_to_world=self.camera_to_world[i],
            intrinsics=self.intrinsics[i],
            sizes=self.sizes[i],
            lightings=tuple(self.lightings[k] for k in i),
            sources=tuple(self.sources[k] for k in i),
            times=self.times[i],
            held_out=self.held_out[i],
        )

    def transformed(self, similarity: Similarity) -> "Cameras":
        return replace(self, camera_to_world=similarity.poses(self.camera_to_world))

    def save(self, folder: Path) -> None:
        """Writes `cameras.json` and `cameras.npz`; image folders are kept as relative paths."""
        np.savez(
            folder / "cameras.npz",
            camera_to_world=self.camera_to_world,
            intrinsics=self.intrinsics,
            sizes=self.sizes,
            times=self.times,
            held_out=self.held_out,
        )
        # A stage folder is written as `<name>.partial` and renamed, so paths are relative to its parent, `build/`.
        base = folder.resolve().parent
        final = {p: Path(os.path.relpath(p.resolve(), base)).as_posix() for p in (self.images, self.masks) if p}
        write_json(
            folder / "cameras.json",
            {
                "names": self.names,
                "lightings": self.lightings,
                "sources": self.sources,
                "images": final[self.images].replace(".partial/", "/"),
                "masks": final[self.masks].replace(".partial/", "/") if self.masks else None,
            },
        )

    @staticmethod
    def load(folder: Path) -> "Cameras":
        """Raises InputError: no such files, or not those that `save` wrote."""
        head, data = read_json(folder / "cameras.json"), load_arrays(folder / "cameras.npz")
        base = folder.resolve().parent
        missing = {"camera_to_world", "intrinsics", "sizes", "times", "held_out"} - data.keys()
        if missing:
            raise InputError(f"{folder / 'cameras.npz'}: no {', '.join(sorted(missing))}; build the scene again")
        with damaged(folder / "cameras.json", "build the scene again"):
            cameras = Cameras(
                names=tuple(map(checked_text, head["names"])),
                camera_to_world=data["camera_to_world"],
                intrinsics=data["intrinsics"],
                sizes=data["sizes"],
                lightings=tuple(map(checked_text, head["lightings"])),
                sources=tuple(map(checked_text, head["sources"])),
                times=data["times"],
                held_out=data["held_out"],
                images=base / head["images"],
                masks=base / head["masks"] if head["masks"] else None,
            )
            n = len(cameras.names)
            if not len(cameras.lightings) == len(cameras.sources) == n:
                raise ValueError(f"{n} names, {len(cameras.lightings)} lightings, {len(cameras.sources)} sources")
        with damaged(folder / "cameras.npz", "build the scene again"):
            check_shapes(
                {
                    "camera_to_world": (cameras.camera_to_world, (n, 4, 4), "f"),
                    "intrinsics": (cameras.intrinsics, (n, 4), "f"),
                    "sizes": (cameras.sizes, (n, 2), "i"),
                    "times": (cameras.times, (n,), "f"),
                    "held_out": (cameras.held_out, (n,), "b"),
                }
            )
        return cameras


def nearest_frame(cameras: Cameras, i: int, lighting: str) -> int | None:
    """The frame of a lighting that was taken closest to frame i and looks the same way; None where none does."""
    offset = np.linalg.norm(cameras.positions - cameras.positions[i], axis=1)
    forward = cameras.camera_to_world[:, :3, 2]
    # Looking elsewhere counts as far away: 10 m for a right angle.
    cost = offset + 10.0 * (1.0 - forward @ forward[i])
    candidates = [k for k, name in enumerate(cameras.lightings) if name == lighting]
    return min(candidates, key=lambda k: float(cost[k])) if candidates else None


class Posed(Protocol):
    """What a renderer needs of cameras: `Cameras` and `Viewpoints` are such."""

    @property
    def camera_to_world(self) -> Array: ...
    @property
    def intrinsics(self) -> Array: ...
    @property
    def sizes(self) -> NDArray[np.int64]: ...


@dataclass(frozen=True)
class Viewpoints:
    """n pinhole views that nobody filmed."""

    camera_to_world: Array
    """Shape (n, 4, 4)."""
    intrinsics: Array
    """fx, fy, cx, cy [px], shape (n, 4)."""
    sizes: NDArray[np.int64]
    """Width, height [px] that the intrinsics are for, shape (n, 2)."""

    @staticmethod
    def of(camera_to_world: Array, intrinsics: Array, size: tuple[int, int]) -> "Viewpoints":
        """One or many views from one camera.

        Args:
            camera_to_world: Shape (4, 4) or (n, 4, 4).
            intrinsics: fx, fy, cx, cy [px], shape (4,), or (n, 4) where they differ.
            size: Width, height [px] that the intrinsics are for.
        """
        pose = np.asarray(camera_to_world, np.float64).reshape(-1, 4, 4)
        k = np.broadcast_to(np.asarray(intrinsics, np.float64), (len(pose), 4))
        return Viewpoints(pose, k, np.broadcast_to(np.array(size, np.int64), (len(pose), 2)))


def resized(cameras: Posed, size: tuple[int, int] | None) -> tuple[Array, tuple[int, int]]:
    """Intrinsics (n, 4) for pictures of one size, and that size: the one given, else that of the cameras.

    Raises:
        InputError: no size given, and the cameras' differ.
    """
    own = np.asarray(cameras.sizes)
    if size is None:
        if len(own) == 0 or (own != own[0]).any():
            raise InputError(f"cameras of {len(np.unique(own, axis=0))} sizes; give render one size=(width, height)")
        size = int(own[0, 0]), int(own[0, 1])
    return np.asarray(cameras.intrinsics) * np.tile(np.array(size) / own, 2), size


def pixel_grid(width: int, height: int) -> Array:
    """Pixel centres (u, v) [px], shape (height, width, 2)."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], -1)


def unproject(pixels: Array, intrinsics: Array) -> Array:
    """Rays through pixels, in the camera, with z = 1 (so that ray × depth is a point). Shapes (..., 2) → (..., 3)."""
    fx, fy, cx, cy = np.moveaxis(np.asarray(intrinsics), -1, 0)
    x, y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    return np.stack([x, y, np.ones_like(x)], -1)


def project(points: Array, camera_to_world: Array, intrinsics: Array) -> tuple[Array, Array]:
    """World points into one camera: pixels (..., 2) and depth (...). Behind the camera depth is negative."""
    local = points @ inverse_pose(camera_to_world)[:3, :3].T + inverse_pose(camera_to_world)[:3, 3]
    depth = local[..., 2]
    fx, fy, cx, cy = intrinsics
    safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    return np.stack([fx * local[..., 0] / safe + cx, fy * local[..., 1] / safe + cy], -1), depth


def scaled_intrinsics(intrinsics: Array, size: tuple[int, int], new_size: tuple[int, int]) -> Array:
    """Intrinsics after resizing an image from `size` to `new_size` (width, height)."""
    sx, sy = new_size[0] / size[0], new_size[1] / size[1]
    return np.asarray(intrinsics) * np.array([sx, sy, sx, sy])


# ---- The sparse points of structure from motion, and which frames saw them.


@dataclass(frozen=True)
class SparsePoints:
    """m points and their k observations (one row per point and frame that sees it)."""

    xyz: NDArray[np.float64]
    """Shape (m, 3), in the frame of the `Cameras` beside them."""
    rgb: NDArray[np.uint8]
    """Shape (m, 3)."""
    error: NDArray[np.float64]
    """Mean reprojection error [px], shape (m,)."""
    point: NDArray[np.int64]
    """Point index per observation, shape (k,)."""
    frame: NDArray[np.int64]
    """Frame index (into the `Cameras` beside them) per observation, shape (k,)."""

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def track_length(self) -> NDArray[np.int64]:
        """How many frames saw each point, shape (m,)."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def transformed(self, similarity: Similarity) -> "SparsePoints":
        return replace(self, xyz=similarity.points(self.xyz))

    @staticmethod
    def empty() -> "SparsePoints":
        none = np.zeros(0, np.int64)
        return SparsePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), none, none)

    def save(self, folder: Path) -> None:
        """Writes `points.npz`."""
        np.savez(folder / "points.npz", **vars(self))

    @staticmethod
    def load(folder: Path) -> "SparsePoints":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / "points.npz"
        with damaged(path, "build the scene again"):
            points = SparsePoints(**load_arrays(path))
            m, k = len(points.xyz), len(points.point)
            check_shapes(
                {
                    "xyz": (points.xyz, (m, 3), "f"),
                    "rgb": (points.rgb, (m, 3), "u"),
                    "error": (points.error, (m,), "f"),
                    "point": (points.point, (k,), "i"),
                    "frame": (points.frame, (k,), "i"),
                }
            )
            if k and not (points.point.min() >= 0 and points.point.max() < m and points.frame.min() >= 0):
                raise ValueError(f"observations of points that are not among the {m}")
        return points
