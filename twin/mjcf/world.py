"""A drivable scene on disk (`world.json` beside `scene.xml`), and the geometry of its route.

*Route*: the filmed path on the ground, a polyline in driving order. *Arc length* s: distance along the route in the
plane, 0 at its first point. *Cross-track error*: distance from the route in the plane, positive to its left.
*Heading*: angle from the x axis, positive towards y. *Corridor*: the area within `half_width` of the route.
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
from twin.robot import CAMERA_SIZE, ZED2, HuskyParams, PixelCamera
from twin.types import Array

SCENE_XML = "scene.xml"
GROUND_GROUP, VISUAL_GROUP, PART_GROUP, ROUTE_GROUP = 0, 2, 3, 4
"""Geom groups of ground, visual mesh and convex parts (for collision); site group of route, corridor and goal."""
_NAMES = {"body": "base_link", "camera": "front", "ground": "ground", "keyframe": "spawn"}
"""Names in the MJCF, for other programs that read `world.json`."""
_CHORD = 1.0  # [m] length of the chord whose direction is the heading of a route


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


def arc_lengths(route: Array) -> Array:
    """Arc length at each vertex of a route (m, ≥2), shape (m,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1))])


def point_at(route: Array, s: Array | float) -> Array:
    """Points (..., d) of a route (m, d) at arc lengths s (...) [m]; s is clamped to the route's ends."""
    knots = arc_lengths(route)
    return np.stack([np.interp(s, knots, route[:, k]) for k in range(route.shape[1])], -1)


def heading_at(route: Array, s: Array | float) -> Array:
    """Heading [rad] at arc lengths s [m], in the shape of s.

    It is the direction of a chord of length `_CHORD` around s; near an end of the route, it is that of the route's
    first or last chord of this length.
    """
    length = arc_lengths(route)[-1]
    window = min(_CHORD, length)
    middle = np.clip(s, window / 2, length - window / 2)
    chord = point_at(route[:, :2], middle + window / 2) - point_at(route[:, :2], middle - window / 2)
    return np.arctan2(chord[..., 1], chord[..., 0])


def nearest_on_route(
    route: Array, xy: Array, around: tuple[Array | float, Array | float] | None = None
) -> tuple[Array, Array]:
    """Arc lengths of the points of the route nearest to `xy`, and cross-track errors [m], both of shape (...).

    Args:
        route: Shape (m, ≥2).
        xy: Shape (..., 2) [m].
        around: Lowest and highest arc length to search [m], each a number or of shape (...), for a route that crosses
            itself; the whole route by default.
    """
    knots, xy = arc_lengths(route), np.asarray(xy)
    low, high = (knots[0], knots[-1]) if around is None else around
    # Indices of the segments that overlap each range of `around`, padded to the largest number of segments in a range.
    first = np.broadcast_to(np.searchsorted(knots[1:], low), xy.shape[:-1])
    last = np.broadcast_to(np.searchsorted(knots[:-1], high, "right"), xy.shape[:-1])
    run = first[..., None] + np.arange(np.max(last - first, initial=1))
    inside, run = run < last[..., None], np.minimum(run, len(route) - 2)
    start, step = route[run, :2], np.diff(route[:, :2], axis=0)[run]
    offset = xy[..., None, :] - start
    length_2 = np.maximum((step**2).sum(-1), 1e-18)
    fraction = np.clip((offset * step).sum(-1) / length_2, 0.0, 1.0)
    residual = offset - fraction[..., None] * step
    best = np.argmin(np.where(inside, (residual**2).sum(-1), np.inf), -1)[..., None]
    cross = step[..., 0] * offset[..., 1] - step[..., 1] * offset[..., 0]
    distance = np.take_along_axis(np.linalg.norm(residual, axis=-1), best, -1)[..., 0]
    side = np.sign(np.take_along_axis(cross, best, -1)[..., 0])
    s = np.take_along_axis(knots[run] + fraction * np.sqrt(length_2), best, -1)[..., 0]
    return s, np.where(side < 0, -distance, distance)


def total_turn(route: Array) -> float:
    """Total change of heading along the route [rad], positive to the left; a full turn adds 2π."""
    s = np.append(np.arange(0.0, arc_lengths(route)[-1], 0.25), np.inf)
    heading = np.unwrap(heading_at(route, s))
    return float(heading[-1] - heading[0])


def corridor_edges(route: Array, half_width: float) -> tuple[Array, Array]:
    """Left and right edges of the corridor beside the vertices of the route, at their heights, shapes (m, 3)."""
    heading = heading_at(route, arc_lengths(route))
    normal = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1) * half_width
    return route + normal, route - normal
