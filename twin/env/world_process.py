"""A process with some of the worlds of `ProcessWorlds`, whose requests it answers.

python -m twin.env.world_process SOCKET PARENT CORES
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

from twin import cores, progress
from twin.env.batch import Outcome, Worlds
from twin.env.process_worlds import News, pickled
from twin.env.suite import Stage

_LOOK = 2.0  # [s] between two looks whether the parent is still there


class Server:
    """What a child does: a request is a method's name and arguments, of its own or of its worlds."""

    worlds: Worlds

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
        progress.set_quiet(quiet)
        *opened, seeds = stage
        self.worlds = Worlds(Stage.open(*opened), seeds)
        return self.worlds.actions, self.worlds.states

    def begin(self, which: list[int]) -> News:
        self.worlds.begin(which)
        return self._news(which)

    def step(self, actions: NDArray, which: list[int]) -> News:
        return self._news(which, self.worlds.step(actions, which))

    def _news(self, which: list[int], outcome: Outcome | None = None) -> News:
        worlds, pixels = self.worlds, self.worlds.pixels
        pictures = pixels.stacks[which, -1] if pixels else None
        trust = pixels.trust[which] if pixels else np.zeros(len(which))
        states = np.stack([worlds.state(i) for i in which])
        return News(pictures, trust, states, [worlds.info(i) for i in which], outcome)


def main() -> None:
    socket, parent, share = map(int, sys.argv[1:])
    os.set_inheritable(socket, False)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # where all processes get it: the parent may want to save first
    cores.use(share)
    server = Server()
    with Connection(socket) as pipe, contextlib.suppress(EOFError, OSError):  # the parent has closed it
        while True:
            while not pipe.poll(_LOOK):
                if os.getppid() != parent:  # gone, though somebody it forked may still have the socket
                    return
            pipe.send_bytes(server.answer(pipe.recv_bytes()))


if __name__ == "__main__":
    main()
