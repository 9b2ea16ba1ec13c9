"""Image sets as lists of files with what is known of each: plain folders, COLMAP models, `transforms.json`.

A *dialect* is a tool's way of writing `transforms.json`: nerfstudio names its camera model and may have moved the
world (`applied_transform`), instant-ngp may give only an angle of view and file names without a suffix. Both use OpenGL
camera axes (y up, looking along −z); here poses are OpenCV's. What a dialect did to the world is undone, so that
sources posed by one reconstruction share its world.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.capture.colmap import find_model, read_model
from twin.capture.lens import Lens, checked_lens
from twin.capture.paths import is_file, is_folder
from twin.errors import InputError, shown
from twin.files import damaged, read_json
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.images import image_size
from twin.geometry.poses import inverse_pose

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".jp2")
_LARGEST = 1e12  # number that a camera may have
_FAR = 1e9  # units from the origin that no camera is
_RIGID_TOLERANCE = 1e-2  # entries of RᵀR − 1; files with rounded numbers stay below

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageSet:
    """n image files in natural order of their names, posed or not."""

    paths: tuple[Path, ...]
    lenses: tuple[Lens, ...] | None = None
    """One per image, at the size the file's writer meant; None where no camera is given."""
    camera_to_world: Array | None = None
    """OpenCV axes, shape (n, 4, 4); None where no pose is given."""
    masks: tuple[Path | None, ...] | None = None
    """Masks that the set itself names."""
    missing: int = 0
    """Images that are listed but do not exist."""


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sorting key under which `frame10` comes after `frame9`."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part)


def detect_kind(path: Path) -> str:
    """What a source is, from what lies at its path: video, images, colmap or transforms. Raises InputError."""
    if not is_folder(path, "check path = in scene.toml (it is relative to the scene folder)"):
        return "transforms" if path.suffix.lower() == ".json" else "video"
    if find_model(path):
        return "colmap"
    if is_file(path / "transforms.json"):
        return "transforms"
    if _image_files(path):
        return "images"
    raise InputError(f"{path}: holds no images, no COLMAP model and no transforms.json; give a film or an image folder")


def read_image_folder(folder: Path) -> ImageSet:
    """The images of a folder in natural order. Raises InputError where there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; kind = 'images' needs a folder of images")
    paths = _image_files(folder)
    if not paths:
        raise InputError(f"{folder}: no image here (looked for {', '.join(IMAGE_SUFFIXES)}); put the photos in it")
    return ImageSet(tuple(paths))


def read_colmap(folder: Path, images: Path | None = None) -> ImageSet:
    """The registered images of a COLMAP model or workspace that exist as files.

    Args:
        folder: Model or workspace.
        images: Image folder; by default looked for in and above the model.

    Raises:
        InputError: no model, damaged files, no image found.
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
            "set images = in scene.toml"
        )
    found = [(root / name, lens, pose) for name, lens, pose in posed if is_file(root / name)]
    return ImageSet(
        tuple(path for path, _, _ in found),
        tuple(lens for _, lens, _ in found),
        np.stack([pose for _, _, pose in found]),
        missing=len(posed) - len(found),
    )


def read_transforms(path: Path, images: Path | None = None) -> ImageSet:
    """The images of a `transforms.json` that exist as files.

    Args:
        path: The file, or the folder that holds it.
        images: Image folder; by default file paths are relative to the JSON file.

    Raises:
        InputError: wrong JSON, a missing or impossible entry, a pose that is not rigid, no image found.
    """
    path = path / "transforms.json" if path.is_dir() else path
    with damaged(path, "export the file again"), np.errstate(all="ignore"):
        return _image_set(path, _json(path), images)


def _image_set(path: Path, table: dict[str, Any], images: Path | None) -> ImageSet:
    frames = table.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: no frames in it; expected a nerfstudio or instant-ngp transforms.json")
    undo, scale = _world_of(table, path)
    entries: dict[Path, tuple[Lens, Array, Path | None]] = {}
    missing = 0
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{where} has no file_path; export the file again")
        where += f" ({frame['file_path']})"
        pose = _rigid(frame.get("transform_matrix"), where)
        file = _find_image(path.parent, images, frame["file_path"])
        if file is None:
            missing += 1
            continue
        world = opencv_to_mujoco(undo @ pose)  # the flip between OpenGL and OpenCV axes is its own inverse
        world[:3, 3] /= scale
        if not np.abs(world[:3, 3]).max() < _FAR:
            raise InputError(f"{where}: transform_matrix lies too far away; export the file again")
        mask = frame.get("mask_path")
        if not isinstance(mask, str | None):
            raise InputError(f"{where}: mask_path = {shown(mask)}; expected a path")
        mask_path = path.parent / mask if mask and is_file(path.parent / mask) else None
        entries.setdefault(file, (lens_from_transforms({**table, **frame}, file, where), world, mask_path))
    if not entries:
        raise InputError(
            f"{path}: none of its {len(frames)} images (such as {frames[0]['file_path']}) found; "
            "set images = in scene.toml"
        )
    files = sorted(entries, key=lambda file: natural_key(str(file)))
    masks = tuple(entries[file][2] for file in files)
    return ImageSet(
        tuple(files),
        tuple(entries[file][0] for file in files),
        np.stack([entries[file][1] for file in files]),
        masks if any(masks) else None,
        missing,
    )


def files_named(path: Path, images: Path | None = None) -> list[Path]:
    """The images and masks that a `transforms.json` names and that are there, wherever they lie; none of a bad file."""
    try:
        frames = _json(path).get("frames")
    except InputError:
        return []  # reading it for good will say what is wrong
    found = set()
    for frame in frames if isinstance(frames, list) else ():
        if isinstance(frame, dict):
            if isinstance(frame.get("file_path"), str):
                found.add(_find_image(path.parent, images, frame["file_path"]))
            if isinstance(frame.get("mask_path"), str) and is_file(path.parent / frame["mask_path"]):
                found.add(path.parent / frame["mask_path"])
    return sorted(file for file in found if file is not None)


def files_read(path: Path, kind: str, images: Path | None = None) -> list[Path]:
    """Every file that reading a source takes, masks of `scene.toml` left out; of a damaged one, what is known.

    Args:
        path: The source.
        kind: auto, or what it is taken for.
        images: Image folder of a posed set that has one elsewhere.

    Raises:
        InputError: nothing there that could be a source.
    """
    kind = detect_kind(path) if kind == "auto" else kind
    if kind == "transforms":
        table = path / "transforms.json" if path.is_dir() else path
        return [table, *files_named(table, images)]
    if kind == "colmap" and path.is_dir() and (model := find_model(path)) is not None:
        files = [file for file in model.iterdir() if is_file(file)]
        try:
            return [*files, *read_colmap(path, images).paths]
        except InputError:
            return files  # reading it for good will say what is wrong
    return _image_files(path) if kind == "images" and path.is_dir() else [path]


def lens_from_transforms(table: dict[str, Any], file: Path, where: str) -> Lens:
    """The lens of one frame; `table` is the file's top level overlaid with the frame's own entries.

    Raises:
        InputError: neither focal length nor angle of view, or a model COLMAP has no name for.
    """

    def number(key: str, default: float | None = None) -> float | None:
        value = table.get(key, default)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (number and abs(value) < _LARGEST):
            raise InputError(f"{where}: {key} = {shown(value)}; expected a finite number")
        return value

    if "w" in table and "h" in table:
        width, height = round(number("w") or 0), round(number("h") or 0)
    else:
        width, height = image_size(file)
    fx, fy = number("fl_x"), number("fl_y")
    angle_x, angle_y = number("camera_angle_x"), number("camera_angle_y")
    if fx is None and angle_x:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fy is None and angle_y and "fl_x" not in table:
        fy = 0.5 * height / math.tan(0.5 * angle_y)
    fx, fy = fx or fy, fy or fx
    if not fx or not fy:
        raise InputError(f"{where}: neither fl_x nor camera_angle_x; add the focal length [px]")
    core = (fx, fy, number("cx", 0.5 * width) or 0.0, number("cy", 0.5 * height) or 0.0)
    k1, k2, k3, k4, p1, p2 = (number(key, 0.0) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    name = table.get("camera_model") or ""
    if not isinstance(name, str):
        raise InputError(f"{where}: camera_model = {shown(name)}; expected OPENCV, OPENCV_FISHEYE or PINHOLE")
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
    """Whether a file is there and is called like an image."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and is_file(path)


def _image_files(folder: Path) -> list[Path]:
    return sorted(filter(is_image, folder.iterdir()), key=lambda p: natural_key(p.name))


def _json(path: Path) -> dict[str, Any]:
    try:
        table = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; give a transforms.json or the folder that holds it") from None
    if not isinstance(table, dict):
        raise InputError(f"{path}: expected a JSON object with frames, got {type(table).__name__}")
    return table


def _rigid(value: Any, where: str) -> Array:
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
    pose = np.eye(4)
    u, _, vt = np.linalg.svd(rotation)  # the nearest rotation: rounded numbers must not bend rays
    pose[:3, :3], pose[:3, 3] = u @ vt, matrix[:3, 3]
    return pose


def _world_of(table: dict[str, Any], path: Path) -> tuple[Array, float]:
    """What brings the file's world back to the one it was made from: a rigid transform, then a division by scale."""
    undo = np.eye(4)
    if "applied_transform" in table:
        undo = inverse_pose(_rigid(table["applied_transform"], f"{path}: applied_transform"))
    scale = table.get("applied_scale", 1.0)
    if not isinstance(scale, int | float) or isinstance(scale, bool) or not 1 / _LARGEST < scale < _LARGEST:
        raise InputError(f"{path}: applied_scale = {shown(scale)}; expected a positive number")
    # nerfstudio scales after it moves, x' = s (R x + t), so t of the undone transform is scaled as well.
    undo[:3, 3] *= scale
    return undo, float(scale)


def _find_image(base: Path, images: Path | None, name: str) -> Path | None:
    name = name.replace("\\", "/")
    places = [images / name, images / Path(name).name] if images else [base / name]
    for place in places:
        if is_file(place):
            return place
        # instant-ngp writes names without a suffix.
        if place.name and place.suffix.lower() not in IMAGE_SUFFIXES:
            for suffix in IMAGE_SUFFIXES:
                for candidate in (place.with_name(place.name + suffix), place.with_name(place.name + suffix.upper())):
                    if is_file(candidate):
                        return candidate
    return None
