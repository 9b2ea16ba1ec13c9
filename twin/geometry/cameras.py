"""Posed pinhole cameras, sparse points, projection, and what a renderer returns for cameras.

OpenCV axes: x right, y down, z forward. Pixel (0, 0) is the *corner* of the top-left pixel, whose center is (0.5, 0.5)
as in COLMAP. *Depth* is the z coordinate in the camera frame, *distance* is measured along the ray. World
coordinates are metric with z up, except in the build folder `2_cameras`, where they are those of the reconstruction.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.files import check_shapes, load_arrays, read_json, require_text, wrap_read_errors, write_json
from twin.geometry.poses import Similarity, inverse_pose
from twin.types import Array

_CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])
_MIN_PARALLAX = 1.0  # [°] two views determine a point's depth if their directions differ by at least this
_CAMERA_ARRAYS: dict[str, tuple[tuple[int, ...], str]] = {
    "camera_to_world": ((4, 4), "f"),
    "intrinsics": ((4,), "f"),
    "sizes": ((2,), "i"),
    "times": ((), "f"),
    "held_out": ((), "b"),
}  # arrays of `Cameras` that are stored: name → (shape per frame, `dtype.kind`)


def opencv_to_mujoco(camera_to_world: Array) -> Array:
    """Converts OpenCV camera axes to MuJoCo's (x right, y up, looking along −z). Self-inverse; shape (..., 4, 4)."""
    return camera_to_world @ _CV_TO_GL


@dataclass(frozen=True)
class Cameras:
    """n undistorted, posed pinhole frames with their metadata, ordered by source and then by time."""

    names: tuple[str, ...]  # frame names, `<source>/<six digits>`; unique
    camera_to_world: Array  # shape (n, 4, 4)
    intrinsics: Array  # fx, fy, cx, cy [px], shape (n, 4)
    sizes: NDArray[np.int64]  # width, height [px], shape (n, 2)
    lightings: tuple[str, ...]  # lighting name per frame
    sources: tuple[str, ...]  # source name per frame
    times: Array  # time since the start of the source [s], or a photo's index; shape (n,)
    held_out: NDArray[np.bool_]  # true for test frames, which are never trained on; shape (n,)
    images: Path  # folder with `<name>.png`, undistorted, 8-bit RGB (or gray, read as RGB)
    masks: Path | None = None  # folder with `<name>.png`, 0 = ignore; None if no frame has a mask

    def __len__(self) -> int:
        return len(self.names)

    def image_path(self, i: int) -> Path:
        return self.images / f"{self.names[i]}.png"

    def mask_path(self, i: int) -> Path | None:
        """The mask file of frame i, or None."""
        path = self.masks / f"{self.names[i]}.png" if self.masks else None
        return path if path and path.exists() else None

    @property
    def positions(self) -> Array:
        """Camera centers, shape (n, 3)."""
        return self.camera_to_world[:, :3, 3]

    def select(self, index: NDArray) -> "Cameras":
        """The frames selected by an index array or boolean mask."""
        i = np.arange(len(self))[index]
        texts = {name: tuple(getattr(self, name)[k] for k in i) for name in ("names", "lightings", "sources")}
        return replace(self, **texts, **{name: getattr(self, name)[i] for name in _CAMERA_ARRAYS})  # type: ignore[arg-type]

    def transformed(self, similarity: Similarity) -> "Cameras":
        return replace(self, camera_to_world=similarity.poses(self.camera_to_world))

    def save(self, folder: Path) -> None:
        """Writes `cameras.json` and `cameras.npz`; image folders are stored as relative paths."""
        np.savez(folder / "cameras.npz", **{name: getattr(self, name) for name in _CAMERA_ARRAYS})
        # A stage folder is written as `<name>.partial` and renamed, so paths are relative to its parent, `build/`.
        base = folder.resolve().parent
        images, masks = (
            Path(os.path.relpath(path.resolve(), base)).as_posix().replace(".partial/", "/") if path else None
            for path in (self.images, self.masks)
        )
        head = {"names": self.names, "lightings": self.lightings, "sources": self.sources}
        write_json(folder / "cameras.json", head | {"images": images, "masks": masks})

    @staticmethod
    def load(folder: Path) -> "Cameras":
        """Reads the files that `save` wrote. Raises InputError if they are missing or damaged."""
        head, data = read_json(folder / "cameras.json"), load_arrays(folder / "cameras.npz")
        base = folder.resolve().parent
        with wrap_read_errors(folder / "cameras.json", "build the scene again"):
            texts = {name: tuple(map(require_text, head[name])) for name in ("names", "lightings", "sources")}
            images, masks = base / head["images"], base / head["masks"] if head["masks"] else None
            n = len(texts["names"])
            if any(len(values) != n for values in texts.values()):
                counts = ", ".join(f"{len(values)} {name}" for name, values in texts.items())
                raise ValueError(f"{counts}; expected equal numbers")
        with wrap_read_errors(folder / "cameras.npz", "build the scene again"):
            arrays = {name: data[name] for name in _CAMERA_ARRAYS}
            check_shapes({name: (arrays[name], (n, *one), kind) for name, (one, kind) in _CAMERA_ARRAYS.items()})
        return Cameras(**texts, **arrays, images=images, masks=masks)  # type: ignore[arg-type]


def evenly_spaced(count: int, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` of `count` items, evenly spaced, ends included."""
    return np.arange(count) if count <= limit else np.round(np.linspace(0, count - 1, limit)).astype(np.int64)


def nearest_frame(cameras: Cameras, i: int, lighting: str) -> int | None:
    """Index of the frame under `lighting` whose pose is closest to frame i's; None if that lighting has no frame."""
    offset = np.linalg.norm(cameras.positions - cameras.positions[i], axis=1)
    forward = cameras.camera_to_world[:, :3, 2]
    # A different view direction adds to the distance: 10 m for a right angle.
    cost = offset + 10.0 * (1.0 - forward @ forward[i])
    candidates = [k for k, name in enumerate(cameras.lightings) if name == lighting]
    return min(candidates, key=lambda k: float(cost[k])) if candidates else None


@dataclass(frozen=True)
class Viewpoints:
    """n virtual pinhole views."""

    camera_to_world: Array  # shape (n, 4, 4)
    intrinsics: Array  # fx, fy, cx, cy [px], shape (n, 4)
    sizes: NDArray[np.int64]  # width, height [px] of the images to which the intrinsics apply, shape (n, 2)

    @staticmethod
    def of(camera_to_world: Array, intrinsics: Array, size: tuple[int, int]) -> "Viewpoints":
        """Views from one pose (4, 4) or many (n, 4, 4), with shared (4,) or individual intrinsics (n, 4) for `size`."""
        pose = np.asarray(camera_to_world, np.float64).reshape(-1, 4, 4)
        k = np.broadcast_to(np.asarray(intrinsics, np.float64), (len(pose), 4))
        return Viewpoints(pose, k, np.broadcast_to(np.array(size, np.int64), (len(pose), 2)))


PosedCameras = Cameras | Viewpoints  # what renderers take


def intrinsics_for_size(cameras: PosedCameras, size: tuple[int, int] | None) -> tuple[Array, tuple[int, int]]:
    """Returns intrinsics (n, 4) scaled to one image size, and that size.

    The size is `size` if given, else the size that all cameras share.

    Raises InputError: no size is given and the cameras' sizes differ, or a pose or a focal length is invalid: kernels
    would read outside of their arrays.
    """
    own = np.asarray(cameras.sizes)
    pose, lens = np.asarray(cameras.camera_to_world), np.asarray(cameras.intrinsics)
    if not (np.isfinite(pose).all() and np.isfinite(lens).all() and (lens[..., :2] > 0.0).all()):
        raise InputError("a camera's pose or intrinsics are not finite, or a focal length is not above 0; correct them")
    if size is None:
        if len(own) == 0 or (own != own[0]).any():
            raise InputError(
                f"the cameras have {len(np.unique(own, axis=0))} different image sizes; "
                "pass size=(width, height) to render"
            )
        size = int(own[0, 0]), int(own[0, 1])
    return scaled_intrinsics(cameras.intrinsics, own, size), size


def pixel_grid(width: int, height: int) -> Array:
    """Pixel centers (u, v) [px], shape (height, width, 2)."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], -1)


def unproject(pixels: Array, intrinsics: Array) -> Array:
    """Rays through pixels, in camera axes with z = 1, so that ray × depth is a point. Shapes (..., 2) → (..., 3)."""
    fx, fy, cx, cy = np.moveaxis(np.asarray(intrinsics), -1, 0)
    x, y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    return np.stack([x, y, np.ones_like(x)], -1)


def project(points: Array, camera_to_world: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Projects world points (..., 3) into one camera: pixels (..., 2) and depth (...), negative behind the camera."""
    world_to_camera = inverse_pose(camera_to_world)
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = local[..., 2]
    fx, fy, cx, cy = intrinsics
    safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    return np.stack([fx * local[..., 0] / safe + cx, fy * local[..., 1] / safe + cy], -1), depth


def depth_determined(cameras: Cameras, points: Array) -> NDArray[np.bool_]:
    """Mask (n,) of the points (n, 3) [m] that one film shows from directions at least `_MIN_PARALLAX` apart.

    Frames are matched within a film, so only there do cameras and field determine depth. Only training frames count.
    Directions are compared with that of the film's first frame that shows the point. Occlusions and image masks are
    ignored.
    """
    found = np.zeros(len(points), bool)
    films, trained = np.array(cameras.sources), ~np.asarray(cameras.held_out, bool)
    for film in dict.fromkeys(cameras.sources):
        first = np.full((len(points), 3), np.nan)  # first direction from which the film shows a point
        for i in np.flatnonzero((films == film) & trained):
            left = np.flatnonzero(~found)
            pixels, depth = project(points[left], cameras.camera_to_world[i], cameras.intrinsics[i])
            shown = left[(depth > 0.0) & (pixels >= 0.0).all(1) & (pixels <= cameras.sizes[i]).all(1)]
            ray = cameras.positions[i] - points[shown]
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            # Chords are compared, because the arc cosine is imprecise for small angles. NaN in `first` gives False.
            found[shown] = np.linalg.norm(ray - first[shown], axis=1) >= 2.0 * np.sin(np.radians(_MIN_PARALLAX) / 2.0)
            new = np.isnan(first[shown, 0])
            first[shown[new]] = ray[new]
    return found


def scaled_intrinsics(intrinsics: Array, size: tuple[int, int] | NDArray, new_size: tuple[int, int]) -> Array:
    """Intrinsics (..., 4) after resizing images from `size` to `new_size` (width, height)."""
    return np.asarray(intrinsics) * np.tile(np.array(new_size) / size, 2)


# ---- sparse points of structure from motion


@dataclass(frozen=True)
class SparsePoints:
    """m points and their k observations (one per point and frame in which it was matched)."""

    xyz: NDArray[np.float64]  # world coordinates of the `Cameras` in the same folder, shape (m, 3)
    rgb: NDArray[np.uint8]  # shape (m, 3)
    error: NDArray[np.float64]  # mean reprojection error [px], shape (m,)
    point: NDArray[np.int64]  # index of each observation's point, shape (k,)
    frame: NDArray[np.int64]  # index of each observation's frame in these `Cameras`, shape (k,)

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def track_length(self) -> NDArray[np.int64]:
        """Number of observations of each point, shape (m,)."""
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
        """Reads the file that `save` wrote. Raises InputError if it is missing or damaged."""
        path = folder / "points.npz"
        with wrap_read_errors(path, "build the scene again"):
            points = SparsePoints(**load_arrays(path))
            m, k = len(points.xyz), len(points.point)
            shapes = {"xyz": ((m, 3), "f"), "rgb": ((m, 3), "u"), "error": ((m,), "f"), "point": ((k,), "i")}
            shapes |= {"frame": ((k,), "i")}
            check_shapes({name: (getattr(points, name), *shape) for name, shape in shapes.items()})
            if k and not (points.point.min() >= 0 and points.point.max() < m and points.frame.min() >= 0):
                raise ValueError(f"an observation has a point index outside 0 to {m - 1}, or a negative frame index")
        return points


# ---- renderings

FAR = 1.0e4  # z-depth of the background [m]


@dataclass(frozen=True)
class Rendering:
    """n rendered views of one size."""

    rgb: NDArray[np.float32]  # color in [0, 1], shape (n, height, width, 3)
    depth: NDArray[np.float32]
    """z-depth [m] at which half the light is blocked, `FAR` where less is blocked; shape (n, height, width)."""
    opacity: NDArray[np.float32]  # share of the light that is blocked, in [0, 1], shape (n, height, width)


class RenderableField(Protocol):
    """Interface shared by `RadianceField` and `BakedField`."""

    @property
    def lightings(self) -> tuple[str, ...]: ...

    def render(self, cameras: PosedCameras, lighting: str, size: tuple[int, int]) -> Rendering: ...
