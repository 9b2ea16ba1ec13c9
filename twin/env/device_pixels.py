"""Pictures that stay on the device they are marched on: for policies that learn there, in thousands of worlds.

Only what the field itself shows is there; worlds with obstacles, weather or an imperfect camera are seen by `Pixels`,
whose pictures come back to the host for what is put into them.
"""

# mypy: disable-error-code="index, attr-defined, valid-type, misc, arg-type, operator, var-annotated, call-overload"
# (inside kernels, Warp's own types hold, which mypy does not know)

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from twin.env.dm_physics import DrivePhysics
from twin.env.lightings import Light, LightSets
from twin.env.obstacle_view import camera_intrinsics
from twin.env.options import Options
from twin.env.pixels import Picture, Pixels
from twin.env.tasks import Drive
from twin.env.trust import SKY, Trust
from twin.geometry.cameras import Viewpoints
from twin.nerf.baked import BakedField

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]
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


class DevicePixels(Pixels):
    """Observes n worlds on the field's device."""

    def __init__(
        self, field: BakedField, trust: Trust, options: Options, worlds: Sequence[tuple[DrivePhysics, Drive]]
    ) -> None:
        """
        Args:
            field: Of the place; its device is where pictures stay.
            trust: What was filmed of it.
            options: Size, stack, lighting; no camera effects, nothing drawn anew, no light of a hazy photo.
            worlds: Whose episodes are observed, without obstacles.
        """
        self.options, self.worlds, self._field = options, list(worlds), field
        self._trust, self._sets = trust, LightSets(field)
        model, (width, height), n = worlds[0][0].robot.model, options.size, len(worlds)
        self._intrinsics = camera_intrinsics(model, model.camera("front").id, options.size)
        self._stacks: Any = wp.zeros((n, options.stack, 3, width * height), dtype=wp.uint8, device=field.where)
        self.lights: list[Light | None] = [None] * n
        self.trust = np.zeros(n)
        self._effects, self._weather = [None] * n, [None] * n
        self.eyes: Eyes = self._eyes
        """Where cameras of some worlds were when their newest pictures were taken, OpenCV poses (k, 4, 4), and when."""

    @property
    def stacks(self) -> Picture:  # type: ignore[override]
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
