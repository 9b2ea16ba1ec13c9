"""The wheel controller against what its limits say in closed form."""

import numpy as np
import pytest

from twin.env.controller import CONTROL_PERIOD, Controller, limit_command, wheel_speeds
from twin.errors import InputError
from twin.robot import CONTROLLERS, TRACK, WHEEL_RADIUS, HuskyParams

_PARAMS = HuskyParams()


def carried_out(wheels: np.ndarray) -> np.ndarray:
    """The speed and yaw rate (2,) that the controller seeks by these wheel speeds (2,), if no wheel is at its limit."""
    left, right = wheels * WHEEL_RADIUS
    return np.array([(left + right) / 2, (right - left) / (_PARAMS.separation_multiplier * TRACK)])


def drive(controller: Controller, command: tuple[float, float], steps: int) -> np.ndarray:
    """Gives a command every 0.1 s; returns the carried out speeds and yaw rates, shape (steps, 2)."""
    out = []
    for time in np.arange(steps) * CONTROL_PERIOD:
        controller.command(time, *command)
        out.append(carried_out(controller.update(time + controller.phase)))
    return np.array(out)


def test_commands_stay_within_the_limits_of_speed_and_acceleration():
    assert limit_command(np.array([5.0, -9.0]), np.array([1.0, -2.0]), _PARAMS).tolist() == [1.0, -2.0]
    np.testing.assert_allclose(limit_command(np.array([1.0, 2.0]), np.zeros(2), _PARAMS), [0.3, 0.6])
    slow = HuskyParams(max_speed=0.5, max_acceleration=1.0)
    np.testing.assert_allclose(limit_command(np.array([1.0, 0.0]), np.array([0.45, 0.0]), slow), [0.5, 0.0])
    np.testing.assert_allclose(limit_command(np.array([1.0, 0.0]), np.zeros(2), slow), [0.1, 0.0])


def test_a_step_command_is_a_ramp():
    fast, spot = HuskyParams(max_wheel_speed=3.0), (0.0, 2.0)
    np.testing.assert_allclose(drive(Controller(), (1.0, 0.0), 6)[:, 0], [0.3, 0.6, 0.9, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(drive(Controller(fast), spot, 6)[:, 1], [0.6, 1.2, 1.8, 2.0, 2.0, 2.0])


def test_sides_differ_by_the_multiplied_track():
    left, right = wheel_speeds(np.array([0.2, 0.3]), _PARAMS) * WHEEL_RADIUS
    assert (left + right) / 2 == pytest.approx(0.2)
    assert right - left == pytest.approx(0.3 * 1.875 * TRACK)


def test_both_sides_are_scaled_down_alike():
    fast = wheel_speeds(np.array([1.0, 1.0]), _PARAMS) * WHEEL_RADIUS
    assert np.abs(fast).max() == pytest.approx(1.0)
    slow = wheel_speeds(np.array([0.1, 0.1]), _PARAMS) * WHEEL_RADIUS
    np.testing.assert_allclose(fast / fast.max(), slow / slow.max())  # the curve stays the same
    # On the spot the controller believes in no more than 1.87 rad/s.
    left, right = wheel_speeds(np.array([0.0, 2.0]), _PARAMS) * WHEEL_RADIUS
    assert (right - left) / (1.875 * TRACK) == pytest.approx(2 / (1.875 * TRACK)) == pytest.approx(1.87, abs=0.01)


def test_a_command_expires_after_a_quarter_second():
    controller = Controller()
    controller.command(0.0, 0.3, 0.0)
    speeds = [carried_out(controller.update(time))[0] for time in (0.0, 0.1, 0.2, 0.3, 0.4)]
    assert speeds == pytest.approx([0.3, 0.3, 0.3, 0.0, 0.0])


@pytest.mark.parametrize("name", CONTROLLERS)
def test_presets_differ_in_rate_and_time_out_only(name):
    """The acceleration is the same, in finer steps; a command expires after the preset's time-out, not before."""
    timing, params = CONTROLLERS[name], HuskyParams(controller=name)
    controller = Controller(params)
    controller.command(0.0, 1.0, 0.0)
    speeds = [carried_out(controller.update(k * timing.period))[0] for k in range(round(0.8 / timing.period))]
    lapses = int(np.ceil(timing.timeout / timing.period - 1e-9))
    step = params.max_acceleration * timing.period
    up = np.minimum(1.0, step * np.arange(1, lapses + 1))
    down = np.maximum(0.0, up[-1] - step * np.arange(1, len(speeds) - lapses + 1))
    np.testing.assert_allclose(speeds, [*up, *down], atol=1e-12)


def test_the_published_presets():
    """Clearpath's: ROS 1 10 Hz and 0.25 s, by default; ROS 2 20 or 50 Hz and 0.5 s."""
    assert HuskyParams().timing == CONTROLLERS["ros1"]
    found = {name: (round(1.0 / timing.period, 9), timing.timeout) for name, timing in CONTROLLERS.items()}
    assert found == {"ros1": (10.0, 0.25), "ros2": (20.0, 0.5), "ros2_50hz": (50.0, 0.5)}
    with pytest.raises(InputError, match="controller = 'ros3'; expected ros1 or ros2 or ros2_50hz"):
        HuskyParams(controller="ros3")


@pytest.mark.parametrize("latency", [0.0, 0.04, 0.1, 0.25, 0.3])
def test_latency_delays_and_changes_nothing_else(latency):
    prompt = drive(Controller(), (1.0, 0.5), 10)
    late = drive(Controller(HuskyParams(command_latency=latency)), (1.0, 0.5), 10)
    periods = int(latency / CONTROL_PERIOD + 1e-9)  # whole ones; the rest is the controller's phase
    np.testing.assert_allclose(late[periods:], prompt[: 10 - periods])
    assert not np.any(late[:periods])


def test_the_newest_command_counts():
    controller = Controller()
    controller.command(0.0, 0.1, 0.0)
    controller.command(0.05, 0.2, 0.0)
    controller.command(0.15, 0.3, 0.0)  # not there yet
    assert carried_out(controller.update(0.1))[0] == pytest.approx(0.2)
