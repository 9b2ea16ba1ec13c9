"""Evaluation of policies on numbered episodes of a task, on this machine or a Ray cluster.

Seed and lighting determine an *episode*: its start, robot and light do not depend on the policy, the machine or other
episodes. So all policies drive the same episodes, and *chunks*, groups of episodes that one process drives, can run in
any order.
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
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import active_children, get_context

import numpy as np

from twin.config import SAMPLED_LIGHTING, Condition
from twin.env.domain_randomization import Ranges, condition_options
from twin.env.env_factory import EnvFactory
from twin.env.vector_env import ProcessVectorEnv
from twin.env.vector_env_local import LocalVectorEnv
from twin.errors import InputError
from twin.learn.policy import Policy, load_policy
from twin.loading import load_scene
from twin.runtime import die_with_parent, ignore_terminal_signals, signals_held, signals_kept

CHUNK = 16
"""Largest number of episodes in a chunk."""

_ENVS = 8  # number of episodes driven in parallel
_SAMPLED_LIGHTING = re.compile(rf"{SAMPLED_LIGHTING}(\d+)")


@dataclass(frozen=True)
class EpisodeChunk:
    """Episodes of one policy under one lighting; see `load_policy` for `source` and `trust`."""

    scene: str
    task: str
    source: str
    trust: bool
    condition: Condition
    """The condition's lighting may be `drawn_<number>`, see `with_sampled_lighting`."""
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class EpisodeResult:
    """Result of an episode, with progress [m], mean trust (`env/trust.py`), and sum of its rewards.

    `lighting` is the lighting's name and, if it was sampled, its mixture; see `LocalVectorEnv.info`.
    """

    seed: int
    cause: str
    progress: float
    steps: int
    trust: float
    reward: float
    lighting: str = ""


def run_chunk(chunk: EpisodeChunk) -> list[EpisodeResult]:
    """Drives a chunk; returns results in the order of its seeds.

    Raises InputError: the policy, scene, task or lighting is unknown.
    """
    envs = _vector_env(chunk.scene, chunk.task, chunk.source, chunk.trust, chunk.condition)
    return run_episodes(_policy(chunk.source, chunk.trust), envs, chunk.seeds)


def run_episodes(
    policy: Policy,
    envs: LocalVectorEnv | ProcessVectorEnv,
    seeds: Sequence[int],
    watch: Callable[[], object] = lambda: None,
    among: Sequence[int] | None = None,
) -> list[EpisodeResult]:
    """Drives one episode per seed, in parallel environments; returns results in the order of the seeds.

    Args:
        envs: Environments that render pictures.
        watch: Called after every episode.
        among: The environments that are used, whose current episodes are abandoned; None: all.
    """
    assert envs.pixels is not None
    among = range(len(envs)) if among is None else among
    waiting = list(range(len(seeds)))
    driving: dict[int, int] = {}  # environment → number of its episode
    trusts: list[list[float]] = [[] for _ in seeds]
    rewards = np.zeros(len(seeds))
    done: dict[int, EpisodeResult] = {}
    while waiting or driving:
        free = [i for i in among if i not in driving][: len(waiting)]
        for i in free:
            driving[i] = waiting.pop(0)
            envs.seed(i, seeds[driving[i]])
        envs.begin(free)
        which = sorted(driving)
        for i in which:
            trusts[driving[i]].append(float(envs.pixels.trust[i]))
        pictures = envs.observation()
        # The policy gets one stack of pictures at a time: in a batch, sums have another order, and the last bit of an
        # action can decide whether a robot hits the curb.
        out = envs.step(np.stack([policy(pictures[i]) for i in which]), which)
        rewards[[driving[i] for i in which]] += out.reward
        for i in [i for i, ended in zip(which, out.over, strict=True) if ended]:
            number, info = driving.pop(i), envs.info(i)
            trust = trusts[number]
            outcome = info["cause"], info["progress"], len(trust), float(np.mean(trust)), float(rewards[number])
            done[number] = EpisodeResult(seeds[number], *outcome, info.get("sampled_lighting", info["lighting"]))
            watch()
    return [done[number] for number in range(len(seeds))]


def run_chunks(chunks: Sequence[EpisodeChunk], processes: int = 1, fresh: bool = True) -> Iterator[list[EpisodeResult]]:
    """Drives chunks on this machine, in several worker processes or in this one; yields the chunks' results in order.

    In this process, policies and scenes that an earlier call has loaded are loaded again, since their files may have
    changed, unless `fresh` is false. The workers end with this process.

    Raises InputError: an error of `run_chunk`, or a worker ended, most likely because memory ran out.
    """
    if processes == 1:
        if fresh:
            for cache in (_policy, _factory, _vector_env):
                cache.cache_clear()
        yield from map(run_chunk, chunks)
        return
    # Workers are spawned, since the threads of Warp and MuJoCo do not survive a fork.
    count = min(processes, max(1, len(chunks)))
    pool = ProcessPoolExecutor(count, get_context("spawn"), _init_worker, (os.getpid(),))
    try:
        # Workers start with signals blocked: Ctrl+C cannot end one before it ignores signals. This process handles it.
        with signals_held():
            driven = pool.map(run_chunk, chunks)
        yield from driven
    except BrokenProcessPool:
        cure = "if memory ran out, use fewer (--processes 1 starts none)"
        raise InputError(f"one of {processes} processes ended; {cure}") from None
    finally:
        if sys.exc_info()[0] is not None:  # do not wait for the remaining chunks
            for worker in active_children():
                worker.kill()
        pool.shutdown(cancel_futures=True)


def with_sampled_lighting(factory: EnvFactory, number: int) -> EnvFactory:
    """Adds a lighting `drawn_<number>` to the factory's field: sampled from the filmed ones, with `number` as seed."""
    assert factory.field is not None
    name = f"{SAMPLED_LIGHTING}{number}"
    if name not in factory.field.lightings:
        # Sampled from the filmed lightings only, so that lightings sampled earlier have no effect.
        filmed = factory.field.lightings_by_name.filmed()
        factory.field.add_lightings({name: filmed.sample(np.random.default_rng(number))})
    return factory


def _init_worker(parent: int) -> None:
    ignore_terminal_signals()
    die_with_parent(parent)


@lru_cache(maxsize=4)
def _policy(source: str, trust: bool) -> Policy:
    return load_policy(source, trust)


@lru_cache(maxsize=1)
def _factory(scene: str, task: str, source: str, trust: bool, randomise: Ranges | None) -> EnvFactory:
    return EnvFactory.open(load_scene(scene), task, {**_policy(source, trust).options(), "randomise": randomise})


@lru_cache(maxsize=1)
def _vector_env(scene: str, task: str, source: str, trust: bool, condition: Condition) -> LocalVectorEnv:
    options = condition_options(condition)
    factory = _factory(scene, task, source, trust, options["randomise"])
    sampled = _SAMPLED_LIGHTING.fullmatch(condition.lighting)
    if sampled:
        factory = with_sampled_lighting(factory, int(sampled[1]))
    lit = dataclasses.replace(factory.options, lighting=condition.lighting)
    return LocalVectorEnv(dataclasses.replace(factory, options=lit), [None] * _ENVS)


# ---- campaigns on a Ray cluster

_CORES = 2  # number of CPU cores that a chunk uses
_CONNECT_TIMEOUT = 5.0  # [s]


def run_chunks_on_ray(chunks: Sequence[EpisodeChunk], address: str) -> Iterator[list[EpisodeResult]]:
    """Does the same as `run_chunks` on a Ray cluster; the address `auto` stands for the cluster on this machine.

    Every node needs `twin`, and scene and policies under the same paths as here. Raises InputError: Ray is not
    installed, there is no such cluster, or an error of `run_chunk`.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # silences a warning of Ray on GPUs
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs the package ray: pip install 'twin[ray]'") from None
    try:
        if address != "auto":  # checked here, since Ray retries for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), _CONNECT_TIMEOUT).close()
        with signals_kept():  # Ray replaces the handler of SIGTERM
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"--ray {address}: no cluster there ({first}); start one with `ray start --head`") from None
    try:
        # A task that asks for more cores than the largest node has would wait for ever.
        cores = max((node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]), default=0.0)
        if cores < 1:
            raise InputError(f"--ray {address}: no node of the cluster offers a CPU core; start one with `ray start`")
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
