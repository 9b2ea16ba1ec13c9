"""Multi-view stereo: depth supervision from frames of one film with known poses.

A *source* of a frame is another frame of the same film that shows nearly the same view from a few degrees to the side.
A frame is divided into *cells* of a few pixels. PatchMatch stereo (Bleyer et al. 2011; for several views Galliani et
al. 2015) fits a plane to every cell, such that the sources, warped by the plane, look like the frame. A cell is used if
enough sources find the same point. Surfaces without texture get no depth.
"""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.geometry.cameras import Cameras, pixel_grid, unproject
from twin.geometry.poses import inverse_pose
from twin.nerf.buffers import parallel
from twin.nerf.dataset import DepthSupervision, TrainingPixels, join_depths
from twin.nerf.kernels import patch_match as kernels
from twin.runtime import bar
from twin.types import Array
from twin.warp_runtime import wp

_GRID_CELLS = 160  # cells along a frame's longer side
_MAX_SOURCES = 4  # sources per frame
_ROUNDS = 4  # PatchMatch rounds after the first
_BEST_ANGLE = 5.0  # [°] between two views of a point: less makes depth imprecise, more changes the appearance
_WINDOW_SPACING = 240  # a frame's longer side is this many times the spacing of a window's pixels
_MAX_COST = 0.5  # greatest 1 − NCC of a used cell
_TOLERANCE = 0.04  # relative difference of inverse depth within which two frames agree
_MIN_PARALLAX = 0.3  # [px] least shift in a voting source if inverse depth changes by the tolerance
_MIN_VOTES = 2  # sources that must agree; 1 suffices if a frame has only one source
_MIN_POINTS = 20  # least number of sparse points from which a frame's depth range is estimated


def stereo_depths(pixels: TrainingPixels, seed: int, device: str) -> tuple[DepthSupervision, dict[str, Any]]:
    """Depth supervision for every frame that has sources, and a summary; the same seed gives the same depths.

    Sparse points give the range of depths to search. With fewer than 20 points or 3 frames, the result is empty.
    """
    n = len(pixels.cameras)
    none = join_depths([])
    points = pixels.points
    if len(points.frame) < _MIN_POINTS or n < 3:
        return none, {"frames": 0, "sightings": 0, "share": 0.0}
    depths = [_depth_quantiles(pixels, i) for i in range(n)]
    sources = choose_sources(pixels.cameras, pixels.intrinsics, np.array([np.median(d) for d in depths]))
    step = max(1, round(float(max(pixels.width.max(), pixels.height.max())) / _GRID_CELLS))
    shapes = np.stack([pixels.height // step, pixels.width // step], 1).astype(np.int32)
    rows, columns = int(shapes[:, 0].max()), int(shapes[:, 1].max())
    frames = kernels.GrayImages()
    gray = np.empty(len(pixels.colors), np.float32)
    for run in zip(pixels.start[:-1].tolist(), pixels.start[1:].tolist(), strict=True):
        # Frame by frame, as colors in floating point take four times the memory of all frames.
        gray[slice(*run)] = pixels.colors[slice(*run)] @ np.array([0.299, 0.587, 0.114], np.float32) / 255.0
    frames.gray = wp.array(gray, dtype=wp.float32, device=device)
    frames.start = wp.array(pixels.start[:-1].astype(np.int64), dtype=wp.int64, device=device)
    frames.width = wp.array(pixels.width.astype(np.int32), dtype=wp.int32, device=device)
    frames.height = wp.array(pixels.height.astype(np.int32), dtype=wp.int32, device=device)
    planes: wp.array = wp.zeros((n, rows, columns), dtype=wp.vec3, device=device)
    costs: wp.array = wp.full((n, rows, columns), 2.0, dtype=wp.float32, device=device)
    cells: wp.array = wp.array(shapes, dtype=wp.vec2i, device=device)

    def mapping(matrices: Array) -> list[wp.array]:
        """Homographies and epipoles, see `_mappings`, on the device."""
        homography, epipole = matrices[..., :3].astype(np.float32), matrices[..., 3].astype(np.float32)
        return [
            wp.array(homography, dtype=wp.mat33, device=device),
            wp.array(epipole, dtype=wp.vec3, device=device),
        ]

    mappings = [_mappings(pixels, i, sources[i]) for i in range(n)]
    views = [kernels.SourceViews() for _ in range(n)]
    for view, source, (there, _) in zip(views, sources, mappings, strict=True):
        view.source = wp.array(source, dtype=wp.int32, device=device)
        view.homography, view.epipole = mapping(there)
    wp.load_module("twin.nerf.kernels.patch_match", device=device)

    with bar("stereo", n, "frame") as progress:

        def find(i: int) -> None:
            shape = tuple(int(x) for x in shapes[i])
            if len(sources[i]):
                spacing = max(1.0, float(round(max(pixels.width[i], pixels.height[i]) / _WINDOW_SPACING)))
                low, high = 0.5 / float(depths[i].max()), 2.0 / float(depths[i].min())
                guesses: list[wp.array] = [
                    wp.array(guess.astype(np.float32), dtype=wp.vec3, device=device)
                    for guess in (_planes_at_points(pixels, i, step, shape), _ground_planes(pixels, i, step, shape))
                ]
                own_planes, own_costs = _frame_part(planes, i, shape), _frame_part(costs, i, shape)
                for number, parity in product(range(_ROUNDS + 1), (0, 1)):
                    inputs = [frames, views[i], i, step, spacing, low, high, number, parity, seed * 100_003 + i]
                    dim = shape[0], (shape[1] + 1) // 2
                    wp.launch(kernels.sweep, dim, [*inputs, *guesses], [own_planes, own_costs], device=device)
            progress.update()

        parallel(find, range(n), device)

    def check(i: int) -> tuple[DepthSupervision, int]:
        shape = tuple(int(x) for x in shapes[i])
        if not len(sources[i]):
            return none, 0
        votes: wp.array = wp.zeros(shape, dtype=wp.int32, device=device)
        inputs = [views[i], *mapping(mappings[i][1]), planes, cells, _frame_part(costs, i, shape), i, step]
        wp.launch(kernels.count_votes, shape, [*inputs, _MAX_COST, _TOLERANCE, _MIN_PARALLAX, votes], device=device)
        q = _frame_part(planes, i, shape).numpy()[..., 0]
        row, column = np.nonzero(votes.numpy() >= min(_MIN_VOTES, len(sources[i])))
        pixel = np.stack([column, row], 1) * step + step // 2 + 0.5
        unmasked = pixels.is_unmasked(i, pixel)
        pixel, depth = pixel[unmasked], 1.0 / q[row[unmasked], column[unmasked]]
        distance = depth * np.linalg.norm(unproject(pixel, pixels.intrinsics[i]), axis=1)
        depths = DepthSupervision(np.full(len(pixel), i, np.int32), pixel, distance.astype(np.float32))
        return depths, shape[0] * shape[1]

    checked = parallel(check, range(n), device)
    found = join_depths([s for s, _ in checked])
    return found, {
        "frames": sum(len(s.frame) > 0 for s, _ in checked),
        "sightings": len(found.frame),
        "share": len(found.frame) / max(1, sum(cells for _, cells in checked)),
    }


def choose_sources(cameras: Cameras, intrinsics: Array, depth: Array) -> list[NDArray[np.int32]]:
    """Up to four sources of every frame, best first, rated by their views of points around the frame's median depth.

    `intrinsics` are fx, fy, cx, cy [px] of the scaled images, shape (n, 4); `depth` is the median depth [m], (n,).
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
        point = local @ cameras.camera_to_world[i, :3, :3].T + positions[i]
        there = np.einsum("jab,sb->jsa", world_to_camera[others, :3, :3], point) + world_to_camera[others, None, :3, 3]
        ahead = there[..., 2] > 0.1 * depth[i]
        inside = (np.abs(there[..., :2]) < half[others, None] * there[..., 2:]).all(-1) & ahead
        a, b = point - positions[i], point - positions[others, None]
        cosine = (a * b).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1) + 1e-12)
        angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
        # A window does not match its image at twice or half the scale, as from twice or half the distance.
        ratio = np.linalg.norm(b, axis=-1) / np.linalg.norm(a, axis=-1)
        spread = np.where(angle < _BEST_ANGLE, 2.0, 8.0)
        rating = (inside * np.exp(-(((angle - _BEST_ANGLE) / spread) ** 2) - (np.log(ratio) / 0.7) ** 2)).sum(-1)
        best = np.argsort(-rating, kind="stable")[:_MAX_SOURCES]
        out.append(others[best[rating[best] > 0.01 * len(spots)]].astype(np.int32))
    return out


def _depth_quantiles(pixels: TrainingPixels, i: int) -> Array:
    """Quantiles (1, 25, 50, 75, 99 %) of z-depth [m] of frame i's sparse points, or of all frames' if it has few."""
    points = pixels.points
    own = points.frame == i
    if own.sum() < _MIN_POINTS:
        own = np.ones(len(points.frame), bool)
    x, y, _ = unproject(points.pixel[own], pixels.intrinsics[points.frame[own]]).T
    depth = points.distance[own] / np.sqrt(1.0 + x**2 + y**2)
    return np.quantile(depth, [0.01, 0.25, 0.5, 0.75, 0.99])


def _mappings(pixels: TrainingPixels, i: int, sources: NDArray[np.int32]) -> Array:
    """Mappings of frame i's pixels into its s sources, and back, shape (2, s, 3, 4).

    Pixel (u, v) of a point at a z-depth is mapped to `M[:, :3] @ (u, v, 1) + M[:, 3] / depth`: a homography
    K_to · R · K_from⁻¹ and an epipole K_to · t.
    """

    def matrix(k: Array) -> Array:
        return np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]])

    own, out = matrix(pixels.intrinsics[i]), np.zeros((2, len(sources), 3, 4))
    for k, j in enumerate(sources):
        other = matrix(pixels.intrinsics[j])
        there = inverse_pose(pixels.cameras.camera_to_world[j]) @ pixels.cameras.camera_to_world[i]
        here = inverse_pose(there)
        for way, a, b, pose in ((0, other, own, there), (1, own, other, here)):
            out[way, k, :, :3], out[way, k, :, 3] = a @ pose[:3, :3] @ np.linalg.inv(b), a @ pose[:3, 3]
    return out


def _frame_part(array: wp.array, i: int, shape: tuple[int, ...]) -> wp.array:
    """Frame i's part of an array over all frames, cropped to the frame's shape."""
    return array[i][: shape[0], : shape[1]]


def _cell_pixels(step: int, shape: tuple[int, ...]) -> Array:
    """Center pixel (u, v) of every cell, shape (rows, columns, 2)."""
    return (pixel_grid(shape[1], shape[0]) - 0.5) * step + step // 2 + 0.5


def _planes_at_points(pixels: TrainingPixels, i: int, step: int, shape: tuple[int, ...]) -> Array:
    """Fronto-parallel planes (rows, columns, 3) at the depth of the nearest sparse point; zeros without points."""
    from scipy.spatial import cKDTree

    own = pixels.points.frame == i
    out = np.zeros((*shape, 3))
    if own.any():
        pixel = pixels.points.pixel[own]
        x, y, _ = unproject(pixel, pixels.intrinsics[i]).T
        q = np.sqrt(1.0 + x**2 + y**2) / pixels.points.distance[own]
        out[..., 0] = q[cKDTree(pixel).query(_cell_pixels(step, shape).reshape(-1, 2))[1]].reshape(shape)
    return out


def _ground_planes(pixels: TrainingPixels, i: int, step: int, shape: tuple[int, ...]) -> Array:
    """The ground plane z = 0 in every cell, shape (rows, columns, 3); inverse depth ≤ 0 above the horizon."""
    pose, (fx, fy, cx, cy) = pixels.cameras.camera_to_world[i], pixels.intrinsics[i]
    height = pose[2, 3]
    # A ray at depth d reaches z = height + d · (row 3 of R) · ray, which is 0 on the ground.
    down = -pose[2, :3] / (height if height > 1e-3 else -1.0)
    grid = _cell_pixels(step, shape)
    out = np.empty((*shape, 3))
    out[..., 1], out[..., 2] = down[0] / fx, down[1] / fy
    out[..., 0] = down[2] + (grid[..., 0] - cx) * out[..., 1] + (grid[..., 1] - cy) * out[..., 2]
    return out
