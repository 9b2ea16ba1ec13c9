"""Verb: fit the Husky to a log of a real one driving.

    python -m twin.align scenes/demo drive.csv
    python -m twin.align husky drive.npz --out aligned

fits the controller's limits and latency, the servo's lag, tyres, ground, centre of mass and effective wheel radii to
half of the log and scores them on the other half, beside a kinematic model fitted to the same half. Each value comes
with a standard error; what the log does not show is left alone, and said so. Out come `robot.toml`, which the scene's
next build uses, and `alignment/` with `align.json` and four pictures.
"""

import argparse
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from twin import progress
from twin.alignment.aligned import Alignment, align, robot_toml, told_error
from twin.alignment.checks import check
from twin.alignment.logs import read_log
from twin.config_file import ROBOT_TOML, load_config, parse, read_robot
from twin.errors import InputError, refuse
from twin.robot import HuskyParams
from twin.scene import SceneDir, digest_file, write_json, write_text

FOLDER = "alignment"
"""Where figures and pictures go, beside `robot.toml`."""
PUBLISHED = "husky"
"""Said instead of a scene: the published robot."""


def run(target: str, log: Path, out: Path | None = None, use_slope: bool = True) -> tuple[Alignment, Path]:
    """Aligns the robot of a scene, or the published one, to a log; writes the results and returns where.

    Args:
        target: Folder of a scene, a `robot.toml`, or `PUBLISHED`.
        log: See `twin.alignment.logs`.
        out: Folder for the results; by default the scene's.
        use_slope: Whether to use the log's accelerations, if it has any.

    Raises:
        InputError: no such robot, no place for the results, or a log that cannot be used.
    """
    params, kept, folder = _robot(target)
    folder = out or folder
    if folder is None:
        raise InputError(f"{target}: the published robot has no folder for its robot.toml; give one with --out")
    windows = read_log(log)
    progress.say(f"{log}: {len(windows)} windows, {int(windows.fitting.sum())} to fit to, the others to score on")
    check(windows, str(log))
    pictures = folder / FOLDER
    _writable(pictures)
    _writable(folder)
    result = align(windows, params, use_slope, progress.say)

    from twin.alignment.plots import draw

    draw(pictures, result.windows, result.fitted, result.baseline)
    figures = {"log": str(log), "log_sha256": digest_file(log) if log.is_file() else None} | result.figures()
    write_json(pictures / "align.json", figures)
    write_text(folder / ROBOT_TOML, robot_toml(result, kept, str(log)))
    return result, folder


def _robot(target: str) -> tuple[HuskyParams, dict[str, Any], Path | None]:
    """The robot to start from, what its robot.toml says, and the folder that lies in."""
    if target == PUBLISHED:
        return HuskyParams(), {}, None
    path = Path(target)
    if path.name.endswith(".toml") and path.is_file() and path.name != "scene.toml":
        kept = read_robot(path)
        return parse(HuskyParams, kept, str(path)), kept, path.parent
    root = path.parent if path.name == "scene.toml" else path
    if not SceneDir(root).config_file.exists():
        raise InputError(f"{target}: no scene.toml there; give a scene's folder, a robot.toml, or `{PUBLISHED}`")
    return load_config(SceneDir(root).config_file).robot, read_robot(root / ROBOT_TOML), root


def _writable(folder: Path) -> None:
    """Makes a folder, and writes a file there and takes it away again."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error}; give another folder with --out") from None


def hidden(folder: Path, result: Alignment) -> list[str]:
    """Fitted fields that `[robot]` of the `scene.toml` beside the written `robot.toml`, if there is one, overrules."""
    path = SceneDir(folder).config_file
    if not path.exists():
        return []
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    return sorted(set(table.get("robot", {})) & set(result.identified))


def summary(result: Alignment) -> str:
    """The lines printed at the end."""
    scoring = ~result.windows.fitting
    rows = [f"{'2 s ahead, on windows not fitted to':36} {'median':>16} {'90th percentile':>18}  wheels"]
    for prediction in (result.nominal, result.baseline, result.level, result.fitted):
        s = prediction.score(scoring)
        wheels = f"{s.wheels_rad_s:.2f} rad/s" if prediction.wheels is not result.windows.wheels else "as measured"
        rows.append(
            f"{prediction.name:36} {s.position_m:7.3f} m {s.yaw_deg:5.1f}° {s.position_m_p90:8.3f} m "
            f"{s.yaw_deg_p90:6.1f}°  {wheels}"
        )
    rows.append("fitted:" if result.identified else "fitted: nothing, for the log shows nothing of the robot")
    for name, (value, error) in result.identified.items():
        told = ", ".join(f"{v:.4g}" for v in value) if isinstance(value, tuple) else f"{value:.4g}"
        rows.append(f"  {name} = {told} ± {told_error(error)}")
    if result.refused:
        rows.append("left alone, for this log does not show them:")
        rows += [f"  {line}" for line in result.refused]
    return "\n".join(rows)


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status: 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m twin.align",
        description="Fit the Husky's parameters to a log of a real one driving; score them on windows not fitted to.",
        epilog="A log is a .csv or .npz with the columns time [s]; cmd_v [m/s] and cmd_yaw_rate [rad/s], or cmd_left "
        "and cmd_right [rad/s]; left_wheel_vel, right_wheel_vel [rad/s]; x, y [m], yaw [rad]; optionally "
        "acceleration_x, acceleration_y [m/s²] and group. Or the folder of a ROS 2 bag with cmd_vel, joint states, a "
        "pose and an IMU (pip install 'twin[ros]').",
    )
    parser.add_argument("robot", help=f"folder of a scene, a robot.toml, or `{PUBLISHED}` for the published one")
    parser.add_argument("log", type=Path, help="a .csv, an .npz, or the folder of a ROS 2 bag")
    parser.add_argument("--out", type=Path, help=f"folder for robot.toml and {FOLDER}/; by default the scene's")
    parser.add_argument("--level", action="store_true", help="take the ground for level, whatever the log's IMU says")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    options = parser.parse_args(arguments)
    progress.set_quiet(options.quiet)
    try:
        result, folder = run(options.robot, options.log, options.out, not options.level)
        overruled = hidden(folder, result)
    except (InputError, OSError) as error:
        return refuse(error)
    if not options.quiet:
        print(summary(result))
        if overruled:
            print(f"scene.toml's [robot] overrules what was fitted: {', '.join(overruled)}; remove it there to use it")
        print(f"wrote {folder / ROBOT_TOML}; look at {folder / FOLDER}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
