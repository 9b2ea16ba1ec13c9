"""Draws the README's picture of the table 1 experiment.

    python benchmarks/table1/picture.py SCENE docs/forecast.jpg

Shows randomized episodes of the twin, test days of the simulated reality, the twin under lightings from a photo of each
of these days, and success on the road against success in the twin for every policy. SCENE holds the results of
`benchmarks/table1`.
"""

import argparse
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.colors import is_color_like, to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

import twin
from twin.evaluation.forecasting import Forecast
from twin.learn.policy import load_policy
from twin.reality.lighting import WEATHER
from twin.reality.real_test import RealTest, task_for
from twin.report.figures import CARD, INK, LINE, MUTED, SERIES
from twin.report.forecast_report import rates_against_road
from twin.types import Image

_WIDTH, _GAP, _LINE = 1640, 8, 34  # [px] total width, gap between images, height of a caption
_PER_ROW = 5  # images in a row
_SEEDS = range(1, 1 + _PER_ROW)  # seeds of the episodes in the twin's images
_SHOWN = list(WEATHER)[: 2 * _PER_ROW]
_PAPER = {
    INK: "#16202a",
    MUTED: "#5b6670",
    LINE: "#d5dade",
    CARD: "#ffffff",
    SERIES[0]: "#2b6cd9",
    SERIES[1]: "#d97a06",
}
_TRIAL = 7_000_000  # seed of the trials on the test road


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--run", default="straight_varied_0", help="run whose policy has the camera of the test road's pictures"
    )
    given = parser.parse_args()
    run = given.scene / "runs" / given.run
    policy = load_policy(run)
    test = RealTest(task_for(policy, "straight", 0), size=policy.size)
    road = [test.reset(name, _TRIAL).capture(test.robot) for name in _SHOWN]
    agreement = rates_against_road(Forecast.load(given.scene / "forecast"))
    parts = [
        _caption("The twin in training: randomized lighting, sun, shadows and haze"),
        *_rows([_first(given.scene, seed, randomise=True) for seed in _SEEDS]),
        _caption(
            f"The test road in {len(_SHOWN)} of its {len(WEATHER)} weathers, which were not filmed; objects have moved"
        ),
        *_rows(road, _SHOWN),
        _caption("The twin with appearance and haze fitted to one photo of each of these days"),
        *_rows([_first(given.scene, 1, lighting=name) for name in _SHOWN], _SHOWN),
        _middle(_in_paper_colors(agreement)),
    ]
    page = np.concatenate([np.full((_GAP, _WIDTH, 3), 255, np.uint8), *parts])
    if not cv2.imwrite(str(given.out), page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 86]):
        parser.error(f"{given.out} cannot be written")


def _first(scene: Path, seed: int, **options: Any) -> Image:
    """The first image of an episode."""
    step = twin.load(scene, "straight", seed, **options).reset()
    return step.observation["pixels"][-1]


def _in_paper_colors(figure: Figure) -> Image:
    """A report figure as an image, with the theme's colors replaced by those for white paper (`_PAPER`)."""
    for artist in figure.findobj():
        if isinstance(artist, Text) and artist.get_bbox_patch():
            artist.set_bbox({"facecolor": _PAPER[CARD], "edgecolor": "none", "alpha": 0.7, "pad": 1.0})
        for part in ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"):
            value = getattr(artist, f"get_{part}", lambda: None)()
            one = np.asarray(value)[0] if np.ndim(value) == 2 and len(value) else value
            if is_color_like(one) and to_hex(one) in _PAPER:
                getattr(artist, f"set_{part}")(_PAPER[to_hex(one)])
    file = BytesIO()
    figure.savefig(file, format="png", dpi=160, facecolor="white")
    return cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_COLOR_RGB)


def _caption(text: str) -> Image:
    out = np.full((_LINE, _WIDTH, 3), 255, np.uint8)
    return _with_text(out, text, (_GAP, _LINE - 11), 0.62, (20, 20, 20))


def _rows(pictures: list[Image], names: Sequence[str] = ()) -> list[Image]:
    """Rows of `_PER_ROW` images of equal size."""
    starts = range(0, len(pictures), _PER_ROW)
    return [_row(pictures[i : i + _PER_ROW], names[i : i + _PER_ROW]) for i in starts]


def _row(pictures: list[Image], names: Sequence[str]) -> Image:
    """Images of equal size side by side, over the full width."""
    width = (_WIDTH - _GAP) // len(pictures) - _GAP
    height = round(width * pictures[0].shape[0] / pictures[0].shape[1])
    out = np.full((height + _GAP, _WIDTH, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        left = _GAP + i * (width + _GAP)
        large = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
        if names:
            _with_text(large, names[i], (8, 24), 0.62, (0, 0, 0), 4)
            _with_text(large, names[i], (8, 24), 0.62, (255, 255, 255))
        out[:height, left : left + width] = large
    return out


def _middle(drawing: Image) -> Image:
    """A drawing, scaled to half the width and centered."""
    width = _WIDTH // 2
    height = round(drawing.shape[0] * width / drawing.shape[1])
    out = np.full((height, _WIDTH, 3), 255, np.uint8)
    out[:, width // 2 : width // 2 + width] = cv2.resize(drawing, (width, height), interpolation=cv2.INTER_AREA)
    return out


def _with_text(out: Image, text: str, at: tuple[int, int], size: float, color: tuple[int, int, int], thick: int = 1):
    return cv2.putText(out, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, thick, cv2.LINE_AA)


if __name__ == "__main__":
    main()
