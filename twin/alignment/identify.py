"""Least squares that says how sure it is, and leaves alone what the data do not show.

A *parameter* has a span: how far from its usual value it may well be, known without any log (one standard deviation).
The *rule*: a parameter is identified if its standard error, all others being free, is at most half its span. Of those
that are not, the least certain one goes back to its usual value, the rest is judged anew, and what is left is fitted
again, until a fit leaves none to go. Before the first fit, far from the best values, only hopeless ones go: those
uncertain by ten times their span.

Standard errors are cluster-robust (Liang and Zeger 1986): residuals of one group of windows may depend on each other in
any way; where the classical ones are larger, those. Residuals are bent (`kinematics.bend`), so single impossible
windows neither pull nor blow them up.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.alignment.kinematics import bend, bent_slopes, weighted

Array = NDArray[np.float64]

SHARE = 0.5  # of its span that a parameter's standard error may be
_HOPELESS = 10.0  # the same before the first fit
_STEP = 0.05  # of its span, for differences
_EVALUATIONS = 20  # at most, per round of the search; those that lead on take one per free parameter besides


@dataclass(frozen=True)
class Parameter:
    """One number that a log may show."""

    name: str
    start: float
    """Where the search begins."""
    span: float
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


def fit(
    table: list[Parameter],
    error: Callable[[dict[str, float]], Array],
    groups: NDArray[np.int64],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Fits what the data identify of a table of parameters.

    Args:
        table: What may be fitted.
        error: Residuals of every window for values by name, in units of a good model's miss, shape (n, looks, ...).
        groups: Of the windows, shape (n,).
        reach: How far the search's first step may go, in spans; less where it begins near the end.
        progress: Told a line per round and per step of the search.
    """
    free = {p.name: p for p in table}
    values = {p.name: p.start for p in table}
    refused: dict[str, str] = {}

    def at(point: Array, names: list[str]) -> Array:
        return error(values | dict(zip(names, point.tolist(), strict=True)))

    def slopes(point: Array, names: list[str], now: Array) -> Array:
        columns = []
        for i, name in enumerate(names):
            p = free[name]
            step = _STEP * p.span * (1 if point[i] + _STEP * p.span <= p.high else -1)
            moved = point.copy()
            moved[i] += step
            columns.append((at(moved, names) - now) / step)
        return np.stack(columns, -1) if columns else np.empty((*now.shape, 0))

    fitted = False
    while True:  # comes to an end, as a parameter less is fitted every time
        names = list(free)
        point = np.array([values[name] for name in names])
        now = at(point, names)
        jacobian = slopes(point, names, now)
        while True:  # judge, drop the worst, judge again
            errors = _standard_errors(jacobian, now, groups, np.array([free[n].span for n in names]))
            relative = errors / [free[n].span for n in names]
            worst = int(np.argmax(relative)) if names else -1
            if worst < 0 or relative[worst] <= (SHARE if fitted else _HOPELESS):
                break
            p = free.pop(names.pop(worst))
            values[p.name] = p.usual
            refused[p.name] = (
                f"{p.name} = {p.usual:.4g} {p.unit}".rstrip()
                + f": standard error {_told(errors[worst])}, wanted at most {SHARE * p.span:.3g}; needs {p.cure}"
            )
            jacobian = np.delete(jacobian, worst, -1)
        if (fitted or not names) and len(names) == len(point):  # nothing dropped after a fit, or nothing left to fit
            cost = float((bend(now) ** 2).sum() / len(now))
            return Fit(values, dict(zip(names, errors.tolist(), strict=True)), refused, cost)
        if not names:
            continue
        progress(f"fitting {', '.join(names)}")
        # In spans from where the search begins: SciPy's first step is then `reach` of them at most, and its tolerances
        # mean the same for every parameter.
        spans = reach * np.array([free[n].span for n in names])
        low = np.array([free[n].low for n in names])
        high = np.array([free[n].high for n in names])
        origin = np.clip([values[n] for n in names], low + 1e-6 * spans, high - 1e-6 * spans)

        def shifted(z: Array, origin=origin, spans=spans, names=names) -> Array:
            return bend(at(origin + z * spans, names)).ravel()

        def tilted(z: Array, origin=origin, spans=spans, names=names) -> Array:
            x = origin + z * spans
            error_now = at(x, names)
            progress(f"  mean log(1 + s) = {(bend(error_now) ** 2).sum() / len(error_now):.4f}")
            return bent_slopes(error_now, slopes(x, names, error_now)).reshape(-1, len(names)) * spans

        found = least_squares(
            shifted,
            np.zeros(len(names)),
            jac=tilted,
            bounds=((low - origin) / spans, (high - origin) / spans),
            ftol=3e-4,
            xtol=3e-3,
            max_nfev=_EVALUATIONS,
        )
        values |= dict(zip(names, (origin + found.x * spans).tolist(), strict=True))
        fitted = True


def _standard_errors(jacobian: Array, error: Array, groups: NDArray[np.int64], spans: Array) -> Array:
    """Cluster-robust, shape (p,), from slopes (n, ..., p) and residuals (n, ...); infinite where there is no slope."""
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
    bread = np.einsum("nmp,nmq->pq", scaled, scaled)
    # A direction without any slope gets next to no curvature, hence a huge error rather than a division by zero.
    bread += np.eye(len(bread)) * 1e-9 * max(1.0, float(np.trace(bread)) / len(bread))
    inverse = np.linalg.inv(bread)
    robust = np.diag(inverse @ meat @ inverse) * count / max(1, count - 1)
    # Two that do exactly the same have no score where they differ, so only the classical error tells on them.
    classical = np.diag(inverse) * (error**2).sum() / max(1, error.size - len(bread))
    variance = np.maximum(robust, classical)
    flat = np.diag(bread) < 1e-6 * max(1.0, float(np.diag(bread).max()))
    return np.where(flat, np.inf, np.sqrt(np.maximum(variance, 0.0))) * spans


def _told(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "unbounded (the log does not move it at all)"
