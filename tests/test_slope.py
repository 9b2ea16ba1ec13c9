"""Initial conditions of a log's windows: the slope estimated from accelerations, and the wheels' preceding motion."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from drive_logs import SOFT, windows_of
from scipy.stats import multivariate_normal

from twin import runtime
from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.sysid import drivetrain, kinematics, logs, rollout, tires


def test_slope_is_found_from_accelerations():
    """On a slope, gravity rotates in the frame of a turning robot, unlike a constant error of the IMU."""
    n, truth = 72, np.array([0.5, -0.3])
    rate = np.linspace(0.8, 1.2, n) * 4 * np.pi / (n * logs.DURATION)  # headings all around, twice
    wheels = np.repeat((rate[:, None] * [-1, 1] * TRACK / 2 / WHEEL_RADIUS)[:, None], logs.SAMPLES, 1)
    windows = windows_of(wheels)
    yaw = kinematics.predict(kinematics.NOMINAL, windows)[:, : logs.SAMPLES, 2]
    turn = kinematics.predict(kinematics.NOMINAL, windows)[:, logs.SAMPLES, 2]
    start = np.concatenate([[-turn[0]], [0.0], np.cumsum(turn[:-1])])
    down = (truth[0] + 1j * truth[1]) * np.exp(-1j * (start[1:, None] + yaw))
    acceleration = -np.stack([down.real, down.imag], -1) + [0.4, -0.2]
    windows = replace(windows, follows=np.arange(n) > 0)
    found = rollout.slope_gravity(replace(windows, acceleration=acceleration), kinematics.NOMINAL)
    expected = (truth[0] + 1j * truth[1]) * np.exp(-1j * start[:-1])  # as it stood where the window before began
    assert found[:, 0] + 1j * found[:, 1] == pytest.approx(expected, abs=0.1)
    assert not rollout.slope_gravity(windows, kinematics.NOMINAL).any()


CHAINS = np.array([False, True, True, True, False, False, True, True])
"""Which of eight windows follow the one before."""


def test_one_slope_seen_from_four_headings_is_one_slope():
    turn = np.array([0.3, -0.7, 1.1, 0.2])
    heading = np.concatenate([[0.0], np.cumsum(turn)[:-1]])
    vector = 0.8 * np.exp(1j * (0.4 - heading))
    lasting = rollout.SlopeModel(1.0, 1e9, 0.5)
    found, _ = rollout.smooth_slopes(lasting, vector, turn, CHAINS[:4])
    assert found == pytest.approx(vector * 1.0 / (1.0 + 0.25 / 4))  # four readings of variance 0.25 against 1


def test_slopes_are_the_gaussian_posterior():
    """The smoother and its likelihood equal those of one joint normal distribution."""
    rng = np.random.default_rng(0)
    readings = rng.normal(size=8) + 1j * rng.normal(size=8)
    turn = rng.uniform(-2, 2, 8)
    terrain = rollout.SlopeModel(0.7, 3.0, 0.4)
    found, cost = rollout.smooth_slopes(terrain, readings, turn, CHAINS)
    chain = np.cumsum(~CHAINS)
    heading = np.array([turn[np.flatnonzero(chain[:i] == chain[i])].sum() for i in range(8)])
    apart = np.abs(np.arange(8)[:, None] - np.arange(8))
    prior = 0.7**2 * np.exp(-apart / 3.0) * (chain[:, None] == chain)
    spread = prior + 0.4**2 * np.eye(8)
    world = readings * np.exp(1j * heading)
    assert found == pytest.approx(prior @ np.linalg.solve(spread, world) * np.exp(-1j * heading))
    normal = multivariate_normal(np.zeros(8), spread)
    assert cost == pytest.approx(-normal.logpdf(world.real) - normal.logpdf(world.imag))


@pytest.mark.parametrize("truth", [rollout.SlopeModel(0.3, 12.0, 0.2), rollout.SlopeModel(0.2, 6.0, 0.5)])
def test_the_noise_of_ground_and_imu_is_estimated(truth):
    rng = np.random.default_rng(1)
    n, keep = 600, np.exp(-1 / truth.windows)
    turn, follows = rng.uniform(-1.5, 1.5, n), np.arange(n) % 50 > 0
    slopes = np.zeros(n, complex)
    for i in range(n):
        new = truth.steepness * (rng.normal() + 1j * rng.normal())
        slopes[i] = keep * slopes[i - 1] * np.exp(-1j * turn[i - 1]) + np.sqrt(1 - keep**2) * new if follows[i] else new
    readings = slopes + truth.noise * (rng.normal(size=n) + 1j * rng.normal(size=n))
    found = rollout.fit_slope_model(readings, turn, follows)
    assert found.steepness == pytest.approx(truth.steepness, rel=0.3)
    assert found.noise == pytest.approx(truth.noise, rel=0.1)
    assert found.windows == pytest.approx(truth.windows, rel=0.5)
    smoothed, _ = rollout.smooth_slopes(found, readings, turn, follows)
    assert np.abs(smoothed - slopes).mean() < 0.7 * np.abs(readings - slopes).mean()


def test_preceding_wheel_speeds_are_those_of_the_window_before():
    wheels = np.arange(3 * logs.SAMPLES * 2, dtype=float).reshape(3, logs.SAMPLES, 2)
    before = replace(windows_of(wheels), follows=np.array([False, True, False])).preceding_wheels
    np.testing.assert_array_equal(before[1], np.concatenate([wheels[0], wheels[1, :1]]))
    for i in (0, 2):
        np.testing.assert_array_equal(before[i], np.repeat(wheels[i, :1], logs.SAMPLES + 1, 0))


def test_an_outlying_reading_affects_no_other():
    rng = np.random.default_rng(3)
    n = 60
    windows = replace(windows_of(np.full((n, logs.SAMPLES, 2), [2.0, 3.0])), follows=np.arange(n) > 0)
    acceleration = rng.normal(0, 0.3, (n, logs.SAMPLES, 2))
    acceleration += rng.normal(0, 0.3, (n, 1, 2))
    plain = rollout.slope_gravity(replace(windows, acceleration=acceleration), kinematics.NOMINAL)
    acceleration[30] = 500.0
    struck = rollout.slope_gravity(replace(windows, acceleration=acceleration), kinematics.NOMINAL)
    assert np.hypot(*struck.T).max() < rollout.MAX_SLOPE * rollout.GRAVITY
    assert np.abs(struck - plain)[np.abs(np.arange(n) - 30) > 10].max() < 0.15


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_readings_without_noise_are_kept(value):
    n = 400
    wheels = np.full((n, logs.SAMPLES, 2), 3.0)
    windows = replace(windows_of(wheels), follows=np.arange(n) > 0, acceleration=np.full_like(wheels, value))
    assert not rollout.slope_gravity(windows, kinematics.NOMINAL).any()
    turn, readings = np.full(n, 0.3), 0.7 * np.exp(-0.3j * np.arange(n))
    for exact in (readings, 0 * readings):
        found, _ = rollout.smooth_slopes(
            rollout.fit_slope_model(exact, turn, windows.follows), exact, turn, windows.follows
        )
        assert found == pytest.approx(exact, abs=0.02)


def test_wheels_continue_their_preceding_motion():
    """This holds for a lagging servo, too; after time zero the wheels follow the commands."""
    params = replace(SOFT, servo_lag=0.2)
    count = logs.SAMPLES + 1
    before = np.stack([np.linspace(6.0, -2.0, count), 1.0 + np.sin(np.arange(count) / 4)], -1)[None]
    commands = np.full((1, 225, 2), 2.0)
    model = rollout.plane_model(params)
    lead = rollout._lag_compensated(before, round(logs.PERIOD / model.opt.timestep), params.servo_lag)
    data = mujoco.MjData(model)
    states, joints = rollout._initial_states(model, params, before[:, 0])
    mujoco.mj_setState(model, data, states[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    done = []
    for row in lead[0]:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        done.append(data.qvel[joints[[0, 1]]].copy())
    assert np.abs(np.array(done)[24::25] - before[0, 1:]).max() < 0.05
    level = np.zeros((1, 2))
    out = rollout.simulate_windows(params, commands, before, level)
    assert out.wheels[0, 0] == pytest.approx(before[0, -1], abs=0.05)
    assert out.wheels[0, -1] == pytest.approx([2.0, 2.0], abs=0.05)
    # The body moves as it had come to, in the samples before time starts as well.
    held = rollout.simulate_windows(params, commands, np.repeat(before[:, -1:], count, 1), level)
    early = [np.diff(o.poses[0, : rollout.LEAD_SAMPLES + 1, 2]) / logs.PERIOD for o in (out, held)]
    assert np.abs(early[0] - early[1]).max() > 0.05


def test_the_fit_begins_each_window_as_the_log_does(monkeypatch):
    """Also for windows that are fitted and follow windows that are not."""
    rng = np.random.default_rng(0)
    n = 12
    wheels = np.repeat(rng.uniform(-3, 3, (n, 1, 2)), logs.SAMPLES, 1)
    windows = replace(windows_of(wheels), follows=np.arange(n) > 0)
    seen = []

    def noted(params, commands, before, slope, timestep=None):
        seen.append(before)
        k = logs.SAMPLES + drivetrain.EXTRA_SAMPLES
        shapes = (rollout.LEAD_SAMPLES + k, 3), (k, 2), (k - 1, 2)
        return rollout.Rollouts(*(np.zeros((len(commands), *shape)) for shape in shapes))

    monkeypatch.setattr(tires, "simulate_windows", noted)
    made, bar = [], runtime.bar
    monkeypatch.setattr(runtime, "bar", lambda *given: made.append(bar(*given)) or made[-1])
    params = HuskyParams()
    tires.fit_ground(params, drivetrain.Drivetrain.from_robot(params, False), windows, np.zeros((n, 2)))
    # Each step of the two searches has a bar with an estimate of the time left.
    assert [one.desc.strip() for one in made] == ["coarse search", "final fit"] and all(one.total for one in made)
    assert seen and sum(one.n for one in made) == len(seen)
    for before in seen:
        np.testing.assert_array_equal(before, windows.preceding_wheels[::2])


def test_a_slope_pulls_downhill():
    """A robot that turns by scrubbing creeps down the slope that its accelerometer measures, before and in a window,
    for any initial heading.
    """
    n = 12
    wheels = np.full((n, logs.SAMPLES, 2), [-3.0, 3.0])
    turning = kinematics.IcrModel(y_left=0.56, y_right=-0.56)  # as SOFT turns
    windows = replace(windows_of(wheels), follows=np.arange(n) > 0)
    poses = kinematics.predict(turning, windows)
    start = np.concatenate([[0.0], np.cumsum(poses[:-1, logs.SAMPLES, 2])])
    downhill = np.exp(1j * (0.8 - start))  # in each window's first frame
    down = downhill[:, None] * np.exp(-1j * poses[:, : logs.SAMPLES, 2])
    slopes = rollout.slope_gravity(replace(windows, acceleration=-np.stack([down.real, down.imag], -1)), turning)
    assert np.hypot(*slopes.T) == pytest.approx(np.ones(n), abs=0.1)
    commands = np.full((n, 225, 2), [-3.0, 3.0])
    driven = [
        tires.simulate_windows(SOFT, commands, windows.preceding_wheels, s, 0.005).poses for s in (0 * slopes, slopes)
    ]
    still, moved = (logs.resample_poses(poses, np.zeros(n), rollout.LEAD_SAMPLES) for poses in driven)
    shift = (moved - still)[:, -1, :2] @ [1, 1j]
    assert np.abs(np.angle(shift / downhill)).max() < np.radians(20)
    assert np.abs(shift).min() > 0.05
