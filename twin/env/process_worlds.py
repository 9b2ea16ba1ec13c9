"""Many worlds on a CPU, a few in each of several processes.

Much of a step is Python, which does one thing at a time in a process however many cores there are: what is in view,
what is touched, the judge. So each *child* (`world_process.py`) has `Worlds` of its own and does with them what its
parent asks. They talk in pickles, over a socket that nobody else has. A world goes through the same in any process.
"""

import contextlib
import os
import pickle
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import cores, progress
from twin.env.batch import Outcome
from twin.env.options import parse_options
from twin.errors import InputError
from twin.loading import Twin

BAD_INPUT, BUG = "bad input", "bug"
"""What a reply begins with where there is no result."""


@dataclass(frozen=True)
class News:
    """What a child's worlds came to."""

    pictures: NDArray[np.uint8] | None
    """The newest of each, shape (k, 3, height, width)."""
    trust: NDArray[np.float64]
    states: NDArray[np.float32]
    infos: list[dict[str, Any]]
    outcome: Outcome | None = None


@dataclass(frozen=True)
class Shown:
    """What the worlds' cameras saw; see `Pixels`."""

    stacks: NDArray[np.uint8]
    trust: NDArray[np.float64]


class ProcessWorlds:
    """n worlds of one scene and task, spread over processes. What is public here is as of `Worlds`."""

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str,
        options: dict[str, Any],
        seeds: Sequence[int | None],
        processes: int,
    ) -> None:
        """
        Args:
            scene: See `twin.load`.
            task: See `twin.load`.
            options: See `twin.env.options.Options`.
            seeds: One per world, of its sequence of episodes; None: unpredictable.
            processes: How many, at most as many as worlds.

        Raises:
            InputError: as `Stage.open`.
        """
        self.options, self.processes, count = parse_options(options), processes, len(seeds)
        self._share = np.array_split(np.arange(count), processes)
        share = max(1, cores.cores() // processes)
        self._children = [_Child(share) for _ in self._share]
        self._all = range(processes)
        try:
            quiet = [progress.is_quiet() or c > 0 for c in self._all]  # one shows what all of them wait for
            mine = [[seeds[i] for i in share] for share in self._share]
            opened = self._ask({c: ("open", quiet[c], scene, task, options, mine[c]) for c in self._all})
        except BaseException:
            self.close()
            raise
        self.actions, self.states = opened[0]
        width, height = self.options.size
        shape = count, self.options.stack, 3, height, width
        self.pixels = Shown(np.zeros(shape, np.uint8), np.zeros(count)) if self.options.pixels else None
        self._states = np.zeros((count, self.states), np.float32)
        self._infos: list[dict[str, Any]] = [{} for _ in range(count)]

    def __len__(self) -> int:
        return len(self._infos)

    def seed(self, i: int, seed: int | None) -> None:
        self._of(i, "seed", seed)

    def begin(self, which: Sequence[int]) -> None:
        some = np.asarray(which, int)
        parts = list(self._split(some))
        news = self._ask({c: ("begin", local) for c, _, local in parts})
        for c, at, _ in parts:
            self._take(some[at], news[c], fills=True)

    def step(self, actions: NDArray, which: Sequence[int] | None = None) -> Outcome:
        some = np.arange(len(self)) if which is None else np.asarray(which, int)
        actions = np.asarray(actions, float)
        parts = list(self._split(some))
        news = self._ask({c: ("step", actions[at], local) for c, at, local in parts})
        out = Outcome(np.zeros(len(some)), np.zeros(len(some), bool), np.zeros(len(some), bool))
        for c, at, _ in parts:
            self._take(some[at], news[c], fills=False)
            part = news[c].outcome
            out.reward[at], out.terminated[at], out.truncated[at] = part.reward, part.terminated, part.truncated
        return out

    def observation(self) -> NDArray:
        if self.pixels:
            stacks = self.pixels.stacks
            return stacks.reshape(len(self), -1, *stacks.shape[3:]).copy()
        return self._states.copy()

    def state(self, i: int) -> NDArray[np.float32]:
        return self._states[i].copy()

    def info(self, i: int) -> dict[str, Any]:
        return dict(self._infos[i])

    def get(self, i: int, name: str) -> Any:
        return self._of(i, "get", name)

    def set(self, i: int, name: str, value: Any) -> None:
        self._of(i, "set", name, value)

    def call(self, i: int, name: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(i, "call", name, *args, **kwargs)

    def close(self) -> None:
        for child in self._children:
            child.close()

    def _split(self, some: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64], list[int]]]:
        """Children that have some of these worlds: which of `some` these are, and their numbers there."""
        for c, share in enumerate(self._share):
            at = np.flatnonzero((some >= share[0]) & (some <= share[-1]))
            if len(at):
                yield c, at, (some[at] - share[0]).tolist()

    def _of(self, i: int, what: str, *args: Any, **kwargs: Any) -> Any:
        ((c, _, (local,)),) = self._split(np.array([i]))
        return self._ask({c: (what, local, *args)}, kwargs)[c]

    def _ask(self, requests: dict[int, tuple[Any, ...]], keywords: dict[str, Any] | None = None) -> dict[int, Any]:
        """Has children do something, all at the same time; what came of it."""
        for c, request in requests.items():
            self._children[c].tell((*request, keywords or {}))
        replies = {c: self._children[c].hear() for c in requests}  # of all, even if one fails
        for failed, said in replies.values():
            if failed == BAD_INPUT:
                raise InputError(said)
            if failed:
                raise RuntimeError(f"in a process of worlds:\n{said}")
        return {c: said for c, (_, said) in replies.items()}

    def _take(self, which: NDArray[np.int64], news: News, fills: bool) -> None:
        if self.pixels and news.pictures is not None:
            stacks, new = self.pixels.stacks, news.pictures[:, None]
            stacks[which] = new if fills else np.concatenate([stacks[which][:, 1:], new], 1)
            self.pixels.trust[which] = news.trust
        self._states[which] = news.states
        for i, info in zip(which.tolist(), news.infos, strict=True):
            self._infos[i] = info


class _Child:
    """The parent's end of a child."""

    def __init__(self, share: int) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "twin.env.world_process", str(share)],
                stdin=theirs.fileno(),
                stdout=2,  # whoever prints there does not print into our output
                env=os.environ | {"OMP_NUM_THREADS": str(share)},
            )
        with ours:
            self._pipe = ours.makefile("rwb")  # closed by our death, however it comes; the child then ends, too

    def tell(self, request: tuple[Any, ...]) -> None:
        with contextlib.suppress(OSError):  # `hear` says why
            self._pipe.write(pickled(*request))
            self._pipe.flush()

    def hear(self) -> tuple[str, Any]:
        try:
            return pickle.load(self._pipe)
        except (EOFError, OSError):
            code = self._process.wait()
            return BAD_INPUT, (
                f"a process of worlds ended with exit status {code}; expected it to go on. If memory ran out, "
                "take fewer worlds, or processes=1"
            )

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.close()
        self._process.wait()


def pickled(*thing: Any) -> bytes:
    return pickle.dumps(thing, pickle.HIGHEST_PROTOCOL)
