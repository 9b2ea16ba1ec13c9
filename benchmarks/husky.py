"""Acceptance table of the Husky model, its negative controls and its simulation speed.

    python benchmarks/husky.py [--scene BUILT_SCENE] [--only A1 B6 ...] [--json FILE]

With `--scene`, the script also measures chi (the track ratio) of the scene's robot on the scene's ground, and the
simulation speed there. A run takes 40 s on the machine in `docs/benchmarks.md`. The exit status is 1 if a row fails or
a negative control passes.
"""

import math
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from acceptance import Row, Subject, plane, terrain
from acceptance.drives import on_ground, on_plane
from acceptance.grounds import reconstructed
from record import record_parser, save

from twin.assets.ground import Ground
from twin.loading import load_scene
from twin.robot import WHEEL_RADIUS, WHEEL_WIDTH, WHEELS

_STEPS, _PIECES, _REPEATS = 5000, 50, 7
_SPEED = (4.0, 4.5)  # [rad/s] of the left and right wheels: a gentle bend at 0.7 m/s
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


def steps_per_second(model: mujoco.MjModel) -> float:
    """Simulation steps per second on one core, over one drive of 10 s.

    The drive is timed in pieces of 0.2 s; one call of `mj_step` runs the 100 steps of a piece. For each piece the
    fastest repeat counts, which reduces the effect of other load on the machine.
    """
    seconds = np.full(_PIECES, np.inf)
    for _ in range(_REPEATS):
        data = mujoco.MjData(model)
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[:] = _SPEED
        mujoco.mj_step(model, data, 500)
        for i in range(_PIECES):
            start = time.perf_counter()
            mujoco.mj_step(model, data, _STEPS // _PIECES)
            seconds[i] = min(seconds[i], time.perf_counter() - start)
    return _STEPS / float(seconds.sum())


def speeds(scene: Path | None) -> list[Row]:
    """Rows of steps per second on a plane, a reconstructed road, and the scene."""
    bumps = reconstructed(np.random.default_rng(0))
    models = {"a plane": (on_plane(), 30e3), "a reconstructed flat road": (on_ground(bumps, start=(-7, 0, 0)), 20e3)}
    if scene is not None:
        models[f"{scene.name}'s ground, with its convex parts"] = (load_scene(scene).world().model(), 20e3)
    return [
        Row("speed", f"steps of {1000 * m.opt.timestep:g} ms on {label}", steps_per_second(m), wanted, math.inf, "1/s")
        for label, (m, wanted) in models.items()
    ]


def scene_rows(path: Path) -> list[Row]:
    """Rows of test E3 (chi) on the ground of a built scene."""
    scene = load_scene(path)
    world = scene.world()
    x, y, _, yaw = world.spawn
    ground = Ground.load(scene.scene.stage("mesh"))
    return terrain.chi_on(Subject(world.robot), ground, (x, y, yaw), world.route, f"{path.name}'s ground")


def line(row: Row) -> str:
    limits = f"{row.low:.5g} to {row.high:.5g}"
    if math.isinf(row.high):
        limits = f"≥ {row.low:.5g}"
    elif math.isinf(row.low):
        limits = f"≤ {row.high:.5g}"
    verdict = "pass" if row.passed else "FAIL"
    return f"{row.id:<5} {row.quantity:<84} {row.value:>10.4g} {row.unit:<6} {limits:<18} {verdict}"


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, help="a built scene")
    kinds = "row ids such as B6; `controls` for the negative controls; `speed` for the simulation speed"
    ids = (*" ".join(MEASURES).split(), "controls", "speed")
    parser.add_argument("--only", nargs="+", choices=ids, metavar="ID", help=kinds)
    arguments = parser.parse_args()

    def wanted(*names: str) -> bool:
        return not arguments.only or bool(set(names) & set(arguments.only))

    rows: list[Row] = []

    def show(more: list[Row]) -> None:
        for row in more:
            print(line(row), flush=True)
        rows.extend(more)

    print(f"{'':<5} {'quantity':<84} {'measured':>10} {'':<6} {'wanted':<18}")
    for key, measure in MEASURES.items():
        if wanted(*key.split()):
            show(measure(Subject()))
    if arguments.scene and wanted("E3"):
        show(scene_rows(arguments.scene))
    if wanted("speed"):
        show(speeds(arguments.scene))
    controls: dict[str, Any] = {}
    for control in CONTROLS if wanted("controls") else ():
        measured = [row for key in control.fails for row in MEASURES[key](control.subject)]
        failed = sorted({row.id for row in measured if not row.passed})
        caught = all(any(row.id in failed for row in measured if row.id in key.split()) for key in control.fails)
        controls[control.name] = {"fails": failed, "caught": caught, "rows": [asdict(row) for row in measured]}
        worst = ", ".join(f"{row.quantity} {row.value:.3g}" for row in measured if not row.passed and row.id != "A1")
        print(f"control: {control.name}: {'fails ' + ', '.join(failed) if caught else 'PASSES'} ({worst})", flush=True)
    status = 0
    if arguments.json:
        report = {
            "rows": [asdict(row) | {"passed": row.passed} for row in rows],
            "controls": controls,
            "machine": platform.processor() or platform.machine(),
            "mujoco": metadata.version("mujoco"),
        }
        # JSON has no infinity, so an open limit is null.
        open_limits = {math.inf: None, -math.inf: None}
        for row in [*report["rows"], *(row for control in controls.values() for row in control["rows"])]:
            row |= {k: open_limits.get(row[k], row[k]) for k in ("value", "low", "high")}
        status = save(arguments.json, report, arguments.replace_record)
    return status or int(not all(row.passed for row in rows) or not all(c["caught"] for c in controls.values()))


if __name__ == "__main__":
    sys.exit(main())
