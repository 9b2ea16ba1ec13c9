"""Runs the README's commands in order in a copy of the last commit, before a release; takes an hour.

    python benchmarks/walk.py [--shell bash|zsh] [--index] [--until WORDS]

Skipped: commands on `scenes/my_road`, which needs films; the test suite, which CI runs; and without `--index` the
command that fetches PyTorch from its own index. The shell is interactive, as for pasted text, and reads no start-up
files. Prints each command with its time; the exit status is that of the first command that fails.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_START = {"bash": ("--norc", "--noprofile"), "zsh": ("-f",)}
_INHERITED = ("PYTHONPATH", "VIRTUAL_ENV")  # would make the copy use another checkout


def commands(text: str, index: bool) -> list[str]:
    """Commands in the shell blocks of a page, without comments and skipped ones; a line with `&&` gives several."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.S | re.M)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.strip()]
    lines = [line.partition("  #")[0] for line in lines if "my_road" not in line and "pytest" not in line]
    return [one for line in lines if index or "--index-url" not in line for one in line.split(" && ")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shell", choices=tuple(_START), default="bash", help="(default: %(default)s)")
    parser.add_argument("--index", action="store_true", help="fetch PyTorch from its own index, as the README does")
    parser.add_argument(
        "--until", metavar="WORDS", help='stop after the first command that contains WORDS, e.g. "build"'
    )
    options = parser.parse_args()
    environment = {name: value for name, value in os.environ.items() if name not in _INHERITED}
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=_ROOT, check=True, stdout=subprocess.PIPE)
        subprocess.run(["tar", "x", "-C", folder], input=archive.stdout, check=True)
        lines = commands((Path(folder) / "README.md").read_text(encoding="utf-8"), options.index)
        if options.until:
            last = next((k for k, line in enumerate(lines) if options.until in line), None)
            if last is None:
                parser.error(f"no command of the README has {options.until!r}")
            lines = lines[: last + 1]
        # One shell for all, as the first command activates the environment.
        steps = (f'printf "%s + %s\\n" "$(date +%T)" {shlex.quote(line)}\n{line} || exit\n' for line in lines)
        start = time.perf_counter()
        shell = [options.shell, *_START[options.shell], "-i", "-c", "".join(steps)]
        done = subprocess.run(shell, cwd=folder, env=environment, stdin=subprocess.DEVNULL)
        print(f"{len(lines)} commands, {time.perf_counter() - start:.0f} s, exit status {done.returncode}")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
