"""Benchmark of the radiance field and its renderer: training within time budgets, baking, speed, depth, memory, GPU.

    python benchmarks/field.py --scene BUILT_SCENE [--only fox bake render depth train gpu] [--json FILE] [--quick]

Prints a table; `field_sections.py` defines each figure. `fox` reads the real capture `fox` in `--data`
(default: ../shared/data beside the project) and trains for 60, 300 and 1200 s. All sections except `fox` and `gpu` need
a complete build and write nothing into the scene. A full run takes about 35 minutes on an otherwise idle machine.
"""

import platform
import sys
import tempfile
from functools import partial
from pathlib import Path

from field_common import Bench
from record import record_parser
from sections import run_sections, versions

from twin.runtime import available_cores

TARGETS: dict[str, tuple[str, float]] = {
    "fox.psnr_60s": ("≥", 24.0),
    "fox.psnr_300s": ("≥", 25.5),
    "fox.seconds_60s": ("≤", 60.0),
    "fox.seconds_300s": ("≤", 300.0),
    "fox.seconds_1200s": ("≤", 1200.0),
    "bake.psnr_drop": ("≤", 0.5),
    "bake.bytes": ("≤", 150e6),
    "render.fps_1core": ("≥", 100.0),
    "render.fps_2core": ("≥", 190.0),
    "render.ratio_to_nerfacto": ("≥", 1000.0),
    "render.first_frame_s": ("≤", 1.0),
    "render.cold_compile_s": ("≤", 30.0),
    "depth.median_error_m": ("≤", 0.05),
    "train.peak_bytes": ("≤", 3e9),
    "gpu.fox.psnr_60s": ("≥", 26.5),
    "gpu.render_fps": ("≥", 10000.0),
    "gpu.cpu_difference_mean": ("≤", 1 / 255),
}
"""Figure → comparison and target. A PSNR within a budget also fails if training exceeded the budget."""


def main() -> int:
    from field_sections import NEED_SCENE, SECTIONS

    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, help="a built scene, such as scenes/demo")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared/data")
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), metavar="SECTION")
    parser.add_argument(
        "--budgets",
        nargs="+",
        type=int,
        default=[60, 300, 1200],
        metavar="S",
        help="training times of section `fox` [s]",
    )
    parser.add_argument("--quick", action="store_true", help="tiny settings that only test the script")
    options = parser.parse_args()
    sections = options.only or list(SECTIONS)
    if not options.scene and any(name in NEED_SCENE for name in sections):
        parser.error(f"--scene is needed for {', '.join(name for name in sections if name in NEED_SCENE)}")
    if "fox" in sections and not (options.data / "fox").is_dir():
        parser.error(f"no folder fox in {options.data}; give another --data, or leave the section out with --only")

    packages = versions("twin", "torch", "warp-lang", "numpy")
    about = {"cores": available_cores(), "machine": platform.machine(), "versions": packages, "quick": options.quick}
    with tempfile.TemporaryDirectory() as work:
        bench = Bench(options.scene, options.data, Path(work), tuple(options.budgets), options.quick)
        chosen = [partial(SECTIONS[name], bench) for name in sections]
        return run_sections(chosen, TARGETS, about, options.json, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
