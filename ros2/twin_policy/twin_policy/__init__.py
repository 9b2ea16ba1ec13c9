"""Drives a robot by a policy of `twin`: pictures in, commands out. Needs NumPy, OpenCV and ONNX Runtime, but neither
ROS nor `twin`.

    policy = OnnxPolicy("runs/first")
    pilot = Pilot(policy, Limits())
    pilot.set_camera(Camera((1280, 720), (533.1, 533.4, 641.2, 355.8), "plumb_bob", (-0.04, 0.01, 0.0, 0.0, 0.0)))
    command = pilot.picture(CompressedPicture(jpeg), stamp)  # v [m/s], yaw rate [rad/s], or a stop with its cause

`pictures.py` decodes and rectifies, `onnx_policy.py` runs the network, `pilot.py` decides whether the robot may drive;
`node.py` connects them to ROS 2. Times are whole nanoseconds, as in ROS messages; durations in settings are seconds.
"""

from twin_policy.onnx_policy import OnnxPolicy
from twin_policy.pictures import Camera, CompressedPicture, PictureError, RawPicture, Rectifier
from twin_policy.pilot import Command, Limits, Pilot

__all__ = [
    "Camera",
    "Command",
    "CompressedPicture",
    "Limits",
    "OnnxPolicy",
    "PictureError",
    "Pilot",
    "RawPicture",
    "Rectifier",
]
__version__ = "0.1.0"
