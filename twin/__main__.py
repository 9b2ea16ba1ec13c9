"""The command `twin`, also `python -m twin`: lists its subcommands (verbs), or runs one of them."""

import sys

from twin import commands
from twin.errors import name_hint, print_error, short_repr


def main(arguments: list[str] | None = None) -> int:
    """Runs a verb; returns its exit status, see `twin.command_line`."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given or given[0] in ("-h", "--help", "help"):
        print("usage: twin VERB ...\n\nA filmed place as a MuJoCo digital twin. The verbs, in the order of use:\n")
        for name, verb in commands.VERBS.items():
            print(f"  {name:<10} {verb.summary}")
        print("\ntwin VERB --help shows a verb's options. Begin with: twin new SCENE VIDEO...")
    elif given[0] == "--version":
        from importlib import metadata

        print(f"twin {metadata.version('twin')}")
    elif given[0] not in commands.VERBS:
        every = f"expected one of {', '.join(commands.VERBS)}"
        return print_error(f"no verb {short_repr(given[0])}; {name_hint(given[0], commands.VERBS, every)}")
    else:
        return commands.main(given[0], given[1:])
    return 0


if __name__ == "__main__":
    sys.exit(main())
