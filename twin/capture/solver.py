"""The worker process of structure from motion: `python -m twin.capture.solver JOB`.

It reads a job, solves it and sends messages to its parent; `worker.py` starts it and describes the messages.
"""

import contextlib
import json
import os
import sys
import threading
import traceback
from pathlib import Path

from twin.capture import localize, mapping
from twin.capture.worker import BAD_INPUT, send_message
from twin.errors import InputError
from twin.runtime import die_with_parent

_TASKS = {"map": mapping.solve_mapping, "register": localize.solve_photo, "register_film": localize.solve_film}


def _exit_with_parent() -> None:
    """Ends this process when its standard input closes, as it does when the parent dies, even by kill -9."""
    with contextlib.suppress(OSError, ValueError):
        while os.read(0, 1024):
            pass
    os._exit(1)


def main(argv: list[str]) -> int:
    """Runs a job. Exit status: 0 done, 2 bad input (sent as an error message), 1 any other error."""
    die_with_parent()
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    job = json.loads(Path(argv[0]).read_text(encoding="utf-8"))
    try:
        _TASKS[job["task"]](job)
    except InputError as error:
        send_message(error=str(error))
        return BAD_INPUT
    except Exception:  # printed here because os._exit below skips the interpreter's own report
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # skips COLMAP's destructors, which may abort; all results are on disk already
