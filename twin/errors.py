"""`InputError`, which is raised for wrong input (not for bugs), and helpers for short error messages."""

import contextlib
import difflib
import re
import sys
from collections.abc import Iterable
from typing import Any

_MAX_VALUE = 80  # largest number of characters of a value in a message
_MAX_WORD = 300  # largest number of characters of a word, such as a path
_MAX_MESSAGE = 1500  # largest number of characters of a message
_LONG_VALUES = (
    # Values in quotes; an apostrophe within a word does not count as a quote.
    re.compile(rf"(?<!\w)'([^']{{{_MAX_VALUE - 3}}})[^']{{4,}}'(?!\w)"),
    re.compile(rf'(?<!\w)"([^"]{{{_MAX_VALUE - 3}}})[^"]{{4,}}"(?!\w)'),
)
_LONG_NUMBER = re.compile(rf"(\d{{{_MAX_VALUE - 3}}})\d{{4,}}")
_LONG_WORD = re.compile(rf"(\S{{{_MAX_WORD - 63}}})\S{{4,}}(\S{{60}})")


class InputError(ValueError):
    """Wrong input. The message is one line with the value, what was expected, and the cure. The command prints it and
    exits with status 2."""

    def __init__(self, message: object = "") -> None:
        super().__init__(shortened(str(message)))


def shortened(message: str) -> str:
    """A message as one line of printable characters, in which long quoted values, numbers and words are cut."""
    if len(message) > 2 * _MAX_MESSAGE:  # before the patterns, which would be slow on values of megabytes
        message = f"{message[:_MAX_MESSAGE]}...{message[-_MAX_MESSAGE:]}"
    message = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
    for pattern in _LONG_VALUES:
        message = pattern.sub(lambda found: found[0][0] + found[1] + "..." + found[0][-1], message)
    message = _LONG_WORD.sub(r"\1...\2", _LONG_NUMBER.sub(r"\1...", message))
    if len(message) > _MAX_MESSAGE:
        message = f"{message[: _MAX_MESSAGE // 2]}...{message[-_MAX_MESSAGE // 2 :]}"
    return message


def short_repr(value: Any) -> str:
    """`repr` of a value from a file, cut to 80 characters; a value that Python cannot print is described instead."""
    try:
        text = repr(value)
    except RecursionError:
        return f"a {type(value).__name__} nested too deep to be shown"
    except ValueError:  # an integer of more digits than Python prints
        return f"a {type(value).__name__} of too many digits to be shown"
    return text if len(text) <= _MAX_VALUE else f"{text[: _MAX_VALUE - 3]}..."


def join_names(names: Iterable[str], most: int = 4) -> str:
    """Joins names as "a", "a and b", "a, b and c"; beyond `most` names, "... and 3 more"."""
    names = [str(name) for name in names]
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} more"]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else "none"


def name_hint(name: str, valid: Iterable[str], otherwise: str | None = None) -> str:
    """End of a message about an unknown name: "did you mean ...?" if a valid one is similar.

    If none is, it is `otherwise`, by default a list of the valid names.
    """
    by_lower = {one.lower(): one for one in valid}
    if near := difflib.get_close_matches(name.lower()[:_MAX_VALUE], list(by_lower), n=1):
        return f"did you mean {by_lower[near[0]]!r}?"
    names = list(by_lower.values())
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"expected one of {listed}" if otherwise is None else otherwise


def print_error(why: Exception | str) -> int:
    """Prints an error line on standard error and returns the exit status 2."""
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"error: {shortened(str(why))}", file=sys.stderr)
    return 2
