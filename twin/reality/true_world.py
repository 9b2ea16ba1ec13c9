"""The simulated reality as a MuJoCo model for rendering, with visual geoms only (nothing collides), and its renderers.

Long places are rendered one stretch of road at a time, so that time and memory do not grow with the road's length. A
renderer of a stretch shows the objects within `_SIGHT` of the stretch. Those farther away than `_SHARP` have smaller
textures and fewer, larger leaves. Places whose road was not lengthened are rendered as a whole.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry.mesh_rays import Surface
from twin.reality import lighting as lightings
from twin.reality import primitives
from twin.reality.lighting import Lighting
from twin.reality.place_objects import KnownPlace, up
from twin.reality.place_spec import LONGEST_DRAWN
from twin.reality.primitives import MeshPart
from twin.reality.rasterizer import SHADOW_RANGE, PlaceRenderer, Rasterizer
from twin.types import Array, Array32

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
    fine = cv2.resize(factor.astype(np.float32), image.shape[1::-1])
    return (image * np.clip(fine, 0.0, 1.0)[..., None]).astype(np.uint8)


def _add_texture(model: mujoco.MjSpec, name: str, image: NDArray[np.uint8]) -> None:
    texture = model.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.width, texture.height, texture.nchannel = image.shape[1], image.shape[0], 3
    texture.data = image.tobytes()
    _add_material(model, name, name, 0.0)


def _add_material(model: mujoco.MjSpec, name: str, texture: str, emission: float) -> None:
    material = model.add_material(name=name, rgba=[1, 1, 1, 1], emission=emission, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture


# ---- renderers

_STRETCH = 100.0  # [m] length of a stretch
_SIGHT = 250.0  # [m] at this distance, a house 8 m high is 11 pixels high in a picture 640 pixels and 85° wide
_SHARP = 60.0  # [m] beyond this distance, a pixel spans more than `_SHRINK` texels of the road, and about one leaf
_SHRINK = 4  # ratio of the resolution of near textures to that of far ones, and of the numbers of leaves
_LAMPS = 24  # shining lamps per stretch; renderers loop over all lamps for every pixel
_SHADOWS = (20.0, 60.0)  # [m] of road before and after a stretch on which the rasterizer casts shadows
_SHADOW_MARGIN = 14.0  # [m] margin around this part of the road, up to the edges of `GroundLayout.field`


def is_long(place: KnownPlace) -> bool:
    """True for a place that is rendered one stretch at a time."""
    return place.route.length > LONGEST_DRAWN


class StretchRenderer:
    """Renders a long place from poses near its line; makes a new renderer whenever the camera enters a stretch."""

    def __init__(self, place: KnownPlace, make: Callable[[KnownPlace], PlaceRenderer]) -> None:
        """`make` is called with the part of `place` near a stretch, and returns a renderer of it."""
        self._place, self._make = place, make
        self._stretch: int | None = None
        self._renderer: PlaceRenderer | None = None

    def at(self, camera_to_world: Array) -> PlaceRenderer:
        """The renderer of the stretch that a pose (4, 4) is on."""
        stretch = int(self._place.route.project(camera_to_world[:2, 3])[0] // _STRETCH)
        if self._renderer is None or stretch != self._stretch:
            self._renderer = None  # frees its memory first
            self._renderer = self._make(near_stretch(self._place, stretch * _STRETCH, (stretch + 1) * _STRETCH))
            self._stretch = stretch
        return self._renderer

    def __call__(self, camera_to_world: Array) -> tuple[Array32, Array32]:
        """See `PlaceRenderer`."""
        return self.at(camera_to_world)(camera_to_world)


def near_stretch(place: KnownPlace, first: float, last: float) -> KnownPlace:
    """The part of a place that is in sight of the stretch from station `first` to `last` [m]."""
    line = place.route.at(np.linspace(first, last, 51))
    boxes = np.array([(o.part.vertices[:, :2].min(0), o.part.vertices[:, :2].max(0)) for o in place.objects])
    away = np.maximum(np.maximum(boxes[:, None, 0] - line, line - boxes[:, None, 1]), 0.0)
    distances = np.hypot(away[..., 0], away[..., 1]).min(1)
    objects = [
        replace(one, part=_thinned(one.part)) if one.kind == "foliage" and distance > _SHARP else one
        for one, distance in zip(place.objects, distances, strict=True)
        if distance < _SIGHT
    ]
    used = {one.texture for one in objects} | {"atlas"}
    sharp = {one.texture for one, distance in zip(place.objects, distances, strict=True) if distance < _SHARP}

    def textures() -> dict[str, NDArray[np.uint8]]:
        images = place.textures().items()
        return {name: image if name in sharp | {"atlas"} else _shrunk(image) for name, image in images if name in used}

    layout = place.layout
    shaded = place.route.at(np.linspace(first - _SHADOWS[0], last + _SHADOWS[1], 91))
    (x0, y0), (x1, y1) = (shaded.min(0) - _SHADOW_MARGIN).tolist(), (shaded.max(0) + _SHADOW_MARGIN).tolist()
    middle = np.append(line[len(line) // 2], 0.0)
    return replace(
        place,
        objects=objects,
        textures=textures,
        layout=replace(
            layout,
            bands={name: band for name, band in layout.bands.items() if name in used},
            lands={name: box for name, box in layout.lands.items() if name in used},
            field=((x0, y0), (x1, y1)),
        ),
        lamp_heads=sorted(place.lamp_heads, key=lambda head: float(np.linalg.norm(head - middle)))[:_LAMPS],
    )


def _thinned(leaves: MeshPart) -> MeshPart:
    """One in `_SHRINK` leaves of `primitives.leaves`, enlarged so that their area is that of all."""
    tips = leaves.vertices.reshape(-1, 4, 3)[::_SHRINK]
    middle = tips.mean(1, keepdims=True)
    kept = len(tips)
    return MeshPart(
        (middle + np.sqrt(_SHRINK) * (tips - middle)).reshape(-1, 3),
        leaves.faces[: 2 * kept],
        leaves.uv.reshape(-1, 4, 2)[::_SHRINK].reshape(-1, 2),
    )


def _shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = max(1, image.shape[1] // _SHRINK), max(1, image.shape[0] // _SHRINK)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def rasterizer_of(place: KnownPlace, light: Lighting, intrinsics: Array, size: tuple[int, int]) -> PlaceRenderer:
    """The rasterizer of a place under a lighting for a camera: fx, fy, cx, cy [px], and width, height [px]."""

    def make(part: KnownPlace) -> Rasterizer:
        return Rasterizer(world_spec(light, part).compile(), intrinsics, size, shadow_range(part))

    return StretchRenderer(place, make) if is_long(place) else make(place)


def shadow_range(place: KnownPlace) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The box in which the rasterizer casts shadows: lowest and highest corner [m]."""
    if place.number == 0:
        return SHADOW_RANGE
    (x0, y0), (x1, y1) = place.layout.field
    height = place.route.ground_height(place.route.at(np.linspace(0.0, place.route.length, 100)))
    return (x0, y0, float(height.min()) - 1.5), (x1, y1, float(height.max()) + 6.0)
