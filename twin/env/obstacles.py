"""Obstacles on the route: added to a model before it is compiled, sampled for each episode, and moved in simulation.

*Station* is the arc length on the route [m], *lateral* the signed distance from it, positive to the left [m]. An
obstacle is a mocap body `obstacle_<name>`, which forces do not move; its geoms are `obstacle_<name>_<number>`. One
model serves many episodes: `place` sets the poses of an episode's obstacles, and parks the others far below the ground.
The model stores the route as the custom numeric `obstacle_route`.

Geoms are primitives and convex hulls in uniform colors, without mesh or texture files. In an obstacle's frame, x points
to its front, y to its left and z up; the origin is on the ground below its center. Geoms that are visible and collide
are in group `OBSTACLE_GROUP`; those that only collide are in the robot's collision group.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from twin.config import ObstacleConfig
from twin.config_file import check_obstacles
from twin.env.route_segments import RouteSegment
from twin.errors import InputError
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.mjcf import husky
from twin.mjcf.husky_visuals import add_visuals
from twin.mjcf.world import World
from twin.types import Array

# ---- geometry

Color = tuple[float, float, float]

OBSTACLE_GROUP = 5

RADIUS = {"cone": 0.2, "box": 0.35, "bollard": 0.1, "car": 2.2, "pedestrian": 0.3, "cyclist": 0.9, "husky": 0.6}
"""Radius of a vertical cylinder around an obstacle of each kind [m]."""

_BOX_SIZE = (0.5, 0.4, 0.45)  # [m] default length, width, height
_COLORS: dict[str, Color] = {
    "cone": (0.85, 0.30, 0.08),
    "box": (0.60, 0.46, 0.28),
    "bollard": (0.25, 0.26, 0.28),
    "car": (0.32, 0.40, 0.52),
    "pedestrian": (0.55, 0.20, 0.18),
    "cyclist": (0.20, 0.42, 0.30),
    "husky": (0.0, 0.0, 0.0),
}
_WHITE, _DARK, _BLACK = (0.85, 0.85, 0.82), (0.14, 0.14, 0.15), (0.07, 0.07, 0.07)
_SKIN, _HAIR, _TROUSERS, _GLASS = (0.72, 0.52, 0.42), (0.16, 0.11, 0.08), (0.18, 0.20, 0.28), (0.16, 0.20, 0.24)
_STEEL, _RED, _LAMP = (0.50, 0.51, 0.53), (0.60, 0.08, 0.06), (0.88, 0.87, 0.80)


class ObstacleModel:
    """Adds geoms to one body. All are in one group; either all collide (`solid`), or all are visual-only."""

    def __init__(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, group: int = OBSTACLE_GROUP, solid: bool = True):
        """Geoms are named `<body>_<number>`."""
        self.spec, self.body, self.group, self.solid, self.count = spec, body, group, solid, 0

    def add(self, kind: mujoco.mjtGeom, color: Color, **settings: Any) -> None:
        if not self.solid:
            settings |= {"contype": 0, "conaffinity": 0}
        name = f"{self.body.name}_{self.count}"
        self.count += 1
        self.body.add_geom(name=name, type=kind, rgba=(*color, 1.0), group=self.group, **settings)

    def box(self, size: Sequence[float], center: Sequence[float], color: Color) -> None:
        self.add(mujoco.mjtGeom.mjGEOM_BOX, color, size=np.array(size) / 2, pos=center)

    def ellipsoid(self, half: Sequence[float], center: Sequence[float], color: Color) -> None:
        self.add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, color, size=half, pos=center)

    def cylinder(self, start: Sequence[float], end: Sequence[float], radius: float, color: Color) -> None:
        self.add(mujoco.mjtGeom.mjGEOM_CYLINDER, color, fromto=(*start, *end), size=(radius, 0, 0))

    def capsule(self, start: Sequence[float], end: Sequence[float], radius: float, color: Color) -> None:
        self.add(mujoco.mjtGeom.mjGEOM_CAPSULE, color, fromto=(*start, *end), size=(radius, 0, 0))

    def hull(self, points: np.ndarray, color: Color) -> None:
        """Adds the convex hull of points (n, 3)."""
        name = f"{self.body.name}_{self.count}"
        mesh = self.spec.add_mesh(name=name)
        mesh.uservert = points.astype(np.float32).ravel()
        # MuJoCo recenters the mesh, but also moves its geom by the opposite offset, so the points stay in place.
        self.add(mujoco.mjtGeom.mjGEOM_MESH, color, meshname=name)

    def frustum(self, low: float, high: float, radii: tuple[float, float], color: Color, sides: int = 20) -> None:
        """Adds an upright truncated cone with `radii` at the heights `low` and `high` [m]."""
        angle = np.arange(sides) * 2 * np.pi / sides
        ring = np.stack([np.cos(angle), np.sin(angle)], 1)
        rings = [np.column_stack([r * ring, np.full(sides, z)]) for r, z in zip(radii, (low, high), strict=True)]
        self.hull(np.concatenate(rings), color)


def _cone(shape: ObstacleModel, color: Color) -> None:
    shape.box((0.32, 0.32, 0.03), (0, 0, 0.015), _DARK)

    def radius(z: float) -> float:
        return 0.125 - 0.10 * (z - 0.03) / 0.52

    for low, high, tone in ((0.03, 0.18, color), (0.18, 0.28, _WHITE), (0.28, 0.38, color), (0.38, 0.46, _WHITE)):
        shape.frustum(low, high, (radius(low), radius(high)), tone)
    shape.frustum(0.46, 0.55, (radius(0.46), radius(0.55)), color)


def _bollard(shape: ObstacleModel, color: Color) -> None:
    shape.cylinder((0, 0, 0), (0, 0, 0.70), 0.055, color)
    shape.cylinder((0, 0, 0.70), (0, 0, 0.80), 0.057, _WHITE)
    shape.cylinder((0, 0, 0.80), (0, 0, 0.88), 0.055, color)
    shape.ellipsoid((0.055, 0.055, 0.04), (0, 0, 0.88), color)


def _car(shape: ObstacleModel, color: Color) -> None:
    def slab(levels: tuple[tuple[float, float, float, float], ...], tone: Color) -> None:
        shape.hull(
            np.array([(x, s * y, z) for z, back, front, y in levels for x in (back, front) for s in (-1, 1)]), tone
        )

    # height, rear and front end, half width [m]
    slab(((0.25, -2.00, 1.95, 0.82), (0.50, -2.05, 2.05, 0.87), (0.78, -2.02, 1.80, 0.85)), color)
    slab(((0.76, -2.00, 1.75, 0.84), (0.92, -1.85, 0.95, 0.80)), color)
    slab(((0.90, -1.75, 0.95, 0.78), (1.36, -1.15, 0.20, 0.62)), _GLASS)
    slab(((1.36, -1.20, 0.25, 0.64), (1.42, -1.10, 0.15, 0.60)), color)
    for x in (-1.25, 1.28):
        for y in (-0.76, 0.76):
            shape.cylinder((x, y - 0.11, 0.31), (x, y + 0.11, 0.31), 0.31, _BLACK)
            shape.cylinder((x, y - 0.12, 0.31), (x, y + 0.12, 0.31), 0.17, _STEEL)
    for y in (-0.62, 0.62):
        shape.box((0.06, 0.30, 0.12), (2.01, y, 0.60), _LAMP)
        shape.box((0.06, 0.30, 0.12), (-2.03, y, 0.64), _RED)


def _pedestrian(shape: ObstacleModel, color: Color) -> None:
    for side, reach in ((1, 0.20), (-1, -0.20)):  # one foot ahead of the other
        hip, knee, heel = (0, 0.09 * side, 0.86), (0.55 * reach + 0.03, 0.09 * side, 0.47), (reach, 0.09 * side, 0.08)
        shape.capsule(hip, knee, 0.075, _TROUSERS)
        shape.capsule(knee, heel, 0.055, _TROUSERS)
        shape.capsule((reach - 0.03, 0.09 * side, 0.045), (reach + 0.12, 0.09 * side, 0.04), 0.04, _BLACK)
        elbow, hand = (-0.5 * reach - 0.03, 0.25 * side, 1.08), (-0.9 * reach + 0.06, 0.23 * side, 0.86)
        shape.capsule((0, 0.20 * side, 1.36), elbow, 0.048, color)
        shape.capsule(elbow, hand, 0.04, color)
        shape.ellipsoid((0.045, 0.03, 0.055), hand, _SKIN)
    shape.capsule((0, -0.06, 0.92), (0, 0.06, 0.92), 0.11, _TROUSERS)
    shape.ellipsoid((0.125, 0.19, 0.34), (0, 0, 1.18), color)
    shape.capsule((0, -0.13, 1.39), (0, 0.13, 1.39), 0.07, color)
    shape.capsule((0, 0, 1.42), (0.01, 0, 1.52), 0.05, _SKIN)
    shape.ellipsoid((0.095, 0.08, 0.12), (0.02, 0, 1.63), _SKIN)
    shape.ellipsoid((0.10, 0.088, 0.09), (-0.005, 0, 1.675), _HAIR)


def _cyclist(shape: ObstacleModel, color: Color) -> None:
    for x in (-0.52, 0.52):
        shape.cylinder((x, -0.016, 0.34), (x, 0.016, 0.34), 0.34, _BLACK)
        shape.cylinder((x, -0.018, 0.34), (x, 0.018, 0.34), 0.29, _STEEL)
    bottom, seat, head = (-0.05, 0, 0.30), (-0.22, 0, 0.86), (0.38, 0, 0.84)
    for start, end in ((bottom, seat), (bottom, head), (seat, head), (bottom, (-0.52, 0, 0.34))):
        shape.capsule(start, end, 0.018, color)
    shape.capsule(head, (0.52, 0, 0.34), 0.018, color)
    shape.capsule(head, (0.40, 0, 0.98), 0.016, _DARK)
    shape.capsule((0.40, -0.24, 0.99), (0.40, 0.24, 0.99), 0.016, _DARK)
    shape.ellipsoid((0.13, 0.075, 0.035), (-0.22, 0, 0.93), _BLACK)
    shirt = (0.76, 0.66, 0.20)
    for side, pedal in ((1, 0.14), (-1, 0.44)):
        knee = (0.18, 0.10 * side, 0.42 + 0.6 * pedal)
        shape.capsule((-0.18, 0.09 * side, 0.96), knee, 0.07, _TROUSERS)
        shape.capsule(knee, (0.0, 0.11 * side, pedal + 0.03), 0.05, _TROUSERS)
        shape.capsule((-0.04, 0.11 * side, pedal), (0.11, 0.11 * side, pedal), 0.035, _BLACK)
        shape.capsule((0.08, 0.18 * side, 1.36), (0.24, 0.24 * side, 1.14), 0.045, shirt)
        shape.capsule((0.24, 0.24 * side, 1.14), (0.40, 0.22 * side, 1.02), 0.038, _SKIN)
    shape.capsule((-0.16, 0, 1.00), (0.05, 0, 1.36), 0.135, shirt)
    shape.ellipsoid((0.095, 0.08, 0.115), (0.16, 0, 1.56), _SKIN)
    shape.ellipsoid((0.13, 0.095, 0.085), (0.135, 0, 1.625), color)


def _husky(shape: ObstacleModel, color: Color) -> None:
    """A parked Husky: its visual geometry, with boxes and cylinders for collision."""
    spec, up = mujoco.MjSpec(), husky.BASE_HEIGHT
    base = spec.worldbody.add_body(name="look", pos=(0, 0, up))
    wheels = {}
    for name, center in zip(husky.WHEELS, husky.wheel_centers(), strict=True):
        wheels[name] = base.add_body(name=name, pos=center)
    add_visuals(spec, base, wheels, husky.HuskyParams())
    for geom in spec.geoms:
        geom.group = shape.group
    shape.body.add_frame().attach_body(base, f"{shape.body.name}_", "")
    if not shape.solid:
        return
    solid = ObstacleModel(shape.spec, shape.body, husky.ROBOT_COLLISION_GROUP)
    solid.box((0.99, 0.57, 0.124), (0, 0, up + 0.062), _DARK)
    solid.box((0.79, 0.57, 0.104), (0, 0, up + 0.176), _DARK)
    for x, y, z in husky.wheel_centers():
        half = husky.WHEEL_WIDTH / 2
        solid.cylinder((x, y - half, z + up), (x, y + half, z + up), husky.WHEEL_RADIUS, _DARK)


_BUILDERS = {
    "cone": _cone,
    "bollard": _bollard,
    "car": _car,
    "pedestrian": _pedestrian,
    "cyclist": _cyclist,
    "husky": _husky,
}


def add_obstacle_geoms(
    shape: ObstacleModel, kind: str, color: Sequence[float] = (), size: Sequence[float] = ()
) -> None:
    """Adds an obstacle's geoms to a body; `ObstacleConfig` explains kind, color and size."""
    red, green, blue = color or _COLORS[kind]
    if kind == "box":
        length, width, height = size or _BOX_SIZE
        shape.box((length, width, height), (0, 0, height / 2), (red, green, blue))
    else:
        _BUILDERS[kind](shape, (red, green, blue))


# ---- obstacles of a model and of an episode

PREFIX = "obstacle_"
STATIC_KINDS = ("cone", "box", "bollard")
"""Kinds of random obstacles and distractor objects: static objects that occur on a path."""

_ROUTE_NUMERIC = "obstacle_route"
_PARKED_HEIGHT = -100.0  # [m], far below the ground
_ROBOT_HALF_WIDTH = 0.34  # [m]
_CLEARANCE = 0.15  # [m] smallest gap between a random obstacle and a robot that passes it within the corridor
_RANDOM_MARGIN = 0.5  # [m] a random obstacle's near edge is at most this far beyond the corridor's edge
_MAX_TRIES = 20  # a distractor object is left out if this many samples give it no free position
_ROBOT_RADIUS = 0.6  # [m] distance from the robot's base to its farthest corner
_DISTRACTOR_STRIP = 2.5  # [m] width of the strip beside the corridor where distractor objects stand
_FREE_ENDS = (4.0, 3.0)  # [m] lengths at the route's start and end in which there are no random obstacles
_SPACING = 4.0  # [m] smallest distance along the route between random obstacles; less if the route is too short
_SINK_DEPTH = 0.01  # [m] obstacles are sunk this far into the ground, to avoid a visible gap below


def body_name(obstacle: ObstacleConfig, number: int) -> str:
    """Body name of an obstacle; `number` is its index in the list of obstacles."""
    return PREFIX + (obstacle.name or f"{obstacle.kind}_{number}")


def add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[ObstacleConfig], world: World) -> None:
    """Adds obstacles' bodies, below the ground, and the route to a scene; `place` moves them in the compiled model.

    Raises:
        InputError: see `check_obstacles`.
    """
    check_obstacles(obstacles)
    for k, one in enumerate(obstacles):
        body = spec.worldbody.add_body(name=body_name(one, k), mocap=True, pos=(0, 0, _PARKED_HEIGHT))
        add_obstacle_geoms(ObstacleModel(spec, body), one.kind, one.color, one.size)
    if not any(numeric.name == _ROUTE_NUMERIC for numeric in spec.numerics):
        spec.add_numeric(name=_ROUTE_NUMERIC, size=world.route.size, data=world.route.ravel())


def place(obstacles: Sequence[ObstacleConfig], data: mujoco.MjData, time: float) -> None:
    """Sets the mocap poses of an episode's obstacles at a time [s], and parks the model's other obstacles.

    Call it before every step if an obstacle moves, and once after each `mj_resetData`, which parks all of them.

    Raises:
        InputError: the model lacks an obstacle of the episode.
    """
    model = data.model
    wanted = {body_name(one, k): one for k, one in enumerate(obstacles)}
    for body in range(model.nbody):
        mocap = model.body_mocapid[body]
        if mocap < 0 or not model.body(body).name.startswith(PREFIX):
            continue
        one = wanted.pop(model.body(body).name, None)
        data.mocap_quat[mocap] = (1.0, 0.0, 0.0, 0.0)
        data.mocap_pos[mocap] = (0.0, 0.0, _PARKED_HEIGHT)
        if one is not None:
            _set_pose(data, mocap, obstacle_pose(one, stored_route(model), time))
    if wanted:
        raise InputError(f"the model has no {', '.join(wanted)}; add it as [[obstacle]], or by add_obstacles")


def _set_pose(data: mujoco.MjData, mocap: int, pose: tuple[float, float, float]) -> None:
    x, y, yaw = pose
    data.mocap_pos[mocap] = (x, y, ground_height(data.model, x, y) - _SINK_DEPTH)
    data.mocap_quat[mocap] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))


def obstacle_pose(obstacle: ObstacleConfig, route: Array, time: float) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad] of an obstacle at a time [s]; a moving one goes back and forth along its line."""
    station, lateral, direction = obstacle_station(obstacle, time)
    x, y = _route_point(route, station, lateral)
    return x, y, float(heading_at(route, station) + direction) + np.deg2rad(obstacle.yaw)


def obstacle_station(obstacle: ObstacleConfig, time: float) -> tuple[float, float, float]:
    """Station, lateral [m] and direction of motion relative to the route [rad] of an obstacle at a time [s]."""
    start = np.array([obstacle.station, obstacle.lateral])
    step = np.array(obstacle.to) - start if obstacle.to else np.zeros(2)
    length = float(np.linalg.norm(step))
    if length < 1e-9:
        return obstacle.station, obstacle.lateral, 0.0
    passes = (time + obstacle.delay) * obstacle.speed / length
    back = bool(passes // 1.0 % 2.0)  # true on the way back; correct for times before 0, too
    share = passes % 1.0
    station, lateral = start + step * (1.0 - share if back else share)
    direction = -step if back else step
    return float(station), float(lateral), float(np.arctan2(direction[1], direction[0]))


def obstacles_in_reach(obstacles: Sequence[ObstacleConfig], half_width: float, time: float) -> Array:
    """Station, lateral and radius [m], shape (k, 3), of those obstacles whose surrounding cylinder a robot in
    the corridor could touch."""
    placed = [(*obstacle_station(one, time)[:2], _radius(one)) for one in obstacles]
    return np.array([row for row in placed if abs(row[1]) < half_width + _ROBOT_HALF_WIDTH + row[2]]).reshape(-1, 3)


def _radius(obstacle: ObstacleConfig) -> float:
    """Radius of a vertical cylinder around an obstacle [m]."""
    return math.hypot(*obstacle.size[:2]) / 2.0 if obstacle.size else RADIUS[obstacle.kind]


def _route_point(route: Array, station: float, lateral: float) -> tuple[float, float]:
    """x, y [m] of a point given by station and lateral; the route continues straight beyond its ends."""
    point = point_at(route[:, :2], station)
    over = station - np.clip(station, 0.0, arc_lengths(route)[-1])
    heading = float(heading_at(route, station))
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    x, y = point + over * along + lateral * left
    return float(x), float(y)


def stored_route(model: mujoco.MjModel) -> Array:
    """The route that `add_obstacles` stored in the model [m], shape (m, 3)."""
    return np.array(model.numeric(_ROUTE_NUMERIC).data).reshape(-1, 3)


def ground_height(model: mujoco.MjModel, x: float, y: float) -> float:
    """Height [m] of the height field `ground`, interpolated bilinearly; beyond its edge, the height of the edge."""
    geom = model.geom("ground")
    k = int(geom.dataid[0])
    rows, columns, adr = int(model.hfield_nrow[k]), int(model.hfield_ncol[k]), int(model.hfield_adr[k])
    half_x, half_y, high, _ = model.hfield_size[k]
    grid = model.hfield_data[adr : adr + rows * columns].reshape(rows, columns)
    column = np.clip((x - geom.pos[0] + half_x) / (2 * half_x), 0, 1) * (columns - 1)
    row = np.clip((y - geom.pos[1] + half_y) / (2 * half_y), 0, 1) * (rows - 1)
    i, j = min(int(row), rows - 2), min(int(column), columns - 2)
    u, v = row - i, column - j
    corners = grid[i : i + 2, j : j + 2]
    return float(geom.pos[2] + high * (np.array([1 - u, u]) @ corners @ np.array([1 - v, v])))


def random_obstacles(world: World, rng: np.random.Generator, count: int) -> tuple[ObstacleConfig, ...]:
    """Samples static obstacles `random_<number>` along the route; within the corridor, a robot can pass each of them.

    Raises:
        InputError: the route is too short for `count` obstacles.
    """
    room = _room_for(count, world)
    spacing = min(_SPACING, 0.8 * room / max(count, 1))
    # Sorted uniform samples plus multiples of the spacing are uniform over all arrangements that keep this spacing.
    free = np.sort(rng.uniform(0.0, room - spacing * (count - 1), count)) if count else np.zeros(0)
    out = []
    for k, station in enumerate(_FREE_ENDS[0] + free + spacing * np.arange(count)):
        kind = str(rng.choice(STATIC_KINDS))
        radius = RADIUS[kind]
        nearest = max(0.0, radius + _ROBOT_HALF_WIDTH + _CLEARANCE - world.half_width)
        farthest = max(nearest, world.half_width + _RANDOM_MARGIN) + radius
        lateral = rng.uniform(nearest, farthest) * rng.choice([-1.0, 1.0])
        yaw = float(rng.uniform(-180.0, 180.0))
        out.append(ObstacleConfig(f"random_{k}", kind, float(station), float(lateral), yaw))
    return tuple(out)


def _room_for(count: int, world: World) -> float:
    """Length of the route's part for random obstacles [m]. Raises InputError: it is too short for `count` of them."""
    length = float(arc_lengths(world.route)[-1])
    room = length - sum(_FREE_ENDS)
    if room <= 0.0 or count > room:
        raise InputError(f"{count} obstacles on a route of {length:.1f} m; expected at most {max(0, int(room))}")
    return room


def random_distractors(world: World, rng: np.random.Generator, count: int) -> tuple[ObstacleConfig, ...]:
    """Samples distractor objects beside the corridor, out of reach of a robot within it.

    They are named as in `random_obstacles`. A winding route may leave room for fewer than `count`.
    """
    route, out = world.route[:, :2], []
    length = float(arc_lengths(world.route)[-1])
    for k in range(count):
        kind = str(rng.choice(STATIC_KINDS))
        nearest = world.half_width + _ROBOT_RADIUS + RADIUS[kind]
        for _ in range(_MAX_TRIES):
            station = float(rng.uniform(0.0, length))
            lateral = float(rng.uniform(nearest, nearest + _DISTRACTOR_STRIP) * rng.choice([-1.0, 1.0]))
            # At a bend, a point beside one part of the route may be on another part of it.
            if np.linalg.norm(route - _route_point(route, station, lateral), axis=1).min() >= nearest:
                out.append(ObstacleConfig(f"random_{k}", kind, station, lateral, float(rng.uniform(-180.0, 180.0))))
                break
    return tuple(out)


# ---- obstacles of an episode

_COLOR_SEED = 7  # random seed of the distractor objects' colors
_ROUTE_STEP = 0.25  # [m] distance between points of a segment's route


class EpisodeObstacles:
    """Obstacles of a task's episodes: configured or random ones along the segment, plus distractor objects.

    Bodies cannot be added to a compiled model. So the model contains a *pool*: as many obstacles of each kind as an
    episode may need.
    """

    def __init__(
        self, wanted: int | Sequence[ObstacleConfig], world: World, segment: RouteSegment, beside: int = 0
    ) -> None:
        """
        Args:
            wanted: Number of random obstacles per episode, or the obstacles that all episodes have.
            world: Contains route and corridor.
            segment: Route segment along which random obstacles stand.
            beside: Largest number of distractor objects.

        Raises:
            InputError: the segment is too short for the random obstacles.
        """
        self._count = wanted if isinstance(wanted, int) else 0
        self._given = () if isinstance(wanted, int) else tuple(wanted)
        self._beside = beside
        self._colors = np.random.default_rng(_COLOR_SEED).uniform(0.05, 0.9, (len(STATIC_KINDS), beside, 3))
        s = np.append(np.arange(segment.start, segment.end, _ROUTE_STEP), segment.end)
        self._segment_world, self._start = replace(world, route=point_at(world.route, s)), segment.start
        if self._count:
            _room_for(self._count, self._segment_world)

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        """Obstacles that the model must contain."""
        standing = [_static_obstacle(kind, k) for kind in STATIC_KINDS for k in range(self._count)]
        distractors = [self._distractor(kind, k) for kind in STATIC_KINDS for k in range(self._beside)]
        return (*self._given, *standing, *distractors)

    def sample(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        """Samples the obstacles of one episode, with `beside` distractor objects."""
        standing = random_obstacles(self._segment_world, rng, self._count) if self._count else ()
        distractors = random_distractors(self._segment_world, rng, beside)
        return (
            *self._given,
            *self._from_pool(standing, _static_obstacle),
            *self._from_pool(distractors, self._distractor),
        )

    def _from_pool(
        self, sampled: Sequence[ObstacleConfig], member: Callable[[str, int], ObstacleConfig]
    ) -> list[ObstacleConfig]:
        """Returns members of the pool, moved to the poses of sampled obstacles."""
        out: list[ObstacleConfig] = []
        for one in sampled:
            mine = member(one.kind, sum(other.kind == one.kind for other in out))
            out.append(replace(mine, station=one.station + self._start, lateral=one.lateral, yaw=one.yaw))
        return out

    def _distractor(self, kind: str, number: int) -> ObstacleConfig:
        color = self._colors[STATIC_KINDS.index(kind), number]
        return ObstacleConfig(f"beside_{kind}_{number}", kind, color=tuple(color.tolist()))


def _static_obstacle(kind: str, number: int) -> ObstacleConfig:
    return ObstacleConfig(f"{kind}_{number}", kind)


class ObstacleMotion:
    """Moves an episode's obstacles; used as `HuskyPhysics.move_obstacles`."""

    def __init__(self, obstacles: Sequence[ObstacleConfig], data: mujoco.MjData) -> None:
        self.obstacles, self._data = tuple(obstacles), data
        self.moving = any(one.to for one in self.obstacles)
        self._moving: list[tuple[ObstacleConfig, int]] | None = None  # moving obstacles, and their mocap bodies
        self._route = np.zeros((0, 3))

    def __call__(self, time: float) -> None:
        """Moves obstacles to their poses at a time [s]; static ones are set only at time 0, and by the first call."""
        if time == 0.0 or self._moving is None:
            place(self.obstacles, self._data, time)
        if self._moving is None:
            bodies = [(one, self._data.model.body(body_name(one, k))) for k, one in enumerate(self.obstacles)]
            self._moving = [(one, int(body.mocapid[0])) for one, body in bodies if one.to]
            if self._moving:
                self._route = stored_route(self._data.model)
        elif time != 0.0:
            for one, mocap in self._moving:
                _set_pose(self._data, mocap, obstacle_pose(one, self._route, time))
