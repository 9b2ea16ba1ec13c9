"""Robust maximum a posteriori estimation with standard errors; unidentified parameters keep their defaults.

A *parameter* has a normal prior; the residuals of a window follow a multivariate Student's t distribution (below). A
parameter is *identified* if its standard error, with all free parameters fitted together, is at most `_MAX_ERROR_SHARE`
of its prior's standard deviation. Of the others, the least certain is fixed at its default, until all that remain are
identified; these are then fitted again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from twin.types import Array

# ---- Student's t residuals
#
# A robot that is stuck for two seconds has residuals a hundred times as large as usual, which would dominate a
# least-squares fit. So the residuals (predicted minus measured) of a window follow a heavy-tailed multivariate t
# distribution (Lange, Little and Taylor 1989). For c components with scales σ, −2 log-likelihood of a window is, up to
# a constant,
#
#     2 Σ log σ + (ν + c) log(1 + s),    s = Σ (residual / σ)² / ν    (mean over the window's evaluated instants)
#
# with ν = `DEGREES_OF_FREEDOM`. Components of one *kind*, such as x and y, share their scale. Maximum-likelihood
# scales are estimated in alternation with the model; both steps increase the likelihood. *Scaled* residuals are in
# units of σ √ν.

Kinds = tuple[int, ...]
"""The kind of each residual component, numbered from 0."""

DEGREES_OF_FREEDOM = 3.0  # fits of ν to the public DRIVE log gave 2.6 to 3.2

_MIN_SCALE = 1e-3  # [m], [rad] or [rad/s] smallest σ; logs are not more accurate
_ROUNDS, _SETTLED = 10, 0.05  # limit of alternations of scales and model; relative change of converged scales
_ITERATIONS, _CLOSE = 500, 1e-4  # limit of steps of expectation maximization; relative change of a scale that ends them


def residual_scale(residuals: Array, kinds: Kinds) -> Array:
    """Maximum-likelihood scales σ √ν, shape (c,), of residuals (n, instants, c); σ is at least `_MIN_SCALE`.

    If more than ν / (ν + c) of the windows have residuals of nearly zero, these windows alone determine the scale.
    """
    kind = np.asarray(kinds)
    of_kind = [residuals[..., kind == k] for k in range(kind.max() + 1)]
    scale = np.array([max(float(np.median(np.abs(r))), _MIN_SCALE) for r in of_kind])
    for _ in range(_ITERATIONS):  # expectation maximization with the step of Kent, Tyler and Vardi (1994)
        weight = 1 / (1 + _squared_norm(residuals / (scale[kind] * np.sqrt(DEGREES_OF_FREEDOM))))
        square = [(weight * (r**2).mean((1, 2))).sum() / weight.sum() for r in of_kind]
        before, scale = scale, np.maximum(np.sqrt(square), _MIN_SCALE)
        if not np.abs(scale / before - 1).max() >= _CLOSE:  # written so that NaN ends the loop, too
            break
    return scale[kind] * np.sqrt(DEGREES_OF_FREEDOM)


def negative_log_likelihood(residuals: Array, kinds: Kinds) -> float:
    """Negative log-likelihood per window of residuals (n, instants, c) at their best scales, up to a constant."""
    scale = residual_scale(residuals, kinds)
    spread = (DEGREES_OF_FREEDOM + len(kinds)) / 2 * np.log1p(_squared_norm(residuals / scale)).mean()
    return float(np.log(scale).sum() + spread)


def fit_with_scales(
    start: Array, residuals: Callable[[Array], Array], kinds: Kinds, solve: Callable[[Array, Array], Array]
) -> Array:
    """Fits a model and the scales of its residuals in alternation until the scales have converged.

    Args:
        residuals: Returns the residuals of a model, shape (n, instants, c).
        solve: Returns the best model, from an initial model and the scales (c,).
    """
    scale = residual_scale(residuals(start), kinds)
    for _ in range(_ROUNDS):
        start = solve(start, scale)
        before, scale = scale, residual_scale(residuals(start), kinds)
        if np.abs(scale / before - 1).max() < _SETTLED:
            break
    return start


def robust_loss(scaled: Array) -> Array:
    """Scaled residuals (n, instants, c), reweighted so that the squares of a window sum to log(1 + s)."""
    return scaled * _per_window(_loss_factor(_squared_norm(scaled)) / np.sqrt(scaled.shape[1]), scaled)


def robust_jacobian(scaled: Array, jacobian: Array) -> Array:
    """Approximate Jacobian of `robust_loss(scaled)` for least squares, from that of `scaled` (n, instants, c, p).

    It gives the exact gradient of the loss, and an approximate curvature.
    """
    norm = _squared_norm(scaled)
    return jacobian * _per_window(1 / (1 + norm) / _loss_factor(norm) / np.sqrt(scaled.shape[1]), jacobian)


def apply_weights(scaled: Array, values: Array) -> Array:
    """Values (n, ...) times √(weight / instants); weight is 1 / (1 + s), as in iteratively reweighted least squares."""
    return values * _per_window(1 / np.sqrt((1 + _squared_norm(scaled)) * scaled.shape[1]), values)


def _squared_norm(scaled: Array) -> Array:
    """s of every window, shape (n,)."""
    return (scaled**2).sum((1, 2)) / scaled.shape[1]


def _loss_factor(norm: Array) -> Array:
    """√(log(1 + s) / s), which tends to 1 at 0."""
    return np.where(norm < 1e-9, 1.0, np.sqrt(np.log1p(norm) / np.maximum(norm, 1e-12)))


def _per_window(factor: Array, like: Array) -> Array:
    return factor.reshape(-1, *[1] * (like.ndim - 1))


# ---- maximum a posteriori estimation

_MAX_ERROR_SHARE = 0.5  # largest standard error of an identified parameter, in prior standard deviations
_MIN_CURVATURE = 0.1  # smallest curvature / that of the least-squares step, see `_inverse_curvature`
_CURVATURE_STEPS = 20  # iterations that find the curvature over a standard error
_STEP = 0.05  # step of finite differences, in prior standard deviations
_NATS = 0.02  # [nat] a search ends when a step gains less; it is the loss at 0.2 standard errors from the maximum
_EVALUATIONS = 50  # limit of evaluations per round of the search, not counting those for Jacobians


@dataclass(frozen=True)
class Parameter:
    """One number to identify."""

    name: str
    prior_mean: float | None
    """None: no prior."""
    prior_std: float
    """Without a prior: twice the largest standard error with which the parameter counts as identified."""
    low: float
    high: float
    default: float
    """Value if it is not identified."""
    unit: str
    cure: str = "a log that uses the full range of speeds and turns"
    """The kind of log that would identify it."""


@dataclass(frozen=True)
class Fit:
    """Result of `fit_parameters`."""

    values: dict[str, float]
    errors: dict[str, float]
    """Standard errors of the identified parameters. The others have none; their values are the defaults."""
    refused: dict[str, str]
    """A line per parameter that is not identified: its default, its standard error and the cure."""


def maximize_posterior(
    table: list[Parameter],
    residuals: Callable[[dict[str, float]], Array],
    kinds: Kinds,
    start: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, float]:
    """The most probable value of every parameter, identified or not.

    Args:
        residuals: Returns the residuals of every window for values by name, shape (n, instants, c).
        reach: Scale of the first step in prior standard deviations; near the solution choose less. A step is at most
            √(reach · distance to the bound).
    """
    # In units of `reach` prior standard deviations from the start, SciPy's first step and tolerances have the same
    # meaning for every parameter.
    low, high, stds = (np.array([getattr(p, of) for p in table]) for of in ("low", "high", "prior_std"))
    scales = reach * stds
    residuals = _cached(residuals)
    prior_mean = np.array([p.prior_mean or 0.0 for p in table])
    prior_factor = np.sqrt(_prior_weights(table, kinds)) / stds
    origin = np.clip([start[p.name] for p in table], low + 1e-6 * scales, high - 1e-6 * scales)

    def at(z: Array) -> dict[str, float]:
        return dict(zip((p.name for p in table), (origin + z * scales).tolist(), strict=True))

    def solve(begin: Array, scale: Array) -> Array:
        def losses(z: Array) -> Array:
            off = (origin + (begin + z) * scales - prior_mean) * prior_factor
            return np.append(robust_loss(residuals(at(begin + z)) / scale).ravel(), off)

        def jacobian(z: Array) -> Array:
            now = residuals(at(begin + z))
            progress(f"  negative log-likelihood per window: {negative_log_likelihood(now, kinds):.4f}")
            slopes = _jacobian(table, residuals, at(begin + z), now) / scale[:, None]
            slopes = robust_jacobian(now / scale, slopes).reshape(-1, len(table))
            return np.concatenate([slopes, np.diag(prior_factor)]) * scales

        bounds = (low - origin) / scales - begin, (high - origin) / scales - begin
        z = np.zeros(len(table))  # SciPy's first step grows with the distance of its starting point from zero
        cost = float((losses(z) ** 2).sum()) / 2  # as SciPy defines it
        tolerance = min(1e-3, _NATS / ((DEGREES_OF_FREEDOM + len(kinds)) * max(cost, 1e-9)))
        return begin + least_squares(losses, z, jacobian, bounds, ftol=tolerance, xtol=1e-3, max_nfev=_EVALUATIONS).x

    return at(fit_with_scales(np.zeros(len(table)), lambda z: residuals(at(z)), kinds, solve))


def fit_parameters(
    table: list[Parameter],
    residuals: Callable[[dict[str, float]], Array],
    kinds: Kinds,
    groups: NDArray[np.int64],
    start: dict[str, float],
    reach: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Fits the parameters that the data identify; the others keep their defaults.

    `groups` (n,) has the group of each window; residuals within a group may be correlated. For the other arguments see
    `maximize_posterior`.
    """
    free = list(table)
    values = {p.name: start[p.name] for p in table}
    refused: dict[str, str] = {}
    residuals = _cached(residuals)

    def at(some: dict[str, float]) -> Array:
        return residuals(values | some)

    while True:  # each round has fewer free parameters
        if free:
            progress(f"fitting {', '.join(p.name for p in free)}")
            values |= maximize_posterior(free, at, kinds, values, reach, progress)
        now = residuals(values)
        scale = residual_scale(now, kinds)
        slopes = _jacobian(free, at, values, now) / scale[:, None]
        count = len(free)
        while True:  # drop the least certain parameter until all are identified
            stds = np.array([p.prior_std for p in free])
            errors = _standard_errors(slopes, now / scale, groups, stds, _prior_weights(free, kinds))
            worst = int(np.argmax(errors / stds)) if free else -1
            if worst < 0 or errors[worst] <= _MAX_ERROR_SHARE * stds[worst]:
                break
            p = free.pop(worst)
            values[p.name] = p.default
            error = (
                f"{errors[worst]:.3g}" if np.isfinite(errors[worst]) else "unbounded (the log does not depend on it)"
            )
            refused[p.name] = (
                f"{p.name} = {p.default:.4g} {p.unit}".rstrip()
                + f": standard error {error}, expected at most {_MAX_ERROR_SHARE * p.prior_std:.3g}; needs {p.cure}"
            )
            slopes = np.delete(slopes, worst, -1)
        if len(free) == count:
            found = {p.name: float(e) for p, e in zip(free, errors, strict=True)}
            return Fit(values, found, refused)


def _prior_weights(table: list[Parameter], kinds: Kinds) -> Array:
    """Weights (p,) of the priors' (value − mean)² / std² relative to log(1 + s) of a window; 0 without a prior."""
    return np.array([0.0 if p.prior_mean is None else 1 / (DEGREES_OF_FREEDOM + len(kinds)) for p in table])


def _cached(residuals: Callable[[dict[str, float]], Array]) -> Callable[[dict[str, float]], Array]:
    """Adds a cache of the newest results, since standard errors reuse the last ones of the search."""
    newest = lru_cache(64)(lambda items: residuals(dict(items)))
    return lambda values: newest(tuple(values.items()))


def _jacobian(
    table: list[Parameter], residuals: Callable[[dict[str, float]], Array], values: dict[str, float], now: Array
) -> Array:
    """Finite-difference Jacobian of the residuals `now` (n, instants, c) at these values, shape (n, instants, c, p)."""
    columns = []
    for p in table:
        step = _STEP * p.prior_std * (1 if values[p.name] + _STEP * p.prior_std <= p.high else -1)
        columns.append((residuals(values | {p.name: values[p.name] + step}) - now) / step)
    return np.stack(columns, -1) if columns else np.empty((*now.shape, 0))


def _standard_errors(jacobian: Array, scaled: Array, groups: NDArray[np.int64], stds: Array, weights: Array) -> Array:
    """Standard errors of the parameters, shape (p,); infinite where the data contain no information.

    They are cluster-robust (Liang and Zeger 1986): residuals within a group may be correlated in any way. With few
    groups, errors that treat windows as independent can be larger; the larger of the two is returned.

    Args:
        jacobian: Jacobian of the scaled residuals, shape (n, instants, c, p).
        scaled: Scaled residuals, shape (n, instants, c).
        groups: Group of each window, shape (n,).
        stds: Standard deviations of the priors, shape (p,).
        weights: Weights of the priors, shape (p,).
    """
    if not jacobian.shape[-1]:
        return np.zeros(0)
    jacobian = jacobian * stds
    rows = jacobian.reshape(len(scaled), -1, len(stds))
    weighted = apply_weights(scaled, apply_weights(scaled, scaled)).reshape(len(scaled), -1)
    score = np.einsum("nmp,nm->np", rows, weighted)
    _, cluster = np.unique(groups, return_inverse=True)
    meat = np.zeros((len(stds),) * 2)
    count = int(cluster.max()) + 1
    for i in range(count):
        g = score[cluster == i].sum(0)
        meat += np.outer(g, g)
    root = apply_weights(scaled, jacobian).reshape(rows.shape)
    information = np.einsum("nmp,nmq->pq", root, root)
    # A tiny prior gives a direction without information a huge error instead of a division by zero.
    tiny = 1e-9 * max(1.0, float(np.trace(information)) / len(information))
    prior = np.diag(np.where(weights > 0, weights, tiny))
    prior_meat = prior * np.where(weights > 0, weights, 1.0)
    window_meat = score.T @ score * len(score) / max(1, len(score) - len(information))
    meats = np.stack([meat * count / max(1, count - 1), window_meat]) + prior_meat
    inverses = [_inverse_curvature(information + prior, root, score, m) for m in meats]
    variance = np.max([np.diag(v @ m @ v) for v, m in zip(inverses, meats, strict=True)], 0)
    flat = np.diag(information) < 1e-6 * max(1.0, float(np.diag(information).max()))
    return np.where(flat, np.inf, np.sqrt(np.maximum(variance, 0.0))) * stds


def _inverse_curvature(information: Array, root: Array, score: Array, meat: Array) -> Array:
    """Inverse of the curvature of the objective between plus and minus one standard error, shape (p, p).

    The curvature of log(1 + s) is smaller than that of the squares that replace it in a least-squares step. At the
    optimum it can be nearly zero although the optimum is sharp: if half of the windows prefer one latency and half
    another, the objective is flat between the two but steep beyond. So the curvature along each principal axis is the
    mean over the interval of a standard error, which in turn depends on the curvature. It is at least `_MIN_CURVATURE`
    times that of the least-squares step, since its estimate is noisy.

    Args:
        information: Curvature of the least-squares step, with the prior, shape (p, p).
        root: Weighted Jacobian, shape (n, residuals of a window, p).
        score: Score of each window, shape (n, p).
        meat: Covariance of the sum of the scores, shape (p, p).
    """
    whiten = np.linalg.inv(np.linalg.cholesky(information))
    axes = np.linalg.eigh(whiten @ score.T @ score @ whiten.T)[1].T @ whiten
    # A shift t along an axis multiplies 1 + s of a window by 1 + 2 t · first + t² · second.
    first, second = score @ axes.T, ((root @ axes.T) ** 2).sum(1)
    spread = np.diag(axes @ meat @ axes.T)
    curvature = np.ones(len(axes))  # relative to the least-squares step, since the axes are whitened
    for _ in range(_CURVATURE_STEPS):
        t2 = spread / curvature**2
        both = 1 + t2 * second
        loss = second - (second * both - 2 * first**2) / (both**2 - 4 * t2 * first**2)
        curvature = np.sqrt(curvature * np.clip(1 - loss.sum(0), _MIN_CURVATURE, 1))
    return axes.T @ (axes / curvature[:, None])
