"""Progress on standard error: a bar with time left on a terminal, a line now and then elsewhere, nothing when quiet."""

import contextlib
import ctypes
import fcntl
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import psutil
from tqdm import tqdm

from twin.errors import InputError
from twin.files import regular

T = TypeVar("T")

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Silences (or restores) every bar of this process."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Whether bars are silenced in this process."""
    return _quiet


def bar(what: str, total: int, unit: str = "it", after: float = 0.0) -> tqdm:
    """A bar to be driven by hand: `update(n)`, `set_postfix_str(s)`, `close()`; also a context manager.

    It shows from `after` seconds on, for what takes long the first time only.
    """
    every = 0.1 if sys.stderr.isatty() else 10.0
    return tqdm(
        total=total, desc=f"  {what}", unit=unit, disable=_quiet, mininterval=every, dynamic_ncols=True, delay=after
    )


def track(items: Iterable[T], what: str, total: int | None = None, unit: str = "it") -> Iterator[T]:
    """Yields the items under a bar."""
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    with bar(what, total, unit) as progress:
        for item in items:
            yield item
            progress.update()


def say(line: str) -> None:
    """One line for the user, above the bars."""
    if not _quiet:
        tqdm.write(line, file=sys.stderr)


# ---- Processes that verbs start: none outlives the one that started it.


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


# ---- How many CPU cores there are to use.


_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_most: int | None = None


def use(most: int) -> None:
    """This process is one of several that share the cores: it uses so many of them."""
    global _most
    _most = most


def cores() -> int:
    """CPU cores this process may use: those it is bound to, where the system can tell, else all of the machine's; no
    more than its container is allowed."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, _most or there, _quota() or there)


@cache
def _quota() -> int | None:
    """Of a container's processor time (Linux control groups 2), in whole cores; None: no bound."""
    try:
        quota, period = _QUOTA.read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else max(1, round(int(quota) / int(period)))


# ---- Peak memory of this process and everything it started, sampled while a block runs.


_PERIOD = 0.2  # [s]


def resident() -> int:
    """Sum of the resident sizes of this process and everything it started; shared pages count in each [bytes]."""
    this, total = psutil.Process(), 0
    for process in (this, *this.children(recursive=True)):
        try:
            total += process.memory_info().rss
        except psutil.Error:
            continue  # it ended between the listing and the look
    return total


class PeakMemory:
    """Context manager; `bytes` is the largest `resident()` seen."""

    def __init__(self) -> None:
        self.bytes = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.bytes = max(self.bytes, resident())
            if self._stop.wait(_PERIOD):
                return


# ---- One process at a time writes what others would mix into.


@contextlib.contextmanager
def alone(path: Path, what: str) -> Iterator[None]:
    """Holds a lock that goes with the process, however it ends.

    Args:
        path: File to lock, with the holder's process number in it while the lock is held. It is removed at the end;
            one that a killed process left is taken over.
        what: Sentence that says what goes on there, for the error.

    Raises:
        InputError: another holds it, or what is there is no file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        if path.exists() or path.is_symlink():
            regular(path)
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise InputError(f"{what} by process {file.read().strip() or '?'}; wait for it or stop it") from None
            if not _is(file.fileno(), path):
                continue  # the holder of before removed it between our opening it and our locking it
            try:
                file.truncate(0)
                os.write(file.fileno(), str(os.getpid()).encode())
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one of this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
