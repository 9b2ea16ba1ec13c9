"""Verb: a film of a drive in a built scene, to be judged by eye.

    python -m twin.film scenes/demo --task right_turn --lighting night --obstacles 4
    python -m twin.film scenes/demo --policy my_policy:act --seed 7 --out drive.mp4

Shows what the robot sees, the robot from behind, where it is, its speed and its reward. The driver is scripted unless a
policy is named: `module:function`, called with pictures, uint8 (3 · stack, height, width), the newest three channels
last, and answering with numbers in [-1, 1], one per action.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from twin import progress
from twin.errors import InputError
from twin.loading import load, load_scene


def film(
    root: Path,
    task: str = "right_turn",
    policy: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    **options: Any,
) -> tuple[Path, Any]:
    """Drives one episode and films it.

    Args:
        root: A built scene.
        task: See `twin.load`.
        policy: `module:function`; the scripted driver where None.
        seed: Of the episode.
        out: The mp4; by default `films/<task>_<lighting>_<seed>.mp4` in the scene's folder.
        options: See `twin.env.options.Options`.

    Returns:
        The film's path, and the `Episode`.

    Raises:
        InputError: the scene, task, policy or an option is not to be had.
    """
    from twin.env.drivers import RouteDriver, load_policy
    from twin.env.episode import record
    from twin.report.episode_film import film_episode
    from twin.report.review import surroundings

    scene = load_scene(root)
    driver = load_policy(policy) if policy else RouteDriver()
    environment = load(scene, task, seed, **options)
    seen: list[np.ndarray] = []

    longest = round(environment.task.time_limit / environment.task.options.control_timestep)

    def watch(step: dm_env.TimeStep) -> None:
        seen.append(step.observation["pixels"][-1])
        wheel.update()

    with progress.bar("drive", longest, "step") as wheel:
        episode = record(environment, driver, watch)
    name = "".join(c if c.isalnum() or c in "-." else "_" for c in f"{task}_{episode.lighting}_{seed}")
    path = out or root / "films" / f"{name}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    drive = environment.task
    film_episode(
        path,
        episode,
        seen,
        drive.world,
        drive.half_width,
        (drive.stretch.start, drive.stretch.end),
        surroundings(scene.scene),
        f"{task.replace('_', ' ')}: {policy or 'scripted driver'}",
    )
    return path, episode


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status: 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m twin.film",
        description="Film a drive in a built scene: robot view, chase view, map, speed and reward.",
    )
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("--task", default="right_turn", help="straight, right_turn, route, or one of scene.toml")
    parser.add_argument("--policy", metavar="MODULE:FUNCTION", help="who drives; a script unless given")
    parser.add_argument("--lighting", default=None, help="a name, a mixture a:b:0.3, training, held-out or any")
    parser.add_argument("--drift", action="store_true", help="the light changes during the drive")
    parser.add_argument("--obstacles", default="scene", help="how many at random; those of scene.toml unless given")
    parser.add_argument("--randomise", action="store_true", help="another robot than the nominal one, by the seed")
    parser.add_argument("--seed", type=int, default=0, help="of the episode")
    parser.add_argument("--out", type=Path, help="the mp4; by default in SCENE/films")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    given = parser.parse_args(arguments)
    progress.set_quiet(given.quiet)
    try:
        options = {
            "lighting_drift": given.drift,
            "randomise": given.randomise,
            "obstacles": _obstacles(given.obstacles),
        }
        if given.lighting:
            options["lighting"] = given.lighting
        path, episode = film(given.scene, given.task, given.policy, given.seed, given.out, **options)
    except (InputError, OSError) as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        return 2
    if not given.quiet:
        print(f"{episode.cause or 'cut off'} after {episode.progress[-1]:.1f} m and {episode.times[-1]:.1f} s: {path}")
    return 0


def _obstacles(text: str) -> str | int:
    if text == "scene":
        return text
    if not text.isdigit():
        raise InputError(f"--obstacles {text!r}: expected a number, or 'scene' for those of scene.toml")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
