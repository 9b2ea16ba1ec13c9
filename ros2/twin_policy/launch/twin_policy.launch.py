"""Starts the node on a Clearpath robot: ros2 launch twin_policy twin_policy.launch.py policy:=/data/first."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "policy": (None, "policy folder, or policy.onnx"),
    "namespace": ("", "the robot's namespace, such as a200_0000"),
    "image": ("sensors/camera_0/color/image", "topic of the pictures"),
    "image_compressed": ("sensors/camera_0/color/compressed", "topic of JPEG or PNG pictures, if compressed is true"),
    "camera_info": ("sensors/camera_0/color/camera_info", "topic of the calibration"),
    "cmd_vel": ("cmd_vel", "topic of the commands"),
    "joy": ("joy_teleop/joy", "topic of the joystick, if deadman_button is 0 or more"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments: `ARGUMENTS` (None: required), and `parameters`, the file with all other settings."""
    settings = Path(get_package_share_directory("twin_policy")) / "config" / "twin_policy.yaml"
    arguments = [DeclareLaunchArgument(k, default_value=v, description=d) for k, (v, d) in ARGUMENTS.items()]
    arguments.append(DeclareLaunchArgument("parameters", default_value=str(settings), description="parameters (YAML)"))
    node = Node(
        package="twin_policy",
        executable="policy_node",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("parameters"), {"policy": LaunchConfiguration("policy")}],
        remappings=[
            ("image", LaunchConfiguration("image")),
            ("image/compressed", LaunchConfiguration("image_compressed")),
            ("camera_info", LaunchConfiguration("camera_info")),
            ("cmd_vel", LaunchConfiguration("cmd_vel")),
            ("joy", LaunchConfiguration("joy")),
            ("/diagnostics", "diagnostics"),  # in the robot's namespace, where Clearpath's aggregator listens
        ],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
