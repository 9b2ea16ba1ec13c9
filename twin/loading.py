"""Opening a built twin from policy code: `twin.load_scene("scenes/demo")`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import InputError
from twin.files import read_json
from twin.scene import SceneDir, finished

if TYPE_CHECKING:
    from twin.geometry.cameras import Cameras
    from twin.mjcf.world import World
    from twin.nerf.baked import BakedField
    from twin.nerf.field import RadianceField


@dataclass(frozen=True)
class Twin:
    """A built scene. Every part is read from disk when it is asked for.

    Each method raises InputError where the stage that makes its part has not been built.
    """

    scene: SceneDir

    def cameras(self) -> Cameras:
        """The filmed frames: metric poses, z up."""
        from twin.geometry.cameras import Cameras

        return Cameras.load(self._folder("metric"))

    def field(self, device: str = "cpu") -> BakedField:
        """The place to look at, under every lighting it was filmed in and those added by `python -m twin.relight`.

        Needs no torch. `device` is cpu or cuda.
        """
        from twin.nerf.added_lightings import added_lightings
        from twin.nerf.baked import BakedField

        field = BakedField.load(self._folder("field"), device)
        field.add_lightings(*added_lightings(self.scene, field.lightings_by_name.vectors.shape[1]))
        return field

    def radiance_field(self) -> RadianceField:
        """The field as it was trained, in torch: slower and a little finer than `field`, with its lightings."""
        from twin.nerf.added_lightings import added_lightings
        from twin.nerf.field import RadianceField

        field = RadianceField.load(self._folder("field"))
        fresh, stale, _ = added_lightings(self.scene, field.appearance.vectors.shape[1])
        field.add_lightings(fresh, stale)
        return field

    def world(self) -> World:
        """The MJCF scene with its route, corridor and goal."""
        from twin.mjcf.world import World

        return World.load(self._folder("mjcf"))

    def report(self) -> dict[str, Any]:
        """Every number of the last build."""
        if not self.scene.report_json.exists():
            raise InputError(f"{self.scene.report_json} is missing; run python -m twin.build {self.scene.root}")
        return read_json(self.scene.report_json)

    def _folder(self, stage: str) -> Path:
        return finished(self.scene, stage)


def load_scene(path: str | Path) -> Twin:
    """Opens a scene folder that `python -m twin.build` has built. Raises InputError where there is none."""
    scene = SceneDir(Path(path))
    if not scene.config_file.exists():
        raise InputError(f"no scene.toml in {path}; give the scene's folder, such as scenes/demo")
    return Twin(scene)
