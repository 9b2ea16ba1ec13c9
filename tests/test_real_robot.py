"""The robot of the real test: laws of its motion, and what is known of a Husky."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from twin.env.domain_randomization import Ranges
from twin.errors import InputError
from twin.reality.place_objects import Solid, Solids
from twin.reality.real_robot import FOOTPRINT, RANGES, TRAINED, HiddenRobot, RealRobot, draw_robot
from twin.robot import TRACK, WHEEL_RADIUS, WHEELBASE, HuskyParams

STILL = replace(HiddenRobot(), shake=0.0)


def on_plane(robot: HiddenRobot, grade: float = 0.0, crossfall: float = 0.0, seed: int = 1) -> RealRobot:
    """A robot at rest on a plane that rises along x and y."""
    route = SimpleNamespace(ground_height=lambda xy: grade * xy[..., 0] + crossfall * xy[..., 1])
    one = RealRobot(robot, SimpleNamespace(route=route, objects=[]))
    one.set_pose(0.0, 0.0, 0.0, np.random.default_rng(seed))
    return one


def driven(one: RealRobot, v: float, yaw_rate: float, seconds: float) -> np.ndarray:
    """Poses x, y, yaw, then both wheel speeds, every 0.1 s under a command that is repeated."""
    rows = []
    for _ in range(round(seconds / 0.1)):
        one.command(v, yaw_rate)
        one.step(0.1)
        rows.append((*one.pose, *one.wheel_speeds))
    return np.array(rows)


def track_ratio(robot: HiddenRobot, v: float, yaw_rate: float) -> float:
    """(v_right − v_left) / (yaw rate · track) in the steady state."""
    rows = driven(on_plane(robot), v, yaw_rate, 6.0)[20:]
    rate = np.polyfit(0.1 * np.arange(len(rows)), rows[:, 2], 1)[0]
    return float((rows[:, 4] - rows[:, 3]).mean() * WHEEL_RADIUS / (rate * TRACK))


# ---- turning


@pytest.mark.parametrize(("v", "yaw_rate"), [(0.0, 0.3), (0.0, 1.0), (0.0, -1.8), (0.5, 0.5), (0.3, -0.6)])
def test_a_centered_robot_turns_as_coulomb_friction_says(v, yaw_rate):
    """chi = 1 + (L / B)² for isotropic friction on four points, for any coefficient; the tires' deflection changes it a
    little.
    """
    for friction in (0.45, 0.9):
        even = replace(STILL, friction=friction, center_forward=0.0, lateral_grip=1.0, static_excess=1.0, payload=0.0)
        assert track_ratio(even, v, yaw_rate) == pytest.approx(1.0 + (WHEELBASE / TRACK) ** 2, rel=0.04)


def test_drawn_robots_turn_as_logs_of_a_husky_show():
    """Logs have chi from 1.96 to 3.5, median 2.26; a simulation with four contact points has 1.8."""
    ratios = [track_ratio(draw_robot(number), 0.0, 1.0) for number in range(12)]
    assert min(ratios) > 1.75 and max(ratios) < 2.6 and np.ptp(ratios) > 0.2
    assert 1.85 < np.median(ratios) < 2.3


def test_yaw_comes_without_overshoot_and_currents_are_those_of_scrubbing():
    one = on_plane(STILL)
    rows = driven(one, 0.0, 1.0, 4.0)
    rates = np.diff(rows[:, 2]) / 0.1
    assert rates.max() <= 1.1 * rates[-10:].mean()
    # Wheel torque against μ N r sin(atan(L / B)) for four tires, with friction across the tire the larger.
    torque = 79.0 * STILL.torque_constant * np.abs(one.currents).mean() - STILL.gear_friction
    loads = (56.582 + STILL.payload) * 9.81 / 2.0
    along, across = STILL.friction, STILL.friction * STILL.lateral_grip
    bound = loads * WHEEL_RADIUS * np.array([along, across]) * WHEELBASE / np.hypot(WHEELBASE, TRACK)
    assert 0.85 * bound[0] < torque < 1.15 * bound[1]


# ---- driving straight, standing, sliding


def test_straight_ahead_it_keeps_to_speed_and_power():
    """1 m/s: drift, slip, and the motors' power against rolling resistance and the gears' friction."""
    one = on_plane(replace(STILL, payload=0.0))
    rows = driven(one, 1.0, 0.0, 10.0)
    speed = np.diff(rows[50:, 0]).mean() / 0.1
    assert abs(rows[-1, 1]) < 0.02 and abs(np.rad2deg(rows[-1, 2])) < 0.3
    wheel = rows[50:, 3:].mean()
    assert -1e-5 <= 1.0 - speed / (wheel * WHEEL_RADIUS) < 0.02
    power = 79.0 * STILL.torque_constant * sum(one.currents) * wheel
    lost = STILL.rolling_resistance * 56.582 * 9.81 * speed + 2.0 * STILL.gear_friction * wheel
    assert power == pytest.approx(lost, rel=0.1)


def test_a_worn_battery_limits_speed():
    """At 1 m/s the back-EMF is 16.8 V."""
    low = replace(STILL, battery_voltage=15.0)
    assert driven(on_plane(low), 1.0, 0.0, 4.0)[-1, 3] * WHEEL_RADIUS < 0.9
    sagging = replace(STILL, battery_voltage=18.0, battery_resistance=0.4)
    stiff = replace(sagging, battery_resistance=0.0)
    turned = [driven(on_plane(one), 0.0, 1.87, 4.0)[-1, 2] for one in (sagging, stiff)]
    assert turned[0] < 0.97 * turned[1]


@pytest.mark.parametrize(("grade", "crossfall"), [(0.08, 0.0), (-0.08, 0.0), (0.0, 0.08)])
def test_at_rest_it_stays_at_rest_on_a_slope(grade, crossfall):
    """Both before the first command and after the end of a drive."""
    for number in range(4):
        one = on_plane(draw_robot(number), grade, crossfall)
        one.step(1.0)
        first = np.array(one.pose)
        one.step(5.0)
        assert np.abs(np.array(one.pose) - first).max() < 1e-4
        driven(one, 0.8, 0.5, 2.0)
        one.step(1.5)
        rest = np.array(one.pose)
        assert np.hypot(*rest[:2]) > 0.8
        one.step(5.0)
        assert np.abs(np.array(one.pose) - rest).max() < 2e-3
        assert np.abs(one.velocity).max() < 1e-6


def test_beyond_the_angle_of_friction_it_slides():
    robot = replace(STILL, lateral_grip=1.0, static_excess=1.0, friction=0.5)
    for off, slides in ((-2.0, False), (2.0, True)):
        one = on_plane(robot, crossfall=float(np.tan(np.arctan(0.5) + np.deg2rad(off))))
        one.step(3.0)
        assert (abs(one.velocity[1]) > 0.5) == slides


def energy(one: RealRobot, grade: float) -> float:
    """Kinetic energy of body and wheels, and potential energy on a plane that rises along x [J]."""
    kinetic = one._mass * (one._vx**2 + one._vy**2) + one._yaw_inertia * one._rate**2
    wheels = one._side_inertia * sum(speed**2 for speed in one._wheel)
    x = one.pose[0] + np.cos(one.pose[2]) * one.robot.center_forward - np.sin(one.pose[2]) * one.robot.center_left
    return 0.5 * (kinetic + wheels) + one._mass * 9.81 * grade * float(x)


@pytest.mark.parametrize("grade", [0.0, 0.08])
def test_without_motors_energy_only_falls(grade):
    """The tires' bristles may return a hundredth of a joule."""
    for number in range(3):
        one = on_plane(replace(draw_robot(number), current_limit=0.0, shake=0.0), grade)
        one._vx, one._vy, one._rate, one._wheel = 1.0, 0.3, 1.0, [3.0, 7.0]
        path = [energy(one, grade)]
        for _ in range(1000):
            one.step(0.002)
            path.append(energy(one, grade))
        assert path[0] - path[-1] > 20.0
        assert (np.array(path) - np.minimum.accumulate(path)).max() < 0.01


# ---- controller and sensors


def test_without_commands_it_stops():
    for number in range(4):
        one = on_plane(draw_robot(number))
        driven(one, 1.0, 0.0, 3.0)
        before = one.pose[0]
        one.step(2.0)
        assert one.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
        assert 0.05 < one.pose[0] - before < 1.1


def test_any_control_step_passes_its_time():
    """The robot advances by steps of 2 ms."""
    for period in (0.001, 0.003, 0.0333, 0.1):
        one = on_plane(STILL)
        for k in range(200):
            one.step(period)
            assert abs(one.time - (k + 1) * period) <= 0.0011, period


def test_its_clocks_jitter_and_a_seed_repeats_them():
    late = replace(STILL, jitter=0.25)
    ends = [driven(on_plane(late, seed=seed), 0.8, 0.6, 3.0)[-1, :2] for seed in (1, 1, 2)]
    assert np.array_equal(ends[0], ends[1])
    assert 1e-4 < np.linalg.norm(ends[0] - ends[2]) < 0.2


def test_it_follows_the_ground_and_shakes_only_where_it_moves():
    one = on_plane(STILL, grade=0.08)
    matrix = one.base_to_world(0.0)
    assert np.rad2deg(np.arcsin(matrix[2, 0])) == pytest.approx(np.rad2deg(np.arctan(0.08)), abs=1e-6)
    shaky = on_plane(replace(STILL, shake=0.3))
    shaky.step(2.0)
    assert shaky.tilt < 1e-3
    tilts = []
    for _ in range(100):
        driven(shaky, 1.0, 0.0, 0.1)
        tilts.append(np.rad2deg(shaky.tilt))
    # Two directions of 0.3° each.
    assert np.sqrt(np.mean(np.square(tilts[20:]))) == pytest.approx(0.3 * np.sqrt(2.0), rel=0.35)


def test_poses_of_the_past_are_kept():
    one = on_plane(STILL)
    driven(one, 1.0, 0.0, 1.0)
    then, when = one.base_to_world(one.time), one.time
    driven(one, 1.0, 0.5, 0.5)
    np.testing.assert_allclose(one.base_to_world(when), then, atol=1e-12)


# ---- collision


def test_a_touch_is_an_overlap_of_footprint_and_solid():
    """The result is compared with points sampled over the robot."""
    rng = np.random.default_rng(0)
    long, wide = (np.linspace(-0.5 * side, 0.5 * side, 90) for side in FOOTPRINT)
    points = np.stack(np.meshgrid(long, wide), -1).reshape(-1, 2)
    wrong = hits = 0
    for k in range(400):
        half = rng.uniform(0.1, 0.8, 3)
        half[2] = half[2] if k % 2 else 0.0
        kind, yaw = ("box" if k % 2 else "cylinder"), float(rng.uniform(-np.pi, np.pi))
        solid = Solid(kind, np.append(rng.uniform(-1.5, 1.5, 2), 0.3), half, yaw)
        pose = (*rng.uniform(-0.5, 0.5, 2).tolist(), float(rng.uniform(-np.pi, np.pi)))
        found = Solids(SimpleNamespace(objects=[SimpleNamespace(solids=[solid])]), FOOTPRINT).hit(*pose, 0.03, 0.4)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        off = points @ np.array([[c, s], [-s, c]]) + pose[:2] - solid.center[:2]
        c, s = np.cos(yaw), np.sin(yaw)
        local = off @ np.array([[c, -s], [s, c]])
        inside = np.abs(local) < half[:2] if kind == "box" else np.hypot(*local.T)[:, None] < half[0]
        wrong += found != bool(inside.all(-1).any())
        hits += found
    assert 100 < hits < 300 and wrong <= 4  # samples miss overlaps of a corner


def test_what_lies_flat_or_hangs_high_is_not_touched():
    solid = Solid("box", np.array([0, 0, 1.0]), np.full(3, 0.2))
    one = Solids(SimpleNamespace(objects=[SimpleNamespace(solids=[solid])]), FOOTPRINT)
    assert not one.hit(0.0, 0.0, 0.0, 0.03, 0.4) and one.hit(0.0, 0.0, 0.0, 0.7, 1.1)


# ---- numbers


def test_numbers_are_robots_and_some_lie_outside_training():
    assert draw_robot(5) == draw_robot(5) != draw_robot(6)
    with pytest.raises(InputError, match="robot -1: expected 0 or more"):
        draw_robot(-1)
    for number in range(60):
        one = draw_robot(number)
        assert all(low <= getattr(one, name) <= high for name, (low, high) in RANGES.items())
    inside = [
        all(low <= getattr(draw_robot(n), name) <= high for name, (low, high) in TRAINED.items()) for n in range(60)
    ]
    assert inside[0] and 5 <= sum(inside) <= 45


def test_what_training_samples_is_stated_rightly():
    """The twin's default ranges on the published robot are those that the reality's modules state."""
    ranges, published = Ranges(), HuskyParams()
    expected = {
        "payload": ranges.payload,
        "friction": tuple(published.friction * factor for factor in ranges.friction),
        "command_latency": tuple(published.command_latency + extra for extra in ranges.latency),
        "wheel_radius": ranges.wheel_radius,
        "wheel_difference": ranges.wheel_difference,
    }
    assert set(TRAINED) == set(expected)
    for name, pair in expected.items():
        assert TRAINED[name] == pytest.approx(pair), name
