"""Misses of heavy tails: scales, what they weigh, and models found with them."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import multivariate_t

from twin.sysid.estimation import (
    DEGREES_OF_FREEDOM,
    fit_with_scales,
    negative_log_likelihood,
    residual_scale,
    robust_jacobian,
    robust_loss,
)

POSE = (0, 0, 1)


def drawn(scales: tuple[float, ...], count: int, seed: int = 0) -> np.ndarray:
    """Misses (count, 1, c) of a t distribution of these scales."""
    shape = np.diag(np.square(scales))
    return multivariate_t(shape=shape, df=DEGREES_OF_FREEDOM, seed=seed).rvs(count).reshape(count, 1, -1)


def test_scales_are_those_of_the_distribution():
    found = residual_scale(drawn((0.06, 0.06, 0.1), 20_000), POSE)
    assert found == pytest.approx(np.sqrt(DEGREES_OF_FREEDOM) * np.array([0.06, 0.06, 0.1]), rel=0.02)


def test_looks_of_a_window_count_as_one():
    misses = drawn((0.06, 0.06, 0.1), 100)
    assert residual_scale(np.repeat(misses, 3, 1), POSE) == pytest.approx(residual_scale(misses, POSE))
    assert negative_log_likelihood(np.repeat(misses, 3, 1), POSE) == pytest.approx(
        negative_log_likelihood(misses, POSE)
    )


def test_no_other_scales_are_likelier():
    """The likelihood by SciPy's own distribution, which unlikelihood is minus of, but for a constant."""
    misses = drawn((0.02, 0.02, 0.3), 300)

    def unlikely(position: float, yaw: float, some: np.ndarray) -> float:
        shape = np.diag(np.square([position, position, yaw]) / DEGREES_OF_FREEDOM)
        return -multivariate_t(shape=shape, df=DEGREES_OF_FREEDOM).logpdf(some[:, 0]).mean()

    _, position, yaw = residual_scale(misses, POSE)
    least = unlikely(position, yaw, misses)
    for k, m in ((0.97, 1), (1.03, 1), (1, 0.97), (1, 1.03)):
        assert unlikely(k * position, m * yaw, misses) > least
    for other in (3 * misses, misses**3 * 1e4):
        _, position, yaw = residual_scale(other, POSE)
        more = unlikely(position, yaw, other) - least
        assert negative_log_likelihood(other, POSE) - negative_log_likelihood(misses, POSE) == pytest.approx(more)


def test_scales_hardly_care_for_impossible_windows():
    misses = drawn((0.05, 0.05, 0.1), 500)
    usual = residual_scale(misses, POSE)
    misses[::25] = 1e4
    assert residual_scale(misses, POSE) == pytest.approx(usual, rel=0.2)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_misses_without_noise_have_a_scale(share):
    misses = np.zeros((100, 2, 3))
    misses[: round(share * 100)] = 0.7
    assert residual_scale(misses, POSE) == pytest.approx(np.full(3, 1e-3 * np.sqrt(DEGREES_OF_FREEDOM)))


def test_bent_misses_count_as_logarithms():
    scaled = np.random.default_rng(0).normal(size=(5, 2, 3)) * np.logspace(-6, 3, 5)[:, None, None]
    assert (robust_loss(scaled) ** 2).sum((1, 2)) == pytest.approx(np.log1p((scaled**2).sum((1, 2)) / 2), rel=1e-6)


def test_gradients_by_bent_slopes_are_exact():
    rng = np.random.default_rng(1)
    at, slopes = rng.normal(size=(20, 2, 3)), rng.normal(size=(20, 2, 3, 4))
    gradient = robust_jacobian(at, slopes).reshape(-1, 4).T @ robust_loss(at).ravel()

    def half(x: np.ndarray) -> float:
        return (robust_loss(at + slopes @ x) ** 2).sum() / 2

    steps = 1e-6 * np.eye(4)
    assert gradient == pytest.approx([(half(step) - half(-step)) / 2e-6 for step in steps], rel=1e-6)


@pytest.mark.parametrize("noise", [0.01, 1.0, 30.0])
def test_model_and_scales_are_found_in_turns(noise):
    """From far away, in any unit, with a tenth of the windows impossible."""
    misses = noise * drawn((1.0,), 300)
    misses[::10] = -80.0 * noise
    found = fit_with_scales(
        np.array([500.0 * noise]),
        lambda x: misses + x,
        (0,),
        lambda x, scale: least_squares(lambda x: robust_loss((misses + x) / scale).ravel(), x).x,
    )
    assert found == pytest.approx(0.0, abs=0.2 * noise)
