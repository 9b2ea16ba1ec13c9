"""Plots of a system identification: end poses, track ratios, wheel speeds and error distributions."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from twin.mjcf.husky import coulomb_track_ratio
from twin.robot import WHEEL_RADIUS
from twin.sysid.kinematics import Prediction, steady_windows, track_ratios
from twin.sysid.logs import DURATION, PERIOD, Windows
from twin.types import Array

_MEASURED, _MODEL, _OTHER = "#444444", "#d1495b", "#3d7ea6"
_SHOWN = 3  # largest number of windows in the plot of wheel speeds


def write_plots(folder: Path, windows: Windows, fitted: Prediction, baseline: Prediction) -> list[Path]:
    """Writes four PNGs and returns their paths.

    They show the held-out windows; the plot of track ratios shows all windows of steady speed.
    """
    figures = {
        folder / "ends.png": _plot_ends(windows, fitted, baseline),
        folder / "turning.png": _plot_turning(windows, fitted),
        folder / "wheels.png": _plot_wheels(windows, fitted),
        folder / "errors.png": _plot_errors(windows, fitted, baseline),
    }
    for path, figure in figures.items():
        figure.savefig(path, dpi=110)
        plt.close(figure)
    return list(figures)


def _plot_ends(windows: Windows, fitted: Prediction, baseline: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
    score = ~windows.fitting
    for i, (axis, name) in enumerate(zip(axes, ("forward [m]", "left [m]", "yaw [°]"), strict=True)):
        unit = 180 / np.pi if i == 2 else 1.0
        measured = windows.poses[score, -1, i] * unit
        for prediction, color, size in ((baseline, _OTHER, 7), (fitted, _MODEL, 9)):
            axis.scatter(measured, prediction.ends[score, i] * unit, s=size, color=color, label=prediction.name)
        low, high = np.quantile(measured, [0.0, 1.0])
        axis.plot([low, high], [low, high], color=_MEASURED, linewidth=0.8)
        axis.set(title=name, xlabel="measured", ylabel="predicted" if i == 0 else "")
    axes[0].legend(frameon=False)
    figure.suptitle(f"End pose after {DURATION:.0f} s, held-out windows")
    return figure


def _plot_turning(windows: Windows, fitted: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained", sharey=True)
    use = steady_windows(windows)
    sides = windows.wheels[use].mean(1) * WHEEL_RADIUS
    real, ours = (track_ratios(windows, ends)[use] for ends in (windows.poses[:, -1], fitted.ends))
    for axis, x, name in (
        (axes[0], np.abs(sides[:, 1] - sides[:, 0]), "difference of the sides' speeds [m/s]"),
        (axes[1], sides.mean(1), "mean of the sides' speeds [m/s]"),
    ):
        axis.scatter(x, real, s=9, color=_MEASURED, label="measured")
        axis.scatter(x, ours, s=9, color=_MODEL, label=fitted.name)
        point = coulomb_track_ratio(np.zeros(2))
        axis.axhline(point, color=_OTHER, linewidth=0.8, label=f"Coulomb friction, centered mass: {point:.2f}")
        axis.set(xlabel=name, ylim=(1.0, 4.0))
    axes[0].set_ylabel("track ratio χ")
    axes[1].legend(frameon=False)
    figure.suptitle(
        "Track ratio χ: speed difference of the sides / that without slip for the same yaw rate; steady windows"
    )
    return figure


def _plot_wheels(windows: Windows, fitted: Prediction) -> plt.Figure:
    score = np.flatnonzero(~windows.fitting)
    change = np.ptp(windows.wheels[score], axis=1).sum(1)
    # Some windows with large changes of speed, spread over the log.
    changing = score[change >= np.quantile(change, 0.7)]
    chosen = changing[np.linspace(0, len(changing) - 1, min(_SHOWN, len(changing))).astype(int)]
    figure, axes = plt.subplots(1, len(chosen), figsize=(12, 3.8), layout="constrained", sharey=True, squeeze=False)
    time = np.arange(windows.wheels.shape[1]) * PERIOD
    for axis, i in zip(axes[0], chosen, strict=True):
        for side, color, name in ((0, _OTHER, "left"), (1, _MODEL, "right")):
            axis.plot(time, windows.wheels[i, :, side], ".", markersize=3, color=color, label=f"{name}, measured")
            axis.plot(time, fitted.wheels[i, :, side], color=color, linewidth=1.2, label=f"{name}, {fitted.name}")
        axis.set(title=f"window {i}", xlabel="time [s]")
    axes[0, 0].set_ylabel("wheel speed [rad/s]")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.suptitle("Wheel speeds in held-out windows with large changes")
    return figure


def _plot_errors(windows: Windows, fitted: Prediction, baseline: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    score = ~windows.fitting
    for prediction, color in ((baseline, _OTHER), (fitted, _MODEL)):
        for axis, values in zip(axes, prediction.errors, strict=True):
            _plot_distribution(axis, values[score], color, prediction.name)
    axes[0].set(xlabel="position error [m]", ylabel="fraction of windows with a smaller error", xlim=(0, 0.8))
    axes[1].set(xlabel="yaw error [°]", xlim=(0, 60))
    axes[0].legend(frameon=False, loc="lower right")
    figure.suptitle(f"Errors after {DURATION:.0f} s, held-out windows; thin lines: median and 90th percentile")
    return figure


def _plot_distribution(axis: Axes, values: Array, color: str, name: str) -> None:
    axis.plot(np.sort(values), np.linspace(0, 1, len(values)), color=color, label=name)
    for share in (0.5, 0.9):
        axis.axvline(float(np.quantile(values, share)), color=color, linewidth=0.6)
    axis.set_ylim(0, 1)
