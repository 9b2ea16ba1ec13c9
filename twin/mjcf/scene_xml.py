"""Stage `mjcf`: writes `scene.xml`, its `assets/` and `world.json` from cameras, ground, convex parts and visual mesh.

The wheels' height field is the ground of stage `mesh` in cells of `mjcf.hfield_cell`. The ground has no friction of its
own: the tires' contact parameters apply (`priority` in `husky.py`; values in `twin.robot.HuskyParams`).

Geom groups: 0 ground, 1 visual geoms of the robot, 2 visual mesh (no contacts), 3 convex parts `part_0000`...,
4 collision geoms of the robot. Route, corridor and goal are sites of group 4. All paths in the XML are relative, so
plain MuJoCo loads the folder from anywhere.
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
from twin.config import RouteConfig, SceneConfig
from twin.errors import InputError
from twin.files import load_arrays
from twin.geometry.cameras import Cameras, depth_determined, opencv_to_mujoco, project
from twin.geometry.images import read_image, write_image
from twin.geometry.polyline import arc_lengths, corridor_edges, heading_at, point_at, total_turn
from twin.geometry.poses import pose_of
from twin.geometry.route import BRANCH
from twin.mjcf import husky
from twin.mjcf.world import (
    GROUND_GROUP,
    PART_GROUP,
    ROUTE_GROUP,
    SCENE_XML,
    VISUAL_GROUP,
    World,
)
from twin.robot import BASE_HEIGHT, CAMERA_SIZE, HuskyParams, PixelCamera
from twin.scene import SceneDir
from twin.types import Array

_HFIELD_BASE = 1.0  # [m] thickness of solid ground below the lowest point, against tunneling
_GROUND_OVERLAP = 0.15  # [m] up to this height above the height field, the visual mesh is left out
_SETTLE_TIME = 2.0  # [s] simulated time in which the robot comes to rest before its state is stored
_MIN_ROUTE = 2.0  # [m] least length of a route
_SITE_SPACING = 1.0  # [m] between sites along the route
_LATEST_START = 6.0  # [m] largest station at which the robot starts; also at most a quarter of the route
_LOOK_AHEAD = 6.0  # [m] length of the corridor ahead of the latest start whose ground is checked
_VIEW_MARGIN = 8  # [px] by which the robot's picture is enlarged when its first view is checked


@dataclass(frozen=True)
class Parts:
    """Closed convex hulls: vertices (v, 3) [m] and faces (f, 3) of each."""

    vertices: list[NDArray[np.float32]]
    faces: list[NDArray[np.int32]]

    @staticmethod
    def load(path: Path) -> "Parts":
        """Reads `parts.npz`."""
        data = load_arrays(path)
        v, f = data["vertex_start"], data["face_start"]
        if len(v) <= 1:
            return Parts([], [])
        return Parts(np.split(data["vertices"], v[1:-1]), np.split(data["faces"], f[1:-1]))


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Runs the stage, see `twin.build`: writes the scene from the stages `metric` and `mesh`; returns metrics.

    Raises:
        InputError: the route is too short, or starts near the edge of the ground, on too steep a slope, or where an
            obstacle pushes the robot away.
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
    # The sleep flag saves time: MuJoCo then does not recompute the poses of the static geoms, of which there may be
    # thousands. The robot has motors, so it never sleeps.
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    _add_sky_and_lights(spec)
    picture = mesh / "ground.png"  # the stage `mesh` writes it; `build_assets` alone does not
    add_ground(spec, ground, assets, config.mjcf.hfield_cell, read_image(picture) if picture.exists() else None)
    faces = _add_visual(spec, ground, mesh / "visual.npz", assets)
    _add_parts(spec, parts, assets)

    route, branches = _load_routes(mesh / "route.npz") if config.mjcf.route else (None, {})
    metrics: dict[str, Any] = {"parts": len(parts.vertices), "visual_faces": faces, "has_route": route is not None}
    if route is None:
        metrics |= {"route_length_m": None, "note": "no route: scene without a robot, corridor or goal"}
    else:
        cameras = Cameras.load(scene.stage("metric"))
        camera = config.robot.camera(film_camera(cameras))
        half_width = config.mjcf.half_width

        def first_vertex(line: Array, chosen: RouteConfig) -> int:
            if chosen.points:  # who gives way points gives the start
                return 0
            return first_filmed(line, half_width, ground, cameras, config.robot, camera)

        first = first_vertex(route, config.route)
        lines = {one.name: (branches[one.name], one) for one in config.branch if one.name in branches}
        starts = {name: float(arc_lengths(line)[first_vertex(line, one)]) for name, (line, one) in lines.items()}
        spawn, initial_contacts = _add_robot(spec, ground, route[first:], config.robot, camera)
        _add_route(spec, route, half_width)
        start = float(arc_lengths(route)[first])
        world = World(route, half_width, spawn, out, camera, config.robot, branches, start, starts)
        world.save()
        metrics |= {
            "route_length_m": world.length,
            "route_start_m": world.start,
            "turn_deg": float(np.rad2deg(total_turn(route))),
            "half_width_m": config.mjcf.half_width,
            "camera_intrinsics_px": world.intrinsics.tolist(),
        }
    built = spec.compile()
    (out / SCENE_XML).write_text(spec.to_xml(), encoding="utf-8")
    metrics |= check_portable(out, built)
    if route is not None:
        metrics["spawn_touched"] = sorted(initial_contacts | set(metrics["spawn_touched"]))
    return metrics


def _load_routes(path: Path) -> tuple[Array | None, dict[str, Array]]:
    """The route [m], shape (m, 3), and the branches by name; None and {} if the stage `mesh` wrote none."""
    if not path.exists():
        return None, {}
    data = load_arrays(path)
    route = np.concatenate([data["xy"], data["z"][:, None]], 1).astype(np.float64)
    branches = {key: line.astype(np.float64) for key, line in data.items() if key.startswith(BRANCH)}
    return route, {key.removeprefix(BRANCH): line for key, line in branches.items()}


def film_camera(cameras: Cameras) -> PixelCamera:
    """The camera of the first training frame, at that frame's size."""
    first = int(np.argmin(cameras.held_out))
    (width, height), (fx, fy, cx, cy) = cameras.sizes[first].tolist(), cameras.intrinsics[first].tolist()
    return PixelCamera((fx, fy, cx, cy), (width, height))


def first_filmed(
    route: Array, half_width: float, ground: Ground, cameras: Cameras, params: HuskyParams, camera: PixelCamera
) -> int:
    """First vertex of the route (m, 3) from which the robot sees only corridor ground whose depth the films determine.

    A film's first frames show the ground from some meters ahead on; a robot at the same place, whose camera is lower,
    would see ground that no frame shows. 0 if there is no such vertex up to `_LATEST_START` and a quarter of the route.
    """
    knots = arc_lengths(route)
    most = max(min(_LATEST_START, knots[-1] / 4, knots[-1] - _MIN_ROUTE), 0.0)
    stations, aside = np.arange(0.0, most + _LOOK_AHEAD, 0.1), np.linspace(-half_width, half_width, 11)
    heading = heading_at(route, stations)
    left = np.stack([-np.sin(heading), np.cos(heading)], -1)
    xy = point_at(route[:, :2], stations)[:, None] + aside[:, None] * left[:, None]
    points = np.concatenate([xy, ground.at(xy)[..., None]], -1).reshape(-1, 3)
    along, undetermined = stations.repeat(len(aside)), ~depth_determined(cameras, points)
    size, intrinsics = np.array(CAMERA_SIZE), np.array(camera.resized(CAMERA_SIZE).intrinsics)
    rotation = np.zeros(9)
    for k in range(int(np.searchsorted(knots, most, "right"))):
        ahead = points[undetermined & (along > knots[k])]
        base, quaternion = rest_pose(ground.at, route[k, :2], float(heading_at(route, knots[k])))
        mujoco.mju_quat2Mat(rotation, quaternion)
        pixels, depth = project(ahead, camera_pose(params, base, rotation.reshape(3, 3)), intrinsics)
        in_view = ((pixels >= -_VIEW_MARGIN) & (pixels <= size + _VIEW_MARGIN)).all(1)
        if not (in_view & (depth > 0.0)).any():
            return k
    return 0


def rest_pose(height_at: Callable[[Array], Array], xy: Array, yaw: float) -> tuple[Array, Array]:
    """Base position [m] and quaternion (wxyz) of a robot on the plane fitted to the ground below its wheels.

    `height_at` maps points (n, 2) to ground heights (n,) [m]; `xy` (2,) [m] and `yaw` [rad] are those of the base.
    """
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])
    local = husky.wheel_centers()[:, :2]
    heights = height_at(xy + local[:, :1] * forward + local[:, 1:] * left)
    (slope_x, slope_y, height), *_ = np.linalg.lstsq(np.column_stack([local, np.ones(4)]), heights, rcond=None)
    x_axis = np.array([*forward, slope_x])
    z_axis = np.cross(x_axis, [*left, slope_y])
    z_axis /= np.linalg.norm(z_axis)
    x_axis /= np.linalg.norm(x_axis)
    rotation = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], 1)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return np.array([*xy, height]) + z_axis * BASE_HEIGHT, quaternion


def camera_pose(params: HuskyParams, base: Array, rotation: Array) -> Array:
    """camera_to_world (4, 4), OpenCV axes, of the front camera; position (3,) [m] and axes (3, 3) of the base."""
    pose = pose_of(rotation @ params.camera_rotation, base + rotation @ params.camera_position)
    return opencv_to_mujoco(pose)  # this conversion is its own inverse


def covered_by_ground(vertices: NDArray, ground: Ground) -> NDArray[np.bool_]:
    """Mask of the points (v, 3) within the height field's horizontal bounds that are below it or up to 0.15 m above it.

    The visual mesh is left out there: two nearly equal surfaces would flicker, shadow each other and hide wheels.
    """
    rows, columns = ground.height.shape
    cell = (vertices[:, :2] - ground.origin) / ground.cell
    inside = ((cell >= 0) & (cell <= [columns - 1, rows - 1])).all(1)
    return inside & (vertices[:, 2] - ground.at(vertices[:, :2]) < _GROUND_OVERLAP)


def _add_sky_and_lights(spec: mujoco.MjSpec) -> None:
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
    # Clipping planes, in multiples of the extent: 0.1 m and 1 km for any scene.
    spec.stat.extent = 20.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.005, 50.0


def add_ground(
    spec: mujoco.MjSpec, ground: Ground, assets: Path, cell: float, picture: NDArray[np.uint8] | None = None
) -> None:
    """Adds the geom `ground`, a height field of `cell` [m]; writes its files to `assets`.

    Its texture is `picture` (see `ground_picture`), or shows the mean color of each cell of the ground.
    """
    coarse = ground.coarsened(cell)
    # MuJoCo's binary height field: int32 rows, int32 columns, then float32 rows from the low-y edge.
    size = np.array(coarse.height.shape, np.int32)
    (assets / "ground.bin").write_bytes(size.tobytes() + coarse.height.astype(np.float32).tobytes())
    # The texture spans the height field from edge to edge; its first row is at +y. Without a picture, each fine cell is
    # a texel, with the mean color of the cell's corners.
    finer = round(coarse.cell / ground.cell)
    rows, columns = ((size - 1) * finer + 1 for size in coarse.height.shape)
    rgb = ground.rgb[:rows, :columns].astype(np.uint16)
    texels = ((rgb[1:, 1:] + rgb[1:, :-1] + rgb[:-1, 1:] + rgb[:-1, :-1] + 2) // 4).astype(np.uint8)
    if picture is not None:
        k = picture.shape[0] // (ground.height.shape[0] - 1)  # texels along a cell
        texels = picture[: k * (rows - 1), : k * (columns - 1)]
    write_image(assets / "ground.png", texels[::-1])
    low, high = float(coarse.height.min()), float(coarse.height.max())
    half = np.array([columns - 1, rows - 1]) * ground.cell / 2
    # MuJoCo maps the file's lowest value to 0 and its highest to size[2], which must be positive. On level ground all
    # heights are mapped to 0, so the 1e-3 has no effect.
    spec.add_hfield(name="ground", file="ground.bin", size=(*half, max(high - low, 1e-3), _HFIELD_BASE))
    _add_textured_material(spec, "ground", emission=0.25)
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=(*(ground.origin + half), low),
        material="ground",
        group=GROUND_GROUP,
    )


def _add_textured_material(spec: mujoco.MjSpec, name: str, emission: float) -> None:
    """Adds a material with the texture `<name>.png`; it emits light, since filmed colors include the lighting."""
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material = spec.add_material(name=name, emission=emission, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_visual(spec: mujoco.MjSpec, ground: Ground, path: Path, assets: Path) -> int:
    data = load_arrays(path)
    vertices, faces, colors = data["vertices"], data["faces"], data["colors"]
    faces = faces[~covered_by_ground(vertices, ground)[faces].all(1)]
    if len(faces) == 0:
        return 0
    texture, texcoords = face_texture(colors[faces])
    write_image(assets / "visual.png", texture)
    used, index = np.unique(faces, return_inverse=True)
    write_obj(assets / "visual.obj", vertices[used], index.reshape(faces.shape), texcoords)
    mesh = spec.add_mesh(name="visual", file="visual.obj")
    # SHELL: an open surface has no volume.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    _add_textured_material(spec, "visual", emission=0.4)
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
        # Consecutive parts differ in hue, which shows their borders.
        hue = (i * 0.618034) % 1.0
        rgb = 0.5 + 0.4 * np.cos(2 * np.pi * (hue + np.array([0.0, 1 / 3, 2 / 3])))
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=PART_GROUP, rgba=(*rgb, 1.0)
        )


def _add_robot(
    spec: mujoco.MjSpec, ground: Ground, route: Array, params: HuskyParams, camera: PixelCamera
) -> tuple[tuple[float, float, float, float], set[str]]:
    """Adds the Husky at the start of the route, lets it settle, and stores its state as the keyframe `spawn`.

    Returns:
        x, y, z [m] and yaw [rad] at rest, and the names of the geoms other than the ground that the robot touched
        before it settled; these may have pushed it aside.
    """
    length = float(arc_lengths(route)[-1])
    if length < _MIN_ROUTE:
        raise InputError(
            f"the route is {length:.2f} m long, expected at least {_MIN_ROUTE:g} m; film a longer path, or set "
            "mjcf.route = false for a scene without a robot"
        )
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
    slope, max_slope = np.degrees(np.arccos(1 - 2 * (x * x + y * y))), np.degrees(np.arctan(params.friction))
    if slope >= max_slope:
        raise InputError(
            f"the ground at the start of the route falls by {slope:.1f}°, expected at most {max_slope:.1f}° for "
            f"tires of friction {params.friction:g} to hold; film from a flatter start, or raise the robot's friction"
        )
    husky.add_husky(spec, position, quaternion, params, camera)
    model = husky.stiffen_for_rest(spec.compile())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    initial_contacts = _touched_geoms(model, data)
    mujoco.mj_step(model, data, int(_SETTLE_TIME / husky.TIMESTEP))
    moved = float(np.linalg.norm(data.qpos[:2] - position[:2]))
    if not moved < 0.05 or abs(data.qpos[2] - position[2]) > 0.1:
        raise InputError(
            f"the robot does not rest at the start of the route: it moved {moved:.2f} m sideways and "
            f"{data.qpos[2] - position[2]:+.2f} m up in {_SETTLE_TIME:g} s, expected < 0.05 m and ± 0.1 m; "
            "an obstacle is there: raise mesh.obstacle_height"
        )
    spec.add_key(name="spawn", qpos=data.qpos)
    x, y, z = data.qpos[:3]
    forward = data.body("base_link").xmat.reshape(3, 3)[:, 0]
    return (float(x), float(y), float(z), float(np.arctan2(forward[1], forward[0]))), initial_contacts


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


# ---- mesh files


def write_obj(path: Path, vertices: NDArray, faces: NDArray, texcoords: NDArray | None = None) -> None:
    """Writes a Wavefront OBJ of vertices (v, 3) [m] and faces (f, 3), counter-clockwise seen from outside.

    `texcoords` are the texture coordinates of each face's corners, u from the left, v from the top, shape (f, 3, 2).
    trimesh would write a separate vertex for each of these, in a file almost twice as large.
    """

    def lines(line: str, rows: NDArray) -> str:
        return line * len(rows) % tuple(rows.ravel().tolist())

    with path.open("w", encoding="ascii") as file:
        file.write(lines("v %.5f %.5f %.5f\n", vertices))
        if texcoords is None:
            file.write(lines("f %d %d %d\n", faces + 1))
            return
        flipped = texcoords.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]  # OBJ measures v from the bottom
        file.write(lines("vt %.6f %.6f\n", flipped))
        corner = np.arange(1, 3 * len(faces) + 1).reshape(-1, 3)
        file.write(lines("f %d/%d %d/%d %d/%d\n", np.stack([faces + 1, corner], -1).reshape(-1, 6)))


def face_texture(colors: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Texture (h, w, 3) of the faces' corner colors (f, 3, 3), uint8, and coordinates as in `write_obj`.

    MuJoCo has no vertex colors. Each face gets 2 × 2 texels: its corner colors c₀, c₁, c₂ and c₁ + c₂ − c₀, so that
    bilinear filtering equals linear interpolation across the triangle (unless the fourth texel is clipped).
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


# ---- portability check

_COMPARED_STEPS = 200
_MAX_DEVIATION = 0.002  # [m] largest distance between the robot bases of the compiled model and of the copy
_XML_PRECISION = 1e-5  # further allowed deviation [fraction of the coordinates], since the XML keeps six digits
CLEARANCE_RANGE = 5.0  # [m] search radius for parts around the spawn


def check_portable(folder: Path, built: mujoco.MjModel) -> dict[str, Any]:
    """Loads a moved copy of the scene in plain MuJoCo and compares its robot's motion with that in the model `built`.

    Returns metrics for the report. `spawn_drift_m` is the distance that the parked robot creeps in 0.4 s on its soft
    tires, for example on a slope.

    Raises:
        RuntimeError: the copy is a different model or its robot moves differently, which is a bug.
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
        raise RuntimeError(
            f"the moved copy has {sizes[1]} geoms, coordinates, motors and keyframes, expected {sizes[0]}"
        )
    if not built.nkey:
        return metrics
    data = _reset_to_spawn(copy)
    metrics["spawn_clearance_m"] = _spawn_clearance(copy, data)
    path, touched = _simulate_parked(copy, data)
    deviation = float(np.linalg.norm(path - _simulate_parked(built, _reset_to_spawn(built))[0], axis=1).max())
    if not deviation <= _MAX_DEVIATION + _XML_PRECISION * np.abs(path[0]).max():
        raise RuntimeError(
            f"the robot of the moved copy moves differently: {deviation:.4f} m apart in {_COMPARED_STEPS} steps"
        )
    drift = float(np.linalg.norm(path[-1] - path[0]))
    return metrics | {"spawn_touched": sorted(touched), "spawn_drift_m": drift}


def _robot_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mask of the robot's geoms, shape (ngeom,)."""
    return model.body_rootid[model.geom_bodyid] == model.body("base_link").id


def _touched_geoms(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Names of the geoms that the robot touches, except the ground."""
    pairs = data.contact.geom
    own = _robot_geoms(model)[pairs]
    other = pairs[~own & own.any(1, keepdims=True)]
    return {model.geom(int(i)).name for i in np.unique(other)} - {"ground"}


def _spawn_clearance(model: mujoco.MjModel, data: mujoco.MjData) -> float | None:
    """Distance from the robot to the nearest convex part [m]; None if there is none within 5 m."""
    robot = np.flatnonzero(_robot_geoms(model) & (model.geom_contype > 0))
    parts = np.flatnonzero(model.geom_group == PART_GROUP)
    center = data.body("base_link").xpos
    near = parts[np.linalg.norm(data.geom_xpos[parts] - center, axis=1) < model.geom_rbound[parts] + CLEARANCE_RANGE]
    pairs = [(int(a), int(b)) for a in robot for b in near]
    distances = [mujoco.mj_geomDistance(model, data, a, b, CLEARANCE_RANGE, None) for a, b in pairs]
    nearest = min(distances, default=CLEARANCE_RANGE)
    return float(nearest) if nearest < CLEARANCE_RANGE else None


def _reset_to_spawn(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("spawn").id)
    mujoco.mj_forward(model, data)
    return data


def _simulate_parked(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, set[str]]:
    """Base positions of a robot without commands [m], shape (steps + 1, 3), and names of the geoms it touched."""
    path, touched = [data.qpos[:3].copy()], _touched_geoms(model, data)
    for _ in range(_COMPARED_STEPS):
        mujoco.mj_step(model, data)
        path.append(data.qpos[:3].copy())
        touched |= _touched_geoms(model, data)
    return np.array(path), touched
