"""How a verb of the command line ends: errors as one line, exit statuses, signals. Options are in `commands.py`.

| exit status | meaning |
|---|---|
| 0 | done |
| 1 | a bug: a traceback says where |
| 2 | bad input, or a machine that refuses (disk full, no permission): one line says what and what to do |
| 128 + n | stopped by signal n (SIGINT, SIGTERM, SIGHUP): one line says that running it again goes on |
"""

import argparse
import contextlib
import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from twin import runtime
from twin.errors import InputError, print_error, shortened

_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_FULL = "free some space and run it again"
_DENIED = "make it readable and writable, or choose another place"
_CURES = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,  # a limit on the size of files
    errno.EROFS: _DENIED,
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.ENOENT: "put it there, or correct the path",
    errno.EISDIR: "expected a file; move the folder away",
    errno.ENOTDIR: "expected a folder; move the file away",
    errno.EEXIST: "move it away",
    errno.ENOTEMPTY: "move it away",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "the link points to itself; remove it",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENOMEM: "close other programs, or ask for less at once",
}


class Stopped(KeyboardInterrupt):
    """A signal asked the process to stop."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if action.option_strings and action.nargs is None and arg_strings == ["--"]:
            # argparse would take the value of --option=-- for the end of the options, and hand on an empty list.
            raise argparse.ArgumentError(action, "expected one argument")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {shortened(message)}; see {self.prog} --help\n")


def run(parser: argparse.ArgumentParser, work: Callable[[Any], None], arguments: list[str] | None = None) -> int:
    """Parses the arguments of a verb and does its work; returns the exit status, see the module.

    Args:
        parser: Of the verb. Its option `--quiet`, where it has one, silences progress.
        work: What the verb does, given the parsed arguments.
        arguments: Of the command line; those of the process where None.
    """
    try:
        options = parser.parse_args(arguments)
        runtime.set_quiet(getattr(options, "quiet", runtime.is_quiet()))
        with stoppable():
            _printable()
            work(options)
            sys.stdout.flush()
    except InputError as error:
        return print_error(error)
    except BrokenPipeError:  # who read what is printed has gone
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the exit would complain
        return 128 + int(signal.SIGPIPE)
    except MemoryError as error:
        return print_error(f"out of memory ({error}); close other programs, or ask for less at once")
    except OSError as error:
        return print_error(in_words(error))
    except KeyboardInterrupt as error:
        with contextlib.suppress(OSError):
            print("stopped; run it again to go on", file=sys.stderr)
        return 128 + (error.number if isinstance(error, Stopped) else int(signal.SIGINT))
    return 0


def _printable() -> None:
    """Lets names that are no UTF-8 be printed, with the odd bytes escaped."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def in_words(error: OSError) -> str:
    """What the machine refused, and the cure where one is known."""
    number = error.errno
    if number is None and "requested and" in str(error):  # NumPy, of a write that was cut short
        number = errno.ENOSPC
    what = os.strerror(number) if number else str(error)
    where = f"{error.filename2 or error.filename}: " if error.filename else ""
    cure = f"; {_CURES[number]}" if number in _CURES else ""
    return f"{where}{what}{cure}"


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP raise `Stopped` within the block; once only, so that what cleans up is not cut short.

    A signal that the process was started to ignore, as by nohup, stays ignored. A second SIGINT, which a person sends,
    ends the process at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _STOPPING}
    stopping = False

    def stop(number: int, _: Any) -> None:
        nonlocal stopping
        if not stopping:
            stopping = True
            raise Stopped(number)
        if number == signal.SIGINT:
            os._exit(128 + number)

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopNotice:
    """Whether a signal has asked to stop, for who wants to save first."""

    number = 0
    """Of the signal; 0: none came."""


@contextlib.contextmanager
def stop_noted() -> Iterator[StopNotice]:
    """Within the block SIGINT, SIGTERM and SIGHUP are only noted; the block raises `Stopped` when it has saved."""
    stop = StopNotice()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, _: Any) -> None:
        stop.number = stop.number or number

    before = {number: signal.getsignal(number) for number in _STOPPING}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, note)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def signals_kept() -> Iterator[None]:
    """Undoes what the block does to the handlers of signals: some libraries take them when they are loaded."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [*_STOPPING, signal.SIGABRT]
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # not from Python
                signal.signal(number, handler)


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """Keeps SIGINT, SIGTERM and SIGHUP waiting until the block ends; in processes started in it, until they unblock."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
