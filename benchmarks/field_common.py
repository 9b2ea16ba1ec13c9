"""Settings of a run of `field.py`, and functions that load fields, render and start workers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sections import run_worker

SIZE = (160, 90)
"""Width, height of the robot's image [px]."""


@dataclass(frozen=True)
class Bench:
    """One run of the benchmark."""

    scene: Path | None
    """A built scene; None if no section needs one."""
    data: Path
    """Folder of the real captures."""
    work: Path
    """Empty folder for intermediate files."""
    budgets: tuple[int, ...]
    """Wall times of training [s]."""
    quick: bool
    """Tiny settings that only show that the script runs."""

    def pick(self, usual: Any, quick: Any) -> Any:
        return quick if self.quick else usual


def load_field(scene: Path) -> Any:
    """The trained radiance field of a built scene (torch)."""
    from twin.loading import load_scene

    return load_scene(scene).radiance_field("cpu")


def load_baked(path: Path, device: str = "cpu") -> Any:
    """The baked field of a built scene, or of a folder that contains one."""
    if (path / "scene.toml").exists() and device == "cpu":
        from twin.loading import load_scene

        return load_scene(path).field()
    from twin.nerf.baked import BakedField

    return BakedField.load(path / "build/3_field" if (path / "scene.toml").exists() else path, device)


def render(field: Any, poses: NDArray, intrinsics: NDArray, size: tuple[int, int], lighting: str) -> Any:
    """Renders n views of a trained or baked field under a lighting; poses (n, 4, 4), intrinsics (4,) [px] at `size`."""
    from twin.geometry.cameras import Viewpoints

    return field.render(Viewpoints.of(poses, intrinsics, size), lighting, size)


def worker(*arguments: str | Path | int, environment: dict[str, str] | None = None) -> dict[str, Any]:
    """Figures of a function of `field_workers.py`, see `run_worker`."""
    return run_worker("field_workers.py", arguments, environment or {})


def route_views(bench: Bench) -> Path:
    """A file with views of the robot's front camera along the route: poses (k, 4, 4), intrinsics (4,) [px].

    The scripted driver drives the route in simulation, so the views have the height and pitch of the robot's camera.
    """
    file = bench.work / "views.npz"
    if not file.exists():
        from twin.env.drivers import follow_route
        from twin.env.physics import HuskyPhysics
        from twin.loading import load_scene

        world = load_scene(bench.scene).world()
        drive = follow_route(world, HuskyPhysics(world.model(), world.robot), 1.0)
        np.savez(file, poses=drive.camera_to_world, intrinsics=world.intrinsics)
    return file
