"""What the parts of `field.py` share: where things are, and the only calls that load and render."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIZE = (160, 90)
"""Width, height of the robot's picture [px]."""

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Bench:
    """One run of the benchmark."""

    scene: Path | None
    """A built scene; None where only sections run that need none."""
    data: Path
    """Folder of the real captures."""
    work: Path
    """Empty folder for what is made on the way."""
    budgets: tuple[int, ...]
    """For training [s]."""
    quick: bool
    """Everything tiny: proves that the script runs, and no more."""

    def pick(self, usual: Any, quick: Any) -> Any:
        return quick if self.quick else usual


def load_field(scene: Path) -> Any:
    """The radiance field of a built scene, as it was trained (torch)."""
    from twin.loading import load_scene

    return load_scene(scene).radiance_field("cpu")


def load_baked(place: Path, where: str = "cpu") -> Any:
    """The baked field of a built scene, or of a folder that holds one."""
    if (place / "scene.toml").exists() and where == "cpu":
        from twin.loading import load_scene

        return load_scene(place).field()
    from twin.nerf.baked import BakedField

    return BakedField.load(place / "build/3_field" if (place / "scene.toml").exists() else place, where)


def render(field: Any, poses: NDArray, intrinsics: NDArray, size: tuple[int, int], lighting: str) -> Any:
    """n views under one lighting from either field; poses (n, 4, 4), intrinsics (4,) [px] at `size`."""
    from twin.geometry.cameras import Viewpoints

    return field.render(Viewpoints.of(poses, intrinsics, size), lighting, size)


def worker(*arguments: str | Path | int, environment: dict[str, str] | None = None) -> dict[str, Any]:
    """What `field_workers.py` says, run in a process of its own so that nothing else is in its memory or caches.

    Raises:
        RuntimeError: it failed.
    """
    command = [sys.executable, str(_HERE / "field_workers.py"), *map(str, arguments)]
    path = os.pathsep.join(filter(None, [str(_HERE.parent), os.environ.get("PYTHONPATH", "")]))
    settings = os.environ | {"PYTHONPATH": path} | (environment or {})
    done = subprocess.run(command, env=settings, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, arguments))}:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def route_views(bench: Bench) -> Path:
    """A file with what the robot's front camera sees from along the route: poses (k, 4, 4), intrinsics (4,) [px].

    The scripted follower drives the route, so that the camera stands and nods as it does on the robot.
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
