"""Heavy-tailed residuals: their scales, their weights, and models fitted with them."""

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


def student(scales: tuple[float, ...], count: int, seed: int = 0) -> np.ndarray:
    """Residuals (count, 1, c) from a t distribution of these scales."""
    shape = np.diag(np.square(scales))
    return multivariate_t(shape=shape, df=DEGREES_OF_FREEDOM, seed=seed).rvs(count).reshape(count, 1, -1)


def test_scales_are_those_of_the_distribution():
    found = residual_scale(student((0.06, 0.06, 0.1), 20_000), POSE)
    assert found == pytest.approx(np.sqrt(DEGREES_OF_FREEDOM) * np.array([0.06, 0.06, 0.1]), rel=0.02)


def test_instants_of_a_window_are_averaged():
    residuals = student((0.06, 0.06, 0.1), 100)
    assert residual_scale(np.repeat(residuals, 3, 1), POSE) == pytest.approx(residual_scale(residuals, POSE))
    assert negative_log_likelihood(np.repeat(residuals, 3, 1), POSE) == pytest.approx(
        negative_log_likelihood(residuals, POSE)
    )


def test_no_other_scales_are_likelier():
    """The likelihood is SciPy's, which differs by a constant."""
    residuals = student((0.02, 0.02, 0.3), 300)

    def cost(position: float, yaw: float, some: np.ndarray) -> float:
        shape = np.diag(np.square([position, position, yaw]) / DEGREES_OF_FREEDOM)
        return -multivariate_t(shape=shape, df=DEGREES_OF_FREEDOM).logpdf(some[:, 0]).mean()

    _, position, yaw = residual_scale(residuals, POSE)
    least = cost(position, yaw, residuals)
    for k, m in ((0.97, 1), (1.03, 1), (1, 0.97), (1, 1.03)):
        assert cost(k * position, m * yaw, residuals) > least
    for other in (3 * residuals, residuals**3 * 1e4):
        _, position, yaw = residual_scale(other, POSE)
        more = cost(position, yaw, other) - least
        assert negative_log_likelihood(other, POSE) - negative_log_likelihood(residuals, POSE) == pytest.approx(more)


def test_scales_resist_outliers():
    residuals = student((0.05, 0.05, 0.1), 500)
    usual = residual_scale(residuals, POSE)
    residuals[::25] = 1e4
    assert residual_scale(residuals, POSE) == pytest.approx(usual, rel=0.2)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_residuals_of_zero_have_a_scale(share):
    residuals = np.zeros((100, 2, 3))
    residuals[: round(share * 100)] = 0.7
    assert residual_scale(residuals, POSE) == pytest.approx(np.full(3, 1e-3 * np.sqrt(DEGREES_OF_FREEDOM)))


def test_squares_of_the_robust_loss_are_logarithms():
    scaled = np.random.default_rng(0).normal(size=(5, 2, 3)) * np.logspace(-6, 3, 5)[:, None, None]
    assert (robust_loss(scaled) ** 2).sum((1, 2)) == pytest.approx(np.log1p((scaled**2).sum((1, 2)) / 2), rel=1e-6)


def test_the_robust_jacobian_gives_exact_gradients():
    rng = np.random.default_rng(1)
    at, slopes = rng.normal(size=(20, 2, 3)), rng.normal(size=(20, 2, 3, 4))
    gradient = robust_jacobian(at, slopes).reshape(-1, 4).T @ robust_loss(at).ravel()

    def half(x: np.ndarray) -> float:
        return (robust_loss(at + slopes @ x) ** 2).sum() / 2

    steps = 1e-6 * np.eye(4)
    assert gradient == pytest.approx([(half(step) - half(-step)) / 2e-6 for step in steps], rel=1e-6)


@pytest.mark.parametrize("noise", [0.01, 1.0, 30.0])
def test_model_and_scales_are_found_in_alternation(noise):
    """The start is far away, the unit arbitrary, and a tenth of the residuals are outliers."""
    residuals = noise * student((1.0,), 300)
    residuals[::10] = -80.0 * noise
    found = fit_with_scales(
        np.array([500.0 * noise]),
        lambda x: residuals + x,
        (0,),
        lambda x, scale: least_squares(lambda x: robust_loss((residuals + x) / scale).ravel(), x).x,
    )
    assert found == pytest.approx(0.0, abs=0.2 * noise)
