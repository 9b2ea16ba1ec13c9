"""The worker process of structure from motion: reads a job, solves it, reports to its parent. See `worker.py`.

python -m twin.capture.solver JOB
"""

import contextlib
import json
import os
import sys
import threading
import traceback
from pathlib import Path

from twin.capture import localize, mapping
from twin.capture.worker import BAD_INPUT, tell
from twin.errors import InputError
from twin.runtime import die_with_parent

_TASKS = {"map": mapping.solve_mapping, "register": localize.solve_photo, "register_film": localize.solve_film}


def _end_with_parent() -> None:
    """Ends this process when its standard input closes, which the parent's death does, even by kill -9."""
    with contextlib.suppress(OSError, ValueError):
        while os.read(0, 1024):
            pass
    os._exit(1)


def main(argv: list[str]) -> int:
    """The worker. Exit status: 0 done, 2 bad input (said in the news), 1 anything else."""
    die_with_parent()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job = json.loads(Path(argv[0]).read_text(encoding="utf-8"))
    try:
        _TASKS[job["task"]](job)
    except InputError as error:
        tell(error=str(error))
        return BAD_INPUT
    except Exception:  # a bug, shown here because the exit below goes past the interpreter and its own report
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # past COLMAP's destructors: all results are on disk already
