"""The Husky against its data sheet and the mechanics of skid steering, on a plane, by wheel commands alone."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from twin.env.controller import CONTROL_PERIOD, limited_command, wheel_speeds
from twin.mjcf import husky
from twin.mjcf.husky import add_husky, center_of_mass, set_options
from twin.mjcf.skid import coulomb_track_ratio
from twin.robot import REAR_HEAVY, TRACK, WHEEL_RADIUS, WHEEL_WIDTH, WHEELBASE, WHEELS, HuskyParams, PixelCamera

_MASS = 56.582  # [kg]
_GRAVITY = 9.81
_PARAMS = HuskyParams()
_SIDE = np.array([-1.0, 1.0, -1.0, 1.0]) / 2  # right minus left, mean of front and rear


def plane(params: HuskyParams | None = None, edit=None) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    set_options(spec)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1))
    add_husky(spec, params=params)
    if edit is not None:
        edit(spec)
    return spec.compile()


@dataclass
class Steady:
    """Per small step after the start-up: what the tests look at."""

    model: mujoco.MjModel
    data: mujoco.MjData
    wheel: np.ndarray  # [rad/s] (n, 4)
    yaw_rate: np.ndarray  # [rad/s] (n,)
    position: np.ndarray  # [m] (n, 3)
    yaw: np.ndarray  # [rad] (n,)
    torque: np.ndarray  # [N m] (n, 4)
    lift: np.ndarray  # vertical acceleration of the camera [m/s²] (n - 1,)
    loaded: np.ndarray  # wheels in contact (n,)
    friction_power: np.ndarray  # [W] (n,)

    @property
    def chi(self) -> float:
        return float((self.wheel @ _SIDE * WHEEL_RADIUS).mean() / (self.yaw_rate.mean() * TRACK))

    @property
    def power(self) -> np.ndarray:
        return (self.torque * self.wheel[:, :2]).sum(1)


def drive(model: mujoco.MjModel, v: float, yaw_rate: float, start: float = 1.5, seconds: float = 1.5) -> Steady:
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 250)
    dofs = [model.joint(f"{name}_wheel").dofadr[0] for name in WHEELS]
    tyres = [model.geom(f"{name}_tyre").id for name in WHEELS]
    ground, camera = model.geom("ground").id, model.camera("front").id
    carried_out = np.zeros(2)
    rows, camera_z = [], []
    per_control = round(CONTROL_PERIOD / model.opt.timestep)
    for k in range(round((start + seconds) / CONTROL_PERIOD)):
        carried_out = limited_command(np.array([v, yaw_rate]), carried_out, _PARAMS)
        data.ctrl[:] = wheel_speeds(carried_out, _PARAMS)
        for _ in range(per_control):
            mujoco.mj_step(model, data)
            if k * CONTROL_PERIOD < start - 1e-9:
                continue
            camera_z.append(data.cam_xpos[camera, 2])
            loaded = {int(g) for pair in data.contact.geom if ground in pair for g in pair} & set(tyres)
            rows.append(
                (
                    data.qvel[dofs].copy(),
                    data.qvel[5],
                    data.qpos[:3].copy(),
                    yaw_of(data),
                    data.actuator_force.copy(),
                    len(loaded),
                    contact_power(model, data),
                )
            )
    wheel, rate, position, yaw, torque, loaded_count, power = (np.array(column) for column in zip(*rows, strict=True))
    lift = np.diff(camera_z, 2) / model.opt.timestep**2
    return Steady(model, data, wheel, rate, position, np.unwrap(yaw), torque, lift, loaded_count, power)


def yaw_of(data: mujoco.MjData) -> float:
    matrix = data.body("base_link").xmat
    return float(np.arctan2(matrix[3], matrix[0]))


def contact_power(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """What all contacts dissipate by sliding and rolling: Σ −(force · slip + moment · spin), no normal part [W]."""
    total, wrench, velocity = 0.0, np.zeros(6), np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(model, data, i, wrench)
        body = model.geom_bodyid[contact.geom[1]]  # the ground is geom 0, so the wheel is the second
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        frame = contact.frame.reshape(3, 3)
        slip = frame @ (velocity[3:] + np.cross(velocity[:3], contact.pos - data.xpos[body]))
        spin = frame @ velocity[:3]
        total -= wrench[1:3] @ slip[1:] + wrench[3:] @ spin
    return total


@pytest.fixture(scope="module")
def point_turn() -> Steady:
    return drive(plane(), 0.0, 1.0)


def test_nothing_but_wheels_drives_it():
    model = plane()
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_FREE] + [mujoco.mjtJoint.mjJNT_HINGE] * 4
    assert model.nu == 2
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moment = np.zeros((2, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    assert not moment[:, :6].any()
    np.testing.assert_allclose(moment[:, 6:], [[0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])
    assert model.nmocap == 0
    assert (model.eq_type == mujoco.mjtEq.mjEQ_JOINT).all()  # the two belts
    assert model.actuator_forcelimited.all()
    assert model.body_gravcomp.max() == 0 and model.opt.enableflags == 0 and model.opt.disableflags == 0


def test_masses_and_measures():
    model = plane()
    assert model.body_mass.sum() == pytest.approx(_MASS, rel=1e-3)
    assert model.body("base_link").mass[0] == pytest.approx(46.034)
    hubs = np.array([model.body(f"{name}_wheel").pos for name in WHEELS])
    assert np.ptp(hubs[:, 0]) == pytest.approx(0.512) and np.ptp(hubs[:, 1]) == pytest.approx(0.5708)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in WHEELS:  # balanced: the centre of mass is on the axle, in the middle of the tyre
        np.testing.assert_allclose(data.body(f"{name}_wheel").xipos, data.geom(f"{name}_tyre").xpos, atol=1e-9)
    np.testing.assert_allclose(
        data.body("base_link").subtree_com - data.body("base_link").xpos, center_of_mass(HuskyParams())
    )
    np.testing.assert_allclose(model.geom("front_left_tyre").size, [0.1651, 0.1143 / 2, 0.1651])
    payload = plane(HuskyParams(payload_mass=10.0, payload_position=(0.2, 0.0, 0.4)))
    assert payload.body_mass.sum() == pytest.approx(_MASS + 10.0, rel=1e-3)


def test_published_inertia_survives():
    model = plane()
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body("base_link").iquat)
    rotation = rotation.reshape(3, 3)
    tensor = rotation @ np.diag(model.body("base_link").inertia) @ rotation.T
    expected = [[0.6022, -0.02364, -0.1197], [-0.02364, 1.7386, -0.001544], [-0.1197, -0.001544, 2.0296]]
    np.testing.assert_allclose(tensor, expected, atol=1e-6)


def test_looks_weigh_and_touch_nothing():
    model = plane()
    looks = model.geom_group == 1
    assert looks.sum() > 20
    assert not model.geom_contype[looks].any() and not model.geom_conaffinity[looks].any()


def test_coulomb_reference():
    assert coulomb_track_ratio(np.zeros(2)) == pytest.approx(1 + (WHEELBASE / TRACK) ** 2, rel=1e-6)
    rear = coulomb_track_ratio(np.array([-0.07, 0.0]))
    assert rear == pytest.approx(coulomb_track_ratio(np.array([0.07, 0.0])), rel=1e-6)
    assert rear < 1.6


@pytest.mark.parametrize("yaw_rate", [0.3, 1.0, 1.8])
def test_track_ratio_centred(yaw_rate):
    turn = drive(plane(), 0.0, yaw_rate, seconds=1.0)
    assert turn.chi == pytest.approx(coulomb_track_ratio(center_of_mass(HuskyParams())), rel=0.03)
    assert turn.lift.std() < 0.2  # no hop
    assert (turn.loaded == 4).mean() >= 0.999


@pytest.mark.parametrize("yaw_rate", [0.3, 1.0, 1.8])
def test_track_ratio_rear_heavy(yaw_rate):
    params = HuskyParams(center_of_mass=REAR_HEAVY)
    turn = drive(plane(params), 0.0, yaw_rate, start=3.0, seconds=1.0)
    assert turn.chi == pytest.approx(coulomb_track_ratio(center_of_mass(params)), rel=0.10)


def test_track_ratio_knows_no_friction_coefficient(point_turn):
    ratios = [point_turn.chi] + [drive(plane(HuskyParams(friction=mu)), 0.0, 1.0).chi for mu in (0.35, 1.0)]
    assert np.ptp(ratios) / np.mean(ratios) <= 0.02


@pytest.mark.parametrize("radius", [0.5, 1.0, 2.0])
def test_track_ratio_on_arcs(radius, point_turn):
    speed = 0.4
    arc = drive(plane(), speed, speed / radius)
    assert arc.chi == pytest.approx(point_turn.chi, rel=0.03)


def test_no_hop_on_rough_asphalt():
    """Flutter takes seconds to build up; the longest, fastest, grippiest turn is where it would show."""
    turn = drive(plane(HuskyParams(friction=1.0)), 0.0, 1.8, start=6.0, seconds=1.0)
    assert turn.lift.std() < 0.2
    assert turn.chi == pytest.approx(coulomb_track_ratio(np.zeros(2)), rel=0.02)


def test_scrubbing_torque(point_turn):
    expected = 0.7 * _MASS * _GRAVITY / 4 * WHEEL_RADIUS * np.sin(np.arctan(WHEELBASE / TRACK))
    assert 0.95 <= np.abs(point_turn.torque).mean() / 2 / expected <= 1.05


def test_power_balance(point_turn):
    assert (point_turn.power > 0).all()
    assert 0.97 <= point_turn.power.mean() / point_turn.friction_power.mean() <= 1.05


def test_point_turn_stays_on_the_point():
    turn = drive(plane(), 0.0, 1.0, start=0.1, seconds=3.0)
    assert np.linalg.norm(turn.position[-1, :2] - turn.position[0, :2]) <= 0.005


def test_straight_line():
    run = drive(plane(), 1.0, 0.0, start=1.0, seconds=10.0)
    assert abs(run.position[-1, 1] - run.position[0, 1]) <= 0.02
    assert abs(np.rad2deg(run.yaw[-1] - run.yaw[0])) <= 0.3
    speed = (run.position[-1, 0] - run.position[0, 0]) / (len(run.position) - 1) / run.model.opt.timestep
    rolled = run.wheel.mean() * WHEEL_RADIUS
    assert 0.0 <= 1 - speed / rolled <= 0.02
    assert speed <= 1.0 and rolled <= 1.0
    expected = HuskyParams().rolling_resistance * _MASS * _GRAVITY * speed
    assert run.power.mean() == pytest.approx(expected, rel=0.10)


def test_braking():
    model = plane()
    moving = drive(model, 1.0, 0.0, start=1.0, seconds=0.2)
    qpos, qvel = moving.data.qpos.copy(), moving.data.qvel.copy()

    def distance(command_per_control) -> float:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        for command in command_per_control:
            data.ctrl[:] = wheel_speeds(command, _PARAMS)
            mujoco.mj_step(model, data, 50)
        assert abs(data.qvel[0]) < 0.01
        return float(data.qpos[0] - qpos[0])

    ramp, carried_out = [], np.array([1.0, 0.0])
    for _ in range(10):
        carried_out = limited_command(np.zeros(2), carried_out, _PARAMS)
        ramp.append(carried_out)
    assert 0.12 <= distance(ramp) <= 0.20
    assert 0.065 <= distance([np.zeros(2)] * 10) <= 0.13


def test_yaw_rate_does_not_overshoot():
    turn = drive(plane(), 0.0, 1.0, start=0.0, seconds=2.0)
    assert turn.yaw_rate.max() <= 1.10 * turn.yaw_rate[-250:].mean()


def test_limits():
    assert limited_command(np.array([5.0, -9.0]), np.array([1.0, -2.0]), _PARAMS).tolist() == [1.0, -2.0]
    np.testing.assert_allclose(limited_command(np.array([1.0, 2.0]), np.zeros(2), _PARAMS), [0.3, 0.6])
    fast = wheel_speeds(np.array([1.0, 1.0]), _PARAMS) * WHEEL_RADIUS
    assert np.abs(fast).max() == pytest.approx(1.0)
    # Scaled alike: the curve stays the same.
    slow = wheel_speeds(np.array([0.1, 0.1]), _PARAMS) * WHEEL_RADIUS
    np.testing.assert_allclose(fast / fast.max(), slow / slow.max())
    yaw_rate = np.abs(wheel_speeds(np.array([0.0, 2.0]), _PARAMS)).max() * WHEEL_RADIUS / (1.875 * TRACK / 2)
    assert yaw_rate == pytest.approx(1.87, abs=0.01)


def test_half_the_time_step_changes_nothing(point_turn):
    def halve(spec: mujoco.MjSpec) -> None:
        spec.option.timestep = husky.TIMESTEP / 2

    fine = drive(plane(edit=halve), 0.0, 1.0)
    assert fine.chi == pytest.approx(point_turn.chi, rel=0.01)
    assert fine.power.mean() == pytest.approx(point_turn.power.mean(), rel=0.01)


def test_default_contacts_would_hop():
    """Negative control: the checks above can fail."""

    def defaults(spec: mujoco.MjSpec) -> None:
        for name in WHEELS:
            spec.geom(f"{name}_tyre").solimp = (0.9, 0.95, 0.001, 0.5, 2.0)

    assert drive(plane(edit=defaults), 0.0, 1.0, seconds=0.5).lift.std() > 2.0


def test_pyramidal_cone_would_need_too_little_torque(point_turn):
    def pyramid(spec: mujoco.MjSpec) -> None:
        spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL

    weak = drive(plane(edit=pyramid), 0.0, 1.0)
    assert np.abs(weak.torque).mean() < 0.9 * np.abs(point_turn.torque).mean()


def test_front_camera_has_the_given_intrinsics():
    """MuJoCo's own frustum (no OpenGL needed) against fx ≠ fy and an off-centre principal point, through the XML."""
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


def test_tyre_mesh_has_the_wheel_s_size():
    model = plane()
    mesh = model.geom("front_left_tyre").size
    assert mesh[1] * 2 == pytest.approx(WHEEL_WIDTH)
    tyre = model.mesh("husky_left_tyre")
    vertices = model.mesh_vert[tyre.vertadr[0] : tyre.vertadr[0] + tyre.vertnum[0]]
    extent = np.sort(np.ptp(vertices, axis=0))
    np.testing.assert_allclose(extent, [WHEEL_WIDTH, 2 * WHEEL_RADIUS, 2 * WHEEL_RADIUS], rtol=0.02)
