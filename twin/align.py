"""Verb: fit the Husky to a log of a real one driving, and its camera to a film that it took.

    python -m twin.align scenes/demo drive.csv
    python -m twin.align scenes/demo robot.mp4
    python -m twin.align husky drive.npz --out aligned

From a log the controller's limits and latency, the servo's lag, tyres, ground, centre of mass and effective wheel radii
are fitted to its one half and scored on the other, beside a kinematic model fitted to the same half. Each value comes
with a standard error; what the log does not show is left alone, and said so. Out come `robot.toml`, which the scene's
next build uses, and `alignment/` with `align.json` and four pictures.

A film by the robot's front camera, driving on the built place, tells how the camera sits (height, yaw, pitch, roll) and
its focal length, unless `[robot] camera_intrinsics` does. They go to the same `robot.toml`; `alignment/camera.png`
shows the film beside what the twin's robot sees.
"""

import argparse
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin import cli, runtime
from twin.config_file import ROBOT_TOML, load_config, overruled, parse, read_robot
from twin.errors import InputError
from twin.files import digest_file, read_toml, write_json, write_text
from twin.robot import HuskyParams
from twin.scene import SceneDir
from twin.sysid.identification import Alignment, align, robot_toml, told_error, toml_text
from twin.sysid.log_checks import check
from twin.sysid.logs import read_log

if TYPE_CHECKING:
    from twin.sysid.camera_extrinsics import CameraAlignment

FILMS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
"""Suffixes of what is taken for a film."""
FOLDER = "alignment"
"""Where figures and pictures go, beside `robot.toml`."""
_LENS = ("camera_intrinsics", "camera_size")
PUBLISHED = "husky"
"""Said instead of a scene: the published robot."""


def run(target: str, log: Path, out: Path | None = None, use_slope: bool = True) -> tuple[Alignment, Path]:
    """Aligns the robot of a scene, or the published one, to a log; writes the results and returns where.

    Args:
        target: Folder of a scene, a `robot.toml`, or `PUBLISHED`.
        log: See `twin.sysid.logs`.
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
    runtime.say(f"{log}: {len(windows)} windows, {int(windows.fitting.sum())} to fit to, the others to score on")
    check(windows, str(log))
    pictures = folder / FOLDER
    _writable(pictures)
    _writable(folder)
    result = align(windows, params, use_slope, runtime.say)

    from twin.sysid.plots import draw

    draw(pictures, result.windows, result.fitted, result.baseline)
    figures = {"log": str(log), "log_sha256": digest_file(log) if log.is_file() else None} | result.figures()
    write_text(folder / ROBOT_TOML, robot_toml(result, kept, str(log)))
    write_json(pictures / "align.json", figures)
    return result, folder


def run_camera(target: str, film: Path) -> "tuple[CameraAlignment, Path]":
    """Aligns the camera of a scene's robot to a film that it took; writes the results and returns where.

    Args:
        target: Folder of a built scene.
        film: By the robot's front camera, driving on the place.

    Raises:
        InputError: no such scene or film, no place for the results, or a film that cannot be used.
    """
    from twin.sysid.camera_extrinsics import align_camera, pictures

    root = Path(target).parent if Path(target).name == "scene.toml" else Path(target)
    if not SceneDir(root).config_file.exists():
        raise InputError(f"{target}: a film is found on a built place; give the scene's folder")
    if not film.is_file():
        raise InputError(f"{film}: no such film")
    scene, by_hand = SceneDir(root), _by_hand(root)
    params = load_config(scene.config_file).robot
    lens = parse(HuskyParams, {name: by_hand[name] for name in _LENS if name in by_hand}, str(scene.config_file))
    # What robot.toml has of the lens may come from an earlier film, which this one replaces.
    params = replace(params, camera_intrinsics=lens.camera_intrinsics, camera_size=lens.camera_size)
    result, frames = align_camera(film, scene, params)
    kept = {name: value for name, value in read_robot(root / ROBOT_TOML).items() if name not in _LENS}
    text = toml_text(f"The camera was fitted to {film.name}: {result.in_words}.", kept, result.identified)
    robot = overruled(tomllib.loads(text), by_hand, str(scene.config_file))
    shown = root / FOLDER
    _writable(shown, "make it so")
    pictures(shown, result, frames, scene, parse(HuskyParams, robot, str(scene.config_file)))
    write_text(root / ROBOT_TOML, text)
    figures = {"film": str(film), "film_sha256": digest_file(film)} | result.figures()
    write_json(shown / "camera.json", figures)
    return result, root


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


def _writable(folder: Path, cure: str = "give another folder with --out") -> None:
    """Makes a folder, and writes a file there and takes it away again."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error}; {cure}") from None


def hidden(folder: Path, identified: Iterable[str]) -> list[str]:
    """Fitted fields that `[robot]` of the `scene.toml` beside the written `robot.toml`, if there is one, overrules."""
    return sorted(set(_by_hand(folder)) & set(identified))


def _by_hand(folder: Path) -> dict[str, Any]:
    """`[robot]` of the `scene.toml` in a folder; empty where there is none."""
    path = SceneDir(folder).config_file
    if not path.exists():
        return {}
    return read_toml(path).get("robot", {})


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
    rows += _fitted(result.identified)
    if result.refused:
        rows.append("left alone, for this log does not show them:")
        rows += [f"  {line}" for line in result.refused]
    return "\n".join(rows)


def _fitted(identified: dict[str, tuple[Any, Any]]) -> list[str]:
    """A line per field: its value and standard error."""
    rows = []
    for name, (value, error) in identified.items():
        told = ", ".join(f"{v:.4g}" for v in value) if isinstance(value, tuple) else f"{value:.4g}"
        rows.append(f"  {name} = {told}" + ("" if error is None else f" ± {told_error(error)}"))
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(
        prog="python -m twin.align",
        description="Fit the Husky's parameters to a log of a real one driving, scored on windows not fitted to; "
        "or how its camera sits to a film by that camera.",
        epilog="A log is a .csv or .npz with the columns time [s]; cmd_v [m/s] and cmd_yaw_rate [rad/s], or cmd_left "
        "and cmd_right [rad/s]; left_wheel_vel, right_wheel_vel [rad/s]; x, y [m], yaw [rad]; optionally "
        "acceleration_x, acceleration_y [m/s²] and group. Or the folder of a ROS 2 bag with cmd_vel, joint states, a "
        "pose and an IMU (pip install 'twin[ros]'). A film (.mp4, ...) is of the robot's front camera, rectified, "
        "driving some ten metres or more on the built scene's place, mostly ahead, in light such as some film's.",
    )
    parser.add_argument("robot", help=f"folder of a scene, a robot.toml, or `{PUBLISHED}` for the published one")
    parser.add_argument("log", type=Path, help="a .csv, an .npz, the folder of a ROS 2 bag, or a film")
    parser.add_argument("--out", type=Path, help=f"folder for robot.toml and {FOLDER}/; by default the scene's")
    parser.add_argument("--level", action="store_true", help="take the ground for level, whatever the log's IMU says")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return cli.run(parser, _main, arguments)


def _main(options: argparse.Namespace) -> None:
    if options.log.suffix.lower() in FILMS:
        if options.out or options.level:
            raise InputError(f"{options.log} is a film; --out and --level belong to a log")
        camera, folder = run_camera(options.robot, options.log)
        identified, lines = camera.identified, "\n".join([camera.in_words, "fitted:", *_fitted(camera.identified)])
    else:
        result, folder = run(options.robot, options.log, options.out, not options.level)
        identified, lines = result.identified, summary(result)
    overruled = hidden(folder, identified)
    if not options.quiet:
        print(lines)
        if overruled:
            print(f"scene.toml's [robot] overrules what was fitted: {', '.join(overruled)}; remove it there to use it")
        print(f"wrote {folder / ROBOT_TOML}; look at {folder / FOLDER}")


if __name__ == "__main__":
    sys.exit(main())
