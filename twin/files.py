"""Checked reading and atomic writing of files.

Readers accept regular files only, so that they never block on a pipe, and raise `InputError` with the file's name for
any defect. Writers write a `.partial` file and rename it, so if the disk is full or the process is killed, the old file
remains unchanged.
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
import tempfile
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from twin.errors import InputError

_MAX_TEXT = 64 << 20  # [bytes] largest JSON or CSV file
_MAX_DIGITS = 40  # largest number of digits of an integer in JSON; the state of a random generator has 39
_MAX_ARRAYS = 2 << 30  # [bytes] largest total size of the arrays in a file, uncompressed
_MAX_TOML = 4 << 20  # [bytes] largest TOML file
_DEEP_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){64}""")  # 64 or more dotted parts
_INT64_LIMIT = 2**63  # bound of TOML integers
_FILE_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


# Unlike the methods of `Path`, these return False for an invalid file name. `is_link` is True even without a target.
exists, is_file, is_link = os.path.exists, os.path.isfile, os.path.islink

# ---- reading


def regular_file(path: Path) -> Path:
    """Returns the path of a regular file, or of a link to one. Raises InputError for anything else."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        what = "a link to nothing" if is_link(path) else getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: {what}; expected a file") from None
    if kind != stat.S_IFREG:
        raise InputError(f"{path} is {_FILE_KINDS.get(kind, 'no regular file')}; expected a file")
    return path


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The contents of a file. Raises InputError as `regular_file` does, or if there are more than `most` bytes."""
    size = regular_file(path).stat().st_size
    if most is not None and size > most:
        raise InputError(f"{path} has {size:,} bytes; expected at most {most:,}")
    return path.read_bytes()


def read_text(path: Path, most: int = _MAX_TEXT) -> str:
    """The contents of a UTF-8 text file, with or without a byte-order mark.

    Raises InputError as `read_bytes` does, or for text that is not UTF-8.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no UTF-8 text ({error.reason} at byte {error.start}); save it as UTF-8") from None


def read_json(path: Path) -> Any:
    """The value in a JSON file. Raises InputError for other files, for numbers that are not finite, and for integers
    of more than 40 digits."""
    return parse_json(read_text(path), path)


def parse_json(text: str, where: object) -> Any:
    """The value of a JSON text, checked as in `read_json`; error messages begin with `where`."""
    try:
        return json.loads(text, parse_int=_json_integer, parse_float=_json_float, parse_constant=_json_float)
    except RecursionError:
        raise InputError(f"{where}: nested too deep; expected JSON with fewer nested values") from None
    except ValueError as error:
        raise InputError(f"{where}: no valid JSON: {error}") from None


def _json_integer(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise ValueError(f"an integer of {len(text)} digits")
    return int(text)


def _json_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} where a finite number is expected")
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file. Raises InputError for other files, or integers that do not fit 64 bits."""
    return parse_toml(read_text(path, _MAX_TOML), path)


def parse_toml(text: str, where: object) -> dict[str, Any]:
    """The table of a TOML text, checked as in `read_toml`; error messages begin with `where`."""
    try:
        if _DEEP_KEY.search(text):  # tomllib's time for such a key is quadratic in the number of its parts
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
    elif isinstance(value, int) and not -_INT64_LIMIT <= value < _INT64_LIMIT:
        raise ValueError("an integer that does not fit 64 bits")


def load_arrays(path: Path, most: int = _MAX_ARRAYS) -> dict[str, NDArray]:
    """The arrays of an npz file; loading it runs no code.

    Raises InputError as `regular_file` does, or for a damaged file, pickled objects, or more than `most` bytes in
    total.
    """
    with wrap_read_errors(regular_file(path), "expected arrays as numpy.savez writes them, without pickled objects"):
        with zipfile.ZipFile(path) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
            if total > most:
                raise InputError(f"{path} unpacks to {total:,} bytes; expected at most {most:,}")
            for entry in archive.infolist():
                _check_header(archive, entry)
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def _check_header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Raises ValueError if an array's header declares more data than the file has, before memory is allocated."""
    if not entry.filename.endswith(".npy"):
        return
    with archive.open(entry) as file:
        version = npy.read_magic(file)
        shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} declares shape {shape} of {dtype}, but has {entry.file_size} bytes")


@contextlib.contextmanager
def wrap_read_errors(path: Path, cure: str) -> Iterator[None]:
    """Converts errors in reading a file into an InputError with the file's name and the cure."""
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
    """The arrays of a safetensors file. Raises InputError for other files."""
    with wrap_read_errors(regular_file(path), "expected a safetensors file"):
        return load_file(path)


def toml_string(text: str) -> str:
    """Converts a text to a TOML string, with special characters escaped; lone surrogates are replaced."""
    text = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any, digits: int | None = None) -> str:
    """Converts a value to TOML: dicts to inline tables, lists and tuples to arrays.

    Floats are written exactly, or with `digits` significant digits.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(toml_value(item, digits) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_string(key)} = {toml_value(item, digits)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, int):
        return str(value)
    text = repr(float(value)) if digits is None else f"{value:.{digits}g}"
    return text if any(c in text for c in ".einf") else text + ".0"


def check_shapes(arrays: Mapping[str, tuple[NDArray, tuple[int, ...], str]]) -> None:
    """Raises ValueError if an array has another shape or kind than given.

    `arrays` maps each name to the array, the expected shape and the expected dtype.kind.
    """
    for name, (array, shape, kind) in arrays.items():
        if array.shape != shape or array.dtype.kind != kind:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; expected {shape} of kind {kind!r}")


def require_text(value: Any) -> str:
    """Returns a value from a JSON file if it is a text, otherwise raises TypeError."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} where a text is expected")
    return value


# ---- digests


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with regular_file(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_json(value: Any) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


# ---- writing


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path that replaces `path` when the block ends, or is removed if the block fails.

    The temporary path has the suffix of `path`, by which writers of films and arrays choose the format.
    """
    partial = path.with_name(f".{path.stem[:200]}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically."""
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Writes a UTF-8 text atomically; undecodable bytes of file names are escaped."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Writes JSON atomically. Raises ValueError for NaN."""
    write_bytes(path, json_bytes(value))


def json_bytes(value: Any) -> bytes:
    """The bytes that `write_json` writes."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode("utf-8")


def save_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Writes an npz file atomically. Raises OSError if the disk is full."""
    with atomic_path(path) as partial:
        np.savez(partial, **arrays)  # type: ignore[arg-type]


def allocate(path: Path, size: int) -> None:
    """Allocates disk space for a file up to `size` [bytes]. A missing file is created; an existing one keeps its
    contents.

    Without this, a process that writes to the memory-mapped file while the disk is full ends with SIGBUS. On
    copy-on-write file systems that may still happen. Raises OSError if the disk is full; a newly created file is
    removed.
    """
    existed = path.exists()
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if not existed:
            path.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        os.close(file)


def remove(path: Path) -> None:
    """Removes a file, a link (not its target), or a folder with its contents, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder that becomes `path` when the block ends, or is removed if the block fails."""
    partial = path.with_name(f".{path.name[:200]}.partial")
    remove(partial)
    partial.mkdir()
    try:
        yield partial
        partial.rename(path)
    finally:
        remove(partial)


# ---- paths that users give, which may be invalid


def require_parent(path: Path) -> None:
    """Raises InputError if the parent folder of a path to be written is missing."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; create it, or give another path")


def require_output(path: Path, suffixes: Sequence[str] = (), make: bool = False) -> None:
    """Raises InputError if a file cannot be written: another suffix than these, a folder, or an unusable parent folder.

    With `make`, a missing parent folder is created.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a file ending in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; give a file")
    if not make:
        require_parent(path)
    require_writable(path.parent)


def require_writable(folder: Path, cure: str = "give another path") -> None:
    """Raises InputError, with the cure, if no file can be written into a folder, which is created if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error}; {cure}") from None


def require_absent(path: Path) -> None:
    """Raises InputError if a folder to be written exists already, or its parent folder is missing."""
    require_parent(path)
    if path.exists() or path.is_symlink():
        raise InputError(f"{path} is there already; remove it, or give another folder")


def is_folder(path: Path, cure: str) -> bool:
    """True for a folder, False for a regular file. Raises InputError for anything else, with `cure` in the message."""
    with contextlib.suppress(OSError, ValueError):  # `regular_file` reports these errors
        if stat.S_ISDIR(path.stat().st_mode):
            return True
    try:
        regular_file(path)
    except InputError as error:
        raise InputError(f"{str(error).removesuffix('; expected a file')}; {cure}") from None
    return False


def require_folder(path: Path, cure: str) -> Path:
    """Returns the path of a folder. Raises InputError as `is_folder` does, or for a file."""
    if not is_folder(path, cure):
        raise InputError(f"{path} is a file; {cure}")
    return path
