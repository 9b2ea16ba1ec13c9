"""`twin.load`: a built scene and a task as a dm_control environment.

Physics and task know nothing of pictures; `SeenDrive` adds them. Both are `dm_control.rl.control.Environment`s.
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

from twin.config import HELD_OUT, RANDOMISED, TRAINING
from twin.config_file import load_config
from twin.env import episode_lighting
from twin.env.compositor import Compositor
from twin.env.domain_randomization import ANOTHER_DAY, UNTOLD, VERSION, Ranges
from twin.env.episode_model import episode_spec
from twin.env.mujoco_renderer import ObjectRenderer, SceneRenderer, camera_pose
from twin.env.observation import PixelObserver
from twin.env.obstacles import EpisodeObstacles, add_obstacles
from twin.env.options import CPU, NERF, Options, control, parse_options
from twin.env.physics import DrivePhysics
from twin.env.route_segments import RouteSegment, find_task
from twin.env.task import DriveTask, RewardAndTermination
from twin.env.trust import Trust
from twin.errors import InputError
from twin.files import digest_file, digest_json
from twin.loading import Twin, load_scene
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.scene import finished, result_of


@dataclass(frozen=True)
class EnvFactory:
    """A scene and a task, ready for any number of worlds."""

    world: World
    stretch: RouteSegment
    options: Options
    obstacles: EpisodeObstacles
    model: mujoco.MjModel
    field: BakedField | None
    """None where no pictures of it are wanted."""
    trust: Trust | None

    @staticmethod
    def open(scene: str | Path | Twin, task: str, options: dict[str, Any]) -> "EnvFactory":
        """Reads a built scene. Raises InputError: not built, no route, no such task or lighting, or unknown options."""
        parsed = parse_options(options)
        twin = scene if isinstance(scene, Twin) else load_scene(scene)
        finished(twin.scene, "mjcf")
        if not twin.scene.has_route:
            raise InputError(f"{twin.scene.root}: nothing to drive, as its build has no route (mjcf.route)")
        world = twin.world()
        if parsed.randomise:
            parsed = dataclasses.replace(parsed, randomise=parsed.randomise.for_robot(world.robot))
        config = load_config(twin.scene.config_file)
        stretch = find_task(task, world, config.task)
        wanted = config.obstacle if isinstance(parsed.obstacles, str) else parsed.obstacles
        beside = round(parsed.randomise.bystanders[1]) if parsed.randomise else 0
        half_width = parsed.half_width or world.half_width
        obstacles = EpisodeObstacles(wanted, dataclasses.replace(world, half_width=half_width), stretch, beside)
        spec = episode_spec(world, stretch.start, stretch.end, half_width)
        add_obstacles(spec, obstacles.pool, world)
        trust = Trust(twin.cameras()) if parsed.pixels else None
        field = twin.field(parsed.device) if parsed.pixels and parsed.observe == NERF else None
        if field is not None:
            episode_lighting.check_names(parsed.lighting, field)
        return EnvFactory(world, stretch, parsed, obstacles, spec.compile(), field, trust)

    def drive(
        self, seed: int | None, judge: tuple[RewardAndTermination, int] | None = None
    ) -> tuple[DrivePhysics, DriveTask]:
        """One more world, with a model of its own; see `Drive`."""
        physics = DrivePhysics.of(copy.copy(self.model), self.world.robot)
        return physics, DriveTask(self.world, self.stretch, self.options, self.obstacles, self.model, seed, judge)

    @property
    def _bare(self) -> bool:
        """Whether nothing is put into pictures of the field, not even the robot itself."""
        lighting = self.options.lighting
        asked = (lighting,) if isinstance(lighting, str) else tuple(lighting)
        airs = [self.field.air(name) for name in asked] if self.field else []
        air = any(one and one.extinction for one in airs)
        if self.options.randomise or self.options.camera or self.obstacles.pool or air:
            return False
        data, camera = mujoco.MjData(self.model), self.model.camera("front").id
        mujoco.mj_resetDataKeyframe(self.model, data, self.model.key("spawn").id)
        mujoco.mj_forward(self.model, data)
        return ObjectRenderer(self.model, camera, self.options.size).in_view(data, camera_pose(data, camera)) is None

    def pixels(self, worlds: list[tuple[DrivePhysics, DriveTask]]) -> PixelObserver | None:
        if self.trust is None:
            return None
        size, count = self.options.size, len(worlds)
        if self.field is not None and self.options.device != CPU and self._bare:
            from twin.env.observation import GpuPixelObserver  # its kernels are for that alone

            return GpuPixelObserver(self.field, self.trust, self.options, worlds)
        if self.field is not None:
            overlay = Compositor(self.model, self.field, size, count)
            return PixelObserver(overlay, self.field, self.trust, self.options, worlds)
        half_width = self.options.half_width or self.world.half_width
        spec = episode_spec(self.world, self.stretch.start, self.stretch.end, half_width, looks=True)
        add_obstacles(spec, self.obstacles.pool, self.world)
        return PixelObserver(SceneRenderer(spec.compile(), size, count), None, self.trust, self.options, worlds)


def fingerprint(twin: Twin, task: str, lighting: str) -> str:
    """What decides an episode besides its seed and who drives, as a digest.

    That is the field, the MJCF scene with its robot, the task's stretch, the obstacles of `scene.toml`, lightings from
    photos that `lighting` names, how lights of a set are drawn, and what is drawn where it ends in `+randomised`.

    Raises:
        InputError: as `Stage.open`.
    """
    world, config = twin.world(), load_config(twin.scene.config_file)
    ranges = [dataclasses.asdict(one) for one in (Ranges(), ANOTHER_DAY)]  # of training and of judging
    drawn = {"version": VERSION, "ranges": ranges} if lighting.endswith(RANDOMISED) else {}
    plain = lighting.removesuffix(RANDOMISED)
    photos = [path for name in plain.split(":") if (path := twin.scene.lightings / f"{name}.json").exists()]
    return digest_json(
        {
            "stages": [result_of(twin.scene, stage) for stage in ("field", "mjcf")],
            "stretch": dataclasses.asdict(find_task(task, world, config.task)),
            "obstacles": [dataclasses.asdict(one) for one in config.obstacle],
            **({"randomise": drawn} if drawn else {}),
            **({"lights": episode_lighting.VERSION} if plain in (TRAINING, HELD_OUT) else {}),
            "photos": [digest_file(path) for path in photos],
            **({"untold": UNTOLD} if photos and drawn else {}),
        }
    )


class DriveEnvironment(control.Environment):
    """A drive whose observations are pictures: `pixels`, uint8, shape (stack, height, width, 3), the newest last."""

    def __init__(self, physics: DrivePhysics, task: DriveTask, pixels: PixelObserver) -> None:
        super().__init__(physics, task, control_timestep=task.options.control_timestep)
        self.pixels = pixels

    def reset(self) -> dm_env.TimeStep:
        step = super().reset()
        self.pixels.begin([0])
        return self._with_pixels(step)

    def step(self, action: Any) -> dm_env.TimeStep:
        begins = self._reset_next_step
        step = super().step(action)  # calls reset() where an episode begins
        if begins:
            return step
        self.pixels.look([0])
        return self._with_pixels(step)

    def observation_spec(self) -> dict[str, specs.BoundedArray]:
        _, stack, three, height, width = self.pixels.stacks.shape
        return {"pixels": specs.BoundedArray((stack, height, width, three), np.uint8, 0, 255, name="pixels")}

    def _with_pixels(self, step: dm_env.TimeStep) -> dm_env.TimeStep:
        return step._replace(observation={"pixels": np.ascontiguousarray(self.pixels.stacks[0].transpose(0, 2, 3, 1))})


def load(
    scene: str | Path | Twin, task: str = "right_turn", seed: int | None = None, **options: Any
) -> control.Environment:
    """A task in a built scene as a dm_control environment.

    Args:
        scene: Its folder, or what `load_scene` returned.
        task: `straight`, `right_turn`, `route`, or a [[task]] of its scene.toml.
        seed: Of the sequence of episodes; None: unpredictable.
        options: See `twin.env.options.Options`.

    Raises:
        InputError: the scene is not built or has no such task, or an option is not to be had.
    """
    stage = EnvFactory.open(scene, task, options)
    physics, drive = stage.drive(seed)
    pixels = stage.pixels([(physics, drive)])
    if pixels is None:
        return control.Environment(physics, drive, control_timestep=drive.options.control_timestep)
    return DriveEnvironment(physics, drive, pixels)
