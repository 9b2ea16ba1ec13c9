"""Runs the sections of `env.py` and `field.py`: prints their figures beside targets, and keeps a record of them."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from record import save, write_so_far

Targets = Mapping[str, tuple[str, float]]
"""Figure → comparison, ≥ or ≤, and target."""
_HERE = Path(__file__).parent


def verdict(name: str, figures: dict[str, Any], targets: Targets) -> tuple[str, str]:
    """A figure's target and "yes" or "no"; empty strings for a figure without a target.

    If training exceeded the budget of a PSNR, the second text is "no" with the time it took, even without a target.
    """
    overtime = ""
    section, _, rest = name.rpartition(".")
    if rest.startswith("psnr_") and rest.split("_")[1].removesuffix("s").isdigit():
        budget = rest.split("_")[1]
        wall = figures.get(f"{section}.seconds_{budget}", 0.0)
        if wall > float(budget.removesuffix("s")):
            overtime = f"no, took {wall:.1f} s"
    if name not in targets:
        return "", overtime
    (sense, wanted), value = targets[name], figures[name]
    met = isinstance(value, int | float) and (value <= wanted if sense == "≤" else value >= wanted)
    return f"{sense} {format_figure(float(wanted))}", overtime or ("yes" if met else "no")


def format_figure(value: Any) -> str:
    """A figure as text for the table."""
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def run_sections(
    sections: Iterable[Callable[[], dict[str, Any]]],
    targets: Targets,
    about: dict[str, Any],
    path: Path | None,
    replace: bool,
) -> int:
    """Measures sections, prints a table, and writes a record with the member `about`; returns the exit status."""
    figures: dict[str, Any] = {}
    print(f"{'figure':36} {'value':>16} {'target':>14}  met")
    for measure in sections:
        found = measure()
        figures |= found
        for name in found:
            wanted, met = verdict(name, figures, targets)
            print(f"{name:36} {format_figure(figures[name]):>16} {wanted:>14}  {met}".rstrip(), flush=True)
        if path:  # after every section, so that an interrupted run keeps its figures
            write_so_far(path, figures | {"about": about})
    return save(path, figures | {"about": about}, replace)


def versions(*packages: str) -> dict[str, str]:
    return {name: metadata.version(name) for name in packages}


def run_worker(
    script: str, arguments: tuple[Any, ...], environment: dict[str, str], launcher: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The JSON that a script of this folder prints last, in a process of its own with clean memory and caches.

    `launcher` are words before the command, such as `taskset`. Raises RuntimeError: the process failed.
    """
    command = [*launcher, sys.executable, str(_HERE / script), *map(str, arguments)]
    path = os.pathsep.join(filter(None, [str(_HERE.parent), os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path} | environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, arguments))}:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])
