"""A drivable scene on disk: `world.json` beside `scene.xml`.

*Route*: the filmed path on the ground, a polyline in driving order (`twin/geometry/polyline.py`). *Corridor*: the area
within `half_width` of the route.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

from twin.config_file import parse_table
from twin.files import check_shapes, read_json, require_text, wrap_read_errors, write_json
from twin.geometry.polyline import arc_lengths
from twin.robot import CAMERA_SIZE, ZED2, HuskyParams, PixelCamera
from twin.types import Array

SCENE_XML = "scene.xml"
GROUND_GROUP, VISUAL_GROUP, PART_GROUP, ROUTE_GROUP = 0, 2, 3, 4
"""Geom groups of ground, visual mesh and convex parts (for collision); site group of route, corridor and goal."""
_NAMES = {"body": "base_link", "camera": "front", "ground": "ground", "keyframe": "spawn"}
"""Names in the MJCF, for other programs that read `world.json`."""


@dataclass(frozen=True)
class World:
    """A drivable scene on disk."""

    route: Array
    """Points on the ground in driving order [m], shape (m, 3), m ≥ 2."""
    half_width: float
    """Half width of the drivable corridor [m]."""
    spawn: tuple[float, float, float, float]
    """x, y, z of the robot's base origin [m] at rest at the start, and its yaw [rad]."""
    folder: Path
    """The folder of `scene.xml`, `assets/` and `world.json`."""
    camera: PixelCamera = ZED2
    """The front camera at its native size."""
    robot: HuskyParams = field(default_factory=HuskyParams)
    """Parameters of the robot in the scene, of its controller and of its camera."""
    branches: dict[str, Array] = field(default_factory=dict)
    """Points of other routes through the place, as `route`, by name."""
    start: float = 0.0
    """Arc length [m] at which the robot starts, and before which no task begins (`scene_xml.first_filmed`)."""
    branch_starts: dict[str, float] = field(default_factory=dict)
    """The same of the branches; 0 for others than these."""

    def along(self, branch: str) -> "World":
        """The world with a branch as its route; "" is the route itself. The robot's `spawn` stays where it is."""
        return replace(self, route=self.branches[branch], start=self.branch_starts.get(branch, 0.0)) if branch else self

    @property
    def length(self) -> float:
        """Length of the route from `start` on [m]."""
        return float(arc_lengths(self.route)[-1]) - self.start

    @property
    def intrinsics(self) -> Array:
        """fx, fy, cx, cy [px] of the front camera at CAMERA_SIZE, shape (4,)."""
        return np.array(self.camera.resized(CAMERA_SIZE).intrinsics)

    @property
    def goal(self) -> Array:
        """End of the route [m], shape (3,)."""
        return self.route[-1]

    @property
    def model_path(self) -> Path:
        return self.folder / SCENE_XML

    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(self.model_path))

    def spec(self, keeps_part: Callable[[str], bool] = lambda name: True, visuals: bool = True) -> mujoco.MjSpec:
        """The model for editing, without the convex parts for whose names `keeps_part` is False.

        Without `visuals`, it has no visual mesh and no textures, which physics does not need.
        """
        tree = ElementTree.parse(self.model_path)
        root = tree.getroot()
        worldbody, assets = root.find("worldbody"), root.find("asset")
        assert worldbody is not None and assets is not None

        def kept(geom: Element) -> bool:
            if geom.get("type") != "mesh":
                return True
            return visuals if geom.get("contype") == "0" else keeps_part(geom.get("mesh", ""))

        # Geoms are removed from the XML, since removing a single one from an MjSpec takes milliseconds; and in one pass
        # over each list, since a long road has thousands of parts.
        left_out = [geom for geom in worldbody.findall("geom") if not kept(geom)]
        geoms, meshes = set(left_out), {geom.get("mesh") for geom in left_out}
        worldbody[:] = [element for element in worldbody if element not in geoms]
        assets[:] = [element for element in assets if not (element.tag == "mesh" and element.get("name") in meshes)]
        if not visuals:
            _strip_textures(root, assets)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.modelfiledir = str(self.folder.resolve())
        return spec

    def save(self) -> None:
        """Writes `world.json` into the folder."""
        write_json(
            self.folder / "world.json",
            {
                "route": self.route.tolist(),
                "start": self.start,
                "half_width": self.half_width,
                "goal": self.goal.tolist(),
                "spawn": list(self.spawn),
                "camera": {
                    "intrinsics": self.intrinsics.tolist(),
                    "size": list(CAMERA_SIZE),
                    "native_intrinsics": list(self.camera.intrinsics),
                    "native_size": list(self.camera.size),
                },
                "robot": asdict(self.robot),
                "names": _NAMES,
                "model": SCENE_XML,
                **({"branches": {k: v.tolist() for k, v in self.branches.items()}} if self.branches else {}),
                **({"branch_starts": self.branch_starts} if self.branch_starts else {}),
            },
        )

    @staticmethod
    def load(folder: Path) -> "World":
        """Reads `world.json`. Raises InputError: it is missing or damaged."""
        path = folder / "world.json"
        head = read_json(path)
        with wrap_read_errors(path, "build the scene again"):
            x, y, z, yaw = map(float, head["spawn"])
            (fx, fy, cx, cy), (width, height) = head["camera"]["native_intrinsics"], head["camera"]["native_size"]
            world = World(
                route=np.array(head["route"], np.float64),
                half_width=float(head["half_width"]),
                spawn=(x, y, z, yaw),
                camera=PixelCamera((float(fx), float(fy), float(cx), float(cy)), (int(width), int(height))),
                robot=parse_table(HuskyParams, head["robot"], str(path)),
                folder=folder,
                branches={
                    require_text(name): np.array(line, np.float64) for name, line in head.get("branches", {}).items()
                },
                start=float(head.get("start", 0.0)),  # earlier builds have no starts
                branch_starts={require_text(name): float(at) for name, at in head.get("branch_starts", {}).items()},
            )
            m = min(len(line) for line in (world.route, *world.branches.values()))
            lines = {"route": world.route} | {f"branch {name}": line for name, line in world.branches.items()}
            check_shapes({name: (line, (len(line), 3), "f") for name, line in lines.items()})
            if m < 2 or not world.half_width > 0.0 or min(fx, fy, width, height) <= 0:
                raise ValueError(
                    f"{m} route points, half width {world.half_width} m, a camera of {width} × {height} px with focal "
                    f"lengths {fx:g}, {fy:g} px; expected at least 2 points, and positive sizes"
                )
            for one in (world, *map(world.along, world.branches)):
                if not (one.start >= 0.0 and one.length > 0.0):
                    raise ValueError(f"a route starts at {one.start:g} m; expected 0 m to less than its length")
        return world


def _strip_textures(root: Element, assets: Element) -> None:
    textured = {m.get("name") for m in assets.findall("material") if m.get("texture") or m.find("layer") is not None}
    for geom in root.iter("geom"):
        if geom.get("material") in textured:
            del geom.attrib["material"]
    for asset in list(assets):
        if asset.tag == "texture" or (asset.tag == "material" and asset.get("name") in textured):
            assets.remove(asset)
