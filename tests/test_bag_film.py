"""Bags as films: the same frames as pictures, calibration, positions and seat; bad bags get one line."""

import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_of_film import (
    CAMERA_INFO,
    FRAME,
    IMAGE,
    START,
    camera_info,
    drive,
    pictures,
    seat,
    transform,
    write,
    write_ros1,
)
from filmed_wall import HEIGHT, WIDTH, captured, film, refused, views
from picture_bag import MESSAGES, TYPES, Recorded, command
from rosbags.rosbag2 import CompressionMode
from scipy.spatial.transform import Rotation
from test_metric import _path, _points, _similarity, _world
from test_pictures import _mosaic  # a mosaic of `SMOOTH`

from twin import commands
from twin.capture.bag_film import lens_of, read_contents
from twin.capture.camera_models import Lens, checked_lens
from twin.capture.capture_data import Capture
from twin.capture.frames import detect_kind, source_files
from twin.capture.scale import scale_from_odometry
from twin.capture.video import FilmStatistics
from twin.config import CalibrationConfig, SourceConfig
from twin.config_file import load_config, read_robot
from twin.errors import InputError
from twin.files import remove
from twin.geometry.cameras import Cameras
from twin.geometry.images import read_image
from twin.new import new_scene

SHIFTS = [6 * i for i in range(30)]
TIMES = np.arange(30) / 10.0
PINHOLE = Lens("PINHOLE", (150.0, 151.0, 80.5, 59.0), WIDTH, HEIGHT)


def straight(count: int = 30, step: float = 1.0) -> np.ndarray:
    """Poses of a base that drives to the north-east."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", np.pi / 4).as_matrix()
    poses[:, :2, 3] = np.arange(count)[:, None] * step / np.sqrt(2)
    return poses


def whole(encoding: str = "rgb8") -> list[Recorded]:
    return [
        camera_info(PINHOLE),
        *seat(0.7, 0.3, 0.1),
        *drive(straight(), TIMES),
        *pictures(views(SHIFTS), TIMES, encoding),
    ]


@pytest.mark.parametrize("storage", ["mcap", "sqlite", "file"])
def test_frames_calibration_and_positions_come_from_the_bag(tmp_path: Path, storage: str) -> None:
    bag = write(tmp_path / "drive", whole(), mcap=storage != "sqlite")
    path = next(bag.glob("*.mcap")) if storage == "file" else bag
    assert detect_kind(path) == "bag" and (path in source_files(path, "auto")) == (storage == "file")
    capture, metrics, out = captured(tmp_path, [SourceConfig(path=str(path.relative_to(tmp_path)))], fps=5.0)
    (source,) = capture.sources
    assert (source.kind, source.calibrated, source.camera_model) == ("bag", True, "PINHOLE")
    np.testing.assert_allclose(source.camera_params, PINHOLE.params)
    assert len(capture.names) == 15 and metrics["with_gps"] == 15
    frames = views(SHIFTS)
    for name, time in zip(capture.names, capture.times, strict=True):
        k = int(name[-6:])
        np.testing.assert_array_equal(read_image(out / "images" / f"{name}.png"), frames[k])
        assert time == pytest.approx(TIMES[k], abs=1e-6)
    assert capture.odometry is not None
    moved = np.linalg.norm(capture.odometry[-1] - capture.odometry[0])
    assert moved == pytest.approx((capture.times[-1] - capture.times[0]) * 10.0, abs=1e-4)
    assert np.allclose(capture.odometry[:, 2], 0.6)  # the lens above base_link


def test_fixes_are_interpolated_across_180_degrees(tmp_path: Path) -> None:
    contents = read_contents(write(tmp_path / "drive", whole()))
    second = contents.stamps[0] + np.array([0, 1, 2, 3]) * 1_000_000_000
    fixes = np.array([[-16.8, 179.99998, 3.0], [-16.8, -179.99998, 3.0], [np.nan] * 3, [-16.8, 179.99996, 3.0]])
    across = replace(contents, fix_times=second, fixes=fixes).fixes_at(np.array([0.0, 0.25, 0.75, 1.0, 1.5]))
    np.testing.assert_allclose(across[:4, 1], [179.99998, 179.99999, -179.99999, -179.99998], atol=1e-9)
    assert np.isnan(across[4]).all()


def test_a_folder_named_like_a_bag_of_ros_1(tmp_path: Path) -> None:
    assert read_contents(write(tmp_path / "drive.bag", whole())).size == (WIDTH, HEIGHT)


@pytest.mark.parametrize("encoding", ["bgra8", "png", "jpeg"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    bag = write(tmp_path / "drive", whole(encoding))
    contents = read_contents(bag)
    assert contents.size == (WIDTH, HEIGHT) and encoding in contents.encoding
    count = FilmStatistics()
    shown = [frame.to_ndarray(format="rgb24") for _, frame in contents.film().decode(count)]
    worst = max(np.abs(a.astype(int) - b).max() for a, b in zip(shown, views(SHIFTS), strict=True))
    assert count.damaged == 0 and worst <= (20 if encoding == "jpeg" else 0)


def test_a_bayer_film(tmp_path: Path) -> None:
    mosaic = _mosaic("rggb")
    flat = np.ascontiguousarray(mosaic).reshape(mosaic.shape[0], -1)
    height, width = mosaic.shape[:2]
    messages = []
    for k in range(3):
        stamp = START + k * 10**8
        raw = TYPES["sensor_msgs/msg/Image"](
            MESSAGES.header(stamp), height, width, "bayer_rggb8", 0, flat.shape[1], flat.ravel()
        )
        messages.append(Recorded(IMAGE, "sensor_msgs/msg/Image", raw, stamp))
    contents = read_contents(write(tmp_path / "bag", messages))
    assert contents.encoding == "bayer_rggb8" and contents.lens is None and "no sensor_msgs" in contents.lens_note
    assert len(list(contents.film().decode(FilmStatistics()))) == 3


def test_a_bag_of_ros_1(tmp_path: Path) -> None:
    frames = views(SHIFTS)
    path = write_ros1(tmp_path / "drive.bag", frames, TIMES)
    capture, metrics, out = captured(tmp_path, [SourceConfig(path="drive.bag")], frames=10)
    assert capture.sources[0].calibrated and metrics["sources"]["drive"]["decoded"] == 30
    name = capture.names[3]
    np.testing.assert_array_equal(read_image(out / "images" / f"{name}.png"), frames[int(name[-6:])])
    seat_of = read_contents(path).seat
    assert seat_of is not None and (seat_of.offset[0], seat_of.pitch) == pytest.approx((0.3, 0.0), abs=1e-9)


# ---- calibration

DISTORTED = [
    ("PINHOLE", ()),
    ("OPENCV", (-0.2, 0.05, 0.001, -0.002)),
    ("FULL_OPENCV", (-0.2, 0.05, 0.001, -0.002, 0.01, 0.1, 0.02, 0.003)),
    ("OPENCV_FISHEYE", (0.1, -0.02, 0.003, -0.001)),
    ("OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize(("model", "distortion"), DISTORTED)
def test_the_lens_projects_as_the_camera_info_says(model: str, distortion: tuple[float, ...]) -> None:
    from twin_policy import Camera

    lens = checked_lens(model, (150.0, 151.0, 80.5, 59.0, *distortion), WIDTH, HEIGHT, "test")
    message = camera_info(lens).message
    found = lens_of(message, False, "bag")
    assert (found.width, found.height) == (WIDTH, HEIGHT)
    x, y = np.linspace(-0.4, 0.4, 9), np.linspace(0.3, -0.3, 9)
    rays = np.stack([x, y, np.ones_like(x)], 1)
    u, v = Camera.from_info(message).project(x, y)
    np.testing.assert_allclose(np.asarray(found.camera.img_from_cam(rays)), np.stack([u, v], 1), atol=1e-9)


def test_five_coefficients_with_k3(tmp_path: Path) -> None:
    message = MESSAGES.camera_info(
        PINHOLE.params, (WIDTH, HEIGHT), START, "plumb_bob", (-0.2, 0.1, 0.001, 0.002, -0.05)
    )
    lens = lens_of(message, False, "bag")
    assert lens.model == "FULL_OPENCV" and lens.distortion == (-0.2, 0.1, 0.001, 0.002, -0.05, 0.0, 0.0, 0.0)


def test_a_calibration_by_hand_replaces_the_bags(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", whole())
    by_hand = CalibrationConfig("PINHOLE", (160.0, 160.0, 80.0, 60.0), WIDTH, HEIGHT)
    capture, _, _ = captured(tmp_path, [SourceConfig(path=bag.name, camera=by_hand)])
    assert capture.sources[0].camera_params == (160.0, 160.0, 80.0, 60.0)


def test_another_cameras_info_is_not_used(tmp_path: Path) -> None:
    messages = [camera_info(PINHOLE, frame="rear_optical"), *pictures(views(SHIFTS), TIMES)]
    contents = read_contents(write(tmp_path / "drive", messages))
    assert (
        contents.lens is None
        and "is of another camera (frame rear_optical, pictures have camera_optical)" in contents.lens_note
    )
    zero = MESSAGES.camera_info((0.0, 0.0, 0.5, 0.5), (WIDTH, HEIGHT), START)
    messages[0] = Recorded(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", zero, START)
    contents = read_contents(write(tmp_path / "zero", messages))
    assert contents.lens is None and "has no calibration" in contents.lens_note


# ---- the camera's seat and the scale


def test_the_seat_is_that_of_the_transforms(tmp_path: Path) -> None:
    found = read_contents(write(tmp_path / "drive", whole())).seat
    assert found is not None and found.ground_known
    assert (found.height, *found.offset) == pytest.approx((0.7, 0.3, 0.0), abs=1e-9)
    assert (found.yaw, found.pitch, found.roll) == pytest.approx((0.0, np.degrees(0.1), 0.0), abs=1e-6)
    # A frame with x forward instead of an optical one, without base_footprint.
    body = transform("base_link", FRAME, Rotation.from_euler("ZYX", (0.2, 0.1, 0.0)), (0.3, 0.0, 0.6))
    other = read_contents(write(tmp_path / "body", [body, *pictures(views(SHIFTS[:3]), TIMES[:3])])).seat
    assert other is not None and not other.ground_known and other.height == pytest.approx(0.6 + 0.13228, abs=1e-5)
    assert (other.yaw, other.pitch) == pytest.approx((np.degrees(0.2), np.degrees(0.1)), abs=1e-6)
    circle = [
        transform("a", FRAME, Rotation.identity(), (0, 0, 1)),
        transform(FRAME, "a", Rotation.identity(), (0, 0, 1)),
    ]
    assert read_contents(write(tmp_path / "circle", [*circle, *pictures(views(SHIFTS[:3]), TIMES[:3])])).seat is None


def test_lengths_of_odometry_give_metres_although_its_heading_drifts(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    film = _path(count=80)
    world = _world(tmp_path / "s", [film], _points(film, rng), _similarity(7))
    steps = np.diff(film[:, :3, 3], axis=0) * 1.02 + rng.normal(0, 0.002, (79, 3))  # wheels too small by 2 %
    drift = Rotation.from_euler("z", np.linspace(0, 1.5, 79)[:, None])  # by 86° in all
    odometry = np.concatenate([np.zeros((1, 3)), np.cumsum(drift.apply(steps), axis=0)])
    odometry[40] = np.nan
    capture = Capture.load(world.scene.stage("capture"))
    replace(capture, odometry=odometry).save(world.scene.stage("capture"))
    metrics = world.run(tmp_path / "out", odometry=True)
    cameras = Cameras.load(tmp_path / "out")
    length = np.linalg.norm(np.diff(cameras.positions, axis=0), axis=1).sum()
    truth = np.linalg.norm(np.diff(film[:, :3, 3], axis=0), axis=1).sum()
    assert length / truth == pytest.approx(1.02, abs=0.004)
    assert metrics["scale_source"] == "odometry" and 0.03 <= metrics["scale_uncertainty"] < 0.032
    both = world.run(tmp_path / "both", odometry=True, camera_height=1.3)
    assert set(both["scales"]) == {"camera_height", "odometry"} and both["scale_disagreement"] < 2.0
    with pytest.raises(InputError, match=r"over 0 stretches of 2 m \(need 5\)"):
        scale_from_odometry(cameras, np.full((80, 3), np.nan), 0.03)
    with pytest.raises(InputError, match=r"varies by \d+%"):
        scale_from_odometry(cameras, rng.normal(0, 3, (80, 3)).cumsum(0), 0.03)


def test_noise_of_odometry_does_not_lengthen_the_scale(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    world = _world(tmp_path / "s", [_path(count=80)], _points(_path(), rng), _similarity(7))
    cameras = Cameras.load(world.scene.stage("cameras"))
    noise = rng.normal(0, 0.2, (15, 80, 3)) * [1, 1, 0]
    scales = [scale_from_odometry(cameras, world.truth[:, :3, 3] + one, 0.0) for one in noise]
    errors = np.log([one.value * _similarity(7).scale for one in scales])
    assert abs(errors.mean()) < 0.015 and np.mean(np.abs(errors) < [one.uncertainty for one in scales]) > 0.8


def test_a_misplaced_camera_does_not_spoil_the_scale_of_odometry(tmp_path: Path) -> None:
    world = _world(tmp_path / "s", [_path(count=80)], _points(_path(), np.random.default_rng(3)), _similarity(7))
    cameras = Cameras.load(world.scene.stage("cameras"))
    cameras.camera_to_world[40, :3, 3] += 100.0
    scale = scale_from_odometry(cameras, world.truth[:, :3, 3], 0.0)
    assert scale.value * _similarity(7).scale == pytest.approx(1.0, abs=1e-3)


# ---- the verb new


def test_new_takes_what_the_bag_has_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rear = [replace(one, topic="/rear/image") for one in pictures(views(SHIFTS), TIMES) if one.stamp < START + 10**9]
    bag = write(tmp_path / "drive", [*whole(), *rear])
    root = tmp_path / "scene"
    assert commands.main("new", [str(root), str(bag)]) == 0
    said = capsys.readouterr()
    text = said.out + said.err
    for words in (
        "drive: 30 pictures of /camera/image, 160x120 rgb8, 10.0 a second over 2.9 s",
        "calibration: /camera/camera_info: plumb_bob",
        "other pictures: /rear/image; choose by --topic",
        "GPS: /gps/fix, 30 fixes, up to 29.0 m from the first",
        "odometry: /odom, a path of 29.0 m",
        "camera on the robot: 0.700 m above the ground, 0.300 m ahead, pitch 5.7°, by /tf_static",
    ):
        assert words in text, text
    assert "fill in [metric]" not in text and "metric scale: camera_height, gps and odometry" in text
    assert "as a log for twin align it lacks commands (geometry_msgs/msg/Twist or" in text
    config = load_config(root / "scene.toml")
    assert config.source[0].topic == "/camera/image" and config.source[0].path == "input/drive"
    assert config.metric.camera_height == pytest.approx(0.7) and config.metric.gps and config.metric.odometry
    robot = read_robot(root / "robot.toml")
    assert robot["camera_height"] == pytest.approx(0.7) and robot["camera_offset"] == pytest.approx([0.3, 0.0])
    assert robot["camera_pitch"] == pytest.approx(np.degrees(0.1), abs=1e-3)
    assert commands.main("new", [str(tmp_path / "other"), str(bag), "--topic", "/rear/image"]) == 0
    assert load_config(tmp_path / "other/scene.toml").source[0].topic == "/rear/image"


def test_the_height_of_a_bag_is_not_that_of_another_film(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    bag = write(tmp_path / "drive", whole())
    phone = film(tmp_path / "phone.mp4", views([5 * i for i in range(6)]))
    assert commands.main("new", [str(tmp_path / "scene"), str(phone), str(bag)]) == 0
    config = load_config(tmp_path / "scene/scene.toml")
    assert config.metric.camera_height == 0.0 and config.metric.camera_height_tolerance == 0.02
    assert [one.camera_height for one in config.source] == [0.0, pytest.approx(0.7)]
    assert "metric scale: camera_height" in capsys.readouterr().out
    assert commands.main("new", [str(tmp_path / "given"), str(phone), str(bag), "--camera-height", "1.1"]) == 0
    config = load_config(tmp_path / "given/scene.toml")
    assert config.metric.camera_height == 1.1 and [one.camera_height for one in config.source] == [0.0, 0.0]


def test_a_failed_start_of_a_scene_leaves_no_robot(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", whole())
    again = tmp_path / "again"
    shutil.copytree(bag, again / "drive")
    root = tmp_path / "scene"
    with pytest.raises(InputError, match="has the same content"):
        new_scene(root, [bag, again / "drive"])
    assert not (root / "robot.toml").exists() and not (root / "scene.toml").exists()


def test_a_camera_below_the_ground_gives_no_height(tmp_path: Path) -> None:
    below = [one for one in whole() if one.topic != "/tf_static"] + seat(-0.4, 0.3, 0.1)
    bags = [write(tmp_path / "left", whole()), write(tmp_path / "right", below)]
    new_scene(tmp_path / "scene", bags)
    config = load_config(tmp_path / "scene/scene.toml")
    assert [one.camera_height for one in config.source] == [pytest.approx(0.7), 0.0]


def test_new_says_whether_the_bag_is_also_a_log(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    moved = [command(1.0, 0.0, one.stamp) for one in whole() if one.topic == "/odom"]
    for name, more, words in (
        ("a", moved, "lacks joint states (sensor_msgs/msg/JointState) or odometry of the wheels"),
        ("b", [*moved, joints("/joints")], "also a log for twin align: commands /cmd_vel, wheels /joints, poses /odom"),
        ("c", [*moved, *odometry_on("/platform/odom/filtered")], "lacks joint states"),
        ("d", [*moved, *odometry_on("/platform/odom")], "commands /cmd_vel, wheels /platform/odom, poses /odom"),
    ):
        bag = write(tmp_path / f"drive_{name}", [*whole(), *more])
        assert commands.main("new", [str(tmp_path / f"scene_{name}"), str(bag)]) == 0
        assert words in capsys.readouterr().err


def test_new_says_when_odometry_is_too_short_for_the_scale(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    bag = write(tmp_path / "short", [one for one in whole() if one.topic != "/odom" or one.stamp < START + 10**9])
    assert commands.main("new", [str(tmp_path / "scene"), str(bag)]) == 0
    said = capsys.readouterr()
    assert "(less than 15 m, so not used for the scale)" in said.err
    assert "metric scale: camera_height and gps\n" in said.out


def odometry_on(topic: str) -> list[Recorded]:
    return [replace(one, topic=topic) for one in whole() if one.topic == "/odom"]


def joints(topic: str) -> Recorded:
    none = np.zeros(0)
    message = TYPES["sensor_msgs/msg/JointState"](MESSAGES.header(START), ["front_left_wheel_joint"], none, none, none)
    return Recorded(topic, "sensor_msgs/msg/JointState", message, START)


def test_new_names_a_set_clock_and_the_other_files_of_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    late = pictures(views(SHIFTS), TIMES + np.where(TIMES < 2.0, 0.0, 1e8))
    bag = write(tmp_path / "drive", [camera_info(PINHOLE), *late])
    (file,) = bag.glob("*.mcap")
    file.rename(bag / "drive_0.mcap")
    (bag / "drive_1.mcap").write_bytes(b"")
    assert commands.main("new", [str(tmp_path / "scene"), str(bag / "drive_0.mcap")]) == 0
    said = capsys.readouterr().err
    assert "drive_0.mcap: no picture for 100000000.1 s from 1.9 s on" in said
    assert "only this one of the bag's 2 files is used; for all, give its folder" in said
    assert "camera on the robot: not found, no /tf_static" in said


def test_a_compressed_file_of_a_bag_is_read_in_its_folder(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        bag = write(tmp_path / mode.name, whole(), compression=mode)
        assert commands.main("new", [str(tmp_path / f"{mode.name} scene"), str(bag)]) == 0
        (file,) = (one for one in bag.iterdir() if one.suffix != ".yaml")
        capsys.readouterr()
        assert commands.main("new", [str(tmp_path / "other"), str(file)]) == 2
        assert "give the bag's folder" in capsys.readouterr().err


@pytest.mark.parametrize("mcap", [True, False])
def test_a_clock_that_was_set_back(tmp_path: Path, capsys: pytest.CaptureFixture, mcap: bool) -> None:
    """A camera's is replaced by the recorder's. Of a recorder's own, the film would mix the parts of equal times."""
    back = START + np.round((TIMES - np.where(TIMES < 2.0, 0.0, 300.0)) * 1e9).astype(int)
    film = pictures(views(SHIFTS), TIMES)
    for one, stamp in zip(film, back.tolist(), strict=True):
        one.message.header.stamp.sec, one.message.header.stamp.nanosec = divmod(stamp, 10**9)
    contents = read_contents(write(tmp_path / "camera", [camera_info(PINHOLE), *film], mcap))
    assert len(contents.stamps) == len(TIMES) and contents.duration == pytest.approx(TIMES[-1])
    assert (
        "the clock of /camera/image was set back by 300 s; the times of recording are used" in capsys.readouterr().err
    )
    times = np.arange(80) * 0.1  # several chunks of a megabyte
    both = [
        replace(one, stamp=one.stamp - (300 * 10**9 if time > 2.0 else 0))
        for one, time in zip(pictures([views(SHIFTS)[0]] * len(times), times), times, strict=True)
    ]
    bag = write(tmp_path / "recorder", [camera_info(PINHOLE), *both], mcap, in_order=False)
    with pytest.raises(
        InputError, match=r"/camera/image: the recorder's clock was set back by about (29\d|300) s.*again"
    ):
        read_contents(bag)


def test_a_first_picture_without_a_stamp_has_the_time_of_its_recording(tmp_path: Path) -> None:
    """As by drivers that publish before their clock is set; the film would last 54 years."""
    film = pictures(views(SHIFTS), TIMES)
    film[0].message.header.stamp.sec = film[0].message.header.stamp.nanosec = 0
    contents = read_contents(write(tmp_path / "camera", [camera_info(PINHOLE), *film]))
    assert contents.duration == pytest.approx(TIMES[-1], abs=0.02)
    assert contents.stamps[0] == pytest.approx(START, abs=20_000_000)


# ---- bad bags


def _stamped(order: list[int]) -> list[Recorded]:
    """Pictures recorded in one order with stamps in another."""
    out = pictures(views(SHIFTS), TIMES)
    for one, k in zip(out, order, strict=True):
        one.message.header.stamp.sec, one.message.header.stamp.nanosec = divmod(START + k * 10**8, 10**9)
    return out


def _encoded(encoding: str) -> list[Recorded]:
    out = pictures(views(SHIFTS), TIMES)
    for one in out:
        one.message.encoding = encoding
    return out


def _modelled(model: str) -> list[Recorded]:
    info = camera_info(PINHOLE)
    info.message.distortion_model, info.message.d = model, np.array([0.1, 0.2])
    return [info, *pictures(views(SHIFTS), TIMES)]


BAD = {
    "no pictures": (lambda: drive(straight(), TIMES), r"no topic with pictures among /gps/fix, /odom; record"),
    "only infrared": (
        lambda: [replace(one, topic="/infra1/image_rect_raw") for one in pictures(views(SHIFTS), TIMES)],
        r"only pictures of depth, infrared or masks: /infra1/image_rect_raw; give one of them as the topic",
    ),
    "nothing": (list, r"no topic with pictures among none"),
    "an unknown encoding": (lambda: _encoded("mono16"), r"/camera/image: encoding 'mono16'; expected one of rgb8"),
    "rows too short": (lambda: _short(), r"/camera/image: rgb8 picture of 160 x 120 px with 100 bytes a row"),
    "a rubbish JPEG": (lambda: _rubbish(), r"5 bytes are neither a JPEG nor a PNG picture; record raw"),
    "an unknown camera model": (
        lambda: _modelled("omni"),
        r"camera_info: distortion model 'omni'; expected none, plumb_bob",
    ),
    "unsorted stamps": (
        lambda: _stamped([*range(15), *range(15)]),
        r"the stamps of 15 of 30 pictures equal .* earlier by up to 1\.400 s",
    ),
    "another size": (
        lambda: [camera_info(Lens("PINHOLE", (150.0, 150.0, 50.0, 60.0), 100, 120)), *pictures(views(SHIFTS), TIMES)],
        r"camera_info is for 100x120, but the pictures are 160x120",
    ),
}


def _short() -> list[Recorded]:
    out = pictures(views(SHIFTS), TIMES)
    for one in out:
        one.message.step = 100
    return out


def _rubbish() -> list[Recorded]:
    out = pictures(views(SHIFTS), TIMES, "jpeg")
    for one in out:
        one.message.data = np.arange(5, dtype=np.uint8)
    return out


@pytest.mark.parametrize("kind", BAD)
def test_bad_bags_get_one_line(tmp_path: Path, kind: str) -> None:
    make, message = BAD[kind]
    bag = write(tmp_path / "bag", make())
    refused(tmp_path, SourceConfig(path=bag.name), message)


def test_damaged_files_get_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    bag = write(tmp_path / "bag", whole())
    good = next(bag.glob("*.mcap")).read_bytes()
    file = tmp_path / "cut.mcap"
    for data, words in (
        (b"", "seems to be empty; the recording was cut off"),
        (good[: len(good) // 2], "end magic is invalid; the recording was cut off: repair it by `mcap recover`"),
        (b"rubbish" * 99, "not a readable bag"),
        (good[:-3000] + bytes(2000) + good[-1000:], "not a readable bag"),
    ):
        file.write_bytes(data)
        refused(tmp_path, SourceConfig(path=file.name), words)
        assert commands.main("new", [str(tmp_path / "scene"), str(file)]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    refused(tmp_path, SourceConfig(path=bag.name, topic="/none"), "topic /none; expected one of .*/camera/image")
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare/drive_0.mcap").write_bytes(good)
    refused(tmp_path, SourceConfig(path="bare"), r"a bag without metadata\.yaml; give its file, such as drive_0\.mcap")
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: 3")
    refused(tmp_path, SourceConfig(path=bag.name), "not a readable bag")
    remove(bag)
    (tmp_path / "folder").mkdir()
    refused(tmp_path, SourceConfig(path="folder", kind="bag"), "not a bag; expected")


def test_a_bag_with_a_hole_is_used_and_said_to_be_damaged(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    bag = write(tmp_path / "bag", pictures(views(SHIFTS), TIMES, "jpeg"))
    file = next(bag.glob("*.mcap"))
    data = file.read_bytes()
    where = [found.start() for found in re.finditer(b"\xff\xd8\xff", data)]
    for start in (where[0], *where[10:16]):  # a camera's first picture is often damaged
        data = data[:start] + bytes(500) + data[start + 500 :]
    file.write_bytes(data)
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="bag")], frames=30)
    assert len(capture.names) == metrics["sources"]["bag"]["decoded"] == 23
    assert metrics["sources"]["bag"]["damaged"] == 7
    assert "bag: damaged; 23 of 30 frames could be decoded" in capsys.readouterr().err


def test_definitions_in_a_bag_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """rosbags would generate code from them, and one odd type would make the whole bag unreadable."""
    import rosbags.typesys.msg
    from rosbags.typesys import Stores, get_typestore

    get_typestore(Stores.ROS2_JAZZY)
    bag = write(tmp_path / "bag", whole())
    monkeypatch.setattr("rosbags.typesys.store.generate_python_code", _forbidden)
    file = next(bag.glob("*.mcap"))
    data = file.read_bytes()
    assert b"float64[9] k" in data
    file.write_bytes(data.replace(b"float64[9] k", b"floaty64[9]k"))
    assert read_contents(bag).lens == PINHOLE
    assert struct.calcsize("<Q") == 8 and rosbags.typesys.msg


def _forbidden(*_: object) -> None:
    raise AssertionError("code is generated")


def test_a_topic_of_a_video_is_refused(tmp_path: Path) -> None:
    from filmed_wall import film

    film(tmp_path / "day.mp4", views(SHIFTS[:5]))
    refused(tmp_path, SourceConfig(path="day.mp4", topic="/camera"), "topic = '/camera', but this is not a bag")
    with pytest.raises(InputError, match=re.escape("none of the films is a bag")):
        from twin.new import new_scene

        new_scene(tmp_path / "scene", [tmp_path / "day.mp4"], 1.2, "/camera")
