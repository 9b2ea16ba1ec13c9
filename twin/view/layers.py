"""Layers: geometry of the scene that the browser draws over the picture. Each is sent when it is first shown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from twin.files import load_arrays
from twin.geometry.cameras import Cameras, unproject
from twin.geometry.polyline import corridor_edges, heading_at, point_at
from twin.loading import Twin
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.scene import require_stage
from twin.types import Array

FILMED_CAMERAS = "filmed cameras"
PALETTE = ((255, 183, 77), (100, 181, 246), (186, 104, 200), (129, 199, 132), (229, 115, 115), (77, 208, 225))
"""Colors of the filmed lightings, in their order."""

_UP = np.array([0.0, 0.0, 0.04])  # [m] lift of lines and areas, so that the ground does not hide them
_GROUND_CELL, _GROUND_FACES = 0.25, 40_000  # [m] smallest width of faces, and their largest number
_FRUSTUM_DEPTH = 0.2  # [m] size of a drawn camera
_CLICK_ANGLE = 0.5  # [°] largest angle between the ray of a click and the camera that it selects
_GAMMA = 2.2
_TRUST_STEP = 0.4  # [m] between points of the trust map
_NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_ROUTE_COLOR, _CORRIDOR_COLOR, _GROUND_COLOR = (255, 214, 0), (0, 200, 255), (120, 144, 156)
_PART_COLOR, _EDGE_COLOR = (255, 87, 51), (200, 60, 40)


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


def scene_layers(scene: viser.SceneApi, twin: Twin, field: BakedField) -> list[Layer]:
    """The layers of a built scene. A damaged layer raises an error when it is shown. `field` is for the trust map."""
    cameras = twin.cameras()
    out = [Layer(FILMED_CAMERAS, "click one to see its frame", lambda path: _frustums(scene, path, cameras))]
    mesh = twin.scene.stage("mesh")
    if (mesh / "stamp.json").exists():
        out += [
            Layer("mesh", "the filmed surface, as twin exports it", lambda path: [_visual_mesh(scene, path, twin)]),
            Layer("ground", "the height field that the wheels roll on", lambda path: [_ground(scene, path, twin)]),
        ]
        if (mesh / "parts.npz").exists():
            text = "the convex parts that the robot collides with"
            out.append(Layer("convex parts", text, lambda path: _parts(scene, path, twin)))
    if twin.scene.has_route:

        def drawn(draw: Callable[..., viser.SceneNodeHandle]) -> Callable[[str], list[viser.SceneNodeHandle]]:
            def add(path: str) -> list[viser.SceneNodeHandle]:
                world = twin.world()
                branches = ("", *world.branches)
                return [draw(scene, f"{path}/{k}", world.along(branch)) for k, branch in enumerate(branches)]

            return add

        out += [
            Layer("route", "the line to be driven, and its branches", drawn(_route)),
            Layer("corridor", "where the robot may drive", drawn(_corridor)),
            Layer(
                "trust map",
                "dark where the robot's pictures are unreliable: far from filmed cameras, or at holes in the field",
                lambda path: [_trust_map(scene, path, twin, twin.world(), cameras, field)],
            ),
        ]
    return out


def _frustums(scene: viser.SceneApi, path: str, cameras: Cameras) -> list[viser.SceneNodeHandle]:
    """Draws the filmed cameras as lines, with one color and one node per lighting, as hundreds of nodes are slow."""
    out: list[viser.SceneNodeHandle] = []
    for number, lighting in enumerate(dict.fromkeys(cameras.lightings)):
        segments = []
        for i in np.flatnonzero([name == lighting for name in cameras.lightings]).tolist():
            width, height = cameras.sizes[i]
            pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
            corners = unproject(pixels, cameras.intrinsics[i]) * _FRUSTUM_DEPTH
            pose = cameras.camera_to_world[i]
            corners = corners @ pose[:3, :3].T + pose[:3, 3]
            center = np.broadcast_to(pose[:3, 3], corners.shape)
            segments += [np.stack([corners, np.roll(corners, -1, 0)], 1), np.stack([center, corners], 1)]
        color = PALETTE[number % len(PALETTE)]
        lines = np.concatenate(segments)
        out.append(scene.add_line_segments(f"{path}/{number}", lines, color, thickness=1.5, thickness_units="screen"))
    return out


def clicked_frame(cameras: Cameras, origin: Array, direction: Array) -> int | None:
    """Index of the frame whose camera has the smallest angle to a click's ray; None if it exceeds `_CLICK_ANGLE`."""
    ahead = cameras.positions - origin
    distance = np.linalg.norm(ahead, axis=1)
    along = ahead @ (direction / np.linalg.norm(direction))
    angle = np.arccos(np.clip(along / np.maximum(distance, 1e-9), -1.0, 1.0))
    # Clicks on the whole frustum count, not only those on its tip.
    angle = np.where(distance > _FRUSTUM_DEPTH, angle - np.arctan(0.5 * _FRUSTUM_DEPTH / distance), np.inf)
    best = int(np.argmin(angle))
    return best if angle[best] < np.deg2rad(_CLICK_ANGLE) else None


def _visual_mesh(scene: viser.SceneApi, path: str, twin: Twin) -> viser.SceneNodeHandle:
    import trimesh  # slow to import, like the other modules that functions of this file import

    mesh = load_arrays(require_stage(twin.scene, "mesh") / "visual.npz")
    linear = (255.0 * (mesh["colors"] / 255.0) ** _GAMMA + 0.5).astype(np.uint8)  # glTF stores linear colors
    surface = trimesh.Trimesh(mesh["vertices"], mesh["faces"], vertex_colors=linear, process=False)
    return scene.add_mesh_trimesh(path, surface, **_NO_SHADOWS)


def _ground(scene: viser.SceneApi, path: str, twin: Twin) -> viser.SceneNodeHandle:
    from twin.assets.ground import Ground

    vertices, faces = Ground.load(require_stage(twin.scene, "mesh")).triangles(_GROUND_CELL, _GROUND_FACES)
    lifted = vertices + _UP
    return scene.add_mesh_simple(path, lifted, faces, color=_GROUND_COLOR, wireframe=True, **_NO_SHADOWS)


def _parts(scene: viser.SceneApi, path: str, twin: Twin) -> list[viser.SceneNodeHandle]:
    from twin.mjcf.scene_xml import Parts

    parts = Parts.load(require_stage(twin.scene, "mesh") / "parts.npz")
    if not parts.vertices:
        return []
    offsets = np.cumsum([0, *(len(one) for one in parts.vertices[:-1])])
    vertices = np.concatenate(parts.vertices)
    faces = np.concatenate([one + first for one, first in zip(parts.faces, offsets, strict=True)])
    common = {"vertices": vertices, "faces": faces, **_NO_SHADOWS}
    solid = scene.add_mesh_simple(path, color=_PART_COLOR, opacity=0.35, flat_shading=True, **common)
    return [solid, scene.add_mesh_simple(f"{path}_edges", color=_EDGE_COLOR, wireframe=True, **common)]


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
    scene: viser.SceneApi, path: str, twin: Twin, world: World, cameras: Cameras, field: BakedField
) -> viser.SceneNodeHandle:
    from matplotlib import colormaps
    from scipy.interpolate import RegularGridInterpolator

    from twin.assets.ground import Ground
    from twin.report.review_video import trust_grid

    s, offsets, trust = trust_grid(field, cameras, world)
    aside = np.arange(offsets[0], offsets[-1] + 1e-6, _TRUST_STEP).clip(max=offsets[-1])
    along, aside = np.meshgrid(np.arange(0.0, s[-1], _TRUST_STEP), aside)
    trust = RegularGridInterpolator((offsets, s), trust)(np.stack([aside, along], -1))
    heading = heading_at(world.route, along)
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
    points = point_at(world.route, along) + aside[..., None] * left
    # Beside the route the ground may be higher or lower than the route.
    points[..., 2] = Ground.load(require_stage(twin.scene, "mesh")).at(points[..., :2])
    colors = (255.0 * colormaps["viridis"](trust.ravel())[:, :3]).astype(np.uint8)
    lifted = points.reshape(-1, 3) + _UP
    return scene.add_point_cloud(path, lifted, colors, point_size=0.08, point_shape="circle", point_shading="flat")
