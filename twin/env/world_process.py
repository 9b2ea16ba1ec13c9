"""A process with some of the worlds of `ProcessWorlds`, whose requests it answers.

python -m twin.env.world_process CORES
"""

import pickle
import signal
import socket
import sys
import traceback
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import cores, progress
from twin.env.batch import Outcome, Worlds
from twin.env.process_worlds import BAD_INPUT, BUG, News, pickled
from twin.env.suite import Stage
from twin.errors import InputError


class Server:
    """What a child does: a request is a method's name and arguments, of its own or of its worlds."""

    worlds: Worlds

    def answer(self, what: str, *arguments: Any) -> Any:
        *args, kwargs = arguments
        owner = self if what in ("open", "begin", "step") else self.worlds
        return getattr(owner, what)(*args, **kwargs)

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
    for one in (signal.SIGINT, signal.SIGTERM):  # are the parent's, who may want to save first
        signal.signal(one, signal.SIG_IGN)
    cores.use(int(sys.argv[1]))
    server = Server()
    with socket.socket(fileno=0) as ours:
        pipe = ours.makefile("rwb")
    while True:
        try:
            request = pickle.load(pipe)
        except (EOFError, OSError):  # the parent has closed it, or is gone
            return
        try:
            reply = pickled("", server.answer(*request))
        except InputError as error:
            reply = pickled(BAD_INPUT, str(error))
        except Exception:
            reply = pickled(BUG, traceback.format_exc())
        pipe.write(reply)
        pipe.flush()


if __name__ == "__main__":
    main()
