"""Pixel observations of n envs: one call renders all envs; each env has a stack of its newest frames.

The newest frame of a stack is the last one. At the beginning of an episode, the first frame fills the whole stack.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (kernels use Warp's own types, which mypy does not know)
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin.config import Condition
from twin.env.compositor import Compositor
from twin.env.episode_lighting import EpisodeLighting, LightingSets, sample_lighting
from twin.env.mujoco_renderer import FRONT_CAMERA, SceneRenderer, camera_intrinsics
from twin.env.options import Options
from twin.env.picture_effects import CameraNoise, Weather
from twin.env.task import CAMERA, LIGHTING, WEATHER, DrivePhysics, DriveTask
from twin.env.trust import SKY_OPACITY, Trust
from twin.geometry.cameras import Viewpoints
from twin.nerf.baked import BakedField
from twin.nerf.sun import main_sun
from twin.types import Array, Image
from twin.warp_runtime import wp

if TYPE_CHECKING:
    import torch


class PixelObserver:
    """Renders n envs and keeps their frame stacks."""

    def __init__(
        self,
        renderer: Compositor | SceneRenderer,
        field: BakedField | None,
        trust: Trust,
        options: Options,
        envs: Sequence[tuple[DrivePhysics, DriveTask]],
    ) -> None:
        """`field` contains the lightings; None if MuJoCo renders the mesh, or splats, under MuJoCo's lights."""
        self._renderer, self.options, self.envs = renderer, options, list(envs)
        self._trust, self._sets = trust, LightingSets(field) if field else None
        width, height = options.size
        self.stacks = np.zeros((len(self.envs), options.stack, 3, height, width), np.uint8)
        """Frame stacks, channels first, shape (n, stack, 3, height, width)."""
        self.lightings = [_no_lighting(options)] * len(self.envs)
        self._noise: list[CameraNoise | None] = [None] * len(self.envs)
        self._weather: list[Weather | None] = [None] * len(self.envs)
        self.trust = np.zeros(len(self.envs))
        """Trust of each env's newest frame, in [0, 1], shape (n,)."""

    def begin(self, which: Sequence[int]) -> None:
        """Samples lighting, camera noise and weather of episodes that have just begun, and fills their stacks."""
        o = self.options
        for i in which:
            task = self.envs[i][1]
            if self._sets:
                self.lightings[i] = sample_lighting(
                    o.lighting, o.lighting_drift, task.time_limit, self._sets, task.rng(LIGHTING)
                )
            if o.camera:
                self._noise[i] = CameraNoise(o.camera, task.rng(CAMERA))
            self._begin_weather(i)
        if len(which):
            self._add_frames(which, fill=True)

    def set_lighting(self, i: int, lighting: EpisodeLighting, fill: bool) -> None:
        """Replaces the lighting of env i's episode from the next frame on; `fill` also renews the whole frame stack."""
        self.lightings[i] = lighting
        self._begin_weather(i)
        if fill:
            self._add_frames([i], fill=True)

    def _begin_weather(self, i: int) -> None:
        """Sets up the weather of env i's episode under its lighting."""
        o, task = self.options, self.envs[i][1]
        fog = self.lightings[i].fog_at(0.0)
        # Lightings fitted to a photo always have a fog; for a clear day, its extinction is 0.
        known = self.lightings[i].fog is not None and o.randomise and o.randomise.hold_known
        task.sample = task.drawn.for_known_weather() if known else task.drawn
        has_weather = fog is not None or o.randomise
        sun = main_sun(self.lightings[i].sunlight_at(0.0))
        known_sun = sun.toward if sun else None
        self._weather[i] = Weather(task.sample, task.rng(WEATHER), fog, known_sun) if has_weather else None

    def observe(self, which: Sequence[int]) -> None:
        """Adds a new frame to the stacks of some envs."""
        if len(which):
            self._add_frames(which, fill=False)

    def info(self, i: int) -> dict[str, Any]:
        """Entries of env i's info: `lighting` (the name used in tables) and `trust`."""
        name = str(Condition(self.lightings[i].name, bool(self.options.randomise)))
        return {"lighting": name, "trust": float(self.trust[i])}

    def _add_frames(self, which: Sequence[int], fill: bool) -> None:
        """Adds new frames to the stacks of some envs, or fills the stacks with them."""
        index, new = list(which), self._render(which)[:, None]
        self.stacks[index] = new if fill else np.concatenate([self.stacks[index][:, 1:], new], 1)

    def _render(self, which: Sequence[int]) -> Image:
        physics = [self.envs[i][0] for i in which]
        datas, poses = [one.delayed_data for one in physics], np.array([one.camera_to_world for one in physics])
        noise = [self._noise[i] for i in which] if self.options.camera else None
        weather = [self._weather[i] for i in which]
        moments = [(self.lightings[i], data.time) for i, data in zip(which, datas, strict=True)]
        for one, (lighting, time) in zip(weather, moments, strict=True):
            if one:
                one.fog = lighting.fog_at(time)
        embeddings = [lighting.at(time) for lighting, time in moments]
        suns = [lighting.sunlight_at(time) for lighting, time in moments]
        out = self._renderer.render(datas, embeddings, noise, weather, suns)
        self.trust[list(which)] = self._trust.of(poses, out)
        return (np.clip(out.rgb.transpose(0, 3, 1, 2), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _no_lighting(options: Options) -> EpisodeLighting:
    """Lighting before the first episode, and of images that do not come from a field."""
    return EpisodeLighting(options.observe, np.zeros(0, np.float32))


# ---- frame stacks on the GPU

CameraPoses = Callable[[NDArray[np.int64]], tuple[Array, Array]]


@wp.kernel
def _push_frames(
    rgb: wp.array2d(dtype=wp.vec3),
    opacity: wp.array2d(dtype=float),
    which: wp.array(dtype=int),
    fill: int,
    lower: int,
    sky: float,
    stacks: wp.array4d(dtype=wp.uint8),
    below: wp.array2d(dtype=float),
):
    """Adds frames to the stacks of some envs, or fills the stacks with them.

    `below` accumulates two sums over the lower half of each frame (pixels from `lower` on): the opacities, and the
    number of pixels whose opacity is less than `sky`.
    """
    k, pixel = wp.tid()
    env, depth = which[k], stacks.shape[1]
    for channel in range(3):
        value = wp.uint8(wp.clamp(rgb[k, pixel][channel], 0.0, 1.0) * 255.0 + 0.5)
        for i in range(depth - 1):
            if fill == 1:
                stacks[env, i, channel, pixel] = value
            else:
                stacks[env, i, channel, pixel] = stacks[env, i + 1, channel, pixel]
        stacks[env, depth - 1, channel, pixel] = value
    if pixel >= lower:
        wp.atomic_add(below, k, 0, opacity[k, pixel])
        if opacity[k, pixel] < sky:
            wp.atomic_add(below, k, 1, 1.0)


class GpuPixelObserver(PixelObserver):
    """Renders n envs and keeps their frame stacks on the field's device, for policies that are trained there.

    Its images show only the field. Obstacles, weather and camera noise need `PixelObserver`, which composites on the
    host.
    """

    def __init__(
        self, field: BakedField, trust: Trust, options: Options, envs: Sequence[tuple[DrivePhysics, DriveTask]]
    ) -> None:
        self.options, self.envs, self._field = options, list(envs), field
        self._trust, self._sets = trust, LightingSets(field)
        model, (width, height), n = envs[0][0].robot.model, options.size, len(envs)
        self._intrinsics = camera_intrinsics(model, model.camera(FRONT_CAMERA).id, options.size)
        self._stacks: Any = wp.zeros((n, options.stack, 3, width * height), dtype=wp.uint8, device=field.device)
        self.lightings = [_no_lighting(options)] * n
        self.trust = np.zeros(n)
        self._noise, self._weather = [None] * n, [None] * n
        self.camera_poses: CameraPoses = self._camera_poses
        """Returns the OpenCV poses (k, 4, 4) and times (k,) [s] of the newest frames of k envs, given by index."""

    @property
    def stacks(self) -> Image:  # type: ignore[override]
        """A copy of the stacks on the host, shape (n, stack, 3, height, width)."""
        n, stack, channels, _ = self._stacks.shape
        width, height = self.options.size
        return self._stacks.numpy().reshape(n, stack, channels, height, width).copy()

    def tensor(self) -> "torch.Tensor":
        """The stacks on the device, uint8 (n, 3 · stack, height, width); the next step overwrites them."""
        import torch  # noqa: F401, as Warp's conversion needs it

        width, height = self.options.size
        return wp.to_torch(self._stacks).reshape(len(self.envs), -1, height, width)

    def _camera_poses(self, which: NDArray[np.int64]) -> tuple[Array, Array]:
        physics = [self.envs[i][0] for i in which]
        return np.array([one.camera_to_world for one in physics]), np.array([one.delayed_data.time for one in physics])

    def _add_frames(self, which: Sequence[int], fill: bool) -> None:
        width, height = self.options.size
        poses, times = self.camera_poses(np.array(which))
        embeddings = [self.lightings[i].at(time) for i, time in zip(which, times.tolist(), strict=True)]
        # The number of environments that begin an episode changes from step to step; rounded up to a power of two, it
        # needs fewer render targets.
        count = min(1 << (len(which) - 1).bit_length(), len(self.envs)) - len(which)
        views = Viewpoints.of(np.append(poses, np.repeat(poses[-1:], count, 0), 0), self._intrinsics, self.options.size)
        embeddings += embeddings[-1:] * count
        lower, device = height // 2 * width, self._field.device
        below = wp.zeros((len(which), 2), dtype=float, device=device)
        index = wp.array(list(which), dtype=int, device=device)

        def push(rgb: Any, opacity: Any) -> None:
            inputs = [rgb, opacity, index, int(fill), lower, SKY_OPACITY]
            wp.launch(_push_frames, (len(which), rgb.shape[1]), inputs, [self._stacks, below], device=device)

        self._field.render_on_device(views, embeddings, push)
        mean_opacity, sky_share = below.numpy().T / (width * height - lower)
        self.trust[list(which)] = self._trust.from_opacity(poses, mean_opacity, sky_share)
