"""The Husky's model: constants, names, sensors, camera, standalone file. Its motion: `test_acceptance.py`."""

from functools import cache

import husky_options
import mujoco
import numpy as np
import pytest
from acceptance import MASS
from acceptance.drives import drive, on_plane, state_at_rest
from acceptance.grounds import reconstructed

from twin.env.physics import HuskyPhysics
from twin.mjcf.husky import (
    HUSKY_SCENE_XML,
    HUSKY_XML,
    add_husky,
    center_of_mass,
    check,
    coulomb_track_ratio,
    set_options,
    standalone_xml,
)
from twin.robot import GEAR_RATIO, TRACK, WHEEL_RADIUS, WHEEL_WIDTH, WHEELBASE, WHEELS, HuskyParams, PixelCamera


def test_bodies_joints_and_sensors_have_the_documented_names():
    model = mujoco.MjModel.from_xml_path(str(HUSKY_XML))
    for name in ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"):
        assert model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_HINGE
    assert model.body("base_link").parentid[0] == 0
    assert [model.actuator(i).name for i in range(model.nu)] == ["left", "right"]
    assert model.site("imu").bodyid[0] == model.body("base_link").id
    assert model.camera("front").bodyid[0] == model.body("base_link").id


def test_the_robot_balances_at_its_center_of_mass():
    model = on_plane()
    assert model.body("base_link").mass[0] == pytest.approx(46.034)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in WHEELS:  # balanced: the center of mass is on the axle, in the middle of the tire
        np.testing.assert_allclose(data.body(f"{name}_wheel").xipos, data.geom(f"{name}_tyre").xpos, atol=1e-9)
    base = data.body("base_link")
    np.testing.assert_allclose(base.subtree_com - base.xpos, center_of_mass(HuskyParams()))


def test_payload_moves_the_center_of_mass():
    params = HuskyParams(payload_mass=10.0, payload_position=(0.2, 0.1, 0.4))
    expected = (MASS * center_of_mass(HuskyParams()) + 10.0 * np.array([0.2, 0.1, 0.4])) / (MASS + 10.0)
    np.testing.assert_allclose(center_of_mass(params), expected)
    # Huygens and Steiner about the common center, by hand for the yaw axis.
    model = on_plane(params)
    chassis = 46.034 * np.array([0.0, 0.0, 0.062]) / 56.034 + 10.0 * np.array([0.2, 0.1, 0.4]) / 56.034
    yaw = 2.0296 + 46.034 * (chassis[:2] ** 2).sum() + 10.0 * ((np.array([0.2, 0.1]) - chassis[:2]) ** 2).sum()
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body("base_link").iquat)
    tensor = rotation.reshape(3, 3) @ np.diag(model.body("base_link").inertia) @ rotation.reshape(3, 3).T
    assert tensor[2, 2] == pytest.approx(yaw, rel=1e-6)


def test_inertia_is_the_published_one():
    model = on_plane()
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body("base_link").iquat)
    rotation = rotation.reshape(3, 3)
    tensor = rotation @ np.diag(model.body("base_link").inertia) @ rotation.T
    expected = [[0.6022, -0.02364, -0.1197], [-0.02364, 1.7386, -0.001544], [-0.1197, -0.001544, 2.0296]]
    np.testing.assert_allclose(tensor, expected, atol=1e-6)


def test_visual_geoms_have_no_mass_and_no_contacts():
    model = on_plane()
    looks = model.geom_group == 1
    assert looks.sum() > 20
    assert not model.geom_contype[looks].any() and not model.geom_conaffinity[looks].any()


def test_the_coulomb_track_ratio_of_a_centered_mass_equals_its_closed_form():
    assert coulomb_track_ratio(np.zeros(2)) == pytest.approx(1 + (WHEELBASE / TRACK) ** 2, rel=1e-6)
    rear = coulomb_track_ratio(np.array([-0.07, 0.0]))
    assert rear == pytest.approx(coulomb_track_ratio(np.array([0.07, 0.0])), rel=1e-6)
    assert rear < 1.6


def test_lag_is_first_order():
    """A step command with lag τ: the filtered command is 1 − e^(−t/τ) of it, and the wheels follow the filter."""
    lag = 0.2
    model = on_plane(HuskyParams(servo_lag=lag))
    data = state_at_rest(model)
    data.ctrl[:] = 3.0
    for steps in (50, 50, 100):
        mujoco.mj_step(model, data, steps)
        share = 1.0 - np.exp(-(data.time - 0.5) / lag)
        np.testing.assert_allclose(data.act, 3.0 * share, rtol=1e-6)
        np.testing.assert_allclose(data.qvel[6:], 3.0 * share, rtol=0.05)


def test_the_robot_turns_to_the_side_of_smaller_wheels():
    model = on_plane(HuskyParams(wheel_radius=(0.160, 0.165)))
    run = drive(model, 0.5, 0.0)
    speed = 0.5 / WHEEL_RADIUS
    left, right = 0.160 * speed, 0.165 * speed
    assert 1.6 < (right - left) / TRACK / run.yaw_rate < 2.3  # chi of a bend of 38 m


def test_sensors_and_motor_currents_agree_with_the_motion():
    physics = HuskyPhysics(on_plane())
    for _ in range(5):
        physics.step()
    np.testing.assert_allclose(physics.data.sensor("imu_accelerometer").data, [0, 0, 9.81], atol=0.02)
    before = physics.data.qpos[7:].copy()
    for _ in range(20):
        physics.command(0.0, 1.0)
        physics.step()
    pose = physics.planar_pose
    physics.command(0.0, 1.0)
    physics.step()
    turned = (physics.planar_pose[2] - pose[2]) / 0.1
    np.testing.assert_allclose(physics.data.sensor("imu_gyro").data, [0, 0, turned], atol=0.01)
    w, x, y, z = physics.data.sensor("imu_orientation").data
    assert np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(physics.planar_pose[2], abs=1e-6)
    assert (np.sign(physics.data.qpos[7:] - before) == [-1, 1, -1, 1]).all()
    # Coulomb: μ m g / 2 on the wheels of a side, at the arm that scrubbing leaves; at 79 · 0.035 N m per A.
    torque = 0.7 * MASS * 9.81 / 2 * WHEEL_RADIUS * np.sin(np.arctan(WHEELBASE / TRACK))
    np.testing.assert_allclose(physics.motor_torque, [-torque, torque], rtol=0.05)
    np.testing.assert_allclose(physics.motor_current, physics.motor_torque / (GEAR_RATIO * 0.035))


def test_belt_couples_the_wheels_of_a_side():
    physics = HuskyPhysics(on_plane())
    for _ in range(20):
        physics.command(0.5, 0.8)
        physics.step()
    front, rear = physics.data.qpos[7:9], physics.data.qpos[9:]
    np.testing.assert_allclose(front, rear, atol=0.01)  # [rad]


def test_front_camera_has_the_given_intrinsics():
    """MuJoCo's own frustum (which needs no OpenGL) has the fx ≠ fy and the off-center principal point that the XML
    contains.
    """
    fx, fy, cx, cy = 125.0, 126.25, 90.0, 30.0
    spec = mujoco.MjSpec()
    add_husky(spec, camera=PixelCamera((fx, fy, cx, cy), (160, 90)))
    spec.compile()
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene, camera = mujoco.MjvScene(model, 500), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera("front").id
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    view = scene.camera[0]
    edges = [
        view.frustum_center - view.frustum_width,
        view.frustum_center + view.frustum_width,
        view.frustum_top,
        view.frustum_bottom,
    ]
    expected = [-cx / fx, (160 - cx) / fx, cy / fy, -(90 - cy) / fy]
    np.testing.assert_allclose(np.array(edges) / view.frustum_near, expected, rtol=1e-5)


def test_tire_mesh_has_the_size_of_the_wheel():
    model = on_plane(HuskyParams(wheel_radius=(WHEEL_RADIUS, 0.16)))
    assert model.geom("front_left_tyre").size[1] * 2 == pytest.approx(WHEEL_WIDTH)
    for name, radius in (("husky_tyre_0", WHEEL_RADIUS), ("husky_tyre_1", 0.16)):
        tyre = model.mesh(name)
        vertices = model.mesh_vert[tyre.vertadr[0] : tyre.vertadr[0] + tyre.vertnum[0]]
        extent = np.sort(np.ptp(vertices, axis=0))
        np.testing.assert_allclose(extent, [WHEEL_WIDTH, 2 * radius, 2 * radius], rtol=0.02)


def test_shipped_file_is_up_to_date():
    """Compares compiled models, since MuJoCo versions format XML differently. `python -m twin.mjcf.husky` renews it."""
    shipped = mujoco.MjModel.from_xml_path(str(HUSKY_XML))
    made = mujoco.MjModel.from_xml_string(standalone_xml())
    assert shipped.names == made.names
    for name in dir(made):
        value = getattr(made, name) if not name.startswith("_") else None
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(shipped, name), value, err_msg=name)
    for name in ("timestep", "integrator", "cone", "impratio", "tolerance"):
        assert getattr(shipped.opt, name) == getattr(made.opt, name)
    assert "worldbody" in HUSKY_XML.read_text() and "plane" not in HUSKY_XML.read_text()


def test_shipped_file_attaches_and_drives_like_the_model():
    """After `MjSpec.attach` and `set_options`, the file drives like the model of the acceptance table."""
    spec = mujoco.MjSpec()
    set_options(spec)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1), pos=(0, 0, 0.5))
    robot = mujoco.MjSpec.from_file(str(HUSKY_XML))
    spec.attach(robot, prefix="a/", frame=spec.worldbody.add_frame(pos=(0.0, 0.0, 0.5)))
    model, own = spec.compile(), on_plane()
    there, here = mujoco.MjData(model), mujoco.MjData(own)
    for ctrl in ((3.0, 3.0), (-3.0, 3.0)):
        for name, value in zip(("left", "right"), ctrl, strict=True):
            there.ctrl[model.actuator(f"a/{name}").id] = value
            here.ctrl[own.actuator(name).id] = value
        mujoco.mj_step(model, there, 500)
        mujoco.mj_step(own, here, 500)
    np.testing.assert_allclose(there.qpos[:3] - [0, 0, 0.5], here.qpos[:3], atol=1e-4)
    np.testing.assert_allclose(there.qvel, here.qvel, atol=1e-3)
    assert here.qvel[5] > 0.9  # it did turn


def test_the_scene_of_the_folder_is_the_robot_on_a_plane():
    model = mujoco.MjModel.from_xml_path(str(HUSKY_SCENE_XML))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    data.ctrl[:] = -3.0, 3.0
    mujoco.mj_step(model, data, 1000)
    assert data.qvel[5] == pytest.approx(3.0 * 2 * WHEEL_RADIUS / (1.812 * TRACK), rel=0.02)
    assert not any(warning.number for warning in data.warning) and not check(model)


RIGHT = husky_options.RIGHT
QUICK = (RIGHT, "`cone` pyramidal (MuJoCo's default)", "`timestep` 5 ms", "`solver` PGS")


@cache
def measured(name):
    return husky_options.measure(husky_options.CASES[name], reconstructed(np.random.default_rng(0)))


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=() if one in QUICK else pytest.mark.slow) for one in husky_options.CASES]
)
def test_check_finds_the_options_that_cost_something_and_no_others(name):
    found = measured(name)
    assert bool(found.faults) == found.differs(measured(RIGHT))


def test_check_names_what_is_wrong_in_a_scene_of_defaults():
    floor = "<geom name='floor' type='plane' size='9 9 1'/>"
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{floor}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="no Husky in the model"):
        check(spec.compile())
    spec.attach(mujoco.MjSpec.from_file(str(HUSKY_XML)), prefix="a/", frame=spec.worldbody.add_frame())
    assert [one.option for one in check(spec.compile())] == ["cone", "impratio", "integrator"]
    set_options(spec)
    assert not check(spec.compile())
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # the robot would fall through the floor
    assert [one.option for one in check(spec.compile())] == ["flag constraint"]
    spec.option.disableflags = 0
    spec.geom("floor").priority = 1
    assert [one.option for one in check(spec.compile())] == ["priority of geom floor"]
    assert "the wheels hop" in str(check(spec.compile())[0])
