"""The finished scene: a portable MJCF folder, and what a driver must know about it.

*Route*: the filmed path on the ground, a polyline in driving order. *Arc length* s runs along it in the plane, from 0
at its start. *Cross-track error*: distance from the route in the plane, positive to its left. *Heading*: angle of the
route from the x axis, positive towards y. *Corridor*: what lies within `half_width` of the route.
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from twin.config_file import parse
from twin.files import check_shapes, checked_text, damaged, read_json, write_json
from twin.robot import CAMERA_SIZE, ZED2, HuskyParams, PixelCamera
from twin.types import Array

SCENE_XML = "scene.xml"
GROUND_GROUP, VISUAL_GROUP, PART_GROUP, ROUTE_GROUP = 0, 2, 3, 4
"""Geom groups, and that of the sites along the route."""


@dataclass(frozen=True)
class World:
    """A drivable scene on disk."""

    route: Array
    """On the ground [m], shape (m, 3), m ≥ 2, in driving order."""
    half_width: float
    """Half width of the drivable corridor [m]."""
    spawn: tuple[float, float, float, float]
    """x, y, z of the robot's base origin [m] at rest at the start, and its yaw [rad]."""
    folder: Path
    """Holds `scene.xml`, `assets/` and `world.json`."""
    camera: PixelCamera = ZED2
    """The front camera at its native size."""
    robot: HuskyParams = field(default_factory=HuskyParams)
    """What was built into the scene, and what its controller and its camera go by."""
    names: dict[str, str] = field(
        default_factory=lambda: {"body": "base_link", "camera": "front", "ground": "ground", "keyframe": "spawn"}
    )
    """What the things in the MJCF are called."""

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

    def save(self) -> None:
        """Writes `world.json` into the folder."""
        write_json(
            self.folder / "world.json",
            {
                "route": self.route.tolist(),
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
                "names": self.names,
                "model": SCENE_XML,
            },
        )

    @staticmethod
    def load(folder: Path) -> "World":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / "world.json"
        head = read_json(path)
        with damaged(path, "build the scene again"):
            x, y, z, yaw = map(float, head["spawn"])
            (fx, fy, cx, cy), (width, height) = head["camera"]["native_intrinsics"], head["camera"]["native_size"]
            world = World(
                route=np.array(head["route"], np.float64),
                half_width=float(head["half_width"]),
                spawn=(x, y, z, yaw),
                camera=PixelCamera((float(fx), float(fy), float(cx), float(cy)), (int(width), int(height))),
                robot=parse(HuskyParams, head["robot"], str(path)),
                folder=folder,
                names={checked_text(key): checked_text(name) for key, name in head["names"].items()},
            )
            m = len(world.route)
            check_shapes({"route": (world.route, (m, 3), "f")})
            if m < 2 or not world.half_width > 0.0 or min(fx, fy, width, height) <= 0:
                raise ValueError(f"a route of {m} points {world.half_width} m to a side, filmed at {width} × {height}")
            missing = {"body", "camera", "ground", "keyframe"} - world.names.keys()
            if missing:
                raise ValueError(f"no name of {', '.join(sorted(missing))}")
        return world


def arc_lengths(route: Array) -> Array:
    """Arc length at each vertex [m], shape (m, ≥2) → (m,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1))])


def point_at(route: Array, s: Array | float) -> Array:
    """Points at arc lengths s [m]; beyond an end, that end. Shapes (m, d) and (...) → (..., d)."""
    knots = arc_lengths(route)
    return np.stack([np.interp(s, knots, route[:, k]) for k in range(route.shape[1])], -1)


def heading_at(route: Array, s: Array | float, window: float = 1.0) -> Array:
    """Heading [rad] at arc lengths s: of the chord over `window` [m] around each, shape as s."""
    length = arc_lengths(route)[-1]
    window = min(window, length)
    middle = np.clip(s, window / 2, length - window / 2)
    chord = point_at(route[:, :2], middle + window / 2) - point_at(route[:, :2], middle - window / 2)
    return np.arctan2(chord[..., 1], chord[..., 0])


def nearest(route: Array, xy: Array, around: tuple[Array | float, Array | float] | None = None) -> tuple[Array, Array]:
    """Foot of the perpendicular on the route.

    Args:
        route: Shape (m, ≥2).
        xy: Points, shape (..., 2).
        around: Arc lengths between which to look [m], for a route that meets itself, for all points or of shape (...);
            everywhere by default.

    Returns:
        Arc length of the foot [m] and cross-track error [m], both of shape (...).
    """
    knots, xy = arc_lengths(route), np.asarray(xy)
    low, high = (knots[0], knots[-1]) if around is None else around
    # Of every point, the segments that reach into its range: a run of them, as long as the longest of all points.
    first = np.broadcast_to(np.searchsorted(knots[1:], low), xy.shape[:-1])
    last = np.broadcast_to(np.searchsorted(knots[:-1], high, "right"), xy.shape[:-1])
    run = first[..., None] + np.arange(np.max(last - first, initial=1))
    inside, run = run < last[..., None], np.minimum(run, len(route) - 2)
    start, step = route[run, :2], np.diff(route[:, :2], axis=0)[run]
    offset = xy[..., None, :] - start
    length_2 = np.maximum((step**2).sum(-1), 1e-18)
    share = np.clip((offset * step).sum(-1) / length_2, 0.0, 1.0)
    miss = offset - share[..., None] * step
    best = np.argmin(np.where(inside, (miss**2).sum(-1), np.inf), -1)[..., None]
    cross = step[..., 0] * offset[..., 1] - step[..., 1] * offset[..., 0]
    distance = np.take_along_axis(np.linalg.norm(miss, axis=-1), best, -1)[..., 0]
    side = np.sign(np.take_along_axis(cross, best, -1)[..., 0])
    s = np.take_along_axis(knots[run] + share * np.sqrt(length_2), best, -1)[..., 0]
    return s, np.where(side < 0, -distance, distance)


def total_turn(route: Array) -> float:
    """How far the heading turns from the route's start to its end [rad], left positive, full turns counted."""
    s = np.append(np.arange(0.0, arc_lengths(route)[-1], 0.25), np.inf)
    heading = np.unwrap(heading_at(route, s))
    return float(heading[-1] - heading[0])


def corridor_edges(route: Array, half_width: float) -> tuple[Array, Array]:
    """Left and right edge of the corridor at the route's vertices, shapes (m, 3); heights are the route's."""
    heading = heading_at(route, arc_lengths(route))
    normal = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1) * half_width
    return route + normal, route - normal


def heading_error(wanted: Array | float, actual: Array | float) -> Array:
    """wanted − actual, wrapped to ±π [rad]."""
    return (np.asarray(wanted) - actual + np.pi) % (2 * np.pi) - np.pi
