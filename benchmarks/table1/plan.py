"""Design of the table 1 experiment: setups, tasks, runs, and the policies that drive on the road.

A *setup* is a set of training options. A *run* trains a setup on a task with a seed. Each run contributes its finished
policy and its checkpoints at a quarter and at half of the steps, so that the policies vary in quality. This selection
was fixed before any result was known.
"""

from dataclasses import dataclass
from pathlib import Path

from twin.config import HELD_OUT, Condition
from twin.evaluation.statistics import MIN_TRIALS
from twin.evaluation.training_curves import CHOICE_FILE
from twin.files import read_json
from twin.reality.lighting import WEATHER

TASKS = {"straight": "straight", "right": "right_turn"}
"""Name in run names → name in `twin.load`."""
SETUPS: dict[str, tuple[str, ...]] = {
    "simulator": ("--observe", "simulator"),
    "one_light": ("--lighting", "sun"),
    "varied": (),
}
"""Name → options of `twin.train`."""
STEPS = {"straight": 12_000, "right": 16_000}
"""Largest number of steps. Published runs took all of them; newer runs may end earlier (`learn.selection`)."""
SHARES = (0.25, 0.5)
"""Fractions of a run's steps at which checkpoints are taken for the forecast."""
EPISODES = 50
"""Episodes in the twin per policy and held-out lighting."""
LIGHTINGS = {"final": (HELD_OUT, str(Condition(HELD_OUT, True))), "checkpoint": (str(Condition(HELD_OUT, True)),)}
"""Lightings in the twin for finished policies and for checkpoints.

Forecasts use the randomized condition, `+randomised`; the paper's table, of finished policies only, uses both.
"""
PHOTOS = tuple(str(Condition(name, True)) for name in WEATHER)
"""Lightings of the twin, each fitted to a photo of a test day, for forecasts per weather."""
PHOTO_EPISODES = 5
"""Episodes in the twin per policy and weather."""
TRIALS = MIN_TRIALS
"""Trials in the simulated reality per policy and weather, the minimum of a forecast."""
PAPER: dict[tuple[str, str], tuple[float, float, float]] = {
    ("simulator", "straight"): (0.94, 0.57, 0.00),
    ("one_light", "straight"): (1.00, 0.19, 0.00),
    ("varied", "straight"): (0.99, 0.98, 0.80),
    ("simulator", "right"): (0.73, 0.54, 0.00),
    ("one_light", "right"): (1.00, 0.95, 0.67),
    ("varied", "right"): (1.00, 1.00, 0.83),
}
"""Success rates in training, in validation and on the road: arXiv 2403.15791, table 1."""


@dataclass(frozen=True)
class Run:
    task: str
    setup: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.task}_{self.setup}_{self.seed}"

    def folder(self, scene: Path) -> Path:
        return scene / "runs" / self.name

    def checkpoints(self, scene: Path) -> list[Path]:
        """Checkpoints for the forecast: for each of `SHARES`, the last one up to 100 steps after that share."""
        saved = sorted((self.folder(scene) / "checkpoints").glob("*"), key=lambda path: int(path.name))
        before = [[path for path in saved if int(path.name) <= share * STEPS[self.task] + 100] for share in SHARES]
        return [some[-1] for some in before if some]

    def finished(self, scene: Path) -> bool:
        path, steps = self.folder(scene), STEPS[self.task]
        if not (path / "config.json").exists():
            return False
        planned = read_json(path / "config.json")["steps"]
        if planned != steps:  # learning rates depend on the total, so a longer run is another training
            raise SystemExit(f"{path} is a run of {planned} steps, not of {steps}; move it away")
        return (path / CHOICE_FILE).exists()  # a run may end before the largest number of steps


def runs(seeds: list[int], tasks: list[str], setups: list[str]) -> list[Run]:
    """Runs of all combinations, seed by seed."""
    return [Run(task, setup, seed) for seed in seeds for setup in setups for task in tasks]
