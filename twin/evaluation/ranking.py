"""Bayesian ranking of policies: probabilities of ranks, and how many further trials would settle the ranking.

Samples of the policies' true rates come from the posterior of `twin.evaluation.rate_model`, which shrinks a rate
towards those of the other policies and treats trials of one day as correlated. The probability of a policy's rank is
the fraction of samples in which the policy has that rank. Results hold for the world, twin or road, in which the trials
were driven: a ranking in the twin is no evidence for the same ranking on the road.
"""

from dataclasses import dataclass

import numpy as np

from twin.evaluation.statistics import CONFIDENCE
from twin.types import Array

SETTLED_PROBABILITY = 0.95  # a ranking is settled when the expected confidence in it is at least this
MARGIN = 0.05  # policies whose true rates differ by less count as equally good
MAX_TRIALS = 1000  # largest number of further trials per policy that is considered

SAMPLES = 4000  # samples of the posterior
_STEP = 5  # [trials] resolution of `trials_needed`


def rank_probabilities(rates: Array) -> Array:
    """Probability that policy i has rank k + 1, shape (n, n), from samples of rates (samples, n); rows sum to 1."""
    ranks = np.argsort(np.argsort(-rates, axis=-1), axis=-1)
    return np.stack([(ranks == k).mean(0) for k in range(rates.shape[-1])], -1)


def rank_interval(probabilities: Array) -> tuple[float, int, int]:
    """Expected rank of a policy (1 is best) from rank probabilities (n,), and the ends of its credible interval.

    The ranks excluded at either end have a total probability of at most (1 − `CONFIDENCE`) / 2.
    """
    ranks = np.arange(1, len(probabilities) + 1)
    tail = (1.0 - CONFIDENCE) / 2 + 1e-12
    below = np.cumsum(probabilities)
    above = np.cumsum(probabilities[::-1])[::-1]
    return float(probabilities @ ranks), int(ranks[below > tail][0]), int(ranks[above > tail][-1])


@dataclass(frozen=True)
class RankingConfidence:
    """Expected confidence in a ranking after further trials, averaged over the posterior of the rates."""

    winner: float
    """Probability that the true rate of the policy ranked first is within `MARGIN` of the best true rate."""
    order: float
    """Expected fraction of pairs in the right order, among pairs whose true rates differ by more than `MARGIN`."""


def expected_confidence(rates: Array, more: int, seed: int, so_far: bool = True) -> RankingConfidence:
    """Expected confidence in the ranking after `more` trials per policy, each on a day of its own.

    The further trials are simulated at the sampled rates; then policies are ranked by their updated posterior means.
    Each policy's present posterior is approximated by a Beta distribution with the samples' mean and variance.

    Args:
        rates: Samples of the true rates, shape (samples, n).
        more: Further trials per policy.
        so_far: True: the ranking also uses the trials on which the posterior is based; False: only the further ones.
    """
    won = np.random.default_rng(seed).binomial(more, rates)
    if so_far:
        mean = rates.mean(0)
        strength = np.maximum(mean * (1.0 - mean) / np.maximum(rates.var(0), 1e-9) - 1.0, 1e-6)
        known = (strength * mean + won) / (strength + more)
    else:
        known = won.astype(float)
    # Policies tied in the posterior mean are equally likely to be ranked first.
    leading = np.isclose(known, known.max(-1, keepdims=True), rtol=0.0, atol=1e-12)
    good = rates >= rates.max(-1, keepdims=True) - MARGIN
    winner = ((leading & good).sum(-1) / leading.sum(-1)).mean()
    right, pairs = 0.0, 0
    for i in range(rates.shape[-1]):  # all pairs at once would take gigabytes for a hundred policies
        apart = rates[:, i : i + 1] - rates > MARGIN
        known_gap = (known[:, i : i + 1] - known)[apart]
        tied = np.abs(known_gap) <= 1e-12
        right += 0.5 * np.count_nonzero(tied) + np.count_nonzero(known_gap[~tied] > 0)
        pairs += len(known_gap)
    return RankingConfidence(float(winner), float(right / pairs) if pairs else 1.0)


def trials_needed(rates: Array, what: str, seed: int, so_far: bool = True) -> int | None:
    """Further trials per policy, a multiple of 5, until an expected confidence reaches `SETTLED_PROBABILITY`.

    `what` names a field of `RankingConfidence`. Returns None if `MAX_TRIALS` do not suffice.
    """

    def enough(more: int) -> bool:
        return bool(getattr(expected_confidence(rates, more, seed, so_far), what) >= SETTLED_PROBABILITY)

    low, high = 0, _STEP
    if enough(0):
        return 0
    while not enough(high):
        low, high = high, 2 * high
        if low >= MAX_TRIALS:
            return None
    while high - low > _STEP:  # bisection: the confidence grows with the number of trials
        middle = (low + high) // (2 * _STEP) * _STEP
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high if high <= MAX_TRIALS else None
