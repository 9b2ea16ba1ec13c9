"""The whole alignment of a robot to a log, and what is written of it.

`robot.toml` gets what the log identified, one line each with its standard error, beside what stood there before; the
rest of the robot stays as published or as `scene.toml` says. `align.json` has every figure.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from twin.files import toml_string
from twin.robot import HuskyParams
from twin.sysid import rollout, tires
from twin.sysid.drivetrain import Drivetrain, fit_drive
from twin.sysid.estimation import Fit
from twin.sysid.kinematics import NOMINAL, Icr, Prediction, fit_icr, predict
from twin.sysid.logs import Windows, without_acceleration
from twin.sysid.plots import steady, track_ratios
from twin.types import Array

_DRIVE_FIELDS = {  # a field of HuskyParams → what of the drive shows it
    "separation_multiplier": ("half_gain",),
    "max_yaw_rate": ("half_limit",),
    "max_wheel_speed": ("wheel_limit",),
    "command_latency": ("latency",),
    "max_acceleration": ("mean_acceleration",),
    "max_yaw_acceleration": ("half_acceleration",),
    "servo_lag": ("lag",),
}
_GROUND_FIELDS = {
    "friction": ("friction",),
    "spin_friction": ("spin_friction",),
    "rolling_resistance": ("rolling_resistance",),
    "slip_stiffness": ("creep",),
    "ground_viscosity": ("ground_viscosity",),
    "center_of_mass": ("center_of_mass_x", "center_of_mass_y", "center_of_mass_z"),
    "wheel_radius": ("radius_left", "radius_right"),
    "servo_gain": ("log10_servo_gain",),
}
_UNSEEN = "the log's commands are wheel speeds, so it never meets the controller's own multiplier; needs v and ω"


@dataclass(frozen=True)
class Alignment:
    """What a log says of a robot."""

    windows: Windows
    icr: Icr
    drive: Drivetrain
    drive_fit: Fit
    ground_fit: Fit
    robot: HuskyParams
    """With everything the log identified in place."""
    nominal: Prediction
    baseline: Prediction
    fitted: Prediction
    level: Prediction
    """As fitted, the ground taken for level."""

    @property
    def identified(self) -> dict[str, tuple[float | tuple[float, ...], float | tuple[float | None, ...]]]:
        """Fields of HuskyParams that the log identified: value and standard error, a number each or as many.

        Errors of yaw rate and acceleration are those at the separation multiplier found; of a vector's components
        those that were not fitted have None.
        """
        out: dict[str, tuple[Any, Any]] = {}
        twist = self.windows.twist
        here = self.drive.robot(self.robot, twist)
        for field, (name,) in _DRIVE_FIELDS.items():
            if name in self.drive_fit.errors and (twist or field != "separation_multiplier"):
                # Every field is in proportion to what shows it.
                off = replace(self.drive, **{name: getattr(self.drive, name) + self.drive_fit.errors[name]})
                out[field] = getattr(self.robot, field), abs(off.robot(self.robot, twist)[field] - here[field])
        for field, names in _GROUND_FIELDS.items():
            errors: list[Any] = [self.ground_fit.errors.get(name) for name in names]
            if all(error is None for error in errors):
                continue
            value = getattr(self.robot, field)
            if names[0].startswith("log10_"):
                errors = [errors[0] * np.log(10) * value]
            elif field == "slip_stiffness":  # the inverse of what was fitted
                errors = [errors[0] * value**2]
            out[field] = (value, tuple(errors)) if isinstance(value, tuple) else (value, errors[0])
        return out

    @property
    def refused(self) -> list[str]:
        """One line per parameter that the log does not show."""
        lines = [*self.drive_fit.refused.values(), *self.ground_fit.refused.values()]
        if not self.windows.twist:
            lines.append(f"separation_multiplier = {self.robot.separation_multiplier:g}: {_UNSEEN}")
        return lines

    def figures(self) -> dict[str, Any]:
        """Every figure, for JSON."""
        windows = self.windows
        fitting, scoring = windows.fitting, ~windows.fitting
        predictions = {
            "nominal_kinematics": self.nominal,
            "icr_kinematics": self.baseline,
            "fitted": self.fitted,
            "fitted_on_level_ground": self.level,
        }
        use = steady(windows)
        real = track_ratios(windows.wheels, windows.poses[:, -1], windows.elapsed[:, -1])[use]
        ours = track_ratios(windows.wheels, self.fitted.ends, windows.elapsed[:, -1])[use]
        scores = {
            name: {"fitted_to": p.score(fitting).told(), "held_out": p.score(scoring).told()}
            for name, p in predictions.items()
        }
        ours_held, theirs = self.fitted.score(scoring), self.baseline.score(scoring)
        return {
            "windows": {"fitted_to": int(fitting.sum()), "held_out": int(scoring.sum())},
            "scores": scores,
            "better_than_icr": {
                "position": round(1 - ours_held.position_m / theirs.position_m, 4),
                "yaw": round(1 - ours_held.yaw_deg / theirs.yaw_deg, 4),
            },
            "track_ratio": {"measured": _quantiles(real), "fitted": _quantiles(ours)},
            "slope_deg": _quantiles(np.degrees(np.hypot(*self.slope.T) / rollout.GRAVITY)),
            "robot": {
                name: {"value": _plain(value), "standard_error": _plain(error)}
                for name, (value, error) in self.identified.items()
            },
            "log": {
                "mean_gain": round(self.drive.mean_gain, 4),
                "half_gain": round(self.drive.half_gain, 4),
                "pose_x_m": round(self.ground_fit.values["pose_x"], 4),
                "pose_y_m": round(self.ground_fit.values["pose_y"], 4),
                "pose_late_s": round(self.ground_fit.values["pose_late"], 4),
            },
            "refused": self.refused,
        }

    @property
    def slope(self) -> Array:
        """Gravity along x and y [m/s²], shape (n, 2); see `slope.gravity`."""
        return rollout.gravity(self.windows, self.icr)


def align(
    windows: Windows,
    params: HuskyParams,
    use_slope: bool = True,
    progress: Callable[[str], None] = lambda _: None,
) -> Alignment:
    """Fits baseline, drive, tyres and ground to the even groups of a log that `checks.check` let pass, and predicts all
    of it."""
    if not use_slope:
        windows = without_acceleration(windows)
    icr = fit_icr(windows)
    progress("commands and wheel speeds")
    drive, drive_fit = fit_drive(windows, params)
    tilt = rollout.gravity(windows, icr)
    ground_fit = tires.fit_ground(params, drive, windows, tilt, progress)
    robot = tires.robot(params, ground_fit.values)
    seen: dict[str, Any] = {
        field: value
        for field, value in drive.robot(params, windows.twist).items()
        if _DRIVE_FIELDS[field][0] in drive_fit.errors and (windows.twist or field != "separation_multiplier")
    }
    robot = replace(robot, **seen)
    progress("predicting every window")

    def prediction(name: str, under: Array) -> Prediction:
        out = tires.simulated(params, ground_fit.values, drive, windows, under)
        return Prediction(name, windows, out.poses, out.wheels)

    fitted = prediction("fitted MJCF", tilt)
    return Alignment(
        windows,
        icr,
        drive,
        drive_fit,
        ground_fit,
        robot,
        Prediction("nominal kinematics", windows, predict(NOMINAL, windows)),
        Prediction("ICR kinematics", windows, predict(icr, windows)),
        fitted,
        prediction("fitted, level ground", np.zeros_like(tilt)) if np.any(tilt) else fitted,
    )


def robot_toml(alignment: Alignment, kept: dict[str, Any], log: str) -> str:
    """The text of a `robot.toml`: what was identified, after what stood there before and still holds."""
    scoring = int((~alignment.windows.fitting).sum())
    ours = alignment.fitted.score(~alignment.windows.fitting)
    told = (
        f"Fitted to {Path(log).name} by python -m twin.align; on {scoring} windows it was not fitted to the robot is "
        f"off by {ours.position_m:.3f} m and {ours.yaw_deg:.1f}° after 2 s (median)."
    )
    return toml_text(told, kept, alignment.identified)


def toml_text(told: str, kept: dict[str, Any], identified: dict[str, tuple[Any, Any]]) -> str:
    """The text of a `robot.toml`.

    Args:
        told: How it came about; is made one line that TOML takes.
        kept: What stood there before.
        identified: What goes before that: value and standard error, None where there is none.
    """
    lines = [
        "# " + "".join(c if c.isprintable() else "?" for c in told),
        *([] if identified else ["# But nothing in it could be identified: what follows stood here before."]),
        *(f"{name} = {_toml(value)}" for name, value in kept.items() if name not in identified),
        *(
            f"{name} = {_toml(value)}" + ("" if error is None else f"  # ± {told_error(error)}")
            for name, (value, error) in identified.items()
        ),
    ]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, int):
        return str(value)
    text = f"{value:.6g}"
    return text if any(c in text for c in ".einf") else text + ".0"


def told_error(error: float | tuple[float | None, ...]) -> str:
    """A standard error in words."""
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
