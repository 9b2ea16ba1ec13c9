"""Maximum a posteriori estimation: textbook cases, and standard errors against the scatter of fits."""

import numpy as np
import pytest
from scipy.stats import t

from twin.sysid.estimation import Fit, Parameter, fit_parameters, maximize_posterior

ONE = (0,)


@pytest.mark.parametrize("prior_mean", [None, 0.0])
def test_parameters_that_move_residuals_are_identified(prior_mean):
    """A line through noise: slope and offset have their textbook errors; a parameter without effect is refused.

    A t distribution's fit to normal noise scatters 8 % more than the textbook's.
    """
    rng = np.random.default_rng(3)
    x = np.linspace(-1, 1, 400)
    y = 2.0 * x + 0.5 + rng.normal(0, 0.1, 400)
    table = [
        Parameter("slope", prior_mean, 1.0, -10, 10, 1.0, ""),
        Parameter("offset", prior_mean, 1.0, -10, 10, 0.0, ""),
        Parameter("nothing", prior_mean, 1.0, -10, 10, 7.0, "m", "another log"),
    ]

    def residuals(v: dict[str, float]) -> np.ndarray:
        return (v["slope"] * x + v["offset"] + 0 * v["nothing"] - y)[:, None, None]

    found = fit_parameters(table, residuals, ONE, np.arange(400), {p.name: 0.0 for p in table})
    assert found.values["slope"] == pytest.approx(2.0, abs=0.03)
    for name, slopes in {"slope": (x**2).sum(), "offset": 400}.items():
        assert found.errors[name] == pytest.approx(1.08 * 0.1 / np.sqrt(slopes), rel=0.1)
    assert found.values["nothing"] == 7.0
    assert "nothing = 7 m" in found.refused["nothing"]
    assert "another log" in found.refused["nothing"]


@pytest.mark.parametrize(("noise", "freedom"), [(0.02, np.inf), (1.0, np.inf), (50.0, np.inf), (1.0, 3), (1.0, 1)])
def test_standard_errors_are_the_scatter_of_fits(noise, freedom):
    """For residuals of any scale and tail; groups of three windows are correlated, and the last component is larger."""
    table = [Parameter(name, None, 2.0 * noise, -50 * noise, 50 * noise, 0.0, "") for name in "ab"]
    found, errors = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        sizes = np.array([1.0, 1.0, 100.0])
        slopes = np.repeat(rng.normal(size=(150, 1, 3, 2)), 2, 1) * sizes[:, None]
        off = rng.normal(size=(150, 3)) * 0.85 + np.repeat(rng.normal(size=(50, 3)), 3, 0) * 0.5
        off = np.repeat(noise * off[:, None], 2, 1) * sizes
        if freedom < np.inf:
            off /= np.sqrt(rng.chisquare(freedom, (150, 1, 1)) / freedom)

        def residuals(values: dict[str, float], slopes=slopes, off=off) -> np.ndarray:
            return off + slopes @ np.array([values["a"], values["b"]])

        one = fit_parameters(table, residuals, (0, 0, 1), np.arange(150) // 3, {"a": 0.2 * noise, "b": 0.2 * noise})
        found.append([one.values[name] for name in "ab"])
        errors.append([one.errors[name] for name in "ab"])
    ratio = np.sqrt(np.square(found).mean() / np.square(errors).mean())
    assert 0.8 < ratio < 1.25


def slope_through(y: np.ndarray, x: np.ndarray, groups: np.ndarray, instants: int = 1) -> Fit:
    """Slope of a line through values repeated at several instants."""

    def residuals(v: dict[str, float]) -> np.ndarray:
        return np.repeat((v["slope"] * x - y)[:, None, None], instants, 1)

    return fit_parameters([Parameter("slope", None, 1.0, -10, 10, 1.0, "")], residuals, ONE, groups, {"slope": 0.0})


@pytest.mark.parametrize("instants", [1, 40])
def test_few_groups_do_not_shrink_standard_errors(instants):
    """The scores of two groups may cancel by chance; the scatter of windows then gives the standard errors."""
    x = np.linspace(-1, 1, 200)
    for seed in range(20):
        y = 2.0 * x + np.random.default_rng(seed).normal(0, 0.1, 200)
        found = slope_through(y, x, np.arange(200) % 2, instants)
        assert found.errors["slope"] > 0.9 * 0.1 / np.linalg.norm(x)


def test_few_groups_lose_one_degree_of_freedom():
    """Windows of a group have equal residuals: the variance of a mean of G groups is Σ off² / (G (G − 1)). The same
    groups eight times over have the same mean and scales, so the ratio of errors shows the denominator."""
    off = np.repeat([0.18, -0.22, 0.1, -0.06], 50)
    x = np.ones(len(off))
    few, many = (slope_through(2.0 + np.tile(off, k), np.tile(x, k), np.repeat(np.arange(4 * k), 50)) for k in (1, 8))
    assert few.values["slope"] == pytest.approx(many.values["slope"], abs=1e-3)
    assert few.errors["slope"] / many.errors["slope"] == pytest.approx(np.sqrt((4 * 8 - 1) / (4 - 1)), rel=0.02)


def test_standard_errors_with_large_residuals_at_high_leverage():
    """A fifth of the windows is stuck, with five times the leverage."""
    found, errors = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        stuck = np.arange(300) % 5 == 0
        x = np.where(stuck, 5.0, 1.0) * rng.normal(size=300)
        one = slope_through(2.0 * x + np.where(stuck, 5.0, 0.5) * rng.normal(size=300), x, np.arange(300))
        found.append(one.values["slope"] - 2.0)
        errors.append(one.errors["slope"])
    assert 0.75 < np.sqrt(np.square(found).mean() / np.square(errors).mean()) < 1.25


def test_windows_that_disagree_determine_their_mean():
    """Half of the windows prefer −1 and half +1. In between, a pair of windows has the loss log(1 + t⁴ / 4), flat at 0
    but steep beyond. The error is the shift t at which its gradient is the standard error √n / 2 of the score.
    """
    off = np.tile([-1.0, 1.0], 50)[:, None, None] * np.ones(3)
    table = [Parameter("t", None, 1.4, -10, 10, 5.0, "")]
    found = fit_parameters(table, lambda v: v["t"] - off, (0, 0, 0), np.arange(100), {"t": 0.0})
    assert not found.refused
    assert found.values["t"] == pytest.approx(0.0, abs=0.01)
    t = found.errors["t"]
    assert 100 / 4 * t**3 / (1 + t**4 / 4) == pytest.approx(np.sqrt(100) / 2, rel=0.03)


def test_outliers_do_not_decide_a_distant_start():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200, 1, 1))
    noise = 0.01 * rng.normal(size=(200, 1, 1))
    noise[::8] = -40.0
    table = [Parameter("a", None, 1.0, -1e3, 1e3, 0.0, "")]
    found = fit_parameters(table, lambda v: (v["a"] - 3.0) * x + noise, ONE, np.arange(200), {"a": 600.0})
    assert found.values["a"] == pytest.approx(3.0, abs=0.005)


def test_no_values_are_evaluated_twice():
    rng = np.random.default_rng(0)
    x, noise = rng.normal(size=(2, 100)), rng.normal(size=100)
    evaluated = []

    def residuals(v: dict[str, float]) -> np.ndarray:
        evaluated.append((v["a"], v["b"]))
        return (x[0] * v["a"] + x[1] * v["b"] - noise)[:, None, None]

    table = [Parameter(name, 0.0, 1.0, -10, 10, 0.0, "") for name in "ab"]
    fit_parameters(table, residuals, ONE, np.arange(100), {"a": 1.0, "b": 1.0})
    assert len(set(evaluated)) == len(evaluated) > 6


@pytest.mark.parametrize("reach", [0.01, 1.0])
def test_reach_is_the_scale_of_the_first_step(reach):
    x = np.random.default_rng(0).normal(size=(100, 1, 1))
    evaluated: list[float] = []

    def residuals(v: dict[str, float]) -> np.ndarray:
        evaluated.append(v["a"])
        return (v["a"] - 500.0) * x + 0.1 * x**2

    maximize_posterior([Parameter("a", None, 1.0, -1e3, 1e3, 0.0, "")], residuals, ONE, {"a": 0.0}, reach)
    assert evaluated[2] == pytest.approx(reach * np.sqrt(1e3 / reach), rel=0.1)  # after the start and its Jacobian


def test_a_prior_weighs_as_much_as_data_of_its_variance():
    """A prior of mean 0 and data of value 1 with eight times its weight."""
    table = [Parameter("a", 0.0, 1.0, -10, 10, 7.0, ""), Parameter("b", None, 1.0, -10, 10, 7.0, "")]
    count = 1000
    noise = np.tile(t(3).ppf((np.arange(count) + 0.5) / count), 2)
    slopes = np.sqrt(8 / (2 / 3 * count)) * np.repeat(
        np.eye(2), count, 0
    )  # information of t with ν = 3: 2 / 3 per value

    def residuals(v: dict[str, float]) -> np.ndarray:
        return (slopes @ [v["a"] - 1, v["b"] - 1] + noise)[:, None, None]

    found = fit_parameters(table, residuals, ONE, np.arange(2 * count), {"a": 5.0, "b": 5.0})
    assert found.values == pytest.approx({"a": 8 / 9, "b": 1.0}, abs=0.01)
    assert found.errors["a"] == pytest.approx(1 / 3, rel=0.05)


@pytest.mark.parametrize("prior_mean", [None, 3.0])
def test_a_fit_without_identified_parameters(prior_mean):
    table = [Parameter(name, prior_mean, 1.0, -10, 10, 7.0, "") for name in ("a", "b")]
    noise = np.random.default_rng(0).normal(size=(50, 1, 1))
    found = fit_parameters(table, lambda v: noise + 0 * (v["a"] + v["b"]), ONE, np.arange(50), {"a": 3.0, "b": 3.0})
    assert found.values == {"a": 7.0, "b": 7.0}
    assert not found.errors and set(found.refused) == {"a", "b"}


@pytest.mark.parametrize("kept", [0, 1])
def test_parameters_are_dropped_one_by_one(kept):
    """Each has an effect only while the next one is not at its default; the last one has nearly none."""
    rng = np.random.default_rng(1)
    names = list("abcdefg")
    x, noise = rng.normal(size=(7, 400)), 0.1 * rng.normal(size=400)
    table = [Parameter(name, 1.0, 1.0, -10, 10, 0.0, "") for name in names]

    def residuals(v: dict[str, float]) -> np.ndarray:
        slopes = [*(float(v[after] != 0.0) for after in names[1:]), 0.005]
        slopes[0] = slopes[0] or float(kept)
        off = (np.array([v[name] for name in names]) - 1.0) * slopes
        return (off @ x + noise)[:, None, None]

    found = fit_parameters(table, residuals, ONE, np.arange(400), dict.fromkeys(names, 1.0))
    assert set(found.errors) == set(names[:kept]) and set(found.refused) == set(names[kept:])
    if kept:
        assert found.values["a"] == pytest.approx(1.0, abs=0.03)
        assert found.errors["a"] == pytest.approx(0.1 / np.linalg.norm(x[0]), rel=0.2)


@pytest.mark.parametrize("prior_mean", [None, 0.0])
def test_of_two_parameters_of_equal_effect_one_is_identified(prior_mean):
    rng = np.random.default_rng(0)
    x, noise = rng.normal(size=200), 0.1 * rng.normal(size=200)
    table = [Parameter(name, prior_mean, 1.0, -10, 10, 0.0, "") for name in ("a", "b")]
    begin = {"a": 0.0, "b": 0.0}

    def residuals(v: dict[str, float]) -> np.ndarray:
        return ((v["a"] + v["b"] - 1.0) * x + noise)[:, None, None]

    found = fit_parameters(table, residuals, ONE, np.arange(200), begin)
    assert len(found.errors) == 1
    assert sum(found.values.values()) == pytest.approx(1.0, abs=0.1)
