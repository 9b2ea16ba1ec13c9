"""The command `twin`, also `python -m twin`: a map of the verbs, and the way to each of them."""

import importlib
import sys

VERBS = {
    "new": "start a scene folder from films or photos",
    "build": "turn a scene folder into a drivable twin, with a report and a review film",
    "relight": "add a lighting to a built scene, from one photo",
    "align": "fit the robot to a log of a real one, or its camera to a film",
    "film": "film a drive in a built scene",
    "export": "write the place for other programs: glTF mesh, Gaussian splats",
    "train": "train a policy on a task of a built scene",
    "validate": "measure how often policies succeed, lighting by lighting",
    "forecast": "predict success on the real road from success in the twin",
    "reality": "the known-truth world: film it, and drive policies in it",
}
"""The verbs in the order in which a user meets them. `twin VERB` is `python -m twin.VERB`."""


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
    if given[0] not in VERBS:
        from twin.errors import shown

        print(f"error: no verb {shown(given[0])}; expected one of {', '.join(VERBS)}", file=sys.stderr)
        return 2
    where = "twin.reality.__main__" if given[0] == "reality" else f"twin.{given[0]}"
    status: int = importlib.import_module(where).main(given[1:])
    return status


def _map() -> str:
    rows = [f"  {name:<10} {what}" for name, what in VERBS.items()]
    head = ["usage: twin VERB ...", "", "A filmed place as a MuJoCo digital twin. The verbs, in the order of use:", ""]
    return "\n".join([*head, *rows, "", "twin VERB --help shows a verb's options. Begin with: twin new SCENE VIDEO..."])


if __name__ == "__main__":
    sys.exit(main())
