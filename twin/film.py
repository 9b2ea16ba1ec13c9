"""Verb: a film of a drive in a built scene, to be judged by eye.

    python -m twin.film scenes/demo --task right_turn --lighting night --obstacles 4
    python -m twin.film scenes/demo --policy first --task straight --lighting held-out --seed 7 --out drive.mp4

Shows what the robot sees, the robot from behind, where it is, its speed and its reward. The driver is scripted unless a
policy is named: whatever `twin.validate` takes, in the environment that the policy asks for. Task, lighting and seed
decide the episode: those of a row of `validation/episodes.csv` show that very episode.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dm_env
import numpy as np

from twin import cli, runtime
from twin.env.suite import load
from twin.errors import InputError
from twin.loading import load_scene

_MOST_DIGITS = 6  # of a number of obstacles

if TYPE_CHECKING:
    from twin.env.episode import Episode


def film(
    root: Path,
    task: str = "right_turn",
    policy: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    trust: bool = False,
    **options: Any,
) -> tuple[Path, "Episode"]:
    """Drives one episode and films it.

    Args:
        root: A built scene.
        task: See `twin.load`.
        policy: A run's name, or see `twin.learn.policy.load_policy`; the scripted driver where None.
        seed: Of the episode.
        out: The mp4; by default `films/<task>_<lighting>_<seed>.mp4` in the scene's folder.
        trust: Whether a policy file may run code.
        options: See `twin.env.options.Options`; where not given, as the policy asks for.

    Returns:
        The film's path, and the episode.

    Raises:
        InputError: the scene, task, policy or an option is not to be had, or the seed is negative.
    """
    from twin.env.drivers import Driver, PolicyDriver, RouteDriver
    from twin.env.episode import record
    from twin.report.episode_video import film_episode
    from twin.report.review_video import surroundings

    if seed < 0:
        raise InputError(f"seed = {seed}: expected 0 or more")
    scene = load_scene(root)
    driver: Driver = RouteDriver()
    who = "scripted driver"
    if policy:
        from twin.learn.policy import find_policy, load_policy

        loaded = load_policy(find_policy(root, policy), trust)
        driver, who = PolicyDriver(loaded), loaded.name
        options = {**loaded.options(), **options}
    environment = load(scene, task, seed, **options)
    seen: list[np.ndarray] = []

    longest = round(environment.task.time_limit / environment.task.options.control_timestep)

    def watch(step: dm_env.TimeStep) -> None:
        seen.append(step.observation["pixels"][-1])
        wheel.update()

    with runtime.bar("drive", longest, "step") as wheel:
        episode = record(environment, driver, watch)
    path = out or root / "films" / film_name(task, episode.lighting, seed)
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
        f"{task.replace('_', ' ')}: {who}",
    )
    return path, episode


def film_name(task: str, lighting: str, seed: int) -> str:
    """File name of an episode's film."""
    return "".join(c if c.isalnum() or c in "-." else "_" for c in f"{task}_{lighting}_{seed}") + ".mp4"


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(
        prog="python -m twin.film",
        description="Film a drive in a built scene: robot view, chase view, map, speed and reward.",
    )
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("--task", default="right_turn", help="straight, right_turn, route, or one of scene.toml")
    parser.add_argument("--policy", help="a run, a checkpoint, an ONNX file or module:function; a script unless given")
    parser.add_argument("--trust", action="store_true", help="load a policy file that may run code")
    parser.add_argument(
        "--lighting",
        default=None,
        help="a name, a mixture a:b:0.3, training, held-out or any; any of them with +randomised",
    )
    parser.add_argument("--drift", action="store_true", help="the light changes during the drive")
    parser.add_argument("--obstacles", default="scene", help="how many at random; those of scene.toml unless given")
    parser.add_argument("--randomise", action="store_true", help="robot, air and bystanders drawn by the seed")
    parser.add_argument("--seed", type=int, default=0, help="of the episode")
    parser.add_argument("--out", type=Path, help="the mp4; by default in SCENE/films")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return cli.run(parser, _main, arguments)


def _main(given: argparse.Namespace) -> None:
    options = {
        "lighting_drift": given.drift,
        "randomise": given.randomise,
        "obstacles": _obstacles(given.obstacles),
    }
    if given.lighting:
        from twin.env.domain_randomization import asked

        options |= {name: value for name, value in asked(given.lighting).items() if value}
    path, episode = film(given.scene, given.task, given.policy, given.seed, given.out, given.trust, **options)
    if not given.quiet:
        print(f"{episode.cause or 'cut off'} after {episode.progress[-1]:.1f} m and {episode.times[-1]:.1f} s: {path}")


def _obstacles(text: str) -> str | int:
    if text == "scene":
        return text
    if not text.isdecimal() or len(text) > _MOST_DIGITS:  # "²" is a digit, too
        raise InputError(f"--obstacles {text!r}: expected a number, or 'scene' for those of scene.toml")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
