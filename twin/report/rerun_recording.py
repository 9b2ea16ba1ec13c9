"""Writes a drive as a recording for Rerun (rerun.io), with one timeline [s]:

world/route, world/corridor, world/goal   the route and the corridor's edges as lines, the goal as a point
world/driven                              the robot's path so far
world/robot                               the robot's pose and size
world/robot/camera                        the front camera with its pictures
world/obstacles                           positions of the obstacles
speed/wanted, yaw_rate/wanted             speed and yaw rate that the driver commands
speed/driven, yaw_rate/driven             speed and yaw rate of the robot
cross_track, progress                     distance from the route, and along it [m]
trust, reward                             trust in the picture, 0 to 1; reward per step
events                                    lighting, randomization, and how the drive ended
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.env.episode import Episode
from twin.env.obstacles import obstacle_pose
from twin.errors import InputError
from twin.geometry.polyline import corridor_edges
from twin.mjcf.world import World
from twin.types import Array

if TYPE_CHECKING:
    import rerun

TIMELINE = "drive"
"""Name of the timeline, in seconds since the start of the drive."""

_JPEG_QUALITY = 90
_ROBOT_SIZE = (0.99, 0.67, 0.39)  # [m] length, width and height of a Husky
_ROUTE_COLOR, _CORRIDOR_COLOR, _DRIVEN_COLOR, _GOAL_COLOR = 0xFFD600FF, 0x00C8FFFF, 0xFF5733FF, 0x81C784FF
_OBSTACLE_COLOR = 0xBA68C8FF


def require_rerun() -> None:
    """Raises InputError if rerun-sdk is not installed."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        raise InputError("a Rerun recording needs the missing package rerun-sdk: pip install 'twin[rerun]'") from None


def write_rerun_recording(
    path: Path,
    episode: Episode,
    pictures: Sequence[NDArray[np.uint8]],
    motion: Array,
    commands: Array,
    camera_to_base: Array,
    world: World,
    half_width: float,
    name: str,
) -> None:
    """Writes a drive of k instants as an `.rrd` file.

    Args:
        path: The `.rrd` file.
        episode: The drive.
        pictures: The robot's picture at each instant, k arrays of shape (height, width, 3).
        motion: Speed [m/s] and yaw rate [rad/s] at each instant, shape (k, 2).
        commands: Commanded speed [m/s] and yaw rate [rad/s] at each instant, shape (k, 2).
        camera_to_base: Pose of the front camera (OpenCV axes) on the robot, shape (4, 4).
        world: The world of the episode.
        half_width: Half width of the corridor [m].
        name: Name of the recording.
    """
    import rerun as rr

    recording = rr.RecordingStream("twin", recording_id=f"{name} {episode.seed}")
    recording.save(path, default_blueprint=_blueprint())
    recording.send_recording_name(name)
    _log_place(recording, world, half_width, camera_to_base, pictures[0].shape[:2])
    driven = episode.base_to_world[:, :3, 3]
    for k, time in enumerate(episode.times.tolist()):
        recording.set_time(TIMELINE, duration=time)
        quaternion = Rotation.from_matrix(episode.base_to_world[k, :3, :3]).as_quat()
        recording.log("world/robot", rr.Transform3D(translation=driven[k], quaternion=rr.Quaternion(xyzw=quaternion)))
        recording.log("world/driven", rr.LineStrips3D([driven[: k + 1]], colors=[_DRIVEN_COLOR]))
        recording.log("world/robot/camera", rr.Image(pictures[k]).compress(_JPEG_QUALITY))
        if episode.obstacles:
            at = np.array([obstacle_pose(one, world.route, time) for one in episode.obstacles])
            ground = np.full(len(at), driven[k, 2])
            points = np.column_stack([at[:, :2], ground])
            labels = [one.name or one.kind for one in episode.obstacles]
            recording.log("world/obstacles", rr.Points3D(points, radii=0.3, colors=_OBSTACLE_COLOR, labels=labels))
        for entity, value in (
            ("speed/wanted", commands[k, 0]),
            ("speed/driven", motion[k, 0]),
            ("yaw_rate/wanted", commands[k, 1]),
            ("yaw_rate/driven", motion[k, 1]),
            ("cross_track", episode.cross_track[k]),
            ("progress", episode.progress[k]),
            ("trust", episode.trust[k]),
            ("reward", episode.rewards[k]),
        ):
            recording.log(entity, rr.Scalars(float(value)))
    end = f"{episode.cause or 'cut off'} after {episode.progress[-1]:.1f} m"
    recording.log("events", rr.TextLog(end, level="INFO" if episode.success else "WARN"))
    recording.set_time(TIMELINE, duration=0.0)
    drawn = json.dumps(episode.randomisation)
    for text in (f"task {episode.task}, seed {episode.seed}", f"lighting {episode.lighting}", f"randomization {drawn}"):
        recording.log("events", rr.TextLog(text, level="INFO"))
    recording.flush()
    recording.disconnect()


def _log_place(
    recording: "rerun.RecordingStream", world: World, half_width: float, camera_to_base: Array, size: tuple[int, int]
) -> None:
    import rerun as rr

    left, right = corridor_edges(world.route, half_width)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("world/route", rr.LineStrips3D([world.route], colors=[_ROUTE_COLOR]), static=True)
    recording.log("world/corridor", rr.LineStrips3D([left, right], colors=[_CORRIDOR_COLOR]), static=True)
    recording.log("world/goal", rr.Points3D([world.goal], radii=0.2, colors=[_GOAL_COLOR]), static=True)
    recording.log(
        "world/robot",
        rr.Boxes3D(sizes=[_ROBOT_SIZE], centers=[(0.0, 0.0, _ROBOT_SIZE[2] / 2)], colors=[_DRIVEN_COLOR]),
        static=True,
    )
    pose = rr.Transform3D(translation=camera_to_base[:3, 3], mat3x3=camera_to_base[:3, :3])
    height, width = size
    fx, fy, cx, cy = world.camera.resized((width, height)).intrinsics
    lens = rr.Pinhole(
        image_from_camera=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        resolution=[width, height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.6,
    )
    recording.log("world/robot/camera", pose, lens, static=True)


def _blueprint() -> "rerun.blueprint.Blueprint":
    import rerun.blueprint as rrb

    curves = [
        rrb.TimeSeriesView(origin="speed", name="Speed [m/s]"),
        rrb.TimeSeriesView(origin="yaw_rate", name="Yaw rate [rad/s]"),
        rrb.TimeSeriesView(contents=["trust", "reward"], name="Trust and reward"),
        rrb.TimeSeriesView(contents=["cross_track"], name="Cross-track error [m]"),
    ]
    seen = rrb.Spatial2DView(origin="world/robot/camera", name="What the robot sees")
    place = rrb.Spatial3DView(origin="world", name="Place")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(place, rrb.TextLogView(origin="events", name="Events")), rrb.Vertical(seen, *curves)
        ),
        collapse_panels=True,
    )
