"""Lightings added to a built scene: `<scene>/lightings/<name>.json`, fitted to a photo by `python -m twin.relight`.

They lie outside `build/`, which may be deleted at any time. An embedding means something to one field only, so each is
tied to the content digest of the field stage it was fitted with; beside another build of the field it is *stale*.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.config import RESERVED_LIGHTINGS
from twin.errors import InputError
from twin.files import damaged, read_json, write_json
from twin.nerf.fog import Fog
from twin.scene import SceneDir, result_of
from twin.scene import check_name as check_scene_name

_FORMAT = 2  # which has the air


@dataclass(frozen=True)
class AddedLighting:
    """One lighting, and what is known of how it came about."""

    name: str
    embedding: list[float]
    """Length dim."""
    air: Fog
    """What was in the air when the photo was taken."""
    field: str
    """`result` in the stamp of the field stage it belongs to."""
    photo: str
    """Path of the photo it was fitted to, as it was given."""
    figures: dict[str, Any]
    """Numbers of the fit, JSON-able."""

    def save(self, scene: SceneDir) -> None:
        """Writes `lightings/<name>.json`, in place of what had this name before."""
        scene.lightings.mkdir(exist_ok=True)
        write_json(scene.lightings / f"{self.name}.json", {"format": _FORMAT, **asdict(self)})


def check_name(name: str, filmed: tuple[str, ...]) -> None:
    """Raises InputError where a name cannot be that of an added lighting: it names a file, and a part of a mixture."""
    check_scene_name(name, "--name")
    if name in RESERVED_LIGHTINGS:
        raise InputError(
            f"--name {name!r}: has a meaning of its own, a light drawn at random; choose another, such as afternoon"
        )
    if name in filmed:
        raise InputError(f"--name {name!r}: the place was filmed under a lighting of this name; choose another")


def field_result(scene: SceneDir) -> str:
    """What the field of a scene is known by. Raises InputError where it has not been built."""
    return result_of(scene, "field")


def added_lightings(
    scene: SceneDir, dim: int
) -> tuple[dict[str, NDArray[np.float32]], tuple[str, ...], dict[str, Fog]]:
    """The lightings added to a scene's present field, whose embeddings have the shape (dim,).

    Returns:
        Embeddings by name, the names of those that are stale, and the air of each.

    Raises:
        InputError: a file there is damaged or of another format.
    """
    result = field_result(scene)
    fresh: dict[str, NDArray[np.float32]] = {}
    airs: dict[str, Fog] = {}
    stale = []
    for path in sorted(scene.lightings.glob("*.json")):
        with damaged(path, "fit it again or delete it"):
            head = read_json(path)
            if head["format"] == 1:  # without its air
                stale.append(path.stem)
                continue
            if head["format"] != _FORMAT:
                raise InputError(f"{path}: format {head['format']}, expected {_FORMAT}; fit it again or delete it")
            made_by, vector = head["field"], np.array(head["embedding"], np.float32)
            red, green, blue = map(float, head["air"]["airlight"])
            air = Fog(float(head["air"]["extinction"]), (red, green, blue))
            if not (0.0 <= air.extinction < np.inf and all(0.0 <= share <= 1.0 for share in air.airlight)):
                raise ValueError(f"air {air.extinction}, {air.airlight}")
            if vector.ndim != 1 or not np.isfinite(vector).all() or (made_by == result and vector.shape != (dim,)):
                raise ValueError(f"embedding of shape {vector.shape}, or not finite")
        if made_by == result:
            fresh[path.stem], airs[path.stem] = vector, air
        else:
            stale.append(path.stem)
    return fresh, tuple(stale), airs
