"""Which policy is best, how sure that is, and how many more trials would make it sure.

The true rate of a cell is drawn from Jeffreys' posterior, Beta(successes + ½, trials − successes + ½), and a policy's
score is the mean of its cells'. The *probability of a rank* is the share of draws in which a policy has it. All this is
about the world in which the trials were driven: how the twin ranks is no evidence yet of how the road does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.evaluation.statistics import CONFIDENCE
from twin.types import Array

SURE = 0.95
"""Probability from which on a ranking is settled."""
MARGIN = 0.05
"""Policies whose true scores differ by less are equally good."""
MOST_TRIALS = 1000
"""Per policy; beyond, more trials are no answer."""

_DRAWS = 4000
_STEP = 5  # trials


@dataclass(frozen=True)
class Tallies:
    """The cells of n policies on one task, up to k each; rows are filled with cells of weight 0."""

    successes: NDArray[np.int64]
    """Shape (n, k)."""
    trials: NDArray[np.int64]
    """Shape (n, k)."""
    weight: Array
    """1 where there is a cell, else 0; shape (n, k)."""

    @staticmethod
    def of(rows: list[list[tuple[int, int]]]) -> "Tallies":
        """From (successes, trials) of each policy's cells."""
        shape = len(rows), max(map(len, rows))
        successes, trials, weight = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape)
        for i, row in enumerate(rows):
            for j, (won, driven) in enumerate(row):
                successes[i, j], trials[i, j], weight[i, j] = won, driven, 1.0
        return Tallies(successes, trials, weight)

    def mean(self, rates: Array) -> Array:
        """Scores (..., n) of cells' rates (..., n, k)."""
        return (rates * self.weight).sum(-1) / self.weight.sum(-1)

    def posterior(self, rng: np.random.Generator, draws: int) -> Array:
        """True rates, shape (draws, n, k)."""
        shape = (draws, *self.successes.shape)
        return rng.beta(self.successes + 0.5, self.trials - self.successes + 0.5, shape)


def rank_probabilities(tallies: Tallies, rng: np.random.Generator, draws: int = _DRAWS) -> Array:
    """Probability that policy i has rank k + 1, shape (n, n); rows and columns sum to 1."""
    scores = tallies.mean(tallies.posterior(rng, draws))
    ranks = np.argsort(np.argsort(-scores, axis=-1), axis=-1)
    n = scores.shape[-1]
    return np.stack([(ranks == k).mean(0) for k in range(n)], -1)


def rank_interval(probabilities: Array, confidence: float = CONFIDENCE) -> tuple[float, int, int]:
    """Expected rank of a policy, 1 is best, and the ranks between which it lies with `confidence`; probabilities (n,).

    From either end, ranks are left out as long as they come to no more than half of what may be missed.
    """
    ranks = np.arange(1, len(probabilities) + 1)
    spare = (1.0 - confidence) / 2 + 1e-12
    below = np.cumsum(probabilities)
    above = np.cumsum(probabilities[::-1])[::-1]
    return float(probabilities @ ranks), int(ranks[below > spare][0]), int(ranks[above > spare][-1])


@dataclass(frozen=True)
class Settled:
    """What a number of further trials per policy would do, on average over what the rates may be."""

    winner: float
    """Probability that the policy then leading is within `MARGIN` of the truly best."""
    order: float
    """Expected share of the pairs whose true scores differ by more than `MARGIN` that are then in the right order."""


def expected_after(tallies: Tallies, more: int, seed: int, so_far: bool = True, draws: int = _DRAWS) -> Settled:
    """How sure the ranking is after `more` trials per policy, spread evenly over its cells.

    True rates are drawn from the posterior, the trials from the rates, and the policies ranked by what would then be
    known (the posterior mean).

    Args:
        tallies: Trials so far.
        more: Further trials per policy.
        seed: The same one compares numbers of trials on the same draws.
        so_far: Whether the trials so far count as seen; if not, they only tell which rates to expect.
        draws: Of the true rates.
    """
    rng = np.random.default_rng(seed)
    true = tallies.posterior(rng, draws)
    per_cell = np.broadcast_to(more / tallies.weight.sum(-1, keepdims=True), tallies.weight.shape)
    extra = np.ceil(per_cell * tallies.weight).astype(np.int64)
    won = rng.binomial(extra, true)
    base_won, base = (tallies.successes, tallies.trials) if so_far else (0, 0)
    known = tallies.mean((base_won + won + 0.5) / (base + extra + 1.0))
    score = tallies.mean(true)
    # Of policies that are tied in what is known, any may be chosen.
    leading = np.isclose(known, known.max(-1, keepdims=True), rtol=0.0, atol=1e-12)
    good = score >= score.max(-1, keepdims=True) - MARGIN
    winner = ((leading & good).sum(-1) / leading.sum(-1)).mean()
    gap, shown = score[:, :, None] - score[:, None, :], known[:, :, None] - known[:, None, :]
    apart = gap > MARGIN
    right = np.where(np.isclose(shown, 0.0, rtol=0.0, atol=1e-12), 0.5, shown > 0)
    order = (right * apart).sum() / apart.sum() if apart.any() else 1.0
    return Settled(float(winner), float(order))


def trials_to_settle(tallies: Tallies, what: str, seed: int, so_far: bool = True) -> int | None:
    """Further trials per policy, a multiple of 5, after which `Settled.winner` or `.order` is expected at `SURE`.

    Args:
        tallies: Trials so far.
        what: "winner" or "order".
        seed: Of the draws.
        so_far: See `expected_after`.

    Returns:
        None where `MOST_TRIALS` would not do.
    """

    def enough(more: int) -> bool:
        return bool(getattr(expected_after(tallies, more, seed, so_far), what) >= SURE)

    low, high = 0, _STEP
    if enough(0):
        return 0
    while not enough(high):
        low, high = high, 2 * high
        if low >= MOST_TRIALS:
            return None
    while high - low > _STEP:  # in between: expected to grow with the trials
        middle = (low + high) // (2 * _STEP) * _STEP
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high if high <= MOST_TRIALS else None
