"""`python -m twin.reality film --out DIR`: films the known-truth world into a scene folder.

The folder then holds `scene.toml`, `input/<lighting>.mp4` and `truth/`. Films are random only through the seeds stated
in the code, so the same command gives the same frames.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from twin.reality import place as places
from twin.reality.film import CAMERA_HEIGHT, Plan, depths, shoot
from twin.reality.lighting import LIGHTINGS
from twin.reality.truth import HALF_WIDTH, Film, Truth

TINY = Plan(
    lightings=("sun", "overcast"), start=24.0, length=12.0, speed=2.0, fps=4, width=320, height=180, samples=2, crf=18
)
"""A few seconds around the start of the turn, for tests."""


def film(plan: Plan, out: Path) -> Truth:
    """Films every lighting of a plan into a scene folder, with its truth."""
    (out / "input").mkdir(parents=True, exist_ok=True)
    place = places.build()
    films = {}
    for lighting in plan.lightings:
        times, poses = shoot(lighting, place, plan, out / "input" / f"{lighting}.mp4")
        films[lighting] = Film(times, poses, *depths(lighting, place, plan, poses))
    truth = Truth(place.route, plan.start, plan.length, HALF_WIDTH, plan.intrinsics, (plan.width, plan.height), films)
    truth.save(out / "truth")
    (out / "scene.toml").write_text(scene_toml(plan, out.resolve().name), encoding="utf-8")
    return truth


def scene_toml(plan: Plan, name: str) -> str:
    """The scene's description, as a user would write it."""
    fx, fy, cx, cy = (round(float(v), 4) for v in plan.intrinsics)
    lines = ["# A drive through the known-truth world, filmed by python -m twin.reality film --out THIS_FOLDER"]
    lines += [f'name = "{name}"', "seed = 0", "", "[metric]", f"camera_height = {CAMERA_HEIGHT}  # metres", ""]
    for lighting in plan.lightings:
        lines += ["[[source]]", f'path = "input/{lighting}.mp4"', f'lighting = "{lighting}"']
        lines += ["[source.camera]", 'model = "PINHOLE"', f"params = [{fx}, {fy}, {cx}, {cy}]"]
        lines += [f"width = {plan.width}", f"height = {plan.height}", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m twin.reality", description="The known-truth world.")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("film", help="film the world into a scene folder")
    command.add_argument("--out", type=Path, required=True, help="scene folder to write")
    command.add_argument("--lightings", nargs="+", choices=sorted(LIGHTINGS), help="default: sun overcast night")
    command.add_argument("--tiny", action="store_true", help="12 m in 320x180 under two lightings, for tests")
    arguments = parser.parse_args()
    plan = TINY if arguments.tiny else Plan()
    if arguments.lightings:
        plan = replace(plan, lightings=tuple(arguments.lightings))
    film(plan, arguments.out)


if __name__ == "__main__":
    main()
