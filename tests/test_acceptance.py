"""The Husky's acceptance table row by row, and the wrong robots that must not pass it."""

import numpy as np
import pytest
from acceptance import Row, Subject, grounds
from acceptance.drives import drive, on_ground
from acceptance.terrain import chi_on
from husky import CONTROLS, MEASURES

from twin.robot import TRACK, HuskyParams

_TABLE = {f"{letter}{n + 1}" for letter, count in zip("ABCDE", (2, 8, 3, 6, 4), strict=True) for n in range(count)}


@pytest.mark.parametrize("key", MEASURES)
def test_each_quantity_of_the_husky_is_within_its_bounds(key):
    rows = MEASURES[key](Subject())
    assert {row.id for row in rows} == set(key.split())
    assert not [row for row in rows if not row.passed]


def test_no_row_is_left_out():
    assert {name for key in MEASURES for name in key.split()} >= _TABLE


@pytest.mark.parametrize("control", CONTROLS, ids=lambda control: control.name)
def test_each_wrong_robot_fails_its_rows(control):
    for key in control.fails:
        assert not all(row.passed for row in MEASURES[key](control.subject)), key


ALIGNED = Subject(
    HuskyParams(
        friction=0.25,
        spin_friction=0.02,
        slip_stiffness=0.025,
        ground_viscosity=4.0,
        separation_multiplier=1.4,
        max_yaw_rate=0.5,
        max_speed=0.4,
    )
)
"""Ground and controller as a log may show them."""


def test_ground_and_controller_of_the_given_robot_are_used():
    for model in (ALIGNED.plane(), on_ground(grounds.level(), ALIGNED.params)):
        assert (model.opt.impratio, model.opt.viscosity) == (0.025, 4.0)
    assert ALIGNED.turn(1.0).wheel_difference == pytest.approx(0.5 * 1.4 * TRACK, rel=0.02)
    assert ALIGNED.turn(1.0, separation_multiplier=1.2).wheel_difference == pytest.approx(0.5 * 1.2 * TRACK, rel=0.02)
    line = np.array([[-5.0, 0.0], [5.0, 0.0]])
    (row,) = chi_on(ALIGNED, grounds.level(), (0.0, 0.0, 0.0), line, "a level field")
    assert row.value == pytest.approx(ALIGNED.turn(1.0, seconds=2.0).chi, rel=0.03)
    assert row.value < drive(ALIGNED.plane(), 0.0, 1.0).chi - 0.05  # the published controller would turn it faster
    fastest = {r.quantity: r.value for r in MEASURES["D1 D2 D3 D5"](ALIGNED)}["fastest wheel"]
    assert fastest == pytest.approx(0.4, rel=0.02)


def test_nan_is_outside_every_bound():
    assert not Row("X", "", float("nan"), -1e9, 1e9).passed
    assert Row("X", "", 1.0, 1.0, 1.0).passed


def test_roughness_of_known_bumps():
    """Bumps of a Gaussian kernel σ have the autocorrelation exp(−d²/4σ²), which is 1/e at 2σ; removing the slow rise
    removes a little of them, too.
    """
    relief = grounds.random_relief(0.02, 0.2, np.random.default_rng(3), half=40.0)
    flat = grounds.level(half=39.0)
    x = flat.origin[0] + flat.cell * np.arange(len(flat.height))
    bumps = type(flat)(relief(np.stack(np.meshgrid(x, x), -1)), flat.origin, flat.cell, flat.measured, flat.rgb)
    values = [grounds.roughness(bumps, np.array([[-38.0, y], [38.0, y]])) for y in range(-30, 31, 3)]
    rms, length = np.mean(values, axis=0)
    assert rms == pytest.approx(0.02, rel=0.15) and length == pytest.approx(0.4, rel=0.15)


def test_reconstruction_removes_noise_and_keeps_relief():
    rng = np.random.default_rng(4)
    flat = grounds.reconstructed(rng)
    assert np.abs(flat.at(np.stack([np.linspace(-7, 7, 200), np.zeros(200)], 1))).max() < 0.02
    hill = grounds.reconstructed(rng, lambda xy: 0.1 * np.sin(xy[:, 0] / 2))
    x = np.linspace(-7, 7, 200)
    np.testing.assert_allclose(hill.at(np.stack([x, np.zeros(200)], 1)), 0.1 * np.sin(x / 2), atol=0.03)
