"""Stand-ins for rclpy and ROS 2's messages, for machines without ROS.

Messages have the fields and defaults of their real definitions (Jazzy's, from rosbags) and refuse others, as generated
classes do. `rclpy` has what `twin_policy.node` uses, with the signatures of rclpy's documentation.
"""

import sys
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

FIELDS = get_typestore(Stores.ROS2_JAZZY).fielddefs
MESSAGES = {
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    "geometry_msgs": ("Twist", "TwistStamped"),
    "rcl_interfaces": ("ParameterDescriptor",),
    "sensor_msgs": ("CameraInfo", "CompressedImage", "Image", "Joy"),
    "std_msgs": ("Bool",),
}
_ZEROS = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0, "byte": b"\0", "octet": b"\0"}


@cache
def message_class(name: str) -> type:
    """The class of a message such as geometry_msgs/msg/Twist; its fields can be given as keywords."""
    constants, fields = FIELDS[name]

    class Message:
        __slots__ = tuple(field for field, _ in fields)

        def __init__(self, **given: Any) -> None:
            for field, kind in fields:
                setattr(self, field, given.pop(field) if field in given else _default(kind))
            assert not given, f"{name} has no {', '.join(given)}"

    for constant, _, value in constants:
        setattr(Message, constant, bytes([value]) if name.endswith("DiagnosticStatus") else value)
    Message.__name__ = name.rpartition("/")[2]
    return Message


def _default(kind: Any) -> Any:
    node, detail = kind
    if node == Nodetype.BASE:
        return _ZEROS.get(detail[0] if isinstance(detail, tuple) else detail, 0)
    if node == Nodetype.NAME:
        return message_class(detail)()
    if node == Nodetype.ARRAY:
        return [_default(detail[0])] * detail[1]
    return []


class Node:
    """rclpy.node.Node, with a clock that a test sets."""

    overrides: ClassVar[dict[str, Any]] = {}
    remapped: ClassVar[dict[str, str]] = {}

    def __init__(self, node_name: str) -> None:
        self.name, self.time = node_name, 0
        self.parameters: dict[str, Any] = {"use_sim_time": False}
        self.descriptors: dict[str, Any] = {}
        self.published: list[tuple[str, Any]] = []
        self.subscriptions: dict[str, tuple[type, Any]] = {}
        self.timers: list[tuple[float, Any]] = []
        self.timer_clocks: list[Any] = []
        self.lines: list[str] = []

    def declare_parameter(self, name: str, value: Any = None, descriptor: Any = None) -> Any:
        assert name not in self.parameters
        self.descriptors[name] = descriptor
        self.parameters[name] = self.overrides.get(name, value)
        if type(self.parameters[name]) is not type(value):  # rclpy's parameters keep the type of their default
            raise TypeError(f"Trying to set parameter '{name}' to '{self.parameters[name]}'")
        return SimpleNamespace(value=self.parameters[name])

    def describe_parameter(self, name: str) -> Any:
        return self.descriptors[name]

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.parameters[name])

    def create_subscription(self, msg_type: type, topic: str, callback: Any, qos_profile: Any) -> None:
        self.subscriptions[topic] = msg_type, callback

    def create_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Any:
        def publish(sent: Any) -> None:
            assert type(sent) is msg_type
            self.published.append((topic, sent))

        return SimpleNamespace(publish=publish)

    def create_timer(self, timer_period_sec: float, callback: Any, *, clock: Any = None) -> None:
        self.timers.append((timer_period_sec, callback))
        self.timer_clocks.append(clock)

    def resolve_topic_name(self, topic: str) -> str:
        return self.remapped.get(topic, f"/{topic}")

    def get_clock(self) -> Any:
        stamp = message_class("builtin_interfaces/msg/Time")(sec=self.time // 10**9, nanosec=self.time % 10**9)
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.time, to_msg=lambda: stamp))

    def get_logger(self) -> Any:
        def say(text: str, throttle_duration_sec: float = 0.0) -> None:
            self.lines.append(text)

        return SimpleNamespace(info=say, warning=say, error=say)


def install(monkeypatch: Any) -> None:
    """Installs the stand-ins under the real modules' names until the test ends."""
    modules = {name: ModuleType(name) for name in ("rclpy", "rclpy.clock", "rclpy.node", "rclpy.qos", "rclpy.signals")}
    modules["rclpy.node"].Node = Node
    modules["rclpy.clock"].ClockType = SimpleNamespace(STEADY_TIME="steady")
    modules["rclpy.clock"].Clock = lambda *, clock_type: clock_type
    modules["rclpy.qos"].QoSProfile = lambda depth, reliability: SimpleNamespace(depth=depth, reliability=reliability)
    modules["rclpy.qos"].ReliabilityPolicy = SimpleNamespace(BEST_EFFORT=2)
    modules["rclpy.signals"].SignalHandlerOptions = SimpleNamespace(NO=0)
    for package, names in MESSAGES.items():
        modules[package], modules[f"{package}.msg"] = ModuleType(package), ModuleType(f"{package}.msg")
        for name in names:
            setattr(modules[f"{package}.msg"], name, message_class(f"{package}/msg/{name}"))
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
