"""A MuJoCo model of textured meshes that stands still, as plain arrays for `raster.py`.

*Levels* of a texture are the texture itself and its halvings, until `_SMALLEST` pixels; all are in one array of bytes.
"""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_LEVELS = 6
_SMALLEST = 8  # [px] side of a level
_SMOOTH = 0.8  # cosine to its face above which a vertex normal is used, as MuJoCo does


@dataclass(frozen=True)
class Flat:
    """m triangles of geom groups 0 and 1, and the lights."""

    corners: Floats
    """World [m], shape (m, 3, 3)."""
    normals: Floats
    """At the corners, unit, shape (m, 3, 3)."""
    uvs: Floats
    """Column, row in [0, 1] of the texture, shape (m, 3, 2)."""
    textures: NDArray[np.int32]
    """Shape (m,)."""
    emissions: Floats
    """Shape (m,)."""
    texels: NDArray[np.uint8]
    """Every level of every texture, row by row, RGB; shape (bytes,)."""
    levels: NDArray[np.int32]
    """Offset in `texels`, width, height [px]; shape (textures, levels, 3). The last ones may repeat."""
    sky: int
    """The texture that is the cube map of the sky."""
    ambient: Floats
    """Shape (3,)."""
    sun_rays: Floats
    """Directions in which the directional lights shine, unit, shape (k, 3)."""
    sun_colours: Floats
    """Shape (k, 3)."""
    sun_shadows: NDArray[np.bool_]
    """Which cast shadows, shape (k,)."""
    lamps: Floats
    """Position [m] and colour of the spot lights, which shine straight down, shape (l, 2, 3)."""
    lamp_shape: Floats
    """Attenuation: constant, per square metre; cosine of the cutoff. Shape (3,)."""


def flatten(model: mujoco.MjModel) -> Flat:
    """The model's meshes in geom groups 0 and 1, its textures and its lights."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    shown = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group <= 1))
    pieces = [_triangles(model, data, int(geom)) for geom in shown]
    materials = model.geom_matid[shown]
    counts = [len(piece[0]) for piece in pieces]
    textures = model.mat_texid[materials, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    texels, levels = _levels(model)
    suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    lamps = np.flatnonzero(~suns)
    shape = np.array([1.0, 0.0, 0.0])
    if len(lamps):
        one = lamps[0]
        shape = np.array([*model.light_attenuation[one][[0, 2]], np.cos(np.deg2rad(model.light_cutoff[one]))])
    lit = np.stack([data.light_xpos[lamps], model.light_diffuse[lamps]], 1)
    return Flat(
        corners=np.concatenate([piece[0] for piece in pieces]),
        normals=np.concatenate([piece[1] for piece in pieces]),
        uvs=np.concatenate([piece[2] for piece in pieces]),
        textures=np.repeat(textures, counts).astype(np.int32),
        emissions=np.repeat(model.mat_emission[materials], counts).astype(np.float32),
        texels=texels,
        levels=levels,
        sky=int(np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)[0]),
        ambient=model.light_ambient.sum(0).astype(np.float32),
        sun_rays=data.light_xdir[suns].astype(np.float32),
        sun_colours=model.light_diffuse[suns].astype(np.float32),
        sun_shadows=np.asarray(model.light_castshadow[suns], bool),
        lamps=lit.astype(np.float32),
        lamp_shape=shape.astype(np.float32),
    )


def _triangles(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Floats, Floats, Floats]:
    """Corners in the world, normals and uvs of a geom's mesh, shapes (m, 3, 3), (m, 3, 3), (m, 3, 2)."""
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    part = slice(first, first + count)
    turn, shift = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    corners = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[part]] @ turn.T + shift
    smooth = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[part]] @ turn.T
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = (flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12))[:, None]
    normals = np.where((smooth * flat).sum(-1, keepdims=True) < _SMOOTH, flat, smooth)
    uvs = model.mesh_texcoord[model.mesh_texcoordadr[mesh] + model.mesh_facetexcoord[part]]
    return corners.astype(np.float32), normals.astype(np.float32), uvs.astype(np.float32)


def _levels(model: mujoco.MjModel) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Every texture in halving sizes: `Flat.texels` and `Flat.levels`."""
    images: list[NDArray[np.uint8]] = []
    table = np.zeros((model.ntex, _LEVELS, 3), np.int32)
    offset = 0
    for texture in range(model.ntex):
        width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
        begin = model.tex_adr[texture]
        image = model.tex_data[begin : begin + 3 * width * height].reshape(height, width, 3)
        for level in range(_LEVELS):
            if level and min(image.shape[:2]) >= 2 * _SMALLEST:
                image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
            elif level:
                table[texture, level] = table[texture, level - 1]
                continue
            images.append(image.ravel())
            table[texture, level] = offset, image.shape[1], image.shape[0]
            offset += image.size
    return np.concatenate(images), table
