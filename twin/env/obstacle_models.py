"""Obstacle geometry: primitives and convex hulls in uniform colors, without mesh or texture files.

In an obstacle's frame, x points to its front, y to its left and z up; the origin is on the ground below its center.
Geoms that are visible and collide are in group `OBSTACLE_GROUP`; those that only collide are in the robot's collision
group.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np

from twin.mjcf import husky

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


def _box(shape: ObstacleModel, color: Color, size: Sequence[float] = ()) -> None:
    length, width, height = size or _BOX_SIZE
    shape.box((length, width, height), (0, 0, height / 2), color)


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
    husky.add_visuals(spec, base, wheels, husky.HuskyParams())
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


_BUILDERS: dict[str, Callable[..., None]] = {
    "cone": _cone,
    "box": _box,
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
    build = partial(_BUILDERS[kind], size=size) if kind == "box" else _BUILDERS[kind]
    build(shape, (red, green, blue))
