"""The command `twin`, also `python -m twin`: a map of the verbs, and the way to each of them."""

import sys

from twin import commands
from twin.errors import print_error, short_repr


def main(arguments: list[str] | None = None) -> int:
    """Runs a verb; returns its exit status, see `twin.cli`."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given or given[0] in ("-h", "--help", "help"):
        print(_map())
        return 0
    if given[0] == "--version":
        from importlib import metadata

        print(f"twin {metadata.version('twin')}")
        return 0
    if given[0] not in commands.VERBS:
        return print_error(f"no verb {short_repr(given[0])}; expected one of {', '.join(commands.VERBS)}")
    return commands.main(given[0], given[1:])


def _map() -> str:
    rows = [f"  {name:<10} {verb.summary}" for name, verb in commands.VERBS.items()]
    head = ["usage: twin VERB ...", "", "A filmed place as a MuJoCo digital twin. The verbs, in the order of use:", ""]
    return "\n".join([*head, *rows, "", "twin VERB --help shows a verb's options. Begin with: twin new SCENE VIDEO..."])


if __name__ == "__main__":
    sys.exit(main())
