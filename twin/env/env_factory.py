"""`twin.load`: loads a task in a built scene as a dm_control environment.

`EnvFactory` reads the scene once and makes any number of environments. `episode_spec` makes their model: ground, robot,
and the collision parts within the robot's reach. `DriveEnvironment` adds image observations to physics and task.
"""

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_env import specs
from scipy.spatial import cKDTree

from twin.assets.gaussians import read_ply
from twin.config import HELD_OUT, TRAINING, Condition, ObstacleConfig
from twin.config_file import load_config
from twin.env import episode_lighting
from twin.env.compositor import Compositor, ObjectRenderer
from twin.env.domain_randomization import EVALUATION_RANGES, KNOWN_WEATHER_FRACTION, PAYLOAD, VERSION, Ranges
from twin.env.episode_lighting import EpisodeLighting
from twin.env.mujoco_renderer import SceneRenderer
from twin.env.observation import GpuPixelObserver, PixelObserver
from twin.env.obstacles import EpisodeObstacles, add_obstacles
from twin.env.options import CPU, NERF, Options, parse_options, state_size
from twin.env.physics import camera_pose
from twin.env.route_segments import RouteSegment, find_task
from twin.env.task import EPISODE_VERSION, DrivePhysics, DriveTask, RewardAndTermination, control
from twin.env.trust import Trust
from twin.errors import InputError
from twin.files import digest_file, digest_json
from twin.geometry.polyline import point_at
from twin.loading import Twin, load_scene
from twin.mjcf.husky import disable_fluid_drag
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.robot import MAX_LATENCY
from twin.scene import require_stage, stage_result
from twin.types import Array


@dataclass(frozen=True)
class EnvFactory:
    """A scene, a task and options, from which environments are made."""

    world: World
    segment: RouteSegment
    options: Options
    obstacles: EpisodeObstacles
    model: mujoco.MjModel
    field: BakedField | None
    """Radiance field; None if no images are rendered from it."""
    trust: Trust | None

    @staticmethod
    def open(scene: str | Path | Twin, task: str, options: dict[str, Any]) -> "EnvFactory":
        """Reads a built scene.

        Raises:
            InputError: the scene is not built, or has no route or no such task or lighting, or an option is invalid.
        """
        parsed = parse_options(options)
        twin = scene if isinstance(scene, Twin) else load_scene(scene)
        require_stage(twin.scene, "mjcf")
        if not twin.scene.has_route:
            raise InputError(f"{twin.scene.root}: its build has no route to drive (see mjcf.route)")
        world = twin.world()
        if parsed.randomise:
            ranges, own = parsed.randomise.for_robot(world.robot), world.robot.command_latency
            if own + ranges.latency[1] > MAX_LATENCY:
                both = f"the robot's command_latency {own:g} s + {ranges.latency[1]:g} s"
                raise InputError(f"randomise: latency: {both}; expected at most {MAX_LATENCY:g} s together")
            parsed = dataclasses.replace(parsed, randomise=ranges)
        config = load_config(twin.scene.config_file)
        segment = find_task(task, world, config.task)
        world = world.along(segment.route)
        here = tuple(one for one in config.obstacle if one.route == segment.route)
        wanted = here if isinstance(parsed.obstacles, str) else parsed.obstacles
        if not isinstance(wanted, int) and any(one.route not in ("", segment.route) for one in wanted):
            raise InputError(f"obstacles: one has another `route` than the task {task!r}; leave out its `route`")
        beside = round(parsed.randomise.bystanders[1]) if parsed.randomise else 0
        half_width = parsed.half_width or world.half_width
        obstacles = EpisodeObstacles(wanted, dataclasses.replace(world, half_width=half_width), segment, beside)
        # How far a robot may get that turns around and drives back.
        back = parsed.speed * (parsed.time_limit or 2.0 * (segment.end - segment.start) / parsed.speed)
        spec = episode_spec(world, max(0.0, segment.start - back), segment.end, half_width)
        add_obstacles(spec, obstacles.pool, world)
        trust = Trust(twin.cameras()) if parsed.pixels else None
        field = twin.field(parsed.device) if parsed.pixels and parsed.observe == NERF else None
        if field is not None:
            episode_lighting.check_lighting_names(parsed.lighting, field)
        return EnvFactory(world, segment, parsed, obstacles, spec.compile(), field, trust)

    def make_env(
        self, seed: int | None, evaluator: tuple[RewardAndTermination, int] | None = None
    ) -> tuple[DrivePhysics, DriveTask]:
        """Returns physics and task of a new environment with its own copy of the model; arguments as in `DriveTask`."""
        physics = DrivePhysics.of(copy.copy(self.model), self.world.robot)
        return physics, DriveTask(self.world, self.segment, self.options, self.obstacles, self.model, seed, evaluator)

    @property
    def _field_only(self) -> bool:
        """True if images show only the field: no object, no part of the robot, no weather and no camera noise."""
        lighting = self.options.lighting
        names = (lighting,) if isinstance(lighting, str) else tuple(lighting)
        fogs = [self.field.fog(name) for name in names] if self.field else []
        has_fog = any(one and one.extinction for one in fogs)
        has_sun = any(self.field.sunlight(name) for name in names) if self.field else False
        if self.options.randomise or self.options.camera or self.obstacles.pool or has_fog or has_sun:
            return False
        data, camera = mujoco.MjData(self.model), self.model.camera("front").id
        mujoco.mj_resetDataKeyframe(self.model, data, self.model.key("spawn").id)
        mujoco.mj_forward(self.model, data)
        renderer = ObjectRenderer(self.model, camera, self.options.size)
        return renderer.visible_mask(data, camera_pose(data, camera)) is None

    def make_observer(self, envs: list[tuple[DrivePhysics, DriveTask]]) -> PixelObserver | None:
        """Returns the observer of environments; None without images."""
        if self.trust is None:
            return None
        size, count = self.options.size, len(envs)
        if self.field is not None:
            if self.options.device != CPU and self._field_only:
                return GpuPixelObserver(self.field, self.trust, self.options, envs)
            compositor = Compositor(self.model, self.field, size, count, lit=(self.segment.start, self.segment.end))
            return PixelObserver(compositor, self.field, self.trust, self.options, envs)
        spec = self.world.spec(keeps_part=lambda name: False)  # collision parts are not drawn
        add_obstacles(spec, self.obstacles.pool, self.world)
        splats = read_ply(Path(self.options.splats)) if self.options.splats else None
        renderer = SceneRenderer(spec.compile(), size, count, splats)
        return PixelObserver(renderer, None, self.trust, self.options, envs)


def fingerprint(twin: Twin, task: str, condition: Condition) -> str:
    """Returns a digest of everything in the scene, task and condition that determines an episode.

    The digest covers the field, the MJCF scene with its robot, the task's route segment, the obstacles of `scene.toml`,
    and the photo lightings that the condition names. For the lightings `training` and `held-out`, it also covers the
    version of the sets; for a randomized condition, the version and ranges of the randomization.

    Raises:
        InputError: see `EnvFactory.open`.
    """
    config = load_config(twin.scene.config_file)
    segment = find_task(task, twin.world(), config.task)
    ranges = [dataclasses.asdict(one) for one in (Ranges(), EVALUATION_RANGES)]  # for training, for evaluation
    randomization = {"version": VERSION, "ranges": ranges} if condition.randomised else {}
    photos = [
        path for name in condition.lighting.split(":") if (path := twin.scene.lightings / f"{name}.json").exists()
    ]
    return digest_json(
        {
            "stages": [stage_result(twin.scene, stage) for stage in ("field", "mjcf")],
            "stretch": _without_route(segment),
            "obstacles": [_without_route(one) for one in config.obstacle if one.route == segment.route],
            "episodes": EPISODE_VERSION,
            **({"randomise": randomization} if randomization else {}),
            **({"lights": episode_lighting.VERSION} if condition.lighting in (TRAINING, HELD_OUT) else {}),
            "photos": [digest_file(path) for path in photos],
            **({"untold": KNOWN_WEATHER_FRACTION} if photos and randomization else {}),
        }
    )


def _without_route(one: RouteSegment | ObstacleConfig) -> dict[str, Any]:
    """The fields; an empty `route` is left out, so that digests from before there were branches stay valid."""
    fields = dataclasses.asdict(one)
    return fields if fields["route"] else {name: value for name, value in fields.items() if name != "route"}


class DriveEnvironment(control.Environment):
    """An environment with image observations: `pixels`, uint8, shape (stack, height, width, 3), the newest last.

    With the option `state`, there is also the observation `state`, float32, shape (k,).
    """

    def __init__(self, physics: DrivePhysics, task: DriveTask, pixels: PixelObserver) -> None:
        super().__init__(physics, task, control_timestep=task.options.control_timestep)
        self.pixels = pixels

    def reset(self) -> dm_env.TimeStep:
        step = super().reset()
        self.pixels.begin([0])
        return self._with_pixels(step)

    def step(self, action: Any) -> dm_env.TimeStep:
        starts_episode = self._reset_next_step
        step = super().step(action)  # calls reset() if an episode starts
        if starts_episode:
            return step
        self.pixels.observe([0])
        return self._with_pixels(step)

    def relight(self, step: dm_env.TimeStep, lighting: EpisodeLighting) -> dm_env.TimeStep:
        """Replaces the lighting at an episode's start; returns its first step, `step`, with images in the new light."""
        self.pixels.set_lighting(0, lighting, fill=True)
        return self._with_pixels(step)

    def observation_spec(self) -> dict[str, specs.BoundedArray]:
        _, stack, channels, height, width = self.pixels.stacks.shape
        images = specs.BoundedArray((stack, height, width, channels), np.uint8, 0, 255, name="pixels")
        size = state_size(self.task.options)
        low, high = self.task.state_bounds[:, :size]
        state = {"state": specs.BoundedArray((size,), np.float32, low, high, name="state")}
        return {"pixels": images} | (state if size else {})

    def _with_pixels(self, step: dm_env.TimeStep) -> dm_env.TimeStep:
        observed = {"pixels": np.ascontiguousarray(self.pixels.stacks[0].transpose(0, 2, 3, 1))}
        if size := state_size(self.task.options):
            observed["state"] = self.task.state(self.physics)[:size]
        return step._replace(observation=observed)


def load(
    scene: str | Path | Twin, task: str = "right_turn", seed: int | None = None, **options: Any
) -> control.Environment:
    """Loads a task in a built scene as a dm_control environment.

    Args:
        scene: The scene's folder, or the result of `load_scene`.
        task: `straight`, `right_turn`, `route`, or a [[task]] of its scene.toml.
        seed: Seed of the sequence of episodes; None: unpredictable.
        options: See `twin.env.options.Options`.

    Raises:
        InputError: the scene is not built or has no such task, or an option is invalid.
    """
    factory = EnvFactory.open(scene, task, options)
    physics, drive_task = factory.make_env(seed)
    pixels = factory.make_observer([(physics, drive_task)])
    if pixels is None:
        return control.Environment(physics, drive_task, control_timestep=drive_task.options.control_timestep)
    return DriveEnvironment(physics, drive_task, pixels)


# ---- model of an episode

_REACH = 1.5  # [m] reach beyond the corridor's edge; exceeds half the robot's length plus its motion in a control step


def episode_spec(world: World, start: float, end: float, half_width: float) -> mujoco.MjSpec:
    """Returns the physics model of episodes between two arc lengths [m] of a scene's route; `half_width` [m].

    An episode ends when the robot leaves the corridor, so the robot never touches collision parts beyond its reach.
    The model lacks these parts. This changes no result, but saves a fifth of the physics' time and most of its memory.
    """
    line = cKDTree(point_at(world.route[:, :2], np.arange(start, end + 0.1, 0.1)))

    def within_reach(part: str) -> bool:
        center, radius = _bounding_sphere(world.folder / "assets" / f"{part}.obj")
        return line.query(center[:2])[0] - radius <= half_width + _REACH

    spec = world.spec(within_reach, visuals=False)
    base = spec.body("base_link")
    payload = base.add_body(name=PAYLOAD, pos=world.robot.payload_position)
    payload.explicitinertial = True
    payload.mass, payload.ipos, payload.inertia = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    disable_fluid_drag(payload, PAYLOAD)
    return spec


def _bounding_sphere(path: Path) -> tuple[Array, float]:
    """Center and radius [m] of a sphere around the vertices of an OBJ file."""
    lines = path.read_text(encoding="ascii").splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    center = (vertices.min(0) + vertices.max(0)) / 2
    return center, float(np.linalg.norm(vertices - center, axis=1).max())
