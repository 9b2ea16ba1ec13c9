"""Processes that verbs start: none outlives the one that started it."""

import ctypes
import os
import signal
import sys
import threading
import time

PARENT = "TWIN_PARENT"
"""Environment variable with the number of the process that starts another."""

_PR_SET_PDEATHSIG = 1
_LOOK = 0.5  # [s] between two looks for the parent


def environment(**more: str) -> dict[str, str]:
    """The environment for a process that calls `die_with_parent`."""
    return {**os.environ, PARENT: str(os.getpid()), **more}


def die_with_parent(parent: int | None = None) -> None:
    """Call first in a child: it is killed when its parent dies, however it does, so that no second writer is left.

    Args:
        parent: Its number; by default what `environment` says, or who the parent is now.
    """
    parent = parent or int(os.environ.get(PARENT, os.getppid()))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was gone before the call
        os._exit(1)
    # For systems without that call.
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def ignore_stops() -> None:
    """Call in a child that its parent ends: signals of a terminal are for the parent. SIGTERM ends the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(1)
