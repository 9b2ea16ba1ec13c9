"""Distances by stereo: where a film's own frames, with their poses known, agree on how far a pixel is.

A *source* of a frame is another frame of the same film that sees much of the same from a few degrees aside. Every few
pixels a plane is found that makes the sources look like the frame (PatchMatch stereo: Bleyer et al. 2011; on several
frames: Galliani et al. 2015); it counts as found where enough sources come to the same place. What is found becomes
sightings to train on. Plain surfaces stay open: nothing is guessed here.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.geometry.cameras import Cameras, pixel_grid, unproject
from twin.geometry.poses import inverse_pose
from twin.nerf.buffers import parallel
from twin.nerf.dataset import DepthSupervision, TrainingPixels, joined
from twin.nerf.kernels import patch_match as kernels
from twin.runtime import bar
from twin.types import Array

_GRID = 160  # cells along a frame's longer side
_SOURCES = 4
_ROUNDS = 4
_ANGLE = 5.0  # [°] between two frames at what both see: less is vague, more looks too different
_SPACING = 240  # a window's pixels are this share of the longer side apart
_MOST_COST = 0.5  # 1 − NCC
_TOLERANCE = 0.04  # of inverse depth, within which two frames agree
_PARALLAX = 0.3  # [px] that a change by the tolerance must move a pixel for a source to have a say
_VOTES = 2
_FEWEST_POINTS = 20  # sparse points a frame must see to say what depths to expect


@dataclass(frozen=True)
class Geometry:
    """A frame's sources and how its pixels appear in them."""

    source: NDArray[np.int32]
    turn: Array
    """K_source · R · K⁻¹, shape (s, 3, 3)."""
    shift: Array
    """K_source · t, shape (s, 3)."""
    back_turn: Array
    back_shift: Array


def stereo_depths(pixels: TrainingPixels, seed: int, where: str) -> tuple[DepthSupervision, dict[str, Any]]:
    """Sightings of every frame that has sources, and what there is to say of them.

    Args:
        pixels: The training frames; their sparse points say what depths to expect, without them there is no stereo.
        seed: Of the guesses; the same seed gives the same sightings.
        where: Device.
    """
    n = len(pixels.cameras)
    none = joined([])
    points = pixels.points
    if len(points.frame) < _FEWEST_POINTS or n < 3:
        return none, {"frames": 0, "sightings": 0, "share": 0.0}
    depths = [_depths(pixels, i) for i in range(n)]
    sources = choose_sources(pixels.cameras, pixels.intrinsics, np.array([np.median(d) for d in depths]))
    step = max(1, round(float(max(pixels.width.max(), pixels.height.max())) / _GRID))
    shapes = np.stack([pixels.height // step, pixels.width // step], 1).astype(np.int32)
    rows, columns = int(shapes[:, 0].max()), int(shapes[:, 1].max())
    frames = kernels.Frames()
    grey = pixels.colours.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / 255.0
    frames.grey = wp.array(grey, dtype=wp.float32, device=where)
    frames.start = wp.array(pixels.start[:-1].astype(np.int64), dtype=wp.int64, device=where)
    frames.width = wp.array(pixels.width.astype(np.int32), dtype=wp.int32, device=where)
    frames.height = wp.array(pixels.height.astype(np.int32), dtype=wp.int32, device=where)
    planes: wp.array = wp.zeros((n, rows, columns), dtype=wp.vec3, device=where)
    costs: wp.array = wp.full((n, rows, columns), 2.0, dtype=wp.float32, device=where)
    cells: wp.array = wp.array(shapes, dtype=wp.vec2i, device=where)
    geometry = [_geometry(pixels, i, sources[i]) for i in range(n)]
    pairs = [_pairs(g, where) for g in geometry]
    wp.load_module("twin.nerf.kernels.patch_match", device=where)

    with bar("stereo", n, "frame") as progress:

        def find(i: int) -> None:
            shape = tuple(int(x) for x in shapes[i])
            if len(sources[i]):
                spacing = max(1.0, float(round(max(pixels.width[i], pixels.height[i]) / _SPACING)))
                low, high = 0.5 / float(depths[i].max()), 2.0 / float(depths[i].min())
                guesses: list[wp.array] = [
                    wp.array(guess.astype(np.float32), dtype=wp.vec3, device=where)
                    for guess in (_nearest_points(pixels, i, step, shape), _floor(pixels, i, step, shape))
                ]
                mine, cost = _window(planes, i, shape), _window(costs, i, shape)
                for number in range(_ROUNDS + 1):
                    for parity in (0, 1):
                        wp.launch(
                            kernels.sweep,
                            (shape[0], (shape[1] + 1) // 2),
                            [
                                *(frames, pairs[i], i, step, spacing, low, high, number, parity),
                                *(seed * 100_003 + i, *guesses),
                            ],
                            [mine, cost],
                            device=where,
                        )
            progress.update()

        parallel(find, range(n), where)

    def check(i: int) -> tuple[DepthSupervision, int]:
        shape = tuple(int(x) for x in shapes[i])
        if not len(sources[i]):
            return none, 0
        votes: wp.array = wp.zeros(shape, dtype=wp.int32, device=where)
        back: list[wp.array] = [
            wp.array(geometry[i].back_turn.astype(np.float32), dtype=wp.mat33, device=where),
            wp.array(geometry[i].back_shift.astype(np.float32), dtype=wp.vec3, device=where),
        ]
        wp.launch(
            kernels.agree,
            shape,
            [
                *(pairs[i], *back, planes, cells, _window(costs, i, shape), i, step),
                *(_MOST_COST, _TOLERANCE, _PARALLAX, votes),
            ],
            device=where,
        )
        q = _window(planes, i, shape).numpy()[..., 0]
        row, column = np.nonzero(votes.numpy() >= min(_VOTES, len(sources[i])))
        pixel = np.stack([column, row], 1) * step + step // 2 + 0.5
        open_ = pixels.open[pixels.start[i] + pixel[:, 1].astype(int) * pixels.width[i] + pixel[:, 0].astype(int)]
        pixel, depth = pixel[open_], 1.0 / q[row[open_], column[open_]]
        distance = depth * np.linalg.norm(unproject(pixel, pixels.intrinsics[i]), axis=1)
        return DepthSupervision(np.full(len(pixel), i, np.int32), pixel, distance.astype(np.float32)), shape[0] * shape[
            1
        ]

    checked = parallel(check, range(n), where)
    found = joined([s for s, _ in checked])
    return found, {
        "frames": sum(len(s.frame) > 0 for s, _ in checked),
        "sightings": len(found.frame),
        "share": len(found.frame) / max(1, sum(cells for _, cells in checked)),
    }


def choose_sources(cameras: Cameras, intrinsics: Array, depth: Array) -> list[NDArray[np.int32]]:
    """Up to four sources of every frame, best first, from what each would see at the depth it expects.

    Args:
        cameras: Training frames.
        intrinsics: Of the pictures used, shape (n, 4) [px].
        depth: Median depth a frame sees [m], shape (n,).
    """
    n = len(cameras)
    positions, world_to_camera = cameras.positions, inverse_pose(cameras.camera_to_world)
    half = np.stack([intrinsics[:, 2] / intrinsics[:, 0], intrinsics[:, 3] / intrinsics[:, 1]], 1)  # tan of half angles
    spots = np.stack(np.meshgrid([-0.8, -0.4, 0.4, 0.8], [-0.5, 0.0, 0.6], [0.5, 1.0, 2.0]), -1).reshape(-1, 3)
    names = np.array(cameras.sources)
    out = []
    for i in range(n):
        others = np.flatnonzero((names == names[i]) & (np.arange(n) != i))
        z = spots[:, 2:] * depth[i]
        local = np.concatenate([spots[:, :2] * half[i] * z, z], 1)
        place = local @ cameras.camera_to_world[i, :3, :3].T + positions[i]
        there = np.einsum("jab,sb->jsa", world_to_camera[others, :3, :3], place) + world_to_camera[others, None, :3, 3]
        ahead = there[..., 2] > 0.1 * depth[i]
        inside = (np.abs(there[..., :2]) < half[others, None] * there[..., 2:]).all(-1) & ahead
        a, b = place - positions[i], place - positions[others, None]
        cosine = (a * b).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1) + 1e-12)
        angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
        # Seen twice as large or half as large, a window no longer looks the same.
        ratio = np.linalg.norm(b, axis=-1) / np.linalg.norm(a, axis=-1)
        spread = np.where(angle < _ANGLE, 2.0, 8.0)
        worth = (inside * np.exp(-(((angle - _ANGLE) / spread) ** 2) - (np.log(ratio) / 0.7) ** 2)).sum(-1)
        best = np.argsort(-worth, kind="stable")[:_SOURCES]
        out.append(others[best[worth[best] > 0.01 * len(spots)]].astype(np.int32))
    return out


def _depths(pixels: TrainingPixels, i: int) -> Array:
    """What z-depths frame i may expect [m]: 1st to 99th percentile of its sparse points, or of all frames'."""
    points = pixels.points
    mine = points.frame == i
    if mine.sum() < _FEWEST_POINTS:
        mine = np.ones(len(points.frame), bool)
    rays = np.stack([np.ones(int(mine.sum())), *_ray_slopes(pixels, points.frame[mine], points.pixel[mine])], 1)
    depth = points.distance[mine] / np.linalg.norm(rays, axis=1)
    return np.quantile(depth, [0.01, 0.25, 0.5, 0.75, 0.99])


def _ray_slopes(pixels: TrainingPixels, frame: NDArray, pixel: Array) -> tuple[Array, Array]:
    fx, fy, cx, cy = pixels.intrinsics[frame].T
    return (pixel[:, 0] - cx) / fx, (pixel[:, 1] - cy) / fy


def _geometry(pixels: TrainingPixels, i: int, sources: NDArray[np.int32]) -> Geometry:
    def matrix(k: Array) -> Array:
        return np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]])

    own = matrix(pixels.intrinsics[i])
    pose = pixels.cameras.camera_to_world[i]
    turns, shifts, back_turns, back_shifts = [], [], [], []
    for j in sources:
        other = matrix(pixels.intrinsics[j])
        there = inverse_pose(pixels.cameras.camera_to_world[j]) @ pose
        turns.append(other @ there[:3, :3] @ np.linalg.inv(own))
        shifts.append(other @ there[:3, 3])
        here = inverse_pose(there)
        back_turns.append(own @ here[:3, :3] @ np.linalg.inv(other))
        back_shifts.append(own @ here[:3, 3])
    stack = [np.array(m).reshape(-1, *shape) for m, shape in ((turns, (3, 3)), (shifts, (3,)))]
    back = [np.array(m).reshape(-1, *shape) for m, shape in ((back_turns, (3, 3)), (back_shifts, (3,)))]
    return Geometry(sources, *stack, *back)


def _pairs(geometry: Geometry, where: str) -> Any:
    pairs = kernels.Pairs()
    pairs.source = wp.array(geometry.source, dtype=wp.int32, device=where)
    pairs.turn = wp.array(geometry.turn.astype(np.float32), dtype=wp.mat33, device=where)
    pairs.shift = wp.array(geometry.shift.astype(np.float32), dtype=wp.vec3, device=where)
    return pairs


def _window(array: wp.array, i: int, shape: tuple[int, ...]) -> wp.array:
    """Frame i's share of an array over all frames, cut to the frame's shape."""
    return array[i][: shape[0], : shape[1]]


def _grid(step: int, shape: tuple[int, ...]) -> Array:
    """Pixel (u, v) of every cell, shape (rows, columns, 2)."""
    return (pixel_grid(shape[1], shape[0]) - 0.5) * step + step // 2 + 0.5


def _nearest_points(pixels: TrainingPixels, i: int, step: int, shape: tuple[int, ...]) -> Array:
    """The depth of the sparse point nearest in the picture, facing the lens; q = 0 where the frame saw none."""
    from scipy.spatial import cKDTree

    mine = pixels.points.frame == i
    out = np.zeros((*shape, 3))
    if mine.any():
        pixel = pixels.points.pixel[mine]
        x, y = _ray_slopes(pixels, pixels.points.frame[mine], pixel)
        q = np.sqrt(1.0 + x**2 + y**2) / pixels.points.distance[mine]
        out[..., 0] = q[cKDTree(pixel).query(_grid(step, shape).reshape(-1, 2))[1]].reshape(shape)
    return out


def _floor(pixels: TrainingPixels, i: int, step: int, shape: tuple[int, ...]) -> Array:
    """The level floor at z = 0; q ≤ 0 above the horizon."""
    pose, (fx, fy, cx, cy) = pixels.cameras.camera_to_world[i], pixels.intrinsics[i]
    height = pose[2, 3]
    # z of the place a ray with unit z-depth reaches at depth d is height + d · (row 3 of R) · ray, and 0 on the floor.
    down = -pose[2, :3] / (height if height > 1e-3 else -1.0)
    grid = _grid(step, shape)
    out = np.empty((*shape, 3))
    out[..., 1], out[..., 2] = down[0] / fx, down[1] / fy
    out[..., 0] = down[2] + (grid[..., 0] - cx) * out[..., 1] + (grid[..., 1] - cy) * out[..., 2]
    return out
