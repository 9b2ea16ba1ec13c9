"""Benchmark of the aligned Husky model against logs of real Huskies.

Prints the figures of `twin align` for a log on grass, and measured motor currents on asphalt beside simulated torques.

    python benchmarks/align.py [--data FOLDER] [--work FOLDER] [--json FILE]
    python benchmarks/align.py --last-third [--data FOLDER] [--json FILE]

With `--last-third`, the model is fitted to the first two thirds of the log on grass, and scored on the last third.
There it is compared with an ICR model on level ground, and with one that gets the same slopes.

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
import numpy as np
from acceptance import REAR_HEAVY
from numpy.typing import NDArray
from record import record_parser, save
from scipy.optimize import least_squares

from twin import runtime
from twin.align import align_to_log, summary
from twin.robot import HuskyParams
from twin.sysid.estimation import fit_with_scales, robust_loss
from twin.sysid.identification import identify
from twin.sysid.kinematics import POSE_KINDS, IcrModel, Prediction, integrate, residuals
from twin.sysid.log_files import read_log
from twin.sysid.logs import MAX_POSE_AGE, PERIOD, Windows, resample_poses
from twin.sysid.rollout import slope_gravity
from twin.types import Array

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


# ---- the last third of a log


def cut_last_third(windows: Windows) -> Windows:
    """The windows with new groups: the first two thirds of the groups are for fitting, the others for scoring."""
    names, rank = np.unique(windows.groups, return_inverse=True)
    return replace(windows, groups=2 * rank + (rank >= len(names) * 2 / 3))


def fit_sloped_icr(windows: Windows, slope: Array) -> Prediction:
    """An ICR model that drifts downhill, fitted to the windows for fitting, and its prediction of all windows.

    Its velocity gets two more terms: gravity forward and to the left [m/s²], each times a constant [s]. The constants
    are fitted together with the other parameters, by the same likelihood. `slope` (n, 2) is `slope_gravity`'s result.
    """
    start = np.array([1.0, 1.0, 0.5, -0.5, 0.0, 0.0, 0.0])
    fitting = windows.fitting

    def pose_residuals(x: Array) -> Array:
        return residuals(_sloped_poses(x, windows, slope), windows)[fitting]

    def solve(x: Array, scale: Array) -> Array:
        return least_squares(lambda x: robust_loss(pose_residuals(x) / scale).ravel(), x, x_scale=0.1).x

    found = fit_with_scales(start, pose_residuals, POSE_KINDS, solve)
    return Prediction("ICR kinematics with slope", windows, _sloped_poses(found, windows, slope))


def _sloped_poses(x: Array, windows: Windows, slope: Array) -> Array:
    """Poses like those of `kinematics.predict`, for five ICR parameters and two of the drift, shape (7,)."""
    model, preceding = IcrModel(*x[:5].tolist()), windows.preceding_wheels
    before, after = preceding[:, -1 - MAX_POSE_AGE : -1], np.repeat(windows.wheels[:, -1:], MAX_POSE_AGE, 1)
    motion = model.motion(np.concatenate([before, windows.wheels, after], 1))
    # The slope is given in the frame at the start of the preceding wheel speeds.
    turned = model.motion(preceding[:, : -1 - MAX_POSE_AGE])[..., 2].sum(1, keepdims=True) * PERIOD
    yaw = turned + np.cumsum(motion[..., 2], 1) * PERIOD - motion[..., 2] * PERIOD
    gravity = (slope[:, :1] + 1j * slope[:, 1:]) * np.exp(-1j * yaw)
    motion[..., 0] += x[5] * gravity.real
    motion[..., 1] += x[6] * gravity.imag
    return resample_poses(integrate(motion), -windows.measurement_times[:, 0], MAX_POSE_AGE)


def last_third(data: Path) -> dict[str, Any]:
    """Scores of models and baselines on the last third of the log; median gains of the model over both baselines.

    The intervals are 90 % intervals of the gains, from resampled groups of the last third.
    """
    windows = cut_last_third(read_log(data / _LOG))
    found = identify(windows, HuskyParams(), progress=runtime.log_line)
    sloped = fit_sloped_icr(windows, slope_gravity(windows, found.icr))
    scoring = ~windows.fitting
    pairs = {"level": (found.level, found.baseline), "slope": (found.fitted, sloped)}
    predictions = (found.nominal, found.baseline, sloped, found.level, found.fitted)
    return {
        "windows": {"fitted_to": int(windows.fitting.sum()), "scored": int(scoring.sum())},
        "scores": {one.name: one.score(scoring).rounded() for one in predictions},
        "better": {name: _gains(*pair, scoring) for name, pair in pairs.items()},
    }


def _gains(ours: Prediction, base: Prediction, scoring: NDArray[np.bool_]) -> dict[str, list[float]]:
    """Share by which our median error is below the baseline's, and its 90 % interval, of position and yaw."""
    rng, groups = np.random.default_rng(0), ours.windows.groups
    members = [np.flatnonzero(scoring & (groups == g)) for g in np.unique(groups[scoring])]
    drawn = [np.concatenate([members[k] for k in rng.integers(len(members), size=len(members))]) for _ in range(2000)]
    out = {}
    for name, mine, theirs in zip(("position", "yaw"), ours.errors, base.errors, strict=True):
        gain = [1.0 - np.median(mine[rows]) / np.median(theirs[rows]) for rows in (np.flatnonzero(scoring), *drawn)]
        out[name] = [round(float(g), 3) for g in (gain[0], *np.quantile(gain[1:], [0.05, 0.95]))]
    return out


def print_last_third(figures: dict[str, Any]) -> None:
    print(f"fitted to {figures['windows']['fitted_to']} windows, scored on the last {figures['windows']['scored']}")
    for name, score in figures["scores"].items():
        tail = f"90th percentile {score['position_m_p90']:.3f} m {score['yaw_deg_p90']:.1f}°"
        print(f"{name:30} {score['position_m']:.3f} m {score['yaw_deg']:6.2f}°   {tail}")
    for name, gains in figures["better"].items():
        for what, (gain, low, high) in gains.items():
            print(f"better than ICR, both with {name}: {what} {gain:.0%} ({low:.0%} to {high:.0%})")


# ---- targets


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
    parser.add_argument("--last-third", action="store_true", help="score the last third of the log on grass only")
    options = parser.parse_args()
    if options.last_third:
        figures = last_third(options.data)
        print_last_third(figures)
        return save(options.json, figures, options.replace_record)
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
