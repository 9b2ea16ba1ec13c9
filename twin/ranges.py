"""Ranges of settings, which are annotations of dataclass fields."""

import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from numbers import Real
from typing import Any

from twin.errors import InputError, short_repr


@dataclass(frozen=True)
class Range:
    """Bounds of a setting, both included, as in `Annotated[float, Range(0, 1)]`."""

    low: float
    high: float = math.inf


@cache
def setting_ranges(kind: type) -> dict[str, Range]:
    """The ranges of a dataclass's fields, by name, for those that have one."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {name: bound for name, hint in hints.items() for bound in getattr(hint, "__metadata__", ())}


def check_ranges(settings: Any, prefix: str = "", suffix: str = "") -> None:
    """Checks the fields of a dataclass that have a range; of tuples, every number.

    Raises:
        InputError: a value is out of range or no number; the message names the field between prefix and suffix.
    """
    kind: type = type(settings)
    for name, bounds in setting_ranges(kind).items():
        for value in _leaves(getattr(settings, name)):
            check_range(value, bounds, f"{prefix}{name}{suffix}")


def check_range(value: Any, bounds: Range, what: str) -> None:
    """Raises InputError if a value is out of range or no number; the message begins with `what`."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and bounds.low <= value <= bounds.high):
        low, high = f"{bounds.low:,.10g}", f"{bounds.high:,.10g}"
        expected = f"at least {low}" if bounds.high == math.inf else f"{low} to {high}"
        short = number and abs(value) < 1e15  # a huge integer is no float
        raise InputError(f"{what} = {f'{value:,.10g}' if short else short_repr(value)}; expected {expected}")


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, tuple | list):
        for part in value:
            yield from _leaves(part)
    else:
        yield value
