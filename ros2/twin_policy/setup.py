"""Installs with pip, or colcon as an ament_python package. Humble's setuptools (59) cannot read a [project] table."""

from setuptools import setup

setup(
    name="twin_policy",
    version="0.1.0",
    description="Drives a robot by a driving policy of twin: camera pictures in, velocity commands out.",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=["twin_policy"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/twin_policy"]),
        ("share/twin_policy", ["package.xml"]),
        ("share/twin_policy/launch", ["launch/twin_policy.launch.py"]),
        ("share/twin_policy/config", ["config/twin_policy.yaml"]),
    ],
    # onnxruntime 1.16 is the first with the operators of a policy, and the last for CUDA 11 on a Jetson.
    install_requires=["numpy>=1.21", "opencv-python-headless>=4.5", "onnxruntime>=1.16"],
    zip_safe=True,
    entry_points={"console_scripts": ["policy_node = twin_policy.node:main"]},
)
