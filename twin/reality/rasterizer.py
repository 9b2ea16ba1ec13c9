"""CPU rasterizer for the images of the robot's camera in the simulated reality: small images in a few milliseconds.

The static world is flattened once into triangles, mip-mapped textures, lights and a shadow map. An image takes two
passes over 2 × 2 samples per pixel: the first finds each sample's nearest triangle, the second computes its color.
Shading is that of `filming.Renderer`, but textures are averaged over the footprint of a sample.

A ray through a sample has direction d with z = 1 in the camera frame. The ray hits a triangle with corners a, b, c in
that frame if d · (b × c), d · (c × a) and d · (a × b) have the sign of det = a · (b × c). These three products are
proportional to the barycentric coordinates of the hit (Olano and Greer, Triangle scan conversion using 2D homogeneous
coordinates, 1997). Their sum is d · ((b − a) × (c − a)), and z = det / sum. No clipping is needed.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, type-var, operator"
# mypy: disable-error-code="call-overload, var-annotated"
# (kernels use Warp's own types, which mypy does not know)

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.types import Array, Array32
from twin.warp_runtime import wp

PlaceRenderer = Callable[[Array], tuple[Array32, Array32]]
"""Renders a place under one lighting.

It takes camera_to_world (4, 4) with OpenCV axes, and returns linear RGB (h, w, 3) and z-depth (h, w) [m]; the sky has
depth 0.
"""

# ---- model to arrays

_MAX_LEVELS = 6
_MIN_SIDE = 8  # [px] smaller mip levels are not made
_SMOOTH_COSINE = 0.8  # at smaller cosines between vertex and face normal, the face normal is used, as in MuJoCo


@dataclass(frozen=True)
class FlatScene:
    """m textured triangles and the lights of a static model."""

    corners: Array32
    """World positions [m], shape (m, 3, 3)."""
    normals: Array32
    """Unit normals at the corners, shape (m, 3, 3)."""
    uvs: Array32
    """Texture coordinates (column, row) in [0, 1], shape (m, 3, 2)."""
    textures: NDArray[np.int32]
    """Index of each triangle's texture, shape (m,)."""
    emissions: Array32
    """Emission of each triangle's material, shape (m,)."""
    texels: NDArray[np.uint8]
    """RGB of all mip levels of all textures, row by row, shape (bytes,)."""
    mip_levels: NDArray[np.int32]
    """Offset in `texels`, width and height [px], shape (textures, levels, 3); the last levels may repeat."""
    sky: int
    """Texture index of the sky's cube map."""
    ambient: Array32
    """Color of the ambient light, shape (3,)."""
    sun_directions: Array32
    """Unit ray directions of the directional lights, shape (k, 3)."""
    sun_colors: Array32
    """Colors of the directional lights, shape (k, 3)."""
    sun_shadows: NDArray[np.bool_]
    """True for directional lights that cast shadows, shape (k,)."""
    lamps: Array32
    """Position [m] and color of the spot lights, which shine straight down, shape (l, 2, 3)."""
    lamp_falloff: Array32
    """Constant attenuation, quadratic attenuation [1/m²] and cosine of the cutoff angle of all lamps; shape (3,)."""


def flatten(model: mujoco.MjModel) -> FlatScene:
    """The meshes of a model in geom groups 0 and 1, its textures and its lights."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    shown = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group <= 1))
    pieces = [_triangles(model, data, int(geom)) for geom in shown]
    materials = model.geom_matid[shown]
    counts = [len(piece[0]) for piece in pieces]
    textures = model.mat_texid[materials, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    texels, mip_levels = _mip_levels(model)
    suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    lamps = np.flatnonzero(~suns)
    shape = np.array([1.0, 0.0, 0.0])
    if len(lamps):
        one = lamps[0]
        shape = np.array([*model.light_attenuation[one][[0, 2]], np.cos(np.deg2rad(model.light_cutoff[one]))])
    lit = np.stack([data.light_xpos[lamps], model.light_diffuse[lamps]], 1)
    return FlatScene(
        corners=np.concatenate([piece[0] for piece in pieces]),
        normals=np.concatenate([piece[1] for piece in pieces]),
        uvs=np.concatenate([piece[2] for piece in pieces]),
        textures=np.repeat(textures, counts).astype(np.int32),
        emissions=np.repeat(model.mat_emission[materials], counts).astype(np.float32),
        texels=texels,
        mip_levels=mip_levels,
        sky=int(np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)[0]),
        ambient=model.light_ambient.sum(0).astype(np.float32),
        sun_directions=data.light_xdir[suns].astype(np.float32),
        sun_colors=model.light_diffuse[suns].astype(np.float32),
        sun_shadows=np.asarray(model.light_castshadow[suns], bool),
        lamps=lit.astype(np.float32),
        lamp_falloff=shape.astype(np.float32),
    )


def _triangles(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Array32, Array32, Array32]:
    """World corners, normals and uvs of a geom's mesh, shapes (m, 3, 3), (m, 3, 3), (m, 3, 2)."""
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    part = slice(first, first + count)
    turn, shift = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    corners = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[part]] @ turn.T + shift
    smooth = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[part]] @ turn.T
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = (flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12))[:, None]
    normals = np.where((smooth * flat).sum(-1, keepdims=True) < _SMOOTH_COSINE, flat, smooth)
    uvs = model.mesh_texcoord[model.mesh_texcoordadr[mesh] + model.mesh_facetexcoord[part]]
    return corners.astype(np.float32), normals.astype(np.float32), uvs.astype(np.float32)


def _mip_levels(model: mujoco.MjModel) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """`FlatScene.texels` and `FlatScene.mip_levels` of a model's textures."""
    images: list[NDArray[np.uint8]] = []
    table = np.zeros((model.ntex, _MAX_LEVELS, 3), np.int32)
    offset = 0
    for texture in range(model.ntex):
        width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
        begin = model.tex_adr[texture]
        image = model.tex_data[begin : begin + 3 * width * height].reshape(height, width, 3)
        for level in range(_MAX_LEVELS):
            if level and min(image.shape[:2]) >= 2 * _MIN_SIDE:
                image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
            elif level:
                table[texture, level] = table[texture, level - 1]
                continue
            images.append(image.ravel())
            table[texture, level] = offset, image.shape[1], image.shape[0]
            offset += image.size
    return np.concatenate(images), table


# ---- shadow map

ShadowRange = tuple[tuple[float, float, float], tuple[float, float, float]]
SHADOW_RANGE: ShadowRange = ((-14.0, -66.0, -1.0), (66.0, 24.0, 6.0))
"""Box that the shadow map covers on the campus road [m]; points outside it are lit."""
_SHADOW_TEXEL = 0.03  # [m]
_FAR = 1.0e6  # [m]
_MAX_BIAS = 12.0  # [texels] bound of the bias against self-shadowing


@wp.struct
class ShadowMap:
    """Orthographic depth map of the directional light number `sun`: axes, origin [m], and depths along `ray` [m]."""

    sun: int
    right: wp.vec3
    up: wp.vec3
    ray: wp.vec3
    left_bottom: wp.vec2
    depth: wp.array2d[float]


@wp.func
def _shadow_texel(shadows: ShadowMap, point: wp.vec3):
    """Column and row of a point in the shadow map [texels]; the third component is 0."""
    o = shadows.left_bottom
    return wp.vec3(wp.dot(point, shadows.right) - o[0], wp.dot(point, shadows.up) - o[1], 0.0) / _SHADOW_TEXEL


@wp.kernel
def _rasterize_shadow(corners: wp.array2d[wp.vec3], shadows: ShadowMap):
    i = wp.tid()
    a = _shadow_texel(shadows, corners[i, 0])
    b = _shadow_texel(shadows, corners[i, 1])
    c = _shadow_texel(shadows, corners[i, 2])
    da, db = wp.dot(corners[i, 0], shadows.ray), wp.dot(corners[i, 1], shadows.ray)
    dc = wp.dot(corners[i, 2], shadows.ray)
    area = wp.cross(b - a, c - a)[2]
    if area == 0.0:
        return
    rows, columns = shadows.depth.shape[0], shadows.depth.shape[1]
    x0 = wp.max(0, int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])))))
    x1 = wp.min(columns - 1, int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])))))
    y0 = wp.max(0, int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])))))
    y1 = wp.min(rows - 1, int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])))))
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            p = wp.vec3(float(x), float(y), 0.0)
            wa, wb = wp.cross(b - p, c - p)[2] / area, wp.cross(c - p, a - p)[2] / area
            wc = 1.0 - wa - wb
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                wp.atomic_min(shadows.depth, y, x, wa * da + wb * db + wc * dc)


@wp.func
def _is_lit(shadows: ShadowMap, x: int, y: int, along: float):
    if x < 0 or y < 0 or x >= shadows.depth.shape[1] or y >= shadows.depth.shape[0]:
        return 1.0
    return wp.where(shadows.depth[y, x] < along, 0.0, 1.0)


@wp.func
def sun_visibility(shadows: ShadowMap, point: wp.vec3, normal: wp.vec3):
    """Fraction of sunlight that reaches a surface point [m]: interpolated depth tests at the four nearest texels."""
    facing = wp.max(-wp.dot(normal, shadows.ray), 1.0e-3)
    # Bias against self-shadowing: the rise of a slanted surface towards the light within a texel, plus half a texel.
    slack = _SHADOW_TEXEL * wp.min(wp.sqrt(1.0 - facing * facing) / facing, _MAX_BIAS) + 0.5 * _SHADOW_TEXEL
    x = (wp.dot(point, shadows.right) - shadows.left_bottom[0]) / _SHADOW_TEXEL
    y = (wp.dot(point, shadows.up) - shadows.left_bottom[1]) / _SHADOW_TEXEL
    along = wp.dot(point, shadows.ray) - slack
    x0, y0 = int(wp.floor(x)), int(wp.floor(y))
    fx, fy = x - float(x0), y - float(y0)
    low = _is_lit(shadows, x0, y0, along) * (1.0 - fx) + _is_lit(shadows, x0 + 1, y0, along) * fx
    high = _is_lit(shadows, x0, y0 + 1, along) * (1.0 - fx) + _is_lit(shadows, x0 + 1, y0 + 1, along) * fx
    return low * (1.0 - fy) + high * fy


def render_shadow_map(corners: wp.array, flat: FlatScene, reach: ShadowRange = SHADOW_RANGE) -> ShadowMap:
    """The shadow map of the first directional light that casts shadows; if none does, an empty map with `sun` = −1."""
    out = ShadowMap()
    casting = np.flatnonzero(flat.sun_shadows)
    out.sun = int(casting[0]) if len(casting) else -1
    ray = flat.sun_directions[out.sun].astype(np.float64) if len(casting) else np.array([0.0, 0.0, -1.0])
    helper = np.eye(3)[np.argmin(np.abs(ray))]
    right = np.cross(ray, helper)
    right /= np.linalg.norm(right)
    up = np.cross(right, ray)
    box = np.array([[x, y, z] for x, y, z in np.array(np.meshgrid(*np.array(reach).T)).reshape(3, -1).T])
    low, high = (box @ np.stack([right, up], 1)).min(0), (box @ np.stack([right, up], 1)).max(0)
    columns, rows = np.ceil((high - low) / _SHADOW_TEXEL).astype(int).tolist() if len(casting) else (1, 1)
    out.right, out.up, out.ray, out.left_bottom = wp.vec3(*right), wp.vec3(*up), wp.vec3(*ray), wp.vec2(*low)
    depth: Any = wp.full((rows, columns), _FAR, dtype=float, device="cpu")
    out.depth = depth
    if len(casting):
        wp.launch(_rasterize_shadow, len(corners), [corners, out], device="cpu")
    return out


# ---- rasterizer


SAMPLES = 2
"""Samples per pixel along each axis of the image."""

_NEAR = 0.02  # [m]
_UNBOUNDED = 1.0e30  # [samples]
_NO_TRIANGLE = 1 << 62
_DEPTH_STEPS = 1.0e5  # [1/m] resolution of a key's depth
_INDEX_BITS = 23
_MAX_TAPS = 6  # largest number of texture lookups along a footprint's longer axis


@wp.func
def _extend_box_by_edge(box: wp.vec4, a: wp.vec3, b: wp.vec3, intrinsics: wp.vec4):
    """Extends a box (x0, y0, x1, y1) [samples] to contain a, and the intersection of edge a–b with the near plane."""
    if a[2] >= _NEAR:
        box = _extend_box_by_point(box, a, intrinsics)
    if (a[2] < _NEAR) != (b[2] < _NEAR):
        box = _extend_box_by_point(box, a + (b - a) * ((_NEAR - a[2]) / (b[2] - a[2])), intrinsics)
    return box


@wp.func
def _extend_box_by_point(box: wp.vec4, p: wp.vec3, intrinsics: wp.vec4):
    x, y = intrinsics[0] * p[0] / p[2] + intrinsics[2], intrinsics[1] * p[1] / p[2] + intrinsics[3]
    return wp.vec4(wp.min(box[0], x), wp.min(box[1], y), wp.max(box[2], x), wp.max(box[3], y))


@wp.kernel
def _rasterize(
    corners: wp.array2d[wp.vec3],
    to_camera: wp.mat33,
    eye: wp.vec3,
    intrinsics: wp.vec4,
    width: int,
    height: int,
    nearest_keys: wp.array[wp.int64],
):
    """Stores the nearest triangle of every sample as a key: the high bits are its depth, the low bits its index."""
    i = wp.tid()
    a, b, c = to_camera * (corners[i, 0] - eye), to_camera * (corners[i, 1] - eye), to_camera * (corners[i, 2] - eye)
    if a[2] < _NEAR and b[2] < _NEAR and c[2] < _NEAR:
        return
    # Box around the part of the triangle beyond the near plane; sample k lies at k + 0.5.
    box = _extend_box_by_edge(wp.vec4(_UNBOUNDED, _UNBOUNDED, -_UNBOUNDED, -_UNBOUNDED), a, b, intrinsics)
    box = _extend_box_by_edge(_extend_box_by_edge(box, b, c, intrinsics), c, a, intrinsics)
    if box[2] < 0.5 or box[3] < 0.5 or box[0] > float(width) - 0.5 or box[1] > float(height) - 0.5:
        return
    x0, x1 = int(wp.ceil(wp.max(box[0] - 0.5, 0.0))), int(wp.floor(wp.min(box[2] - 0.5, float(width - 1))))
    y0, y1 = int(wp.ceil(wp.max(box[1] - 0.5, 0.0))), int(wp.floor(wp.min(box[3] - 0.5, float(height - 1))))
    na, nb, nc = wp.cross(b, c), wp.cross(c, a), wp.cross(a, b)
    plane = wp.cross(b - a, c - a)
    det = wp.dot(a, plane)
    if det < 0.0:
        na, nb, nc = -na, -nb, -nc
    if det == 0.0:
        return
    for y in range(y0, y1 + 1):
        v = (float(y) + 0.5 - intrinsics[3]) / intrinsics[1]
        for x in range(x0, x1 + 1):
            u = (float(x) + 0.5 - intrinsics[2]) / intrinsics[0]
            wa = u * na[0] + v * na[1] + na[2]
            wb = u * nb[0] + v * nb[1] + nb[2]
            wc = u * nc[0] + v * nc[1] + nc[2]
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                z = det / (u * plane[0] + v * plane[1] + plane[2])
                if z > _NEAR and z < _FAR:
                    key = wp.int64(z * _DEPTH_STEPS) * wp.int64(1 << _INDEX_BITS) + wp.int64(i)
                    wp.atomic_min(nearest_keys, y * width + x, key)


@wp.func
def _texel(texels: wp.array[wp.uint8], at: int):
    return wp.vec3(float(texels[at]), float(texels[at + 1]), float(texels[at + 2]))


@wp.func
def _bilinear(texels: wp.array[wp.uint8], level: wp.vec3i, uv: wp.vec2):
    """Color, 0 to 255, of a mip level (offset, width, height) at uv in [0, 1]², clamped to its edge."""
    x = wp.clamp(uv[0] * float(level[1]) - 0.5, 0.0, float(level[1] - 1))
    y = wp.clamp(uv[1] * float(level[2]) - 0.5, 0.0, float(level[2] - 1))
    x0, y0 = int(x), int(y)
    x1, y1 = wp.min(x0 + 1, level[1] - 1), wp.min(y0 + 1, level[2] - 1)
    fx, fy = x - float(x0), y - float(y0)
    row0, row1 = level[0] + 3 * y0 * level[1], level[0] + 3 * y1 * level[1]
    upper = _texel(texels, row0 + 3 * x0) * (1.0 - fx) + _texel(texels, row0 + 3 * x1) * fx
    lower = _texel(texels, row1 + 3 * x0) * (1.0 - fx) + _texel(texels, row1 + 3 * x1) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.func
def _sample_texture(
    texels: wp.array[wp.uint8],
    mip_levels: wp.array2d[wp.vec3i],
    texture: int,
    uv: wp.vec2,
    uv_step_x: wp.vec2,
    uv_step_y: wp.vec2,
):
    """Mean color over the footprint that two uv steps span.

    The lookups lie along the footprint's longer axis; its shorter axis determines the mip level.
    """
    base = mip_levels[texture, 0]
    size = wp.vec2(float(base[1]), float(base[2]))
    dx, dy = wp.length(wp.cw_mul(uv_step_x, size)), wp.length(wp.cw_mul(uv_step_y, size))
    step, longer, shorter = uv_step_y, dy, dx
    if dx > dy:
        step, longer, shorter = uv_step_x, dx, dy
    taps = int(wp.clamp(wp.ceil(longer / wp.max(shorter, 1.0)), 1.0, float(_MAX_TAPS)))
    wide = wp.max(wp.max(shorter, longer / float(taps)), 1.0)
    level = mip_levels[texture, wp.min(int(wp.log2(wide) + 0.5), mip_levels.shape[1] - 1)]
    color = wp.vec3(0.0, 0.0, 0.0)
    for k in range(taps):
        share = (float(k) + 0.5) / float(taps) - 0.5
        color += _bilinear(texels, level, uv + step * share)
    return color / (255.0 * float(taps))


@wp.func
def _sky(texels: wp.array[wp.uint8], level: wp.vec3i, ray: wp.vec3):
    """Color of a cube map along a world ray; faces are stacked in OpenGL's order, the cube's y is the world's z."""
    x, y, z = ray[0], ray[2], -ray[1]
    ax, ay, az = wp.abs(x), wp.abs(y), wp.abs(z)
    face = int(0)  # noqa: RUF046 - int() declares a variable that Warp can change
    s, t, most = -z, -y, ax
    if ax >= ay and ax >= az:
        if x <= 0.0:
            face, s = 1, z
    elif ay >= az:
        face, s, t, most = 2, x, z, ay
        if y <= 0.0:
            face, t = 3, -z
    else:
        face, s, t, most = 4, x, -y, az
        if z <= 0.0:
            face, s = 5, -x
    side = level[1]
    inset = 0.5 / float(side)
    column, row = (s / most + 1.0) / 2.0, wp.clamp((t / most + 1.0) / 2.0, inset, 1.0 - inset)
    return _bilinear(texels, level, wp.vec2(column, (float(face) + row) / 6.0)) / 255.0


@wp.kernel
def _shade(
    corners: wp.array2d[wp.vec3],
    normals: wp.array2d[wp.vec3],
    uvs: wp.array2d[wp.vec2],
    textures: wp.array[int],
    emissions: wp.array[float],
    texels: wp.array[wp.uint8],
    mip_levels: wp.array2d[wp.vec3i],
    sky: int,
    ambient: wp.vec3,
    sun_directions: wp.array[wp.vec3],
    sun_colors: wp.array[wp.vec3],
    lamps: wp.array2d[wp.vec3],
    lamp_falloff: wp.vec3,
    shadows: ShadowMap,
    nearest_keys: wp.array[wp.int64],
    to_camera: wp.mat33,
    eye: wp.vec3,
    intrinsics: wp.vec4,
    width: int,
    rgb: wp.array2d[wp.vec3],
    depth: wp.array2d[float],
):
    """Writes the mean color of a pixel's samples and the z-depth of the first one (0 = sky)."""
    py, px = wp.tid()
    to_world = wp.transpose(to_camera)
    total = wp.vec3(0.0, 0.0, 0.0)
    for sample in range(SAMPLES * SAMPLES):
        x, y = px * SAMPLES + sample % SAMPLES, py * SAMPLES + sample // SAMPLES
        d = wp.vec3(
            (float(x) + 0.5 - intrinsics[2]) / intrinsics[0], (float(y) + 0.5 - intrinsics[3]) / intrinsics[1], 1.0
        )
        key = nearest_keys[y * width + x]
        if key == wp.int64(_NO_TRIANGLE):
            if sample == 0:
                depth[py, px] = 0.0
            total += _sky(texels, mip_levels[sky, 0], to_world * d)
            continue
        i = int(key % wp.int64(1 << _INDEX_BITS))
        a = to_camera * (corners[i, 0] - eye)
        b = to_camera * (corners[i, 1] - eye)
        c = to_camera * (corners[i, 2] - eye)
        na, nb, nc = wp.cross(b, c), wp.cross(c, a), wp.cross(a, b)
        w = wp.vec3(wp.dot(d, na), wp.dot(d, nb), wp.dot(d, nc))
        plane = wp.cross(b - a, c - a)
        z = wp.dot(a, plane) / wp.dot(d, plane)
        if sample == 0:
            depth[py, px] = z
        # wx, wy: barycentric coordinates one sample to the right and one sample down. The uv steps span the footprint.
        wx = w + wp.vec3(na[0], nb[0], nc[0]) / intrinsics[0]
        wy = w + wp.vec3(na[1], nb[1], nc[1]) / intrinsics[1]
        here = w / (w[0] + w[1] + w[2])
        uv = uvs[i, 0] * here[0] + uvs[i, 1] * here[1] + uvs[i, 2] * here[2]
        wx = wx / (wx[0] + wx[1] + wx[2])
        wy = wy / (wy[0] + wy[1] + wy[2])
        uv_step_x = uvs[i, 0] * wx[0] + uvs[i, 1] * wx[1] + uvs[i, 2] * wx[2] - uv
        uv_step_y = uvs[i, 0] * wy[0] + uvs[i, 1] * wy[1] + uvs[i, 2] * wy[2] - uv
        base = _sample_texture(texels, mip_levels, textures[i], uv, uv_step_x, uv_step_y)

        point = eye + to_world * (d * z)
        normal = wp.normalize(normals[i, 0] * here[0] + normals[i, 1] * here[1] + normals[i, 2] * here[2])
        if wp.dot(normal, to_world * d) > 0.0:
            normal = -normal
        light = ambient + wp.vec3(emissions[i], emissions[i], emissions[i])
        for k in range(sun_directions.shape[0]):
            facing = -wp.dot(normal, sun_directions[k])
            if facing > 0.0:
                if k == shadows.sun:
                    facing *= sun_visibility(shadows, point, normal)
                light += sun_colors[k] * facing
        for k in range(lamps.shape[0]):
            lamp_direction = lamps[k, 0] - point
            distance = wp.length(lamp_direction)
            lamp_direction = lamp_direction / distance
            below = lamp_direction[2]  # lamps shine straight down
            facing = wp.dot(normal, lamp_direction)
            if below >= lamp_falloff[2] and facing > 0.0:
                light += lamps[k, 1] * (facing * below / (lamp_falloff[0] + lamp_falloff[1] * distance * distance))
        color = wp.cw_mul(base, light)
        total += wp.vec3(wp.min(color[0], 1.0), wp.min(color[1], 1.0), wp.min(color[2], 1.0))
    rgb[py, px] = total / float(SAMPLES * SAMPLES)


class Rasterizer:
    """Renders one place under one lighting from any pose."""

    def __init__(
        self,
        model: mujoco.MjModel,
        intrinsics: Array,
        size: tuple[int, int],
        shadow_range: ShadowRange = SHADOW_RANGE,
    ) -> None:
        """
        Args:
            model: Compiled `true_world.world_spec`.
            intrinsics: fx, fy, cx, cy [px], shape (4,).
            size: Width, height of the image [px].
            shadow_range: Box in which the sun casts shadows, lowest and highest corner [m].
        """
        flat: FlatScene = flatten(model)
        if len(flat.corners) >= 1 << _INDEX_BITS:
            raise ValueError(f"{len(flat.corners)} triangles; the rasterizer takes fewer than {1 << _INDEX_BITS}")
        self._size = (SAMPLES * size[0], SAMPLES * size[1])
        self._intrinsics = wp.vec4(*(float(value) * SAMPLES for value in intrinsics))
        with wp.ScopedDevice("cpu"):
            self._corners = wp.array(flat.corners, dtype=wp.vec3)
            self._nearest = wp.empty(self._size[0] * self._size[1], dtype=wp.int64)
            self._rgb = wp.empty((size[1], size[0]), dtype=wp.vec3)
            self._depth = wp.empty((size[1], size[0]), dtype=float)
            self._inputs: list[Any] = [
                self._corners,
                wp.array(flat.normals, dtype=wp.vec3),
                wp.array(flat.uvs, dtype=wp.vec2),
                wp.array(flat.textures, dtype=int),
                wp.array(flat.emissions, dtype=float),
                wp.array(flat.texels, dtype=wp.uint8),
                wp.array(flat.mip_levels, dtype=wp.vec3i),
                flat.sky,
                wp.vec3(*flat.ambient.tolist()),
                wp.array(flat.sun_directions, dtype=wp.vec3),
                wp.array(flat.sun_colors, dtype=wp.vec3),
                wp.array(flat.lamps, dtype=wp.vec3),
                wp.vec3(*flat.lamp_falloff.tolist()),
                render_shadow_map(self._corners, flat, shadow_range),
            ]

    def __call__(self, camera_to_world: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """RGB (h, w, 3) in [0, 1] and z-depth (h, w) [m] for an OpenCV pose (4, 4).

        The depth belongs to the pixel's first sample and is 0 for the sky.
        """
        to_camera = wp.mat33(camera_to_world[:3, :3].T.astype(np.float32))
        eye = wp.vec3(*camera_to_world[:3, 3].tolist())
        width, height = self._size
        with wp.ScopedDevice("cpu"):
            self._nearest.fill_(_NO_TRIANGLE)
            view = [to_camera, eye, self._intrinsics, width]
            wp.launch(_rasterize, len(self._corners), [self._corners, *view, height, self._nearest])
            wp.launch(_shade, self._rgb.shape, [*self._inputs, self._nearest, *view, self._rgb, self._depth])
        return self._rgb.numpy().copy(), self._depth.numpy().copy()
