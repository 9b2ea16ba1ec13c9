"""One process at a time writes what others would mix into."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from twin.errors import InputError
from twin.files import regular


@contextlib.contextmanager
def alone(path: Path, what: str) -> Iterator[None]:
    """Holds a lock that goes with the process, however it ends.

    Args:
        path: File to lock, with the holder's process number in it while the lock is held. It is removed at the end;
            one that a killed process left is taken over.
        what: Sentence that says what goes on there, for the error.

    Raises:
        InputError: another holds it, or what is there is no file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        if path.exists() or path.is_symlink():
            regular(path)
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise InputError(f"{what} by process {file.read().strip() or '?'}; wait for it or stop it") from None
            if not _is(file.fileno(), path):
                continue  # the holder of before removed it between our opening it and our locking it
            try:
                file.truncate(0)
                os.write(file.fileno(), str(os.getpid()).encode())
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one of this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
