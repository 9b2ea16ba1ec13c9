"""Hostile input to every reader and every verb: all is taken, or refused in one line.

    python benchmarks/fuzz.py --cases 50000 --seed 1 [--only TARGET] [--case K] [--command-line 60]

A case is drawn from (seed, target, number) alone, so that `--only TARGET --case K` repeats it. It passes where the
reader returns or raises InputError with one line of less than 1,700 characters; where a verb returns 0 or 2 with one
line on standard error; where an environment takes a step or refuses it by ValueError and then goes on. Anything else
fails: another exception, a process that dies, more than 30 s, more than 3 GB, a file outside the case's folder that
changed, a planted payload that ran. Cases run in one child process at a time, which is started anew where it dies.

Prints a table, then every failure; exit status 1 if there are any.
"""

import argparse
import contextlib
import ctypes
import errno
import gc
import hashlib
import io
import json
import os
import queue
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

_HERE = Path(__file__).resolve().parent
_ROOT = _HERE.parent
LONGEST_LINE = 1700  # characters of a message
SECONDS = 30.0  # of a case
MEMORY = 3 << 30  # [bytes] resident in a case
_DATA = 8 << 30  # [bytes] of data a process may ask for, so that the machine survives
_MARKER = "TWIN_FUZZ_MARKER"
"""Environment variable: the file that a payload makes when it runs."""


@dataclass(frozen=True)
class Case:
    """What a target's case has to go by."""

    rng: Random
    folder: Path
    """Empty, and the only one that it may write to."""
    stuff: Any
    """`fuzz_targets.Stuff`, made once a process."""


@dataclass(frozen=True)
class Target:
    """A reader or a verb."""

    name: str
    share: float
    """Of the cases, relative to the others'."""
    run: Callable[[Case], bool | None]
    """Runs a case; returns False where a verb refused."""


@dataclass(frozen=True)
class Outcome:
    """Of a case."""

    target: str
    case: int
    accepted: bool = False
    failure: str = ""
    """The exception, or what else is wrong; empty where nothing is."""
    line: str = ""
    """The last line of the traceback that names a place."""
    seconds: float = 0.0
    memory: int = 0
    """Peak resident in the case [bytes]."""


@dataclass
class Row:
    """Of the table."""

    cases: int = 0
    refused: int = 0
    accepted: int = 0
    failures: list[Outcome] = field(default_factory=list)
    slowest: float = 0.0
    memory: int = 0

    def add(self, one: Outcome) -> None:
        self.cases += 1
        if one.failure:
            self.failures.append(one)
        elif one.accepted:
            self.accepted += 1
        else:
            self.refused += 1
        self.slowest, self.memory = max(self.slowest, one.seconds), max(self.memory, one.memory)


class Broken(Exception):
    """A case that neither raises nor is right."""


class _TooLong(BaseException):
    """The time of a case is over."""


# ---- one case


def run_case(target: Target, seed: int, k: int, work: Path, stuff: Any, seconds: float = SECONDS) -> Outcome:
    """Runs a case in this process, in the folder `work/case`, and looks at what it did."""
    from twin.errors import InputError

    folder = work / "case"
    _remove(folder)
    folder.mkdir()
    os.chdir(work / "cwd")
    before = _snapshot(work)
    _reset_peak()
    accepted, failure, line = False, "", ""
    start = time.perf_counter()
    try:
        with _limited(seconds):
            accepted = target.run(Case(Random(f"{seed}/{target.name}/{k}"), folder, stuff)) is not False
    except InputError as error:
        failure = _wrong_line(str(error))
    except OSError as error:  # which verbs turn into one line
        failure = "" if error.errno == errno.ENAMETOOLONG else _text(error)
        line = _place(error)
    except _TooLong as error:
        failure, line = f"more than {seconds:g} s", _place(error)
    except Broken as error:
        failure = str(error)
    except BaseException as error:
        said = " ".join(f"{type(error).__name__}: {_text(error)}".split())[:300]
        failure, line = said or type(error).__name__, _place(error)
    took, peak = time.perf_counter() - start, _peak()
    changed = _changed(before, _snapshot(work))
    if not failure and peak > MEMORY:
        failure = f"{peak / 2**20:,.0f} MiB"
    if not failure and changed:
        failure = f"changed outside its folder: {', '.join(changed[:3])}"
    if (work / "marker").exists():
        failure = "a planted payload ran"
        (work / "marker").unlink()
    if took > 1.0 or peak > 1 << 30:
        gc.collect()
    return Outcome(target.name, k, accepted, failure, line, took, peak)


def _wrong_line(message: str) -> str:
    if "\n" in message or "\r" in message:
        return f"a message of several lines: {message[:200]!r}"
    if not message.strip() or len(message) >= LONGEST_LINE:
        return f"a message of {len(message)} characters: {message[:200]!r}"
    return ""


def call_verb(main: Callable[[list[str]], int], arguments: list[str]) -> bool:
    """Runs a verb in this process; True where it returns 0. Raises Broken: neither done nor refused in one line."""
    err = io.StringIO()
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
        try:
            status: Any = main(arguments)
        except SystemExit as stop:
            status = stop.code
    check_refusal(status, err.getvalue())
    return status == 0


def check_refusal(status: Any, err: str) -> None:
    """Raises Broken unless a verb ended with 0, or with 2 and one line on standard error."""
    if status not in (0, 2) or "Traceback" in err:
        told = " ".join(err.split())[-200:]
        raise Broken(f"exit status {status}: {told!r}")
    lines = err.splitlines()
    if status == 2 and (len(lines) != 1 or not err.startswith("error: ")):
        raise Broken(f"refused in {len(lines)} lines: {err[:200]!r}")
    if status == 2 and _wrong_line(lines[0]):
        raise Broken(_wrong_line(lines[0]))


@contextlib.contextmanager
def _limited(seconds: float) -> Iterator[None]:
    def over(*_: Any) -> None:
        raise _TooLong

    former = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # again where it was swallowed on the way
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return "which cannot be shown"


def _place(error: BaseException) -> str:
    """Where in twin, or else in a library, it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/twin/" in frame.filename]
    frame = (ours or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}: {frame.line}"


def _remove(folder: Path) -> None:
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder, ignore_errors=True)
    else:
        folder.unlink(missing_ok=True)


def _snapshot(work: Path) -> dict[str, tuple[int, ...]]:
    """Every file beside the case's folder: its size, its time of change, and its digest where it is small."""
    out: dict[str, tuple[int, ...]] = {}
    for base, folders, files in os.walk(work):
        if Path(base) == work:
            folders[:] = [name for name in folders if name != "case"]
        for name in (*folders, *files):
            path = Path(base) / name
            facts = path.lstat()
            digest = 0
            if Path(base).name == "kept":
                digest = int.from_bytes(hashlib.sha256(path.read_bytes()).digest()[:8])
            when = facts.st_mtime_ns if path.is_file() else 0
            out[str(path.relative_to(work))] = (facts.st_mode, facts.st_size if path.is_file() else 0, when, digest)
    return out


def _changed(before: dict[str, tuple[int, ...]], after: dict[str, tuple[int, ...]]) -> list[str]:
    return sorted(
        name for name in before.keys() | after.keys() if before.get(name) != after.get(name) and name != "marker"
    )


def _reset_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) << 10
    except (OSError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << (10 if sys.platform != "darwin" else 0)


# ---- many cases, in children


def plan(cases: int, only: str | None = None) -> list[tuple[str, int]]:
    """Target and number of every case, by the targets' shares; each has one at least."""
    from fuzz_targets import TARGETS

    targets = [one for one in TARGETS if only in (None, one.name)]
    if not targets:
        raise SystemExit(f"no target {only!r}; there are {', '.join(one.name for one in TARGETS)}")
    total = sum(one.share for one in targets)
    return [(one.name, k) for one in targets for k in range(max(1, round(cases * one.share / total)))]


def fuzz(todo: list[tuple[str, int]], seed: int, seconds: float = SECONDS, say: bool = False) -> dict[str, Row]:
    """Runs cases in a child process, in a new one after each death; returns the table's rows by target."""
    rows: dict[str, Row] = {}
    todo = list(todo)
    with tempfile.TemporaryDirectory(prefix="twin-fuzz-") as place:
        while todo:
            done = 0
            for one in _child(todo, seed, Path(place), seconds):
                rows.setdefault(one.target, Row()).add(one)
                done += 1
                if say and one.failure:
                    print(f"{one.target} --case {one.case}: {one.failure} | {one.line}", file=sys.stderr)
            todo = todo[done:]
    return rows


def _child(todo: list[tuple[str, int]], seed: int, place: Path, seconds: float) -> Iterator[Outcome]:
    """Outcomes of the cases until the child ends; the last one is of its death, where it died."""
    work = place / "work"
    _remove(work)
    work.mkdir()
    environment = {**os.environ, _MARKER: str(work / "marker"), "TMPDIR": str(place)}
    environment["PYTHONPATH"] = os.pathsep.join((str(_ROOT), os.environ.get("PYTHONPATH", "")))
    command = [sys.executable, str(Path(__file__).resolve()), "--child", str(work), "--seed", str(seed)]
    errors = (place / "stderr").open("w+b")
    with subprocess.Popen(
        [*command, "--limit", str(seconds)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        env=environment,
    ) as child:
        assert child.stdin and child.stdout
        lines: queue.Queue[bytes] = queue.Queue()
        threading.Thread(target=_put_lines, args=(child.stdout, lines), daemon=True).start()
        child.stdin.write(json.dumps(todo).encode())
        child.stdin.close()
        told, wait = 0, 600.0
        while told < len(todo):
            try:
                line = lines.get(timeout=wait)
            except queue.Empty:
                line = b""
            if not line:
                child.kill()
                child.wait()
                errors.seek(0)
                rest = errors.read()[-2000:].decode(errors="replace")
                if told == 0 and b"ready" not in (place / "stderr").read_bytes():
                    raise RuntimeError(f"the child does not start:\n{rest}")
                why = f"the process died ({child.returncode}) or hung: {' '.join(rest.split())[-300:]}"
                yield Outcome(*todo[told], failure=why)
                return
            wait = 2 * seconds + 30.0
            yield Outcome(**json.loads(line))
            told += 1


def _put_lines(file: Any, lines: "queue.Queue[bytes]") -> None:
    """Every line as it comes, then an empty one."""
    for line in file:
        lines.put(line)
    lines.put(b"")


def _be_child(work: Path, seed: int, seconds: float) -> None:
    """Runs the cases given on standard input; writes an outcome a line."""
    todo = json.loads(sys.stdin.read())
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what readers print
    resource.setrlimit(resource.RLIMIT_DATA, (_DATA, _DATA))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # ends with its parent
    import faulthandler

    faulthandler.enable()
    for name in ("kept", "cwd"):
        (work / name).mkdir()
    (work / "kept" / "notes.txt").write_text("kept\n")
    (work / "kept" / "numbers.bin").write_bytes(bytes(range(256)))
    from fuzz_targets import TARGETS, Stuff

    stuff = Stuff(work)
    targets = {one.name: one for one in TARGETS}
    for name in dict.fromkeys(name for name, _ in todo):  # what is loaded once is not a case's time
        with contextlib.suppress(BaseException), _limited(10.0):
            targets[name].run(_warm(work, name, stuff))
    print("ready", file=sys.stderr, flush=True)
    for name, k in todo:
        outcome = run_case(targets[name], seed, k, work, stuff, seconds)
        out.write(json.dumps(asdict(outcome)) + "\n")


def _warm(work: Path, name: str, stuff: Any) -> Case:
    _remove(work / "case")
    (work / "case").mkdir()
    os.chdir(work / "cwd")
    return Case(Random(f"warm/{name}"), work / "case", stuff)


# ---- through the command line


def command_line(cases: int, seed: int, seconds: float = SECONDS) -> Row:
    """Runs verbs' cases as `python -m twin.VERB`, two at a time."""
    from concurrent.futures import ThreadPoolExecutor

    row = Row()
    with tempfile.TemporaryDirectory(prefix="twin-fuzz-") as place, ThreadPoolExecutor(2) as pool:
        for one in pool.map(lambda k: _command(k, seed, Path(place) / str(k), seconds), range(cases)):
            row.add(one)
    return row


def _command(k: int, seed: int, work: Path, seconds: float) -> Outcome:
    from fuzz_targets import command_of

    for name in ("kept", "cwd", "case"):
        (work / name).mkdir(parents=True)
    (work / "kept" / "notes.txt").write_text("kept\n")
    name, arguments = command_of(Case(Random(f"{seed}/command line/{k}"), work / "case", None))
    before = _snapshot(work)
    environment = {**os.environ, _MARKER: str(work / "marker"), "PYTHONPATH": str(_ROOT)}
    start = time.perf_counter()
    accepted, failure = False, ""
    try:
        done = subprocess.run(
            [sys.executable, "-m", name, *arguments],
            cwd=work / "cwd",
            env=environment,
            capture_output=True,
            timeout=2 * seconds,
            stdin=subprocess.DEVNULL,
        )
        check_refusal(done.returncode, done.stderr.decode(errors="replace"))
        accepted = done.returncode == 0
    except subprocess.TimeoutExpired:
        failure = f"more than {2 * seconds:g} s"
    except Broken as error:
        failure = str(error)
    changed = _changed(before, _snapshot(work))
    if not failure and ((work / "marker").exists() or changed):
        failure = f"changed outside its folder: {changed}, or a payload ran"
    shown = f"{name} {' '.join(one[:60] for one in arguments)}"
    return Outcome("command line", k, accepted, failure, shown, time.perf_counter() - start)


# ---- telling


def table(rows: dict[str, Row]) -> str:
    """The table, and below it every failure with how to repeat it."""
    head = (
        f"{'target':<16} {'cases':>6} {'refused':>8} {'accepted':>9} {'failures':>9} {'slowest s':>10} {'peak MiB':>9}"
    )
    lines = [head]
    for name, row in rows.items():
        counts = f"{row.cases:>6} {row.refused:>8} {row.accepted:>9} {len(row.failures):>9}"
        lines.append(f"{name:<16} {counts} {row.slowest:>10.2f} {row.memory / 2**20:>9.0f}")
    for row in rows.values():
        for one in row.failures:
            lines.append(f"{one.target} --case {one.case}: {one.failure}" + (f"\n    {one.line}" if one.line else ""))
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Hostile input to every reader and every verb.")
    parser.add_argument("--cases", type=int, default=50_000, help="of all targets together (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", metavar="TARGET", help="one target")
    parser.add_argument("--case", type=int, metavar="K", help="one case of that target")
    parser.add_argument("--command-line", type=int, default=0, metavar="N", help="cases through the command line, too")
    parser.add_argument("--limit", type=float, default=SECONDS, help="[s] of a case (default %(default)g)")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    sys.path[:0] = [str(_HERE), str(_ROOT / "tests"), str(_ROOT)]
    if given.child:
        _be_child(given.child, given.seed, given.limit)
        return 0
    if given.case is not None and not given.only:
        parser.error("--case needs --only TARGET")
    todo = plan(given.cases, given.only) if given.case is None else [(given.only, given.case)]
    rows = fuzz(todo, given.seed, given.limit, say=True)
    if given.command_line:
        rows["command line"] = command_line(given.command_line, given.seed, given.limit)
    print(table(rows))
    return 1 if any(row.failures for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
