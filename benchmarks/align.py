"""Benchmark of the aligned Husky model against logs of real Huskies.

Prints the figures of `twin align` for a log on grass, and measured motor currents on asphalt beside simulated torques.

    python benchmarks/align.py [--data FOLDER] [--work FOLDER] [--json FILE]

The folder `--data` contains the logs `husky_drive` and `borealtc_asphalt`. A run takes about 20 minutes on two cores of
the machine in `docs/benchmarks.md`. The exit status is 1 if a target is missed.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import motor_currents
from record import record_parser, save

from twin import runtime
from twin.align import align_to_log, summary
from twin.robot import REAR_HEAVY, HuskyParams

_DATA = Path(__file__).parents[2] / "shared" / "data"
_LOG = Path("husky_drive") / "husky_drive_dev.npz"
_ASPHALT = "borealtc_asphalt"

TARGETS = {"position_m": 0.12, "yaw_deg": 4.7, "wheels_rad_s": 0.3}
"""Upper limits of the median errors over held-out windows of the log, 2 s each."""


def turning_efforts(data: Path) -> dict[str, dict[str, float]]:
    """Motor current or torque in a steady turn, relative to driving straight: outer side, inner side, mean of both.

    The keys are "measured" and the names of the simulated robots.
    """
    steady = motor_currents.read_currents(sorted((data / _ASPHALT).glob("ASPHALT_pro_*.npz")))
    published = HuskyParams()
    rolling = motor_currents.rolling_resistance_of(steady, published)
    robots = {
        "simulated, published robot": published,
        "simulated, rear-heavy": replace(published, center_of_mass=REAR_HEAVY),
        f"simulated, rolling resistance {rolling:.3f} (fitted to the mean)": replace(
            published, rolling_resistance=rolling
        ),
    }
    found = {"measured": motor_currents.measured_effort(steady)}
    found |= {name: motor_currents.simulated_effort(steady, params) for name, params in robots.items()}
    return {
        name: {"outer": round(e.outer, 3), "inner": round(e.inner, 3), "mean": round(e.total, 3)}
        for name, e in found.items()
    }


def against_kinematics(figures: dict[str, Any]) -> list[str]:
    """One line per assumption on the ground: median errors of model and kinematic baseline over held-out windows.

    The baseline assumes level ground, so the two have the same information only in the first line.
    """
    held_out = {name: score["held_out"] for name, score in figures["scores"].items()}
    base, lines = held_out["icr_kinematics"], []
    for what, name in (("level ground", "fitted_on_level_ground"), ("slope from the accelerometer", "fitted")):
        ours = held_out[name]
        gains = [1.0 - ours[key] / base[key] for key in ("position_m", "yaw_deg")]
        lines.append(
            f"{what:30} {ours['position_m']:.3f} m against {base['position_m']:.3f} m ({gains[0]:.0%} better), "
            f"{ours['yaw_deg']:.2f}° against {base['yaw_deg']:.2f}° ({gains[1]:.0%})"
        )
    return lines


def verdicts(figures: dict[str, Any]) -> list[tuple[str, float, float, bool]]:
    """One row per target: name, value, target, and True if the target is met."""
    held_out = figures["scores"]["fitted"]["held_out"]
    rows = [(name, held_out[name], most, held_out[name] <= most) for name, most in TARGETS.items()]
    return [*rows, *((f"better than ICR, {k}", v, 1 / 3, v >= 1 / 3) for k, v in figures["better_than_icr"].items())]


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of the real logs")
    parser.add_argument(
        "--work", type=Path, help="folder for robot.toml, align.json and the plots (default: a temporary one)"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work = options.work or Path(scratch)
        result, folder = align_to_log("husky", options.data / _LOG, work)
        figures = json.loads((folder / "alignment" / "align.json").read_text(encoding="utf-8"))
    print(summary(result))
    print("MJCF against the kinematic baseline, pose after 2 s, median error over held-out windows:")
    print("\n".join(against_kinematics(figures)))
    rows = verdicts(figures)
    for name, value, target, met in rows:
        print(f"{name:28} {value:8.4f}   wanted {target:.4f}   {'met' if met else 'missed'}")
    runtime.log_line("currents on asphalt")
    asphalt = turning_efforts(options.data)
    print(f"\n{'turning relative to driving straight':64} outer  inner   mean")
    for name, e in asphalt.items():
        print(f"{name:64} {e['outer']:5.2f}  {e['inner']:5.2f}  {e['mean']:5.2f}")
    everything = {"drive": figures, "asphalt": asphalt, "targets": {n: bool(m) for n, _, _, m in rows}}
    status = save(options.json, everything, options.replace_record)
    return status or int(not all(met for *_, met in rows))


if __name__ == "__main__":
    sys.exit(main())
