"""The whole table, and the wrong robots that must not pass it.

Ids: A what it is made of, B scrubbing on a plane, C friction at rest, D driving, E ground from the shipped pipeline; P
goes beyond. Judge chi together with B4 to B6: a hopping model can read a plausible chi, and a pyramidal cone reads the
right chi with a torque 21 % too low.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from twin.env.acceptance import ground, plane
from twin.env.acceptance.rows import Row, Subject
from twin.robot import WHEEL_RADIUS, WHEEL_WIDTH, WHEELS

MEASURES: dict[str, Callable[[Subject], list[Row]]] = {
    "A1": plane.made_of,
    "A2": plane.measures,
    "B1": plane.track_ratios,
    "B2": plane.friction_spread,
    "B3": plane.arcs,
    "B4 B5": plane.scrubbing,
    "B6 B7": plane.quiet,
    "B8": plane.drift,
    "C1": plane.pushed,
    "C2": plane.slopes,
    "C3": plane.stall,
    "D1 D2 D3 D5": plane.straight,
    "D4": plane.stops,
    "D6": plane.overshoot,
    "E1 E2": ground.flat_ground,
    "E3": ground.reconstructed_ground,
    "E4": ground.halved_step,
    "P1": ground.plates,
    "P2": ground.ramp,
}
"""What measures which rows."""


@dataclass(frozen=True)
class Control:
    """A model that is wrong in a known way."""

    name: str
    subject: Subject
    fails: tuple[str, ...]
    """Keys of MEASURES, each of which must have a row that it fails."""


def _default_contacts(spec: mujoco.MjSpec) -> None:
    for name in WHEELS:
        tyre = spec.geom(f"{name}_tyre")
        tyre.solref, tyre.solimp = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)


def _pyramidal_cone(spec: mujoco.MjSpec) -> None:
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def _mesh_tyres(spec: mujoco.MjSpec) -> None:
    angle = np.arange(32) * 2 * np.pi / 32
    rings = [(WHEEL_RADIUS * np.cos(angle), np.full(32, y), WHEEL_RADIUS * np.sin(angle)) for y in (-0.5, 0.5)]
    mesh = spec.add_mesh(name="polygon")
    mesh.uservert = (np.concatenate([np.stack(ring, 1) for ring in rings]) * [1.0, WHEEL_WIDTH, 1.0]).ravel()
    for name in WHEELS:
        tyre = spec.geom(f"{name}_tyre")
        tyre.type, tyre.meshname = mujoco.mjtGeom.mjGEOM_MESH, "polygon"


def _casters(spec: mujoco.MjSpec) -> None:
    for name in WHEELS[2:]:
        tyre = spec.geom(f"{name}_tyre")
        tyre.condim, tyre.friction = 1, (0.0, 0.0, 0.0)


CONTROLS = (
    Control("default contacts", Subject(edit=_default_contacts), ("B6 B7",)),
    Control("pyramidal cone", Subject(edit=_pyramidal_cone), ("B4 B5",)),
    Control("mesh tyres", Subject(edit=_mesh_tyres), ("A1", "B6 B7")),
    Control("frictionless casters", Subject(edit=_casters), ("A1", "B1", "B4 B5")),
)
