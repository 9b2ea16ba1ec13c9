"""`Forecast`: what rates in the twin say about the real runs. Numbers only; pages and tables are drawn from it.

A *candidate* is a policy on a task. Its twin score is the mean of its rates under the *compared lightings*: those of
the twin that real cells of the task are compared with, or all of them where there are no real trials yet. It is
*driven* if it has real trials. A *group* is the driven candidates of one task, or of all of them. Every number stands
in an `Estimate` with its count and its interval, or with what is missing for it.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from twin.config_file import parse
from twin.errors import InputError
from twin.files import damaged, exists, read_json, write_json
from twin.report import ranking
from twin.report.bootstrap import DRAWS
from twin.report.statistics import CONFIDENCE

ALL_TASKS = "all tasks"
_FILE = "forecast.json"


@dataclass(frozen=True)
class Estimate:
    """A number with its interval, or why there is none."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    """Trials behind a rate, policies or cells behind a statistic."""
    missing: str = ""
    """What it would take; empty where there is a value."""


UNKNOWN_TRAINING = Estimate(missing="its training on this task is not known")


@dataclass(frozen=True)
class Pair:
    """A real cell beside the twin's."""

    policy: str
    task: str
    lighting: str
    twin_lighting: str
    twin: Estimate
    real: Estimate
    bias: Estimate
    """Real minus twin rate."""

    @property
    def within_chance(self) -> bool:
        """Whether its bias may be none."""
        return (self.bias.low or 0.0) <= 0.0 <= (self.bias.high or 0.0)


@dataclass(frozen=True)
class Candidate:
    policy: str
    task: str
    lightings: tuple[str, ...]
    """Of the twin, that its score is the mean over."""
    twin: Estimate
    twin_rank: Estimate
    """Among the task's candidates, 1 is best: expected, and interval."""
    twin_ranks: tuple[float, ...]
    """Probability of each rank in the twin."""
    real: Estimate
    """Mean over its real cells."""
    real_ranks: tuple[float, ...]
    """Probability of each rank on the road among the driven; empty where it was not driven or is the only one."""
    corrected: Estimate
    """Real rate expected, from its twin score and the other driven candidates; its own real trials are not used."""
    trained: Estimate = UNKNOWN_TRAINING
    """Rate in its training, on this task, before it was saved."""

    @property
    def driven(self) -> bool:
        return self.real.value is not None


@dataclass(frozen=True)
class Group:
    """How well the twin foretold the road for the driven candidates of a task, or of all tasks."""

    task: str
    policies: int
    cells: int
    missing: tuple[str, ...]
    """What it would take; nothing below is given before."""
    pearson: Estimate
    spearman: Estimate
    mmrv: Estimate
    winner_agreement: Estimate
    winner_regret: Estimate
    bias: Estimate
    """Mean over cells of real minus twin."""
    coverage: Estimate
    """Share of the cells whose difference between twin and road is no more than chance (interval of `Pair.bias`)."""
    corrected_coverage: Estimate
    """Share of the candidates whose real rate lies in the interval predicted without them."""
    mean_real: Estimate
    """Mean real rate of policies such as these, driven or not (prediction-powered)."""


@dataclass(frozen=True)
class LeftOut:
    """One real lighting, foretold from all others of the task."""

    task: str
    lighting: str
    cells: int
    twin_error: Estimate
    """Mean distance of the twin's rates from the real ones."""
    corrected_error: Estimate
    """The same after the correction learnt under the other lightings."""
    coverage: Estimate
    """Share of the cells within the interval predicted."""


@dataclass(frozen=True)
class Plan:
    """What more real trials would bring. `ranking` states the rule."""

    task: str
    policies: int
    basis: str
    """road: trials are added to those driven; twin: none so far, and the road is taken to be like the twin."""
    winner_now: float | None = None
    """Probability that the leading policy is the best, or within `ranking.MARGIN` of it."""
    order_now: float | None = None
    """Share of the pairs that matter expected in the right order."""
    more_for_winner: int | None = None
    """Real trials per policy until `winner_now` is expected to be `sure`; None: more than `ranking.MOST_TRIALS`."""
    more_for_order: int | None = None


@dataclass(frozen=True)
class Forecast:
    scene: str
    twin_trials: int
    real_trials: int
    tasks: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    """Task by task, best in the twin first."""
    pairs: tuple[Pair, ...]
    groups: tuple[Group, ...]
    left_out: tuple[LeftOut, ...]
    plans: tuple[Plan, ...]
    confidence: float = CONFIDENCE
    draws: int = DRAWS
    seed: int = 0
    sure: float = ranking.SURE
    margin: float = ranking.MARGIN

    def of(self, task: str) -> list[Candidate]:
        return [c for c in self.candidates if c.task == task]

    def save(self, folder: Path) -> None:
        """Writes `forecast.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / _FILE, asdict(self))

    @staticmethod
    def load(folder: Path) -> "Forecast":
        """Raises InputError: no such file, or not one that `save` wrote."""
        path = folder / _FILE
        if not exists(path):
            raise InputError(f"{path} does not exist; run python -m twin.forecast SCENE")
        with damaged(path, "run python -m twin.forecast SCENE anew"):
            try:
                return parse(Forecast, _given(read_json(path)), str(path))
            except InputError as error:
                raise InputError(f"{error}; run python -m twin.forecast SCENE anew") from None


def _given(value: Any) -> Any:
    """A JSON value without its nulls, which a dataclass has as defaults."""
    if isinstance(value, dict):
        return {key: _given(item) for key, item in value.items() if item is not None}
    return [_given(item) for item in value] if isinstance(value, list) else value
