"""Plays a ROS bag to a policy and prints the commands that it would give to a robot. Needs neither a robot nor ROS.

    pip install '.[ros]'
    twin unpack demo theirs
    twin reality bag --policy theirs/runs/first --task straight --lighting haze --out haze_1
    python examples/play_bag.py theirs/runs/first haze_1

The bag needs pictures and camera_info. Time is that of the recording, so old or missing pictures stop the robot.
"""

import argparse
from pathlib import Path

from twin.capture.bag import choose_camera_info, choose_pictures, header_time, is_rectified, open_bag, picture_of
from twin.errors import InputError
from twin_policy import Camera, Command, OnnxPolicy, PictureError, Pilot

WATCH = 50_000_000  # [ns] between two checks for missing pictures


def play(policy: Path, path: Path) -> list[tuple[int, Command]]:
    """Time [ns] and command of every picture of a bag, and of the stops between pictures."""
    now, commands = 0, []
    pilot = Pilot(OnnxPolicy(policy), clock=lambda: now, steady=lambda: now)
    with open_bag(path) as bag:
        pictures = choose_pictures(bag.connections, path)
        calibration = choose_camera_info(bag.connections, pictures)
        if calibration is None:
            raise InputError(f"{path}: no camera_info for {pictures}; record it")
        for connection, time, message in bag.messages(bag.on(pictures, calibration)):
            while commands and now + WATCH < time:
                now += WATCH
                if not (command := pilot.command()).drives and commands[-1][1].drives:
                    commands.append((now, command))
            now = time
            if connection.topic == calibration:
                pilot.set_camera(Camera.from_info(message, is_rectified(pictures)))
            else:
                commands.append((now, pilot.picture(picture_of(message), header_time(message))))
    return commands


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("bag", type=Path)
    given = parser.parse_args()
    try:
        for time, command in play(given.policy, given.bag):
            print(f"{time / 1e9:.2f} s: {command.v:.2f} m/s, {command.yaw_rate:+.2f} rad/s {command.cause}")
    except (InputError, PictureError, ValueError) as error:
        raise SystemExit(f"error: {error}") from None
