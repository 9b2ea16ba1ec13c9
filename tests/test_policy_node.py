"""The ROS 2 node: its callbacks on the real rclpy where that is installed, else on stand-ins; its package.

Without ROS, nothing here runs the middleware: topics and executors are read, not run. Launch files are never run.
"""

import ast
import importlib
import importlib.util
import runpy
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock
from xml.etree import ElementTree

import numpy as np
import pytest
import ros_stand_ins
from ruamel.yaml import YAML
from test_pilot import LENS, SMALL, picture, small_policy

ROOT = Path(__file__).parents[1] / "ros2" / "twin_policy"
HAS_ROS = importlib.util.find_spec("rclpy") is not None
MS = 1_000_000


def filled(image: Any, k: int) -> Any:
    """The message with picture k."""
    image.encoding, image.height, image.width, image.step = "rgb8", 18, 32, 96
    image.data = picture(k).tobytes()
    return image


def calibrated(info: Any) -> Any:
    """The message with the calibration of the pictures."""
    info.width, info.height, info.distortion_model, info.d = *SMALL.size, "plumb_bob", [0.0] * 5
    fx, fy, cx, cy = LENS.intrinsics
    info.k = [fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0]
    return info


class Rig:
    """A node with parameters, and messages to it; its clocks stand still between messages where ROS is absent."""

    def __init__(self, monkeypatch, folder: Path, **parameters: Any) -> None:
        small_policy(folder)
        parameters = {"policy": str(folder), **parameters}
        self.steady = 10**9
        if not HAS_ROS:
            ros_stand_ins.install(monkeypatch)
        sys.modules.pop("twin_policy.node", None)
        self.module = importlib.import_module("twin_policy.node")
        if HAS_ROS:
            import rclpy
            from rclpy.parameter import Parameter

            rclpy.init()
            overrides = [Parameter(name, value=value) for name, value in parameters.items()]
            try:
                self.node = self.module.PolicyNode(parameter_overrides=overrides)
            except ValueError:
                rclpy.shutdown()
                raise
            self.published: list[tuple[str, Any]] = []
            for topic, publisher in (("cmd_vel", self.node._commands), ("/diagnostics", self.node._diagnostics)):
                monkeypatch.setattr(
                    publisher, "publish", lambda sent, topic=topic: self.published.append((topic, sent))
                )
        else:
            monkeypatch.setattr(ros_stand_ins.Node, "overrides", parameters)
            monkeypatch.setattr("time.monotonic_ns", lambda: self.steady)
            self.node = self.module.PolicyNode()
            self.published = self.node.published
        self.wait(0)

    def wait(self, milliseconds: int) -> None:
        if HAS_ROS:
            time.sleep(milliseconds / 1000)
        else:
            self.steady += milliseconds * MS
            self.node.time = 1_700_000_000 * 10**9 + self.steady

    def stamped(self, message: Any) -> Any:
        now = self.node.get_clock().now().to_msg()
        message.header.stamp.sec, message.header.stamp.nanosec = now.sec, now.nanosec
        return message

    def show(self, k: int = 0) -> None:
        self.node._on_image(filled(self.stamped(self.module.Image()), k))

    def calibrate(self) -> None:
        self.node._on_camera_info(calibrated(self.stamped(self.module.CameraInfo())))

    def commands(self) -> list[tuple[float, float]]:
        """v and yaw rate of the messages published so far, which are forgotten."""
        sent = [getattr(one, "twist", one) for topic, one in self.published if topic == "cmd_vel"]
        self.published.clear()
        return [(one.linear.x, one.angular.z) for one in sent]


@pytest.fixture
def rig(monkeypatch, tmp_path):
    rigs: list[Rig] = []

    def make(**parameters: Any) -> Rig:
        rigs.append(Rig(monkeypatch, tmp_path, **parameters))
        return rigs[-1]

    yield make
    sys.modules.pop("twin_policy.node", None)
    if HAS_ROS:
        import rclpy

        for one in rigs:
            one.node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()


def test_it_drives_while_the_switch_is_held(rig):
    r = rig()
    r.calibrate()
    r.show()
    assert r.commands() == []  # nothing but stops without the switch
    r.node.pilot.press()
    for k in range(3):
        r.wait(100)
        r.show(k)
        r.node._watch()
    stack = np.concatenate([picture(k).transpose(2, 0, 1) for k in (0, 0, 1, 2)])
    sent = r.published[-1][1]
    assert type(sent).__name__ == "TwistStamped" and sent.header.frame_id == "base_link"
    r.show(2)  # doubled: the same picture, without a new command
    commands = r.commands()
    assert len(commands) == 3 and commands[-1] == r.node.pilot.policy.command(stack)


def test_it_stops_when_pictures_cease_and_is_silent_when_the_switch_is_released(rig):
    r = rig(deadman_button=1, deadman=5.0)  # with rclpy the clocks run on
    r.calibrate()
    joy = r.module.Joy()
    joy.buttons = [0, 1]
    r.node._on_joy(joy)
    r.show()
    r.commands()
    r.wait(350)
    r.node._watch()
    assert r.commands() == [(0.0, 0.0)] and "old" in r.node.pilot.command().cause
    joy.buttons = [0]
    r.node._on_joy(joy)
    r.node._watch()
    assert r.commands() == [(0.0, 0.0)]
    r.wait(1100)
    r.node._watch()
    assert r.commands() == []  # another source may drive
    r.node.stop()
    assert r.commands() == [(0.0, 0.0)]


def test_a_picture_that_stops_the_robot_does_so_at_once(rig):
    """Not only when the watchdog wakes."""
    r = rig(deadman=0.0)
    r.calibrate()
    r.show()
    assert len(r.commands()) == 1
    r.wait(100)
    r.node._on_image(filled(r.stamped(r.module.Image()), 1))
    assert len(r.commands()) == 1
    r.wait(100)
    wrong = filled(r.stamped(r.module.Image()), 2)
    wrong.encoding = "mono16x"
    r.node._on_image(wrong)
    assert r.commands() == [(0.0, 0.0)]
    r.node._on_image(wrong)
    assert r.commands() == []


@pytest.mark.skipif(HAS_ROS, reason="rclpy keeps its timers' clocks")
def test_the_watchdog_has_a_clock_that_is_never_set_back(rig, monkeypatch):
    assert rig().node.timer_clocks == ["steady", "steady"]

    class Simulated(ros_stand_ins.Node):
        def get_parameter(self, name):
            return type("Value", (), {"value": True if name == "use_sim_time" else self.parameters[name]})

    monkeypatch.setattr(ros_stand_ins, "Node", Simulated)
    assert rig().node.timer_clocks == [None, None]  # simulated time may stand still


@pytest.mark.skipif(HAS_ROS, reason="needs a remapping of the command line")
@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera_0/color/image_rect", True),
        ("/image_rectified/front", True),
        ("/direct/image", False),
        ("/rectory/image", False),
    ],
)
def test_pictures_are_not_rectified_twice(rig, monkeypatch, topic, rectified):
    monkeypatch.setattr(ros_stand_ins.Node, "remapped", {"image": topic})
    rig(rectified=True)
    if rectified:
        with pytest.raises(ValueError, match=f"rectified = false, but {topic} is named"):
            rig()
    else:
        rig()


def test_diagnostics_warn_of_a_slow_camera_and_of_a_missing_one(rig):
    r = rig(deadman=5.0)

    def told() -> tuple[Any, str]:
        r.node._diagnose()
        status = r.published[-1][1].status[0]
        return status.level, status.message

    levels = r.module.DiagnosticStatus
    r.wait(10)
    assert told() == (levels.WARN, "deadman switch is not held; no camera_info, so pictures cannot be rectified")
    r.calibrate()
    assert told() == (levels.OK, "deadman switch is not held")
    r.node.pilot.press()
    for spacing, level, said in ((140, levels.WARN, "drives by a picture every 0.14 s"), (100, levels.OK, "drives")):
        for k in range(8):
            r.wait(spacing)
            r.show(k)
        if not HAS_ROS:  # with rclpy the clocks run on
            found, message = told()
            assert found == level and message.partition(";")[0] == said


def test_plain_twists_and_diagnostics(rig):
    r = rig(stamped=False, deadman=0.0, policy_camera=[20.0, 20.0, 16.0, 9.0])
    r.node._diagnose()
    topic, array = r.published[-1]
    assert topic == "/diagnostics" and array.status[0].level == r.module.DiagnosticStatus.ERROR
    assert array.status[0].message == "waiting for a picture"
    r.calibrate()
    r.show()
    assert type(r.published[-1][1]).__name__ == "Twist"
    r.node._diagnose()
    status = r.published[-1][1].status[0]
    assert status.level == r.module.DiagnosticStatus.OK and status.message == "drives"
    assert {one.key: one.value for one in status.values}["used"] == "1"
    r.wait(210)
    r.show(1)
    for level, message in (("WARN", "drives, 1 pictures lost since the last report"), ("OK", "drives")):
        r.node._diagnose()
        status = r.published[-1][1].status[0]
        assert status.level == getattr(r.module.DiagnosticStatus, level) and status.message == message


def test_compressed_pictures_and_bad_calibrations(rig):
    from picture_bag import image

    r = rig(compressed=True, deadman=0.0)
    if not HAS_ROS:
        assert "image/compressed" in r.node.subscriptions and "image" not in r.node.subscriptions
    r.node._on_camera_info(r.module.CameraInfo())  # an uncalibrated camera's, all zeros
    message = r.stamped(r.module.CompressedImage())
    message.data = image(picture(0), 0, encoding="png").message.data.tobytes()
    r.node._on_compressed(message)
    assert "is the camera calibrated?" in r.node.pilot.command().cause
    r.calibrate()
    r.node._on_compressed(r.stamped(message))
    assert len(r.commands()) == 1
    r.node._on_camera_info(r.module.CameraInfo())  # the driver was started again without its calibration
    r.node._watch()
    assert r.commands() == [(0.0, 0.0)] and "is the camera calibrated?" in r.node.pilot.command().cause
    r.wait(1100)
    r.node._on_compressed(r.stamped(message))
    assert r.commands() == []
    r.calibrate()
    r.wait(100)
    r.node._on_compressed(r.stamped(message))
    assert len(r.commands()) == 1


def test_bad_parameters_are_one_error(rig):
    with pytest.raises(ValueError, match="policy_camera"):
        rig(policy_camera=[1.0, 2.0])
    with pytest.raises(ValueError, match="timeout = "):
        rig(timeout=0.0)
    with pytest.raises(ValueError, match="parameter rest: "):
        rig(rest=1)  # an integer
    with pytest.raises(ValueError, match="watchdog_rate = "):
        rig(watchdog_rate=0.0)


def test_a_running_node_refuses_other_parameters(rig):
    node = rig().node
    assert all(node.describe_parameter(name).read_only for name in ("timeout", "stamped", "deadman_button", "policy"))


def launch_file(monkeypatch, **arguments: str) -> tuple[dict[str, Any], list[str]]:
    """Defaults of the launch file's arguments, and the options it gives the node with these arguments."""
    at: dict[str, Any] = {}
    names = [f"launch{part}" for part in ("", ".actions", ".substitutions", "_ros", "_ros.actions")]
    for name in ("ament_index_python", "ament_index_python.packages", *names):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    sys.modules["ament_index_python.packages"].get_package_share_directory = lambda _: str(ROOT)
    declare = sys.modules["launch.actions"].DeclareLaunchArgument
    declare.side_effect = lambda name, default_value, description: at.__setitem__(name, default_value)
    # Arguments are declared before they are used.
    sys.modules["launch.substitutions"].LaunchConfiguration = lambda name: arguments.get(name, at[name])
    runpy.run_path(str(ROOT / "launch" / "twin_policy.launch.py"))["generate_launch_description"]()
    given = sys.modules["launch_ros.actions"].Node.call_args.kwargs
    file, values = given["parameters"]
    options = ["-r", f"__ns:={given['namespace']}", "--params-file", file]
    options += [word for item in values.items() for word in ("-p", ":=".join(item))]
    return at, options + [word for pair in given["remappings"] for word in ("-r", ":=".join(pair))]


@pytest.mark.slow
def test_it_drives_and_stops_across_the_middleware(monkeypatch, tmp_path):
    """The node runs in a process of its own with the launch file's options, on a robot with a namespace; pictures and
    the switch come from this process, 10 times a second.
    """
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import TwistStamped
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import Bool

    small_policy(tmp_path)
    # Limits that hold beside other programs, too.
    given = ("timeout:=1.0", "inference:=1.0", "deadman:=1.0")
    default, options = launch_file(monkeypatch, policy=str(tmp_path), namespace="/a200_0000")
    main = [sys.executable, "-c", "from twin_policy.node import main; main()", "--ros-args", *options]
    process = subprocess.Popen([*main, *(word for one in given for word in ("-p", one))])
    rclpy.init()
    client = rclpy.create_node("client", namespace="/a200_0000")
    speeds: list[float] = []
    reports: list[str] = []
    client.create_subscription(TwistStamped, default["cmd_vel"], lambda sent: speeds.append(sent.twist.linear.x), 50)
    client.create_subscription(
        DiagnosticArray, "diagnostics", lambda sent: reports.extend(one.message for one in sent.status), 50
    )
    kinds = {"image": Image, "camera_info": CameraInfo, "deadman": Bool}
    topics = {name: client.create_publisher(kind, default.get(name, name), 1) for name, kind in kinds.items()}

    def play(seconds: float, shown: bool, held: bool, until: Any = lambda: False) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            image = Image()
            image.header.stamp = client.get_clock().now().to_msg()
            if shown:
                topics["image"].publish(filled(image, 0))
            topics["camera_info"].publish(calibrated(CameraInfo()))
            topics["deadman"].publish(Bool(data=held))
            rest = time.monotonic() + 0.1
            while time.monotonic() < rest:
                rclpy.spin_once(client, timeout_sec=0.02)

    try:
        play(30.0, shown=True, held=True, until=lambda: any(speeds))
        assert any(speeds)
        play(3.0, shown=False, held=True)
        speeds.clear()
        play(1.0, shown=False, held=True)
        assert set(speeds) == {0.0}  # without pictures, nothing but stops
        play(20.0, shown=True, held=True, until=lambda: any(speeds))
        assert any(speeds)
        play(3.0, shown=True, held=False)
        assert speeds[-1] == 0.0
        speeds.clear()
        play(1.0, shown=True, held=False)
        assert speeds == []  # another source may drive
        assert any(report.startswith("drives") for report in reports)
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == 0
    finally:
        process.kill()
        client.destroy_node()
        rclpy.shutdown()


# ---- what the package says


def test_the_yaml_names_every_parameter_of_the_node_with_its_default():
    """The node declares each parameter of the file with the same type, and no other."""
    text = (ROOT / "config" / "twin_policy.yaml").read_text()
    given = YAML(typ="safe").load(text)["/**"]["ros__parameters"]
    tree = ast.parse((ROOT / "twin_policy" / "node.py").read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    literal = {
        c.args[0].value: c.args[1] for c in calls if c.func.id == "parameter" and isinstance(c.args[0], ast.Constant)
    }
    from twin_policy import Limits

    limits = {name: getattr(Limits, name) for name in ("timeout", "inference", "ahead", "clock_jump", "early", "rest")}
    expected = {name: ast.literal_eval(value) for name, value in literal.items()} | limits
    assert given == expected
    assert {name: type(value) for name, value in given.items()} == {
        name: type(value) for name, value in expected.items()
    }


def test_the_launch_file_requires_the_policy_and_nothing_else(monkeypatch):
    """As it replaces the parameter file's policy, a default would replace it by none."""
    default, options = launch_file(monkeypatch, policy="/data/first")
    assert [name for name, value in default.items() if value is None] == ["policy"]
    assert {"policy:=/data/first", "__ns:=", "/diagnostics:=diagnostics"} <= set(options)


def test_the_package_is_one_for_colcon():
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("export/build_type") == "ament_python"
    depends = {one.text for one in package.findall("exec_depend")}
    tree = ast.parse((ROOT / "twin_policy" / "node.py").read_text())
    froms = {node.module.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert froms & {"rclpy", *ros_stand_ins.MESSAGES} <= depends
    assert (ROOT / "resource" / package.findtext("name")).exists()


def test_the_core_needs_three_packages_and_python_3_10():
    """The syntax is that of 3.10; imports are the standard library, numpy, cv2, onnxruntime and, in the node, rclpy's
    packages.
    """
    for path in (ROOT / "twin_policy").glob("*.py"):
        tree = ast.parse(path.read_text(), feature_version=(3, 10))
        names = {alias.name.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
        names |= {n.module.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        foreign = names - set(sys.stdlib_module_names) - {"numpy", "cv2", "onnxruntime", "twin_policy"}
        if path.name == "node.py":
            foreign -= {"rclpy", *ros_stand_ins.MESSAGES}
        assert not foreign, (path.name, foreign)


@pytest.mark.slow
def test_a_wheel_has_all_that_a_robot_needs(tmp_path):
    shutil.copytree(ROOT, tmp_path / "source")  # building leaves folders behind
    command = [sys.executable, "-m", "pip", "wheel", "--no-build-isolation", "--no-deps", "-q", "-w", tmp_path]
    subprocess.run([*command, tmp_path / "source"], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for wanted in ("twin_policy/node.py", "launch/twin_policy.launch.py", "config/twin_policy.yaml", "package.xml"):
        assert any(name.endswith(wanted) for name in names), names
    assert not any(name.startswith("twin/") for name in names)
