"""Benchmark of the environment: speed, memory, scripted drivers, exploits, endurance, trust score, obstacles, GPU.

    python benchmarks/env.py --scene BUILT_SCENE [--only SECTION ...] [--json FILE]

Prints a table; `env_sections.py` defines each figure. The robot drives the tasks `straight` and `right_turn`, or the
whole route in a scene that has neither. Speeds are for 160×90 images, 10 Hz control and 2 ms physics; each is the best
of one to eight short runs in a separate process that is bound to the stated number of cores.
"""

import argparse
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from field import format_figure
from record import add_record_options, save, write_so_far

TARGETS: dict[str, tuple[str, float]] = {
    "single.steps_per_s": ("≥", 60.0),
    "batch8.steps_per_s": ("≥", 130.0),
    "worlds64.bytes": ("≤", 3e9),
    "driver.success.straight": ("≥", 0.99),
    "driver.success.right_turn": ("≥", 0.99),
    "audit.false_successes": ("≤", 0.0),
    "soak.growth_bytes": ("≤", 32 * 2**20),
    "seen_touched.median_m": ("≤", 0.05),
    "overlay.obstacle_psnr.sun": ("≥", 18.0),
    "overlay.obstacle_psnr.overcast": ("≥", 18.0),
    "overlay.obstacle_psnr.night": ("≥", 18.0),
    "overlay.mask_iou": ("≥", 0.9),
    "gpu.steps_per_s": ("≥", 10_000.0),
}
"""Figure → comparison and target."""


def verdict(name: str, value: Any) -> tuple[str, str]:
    """A figure's target and "yes" if it is met, else "no"; two empty strings for a figure without a target."""
    if name not in TARGETS:
        return "", ""
    sense, wanted = TARGETS[name]
    met = isinstance(value, int | float) and (value <= wanted if sense == "≤" else value >= wanted)
    return f"{sense} {wanted:,.4g}" if wanted < 1e6 else f"{sense} {wanted:,.0f}", "yes" if met else "no"


def main() -> int:
    from env_sections import SECTIONS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True, help="a built scene, such as scenes/demo")
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), metavar="SECTION")
    add_record_options(parser)
    parser.add_argument("--quick", action="store_true", help="tiny settings that only test the script")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    record: dict[str, Any] = {}
    print(f"{'figure':36} {'value':>16} {'target':>14}  met")
    for section in options.only or list(SECTIONS):
        found = SECTIONS[section](options.scene, options.quick)
        figures |= found
        for name, value in found.items():
            wanted, met = verdict(name, value)
            print(f"{name:36} {format_figure(value):>16} {wanted:>14}  {met}".rstrip(), flush=True)
        if options.json:  # after every section, so that an interrupted run keeps its figures
            record = figures | {"about": about(options)}
            write_so_far(options.json, record)
    return save(options.json, record, options.replace_record)


def about(options: argparse.Namespace) -> dict[str, Any]:
    """Machine and package versions of the measurement."""
    versions = {name: metadata.version(name) for name in ("twin", "mujoco", "mujoco-warp", "warp-lang", "numpy")}
    return {"machine": platform.machine(), "versions": versions, "quick": options.quick}


if __name__ == "__main__":
    sys.exit(main())
