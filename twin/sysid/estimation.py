"""Least squares that says how sure it is, and leaves alone what the data do not show.

A *parameter* may have a guess, what it is likely to be before any log, and has a span: how far off that may well be (a
normal prior: mean and one standard deviation). What is fitted is the most probable, given both the log, whose misses
are a Student's t (`robust`), and the guesses; that keeps many parameters from conspiring to explain the noise of a
short log. Where a guess is far off, a log of some minutes outweighs it. The *rule*: a parameter is identified if the
log leaves at most half of the doubt about it, all others being free: a standard error of half its span. Of those that
are not, the least certain one goes back to its usual value, the rest is judged anew, and what is left is fitted again,
until a fit leaves none to go.

Standard errors are cluster-robust (Liang and Zeger 1986): misses of one group of windows may depend on each other in
any way; where those of windows by themselves are larger, as they may be of few groups, those. Bent as misses are,
single impossible windows neither pull nor blow them up; that their pull falls off with distance makes the valley
flatter than squares would, and what is found less sure.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.types import Array

# ---- Misses of heavy tails: Student's t of three degrees of freedom, of scales that the misses themselves tell.
#
# A robot that is stuck for two seconds misses its model by a hundred times what it usually does; squares would have such
# windows decide a fit. So *misses*, predicted minus measured, of a window are taken to be of a multivariate t (Lange,
# Little and Taylor 1989), whose −2 log likelihood for c components of scale σ is, but for a constant,
#
#     2 Σ log σ + (ν + c) log(1 + s),    s = Σ (miss / σ)² / ν    (the mean over the instants that are looked at)
#
# with ν = `FREEDOM`; where ν was left to a log as well, DRIVE's, it came to 2.6 to 3.2. The instants of a window count as
# one. Components of one *kind*, such as x and y, share their scale. Nobody knows beforehand how well a model can do on
# some ground, so scales are the likeliest for the misses there are; they and the model are found in turns, which makes
# both likelier every time. *Scaled* misses are in units of σ √ν; *bent*, the squares of a window's sum to log(1 + s), as
# least-squares solvers would have it.


Kinds = tuple[int, ...]
"""The kind of each component, numbered from 0."""

FREEDOM = 3.0  # degrees of

_FINEST = 1e-3  # the least scale, in units of the misses: no log tells millimetres, milliradians, or as much a second
_ROUNDS, _SETTLED = 10, 0.05  # at most, of scales and model in turns; share by which scales that have settled change
_ITERATIONS, _CLOSE = 500, 1e-4


def unit(misses: Array, kinds: Kinds) -> Array:
    """σ √ν of each component, shape (c,), that makes misses (n, looks, c) likeliest, where no kind is without noise.

    Where more than ν / (ν + c) of the windows have next to no misses, those alone decide.
    """
    kind = np.asarray(kinds)
    of_kind = [misses[..., kind == k] for k in range(kind.max() + 1)]
    scale = np.array([max(float(np.median(np.abs(m))), _FINEST) for m in of_kind])
    for _ in range(_ITERATIONS):  # expectation and maximisation, with the step of Kent, Tyler and Vardi (1994)
        weight = 1 / (1 + _size(misses / (scale[kind] * np.sqrt(FREEDOM))))
        square = [(weight * (m**2).mean((1, 2))).sum() / weight.sum() for m in of_kind]
        before, scale = scale, np.maximum(np.sqrt(square), _FINEST)
        if not np.abs(scale / before - 1).max() >= _CLOSE:  # as it never is without numbers
            break
    return scale[kind] * np.sqrt(FREEDOM)


def negative_log_likelihood(misses: Array, kinds: Kinds) -> float:
    """Minus the log likelihood of misses (n, looks, c), of likeliest scales; per window, and but for a constant."""
    units = unit(misses, kinds)
    return float(np.log(units).sum() + (FREEDOM + len(kinds)) / 2 * np.log1p(_size(misses / units)).mean())


def in_turns(
    begin: Array, misses: Callable[[Array], Array], kinds: Kinds, solve: Callable[[Array, Array], Array]
) -> Array:
    """A model and the scales of its misses, found in turns until these have settled.

    Args:
        begin: The model, as numbers.
        misses: Of a model, shape (n, looks, c).
        kinds: Of components.
        solve: The best model from another one on, with misses in given units, shape (c,).
    """
    scale = unit(misses(begin), kinds)
    for _ in range(_ROUNDS):
        begin = solve(begin, scale)
        before, scale = scale, unit(misses(begin), kinds)
        if np.abs(scale / before - 1).max() < _SETTLED:
            break
    return begin


def robust_loss(scaled: Array) -> Array:
    """Scaled misses (n, looks, c), times what makes the squares of a window sum to log(1 + s)."""
    return scaled * _per_window(_bend(_size(scaled)) / np.sqrt(scaled.shape[1]), scaled)


def robust_slopes(scaled: Array, slopes: Array) -> Array:
    """What a least-squares solver may take for the slopes of `bent(scaled)`: with them its gradient is exact.

    The true ones turn with the misses, over which differences stumble; Gauss and Newton do not need that part.

    Args:
        scaled: Shape (n, looks, c).
        slopes: Of `scaled`, one more axis.
    """
    size = _size(scaled)
    return slopes * _per_window(1 / (1 + size) / _bend(size) / np.sqrt(scaled.shape[1]), slopes)


def weighted(scaled: Array, values: Array) -> Array:
    """Values (n, ...) times the root of their window's weight 1 / (1 + s), as iterated least squares would have it."""
    return values * _per_window(1 / np.sqrt((1 + _size(scaled)) * scaled.shape[1]), values)


def _size(scaled: Array) -> Array:
    """s of every window."""
    return (scaled**2).sum((1, 2)) / scaled.shape[1]


def _bend(size: Array) -> Array:
    """√(log(1 + s) / s), which tends to 1 at 0."""
    return np.where(size < 1e-9, 1.0, np.sqrt(np.log1p(size) / np.maximum(size, 1e-12)))


def _per_window(factor: Array, like: Array) -> Array:
    return factor.reshape(-1, *[1] * (like.ndim - 1))


SHARE = 0.5  # of its span that a parameter's standard error may be
_FLATTEST = 0.1  # of the curvature that squares would have; where noise rules, differences of the two are noise, too
_STEP = 0.05  # of its span, for differences
_NATS = 0.02  # of likelihood; a search ends where a step brings less: a fifth of a standard error off in one direction
_EVALUATIONS = 50  # at most, per round of the search; those that lead on take one per free parameter besides


@dataclass(frozen=True)
class Parameter:
    """One number that a log may show."""

    name: str
    guess: float | None
    """None: all that is known of it is what the log says."""
    span: float
    """How far off the guess may well be; without one, twice the standard error at which it counts as known."""
    low: float
    high: float
    usual: float
    """What it stays at where the log does not show it."""
    unit: str
    cure: str = "a log that uses the full range of speeds and turns"
    """What kind of log would show it."""


@dataclass(frozen=True)
class Fit:
    """What came out; names not in `errors` were left at their usual values."""

    values: dict[str, float]
    """Every parameter's value."""
    errors: dict[str, float]
    """Standard errors of the identified ones."""
    refused: dict[str, str]
    """Why the others were left alone, one line each."""
    unlikelihood: float
    """Of the misses that are left (`robust.unlikelihood`)."""


def search(
    table: list[Parameter],
    misses: Callable[[dict[str, float]], Array],
    kinds: Kinds,
    begin: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, float]:
    """The most probable values of every parameter, whether or not the data identify it.

    Args:
        table: What is fitted.
        misses: Of every window for values by name, shape (n, looks, c).
        kinds: Of their components.
        begin: Values to begin at.
        reach: Scale of the search's first step, in spans; less where it begins near the end. A step goes as far as
            the root of it times the distance to the bound.
        progress: Told a line per step of the search.
    """
    # In `reach` spans from where the search begins: so SciPy scales its first step, and its tolerances mean the same
    # for every parameter.
    low, high = (np.array([getattr(p, of) for p in table]) for of in ("low", "high"))
    spans = reach * np.array([p.span for p in table])
    misses = _remembered(misses)
    guess = np.array([p.guess or 0.0 for p in table])
    sure = np.array([0.0 if p.guess is None else np.sqrt(_likely(kinds)) / p.span for p in table])
    origin = np.clip([begin[p.name] for p in table], low + 1e-6 * spans, high - 1e-6 * spans)

    def at(z: Array) -> dict[str, float]:
        return dict(zip((p.name for p in table), (origin + z * spans).tolist(), strict=True))

    def solve(start: Array, scale: Array) -> Array:
        def shifted(z: Array) -> Array:
            off = (origin + (start + z) * spans - guess) * sure
            return np.append(robust_loss(misses(at(start + z)) / scale).ravel(), off)

        def tilted(z: Array) -> Array:
            now = misses(at(start + z))
            progress(f"  −log likelihood of a window's misses: {negative_log_likelihood(now, kinds):.4f}")
            slopes = _slopes(table, misses, at(start + z), now) / scale[:, None]
            slopes = robust_slopes(now / scale, slopes).reshape(-1, len(table))
            return np.concatenate([slopes, np.diag(sure)]) * spans

        bounds = (low - origin) / spans - start, (high - origin) / spans - start
        z = np.zeros(len(table))  # from elsewhere SciPy's first step would be as long as that is far
        half = float((shifted(z) ** 2).sum()) / 2  # what SciPy makes less
        enough = min(1e-3, _NATS / ((FREEDOM + len(kinds)) * max(half, 1e-9)))
        return start + least_squares(shifted, z, tilted, bounds, ftol=enough, xtol=1e-3, max_nfev=_EVALUATIONS).x

    return at(in_turns(np.zeros(len(table)), lambda z: misses(at(z)), kinds, solve))


def fit(
    table: list[Parameter],
    misses: Callable[[dict[str, float]], Array],
    kinds: Kinds,
    groups: NDArray[np.int64],
    begin: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Fits what the data identify of a table of parameters.

    Args:
        table: What may be fitted.
        misses: As of `search`.
        kinds: As of `search`.
        groups: Of the windows, shape (n,).
        begin: Values to begin at.
        reach: As of `search`.
        progress: Told a line per round and per step of the search.
    """
    free = list(table)
    values = {p.name: begin[p.name] for p in table}
    refused: dict[str, str] = {}
    misses = _remembered(misses)

    def at(some: dict[str, float]) -> Array:
        return misses(values | some)

    while True:  # comes to an end, as a parameter less is fitted every time
        if free:
            progress(f"fitting {', '.join(p.name for p in free)}")
            values |= search(free, at, kinds, values, reach, progress)
        now = misses(values)
        scale = unit(now, kinds)
        slopes = _slopes(free, at, values, now) / scale[:, None]
        count = len(free)
        while True:  # judge, drop the worst, judge again
            spans = np.array([p.span for p in free])
            likely = np.array([0.0 if p.guess is None else _likely(kinds) for p in free])
            errors = _standard_errors(slopes, now / scale, groups, spans, likely)
            worst = int(np.argmax(errors / spans)) if free else -1
            if worst < 0 or errors[worst] <= SHARE * spans[worst]:
                break
            p = free.pop(worst)
            values[p.name] = p.usual
            refused[p.name] = (
                f"{p.name} = {p.usual:.4g} {p.unit}".rstrip()
                + f": standard error {_told(errors[worst])}, wanted at most {SHARE * p.span:.3g}; needs {p.cure}"
            )
            slopes = np.delete(slopes, worst, -1)
        if len(free) == count:
            found = {p.name: float(e) for p, e in zip(free, errors, strict=True)}
            return Fit(values, found, refused, negative_log_likelihood(now, kinds))


def _likely(kinds: Kinds) -> float:
    """By which (value − guess)² / span² counts beside log(1 + s)."""
    return 1 / (FREEDOM + len(kinds))


def _remembered(misses: Callable[[dict[str, float]], Array]) -> Callable[[dict[str, float]], Array]:
    """The same, but nothing twice: what is found is judged by misses and slopes that the search ended with.

    Those are among the newest few per parameter; the others are forgotten.
    """
    seen: dict[tuple[float, ...], Array] = {}

    def at(values: dict[str, float]) -> Array:
        key = tuple(values.values())
        if key not in seen:
            seen[key] = misses(values)
            if len(seen) > 4 * (len(values) + 1):
                del seen[next(iter(seen))]
        return seen[key]

    return at


def _slopes(
    table: list[Parameter], misses: Callable[[dict[str, float]], Array], values: dict[str, float], now: Array
) -> Array:
    """Of misses `now` at these values by differences, one more axis for parameters."""
    columns = []
    for p in table:
        step = _STEP * p.span * (1 if values[p.name] + _STEP * p.span <= p.high else -1)
        columns.append((misses(values | {p.name: values[p.name] + step}) - now) / step)
    return np.stack(columns, -1) if columns else np.empty((*now.shape, 0))


def _standard_errors(slopes: Array, scaled: Array, groups: NDArray[np.int64], spans: Array, likely: Array) -> Array:
    """Cluster-robust, shape (p,), from slopes (n, looks, c, p) of scaled misses (n, looks, c); infinite where nothing
    tells. `likely` is by how much guesses count, 0 without one, shape (p,)."""
    if not slopes.shape[-1]:
        return np.zeros(0)
    slopes = slopes * spans
    rows = slopes.reshape(len(scaled), -1, len(spans))
    pull = weighted(scaled, weighted(scaled, scaled)).reshape(len(scaled), -1)
    score = np.einsum("nmp,nm->np", rows, pull)
    _, cluster = np.unique(groups, return_inverse=True)
    meat = np.zeros((len(spans),) * 2)
    count = int(cluster.max()) + 1
    for i in range(count):
        g = score[cluster == i].sum(0)
        meat += np.outer(g, g)
    steep = weighted(scaled, slopes).reshape(rows.shape)
    told = np.einsum("nmp,nmq->pq", steep, steep)
    # A direction that nothing tells of has next to no curvature, hence a huge error rather than a division by zero.
    prior = np.diag(np.where(likely > 0, likely, 1e-9 * max(1.0, float(np.trace(told)) / len(told))))
    inverse = _inverse_curvature(told + prior, score)
    doubt = prior * np.where(likely > 0, likely, 1.0)
    robust = np.diag(inverse @ (meat * count / max(1, count - 1) + doubt) @ inverse)
    own = score.T @ score * len(score) / max(1, len(score) - len(told))
    alone = np.diag(inverse @ (own + doubt) @ inverse)
    variance = np.maximum(robust, alone)
    flat = np.diag(told) < 1e-6 * max(1.0, float(np.diag(told).max()))
    return np.where(flat, np.inf, np.sqrt(np.maximum(variance, 0.0))) * spans


def _inverse_curvature(steep: Array, score: Array) -> Array:
    """Inverse of the curvature of what is least.

    log(1 + s) has less of it than the squares that stand for it in a step, by twice the squared score of every window.
    """
    root = np.linalg.inv(np.linalg.cholesky(steep))
    less, axes = np.linalg.eigh(2 * root @ score.T @ score @ root.T)
    half = axes.T @ root
    return half.T @ (half / np.maximum(1 - less, _FLATTEST)[:, None])


def _told(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "unbounded (the log does not move it at all)"
