"""Reality's own Husky: what the training side is not told, drawn once.

Every value is uniform in the range stated here, from a fixed seed, and stays the same through all trials and the drive
log, as one robot's would. What is printed on the robot (its controller's limits, its track) is as published.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.config import MjcfConfig
from twin.env.camera_noise import CameraNoise, CameraOptions
from twin.env.obstacles import EpisodeObstacles
from twin.env.options import Options
from twin.env.physics import DrivePhysics
from twin.env.route_segments import RouteSegment, find_task
from twin.env.task import DriveTask
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.route import route_length, smooth_route
from twin.mjcf import husky
from twin.mjcf.scene_xml import rest_pose
from twin.mjcf.world import World, heading_at, point_at
from twin.reality import place as places
from twin.reality import true_world as worlds
from twin.reality.centerline import RoadLine, ground_height
from twin.reality.filming import FilmingPlan, develop, smooth_noise, trajectory
from twin.reality.lighting import Lighting, hazed
from twin.reality.rasterizer import Raster
from twin.reality.things import SEED, KnownPlace, Thing
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.types import Array


@dataclass(frozen=True)
class HiddenRobot:
    """One Husky with its front camera."""

    params: HuskyParams
    camera_turn: tuple[float, float, float]
    """By which the camera is mounted askew, about its axes right, up, back [°]."""
    camera: CameraOptions
    """Vibration and shutter; exposure is `exposure_drift`, for it acts on light and not on a finished picture."""
    exposure_drift: float
    """Standard deviation of the logarithm of the exposure."""


def robot() -> HiddenRobot:
    """The one there is."""
    rng = np.random.default_rng([SEED, 41])

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    radius = WHEEL_RADIUS * between(0.975, 1.0)
    film = FilmingPlan()
    zoom = between(0.985, 1.015)
    fx, fy, cx, cy = film.intrinsics.tolist()
    params = HuskyParams(
        center_of_mass=(between(-0.05, 0.0), between(-0.01, 0.01), 0.062),
        payload_mass=between(6.0, 14.0),
        payload_position=(between(-0.10, 0.10), between(-0.04, 0.04), 0.33),
        friction=between(0.55, 0.9),
        rolling_resistance=between(0.015, 0.03),
        wheel_radius=(radius * between(0.996, 1.004), radius * between(0.996, 1.004)),
        servo_lag=between(0.05, 0.12),
        motor_torque=between(50.0, 65.0),
        command_latency=between(0.03, 0.08),
        camera_height=0.6 + between(-0.015, 0.015),
        camera_offset=(0.36 + between(-0.02, 0.02), between(-0.015, 0.015)),
        camera_pitch=5.0 + between(-0.8, 0.8),
        camera_latency=between(0.04, 0.09),
        camera_intrinsics=(fx * zoom, fy * zoom, cx + between(-4.0, 4.0), cy + between(-4.0, 4.0)),
        camera_size=(film.width, film.height),
    )
    turn = (between(-0.4, 0.4), between(-0.6, 0.6), between(-0.6, 0.6))
    camera = CameraOptions(vibration=between(0.15, 0.35), shutter=between(0.008, 0.02))
    return HiddenRobot(params, turn, camera, between(0.06, 0.12))


# ---- The road as the robot drives it: the true ground and all that is solid, on a day after the film was made.
#
# Tasks are the twin's own, by name, and mean the same places: the *route* is the path that the camera was filmed along,
# which is what a twin of the film takes for its route, here as it truly was. So are the rules of a trial, which are those
# of `twin.env.task`.


_REACH = 1.5  # [m] beyond the corridor's edge: as in the twin, what lies further is never touched
_SAME_LENGTH = 0.98  # share of the longest film's path from which on the first film counts


def route(plan: FilmingPlan | None = None, line: RoadLine | None = None) -> Array:
    """The filmed path on the true ground [m], shape (m, 3).

    Of several films the first of those within 2 % of the longest, as a build chooses.
    """
    plan, line = plan or FilmingPlan(), line or RoadLine()
    paths = [smooth_route(trajectory(plan, line, lighting)[1][:, :3, 3]) for lighting in plan.lightings]
    lengths = np.array([route_length(path) for path in paths])
    xy = paths[int(np.argmax(lengths >= _SAME_LENGTH * lengths.max()))]
    return np.column_stack([xy, ground_height(line, xy)])


@cache
def place_robot() -> KnownPlace:
    """The place on the day of the trials."""
    return places.build(later=True)


class TrueRoad:
    """One task of the real test."""

    def __init__(self, task: str, robot: HiddenRobot, options: Options) -> None:
        """
        Args:
            task: As in the twin: straight, right_turn or route.
            robot: Drives.
            options: What a policy's numbers mean; its pictures are none of the road's business.

        Raises:
            InputError: no such task.
        """
        line = route()
        half_width = MjcfConfig().half_width
        yaw = float(heading_at(line, 0.0))
        start, quaternion = rest_pose(lambda xy: ground_height(place_robot().route, xy), line[0, :2], yaw)
        self.world = World(line, half_width, (*start.tolist(), yaw), Path(), robot=robot.params)
        self.stretch: RouteSegment = find_task(task, self.world)
        spec = worlds.solids(self._near(half_width + _REACH))
        husky.set_options(spec, robot.params)
        husky.add_husky(spec, start, quaternion, robot.params)
        self.model = spec.compile()
        _mount(self.model, robot.camera_turn)
        self.physics = DrivePhysics.of(self.model, robot.params)
        none = EpisodeObstacles((), self.world, self.stretch)
        self.drive = DriveTask(self.world, self.stretch, options, none, self.model)

    def intrinsics(self, size: tuple[int, int]) -> Array:
        """fx, fy, cx, cy [px] of the robot's camera with pictures of a size (width, height), shape (4,)."""
        return np.array(self.world.robot.camera().resized(size).intrinsics)

    def _near(self, reach: float) -> KnownPlace:
        """The place with nothing solid further than `reach` [m] from the stretch."""
        s = self.stretch
        along = cKDTree(point_at(self.world.route[:, :2], np.arange(s.start, s.end + 0.1, 0.1)))

        def near(thing: Thing) -> bool:
            return any(
                along.query(one.centre[:2])[0] - np.hypot(one.half[0], one.half[1]) <= reach for one in thing.solids
            )

        return KnownPlace(place_robot().route, [thing for thing in place_robot().things if near(thing)], [])


def _mount(model: mujoco.MjModel, turn: tuple[float, float, float]) -> None:
    """Turns the front camera about its axes by angles [°]."""
    camera = model.camera("front").id
    rotation, quaternion = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.deg2rad(turn), "xyz")
    mujoco.mju_mulQuat(quaternion, model.cam_quat[camera], rotation)
    model.cam_quat[camera] = quaternion


# ---- What the robot's camera makes of the world: it shakes, its shutter smears, haze dims, the sensor develops and adds
# noise. Numbers: `real_robot.py` and the lighting.


_SKY = 1.0e4  # [m] away, where smearing is concerned
_DRIFT_TIME = 9.0  # [s] of the exposure
_TICK = 0.1  # [s] between two values of it
_NOISE = 0.5  # of a film frame's, whose pixels are a quarter as wide; a resized picture has less


class RealCamera:
    """One camera in one trial; the same generator and the same poses give the same pictures."""

    def __init__(
        self,
        raster: Raster,
        lighting: Lighting,
        robot: HiddenRobot,
        intrinsics: Array,
        size: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """
        Args:
            raster: Of the place under the lighting, with these intrinsics and this size.
            lighting: Exposure, noise, haze.
            robot: Whose camera it is.
            intrinsics: fx, fy, cx, cy [px], shape (4,).
            size: Width, height [px].
            rng: Of the trial.
        """
        self._raster, self._robot, self._intrinsics, self._rng = raster, robot, intrinsics, rng
        self._lighting = replace(lighting, noise=_NOISE * lighting.noise)
        self._rays = unproject(pixel_grid(*size), intrinsics)
        self._effects = CameraNoise(robot.camera, rng)
        self._times = np.arange(0.0, 600.0, _TICK)
        self._gains = np.exp(robot.exposure_drift * smooth_noise(rng, self._times, _DRIFT_TIME))

    def look(self, camera_to_world: Array, time: float) -> NDArray[np.uint8]:
        """The picture (h, w, 3) of a camera that would be at a pose (4, 4) if it did not shake, at a time [s]."""
        pose = self._effects.shaken(camera_to_world, time)
        light, depth = self._raster(pose)
        light = hazed(light, depth, self._lighting)
        far = np.where(depth > 0.0, depth, np.float32(_SKY))
        light = self._effects.exposed(light, far, pose, time, self._rays, self._intrinsics)
        return develop(self._rng, light, self._lighting, float(np.interp(time, self._times, self._gains)))
