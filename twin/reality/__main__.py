"""The known-truth world's verbs.

    python -m twin.reality film --out DIR
    python -m twin.reality compare DIR
    python -m twin.reality drive --policy FILE... --task straight|right_turn --out results.csv
    python -m twin.reality log --out drive.csv
    python -m twin.reality onboard --out robot.mp4
    python -m twin.reality photo --lighting dawn --out dawn.png

`film` writes a scene folder: `scene.toml`, `input/<lighting>.mp4` and `truth/`. `drive` is the real test. `log`, and
`onboard`, a film by the robot's own camera, are what `twin.align` may learn of the robot; `photo` is what
`twin.relight` may learn of the weather of a trial. All are random only through the seeds stated in the code, so the
same command gives the same files.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from twin import cli
from twin.build import publish
from twin.config import HELD_OUT, RANDOMISED
from twin.errors import InputError
from twin.evaluation.statistics import MIN_TRIALS
from twin.evaluation.trials import cells_text, tally
from twin.files import toml_string, write_text
from twin.loading import load_scene
from twin.reality import place as places
from twin.reality import real_test, recordings
from twin.reality.comparison import compare
from twin.reality.filming import CAMERA_HEIGHT, FilmingPlan, depths, shoot
from twin.reality.lighting import LIGHTINGS, WEATHER
from twin.reality.real_test import TASKS
from twin.reality.truth import HALF_WIDTH, TrueFilm, Truth
from twin.scene import SceneDir

TINY = FilmingPlan(
    lightings=("sun", "overcast"), start=24.0, length=12.0, speed=2.0, fps=4, width=320, height=180, samples=2, crf=18
)
"""A few seconds around the start of the turn, for tests."""


def film(plan: FilmingPlan, out: Path) -> Truth:
    """Films every lighting of a plan into a scene folder, with its truth.

    Raises:
        InputError: another's folder.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / "truth").is_dir():
        raise InputError(
            f"{out} has something in it and no truth/, so it is no scene of this world; give another --out"
        )
    (out / "input").mkdir(parents=True, exist_ok=True)
    place = places.build()
    films = {}
    for lighting in plan.lightings:
        times, poses = shoot(lighting, place, plan, out / "input" / f"{lighting}.mp4")
        films[lighting] = TrueFilm(times, poses, *depths(lighting, place, plan, poses))
    truth = Truth(place.route, plan.start, plan.length, HALF_WIDTH, plan.intrinsics, (plan.width, plan.height), films)
    truth.save(out / "truth")
    write_text(out / "scene.toml", scene_toml(plan, out.resolve().name))
    return truth


def scene_toml(plan: FilmingPlan, name: str) -> str:
    """The scene's description, as a user would write it."""
    fx, fy, cx, cy = (round(float(v), 4) for v in plan.intrinsics)
    lines = ["# A drive through the known-truth world, filmed by python -m twin.reality film --out THIS_FOLDER"]
    lines += [
        f"name = {toml_string(name)}",
        "seed = 0",
        "",
        "[metric]",
        f"camera_height = {CAMERA_HEIGHT}  # metres",
        "",
    ]
    for lighting in plan.lightings:
        lines += ["[[source]]", f'path = "input/{lighting}.mp4"', f'lighting = "{lighting}"']
        lines += ["[source.camera]", 'model = "PINHOLE"', f"params = [{fx}, {fy}, {cx}, {cy}]"]
        lines += [f"width = {plan.width}", f"height = {plan.height}", ""]
    return "\n".join(lines)


def main(given: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(prog="python -m twin.reality", description="The known-truth world.")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("film", help="film the world into a scene folder")
    command.add_argument("--out", type=Path, required=True, help="scene folder to write")
    command.add_argument("--lightings", nargs="+", choices=sorted(LIGHTINGS), help="default: sun overcast night")
    command.add_argument("--tiny", action="store_true", help="12 m in 320x180 under two lightings, for tests")
    command = commands.add_parser("compare", help="a build of a filmed world against its truth, into its report")
    command.add_argument("scene", type=Path, help="scene folder, built")
    command = commands.add_parser("drive", help="the real test: drive a policy file in weather that was not filmed")
    command.add_argument("--policy", type=Path, nargs="+", required=True, help="policy folders or .onnx files")
    command.add_argument("--task", choices=TASKS, required=True)
    command.add_argument(
        "--trials",
        type=int,
        default=MIN_TRIALS,
        help="per policy and lighting (default %(default)s, the least that twin.forecast takes)",
    )
    among = f"among {', '.join(WEATHER)}"
    command.add_argument(
        "--lightings", nargs="+", choices=WEATHER, default=list(WEATHER), metavar="NAME", help=f"{among}; default: all"
    )
    command.add_argument(
        "--out", type=Path, required=True, help="results.csv; rows of trials go beside it; not for two commands at once"
    )
    command.add_argument(
        "--twin-lighting",
        default=HELD_OUT + RANDOMISED,
        help="the twin's lighting to compare with (default %(default)s)",
    )
    command.add_argument("--films", type=Path, help="folder for a film of every trial, as the robot saw it")
    command = commands.add_parser("log", help="a drive log of the world's Husky, for twin.align")
    command.add_argument("--out", type=Path, required=True, help="drive.csv")
    command.add_argument("--duration", type=float, default=300.0, help="[s] (default %(default)g)")
    command = commands.add_parser("onboard", help="a film by the world's Husky's own camera, for twin.align")
    command.add_argument("--out", type=Path, required=True, help="robot.mp4")
    command = commands.add_parser("photo", help="a photo by that camera in the weather of a trial, for twin.relight")
    command.add_argument("--lighting", required=True, choices=WEATHER, metavar="NAME", help=among)
    command.add_argument("--out", type=Path, required=True, help="photo.png")
    return cli.run(parser, _main, given)


def _main(options: argparse.Namespace) -> None:
    if options.command == "film":
        plan = TINY if options.tiny else FilmingPlan()
        film(replace(plan, lightings=tuple(options.lightings)) if options.lightings else plan, options.out)
    elif options.command == "compare":
        scene = SceneDir(options.scene)
        figures = compare(scene)["figures"]
        publish(scene, load_scene(options.scene).report())
        print("\n".join(f"{name:<32} {value:.4g}" for name, value in figures.items() if value is not None))
    elif options.command == "log":
        recordings.log_write(options.out, recordings.record(options.duration))
    elif options.command == "onboard":
        recordings.write(options.out)
    elif options.command == "photo":
        recordings.photograph(options.lighting, options.out)
    else:
        trials = real_test.run(
            options.policy,
            options.task,
            options.lightings,
            options.trials,
            options.out,
            options.twin_lighting,
            options.films,
        )
        print(cells_text(tally(trials)), end="")


if __name__ == "__main__":
    sys.exit(main())
