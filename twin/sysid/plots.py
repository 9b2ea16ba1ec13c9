"""Pictures of an alignment: where windows end, how hard turning is, how wheels follow, how errors spread."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from twin.mjcf.husky import coulomb_track_ratio
from twin.robot import TRACK, WHEEL_RADIUS
from twin.sysid.kinematics import Prediction
from twin.sysid.logs import DURATION, PERIOD, Windows
from twin.types import Array

_MEASURED, _MODEL, _OTHER = "#444444", "#d1495b", "#3d7ea6"
_MIN_DIFFERENCE = 0.25  # [m/s] of the sides; below it the track ratio is noise
_SHOWN = 3  # windows of wheel speeds


def draw(folder: Path, windows: Windows, fitted: Prediction, baseline: Prediction) -> list[Path]:
    """Four PNGs of the windows that were scored on: ends, turning, wheels, errors. Returns their paths."""
    figures = {
        "ends.png": _ends(windows, fitted, baseline),
        "turning.png": _turning(windows, fitted),
        "wheels.png": _wheels(windows, fitted),
        "errors.png": _errors(windows, fitted, baseline),
    }
    paths = []
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)
        plt.close(figure)
        paths.append(folder / name)
    return paths


def _ends(windows: Windows, fitted: Prediction, baseline: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
    score = ~windows.fitting
    for i, (axis, name) in enumerate(zip(axes, ("forward [m]", "left [m]", "turned [°]"), strict=True)):
        unit = 180 / np.pi if i == 2 else 1.0
        measured = windows.poses[score, -1, i] * unit
        for prediction, colour, size in ((baseline, _OTHER, 7), (fitted, _MODEL, 9)):
            axis.scatter(measured, prediction.ends[score, i] * unit, s=size, color=colour, label=prediction.name)
        low, high = np.quantile(measured, [0.0, 1.0])
        axis.plot([low, high], [low, high], color=_MEASURED, linewidth=0.8)
        axis.set(title=name, xlabel="measured", ylabel="predicted" if i == 0 else "")
    axes[0].legend(frameon=False)
    figure.suptitle(f"Where the robot is after {DURATION:.0f} s, windows not fitted to")
    return figure


def track_ratios(wheels: Array, ends: Array, elapsed: Array) -> Array:
    """chi of each window [-], shape (n,), from mean wheel speeds [rad/s], turns [rad] and how long they took [s]."""
    difference = (wheels[..., 1] - wheels[..., 0]).mean(1) * WHEEL_RADIUS
    turned = np.where(np.abs(ends[:, 2]) < 1e-6, np.nan, ends[:, 2])
    return difference * elapsed / (TRACK * turned)


def steady(windows: Windows) -> NDArray[np.bool_]:
    """Windows whose wheels turn at different and constant speeds, so that chi means something. Shape (n,)."""
    sides = windows.wheels * WHEEL_RADIUS
    thirds = np.stack([part.mean(1) for part in np.array_split(sides, 3, axis=1)])
    constant = np.ptp(thirds, axis=0).max(1) < 0.08
    return constant & (np.abs((sides[..., 1] - sides[..., 0]).mean(1)) > _MIN_DIFFERENCE)


def _turning(windows: Windows, fitted: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained", sharey=True)
    use = steady(windows)
    sides = windows.wheels[use].mean(1) * WHEEL_RADIUS
    real = track_ratios(windows.wheels[use], windows.poses[use, -1], windows.elapsed[use, -1])
    ours = track_ratios(windows.wheels[use], fitted.ends[use], windows.elapsed[use, -1])
    for axis, x, name in (
        (axes[0], np.abs(sides[:, 1] - sides[:, 0]), "difference of the sides' speeds [m/s]"),
        (axes[1], sides.mean(1), "mean of the sides' speeds [m/s]"),
    ):
        axis.scatter(x, real, s=9, color=_MEASURED, label="measured")
        axis.scatter(x, ours, s=9, color=_MODEL, label=fitted.name)
        point = coulomb_track_ratio(np.zeros(2))
        axis.axhline(point, color=_OTHER, linewidth=0.8, label=f"Coulomb friction, centred mass: {point:.2f}")
        axis.set(xlabel=name, ylim=(1.0, 4.0))
    axes[0].set_ylabel("track ratio chi")
    axes[1].legend(frameon=False)
    figure.suptitle("How much faster wheels must turn than a differential drive's; windows of steady speed")
    return figure


def _wheels(windows: Windows, fitted: Prediction) -> plt.Figure:
    score = np.flatnonzero(~windows.fitting)
    change = np.ptp(windows.wheels[score], axis=1).sum(1)
    # Some of the liveliest windows, spread over the log rather than the very liveliest.
    lively = score[change >= np.quantile(change, 0.7)]
    chosen = lively[np.linspace(0, len(lively) - 1, min(_SHOWN, len(lively))).astype(int)]
    figure, axes = plt.subplots(1, len(chosen), figsize=(12, 3.8), layout="constrained", sharey=True, squeeze=False)
    time = np.arange(windows.wheels.shape[1]) * PERIOD
    for axis, i in zip(axes[0], chosen, strict=True):
        for side, colour, name in ((0, _OTHER, "left"), (1, _MODEL, "right")):
            axis.plot(time, windows.wheels[i, :, side], ".", markersize=3, color=colour, label=f"{name}, measured")
            axis.plot(time, fitted.wheels[i, :, side], color=colour, linewidth=1.2, label=f"{name}, {fitted.name}")
        axis.set(title=f"window {i}", xlabel="time [s]")
    axes[0, 0].set_ylabel("wheel speed [rad/s]")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.suptitle("Wheels after a change of command, windows not fitted to")
    return figure


def _errors(windows: Windows, fitted: Prediction, baseline: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    score = ~windows.fitting
    for prediction, colour in ((baseline, _OTHER), (fitted, _MODEL)):
        _spread(axes[0], prediction.distance[score], colour, prediction.name)
        _spread(axes[1], prediction.angle[score], colour, prediction.name)
    axes[0].set(xlabel="error of position [m]", ylabel="share of windows below", xlim=(0, 0.8))
    axes[1].set(xlabel="error of yaw [°]", xlim=(0, 60))
    axes[0].legend(frameon=False, loc="lower right")
    figure.suptitle(f"Errors after {DURATION:.0f} s, windows not fitted to; thin lines: median and 90th percentile")
    return figure


def _spread(axis: Axes, values: Array, colour: str, name: str) -> None:
    axis.plot(np.sort(values), np.linspace(0, 1, len(values)), color=colour, label=name)
    for share in (0.5, 0.9):
        axis.axvline(float(np.quantile(values, share)), color=colour, linewidth=0.6)
    axis.set_ylim(0, 1)
