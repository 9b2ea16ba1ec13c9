"""Obstacles: poses, motion, and contact in MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from twin.config import OBSTACLE_KINDS, ObstacleConfig
from twin.config_file import load_config
from twin.env import obstacles as module
from twin.env.obstacles import (
    ObstacleMotion,
    add_obstacles,
    ground_height,
    obstacle_pose,
    place,
    random_distractors,
    random_obstacles,
)
from twin.env.physics import HuskyPhysics
from twin.errors import InputError
from twin.geometry.polyline import arc_lengths, nearest_on_route
from twin.mjcf.husky import add_husky, set_options
from twin.mjcf.world import World

ANGLE = np.linspace(0, np.pi / 2, 60)
BEND = np.concatenate(
    [
        np.column_stack([np.arange(0, 10, 0.2), np.zeros(50)]),
        np.column_stack([10 + 9 * np.sin(ANGLE), 9 - 9 * np.cos(ANGLE)]),
    ]
)
ROUTE = np.column_stack([BEND, 0.02 * BEND[:, 0]])


@pytest.fixture
def world(tmp_path):
    return World(ROUTE, 1.0, (0, 0, 0, 0), tmp_path)


def flat_spec(slope: float = 0.02) -> mujoco.MjSpec:
    """A height field that rises with x, and a Husky at the origin."""
    spec = mujoco.MjSpec()
    set_options(spec)
    field = spec.add_hfield(name="ground", nrow=21, ncol=41, size=(20.0, 10.0, 40.0 * slope, 1.0))
    field.userdata = np.tile(np.linspace(0, 1, 41), 21)
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=(10.0, 0.0, -10.0 * slope)
    )
    add_husky(spec)
    return spec


def test_obstacle_pose_is_on_the_ground(world):
    told = (ObstacleConfig("a", "cone", 12.0, -0.5), ObstacleConfig("b", "box", 3.0, 1.5, yaw=30.0))
    spec = flat_spec()
    add_obstacles(spec, told, world)
    model = spec.compile()
    data = mujoco.MjData(model)
    place(told, data, 0.0)
    mujoco.mj_forward(model, data)
    for one, name in zip(told, ("obstacle_a", "obstacle_b"), strict=True):
        position = data.body(name).xpos
        s, lateral = nearest_on_route(ROUTE, position[:2])
        assert (s, lateral) == (pytest.approx(one.station, abs=0.02), pytest.approx(one.lateral, abs=0.02))
        assert position[2] == pytest.approx(0.02 * position[0], abs=0.02)
    assert data.body("obstacle_b").xmat.reshape(3, 3)[1, 0] == pytest.approx(np.sin(np.deg2rad(30)), abs=1e-3)


def test_the_ground_is_as_high_as_a_ray_finds_it(world):
    model = flat_spec(0.05).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for x, y in ((3.3, 1.7), (12.01, -2.2), (-4.0, 0.5)):
        geom = np.zeros(1, np.int32)
        only_ground = np.array([1, 0, 0, 0, 0, 0], np.uint8)
        drop = mujoco.mj_ray(model, data, np.array([x, y, 50.0]), np.array([0, 0, -1.0]), only_ground, 1, -1, geom)
        assert ground_height(model, x, y) == pytest.approx(50.0 - drop, abs=1e-5)


def test_moving_obstacle_returns_at_its_speed():
    across = ObstacleConfig("p", "pedestrian", 5.0, -2.0, to=(5.0, 2.0), speed=1.25, delay=0.4)
    poses = np.array([obstacle_pose(across, ROUTE, t) for t in np.arange(0.0, 8.0, 0.1)])
    assert np.abs(poses[:, 0] - 5.0).max() < 0.01
    assert poses[0, 1] == pytest.approx(-1.5) and poses[:, 1].max() <= 2.0 and poses[:, 1].min() >= -2.0
    steps = np.abs(np.diff(poses[:, 1]))
    assert np.median(steps) == pytest.approx(0.125) and steps.max() < 0.126
    facing = np.sign(np.diff(poses[:, 1]))
    assert np.allclose(np.sin(poses[:-1, 2])[steps > 0.12], facing[steps > 0.12], atol=1e-6)
    along = ObstacleConfig("c", "cyclist", 2.0, 0.5, to=(20.0, 0.5), speed=4.0)
    x, y, yaw = obstacle_pose(along, ROUTE, 3.0)
    s, lateral = nearest_on_route(ROUTE, np.array([x, y]))
    assert (s, lateral) == (pytest.approx(14.0, abs=0.05), pytest.approx(0.5, abs=0.05))
    assert yaw == pytest.approx((14.0 - 10.0) / 9.0, abs=0.1)  # it faces along the bend


def test_a_negative_delay_makes_no_jump():
    late = ObstacleConfig("p", "pedestrian", 5.0, -2.0, to=(5.0, 2.0), speed=1.25, delay=-7.3)
    lateral = np.array([obstacle_pose(late, ROUTE, t)[1] for t in np.arange(0.0, 12.0, 0.1)])
    assert np.abs(np.diff(lateral)).max() < 0.126
    assert lateral[73] == pytest.approx(-2.0)


@pytest.mark.parametrize("kind", OBSTACLE_KINDS)
def test_every_kind_stands_on_the_ground_and_is_bumped_into(world, kind):
    told = (ObstacleConfig("it", kind, 6.0, 0.0, yaw=90.0),)
    spec = flat_spec(1e-6)
    add_obstacles(spec, told, world)
    model = spec.compile()
    data = mujoco.MjData(model)
    place(told, data, 0.0)
    mujoco.mj_forward(model, data)
    mine = [i for i in range(model.ngeom) if model.body_rootid[model.geom_bodyid[i]] == model.body("obstacle_it").id]
    drawn = [i for i in mine if model.geom_group[i] == 5]
    assert drawn and all(model.geom(i).name.startswith("obstacle_it") or model.geom(i).name == "" for i in mine)
    corners = np.concatenate([_corners(model, data, i) for i in drawn])
    assert -0.06 < corners[:, 2].min() < 0.05
    assert np.linalg.norm(corners[:, :2] - [6.0, 0.0], axis=1).max() < module.RADIUS[kind] + 0.35
    # Drive the robot into it.
    data.qpos[0] = 6.0 - 0.5
    mujoco.mj_forward(model, data)
    touching = {model.geom(int(g)).name for pair in data.contact.geom for g in pair}
    assert any(name.startswith("obstacle_it") for name in touching)


def _corners(model, data, i) -> np.ndarray:
    center, half = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return data.geom_xpos[i] + (center + signs * half) @ data.geom_xmat[i].reshape(3, 3).T


def test_a_start_inside_an_obstacle_is_a_contact_although_it_pushes_the_robot_away(world):
    told = (ObstacleConfig("it", "box", 6.0, 0.3),)
    spec = flat_spec(1e-6)
    add_obstacles(spec, told, world)
    robot = HuskyPhysics(spec.compile())
    robot.move_obstacles = ObstacleMotion(told, robot.data)
    for x in np.arange(5.6, 6.45, 0.1):
        robot.set_pose(float(x), 0.0, 0.0)
        assert robot.touched_geoms, x
    robot.set_pose(3.0, 0.0, 0.0)
    assert not robot.touched_geoms


def test_only_what_moves_is_moved(world, monkeypatch):
    told = (ObstacleConfig("still", "cone", 3.0, 1.5), ObstacleConfig("walks", "pedestrian", 6.0, -1.0, to=(6.0, 1.0)))
    spec = flat_spec()
    add_obstacles(spec, told, world)
    model = spec.compile()
    data, alone = mujoco.MjData(model), mujoco.MjData(model)
    motion, found = ObstacleMotion(told, data), []
    monkeypatch.setattr(
        module, "obstacle_pose", lambda one, *rest: (found.append(one.name), obstacle_pose(one, *rest))[1]
    )
    for time in (0.0, 0.4, 1.7, 0.0, 0.9):
        found.clear()
        motion(time)
        assert found == (["walks"] if time else ["still", "walks"])
        place(told, alone, time)
        assert np.array_equal(data.mocap_pos, alone.mocap_pos) and np.array_equal(data.mocap_quat, alone.mocap_quat)
    late = ObstacleMotion(told, mujoco.MjData(model))  # as after an obstacle was dragged during a drive
    late(0.9)
    assert np.array_equal(late._data.mocap_pos, data.mocap_pos)


def test_unused_obstacles_are_parked(world):
    pool = (ObstacleConfig("a", "cone", 3.0), ObstacleConfig("b", "cone", 4.0))
    spec = flat_spec()
    add_obstacles(spec, pool, world)
    model = spec.compile()
    data = mujoco.MjData(model)
    place(pool[1:], data, 0.0)
    mujoco.mj_forward(model, data)
    assert data.body("obstacle_a").xpos[2] < -50.0 < data.body("obstacle_b").xpos[2]
    with pytest.raises(InputError, match="no obstacle_c"):
        place((ObstacleConfig("c", "cone"),), data, 0.0)


def test_random_obstacles_leave_room_and_repeat(world):
    drawn = random_obstacles(world, np.random.default_rng(3), 4)
    assert drawn == random_obstacles(world, np.random.default_rng(3), 4)
    assert drawn != random_obstacles(world, np.random.default_rng(4), 4)
    for seed in range(40):
        many = random_obstacles(world, np.random.default_rng(seed), 4)
        stations = np.array([one.station for one in many])
        assert (
            (np.diff(stations) > 3.0).all() and stations.min() >= 4.0 and stations.max() <= arc_lengths(ROUTE)[-1] - 3.0
        )
        for one in many:
            assert abs(one.lateral) + world.half_width - module.RADIUS[one.kind] > 0.34
    with pytest.raises(InputError, match="at most"):
        random_obstacles(world, np.random.default_rng(0), 500)


def test_distractors_are_out_of_reach_of_the_corridor(world):
    bend = np.linspace(0.0, np.pi, 60)
    tight = np.column_stack([3.0 * np.sin(bend), 3.0 - 3.0 * np.cos(bend), 0.0 * bend])  # the inside has no room
    for route in (world.route, tight):
        there = replace(world, route=route)
        drawn = random_distractors(there, np.random.default_rng(3), 6)
        assert (
            drawn
            == random_distractors(there, np.random.default_rng(3), 6)
            != random_distractors(there, np.random.default_rng(4), 6)
        )
        for seed in range(40):
            for one in random_distractors(there, np.random.default_rng(seed), 6):
                x, y, _ = module.obstacle_pose(one, route, 0.0)
                free = np.hypot(*(route[:, :2] - (x, y)).T).min() - module.RADIUS[one.kind]
                assert there.half_width + 0.6 <= free + 1e-9 and free < there.half_width + 3.2


def test_obstacles_of_scene_toml(tmp_path):
    path = tmp_path / "scene.toml"
    head = '[[source]]\npath = "a.mp4"\n[metric]\ncamera_height = 1.2\n'
    path.write_text(head + '[[obstacle]]\nkind = "pedestrian"\nstation = 12\nlateral = -2.5\nto = [12.0, 2.5]\n')
    (one,) = load_config(path).obstacle
    assert one == ObstacleConfig(kind="pedestrian", station=12.0, lateral=-2.5, to=(12.0, 2.5))
    for wrong, told in (
        ('kind = "kone"', "did you mean 'cone'"),
        ('kind = "cone"\nto = [3.0]', "expected station and lateral"),
        ('kind = "cone"\nlatteral = 1.0', "did you mean 'lateral'"),
        ('kind = "box"\nsize = [1.0, 0.0, 1.0]', "length, width, height"),
        ('kind = "cone"\nname = "a"\n[[obstacle]]\nkind = "cone"\nname = "a"', "named 'a'"),
    ):
        path.write_text(head + "[[obstacle]]\n" + wrong + "\n")
        with pytest.raises(InputError, match=told):
            load_config(path)


def test_obstacles_made_in_python_are_checked_like_those_of_scene_toml(world):
    for wrong, words in (
        ({"to": (3.0,)}, "expected station and lateral"),
        ({"kind": "box", "size": (1.0, 2.0)}, "expected length, width, height"),
        ({"color": (200.0, 0.0, 0.0)}, "expected values from 0 to 1"),
        ({"station": float("nan")}, "expected finite numbers"),
    ):
        with pytest.raises(InputError, match=words):
            add_obstacles(flat_spec(), (ObstacleConfig(**({"kind": "cone"} | wrong)),), world)
