"""A process with some of the worlds of `ProcessWorlds`, whose requests it answers.

python -m twin.env.vector_env_child SOCKET PARENT CORES
"""

import contextlib
import os
import pickle
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.env.suite import EnvFactory
from twin.env.vector_env_local import LocalVectorEnv, StepResult
from twin.env.vector_env_processes import StepMessage, pickled

_LOOK = 2.0  # [s] between two looks whether the parent is still there


class VectorEnvServer:
    """What a child does: a request is a method's name and arguments, of its own or of its worlds."""

    worlds: LocalVectorEnv

    def answer(self, request: bytes) -> bytes:
        """What came of a request: an exception or None, and what was asked for."""
        try:
            what, *args, kwargs = pickle.loads(request)
            owner = self if what in ("open", "begin", "step") else self.worlds
            return pickled((None, getattr(owner, what)(*args, **kwargs)))
        except Exception as error:
            error.add_note(f"in a process of worlds:\n{traceback.format_exc()}")
            with contextlib.suppress(Exception):
                reply = pickled((error, None))
                pickle.loads(reply)  # which not every exception bears
                return reply
            return pickled((RuntimeError(error.__notes__[-1]), None))

    def open(self, quiet: bool, *stage: Any) -> tuple[int, int]:
        runtime.set_quiet(quiet)
        *opened, seeds = stage
        self.worlds = LocalVectorEnv(EnvFactory.open(*opened), seeds)
        return self.worlds.actions, self.worlds.states

    def begin(self, which: list[int]) -> StepMessage:
        self.worlds.begin(which)
        return self._news(which)

    def step(self, actions: NDArray, which: list[int]) -> StepMessage:
        return self._news(which, self.worlds.step(actions, which))

    def _news(self, which: list[int], outcome: StepResult | None = None) -> StepMessage:
        worlds, pixels = self.worlds, self.worlds.pixels
        pictures = pixels.stacks[which, -1] if pixels else None
        trust = pixels.trust[which] if pixels else np.zeros(len(which))
        states = np.stack([worlds.state(i) for i in which])
        return StepMessage(pictures, trust, states, [worlds.info(i) for i in which], outcome)


def main() -> None:
    socket, parent, share = map(int, sys.argv[1:])
    os.set_inheritable(socket, False)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # where all processes get it: the parent may want to save first
    runtime.use(share)
    server = VectorEnvServer()
    with Connection(socket) as pipe, contextlib.suppress(EOFError, OSError):  # the parent has closed it
        while True:
            while not pipe.poll(_LOOK):
                if os.getppid() != parent:  # gone, though somebody it forked may still have the socket
                    return
            pipe.send_bytes(server.answer(pipe.recv_bytes()))


if __name__ == "__main__":
    main()
