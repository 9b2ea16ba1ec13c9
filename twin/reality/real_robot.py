"""The robot of the real test: a Husky with hidden parameters, the true road it drives on, and its camera.

Each hidden value is uniform in the range stated here, sampled with a fixed seed, and stays the same in all trials and
the drive log. Published values (the controller's limits, the track) are unchanged.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.config import MjcfConfig, TaskConfig
from twin.env.camera_noise import CameraNoise, CameraOptions
from twin.env.obstacles import EpisodeObstacles
from twin.env.options import Options
from twin.env.route_segments import RouteSegment, find_task
from twin.env.task import DrivePhysics, DriveTask
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.passes import path_length, smooth_path
from twin.mjcf import husky
from twin.mjcf.scene_xml import rest_pose
from twin.mjcf.world import World, heading_at, point_at
from twin.reality import SEED, true_world
from twin.reality import place as places
from twin.reality.centerline import RoadLine
from twin.reality.drawn_place import build_number
from twin.reality.filming import FilmingPlan, sensor_image, smooth_noise, trajectory
from twin.reality.lighting import Lighting, apply_haze
from twin.reality.place_objects import DrivenLine, KnownPlace, PlaceObject
from twin.reality.place_spec import draw, tasks
from twin.reality.rasterizer import SHADOW_RANGE, Rasterizer
from twin.robot import WHEEL_RADIUS, HuskyParams
from twin.types import Array


@dataclass(frozen=True)
class HiddenRobot:
    """A Husky with hidden parameters and its front camera."""

    params: HuskyParams
    camera_misalignment: tuple[float, float, float]
    """Rotation of the mounted camera about its axes right, up, back [°]."""
    camera: CameraOptions
    """Vibration and shutter. Exposure is separate, since here it acts on light and not on a finished image."""
    exposure_drift: float
    """Standard deviation of the log exposure."""


def hidden_robot() -> HiddenRobot:
    """The robot of the real test."""
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


# ---- road

_COLLISION_REACH = 1.5  # [m] beyond the corridor; as in the twin, the robot touches nothing further away
_LENGTH_TOLERANCE = 0.98  # fraction of the longest path; the first film above it gives the route


def true_route(plan: FilmingPlan | None = None, line: DrivenLine | None = None) -> Array:
    """The route: the filmed path on the true ground [m], shape (m, 3).

    As in a build, the first film within 2 % of the longest gives the path.
    """
    plan, line = plan or FilmingPlan(), line or RoadLine()
    paths = [smooth_path(trajectory(plan, line, lighting)[1][:, :3, 3]) for lighting in plan.lightings]
    lengths = np.array([path_length(path) for path in paths])
    xy = paths[int(np.argmax(lengths >= _LENGTH_TOLERANCE * lengths.max()))]
    return np.column_stack([xy, line.ground_height(xy)])


@cache
def place_on_test_day(number: int = 0) -> KnownPlace:
    """The place of a number on the day of the trials, after small objects have moved."""
    return build_number(number, displaced=True) if number else places.build(displaced=True)


def shadow_range(place: KnownPlace) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The box [m] in which the rasterizer casts shadows."""
    if place.number == 0:
        return SHADOW_RANGE
    (x0, y0), (x1, y1) = place.layout.field
    height = place.route.ground_height(place.route.at(np.linspace(0.0, place.route.length, 100)))
    return (x0, y0, float(height.min()) - 1.5), (x1, y1, float(height.max()) + 6.0)


class TrueRoad:
    """One task of the real test on the true ground, with the twin's task names and episode rules."""

    def __init__(self, task: str, robot: HiddenRobot, options: Options, number: int = 0) -> None:
        """
        Args:
            task: straight, right_turn or route; on a drawn place one of `place_spec.tasks`.
            robot: The robot that drives.
            options: Environment options of the policy, without images.
            number: Number of the place.

        Raises:
            InputError: unknown task.
        """
        self.place = place_on_test_day(number)
        spec = draw(number) if number else None
        line = true_route(FilmingPlan.of(spec) if spec else None, self.place.route)
        offered = tasks(spec.line) if spec else {}
        half_width = MjcfConfig().half_width
        yaw = float(heading_at(line, 0.0))
        start, quaternion = rest_pose(self.place.route.ground_height, line[0, :2], yaw)
        self.world = World(line, half_width, (*start.tolist(), yaw), Path(), robot=robot.params)
        self.segment: RouteSegment = find_task(
            task, self.world, tuple(TaskConfig(name, start, length) for name, (start, length) in offered.items())
        )
        model = true_world.collision_spec(self._near(half_width + _COLLISION_REACH))
        husky.set_options(model, robot.params)
        husky.add_husky(model, start, quaternion, robot.params)
        self.model = model.compile()
        _rotate_camera(self.model, robot.camera_misalignment)
        self.physics = DrivePhysics.of(self.model, robot.params)
        none = EpisodeObstacles((), self.world, self.segment)
        self.drive = DriveTask(self.world, self.segment, options, none, self.model)

    def intrinsics(self, size: tuple[int, int]) -> Array:
        """fx, fy, cx, cy [px] of the robot's camera for images of a size (width, height), shape (4,)."""
        return np.array(self.world.robot.camera().resized(size).intrinsics)

    def _near(self, reach: float) -> KnownPlace:
        """The place without solid objects further than `reach` [m] from the segment."""
        s = self.segment
        along = cKDTree(point_at(self.world.route[:, :2], np.arange(s.start, s.end + 0.1, 0.1)))

        def near(obj: PlaceObject) -> bool:
            return any(
                along.query(one.center[:2])[0] - np.hypot(one.half[0], one.half[1]) <= reach for one in obj.solids
            )

        return replace(self.place, objects=[obj for obj in self.place.objects if near(obj)], lamp_heads=[])


def _rotate_camera(model: mujoco.MjModel, turn: tuple[float, float, float]) -> None:
    """Rotates the front camera about its axes right, up, back by angles [°]."""
    camera = model.camera("front").id
    rotation, quaternion = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(rotation, np.deg2rad(turn), "xyz")
    mujoco.mju_mulQuat(quaternion, model.cam_quat[camera], rotation)
    model.cam_quat[camera] = quaternion


# ---- camera

_SKY_DISTANCE = 1.0e4  # [m] depth of the sky for motion blur
_DRIFT_TIME = 9.0  # [s] period of the exposure drift
_DRIFT_STEP = 0.1  # [s] between values of the exposure drift
_NOISE_SCALE = 0.5  # of a film frame's noise: its pixels are a quarter as wide, and a resized image has less


class RealCamera:
    """The robot's camera in one trial: vibration, motion blur, haze, exposure drift and sensor noise.

    The same generator and poses give the same images.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        lighting: Lighting,
        robot: HiddenRobot,
        intrinsics: Array,
        size: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """
        Args:
            rasterizer: Renders the place under the lighting with these intrinsics and this size.
            lighting: Exposure, noise and haze.
            robot: Camera effects.
            intrinsics: fx, fy, cx, cy [px], shape (4,).
            size: Width, height [px].
            rng: Random generator of the trial.
        """
        self._rasterizer, self._intrinsics, self._rng = rasterizer, intrinsics, rng
        self._lighting = replace(lighting, noise=_NOISE_SCALE * lighting.noise)
        self._rays = unproject(pixel_grid(*size), intrinsics)
        self._effects = CameraNoise(robot.camera, rng)
        self._times = np.arange(0.0, 600.0, _DRIFT_STEP)
        self._gains = np.exp(robot.exposure_drift * smooth_noise(rng, self._times, _DRIFT_TIME))

    def capture(self, camera_to_world: Array, time: float) -> NDArray[np.uint8]:
        """The image (h, w, 3) at a time [s] from a pose (4, 4), to which vibration is added."""
        pose = self._effects.perturb_pose(camera_to_world, time)
        light, depth = self._rasterizer(pose)
        light = apply_haze(light, depth, self._lighting)
        far = np.where(depth > 0.0, depth, np.float32(_SKY_DISTANCE))
        light = self._effects.apply(light, far, pose, time, self._rays, self._intrinsics)
        return sensor_image(self._rng, light, self._lighting, float(np.interp(time, self._times, self._gains)))
