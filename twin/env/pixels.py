"""What the robots' cameras see: one call renders the pictures of n worlds, each in its own light.

A *stack* is the last few pictures of an episode, the newest last; at its beginning the first picture fills it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.config import RANDOMISED
from twin.env.camera_effects import CameraEffects
from twin.env.dm_physics import DrivePhysics
from twin.env.lightings import Light, LightSets, draw_light
from twin.env.options import SIMULATOR, Options
from twin.env.overlay import Overlay
from twin.env.simulator_view import SimulatorView
from twin.env.tasks import CAMERA, LIGHT, WEATHER, Drive
from twin.env.trust import Trust
from twin.env.weather import Weather
from twin.nerf.baked import BakedField

Picture = NDArray[np.uint8]

_PLAIN = Light(SIMULATOR, np.zeros(0, np.float32))


class Pixels:
    """Observes n worlds."""

    def __init__(
        self,
        overlay: Overlay | SimulatorView,
        field: BakedField | None,
        trust: Trust,
        options: Options,
        worlds: Sequence[tuple[DrivePhysics, Drive]],
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
        self._trust, self._sets = trust, LightSets(field) if field else None
        width, height = options.size
        self.stacks = np.zeros((len(self.worlds), options.stack, 3, height, width), np.uint8)
        """Shape (n, stack, 3, height, width): colours first, as networks want them."""
        self.lights: list[Light | None] = [None] * len(self.worlds)
        self._effects: list[CameraEffects | None] = [None] * len(self.worlds)
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
                self.lights[i] = draw_light(o.lighting, o.lighting_drift, task.time_limit, self._sets, task.rng(LIGHT))
            if o.camera:
                self._effects[i] = CameraEffects(o.camera, task.rng(CAMERA))
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

    def _look(self, which: Sequence[int]) -> Picture:
        physics = [self.worlds[i][0] for i in which]
        seen, poses = [one.seen for one in physics], np.array([one.camera_to_world for one in physics])
        lights = [self.lights[i].at(data.time) for i, data in zip(which, seen, strict=True)]  # type: ignore[union-attr]
        effects = [self._effects[i] for i in which] if self.options.camera else None
        weather = [self._weather[i] for i in which]
        for i, sky, data in zip(which, weather, seen, strict=True):
            if sky:
                sky.air = self.lights[i].air_at(data.time)  # type: ignore[union-attr]
        out = self._overlay.render(seen, lights, effects, weather)  # type: ignore[arg-type]
        self.trust[list(which)] = self._trust.of(poses, out)
        return (np.clip(out.rgb.transpose(0, 3, 1, 2), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
