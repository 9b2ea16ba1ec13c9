"""The subcommands (verbs) of `twin` and their options: `twin VERB`, also `python -m twin.VERB`.

Only options are defined here, so that `--help` is fast; a verb's module is imported when the verb runs.
`command_line.py` runs a command line.
"""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin.command_line import HelpFormatter, Parser, run
from twin.config import CAUSES, HELD_OUT, QUALITIES, Condition
from twin.scene import STAGE_FOLDERS

_Add = Callable[..., Any]


@dataclass(frozen=True)
class Verb:
    """A subcommand of `twin`."""

    summary: str
    define: Callable[[argparse.ArgumentParser, _Add], None]
    """Adds the description and options to a parser; its second argument is the parser's `add_argument`."""
    module: str
    """Module whose function `command` runs with the parsed options."""
    quiet: str = "no progress, no summary"
    """Help of the option --quiet; without any, there is no such option."""


def main(verb: str, arguments: list[str] | None = None) -> int:
    """Runs a verb (a key of `VERBS`) with the given arguments; returns the exit status.

    By default, the arguments are those of the process.
    """

    def work(options: argparse.Namespace) -> None:
        importlib.import_module(VERBS[verb].module).command(options)

    return run(parser_of(verb), work, arguments)


def parser_of(verb: str) -> argparse.ArgumentParser:
    """The argument parser of a verb, a key of `VERBS`."""
    parser = Parser(prog=f"twin {verb}", formatter_class=HelpFormatter)
    VERBS[verb].define(parser, parser.add_argument)
    if VERBS[verb].quiet:
        parser.add_argument("--quiet", action="store_true", help=VERBS[verb].quiet)
    return parser


# ---- options

_OTHERS_POLICIES = (
    "module:function gets the last four pictures, uint8 (12, 90, 160), and returns 1 number in [-1, 1] (yaw rate at 1 "
    "m/s) or 2 (speed, yaw rate). A stable-baselines3 zip gets pictures of the size and number it was trained with, "
    "without state. Both drive with the defaults of an environment: at most 1 m/s and 1 rad/s, 10 actions per second."
)


def _new(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Start a scene folder from films or robots' bags (ROS 2, or .bag of ROS 1; pip install 'twin[ros]'). A bag "
        "also brings the camera's calibration, GPS and odometry for the scale, and the camera's pose on the robot."
    )
    add("scene", type=Path, help="folder to make, such as scenes/my_road")
    films = "films, bags, photo folders, COLMAP models or transforms.json"
    add("films", type=Path, nargs="+", metavar="VIDEO", help=films)
    height = "height of the lens above the ground (default: that of a bag)"
    add("--camera-height", type=float, metavar="METERS", help=height)
    add("--topic", help="topic of a bag's pictures; default: that with the most pictures")


def _build(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Turn a filmed place into a drivable MuJoCo twin."
    parser.set_defaults(resumes=True)
    parser.epilog = """\
a scene.toml of your own road:

  [[source]]                      # one per film; several lightings make one twin
  path = "input/morning.mp4"      # video, bag, photo folder, COLMAP model or transforms.json
  lighting = "morning"
  # mask = "input/robot.png"      # 0 = ignore (an image, or a folder named like the frames)
  # camera = { model = "PINHOLE", params = [fx, fy, cx, cy], width = 1280, height = 720 }

  [metric]                        # the source of the scale: one or more of
  camera_height = 1.2             #   lens above the ground [m]
  # gps = true                    #   positions in EXIF or a bag
  # odometry = true               #   distances by a bag's odometry
  # distance = { metres = 5.0, frame_a = "morning/000010", a = [u, v], b = [u, v] }
  # marker = { family = "DICT_APRILTAG_36h11", id = 0, size = 0.2 }
  # poses_are_metric = true       #   poses of the input, in meters

twin new SCENE VIDEO... writes such a folder.
"""
    add("scene", type=Path, help="folder with scene.toml and input/")
    add("--until", choices=STAGE_FOLDERS, metavar="STAGE", help=f"last stage to run: {', '.join(STAGE_FOLDERS)}")
    add("--force", choices=STAGE_FOLDERS, metavar="STAGE", action="append", default=[], help="stage to run again")
    add("--quality", choices=tuple(QUALITIES), help="sharpness of the field; default: as in scene.toml, or standard")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="override scene.toml, as in nerf.steps=4000")
    add("--device", choices=("cpu", "cuda"), help="default: cuda where it is usable, else cpu")


def _relight(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Add a lighting to a built scene from one photo: the photo is located, then an appearance embedding of the "
        "radiance field, fog and, on demand, a sun are fitted to it. Then the twin can be rendered in that lighting."
    )
    parser.epilog = (
        "Without --sun and --time the lighting has no sun. A sun is kept only if, with it, a fit to half of the photo "
        "explains the other half better."
    )
    add("scene", type=Path, help="folder of a built scene")
    add("photo", type=Path, help="an image file that shows the place, from near the filmed path")
    add("--name", required=True, help="name of the lighting; replaces an added one of that name")
    add(
        "--sun",
        metavar="AZIMUTH,ELEVATION",
        help="direction [°], the azimuth counterclockwise from the scene's x axis; search: find it in the photo",
    )
    add("--time", help="when the photo was taken, such as 2026-06-01T17:30+02:00; gives the sun")
    add("--location", metavar="LAT,LON", help="where it was taken [°]; default: by the frames' GPS")
    add("--heading", type=float, metavar="DEG", help="compass angle of the scene's x axis [°]; default: by GPS")


def _align(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Fit the Husky's parameters to the log of a real Husky's drive, and score them on parts of the log that were "
        "held out; or fit the pose of its camera to a film by that camera."
    )
    parser.epilog = (
        "A log is a .csv or .npz with the columns time [s]; cmd_v [m/s] and cmd_yaw_rate [rad/s], or cmd_left "
        "and cmd_right [rad/s]; left_wheel_vel, right_wheel_vel [rad/s]; x, y [m], yaw [rad]; optionally "
        "acceleration_x, acceleration_y [m/s²] and group. Or a ROS bag with cmd_vel, joint states (or the wheels' "
        "odometry), poses other than wheel odometry (or pictures from which the scene was built) and optionally an IMU "
        "(pip install 'twin[ros]'). A film (.mp4, ...) has rectified pictures of the robot's front camera. In it, the "
        "robot drives about 20 m at the scene's place, mostly straight ahead, in light like that of one of its films."
    )
    add("robot", help="folder of a scene, a robot.toml, or `husky` (published values)")
    add("log", type=Path, help="a .csv, an .npz, a bag, or a film")
    add("--camera", action="store_true", help="fit the camera's pose to the bag's pictures")
    add("--topic", help="topic of the bag's poses; with --camera, of its pictures")
    add("--out", type=Path, help="folder for robot.toml and alignment/; default: that of the scene")
    add("--level", action="store_true", help="assume level ground and ignore the log's IMU")


def _film(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Film a drive in a built scene: robot view, chase view, map, speed and reward."
    parser.epilog = _OTHERS_POLICIES
    add("scene", type=Path, help="folder of a built scene, or a pack")
    add("--task", default="right_turn", help="straight, right_turn, route, or one of scene.toml")
    add("--policy", help="a run, a checkpoint, an ONNX file, module:function or a zip; default: a scripted driver")
    add("--trust", action="store_true", help="load a policy file that may run code")
    add(
        "--lighting",
        help="a name, a mixture a:b:0.3 (30 %% of b), or a random one: training, held-out, any; each may end with "
        "+randomised (default: training)",
    )
    add("--drift", action="store_true", help="the light changes during the drive")
    add("--obstacles", default="scene", help="number of random obstacles; scene: those of scene.toml")
    add("--randomise", action="store_true", help="randomize robot, weather and distractor objects")
    add("--seed", type=int, default=0, help="seed of the episode")
    add("--out", type=Path, help="the mp4; default: a file in SCENE/films")
    add(
        "--rerun",
        type=Path,
        metavar="FILE",
        help="also write the drive as a Rerun recording, such as drive.rrd (pip install 'twin[rerun]')",
    )
    add(
        "--lerobot",
        type=Path,
        metavar="DIR",
        help="record drives as a LeRobot dataset instead of a film (pip install 'twin[lerobot]')",
    )
    add("--episodes", type=int, default=1, help="drives in the dataset, with seeds from --seed on")


def _drive(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Show the Husky driving, in a film or on the page of twin view. By default, the policy of a pack or of a "
        "scene's only run drives the task of its training; without such a policy, the scripted driver drives."
    )
    add("scene", type=Path, help="folder of a built scene, or a pack or its name: demo")
    add("--view", action="store_true", help="show the drive in the browser; press Start driving there")
    add("--policy", help="a run, a checkpoint, an ONNX file or module:function")
    add("--trust", action="store_true", help="load a policy file that may run code")
    add("--task", help="straight, right_turn, route, or one of scene.toml")
    add("--lighting", help="a name, or a mixture sun:night:0.5 (default: sampled; with --view the first filmed one)")
    add("--seed", type=int, default=0, help="seed of the episode")
    add("--port", type=int, default=8080, help="port of the page; if taken, the next free one; 0: any")
    add("--out", type=Path, help="the mp4; default: in SCENE/films; for a pack, in this folder")


def _pack(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Pack a built scene into one file with what driving in it needs, for another machine."
    add("scene", type=Path, help="folder of a built scene")
    add("-o", "--out", type=Path, metavar="FILE", help="the pack; default: NAME.twin in this folder")
    add("--policy", action="append", default=[], help="a run, a checkpoint or an ONNX file to include; may be repeated")
    add("--licence", default="", metavar="TEXT", help="terms of use, such as 'CC BY 4.0'; default: not stated")
    add("--with-positions", action="store_true", help="include the films' GPS positions")
    add(
        "--levels",
        type=int,
        default=256,
        help="number of values to which the radiance field's features are rounded; fewer values make the pack smaller "
        "and change the field; 256 keeps every bit",
    )
    add("--trust", action="store_true", help="include policies that may run code when they are loaded")


def _unpack(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Unpack a pack into a scene folder, in which all commands work that need no films. Its paths, sizes and "
        "digests are checked, and nothing in it runs."
    )
    add("pack", type=Path, help="the file")
    add("folder", type=Path, help="folder to make")
    add("--trust", action="store_true", help="unpack policies that may run code when loaded, too")


def _view(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Show a built scene in the browser: look around under any lighting, drive the Husky by keys or a policy, put "
        "obstacles in its way, compare film and twin, place camera paths. Or render such a path to a film."
    )
    add("scene", type=Path, help="folder of a built scene, or a pack")
    add(
        "--lighting",
        help="a name, or a mixture sun:night:0.5; default: the first filmed one; with --path, of views without one",
    )
    add("--task", help="task of the driver: straight, right_turn, ... (default: route)")
    add("--policy", help="a run, a checkpoint, an ONNX file or module:function that may drive")
    add("--trust", action="store_true", help="load a policy file that may run code")
    add("--seed", type=int, default=0, help="seed of the task's episodes")
    add(
        "--host",
        default="127.0.0.1",
        help="address to serve on; unless it is this machine's loopback, the page's URL contains a secret token",
    )
    add("--port", type=int, default=8080, help="port; if taken, the next free one; 0: any")
    add("--path", type=Path, help="render this saved camera path instead of showing the page")
    add("--out", type=Path, help="the mp4 of --path")
    add("--size", default="1280x720", help="size of the film [px]")
    add("--fps", type=int, default=30, help="frames per second of the film")


def _export(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Write a built place for other programs: all of it as USD, its mesh as glTF, its radiance field as Gaussian "
        "splats, its frames and cameras for other trainers, a task's rules for evaluation elsewhere."
    )
    add("scene", type=Path, help="folder of a built scene, or a pack")
    add(
        "--usd",
        type=Path,
        metavar="FILE",
        help="write splats in every lighting, collision shapes, the Husky, its camera and route as .usdz, .usd, .usdc "
        "(pip install 'twin[usd]')",
    )
    add("--glb", type=Path, metavar="FILE", help="write the visual mesh, textured (binary glTF, y up)")
    add("--ply", type=Path, metavar="FILE", help="write Gaussians as 3DGS viewers read them (z up)")
    add("--spz", type=Path, metavar="FILE", help="write the Gaussians compressed (z up); needs the extra spz")
    add("--nerfstudio", type=Path, metavar="DIR", help="write transforms.json, frames, masks and sparse points")
    add("--colmap", type=Path, metavar="DIR", help="write a COLMAP model with its frames and masks")
    add("--task-file", type=Path, metavar="FILE", help="write the rules of --task as JSON, for evaluation elsewhere")
    add("--task", metavar="NAME", help="a task of the scene, such as straight")
    add(
        "--lighting",
        help="lighting of --glb, --ply and --spz, and the first one in --usd: a name, or a mixture sun:night:0.5; "
        "default: first filmed one",
    )


def _train(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Train a policy from pixels, by a teacher that SAC trains from the robot's state."
    parser.set_defaults(resumes=True)
    add("scene", type=Path, help="folder of a built scene")
    add("--task", default="straight", help="straight, right_turn, route, or one of scene.toml")
    add("--run", required=True, help="name of the run, a folder in SCENE/runs")
    add("--observe", choices=("nerf", "simulator"), help="source of the pictures (default: nerf)")
    add("--lighting", help="one lighting by name (default: training, which varies between episodes)")
    add("--preset", choices=("cpu", "gpu"), default="cpu", help="sizes of network, batch and run")
    action = "yaw rate at 1 m/s, or also the speed, up to 1 m/s (default: steering)"
    add("--action", choices=("steering", "twist"), help=action)
    add("--success", type=float, help="success rate in tests at which the training ends (default: 0.95)")
    steps = "largest number of control steps of all environments (default: 24000, more from 50 m on; gpu: 60000)"
    add("--steps", type=int, help=steps)
    add("--teacher-steps", type=int, help="control steps of the teacher, which needs no pictures (default: 20000)")
    add("--worlds", type=int, help="number of parallel environments (default: 8; gpu: 32)")
    processes = "processes that step the environments, two or more each (default: one per core, at most 16)"
    add("--processes", type=int, help=processes)
    add("--device", choices=("cpu", "cuda"), help="where the networks are trained (default: cpu; preset gpu: cuda)")
    add("--updates", type=float, help="updates of the policy per control step (default: 0.5)")
    add(
        "--steering",
        type=float,
        help="teacher's penalty of full steering, as share of a step's reward (default: 0.5)",
    )
    entropy = "teacher's target entropy per action component [nat]; higher explores more (default: -0.5)"
    add("--entropy", type=float, help=entropy)
    add("--colours", type=float, help="strength of color augmentation where the lighting varies (default: 1.0)")
    add("--seed", type=int, help="seed of every random draw (default: 0)")
    add(
        "--randomise",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="randomize the robot and, where the lighting varies, weather and distractor objects (the default)",
    )
    add(
        "--wandb",
        metavar="PROJECT",
        help="project of Weights & Biases, or ENTITY/PROJECT, to which numbers are logged and at the end a film of the "
        "kept policy (pip install 'twin[wandb]')",
    )


def _validate(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Measure how often policies succeed, lighting by lighting."
    parser.set_defaults(resumes=True)
    parser.epilog = _OTHERS_POLICIES
    add("scene", type=Path, help="folder of a built scene")
    add("--policy", nargs="+", required=True, help="runs, checkpoints, ONNX files, module:function or zips; see below")
    add("--task", default="straight", help="straight, right_turn, route, or one of scene.toml")
    add(
        "--lightings",
        nargs="+",
        default=[HELD_OUT, str(Condition(HELD_OUT, True))],
        help="names, mixtures a:b:0.3, or random ones: held-out, any; each may end with +randomised",
    )
    add("--episodes", type=int, default=100, help="number per policy and lighting")
    add("--worst", action="store_true", help="search for each policy's worst lighting")
    add("--films", action="store_true", help="film each policy's typical and worst episode")
    add("--trust", action="store_true", help="load policy files that may run code")
    add("--processes", type=int, default=1, help="processes on this machine, such as one per core")
    add("--ray", metavar="ADDRESS", help="use a Ray cluster; auto: the one on this machine")


def _trial(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "Evaluate a trial on the road, from the robot's ROS bag, by the twin's rules. The results are a row of "
        "real.csv, a film of robot and twin side by side, and their differences in path and pictures."
    )
    parser.epilog = (
        "The bag (a folder, .mcap, .db3 or .bag; pip install 'twin[ros]') has the front camera's pictures and "
        "camera_info, velocity commands, and poses: odometry that does not drift (RTK, LiDAR, filtered), or NavSatFix. "
        "Topics are found by their types."
    )
    add("scene", type=Path, help="folder of a built scene")
    add("bag", type=Path, nargs="+", help="the recording of one trial; with --lerobot, of any drives")
    add("--policy", help="the policy that drove: a run, a checkpoint or an ONNX file")
    add("--task", default="straight", help="straight, right_turn, route, or one of scene.toml")
    add("--lighting", metavar="NAME", help="name of the day or lighting in real.csv")
    add("--twin-lighting", metavar="NAME", help="the twin's lighting to compare with; default: as before or --lighting")
    add("--cause", choices=CAUSES[1:], help="what ended the trial, if the poses do not show it")
    add("--out", type=Path, metavar="CSV", help="default: SCENE/real.csv; a list of trials is beside it")
    add(
        "--frame",
        choices=("pictures", "scene"),
        default="pictures",
        help="pictures: fit the poses to the localized pictures; scene: the poses are in the scene's coordinates",
    )
    add(
        "--lerobot",
        type=Path,
        metavar="DIR",
        help="write the bags, of a policy or a human, as a LeRobot dataset instead (pip install 'twin[lerobot]')",
    )
    add("--image", metavar="TOPIC", help="topic of the pictures")
    add("--camera-info", metavar="TOPIC", help="topic of the calibration")
    add("--poses", metavar="TOPIC", help="topic of the poses")
    add("--commands", metavar="TOPIC", help="topic of the commands")


def _forecast(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = "Predict success on the road from success in the twin."
    parser.epilog = """\
real.csv, one line per policy and lighting:

  policy,lighting,trials,successes
  first,morning,10,8
  first,dusk,10,6

Names are those of validation/episodes.csv. If a policy was validated on several tasks, add a column task.
If the twin has no lighting of a name, a column twin_lighting names the lighting to compare with, such as
held-out+randomised.
"""
    add("scene", type=Path, help="folder of a scene with validated policies")
    real = "tables of trials on the road, such as SCENE/real.csv, see below; without them: ranks in the twin alone"
    add("--real", type=Path, nargs="+", default=[], metavar="CSV", help=real)
    add("--seed", type=int, default=0, help="seed of the sampling from posteriors")


def _reality(parser: argparse.ArgumentParser, add: _Add) -> None:
    parser.description = (
        "A generated place whose truth is known: film it, drive policies in it, compare a build with it."
    )
    commands = parser.add_subparsers(dest="command", required=True, parser_class=Parser)

    def command(name: str, text: str) -> tuple[argparse.ArgumentParser, _Add]:
        """A command's parser, and the function that adds an option to it."""
        parser = commands.add_parser(name, help=text, description=text, formatter_class=HelpFormatter)
        return parser, parser.add_argument

    def place(add: _Add) -> None:
        what = "0: the demo's street; from 1: sampled places (1 to 49 are for development)"
        add("--place", type=int, default=0, metavar="NUMBER", help=what)
        what = "lengthen a sampled place's road to this, 20 to 2000; 0: as sampled"
        add("--length", type=float, default=0.0, metavar="METERS", help=what)

    def robot(add: _Add, camera: bool = True) -> None:
        place(add)
        add("--robot", type=int, default=0, metavar="NUMBER", help="number of the simulated robot")
        if camera:
            add("--camera", type=int, default=0, metavar="NUMBER", help="number of that robot's camera")

    designed = "dawn, afternoon, evening, haze, rain"

    def one_weather(one: argparse.ArgumentParser) -> None:
        either = one.add_mutually_exclusive_group(required=True)
        either.add_argument("--lighting", metavar="NAME", help=f"{designed}, or day_N")
        either.add_argument("--day", type=int, nargs=1, metavar="NUMBER", help="number of a random day, from 1")

    _, add = command("film", "film the place into a scene folder")
    add("--out", type=Path, required=True, help="scene folder to write")
    place(add)
    add(
        "--lightings",
        nargs="+",
        metavar="NAME",
        help="of sun, overcast, night, dusk; default: the first three; for a sampled place, its own",
    )
    add("--tiny", action="store_true", help="only 12 m in 320x180 px under two lightings, for tests")
    traffic = "walkers and cars move through the films, and parked cars have left in the last lighting"
    add("--traffic", action="store_true", help=traffic)
    add("--side-roads", action="store_true", help="film the side roads of a sampled place, too: films of their own")
    add("--readout", type=float, default=0.0, metavar="SECONDS", help="rolling shutter; 0: none")
    add("--shake", type=float, metavar="FACTOR", help="shake of the camera; 1: as on a cart")
    _, add = command("compare", "compare a build of a filmed place with its truth, and show it in the build's report")
    add("scene", type=Path, help="folder of a built scene")
    one, add = command("drive", "drive policy files on the simulated road, in weather that was not filmed")
    one.set_defaults(resumes=True)
    add("--policy", type=Path, nargs="+", required=True, help="policy folders or .onnx files")
    task = "{straight,right_turn}; a sampled place names its own; or a .json of twin export --task-file"
    add("--task", required=True, help=task)
    add("--scene", type=Path, help="the built scene from which the .json was exported")
    robot(add)
    add("--trials", type=int, default=5, help="per policy and lighting; twin forecast takes 5 or more")
    what = f"{designed}, day_N (default: these five and day_1 to day_15; with --day none)"
    add("--lightings", nargs="+", metavar="NAME", help=what)
    add("--day", type=int, nargs="+", metavar="NUMBER", help="numbers of random days, from 1")
    out = "real.csv, with a table of trials beside it; only one command at a time may write it"
    add("--out", type=Path, required=True, help=out)
    compared = f"the twin's lighting to compare with; default: as before, or {Condition(HELD_OUT, True)}"
    add("--twin-lighting", metavar="NAME", help=compared)
    add("--films", type=Path, help="folder for a film of every trial driven now, as the robot saw it")
    _, add = command("log", "a drive log of the place's Husky, for twin align")
    add("--out", type=Path, required=True, help="drive.csv")
    add("--duration", type=float, default=300.0, help="length of the drive [s]")
    robot(add, camera=False)
    _, add = command("onboard", "a film by the place's Husky, for twin align")
    add("--out", type=Path, required=True, help="robot.mp4")
    robot(add)
    one, add = command("bag", "a ROS 2 bag of one trial of the place's Husky, for twin trial")
    add("--out", type=Path, required=True, help="folder of the bag")
    add("--policy", type=Path, help="policy folder; default: the robot follows the route")
    add("--task", default="straight", help="{straight,right_turn}; a sampled place names its own")
    one_weather(one)
    add("--seed", type=int, default=0, help="seed of start, camera and noise")
    robot(add)
    one, add = command("photo", "a photo by the Husky's camera in the weather of a trial, for twin relight")
    one_weather(one)
    add("--out", type=Path, required=True, help="photo.png")
    robot(add)


VERBS = {
    "new": Verb("start a scene folder from films, photos or bags", _new, "twin.new", quiet=""),
    "build": Verb("turn a scene folder into a drivable twin, with a report and a review video", _build, "twin.build"),
    "relight": Verb("add a lighting to a built scene, from one photo", _relight, "twin.relight"),
    "align": Verb("fit the robot to a log of a real one, or its camera to a film", _align, "twin.align"),
    "drive": Verb("show the Husky driving in a scene or a pack", _drive, "twin.drive"),
    "view": Verb(
        "look at a built scene and drive in it, in the browser",
        _view,
        "twin.view.__main__",
        quiet="no progress, no address, no summary",
    ),
    "film": Verb("film a drive in a built scene", _film, "twin.film"),
    "export": Verb("write the place for other programs: USD, glTF, splats, cameras", _export, "twin.export.__main__"),
    "pack": Verb("pack a built scene into one file, with policies, for another machine", _pack, "twin.pack"),
    "unpack": Verb("unpack such a file into a scene folder", _unpack, "twin.unpack", quiet="no summary"),
    "train": Verb("train a policy on a task of a built scene", _train, "twin.train"),
    "validate": Verb(
        "measure how often policies succeed, lighting by lighting",
        _validate,
        "twin.validate",
        quiet="no progress, no table",
    ),
    "trial": Verb("evaluate a trial on the road from the robot's recording", _trial, "twin.trial"),
    "forecast": Verb(
        "predict success on the real road from success in the twin",
        _forecast,
        "twin.forecast",
        quiet="no summary",
    ),
    "reality": Verb(
        "a generated place whose truth is known: film it, drive in it", _reality, "twin.reality.__main__", quiet=""
    ),
}
"""The verbs, in the order in which a user needs them."""
