"""A textured corridor filmed by known cameras, as capture and metric leave it: for tests that match features.

Ground z = 0, walls y = ±3, end x = 20 [m]; each plane has a texture of its own at 4 cm per texel.
"""

from pathlib import Path

import cv2
import numpy as np

from twin.capture.capture_data import Capture, SourceInfo
from twin.geometry.cameras import Cameras, SparsePoints, pixel_grid, unproject
from twin.geometry.images import write_image
from twin.geometry.poses import look_at
from twin.scene import SceneDir

SIZE = (320, 240)
K = np.array([260.0, 260.0, 160.0, 120.0])
_PLANES = ((2, 0.0, 0, 1), (1, 3.0, 0, 2), (1, -3.0, 0, 2), (0, 20.0, 1, 2))  # axis, level, texture axes


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Noise at several scales, shape (512, 512, 3) in [0, 1]."""
    total = np.zeros((512, 512, 3))
    for cells in (16, 32, 64, 128, 256):
        total += np.kron(rng.random((cells, cells, 3)), np.ones((512 // cells, 512 // cells, 1)))
    return (total - total.min()) / np.ptp(total)


TEXTURES = [_texture(np.random.default_rng(i)) for i in range(len(_PLANES))]


def hits(pixels: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray = K) -> tuple[np.ndarray, np.ndarray]:
    """Points (..., 3) [m] where the rays of pixels (..., 2) meet the corridor, and the index (...) of the plane."""
    rays = unproject(pixels, intrinsics) @ pose[:3, :3].T
    depth, which = np.full(rays.shape[:-1], np.inf), np.zeros(rays.shape[:-1], int)
    for k, (axis, level, _, _) in enumerate(_PLANES):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (level - pose[axis, 3]) / rays[..., axis]
        nearer = (t > 0) & (t < depth)
        depth[nearer], which[nearer] = t[nearer], k
    depth = np.where(np.isfinite(depth), depth, 100.0)
    return pose[:3, 3] + depth[..., None] * rays, which


def picture(
    pose: np.ndarray, size: tuple[int, int] = SIZE, intrinsics: np.ndarray = K, tint=(1.0, 1.0, 1.0)
) -> np.ndarray:
    """A camera's picture, uint8, shape (h, w, 3)."""
    place, which = hits(pixel_grid(*size), pose, intrinsics)
    image = np.zeros((*place.shape[:2], 3))
    for k, (_, _, a, b) in enumerate(_PLANES):
        mine = which == k
        u, v = (np.floor(place[mine][:, axis] / 0.04).astype(int) % 512 for axis in (a, b))
        image[mine] = TEXTURES[k][u, v]
    return (255 * np.clip(image * tint, 0, 1)).astype(np.uint8)


def pose_at(x: float, y: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """A camera 1.2 m up that looks along the corridor, `turn` to the left [m at 6 m]."""
    eye = np.array([x, y, 1.2])
    return look_at(eye, eye + np.array([6.0, turn, -0.4]))


def filmed_corridor(root: Path, frames: int = 6) -> SceneDir:
    """A scene with its capture and metric stages; every point is a feature of one frame, put where its ray ends."""
    scene = SceneDir(root)
    capture, metric = scene.stage("capture"), scene.stage("metric")
    capture.mkdir(parents=True)
    metric.mkdir()
    (root / "scene.toml").write_text('name = "corridor"\n[[source]]\npath = "input/day"\nlighting = "day"\n')
    poses = np.array([pose_at(x, 0.2 * np.sin(x)) for x in np.linspace(0.0, 5.0, frames)])
    names = tuple(f"day/{i:06d}" for i in range(frames))
    cameras = Cameras(
        names=names,
        camera_to_world=poses,
        intrinsics=np.tile(K, (frames, 1)),
        sizes=np.tile(SIZE, (frames, 1)),
        lightings=("day",) * frames,
        sources=("day",) * frames,
        times=np.arange(frames, dtype=float),
        held_out=np.zeros(frames, bool),
        images=scene.stage("cameras") / "images",
    )
    places, seen = [], []
    for i, pose in enumerate(poses):
        image = picture(pose)
        write_image(cameras.image_path(i), image)
        found = cv2.SIFT_create(1500).detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        pixels = np.unique(np.array([k.pt for k in found]) + 0.5, axis=0)  # OpenCV's first pixel center is 0, 0
        places.append(hits(pixels, pose)[0])
        seen.append(np.full(len(pixels), i))
    xyz, frame = np.concatenate(places), np.concatenate(seen)
    n = len(xyz)
    cameras.save(metric)
    SparsePoints(xyz, np.zeros((n, 3), np.uint8), np.full(n, 0.5), np.arange(n), frame).save(metric)
    info = SourceInfo("day", "day", "images", *SIZE, "PINHOLE", tuple(K), True, 0.0)
    nowhere = np.full((frames, 3), np.nan)
    Capture((info,), names, np.zeros(frames, int), cameras.times, cameras.held_out, nowhere).save(capture)
    return scene
