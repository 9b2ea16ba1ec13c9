"""Misses of heavy tails: Student's t of three degrees of freedom, of scales that the misses themselves tell.

A robot that is stuck for two seconds misses its model by a hundred times what it usually does; squares would have such
windows decide a fit. So *misses*, predicted minus measured, of a window are taken to be of a multivariate t (Lange,
Little and Taylor 1989), whose −2 log likelihood for c components of scale σ is, but for a constant,

    2 Σ log σ + (ν + c) log(1 + s),    s = Σ (miss / σ)² / ν    (the mean over the instants that are looked at)

with ν = `FREEDOM`; where ν was left to a log as well, DRIVE's, it came to 2.6 to 3.2. The instants of a window count as
one. Components of one *kind*, such as x and y, share their scale. Nobody knows beforehand how well a model can do on
some ground, so scales are the likeliest for the misses there are; they and the model are found in turns, which makes
both likelier every time. *Scaled* misses are in units of σ √ν; *bent*, the squares of a window's sum to log(1 + s), as
least-squares solvers would have it.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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


def unlikelihood(misses: Array, kinds: Kinds) -> float:
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


def bent(scaled: Array) -> Array:
    """Scaled misses (n, looks, c), times what makes the squares of a window sum to log(1 + s)."""
    return scaled * _per_window(_bend(_size(scaled)) / np.sqrt(scaled.shape[1]), scaled)


def bent_slopes(scaled: Array, slopes: Array) -> Array:
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
