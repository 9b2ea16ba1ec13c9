"""Readers of image sets: plain folders without poses, and COLMAP models and `transforms.json` with cameras and poses.

A COLMAP *model* is the folder with the files `cameras` and `images`; a *workspace* has a model under `sparse/0`. The
points of a model are not read. `transforms.json` has two variants. nerfstudio writes the camera model and may transform
the world (`applied_transform`). instant-ngp may write only an angle of view, and file names without suffix. Both use
OpenGL camera axes (y up, looking along −z); poses here have OpenCV axes. nerfstudio's transform of the world is undone,
so that all sources posed by one reconstruction are in the same world coordinates.
"""

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap

from twin.capture.camera_models import Lens, checked_lens
from twin.config import CAMERA_MODELS
from twin.errors import InputError, short_repr
from twin.files import is_file, read_bytes, read_json, wrap_read_errors
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.images import HEIF_SUFFIXES, image_size
from twin.geometry.poses import inverse_pose, pose_of
from twin.types import Array

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".jp2", *HEIF_SUFFIXES)
_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")
_MODEL_NAMES = {int(pycolmap.CameraModelId.__members__[name]): name for name in CAMERA_MODELS}
_CURE = "export the model again"
_MAX_POSE_VALUE = 1e9  # upper limit of the numbers in a COLMAP pose
_MAX_CAMERA_VALUE = 1e12  # upper limit of a camera's numbers in `transforms.json`
_MAX_COORDINATE = 1e9  # upper limit of a camera center's coordinates in `transforms.json`
_RIGID_TOLERANCE = 1e-2  # largest accepted entry of RᵀR − I; rounding in the file causes smaller ones


# ---- COLMAP models
#
# pycolmap's reader is not used: it needs the points' files and loads them, accepts a truncated cameras.bin, does not
# name file and line of damaged text, and may abort the process.


def find_model(folder: Path) -> Path | None:
    """The COLMAP model in a folder or at the usual places below it, or None."""
    models = (folder / name for name in _MODEL_FOLDERS)
    return next((model for model in models if _has_model(model, ".bin") or _has_model(model, ".txt")), None)


def _has_model(folder: Path, suffix: str) -> bool:
    return is_file(folder / f"cameras{suffix}") and is_file(folder / f"images{suffix}")


def read_model(model: Path) -> list[tuple[str, Lens, Array]]:
    """The registered images of a model in file order: name, lens and camera_to_world (4, 4).

    Raises InputError: damaged or inconsistent files, or a pose that is not finite.
    """
    binary = _has_model(model, ".bin")
    cameras_path, images_path = (model / f"{name}{'.bin' if binary else '.txt'}" for name in ("cameras", "images"))
    with wrap_read_errors(cameras_path, _CURE):
        lenses = (_cameras_bin if binary else _cameras_txt)(cameras_path)
    with wrap_read_errors(images_path, _CURE):
        images = (_images_bin if binary else _images_txt)(images_path)
    posed = []
    for name, camera_id, values in images:
        if camera_id not in lenses:
            raise InputError(f"{images_path}: {name} uses camera {camera_id}, which {cameras_path.name} does not list")
        file = PurePosixPath(name.replace("\\", "/"))
        if not file.name or file.is_absolute() or ".." in file.parts or "\0" in name:
            raise InputError(f"{images_path}: an image is named {name!r}; expected a path below the image folder")
        if not np.abs(values).max() < _MAX_POSE_VALUE or (length := float(np.linalg.norm(values[:4]))) < 1e-6:
            raise InputError(f"{images_path}: the pose of {name} is not finite; remove that image or export again")
        world_to_camera = pose_of(rotation_from_quaternion(values[:4] / length), values[4:])
        posed.append((name, lenses[camera_id], inverse_pose(world_to_camera)))
    return posed


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z), shape (3, 3)."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * cross


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for number, line in _numbered_lines(path):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words, where = line.split(), f"{path}: line {number}"
        try:
            key, width, height, params = int(words[0]), int(words[2]), int(words[3]), tuple(map(float, words[4:]))
        except (ValueError, IndexError):
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}") from None
        lenses[key] = checked_lens(words[1], params, width, height, where)
    return lenses


def _images_txt(path: Path) -> list[tuple[str, int, Array]]:
    images = []
    lines = _numbered_lines(path)
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
        next(lines, None)  # skips the line of the image's points, which may be empty
    return images


def _numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        return iter(enumerate(read_bytes(path).decode("utf-8").splitlines(), 1))
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; {_CURE}") from None


class _BinaryReader:
    """Reads packed little-endian values of a file in sequence."""

    def __init__(self, path: Path) -> None:
        self.data, self.offset = read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        start = self.offset
        self.offset += struct.calcsize("<" + layout)
        return struct.unpack_from("<" + layout, self.data, start)

    def text(self) -> str:
        start, end = self.offset, self.data.index(b"\0", self.offset)
        self.offset = end + 1
        return self.data[start:end].decode("utf-8")


def _cameras_bin(path: Path) -> dict[int, Lens]:
    reader, lenses = _BinaryReader(path), {}
    for _ in range(reader.take("Q")[0]):
        key, model_id, width, height = reader.take("iiQQ")
        model = _MODEL_NAMES.get(model_id)
        if model is None:
            raise ValueError(f"unknown camera model number {model_id}")
        params = reader.take(f"{CAMERA_MODELS[model]}d")
        lenses[key] = checked_lens(model, params, width, height, f"{path}: camera {key}")
    return lenses


def _images_bin(path: Path) -> list[tuple[str, int, Array]]:
    reader, images = _BinaryReader(path), []
    for _ in range(reader.take("Q")[0]):
        values = reader.take("I7dI")
        images.append((reader.text(), int(values[8]), np.array(values[1:8])))
        (points,) = reader.take("Q")
        reader.offset += 24 * points
        if reader.offset > len(reader.data):
            raise ValueError(f"the file ends early, after {len(reader.data)} bytes")
    return images


# ---- image sets


@dataclass(frozen=True)
class ImageSet:
    """n image files in natural order of their names, with or without poses."""

    paths: tuple[Path, ...]
    lenses: tuple[Lens, ...] | None = None  # one per image, at the size given in the file; None without cameras
    camera_to_world: Array | None = None  # OpenCV axes, shape (n, 4, 4); None without poses
    masks: tuple[Path | None, ...] | None = None  # file or None per image; None if the set lists no masks
    missing: int = 0  # number of listed images that do not exist
    missing_masks: int = 0  # number of listed masks that do not exist


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `frame10` after `frame9`."""
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", text) if part)


def read_image_folder(folder: Path) -> ImageSet:
    """The images of a folder in natural order. Raises InputError if there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; kind = 'images' needs a folder of images")
    paths = image_files(folder)
    if not paths:
        raise InputError(f"{folder}: no image here (looked for {', '.join(IMAGE_SUFFIXES)}); put the photos in it")
    return ImageSet(tuple(paths))


def read_colmap(folder: Path, images: Path | None = None) -> ImageSet:
    """The registered images of a COLMAP model or workspace; images without a file are left out and counted.

    Without `images`, the image folder is searched for in and above the model. Raises InputError: no model, damaged
    files, no image found.
    """
    model = find_model(folder) if folder.is_dir() else None
    if model is None:
        raise InputError(f"{folder}: no COLMAP model here; expected cameras and images as .bin or .txt")
    posed = sorted(read_model(model), key=lambda entry: natural_key(entry[0]))
    if not posed:
        raise InputError(f"{model}: the COLMAP model has no registered image; reconstruct again")
    roots = [images] if images else [r for up in (folder, model, *list(model.parents)[:3]) for r in (up / "images", up)]
    root = next((r for r in roots if any(is_file(r / name) for name, _, _ in posed)), None)
    if root is None:
        raise InputError(
            f"{model}: none of its {len(posed)} images (such as {posed[0][0]}) found in {roots[0]}; "
            "set `images` in scene.toml to their folder"
        )
    found = [(root / name, lens, pose) for name, lens, pose in posed if is_file(root / name)]
    paths, lenses, poses = zip(*found, strict=True)
    return ImageSet(paths, lenses, np.stack(poses), missing=len(posed) - len(found))


def read_transforms(path: Path, images: Path | None = None) -> ImageSet:
    """The images of a `transforms.json`, or of the one in a folder; images without a file are left out and counted.

    The images are searched for in the folder `images`; without it, by their paths relative to the JSON file.

    Raises InputError: wrong JSON, a missing or impossible entry, a pose that is not rigid, no image found.
    """
    path = path / "transforms.json" if path.is_dir() else path
    with wrap_read_errors(path, "export the file again"), np.errstate(all="ignore"):
        return _image_set(path, _transforms_table(path), images)


def _image_set(path: Path, table: dict[str, Any], images: Path | None) -> ImageSet:
    frames = table.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: no frames in it; expected a nerfstudio or instant-ngp transforms.json")
    to_original, scale = _undo_world_transform(table, path)
    entries: dict[Path, tuple[Lens, Array, Path | None]] = {}
    missing = missing_masks = 0
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{where} has no file_path; export the file again")
        where += f" ({frame['file_path']})"
        pose = _rigid_pose(frame.get("transform_matrix"), where)
        file = _find_image(path.parent, images, frame["file_path"])
        if file is None:
            missing += 1
            continue
        world = opencv_to_mujoco(to_original @ pose)  # this flip of axes also converts OpenGL to OpenCV
        world[:3, 3] /= scale
        if not np.abs(world[:3, 3]).max() < _MAX_COORDINATE:
            raise InputError(f"{where}: the position in transform_matrix is too large; export the file again")
        mask = frame.get("mask_path")
        if not isinstance(mask, str | None):
            raise InputError(f"{where}: mask_path = {short_repr(mask)}; expected a path")
        mask_path = path.parent / mask if mask and is_file(path.parent / mask) else None
        missing_masks += bool(mask) and mask_path is None
        entries.setdefault(file, (lens_from_transforms({**table, **frame}, file, where), world, mask_path))
    if not entries:
        raise InputError(
            f"{path}: none of its {len(frames)} images (such as {frames[0]['file_path']}) found; "
            "set `images` in scene.toml to their folder"
        )
    files = sorted(entries, key=lambda file: natural_key(str(file)))
    lenses, poses, masks = zip(*(entries[file] for file in files), strict=True)
    return ImageSet(tuple(files), lenses, np.stack(poses), masks if any(masks) else None, missing, missing_masks)


def listed_files(path: Path, images: Path | None = None) -> list[Path]:
    """The existing images and masks listed by a `transforms.json`; empty for a damaged file."""
    try:
        frames = _transforms_table(path).get("frames")
    except InputError:
        return []  # `read_transforms` will report the error
    found = set()
    for frame in frames if isinstance(frames, list) else ():
        if isinstance(frame, dict):
            if isinstance(name := frame.get("file_path"), str):
                found.add(_find_image(path.parent, images, name))
            if isinstance(name := frame.get("mask_path"), str) and is_file(path.parent / name):
                found.add(path.parent / name)
    return sorted(filter(None, found))


def lens_from_transforms(table: dict[str, Any], file: Path, where: str) -> Lens:
    """The lens of one frame; `table` is the file's top level updated with the frame's own entries.

    Raises InputError: neither focal length nor angle of view, or an unsupported camera model.
    """

    def number(key: str, default: float = 0.0) -> float:
        value = table.get(key)
        if value is not None and not _is_number(value, _MAX_CAMERA_VALUE):
            raise InputError(f"{where}: {key} = {short_repr(value)}; expected a finite number")
        return default if value is None else value

    width, height = (round(number("w")), round(number("h"))) if "w" in table and "h" in table else image_size(file)
    fx, fy = number("fl_x"), number("fl_y")
    angle_x, angle_y = number("camera_angle_x"), number("camera_angle_y")
    if table.get("fl_x") is None and angle_x:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if table.get("fl_y") is None and angle_y and "fl_x" not in table:
        fy = 0.5 * height / math.tan(0.5 * angle_y)
    fx, fy = fx or fy, fy or fx
    if not fx or not fy:
        raise InputError(f"{where}: neither fl_x nor camera_angle_x; add the focal length [px]")
    core = (fx, fy, number("cx", 0.5 * width), number("cy", 0.5 * height))
    k1, k2, k3, k4, p1, p2 = map(number, ("k1", "k2", "k3", "k4", "p1", "p2"))
    name = table.get("camera_model") or ""
    if not isinstance(name, str):
        raise InputError(f"{where}: camera_model = {short_repr(name)}; expected OPENCV, OPENCV_FISHEYE or PINHOLE")
    if name == "OPENCV_FISHEYE" or (not name and table.get("is_fisheye")):
        return checked_lens("OPENCV_FISHEYE", (*core, k1, k2, k3, k4), width, height, where)
    if name not in ("", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise InputError(f"{where}: camera_model {name!r} is not supported; expected OPENCV, OPENCV_FISHEYE or PINHOLE")
    if k4:
        raise InputError(f"{where}: k4 = {k4:g} of a perspective camera is not supported; calibrate with k1, k2, k3")
    if k3:
        return checked_lens("FULL_OPENCV", (*core, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), width, height, where)
    if k1 or k2 or p1 or p2:
        return checked_lens("OPENCV", (*core, k1, k2, p1, p2), width, height, where)
    return checked_lens("PINHOLE", core, width, height, where)


def is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and is_file(path)


def image_files(folder: Path) -> list[Path]:
    return sorted(filter(is_image, folder.iterdir()), key=lambda p: natural_key(p.name))


def _transforms_table(path: Path) -> dict[str, Any]:
    try:
        table = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; give a transforms.json or the folder that holds it") from None
    if not isinstance(table, dict):
        raise InputError(f"{path}: expected a JSON object with frames, got {type(table).__name__}")
    return table


def _rigid_pose(value: Any, where: str) -> Array:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where}: transform_matrix is not 4x4; export the file again")
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: transform_matrix is not finite; remove this frame or export the file again")
    rotation = matrix[:3, :3]
    wrong = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not wrong <= _RIGID_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"{where}: transform_matrix is not rigid (RᵀR is off by {wrong:.2g}, det {np.linalg.det(rotation):.2g}); "
            "expected a rotation and a translation"
        )
    u, _, vt = np.linalg.svd(rotation)  # the nearest rotation, since the file's numbers may be rounded
    return pose_of(u @ vt, matrix[:3, 3])


def _undo_world_transform(table: dict[str, Any], path: Path) -> tuple[Array, float]:
    """The inverse of nerfstudio's transform of the world: a rigid transform (4, 4), then a division of positions."""
    to_original = np.eye(4)
    if "applied_transform" in table:
        to_original = inverse_pose(_rigid_pose(table["applied_transform"], f"{path}: applied_transform"))
    scale = table.get("applied_scale", 1.0)
    if not _is_number(scale, _MAX_CAMERA_VALUE) or scale <= 1 / _MAX_CAMERA_VALUE:
        raise InputError(f"{path}: applied_scale = {short_repr(scale)}; expected a positive number")
    # nerfstudio scales after the rigid transform, x' = s (R x + t), so the translation of the inverse is scaled too.
    to_original[:3, 3] *= scale
    return to_original, float(scale)


def _is_number(value: Any, limit: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < limit


def _find_image(base: Path, images: Path | None, name: str) -> Path | None:
    name = name.replace("\\", "/")
    for path in [images / name, images / Path(name).name] if images else [base / name]:
        suffixes = [""]
        if path.name and path.suffix.lower() not in IMAGE_SUFFIXES:  # instant-ngp writes names without a suffix
            suffixes += [case for suffix in IMAGE_SUFFIXES for case in (suffix, suffix.upper())]
        for suffix in suffixes:
            if is_file(candidate := path.parent / (path.name + suffix)):
                return candidate
    return None
