"""glTF file (`.glb`) of the visual mesh with a texture baked from the radiance field under one lighting.

Every face has its own square of the texture, its *tile*. On the face, a *texel* (pixel of the texture) is about as
large as a pixel of the nearest rendered view. Its color is a mean over the views that show its point of the face; near
and frontal views have the largest weights. The material is unlit (KHR_materials_unlit), since filmed colors include the
light. In glTF, y points up.
"""

# mypy: disable-error-code="index, attr-defined"
# (mypy does not know the types that Warp uses inside kernels)

import io
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image as PillowImage
from scipy.spatial import cKDTree

from twin.assets.views import Views
from twin.errors import InputError
from twin.geometry.cameras import project
from twin.geometry.poses import inverse_pose
from twin.types import Array, Image
from twin.warp_runtime import wp

VIEWS, WIDTH, FAR = 96, 640, 100.0
"""Number of views that the texture is baked from, their width [px], and the z-depth where background starts [m]."""
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_SIDE = 4096  # [px] largest width of the texture; every viewer supports this size
_MIN_TEXEL = 0.01  # [m] least side of a texel on its face
_MAX_TILE = 256  # [px] greatest side of a face's tile
_COARSER = 1.1  # factor by which texels grow until all tiles fit
_DEPTH_TOLERANCE = 0.03  # a vertex is visible up to this relative difference from the rendered depth
# Larger for texels: the mesh is smoother than the field, so a face may lie before or behind the surface in a view.
_TEXEL_TOLERANCE = 0.08
_SHARPNESS = 2.0  # a view's weight is this power of cos(angle between ray and normal) / depth²
_CHUNK = 2_000_000  # texels computed at once
_JPEG_QUALITY = 95


def textured_glb(vertices: Array, faces: NDArray, views: Views) -> bytes:
    """The `.glb` of a mesh with vertices (v, 3) [m] and faces (f, 3), its texture baked from views of one lighting.

    Raises:
        InputError: no view shows the mesh.
    """
    texture, coordinates = bake(vertices, faces, views)
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


def bake(vertices: Array, faces: NDArray, views: Views) -> tuple[Image, NDArray[np.float64]]:
    """Returns the texture (h, w, 3) and texture coordinates (f, 3, 2) of the faces' corners: u from left, v from top.

    Raises:
        InputError: no view shows the mesh.
    """
    corner, order = _turned(vertices[faces])
    side = _tile_sides(corner, views)
    x, y, size = pack_tiles(side)
    height = int((y + side).max())
    texture = np.zeros((height, size, 3), np.uint8)
    u_axis, v_axis = ((corner[:, k] - corner[:, 0]) / (side - 1)[:, None] for k in (1, 2))
    normal = np.cross(u_axis, v_axis)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    uploaded = _upload_views(views)
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


def _tile_sides(corner: Array, views: Views) -> NDArray[np.int64]:
    """Sides (f,) of the tiles [px]: texels are as large as a pixel of the nearest view, or larger so that all fit."""
    legs = np.linalg.norm(corner[:, 1:] - corner[:, :1], axis=-1).max(1)
    nearest = cKDTree(views.camera_to_world[:, :3, 3]).query(corner.mean(1))[0]
    texel = np.maximum(nearest / views.intrinsics[:, 0].mean(), _MIN_TEXEL)
    while True:
        side = np.clip(np.ceil(legs / texel).astype(np.int64) + 1, 2, _MAX_TILE)
        if (side**2).sum() < 0.97 * _SIDE**2 or (side == 2).all():
            return side
        texel *= _COARSER


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
    tolerance: float,
    sharpness: float,
    out: wp.array[wp.vec3],
    total: wp.array[float],
):
    t = wp.tid()
    color = wp.vec3(0.0)
    weight = float(0.0)
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
                rendered = depth[i, int(v + 0.5), int(u + 0.5)]
                if wp.abs(rendered - z) < tolerance * z:
                    facing = wp.abs(wp.dot(wp.transform_vector(world_to_camera[i], normals[t]), wp.normalize(local)))
                    share = wp.pow(wp.max(facing, 0.02) / (z * z), sharpness)
                    x, y = u - float(a), v - float(b)
                    for dv in range(2):
                        for du in range(2):
                            part = (x if du == 1 else 1.0 - x) * (y if dv == 1 else 1.0 - y) * share
                            color += part * wp.vec3(
                                float(rgb[i, b + dv, a + du, 0]),
                                float(rgb[i, b + dv, a + du, 1]),
                                float(rgb[i, b + dv, a + du, 2]),
                            )
                    weight += share
    total[t] = weight
    if weight > 0.0:
        out[t] = color / weight


def _upload(values: NDArray, kind: Any) -> Any:
    return wp.array(np.ascontiguousarray(values), dtype=kind, device="cpu")


def _upload_views(views: Views) -> list[Any]:
    """Views as Warp arrays: poses (world to camera), intrinsics, colors, depths."""
    inverse = np.stack([inverse_pose(pose) for pose in views.camera_to_world])
    kinds = ((inverse, wp.mat44), (views.intrinsics, wp.vec4), (views.depth, float))
    poses, intrinsics, depth = (_upload(values.astype(np.float32), kind) for values, kind in kinds)
    return [poses, intrinsics, _upload(views.rgb, wp.uint8), depth]


def _colors(views: list[Any], points: Array, normals: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colors (k, 3) in [0, 255] of points (k, 3) with unit normals, and weights (k,), 0 for unseen points."""
    given = [_upload(x.astype(np.float32), wp.vec3) for x in (points, normals)]
    out = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    total = wp.zeros(len(points), dtype=float, device="cpu")
    wp.launch(_gather, len(points), [*given, *views, _TEXEL_TOLERANCE, _SHARPNESS], [out, total], device="cpu")
    return out.numpy().copy(), total.numpy()


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
