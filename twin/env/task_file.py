"""A task as a JSON file, for whoever runs trials without this package: the line, its width, the rules and the pictures.

    {"format": "twin task", "version": 1, "name": "straight", "line": [[x, y, z], ...], "half_width": 1.0, ...}

Coordinates are those of the scene, metres, z up. The rules are those of `twin.env.task.RewardAndTermination`, stated as
numbers, so that another judge needs none of its code.
"""

import math
from pathlib import Path
from typing import Any

from twin.env.options import Options
from twin.env.route_segments import RouteSegment
from twin.env.task import BUMPER_OFFSET, ROLLOVER_COSINE, STUCK_DISTANCE, STUCK_TIME, RewardAndTermination
from twin.files import write_json
from twin.mjcf.world import World, heading_at, point_at

FORMAT, VERSION = "twin task", 1


def task_table(world: World, segment: RouteSegment, options: Options) -> dict[str, Any]:
    """The contents of the file, JSON-able.

    `line` is on the ground [m], shape (m, 3), in driving order; stations are arc lengths along it [m]. `start.pose` is x, y [m] and
    yaw [rad]; trials begin within ± `offset` [m] beside it and ± `heading` [°] of it. `goal` is the station that the
    base must reach; `give_up` [m], [s] ends a trial that moves less than that in that time; `max_tilt` [rad].
    `camera` is the seat of the twin's camera: forward, left and up from the base on the ground [m], downward pitch,
    yaw to the left, roll to the right [°], fx, fy, cx, cy and width, height [px]. A control step takes
    `control_timestep` [s]; a policy gets the last `stack` pictures.
    """
    rules, robot = RewardAndTermination(world, segment, options), world.robot
    route = world.route[:, :2]
    x, y = point_at(route, segment.start).tolist()
    camera = robot.camera(world.camera)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": segment.name,
        "line": world.route.tolist(),
        "half_width": rules.half_width,
        "start": {
            "station": segment.start,
            "pose": [x, y, float(heading_at(route, segment.start))],
            "offset": options.start_offset,
            "heading": options.start_heading,
        },
        "goal": segment.end - BUMPER_OFFSET,
        "time_limit": rules.time_limit,
        "give_up": {"distance": STUCK_DISTANCE, "time": STUCK_TIME},
        "max_tilt": math.acos(ROLLOVER_COSINE),
        "limits": {"speed": options.speed, "yaw_rate": options.yaw_rate},
        "control_timestep": options.control_timestep,
        "camera": {
            "position": [*robot.camera_offset, robot.camera_height],
            "angles": [robot.camera_pitch, robot.camera_yaw, robot.camera_roll],
            "intrinsics": list(camera.intrinsics),
            "size": list(camera.size),
        },
        "pictures": {"size": list(options.size), "stack": options.stack},
    }


def write_task(path: Path, world: World, segment: RouteSegment, options: Options) -> None:
    """Writes `task_table` to a file."""
    write_json(path, task_table(world, segment, options))
