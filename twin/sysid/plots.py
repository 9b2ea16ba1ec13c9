"""Plots of a system identification: end poses, track ratios, wheel speeds and error distributions."""

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
_SHOWN = 3  # windows in the plot of wheel speeds


def write_plots(folder: Path, windows: Windows, fitted: Prediction, baseline: Prediction) -> list[Path]:
    """Writes four PNGs of the windows for scoring and returns their paths."""
    figures = {
        "ends.png": _plot_ends(windows, fitted, baseline),
        "turning.png": _plot_turning(windows, fitted),
        "wheels.png": _plot_wheels(windows, fitted),
        "errors.png": _plot_errors(windows, fitted, baseline),
    }
    paths = []
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)
        plt.close(figure)
        paths.append(folder / name)
    return paths


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


def track_ratios(wheels: Array, ends: Array, elapsed: Array) -> Array:
    """Track ratio chi of each window: effective track over geometric track, shape (n,).

    Args:
        wheels: Wheel speeds, left and right [rad/s], shape (n, k, 2).
        ends: Poses at the end x, y [m], yaw [rad], shape (n, 3).
        elapsed: Durations [s], shape (n,).
    """
    difference = (wheels[..., 1] - wheels[..., 0]).mean(1) * WHEEL_RADIUS
    turned = np.where(np.abs(ends[:, 2]) < 1e-6, np.nan, ends[:, 2])
    return difference * elapsed / (TRACK * turned)


def steady_windows(windows: Windows) -> NDArray[np.bool_]:
    """Windows whose sides turn at different and constant speeds, so that chi is defined, shape (n,)."""
    sides = windows.wheels * WHEEL_RADIUS
    thirds = np.stack([part.mean(1) for part in np.array_split(sides, 3, axis=1)])
    constant = np.ptp(thirds, axis=0).max(1) < 0.08
    return constant & (np.abs((sides[..., 1] - sides[..., 0]).mean(1)) > _MIN_DIFFERENCE)


def _plot_turning(windows: Windows, fitted: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained", sharey=True)
    use = steady_windows(windows)
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
        axis.axhline(point, color=_OTHER, linewidth=0.8, label=f"Coulomb friction, centered mass: {point:.2f}")
        axis.set(xlabel=name, ylim=(1.0, 4.0))
    axes[0].set_ylabel("track ratio chi")
    axes[1].legend(frameon=False)
    figure.suptitle("Wheel speed difference relative to a differential drive; windows of steady speed")
    return figure


def _plot_wheels(windows: Windows, fitted: Prediction) -> plt.Figure:
    score = np.flatnonzero(~windows.fitting)
    change = np.ptp(windows.wheels[score], axis=1).sum(1)
    # Windows with large changes of speed, spread over the log.
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
    figure.suptitle("Wheel speeds after a change of command, held-out windows")
    return figure


def _plot_errors(windows: Windows, fitted: Prediction, baseline: Prediction) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    score = ~windows.fitting
    for prediction, color in ((baseline, _OTHER), (fitted, _MODEL)):
        _plot_distribution(axes[0], prediction.distance[score], color, prediction.name)
        _plot_distribution(axes[1], prediction.angle[score], color, prediction.name)
    axes[0].set(xlabel="position error [m]", ylabel="fraction of windows below", xlim=(0, 0.8))
    axes[1].set(xlabel="yaw error [°]", xlim=(0, 60))
    axes[0].legend(frameon=False, loc="lower right")
    figure.suptitle(f"Errors after {DURATION:.0f} s, held-out windows; thin lines: median and 90th percentile")
    return figure


def _plot_distribution(axis: Axes, values: Array, color: str, name: str) -> None:
    axis.plot(np.sort(values), np.linspace(0, 1, len(values)), color=color, label=name)
    for share in (0.5, 0.9):
        axis.axvline(float(np.quantile(values, share)), color=color, linewidth=0.6)
    axis.set_ylim(0, 1)
