"""glTF file (`.glb`) of the visual mesh with a texture baked under one lighting, from the field and from the film.

Every face has its own square of the texture, its *tile*. On the face, a *texel* (pixel of the texture) is about as
large as a pixel of the nearest rendered view. Its color is a mean over the *pictures* in which nothing of the mesh
hides its point of the face: views rendered from the radiance field, and training frames filmed under the lighting. Near
and frontal pictures have the largest weights. A frame is left out where its color differs much from the views', since
something that moved or left may hide the point. The material is unlit (KHR_materials_unlit), since filmed colors
include the light. In glTF, y points up.
"""

# mypy: disable-error-code="index, attr-defined"
# (mypy does not know the types that Warp uses inside kernels)

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image as PillowImage
from scipy.spatial import cKDTree

from twin import runtime
from twin.assets.views import Views
from twin.errors import InputError
from twin.geometry.cameras import Cameras, pixel_grid, project, unproject
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import inverse_pose
from twin.nerf.dataset import load_frame
from twin.types import Array, Image
from twin.warp_runtime import wp

VIEWS, WIDTH, FAR = 96, 640, 100.0
"""Number of rendered views, width of all pictures [px], and the z-depth where background starts [m]."""
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_SIDE = 4096  # [px] largest width and height of the texture; every viewer supports this size
_MIN_TEXEL = 0.01  # [m] least side of a texel on its face
_MAX_TILE = 256  # [px] greatest side of a face's tile
_COARSER = 1.1  # factor by which texels grow until all tiles fit
_DEPTH_TOLERANCE = 0.03  # a vertex is visible up to this relative difference from the rendered depth
_SAME_DEPTH = 0.02  # a texel is visible where its z-depth and the mesh's differ by less than this share
_MOST_DIFFERENT = 100.0  # [of 255] largest difference of a frame's color from the views', over all channels (norm)
_CHUNK = 2_000_000  # texels computed at once
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class Pictures:
    """n pictures of one size and lighting."""

    camera_to_world: Array  # shape (n, 4, 4)
    intrinsics: Array  # fx, fy, cx, cy [px], shape (n, 4)
    rgb: NDArray[np.uint8]  # shape (n, h, w, 3)
    masks: NDArray[np.bool_]  # pixels to use, shape (n, h, w)


def filmed_frames(cameras: Cameras, lighting: str) -> list[Pictures]:
    """The training frames filmed under a lighting, each at most `WIDTH` wide; none if the scene lacks its films."""
    frames = []
    for i in np.flatnonzero(~cameras.held_out & (np.array(cameras.lightings) == lighting)).tolist():
        if cameras.image_path(i).exists():
            rgb, mask, intrinsics = load_frame(cameras, i, WIDTH)
            frames.append(Pictures(cameras.camera_to_world[i : i + 1], intrinsics[None], rgb[None], mask[None]))
    return frames


def textured_glb(vertices: Array, faces: NDArray, views: Views, frames: Sequence[Pictures] = ()) -> bytes:
    """The `.glb` of a mesh with vertices (v, 3) [m] and faces (f, 3), its texture baked from pictures of one lighting.

    Raises:
        InputError: no view shows the mesh.
    """
    texture, coordinates = bake(vertices, faces, views, frames)
    encoded = io.BytesIO()
    PillowImage.fromarray(texture).save(encoded, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    picture = PillowImage.open(encoded)
    # trimesh would encode the picture again, at Pillow's default quality.
    picture.save = lambda file, **_: file.write(encoded.getvalue())  # type: ignore[method-assign]
    material = trimesh.visual.material.PBRMaterial(
        name="baked", baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0
    )
    corners = faces.ravel()
    uv = coordinates.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]  # trimesh measures v from the bottom
    surface = trimesh.Trimesh(
        vertices[corners],
        np.arange(len(corners)).reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    surface.apply_transform(_Z_UP_TO_Y_UP)

    def unlit(tree: dict[str, Any]) -> None:
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        for one in tree["materials"]:
            one["extensions"] = {"KHR_materials_unlit": {}}

    return trimesh.exchange.gltf.export_glb(trimesh.Scene(surface), tree_postprocessor=unlit)


def bake(
    vertices: Array, faces: NDArray, views: Views, frames: Sequence[Pictures] = ()
) -> tuple[Image, NDArray[np.float64]]:
    """Returns the texture (h, w, 3) and texture coordinates (f, 3, 2) of the faces' corners: u from left, v from top.

    Raises:
        InputError: no view shows the mesh.
    """
    corner, order = _turned(vertices[faces])
    side, x, y, size = _tiles(corner, views)
    height = int((y + side).max())
    texture = np.zeros((height, size, 3), np.uint8)
    u_axis, v_axis = ((corner[:, k] - corner[:, 0]) / (side - 1)[:, None] for k in (1, 2))
    normal = np.cross(u_axis, v_axis)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    rendered = Pictures(views.camera_to_world, views.intrinsics, views.rgb, np.ones(views.depth.shape, bool))
    surface = Surface(vertices, faces)
    with runtime.bar("visible faces", len(views) + len(frames), "picture") as bar:
        uploaded = [_upload_pictures(pictures, surface, bar.update) for pictures in (rendered, *frames)]
    means = np.full((len(faces), 3), np.nan)
    counts = side**2
    start = 0
    while start < len(faces):
        stop = max(start + 1, int(np.searchsorted(np.cumsum(counts[start:]), _CHUNK)) + start)
        own = np.repeat(np.arange(start, stop), counts[start:stop])
        within = np.arange(len(own)) - np.repeat(np.cumsum(counts[start:stop]) - counts[start:stop], counts[start:stop])
        j, i = np.divmod(within, side[own])
        points = corner[own, 0] + i[:, None] * u_axis[own] + j[:, None] * v_axis[own]
        rgb, weight = _colors(uploaded, points, normal[own])
        seen = weight > 0.0
        n = np.bincount(own[seen] - start, minlength=stop - start)
        total = np.stack([np.bincount(own[seen] - start, rgb[seen, c], stop - start) for c in range(3)], 1)
        with np.errstate(invalid="ignore"):
            means[start:stop] = total / n[:, None]
        # Texels that no view shows get the mean color of their face; faces that no view shows get
        # the color of the nearest face.
        rgb[~seen] = np.nan_to_num(means[own[~seen]], nan=-1.0)
        texture[y[own] + j, x[own] + i] = np.clip(rgb + 0.5, 0, 255).astype(np.uint8)
        start = stop
    bare = np.isnan(means[:, 0])
    if bare.all():
        raise InputError("no view of the field shows the mesh; build the scene again")
    centers = corner.mean(1)
    near = means[~bare][cKDTree(centers[~bare]).query(centers[bare])[1]]
    for k, color in zip(np.flatnonzero(bare), near, strict=True):
        texture[y[k] : y[k] + side[k], x[k] : x[k] + side[k]] = color + 0.5
    low = np.stack([x, y], 1) + 0.5
    ends = np.stack([low, low + np.stack([side - 1, 0 * side], 1), low + np.stack([0 * side, side - 1], 1)], 1)
    coordinates = np.empty((len(faces), 3, 2))
    np.put_along_axis(coordinates, order[:, :, None], ends / [size, height], 1)
    return texture, coordinates


def _turned(corners: Array) -> tuple[Array, NDArray[np.int64]]:
    """Corners (f, 3, 3), rotated so that the first is opposite the longest edge, and their former indices (f, 3)."""
    edges = np.linalg.norm(np.roll(corners, -1, 1) - np.roll(corners, 1, 1), axis=-1)
    order = (np.argmax(edges, 1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(corners, order[:, :, None], 1).astype(np.float64), order


def _tiles(corner: Array, views: Views) -> tuple[NDArray[np.int64], NDArray, NDArray, int]:
    """Sides (f,) of the tiles, their left and top edges, and the texture's width [px].

    Texels are as large as a pixel of the nearest view, or larger so that all tiles fit.
    """
    legs = np.linalg.norm(corner[:, 1:] - corner[:, :1], axis=-1).max(1)
    nearest = cKDTree(views.camera_to_world[:, :3, 3]).query(corner.mean(1))[0]
    texel = np.maximum(nearest / views.intrinsics[:, 0].mean(), _MIN_TEXEL)
    while True:
        side = np.clip(np.ceil(legs / texel).astype(np.int64) + 1, 2, _MAX_TILE)
        if (side**2).sum() < _SIDE**2 or (side == 2).all():
            x, y, width = pack_tiles(side)
            if (y + side).max() <= _SIDE or (side == 2).all():
                return side, x, y, width
        texel = texel * _COARSER


def pack_tiles(side: NDArray[np.int64]) -> tuple[NDArray, NDArray, int]:
    """Places square tiles in rows, the largest first; returns their left and top edges, and the total width [px]."""
    width = max(_SIDE if (side**2).sum() > _SIDE**2 / 4 else _SIDE // 2, int(side.max()))
    x, y = np.empty_like(side), np.empty_like(side)
    left = top = 0
    row = int(side.max())
    for k in np.argsort(-side, kind="stable").tolist():
        n = int(side[k])
        if left + n > width:
            left, top, row = 0, top + row, n
        x[k], y[k] = left, top
        left += n
    return x, y, width


@wp.kernel
def _gather(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    world_to_camera: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    rgb: wp.array4d[wp.uint8],
    depth: wp.array3d[float],
    wanted: wp.array[wp.vec3],
    most_different: float,
    colors: wp.array[wp.vec3],
    weights: wp.array[float],
):
    t = wp.tid()
    height, width = depth.shape[1], depth.shape[2]
    for i in range(depth.shape[0]):
        local = wp.transform_point(world_to_camera[i], points[t])
        z = local[2]
        k = intrinsics[i]
        if z > 0.05:
            u = k[0] * local[0] / z + k[2] - 0.5
            v = k[1] * local[1] / z + k[3] - 0.5
            if u >= 0.0 and v >= 0.0 and u < float(width - 1) and v < float(height - 1):
                a, b = int(u), int(v)
                x, y = u - float(a), v - float(b)
                color = wp.vec3(0.0)
                visible = float(0.0)
                for dv in range(2):
                    for du in range(2):
                        if wp.abs(depth[i, b + dv, a + du] - z) < _SAME_DEPTH * z:
                            part = (x if du == 1 else 1.0 - x) * (y if dv == 1 else 1.0 - y) + 1.0e-3
                            visible += part
                            color += part * wp.vec3(
                                float(rgb[i, b + dv, a + du, 0]),
                                float(rgb[i, b + dv, a + du, 1]),
                                float(rgb[i, b + dv, a + du, 2]),
                            )
                if visible > 0.0:
                    mean = color / visible
                    if wp.length(mean - wanted[t]) < most_different:
                        facing = wp.dot(wp.transform_vector(world_to_camera[i], normals[t]), wp.normalize(local))
                        share = wp.max(wp.abs(facing), 0.02) / (z * z)
                        colors[t] += share * mean
                        weights[t] += share


def _upload(values: NDArray, kind: Any) -> Any:
    return wp.array(np.ascontiguousarray(values), dtype=kind, device="cpu")


def _upload_pictures(pictures: Pictures, mesh: Surface, told: Callable[[], object]) -> list[Any]:
    """Pictures as Warp arrays: poses (world to camera), intrinsics, colors, and z-depth of the mesh, 0 where masked.

    Calls `told` after each picture.
    """
    shape = pictures.masks.shape
    depth = np.empty(shape, np.float32)
    for i, (pose, intrinsics) in enumerate(zip(pictures.camera_to_world, pictures.intrinsics, strict=True)):
        rays = unproject(pixel_grid(shape[2], shape[1]), intrinsics).reshape(-1, 3) @ pose[:3, :3].T
        depth[i] = mesh.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays).reshape(shape[1:])
        told()
    inverse = np.stack([inverse_pose(pose) for pose in pictures.camera_to_world])
    kinds = ((inverse, wp.mat44), (pictures.intrinsics, wp.vec4), (depth * pictures.masks, float))
    poses, intrinsics, depth = (_upload(values.astype(np.float32), kind) for values, kind in kinds)
    return [poses, intrinsics, _upload(pictures.rgb, wp.uint8), depth]


def _colors(uploaded: list[list[Any]], points: Array, normals: Array) -> tuple[NDArray, NDArray[np.float32]]:
    """Colors (k, 3) in [0, 255] of points (k, 3) with unit normals, and weights (k,), 0 for unseen points.

    The first element of `uploaded` has the rendered views, the others have the frames.
    """
    count = len(points)
    given = [_upload(x.astype(np.float32), wp.vec3) for x in (points, normals)]
    out = [wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=float, device="cpu")]
    views, *frames = uploaded
    wp.launch(_gather, count, [*given, *views, wp.zeros_like(out[0]), np.inf], out, device="cpu")
    shown, weight = (values.numpy() for values in out)
    # A point that no view shows has no color to compare with, so no frame may show it, either.
    shown = np.where(weight[:, None] > 0.0, shown / np.maximum(weight, 1e-20)[:, None], np.inf)
    wanted = _upload(shown.astype(np.float32), wp.vec3)
    for frame in frames:
        wp.launch(_gather, count, [*given, *frame, wanted, _MOST_DIFFERENT], out, device="cpu")
    total, weight = (values.numpy() for values in out)
    return total / np.maximum(weight, 1e-20)[:, None], weight


def vertex_colors(views: Views, vertices: Array) -> NDArray[np.uint8]:
    """Colors of vertices (k, 3) [m]: means over views weighted by 1 / depth², shape (k, 3).

    A vertex that no view shows has the color of the nearest one that a view shows.
    """
    height, width = views.depth.shape[1:]
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for i in range(len(views)):
        pixel, depth = project(vertices, views.camera_to_world[i], views.intrinsics[i])
        u, v = np.floor(np.nan_to_num(pixel, nan=-1.0).clip(-1.0, 1e6)).astype(int).T
        inside = np.flatnonzero((depth > 0.0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))
        rendered = views.depth[i, v[inside], u[inside]]
        visible = inside[np.abs(rendered - depth[inside]) < _DEPTH_TOLERANCE * depth[inside]]
        share = 1.0 / depth[visible] ** 2
        total[visible] += share[:, None] * views.rgb[i, v[visible], u[visible]]
        weight[visible] += share
    known = weight > 0.0
    if not known.any():
        raise InputError("no view of the field shows the mesh; build the scene again")
    colors = total / np.maximum(weight, 1e-12)[:, None]
    colors[~known] = colors[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return (colors + 0.5).astype(np.uint8)
