"""The simulated reality as a MuJoCo model for rendering, with visual geoms only; nothing collides."""

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry.mesh_rays import Surface
from twin.reality import lighting as lightings
from twin.reality import primitives, textures
from twin.reality.lighting import Lighting
from twin.reality.place_objects import KnownPlace, up
from twin.reality.primitives import MeshPart
from twin.types import Array

# ---- ambient occlusion of the ground

_SKY_RAYS = 48
_OCCLUDER_REACH = 7.0  # [m] objects farther away do not occlude the sky
_OCCLUSION_STEP = 0.3  # [m] between points of a sky-visibility map; the points of the land's map are 1 m apart


def sky_visibility(place: KnownPlace, points: Array) -> Array:
    """Fraction of the cosine-weighted sky that no nearby object hides from points (..., 3) [m], shape (...)."""
    part = primitives.join([t.part for t in place.objects if t.kind in ("obstacle", "foliage")])
    k = np.arange(_SKY_RAYS) + 0.5
    # Malley's method: points that fill a disc uniformly are projected up to the hemisphere.
    angle, sine = k * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(k / _SKY_RAYS)
    rays = np.stack([sine * np.cos(angle), sine * np.sin(angle), np.sqrt(1.0 - sine**2)], 1)
    flat = points.reshape(-1, 3) + up(0.02)
    return Surface(part.vertices, part.faces).openness(flat, rays, _OCCLUDER_REACH).reshape(points.shape[:-1])


def ground_visibility(place: KnownPlace) -> dict[str, Array]:
    """A coarse sky-visibility map for each ground texture, with rows and columns along those of the texture."""
    grids = {}
    for name, (first, last, top, bottom) in place.layout.bands.items():
        along = np.linspace(first, last, round((last - first) / _OCCLUSION_STEP))
        across = np.linspace(top, bottom, max(2, round(abs(top - bottom) / _OCCLUSION_STEP)))
        grids[name] = place.route.at(along[None], across[:, None])
    for name, (x0, x1, y0, y1) in place.layout.lands.items():
        x, y = np.meshgrid(np.linspace(x0, x1, round(x1 - x0)), np.linspace(y1, y0, round(y1 - y0)))
        grids[name] = np.stack([x, y], -1)
    return {
        name: sky_visibility(place, np.concatenate([xy, place.route.ground_height(xy)[..., None]], -1))
        for name, xy in grids.items()
    }


# ---- model


def world_spec(
    lighting: Lighting | str, place: KnownPlace, moving: Mapping[str, MeshPart] | None = None
) -> mujoco.MjSpec:
    """Model of a place under one lighting, with textures, lights and a camera named `film`.

    Ground geoms are in group 0, all others in group 1. Each mesh of `moving` becomes a mocap body of its name.
    """
    light = place.lightings[lighting] if isinstance(lighting, str) else lighting
    model = mujoco.MjSpec()
    model.modelname = f"reality_{light.name}"
    model.visual.map.znear, model.visual.map.zfar = 0.001, 10.0
    model.stat.extent, model.stat.center = 60.0, [20.0, -5.0, 0.0]
    visibility = ground_visibility(place) if light.occlusion > 0.0 else {}
    for name, image in place.textures().items():
        if name in visibility:
            image = _darkened(image, 1.0 - light.occlusion * (1.0 - visibility[name]))
        if light.wet > 0.0 and name in place.layout.wet:
            image = (image * (1.0 - light.wet)).astype(np.uint8)
        _add_texture(model, name, image)
    sky = place.sky(light)
    box = model.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    box.width, box.height, box.nchannel, box.data = sky.shape[1], sky.shape[0], 3, sky.tobytes()
    for name, emission in (
        ("lamp_glass", light.glow),
        ("windows_by_night", 0.75 * light.glow),
        ("windows_by_day", 0.0),
    ):
        _add_material(model, name, "atlas", emission)
    after_dark = light.glow > 0.0
    for obj in place.objects:
        if obj.texture == ("windows_by_day" if after_dark else "windows_by_night"):
            continue
        _add_geom(model.worldbody, model, obj.name, obj.part, obj.texture, group=0 if obj.kind == "ground" else 1)
    for name, part in (moving or {}).items():
        _add_geom(model.worldbody.add_body(name=name, mocap=True), model, name, part, "atlas", group=1)
    lightings.add_lights(model, light, np.array(place.lamp_heads))
    model.worldbody.add_camera(name="film", pos=[0, 0, 1.2])
    return model


def _add_geom(body: mujoco.MjsBody, model: mujoco.MjSpec, name: str, part: MeshPart, material: str, group: int) -> None:
    mesh = model.add_mesh(name=name)
    mesh.uservert = part.vertices.astype(np.float32).ravel()
    mesh.userface = part.faces.ravel()
    mesh.usertexcoord = part.uv.astype(np.float32).ravel()
    mesh.userfacetexcoord = part.faces.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        contype=0,
        conaffinity=0,
        group=group,
    )


def _darkened(image: NDArray[np.uint8], factor: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Multiplies a texture by a coarse map of factors in [0, 1]."""
    fine = textures.resized(factor.astype(np.float32), image.shape[:2], smooth=False)
    return (image * np.clip(fine, 0.0, 1.0)[..., None]).astype(np.uint8)


def _add_texture(model: mujoco.MjSpec, name: str, image: NDArray[np.uint8]) -> None:
    texture = model.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.width, texture.height, texture.nchannel = image.shape[1], image.shape[0], 3
    texture.data = image.tobytes()
    _add_material(model, name, name, 0.0)


def _add_material(model: mujoco.MjSpec, name: str, texture: str, emission: float) -> None:
    material = model.add_material(name=name, rgba=[1, 1, 1, 1], emission=emission, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
