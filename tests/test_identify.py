"""Least squares that says how sure it is: textbook cases, and how far fits scatter."""

import numpy as np
import pytest

from twin.alignment.identify import Parameter, bend, fit


def test_bent_residuals_count_as_logarithms():
    error = np.random.default_rng(0).normal(size=(5, 2, 3)) * np.logspace(-6, 3, 5)[:, None, None]
    mean_square = (error**2).sum((1, 2)) / 2
    assert (bend(error) ** 2).sum((1, 2)) == pytest.approx(np.log1p(mean_square), rel=1e-6)


@pytest.mark.parametrize("guess", [None, 0.0])
def test_identified_are_what_residuals_move(guess):
    """A line through noise: slope and offset come out with their textbook errors; what does nothing is refused."""
    rng = np.random.default_rng(3)
    x = np.linspace(-1, 1, 400)
    y = 2.0 * x + 0.5 + rng.normal(0, 0.1, 400)
    table = [
        Parameter("slope", guess, 1.0, -10, 10, 1.0, ""),
        Parameter("offset", guess, 1.0, -10, 10, 0.0, ""),
        Parameter("nothing", guess, 1.0, -10, 10, 7.0, "m", "another log"),
    ]

    def error(v: dict[str, float]) -> np.ndarray:
        return (v["slope"] * x + v["offset"] + 0 * v["nothing"] - y)[:, None, None]

    found = fit(table, error, np.arange(400), {p.name: 0.0 for p in table})
    assert found.values["slope"] == pytest.approx(2.0, abs=0.03)
    for name, shown in {"slope": (x**2).sum(), "offset": 400}.items():
        prior = 0.0 if guess is None else 0.25
        assert found.errors[name] == pytest.approx(np.sqrt(0.1**2 * shown + prior**2) / (shown + prior), rel=0.2)
    assert found.values["nothing"] == 7.0
    assert "nothing = 7 m" in found.refused["nothing"]
    assert "another log" in found.refused["nothing"]


@pytest.mark.parametrize("noise", [0.1, 1.0, 2.0])
def test_errors_are_how_far_fits_scatter(noise):
    """However large residuals are beside a good model's miss, and though three windows in a row share some."""
    table = [Parameter(name, None, 2.0, -50, 50, 0.0, "") for name in "ab"]
    found, told = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        slopes = np.repeat(rng.normal(size=(150, 1, 3, 2)), 2, 1)
        off = rng.normal(size=(150, 3)) * 0.85 + np.repeat(rng.normal(size=(50, 3)), 3, 0) * 0.5
        off = np.repeat(noise * off[:, None], 2, 1)

        def error(values: dict[str, float], slopes=slopes, off=off) -> np.ndarray:
            return off + slopes @ np.array([values["a"], values["b"]])

        one = fit(table, error, np.arange(150) // 3, {"a": 0.2, "b": 0.2})
        found.append([one.values[name] for name in "ab"])
        told.append([one.errors[name] for name in "ab"])
    ratio = np.sqrt(np.square(found).mean() / np.square(told).mean())
    assert 0.8 < ratio < 1.25


def test_a_guess_weighs_as_much_as_a_log_that_is_as_unsure():
    """One that says 1 and has three times the weight of the guess that says 0."""
    table = [Parameter("a", 0.0, 1.0, -10, 10, 7.0, ""), Parameter("b", None, 1.0, -10, 10, 7.0, "")]
    shown = np.sqrt(0.75 / 100) * np.repeat(np.eye(2), 100, 0)
    found = fit(
        table, lambda v: (shown @ [v["a"] - 1, v["b"] - 1])[:, None, None], np.arange(200), {"a": 5.0, "b": 5.0}
    )
    assert found.values == pytest.approx({"a": 0.75, "b": 1.0}, abs=0.01)
    assert found.errors["a"] == pytest.approx(1 / 4, rel=0.02)


@pytest.mark.parametrize("guess", [None, 3.0])
def test_nothing_identified_is_a_fit_too(guess):
    table = [Parameter(name, guess, 1.0, -10, 10, 7.0, "") for name in ("a", "b")]
    noise = np.random.default_rng(0).normal(size=(50, 1, 1))
    found = fit(table, lambda v: noise + 0 * (v["a"] + v["b"]), np.arange(50), {"a": 3.0, "b": 3.0})
    assert found.values == {"a": 7.0, "b": 7.0}
    assert not found.errors and set(found.refused) == {"a", "b"}
    assert found.cost == pytest.approx(np.log1p(noise**2).mean())


@pytest.mark.parametrize("kept", [0, 1])
def test_parameters_may_go_one_by_one(kept):
    """Each shows only as long as the next one is not at its usual value, and the last one hardly shows."""
    rng = np.random.default_rng(1)
    names = list("abcdefg")
    x, noise = rng.normal(size=(7, 400)), 0.1 * rng.normal(size=400)
    table = [Parameter(name, 1.0, 1.0, -10, 10, 0.0, "") for name in names]

    def error(v: dict[str, float]) -> np.ndarray:
        shown = [*(float(v[after] != 0.0) for after in names[1:]), 0.005]
        shown[0] = shown[0] or float(kept)
        off = (np.array([v[name] for name in names]) - 1.0) * shown
        return (off @ x + noise)[:, None, None]

    found = fit(table, error, np.arange(400), dict.fromkeys(names, 1.0))
    assert set(found.errors) == set(names[:kept]) and set(found.refused) == set(names[kept:])
    if kept:
        assert found.values["a"] == pytest.approx(1.0, abs=0.03)
        assert found.errors["a"] == pytest.approx(np.sqrt(0.1**2 * 400 + 0.25**2) / 400.25, rel=0.2)


@pytest.mark.parametrize("guess", [None, 0.0])
def test_two_that_do_the_same_are_not_both_identified(guess):
    rng = np.random.default_rng(0)
    x, noise = rng.normal(size=200), 0.1 * rng.normal(size=200)
    table = [Parameter(name, guess, 1.0, -10, 10, 0.0, "") for name in ("a", "b")]
    begin = {"a": 0.0, "b": 0.0}
    found = fit(table, lambda v: ((v["a"] + v["b"] - 1.0) * x + noise)[:, None, None], np.arange(200), begin)
    assert len(found.errors) == 1
    assert sum(found.values.values()) == pytest.approx(1.0, abs=0.1)
