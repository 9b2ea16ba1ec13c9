"""ROS 2 node: pictures and camera_info in, velocity commands and diagnostics out, with a deadman switch.

A driving command is published once, as soon as the policy has processed its picture. A stop is published at once and
then at `watchdog_rate`; after the deadman switch is released, only for one second, so that another node may drive the
robot. The watchdog runs on a clock that nothing sets back, except with simulated time.
"""

import re
import signal
import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Joy
from std_msgs.msg import Bool

from twin_policy.onnx_policy import OnnxPolicy
from twin_policy.pictures import Camera, CompressedPicture, PictureError, RawPicture
from twin_policy.pilot import DEADMAN, Command, Limits, Pilot

_MAX_SPACING = 1.1  # [control steps] mean time between used pictures beyond which diagnostics warn
_SILENT_AFTER = 1_000_000_000  # [ns] for which stops are published after the deadman switch was released


class PolicyNode(Node):
    """Drives a robot by a policy; `config/twin_policy.yaml` explains the parameters."""

    def __init__(self, **options: Any) -> None:
        super().__init__("twin_policy", **options)

        def parameter(name: str, default: Any) -> Any:
            # Read-only: a change while the node runs would have no effect. rclpy keeps and completes the descriptor.
            try:
                return self.declare_parameter(name, default, ParameterDescriptor(read_only=True)).value
            except Exception as error:  # another type than the default's, such as 1 for 1.0
                raise ValueError(f"parameter {name}: {error}") from None

        policy = OnnxPolicy(parameter("policy", ""))
        limits = Limits(
            **{
                name: float(parameter(name, getattr(Limits, name)))
                for name in ("timeout", "inference", "ahead", "clock_jump", "early", "rest")
            },
            deadman=float(parameter("deadman", 0.5)),
        )
        pinhole = [float(x) for x in parameter("policy_camera", [0.0]) if x]
        if len(pinhole) not in (0, 4):
            raise ValueError(f"policy_camera = {pinhole}; expected fx, fy, cx, cy at {policy.size} px, or nothing")
        camera = Camera(policy.size, (pinhole[0], pinhole[1], pinhole[2], pinhole[3])) if pinhole else None
        simulated = self.get_parameter("use_sim_time").value
        self._steady = self._now if simulated else time.monotonic_ns
        self.pilot = Pilot(policy, limits, camera, self._now, self._steady)
        self._rectified, self._frame = parameter("rectified", False), parameter("frame_id", "base_link")
        self._button, self._said, self._released = int(parameter("deadman_button", -1)), "", self._steady()
        self._stamped = parameter("stamped", True)
        self._sent = 0  # stamp of the picture behind the last driving command [ns]
        self._driving = False  # whether the last published command drives
        self._spacings: list[int] = []  # times between used pictures since the last diagnostics [ns]
        self._lost = 0  # pictures lost until the last diagnostics
        self._commands = self.create_publisher(TwistStamped if self._stamped else Twist, "cmd_vel", 1)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        if parameter("compressed", False):
            kind, name, handle = CompressedImage, "image/compressed", self._on_compressed
        else:
            kind, name, handle = Image, "image", self._on_image
        self.create_subscription(kind, name, handle, newest)
        topic = self.resolve_topic_name(name)
        if re.search(r"(^|[/_])rect(ified)?($|[/_])", topic) and not self._rectified:
            raise ValueError(
                f"rectified = false, but {topic} is named as rectified pictures are; set rectified to true, since the "
                "distortion would be removed twice"
            )
        self.create_subscription(CameraInfo, "camera_info", self._on_camera_info, newest)
        if self._button < 0:
            self.create_subscription(Bool, "deadman", lambda message: self.pilot.press(message.data), 1)
        else:
            self.create_subscription(Joy, "joy", self._on_joy, 1)
        rate = float(parameter("watchdog_rate", 20.0))
        if not 1.0 <= rate <= 1000.0:
            raise ValueError(f"watchdog_rate = {rate}; expected 1 to 1000 Hz")
        # By default a timer has the system's clock, and stands still when that is set back.
        clock = None if simulated else Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / rate, self._watch, clock=clock)
        self.create_timer(1.0, self._diagnose, clock=clock)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds

    # ---- inputs

    def _on_image(self, message: Any) -> None:
        raw = RawPicture(message.encoding, message.width, message.height, message.step, message.data)
        self._on_picture(raw, message.header)

    def _on_compressed(self, message: Any) -> None:
        self._on_picture(CompressedPicture(message.data), message.header)

    def _on_picture(self, picture: Any, header: Any) -> None:
        stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        command = self.pilot.picture(picture, stamp)
        if command.drives and command.stamp == stamp != self._sent:
            if self._driving:
                self._spacings.append(stamp - self._sent)
            self._sent = stamp
            self._publish(command)
        elif self._driving and not command.drives:
            self._publish(command)

    def _on_camera_info(self, message: Any) -> None:
        try:
            self.pilot.set_camera(Camera.from_info(message, self._rectified))
        except PictureError as error:
            self.pilot.lose_camera(f"camera_info: {error}")
            self.get_logger().error(f"camera_info: {error}", throttle_duration_sec=5.0)

    def _on_joy(self, message: Any) -> None:
        self.pilot.press(self._button < len(message.buttons) and bool(message.buttons[self._button]))

    # ---- outputs

    def _watch(self) -> None:
        command = self.pilot.command()
        said = re.sub(r"\d", "", command.cause)  # another age of late pictures is nothing new
        if said != self._said:
            self.get_logger().warning(f"stop: {command.cause}") if command.cause else self.get_logger().info("drives")
            self._said = said
        if command.cause != DEADMAN:
            self._released = self._steady()
        if not command.drives and self._steady() - self._released <= _SILENT_AFTER:
            self._publish(command)

    def _publish(self, command: Command) -> None:
        message = TwistStamped() if self._stamped else Twist()
        twist = message.twist if self._stamped else message
        twist.linear.x, twist.angular.z = command.v, command.yaw_rate
        if self._stamped:
            message.header.stamp, message.header.frame_id = self.get_clock().now().to_msg(), self._frame
        self._driving = command.drives
        self._commands.publish(message)

    def _diagnose(self) -> None:
        pilot, command = self.pilot, self.pilot.command()
        level = DiagnosticStatus.OK if command.drives or command.cause == DEADMAN else DiagnosticStatus.ERROR
        lost, self._lost = pilot.counts["lost"] - self._lost, pilot.counts["lost"]
        spacings, self._spacings = self._spacings, []
        spacing = 1e-9 * sum(spacings) / max(1, len(spacings))
        said = command.cause or "drives"
        if command.drives and lost:
            level, said = DiagnosticStatus.WARN, f"drives, {lost} pictures lost since the last report"
        elif command.drives and len(spacings) > 1 and spacing > _MAX_SPACING * pilot.policy.timestep:
            level = DiagnosticStatus.WARN
            said = f"drives by a picture every {spacing:.2f} s; the policy expects {pilot.policy.timestep:g} s"
        elif command.cause == DEADMAN and not pilot.has_camera:
            level, said = DiagnosticStatus.WARN, f"{DEADMAN}; {pilot.no_camera}"
        facts = {"policy": pilot.policy.name, "milliseconds": f"{1e3 * pilot.duration:.1f}", **pilot.counts}
        values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        status = DiagnosticStatus(level=level, name="twin_policy", message=said, values=values)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def stop(self) -> None:
        """Publishes a stop; called at the end of the process."""
        self._publish(Command(cause="shutdown"))


def main() -> None:
    """Runs the node until SIGINT, SIGTERM or SIGHUP, the end of its terminal; then the robot stops."""
    # With rclpy's own handlers, nothing could be published after a signal.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for ending in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(ending, signal.default_int_handler)
    try:
        node = PolicyNode()
    except ValueError as error:
        rclpy.logging.get_logger("twin_policy").fatal(str(error))
        raise SystemExit(2) from None
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.shutdown()
