"""`twin reality`: films a generated place whose truth is known, drives in it, and measures builds of it.

    twin reality film [--place NUMBER [--length METERS] [--side-roads]] --out DIR
    twin reality compare DIR
    twin reality drive --policy FILE... --task straight [--place N] [--robot N] [--camera N] --day 1 2
        --out results.csv
    twin reality log --out drive.csv
    twin reality onboard --out robot.mp4
    twin reality bag --lighting dawn --out dawn_1
    twin reality photo --lighting dawn --out dawn.png

`film` writes a scene folder: `scene.toml`, `input/*.mp4` and `truth/`. `compare` measures a build against that truth.
`drive` drives policies in weather that was not filmed. `log` writes a drive log, for `twin.align`. `onboard` writes a
film by the robot's camera, also for `twin.align`. `bag` writes a robot's recording of a trial, for `twin.trial`.
`photo` writes a photo in the weather of a trial, for `twin.relight`. A repeated command writes identical files.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from twin import commands
from twin.build import publish
from twin.errors import InputError, name_hint, short_repr
from twin.evaluation.trials import cells_csv, tally
from twin.files import require_output, toml_string, write_text
from twin.geometry.cameras import Cameras
from twin.loading import load_scene
from twin.reality import campus_road, real_test, recordings
from twin.reality.campus_road import RoadLine
from twin.reality.filming import FilmingPlan, depth_maps, film_name, film_pass, parked_cars
from twin.reality.lighting import LIGHTINGS, WEATHER
from twin.reality.place_objects import DrivenLine, KnownPlace
from twin.reality.place_sampling import check_length, sample_place
from twin.reality.place_spec import PlaceSpec, SideRoad, tasks
from twin.reality.rasterizer import PlaceRenderer
from twin.reality.real_test import Setup
from twin.reality.road_task import RoadTask, read_task
from twin.reality.sampled_place import build_number
from twin.reality.sampled_road import SampledRoad
from twin.reality.side_roads import SideLine
from twin.reality.truth import HALF_WIDTH, TrueFilm, Truth, align_poses, compare, matched_poses
from twin.scene import SceneDir, require_stage

TINY = FilmingPlan(
    lightings=("sun", "overcast"), start=24.0, length=12.0, speed=2.0, fps=4, width=320, height=180, samples=2, crf=18
)
"""A short film of the campus road, 12 m around the start of its turn, for tests."""


_LENGTHS = (20.0, 2000.0)  # [m] range of `--length`
_MAX_READOUT = 0.1  # [s]
_MAX_SHAKE = 10.0


def film(
    plan: FilmingPlan,
    out: Path,
    number: int = 0,
    traffic: bool = False,
    renderer_of: Callable[[str, KnownPlace], PlaceRenderer] | None = None,
    length: float = 0.0,
    side_roads: bool = False,
) -> Truth:
    """Films every pass of a plan under every lighting into the scene folder `out`, and saves the truth there.

    The truth of an older film in this folder is deleted first; its settings are kept as `scene.old.toml` if they are
    not the new ones.

    With `traffic`, walkers and cars move through every film, and the films of all lightings but the last show parked
    cars. The truth contains none of them. `renderer_of` returns the renderer for a lighting and a place; the default is
    `filming.Renderer`, the only one that shows moving traffic. `length` [m] is that for `place_sampling.sample_place`.
    With `side_roads`, every side road whose turn begins within the filmed length gets films of its own.

    Raises:
        InputError: `out` is not empty and has no folder `truth`; there is no such side road; or `traffic` is given
            with `side_roads`.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / "truth").is_dir():
        raise InputError(f"{out} is not empty and has no truth/, so this command did not write it; give another --out")
    if side_roads and not number:
        raise InputError("--side-roads: the demo's street has none; give a --place from 1 on")
    if side_roads and traffic:
        raise InputError("--side-roads with --traffic: walkers and cars keep to the main road; leave one of them out")
    spec = sample_place(number, length, side_roads) if number else None
    sides = _filmed_sides(spec, plan) if spec and side_roads else []
    # The folder of the truth exists from the start, so that filming can start again after an interruption. Settings and
    # truth of an older film would not fit the new films.
    (out / "truth").mkdir(parents=True, exist_ok=True)
    (out / "input").mkdir(exist_ok=True)
    for old in (out / "truth" / "truth.json", out / "truth" / "truth.npz"):
        old.unlink(missing_ok=True)
    settings, before = out / "scene.toml", out / "scene.old.toml"
    if settings.exists():
        settings.replace(before)
    place = build_number(number, length=length, side_roads=side_roads) if number else campus_road.build()
    assert isinstance(place.route, RoadLine | SampledRoad)
    lines: list[tuple[FilmingPlan, DrivenLine]] = [(plan, place.route)]
    lines += [(side_plan, line) for line, side_plan in sides]
    parked = parked_cars(place, plan.start, plan.length) if traffic else []
    films, lightings = {}, {}
    for lighting in plan.lightings:
        there = replace(place, objects=[*place.objects, *(parked if lighting != plan.lightings[-1] else [])])
        renderer = renderer_of(lighting, there) if renderer_of else None
        for one_plan, line in lines:
            for one in one_plan.passes:
                name = film_name(lighting, one)
                path = out / "input" / f"{name}.mp4"
                times, poses = film_pass(lighting, there, one_plan, path, one, traffic, renderer, line)
                films[name] = TrueFilm(times, poses, *depth_maps(lighting, place, one_plan, poses))
                lightings[name] = lighting
    size = plan.width, plan.height
    truth = Truth(
        place.route,
        plan.start,
        plan.length,
        HALF_WIDTH,
        plan.intrinsics,
        size,
        films,
        number,
        lightings,
        plan.camera_height,
        {line.one.name: side_plan.length for line, side_plan in sides},
    )
    truth.save(out / "truth")
    write_text(settings, scene_toml(plan, out.resolve().name, spec, truth.road_length, sides, traffic))
    if before.exists() and before.read_bytes() == settings.read_bytes():
        before.unlink()
    return truth


_Sides = Sequence[tuple[SideLine, FilmingPlan]]
"""Lines into the filmed side roads, and the plans of their films."""
_AFTER_TURN = 4.0  # [m] from the end of the turn to that of the task `into_<side road>`
_DEVELOPMENT = 49  # places up to this number are for development
_TINY_SIDE = 20.0  # [m] of a side road's line that `--tiny` films


def _filmed_sides(spec: PlaceSpec, plan: FilmingPlan) -> _Sides:
    """The side roads whose turn begins within the filmed length. Raises InputError if there are none."""
    tiny = plan.length < spec.line.length
    road, out = SampledRoad(spec), []
    for axis in road.side_axes:
        if axis.one in _within(spec, plan.length):
            line = SideLine(road, axis)
            length = min(line.length, _TINY_SIDE) if tiny else line.length
            out.append((line, plan.side(axis.one.name, length)))
    if not out:
        reach = plan.length if tiny else float("inf")
        known = [str(n) for n in range(1, _DEVELOPMENT + 1) if _within(sample_place(n, side_roads=True), reach)]
        raise InputError(
            f"--side-roads: no side road in the first {plan.length:g} m of place {spec.number} has room for a film; "
            f"choose one of the places {', '.join(known)}"
            + (", or film without --tiny" if spec.line.side_roads else "")
        )
    return out


def _within(spec: PlaceSpec, length: float) -> list[SideRoad]:
    """The side roads whose turn begins within the first `length` meters of the road."""
    return [one for one in spec.line.side_roads if one.mouth.station - one.radius <= length]


def scene_toml(
    plan: FilmingPlan,
    name: str,
    spec: PlaceSpec | None = None,
    road_length: float = 0.0,
    sides: _Sides = (),
    traffic: bool = False,
) -> str:
    """The contents of `scene.toml`, as a user would write them, headed by the command that films it again.

    `spec` is None for the campus road; `road_length` is `Truth.road_length` [m].
    """
    usual = FilmingPlan.of(spec) if spec else FilmingPlan()
    tiny = plan.length < usual.length
    lightings = usual.lightings[:2] if tiny else usual.lightings
    fx, fy, cx, cy = (round(float(v), 4) for v in plan.intrinsics)
    place = f" --place {spec.number}" if spec else ""
    place += f" --length {road_length:g}" if road_length else ""
    place += " --side-roads" if sides else ""
    place += " --traffic" if traffic else ""
    place += " --tiny" if tiny else ""
    place += f" --lightings {' '.join(plan.lightings)}" if plan.lightings != lightings else ""
    place += f" --readout {plan.readout:g}" if plan.readout else ""
    place += f" --shake {plan.shake:g}" if plan.shake != (spec.film.shake if spec else FilmingPlan.shake) else ""
    height = f"camera_height = {plan.camera_height}  # [m]"
    if spec:
        height = f"camera_height = {spec.film.stated_height}  # [m], ± {spec.film.height_tolerance:.3f}"
    lines = [f"# A generated place, filmed by twin reality film{place} --out THIS_FOLDER"]
    lines += [f"name = {toml_string(name)}", "seed = 0", "", "[metric]", height, ""]
    for lighting in plan.lightings:
        for one in [*plan.passes, *(one for _, there in sides for one in there.passes)]:
            lines += ["[[source]]", f'path = "input/{film_name(lighting, one)}.mp4"', f'lighting = "{lighting}"']
            if spec is None or spec.film.calibrated:
                lines += ["[source.camera]", 'model = "PINHOLE"', f"params = [{fx}, {fy}, {cx}, {cy}]"]
                lines += [f"width = {plan.width}", f"height = {plan.height}"]
            lines += [""]
    if sides:
        lines += ["[route]", f'passes = ["{film_name(plan.lightings[0], plan.passes[0])}"]', ""]
    for task, (start, length) in (tasks(spec.line) if spec else {}).items():
        if start + length <= plan.length:
            lines += ["[[task]]", f'name = "{task}"', f"start = {start}", f"length = {length}", ""]
    for line, there in sides:
        side = line.one.name
        lines += ["[[branch]]", f'name = "{side}"  # also a task: the whole branch']
        lines += [f'passes = ["{film_name(plan.lightings[0], there.passes[0])}"]', ""]
        end = min(line.turn_end + _AFTER_TURN, 0.9 * there.length)
        lines += ["[[task]]", f'name = "into_{side}"', f'route = "{side}"']
        lines += ["start = 0.5", f"length = {end - 0.5:.2f}", ""]
    return "\n".join(lines)


def command(options: argparse.Namespace) -> None:
    """Runs the command that the options name, as parsed by `twin.commands`."""
    if getattr(options, "length", 0.0):
        if not _LENGTHS[0] <= options.length <= _LENGTHS[1]:
            raise InputError(f"--length {options.length:g}: expected {_LENGTHS[0]:g} to {_LENGTHS[1]:g} m")
        if options.place == 0:
            raise InputError("--length: the demo's road cannot be lengthened; give a --place from 1 on")
        check_length(options.place, options.length)
    if options.command == "film":
        plan = TINY if options.tiny else FilmingPlan()
        if options.place:
            plan = FilmingPlan.of(sample_place(options.place, options.length))
            if options.tiny:
                plan = replace(plan, lightings=plan.lightings[:2], length=12.0, width=320, height=180)
        known = plan.lightings if options.place else tuple(LIGHTINGS)
        for name in options.lightings or []:
            if name not in known:
                raise InputError(f"no lighting {short_repr(name)} in this place; {name_hint(name, known)}")
        plan = replace(plan, lightings=tuple(dict.fromkeys(options.lightings or plan.lightings)))
        if not 0.0 <= options.readout <= _MAX_READOUT:
            raise InputError(f"--readout {options.readout:g}: expected 0 to {_MAX_READOUT:g} s")
        if options.shake is not None and not 0.0 <= options.shake <= _MAX_SHAKE:
            raise InputError(f"--shake {options.shake:g}: expected 0 to {_MAX_SHAKE:g}")
        shake = plan.shake if options.shake is None else options.shake
        plan = replace(plan, readout=options.readout, shake=shake)
        film(plan, options.out, options.place, options.traffic, None, options.length, options.side_roads)
    elif options.command == "compare":
        scene = SceneDir(options.scene)
        figures = compare(scene)["figures"]
        publish(scene, load_scene(options.scene).report())
        print("\n".join(f"{name:<32} {value:.4g}" for name, value in figures.items() if value is not None))
    else:
        _with_robot(options, Setup(options.place, options.robot, getattr(options, "camera", 0), options.length))


def _with_robot(options: argparse.Namespace, setup: Setup) -> None:
    """Runs a command that needs a robot: log, onboard, bag, photo or drive."""
    numbers = getattr(options, "day", None) or []
    for number in numbers:
        if number < 1:
            raise InputError(f"--day {number}: expected 1 or more")
    days = [f"day_{number}" for number in numbers]
    if options.command == "log":
        require_output(options.out, (".csv",), make=True)
        recordings.write_log(options.out, recordings.record_log(options.duration, setup))
    elif options.command == "onboard":
        recordings.write_film(options.out, setup)
    elif options.command == "bag":
        (lighting,) = days or [options.lighting]
        trial = recordings.write_robot_bag(options.out, options.policy, options.task, lighting, options.seed, setup)
        print(f"{options.out}: {trial.cause} after {trial.progress:.1f} m")
    elif options.command == "photo":
        (lighting,) = days or [options.lighting]
        recordings.write_photo(lighting, options.out, setup)
    else:
        if options.lightings is None and not days:
            options.lightings = list(WEATHER)
        trials = real_test.run(
            options.policy,
            scene_task(options.task, options.scene, setup.place, setup.length),
            [*(options.lightings or []), *days],
            options.trials,
            options.out,
            options.twin_lighting,
            options.films,
            setup,
        )
        print(cells_csv(tally(trials)), end="")
        print(setup)


def scene_task(given: str, scene: Path | None, place: int, length: float = 0.0) -> str | RoadTask:
    """Returns a task's name unchanged; reads a JSON file and transforms its task to the true frame.

    Raises:
        InputError: no scene, a scene without truth, or one of another place or length.
    """
    if not given.endswith(".json"):
        if scene is not None:
            raise InputError(f"--scene {scene}: only a task of a .json file is in a scene's frame; leave --scene out")
        return given
    if scene is None:
        raise InputError(f"{given} is in the frame of a scene; give --scene, the folder that it was exported from")
    root = SceneDir(scene)
    if not (root.truth / "truth.npz").exists():
        raise InputError(f"{scene} has no truth; only scenes of `twin reality film` have one")
    truth = Truth.load(root.truth)
    if truth.number != place:
        raise InputError(f"{scene} is a film of place {truth.number}; give --place {truth.number}")
    if truth.side_roads:
        raise InputError(
            f"{scene} was filmed with --side-roads, which twin reality drive does not support; film without"
        )
    if place and truth.route.length != sample_place(place, length).line.length:
        cure = f"give --length {truth.road_length:g}" if truth.road_length else "leave --length out"
        raise InputError(
            f"{scene} has a road of {truth.route.length:g} m, the given place a longer or shorter one; {cure}"
        )
    cameras = Cameras.load(require_stage(root, "metric"))
    return read_task(Path(given), align_poses(cameras.camera_to_world, matched_poses(truth, cameras)))


if __name__ == "__main__":
    sys.exit(commands.main("reality"))
