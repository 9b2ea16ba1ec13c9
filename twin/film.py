"""Verb: films a drive in a built scene, for visual review.

    python -m twin.film scenes/demo --task right_turn --lighting night --obstacles 4
    python -m twin.film scenes/demo --policy first --task straight --lighting held-out --seed 7 --out drive.mp4

The film shows the robot's camera image, the robot from behind, its position, speed and reward. The driver is
scripted, or a policy that `twin.validate` accepts, in an environment with the policy's options. Task, lighting and seed
determine the episode: those of a row of `validation/episodes.csv` reproduce it.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dm_env
import numpy as np

from twin import commands, runtime
from twin.env.suite import load
from twin.errors import InputError
from twin.loading import load_scene
from twin.unpack import is_cached

if TYPE_CHECKING:
    from twin.env.episode import Episode

_MAX_DIGITS = 6  # of the number of obstacles


def film(
    root: Path,
    task: str = "right_turn",
    policy: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    trust: bool = False,
    **options: Any,
) -> tuple[Path, "Episode"]:
    """Drives one episode and films it; returns the film's path and the episode.

    Args:
        root: A built scene, or a pack.
        task: See `twin.load`.
        policy: A run's name, or see `twin.learn.policy.load_policy`; None: the scripted driver.
        seed: Seed of the episode.
        out: The mp4 file; by default `films/<task>_<lighting>_<seed>.mp4` in the scene's folder, or for a pack
            `<pack>_<task>_<lighting>_<seed>.mp4` in the working folder.
        trust: Allows a policy file to run code.
        options: See `twin.env.options.Options`; by default those of the policy.

    Raises:
        InputError: an unknown scene, task, policy or option, or a negative seed.
    """
    from twin.env.drivers import Driver, PolicyDriver, RouteDriver
    from twin.env.episode import record_episode
    from twin.report.episode_video import write_episode_video
    from twin.report.review_video import load_ground_and_parts

    if seed < 0:
        raise InputError(f"seed = {seed}: expected 0 or more")
    scene = load_scene(root)
    driver: Driver = RouteDriver()
    driver_name = "scripted driver"
    if policy:
        from twin.learn.policy import find_policy, load_policy

        loaded = load_policy(find_policy(scene.scene.root, policy), trust)
        driver, driver_name = PolicyDriver(loaded), loaded.name
        options = {**loaded.options(), **options}
    environment = load(scene, task, seed, **options)
    images: list[np.ndarray] = []
    max_steps = round(environment.task.time_limit / environment.task.options.control_timestep)

    def watch(step: dm_env.TimeStep) -> None:
        images.append(step.observation["pixels"][-1])
        progress.update()

    with runtime.bar("drive", max_steps, "step") as progress:
        episode = record_episode(environment, driver, watch)
    name = film_name(task, episode.lighting, seed)
    in_cache = is_cached(scene.scene.root)
    path = out or (Path(f"{root.stem}_{name}") if in_cache else scene.scene.root / "films" / name)
    path.parent.mkdir(parents=True, exist_ok=True)
    driven, geometry = environment.task, load_ground_and_parts(scene.scene)
    limits, title = (driven.segment.start, driven.segment.end), f"{task.replace('_', ' ')}: {driver_name}"
    write_episode_video(path, episode, images, driven.world, driven.half_width, limits, geometry, title)
    return path, episode


def film_name(task: str, lighting: str, seed: int) -> str:
    """File name of an episode's film."""
    return "".join(c if c.isalnum() or c in "-." else "_" for c in f"{task}_{lighting}_{seed}") + ".mp4"


def command(given: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    obstacles = given.obstacles
    if obstacles != "scene":
        if not obstacles.isdecimal() or len(obstacles) > _MAX_DIGITS:  # isdigit accepts "²"
            raise InputError(f"--obstacles {obstacles!r}: expected a number, or 'scene' for those of scene.toml")
        obstacles = int(obstacles)
    options = {"lighting_drift": given.drift, "randomise": given.randomise, "obstacles": obstacles}
    options |= film_options(given.lighting)
    path, episode = film(given.scene, given.task, given.policy, given.seed, given.out, given.trust, **options)
    if not given.quiet:
        print(summary(path, episode))


def film_options(lighting: str | None) -> dict[str, Any]:
    """Options of the environment for `--lighting`."""
    if not lighting:
        return {}
    from twin.config import Condition
    from twin.env.domain_randomization import condition_options

    return {name: value for name, value in condition_options(Condition.parse(lighting)).items() if value}


def summary(path: Path, episode: "Episode") -> str:
    """One line: how the drive ended, and where its film is."""
    return f"{episode.cause or 'cut off'} after {episode.progress[-1]:.1f} m and {episode.times[-1]:.1f} s: {path}"


main = partial(commands.main, "film")

if __name__ == "__main__":
    sys.exit(main())
