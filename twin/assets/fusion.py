"""Depth maps into a truncated signed distance field, and colours on to points: the loops over voxels × views.

*Signed distance* [m] is positive in free space, negative behind a surface, and believed within ± `band` of it only.
Each view votes at each voxel: `near` where its surface passes within the band, `free` where it looks further. A surface
that few views make and many look through is a floater, and their votes outweigh it (Curless & Levoy 1996, eqs. 3 and 4,
with free space counted in). The ramp that a field leaves between the rim of a thing and what is behind it is seen
edge-on, where votes count next to nothing; so views that look past it from elsewhere, even from far away, clear it.
"""

# mypy: disable-error-code="index, attr-defined"
# (inside kernels, Warp's own types hold, which mypy does not know)

import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.assets.views import Views
from twin.geometry.poses import inverse_pose

wp.config.log_level = wp.LOG_ERROR  # compiling is announced by our own bars

Array = NDArray[np.float64]

LOOK_THROUGH = 2.5  # a view says what is free this many times further than it says where a surface is
_FADE = 5.0  # [m] depth at which a view's vote counts half: its pixels and its errors have grown
_CLEARANCE = 0.1  # share of the depth a surface beyond that reach must lie behind what it is to leave free
_ONE_SURFACE = 1.1  # neighbouring pixels whose depths differ by more than this ratio belong to two


@wp.func
def _look(point: wp.vec3, pose: wp.mat44, k: wp.vec4):
    """Pixel (u, v) and depth of a world point."""
    local = wp.transform_point(pose, point)
    z = wp.max(local[2], 1.0e-6)
    return wp.vec3(k[0] * local[0] / z + k[2], k[1] * local[1] / z + k[3], local[2])


@wp.kernel
def _fuse(
    points: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
    slant: wp.array3d[wp.float32],
    far: float,
    band: float,
    reach: float,
    fade: float,
    clearance: float,
    one_surface: float,
    distance: wp.array[wp.float32],
    near: wp.array[wp.float32],
    free: wp.array[wp.float32],
):
    i = wp.tid()
    point = points[i]
    height = depth.shape[1]
    width = depth.shape[2]
    total = float(0.0)
    near_votes = float(0.0)
    free_votes = float(0.0)
    for view in range(depth.shape[0]):
        seen = _look(point, world_to_camera[view], intrinsics[view])
        z = seen[2]
        if z > 0.35 and z < reach:
            u = seen[0] - 0.5
            v = seen[1] - 0.5
            if u >= 0.0 and v >= 0.0 and u < float(width - 1) and v < float(height - 1):
                column = int(u)
                row = int(v)
                nearest_row = int(v + 0.5)
                nearest_column = int(u + 0.5)
                a = depth[view, row, column]
                b = depth[view, row, column + 1]
                c = depth[view, row + 1, column]
                d = depth[view, row + 1, column + 1]
                low = wp.min(wp.min(a, b), wp.min(c, d))
                high = wp.max(wp.max(a, b), wp.max(c, d))
                surface = depth[view, nearest_row, nearest_column]
                if low > 0.0 and high < one_surface * low:
                    # One surface: inverse depth is bilinear on it.
                    s = u - float(column)
                    t = v - float(row)
                    surface = 1.0 / ((1.0 - t) * ((1.0 - s) / a + s / b) + t * ((1.0 - s) / c + s / d))
                if surface > 0.0:
                    away = (surface - z) * slant[view, nearest_row, nearest_column]
                    weight = 1.0 / (1.0 + (z / fade) * (z / fade))
                    if away >= band and (z < far or surface - z > clearance * z):
                        free_votes += weight
                    elif away < band and away > -band and z < far:
                        lean = wp.min(slant[view, nearest_row, nearest_column], 1.0)
                        weight *= lean * lean
                        near_votes += weight
                        total += weight * away
    near[i] = near_votes
    free[i] = free_votes
    if near_votes > 0.0:
        distance[i] = (total + band * free_votes) / (near_votes + free_votes)


@wp.kernel
def _colour(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    eyes: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    depth: wp.array3d[wp.float32],
    rgb: wp.array4d[wp.uint8],
    tolerance: float,
    colours: wp.array[wp.vec3],
    found: wp.array[wp.float32],
):
    i = wp.tid()
    point = points[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    weights = float(0.0)
    for view in range(depth.shape[0]):
        seen = _look(point, world_to_camera[view], intrinsics[view])
        z = seen[2]
        # Only what faces the lens is seen; 0.1 (6°) keeps the walls beside a forward-looking camera.
        if z > 0.35 and wp.dot(normals[i], wp.normalize(eyes[view] - point)) > 0.1:
            column = int(wp.floor(seen[0]))
            row = int(wp.floor(seen[1]))
            if column >= 0 and row >= 0 and column < depth.shape[2] and row < depth.shape[1]:
                surface = depth[view, row, column]
                if surface > 0.0 and wp.abs(surface - z) < tolerance + 0.05 * z:
                    # Sharpest where nearest: the fourth power lets the few nearest views decide.
                    weight = 1.0 / (z * z * z * z)
                    pixel = wp.vec3(
                        float(rgb[view, row, column, 0]),
                        float(rgb[view, row, column, 1]),
                        float(rgb[view, row, column, 2]),
                    )
                    total += weight * pixel
                    weights += weight
    if weights > 0.0:
        colours[i] = total / weights
        found[i] = 1.0


def fuse(points: Array, views: Views, band: float, far: float) -> tuple[NDArray, NDArray, NDArray]:
    """Votes of all views at points (k, 3), each (k,): signed distance [m] (NaN where no surface is), near and free.

    Surfaces are believed up to the depth `far` [m], free space up to `LOOK_THROUGH` times as far.
    """
    device = "cpu"
    distance = wp.full(len(points), float("nan"), dtype=wp.float32, device=device)
    near = wp.zeros(len(points), dtype=wp.float32, device=device)
    free = wp.zeros(len(points), dtype=wp.float32, device=device)
    slant: wp.array = wp.array(views.slant, dtype=wp.float32, device=device)
    inputs = [*_cameras(points, views, device), slant, far, band, LOOK_THROUGH * far, _FADE, _CLEARANCE, _ONE_SURFACE]
    wp.launch(_fuse, len(points), inputs, [distance, near, free], device=device)
    return distance.numpy(), near.numpy(), free.numpy()


def colour(
    points: Array, normals: Array, views: Views, tolerance: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (k, 3) of surface points (k, 3) with normals (k, 3) from the nearest views, and whether any sees it (k,).

    A view sees a point that faces it and lies within `tolerance` [m] and 5 % of its depth.
    """
    device = "cpu"
    colours = wp.zeros(len(points), dtype=wp.vec3, device=device)
    found = wp.zeros(len(points), dtype=wp.float32, device=device)
    rgb: wp.array = wp.array(views.rgb, dtype=wp.uint8, device=device)
    where, *cameras = _cameras(points, views, device)
    turned: wp.array = wp.array(np.asarray(normals, np.float32), dtype=wp.vec3, device=device)
    eyes: wp.array = wp.array(views.camera_to_world[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    inputs = [where, turned, eyes, *cameras, rgb, tolerance]
    wp.launch(_colour, len(points), inputs, [colours, found], device=device)
    return (colours.numpy() + 0.5).astype(np.uint8), found.numpy() > 0


def _cameras(points: Array, views: Views, device: str) -> list[wp.array]:
    return [
        wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device),
        wp.array(inverse_pose(views.camera_to_world).astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(views.intrinsics.astype(np.float32), dtype=wp.vec4, device=device),
        wp.array(views.depth, dtype=wp.float32, device=device),
    ]
