"""System identification from logs of a simulated robot whose parameters are known."""

import json
from dataclasses import replace
from pathlib import Path

import align as align_benchmark
import motor_currents
import mujoco
import numpy as np
import pytest
from drive_logs import SOFT, columns, windows_of

from twin import commands
from twin.align import summary
from twin.config_file import parse_table, read_robot
from twin.env.controller import Controller, limit_command, wheel_speeds
from twin.robot import TRACK, WHEEL_RADIUS, HuskyParams
from twin.sysid import drivetrain, kinematics, log_files, logs, rollout
from twin.sysid.estimation import Fit
from twin.sysid.identification import Identification, identify, robot_toml
from twin.sysid.kinematics import IcrModel, Prediction


def test_constant_wheel_speeds_drive_a_circle():
    """Constant wheel speeds make a circle: radius and angle are known."""
    left, right = 2.0, 5.0
    wheels = np.broadcast_to([left, right], (1, logs.SAMPLES, 2)).copy()
    poses = kinematics.predict(kinematics.NOMINAL, windows_of(wheels))
    rate = (right - left) * WHEEL_RADIUS / TRACK
    radius = (right + left) * WHEEL_RADIUS / 2 / rate
    angle = rate * logs.DURATION
    x, y, yaw = poses[0, logs.SAMPLES]
    # Twenty chords a second instead of the arc are short by a share of (rate · period)² / 24.
    assert x == pytest.approx(radius * np.sin(angle), rel=1e-4)
    assert y == pytest.approx(radius * (1 - np.cos(angle)), rel=1e-4)
    assert yaw == pytest.approx(angle)


def test_the_icr_model_is_recovered_from_its_own_motion():
    rng = np.random.default_rng(0)
    truth = IcrModel(0.93, 0.97, 0.55, -0.62, -0.08)
    wheels = np.repeat(rng.uniform(-6, 6, (60, 1, 2)), logs.SAMPLES, 1)
    poses = kinematics.predict(truth, windows_of(wheels))[:, : logs.SAMPLES + 1]
    poses[::7] = rng.normal(0.0, 1e-3, poses[::7].shape)  # the robot stuck in every seventh window
    found = kinematics.fit_icr(windows_of(wheels, poses))
    for name in truth.__dataclass_fields__:
        assert getattr(found, name) == pytest.approx(getattr(truth, name), abs=2e-3)


def test_kinematics_begin_with_the_preceding_wheel_speeds():
    """The first pose of a slow sensor was measured in the window before, so the wheel speeds of that window matter."""
    n, age = 6, 10
    time = np.arange(n * logs.SAMPLES) * logs.PERIOD
    wheels = np.stack([4 + 2 * np.sin(time), 4 - 2 * np.sin(1.7 * time)], -1).reshape(n, logs.SAMPLES, 2)
    whole = kinematics.integrate(kinematics.NOMINAL.motion(wheels.reshape(1, -1, 2)))[0]
    seen = [np.maximum(0, i * logs.SAMPLES + np.arange(logs.SAMPLES + 1) + 5) // age * age - 5 for i in range(n)]
    windows = replace(windows_of(wheels, logs.relative_poses(whole[np.maximum(0, seen)])), follows=np.arange(n) > 0)
    assert windows.measurement_times[1:, 0] == pytest.approx(-0.25)
    distance, angle = Prediction("nominal", windows, kinematics.predict(kinematics.NOMINAL, windows)).errors
    assert distance[1:].max() < 0.005
    assert angle[1:].max() < 0.2


def test_icr_baseline_that_gets_the_slopes_slides_downhill():
    """Tests the baseline of `benchmarks/align.py --last-third`; without drift it is the plain baseline."""
    rng = np.random.default_rng(1)
    windows = windows_of(rng.uniform(1.0, 4.0, (8, 1, 2)) + np.zeros((8, logs.SAMPLES, 2)), follows=np.arange(8) > 0)
    slope, five = rng.normal(0.0, 0.5, (8, 2)), np.array([0.93, 0.97, 0.55, -0.62, -0.08])
    plain = kinematics.predict(IcrModel(*five), windows)
    np.testing.assert_allclose(
        align_benchmark._sloped_poses(np.append(five, [0, 0]), windows, slope), plain, atol=1e-12
    )
    straight = windows_of(np.full((1, logs.SAMPLES, 2), 3.0))
    level = kinematics.predict(kinematics.NOMINAL, straight)
    left = align_benchmark._sloped_poses(
        np.array([1, 1, TRACK / 2, -TRACK / 2, 0, 0, 0.2]), straight, np.array([[0.0, 0.5]])
    )
    assert (left - level)[0, logs.SAMPLES] == pytest.approx([0.0, 0.2 * 0.5 * logs.DURATION, 0.0], abs=1e-9)


def test_last_third_of_the_groups_is_for_scoring():
    groups = np.repeat([3, 5, 7, 8, 11, 12], 4)
    windows = align_benchmark.cut_last_third(windows_of(np.ones((24, logs.SAMPLES, 2)), groups=groups))
    assert np.array_equal(windows.fitting, groups <= 8) and len(np.unique(windows.groups)) == 6


def test_commands_become_the_controllers_wheel_speeds():
    """The smooth drivetrain model equals the mean of the robot's controller over all phases of its 0.1 s clock."""
    params = replace(SOFT, servo_lag=0.0)
    request = (0.7, 0.9)
    speeds = []
    for phase in np.arange(10) * 0.01:
        controller, speed, rows = Controller(params), np.zeros(2), []
        for i in range(200):
            if i % 10 == 0:
                controller.command(i * 0.01, *request)
            if (i - round(phase * 100)) % 10 == 0 and i * 0.01 >= phase:
                speed = controller.update(i * 0.01)
            rows.append(speed)
        speeds.append(rows)
    windows = windows_of(np.zeros((1, logs.SAMPLES, 2)), commands=np.full((1, logs.SAMPLES, 2), request), twist=True)
    targets, _ = drivetrain.simulate_drivetrain(drivetrain.Drivetrain.from_robot(params, True), windows)
    mean = np.mean(speeds, 0)
    assert np.abs(targets[0, :200] - mean).max() < 0.3  # of 6 rad/s; the ramp's ends are rounder in the mean
    assert np.abs(targets[0, 190:200] - mean[190:]).max() < 1e-6


def test_the_drivetrain_is_the_controller_run_every_step():
    """With delays of whole steps and no lag, servo targets equal the controller's to the last digits."""
    params = replace(SOFT, servo_lag=0.0, max_wheel_speed=0.8)
    rng = np.random.default_rng(0)
    requests = np.repeat(rng.uniform([-0.9, -2.0], [0.9, 2.0], (12, 4, 2)), logs.SAMPLES // 4, 1)
    windows = windows_of(np.zeros((12, logs.SAMPLES, 2)), commands=requests, twist=True)
    targets, _ = drivetrain.simulate_drivetrain(drivetrain.Drivetrain.from_robot(params, True), windows)
    steps = round(params.command_latency / drivetrain.CONTROL_STEP)
    arrived = np.pad(requests.repeat(round(logs.PERIOD / drivetrain.CONTROL_STEP), 1), ((0, 0), (steps, 0), (0, 0)))
    limited, expected = np.zeros((12, 2)), []
    for i in range(logs.SAMPLES * 5):
        limited = limit_command(arrived[:, i], limited, params, drivetrain.CONTROL_STEP)
        expected.append(wheel_speeds(limited, params))
    assert (np.abs(expected).max(-1) > 0.999 * params.max_wheel_speed / WHEEL_RADIUS).any()
    np.testing.assert_allclose(targets[:, : logs.SAMPLES * 5], np.stack(expected, 1), rtol=0, atol=1e-9)


def test_acceleration_ramps_continue_from_window_to_window():
    """Wheels lag behind a ramp, so only the commands of earlier windows determine the controller's state at a window's
    start.
    """
    drive = drivetrain.Drivetrain(1.0, 1.0, np.inf, 9.0, 9.0, 0.2, 1.0, 9.0, 0.3)
    time = np.arange(3 * logs.SAMPLES) * logs.PERIOD
    ramp = np.maximum(0.0, time - drive.latency)
    lagged = drive.mean_acceleration * (ramp - drive.lag * (1 - np.exp(-ramp / drive.lag)))
    wheels = np.repeat(lagged[:, None], 2, 1).reshape(3, logs.SAMPLES, 2)
    asked = np.full((3, logs.SAMPLES, 2), 8.0)
    windows = replace(windows_of(wheels, commands=asked, twist=False), follows=np.arange(3) > 0)
    targets, turned = drivetrain.simulate_drivetrain(drive, windows)
    step = drive.mean_acceleration * drivetrain.CONTROL_STEP
    assert targets[1:, :25] == pytest.approx(targets[:-1, 200:])
    assert targets[:, 100, 0] == pytest.approx(drive.mean_acceleration * (2.0 * np.arange(3) + 0.8), abs=1.01 * step)
    assert drivetrain.at_samples(turned) == pytest.approx(wheels, abs=step)


def limited_windows(seed: int, truth: HuskyParams, most: tuple[float, float]) -> logs.Windows:
    """Wheel speeds of the drivetrain model, with noise, under random commands of up to `most` [m/s], [rad/s]."""
    rng = np.random.default_rng(seed)
    requests = np.repeat(rng.uniform(-1, 1, (40, 2, 2)) * most, logs.SAMPLES // 2, 1)
    windows = windows_of(np.zeros((40, logs.SAMPLES, 2)), commands=requests, twist=True)
    windows = replace(windows, groups=np.arange(40) // 2, follows=np.arange(40) > 0)
    _, turned = drivetrain.simulate_drivetrain(drivetrain.Drivetrain.from_robot(truth, True), windows)
    return replace(windows, wheels=drivetrain.at_samples(turned) + rng.normal(0, 0.02, windows.wheels.shape))


def test_a_speed_limit_below_the_commands_is_found():
    truth = replace(SOFT, max_speed=0.5)
    windows = limited_windows(0, truth, (0.9, 1.8))
    fitted, fit = drivetrain.fit_drivetrain(windows, HuskyParams())
    found = fitted.robot_fields(HuskyParams(), True)
    for name in ("max_speed", "max_acceleration", "max_yaw_acceleration", "command_latency", "servo_lag"):
        assert found[name] == pytest.approx(getattr(truth, name), rel=0.03), name
    assert {"mean_limit", "mean_acceleration"} <= fit.errors.keys()


def test_the_largest_command_is_no_limit():
    """The robot is faster than the published one, and reaches none of its limits."""
    truth = replace(SOFT, max_speed=3.0, max_wheel_speed=3.0, max_yaw_rate=2.0)
    windows = limited_windows(1, truth, (1.3, 0.9))
    fitted, fit = drivetrain.fit_drivetrain(windows, HuskyParams())
    assert fit.refused.keys() == {"mean_limit", "half_limit", "wheel_limit"}
    assert "max_wheel_speed = 1 is kept, which the log exceeds, so raise it in [robot]" in fit.refused["wheel_limit"]
    assert "raise" not in fit.refused["half_limit"]
    assert fitted.half_gain == pytest.approx(truth.separation_multiplier, abs=4 * fit.errors["half_gain"])


def test_a_wrong_sample_of_an_encoder_exceeds_no_limit():
    windows = limited_windows(1, SOFT, (0.5, 0.6))
    windows.wheels[4, 7, 0] = 300.0
    fitted, fit = drivetrain.fit_drivetrain(windows, HuskyParams())
    assert "raise" not in "".join(fit.refused.values())
    assert fitted.wheel_limit == drivetrain.Drivetrain.from_robot(HuskyParams(), True).wheel_limit


@pytest.mark.parametrize("late", [0.4, 0.2, 0.07, 0.0, -0.15])
def test_a_pose_delay_shows_earlier_poses(late):
    """One robot speeds up along a straight line, another drives around a circle."""
    time = (
        np.arange(rollout.LEAD_SAMPLES + logs.SAMPLES + drivetrain.EXTRA_SAMPLES) - rollout.LEAD_SAMPLES
    ) * logs.PERIOD
    line = np.stack([(time + 1.0) ** 2, 0 * time, 0 * time], -1)
    circle = np.stack([np.sin(time), 1 - np.cos(time), time], -1)
    poses = logs.resample_poses(np.stack([line, circle]), np.array([late, late]), rollout.LEAD_SAMPLES)[
        :, : logs.SAMPLES + 2
    ]
    t = np.arange(poses.shape[1]) * logs.PERIOD
    assert len(t) == logs.SAMPLES + 2
    np.testing.assert_allclose(poses[0, :, 0], (t - late + 1) ** 2 - (1 - late) ** 2, atol=1e-3)
    np.testing.assert_allclose(poses[1], np.stack([np.sin(t), 1 - np.cos(t), t], -1), atol=1e-3)


def test_viscosity_drags_tires_but_not_the_chassis():
    from twin.sysid.rollout import plane_model

    def drag(params: HuskyParams) -> np.ndarray:
        model = plane_model(params)
        data = mujoco.MjData(model)
        data.qvel[0] = 0.5
        mujoco.mj_forward(model, data)
        return data.qfrc_fluid[:3].copy()

    assert not drag(HuskyParams()).any()
    # Stokes drag of a sphere as wide as the tire on the mean, four of them (MuJoCo's ellipsoid model).
    width = 2 * (0.1651 + 0.1143 / 2 + 0.1651) / 3
    assert drag(HuskyParams(ground_viscosity=5.0))[0] == pytest.approx(-4 * 3 * np.pi * width * 5.0 * 0.5, rel=0.01)


@pytest.mark.parametrize("speed", [0.4, 0.8])
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_grip_grows_with_slip_over_rolling_speed(speed, share):
    """A driving robot that is pushed sideways by a fraction of its grip slides at a fraction of its speed, known in
    closed form.
    """
    params = HuskyParams(friction=0.3, rolling_resistance=0.12, motor_torque=500.0)
    model = rollout.plane_model(params)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    base = model.body("base_link").id
    push = share * params.friction * model.body_mass.sum() * 9.81
    slip = []
    for i in range(1000):
        across = data.xmat[base].reshape(3, 3)[:, 1]
        data.ctrl[:] = speed / WHEEL_RADIUS
        data.xfrc_applied[base, :3] = push * across
        mujoco.mj_step(model, data)
        if i >= 700:
            slip.append(data.qvel[:3] @ across / np.hypot(data.qvel[0], data.qvel[1]))
    tangent = params.rolling_resistance / params.friction * share / np.sqrt(1 - share**2)
    assert np.mean(slip) == pytest.approx(np.sin(np.arctan(tangent)), rel=0.04)


@pytest.mark.slow
def test_a_known_robot_is_recovered(drive, tmp_path):
    """The fit recovers the known parameters of a simulated drive, and predicts held-out windows far better than
    kinematics.
    """
    windows = logs.cut_windows(drive, "log")
    result = identify(windows, HuskyParams())
    found = result.identified
    for name, tolerance in {
        "command_latency": 0.06,  # the controller reads commands of the log up to one of its periods late
        "servo_lag": 0.04,
        "max_acceleration": 0.2,
        "max_yaw_acceleration": 0.3,
        "separation_multiplier": 0.05,
        "friction": 0.07,
        "ground_viscosity": 1.0,
        "rolling_resistance": 0.01,
    }.items():
        assert found[name][0] == pytest.approx(getattr(SOFT, name), abs=tolerance), name
    assert found["center_of_mass"][0][0] == pytest.approx(-0.06, abs=0.03)
    assert found["wheel_radius"][0] == pytest.approx((WHEEL_RADIUS, WHEEL_RADIUS), abs=0.004)
    held_out = ~windows.fitting
    ours, theirs = result.fitted.score(held_out), result.baseline.score(held_out)
    # The ICR model knows what the wheels did, ours only their commands, by a controller whose clock is not the log's.
    assert ours.position_m < min(0.02, 0.75 * theirs.position_m)
    assert ours.yaw_deg < min(2.0, 0.75 * theirs.yaw_deg)
    assert ours.wheels_rad_s < 0.15
    # The scene reads robot.toml back.
    path = tmp_path / "robot.toml"
    path.write_text(robot_toml(result, {"camera_pitch": 7.0, "friction": 0.1}, "log"), encoding="utf-8")
    robot = parse_table(HuskyParams, read_robot(path), "robot.toml")
    assert robot.camera_pitch == 7.0
    assert robot.friction == pytest.approx(result.robot.friction, rel=1e-4)
    assert robot.center_of_mass == pytest.approx(result.robot.center_of_mass, abs=1e-4)


def aligned(twist: bool = True, drive_errors=None, ground_errors=None, **robot) -> Identification:
    """An identification without a fit, with given standard errors."""
    params = HuskyParams(**robot)
    wheels = np.random.default_rng(0).uniform(1, 5, (40, logs.SAMPLES, 2))
    gone = kinematics.predict(kinematics.IcrModel(y_left=0.6, y_right=-0.6), windows_of(wheels))[:, : logs.SAMPLES + 1]
    windows = windows_of(wheels, gone, twist=twist)
    drive = drivetrain.Drivetrain.from_robot(params, twist)
    prediction = Prediction("made up", windows, kinematics.predict(kinematics.NOMINAL, windows), wheels + 0.1)
    fits = [
        Fit({}, drive_errors or {}, {}),
        Fit({"pose_x": 0.0, "pose_y": 0.0, "pose_late": 0.0}, ground_errors or {}, {}),
    ]
    return Identification(windows, kinematics.NOMINAL, drive, *fits, params, *[prediction] * 4)


@pytest.mark.parametrize("twist", [True, False])
def test_errors_of_yaw_limits_scale_with_the_multiplier(twist):
    """ω = half speed · 2 r / (multiplier · track), and its error scales alike; other errors are in the unit of their
    field.
    """
    errors = {"half_limit": 0.1, "half_acceleration": 0.4, "wheel_limit": 0.2, "latency": 0.03, "half_gain": 0.05}
    found = aligned(twist, errors, separation_multiplier=1.875, command_latency=0.2).identified
    per_half = 2 * WHEEL_RADIUS / (1.875 * TRACK)
    assert found["max_yaw_rate"] == (2.0, pytest.approx(0.1 * per_half))
    assert found["max_yaw_acceleration"] == (6.0, pytest.approx(0.4 * per_half))
    assert found["max_wheel_speed"][1] == pytest.approx(0.2 * WHEEL_RADIUS)
    assert found["command_latency"] == (0.2, pytest.approx(0.03))
    assert ("separation_multiplier" in found) == twist
    if twist:
        assert found["separation_multiplier"] == (1.875, pytest.approx(0.05))


def test_components_that_were_not_fitted_are_named():
    result = aligned(ground_errors={"center_of_mass_x": 0.003, "radius_left": 0.001, "radius_right": 0.002})
    assert result.identified["center_of_mass"][1] == (0.003, None, None)
    assert "# ± 0.003, not fitted, not fitted\n" in robot_toml(result, {}, "log")
    assert "± 0.003, not fitted, not fitted" in summary(result)
    assert "# ± 0.001, 0.002\n" in robot_toml(result, {}, "log")
    robot = json.loads(json.dumps(result.figures()))["robot"]
    assert robot["center_of_mass"]["standard_error"] == [0.003, None, None]


def test_a_log_that_identifies_nothing_keeps_previous_fields():
    result = aligned()
    assert "fitted: nothing" in summary(result)
    text = robot_toml(result, {"friction": 0.3}, "log")
    assert "Nothing could be identified from this log" in text and "friction = 0.3\n" in text


def test_fields_of_the_scene_that_override_fitted_ones_are_named(tmp_path, monkeypatch, capsys):
    errors = {"friction": 0.01, "spin_friction": 0.01}
    monkeypatch.setattr("twin.align.identify", lambda *_: aligned(ground_errors=errors))
    monkeypatch.setattr("twin.align.check_log", lambda *_: None)
    monkeypatch.setattr("twin.align.write_plots", lambda *_: None)
    scene, log = tmp_path / "x", tmp_path / "log.npz"
    scene.mkdir()
    (scene / "scene.toml").write_text(
        '[[source]]\npath = "a.mp4"\n[metric]\ncamera_height = 1.2\n[robot]\nfriction = 0.5\nmax_speed = 0.9\n'
    )
    np.savez(log, **columns(HuskyParams(), 4.0, seed=0))
    for target in (scene, scene / "scene.toml", scene / "robot.toml"):  # the last one written by the first
        assert commands.main("align", [str(target), str(log)]) == 0
        assert "overrides fitted values: friction;" in capsys.readouterr().out, target
    assert commands.main("align", [str(scene), str(log), "--out", str(tmp_path / "out")]) == 0
    assert "overrides fitted values" not in capsys.readouterr().out  # that folder is not the scene's
    found = tmp_path / "out" / "robot.toml"
    found.write_text(found.read_text() + "\nrolling_resistance = 0.0321\n")  # as an earlier log gave it
    assert commands.main("align", ["husky", str(log), "--out", str(tmp_path / "out")]) == 0
    assert read_robot(found)["rolling_resistance"] == 0.0321


@pytest.mark.parametrize("out", ["file/out", "taken"])
def test_an_unwritable_folder_is_refused_before_the_fit(out, drive, tmp_path, monkeypatch, capsys):
    def never(*_):
        raise AssertionError("fitted before the folder was made")

    monkeypatch.setattr("twin.align.identify", never)
    (tmp_path / "file").write_text("")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "alignment").write_text("")
    np.savez(tmp_path / "log.npz", **drive)
    assert commands.main("align", ["husky", str(tmp_path / "log.npz"), "--out", str(tmp_path / out), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(tmp_path / out) in said and "--out" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "x.csv"], "no scene.toml there"),
        (["husky", "x.csv"], "give one with --out"),
        (["husky", "x.csv", "--out", "out"], "no such log"),
    ],
)
def test_bad_arguments_exit_with_status_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert commands.main("align", arguments) == 2
    assert message in capsys.readouterr().err


def test_motor_effort_is_relative_to_a_straight_drive():
    """The made-up log turns left: the right side draws three times the current of a straight drive, the left half of
    it.
    """
    speeds = np.concatenate([np.full((50, 2), 0.5), np.full((50, 2), [0.4, 0.6])])
    amps = np.concatenate([np.full((50, 2), 2.0), np.full((50, 2), [1.0, 6.0])])
    effort = motor_currents.measured_effort(motor_currents.SteadySamples(speeds, amps))
    assert (effort.outer, effort.inner, effort.total) == pytest.approx((3.0, 0.5, 1.75))


def test_rolling_resistance_from_motor_currents():
    rng = np.random.default_rng(0)
    turning = rng.uniform(0.25, 0.4, (40, 1)) + np.array([[-0.06, 0.06]])
    speeds = np.concatenate([np.full((40, 2), 0.6), turning])
    truth = HuskyParams(rolling_resistance=0.05)
    steady = motor_currents.SteadySamples(speeds, np.ones_like(speeds))
    effort = motor_currents.simulated_effort(steady, truth)
    amps = np.concatenate([np.ones((40, 2)), np.full((40, 2), [effort.inner, effort.outer])])
    found = motor_currents.rolling_resistance_of(motor_currents.SteadySamples(speeds, amps), HuskyParams())
    assert found == pytest.approx(0.05, rel=0.05)


@pytest.mark.realdata
def test_kinematic_baselines_on_the_real_log(real_data: Path):
    """Others computed these errors from the same log: 0.45 m and 70° nominal, 0.18 m and 7° with a fitted ICR model."""
    windows = log_files.read_log(real_data / "husky_drive" / "husky_drive_dev.npz")
    held_out = ~windows.fitting
    distance, angle = Prediction("nominal", windows, kinematics.predict(kinematics.NOMINAL, windows)).errors
    assert np.median(distance[held_out]) == pytest.approx(0.45, abs=0.02)
    assert 65 < np.median(angle[held_out]) < 85
    model = kinematics.fit_icr(windows)
    distance, angle = Prediction("ICR", windows, kinematics.predict(model, windows)).errors
    assert np.median(distance[held_out]) == pytest.approx(0.18, abs=0.01)
    assert np.median(angle[held_out]) == pytest.approx(6.6, abs=0.6)
