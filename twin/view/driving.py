"""Driving in the page: the Husky in the scene's simulation, driven in real time by keys, a policy or a script.

There is one environment for keys and one for a *task* of the scene. They share their obstacles, which may be added,
moved and removed at any time. With keys, the robot may reverse and go anywhere, and contacts are only reported. A
policy or the scripted driver drives the task, which ends as it does in `twin validate`.
"""

import copy
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import dm_env
import numpy as np
from scipy.optimize import brentq

from twin.config import OBSTACLE_KINDS, ObstacleConfig
from twin.config_file import load_config
from twin.env.drivers import Driver, PolicyDriver, RouteDriver
from twin.env.env_factory import DriveEnvironment, EnvFactory
from twin.env.episode_lighting import EpisodeLighting
from twin.env.obstacles import EpisodeObstacles, ObstacleMotion, ground_height, obstacle_pose, place
from twin.env.route_segments import RouteSegment, find_task
from twin.env.task import DrivePhysics, DriveTask, control
from twin.errors import InputError
from twin.files import toml_value
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.loading import Twin
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.types import Array, Image
from twin.view.scene_picture import ObjectState

KEYS_DRIVER, SCRIPTED_DRIVER = "keys W A S D", "scripted driver"

_PER_KIND = 4  # obstacles of each kind that may be added to those of scene.toml
_REACH = 25.0  # [m] convex parts up to this distance from the route block a robot that is driven by keys
_LONG = 1e6  # [s] time limit of a drive by keys
_MAX_LAG = 0.5  # [s] largest lag behind real time that is caught up; the rest is dropped
_STATION_STEP = 0.1  # [m] spacing of the stations that `station_and_lateral` tries


@dataclass(frozen=True)
class LoadedTwin(Twin):
    """A scene whose field is in memory already."""

    baked: BakedField

    def field(self, device: str = "cpu") -> BakedField:
        return self.baked


@dataclass(frozen=True)
class DriveFacts:
    """State of the drive: speed [m/s], yaw rate [rad/s], cross-track error and progress [m], trust in [0, 1]."""

    time: float
    """[s]"""
    base_to_world: Array
    image: Image
    """The robot's picture, shape (h, w, 3)."""
    command: Array
    """v [m/s] and yaw rate [rad/s]."""
    speed: float
    yaw_rate: float
    torque: Array
    """Motor torque of the left and right side at the wheels [N m]."""
    current: Array
    """Motor current of each side [A]."""
    cross_track: float
    progress: float
    trust: float
    touched: tuple[str, ...]
    cause: str
    """Cause of the episode's end; empty while it goes on."""
    rate: float
    """Ratio of simulated to real time, averaged over the last steps."""


class PlacedObstacles(EpisodeObstacles):
    """The obstacles that stand in the scene at present, taken from a pool with several of each kind."""

    def __init__(self, world: World, segment: RouteSegment, given: tuple[ObstacleConfig, ...]) -> None:
        """`given` are the obstacles of scene.toml, which are in the scene from the beginning."""
        super().__init__((), world, segment)
        self._world = world
        named = tuple(replace(one, name=one.name or f"{one.kind}_{k}") for k, one in enumerate(given))
        spare: list[ObstacleConfig] = []
        for kind in OBSTACLE_KINDS:
            # The user may have copied obstacles that an earlier session added, with their names, to scene.toml.
            numbered = (f"added_{kind}_{k}" for k in range(_PER_KIND + len(named)))
            free = [name for name in numbered if all(name != one.name for one in named)]
            spare += [ObstacleConfig(name, kind, route=segment.route) for name in free[:_PER_KIND]]
        self._pool = (*named, *spare)
        self.standing: dict[str, ObstacleConfig] = {one.name: one for one in named}
        """The standing obstacles by name."""

    @property
    def pool(self) -> tuple[ObstacleConfig, ...]:
        return self._pool

    def sample(self, rng: np.random.Generator, beside: int = 0) -> tuple[ObstacleConfig, ...]:
        return tuple(self.standing.values())

    def free(self, kind: str) -> str | None:
        """Name of an obstacle of this kind that is not in the scene yet; None if all are."""
        return next((one.name for one in self._pool if one.kind == kind and one.name not in self.standing), None)

    def put(self, name: str, x: float, y: float, yaw: float) -> None:
        """Puts the named obstacle at x, y [m] and yaw [rad] in the world, where it stands still."""
        mine = next(one for one in self._pool if one.name == name)
        station, lateral = station_and_lateral(self._world.route, np.array([x, y]))
        turn = np.rad2deg(yaw - float(heading_at(self._world.route, station)))
        turn = (turn + 180.0) % 360.0 - 180.0
        self.standing[name] = replace(
            mine, station=round(station, 3), lateral=round(lateral, 3), yaw=round(turn, 1), to=(), delay=0.0
        )

    def pose(self, name: str, time: float = 0.0) -> tuple[float, float, float]:
        """x, y [m] and yaw [rad] of a standing obstacle."""
        return obstacle_pose(self.standing[name], self._world.route, time)

    def toml(self) -> str:
        """The standing obstacles as [[obstacle]] tables of scene.toml."""
        usual = asdict(ObstacleConfig())
        return "\n\n".join(
            "\n".join(["[[obstacle]]", *(f"{k} = {toml_value(v)}" for k, v in asdict(one).items() if v != usual[k])])
            for one in self.standing.values()
        )


def station_and_lateral(route: Array, xy: Array) -> tuple[float, float]:
    """Station and lateral [m] for which `obstacle_pose` in `twin.env.obstacles` returns the point `xy` (2,).

    Of several solutions, the one with the smallest distance from the route is returned.
    """
    length = float(arc_lengths(route)[-1])

    def offset(s: Any) -> tuple[Any, Any]:
        """Distances [m] of the point ahead and to the left of the route's point at station s."""
        heading = heading_at(route, s)
        x, y = (xy - point_at(route[:, :2], s)).T
        beyond = s - np.clip(s, 0.0, length)
        return x * np.cos(heading) + y * np.sin(heading) - beyond, y * np.cos(heading) - x * np.sin(heading)

    reach = float(np.linalg.norm(xy - route[0, :2])) + length + 1.0
    s = np.arange(-reach, length + reach, _STATION_STEP)
    ahead, left = offset(s)
    passed = np.flatnonzero((ahead[:-1] >= 0.0) & (ahead[1:] < 0.0))
    k = passed[np.abs(left[passed]).argmin()]
    station = brentq(lambda at: offset(at)[0], s[k], s[k + 1])
    return station, float(offset(station)[1])


class FreeDrive(DriveTask):
    """A task without an end, whose robot may reverse."""

    def _bounds(self) -> tuple[Array, Array]:
        high = np.array([self.options.speed, self.options.yaw_rate])
        return -high, high

    def get_termination(self, physics: DrivePhysics) -> None:
        return None


class KeyDriver:
    """Drives by the held keys: W ahead, S back, A turns left, D turns right."""

    def __init__(self, held: Callable[[], frozenset[str]]) -> None:
        self._held = held

    def __call__(self, environment: Any, step: dm_env.TimeStep) -> Array:
        keys, limits = self._held(), environment.action_spec().maximum
        return limits * np.array([("w" in keys) - ("s" in keys), ("a" in keys) - ("d" in keys)], float)


class Driving:
    """The environments, and the thread that steps the one being driven."""

    def __init__(
        self,
        twin: Twin,
        field: BakedField,
        task: str,
        policy: Any,
        lighting: EpisodeLighting,
        held: Callable[[], frozenset[str]],
        on_step: Callable[[DriveFacts], None],
        on_error: Callable[[Exception], None],
        seed: int = 0,
    ) -> None:
        """
        Args:
            twin: A built scene with a route.
            field: The scene's radiance field.
            task: The task that a policy or the scripted driver drives.
            policy: A `twin.learn.policy.Policy`, or None.
            lighting: Lighting of the robot's pictures.
            held: Returns the held keys.
            on_step: Called after every control step, on the stepping thread, and after every reset, on any thread.
            on_error: Called on the stepping thread after an error of a driver or the simulation, which ends the drive.
            seed: Seed of the task's episodes.

        Raises:
            InputError: the scene cannot be driven, or has no such task.
        """
        self._lighting, self._on_step, self._on_error, self._seed = lighting, on_step, on_error, seed
        shared = LoadedTwin(twin.scene, field.single_threaded())
        config = load_config(twin.scene.config_file)
        options: dict[str, Any] = {"lighting": field.lightings[0], "observe": "nerf"}
        segment = find_task(task, twin.world(), config.task)
        self.world = twin.world().along(segment.route)
        standing = tuple(one for one in config.obstacle if one.route == segment.route)
        self.obstacles = PlacedObstacles(self.world, segment, standing)
        common = {**options, "obstacles": self.obstacles.pool}
        free = {
            "half_width": max(_REACH, self.world.half_width),
            "start_offset": 0.0,
            "start_heading": 0.0,
            "time_limit": _LONG,
            "speed": self.world.robot.max_speed,
            "yaw_rate": self.world.robot.max_yaw_rate,
        }
        loose = EnvFactory.open(shared, segment.route or "route", {**common, **free})
        bound = EnvFactory.open(shared, task, {**common, **(policy.options() if policy else {})})
        by_keys, by_others = ("keys", loose, FreeDrive), ("task", bound, DriveTask)
        self.drivers: dict[str, tuple[Driver, tuple[str, EnvFactory, type[DriveTask]]]] = {
            KEYS_DRIVER: (KeyDriver(held), by_keys),
            SCRIPTED_DRIVER: (RouteDriver(), by_others),
        }
        if policy:
            self.drivers[f"policy {policy.name}"] = PolicyDriver(policy), by_others
        self._environments: dict[str, DriveEnvironment] = {}
        self.driver = KEYS_DRIVER
        """Name of the present driver, a key of `drivers`."""
        self._lock = threading.RLock()
        self._running, self._closed = threading.Event(), threading.Event()
        self._rate = 1.0
        self._step: dm_env.TimeStep | None = None
        self.reset()
        self._thread = threading.Thread(target=self._run, daemon=True, name="driving")
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._running.is_set()

    @property
    def environment(self) -> DriveEnvironment:
        """The environment of the present driver, created when it is first needed."""
        name, factory, kind = self.drivers[self.driver][1]
        if name not in self._environments:
            factory = replace(factory, obstacles=self.obstacles)
            physics = DrivePhysics.of(copy.copy(factory.model), factory.world.robot)
            task = kind(factory.world, factory.segment, factory.options, self.obstacles, factory.model, self._seed)
            pixels = factory.make_observer([(physics, task)])
            assert pixels is not None
            self._environments[name] = DriveEnvironment(physics, task, pixels)
        return self._environments[name]

    def choose(self, driver: str) -> None:
        """Switches to a driver, which begins at the start of its task."""
        with self._lock:
            self.pause()
            if driver != self.driver:
                self.driver = driver
                self.reset()

    def start(self) -> None:
        with self._lock:
            if self._step is None or self._step.last():
                self.reset()
        self._running.set()

    def pause(self) -> None:
        self._running.clear()

    def reset(self) -> None:
        """Starts a new episode. If the robot cannot start, for example on an obstacle, pauses and raises InputError."""
        with self._lock:
            environment, self._step = self.environment, None
            try:
                self._step = environment.relight(environment.reset(), self._lighting)
            except InputError:
                self.pause()
                raise
            self._report(np.zeros(2))

    def set_lighting(self, lighting: EpisodeLighting) -> None:
        """Changes the lighting of the robot's pictures, from the next one on."""
        with self._lock:
            self._lighting = lighting
            self.environment.pixels.set_lighting(0, lighting, fill=False)

    def objects(self) -> ObjectState:
        """The present positions of robot and obstacles."""
        with self._lock:
            return ObjectState.of(self.environment.physics.data.ptr)

    def update_obstacles(self) -> None:
        """Applies changes of `obstacles` to the simulation."""
        with self._lock:
            environment = self.environment
            task, data = environment.task, environment.physics.data.ptr
            task.obstacles = tuple(self.obstacles.standing.values())
            environment.physics.robot.move_obstacles = ObstacleMotion(task.obstacles, data)
            place(task.obstacles, data, float(data.time))
            environment.physics.forward()

    def ground_height(self, x: float, y: float) -> float:
        """[m]"""
        return ground_height(self.environment.physics.model.ptr, x, y)

    def close(self) -> None:
        self._closed.set()
        self._running.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            if not self._running.is_set():
                self._running.wait()
                due = time.monotonic()
            if self._closed.is_set():
                return
            began = time.monotonic()
            with self._lock:
                if self._running.is_set():
                    try:
                        self._advance()
                    except Exception as error:  # a policy may raise anything
                        self.pause()
                        self._on_error(error)
                period = self.environment.task.options.control_timestep
            due = max(due + period, time.monotonic() - _MAX_LAG)
            time.sleep(max(0.0, due - time.monotonic()))
            self._rate += 0.2 * (period / max(time.monotonic() - began, 1e-3) - self._rate)

    def _advance(self) -> None:
        driver, environment = self.drivers[self.driver][0], self.environment
        assert self._step is not None
        action = np.asarray(driver(environment, self._step), float)
        try:
            self._step = environment.step(action)
        except control.PhysicsError:  # the simulation diverged, as in a violent collision
            self.reset()
            return
        if self._step.last():
            self.pause()
        self._report(environment.task.commands(action[None])[0])

    def _report(self, command: Array) -> None:
        environment = self.environment
        physics, task, robot = environment.physics, environment.task, environment.physics.robot
        assert self._step is not None
        self._on_step(
            DriveFacts(
                time=float(physics.time()),
                base_to_world=physics.base_to_world,
                image=self._step.observation["pixels"][-1],
                command=command,
                speed=physics.speed,
                yaw_rate=physics.yaw_rate,
                torque=robot.motor_torque,
                current=robot.motor_current,
                cross_track=task.cross_track,
                progress=task.progress,
                trust=float(environment.pixels.trust[0]),
                touched=physics.touched,
                cause=task.cause if self._step.last() else "",
                rate=self._rate,
            )
        )
