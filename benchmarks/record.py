"""Records of benchmark figures: JSON files that are not overwritten by a record with fewer entries.

Entries of a record are the members of its nested objects, and the items of lists of objects (runs, policies, rows).
Numbers of samples (`_SIZES`) must not decrease, and `quick` must not become true; other plain values may change. JSON
has no NaN and no infinity: these become null. Numbers are rounded to 9 digits, more than libraries agree on.
"""

import argparse
import math
from collections import Counter
from pathlib import Path
from typing import Any

from twin.errors import InputError, print_error
from twin.files import read_json, write_json

_NAMES = ("id", "quantity", "task", "setup", "seed", "policy", "name")
"""Members that identify an object in a list."""
_SIZES = ("trials", "worlds", "experiments", "pictures")
"""Members that count samples."""
_LISTED = 4
"""Number of missing entries that an error names."""


def record_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser with the options of `add_record_options`; `description` is the script's docstring."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_record_options(parser)
    return parser


def add_record_options(parser: argparse.ArgumentParser) -> None:
    """Adds `--json` and `--replace-record`."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure here")
    parser.add_argument(
        "--replace-record", action="store_true", help="overwrite a record even with one that lacks some of its entries"
    )


def lost(old: Any, new: Any, where: str = "") -> list[str]:
    """Names of the entries that a new JSON value lacks; `where` is the path of both values within their record."""
    if isinstance(old, dict):
        if not isinstance(new, dict):
            return [where or "all of it"]
        return [name for key in old for name in _lost_member(old, new, key, where)]
    if isinstance(old, list):
        mine, its = _labelled(old), _labelled(new if isinstance(new, list) else [])
        return [
            name
            for label, item in mine.items()
            for name in (lost(item, its[label], f"{where}[{label}]") if label in its else [f"{where}[{label}]"])
        ]
    return []


def _lost_member(old: dict[str, Any], new: dict[str, Any], key: str, where: str) -> list[str]:
    name, before, now = f"{where}.{key}".lstrip("."), old[key], new.get(key)
    if key not in new or (now is None and before is not None):
        return [name]
    fewer = key in _SIZES and isinstance(before, int) and isinstance(now, int) and now < before
    if fewer or (key == "quick" and now is True and before is False):
        return [f"{name} ({now} instead of {before})"]
    return lost(before, now, name)


def _labelled(items: list[Any]) -> dict[str, Any]:
    """The objects of a list by label, numbered if labels repeat; other items are left out."""
    out, count = {}, Counter[str]()
    for item in items:
        if isinstance(item, dict):
            label = " ".join(str(item[key]) for key in _NAMES if key in item)
            count[label] += 1
            out[label if count[label] == 1 else f"{label} #{count[label]}"] = item
    return out


def write_so_far(path: Path, record: dict[str, Any]) -> None:
    """Writes the intermediate record of a long run to `<path>.partial`, which `write_record` removes."""
    write_json(_partial(path), _finite(record))


def write_record(path: Path, record: dict[str, Any], replace: bool | None = False) -> None:
    """Writes a record.

    Args:
        record: A JSON object; may contain NaN and infinity.
        replace: True overwrites a record even if the new one lacks entries. None means False in a script that has no
            `--replace-record`.

    Raises:
        InputError: the file has entries that the new record lacks, or is no record. The file is kept, and the new
            record is in `<path>.partial`.
    """
    if not replace and path.exists():
        wrong = _reason_to_keep(path, record)
        if wrong:
            write_so_far(path, record)
            raise InputError(
                f"{path} {wrong}; it is kept and the new figures are in {_partial(path)}: "
                f"give another file{'' if replace is None else ', or --replace-record'}"
            )
    write_json(path, _finite(record))
    _partial(path).unlink(missing_ok=True)


def _reason_to_keep(path: Path, record: dict[str, Any]) -> str:
    """Reason not to overwrite a file; empty if there is none."""
    try:
        old = read_json(path)
    except InputError:
        return "is not a record of figures"
    gone = lost(old, _finite(record))
    if not gone:
        return ""
    more = f" and {len(gone) - _LISTED} more" if len(gone) > _LISTED else ""
    return f"has entries that the new record lacks ({', '.join(gone[:_LISTED])}{more})"


def save(path: Path | None, record: dict[str, Any], replace: bool | None = False) -> int:
    """Calls `write_record` at the end of a script; writes nothing if `path` is None.

    Returns:
        The exit status: 0, or 2 with one line on standard error.
    """
    try:
        if path:
            write_record(path, record, replace)
    except (InputError, OSError) as error:
        return print_error(error)
    return 0


def _partial(path: Path) -> Path:
    return path.with_name(f"{path.name}.partial")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if not isinstance(value, float):
        return value
    return float(f"{value:.9g}") if math.isfinite(value) else None
