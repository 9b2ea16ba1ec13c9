"""Success rates of policies, of their population, and the policies' ranking, by a hierarchical beta-binomial model.

Most trials of a policy on one day have the same outcome, so the independent units are days, not trials. With m trials
on day j, policy i succeeds yᵢⱼ times:

    rᵢⱼ | pᵢ ~ Beta with mean pᵢ and intra-class correlation ρ        the rate on day j
    yᵢⱼ | rᵢⱼ ~ Binomial(m, rᵢⱼ)
    pᵢ ~ Beta with mean μᵢ and intra-class correlation τ              the policy's rate over days
    logit μᵢ = logit μ + β xᵢ                                        xᵢ: a covariate; the forecast has none

A Beta distribution with mean p and intra-class correlation ρ is Beta(p/ρ − p, (1 − p)/ρ − (1 − p)). With ρ = 1, all
trials of a day have the same outcome; with ρ = 0, they are independent. The priors are Beta(5, 1) of ρ, since on most
days all trials of a policy have the same outcome (706 of 720 cells in docs/benchmarks.md), Beta(1, 2) of τ, and
Beta(3/2, 3/2) of μ. With uniform priors and Jeffreys' prior of μ, all successes on a few days suggested that a policy
always succeeds: 90 % intervals from two to four days had coverages of 0.74 to 0.83 where weather changes a lot (script
not kept). All policies share ρ. All parameters are integrated over a grid, so intervals need neither sampling nor a
seed. A policy's rate is shrunk towards the rates of the other policies, more strongly if these are alike; it is not
shrunk towards one half. The beta-binomial distribution is Skellam's (J. R. Stat. Soc. B 10, 1948); for hierarchical
models see Gelman et al., Bayesian Data Analysis, section 5.3.

Policies of one experiment drive on the same days, and a bad day is bad for all of them. So their cells are not
independent, and the product of their likelihoods is a *composite* likelihood. It is raised to the power
(2k − 1) / (2k + 1) for k days (for such scaling see Ribatet, Cooley and Davison, Statistica Sinica 22, 2012). Besides,
n − 1 other policies tell less about a policy's rate than as many independent ones: their likelihood is raised to the
power 1 / (1 + c (n − 1)), where c is the correlation between two policies' outcomes on one day, as estimated from the
days driven (`_shared_effect`), but at least 0.3. `sample` does not use this power.

The estimand of `interval` is the rate over the *population* of days like those driven. `cell_means` estimates rates on
the days that were driven. For the coverage of the intervals see `benchmarks/intervals.py`.

Policies are *ranked* by samples of their rates from the posterior. The probability of a policy's rank is the fraction
of samples in which the policy has that rank. Results hold for the world, twin or road, in which the trials were driven:
a ranking in the twin is no evidence for the same ranking on the road.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainc, betaincinv, betaln, expit, logit

from twin.evaluation.statistics import CONFIDENCE
from twin.types import Array

MIN_RATE_DAYS = 2
"""Number of days below which a policy's rate over days has no interval."""

_EDGES = np.concatenate([[0.0], expit(np.linspace(-7.5, 7.5, 47)), [1.0]])
"""Edges of the grid of rates."""
_RATES = np.concatenate([[_EDGES[1] / 3], expit((logit(_EDGES[1:-2]) + logit(_EDGES[2:-1])) / 2), [1 - _EDGES[1] / 3]])
_CORRELATIONS = (np.arange(10) + 0.5) / 10  # grid of ρ
_ALL_OR_NONE = 4.0  # exponent of the density of Beta(5, 1), the prior of ρ
_ALIKE = 1.0 - np.sqrt(1.0 - (np.arange(10) + 0.5) / 10)  # grid of τ: quantiles of its prior Beta(1, 2)
_MEANS = betaincinv(1.5, 1.5, (np.arange(15) + 0.5) / 15)  # grid of μ: quantiles of its prior Beta(3/2, 3/2)
_LEAST_SHARED = 0.3  # least correlation between two policies' outcomes on one day, also its prior mean
_PRIOR_DAYS = 2.0  # weight of this prior mean, as a number of days on which one more policy drives
_SLOPES = (0.0, 0.5, 1.0)  # grid of β, equally likely


@dataclass(frozen=True)
class RateModel:
    """Posterior of the rates of n policies; see the module's docstring."""

    successes: Array
    """Successes in each cell, shape (n, k)."""
    trials: Array
    """Trials in each cell, shape (n, k); 0 in padding."""
    likelihood: Array
    """Likelihood of each policy's cells given its rate (axis g) and ρ (axis r), relative to its maximum over rates,
    shape (n, g, r)."""
    maximum: Array
    """Logarithm of this maximum, shape (n, r)."""
    prior: Array
    """Prior mass of the grid's rates for each combination h of μ, τ and β, shape (n or 1, h, g)."""
    evidence: Array
    """Log-likelihood of each policy's cells for each h and ρ, shape (n, h, r)."""
    weight: Array
    """Posterior mass of each h and ρ, shape (h, r)."""
    correlations: Array
    """Prior mass of each ρ, up to a factor, shape (r,)."""
    power: float
    """Power of the other policies' likelihood in a policy's posterior."""

    @staticmethod
    def fit(
        successes: ArrayLike,
        trials: ArrayLike,
        covariate: ArrayLike | None = None,
        shared_days: bool = True,
        all_or_none: bool = True,
    ) -> "RateModel":
        """Fits the counts of n policies in up to k cells, shapes (n, k); cells without trials are padding.

        Args:
            covariate: xᵢ [logit], shape (n,); `fit` subtracts its mean; None: no covariate.
            shared_days: True if column j is the same day for all policies; see the module's docstring.
            all_or_none: True: the prior of ρ expects that all trials of a day have the same outcome; False: it is
                uniform.

        Raises:
            ValueError: more successes than trials, negative counts, or shapes that differ.
        """
        won, driven = np.atleast_2d(np.asarray(successes, float)), np.atleast_2d(np.asarray(trials, float))
        if won.shape != driven.shape or not len(won) or (won < 0).any() or (won > driven).any():
            raise ValueError(f"successes {won.shape} of trials {driven.shape}: expected 0 ≤ successes ≤ trials, (n, k)")
        days = (driven > 0).sum(-1).max()
        logs = _log_likelihood(won, driven) * ((2 * days - 1) / (2 * days + 1) if shared_days else 1.0)
        maximum = logs.max(1)  # for each ρ: with hundreds of days the likelihoods of some ρ are too small for a float
        likelihood = np.exp(logs - maximum[:, None])
        slopes = np.zeros(1) if covariate is None else np.array(_SLOPES)
        given = np.zeros(1) if covariate is None else np.asarray(covariate, float)
        x = given - given.mean()
        mean, correlation, slope = (a.ravel() for a in np.meshgrid(_MEANS, _ALIKE, slopes, indexing="ij"))
        centers = expit(logit(mean) + slope * x[:, None])
        a, b = _beta(np.clip(centers, 1e-4, 1 - 1e-4), correlation)
        prior = np.diff(betainc(a[..., None], b[..., None], _EDGES), axis=-1)
        evidence = np.log(np.maximum(np.matmul(prior, likelihood), 1e-300)) + maximum[:, None]
        log = evidence.sum(0)
        correlations = _CORRELATIONS ** (_ALL_OR_NONE if all_or_none else 0.0)
        weight = np.exp(log - log.max()) * correlations
        others = max(int((driven.sum(-1) > 0).sum()) - 1, 0)
        power = 1.0 / (1.0 + _shared_effect(won, driven) * others) if shared_days else 1.0
        weight /= weight.sum()
        return RateModel(won, driven, likelihood, maximum, prior, evidence, weight, correlations, power)

    def posterior(self) -> Array:
        """Mass of the grid's rates for each policy, shape (n, g)."""
        return np.asarray(self._joint().sum(-1))

    def _joint(self) -> Array:
        """Mass of the grid's rates and ρ for each policy, shape (n, g, r)."""
        log = self.power * (self.evidence.sum(0) - self.evidence) + self.maximum[:, None]
        scaled = np.exp(log - log.max((1, 2), keepdims=True)) * self.correlations
        prior = np.broadcast_to(self.prior, (len(scaled), *self.prior.shape[1:]))
        mass = np.matmul(np.swapaxes(prior, 1, 2), scaled) * self.likelihood
        return np.asarray(mass / mass.sum((-1, -2), keepdims=True))

    def mean(self) -> Array:
        """Posterior mean of each policy's rate over days, shape (n,)."""
        return np.asarray(self.posterior() @ _RATES)

    def interval(self) -> tuple[Array, Array]:
        """Ends of the shortest credible interval of each policy's rate over days, shapes (n,)."""
        ends = np.array([_shortest(mass, _EDGES) for mass in self.posterior()])
        return ends[:, 0], ends[:, 1]

    def sample(self, rng: np.random.Generator, samples: int) -> Array:
        """Samples of the policies' rates over days, shape (samples, n), for a model without shared days."""
        chosen = rng.choice(self.weight.size, samples, p=self.weight.ravel())
        h, r = np.unravel_index(chosen, self.weight.shape)
        out = np.empty((samples, len(self.likelihood)))
        for i, likelihood in enumerate(self.likelihood):
            mass = self.prior[min(i, len(self.prior) - 1)][h] * likelihood.T[r]
            cumulative = np.cumsum(mass, -1)
            picked = (cumulative < rng.random((samples, 1)) * cumulative[:, -1:]).sum(-1)
            low, high = _EDGES[picked], _EDGES[picked + 1]
            out[:, i] = low + (high - low) * rng.random(samples)
        return out

    def cell_means(self) -> Array:
        """Posterior mean of the rate of each cell, shape (n, k): its observed rate, shrunk towards the policy's."""
        joint = self._joint()
        size = 1.0 / _CORRELATIONS - 1.0
        won, driven = self.successes[:, :, None, None], self.trials[:, :, None, None]
        means = (_RATES[:, None] * size + won) / (size + driven)
        return np.asarray((joint[:, None] * means).sum((-1, -2)))


def _shared_effect(won: Array, driven: Array) -> float:
    """Correlation between two policies' success rates on one day, from cells (n, k), at least `_LEAST_SHARED`.

    It is the mean over pairs of policies, on the days that both drove, and shrunk towards the prior mean.
    """
    mask = driven > 0
    rate = np.where(mask, won / np.maximum(driven, 1.0), 0.0)
    off = np.where(mask, rate - rate.sum(1, keepdims=True) / np.maximum(mask.sum(1, keepdims=True), 1), 0.0)
    together, spread = off @ off.T, off**2 @ mask.T
    pairs = np.triu_indices(len(off), 1)
    scale = np.sqrt(spread * spread.T)[pairs].sum()
    varied = int((np.abs(off).max(1) > 1e-9).sum())
    if varied < 2 or scale < 1e-9:
        return _LEAST_SHARED
    weight = (varied - 1) * (int(mask.any(0).sum()) - 1)
    found = (_PRIOR_DAYS * _LEAST_SHARED + weight * together[pairs].sum() / scale) / (_PRIOR_DAYS + weight)
    return float(np.clip(found, _LEAST_SHARED, 1.0))


def _beta(mean: Array, correlation: Array) -> tuple[Array, Array]:
    """Parameters of a Beta distribution from mean and intra-class correlation."""
    size = 1.0 / correlation - 1.0
    return mean * size, (1.0 - mean) * size


def _log_likelihood(won: Array, driven: Array) -> Array:
    """Sum over cells of the beta-binomial log-likelihood, up to a term per policy, shape (n, g, r)."""
    a, b = _beta(_RATES[:, None], _CORRELATIONS[None])
    pairs, index = np.unique(np.stack([won.ravel(), driven.ravel()], -1), axis=0, return_inverse=True)
    y, m = pairs[:, 0, None, None], pairs[:, 1, None, None]
    table = betaln(a + y, b + m - y) - betaln(a, b)
    counts = np.zeros((len(won), len(pairs)))
    np.add.at(counts, (np.repeat(np.arange(len(won)), won.shape[1]), index.ravel()), 1.0)
    return np.asarray(np.tensordot(counts, table, 1))


def _shortest(mass: Array, edges: Array) -> tuple[float, float]:
    """Shortest interval with mass `CONFIDENCE` of a distribution that is uniform between the edges of each bin."""
    below = np.concatenate([[0.0], np.cumsum(mass)])
    below /= below[-1]
    start = np.linspace(0.0, 1.0 - CONFIDENCE, 201)
    low, high = np.interp(start, below, edges), np.interp(start + CONFIDENCE, below, edges)
    best = int(np.argmin(high - low))
    return float(low[best]), float(high[best])


# ---- ranking

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
