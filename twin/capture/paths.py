"""What lies at a path that a user or a file of theirs names; such a name may be anything."""

import stat
from pathlib import Path

from twin.errors import InputError
from twin.files import regular


def is_file(path: Path) -> bool:
    """Whether a regular file is there, or a link to one; False for a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path, cure: str) -> bool:
    """True for a folder, False for a regular file.

    Args:
        path: What is asked about.
        cure: Ends the message of the InputError.

    Raises:
        InputError: neither is there: nothing, a link to nothing, a pipe, a device; or no name of a file.
    """
    try:
        if stat.S_ISDIR(path.stat().st_mode):
            return True
    except (OSError, ValueError):
        pass  # said by the next line
    try:
        regular(path)
    except InputError as error:
        raise InputError(f"{str(error).removesuffix('; expected a file')}; {cure}") from None
    return False


def folder(path: Path, cure: str) -> Path:
    """The path of a folder. Raises InputError where it is none; `cure` ends the message."""
    if not is_folder(path, cure):
        raise InputError(f"{path} is a file; {cure}")
    return path
