"""Bayesian ranking of policies: probabilities of ranks, and how many further trials would settle the ranking.

The true rate of a cell is sampled from Jeffreys' posterior, Beta(successes + ½, trials − successes + ½); a policy's
score is the mean over its cells. A rank's probability is the fraction of samples in which a policy has it. All this
holds for the world in which the trials were driven: a ranking in the twin is no evidence of one on the road.
"""

from dataclasses import dataclass

import numpy as np

from twin.evaluation.statistics import CONFIDENCE
from twin.types import Array, Indices

SETTLED_PROBABILITY = 0.95  # from which on a ranking counts as settled
MARGIN = 0.05  # policies whose true scores differ by less count as equally good
MAX_TRIALS = 1000  # most further trials per policy that are considered

_SAMPLES = 4000  # of the posterior
_STEP = 5  # trials


@dataclass(frozen=True)
class TrialCounts:
    """Trials of n policies on one task in up to k cells each, shape (n, k); short rows are padded."""

    successes: Indices
    trials: Indices
    weight: Array
    """1 for a cell, 0 for padding."""

    @staticmethod
    def from_rows(rows: list[list[tuple[int, int]]]) -> "TrialCounts":
        """Counts from (successes, trials) of each policy's cells."""
        shape = len(rows), max(map(len, rows))
        successes, trials, weight = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape)
        for i, row in enumerate(rows):
            for j, (won, driven) in enumerate(row):
                successes[i, j], trials[i, j], weight[i, j] = won, driven, 1.0
        return TrialCounts(successes, trials, weight)

    def scores(self, rates: Array) -> Array:
        """Scores (..., n) from rates of cells (..., n, k)."""
        return (rates * self.weight).sum(-1) / self.weight.sum(-1)

    def sample_posterior(self, rng: np.random.Generator, samples: int) -> Array:
        """Samples of the true rates, shape (samples, n, k)."""
        shape = (samples, *self.successes.shape)
        return rng.beta(self.successes + 0.5, self.trials - self.successes + 0.5, shape)


def rank_probabilities(counts: TrialCounts, rng: np.random.Generator, samples: int = _SAMPLES) -> Array:
    """Probability that policy i has rank k + 1, shape (n, n); rows and columns sum to 1."""
    scores = counts.scores(counts.sample_posterior(rng, samples))
    ranks = np.argsort(np.argsort(-scores, axis=-1), axis=-1)
    n = scores.shape[-1]
    return np.stack([(ranks == k).mean(0) for k in range(n)], -1)


def rank_interval(probabilities: Array, confidence: float = CONFIDENCE) -> tuple[float, int, int]:
    """Expected rank of a policy (1 is best) from rank probabilities (n,), and the ends of its credible interval.

    The ranks excluded at either end have a total probability of at most (1 − confidence) / 2.
    """
    ranks = np.arange(1, len(probabilities) + 1)
    tail = (1.0 - confidence) / 2 + 1e-12
    below = np.cumsum(probabilities)
    above = np.cumsum(probabilities[::-1])[::-1]
    return float(probabilities @ ranks), int(ranks[below > tail][0]), int(ranks[above > tail][-1])


@dataclass(frozen=True)
class RankingConfidence:
    """Expected confidence in a ranking after further trials, averaged over the posterior of the rates."""

    winner: float
    """Probability that the leading policy is within `MARGIN` of the truly best."""
    order: float
    """Expected fraction of pairs in the right order, among those with true scores more than `MARGIN` apart."""


def expected_confidence(
    counts: TrialCounts, more: int, seed: int, so_far: bool = True, samples: int = _SAMPLES
) -> RankingConfidence:
    """Expected confidence in the ranking after `more` trials per policy, spread evenly over its cells.

    True rates are sampled from the posterior, and trials at these rates; policies are ranked by the posterior mean.

    Args:
        counts: Trials so far.
        more: Further trials per policy.
        seed: With the same seed, different `more` are compared on the same samples.
        so_far: False: the trials so far determine the true rates, but do not count for the ranking.
        samples: Number of samples of the true rates.
    """
    rng = np.random.default_rng(seed)
    true = counts.sample_posterior(rng, samples)
    per_cell = np.broadcast_to(more / counts.weight.sum(-1, keepdims=True), counts.weight.shape)
    extra = np.ceil(per_cell * counts.weight).astype(np.int64)
    won = rng.binomial(extra, true)
    base_won, base = (counts.successes, counts.trials) if so_far else (0, 0)
    known = counts.scores((base_won + won + 0.5) / (base + extra + 1.0))
    score = counts.scores(true)
    # Policies tied in the posterior mean are equally likely to be chosen.
    leading = np.isclose(known, known.max(-1, keepdims=True), rtol=0.0, atol=1e-12)
    good = score >= score.max(-1, keepdims=True) - MARGIN
    winner = ((leading & good).sum(-1) / leading.sum(-1)).mean()
    gap, known_gap = score[:, :, None] - score[:, None, :], known[:, :, None] - known[:, None, :]
    apart = gap > MARGIN
    right = np.where(np.isclose(known_gap, 0.0, rtol=0.0, atol=1e-12), 0.5, known_gap > 0)
    order = (right * apart).sum() / apart.sum() if apart.any() else 1.0
    return RankingConfidence(float(winner), float(order))


def trials_needed(counts: TrialCounts, what: str, seed: int, so_far: bool = True) -> int | None:
    """Further trials per policy, a multiple of 5, until an expected confidence reaches `SETTLED_PROBABILITY`.

    `what` names a field of `RankingConfidence`. Returns None if `MAX_TRIALS` do not suffice.
    """

    def enough(more: int) -> bool:
        return bool(getattr(expected_confidence(counts, more, seed, so_far), what) >= SETTLED_PROBABILITY)

    low, high = 0, _STEP
    if enough(0):
        return 0
    while not enough(high):
        low, high = high, 2 * high
        if low >= MAX_TRIALS:
            return None
    while high - low > _STEP:  # bisection, as the confidence grows with the trials
        middle = (low + high) // (2 * _STEP) * _STEP
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high if high <= MAX_TRIALS else None
