"""The one exception that means "the input is wrong", as opposed to a bug of ours; and how verbs end on it."""

import sys


class InputError(ValueError):
    """Bad input. Its message is one line: the value, what was expected, and the cure. The verbs exit with status 2."""


def refuse(why: Exception | str) -> int:
    """Says in one line on standard error what is wrong with the input; returns the exit status of the verb, 2."""
    print("error: " + " ".join(str(why).split()), file=sys.stderr)
    return 2
