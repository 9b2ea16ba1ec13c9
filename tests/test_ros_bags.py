"""Drive logs from bags: wheel speeds of the wheels' odometry, and poses by the pictures that the robot took."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_of_film import START, camera_info, pictures, write
from filmed_wall import views
from ros_bag import write_bag
from test_bag_film import PINHOLE, SHIFTS, TIMES
from tiny_world import tiny_scene

from twin import commands
from twin.assets.ground import Ground
from twin.config import SceneConfig, SourceConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.robot import HuskyParams
from twin.scene import write_stamp
from twin.sysid.camera_extrinsics import camera_pose_on_ground
from twin.sysid.log_files import FilmedPoses, filmed_poses, read_bag
from twin.sysid.logs import relative_poses

ROWS = 200


@pytest.fixture(scope="module")
def table(drive) -> dict[str, np.ndarray]:
    return {name: column[:ROWS] for name, column in drive.items()}


def test_wheel_speeds_of_the_wheels_odometry_are_those_of_the_joints(table, tmp_path: Path) -> None:
    joints = read_bag(write_bag(tmp_path / "joints", table))
    for missing in (("wheels", "arm"), ("wheels",)):  # an arm's joint states say nothing about the wheels
        odometry = read_bag(write_bag(tmp_path / "_".join(missing), table, without=missing))
        for name in ("left_wheel_vel", "right_wheel_vel", "x", "cmd_v"):
            np.testing.assert_allclose(odometry[name], joints[name], atol=1e-9, err_msg=name)


def test_no_wheel_speeds_are_computed_from_a_filter_that_knows_the_imu(table, tmp_path: Path) -> None:
    missing = ("wheels", "arm", "wheel odometry")
    bag = write_bag(tmp_path / "bag", table, without=missing, poses="/odometry/filtered")
    with pytest.raises(InputError, match="no topic with wheels"):
        read_bag(bag, poses="/odometry/filtered")


def test_poses_of_the_wheels_are_refused_and_those_of_pictures_used(table, tmp_path: Path, capsys) -> None:
    bag = write_bag(tmp_path / "bag", table, without=("poses",))
    with pytest.raises(InputError, match=r"no topic with poses .* other than wheel odometry among .*/platform/odom"):
        read_bag(bag)
    assert commands.main("align", ["husky", str(bag), "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    begin = 1_700_000_000 * 10**9 + round(table["time"][0] * 1e9)
    times = begin + (np.arange(0, 10, 0.5) * 1e9).astype(np.int64)
    poses = np.column_stack([np.arange(20.0), np.zeros(20), np.linspace(0, 1, 20)])
    found = read_bag(bag, FilmedPoses(times, poses))
    assert len(found["time"]) == ROWS and "20 poses in the built scene" in capsys.readouterr().err
    np.testing.assert_allclose(found["x"], np.minimum(np.floor((found["time"] + 1e-6) / 0.5), 19))


def test_the_filter_of_wheels_and_imu_is_refused_unless_it_is_asked_for(table, tmp_path: Path, capsys) -> None:
    bag = write_bag(tmp_path / "bag", table, poses="/odometry/filtered")
    with pytest.raises(
        InputError, match=r"no topic with poses .* other than wheel odometry .*--topic names their topic"
    ):
        read_bag(bag)
    np.testing.assert_allclose(read_bag(bag, poses="/odometry/filtered")["x"], table["x"], atol=1e-9)
    assert "poses /odometry/filtered, imu /imu/data" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"no poses on topic /odom; expected one of /platform/odom and /odometry/"):
        read_bag(bag, poses="/odom")


def test_messages_that_are_not_finite_are_left_out(table, tmp_path: Path, capsys) -> None:
    gap = {name: column.copy() for name, column in table.items()}
    gap["x"][100:103] = np.nan
    gap["acceleration_y"][7] = np.nan
    found = read_bag(write_bag(tmp_path / "bag", gap))
    assert len(found["time"]) == ROWS
    np.testing.assert_allclose(found["x"][99:104], table["x"][[99, 99, 99, 99, 103]], atol=1e-9)
    said = capsys.readouterr().err
    assert "3 messages on /icp_odom left out: not finite" in said and "1 messages on /imu/data" in said
    gap["acceleration_y"][:] = np.nan  # the IMU is optional
    assert len(read_bag(write_bag(tmp_path / "no_imu", gap, without=("camera's imu",)))["time"]) == ROWS


def test_a_command_ends_when_the_controller_times_out(table, tmp_path: Path) -> None:
    silent = table["cmd_v"].copy()
    silent[101:140] = np.nan  # two seconds
    found = read_bag(write_bag(tmp_path / "bag", table | {"cmd_v": silent}))
    since = table["time"][101:140] - table["time"][100]
    for name in ("cmd_v", "cmd_yaw_rate"):
        held = np.where(since < 0.51, table[name][100], 0.0)
        np.testing.assert_allclose(found[name][101:140], held, atol=1e-9)
        np.testing.assert_allclose(np.delete(found[name], range(101, 140)), np.delete(table[name], range(101, 140)))


def test_the_poses_of_pictures_are_those_of_the_base_below_the_cameras(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path / "scene")
    robot = HuskyParams(camera_height=0.7, camera_pitch=8.0, camera_yaw=3.0)
    bag = write(tmp_path / "scene/input/drive", [camera_info(PINHOLE), *pictures(views(SHIFTS), TIMES)])
    ground = Ground.load(scene.stage("mesh"))
    bases = np.column_stack([np.linspace(1, 4, 10), np.linspace(0, 0.5, 10), np.linspace(0, 0.4, 10)])
    old = Cameras.load(scene.stage("metric"))
    poses = []
    for x, y, yaw in bases:
        ahead = np.array([np.cos(yaw), np.sin(yaw)]) * robot.camera_offset[0]
        poses.append(camera_pose_on_ground(robot, np.array([x, y]) + ahead, yaw, ground.at))
    times = TIMES[:30:3]
    replace(
        old,
        names=tuple(f"drive/{3 * k:06d}" for k in range(10)),
        camera_to_world=np.array(poses),
        intrinsics=np.tile(old.intrinsics[1], (10, 1)),
        sizes=np.tile(old.sizes[1], (10, 1)),
        lightings=("day",) * 10,
        sources=("drive",) * 10,
        times=times,
        held_out=np.zeros(10, bool),
    ).save(scene.stage("metric"))
    for stage in ("metric", "mesh"):
        write_stamp(scene.stage(stage), stage)
    config = SceneConfig(source=(SourceConfig(path="input/drive", lighting="day"),), robot=robot)
    copy = write(tmp_path / "copy", [camera_info(PINHOLE), *pictures(views(SHIFTS[:10]), TIMES[:10])])
    assert filmed_poses(scene, config, copy) is None  # another bag
    found = filmed_poses(scene, config, bag)
    assert found is not None
    np.testing.assert_array_equal(found.times, START + np.round(times * 1e9).astype(np.int64))
    np.testing.assert_allclose(
        relative_poses(found.poses[None])[0], relative_poses(bases[None])[0], atol=0.03
    )  # the ground is not level
