"""Benchmark of the environment: speed, memory, scripted drivers, exploits, endurance, trust score, obstacles, GPU.

    python benchmarks/env.py --scene BUILT_SCENE [--only SECTION ...] [--json FILE]

Prints a table; `env_sections.py` defines each figure. The robot drives the tasks `straight` and `right_turn`, or the
whole route in a scene that has neither. Speeds are for 160×90 images, 10 Hz control and 2 ms physics; each is the best
of one to eight short runs in a separate process that is bound to the stated number of cores.
"""

import platform
import sys
from functools import partial
from pathlib import Path

from record import record_parser
from sections import run_sections, versions

TARGETS: dict[str, tuple[str, float]] = {
    "single.steps_per_s": ("≥", 60.0),
    "batch8.steps_per_s": ("≥", 130.0),
    "worlds64.bytes": ("≤", 3e9),
    "driver.success.straight": ("≥", 0.99),
    "driver.success.right_turn": ("≥", 0.99),
    "audit.false_successes": ("≤", 0.0),
    "soak.growth_bytes": ("≤", 32 * 2**20),
    "gpu.steps_per_s": ("≥", 10_000.0),
}
"""Figure → comparison and target."""


def main() -> int:
    from env_sections import SECTIONS

    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a built scene, such as scenes/demo")
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), metavar="SECTION")
    parser.add_argument("--quick", action="store_true", help="tiny settings that only test the script")
    options = parser.parse_args()
    packages = versions("twin", "mujoco", "mujoco-warp", "warp-lang", "numpy")
    about = {"machine": platform.machine(), "versions": packages, "quick": options.quick}
    chosen = [partial(SECTIONS[name], options.scene, options.quick) for name in options.only or SECTIONS]
    return run_sections(chosen, TARGETS, about, options.json, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
