"""The one exception that means "the input is wrong", as opposed to a bug of ours; and how its message is kept short."""

import contextlib
import re
import sys
from collections.abc import Iterable
from typing import Any

_VALUE = 80  # characters of a value that a message repeats
_WORD = 300  # characters of a word, such as a path
_MESSAGE = 1500  # characters of a message
_LONG_VALUES = (
    # In quotes: an apostrophe within a word opens none.
    re.compile(rf"(?<!\w)'([^']{{{_VALUE - 3}}})[^']{{4,}}'(?!\w)"),
    re.compile(rf'(?<!\w)"([^"]{{{_VALUE - 3}}})[^"]{{4,}}"(?!\w)'),
)
_LONG_NUMBER = re.compile(rf"(\d{{{_VALUE - 3}}})\d{{4,}}")
_LONG_WORD = re.compile(rf"(\S{{{_WORD - 63}}})\S{{4,}}(\S{{60}})")


class InputError(ValueError):
    """Bad input. Its message is one line: the value, what was expected, and the cure. The verbs exit with status 2.

    A message repeats at most 80 characters of a value and 300 of a path; what is longer is cut.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(shortened(str(message)))


def shortened(message: str) -> str:
    """A message in one line of printable characters, whose quoted values, numbers and words are cut where long."""
    if len(message) > 2 * _MESSAGE:  # before the patterns: a value may have megabytes
        message = f"{message[:_MESSAGE]}...{message[-_MESSAGE:]}"
    message = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
    for pattern in _LONG_VALUES:
        message = pattern.sub(lambda found: found[0][0] + found[1] + "..." + found[0][-1], message)
    message = _LONG_WORD.sub(r"\1...\2", _LONG_NUMBER.sub(r"\1...", message))
    if len(message) > _MESSAGE:
        message = f"{message[: _MESSAGE // 2]}...{message[-_MESSAGE // 2 :]}"
    return message


def shown(value: Any) -> str:
    """`repr` of a value from a file, cut at 80 characters, however deep it is nested."""
    try:
        text = repr(value)
    except RecursionError:
        return f"a {type(value).__name__} nested too deep to be shown"
    except ValueError:  # an integer of more digits than Python prints
        return f"a {type(value).__name__} of too many digits to be shown"
    return text if len(text) <= _VALUE else f"{text[: _VALUE - 3]}..."


def listing(names: Iterable[str], most: int = 4) -> str:
    """ "a", "a and b", "a, b and c"; beyond `most`, how many more there are."""
    names = [str(name) for name in names]
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} more"]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else "none"


def refuse(why: Exception | str) -> int:
    """Prints in one line on standard error what is wrong with the input; returns the exit status of the verb, 2."""
    with contextlib.suppress(OSError):  # where the terminal is gone
        print(f"error: {shortened(str(why))}", file=sys.stderr)
    return 2
