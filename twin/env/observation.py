"""What the robots' cameras see: one call renders the pictures of n worlds, each in its own light.

A *stack* is the last few pictures of an episode, the newest last; at its beginning the first picture fills it.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (inside kernels, Warp's own types hold, which mypy does not know)
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.config import RANDOMISED
from twin.env.camera_noise import CameraNoise
from twin.env.compositor import Compositor
from twin.env.episode_lighting import EpisodeLighting, LightingSets, sample_lighting
from twin.env.mujoco_renderer import SceneRenderer, camera_intrinsics
from twin.env.options import SIMULATOR, Options
from twin.env.physics import DrivePhysics
from twin.env.task import CAMERA, LIGHT, WEATHER, DriveTask
from twin.env.trust import SKY, Trust
from twin.env.weather import Weather
from twin.geometry.cameras import Viewpoints
from twin.nerf.baked import BakedField
from twin.types import Array, Image

if TYPE_CHECKING:
    import torch


_PLAIN = EpisodeLighting(SIMULATOR, np.zeros(0, np.float32))


class PixelObserver:
    """Observes n worlds."""

    def __init__(
        self,
        overlay: Compositor | SceneRenderer,
        field: BakedField | None,
        trust: Trust,
        options: Options,
        worlds: Sequence[tuple[DrivePhysics, DriveTask]],
    ) -> None:
        """
        Args:
            overlay: Renders the worlds.
            field: Of the place; knows its lightings. None where MuJoCo draws it, in its own light.
            trust: What was filmed of it.
            options: Size, stack, lighting.
            worlds: Whose episodes are observed.
        """
        self._overlay, self.options, self.worlds = overlay, options, list(worlds)
        self._trust, self._sets = trust, LightingSets(field) if field else None
        width, height = options.size
        self.stacks = np.zeros((len(self.worlds), options.stack, 3, height, width), np.uint8)
        """Shape (n, stack, 3, height, width): colours first, as networks want them."""
        self.lights: list[EpisodeLighting | None] = [None] * len(self.worlds)
        self._effects: list[CameraNoise | None] = [None] * len(self.worlds)
        self._weather: list[Weather | None] = [None] * len(self.worlds)
        self.trust = np.zeros(len(self.worlds))
        """Of each world's newest picture, in [0, 1], shape (n,)."""

    def begin(self, which: Sequence[int]) -> None:
        """Draws the lights of episodes that have just begun, and fills their stacks."""
        o = self.options
        for i in which:
            task = self.worlds[i][1]
            self.lights[i] = _PLAIN
            if self._sets:
                self.lights[i] = sample_lighting(
                    o.lighting, o.lighting_drift, task.time_limit, self._sets, task.rng(LIGHT)
                )
            if o.camera:
                self._effects[i] = CameraNoise(o.camera, task.rng(CAMERA))
            air = self.lights[i].air_at(0.0)  # type: ignore[union-attr]
            # Air that a photo told to be clear is known, too.
            if air is not None and o.randomise and o.randomise.hold_known:
                task.weathered(task.draw.on_a_known_day())
            has_any = air is not None or o.randomise
            self._weather[i] = Weather(task.draw, task.rng(WEATHER), air) if has_any else None
        if len(which):
            self._show(which, fills=True)

    def look(self, which: Sequence[int]) -> None:
        """Adds a new picture to the stacks of some worlds."""
        if len(which):
            self._show(which, fills=False)

    def info(self, i: int) -> dict[str, Any]:
        """What is to be told of world i's picture: `lighting`, as tables name it, and `trust`."""
        light = self.lights[i]
        name = light.name + (RANDOMISED if self.options.randomise else "") if light else ""
        return {"lighting": name, "trust": float(self.trust[i])}

    def _show(self, which: Sequence[int], fills: bool) -> None:
        """Adds new pictures to the stacks of some worlds, or fills these with them."""
        index, new = list(which), self._look(which)[:, None]
        self.stacks[index] = new if fills else np.concatenate([self.stacks[index][:, 1:], new], 1)

    def _look(self, which: Sequence[int]) -> Image:
        physics = [self.worlds[i][0] for i in which]
        seen, poses = [one.seen for one in physics], np.array([one.camera_to_world for one in physics])
        lights = [self.lights[i].at(data.time) for i, data in zip(which, seen, strict=True)]  # type: ignore[union-attr]
        effects = [self._effects[i] for i in which] if self.options.camera else None
        weather = [self._weather[i] for i in which]
        for i, sky, data in zip(which, weather, seen, strict=True):
            if sky:
                sky.air = self.lights[i].air_at(data.time)  # type: ignore[union-attr]
        out = self._overlay.render(seen, lights, effects, weather)
        self.trust[list(which)] = self._trust.of(poses, out)
        return (np.clip(out.rgb.transpose(0, 3, 1, 2), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


# ---- Pictures that stay on the device they are marched on: for policies that learn there, in thousands of worlds.
#
# Only what the field itself shows is there; worlds with obstacles, weather or an imperfect camera are seen by `Pixels`,
# whose pictures come back to the host for what is put into them.


Eyes = Callable[[NDArray[np.int64]], tuple[Array, Array]]


@wp.kernel
def _push(
    rgb: wp.array2d(dtype=wp.vec3),
    opacity: wp.array2d(dtype=float),
    which: wp.array(dtype=int),
    fills: int,
    lower: int,
    sky: float,
    stacks: wp.array4d(dtype=wp.uint8),
    below: wp.array2d(dtype=float),
):
    """Adds pictures to the stacks of some worlds, or fills these with them; sums up their lower halves, from pixel
    `lower` on: opacity, and how many pixels have less than `sky` of it."""
    k, pixel = wp.tid()
    world, depth = which[k], stacks.shape[1]
    for colour in range(3):
        value = wp.uint8(wp.clamp(rgb[k, pixel][colour], 0.0, 1.0) * 255.0 + 0.5)
        for i in range(depth - 1):
            if fills == 1:
                stacks[world, i, colour, pixel] = value
            else:
                stacks[world, i, colour, pixel] = stacks[world, i + 1, colour, pixel]
        stacks[world, depth - 1, colour, pixel] = value
    if pixel >= lower:
        wp.atomic_add(below, k, 0, opacity[k, pixel])
        if opacity[k, pixel] < sky:
            wp.atomic_add(below, k, 1, 1.0)


class GpuPixelObserver(PixelObserver):
    """Observes n worlds on the field's device."""

    def __init__(
        self, field: BakedField, trust: Trust, options: Options, worlds: Sequence[tuple[DrivePhysics, DriveTask]]
    ) -> None:
        """
        Args:
            field: Of the place; its device is where pictures stay.
            trust: What was filmed of it.
            options: Size, stack, lighting; no camera effects, nothing drawn anew, no light of a hazy photo.
            worlds: Whose episodes are observed, without obstacles.
        """
        self.options, self.worlds, self._field = options, list(worlds), field
        self._trust, self._sets = trust, LightingSets(field)
        model, (width, height), n = worlds[0][0].robot.model, options.size, len(worlds)
        self._intrinsics = camera_intrinsics(model, model.camera("front").id, options.size)
        self._stacks: Any = wp.zeros((n, options.stack, 3, width * height), dtype=wp.uint8, device=field.where)
        self.lights: list[EpisodeLighting | None] = [None] * n
        self.trust = np.zeros(n)
        self._effects, self._weather = [None] * n, [None] * n
        self.eyes: Eyes = self._eyes
        """Where cameras of some worlds were when their newest pictures were taken, OpenCV poses (k, 4, 4), and when."""

    @property
    def stacks(self) -> Image:  # type: ignore[override]
        """A copy on the host, shape (n, stack, 3, height, width)."""
        n, stack, three, _ = self._stacks.shape
        width, height = self.options.size
        return self._stacks.numpy().reshape(n, stack, three, height, width).copy()

    def tensor(self) -> "torch.Tensor":
        """The stacks where they are, uint8 (n, 3 · stack, height, width); overwritten by the next step."""
        import torch  # noqa: F401, as Warp's conversion needs it

        width, height = self.options.size
        return wp.to_torch(self._stacks).reshape(len(self.worlds), -1, height, width)

    def _eyes(self, which: NDArray[np.int64]) -> tuple[Array, Array]:
        physics = [self.worlds[i][0] for i in which]
        return np.array([one.camera_to_world for one in physics]), np.array([one.seen.time for one in physics])

    def _show(self, which: Sequence[int], fills: bool) -> None:
        width, height = self.options.size
        poses, times = self.eyes(np.array(which))
        lights = [self.lights[i].at(time) for i, time in zip(which, times.tolist(), strict=True)]  # type: ignore[union-attr]
        views = Viewpoints.of(poses, self._intrinsics, self.options.size)
        lower, device = height // 2 * width, self._field.where
        below, index = (
            wp.zeros((len(which), 2), dtype=float, device=device),
            wp.array(list(which), dtype=int, device=device),
        )

        def push(rgb: Any, opacity: Any) -> None:
            given = [rgb, opacity, index, int(fills), lower, SKY]
            wp.launch(_push, rgb.shape, given, [self._stacks, below], device=device)

        self._field.show(views, lights, push)
        opaque, sky = below.numpy().T / (width * height - lower)
        self.trust[list(which)] = self._trust.judged(poses, opaque, sky)
