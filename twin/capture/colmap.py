"""Posed images of a COLMAP model, text or binary, read without COLMAP so that a damaged file gives a clear message.

Only the cameras and the images are needed; points are found anew. A *model* is the folder that holds `cameras` and
`images`; a COLMAP *workspace* has it under `sparse/0`.
"""

import struct
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from twin.capture.lens import Lens, checked_lens
from twin.errors import InputError
from twin.geometry.poses import inverse_pose

_MODEL_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")

Array = NDArray[np.float64]


def find_model(folder: Path) -> Path | None:
    """The COLMAP model in a folder or at its usual places below it, or None."""
    for place in _MODEL_PLACES:
        model = folder / place
        if any((model / f"cameras{kind}").exists() and (model / f"images{kind}").exists() for kind in (".bin", ".txt")):
            return model
    return None


def read_model(model: Path) -> list[tuple[str, Lens, Array]]:
    """The registered images of a model: name, lens and camera_to_world (4, 4), in the order of the file.

    Raises:
        InputError: damaged or inconsistent files, or a pose that is not finite.
    """
    kind = ".bin" if (model / "images.bin").exists() and (model / "cameras.bin").exists() else ".txt"
    read_cameras, read_images = (_cameras_bin, _images_bin) if kind == ".bin" else (_cameras_txt, _images_txt)
    cameras_path, images_path = model / f"cameras{kind}", model / f"images{kind}"
    try:
        lenses = read_cameras(cameras_path)
    except (ValueError, IndexError, struct.error) as error:
        raise _damaged(cameras_path, error) from None
    try:
        images = read_images(images_path)
    except (ValueError, IndexError, struct.error) as error:
        raise _damaged(images_path, error) from None
    posed = []
    for name, camera_id, values in images:
        if camera_id not in lenses:
            raise InputError(f"{images_path}: {name} uses camera {camera_id}, which {cameras_path.name} does not list")
        length = float(np.linalg.norm(values[:4]))
        if not np.isfinite(values).all() or length < 1e-6:
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


def _damaged(path: Path, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{path}: damaged or no COLMAP file ({error}); export the model again")


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
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; export the model again") from None


class _Reader:
    """Reads packed little-endian values from bytes, front to back."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

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
        try:
            camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model_id), 1.0, width, height)
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"camera model number {model_id}") from None
        params = reader.take(f"{len(camera.params)}d")
        lenses[key] = checked_lens(camera.model_name, params, width, height, f"{path}: camera {key}")
    return lenses


def _images_bin(path: Path) -> list[tuple[str, int, Array]]:
    reader, images = _Reader(path), []
    for _ in range(reader.take("Q")[0]):
        values = reader.take("I7dI")
        images.append((reader.text(), int(values[8]), np.array(values[1:8])))
        reader.skip(24 * reader.take("Q")[0])
    return images
