"""Runs a command line: parses its options, calls the command's function, and prints errors as one line with a cure.

| exit status | meaning |
|---|---|
| 0 | done |
| 1 | a bug: a traceback |
| 2 | bad input, or an error of the operating system (disk full, no permission): one line with cause and cure |
| 128 + n | stopped by signal n (SIGINT, SIGTERM, SIGHUP): one line; the same command, run again, continues |
"""

import argparse
import contextlib
import errno
import io
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable
from typing import Any, NoReturn

from twin import runtime
from twin.errors import InputError, print_error, shortened

_FULL = "free some space and run the command again"
_DENIED = "make it readable and writable, or choose another place"
_CURES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FULL),  # EFBIG: a file exceeds the size limit
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), _DENIED),
    **dict.fromkeys((errno.EEXIST, errno.ENOTEMPTY), "move it away"),
    errno.ENOENT: "put it there, or correct the path",
    errno.EISDIR: "expected a file; move the folder away",
    errno.ENOTDIR: "expected a folder; move the file away",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "the link points to itself; remove it",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENOMEM: "close other programs, or choose smaller settings",
}


class Parser(argparse.ArgumentParser):
    """An argument parser that prints errors as one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # argparse takes only single negative numbers as values; here, `--location -33.9,18.4` is one, too.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if action.option_strings and action.nargs is None and arg_strings == ["--"]:
            # For --option=--, argparse would treat the value as the end of the options and return an empty list.
            raise argparse.ArgumentError(action, "expected one argument")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {shortened(message)}; see {self.prog} --help\n")


class HelpFormatter(argparse.HelpFormatter):
    """Adds an option's default to its help, and keeps the line breaks of an epilog."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, value = action.help or "", action.default
        if value is None or isinstance(value, bool) or value in ("", [], argparse.SUPPRESS) or "default" in text:
            return text
        return f"{text} (default: {' '.join(value) if isinstance(value, list) else value})"

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)


def run(
    parser: argparse.ArgumentParser, work: Callable[[argparse.Namespace], None], arguments: list[str] | None = None
) -> int:
    """Parses arguments and calls `work` with the options; returns the exit status. `--quiet` turns progress off.

    The parser's default `resumes` is True for commands that continue when they are run again after they were stopped.
    """
    options = argparse.Namespace()
    try:
        options = parser.parse_args(arguments)
        runtime.set_quiet(getattr(options, "quiet", runtime.is_quiet()))
        with runtime.stoppable():
            if isinstance(sys.stdout, io.TextIOWrapper):
                sys.stdout.reconfigure(errors="backslashreplace")  # so that names that are not UTF-8 can be printed
            work(options)
            sys.stdout.flush()
    except InputError as error:
        return print_error(error)
    except BrokenPipeError:  # the program that read the output has ended
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that exiting raises no second error
        return 128 + int(signal.SIGPIPE)
    except MemoryError as error:
        return print_error(f"out of memory ({error}); close other programs, or choose smaller settings")
    except OSError as error:
        return print_error(_describe(error))
    except KeyboardInterrupt as error:
        with contextlib.suppress(OSError):
            resumes = getattr(options, "resumes", False)
            print("stopped" + resumes * "; to continue, run the same command again", file=sys.stderr)
        return 128 + (error.number if isinstance(error, runtime.Stopped) else int(signal.SIGINT))
    return 0


def _describe(error: OSError) -> str:
    """The message for an error of the operating system: file, error, and the cure if one is known."""
    number = error.errno
    if number is None and "requested and" in str(error):  # NumPy's error if a file could not be written completely
        number = errno.ENOSPC
    what = os.strerror(number) if number else str(error)
    where = f"{error.filename2 or error.filename}: " if error.filename else ""
    cure = f"; {_CURES[number]}" if number in _CURES else ""
    return f"{where}{what}{cure}"
