"""Joins two reconstructions of one road by matching the ground as it looks from above.

Films in opposite directions have no view in common, so their frames do not match, and COLMAP reconstructs them
separately. From above, however, the ground has the same texture in both. Each reconstruction is a *part*. For each part
a *ground picture* is composed of its frames: a map of the ground, with a pixel size of 2 % of the camera's height above
the road. SIFT features of both pictures are matched. A match belongs to a pixel of a frame in each part, and so to a
ray in each part. The similarity between the parts makes both rays of a match meet at the ground.

*Level frame* of a part: z up, unit = height of the camera above the road. Lengths in this file are in this unit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from twin.capture.gravity import up_from_ground
from twin.geometry.poses import Similarity, inverse_pose
from twin.types import Array

_PIXEL, _MAX_PIXEL = 0.02, 0.05  # side of a ground picture's pixel; it is larger on a long road
_NEAR, _FAR, _ASIDE = 1.0, 5.0, 3.5  # the ground that is taken from a frame: range ahead; width to each side
_MAX_PIXELS = 1.2e7  # largest size of a ground picture; SIFT takes 0.24 GB per million pixels
_FEATURES = 20_000  # most SIFT features of a ground picture
_CONTRAST = 0.015  # SIFT's threshold; asphalt has little contrast
_RATIO = 0.85  # largest distance of the best match, relative to the second best one
_TOLERANCE = 0.35  # largest error of a match under a similarity of the maps; relief displaces the two views oppositely
_MIN_MATCHES = 25  # fewer matches may agree on a similarity by chance
_MIN_EXTENT = 5.0  # least extent of the matches; one manhole cover looks like another
_STEEPEST = 0.5  # ground that seems to rise or fall by more than this within a frame is left out
_MAX_SCALE = 1.3  # largest ratio of the two camera heights
_RAY_SIGMA, _HEIGHT_SIGMA = 0.02, 0.01  # standard deviations of the distance of two rays and of the road's height
_AROUND, _MIN_AROUND = 1.5, 4  # radius and least number of the road points that give the height of a ground point
_SAME_RAY = 1e-3  # [focal lengths] largest change of a ray that is projected and then unprojected
_OUTLIER = 3.0  # [standard deviations] scale of the robust loss

FrameReader = Callable[[int], tuple[NDArray[np.uint8], NDArray[np.uint8] | None]]
"""Reads a frame by its index in the capture: gray picture (h, w), and mask (h, w) or None; 0 = ignore."""


@dataclass(frozen=True)
class Part:
    """A reconstruction of n frames."""

    frames: NDArray[np.int64]  # indices of the frames in the capture, shape (n,)
    camera_to_world: Array  # poses in the reconstruction's frame and unit, shape (n, 4, 4)
    points: Array  # sparse points, shape (m, 3)
    cameras: list[pycolmap.Camera]  # camera of each frame, with distortion
    lightings: list[str]  # lighting of each frame


@dataclass(frozen=True)
class _GroundPicture:
    """Map of the ground of the frames of one lighting."""

    gray: NDArray[np.uint8]  # shape (rows, columns); x grows with the column and y with the row
    owner: NDArray[np.int32]  # frame of each pixel, as an index into the part's frames; −1: not seen
    origin: Array  # x, y of the corner of the first pixel, shape (2,)
    pixel: float  # side of a pixel


def join(a: Part, b: Part, read_frame: FrameReader) -> Similarity | None:
    """The similarity from the frame of part b to that of part a; None if their grounds do not match."""
    levels = _level_frame(a), _level_frame(b)
    if levels[0] is None or levels[1] is None:
        return None
    (level_a, road_a), (level_b, road_b) = levels[0], levels[1]
    poses_a, poses_b = level_a.poses(a.camera_to_world), level_b.poses(b.camera_to_world)
    common = set(a.lightings) & set(b.lightings)
    pairs = [(one, one) for one in common] or [(one, two) for one in set(a.lightings) for two in set(b.lightings)]
    found: list[tuple[Array, Array, Array, Array]] = []  # matched points (k, 2), rays (k, 6) of pairs of pictures
    for one, two in sorted(pairs):
        picture_a = _ground_picture(a, poses_a, one, read_frame)
        picture_b = _ground_picture(b, poses_b, two, read_frame)
        if picture_a and picture_b:
            xy_a, xy_b = _matches(picture_a, picture_b)
            rays = _rays(picture_a, xy_a, poses_a, road_a), _rays(picture_b, xy_b, poses_b, road_b)
            found.append((xy_a, xy_b, *rays))
    fits = [_planar_similarity(xy_b, xy_a) for xy_a, xy_b, *_ in found]
    count, planar = max(fits, key=lambda fit: fit[0], default=(0, np.eye(3)))
    if count < _MIN_MATCHES:
        return None
    xy_a, xy_b, rays_a, rays_b = map(np.concatenate, zip(*found, strict=True))
    near = np.linalg.norm(xy_b @ planar[:2, :2].T + planar[:2, 2] - xy_a, axis=1) < _TOLERANCE
    if max(np.ptp(xy_a[near], axis=0)) < _MIN_EXTENT:
        return None
    return level_a.inverse() @ _meeting_similarity(rays_a[near], rays_b[near], planar) @ level_b


def _level_frame(part: Part) -> tuple[Similarity, Array] | None:
    """The similarity to the part's level frame, and its road points (k, 3) there; None if it has no road."""
    gravity, road = up_from_ground(part.camera_to_world, part.points)
    if road is None:
        return None
    up = gravity.direction
    # x along the road makes the ground picture of a straight road narrow.
    centers = part.camera_to_world[:, :3, 3] - part.camera_to_world[:, :3, 3].mean(0)
    flat = centers - np.outer(centers @ up, up)
    x_axis = np.linalg.svd(flat, full_matrices=False)[2][0]
    x_axis = x_axis - (x_axis @ up) * up
    if np.linalg.norm(x_axis) < 0.5:
        return None
    x_axis /= np.linalg.norm(x_axis)
    rotation = np.stack([x_axis, np.cross(up, x_axis), up])
    level = Similarity(1.0 / road.drop, rotation, np.zeros(3))
    return level, level.points(part.points[road.points])


def _slopes(poses: Array) -> Array:
    """Slope of the path in the viewing direction at each frame, shape (n,); poses (n, 4, 4) in the level frame."""
    centers, forward = poses[:, :3, 3], poses[:, :3, 2]
    out = np.zeros(len(poses))
    for k in range(len(poses)):
        ahead = forward[k, :2] / max(float(np.linalg.norm(forward[k, :2])), 1e-9)
        offset = centers - centers[k]
        along = offset[:, :2] @ ahead
        near = (np.abs(along) < _FAR) & (np.linalg.norm(offset[:, :2], axis=1) < _FAR)
        if np.ptp(along[near]) > 1.0:
            out[k] = np.polyfit(along[near], offset[near, 2], 1)[0]
    return out


def _ground_picture(part: Part, poses: Array, lighting: str, read_frame: FrameReader) -> _GroundPicture | None:
    """The ground as the frames of a lighting show it; None without such frames, or if the ground is too large."""
    chosen = [k for k, one in enumerate(part.lightings) if one == lighting]
    if not chosen:
        return None
    centers = poses[chosen, :2, 3]
    low, high = centers.min(0) - _FAR - _ASIDE, centers.max(0) + _FAR + _ASIDE
    pixel = max(_PIXEL, float(np.sqrt(np.prod(high - low) / _MAX_PIXELS)))
    if pixel > _MAX_PIXEL:
        return None
    columns, rows = np.ceil((high - low) / pixel).astype(int).tolist()
    slopes = _slopes(poses)
    gray = np.zeros((rows, columns), np.uint8)
    owner = np.full((rows, columns), -1, np.int32)
    nearest = np.full((rows, columns), np.inf, np.float32)
    for k in chosen:
        center, forward = poses[k, :3, 3], poses[k, :2, 2]
        ahead = forward / max(float(np.linalg.norm(forward)), 1e-9)
        left = np.array([-ahead[1], ahead[0]])
        corners = center[:2] + np.array([x * ahead + y * left for x in (_NEAR, _FAR) for y in (-_ASIDE, _ASIDE)])
        c0, r0 = np.floor((corners.min(0) - low) / pixel).astype(int)
        c1, r1 = np.ceil((corners.max(0) - low) / pixel).astype(int)
        x, y = np.meshgrid(low[0] + (np.arange(c0, c1) + 0.5) * pixel, low[1] + (np.arange(r0, r1) + 0.5) * pixel)
        offset = np.stack([x - center[0], y - center[1]], -1)
        along, aside = offset @ ahead, offset @ left
        window = slice(r0, r1), slice(c0, c1)
        rise = slopes[k] * along
        take = (np.abs(rise) < _STEEPEST) & (np.abs(aside) < _ASIDE)
        take &= (along > _NEAR) & (along < _FAR) & (along < nearest[window])
        ground = np.stack([x, y, center[2] - 1.0 + rise], -1)
        camera = part.cameras[k]
        pixels = np.full((*x.shape, 2), -1.0)
        pixels[take] = _project(ground[take], poses[k], camera)
        take &= (pixels > 0.0).all(-1) & (pixels < np.array([camera.width, camera.height]) - 1.0).all(-1)
        column, row = (pixels.astype(np.float32) - np.float32(0.5)).transpose(2, 0, 1)
        picture, valid = read_frame(int(part.frames[k]))
        values = cv2.remap(picture, column, row, cv2.INTER_LINEAR)
        if valid is not None:
            take &= cv2.remap(valid, column, row, cv2.INTER_NEAREST) > 0
        gray[window][take] = values[take]
        owner[window][take] = k
        nearest[window][take] = along[take]
    return _GroundPicture(gray, owner, low, pixel)


def _project(points: Array, pose: Array, camera: pycolmap.Camera) -> Array:
    """Pixels (k, 2) of points (k, 3) under a camera with distortion; −1 for points that it does not see."""
    to_camera = inverse_pose(pose)
    local = points @ to_camera[:3, :3].T + to_camera[:3, 3]
    out = np.full((len(points), 2), -1.0)
    front = np.flatnonzero(local[:, 2] > 0.05)
    if not len(front):
        return out
    pixels = np.asarray(camera.img_from_cam(local[front])).reshape(-1, 2)
    # A distortion model may project rays from far outside the picture into it. Unprojection then gives another ray.
    rays = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
    same = np.abs(rays - local[front, :2] / local[front, 2:]).max(1) < _SAME_RAY
    out[front[same]] = pixels[same]
    return out


def _matches(a: _GroundPicture, b: _GroundPicture) -> tuple[Array, Array]:
    """Points x, y of mutual matches between the features of two ground pictures, shapes (k, 2)."""
    sift = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=_CONTRAST)
    found = []
    for picture in (a, b):
        mask = cv2.erode((picture.owner >= 0).astype(np.uint8), np.ones((9, 9), np.uint8))
        keys, descriptors = sift.detectAndCompute(picture.gray, mask)
        xy = np.array([key.pt for key in keys], np.float64).reshape(-1, 2)
        found.append((picture.origin + (xy + 0.5) * picture.pixel, descriptors))
    (xy_a, descriptors_a), (xy_b, descriptors_b) = found
    if descriptors_a is None or descriptors_b is None or min(len(xy_a), len(xy_b)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    two = matcher.knnMatch(descriptors_a, descriptors_b, k=2)
    forth = {best.queryIdx: best.trainIdx for best, second in two if best.distance < _RATIO * second.distance}
    back = {m.queryIdx: m.trainIdx for (m,) in matcher.knnMatch(descriptors_b, descriptors_a, k=1)}
    mutual = np.array([(i, j) for i, j in forth.items() if back[j] == i], np.int64).reshape(-1, 2)
    return xy_a[mutual[:, 0]], xy_b[mutual[:, 1]]


def _planar_similarity(source: Array, target: Array) -> tuple[int, Array]:
    """Number of points that one similarity of the plane maps within `_TOLERANCE`, and its matrix (3, 3)."""
    if len(source) < 3:
        return 0, np.eye(3)
    matrix, inliers = cv2.estimateAffinePartial2D(
        source, target, ransacReprojThreshold=_TOLERANCE, maxIters=20_000, confidence=0.9999
    )
    if matrix is None:
        return 0, np.eye(3)
    scale = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    plausible = 1.0 / _MAX_SCALE < scale < _MAX_SCALE
    return int(inliers.sum()) if plausible else 0, np.vstack([matrix, [0.0, 0.0, 1.0]])


def _rays(picture: _GroundPicture, xy: Array, poses: Array, road: Array) -> Array:
    """Rays to points (k, 2) of a ground picture: center of the frame's camera, and the ground point; shape (k, 6).

    The height of a ground point is that of the road points (m, 3) around it, if there are enough of them.
    """
    column, row = np.floor((xy - picture.origin) / picture.pixel).astype(int).T
    frame = picture.owner[row, column]
    center = poses[frame, :3, 3]
    forward = poses[frame, :2, 2] / np.linalg.norm(poses[frame, :2, 2], axis=1, keepdims=True)
    along = ((xy - center[:, :2]) * forward).sum(1)
    drawn = center[:, 2] - 1.0 + _slopes(poses)[frame] * along  # the height with which the picture was composed
    height = drawn.copy()
    for k, near in enumerate(cKDTree(road[:, :2]).query_ball_point(xy, _AROUND)):
        if len(near) >= _MIN_AROUND:
            height[k] = np.median(road[near, 2])
    # The point moves along its ray to the height of the road.
    direction = np.column_stack([xy, drawn]) - center
    return np.concatenate([center, center + direction * ((height - center[:, 2]) / direction[:, 2])[:, None]], 1)


def _meeting_similarity(a: Array, b: Array, planar: Array) -> Similarity:
    """The similarity from b to a under which the rays (k, 6) of each match meet at the road of both parts.

    `planar` (3, 3) is the first estimate. Opposite rays meet at any displacement along the road, at different heights,
    so the heights of the meeting points determine this displacement.
    """
    scale = float(np.hypot(planar[0, 0], planar[1, 0]))
    turn = float(np.arctan2(planar[1, 0], planar[0, 0]))
    lift = float(np.median(a[:, 5] - scale * b[:, 5]))
    middle = np.array([*(b[:, 3:5] @ planar[:2, :2].T + planar[:2, 2]).mean(0), 0.0])

    def similarity(x: Array) -> Similarity:
        """The similarity with parameters x: log scale, tilt about the middle of the road, turn, translation."""
        tilt = Rotation.from_rotvec([x[1], x[2], 0.0]).as_matrix()
        rotation = tilt @ Rotation.from_rotvec([0.0, 0.0, x[3]]).as_matrix()
        return Similarity(float(np.exp(x[0])), rotation, tilt @ (x[4:] - middle) + middle)

    def residuals(x: Array) -> Array:
        there = similarity(x)
        eye_a, eye_b = a[:, :3], there.points(b[:, :3])
        ray_a, ray_b = a[:, 3:] - eye_a, there.points(b[:, 3:]) - eye_b
        gap = eye_b - eye_a
        normal = np.cross(ray_a, ray_b)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        # The points where the rays are closest are eye_a + s ray_a and eye_b + t ray_b; s = t = 1 on the road.
        aa, bb, ab = (ray_a**2).sum(1), (ray_b**2).sum(1), (ray_a * ray_b).sum(1)
        ga, gb = (gap * ray_a).sum(1), (gap * ray_b).sum(1)
        sine = np.maximum(aa * bb - ab**2, 1e-9)
        s, t = (ga * bb - gb * ab) / sine, (ga * ab - gb * aa) / sine
        apart = (gap * normal).sum(1)
        above_a, above_b = (s - 1.0) * ray_a[:, 2], (t - 1.0) * ray_b[:, 2]
        return np.concatenate([apart / _RAY_SIGMA, above_a / _HEIGHT_SIGMA, above_b / _HEIGHT_SIGMA])

    start = np.array([np.log(scale), 0.0, 0.0, turn, planar[0, 2], planar[1, 2], lift])
    return similarity(least_squares(residuals, start, loss="soft_l1", f_scale=_OUTLIER).x)
