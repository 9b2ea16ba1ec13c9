"""One fuzz case and its oracle.

A target passes if it returns, or raises `InputError` with one line of fewer than `MAX_MESSAGE` characters. A verb (a
subcommand of `twin`) passes if it exits with 0, or with 2 and one such line on standard error. Every other outcome is a
failure: another exception (but for too long a file name), too much time or memory, a file changed outside the case's
folder, a planted payload that ran.

A working folder contains `case` (the only folder that the case may write to), `cwd` and `kept` (which must not change),
and the file `marker` if a payload has run.
"""

import contextlib
import errno
import gc
import hashlib
import io
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

MAX_MESSAGE = 1700  # characters
MAX_SECONDS = 30.0
MAX_MEMORY = 3 << 30  # [bytes] peak resident memory
MARKER_VARIABLE = "TWIN_FUZZ_MARKER"
"""Environment variable: path of the file that a payload writes."""


@dataclass(frozen=True)
class Case:
    """Inputs of a target."""

    rng: Random
    folder: Path
    """An empty folder, the only one that the case may write to."""
    samples: Any
    """`samples.Samples` of this process; None on the command line."""


@dataclass(frozen=True)
class Target:
    """A reader or a verb under test."""

    name: str
    """Part of the seed of its cases."""
    weight: float
    """Share of its cases, relative to the weights of other targets."""
    run: Callable[[Case], bool | None]
    """Runs a case; returns False if a verb refused its input."""


@dataclass(frozen=True)
class Outcome:
    """Result of one case."""

    target: str
    case: int
    accepted: bool = False
    failure: str = ""
    """Reason of the failure; empty if the case passed."""
    line: str = ""
    """Source line that raised the error."""
    seconds: float = 0.0
    memory: int = 0
    """Peak resident memory [bytes]."""


class Violation(Exception):
    """The target returned, but broke its contract."""


class _TimeLimitExceeded(BaseException):
    """Raised by the timer; no `except Exception` of the target catches it."""


def run_case(target: Target, seed: int, k: int, work: Path, samples: Any, seconds: float = MAX_SECONDS) -> Outcome:
    """Runs case k of a target in this process, in the folder `work/case`, and checks its effects."""
    from twin.errors import InputError

    case = new_case(work, f"{seed}/{target.name}/{k}", samples)
    before = snapshot(work)
    _reset_peak_memory()
    accepted, failure, line = False, "", ""
    start = time.perf_counter()
    try:
        with time_limit(seconds):
            accepted = target.run(case) is not False
    except InputError as error:
        failure = _message_fault(str(error))
    except OSError as error:  # passes only if a name is too long
        failure = "" if error.errno == errno.ENAMETOOLONG else _text(error)
        line = _source_line(error)
    except _TimeLimitExceeded as error:
        failure, line = f"more than {seconds:g} s", _source_line(error)
    except Violation as error:
        failure = str(error)
    except BaseException as error:
        message = " ".join(f"{type(error).__name__}: {_text(error)}".split())[:300]
        failure, line = message or type(error).__name__, _source_line(error)
    elapsed, peak = time.perf_counter() - start, peak_memory()
    changed = changed_files(before, snapshot(work))
    if not failure and peak > MAX_MEMORY:
        failure = f"{peak / 2**20:,.0f} MiB"
    if not failure and changed:
        failure = f"changed outside its folder: {', '.join(changed[:3])}"
    if (work / "marker").exists():
        failure = "a planted payload ran"
        (work / "marker").unlink()
    if elapsed > 1.0 or peak > 1 << 30:
        gc.collect()
    return Outcome(target.name, k, accepted, failure, line, elapsed, peak)


def new_case(work: Path, seed: str, samples: Any) -> Case:
    """A case with an empty folder; `work/cwd` becomes the current directory."""
    remove(work / "case")
    (work / "case").mkdir()
    os.chdir(work / "cwd")
    return Case(Random(seed), work / "case", samples)


def call_verb(main: Callable[[list[str]], int], arguments: list[str]) -> bool:
    """Runs a verb in this process; returns True if it exits with 0. Raises Violation as `check_refusal`."""
    err = io.StringIO()
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
        try:
            status: Any = main(arguments)
        except SystemExit as stop:
            status = stop.code
    check_refusal(status, err.getvalue())
    return status == 0


def check_refusal(status: Any, err: str) -> None:
    """Raises Violation unless a verb exited with 0, or with 2 and one line on standard error."""
    if status not in (0, 2) or "Traceback" in err:
        raise Violation(f"exit status {status}: {' '.join(err.split())[-200:]!r}")
    lines = err.splitlines()
    if status == 2 and (len(lines) != 1 or not err.startswith("error: ")):
        raise Violation(f"refused in {len(lines)} lines: {err[:200]!r}")
    if status == 2 and (fault := _message_fault(lines[0])):
        raise Violation(fault)


def _message_fault(message: str) -> str:
    """Reason why a message is not acceptable; empty if it is."""
    if "\n" in message or "\r" in message:
        return f"a message of several lines: {message[:200]!r}"
    if not message.strip() or len(message) >= MAX_MESSAGE:
        return f"a message of {len(message)} characters: {message[:200]!r}"
    return ""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raises an exception in the main thread after `seconds`."""

    def expire(*_: Any) -> None:
        raise _TimeLimitExceeded

    former = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # repeats in case the target catches the first exception
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return "error without a printable message"


def _source_line(error: BaseException) -> str:
    """Innermost source line of twin in the traceback; if it has none, the innermost line of all."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/twin/" in frame.filename]
    frame = (ours or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}: {frame.line}"


def remove(folder: Path) -> None:
    """Deletes a file, a link or a folder if it exists."""
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder, ignore_errors=True)
    else:
        folder.unlink(missing_ok=True)


def snapshot(work: Path) -> dict[str, tuple[int, ...]]:
    """Mode, size and modification time of every file outside `case`, and the digest of those in `kept`."""
    out: dict[str, tuple[int, ...]] = {}
    for base, folders, files in os.walk(work):
        if Path(base) == work:
            folders[:] = [name for name in folders if name != "case"]
        for name in (*folders, *files):
            path = Path(base) / name
            stat = path.lstat()
            size, modified = (stat.st_size, stat.st_mtime_ns) if path.is_file() else (0, 0)
            digest = 0
            if Path(base).name == "kept":
                digest = int.from_bytes(hashlib.sha256(path.read_bytes()).digest()[:8])
            out[str(path.relative_to(work))] = (stat.st_mode, size, modified, digest)
    return out


def changed_files(before: dict[str, tuple[int, ...]], after: dict[str, tuple[int, ...]]) -> list[str]:
    """Names of files whose entries differ between two snapshots, without the marker."""
    return sorted(
        name for name in before.keys() | after.keys() if before.get(name) != after.get(name) and name != "marker"
    )


def _reset_peak_memory() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Peak resident memory of this process [bytes] since its begin, or since the last reset if the system has resets.

    `getrusage`, which is used where there is no /proc, also includes the parent's memory at the fork.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) << 10
    except (OSError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << (10 if sys.platform != "darwin" else 0)
