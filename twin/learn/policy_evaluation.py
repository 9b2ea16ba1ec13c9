"""Evaluation of policies on numbered episodes of a task, on this machine or a cluster, and selection of a checkpoint.

An *episode* is determined by its seed and lighting: start, robot and light do not depend on the policy, the machine or
the episodes beside it. So all policies drive the same episodes, and a campaign can be cut into *chunks* that run in any
order.
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
from twin.env.domain_randomization import Ranges, lighting_options
from twin.env.suite import EnvFactory
from twin.env.vector_env import make_vector_env
from twin.env.vector_env_local import LocalVectorEnv
from twin.env.vector_env_processes import ProcessVectorEnv
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE_FILE
from twin.files import read_json, wrap_read_errors, write_json
from twin.learn.checkpoint import saved_steps
from twin.learn.policy import Policy, copy_policy, load_policy
from twin.learn.train_config import TrainConfig
from twin.loading import Twin, load_scene
from twin.runtime import die_with_parent, ignore_terminal_signals, signals_held, signals_kept

CHUNK = 16
"""Most episodes of a chunk, which one process drives."""

_ENVS = 8  # episodes driven at once
_SAMPLED_LIGHTING = re.compile(r"drawn_(\d+)")


@dataclass(frozen=True)
class EpisodeChunk:
    """Episodes of one policy under one lighting."""

    scene: str
    task: str
    source: str
    """See `load_policy`."""
    trust: bool
    lighting: str
    """See `env/episode_lighting.py`; or `drawn_<number>`, see `with_sampled_lighting`. With `+randomised`, robot,
    weather and distractor objects are randomized as far as they are not known, see `env/domain_randomization.py`."""
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode."""

    seed: int
    cause: str
    progress: float
    """[m]"""
    steps: int
    trust: float
    """Mean over the episode's pictures."""
    reward: float
    """Sum over the episode."""


def run_chunk(chunk: EpisodeChunk) -> list[EpisodeResult]:
    """Drives the episodes of a chunk; returns results in the order of its seeds.

    Raises InputError: the policy, scene, task or lighting does not exist.
    """
    envs = _vector_env(chunk.scene, chunk.task, chunk.source, chunk.trust, chunk.lighting)
    return run_episodes(_policy(chunk.source, chunk.trust), envs, chunk.seeds)


def run_episodes(
    policy: Policy,
    envs: LocalVectorEnv | ProcessVectorEnv,
    seeds: Sequence[int],
    watch: Callable[[], object] = lambda: None,
) -> list[EpisodeResult]:
    """Drives an episode per seed, in all environments at once; returns results in the order of the seeds.

    Args:
        envs: With pictures; their current episodes are abandoned.
        seeds: Of the episodes.
    """
    assert envs.pixels is not None
    waiting = list(range(len(seeds)))
    driving: dict[int, int] = {}  # environment → number of its episode
    trusts: list[list[float]] = [[] for _ in seeds]
    rewards = np.zeros(len(seeds))
    done: dict[int, EpisodeResult] = {}
    while waiting or driving:
        free = [i for i in range(len(envs)) if i not in driving][: len(waiting)]
        for i in free:
            driving[i] = waiting.pop(0)
            envs.seed(i, seeds[driving[i]])
        envs.begin(free)
        which = sorted(driving)
        for i in which:
            trusts[driving[i]].append(float(envs.pixels.trust[i]))
        pictures = envs.observation()
        # One by one: a batch sums in another order, and the last bit can decide whether a robot hits the kerb.
        out = envs.step(np.stack([policy(pictures[i]) for i in which]), which)
        rewards[[driving[i] for i in which]] += out.reward
        for i in [i for i, ended in zip(which, out.over, strict=True) if ended]:
            number, info = driving.pop(i), envs.info(i)
            seen = trusts[number]
            outcome = info["cause"], info["progress"], len(seen), float(np.mean(seen)), float(rewards[number])
            done[number] = EpisodeResult(seeds[number], *outcome)
            watch()
    return [done[number] for number in range(len(seeds))]


def campaign(chunks: Sequence[EpisodeChunk], processes: int = 1) -> Iterator[list[EpisodeResult]]:
    """Drives chunks; yields their results in order, each as soon as it and all earlier ones are done.

    Args:
        processes: Worker processes on this machine; they end with this one, however it ends.

    Raises:
        InputError: an error of `run_chunk`, or a process ended, most likely because memory ran out.
    """
    if processes == 1:
        yield from map(run_chunk, chunks)
    else:
        # Spawned, since the threads of Warp and MuJoCo do not survive a fork.
        count = min(processes, max(1, len(chunks)))
        pool = ProcessPoolExecutor(count, get_context("spawn"), _init_worker, (os.getpid(),))
        try:
            with signals_held():  # workers start here; this process handles a terminal's signals
                driven = pool.map(run_chunk, chunks)
            yield from driven
        except BrokenProcessPool:
            raise InputError(
                f"one of {processes} processes ended; if memory ran out, use fewer (--processes 1: none)"
            ) from None
        finally:
            if sys.exc_info()[0] is not None:  # do not wait for the remaining chunks
                for worker in active_children():
                    worker.kill()
            pool.shutdown(cancel_futures=True)


def with_sampled_lighting(factory: EnvFactory, number: int) -> EnvFactory:
    """Adds a lighting `drawn_<number>` to the factory's field, sampled from the filmed ones with that seed."""
    assert factory.field is not None
    name = f"drawn_{number}"
    if name not in factory.field.lightings:
        # Of the filmed ones, so that lightings sampled before do not change the result.
        filmed = factory.field.lightings_by_name.filmed()
        factory.field.add_lightings({name: filmed.sample(np.random.default_rng(number))})
    return factory


def _init_worker(parent: int) -> None:
    """Initializes a worker process."""
    ignore_terminal_signals()
    die_with_parent(parent)


@lru_cache(maxsize=4)
def _policy(source: str, trust: bool) -> Policy:
    return load_policy(source, trust)


@lru_cache(maxsize=1)
def _factory(scene: str, task: str, source: str, trust: bool, randomise: Ranges | None) -> EnvFactory:
    return EnvFactory.open(load_scene(scene), task, {**_policy(source, trust).options(), "randomise": randomise})


@lru_cache(maxsize=1)
def _vector_env(scene: str, task: str, source: str, trust: bool, lighting: str) -> LocalVectorEnv:
    options = lighting_options(lighting)
    factory = _factory(scene, task, source, trust, options["randomise"])
    sampled = _SAMPLED_LIGHTING.fullmatch(options["lighting"])
    if sampled:
        factory = with_sampled_lighting(factory, int(sampled[1]))
    lit = dataclasses.replace(factory.options, lighting=options["lighting"])
    return LocalVectorEnv(dataclasses.replace(factory, options=lit), [None] * _ENVS)


# ---- campaigns on a Ray cluster

_CORES = 2  # that a chunk uses
_CONNECT_TIMEOUT = 5.0  # [s]


def campaign_on_ray(chunks: Sequence[EpisodeChunk], address: str) -> Iterator[list[EpisodeResult]]:
    """Same as `campaign`, on the cluster at an address (`auto`: the one that runs on this machine).

    Its nodes need `twin` and the scene and the policies under the same paths, such as on a shared disk.

    Raises:
        InputError: Ray is not installed, there is no such cluster, or an error of `run_chunk`.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # silences a warning of Ray on GPUs
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs more: pip install .[ray]") from None
    try:
        if address != "auto":  # Ray itself retries for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), _CONNECT_TIMEOUT).close()
        with signals_kept():  # Ray replaces the handler of SIGTERM
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"--ray {address}: no cluster there ({first}); start one with `ray start --head`") from None
    try:
        # No more cores than the largest node has, or the tasks would wait for ever.
        cores = max((node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
        if cores < 1:
            raise InputError(f"--ray {address}: no node of the cluster has a core to give; start one with `ray start`")
        # By default Ray fills one node before it uses the next.
        remote = ray.remote(num_cpus=int(min(_CORES, cores)), scheduling_strategy="SPREAD")(run_chunk)
        for driven in [remote.remote(chunk) for chunk in chunks]:
            yield ray.get(driven)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        raise
    finally:
        ray.shutdown()


# ---- selection of a checkpoint

FRESH_EPISODES = 20
"""Fresh episodes of the selected policy."""

_CANDIDATES = 4
_SEED_STREAM = 7  # seeds of these episodes come from the run's seed and this


def select_checkpoint(twin: Twin, folder: Path, config: TrainConfig, processes: int | None = None) -> dict[str, Any]:
    """Selects the best policy of a finished training as the run's; keeps an earlier selection of the same training.

    *Candidates*, policies saved in the second half of the training, drive the same episodes without exploration: whole
    ones with the training's lighting and randomization and their own seeds. The one with most successes is selected,
    among equals the one with the highest mean reward. Since the best of several was also lucky, its reported success
    rate comes from fresh episodes.

    Args:
        config: Of the run; `trials` is the number of episodes per candidate.

    Returns:
        The content of `choice.json`: steps of the training; step, trials, successes and mean reward of every candidate,
        and of the selected one on fresh episodes.
    """
    trained = saved_steps(folder / "state")
    if (folder / CHOICE_FILE).exists():
        with wrap_read_errors(folder / CHOICE_FILE, "delete it, and the best policy is selected again"):
            before = read_json(folder / CHOICE_FILE)
            if before["steps"] == trained:
                _ = [before["chosen"][name] + 0 for name in ("step", "trials", "successes")]
                return before
    candidates = _candidates(folder / "checkpoints", trained)
    samples = np.random.SeedSequence([config.seed, _SEED_STREAM]).generate_state(config.trials + FRESH_EPISODES)
    seeds = tuple(int(seed) for seed in samples)
    shared, fresh = seeds[: config.trials], seeds[config.trials :]
    options = {**config.options(), "start_along": 0.0}
    results = []
    bar = runtime.bar("choose", len(candidates) * len(shared) + len(fresh), "episode")
    with closing(make_vector_env(twin, config.task, options, [None] * config.worlds, processes)) as envs, bar:

        def evaluate(path: Path, which: tuple[int, ...]) -> dict[str, Any]:
            return {"step": int(path.name)} | _totals(run_episodes(load_policy(path), envs, which, bar.update))

        for path in candidates:
            results.append(evaluate(path, shared))
        best = max(range(len(results)), key=lambda i: (results[i]["successes"], results[i]["reward"]))
        last = evaluate(candidates[best], fresh)
    copy_policy(candidates[best], folder)
    out = {"steps": trained, "candidates": results, "chosen": last}
    write_json(folder / CHOICE_FILE, out)
    return out


def _candidates(folder: Path, steps: int) -> list[Path]:
    """At most `_CANDIDATES` evenly spaced policies of the second half, the last one included."""
    late = sorted(path for path in folder.iterdir() if steps / 2 < int(path.name))
    return late[:: -max(1, -(-len(late) // _CANDIDATES))][::-1]


def _totals(results: list[EpisodeResult]) -> dict[str, Any]:
    won = sum(one.cause == "goal" for one in results)
    return {
        "trials": len(results),
        "successes": won,
        "reward": round(float(np.mean([one.reward for one in results])), 3),
    }
