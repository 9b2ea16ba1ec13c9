"""Driving policies through numbered episodes of a task, to judge them.

An *episode* is decided by its seed and its lighting; whoever drives it, on whatever machine, beside whichever others,
meets the same start, robot and light. So policies are compared on the same episodes, and a campaign can be cut into
*chunks*, done in any order and anywhere, and put together again.
"""

import dataclasses
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import active_children, get_context

import numpy as np

from twin.child import die_with_parent, ignore_stops
from twin.env.batch import Worlds
from twin.env.process_worlds import ProcessWorlds
from twin.env.randomisation import Ranges, asked
from twin.env.suite import Stage
from twin.errors import InputError
from twin.learn.policy import Policy, load_policy
from twin.loading import load_scene
from twin.verb import signals_held

CHUNK = 16
"""Episodes at most that are driven by one process in one go."""

_WORLDS = 8  # at once
_DRAWN = re.compile(r"drawn_(\d+)")


@dataclass(frozen=True)
class Chunk:
    """Episodes of one policy under one lighting."""

    scene: str
    task: str
    source: str
    """See `load_policy`."""
    trust: bool
    lighting: str
    """See `env/lightings.py`; or `drawn_<number>`: the light that this seed draws, see `drawn_light`. With
    `+randomised` robot, weather and bystanders are drawn for every episode, too, as far as they are not known, see
    `env/randomisation.py`."""
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Driven:
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


def drive(chunk: Chunk) -> list[Driven]:
    """Drives the episodes of a chunk; in the order of their seeds.

    Raises:
        InputError: the policy, scene, task or lighting is not to be had.
    """
    worlds = _worlds(chunk.scene, chunk.task, chunk.source, chunk.trust, chunk.lighting)
    return episodes(_policy(chunk.source, chunk.trust), worlds, chunk.seeds)


def episodes(
    policy: Policy, worlds: Worlds | ProcessWorlds, seeds: Sequence[int], watch: Callable[[], object] = lambda: None
) -> list[Driven]:
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
    done: dict[int, Driven] = {}
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
            done[number] = Driven(seeds[number], *outcome)
            watch()
    return [done[number] for number in range(len(seeds))]


def campaign(chunks: Sequence[Chunk], processes: int = 1) -> Iterator[list[Driven]]:
    """Drives chunks; what became of them, in their order, each as soon as it and those before it are done.

    Args:
        chunks: What to drive.
        processes: How many on this machine. They end when this one does, however it does.

    Raises:
        InputError: as `drive`, or a process ended, for want of memory most likely.
    """
    if processes == 1:
        yield from map(drive, chunks)
    else:
        # Warp and MuJoCo have threads, which a fork would not survive.
        pool = ProcessPoolExecutor(min(processes, max(1, len(chunks))), get_context("spawn"), _begin, (os.getpid(),))
        try:
            with signals_held():  # the workers are started here; a signal to all of a terminal's is for us
                driven = pool.map(drive, chunks)
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


def drawn_light(stage: Stage, number: int) -> Stage:
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
def _stage(scene: str, task: str, source: str, trust: bool, randomise: Ranges | None) -> Stage:
    return Stage.open(load_scene(scene), task, {**_policy(source, trust).options(), "randomise": randomise})


@lru_cache(maxsize=1)
def _worlds(scene: str, task: str, source: str, trust: bool, lighting: str) -> Worlds:
    options = asked(lighting)
    stage = _stage(scene, task, source, trust, options["randomise"])
    drawn = _DRAWN.fullmatch(options["lighting"])
    if drawn:
        stage = drawn_light(stage, int(drawn[1]))
    lit = dataclasses.replace(stage.options, lighting=options["lighting"])
    return Worlds(dataclasses.replace(stage, options=lit), [None] * _WORLDS)
