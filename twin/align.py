"""`twin align`: fits the Husky's parameters to a drive log, or its front camera to a film by that camera.

    twin align scenes/demo drive.csv
    twin align scenes/my_road drive.mcap [--camera]
    twin align husky drive.npz --out aligned

System identification fits the controller's limits and latency, the servo's lag, tires, ground, center of mass and
effective wheel radii to half of the log. The other half is held out to score this fit, and a kinematic model
that is fitted to the same data. Results are `robot.toml`, which the scene's next build uses, and `alignment/` with
`align.json` and four figures. Parameters that the log does not determine keep their values.

A film by the robot's front camera in the built place determines the camera's extrinsics (height, yaw, pitch, roll) and,
unless `[robot] camera_intrinsics` is given, its focal length. `alignment/camera.png` shows the film beside the twin's
images. A ROS bag serves as a log or, with --camera, as a film.
"""

import argparse
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin import commands, runtime
from twin.capture.bag import is_bag
from twin.config_file import ROBOT_TOML, load_config, merge_robot, parse_table, read_robot
from twin.errors import InputError
from twin.files import digest_file, is_file, read_toml, require_writable, write_json, write_text
from twin.mjcf.husky import coulomb_track_ratio
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.scene import SceneDir
from twin.sysid.identification import Identification, format_error, identify, robot_toml, toml_text
from twin.sysid.kinematics import Prediction, steady_windows, track_ratios
from twin.sysid.log_files import filmed_poses, read_bag, read_log
from twin.sysid.logs import DURATION, PERIOD, Windows, check_log, cut_windows
from twin.types import Array

if TYPE_CHECKING:
    from twin.sysid.camera_extrinsics import CameraCalibration

RESULT_FOLDER = "alignment"
"""Folder beside `robot.toml` for figures and numbers of the fit."""
PUBLISHED_ROBOT = "husky"
"""Name that stands, in place of a scene, for the robot with Clearpath's published parameters."""
_FILM_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
_INTRINSICS_FIELDS = ("camera_intrinsics", "camera_size")


def align_to_log(
    target: str, log: Path, out: Path | None = None, use_slope: bool = True, topic: str = ""
) -> tuple[Identification, Path]:
    """Fits a robot to a log; writes the results and returns their folder.

    Args:
        target: Folder of a scene, a `robot.toml`, or `PUBLISHED_ROBOT`.
        log: See `twin.sysid.logs`.
        out: Folder for the results; by default that of the scene or the `robot.toml`. The fit of the published robot
            starts from a `robot.toml` that is there.
        use_slope: Accounts for the ground's slope, which is estimated from the log's accelerations (if it has any).
        topic: Topic of a bag's poses; empty: the best one that does not come from the wheels.

    Raises:
        InputError: the robot is unknown, the folder is not writable, or the log is unusable.
    """
    if out and target == PUBLISHED_ROBOT and is_file(out / ROBOT_TOML):
        target = str(out / ROBOT_TOML)
        runtime.log_line(f"{target}: the fit starts from it, and keeps what the log does not determine")
    params, kept, folder = _robot(target)
    folder = out or folder
    if folder is None:
        raise InputError(f"{target}: the published robot has no folder for its robot.toml; give one with --out")
    windows = _windows(target, log, topic)
    if not use_slope:
        windows = replace(windows, acceleration=None)
    runtime.log_line(f"{log}: {len(windows)} time windows, {int(windows.fitting.sum())} to fit, the others held out")
    check_log(windows, str(log))
    pictures = folder / RESULT_FOLDER
    for one in (pictures, folder):
        require_writable(one, "give another folder with --out")
    result = identify(windows, params, runtime.log_line)

    write_plots(pictures, result.windows, result.fitted, result.baseline)
    figures = {"log": str(log), "log_sha256": digest_file(log) if log.is_file() else None} | result.figures()
    write_text(folder / ROBOT_TOML, robot_toml(result, kept, str(log)))
    write_json(pictures / "align.json", figures)
    return result, folder


def _windows(target: str, log: Path, topic: str) -> Windows:
    """The time windows of a log. If it is a bag that the scene was built from, reconstructed poses can be used."""
    if not is_bag(log):
        return read_log(log)

    scene = SceneDir(_scene_root(target))
    filmed = filmed_poses(scene, load_config(scene.config_file), log) if scene.config_file.exists() else None
    return cut_windows(read_bag(log, filmed, topic), str(log))


def align_camera(target: str, film: Path, topic: str = "") -> "tuple[CameraCalibration, Path]":
    """Fits the camera of a built scene's robot to a film or a bag; writes the results and returns their folder.

    Raises:
        InputError: the scene or film is unknown, the folder is not writable, or the film is unusable.
    """
    from twin.sysid.camera_extrinsics import calibrate_camera, write_camera_comparison

    root = _scene_root(target)
    scene = SceneDir(root)
    if not film.is_file() and not is_bag(film):
        raise InputError(f"{film}: no such film; expected a video, or a bag with pictures")
    if not scene.config_file.exists():
        raise InputError(f"{target}: a film needs a built scene to be localized in; give the scene's folder")
    by_hand = _scene_robot_table(root)
    params = load_config(scene.config_file).robot
    given = {name: by_hand[name] for name in _INTRINSICS_FIELDS if name in by_hand}
    lens = parse_table(HuskyParams, given, str(scene.config_file))
    # Intrinsics in robot.toml may come from an earlier film, which this film replaces.
    params = replace(params, camera_intrinsics=lens.camera_intrinsics, camera_size=lens.camera_size)
    result, frames = calibrate_camera(film, scene, params, topic)
    kept = {name: value for name, value in read_robot(root / ROBOT_TOML).items() if name not in _INTRINSICS_FIELDS}
    text = toml_text(f"The camera was fitted to {film.name}: {result.summary}.", kept, result.identified)
    robot = merge_robot(tomllib.loads(text), by_hand, str(scene.config_file))
    folder = root / RESULT_FOLDER
    require_writable(folder, "make it writable")
    write_camera_comparison(folder, result, frames, scene, parse_table(HuskyParams, robot, str(scene.config_file)))
    write_text(root / ROBOT_TOML, text)
    figures = {"film": str(film), "film_sha256": digest_file(film) if film.is_file() else None} | result.figures()
    write_json(folder / "camera.json", figures)
    return result, root


def _robot(target: str) -> tuple[HuskyParams, dict[str, Any], Path | None]:
    """The robot's initial parameters, the table of its robot.toml, and that file's folder; {} and None for `husky`."""
    if target == PUBLISHED_ROBOT:
        return HuskyParams(), {}, None
    path = Path(target)
    if path.name.endswith(".toml") and path.is_file() and path.name != "scene.toml":
        kept = read_robot(path)
        return parse_table(HuskyParams, kept, str(path)), kept, path.parent
    root = _scene_root(target)
    if not SceneDir(root).config_file.exists():
        raise InputError(f"{target}: no scene.toml there; give a scene's folder, a robot.toml, or `{PUBLISHED_ROBOT}`")
    return load_config(SceneDir(root).config_file).robot, read_robot(root / ROBOT_TOML), root


def _scene_root(target: str) -> Path:
    path = Path(target)
    return path.parent if path.name == "scene.toml" else path


def _scene_robot_table(folder: Path) -> dict[str, Any]:
    """`[robot]` of the `scene.toml` in a folder; empty if there is none."""
    path = SceneDir(folder).config_file
    return read_toml(path).get("robot", {}) if path.exists() else {}


def summary(result: Identification) -> str:
    scoring = ~result.windows.fitting
    rows = [f"{'errors after 2 s, held-out windows':36} {'median':>16} {'90th percentile':>18}  wheels"]
    for prediction in (result.nominal, result.baseline, result.level, result.fitted):
        s = prediction.score(scoring)
        wheels = f"{s.wheels_rad_s:.2f} rad/s" if prediction.wheels is not result.windows.wheels else "as measured"
        rows.append(
            f"{prediction.name:36} {s.position_m:7.3f} m {s.yaw_deg:5.1f}° {s.position_m_p90:8.3f} m "
            f"{s.yaw_deg_p90:6.1f}°  {wheels}"
        )
    rows.append("fitted:" if result.identified else "fitted: nothing, as the log determines no parameter")
    rows += _fitted(result.identified)
    if result.refused:
        rows += ["unchanged, as this log does not determine them:", *(f"  {line}" for line in result.refused)]
    return "\n".join(rows)


def _fitted(identified: dict[str, tuple[Any, Any]]) -> list[str]:
    """One line per fitted field, with its value and standard error."""
    rows = []
    for name, (value, error) in identified.items():
        text = ", ".join(f"{v:.4g}" for v in value) if isinstance(value, tuple) else f"{value:.4g}"
        rows.append(f"  {name} = {text}" + ("" if error is None else f" ± {format_error(error)}"))
    return rows


def command(options: argparse.Namespace) -> None:
    """Runs `twin align` with the options parsed by `twin.commands`."""
    if options.camera and not is_bag(options.log):
        raise InputError(f"{options.log} is not a bag; leave out --camera, which is only for bags")
    if options.topic and not is_bag(options.log):
        raise InputError(f"--topic {options.topic}: {options.log} is not a bag; leave it out")
    if options.camera or options.log.suffix.lower() in _FILM_SUFFIXES:
        if options.out or options.level:
            raise InputError(f"{options.log} is taken as a film; leave out --out and --level, which are for logs")
        camera, folder = align_camera(options.robot, options.log, options.topic or "")
        identified, lines = camera.identified, "\n".join([camera.summary, "fitted:", *_fitted(camera.identified)])
    else:
        result, folder = align_to_log(options.robot, options.log, options.out, not options.level, options.topic or "")
        identified, lines = result.identified, summary(result)
    overridden = sorted(set(_scene_robot_table(folder)) & set(identified))
    if not options.quiet:
        print(lines)
        if overridden:
            print(f"scene.toml overrides fitted values: {', '.join(overridden)}; to use the fit, remove them there")
        print(f"wrote {folder / ROBOT_TOML}; look at {folder / RESULT_FOLDER}")


# ---- figures

_MEASURED, _MODEL, _OTHER = "#444444", "#d1495b", "#3d7ea6"
_DPI = 110
_SHOWN = 3  # largest number of windows in the plot of wheel speeds


def write_plots(folder: Path, windows: Windows, fitted: Prediction, baseline: Prediction) -> None:
    """Writes four PNGs. They show the held-out windows, but `turning.png` shows all windows of steady speed."""
    _plot_ends(windows, fitted, baseline).savefig(folder / "ends.png", dpi=_DPI)
    _plot_turning(windows, fitted).savefig(folder / "turning.png", dpi=_DPI)
    _plot_wheels(windows, fitted).savefig(folder / "wheels.png", dpi=_DPI)
    _plot_errors(windows, fitted, baseline).savefig(folder / "errors.png", dpi=_DPI)


def _plot_ends(windows: Windows, fitted: Prediction, baseline: Prediction) -> Figure:
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
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


def _plot_turning(windows: Windows, fitted: Prediction) -> Figure:
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
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


def _plot_wheels(windows: Windows, fitted: Prediction) -> Figure:
    score = np.flatnonzero(~windows.fitting)
    change = np.ptp(windows.wheels[score], axis=1).sum(1)
    # Some windows with large changes of speed, spread over the log.
    changing = score[change >= np.quantile(change, 0.7)]
    chosen = changing[np.linspace(0, len(changing) - 1, min(_SHOWN, len(changing))).astype(int)]
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    axes = figure.subplots(1, len(chosen), sharey=True, squeeze=False)
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


def _plot_errors(windows: Windows, fitted: Prediction, baseline: Prediction) -> Figure:
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    axes = figure.subplots(1, 2)
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


if __name__ == "__main__":
    sys.exit(commands.main("align"))
