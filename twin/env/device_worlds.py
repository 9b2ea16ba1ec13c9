"""Many worlds on a GPU: stepped, judged and, where the field alone is in view, seen all at once.

An episode begins on the host, world by world, as everywhere. After that nothing is done world by world but for those
who ask for one of them: `mujoco_warp` steps all (`device_steps.py`), one `Judge` judges all, and pictures stay on the
device (`device_pixels.py`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.env.batch import Outcome, Worlds
from twin.env.device_pixels import DevicePixels
from twin.env.device_steps import DeviceSteps
from twin.env.dm_physics import DrivePhysics
from twin.env.judge import Judge, Motion
from twin.env.suite import Stage
from twin.env.tasks import Drive

Array = NDArray[np.float64]


class DeviceWorlds(Worlds):
    """n worlds of one scene and task that `mujoco_warp` steps."""

    def __init__(self, stage: Stage, seeds: Sequence[int | None], device: str) -> None:
        """
        Args:
            stage: Scene, task and options.
            seeds: One per world, of its sequence of episodes; None: unpredictable.
            device: Warp's name of the device.
        """
        self._judge = Judge(stage.world, stage.stretch, stage.options, len(seeds))
        self._speed = np.zeros(len(seeds))
        super().__init__(stage, seeds)
        self._device = DeviceSteps(self._physics, stage.options.control_timestep, device)
        if isinstance(self.pixels, DevicePixels):
            self.pixels.eyes = self._device.eyes

    def _parts(self, stage: Stage, seeds: Sequence[int | None]) -> list[tuple[DrivePhysics, Drive]]:
        return [stage.drive(seed, (self._judge, i)) for i, seed in enumerate(seeds)]

    @property
    def physics(self) -> list[DrivePhysics]:
        """Of every world, as it is now: they are brought up to it, which is no matter of course here."""
        self._device.sync(np.arange(len(self)))
        return self._physics

    def begin(self, which: Sequence[int]) -> None:
        self._each(lambda i: self._environments[i].reset(), which)
        some = np.array(which, int)
        self._device.begin(some)
        self._remember(some, self._device.motion(some))
        if self.pixels:
            self.pixels.begin(which)

    def info(self, i: int) -> dict[str, Any]:
        told = self.tasks[i].told(float(self._speed[i]), self._device.touched(i))
        return told | (self.pixels.info(i) if self.pixels else {})

    def _advance(self, wanted: Array, which: Sequence[int]) -> Outcome:
        some = np.array(which, int)
        commands = self.tasks[0].commands(wanted)
        self._judge.act(some, commands[:, 1])
        self._device.step(some, commands)
        motion = self._device.motion(some)
        self._judge.judge(some, motion)
        self._remember(some, motion)
        if self.pixels and not isinstance(self.pixels, DevicePixels):
            self._device.sync(some)  # the host draws what is in view
        return Outcome(self._judge.reward(some), *self._judge.ended(some))

    def _remember(self, which: NDArray[np.int64], motion: Motion) -> None:
        self._states[which], self._speed[which] = self._judge.state(which, motion), motion.speed
