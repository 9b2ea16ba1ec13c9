"""Many worlds on a CPU, a few in each of several processes.

Much of a step is Python, which does one thing at a time in a process however many cores there are: what is in view,
what is touched, the judge. So each *child* (`vector_env_child.py`) has `Worlds` of its own and does with them what its
parent asks. They talk in pickles, over a socket of their own. A world goes through the same in any process.
"""

import contextlib
import copy
import os
import pickle
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.env.options import parse_options
from twin.env.task import checked_actions
from twin.env.vector_env_local import StepResult, frame_stack
from twin.errors import InputError
from twin.loading import Twin


@dataclass(frozen=True)
class StepMessage:
    """What a child's worlds came to."""

    pictures: NDArray[np.uint8] | None
    """The newest of each, shape (k, 3, height, width)."""
    trust: NDArray[np.float64]
    states: NDArray[np.float32]
    infos: list[dict[str, Any]]
    outcome: StepResult | None = None


@dataclass(frozen=True)
class StackedPictures:
    """What the worlds' cameras saw; see `Pixels`."""

    stacks: NDArray[np.uint8]
    trust: NDArray[np.float64]


class ProcessVectorEnv:
    """n worlds of one scene and task, spread over processes: `Worlds`, but for `physics`, `tasks` and most of `pixels`,
    which are elsewhere."""

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
        parts = np.array_split(np.arange(count), processes)
        self._home = [(c, k) for c, part in enumerate(parts) for k in range(len(part))]
        self._lock = threading.Lock()
        self._children: list[_Child] = []
        self._end = weakref.finalize(self, _end, self._children)
        try:
            for _ in parts:
                self._children.append(_Child(max(1, runtime.cores() // processes)))
            quiet = [runtime.is_quiet() or c > 0 for c in range(processes)]  # one shows what all of them wait for
            mine = [[seeds[i] for i in part] for part in parts]
            opened = self._ask({c: ("open", quiet[c], scene, task, options, mine[c]) for c in range(processes)})
        except BaseException:
            self.close()
            raise
        self.actions, self.states = opened[0]
        width, height = self.options.size
        shape = count, self.options.stack, 3, height, width
        self.pixels = StackedPictures(np.zeros(shape, np.uint8), np.zeros(count)) if self.options.pixels else None
        self._states = np.zeros((count, self.states), np.float32)
        self._infos: list[dict[str, Any] | None] = [None] * count
        """As last told; None where it may be another by now."""

    def __len__(self) -> int:
        return len(self._home)

    def seed(self, i: int, seed: int | None) -> None:
        self._of(i, "seed", seed)

    def begin(self, which: Sequence[int]) -> None:
        some = np.asarray(which, int)
        parts = list(self._split(some))
        news = self._ask({c: ("begin", local) for c, _, local in parts})
        for c, at, _ in parts:
            self._take(some[at], news[c], fills=True)

    def step(self, actions: NDArray, which: Sequence[int] | None = None) -> StepResult:
        some = np.arange(len(self)) if which is None else np.asarray(which, int)
        actions = checked_actions(actions, (len(some), self.actions))
        parts = list(self._split(some))
        news = self._ask({c: ("step", actions[at], local) for c, at, local in parts})
        out = StepResult(np.zeros(len(some)), np.zeros(len(some), bool), np.zeros(len(some), bool))
        for c, at, _ in parts:
            self._take(some[at], news[c], fills=False)
            part = news[c].outcome
            out.reward[at], out.terminated[at], out.truncated[at] = part.reward, part.terminated, part.truncated
        return out

    def observation(self) -> NDArray:
        return frame_stack(self.pixels.stacks) if self.pixels else self._states.copy()

    def state(self, i: int) -> NDArray[np.float32]:
        return self._states[i].copy()

    def info(self, i: int) -> dict[str, Any]:
        told = self._infos[i]
        return self._of(i, "info") if told is None else copy.deepcopy(told)

    def get(self, i: int, name: str) -> Any:
        return self._of(i, "get", name)

    def set(self, i: int, name: str, value: Any) -> None:
        self._infos[i] = None
        self._of(i, "set", name, value)

    def call(self, i: int, name: str, *args: Any, **kwargs: Any) -> Any:
        self._infos[i] = None
        return self._of(i, "call", name, *args, **kwargs)

    def close(self) -> None:
        self._end()

    def _split(self, some: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64], list[int]]]:
        """Children that have some of these worlds: which of `some` these are, and their numbers there."""
        homes = np.array([self._home[i] for i in some.tolist()]).reshape(-1, 2)
        for c in np.unique(homes[:, 0]).tolist():
            at = np.flatnonzero(homes[:, 0] == c)
            yield c, at, homes[at, 1].tolist()

    def _of(self, i: int, what: str, *args: Any, **kwargs: Any) -> Any:
        c, local = self._home[i]
        return self._ask({c: (what, local, *args)}, kwargs)[c]

    def _ask(self, requests: dict[int, tuple[Any, ...]], keywords: dict[str, Any] | None = None) -> dict[int, Any]:
        """Has children do something, all at the same time; what came of it."""
        messages = {c: pickled((*request, keywords or {})) for c, request in requests.items()}
        with self._lock:
            if not self._end.alive:
                raise InputError(
                    "these worlds are closed, be it that a step was interrupted or one of their processes ended; "
                    "expected open ones, so make them anew"
                )
            try:
                for c, message in messages.items():
                    self._children[c].tell(message)
                replies = {c: self._children[c].hear() for c in requests}  # of all, even if one fails
            except BaseException:  # some have been told, or heard, and others not
                self.close()
                raise
        for failed, _ in replies.values():
            if failed:
                raise failed
        return {c: said for c, (_, said) in replies.items()}

    def _take(self, which: NDArray[np.int64], news: StepMessage, fills: bool) -> None:
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
        self.pipe, theirs = Pipe()
        path = os.pathsep.join(str(folder or Path.cwd()) for folder in sys.path)
        with theirs:
            self.process = subprocess.Popen(
                # -P: it imports what this process would, not what else lies in the current folder.
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "twin.env.vector_env_child",
                    *map(str, (theirs.fileno(), os.getpid(), share)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                process_group=0,  # Ctrl-C is for the parent, who may want to save first
                env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": str(share)},
            )

    def tell(self, message: bytes) -> None:
        with contextlib.suppress(OSError):  # `hear` says why
            self.pipe.send_bytes(message)

    def hear(self) -> tuple[Exception | None, Any]:
        try:
            return pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            code = self.process.wait()
            raise InputError(
                f"a process of worlds ended with exit status {code}; expected it to go on. "
                + ("If memory ran out, take fewer processes (1: none)" if code == -9 else "It may have said why above")
            ) from None


def _end(children: list[_Child]) -> None:
    """Ends children, which have nothing to save."""
    for child in children:
        child.pipe.close()
        child.process.kill()
    for child in children:
        child.process.wait()


def pickled(thing: Any) -> bytes:
    return pickle.dumps(thing, pickle.HIGHEST_PROTOCOL)
