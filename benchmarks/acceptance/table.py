"""The acceptance table: measuring functions by row ids, and the negative controls that must fail them."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from acceptance import plane, terrain
from acceptance.rows import Row, Subject
from twin.robot import WHEEL_RADIUS, WHEEL_WIDTH, WHEELS

MEASURES: dict[str, Callable[[Subject], list[Row]]] = {
    "A1": plane.composition,
    "A2": plane.measures,
    "B1": plane.track_ratios,
    "B2": plane.friction_spread,
    "B3": plane.arcs,
    "B4 B5": plane.scrubbing,
    "B6 B7": plane.quiet,
    "B8": plane.drift,
    "C1": plane.push,
    "C2": plane.slopes,
    "C3": plane.stall,
    "D1 D2 D3 D5": plane.straight,
    "D4": plane.stops,
    "D6": plane.overshoot,
    "E1 E2": terrain.flat_ground,
    "E3": terrain.reconstructed_ground,
    "E4": terrain.halved_step,
    "P1": terrain.plates,
    "P2": terrain.ramp,
}
"""Row ids → function that measures them."""


@dataclass(frozen=True)
class Control:
    """A negative control: a model that is wrong in a known way."""

    name: str
    subject: Subject
    fails: tuple[str, ...]
    """Keys of MEASURES; the model must fail at least one row of each."""


def _default_contacts(spec: mujoco.MjSpec) -> None:
    for name in WHEELS:
        tire = spec.geom(f"{name}_tyre")
        tire.solref, tire.solimp = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)


def _pyramidal_cone(spec: mujoco.MjSpec) -> None:
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def _mesh_tyres(spec: mujoco.MjSpec) -> None:
    angle = np.arange(32) * 2 * np.pi / 32
    rings = [(WHEEL_RADIUS * np.cos(angle), np.full(32, y), WHEEL_RADIUS * np.sin(angle)) for y in (-0.5, 0.5)]
    mesh = spec.add_mesh(name="polygon")
    mesh.uservert = (np.concatenate([np.stack(ring, 1) for ring in rings]) * [1.0, WHEEL_WIDTH, 1.0]).ravel()
    for name in WHEELS:
        tire = spec.geom(f"{name}_tyre")
        tire.type, tire.meshname = mujoco.mjtGeom.mjGEOM_MESH, "polygon"


def _casters(spec: mujoco.MjSpec) -> None:
    for name in WHEELS[2:]:
        tire = spec.geom(f"{name}_tyre")
        tire.condim, tire.friction = 1, (0.0, 0.0, 0.0)


CONTROLS = (
    Control("default contacts", Subject(edit=_default_contacts), ("B6 B7",)),
    Control("pyramidal cone", Subject(edit=_pyramidal_cone), ("B4 B5",)),
    Control("mesh tires", Subject(edit=_mesh_tyres), ("A1", "B6 B7")),
    Control("frictionless casters", Subject(edit=_casters), ("A1", "B1", "B4 B5")),
)
