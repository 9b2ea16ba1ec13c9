"""Lightings added to a built scene: `<scene>/lightings/<name>.json`, fitted to a photo by `python -m twin.relight`.

The files lie outside `build/`, which may be deleted at any time. An embedding is valid for one field only, so each file
stores the content digest of its field stage; with another build of the field it is *stale*.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.config import RESERVED_LIGHTINGS
from twin.errors import InputError
from twin.files import read_json, wrap_read_errors, write_json
from twin.nerf.fog import Fog
from twin.scene import SceneDir, stage_result
from twin.scene import check_name as check_scene_name

_FORMAT = 2  # 1 has no fog


@dataclass(frozen=True)
class AddedLighting:
    """One added lighting and its origin. The file stores these names as keys."""

    name: str
    embedding: list[float]
    """Length dim."""
    air: Fog
    """Fog in the photo."""
    field: str
    """`result` in the stamp of its field stage."""
    photo: str
    """Path of the photo, as given."""
    figures: dict[str, Any]
    """Numbers of the fit, JSON-able."""

    def save(self, scene: SceneDir) -> None:
        """Writes `lightings/<name>.json`, replacing an existing file."""
        scene.lightings.mkdir(exist_ok=True)
        write_json(scene.lightings / f"{self.name}.json", {"format": _FORMAT, **asdict(self)})


def check_name(name: str, filmed: tuple[str, ...]) -> None:
    """Raises InputError for a name that is reserved, filmed, or unfit for a file name or a part of a mixture."""
    check_scene_name(name, "--name")
    if name in RESERVED_LIGHTINGS:
        raise InputError(f"--name {name!r}: reserved for random lightings; choose another, such as afternoon")
    if name in filmed:
        raise InputError(f"--name {name!r}: the place was filmed under a lighting of this name; choose another")


def field_result(scene: SceneDir) -> str:
    """Content digest of a scene's field stage. Raises InputError if it is not built."""
    return stage_result(scene, "field")


def added_lightings(
    scene: SceneDir, dim: int
) -> tuple[dict[str, NDArray[np.float32]], tuple[str, ...], dict[str, Fog]]:
    """Loads the lightings added to a scene's field: embeddings (dim,) by name, stale names, and fog by name.

    Raises InputError if a file is damaged or has another format.
    """
    result = field_result(scene)
    fresh: dict[str, NDArray[np.float32]] = {}
    fogs: dict[str, Fog] = {}
    stale = []
    for path in sorted(scene.lightings.glob("*.json")):
        with wrap_read_errors(path, "fit it again or delete it"):
            head = read_json(path)
            if head["format"] == 1:  # without fog
                stale.append(path.stem)
                continue
            if head["format"] != _FORMAT:
                raise InputError(f"{path}: format {head['format']}, expected {_FORMAT}; fit it again or delete it")
            made_by, vector = head["field"], np.array(head["embedding"], np.float32)
            red, green, blue = map(float, head["air"]["airlight"])
            fog = Fog(float(head["air"]["extinction"]), (red, green, blue))
            if not (0.0 <= fog.extinction < np.inf and all(0.0 <= share <= 1.0 for share in fog.airlight)):
                raise ValueError(f"air {fog.extinction}, {fog.airlight}")
            if vector.ndim != 1 or not np.isfinite(vector).all() or (made_by == result and vector.shape != (dim,)):
                raise ValueError(f"embedding of shape {vector.shape}, or not finite")
        if made_by == result:
            fresh[path.stem], fogs[path.stem] = vector, fog
        else:
            stale.append(path.stem)
    return fresh, tuple(stale), fogs
