"""Posed images of a COLMAP model, text or binary, read without COLMAP so that a damaged file gives a clear message.

Only the cameras and the images are needed; points are found anew. A *model* is the folder that holds `cameras` and
`images`; a COLMAP *workspace* has it under `sparse/0`.
"""

import struct
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from twin.capture.lens import Lens, checked_lens
from twin.capture.paths import is_file
from twin.capture.pycolmap_import import pycolmap
from twin.config import CAMERA_MODELS
from twin.errors import InputError
from twin.files import damaged, read_bytes
from twin.geometry.poses import inverse_pose

_MODEL_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")
_MODEL_NAMES = {int(pycolmap.CameraModelId.__members__[name]): name for name in CAMERA_MODELS}
_LARGEST = 1e9  # number in a pose
_CURE = "export the model again"

Array = NDArray[np.float64]


def find_model(folder: Path) -> Path | None:
    """The COLMAP model in a folder or at its usual places below it, or None."""
    for place in _MODEL_PLACES:
        model = folder / place
        if any(_both(model, kind) for kind in (".bin", ".txt")):
            return model
    return None


def _both(model: Path, kind: str) -> bool:
    return is_file(model / f"cameras{kind}") and is_file(model / f"images{kind}")


def read_model(model: Path) -> list[tuple[str, Lens, Array]]:
    """The registered images of a model: name, lens and camera_to_world (4, 4), in the order of the file.

    Raises:
        InputError: damaged or inconsistent files, or a pose that is not finite.
    """
    kind = ".bin" if _both(model, ".bin") else ".txt"
    read_cameras, read_images = (_cameras_bin, _images_bin) if kind == ".bin" else (_cameras_txt, _images_txt)
    cameras_path, images_path = model / f"cameras{kind}", model / f"images{kind}"
    with damaged(cameras_path, _CURE):
        lenses = read_cameras(cameras_path)
    with damaged(images_path, _CURE):
        images = read_images(images_path)
    posed = []
    for name, camera_id, values in images:
        if camera_id not in lenses:
            raise InputError(f"{images_path}: {name} uses camera {camera_id}, which {cameras_path.name} does not list")
        place = PurePosixPath(name.replace("\\", "/"))
        if not place.name or place.is_absolute() or ".." in place.parts or "\0" in name:
            raise InputError(f"{images_path}: an image is named {name!r}; expected a path below the image folder")
        if not np.abs(values).max() < _LARGEST or (length := float(np.linalg.norm(values[:4]))) < 1e-6:
            raise InputError(f"{images_path}: the pose of {name} is not finite; remove that image or export again")
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quaternion(values[:4] / length)
        pose[:3, 3] = values[4:]
        posed.append((name, lenses[camera_id], inverse_pose(pose)))
    return posed


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z), shape (3, 3)."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * cross


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for number, line in enumerate(_text(path), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}: line {number}"
        try:
            key, width, height, params = int(words[0]), int(words[2]), int(words[3]), tuple(map(float, words[4:]))
        except (ValueError, IndexError):
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}") from None
        lenses[key] = checked_lens(words[1], params, width, height, where)
    return lenses


def _images_txt(path: Path) -> list[tuple[str, int, Array]]:
    images = []
    lines = iter(enumerate(_text(path), 1))
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        try:
            images.append((words[9].strip(), int(words[8]), np.array([float(word) for word in words[1:8]])))
        except (ValueError, IndexError):
            raise InputError(
                f"{path}: line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:60]!r}"
            ) from None
        next(lines, None)  # its points, perhaps an empty line
    return images


def _text(path: Path) -> list[str]:
    try:
        return read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; {_CURE}") from None


class _Reader:
    """Reads packed little-endian values from bytes, front to back."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        text, self.at = self.data[self.at : end].decode("utf-8"), end + 1
        return text

    def skip(self, count: int) -> None:
        if self.at + count > len(self.data):
            raise ValueError(f"ends after {len(self.data)} bytes")
        self.at += count


def _cameras_bin(path: Path) -> dict[int, Lens]:
    reader, lenses = _Reader(path), {}
    for _ in range(reader.take("Q")[0]):
        key, model_id, width, height = reader.take("iiQQ")
        model = _MODEL_NAMES.get(model_id)
        if model is None:
            raise ValueError(f"camera model number {model_id}")
        params = reader.take(f"{CAMERA_MODELS[model]}d")
        lenses[key] = checked_lens(model, params, width, height, f"{path}: camera {key}")
    return lenses


def _images_bin(path: Path) -> list[tuple[str, int, Array]]:
    reader, images = _Reader(path), []
    for _ in range(reader.take("Q")[0]):
        values = reader.take("I7dI")
        images.append((reader.text(), int(values[8]), np.array(values[1:8])))
        reader.skip(24 * reader.take("Q")[0])
    return images
