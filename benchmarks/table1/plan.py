"""What the experiment is: setups, tasks, runs, and which policies go to the road.

A *setup* is a way to train. A *run* is a training: a setup on a task with a seed. Of every run, besides the finished
policy, the checkpoints at a quarter and at half of the steps are taken: policies of varied quality for the forecast,
chosen here and thus before anything is known of how they drive.
"""

from dataclasses import dataclass
from pathlib import Path

from twin.config import HELD_OUT, Condition
from twin.evaluation.statistics import MIN_TRIALS
from twin.evaluation.training_curves import CHOICE_FILE
from twin.files import read_json
from twin.reality.lighting import WEATHER

TASKS = {"straight": "straight", "right": "right_turn"}
"""In names of runs → in `twin.load`."""
SETUPS: dict[str, tuple[str, ...]] = {
    "simulator": ("--observe", "simulator"),
    "one_light": ("--lighting", "sun"),
    "varied": (),
}
"""Name → options of `twin.train`."""
STEPS = {"straight": 12_000, "right": 16_000}
SHARES = (0.25, 0.5)
"""Of a run's steps, at which checkpoints are taken for the forecast."""
EPISODES = 50
"""In the twin, per policy and lighting."""
LIGHTINGS = {"final": (HELD_OUT, str(Condition(HELD_OUT, True))), "checkpoint": (str(Condition(HELD_OUT, True)),)}
"""Of the twin. The latter is what reality is compared with; the former, for finished policies, is the paper's."""
PHOTOS = tuple(str(Condition(name, True)) for name in WEATHER)
"""Of the twin, by a photo of each day of the test: what reality is compared with, weather by weather."""
PHOTO_EPISODES = 5
"""In the twin, per policy and weather."""
TRIALS = MIN_TRIALS
"""In reality, per policy and weather. From fewer nothing is forecast."""
PAPER: dict[tuple[str, str], tuple[float, float, float]] = {
    ("simulator", "straight"): (0.94, 0.57, 0.00),
    ("one_light", "straight"): (1.00, 0.19, 0.00),
    ("varied", "straight"): (0.99, 0.98, 0.80),
    ("simulator", "right"): (0.73, 0.54, 0.00),
    ("one_light", "right"): (1.00, 0.95, 0.67),
    ("varied", "right"): (1.00, 1.00, 0.83),
}
"""Training, validation and real success, arXiv 2403.15791, table 1."""


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
        """Those for the forecast: at each of `SHARES`, the last before it."""
        there = sorted((self.folder(scene) / "checkpoints").glob("*"), key=lambda path: int(path.name))
        picked = [[path for path in there if int(path.name) <= share * STEPS[self.task] + 100] for share in SHARES]
        return [some[-1] for some in picked if some]

    def finished(self, scene: Path) -> bool:
        path, steps = self.folder(scene), STEPS[self.task]
        if not (path / "config.json").exists():
            return False
        asked = read_json(path / "config.json")["steps"]
        if asked != steps:  # the learning rate falls by the steps asked for: a longer run is another training
            raise SystemExit(f"{path} is a run of {asked} steps, not of {steps}; move it away")
        return (path / CHOICE_FILE).exists() and read_json(path / CHOICE_FILE)["steps"] >= steps


def runs(seeds: list[int], tasks: list[str], setups: list[str]) -> list[Run]:
    """Every cell once before any has a second seed."""
    return [Run(task, setup, seed) for seed in seeds for setup in setups for task in tasks]
