"""Reading files that may be anything, and writing files so that a reader never sees half of one.

Readers take regular files only, so that none waits for a pipe; what is wrong with a file is an `InputError` that names
it. Writers write aside, as `<name>.partial`, and rename: a full disk or a kill leaves the former file as it was.
"""

import contextlib
import csv
import hashlib
import json
import math
import os
import re
import shutil
import stat
import struct
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from twin.errors import InputError

PARTIAL = ".partial"
"""Suffix of what is being written."""

_MOST_TEXT = 64 << 20  # [bytes] of a JSON or CSV file
_MOST_DIGITS = 40  # of an integer in JSON; the state of a random generator has 39
_MOST_ARRAYS = 2 << 30  # [bytes] of all arrays of a file, unpacked
_MOST_TOML = 4 << 20  # [bytes]
_DEEP_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){64}""")  # a.b.c. and so on
_WHOLE = 2**63  # beyond which no setting goes
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


# ---- reading


def regular(path: Path) -> Path:
    """The path of a regular file, or of a link to one.

    Raises:
        InputError: nothing there, a dangling link, a folder, a pipe, a device; or a name that no file can have.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        what = "a link to nothing" if path_is_link(path) else getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: {what}; expected a file") from None
    if kind != stat.S_IFREG:
        raise InputError(f"{path} is {_KINDS.get(kind, 'no regular file')}; expected a file")
    return path


def exists(path: Path) -> bool:
    """Whether there is anything of this name; False for a name that no file can have, where Path.exists raises."""
    try:
        return path.exists()
    except OSError:
        return False


def path_is_link(path: Path) -> bool:
    """Whether there is a link of this name, dangling or not; False for a name that no file can have."""
    try:
        return path.is_symlink()
    except (OSError, ValueError):
        return False


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The contents of a file. Raises InputError: see `regular`; or more than `most` bytes."""
    size = regular(path).stat().st_size
    if most is not None and size > most:
        raise InputError(f"{path} has {size:,} bytes; expected at most {most:,}")
    return path.read_bytes()


def read_text(path: Path, most: int = _MOST_TEXT) -> str:
    """The contents of a text file in UTF-8, with or without a byte-order mark.

    Raises:
        InputError: see `regular`; no UTF-8, or more than `most` bytes.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no UTF-8 text ({error.reason} at byte {error.start})") from None


def read_json(path: Path) -> Any:
    """The value in a JSON file; its numbers are finite and its integers have at most 40 digits.

    Raises:
        InputError: see `regular`; or no such JSON.
    """
    return parse_json(read_text(path), path)


def parse_json(text: str, where: object) -> Any:
    """The value of a JSON text, checked as by `read_json`; `where` opens the message of the InputError."""
    try:
        return json.loads(text, parse_int=_json_integer, parse_float=_json_float, parse_constant=_json_float)
    except RecursionError:
        raise InputError(f"{where}: nested too deep; expected JSON as twin or another tool writes it") from None
    except ValueError as error:
        raise InputError(f"{where}: no valid JSON: {error}") from None


def _json_integer(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"an integer of {len(text)} digits")
    return int(text)


def _json_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} where a finite number is expected")
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file; integers fit 64 bits, as TOML has it. Raises InputError: see `regular`; or no TOML."""
    return parse_toml(read_text(path, _MOST_TOML), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """The table of a TOML text, checked as by `read_toml`; `where` opens the message of the InputError."""
    try:
        if _DEEP_KEY.search(text):  # the time that tomllib takes for one grows with the square of its parts
            raise RecursionError
        table = tomllib.loads(text)
        _check_numbers(table)
    except RecursionError:
        raise InputError(f"{where}: nested too deep; expected tables, lists and values as in the README") from None
    except ValueError as error:
        raise InputError(f"{where}: not valid TOML: {error}") from None
    return table


def _check_numbers(value: Any) -> None:
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _check_numbers(item)
    elif isinstance(value, int) and not -_WHOLE <= value < _WHOLE:
        raise ValueError("an integer that does not fit 64 bits")


def load_arrays(path: Path, most: int = _MOST_ARRAYS) -> dict[str, NDArray]:
    """The arrays of an npz file; nothing in it can run code.

    Args:
        path: The file.
        most: Bytes of all arrays together, unpacked.

    Raises:
        InputError: see `regular`; no npz file, a damaged one, pickled objects, or more than `most` bytes.
    """
    with damaged(regular(path), f"expected arrays as numpy.savez writes them{_PICKLED}"):
        with zipfile.ZipFile(path) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
            if total > most:
                raise InputError(f"{path} unpacks to {total:,} bytes; expected at most {most:,}")
            for entry in archive.infolist():
                _check_header(archive, entry)
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


_PICKLED = ", without pickled objects"


def _check_header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Raises ValueError where an array's header promises more than its file holds: it would be allocated first."""
    if not entry.filename.endswith(".npy"):
        return
    with archive.open(entry) as file:
        version = npy.read_magic(file)
        shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} promises {shape} of {dtype} and holds {entry.file_size} bytes")


@contextlib.contextmanager
def damaged(path: Path, cure: str) -> Iterator[None]:
    """Turns the errors of reading a file's contents into one InputError, which names the file and the cure."""
    try:
        yield
    except InputError:
        raise
    except (
        *(ArithmeticError, AttributeError, EOFError, LookupError, RecursionError, TypeError, ValueError),
        *(struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, NotImplementedError, SyntaxError),
        *(MemoryError, OSError, AssertionError, RuntimeError, SafetensorError, csv.Error),
    ) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path} is damaged ({type(error).__name__}: {what}); {cure}") from error


def load_tensors(path: Path) -> dict[str, NDArray]:
    """The arrays of a safetensors file. Raises InputError: see `regular`; or no such file."""
    with damaged(regular(path), "expected a safetensors file"):
        return load_file(path)


def toml_string(text: str) -> str:
    """A text as TOML's basic string: quotes, backslashes and control characters escaped, lone surrogates replaced."""
    whole = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def check_shapes(arrays: Mapping[str, tuple[NDArray, tuple[int, ...], str]]) -> None:
    """Raises ValueError where an array is of another shape or kind: given by name with its shape and `dtype.kind`."""
    for name, (array, shape, kind) in arrays.items():
        if array.shape != shape or array.dtype.kind != kind:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; expected {shape} of kind {kind!r}")


def checked_text(value: Any) -> str:
    """A text from a JSON file. Raises TypeError: it is none."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} where a text is expected")
    return value


# ---- digests


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with regular(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_json(value: Any) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


# ---- writing


@contextlib.contextmanager
def aside(path: Path) -> Iterator[Path]:
    """A path to write to, which takes the place of `path` when the block ends and goes when the block fails.

    Its name has the suffix of `path`, since writers of films and arrays go by it.
    """
    partial = path.with_name(f".{path.stem[:200]}{PARTIAL}{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file aside and renames it."""
    with aside(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Writes a text in UTF-8, as `write_bytes` does; odd bytes of file names are escaped."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Writes JSON as `write_text` does. NaN is refused."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """The contents that `write_json` gives a file."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode("utf-8")


def save_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Writes an npz file as `write_bytes` does. Raises OSError where the disk is full."""
    with aside(path) as partial:
        np.savez(partial, **arrays)  # type: ignore[arg-type]


def allocate(path: Path, size: int) -> None:
    """Makes a file of a size whose bytes the disk has set aside, keeping what it holds.

    A map of a file with holes in it ends the process by SIGBUS when the disk is full. On file systems that copy on
    write a full disk may still do so later.

    Args:
        path: The file; made where it does not exist.
        size: [bytes]

    Raises:
        OSError: the disk is full; a file that was made for this is gone then.
    """
    there = path.exists()
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file, 0, size)
        else:  # macOS
            for start in range(os.fstat(file).st_size, size, 1 << 20):
                os.pwrite(file, bytes(min(1 << 20, size - start)), start)
    except OSError as error:
        if not there:
            path.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        os.close(file)


def remove(path: Path) -> None:
    """Removes whatever is there: a file, a link (not what it points to), or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


# ---- What lies at a path that a user or a file of theirs names; such a name may be anything.


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
