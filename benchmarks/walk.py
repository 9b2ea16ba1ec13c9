"""Runs the README's commands in order on a copy of the checkout, before a release; takes an hour.

    python benchmarks/walk.py [--shell bash|zsh] [--index]

Skipped: commands on `scenes/my_road`, which needs films; the test suite, which CI runs; and without `--index` the
command that fetches PyTorch from its own index. Prints each command with its start time; the exit status is 1 if one
fails.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


def commands(text: str, index: bool) -> list[str]:
    """Commands in the shell blocks of a page, without the skipped ones."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.S | re.M)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.strip()]
    lines = [line for line in lines if "my_road" not in line and "pytest" not in line]
    return [line for line in lines if index or "--index-url" not in line]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shell", choices=("bash", "zsh"), default="bash", help="(default: %(default)s)")
    parser.add_argument("--index", action="store_true", help="fetch PyTorch from its own index, as the README does")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=_ROOT, check=True, stdout=subprocess.PIPE)
        subprocess.run(["tar", "x", "-C", folder], input=archive.stdout, check=True)
        lines = commands((Path(folder) / "README.md").read_text(encoding="utf-8"), options.index)
        # One shell for all, as the first command activates the environment.
        script = "".join(
            f"echo '+ {line}'; date +%s\n{line} || exit 1\n" for line in (one.replace("'", '"') for one in lines)
        )
        start = time.perf_counter()
        done = subprocess.run([options.shell, "-c", script], cwd=folder, stdout=subprocess.PIPE, text=True)
        print(done.stdout)
        print(f"{len(lines)} commands, {time.perf_counter() - start:.0f} s, exit status {done.returncode}")
    return int(done.returncode != 0)


if __name__ == "__main__":
    sys.exit(main())
