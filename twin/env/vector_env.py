"""Vector environments: `make_vector_env` steps n environments in one process, in several processes, or on a GPU.

Much of a step is Python code (visibility, contacts, reward), which the interpreter's lock limits to one core per
process. So a `ProcessVectorEnv` starts *child* processes. Each child process has a `LocalVectorEnv` and executes its
parent's requests. Requests and replies are sent as pickles over a socket. The number of processes does not affect the
results.
"""

import contextlib
import copy
import os
import pickle
import signal
import subprocess
import sys
import threading
import traceback
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.env.env_factory import EnvFactory
from twin.env.options import CPU, check_actions, parse_options
from twin.env.vector_env_local import LocalVectorEnv, StepResult, frame_stack
from twin.errors import InputError
from twin.loading import Twin
from twin.runtime import available_cores

_MIN_ENVS, _MAX_PROCESSES = 2, 16  # defaults: least number of environments per process; largest number of processes
_CHILD_CODE = "from twin.env.vector_env import serve; serve()"  # not -m, which would pickle classes as part of __main__
_PARENT_CHECK_PERIOD = 2.0  # [s] time between two checks that the parent is still running


@dataclass(frozen=True)
class StepMessage:
    """A child's reply to `begin` and `step` for k environments."""

    images: NDArray[np.uint8] | None
    """The newest image of each environment, shape (k, 3, height, width)."""
    trust: NDArray[np.float64]
    states: NDArray[np.float32]
    infos: list[dict[str, Any]]
    result: StepResult | None = None


@dataclass(frozen=True)
class StackedImages:
    """Frame stacks and trust of all environments; see `PixelObserver`."""

    stacks: NDArray[np.uint8]
    trust: NDArray[np.float64]


class ProcessVectorEnv:
    """n environments of one scene and task in several processes.

    The interface is that of `LocalVectorEnv`, without `physics`, `tasks` and most of `pixels`.
    """

    def __init__(
        self,
        scene: str | Path | Twin,
        task: str,
        options: dict[str, Any],
        seeds: Sequence[int | None],
        processes: int,
    ) -> None:
        """Arguments as in `make_vector_env`; `processes` is at most the number of environments."""
        self.options, self.processes, count = parse_options(options), processes, len(seeds)
        # Neighbors are in different processes, so that any range of environments is spread over all processes.
        parts = [range(c, count, processes) for c in range(processes)]
        self._location = [(i % processes, i // processes) for i in range(count)]
        self._lock = threading.Lock()
        self._children: list[_Child] = []
        self._end = weakref.finalize(self, _kill, self._children)
        try:
            for _ in parts:
                self._children.append(_Child(max(1, available_cores() // processes)))
            quiet = [runtime.is_quiet() or c > 0 for c in range(processes)]  # only the first child shows progress
            mine = [[seeds[i] for i in part] for part in parts]
            opened = self._request({c: ("open", quiet[c], scene, task, options, mine[c]) for c in range(processes)})
        except BaseException:
            self.close()
            raise
        self.action_size, self.state_size = opened[0]
        width, height = self.options.size
        shape = count, self.options.stack, 3, height, width
        self.pixels = StackedImages(np.zeros(shape, np.uint8), np.zeros(count)) if self.options.pixels else None
        self._states = np.zeros((count, self.state_size), np.float32)
        self._infos: list[dict[str, Any] | None] = [None] * count
        """The info last received from each environment; None if it may have changed since."""

    def __len__(self) -> int:
        return len(self._location)

    def seed(self, i: int, seed: int | None) -> None:
        self._call_child(i, "seed", seed)

    def begin(self, which: Sequence[int]) -> None:
        some = np.asarray(which, int)
        parts = list(self._split(some))
        messages = self._request({c: ("begin", local) for c, _, local in parts})
        for c, at, _ in parts:
            self._store(some[at], messages[c], fill=True)

    def step(self, actions: NDArray, which: Sequence[int] | None = None) -> StepResult:
        some = np.arange(len(self)) if which is None else np.asarray(which, int)
        actions = check_actions(actions, (len(some), self.action_size))
        parts = list(self._split(some))
        messages = self._request({c: ("step", actions[at], local) for c, at, local in parts})
        out = StepResult(np.zeros(len(some)), np.zeros(len(some), bool), np.zeros(len(some), bool))
        for c, at, _ in parts:
            self._store(some[at], messages[c], fill=False)
            part = messages[c].result
            out.reward[at], out.terminated[at], out.truncated[at] = part.reward, part.terminated, part.truncated
        return out

    def observation(self) -> NDArray:
        return frame_stack(self.pixels.stacks) if self.pixels else self._states.copy()

    def state(self, i: int) -> NDArray[np.float32]:
        return self._states[i].copy()

    def info(self, i: int) -> dict[str, Any]:
        known = self._infos[i]
        return self._call_child(i, "info") if known is None else copy.deepcopy(known)

    def get(self, i: int, name: str) -> Any:
        return self._call_child(i, "get", name)

    def set(self, i: int, name: str, value: Any) -> None:
        self._infos[i] = None
        self._call_child(i, "set", name, value)

    def call(self, i: int, name: str, *args: Any, **kwargs: Any) -> Any:
        self._infos[i] = None
        return self._call_child(i, "call", name, *args, **kwargs)

    def close(self) -> None:
        self._end()

    def _split(self, some: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64], list[int]]]:
        """Yields (child, positions, indices) for each child that has some of the environments `some`.

        `positions` are the places of these environments in `some`; `indices` are their indices within the child.
        """
        locations = np.array([self._location[i] for i in some.tolist()]).reshape(-1, 2)
        for c in np.unique(locations[:, 0]).tolist():
            at = np.flatnonzero(locations[:, 0] == c)
            yield c, at, locations[at, 1].tolist()

    def _call_child(self, i: int, method: str, *args: Any, **kwargs: Any) -> Any:
        c, local = self._location[i]
        return self._request({c: (method, local, *args)}, kwargs)[c]

    def _request(self, requests: dict[int, tuple[Any, ...]], keywords: dict[str, Any] | None = None) -> dict[int, Any]:
        """Sends requests to children, waits for all replies, and returns their results."""
        messages = {c: serialize((*request, keywords or {})) for c, request in requests.items()}
        with self._lock:
            if not self._end.alive:
                raise InputError(
                    "the vector environment is closed: by close(), by an interrupted step, or because one of its "
                    "processes ended; make a new one"
                )
            try:
                for c, message in messages.items():
                    self._children[c].send(message)
                replies = {c: self._children[c].receive() for c in requests}  # all, even if one is an error
            except BaseException:  # otherwise, the next request would read pending replies
                self.close()
                raise
        for error, _ in replies.values():
            if error:
                raise error
        return {c: result for c, (_, result) in replies.items()}

    def _store(self, which: NDArray[np.int64], message: StepMessage, fill: bool) -> None:
        """Stores a reply. With `fill`, the new image fills the whole stack."""
        if self.pixels and message.images is not None:
            stacks, new = self.pixels.stacks, message.images[:, None]
            stacks[which] = new if fill else np.concatenate([stacks[which][:, 1:], new], 1)
            self.pixels.trust[which] = message.trust
        self._states[which] = message.states
        for i, info in zip(which.tolist(), message.infos, strict=True):
            self._infos[i] = info


class _Child:
    """A child process, which uses `share` cores, and the parent's end of its socket."""

    def __init__(self, share: int) -> None:
        self.pipe, theirs = Pipe()
        path = os.pathsep.join(str(folder or Path.cwd()) for folder in sys.path)
        with theirs:
            self.process = subprocess.Popen(
                # -P: the child imports what this process imports, not modules in the current folder.
                [sys.executable, "-P", "-c", _CHILD_CODE, *map(str, (theirs.fileno(), os.getpid(), share))],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                process_group=0,  # Ctrl-C reaches only the parent, which can then save its state
                # The child renders on the CPU. The GPU is hidden, so that the child takes none of its memory.
                env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": str(share), "CUDA_VISIBLE_DEVICES": ""},
            )

    def send(self, message: bytes) -> None:
        with contextlib.suppress(OSError):  # `receive` reports the cause
            self.pipe.send_bytes(message)

    def receive(self) -> tuple[Exception | None, Any]:
        try:
            return pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            code = self.process.wait()
            raise InputError(
                f"a process of the vector environment ended with exit status {code}; expected it to run. "
                + ("If memory ran out, use fewer; processes=1 starts none" if code == -9 else "See its messages above")
            ) from None


def _kill(children: list[_Child]) -> None:
    """Kills child processes; they have nothing to save."""
    for child in children:
        child.pipe.close()
        child.process.kill()
    for child in children:
        child.process.wait()


def serialize(value: Any) -> bytes:
    return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)


# ---- in a child process


class VectorEnvServer:
    """Executes requests: names of methods of this class or of its `LocalVectorEnv`, each with its arguments."""

    envs: LocalVectorEnv

    def answer(self, request: bytes) -> bytes:
        """Executes a pickled request; returns a pickled pair: an exception or None, and the result."""
        try:
            method, *args, kwargs = pickle.loads(request)
            owner = self if method in ("open", "begin", "step") else self.envs
            return serialize((None, getattr(owner, method)(*args, **kwargs)))
        except Exception as error:
            error.add_note(f"in a process of the vector environment:\n{traceback.format_exc()}")
            with contextlib.suppress(Exception):
                reply = serialize((error, None))
                pickle.loads(reply)  # some exceptions cannot be unpickled
                return reply
            return serialize((RuntimeError(error.__notes__[-1]), None))

    def open(
        self, quiet: bool, scene: Any, task: str, options: dict[str, Any], seeds: list[int | None]
    ) -> tuple[int, int]:
        runtime.set_quiet(quiet)
        self.envs = LocalVectorEnv(EnvFactory.open(scene, task, options), seeds)
        return self.envs.action_size, self.envs.state_size

    def begin(self, which: list[int]) -> StepMessage:
        self.envs.begin(which)
        return self._message(which)

    def step(self, actions: NDArray, which: list[int]) -> StepMessage:
        return self._message(which, self.envs.step(actions, which))

    def _message(self, which: list[int], result: StepResult | None = None) -> StepMessage:
        envs, pixels = self.envs, self.envs.pixels
        images = pixels.stacks[which, -1] if pixels else None
        trust = pixels.trust[which] if pixels else np.zeros(len(which))
        states = np.stack([envs.state(i) for i in which])
        return StepMessage(images, trust, states, [envs.info(i) for i in which], result)


def serve() -> None:
    """Serves a parent's requests. Command line arguments: socket, process id of the parent, number of cores to use."""
    socket, parent, share = map(int, sys.argv[1:])
    os.set_inheritable(socket, False)
    # SIGTERM may reach all processes. This one ignores it: the parent saves its state, and then ends this process.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    runtime.limit_cores(share)
    server = VectorEnvServer()
    with Connection(socket) as pipe, contextlib.suppress(EOFError, OSError):  # the parent closed the pipe
        while True:
            while not pipe.poll(_PARENT_CHECK_PERIOD):
                # The socket alone does not show that the parent ended: a process forked by the parent may hold it open.
                if os.getppid() != parent:
                    return
            pipe.send_bytes(server.answer(pipe.recv_bytes()))


# ---- choice of the vector environment


def default_processes(count: int) -> int:
    """Number of processes on a CPU for `count` environments: one per core, at most 16, with at least two each."""
    return max(1, min(available_cores(), count // _MIN_ENVS, _MAX_PROCESSES))


def make_vector_env(
    scene: str | Path | Twin,
    task: str,
    options: dict[str, Any],
    seeds: Sequence[int | None],
    processes: int | None = None,
) -> LocalVectorEnv | ProcessVectorEnv:
    """Returns n environments on the device of the options; see `LocalVectorEnv` for their interface.

    Args:
        scene, task, options: See `twin.load`.
        seeds: Seed of each environment's sequence of episodes; None: unpredictable.
        processes: Number of processes on a CPU; None: see `default_processes`.

    Raises:
        InputError: as in `EnvFactory.open`; also if `processes` is below 1, or there are no seeds.
    """
    if not seeds:
        raise InputError("0 environments; expected at least 1")
    if processes is not None and processes < 1:
        raise InputError(f"processes = {processes}; expected at least 1")
    device = parse_options(options).device
    if device != CPU:
        from twin.env.vector_env_gpu import GpuVectorEnv  # slow to import

        return GpuVectorEnv(EnvFactory.open(scene, task, options), seeds, device)
    processes = min(processes or default_processes(len(seeds)), len(seeds))
    if processes > 1:
        return ProcessVectorEnv(scene, task, options, seeds, processes)
    return LocalVectorEnv(EnvFactory.open(scene, task, options), seeds)
