"""Progress on standard error: a bar with time left on a terminal, a line now and then elsewhere, nothing when quiet."""

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Silences (or restores) every bar of this process."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Whether bars are silenced in this process."""
    return _quiet


def bar(what: str, total: int, unit: str = "it", after: float = 0.0) -> tqdm:
    """A bar to be driven by hand: `update(n)`, `set_postfix_str(s)`, `close()`; also a context manager.

    It shows from `after` seconds on, for what takes long the first time only.
    """
    every = 0.1 if sys.stderr.isatty() else 10.0
    return tqdm(
        total=total, desc=f"  {what}", unit=unit, disable=_quiet, mininterval=every, dynamic_ncols=True, delay=after
    )


def track(items: Iterable[T], what: str, total: int | None = None, unit: str = "it") -> Iterator[T]:
    """Yields the items under a bar."""
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    with bar(what, total, unit) as progress:
        for item in items:
            yield item
            progress.update()


def say(line: str) -> None:
    """One line for the user, above the bars."""
    if not _quiet:
        tqdm.write(line, file=sys.stderr)
