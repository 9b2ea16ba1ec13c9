"""Frames, cameras and sparse points of a built scene, for programs that train radiance fields or splats.

A COLMAP workspace:

    DIR/images/<source>/<number>.png     undistorted frames
    DIR/masks/<source>/<number>.png.png  for frames with a mask; 0 = ignore
    DIR/sparse/0/cameras.txt, images.txt, points3D.txt

Its 2D points are projected 3D points, as the detected features are not kept. A nerfstudio data set:

    DIR/transforms.json                every frame
    DIR/transforms_<lighting>.json     frames of one lighting, if the scene has several, for `ns-train METHOD --data`
    DIR/images/..., DIR/masks/...      undistorted frames; masks, if any frame has one: 0 = ignore
    DIR/points.ply                     sparse points, from which splatfacto starts

Its cameras have OpenGL axes (x right, y up, looking along −z), and `applied_transform` is the identity; by default,
nerfstudio then rotates, centers and scales the poses. World coordinates of both are the scene's: meters, z up.
"""

import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from twin.assets.gaussians import ply_bytes
from twin.files import new_folder, write_bytes, write_json, write_text
from twin.geometry.cameras import Cameras, SparsePoints, opencv_to_mujoco, project
from twin.geometry.images import write_image
from twin.geometry.poses import inverse_pose

_POINTS = "points.ply"


def _copy_frames(cameras: Cameras, folder: Path, mask_name: Callable[[str], str], white: bool = False) -> None:
    """Copies frames to `images/` and masks to `masks/`; if `white`, frames without a mask get a white one."""
    for i, name in enumerate(cameras.names):
        image = folder / "images" / f"{name}.png"
        image.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(cameras.image_path(i), image)
        mask = cameras.mask_path(i)
        if mask or white:
            target = folder / "masks" / mask_name(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            if mask:
                shutil.copyfile(mask, target)
            else:
                write_image(target, np.full(cameras.sizes[i, ::-1], 255, np.uint8))


# ---- COLMAP


def write_colmap(out: Path, cameras: Cameras, points: SparsePoints) -> None:
    """Writes a COLMAP workspace; `points.frame` are indices into `cameras`."""
    with new_folder(out) as folder:
        _copy_frames(cameras, folder, lambda name: f"{name}.png.png")
        _write_model(folder, cameras, points)


def _write_model(folder: Path, cameras: Cameras, points: SparsePoints) -> None:
    """Writes COLMAP's text files to `folder/sparse/0`."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    keys = [(*size.tolist(), *k.tolist()) for size, k in zip(cameras.sizes, cameras.intrinsics, strict=True)]
    camera_ids = {key: i + 1 for i, key in enumerate(dict.fromkeys(keys))}
    pinholes = ((number, "PINHOLE", *key) for key, number in camera_ids.items())
    _write_lines(model / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy", pinholes)
    rows: list[tuple] = []
    tracks: list[list[int]] = [[] for _ in range(len(points))]
    for i, name in enumerate(cameras.names):
        world_to_camera = inverse_pose(cameras.camera_to_world[i])
        x, y, z, w = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat().tolist()
        file = f"{name}.png"
        rows.append((i + 1, w, x, y, z, *world_to_camera[:3, 3].tolist(), camera_ids[keys[i]], file))
        seen = np.unique(points.point[points.frame == i])
        pixels, depth = project(points.xyz[seen], cameras.camera_to_world[i], cameras.intrinsics[i])
        inside = (depth > 0.0) & (pixels >= 0.0).all(1) & (pixels <= cameras.sizes[i]).all(1)
        seen, pixels = seen[inside], pixels[inside]
        for k, point in enumerate(seen.tolist()):
            tracks[point] += [i + 1, k]
        rows.append(tuple(v for p, n in zip(pixels.tolist(), seen.tolist(), strict=True) for v in (*p, n + 1)))
    _write_lines(model / "images.txt", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; then X Y POINT3D_ID ...", rows)
    records = zip(points.xyz.tolist(), points.rgb.tolist(), points.error.tolist(), tracks, strict=True)
    seen_points = ((k + 1, *xyz, *rgb, error, *track) for k, (xyz, rgb, error, track) in enumerate(records) if track)
    _write_lines(model / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_INDEX ...", seen_points)


def _write_lines(path: Path, head: str, rows: Iterable[tuple]) -> None:
    """Writes a comment `head`, then one line per row; floating-point numbers keep all digits."""
    write_text(path, "\n".join([f"# {head}", *(" ".join(map(str, row)) for row in rows), ""]))


# ---- nerfstudio


def write_nerfstudio(out: Path, cameras: Cameras, points: SparsePoints) -> None:
    """Writes a nerfstudio data set."""
    everything = range(len(cameras))
    # nerfstudio requires masks for all frames or for none.
    masked = any(cameras.mask_path(i) for i in everything)
    with new_folder(out) as folder:
        _copy_frames(cameras, folder, lambda name: f"{name}.png", white=masked)
        columns = zip(("x", "y", "z", "red", "green", "blue"), (*points.xyz.T, *points.rgb.T), strict=True)
        write_bytes(folder / _POINTS, ply_bytes(dict(columns)))
        write_json(folder / "transforms.json", _transforms(cameras, everything, masked))
        names = dict.fromkeys(cameras.lightings)
        for lighting in names if len(names) > 1 else ():
            some = [i for i in everything if cameras.lightings[i] == lighting]
            write_json(folder / f"transforms_{lighting}.json", _transforms(cameras, some, masked))


def _transforms(cameras: Cameras, frames: Sequence[int], masked: bool) -> dict[str, Any]:
    """The contents of a `transforms.json` with these frames; the held-out ones are its validation and test set."""
    poses = opencv_to_mujoco(cameras.camera_to_world)  # MuJoCo's camera axes are OpenGL's
    listed = [
        {
            "file_path": f"images/{cameras.names[i]}.png",
            **({"mask_path": f"masks/{cameras.names[i]}.png"} if masked else {}),
            **dict(zip(("fl_x", "fl_y", "cx", "cy"), cameras.intrinsics[i].tolist(), strict=True)),
            **dict(zip(("w", "h"), cameras.sizes[i].tolist(), strict=True)),
            "transform_matrix": poses[i].tolist(),
            "lighting": cameras.lightings[i],
        }
        for i in frames
    ]
    held_out = [f"images/{cameras.names[i]}.png" for i in frames if cameras.held_out[i]]
    trained = [f"images/{cameras.names[i]}.png" for i in frames if not cameras.held_out[i]]
    # nerfstudio requires all three lists or none.
    split = {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out} if held_out else {}
    return {
        "camera_model": "OPENCV",  # without distortion
        "applied_transform": np.eye(4)[:3].tolist(),
        "applied_scale": 1.0,
        "ply_file_path": _POINTS,
        **split,
        "frames": listed,
    }
