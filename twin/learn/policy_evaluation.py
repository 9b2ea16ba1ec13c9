"""Driving policies through numbered episodes of a task, to judge them.

An *episode* is decided by its seed and its lighting; whoever drives it, on whatever machine, beside whichever others,
meets the same start, robot and light. So policies are compared on the same episodes, and a campaign can be cut into
*chunks*, done in any order and anywhere, and put together again.
"""

import dataclasses
import logging
import os
import re
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

import numpy as np

from twin import runtime
from twin.cli import signals_held, signals_kept
from twin.env.domain_randomization import Ranges, asked
from twin.env.suite import EnvFactory
from twin.env.vector_env import make_vector_env
from twin.env.vector_env_local import LocalVectorEnv
from twin.env.vector_env_processes import ProcessVectorEnv
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE
from twin.files import damaged, read_json, write_json
from twin.learn.checkpoint import saved_steps
from twin.learn.policy import Policy, copy_policy, load_policy
from twin.learn.train_config import TrainConfig
from twin.loading import Twin, load_scene
from twin.runtime import die_with_parent, ignore_stops

CHUNK = 16
"""Episodes at most that are driven by one process in one go."""

_WORLDS = 8  # at once
_DRAWN = re.compile(r"drawn_(\d+)")


@dataclass(frozen=True)
class EpisodeChunk:
    """Episodes of one policy under one lighting."""

    scene: str
    task: str
    source: str
    """See `load_policy`."""
    trust: bool
    lighting: str
    """See `env/episode_lighting.py`; or `drawn_<number>`: the light that this seed draws, see `drawn_light`. With
    `+randomised` robot, weather and bystanders are drawn for every episode, too, as far as they are not known, see
    `env/domain_randomization.py`."""
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class EpisodeResult:
    """What became of one episode."""

    seed: int
    cause: str
    progress: float
    """[m]"""
    steps: int
    trust: float
    """Mean over its pictures."""
    reward: float
    """Sum."""


def run_chunk(chunk: EpisodeChunk) -> list[EpisodeResult]:
    """Drives the episodes of a chunk; in the order of their seeds.

    Raises:
        InputError: the policy, scene, task or lighting is not to be had.
    """
    worlds = _worlds(chunk.scene, chunk.task, chunk.source, chunk.trust, chunk.lighting)
    return episodes(_policy(chunk.source, chunk.trust), worlds, chunk.seeds)


def episodes(
    policy: Policy,
    worlds: LocalVectorEnv | ProcessVectorEnv,
    seeds: Sequence[int],
    watch: Callable[[], object] = lambda: None,
) -> list[EpisodeResult]:
    """Drives an episode of every seed, as many at once as there are worlds; in the order of the seeds.

    Args:
        policy: What drives.
        worlds: With pictures; what they are at is dropped.
        seeds: Of the episodes.
        watch: Is called when an episode has ended.
    """
    assert worlds.pixels is not None
    waiting = list(range(len(seeds)))
    driving: dict[int, int] = {}  # world → number of its episode
    trusts: list[list[float]] = [[] for _ in seeds]
    rewards = np.zeros(len(seeds))
    done: dict[int, EpisodeResult] = {}
    while waiting or driving:
        free = [i for i in range(len(worlds)) if i not in driving][: len(waiting)]
        for i in free:
            driving[i] = waiting.pop(0)
            worlds.seed(i, seeds[driving[i]])
        worlds.begin(free)
        which = sorted(driving)
        for i in which:
            trusts[driving[i]].append(float(worlds.pixels.trust[i]))
        pictures = worlds.observation()
        # One by one: in a batch the sums are done in another order, and the last bit decides who meets the kerb.
        out = worlds.step(np.stack([policy(pictures[i]) for i in which]), which)
        rewards[[driving[i] for i in which]] += out.reward
        for i in [i for i, ended in zip(which, out.over, strict=True) if ended]:
            number, info = driving.pop(i), worlds.info(i)
            seen = trusts[number]
            outcome = info["cause"], info["progress"], len(seen), float(np.mean(seen)), float(rewards[number])
            done[number] = EpisodeResult(seeds[number], *outcome)
            watch()
    return [done[number] for number in range(len(seeds))]


def campaign(chunks: Sequence[EpisodeChunk], processes: int = 1) -> Iterator[list[EpisodeResult]]:
    """Drives chunks; what became of them, in their order, each as soon as it and those before it are done.

    Args:
        chunks: What to drive.
        processes: How many on this machine. They end when this one does, however it does.

    Raises:
        InputError: as `drive`, or a process ended, for want of memory most likely.
    """
    if processes == 1:
        yield from map(run_chunk, chunks)
    else:
        # Warp and MuJoCo have threads, which a fork would not survive.
        pool = ProcessPoolExecutor(min(processes, max(1, len(chunks))), get_context("spawn"), _begin, (os.getpid(),))
        try:
            with signals_held():  # the workers are started here; a signal to all of a terminal's is for us
                driven = pool.map(run_chunk, chunks)
            yield from driven
        except BrokenProcessPool:
            raise InputError(
                f"one of {processes} processes ended; if memory ran out, take fewer (--processes 1: none)"
            ) from None
        finally:
            if sys.exc_info()[0] is not None:  # no waiting for chunks that nobody wants
                for worker in active_children():
                    worker.kill()
            pool.shutdown(cancel_futures=True)


def drawn_light(stage: EnvFactory, number: int) -> EnvFactory:
    """The stage with a light `drawn_<number>` in its field: one that could have been filmed, drawn with that seed."""
    assert stage.field is not None
    name = f"drawn_{number}"
    if name not in stage.field.lightings:
        # Of the filmed ones: lights drawn before must not change what this number draws.
        filmed = stage.field.lightings_by_name.filmed()
        stage.field.add_lightings({name: filmed.sample(np.random.default_rng(number))})
    return stage


def _begin(parent: int) -> None:
    """In a worker, before its first chunk."""
    ignore_stops()
    die_with_parent(parent)


@lru_cache(maxsize=4)
def _policy(source: str, trust: bool) -> Policy:
    return load_policy(source, trust)


@lru_cache(maxsize=1)
def _stage(scene: str, task: str, source: str, trust: bool, randomise: Ranges | None) -> EnvFactory:
    return EnvFactory.open(load_scene(scene), task, {**_policy(source, trust).options(), "randomise": randomise})


@lru_cache(maxsize=1)
def _worlds(scene: str, task: str, source: str, trust: bool, lighting: str) -> LocalVectorEnv:
    options = asked(lighting)
    stage = _stage(scene, task, source, trust, options["randomise"])
    drawn = _DRAWN.fullmatch(options["lighting"])
    if drawn:
        stage = drawn_light(stage, int(drawn[1]))
    lit = dataclasses.replace(stage.options, lighting=options["lighting"])
    return LocalVectorEnv(dataclasses.replace(stage, options=lit), [None] * _WORLDS)


# ---- Campaigns larger than one machine, on a Ray cluster.
#
# Its nodes need `twin`, and see the scene and the policies under the same paths, as on a shared disk.


_CORES = 2  # that driving a chunk keeps busy
_PATIENCE = 5.0  # [s]


def campaign_on_ray(chunks: Sequence[EpisodeChunk], address: str) -> Iterator[list[EpisodeResult]]:
    """As `judging.campaign`, on the cluster at an address (`auto`: the one that runs on this machine).

    Raises:
        InputError: Ray is not installed, there is no such cluster, or what `drive` raises.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray warns that it will leave GPUs alone
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs more: pip install .[ray]") from None
    try:
        if address != "auto":  # Ray itself would try for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), _PATIENCE).close()
        with signals_kept():  # Ray takes SIGTERM for itself
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"--ray {address}: no cluster there ({first}); start one with `ray start --head`") from None
    try:
        # No more than the largest node has, or the tasks would wait for ever.
        cores = max((node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
        if cores < 1:
            raise InputError(f"--ray {address}: no node of the cluster has a core to give; start one with `ray start`")
        # Spread: by default Ray fills one node before it uses the next.
        remote = ray.remote(num_cpus=int(min(_CORES, cores)), scheduling_strategy="SPREAD")(run_chunk)
        for driven in [remote.remote(chunk) for chunk in chunks]:
            yield ray.get(driven)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        raise
    finally:
        ray.shutdown()


# ---- Which of a training's policies is its best; the last need not be.
#
# When all steps are done, *candidates*, policies saved in the second half, drive the same episodes without exploring.
# These are whole episodes of the kind that was trained on, in its lights and with its robots, of seeds of their own. The
# one that arrives most often is the run's policy; of those alike, the one that earns most. Because the best of several
# was lucky, too, it drives *fresh* episodes at the end, and its rate in training is told of these alone.


FRESH = 20
"""Episodes that the chosen one drives at the end."""

_CANDIDATES = 4
_STREAM = 7  # with a run's seed, what the seeds of these episodes are drawn from


def select_checkpoint(twin: Twin, folder: Path, config: TrainConfig, processes: int | None = None) -> dict[str, Any]:
    """Makes the best policy of a finished training the run's; does nothing where that is done.

    Args:
        twin: What was trained in.
        folder: Of the run.
        config: Of the run; `trials` is the number of episodes each candidate drives.
        processes: See `worlds_of`.

    Returns:
        What `choice.json` holds: steps that were trained; for every candidate its step, trials, successes and mean
        reward; step, trials and successes of the chosen one, of fresh episodes.
    """
    trained = saved_steps(folder / "state")
    if (folder / CHOICE).exists():
        with damaged(folder / CHOICE, "delete it, and the best policy is chosen again"):
            before = read_json(folder / CHOICE)
            if before["steps"] == trained:
                _ = [before["chosen"][name] + 0 for name in ("step", "trials", "successes")]
                return before
    candidates = _candidates(folder / "checkpoints", trained)
    drawn = np.random.SeedSequence([config.seed, _STREAM]).generate_state(config.trials + FRESH)
    seeds = tuple(int(seed) for seed in drawn)
    shared, fresh = seeds[: config.trials], seeds[config.trials :]
    options = {**config.options(), "start_along": 0.0}
    tried = []
    bar = runtime.bar("choose", len(candidates) * len(shared) + len(fresh), "episode")
    with closing(make_vector_env(twin, config.task, options, [None] * config.worlds, processes)) as worlds, bar:

        def told(path: Path, which: tuple[int, ...]) -> dict[str, Any]:
            return {"step": int(path.name)} | _summed(episodes(load_policy(path), worlds, which, bar.update))

        for path in candidates:
            tried.append(told(path, shared))
        best = max(range(len(tried)), key=lambda i: (tried[i]["successes"], tried[i]["reward"]))
        last = told(candidates[best], fresh)
    copy_policy(candidates[best], folder)
    out = {"steps": trained, "candidates": tried, "chosen": last}
    write_json(folder / CHOICE, out)
    return out


def _candidates(folder: Path, steps: int) -> list[Path]:
    """Of the second half, as far apart as gives few enough; the last one always."""
    late = sorted(path for path in folder.iterdir() if steps / 2 < int(path.name))
    return late[:: -max(1, -(-len(late) // _CANDIDATES))][::-1]


def _summed(driven: list[EpisodeResult]) -> dict[str, Any]:
    won = sum(one.cause == "goal" for one in driven)
    return {"trials": len(driven), "successes": won, "reward": round(float(np.mean([d.reward for d in driven])), 3)}
