"""Layers of the page: geometry of the scene that the browser draws over the picture, each sent when first shown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import viser
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.assets.ground import Ground
from twin.errors import InputError
from twin.files import load_arrays
from twin.geometry.cameras import Cameras
from twin.loading import Twin
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import World, corridor_edges, heading_at, point_at
from twin.nerf.baked import BakedField
from twin.report.review_video import trust_grid
from twin.scene import require_stage
from twin.types import Array

PALETTE = ((255, 183, 77), (100, 181, 246), (186, 104, 200), (129, 199, 132), (229, 115, 115), (77, 208, 225))
"""Colors of the filmed lightings, in their order."""

_UP = np.array([0.0, 0.0, 0.04])  # [m] lift of lines and areas above the ground, so that it does not hide them
_GROUND_CELL, _GROUND_FACES = 0.25, 40_000
_MAX_FRUSTUMS = 60  # per lighting
_FRUSTUM_SCALE = 0.25
_NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_ROUTE_COLOR, _CORRIDOR_COLOR, _PART_COLOR, _GROUND_COLOR = (255, 214, 0), (0, 200, 255), (255, 87, 51), (120, 144, 156)


def wxyz_of(rotation: Array) -> Array:
    """Quaternion w, x, y, z of a rotation matrix (3, 3)."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


@dataclass
class Layer:
    """One layer; its nodes are below `/layers/<name>`."""

    name: str
    hint: str
    add: Callable[[str], list[viser.SceneNodeHandle]]
    """Adds the nodes below a path and returns them."""
    nodes: list[viser.SceneNodeHandle] | None = None

    def show(self, visible: bool) -> None:
        if self.nodes is None and visible:
            self.nodes = self.add(f"/layers/{self.name.replace(' ', '_')}")
        for node in self.nodes or ():
            node.visible = visible


def scene_layers(
    server: viser.ViserServer, twin: Twin, field: BakedField, on_frame: Callable[[viser.ClientHandle, int], None]
) -> list[Layer]:
    """The layers that a scene has.

    Args:
        server: Shows them.
        twin: The built scene.
        field: For the trust map.
        on_frame: Called with the index of the filmed frame whose frustum is clicked.
    """
    scene, cameras = server.scene, twin.cameras()
    text = "click one to see its frame"
    out = [Layer("filmed cameras", text, lambda path: _frustums(server, path, cameras, on_frame))]
    if _has(twin, "mesh"):
        mesh = twin.scene.stage("mesh")
        out += [
            Layer("mesh", "what other programs get: the visual mesh", lambda path: [_visual_mesh(scene, path, twin)]),
            Layer("ground", "the height field that the wheels roll on", lambda path: [_ground(scene, path, twin)]),
        ]
        if (mesh / "parts.npz").exists():
            text = "the solid parts that the robot collides with"
            out.append(Layer("convex parts", text, lambda path: _parts(scene, path, twin)))
    if twin.scene.has_route and _has(twin, "mjcf"):
        world = twin.world()
        out += [
            Layer("route", "the line to be driven", lambda path: [_route(scene, path, world)]),
            Layer("corridor", "where the robot may drive", lambda path: [_corridor(scene, path, world)]),
            Layer(
                "trust map",
                "how far the robot's pictures can be trusted: dark is far from the film, or full of holes",
                lambda path: [_trust_map(scene, path, world, cameras, field)],
            ),
        ]
    return out


def _has(twin: Twin, stage: str) -> bool:
    try:
        require_stage(twin.scene, stage)
    except InputError:
        return False
    return True


def _frustums(
    server: viser.ViserServer, path: str, cameras: Cameras, on_frame: Callable[[viser.ClientHandle, int], None]
) -> list[viser.SceneNodeHandle]:
    nodes: list[viser.SceneNodeHandle] = []
    for number, lighting in enumerate(dict.fromkeys(cameras.lightings)):
        mine = np.flatnonzero([name == lighting for name in cameras.lightings])
        for i in mine[:: -(-len(mine) // _MAX_FRUSTUMS)].tolist():
            width, height = cameras.sizes[i]
            node = server.scene.add_camera_frustum(
                f"{path}/{cameras.names[i]}",
                fov=float(2.0 * np.arctan(height / 2.0 / cameras.intrinsics[i, 1])),
                aspect=float(width / height),
                scale=_FRUSTUM_SCALE,
                color=PALETTE[number % len(PALETTE)],
                wxyz=wxyz_of(cameras.camera_to_world[i, :3, :3]),
                position=cameras.camera_to_world[i, :3, 3],
                cast_shadow=False,
                receive_shadow=False,
            )

            def clicked(event: viser.SceneNodePointerEvent, frame: int = i) -> None:
                on_frame(event.client, frame)

            node.on_click(clicked)
            nodes.append(node)
    return nodes


def _visual_mesh(scene: viser.SceneApi, path: str, twin: Twin) -> viser.SceneNodeHandle:
    mesh = load_arrays(twin.scene.stage("mesh") / "visual.npz")
    return _colored_mesh(scene, path, mesh["vertices"], mesh["faces"], mesh["colors"])


def _ground(scene: viser.SceneApi, path: str, twin: Twin) -> viser.SceneNodeHandle:
    vertices, faces = Ground.load(twin.scene.stage("mesh")).triangles(_GROUND_CELL, _GROUND_FACES)
    lifted = vertices + _UP
    return scene.add_mesh_simple(path, lifted, faces, color=_GROUND_COLOR, wireframe=True, **_NO_SHADOWS)


def _parts(scene: viser.SceneApi, path: str, twin: Twin) -> list[viser.SceneNodeHandle]:
    parts = Parts.load(twin.scene.stage("mesh") / "parts.npz")
    if not parts.vertices:
        return []
    offsets = np.cumsum([0, *(len(one) for one in parts.vertices[:-1])])
    vertices = np.concatenate(parts.vertices)
    faces = np.concatenate([one + first for one, first in zip(parts.faces, offsets, strict=True)])
    common = {"vertices": vertices, "faces": faces, "color": _PART_COLOR, "side": "double", **_NO_SHADOWS}
    solid = scene.add_mesh_simple(path, opacity=0.35, flat_shading=True, **common)
    return [solid, scene.add_mesh_simple(f"{path}_edges", wireframe=True, opacity=0.5, **common)]


def _route(scene: viser.SceneApi, path: str, world: World) -> viser.SceneNodeHandle:
    points = world.route + _UP
    segments = np.stack([points[:-1], points[1:]], 1)
    return scene.add_line_segments(path, segments, _ROUTE_COLOR, thickness=0.08)


def _corridor(scene: viser.SceneApi, path: str, world: World) -> viser.SceneNodeHandle:
    left, right = corridor_edges(world.route, world.half_width)
    vertices = np.concatenate([left, right]) + _UP
    i = np.arange(len(left) - 1)
    n = len(left)
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    return scene.add_mesh_simple(
        path, vertices, faces, color=_CORRIDOR_COLOR, opacity=0.3, side="double", **_NO_SHADOWS
    )


def _trust_map(
    scene: viser.SceneApi, path: str, world: World, cameras: Cameras, field: BakedField
) -> viser.SceneNodeHandle:
    s, offsets, trust = trust_grid(field, cameras, world)
    heading = heading_at(world.route, s)
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
    points = point_at(world.route, s) + offsets[:, None, None] * left + 2.0 * _UP
    rows, columns = trust.shape
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    colors = (255.0 * colormaps["viridis"](trust.ravel())[:, :3]).astype(np.uint8)
    return _colored_mesh(scene, path, points.reshape(-1, 3), faces, colors, double=True)


def _colored_mesh(
    scene: viser.SceneApi, path: str, vertices: NDArray, faces: NDArray, colors: NDArray, double: bool = False
) -> viser.SceneNodeHandle:
    """A mesh with a color per vertex, uint8 (v, 3), without shading by lights of the page."""
    if double:
        faces = np.concatenate([faces, faces[:, ::-1]])
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    return scene.add_mesh_trimesh(path, mesh, **_NO_SHADOWS)
