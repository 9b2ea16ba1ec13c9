"""Least squares that says how sure it is, and leaves alone what the data do not show.

A *parameter* may have a guess, what it is likely to be before any log, and has a span: how far off that may well be (a
normal prior: mean and one standard deviation). What is fitted is the most probable, given both the log and the guesses;
that keeps many parameters from conspiring to explain the noise of a short log. Where a guess is far off, a log of some
minutes outweighs it. What log(1 + s) of a window weighs against it is that of Cauchy's distribution of x, y and yaw,
whose −2 log likelihood is 4 log(1 + s). The *rule*: a parameter is identified if the log leaves at most half of the
doubt about it, all others being free: a standard error of half its span. Of those that are not, the least certain one
goes back to its usual value, the rest is judged anew, and what is left is fitted again, until a fit leaves none to go.

Standard errors are cluster-robust (Liang and Zeger 1986): residuals of one group of windows may depend on each other in
any way; where the classical ones are larger, those. Residuals are bent (`kinematics.bend`), so single impossible
windows neither pull nor blow them up; that their pull falls off with distance makes the valley flatter, and what is
found less sure, by a third to a half where most residuals are as large as those of a real log.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.alignment.kinematics import bend, bent_slopes, weighted

Array = NDArray[np.float64]

SHARE = 0.5  # of its span that a parameter's standard error may be
_LIKELY = 0.25  # by which (value − guess)² / span² counts beside log(1 + s)
_FLATTEST = 0.1  # of the curvature that squares would have; where noise rules, differences of the two are noise, too
_STEP = 0.05  # of its span, for differences
_EVALUATIONS = 20  # at most, per round of the search; those that lead on take one per free parameter besides


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
    cost: float
    """Mean of log(1 + s) over windows."""


def search(
    table: list[Parameter],
    error: Callable[[dict[str, float]], Array],
    begin: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, float]:
    """The most probable values of every parameter, whether or not the data identify it.

    Args:
        table: What is fitted.
        error: Residuals of every window for values by name, in units of a good model's miss, shape (n, looks, ...).
        begin: Values to begin at.
        reach: Scale of the search's first step, in spans; less where it begins near the end. A step goes as far as
            the root of it times the distance to the bound.
        progress: Told a line per step of the search.
    """
    # In `reach` spans from where the search begins: so SciPy scales its first step, and its tolerances mean the same
    # for every parameter.
    low, high = (np.array([getattr(p, of) for p in table]) for of in ("low", "high"))
    spans = reach * np.array([p.span for p in table])
    error = _remembered(error)
    guess = np.array([p.guess or 0.0 for p in table])
    sure = np.array([0.0 if p.guess is None else np.sqrt(_LIKELY) / p.span for p in table])
    origin = np.clip([begin[p.name] for p in table], low + 1e-6 * spans, high - 1e-6 * spans)

    def named(point: Array) -> dict[str, float]:
        return dict(zip((p.name for p in table), point.tolist(), strict=True))

    def shifted(z: Array) -> Array:
        point = origin + z * spans
        return np.append(bend(error(named(point))).ravel(), (point - guess) * sure)

    def tilted(z: Array) -> Array:
        point = origin + z * spans
        now = error(named(point))
        progress(f"  mean log(1 + s) = {_cost(now):.4f}")
        bent = bent_slopes(now, _slopes(table, error, named(point), now)).reshape(-1, len(table))
        return np.concatenate([bent, np.diag(sure)]) * spans

    found = least_squares(
        shifted,
        np.zeros(len(table)),
        jac=tilted,
        bounds=((low - origin) / spans, (high - origin) / spans),
        ftol=3e-4,
        xtol=3e-3,
        max_nfev=_EVALUATIONS,
    )
    return named(origin + found.x * spans)


def fit(
    table: list[Parameter],
    error: Callable[[dict[str, float]], Array],
    groups: NDArray[np.int64],
    begin: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Fits what the data identify of a table of parameters.

    Args:
        table: What may be fitted.
        error: As of `search`.
        groups: Of the windows, shape (n,).
        begin: Values to begin at.
        reach: As of `search`.
        progress: Told a line per round and per step of the search.
    """
    free = list(table)
    values = {p.name: begin[p.name] for p in table}
    refused: dict[str, str] = {}
    error = _remembered(error)

    def at(some: dict[str, float]) -> Array:
        return error(values | some)

    while True:  # comes to an end, as a parameter less is fitted every time
        if free:
            progress(f"fitting {', '.join(p.name for p in free)}")
            values |= search(free, at, values, reach, progress)
        now = error(values)
        jacobian = _slopes(free, at, values, now)
        count = len(free)
        while True:  # judge, drop the worst, judge again
            spans = np.array([p.span for p in free])
            errors = _standard_errors(jacobian, now, groups, spans, np.array([p.guess is not None for p in free]))
            worst = int(np.argmax(errors / spans)) if free else -1
            if worst < 0 or errors[worst] <= SHARE * spans[worst]:
                break
            p = free.pop(worst)
            values[p.name] = p.usual
            refused[p.name] = (
                f"{p.name} = {p.usual:.4g} {p.unit}".rstrip()
                + f": standard error {_told(errors[worst])}, wanted at most {SHARE * p.span:.3g}; needs {p.cure}"
            )
            jacobian = np.delete(jacobian, worst, -1)
        if len(free) == count:
            found = {p.name: float(e) for p, e in zip(free, errors, strict=True)}
            return Fit(values, found, refused, _cost(now))


def _remembered(error: Callable[[dict[str, float]], Array]) -> Callable[[dict[str, float]], Array]:
    """The same, but nothing twice: what is found is judged by residuals and slopes that the search ended with.

    Those are among the newest few per parameter; the others are forgotten.
    """
    seen: dict[tuple[float, ...], Array] = {}

    def at(values: dict[str, float]) -> Array:
        key = tuple(values.values())
        if key not in seen:
            seen[key] = error(values)
            if len(seen) > 4 * (len(values) + 1):
                del seen[next(iter(seen))]
        return seen[key]

    return at


def _slopes(
    table: list[Parameter], error: Callable[[dict[str, float]], Array], values: dict[str, float], now: Array
) -> Array:
    """Of residuals `now` at these values by differences, one more axis for parameters."""
    columns = []
    for p in table:
        step = _STEP * p.span * (1 if values[p.name] + _STEP * p.span <= p.high else -1)
        columns.append((error(values | {p.name: values[p.name] + step}) - now) / step)
    return np.stack(columns, -1) if columns else np.empty((*now.shape, 0))


def _cost(error: Array) -> float:
    """Mean of log(1 + s) over windows."""
    return float((bend(error) ** 2).sum() / len(error))


def _standard_errors(
    jacobian: Array, error: Array, groups: NDArray[np.int64], spans: Array, guessed: NDArray[np.bool_]
) -> Array:
    """Cluster-robust, shape (p,), from slopes (n, ..., p) and residuals (n, ...); infinite where nothing tells."""
    if not jacobian.shape[-1]:
        return np.zeros(0)
    scaled = weighted(error, jacobian * spans).reshape(len(error), -1, len(spans))
    error = weighted(error, error).reshape(len(error), -1)
    score = np.einsum("nmp,nm->np", scaled, error)
    _, cluster = np.unique(groups, return_inverse=True)
    meat = np.zeros((scaled.shape[-1],) * 2)
    count = int(cluster.max()) + 1
    for i in range(count):
        g = score[cluster == i].sum(0)
        meat += np.outer(g, g)
    told = np.einsum("nmp,nmq->pq", scaled, scaled)
    # A direction that nothing tells of has next to no curvature, hence a huge error rather than a division by zero.
    prior = np.diag(np.where(guessed, _LIKELY, 1e-9 * max(1.0, float(np.trace(told)) / len(told))))
    inverse = _inverse_curvature(told + prior, score)
    doubt = prior * np.where(guessed, _LIKELY, 1.0)
    robust = np.diag(inverse @ (meat * count / max(1, count - 1) + doubt) @ inverse)
    # Two that do exactly the same have no score where they differ, so only the classical error tells on them.
    noise = (error**2).sum() / max(1, error.size - len(told))
    classical = np.diag(inverse @ (told * noise + doubt) @ inverse)
    variance = np.maximum(robust, classical)
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
