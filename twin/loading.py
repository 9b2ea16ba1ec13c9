"""Access to a built scene from Python: `twin.load_scene("scenes/demo")`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import InputError
from twin.files import read_json
from twin.scene import SceneDir, require_stage
from twin.unpack import open_scene

if TYPE_CHECKING:
    from twin.geometry.cameras import Cameras
    from twin.mjcf.world import World
    from twin.nerf.baked import BakedField
    from twin.nerf.field import RadianceField


@dataclass(frozen=True)
class Twin:
    """A built scene. Each method reads a part of it from disk, and raises InputError if that part was not built."""

    scene: SceneDir

    def cameras(self) -> Cameras:
        """Cameras of the filmed frames: metric poses, z up."""
        from twin.geometry.cameras import Cameras

        return Cameras.load(require_stage(self.scene, "metric"))

    def field(self, device: str = "cpu") -> BakedField:
        """The baked radiance field with the filmed lightings and those added by `twin.relight`; needs no torch.

        `device` is cpu or cuda.
        """
        from twin.nerf.baked import BakedField
        from twin.nerf.lightings import added_lightings

        field = BakedField.load(require_stage(self.scene, "field"), device)
        field.add_lightings(*added_lightings(self.scene, field.lightings_by_name.vectors.shape[1]))
        return field

    def radiance_field(self, device: str | None = None) -> RadianceField:
        """The radiance field as trained, in torch: slower and slightly more detailed than `field`, with the same
        lightings.

        `device` is cpu or cuda; None: cuda if it is usable.
        """
        from twin.nerf.field import RadianceField
        from twin.nerf.lightings import added_lightings

        field = RadianceField.load(require_stage(self.scene, "field"), device)
        fresh, stale, *_ = added_lightings(self.scene, field.appearance.vectors.shape[1])
        field.add_lightings(fresh, stale)
        return field

    def world(self) -> World:
        """The MJCF scene with route, corridor and goal."""
        from twin.mjcf.world import World

        return World.load(require_stage(self.scene, "mjcf"))

    def report(self) -> dict[str, Any]:
        """`report.json` of the last build."""
        if not self.scene.report_json.exists():
            raise InputError(f"{self.scene.report_json} is missing; run twin build {shlex.quote(str(self.scene.root))}")
        return read_json(self.scene.report_json)


def load_scene(path: str | Path) -> Twin:
    """Opens a scene folder built by `twin.build`, or a pack of a scene (see `twin.unpack.open_scene`).

    Raises InputError if there is no scene at the path.
    """
    scene = SceneDir(open_scene(Path(path)))
    if not scene.config_file.exists():
        raise InputError(f"no scene.toml in {path}; give the scene's folder, such as scenes/demo, or a pack of one")
    return Twin(scene)


def load_writable(path: Path) -> Twin:
    """Opens a scene folder to which results will be added. Raises InputError as `load_scene` does, or for a pack."""
    twin = load_scene(path)
    if twin.scene.root != path:
        command = f"twin unpack {shlex.quote(str(path))} FOLDER"
        raise InputError(f"{path} is a pack; unpack it to a folder, which can take results: {command}")
    return twin
