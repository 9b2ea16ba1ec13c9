"""Child process of `ProcessVectorEnv`: executes the parent's requests on some of its environments.

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
from twin.env.vector_env_processes import StepMessage, serialize

_PARENT_CHECK_PERIOD = 2.0  # [s] between two checks that the parent runs


class VectorEnvServer:
    """Executes requests: name and arguments of a method of this class or of its `LocalVectorEnv`."""

    envs: LocalVectorEnv

    def answer(self, request: bytes) -> bytes:
        """Executes a request and returns an exception or None, and the result."""
        try:
            method, *args, kwargs = pickle.loads(request)
            owner = self if method in ("open", "begin", "step") else self.envs
            return serialize((None, getattr(owner, method)(*args, **kwargs)))
        except Exception as error:
            error.add_note(f"in a process of the vector environment:\n{traceback.format_exc()}")
            with contextlib.suppress(Exception):
                reply = serialize((error, None))
                pickle.loads(reply)  # fails for some exceptions
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


def main() -> None:
    socket, parent, share = map(int, sys.argv[1:])
    os.set_inheritable(socket, False)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # may reach all processes; the parent saves first and ends this one
    runtime.limit_cores(share)
    server = VectorEnvServer()
    with Connection(socket) as pipe, contextlib.suppress(EOFError, OSError):  # the parent closed it
        while True:
            while not pipe.poll(_PARENT_CHECK_PERIOD):
                if os.getppid() != parent:  # ended, though a process that it forked may keep the socket open
                    return
            pipe.send_bytes(server.answer(pipe.recv_bytes()))


if __name__ == "__main__":
    main()
