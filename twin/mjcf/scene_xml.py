"""Stage `mjcf`: cameras, ground, parts and looks → `scene.xml` with `assets/` beside it, and `world.json`.

Geom groups: 0 ground, 1 the robot's looks, 2 the visual mesh (touches nothing), 3 the convex parts `part_0000`...,
4 the robot's collision shapes. Route, corridor and goal are sites of group 4. Every path in the XML is relative, so the
folder may be moved, zipped, or handed to anyone who has plain MuJoCo.
"""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.assets.ground import Ground
from twin.config import SceneConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.images import write_image
from twin.mjcf import husky
from twin.mjcf.world import (
    GROUND_GROUP,
    PART_GROUP,
    ROUTE_GROUP,
    SCENE_XML,
    VISUAL_GROUP,
    World,
    arc_lengths,
    corridor_edges,
    heading_at,
    point_at,
    total_turn,
)
from twin.robot import BASE_HEIGHT, HuskyParams, PixelCamera
from twin.scene import SceneDir
from twin.types import Array

# ---- Whether an exported scene can be moved, and what the robot meets at its start.
#
# *Built* is the model as the exporter compiled it; the *copy* is what plain MuJoCo makes of the written folder, moved.


_STEPS = 200  # driven through for the comparison
_APART = 0.002  # [m] base of the built robot and of the copy's may come apart in them
_DIGITS = 1e-5  # and as a share of where they are, for XML keeps six digits of a number
_CLEARANCE_RANGE = 5.0  # [m] within which parts are looked for around the spawn


def check_portable(folder: Path, built: mujoco.MjModel) -> dict[str, Any]:
    """Loads a moved copy of the scene in plain MuJoCo; its robot must do there what the built one does.

    Args:
        folder: Holds the written scene.
        built: With a keyframe `spawn` where there is a robot.

    Returns:
        Metrics for the report. `spawn_drift_m` is how far the parked robot creeps in 0.4 s, which on a slope is what
        its tyres imply.

    Raises:
        RuntimeError: the copy is another model, or its robot moves otherwise: a bug of the exporter.
    """
    with tempfile.TemporaryDirectory(prefix="twin-moved-") as temporary:
        moved = Path(temporary) / "elsewhere"
        shutil.copytree(folder, moved)
        copy = mujoco.MjModel.from_xml_path(str(moved / SCENE_XML))
    metrics: dict[str, Any] = {
        "geoms": int(copy.ngeom),
        "xml_bytes": (folder / SCENE_XML).stat().st_size,
        "assets_bytes": sum(path.stat().st_size for path in (folder / "assets").iterdir()),
    }
    sizes = [(model.ngeom, model.nq, model.nu, model.nkey) for model in (built, copy)]
    if sizes[0] != sizes[1]:
        raise RuntimeError(f"the moved copy has {sizes[1]} geoms, coordinates, motors, keyframes; built: {sizes[0]}")
    if not built.nkey:
        return metrics
    data = _at_spawn(copy)
    metrics["spawn_clearance_m"] = spawn_clearance(copy, data)
    path, touched = _parked(copy, data)
    apart = float(np.linalg.norm(path - _parked(built, _at_spawn(built))[0], axis=1).max())
    if not apart <= _APART + _DIGITS * np.abs(path[0]).max():
        raise RuntimeError(f"the robot of the moved copy moves otherwise: {apart:.4f} m apart within {_STEPS} steps")
    drift = float(np.linalg.norm(path[-1] - path[0]))
    return metrics | {"spawn_touched": sorted(touched), "spawn_drift_m": drift}


def robot_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms belong to the robot, shape (ngeom,)."""
    return model.body_rootid[model.geom_bodyid] == model.body("base_link").id


def touched_names(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Names of the geoms that the robot touches now, besides the ground."""
    pairs = data.contact.geom
    mine = robot_geoms(model)[pairs]
    other = pairs[mine[:, 0] != mine[:, 1]][~mine[mine[:, 0] != mine[:, 1]]]
    return {model.geom(int(i)).name for i in np.unique(other)} - {"ground"}


def spawn_clearance(model: mujoco.MjModel, data: mujoco.MjData) -> float | None:
    """Distance from the robot to the nearest convex part [m]; None where none is within 5 m."""
    robot = np.flatnonzero(robot_geoms(model) & (model.geom_contype > 0))
    parts = np.flatnonzero(model.geom_group == PART_GROUP)
    center = data.body("base_link").xpos
    near = parts[np.linalg.norm(data.geom_xpos[parts] - center, axis=1) < model.geom_rbound[parts] + _CLEARANCE_RANGE]
    distances = [
        mujoco.mj_geomDistance(model, data, int(a), int(b), _CLEARANCE_RANGE, None) for a in robot for b in near
    ]
    best = min(distances, default=_CLEARANCE_RANGE)
    return float(best) if best < _CLEARANCE_RANGE else None


def _at_spawn(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    mujoco.mj_forward(model, data)
    return data


def _parked(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, set[str]]:
    """Where the base of a robot left alone is after every step [m], shape (steps + 1, 3), and what it touched."""
    path, touched = [data.qpos[:3].copy()], touched_names(model, data)
    for _ in range(_STEPS):
        mujoco.mj_step(model, data)
        path.append(data.qpos[:3].copy())
        touched |= touched_names(model, data)
    return np.array(path), touched


# ---- Asset files as MuJoCo reads them: height fields, OBJ meshes, and textures that stand in for vertex colours.


_CHUNK = 50_000  # lines formatted at once


def write_hfield(path: Path, height: NDArray) -> None:
    """MuJoCo's binary height field: int32 rows, int32 columns, then float32 row by row from the low-y edge."""
    rows, columns = height.shape
    path.write_bytes(np.array([rows, columns], np.int32).tobytes() + height.astype(np.float32).tobytes())


def write_obj(path: Path, vertices: NDArray, faces: NDArray, texcoords: NDArray | None = None) -> None:
    """A Wavefront OBJ.

    Args:
        path: File to write.
        vertices: Shape (v, 3) [m].
        faces: Shape (f, 3), counter-clockwise seen from outside.
        texcoords: Per face and corner, u from the left and v from the top of the picture, shape (f, 3, 2).
    """
    with path.open("w", encoding="ascii") as file:
        _write_lines(file, "v %.5f %.5f %.5f\n", vertices)
        if texcoords is None:
            _write_lines(file, "f %d %d %d\n", faces + 1)
            return
        flipped = texcoords.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts v from the bottom
        _write_lines(file, "vt %.6f %.6f\n", flipped)
        corner = np.arange(1, 3 * len(faces) + 1).reshape(-1, 3)
        _write_lines(file, "f %d/%d %d/%d %d/%d\n", np.stack([faces + 1, corner], -1).reshape(-1, 6))


def _write_lines(file, line: str, rows: NDArray) -> None:
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        file.write(line * len(part) % tuple(part.ravel().tolist()))


def face_tiles(colors: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A texture that gives every face its own three corner colours, as MuJoCo knows no vertex colours.

    Each face owns 2 × 2 texels: corners 0, 1, 2 at the centres of three of them and c₁ + c₂ − c₀ in the fourth, which
    makes bilinear filtering exactly the linear interpolation across the triangle (but where the fourth is clamped).

    Args:
        colors: Per face and corner, shape (f, 3, 3) uint8.

    Returns:
        The texture, shape (h, w, 3), and texture coordinates per face and corner, shape (f, 3, 2), u from the left and
        v from the top.
    """
    count = len(colors)
    across = max(1, int(np.ceil(np.sqrt(count))))
    down = -(-count // across)
    c = colors.astype(np.int16)
    fourth = np.clip(c[:, 1] + c[:, 2] - c[:, 0], 0, 255)
    tiles = np.zeros((down * across, 2, 2, 3), np.uint8)
    tiles[:count] = np.stack([c[:, 0], c[:, 1], c[:, 2], fourth], 1).reshape(-1, 2, 2, 3)
    texture = tiles.reshape(down, across, 2, 2, 3).swapaxes(1, 2).reshape(2 * down, 2 * across, 3)
    corner = np.stack(np.divmod(np.arange(count), across)[::-1], 1)[:, None] * 2 + [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]
    return texture, corner / [2 * across, 2 * down]


_HFIELD_BASE = 1.0  # [m] of solid below the lowest point, so that nothing tunnels through
_GROUND_SKIN = 0.15  # [m] above the height field: visual mesh below this is left to the field's own texture
_SETTLE_TIME = 2.0  # [s]
_MIN_ROUTE = 2.0  # [m]
_SITE_SPACING = 1.0  # [m] between the route's sites


@dataclass(frozen=True)
class Parts:
    """P closed convex hulls [m]."""

    vertices: list[NDArray[np.float32]]
    faces: list[NDArray[np.int32]]

    @staticmethod
    def load(path: Path) -> "Parts":
        with np.load(path, allow_pickle=False) as data:
            v, f = data["vertex_start"], data["face_start"]
            return (
                Parts(np.split(data["vertices"], v[1:-1]), np.split(data["faces"], f[1:-1]))
                if len(v) > 1
                else Parts([], [])
            )


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Writes the portable scene.

    Args:
        scene: Reads the stages `metric` (Cameras) and `mesh` (ground.npz, parts.npz, visual.npz and, for a drive,
            route.npz).
        config: `mjcf` and `robot`.
        out: Gets `scene.xml`, `assets/` and, for a drive, `world.json`.

    Returns:
        Metrics for the report.

    Raises:
        InputError: the route is too short, starts off the ground or where it is too steep to stand, or something solid
            pushes the robot away there.
    """
    mesh = scene.stage("mesh")
    ground = Ground.load(mesh)
    parts = Parts.load(mesh / "parts.npz")
    assets = out / "assets"
    assets.mkdir(parents=True, exist_ok=True)

    spec = mujoco.MjSpec()
    spec.modelname = config.name or "twin"
    spec.meshdir = spec.texturedir = "assets"
    spec.modelfiledir = str(out.resolve())
    husky.set_options(spec, config.robot)
    # Spares MuJoCo the poses of thousands of geoms that never move; what has motors, the robot, never sleeps.
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    _add_surroundings(spec)
    add_ground(spec, ground, assets, config.mjcf.hfield_cell)
    faces = _add_visual(spec, ground, mesh / "visual.npz", assets)
    _add_parts(spec, parts, assets)

    route = load_route(mesh / "route.npz") if config.mjcf.route else None
    metrics: dict[str, Any] = {"parts": len(parts.vertices), "visual_faces": faces, "has_route": route is not None}
    if route is None:
        built = _write(spec, out)
        metrics |= {"route_length_m": None, "note": "no route: scene without a robot, corridor or goal"}
    else:
        camera = config.robot.camera(film_camera(Cameras.load(scene.stage("metric"))))
        spawn, blocked = _add_robot(spec, ground, route, config.robot, camera)
        _add_route(spec, route, config.mjcf.half_width)
        built = _write(spec, out)
        world = World(route, config.mjcf.half_width, spawn, out, camera, config.robot)
        world.save()
        metrics |= {
            "route_length_m": float(arc_lengths(route)[-1]),
            "turn_deg": float(np.rad2deg(total_turn(route))),
            "half_width_m": config.mjcf.half_width,
            "camera_intrinsics_px": world.intrinsics.tolist(),
        }
    metrics |= check_portable(out, built)
    if route is not None:
        metrics["spawn_touched"] = sorted(blocked | set(metrics["spawn_touched"]))
    return metrics


def load_route(path: Path) -> Array | None:
    """The route [m], shape (m, 3); None where the mesh stage found none."""
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as data:
        return np.concatenate([data["xy"], data["z"][:, None]], 1).astype(np.float64)


def film_camera(cameras: Cameras) -> PixelCamera:
    """The real camera of the first training frame."""
    training = np.flatnonzero(~cameras.held_out)
    first = int(training[0]) if len(training) else 0
    (width, height), (fx, fy, cx, cy) = cameras.sizes[first].tolist(), cameras.intrinsics[first].tolist()
    return PixelCamera((fx, fy, cx, cy), (width, height))


def rest_pose(height_at: Callable[[Array], Array], xy: Array, yaw: float) -> tuple[Array, Array]:
    """Base position [m] and quaternion (wxyz) of a robot whose wheels stand on the plane that fits the ground below.

    Args:
        height_at: Height of the ground [m] at points (n, 2), shape (n,).
        xy: Of the base [m], shape (2,).
        yaw: [rad]
    """
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])
    local = husky.wheel_centers()[:, :2]
    heights = height_at(xy + local[:, :1] * forward + local[:, 1:] * left)
    (slope_x, slope_y, height), *_ = np.linalg.lstsq(np.column_stack([local, np.ones(4)]), heights, rcond=None)
    x_axis = np.array([*forward, slope_x])
    y_axis = np.array([*left, slope_y])
    z_axis = np.cross(x_axis, y_axis)
    z_axis /= np.linalg.norm(z_axis)
    x_axis /= np.linalg.norm(x_axis)
    rotation = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], 1)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return np.array([*xy, height]) + z_axis * BASE_HEIGHT, quaternion


def covered_by_ground(vertices: NDArray, ground: Ground) -> NDArray[np.bool_]:
    """Which points (v, 3) the height field shows already: below it or hardly above, within its bounds.

    Two surfaces within centimetres of each other would flicker, shade each other and swallow the robot's wheels.
    """
    rows, columns = ground.height.shape
    cell = (vertices[:, :2] - ground.origin) / ground.cell
    inside = ((cell >= 0) & (cell <= [columns - 1, rows - 1])).all(1)
    return inside & (vertices[:, 2] - ground.at(vertices[:, :2]) < _GROUND_SKIN)


def compacted(vertices: NDArray, colors: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Drops the vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], colors[used], inverse.reshape(faces.shape)


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.55, 0.68, 0.85),
        rgb2=(0.86, 0.89, 0.92),
        width=128,
        height=128 * 6,
    )
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0, 0, 50),
        dir=(0.35, 0.25, -0.9),
        diffuse=(0.45, 0.45, 0.43),
        ambient=(0.0, 0.0, 0.0),
        specular=(0.2, 0.2, 0.2),
        castshadow=True,
    )
    spec.visual.headlight.ambient = (0.4, 0.4, 0.42)
    spec.visual.headlight.diffuse = (0.15, 0.15, 0.15)
    spec.visual.headlight.specular = (0, 0, 0)
    # Clipping planes are multiples of the extent: 0.1 m and 1 km, however large the scene is.
    spec.stat.extent = 20.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.005, 50.0


def add_ground(spec: mujoco.MjSpec, ground: Ground, assets: Path, cell: float) -> None:
    """Adds the geom `ground`, a height field of `cell` [m] in the ground's colours, its files in `assets`."""
    coarse = ground.coarsened(cell)
    write_hfield(assets / "ground.bin", coarse.height)
    # A texel per fine cell, the mean of its corners, as the texture spans the field edge to edge. First row: far (+y).
    finer = round(coarse.cell / ground.cell)
    rows, columns = ((size - 1) * finer + 1 for size in coarse.height.shape)
    rgb = ground.rgb[:rows, :columns].astype(np.uint16)
    cells = (rgb[1:, 1:] + rgb[1:, :-1] + rgb[:-1, 1:] + rgb[:-1, :-1] + 2) // 4
    write_image(assets / "ground.png", cells[::-1].astype(np.uint8))
    low, high = float(coarse.height.min()), float(coarse.height.max())
    half = np.array([columns - 1, rows - 1]) * ground.cell / 2
    # MuJoCo maps the file's lowest value to 0 and its highest to size[2]; a level field is all 0 at any size.
    spec.add_hfield(name="ground", file="ground.bin", size=(*half, max(high - low, 1e-3), _HFIELD_BASE))
    _add_textured(spec, "ground", emission=0.25)
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=(*(ground.origin + half), low),
        material="ground",
        group=GROUND_GROUP,
    )


def _add_textured(spec: mujoco.MjSpec, name: str, emission: float) -> None:
    """A material with `assets/<name>.png` as its colour. Filmed colours carry their own light, hence the emission."""
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material = spec.add_material(name=name, emission=emission, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_visual(spec: mujoco.MjSpec, ground: Ground, path: Path, assets: Path) -> int:
    with np.load(path, allow_pickle=False) as data:
        vertices, faces, colors = data["vertices"], data["faces"], data["colors"]
    faces = faces[~covered_by_ground(vertices, ground)[faces].all(1)]
    vertices, colors, faces = compacted(vertices, colors, faces)
    if len(faces) == 0:
        return 0
    texture, texcoords = face_tiles(colors[faces])
    write_image(assets / "visual.png", texture)
    write_obj(assets / "visual.obj", vertices, faces, texcoords)
    mesh = spec.add_mesh(name="visual", file="visual.obj")
    # An open surface has no volume.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    _add_textured(spec, "visual", emission=0.4)
    spec.worldbody.add_geom(
        name="visual",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="visual",
        material="visual",
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
    )
    return len(faces)


def _add_parts(spec: mujoco.MjSpec, parts: Parts, assets: Path) -> None:
    for i, (vertices, faces) in enumerate(zip(parts.vertices, parts.faces, strict=True)):
        name = f"part_{i:04d}"
        write_obj(assets / f"{name}.obj", vertices, faces)
        mesh = spec.add_mesh(name=name, file=f"{name}.obj")
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        # Neighbours in different hues, so that one sees where a part ends.
        hue = (i * 0.618034) % 1.0
        rgb = 0.5 + 0.4 * np.cos(2 * np.pi * (hue + np.array([0.0, 1 / 3, 2 / 3])))
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=PART_GROUP, rgba=(*rgb, 1.0)
        )


def _add_robot(
    spec: mujoco.MjSpec, ground: Ground, route: Array, params: HuskyParams, camera: PixelCamera
) -> tuple[tuple[float, float, float, float], set[str]]:
    """Puts the Husky at the route's start, lets it settle, and keeps that as keyframe `spawn`.

    Returns:
        x, y, z [m] and yaw [rad] at rest, and the names of what stood in its place besides the ground (and may have
        pushed it aside).
    """
    length = float(arc_lengths(route)[-1])
    if length < _MIN_ROUTE:
        raise InputError(f"the filmed route is {length:.2f} m long, expected {_MIN_ROUTE:g} m; set mjcf.route = false")
    yaw = float(heading_at(route, 0.0))
    rows, columns = ground.height.shape
    edge = np.minimum(
        route[0, :2] - ground.origin, ground.origin + np.array([columns - 1, rows - 1]) * ground.cell - route[0, :2]
    )
    if edge.min() < 1.0:
        raise InputError(
            f"the route starts {edge.min():.2f} m from the edge of the ground, expected at least 1 m; raise mesh.margin"
        )
    position, quaternion = rest_pose(ground.at, route[0, :2], yaw)
    x, y = quaternion[1:3]
    fall, steepest = np.degrees(np.arccos(1 - 2 * (x * x + y * y))), np.degrees(np.arctan(params.friction))
    if fall >= steepest:
        raise InputError(
            f"the ground at the route's start falls by {fall:.1f}°, expected at most {steepest:.1f}° for tyres of "
            f"friction {params.friction:g} to hold; film from a flatter start, or raise the robot's friction"
        )
    husky.add_husky(spec, position, quaternion, params, camera)
    model = husky.held(spec.compile())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    blocked = touched_names(model, data)
    mujoco.mj_step(model, data, int(_SETTLE_TIME / husky.TIMESTEP))
    moved = float(np.linalg.norm(data.qpos[:2] - position[:2]))
    if not moved < 0.05 or abs(data.qpos[2] - position[2]) > 0.1:
        raise InputError(
            f"the robot does not rest at the route's start: moved {moved:.2f} m, {data.qpos[2] - position[2]:+.2f} m "
            f"up in {_SETTLE_TIME:g} s, expected < 0.05; something solid is there: raise mesh.obstacle_height"
        )
    spec.add_key(name="spawn", qpos=data.qpos)
    x, y, z = data.qpos[:3]
    forward = data.body("base_link").xmat.reshape(3, 3)[:, 0]
    return (float(x), float(y), float(z), float(np.arctan2(forward[1], forward[0]))), blocked


def _add_route(spec: mujoco.MjSpec, route: Array, half_width: float) -> None:
    s = np.arange(0.0, arc_lengths(route)[-1], _SITE_SPACING)
    left, right = corridor_edges(route, half_width)
    for prefix, line, rgba in (
        ("route", route, (0.1, 0.8, 0.2, 1.0)),
        ("corridor_left", left, (0.9, 0.9, 0.2, 1.0)),
        ("corridor_right", right, (0.9, 0.9, 0.2, 1.0)),
    ):
        knots = arc_lengths(route)
        points = np.stack([np.interp(s, knots, line[:, k]) for k in range(3)], 1)
        for i, point in enumerate(points):
            spec.worldbody.add_site(
                name=f"{prefix}_{i:03d}", pos=point, size=(0.05, 0.05, 0.05), group=ROUTE_GROUP, rgba=rgba
            )
    spec.worldbody.add_site(
        name="goal", pos=point_at(route, np.inf), size=(0.2, 0.2, 0.2), group=ROUTE_GROUP, rgba=(0.9, 0.1, 0.1, 1)
    )


def _write(spec: mujoco.MjSpec, out: Path) -> mujoco.MjModel:
    model = spec.compile()
    (out / SCENE_XML).write_text(spec.to_xml(), encoding="utf-8")
    return model
