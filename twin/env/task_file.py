"""A task as a JSON file (line, width, limits, start) for programs that do not use this package.

    {"format": "twin task", "version": 1, "name": "straight", "line": [[x, y, z], ...], "half_width": 1.0, ...}

The file contains the numbers of `twin.env.task.RewardAndTermination`, so that other programs can evaluate drives by the
same rules.
"""

import math
from pathlib import Path
from typing import Any

from twin.env.options import Options
from twin.env.route_segments import RouteSegment
from twin.env.task import BUMPER_OFFSET, ROLLOVER_COSINE, STUCK_DISTANCE, STUCK_TIME, RewardAndTermination
from twin.files import write_json
from twin.mjcf.world import World

FORMAT, VERSION = "twin task", 1


def task_table(world: World, segment: RouteSegment, options: Options) -> dict[str, Any]:
    """The contents of the file, in the scene's frame (z up), meters, seconds, radians.

    `line` (m, 3) is on the ground, in driving order; a *station* is a horizontal arc length along it. Trials start at
    `start.station`, up to `start.offset` beside the line and turned by up to `start.heading` from its direction. They
    succeed when the base reaches the station `goal`. They fail

    - when the base is further than `half_width` from the line;
    - when the robot touches an object;
    - when the robot tilts by more than `max_tilt`;
    - when the robot moves by less than `stuck.distance` in `stuck.time`;
    - after `time_limit`.

    Commands come every `control_timestep` and are bounded by `limits`.
    """
    rules = RewardAndTermination(world, segment, options)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": segment.name,
        "line": world.route.tolist(),
        "half_width": rules.half_width,
        "start": {
            "station": segment.start,
            "offset": options.start_offset,
            "heading": math.radians(options.start_heading),
        },
        "goal": segment.end - BUMPER_OFFSET,
        "time_limit": rules.time_limit,
        "stuck": {"distance": STUCK_DISTANCE, "time": STUCK_TIME},
        "max_tilt": math.acos(ROLLOVER_COSINE),
        "limits": {"speed": options.speed, "yaw_rate": options.yaw_rate},
        "control_timestep": options.control_timestep,
    }


def write_task(path: Path, world: World, segment: RouteSegment, options: Options) -> None:
    write_json(path, task_table(world, segment, options))
