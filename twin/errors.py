"""The one exception that means "the input is wrong", as opposed to a bug of ours."""


class InputError(ValueError):
    """Bad input. Its message is one line: the value, what was expected, and the cure. The verbs exit with status 2."""
