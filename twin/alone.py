"""One process at a time writes what others would mix into."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from twin.errors import InputError


@contextlib.contextmanager
def alone(path: Path, what: str) -> Iterator[None]:
    """Holds a lock that goes with the process, however it ends.

    Args:
        path: File to lock; it stays, with the holder's process number in it.
        what: Sentence that says what goes on there, for the error.

    Raises:
        InputError: another holds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise InputError(f"{what} by process {file.read().strip() or '?'}; wait for it or stop it") from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
