"""The known-truth world as a MuJoCo model: visual geoms (groups 0 and 1), which are filmed, and collision geoms (3)."""

from collections.abc import Callable
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry.mesh_rays import Surface
from twin.reality import centerline as roads
from twin.reality import lighting as lightings
from twin.reality import place as places
from twin.reality import primitives, textures
from twin.reality.centerline import END, PAVEMENT_WIDTH, ROAD_HALF_WIDTH, START, VERGE_WIDTH, ground_height
from twin.reality.lighting import Lighting
from twin.reality.place import BUILDINGS
from twin.reality.place_objects import ATLAS_CELL, ATLAS_SIDE, CELLS, SEED, KnownPlace, up
from twin.types import Array

# ---- ambient occlusion of the ground

_SKY_RAYS = 48
_OCCLUDER_REACH = 7.0  # [m] within which objects occlude the sky
_OCCLUSION_STEP = 0.3  # [m] between points of the map


def sky_visibility(place: KnownPlace, points: Array) -> Array:
    """Fraction of the cosine-weighted sky that objects nearby leave visible from points (..., 3), shape (...)."""
    part = primitives.join([t.part for t in place.objects if t.kind in ("obstacle", "foliage")])
    k = np.arange(_SKY_RAYS) + 0.5
    angle, sine = k * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(k / _SKY_RAYS)  # Malley: a uniform disc lifted to the dome
    rays = np.stack([sine * np.cos(angle), sine * np.sin(angle), np.sqrt(1.0 - sine**2)], 1)
    flat = points.reshape(-1, 3) + up(0.02)
    return Surface(part.vertices, part.faces).openness(flat, rays, _OCCLUDER_REACH).reshape(points.shape[:-1])


def ground_visibility(place: KnownPlace) -> dict[str, Array]:
    """Per ground texture, a coarse sky-visibility map whose rows and columns run along those of the texture."""
    edge, outer = roads.ROAD_HALF_WIDTH, roads.ROAD_HALF_WIDTH + roads.KERB_WIDTH
    bands = {
        "road": (edge, -edge),
        "verge_left": (outer + roads.VERGE_WIDTH, outer),
        "verge_right": (-outer, -outer - roads.VERGE_WIDTH),
    }
    along = np.linspace(roads.START, roads.END, round((roads.END - roads.START) / _OCCLUSION_STEP))
    grids = {}
    for name, (first, last) in bands.items():
        across = np.linspace(first, last, round(abs(first - last) / _OCCLUSION_STEP))
        grids[name] = place.route.at(along[None], across[:, None])
    x0, x1, y0, y1 = places.LAND_RANGE
    x, y = np.meshgrid(np.linspace(x0, x1, round(x1 - x0)), np.linspace(y1, y0, round(y1 - y0)))
    grids["land"] = np.stack([x, y], -1)
    return {
        name: sky_visibility(place, np.concatenate([xy, roads.ground_height(place.route, xy)[..., None]], -1))
        for name, xy in grids.items()
    }


# ---- textures and model

ROAD_PIXEL = 0.0125  # [m] texel of the road
VERGE_PIXEL = 0.022
WALL_PIXEL = 0.03
_HFIELD_CELL = 0.2  # [m] of the height field
COLLISION_GROUP = 3

WALLS = {  # building → brick or plaster, color
    "hall": ("bricks", (0.50, 0.26, 0.19)),
    "library": ("plaster", (0.72, 0.66, 0.53)),
    "lodge": ("bricks", (0.56, 0.40, 0.28)),
    "school": ("bricks", (0.45, 0.22, 0.18)),
    "workshop": ("plaster", (0.55, 0.60, 0.58)),
    "annex": ("plaster", (0.70, 0.70, 0.68)),
    "dormitory": ("bricks", (0.60, 0.47, 0.36)),
    "tower": ("plaster", (0.6, 0.58, 0.55)),
    "block": ("plaster", (0.66, 0.60, 0.56)),
    "sheds": ("bricks", (0.42, 0.38, 0.34)),
}

WET_TEXTURES = ("road", "kerb", "verge_left", "verge_right", "land")
"""Ground textures, which rain darkens."""


def _to_uint8(image: NDArray) -> NDArray[np.uint8]:
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@cache
def place_textures() -> dict[str, NDArray[np.uint8]]:
    """All textures of the place by name, uint8 RGB."""

    def rng(*key: int) -> np.random.Generator:
        return np.random.default_rng([SEED, 5, *key])

    length = END - START
    out = {"road": _to_uint8(textures.road(rng(0), length, ROAD_HALF_WIDTH, ROAD_PIXEL))}
    shape = (round(VERGE_WIDTH / VERGE_PIXEL), round(length / VERGE_PIXEL))
    out["verge_right"] = _to_uint8(textures.grass(rng(1), shape, VERGE_PIXEL))
    left = textures.grass(rng(2), shape, VERGE_PIXEL)
    paved = round(PAVEMENT_WIDTH / VERGE_PIXEL)
    left[-paved:] = textures.slabs(rng(3), (paved, shape[1]), VERGE_PIXEL, (0.57, 0.75))
    out["verge_left"] = _to_uint8(left)
    out["kerb"] = _to_uint8(textures.kerb(rng(4), (16, round(length / 0.02)), 0.02))
    out["land"] = _to_uint8(textures.grass(rng(5), (2292, 2172), 1 / 12))
    for k, (name, (kind, color)) in enumerate(WALLS.items()):
        (_, size, _) = BUILDINGS[name]
        wall = (round(size[2] / WALL_PIXEL), round(2 * (size[0] + size[1]) / WALL_PIXEL))
        paint = textures.bricks if kind == "bricks" else textures.plaster
        out[name] = _to_uint8(textures.weathered(paint(rng(6, k), wall, WALL_PIXEL, color), WALL_PIXEL))
    out["atlas"] = _to_uint8(_atlas(rng))
    return out


def _atlas(rng: Callable[..., np.random.Generator]) -> NDArray[np.float32]:
    square = (ATLAS_CELL, ATLAS_CELL)
    tones = {
        "zinc": (0.55, 0.57, 0.58), "dark": (0.16, 0.17, 0.18), "green": (0.12, 0.30, 0.18), "red": (0.58, 0.12, 0.10),
        "blue": (0.13, 0.24, 0.46), "white": (0.78, 0.78, 0.76), "rubber": (0.09, 0.09, 0.09),
        "tank": (0.34, 0.33, 0.33),
    }  # fmt: skip
    signs = [
        ((0.10, 0.22, 0.55), "LIBRARY"), ((0.85, 0.85, 0.82), "SLOW"), ((0.9, 0.75, 0.1), "WORKS"),
        ((0.12, 0.4, 0.2), "HALL B"), ((0.75, 0.1, 0.1), "STOP"), ((0.92, 0.9, 0.85), "MAP"),
        ((0.95, 0.95, 0.9), "KA 214"), ((0.93, 0.8, 0.2), "RX 730"),
    ]  # fmt: skip
    greens = [(0.26, 0.37, 0.12), (0.33, 0.42, 0.13), (0.40, 0.40, 0.14), (0.22, 0.33, 0.14)]
    image = np.zeros((ATLAS_SIDE * ATLAS_CELL, ATLAS_SIDE * ATLAS_CELL, 3), np.float32)
    for k, name in enumerate(CELLS):
        g = rng(7, k)
        if name.startswith("bark"):
            tile = textures.bark(g, square)
        elif name.startswith("leaf"):
            tile = textures.leaf(g, square, greens[int(name[-1])])
        elif name == "hedge":
            tile = textures.leaf(g, square, (0.10, 0.16, 0.06))
        elif name in tones:
            tile = textures.metal(g, square, tones[name])
        elif name == "glass":
            tile = textures.metal(g, square, (0.16, 0.2, 0.24))
        elif name in ("planks", "crate"):
            tile = textures.wood(g, square)
        elif name == "cone":
            tile = textures.stripes(g, square, (0.85, 0.30, 0.08), (0.88, 0.88, 0.85), 5)
        elif name == "barrier":
            tile = np.rot90(textures.stripes(g, square, (0.75, 0.1, 0.08), (0.9, 0.9, 0.88), 7)).copy()
        elif name.startswith("door"):
            tile = textures.wood(g, square) * np.float32(0.55)
        elif name == "lamp":
            tile = np.full((*square, 3), (1.0, 0.93, 0.76), np.float32)
        elif name.startswith("sign"):
            tile = textures.notice(g, square, *signs[int(name[-1])])
        else:
            tile = textures.resized(textures.window(g, name.startswith("lit")), square)
        row, column = divmod(k, ATLAS_SIDE)
        image[row * ATLAS_CELL : (row + 1) * ATLAS_CELL, column * ATLAS_CELL : (column + 1) * ATLAS_CELL] = tile
    return image


def collision_spec(place: KnownPlace | None = None) -> mujoco.MjSpec:
    """The collision geoms alone, in group 3: the height field `ground`, boxes and cylinders. Quick to compile."""
    place = place or places.build()
    model = mujoco.MjSpec()
    low, high = np.array([-8.0, -58.0]), np.array([60.0, 22.0])
    columns, rows = (np.round((high - low) / _HFIELD_CELL).astype(int) + 1).tolist()
    x, y = np.meshgrid(np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows))
    z = ground_height(place.route, np.stack([x, y], -1))
    field = model.add_hfield(name="ground", nrow=rows, ncol=columns)
    field.size = [*((high - low) / 2), float(np.ptp(z)), 0.5]
    field.userdata = ((z - z.min()) / np.ptp(z)).astype(np.float32).ravel()
    model.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=[*((low + high) / 2), float(z.min())],
        group=COLLISION_GROUP,
    )
    for obj in place.objects:
        for k, solid in enumerate(obj.solids):
            model.worldbody.add_geom(
                name=f"{obj.name}_solid_{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX if solid.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER,
                pos=solid.center,
                size=list(solid.half),
                quat=[np.cos(solid.yaw / 2), 0, 0, np.sin(solid.yaw / 2)],
                group=COLLISION_GROUP,
            )
    return model


def world_spec(lighting: Lighting | str, place: KnownPlace | None = None) -> mujoco.MjSpec:
    """The world under one lighting, with textures, lights, collision geoms and a camera named `film`.

    Visual geoms are in groups 0 (ground) and 1 and do not collide; collision geoms are in group 3 and are not filmed.
    """
    light = lightings.LIGHTINGS[lighting] if isinstance(lighting, str) else lighting
    place = place or places.build()
    model = collision_spec(place)
    model.modelname = f"reality_{light.name}"
    model.visual.map.znear, model.visual.map.zfar = 0.001, 10.0
    model.stat.extent, model.stat.center = 60.0, [20.0, -5.0, 0.0]
    visibility = ground_visibility(place) if light.occlusion > 0.0 else {}
    for name, image in place_textures().items():
        if name in visibility:
            image = _darkened(image, 1.0 - light.occlusion * (1.0 - visibility[name]))
        if light.wet > 0.0 and name in WET_TEXTURES:
            image = (image * (1.0 - light.wet)).astype(np.uint8)
        _add_texture(model, name, image)
    sky = lightings.sky_cube_map(light, SEED)
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
        mesh = model.add_mesh(name=obj.name)
        mesh.uservert = obj.part.vertices.astype(np.float32).ravel()
        mesh.userface = obj.part.faces.ravel()
        mesh.usertexcoord = obj.part.uv.astype(np.float32).ravel()
        mesh.userfacetexcoord = obj.part.faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        model.worldbody.add_geom(
            name=obj.name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=obj.name,
            material=obj.texture,
            contype=0,
            conaffinity=0,
            group=0 if obj.kind == "ground" else 1,
        )
    lightings.add_lights(model, light, np.array(place.lamp_heads))
    model.worldbody.add_camera(name="film", pos=[0, 0, 1.2])
    return model


def _darkened(image: NDArray[np.uint8], factor: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A texture multiplied by a coarse map of factors in [0, 1]."""
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
