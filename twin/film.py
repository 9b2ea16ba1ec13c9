"""`twin film`: films a drive in a built scene, for visual review.

    twin film scenes/demo --policy first --task straight --lighting held-out --seed 7 --out drive.mp4
    twin film scenes/demo --lerobot drives --episodes 20

The driver is a scripted route follower, or a policy that `twin.validate` accepts; a policy also gives the environment's
options. Task, lighting and seed determine the episode, so any row of `validation/episodes.csv` can be filmed. With
`--lerobot`, drives are recorded as a dataset for learning instead of a film.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from twin import commands, runtime
from twin.config import STEERING, Condition
from twin.env.domain_randomization import condition_options
from twin.env.drivers import Driver, PolicyDriver, RouteDriver
from twin.env.env_factory import load
from twin.env.episode import Episode, record_episode
from twin.errors import InputError
from twin.files import atomic_path, new_folder, require_absent, require_output, require_writable
from twin.geometry.poses import inverse_pose
from twin.learn.policy import find_policy, load_policy
from twin.loading import Twin, load_scene
from twin.report.drive_dataset import DriveDataset, drive_instruction, drives_summary, require_pyarrow
from twin.report.drive_video import write_episode_video
from twin.report.rerun_recording import require_rerun, write_rerun_recording
from twin.report.review_video import load_ground_and_parts
from twin.unpack import is_cached

_MAX_DIGITS = 6  # largest number of digits in --obstacles


def film(
    root: Path,
    task: str = "right_turn",
    policy: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    trust: bool = False,
    rerun: Path | None = None,
    **options: Any,
) -> tuple[Path, Episode]:
    """Drives one episode and films it; returns the film's path and the episode.

    Args:
        root: A built scene, or a pack.
        task: See `twin.load`.
        policy: A run's name, or a source as in `twin.learn.policy.load_policy`; None: the scripted driver.
        seed: Seed of the episode.
        out: The mp4 file; by default `films/<task>_<lighting>_<driver>_<seed>.mp4` in the scene's folder, or for a pack
            `<pack>_<task>_<lighting>_<driver>_<seed>.mp4` in the working folder; with a number of random obstacles,
            `<number>_obstacles` comes before the driver.
        trust: Allows a policy file to run code.
        rerun: A file for a Rerun recording, see `twin.report.rerun_recording`; None: no recording.
        options: See `twin.env.options.Options`; by default those of the policy.

    Raises:
        InputError: the scene, task, policy or an option is unknown, the seed is negative, a file cannot be written
            or has another suffix than `.mp4` and `.rrd`, or rerun-sdk is needed but not installed.
    """
    if out:
        require_output(out, (".mp4",), make=True)
    if rerun:
        require_rerun()
        require_output(rerun, (".rrd",))
    scene = load_scene(root)
    in_cache = is_cached(scene.scene.root)
    folder = out.parent if out else Path() if in_cache else scene.scene.root / "films"
    driver, driver_name, options = _driver(scene, policy, seed, trust, options)
    environment = load(scene, task, seed, **options)
    require_writable(folder, "give another path with --out")
    images: list[np.ndarray] = []
    motion: list[tuple[float, float]] = []
    cameras: list[np.ndarray] = []  # the camera's pose on the robot

    def watch(step: dm_env.TimeStep) -> None:
        images.append(step.observation["pixels"][-1].copy())
        motion.append((environment.physics.speed, environment.physics.yaw_rate))
        if not cameras:  # measured before the robot moves, so that the camera's latency does not matter
            cameras.append(inverse_pose(environment.physics.base_to_world) @ environment.physics.camera_to_world)
        progress.update()

    max_steps = round(environment.task.time_limit / environment.task.options.control_timestep)
    with runtime.bar("drive", max_steps, "step") as progress:
        episode = replace(record_episode(environment, driver, watch), seed=seed)
    obstacles = options.get("obstacles")
    standing = [f"{obstacles}_obstacles"] if isinstance(obstacles, int) else []
    name = film_name(task, episode.lighting, *standing, driver_name, seed)
    path = out or folder / (f"{root.stem}_{name}" if in_cache else name)
    driven, title = environment.task, f"{task.replace('_', ' ')}: {driver_name}"
    limits = driven.segment.start, driven.segment.end
    shown = driven.world, driven.half_width, limits, load_ground_and_parts(scene.scene)
    told = episode.lighting + environment.pixels.lightings[0].mixture
    write_episode_video(path, replace(episode, lighting=told), images, shown, title)
    if rerun:
        place = driven.world, driven.half_width, f"{scene.scene.root.resolve().name}, {title}"
        commands = episode.actions
        if driven.options.action == STEERING:
            commands = np.column_stack([np.full(len(commands), driven.options.speed), commands])
        with atomic_path(rerun) as partial:
            write_rerun_recording(partial, episode, images, np.array(motion), commands, cameras[0], *place)
    return path, episode


def record_dataset(
    root: Path,
    out: Path,
    episodes: int = 1,
    task: str = "right_turn",
    policy: str | None = None,
    seed: int = 0,
    trust: bool = False,
    **options: Any,
) -> list[Episode]:
    """Drives episodes and writes them as a LeRobot dataset, see `twin.report.drive_dataset`; returns the episodes.

    Args:
        root, task, policy, trust, options: See `film`.
        out: The dataset's folder; must not exist.
        episodes: Number of drives, at least 1.
        seed: Seed of the first drive; the other drives have the following seeds. Each is the episode that `film` drives
            with that seed.

    Raises:
        InputError: an error of `film`; `out` exists, or pyarrow is not installed.
    """
    if episodes < 1:
        raise InputError(f"--episodes {episodes}: expected 1 or more")
    require_pyarrow()
    require_absent(out)
    scene = load_scene(root)
    driver, _, options = _driver(scene, policy, seed, trust, options)
    environment = load(scene, task, seed, **options)
    driving, spec = environment.task.options, environment.action_spec()
    names = ("linear_velocity", "angular_velocity")[driving.action == STEERING :]
    actions = {
        name: (float(low), float(high)) for name, low, high in zip(names, spec.minimum, spec.maximum, strict=True)
    }
    words = drive_instruction(scene.scene.root, task)
    pictures: list[np.ndarray] = []
    motion: list[tuple[float, float]] = []

    def watch(step: dm_env.TimeStep) -> None:
        pictures.append(step.observation["pixels"][-1].copy())
        motion.append((environment.physics.speed, environment.physics.yaw_rate))

    recorded = []
    with new_folder(out) as folder, runtime.bar("drives", episodes, "drive") as progress:
        dataset = DriveDataset(folder, driving.size, driving.control_timestep, actions, words)
        for k in range(episodes):
            environment.task.seed(seed + k)
            pictures.clear()
            motion.clear()
            recorded.append(replace(record_episode(environment, driver, watch), seed=seed + k))
            dataset.add(recorded[-1], pictures, np.array(motion))
            progress.update()
        dataset.finish()
    return recorded


def _driver(
    scene: Twin, policy: str | None, seed: int, trust: bool, options: dict[str, Any]
) -> tuple[Driver, str, dict[str, Any]]:
    """The driver, its name, and the environment's options; given options take precedence over those of the policy."""
    if seed < 0:
        raise InputError(f"seed = {seed}: expected 0 or more")
    if not policy:
        return RouteDriver(), "scripted driver", options
    loaded = load_policy(find_policy(scene.scene.root, policy), trust)
    return PolicyDriver(loaded), loaded.name, {**loaded.options(), **options}


def film_name(*parts: str | int) -> str:
    """Name of a film's file, made of parts such as task, lighting, driver and seed."""
    return "".join(c if c.isalnum() or c in "-." else "_" for c in "_".join(map(str, parts))) + ".mp4"


def command(given: argparse.Namespace) -> None:
    """Runs `twin film` with the options parsed by `twin.commands`."""
    obstacles = given.obstacles
    if obstacles != "scene":
        if not obstacles.isdecimal() or len(obstacles) > _MAX_DIGITS:  # isdigit accepts "²"
            most = 10**_MAX_DIGITS - 1
            raise InputError(f"--obstacles {obstacles!r}: expected 0 to {most}, or 'scene' for those of scene.toml")
        obstacles = int(obstacles)
    options = {"lighting_drift": given.drift, "randomise": given.randomise, "obstacles": obstacles}
    options |= film_options(given.lighting)
    driven = (given.task, given.policy, given.seed)
    if given.lerobot:
        if given.out:
            raise InputError("--out names a film, but --lerobot DIR writes a dataset instead; leave out --out")
        if given.rerun:
            raise InputError("--rerun records one drive, and --lerobot DIR several; leave out one of them")
        drives = record_dataset(given.scene, given.lerobot, given.episodes, *driven, given.trust, **options)
        if not given.quiet:
            print(drives_summary(drives, given.lerobot))
        return
    if given.episodes != 1:
        raise InputError(f"--episodes {given.episodes}: a film shows one drive; for several, use --lerobot DIR")
    path, episode = film(given.scene, *driven, given.out, given.trust, given.rerun, **options)
    if not given.quiet:
        print(summary(path, episode))
        if given.rerun:
            print(f"look at it: rerun {given.rerun}")


def film_options(lighting: str | None) -> dict[str, Any]:
    """Options of the environment that `--lighting` determines."""
    if not lighting:
        return {}
    return {name: value for name, value in condition_options(Condition.parse(lighting)).items() if value}


def summary(path: Path, episode: Episode) -> str:
    """One line with the end of the drive and the path of its film."""
    return f"{episode.cause or 'cut off'} after {episode.progress[-1]:.1f} m and {episode.times[-1]:.1f} s: {path}"


if __name__ == "__main__":
    sys.exit(commands.main("film"))
