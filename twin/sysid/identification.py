"""Runs the system identification of a robot from a log, and writes the text of `robot.toml`.

`drivetrain.py` fits limits, latency and lag of the motors; `tires.py` fits friction, center of mass, wheel radii and
servo gain; `estimation.py` is the estimator.

`robot.toml` keeps its previous fields and gets a line with value and standard error for each identified field. Fields
that it lacks have their published values or those of `scene.toml`. `align.json` has all numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from twin.files import toml_value
from twin.robot import HuskyParams
from twin.sysid import rollout, tires
from twin.sysid.drivetrain import Drivetrain, fit_drivetrain
from twin.sysid.estimation import Fit
from twin.sysid.kinematics import NOMINAL, IcrModel, Prediction, fit_icr, predict, steady_windows, track_ratios
from twin.sysid.logs import Windows
from twin.types import Array

_DRIVE_FIELDS = {  # field of HuskyParams → parameter of the drivetrain, to which it is proportional
    "separation_multiplier": "half_gain",
    "max_speed": "mean_limit",
    "max_yaw_rate": "half_limit",
    "max_wheel_speed": "wheel_limit",
    "command_latency": "latency",
    "max_acceleration": "mean_acceleration",
    "max_yaw_acceleration": "half_acceleration",
    "servo_lag": "lag",
}
_GROUND_FIELDS = {  # field of HuskyParams → parameters of `tires`
    "friction": ("friction",),
    "spin_friction": ("spin_friction",),
    "rolling_resistance": ("rolling_resistance",),
    "slip_stiffness": ("creep",),
    "ground_viscosity": ("ground_viscosity",),
    "center_of_mass": ("center_of_mass_x", "center_of_mass_y", "center_of_mass_z"),
    "wheel_radius": ("radius_left", "radius_right"),
    "servo_gain": ("log10_servo_gain",),
}
_DIGITS = 6  # significant digits of numbers in robot.toml
_NO_TWIST = "the log's commands are wheel speeds, which bypass the controller's own multiplier; needs v and ω"


@dataclass(frozen=True)
class Identification:
    """A robot identified from a log, with predictions of the log."""

    windows: Windows
    icr: IcrModel
    drivetrain: Drivetrain
    drive_fit: Fit
    ground_fit: Fit
    robot: HuskyParams
    nominal: Prediction
    baseline: Prediction
    fitted: Prediction
    level: Prediction
    """Prediction of the fitted model on level ground."""

    @property
    def identified(self) -> dict[str, tuple[float | tuple[float, ...], float | tuple[float | None, ...]]]:
        """Identified fields of HuskyParams: value and standard error, each a number or a tuple.

        Errors of `max_yaw_rate` and `max_yaw_acceleration` take the fitted separation multiplier as exact. The error of
        a component that is not identified is None.
        """
        out: dict[str, tuple[Any, Any]] = {}
        twist = self.windows.twist
        here = self.drivetrain.robot_fields(self.robot, twist)
        for field in _identified_drive_fields(self.drive_fit, twist):
            name = _DRIVE_FIELDS[field]
            off = replace(self.drivetrain, **{name: getattr(self.drivetrain, name) + self.drive_fit.errors[name]})
            out[field] = getattr(self.robot, field), abs(off.robot_fields(self.robot, twist)[field] - here[field])
        for field, names in _GROUND_FIELDS.items():
            errors: list[Any] = [self.ground_fit.errors.get(name) for name in names]
            if all(error is None for error in errors):
                continue
            value = getattr(self.robot, field)
            if names[0].startswith("log10_"):
                errors = [errors[0] * np.log(10) * value]
            elif field == "slip_stiffness":  # the fitted parameter is its inverse
                errors = [errors[0] * value**2]
            out[field] = (value, tuple(errors)) if isinstance(value, tuple) else (value, errors[0])
        return out

    @property
    def refused(self) -> list[str]:
        """A line per parameter that the log does not identify."""
        lines = [*self.drive_fit.refused.values(), *self.ground_fit.refused.values()]
        if not self.windows.twist:
            lines.append(f"separation_multiplier = {self.robot.separation_multiplier:g}: {_NO_TWIST}")
        return lines

    def figures(self) -> dict[str, Any]:
        """All numbers, for JSON."""
        windows = self.windows
        fitting, scoring = windows.fitting, ~windows.fitting
        predictions = {
            "nominal_kinematics": self.nominal,
            "icr_kinematics": self.baseline,
            "fitted": self.fitted,
            "fitted_on_level_ground": self.level,
        }
        steady = steady_windows(windows)
        ends = {"measured": windows.poses[:, -1], "fitted": self.fitted.ends}
        slope = rollout.slope_gravity(windows, self.icr)
        scores = {
            name: {"fitted_to": p.score(fitting).rounded(), "held_out": p.score(scoring).rounded()}
            for name, p in predictions.items()
        }
        fitted, baseline = self.fitted.score(scoring), self.baseline.score(scoring)
        return {
            "windows": {"fitted_to": int(fitting.sum()), "held_out": int(scoring.sum())},
            "scores": scores,
            "better_than_icr": {
                "position": round(1 - fitted.position_m / baseline.position_m, 4),
                "yaw": round(1 - fitted.yaw_deg / baseline.yaw_deg, 4),
            },
            "track_ratio": {name: _quantiles(track_ratios(windows, end)[steady]) for name, end in ends.items()},
            "slope_deg": _quantiles(np.degrees(np.hypot(*slope.T) / rollout.GRAVITY)),
            "robot": {
                name: {"value": _plain(value), "standard_error": _plain(error)}
                for name, (value, error) in self.identified.items()
            },
            "log": {
                "mean_gain": round(self.drivetrain.mean_gain, 4),
                "half_gain": round(self.drivetrain.half_gain, 4),
                "pose_x_m": round(self.ground_fit.values["pose_x"], 4),
                "pose_y_m": round(self.ground_fit.values["pose_y"], 4),
                "pose_late_s": round(self.ground_fit.values["pose_late"], 4),
            },
            "refused": self.refused,
        }


def _identified_drive_fields(fit: Fit, twist: bool) -> list[str]:
    """Fields that the drivetrain's fit identifies: without `twist`, not the multiplier, which wheel commands bypass."""
    return [
        field
        for field, name in _DRIVE_FIELDS.items()
        if name in fit.errors and (twist or field != "separation_multiplier")
    ]


def identify(windows: Windows, params: HuskyParams, progress: Callable[[str], None] = lambda _: None) -> Identification:
    """Fits baseline, drivetrain, tires and ground to the windows for fitting, then predicts every window.

    Without accelerations, the ground counts as level.
    """
    icr = fit_icr(windows)
    progress("commands and wheel speeds")
    drivetrain, drive_fit = fit_drivetrain(windows, params)
    slope = rollout.slope_gravity(windows, icr)
    ground_fit = tires.fit_ground(params, drivetrain, windows, slope, progress)
    fields = drivetrain.robot_fields(params, windows.twist)
    identified: dict[str, Any] = {f: fields[f] for f in _identified_drive_fields(drive_fit, windows.twist)}
    robot = replace(tires.robot_with_values(params, ground_fit.values), **identified)
    progress("predicting every window")

    def prediction(name: str, gravity: Array) -> Prediction:
        out = tires.simulate_log(params, ground_fit.values, drivetrain, windows, gravity)
        return Prediction(name, windows, out.poses, out.wheels)

    fitted = prediction("fitted MJCF", slope)
    return Identification(
        windows,
        icr,
        drivetrain,
        drive_fit,
        ground_fit,
        robot,
        Prediction("nominal kinematics", windows, predict(NOMINAL, windows)),
        Prediction("ICR kinematics", windows, predict(icr, windows)),
        fitted,
        prediction("fitted, level ground", np.zeros_like(slope)) if np.any(slope) else fitted,
    )


def robot_toml(identification: Identification, previous: dict[str, Any], log: str) -> str:
    """The text of a `robot.toml`: the previous fields that were not identified, then the identified ones."""
    scoring = int((~identification.windows.fitting).sum())
    score = identification.fitted.score(~identification.windows.fitting)
    comment = (
        f"Fitted to {Path(log).name} by twin align; median error after 2 s on {scoring} held-out windows: "
        f"{score.position_m:.3f} m, {score.yaw_deg:.1f}°."
    )
    return toml_text(comment, previous, identification.identified)


def toml_text(comment: str, previous: dict[str, Any], identified: dict[str, tuple[Any, Any]]) -> str:
    """The text of a `robot.toml`.

    Args:
        comment: The first line; unprintable characters are replaced.
        previous: Fields of the previous file, kept unless identified.
        identified: Value and standard error (or None) of identified fields.
    """
    lines = ["# " + "".join(c if c.isprintable() else "?" for c in comment)]
    if not identified:
        lines.append("# Nothing could be identified from this log; the fields below are those of the previous file.")
    lines += [f"{name} = {toml_value(value, _DIGITS)}" for name, value in previous.items() if name not in identified]
    for name, (value, error) in identified.items():
        lines.append(
            f"{name} = {toml_value(value, _DIGITS)}" + ("" if error is None else f"  # ± {format_error(error)}")
        )
    return "\n".join(lines) + "\n"


def format_error(error: float | tuple[float | None, ...]) -> str:
    """A standard error, or those of a tuple's components."""
    each = error if isinstance(error, tuple) else (error,)
    return ", ".join("not fitted" if e is None else f"{e:.2g}" for e in each)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return None if value is None else float(f"{value:.6g}")


def _quantiles(values: Array) -> dict[str, float] | None:
    """10th, 50th and 90th percentile; None without values."""
    if not len(values):
        return None
    return {f"p{q}": round(float(np.nanquantile(values, q / 100)), 3) for q in (10, 50, 90)}
