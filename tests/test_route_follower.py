"""The Husky driven by commands and by the scripted follower in a small made-up scene, and the pictures of that."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from acceptance import REAR_HEAVY
from tiny_world import export, tiny_config, tiny_scene, tiny_world

from twin.env import mujoco_renderer
from twin.env.drivers import follow_route, pursuit_curvature
from twin.env.mujoco_renderer import NOTHING, ON_GROUND, CollisionCaster, SceneCamera, blend_parts, chase_poses
from twin.env.physics import HuskyPhysics
from twin.geometry.cameras import pixel_grid, project, unproject
from twin.geometry.poses import inverse_pose, look_at
from twin.mjcf.husky import add_husky, set_options
from twin.mjcf.world import GROUND_GROUP, PART_GROUP, World
from twin.report.video_writer import frame_indices
from twin.robot import HuskyParams


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> World:
    return tiny_world(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def drive(world):
    return follow_route(world, HuskyPhysics(world.model(), world.robot))


def on_a_plane(params: HuskyParams | None = None) -> HuskyPhysics:
    spec = mujoco.MjSpec()
    set_options(spec, params)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1))
    add_husky(spec, params=params)
    return HuskyPhysics(spec.compile(), params)


def test_reaches_the_goal(world, drive):
    assert drive.outcome == "goal" and drive.reached_goal
    assert drive.touched == ()
    assert drive.max_cross_track < 0.15
    assert np.linalg.norm(drive.base_to_world[-1, :2, 3] - world.goal[:2]) < 1.0
    assert np.all(np.diff(drive.times) > 0.0999)
    assert drive.progress[-1] > drive.progress[0]


def test_record_is_consistent(world, drive):
    """Poses belong to the recorded qpos, and the camera is fixed to the base."""
    k = len(drive.times)
    assert drive.qpos.shape == (k, 11) and drive.camera_to_world.shape == (k, 4, 4) and drive.commands.shape == (k, 2)
    np.testing.assert_allclose(drive.base_to_world[:, :3, 3], drive.qpos[:, :3], atol=1e-9)
    mount = inverse_pose(drive.base_to_world) @ drive.camera_to_world
    np.testing.assert_allclose(mount, np.broadcast_to(mount[0], mount.shape), atol=1e-9)
    np.testing.assert_allclose(mount[0, :3, 3], HuskyParams().camera_position, atol=1e-6)


def test_front_camera_looks_ahead_and_upright(drive):
    """OpenCV axes: a point on the road ahead is in the picture, left of the road is left, the near road is low."""
    intrinsics = np.array([80.0, 80.0, 80.0, 45.0])
    base = drive.base_to_world[0]
    ahead, left, near = (base[:3, :3] @ np.array(p) + base[:3, 3] for p in ([6, 0, 0], [6, 1, 0], [1.5, 0, -0.1]))
    pixels, depth = project(np.array([ahead, left, near]), drive.camera_to_world[0], intrinsics)
    assert (depth > 0).all()
    assert abs(pixels[0, 0] - 80) < 1 and pixels[1, 0] < pixels[0, 0] and pixels[2, 1] > pixels[0, 1]


def test_the_same_drive_repeats_exactly(world, drive):
    again = follow_route(world, HuskyPhysics(world.model(), world.robot))
    np.testing.assert_array_equal(again.qpos, drive.qpos)


def test_rear_heavy_robot_is_followed_too(tmp_path):
    """Its yaw rate is 1.3 times the commanded one; heading feedback must compensate for that."""
    config = replace(tiny_config(), robot=HuskyParams(center_of_mass=REAR_HEAVY))
    world = World.load(export(tiny_scene(tmp_path), config)[0])
    assert world.robot.center_of_mass == REAR_HEAVY
    assert world.model().body("base_link").ipos[0] == pytest.approx(-0.085)
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot))
    assert drive.reached_goal and drive.max_cross_track < 0.2


def test_an_obstacle_on_the_road_ends_the_drive(tmp_path):
    world = World.load(export(tiny_scene(tmp_path, boxes=((4.0, -3.0, 0.8), (3.5, 0.1, 0.8))))[0])
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot))
    assert drive.outcome == "touched" and drive.touched == ("part_0001",)
    # The bumper of the chassis is 0.49 m ahead of the base, the box begins at 3.2 m.
    assert drive.base_to_world[-1, 0, 3] == pytest.approx(3.2 - 0.4937, abs=0.12)


def test_leaving_the_corridor_ends_the_drive(world):
    narrow = replace(world, half_width=0.002)
    drive = follow_route(narrow, HuskyPhysics(world.model(), world.robot))
    assert drive.outcome == "off_corridor" and drive.max_cross_track > 0.002


def test_the_time_limit_ends_the_drive(world):
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), timeout=1.0)
    assert drive.outcome == "timeout" and drive.times[-1] == pytest.approx(1.1, abs=0.11)


def test_pursuit_circle_passes_the_target():
    assert pursuit_curvature(np.zeros(3), np.array([2.0, 0.0])) == 0.0
    # A quarter circle to the left of radius 3 ends at (3, 3).
    assert pursuit_curvature(np.zeros(3), np.array([3.0, 3.0])) == pytest.approx(1 / 3)
    turned = np.array([1.0, 2.0, np.pi / 2])
    assert pursuit_curvature(turned, np.array([1.0 + 3.0, 2.0 + 3.0])) == pytest.approx(-1 / 3)


def test_a_command_expires():
    physics = on_a_plane()
    physics.command(1.0, 0.0)
    speeds = []
    for _ in range(12):
        physics.step()
        speeds.append(physics.data.qvel[6:].mean() * 0.1651)
    assert max(speeds) > 0.5 and abs(speeds[-1]) < 0.02


def test_speed_and_acceleration_stay_within_their_limits():
    physics = on_a_plane()
    for _ in range(5):
        physics.step()
    speeds = []
    for _ in range(15):
        physics.command(3.0, 0.0)
        physics.step()
        speeds.append(float(physics.data.qvel[0]))
    assert max(speeds) <= 1.0
    assert max(np.diff([0.0, *speeds])) <= 3.0 * 0.1 * 1.1
    assert speeds[-1] > 0.97


def test_every_touch_is_seen_once_and_named():
    spec = mujoco.MjSpec()
    set_options(spec)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1))
    spec.worldbody.add_geom(name="pole", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(0.05, 0.5, 0), pos=(1.2, 0.1, 0.5))
    add_husky(spec)
    physics = HuskyPhysics(spec.compile())
    seen = []
    for _ in range(15):
        physics.command(0.8, 0.0)
        physics.step()
        seen.append(physics.touched)
    assert seen[0] == () and ("pole",) in seen
    physics.reset()
    assert physics.touched == () and physics.time == 0.0


def test_hidden_parts_are_not_blended():
    rgb = np.full((4, 6, 3), 100, np.uint8)
    part = np.full((4, 6, 3), 200, np.uint8)
    depth = np.full((4, 6), 5.0)
    identity = np.full((4, 6), -1)
    identity[:, 2:4], identity[:, 4:] = 7, 8
    part_depth = np.where(np.arange(6) < 4, 4.0, 9.0) * np.ones((4, 1))
    out = blend_parts(rgb, depth, part, part_depth, identity)
    assert (out[:, :2] == 100).all() and (out[:, 4:] == 100).all()  # nothing there, or behind the wall
    assert (out[:, 3] > 100).all()
    assert (out[1:, 2] < out[1:, 3]).all()  # the outline is dark


def test_parts_in_several_models_are_hit_as_in_one(world, monkeypatch):
    """Each ray tells the nearest part's own number, wherever it is; numbers, depths and colors do not depend on it."""
    model = world.model()
    parts = np.flatnonzero(model.geom_group == PART_GROUP)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    middle = data.geom_xpos[parts].mean(0)
    pose, intrinsics = look_at(middle + np.array([-6.0, 0.0, 2.0]), middle), np.array([60.0, 60.0, 40.0, 22.5])
    one = CollisionCaster(world, (80, 45), intrinsics, ground=True)
    monkeypatch.setattr(mujoco_renderer, "_PARTS_PER_MODEL", 1)
    several = CollisionCaster(world, (80, 45), intrinsics, ground=True)
    assert len(several._casters) == len(parts) == one.count > 1 and len(one._casters) == 1
    for found, expected in zip(several.cast(pose), one.cast(pose), strict=True):
        np.testing.assert_array_equal(found, expected)
    _, depth, hit = one.cast(pose)
    assert set(np.unique(hit)) == {NOTHING, ON_GROUND, *range(len(parts))}
    rays, geom = unproject(pixel_grid(80, 45), intrinsics) @ pose[:3, :3].T, np.zeros(1, np.int32)
    groups = np.isin(np.arange(6), (GROUND_GROUP, PART_GROUP)).astype(np.uint8)
    agree = []
    for v, u in np.ndindex(hit.shape):
        mujoco.mj_ray(model, data, pose[:3, 3], rays[v, u], groups, True, -1, geom)
        known = {-1: NOTHING} | {part: number for number, part in enumerate(parts)}
        agree.append(known.get(int(geom[0]), ON_GROUND) == hit[v, u])
    assert np.mean(agree) > 0.99  # but for borders
    assert ((depth > 0.0) == (hit != NOTHING)).all()
    bare = CollisionCaster(world, (80, 45), intrinsics).cast(pose)[2]
    assert ON_GROUND not in bare and (bare[hit >= 0] == hit[hit >= 0]).all()


def test_an_open_place_is_drawn_and_hit(tmp_path):
    """A scene without any convex part."""
    scene = tiny_scene(tmp_path, boxes=())
    export(scene)
    bare = World.load(scene.stage("mjcf"))
    camera = SceneCamera(bare, (80, 45))
    assert np.ptp(camera.render(camera.data.qpos, look_at(np.array([0.0, 3.0, 1.5]), np.zeros(3)))) > 20
    intrinsics, pose = np.array([60.0, 60.0, 40.0, 22.5]), look_at(np.array([0.0, 0.0, 1.5]), np.array([3.0, 0.0, 0.0]))
    assert set(np.unique(CollisionCaster(bare, (80, 45), intrinsics, ground=True).cast(pose)[2])) == {
        ON_GROUND,
        NOTHING,
    }
    assert (CollisionCaster(bare, (80, 45), intrinsics).cast(pose)[2] == NOTHING).all()


def test_chase_camera_is_behind_and_sees_the_robot(drive):
    poses = chase_poses(drive.base_to_world)
    behind = inverse_pose(drive.base_to_world) @ poses[:, :, 3:]
    assert (behind[:, 0, 0] < -1.5).all() and (behind[:, 2, 0] > 1.0).all()
    for pose, base in zip(poses[::10], drive.base_to_world[::10], strict=True):
        pixel, depth = project(base[:3, 3], pose, np.array([300.0, 300.0, 160.0, 90.0]))
        assert depth > 1.0 and 100 < pixel[0] < 220 and 90 < pixel[1] < 180


def test_frame_indices_include_the_last():
    assert frame_indices(10, 3) == [0, 3, 6, 9]
    assert frame_indices(11, 3) == [0, 3, 6, 9, 10]


@pytest.mark.slow
def test_pictures_show_robot_ground_and_parts(world, drive):
    """The renderer draws robot, ground and parts where they are. Slow: its kernels compile on first use."""
    camera, poses = SceneCamera(world, (160, 90)), chase_poses(drive.base_to_world)
    frames = [camera.render(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), 40)]
    assert all(frame.shape == (90, 160, 3) and frame.dtype == np.uint8 for frame in frames)
    yellow = [((f[..., 0] > 120) & (f[..., 1] > 80) & (f[..., 2] < 60)).sum() for f in frames]
    assert min(yellow) > 10  # the robot's body
    away = drive.base_to_world[0].copy()
    sky = camera.render(drive.qpos[0], chase_poses(away[None])[0] @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.ptp(sky.reshape(-1, 3), axis=0).max() < 120 and sky[..., 2].mean() > 150


def test_command_latency_delays_the_motion():
    """The drive is the same, later by the latency, which is not a whole number of control steps."""
    latency = 0.14
    prompt, late = on_a_plane(), on_a_plane(HuskyParams(command_latency=latency))
    tracks: dict[HuskyPhysics, list] = {prompt: [], late: []}
    for physics, track in tracks.items():
        for _ in range(5):
            physics.step()
        for _ in range(15):
            physics.command(0.5, 0.4)
            physics.step()
            track.append((physics.time, *physics.planar_pose))
    prompt_track, late_track = (np.array(track) for track in tracks.values())
    for column in (1, 2, 3):
        expected = np.interp(late_track[3:, 0] - latency, prompt_track[:, 0], prompt_track[:, column])
        np.testing.assert_allclose(late_track[3:, column], expected, atol=0.004)


def test_camera_latency_shows_the_past():
    latency = 0.13
    physics = on_a_plane(HuskyParams(camera_latency=latency))
    np.testing.assert_array_equal(physics.delayed_camera_to_world, physics.camera_to_world)
    times, poses = [], []
    for _ in range(25):
        physics.command(0.6, 0.8)
        physics.step()
        times.append(physics.time)
        poses.append(physics.camera_to_world)
    # At constant speeds the camera moves on a circle: between two instants it is where the arc says.
    delayed = physics.delayed_camera_to_world
    share = (times[-1] - latency - times[-3]) / 0.1
    positions = np.array([pose[:3, 3] for pose in poses[-3:]])
    np.testing.assert_allclose(delayed[:3, 3], (1 - share) * positions[0] + share * positions[1], atol=2e-3)
    np.testing.assert_allclose(delayed[:3, :3] @ delayed[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.norm(delayed[:3, 3] - positions[-1]) > 0.05


def test_delayed_poses_belong_to_one_instant():
    """They are exact at contact checks, which are 10 ms apart, and close to the truth between these."""
    latency, step = 0.026, 0.002
    prompt, fine, coarse = on_a_plane(), *(on_a_plane(HuskyParams(camera_latency=latency)) for _ in range(2))
    past = [prompt.data.qpos.copy()]
    for k in range(600):
        for physics, wanted in ((prompt, True), (fine, True), (coarse, k % 50 == 0)):
            if k % 50 == 0:
                physics.command(1.0, 0.5)
            if wanted:
                physics.step(step if physics is not coarse else 50 * step)
        past.append(prompt.data.qpos.copy())
        then = max(0, len(past) - 1 - round(latency / step))
        np.testing.assert_array_equal(fine.delayed_data.qpos, past[then])
        assert fine.delayed_data.time == pytest.approx(step * then, abs=1e-9)
        if k % 50 == 49:
            np.testing.assert_allclose(coarse.delayed_data.qpos, past[then], atol=2e-4)
            assert coarse.delayed_data.time == pytest.approx(step * then, abs=1e-9)
    assert np.linalg.norm(fine.delayed_data.qpos[:2] - fine.data.qpos[:2]) > 0.02
    assert prompt.delayed_data is prompt.data


@pytest.mark.parametrize("latency", [0.03, 0.113])
def test_delayed_poses_of_moving_obstacles(latency):
    spec = mujoco.MjSpec()
    set_options(spec)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(50, 50, 1))
    spec.worldbody.add_body(name="walker", mocap=True).add_geom(size=(0.1, 0.1, 0.1), pos=(0, 0, 1))
    params = HuskyParams(camera_latency=latency)
    add_husky(spec, params=params)
    physics = HuskyPhysics(spec.compile(), params)

    def walk(time: float) -> None:
        physics.data.mocap_pos[0] = 3.0 + 2.0 * time, 1.0, 0.0

    walk(0.0)
    physics.move_obstacles = walk
    physics.begin()
    for k in range(5):
        physics.step()
        time = max(0.0, 0.1 * (k + 1) - latency)
        assert physics.delayed_data.time == pytest.approx(time, abs=1e-9)
        np.testing.assert_allclose(physics.delayed_data.body("walker").xpos, [3.0 + 2.0 * time, 1.0, 0.0])
