"""Verbs of the known-truth world.

    python -m twin.reality film --out DIR
    python -m twin.reality compare DIR
    python -m twin.reality drive --policy FILE... --task straight|right_turn --out results.csv
    python -m twin.reality log --out drive.csv
    python -m twin.reality onboard --out robot.mp4
    python -m twin.reality photo --lighting dawn --out dawn.png

`film` writes a scene folder: `scene.toml`, `input/<lighting>.mp4` and `truth/`. `compare` measures a build against that
truth. `drive` runs the real test. `log` (drive log) and `onboard` (film by the robot's camera) are inputs of
`twin.align`; `photo` (the weather of a trial) is an input of `twin.relight`. All seeds are fixed in the code, so the
same command writes the same files.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from twin import commands
from twin.build import publish
from twin.errors import InputError, short_repr
from twin.evaluation.trials import cells_csv, tally
from twin.files import toml_string, write_text
from twin.loading import load_scene
from twin.reality import place as places
from twin.reality import real_test, recordings
from twin.reality.comparison import compare
from twin.reality.filming import CAMERA_HEIGHT, FilmingPlan, depth_maps, film_lighting
from twin.reality.lighting import LIGHTINGS, WEATHER
from twin.reality.truth import HALF_WIDTH, TrueFilm, Truth
from twin.scene import SceneDir

TINY = FilmingPlan(
    lightings=("sun", "overcast"), start=24.0, length=12.0, speed=2.0, fps=4, width=320, height=180, samples=2, crf=18
)
"""12 m around the start of the turn, for tests."""


def film(plan: FilmingPlan, out: Path) -> Truth:
    """Films every lighting of a plan into a scene folder and saves the truth beside it.

    Raises:
        InputError: `out` is not empty and was not written by this function.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / "truth").is_dir():
        raise InputError(
            f"{out} is not empty and has no truth/, so it is not a scene of this world; give another --out"
        )
    (out / "input").mkdir(parents=True, exist_ok=True)
    place = places.build()
    films = {}
    for lighting in plan.lightings:
        times, poses = film_lighting(lighting, place, plan, out / "input" / f"{lighting}.mp4")
        films[lighting] = TrueFilm(times, poses, *depth_maps(lighting, place, plan, poses))
    truth = Truth(place.route, plan.start, plan.length, HALF_WIDTH, plan.intrinsics, (plan.width, plan.height), films)
    truth.save(out / "truth")
    write_text(out / "scene.toml", scene_toml(plan, out.resolve().name))
    return truth


def scene_toml(plan: FilmingPlan, name: str) -> str:
    """The contents of `scene.toml`, as a user would write them."""
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


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.commands`."""
    return commands.main("reality", arguments)


def _check_lightings(names: list[str], among: Iterable[str]) -> None:
    for name in names:
        if name not in among:
            raise InputError(f"no lighting {short_repr(name)} in this place; expected one of {', '.join(among)}")


def command(options: argparse.Namespace) -> None:
    """Runs this verb with the options parsed by `twin.commands`."""
    if options.command == "film":
        _check_lightings(options.lightings or [], LIGHTINGS)
        plan = TINY if options.tiny else FilmingPlan()
        film(replace(plan, lightings=tuple(options.lightings)) if options.lightings else plan, options.out)
    elif options.command == "compare":
        scene = SceneDir(options.scene)
        figures = compare(scene)["figures"]
        publish(scene, load_scene(options.scene).report())
        print("\n".join(f"{name:<32} {value:.4g}" for name, value in figures.items() if value is not None))
    elif options.command == "log":
        recordings.write_log(options.out, recordings.record_log(options.duration))
    elif options.command == "onboard":
        recordings.write_film(options.out)
    elif options.command == "photo":
        _check_lightings([options.lighting], WEATHER)
        recordings.write_photo(options.lighting, options.out)
    else:
        options.lightings = options.lightings or list(WEATHER)
        _check_lightings(options.lightings, WEATHER)
        trials = real_test.run(
            options.policy,
            options.task,
            options.lightings,
            options.trials,
            options.out,
            options.twin_lighting,
            options.films,
        )
        print(cells_csv(tally(trials)), end="")


if __name__ == "__main__":
    sys.exit(main())
