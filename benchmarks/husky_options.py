"""Effects of a scene's options on the Husky's tires, and whether `twin.mjcf.husky.check` reports them.

    python benchmarks/husky_options.py [--json FILE]

The robot turns on the spot at a commanded 1 rad/s, on a plane and on a flat road as the mesh stage reconstructs it.
Prints yaw rate and motor torque, divided by those with the right options on the plane; motor power divided by the power
that the contacts dissipate (1 if energy is conserved); vertical acceleration at the camera (jolt); and the speed of the
robot when parked on a slope (creep). A run takes 20 s.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass

import mujoco
import numpy as np
from acceptance import GRAVITY
from acceptance.drives import drive, on_ground, on_plane
from acceptance.grounds import reconstructed
from record import record_parser, save

from twin.assets.ground import Ground
from twin.mjcf.husky import check
from twin.robot import WHEELS, HuskyParams

Edit = Callable[[mujoco.MjSpec], None]


def option(**values: object) -> Edit:
    """An edit that sets options of the scene."""
    return lambda spec: _set(spec.option, values)


def ground(**values: object) -> Edit:
    """An edit that sets attributes of the ground."""
    return lambda spec: _set(spec.geom("ground"), values)


def _set(target: object, values: dict[str, object]) -> None:
    for name, value in values.items():
        setattr(target, name, value)


def pairs(spec: mujoco.MjSpec) -> None:
    """Defines every tire's contact with the ground as an explicit pair."""
    for name in WHEELS:
        spec.add_pair(geomname1=f"{name}_tyre", geomname2="ground")


RIGHT = "as `set_options` sets them"
Integrator, Solver = mujoco.mjtIntegrator, mujoco.mjtSolver
CASES: dict[str, Edit | None] = {
    RIGHT: None,
    "`cone` pyramidal (MuJoCo's default)": option(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL),
    "`impratio` 1 (MuJoCo's default)": option(impratio=1.0),
    "`impratio` 100": option(impratio=100.0),
    "`integrator` Euler (MuJoCo's default)": option(integrator=Integrator.mjINT_EULER),
    "`integrator` RK4": option(integrator=Integrator.mjINT_RK4),
    "`integrator` implicit": option(integrator=Integrator.mjINT_IMPLICIT),
    "`timestep` 5 ms": option(timestep=0.005),
    "`timestep` 4 ms": option(timestep=0.004),
    "`timestep` 10 ms": option(timestep=0.01),
    "`solver` PGS": option(solver=Solver.mjSOL_PGS),
    "`solver` CG": option(solver=Solver.mjSOL_CG),
    "`solver` PGS, 10 `iterations`": option(solver=Solver.mjSOL_PGS, iterations=10),
    "`iterations` 1": option(iterations=1),
    "`iterations` 3": option(iterations=3),
    "`iterations` 10": option(iterations=10),
    "`tolerance` 1e-2": option(tolerance=1e-2),
    "`noslip_iterations` 5": option(noslip_iterations=5),
    "ground of `priority` 2, otherwise MuJoCo's default": ground(priority=2),
    "the same with `condim` 1": ground(priority=2, condim=1),
    "flag `override` enabled": option(enableflags=mujoco.mjtEnableBit.mjENBL_OVERRIDE),
    "contact `pair` of each tire, otherwise MuJoCo's default": pairs,
    "cone, impratio, integrator as MuJoCo's default": option(
        cone=mujoco.mjtCone.mjCONE_PYRAMIDAL, impratio=1.0, integrator=Integrator.mjINT_EULER, tolerance=1e-8
    ),
}


@dataclass(frozen=True)
class Cost:
    """Behavior of a model, and the number of faults that `check` finds in it."""

    yaw_rate: float
    """Yaw rate of a turn on the spot on a plane [rad/s]."""
    torque: float
    """Mean motor torque per wheel in that turn [N m]."""
    balance: float
    """Power of the motors divided by the power that the contacts dissipate."""
    jolt: float
    """Vertical acceleration at the camera [m/s²]."""
    ground_yaw_rate: float
    """Yaw rate of the same turn on a reconstructed flat road [rad/s]."""
    ground_jolt: float
    """Vertical acceleration at the camera on that road [m/s²]."""
    creep: float
    """Speed [mm/s] 2 s after the robot is parked on a slope that is 2° less steep than the one on which it slides."""
    faults: int
    """Number of options that `check` reports as wrong."""

    def differs(self, right: "Cost") -> bool:
        """True if yaw rate differs by 2 % or torque by 5 % from `right`, or if jolt or creep is large."""
        turns = abs(self.yaw_rate / right.yaw_rate - 1) < 0.02 and abs(self.ground_yaw_rate / right.yaw_rate - 1) < 0.02
        quiet = self.jolt < 0.2 and self.ground_jolt < 1.0
        return not (turns and quiet and abs(self.torque / right.torque - 1) < 0.05 and self.creep < 5.0)


def measure(edit: Edit | None, road: Ground) -> Cost:
    model = on_plane(edit=edit)
    turn = drive(model, 0.0, 1.0, 1.5, 1.5)
    dissipated = turn.dissipated.mean()
    balance = float(turn.power.mean() / dissipated) if dissipated else math.nan
    there = drive(on_ground(road, edit=edit), 0.0, 1.0, 1.5, 1.5)
    angle = math.atan(HuskyParams.friction) - math.radians(2.0)
    parked = on_plane(edit=edit)
    parked.opt.gravity[:] = GRAVITY * np.array([0.0, math.sin(angle), -math.cos(angle)])
    data = mujoco.MjData(parked)
    mujoco.mj_step(parked, data, round(2.0 / parked.opt.timestep))
    creep = 1000 * float(np.linalg.norm(data.qvel[:2]))
    torque = float(np.abs(turn.torque).mean() / 2)
    return Cost(turn.yaw_rate, torque, balance, turn.jolt, there.yaw_rate, there.jolt, creep, len(check(model)))


def main() -> int:
    parser = record_parser(__doc__)
    arguments = parser.parse_args()
    road = reconstructed(np.random.default_rng(0))
    rows = {name: measure(edit, road) for name, edit in CASES.items()}
    right = rows[RIGHT]
    columns = "yaw rate", "torque", "power balance", "jolt, m/s²", "road: yaw rate", "road: jolt, m/s²", "creep, mm/s"
    print(f"| options of the scene | {' | '.join(columns)} | found |\n|---|{'---|' * (len(columns) + 1)}")
    for name, row in rows.items():
        values = [row.yaw_rate / right.yaw_rate, row.torque / right.torque, row.balance]
        texts = [f"{value:.3f}" for value in values] + [
            f"{row.jolt:.2g}",
            f"{row.ground_yaw_rate / right.yaw_rate:.3f}",
        ]
        texts += [f"{row.ground_jolt:.2g}", f"{row.creep:.2g}", "yes" if row.faults else "no"]
        print(f"| {name} | {' | '.join(texts)} |")
    return save(arguments.json, {name: asdict(row) for name, row in rows.items()}, arguments.replace_record)


if __name__ == "__main__":
    sys.exit(main())
