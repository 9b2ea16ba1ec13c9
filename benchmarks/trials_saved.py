"""Benchmark of the real trials that the twin saves: estimates from n trials of Table 1, with and without the twin.

    python benchmarks/trials_saved.py [--results benchmarks/table1/results.json] [--json FILE] [--picture FILE]

The recorded days are the population, and a policy's rate over all of them is the truth. An *experiment* draws days from
it with replacement. On some of these days the policies drive on the road, five trials each. Twenty further days have
only a photo: there, the policies drive only in the twin. A policy's rate is then estimated in four ways:

- alone: from the real trials, by the model of `twin.evaluation.rate_model`.
- twin: the same model with the policy's rate in the twin as covariate; the estimate shrinks towards the rate that the
  covariate predicts.
- mean: the mean real rate over the driven days; its interval is Student's t over days.
- powered: prediction-powered inference (PPI++, `prediction_powered_mean`): the same mean plus λ times the
  difference between the twin's rates on the further days and on the driven days. This estimate is unbiased even if
  the twin is wrong. λ is tuned on other trainings.

Prints, by number of real trials per policy: width and coverage of the 90 % intervals, root mean square error, and how
often the policy with the highest estimate is within 5 points of the best of its task. *Middling* policies have a
rate of 2 to 98 %; for the others a few trials suffice even without the twin. The seed is fixed. A run takes two
minutes.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from record import record_parser, save

from twin.config import Condition
from twin.evaluation.agreement_intervals import training_of
from twin.evaluation.rate_model import RateModel
from twin.evaluation.statistics import prediction_powered_mean
from twin.files import read_json

DAYS = (2, 3, 4, 6, 8, 12, 16)
"""Numbers of driven days."""
TRIALS = 5  # per policy and day
PHOTOS = 20
"""Days with a photo and no trials."""
MARGIN = 0.05  # difference in rate up to which a policy counts as the best
WAYS = ("alone", "twin", "mean", "powered")
_LEAST_DAYS = 5  # fewest driven days for an interval of `mean` or `powered`
_EXPERIMENTS = 60


@dataclass(frozen=True)
class Record:
    """Trials of n policies on k recorded days, shapes (n, k)."""

    real: np.ndarray
    """Rate on the road."""
    twin: np.ndarray
    """Successes in the twin, out of `episodes`."""
    episodes: int
    training: np.ndarray
    task: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        return self.real.mean(1)

    @property
    def middling(self) -> np.ndarray:
        return (self.truth > 0.02) & (self.truth < 0.98)


def read_record(path: Path) -> Record:
    real, twin, names, tasks, episodes = [], [], [], [], 0
    for run in read_json(path)["runs"]:
        for policy in run["policies"]:
            road, photo = policy["real"]["by_lighting"], policy["validate_by_photo"]["by_lighting"]
            cells = [photo[str(Condition(day, True))] for day in road]
            real.append([cell["successes"] / cell["trials"] for cell in road.values()])
            twin.append([cell["successes"] for cell in cells])
            episodes = cells[0]["trials"]
            names.append(training_of(policy["policy"]))
            tasks.append(run["task"])
    _, training = np.unique(names, return_inverse=True)
    return Record(np.array(real), np.array(twin), episodes, training, np.array(tasks))


Estimates = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Way of estimation → estimates of the policies, lower and upper ends of their intervals or nan; shapes (n,)."""


def estimates(record: Record, driven: np.ndarray, photos: np.ndarray, rng: np.random.Generator) -> Estimates:
    """Estimates of one experiment; `driven` and `photos` are indices of recorded days."""
    won = rng.binomial(TRIALS, record.real[:, driven])
    counts = won, np.full(won.shape, TRIALS)
    twin = record.twin[:, np.concatenate([driven, photos])]
    share = (twin.sum(1) + 0.5) / (twin.shape[1] * record.episodes + 1.0)
    out: Estimates = {}
    for way, covariate in (("alone", None), ("twin", np.log(share / (1.0 - share)))):
        model = RateModel.fit(*counts, covariate)
        out[way] = (model.mean(), *model.interval())
    y, f = won / TRIALS, record.twin[:, driven] / record.episodes
    further = record.twin[:, photos] / record.episodes
    for way, power in (("mean", np.zeros(len(y))), ("powered", powers(record.training, f, y))):
        value = y.mean(1) + power * (further.mean(1) - f.mean(1))
        ends = np.full((2, len(y)), np.nan)
        if len(driven) >= _LEAST_DAYS:
            for i, weight in enumerate(power):
                one = prediction_powered_mean(twin=f[i], real=y[i], twin_only=further[i], power=weight)
                value[i], ends[:, i] = one.value, np.clip((one.low, one.high), 0.0, 1.0)
        out[way] = (value, *ends)
    return out


def powers(training: np.ndarray, f: np.ndarray, y: np.ndarray) -> np.ndarray:
    """λ of each policy, tuned on the day-to-day agreement of the policies of other trainings (example 6.1 of PPI++)."""
    f0, y0 = f - f.mean(1, keepdims=True), y - y.mean(1, keepdims=True)
    covariance, variance = (f0 * y0).sum(1), (f0 * f0).sum(1)
    out = np.zeros(len(f))
    for i in range(len(f)):
        others = training != training[i]
        if variance[others].sum() > 0:
            out[i] = covariance[others].sum() / variance[others].sum() / (1.0 + f.shape[1] / PHOTOS)
    return out


def best_chosen(record: Record, estimate: np.ndarray, among: np.ndarray, rng: np.random.Generator) -> float:
    """Fraction of tasks whose policy with the highest estimate is within `MARGIN` of the best; ties break at random."""
    hits = []
    for task in np.unique(record.task):
        mine = np.flatnonzero(among & (record.task == task))
        chosen = mine[np.argmax(estimate[mine] + 1e-9 * rng.random(len(mine)))]
        hits.append(record.truth[chosen] >= record.truth[mine].max() - MARGIN)
    return float(np.mean(hits))


def row(record: Record, days: int, experiments: int, seed: int = 0) -> dict[str, dict[str, dict[str, float]]]:
    """Group of policies → way → figures, for a number of driven days."""
    rng = np.random.default_rng([seed, days])
    groups = {"all": np.ones(len(record.truth), bool), "middling": record.middling}
    sums: dict[str, dict[str, list[list[float]]]] = {g: {way: [] for way in WAYS} for g in groups}
    for _ in range(experiments):
        drawn = rng.integers(record.real.shape[1], size=days + PHOTOS)
        for way, (value, low, high) in estimates(record, drawn[:days], drawn[days:], rng).items():
            for group, of in groups.items():
                truth = record.truth[of]
                inside = np.where(np.isfinite(low[of]), (low[of] <= truth) & (truth <= high[of]), np.nan)
                error = float(np.mean((value[of] - truth) ** 2))
                best = best_chosen(record, value, of, rng)
                sums[group][way].append([float(np.mean(high[of] - low[of])), float(np.mean(inside)), error, best])
    out: dict[str, dict[str, dict[str, float]]] = {}
    for group, ways in sums.items():
        out[group] = {}
        for way, values in ways.items():
            width, held, error, best = np.mean(values, 0)
            figures = {"width": width, "coverage": held, "rmse": np.sqrt(error), "best": best}
            out[group][way] = {name: float(value) for name, value in figures.items()}
    return out


def picture(rows: dict[int, Any]) -> Figure:
    """Plots against the number of real trials: error of middling policies' rates, and choices of each task's best."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    labels = {
        "alone": "real trials alone",
        "twin": "with the twin",
        "powered": "prediction-powered mean",
        "mean": "mean",
    }
    for way, marker in (("alone", "o"), ("twin", "s"), ("mean", "D"), ("powered", "^")):
        for axes, name in ((left, "rmse"), (right, "best")):
            among = "all" if name == "best" else "middling"
            values = [100 * rows[days][among][way][name] for days in rows]
            axes.plot([TRIALS * days for days in rows], values, marker=marker, ms=4, lw=1.4, label=labels[way])
    left.set(xlabel="real trials per policy", ylabel="error of a rate, rms [points]", ylim=(0, None))
    right.set(xlabel="real trials per policy", ylabel="best policy chosen [%]", ylim=(0, 104))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(lw=0.4)
    right.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "table1" / "results.json")
    parser.add_argument("--experiments", type=int, default=_EXPERIMENTS)
    parser.add_argument("--picture", type=Path, metavar="FILE")
    given = parser.parse_args()
    record = read_record(given.results)
    print(
        "| real trials per policy | policies | "
        + " | ".join(f"{way}: width; coverage; rms error; best" for way in WAYS)
    )
    print(f"|---|---|{'---|' * len(WAYS)}")
    rows: dict[int, Any] = {}
    for days in DAYS:
        rows[days] = row(record, days, given.experiments)
        for group, ways in rows[days].items():
            cells = ["; ".join(f"{x:.2f}" if x == x else "–" for x in one.values()) for one in ways.values()]
            print(f"| {TRIALS * days} on {days} days | {group} | {' | '.join(cells)} |", flush=True)
    if given.picture:
        picture(rows).savefig(given.picture, dpi=130)
    found = {"experiments": given.experiments, "days": {str(days): value for days, value in rows.items()}}
    return save(given.json, found, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
