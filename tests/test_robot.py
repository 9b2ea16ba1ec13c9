"""Parameters of a robot: where they are read from, their precedence and checks, and that the scene uses them."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_world import tiny_config, tiny_scene

from twin.build import PIPELINE, _depends
from twin.config_file import load_config
from twin.errors import InputError
from twin.files import digest_json
from twin.mjcf.scene_xml import run
from twin.mjcf.world import World
from twin.robot import CAMERA_SIZE, ZED2, HuskyParams, PixelCamera

_SCENE = """
[[source]]
path = "input/a.mp4"
[metric]
camera_height = 1.2
"""


def config_of(folder, robot_toml: str | None = None, section: str = "", overrides: tuple[str, ...] = ()):
    (folder / "scene.toml").write_text(_SCENE + section)
    if robot_toml is not None:
        (folder / "robot.toml").write_text(robot_toml)
    return load_config(folder / "scene.toml", overrides)


def test_scene_toml_precedes_robot_toml_and_defaults(tmp_path):
    assert config_of(tmp_path).robot == HuskyParams()
    robot = config_of(tmp_path, "friction = 0.6\nservo_lag = 0.1\n", "[robot]\nfriction = 0.5\n").robot
    assert robot == HuskyParams(friction=0.5, servo_lag=0.1)
    robot = config_of(tmp_path, "friction = 0.6\n", "[robot]\nfriction = 0.5\n", ("robot.friction=0.4",)).robot
    assert robot.friction == 0.4


def test_lists_and_whole_numbers_are_read_as_floats(tmp_path):
    robot = config_of(
        tmp_path,
        "center_of_mass = [-0.05, 0, 0.06]\ncamera_intrinsics = [600, 600, 320, 240]\ncamera_size = [640, 480]",
    ).robot
    assert robot.center_of_mass == (-0.05, 0.0, 0.06) and robot.camera_size == (640, 480)
    assert robot.camera() == PixelCamera((600.0, 600.0, 320.0, 240.0), (640, 480))


@pytest.mark.parametrize(
    ("robot_toml", "message"),
    [
        ("fricton = 0.6", r"robot\.toml: unknown key 'fricton'; did you mean 'friction'\?"),
        ("friction = 'low'", r"robot\.toml: friction: expected float, got 'low'"),
        ("friction = -0.1", r"robot\.toml: friction = -0\.1; expected 0\.01 to 3"),
        ("wheel_radius = [165.1, 165.1]", r"wheel_radius = 165\.1; expected 0\.1 to 0\.25"),
        ("wheel_radius = [0.165]", r"wheel_radius = \[0\.165\]; expected 2 numbers"),
        ("camera_intrinsics = [600, 600, 320]", r"expected \[fx, fy, cx, cy\]"),
        ("camera_intrinsics = [0, 600, 320, 240]", r"expected fx, fy > 0"),
        ("wheel_shape = 'square'", r"expected ellipsoid or cylinder"),
        ("friction = [", r"not valid TOML"),
    ],
)
def test_bad_values_are_refused(tmp_path, robot_toml, message):
    with pytest.raises(InputError, match=message):
        config_of(tmp_path, robot_toml)


def test_wrong_section_is_refused_by_name(tmp_path):
    with pytest.raises(
        InputError, match=r"scene\.toml: robot: unknown key 'camera_hight'; did you mean 'camera_height'"
    ):
        config_of(tmp_path, None, "[robot]\ncamera_hight = 0.5\n")


def test_a_changed_robot_changes_the_key_of_stage_mjcf(tmp_path):
    stage = next(stage for stage in PIPELINE if stage.name == "mjcf")

    def key(config) -> str:
        return digest_json(_depends(replace(stage, upstream=()), config, {}, {}))

    plain = key(config_of(tmp_path))
    assert key(config_of(tmp_path, "command_latency = 0.1")) != plain
    assert key(config_of(tmp_path, "# measured\n")) == plain


def test_resized_camera_sees_the_same():
    """A point has corresponding pixels in the large image and in the small one, which is cropped evenly."""
    big = PixelCamera((500.0, 510.0, 330.0, 250.0), (640, 480))
    small = big.resized(CAMERA_SIZE)
    x, y = 0.3, -0.2
    u, v = 500 * x + 330, 510 * y + 250
    fx, fy, cx, cy = small.intrinsics
    assert fx * x + cx == pytest.approx(u / 4)
    assert fy * y + cy == pytest.approx(v / 4 - (120 - 90) / 2)
    np.testing.assert_allclose(ZED2.resized(CAMERA_SIZE).intrinsics, [66.25, 66.25, 80.0, 45.0])


def test_robot_reaches_the_scene_and_the_world(tmp_path):
    robot = HuskyParams(
        camera_height=0.8,
        camera_pitch=12.0,
        camera_intrinsics=(600.0, 610.0, 310.0, 170.0),
        camera_size=(640, 360),
        wheel_radius=(0.164, 0.166),
        payload_mass=5.0,
        command_latency=0.12,
        servo_lag=0.05,
    )
    scene = tiny_scene(tmp_path)
    out = scene.stage("mjcf")
    out.mkdir()
    run(scene, replace(tiny_config(), robot=robot), out)
    world = World.load(out)
    assert world.robot == robot
    assert world.camera == PixelCamera((600.0, 610.0, 310.0, 170.0), (640, 360))
    np.testing.assert_allclose(world.intrinsics, [150.0, 152.5, 77.5, 42.5])
    model = world.model()
    assert model.body_mass.sum() == pytest.approx(56.582 + 5.0)
    for name, size, scale in (("front", (160, 90), 4.0), ("front_native", (640, 360), 1.0)):
        camera = model.camera(name).id
        pixel = model.cam_sensorsize[camera, 0] / size[0]
        assert model.cam_resolution[camera].tolist() == list(size)
        np.testing.assert_allclose(model.cam_intrinsic[camera, :2] / pixel, [600 / scale, 610 / scale], rtol=1e-5)
    assert model.geom("rear_left_tyre").size[0] == pytest.approx(0.164)
    assert model.geom("front_right_tyre").size[0] == pytest.approx(0.166)
    assert model.na == 2 and model.actuator("left").dynprm[0] == pytest.approx(0.05)
