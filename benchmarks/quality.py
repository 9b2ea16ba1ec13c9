"""Picture quality against training time: held-out scores of a scene's field at each `nerf.quality`.

    python benchmarks/quality.py SCENE [--qualities draft standard high] [--json FILE] [--picture docs/quality.png]

The scene must be built up to stage `metric`; the fields are trained from its cameras in a temporary folder. Times are
those of stage `field` alone, on an otherwise idle machine.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from record import record_parser, save

from twin.config import QUALITIES
from twin.config_file import load_config
from twin.nerf.trainer import run
from twin.scene import SceneDir

_COLUMNS = ("psnr", "ssim", "psnr_small", "ssim_small", "psnr_small_lower", "ssim_small_lower")


def measure(scene: SceneDir, quality: str) -> dict[str, Any]:
    """Minutes of stage `field`, mean scores over the lightings, and scores by lighting."""
    config = load_config(scene.config_file, (f"nerf.quality={quality}",))
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        metrics = run(scene, config, Path(out))
    minutes = (time.perf_counter() - began) / 60.0
    by_lighting = {column: metrics[column] for column in _COLUMNS}
    means = {column: float(np.mean(list(values.values()))) for column, values in by_lighting.items() if values}
    return {"minutes": minutes, "n": sum(metrics["n"].values()), **means, "by_lighting": by_lighting}


def draw(figures: dict[str, dict[str, Any]], path: Path) -> None:
    """Plots PSNR against minutes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    minutes = [row["minutes"] for row in figures.values()]
    for column, marker, label in (
        ("psnr_small_lower", "s", "at 160×90, lower half"),
        ("psnr_small", "o", "at 160×90"),
        ("psnr", "^", "at the training resolution"),
    ):
        axes.plot(minutes, [row[column] for row in figures.values()], marker=marker, label=label)
    top = [row["psnr_small_lower"] for row in figures.values()]
    for name, x, y in zip(figures, minutes, top, strict=True):
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(0, 7), ha="center")
    axes.margins(0.12)
    axes.set(xlabel="minutes of stage field", ylabel="held-out PSNR [dB], mean over lightings")
    axes.grid(alpha=0.3)
    axes.legend(loc="center right")
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--qualities", nargs="+", choices=tuple(QUALITIES), default=list(QUALITIES))
    parser.add_argument("--picture", type=Path, help="write the plot to this file")
    options = parser.parse_args()
    figures: dict[str, dict[str, Any]] = {}
    print(f"{'quality':9} {'minutes':>7} " + " ".join(f"{column:>16}" for column in _COLUMNS))
    for quality in options.qualities:
        row = figures[quality] = measure(SceneDir(options.scene), quality)
        scores = " ".join(f"{row.get(column, float('nan')):16.3f}" for column in _COLUMNS)
        print(f"{quality:9} {row['minutes']:7.1f} {scores}", flush=True)
        for column in ("psnr", "ssim", "psnr_small_lower"):
            print(f"{'':9} {column}: " + ", ".join(f"{k} {v:.3f}" for k, v in row["by_lighting"][column].items()))
    if options.picture:
        draw(figures, options.picture)
    return save(options.json, figures, options.replace_record)


if __name__ == "__main__":
    sys.exit(main())
