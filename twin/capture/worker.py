"""Runs COLMAP in a separate process, because some of its failures abort the whole process.

The parent starts the *worker*, `python -m twin.capture.worker MODULE:FUNCTION JOB`, which calls the function with the
*job* (a dictionary in the file JOB) and that file's folder. The parent shows the worker's progress, and raises an error
with a cure if the worker aborts. A *message* is one line of JSON on the worker's standard output: {"bar": name,
"total": n} starts a progress bar, {"step": n} advances it, {"say": text} prints a line, {"error": text} reports bad
input. COLMAP writes its own log to standard error; the parent copies it to a file.
"""

import contextlib
import errno
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from twin import runtime
from twin.errors import InputError
from twin.runtime import child_environment, die_with_parent

_BAD_INPUT = 2  # exit status
_CURES = {
    "SIGABRT": "film slower and with more texture in view, check the calibration, or set cameras.mapper = "
    '"incremental"',
    "SIGKILL": "too little memory: lower cameras.features or capture.max_frames",
    "SIGTERM": "stopped from outside: build again",
}
_DISK_FULL = ("no space left on device", "disk is full", "sqlite_full")


# ---- in the parent


def run_worker(solve: Callable[[dict[str, Any], Path], None], job: dict[str, Any], folder: Path) -> None:
    """Runs `solve(job, folder)` in a worker with progress bars; the folder also gets the job and COLMAP's log.

    Raises InputError (bad input, or a signal inside COLMAP), OSError (full disk) or RuntimeError (a bug).
    """
    job_file = folder / "job.json"
    job_file.write_text(json.dumps(job), encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, "-m", "twin.capture.worker", f"{solve.__module__}:{solve.__qualname__}", str(job_file)],
        stdin=subprocess.PIPE,  # closes when the parent ends in any way, which ends the worker, too
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        process_group=0,  # signals from the terminal reach only the parent
        env=child_environment(),
    )
    assert process.stdout and process.stderr
    recent: deque[str] = deque(maxlen=30)
    reader = threading.Thread(target=_keep_log, args=(process.stderr, folder / "colmap.log", recent), daemon=True)
    reader.start()
    bar: runtime.tqdm | None = None
    error: str | None = None
    try:
        for message in filter(None, map(_parsed, process.stdout)):
            if "bar" in message:
                if bar is not None:
                    bar.close()
                bar = runtime.bar(message["bar"], message["total"])
            if "step" in message and bar is not None:
                bar.update(message["step"])
            if "say" in message:
                runtime.log_line(message["say"])
            error = message.get("error", error)
        code = process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        reader.join(timeout=5.0)
        if bar is not None:
            bar.close()
    if code == 0:
        return
    tail = " | ".join(recent)[-1500:]
    if code == _BAD_INPUT and error:
        raise InputError(error)
    if any(words in tail.lower() for words in _DISK_FULL):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    if code < 0:
        name = signal.Signals(-code).name
        cure = _CURES.get(name, _CURES["SIGABRT"])
        words = next((part for part in reversed(tail.split(" | ")) if part.strip()), "no log")[-160:]
        raise InputError(f"COLMAP was ended by {name} ({words}); {cure}")
    raise RuntimeError(f"COLMAP's worker failed with exit status {code}: {tail}")


def _parsed(line: str) -> dict[str, Any]:
    """A message of the worker; {} for a line that is not a message."""
    try:
        message = json.loads(line)
    except json.JSONDecodeError:
        return {}
    return message if isinstance(message, dict) else {}


def _keep_log(stream: IO[str], path: Path, recent: deque[str]) -> None:
    with path.open("wb", buffering=0) as log:
        for line in stream:
            recent.append(line.rstrip("\n"))
            with contextlib.suppress(OSError):  # on a full disk the worker itself fails
                log.write(line.encode())


# ---- in the worker


def send_message(**message: Any) -> None:
    print(json.dumps(message), flush=True)


def main(function: str, job_file: str) -> int:
    """Calls MODULE:FUNCTION with a job. Exit status: 0 done, 2 bad input (sent as a message), 1 any other error."""
    die_with_parent()
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        module, _, name = function.partition(":")
        path = Path(job_file)
        getattr(importlib.import_module(module), name)(json.loads(path.read_text(encoding="utf-8")), path.parent)
    except InputError as error:
        send_message(error=str(error))
        return _BAD_INPUT
    except Exception:  # printed here because os._exit below skips the interpreter's own report
        traceback.print_exc()
        return 1
    return 0


def _exit_with_parent() -> None:
    """Ends this process when its standard input closes, which also happens when the parent is killed."""
    with contextlib.suppress(OSError, ValueError):
        while os.read(0, 1024):
            pass
    os._exit(1)


if __name__ == "__main__":
    code = main(*sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # skips COLMAP's destructors, which may abort; all results are on disk already
