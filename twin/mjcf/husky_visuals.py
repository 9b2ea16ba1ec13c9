"""Visual geoms of the Husky: hull, tires, bumpers and camera mast, without mass or contacts.

Their proportions follow the published dimensions; nothing is taken from Clearpath's meshes.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.robot import WHEEL_WIDTH, HuskyParams
from twin.types import Array

ROBOT_VISUAL_GROUP = 1
"""Group of these geoms."""

_CAMERA_PREFIX = "camera_"  # prefix of the names of the camera housing's geoms
_YELLOW = (0.96, 0.74, 0.05, 1.0)
_BLACK = (0.06, 0.06, 0.065, 1.0)
_DARK = (0.13, 0.13, 0.14, 1.0)
_STEEL = (0.45, 0.46, 0.48, 1.0)
_LAMP = (0.95, 0.95, 0.88, 1.0)
_RED = (0.75, 0.06, 0.05, 1.0)

_LUGS = 22  # tread blocks around a tire


def add_visuals(
    spec: mujoco.MjSpec, base: mujoco.MjsBody, wheels: dict[str, mujoco.MjsBody], params: HuskyParams
) -> None:
    """Adds visual geoms to the base and the wheels (by name, as in `twin.robot.WHEELS`)."""
    radii, width = params.wheel_radius, WHEEL_WIDTH
    for name, rgba, specular in (("yellow", _YELLOW, 0.4), ("black", _BLACK, 0.2), ("dark", _DARK, 0.2)):
        spec.add_material(name=f"husky_{name}", rgba=rgba, specular=specular, shininess=0.4)
    tires = {radius: f"tyre_{i}" for i, radius in enumerate(dict.fromkeys(radii))}
    meshes = {"hull": _hull()} | {name: _tire(radius, width) for radius, name in tires.items()}
    for name, (vertices, faces) in meshes.items():
        mesh = spec.add_mesh(name=f"husky_{name}")
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL

    _mesh(base, "husky_hull", "husky_yellow")
    _box(base, (0.66, 0.34, 0.11), (0.0, 0.0, 0.035), material="husky_dark")  # belly between the wheels
    _box(base, (0.74, 0.50, 0.012), (0.0, 0.0, 0.236), material="husky_dark")  # top plate
    for y in (-0.235, 0.235):  # rails along the top plate
        _box(base, (0.74, 0.03, 0.02), (0.0, y, 0.250), material="husky_black")
    for x in (-0.30, -0.10, 0.10, 0.30):  # slots of the top plate
        _box(base, (0.012, 0.36, 0.004), (x, 0.0, 0.2435), rgba=_STEEL)
    for end in (-1.0, 1.0):
        _bumper(base, end)
    _box(base, (0.16, 0.11, 0.05), (-0.29, 0.0, 0.267), material="husky_black")  # user panel and emergency stop
    _cylinder(base, (-0.29, 0.0, 0.29), (-0.29, 0.0, 0.318), 0.024, rgba=_RED)
    _mast(base, params.camera_position)
    for name, wheel in wheels.items():
        radius = radii[name.endswith("right")]
        _mesh(wheel, f"husky_{tires[radius]}", "husky_black")
        for y in (-1.0, 1.0):
            _cylinder(wheel, (0, 0.30 * width * y, 0), (0, 0.44 * width * y, 0), 0.55 * radius, rgba=_STEEL)
            _cylinder(wheel, (0, 0.40 * width * y, 0), (0, 0.47 * width * y, 0), 0.22 * radius, material="husky_yellow")
            for angle in np.arange(5) * 2 * np.pi / 5:  # wheel bolts, which make the rotation visible
                x, z = 0.38 * radius * np.cos(angle), 0.38 * radius * np.sin(angle)
                _cylinder(wheel, (x, 0.42 * width * y, z), (x, 0.465 * width * y, z), 0.012, material="husky_black")


def _bumper(base: mujoco.MjsBody, end: float) -> None:
    """Adds a black bumper bar with two lamps at the front (end = 1) or the rear (end = −1)."""
    x = 0.455 * end
    _tube(base, (x, -0.20, 0.075), (x, 0.20, 0.075), 0.024)
    _tube(base, (x, -0.20, 0.165), (x, 0.20, 0.165), 0.018)
    for y in (-0.20, 0.20):
        _tube(base, (x, y, 0.075), (x, y, 0.165), 0.018)
        _tube(base, (x, y, 0.075), (0.38 * end, y * 0.9, 0.075), 0.018)
        _cylinder(
            base, (0.395 * end, 0.65 * y, 0.12), (0.43 * end, 0.65 * y, 0.12), 0.03, rgba=_LAMP if end > 0 else _RED
        )


def _mast(base: mujoco.MjsBody, camera: tuple[float, float, float]) -> None:
    """Adds an arch of two tubes that carries the camera, and the camera's housing just behind its lens."""
    x, y, z = camera
    foot = min(x, 0.33) - 0.05
    if z > 0.30:
        for side in (-0.20, 0.20):
            _tube(base, (foot, side, 0.25), (foot, side, z - 0.09), 0.014)
            _tube(base, (foot, side, z - 0.09), (foot, 0.72 * side, z - 0.04), 0.014)
        _tube(base, (foot, -0.144, z - 0.04), (foot, 0.144, z - 0.04), 0.014)
        _tube(base, (foot, y, z - 0.04), (x - 0.03, y, z - 0.02), 0.012, name=f"{_CAMERA_PREFIX}bracket")
    _box(base, (0.03, 0.175, 0.03), (x - 0.02, y, z), rgba=_STEEL, name=f"{_CAMERA_PREFIX}housing")
    for name, offset in (("lens_right", -0.06), ("lens_left", 0.06)):
        ends = (x - 0.01, y + offset, z), (x - 0.002, y + offset, z)
        _cylinder(base, *ends, 0.011, material="husky_black", name=f"{_CAMERA_PREFIX}{name}")


def camera_mount_geoms(model: mujoco.MjModel, camera: int) -> NDArray[np.int64]:
    """Geoms to leave out of a camera's images: the housing, lenses and bracket on the camera's body, shape (k,).

    Randomization shifts the camera, and a delayed picture is rendered from an earlier pose, but these geoms stay where
    they are, so they could block the view.
    """
    own = np.flatnonzero(model.geom_bodyid == model.cam_bodyid[camera])
    return own[[model.geom(int(i)).name.startswith(_CAMERA_PREFIX) for i in own]]


def _geom(body: mujoco.MjsBody, kind: Any, **settings: Any) -> None:
    body.add_geom(type=kind, contype=0, conaffinity=0, group=ROBOT_VISUAL_GROUP, mass=0.0, **settings)


def _mesh(body: mujoco.MjsBody, name: str, material: str) -> None:
    _geom(body, mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=material)


def _box(body: mujoco.MjsBody, size: tuple[float, ...], center: tuple[float, ...], **settings: Any) -> None:
    _geom(body, mujoco.mjtGeom.mjGEOM_BOX, size=np.array(size) / 2, pos=center, **settings)


def _cylinder(body: mujoco.MjsBody, start: Any, end: Any, radius: float, **settings: Any) -> None:
    _geom(body, mujoco.mjtGeom.mjGEOM_CYLINDER, fromto=(*start, *end), size=(radius, 0, 0), **settings)


def _tube(body: mujoco.MjsBody, start: Any, end: Any, radius: float, **settings: Any) -> None:
    settings |= {"fromto": (*start, *end), "size": (radius, 0, 0), "material": "husky_black"}
    _geom(body, mujoco.mjtGeom.mjGEOM_CAPSULE, **settings)


def _hull() -> tuple[Array, NDArray[np.int64]]:
    """Mesh of the yellow hull: eight-sided outlines, widest above the wheels, narrower at the top and the bottom."""
    levels = (  # height, half length, half width, corner cut [m]
        (0.075, 0.36, 0.20, 0.04),
        (0.140, 0.40, 0.22, 0.05),
        (0.165, 0.41, 0.275, 0.06),
        (0.215, 0.40, 0.275, 0.06),
        (0.232, 0.38, 0.255, 0.06),
    )
    rings = []
    for z, a, b, c in levels:
        outline = [(a, b - c), (a - c, b), (c - a, b), (-a, b - c), (-a, c - b), (c - a, -b), (a - c, -b), (a, c - b)]
        rings.append([(x, y, z) for x, y in outline])
    return _lathe(np.array(rings))


def _tire(radius: float, width: float) -> tuple[Array, NDArray[np.int64]]:
    """Mesh of a tire with chevron lugs about the y axis."""
    steps = 4 * _LUGS
    # Across the tire: position [half widths], radius at a lug and in a groove [tire radii], lead of the chevron [lugs].
    profile = (
        (-0.62, 0.50, 0.50, 0.0),
        (-0.98, 0.70, 0.70, 0.0),
        (-1.00, 0.88, 0.86, 0.5),
        (-0.80, 0.99, 0.93, 0.5),
        (-0.40, 1.00, 0.945, 0.25),
        (0.00, 1.00, 0.95, 0.0),
        (0.40, 1.00, 0.945, 0.25),
        (0.80, 0.99, 0.93, 0.5),
        (1.00, 0.88, 0.86, 0.5),
        (0.98, 0.70, 0.70, 0.0),
        (0.62, 0.50, 0.50, 0.0),
    )
    rings = []
    for y, lug, groove, lead in profile:
        phase = (np.arange(steps) / 4 + lead) * 2 * np.pi  # one lug per 2π
        angle = np.arange(steps) * 2 * np.pi / steps
        r = radius * np.where(np.sin(phase + 0.1) > 0, lug, groove)
        rings.append(np.stack([r * np.cos(angle), np.full(steps, y * width / 2), -r * np.sin(angle)], 1))
    return _lathe(np.array(rings))


def _lathe(rings: Array) -> tuple[Array, NDArray[np.int64]]:
    """A closed mesh with caps from stacked rings (levels, n, 3), counter-clockwise about the stacking direction."""
    levels, n, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    i = np.arange(n)
    j = (i + 1) % n
    faces = []
    for low in np.arange(levels - 1) * n:
        faces += [np.stack([low + i, low + j, low + n + j], 1), np.stack([low + i, low + n + j, low + n + i], 1)]
    bottom, top = levels * n, levels * n + 1
    last = (levels - 1) * n
    faces += [np.stack([np.full(n, bottom), j, i], 1), np.stack([np.full(n, top), last + i, last + j], 1)]
    return vertices, np.concatenate(faces)
