"""Fuzzer: every reader of files and every verb (`twin VERB`) must accept hostile input, or refuse it in one line.

    python benchmarks/fuzz.py --cases 50000 --seed 1 [--only TARGET] [--case K] [--command-line 60]

A case depends on (seed, target, number) alone, so `--only TARGET --case K` repeats it. `fuzzing/cases.py` defines when
a case passes; `fuzzing/targets.py` lists the targets. Cases run in a child process. If it dies, the case counts as a
failure, and a new child runs the remaining cases.

Prints a table, then every failure; the exit status is 1 if a case failed.
"""

import argparse
import contextlib
import ctypes
import json
import os
import queue
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.cases import (
    MARKER_VARIABLE,
    MAX_SECONDS,
    Case,
    Outcome,
    Violation,
    changed_files,
    check_refusal,
    new_case,
    remove,
    run_case,
    snapshot,
    time_limit,
)

_HERE = Path(__file__).resolve().parent
_ROOT = _HERE.parent
_MAX_DATA = 8 << 30  # [bytes] limit of the child's data segment, so that no case uses up the memory
_START_SECONDS = 600.0  # time limit for the child to write its valid samples
_WARM_UP_SECONDS = 10.0  # time limit of a target's first call, which is not a case


@dataclass
class Row:
    """A target's row of the table."""

    cases: int = 0
    refused: int = 0
    accepted: int = 0
    failures: list[Outcome] = field(default_factory=list)
    slowest: float = 0.0
    memory: int = 0

    def add(self, outcome: Outcome) -> None:
        self.cases += 1
        if outcome.failure:
            self.failures.append(outcome)
        elif outcome.accepted:
            self.accepted += 1
        else:
            self.refused += 1
        self.slowest, self.memory = max(self.slowest, outcome.seconds), max(self.memory, outcome.memory)


# ---- cases in child processes


def allocate_cases(cases: int, only: str | None = None) -> list[tuple[str, int]]:
    """Target and number of every case, in proportion to the targets' weights, at least one for each."""
    from fuzzing.targets import TARGETS

    targets = [one for one in TARGETS if only in (None, one.name)]
    if not targets:
        raise SystemExit(f"no target {only!r}; there are {', '.join(one.name for one in TARGETS)}")
    total = sum(one.weight for one in targets)
    return [(one.name, k) for one in targets for k in range(max(1, round(cases * one.weight / total)))]


def run_cases(
    cases: list[tuple[str, int]], seed: int, seconds: float = MAX_SECONDS, verbose: bool = False
) -> dict[str, Row]:
    """Runs cases in a child process, restarted after each death; returns rows of the table by target."""
    rows: dict[str, Row] = {}
    pending = list(cases)
    with tempfile.TemporaryDirectory(prefix="twin-fuzz-") as folder:
        while pending:
            done = 0
            for outcome in _outcomes_of_child(pending, seed, Path(folder), seconds):
                rows.setdefault(outcome.target, Row()).add(outcome)
                done += 1
                if verbose and outcome.failure:
                    print(
                        f"{outcome.target} --case {outcome.case}: {outcome.failure} | {outcome.line}", file=sys.stderr
                    )
            pending = pending[done:]
    return rows


def _outcomes_of_child(cases: list[tuple[str, int]], seed: int, folder: Path, seconds: float) -> Iterator[Outcome]:
    """Outcomes of cases until the child ends; if it dies or hangs, the last outcome is that failure."""
    work = folder / "work"
    remove(work)
    work.mkdir()
    environment = {**os.environ, MARKER_VARIABLE: str(work / "marker"), "TMPDIR": str(folder)}
    environment["PYTHONPATH"] = os.pathsep.join((str(_ROOT), os.environ.get("PYTHONPATH", "")))
    command = [sys.executable, str(Path(__file__).resolve()), "--child", str(work), "--seed", str(seed)]
    with (
        (folder / "stderr").open("w+b") as errors,
        subprocess.Popen(
            [*command, "--limit", str(seconds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
        ) as child,
    ):
        assert child.stdin and child.stdout
        lines: queue.Queue[bytes] = queue.Queue()
        threading.Thread(target=_enqueue_lines, args=(child.stdout, lines), daemon=True).start()
        child.stdin.write(json.dumps(cases).encode())
        child.stdin.close()
        timeout = _START_SECONDS
        for done, (target, k) in enumerate(cases):
            try:
                line = lines.get(timeout=timeout)
            except queue.Empty:
                line = b""
            if not line:
                child.kill()
                child.wait()
                errors.seek(0)
                log = errors.read()
                tail = log[-2000:].decode(errors="replace")
                if done == 0 and b"ready" not in log:
                    raise RuntimeError(f"the child does not start:\n{tail}")
                failure = f"the process died ({child.returncode}) or hung: {' '.join(tail.split())[-300:]}"
                yield Outcome(target, k, failure=failure)
                return
            timeout = 2 * seconds + 30.0
            yield Outcome(**json.loads(line))


def _enqueue_lines(file: Any, lines: "queue.Queue[bytes]") -> None:
    """Puts every line of a file into a queue as it arrives, and an empty line at the end."""
    for line in file:
        lines.put(line)
    lines.put(b"")


def _run_child(work: Path, seed: int, seconds: float) -> None:
    """Runs the cases given on standard input; writes one outcome per line."""
    cases = json.loads(sys.stdin.read())
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # text that readers print must not mix with the outcomes
    resource.setrlimit(resource.RLIMIT_DATA, (_MAX_DATA, _MAX_DATA))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # the child dies with its parent
    import faulthandler

    faulthandler.enable()
    for name in ("kept", "cwd"):
        (work / name).mkdir()
    (work / "kept" / "notes.txt").write_text("kept\n")
    (work / "kept" / "numbers.bin").write_bytes(bytes(range(256)))
    from fuzzing.samples import Samples
    from fuzzing.targets import TARGETS

    samples = Samples(work)
    targets = {one.name: one for one in TARGETS}
    for name in dict.fromkeys(name for name, _ in cases):  # imports and caches do not count in a case's time
        with contextlib.suppress(BaseException), time_limit(_WARM_UP_SECONDS):
            targets[name].run(new_case(work, f"warm/{name}", samples))
    print("ready", file=sys.stderr, flush=True)
    for name, k in cases:
        out.write(json.dumps(asdict(run_case(targets[name], seed, k, work, samples, seconds))) + "\n")


# ---- cases on the command line


def run_command_lines(cases: int, seed: int, seconds: float = MAX_SECONDS) -> Row:
    """Runs cases of verbs as `python -m twin VERB`, two at a time."""
    from concurrent.futures import ThreadPoolExecutor

    row = Row()
    with tempfile.TemporaryDirectory(prefix="twin-fuzz-") as folder, ThreadPoolExecutor(2) as pool:
        for outcome in pool.map(lambda k: _command_line(k, seed, Path(folder) / str(k), seconds), range(cases)):
            row.add(outcome)
    return row


def _command_line(k: int, seed: int, work: Path, seconds: float) -> Outcome:
    from fuzzing.verbs import command_of

    for name in ("kept", "cwd", "case"):
        (work / name).mkdir(parents=True)
    (work / "kept" / "notes.txt").write_text("kept\n")
    arguments = command_of(Case(Random(f"{seed}/command line/{k}"), work / "case", None))
    before = snapshot(work)
    environment = {
        **os.environ,
        MARKER_VARIABLE: str(work / "marker"),
        "PYTHONPATH": f"{_ROOT}{os.pathsep}{_ROOT}/ros2/twin_policy",
    }
    start = time.perf_counter()
    accepted, failure = False, ""
    try:
        done = subprocess.run(
            [sys.executable, "-m", "twin", *arguments],
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
    except Violation as error:
        failure = str(error)
    changed = changed_files(before, snapshot(work))
    if not failure and ((work / "marker").exists() or changed):
        failure = f"changed outside its folder: {changed}, or a payload ran"
    line = " ".join(one[:60] for one in arguments)
    return Outcome("command line", k, accepted, failure, line, time.perf_counter() - start)


# ---- report


def table(rows: dict[str, Row]) -> str:
    """The table, followed by every failure with the options that repeat it."""
    lines = [
        f"{'target':<16} {'cases':>6} {'refused':>8} {'accepted':>9} {'failures':>9} {'slowest s':>10} {'peak MiB':>9}"
    ]
    for name, row in rows.items():
        counts = f"{row.cases:>6} {row.refused:>8} {row.accepted:>9} {len(row.failures):>9}"
        lines.append(f"{name:<16} {counts} {row.slowest:>10.2f} {row.memory / 2**20:>9.0f}")
    for row in rows.values():
        for one in row.failures:
            lines.append(f"{one.target} --case {one.case}: {one.failure}" + (f"\n    {one.line}" if one.line else ""))
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Fuzzes every reader and every verb with hostile input.")
    parser.add_argument("--cases", type=int, default=50_000, help="number of cases (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", metavar="TARGET", help="run only this target")
    parser.add_argument("--case", type=int, metavar="K", help="run only case K of that target")
    parser.add_argument("--command-line", type=int, default=0, metavar="N", help="further cases, run as commands")
    parser.add_argument(
        "--limit", type=float, default=MAX_SECONDS, help="time limit of a case [s] (default %(default)g)"
    )
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    sys.path[:0] = [str(_HERE), str(_ROOT / "tests"), str(_ROOT), str(_ROOT / "ros2" / "twin_policy")]
    if options.child:
        _run_child(options.child, options.seed, options.limit)
        return 0
    if options.case is not None and not options.only:
        parser.error("--case needs --only TARGET")
    cases = allocate_cases(options.cases, options.only) if options.case is None else [(options.only, options.case)]
    rows = run_cases(cases, options.seed, options.limit, verbose=True)
    if options.command_line:
        rows["command line"] = run_command_lines(options.command_line, options.seed, options.limit)
    print(table(rows))
    return 1 if any(row.failures for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
