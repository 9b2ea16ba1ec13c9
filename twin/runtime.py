"""Runtime services of the commands: progress bars, signals, child processes, CPU cores, memory and file locks."""

import contextlib
import ctypes
import fcntl
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import psutil
from tqdm import tqdm

from twin.errors import InputError
from twin.files import regular_file

T = TypeVar("T")

# ---- progress on standard error

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Turns all progress output of this process off (True) or on (False)."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    return _quiet


@dataclass(frozen=True)
class BuildStage:
    """The running stage of a build, shown by its progress bars."""

    number: int
    count: int
    expected: float
    """Expected duration of the stage [s]."""
    later: float
    """Expected duration of the stages after it [s]."""
    started: float = field(default_factory=time.monotonic)


_stage: BuildStage | None = None


def set_stage(stage: BuildStage | None) -> None:
    """Sets the build stage, which progress bars show with the remaining time of the build; None outside a build."""
    global _stage
    _stage = stage


# tqdm's default lock is a system semaphore. When a child process with a bar is killed, Python warns of a leaked one.
tqdm.set_lock(threading.RLock())


class _Bar(tqdm):
    """A progress bar that also shows the remaining time of the build, if one is running."""

    @property
    def format_dict(self) -> dict[str, Any]:
        facts: dict[str, Any] = super().format_dict
        if _stage:
            rate = facts["rate"] or (facts["n"] - facts["initial"]) / max(facts["elapsed"], 1e-6)
            bar = max((facts["total"] or 0) - facts["n"], 0) / rate if rate else 0.0
            left = max(_stage.expected - (time.monotonic() - _stage.started), bar) + _stage.later
            facts["bar_format"] = "{l_bar}{bar}{r_bar}, "
            facts["bar_format"] += f"stage {_stage.number}/{_stage.count}, {self.format_interval(left)} to the end"
        return facts


def bar(what: str, total: int, unit: str = "it", after: float = 0.0) -> tqdm:
    """A progress bar, which is also a context manager.

    In a terminal it is redrawn in place; in a log file it writes a line every 10 s; with `set_quiet`, nothing is shown.
    It appears after `after` [s], so that work which is usually fast shows no bar. Bytes (unit "B") are shown as MB.
    """
    every, scaled = 0.1 if sys.stderr.isatty() else 10.0, unit == "B"
    look = {"mininterval": every, "dynamic_ncols": True, "delay": after, "unit": unit, "unit_scale": scaled}
    return _Bar(total=total, desc=f"  {what}", disable=_quiet, **look)


def track(items: Iterable[T], what: str, total: int | None = None, unit: str = "it") -> Iterator[T]:
    """Yields the items and advances a progress bar; `total` is needed if the items have no length."""
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    with bar(what, total, unit) as progress:
        for item in items:
            yield item
            progress.update()


def log_line(line: str) -> None:
    """Prints a line above the progress bars."""
    if not _quiet:
        tqdm.write(line, file=sys.stderr)


# ---- signals

_AGAIN = 0.05  # [s] if the exception of a signal was dropped, the signal is sent again after this time
_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(KeyboardInterrupt):
    """A signal asked the process to stop."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Within the block, the first SIGINT, SIGTERM or SIGHUP raises `Stopped`.

    Later signals are ignored, so that cleanup can finish; only SIGINT ends the process at once. Signals that were
    ignored when the process started, for example because of nohup, stay ignored.
    """
    stopping = 0
    again: list[threading.Timer] = []
    main = threading.current_thread() is threading.main_thread()

    def stop(number: int, _: Any) -> None:
        nonlocal stopping
        if not stopping:
            stopping = number
            raise Stopped(number)
        if number == signal.SIGINT:
            os._exit(128 + number)

    def send_again(number: int) -> None:
        nonlocal stopping
        stopping = 0
        os.kill(os.getpid(), number)

    def ignored(what: Any) -> None:
        """Python drops exceptions that are raised in callbacks, such as those of weak references."""
        if isinstance(what.exc_value, Stopped):
            timer = threading.Timer(_AGAIN, send_again, (what.exc_value.number,))
            timer.daemon = True
            again.append(timer)
            timer.start()
        else:
            hook(what)

    hook = sys.unraisablehook
    if main:
        sys.unraisablehook = ignored
    try:
        with _handled(stop):
            yield
    except (ImportError, SystemError) as error:  # a module written in C, interrupted while it was imported
        if stopping:
            raise Stopped(stopping) from error
        raise
    finally:
        if main:
            sys.unraisablehook = hook
        for timer in again:
            timer.cancel()


class StopNotice:
    """`number` is the first signal that asked the process to stop, or 0."""

    number = 0


@contextlib.contextmanager
def stop_noted() -> Iterator[StopNotice]:
    """Within the block, SIGINT, SIGTERM and SIGHUP are only noted. The block should then save its work and raise
    `Stopped`."""
    stop = StopNotice()

    def note(number: int, _: Any) -> None:
        stop.number = stop.number or number

    with _handled(note):
        yield stop


@contextlib.contextmanager
def _handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handles SIGINT, SIGTERM and SIGHUP within the block, if in the main thread; ignored signals stay ignored."""
    with signals_kept():
        if threading.current_thread() is threading.main_thread():
            for number in _STOPPING:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    signal.signal(number, handler)
        yield


@contextlib.contextmanager
def signals_kept() -> Iterator[None]:
    """Restores the signal handlers at the end of the block, since some libraries replace them when imported."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (*_STOPPING, signal.SIGABRT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: the handler was not set by Python
                signal.signal(number, handler)


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """Delays SIGINT, SIGTERM and SIGHUP to the end of the block.

    Processes that are started in the block inherit the blocked signals, and must unblock them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# ---- child processes

_PARENT = "TWIN_PARENT"  # environment variable with the process number of the parent
_PR_SET_PDEATHSIG = 1


def child_environment(**more: str) -> dict[str, str]:
    """Environment variables for a child process that calls `die_with_parent`."""
    return {**os.environ, _PARENT: str(os.getpid()), **more}


def die_with_parent(parent: int | None = None) -> None:
    """Makes this process end when its parent ends, so that it does not go on writing files; to be called first in a
    child.

    `parent` is a process number, by default that from `child_environment`, or else that of the present parent.
    """
    parent = parent or int(os.environ.get(_PARENT, os.getppid()))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent ended before the call
        os._exit(1)


def ignore_terminal_signals() -> None:
    """Makes a child ignore the terminal's signals, which its parent handles; SIGTERM still ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])


# ---- CPU cores

_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_core_limit: int | None = None


def limit_cores(limit: int) -> None:
    """Limits `available_cores` in a process that shares the cores with others."""
    global _core_limit
    _core_limit = limit


def return_memory() -> None:
    """Returns freed memory to the system, if the C library offers it, as glibc does.

    The library keeps freed memory for later, in several places for several threads. A server that allocates pictures
    of many sizes would grow by about 100 MB in an hour, and a build would need half a gigabyte more.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def available_cores() -> int:
    """Number of CPU cores that this process may use, by its affinity, the container's quota and `limit_cores`."""
    count = len(os.sched_getaffinity(0))
    return min(count, _core_limit or count, _quota() or count)


@cache
def _quota() -> int | None:
    """CPU quota of the container (cgroup v2) in whole cores; None: unlimited."""
    try:
        quota, period = _QUOTA.read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else max(1, round(int(quota) / int(period)))


# ---- memory

_MEMORY_POLL = 0.2  # [s]


def resident_memory() -> int:
    """Resident memory of this process and its descendants [bytes]; shared pages count in each process."""
    this, total = psutil.Process(), 0
    for process in (this, *this.children(recursive=True)):
        try:
            total += process.memory_info().rss
        except psutil.Error:
            continue  # it ended after it was listed
    return total


class PeakMemory:
    """Context manager that samples `resident_memory`; `bytes` is the largest sample."""

    def __init__(self) -> None:
        self.bytes = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.bytes = max(self.bytes, resident_memory())
            if self._stop.wait(_MEMORY_POLL):
                return


# ---- file lock


@contextlib.contextmanager
def exclusive_lock(path: Path, what: str) -> Iterator[None]:
    """Holds a lock on a file during the block. The lock is also released when the process ends, even if it is killed.

    Args:
        path: Lock file, which contains the holder's process number. It is removed at the end; a file that a killed
            process left is reused.
        what: Description of the locked work for the error message.

    Raises:
        InputError: another process holds the lock, or `path` is not a regular file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        if path.exists() or path.is_symlink():
            regular_file(path)
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise InputError(f"{what} by process {file.read().strip() or '?'}; wait for it or stop it") from None
            if not _is_same_file(file.fileno(), path):
                continue  # the former holder removed it after we opened it
            try:
                file.truncate(0)
                os.write(file.fileno(), str(os.getpid()).encode())
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
